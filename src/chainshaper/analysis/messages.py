"""Messages: who published them when, who took them, and which take belongs to which publication.

A message is identified by its topic and its DDS source timestamp (paper, section 2.4). Versions
of ROS 2 show different halves of that:

* from Jazzy on `rmw_publish` carries the publisher's handle and the source timestamp, and
  `rmw_take` the same timestamp: the match is exact;
* before Jazzy `rmw_publish` has neither. Its publisher is that of the `rcl_publish` with the same
  message just before it on the same thread; a take is linked to the latest publication on its
  topic at or before its source timestamp;
* CARET (Galactic) has neither `rmw_publish` nor `rmw_take`: `dds_write` is the publication,
  `dds_bind_addr_to_stamp` right after it on the same thread gives the source timestamp, and
  `dispatch_subscription_callback` is the take;
* intra-process messages have no timestamp at all: the publication is the `rclcpp_intra_publish`
  before a ring buffer's enqueue on the same thread, the take is the dequeue of the same place in
  the same buffer.

Publications and takes under handles that were never initialised are left out
(:mod:`~chainshaper.analysis.objects`).
"""

import polars as pl

from chainshaper.analysis.matching import by_number, first_after, grows, in_order, latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.values import events

__all__ = ["link_takes", "overwritten_in", "publications", "takes"]

_PUBLISHER = ["publisher", "node", "topic"]


def publications(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """All publications of known publishers, sorted by time.

    Columns: ``publication`` (numbered from 0), ``time`` (of `rmw_publish`, the write to DDS; of
    the `rclcpp_intra_publish` when there was no such write), ``pid``, ``tid``, ``publisher``,
    ``node``, ``topic``, ``source_timestamp`` (CLOCK_REALTIME, null if unknown) and ``intra_time``
    (when it was handed to ring buffers of the same process, null if it was not).
    """
    written = _written(tables, objects)
    handed = _handed_over(tables, objects)
    if not handed.height:
        written = written.with_columns(intra_time=pl.lit(None, dtype=pl.Int64))
        return in_order(written, "time", "pid", "tid").with_row_index("publication")
    # One publish() may do both, ring buffers first: the next write by the same publisher on the
    # same thread is the same message.
    both = latest_before(
        written.with_row_index("row"), handed, ["pid", "tid", "publisher"], "time", "intra_time"
    )
    first = both.drop_nulls("handed").group_by("handed").agg(pl.col("row").min())
    both = both.join(first, on=["handed", "row"], how="left", maintain_order="left")
    merged = both.join(first.select("row", is_first=pl.lit(True)), on="row", how="left")
    merged = merged.with_columns(pl.when("is_first").then("intra_time").alias("intra_time"))
    alone = handed.join(first, on="handed", how="anti")
    columns = ["time", "pid", "tid", *_PUBLISHER, "source_timestamp", "intra_time"]
    alone = alone.with_columns(
        time=pl.col("intra_time"), source_timestamp=pl.lit(None, dtype=pl.Int64)
    )
    every = pl.concat([merged.select(columns), alone.select(columns)])
    return in_order(every, "time", "pid", "tid").with_row_index("publication")


def _written(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Messages given to DDS: ``time, pid, tid, publisher, node, topic, source_timestamp``."""
    writes = _writes(tables)
    by_rmw = objects.publishers.select(
        "pid", *_PUBLISHER, rmw_publisher_handle="rmw_handle", created="valid_from"
    )
    by_rcl = objects.publishers.select(
        "pid", *_PUBLISHER, publisher_handle="handle", created="valid_from"
    )
    named = writes.filter(pl.col("rmw_publisher_handle").is_not_null())
    nameless = writes.filter(pl.col("rmw_publisher_handle").is_null())
    found = [latest_before(named, by_rmw, ["pid", "rmw_publisher_handle"], "time", "created")]
    if nameless.height:
        nameless = _with_rcl_publisher(tables, nameless)
        found.append(
            latest_before(nameless, by_rcl, ["pid", "publisher_handle"], "time", "created")
        )
    columns = ["time", "pid", "tid", *_PUBLISHER, "source_timestamp"]
    every = pl.concat([frame.select(columns) for frame in found])
    return every.drop_nulls("publisher") if every["publisher"].null_count() else every


def _writes(tables: events.EventTables) -> pl.DataFrame:
    """The event that stands for writing to DDS in this recording, with what it says."""
    no_handle = pl.lit(None, dtype=pl.UInt64).alias("rmw_publisher_handle")
    for name in ("rmw_publish", "dds_write", "rcl_publish"):
        writes = events.table(tables, name)
        if writes.height:
            break
    if name == "rmw_publish":
        writes = events.table(tables, name, ["rmw_publisher_handle", "timestamp"])
        stamp = pl.when(pl.col("timestamp") > 0).then("timestamp")  # 0: not supported by the RMW
        writes = writes.with_columns(stamp.alias("source_timestamp"))
    else:
        unknown = pl.lit(None, dtype=pl.Int64).alias("source_timestamp")
        writes = writes.with_columns(unknown, no_handle)
    bound = events.table(tables, "dds_bind_addr_to_stamp")
    if bound.height:
        bound = bound.select("pid", "tid", "source_stamp", message="addr", bound="time")
        writes = first_after(writes, bound, ["pid", "tid", "message"], "time", "bound")
        # A later write of the same address has a better claim to the stamp after it.
        mine = pl.col("bound") == pl.col("bound").shift(-1).over("pid", "tid", "message")
        stamp = pl.when(~mine.fill_null(False)).then("source_stamp")
        writes = writes.with_columns(pl.coalesce("source_timestamp", stamp))
    return writes.select(
        "time", "pid", "tid", "message", "rmw_publisher_handle", "source_timestamp"
    )


def _with_rcl_publisher(tables: events.EventTables, writes: pl.DataFrame) -> pl.DataFrame:
    """Add ``publisher_handle`` of the `rcl_publish` of the same message just before each write.

    Addresses of messages repeat, so a `rcl_publish` counts for the first write after it only.
    """
    published = (
        events.table(tables, "rcl_publish")
        .select("pid", "tid", "message", "publisher_handle", published="time")
        .with_row_index("rcl")
    )
    found = latest_before(writes, published, ["pid", "tid", "message"], "time", "published")
    again = pl.col("rcl") == pl.col("rcl").shift(1).over("pid", "tid", "message")
    own = ~again.fill_null(False)
    return found.with_columns(pl.when(own).then("publisher_handle").alias("publisher_handle"))


def _handed_over(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Messages given to ring buffers: ``handed, intra_time, pid, tid, publisher, node, topic``."""
    by_rcl = objects.publishers.select(
        "pid", *_PUBLISHER, publisher_handle="handle", created="valid_from"
    )
    handed = events.table(tables, "rclcpp_intra_publish").select(
        "pid", "tid", "publisher_handle", intra_time="time"
    )
    found = latest_before(handed, by_rcl, ["pid", "publisher_handle"], "intra_time", "created")
    found = found.drop_nulls("publisher").with_row_index("handed")
    return found.select("handed", "intra_time", "pid", "tid", *_PUBLISHER)


def takes(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """All messages taken by known subscriptions, sorted by time.

    Columns: ``take`` (numbered from 0), ``time``, ``pid``, ``tid``, ``callback_id`` (null if the
    subscription has no callback), ``node``, ``topic``, ``source_timestamp``, ``intra_process``,
    and for those the ``buffer`` and ``index`` the message lay in. A take that found nothing
    (``taken`` = 0) carries no message and is left out.
    """
    owner = objects.callbacks.drop_nulls("subscription").select("subscription", "callback_id")
    owner = owner.unique("subscription", maintain_order=True)
    subscriptions = objects.subscriptions.join(owner, on="subscription", how="left").select(
        "pid", "callback_id", "node", "topic", "rmw_handle", created="valid_from"
    )
    taken = events.table(tables, "rmw_take", ["taken"])
    if (taken["taken"] == 0).any():
        taken = taken.filter(pl.col("taken").fill_null(1) != 0)
    from_dds = latest_before(
        taken.rename({"rmw_subscription_handle": "rmw_handle"}),
        subscriptions,
        ["pid", "rmw_handle"],
        "time",
        "created",
    )
    parts = [from_dds.drop_nulls("topic") if from_dds["topic"].null_count() else from_dds]
    if taken.is_empty():
        parts.append(_dispatched(tables, objects))
    parts.append(_dequeued(tables, objects))
    parts = [part for part in parts if part.height] or parts[:1]
    every = pl.concat(
        [
            part.select(
                "time",
                "pid",
                "tid",
                "callback_id",
                "node",
                "topic",
                pl.when(pl.col("source_timestamp") > 0).then("source_timestamp"),
                *(
                    pl.col(name) if name in part.columns else pl.lit(None, pl.UInt64).alias(name)
                    for name in ("buffer", "index")
                ),
            )
            for part in parts
        ]
    )
    every = in_order(every, "time", "pid", "tid").with_row_index("take")
    return every.with_columns(pl.col("buffer").is_not_null().alias("intra_process"))


def _dispatched(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    owners = _with_enums(objects.callbacks, objects).select(
        "pid", "callback_id", "node", "topic", callback="handle", created="valid_from"
    )
    dispatched = events.table(tables, "dispatch_subscription_callback").rename(
        {"source_stamp": "source_timestamp"}
    )
    found = latest_before(dispatched, owners, ["pid", "callback"], "time", "created")
    return found.drop_nulls("topic")


def _with_enums(callbacks: pl.DataFrame, objects: Objects) -> pl.DataFrame:
    types = objects.subscriptions.schema
    return callbacks.with_columns(pl.col(name).cast(types[name]) for name in ("node", "topic"))


def _dequeued(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    owner = objects.callbacks.unique("callback_id", maintain_order=True)
    owner = _with_enums(owner, objects).select("callback_id", "node", "topic")
    buffers = objects.buffers.rename({"valid_from": "created"})
    dequeued = events.table(tables, "rclcpp_ring_buffer_dequeue")
    found = latest_before(dequeued, buffers, ["pid", "buffer"], "time", "created")
    found = found.drop_nulls("callback_id").join(
        owner, on="callback_id", how="left", maintain_order="left"
    )
    return found.with_columns(source_timestamp=pl.lit(None, dtype=pl.Int64))


def link_takes(
    tables: events.EventTables, taken: pl.DataFrame, published: pl.DataFrame, clock_offset_ns: int
) -> pl.DataFrame:
    """``taken`` with a column ``publication``: which publication each take read (null: unknown).

    ``clock_offset_ns`` is what to add to event times for CLOCK_REALTIME, the clock of source
    timestamps; it is used only where publications carry no source timestamp.
    """
    found = _with_same_stamp(taken, published)
    linked = taken.with_columns(by_number(found, "take", "publication", taken.height))
    stampless = published.filter(
        pl.col("source_timestamp").is_null()
        & (pl.col("intra_time").is_null() | (pl.col("time") > pl.col("intra_time")))
    ).select("topic", guess="publication", published="time")
    if stampless.height:
        rows = linked.with_columns(sent=pl.col("source_timestamp") - clock_offset_ns)
        rows = latest_before(rows, stampless, ["topic"], "sent", "published")
        # A subscription gets a message once: a second take of it read one whose events were lost.
        again = pl.col("guess") == pl.col("guess").shift(1).over("pid", "node", "callback_id")
        guess = pl.when(~again.fill_null(False)).then("guess")
        linked = rows.with_columns(pl.coalesce("publication", guess)).sort("take")
        linked = linked.select([*taken.columns, "publication"])
    return _link_through_buffers(tables, linked, published)


def _with_same_stamp(taken: pl.DataFrame, published: pl.DataFrame) -> pl.DataFrame:
    """``take, publication`` that agree in topic and source timestamp.

    An asof join that insists on equality: unlike a hash join it stays linear in time and memory
    whatever the stamps are. Should two publications of a topic share one, the first is taken.
    """
    stamp = "source_timestamp"
    wanted = taken.select("topic", stamp, "take")
    if wanted[stamp].null_count():
        wanted = wanted.drop_nulls(stamp)
    stamped = published.select("topic", "publication", stamped=stamp)
    if stamped["stamped"].null_count():
        stamped = stamped.drop_nulls("stamped")
    if not grows(stamped["stamped"]):  # among equals the first comes last
        stamped = stamped.reverse().sort("stamped", maintain_order=True)
    found = latest_before(wanted, stamped, ["topic"], stamp, "stamped")
    return found.filter(pl.col(stamp) == pl.col("stamped")).select("take", "publication")


def _link_through_buffers(
    tables: events.EventTables, taken: pl.DataFrame, published: pl.DataFrame
) -> pl.DataFrame:
    if not taken["intra_process"].any():
        return taken
    stored = _enqueued(tables, published)
    found = latest_before(taken, stored, ["pid", "buffer", "index"], "time", "enqueued")
    return (
        found.with_columns(pl.coalesce("publication", "stored")).sort("take").select(taken.columns)
    )


def _enqueued(tables: events.EventTables, published: pl.DataFrame) -> pl.DataFrame:
    """Every enqueue into a ring buffer: ``pid, buffer, index, enqueued, stored, overwrites``.

    ``stored`` is the publication that was put there, ``overwrites`` whether the buffer was full,
    so that its oldest message, which lay in this place, was lost.
    """
    handed = published.drop_nulls("intra_time").select(
        "pid", "tid", "intra_time", stored="publication"
    )
    put = events.table(tables, "rclcpp_ring_buffer_enqueue", ["overwritten"]).select(
        "pid", "tid", "buffer", "index", "overwritten", enqueued="time"
    )
    found = latest_before(put, handed, ["pid", "tid"], "enqueued", "intra_time")
    return found.select(
        "pid",
        "buffer",
        "index",
        "enqueued",
        "stored",
        pl.col("overwritten").fill_null(0).ne(0).alias("overwrites"),
    )


def overwritten_in(
    tables: events.EventTables, published: pl.DataFrame, buffers: pl.DataFrame, callback_id: int
) -> pl.Series:
    """Publications that were overwritten in the ring buffers of one subscription's callback."""
    stored = latest_before(
        _enqueued(tables, published),
        buffers.rename({"valid_from": "created"}),
        ["pid", "buffer"],
        "enqueued",
        "created",
    ).filter(pl.col("callback_id") == callback_id)
    next_overwrites = pl.col("overwrites").shift(-1).over("pid", "buffer", "index")
    return stored.filter(next_overwrites.fill_null(False))["stored"].drop_nulls()
