"""The steps of the flow as functions: measure → plan → shape → compare.

Each joins two rooms of the library (analysis and planning, splicing and workload), so that none
of them needs to know the other. Each verb of the command line is one call of a function here or
in a room.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper import events
from chainshaper.analysis import LatencyAnalysis, analyse_latency
from chainshaper.app import ApplicationGraph, Chain
from chainshaper.durations import format_duration
from chainshaper.errors import InputError, OperationError
from chainshaper.planning import Plan, plan_shaping
from chainshaper.recording import Recording
from chainshaper.sources import open_source
from chainshaper.splicing.application import splice_application
from chainshaper.workload.description import Application
from chainshaper.workload.live import Progress, origin_timer, run_application

__all__ = [
    "Comparison",
    "Measurement",
    "chain_of",
    "compare_recordings",
    "measure_latency",
    "plan_recording",
    "shape_application",
]


@dataclass(frozen=True)
class Measurement:
    """A recording with its chain's latency analysis.

    ``longest_stall_ns`` is the machine's own during the recording (None: nobody watched it),
    ``overruns`` counts messages that came too late for their publish slot (None: no gate ran),
    ``plan`` is the plan in force.
    """

    recording: Recording
    analysis: LatencyAnalysis
    longest_stall_ns: int | None
    overruns: int | None
    plan: Plan | None


@dataclass(frozen=True)
class Comparison:
    """The same chain in several recordings, usually before and after shaping."""

    chain: str
    measurements: tuple[Measurement, ...]


def chain_of(recording: Recording, chain: str | None) -> str:
    """The chain that was asked for, or the one that the recording itself names.

    Raises:
        InputError: neither names one.
    """
    named = chain or recording.info.chain
    if named is None:
        raise InputError(
            f"{recording.path} names no chain of interest: give one with --chain FIRST..LAST, "
            "such as --chain /t1../t5"
        )
    return named


def measure_latency(recording: Recording | str | Path, chain: str | None = None) -> Measurement:
    """Analyse the end-to-end latency of one chain in a recording."""
    if not isinstance(recording, Recording):
        recording = open_source(recording)
    analysis = analyse_latency(recording, chain_of(recording, chain))
    stalls = events.table(recording.events, "machine_stall")
    longest = None
    if recording.info.stall_meter is not None:
        longest = int(stalls["duration"].max() or 0)  # type: ignore[arg-type]
    overruns = None
    if "gate_release" in recording.events:
        overruns = recording.events["gate_release"].filter(pl.col("cycles_waited") > 0).height
    plan = recording.info.plan
    return Measurement(
        recording=recording,
        analysis=analysis,
        longest_stall_ns=longest,
        overruns=overruns,
        plan=None if plan is None else Plan.model_validate(plan, strict=False),
    )


def plan_recording(
    recording: Recording | str | Path,
    chain: str | None = None,
    *,
    epsilon_ns: int = 1_000_000,
    publish_slot_ns: int = 1_000_000,
    anchor: str = "stamp",
    spin_ns: int = 300_000,
    pause_ns: int = 500_000,
) -> Plan:
    """Plan single-band shaping of a recorded chain (eq. 1, 4).

    L̄ is the maximum over the cycles that the machine did not disturb: a stall of the machine is
    not part of the chain's latency. Period, cores and priorities are those of the recording.

    Raises:
        InputError: no chain, or a chain that no timer starts.
        OperationError: no complete undisturbed traversal, or L̄ does not fit into the period.
    """
    measurement = measure_latency(recording, chain)
    recording, analysis = measurement.recording, measurement.analysis
    complete = analysis.traversals.filter(pl.col("complete") & ~pl.col("disturbed"))
    if complete.height == 0:
        raise OperationError(
            f"{recording.path}: of {analysis.traversals.height} traversals of "
            f"{analysis.chain.spec} none is complete and undisturbed by the machine, so there is "
            "nothing to plan from: see `chainshaper latency`, and record again"
        )
    graph, found = analysis.graph, analysis.chain
    first = graph.callbacks[found.callbacks[0]]
    if first.period_ns is None:
        raise InputError(
            f"chain {found.spec} starts at {first.label}, which is no timer, so its period is not "
            "known: begin the chain at the timer callback that starts it"
        )
    executors = _executors(recording, graph, found)
    return plan_shaping(
        complete["latency_ns"].to_numpy().astype(np.int64),
        first.period_ns,
        spec=found.spec,
        output=found.topics[-1],
        publisher=graph.callbacks[found.callbacks[-1]].node,
        nodes=tuple(dict.fromkeys(graph.callbacks[i].node for i in found.callbacks)),
        epsilon_ns=epsilon_ns,
        publish_slot_ns=publish_slot_ns,
        recording=str(recording.path),
        incomplete=analysis.statistics.incomplete,
        disturbed=analysis.statistics.disturbed,
        realtime=recording.info.realtime,
        longest_stall_ns=measurement.longest_stall_ns,
        core=executors.core,
        anchor=anchor,  # type: ignore[arg-type]
        fifo_priority=min(97, executors.priority + 5),
        spin_ns=spin_ns,
        pause_ns=pause_ns,
    )


@dataclass(frozen=True)
class _Executors:
    core: int
    priority: int


def _executors(recording: Recording, graph: ApplicationGraph, chain: Chain) -> _Executors:
    """Core and priority of the chain's last executor, which R_m° shares (eq. 3)."""
    last = graph.callbacks[chain.callbacks[-1]]
    for thread in recording.info.threads:
        if thread.pid == last.pid and thread.role == "executor":
            return _Executors(thread.cores[0], thread.priority or 80)
    return _Executors(core=1, priority=80)


def shape_application(
    application: Application,
    plan: Plan,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    command: Sequence[str] = (),
    progress: Progress | None = None,
) -> Recording:
    """Splice the plan's shaping node into an application, run it and record it.

    Raises:
        InputError: the plan does not fit the application; and what
            :func:`~chainshaper.workload.live.run_application` raises.
    """
    period = origin_timer(application).timer_ns
    if period != plan.chain.period_ns:
        raise InputError(
            f"the plan is for a chain with the period {format_duration(plan.chain.period_ns)}, but "
            f"{application.chain} of {application.name!r} has {format_duration(period or 0)}: plan "
            "again from a recording of this application"
        )
    return run_application(
        splice_application(application, plan),
        output,
        cycles=cycles,
        realtime=realtime,
        plan=plan.model_dump(mode="json"),
        command=command,
        progress=progress,
    )


def compare_recordings(
    recordings: Sequence[Recording | str | Path], chain: str | None = None
) -> Comparison:
    """Measure the same chain in several recordings.

    Raises:
        InputError: fewer than two recordings, or a chain that one of them does not have.
    """
    if len(recordings) < 2:
        raise InputError("a comparison needs two recordings, such as `compare before after`")
    measurements = [measure_latency(recording, chain) for recording in recordings]
    return Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
