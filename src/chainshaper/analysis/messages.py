"""Messages: who published them when, who took them, and which take belongs to which publication.

A message is identified by its topic and its DDS source timestamp (paper, section 2.4). Versions
of ROS 2 have different events of that:

* from Jazzy on `rmw_publish` carries the publisher's handle and the source timestamp, and
  `rmw_take` the same timestamp: the match is exact;
* before Jazzy `rmw_publish` has neither. Its publisher is that of the `rcl_publish` with the same
  message just before it on the same thread; a take is linked to the latest publication on its
  topic at or before its source timestamp, as the clocks were then
  (:mod:`~chainshaper.analysis.wall_clock`);
* CARET (Galactic) has neither `rmw_publish` nor `rmw_take`: `dds_write` is the publication,
  `dds_bind_addr_to_stamp` right after it on the same thread gives the source timestamp, and
  `dispatch_subscription_callback` is the take;
* intra-process messages have no timestamp at all: the publication is the `rclcpp_intra_publish`
  before a ring buffer's enqueue on the same thread, the take is the dequeue of the same place in
  the same buffer;
* CARET (Galactic, Humble) has no events of ring buffers: the take is its dispatch of the message's
  address, or of a copy's, to the callback.

Requests and responses of services are messages, too: a client publishes ``SERVICE:request``, which
the server takes, and takes ``SERVICE:response``. Instead of a source timestamp they have the number
of their call (:func:`service_calls`).

An asynchronous publisher hands its messages to a thread that sends them. `rmw_publish` is recorded
when the message is handed over; `asynchronous_send` says when, and whether, the thread sent it.
"""

from collections.abc import Mapping

import polars as pl

from chainshaper.analysis.matching import by_number, first_after, grows, in_order, latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.analysis.wall_clock import StampedMessages, messages_of_stamps
from chainshaper.values import events
from chainshaper.values.application import REQUEST

_PUBLISHER = ["publisher", "node", "topic"]
_END: list[str | pl.Expr] = [
    "pid",
    "rmw_handle",
    pl.col("valid_from").alias("created"),
]  # of an endpoint, as a key
_NO_TIME = pl.lit(None, dtype=pl.Int64)
_NO_CALL = pl.lit(None, dtype=pl.Int64)

_CALLS = {"rmw_send_request": "client", "rmw_take_request": "service"}
_CALLS |= {"rmw_send_response": "service", "rmw_take_response": "client"}
_DISPATCHES = ("dispatch_intra_process_subscription_callback", "dispatch_intra_process")
_COPIES = 3  # at most: a message is copied on its way to a callback of its process
_CALL_BITS = 40  # of the number of a call: the client stands above, which of its calls below
_GID = 16  # bytes that mean anything
_CLOCKS_AGREE = 2_000
"""How far apart (ns) the clocks of events and stamps may be. No writer publishes twice so fast."""
_HELD_UP = 1_000_000
"""The longest time (ns) that is likely between a publication's event and its source timestamp."""


def service_calls(
    tables: events.EventTables, objects: Objects, clock_offset_ns: int
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return two frames of requests and responses: those that were sent, and those taken.

    Columns: ``time`` (ns), ``pid``, ``tid``, ``rmw_handle``, and ``call``, a number that identifies
    the call in the recording: which client, and which of its calls. Servers know clients by gid.
    """
    columns = ["time", "pid", "tid", "rmw_handle"]
    if not any(events.table(tables, name).height for name in _CALLS):
        no_calls = events.table(tables, "rmw_send_request").rename(
            {"rmw_client_handle": "rmw_handle"}
        )
        no_calls = no_calls.select(*columns, call="sequence_number")
        return no_calls, no_calls
    of_event = {}
    for name, role in _CALLS.items():
        rows = events.table(tables, name, ["taken", "source_timestamp"] if "take" in name else [])
        if "taken" in rows.columns:
            rows = rows.filter(pl.col("taken").fill_null(1) != 0)
        of_event[name] = rows.rename({f"rmw_{role}_handle": "rmw_handle"})
    requests = objects.publishers.filter(pl.col("topic").cast(pl.String).str.ends_with(REQUEST))
    clients = requests.select(*_END, "topic", client="publisher")
    for name in ("rmw_send_request", "rmw_take_response"):
        of_event[name] = latest_before(
            of_event[name], clients, ["pid", "rmw_handle"], "time", "created"
        )
    owners = _gid_owners(tables, objects, of_event, clients, clock_offset_ns)
    for name in ("rmw_take_request", "rmw_send_response"):
        rows = of_event[name].with_columns(gid=_gid_text("client_gid"))
        of_event[name] = rows.join(owners, on="gid", how="left", maintain_order="left")
    number = pl.col("client").cast(pl.Int64) * (1 << _CALL_BITS) + pl.col("sequence_number")
    calls = {name: rows.select(*columns, call=number) for name, rows in of_event.items()}
    sent, taken = ([calls[name] for name in _CALLS if way in name] for way in ("send", "take"))
    return pl.concat(sent), pl.concat(taken)


def _gid_owners(
    tables: events.EventTables,
    objects: Objects,
    of_event: Mapping[str, pl.DataFrame],
    clients: pl.DataFrame,
    clock_offset_ns: int,
) -> pl.DataFrame:
    """Make a frame of which ``client`` has which ``gid``.

    `rmw_client_init` says so. Without it, each request that a server took votes: for the client
    that sent the latest request with the same number to this service before the source timestamp.
    The client with most votes has the gid.
    """
    key = ["pid", "rmw_handle"]
    created = events.table(tables, "rmw_client_init").rename({"rmw_client_handle": "rmw_handle"})
    created = first_after(created, clients, key, "time", "created")
    servers = objects.subscriptions.select(*_END, "topic")
    came = latest_before(of_event["rmw_take_request"], servers, key, "time", "created")
    at = pl.min_horizontal(pl.col("source_timestamp") - clock_offset_ns, "time")
    came = came.with_columns(at=at)  # at the latest when it was taken, if the wall clock was set
    sent = of_event["rmw_send_request"].select("topic", "sequence_number", "client", sent="time")
    came = latest_before(came, sent, ["topic", "sequence_number"], "at", "sent")
    votes = came.group_by("client", "client_gid").len().sort("len", descending=True)
    by_init = created.select("client", gid=_gid_text("gid"))
    owners = pl.concat([by_init, votes.select("client", gid=_gid_text("client_gid"))])
    return owners.drop_nulls().unique("gid", keep="first", maintain_order=True)


def _gid_text(column: str) -> pl.Expr:
    """Return a gid as text, so that frames can be joined by it."""
    return pl.col(column).list.head(_GID).cast(pl.List(pl.String)).list.join(".")


def publications(tables: events.EventTables, objects: Objects, calls: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of all publications of known publishers, sorted by time. Columns:

    * ``publication``: numbered from 0.
    * ``time``: of `rmw_publish`, the write to DDS; without one, of `rclcpp_intra_publish` (ns).
    * ``pid``, ``tid``, ``publisher``, ``node``, ``topic``.
    * ``source_timestamp``: ns of CLOCK_REALTIME; null if unknown.
    * ``call``: of a request or response, null for messages; absent where no service was called.
    * ``intra_time``: when it was handed to ring buffers of the same process (ns); null if never.
    """
    written = _written(tables, objects, calls)
    handed = _handed_over(tables, objects)
    all_publications = written.with_columns(intra_time=_NO_TIME)
    if handed.height:
        # One publish() may do both, ring buffers first: the next write by the same publisher on
        # the same thread is the same message.
        both = latest_before(written, handed, ["pid", "tid", "publisher"], "time", "intra_time")
        first_write = pl.col("handed").is_first_distinct() & pl.col("handed").is_not_null()
        both = both.with_columns(pl.when(first_write).then("intra_time"))
        alone = handed.join(both.drop_nulls("intra_time"), on="handed", how="anti")
        alone = alone.with_columns(time="intra_time", source_timestamp=_NO_TIME, call=_NO_CALL)
        all_publications = pl.concat(
            [part.select(all_publications.columns) for part in (both, alone)]
        )
    return in_order(all_publications, "time", "pid", "tid").with_row_index("publication")


def _written(tables: events.EventTables, objects: Objects, calls: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the messages given to DDS, with the columns of :func:`publications`.

    Without ``publication`` and ``intra_time``; with ``call`` only where services were called.
    """
    writes = _writes(tables)
    if calls.height:
        writes = pl.concat([writes, calls], how="diagonal")
    by_rmw = objects.publishers.select(*_END, *_PUBLISHER)
    nameless = pl.col("rmw_handle").is_null()
    known = writes.filter(~nameless)
    parts = [latest_before(known, by_rmw, ["pid", "rmw_handle"], "time", "created")]
    if known.height < writes.height:
        # The publisher is that of the rcl_publish of the same message just before. Addresses of
        # messages repeat, so a rcl_publish counts for the first write after it only.
        message = ["pid", "tid", "message"]
        published = events.table(tables, "rcl_publish").with_row_index("rcl")
        published = published.select(*message, "rcl", "publisher_handle", published="time")
        rows = latest_before(writes.filter(nameless), published, message, "time", "published")
        again = pl.col("rcl") == pl.col("rcl").shift(1).over(message)
        rows = rows.with_columns(pl.when(~again.fill_null(False)).then("publisher_handle"))
        parts.append(_by_rcl_handle(rows, objects, "time"))
    columns = ["time", "pid", "tid", *_PUBLISHER, "source_timestamp"]
    if calls.height:
        columns.append("call")
    all_writes = pl.concat([frame.select(columns) for frame in parts])
    return (
        all_writes.drop_nulls("publisher") if all_writes["publisher"].null_count() else all_writes
    )


def _by_rcl_handle(rows: pl.DataFrame, objects: Objects, time: str) -> pl.DataFrame:
    """Add the publisher that had the row's ``publisher_handle`` at the instant ``time``."""
    publishers = objects.publishers.select(
        "pid", *_PUBLISHER, publisher_handle="handle", created="valid_from"
    )
    return latest_before(rows, publishers, ["pid", "publisher_handle"], time, "created")


def _writes(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of the event that stands for writing to DDS in this recording.

    Columns: ``time, pid, tid, message, rmw_handle, source_timestamp``; nulls where it has none.
    """
    names = ("rmw_publish", "dds_write", "rcl_publish")
    name = next((name for name in names if events.table(tables, name).height), names[-1])
    if name == "rmw_publish":
        writes = events.table(tables, name, ["rmw_publisher_handle", "timestamp"])
        stamp = pl.when(pl.col("timestamp") > 0).then("timestamp")  # 0: not supported by the RMW
        writes = writes.with_columns(source_timestamp=stamp, rmw_handle="rmw_publisher_handle")
    else:
        nowhere = pl.lit(None, dtype=pl.UInt64)
        writes = events.table(tables, name)
        writes = writes.with_columns(source_timestamp=_NO_TIME, rmw_handle=nowhere)
    bound = events.table(tables, "dds_bind_addr_to_stamp")
    if bound.height:
        message = ["pid", "tid", "message"]
        bound = bound.select("pid", "tid", "source_stamp", message="addr", bound="time")
        writes = first_after(writes, bound, message, "time", "bound")
        # A later write of the same address has a better claim to the stamp after it.
        later_write = pl.col("bound") == pl.col("bound").shift(-1).over(message)
        stamp = pl.when(~later_write.fill_null(False)).then("source_stamp")
        writes = writes.with_columns(pl.coalesce("source_timestamp", stamp))
    return writes.select("time", "pid", "tid", "message", "rmw_handle", "source_timestamp")


def _handed_over(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Make a frame of the messages given to ring buffers, numbered by ``handed``.

    Further columns: ``intra_time`` (ns), ``pid``, ``tid``, ``publisher``, ``node``, ``topic``.
    """
    handed = events.table(tables, "rclcpp_intra_publish").rename({"time": "intra_time"})
    of_known = _by_rcl_handle(handed, objects, "intra_time").drop_nulls("publisher")
    return of_known.with_row_index("handed").select(
        "handed", "intra_time", "pid", "tid", *_PUBLISHER
    )


def taken_by_rmw(tables: events.EventTables) -> pl.DataFrame:
    """Return the rows of `rmw_take` in which a message was there to be taken."""
    taken = events.table(tables, "rmw_take", ["taken"])
    if (taken["taken"] == 0).any():
        taken = taken.filter(pl.col("taken").fill_null(1) != 0)
    return taken


def takes(tables: events.EventTables, objects: Objects, calls: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of all messages that known subscriptions took, sorted by time. Columns:

    * ``take``: numbered from 0.
    * ``time`` (ns), ``pid``, ``tid``.
    * ``callback_id``: null if the subscription has no callback.
    * ``node``, ``topic``.
    * ``source_timestamp``: ns of CLOCK_REALTIME; null if unknown.
    * ``call``: of a request or response, null for messages; absent where no service was called.
    * ``intra_process``: whether it came from within the process.
    * ``buffer``, ``index``: the ring buffer, and the place in it, where such a message lay; null
      where only CARET's events show it.

    A take that got no message (``taken`` = 0) is left out.
    """
    types = {name: objects.subscriptions.schema[name] for name in ("node", "topic")}
    callbacks = objects.callbacks.cast(types)  # type: ignore[arg-type]
    owner = callbacks.drop_nulls("subscription").unique("subscription", maintain_order=True)
    owner = owner.select("subscription", "callback_id")
    columns, key = ["callback_id", "node", "topic"], ["pid", "rmw_handle"]
    subscriptions = objects.subscriptions.join(owner, on="subscription", how="left")
    from_dds = subscriptions.select(*_END, *columns)
    taken = taken_by_rmw(tables).rename({"rmw_subscription_handle": "rmw_handle"})
    parts = [latest_before(taken, from_dds, key, "time", "created")]
    if calls.height:
        calls = calls.with_columns(source_timestamp=_NO_TIME)
        parts.append(latest_before(calls, from_dds, key, "time", "created"))
    owners = callbacks.select("pid", *columns, callback="handle", created="valid_from")
    if taken.is_empty():
        dispatched = events.table(tables, "dispatch_subscription_callback")
        dispatched = dispatched.rename({"source_stamp": "source_timestamp"})
        parts.append(latest_before(dispatched, owners, ["pid", "callback"], "time", "created"))
    dispatched = _dispatched(tables)
    dispatched = latest_before(dispatched, owners, ["pid", "callback"], "time", "created")
    within = {"source_timestamp": _NO_TIME, "intra_process": pl.lit(True)}
    parts.append(dispatched.with_columns(**within))
    owners = callbacks.unique("callback_id", maintain_order=True).select(columns)
    buffers = objects.buffers.join(owners, on="callback_id", how="left")
    dequeued = events.table(tables, "rclcpp_ring_buffer_dequeue")
    dequeued = latest_before(dequeued, buffers, ["pid", "buffer"], "time", "valid_from")
    parts.append(dequeued.drop_nulls("callback_id").with_columns(**within))
    nowhere = pl.lit(None, dtype=pl.UInt64)
    absent = {"buffer": nowhere, "index": nowhere}
    if calls.height:
        absent["call"] = _NO_CALL
    parts = [
        part.select(
            *("time", "pid", "tid", *columns),
            pl.when(pl.col("source_timestamp") != 0).then("source_timestamp"),
            *(pl.col(n) if n in part.columns else null.alias(n) for n, null in absent.items()),
            intra_process=pl.lit("intra_process" in part.columns),
        )
        for part in parts
    ]
    all_takes = pl.concat([part for part in parts if part.height] or parts[:1])
    all_takes = all_takes.drop_nulls("topic") if all_takes["topic"].null_count() else all_takes
    return in_order(all_takes, "time", "pid", "tid").with_row_index("take")


def _dispatched(tables: events.EventTables) -> pl.DataFrame:
    """CARET's dispatches of messages within a process: ``time, pid, tid, message, callback``.

    The frame is empty where events of ring buffers show the same messages.
    """
    rows = [events.table(tables, name) for name in _DISPATCHES]
    if events.table(tables, "rclcpp_ring_buffer_dequeue").height:
        rows = [row.clear() for row in rows]
    all_dispatches = pl.concat(
        row.select("time", "pid", "tid", "message", "callback") for row in rows
    )
    return in_order(all_dispatches, "time")


def has_stampless(published: pl.DataFrame) -> bool:
    """Return whether some message has no source timestamp; requests and responses need none."""
    return _messages(published)["source_timestamp"].null_count() > 0


def link_takes(
    tables: events.EventTables, taken: pl.DataFrame, published: pl.DataFrame, clock_offset_ns: int
) -> tuple[pl.DataFrame, StampedMessages | None]:
    """Add the column ``publication``: which publication each take read (null: unknown).

    ``clock_offset_ns`` is CLOCK_REALTIME, the clock of source timestamps, less the clock of events
    when the recording began. It is used only where publications carry no source timestamp. The
    second value is how such messages were found where a fixed distance of the clocks did not
    suffice, else None.
    """
    matches = _with_same(taken, published, "source_timestamp")
    if "call" in taken.columns and "call" in published.columns:
        matches = pl.concat([matches, _with_same(taken, published, "call")])
    linked = taken.with_columns(by_number(matches, "take", "publication", taken.height))
    columns, by_clocks = linked.columns, None
    through_buffer = pl.col("intra_time").is_not_null() & (pl.col("time") <= pl.col("intra_time"))
    stampless = _messages(published).filter(pl.col("source_timestamp").is_null() & ~through_buffer)
    unknown = linked.filter(pl.col("publication").is_null() & (pl.col("source_timestamp") > 0))
    if stampless.height and unknown.height:
        stampless = stampless.select("topic", "publisher", "time", guess="publication")
        rows = _by_fixed_clocks(unknown, stampless, clock_offset_ns)
        if rows is None:
            stampless = stampless.rename({"guess": "publication"})
            by_clocks = messages_of_stamps(unknown, stampless, clock_offset_ns)
            message = ["topic", "source_timestamp"]
            guesses = by_clocks.frame.rename({"publication": "guess"})
            rows = unknown.join(guesses, on=message, how="left", maintain_order="left")
        guess = by_number(rows, "take", "guess", linked.height)
        linked = linked.with_columns(pl.coalesce("publication", guess))
    if _dispatched(tables).height:
        linked = _with_dispatched(tables, linked, published)
    if taken["buffer"].count():
        stored = _enqueued(tables, published)
        rows = latest_before(linked, stored, ["pid", "buffer", "index"], "time", "enqueued")
        linked = rows.with_columns(pl.coalesce("publication", "stored")).sort("take")
    return linked.select(columns), by_clocks


def _by_fixed_clocks(
    unknown: pl.DataFrame, stampless: pl.DataFrame, clock_offset_ns: int
) -> pl.DataFrame | None:
    """Add to takes the column ``guess``: the latest publication before their source timestamp.

    None: the distance of the clocks changed, or the publication of a message is missing.
    """
    sent = pl.col("source_timestamp") - clock_offset_ns + _CLOCKS_AGREE
    known = stampless.select("topic", "guess", published="time")
    rows = latest_before(unknown.with_columns(sent=sent), known, ["topic"], "sent", "published")
    # A subscription gets a message once. So a second take with the same guess read another message,
    # whose publication is missing.
    again = pl.col("guess") == pl.col("guess").shift(1).over("pid", "node", "callback_id")
    late = pl.col("sent") - pl.col("published") > _CLOCKS_AGREE + _HELD_UP
    early = pl.col("published") > pl.col("time")
    odd = pl.col("guess").is_null() | again.fill_null(False) | late | early
    return None if rows.select(odd.any()).item() else rows


def _with_dispatched(
    tables: events.EventTables, linked: pl.DataFrame, published: pl.DataFrame
) -> pl.DataFrame:
    """Add the publications of messages that CARET saw dispatched within their process.

    Addresses are used again: the message at an address is the latest that was handed over, or
    copied, there.
    """
    address, thread = ["pid", "message"], ["pid", "tid"]
    handed = events.table(tables, "rclcpp_intra_publish").select("time", *thread, "message")
    known = published.drop_nulls("intra_time").select(*thread, "intra_time", stored="publication")
    handed = latest_before(handed, known, thread, "time", "intra_time")
    handed = handed.filter(pl.col("time") == pl.col("intra_time"))
    origins = handed.select(*address, "stored", since="time")
    copied = events.table(tables, "message_construct")
    copied = copied.select("time", "pid", "constructed_message", message="original_message")
    for _ in range(_COPIES if copied.height else 0):
        of_original = latest_before(copied, origins, address, "time", "since").drop_nulls("stored")
        copies = of_original.select(
            "pid", "stored", message="constructed_message", since="time"
        ).select(origins.columns)
        origins = pl.concat([origins, copies]).unique().sort("since", maintain_order=True)
    took = _dispatched(tables).select(*thread, "message", dispatched="time")
    rows = linked.filter(pl.col("intra_process") & pl.col("buffer").is_null())
    rows = latest_before(rows, took, thread, "time", "dispatched")
    rows = latest_before(rows, origins, address, "time", "since").drop_nulls("stored")
    # A callback gets a message once: the second dispatch was of a message whose events were lost.
    rows = rows.unique(["callback_id", "stored"], keep="first", maintain_order=True)
    stored = by_number(rows, "take", "stored", linked.height)
    return linked.with_columns(pl.coalesce("publication", stored))


def _messages(published: pl.DataFrame) -> pl.DataFrame:
    """Return the publications without the requests and responses of services."""
    return published.filter(pl.col("call").is_null()) if "call" in published.columns else published


def _with_same(taken: pl.DataFrame, published: pl.DataFrame, stamp: str) -> pl.DataFrame:
    """Make a frame of the pairs ``take, publication`` with the same topic and the same ``stamp``.

    ``stamp`` is the name of a column. An asof join, and then a test for equality: unlike a hash
    join it stays linear in time and memory whatever the stamps are. Of two publications of a topic
    with one stamp the first counts.
    """
    wanted = taken.select("topic", stamp, "take")
    wanted = wanted.drop_nulls(stamp) if wanted[stamp].null_count() else wanted
    stamped = published.select("topic", "publication", stamped=stamp)
    stamped = stamped.drop_nulls("stamped") if stamped["stamped"].null_count() else stamped
    if not grows(stamped["stamped"]):  # the join takes the last of equal stamps
        stamped = stamped.reverse().sort("stamped", maintain_order=True)
    latest = latest_before(wanted, stamped, ["topic"], stamp, "stamped")
    return latest.filter(pl.col(stamp) == pl.col("stamped")).select("take", "publication")


def _enqueued(tables: events.EventTables, published: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of every enqueue into a ring buffer.

    Columns: ``pid``, ``tid``, ``buffer``; ``index``, the place in the buffer; ``enqueued``, when
    (ns); ``stored``, the publication that was put there (null: unknown); ``overwrites``, whether
    the message that lay in this place was lost.
    """
    handed = published.drop_nulls("intra_time").select(
        "pid", "tid", "intra_time", stored="publication"
    )
    put = events.table(tables, "rclcpp_ring_buffer_enqueue", ["overwritten"]).select(
        *("pid", "tid", "buffer", "index"),
        enqueued="time",
        overwrites=pl.col("overwritten").fill_null(0) != 0,
    )
    return latest_before(put, handed, ["pid", "tid"], "enqueued", "intra_time")


def overwritten_in(
    tables: events.EventTables, published: pl.DataFrame, buffers: pl.DataFrame, callback_id: int
) -> pl.Series:
    """Numbers of the publications that were overwritten in the ring buffers of a callback."""
    stored = _enqueued(tables, published)
    stored = latest_before(stored, buffers, ["pid", "buffer"], "enqueued", "valid_from")
    stored = stored.filter(pl.col("callback_id") == callback_id)
    next_overwrites = pl.col("overwrites").shift(-1).over("pid", "buffer", "index")
    return stored.filter(next_overwrites.fill_null(False))["stored"].drop_nulls()


def with_departures(
    published: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.DataFrame:
    """Add the column ``sent``: when each message left its process (ns, null: it never did)."""
    created = events.table(tables, "rcl_publisher_init", ["asynchronous"])
    created = created.filter(pl.col("asynchronous").fill_null(0) != 0)
    if not created.height:
        return published.with_columns(sent=pl.col("time"))
    asynchronous = objects.publishers.join(
        created.select("pid", rmw_handle="rmw_publisher_handle"), on=["pid", "rmw_handle"]
    )
    ours = published["publisher"].is_in(asynchronous["publisher"].implode())
    sent = _sends(published, tables, objects).filter(pl.col("outcome") == "sent")
    left = by_number(sent, "publication", "time", published.height)
    return published.with_columns(sent=pl.when(ours).then(left).otherwise("time"))


def why_not_sent(
    published: pl.DataFrame, tables: events.EventTables, objects: Objects
) -> pl.Series:
    """Give each publication a reason why it was not sent; it holds for those without ``sent``."""
    sends = _sends(published, tables, objects).with_columns(reason=pl.lit("discarded"))
    return by_number(sends, "publication", "reason", published.height).fill_null("not sent")


def _sends(published: pl.DataFrame, tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Return the table `asynchronous_send` with the ``publication`` that each row is about."""
    publishers = objects.publishers.select("pid", "publisher", rmw_publisher_handle="rmw_handle")
    sends = events.table(tables, "asynchronous_send").rename({"timestamp": "source_timestamp"})
    stamped = published.select("publication", "publisher", "source_timestamp")
    sends = sends.join(publishers, on=["pid", "rmw_publisher_handle"])
    return sends.join(stamped, on=["publisher", "source_timestamp"])


def discarded_instances(
    taken: pl.DataFrame, tables: events.EventTables, objects: Objects, instances: pl.DataFrame
) -> pl.Series:
    """Give each callback instance true if it is a gate's that discarded its message, else null."""
    key = ["callback_id", "source_timestamp"]
    discarded = gate_decisions(tables, objects).filter(pl.col("release").is_null())
    stamped = taken.drop_nulls("instance").join(discarded, on=key, how="semi")
    within = instances.join(discarded, on=["callback_id", "start"], how="semi")
    all_discarding = pl.concat([rows.select("instance") for rows in (stamped, within)])
    all_discarding = all_discarding.with_columns(discarded=pl.lit(True))
    return by_number(all_discarding, "instance", "discarded", instances.height)


def gate_decisions(tables: events.EventTables, objects: Objects) -> pl.DataFrame:
    """Return the table `gate_release` with the ``callback_id`` of each gate.

    A shaping node in ROS 2 does not know the handle of its callback. So a decision of its gate has
    a row for each subscription of its process, and the message's source timestamp decides later
    which of them took it. A decision about a message without such a stamp was made in the instance
    that ran on the gate's thread; that began at ``start`` (null for all others).
    """
    decisions = events.table(tables, "gate_release", ["mode", "moved", "dropped"])
    key = ["pid", "callback"]
    callbacks = objects.callbacks.with_columns(callback="handle")
    handles = callbacks.select(*key, "callback_id").unique()
    known = decisions.join(handles, on=key, maintain_order="left").with_columns(start=_NO_TIME)
    nameless = decisions.join(handles, on=key, how="anti", maintain_order="left")
    if not nameless.height:
        return known
    stamped = pl.col("source_timestamp").is_not_null()
    began = events.table(tables, "callback_start").select("pid", "tid", "callback", start="time")
    within = nameless.filter(~stamped).drop("callback")
    within = latest_before(within, began, ["pid", "tid"], "time", "start").join(handles, on=key)
    listening = callbacks.filter(pl.col("kind") == "subscription").select("pid", "callback_id")
    unknown = nameless.filter(stamped).with_columns(start=_NO_TIME)
    unknown = unknown.join(listening.unique(), on="pid", maintain_order="left")
    return pl.concat([known, *(rows.select(known.columns) for rows in (unknown, within))])


def with_overrun(decisions: pl.DataFrame, due_cycles: int = 0) -> pl.DataFrame:
    """Add the column ``overrun``, if an older recording lacks it.

    Then a message overran if it left more than ``due_cycles`` cycles after its own.
    """
    if "overrun" in decisions.columns:
        return decisions
    late = pl.col("cycles_waited") > due_cycles
    return decisions.with_columns(overrun=pl.when(late).then(pl.lit("wait")))


def gated_hops(
    tables: events.EventTables, objects: Objects, hops: pl.DataFrame, due_cycles: int = 0
) -> pl.DataFrame:
    """Make a frame of what gates decided: a row per hop of a traversal whose callback is a gate.

    Columns, sorted by the first two: ``traversal``; ``hop``; ``let_go``, when the gate let the
    message go (ns); and of `gate_release`: ``arrival, origin, release, slot, cycles_waited, anchor,
    overrun, mode, dropped, moved_ns``. Several messages may have the same source timestamp (writers
    stamp in microseconds, a simulated clock stands still): then the decision counts whose
    ``arrival`` is nearest to the start of the callback.
    """
    key = ["callback_id", "source_timestamp"]
    decided = with_overrun(gate_decisions(tables, objects), due_cycles).with_columns(let_go="time")
    if decided.is_empty():  # the joins would copy all hops to find nothing
        hops = hops.clear()
    reached = hops.select("traversal", "hop", "start", *key)
    columns = [*reached.columns, *(n for n in decided.columns if n not in reached.columns)]
    stamped = reached.drop_nulls(key).join(decided.drop("start"), on=key)
    within = reached.drop("source_timestamp").join(decided, on=["callback_id", "start"])
    candidates = pl.concat([rows.select(columns) for rows in (stamped, within)])
    apart = (pl.col("arrival") - pl.col("start")).abs()
    candidates = candidates.sort("traversal", "hop", apart, maintain_order=True)
    return candidates.unique(["traversal", "hop"], keep="first", maintain_order=True).select(
        *("traversal", "hop", "arrival", "origin", "release", "let_go", "slot"),
        *("cycles_waited", "anchor", "overrun", "mode", "dropped"),
        moved_ns=pl.col("moved").fill_null(0),
    )
