"""The end-to-end latencies of one chain in a recording, figures about them and about callbacks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import polars as pl

from chainshaper.analysis.chains import find_chain
from chainshaper.analysis.data_age import DataAge, data_age
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
from chainshaper.analysis.host_clocks import bounded_statistics, with_hop_intervals, with_intervals
from chainshaper.analysis.loops import loop_figures
from chainshaper.analysis.outputs_due import not_begun, with_outputs_due
from chainshaper.analysis.statistics import LatencyStatistics, latency_statistics
from chainshaper.analysis.traversals import reception, traverse
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Chain, trigger_text
from chainshaper.values.errors import shown
from chainshaper.values.notebook import notebook_html
from chainshaper.values.recording import Recording


def summary(times: pl.Expr) -> pl.Expr:
    """Times as a struct ``{min, mean, max}``; null where there are none."""
    figures = pl.struct(min=times.min(), mean=times.mean(), max=times.max())
    return pl.when(times.count() > 0).then(figures)


def callback_statistics(flow: DataFlow) -> pl.DataFrame:
    """Make a frame of every callback that was seen to run, one row each. Columns:

    * ``callback_id, node, kind, topic, symbol``.
    * ``period_ns``: the period of a timer's, or a loop's, starts.
    * ``declared_ns``: the period with which the timer was created.
    * ``pid``: its process, the last one of a node that was started again; ``pids``: all of them.
    * ``tids``: the threads that ran it.
    * ``count``: of its instances.
    * ``unfinished``: how many of these have no end.
    * ``response_ns``, ``execution_ns``: structs ``{min, mean, max}`` in ns (means are floats); null
      where no instance has such a time.
    * ``phase_ns``, ``start_jitter_ns``, ``overruns``: of loops
      (:func:`~chainshaper.analysis.loops.loop_figures`); null for all others.
    """
    # Of a callback's registrations those of its node's last process come first.
    about = flow.objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    loops = about.filter(pl.col("kind") == "loop")["callback_id"]
    is_seen = ~pl.col("assumed") | pl.col("callback_id").is_in(loops.implode())
    ran = flow.instances.filter(is_seen).group_by("callback_id")
    figures = ran.agg(
        pids=pl.col("pid").unique(maintain_order=True),
        tids=pl.col("tid").unique().sort(),
        count=pl.len(),
        unfinished=pl.col("end").null_count(),
        response_ns=summary(pl.col("end") - pl.col("start")),
        execution_ns=summary(pl.col("execution_ns")),
    )
    names = ("callback_id", "node", "kind", "topic", "period_ns", "declared_ns", "symbol", "pid")
    joined = about.select(names).join(figures, on="callback_id")
    of_loops = loop_figures(about, flow.instances, flow.turns)
    joined = joined.join(of_loops, on="callback_id", how="left")
    return joined.sort("callback_id")


def named_callbacks(flow: DataFlow) -> pl.DataFrame:
    """Select the callbacks that have the same name in every run: node, and what starts them.

    They are rows of :func:`.callback_statistics`, without callbacks that every node has. Two more
    columns: ``starts``, the topic or the timer's declared period; ``shown``, the same with the
    period of the timer's starts beside the declared one. Several callbacks may have one name: two
    timers of one period, or those of a node that was started again.
    """
    callbacks = callback_statistics(flow).filter(
        pl.col("node").is_not_null()
        & pl.col("kind").is_in(["timer", "subscription"])
        & ~pl.col("topic").fill_null("").is_in(list(INTERNAL_TOPICS))
    )
    triggers = callbacks.select("topic", "period_ns", "declared_ns").rows()
    starts = [trigger_text(topic, declared) for topic, _, declared in triggers]
    shown = [trigger_text(*trigger) for trigger in triggers]
    texts = {"starts": starts, "shown": shown}
    return callbacks.with_columns(pl.Series(name, text, pl.String) for name, text in texts.items())


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
    """Map each name of :func:`named_callbacks`, node and ``starts``, to its longest times."""
    named = named_callbacks(flow).group_by("node", "starts", maintain_order=True)
    rows = named.agg(
        response=pl.col("response_ns").struct.field("max").max(),
        execution=pl.col("execution_ns").struct.field("max").max(),
        shown=pl.col("shown").first(),
    )
    return {(node, starts): Longest(*longest) for node, starts, *longest in rows.iter_rows()}


class RecordedExecutor(NamedTuple):
    """An executor as a recording shows it: threads of a process that run the same callbacks."""

    pid: int
    threads: dict[int, tuple[str, ...]]  # thread id → the nodes whose callbacks it ran
    callbacks: frozenset[int]  # their ids
    names: tuple[tuple[str, str], ...]
    """Node and trigger of the timers and subscriptions among them. Those that every node has are
    left out: `/clock` may have a thread of its own."""


def executors(flow: DataFlow) -> list[RecordedExecutor]:
    """Find the executors of a recording (paper, section 6): groups of callbacks that share threads.

    Callbacks that ran on one thread have one executor, and so have all that ran on any of its
    threads. A thread that calls the timers belongs to their executor (rclcpp's events executor). In
    Python the main thread belongs to it as well: it gives the others their work.
    """
    listed: list[RecordedExecutor] = []
    columns_of_runs = ("callback_id", "pid", "tid")
    calls = timer_calls(flow.events, flow.objects).select(columns_of_runs)
    ran = pl.concat([flow.instances.select(columns_of_runs), calls]).unique()
    without_executor = pl.col("kind").is_in(["loop", "unknown"]) & ~pl.col("observed")
    known = flow.objects.callbacks.filter(~without_executor)
    # Of a node that was started again only the threads of its last process count.
    known = known.unique("callback_id", keep="first", maintain_order=True).join(
        ran.group_by("callback_id", "pid").agg(tids=pl.col("tid").sort()),
        on=["callback_id", "pid"],
    )
    in_python = {*events.table(flow.events, "rclpy_followed")["pid"]}
    # A timer's declared period names it: it is the same whatever the recording shows.
    columns = ("callback_id", "node", "kind", "topic", "declared_ns", "pid", "tids", "observed")
    for row in known.sort("callback_id").select(*columns).iter_rows():
        number, node, kind, topic, declared_ns, pid, tids, observed = row
        tids = tids if observed and pid not in in_python else {pid, *tids}
        threads: dict[int, tuple[str, ...]] = dict.fromkeys(tids, (node,))
        callbacks, names = frozenset((number,)), tuple[tuple[str, str], ...]()
        if kind in ("timer", "subscription") and topic not in INTERNAL_TOPICS:
            names = ((node, trigger_text(topic, declared_ns)),)
        for executor in [
            executor
            for executor in listed
            if executor.pid == pid and executor.threads.keys() & threads
        ]:
            listed.remove(executor)
            for tid, nodes in executor.threads.items():
                threads[tid] = tuple(dict.fromkeys((*nodes, *threads.get(tid, ()))))
            callbacks, names = (
                callbacks | executor.callbacks,
                tuple(dict.fromkeys(executor.names + names)),
            )
        listed.append(RecordedExecutor(pid, threads, callbacks, names))
    return listed


@dataclass(frozen=True)
class LatencyAnalysis:
    """The end-to-end latency of one chain in one recording.

    ``traversals`` is the frame of :class:`~chainshaper.analysis.traversals.Traversals` with further
    columns:

    * ``place_ns``, ``due_at``, ``late``: see :func:`~.disturbance.with_punctuality`.
    * ``was_due``: see :func:`~.outputs_due.with_outputs_due`.
    * ``disturbed``: whether a stall of the machine hit it.
    * ``received``: when the subscriber's callback started with the output (ns, null: never).
    * ``reception_ns``: the latency until then.
    * ``reception_disturbed``: whether a stall hit it, or the delivery of its output.
    * ``latency_low_ns``, ``latency_high_ns``, and the same of ``reception``: in recordings of
      several hosts only, see :func:`~.host_clocks.with_intervals`.
    """

    chain: Chain
    graph: ApplicationGraph
    traversals: pl.DataFrame
    hops: pl.DataFrame  # see `Traversals`
    releases: pl.DataFrame  # what gates decided about these hops: `messages.gated_hops`
    statistics: LatencyStatistics  # over all complete traversals
    undisturbed: LatencyStatistics  # over those that no stall disturbed
    subscriber: (
        LatencyStatistics | None
    )  # of `reception_ns`; None: no node subscribes to the output
    subscriber_undisturbed: LatencyStatistics | None  # over those not `reception_disturbed`
    incomplete: dict[str, int]  # number of traversals without an end, by reason
    silent: int  # instances of the first callback that began no traversal
    notes: tuple[str, ...]
    not_begun: int = 0  # cycles of a plan in which the first callback did not run
    period_ns: int | None = None  # of the timer that starts the chain; None: no timer does
    data_age: DataAge | None = None  # what a loop of the chain worked with; None: it has none

    def __repr__(self) -> str:
        return shown(f"LatencyAnalysis({self.chain.spec}: {self.statistics.text})")

    _repr_html_ = notebook_html

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
    pauses: Sequence[tuple[int, int]] = (),
) -> LatencyAnalysis:
    """Measure every traversal of ``chain`` in a recording, with statistics.

    * ``clock_offset_ns``: CLOCK_REALTIME less the clock of events. A recording has it; tables from
      before Jazzy need it.
    * ``due``: when a plan has outputs leave. What is due of other chains is ignored.
    * ``between``: two instants (ns; the second may be None). Traversals that did not both begin and
      end between them are left out.
    * ``pauses``: times in which nothing ran, each from an instant until another (ns). Nothing was
      due then.

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
    traversals = traverse(flow, chain, graph)
    own_due = next(
        (
            due_of_output
            for due_of_output in due
            if due_of_output.output in {None, chain.topics[-1]}
        ),
        None,
    )
    judged, releases = with_punctuality(flow, traversals, own_due)
    stalled = pl.Series(disturbed(flow, judged, 0 if own_due is None else own_due.margin_ns))
    received = reception(flow, traversals, graph)
    sent, arrived = judged["end"].fill_null(0), received["received"].fill_null(-1)
    on_its_way = pl.Series(stalled_after(flow, sent.to_numpy(), arrived.to_numpy()))
    frame = judged.drop("origin", "computed_at", "expected_at").with_columns(
        *(received["received"], received["reception_ns"], received["received_by"]),
        disturbed=stalled,
        reception_disturbed=stalled | on_its_way,
    )
    frame = with_intervals(flow, frame, traversals.hops)
    until = None if between is None else between[1]
    frame = with_outputs_due(flow, frame, releases, due_within(flow, chain, own_due), until)
    hops = with_hop_intervals(flow, traversals.hops)
    if between is not None:
        since_ns, until_ns = between
        ended = pl.max_horizontal("start", "end")
        before = pl.lit(True) if until_ns is None else ended < until_ns
        frame = frame.filter((pl.col("start") >= since_ns) & before)
        hops, releases = (t.join(frame, on="traversal", how="semi") for t in (hops, releases))
    reasons = frame.select("reason").drop_nulls().group_by("reason").len().sort("reason")
    calm, well_received = (frame.filter(~pl.col(f"{of}disturbed")) for of in ("", "reception_"))
    subscribed = frame["reception_ns"].count() > 0
    return LatencyAnalysis(
        chain=chain,
        graph=graph,
        traversals=frame,
        hops=hops,
        releases=releases,
        statistics=_statistics(frame, "latency_ns"),
        undisturbed=_statistics(calm, "latency_ns"),
        subscriber=_statistics(frame, "reception_ns") if subscribed else None,
        subscriber_undisturbed=_statistics(well_received, "reception_ns") if subscribed else None,
        incomplete=dict(reasons.iter_rows()),
        silent=traversals.silent,
        notes=(*notes, *flow.notes, *traversals.notes),
        not_begun=0 if own_due is None else not_begun(flow, chain, own_due, between, pauses),
        period_ns=timer_period(flow, chain),
        data_age=data_age(flow, traversals, graph, between),
    )


def _statistics(frame: pl.DataFrame, column: str) -> LatencyStatistics:
    """Compute statistics of ``latency_ns`` or ``reception_ns`` over traversals."""
    measured = frame.drop_nulls(column)
    known = measured["late"].count() or not measured.height
    hit = "disturbed" if column == "latency_ns" else "reception_disturbed"
    statistics = latency_statistics(
        measured[column].to_numpy(),
        measured[hit].to_numpy(),
        incomplete=frame.height - measured.height - frame.filter(reason="inactive").height,
        late=int(measured["late"].sum()) if known else None,
    )
    low, high = (column.replace("_ns", f"_{side}_ns") for side in ("low", "high"))
    if low not in measured.columns:
        return statistics
    return bounded_statistics(statistics, measured[low].to_numpy(), measured[high].to_numpy())
