"""What callbacks do: compute and publish, hold a message at a gate, complete a set of messages.

A callback has started when these functions are called. They leave in its thread's row how much
CPU time it needs next and what follows (`T_LEFT`, `T_STEP`), or let the thread wait.
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
from chainshaper.simulation.messages import publish
from chainshaper.simulation.queues import (
    begin_entry,
    draw,
    free_message,
    log,
    new_message,
    push_event,
    put_newest,
    take_oldest,
)
from chainshaper.values.compiled.memory import compiled

__all__ = ["begin_body", "go_on_publishing", "pass_gate", "sleep"]


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
    """What has come meanwhile may leave for the message that is held, or leave no room for it."""
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
