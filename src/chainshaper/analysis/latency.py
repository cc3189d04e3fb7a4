"""The end-to-end latencies of one chain in a recording, and the figures about them and callbacks.

:func:`analyse_latency` is the whole analysis in one call.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.disturbance import Due, disturbed, stalled_after, with_punctuality
from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.analysis.graph import graph_of
from chainshaper.analysis.traversals import reception, traverse
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Chain
from chainshaper.values.recording import Recording

__all__ = [
    "PERCENTILES",
    "LatencyAnalysis",
    "LatencyStatistics",
    "analyse_latency",
    "callback_statistics",
    "latency_statistics",
]

PERCENTILES: tuple[float, ...] = (0.5, 1, 5, 25, 50, 75, 95, 99, 99.5)


@dataclass(frozen=True)
class LatencyStatistics:
    """Statistics of a sample of latencies, in whole nanoseconds; None where there is no sample.

    ``count`` latencies were measured; ``incomplete`` traversals have none; ``disturbed`` of
    ``count`` were hit by a stall of the machine; ``late`` of them came behind the slot or cycle
    they were due in (None: when they were due is not known). ``jitter_ns`` is max − min (paper: J),
    ``spread_ns`` p99.5 − p0.5. ``percentiles_ns`` has the keys 0.5, 1, 5, 25, 50, 75, 95, 99 and
    99.5 as text; they interpolate linearly between the two nearest values (NumPy's default),
    then are rounded.
    """

    count: int
    incomplete: int
    disturbed: int
    min_ns: int | None
    mean_ns: int | None
    max_ns: int | None
    jitter_ns: int | None
    spread_ns: int | None
    percentiles_ns: dict[str, int]
    late: int | None = None


def latency_statistics(
    latency_ns: npt.ArrayLike,
    disturbed: npt.ArrayLike | None = None,
    incomplete: int = 0,
    late: int | None = None,
) -> LatencyStatistics:
    """Statistics of latencies in ns; ``disturbed`` marks those that the machine hit.

    Disturbed latencies are counted and included: to leave them out, pass the others only.
    """
    sample = np.asarray(latency_ns, dtype=np.int64)
    hit = 0 if disturbed is None else int(np.count_nonzero(np.asarray(disturbed, dtype=bool)))
    if not len(sample):
        return LatencyStatistics(0, incomplete, hit, None, None, None, None, None, {}, late)
    values = np.percentile(sample, PERCENTILES)
    percentiles = {f"{p:g}": round(float(v)) for p, v in zip(PERCENTILES, values, strict=True)}
    low, high = int(sample.min()), int(sample.max())
    return LatencyStatistics(
        count=len(sample),
        incomplete=incomplete,
        disturbed=hit,
        min_ns=low,
        mean_ns=round(int(sample.sum()) / len(sample)),
        max_ns=high,
        jitter_ns=high - low,
        spread_ns=percentiles["99.5"] - percentiles["0.5"],
        percentiles_ns=percentiles,
        late=late,
    )


def callback_statistics(flow: DataFlow) -> pl.DataFrame:
    """Count, response and execution times of every callback that was seen to run, one row each.

    Columns: ``callback_id, node, kind, topic, period_ns, symbol, pid, tids, count, unfinished,
    response_ns, execution_ns``. The last two are structs ``{min, mean, max}`` in ns (means as
    floats), null where no instance has such a time. ``period_ns`` is the timer's own period.
    """
    about = flow.objects.callbacks.unique("callback_id", maintain_order=True)
    response = pl.col("end") - pl.col("start")
    seen = flow.instances.filter(~pl.col("assumed"))
    figures = seen.group_by("callback_id").agg(
        pl.col("tid").unique().sort().alias("tids"),
        pl.len().alias("count"),
        pl.col("end").null_count().alias("unfinished"),
        _summary(response).alias("response_ns"),
        _summary(pl.col("execution_ns")).alias("execution_ns"),
    )
    joined = about.join(figures, on="callback_id", how="inner").sort("callback_id")
    columns = ["callback_id", "node", "kind", "topic", "period_ns", "symbol", "pid"]
    times = [
        pl.when(pl.col(name).struct.field("min").is_not_null()).then(pl.col(name)).alias(name)
        for name in ("response_ns", "execution_ns")
    ]
    return joined.select(*columns, "tids", "count", "unfinished", *times)


def _summary(values: pl.Expr) -> pl.Expr:
    return pl.struct(min=values.min(), mean=values.mean(), max=values.max())


@dataclass(frozen=True)
class LatencyAnalysis:
    """The end-to-end latency of one chain in one recording.

    ``traversals`` is the frame of :class:`~chainshaper.analysis.traversals.Traversals` with the
    columns ``place_ns``, ``due_at``, ``late`` (see
    :func:`~chainshaper.analysis.disturbance.with_punctuality`), ``disturbed``, ``received``,
    ``reception_ns`` (latency to the subscriber's `callback_start`) and ``reception_disturbed``
    (also by a stall between the two) added, ``hops`` its frame of hops, ``releases`` what gates
    decided about them (:func:`~chainshaper.analysis.messages.gated_hops`). ``statistics`` are
    over all complete traversals, ``undisturbed`` over those that the machine did not disturb;
    ``subscriber`` and ``subscriber_undisturbed`` are the same of ``reception_ns`` (None: no node
    subscribes to the output in this recording). ``incomplete`` counts traversals without an end by
    reason, ``silent`` instances of the first callback that began none.
    """

    chain: Chain
    graph: ApplicationGraph
    traversals: pl.DataFrame
    hops: pl.DataFrame
    releases: pl.DataFrame
    statistics: LatencyStatistics
    undisturbed: LatencyStatistics
    subscriber: LatencyStatistics | None
    subscriber_undisturbed: LatencyStatistics | None
    incomplete: dict[str, int]
    silent: int
    notes: tuple[str, ...]


def analyse_latency(
    source: Recording | events.EventTables | DataFlow,
    chain: str | Chain,
    clock_offset_ns: int | None = None,
    *,
    subscriber: str | None = None,
    due: Sequence[Due] = (),
    between: tuple[int, int | None] | None = None,
) -> LatencyAnalysis:
    """Every traversal of ``chain`` in a recording, with statistics.

    ``source`` is a recording, its event tables, or its data flow where several chains are
    analysed. ``clock_offset_ns`` (event clock to CLOCK_REALTIME) is taken from a recording and
    needed for tables from before Jazzy. ``subscriber`` names the node whose reception is
    reported. ``due`` is when a plan has outputs leave; those of other chains are passed over.
    ``between`` leaves out traversals that did not begin, and end, between two instants (ns).

    Raises:
        InputError: the chain is not in the recording, see
            :func:`~chainshaper.analysis.chains.find_chain`.
    """
    notes: tuple[str, ...] = ()
    if isinstance(source, DataFlow):
        flow = source
    elif isinstance(source, Recording):
        offset = source.info.clock_offset_ns if clock_offset_ns is None else clock_offset_ns
        flow = data_flow(source.events, offset)
        notes = source.info.notes
    else:
        flow = data_flow(source, clock_offset_ns or 0)
    graph = graph_of(flow)
    if isinstance(chain, str):
        chain = find_chain(graph, chain)
    found = traverse(flow, chain, graph)
    received = reception(flow, found, graph, subscriber)
    own = next((one for one in due if one.output in {None, chain.topics[-1]}), None)
    judged, releases = with_punctuality(flow, found, own)
    hit = disturbed(flow, judged, 0 if own is None else own.margin_ns)
    frame = judged.drop("origin", "computed_at").with_columns(
        received["received"], received["reception_ns"], disturbed=hit
    )
    on_its_way = stalled_after(
        flow, frame["end"].fill_null(0).to_numpy(), frame["received"].fill_null(-1).to_numpy()
    )
    frame = frame.with_columns(reception_disturbed=pl.col("disturbed") | pl.Series(on_its_way))
    hops = found.hops
    if between is not None:
        frame = frame.filter(_within(*between))
        hops, releases = (t.join(frame, on="traversal", how="semi") for t in (hops, releases))
    reasons = frame.select("reason").drop_nulls().group_by("reason").len().sort("reason")
    measured = frame.select(
        "latency_ns", "reception_ns", "late", "disturbed", "reception_disturbed"
    )
    return LatencyAnalysis(
        chain=chain,
        graph=graph,
        traversals=frame,
        hops=hops,
        releases=releases,
        statistics=_statistics(measured, "latency_ns"),
        undisturbed=_statistics(measured.filter(~pl.col("disturbed")), "latency_ns"),
        subscriber=_subscriber(measured, measured),
        subscriber_undisturbed=_subscriber(
            measured, measured.filter(~pl.col("reception_disturbed"))
        ),
        incomplete=dict(reasons.iter_rows()),
        silent=found.silent,
        notes=(*notes, *flow.notes, *found.notes),
    )


def _within(since_ns: int, until_ns: int | None) -> pl.Expr:
    ended = pl.max_horizontal("start", "end")
    return (pl.col("start") >= since_ns) & (True if until_ns is None else ended < until_ns)


def _statistics(
    frame: pl.DataFrame, column: str, disturbed_by: str = "disturbed"
) -> LatencyStatistics:
    measured = frame.select(column, "late", disturbed_by).drop_nulls(column)
    known = measured["late"].count() or not measured.height
    return latency_statistics(
        measured[column].to_numpy(),
        measured[disturbed_by].to_numpy(),
        incomplete=frame.height - measured.height,
        late=int(measured["late"].sum()) if known else None,
    )


def _subscriber(frame: pl.DataFrame, chosen: pl.DataFrame) -> LatencyStatistics | None:
    if not frame["reception_ns"].count():
        return None
    return _statistics(chosen, "reception_ns", "reception_disturbed")
