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

from chainshaper.simulation import layout as at
from chainshaper.simulation.executor import advance, expire
from chainshaper.simulation.messages import deliver, wake
from chainshaper.simulation.queues import log, pop_event
from chainshaper.values.compiled.memory import compiled, table_at

__all__ = ["run"]


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
