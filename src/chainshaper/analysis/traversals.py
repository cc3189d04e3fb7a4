"""Traversals of a chain: following every message from the first callback to the last topic.

A traversal (paper, section 2.4, figure 2) begins with the `callback_start` of an instance of the
chain's first callback, goes on from a publication to the instance whose take has the same topic and
source timestamp, and ends with the publication of the chain's last topic: the latency L.

**Which publication a message goes into.** Those made on the hop's topic inside the instance that
read it. If there is none, and other callbacks of the node publish this topic too (synchronising
callbacks, stored messages: :mod:`~chainshaper.analysis.graph`), that of the node's first instance
which starts after it and publishes the topic; what several threads publish in instances that run
already has got its inputs before, but for a set's inputs that start at once, of which any may
complete it. For message_filters that is the soonest set that the message can be in. An
approximate-time synchroniser may hold messages back; outputs into which no new input went give that
away, and ``notes`` says that L is a lower bound.

**The newest message counts.** Of several messages that a node stored for one publication, of a
timer or of a synchroniser of its own, the newest is taken to be in it, as in a variable that is
overwritten: L is the age of what was published. The others are incomplete, "not used"; no output is
missing for them. message_filters has queues instead: there each message counts, also where several
came before one publication, of which only one can have been in it; ``notes`` says so.

**One row per data flow.** An instance that publishes a topic twice makes two traversals, with
the same start.

**A standby.** What a shaping node's standby published for it, while it was not there, is the
chain's output: the traversal goes on with the standby's instance.

**Silent instances.** An instance of the first callback that ended and published nothing on the
chain's first topic begins no traversal: callbacks may publish on a condition. Further down, where
data had arrived, an instance that publishes nothing leaves its traversal incomplete.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.graph import MESSAGE_FILTER, goes_on_elsewhere, graph_of
from chainshaper.analysis.matching import by_number, first_after, in_order, latest_before
from chainshaper.analysis.messages import (
    discarded_instances,
    gated_hops,
    overwritten_in,
    why_not_sent,
)
from chainshaper.values.application import ApplicationGraph, Callback, Chain
from chainshaper.values.plan_choices import STANDBY

REASONS: dict[str, str] = {
    "lost": "published, but never taken, though a later message of the topic was",
    "overwritten": "published, but overwritten in a full intra-process ring buffer",
    "not taken": "published, but not taken by the time the recording ended",
    "take not recorded": "published, but which of its subscriber's callback instances got it, no "
    "event says: there are none of its takes",
    "not executed": "taken, but no callback instance got it",
    "not published": "its callback instance, or its process, ended without publishing",
    "not used": "stored for a timer or a synchroniser of its node, which used a newer message",
    "inactive": "its node is a lifecycle node, which was not active then",
    "discarded": "withheld on purpose: it had overrun its slot or outlived its lifespan, or newer "
    "messages had filled its asynchronous publisher's history",
    "not sent": "handed to an asynchronous publisher, whose thread had not sent it by the time the "
    "recording ended",
    "still running": "its callback instance had not ended when the recording did, or its end "
    "was lost",
}
"""Why a traversal is incomplete."""

OWES_NO_OUTPUT = ("not used", "inactive")
"""Reasons for which no output is missing."""

_SILENT = ["not published", "inactive"]
_IN_NODE = [*_SILENT, "not used", "discarded", "not sent", "still running"]
_WITHOUT_EFFECT = ["not published", "lost", "not taken", "take not recorded", "not executed"]
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
    ``hop`` (from 0), ``callback_id`` (of a standby where that published for its shaping node),
    ``topic`` (that it publishes), ``instance``, the times
    ``take``, ``start``, ``publish`` and ``end`` (of the instance), ``source_timestamp`` (of the
    message it took), ``communication_ns`` (previous publication to start: transport and waiting),
    ``computation_ns`` (start to publication, without the next), ``waiting_ns`` (in the node: from
    the end of the instance until another callback of the node began, which published for it; in a
    gate, from the arrival until it let go; for a publisher's thread, until that sent it), and
    ``via``: ``instance`` when the instance itself published, ``sibling`` when another callback of
    its node did. Over a complete traversal the three parts add up to the latency.

    ``silent`` counts instances of the first callback that published nothing.
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
    # While it is followed, a traversal is a row of numbers: for every hop h the `instance_h`, the
    # `take_h` it read, the `publication_h` it went into and whether that was a `sibling_h`'s.
    # Numbers are rows of the data flow's frames, so times are looked up when they are needed.
    graph = graph or graph_of(flow)
    path = graph.path(chain)
    state = _begun(flow, path[0])
    silent, notes = 0, list[str]()
    for hop, (callback, topic) in enumerate(zip(path, chain.topics, strict=True)):
        standby = _standby(graph, callback, topic)
        if hop:
            state = _take(flow, state, hop, callback, standby=standby, topic=topic)
        state = _publish(flow, state, hop, [callback.id, *standby], topic)
        if topic in callback.passes_on or (hop and goes_on_elsewhere(graph, callback, topic)):
            state, note = _publish_by_sibling(flow, state, hop, callback, topic)
            if _keeps_newest(graph, callback, topic):
                state = _newest_alone(state, hop)
            notes += note
        state = _unless_published(flow, state, hop)
        state = _unless_active(flow, state, hop, callback)
        if hop == 0:
            # One whose process died as it ran is no silent one: it might have published.
            ended = _looked_up(flow.instances, "end", "instance_0").is_not_null()
            begun = state.filter(~(ended & pl.col("reason").is_in(_SILENT).fill_null(False)))
            silent, state = state.height - begun.height, begun
    frame = _described(flow, chain, state)
    hops = pl.concat(_hop(flow, chain, frame, hop) for hop in range(len(path)))
    hops = _without_holds(flow, hops)
    return Traversals(chain, frame.select(_SUMMARY), hops, silent, tuple(notes))


def _begun(flow: DataFlow, first: Callback) -> pl.DataFrame:
    """One row per instance of the first callback, with what it took if it is a subscription."""
    own = pl.col("callback_id") == first.id
    taken = flow.takes.filter(own & pl.col("instance").is_not_null())
    take = by_number(taken, "instance", "take", flow.instances.height)
    return flow.instances.filter(own).select(
        instance_0="instance",
        take_0=pl.lit(take).gather("instance"),
        broken_hop=pl.lit(None, dtype=pl.UInt8),
        reason=pl.lit(None, dtype=_REASON),
    )


def _standby(graph: ApplicationGraph, callback: Callback, topic: str) -> list[int]:
    """The callback that publishes the topic while this one, a shaping node's, is not there."""
    return [
        one.id
        for one in graph.callbacks
        if one.node == callback.node + STANDBY
        and one.trigger == callback.trigger
        and topic in one.publishes
    ]


def _publish(
    flow: DataFlow, state: pl.DataFrame, hop: int, callbacks: Sequence[int], topic: str
) -> pl.DataFrame:
    """Add the publications of the hop's topic inside each traversal's instance."""
    own = pl.col("callback_id").is_in(callbacks) & (pl.col("topic") == topic)
    inside = flow.publications.filter(own & pl.col("instance").is_not_null())
    instance, publication = f"instance_{hop}", f"publication_{hop}"
    first = by_number(inside, "instance", "publication", flow.instances.height)
    if first.count() == inside.height:
        state = state.with_columns(first.gather(state[instance]).alias(publication))
    else:  # an instance that publishes several times begins as many traversals
        named = inside.select(**{instance: "instance", publication: "publication"})
        state = state.join(named, on=instance, how="left", maintain_order="left")
    return state.with_columns(pl.lit(False).alias(f"sibling_{hop}"))


def _publish_by_sibling(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback, topic: str
) -> tuple[pl.DataFrame, list[str]]:
    """Fill in what the node's first instance after this one's start publishes.

    A node that was created anew in between knows nothing of the messages of the one before it.
    Also returns notes where it is not clear which input an output of message_filters got.
    """
    publication, sibling = f"publication_{hop}", f"sibling_{hop}"
    publishers = flow.objects.publishers.select("publisher", created="valid_from")
    of_node = pl.col("pid").is_in(callback.processes) & (pl.col("node") == callback.node)
    here = flow.publications.filter((pl.col("topic") == topic) & of_node)
    began = pl.coalesce(_looked_up(flow.instances, "start", "instance"), "time")
    here = here.select("publisher", "callback_id", "time", later="publication", began=began)
    here = here.join(publishers, on="publisher", how="left", maintain_order="left")
    waiting = pl.col(publication).is_null() & pl.col(f"instance_{hop}").is_not_null()
    start = _looked_up(flow.instances, "start", f"instance_{hop}")
    rows = state.with_row_index("row").filter(waiting).select("row", start=start)
    if topic in callback.in_turns:
        here = _begun_with_last_input(here.sort("began"), rows["start"].sort(), callback.id)
    found = first_after(rows, here, [], "start", "began", strictly=True)
    found = found.filter(pl.col("created") <= pl.col("start"))
    later = by_number(found, "row", "later", state.height)
    state = state.with_columns(
        pl.coalesce(publication, later), (pl.col(sibling) | later.is_not_null()).alias(sibling)
    )
    if callback.kind == "service" or MESSAGE_FILTER not in (callback.symbol or MESSAGE_FILTER):
        return state, []  # a callback that stores its latest message: old values are its purpose
    reached = state[publication].drop_nulls()
    between = here.filter(pl.col("later").is_between(reached.min(), reached.max())).height
    missed = between - reached.n_unique()
    note = (
        f"{missed} of {between} publications on {topic} came without a new message on "
        f"{callback.topic}: {callback.node} holds messages back or uses old ones again, for how "
        "long the events do not show; latencies through it are lower bounds."
    )
    if missed > 0:
        return state, [note]
    shared = reached.len() - reached.n_unique()
    note = (
        f"{shared} messages on {callback.topic} count with the same publication on {topic} as "
        f"another one: {callback.node} has one of them in it, and no event says which."
    )
    return state, [note] if shared else []


def _keeps_newest(graph: ApplicationGraph, callback: Callback, topic: str) -> bool:
    """Whether a node that stores what the callback reads has the newest message only."""
    if callback.kind == "service":
        return False  # each goal of an action has feedback of its own
    by_timer = any(
        one.kind == "timer" and topic in one.publishes
        for one in graph.callbacks
        if (one.node, one.pid) == (callback.node, callback.pid)
    )
    return by_timer or MESSAGE_FILTER not in (callback.symbol or MESSAGE_FILTER)


def _newest_alone(state: pl.DataFrame, hop: int) -> pl.DataFrame:
    """The state in which of several messages that went into one publication the newest did alone.

    A node that stores messages has the newest when it publishes: those before it are not used.
    """
    instance, publication = f"instance_{hop}", f"publication_{hop}"
    newest = pl.col(instance).max().over(publication)
    older = (pl.col(publication).is_not_null() & (pl.col(instance) < newest)).fill_null(False)
    state = _broken(state, older, hop, pl.lit("not used"))
    return state.with_columns(pl.when(~older).then(publication).alias(publication))


def _begun_with_last_input(here: pl.DataFrame, stored: pl.Series, callback: int) -> pl.DataFrame:
    """Outputs whose ``began`` lies behind each input that ``callback`` stored for them.

    Of inputs that start at once on several threads the lock of the set makes one the last: where
    none was ``stored`` since the output before, the first that started while this one ran was.
    """
    before = stored.search_sorted(here["began"]).to_numpy()
    following = pl.Series(np.append(stored.to_numpy(), np.iinfo(np.int64).max)[before])
    none = pl.Series(np.diff(before, prepend=0) == 0) & (here["callback_id"] != callback)
    late = none & (following < here["time"])
    return here.with_columns(began=pl.when(late).then(following + 1).otherwise("began"))


def _unless_published(flow: DataFlow, state: pl.DataFrame, hop: int) -> pl.DataFrame:
    """Mark the traversals whose message no publication of the hop carried on, or did not leave."""
    instance, publication = pl.col(f"instance_{hop}"), pl.col(f"publication_{hop}")
    stuck = instance.is_not_null() & publication.is_null()
    ended = _looked_up(flow.instances, "end", f"instance_{hop}").is_not_null()
    if flow.followed.height:  # processes that were started again, as which nothing runs any more
        followed = flow.followed.filter(pl.col("pid") != pl.col("last_pid"))["pid"].unique()
        ended |= _looked_up(flow.instances, "pid", f"instance_{hop}").is_in(followed.implode())
    why = pl.when(ended).then(pl.lit("not published")).otherwise(pl.lit("still running"))
    if "gate_release" in flow.events:
        withheld = discarded_instances(flow.takes, flow.events, flow.objects, flow.instances)
        gone = pl.lit(withheld).gather(instance)
        why = pl.when(ended & gone.is_not_null()).then(pl.lit("discarded")).otherwise(why)
    state = _broken(state, stuck, hop, why)
    unsent = flow.publications["sent"].is_null()
    if not unsent.any():
        return state
    waits = pl.lit(unsent).gather(publication).fill_null(False)
    reasons = pl.lit(why_not_sent(flow.publications, flow.events, flow.objects))
    return _broken(state, waits, hop, reasons.gather(publication))


def _unless_active(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback
) -> pl.DataFrame:
    """Say so of traversals that stopped at this hop because its lifecycle node was not active: in
    the node, also where its subscription did not even exist."""
    changes = flow.objects.activity.filter(
        pl.col("pid").is_in(callback.processes), node=callback.node
    )
    stopped = pl.col("reason").is_in(_WITHOUT_EFFECT)
    stopped &= pl.col("broken_hop") == hop
    if changes.is_empty() or state.filter(stopped).is_empty():
        return state
    came = _looked_up(flow.instances, "start", f"instance_{hop}")
    if hop:
        came = pl.coalesce(came, _looked_up(flow.publications, "time", f"publication_{hop - 1}"))
    rows = state.with_row_index("row").select("row", came=came)
    found = latest_before(rows, changes.select("time", "active"), [], "came", "time")
    active = by_number(found, "row", "active", state.height).fill_null(False)
    idle = pl.lit("inactive", dtype=_REASON)
    return state.with_columns(reason=pl.when(stopped & ~active).then(idle).otherwise("reason"))


def _take(
    flow: DataFlow,
    state: pl.DataFrame,
    hop: int,
    callback: Callback,
    *,
    standby: Sequence[int],
    topic: str,
) -> pl.DataFrame:
    """Add the instance of ``callback`` that took each traversal's latest publication, or that of
    its ``standby`` which published for it."""
    taken = flow.takes.filter(pl.col("publication").is_not_null())
    own = taken.filter(pl.col("callback_id") == callback.id)
    own = own.select("publication", "take", "instance")
    # Should a message have been taken twice, the take that led to an execution is followed, of
    # several the first: what is laid out last stays.
    executed = pl.col("instance").is_not_null()
    layers = [own.filter(~executed).reverse(), own.filter(executed).reverse()]
    if standby:
        published = flow.publications.filter(pl.col("topic") == topic)["instance"].drop_nulls()
        passed_on = pl.col("instance").is_in(published.implode())
        for_it = taken.filter(pl.col("callback_id").is_in(standby)).select(own.columns)
        layers += [for_it.filter(passed_on).reverse(), own.filter(passed_on).reverse()]
    taken = pl.concat(layers)
    before, height = pl.col(f"publication_{hop - 1}"), flow.publications.height
    laid_out = {name: by_number(taken, "publication", name, height) for name in taken.columns[1:]}
    state = state.with_columns(
        pl.lit(numbers).gather(before).alias(f"{name}_{hop}") for name, numbers in laid_out.items()
    )
    latest = pl.lit(taken["publication"].max(), dtype=pl.UInt32)
    later = (before < latest).fill_null(False)  # they are numbered in order of time
    why = pl.when(later).then(pl.lit("lost")).otherwise(pl.lit("not taken"))
    if callback.id in flow.untold:
        why = pl.lit("take not recorded")
    if flow.publications["intra_time"].count():
        buffers = flow.objects.buffers
        overwritten = overwritten_in(flow.events, flow.publications, buffers, callback.id)
        gone = pl.lit(overwritten.implode())
        why = pl.when(before.is_in(gone)).then(pl.lit("overwritten")).otherwise(why)
    state = _broken(state, pl.col(f"take_{hop}").is_null(), hop, why)
    return _broken(state, pl.col(f"instance_{hop}").is_null(), hop, pl.lit("not executed"))


def _broken(state: pl.DataFrame, where: pl.Expr, hop: int, reason: pl.Expr) -> pl.DataFrame:
    """Mark the traversals that stop at ``hop``; those that stopped earlier keep their mark."""
    here, at = where & pl.col("reason").is_null(), pl.lit(hop, dtype=pl.UInt8)
    return state.with_columns(
        broken_hop=pl.when(here).then(at).otherwise("broken_hop"),
        reason=pl.when(here).then(reason.cast(_REASON)).otherwise("reason"),
    )


def _looked_up(frame: pl.DataFrame, column: str, numbers: str) -> pl.Expr:
    """``column`` of the rows of ``frame`` that the state's column ``numbers`` names."""
    return pl.lit(frame[column]).gather(pl.col(numbers))


_SUMMARY = ["traversal", "start", "end", "latency_ns", "complete", "publication"]
_SUMMARY += ["broken_hop", "broken_at", "reason"]


def _described(flow: DataFlow, chain: Chain, state: pl.DataFrame) -> pl.DataFrame:
    """The rows of numbers in order, with the columns of ``Traversals.frame``."""
    publication = f"publication_{len(chain.topics) - 1}"
    frame = state.with_columns(
        start=_looked_up(flow.instances, "start", "instance_0"),
        end=_looked_up(flow.publications, "sent", publication),
    )
    # A message that was not taken broke its chain on the topic before the hop it did not reach.
    on_the_way = pl.col("reason").is_in(_IN_NODE).not_()
    place = pl.col("broken_hop").cast(pl.Int64) - on_the_way.cast(pl.Int64)
    frame = in_order(frame, "start", "end", publication, nulls_last=True)
    return frame.with_row_index("traversal").with_columns(
        latency_ns=pl.col("end") - pl.col("start"),
        complete=pl.col("end").is_not_null(),
        publication=publication,
        broken_at=pl.lit(pl.Series(chain.topics)).gather(place),
    )


def _hop(flow: DataFlow, chain: Chain, frame: pl.DataFrame, hop: int) -> pl.DataFrame:
    instance, take = f"instance_{hop}", f"take_{hop}"
    sent = _published_at(flow, hop - 1, chain) if hop else pl.lit(None, dtype=pl.Int64)
    via = pl.when(f"sibling_{hop}").then(pl.lit("sibling")).otherwise(pl.lit("instance"))
    start = _looked_up(flow.instances, "start", instance)
    done = pl.coalesce(_looked_up(flow.instances, "end", instance), start)
    # What a thread of the node's publishes, without a callback, it may have computed meanwhile.
    publisher = _looked_up(flow.publications, "instance", f"publication_{hop}")
    began = pl.lit(flow.instances["start"]).gather(publisher)
    waiting = pl.when(f"sibling_{hop}").then((began - done).clip(lower_bound=0)).fill_null(0)
    publish = _published_at(flow, hop, chain)
    handed_over = _looked_up(flow.publications, "time", f"publication_{hop}")
    waiting += (publish - handed_over).clip(lower_bound=0).fill_null(0)
    reached = frame.filter(pl.col(instance).is_not_null()).select(
        "traversal",
        hop=pl.lit(hop, dtype=pl.UInt8),
        callback_id=_looked_up(flow.instances, "callback_id", instance),
        topic=pl.lit(chain.topics[hop], dtype=pl.Enum(list(chain.topics))),
        instance=instance,
        take=_looked_up(flow.takes, "time", take),
        start=start,
        publish=publish,
        end=_looked_up(flow.instances, "end", instance),
        source_timestamp=_looked_up(flow.takes, "source_timestamp", take),
        communication_ns=sent,
        waiting_ns=waiting,
        via=via.cast(_VIA),
    )
    published = pl.col("publish").is_not_null()
    return reached.with_columns(
        communication_ns=pl.col("start") - pl.col("communication_ns"),
        computation_ns=pl.col("publish") - pl.col("start") - pl.col("waiting_ns"),
        waiting_ns=pl.when(published).then("waiting_ns"),
        via=pl.when(published).then("via"),
    )


def _without_holds(flow: DataFlow, hops: pl.DataFrame) -> pl.DataFrame:
    """Hops in which what a gate held a message back is waiting, not computation."""
    if "gate_release" not in flow.events:
        return hops
    gated = gated_hops(flow.events, flow.objects, hops).select(
        "traversal", "hop", "arrival", "let_go"
    )
    rows = hops.join(gated, on=["traversal", "hop"], how="left", maintain_order="left")
    until = pl.min_horizontal("let_go", "publish")
    since = pl.max_horizontal("arrival", "start")
    between = pl.when(pl.col("let_go").is_not_null()).then(until - since)
    held = pl.min_horizontal(between.clip(lower_bound=0).fill_null(0), "computation_ns")
    return rows.with_columns(
        computation_ns=pl.col("computation_ns") - held, waiting_ns=pl.col("waiting_ns") + held
    ).select(hops.columns)


def _published_at(flow: DataFlow, hop: int, chain: Chain) -> pl.Expr:
    """When the hop's message left: for a ring buffer when it was put there, else with DDS."""
    time = _looked_up(flow.publications, "sent", f"publication_{hop}")
    if hop == len(chain.callbacks) - 1 or not flow.takes["intra_process"].any():
        return time
    put = _looked_up(flow.publications, "intra_time", f"publication_{hop}")
    through_buffer = _looked_up(flow.takes, "intra_process", f"take_{hop + 1}")
    return pl.when(through_buffer).then(put).otherwise(time)


def reception(flow: DataFlow, traversals: Traversals, graph: ApplicationGraph) -> pl.DataFrame:
    """When a callback of the output's subscriber started with each traversal's message.

    One row per traversal, in order: ``traversal``, ``received`` (null: never) and ``reception_ns``
    (from the traversal's start). The subscriber is the first subscription callback of the last
    topic that received anything at all.
    """
    output = traversals.chain.topics[-1]
    candidates = [callback.id for callback in graph.callbacks if callback.trigger == output]
    taken = flow.takes.filter(pl.col("callback_id").is_in(candidates))
    taken = taken.drop_nulls(["publication", "instance"])
    taken = taken.filter(pl.col("callback_id") == pl.col("callback_id").min())
    # Of several takes the first: what is laid out last stays.
    reader = by_number(taken.reverse(), "publication", "instance", flow.publications.height)
    received = flow.instances["start"].gather(reader.gather(traversals.frame["publication"]))
    return traversals.frame.select(
        "traversal", received=received, reception_ns=received - pl.col("start")
    )
