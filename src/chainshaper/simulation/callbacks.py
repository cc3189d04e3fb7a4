"""What happens in the compiled engine: queues, how messages travel, and what callbacks do.

Everything is of a fixed size. Where something runs short, `X.PAUSED` says what, and the engine is
left at the next safe place; limits leave enough in reserve for what happens until then.

A publication reaches every reader of its topic after a delay, in order (DDS delivers the messages
of one writer in order), where a DDS thread of the reader's process may have to work for it first.
An asynchronous publisher hands it to the publisher thread of its process before; see
:mod:`chainshaper.workload.executor`.

Functions of callbacks leave in their thread's row how much CPU time it needs next and what follows
(`T.LEFT`, `T.STEP`), or let the thread wait; they return whether the callback goes on.

The gate's decisions are `Queue` of :mod:`chainshaper.gate.decision` once more, because the engine
cannot call Python; tests hold the two against each other.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.gate.decision import CHANGES, MAX_AGE_CYCLES, MAX_FUTURE_NS
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, C, D, E, G, H, I, M, P, Q, R, T, X
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
    rows, count = m[X.LOG_ROWS], m[m[X.LOGGED] + kind]
    m[m[X.LOGGED] + kind] = count + 1
    if count + at.RESERVE >= rows:
        m[X.PAUSED] = at.LOG_FULL
    place = m[X.LOG] + kind * at.LOG_COLUMNS * rows + count
    m[place] = time
    m[place + rows] = NONE if thread == NONE else m[thread + T.ROW]
    for field in range(len(fields)):
        m[place + (2 + field) * rows] = fields[field]


@compiled(inline=True)
def copy(m, source, target, count):
    """Some columns, from one place to another."""
    for column in range(count):
        m[target + column] = m[source + column]


@compiled()
def push_event(m, time, kind, row):
    """Something will happen; of what happens at one time, the first pushed comes first."""
    place = m[X.EVENTS_END]
    m[X.EVENTS_END] += H.COLUMNS
    while place > m[X.EVENTS] and m[place - H.COLUMNS + H.TIME] <= time:
        copy(m, place - H.COLUMNS, place, H.COLUMNS)
        place -= H.COLUMNS
    m[place + H.TIME], m[place + H.KIND], m[place + H.ROW] = time, kind, row
    if m[X.EVENTS_END] >= m[X.EVENTS_LIMIT]:
        m[X.PAUSED] = at.MESSAGES_FULL


@compiled()
def new_message(m):
    """An unused row of the pool."""
    message = m[X.FREE]
    m[X.FREE] = m[message + M.NEXT]
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
def append(m, queue, message):
    """A message goes to the end of a queue."""
    if m[queue + Q.WAITING] == 0:
        m[queue + Q.HEAD] = message
    else:
        m[m[queue + Q.TAIL] + M.NEXT] = message
    m[queue + Q.TAIL] = message
    m[queue + Q.WAITING] += 1


@compiled()
def take_oldest(m, queue):
    """The first message of a queue that is not empty, taken out."""
    message = m[queue + Q.HEAD]
    m[queue + Q.HEAD] = m[message + M.NEXT]
    m[queue + Q.WAITING] -= 1
    return message


@compiled()
def put_newest(m, queue, message):
    """A message goes to the end of a queue; the oldest one of a full queue is gone."""
    if m[queue + Q.WAITING] == m[queue + Q.DEPTH]:
        free_message(m, take_oldest(m, queue))
    append(m, queue, message)


@compiled()
def mark_event(m, thread, row):
    """A thread has something to do for an entity or a publisher: to the end of its queue."""
    event = new_message(m)
    m[event + M.ENTITY] = row
    append(m, thread + T.HEAD, event)


@compiled()
def next_event(m, thread):
    """The row that the first mark in a thread's queue is for."""
    event = take_oldest(m, thread + T.HEAD)
    free_message(m, event)
    return m[event + M.ENTITY]


@compiled()
def drop_expired(m, entity):
    """Forget messages that have waited in a history for longer than their lifespan."""
    lifespan = m[entity + E.LIFESPAN]
    while lifespan != NONE and m[entity + E.WAITING] > 0:
        if m[X.NOW] - m[m[entity + E.HEAD] + M.ARRIVAL] <= lifespan:
            return
        free_message(m, take_oldest(m, entity + E.HEAD))


ADDRESSES = 64
"""Addresses of messages repeat, as they do in a real process."""

FIRST_ADDRESS, APART = 0x7F00_0000_0000, 0x480


@compiled()
def wait(m, thread):
    """A thread has nothing to do."""
    m[thread + T.RUNNABLE] = 0
    m[m[thread + T.CORE] + C.DIRTY] = 1


@compiled()
def wake(m, thread, step):
    """A thread that waits with that step as its next one becomes runnable, last of its rank."""
    if m[thread + T.RUNNABLE] == 0 and m[thread + T.STEP] == step:
        m[thread + T.RUNNABLE] = 1
        m[thread + T.LEFT] += draw(m, m[thread + T.WAKE])
        queue_up(m, thread)
        m[m[thread + T.CORE] + C.DIRTY] = 1


@compiled()
def queue_up(m, thread):
    """A thread goes behind all others of its rank."""
    m[thread + T.SEQUENCE] = m[X.COUNTER]
    m[X.COUNTER] += 1


@compiled()
def wake_executor(m, thread):
    """Something may be ready for a thread's executor: wake the thread that waits for it."""
    owner = m[m[thread + T.POOL] + T.OWNER]
    if owner != NONE:
        wake(m, owner, at.COLLECT)


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
    handles = (m[publisher + P.HANDLE], m[publisher + P.RMW_HANDLE])
    log(m, at.L_PUBLISH, now, thread, (*handles, address, now))
    message = new_message(m)
    copy(m, thread + T.SOURCE, message + M.SOURCE, at.CARRIED)
    m[message + M.PUBLISHER], m[message + M.ADDRESS] = publisher, address
    m[message + M.SOURCE], m[message + M.MODE] = now, NONE
    modes = m[publisher + P.MODES_COUNT]
    if modes > 0:
        m[message + M.MODE] = m[m[publisher + P.MODES] + published % modes]
    if m[publisher + P.ASYNCHRONOUS] == 0:
        send(m, thread, message)
        return
    sender = m[thread + T.PUBLISHER_THREAD]
    if m[publisher + P.WAITING] < m[publisher + P.DEPTH]:
        mark_event(m, sender, publisher)
    else:  # the newer ones move up by one place
        source = m[m[publisher + P.HEAD] + M.SOURCE]
        log(m, at.L_SEND, now, sender, (m[publisher + P.RMW_HANDLE], source, at.OVERWRITTEN, 0))
    put_newest(m, publisher + P.HEAD, message)
    wake(m, sender, at.SEND)


@compiled()
def send(m, thread, message):
    """A message leaves now, sent by a thread; it is free afterwards, readers get copies."""
    publisher, now = m[message + M.PUBLISHER], m[X.NOW]
    if m[publisher + P.ENDS_CHAIN] == 1 and m[message + M.START] != NONE:
        noted = m[X.LATENCIES] + m[message + M.NUMBER]
        if noted < m[X.LATENCIES_END] and m[noted] == NONE:
            m[noted] = now - m[message + M.START]
    for reader in range(m[publisher + P.FIRST], m[publisher + P.END], R.COLUMNS):
        own = new_message(m)
        copy(m, message + M.PUBLISHER, own + M.PUBLISHER, M.COLUMNS - M.PUBLISHER)
        m[own + M.ENTITY] = m[reader + R.ENTITY]
        delivery = m[reader + R.DELIVERY]
        if delivery == NONE:
            delivery = m[thread + T.DELIVERY]
        arrival = max(now + draw(m, delivery), m[reader + R.LAST])
        m[reader + R.LAST] = arrival
        if arrival == now:
            deliver(m, own)
        else:
            push_event(m, arrival, at.DELIVERY, own)
    free_message(m, message)


@compiled()
def deliver(m, message):
    """A message reaches its reader's process, where a DDS thread may have to work for it."""
    receiver = m[m[m[message + M.ENTITY] + E.THREAD] + T.DDS_THREAD]
    if receiver == NONE:
        arrive(m, message)
    else:
        append(m, receiver + T.HEAD, message)
        wake(m, receiver, at.RECEIVE)


@compiled()
def arrive(m, message):
    """A message enters its reader's history, and wakes the executor if it waits for work."""
    entity, now = m[message + M.ENTITY], m[X.NOW]
    m[message + M.ARRIVAL] = now
    thread = m[entity + E.THREAD]
    overwrites = m[entity + E.WAITING] == m[entity + E.DEPTH]
    if overwrites and m[entity + E.BODY] == at.GATE:
        oldest = m[entity + E.HEAD]
        about = (m[entity + E.CALLBACK], m[oldest + M.SOURCE], m[oldest + M.ARRIVAL])
        anchor = 1 - m[m[entity + E.BODY_ROW] + G.STAMPED]
        never = (m[oldest + M.ORIGIN], NONE, NONE, 0, anchor, NONE, NONE, at.OVERFLOWED, 0)
        log(m, at.L_RELEASE, now, thread, (*about, *never))
    put_newest(m, entity + E.HEAD, message)
    # The event of the message that was overwritten is still in the queue, for this one to use.
    if m[thread + T.KIND] == at.EVENTS and not overwrites:
        mark_event(m, thread, entity)
    if may_run(m, entity):
        wake_executor(m, thread)


@compiled()
def begin_body(m, thread):
    """Begin the callback of the thread's entity."""
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
    """Publish on the next topic, or compute what comes behind them, or end the callback."""
    publisher, entity = m[thread + T.PUBLICATION], m[thread + T.ENTITY]
    if publisher == m[entity + E.PUBLISHERS_END] and m[entity + E.AFTERWARDS] != NONE:
        m[thread + T.PUBLICATION] += 1  # so that it ends when this is done
        afterwards = draw(m, m[entity + E.AFTERWARDS])
        m[thread + T.LEFT] = afterwards + afterwards * m[X.AWAY] // 1_000_000
        return True
    if publisher >= m[entity + E.PUBLISHERS_END]:
        return _end(m, thread)
    m[thread + T.PUBLICATION] += P.COLUMNS
    publish(m, thread, publisher)
    m[thread + T.LEFT] = draw(m, m[thread + T.PUBLISH])
    return True


@compiled()
def _end(m, thread):
    ended = (m[m[thread + T.ENTITY] + E.CALLBACK], m[thread + T.USED])
    log(m, at.L_END, m[X.NOW], thread, ended)
    return False


@compiled()
def _complete(m, thread):
    """Add the message to its synchroniser's input; whether that completes a set.

    It has the oldest message of every input, and the stamp of the first one's; where one input
    triggers, the newest of the others, which stay for its next message.
    """
    entity = m[thread + T.ENTITY]
    first = m[entity + E.BODY_ROW]
    end = m[first + I.END]
    mine = first + m[entity + E.INPUT] * I.COLUMNS
    message = new_message(m)
    copy(m, thread + T.SOURCE, message + M.SOURCE, at.CARRIED)
    put_newest(m, mine + I.HEAD, message)
    trigger = m[first + I.TRIGGER]
    if trigger not in (NONE, mine):
        return False
    for source in range(first, end, I.COLUMNS):
        if m[source + I.WAITING] == 0:
            if trigger == mine:
                free_message(m, take_oldest(m, mine + I.HEAD))
            return False
    m[thread + T.START] = NONE
    for source in range(first, end, I.COLUMNS):
        message = take_oldest(m, source + I.HEAD)
        if trigger not in (NONE, source):
            kept = new_message(m)
            copy(m, message + M.SOURCE, kept + M.SOURCE, at.CARRIED)
            put_newest(m, source + I.HEAD, kept)
        if source == first:
            m[thread + T.ORIGIN] = m[message + M.ORIGIN]
        if m[source + I.ON_CHAIN] == 1:
            m[thread + T.START] = m[message + M.START]
            m[thread + T.NUMBER] = m[message + M.NUMBER]
        free_message(m, message)
    return True


@compiled()
def _sleep(m, thread, until):
    wait(m, thread)
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
    """A thread of a gate goes on: awake, watching the clock, having published or paused."""
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
    message = m[entity + E.HEAD]
    for _ in range(m[entity + E.WAITING]):
        if _replaces(m, gate, m[message + M.ARRIVAL], m[message + M.ORIGIN]):
            drop(m, gate, at.REPLACED)
            return
        message = m[message + M.NEXT]


@compiled()
def _leave_gate(m, thread):
    entity = m[thread + T.ENTITY]
    gate = m[entity + E.BODY_ROW]
    m[gate + G.FREE] = m[X.NOW]
    about = (m[entity + E.CALLBACK], m[thread + T.SOURCE], m[gate + G.ARRIVAL])
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
    cycle = max(due, (ready - origin) // cycle_ns)
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
