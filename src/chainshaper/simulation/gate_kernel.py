"""The gate's decision, compiled: :func:`chainshaper.enforcement.gate.release_of` once more.

It is written down a second time because the engine cannot call Python; a test holds the two
against each other on random gates and messages.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.compiled.memory import compiled
from chainshaper.simulation import layout as at

__all__ = ["decide", "missed_slot", "switch_mode"]

MAX_FUTURE_NS = 1_000_000
MAX_AGE_CYCLES = 10


@compiled()
def decide(m, gate, arrival, stamp):
    """Decide about a message, in the gate's own row: when it may leave, and why."""
    age = arrival - stamp
    cycle_ns = m[gate + at.G_CYCLE]
    stamped = (
        m[gate + at.G_STAMPED] == 1 and age >= -MAX_FUTURE_NS and age <= MAX_AGE_CYCLES * cycle_ns
    )
    origin = stamp if stamped else arrival - (arrival - m[gate + at.G_PHASE]) % cycle_ns
    if stamped:
        m[gate + at.G_PHASE] = origin % cycle_ns
    mode = _mode_at(m, gate, origin)
    first, last, policy = _open_to(m, gate, mode)
    cycle = max(0, (arrival - origin) // cycle_ns)
    due_from = origin + m[gate + at.G_DUE] * cycle_ns
    overran = arrival >= due_from + m[last - 1]
    m[gate + at.G_ARRIVAL], m[gate + at.G_ORIGIN], m[gate + at.G_MODE] = arrival, origin, mode
    m[gate + at.G_BY_STAMP], m[gate + at.G_TREATED] = stamped, at.NONE
    m[gate + at.G_SLOT], m[gate + at.G_CYCLES] = at.NONE, cycle
    if overran and policy != at.WAIT:
        m[gate + at.G_AT] = arrival if policy == at.PUBLISH_LATE else at.NONE
        m[gate + at.G_TREATED] = policy
        return
    if overran:
        m[gate + at.G_TREATED] = at.WAIT
    elif mode != at.NONE and arrival >= due_from + m[first + 1]:
        m[gate + at.G_TREATED] = at.NEXT_SLOT
    while True:
        start = origin + m[gate + at.G_CYCLES] * cycle_ns
        for slot in range(first, last, 2):
            if arrival < start + m[slot + 1]:
                m[gate + at.G_AT] = max(arrival, start + m[slot])
                m[gate + at.G_SLOT] = (slot - m[gate + at.G_SLOTS]) // 2
                return
        m[gate + at.G_CYCLES] += 1


@compiled()
def missed_slot(m, gate):
    """Whether the message has to be discarded because its slot is over by now."""
    _, _, policy = _open_to(m, gate, m[gate + at.G_MODE])
    slot = m[gate + at.G_SLOT]
    if policy != at.DISCARD or slot == at.NONE:
        return False
    end = m[m[gate + at.G_SLOTS] + 2 * slot + 1]
    return m[at.X_NOW] >= m[gate + at.G_ORIGIN] + m[gate + at.G_CYCLES] * m[gate + at.G_CYCLE] + end


@compiled()
def switch_mode(m, gate, mode):
    """A mode is announced; one that the gate does not know, or has already, changes nothing."""
    if mode == at.NONE or m[m[gate + at.G_BANDS] + mode] == at.NONE:
        return
    count, changes = m[gate + at.G_CHANGED], m[gate + at.G_CHANGES]
    current = m[gate + at.G_DEFAULT]
    if count:
        current = m[changes + 2 * ((count - 1) % at.CHANGES_KEPT) + 1]
    if mode != current:
        place = changes + 2 * (count % at.CHANGES_KEPT)
        m[place], m[place + 1] = m[at.X_NOW], mode
        m[gate + at.G_CHANGED] = count + 1


@compiled()
def _mode_at(m, gate, origin):
    mode = m[gate + at.G_DEFAULT]
    if mode == at.NONE:
        return mode
    count, changes = m[gate + at.G_CHANGED], m[gate + at.G_CHANGES]
    for number in range(count - 1, max(-1, count - 1 - at.CHANGES_KEPT), -1):
        place = changes + 2 * (number % at.CHANGES_KEPT)
        if m[place] <= origin:
            return m[place + 1]
    return mode


@compiled()
def _open_to(m, gate, mode):
    """Where the slots open to a mode begin and end, and what is done behind them."""
    first, last = m[gate + at.G_SLOTS], m[gate + at.G_SLOTS_END]
    if mode == at.NONE:
        return first, last, m[gate + at.G_OVERRUN]
    band = first + 2 * m[m[gate + at.G_BANDS] + mode]
    if m[gate + at.G_LATE] == at.NEXT_SLOT:
        return band, last, m[gate + at.G_OVERRUN]
    return band, band + 2, m[gate + at.G_LATE]
