"""What happens in the compiled engine: queues, how messages travel, and what callbacks do.

Everything is of a fixed size. Where something runs short, `X.PAUSED` says what, and the engine is
left at the next safe place; limits leave enough in reserve for what happens until then.

A publication reaches every reader of its topic after a delay, in order (DDS delivers the messages
of one writer in order). Optionally a DDS thread of the subscriber's process works for it first.
A history has the last ``depth`` messages: a newer one overwrites the oldest. An asynchronous
publisher hands its message to the publisher thread of its process, whose history has those that
are not sent yet; see :mod:`chainshaper.workload.executor`.

A callback has started when :func:`begin_body` is called. Its functions leave in its thread's row
how much CPU time it needs next and what follows (`T.LEFT`, `T.STEP`), or let the thread wait.

The gate's decisions are `Queue` of :mod:`chainshaper.gate.decision` once more, because the engine
cannot call Python; tests hold the two against each other, on random gates and messages and on
`tests/gate_conformance.yaml`.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.gate.decision import CHANGES, MAX_AGE_CYCLES, MAX_FUTURE_NS
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, A, C, D, E, G, H, I, M, P, Q, R, S, T, X
from chainshaper.values.compiled.memory import compiled


@compiled()
def draw(m, stream):
    """The next value of a stream."""
    constant = m[stream + D.CONSTANT]
    if constant != NONE:
        return constant
    place = m[stream + D.NEXT]
    m[stream + D.NEXT] = place + 1
    if place >= m[stream + D.LIMIT]:
        m[X.PAUSED] = at.MORE_DRAWS
    return m[place]


@compiled()
def log(m, kind, time, thread, fields):
    """An entry of the log, if it is of the recorded time."""
    if m[X.LOGGING] == 0 or time < m[X.RECORD_FROM]:
        return
    area = m[X.LOGS] + kind * A.COLUMNS
    count, stride = m[area + A.COUNT], m[area + A.STRIDE]
    m[area + A.COUNT] = count + 1
    if count + at.RESERVE >= stride:
        m[X.PAUSED] = at.LOG_FULL
    place = m[area + A.FIRST] + count
    m[place] = time
    m[place + stride] = NONE if thread == NONE else m[thread + T.ROW]
    for field in range(len(fields)):
        m[place + (2 + field) * stride] = fields[field]


@compiled()
def push_event(m, time, kind, row):
    """Something will happen; of what happens at one time, the first pushed comes first."""
    place = m[X.HEAP_END]
    m[X.HEAP_END] = place + H.COLUMNS
    order = m[X.COUNTER]
    m[X.COUNTER] = order + 1
    heap = m[X.HEAP]
    while place > heap:
        above = heap + (((place - heap) // H.COLUMNS - 1) >> 1) * H.COLUMNS
        if m[above + H.TIME] <= time:
            break
        _move(m, above, place)
        place = above
    m[place + H.TIME] = time
    m[place + H.ORDER] = order
    m[place + H.KIND] = kind
    m[place + H.ROW] = row
    if m[X.HEAP_END] >= m[X.HEAP_LIMIT]:
        m[X.PAUSED] = at.MESSAGES_FULL


@compiled()
def pop_event(m):
    """Kind and row of the next event."""
    heap = m[X.HEAP]
    kind, row = m[heap + H.KIND], m[heap + H.ROW]
    last = m[X.HEAP_END] - H.COLUMNS
    m[X.HEAP_END] = last
    place = heap
    while True:
        below = 2 * place - heap + H.COLUMNS
        if below >= last:
            break
        if below + H.COLUMNS < last and _earlier(m, below + H.COLUMNS, below):
            below += H.COLUMNS
        if _earlier(m, last, below):
            break
        _move(m, below, place)
        place = below
    _move(m, last, place)
    return kind, row


@compiled()
def _move(m, source, target):
    for column in range(H.COLUMNS):
        m[target + column] = m[source + column]


@compiled()
def _earlier(m, one, other):
    if m[one + H.TIME] != m[other + H.TIME]:
        return m[one + H.TIME] < m[other + H.TIME]
    return m[one + H.ORDER] < m[other + H.ORDER]


@compiled()
def new_message(m):
    """An unused row of the pool."""
    message = m[X.FREE]
    m[X.FREE] = m[message + M.NEXT]
    m[message + M.NEXT] = NONE
    m[X.UNUSED] -= 1
    if m[X.UNUSED] <= at.RESERVE:
        m[X.PAUSED] = at.MESSAGES_FULL
    return message


@compiled()
def free_message(m, message):
    """Give a row back to the pool."""
    m[message + M.NEXT] = m[X.FREE]
    m[X.FREE] = message
    m[X.UNUSED] += 1


@compiled()
def _copy(m, source, target):
    for field in range(M.PUBLISHER, M.ARRIVAL):
        m[target + field] = m[source + field]


@compiled()
def append(m, thread, message):
    """A message goes to the end of a thread's queue."""
    m[message + M.NEXT] = NONE
    if m[thread + T.HEAD] == NONE:
        m[thread + T.HEAD] = message
    else:
        m[m[thread + T.TAIL] + M.NEXT] = message
    m[thread + T.TAIL] = message


@compiled()
def pop_head(m, thread):
    """The first message of a thread's queue."""
    message = m[thread + T.HEAD]
    m[thread + T.HEAD] = m[message + M.NEXT]
    return message


@compiled()
def put_newest(m, ring, message):
    """A message goes to the end of a ring; the oldest one of a full ring is gone."""
    if m[ring + Q.WAITING] == m[ring + Q.DEPTH]:
        free_message(m, take_oldest(m, ring))
    place = (m[ring + Q.HEAD] + m[ring + Q.WAITING]) % m[ring + Q.DEPTH]
    m[m[ring + Q.PLACES] + place] = message
    m[ring + Q.WAITING] += 1


@compiled()
def take_oldest(m, ring):
    """The oldest message of a ring that is not empty, taken out."""
    message = m[m[ring + Q.PLACES] + m[ring + Q.HEAD]]
    m[ring + Q.HEAD] = (m[ring + Q.HEAD] + 1) % m[ring + Q.DEPTH]
    m[ring + Q.WAITING] -= 1
    return message


@compiled()
def drop_expired(m, entity):
    """Forget messages that have waited in a history for longer than their lifespan."""
    lifespan = m[entity + E.LIFESPAN]
    while lifespan != NONE and m[entity + E.WAITING] > 0:
        message = m[m[entity + E.HISTORY] + m[entity + E.HEAD]]
        if m[X.NOW] - m[message + M.ARRIVAL] <= lifespan:
            return
        free_message(m, take_oldest(m, entity + E.HISTORY))


ADDRESSES = 64
"""Addresses of messages repeat, as they do in a real process."""

FIRST_ADDRESS, APART = 0x7F00_0000_0000, 0x480


@compiled()
def wake(m, thread):
    """A thread that waits becomes runnable, at the end of the queue of its rank."""
    m[thread + T.RUNNABLE] = 1
    m[thread + T.LEFT] += draw(m, m[thread + T.WAKE])
    m[thread + T.SEQUENCE] = m[X.COUNTER]
    m[X.COUNTER] += 1
    m[m[thread + T.CORE] + C.DIRTY] = 1


@compiled()
def wake_waiting(m, thread, step):
    """Wake a thread if it waits, with that step as its next one."""
    if m[thread + T.RUNNABLE] == 0 and m[thread + T.STEP] == step:
        wake(m, thread)


@compiled()
def wake_executor(m, thread):
    """Something may be ready for a thread's executor: wake the thread that waits for it."""
    owner = m[m[thread + T.POOL] + T.OWNER]
    if owner != NONE:
        wake_waiting(m, owner, at.COLLECT)


@compiled()
def may_run(m, entity):
    """Whether no other callback of its mutually exclusive group runs."""
    return m[entity + E.GROUP] == NONE or m[m[entity + E.GROUP]] == 0


@compiled()
def publish(m, thread, publisher):
    """The executor publishes: what it passes on stands in its thread's row."""
    now, published = m[X.NOW], m[publisher + P.PUBLISHED]
    m[publisher + P.PUBLISHED] += 1
    address = FIRST_ADDRESS + (m[publisher + P.ROW] * ADDRESSES + published % ADDRESSES) * APART
    log(m, at.L_PUBLISH, now, thread, (m[publisher + P.ROW], address))
    message = new_message(m)
    for field in range(M.COLUMNS - M.SOURCE):
        m[message + M.SOURCE + field] = m[thread + T.SOURCE + field]
    m[message + M.PUBLISHER], m[message + M.ADDRESS] = publisher, address
    m[message + M.SOURCE], m[message + M.MODE] = now, NONE
    modes = m[publisher + P.MODES_COUNT]
    if modes > 0:
        m[message + M.MODE] = m[m[publisher + P.MODES] + published % modes]
    if m[publisher + P.ASYNCHRONOUS] == 1:
        _hand_over(m, m[thread + T.PUBLISHER_THREAD], message)
    else:
        send(m, thread, message)


@compiled()
def _hand_over(m, thread, message):
    """Put a message into its asynchronous writer's history, which has the last ones."""
    publisher = m[message + M.PUBLISHER]
    if m[publisher + P.UNSENT] < m[publisher + P.DEPTH]:
        m[publisher + P.UNSENT] += 1
        append(m, thread, message)
    else:
        # All of this writer's move up by one place; the oldest one's is gone.
        place = m[thread + T.HEAD]
        while m[place + M.PUBLISHER] != publisher:
            place = m[place + M.NEXT]
        lost = (m[publisher + P.ROW], m[place + M.SOURCE], at.OVERWRITTEN, 0)
        log(m, at.L_SEND, m[X.NOW], thread, lost)
        following = m[place + M.NEXT]
        while following != NONE:
            if m[following + M.PUBLISHER] == publisher:
                _copy(m, following, place)
                place = following
            following = m[following + M.NEXT]
        _copy(m, message, place)
        free_message(m, message)
    wake_waiting(m, thread, at.SEND)


@compiled()
def send(m, thread, message):
    """A message leaves now, sent by a thread; it is free afterwards, readers get copies."""
    publisher, now = m[message + M.PUBLISHER], m[X.NOW]
    if m[publisher + P.ENDS_CHAIN] == 1 and m[message + M.START] != NONE:
        noted = m[X.LATENCIES] + m[message + M.NUMBER]
        if noted < m[X.LATENCIES_END] and m[noted] == NONE:
            m[noted] = now - m[message + M.START]
    for reader in range(m[publisher + P.FIRST], m[publisher + P.END], R.COLUMNS):
        copy = new_message(m)
        _copy(m, message, copy)
        m[copy + M.ENTITY] = m[reader + R.ENTITY]
        arrival = max(now + draw(m, m[thread + T.DELIVERY]), m[reader + R.LAST])
        m[reader + R.LAST] = arrival
        if arrival == now:
            deliver(m, copy)
        else:
            push_event(m, arrival, at.DELIVERY, copy)
    free_message(m, message)


@compiled()
def deliver(m, message):
    """A message reaches its reader's process, where a DDS thread may have to work for it."""
    receiver = m[m[m[message + M.ENTITY] + E.THREAD] + T.DDS_THREAD]
    if receiver == NONE:
        arrive(m, message)
        return
    append(m, receiver, message)
    wake_waiting(m, receiver, at.RECEIVE)


@compiled()
def arrive(m, message):
    """A message enters its reader's history, and wakes the executor if it waits for work."""
    entity, now = m[message + M.ENTITY], m[X.NOW]
    m[message + M.ARRIVAL] = now
    thread = m[entity + E.THREAD]
    overwrites = m[entity + E.WAITING] == m[entity + E.DEPTH]
    if overwrites and m[entity + E.BODY] == at.GATE:
        oldest = m[m[entity + E.HISTORY] + m[entity + E.HEAD]]
        about = (m[entity + E.ROW], m[oldest + M.SOURCE], m[oldest + M.ARRIVAL])
        anchor = 1 - m[m[entity + E.BODY_ROW] + G.STAMPED]
        never = (m[oldest + M.ORIGIN], NONE, NONE, 0, anchor, NONE, NONE, at.OVERFLOWED, 0)
        log(m, at.L_RELEASE, now, thread, (*about, *never))
    put_newest(m, entity + E.HISTORY, message)
    # The event of the message that was overwritten is still in the queue, for this one to use.
    if m[thread + T.KIND] == at.EVENTS and not overwrites:
        mark_event(m, thread, entity)
    if may_run(m, entity):
        wake_executor(m, thread)


@compiled()
def mark_event(m, thread, entity):
    """An entity of an events executor has something to execute: to the end of its queue."""
    event = new_message(m)
    m[event + M.ENTITY] = entity
    append(m, thread, event)


@compiled()
def begin_body(m, thread):
    """Begin the callback of the thread's entity; false if it has ended already."""
    entity = m[thread + T.ENTITY]
    body = m[entity + E.BODY]
    m[thread + T.PUBLICATION] = m[entity + E.PUBLISHERS]
    m[thread + T.STEP] = at.PUBLISH
    if body == at.GATE:
        return _enter_gate(m, thread)
    if body == at.MODE_LISTENER:
        switch_mode(m, m[entity + E.BODY_ROW], m[thread + T.MODE])
        return _end(m, thread)
    if body == at.SYNCHRONISE and not _complete(m, thread):
        return _end(m, thread)
    execution = draw(m, m[entity + E.EXECUTION])
    m[thread + T.LEFT] = execution + execution * m[X.AWAY] // 1_000_000
    return True


@compiled()
def go_on_publishing(m, thread):
    """Publish on the next topic; false if all have been served and the callback has ended."""
    publisher = m[thread + T.PUBLICATION]
    if publisher == m[m[thread + T.ENTITY] + E.PUBLISHERS_END]:
        return _end(m, thread)
    m[thread + T.PUBLICATION] += P.COLUMNS
    publish(m, thread, publisher)
    m[thread + T.LEFT] = draw(m, m[thread + T.PUBLISH])
    return True


@compiled()
def _end(m, thread):
    ended = (m[m[thread + T.ENTITY] + E.ROW], m[thread + T.USED])
    log(m, at.L_END, m[X.NOW], thread, ended)
    return False


@compiled()
def _complete(m, thread):
    """Add the message to its synchroniser's input; true if that completes a set.

    The oldest message of every input makes a set. Its stamp is that of the first input.
    """
    entity = m[thread + T.ENTITY]
    synchroniser = m[entity + E.BODY_ROW]
    first, end = m[synchroniser + S.FIRST], m[synchroniser + S.END]
    mine = first + m[entity + E.INPUT] * I.COLUMNS
    message = new_message(m)
    for field in range(M.COLUMNS - M.SOURCE):
        m[message + M.SOURCE + field] = m[thread + T.SOURCE + field]
    put_newest(m, mine + I.RING, message)
    for source in range(first, end, I.COLUMNS):
        if m[source + I.WAITING] == 0:
            return False
    m[thread + T.START] = NONE
    for source in range(first, end, I.COLUMNS):
        message = take_oldest(m, source + I.RING)
        if source == first:
            m[thread + T.ORIGIN] = m[message + M.ORIGIN]
        if m[source + I.ON_CHAIN] == 1:
            m[thread + T.START] = m[message + M.START]
            m[thread + T.NUMBER] = m[message + M.NUMBER]
        free_message(m, message)
    return True


@compiled()
def _sleep(m, thread, until):
    """A thread waits for an instant, whatever else happens."""
    m[thread + T.RUNNABLE] = 0
    m[m[thread + T.CORE] + C.DIRTY] = 1
    push_event(m, until, at.SLEEP_OVER, thread)


@compiled()
def _enter_gate(m, thread):
    gate, now = m[m[thread + T.ENTITY] + E.BODY_ROW], m[X.NOW]
    # A gate at rest knows of a message when it has taken it.
    arrival = now if m[thread + T.ARRIVAL] >= m[gate + G.FREE] else m[thread + T.ARRIVAL]
    decide(m, gate, arrival, m[thread + T.ORIGIN])
    m[thread + T.BEGAN] = now
    if m[gate + G.AT] == NONE:
        return _leave_gate(m, thread)
    m[thread + T.STEP], m[thread + T.BEGAN] = at.GATE_WAKE, NONE
    if m[gate + G.AT] - m[gate + G.SPIN] > now:
        _sleep(m, thread, m[gate + G.AT] - m[gate + G.SPIN])
    return True


@compiled()
def pass_gate(m, thread):
    """A thread of a gate goes on: awake, watching the clock, having published or paused.

    False if the callback has ended.
    """
    entity, now = m[thread + T.ENTITY], m[X.NOW]
    gate = m[entity + E.BODY_ROW]
    if m[thread + T.STEP] == at.GATE_WAKE:
        if m[thread + T.BEGAN] == NONE:  # it has just woken
            m[thread + T.BEGAN] = now
            _look(m, entity, gate)
            if m[gate + G.AT] == NONE:
                return _leave_gate(m, thread)
        if now < m[gate + G.AT]:
            m[thread + T.LEFT] = m[gate + G.AT] - now  # watching the clock
            return True
        m[thread + T.BEGAN] = now
        if missed_slot(m, gate):
            drop(m, gate, at.DISCARDED)
            m[gate + G.TREATED] = at.DISCARD
            return _leave_gate(m, thread)
        if m[gate + G.SLOT] != NONE:
            m[gate + G.LEFT] = m[gate + G.LEAVING]
        m[thread + T.STEP] = at.GATE_PUBLISHED
        publish(m, thread, m[entity + E.PUBLISHERS])
        m[thread + T.LEFT] = draw(m, m[thread + T.PUBLISH])
        return True
    # Another message that waits already must not become late by the pause.
    published = m[thread + T.STEP] == at.GATE_PUBLISHED
    if published and m[gate + G.PAUSE] > 0 and m[entity + E.WAITING] == 0:
        m[thread + T.STEP] = at.GATE_PAUSED
        _sleep(m, thread, now + m[gate + G.PAUSE])
        return True
    return _leave_gate(m, thread)


@compiled()
def _look(m, entity, gate):
    """What has come meanwhile may leave for the one at the gate, or leave no room for it."""
    if m[entity + E.WAITING] == m[entity + E.DEPTH]:
        drop(m, gate, at.OVERFLOWED)
        return
    for number in range(m[entity + E.WAITING]):
        place = (m[entity + E.HEAD] + number) % m[entity + E.DEPTH]
        message = m[m[entity + E.HISTORY] + place]
        if _replaces(m, gate, m[message + M.ARRIVAL], m[message + M.ORIGIN]):
            drop(m, gate, at.REPLACED)
            return


@compiled()
def _leave_gate(m, thread):
    entity = m[thread + T.ENTITY]
    gate = m[entity + E.BODY_ROW]
    m[gate + G.FREE] = m[X.NOW]
    about = (m[entity + E.ROW], m[thread + T.SOURCE], m[gate + G.ARRIVAL])
    leaves = (m[gate + G.ORIGIN], m[gate + G.AT], m[gate + G.SLOT], m[gate + G.CYCLES])
    why = (1 - m[gate + G.BY_STAMP], m[gate + G.TREATED], m[gate + G.MODE], m[gate + G.DROPPED])
    row = (*about, *leaves, *why, m[gate + G.MOVED])
    log(m, at.L_RELEASE, m[thread + T.BEGAN], thread, row)
    return _end(m, thread)


@compiled()
def decide(m, gate, arrival, stamp):
    """When the message whose turn it is may leave, and why, as `Queue.decide`."""
    ready = max(arrival, m[gate + G.FREE])
    _release(m, gate, gate, arrival, stamp, ready)
    if m[gate + G.BY_STAMP] == 1:
        m[gate + G.PHASE] = m[gate + G.ORIGIN] % m[gate + G.CYCLE]
    in_order = m[gate + G.MESSAGES] == at.ALL_IN_ORDER
    if m[gate + G.AT] == NONE or m[gate + G.SLOT] == NONE or in_order:
        return
    left = m[gate + G.LEFT]
    if left != NONE and _same_cycle(m, gate, _start(m, gate, gate), left):
        if m[gate + G.MESSAGES] == at.FIRST:
            drop(m, gate, at.SURPLUS)
            return
        last_end = m[m[gate + G.SLOTS_END] - 1] + _moved_at(m, gate, left)
        _release(m, gate, gate, arrival, stamp, max(ready, left + last_end))
        if m[gate + G.AT] == NONE:
            return
        if m[gate + G.SLOT] == NONE:
            m[gate + G.AT] = ready
            return
    start, leaving = _start(m, gate, gate), m[gate + G.LEAVING]
    if leaving == NONE or not _same_cycle(m, gate, start, leaving):
        m[gate + G.LEAVING] = start


@compiled()
def drop(m, gate, why):
    """The message never leaves."""
    m[gate + G.AT] = m[gate + G.SLOT] = NONE
    m[gate + G.DROPPED] = why


@compiled()
def _replaces(m, gate, arrival, stamp):
    """Whether a message that waits would leave for the one at the gate, as `Queue.replaced`."""
    if m[gate + G.MESSAGES] != at.NEWEST or m[gate + G.SLOT] == NONE:
        return False
    other = gate + G.OTHER - G.ARRIVAL
    _release(m, gate, other, arrival, stamp, m[X.NOW])
    if m[other + G.SLOT] == NONE or m[gate + G.LEAVING] == NONE:
        return False
    return _same_cycle(m, gate, _start(m, gate, other), m[gate + G.LEAVING])


@compiled()
def _start(m, gate, row):
    return m[row + G.ORIGIN] + m[row + G.CYCLES] * m[gate + G.CYCLE]


@compiled()
def _same_cycle(m, gate, start, other):
    return 2 * abs(start - other) < m[gate + G.CYCLE]


@compiled()
def _release(m, gate, row, arrival, stamp, ready):  # noqa: PLR0917 - as `release_of`
    """What `release_of` decides, into the fields from G.ARRIVAL on, counted from ``row``."""
    age = arrival - stamp
    cycle_ns = m[gate + G.CYCLE]
    due = m[gate + G.DUE]
    max_age = (MAX_AGE_CYCLES + due) * cycle_ns
    stamped = m[gate + G.STAMPED] == 1 and age >= -MAX_FUTURE_NS and age <= max_age
    origin = stamp if stamped else arrival - (arrival - m[gate + G.PHASE]) % cycle_ns
    if not stamped:
        due = min(due, 1)
    mode = _mode_at(m, gate, origin)
    first, last, policy = _open_to(m, gate, mode)
    ready = max(arrival, ready)
    cycle = max(0, (ready - origin) // cycle_ns)
    due_from = origin + due * cycle_ns
    m[row + G.MOVED] = _moved_at(m, gate, due_from)
    due_from += m[row + G.MOVED]
    overran = not _lets_out(m, gate, last - 2, due_from, arrival, ready)
    m[row + G.ARRIVAL], m[row + G.ORIGIN], m[row + G.MODE] = arrival, origin, mode
    m[row + G.BY_STAMP], m[row + G.TREATED] = stamped, NONE
    m[row + G.SLOT], m[row + G.CYCLES], m[row + G.DROPPED] = NONE, cycle, NONE
    if overran and policy != at.WAIT:
        m[row + G.TREATED], m[row + G.AT] = policy, ready
        if policy != at.PUBLISH_LATE:
            m[row + G.AT], m[row + G.DROPPED] = NONE, at.DISCARDED
        return
    if overran:
        m[row + G.TREATED] = at.WAIT
    elif mode != NONE and not _lets_out(m, gate, first, due_from, arrival, ready):
        m[row + G.TREATED] = at.NEXT_SLOT
    m[row + G.CYCLES] = max(due, cycle)
    while True:
        start = origin + m[row + G.CYCLES] * cycle_ns
        m[row + G.MOVED] = _moved_at(m, gate, start)
        start += m[row + G.MOVED]
        for slot in range(first, last, 2):
            if _lets_out(m, gate, slot, start, arrival, ready):
                m[row + G.AT] = max(ready, start + m[slot])
                m[row + G.SLOT] = (slot - m[gate + G.SLOTS]) // 2
                return
        m[row + G.CYCLES] += 1


@compiled()
def _lets_out(m, gate, slot, start, arrival, ready):  # noqa: PLR0917 - as `Gate.lets_out`
    in_time = m[gate + G.AT_ONCE] == 1 or arrival <= start + m[slot]
    return in_time and ready < start + m[slot + 1]


@compiled()
def missed_slot(m, gate):
    """Whether the message has to be discarded because its slot is over by now."""
    _, _, policy = _open_to(m, gate, m[gate + G.MODE])
    slot = m[gate + G.SLOT]
    if policy != at.DISCARD or slot == NONE:
        return False
    end = m[m[gate + G.SLOTS] + 2 * slot + 1] + m[gate + G.MOVED]
    return m[X.NOW] >= _start(m, gate, gate) + end


@compiled()
def switch_mode(m, gate, mode):
    """A mode is announced; one that the gate does not know, or has already, changes nothing."""
    if mode == NONE or m[m[gate + G.BANDS] + mode] == NONE:
        return
    count, changes = m[gate + G.CHANGED], m[gate + G.CHANGES]
    current = m[gate + G.DEFAULT]
    if count:
        current = m[changes + 2 * ((count - 1) % CHANGES) + 1]
    if mode != current:
        place = changes + 2 * (count % CHANGES)
        m[place], m[place + 1] = m[X.NOW], mode
        m[gate + G.CHANGED] = count + 1


@compiled()
def _moved_at(m, gate, cycle_start):
    moved = 0
    for move in range(m[gate + G.MOVES], m[gate + G.MOVES_END], 2):
        if m[move] <= cycle_start:
            moved = m[move + 1]
    return moved


@compiled()
def _mode_at(m, gate, origin):
    mode = m[gate + G.DEFAULT]
    if mode == NONE:
        return mode
    count, changes = m[gate + G.CHANGED], m[gate + G.CHANGES]
    for number in range(count - 1, max(-1, count - 1 - CHANGES), -1):
        place = changes + 2 * (number % CHANGES)
        if m[place] <= origin:
            return m[place + 1]
    return mode


@compiled()
def _open_to(m, gate, mode):
    """Where the slots open to a mode begin and end, and what is done behind them."""
    first, last = m[gate + G.SLOTS], m[gate + G.SLOTS_END]
    if mode == NONE:
        return first, last, m[gate + G.OVERRUN]
    band = first + 2 * m[m[gate + G.BANDS] + mode]
    if m[gate + G.LATE] == at.NEXT_SLOT:
        return band, last, m[gate + G.OVERRUN]
    return band, band + 2, m[gate + G.LATE]
