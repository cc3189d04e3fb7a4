"""How messages travel: publication, delivery, the history of a subscription, waking who waits.

A publication reaches every reader of its topic after a delay, in order (DDS delivers the messages
of one writer in order). Optionally a DDS thread of the subscriber's process works for it first.
A history keeps the last ``depth`` messages: a newer one overwrites the oldest.

An asynchronous publisher hands its message to the publisher thread of its process. Its own
history keeps those that are not sent yet; see :mod:`chainshaper.workload.asynchronous`.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.layout import (
    C_DIRTY,
    COLLECT,
    DELIVERY,
    E_DEPTH,
    E_HEAD,
    E_RING,
    E_THREAD,
    E_WAITING,
    EVENTS,
    L_PUBLISH,
    L_SEND,
    M_ADDRESS,
    M_ARRIVAL,
    M_ENTITY,
    M_MODE,
    M_NEXT,
    M_NUMBER,
    M_ORIGIN,
    M_PUBLISHER,
    M_SOURCE,
    M_START,
    NONE,
    OVERWRITTEN,
    P_ASYNCHRONOUS,
    P_DEPTH,
    P_END,
    P_ENDS_CHAIN,
    P_FIRST,
    P_HELD,
    P_MODES,
    P_MODES_COUNT,
    P_PUBLISHED,
    P_ROW,
    R_ENTITY,
    R_LAST,
    READER_COLUMNS,
    RECEIVE,
    SEND,
    T_CORE,
    T_DDS_THREAD,
    T_DELIVERY,
    T_HEAD,
    T_KIND,
    T_LEFT,
    T_NUMBER,
    T_ORIGIN,
    T_PUBLISHER_THREAD,
    T_RUNNABLE,
    T_SEQUENCE,
    T_START,
    T_STEP,
    T_WAKE,
    X_COUNTER,
    X_LATENCIES,
    X_LATENCIES_END,
    X_NOW,
    X_WARM_UP,
)
from chainshaper.simulation.queues import (
    append,
    draw,
    free_message,
    log,
    new_message,
    oldest_message,
    push_event,
)

__all__ = ["arrive", "deliver", "mark_event", "publish", "send", "wake"]

ADDRESSES = 64
"""Addresses of messages repeat, as they do in a real process."""

FIRST_ADDRESS, APART = 0x7F00_0000_0000, 0x480


@compiled
def wake(m, thread):
    """A thread that waits becomes runnable, at the end of the queue of its rank."""
    m[thread + T_RUNNABLE] = 1
    m[thread + T_LEFT] += draw(m, m[thread + T_WAKE])
    m[thread + T_SEQUENCE] = m[X_COUNTER]
    m[X_COUNTER] += 1
    m[m[thread + T_CORE] + C_DIRTY] = 1


@compiled
def publish(m, thread, publisher):
    """The executor publishes: what it passes on stands in its thread's row."""
    now, published = m[X_NOW], m[publisher + P_PUBLISHED]
    m[publisher + P_PUBLISHED] += 1
    address = FIRST_ADDRESS + (m[publisher + P_ROW] * ADDRESSES + published % ADDRESSES) * APART
    log(m, L_PUBLISH, thread, (m[publisher + P_ROW], address))
    message = new_message(m)
    m[message + M_PUBLISHER], m[message + M_SOURCE] = publisher, now
    m[message + M_ADDRESS], m[message + M_ORIGIN] = address, m[thread + T_ORIGIN]
    m[message + M_START], m[message + M_NUMBER] = m[thread + T_START], m[thread + T_NUMBER]
    m[message + M_MODE] = NONE
    if m[publisher + P_MODES_COUNT] > 0:
        m[message + M_MODE] = m[m[publisher + P_MODES] + published % m[publisher + P_MODES_COUNT]]
    if m[publisher + P_ASYNCHRONOUS] == 1:
        _hand_over(m, m[thread + T_PUBLISHER_THREAD], message)
    else:
        send(m, thread, message)


@compiled
def send(m, thread, message):
    """A message leaves now, sent by a thread; it is free afterwards, readers get copies."""
    publisher, now = m[message + M_PUBLISHER], m[X_NOW]
    if m[publisher + P_ENDS_CHAIN] == 1 and m[message + M_START] != NONE:
        noted = m[X_LATENCIES] + m[message + M_NUMBER] - m[X_WARM_UP]
        if m[X_LATENCIES] <= noted < m[X_LATENCIES_END] and m[noted] == NONE:
            m[noted] = now - m[message + M_START]
    for reader in range(m[publisher + P_FIRST], m[publisher + P_END], READER_COLUMNS):
        copy = new_message(m)
        _copy(m, message, copy)
        m[copy + M_ENTITY] = m[reader + R_ENTITY]
        at = max(now + draw(m, m[thread + T_DELIVERY]), m[reader + R_LAST])
        m[reader + R_LAST] = at
        if at == now:
            deliver(m, copy)
        else:
            push_event(m, at, DELIVERY, copy)
    free_message(m, message)


@compiled
def deliver(m, message):
    """A message reaches its reader's process, where a DDS thread may have to work for it."""
    receiver = m[m[m[message + M_ENTITY] + E_THREAD] + T_DDS_THREAD]
    if receiver == NONE:
        arrive(m, message)
        return
    append(m, receiver, message)
    if m[receiver + T_RUNNABLE] == 0 and m[receiver + T_STEP] == RECEIVE:
        wake(m, receiver)


@compiled
def arrive(m, message):
    """A message enters its reader's history, and wakes the executor if it waits for work."""
    entity = m[message + M_ENTITY]
    m[message + M_ARRIVAL] = m[X_NOW]
    overwrites = m[entity + E_WAITING] == m[entity + E_DEPTH]
    if overwrites:
        free_message(m, oldest_message(m, entity))
    place = (m[entity + E_HEAD] + m[entity + E_WAITING]) % m[entity + E_DEPTH]
    m[m[entity + E_RING] + place] = message
    m[entity + E_WAITING] += 1
    thread = m[entity + E_THREAD]
    # The event of the message that was overwritten is still in the queue, for this one to use.
    if m[thread + T_KIND] == EVENTS and not overwrites:
        mark_event(m, thread, entity)
    if m[thread + T_RUNNABLE] == 0 and m[thread + T_STEP] == COLLECT:
        wake(m, thread)


@compiled
def mark_event(m, thread, entity):
    """An entity of an events executor has something to execute: to the end of its queue."""
    event = new_message(m)
    m[event + M_ENTITY] = entity
    append(m, thread, event)


@compiled
def _hand_over(m, thread, message):
    """Put a message into its asynchronous writer's history, which keeps the last ones."""
    publisher = m[message + M_PUBLISHER]
    if m[publisher + P_HELD] < m[publisher + P_DEPTH]:
        m[publisher + P_HELD] += 1
        append(m, thread, message)
    else:
        # All of this writer's move up by one place; the oldest one's is gone.
        place = m[thread + T_HEAD]
        while m[place + M_PUBLISHER] != publisher:
            place = m[place + M_NEXT]
        entry = (m[publisher + P_ROW], m[place + M_SOURCE], OVERWRITTEN, 0)
        log(m, L_SEND, thread, entry)
        following = m[place + M_NEXT]
        while following != NONE:
            if m[following + M_PUBLISHER] == publisher:
                _copy(m, following, place)
                place = following
            following = m[following + M_NEXT]
        _copy(m, message, place)
        free_message(m, message)
    if m[thread + T_RUNNABLE] == 0 and m[thread + T_STEP] == SEND:
        wake(m, thread)


@compiled
def _copy(m, source, target):
    for field in range(M_PUBLISHER, M_ARRIVAL):
        m[target + field] = m[source + field]
