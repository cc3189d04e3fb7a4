"""Recording an application that is not ours: `chainshaper record`.

    tracing on ─► application starts ─► threads looked at, now and then ─► tracing off
                                        ─► types and QoS asked for ─► application ends ─► recording

Tracing begins first, because an object emits its name once, when it is created. Types and QoS are
asked for when tracing is over: discovery costs every node some time. What the tracer wrote is kept
with the recording, as `trace/`.

Whatever ends the run, the application, a duration or Ctrl-C, its recording is whole; nothing is
left running, nor changed.
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
from pathlib import Path
from typing import TypeAlias

from chainshaper.enforcement.threads import strangers_text
from chainshaper.flow.exploration import with_trace_events
from chainshaper.flow.recorded_threads import (
    known_endpoints,
    recorded_threads_of,
    scheduled_in_real_time,
)
from chainshaper.linux.own_processes import check_command, end_command, end_in_words, start_command
from chainshaper.linux.processes import (
    Process,
    descendants,
    find_applications,
    list_processes,
    run_users,
)
from chainshaper.linux.runs import Governed, governing, in_force_throughout
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import parents
from chainshaper.planning import Plan
from chainshaper.sources import Tracer
from chainshaper.sources.gate_log import releases_so_far, with_gate_logs
from chainshaper.sources.ros import Environment, ask_graph, environment_of
from chainshaper.values import events
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import ChainshaperError, InputError, OperationError
from chainshaper.values.events import EventTables
from chainshaper.values.files import open_to_all
from chainshaper.values.recording import (
    EndpointInfo,
    InForceInfo,
    Recording,
    refuse_existing,
    write_recording,
)
from chainshaper.workload.stall_watch import StallWatch, far_from, stalls_watched

__all__ = ["Recorded", "Scheduling", "record_command"]

Scheduling: TypeAlias = AbstractContextManager[Callable[[Sequence[Process]], bool]]
"""Changes how the application's threads run for as long as its context lasts.

What it gives is called about once a second with the application's processes, and says whether all
is as it shall be; events from before that are left out of the tables.
"""

TRACE_FOLDER = "trace"
SPARE_DISK = 64 << 20
"""A run ends when its disk has no more than that (bytes): there is more to be written."""

_STEP_S = 0.1
_FIRST_LOOK_NS = 500_000_000
_LONGEST_PAUSE_NS = 5_000_000_000
"""Looking costs the machine some milliseconds: the longer a run lasts, the rarer it is."""


@dataclass(frozen=True)
class Recorded:
    """A recording, and the exit code of the command where it ended by itself."""

    recording: Recording
    exit_code: int | None


@dataclass
class _Run:
    """What there is to keep together while an application is recorded, and what was seen of it.

    ``environment`` is a node's. ``in_force_ns`` is when the scheduling that was asked for was,
    ``governed`` are plans that others put in force meanwhile (`chainshaper apply`).
    """

    tracer: Tracer
    folder: Path
    duration_ns: int | None
    stop: threading.Event
    progress: Callable[[float, str], None]
    users: frozenset[int]
    pids: Sequence[int] = ()
    gate_logs: Sequence[Path] = ()
    command: "subprocess.Popen[bytes] | None" = None
    schedule: Callable[[Sequence[Process]], bool] | None = None
    begun_ns: int = 0
    ended_ns: int = 0
    processes: tuple[Process, ...] = ()
    strangers: str | None = None
    environment: Environment | None = None
    no_environment_because: str = "no process was seen that looks like a node"
    endpoints: tuple[EndpointInfo, ...] = ()
    no_qos_because: str | None = None
    in_force_ns: int | None = None
    governed: tuple[Governed, ...] = ()
    stalls: StallWatch = field(default_factory=StallWatch)
    exit_code: int | None = None
    notes: tuple[str, ...] = ()


def record_command(
    output: str | Path,
    command: Sequence[str] = (),
    *,
    source: str = "lttng",
    duration_ns: int | None = None,
    pids: Sequence[int] = (),
    users: Collection[str | int] = (),
    buffer: int | None = None,
    chain: str | None = None,
    scheduling: Scheduling | None = None,
    plan: Plan | None = None,
    gate_logs: Sequence[Path] = (),
    watch_stalls: bool = False,
    command_stdout: int | None = None,
    stop: threading.Event | None = None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Recorded:
    """Record an application until it ends, ``duration_ns`` are over, or ``stop`` is set.

    ``command`` is started, and ended with the recording. Without one, eBPF attaches to ``pids``
    and their descendants, or to all that ``users`` run (names or numbers; default: who launched
    us, and root). ``buffer`` is the size of LTTng's buffer of a core in bytes. ``chain`` is noted
    as the chain of interest, ``plan`` as the plan in force; ``gate_logs`` are where its shaping
    nodes note what they do. ``watch_stalls`` has a sleeper on every core notice when the machine
    stands still, which takes some 2 % of it. What the command prints goes to the file descriptor
    ``command_stdout``, if that is given. ``progress`` gets the share that is done, as far as
    that is known, and what is being done.

    Raises:
        InputError: ``output`` exists, there is no such command or process, or no such source.
        PlatformError: the tracer is not installed, or a privilege is missing.
        OperationError: tracing does not start, nothing was traced, or it cannot be read or
            written; what the tracer wrote is then kept beside ``output``, and named.
    """
    output, taken = refuse_existing(output), run_users(users)
    if command:
        check_command(command)
    folder = _work_folder(output)
    try:
        tracer = _tracer(source, folder, command, pids, buffer, users=taken)
        stop = stop or threading.Event()
        run = _Run(tracer, folder, duration_ns, stop, progress, taken, pids, gate_logs)
        _trace(run, command, command_stdout, scheduling, watch_stalls=watch_stalls)
        progress(1.0, "reading the events")
        try:
            recording = _written(output, run, command, chain, plan)
        except ChainshaperError as error:
            raise OperationError(f"{error}{_what_is_left(run, output)}") from error
        if any(folder.iterdir()):
            open_to_all(folder)
            folder.rename(recording.path / TRACE_FOLDER)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return Recorded(recording, run.exit_code)


def _work_folder(output: Path) -> Path:
    parent = output.absolute().parent
    try:
        return Path(tempfile.mkdtemp(prefix=f".{output.name}.tracing-", dir=parent))
    except OSError as error:
        raise OperationError(f"{parent}: no trace can be written there: {error}") from error


def _tracer(
    source: str,
    folder: Path,
    command: Sequence[str],
    pids: Sequence[int],
    buffer: int | None,
    *,
    users: frozenset[int],
) -> Tracer:
    if source == "lttng":
        from chainshaper.sources.lttng.session import LttngSession

        return LttngSession(folder, command, pids, buffer, users)
    if source != "ebpf":
        raise InputError(f"{source!r} is no source of events: name lttng or ebpf")
    if buffer is not None:
        raise InputError("--buffer is about LTTng's buffers: leave it out with `--source ebpf`")
    from chainshaper.sources.ebpf.session import EbpfTracer

    return EbpfTracer(folder, command, pids, users)


def _trace(
    run: _Run,
    command: Sequence[str],
    stdout: int | None,
    scheduling: Scheduling | None,
    *,
    watch_stalls: bool,
) -> None:
    """The run itself: from the beginning of tracing to the end of the application."""
    with ExitStack() as undo:
        if watch_stalls:
            run.stalls = undo.enter_context(stalls_watched(available_cores(), may_use_fifo()))
        undo.callback(run.tracer.remove)
        run.progress(0.0, "starting to trace")
        environment = run.tracer.start()
        if command:
            run.command = start_command(command, environment, stdout)
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
            lasted = format_duration(round(run.ended_ns - run.begun_ns, -8))
            run.notes += (f"the command {end_in_words(run.exit_code)} after {lasted}.",)
        _ask_for_qos(run)


def _watch(run: _Run) -> None:
    """Look at the application now and then, until it, its time or the tracer ends."""
    next_look = run.begun_ns + _FIRST_LOOK_NS
    while True:
        lasted = time.monotonic_ns() - run.begun_ns
        if run.command is not None and run.command.poll() is not None:
            run.exit_code = run.command.returncode
            return
        over = run.stop.is_set() or (run.duration_ns is not None and lasted >= run.duration_ns)
        if over or lasted >= next_look - run.begun_ns:
            failure = run.tracer.failure() or _full_disk(run.folder)
            _look(run)
            if failure is not None:
                run.notes += (f"tracing ended before the application did: {failure}.",)
            if over or failure is not None or (run.command is None and not run.processes):
                return
            pause = _FIRST_LOOK_NS if run.schedule else max(_FIRST_LOOK_NS, lasted)
            next_look = run.begun_ns + lasted + min(_LONGEST_PAUSE_NS, pause)
        share = 0.0 if run.duration_ns is None else lasted / run.duration_ns
        run.progress(min(1.0, share), "recording; Ctrl-C ends it")
        run.stop.wait(_STEP_S)


def _full_disk(folder: Path) -> str | None:
    free = shutil.disk_usage(folder).free
    return f"the disk of {folder.parent} is full" if free < SPARE_DISK else None


def _look(run: _Run) -> None:
    """Which processes and threads there are, and a node's environment."""
    if run.pids:
        parent_of = parents()
        family = descendants(parent_of, *run.pids) & parent_of.keys()
        processes = list_processes(family)
    else:
        everybody = find_applications(list_processes())
        processes = tuple(one for one in everybody if one.user in run.users)
        run.strangers = strangers_text(everybody, run.users) or run.strangers
    run.processes = processes
    pids = {one.pid for one in processes}
    run.governed = governing(pids, time.monotonic_ns(), run.governed)
    # The node that was started last, not its launcher, nor what only carries its command line.
    nodes = sorted(find_applications(processes), key=lambda one: (one.participates, one.pid))
    if nodes:
        try:
            run.environment = environment_of(nodes[-1].pid)
        except OperationError as error:
            run.no_environment_because = str(error)
    if run.schedule is not None and run.schedule(processes) and run.in_force_ns is None:
        # What was before is left out, so stalls are watched from here on.
        run.in_force_ns = run.stalls.begin(far_from(releases_so_far(run.gate_logs)))


def _ask_for_qos(run: _Run) -> None:
    """Types and QoS of all topics, while the application is still there."""
    if run.exit_code is not None:
        run.no_qos_because = "the application had ended by itself"
    elif run.environment is None:
        run.no_qos_because = run.no_environment_because
    else:
        run.endpoints, run.no_qos_because = ask_graph(run.environment)


def _written(
    output: Path, run: _Run, command: Sequence[str], chain: str | None, plan: Plan | None
) -> Recording:
    tables, info = run.tracer.recording()
    if run.stalls.table is not None:
        tables = {**tables, "machine_stall": run.stalls.table}
    since_ns = run.in_force_ns or run.begun_ns
    tables, missing = with_gate_logs(tables, run.gate_logs, since_ns, run.ended_ns)
    run.notes += missing
    if run.command is None:  # its nodes were created before tracing began
        from chainshaper.sources.ebpf.late_attachment import with_found_nodes

        tables, info = with_found_nodes(tables, info, run.endpoints, run.processes)
    recording = Recording(output, info, tables)
    threads = recorded_threads_of(run.processes, recording)
    notes = (*info.notes, *run.notes, *((run.strangers,) if run.strangers else ()))
    if run.no_qos_because is not None:
        notes += (f"types and QoS of topics could not be asked for: {run.no_qos_because}.",)
    if run.schedule is not None:
        tables, note = _from_in_force(tables, run)
        notes += (note,)
    variables = {} if run.environment is None else run.environment.variables
    facts = {
        "kernel": platform.release(),
        "distribution": variables.get("ROS_DISTRO") or info.distribution,
        "rmw": variables.get("RMW_IMPLEMENTATION") or info.rmw,
        "command": tuple(command),
        "threads": threads,
        "endpoints": known_endpoints(tables, run.endpoints),
        "realtime": True if run.schedule is not None else scheduled_in_real_time(threads),
        "stall_meter": run.stalls.info,
        "chain": chain,
        "plan": None if plan is None else plan.model_dump(mode="json"),
        "in_force": None if plan is None else InForceInfo(since_ns=since_ns),
        "notes": notes,
    }
    if plan is None and (governed := in_force_throughout(run.governed)) is not None:
        facts["plan"] = governed.plan
        facts["in_force"] = InForceInfo(since_ns=governed.since_ns, until_ns=governed.until_ns)
    return write_recording(output, tables, with_trace_events(recording).model_copy(update=facts))


def _from_in_force(tables: EventTables, run: _Run) -> tuple[EventTables, str]:
    """The events of what happened under the scheduling, and those of all objects' creation."""
    since = run.in_force_ns
    if since is None:
        raise OperationError(
            "the run was over before the threads had the scheduling it was to be recorded with"
        )
    kept = events.happened(tables, since)
    lasted = format_duration(round(since - run.begun_ns, -8))
    return kept, f"the first {lasted} were left out: the scheduling was not in force yet."


def _what_is_left(run: _Run, output: Path) -> str:
    """What to add to a message when there is no recording: what else went wrong, the trace."""
    said = "".join(f"; {note.rstrip('.')}" for note in run.notes)
    if any(run.folder.iterdir()):
        kept = output.with_name(run.folder.name.lstrip("."))
        run.folder.rename(kept)
        said += f"; what was traced is kept in {kept}"
    return said
