"""Carrying out a plan on a running application: the function behind `chainshaper apply`.

    find the threads ─► priorities and cores ─► servers ─► anchor ─► arm ─► watch ─► all as before

Nothing of the application is changed but where and when its threads run, and everything that is
changed stands in a journal first (:mod:`chainshaper.enforcement.runs.journal`): whatever ends
the run, this function, a signal or a crash, puts it back. Servers are armed only when all nodes
run, and released before a command of ours is told to end, since a stopped thread cannot.

The shaping node is its own server: it holds messages back by itself, so its thread gets a
priority and a core, and no slots from a back end.
"""

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from chainshaper.command_process import end_command, start_command
from chainshaper.dry_run import LEAD_NS, first_thread, server_table
from chainshaper.durations import format_duration
from chainshaper.enforcement.back_ends import Choice, choose_back_end, gates, make_back_end
from chainshaper.enforcement.phase import DriftWatch, measure_phase
from chainshaper.enforcement.realtime import available_cores, check_cores
from chainshaper.enforcement.runs.claims import claim_run
from chainshaper.enforcement.runs.journal import Journal
from chainshaper.enforcement.runs.release_after import start_watching
from chainshaper.enforcement.runs.scheduling_memory import change_scheduling, restore_scheduling
from chainshaper.enforcement.runs.state import RunState, ServerState, remove_run, save_run_state
from chainshaper.enforcement.servers import BackEnd, ServerCounters, ServerTable
from chainshaper.enforcement.threads.allocation import Allocation, RecordedProcess, new_and_ended
from chainshaper.enforcement.threads.server_threads import (
    left_by_back_end,
    plan_scheduling,
    server_members,
)
from chainshaper.errors import OperationError
from chainshaper.planning import Plan
from chainshaper.planning.plan import shaping_nodes
from chainshaper.planning.publication import publication_warnings
from chainshaper.recording import Recording
from chainshaper.shaping_phase import NOBODY, Telling, moved_text, tell_phase
from chainshaper.thread_search import find_threads

__all__ = ["Applied", "apply_plan"]

START_NS = 30_000_000_000
"""A command has this long to start all nodes of the plan."""

PHASE_BOUND_NS = 250_000
"""Shaping nodes are told again where cycles begin when that has moved by more. Watching a thread
from outside tells nothing finer (:data:`chainshaper.enforcement.phase.POLL_NS`)."""

_LOOK_S = 1.0
_NOTHING = ServerCounters(None, None, None, None)


@dataclass(frozen=True)
class Applied:
    """How a run ended: its last state, and the exit code of the command (None: there was none)."""

    state: RunState
    exit_code: int | None


@dataclass
class _Run:
    """What there is to keep together, and to put back, while a plan is in force."""

    plan: Plan
    choice: Choice
    journal: Journal
    recorded: tuple[RecordedProcess, ...]
    stop: threading.Event
    watcher: subprocess.Popen[bytes] | None = None
    command: subprocess.Popen[bytes] | None = None
    servers: BackEnd | None = None
    telling: Telling = NOBODY

    @property
    def folder(self) -> Path:
        return self.journal.path.parent

    @property
    def command_ended(self) -> bool:
        return self.command is not None and self.command.poll() is not None


def apply_plan(
    plan: Plan,
    command: Sequence[str] = (),
    *,
    command_stdout: int | None = None,
    back_end: str = "auto",
    recording: Recording | None = None,
    phase_ns: int | None = None,
    wait_ns: int | None = None,
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
    given. ``recording`` is one of the very processes, if there is one. ``watch`` gets the state
    every second; ``folder`` is where runs keep what they need (default: `/run/chainshaper`).

    Raises:
        InputError: the plan names no threads, or its table is not one.
        PlatformError: the machine lacks a core or the back end, or we a privilege.
        OperationError: another run governs one of the cores or nodes, a node does not appear or
            is ambiguous, the chain has no regular beginning, the kernel refuses something, the
            servers failed while in force, or the application, not being our command, has ended.
    """
    table = server_table(plan)
    check_cores({server.core: f"server {server.name}" for server in plan.servers})
    choice = choose_back_end(back_end)
    nodes = {thread.node for server in plan.servers for thread in server.threads}
    nodes.update(receiver for node in shaping_nodes(plan) for receiver in node.receivers)
    recorded = _seen_in(recording)
    journal = claim_run({server.core for server in plan.servers}, nodes, folder)
    run = _Run(plan, choice, journal, recorded, stop or threading.Event())
    try:
        run.watcher = start_watching(run.folder)
        if command:
            run.command = start_command(command, stdout=command_stdout)
        if wait_ns is None:
            wait_ns = START_NS if command else 0
        found = _await_nodes(run, wait_ns, progress)
        _schedule(run, found)
        run.servers = make_back_end(choice.name, table, run.folder, journal)
        state = _initial_state(run, table, command, plan_path)
        state = _arm(run, run.servers, found, state, phase_ns, progress)
        state = _keep(run, run.servers, found, state, watch)
    finally:
        _put_back(run)
        if run.watcher is not None:
            run.watcher.kill()  # the journal is gone, so it has nothing to do
            run.watcher.wait()
    if state.failure is not None:
        raise OperationError(f"{state.failure}; everything is as it was before")
    return Applied(state, run.command.returncode if run.command else None)


def _seen_in(recording: Recording | None) -> tuple[RecordedProcess, ...]:
    """What a recording says about processes, looked up once: it takes longer than looking at them.

    Reading events is slow to import: only who has a recording pays for it.
    """
    if recording is None:
        return ()
    from chainshaper.recorded_threads import recorded_processes

    return recorded_processes(recording)[0]


def _await_nodes(run: _Run, wait_ns: int, progress: Callable[[float, str], None]) -> Allocation:
    """Look until all nodes of the plan run, and their threads have stopped becoming more."""
    begun, found = time.monotonic_ns(), find_threads(run.plan, recorded=run.recorded)
    while True:
        waited, complete = time.monotonic_ns() - begun, True
        try:
            server_members(run.plan, found)
        except OperationError:
            complete = False
            if run.command_ended and run.command is not None:
                raise OperationError(
                    f"the command ended with code {run.command.returncode} before all nodes of "
                    "the plan were running"
                ) from None
            if run.stop.is_set() or waited >= wait_ns:
                raise
        progress(min(1.0, waited / max(1, wait_ns)), "finding the nodes")
        if wait_ns:
            run.stop.wait(_LOOK_S)
        now = find_threads(run.plan, recorded=run.recorded)
        if complete and not any(new_and_ended(found, now)):
            return now
        found = now


def _schedule(run: _Run, found: Allocation) -> None:
    """Give threads their priorities and cores, as far as the back end leaves that to us."""
    wanted = plan_scheduling(run.plan, found, available_cores())
    for one in left_by_back_end(run.choice.name, wanted):
        if one.server is None or run.choice.name != "fifo":  # that is all the latter does
            change_scheduling(run.journal, one.thread.thread, one.wanted)


def _initial_state(
    run: _Run, table: ServerTable, command: Sequence[str], plan_path: str
) -> RunState:
    gated = {server.name for server in table.servers}
    keeper = run.choice.name if gates(run.choice.name) else "nobody: priority only"
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
            ServerState(
                server.name,
                server.core,
                server.priority,
                server.slots,
                (),
                keeper if server.name in gated else "gate",
                _NOTHING,
            )
            for server in run.plan.servers
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
        phase = measure_phase(
            *(origin.pid, origin.tid, run.plan.cycle_ns),
            progress=lambda share: progress(share, "measuring where in a cycle the chain begins"),
        )
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
    threads = _assign(run.plan, found, servers, {server.name: () for server in run.plan.servers})
    servers.arm(anchor)
    return replace(
        _with_threads(state, threads), anchor_ns=anchor, phase_spread_ns=spread, notes=notes
    )


def _assign(
    plan: Plan, found: Allocation, servers: BackEnd, already: dict[str, tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Put the threads that are not in their servers yet there; the threads of each server."""
    themselves = {node.thread.node for node in shaping_nodes(plan)}
    threads = {}
    for name, members in server_members(plan, found).items():
        for member in members:
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
    told_ns, notes = 0, state.notes
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
        save_run_state(run.folder, state)
        watch(state)
        if state.failure is not None or is_over:
            return state
        moved_ns = drifted_ns or 0
        if abs(moved_ns - told_ns) > PHASE_BOUND_NS and run.telling is NOBODY:
            told_ns, run.telling = moved_ns, tell_phase(run.plan, found, begins + moved_ns)
            state = replace(state, notes=(*notes, moved_text(moved_ns)))
        if run.stop.wait(_LOOK_S):
            continue
        if run.watcher is not None and run.watcher.poll() is not None:  # somebody killed it
            run.watcher = start_watching(run.folder)
        now = find_threads(run.plan, recorded=run.recorded)
        new, _ = new_and_ended(found, now)
        state = _with_threads(state, _living(now, state))
        with contextlib.suppress(OperationError):  # a node is on its way up: at the next look
            if new:
                state = _taken_in(run, servers, now, state)
            found = now


def _told(run: _Run) -> tuple[str, ...]:
    """What went wrong with telling the shaping nodes, once that is over."""
    if not run.telling.is_over():
        return ()
    telling, run.telling = run.telling, NOBODY
    return telling.end()


def _failure(run: _Run, servers: BackEnd, state: RunState) -> str | None:
    """Why the plan is no longer in force: the back end, or nobody is left to govern."""
    reason = servers.failure()
    if reason is not None:
        return f"the servers failed: {reason}"
    # What we have started ends by itself, and has perhaps still to write down what it saw; and
    # somebody may have ended both the application and us.
    if (
        run.command is None
        and not run.stop.is_set()
        and not any(one.threads for one in state.servers)
    ):
        return "the application has ended: no thread of the plan's nodes is left"
    return None


def _living(found: Allocation, state: RunState) -> dict[str, tuple[int, ...]]:
    """The threads of each server that have not ended."""
    there = {one.thread.tid for one in found.threads}
    return {one.name: tuple(tid for tid in one.threads if tid in there) for one in state.servers}


def _taken_in(run: _Run, servers: BackEnd, found: Allocation, state: RunState) -> RunState:
    """Threads that appeared later get what the plan says.

    Raises:
        OperationError: not all nodes are there, or a thread has ended again.
    """
    already = {one.name: one.threads for one in state.servers}
    _schedule(run, found)
    return _with_threads(state, _assign(run.plan, found, servers, already))


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
    problems += [
        f"{one.tid} ({one.comm}): {one.reason}"
        for one in restore_scheduling(run.journal)
        if one.fate == "failed"
    ]
    if problems:
        raise OperationError(
            f"not everything could be put back: {'; '.join(problems)}; {run.journal.path} says "
            "what was there, `chainshaper release` tries again"
        )
    remove_run(run.journal)
