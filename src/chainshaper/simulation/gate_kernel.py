"""The gate's decisions, compiled: `Queue` of :mod:`chainshaper.gate.decision` once more.

They are written down a second time because the engine cannot call Python; tests hold the two
against each other, on random gates and messages and on `tests/gate_conformance.yaml`.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.gate.decision import MAX_AGE_CYCLES, MAX_FUTURE_NS
from chainshaper.simulation import layout as at
from chainshaper.values.compiled.memory import compiled


@compiled()
def decide(m, gate, arrival, stamp):
    """Decide about a message whose turn it is, in the gate's own row: when it may leave, and why.

    As `Queue.decide` does.
    """
    ready = max(arrival, m[gate + at.G_FREE])
    _release(m, gate, gate, arrival, stamp, ready)
    if m[gate + at.G_BY_STAMP] == 1:
        m[gate + at.G_PHASE] = m[gate + at.G_ORIGIN] % m[gate + at.G_CYCLE]
    if m[gate + at.G_AT] == at.NONE:
        m[gate + at.G_DROPPED] = at.DISCARDED
        return
    if m[gate + at.G_SLOT] == at.NONE or m[gate + at.G_MESSAGES] == at.ALL_IN_ORDER:
        return
    left = m[gate + at.G_LEFT]
    if left != at.NONE and _same_cycle(m, gate, _start(m, gate, gate), left):
        if m[gate + at.G_MESSAGES] == at.FIRST:
            drop(m, gate, at.SURPLUS)
            return
        last_end = m[m[gate + at.G_SLOTS_END] - 1]
        _release(m, gate, gate, arrival, stamp, max(ready, left + last_end))
        if m[gate + at.G_AT] == at.NONE:
            m[gate + at.G_DROPPED] = at.DISCARDED
            return
        if m[gate + at.G_SLOT] == at.NONE:
            m[gate + at.G_AT] = ready
            return
    start, leaving = _start(m, gate, gate), m[gate + at.G_LEAVING]
    if leaving == at.NONE or not _same_cycle(m, gate, start, leaving):
        m[gate + at.G_LEAVING] = start


@compiled()
def drop(m, gate, why):
    """The message never leaves."""
    m[gate + at.G_AT] = m[gate + at.G_SLOT] = at.NONE
    m[gate + at.G_DROPPED] = why


@compiled()
def left(m, gate):
    """The message leaves."""
    if m[gate + at.G_SLOT] != at.NONE:
        m[gate + at.G_LEFT] = m[gate + at.G_LEAVING]


@compiled()
def replaces(m, gate, arrival, stamp):
    """Whether a message that waits would leave for the one that the gate holds."""
    if m[gate + at.G_MESSAGES] != at.NEWEST or m[gate + at.G_SLOT] == at.NONE:
        return False
    other = gate + at.G_OTHER - at.G_ARRIVAL
    _release(m, gate, other, arrival, stamp, m[at.X_NOW])
    if m[other + at.G_SLOT] == at.NONE or m[gate + at.G_LEAVING] == at.NONE:
        return False
    return _same_cycle(m, gate, _start(m, gate, other), m[gate + at.G_LEAVING])


@compiled()
def _start(m, gate, row):
    return m[row + at.G_ORIGIN] + m[row + at.G_CYCLES] * m[gate + at.G_CYCLE]


@compiled()
def _same_cycle(m, gate, start, other):
    return 2 * abs(start - other) < m[gate + at.G_CYCLE]


@compiled()
def _release(m, gate, row, arrival, stamp, ready):  # noqa: PLR0917 - as `release_of`
    """What `release_of` decides, into the fields from G_ARRIVAL on, counted from ``row``."""
    age = arrival - stamp
    cycle_ns = m[gate + at.G_CYCLE]
    due = m[gate + at.G_DUE]
    max_age = (MAX_AGE_CYCLES + due) * cycle_ns
    stamped = m[gate + at.G_STAMPED] == 1 and age >= -MAX_FUTURE_NS and age <= max_age
    origin = stamp if stamped else arrival - (arrival - m[gate + at.G_PHASE]) % cycle_ns
    if not stamped:
        due = min(due, 1)
    mode = _mode_at(m, gate, origin)
    first, last, policy = _open_to(m, gate, mode)
    ready = max(arrival, ready)
    cycle = max(0, (ready - origin) // cycle_ns)
    due_from = origin + due * cycle_ns
    overran = ready >= due_from + m[last - 1]
    m[row + at.G_ARRIVAL], m[row + at.G_ORIGIN], m[row + at.G_MODE] = arrival, origin, mode
    m[row + at.G_BY_STAMP], m[row + at.G_TREATED] = stamped, at.NONE
    m[row + at.G_SLOT], m[row + at.G_CYCLES], m[row + at.G_DROPPED] = at.NONE, cycle, at.NONE
    if overran and policy != at.WAIT:
        m[row + at.G_AT] = ready if policy == at.PUBLISH_LATE else at.NONE
        m[row + at.G_TREATED] = policy
        return
    if overran:
        m[row + at.G_TREATED] = at.WAIT
    elif mode != at.NONE and ready >= due_from + m[first + 1]:
        m[row + at.G_TREATED] = at.NEXT_SLOT
    m[row + at.G_CYCLES] = max(due, cycle)
    while True:
        start = origin + m[row + at.G_CYCLES] * cycle_ns
        for slot in range(first, last, 2):
            if ready < start + m[slot + 1]:
                m[row + at.G_AT] = max(ready, start + m[slot])
                m[row + at.G_SLOT] = (slot - m[gate + at.G_SLOTS]) // 2
                return
        m[row + at.G_CYCLES] += 1


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
