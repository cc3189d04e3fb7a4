"""Carrying out a plan on a running application: the function behind `chainshaper apply`.

    find the threads ─► priorities and cores ─► servers ─► anchor ─► arm ─► watch ─► all as before

Every change stands in a journal first (:mod:`chainshaper.enforcement.journal`): whatever ends the
run puts it back. Servers are armed only when all nodes run, and released before a command of ours
is to end, since a stopped thread cannot. A thread that appears later gets what the plan says at the
next look.
"""

import os
import subprocess
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from chainshaper.enforcement import undoing
from chainshaper.enforcement.back_ends import Choice, choose_back_end, make_back_end
from chainshaper.enforcement.freezer import groups_of, run_of
from chainshaper.enforcement.guardian import Guardians, put_back
from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.node_threads import IN_ORDER
from chainshaper.enforcement.scheduling_memory import look_alikes
from chainshaper.enforcement.servers import BackEnd
from chainshaper.enforcement.thread_scheduling import left_reservations, waiting_receivers
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.followed_chains import followed_chains
from chainshaper.flow.in_step import loops_in_step
from chainshaper.flow.plan_checks import (
    check_publishers,
    refuse_other_clocks,
    refuse_simulated,
    refuse_unfit,
)
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.followers import Followers
from chainshaper.flow.plan_in_force.loops import LoopsInStep
from chainshaper.flow.plan_in_force.origins import OriginWatches
from chainshaper.flow.plan_in_force.phases import PhaseMessages
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.flow.plan_in_force.supervision import Supervision
from chainshaper.flow.plan_in_force.threads import (
    RunThreads,
    assign_threads,
    await_nodes,
    note_absent,
    note_strangers,
)
from chainshaper.flow.recorded_processes import evidence_of, recorded_in
from chainshaper.flow.server_tables import server_table
from chainshaper.linux.child_processes import end_command, start_command
from chainshaper.linux.processes import run_users
from chainshaper.linux.scheduling import check_cores
from chainshaper.planning.offsets import LEAD_NS, chain_name
from chainshaper.planning.overruns import publication_warnings
from chainshaper.planning.plan import Plan
from chainshaper.splicing.shaped_outputs import gates_of, remove_abandoned_pages
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.progress import Progress

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


START_NS = 30_000_000_000  # for a command to start all nodes of the plan


@dataclass(frozen=True)
class Applied:
    """How a run ended: its last state, and the exit code of the command (None: there was none)."""

    state: RunState
    exit_code: int | None


def apply_plan(
    plan: Plan,
    command: Sequence[str] = (),
    *,
    command_stdout: int | None = None,
    back_end: str = "auto",
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    adapt: bool = False,
    max_latency_ns: int | None = None,
    wait_ns: int | None = None,
    users: Collection[str | int] = (),
    plan_path: str = "",
    folder: Path | None = None,
    stop: threading.Event | None = None,
    watch: Callable[[RunState], None] = lambda _: None,
    progress: Progress = lambda *_: None,
) -> Applied:
    """Put a plan in force until ``stop`` is set, the command or the application ends, or it fails.

    ``command`` is started first (its output goes to ``command_stdout``); without one, the
    application runs already. Its nodes have ``wait_ns`` to appear (default: 30 s with a command,
    else none). ``phase_ns`` is where in a cycle the first chain's timer expires, on CLOCK_MONOTONIC
    (None: those of all chains are measured). With ``adapt`` slots follow the latencies, to no later
    end than ``max_latency_ns`` (None: as the plan says). Where the plan has a loop in step, the
    output's slots, or the loop, are moved so that they are, and a command is started beneath the
    library that sees how loops sleep. ``recording`` is one of the very processes, or of an earlier
    run (None: those that the plan names); ``users`` are as for
    :func:`.find_threads`. ``watch`` gets the state every second; ``folder`` is where runs stand
    (default: `/run/chainshaper`).

    Raises InputError: no such user, or the plan cannot be carried out. PlatformError: the machine
    lacks a core or the back end, or we a privilege. OperationError: another run governs a core or
    node, a node does not appear, a chain has no regular beginning, the kernel refuses something,
    the servers failed, the application ended, or ``stop`` was set before the plan was in force.
    """
    user_ids = run_users(users)
    server_table(plan)
    check_cores({server.core: f"server {server.name}" for server in plan.servers})
    choice = choose_back_end(back_end)
    refuse_unfit(plan, choice.name)
    plan, reaches_ns, why_not = _followed(plan, choice.name, max_latency_ns, adapt=adapt)
    # Looked up once: that takes longer than looking at processes.
    recordings, unread = evidence_of(plan, recording)
    recorded, unread = recorded_in(recordings, unread)
    stop = stop or threading.Event()

    def go_on() -> None:
        if stop.is_set():
            raise OperationError("the run was asked to end before the plan was in force")

    journal = _claim(plan, folder, go_on)
    run = _Run(journal)
    run_threads = RunThreads(journal, recorded, user_ids, unread)
    anchored = AnchoredPlan(plan, plan, choice.name)
    if wait_ns is None:
        wait_ns = START_NS if command else 0
    try:
        run.guardians = Guardians(journal)
        if command:
            in_front = _in_front_of_loops(plan)
            run.command = start_command(command, in_front, stdout=command_stdout)
        await_nodes(
            run_threads,
            plan,
            wait_ns,
            command=run.command,
            stop=stop,
            go_on=go_on,
            progress=progress,
        )
        run.guardians.await_ready(go_on)
        notes = _schedule(run_threads, plan, choice.name, recordings)
        report = _begin_report(journal, choice, plan, command, plan_path)
        note_strangers(report, run_threads.latest)
        note_absent(report, plan, run_threads.latest, run_threads.unread)
        report.note(*notes, *(note for note in run_threads.latest.notes if note.endswith(IN_ORDER)))
        _find_anchor(anchored, run_threads, report, phase_ns, go_on=go_on, progress=progress)
        table = server_table(anchored.plan)
        servers = run.servers = make_back_end(choice.name, table, journal, go_on)
        followers = run.followers = Followers(anchored, servers)
        supervision = Supervision(
            anchored=anchored,
            threads=run_threads,
            report=report,
            phases=run.phases,
            followers=followers,
            loops=run.loops,
            origins=run.origins,
            servers=servers,
            stop=stop,
            go_on=go_on,
            command=run.command,
            guardians=run.guardians,
        )
        _arm(supervision, progress)
        report.note(*why_not)
        _await_gates(supervision, reaches_ns, wait_ns, progress)
        followers.start(run_threads.latest, reaches_ns)
        run.loops.start(anchored, run_threads.latest)
        supervision.watch_over(watch)
        strangers = look_alikes(journal, groups_of(run_of(journal)))
    finally:
        run.put_back()
    if report.state.failure is not None:
        ending = "; ".join(("everything is as it was before", *strangers))
        raise OperationError(f"{report.state.failure}; {ending}")
    report.note(*strangers)
    return Applied(report.state, run.command.returncode if run.command else None)


def _followed(
    plan: Plan, back_end: str, max_latency_ns: int | None, *, adapt: bool
) -> tuple[Plan, dict[int, tuple[int, int]], list[str]]:
    """Find which chains' slots follow their latencies: none without ``adapt``.

    Returns as :func:`.followed_chains`. Raises InputError: no slot can, or one is in step.
    """
    loops_in_step(plan, adapt)
    return followed_chains(plan, back_end, max_latency_ns) if adapt else (plan, {}, [])


def _in_front_of_loops(plan: Plan) -> dict[str, str]:
    """Return the variables by which what we start can be seen to sleep, and be moved.

    Empty: no loop of the plan is in step with an output; or the library cannot be in front, and
    outputs alone are moved: then wake-ups of the loops are counted from outside.

    Raises PlatformError: the library cannot be in front, and a loop is to be moved.
    """
    loops = [loop for _, _, loop in loops_in_step(plan)]
    if not loops:
        return {}
    from chainshaper.sources.preload import named_loops

    before = os.environ.get(named_loops.VARIABLE, "").split(",")
    names = dict.fromkeys(filter(None, [*before, *(loop.node for loop in loops)]))
    try:
        return named_loops.in_front_of(list(names))
    except PlatformError:
        if any(loop.in_step == "loop" or loop.thread is None for loop in loops):
            raise
        return {}


@dataclass
class _Run:
    """What a run has begun, and is to be ended while a plan is put out of force."""

    journal: Journal
    guardians: Guardians | None = None
    command: subprocess.Popen[bytes] | None = None
    servers: BackEnd | None = None
    followers: Followers | None = None
    loops: LoopsInStep = field(default_factory=LoopsInStep)
    phases: PhaseMessages = field(default_factory=PhaseMessages)
    origins: OriginWatches = field(default_factory=OriginWatches)

    def put_back(self) -> None:
        """Put everything back: first let all threads go, then end our command, then the rest."""
        problems: list[str] = []
        self.origins.end()
        self.loops.end()
        if self.followers is not None:
            self.followers.end()
        if self.servers is not None:
            try:
                self.servers.release()
            except OperationError as error:
                problems.append(str(error))
        self.phases.end()
        if self.command is not None:
            end_command(self.command)
        if self.command is not None or self.followers is not None:
            remove_abandoned_pages()  # what a follower had open its own run has left
        put_back(self.journal, self.guardians, problems)


def _claim(plan: Plan, folder: Path | None, go_on: Callable[[], None]) -> Journal:
    """Begin a run that governs the plan's cores and nodes. Raises: as :func:`.claim_run`."""
    cores = {server.core for server in plan.servers}
    nodes = {thread.node for server in plan.servers for thread in server.threads}
    nodes.update(receiver for node in plan.shaping_nodes for receiver in node.receivers)
    return undoing.claim_run(cores, nodes, folder, go_on)


def _schedule(
    run_threads: RunThreads, plan: Plan, back_end: str, recordings: "Sequence[Recording]"
) -> list[str]:
    """Give the threads their priorities and cores, unless the plan does not fit them.

    Returns what a person must know. Raises InputError, PlatformError: it does not fit.
    """
    refuse_simulated(plan, run_threads.latest)
    refuse_other_clocks(plan, run_threads.latest)
    notes = check_publishers(plan, run_threads.latest, recordings)
    wanted = run_threads.schedule(plan, back_end)
    return notes + waiting_receivers(plan, wanted) + left_reservations(wanted)


def _begin_report(
    journal: Journal, choice: Choice, plan: Plan, command: Sequence[str], plan_path: str
) -> RunReport:
    """Begin to show a run, before its slots count."""
    folder = journal.path.parent
    state = RunState(
        run=folder.name,
        owner=os.getpid(),
        plan=plan_path,
        command=tuple(command),
        back_end=choice.name,
        reason=choice.reason,
        started_ns=time.monotonic_ns(),
        cycle_ns=plan.cycle_ns,
        notes=tuple(note for chain in plan.chains for note in publication_warnings(chain)),
    )
    return RunReport(folder, state)


def _find_anchor(
    anchored: AnchoredPlan,
    run_threads: RunThreads,
    report: RunReport,
    phase_ns: int | None,
    *,
    go_on: Callable[[], None],
    progress: Progress,
) -> None:
    """Measure where chains begin, see from when on their slots count, and show the servers."""

    def measured(share: float) -> None:
        go_on()
        progress(share, "measuring where in a cycle the chain begins")

    phases = anchored.measure(run_threads.latest, phase_ns, measured)
    for chain, phase in zip(anchored.given.chains, phases, strict=False):
        if phase.spread_ns > LEAD_NS:
            report.note(
                f"the beginning of {chain_name(chain)} varies by"
                f" {duration_text(phase.spread_ns)} from cycle to cycle: it is started by"
                " something less regular than a timer"
            )
    if phases:
        spread_ns = max(phase.spread_ns for phase in phases)
        report.state = replace(report.state, phase_spread_ns=spread_ns)
    elif anchored.gated:
        report.note("slots stay where --phase puts them, also when the chain's timer drifts")
    report.state = replace(report.state, servers=anchored.server_states())


def _arm(run: Supervision, progress: Progress) -> None:
    """Tell shaping nodes where cycles begin, put the threads into the servers, close these."""
    anchored, servers = run.anchored, run.servers
    anchor_ns, cycle_ns = anchored.anchor_ns, anchored.plan.cycle_ns
    run.phases.send(
        anchored, run.threads.latest, dict.fromkeys(range(len(anchored.plan.chains)), 0)
    )
    while not run.end_messages():
        if run.stop.wait(0.05) or run.command_has_ended:
            break
        progress(1.0, "telling shaping nodes where cycles begin")
    assign_threads(run.threads, anchored, servers, run.report, run.go_on)
    servers.arm(anchor_ns)
    since_ns = servers.in_force_from() or time.monotonic_ns()
    anchored.save(run.report.folder)
    in_force_ns = since_ns + (anchor_ns - since_ns) % cycle_ns
    run.report.state = replace(run.report.state, anchor_ns=anchor_ns, in_force_ns=in_force_ns)


def _await_gates(
    run: Supervision, reaches_ns: Mapping[int, tuple[int, int]], wait_ns: int, progress: Progress
) -> None:
    """Wait until the outputs whose slots are to be moved have gates, for this long at most.

    A shaping node runs before it has a gate: that comes when it has found a publisher.
    """
    places = {*reaches_ns, *(place for place, *_ in loops_in_step(run.anchored.given))}
    chains = [run.anchored.given.chains[place] for place in sorted(places)]
    outputs = [chain.shaping_node.output for chain in chains if chain.shaping_node is not None]
    begun = time.monotonic_ns()
    while outputs:
        listed = run.threads.find(run.anchored.given).threads
        pids = {each.thread.pid for each in listed}
        outputs = [output for output in outputs if not gates_of(output, pids)]
        waited = time.monotonic_ns() - begun
        if waited >= wait_ns or run.command_has_ended or not outputs:
            return
        progress(min(1.0, waited / wait_ns), f"waiting for the gate of {outputs[0]}")
        run.stop.wait(0.1)
        run.go_on()
