"""The end-to-end latencies of one chain in a recording, figures about them and about callbacks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.disturbance import (
    Due,
    disturbed,
    due_within,
    stalled_after,
    timer_period,
    with_punctuality,
)
from chainshaper.analysis.flow import DataFlow, data_flow, recorded_flow, timer_calls
from chainshaper.analysis.graph import graph_of
from chainshaper.analysis.outputs_due import not_begun, with_outputs_due
from chainshaper.analysis.traversals import reception, traverse
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Chain, trigger_text
from chainshaper.values.recording import Recording

PERCENTILES: tuple[float, ...] = (0.5, 1, 5, 25, 50, 75, 95, 99, 99.5)


@dataclass(frozen=True)
class LatencyStatistics:
    """Statistics of a sample of latencies, in whole nanoseconds; None where there is no sample.

    ``count`` latencies were measured; ``incomplete`` traversals have none, but for those that came
    to a lifecycle node while it was not active; ``disturbed`` of ``count`` were hit by a stall of
    the machine; ``late`` of them came behind the slot or cycle they were due in (None: not known).
    ``jitter_ns`` is max − min (paper: J), ``spread_ns`` p99.5 − p0.5. ``percentiles_ns`` has
    :data:`PERCENTILES` as text for keys; they interpolate linearly between the two nearest values.
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
    low, high, mean = int(sample.min()), int(sample.max()), round(int(sample.sum()) / len(sample))
    spread = percentiles["99.5"] - percentiles["0.5"]
    figures = (low, mean, high, high - low, spread, percentiles)
    return LatencyStatistics(len(sample), incomplete, hit, *figures, late)


def summary(times: pl.Expr) -> pl.Expr:
    """Times as a struct ``{min, mean, max}``; null where there are none."""
    figures = pl.struct(min=times.min(), mean=times.mean(), max=times.max())
    return pl.when(times.count() > 0).then(figures)


def callback_statistics(flow: DataFlow) -> pl.DataFrame:
    """Count, response and execution times of every callback that was seen to run, one row each.

    Columns: ``callback_id, node, kind, topic, period_ns, declared_ns, symbol, pid, pids, tids,
    count, unfinished, response_ns, execution_ns``. The last two are structs ``{min, mean, max}`` in
    ns (means as floats), null where no instance has such a time. ``period_ns`` is the period of a
    timer's starts, ``declared_ns`` that with which it was created, ``pids`` are all
    processes of a node that was started again, ``pid`` is the last.
    """
    # Of a callback's registrations those of its node's last process come first.
    about = flow.objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    ran = flow.instances.filter(~pl.col("assumed")).group_by("callback_id")
    figures = ran.agg(
        pids=pl.col("pid").unique(maintain_order=True),
        tids=pl.col("tid").unique().sort(),
        count=pl.len(),
        unfinished=pl.col("end").null_count(),
        response_ns=summary(pl.col("end") - pl.col("start")),
        execution_ns=summary(pl.col("execution_ns")),
    )
    names = ("callback_id", "node", "kind", "topic", "period_ns", "declared_ns", "symbol", "pid")
    found = about.select(names).join(figures, on="callback_id")
    return found.sort("callback_id")


def named_callbacks(flow: DataFlow) -> pl.DataFrame:
    """Callbacks that ran and are named alike in every run: by node, and ``starts``, what starts
    them: a topic, or a timer with its declared period. Several may have one name: two timers of one
    period, or those of a node started again. ``shown`` has the period of the timer's starts, too.

    They are rows of :func:`.callback_statistics`, without those that every node has.
    """
    found = callback_statistics(flow).filter(
        pl.col("node").is_not_null()
        & pl.col("kind").is_in(["timer", "subscription"])
        & ~pl.col("topic").fill_null("").is_in(list(INTERNAL_TOPICS))
    )
    triggers = found.select("topic", "period_ns", "declared_ns").rows()
    starts = [trigger_text(topic, declared) for topic, _, declared in triggers]
    shown = [trigger_text(*trigger) for trigger in triggers]
    texts = {"starts": starts, "shown": shown}
    return found.with_columns(pl.Series(name, text, pl.String) for name, text in texts.items())


class Longest(NamedTuple):
    """The longest response and execution time of a callback (ns; None: not known).

    ``shown`` is what starts it, with the period of a timer's starts beside the declared one.
    """

    response_ns: float | None
    execution_ns: float | None
    shown: str

    @property
    def times(self) -> tuple[float | None, float | None]:
        """Both, in this order."""
        return self.response_ns, self.execution_ns


def longest_times(flow: DataFlow) -> dict[tuple[str, str], Longest]:
    """The longest times of each name of :func:`named_callbacks`."""
    named = named_callbacks(flow).group_by("node", "starts", maintain_order=True)
    rows = named.agg(
        response=pl.col("response_ns").struct.field("max").max(),
        execution=pl.col("execution_ns").struct.field("max").max(),
        shown=pl.col("shown").first(),
    )
    return {(node, starts): Longest(*longest) for node, starts, *longest in rows.iter_rows()}


class Executor(NamedTuple):
    """The threads of a process that run the same callbacks.

    ``threads`` are their ids, each with the nodes it ran callbacks of, ``callbacks`` these by id,
    ``names`` the timers and subscriptions among them by node and trigger, without those that every
    node has for itself (`/clock` may have a thread of its own).
    """

    pid: int
    threads: dict[int, tuple[str, ...]]
    callbacks: frozenset[int]
    names: tuple[tuple[str, str], ...]


def executors(flow: DataFlow) -> list[Executor]:
    """Which callbacks have an executor of their own (paper, section 6): they share no thread.

    What one thread was seen to run is one executor's, and so is what several take turns with. A
    thread that calls the timers for it belongs to it (rclcpp's events executor), and of several of
    Python the main thread, which gives them their work.
    """
    found: list[Executor] = []
    who = ("callback_id", "pid", "tid")  # threads of processes that were followed are no more
    calls = timer_calls(flow.events, flow.objects).select(who)
    ran = pl.concat([flow.instances.select(who), calls]).unique()
    about = flow.objects.callbacks.filter((pl.col("kind") != "unknown") | pl.col("observed"))
    about = about.unique("callback_id", keep="first", maintain_order=True).join(
        ran.group_by("callback_id", "pid").agg(tids=pl.col("tid").sort()),
        on=["callback_id", "pid"],
    )
    # A timer's declared period names it: it is the same whatever the recording shows.
    columns = ("callback_id", "node", "kind", "topic", "declared_ns", "pid", "tids", "observed")
    for row in about.sort("callback_id").select(*columns).iter_rows():
        number, node, kind, topic, declared_ns, pid, tids, observed = row
        tids = tids if observed else {pid, *tids}
        threads: dict[int, tuple[str, ...]] = dict.fromkeys(tids, (node,))
        callbacks, names = frozenset((number,)), tuple[tuple[str, str], ...]()
        if kind in ("timer", "subscription") and topic not in INTERNAL_TOPICS:
            names = ((node, trigger_text(topic, declared_ns)),)
        for one in [one for one in found if one.pid == pid and one.threads.keys() & threads]:
            found.remove(one)
            for tid, nodes in one.threads.items():
                threads[tid] = tuple(dict.fromkeys((*nodes, *threads.get(tid, ()))))
            callbacks, names = callbacks | one.callbacks, tuple(dict.fromkeys(one.names + names))
        found.append(Executor(pid, threads, callbacks, names))
    return found


@dataclass(frozen=True)
class LatencyAnalysis:
    """The end-to-end latency of one chain in one recording.

    ``traversals`` is the frame of :class:`~chainshaper.analysis.traversals.Traversals` with
    ``place_ns``, ``due_at``, ``late`` (:func:`~.disturbance.with_punctuality`), ``was_due``
    (:func:`~.outputs_due.with_outputs_due`), ``disturbed``,
    ``received``, ``reception_ns`` (latency to the subscriber's `callback_start`) and
    ``reception_disturbed`` (also by a stall between the two), ``hops`` its frame of hops,
    ``releases`` what gates decided about them (:func:`~.messages.gated_hops`). ``statistics`` are
    over all complete traversals, ``undisturbed`` over those that the machine did not disturb;
    ``subscriber`` and ``subscriber_undisturbed`` are the same of ``reception_ns`` (None: no node
    subscribes to the output). ``incomplete`` counts traversals without an end by reason, ``silent``
    instances of the first callback that began none, ``not_begun`` cycles of a plan in which it did
    not run at all. ``period_ns`` is that of the timer that starts the chain (None: none does).
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
    not_begun: int = 0
    period_ns: int | None = None

    @property
    def decided(self) -> pl.DataFrame:
        """What gates decided about the chain's outputs."""
        return self.releases.filter(pl.col("hop") == len(self.chain.callbacks) - 1)

    @property
    def calm(self) -> pl.DataFrame:
        """The complete traversals that the machine did not disturb."""
        return self.traversals.filter(pl.col("complete") & ~pl.col("disturbed"))


def analyse_latency(
    source: Recording | events.EventTables | DataFlow,
    chain: str | Chain,
    clock_offset_ns: int | None = None,
    *,
    due: Sequence[Due] = (),
    between: tuple[int, int | None] | None = None,
) -> LatencyAnalysis:
    """Every traversal of ``chain`` in a recording, with statistics.

    ``clock_offset_ns`` (event clock to CLOCK_REALTIME) is taken from a recording and needed for
    tables from before Jazzy. ``due`` is when a plan has outputs leave; those of other chains are
    passed over. ``between`` leaves out traversals that did not begin, and end, between two instants
    (ns).

    Raises InputError: the chain is not in the recording, see :func:`~.chains.find_chain`.
    """
    notes: tuple[str, ...] = ()
    if isinstance(source, Recording):
        notes = source.info.notes
        if clock_offset_ns is not None:
            info = source.info.model_copy(update={"clock_offset_ns": clock_offset_ns})
            source = replace(source, info=info)
        source = recorded_flow(source)
    flow = source if isinstance(source, DataFlow) else data_flow(source, clock_offset_ns or 0)
    graph = graph_of(flow)
    if isinstance(chain, str):
        chain = find_chain(graph, chain)
    found = traverse(flow, chain, graph)
    own = next((one for one in due if one.output in {None, chain.topics[-1]}), None)
    judged, releases = with_punctuality(flow, found, own)
    hit = pl.Series(disturbed(flow, judged, 0 if own is None else own.margin_ns))
    received = reception(flow, found, graph)
    sent, arrived = judged["end"].fill_null(0), received["received"].fill_null(-1)
    on_its_way = pl.Series(stalled_after(flow, sent.to_numpy(), arrived.to_numpy()))
    frame = judged.drop("origin", "computed_at", "expected_at").with_columns(
        *(received["received"], received["reception_ns"]),
        disturbed=hit,
        reception_disturbed=hit | on_its_way,
    )
    until = None if between is None else between[1]
    frame = with_outputs_due(flow, frame, releases, due_within(flow, chain, own), until)
    hops = found.hops
    if between is not None:
        since_ns, until_ns = between
        ended = pl.max_horizontal("start", "end")
        before = pl.lit(True) if until_ns is None else ended < until_ns
        frame = frame.filter((pl.col("start") >= since_ns) & before)
        hops, releases = (t.join(frame, on="traversal", how="semi") for t in (hops, releases))
    reasons = frame.select("reason").drop_nulls().group_by("reason").len().sort("reason")
    calm, well_received = (frame.filter(~pl.col(f"{of}disturbed")) for of in ("", "reception_"))
    read = frame["reception_ns"].count() > 0
    return LatencyAnalysis(
        chain=chain,
        graph=graph,
        traversals=frame,
        hops=hops,
        releases=releases,
        statistics=_statistics(frame, "latency_ns"),
        undisturbed=_statistics(calm, "latency_ns"),
        subscriber=_statistics(frame, "reception_ns") if read else None,
        subscriber_undisturbed=_statistics(well_received, "reception_ns") if read else None,
        incomplete=dict(reasons.iter_rows()),
        silent=found.silent,
        notes=(*notes, *flow.notes, *found.notes),
        not_begun=0 if own is None else not_begun(flow, chain, own, between),
        period_ns=timer_period(flow, chain),
    )


def _statistics(frame: pl.DataFrame, column: str) -> LatencyStatistics:
    measured = frame.drop_nulls(column)
    known = measured["late"].count() or not measured.height
    hit = "disturbed" if column == "latency_ns" else "reception_disturbed"
    return latency_statistics(
        measured[column].to_numpy(),
        measured[hit].to_numpy(),
        incomplete=frame.height - measured.height - frame.filter(reason="inactive").height,
        late=int(measured["late"].sum()) if known else None,
    )
