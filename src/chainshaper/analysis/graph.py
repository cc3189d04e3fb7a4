"""The application graph of a recording: callbacks connected by topics (paper, section 2.1).

A callback is connected to a topic that its instances publish. Some messages are read in one
callback and published in another of the same node:

* **Synchronising callbacks** (message_filters) read in one instance and publish in that of the
  input which completes the set; no event says so. A subscription callback is taken to be such an
  input of topic X when another subscription callback of its node publishes X, subscribes to another
  topic, and it either is registered by message_filters (its symbol says so) or publishes nothing.
* **A synchroniser of the application's own** keeps its latest inputs, and publishes in the callback
  of whichever comes last. Several subscription callbacks of a node that publish topic X are taken
  to be its inputs when each of them ran as often as X was published: ``Callback.in_turns``.
* **An action's goal** leads to the feedback that its server's node publishes next.
* **Stored messages**: a subscription callback in a node whose subscription callbacks publish
  nothing at all, but whose timers do, is taken to store the message for the timers.

All are inferences. What a callback never publishes itself stands in ``Callback.publishes`` and also
in ``passes_on``.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.analysis.objects import endpoints
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Callback, Node

MESSAGE_FILTER = "message_filters::"
"""What the symbols of callbacks that message_filters registered contain."""


def application_graph(tables: events.EventTables) -> ApplicationGraph:
    """The graph of callbacks (by the ids of analysis frames) and topics that events show."""
    return graph_of(data_flow(tables))


def graph_of(flow: DataFlow) -> ApplicationGraph:
    """The application graph of a recording whose data flow is known already."""
    pairs = flow.publications.lazy().select("callback_id", "topic").drop_nulls().unique()
    writes = defaultdict[int, set[str]](set)
    for callback_id, topic in pairs.collect().iter_rows():
        writes[callback_id].add(topic)
    known = flow.objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    known = known.sort("callback_id").rename({"callback_id": "id"})
    period = ("period_ns", "declared_ns")
    known = known.select("kind", "node", "pid", "handle", "topic", *period, "symbol", "id")
    last = {(node, pid): last_pid for node, pid, last_pid in flow.followed.iter_rows()}
    earlier = defaultdict[tuple[str, int], tuple[int, ...]](tuple)
    for (node, pid), last_pid in last.items():
        if pid != last_pid:
            earlier[node, last_pid] += (pid,)
    callbacks = []
    for row in known.iter_rows(named=True):
        row["pid"] = last.get((row["node"], row["pid"]), row["pid"])
        row |= {"earlier_pids": earlier[row["node"], row["pid"]]}
        callbacks.append(Callback(**row, publishes=tuple(sorted(writes[row["id"]]))))
    of_node = defaultdict[tuple[int, str], list[Callback]](list)
    for callback in callbacks:
        of_node[callback.pid, callback.node].append(callback)
    turns = _in_turns(flow, of_node.values())
    created = flow.objects.nodes.select("node", "pid").unique(maintain_order=True).iter_rows()
    nodes = dict.fromkeys((node, last.get((node, pid), pid)) for node, pid in created)
    complete = []
    for one in callbacks:
        passed = _passed_on(one, of_node[one.pid, one.node])
        sets = ({*one.publishes, *passed}, passed, turns[one.id])
        publishes, passes_on, in_turns = (tuple(sorted(topics)) for topics in sets)
        complete.append(replace(one, publishes=publishes, passes_on=passes_on, in_turns=in_turns))
    return ApplicationGraph(
        nodes=tuple(Node(name, pid, earlier[name, pid]) for name, pid in nodes),
        callbacks=tuple(complete),
        publishers=_by_topic(flow.objects.publishers),
        subscribers=_by_topic(flow.objects.subscriptions),
    )


def _passed_on(callback: Callback, siblings: list[Callback]) -> set[str]:
    """The topics that another callback of its node publishes for one."""
    own = set(callback.publishes)
    if callback.kind == "service":  # an action's: a thread of the goal publishes as a rule
        action, goal, _ = (callback.topic or "").partition("/_action/send_goal")
        published = {topic for one in siblings for topic in one.publishes}
        return {f"{action}/_action/feedback"} & published - own if goal else set()
    if callback.kind != "subscription" or callback.topic in {None, *INTERNAL_TOPICS}:
        return set()
    if not _outputs(siblings, "subscription"):
        return _outputs(siblings, "timer")
    if MESSAGE_FILTER in (callback.symbol or "") or not own - INTERNAL_TOPICS:
        others = [one for one in siblings if one.topic != callback.topic]
        return _outputs(others, "subscription") - own  # none synchronises a topic with itself
    return set()


def _in_turns(flow: DataFlow, nodes: Iterable[list[Callback]]) -> dict[int, set[str]]:
    """Which topics each callback writes in turns with others of its node, as their synchroniser.

    By the k-th publication since the first each of them has run k times: callbacks that publish
    independently of each other do not keep to that. An instance that begins while the set is being
    published may be part of it: of two that begin at once on two threads, either completes it.
    """
    found = defaultdict[int, set[str]](set)
    for callbacks in nodes:
        for topic in _outputs(callbacks, "subscription"):
            writers = [c for c in callbacks if topic in c.publishes and c.kind != "unknown"]
            inputs = {one.topic for one in writers if one.kind == "subscription"}
            if len(writers) < 2 or len(inputs) < len(writers):
                continue  # one alone; or a timer publishes it too, or two callbacks of one topic do
            ids = [one.id for one in writers]
            own = flow.publications.filter(pl.col("callback_id").is_in(ids), topic=topic)
            written = own.join(flow.instances, on="instance").sort("start")
            if len(written) < 2:
                continue  # nothing lies between
            since, until = written["start"][0], written["time"][1:]
            ran = flow.instances.filter(pl.col("callback_id").is_in(ids), pl.col("start") > since)
            ran = ran.sort("start")
            starts = (ran.filter(callback_id=one)["start"] for one in ids)
            places = np.arange(1, len(written))
            if all((one.search_sorted(until).to_numpy() >= places).all() for one in starts):
                for number in ids:
                    found[number].add(topic)
    return found


def _outputs(callbacks: list[Callback], kind: str) -> set[str]:
    topics = {topic for one in callbacks if one.kind == kind for topic in one.publishes}
    return topics - INTERNAL_TOPICS


def _by_topic(endpoints: pl.DataFrame) -> dict[str, tuple[str, ...]]:
    """Topic → names of the nodes that have such an endpoint."""
    named = endpoints.select("topic", "node").drop_nulls().unique().sort("topic", "node")
    grouped = named.group_by("topic", maintain_order=True).agg("node")
    return {topic: tuple(nodes) for topic, nodes in grouped.iter_rows()}


def goes_on_elsewhere(graph: ApplicationGraph, callback: Callback, topic: str) -> bool:
    """Whether what ``callback`` reads may leave on ``topic`` through another of its node.

    So it is for callbacks that pass the topic on, or write it in turns, and, since the last input
    completes a set, for the siblings that publish it. Where each of several callbacks publishes the
    topic, they are inputs of one synchroniser if message_filters registered them, or if nothing is
    known about who did; otherwise they publish independently.
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
    if topic in {*callback.passes_on, *callback.in_turns} or any(
        topic in other.passes_on for other in siblings
    ):
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
    roles = {"service": "server", "client": "client"}
    ends = endpoints(tables).filter(pl.col("role").is_in([*roles]))
    columns = ["service", "role", "node", "pid"]
    ends = ends.with_columns(pl.col("role").replace(roles), service="topic")
    return ends.select(columns).unique().sort(columns)
