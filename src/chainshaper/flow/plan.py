"""From recordings to a plan, and a run of a described application that the plan shapes.

A chain in a graph waits at synchronising callbacks for branches that are not part of it (paper,
section 2.3). Whoever plans slots for its callbacks has to plan for those branches too, so they are
followed backwards here, from every input of a synchronising callback to what starts it, or to the
node with which the chain begins: what feeds a subscription there is not planned for.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, analyse_latency, data_flow
from chainshaper.analysis.disturbance import overlapping
from chainshaper.analysis.graph import goes_on_elsewhere
from chainshaper.planning import CallbackTimes, Plan, PlanRequest, Profile, plan_chain
from chainshaper.planning.application_plan import ApplicationPlan, plan_values, whole
from chainshaper.planning.plan import publisher_servers
from chainshaper.planning.request import DEFAULT_CORE
from chainshaper.sources import open_source
from chainshaper.splicing.application import splice_application
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Callback, Chain
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import chain_of, longest_stall
from chainshaper.workload.description import Application
from chainshaper.workload.live import Enforcement, Progress, run_application

__all__ = ["plan_recording", "profile_chains", "shape_application"]

DEFAULT_PRIORITY = 80
_STANDARD = PlanRequest()


def profile_chains(
    recording: Recording | str | Path,
    chains: Sequence[str | None] = (None,),
    *,
    period_ns: int | None = None,
) -> tuple[Profile, ...]:
    """What the planner needs of recorded chains: see :func:`chainshaper.planning.plan_chain`.

    ``period_ns`` is for chains that no timer starts; None stands for the chain that the recording
    names. Latencies and all other times but ``every_latency_ns`` are over cycles that the machine
    did not disturb: a stall is not part of the chain's latency, but its output is late
    nevertheless. Only where fewer than two were undisturbed, they are over all.

    Raises InputError: no such chain, or a chain's period is not known, or known and given as well.
    OperationError: a chain with fewer than two complete traversals.
    """
    if not isinstance(recording, Recording):
        recording = open_source(recording)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    analyses = [analyse_latency(flow, chain_of(recording, chain)) for chain in chains]
    return tuple(_profile_of(recording, flow, analysis, period_ns) for analysis in analyses)


def _profile_of(
    recording: Recording, flow: DataFlow, analysis: LatencyAnalysis, period_ns: int | None
) -> Profile:
    graph, chain, statistics = analysis.graph, analysis.chain, analysis.statistics
    every = analysis.traversals.filter("complete")
    if every.height < 2:
        raise OperationError(
            f"{recording.path}: of {analysis.traversals.height} traversals of {chain.spec}"
            f" {every.height or 'none'} is complete, too few to plan from: see `chainshaper"
            " latency`, and record again, longer"
        )
    calm = every.filter(~pl.col("disturbed"))
    all_disturbed = calm.height < 2
    disturbed = every.clear() if all_disturbed else every.filter("disturbed")
    period = _period(analysis, period_ns)
    stages = graph_stages(graph, chain)
    cores, priority = _executors(recording, graph)
    nodes = dict.fromkeys(stage.node for stage in stages)
    core_of = {node: cores.get(node, DEFAULT_CORE) for node in nodes}
    instances = _instances_apart_from(flow, disturbed)
    measured = every if all_disturbed else calm
    return Profile(
        latencies_ns=measured["latency_ns"].to_numpy().astype(np.int64),
        every_latency_ns=every["latency_ns"].to_numpy().astype(np.int64),
        period_ns=period,
        spec=chain.spec,
        nodes=tuple(graph.callbacks[number].node for number in chain.callbacks),
        topics=chain.topics,
        begins=(chain.callbacks[0], graph.callbacks[chain.callbacks[0]].label),
        upstream=_upstream(graph, chain, stages),
        core_of=core_of,
        together=_together(graph, nodes),
        receivers=_receivers(graph, chain, nodes),
        callbacks=tuple(_times(flow, instances, stage, core_of[stage.node]) for stage in stages),
        fifo_priority=min(97, priority.get(stages[-1].node, DEFAULT_PRIORITY) + 5),
        recording=str(recording.path),
        incomplete=statistics.incomplete,
        disturbed=statistics.disturbed,
        realtime=recording.info.realtime,
        longest_stall_ns=longest_stall(recording),
        utilisation=_utilisation(flow, graph, core_of),
        longest_send_ns=_longest_send(flow),
        lost_events=sum(recording.info.lost.values()) or None,
        output_depth=_output_depth(flow, stages[-1].node, chain.topics[-1]),
        all_disturbed=all_disturbed or None,
    )


def _period(analysis: LatencyAnalysis, given: int | None) -> int:
    first = analysis.graph.callbacks[analysis.chain.callbacks[0]]
    if first.period_ns is not None and given not in (None, first.period_ns):
        raise InputError(
            "--period goes with --latencies, or with a chain that no timer starts:"
            f" {first.label} has its own period, leave it out"
        )
    period = given if first.period_ns is None else first.period_ns
    if period is not None:
        return period
    starts = analysis.traversals["start"].unique().sort().to_numpy()
    seen = f" (starts are {format_duration(int(np.median(np.diff(starts))))} apart, mostly)"
    raise InputError(
        f"chain {analysis.chain.spec} starts at {first.label}, which is no timer, so its period is"
        f" not known{seen if len(starts) > 1 else ''}: add --period, or begin the chain at the"
        " timer callback that starts it"
    )


@dataclass(frozen=True)
class _Stage:
    """One step of the graph: a callback, or the inputs of a synchronising one, as one.

    ``after`` are the places of the stages that it waits for.
    """

    node: str
    topic: str
    members: tuple[int, ...]
    after: tuple[int, ...]


_Key = tuple[tuple[int, ...], str]
"""A stage while it is looked for: its callbacks, and the topic it publishes."""


def graph_stages(graph: ApplicationGraph, chain: Chain) -> list[_Stage]:
    """The chain and the branches it waits for, along the graph; the chain's last stands last."""
    outside = _feeding(graph, chain)
    along: list[_Key] = []
    before: dict[int, list[_Key]] = {}  # of the chain's callbacks
    of_chain: dict[int, _Key] = {}
    for number, topic in zip(chain.callbacks, chain.topics, strict=True):
        members = _inputs(graph, graph.callbacks[number], topic) if along else (number,)
        before[number] = along[-1:]
        along.append((members, topic))
        of_chain.update(dict.fromkeys(members, along[-1]))
    needs: dict[_Key, set[_Key]] = {}

    def writers_of(topic: str | None) -> list[_Key]:
        return [
            of_chain.get(writer.id) or (_inputs(graph, writer, topic), topic)
            for writer in graph.callbacks
            if topic is not None and topic in writer.publishes and writer.node not in outside
        ]

    def follow(key: _Key, above: set[_Key]) -> None:
        needs[key] = set()
        for number in key[0]:
            on_chain = key in along and number in before
            read = graph.callbacks[number].topic
            for one in before[number] if on_chain else writers_of(read):
                if one not in above:  # what feeds back comes from a cycle before
                    needs[key].add(one)
                    if one not in needs:
                        follow(one, above | {one})

    follow(along[-1], {along[-1]})
    level: dict[_Key, int] = {}

    def level_of(key: _Key) -> int:
        if key not in level:
            level[key] = 0  # ends a loop
            level[key] = 1 + max((level_of(one) for one in needs[key]), default=-1)
        return level[key]

    order = sorted(needs, key=lambda key: (level_of(key), key not in along, key))
    return [
        _Stage(
            node=graph.callbacks[members[0]].node,
            topic=topic,
            members=members,
            after=tuple(sorted(order.index(one) for one in needs[members, topic])),
        )
        for members, topic in order
    ]


def _upstream(graph: ApplicationGraph, chain: Chain, stages: list[_Stage]) -> frozenset[str]:
    """The topics that the chain's output waits for, those before its first callback included."""
    found = {stage.topic for stage in stages}
    first = graph.callbacks[chain.callbacks[0]].topic
    ahead = set() if first is None else {first}
    while ahead:
        found |= ahead
        writers = [
            (callback, topic)
            for callback in graph.callbacks
            for topic in ahead.intersection(callback.publishes)
        ]
        inputs = [number for one, topic in writers for number in _inputs(graph, one, topic)]
        read = {graph.callbacks[number].topic for number in inputs}
        ahead = {topic for topic in read if topic is not None} - found
    return frozenset(found - {chain.topics[-1]})


def _feeding(graph: ApplicationGraph, chain: Chain) -> set[str]:
    """All nodes that feed the node with which a chain begins, if it begins with a subscription."""
    first = graph.callbacks[chain.callbacks[0]]
    own = {graph.callbacks[number].node for number in chain.callbacks}
    found: set[str] = set()
    fed = set() if first.topic is None else {first.node}
    while fed:
        topics = {callback.topic for callback in graph.callbacks if callback.node in fed}
        fed = {writer.node for writer in graph.callbacks if topics.intersection(writer.publishes)}
        fed -= found | own
        found |= fed
    return found


def _inputs(graph: ApplicationGraph, callback: Callback, topic: str) -> tuple[int, ...]:
    """The callback and, where it is an input of a synchronising one, the other inputs."""
    if not goes_on_elsewhere(graph, callback, topic):
        return (callback.id,)
    return tuple(
        other.id
        for other in graph.callbacks
        if (other.pid, other.node) == (callback.pid, callback.node) and topic in other.publishes
    )


def _times(flow: DataFlow, instances: pl.DataFrame, stage: _Stage, core: int) -> CallbackTimes:
    """Response times of a stage: those of the instances that publish.

    At a synchronising callback the other inputs' instances come before, in the same slot.
    """
    published = flow.publications.filter(pl.col("topic") == stage.topic)["instance"].drop_nulls()
    publishes = pl.col("instance").is_in(published.implode())
    own = instances.filter(pl.col("callback_id").is_in(stage.members))
    response = (publishing if (publishing := own.filter(publishes)).height else own)["response"]
    if response.is_empty():
        raise OperationError(
            f"no execution of {stage.node} that publishes {stage.topic} was recorded undisturbed:"
            " record again"
        )
    others = own.filter(~publishes) if len(stage.members) > 1 else own.clear()
    waiting = others.group_by("callback_id").agg(pl.col("response").max())["response"].sum()
    return CallbackTimes(
        node=stage.node,
        core=core,
        min_response_ns=int(response.min()),  # type: ignore[arg-type]
        mean_response_ns=round(float(response.mean())),  # type: ignore[arg-type]
        max_response_ns=int(response.max()) + waiting,  # type: ignore[arg-type]
        after=stage.after,
    )


def _instances_apart_from(flow: DataFlow, disturbed: pl.DataFrame) -> pl.DataFrame:
    """Finished instances, with their response time, that began in none of these traversals."""
    seen = flow.instances.filter(pl.col("end").is_not_null() & ~pl.col("assumed"))
    began = seen["start"].to_numpy()
    # An instance that begins just as a traversal ends is hit by it as well.
    hit = overlapping(began, began, disturbed["start"].to_numpy(), disturbed["end"].to_numpy() + 1)
    response = pl.col("end") - pl.col("start")
    return seen.filter(~pl.Series(hit)).select("instance", "callback_id", response=response)


def _together(graph: ApplicationGraph, nodes: Collection[str]) -> tuple[tuple[str, ...], ...]:
    """The processes that host several nodes, these among them: they may share an executor."""
    hosts: dict[int, list[str]] = {}
    for one in graph.nodes:
        hosts.setdefault(one.pid, []).append(one.name)
    return tuple(
        tuple(own) for own in hosts.values() if len(own) > 1 and not set(own).isdisjoint(nodes)
    )


def _receivers(graph: ApplicationGraph, chain: Chain, nodes: Collection[str]) -> tuple[str, ...]:
    """Who subscribes to the chain's output, and has no part in the chain.

    Nodes with a hidden name are tools such as `ros2 topic echo`, which come and go.
    """
    return tuple(
        node
        for node in graph.subscribers.get(chain.topics[-1], ())
        if node not in nodes and not node.rpartition("/")[2].startswith("_")
    )


def _executors(
    recording: Recording, graph: ApplicationGraph
) -> tuple[dict[str, int], dict[str, int]]:
    """Core and SCHED_FIFO priority of every node's executor, where the recording knows them."""
    by_pid = {thread.pid: thread for thread in recording.info.threads if thread.role == "executor"}
    found = {node.name: by_pid[node.pid] for node in graph.nodes if node.pid in by_pid}
    return (
        {name: thread.cores[0] for name, thread in found.items() if len(thread.cores) == 1},
        {name: thread.priority for name, thread in found.items() if thread.priority},
    )


def _longest_send(flow: DataFlow) -> int | None:
    """How long asynchronous publishers were busy sending one message, at most (ns).

    Without sends that a stall of the machine fell into: it says nothing about sending.
    """
    sends = events.table(flow.events, "asynchronous_send").filter(pl.col("outcome") == "sent")
    if not sends.height:
        return None
    stalls = events.table(flow.events, "machine_stall")
    (began, ended), (stalled, over) = (
        (one["time"].to_numpy(), (one["time"] + one["duration"]).to_numpy())
        for one in (sends, stalls)
    )
    calm = sends.filter(~pl.Series(overlapping(began, ended, stalled, over)))
    return int((calm if calm.height else sends)["duration"].max())  # type: ignore[arg-type]


def _output_depth(flow: DataFlow, node: str, topic: str) -> int | None:
    """The history (keep last) of the writer of the chain's output."""
    writers = flow.objects.publishers.filter((pl.col("node") == node) & (pl.col("topic") == topic))
    depths = (
        events.table(flow.events, "rcl_publisher_init", ["queue_depth"])
        .join(writers.select("pid", publisher_handle="handle"), on=["pid", "publisher_handle"])
        .filter(pl.col("queue_depth") > 0)["queue_depth"]
    )
    return int(depths.min()) if depths.len() else None  # type: ignore[arg-type]


def _utilisation(flow: DataFlow, graph: ApplicationGraph, core_of: dict[str, int]) -> float | None:
    """The largest share of a core that the executors of the chain's nodes take."""
    core = {one.id: core_of[one.node] for one in graph.callbacks if one.node in core_of}
    ran = flow.instances.filter(
        pl.col("callback_id").is_in(list(core)) & pl.col("execution_ns").is_not_null()
    )
    if not ran.height:
        return None
    lasted = int(ran["end"].max()) - int(ran["start"].min())  # type: ignore[arg-type]
    of_core = ran.group_by(pl.col("callback_id").replace_strict(core))
    busy = of_core.agg(pl.col("execution_ns").sum())["execution_ns"].max()
    return float(busy) / max(1, lasted)  # type: ignore[arg-type]


def plan_recording(
    recording: Recording | str | Path,
    chain: str | None = None,
    request: PlanRequest = _STANDARD,
    *,
    period_ns: int | None = None,
    sinks: Sequence[str] = (),
) -> Plan:
    """Plan a recorded chain: single-band shaping (eq. 1, 4) unless ``request`` says otherwise.

    ``sinks`` are chains to further outputs of the same graph.

    Raises: as :func:`profile_chains` and :func:`chainshaper.planning.plan_chain`.
    """
    profile, *further = profile_chains(recording, (chain, *sinks), period_ns=period_ns)
    return plan_chain(profile, request, further)


def shape_application(
    application: Application,
    plan: Plan | ApplicationPlan,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    enforcement: Enforcement | None = None,
    command: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Recording:
    """Splice the plan's shaping nodes into an application, run it and record it.

    ``enforcement`` puts the plan's servers in force while it runs. A shaping node does without; the
    thread of an asynchronous publisher is gated unless ``enforcement`` does so
    (:func:`chainshaper.flow.apply.publishers_gated`).

    Raises InputError: the plan does not fit the application; and what
    :func:`~chainshaper.workload.live.run_application` raises. PlatformError: the plan gates a
    publisher's thread, and threads cannot be frozen here.
    """
    joint = whole(plan)
    if any(next(publisher_servers(one), None) for one in joint.chains) and enforcement is None:
        from chainshaper.flow.apply import publishers_gated

        enforcement = partial(publishers_gated, joint)
    return run_application(
        splice_application(application, joint),
        output,
        cycles=cycles,
        realtime=realtime,
        plan=plan_values(joint),
        enforcement=enforcement,
        command=command,
        progress=progress,
    )
