"""How messages travel: publication, delivery, the history of a subscription, waking who waits.

A publication reaches every reader of its topic after a delay, in order (DDS delivers the messages
of one writer in order). Optionally a DDS thread of the subscriber's process works for it first.
A history keeps the last ``depth`` messages: a newer one overwrites the oldest.

An asynchronous publisher hands its message to the publisher thread of its process. Its own
history keeps those that are not sent yet; see :mod:`chainshaper.workload.executor`.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation import layout as at
from chainshaper.simulation.queues import (
    append,
    draw,
    free_message,
    log,
    new_message,
    push_event,
    put_newest,
)
from chainshaper.values.compiled.memory import compiled

__all__ = ["arrive", "deliver", "mark_event", "publish", "send", "wake"]

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
