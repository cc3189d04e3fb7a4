"""ROS 2's executors, and the threads that work for them, step by step (compiled).

*Single-threaded* (`rclcpp/src/rclcpp/executor.cpp`): a snapshot of all that is ready is taken when
the wait set is filled, and executed to the end before the next one: timers first, then
subscriptions, services and clients, each in the order of registration and at most once. A message
is taken when its callback is about to run. A timer that missed whole periods fires once and keeps
its phase. *Static* (`static_single_threaded_executor.cpp`): subscriptions first, then timers,
clients and services, and one callback per wait set. *Events* (`events_executor.cpp`): in the order
in which things happened, every message and every expiry an event of its own.

Entities stand in the order in which their executor looks at them, so that all of them walk through
their entities from the first to the last.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.callbacks import begin_body, go_on_publishing, pass_gate
from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.layout import (
    C_DIRTY,
    COLLECT,
    E_DUE,
    E_INSTANCES,
    E_KIND,
    E_LIFESPAN,
    E_ON_CHAIN,
    E_PERIOD,
    E_READY,
    E_ROW,
    E_STARTS_CHAIN,
    E_THREAD,
    E_WAITING,
    ENTITY_COLUMNS,
    EVENTS,
    EXPIRED,
    EXPIRY,
    L_EXECUTE,
    L_SEND,
    L_START,
    L_TAKE,
    L_WAIT,
    M_ADDRESS,
    M_ENTITY,
    M_MODE,
    M_NUMBER,
    M_ORIGIN,
    M_PUBLISHER,
    M_SOURCE,
    M_START,
    NONE,
    P_HELD,
    P_LIFESPAN,
    P_ROW,
    PUBLISH,
    RECEIVE,
    RECEIVED,
    SEND,
    SENT,
    SENT_OUTCOME,
    STATIC,
    T_BEGAN,
    T_CORE,
    T_END,
    T_ENTITY,
    T_FIRST,
    T_HEAD,
    T_KIND,
    T_LEFT,
    T_MODE,
    T_NUMBER,
    T_ORIGIN,
    T_PUBLICATION,
    T_PUBLISH,
    T_RECEIVE,
    T_RUNNABLE,
    T_SOURCE,
    T_START,
    T_STEP,
    T_TAKE,
    T_USED,
    TAKE,
    TIMER,
    X_LAST_TIMER,
    X_NOW,
    X_STOP,
)
from chainshaper.simulation.messages import arrive, mark_event, send, wake
from chainshaper.simulation.queues import (
    draw,
    drop_expired,
    free_message,
    log,
    oldest_message,
    pop_head,
    push_event,
)

__all__ = ["advance", "expire"]


@compiled
def advance(m, thread):
    """Go on with a running thread that needs no more CPU time for its step."""
    while m[thread + T_RUNNABLE] == 1 and m[thread + T_LEFT] == 0:
        step = m[thread + T_STEP]
        if step >= SEND:
            _work_for_executor(m, thread)
        elif step == COLLECT:
            _collect(m, thread)
        else:
            if step == TAKE:
                goes_on = _take(m, thread)
            elif step == PUBLISH:
                goes_on = go_on_publishing(m, thread)
            else:
                goes_on = pass_gate(m, thread)
            if not goes_on:
                _choose(m, thread)


@compiled
def expire(m, entity):
    """A timer's time has come: its executor sees it in its next snapshot, or gets an event."""
    thread = m[entity + E_THREAD]
    if m[thread + T_KIND] == EVENTS:
        mark_event(m, thread, entity)
        _call_timer(m, entity)
    if m[thread + T_RUNNABLE] == 0 and m[thread + T_STEP] == COLLECT:
        wake(m, thread)


@compiled
def _call_timer(m, entity):
    """Move on to the first expiry that is not over yet, as `rcl_timer_call` does."""
    now = m[X_NOW]
    m[entity + E_DUE] += m[entity + E_PERIOD]
    if m[entity + E_DUE] < now:
        period = m[entity + E_PERIOD]
        m[entity + E_DUE] += -(-(now - m[entity + E_DUE]) // period) * period
    if m[entity + E_DUE] <= m[X_LAST_TIMER]:
        push_event(m, m[entity + E_DUE], EXPIRY, entity)


@compiled
def _ready(m, entity):
    if m[entity + E_KIND] == TIMER:
        return m[entity + E_DUE] <= min(m[X_NOW], m[X_LAST_TIMER])
    if m[entity + E_LIFESPAN] != NONE:
        drop_expired(m, entity)
    return m[entity + E_WAITING] > 0


@compiled
def _collect(m, thread):
    """Fill the wait set and take a snapshot of what is ready; wait if nothing is."""
    if m[thread + T_KIND] == EVENTS:
        if m[thread + T_HEAD] == NONE:
            _wait(m, thread)
            return
    else:
        any_ready = False
        for entity in range(m[thread + T_FIRST], m[thread + T_END], ENTITY_COLUMNS):
            ready = _ready(m, entity)
            m[entity + E_READY] = ready
            any_ready |= ready
        if not any_ready:
            _wait(m, thread)
            return
    _choose(m, thread)


@compiled
def _wait(m, thread):
    m[thread + T_RUNNABLE] = 0
    m[m[thread + T_CORE] + C_DIRTY] = 1


@compiled
def _choose(m, thread):
    """The next of the snapshot is executed; if there is none left, a new one is taken."""
    chosen = NONE
    if m[thread + T_KIND] == EVENTS:
        if m[thread + T_HEAD] != NONE:
            event = pop_head(m, thread)
            chosen = m[event + M_ENTITY]
            free_message(m, event)
    else:
        for entity in range(m[thread + T_FIRST], m[thread + T_END], ENTITY_COLUMNS):
            if m[entity + E_READY] == 1:
                chosen = entity
                break
    if chosen == NONE:
        _refill(m, thread)
        return
    if m[thread + T_KIND] == STATIC:  # one callback per wait set
        for entity in range(m[thread + T_FIRST], m[thread + T_END], ENTITY_COLUMNS):
            m[entity + E_READY] = 0
    m[chosen + E_READY] = 0
    log(m, L_EXECUTE, thread, (m[chosen + E_ROW],))
    m[thread + T_ENTITY] = chosen
    m[thread + T_STEP] = TAKE
    if m[chosen + E_KIND] != TIMER:
        m[thread + T_LEFT] = draw(m, m[thread + T_TAKE])
    elif m[thread + T_KIND] != EVENTS:  # there, it was called when it expired
        _call_timer(m, chosen)


@compiled
def _refill(m, thread):
    m[thread + T_STEP] = COLLECT
    due = m[X_STOP]
    for entity in range(m[thread + T_FIRST], m[thread + T_END], ENTITY_COLUMNS):
        if m[entity + E_KIND] == TIMER and m[entity + E_DUE] <= m[X_LAST_TIMER]:
            due = min(due, m[entity + E_DUE])
    if m[thread + T_KIND] != EVENTS:
        log(m, L_WAIT, thread, (max(0, due - m[X_NOW]),))


@compiled
def _take(m, thread):
    """Take the message of the chosen entity and start its callback; false if it is over."""
    entity, now = m[thread + T_ENTITY], m[X_NOW]
    m[thread + T_START] = NONE
    if m[entity + E_KIND] == TIMER:
        m[thread + T_ORIGIN], m[thread + T_NUMBER] = now, m[entity + E_INSTANCES]
        if m[entity + E_STARTS_CHAIN] == 1:
            m[thread + T_START] = now
    else:
        drop_expired(m, entity)
        if m[entity + E_WAITING] == 0:
            log(m, L_TAKE, thread, (m[entity + E_ROW], 0, 0, 0))
            return False
        message = oldest_message(m, entity)
        m[thread + T_SOURCE], m[thread + T_ORIGIN] = m[message + M_SOURCE], m[message + M_ORIGIN]
        m[thread + T_MODE], m[thread + T_NUMBER] = m[message + M_MODE], m[message + M_NUMBER]
        if m[entity + E_ON_CHAIN] == 1:
            m[thread + T_START] = m[message + M_START]
        entry = (m[entity + E_ROW], m[message + M_ADDRESS], m[message + M_SOURCE], 1)
        free_message(m, message)
        log(m, L_TAKE, thread, entry)
    m[entity + E_INSTANCES] += 1
    log(m, L_START, thread, (m[entity + E_ROW], m[thread + T_USED]))
    return begin_body(m, thread)


@compiled
def _work_for_executor(m, thread):
    """The next step of a publisher thread or a DDS thread."""
    step = m[thread + T_STEP]
    if step == SENT:
        duration = m[X_NOW] - m[thread + T_BEGAN]
        publisher = m[thread + T_PUBLICATION]
        entry = (m[publisher + P_ROW], m[thread + T_SOURCE], SENT_OUTCOME, duration)
        log(m, L_SEND, thread, entry)
        m[thread + T_STEP] = SEND
    elif step == RECEIVED:
        arrive(m, pop_head(m, thread))
        m[thread + T_STEP] = RECEIVE
    elif m[thread + T_HEAD] == NONE:
        _wait(m, thread)
    elif step == RECEIVE:
        m[thread + T_LEFT] = draw(m, m[thread + T_RECEIVE])
        m[thread + T_STEP] = RECEIVED
    else:
        _send_next(m, thread)


@compiled
def _send_next(m, thread):
    message, now = pop_head(m, thread), m[X_NOW]
    publisher, source = m[message + M_PUBLISHER], m[message + M_SOURCE]
    m[publisher + P_HELD] -= 1
    if m[publisher + P_LIFESPAN] != NONE and now - source > m[publisher + P_LIFESPAN]:
        log(m, L_SEND, thread, (m[publisher + P_ROW], source, EXPIRED, 0))
        free_message(m, message)
        return
    m[thread + T_BEGAN], m[thread + T_SOURCE], m[thread + T_PUBLICATION] = now, source, publisher
    send(m, thread, message)
    m[thread + T_LEFT] = draw(m, m[thread + T_PUBLISH])
    m[thread + T_STEP] = SENT
