"""What callbacks do: compute and publish, hold a message at a gate, complete a set of messages.

A callback has started when these functions are called. They leave in its thread's row how much
CPU time it needs next and what follows (`T_LEFT`, `T_STEP`), or let the thread wait.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.gate_kernel import decide, missed_slot, switch_mode
from chainshaper.simulation.layout import (
    A_STRIDE,
    C_DIRTY,
    DISCARD,
    E_BODY,
    E_BODY_ROW,
    E_EXECUTION,
    E_INPUT,
    E_PUBLISHERS,
    E_PUBLISHERS_END,
    E_ROW,
    E_WAITING,
    G_ARRIVAL,
    G_AT,
    G_MODE,
    G_PAUSE,
    G_SLOT,
    G_SPIN,
    G_TREATED,
    GATE,
    GATE_PAUSED,
    GATE_PUBLISHED,
    GATE_WAKE,
    I_DEPTH,
    I_HEAD,
    I_ON_CHAIN,
    I_RING,
    I_WAITING,
    INPUT_COLUMNS,
    L_END,
    L_RELEASE,
    LOG_COLUMNS,
    M_NUMBER,
    M_ORIGIN,
    M_START,
    MODE_LISTENER,
    NONE,
    PUBLISH,
    PUBLISHER_COLUMNS,
    S_END,
    S_FIRST,
    SLEEP_OVER,
    SYNCHRONISE,
    T_BEGAN,
    T_CORE,
    T_ENTITY,
    T_LEFT,
    T_MODE,
    T_NUMBER,
    T_ORIGIN,
    T_PUBLICATION,
    T_PUBLISH,
    T_RUNNABLE,
    T_SOURCE,
    T_START,
    T_STEP,
    T_USED,
    X_AWAY,
    X_LOGS,
    X_NOW,
)
from chainshaper.simulation.messages import publish
from chainshaper.simulation.queues import (
    begin_entry,
    draw,
    free_message,
    log,
    new_message,
    push_event,
)

__all__ = ["begin_body", "go_on_publishing", "pass_gate", "sleep"]


@compiled
def begin_body(m, thread):
    """Begin the callback of the thread's entity; false if it has ended already."""
    entity = m[thread + T_ENTITY]
    body = m[entity + E_BODY]
    m[thread + T_PUBLICATION] = m[entity + E_PUBLISHERS]
    m[thread + T_STEP] = PUBLISH
    if body == GATE:
        return _hold(m, thread)
    if body == MODE_LISTENER:
        switch_mode(m, m[entity + E_BODY_ROW], m[thread + T_MODE])
        return _end(m, thread)
    if body == SYNCHRONISE and not _complete(m, thread):
        return _end(m, thread)
    execution = draw(m, m[entity + E_EXECUTION])
    m[thread + T_LEFT] = execution + execution * m[X_AWAY] // 1_000_000
    return True


@compiled
def go_on_publishing(m, thread):
    """Publish on the next topic; false if all have been served and the callback has ended."""
    publisher = m[thread + T_PUBLICATION]
    if publisher == m[m[thread + T_ENTITY] + E_PUBLISHERS_END]:
        return _end(m, thread)
    m[thread + T_PUBLICATION] += PUBLISHER_COLUMNS
    publish(m, thread, publisher)
    m[thread + T_LEFT] = draw(m, m[thread + T_PUBLISH])
    return True


@compiled
def sleep(m, thread, until):
    """A thread waits for an instant, whatever else happens."""
    m[thread + T_RUNNABLE] = 0
    m[m[thread + T_CORE] + C_DIRTY] = 1
    push_event(m, until, SLEEP_OVER, thread)


@compiled
def pass_gate(m, thread):
    """A thread of a gate goes on: awake, watching the clock, having published or paused.

    False if the callback has ended.
    """
    entity, now = m[thread + T_ENTITY], m[X_NOW]
    gate = m[entity + E_BODY_ROW]
    if m[thread + T_STEP] == GATE_WAKE:
        if now < m[gate + G_AT]:
            m[thread + T_LEFT] = m[gate + G_AT] - now  # watching the clock
            return True
        m[thread + T_BEGAN] = now
        if missed_slot(m, gate):
            m[gate + G_AT], m[gate + G_SLOT], m[gate + G_TREATED] = NONE, NONE, DISCARD
            return _released(m, thread)
        m[thread + T_STEP] = GATE_PUBLISHED
        publish(m, thread, m[entity + E_PUBLISHERS])
        m[thread + T_LEFT] = draw(m, m[thread + T_PUBLISH])
        return True
    # Another message that waits already must not become late by the pause.
    published = m[thread + T_STEP] == GATE_PUBLISHED
    if published and m[gate + G_PAUSE] > 0 and m[entity + E_WAITING] == 0:
        m[thread + T_STEP] = GATE_PAUSED
        sleep(m, thread, now + m[gate + G_PAUSE])
        return True
    return _released(m, thread)


@compiled
def _hold(m, thread):
    gate, now = m[m[thread + T_ENTITY] + E_BODY_ROW], m[X_NOW]
    decide(m, gate, now, m[thread + T_ORIGIN])
    m[thread + T_BEGAN] = now
    if m[gate + G_AT] == NONE:
        return _released(m, thread)
    m[thread + T_STEP] = GATE_WAKE
    if m[gate + G_AT] - m[gate + G_SPIN] > now:
        sleep(m, thread, m[gate + G_AT] - m[gate + G_SPIN])
    return True


@compiled
def _released(m, thread):
    entity = m[thread + T_ENTITY]
    gate = m[entity + E_BODY_ROW]
    place = begin_entry(m, L_RELEASE, m[thread + T_BEGAN], thread)
    if place != NONE:
        stride = m[m[X_LOGS] + L_RELEASE * LOG_COLUMNS + A_STRIDE]
        m[place + 2 * stride] = m[entity + E_ROW]
        m[place + 3 * stride] = m[thread + T_SOURCE]
        for field in range(G_MODE - G_ARRIVAL + 1):
            m[place + (4 + field) * stride] = m[gate + G_ARRIVAL + field]
    return _end(m, thread)


@compiled
def _complete(m, thread):
    """Add the message to its synchroniser's input; true if that completes a set.

    The oldest message of every input makes a set. Its stamp is that of the first input.
    """
    entity = m[thread + T_ENTITY]
    synchroniser = m[entity + E_BODY_ROW]
    first, end = m[synchroniser + S_FIRST], m[synchroniser + S_END]
    mine = first + m[entity + E_INPUT] * INPUT_COLUMNS
    if m[mine + I_WAITING] == m[mine + I_DEPTH]:
        free_message(m, _oldest(m, mine))
    message = new_message(m)
    m[message + M_ORIGIN], m[message + M_START] = m[thread + T_ORIGIN], m[thread + T_START]
    m[message + M_NUMBER] = m[thread + T_NUMBER]
    place = (m[mine + I_HEAD] + m[mine + I_WAITING]) % m[mine + I_DEPTH]
    m[m[mine + I_RING] + place] = message
    m[mine + I_WAITING] += 1
    for source in range(first, end, INPUT_COLUMNS):
        if m[source + I_WAITING] == 0:
            return False
    m[thread + T_START] = NONE
    for source in range(first, end, INPUT_COLUMNS):
        message = _oldest(m, source)
        if source == first:
            m[thread + T_ORIGIN] = m[message + M_ORIGIN]
        if m[source + I_ON_CHAIN] == 1:
            m[thread + T_START] = m[message + M_START]
            m[thread + T_NUMBER] = m[message + M_NUMBER]
        free_message(m, message)
    return True


@compiled
def _oldest(m, source):
    """The oldest message that waits at an input, taken out."""
    message = m[m[source + I_RING] + m[source + I_HEAD]]
    m[source + I_HEAD] = (m[source + I_HEAD] + 1) % m[source + I_DEPTH]
    m[source + I_WAITING] -= 1
    return message


@compiled
def _end(m, thread):
    log(m, L_END, thread, (m[m[thread + T_ENTITY] + E_ROW], m[thread + T_USED]))
    return False
