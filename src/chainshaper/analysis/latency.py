"""From a recording to the end-to-end latencies of one chain: the whole analysis in one call."""

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.disturbance import disturbed, stalled_after
from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.analysis.graph import graph_of
from chainshaper.analysis.punctuality import Due, with_punctuality
from chainshaper.analysis.statistics import LatencyStatistics, latency_statistics
from chainshaper.analysis.subscriber import reception
from chainshaper.analysis.traversals import traverse
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Chain
from chainshaper.values.recording import Recording

__all__ = ["LatencyAnalysis", "analyse_latency"]


@dataclass(frozen=True)
class LatencyAnalysis:
    """The end-to-end latency of one chain in one recording.

    ``traversals`` is the frame of :class:`~chainshaper.analysis.traversals.Traversals` with the
    columns ``place_ns``, ``due_at``, ``late`` (see
    :func:`~chainshaper.analysis.punctuality.with_punctuality`), ``disturbed``, ``received``,
    ``reception_ns`` (latency to the subscriber's `callback_start`) and ``reception_disturbed``
    (also by a stall between the two) added, ``hops`` its frame of hops, ``releases`` what gates
    decided about them (:func:`~chainshaper.analysis.departures.gated_hops`). ``statistics`` are
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
