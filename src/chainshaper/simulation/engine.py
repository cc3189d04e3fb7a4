"""The discrete-event engine: ROS 2's executors, cores that run threads, and the order of events.

On every core the eligible runnable thread of the smallest rank runs; among equals the one that
waits for longest, and a pre-empted thread stays in its place (SCHED_FIFO). Where a plan is in
force, threads in servers are eligible while a slot of their server is open, ranked by the priority
of the server; where the plan says so, equals take turns when their quantum is used up
(round-robin). All others come behind them, by their own priority (best effort).

At one instant, first what was to come happens (expiries, deliveries, ends of sleeps), so that an
executor's snapshot has all that happened up to that instant; then running threads that have used
what they needed go on; and only then slots open and close: work that fills a slot exactly is done.

Executors. *Single-threaded* (`rclcpp/src/rclcpp/executor.cpp`) and *multi-threaded*
(`multi_threaded_executor.cpp`) ones are as :mod:`chainshaper.workload.executor` has them, with
services and clients behind subscriptions. *Static* (`static_single_threaded_executor.cpp`):
subscriptions first, then timers, clients and services, and one callback per wait set. *Events*
(`events_executor.cpp`): in the order in which things happened, every message and every expiry an
event of its own. Entities stand in the order in which their executor looks at them.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation import callbacks
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, C, E, H, M, P, T, X
from chainshaper.values.compiled.memory import compiled, table_at


@compiled()
def advance(m, thread):
    """Go on with a running thread that needs no more CPU time for its step."""
    while m[thread + T.RUNNABLE] == 1 and m[thread + T.LEFT] == 0:
        step = m[thread + T.STEP]
        if step >= at.SEND:
            _work_for_executor(m, thread)
        elif step == at.COLLECT:
            _collect(m, thread)
        elif step == at.TURN:
            _choose(m, thread)
        else:
            if step == at.TAKE:
                goes_on = _take(m, thread)
            elif step == at.PUBLISH:
                goes_on = callbacks.go_on_publishing(m, thread)
            else:
                goes_on = callbacks.pass_gate(m, thread)
            group = m[m[thread + T.ENTITY] + E.GROUP]
            if not goes_on and group != NONE:
                m[group] = 0
                callbacks.wake_executor(m, thread)
            if not goes_on:
                _choose(m, thread)


@compiled()
def expire(m, entity):
    """A timer's time has come: its executor sees it in its next snapshot, or gets an event."""
    thread = m[entity + E.THREAD]
    if m[thread + T.KIND] == at.EVENTS:
        callbacks.mark_event(m, thread, entity)
        _call_timer(m, entity)
    if callbacks.may_run(m, entity):
        callbacks.wake_executor(m, thread)


@compiled()
def _call_timer(m, entity):
    """Move on to the first expiry that is not over yet, as `rcl_timer_call` does."""
    period = m[entity + E.PERIOD]
    missed = max(0, -(-(m[X.NOW] - m[entity + E.DUE]) // period) - 1)
    m[entity + E.DUE] += (1 + missed) * period
    if m[entity + E.DUE] <= m[X.LAST_TIMER]:
        callbacks.push_event(m, m[entity + E.DUE], at.EXPIRY, entity)


@compiled()
def _ready(m, entity):
    if m[entity + E.KIND] == at.TIMER:
        return m[entity + E.DUE] <= min(m[X.NOW], m[X.LAST_TIMER])
    if m[entity + E.LIFESPAN] != NONE:
        callbacks.drop_expired(m, entity)
    return m[entity + E.WAITING] > 0


@compiled()
def _collect(m, thread):
    """Fill the wait set and take a snapshot of what is ready; wait if nothing is."""
    any_ready = m[thread + T.WAITING] > 0  # an events executor's
    if m[thread + T.KIND] != at.EVENTS:
        for entity in range(m[thread + T.FIRST], m[thread + T.END], E.COLUMNS):
            m[entity + E.READY] = callbacks.may_run(m, entity) and _ready(m, entity)
            any_ready |= m[entity + E.READY] == 1
    if any_ready:
        _choose(m, thread)
    else:
        callbacks.wait(m, thread)


@compiled()
def _choose(m, thread):
    """The next of the snapshot is executed; if there is none left, a new one is taken."""
    chosen, kind = NONE, m[thread + T.KIND]
    if kind == at.MULTI_THREADED and not _takes_turn(m, thread):
        return
    if kind != at.EVENTS:
        chosen = _first_ready(m, thread)
    elif m[thread + T.WAITING] > 0:
        chosen = callbacks.next_event(m, thread)
    if chosen == NONE:
        _refill(m, thread)
        return
    callbacks.log(m, at.L_EXECUTE, m[X.NOW], thread, (m[chosen + E.HANDLE],))
    m[thread + T.ENTITY] = chosen
    m[thread + T.STEP] = at.TAKE
    if m[chosen + E.KIND] != at.TIMER:
        m[thread + T.LEFT] = callbacks.draw(m, m[thread + T.TAKE])
    elif kind != at.EVENTS:  # there, it was called when it expired
        _call_timer(m, chosen)
    if kind == at.MULTI_THREADED:
        if m[chosen + E.GROUP] != NONE:
            m[m[chosen + E.GROUP]] = 1
        _give_turn(m, m[thread + T.POOL])


@compiled()
def _first_ready(m, thread):
    """Take what comes first of the snapshot and may run out of it, NONE if nothing does."""
    chosen = NONE
    for entity in range(m[thread + T.FIRST], m[thread + T.END], E.COLUMNS):
        if m[entity + E.READY] == 1 and chosen == NONE:
            m[entity + E.READY] = 0
            if callbacks.may_run(m, entity):
                chosen = entity
        elif m[thread + T.KIND] == at.STATIC:  # one callback per wait set
            m[entity + E.READY] = 0
    return chosen


@compiled()
def _takes_turn(m, thread):
    """Whether no other thread of the executor waits or takes what is next; else it queues up."""
    pool = m[thread + T.POOL]
    if m[pool + T.OWNER] == NONE or m[pool + T.OWNER] == thread:
        m[pool + T.OWNER] = thread
        return True
    m[thread + T.STEP] = at.TURN
    callbacks.queue_up(m, thread)
    callbacks.wait(m, thread)
    return False


@compiled()
def _give_turn(m, pool):
    """Wake the thread that has queued up for longest; another may be quicker."""
    m[pool + T.OWNER], longest = NONE, NONE
    for thread in range(pool, m[pool + T.POOL_END], T.COLUMNS):
        queues = m[thread + T.RUNNABLE] == 0 and m[thread + T.STEP] == at.TURN
        if queues and (longest == NONE or m[thread + T.SEQUENCE] < m[longest + T.SEQUENCE]):
            longest = thread
    if longest != NONE:
        callbacks.wake(m, longest, at.TURN)


@compiled()
def _refill(m, thread):
    m[thread + T.STEP] = at.COLLECT
    if m[thread + T.KIND] != at.EVENTS:
        due = m[X.STOP]
        for entity in range(m[thread + T.FIRST], m[thread + T.END], E.COLUMNS):
            if m[entity + E.KIND] == at.TIMER and m[entity + E.DUE] <= m[X.LAST_TIMER]:
                due = min(due, m[entity + E.DUE])
        callbacks.log(m, at.L_WAIT, m[X.NOW], thread, (max(0, due - m[X.NOW]),))


@compiled()
def _take(m, thread):
    """Take the message of the chosen entity and start its callback; false if it is over."""
    entity, now = m[thread + T.ENTITY], m[X.NOW]
    m[thread + T.START] = NONE
    if m[entity + E.KIND] == at.TIMER:
        m[thread + T.ORIGIN] = now
    else:
        callbacks.drop_expired(m, entity)
        if m[entity + E.WAITING] == 0:
            callbacks.log(m, at.L_TAKE, now, thread, (m[entity + E.RMW_HANDLE], 0, 0, 0))
            return False
        message = callbacks.take_oldest(m, entity + E.HEAD)
        callbacks.copy(m, message + M.SOURCE, thread + T.SOURCE, at.CARRIED)
        if m[entity + E.ON_CHAIN] == 0:
            m[thread + T.START] = NONE
        entry = (m[entity + E.RMW_HANDLE], m[message + M.ADDRESS], m[message + M.SOURCE], 1)
        callbacks.log(m, at.L_TAKE, now, thread, entry)
        callbacks.free_message(m, message)
    if m[entity + E.STARTS_CHAIN] == 1 and now >= m[X.RECORD_FROM]:
        m[thread + T.START], m[thread + T.NUMBER] = now, m[X.STARTED]
        m[X.STARTED] += 1
    callbacks.log(m, at.L_START, now, thread, (m[entity + E.CALLBACK], m[thread + T.USED], 0))
    return callbacks.begin_body(m, thread)


@compiled()
def _work_for_executor(m, thread):
    """The next step of a publisher thread or a DDS thread."""
    step, now = m[thread + T.STEP], m[X.NOW]
    if step == at.SENT:
        writer, began = m[m[thread + T.PUBLICATION] + P.RMW_HANDLE], m[thread + T.BEGAN]
        entry = (writer, m[thread + T.SOURCE], at.SENT_OUTCOME, now - began)
        callbacks.log(m, at.L_SEND, began, thread, entry)
        m[thread + T.STEP] = at.SEND
    elif step == at.RECEIVED:
        callbacks.arrive(m, callbacks.take_oldest(m, thread + T.HEAD))
        m[thread + T.STEP] = at.RECEIVE
    elif m[thread + T.WAITING] == 0:
        callbacks.wait(m, thread)
    elif step == at.RECEIVE:
        m[thread + T.LEFT] = callbacks.draw(m, m[thread + T.RECEIVE])
        m[thread + T.STEP] = at.RECEIVED
    else:
        publisher = callbacks.next_event(m, thread)
        message = callbacks.take_oldest(m, publisher + P.HEAD)
        source, lifespan = m[message + M.SOURCE], m[publisher + P.LIFESPAN]
        if lifespan != NONE and now - source > lifespan:
            expired = (m[publisher + P.RMW_HANDLE], source, at.EXPIRED, 0)
            callbacks.log(m, at.L_SEND, now, thread, expired)
            callbacks.free_message(m, message)
            return
        m[thread + T.BEGAN], m[thread + T.SOURCE] = now, source
        m[thread + T.PUBLICATION] = publisher
        callbacks.send(m, thread, message)
        m[thread + T.LEFT] = callbacks.draw(m, m[thread + T.PUBLISH])
        m[thread + T.STEP] = at.SENT


@compiled()
def run(address):
    """Go on until the end, or until the caller has to look after the array; why (`X.PAUSED`)."""
    m = table_at(address)
    m[X.PAUSED] = at.RUNNING
    while m[X.PAUSED] == at.RUNNING:
        now = _next_instant(m)
        if now > m[X.STOP]:
            return at.OVER
        m[X.NOW] = now
        while _next_event_ns(m) <= now:
            m[X.EVENTS_END] -= H.COLUMNS
            kind, row = m[m[X.EVENTS_END] + H.KIND], m[m[X.EVENTS_END] + H.ROW]
            if kind == at.DELIVERY:
                callbacks.deliver(m, row)
            elif kind == at.EXPIRY:
                expire(m, row)
            else:
                callbacks.wake(m, row, m[row + T.STEP])
        # A thread that goes on may cause something that happens now: one goes on at a time.
        if not _one_goes_on(m):
            for core in range(m[X.CORES], m[X.CORES_END], C.COLUMNS):
                if m[core + C.BOUNDARY] <= now:
                    _cross_boundary(m, core)
                if m[core + C.DIRTY] == 1:
                    _reschedule(m, core)
    return m[X.PAUSED]


@compiled(inline=True)
def _next_event_ns(m):
    """When the next of the events to come happens: they stand from the last one to the next."""
    if m[X.EVENTS_END] == m[X.EVENTS]:
        return at.FOREVER
    return m[m[X.EVENTS_END] - H.COLUMNS + H.TIME]


@compiled()
def _next_instant(m):
    now = _next_event_ns(m)
    for core in range(m[X.CORES], m[X.CORES_END], C.COLUMNS):
        if m[core + C.DIRTY] == 1:
            return m[X.NOW]
        now = min(now, m[core + C.UNTIL], m[core + C.BOUNDARY])
    return now


@compiled()
def _one_goes_on(m):
    """Let one running thread go on that has used what it needed for a step, or its quantum."""
    for core in range(m[X.CORES], m[X.CORES_END], C.COLUMNS):
        if m[core + C.UNTIL] > m[X.NOW]:
            continue
        thread = m[core + C.RUNNING]
        _charge(m, core)
        if m[thread + T.LEFT] == 0:
            advance(m, thread)
        elif m[core + C.QUANTUM] <= 0:
            callbacks.queue_up(m, thread)
            m[core + C.QUANTUM] = m[X.QUANTUM]
            m[core + C.DIRTY] = 1
        _run_until(m, core)
        return True
    return False


@compiled()
def _run_until(m, core):
    """Note when the running thread needs to be looked at again."""
    thread = m[core + C.RUNNING]
    m[core + C.UNTIL] = at.FOREVER
    if thread != NONE and m[thread + T.RUNNABLE] == 1:
        left = m[thread + T.LEFT]
        if m[thread + T.SERVER] != NONE:
            left = min(left, m[core + C.QUANTUM])
        m[core + C.UNTIL] = m[X.NOW] + left


@compiled()
def _charge(m, core):
    """Account for what the running thread has used since it was looked at last."""
    thread = m[core + C.RUNNING]
    if thread != NONE:
        used = m[X.NOW] - m[core + C.SINCE]
        m[thread + T.LEFT] -= used
        m[thread + T.USED] += used
        m[core + C.QUANTUM] -= used
        m[core + C.SINCE] = m[X.NOW]


@compiled()
def _cross_boundary(m, core):
    """Servers open and close; the next boundary may be in the next cycle."""
    pair = m[core + C.NEXT]
    m[core + C.MASK] = m[pair + 1]
    following = pair + 2
    if following == m[core + C.TABLE_END]:
        following = m[core + C.TABLE]
        m[core + C.BOUNDARY] += m[X.CYCLE]
    m[core + C.BOUNDARY] += m[following] - m[pair]
    m[core + C.NEXT] = following
    m[core + C.DIRTY] = 1


@compiled()
def _reschedule(m, core):
    """Let the best eligible thread run."""
    m[core + C.DIRTY] = 0
    _charge(m, core)
    best = NONE
    for place in range(m[core + C.FIRST], m[core + C.END]):
        thread = m[place]
        server = m[thread + T.SERVER]
        eligible = server == NONE or (m[core + C.MASK] >> server) & 1 == 1
        if m[thread + T.RUNNABLE] == 1 and eligible and _goes_before(m, thread, best):
            best = thread
    if best != m[core + C.RUNNING]:
        _switch(m, core, best)
    _run_until(m, core)


@compiled()
def _goes_before(m, thread, other):
    if other == NONE or m[thread + T.RANK] != m[other + T.RANK]:
        return other == NONE or m[thread + T.RANK] < m[other + T.RANK]
    return m[thread + T.SEQUENCE] < m[other + T.SEQUENCE]


@compiled()
def _switch(m, core, thread):
    before, now = m[core + C.RUNNING], m[X.NOW]
    runnable, row = 0, NONE
    if before != NONE:
        runnable, row = m[before + T.RUNNABLE], m[before + T.ROW]
        m[before + T.PREEMPTED] |= runnable
    if m[X.SWITCHES] == 1:
        switched = ((core - m[X.CORES]) // C.COLUMNS, row, runnable)
        callbacks.log(m, at.L_SWITCH, now, thread, switched)
    m[core + C.RUNNING] = thread
    if thread == NONE:
        return
    if m[thread + T.PREEMPTED] == 1:
        m[thread + T.LEFT] += m[X.PREEMPTION_COST]
        m[thread + T.PREEMPTED] = 0
    if thread != m[core + C.LAST]:
        m[thread + T.LEFT] += m[X.SWITCH_COST]
    m[core + C.LAST] = thread
    m[core + C.SINCE] = now
    m[core + C.QUANTUM] = m[X.QUANTUM]
