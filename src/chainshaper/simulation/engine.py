"""The discrete-event engine: ROS 2's executors, cores that run threads, and the order of events.

On every core the eligible runnable thread of the smallest rank runs; among equals the one that
waits for longest, and a pre-empted thread stays in its place (SCHED_FIFO). Where a plan is in
force, threads in servers are eligible while a slot of their server is open, ranked by the priority
of the server; they take turns when their quantum is used up (round-robin). All others come behind
them, by their own priority (best effort). Slots overlap freely: the better priority runs.

At one instant, first what was to come happens (expiries, deliveries, ends of sleeps), so that an
executor's snapshot has all that happened up to that instant; then running threads that have used
what they needed go on; and only then slots open and close: work that fills a slot exactly is done.

Executors. *Single-threaded* (`rclcpp/src/rclcpp/executor.cpp`): a snapshot of all that is ready is
taken when the wait set is filled, and executed to the end before the next one: timers first, then
subscriptions, services and clients, each in the order of registration and at most once. A message
is taken when its callback is about to run. A timer that missed whole periods fires once and stays
in phase. *Static* (`static_single_threaded_executor.cpp`): subscriptions first, then timers,
clients and services, and one callback per wait set. *Events* (`events_executor.cpp`): in the order
in which things happened, every message and every expiry an event of its own. Entities stand in the
order in which their executor looks at them.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation import layout as at
from chainshaper.simulation.callbacks import (
    arrive,
    begin_body,
    deliver,
    draw,
    drop_expired,
    free_message,
    go_on_publishing,
    log,
    mark_event,
    pass_gate,
    pop_event,
    pop_head,
    push_event,
    send,
    take_oldest,
    wake,
)
from chainshaper.values.compiled.memory import compiled, table_at

__all__ = ["run"]


@compiled()
def advance(m, thread):
    """Go on with a running thread that needs no more CPU time for its step."""
    while m[thread + at.T_RUNNABLE] == 1 and m[thread + at.T_LEFT] == 0:
        step = m[thread + at.T_STEP]
        if step >= at.SEND:
            _work_for_executor(m, thread)
        elif step == at.COLLECT:
            _collect(m, thread)
        else:
            if step == at.TAKE:
                goes_on = _take(m, thread)
            elif step == at.PUBLISH:
                goes_on = go_on_publishing(m, thread)
            else:
                goes_on = pass_gate(m, thread)
            if not goes_on:
                _choose(m, thread)


@compiled()
def expire(m, entity):
    """A timer's time has come: its executor sees it in its next snapshot, or gets an event."""
    thread = m[entity + at.E_THREAD]
    if m[thread + at.T_KIND] == at.EVENTS:
        mark_event(m, thread, entity)
        _call_timer(m, entity)
    if m[thread + at.T_RUNNABLE] == 0 and m[thread + at.T_STEP] == at.COLLECT:
        wake(m, thread)


@compiled()
def _call_timer(m, entity):
    """Move on to the first expiry that is not over yet, as `rcl_timer_call` does."""
    now = m[at.X_NOW]
    m[entity + at.E_DUE] += m[entity + at.E_PERIOD]
    if m[entity + at.E_DUE] < now:
        period = m[entity + at.E_PERIOD]
        m[entity + at.E_DUE] += -(-(now - m[entity + at.E_DUE]) // period) * period
    if m[entity + at.E_DUE] <= m[at.X_LAST_TIMER]:
        push_event(m, m[entity + at.E_DUE], at.EXPIRY, entity)


@compiled()
def _ready(m, entity):
    if m[entity + at.E_KIND] == at.TIMER:
        return m[entity + at.E_DUE] <= min(m[at.X_NOW], m[at.X_LAST_TIMER])
    if m[entity + at.E_LIFESPAN] != at.NONE:
        drop_expired(m, entity)
    return m[entity + at.E_WAITING] > 0


@compiled()
def _collect(m, thread):
    """Fill the wait set and take a snapshot of what is ready; wait if nothing is."""
    if m[thread + at.T_KIND] == at.EVENTS:
        if m[thread + at.T_HEAD] == at.NONE:
            _wait(m, thread)
            return
    else:
        any_ready = False
        for entity in range(m[thread + at.T_FIRST], m[thread + at.T_END], at.ENTITY_COLUMNS):
            ready = _ready(m, entity)
            m[entity + at.E_READY] = ready
            any_ready |= ready
        if not any_ready:
            _wait(m, thread)
            return
    _choose(m, thread)


@compiled()
def _wait(m, thread):
    m[thread + at.T_RUNNABLE] = 0
    m[m[thread + at.T_CORE] + at.C_DIRTY] = 1


@compiled()
def _choose(m, thread):
    """The next of the snapshot is executed; if there is none left, a new one is taken."""
    chosen = at.NONE
    if m[thread + at.T_KIND] == at.EVENTS:
        if m[thread + at.T_HEAD] != at.NONE:
            event = pop_head(m, thread)
            chosen = m[event + at.M_ENTITY]
            free_message(m, event)
    else:
        for entity in range(m[thread + at.T_FIRST], m[thread + at.T_END], at.ENTITY_COLUMNS):
            if m[entity + at.E_READY] == 1:
                chosen = entity
                break
    if chosen == at.NONE:
        _refill(m, thread)
        return
    if m[thread + at.T_KIND] == at.STATIC:  # one callback per wait set
        for entity in range(m[thread + at.T_FIRST], m[thread + at.T_END], at.ENTITY_COLUMNS):
            m[entity + at.E_READY] = 0
    m[chosen + at.E_READY] = 0
    log(m, at.L_EXECUTE, thread, (m[chosen + at.E_ROW],))
    m[thread + at.T_ENTITY] = chosen
    m[thread + at.T_STEP] = at.TAKE
    if m[chosen + at.E_KIND] != at.TIMER:
        m[thread + at.T_LEFT] = draw(m, m[thread + at.T_TAKE])
    elif m[thread + at.T_KIND] != at.EVENTS:  # there, it was called when it expired
        _call_timer(m, chosen)


@compiled()
def _refill(m, thread):
    m[thread + at.T_STEP] = at.COLLECT
    due = m[at.X_STOP]
    for entity in range(m[thread + at.T_FIRST], m[thread + at.T_END], at.ENTITY_COLUMNS):
        if m[entity + at.E_KIND] == at.TIMER and m[entity + at.E_DUE] <= m[at.X_LAST_TIMER]:
            due = min(due, m[entity + at.E_DUE])
    if m[thread + at.T_KIND] != at.EVENTS:
        log(m, at.L_WAIT, thread, (max(0, due - m[at.X_NOW]),))


@compiled()
def _take(m, thread):
    """Take the message of the chosen entity and start its callback; false if it is over."""
    entity, now = m[thread + at.T_ENTITY], m[at.X_NOW]
    m[thread + at.T_START] = at.NONE
    if m[entity + at.E_KIND] == at.TIMER:
        m[thread + at.T_ORIGIN], m[thread + at.T_NUMBER] = now, m[entity + at.E_INSTANCES]
        if m[entity + at.E_STARTS_CHAIN] == 1:
            m[thread + at.T_START] = now
    else:
        drop_expired(m, entity)
        if m[entity + at.E_WAITING] == 0:
            log(m, at.L_TAKE, thread, (m[entity + at.E_ROW], 0, 0, 0))
            return False
        message = take_oldest(m, entity + at.E_HISTORY)
        m[thread + at.T_SOURCE] = m[message + at.M_SOURCE]
        m[thread + at.T_ORIGIN] = m[message + at.M_ORIGIN]
        m[thread + at.T_MODE] = m[message + at.M_MODE]
        m[thread + at.T_NUMBER] = m[message + at.M_NUMBER]
        m[thread + at.T_CAME] = m[message + at.M_ARRIVAL]
        if m[entity + at.E_ON_CHAIN] == 1:
            m[thread + at.T_START] = m[message + at.M_START]
        entry = (m[entity + at.E_ROW], m[message + at.M_ADDRESS], m[message + at.M_SOURCE], 1)
        free_message(m, message)
        log(m, at.L_TAKE, thread, entry)
    m[entity + at.E_INSTANCES] += 1
    log(m, at.L_START, thread, (m[entity + at.E_ROW], m[thread + at.T_USED]))
    return begin_body(m, thread)


@compiled()
def _work_for_executor(m, thread):
    """The next step of a publisher thread or a DDS thread."""
    step = m[thread + at.T_STEP]
    if step == at.SENT:
        duration = m[at.X_NOW] - m[thread + at.T_BEGAN]
        publisher = m[thread + at.T_PUBLICATION]
        entry = (m[publisher + at.P_ROW], m[thread + at.T_SOURCE], at.SENT_OUTCOME, duration)
        log(m, at.L_SEND, thread, entry)
        m[thread + at.T_STEP] = at.SEND
    elif step == at.RECEIVED:
        arrive(m, pop_head(m, thread))
        m[thread + at.T_STEP] = at.RECEIVE
    elif m[thread + at.T_HEAD] == at.NONE:
        _wait(m, thread)
    elif step == at.RECEIVE:
        m[thread + at.T_LEFT] = draw(m, m[thread + at.T_RECEIVE])
        m[thread + at.T_STEP] = at.RECEIVED
    else:
        _send_next(m, thread)


@compiled()
def _send_next(m, thread):
    message, now = pop_head(m, thread), m[at.X_NOW]
    publisher, source = m[message + at.M_PUBLISHER], m[message + at.M_SOURCE]
    m[publisher + at.P_HELD] -= 1
    if m[publisher + at.P_LIFESPAN] != at.NONE and now - source > m[publisher + at.P_LIFESPAN]:
        log(m, at.L_SEND, thread, (m[publisher + at.P_ROW], source, at.EXPIRED, 0))
        free_message(m, message)
        return
    m[thread + at.T_BEGAN] = now
    m[thread + at.T_SOURCE] = source
    m[thread + at.T_PUBLICATION] = publisher
    send(m, thread, message)
    m[thread + at.T_LEFT] = draw(m, m[thread + at.T_PUBLISH])
    m[thread + at.T_STEP] = at.SENT


@compiled()
def run(address):
    """Go on until the end, or until the caller has to look after the array; why (`X_PAUSED`)."""
    m = table_at(address)
    m[at.X_PAUSED] = at.RUNNING
    while m[at.X_PAUSED] == at.RUNNING:
        now = _next_instant(m)
        if now > m[at.X_STOP]:
            return at.OVER
        m[at.X_NOW] = now
        while m[at.X_HEAP_END] > m[at.X_HEAP] and m[m[at.X_HEAP] + at.H_TIME] <= now:
            _happen(m)
        # A thread that goes on may cause something that happens now: one goes on at a time.
        if not _one_goes_on(m):
            for core in range(m[at.X_CORES], m[at.X_CORES_END], at.CORE_COLUMNS):
                if m[core + at.C_BOUNDARY] <= now:
                    _cross_boundary(m, core)
                if m[core + at.C_DIRTY] == 1:
                    _reschedule(m, core)
    return m[at.X_PAUSED]


@compiled()
def _next_instant(m):
    now = at.FOREVER
    if m[at.X_HEAP_END] > m[at.X_HEAP]:
        now = m[m[at.X_HEAP] + at.H_TIME]
    for core in range(m[at.X_CORES], m[at.X_CORES_END], at.CORE_COLUMNS):
        if m[core + at.C_DIRTY] == 1:
            return m[at.X_NOW]
        now = min(now, m[core + at.C_UNTIL], m[core + at.C_BOUNDARY])
    return now


@compiled()
def _happen(m):
    kind, row = pop_event(m)
    if kind == at.DELIVERY:
        deliver(m, row)
    elif kind == at.EXPIRY:
        expire(m, row)
    else:
        wake(m, row)


@compiled()
def _one_goes_on(m):
    """Let one running thread go on that has used what it needed for a step, or its quantum."""
    for core in range(m[at.X_CORES], m[at.X_CORES_END], at.CORE_COLUMNS):
        if m[core + at.C_UNTIL] > m[at.X_NOW]:
            continue
        thread = m[core + at.C_RUNNING]
        _charge(m, core)
        if m[thread + at.T_LEFT] == 0:
            advance(m, thread)
        elif m[core + at.C_QUANTUM] <= 0:
            m[thread + at.T_SEQUENCE] = m[at.X_COUNTER]
            m[at.X_COUNTER] += 1
            m[core + at.C_QUANTUM] = m[at.X_QUANTUM]
            m[core + at.C_DIRTY] = 1
        _run_until(m, core)
        return True
    return False


@compiled()
def _run_until(m, core):
    """Note when the running thread needs to be looked at again."""
    thread = m[core + at.C_RUNNING]
    m[core + at.C_UNTIL] = at.FOREVER
    if thread != at.NONE and m[thread + at.T_RUNNABLE] == 1:
        left = m[thread + at.T_LEFT]
        if m[thread + at.T_SERVER] != at.NONE:
            left = min(left, m[core + at.C_QUANTUM])
        m[core + at.C_UNTIL] = m[at.X_NOW] + left


@compiled()
def _charge(m, core):
    """Account for what the running thread has used since it was looked at last."""
    thread = m[core + at.C_RUNNING]
    if thread == at.NONE:
        return
    used = m[at.X_NOW] - m[core + at.C_SINCE]
    m[thread + at.T_LEFT] -= used
    m[thread + at.T_USED] += used
    m[core + at.C_QUANTUM] -= used
    m[core + at.C_SINCE] = m[at.X_NOW]


@compiled()
def _cross_boundary(m, core):
    """Servers open and close; the next boundary may be in the next cycle."""
    pair = m[core + at.C_NEXT]
    m[core + at.C_MASK] = m[pair + 1]
    following = pair + 2
    if following == m[core + at.C_TABLE_END]:
        following = m[core + at.C_TABLE]
        m[core + at.C_BOUNDARY] += m[at.X_CYCLE]
    m[core + at.C_BOUNDARY] += m[following] - m[pair]
    m[core + at.C_NEXT] = following
    m[core + at.C_DIRTY] = 1


@compiled()
def _reschedule(m, core):
    """Let the best eligible thread run."""
    m[core + at.C_DIRTY] = 0
    _charge(m, core)
    best = at.NONE
    for place in range(m[core + at.C_FIRST], m[core + at.C_END]):
        thread = m[place]
        if m[thread + at.T_RUNNABLE] == 0 or not _eligible(m, core, thread):
            continue
        if best == at.NONE or _goes_before(m, thread, best):
            best = thread
    if best != m[core + at.C_RUNNING]:
        _switch(m, core, best)
    _run_until(m, core)


@compiled()
def _eligible(m, core, thread):
    server = m[thread + at.T_SERVER]
    return server == at.NONE or (m[core + at.C_MASK] >> server) & 1 == 1


@compiled()
def _goes_before(m, thread, other):
    if m[thread + at.T_RANK] != m[other + at.T_RANK]:
        return m[thread + at.T_RANK] < m[other + at.T_RANK]
    return m[thread + at.T_SEQUENCE] < m[other + at.T_SEQUENCE]


@compiled()
def _switch(m, core, thread):
    before = m[core + at.C_RUNNING]
    runnable, row = 0, at.NONE
    if before != at.NONE:
        row = m[before + at.T_ROW]
        if m[before + at.T_RUNNABLE] == 1:
            m[before + at.T_PREEMPTED] = 1
            runnable = 1
    if m[at.X_SWITCHES] == 1:
        log(m, at.L_SWITCH, thread, ((core - m[at.X_CORES]) // at.CORE_COLUMNS, row, runnable))
    m[core + at.C_RUNNING] = thread
    if thread == at.NONE:
        return
    if m[thread + at.T_PREEMPTED] == 1:
        m[thread + at.T_LEFT] += m[at.X_PREEMPTION_COST]
        m[thread + at.T_PREEMPTED] = 0
    if thread != m[core + at.C_LAST]:
        m[thread + at.T_LEFT] += m[at.X_SWITCH_COST]
    m[core + at.C_LAST] = thread
    m[core + at.C_SINCE] = m[at.X_NOW]
    m[core + at.C_QUANTUM] = m[at.X_QUANTUM]
