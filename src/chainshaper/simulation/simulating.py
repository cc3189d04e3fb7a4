"""Simulate an application, with or without a plan in force, and record its events.

Instead of described execution times, measured ones may be drawn: the CPU times of each callback's
instances in a recording, in the order in which they happened. So stretches of them stay correlated
in time, and those of callbacks that all ran once a cycle are of the same cycles. They end where the
callback first publishes: what publishing costs is described apart.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import _core
from chainshaper.analysis import recorded_flow
from chainshaper.analysis.flow import DataFlow
from chainshaper.planning.chain_plan import publisher_servers
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.planning.plan_file import plan_values
from chainshaper.simulation.machine import INSTANTS, Handles, Int64s, Machine
from chainshaper.simulation.system import System, build_system
from chainshaper.sources import open_source
from chainshaper.splicing.application import at_offsets, splice_application
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.progress import Progress
from chainshaper.values.recording import (
    InForceInfo,
    Recording,
    RecordingInfo,
    refuse_existing,
    write_recording,
)
from chainshaper.workload import live
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    ExecutionTime,
    NodeDescription,
    application_as_written,
    node_name,
)
from chainshaper.workload.event_log import EventLog
from chainshaper.workload.timing import Timing, timing_of

START_NS = 1_000_000_000
LONGEST_NS = 1 << 62
MOST = 100_000  # samples of an execution time: enough for any distribution


def simulate(
    application: Application,
    output: str | Path,
    plan: Plan | None = None,
    *,
    cycles: int = 320,
    seed: int | None = None,
    switches: bool = False,
    command: Sequence[str] = (),
    progress: Progress | None = None,
) -> Recording:
    """Simulate ``cycles`` periods of an application's chain and record its events.

    ``plan`` is in force as `chainshaper apply` has it: its servers run their threads in their
    slots, its shaping node is spliced in and delays the output. ``seed`` replaces the
    description's. With ``switches`` the recording has `sched_switch` as well. Memory does not
    grow with ``cycles``. As in a live run, a few cycles before the recorded ones are left out.

    Raises InputError: ``output`` exists, the plan does not fit the application, or a callback of it
    computes, so that its execution times are not known. OperationError: messages pile up without
    end, or the recording cannot be written.
    """
    output = refuse_existing(output)
    application, timing = _checked(application, plan, cycles, seed)
    system, objects, machine = _built(application, plan, timing, switches=switches)
    info = RecordingInfo(
        source="simulated",
        host="simulation",  # thread ids say nothing about any real machine
        kernel="none",
        clock_offset_ns=0,
        command=tuple(command),
        processes={
            process.pid: application.nodes[process.key].container or process.node
            for process in system.processes
        },
        threads=system.threads,
        realtime=True,
        notes=("simulated",),
        chain=application.chain,
        application=application_as_written(application),
        plan=None if plan is None else plan_values(plan),
        in_force=None if plan is None else InForceInfo(since_ns=timing.record_from_ns),
    )
    return write_recording(output, _event_tables(system, objects, machine, progress), info)


def simulate_latencies(
    application: Application,
    plan: Plan | None = None,
    *,
    cycles: int = 320,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Int64s:
    """Simulate an application; return its chain's end-to-end latencies (ns), without any event.

    They are those of :func:`simulate` and the latency analysis of its recording: one per instance
    of the chain, ``cycles`` at most. −1 stands for an instance that did not complete: its message
    was discarded, lost, or merged with another's.

    Raises: as :func:`simulate`.
    """
    application, timing = _checked(application, plan, cycles, seed)
    _, _, machine = _built(application, plan, timing, latencies=cycles)
    for _ in _runs(machine, progress):
        pass
    return machine.simulation.latencies()


def _checked(
    application: Application, plan: Plan | None, cycles: int, seed: int | None
) -> tuple[Application, Timing]:
    """Give the application seed and shaping nodes; return it, and the instants of its run.

    Raises InputError: too few or too many cycles, or a callback that computes.
    """
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be simulated: ask for at least 1")
    for name, callback in application.callbacks():
        if callback.computes is not None:
            raise InputError(
                f"node {name} computes {callback.computes}, and how long that takes is not known "
                "before it has run: measure it (`chainshaper run APP.yaml -o REC`), and simulate "
                "with the times that were recorded (--execution-times REC)"
            )
    if seed is not None:
        application = application.model_copy(update={"seed": seed})
    if plan is not None:
        shapes_every_chain = all(
            chain.shaping_node is not None or any(publisher_servers(chain)) for chain in plan.chains
        )
        if shapes_every_chain:
            application = splice_application(application, plan)
        else:  # a baseline
            application = at_offsets(application, plan)
    timing = timing_of(application, cycles, START_NS)
    slowest = max((cb.period_ns or 0) + cb.phase_ns for _, cb in application.callbacks())
    if timing.stop_ns + slowest > LONGEST_NS:
        raise InputError(
            f"{cycles} cycles with the durations of {application.name!r} would end in"
            f" {duration_text(timing.stop_ns + slowest)}: simulate {duration_text(LONGEST_NS)}"
            " at the most"
        )
    return application, timing


def _built(
    application: Application,
    plan: Plan | None,
    timing: Timing,
    *,
    switches: bool = False,
    latencies: int = 0,
) -> tuple[System, list[live.ProcessLog], Machine]:
    """Build what is simulated, the log of its objects' creation, and the engine's description."""
    in_force = None if plan is None else open_until_done(plan)
    system = build_system(application, in_force, follow_chain=latencies > 0)
    objects, handles = _create_objects(system)
    machine = Machine(system, handles, in_force, timing, switches=switches, latencies=latencies)
    return system, objects, machine


def _runs(machine: Machine, progress: Progress | None = None) -> Iterator[_core.Pause]:
    """Run to the end; yield why the engine paused, each time that it does.

    Raises OperationError: messages pile up, or callbacks call each other, without end.
    """
    simulation, described = machine.simulation, machine.description
    while (reason := simulation.run(INSTANTS)) != _core.Pause.over:
        if reason == _core.Pause.messages_full:
            raise OperationError(
                "messages pile up without end: an executor or a publisher thread that never gets"
                " to run, or a delivery that takes far longer than a period; correct the"
                " description, or the plan's slots"
            )
        if reason == _core.Pause.endless:
            raise OperationError(
                "callbacks have each other called without end while no time passes: give one of"
                " them an execution time, or a topic on the way a delivery time"
            )
        yield reason
        if progress is not None:
            elapsed, whole_run = simulation.now_ns - START_NS, described.stop_ns - START_NS
            progress(elapsed / whole_run, "simulating")
    yield _core.Pause.over


def _event_tables(
    system: System,
    objects: Sequence[live.ProcessLog],
    machine: Machine,
    progress: Progress | None,
) -> Iterator[dict[str, pl.DataFrame]]:
    """Yield the event tables part by part as the log fills up, those of objects first."""
    yield live.event_tables(objects, from_ns=0)
    for reason in _runs(machine, progress):
        if reason != _core.Pause.none:
            yield _logged(system, machine.simulation.take_log())


def _create_objects(system: System) -> tuple[list[live.ProcessLog], Handles]:
    """Give every object a handle, unique in its process, and note its creation."""
    first_of: dict[int, EventLog] = {}  # of a process, whose handles all of its nodes number
    logs = []
    for process in system.processes:
        first = first_of.get(process.pid)
        new_handle = None if first is None else first.new_handle
        logs.append(EventLog(clock=lambda: 0, new_handle=new_handle))
        first_of.setdefault(process.pid, logs[-1])
    for process, log in zip(system.processes, logs, strict=True):
        log.node(process.node, "simulation")
    publishers = [
        logs[publisher.process].publisher(
            publisher.topic, system.depth(publisher.topic), publisher.asynchronous
        )
        for publisher in system.publishers
    ]
    entities = []
    for entity in system.entities:
        log = logs[entity.process]
        if entity.kind == "loop":
            log.loop(system.processes[entity.process].node)
            entities.append((0, 0, 0))
            continue
        filtered = "message_filters::" if entity.described.synchronises else ""
        node = system.processes[entity.process].node
        callback = log.callback(f"{filtered}{node}::callback{entity.index}")
        if entity.topic is None:
            handle, rmw_handle = log.timer(callback, entity.described.timer_ns or 0), 0
        else:
            depth = system.depth(entity.topic)
            handle, rmw_handle = log.subscription(callback, entity.topic, depth)
        entities.append((callback, handle, rmw_handle))
    core_of = {info.pid: info.cores[0] for info in system.threads if info.role == "executor"}
    created = [
        live.ProcessLog(process.pid, core_of[process.pid], b"", tuple(log.objects))
        for process, log in zip(system.processes, logs, strict=True)
    ]
    return created, Handles(entities, publishers)


def _logged(
    system: System, log: Mapping[str, Mapping[str, npt.NDArray[Any]]]
) -> dict[str, pl.DataFrame]:
    """Make event tables of a part of the log; those without a row are left out."""
    tables = dict(live.logged_tables(log, system.modes))
    # The engine logs these when they end, and their time is when they began.
    for name in {"asynchronous_send", "gate_release"} & tables.keys():
        tables[name] = tables[name].sort("time", maintain_order=True)
    switches = log["context_switch"]
    if switches["time"].size:
        tables["sched_switch"] = _switches(system, switches)
    return tables


def _switches(system: System, switches: Mapping[str, npt.NDArray[Any]]) -> pl.DataFrame:
    """The table `sched_switch`; the log has threads' places, and −1, the last, for the idle one."""
    pids = np.array([*(info.pid for info in system.threads), 0], dtype=np.int32)
    tids = np.array([*(info.tid for info in system.threads), 0], dtype=np.int32)
    comms = np.array([*(info.comm for info in system.threads), "swapper"])
    priorities = np.array([*(99 - info.priority for info in system.threads), 120])
    before, following = switches["previous"], switches["thread"]
    columns = {
        "time": switches["time"],
        "cpu": np.array(system.cores)[switches["core"]],
        "prev_state": 1 - switches["runnable"],
        "pid": pids[before],
        "tid": tids[before],
    }
    for key, values in (("comm", comms), ("tid", tids), ("prio", priorities)):
        columns |= {f"prev_{key}": values[before], f"next_{key}": values[following]}
    return live.typed_table("sched_switch", pl.DataFrame(columns))


def with_recorded_times(
    application: Application, recording: Recording | str | Path, *, block: int = 1
) -> Application:
    """Have execution times drawn from a recording of the application, in stretches of ``block``.

    Gates keep what they have: they compute nothing. Callbacks of a node with the same period or
    topic are told apart by the order in which they were registered.

    Raises InputError: a callback of the application is not in the recording, or its CPU time is
    not.
    """
    recording = recording if isinstance(recording, Recording) else open_source(recording)
    times = _computing_times(recorded_flow(recording))
    nodes = {}
    for key, node in application.nodes.items():
        name = node_name(key)
        recorded = {trigger: callbacks for (of, trigger), callbacks in times.items() if of == name}
        callbacks = tuple(_with_times(node, recorded, f"{recording.path}: {name}", block))
        nodes[key] = node.model_copy(update={"callbacks": callbacks})
    return application.model_copy(update={"nodes": nodes})


_Trigger: TypeAlias = str | int  # a topic, a timer's period, or `_LOOP`
_LOOP = "its loop"  # of which a node has one


def _triggers(callback: CallbackDescription) -> tuple[_Trigger, ...]:
    if callback.loop_ns is not None:
        return (_LOOP,)
    return callback.subscriptions if callback.timer_ns is None else (callback.timer_ns,)


def _with_times(
    node: NodeDescription,
    recorded: Mapping[_Trigger, Sequence[pl.DataFrame]],
    where: str,
    block: int,
) -> Iterator[CallbackDescription]:
    """Yield a node's callbacks with the execution times that were recorded.

    ``recorded`` is the node's part of :func:`_computing_times`: a frame per callback, by trigger.
    ``where`` names recording and node in messages.
    """
    described = Counter(trigger for callback in node.callbacks for trigger in _triggers(callback))
    before = Counter[_Trigger]()
    for callback in node.callbacks:
        parts: list[pl.DataFrame] = []
        for trigger in _triggers(callback):
            candidates, place = recorded.get(trigger, ()), before[trigger]
            parts += candidates[place : place + 1]
            before[trigger] += 1
            if callback.gate is None and len(candidates) != described[trigger]:
                timers = "" if isinstance(trigger, str) else f"timers of {duration_text(trigger)}"
                raise InputError(
                    f"{where} has CPU times of {len(candidates)} callbacks of {timers or trigger},"
                    f" and {described[trigger]} are described: record the application that is"
                    " described, with its threads' CPU times or sched_switch"
                )
        if callback.gate is not None:
            yield callback
            continue
        instances = pl.concat(parts).sort("start")
        if callback.synchronises:  # the others only left their message
            instances = instances.filter("published")
        if instances.is_empty():
            raise InputError(
                f"{where} never published what it synchronises from"
                f" {', '.join(callback.synchronises)}, by which instances that computed are told"
                " from those that left a message: have it publish a topic"
            )
        drawn = samples(instances["used"]).model_copy(update={"block": block})
        yield callback.model_copy(update={"execution": drawn, "computes": None})


def _computing_times(flow: DataFlow) -> dict[tuple[str, _Trigger], list[pl.DataFrame]]:
    """The callbacks' instances, a frame per callback, by node and trigger, as they were registered.

    Columns:
        start: when the instance began (ns).
        used: its CPU time up to its first publication (ns).
        published: whether it published.
    """
    published = flow.publications.group_by("instance").agg(first=pl.col("time").min())
    of_callback = ("callback_id", "node", "topic", "period_ns", "kind")
    callbacks = flow.objects.callbacks.select(of_callback)
    frame = (
        flow.instances.join(published, on="instance", how="left")
        .join(callbacks.unique("callback_id"), on="callback_id")
        .with_columns(
            used=pl.col("execution_ns") - (pl.col("end") - pl.col("first")).fill_null(0),
            published=pl.col("first").is_not_null(),
        )
        .drop_nulls("used")
        .sort("callback_id")  # they are numbered in order of registration
    )
    frames: dict[tuple[str, _Trigger], list[pl.DataFrame]] = {}
    for (_, node, topic, period, kind), rows in frame.group_by(*of_callback, maintain_order=True):
        trigger: _Trigger = str(topic) if period is None else int(period)
        if kind == "loop":
            trigger = _LOOP
        instances = rows.select("start", "used", "published")
        frames.setdefault((str(node), trigger), []).append(instances)
    return frames


def samples(values: pl.Series) -> ExecutionTime:
    """An execution time that draws from measured ones (ns)."""
    return ExecutionTime(samples_ns=tuple(values.drop_nulls().clip(0).head(MOST).to_list()))
