"""Simulate an application, with or without a plan in force."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from chainshaper.planning.overruns import open_until_done
from chainshaper.planning.plan import Plan, publisher_servers
from chainshaper.simulation import layout as at
from chainshaper.simulation.arrays import Streams, System, build_machine, build_system
from chainshaper.simulation.layout import Int64s, Memory
from chainshaper.simulation.tables import Names, created_objects, event_frames, name_objects
from chainshaper.splicing.application import splice_application
from chainshaper.values.compiled import kernel
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import (
    InForceInfo,
    Recording,
    RecordingInfo,
    ThreadInfo,
    refuse_existing,
    write_recording,
)
from chainshaper.workload.description import Application, application_as_written
from chainshaper.workload.live import WARM_UP_CYCLES, origin_timer, timing_of

__all__ = ["simulate", "simulate_latencies"]

_run_engine = kernel("chainshaper.simulation.engine", "run")

START_NS = 1_000_000_000
LONGEST_NS = 1 << 62

Progress = Callable[[float, str], None]


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
    slots, its shaping node is spliced in and holds the output. ``seed`` replaces the
    description's. With ``switches`` the recording has `sched_switch` as well. Memory does not
    grow with ``cycles``. As in a live run, a few cycles before the recorded ones are left out.

    Raises:
        InputError: ``output`` exists, the plan does not fit the application, or a callback of it
            computes, so that its execution times are not known.
        OperationError: messages pile up without end, or the recording cannot be written.
    """
    output = refuse_existing(output)
    simulation = _prepare(application, plan, cycles, seed, events=True, switches=switches)
    info = RecordingInfo(
        source="simulated",
        host="simulation",  # thread ids say nothing about any real machine
        kernel="none",
        clock_offset_ns=0,
        command=tuple(command),
        processes={p.pid: p.node for p in simulation.system.processes},
        threads=_thread_infos(simulation.system, simulation.names),
        realtime=True,
        notes=(f"simulated; the first {WARM_UP_CYCLES} cycles were not recorded",),
        chain=simulation.system.application.chain,
        application=application_as_written(simulation.system.application),
        plan=None if plan is None else plan.model_dump(mode="json"),
        in_force=None if plan is None else InForceInfo(since_ns=simulation.record_from_ns),
    )
    return write_recording(output, _run(simulation, progress), info)


def simulate_latencies(
    application: Application,
    plan: Plan | None = None,
    *,
    cycles: int = 320,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Int64s:
    """The end-to-end latencies of an application's chain, by simulation (ns, one per cycle).

    What :func:`simulate` and the latency analysis of its recording give, without any event being
    written. −1 stands for an instance that did not complete: its message was discarded, lost, or
    merged with another's.

    Raises: as :func:`simulate`.
    """
    simulation = _prepare(application, plan, cycles, seed, events=False, switches=False)
    for _ in _run(simulation, progress):
        pass
    latencies: Int64s = simulation.machine["latencies"][0]
    return latencies


def _refuse_functions(application: Application) -> None:
    for name, callback in application.callbacks():
        if callback.computes is not None:
            raise InputError(
                f"node {name} computes {callback.computes}, and how long that takes is not known "
                "before it has run: measure it (`chainshaper run APP.yaml -o REC`), and simulate "
                "with the times that were recorded (--execution-times REC)"
            )


@dataclass(frozen=True)
class _Simulation:
    """A system with its machine, ready to run."""

    system: System
    machine: Memory
    streams: Streams
    names: Names
    record_from_ns: int


def _run(
    simulation: _Simulation, progress: Progress | None = None
) -> Iterator[dict[str, pl.DataFrame]]:
    """Run to the end; the event tables part by part as they fill up, objects first."""
    machine, control = simulation.machine, simulation.machine.array
    yield created_objects(simulation.names)
    while (reason := _run_engine(control.ctypes.data)) != at.OVER:
        if reason == at.MESSAGES_FULL:
            raise OperationError(
                "messages pile up without end: an executor or a publisher thread that never gets"
                " to run, or a delivery that takes far longer than a period; correct the"
                " description, or the plan's slots"
            )
        simulation.streams.fill(machine)
        if reason == at.LOG_FULL:
            yield _flush(simulation)
        if progress is not None:
            done = (control[at.X_NOW] - START_NS) / (control[at.X_STOP] - START_NS)
            progress(float(done), "simulating")
    if control[at.X_LOGGING]:
        yield _flush(simulation)


def _flush(simulation: _Simulation) -> dict[str, pl.DataFrame]:
    frames = event_frames(simulation.system, simulation.names, simulation.machine)
    simulation.machine["counts"][:, at.A_COUNT] = 0
    return frames


def _prepare(
    application: Application,
    plan: Plan | None,
    cycles: int,
    seed: int | None,
    *,
    events: bool,
    switches: bool,
) -> _Simulation:
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be simulated: ask for at least 1")
    _refuse_functions(application)
    if seed is not None:
        application = application.model_copy(update={"seed": seed})
    timer = origin_timer(application)
    period = timer.timer_ns or 0
    if plan is not None:
        if plan.chain.period_ns != period:
            raise InputError(
                f"the plan is for a chain with the period {format_duration(plan.chain.period_ns)},"
                f" but {application.chain} of {application.name!r} has {format_duration(period)}:"
                " plan again from a recording of this application"
            )
        if plan.shaping_node is not None or any(publisher_servers(plan)):  # not in a baseline
            application = splice_application(application, plan)
    system = build_system(application, follow_chain=not events)
    timing = timing_of(application, cycles, START_NS)
    slowest = max((cb.timer_ns or 0) + cb.phase_ns for _, cb in application.callbacks())
    if timing.stop_ns + slowest > LONGEST_NS:
        raise InputError(
            f"{cycles} cycles with the durations of {application.name!r} would end in"
            f" {format_duration(timing.stop_ns + slowest)}: simulate {format_duration(LONGEST_NS)}"
            " at the most"
        )
    streams = Streams(application.seed)
    machine, cores = build_machine(
        system,
        None if plan is None else open_until_done(plan),
        timing,
        streams,
        events=events,
        switches=switches,
        latencies=0 if events else cycles,
        warm_up=WARM_UP_CYCLES,
    )
    return _Simulation(
        system, machine, streams, name_objects(system, machine, cores), timing.record_from_ns
    )


def _thread_infos(system: System, names: Names) -> tuple[ThreadInfo, ...]:
    return tuple(
        ThreadInfo(
            tid=thread.tid,
            pid=system.processes[thread.process].pid,
            comm=comm,
            node=system.processes[thread.process].node,
            role=thread.role,
            policy="SCHED_FIFO",
            priority=thread.priority,
            cores=(int(core),),
        )
        for thread, comm, core in zip(system.threads, names.comms, names.cpus, strict=True)
    )
