"""What the compiled engine keeps things in: streams of numbers, events to come, messages, the log.

Everything is of a fixed size. Where something runs short, `X_PAUSED` says what, and the engine is
left at the next safe place; limits keep enough in reserve for what happens until then.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation import layout as at
from chainshaper.values.compiled.memory import compiled

__all__ = [
    "append",
    "begin_entry",
    "draw",
    "drop_expired",
    "free_message",
    "log",
    "new_message",
    "pop_event",
    "pop_head",
    "push_event",
    "put_newest",
    "take_oldest",
]


@compiled()
def draw(m, stream):
    """The next value of a stream."""
    constant = m[stream + at.D_CONSTANT]
    if constant != at.NONE:
        return constant
    place = m[stream + at.D_NEXT]
    m[stream + at.D_NEXT] = place + 1
    if place >= m[stream + at.D_LIMIT]:
        m[at.X_PAUSED] = at.MORE_DRAWS
    return m[place]


@compiled()
def begin_entry(m, kind, time, thread):
    """Begin an entry of the log with time and thread; where it stands (NONE: not recorded)."""
    if m[at.X_LOGGING] == 0 or time < m[at.X_RECORD_FROM]:
        return at.NONE
    area = m[at.X_LOGS] + kind * at.LOG_COLUMNS
    count, stride = m[area + at.A_COUNT], m[area + at.A_STRIDE]
    m[area + at.A_COUNT] = count + 1
    if count + at.RESERVE >= stride:
        m[at.X_PAUSED] = at.LOG_FULL
    place = m[area + at.A_FIRST] + count
    m[place] = time
    m[place + stride] = at.NONE if thread == at.NONE else m[thread + at.T_ROW]
    return place


@compiled()
def log(m, kind, thread, fields):
    """An entry of the log about what happens now."""
    place = begin_entry(m, kind, m[at.X_NOW], thread)
    if place != at.NONE:
        stride = m[m[at.X_LOGS] + kind * at.LOG_COLUMNS + at.A_STRIDE]
        place += 2 * stride
        for field in range(len(fields)):
            m[place + field * stride] = fields[field]


@compiled()
def push_event(m, time, kind, row):
    """Something will happen; of what happens at one time, the first pushed comes first."""
    place = m[at.X_HEAP_END]
    m[at.X_HEAP_END] = place + at.HEAP_COLUMNS
    order = m[at.X_COUNTER]
    m[at.X_COUNTER] = order + 1
    heap = m[at.X_HEAP]
    while place > heap:
        above = heap + (((place - heap) // at.HEAP_COLUMNS - 1) >> 1) * at.HEAP_COLUMNS
        if m[above + at.H_TIME] <= time:
            break
        _move(m, above, place)
        place = above
    m[place + at.H_TIME] = time
    m[place + at.H_ORDER] = order
    m[place + at.H_KIND] = kind
    m[place + at.H_ROW] = row
    if m[at.X_HEAP_END] >= m[at.X_HEAP_LIMIT]:
        m[at.X_PAUSED] = at.MESSAGES_FULL


@compiled()
def pop_event(m):
    """Kind and row of the next event."""
    heap = m[at.X_HEAP]
    kind, row = m[heap + at.H_KIND], m[heap + at.H_ROW]
    last = m[at.X_HEAP_END] - at.HEAP_COLUMNS
    m[at.X_HEAP_END] = last
    place = heap
    while True:
        below = 2 * place - heap + at.HEAP_COLUMNS
        if below >= last:
            break
        if below + at.HEAP_COLUMNS < last and _earlier(m, below + at.HEAP_COLUMNS, below):
            below += at.HEAP_COLUMNS
        if _earlier(m, last, below):
            break
        _move(m, below, place)
        place = below
    _move(m, last, place)
    return kind, row


@compiled()
def _move(m, source, target):
    for column in range(at.HEAP_COLUMNS):
        m[target + column] = m[source + column]


@compiled()
def _earlier(m, one, other):
    if m[one + at.H_TIME] != m[other + at.H_TIME]:
        return m[one + at.H_TIME] < m[other + at.H_TIME]
    return m[one + at.H_ORDER] < m[other + at.H_ORDER]


@compiled()
def new_message(m):
    """An unused row of the pool."""
    message = m[at.X_FREE]
    m[at.X_FREE] = m[message + at.M_NEXT]
    m[message + at.M_NEXT] = at.NONE
    m[at.X_UNUSED] -= 1
    if m[at.X_UNUSED] <= at.RESERVE:
        m[at.X_PAUSED] = at.MESSAGES_FULL
    return message


@compiled()
def free_message(m, message):
    """Give a row back to the pool."""
    m[message + at.M_NEXT] = m[at.X_FREE]
    m[at.X_FREE] = message
    m[at.X_UNUSED] += 1


@compiled()
def append(m, thread, message):
    """A message goes to the end of a thread's queue."""
    m[message + at.M_NEXT] = at.NONE
    if m[thread + at.T_HEAD] == at.NONE:
        m[thread + at.T_HEAD] = message
    else:
        m[m[thread + at.T_TAIL] + at.M_NEXT] = message
    m[thread + at.T_TAIL] = message


@compiled()
def pop_head(m, thread):
    """The first message of a thread's queue."""
    message = m[thread + at.T_HEAD]
    m[thread + at.T_HEAD] = m[message + at.M_NEXT]
    return message


@compiled()
def put_newest(m, ring, message):
    """A message goes to the end of a ring; the oldest one of a full ring is gone."""
    if m[ring + at.Q_WAITING] == m[ring + at.Q_DEPTH]:
        free_message(m, take_oldest(m, ring))
    place = (m[ring + at.Q_HEAD] + m[ring + at.Q_WAITING]) % m[ring + at.Q_DEPTH]
    m[m[ring + at.Q_PLACES] + place] = message
    m[ring + at.Q_WAITING] += 1


@compiled()
def take_oldest(m, ring):
    """The oldest message of a ring that is not empty, taken out."""
    message = m[m[ring + at.Q_PLACES] + m[ring + at.Q_HEAD]]
    m[ring + at.Q_HEAD] = (m[ring + at.Q_HEAD] + 1) % m[ring + at.Q_DEPTH]
    m[ring + at.Q_WAITING] -= 1
    return message


@compiled()
def drop_expired(m, entity):
    """Forget messages that have waited in a history for longer than their lifespan."""
    lifespan = m[entity + at.E_LIFESPAN]
    while lifespan != at.NONE and m[entity + at.E_WAITING] > 0:
        message = m[m[entity + at.E_HISTORY] + m[entity + at.E_HEAD]]
        if m[at.X_NOW] - m[message + at.M_ARRIVAL] <= lifespan:
            return
        free_message(m, take_oldest(m, entity + at.E_HISTORY))
