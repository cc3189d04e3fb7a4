"""What the compiled engine keeps things in: streams of numbers, events to come, messages, the log.

Everything is of a fixed size. Where something runs short, `X_PAUSED` says what, and the engine is
left at the next safe place; limits keep enough in reserve for what happens until then.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.layout import (
    A_COUNT,
    A_FIRST,
    A_STRIDE,
    D_CONSTANT,
    D_LIMIT,
    D_NEXT,
    E_DEPTH,
    E_HEAD,
    E_LIFESPAN,
    E_RING,
    E_WAITING,
    H_KIND,
    H_ORDER,
    H_ROW,
    H_TIME,
    HEAP_COLUMNS,
    LOG_COLUMNS,
    LOG_FULL,
    M_ARRIVAL,
    M_NEXT,
    MESSAGES_FULL,
    MORE_DRAWS,
    NONE,
    T_HEAD,
    T_ROW,
    T_TAIL,
    X_COUNTER,
    X_FREE,
    X_HEAP,
    X_HEAP_END,
    X_HEAP_LIMIT,
    X_LOGGING,
    X_LOGS,
    X_NOW,
    X_PAUSED,
    X_RECORD_FROM,
    X_UNUSED,
)

__all__ = [
    "RESERVE",
    "append",
    "begin_entry",
    "draw",
    "drop_expired",
    "free_message",
    "log",
    "new_message",
    "oldest_message",
    "pop_event",
    "pop_head",
    "push_event",
]

RESERVE = 1024
"""So much of everything is left when the engine pauses: more than one step can use."""


@compiled
def draw(m, stream):
    """The next value of a stream."""
    constant = m[stream + D_CONSTANT]
    if constant != NONE:
        return constant
    place = m[stream + D_NEXT]
    m[stream + D_NEXT] = place + 1
    if place >= m[stream + D_LIMIT]:
        m[X_PAUSED] = MORE_DRAWS
    return m[place]


@compiled
def begin_entry(m, kind, time, thread):
    """Begin an entry of the log with time and thread; where it stands (NONE: not recorded)."""
    if m[X_LOGGING] == 0 or time < m[X_RECORD_FROM]:
        return NONE
    area = m[X_LOGS] + kind * LOG_COLUMNS
    count, stride = m[area + A_COUNT], m[area + A_STRIDE]
    m[area + A_COUNT] = count + 1
    if count + RESERVE >= stride:
        m[X_PAUSED] = LOG_FULL
    place = m[area + A_FIRST] + count
    m[place] = time
    m[place + stride] = NONE if thread == NONE else m[thread + T_ROW]
    return place


@compiled
def log(m, kind, thread, fields):
    """An entry of the log about what happens now."""
    place = begin_entry(m, kind, m[X_NOW], thread)
    if place != NONE:
        stride = m[m[X_LOGS] + kind * LOG_COLUMNS + A_STRIDE]
        place += 2 * stride
        for field in range(len(fields)):
            m[place + field * stride] = fields[field]


@compiled
def push_event(m, time, kind, row):
    """Something will happen; of what happens at one time, the first pushed comes first."""
    place = m[X_HEAP_END]
    m[X_HEAP_END] = place + HEAP_COLUMNS
    order = m[X_COUNTER]
    m[X_COUNTER] = order + 1
    heap = m[X_HEAP]
    while place > heap:
        above = heap + (((place - heap) // HEAP_COLUMNS - 1) >> 1) * HEAP_COLUMNS
        if m[above + H_TIME] <= time:
            break
        _move(m, above, place)
        place = above
    m[place + H_TIME] = time
    m[place + H_ORDER] = order
    m[place + H_KIND] = kind
    m[place + H_ROW] = row
    if m[X_HEAP_END] >= m[X_HEAP_LIMIT]:
        m[X_PAUSED] = MESSAGES_FULL


@compiled
def pop_event(m):
    """Kind and row of the next event."""
    heap = m[X_HEAP]
    kind, row = m[heap + H_KIND], m[heap + H_ROW]
    last = m[X_HEAP_END] - HEAP_COLUMNS
    m[X_HEAP_END] = last
    place = heap
    while True:
        below = 2 * place - heap + HEAP_COLUMNS
        if below >= last:
            break
        if below + HEAP_COLUMNS < last and _earlier(m, below + HEAP_COLUMNS, below):
            below += HEAP_COLUMNS
        if _earlier(m, last, below):
            break
        _move(m, below, place)
        place = below
    _move(m, last, place)
    return kind, row


@compiled
def _move(m, source, target):
    for column in range(HEAP_COLUMNS):
        m[target + column] = m[source + column]


@compiled
def _earlier(m, one, other):
    if m[one + H_TIME] != m[other + H_TIME]:
        return m[one + H_TIME] < m[other + H_TIME]
    return m[one + H_ORDER] < m[other + H_ORDER]


@compiled
def new_message(m):
    """An unused row of the pool."""
    message = m[X_FREE]
    m[X_FREE] = m[message + M_NEXT]
    m[message + M_NEXT] = NONE
    m[X_UNUSED] -= 1
    if m[X_UNUSED] <= RESERVE:
        m[X_PAUSED] = MESSAGES_FULL
    return message


@compiled
def free_message(m, message):
    """Give a row back to the pool."""
    m[message + M_NEXT] = m[X_FREE]
    m[X_FREE] = message
    m[X_UNUSED] += 1


@compiled
def append(m, thread, message):
    """A message goes to the end of a thread's queue."""
    m[message + M_NEXT] = NONE
    if m[thread + T_HEAD] == NONE:
        m[thread + T_HEAD] = message
    else:
        m[m[thread + T_TAIL] + M_NEXT] = message
    m[thread + T_TAIL] = message


@compiled
def pop_head(m, thread):
    """The first message of a thread's queue."""
    message = m[thread + T_HEAD]
    m[thread + T_HEAD] = m[message + M_NEXT]
    return message


@compiled
def oldest_message(m, entity):
    """The oldest message of a history that is not empty, taken out."""
    message = m[m[entity + E_RING] + m[entity + E_HEAD]]
    m[entity + E_HEAD] = (m[entity + E_HEAD] + 1) % m[entity + E_DEPTH]
    m[entity + E_WAITING] -= 1
    return message


@compiled
def drop_expired(m, entity):
    """Forget messages that have waited in a history for longer than their lifespan."""
    lifespan = m[entity + E_LIFESPAN]
    while lifespan != NONE and m[entity + E_WAITING] > 0:
        message = m[m[entity + E_RING] + m[entity + E_HEAD]]
        if m[X_NOW] - m[message + M_ARRIVAL] <= lifespan:
            return
        free_message(m, oldest_message(m, entity))
