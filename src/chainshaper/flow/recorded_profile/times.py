"""How long the callbacks of a chain, and the stages of its graph, took in a recording."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, analyse_latency
from chainshaper.analysis.disturbance import overlapping, stalled_within
from chainshaper.flow.recorded_profile.stages import Stage, callbacks_along, ways_through
from chainshaper.planning import CallbackTimes
from chainshaper.planning.profile import UNKNOWN
from chainshaper.values.application import Chain
from chainshaper.values.errors import OperationError
from chainshaper.verify.measure import PARTS

Steps = npt.NDArray[np.int64]
"""Times (ns): a row for each traversal, by its number, a column for each callback or stage."""

_ONE_BEGINNING_NS = 5_000_000
"""Two timers begin so far apart in all cycles, at most, if they do not wait for others."""


def undisturbed_instances(flow: DataFlow, disturbed: pl.DataFrame) -> pl.DataFrame:
    """Return the finished instances that began in none of the ``disturbed`` traversals.

    Columns:
        instance: its number.
        callback_id: its callback.
        response: its response time (ns).
    """
    last = flow.publications.group_by("instance").agg(last=pl.col("time").max())
    ended = flow.instances.join(last, on="instance", how="left", maintain_order="left")
    until = pl.coalesce("end", pl.when("assumed").then("last"))
    finished = ended.with_columns(end=until).drop_nulls("end")
    began = finished["start"].to_numpy()
    # An instance that begins just as a traversal ends is hit by it as well.
    hit = overlapping(began, began, disturbed["start"].to_numpy(), disturbed["end"].to_numpy() + 1)
    response = pl.col("end") - pl.col("start")
    calm = finished.filter(~pl.Series(hit))
    return calm.select("instance", "callback_id", response=response)


def callback_times(
    flow: DataFlow, instances: pl.DataFrame, stage: Stage, core: int
) -> CallbackTimes:
    """Return the response times of a stage over some instances (:func:`undisturbed_instances`).

    The longest is behind those of the other inputs of a synchronising callback. Raises
    OperationError: the stage published in none of the instances.
    """
    published = flow.publications.filter(pl.col("topic") == stage.topic)["instance"].drop_nulls()
    publishes = pl.col("instance").is_in(published.implode())
    of_stage = instances.filter(pl.col("callback_id").is_in(stage.members))
    publishing = of_stage.filter(publishes)
    response = (publishing if publishing.height else of_stage)["response"]
    if response.is_empty():
        raise OperationError(
            f"{stage.node} did not publish {stage.topic} in any undisturbed execution: record again"
        )
    waiting_ns = 0
    if len(stage.members) > 1:
        silent = of_stage.filter(~publishes).group_by("callback_id")
        waiting_ns = int(silent.agg(pl.col("response").max())["response"].sum())
    return CallbackTimes(
        node=stage.node,
        core=core,
        min_response_ns=int(response.min()),  # type: ignore[arg-type]
        mean_response_ns=round(float(response.mean())),  # type: ignore[arg-type]
        max_response_ns=int(response.max()) + waiting_ns,  # type: ignore[arg-type]
        after=stage.after,
        publishes=stage.topic,
    )


def chain_steps(
    flow: DataFlow, analysis: LatencyAnalysis, core_of: Mapping[str, int], planned: Collection[int]
) -> Steps:
    """Return what each callback of a chain took, from the message before it to its own message.

    The time for which other ``planned`` callbacks had its core while it waited is left out; it
    waits at least as long as the recording's quickest message. So the sum of a row is the latency
    of an instance that is alone.
    """
    chain, graph = analysis.chain, analysis.graph
    ran = flow.instances.drop_nulls("end").sort("start")
    core = {callback.id: core_of.get(callback.node, callback.node) for callback in graph.callbacks}
    hops = analysis.hops.sort("hop", "traversal")
    numbers = (hops["traversal"], analysis.traversals["traversal"])
    rows = 1 + max(int(column.max() or 0) for column in numbers)  # type: ignore[arg-type]
    steps = np.zeros((rows, len(chain.callbacks)), dtype=np.int64)
    free = np.zeros(rows, dtype=np.int64)  # when the instance before is over
    sent = flow.takes.join(flow.publications.select("publication", sent="time"), on="publication")
    quickest = int((sent["time"] - sent["sent"]).min() or 0)
    for hop, number in enumerate(chain.callbacks):
        of_hop = hops.filter((pl.col("hop") == hop) & pl.col("publish").is_not_null())
        # Where another callback of the node publishes, this one's own end comes before.
        of_hop = of_hop.with_columns(end=pl.max_horizontal("end", "publish"))
        row, start, end = (of_hop[name].to_numpy() for name in ("traversal", "start", "end"))
        parts = (of_hop[f"{part}_ns"].fill_null(0) for part in PARTS)
        steps[row, hop] = sum(parts, of_hop["hop"] * 0).to_numpy()
        if hop:
            on_core = [planned_id for planned_id in planned if core[planned_id] == core[number]]
            beside = ran.filter(pl.col("callback_id").is_in(on_core))
            began, ended = busy_intervals(beside)
            since = np.minimum(free[row], start)
            taken = stalled_within(since, start, began, ended, np.zeros_like(began))
            steps[row, hop] -= np.minimum(taken, np.maximum(0, start - since - quickest))
        free[row] = end
    return steps


def busy_intervals(instances: pl.DataFrame) -> tuple[Steps, Steps]:
    """Return starts and ends of instances, sorted by their start, as intervals without overlaps.

    An instance that began while another one ran may only have waited until that ended.
    """
    ended = np.maximum.accumulate(instances["end"].to_numpy())
    began = np.maximum(instances["start"].to_numpy(), np.append(0, ended)[:-1])
    return began, ended


class GraphSteps(NamedTuple):
    """What the stages of a graph took."""

    steps_ns: Steps
    begins_ns: tuple[int, ...]  # of each stage that waits for none: how long after the chain, most


def graph_steps(
    flow: DataFlow,
    analysis: LatencyAnalysis,
    stages: Sequence[Stage],
    core_of: Mapping[str, int],
    planned: Collection[int],
) -> GraphSteps:
    """Return what each stage of a graph took in each traversal of its chain.

    Every way through the graph to the chain's output is a chain of its own, whose traversals end
    with the same publications. A callback that joins branches took what it did behind the message
    that came last: the least of its ways.
    """
    known = analysis.traversals.filter("complete").select("traversal", "publication", "start")
    rows = 1 + int(analysis.traversals["traversal"].max() or 0)  # type: ignore[arg-type]
    took = np.full((rows, len(stages)), np.inf)
    begins = [0] * len(stages)
    for way in ways_through(analysis.chain, stages):
        callbacks = callbacks_along(analysis.graph, stages, way)
        of_way = analysis
        if callbacks != analysis.chain.callbacks:
            topics = tuple(stages[place].topic for place in way)
            spec = f"{stages[way[0]].node}..{topics[-1]}"
            of_way = analyse_latency(flow, Chain(spec, callbacks, topics))
        steps = chain_steps(flow, of_way, core_of, planned)
        ended = of_way.traversals.filter("complete").select(
            "publication", number="traversal", began="start"
        )
        pairs = known.join(ended.unique("publication", keep="last"), on="publication")
        row, number = pairs["traversal"].to_numpy(), pairs["number"].to_numpy()
        for hop, place in enumerate(way):
            took[row, place] = np.fmin(took[row, place], steps[number, hop])
        if callbacks[0] != analysis.chain.callbacks[0] and pairs.height:
            later_ns = _latest_beginning(pairs["began"] - pairs["start"])
            if later_ns is None:
                begins[way[0]] = UNKNOWN
            else:
                begins[way[0]] = max(begins[way[0]], later_ns)
    longest = np.max(np.where(np.isfinite(took), took, 0), axis=0)
    return GraphSteps(np.where(np.isfinite(took), took, longest).astype(np.int64), tuple(begins))


def _latest_beginning(behind: pl.Series) -> int | None:
    """Return how long after its chain a branch begins, at most (ns).

    None: instances pile up and wait for each other, so that none shows when the branch would begin
    by itself.
    """
    longest, least = int(behind.max() or 0), int(behind.min() or 0)  # type: ignore[arg-type]
    return max(0, longest) if longest - least < _ONE_BEGINNING_NS else None
