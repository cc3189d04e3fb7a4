"""Traversals of a chain: following every message from the first callback to the last topic.

A traversal is what the paper's tool walks (section 2.4, figure 2): it begins with the
`callback_start` of an instance of the chain's first callback, goes on from a publication to the
instance whose take has the same topic and source timestamp, and ends with the publication of the
chain's last topic. Its length is the end-to-end latency L.

**Which publication a message goes into.** Those made on the hop's topic inside the instance that
read it. If there is none, and other callbacks of the node publish this topic too (synchronising
callbacks, stored messages: :mod:`~chainshaper.analysis.graph`), the first publication of the
topic by the node after the instance's start. For message_filters that is the soonest set
that the message can be in, and several inputs may go into one output. Which set it really was in
no event shows: an approximate-time synchroniser may hold messages back until the next one. Outputs
into which no new input went give that away; then ``notes`` says that L is a lower bound.

**One row per data flow.** An instance that publishes a topic twice makes two traversals, with
the same start; two messages that go into one publication are two traversals with the same end.

**Silent instances.** An instance of the first callback that ended and published nothing on the
chain's first topic begins no traversal: callbacks may publish on a condition, and no data flowed
that could be late. They are counted in ``silent``. Further down, where data had arrived, an
instance that publishes nothing leaves its traversal incomplete.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.graph import MESSAGE_FILTER, goes_on_elsewhere, graph_of
from chainshaper.analysis.matching import first_after
from chainshaper.analysis.messages import overwritten_in
from chainshaper.app import ApplicationGraph, Callback, Chain

__all__ = ["REASONS", "Traversals", "reception", "traverse"]

REASONS: dict[str, str] = {
    "lost": "published, but never taken, though a later message of the topic was",
    "overwritten": "published, but overwritten in a full intra-process ring buffer",
    "not taken": "published, but not taken by the time the recording ended",
    "not executed": "taken, but no callback instance got it",
    "not published": "its callback instance ended without publishing",
    "still running": "its callback instance had not ended when the recording did, or its end "
    "was lost",
}
"""Why a traversal is incomplete."""


@dataclass(frozen=True)
class Traversals:
    """All traversals of one chain.

    ``frame`` has one row per traversal, sorted by start: ``traversal`` (numbered from 0),
    ``start``, ``end``, ``latency_ns`` (null when incomplete), ``complete``, ``publication`` (the
    output's number in the data flow), ``broken_hop`` and ``broken_at`` (place in the chain and
    topic where an incomplete one stopped) and ``reason`` (a key of :data:`REASONS`).

    ``hops`` has one row per traversal and callback reached: ``traversal``, ``hop`` (from 0),
    ``callback_id``, ``topic`` (that it publishes), ``instance``, ``take`` (time), ``start``,
    ``publish`` (time), ``end`` (of the instance), ``source_timestamp`` (of the message it took),
    ``communication_ns`` (previous publication to start: waiting and transport),
    ``computation_ns`` (start to publication), and ``via``: ``instance`` when the instance itself
    published, ``sibling`` when another callback of its node did. Over a complete traversal
    communication and computation add up to the latency.

    ``silent`` counts instances of the first callback that published nothing. ``notes`` says what
    the events leave open.
    """

    chain: Chain
    frame: pl.DataFrame
    hops: pl.DataFrame
    silent: int
    notes: tuple[str, ...]


def traverse(flow: DataFlow, chain: Chain, graph: ApplicationGraph | None = None) -> Traversals:
    """Follow every traversal of ``chain``, whose callbacks are ids of the recording's graph.

    Cost is a few joins per hop, linear in the messages of the chain.
    """
    graph = graph or graph_of(flow)
    callbacks = {callback.id: callback for callback in graph.callbacks}
    path = [callbacks[number] for number in chain.callbacks]
    state = (
        flow.instances.filter(pl.col("callback_id") == path[0].id)
        .select(instance_0="instance", start_0="start", end_0="end")
        .with_columns(
            pl.lit(None, dtype=pl.Int64).alias("broken_hop"),
            pl.lit(None, dtype=pl.String).alias("broken_at"),
            pl.lit(None, dtype=pl.String).alias("reason"),
        )
    )
    state = _with_first_take(flow, state)
    silent = 0
    notes: list[str] = []
    for hop, (callback, topic) in enumerate(zip(path, chain.topics, strict=True)):
        if hop:
            state = _take(flow, state, hop, callback, chain.topics[hop - 1])
        state = _publish(flow, state, hop, callback, topic)
        if topic in callback.passes_on or (hop and goes_on_elsewhere(graph, callback, topic)):
            here = _published_by_node(flow, callback, topic)
            state = _publish_by_sibling(state, here, hop)
            notes += _held_back(state, here, hop, callback, topic)
        state = _unless_published(state, hop, topic)
        if hop == 0:
            quiet = (pl.col("reason") == "not published").fill_null(False)
            silent = int(state.select(quiet.sum()).item())
            state = state.filter(~quiet)
    frame, hops = _finished(chain, state)
    return Traversals(chain, frame, hops, silent, tuple(notes))


def _with_first_take(flow: DataFlow, state: pl.DataFrame) -> pl.DataFrame:
    """What the first callback's instances took, when it is a subscription."""
    taken = flow.takes.drop_nulls("instance").select(
        instance_0="instance", take_0="time", stamp_0="source_timestamp"
    )
    taken = taken.unique("instance_0", keep="last", maintain_order=True)
    return state.join(taken, on="instance_0", how="left", maintain_order="left")


def _publish(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> pl.DataFrame:
    """Add the publications of the hop's topic inside each traversal's instance."""
    own = flow.publications.filter(
        (pl.col("topic") == topic) & (pl.col("callback_id") == callback.id)
    ).select(
        pl.col("instance").alias(f"instance_{hop}"),
        pl.col("publication").alias(f"publication_{hop}"),
        pl.col("time").alias(f"publish_{hop}"),
        pl.col("intra_time").alias(f"intra_{hop}"),
        pl.lit("instance").alias(f"via_{hop}"),
    )
    return state.join(own, on=f"instance_{hop}", how="left", maintain_order="left")


def _published_by_node(flow: DataFlow, callback: Callback, topic: str) -> pl.DataFrame:
    return flow.publications.filter(
        (pl.col("topic") == topic)
        & (pl.col("pid") == callback.pid)
        & (pl.col("node") == callback.node)
    ).select(sibling="publication", sibling_time="time", sibling_intra="intra_time")


def _publish_by_sibling(state: pl.DataFrame, here: pl.DataFrame, hop: int) -> pl.DataFrame:
    """Fill in the first publication by the node after the instance's start."""
    rows = state.with_row_index("row")
    rows = first_after(rows, here, [], f"start_{hop}", "sibling_time", strictly=True).sort("row")
    found = pl.col(f"publication_{hop}").is_null() & pl.col("sibling").is_not_null()
    filled = {
        f"publication_{hop}": pl.col("sibling"),
        f"publish_{hop}": pl.col("sibling_time"),
        f"intra_{hop}": pl.col("sibling_intra"),
        f"via_{hop}": pl.lit("sibling"),
    }
    return rows.with_columns(
        pl.when(found).then(value).otherwise(name).alias(name) for name, value in filled.items()
    ).select(state.columns)


def _held_back(
    state: pl.DataFrame, here: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> list[str]:
    """A note if outputs of a synchroniser got no input that came since the output before."""
    if callback.symbol is not None and MESSAGE_FILTER not in callback.symbol:
        return []  # a callback that stores its latest message: old values are its purpose
    reached = state[f"publication_{hop}"].drop_nulls()
    between = here.filter(pl.col("sibling").is_between(reached.min(), reached.max()))
    missed = between.height - reached.n_unique()
    if missed <= 0:
        return []
    return [
        f"{missed} of {between.height} publications on {topic} came without a new message on "
        f"{callback.topic}: {callback.node} holds messages back before it publishes them, for how "
        "long the events do not show; latencies through it are lower bounds."
    ]


def _unless_published(state: pl.DataFrame, hop: int, topic: str) -> pl.DataFrame:
    stuck = (
        pl.col("reason").is_null()
        & pl.col(f"instance_{hop}").is_not_null()
        & pl.col(f"publication_{hop}").is_null()
    )
    ended = pl.col(f"end_{hop}").is_not_null()
    why = pl.when(ended).then(pl.lit("not published")).otherwise(pl.lit("still running"))
    return _broken(state, stuck, hop, topic, why)


def _take(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> pl.DataFrame:
    """Add the instance of ``callback`` that took each traversal's latest publication."""
    last = hop - 1
    mine = flow.takes.filter(pl.col("callback_id") == callback.id).drop_nulls("publication")
    times = flow.instances.filter(pl.col("callback_id") == callback.id)
    times = times.select("instance", start="start", end="end")
    # Should a message have been taken twice, the take that led to an execution is followed.
    mine = mine.sort(pl.col("instance").is_null(), "time", maintain_order=True)
    mine = mine.unique("publication", keep="first", maintain_order=True)
    mine = mine.join(times, on="instance", how="left").select(
        pl.col("publication").alias(f"publication_{last}"),
        pl.col("instance").alias(f"instance_{hop}"),
        pl.col("time").alias(f"take_{hop}"),
        pl.col("source_timestamp").alias(f"stamp_{hop}"),
        pl.col("start").alias(f"start_{hop}"),
        pl.col("end").alias(f"end_{hop}"),
        pl.col("intra_process").alias("through_buffer"),
    )
    state = state.join(mine, on=f"publication_{last}", how="left", maintain_order="left")
    # A message that went through a ring buffer left when it was put there, not when DDS got it.
    left = pl.when("through_buffer").then(f"intra_{last}").otherwise(f"publish_{last}")
    state = state.with_columns(left.alias(f"publish_{last}")).drop("through_buffer")
    untaken = pl.col("reason").is_null() & pl.col(f"take_{hop}").is_null()
    state = _broken(state, untaken, hop, topic, _why_not_taken(flow, mine, callback, last))
    unread = pl.col("reason").is_null() & pl.col(f"instance_{hop}").is_null()
    return _broken(state, unread, hop, topic, pl.lit("not executed"))


def _why_not_taken(flow: DataFlow, taken: pl.DataFrame, callback: Callback, last: int) -> pl.Expr:
    """The reason why a publication that ``callback`` never took broke its traversal."""
    publication = pl.col(f"publication_{last}")
    latest = taken[f"publication_{last}"].max()
    later = publication < pl.lit(latest, dtype=pl.Int64)  # numbered in order of time
    reason = pl.when(later.fill_null(False)).then(pl.lit("lost")).otherwise(pl.lit("not taken"))
    if not flow.publications["intra_time"].count():
        return reason
    overwritten = overwritten_in(flow.events, flow.publications, flow.objects.buffers, callback.id)
    return (
        pl.when(publication.is_in(overwritten.implode()))
        .then(pl.lit("overwritten"))
        .otherwise(reason)
    )


def _broken(
    state: pl.DataFrame, where: pl.Expr, hop: int, topic: str, reason: pl.Expr
) -> pl.DataFrame:
    """Mark the traversals that stop at ``hop``; those that stopped earlier keep their mark."""
    at = pl.lit(hop, dtype=pl.Int64)
    return state.with_columns(
        pl.when(where).then(at).otherwise("broken_hop").alias("broken_hop"),
        pl.when(where).then(pl.lit(topic)).otherwise("broken_at").alias("broken_at"),
        pl.when(where).then(reason).otherwise("reason").alias("reason"),
    )


def _finished(chain: Chain, state: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    last = len(chain.callbacks) - 1
    state = state.sort("start_0", f"publish_{last}", maintain_order=True)
    state = state.with_row_index("traversal").with_columns(pl.col("traversal").cast(pl.Int64))
    frame = state.select(
        "traversal",
        start="start_0",
        end=f"publish_{last}",
        latency_ns=pl.col(f"publish_{last}") - pl.col("start_0"),
        complete=pl.col(f"publish_{last}").is_not_null(),
        publication=f"publication_{last}",
        broken_hop="broken_hop",
        broken_at="broken_at",
        reason="reason",
    )
    return frame, _hops(chain, state)


def _hops(chain: Chain, state: pl.DataFrame) -> pl.DataFrame:
    parts = []
    for hop, (callback_id, topic) in enumerate(zip(chain.callbacks, chain.topics, strict=True)):
        previous = pl.col(f"publish_{hop - 1}") if hop else pl.lit(None, dtype=pl.Int64)
        parts.append(
            state.filter(pl.col(f"instance_{hop}").is_not_null()).select(
                "traversal",
                hop=pl.lit(hop, dtype=pl.Int64),
                callback_id=pl.lit(callback_id, dtype=pl.Int64),
                topic=pl.lit(topic),
                instance=f"instance_{hop}",
                take=f"take_{hop}",
                start=f"start_{hop}",
                publish=f"publish_{hop}",
                end=f"end_{hop}",
                source_timestamp=f"stamp_{hop}",
                communication_ns=pl.col(f"start_{hop}") - previous,
                computation_ns=pl.col(f"publish_{hop}") - pl.col(f"start_{hop}"),
                via=f"via_{hop}",
            )
        )
    return pl.concat(parts).sort("traversal", "hop", maintain_order=True)


def reception(
    flow: DataFlow, traversals: Traversals, graph: ApplicationGraph, node: str | None = None
) -> pl.DataFrame:
    """What the subscriber of the chain's output sees: the latency to its `callback_start`.

    The paper's latency ends at the publication; an actuator's node gets the message later. One
    row per traversal, in order: ``traversal``, ``received`` (start of the callback instance that
    took the output, null if there is none) and ``reception_ns`` (from the traversal's start).
    The subscriber is that of ``node``, by default the first subscription callback of the last
    topic that took anything at all.
    """
    topic = traversals.chain.topics[-1]
    candidates = [
        callback.id
        for callback in graph.callbacks
        if callback.kind == "subscription"
        and callback.topic == topic
        and node in {None, callback.node}
    ]
    taken = flow.takes.drop_nulls(["publication", "instance"]).filter(
        pl.col("callback_id").is_in(candidates)
    )
    taken = taken.filter(pl.col("callback_id") == pl.col("callback_id").min())
    started = flow.instances.select("instance", received="start")
    taken = taken.join(started, on="instance", how="left").sort("received")
    taken = taken.unique("publication", keep="first").select("publication", "received")
    rows = traversals.frame.join(taken, on="publication", how="left", maintain_order="left")
    return rows.select("traversal", "received", reception_ns=pl.col("received") - pl.col("start"))
