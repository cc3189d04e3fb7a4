"""Traversals of a chain: each message is followed from the first callback to the last topic.

A traversal (paper, section 2.4, figure 2) begins with the `callback_start` of an instance of the
chain's first callback, goes on from a publication to the instance whose take has the same topic and
source timestamp, and ends with the publication of the chain's last topic: the latency L.

**Which publication a message goes into.** All that the instance which read it publishes on the
hop's topic. If there are none, and other callbacks of the node publish this topic too
(synchronising callbacks, stored messages: :mod:`~chainshaper.analysis.graph`), the message goes
into the publication of the node's first instance that starts afterwards and publishes the topic.
An instance that runs already, on another thread, has got its inputs before. The exception is a set
whose inputs start at the same time: any of them may complete it. For message_filters this is the
soonest set that the message can be in. An approximate-time synchroniser may hold messages back;
then there are outputs into which no new input went, and ``notes`` says that L is a lower bound.

**The newest message counts.** A node stores messages in a variable, and a timer, or a synchroniser
written by hand, publishes from it. Of several messages stored before one publication the newest
counts as the one in it: L is the age of what was published. The others are incomplete, with the
reason "not used"; no output is missing for them. message_filters has queues instead: there each
message counts, also where several came before one publication although only one can have been in
it; ``notes`` says so.

A loop that evidently queues its messages has a publication for each: each of its turns published as
often as messages had come since the turn before, and some of them several times.

**A message's first use is the reaction.** A timer, or a loop, that is faster than its input uses a
message again. These repeats are no traversals: they are older data
(:mod:`~chainshaper.analysis.data_age`). A loop that takes messages itself, in the turn in which it
publishes, uses them at once.

**One row per data flow.** An instance that publishes a topic twice makes two traversals, with
the same start. In Python no event shows where a callback ends. Where publications are as regular as
those of a loop, whenever messages come, only the first one behind a take counts.

**A standby.** While a shaping node is not there, its standby publishes the chain's output: the
traversal goes on with the standby's instance.

**Silent instances.** An instance of the first callback that ended and published nothing on the
chain's first topic begins no traversal: callbacks may publish on a condition. Further down, where
data had arrived, an instance that publishes nothing leaves its traversal incomplete.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.graph import MESSAGE_FILTER, goes_on_elsewhere, graph_of, readers
from chainshaper.analysis.loops import seems_regular
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
    "not used": "stored for a timer, a loop or a synchroniser, which used a newer message",
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

_SILENT = ["not published", "inactive"]  # of an instance of the first callback: no traversal
_IN_NODE = [*_SILENT, "not used", "discarded", "not sent", "still running"]
_WITHOUT_EFFECT = ["not published", "lost", "not taken", "take not recorded", "not executed"]
_REASON = pl.Enum(list(REASONS))
_VIA = pl.Enum(["instance", "sibling"])


@dataclass(frozen=True)
class Traversals:
    """All traversals of one chain. Times are in ns of the event clock.

    ``frame`` has one row per traversal, sorted by start:

    * ``traversal``: numbered from 0.
    * ``start``, ``end``, ``latency_ns``: ``end`` and the latency are null when it is incomplete.
    * ``complete``.
    * ``publication``: number of the output in the data flow.
    * ``broken_hop``, ``broken_at``: place in the chain, and topic, where an incomplete one stopped.
    * ``reason``: why it is incomplete, a key of :data:`REASONS`.

    ``hops`` has one row per traversal and callback that it reached, sorted by hop:

    * ``traversal``, ``hop`` (from 0).
    * ``callback_id``: the standby's, where a standby published for its shaping node.
    * ``topic``: that the callback publishes.
    * ``instance``: its number in the data flow.
    * ``take``, ``start``, ``publish``, ``end``: instants of the instance.
    * ``source_timestamp``: of the message that it took.
    * ``publication``: number in the data flow of what the message went into (null: nothing).
    * ``communication_ns``: from the previous publication to the start.
    * ``computation_ns``: from the start to the publication, without the waiting.
    * ``waiting_ns``: within the node, of three kinds. From the end of the instance until another
      callback of the node began which published for it; in a gate, from the arrival until the
      release; for a publisher's thread, until it sent the message.
    * ``via``: ``instance`` when the instance itself published, ``sibling`` when another callback
      of its node did.

    Over a complete traversal communication, computation and waiting add up to the latency.

    ``silent`` counts the instances of the first callback that published nothing.
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
    # While traversals are followed, the `state` has a row of numbers for each. Columns per hop h:
    # `instance_h`, the `take_h` that it read, the `publication_h` that the message went into, and
    # whether a sibling published that (`sibling_h`). Columns of the whole: `broken_hop`, `reason`.
    # Numbers are rows of the data flow's frames, so times are looked up when they are needed.
    graph = graph or graph_of(flow)
    path = graph.path(chain)
    state = _begun(flow, path[0])
    silent, notes = 0, list[str]()
    for hop, (callback, topic) in enumerate(zip(path, chain.topics, strict=True)):
        standby = _standby(graph, callback, topic)
        if hop:
            state = _take(flow, state, hop, callback, standby=standby, topic=topic)
        state, repeats = _publish(flow, state, hop, [callback.id, *standby], topic)
        notes += repeats
        if topic in callback.passes_on or (hop and goes_on_elsewhere(graph, callback, topic)):
            reading = readers(graph, callback, topic)
            declared = (callback.topic, topic) in graph.through
            state, note = _publish_by_sibling(
                flow, state, hop, callback, topic, reading=reading, declared=declared
            )
            if _keeps_newest(graph, callback, topic):
                state = _newest_alone(state, hop)
            notes += note
        state = _unless_published(flow, state, hop)
        state = _unless_active(flow, state, hop, callback)
        if hop == 0:
            # An instance whose process died while it ran is not silent: it might have published.
            ended = _looked_up(flow.instances, "end", "instance_0").is_not_null()
            begun = state.filter(~(ended & pl.col("reason").is_in(_SILENT).fill_null(False)))
            silent, state = state.height - begun.height, begun
    frame = _described(flow, chain, state)
    hops = pl.concat(_hop(flow, chain, frame, hop) for hop in range(len(path)))
    hops = _without_holds(flow, hops)
    return Traversals(chain, frame.select(_SUMMARY), hops, silent, tuple(notes))


def _begun(flow: DataFlow, first: Callback) -> pl.DataFrame:
    """Begin the state: a row per instance of the first callback, with its take if it has one."""
    of_callback = pl.col("callback_id") == first.id
    taken = flow.takes.lazy().filter(of_callback & pl.col("instance").is_not_null())
    taken_in = taken.select("instance", "take").collect()
    take = by_number(taken_in, "instance", "take", flow.instances.height)
    begun = (
        flow.instances.lazy()
        .filter(of_callback)
        .select(
            instance_0="instance",
            take_0=pl.lit(take).gather("instance"),
            broken_hop=pl.lit(None, dtype=pl.UInt8),
            reason=pl.lit(None, dtype=_REASON),
        )
    )
    return begun.collect()


def _standby(graph: ApplicationGraph, callback: Callback, topic: str) -> list[int]:
    """Ids of the standby's callback, which publishes while this shaping node is not there."""
    return [
        other_callback.id
        for other_callback in graph.callbacks
        if other_callback.node == callback.node + STANDBY
        and other_callback.trigger == callback.trigger
        and topic in other_callback.publishes
    ]


def _publish(
    flow: DataFlow, state: pl.DataFrame, hop: int, callbacks: Sequence[int], topic: str
) -> tuple[pl.DataFrame, list[str]]:
    """Add the publications of the hop's topic inside each traversal's instance.

    The notes say how many were left out that only look as if they were inside it.
    """
    for_hop = pl.col("callback_id").is_in(callbacks) & (pl.col("topic") == topic)
    published = flow.publications.lazy().filter(for_hop & pl.col("instance").is_not_null())
    inside = published.select("instance", "publication", "time").collect()
    inside, repeats = _first_behind_takes(flow, inside)
    notes = list[str]()
    if repeats:
        notes.append(
            f"{repeats} messages on {topic} were published regularly, also without a new message,"
            " and no event shows where callbacks end (Python): they count as repeats of older data,"
            " not as cycles."
        )
    instance, publication = f"instance_{hop}", f"publication_{hop}"
    first = by_number(inside, "instance", "publication", flow.instances.height)
    if first.count() == inside.height:
        state = state.with_columns(first.gather(state[instance]).alias(publication))
    else:  # an instance that publishes several times begins as many traversals
        numbers = inside.select(**{instance: "instance", publication: "publication"})
        state = state.join(numbers, on=instance, how="left", maintain_order="left")
    state = state.with_columns(pl.lit(False).alias(f"sibling_{hop}"))
    return state, notes


def _first_behind_takes(flow: DataFlow, inside: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Leave out what a Python loop published again behind a take, and count it.

    No event shows where such an instance ends. That its publications are as regular as those of a
    loop, whenever messages come, shows that a loop makes them. What a callback publishes comes in
    bursts, behind each message.
    """
    endless = flow.instances["assumed"] & flow.instances["end"].is_null()
    is_first = inside["instance"].is_first_distinct()
    is_repeat = ~is_first & endless.gather(inside["instance"])
    if not is_repeat.any() or not seems_regular(inside["time"].sort().to_numpy()):
        return inside, 0
    return inside.filter(~is_repeat), int(is_repeat.sum())


def _publish_by_sibling(
    flow: DataFlow,
    state: pl.DataFrame,
    hop: int,
    callback: Callback,
    topic: str,
    *,
    reading: Sequence[Callback],
    declared: bool,
) -> tuple[pl.DataFrame, list[str]]:
    """Fill in what another callback of the node published for the message.

    It is the publication of the node's first instance that starts after the message's own; or of
    the instance of a loop in which it was taken. Messages from before the node was started again
    have none: the new process never got them. ``reading`` are timers and loops that publish what
    the callback stored, also those of other nodes; ``declared``: the user says that they do. The
    notes say where it is not clear which input an output of message_filters got.
    """
    publication, sibling = f"publication_{hop}", f"sibling_{hop}"
    publishers = flow.objects.publishers.select("publisher", created="valid_from")
    of_node = pl.col("node").is_in([callback.node, *(reader.node for reader in reading)])
    of_process = pl.col("pid").is_in(callback.processes)
    candidates = flow.publications.filter((pl.col("topic") == topic) & of_process & of_node)
    began = pl.coalesce(pl.lit(reading_instants(flow)).gather("instance"), "time")
    candidates = candidates.select(
        *("publisher", "callback_id", "instance", "tid", "time"), later="publication", began=began
    )
    candidates = candidates.join(publishers, on="publisher", how="left", maintain_order="left")
    waiting = pl.col(publication).is_null() & pl.col(f"instance_{hop}").is_not_null()
    start = _looked_up(flow.instances, "start", f"instance_{hop}")
    rows = state.with_row_index("row").filter(waiting)
    rows = rows.select("row", start=start, instance_of_row=f"instance_{hop}")
    if topic in callback.in_turns:
        candidates = _begun_with_last_input(
            candidates.sort("began"), rows["start"].sort(), callback.id
        )
    matches = first_after(rows, candidates, [], "start", "began", strictly=True)
    loops = [reader.id for reader in reading if reader.kind == "loop"]
    if loops:
        matches = pl.concat([matches, _used_in_turn(flow, rows, candidates, loops)])
        matches = matches.sort("later", descending=True, nulls_last=False)  # the first use counts
        matches = matches.drop_nulls("later").unique("row", keep="last", maintain_order=True)
        queued = _queued(matches, candidates, loops)
        matches = matches if queued is None else queued
    matches = matches.filter(pl.col("created") <= pl.col("start"))
    later = by_number(matches, "row", "later", state.height)
    state = state.with_columns(
        pl.coalesce(publication, later), (pl.col(sibling) | later.is_not_null()).alias(sibling)
    )
    stores = MESSAGE_FILTER not in (callback.symbol or MESSAGE_FILTER) or bool(loops)
    stores = stores or declared
    if callback.kind == "service" or stores:
        return state, []  # a callback that stores its latest message: old values are its purpose
    reached = state[publication].drop_nulls()
    between = candidates.filter(pl.col("later").is_between(reached.min(), reached.max())).height
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


def reading_instants(flow: DataFlow) -> pl.Series:
    """Return from when on each instance no longer sees what is stored (ns): from its start on.

    A controller manager first reads its hardware, and then what was stored.
    """
    reads = by_number(flow.turns.drop_nulls("reads"), "instance", "reads", flow.instances.height)
    return reads.fill_null(flow.instances["start"]) if reads.count() else flow.instances["start"]


def _used_in_turn(
    flow: DataFlow, rows: pl.DataFrame, candidates: pl.DataFrame, loops: Sequence[int]
) -> pl.DataFrame:
    """Match messages that a loop took itself to what it published later in the same turn.

    The result has the columns of `first_after` of the two frames.
    """
    own = candidates.filter(pl.col("callback_id").is_in(loops))
    own = own.with_columns(turn_began="began", began="time")  # later than the message, in this turn
    tid = _looked_up(flow.instances, "tid", "instance_of_row")
    by_thread = rows.with_columns(tid=tid)
    matches = first_after(by_thread, own, ["tid"], "start", "began", strictly=True)
    return matches.filter(pl.col("turn_began") <= pl.col("start")).select(
        *rows.columns, *(pl.col(name) for name in candidates.columns)
    )


def _queued(
    matches: pl.DataFrame, candidates: pl.DataFrame, loops: Sequence[int]
) -> pl.DataFrame | None:
    """Match each message to a publication of its own, where a loop evidently queues them.

    It does if each of its turns published as often as messages had come since the turn before, and
    some of them several times. None: no event shows that; then the newest message counts.
    """
    if matches.is_empty():
        return None
    first, last = matches["instance"].min(), matches["instance"].max()
    of_loops = pl.col("callback_id").is_in(loops) & pl.col("instance").is_between(first, last)
    written = candidates.filter(of_loops).sort("later")
    came = matches.group_by("instance").agg(came=pl.len())
    wrote = written.group_by("instance").agg(wrote=pl.len())
    turns = wrote.join(came, on="instance", how="left").with_columns(pl.col("came").fill_null(0))
    if (turns["came"] != turns["wrote"]).any() or turns["wrote"].max() == 1:
        return None
    place = pl.int_range(pl.len()).over("instance")
    messages = matches.sort("start", maintain_order=True)
    messages = messages.select("row", "start", "instance_of_row", "instance")
    numbered = messages.with_columns(place=place).join(
        written.with_columns(place=place), on=["instance", "place"]
    )
    return numbered.select(matches.columns)


def _keeps_newest(graph: ApplicationGraph, callback: Callback, topic: str) -> bool:
    """Return whether the node stores only the newest of the messages that the callback reads."""
    if callback.kind == "service":
        return False  # each goal of an action has feedback of its own
    is_read = bool(readers(graph, callback, topic))
    return is_read or MESSAGE_FILTER not in (callback.symbol or MESSAGE_FILTER)


def _newest_alone(state: pl.DataFrame, hop: int) -> pl.DataFrame:
    """Keep only the newest of several messages that went into one publication.

    The others are marked "not used".
    """
    instance, publication = f"instance_{hop}", f"publication_{hop}"
    newest = pl.col(instance).max().over(publication)
    older = (pl.col(publication).is_not_null() & (pl.col(instance) < newest)).fill_null(False)
    state = _broken(state, older, hop, pl.lit("not used"))
    return state.with_columns(pl.when(~older).then(publication).alias(publication))


def _begun_with_last_input(outputs: pl.DataFrame, stored: pl.Series, callback: int) -> pl.DataFrame:
    """Move ``began`` of outputs behind the start of the input that ``callback`` gave them.

    ``stored`` has the starts of the callback's instances that did not publish themselves. When the
    inputs of a set start at the same time on several threads, a lock decides which comes last. So
    where no input was stored since the output before, the output got the first one that was stored
    while its own instance ran.
    """
    stored_before = stored.search_sorted(outputs["began"]).to_numpy()
    following = pl.Series(np.append(stored.to_numpy(), np.iinfo(np.int64).max)[stored_before])
    nothing_stored = pl.Series(np.diff(stored_before, prepend=0) == 0) & (
        outputs["callback_id"] != callback
    )
    late = nothing_stored & (following < outputs["time"])
    return outputs.with_columns(began=pl.when(late).then(following + 1).otherwise("began"))


def _unless_published(flow: DataFlow, state: pl.DataFrame, hop: int) -> pl.DataFrame:
    """Mark the traversals whose message was not published at the hop, or was never sent."""
    instance, publication = pl.col(f"instance_{hop}"), pl.col(f"publication_{hop}")
    stuck = instance.is_not_null() & publication.is_null()
    ended = _looked_up(flow.instances, "end", f"instance_{hop}").is_not_null()
    if flow.followed.height:  # of a process that was started again no instance runs any more
        followed = flow.followed.filter(pl.col("pid") != pl.col("last_pid"))["pid"].unique()
        ended |= _looked_up(flow.instances, "pid", f"instance_{hop}").is_in(followed.implode())
    reason = pl.when(ended).then(pl.lit("not published")).otherwise(pl.lit("still running"))
    if "gate_release" in flow.events:
        withheld = discarded_instances(flow.takes, flow.events, flow.objects, flow.instances)
        withheld_here = pl.lit(withheld).gather(instance)
        reason = (
            pl.when(ended & withheld_here.is_not_null()).then(pl.lit("discarded")).otherwise(reason)
        )
    state = _broken(state, stuck, hop, reason)
    unsent = flow.publications["sent"].is_null()
    if not unsent.any():
        return state
    never_left = pl.lit(unsent).gather(publication).fill_null(False)
    reasons = pl.lit(why_not_sent(flow.publications, flow.events, flow.objects))
    return _broken(state, never_left, hop, reasons.gather(publication))


def _unless_active(
    flow: DataFlow, state: pl.DataFrame, hop: int, callback: Callback
) -> pl.DataFrame:
    """Mark traversals that stopped at this hop because its lifecycle node was not active.

    Also those whose message was not taken: an inactive node may not even have a subscription.
    """
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
    states = latest_before(rows, changes.select("time", "active"), [], "came", "time")
    active = by_number(states, "row", "active", state.height).fill_null(False)
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
    """Add the instance that took each traversal's latest publication.

    It is an instance of ``callback``, or of the ``standby`` that published for it.
    """
    known = flow.takes.lazy().filter(pl.col("publication").is_not_null())
    columns = ["publication", "take", "instance"]
    by_callback = known.filter(pl.col("callback_id") == callback.id).select(columns).collect()
    # If a message was taken twice, the first take that led to an execution is followed. Of several
    # rows with one number `by_number` takes the last, so the best ones come last.
    executed = pl.col("instance").is_not_null()
    layers = [by_callback.filter(~executed).reverse(), by_callback.filter(executed).reverse()]
    if standby:
        published = flow.publications.filter(pl.col("topic") == topic)["instance"].drop_nulls()
        passed_on = pl.col("instance").is_in(published.implode())
        by_standby = known.filter(pl.col("callback_id").is_in(standby)).select(columns).collect()
        layers += [by_standby.filter(passed_on).reverse(), by_callback.filter(passed_on).reverse()]
    taken = pl.concat(layers)
    before, height = pl.col(f"publication_{hop - 1}"), flow.publications.height
    laid_out = {name: by_number(taken, "publication", name, height) for name in taken.columns[1:]}
    state = state.with_columns(
        pl.lit(numbers).gather(before).alias(f"{name}_{hop}") for name, numbers in laid_out.items()
    )
    last_taken = pl.lit(taken["publication"].max(), dtype=pl.UInt32)
    later = (before < last_taken).fill_null(False)  # they are numbered in order of time
    reason = pl.when(later).then(pl.lit("lost")).otherwise(pl.lit("not taken"))
    if callback.id in flow.without_takes:
        reason = pl.lit("take not recorded")
    if flow.publications["intra_time"].count():
        buffers = flow.objects.buffers
        overwritten = overwritten_in(flow.events, flow.publications, buffers, callback.id)
        lost_in_buffer = pl.lit(overwritten.implode())
        reason = pl.when(before.is_in(lost_in_buffer)).then(pl.lit("overwritten")).otherwise(reason)
    state = _broken(state, pl.col(f"take_{hop}").is_null(), hop, reason)
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
    """Sort the state by start and add the columns of ``Traversals.frame``."""
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
    """Make the rows of ``Traversals.hops`` for one place in the chain."""
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
    reached = (
        frame.lazy()
        .filter(pl.col(instance).is_not_null())
        .select(
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
            publication=f"publication_{hop}",
            communication_ns=sent,
            waiting_ns=waiting,
            via=via.cast(_VIA),
        )
    )
    published = pl.col("publish").is_not_null()
    with_parts = reached.with_columns(
        communication_ns=pl.col("start") - pl.col("communication_ns"),
        computation_ns=pl.col("publish") - pl.col("start") - pl.col("waiting_ns"),
        waiting_ns=pl.when(published).then("waiting_ns"),
        via=pl.when(published).then("via"),
    )
    return with_parts.collect()


def _without_holds(flow: DataFlow, hops: pl.DataFrame) -> pl.DataFrame:
    """Move the time for which a gate held a message back from computation to waiting."""
    if "gate_release" not in flow.events:
        return hops
    gated = gated_hops(flow.events, flow.objects, hops).select(
        "traversal", "hop", "arrival", "let_go"
    )
    rows = hops.join(gated, on=["traversal", "hop"], how="left", maintain_order="left")
    until = pl.min_horizontal("let_go", "publish")
    since = pl.max_horizontal("arrival", "start")
    between = pl.when(pl.col("let_go").is_not_null()).then(until - since)
    hold = pl.min_horizontal(between.clip(lower_bound=0).fill_null(0), "computation_ns")
    return rows.with_columns(
        computation_ns=pl.col("computation_ns") - hold, waiting_ns=pl.col("waiting_ns") + hold
    ).select(hops.columns)


def _published_at(flow: DataFlow, hop: int, chain: Chain) -> pl.Expr:
    """When the hop's message left: when it was put into a ring buffer, else when DDS sent it."""
    time = _looked_up(flow.publications, "sent", f"publication_{hop}")
    if hop == len(chain.callbacks) - 1 or not flow.takes["intra_process"].any():
        return time
    put = _looked_up(flow.publications, "intra_time", f"publication_{hop}")
    through_buffer = _looked_up(flow.takes, "intra_process", f"take_{hop + 1}")
    return pl.when(through_buffer).then(put).otherwise(time)


def reception(flow: DataFlow, traversals: Traversals, graph: ApplicationGraph) -> pl.DataFrame:
    """Make a frame of when a subscriber's callback started with each traversal's output.

    One row per traversal, in order: ``traversal``; ``received`` (ns, null: never); ``received_by``,
    the process; ``reception_ns`` (since the traversal's start). The subscriber is the first
    subscription callback of the last topic that received a message at all.
    """
    output = traversals.chain.topics[-1]
    candidates = [callback.id for callback in graph.callbacks if callback.trigger == output]
    known = flow.takes.lazy().filter(pl.col("callback_id").is_in(candidates))
    known = known.select("callback_id", "publication", "instance").drop_nulls()
    taken = known.collect().filter(pl.col("callback_id") == pl.col("callback_id").min())
    # Of several takes the first counts. `by_number` takes the last row, so they are reversed.
    reader = by_number(taken.reverse(), "publication", "instance", flow.publications.height)
    instance = reader.gather(traversals.frame["publication"])
    received = flow.instances["start"].gather(instance)
    return traversals.frame.select(
        "traversal",
        received=received,
        received_by=flow.instances["pid"].gather(instance),
        reception_ns=received - pl.col("start"),
    )
