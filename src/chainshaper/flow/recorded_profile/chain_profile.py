"""The profile of a chain from the analysis of a recording."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis
from chainshaper.flow.recorded_profile.executors import (
    executors_of_chain,
    interfering_callbacks,
    nodes_sharing_processes,
    utilisation,
)
from chainshaper.flow.recorded_profile.output import (
    longest_send,
    receivers_of,
    reception_of,
    writer_of,
)
from chainshaper.flow.recorded_profile.stages import Stage, taking_part, upstream_topics
from chainshaper.flow.recorded_profile.times import (
    GraphSteps,
    Steps,
    callback_times,
    chain_steps,
    graph_steps,
    undisturbed_instances,
)
from chainshaper.planning import Profile
from chainshaper.planning.request import DEFAULT_CORE
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.handed_over import through_texts
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import longest_stall
from chainshaper.verify.promises import NOT_PUBLISHED

DEFAULT_PRIORITY = 80
_SAME_SPEED = 0.02  # so far may /clock be from the speed of time


def profile_of(
    recording: Recording,
    flow: DataFlow,
    analysis: LatencyAnalysis,
    *,
    stages: Sequence[Stage],
    begun_ns: int,
    period_ns: int | None,
    planned: Collection[int],
) -> Profile:
    """Return the profile of an analysed chain, whose stages are those of its graph.

    ``begun_ns`` is when the recording's first callback began, ``planned`` the callbacks of all
    chains that are profiled, with their branches; the rest is as for :func:`.profile_chains`.
    """
    graph, chain = analysis.graph, analysis.chain
    cycles = complete_cycles(recording, analysis)
    period = period_of(analysis, period_ns)
    simulated = _nodes_in_simulated_time(flow, analysis)
    nodes = taking_part(graph, chain, stages)
    executors = executors_of_chain(recording, flow, graph, stages)
    core_of = {node: executors.cores.get(node, DEFAULT_CORE) for node in nodes}
    instances = undisturbed_instances(flow, cycles.disturbed)
    steps = _steps(flow, analysis, stages, executors.cores, planned)
    measured = cycles.measured["traversal"].to_numpy()
    every = cycles.every["traversal"].to_numpy()
    receivers = receivers_of(graph, chain, nodes)
    writer = writer_of(recording, flow, stages[-1].node, chain.topics[-1])
    callbacks = {*chain.callbacks, *(number for stage in stages for number in stage.members)}
    return Profile(
        latencies_ns=cycles.measured["latency_ns"].to_numpy().astype(np.int64),
        every_latency_ns=cycles.every["latency_ns"].to_numpy().astype(np.int64),
        starts_ns=cycles.measured["start"].to_numpy() - begun_ns,
        period_ns=period,
        spec=chain.spec,
        nodes=tuple(graph.callbacks[number].node for number in chain.callbacks),
        topics=chain.topics,
        begins=(chain.callbacks[0], graph.callbacks[chain.callbacks[0]].label),
        upstream=upstream_topics(graph, chain, stages),
        core_of=core_of,
        executors=executors.named,
        callback_groups=executors.groups,
        cores=executors.cores,
        every_node=tuple(node.name for node in graph.nodes),
        together=nodes_sharing_processes(graph, nodes),
        receivers=receivers,
        reception=reception_of(flow, analysis, receivers, executors.cores, period),
        callbacks=tuple(
            callback_times(flow, instances, stage, core_of[stage.node]) for stage in stages
        ),
        steps_ns=steps.of_chain[measured],
        every_step_ns=steps.of_chain[every],
        graph_steps_ns=steps.of_graph_in(measured),
        every_graph_step_ns=steps.of_graph_in(every),
        begins_ns=steps.begins_ns,
        fifo_priority=min(97, executors.priorities.get(stages[-1].node, DEFAULT_PRIORITY) + 5),
        recording=str(recording.path),
        incomplete=analysis.statistics.incomplete - analysis.incomplete.get("not used", 0),
        unpublished=analysis.incomplete.get(NOT_PUBLISHED, 0),
        disturbed=int(cycles.every["disturbed"].sum()),
        realtime=recording.info.realtime,
        longest_stall_ns=longest_stall(recording),
        utilisation=utilisation(flow, graph, core_of, executors.running),
        longest_send_ns=longest_send(flow),
        lost_events=sum(recording.info.lost.values()) or None,
        longest_publication_ns=writer.longest_publication_ns,
        asynchronous=writer.asynchronous,
        intra_process=writer.intra_process,
        output_depth=writer.output_depth,
        through=through_texts(recording.info.through),
        simulated=simulated,
        interfering=interfering_callbacks(
            flow, analysis, executors.running, {*planned, *chain.callbacks}
        ),
        contradictions=tuple(
            contradiction.note
            for contradiction in flow.contradictions
            if callbacks & contradiction.callbacks
        ),
        all_disturbed=cycles.all_disturbed or None,
    )


@dataclass(frozen=True)
class Cycles:
    """The complete traversals of a chain."""

    every: pl.DataFrame
    measured: pl.DataFrame  # those of which times are taken
    disturbed: pl.DataFrame  # those of which no times are taken
    all_disturbed: bool  # whether fewer than two are undisturbed: times are taken of all


def complete_cycles(recording: Recording, analysis: LatencyAnalysis) -> Cycles:
    """Return the complete traversals. Raises OperationError: there are fewer than two."""
    every = analysis.traversals.filter("complete")
    if every.height < 2:
        traversals, complete = analysis.traversals.height, every.height or "none"
        raise OperationError(
            f"{recording.path}: of {traversals} traversals of {analysis.chain.spec} {complete} is"
            " complete, too few to plan from: see `chainshaper latency`, and record longer"
        )
    calm = every.filter(~pl.col("disturbed"))
    if calm.height < 2:
        return Cycles(every, every, every.clear(), all_disturbed=True)
    return Cycles(every, calm, every.filter("disturbed"), all_disturbed=False)


@dataclass(frozen=True)
class _ProfiledSteps:
    """What each callback of the chain took, and each stage of its graph, if it has branches."""

    of_chain: Steps
    of_graph: GraphSteps | None

    def of_graph_in(self, traversals: npt.NDArray[np.int64]) -> Steps:
        """Return what the stages of the graph took in these traversals; without branches, none."""
        if self.of_graph is None:
            return np.zeros((0, 0), np.int64)
        return self.of_graph.steps_ns[traversals]

    @property
    def begins_ns(self) -> tuple[int, ...]:
        """How long after the chain each stage begins that waits for none."""
        return () if self.of_graph is None else self.of_graph.begins_ns


def _steps(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    stages: Sequence[Stage],
    core_of: Mapping[str, int],
    planned: Collection[int],
) -> _ProfiledSteps:
    """Return the steps of the chain, alone with its branches, and of its graph."""
    chain = set(analysis.chain.callbacks)
    branches = {number for stage in stages for number in stage.members} - chain
    of_chain = chain_steps(flow, analysis, core_of, {*planned, *chain} - branches)
    if not branches:
        return _ProfiledSteps(of_chain, None)
    return _ProfiledSteps(of_chain, graph_steps(flow, analysis, stages, core_of, planned))


def period_of(analysis: LatencyAnalysis, given: int | None) -> int:
    """Return the period of a chain (ns): of the timer that starts it, else as ``given``.

    Raises InputError: it is not known, or known and given as well, or not positive.
    """
    first, spec = analysis.graph.callbacks[analysis.chain.callbacks[0]], analysis.chain.spec
    of_timer = first.period_ns
    if of_timer is not None and given not in (None, of_timer):
        raise InputError(
            "--period goes with --latencies, or with a chain that no timer starts, which"
            f" {first.label} does: leave it out"
        )
    period = given if of_timer is None else of_timer
    if period is None:
        apart = _between_starts(analysis)
        seen = "" if apart is None else f" (starts are {duration_text(int(apart))} apart, mostly)"
        raise InputError(
            f"chain {spec} starts at {first.label}, which is no timer, so its period is not"
            f" known{seen}: add --period, or begin the chain at the timer callback that starts it"
        )
    if period <= 0:
        raise InputError(
            f"chain {spec} cannot have the period {duration_text(period)}: give one longer than"
            " 0 ms, or begin the chain at a timer"
        )
    return period


def _between_starts(analysis: LatencyAnalysis) -> float | None:
    """Return how far apart traversals start, mostly (ns); None: there are fewer than two."""
    starts = analysis.traversals["start"].unique().sort()
    return float(np.median(np.diff(starts.to_numpy()))) if len(starts) > 1 else None


def _nodes_in_simulated_time(flow: DataFlow, analysis: LatencyAnalysis) -> tuple[str, ...]:
    """Return the nodes of a chain that follow `/clock`.

    Raises InputError: `/clock` does not run at the speed of time.
    """
    callbacks = [analysis.graph.callbacks[number] for number in analysis.chain.callbacks]
    following = set(flow.takes.filter(topic="/clock")["node"])
    nodes = tuple(
        dict.fromkeys(callback.node for callback in callbacks if callback.node in following)
    )
    first, apart = callbacks[0], _between_starts(analysis)
    if first.node in nodes and first.period_ns and apart:
        speed = first.period_ns / apart
        if abs(speed - 1) >= _SAME_SPEED:
            raise InputError(
                f"{first.node} follows /clock, which runs at {speed:.2f} of the speed of time: its"
                f" timer of {duration_text(first.period_ns)} expires every"
                f" {duration_text(round(int(apart), -5))}. Replay at that speed (`ros2 bag play"
                " --rate 1.0`), or start the nodes with use_sim_time:=false"
            )
    return nodes
