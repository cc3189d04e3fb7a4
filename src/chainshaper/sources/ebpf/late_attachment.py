"""Find the objects of an application that ran before tracing began, as far as possible.

Events name an object when it is created. For objects created before, these functions fill the same
tables from what else is recorded (`docs/record_ebpf.md`), and leave null what is not certain.
Handles are the real ones where events have them, else other addresses of the object; handles of
nodes are numbers from 1.
"""

from collections.abc import Iterable, Mapping, Sequence

import polars as pl

from chainshaper.linux.processes import RunningProcess, named_nodes
from chainshaper.sources.system import processes_of
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS
from chainshaper.values.recording import EndpointInfo, RecordingInfo

ADDED = (
    "rclcpp_subscription_callback_added",
    "rclcpp_timer_callback_added",
    "rclcpp_service_callback_added",
)
"""The events that make callbacks known."""

# Shares of a callback's starts.
_NEARLY_ALWAYS = 0.9
_MOSTLY = 0.5
_REGULAR = 0.25
"""A timer's start is regular if its distance from the one before is off the usual distance by no
more than this share of it."""
_FEWEST_STARTS = 4
_PERIOD_GRID_NS = 100_000  # to which measured periods are rounded

_CALLBACK = ["pid", "callback"]
_THREAD = ["time", "pid", "tid"]
_KINDS = ("publisher", "subscription")


def with_found_objects(
    tables: events.EventTables, handles: pl.DataFrame, began_ns: int
) -> tuple[events.EventTables, tuple[str, ...]]:
    """Add the publishers, subscriptions and callbacks that were created before ``began_ns``.

    Returns the tables, and a note on what was added. ``handles`` are those that events had, with
    the topic's name in their memory (see `Printed`).
    """
    handles = handles.filter(pl.col("topic").str.starts_with("/"))  # others are of the RMW itself
    publishers = _publishers(tables, handles)
    known = events.table(tables, "rcl_subscription_init")
    subscriptions = _unknown_handles(handles, "rmw_take", "rmw_subscription_handle", known)
    starts = _unregistered_starts(tables)
    # A callback that nearly always starts after a take from the same subscription is that one's.
    usual = pl.col("taken").drop_nulls().mode().first().alias("rmw_subscription_handle")
    share = (pl.col("taken") == usual).fill_null(False).mean()
    readers = (
        starts.group_by(_CALLBACK)
        .agg(usual, share=share)
        .filter(pl.col("share") >= _NEARLY_ALWAYS)
        .join(subscriptions, on=["pid", "rmw_subscription_handle"], how="semi")
    )
    timers = _timers(starts.join(readers, on=_CALLBACK, how="anti"))
    handle = pl.col("rmw_subscription_handle").alias("subscription_handle")
    readers = readers.with_columns(handle, subscription="callback")
    timers = timers.with_columns(timer_handle="callback")
    created_before = {
        "rcl_publisher_init": publishers,
        "rcl_subscription_init": subscriptions.with_columns(handle),
        **dict.fromkeys(("rclcpp_subscription_init", ADDED[0]), readers),
        **dict.fromkeys(("rcl_timer_init", ADDED[1]), timers),
    }
    if not any(rows.height for rows in created_before.values()):
        return tables, ()
    note = (
        f"tracing began while the application ran; found were publishers ({publishers.height}) and "
        f"subscriptions ({subscriptions.height}) by the topics in their memory, callbacks of "
        f"subscriptions ({readers.height}) by the messages taken before, and timers "
        f"({timers.height}) by their regularity (with measured periods). Services, and what was "
        "idle, cannot be known."
    )
    return {**tables, **added_rows(tables, created_before, began_ns)}, (note,)


def with_functions(
    tables: events.EventTables, functions: Mapping[tuple[int, int], str], began_ns: int
) -> events.EventTables:
    """Add functions of callbacks, (process, callback) → function, to `rclcpp_callback_register`.

    Those that the table has already stay. A new row has the time at which its callback was added.
    """
    named = pl.DataFrame(
        [(*callback, symbol) for callback, symbol in functions.items()],
        schema={"pid": pl.Int32, "callback": pl.UInt64, "symbol": pl.String},
        orient="row",
    )
    added = pl.concat([events.table(tables, name).select("time", *_CALLBACK) for name in ADDED])
    latest = added.group_by(_CALLBACK).agg(pl.col("time").max())
    known = events.table(tables, "rclcpp_callback_register")
    unknown = named.join(known, on=_CALLBACK, how="anti").join(latest, on=_CALLBACK, how="left")
    return {**tables, **added_rows(tables, {"rclcpp_callback_register": unknown}, began_ns)}


def added_rows(
    tables: events.EventTables, rows: Mapping[str, pl.DataFrame], began_ns: int
) -> dict[str, pl.DataFrame]:
    """Return the tables that get new rows, without the others.

    Rows without a ``time`` become events of ``began_ns``; their thread is the process's main one.
    """
    extended = {}
    for name, new_rows in rows.items():
        if new_rows.height:
            new, known = events.table({name: new_rows}, name, ["time"]), events.table(tables, name)
            new = new.with_columns(pl.col("time").fill_null(began_ns), tid="pid")
            both = pl.concat([new, known], how="diagonal").select(known.columns)
            extended[name] = both.sort("time", maintain_order=True)
    return extended


def _unknown_handles(
    handles: pl.DataFrame, event: str, column: str, known: pl.DataFrame
) -> pl.DataFrame:
    """Return ``pid, <column>, topic_name`` of an event's handles that are not in ``known``."""
    renamed = pl.col("handle").alias(column)
    at_event = handles.filter(event=event).select("pid", renamed, topic_name="topic")
    return at_event.join(known, on=["pid", column], how="anti")


def _in_order(*frames: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of several frames in order of time."""
    return pl.concat(frames, how="diagonal").sort("time", maintain_order=True)


def _publishers(tables: events.EventTables, handles: pl.DataFrame) -> pl.DataFrame:
    """Return ``pid, publisher_handle, rmw_publisher_handle, topic_name`` of unknown publishers.

    A publisher has a handle of rcl, in `rcl_publish`, and one of rmw, in `rmw_publish`. The events
    of one message show which two belong together.
    """
    key = ["pid", "rmw_publisher_handle"]
    known = events.table(tables, "rcl_publisher_init")
    published = events.table(tables, "rcl_publish")
    written = events.table(tables, "rmw_publish", key[1:])
    pairs = (
        _in_order(
            published.select(*_THREAD, "message", "publisher_handle"),
            written.select(*_THREAD, "message", key[1]),
        )
        .with_columns(pl.col("publisher_handle").shift(1).over("pid", "tid", "message"))
        .drop_nulls([key[1], "publisher_handle"])
        .group_by(key)
        .agg(pl.col("publisher_handle").mode().first())
    )
    by_rmw = _unknown_handles(handles, "rmw_publish", key[1], known)
    by_rmw = by_rmw.join(pairs, on=key, how="left")
    by_rcl = _unknown_handles(handles, "rcl_publish", "publisher_handle", known)
    return pl.concat([by_rmw, by_rcl], how="diagonal")


def _unregistered_starts(tables: events.EventTables) -> pl.DataFrame:
    """Return the starts of callbacks whose creation was not traced.

    Columns:

    * ``time``: when it started (ns)
    * ``pid``, ``callback``
    * ``taken``: the rmw handle of the subscription from which the thread had taken a message right
      before; null if it had not
    """
    takes = events.table(tables, "rmw_take", ["taken"]).filter(pl.col("taken").fill_null(1) != 0)
    starts = events.table(tables, "callback_start", ["is_intra_process"])
    rows = _in_order(
        takes.select(*_THREAD, handle="rmw_subscription_handle"),
        starts.select(*_THREAD, "callback", "is_intra_process"),
        events.table(tables, "callback_end").select(*_THREAD),
    ).with_columns(taken=pl.col("handle").shift(1).over("pid", "tid"))
    rows = rows.drop_nulls("callback").filter(pl.col("is_intra_process").fill_null(0) == 0)
    registered = pl.concat(events.table(tables, name).select(_CALLBACK) for name in ADDED)
    return rows.join(registered, on=_CALLBACK, how="anti").select("time", *_CALLBACK, "taken")


def _timers(starts: pl.DataFrame) -> pl.DataFrame:
    """Return ``pid, callback, period`` of callbacks that start regularly without a message."""
    gaps = starts.sort("time").with_columns(gap=pl.col("time").diff().over(_CALLBACK))
    usual = pl.col("gap").median()
    regular = (pl.col("gap") - usual).abs() <= _REGULAR * usual
    taken, period = pl.col("taken").count(), (usual / _PERIOD_GRID_NS).round() * _PERIOD_GRID_NS
    is_timer = (pl.len() >= _FEWEST_STARTS) & (taken <= (1 - _NEARLY_ALWAYS) * pl.len())
    judged = gaps.group_by(_CALLBACK).agg(
        is_timer=is_timer & (regular.mean() >= _MOSTLY),
        period=pl.when(period > 0).then(period).otherwise(usual).cast(pl.Int64),
    )
    return judged.filter("is_timer").drop("is_timer")


def with_found_nodes(
    tables: events.EventTables,
    info: RecordingInfo,
    endpoints: Sequence[EndpointInfo],
    processes: Iterable[RunningProcess],
) -> tuple[events.EventTables, RecordingInfo]:
    """Add the nodes of publishers, subscriptions and timers that have none, where it is certain.

    If in the ``endpoints`` of DDS discovery a single node publishes a topic, the publisher of that
    topic is that node's, and the node is in the publisher's process; likewise for subscriptions.
    The command lines of ``processes`` may name nodes, too. A note says what stays unknown.
    """
    created = {kind: events.table(tables, f"rcl_{kind}_init") for kind in _KINDS}
    nameless = pl.concat(
        rows.filter(pl.col("node_handle").is_null()).select("time", *_endpoint(kind))
        for kind, rows in created.items()
    )
    if nameless.is_empty():
        return tables, info
    wanted = list(nameless.drop("time").iter_rows())
    named = {process.pid: named_nodes(process.command) for process in processes}
    owners, nodes_of = _owners(wanted, endpoints, named)
    numbers = {
        (pid, node): number
        for pid, nodes in nodes_of.items()
        for number, node in enumerate(sorted(nodes), 1)
    }
    changed: dict[str, pl.DataFrame] = dict(tables)
    for kind, rows in created.items():
        keys = rows.select(*_endpoint(kind)).iter_rows()
        handles = [numbers[key[1], owners[key]] if key in owners else None for key in keys]
        if any(handles):
            node = pl.col("node_handle").fill_null(pl.Series(handles, dtype=pl.UInt64))
            changed[f"rcl_{kind}_init"] = rows.with_columns(node)
    parts = [
        (pid, number, node.rpartition("/")[0] or "/", node.rpartition("/")[2])
        for (pid, node), number in numbers.items()
    ]
    columns, known = events.column_types("rcl_node_init"), ("pid", "node_handle", "namespace")
    types = {name: columns[name] for name in (*known, "node_name")}
    nodes = pl.DataFrame(parts, schema=types, orient="row")
    new = {"rcl_node_init": nodes, "rclcpp_timer_link_node": _timer_links(changed, nodes)}
    changed |= added_rows(changed, new, min(nameless["time"]))
    names = processes_of(changed, info.processes)
    notes = info.notes
    if unknown := sorted({key[2] for key in wanted if key not in owners} - INTERNAL_TOPICS):
        which = f"which nodes publish or subscribe {', '.join(unknown)} is not certain"
        notes += (f"{which}: neither the ROS graph nor a command line tells.",)
    return changed, info.model_copy(update={"processes": names, "notes": notes})


def _endpoint(kind: str) -> tuple[pl.Expr, ...]:
    """Return the columns that say which endpoint a row is about: kind, process, topic."""
    return pl.lit(kind).alias("kind"), pl.col("pid"), pl.col("topic_name")


def _owners(
    wanted: Sequence[tuple[str, int, str]],
    endpoints: Iterable[EndpointInfo],
    named: Mapping[int, Sequence[str]],
) -> tuple[dict[tuple[str, int, str], str], dict[int, set[str]]]:
    """Find the nodes of endpoints.

    Returns (kind, process, topic) → node, where that is certain; and process → the nodes that are
    known to be in it. ``named`` are the nodes that command lines of processes name.
    """
    candidates: dict[tuple[str, str], set[str]] = {}
    for endpoint in endpoints:
        candidates.setdefault((endpoint.kind, endpoint.topic), set()).add(endpoint.node)
    nodes_of = {pid: set(named.get(pid, ())) for _, pid, _ in wanted}
    for kind, pid, topic in wanted:
        if len(candidates.get((kind, topic), ())) == 1:
            nodes_of[pid] |= candidates[kind, topic]
    owners = {}
    for kind, pid, topic in wanted:
        possible = candidates.get((kind, topic), nodes_of[pid])
        if len(possible) > 1:
            possible = possible & nodes_of[pid]
        if len(possible) == 1:
            (owners[kind, pid, topic],) = possible
    return owners, nodes_of


def _timer_links(tables: events.EventTables, nodes: pl.DataFrame) -> pl.DataFrame:
    """Return ``pid, timer_handle, node_handle`` of timers that no event links to a node.

    A timer is of the only node in its process, or else of the node whose publishers its callback
    uses. Timers of which neither is known are left out.
    """
    timers, linked = (events.table(tables, name) for name in (ADDED[1], "rclcpp_timer_link_node"))
    timers = timers.join(linked, on=["pid", "timer_handle"], how="anti")
    only_nodes = nodes.select("pid", only_node="node_handle").unique("pid", keep="none")
    started = events.table(tables, "callback_start")
    ended = events.table(tables, "callback_end").with_columns(callback=pl.lit(0, pl.UInt64))
    published = events.table(tables, "rcl_publish").select(*_THREAD, "publisher_handle")
    created = events.table(tables, "rcl_publisher_init")
    owners = created.select("pid", "publisher_handle", "node_handle").drop_nulls()
    called = [frame.select(*_THREAD, "callback") for frame in (started, ended)]
    # Callback → the node whose publishers it uses most often.
    publishing = (
        _in_order(*called, published)
        .with_columns(pl.col("callback").forward_fill().over("pid", "tid"))
        .drop_nulls(["publisher_handle", "callback"])
        .filter(pl.col("callback") != 0)
        .join(owners, on=["pid", "publisher_handle"])
        .group_by(_CALLBACK)
        .agg(pl.col("node_handle").mode().first())
    )
    return (
        timers.join(only_nodes, on="pid", how="left")
        .join(publishing, on=_CALLBACK, how="left")
        .select("pid", "timer_handle", node_handle=pl.coalesce("only_node", "node_handle"))
        .drop_nulls("node_handle")
    )
