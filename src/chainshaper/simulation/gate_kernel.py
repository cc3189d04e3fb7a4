"""The gate's decision, compiled: :func:`chainshaper.enforcement.gate.release_of` once more.

It is written down a second time because the engine cannot call Python; a test holds the two
against each other on random gates and messages.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.layout import (
    CHANGES_KEPT,
    DISCARD,
    G_ARRIVAL,
    G_AT,
    G_BANDS,
    G_BY_STAMP,
    G_CHANGED,
    G_CHANGES,
    G_CYCLE,
    G_CYCLES,
    G_DEFAULT,
    G_DUE,
    G_LATE,
    G_MODE,
    G_ORIGIN,
    G_OVERRUN,
    G_PHASE,
    G_SLOT,
    G_SLOTS,
    G_SLOTS_END,
    G_STAMPED,
    G_TREATED,
    NEXT_SLOT,
    NONE,
    PUBLISH_LATE,
    WAIT,
    X_NOW,
)

__all__ = ["decide", "missed_slot", "switch_mode"]

MAX_FUTURE_NS = 1_000_000
MAX_AGE_CYCLES = 10


@compiled
def decide(m, gate, arrival, stamp):
    """Decide about a message, in the gate's own row: when it may leave, and why."""
    age = arrival - stamp
    cycle_ns = m[gate + G_CYCLE]
    stamped = (
        m[gate + G_STAMPED] == 1 and age >= -MAX_FUTURE_NS and age <= MAX_AGE_CYCLES * cycle_ns
    )
    origin = stamp if stamped else arrival - (arrival - m[gate + G_PHASE]) % cycle_ns
    if stamped:
        m[gate + G_PHASE] = origin % cycle_ns
    mode = _mode_at(m, gate, origin)
    first, last, policy = _open_to(m, gate, mode)
    cycle = max(0, (arrival - origin) // cycle_ns)
    due_from = origin + m[gate + G_DUE] * cycle_ns
    overran = arrival >= due_from + m[last - 1]
    m[gate + G_ARRIVAL], m[gate + G_ORIGIN], m[gate + G_MODE] = arrival, origin, mode
    m[gate + G_BY_STAMP], m[gate + G_TREATED] = stamped, NONE
    m[gate + G_SLOT], m[gate + G_CYCLES] = NONE, cycle
    if overran and policy != WAIT:
        m[gate + G_AT] = arrival if policy == PUBLISH_LATE else NONE
        m[gate + G_TREATED] = policy
        return
    if overran:
        m[gate + G_TREATED] = WAIT
    elif mode != NONE and arrival >= due_from + m[first + 1]:
        m[gate + G_TREATED] = NEXT_SLOT
    while True:
        start = origin + m[gate + G_CYCLES] * cycle_ns
        for slot in range(first, last, 2):
            if arrival < start + m[slot + 1]:
                m[gate + G_AT] = max(arrival, start + m[slot])
                m[gate + G_SLOT] = (slot - m[gate + G_SLOTS]) // 2
                return
        m[gate + G_CYCLES] += 1


@compiled
def missed_slot(m, gate):
    """Whether the message has to be discarded because its slot is over by now."""
    _, _, policy = _open_to(m, gate, m[gate + G_MODE])
    slot = m[gate + G_SLOT]
    if policy != DISCARD or slot == NONE:
        return False
    end = m[m[gate + G_SLOTS] + 2 * slot + 1]
    return m[X_NOW] >= m[gate + G_ORIGIN] + m[gate + G_CYCLES] * m[gate + G_CYCLE] + end


@compiled
def switch_mode(m, gate, mode):
    """A mode is announced; one that the gate does not know, or has already, changes nothing."""
    if mode == NONE or m[m[gate + G_BANDS] + mode] == NONE:
        return
    count, changes = m[gate + G_CHANGED], m[gate + G_CHANGES]
    current = m[gate + G_DEFAULT]
    if count:
        current = m[changes + 2 * ((count - 1) % CHANGES_KEPT) + 1]
    if mode != current:
        place = changes + 2 * (count % CHANGES_KEPT)
        m[place], m[place + 1] = m[X_NOW], mode
        m[gate + G_CHANGED] = count + 1


@compiled
def _mode_at(m, gate, origin):
    mode = m[gate + G_DEFAULT]
    if mode == NONE:
        return mode
    count, changes = m[gate + G_CHANGED], m[gate + G_CHANGES]
    for number in range(count - 1, max(-1, count - 1 - CHANGES_KEPT), -1):
        place = changes + 2 * (number % CHANGES_KEPT)
        if m[place] <= origin:
            return m[place + 1]
    return mode


@compiled
def _open_to(m, gate, mode):
    """Where the slots open to a mode begin and end, and what is done behind them."""
    first, last = m[gate + G_SLOTS], m[gate + G_SLOTS_END]
    if mode == NONE:
        return first, last, m[gate + G_OVERRUN]
    band = first + 2 * m[m[gate + G_BANDS] + mode]
    if m[gate + G_LATE] == NEXT_SLOT:
        return band, last, m[gate + G_OVERRUN]
    return band, band + 2, m[gate + G_LATE]
