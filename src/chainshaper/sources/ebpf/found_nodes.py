"""Which nodes the endpoints of an application belong to that ran before tracing began.

No event that is repeated names a node. Three things tell:

* DDS discovery shows which nodes publish and subscribe which topics: a topic that one node only
  publishes tells whose publisher it is, and which node lives in that process;
* the command line of a process names nodes (remap rules, which `ros2 launch` makes);
* where several nodes have a topic (`/rosout`), the one that is known to live in that process.

A timer belongs to its process's only node, or to that of the publisher it uses. What is not certain
is left open. Nodes are numbered from 1, where no object's address can be.
"""

from collections.abc import Iterable, Mapping, Sequence

import polars as pl

from chainshaper.analysis.objects import INTERNAL_TOPICS
from chainshaper.linux.processes import Process, named_nodes
from chainshaper.sources.ebpf.late_attachment import added_rows
from chainshaper.sources.system import processes_of
from chainshaper.values import events
from chainshaper.values.recording import EndpointInfo, RecordingInfo

__all__ = ["with_found_nodes"]

_KINDS = ("publisher", "subscription")


def with_found_nodes(
    tables: events.EventTables,
    info: RecordingInfo,
    endpoints: Sequence[EndpointInfo],
    processes: Iterable[Process],
) -> tuple[events.EventTables, RecordingInfo]:
    """Give publishers, subscriptions and timers without a node theirs, as far as it is certain.

    ``endpoints`` are those of DDS discovery. Names of processes change with the tables, and what
    stays unknown becomes a note. Nothing changes where every endpoint has its node.
    """
    nameless = {kind: _nameless(tables, kind) for kind in _KINDS}
    began = min((t for rows in nameless.values() for t in rows["time"]), default=None)
    if began is None:
        return tables, info
    wanted = [
        (kind, pid, topic)
        for kind, rows in nameless.items()
        for pid, topic in rows.select("pid", "topic_name").iter_rows()
    ]
    named = {one.pid: named_nodes(one.command) for one in processes}
    owners, nodes_of = _owners(wanted, endpoints, named)
    numbers = {
        (pid, node): number
        for pid, nodes in nodes_of.items()
        for number, node in enumerate(sorted(nodes), 1)
    }
    changed: dict[str, pl.DataFrame] = dict(tables)
    for kind in _KINDS:
        created = events.table(tables, f"rcl_{kind}_init")
        keys = [(kind, *key) for key in created.select("pid", "topic_name").iter_rows()]
        found = [numbers[key[1], owners[key]] if key in owners else None for key in keys]
        if any(found):
            node = pl.col("node_handle").fill_null(pl.Series(found, dtype=pl.UInt64))
            changed[f"rcl_{kind}_init"] = created.with_columns(node)
    new = {
        "rcl_node_init": _node_rows(numbers),
        "rclcpp_timer_link_node": _timer_links(changed, nodes_of, numbers),
    }
    changed |= added_rows(changed, new, began)
    names = processes_of(changed, info.processes)
    notes = (*info.notes, *_about_unknown(key[2] for key in wanted if key not in owners))
    return changed, info.model_copy(update={"processes": names, "notes": notes})


def _about_unknown(topics: Iterable[str]) -> tuple[str, ...]:
    unknown = sorted(set(topics) - INTERNAL_TOPICS)
    if not unknown:
        return ()
    return (
        f"which nodes publish or subscribe {', '.join(unknown)} is not certain: neither the ROS "
        "graph nor a command line tells.",
    )


def _nameless(tables: events.EventTables, kind: str) -> pl.DataFrame:
    endpoints = events.table(tables, f"rcl_{kind}_init")
    return endpoints.filter(pl.col("node_handle").is_null()).select("time", "pid", "topic_name")


def _owners(
    wanted: Iterable[tuple[str, int, str]],
    endpoints: Iterable[EndpointInfo],
    named: Mapping[int, Sequence[str]],
) -> tuple[dict[tuple[str, int, str], str], dict[int, set[str]]]:
    """(Kind, process, topic) → node, where that is certain; process → the nodes known in it."""
    candidates: dict[tuple[str, str], set[str]] = {}
    for one in endpoints:
        candidates.setdefault((one.kind, one.topic), set()).add(one.node)
    wanted = list(wanted)
    nodes_of = {pid: set(named.get(pid, ())) for _, pid, _ in wanted}
    for kind, pid, topic in wanted:
        found = candidates.get((kind, topic), set())
        if len(found) == 1:
            nodes_of[pid] |= found
    owners = {}
    for kind, pid, topic in wanted:
        found = candidates.get((kind, topic), nodes_of[pid])
        if len(found) > 1:
            found = found & nodes_of[pid]
        if len(found) == 1:
            (owners[kind, pid, topic],) = found
    return owners, nodes_of


def _node_rows(numbers: Mapping[tuple[int, str], int]) -> pl.DataFrame:
    split = [(pid, handle, *node.rsplit("/", 1)) for (pid, node), handle in numbers.items()]
    return pl.DataFrame(
        [(pid, handle, namespace or "/", name) for pid, handle, namespace, name in split],
        schema={
            "pid": pl.Int32,
            "node_handle": pl.UInt64,
            "namespace": pl.String,
            "node_name": pl.String,
        },
        orient="row",
    )


def _timer_links(
    tables: events.EventTables,
    nodes_of: Mapping[int, set[str]],
    numbers: Mapping[tuple[int, str], int],
) -> pl.DataFrame:
    """``pid, timer_handle, node_handle`` of timers that no event links to a node."""
    timers = events.table(tables, "rclcpp_timer_callback_added").join(
        events.table(tables, "rclcpp_timer_link_node"), on=["pid", "timer_handle"], how="anti"
    )
    only = [
        (pid, numbers[pid, node])
        for pid, nodes in nodes_of.items()
        for node in nodes
        if len(nodes) == 1
    ]
    alone = pl.DataFrame(only, schema={"pid": pl.Int32, "alone": pl.UInt64}, orient="row")
    return (
        timers.join(alone, on="pid", how="left")
        .join(_publishing(tables), on=["pid", "callback"], how="left")
        .select("pid", "timer_handle", node_handle=pl.coalesce("alone", "node_handle"))
        .drop_nulls("node_handle")
    )


def _publishing(tables: events.EventTables) -> pl.DataFrame:
    """``pid, callback, node_handle``: whose publishers callbacks use, mostly."""
    starts = events.table(tables, "callback_start").select("time", "pid", "tid", "callback")
    ends = events.table(tables, "callback_end").select(
        "time", "pid", "tid", callback=pl.lit(0, pl.UInt64)
    )
    published = events.table(tables, "rcl_publish").select("time", "pid", "tid", "publisher_handle")
    owners = events.table(tables, "rcl_publisher_init").select(
        "pid", "publisher_handle", "node_handle"
    )
    rows = pl.concat([starts, ends, published], how="diagonal").sort("time", maintain_order=True)
    rows = rows.with_columns(pl.col("callback").forward_fill().over("pid", "tid"))
    inside = rows.drop_nulls(["publisher_handle", "callback"]).filter(pl.col("callback") != 0)
    return (
        inside.join(owners.drop_nulls(), on=["pid", "publisher_handle"])
        .group_by("pid", "callback")
        .agg(pl.col("node_handle").mode().first())
    )
