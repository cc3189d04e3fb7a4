"""What happens in the compiled engine: queues, how messages travel, and what callbacks do.

Everything is of a fixed size. Where something runs short, `X_PAUSED` says what, and the engine is
left at the next safe place; limits leave enough in reserve for what happens until then.

A publication reaches every reader of its topic after a delay, in order (DDS delivers the messages
of one writer in order). Optionally a DDS thread of the subscriber's process works for it first.
A history has the last ``depth`` messages: a newer one overwrites the oldest. An asynchronous
publisher hands its message to the publisher thread of its process, whose history has those that
are not sent yet; see :mod:`chainshaper.workload.executor`.

A callback has started when :func:`begin_body` is called. Its functions leave in its thread's row
how much CPU time it needs next and what follows (`T_LEFT`, `T_STEP`), or let the thread wait.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation import layout as at
from chainshaper.simulation.gate_kernel import (
    decide,
    drop,
    left,
    missed_slot,
    replaces,
    switch_mode,
)
from chainshaper.values.compiled.memory import compiled

__all__ = [
    "append",
    "arrive",
    "begin_body",
    "deliver",
    "draw",
    "drop_expired",
    "free_message",
    "go_on_publishing",
    "log",
    "mark_event",
    "pass_gate",
    "pop_event",
    "pop_head",
    "push_event",
    "send",
    "take_oldest",
    "wake",
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


ADDRESSES = 64
"""Addresses of messages repeat, as they do in a real process."""

FIRST_ADDRESS, APART = 0x7F00_0000_0000, 0x480


@compiled()
def wake(m, thread):
    """A thread that waits becomes runnable, at the end of the queue of its rank."""
    m[thread + at.T_RUNNABLE] = 1
    m[thread + at.T_LEFT] += draw(m, m[thread + at.T_WAKE])
    m[thread + at.T_SEQUENCE] = m[at.X_COUNTER]
    m[at.X_COUNTER] += 1
    m[m[thread + at.T_CORE] + at.C_DIRTY] = 1


@compiled()
def publish(m, thread, publisher):
    """The executor publishes: what it passes on stands in its thread's row."""
    now, published = m[at.X_NOW], m[publisher + at.P_PUBLISHED]
    m[publisher + at.P_PUBLISHED] += 1
    address = FIRST_ADDRESS + (m[publisher + at.P_ROW] * ADDRESSES + published % ADDRESSES) * APART
    log(m, at.L_PUBLISH, thread, (m[publisher + at.P_ROW], address))
    message = new_message(m)
    m[message + at.M_PUBLISHER], m[message + at.M_SOURCE] = publisher, now
    m[message + at.M_ADDRESS], m[message + at.M_ORIGIN] = address, m[thread + at.T_ORIGIN]
    m[message + at.M_START] = m[thread + at.T_START]
    m[message + at.M_NUMBER] = m[thread + at.T_NUMBER]
    m[message + at.M_MODE] = at.NONE
    if m[publisher + at.P_MODES_COUNT] > 0:
        m[message + at.M_MODE] = m[
            m[publisher + at.P_MODES] + published % m[publisher + at.P_MODES_COUNT]
        ]
    if m[publisher + at.P_ASYNCHRONOUS] == 1:
        _hand_over(m, m[thread + at.T_PUBLISHER_THREAD], message)
    else:
        send(m, thread, message)


@compiled()
def send(m, thread, message):
    """A message leaves now, sent by a thread; it is free afterwards, readers get copies."""
    publisher, now = m[message + at.M_PUBLISHER], m[at.X_NOW]
    if m[publisher + at.P_ENDS_CHAIN] == 1 and m[message + at.M_START] != at.NONE:
        noted = m[at.X_LATENCIES] + m[message + at.M_NUMBER] - m[at.X_WARM_UP]
        if m[at.X_LATENCIES] <= noted < m[at.X_LATENCIES_END] and m[noted] == at.NONE:
            m[noted] = now - m[message + at.M_START]
    for reader in range(m[publisher + at.P_FIRST], m[publisher + at.P_END], at.READER_COLUMNS):
        copy = new_message(m)
        _copy(m, message, copy)
        m[copy + at.M_ENTITY] = m[reader + at.R_ENTITY]
        arrival = max(now + draw(m, m[thread + at.T_DELIVERY]), m[reader + at.R_LAST])
        m[reader + at.R_LAST] = arrival
        if arrival == now:
            deliver(m, copy)
        else:
            push_event(m, arrival, at.DELIVERY, copy)
    free_message(m, message)


@compiled()
def deliver(m, message):
    """A message reaches its reader's process, where a DDS thread may have to work for it."""
    receiver = m[m[m[message + at.M_ENTITY] + at.E_THREAD] + at.T_DDS_THREAD]
    if receiver == at.NONE:
        arrive(m, message)
        return
    append(m, receiver, message)
    if m[receiver + at.T_RUNNABLE] == 0 and m[receiver + at.T_STEP] == at.RECEIVE:
        wake(m, receiver)


@compiled()
def arrive(m, message):
    """A message enters its reader's history, and wakes the executor if it waits for work."""
    entity = m[message + at.M_ENTITY]
    m[message + at.M_ARRIVAL] = m[at.X_NOW]
    overwrites = m[entity + at.E_WAITING] == m[entity + at.E_DEPTH]
    if overwrites and m[entity + at.E_BODY] == at.GATE:
        _note_overflow(m, entity)
    put_newest(m, entity + at.E_HISTORY, message)
    thread = m[entity + at.E_THREAD]
    # The event of the message that was overwritten is still in the queue, for this one to use.
    if m[thread + at.T_KIND] == at.EVENTS and not overwrites:
        mark_event(m, thread, entity)
    if m[thread + at.T_RUNNABLE] == 0 and m[thread + at.T_STEP] == at.COLLECT:
        wake(m, thread)


@compiled()
def _note_overflow(m, entity):
    """A gate has no room any more for the oldest message that waits there."""
    gate = m[entity + at.E_BODY_ROW]
    oldest = m[m[entity + at.E_HISTORY] + m[entity + at.E_HEAD]]
    came, origin = m[oldest + at.M_ARRIVAL], m[oldest + at.M_ORIGIN]
    about = (m[entity + at.E_ROW], m[oldest + at.M_SOURCE])
    decision = (came, at.NONE, origin, at.NONE, 0, m[gate + at.G_STAMPED], at.NONE, at.NONE)
    log(m, at.L_RELEASE, m[entity + at.E_THREAD], (*about, *decision, at.OVERFLOWED))


@compiled()
def mark_event(m, thread, entity):
    """An entity of an events executor has something to execute: to the end of its queue."""
    event = new_message(m)
    m[event + at.M_ENTITY] = entity
    append(m, thread, event)


@compiled()
def _hand_over(m, thread, message):
    """Put a message into its asynchronous writer's history, which keeps the last ones."""
    publisher = m[message + at.M_PUBLISHER]
    if m[publisher + at.P_HELD] < m[publisher + at.P_DEPTH]:
        m[publisher + at.P_HELD] += 1
        append(m, thread, message)
    else:
        # All of this writer's move up by one place; the oldest one's is gone.
        place = m[thread + at.T_HEAD]
        while m[place + at.M_PUBLISHER] != publisher:
            place = m[place + at.M_NEXT]
        entry = (m[publisher + at.P_ROW], m[place + at.M_SOURCE], at.OVERWRITTEN, 0)
        log(m, at.L_SEND, thread, entry)
        following = m[place + at.M_NEXT]
        while following != at.NONE:
            if m[following + at.M_PUBLISHER] == publisher:
                _copy(m, following, place)
                place = following
            following = m[following + at.M_NEXT]
        _copy(m, message, place)
        free_message(m, message)
    if m[thread + at.T_RUNNABLE] == 0 and m[thread + at.T_STEP] == at.SEND:
        wake(m, thread)


@compiled()
def _copy(m, source, target):
    for field in range(at.M_PUBLISHER, at.M_ARRIVAL):
        m[target + field] = m[source + field]


@compiled()
def begin_body(m, thread):
    """Begin the callback of the thread's entity; false if it has ended already."""
    entity = m[thread + at.T_ENTITY]
    body = m[entity + at.E_BODY]
    m[thread + at.T_PUBLICATION] = m[entity + at.E_PUBLISHERS]
    m[thread + at.T_STEP] = at.PUBLISH
    if body == at.GATE:
        return _hold(m, thread)
    if body == at.MODE_LISTENER:
        switch_mode(m, m[entity + at.E_BODY_ROW], m[thread + at.T_MODE])
        return _end(m, thread)
    if body == at.SYNCHRONISE and not _complete(m, thread):
        return _end(m, thread)
    execution = draw(m, m[entity + at.E_EXECUTION])
    m[thread + at.T_LEFT] = execution + execution * m[at.X_AWAY] // 1_000_000
    return True


@compiled()
def go_on_publishing(m, thread):
    """Publish on the next topic; false if all have been served and the callback has ended."""
    publisher = m[thread + at.T_PUBLICATION]
    if publisher == m[m[thread + at.T_ENTITY] + at.E_PUBLISHERS_END]:
        return _end(m, thread)
    m[thread + at.T_PUBLICATION] += at.PUBLISHER_COLUMNS
    publish(m, thread, publisher)
    m[thread + at.T_LEFT] = draw(m, m[thread + at.T_PUBLISH])
    return True


@compiled()
def sleep(m, thread, until):
    """A thread waits for an instant, whatever else happens."""
    m[thread + at.T_RUNNABLE] = 0
    m[m[thread + at.T_CORE] + at.C_DIRTY] = 1
    push_event(m, until, at.SLEEP_OVER, thread)


@compiled()
def pass_gate(m, thread):
    """A thread of a gate goes on: awake, watching the clock, having published or paused.

    False if the callback has ended.
    """
    entity, now = m[thread + at.T_ENTITY], m[at.X_NOW]
    gate = m[entity + at.E_BODY_ROW]
    if m[thread + at.T_STEP] == at.GATE_WAKE:
        if m[thread + at.T_BEGAN] == at.NONE:  # it has just woken
            m[thread + at.T_BEGAN] = now
            _look(m, entity, gate)
            if m[gate + at.G_AT] == at.NONE:
                return _released(m, thread)
        if now < m[gate + at.G_AT]:
            m[thread + at.T_LEFT] = m[gate + at.G_AT] - now  # watching the clock
            return True
        m[thread + at.T_BEGAN] = now
        if missed_slot(m, gate):
            drop(m, gate, at.DISCARDED)
            m[gate + at.G_TREATED] = at.DISCARD
            return _released(m, thread)
        left(m, gate)
        m[thread + at.T_STEP] = at.GATE_PUBLISHED
        publish(m, thread, m[entity + at.E_PUBLISHERS])
        m[thread + at.T_LEFT] = draw(m, m[thread + at.T_PUBLISH])
        return True
    # Another message that waits already must not become late by the pause.
    published = m[thread + at.T_STEP] == at.GATE_PUBLISHED
    if published and m[gate + at.G_PAUSE] > 0 and m[entity + at.E_WAITING] == 0:
        m[thread + at.T_STEP] = at.GATE_PAUSED
        sleep(m, thread, now + m[gate + at.G_PAUSE])
        return True
    return _released(m, thread)


@compiled()
def _hold(m, thread):
    gate, now = m[m[thread + at.T_ENTITY] + at.E_BODY_ROW], m[at.X_NOW]
    decide(m, gate, m[thread + at.T_CAME], m[thread + at.T_ORIGIN])
    m[thread + at.T_BEGAN] = now
    if m[gate + at.G_AT] == at.NONE:
        return _released(m, thread)
    m[thread + at.T_STEP], m[thread + at.T_BEGAN] = at.GATE_WAKE, at.NONE
    if m[gate + at.G_AT] - m[gate + at.G_SPIN] > now:
        sleep(m, thread, m[gate + at.G_AT] - m[gate + at.G_SPIN])
    return True


@compiled()
def _look(m, entity, gate):
    """What has come meanwhile may leave for the one at the gate, or leave no room for it."""
    if m[entity + at.E_WAITING] == m[entity + at.E_DEPTH]:
        drop(m, gate, at.OVERFLOWED)
        return
    for number in range(m[entity + at.E_WAITING]):
        place = (m[entity + at.E_HEAD] + number) % m[entity + at.E_DEPTH]
        message = m[m[entity + at.E_HISTORY] + place]
        if replaces(m, gate, m[message + at.M_ARRIVAL], m[message + at.M_ORIGIN]):
            drop(m, gate, at.REPLACED)
            return


@compiled()
def _released(m, thread):
    entity = m[thread + at.T_ENTITY]
    gate = m[entity + at.E_BODY_ROW]
    m[gate + at.G_FREE] = m[at.X_NOW]
    place = begin_entry(m, at.L_RELEASE, m[thread + at.T_BEGAN], thread)
    if place != at.NONE:
        stride = m[m[at.X_LOGS] + at.L_RELEASE * at.LOG_COLUMNS + at.A_STRIDE]
        m[place + 2 * stride] = m[entity + at.E_ROW]
        m[place + 3 * stride] = m[thread + at.T_SOURCE]
        for field in range(at.G_OTHER - at.G_ARRIVAL):
            m[place + (4 + field) * stride] = m[gate + at.G_ARRIVAL + field]
    return _end(m, thread)


@compiled()
def _complete(m, thread):
    """Add the message to its synchroniser's input; true if that completes a set.

    The oldest message of every input makes a set. Its stamp is that of the first input.
    """
    entity = m[thread + at.T_ENTITY]
    synchroniser = m[entity + at.E_BODY_ROW]
    first, end = m[synchroniser + at.S_FIRST], m[synchroniser + at.S_END]
    mine = first + m[entity + at.E_INPUT] * at.INPUT_COLUMNS
    message = new_message(m)
    m[message + at.M_ORIGIN] = m[thread + at.T_ORIGIN]
    m[message + at.M_START] = m[thread + at.T_START]
    m[message + at.M_NUMBER] = m[thread + at.T_NUMBER]
    put_newest(m, mine + at.I_RING, message)
    for source in range(first, end, at.INPUT_COLUMNS):
        if m[source + at.I_WAITING] == 0:
            return False
    m[thread + at.T_START] = at.NONE
    for source in range(first, end, at.INPUT_COLUMNS):
        message = take_oldest(m, source + at.I_RING)
        if source == first:
            m[thread + at.T_ORIGIN] = m[message + at.M_ORIGIN]
        if m[source + at.I_ON_CHAIN] == 1:
            m[thread + at.T_START] = m[message + at.M_START]
            m[thread + at.T_NUMBER] = m[message + at.M_NUMBER]
        free_message(m, message)
    return True


@compiled()
def _end(m, thread):
    log(m, at.L_END, thread, (m[m[thread + at.T_ENTITY] + at.E_ROW], m[thread + at.T_USED]))
    return False
