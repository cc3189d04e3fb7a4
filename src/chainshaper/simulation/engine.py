"""The discrete-event engine: cores that run threads, and the order in which things happen.

On every core the eligible runnable thread of the smallest rank runs; among equals the one that
waits for longest, and a pre-empted thread keeps its place (SCHED_FIFO). Where a plan is in force,
threads in servers are eligible while a slot of their server is open, ranked by the priority of
the server; they take turns when their quantum is used up (round-robin). All others come behind
them, by their own priority (best effort). Slots overlap freely: the better priority runs.

At one instant, first what was to come happens (expiries, deliveries, ends of sleeps), so that an
executor's snapshot has all that happened up to that instant; then running threads that have used
what they needed go on; and only then slots open and close: work that fills a slot exactly is done.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

from chainshaper.simulation.compiled import compiled
from chainshaper.simulation.executor import advance, expire
from chainshaper.simulation.layout import (
    C_BOUNDARY,
    C_DIRTY,
    C_END,
    C_FIRST,
    C_LAST,
    C_MASK,
    C_NEXT,
    C_QUANTUM,
    C_RUNNING,
    C_SINCE,
    C_TABLE,
    C_TABLE_END,
    C_UNTIL,
    CORE_COLUMNS,
    DELIVERY,
    EXPIRY,
    FOREVER,
    H_TIME,
    L_SWITCH,
    NONE,
    OVER,
    RUNNING,
    T_LEFT,
    T_PREEMPTED,
    T_RANK,
    T_ROW,
    T_RUNNABLE,
    T_SEQUENCE,
    T_SERVER,
    T_USED,
    X_CORES,
    X_CORES_END,
    X_COUNTER,
    X_CYCLE,
    X_HEAP,
    X_HEAP_END,
    X_NOW,
    X_PAUSED,
    X_PREEMPTION_COST,
    X_QUANTUM,
    X_STOP,
    X_SWITCH_COST,
    X_SWITCHES,
)
from chainshaper.simulation.messages import deliver, wake
from chainshaper.simulation.queues import log, pop_event

__all__ = ["run"]


@compiled
def run(m):
    """Go on until the end, or until the caller has to look after the array; why (`X_PAUSED`)."""
    m[X_PAUSED] = RUNNING
    while m[X_PAUSED] == RUNNING:
        now = _next_instant(m)
        if now > m[X_STOP]:
            return OVER
        m[X_NOW] = now
        while m[X_HEAP_END] > m[X_HEAP] and m[m[X_HEAP] + H_TIME] <= now:
            _happen(m)
        # A thread that goes on may cause something that happens now: one goes on at a time.
        if not _one_goes_on(m):
            for core in range(m[X_CORES], m[X_CORES_END], CORE_COLUMNS):
                if m[core + C_BOUNDARY] <= now:
                    _cross_boundary(m, core)
                if m[core + C_DIRTY] == 1:
                    _reschedule(m, core)
    return m[X_PAUSED]


@compiled
def _next_instant(m):
    now = FOREVER
    if m[X_HEAP_END] > m[X_HEAP]:
        now = m[m[X_HEAP] + H_TIME]
    for core in range(m[X_CORES], m[X_CORES_END], CORE_COLUMNS):
        if m[core + C_DIRTY] == 1:
            return m[X_NOW]
        now = min(now, m[core + C_UNTIL], m[core + C_BOUNDARY])
    return now


@compiled
def _happen(m):
    kind, row = pop_event(m)
    if kind == DELIVERY:
        deliver(m, row)
    elif kind == EXPIRY:
        expire(m, row)
    else:
        wake(m, row)


@compiled
def _one_goes_on(m):
    """Let one running thread go on that has used what it needed for a step, or its quantum."""
    for core in range(m[X_CORES], m[X_CORES_END], CORE_COLUMNS):
        if m[core + C_UNTIL] > m[X_NOW]:
            continue
        thread = m[core + C_RUNNING]
        _charge(m, core)
        if m[thread + T_LEFT] == 0:
            advance(m, thread)
        elif m[core + C_QUANTUM] <= 0:
            m[thread + T_SEQUENCE] = m[X_COUNTER]
            m[X_COUNTER] += 1
            m[core + C_QUANTUM] = m[X_QUANTUM]
            m[core + C_DIRTY] = 1
        _run_until(m, core)
        return True
    return False


@compiled
def _run_until(m, core):
    """Note when the running thread needs to be looked at again."""
    thread = m[core + C_RUNNING]
    m[core + C_UNTIL] = FOREVER
    if thread != NONE and m[thread + T_RUNNABLE] == 1:
        left = m[thread + T_LEFT]
        if m[thread + T_SERVER] != NONE:
            left = min(left, m[core + C_QUANTUM])
        m[core + C_UNTIL] = m[X_NOW] + left


@compiled
def _charge(m, core):
    """Account for what the running thread has used since it was looked at last."""
    thread = m[core + C_RUNNING]
    if thread == NONE:
        return
    used = m[X_NOW] - m[core + C_SINCE]
    m[thread + T_LEFT] -= used
    m[thread + T_USED] += used
    m[core + C_QUANTUM] -= used
    m[core + C_SINCE] = m[X_NOW]


@compiled
def _cross_boundary(m, core):
    """Servers open and close; the next boundary may be in the next cycle."""
    pair = m[core + C_NEXT]
    m[core + C_MASK] = m[pair + 1]
    following = pair + 2
    if following == m[core + C_TABLE_END]:
        following = m[core + C_TABLE]
        m[core + C_BOUNDARY] += m[X_CYCLE]
    m[core + C_BOUNDARY] += m[following] - m[pair]
    m[core + C_NEXT] = following
    m[core + C_DIRTY] = 1


@compiled
def _reschedule(m, core):
    """Let the best eligible thread run."""
    m[core + C_DIRTY] = 0
    _charge(m, core)
    best = NONE
    for place in range(m[core + C_FIRST], m[core + C_END]):
        thread = m[place]
        if m[thread + T_RUNNABLE] == 0 or not _eligible(m, core, thread):
            continue
        if best == NONE or _goes_before(m, thread, best):
            best = thread
    if best != m[core + C_RUNNING]:
        _switch(m, core, best)
    _run_until(m, core)


@compiled
def _eligible(m, core, thread):
    server = m[thread + T_SERVER]
    return server == NONE or (m[core + C_MASK] >> server) & 1 == 1


@compiled
def _goes_before(m, thread, other):
    if m[thread + T_RANK] != m[other + T_RANK]:
        return m[thread + T_RANK] < m[other + T_RANK]
    return m[thread + T_SEQUENCE] < m[other + T_SEQUENCE]


@compiled
def _switch(m, core, thread):
    before = m[core + C_RUNNING]
    runnable, row = 0, NONE
    if before != NONE:
        row = m[before + T_ROW]
        if m[before + T_RUNNABLE] == 1:
            m[before + T_PREEMPTED] = 1
            runnable = 1
    if m[X_SWITCHES] == 1:
        log(m, L_SWITCH, thread, ((core - m[X_CORES]) // CORE_COLUMNS, row, runnable))
    m[core + C_RUNNING] = thread
    if thread == NONE:
        return
    if m[thread + T_PREEMPTED] == 1:
        m[thread + T_LEFT] += m[X_PREEMPTION_COST]
        m[thread + T_PREEMPTED] = 0
    if thread != m[core + C_LAST]:
        m[thread + T_LEFT] += m[X_SWITCH_COST]
    m[core + C_LAST] = thread
    m[core + C_SINCE] = m[X_NOW]
    m[core + C_QUANTUM] = m[X_QUANTUM]
