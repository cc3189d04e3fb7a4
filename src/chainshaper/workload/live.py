"""Run a described application live: real processes, real DDS topics, real scheduling.

Threads are allocated as in the paper (section 2.5), so that they interfere little: executors under
SCHED_FIFO on their cores, DDS threads under SCHED_FIFO on another core. All processes end with the
run.
"""

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.control.plant_file import described_loop
from chainshaper.enforcement.journal import Governed, governing, in_force_throughout
from chainshaper.linux.child_processes import LIBRARIES
from chainshaper.linux.scheduling import (
    SchedulingRequest,
    apply_scheduling,
    available_cores,
    check_cores,
    may_use_fifo,
)
from chainshaper.linux.threads import (
    RunningThread,
    ThreadRole,
    foreign_realtime_processes,
    list_threads,
)
from chainshaper.robot.clocks import clock_offset
from chainshaper.values import events
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.event_declarations import LOOP_MOVES
from chainshaper.values.progress import Progress
from chainshaper.values.recording import (
    InForceInfo,
    Recording,
    RecordingInfo,
    ThreadInfo,
    refuse_existing,
    write_recording,
)
from chainshaper.workload import launcher
from chainshaper.workload.description import (
    Application,
    application_as_written,
    loop_period_ns,
    node_name,
    origin_timer,
)
from chainshaper.workload.event_log import ABSENT, ALSO_TAKEN, EVENTS, LAYOUT, WIDTH, WORDS
from chainshaper.workload.launcher import Child
from chainshaper.workload.live_plant import LiveLoop, carried_bytes
from chainshaper.workload.node_setup import Counterparts, NodeSetup
from chainshaper.workload.stall_meter import StallWatch, far_from, meter_tables, stalls_watched
from chainshaper.workload.timing import Timing, timing_of

Numbers: TypeAlias = npt.NDArray[np.int64]


@dataclass(frozen=True)
class StartedNodes:
    """The nodes of a live run while they wait for its start.

    Instants are of CLOCK_MONOTONIC. Where servers are in force early, both come some whole
    hyper-periods sooner than it says here.
    """

    pids: dict[str, int]  # by the node's full name
    anchor_ns: int  # first expiry of the timer that starts the chain; cycles count from it
    start_ns: int  # the common start of all timers


Tables: TypeAlias = Callable[[], Mapping[str, pl.DataFrame]]
Enforcement: TypeAlias = Callable[[StartedNodes], AbstractContextManager[Tables | None]]
"""Puts reservation servers in force for as long as its context lasts.

It may give a function that returns event tables of its own once the context has ended.
"""

LEAD_NS = 300_000_000  # from when all nodes are ready to the start of their timers
ENFORCING_NS = 2_000_000_000  # at most until servers are in force, before the first cycle
DISCOVERY_NS = 20_000_000_000  # at most until all nodes have found each other
LOOK_NS = 1_000_000_000  # between two looks for runs that govern the nodes; they write every second
SINGLE_THREADED = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # what callbacks compute


def run_application(
    application: Application,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    plan: dict[str, Any] | None = None,
    enforcement: Enforcement | None = None,
    loops_in_front: Mapping[str, str] = MappingProxyType({}),
    command: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Recording:
    """Run an application for ``cycles`` periods of its chain and record it.

    With ``realtime`` None, SCHED_FIFO is used where it is permitted; with False it is not used.
    ``plan`` is stored with the recording. A few cycles before the recorded ones warm the caches and
    are left out. ``enforcement`` is entered when all nodes are ready and their threads have their
    scheduling. It is left when the run is over, however it ends, before any node is asked to leave:
    a thread whose server is closed could not. Nodes with a loop get the variables
    ``loops_in_front``, which put the tracing library in front of them, so that it can be moved.

    Raises:
        InputError: ``output`` exists.
        PlatformError: a core is missing, DDS does not load.
        OperationError: a node died, discovery failed, or the recording cannot be written: then all
            processes are gone, and no recording is left. Or the run was interrupted
            (KeyboardInterrupt): then the whole cycles until then are recorded, as the message says.
    """
    output = refuse_existing(output)
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be recorded: ask for at least 1")
    check_cores(application.cores())
    if application.control_loop is not None:
        LiveLoop.described(application.control_loop, loop_period_ns(application), application.seed)
    permitted = fifo_permitted(realtime)
    realtime = permitted if realtime is None else realtime
    run = _run(
        application,
        cycles,
        realtime=realtime,
        enforcement=enforcement,
        loops_in_front=loops_in_front,
        progress=progress,
    )
    tables = event_tables(run.logs, run.timing.record_from_ns)
    tables |= meter_tables(run.stalls.seen, tables.get("machine_stall"))
    tables |= run.tables
    if "thread_sleep" in tables:
        moved = events.table(tables, "loop_moved")
        tables["thread_sleep"] = with_moved_sleeps(tables["thread_sleep"], moved)
    notes = list(_notes(realtime, permitted, run.memory_locked, run.clock_moved_ns))
    if run.was_interrupted:
        tables = dict(events.happened(tables, 0, run.timing.stop_ns))
        notes.append(f"interrupted: {run.timing.cycles} of {cycles} cycles were recorded")
    if plan is None:
        plan, in_force = _plan_of_others(run.governed)
    else:
        in_force = InForceInfo(since_ns=run.timing.record_from_ns)
    info = RecordingInfo(
        source="live",
        rmw="cyclonedds",
        clock_offset_ns=run.clock_offset_ns,
        command=tuple(command),
        processes={pid: node for node, pid in run.pids.items()},
        threads=run.threads,
        realtime=realtime,
        notes=tuple(notes),
        stall_meter=run.stalls.info,
        chain=application.chain,
        application=application_as_written(application),
        plan=plan,
        in_force=in_force,
    )
    recording = write_recording(output, tables, info)
    if run.was_interrupted:
        raise OperationError(f"{notes[-1]}; they are in {output}")
    return recording


@dataclass(frozen=True)
class _FinishedRun:
    """What is known of a run when all of its processes have ended."""

    pids: dict[str, int]  # of nodes, by their full names
    logs: list["ProcessLog"]  # of nodes
    stalls: StallWatch
    timing: Timing  # as it was in the end
    was_interrupted: bool
    threads: tuple[ThreadInfo, ...]
    governed: tuple[Governed, ...]  # plans that others put in force meanwhile
    memory_locked: bool  # in all nodes
    clock_offset_ns: int  # of CLOCK_REALTIME against CLOCK_MONOTONIC, when the run began
    clock_moved_ns: int  # by how much that changed until the end
    tables: Mapping[str, pl.DataFrame]  # of the enforcement


def _run(
    application: Application,
    cycles: int,
    *,
    realtime: bool,
    enforcement: Enforcement | None,
    loops_in_front: Mapping[str, str],
    progress: Progress,
) -> _FinishedRun:
    """Start the nodes, let them run, collect what they recorded, and end them."""
    # Without real-time priority a meter cannot tell a stall from ordinary scheduling.
    watching = stalls_watched(application.cores(), True) if realtime else nullcontext(StallWatch())
    nodes: dict[str, Child] = {}
    finished = False
    try:
        progress(0.0, "starting nodes")
        _start_nodes(application, nodes, realtime, loops_in_front)
        with watching as stalls:
            memory_locked = _await_ready(nodes.values())
            _allocate_threads(application, nodes, realtime)
            offset_ns = clock_offset()
            lead_ns = LEAD_NS if enforcement is None else LEAD_NS + ENFORCING_NS
            timing = timing_of(application, cycles, time.monotonic_ns() + lead_ns)
            pids = {node_name(name): child.pid for name, child in nodes.items()}
            started = StartedNodes(pids, timing.anchor_ns, timing.start_ns)
            with nullcontext() if enforcement is None else enforcement(started) as tables_of:
                timing = _sooner(application, cycles, timing)
                for child in nodes.values():
                    child.tell(**asdict(timing))
                stalls.begin(timing.anchor_ns + _between_releases(application), timing.stop_ns)
                threads, governed, interrupted_ns = _watch(nodes, stalls.meters, timing, progress)
                if interrupted_ns is not None:
                    timing = _ended_early(nodes.values(), timing, interrupted_ns)
            progress(1.0, "collecting events")
            logs = [_read_log(name, child, application) for name, child in nodes.items()]
        finished = True
    finally:
        launcher.end_all(nodes.values(), patience_s=3.0 if finished else 0.0)
    return _FinishedRun(
        pids=pids,
        logs=logs,
        stalls=stalls,
        timing=timing,
        was_interrupted=interrupted_ns is not None,
        threads=threads,
        governed=governed,
        memory_locked=memory_locked,
        clock_offset_ns=offset_ns,
        clock_moved_ns=clock_offset() - offset_ns,
        tables={} if tables_of is None else tables_of(),
    )


def with_moved_sleeps(sleeps: pl.DataFrame, moved: pl.DataFrame) -> pl.DataFrame:
    """Return the table `thread_sleep` of loops that log their own instants, as they were moved.

    ``moved`` is the table `loop_moved`: the library notes each change right behind the beginning of
    the sleep that it is for, which the loop has logged before. ``until`` gets what was added.
    """
    if moved.is_empty():
        return sleeps
    one_off = [LOOP_MOVES.index("asked"), LOOP_MOVES.index("followed")]
    changes = moved.select(
        *("pid", "tid", "kept"),
        changed=pl.col("time"),
        once=pl.when(pl.col("why").is_in(one_off)).then("added").otherwise(0),
    ).sort("changed")
    rows = sleeps.with_row_index("row").sort("time")
    begun = rows.select("pid", "tid", "time", "row")
    changes = changes.join_asof(
        begun, left_on="changed", right_on="time", by=["pid", "tid"], check_sortedness=False
    )
    changes = changes.drop_nulls("row").select("pid", "tid", "kept", "once", since="time", at="row")
    rows = rows.join_asof(
        changes.sort("since"),
        left_on="time",
        right_on="since",
        by=["pid", "tid"],
        check_sortedness=False,
    )
    is_first = pl.col("row") == pl.col("at")
    added = pl.col("kept").fill_null(0) + pl.when(is_first).then("once").otherwise(0)
    rows = rows.with_columns(until=pl.col("until") + added)
    return rows.sort("row").select(sleeps.columns)


def _plan_of_others(
    governed: Sequence[Governed],
) -> tuple[dict[str, Any] | None, InForceInfo | None]:
    """Return the plan that others had in force during a run, and when; None: there was none."""
    together = in_force_throughout(governed)
    if together is None:
        return None, None
    return together.plan, InForceInfo(since_ns=together.since_ns, until_ns=together.until_ns)


def fifo_permitted(wanted: bool | None) -> bool:
    """Whether SCHED_FIFO is permitted. Raises PlatformError: it is ``wanted``, and is not."""
    permitted = may_use_fifo()
    if wanted and not permitted:
        raise PlatformError(
            "real-time scheduling was asked for, but this process may not use SCHED_FIFO: run as "
            "root, give your user an rtprio limit of 98 in /etc/security/limits.conf, or do without"
        )
    return permitted


def _between_releases(application: Application) -> int:
    """Return how long behind the anchor stall meters begin to wake up, far from all releases."""
    starts = [
        start
        for _, callback in application.callbacks()
        if callback.gate is not None
        for start, _ in callback.gate.slots
    ]
    return far_from(starts or [0])


def _sooner(application: Application, cycles: int, timing: Timing) -> Timing:
    """Move a run earlier, by as many whole hyper-periods of its timers as there is time for."""
    periods = [period for _, callback in application.callbacks() if (period := callback.period_ns)]
    hyper_period_ns = math.lcm(*periods)
    spare_ns = max(0, timing.start_ns - LEAD_NS - time.monotonic_ns())
    earlier_ns = spare_ns // hyper_period_ns * hyper_period_ns
    return timing_of(application, cycles, timing.start_ns - earlier_ns)


def _ended_early(children: Iterable[Child], timing: Timing, ended_ns: int) -> Timing:
    """Have the run end now; return its timing, which ends with the last whole cycle.

    Raises OperationError: there was none.
    """
    early = replace(timing, stop_ns=ended_ns)
    if early.cycles < 1:
        raise OperationError("interrupted before one whole cycle: nothing is recorded")
    for child in children:
        child.process.send_signal(launcher.ENOUGH)
    return replace(early, stop_ns=timing.record_from_ns + early.cycles * timing.period_ns)


def _start_nodes(
    application: Application,
    nodes: dict[str, Child],
    realtime: bool,
    loops_in_front: Mapping[str, str],
) -> None:
    """Start a process for each node, and add it to ``nodes``.

    Its arguments name the node as those of ROS 2 do, so that others recognise it.
    """
    from chainshaper.workload.dds import closed_domain_configuration, free_domain

    domain = free_domain()
    environment = {"CYCLONEDDS_URI": closed_domain_configuration(), **SINGLE_THREADED}
    for name in application.nodes:
        namespace, _, base = node_name(name).rpartition("/")
        nodes[name] = launcher.start_child(
            f"node {name}",
            "chainshaper.workload.node_process",
            {**environment, **(loops_in_front if application.nodes[name].loop is not None else {})},
            arguments=("--ros-args", "-r", f"__node:={base}", "-r", f"__ns:={namespace or '/'}"),
            libraries=LIBRARIES,
        )
        nodes[name].tell_model(_setup_of(application, name, domain, realtime))


def _setup_of(application: Application, name: str, domain: int, realtime: bool) -> NodeSetup:
    """Return what the process of a node gets before it runs."""
    described = [callback for _, callback in application.callbacks()]
    publishers = Counter(topic for callback in described for topic in callback.publishes)
    subscriptions = Counter(topic for callback in described for topic in callback.subscriptions)
    executor, dds = application.scheduling_of(name), application.dds_scheduling_of(name)
    loop = application.control_loop
    takes_part = any(callback.control for callback in application.nodes[name].callbacks)
    carried = 0
    if loop is not None:
        plant = described_loop(Path("control_loop"), loop).plant
        carried = carried_bytes(plant.outputs, plant.inputs, loop.copies)
    return NodeSetup(
        name=node_name(name),
        node=application.nodes[name],
        topics={topic: application.topic(topic) for topic in publishers},
        announced=frozenset(application.announced()),
        counterparts={
            topic: Counterparts(publishers=publishers[topic], subscriptions=subscriptions[topic])
            for topic in publishers
        },
        domain=domain,
        discovery_ns=DISCOVERY_NS,
        seed=application.seed,
        parent=os.getpid(),
        starts_chain=origin_timer(application)[0] == name,
        origin_phase_ns=origin_timer(application)[1].phase_ns,
        control_loop=loop if takes_part else None,
        loop_period_ns=loop_period_ns(application),
        carried=carried,
        delivery_core=dds.core if realtime and dds.core != executor.core else None,
    )


def _await_ready(children: Iterable[Child]) -> bool:
    """Wait until all nodes have found each other; return whether all could lock their memory.

    Raises OperationError: some were not found.
    """
    answers = [(child, child.hear()) for child in children]
    missing = [f"{child.name}: {text}" for child, answer in answers for text in answer["missing"]]
    if missing:
        raise OperationError(
            f"DDS discovery was not complete after {duration_text(DISCOVERY_NS)} "
            f"({'; '.join(missing)}); is UDP on 127.0.0.1 permitted here?"
        )
    return all(answer["memory_locked"] for _, answer in answers)


def _allocate_threads(application: Application, nodes: dict[str, Child], realtime: bool) -> None:
    """Give every thread its core and, where permitted, its SCHED_FIFO priority."""
    for name, child in nodes.items():
        executor, dds = application.scheduling_of(name), application.dds_scheduling_of(name)
        loop = application.loop_scheduling_of(name)
        cores = iter(application.cores_of(name))
        for thread in node_threads(child.pid):
            core, priority = dds.core, dds.priority
            if thread.role == "executor":
                core, priority = next(cores), executor.priority
            elif thread.role == "publisher":
                # Below the executor: it shares the writer's lock with it, and may spin on it.
                core, priority = executor.core, max(1, executor.priority - 1)
            elif thread.role == "loop" and loop is not None:
                core, priority = loop.core, loop.priority
            cores_of_thread: tuple[int, ...] = (core,)
            described = thread.role in ("executor", "publisher", "loop")
            if described and not application.nodes[name].bound:
                cores_of_thread = tuple(available_cores())
            wanted = SchedulingRequest(priority if realtime else None, cores=cores_of_thread)
            apply_scheduling(thread, wanted)


def _watch(
    nodes: dict[str, Child],
    meters: dict[int, Child],
    timing: Timing,
    progress: Progress,
) -> tuple[tuple[ThreadInfo, ...], tuple[Governed, ...], int | None]:
    """Wait for the end of the run.

    Returns the threads as they were while it lasted, the plans that others put in force meanwhile
    (`chainshaper apply`), and when the run was interrupted (ns; None: it was not). Raises
    OperationError: a process ended before its time.
    """
    threads: tuple[ThreadInfo, ...] = ()
    governed: tuple[Governed, ...] = ()
    interrupted_ns: int | None = None
    pids, next_look = {child.pid for child in nodes.values()}, timing.start_ns
    while (now := time.monotonic_ns()) < timing.stop_ns:
        if (casualty := launcher.first_casualty([*nodes.values(), *meters.values()])) is not None:
            raise OperationError(f"{casualty.obituary()}; the run was ended and nothing recorded")
        if now >= timing.record_from_ns and not threads:
            threads = _snapshot(nodes, meters)
        if now >= next_look:
            governed, next_look = governing(pids, now, governed), now + LOOK_NS
        done_ns = max(0, now - timing.start_ns)
        progress(done_ns / (timing.stop_ns - timing.start_ns), "recording")
        try:
            time.sleep(0.1)
        except KeyboardInterrupt:
            interrupted_ns = time.monotonic_ns()
            break
    governed = governing(pids, time.monotonic_ns(), governed)
    return threads or _snapshot(nodes, meters), governed, interrupted_ns


def _snapshot(nodes: dict[str, Child], meters: dict[int, Child]) -> tuple[ThreadInfo, ...]:
    """Return all threads of nodes and stall meters, as they are now."""
    shown = [
        _thread_info(thread, node_name(name), thread.role)
        for name, child in nodes.items()
        for thread in node_threads(child.pid)
    ]
    shown += [
        _thread_info(thread, "", "stall-meter")
        for child in meters.values()
        for thread in list_threads(child.pid)
    ]
    return tuple(shown)


def _thread_info(thread: RunningThread, node: str, role: str) -> ThreadInfo:
    return ThreadInfo(
        tid=thread.tid,
        pid=thread.pid,
        comm=thread.comm,
        node=node,
        role=role,
        policy=thread.policy,
        priority=thread.priority,
        cores=thread.cores,
    )


def node_threads(pid: int) -> list[RunningThread]:
    """Return the threads of a node's process, with their roles.

    Executors are the main thread and those named `WORKER_NAME`; its loop's is `LOOP_NAME`. Threads
    that a callback's module has started execute nothing; they have the name of the thread that
    loaded it.
    """
    roles: dict[str, ThreadRole] = {launcher.WORKER_NAME: "executor", launcher.LOOP_NAME: "loop"}
    return [
        replace(
            thread, role=thread.role if thread.tid == pid else roles.get(thread.comm, thread.role)
        )
        for thread in list_threads(pid)
    ]


@dataclass(frozen=True)
class ProcessLog:
    """What a process has recorded."""

    pid: int
    core: int | None  # that its executor was pinned to; None: it was not, or to several
    rows: bytes  # of :mod:`~chainshaper.workload.event_log`
    objects: tuple[dict[str, Any], ...]  # the events of their creation
    modes: tuple[str, ...] = ()  # that its gate knows

    def process(self) -> dict[str, Any]:
        """Return the fields that all events of the process share."""
        return {"pid": self.pid, "cpu": self.core}


def event_tables(logs: Sequence[ProcessLog], from_ns: int) -> dict[str, pl.DataFrame]:
    """Return the event tables of all processes, sorted by time.

    They have the events from ``from_ns`` on, and the creation of all objects.
    """
    parts: dict[str, list[pl.DataFrame]] = {}
    created: dict[str, list[dict[str, Any]]] = {}  # by event, of all processes: there are many
    for log in logs:
        rows = np.frombuffer(log.rows, dtype=np.int64).reshape(-1, WIDTH)
        rows = rows[rows[:, 1] >= from_ns]
        entries = {
            entry: dict(zip(("time", "tid", *fields), columns.T, strict=False)) | log.process()
            for number, (entry, fields) in enumerate(LAYOUT.items())
            if (columns := rows[rows[:, 0] == number, 1:]).size
        }
        for name, table in logged_tables(entries, log.modes):
            parts.setdefault(name, []).append(table)
        main_thread = {**log.process(), "tid": log.pid}
        for of_object in log.objects:
            created.setdefault(of_object["event"], []).append(of_object | main_thread)
    for name, rows_of_event in created.items():
        frame = pl.DataFrame(rows_of_event, infer_schema_length=None)
        parts.setdefault(name, []).append(typed_table(name, frame))
    return {
        name: pl.concat(tables).sort("time", maintain_order=True)
        for name, tables in sorted(parts.items())
    }


def logged_tables(
    entries: Mapping[str, Mapping[str, npt.NDArray[Any]]], modes: Sequence[str]
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the tables of the events for which a log's entries stand, with the events' names.

    ``entries`` has the columns of each kind of entry, by name: time, thread, process, core, and the
    fields in :data:`LAYOUT`. ``modes`` are the names of the modes, which are numbers there.
    """
    for entry in LAYOUT:
        columns = entries.get(entry, {})
        if not columns or not columns["time"].size:
            continue
        frame = pl.DataFrame(columns)
        taken = frame
        if entry == "take" and not (frame["taken"] == 1).all():
            taken = frame.filter(taken=1)
        for name in EVENTS[entry]:
            named = taken if name in ALSO_TAKEN else frame
            if named.height:
                yield name, typed_table(name, named, modes)


def typed_table(name: str, frame: pl.DataFrame, modes: Sequence[str] = ()) -> pl.DataFrame:
    """Make an event's table of a frame of numbers, which stand for words and nulls as in a log."""
    types, words = events.column_types(name), {**WORDS, "mode": modes}
    columns = []
    for field in filter(frame.columns.__contains__, types):
        column = frame[field]
        if column.dtype == pl.Int64 and types[field] == pl.UInt64:  # a handle
            column = column.reinterpret(signed=False)
        if types[field] == pl.Float64:
            column = pl.Series(field, column.to_numpy().view(np.float64))
        if field in words:
            named = dict(enumerate(words[field]))
            column = column.replace_strict(named, default=None, return_dtype=pl.String())
        elif field in {"release", "slot"}:
            column = column.replace({ABSENT: None})
        columns.append(column.cast(types[field]))
    return pl.DataFrame(columns)


def _read_log(name: str, child: Child, application: Application) -> ProcessLog:
    """Receive what a node has recorded."""
    answer = child.hear()
    rows = child.hear_bytes(answer["bytes"])
    described = application.nodes[name]
    cores = set(application.cores_of(name))
    gates = [callback.gate for callback in described.callbacks if callback.gate is not None]
    modes = gates[0].modes if gates else None
    return ProcessLog(
        child.pid,
        core=cores.pop() if len(cores) == 1 and described.bound else None,
        rows=rows,
        objects=tuple(answer["objects"]),
        modes=() if modes is None else tuple(modes.bands),
    )


def _notes(
    realtime: bool, permitted: bool, memory_locked: bool, clock_moved_ns: int
) -> Iterator[str]:
    """Yield what may have disturbed the run, in words."""
    if not realtime:
        reason = "SCHED_FIFO was declined" if permitted else "the process may not use SCHED_FIFO"
        yield (
            f"taken without real-time scheduling ({reason}), and without watching for stalls of"
            " the machine"
        )
    if not memory_locked:
        yield "memory was not locked: page faults may have cost time"
    if abs(clock_moved_ns) > 1_000_000:
        yield f"the wall clock moved by {duration_text(clock_moved_ns)} against CLOCK_MONOTONIC"
    if foreign := foreign_realtime_processes():
        yield f"other real-time processes were running: {', '.join(foreign)}"
