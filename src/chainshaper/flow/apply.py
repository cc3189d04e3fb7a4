"""Carrying out a plan on a running application: the function behind `chainshaper apply`.

    find the threads ─► priorities and cores ─► servers ─► anchor ─► arm ─► watch ─► all as before

Nothing of the application is changed but where and when its threads run, and every change stands in
a journal first (:mod:`chainshaper.linux.runs`): whatever ends the run, this function, a signal or a
crash, puts it back. Servers are armed only when all nodes run, and released before a command of
ours is to end, since a stopped thread cannot.

A thread that appears later gets what the plan says, at the next look; until then it has the class,
cores and cgroup of the thread that started it. The shaping node is its own server: its thread gets
a priority and a core, and no slots from a back end.
"""

import contextlib
import os
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from chainshaper.enforcement import threads as allocation
from chainshaper.enforcement.back_ends import Choice, choose_back_end, gates, make_back_end
from chainshaper.enforcement.guardian import Guardians, run_claimed, start_guardians
from chainshaper.enforcement.scheduling_memory import change_all, look_alikes, note_descendants
from chainshaper.enforcement.servers import (
    BackEnd,
    ServerCounters,
    ServerTable,
)
from chainshaper.enforcement.threads import Allocation, NodeThread, RecordedProcess, server_members
from chainshaper.enforcement.undoing import (
    RunState,
    ServerState,
    claim_run,
    save_run_state,
    strange_lines,
    undo_run,
)
from chainshaper.flow.phase import (
    NO_NODE,
    DriftWatch,
    Telling,
    measure_phase,
    moved_text,
    tell_phase,
)
from chainshaper.flow.threads import LEAD_NS, find_threads, first_thread, server_table, table_of
from chainshaper.linux.own_processes import end_command, start_command
from chainshaper.linux.processes import run_users
from chainshaper.linux.runs import PLAN_FILE, Journal
from chainshaper.linux.scheduling import available_cores, check_cores
from chainshaper.linux.threads import list_threads
from chainshaper.planning.overruns import (
    open_until_done,
    publication_warnings,
    refuse_offset,
)
from chainshaper.planning.plan import Plan, publisher_servers, shaping_nodes
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import
    from chainshaper.workload.live import StartedNodes


START_NS = 30_000_000_000
"""A command has this long to start all nodes of the plan."""

PHASE_BOUND_NS = 250_000
"""Shaping nodes get the beginning of cycles again when it has moved by more. Watching a thread from
outside shows nothing finer (:data:`.phase.POLL_NS`)."""

_LOOK_S = 1.0
_SETTLING_LOOKS = 3
"""Nodes that have just started go on to start threads for a while; some never stop."""
_FLEETING = 3
"""So many threads of a process that a look finds, and the next does not, are worth a note."""
_NOTHING = ServerCounters()


@dataclass(frozen=True)
class Applied:
    """How a run ended: its last state, and the exit code of the command (None: there was none)."""

    state: RunState
    exit_code: int | None


@dataclass
class _Run:
    """What belongs together, and is to be put back, while a plan is in force."""

    given: Plan
    plan: Plan  # as it is carried out: with room for overruns
    choice: Choice
    journal: Journal
    recorded: tuple[RecordedProcess, ...]
    users: frozenset[int]
    stop: threading.Event
    guardians: Guardians | None = None
    command: subprocess.Popen[bytes] | None = None
    servers: BackEnd | None = None
    telling: Telling = NO_NODE

    @property
    def folder(self) -> Path:
        return self.journal.path.parent

    def go_on(self) -> None:
        """See whether the run is to come into force still. Raises OperationError: it is to end."""
        _go_on(self.stop)

    @property
    def command_ended(self) -> bool:
        return self.command is not None and self.command.poll() is not None


def apply_plan(
    plan: Plan,
    command: Sequence[str] = (),
    *,
    command_stdout: int | None = None,
    back_end: str = "auto",
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    wait_ns: int | None = None,
    users: Collection[str | int] = (),
    plan_path: str = "",
    folder: Path | None = None,
    stop: threading.Event | None = None,
    watch: Callable[[RunState], None] = lambda _: None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Applied:
    """Put a plan in force until ``stop`` is set, the command or the application ends, or it fails.

    ``command`` is started first, with ``command_stdout`` as its output if that is not ours;
    without one, the application runs already. Its nodes have
    ``wait_ns`` to appear (default: 30 s with a command, else none). ``phase_ns`` is where in a
    cycle the chain's first timer expires, on CLOCK_MONOTONIC; it is measured where it is not
    given. ``recording`` is one of the very processes, if there is one. Only processes of ``users``
    (names or numbers; default: who launched us, and root) are taken for nodes of the plan, now and
    later. ``watch`` gets the state every second; ``folder`` is where runs keep what they need
    (default: `/run/chainshaper`).

    Raises:
        InputError: the plan names no threads, its table is not one, or it has an offset; or there
            is no such user.
        PlatformError: the machine lacks a core or the back end, or we a privilege.
        OperationError: another run governs one of the cores or nodes, a node does not appear or
            is ambiguous, the chain has no regular beginning, the kernel refuses something, the
            servers failed while in force, or the application, not being our command, has ended;
            or ``stop`` was set before the plan was in force.
    """
    refuse_offset(plan)
    given, plan = plan, open_until_done(plan)
    table, taken = server_table(plan), run_users(users)
    check_cores({server.core: f"server {server.name}" for server in plan.servers})
    choice = choose_back_end(back_end)
    nodes = {thread.node for server in plan.servers for thread in server.threads}
    nodes.update(receiver for node in shaping_nodes(plan) for receiver in node.receivers)
    recorded, asked = _seen_in(recording), stop or threading.Event()
    cores = {server.core for server in plan.servers}
    journal = claim_run(cores, nodes, folder, lambda: _go_on(asked))
    run = _Run(given, plan, choice, journal, recorded, taken, asked)
    try:
        run.guardians = start_guardians(journal)
        if command:
            run.command = start_command(command, stdout=command_stdout)
        if wait_ns is None:
            wait_ns = START_NS if command else 0
        found = _await_nodes(run, wait_ns, progress)
        run.guardians.await_ready(run.go_on)
        _schedule(run, found)
        run.servers = make_back_end(choice.name, table, journal, run.go_on)
        state = _naming_strangers(_initial_state(run, table, command, plan_path), found)
        state = _arm(run, run.servers, found, state, phase_ns, progress)
        state = _keep(run, run.servers, found, state, watch)
        strangers = look_alikes(journal)
    finally:
        _put_back(run)
    if state.failure is not None:
        ending = "; ".join(("everything is as it was before", *strangers))
        raise OperationError(f"{state.failure}; {ending}")
    state = replace(state, notes=(*state.notes, *strangers))
    return Applied(state, run.command.returncode if run.command else None)


def _go_on(stop: threading.Event) -> None:
    if stop.is_set():
        raise OperationError("the run was asked to end before the plan was in force")


def _seen_in(recording: "Recording | None") -> tuple[RecordedProcess, ...]:
    """What a recording says about processes, looked up once: it takes longer than looking at them.

    Reading events is slow to import: only who has a recording pays for it.
    """
    if recording is None:
        return ()
    from chainshaper.flow.recorded_threads import recorded_processes

    return recorded_processes(recording)[0]


def _find(run: _Run) -> Allocation:
    return find_threads(run.plan, recorded=run.recorded, users=run.users)


def _await_nodes(run: _Run, wait_ns: int, progress: Callable[[float, str], None]) -> Allocation:
    """Look until all nodes of the plan run; where there is time, a little for those that start."""
    begun, looks, found = time.monotonic_ns(), 0, None
    while True:
        run.go_on()
        now = _find(run)
        waited = time.monotonic_ns() - begun
        try:
            server_members(run.plan, now)
            looks += 1
        except OperationError:
            looks = 0
            if run.command_ended and run.command is not None:
                raise OperationError(
                    f"the command ended with code {run.command.returncode} before all nodes of "
                    "the plan were running"
                ) from None
            if waited >= wait_ns:
                raise
        quiet = found is not None and not any(allocation.new_and_ended(found, now))
        if looks and (quiet or looks > _SETTLING_LOOKS or waited >= wait_ns):
            return now
        found = now
        progress(min(1.0, waited / wait_ns), "finding the nodes")
        run.stop.wait(min(_LOOK_S, (wait_ns - waited) / 1e9))


def _schedule(run: _Run, found: Allocation) -> None:
    """Give threads their priorities and cores, as far as the back end leaves that to us."""
    wanted = allocation.plan_scheduling(run.plan, found, available_cores())
    changes = (
        (one.thread.thread, one.wanted)
        for one in allocation.left_by_back_end(run.choice.name, wanted)
        if one.server is None or run.choice.name != "fifo"  # that is all the latter does
    )
    change_all(run.journal, changes)


def _initial_state(
    run: _Run, table: ServerTable, command: Sequence[str], plan_path: str
) -> RunState:
    keeper = run.choice.name if gates(run.choice.name) else "none: priority only"
    kept_by = {server.name: "gate" for server in run.plan.servers}
    kept_by |= {server.name: keeper for server in table.servers}
    return RunState(
        run=run.folder.name,
        owner=os.getpid(),
        plan=plan_path,
        command=tuple(command),
        back_end=run.choice.name,
        reason=run.choice.reason,
        started_ns=time.monotonic_ns(),
        cycle_ns=run.plan.cycle_ns,
        anchor_ns=None,
        phase_spread_ns=None,
        drift_ns=None,
        servers=tuple(
            ServerState(s.name, s.core, s.priority, s.slots, (), kept_by[s.name], _NOTHING)
            for s in run.plan.servers
        ),
        notes=tuple(publication_warnings(run.plan)),
        failure=None,
    )


def _arm(  # noqa: PLR0917 - the parts of a run, each used once
    run: _Run,
    servers: BackEnd,
    found: Allocation,
    state: RunState,
    phase_ns: int | None,
    progress: Callable[[float, str], None],
) -> RunState:
    """Measure where the chain begins, put its threads into the servers, and close these."""
    notes, spread = state.notes, None
    if phase_ns is None:
        origin = first_thread(run.plan, found)

        def measured(share: float) -> None:
            run.go_on()
            progress(share, "measuring where in a cycle the chain begins")

        phase = measure_phase(origin.pid, origin.tid, run.plan.cycle_ns, progress=measured)
        phase_ns, spread = phase.at_ns, phase.spread_ns
        if spread > LEAD_NS:
            notes += (
                f"the chain's beginning varies by {format_duration(spread)} from cycle to cycle: "
                "it is started by something less regular than a timer",
            )
    anchor = (phase_ns + LEAD_NS) % run.plan.cycle_ns
    # Held back by a server, the chain begins as its slot opens, otherwise with its timer.
    run.telling = tell_phase(run.plan, found, anchor if gates(run.choice.name) else phase_ns)
    while not (run.telling.is_over() or run.stop.wait(0.05) or run.command_ended):
        progress(1.0, "telling shaping nodes where cycles begin")
    notes += _told(run)
    threads = _assign(run, found, servers, {server.name: () for server in run.plan.servers})
    servers.arm(anchor)
    since = servers.in_force_from() or time.monotonic_ns()
    with contextlib.suppress(OSError):  # a full /run ends no plan; recordings lack it then
        (run.folder / PLAN_FILE).write_text(run.given.model_dump_json())
    return replace(
        _with_threads(state, threads),
        anchor_ns=anchor,
        phase_spread_ns=spread,
        notes=notes,
        in_force_ns=since + (anchor - since) % run.plan.cycle_ns,
    )


def _assign(
    run: _Run, found: Allocation, servers: BackEnd, already: dict[str, tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Put the threads that are not in their servers yet there; the threads of each server."""
    themselves = {node.thread.node for node in shaping_nodes(run.plan)}
    threads = {}
    for name, members in server_members(run.plan, found).items():
        for member in members:
            run.go_on()
            tid = member.thread.tid
            if tid not in already[name] and themselves.isdisjoint(member.nodes):
                servers.assign(tid, name)
        threads[name] = tuple(member.thread.tid for member in members)
    return threads


def _with_threads(state: RunState, threads: dict[str, tuple[int, ...]]) -> RunState:
    return replace(
        state, servers=tuple(replace(one, threads=threads[one.name]) for one in state.servers)
    )


def _keep(
    run: _Run,
    servers: BackEnd,
    found: Allocation,
    state: RunState,
    watch: Callable[[RunState], None],
) -> RunState:
    """Watch over the run until it is to end; the state as it was last."""
    origin, gated = first_thread(run.plan, found), gates(run.choice.name)
    begins = (state.anchor_ns or 0) - (0 if gated else LEAD_NS)
    slots = next((s.slots for s in state.servers if gated and origin.tid in s.threads), ())
    drift = DriftWatch(
        *(origin.pid, origin.tid, run.plan.cycle_ns, begins, slots),
        cores=set(available_cores()) - {server.core for server in run.plan.servers},
    )
    sent_ns, notes = 0, state.notes
    latest: tuple[NodeThread, ...] = ()
    unsaved = untaken = ""
    while True:
        is_over = run.command_ended or run.stop.is_set()
        counters = servers.counters()
        state = replace(
            state,
            servers=tuple(
                replace(one, counters=counters.get(one.name, _NOTHING)) for one in state.servers
            ),
            drift_ns=(drifted_ns := drift.latest_ns),
            failure=_failure(run, servers, state),
            notes=(*state.notes, *_told(run)),
        )
        trouble = tuple(filter(None, (unsaved, untaken)))
        if state.failure is not None or is_over:
            state = replace(state, ended_ns=time.monotonic_ns())
        shown = replace(state, notes=(*state.notes, *trouble))  # for as long as it lasts
        unsaved = _saved(run, shown)
        watch(shown)
        if state.failure is not None or is_over:
            return shown
        moved_ns = drifted_ns or 0
        if abs(moved_ns - sent_ns) > PHASE_BOUND_NS and run.telling is NO_NODE:
            sent_ns, run.telling = moved_ns, tell_phase(run.plan, found, begins + moved_ns)
            state = replace(state, notes=(*notes, moved_text(moved_ns)))
        if run.stop.wait(_LOOK_S):
            continue
        if run.guardians is not None:
            run.guardians.renew()
        found, state, latest, untaken = _look_again(run, servers, found, state, latest)


def _look_again(
    run: _Run,
    servers: BackEnd,
    before: Allocation,
    state: RunState,
    latest: tuple[NodeThread, ...],
) -> tuple[Allocation, RunState, tuple[NodeThread, ...], str]:
    """Threads that have appeared get what the plan says; ``latest`` had when it was looked before.

    Returns the threads that are known now, the state, the new ones, and why these were not taken
    in, if so: a node is on its way up, perhaps.
    """
    now = _find(run)
    new, ended = allocation.new_and_ended(before, now)
    state = _naming_strangers(replace(state, notes=_with_fleeting(state.notes, latest, ended)), now)
    there = {one.thread.tid for one in now.threads}
    living = {s.name: tuple(t for t in s.threads if t in there) for s in state.servers}
    state = _with_threads(state, living)
    try:
        note_descendants(run.journal)
        if new:
            _schedule(run, now)
            state = _with_threads(state, _assign(run, now, servers, living))
    except OperationError as error:
        reason = f"threads that have appeared are as they were: {error}"
        return before, state, new, "" if run.stop.is_set() else reason
    return now, state, new, ""


def _naming_strangers(state: RunState, found: Allocation) -> RunState:
    """The state with one line about strangers who say they are nodes: the latest, if there is any.

    It replaces the one before, so that they cannot make it long by coming and going.
    """
    if found.strangers is None:
        return state
    others = (note for note in state.notes if not note.startswith(allocation.LEFT_ALONE))
    return replace(state, notes=(*others, found.strangers))


def _told(run: _Run) -> tuple[str, ...]:
    """What went wrong with telling the shaping nodes, once that is over."""
    if not run.telling.is_over():
        return ()
    telling, run.telling = run.telling, NO_NODE
    return telling.end()


def _failure(run: _Run, servers: BackEnd, state: RunState) -> str | None:
    """Why the plan is no longer in force: the back end, or no thread is left to govern."""
    reason = servers.failure()
    if reason is not None:
        return f"the servers failed: {reason}"
    # What we have started ends by itself, and has perhaps still to write down what it saw; and
    # a person may have ended both the application and us.
    if (
        run.command is None
        and not run.stop.is_set()
        and not any(one.threads for one in state.servers)
    ):
        return "the application has ended: no thread of the plan's nodes is left"
    return None


def _saved(run: _Run, state: RunState) -> str:
    """Show others the state; why they cannot see it, if so. The plan is in force all the same."""
    try:
        save_run_state(run.folder, state)
    except OSError as error:
        return f"{run.folder}: `status` cannot show how this run is doing ({error.strerror})"
    return ""


def _with_fleeting(
    notes: tuple[str, ...], latest: Sequence[NodeThread], ended: Sequence[NodeThread]
) -> tuple[str, ...]:
    """Notes with the processes whose threads come and go: what ended since it was new."""
    gone = {one.thread.identity for one in ended}
    counted = Counter(one.thread.pid for one in latest if one.thread.identity in gone)
    said = (
        f"threads of process {pid} come and go: each has the class, cores and cgroup of the "
        "thread that started it, and is left so"
        for pid, times in counted.items()
        if times >= _FLEETING
    )
    return tuple(dict.fromkeys((*notes, *said)))


def _put_back(run: _Run) -> None:
    """Everything as it was: first let all threads go, then end our command, then the rest."""
    problems: list[str] = []
    if run.servers is not None:
        try:
            run.servers.release()
        except OperationError as error:
            problems.append(str(error))
    run.telling.end()
    if run.command is not None:
        end_command(run.command)
    problems += undo_run(run.journal, by_owner=True)
    problems += strange_lines(run.journal)
    if run.guardians is not None:
        run.guardians.end()
    if problems:
        raise OperationError(
            f"not everything could be put back: {'; '.join(problems)}; {run.journal.path} says "
            "what was there, `chainshaper release` tries again"
        )


@contextlib.contextmanager
def publishers_gated(plan: Plan, nodes: "StartedNodes") -> Iterator[None]:
    """Inside, the publisher threads that a plan names run in the slots of their servers only.

    For the live workload (paper, section 3.2.1, design 1): its nodes are ours, so which process
    each is, and when cycles start, needs not be found or measured. Executors and DDS threads of
    the same processes run on.

    Raises:
        PlatformError: threads cannot be frozen here.
        OperationError: another run governs one of the cores or nodes, a node has no such thread,
            or the servers failed meanwhile.
    """
    choice = choose_back_end("freezer")  # the others want threads of the fair class
    planned = [(server, names) for _, server, names in publisher_servers(open_until_done(plan))]
    table = table_of(plan.cycle_ns, (server for server, _ in planned))
    cores = {server.core for server, _ in planned}
    with run_claimed(cores, {name for _, names in planned for name in names}) as journal:
        servers = make_back_end(choice.name, table, journal)
        try:
            for server, names in planned:
                for name in names:
                    for tid in _publisher_threads(name, nodes):
                        servers.assign(tid, server.name)
            servers.arm(nodes.anchor_ns)
            yield
            failure = servers.failure()
        finally:
            servers.release()
    if failure is not None:
        raise OperationError(f"the servers failed while the application ran: {failure}")


def _publisher_threads(node: str, nodes: "StartedNodes") -> list[int]:
    pid = nodes.pids.get(node)
    found = [t.tid for t in list_threads(pid) if t.role == "publisher"] if pid is not None else []
    if not found:
        raise OperationError(
            f"{node} has no thread that publishes for it: let it publish asynchronously "
            "(`publication: asynchronous` under `topics`), or plan with --publication synchronous"
        )
    return found
