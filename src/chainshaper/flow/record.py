"""Recording an application that is not ours: `chainshaper record`.

    tracing on ─► application starts ─► threads looked at, now and then ─► tracing off
                                        ─► types and QoS asked for ─► application ends ─► recording

Tracing begins first, because an object emits its name once, when it is created; types and QoS are
asked for when it is over: discovery costs every node some time.
"""

import platform
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeVar

from chainshaper.analysis.objects import resolve_objects
from chainshaper.enforcement.journal import Governed, governing, in_force_throughout
from chainshaper.enforcement.node_threads import allocate, strangers_text
from chainshaper.flow.exploration import with_trace_events
from chainshaper.flow.recorded_processes import recorded_processes
from chainshaper.linux import processes as running
from chainshaper.linux.child_processes import (
    check_command,
    end_command,
    end_in_words,
    start_command,
)
from chainshaper.linux.processes import RunningProcess, find_applications
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import parents
from chainshaper.planning import Plan
from chainshaper.planning.plan_file import plan_values
from chainshaper.sources import Tracer, ebpf, lttng, preload
from chainshaper.sources.ebpf.late_attachment import with_found_nodes
from chainshaper.sources.gate_log import releases_so_far, with_gate_logs
from chainshaper.sources.ros import Environment, ask_graph, environment_of
from chainshaper.sources.system import own_pid_namespace
from chainshaper.values import events
from chainshaper.values import recording as recordings
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, InputError, OperationError
from chainshaper.values.files import open_to_all, rename_output
from chainshaper.values.handed_over import Through
from chainshaper.values.leftovers import claimed, leftover_text, leftovers
from chainshaper.values.recording import EndpointInfo, Recording, ThreadInfo
from chainshaper.workload.stall_meter import StallWatch, far_from, stalls_watched

_T = TypeVar("_T")
Scheduling: TypeAlias = AbstractContextManager[Callable[[Sequence[RunningProcess]], bool]]
"""Changes how the application's threads run, until its context ends.

It yields a function that is called about once a second with the processes, and returns whether the
scheduling is in force from now on.
"""

TRACE_FOLDER = "trace"
SPARE_DISK = 64 << 20  # a run ends when its disk has no more (bytes): there is more to be written
_STEP_S = 0.1
_FIRST_LOOK_NS = 500_000_000
_LONGEST_UNTIL_IN_FORCE_NS = 180_000_000_000  # a dozen slow cycles are measured, up to five times
_LONGEST_PAUSE_NS = 5_000_000_000  # looking takes some ms: the longer a run lasts, the rarer it is


@dataclass(frozen=True)
class Recorded:
    """A recording, and the exit code of the command where it ended by itself."""

    recording: Recording
    exit_code: int | None


@dataclass
class _RecordedRun:
    """An application that is recorded, and what was seen of it."""

    tracer: Tracer
    folder: Path  # of the trace
    words: Sequence[str]  # of the command; none: it runs already
    duration_ns: int | None
    stop: threading.Event
    progress: Callable[[float, str], None]
    users: frozenset[int]  # whose processes are nodes
    pids: Sequence[int]  # of processes that stand for their descendants too; none: all that run
    gate_logs: Sequence[Path]
    notes: tuple[str, ...] = ()
    command: "subprocess.Popen[bytes] | None" = None
    # Schedules threads; returns whether the scheduling is in force.
    schedule: Callable[[Sequence[RunningProcess]], bool] | None = None
    begun_ns: int = 0  # CLOCK_MONOTONIC
    ended_ns: int = 0  # the same; 0: it has not ended
    processes: tuple[RunningProcess, ...] = ()  # at the last look
    strangers: str | None = None  # a line about other users' processes that may be nodes
    environment: Environment | None = None  # a node's
    endpoints: tuple[EndpointInfo, ...] = ()
    no_qos_because: str | None = "no process was seen that looks like a node"
    in_force_ns: int | None = None  # when the scheduling that was asked for was
    governed: tuple[Governed, ...] = ()  # plans that others put in force meanwhile
    stalls: StallWatch = field(default_factory=StallWatch)
    exit_code: int | None = None


def record_command(
    output: str | Path,
    command: Sequence[str] = (),
    *,
    source: str | None = None,
    duration_ns: int | None = None,
    pids: Sequence[int] = (),
    users: Collection[str | int] = (),
    buffer: int | None = None,
    chain: str | None = None,
    loops: Sequence[str] = (),
    through: Through = (),
    scheduling: Scheduling | None = None,
    plan: Plan | None = None,
    gate_logs: Sequence[Path] = (),
    watch_stalls: bool = False,
    ask_qos: bool = True,
    command_stdout: int | None = None,
    stop: threading.Event | None = None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Recorded:
    """Record an application until it ends, ``duration_ns`` are over, or ``stop`` is set.

    ``command`` is started, and ended with the recording; it prints to ``command_stdout``. Without
    one, `ebpf` and `preload` attach to ``pids`` and their descendants, or to all that ``users`` run
    (as :func:`.find_threads`). Without ``source`` it is `preload`, or `lttng` where there is no
    command, or a ``buffer`` (the size of LTTng's of a core, in bytes). ``loops`` are names of nodes
    and threads whose loops are recorded although they publish nothing (`preload` only). ``chain``
    is noted as the chain of interest, ``through`` as what is declared of it, ``plan`` as the plan
    in force; ``gate_logs`` are where its shaping nodes note what they do. ``watch_stalls`` watches
    every core for stalls (2 % of it).
    ``ask_qos`` has ROS 2 asked for types and QoS of topics, which takes it seconds.

    Raises InputError: ``output`` exists, or no such command, process or source does. PlatformError:
    the tracer or a privilege is missing. OperationError: tracing does not start, or nothing was
    traced, or it cannot be read or written: then it stays beside ``output``, and is named.
    """
    output, taken = recordings.refuse_existing(output), running.run_users(users)
    if command:
        check_command(command)
    parent = output.absolute().parent
    for left in leftovers(parent, output.name):
        progress(0.0, leftover_text(left))
    until = ExitStack()
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{output.name}.tracing-", dir=parent))
        until.enter_context(claimed(folder))
    except OSError as error:
        raise OperationError(f"{parent}: no trace can be written there: {error}") from error
    try:
        tracer = _tracer(source, folder, command, pids, buffer, users=taken, loops=loops)
        run = _RecordedRun(
            tracer=tracer,
            folder=folder,
            words=command,
            duration_ns=duration_ns,
            stop=stop or threading.Event(),
            progress=progress,
            users=taken,
            pids=pids,
            gate_logs=gate_logs,
        )
        try:
            _trace(run, scheduling, command_stdout, stalls=watch_stalls, ask_qos=ask_qos)
            progress(1.0, "reading the events")
            recording = _written(output, run, chain, through, plan)
            run.tracer.written()
        except BaseException as error:  # the trace may be of hours: nothing costs it
            if not run.ended_ns:
                raise
            notes = "".join(f"; {note.rstrip('.')}" for note in run.notes)
            if any(folder.iterdir()):
                left = rename_output(folder, output.with_name(folder.name.lstrip(".")))
                notes += f"; what was traced stays in {left}"
            if isinstance(error, ChainshaperError):
                raise OperationError(f"{error}{notes}") from error
            progress(1.0, f"it cannot be read{notes}")
            raise
        if any(folder.iterdir()):
            open_to_all(folder)
            rename_output(folder, recording.path / TRACE_FOLDER)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        until.close()
    return Recorded(recording, run.exit_code)


def _tracer(
    source: str | None,
    folder: Path,
    command: Sequence[str],
    pids: Sequence[int],
    buffer: int | None,
    *,
    users: frozenset[int],
    loops: Sequence[str] = (),
) -> Tracer:
    """Return the tracer that was asked for, or that fits. Raises InputError: there is no such."""
    if source is None:
        # A given buffer, and processes that run already, are LTTng's to answer.
        source = "lttng" if buffer is not None or not command else "preload"
    check_loops(loops, source)
    if source == "lttng":
        return lttng.LttngSession(folder, command, pids, buffer, users)
    if source not in ("ebpf", "preload"):
        raise InputError(f"{source!r} is no source of events: name lttng, preload or ebpf")
    if buffer is not None:
        raise InputError(
            f"--buffer is about LTTng's buffers: leave it out with `--source {source}`"
        )
    if source == "preload":
        return preload.PreloadTracer(folder, command, pids, users, loops)
    return ebpf.EbpfTracer(folder, command, pids, users)


def check_loops(loops: Sequence[str], source: str | None) -> None:
    """Refuse names of loops that a source (None: `preload`) cannot follow. Raises InputError."""
    preload.named_loops.names_text(loops)
    if loops and source not in (None, "preload"):
        raise InputError(
            f"--source {source} does not see how threads sleep, `--source preload` alone does:"
            " leave out --loop (a loop that publishes is seen from its publications), or take"
            " `--source preload`"
        )


def _trace(
    run: _RecordedRun,
    scheduling: Scheduling | None,
    stdout: int | None,
    *,
    stalls: bool,
    ask_qos: bool,
) -> None:
    """Trace the application from its start to its end, and look at it meanwhile."""
    with ExitStack() as undo:
        if stalls:
            run.stalls = undo.enter_context(stalls_watched(available_cores(), may_use_fifo()))
        undo.callback(run.tracer.remove)
        run.progress(0.0, "starting to trace")
        environment = run.tracer.start()
        if run.words:
            run.command = start_command(run.words, environment, stdout)
            undo.callback(end_command, run.command)
            run.pids = (run.command.pid,)
        if scheduling is not None:
            run.schedule = undo.enter_context(scheduling)
        run.begun_ns = time.monotonic_ns()
        if scheduling is None:
            run.stalls.begin()
        _watch(run)
        run.ended_ns = time.monotonic_ns()
        run.progress(1.0, "ending")
        run.tracer.stop()
        if run.exit_code:
            lasted = duration_text(round(run.ended_ns - run.begun_ns, -8))
            run.notes += (f"the command {end_in_words(run.exit_code)} after {lasted}.",)
        if not ask_qos:
            run.no_qos_because = None
        elif run.exit_code is not None:  # types and QoS of all topics are asked of what still runs
            run.no_qos_because = "the application had ended by itself"
        elif run.environment is not None:
            run.endpoints, run.no_qos_because = ask_graph(run.environment)


def _watch(run: _RecordedRun) -> None:
    """Look at the application until it, its time (in force) or the tracer ends."""
    next_look = _FIRST_LOOK_NS
    while True:
        now = time.monotonic_ns()
        lasted = now - run.begun_ns
        awaits_force = run.schedule is not None and run.in_force_ns is None
        counted = 0 if awaits_force else now - (run.in_force_ns or run.begun_ns)
        if run.command is not None and run.command.poll() is not None:
            run.exit_code = run.command.returncode
            return
        over = run.stop.is_set() or (run.duration_ns is not None and counted >= run.duration_ns)
        over |= awaits_force and lasted >= _LONGEST_UNTIL_IN_FORCE_NS
        if over or lasted >= next_look:
            failure = run.tracer.failure()
            if failure is None and shutil.disk_usage(run.folder).free < SPARE_DISK:
                failure = f"the disk of {run.folder.parent} is full"
            try:
                _look(run)
            except ChainshaperError:
                raise
            except Exception as error:  # what was traced is not lost for it
                failure = failure or f"looking at it has failed ({type(error).__name__}: {error})"
            if failure is not None:
                run.notes += (f"tracing ended before the application did: {failure}.",)
            if over or failure is not None or (run.command is None and not run.processes):
                return
            pause = _FIRST_LOOK_NS if run.schedule else max(_FIRST_LOOK_NS, lasted)
            next_look = lasted + min(_LONGEST_PAUSE_NS, pause)
        share = 0.0 if run.duration_ns is None else counted / run.duration_ns
        doing = "waiting until the scheduling is in force" if awaits_force else "recording"
        run.progress(min(1.0, share), f"{doing}; Ctrl-C ends it")
        run.stop.wait(_STEP_S)


def _look(run: _RecordedRun) -> None:
    """See which processes and threads there are, and a node's environment."""
    if run.pids:
        parent_of = parents()
        family = running.descendants(parent_of, *run.pids) & parent_of.keys()
        run.processes = running.list_processes(family)
    else:
        applications = find_applications(running.list_processes())
        run.processes = tuple(process for process in applications if process.user in run.users)
        run.strangers = strangers_text(applications, run.users) or run.strangers
    pids = {process.pid for process in run.processes}
    run.governed = governing(pids, time.monotonic_ns(), run.governed)
    # The node that was started last, not its launcher, nor what only carries its command line.
    nodes = sorted(
        find_applications(run.processes), key=lambda process: (process.participates, process.pid)
    )
    if nodes:
        try:
            run.environment = environment_of(nodes[-1].pid)
        except OperationError as error:
            run.no_qos_because = str(error)
    if run.schedule is not None and run.schedule(run.processes) and run.in_force_ns is None:
        # What was before is left out, so stalls are watched from here on.
        run.in_force_ns = run.stalls.begin(far_from(releases_so_far(run.gate_logs)))


def _written(
    output: Path, run: _RecordedRun, chain: str | None, through: Through, plan: Plan | None
) -> Recording:
    """Write the recording: the events, and all else that is known of the run.

    Raises OperationError: nothing was traced, or the scheduling was never in force.
    """
    tables, info = run.tracer.recording()
    if run.stalls.table is not None:
        tables = {**tables, "machine_stall": run.stalls.table}
    since_ns = run.in_force_ns or run.begun_ns
    tables, missing = with_gate_logs(tables, run.gate_logs, since_ns, run.ended_ns)
    run.notes += missing
    if run.command is None:  # its nodes were created before tracing began
        find_nodes = partial(with_found_nodes, tables, info, run.endpoints, run.processes)
        tables, info = _beside_events(run, "nodes", find_nodes, (tables, info))
    recording = Recording(output, info, tables)
    threads: tuple[ThreadInfo, ...] = ()
    endpoints: tuple[EndpointInfo, ...] = ()
    ask_threads = partial(_recorded_threads, run.processes, recording)
    threads = _beside_events(run, "threads", ask_threads, threads)
    ask_endpoints = partial(_known_endpoints, tables, run.endpoints)
    endpoints = _beside_events(run, "endpoints", ask_endpoints, endpoints)
    notes = [*info.notes, *run.notes, *filter(None, [run.strangers])]
    if run.no_qos_because is not None:
        notes.append(f"types and QoS of topics could not be asked for: {run.no_qos_because}.")
    if run.schedule is not None:
        if run.in_force_ns is None:
            raise OperationError(
                "the run was over before the threads had the scheduling it was to be recorded with"
            )
        tables = events.happened(tables, since_ns)
        lasted = duration_text(round(since_ns - run.begun_ns, -8))
        notes.append(f"the first {lasted} were left out: the scheduling was not in force yet.")
    policies = {thread.policy for thread in threads if thread.role == "executor"}
    in_real_time = policies <= {"SCHED_FIFO", "SCHED_RR"} if policies else None
    variables = {} if run.environment is None else run.environment.variables
    facts = {
        "kernel": platform.release(),
        "distribution": variables.get("ROS_DISTRO") or info.distribution,
        "rmw": variables.get("RMW_IMPLEMENTATION") or info.rmw,
        "command": tuple(run.words),
        "threads": threads,
        "endpoints": endpoints,
        "realtime": run.schedule is not None or in_real_time,
        "stall_meter": run.stalls.info,
        "chain": chain,
        "through": through,
        "plan": None if plan is None else plan_values(plan),
        "in_force": None if plan is None else recordings.InForceInfo(since_ns=since_ns),
        "notes": tuple(notes),
    }
    if plan is None and (governed := in_force_throughout(run.governed)) is not None:
        spell = recordings.InForceInfo(since_ns=governed.since_ns, until_ns=governed.until_ns)
        facts |= {"plan": governed.plan, "in_force": spell}
    info = with_trace_events(recording).model_copy(update=facts)
    return recordings.write_recording(output, tables, info)


def _beside_events(run: _RecordedRun, name: str, ask: Callable[[], _T], otherwise: _T) -> _T:
    """Return what is known of an application beside its events; ``otherwise``, if that fails.

    The events are written whatever fails here, with a note that names what is not known.
    """
    try:
        return ask()
    except Exception as error:
        failed = f"{type(error).__name__}: {error}"
        run.notes += (f"the application's {name} are not known: reading them failed ({failed}).",)
        return otherwise


def _recorded_threads(
    processes: Sequence[RunningProcess], recording: Recording
) -> tuple[ThreadInfo, ...]:
    """Return the threads of the nodes among ``processes``, numbered as in the recording.

    Without nodes they are those of processes in DDS. A thread that works for several nodes (a
    container's) is given to none.
    """
    recorded, _ = recorded_processes(recording)
    pids = {seen.pid for seen in recorded}
    is_here = recording.info.pid_namespace == own_pid_namespace()
    pid_there = {
        process.pid: process.pid if is_here else process.inner_pid for process in processes
    }
    nodes = [process for process in processes if pid_there[process.pid] in pids]
    nodes = nodes or [process for process in processes if process.participates]
    return tuple(
        ThreadInfo(
            tid=listed.thread.tid if is_here else listed.thread.inner_tid,
            pid=pid_there[listed.thread.pid],
            comm=listed.thread.comm,
            node=listed.nodes[0] if len(listed.nodes) == 1 else "",
            role=listed.thread.role,
            policy=listed.thread.policy,
            priority=listed.thread.priority,
            cores=listed.thread.cores,
        )
        for listed in allocate(nodes, recorded, among=processes).threads
    )


def _known_endpoints(
    tables: events.EventTables, asked: Sequence[EndpointInfo]
) -> tuple[EndpointInfo, ...]:
    """Return the graph's endpoints with their depths from the trace, then those only traced."""
    objects = resolve_objects(tables)
    traced: list[EndpointInfo] = []
    by_kind = {"publisher": objects.publishers, "subscription": objects.subscriptions}
    for kind, owners in by_kind.items():
        created = events.table(tables, f"rcl_{kind}_init", ["queue_depth"]).select(
            "pid", handle=f"{kind}_handle", valid_from="time", depth="queue_depth"
        )
        rows = owners.join(created, on=["pid", "handle", "valid_from"]).sort("valid_from")
        rows = rows.drop_nulls(["node", "topic"]).select("node", "topic", "depth")
        traced += [EndpointInfo.model_validate({"kind": kind, **row}) for row in rows.to_dicts()]
    known = []
    for endpoint in asked:
        key, depth = (endpoint.node, endpoint.topic, endpoint.kind), endpoint.depth or None
        for place, seen in enumerate(traced):
            if (seen.node, seen.topic, seen.kind) == key:
                depth = depth or seen.depth  # 0: the graph does not know it
                del traced[place]
                break
        known.append(endpoint.model_copy(update={"depth": depth}))
    return (*known, *traced)
