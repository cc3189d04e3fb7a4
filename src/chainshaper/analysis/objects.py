"""Who exists: nodes, publishers, subscriptions, timers, services and their callbacks.

Events name objects by handles: addresses that are unique only within one process, and only until
they are freed. So a handle is looked up as (process, handle, time): it means the last object that
was created there, at or before the event. A handle without an event of its creation belongs to no
known object: Cyclone DDS has such for `ros_discovery_info`, and so has all that existed before
tracing began. The order of the events is that of rclcpp's constructors (ros2_tracing).
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.manager_loops import manager_ends
from chainshaper.analysis.matching import first_after, latest_before, nearest
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_SERVICES, LOOP_END, REQUEST, RESPONSE

_CALL = ("request", "response")
_NEARLY_ALWAYS = 0.9  # of a callback's starts: so many must come behind a take of its subscription

CALLBACK_SCHEMA: dict[str, pl.DataType] = {
    "callback_id": pl.UInt32(),
    "pid": pl.Int32(),
    "handle": pl.UInt64(),
    "valid_from": pl.Int64(),
    "valid_to": pl.Int64(),
    "kind": pl.String(),
    "node": pl.String(),
    "topic": pl.String(),
    "period_ns": pl.Int64(),
    "declared_ns": pl.Int64(),
    "symbol": pl.String(),
    "observed": pl.Boolean(),
    "subscription": pl.UInt32(),
}


@dataclass(frozen=True)
class Objects:
    """The objects of a recording, one frame per kind; times are ns of the event clock.

    ``nodes``
        ``pid, handle, valid_from, node`` (name with namespace, ``/front/filter``).
    ``publishers``, ``subscriptions``
        ``publisher`` or ``subscription`` (numbered from 0), ``pid, handle, rmw_handle, valid_from,
        node, topic``. In these two, and in all that is joined from them, names are of type
        ``Enum``: millions of rows carry them as numbers. Clients and servers whose calls were seen
        are in both, with the topics ``SERVICE:request`` and ``SERVICE:response``.
    ``callbacks``
        One row per *registration*: an address under which a callback ran for a time.

        * ``callback_id``: callbacks are numbered from 0 (:func:`numbered`).
        * ``pid``, ``handle``: process and address.
        * ``valid_from``, ``valid_to``: from its registration until another one of the same address
          (null: there was none).
        * ``kind``: ``timer``, ``subscription``, ``service``, ``client``, ``loop`` or ``unknown``.
        * ``node``.
        * ``topic``: the topic's or the service's name.
        * ``declared_ns``: the period with which a timer was created.
        * ``period_ns``: the same here; in a :class:`~chainshaper.analysis.flow.DataFlow` the period
          that its starts show.
        * ``symbol``: the name of its function.
        * ``observed``: false for what has no callback events: subscriptions, services and timers of
          rclpy, services of actions, loops, and all clients.
        * ``subscription``: its number in that frame.
    ``buffers``
        Ring buffers for messages within a process: ``pid, buffer, valid_from, callback_id``.
    ``activity``
        When lifecycle nodes became active, or inactive: ``time, pid, node, active``.
    ``notes``
        What cannot be known from this recording, in plain words.
    """

    nodes: pl.DataFrame
    publishers: pl.DataFrame
    subscriptions: pl.DataFrame
    callbacks: pl.DataFrame
    buffers: pl.DataFrame
    activity: pl.DataFrame
    notes: tuple[str, ...]


def resolve_objects(tables: events.EventTables) -> Objects:
    """Find all objects of a recording. Cost is linear in the number of events."""
    nodes, ends = named_nodes(tables), endpoints(tables)
    publishers, subscriptions = (_carrying(tables, ends, k) for k in ("publisher", "subscription"))
    with_events = [
        _subscription_callbacks(tables, subscriptions),
        _timer_callbacks(tables, nodes),
        _service_callbacks(tables, ends, subscriptions),
        _of_conditions(tables, nodes),
    ]
    registered = pl.concat(with_events, how="diagonal_relaxed")
    unknown = _unregistered(tables, registered)
    by_takes = _subscriptions_by_takes(tables, subscriptions, unknown)
    unknown = unknown.join(by_takes, on=["pid", "handle"], how="anti", maintain_order="left")
    registered = _with_symbols(tables, pl.concat([registered, by_takes], how="diagonal_relaxed"))
    # No version of rclcpp says when the callbacks of clients run.
    clients = (
        ends.filter(role="client")
        .drop("role", "rmw_handle")
        .with_columns(end="handle", kind=pl.lit("client"), observed=pl.lit(False))
    )
    clients = _listening(clients, subscriptions, RESPONSE)
    listening = pl.concat([registered, clients], how="diagonal_relaxed")
    without_registration = [
        unknown,
        _callbackless(tables, subscriptions, listening),
        _timers_of_python(tables, nodes),
        clients,
    ]
    callbacks = numbered(
        tables, pl.concat([registered, *without_registration], how="diagonal_relaxed")
    )
    names = []
    for column in ("node", "topic"):
        known = [frame[column].cast(pl.String) for frame in (publishers, subscriptions, callbacks)]
        names.append(pl.col(column).cast(pl.Enum(pl.concat(known).drop_nulls().unique().sort())))
    return Objects(
        nodes=nodes,
        publishers=publishers.with_columns(names),
        subscriptions=subscriptions.with_columns(names),
        callbacks=callbacks.with_columns(declared_ns="period_ns").select(
            pl.col(name).cast(kind) for name, kind in CALLBACK_SCHEMA.items()
        ),
        buffers=_buffers(tables, callbacks),
        activity=_activity(tables, nodes),
        notes=(*_notes(tables, callbacks), *_notes_of_takes(by_takes)),
    )


def named_nodes(tables: events.EventTables) -> pl.DataFrame:
    """Return the frame ``nodes`` of :class:`Objects`."""
    created = events.table(tables, "rcl_node_init").drop_nulls("node_handle")
    return created.select("pid", handle="node_handle", valid_from="time", node=events.NODE_NAME)


def named_loops(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the loops that the user named: ``pid, tid, valid_from, node, is_thread``.

    A thread that was named by its own name counts as one of the node that its process created
    first.
    """
    named = events.table(tables, "loop_named")
    first = nodes.unique("pid", keep="first", maintain_order=True).select("pid", first="node")
    joined = named.join(first, on="pid", how="left", maintain_order="left")
    is_thread = pl.col("is_thread") != 0
    node = pl.when(is_thread).then("first").otherwise("name")
    chosen = joined.select("pid", "tid", valid_from="time", node=node, is_thread=is_thread)
    return chosen.drop_nulls("node")


def _with_node(objects: pl.DataFrame, nodes: pl.DataFrame, at: str) -> pl.DataFrame:
    """Add ``node``: the name of the node that had the row's ``node_handle`` at the instant ``at``.

    Before Iron a node's publisher of /rosout is created just before its `rcl_node_init`: if no node
    had the handle yet, it is the next one that gets it.
    """
    of_node = nodes.select("pid", "node", node_handle="handle", node_from="valid_from")
    joined = latest_before(objects, of_node, ["pid", "node_handle"], at, "node_from")
    later = first_after(objects, of_node, ["pid", "node_handle"], at, "node_from")
    return joined.with_columns(pl.col("node").fill_null(later["node"]))


def endpoints(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of all publishers, subscriptions, clients and services.

    Columns: ``role`` (``publisher``, ``subscription``, ``client``, ``service``), ``pid``,
    ``handle``, ``rmw_handle``, ``valid_from``, ``node``, and ``topic`` (or the service's name).
    """
    of_roles = []
    for role in ("publisher", "subscription", "client", "service"):
        name = "topic_name" if role in ("publisher", "subscription") else "service_name"
        handles = {"handle": f"{role}_handle", "rmw_handle": f"rmw_{role}_handle"}
        of_roles.append(
            events.table(tables, f"rcl_{role}_init").select(
                "pid", "node_handle", **handles, role=pl.lit(role), valid_from="time", topic=name
            )
        )
    ends = _with_node(pl.concat(of_roles), named_nodes(tables), "valid_from")
    return ends.drop("node_handle", "node_from")


def _carrying(tables: events.EventTables, ends: pl.DataFrame, kind: str) -> pl.DataFrame:
    """Make the frame ``publishers`` or ``subscriptions`` (``kind``) of :class:`Objects`.

    Clients and servers whose calls were seen count as both. A loop that the user named publishes
    the ends of its instances, a controller manager those of `write()`.
    """
    parts = [ends.filter(role=kind)]
    internal = pl.col("topic").str.extract("([^/]*)$").is_in(INTERNAL_SERVICES)
    for role, sends, takes in (("client", *_CALL), ("service", *_CALL[::-1])):
        calls = [
            events.table(tables, f"rmw_{table}") for table in (f"send_{sends}", f"take_{takes}")
        ]
        seen = pl.concat(table.select("pid", rmw_handle=f"rmw_{role}_handle") for table in calls)
        used = ends.filter(~internal, role=role)
        used = used.join(seen.unique(), on=["pid", "rmw_handle"], how="semi", maintain_order="left")
        suffix = f":{sends if kind == 'publisher' else takes}"
        parts.append(used.with_columns(pl.col("topic") + suffix))
    if kind == "publisher":
        loops = named_loops(tables, named_nodes(tables)).select("pid", "node", "valid_from")
        loops = loops.unique(["pid", "node"], keep="first", maintain_order=True)
        loops = loops.with_columns(topic=pl.col("node") + LOOP_END)
        of_managers = manager_ends(tables, named_nodes(tables))  # each of which has this end only
        loops = loops.join(of_managers, on=["pid", "node"], how="anti", maintain_order="left")
        parts = [pl.concat([*parts, loops, of_managers], how="diagonal_relaxed")]
    return pl.concat(parts).drop("role").with_row_index(kind)


def _added(tables: events.EventTables, kind: str, owner: str) -> pl.DataFrame:
    """Make a frame of the registrations of callbacks: ``pid, handle, valid_from`` and the owner."""
    added = events.table(tables, f"rclcpp_{kind}_callback_added")
    return added.select("pid", owner, handle="callback", valid_from="time")


def _subscription_callbacks(
    tables: events.EventTables, subscriptions: pl.DataFrame
) -> pl.DataFrame:
    """Make a frame of subscriptions' callbacks with node and topic.

    Callback ← rclcpp subscription object ← rcl subscription ← node and topic. The object is matched
    to the nearest `rclcpp_subscription_init`: for an intra-process twin that event comes just after
    `callback_added`, for all others just before.
    """
    objects = events.table(tables, "rclcpp_subscription_init").select(
        "pid", "subscription", rcl_handle="subscription_handle", created="time"
    )
    added = _added(tables, "subscription", "subscription")
    joined = nearest(added, objects, ["pid", "subscription"], "valid_from", "created")
    rcl = subscriptions.select(
        "pid", "subscription", "node", "topic", rcl_handle="handle", rcl_from="valid_from"
    )
    # Both constructors ran after rcl_subscription_init; without `created` there is no rcl handle.
    known = pl.max_horizontal("created", "valid_from")
    joined = joined.drop("subscription").with_columns(known=known, kind=pl.lit("subscription"))
    return latest_before(joined, rcl, ["pid", "rcl_handle"], "known", "rcl_from").select(
        "pid", "handle", "valid_from", "node", "topic", "subscription", "kind"
    )


def _timer_callbacks(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of timers' callbacks with node and period.

    The event of the period comes before `rclcpp_timer_callback_added`, that of the node after it.
    """
    timer = ["pid", "timer_handle"]
    created = events.table(tables, "rcl_timer_init")
    created = created.select(*timer, period_ns="period", created="time")
    linked = events.table(tables, "rclcpp_timer_link_node")
    linked = linked.select(*timer, "node_handle", linked="time")
    added = _added(tables, "timer", "timer_handle").with_columns(kind=pl.lit("timer"))
    joined = latest_before(added, created, timer, "valid_from", "created")
    joined = first_after(joined, linked, timer, "valid_from", "linked")
    # `joined` is sorted by valid_from: a link made after the address was used again is that of
    # another timer.
    next_use = pl.col("valid_from").shift(-1).over(timer)
    of_this_timer = next_use.is_null() | (pl.col("linked") < next_use)
    at = pl.max_horizontal("linked", "valid_from")
    joined = _with_node(
        joined.with_columns(pl.when(of_this_timer).then("node_handle"), at=at), nodes, "at"
    )
    return joined.select("pid", "handle", "valid_from", "node", "period_ns", "kind")


def _service_callbacks(
    tables: events.EventTables, ends: pl.DataFrame, subscriptions: pl.DataFrame
) -> pl.DataFrame:
    """Make a frame of services' callbacks with node and name of the service."""
    added = _added(tables, "service", "service_handle").rename({"service_handle": "end"})
    created = ends.filter(role="service")
    created = created.select("pid", "node", "topic", end="handle", made="valid_from")
    joined = latest_before(added, created, ["pid", "end"], "valid_from", "made")
    return _listening(joined.with_columns(kind=pl.lit("service")), subscriptions, REQUEST)


def _listening(ends: pl.DataFrame, subscriptions: pl.DataFrame, to: str) -> pl.DataFrame:
    """Add the ``subscription`` as which a server or client is listed, if its calls were seen."""
    entries = subscriptions.filter(pl.col("topic").str.ends_with(to))
    entries = entries.select("pid", "subscription", end="handle", created="valid_from")
    return latest_before(ends, entries, ["pid", "end"], "valid_from", "created")


def _with_symbols(tables: events.EventTables, registered: pl.DataFrame) -> pl.DataFrame:
    """Add ``valid_to``, ``observed`` and the ``symbol`` registered while the handle was valid."""
    registered = registered.sort("valid_from", maintain_order=True).with_columns(
        valid_to=pl.col("valid_from").shift(-1).over("pid", "handle"), observed=pl.lit(True)
    )
    symbols = events.table(tables, "rclcpp_callback_register").select(
        "pid", "symbol", handle="callback", named="time"
    )
    joined = first_after(registered, symbols, ["pid", "handle"], "valid_from", "named")
    in_time = pl.col("valid_to").is_null() | (pl.col("named") < pl.col("valid_to"))
    return joined.with_columns(pl.when(in_time).then("symbol").alias("symbol")).drop("named")


def _unregistered(tables: events.EventTables, registered: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of callbacks that ran before, or without, an event of their registration."""
    key = ["pid", "handle"]
    known = registered.group_by(key).agg(valid_to=pl.col("valid_from").min())
    started = events.table(tables, "callback_start").lazy().select("pid", "time", handle="callback")
    coroutines = events.table(tables, "coroutine_step").lazy().filter(pl.col("callback") != 0)
    coroutines = coroutines.select("pid", "time", handle="callback")
    started = pl.concat([started, coroutines])
    first = started.group_by(key).agg(valid_from=pl.col("time").min()).collect()
    first = first.join(known, on=key, how="left")
    early = pl.col("valid_to").is_null() | (pl.col("valid_from") < pl.col("valid_to"))
    unknown = first.with_columns(kind=pl.lit("unknown"), observed=pl.lit(True))
    return unknown.filter(early).sort("valid_from", *key)


def _of_conditions(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the callbacks of rclpy's guard conditions: only their node is known."""
    added = events.table(tables, "rclpy_callback_added")
    added = added.select("pid", "node_handle", handle="callback", valid_from="time")
    added = _with_node(added, nodes, "valid_from").with_columns(kind=pl.lit("unknown"))
    return added.select("pid", "handle", "valid_from", "node", "kind")


def _subscriptions_by_takes(
    tables: events.EventTables, subscriptions: pl.DataFrame, unknown: pl.DataFrame
) -> pl.DataFrame:
    """Find those of ``unknown`` callbacks that are a subscription's.

    A callback that was copied, or moved, runs at another address than the registered one. Right
    before nearly all of its starts its thread takes a message of one subscription, or executes it.
    """
    thread, key = ["pid", "tid"], ["pid", "handle"]
    columns = ["node", "topic", "subscription"]
    if unknown.is_empty() or subscriptions.is_empty():
        return unknown.clear().with_columns(subscriptions.clear().select(columns))
    started = events.table(tables, "callback_start", ["is_intra_process"])
    starts = started.filter(pl.col("is_intra_process").fill_null(0) == 0)
    starts = starts.select("time", *thread, handle="callback")
    starts = starts.join(unknown, on=key, how="semi", maintain_order="left")
    begun = started.select(*thread, begun="time")
    ended = events.table(tables, "callback_end").select(*thread, ended="time")
    last_begun = latest_before(starts, begun, thread, "time", "begun", strictly=True)["begun"]
    last_ended = latest_before(starts, ended, thread, "time", "ended")["ended"]
    starts = starts.with_columns(before=pl.max_horizontal(last_begun, last_ended))
    votes = []
    for name, handle, owner in (
        ("rmw_take", "rmw_subscription_handle", "rmw_handle"),
        ("rclcpp_executor_execute", "handle", "handle"),
    ):
        rows = events.table(tables, name).select(*thread, end=handle, did="time")
        rows = latest_before(starts, rows, thread, "time", "did")
        rows = rows.filter(pl.col("before").is_null() | (pl.col("did") > pl.col("before")))
        ends = subscriptions.select("pid", *columns, end=owner, created="valid_from")
        votes.append(latest_before(rows, ends, ["pid", "end"], "did", "created"))
    counted = pl.concat(vote.select(*key, "time", *columns) for vote in votes)
    counted = counted.drop_nulls("subscription").unique([*key, "time", "subscription"])
    counted = counted.group_by(*key, "subscription").agg(pl.len(), *map(pl.first, columns[:2]))
    counted = counted.join(starts.group_by(key).agg(starts=pl.len()), on=key)
    counted = counted.filter(pl.col("len") >= _NEARLY_ALWAYS * pl.col("starts"))
    certain = counted.unique(key, keep="none").select(*key, *columns)
    return unknown.join(certain, on=key, maintain_order="left").with_columns(
        kind=pl.lit("subscription")
    )


def _notes_of_takes(by_takes: pl.DataFrame) -> tuple[str, ...]:
    return tuple(
        f"the callback of {node} for {topic} ran at the address {handle:#x}, which was not"
        " registered: what its thread took right before its starts tells that it is this one."
        for node, topic, handle in by_takes.select("node", "topic", "handle").iter_rows()
    )


def _callbackless(
    tables: events.EventTables, subscriptions: pl.DataFrame, registered: pl.DataFrame
) -> pl.DataFrame:
    """Make a frame of subscriptions and services that have no callback in the trace.

    Such are those of rclpy, wait sets and action servers.
    """
    bare = subscriptions.join(registered.drop_nulls("subscription"), on="subscription", how="anti")
    takes = events.table(tables, "rmw_take").lazy()
    takes = takes.select("pid", rmw_handle="rmw_subscription_handle").unique()
    takes_messages = bare.join(takes.collect(), on=["pid", "rmw_handle"], how="semi")
    serves = pl.col("topic").str.ends_with(REQUEST)
    silent = pl.concat([takes_messages.filter(~serves), bare.filter(serves)])
    return silent.select(
        *("pid", "handle", "valid_from", "node", "subscription"),
        topic=pl.col("topic").str.strip_suffix(REQUEST),
        kind=pl.when(serves).then(pl.lit("service")).otherwise(pl.lit("subscription")),
        observed=pl.lit(False),
    )


def _timers_of_python(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of timers that are called, but have no callback in the trace (rclpy).

    No event says to which node they belong: the last one that their process had created counts.
    """
    timer = ["pid", "timer_handle"]
    called = events.table(tables, "rcl_timer_call").select(timer).unique()
    created = events.table(tables, "rcl_timer_init").join(called, on=timer, how="semi")
    added = events.table(tables, "rclcpp_timer_callback_added")
    bare = created.join(added, on=timer, how="anti").select(
        "pid", handle="timer_handle", valid_from="time", period_ns="period", kind=pl.lit("timer")
    )
    owners = nodes.select("pid", "node", node_from="valid_from")
    owned = latest_before(bare, owners, ["pid"], "valid_from", "node_from")
    return owned.with_columns(observed=pl.lit(False))


def _buffers(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """Make the frame ``buffers``: ring buffer → intra-process buffer → subscription → callback."""
    buffers = events.table(tables, "rclcpp_buffer_to_ipb").select(
        "pid", "buffer", "ipb", valid_from="time"
    )
    owners = events.table(tables, "rclcpp_ipb_to_subscription").select(
        "pid", "ipb", "subscription", owned="time"
    )
    added = _added(tables, "subscription", "subscription").rename({"valid_from": "added"})
    ids = callbacks.select("pid", "handle", "callback_id", registered="valid_from")
    owned = first_after(buffers, owners, ["pid", "ipb"], "valid_from", "owned").drop_nulls("owned")
    joined = nearest(owned, added, ["pid", "subscription"], "owned", "added").drop_nulls("added")
    joined = latest_before(joined, ids, ["pid", "handle"], "added", "registered")
    return joined.select("pid", "buffer", "valid_from", "callback_id").sort("valid_from")


def _activity(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Make the frame ``activity``; a lifecycle node is not active when it is created."""
    machine = ["pid", "state_machine"]
    created = events.table(tables, "rcl_lifecycle_state_machine_init")
    created = _with_node(created.select("time", *machine, "node_handle"), nodes, "time")
    changed = events.table(tables, "rcl_lifecycle_transition")
    changed = changed.with_columns(active=pl.col("goal_label") == "active")
    created = created.rename({"time": "created"}).select(*machine, "created", "node")
    changed = latest_before(changed, created, machine, "time", "created")
    first = created.select(time="created", pid="pid", node="node", active=pl.lit(False))
    return pl.concat([first, changed.select(first.columns)]).sort("time")


def _notes(tables: events.EventTables, callbacks: pl.DataFrame) -> tuple[str, ...]:
    notes: list[str] = []
    unknown = callbacks.filter(pl.col("kind") == "unknown", pl.col("symbol").is_null())
    for problem, pids in _problems_of_rclpy(tables):
        notes.append(
            f"callbacks of rclpy in process {pids} are inferred, not followed ({problem}): an"
            " instance begins with its message's take or its timer's call, and has no end."
        )
    if len(unknown):
        processes = ", ".join(map(str, unknown["pid"].unique().sort()))
        notes.append(
            f"{len(unknown)} callbacks (process {processes}) ran without having been registered: "
            "tracing started after the application, or their events were lost; their node, kind "
            "and topic cannot be known. Start tracing first to see them."
        )

    def some(*names: str) -> bool:
        return any(events.table(tables, name).height for name in names)

    messages = some("rmw_take", "rmw_publish")
    if messages and not some("rcl_publisher_init", "rcl_subscription_init"):
        notes.append(
            "no publisher or subscription was created during the recording: the topics of "
            "messages cannot be known, so no chain can be followed."
        )
    elif messages and not some("rcl_node_init"):
        notes.append("no node was created during the recording: names of nodes cannot be known.")
    silent = callbacks.filter(~pl.col("observed") & (pl.col("kind") == "subscription"))
    silent = silent.filter(~pl.col("topic").str.contains("/_action/", literal=True))
    notes += [
        f"{node} takes {topic} without callback events (a Python node, or a wait set): its "
        "response times cannot be known; what its thread publishes until its next take is "
        "counted as its output."
        for node, topic in silent.select("node", "topic").iter_rows()
    ]
    return tuple(notes)


def _problems_of_rclpy(tables: events.EventTables) -> list[tuple[str, str]]:
    """List why callbacks of rclpy emit no events, and in which processes."""
    failed = events.table(tables, "rclpy_followed").filter(pl.col("problem") != "")
    failed = failed.group_by("problem", maintain_order=True).agg(pl.col("pid").unique().sort())
    return [(problem, ", ".join(map(str, pids))) for problem, pids in failed.iter_rows()]


def numbered(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """Add ``callback_id``: registrations of what a person calls the same callback share one number.

    Two registrations are one callback when they belong to the same subscription (intra-process
    twins). Or when node, kind, topic, period and symbol agree and the first had ended before the
    second began: its address was used again, or its last instance had started.
    """
    missing = pl.format("unknown (process {})", "pid")
    # An address means nothing without its process, and some traces have threads only.
    callbacks = (
        callbacks.drop_nulls("pid")
        .sort("valid_from", "handle", maintain_order=True)
        .with_columns(named=pl.col("node").is_not_null(), node=pl.col("node").fill_null(missing))
    )
    identity = ["pid", "kind", "node", "topic", "period_ns", "symbol"]
    last_start = _last_starts(tables, callbacks, identity)
    latest: dict[tuple[object, ...], tuple[int, int]] = {}  # identity → (id, when it ended)
    of_subscription: dict[int, int] = {}
    ids: list[int] = []
    count = 0
    never = 1 << 63
    columns = [*identity, "subscription", "valid_from", "valid_to", "named"]
    for row, values in enumerate(callbacks.select(columns).iter_rows()):
        *key, subscription, valid_from, valid_to, named = values
        number = of_subscription.get(subscription)
        if number is None and named:
            previous, ended = latest.get(tuple(key), (0, never))
            number = previous if ended <= valid_from else None
        if number is None:
            number, count = count, count + 1
        ids.append(number)
        freed = never if valid_to is None else valid_to
        latest[tuple(key)] = number, min(freed, last_start.get(row, never) + 1)
        if subscription is not None:
            of_subscription.setdefault(subscription, number)
    return callbacks.drop("named").with_columns(pl.Series("callback_id", ids, dtype=pl.UInt32))


def _last_starts(
    tables: events.EventTables, callbacks: pl.DataFrame, identity: list[str]
) -> dict[int, int]:
    """Map rows of registrations that look alike to the start of their last instance (ns)."""
    alike = callbacks.with_row_index("row").filter(pl.len().over(identity) > 1)
    if alike.is_empty():
        return {}
    owner = alike.select("row", "valid_from", "pid", callback="handle")
    starts = events.table(tables, "callback_start").select("time", "pid", "callback")
    starts = starts.join(owner.select("pid", "callback"), on=["pid", "callback"], how="semi")
    owned = latest_before(starts, owner, ["pid", "callback"], "time", "valid_from")
    last = owned.drop_nulls("row").group_by("row").agg(pl.col("time").max())
    return dict(last.select("row", "time").iter_rows())
