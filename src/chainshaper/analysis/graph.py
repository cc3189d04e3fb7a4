"""The application graph of a recording: callbacks connected by topics (paper, section 2.1).

A callback is connected to a topic that its instances publish. Some messages, however, are read
in one callback and published in another of the same node:

* **Synchronising callbacks** (message_filters) read in one instance and publish in that of the
  input which completes the set. The library emits no events of its own. A subscription callback
  is taken to be such an input of topic X when another subscription callback of its node publishes
  X, subscribes to another topic, and it either is registered by message_filters (its symbol says
  so) or publishes nothing itself.
* **Stored messages**: a subscription callback that publishes nothing, in a node whose
  subscription callbacks publish nothing at all, but whose timers do, is taken to store the
  message for the timers.

Both are inferences, so they are marked: such topics stand in ``Callback.publishes`` (the chain
goes on there) and also in ``Callback.passes_on``.
"""

from dataclasses import dataclass
from typing import Any

import polars as pl

from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.analysis.matching import latest_before
from chainshaper.analysis.objects import named_nodes
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Callback, Node

__all__ = [
    "INTERNAL_TOPICS",
    "MESSAGE_FILTER",
    "ApplicationDescription",
    "application_graph",
    "goes_on_elsewhere",
    "graph_of",
    "services",
]

MESSAGE_FILTER = "message_filters::"
"""What the symbols of callbacks that message_filters registered contain."""


def application_graph(tables: events.EventTables) -> ApplicationGraph:
    """The graph of callbacks and topics that the events of a recording show.

    Callback ids are those of the analysis frames. See the module's description for the topics
    that a callback is said to publish.
    """
    return graph_of(data_flow(tables))


def graph_of(flow: DataFlow) -> ApplicationGraph:
    """The application graph of a recording whose data flow is known already."""
    callbacks = flow.objects.callbacks.unique("callback_id", maintain_order=True)
    callbacks = callbacks.sort("callback_id")
    writes = _direct(flow)
    passed = _passed_on(callbacks, writes)
    return ApplicationGraph(
        nodes=tuple(
            Node(name, pid)
            for name, pid in flow.objects.nodes.select("node", "pid")
            .unique(maintain_order=True)
            .iter_rows()
        ),
        callbacks=tuple(
            Callback(
                id=row["callback_id"],
                kind=row["kind"],
                node=row["node"],
                pid=row["pid"],
                handle=row["handle"],
                topic=row["topic"],
                period_ns=row["period_ns"],
                symbol=row["symbol"],
                publishes=tuple(
                    sorted({*writes.get(row["callback_id"], ()), *passed[row["callback_id"]]})
                ),
                passes_on=tuple(sorted(passed[row["callback_id"]])),
            )
            for row in callbacks.iter_rows(named=True)
        ),
        publishers=_by_topic(flow.objects.publishers),
        subscribers=_by_topic(flow.objects.subscriptions),
    )


def _direct(flow: DataFlow) -> dict[int, set[str]]:
    """Callback id → topics published inside its instances."""
    pairs = (
        flow.publications.lazy()
        .drop_nulls(["callback_id", "topic"])
        .select("callback_id", "topic")
        .unique()
        .collect()
    )
    writes: dict[int, set[str]] = {}
    for callback_id, topic in pairs.iter_rows():
        writes.setdefault(callback_id, set()).add(topic)
    return writes


def _passed_on(callbacks: pl.DataFrame, writes: dict[int, set[str]]) -> dict[int, set[str]]:
    """Callback id → topics that a sibling of its node publishes for it."""
    passed: dict[int, set[str]] = {number: set() for number in callbacks["callback_id"]}
    known = callbacks.filter(pl.col("kind") != "unknown")
    for group in known.partition_by("pid", "node", maintain_order=True):
        rows = list(group.iter_rows(named=True))
        outputs = {
            kind: {
                row["callback_id"]: writes.get(row["callback_id"], set()) - INTERNAL_TOPICS
                for row in rows
                if row["kind"] == kind
            }
            for kind in ("subscription", "timer")
        }
        by_inputs = set().union(*outputs["subscription"].values())
        by_timers = set().union(*outputs["timer"].values())
        for row in rows:
            if row["kind"] != "subscription" or row["topic"] in {None, *INTERNAL_TOPICS}:
                continue
            own = outputs["subscription"][row["callback_id"]]
            filtered = MESSAGE_FILTER in (row["symbol"] or "")
            if by_inputs and (filtered or not own):
                passed[row["callback_id"]] = _of_other_topics(row, rows, outputs) - own
            elif not by_inputs:
                passed[row["callback_id"]] = by_timers
    return passed


def _of_other_topics(
    row: dict[str, Any], rows: list[dict[str, Any]], outputs: dict[str, dict[int, set[str]]]
) -> set[str]:
    """What subscriptions to other topics publish: no callback synchronises a topic with itself."""
    siblings = [other for other in rows if other["topic"] != row["topic"]]
    return set().union(*(outputs["subscription"].get(o["callback_id"], ()) for o in siblings))


def _by_topic(endpoints: pl.DataFrame) -> dict[str, tuple[str, ...]]:
    """Topic → names of the nodes that have such an endpoint."""
    named = endpoints.drop_nulls(["topic", "node"]).select("topic", "node").unique()
    grouped = named.sort("topic", "node").group_by("topic", maintain_order=True).agg("node")
    return {topic: tuple(nodes) for topic, nodes in grouped.iter_rows()}


def goes_on_elsewhere(graph: ApplicationGraph, callback: Callback, topic: str) -> bool:
    """Whether what ``callback`` reads may leave on ``topic`` through another of its node.

    So it is for callbacks that pass the topic on and, since the last input completes a set, for
    the siblings that publish it. Where each of several callbacks publishes the topic, they are
    inputs of one synchroniser if message_filters registered them, or if nothing is known about
    who did; otherwise they publish independently.
    """
    if callback.kind != "subscription":
        return False
    siblings = [
        other
        for other in graph.callbacks
        if other.id != callback.id
        and (other.pid, other.node) == (callback.pid, callback.node)
        and topic in other.publishes
    ]
    if topic in callback.passes_on or any(topic in other.passes_on for other in siblings):
        return True
    filtered = callback.symbol is None or MESSAGE_FILTER in callback.symbol
    return filtered and any(other.kind == "subscription" for other in siblings)


@dataclass(frozen=True)
class ApplicationDescription:
    """Everything that a picture of an application shows.

    ``services`` is the frame of :func:`services`; ``lost`` and ``notes`` are what a reader must
    know about how complete it is.
    """

    graph: ApplicationGraph
    services: pl.DataFrame
    lost: dict[str, int]
    notes: tuple[str, ...]


def services(tables: events.EventTables) -> pl.DataFrame:
    """All services: ``service, role, node, pid``, one row per server and client."""
    nodes = named_nodes(tables).rename({"handle": "node_handle", "valid_from": "created"})
    found = []
    for role, name in (("server", "rcl_service_init"), ("client", "rcl_client_init")):
        ends = events.table(tables, name).select(
            "time", "pid", "node_handle", service="service_name", role=pl.lit(role)
        )
        joined = latest_before(ends, nodes, ["pid", "node_handle"], "time", "created")
        found.append(joined.select("service", "role", "node", "pid"))
    return pl.concat(found).unique().sort("service", "role", "node", "pid")
