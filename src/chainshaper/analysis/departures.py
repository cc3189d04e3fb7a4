"""When messages really left, and which were withheld on purpose.

Publishing and leaving are two things where a thread of its own sends for the executor: the
`rmw_publish` of an asynchronous publisher is recorded, and the source timestamp taken, when the
message is handed over. `asynchronous_send` says when, and whether, it was sent; sources that
cannot know this lack the table, and then what the output's subscriber saw has to be looked at.

A shaping node may discard a message that overran its slot (`gate_release` without a release).
Which decision was about which message of a chain stands here, once: see :func:`gated_hops`.
"""

import polars as pl

from chainshaper.analysis.matching import by_number
from chainshaper.analysis.objects import Objects
from chainshaper.values import events

__all__ = [
    "discarded_instances",
    "gate_decisions",
    "gated_hops",
    "why_not_sent",
    "with_departures",
    "with_overrun",
]


def with_departures(
    published: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.DataFrame:
    """``published`` with a column ``sent``: when each message left (null: it never did)."""
    created = events.table(tables, "rcl_publisher_init", ["asynchronous"])
    created = created.filter(pl.col("asynchronous").fill_null(0) != 0)
    if not created.height:
        return published.with_columns(sent=pl.col("time"))
    asynchronous = objects.publishers.join(
        created.select("pid", rmw_handle="rmw_publisher_handle"), on=["pid", "rmw_handle"]
    )
    ours = published["publisher"].is_in(asynchronous["publisher"].implode())
    sends = _sends(published, tables, objects)
    left = by_number(
        sends.filter(pl.col("outcome") == "sent"), "publication", "time", published.height
    )
    return published.with_columns(sent=pl.when(ours).then(left).otherwise("time"))


def why_not_sent(
    published: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.Series:
    """Per publication the reason why it was not sent; only of use for those without ``sent``."""
    sends = _sends(published, tables, objects).with_columns(reason=pl.lit("discarded"))
    return by_number(sends, "publication", "reason", published.height).fill_null("not sent")


def _sends(published: pl.DataFrame, tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """``publication, publisher, time, outcome`` of what publisher threads dealt with."""
    table = events.table(tables, "asynchronous_send")
    publishers = objects.publishers.select("pid", "publisher", rmw_publisher_handle="rmw_handle")
    return (
        table.join(publishers, on=["pid", "rmw_publisher_handle"], how="inner")
        .select("publisher", "time", "outcome", source_timestamp="timestamp")
        .join(
            published.select("publication", "publisher", "source_timestamp"),
            on=["publisher", "source_timestamp"],
            how="inner",
        )
    )


def discarded_instances(
    taken: pl.DataFrame, tables: events.EventTables, objects: Objects, instances: int
) -> pl.Series:
    """Per callback instance whether it was a gate's that discarded its message (else null)."""
    discarded = (
        gate_decisions(tables, objects)
        .filter(pl.col("release").is_null())
        .select("callback_id", "source_timestamp", discarded=pl.lit(True))
    )
    found = taken.select("callback_id", "source_timestamp", "instance").join(
        discarded, on=["callback_id", "source_timestamp"], how="inner"
    )
    return by_number(found.drop_nulls("instance"), "instance", "discarded", instances)


def gate_decisions(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """The table `gate_release` with the ``callback_id`` of each gate.

    A shaping node in ROS 2 does not know its callback's handle. A decision of its is there once for
    each subscription of its process; which one took the message, the source timestamp tells.
    """
    decisions = events.table(tables, "gate_release", ["mode"])
    callbacks = objects.callbacks.select("pid", "callback_id", "kind", callback="handle")
    handles = callbacks.drop("kind").unique()
    known = decisions.join(handles, on=["pid", "callback"], how="inner", maintain_order="left")
    nameless = decisions.join(handles, on=["pid", "callback"], how="anti", maintain_order="left")
    if not nameless.height:
        return known
    listening = callbacks.filter(pl.col("kind") == "subscription").select("pid", "callback_id")
    unknown = nameless.join(listening.unique(), on="pid", how="inner", maintain_order="left")
    return pl.concat([known, unknown.select(known.columns)])


def with_overrun(decisions: pl.DataFrame, due_cycles: int = 0) -> pl.DataFrame:
    """Decisions with the column ``overrun``, which older recordings lack.

    Without it a message overran when it left in a later cycle than ``due_cycles`` after its own.
    """
    if "overrun" in decisions.columns:
        return decisions
    late = pl.col("cycles_waited") > due_cycles
    return decisions.with_columns(overrun=pl.when(late).then(pl.lit("wait")))


_DECIDED = ("arrival", "origin", "release", "slot", "cycles_waited", "anchor", "overrun", "mode")


def gated_hops(
    tables: events.EventTables, objects: Objects, hops: pl.DataFrame, due_cycles: int = 0
) -> pl.DataFrame:
    """What gates decided about the messages of a chain: one row per hop whose callback is a gate.

    ``traversal, hop, arrival, origin, release, let_go, slot, cycles_waited, anchor, overrun, mode``
    of `gate_release`, sorted; ``let_go`` is when it really did. A decision is found by the gate's
    callback and the message's source timestamp. Several messages may have the same (writers
    stamp in microseconds, a simulated clock stands still): then the decision is meant whose
    ``arrival`` is nearest to the start of the callback.
    """
    decided = with_overrun(gate_decisions(tables, objects), due_cycles).select(
        "callback_id", "source_timestamp", *_DECIDED, let_go="time"
    )
    keys = ["callback_id", "source_timestamp"]
    reached = hops.select("traversal", "hop", "start", *keys).drop_nulls(keys)
    found = reached.join(decided, on=keys, how="inner")
    apart = (pl.col("arrival") - pl.col("start")).abs()
    nearest = found.sort("traversal", "hop", apart, maintain_order=True)
    columns = ("traversal", "hop", *_DECIDED[:3], "let_go", *_DECIDED[3:])
    return nearest.unique(["traversal", "hop"], keep="first", maintain_order=True).select(columns)
