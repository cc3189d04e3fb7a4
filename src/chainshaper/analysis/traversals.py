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

**Reception.** The latency ends at the publication; the node that acts on the output subscribes to
it, and its callback starts later: after transport, and after whatever else its executor is doing.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.graph import MESSAGE_FILTER, goes_on_elsewhere, graph_of
from chainshaper.analysis.matching import by_number, first_after, in_order
from chainshaper.analysis.messages import discarded_instances, overwritten_in, why_not_sent
from chainshaper.values.application import ApplicationGraph, Callback, Chain

__all__ = ["REASONS", "Traversals", "reception", "traverse"]

REASONS: dict[str, str] = {
    "lost": "published, but never taken, though a later message of the topic was",
    "overwritten": "published, but overwritten in a full intra-process ring buffer",
    "not taken": "published, but not taken by the time the recording ended",
    "not executed": "taken, but no callback instance got it",
    "not published": "its callback instance ended without publishing",
    "discarded": "withheld on purpose: it had overrun its slot or outlived its lifespan, or newer "
    "messages had filled its asynchronous publisher's history",
    "not sent": "handed to an asynchronous publisher, whose thread had not sent it by the time the "
    "recording ended",
    "still running": "its callback instance had not ended when the recording did, or its end "
    "was lost",
}
"""Why a traversal is incomplete."""

_IN_NODE = ["not published", "discarded", "not sent", "still running"]
_REASON = pl.Enum(list(REASONS))
_VIA = pl.Enum(["instance", "sibling"])


@dataclass(frozen=True)
class Traversals:
    """All traversals of one chain.

    ``frame`` has one row per traversal, sorted by start: ``traversal`` (numbered from 0),
    ``start``, ``end``, ``latency_ns`` (null when incomplete), ``complete``, ``publication`` (the
    output's number in the data flow), ``broken_hop`` and ``broken_at`` (place in the chain and
    topic where an incomplete one stopped) and ``reason`` (a key of :data:`REASONS`).

    ``hops`` has one row per traversal and callback reached, sorted by hop: ``traversal``,
    ``hop`` (from 0), ``callback_id``, ``topic`` (that it publishes), ``instance``, ``take``
    (time), ``start``, ``publish`` (time), ``end`` (of the instance), ``source_timestamp`` (of the
    message it took), ``communication_ns`` (previous publication to start: transport and waiting),
    ``computation_ns`` (start to publication), and ``via``: ``instance`` when the instance itself
    published, ``sibling`` when another callback of its node did, null when none did. Over a
    complete traversal communication and computation add up to the latency.

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
    state = _begun(flow, path[0])
    silent = 0
    notes: list[str] = []
    for hop, (callback, topic) in enumerate(zip(path, chain.topics, strict=True)):
        if hop:
            state = _take(flow, state, hop, callback)
        state = _publish(flow, state, hop, callback, topic)
        if topic in callback.passes_on or (hop and goes_on_elsewhere(graph, callback, topic)):
            here = _published_by_node(flow, callback, topic)
            state = _publish_by_sibling(flow, state, hop, here)
            notes += _held_back(state, here, hop, callback, topic)
        state = _unless_published(flow, state, hop)
        if hop == 0:
            quiet = (pl.col("reason") == "not published").fill_null(False)
            silent = int(state.select(quiet.sum()).item())
            state = state.filter(~quiet)
    frame, hops = _described(flow, chain, state)
    return Traversals(chain, frame, hops, silent, tuple(notes))


# While it is followed, a traversal is a row of numbers: for every hop h the `instance_h`, the
# `take_h` it read, the `publication_h` it went into and whether that was a `sibling_h`'s. Numbers
# are the row numbers of the data flow's frames, so times are looked up when they are needed.


def _begun(flow: DataFlow, first: Callback) -> pl.DataFrame:
    """One row per instance of the first callback, with what it took if it is a subscription."""
    begun = flow.instances.filter(pl.col("callback_id") == first.id).select(instance_0="instance")
    taken = (
        flow.takes.filter((pl.col("callback_id") == first.id) & pl.col("instance").is_not_null())
        .select(instance_0="instance", take_0="take")
        .unique("instance_0", keep="last", maintain_order=True)
    )
    return begun.join(taken, on="instance_0", how="left", maintain_order="left").with_columns(
        pl.lit(None, dtype=pl.UInt8).alias("broken_hop"),
        pl.lit(None, dtype=_REASON).alias("reason"),
    )


def _publish(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> pl.DataFrame:
    """Add the publications of the hop's topic inside each traversal's instance."""
    own = flow.publications.filter(
        (pl.col("callback_id") == callback.id) & (pl.col("topic") == topic)
    ).select(
        pl.col("instance").alias(f"instance_{hop}"),
        pl.col("publication").alias(f"publication_{hop}"),
    )
    instance, publication = f"instance_{hop}", f"publication_{hop}"
    first = by_number(own.drop_nulls(), instance, publication, flow.instances.height)
    if first.count() == own[instance].count():
        state = state.with_columns(first.gather(state[instance]).alias(publication))
    else:  # an instance that publishes several times begins as many traversals
        state = state.join(own, on=instance, how="left", maintain_order="left")
    return state.with_columns(pl.lit(False).alias(f"sibling_{hop}"))


def _published_by_node(flow: DataFlow, callback: Callback, topic: str) -> pl.DataFrame:
    """``later, sent, created``: the node's publications, and since when their publisher exists."""
    publishers = flow.objects.publishers.select("publisher", created="valid_from")
    here = flow.publications.filter(
        (pl.col("topic") == topic)
        & (pl.col("pid") == callback.pid)
        & (pl.col("node") == callback.node)
    ).select("publisher", later="publication", sent="time")
    return here.join(publishers, on="publisher", how="left", maintain_order="left")


def _publish_by_sibling(
    flow: DataFlow, state: pl.DataFrame, hop: int, here: pl.DataFrame
) -> pl.DataFrame:
    """Fill in the first publication by the node after the instance's start.

    A node that was created anew in between knows nothing of the messages of the one before it.
    """
    waiting = pl.col(f"publication_{hop}").is_null() & pl.col(f"instance_{hop}").is_not_null()
    rows = state.with_row_index("row").filter(waiting)
    start = _looked_up(flow.instances, "start", f"instance_{hop}").alias("start")
    found = first_after(rows.select("row", start), here, [], "start", "sent", strictly=True)
    later = found.filter(pl.col("created") <= pl.col("start")).select("row", "later")
    joined = state.with_row_index("row").join(later, on="row", how="left", maintain_order="left")
    return joined.with_columns(
        pl.coalesce(f"publication_{hop}", "later"),
        (pl.col(f"sibling_{hop}") | pl.col("later").is_not_null()).alias(f"sibling_{hop}"),
    ).drop("row", "later")


def _held_back(
    state: pl.DataFrame, here: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> list[str]:
    """A note if outputs of a synchroniser got no input that came since the output before."""
    if callback.symbol is not None and MESSAGE_FILTER not in callback.symbol:
        return []  # a callback that stores its latest message: old values are its purpose
    reached = state[f"publication_{hop}"].drop_nulls()
    between = here.filter(pl.col("later").is_between(reached.min(), reached.max()))
    missed = between.height - reached.n_unique()
    if missed <= 0:
        return []
    return [
        f"{missed} of {between.height} publications on {topic} came without a new message on "
        f"{callback.topic}: {callback.node} holds messages back or uses old ones again, for how "
        "long the events do not show; latencies through it are lower bounds."
    ]


def _unless_published(flow: DataFlow, state: pl.DataFrame, hop: int) -> pl.DataFrame:
    instance, publication = pl.col(f"instance_{hop}"), pl.col(f"publication_{hop}")
    stuck = pl.col("reason").is_null() & instance.is_not_null() & publication.is_null()
    ended = _looked_up(flow.instances, "end", f"instance_{hop}").is_not_null()
    why = pl.when(ended).then(pl.lit("not published")).otherwise(pl.lit("still running"))
    if "gate_release" in flow.events:
        withheld = discarded_instances(flow.takes, flow.events, flow.objects, flow.instances.height)
        gone = pl.lit(withheld).gather(instance)
        why = pl.when(ended & gone.is_not_null()).then(pl.lit("discarded")).otherwise(why)
    state = _broken(state, stuck, hop, why)
    if not flow.publications["sent"].null_count():
        return state
    kept = pl.lit(flow.publications["sent"].is_null()).gather(publication)
    unsent = pl.lit(why_not_sent(flow.publications, flow.events, flow.objects))
    kept_back = pl.col("reason").is_null() & kept.fill_null(False)
    return _broken(state, kept_back, hop, unsent.gather(publication))


def _take(flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback) -> pl.DataFrame:
    """Add the instance of ``callback`` that took each traversal's latest publication."""
    taken = flow.takes.filter(
        (pl.col("callback_id") == callback.id) & pl.col("publication").is_not_null()
    ).select("publication", "take", "instance")
    # Should a message have been taken twice, the take that led to an execution is followed, of
    # several the first: what is laid out last stays.
    executed = pl.col("instance").is_not_null()
    taken = pl.concat([taken.filter(~executed).reverse(), taken.filter(executed).reverse()])
    height = flow.publications.height
    before = pl.col(f"publication_{hop - 1}")
    state = state.with_columns(
        pl.lit(by_number(taken, "publication", column, height))
        .gather(before)
        .alias(f"{column}_{hop}")
        for column in ("take", "instance")
    )
    untaken = pl.col("reason").is_null() & pl.col(f"take_{hop}").is_null()
    why = _why_not_taken(flow, taken, callback, pl.col(f"publication_{hop - 1}"))
    state = _broken(state, untaken, hop, why)
    unread = pl.col("reason").is_null() & pl.col(f"instance_{hop}").is_null()
    return _broken(state, unread, hop, pl.lit("not executed"))


def _why_not_taken(
    flow: DataFlow, taken: pl.DataFrame, callback: Callback, publication: pl.Expr
) -> pl.Expr:
    """The reason why a publication that ``callback`` never took broke its traversal."""
    latest = pl.lit(taken["publication"].max(), dtype=pl.UInt32)
    later = (publication < latest).fill_null(False)  # they are numbered in order of time
    reason = pl.when(later).then(pl.lit("lost")).otherwise(pl.lit("not taken"))
    if not flow.publications["intra_time"].count():
        return reason
    overwritten = overwritten_in(flow.events, flow.publications, flow.objects.buffers, callback.id)
    marks = pl.DataFrame({"publication": overwritten}).with_columns(gone=True)
    gone = by_number(marks, "publication", "gone", flow.publications.height)
    return pl.when(pl.lit(gone).gather(publication)).then(pl.lit("overwritten")).otherwise(reason)


def _broken(state: pl.DataFrame, where: pl.Expr, hop: int, reason: pl.Expr) -> pl.DataFrame:
    """Mark the traversals that stop at ``hop``; those that stopped earlier keep their mark."""
    at = pl.lit(hop, dtype=pl.UInt8)
    return state.with_columns(
        pl.when(where).then(at).otherwise("broken_hop").alias("broken_hop"),
        pl.when(where).then(reason.cast(_REASON)).otherwise("reason").alias("reason"),
    )


def _looked_up(frame: pl.DataFrame, column: str, numbers: str) -> pl.Expr:
    """``column`` of the rows of ``frame`` that the state's column ``numbers`` names."""
    return pl.lit(frame[column]).gather(pl.col(numbers))


def _described(
    flow: DataFlow, chain: Chain, state: pl.DataFrame
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The frames of :class:`Traversals` from the rows of numbers."""
    last = len(chain.callbacks) - 1
    frame = state.with_columns(
        start=_looked_up(flow.instances, "start", "instance_0"),
        end=_looked_up(flow.publications, "sent", f"publication_{last}"),
    )
    frame = in_order(frame, "start", "end", f"publication_{last}", nulls_last=True)
    frame = frame.with_row_index("traversal")
    # A message that was not taken broke its chain on the topic before the hop it did not reach.
    on_the_way = pl.col("reason").is_in(_IN_NODE).not_()
    place = pl.col("broken_hop").cast(pl.Int64) - on_the_way.cast(pl.Int64)
    summary = frame.select(
        "traversal",
        "start",
        "end",
        (pl.col("end") - pl.col("start")).alias("latency_ns"),
        pl.col("end").is_not_null().alias("complete"),
        pl.col(f"publication_{last}").alias("publication"),
        "broken_hop",
        pl.lit(pl.Series(chain.topics)).gather(place).alias("broken_at"),
        "reason",
    )
    hops = [_hop(flow, chain, frame, hop) for hop in range(last + 1)]
    return summary, pl.concat(hops)


def _hop(flow: DataFlow, chain: Chain, frame: pl.DataFrame, hop: int) -> pl.DataFrame:
    previous, publish = pl.lit(None, dtype=pl.Int64), _published_at(flow, hop, chain)
    if hop:
        previous = _published_at(flow, hop - 1, chain)
    sibling = pl.when(f"sibling_{hop}").then(pl.lit("sibling")).otherwise(pl.lit("instance"))
    published = pl.col("publish").is_not_null()
    return (
        frame.filter(pl.col(f"instance_{hop}").is_not_null())
        .select(
            "traversal",
            pl.lit(hop, dtype=pl.UInt8).alias("hop"),
            pl.lit(chain.callbacks[hop], dtype=pl.UInt32).alias("callback_id"),
            pl.lit(chain.topics[hop], dtype=pl.Enum(list(chain.topics))).alias("topic"),
            pl.col(f"instance_{hop}").alias("instance"),
            _looked_up(flow.takes, "time", f"take_{hop}").alias("take"),
            _looked_up(flow.instances, "start", f"instance_{hop}").alias("start"),
            publish.alias("publish"),
            _looked_up(flow.instances, "end", f"instance_{hop}").alias("end"),
            _looked_up(flow.takes, "source_timestamp", f"take_{hop}").alias("source_timestamp"),
            previous.alias("communication_ns"),
            sibling.cast(_VIA).alias("via"),
        )
        .with_columns(
            (pl.col("start") - pl.col("communication_ns")).alias("communication_ns"),
            (pl.col("publish") - pl.col("start")).alias("computation_ns"),
            pl.when(published).then("via").alias("via"),
        )
    )


def _published_at(flow: DataFlow, hop: int, chain: Chain) -> pl.Expr:
    """When the hop's message left: for a ring buffer when it was put there, else with DDS."""
    time = _looked_up(flow.publications, "sent", f"publication_{hop}")
    if hop == len(chain.callbacks) - 1 or not flow.takes["intra_process"].any():
        return time
    put = _looked_up(flow.publications, "intra_time", f"publication_{hop}")
    through_buffer = _looked_up(flow.takes, "intra_process", f"take_{hop + 1}")
    return pl.when(through_buffer).then(put).otherwise(time)


def reception(
    flow: DataFlow, traversals: Traversals, graph: ApplicationGraph, node: str | None = None
) -> pl.DataFrame:
    """When a callback of the output's subscriber started with each traversal's message.

    One row per traversal, in order: ``traversal``, ``received`` (start of the callback instance
    that took the output, null if there is none) and ``reception_ns`` (from the traversal's
    start). The subscriber is that of ``node``, by default the first subscription callback of the
    last topic that received anything at all.
    """
    topic = traversals.chain.topics[-1]
    candidates = [
        callback.id
        for callback in graph.callbacks
        if callback.kind == "subscription"
        and callback.topic == topic
        and node in {None, callback.node}
    ]
    taken = flow.takes.filter(
        pl.col("callback_id").is_in(candidates)
        & pl.col("publication").is_not_null()
        & pl.col("instance").is_not_null()
    ).select("callback_id", "publication", "instance")
    taken = taken.filter(pl.col("callback_id") == pl.col("callback_id").min())
    # Of several takes the first: what is laid out last stays.
    reader = by_number(taken.reverse(), "publication", "instance", flow.publications.height)
    received = flow.instances["start"].gather(reader.gather(traversals.frame["publication"]))
    return traversals.frame.select(
        "traversal", received=received, reception_ns=received - pl.col("start")
    )
