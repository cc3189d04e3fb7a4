"""Run a described application live: real processes, real DDS topics, real scheduling.

Threads are allocated as in the paper (section 2.5): executors SCHED_FIFO on their cores, DDS
threads SCHED_FIFO on another, interference low. All of them end with the run.
"""

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.enforcement.journal import Governed, governing, in_force_throughout
from chainshaper.linux.own_processes import LIBRARIES
from chainshaper.linux.scheduling import (
    SchedulingRequest,
    apply_scheduling,
    available_cores,
    check_cores,
    may_use_fifo,
)
from chainshaper.linux.threads import RunningThread, foreign_realtime_processes, list_threads
from chainshaper.robot.clocks import clock_offset
from chainshaper.values import events
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError
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
    node_name,
    origin_timer,
)
from chainshaper.workload.event_log import ABSENT, ALSO_TAKEN, EVENTS, LAYOUT, WIDTH, WORDS
from chainshaper.workload.launcher import Child
from chainshaper.workload.node_setup import Counterparts, NodeSetup
from chainshaper.workload.stall_meter import StallWatch, far_from, meter_tables, stalls_watched
from chainshaper.workload.timing import Timing, timing_of

Numbers: TypeAlias = npt.NDArray[np.int64]


@dataclass(frozen=True)
class StartedNodes:
    """The nodes of a live run while they wait for its start, by full name.

    ``start_ns`` (CLOCK_MONOTONIC) is the common start of all timers, ``anchor_ns`` the first expiry
    of the timer that starts the chain, from which its cycles count. Where servers are in force
    early, both come some hyper-periods sooner than it says here.
    """

    pids: dict[str, int]
    anchor_ns: int
    start_ns: int


Enforcement: TypeAlias = Callable[[StartedNodes], AbstractContextManager[object]]
"""Puts reservation servers in force for as long as its context lasts."""

LEAD_NS = 300_000_000
ENFORCING_NS = 2_000_000_000  # at most until servers are in force, before the first cycle
DISCOVERY_NS = 20_000_000_000
LOOK_NS = 1_000_000_000  # between looks who governs the nodes: they write it down every second
SHOWN = ("tid", "pid", "comm", "policy", "priority", "cores")  # of a thread, by the kernel
SINGLE_THREADED = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # what callbacks compute


def run_application(
    application: Application,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    plan: dict[str, Any] | None = None,
    enforcement: Enforcement | None = None,
    command: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Recording:
    """Run an application for ``cycles`` periods of its chain and record it.

    ``realtime`` None takes SCHED_FIFO where it is permitted; False does without. ``plan`` is
    stored with the recording. A few cycles before the recorded ones warm the caches and are left
    out. ``enforcement`` is entered when all nodes stand ready and their threads have their
    scheduling, and left when the run is over, however it ends, before any node is asked to leave:
    a thread whose server is closed could not.

    Raises:
        InputError: ``output`` exists.
        PlatformError: a core is missing, DDS does not load.
        OperationError: a node died, discovery failed, the recording cannot be written. In every
            case all processes are gone and no recording is left; but where the run was interrupted
            (KeyboardInterrupt), the whole cycles until then are, which the message says.
    """
    output = refuse_existing(output)
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be recorded: ask for at least 1")
    check_cores(application.cores())
    permitted = _permitted(realtime)
    realtime = permitted if realtime is None else realtime
    # What can be pre-empted itself cannot tell a stall from ordinary scheduling.
    watching = stalls_watched(application.cores(), True) if realtime else nullcontext(StallWatch())
    nodes: dict[str, Child] = {}
    finished = False
    try:
        progress(0.0, "starting nodes")
        _start_nodes(application, nodes, realtime)
        with watching as stalls:
            memory_locked = _await_ready(nodes.values())
            _allocate_threads(application, nodes, realtime)
            lead = LEAD_NS if enforcement is None else LEAD_NS + ENFORCING_NS
            timing = timing_of(application, cycles, time.monotonic_ns() + lead)
            offset = clock_offset()
            pids = {node_name(name): child.pid for name, child in nodes.items()}
            started = StartedNodes(pids, timing.anchor_ns, timing.start_ns)
            with nullcontext() if enforcement is None else enforcement(started):
                timing = _sooner(application, cycles, timing)
                for child in nodes.values():
                    child.tell(**asdict(timing))
                stalls.begin(timing.anchor_ns + _between_releases(application), timing.stop_ns)
                threads, governed, ended_ns = _watch(nodes, stalls.meters, timing, progress)
                if ended_ns is not None:
                    timing = _ended_early(nodes.values(), timing, ended_ns)
            progress(1.0, "collecting events")
            logs = [_read_log(name, child, application) for name, child in nodes.items()]
        finished = True
    finally:
        launcher.end_all(nodes.values(), patience_s=3.0 if finished else 0.0)
    tables = event_tables(logs, timing.record_from_ns)
    tables |= meter_tables(stalls.seen, tables.get("machine_stall"))
    notes = list(_notes(realtime, permitted, memory_locked, clock_offset() - offset))
    if ended_ns is not None:
        tables = dict(events.happened(tables, 0, timing.stop_ns))
        notes.append(f"interrupted: {timing.cycles} of {cycles} cycles were recorded")
    together = in_force_throughout(governed)
    in_force = None if plan is None else InForceInfo(since_ns=timing.record_from_ns)
    if plan is None and together is not None:
        plan = together.plan
        in_force = InForceInfo(since_ns=together.since_ns, until_ns=together.until_ns)
    info = RecordingInfo(
        source="live",
        rmw="cyclonedds",
        clock_offset_ns=offset,
        command=tuple(command),
        processes={pid: node for node, pid in pids.items()},
        threads=threads,
        realtime=realtime,
        notes=tuple(notes),
        stall_meter=stalls.info,
        chain=application.chain,
        application=application_as_written(application),
        plan=plan,
        in_force=in_force,
    )
    recording = write_recording(output, tables, info)
    if ended_ns is not None:
        raise OperationError(f"{notes[-1]}; they are in {output}")
    return recording


def _permitted(wanted: bool | None) -> bool:
    """Whether SCHED_FIFO is. Raises PlatformError: it is wanted and is not."""
    permitted = may_use_fifo()
    if wanted and not permitted:
        raise PlatformError(
            "real-time scheduling was asked for, but this process may not use SCHED_FIFO: run as "
            "root, give your user an rtprio limit of 98 in /etc/security/limits.conf, or do without"
        )
    return permitted


def _between_releases(application: Application) -> int:
    """Where behind the anchor stall meters wake up, and every millisecond then."""
    gates = (cb.gate for _, cb in application.callbacks() if cb.gate is not None)
    return far_from([opens for gate in gates for opens, _ in gate.slots] or [0])


def _sooner(application: Application, cycles: int, timing: Timing) -> Timing:
    """The same run earlier by the whole hyper-periods of its timers that there is time to spare."""
    hyper = math.lcm(*(cb.timer_ns for _, cb in application.callbacks() if cb.timer_ns))
    spare = max(0, timing.start_ns - LEAD_NS - time.monotonic_ns())
    return timing_of(application, cycles, timing.start_ns - spare // hyper * hyper)


def _ended_early(children: Iterable[Child], timing: Timing, ended_ns: int) -> Timing:
    """Have the run end now; it stops behind its last whole cycle. Raises OperationError: none."""
    early = replace(timing, stop_ns=ended_ns)
    if early.cycles < 1:
        raise OperationError("interrupted before one whole cycle: nothing is recorded")
    for child in children:
        child.process.send_signal(launcher.ENOUGH)
    return replace(early, stop_ns=timing.record_from_ns + early.cycles * timing.period_ns)


def _start_nodes(application: Application, nodes: dict[str, Child], realtime: bool) -> None:
    """Start a process per node, into ``nodes``, with its name in the arguments that ROS 2 has."""
    from chainshaper.workload.dds import closed_domain_configuration, free_domain

    domain = free_domain()
    environment = {"CYCLONEDDS_URI": closed_domain_configuration(), **SINGLE_THREADED}
    for name in application.nodes:
        namespace, _, base = node_name(name).rpartition("/")
        nodes[name] = launcher.start_child(
            f"node {name}",
            "chainshaper.workload.node_process",
            environment,
            arguments=("--ros-args", "-r", f"__node:={base}", "-r", f"__ns:={namespace or '/'}"),
            libraries=LIBRARIES,
        )
        nodes[name].tell_model(_setup_of(application, name, domain, realtime))


def _setup_of(application: Application, name: str, domain: int, realtime: bool) -> NodeSetup:
    """What the process of the node gets before it runs."""
    described = [callback for _, callback in application.callbacks()]
    publishers = Counter(topic for callback in described for topic in callback.publishes)
    subscriptions = Counter(topic for callback in described for topic in callback.subscriptions)
    executor, dds = application.scheduling_of(name), application.dds_scheduling_of(name)
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
        origin_phase_ns=origin_timer(application)[1].phase_ns,
        delivery_core=dds.core if realtime and dds.core != executor.core else None,
    )


def _await_ready(children: Iterable[Child]) -> bool:
    """Wait until all have found each other; whether all of them could lock their memory."""
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
        cores = iter(application.cores_of(name))
        for thread in node_threads(child.pid):
            core, priority = dds.core, dds.priority
            if thread.role == "executor":
                core, priority = next(cores), executor.priority
            elif thread.role == "publisher":
                # Below the executor: it shares the writer's lock with it, and may spin on it.
                core, priority = executor.core, max(1, executor.priority - 1)
            cores_of_thread: tuple[int, ...] = (core,)
            if thread.role in ("executor", "publisher") and not application.nodes[name].bound:
                cores_of_thread = tuple(available_cores())
            wanted = SchedulingRequest(priority if realtime else None, cores=cores_of_thread)
            apply_scheduling(thread, wanted)


def _watch(
    nodes: dict[str, Child],
    meters: dict[int, Child],
    timing: Timing,
    progress: Progress,
) -> tuple[tuple[ThreadInfo, ...], tuple[Governed, ...], int | None]:
    """Wait for the end of the run. Raises OperationError: a process ended before its time.

    The threads as they were while it lasted, the plans that others put in force meanwhile
    (`chainshaper apply`), and when the run was interrupted, if it was (ns).
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
    found = [
        (node_name(name), one) for name, child in nodes.items() for one in node_threads(child.pid)
    ]
    found += [("", one) for child in meters.values() for one in list_threads(child.pid)]
    return tuple(
        ThreadInfo(
            node=node,
            role=one.role if node else "stall-meter",
            **{name: getattr(one, name) for name in SHOWN},
        )
        for node, one in found
    )


def node_threads(pid: int) -> list[RunningThread]:
    """The threads of a node's process. What a callback's module starts executes nothing, and has
    its thread's name.
    """
    return [
        replace(one, role="executor") if one.comm == launcher.WORKER_NAME else one
        for one in list_threads(pid)
    ]


@dataclass(frozen=True)
class ProcessLog:
    """What one process recorded: rows of :mod:`~chainshaper.workload.event_log`, and objects."""

    pid: int
    core: int | None  # the one its executor was pinned to, if it was one
    rows: bytes
    objects: tuple[dict[str, Any], ...]
    modes: tuple[str, ...] = ()  # that its gate knows

    def process(self) -> dict[str, Any]:
        """What all its events have."""
        return {"pid": self.pid, "cpu": self.core}


def event_tables(logs: Sequence[ProcessLog], from_ns: int) -> dict[str, pl.DataFrame]:
    """The event tables of all processes, sorted by time, from ``from_ns`` on, but for objects."""
    parts: dict[str, list[pl.DataFrame]] = {}
    for log in logs:
        rows = np.frombuffer(log.rows, dtype=np.int64).reshape(-1, WIDTH)
        rows = rows[rows[:, 1] >= from_ns]
        entries = {
            entry: dict(zip(("time", "tid", *fields), columns.T, strict=False)) | log.process()
            for number, (entry, fields) in enumerate(LAYOUT.items())
            if (columns := rows[rows[:, 0] == number, 1:]).size
        }
        found = list(logged_tables(entries, log.modes))
        own = {**log.process(), "tid": log.pid}
        for name in dict.fromkeys(created["event"] for created in log.objects):
            created = pl.DataFrame([one | own for one in log.objects if one["event"] == name])
            found.append((name, typed_table(name, created)))
        for name, table in found:
            parts.setdefault(name, []).append(table)
    return {
        name: pl.concat(tables).sort("time", maintain_order=True)
        for name, tables in sorted(parts.items())
    }


def logged_tables(
    entries: Mapping[str, Mapping[str, npt.NDArray[Any]]], modes: Sequence[str]
) -> Iterator[tuple[str, pl.DataFrame]]:
    """The events that entries of a log stand for, of which :data:`LAYOUT` says the fields: columns
    by their names, beside time and thread.
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
    """An event's table from columns of numbers, which stand for words and nulls as in the log."""
    types, words = events.column_types(name), {**WORDS, "mode": modes}
    columns = []
    for field in filter(frame.columns.__contains__, types):
        column = frame[field]
        if column.dtype == pl.Int64 and types[field] == pl.UInt64:  # a handle
            column = column.reinterpret(signed=False)
        if field in words:
            named = dict(enumerate(words[field]))
            column = column.replace_strict(named, default=None, return_dtype=pl.String())
        elif field in {"release", "slot"}:
            column = column.replace({ABSENT: None})
        columns.append(column.cast(types[field]))
    return pl.DataFrame(columns)


def _read_log(name: str, child: Child, application: Application) -> ProcessLog:
    answer = child.hear()
    rows = child.hear_bytes(answer["bytes"])
    core, *others = {*application.cores_of(name)}
    unbound = not application.nodes[name].bound
    modes = [cb.gate.modes for cb in application.nodes[name].callbacks if cb.gate is not None]
    names = tuple(modes[0].bands) if modes and modes[0] is not None else ()
    known = None if others or unbound else core
    return ProcessLog(child.pid, known, rows, tuple(answer["objects"]), names)


def _notes(
    realtime: bool, permitted: bool, memory_locked: bool, clock_moved_ns: int
) -> Iterator[str]:
    if not realtime:
        reason = "SCHED_FIFO was declined" if permitted else "the process may not use SCHED_FIFO"
        how = f"without real-time scheduling ({reason})"
        yield f"taken {how}, and without watching for stalls of the machine"
    if not memory_locked:
        yield "memory was not locked: page faults may have cost time"
    if abs(clock_moved_ns) > 1_000_000:
        yield f"the wall clock moved by {duration_text(clock_moved_ns)} against CLOCK_MONOTONIC"
    if others := foreign_realtime_processes():
        yield f"other real-time processes were running: {', '.join(others)}"
