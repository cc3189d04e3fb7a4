"""From recordings to profiles, and to a plan.

A chain in a graph waits at synchronising callbacks for branches that are not part of it (paper,
section 2.3). Slots have to be planned for those too, so they are followed backwards, to what starts
them or to the node with which the chain begins: what feeds a subscription there is not planned for.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain as joined
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis import (
    DataFlow,
    LatencyAnalysis,
    analyse_latency,
    executors,
    recorded_flow,
)
from chainshaper.analysis.contradictions import refuse_contradicted
from chainshaper.analysis.disturbance import overlapping, stalled_within
from chainshaper.analysis.graph import goes_on_elsewhere
from chainshaper.analysis.latency import Executor
from chainshaper.planning import CallbackTimes, Modes, Plan, PlanRequest, Profile, plan_chain
from chainshaper.planning.latencies import read_latencies
from chainshaper.planning.profile import UNKNOWN, Interfering, Reception
from chainshaper.planning.request import DEFAULT_CORE
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Callback, Chain
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.middleware import middleware_of, thread_work
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import wrong_values_refused
from chainshaper.verify.measure import PARTS, chain_of, longest_stall, opened
from chainshaper.verify.promises import NOT_PUBLISHED
from chainshaper.workload.description import Application, node_name
from chainshaper.workload.timing import timing_of

DEFAULT_PRIORITY = 80
_STANDARD = PlanRequest()
_ONE_BEGINNING_NS = 5_000_000  # so far apart are two timers' starts in all cycles, but for others
_SAME_SPEED = 0.02  # so far may /clock be from the speed of time


def profile_chains(
    recording: Recording | str | Path,
    chains: Sequence[str | None] = (None,),
    *,
    period_ns: int | None = None,
    modes: Modes | None = None,
    mode_recordings: Mapping[str, str | Path] = MappingProxyType({}),
    since_ns: int = 0,
    until_ns: int | None = None,
) -> tuple[Profile, ...]:
    """What the planner needs of recorded chains: see :func:`chainshaper.planning.plan_chain`.

    ``period_ns`` is for chains that no timer starts; None stands for the chain that the recording
    names, or the only one in it. All times but ``every_latency_ns`` are over cycles that the
    machine did not disturb (of fewer than two: over all). Of ``modes``, each has a profile of its
    own: of its recording or file of latencies in ``mode_recordings``, or of the cycles that began
    in it, by the description of what ran. What happened before ``since_ns`` or from ``until_ns`` on
    is left out.

    Raises InputError: no such chain or mode, or a chain's period is not known, or known and given
    as well. OperationError: fewer than two complete traversals of a chain, or in a mode.
    """
    recording = opened(recording)
    all_events = recording.events
    begun = int(events.table(all_events, "callback_start")["time"].min() or 0)  # type: ignore[arg-type]
    if since_ns or until_ns is not None:
        until = None if until_ns is None else begun + until_ns
        recording = replace(recording, events=events.happened(all_events, begun + since_ns, until))
    flow = recorded_flow(recording)
    analyses = [analyse_latency(flow, chain_of(recording, chain, flow)) for chain in chains]
    stages = [graph_stages(one.graph, one.chain) for one in analyses]
    planned = {number for own in stages for stage in own for number in stage.members}
    chained = {number for one in analyses for number in one.chain.callbacks}
    refuse_contradicted(flow.contradictions, planned | chained, recording.path)
    profile_of = partial(
        _profile_of, recording, flow, begun_ns=begun, period_ns=period_ns, planned=planned
    )
    profiles = [profile_of(one, stages=own) for one, own in zip(analyses, stages, strict=True)]
    if modes is None:
        return tuple(profiles)
    if others := ", ".join(mode_recordings.keys() - modes.bands.keys()):
        raise InputError(f"{others}: none of the modes {', '.join(modes.bands)}: correct it")
    # Announcements are counted from the first one on, also where that is left out.
    announced = recorded_flow(replace(recording, events=all_events)) if since_ns else flow
    for number, analysis in enumerate(analyses):
        apart: dict[str, Profile] = {}
        for mode, place in mode_recordings.items():
            if Path(place).is_file():
                bare, period = read_latencies(Path(place)), profiles[number].period_ns
                apart[mode] = Profile(bare, period, recording=str(place))
            else:
                only = chains[number:][:1]
                (apart[mode],) = profile_chains(
                    place, only, period_ns=period_ns, since_ns=since_ns, until_ns=until_ns
                )
        in_force = _modes_in_force(recording, announced, analysis.traversals["start"], modes)
        for mode in modes.bands.keys() - apart if apart or in_force.count() else ():
            own = replace(analysis, traversals=analysis.traversals.filter(in_force == mode))
            try:
                apart[mode] = profile_of(own, stages=stages[number])
            except OperationError as error:
                remedy = f"or give the mode's own profile (--mode-profile {mode}=REC)"
                raise OperationError(f"mode {mode}: {error}; {remedy}") from error
        profiles[number] = replace(profiles[number], of_modes=apart)
    return tuple(profiles)


def _profile_of(
    recording: Recording,
    flow: DataFlow,
    analysis: LatencyAnalysis,
    *,
    stages: list["_Stage"],
    begun_ns: int,
    period_ns: int | None,
    planned: Collection[int],
) -> Profile:
    graph, chain = analysis.graph, analysis.chain
    every = analysis.traversals.filter("complete")
    if every.height < 2:
        every_one, complete = analysis.traversals.height, every.height or "none"
        counted = f"of {every_one} traversals of {chain.spec} {complete}"
        why = "complete, too few to plan from: see `chainshaper latency`, and record longer"
        raise OperationError(f"{recording.path}: {counted} is {why}")
    calm = every.filter(~pl.col("disturbed"))
    all_disturbed = calm.height < 2
    disturbed = every.clear() if all_disturbed else every.filter("disturbed")
    period = _period(analysis, period_ns)
    simulated = _simulated(flow, analysis)
    nodes = taking_part(graph, chain, stages)
    running, named, cores, priority = _executors(recording, flow, graph, stages)
    core_of = {node: cores.get(node, DEFAULT_CORE) for node in nodes}
    instances = _instances_apart_from(flow, disturbed)
    measured = every if all_disturbed else calm
    own = {*chain.callbacks, *(n for stage in stages for n in stage.members)}
    branches = own - {*chain.callbacks}
    steps = _steps(flow, analysis, cores, {*planned, *chain.callbacks} - branches)
    graph_steps, begins = np.zeros((0, 0), np.int64), tuple[int, ...]()
    if branches:
        graph_steps, begins = _graph_steps(flow, analysis, stages, cores, planned)
    measured_rows, every_row = (one["traversal"].to_numpy() for one in (measured, every))
    sends = events.table(flow.events, "asynchronous_send")
    receivers = tuple(  # tools such as `ros2 topic echo`, which come and go, have hidden names
        node
        for node in graph.subscribers.get(chain.topics[-1], ())
        if node not in nodes and not node.rpartition("/")[2].startswith("_")
    )
    return Profile(
        latencies_ns=measured["latency_ns"].to_numpy().astype(np.int64),
        every_latency_ns=every["latency_ns"].to_numpy().astype(np.int64),
        starts_ns=measured["start"].to_numpy() - begun_ns,
        period_ns=period,
        spec=chain.spec,
        nodes=tuple(graph.callbacks[number].node for number in chain.callbacks),
        topics=chain.topics,
        begins=(chain.callbacks[0], graph.callbacks[chain.callbacks[0]].label),
        upstream=_upstream(graph, chain, stages),
        core_of=core_of,
        executors=named,
        cores=cores,
        every_node=tuple(node.name for node in graph.nodes),
        together=_together(graph, nodes),
        receivers=receivers,
        reception=_reception(flow, analysis, receivers, cores, period),
        callbacks=tuple(_times(flow, instances, stage, core_of[stage.node]) for stage in stages),
        steps_ns=steps[measured_rows],
        every_step_ns=steps[every_row],
        graph_steps_ns=graph_steps[measured_rows] if branches else graph_steps,
        every_graph_step_ns=graph_steps[every_row] if branches else graph_steps,
        begins_ns=begins,
        fifo_priority=min(97, priority.get(stages[-1].node, DEFAULT_PRIORITY) + 5),
        recording=str(recording.path),
        incomplete=analysis.statistics.incomplete - analysis.incomplete.get("not used", 0),
        unpublished=analysis.incomplete.get(NOT_PUBLISHED, 0),
        disturbed=int(every["disturbed"].sum()),
        realtime=recording.info.realtime,
        longest_stall_ns=longest_stall(recording),
        utilisation=_utilisation(flow, graph, core_of, running),
        longest_send_ns=_longest_calm(flow, sends.filter(pl.col("outcome") == "sent")),
        lost_events=sum(recording.info.lost.values()) or None,
        **_writer(recording, flow, stages[-1].node, chain.topics[-1]),
        simulated=simulated,
        interfering=_interfering(flow, analysis, running, {*planned, *chain.callbacks}),
        contradictions=tuple(one.note for one in flow.contradictions if own & one.callbacks),
        all_disturbed=all_disturbed or None,
    )


def _reception(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    receivers: Sequence[str],
    core_of: Mapping[str, int],
    period_ns: int,
) -> Reception | None:
    """How a chain's output gets to those that receive it; None: no message did."""
    output, callbacks = analysis.chain.topics[-1], analysis.graph.callbacks
    own = [one.id for one in callbacks if one.trigger == output and one.node in receivers]
    known = analysis.traversals.filter(pl.col("complete") & ~pl.col("reception_disturbed"))
    known = known.drop_nulls("received")
    if not own or not known.height:
        return None
    cores = {core_of.get(node) for node in receivers}
    core = cores.pop() if len(cores) == 1 else None
    same = [one.id for one in callbacks if core is not None and core_of.get(one.node) == core]
    busy = flow.instances.drop_nulls("end").sort("start")
    others = busy.filter(pl.col("callback_id").is_in(same))
    end, received = known["end"].to_numpy(), known["received"].to_numpy()
    ended = np.maximum.accumulate(others["end"].to_numpy())
    began = np.maximum(others["start"].to_numpy(), np.append(0, ended)[:-1])
    waited = stalled_within(end, received, began, ended, np.zeros_like(began))
    shortest = int((received - end).min())
    on_its_way = np.maximum(received - end - waited, shortest)
    members = {
        k for one in executors(flow) if not one.callbacks.isdisjoint(own) for k in one.callbacks
    }
    took = pl.coalesce("execution_ns", pl.col("end") - pl.col("start"))
    ran = busy.with_columns(took=took, cycle=pl.col("start") // period_ns)
    of_output, beside = (
        ran.filter(pl.col("callback_id").is_in(list(which)))
        for which in (own, members.difference(own))
    )
    in_cycle = beside.group_by("cycle").agg(pl.col("took").sum())["took"]
    together = of_output.group_by("cycle").agg(pl.col("took").sum())["took"]
    return Reception(
        core=core,
        shortest_ns=int(on_its_way.min()),
        mean_ns=round(float(on_its_way.mean())),
        longest_ns=int(on_its_way.max()),
        time_ns=int(together.max() or 0),  # type: ignore[arg-type]
        beside_ns=int(in_cycle.max() or 0),  # type: ignore[arg-type]
        # All of them may be ready as the output comes, and be served first.
        beside_once_ns=int(beside.group_by("callback_id").agg(pl.col("took").max())["took"].sum()),
    )


def _modes_in_force(
    recording: Recording, flow: DataFlow, starts: pl.Series, modes: Modes
) -> pl.Series:
    """The mode in which each cycle began, by the description of what ran; null if unknown."""
    named: list[tuple[int, str]] = []
    described = recording.info.application
    if described is not None and not any(recording.info.lost.values()):
        with wrong_values_refused(Application, f"{recording.path}: the description that ran: "):
            application = Application.model_validate(described, strict=False)
        warm_up_ns = timing_of(application, 0, 0).record_from_ns
        for name, timer in application.callbacks():
            if timer.timer_ns is None or not timer.announces or modes.topic not in timer.publishes:
                continue
            node, before = node_name(name), -((timer.phase_ns - warm_up_ns) // timer.timer_ns)
            sent = flow.publications.filter(topic=modes.topic, node=node)["time"].to_list()
            # The last one before the recording is in force when it begins.
            times = [0, *sent] if before > 0 else sent
            turns, which = len(timer.announces), enumerate(times, start=max(0, before - 1))
            named += [(time, timer.announces[turn % turns]) for turn, time in which]
    if not named:
        return pl.Series([None] * len(starts), dtype=pl.String)
    known = sorted(one for one in named if one[1] in modes.bands)
    place = np.searchsorted([time for time, _ in known], starts.to_numpy(), side="right")
    return pl.Series([modes.default, *(mode for _, mode in known)]).gather(place)


def _period(analysis: LatencyAnalysis, given: int | None) -> int:
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
        reason = f"chain {spec} cannot have the period {duration_text(period)}"
        raise InputError(f"{reason}: give one longer than 0 ms, or begin the chain at a timer")
    return period


def _between_starts(analysis: LatencyAnalysis) -> float | None:
    starts = analysis.traversals["start"].unique().sort()
    return float(np.median(np.diff(starts.to_numpy()))) if len(starts) > 1 else None


def _simulated(flow: DataFlow, analysis: LatencyAnalysis) -> tuple[str, ...]:
    """The nodes of a chain that follow `/clock`, which is to run at the speed of time."""
    callbacks = [analysis.graph.callbacks[number] for number in analysis.chain.callbacks]
    follow = set(flow.takes.filter(topic="/clock")["node"])
    found = tuple(dict.fromkeys(one.node for one in callbacks if one.node in follow))
    first, apart = callbacks[0], _between_starts(analysis)
    if first.node in found and first.period_ns and apart:
        speed = first.period_ns / apart
        if abs(speed - 1) >= _SAME_SPEED:
            raise InputError(
                f"{first.node} follows /clock, which runs at {speed:.2f} of the speed of time: its"
                f" timer of {duration_text(first.period_ns)} expires every"
                f" {duration_text(round(int(apart), -5))}. Replay at that speed (`ros2 bag play"
                " --rate 1.0`), or start the nodes with use_sim_time:=false"
            )
    return found


@dataclass(frozen=True)
class _Stage:
    """One step of the graph: a callback, or the inputs of a synchronising one."""

    node: str
    topic: str
    members: tuple[int, ...]
    after: tuple[int, ...]


_Key = tuple[tuple[int, ...], str]  # of a stage: its callbacks, and the topic it publishes


def graph_stages(graph: ApplicationGraph, chain: Chain) -> list[_Stage]:
    """The chain and the branches it waits for, along the graph; the chain's last stands last."""
    outside = _feeding(graph, chain)
    along = list[_Key]()
    before, of_chain = dict[int, list[_Key]](), dict[int, _Key]()  # by the chain's callbacks
    for number, topic in zip(chain.callbacks, chain.topics, strict=True):
        members = inputs_of(graph, graph.callbacks[number], topic) if along else (number,)
        before[number] = along[-1:]
        along.append((members, topic))
        of_chain.update(dict.fromkeys(members, along[-1]))
    needs, level = dict[_Key, set[_Key]](), dict[_Key, int]()

    def writers_of(topic: str | None) -> list[_Key]:
        return [
            of_chain.get(writer.id) or (inputs_of(graph, writer, topic), topic)
            for writer in graph.callbacks
            if topic is not None and topic in writer.publishes and writer.node not in outside
        ]

    def follow(key: _Key, above: set[_Key]) -> None:
        needs[key] = set()
        for number in key[0]:
            on_chain, read = key in along and number in before, graph.callbacks[number].trigger
            for one in before[number] if on_chain else writers_of(read):
                if one not in above:  # what feeds back comes from a cycle before
                    needs[key].add(one)
                    if one not in needs:
                        follow(one, above | {one})
        level[key] = max((1 + level[one] for one in needs[key]), default=0)

    follow(along[-1], {along[-1]})
    order = sorted(needs, key=lambda key: (level[key], key not in along, key))
    places = {key: tuple(sorted(map(order.index, needs[key]))) for key in order}
    return [
        _Stage(graph.callbacks[members[0]].node, topic, members, places[members, topic])
        for members, topic in order
    ]


def taking_part(graph: ApplicationGraph, chain: Chain, stages: Sequence[_Stage]) -> tuple[str, ...]:
    """The nodes of a chain, then those of the branches that it waits for: so urgent they are."""
    along = (graph.callbacks[number].node for number in chain.callbacks)
    return tuple(dict.fromkeys((*along, *(stage.node for stage in stages))))


def _upstream(graph: ApplicationGraph, chain: Chain, stages: list[_Stage]) -> frozenset[str]:
    """The topics that the chain's output waits for, those before its first callback included."""
    found: set[str | None] = {stage.topic for stage in stages}
    ahead = {graph.callbacks[chain.callbacks[0]].trigger}
    while ahead:
        found |= ahead
        ahead = {
            graph.callbacks[number].trigger
            for writer in graph.callbacks
            for topic in {*writer.publishes} & ahead
            for number in inputs_of(graph, writer, topic)
        } - found
    return frozenset(topic for topic in found - {chain.topics[-1]} if topic is not None)


def _feeding(graph: ApplicationGraph, chain: Chain) -> set[str]:
    """All nodes that feed the node with which a chain begins, if it begins with a subscription."""
    first = graph.callbacks[chain.callbacks[0]]
    own = {graph.callbacks[number].node for number in chain.callbacks}
    found, fed = set[str](), set() if first.trigger is None else {first.node}
    while fed:
        topics = {callback.trigger for callback in graph.callbacks if callback.node in fed}
        feeding = {one.node for one in graph.callbacks if topics.intersection(one.publishes)}
        fed = feeding - found - own
        found |= fed
    return found


def inputs_of(graph: ApplicationGraph, callback: Callback, topic: str) -> tuple[int, ...]:
    """The callback and, where it is an input of a synchronising one, the other inputs."""
    if not goes_on_elsewhere(graph, callback, topic):
        return (callback.id,)
    return tuple(
        other.id
        for other in graph.callbacks
        if (other.pid, other.node) == (callback.pid, callback.node) and topic in other.publishes
    )


def _times(flow: DataFlow, instances: pl.DataFrame, stage: _Stage, core: int) -> CallbackTimes:
    """Response times of a stage, behind those of the other inputs of a synchronising callback."""
    published = flow.publications.filter(pl.col("topic") == stage.topic)["instance"].drop_nulls()
    publishes = pl.col("instance").is_in(published.implode())
    own = instances.filter(pl.col("callback_id").is_in(stage.members))
    response = (publishing if (publishing := own.filter(publishes)).height else own)["response"]
    if response.is_empty():
        raise OperationError(
            f"{stage.node} did not publish {stage.topic} in any undisturbed execution: record again"
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
        publishes=stage.topic,
    )


def _steps(
    flow: DataFlow, analysis: LatencyAnalysis, core_of: dict[str, int], planned: Collection[int]
) -> npt.NDArray[np.int64]:
    """What each callback of the chain took, a row per traversal's number: from the message before
    it to its own, without the time for which other ``planned`` callbacks had its core while it
    waited, which it does as long as the recording's quickest message at least. A row's sum is the
    latency of an instance that is alone.
    """
    chain, graph = analysis.chain, analysis.graph
    ran = flow.instances.drop_nulls("end").sort("start")
    core = {one.id: core_of.get(one.node, one.node) for one in graph.callbacks}
    hops = analysis.hops.sort("hop", "traversal")
    numbers = (hops["traversal"], analysis.traversals["traversal"])
    rows = 1 + max(int(one.max() or 0) for one in numbers)  # type: ignore[arg-type]
    steps = np.zeros((rows, len(chain.callbacks)), dtype=np.int64)
    free = np.zeros(rows, dtype=np.int64)  # when the instance before is over
    sent = flow.takes.join(flow.publications.select("publication", sent="time"), on="publication")
    quickest = int((sent["time"] - sent["sent"]).min() or 0)
    for hop, number in enumerate(chain.callbacks):
        own = hops.filter((pl.col("hop") == hop) & pl.col("publish").is_not_null())
        # Where another callback of the node publishes, this one's own end comes before.
        own = own.with_columns(end=pl.max_horizontal("end", "publish"))
        row, start, end = (own[name].to_numpy() for name in ("traversal", "start", "end"))
        parts = (own[f"{part}_ns"].fill_null(0) for part in PARTS)
        steps[row, hop] = sum(parts, own["hop"] * 0).to_numpy()
        if hop:
            same = [one for one in planned if core[one] == core[number]]
            others = ran.filter(pl.col("callback_id").is_in(same))
            ended = np.maximum.accumulate(others["end"].to_numpy())  # some may only have waited
            began = np.maximum(others["start"].to_numpy(), np.append(0, ended)[:-1])
            since = np.minimum(free[row], start)
            taken = stalled_within(since, start, began, ended, np.zeros_like(began))
            steps[row, hop] -= np.minimum(taken, np.maximum(0, start - since - quickest))
        free[row] = end
    return steps


def _graph_steps(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    stages: Sequence[_Stage],
    core_of: dict[str, int],
    planned: Collection[int],
) -> tuple[npt.NDArray[np.int64], tuple[int, ...]]:
    """What each stage of a graph took, a row per traversal's number of its chain; and how long
    after the chain each begins that waits for none, at most.

    Every way through the graph to the chain's output is a chain of its own, whose traversals end
    with the same publications. A callback that joins branches took what it did behind the message
    that came last: the least of its ways.
    """
    known = analysis.traversals.filter("complete").select("traversal", "publication", "start")
    rows = 1 + int(analysis.traversals["traversal"].max() or 0)  # type: ignore[arg-type]
    took = np.full((rows, len(stages)), np.inf)
    begins = [0] * len(stages)
    for way in _ways(analysis.chain, stages):
        callbacks = _callbacks_along(analysis.graph, stages, way)
        own = analysis
        if callbacks != analysis.chain.callbacks:
            topics = tuple(stages[place].topic for place in way)
            spec = f"{stages[way[0]].node}..{topics[-1]}"
            own = analyse_latency(flow, Chain(spec, callbacks, topics))
        steps = _steps(flow, own, core_of, planned)
        ended = own.traversals.filter("complete").select(
            "publication", number="traversal", began="start"
        )
        pairs = known.join(ended.unique("publication", keep="last"), on="publication")
        row, number = pairs["traversal"].to_numpy(), pairs["number"].to_numpy()
        for hop, place in enumerate(way):
            took[row, place] = np.fmin(took[row, place], steps[number, hop])
        if callbacks[0] != analysis.chain.callbacks[0] and pairs.height:
            later = _later(pairs["began"] - pairs["start"])
            begins[way[0]] = UNKNOWN if later is None else max(begins[way[0]], later)
    longest = np.max(np.where(np.isfinite(took), took, 0), axis=0)
    return np.where(np.isfinite(took), took, longest).astype(np.int64), tuple(begins)


def _later(behind: pl.Series) -> int | None:
    """How long after its chain a branch begins, at most (ns); None: instances pile up and wait for
    each other, so that none says when it would begin by itself.
    """
    longest, least = int(behind.max() or 0), int(behind.min() or 0)  # type: ignore[arg-type]
    return max(0, longest) if longest - least < _ONE_BEGINNING_NS else None


def _ways(chain: Chain, stages: Sequence[_Stage]) -> Iterator[tuple[int, ...]]:
    """The chain's way through the graph, and ways that have all that it does not pass: by places of
    stages."""
    along = tuple(
        next(k for k, one in enumerate(stages) if number in one.members and one.topic == topic)
        for number, topic in zip(chain.callbacks, chain.topics, strict=True)
    )
    yield along
    following = {before: k for k, one in enumerate(stages) for before in one.after}
    following |= dict(pairwise(along))
    seen = set(pairwise(along))
    for place, one in enumerate(stages):
        for before in one.after:
            if (before, place) in seen:
                continue
            way = [before, place]
            while stages[way[0]].after:
                way.insert(0, stages[way[0]].after[0])
            while way[-1] != len(stages) - 1:
                way.append(following[way[-1]])
            seen |= set(pairwise(way))
            yield tuple(way)


def _callbacks_along(
    graph: ApplicationGraph, stages: Sequence[_Stage], way: Sequence[int]
) -> tuple[int, ...]:
    """The callbacks by which data goes along a way: of several inputs, that which reads it."""
    found = [stages[way[0]].members[0]]
    for before, place in pairwise(way):
        members = stages[place].members
        read = (n for n in members if graph.callbacks[n].trigger == stages[before].topic)
        found.append(next(read, members[0]))
    return tuple(found)


def _instances_apart_from(flow: DataFlow, disturbed: pl.DataFrame) -> pl.DataFrame:
    """Finished instances that began in none of these traversals, with their response time."""
    last = flow.publications.group_by("instance").agg(last=pl.col("time").max())
    ended = flow.instances.join(last, on="instance", how="left", maintain_order="left")
    until = pl.coalesce("end", pl.when("assumed").then("last"))
    seen = ended.with_columns(end=until).drop_nulls("end")
    began = seen["start"].to_numpy()
    # An instance that begins just as a traversal ends is hit by it as well.
    hit = overlapping(began, began, disturbed["start"].to_numpy(), disturbed["end"].to_numpy() + 1)
    response = pl.col("end") - pl.col("start")
    return seen.filter(~pl.Series(hit)).select("instance", "callback_id", response=response)


def _together(graph: ApplicationGraph, nodes: Collection[str]) -> tuple[tuple[str, ...], ...]:
    """The processes that host several nodes, these among them: they may share an executor."""
    hosts = defaultdict[int, list[str]](list)
    for one in graph.nodes:
        hosts[one.pid].append(one.name)
    return tuple(tuple(own) for own in hosts.values() if own[1:] and not {*own}.isdisjoint(nodes))


def _executors(
    recording: Recording, flow: DataFlow, graph: ApplicationGraph, stages: Sequence[_Stage]
) -> tuple[list[Executor], dict[str, tuple[tuple[str, ...], ...]], dict[str, int], dict[str, int]]:
    """The executors that run the chain and its branches; of nodes with several, their callbacks, if
    these have names of their own; core and SCHED_FIFO priority, if known, of every node's executor.
    """
    every, members = executors(flow), {number for stage in stages for number in stage.members}
    running = [one for one in every if not members.isdisjoint(one.callbacks)]
    named = {}
    for node in {stage.node for stage in stages}:
        names = [tuple(name for owner, name in one.names if owner == node) for one in every]
        own = tuple(one for one, by in zip(names, every, strict=True) if one and by in running)
        if own and sum(map(bool, names)) > 1 and max(Counter(joined(*names)).values()) == 1:
            named[node] = own
    ours = {(one.pid, tid) for one in running for tid in one.threads}
    threads = sorted(recording.info.threads, key=lambda one: (one.pid, one.tid) in ours)
    by_pid = {one.pid: one for one in threads if one.role == "executor"}  # of several, ours
    found = {node.name: by_pid[node.pid] for node in graph.nodes if node.pid in by_pid}
    cores = {name: one.cores[0] for name, one in found.items() if len(one.cores) == 1}
    priorities = {name: one.priority for name, one in found.items() if one.priority}
    return running, named, cores, priorities


def _interfering(
    flow: DataFlow, analysis: LatencyAnalysis, running: Sequence[Executor], planned: Collection[int]
) -> tuple[Interfering, ...]:
    """What else the executors of a chain run while its complete traversals last."""
    cycles = analysis.traversals.filter("complete")
    start, end = (cycles[name].to_numpy() for name in ("start", "end"))
    theirs = {number for one in running for number in one.callbacks}.difference(planned)
    callbacks, found = analysis.graph.callbacks, []
    for callback in callbacks:
        if callback.id not in theirs or callback.trigger in INTERNAL_TOPICS:
            continue
        own = flow.instances.filter(callback_id=callback.id).drop_nulls("end")
        if not own.height:
            continue
        began, ended = own["start"].to_numpy(), own["end"].to_numpy()
        share = float(overlapping(start, end, began, ended).mean())
        writers = (one.node for one in callbacks if callback.trigger in one.publishes)
        longest_ns = int((ended - began).max())
        found.append(Interfering(callback.label, tuple(dict.fromkeys(writers)), share, longest_ns))
    return tuple(found)


def _writer(recording: Recording, flow: DataFlow, node: str, topic: str) -> dict[str, Any]:
    """What is seen of who writes the chain's output, under the names of a profile.

    No event says when a publication was over: not after the end of its callback, the next that the
    callback made, and when all subscribers had the message. Whether a thread of the process
    publishes shows where DDS threads have names; some middleware has no such threads.
    """
    own, time = (pl.col("topic") == topic) & (pl.col("node") == node), pl.col("time")
    readers = flow.takes.drop_nulls("publication").group_by("publication").agg(taken=time.max())
    sent = (
        flow.publications.with_columns(following=time.shift(-1).over("instance"))
        .filter(own)
        .join(flow.instances.select("instance", "end").drop_nulls(), on="instance")
        .join(readers, on="publication", how="left")
        .select("time", duration=pl.min_horizontal("end", "following", "taken") - time)
    )
    handed = flow.takes.filter("intra_process").join(
        flow.publications.filter(own), on="publication", how="semi"
    )
    writers = flow.objects.publishers.filter(own).select("pid", publisher_handle="handle")
    created = events.table(flow.events, "rcl_publisher_init", ["queue_depth"])
    depths = created.join(writers, on=["pid", "publisher_handle"])["queue_depth"]
    threads = recording.info.threads
    pids = {thread.pid for thread in threads if thread.node == node}
    own_threads = [thread for thread in threads if thread.pid in pids]
    roles = {thread.role for thread in own_threads}
    have_names = any(thread_work(thread.comm) is not None for thread in own_threads)
    middleware = middleware_of(recording.info.rmw)
    is_synchronous = middleware is not None and middleware.is_synchronous
    return {
        "longest_publication_ns": _longest_calm(flow, sent),
        "asynchronous": "publisher" in roles if have_names else (False if is_synchronous else None),
        "intra_process": True if handed.height else None,
        "output_depth": depths.filter(depths > 0).min(),
    }


def _longest_calm(flow: DataFlow, lasted: pl.DataFrame) -> int | None:
    """The longest ``duration`` from a ``time`` on; of those that no stall fell into, if any."""
    stalls = events.table(flow.events, "machine_stall")
    (began, ended), (stalled, over) = (
        (one["time"].to_numpy(), (one["time"] + one["duration"]).to_numpy())
        for one in (lasted, stalls)
    )
    calm = lasted.filter(~pl.Series(overlapping(began, ended, stalled, over)))
    return (calm if calm.height else lasted)["duration"].max()  # type: ignore[return-value]


def _utilisation(
    flow: DataFlow, graph: ApplicationGraph, core_of: dict[str, int], running: Sequence[Executor]
) -> float | None:
    """The largest share of a core that the executors of the chain take."""
    theirs = {number for one in running for number in one.callbacks}
    own = (one for one in graph.callbacks if one.node in core_of and one.id in theirs)
    core = {one.id: core_of[one.node] for one in own}
    ran = flow.instances.filter(pl.col("callback_id").is_in(list(core))).drop_nulls("execution_ns")
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

    ``sinks`` are chains to further outputs of the same graph. Raises: as :func:`profile_chains`
    and :func:`~chainshaper.planning.plan_chain`.
    """
    if not isinstance(chain, str | None):
        raise InputError("one chain goes here: profile several, and plan with `plan_application`")
    wanted = (chain, *sinks)
    profile, *further = profile_chains(recording, wanted, period_ns=period_ns, modes=request.modes)
    return Plan.of(plan_chain(profile, request, further))
