"""The application graph of a recording: callbacks connected by topics (paper, section 2.1).

A callback is connected to a topic that its instances publish. Some messages are read in one
callback and published in another of the same node:

* **Synchronising callbacks** (message_filters) read a message each; the one whose message completes
  the set publishes. No event shows that. A subscription callback counts as an input of topic X when
  another subscription callback of its node publishes X and subscribes to another topic, and
  message_filters registered this one (its symbol says so) or it publishes nothing itself.
* **A synchroniser that the application wrote** stores its latest inputs, and publishes in the
  callback of whichever comes last. Several subscription callbacks of a node that publish topic X
  are its inputs when each of them ran as often as X was published: ``Callback.in_turns``.
* **An action's goal** leads to the feedback that its server's node publishes next.
* **Stored messages**: in a node whose subscription callbacks publish nothing at all, but whose
  timers or loops do, a subscription callback stores its message for these. A loop that the user
  named also reads what such callbacks of other nodes of its process stored.
* **What the user declares** (`--through`): messages of a topic go into another topic's, which any
  callback of the same process publishes.

All of these but the last are inferences. A topic that only another callback publishes for this one
stands in ``Callback.publishes`` and also in ``passes_on``.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow, data_flow
from chainshaper.analysis.messages import gate_decisions
from chainshaper.analysis.objects import endpoints
from chainshaper.values import events
from chainshaper.values.application import (
    INTERNAL_TOPICS,
    LOOP_ENDS,
    ApplicationGraph,
    Callback,
    Node,
)
from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError

MESSAGE_FILTER = "message_filters::"
"""This stands in the symbols of callbacks that message_filters registered."""


def application_graph(tables: events.EventTables) -> ApplicationGraph:
    """Make the graph of callbacks and topics that events show; ids are those of the data flow."""
    return graph_of(data_flow(tables))


def graph_of(flow: DataFlow, doubts: list[str] | None = None) -> ApplicationGraph:
    """Make the application graph of a data flow.

    With ``doubts``, what the user declared and cannot be here is left out, and why is added to
    them. Else raises InputError: a declaration cannot be.
    """
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
    named_loops = defaultdict[int, list[Callback]](list)
    for callback in callbacks:
        if is_named_loop(callback):
            named_loops[callback.pid].append(callback)
    through, handed = list[tuple[str, str]](), defaultdict[int, set[str]](set)
    for declared in flow.through:
        try:
            pair, readers = _handed_over(callbacks, flow, *declared)
        except InputError as error:
            if doubts is None:
                raise
            doubts.append(str(error))
            continue
        through.append(pair)
        for number in readers:
            handed[number].add(pair[1])
    created = flow.objects.nodes.select("node", "pid").unique(maintain_order=True).iter_rows()
    nodes = dict.fromkeys((node, last.get((node, pid), pid)) for node, pid in created)
    complete = []
    for callback in callbacks:
        siblings = of_node[callback.pid, callback.node]
        passed = _passed_on(callback, siblings, named_loops[callback.pid]) | handed[callback.id]
        sets = ({*callback.publishes, *passed}, passed, turns[callback.id])
        publishes, passes_on, in_turns = (tuple(sorted(topics)) for topics in sets)
        complete.append(
            replace(callback, publishes=publishes, passes_on=passes_on, in_turns=in_turns)
        )
    return ApplicationGraph(
        nodes=tuple(Node(name, pid, earlier[name, pid]) for name, pid in nodes),
        callbacks=tuple(complete),
        publishers=_by_topic(flow.objects.publishers),
        subscribers=_by_topic(flow.objects.subscriptions),
        through=tuple(through),
    )


def with_possible_hand_overs(flow: DataFlow) -> tuple[DataFlow, tuple[str, ...]]:
    """Leave out what was declared and cannot be in a recording; say why of each declaration."""
    if not flow.through:
        return flow, ()
    doubts = list[str]()
    return replace(flow, through=graph_of(flow, doubts).through), tuple(doubts)


def _handed_over(
    callbacks: Sequence[Callback], flow: DataFlow, read: str, written: str
) -> tuple[tuple[str, str], list[int]]:
    """Return what a declaration says of a recording, and the ids of callbacks that hand over.

    That is the declaration itself; where ``written`` is an output that is shaped here, its
    messages go into what its shaping node reads. ``callbacks`` publish what their own instances
    did. Raises InputError: it cannot be, since a topic is not there, or nobody in a process has
    both.
    """
    declared = f"--through {read}={written}"
    for topic, ends in ((read, flow.objects.subscriptions), (written, flow.objects.publishers)):
        known = {*ends["topic"].cast(pl.String).drop_nulls()} - INTERNAL_TOPICS
        if topic not in known:
            doing = "reads" if topic == read else "publishes"
            close = close_names(topic, known)
            remedy = f"did you mean {' or '.join(close)}?" if close else "see `graph`"
            raise InputError(f"{declared}: no node of the recording {doing} {topic}; {remedy}")
    writers = [c for c in callbacks if written in c.publishes]
    gates = _gates(flow)
    if inputs := [c.topic for c in writers if c.id in gates and c.topic]:
        written = inputs[0]
        writers = [c for c in callbacks if written in c.publishes]
    readers_of = [c for c in callbacks if c.kind == "subscription" and c.topic == read]
    handing = [c.id for c in readers_of if any(w.pid == c.pid and w.id != c.id for w in writers)]
    if readers_of and writers and not handing:
        ways = [
            ", ".join(sorted({f"{c.node} (process {c.pid})" for c in ends}))
            for ends in (readers_of, writers)
        ]
        raise InputError(
            f"{declared}: {ways[0]} reads {read}, {ways[1]} publishes {written}, and these are"
            " not in one process, or one callback does both: what a callback publishes itself"
            " needs no declaration, and what goes from process to process is a message; name"
            " the topic in between, or the nodes of one process"
        )
    return (read, written), handing


def _gates(flow: DataFlow) -> set[int]:
    """Return the ids of callbacks that a gate's log is about: those of shaping nodes."""
    if "gate_release" not in flow.events:
        return set()
    return {*gate_decisions(flow.events, flow.objects)["callback_id"].drop_nulls()}


def is_named_loop(callback: Callback) -> bool:
    """Return whether a callback is a loop that is known by name: its instances' ends are messages.

    The user named it, or it is a controller manager of ros2_control.
    """
    ends = {callback.node + ending for ending in LOOP_ENDS}
    return callback.kind == "loop" and not ends.isdisjoint(callback.publishes)


def readers(graph: ApplicationGraph, callback: Callback, topic: str) -> list[Callback]:
    """Return the timers and loops that publish ``topic`` from what ``callback`` stored.

    Where the user declared that its messages go there, it is whatever callback publishes it.
    """
    if (callback.topic, topic) in graph.through:
        return [
            reader
            for reader in graph.callbacks
            if topic in {*reader.publishes} - {*reader.passes_on}
            and reader.pid == callback.pid
            and reader.id != callback.id
        ]
    return [
        reader
        for reader in graph.callbacks
        if reader.kind in ("timer", "loop")
        and topic in reader.publishes
        and reader.pid == callback.pid
        and (reader.node == callback.node or is_named_loop(reader))
    ]


def _passed_on(
    callback: Callback, siblings: list[Callback], named_loops: list[Callback]
) -> set[str]:
    """Return the topics that other callbacks of its node publish for a callback.

    ``named_loops`` are those of its process.
    """
    published_itself = set(callback.publishes)
    if callback.kind == "service":  # an action's: a thread of the goal publishes as a rule
        action, goal, _ = (callback.topic or "").partition("/_action/send_goal")
        published = {topic for sibling in siblings for topic in sibling.publishes}
        return {f"{action}/_action/feedback"} & published - published_itself if goal else set()
    if callback.kind != "subscription" or callback.topic in {None, *INTERNAL_TOPICS}:
        return set()
    if not _outputs(siblings, "subscription"):
        of_siblings = _outputs(siblings, "timer") | _outputs(siblings, "loop")
        return of_siblings | _outputs(named_loops, "loop")
    if MESSAGE_FILTER in (callback.symbol or "") or not published_itself - INTERNAL_TOPICS:
        of_other_topics = [sibling for sibling in siblings if sibling.topic != callback.topic]
        return (
            _outputs(of_other_topics, "subscription") - published_itself
        )  # none synchronises a topic with itself
    return set()


def _in_turns(flow: DataFlow, nodes: Iterable[list[Callback]]) -> dict[int, set[str]]:
    """Map callbacks to the topics that they publish in turns with others of their node.

    They are inputs of a synchroniser: by the k-th publication since the first, each of them has run
    at least k times, which is not so of callbacks that publish independently. An instance that
    begins while the set is being published may be part of it: of two that begin at the same time on
    two threads, either may complete the set.
    """
    topics_of = defaultdict[int, set[str]](set)
    for callbacks in nodes:
        for topic in _outputs(callbacks, "subscription"):
            writers = [
                c for c in callbacks if topic in c.publishes and c.kind not in ("loop", "unknown")
            ]
            inputs = {writer.topic for writer in writers if writer.kind == "subscription"}
            if len(writers) < 2 or len(inputs) < len(writers):
                continue  # a single writer, or a timer among them, or two inputs of one topic
            ids = [writer.id for writer in writers]
            of_writers = flow.publications.filter(pl.col("callback_id").is_in(ids), topic=topic)
            written = of_writers.join(flow.instances, on="instance").sort("start")
            if len(written) < 2:
                continue  # there is no span between two publications
            since, until = written["start"][0], written["time"][1:]
            ran = flow.instances.filter(pl.col("callback_id").is_in(ids), pl.col("start") > since)
            ran = ran.sort("start")
            starts = (ran.filter(callback_id=number)["start"] for number in ids)
            places = np.arange(1, len(written))
            if all((begun.search_sorted(until).to_numpy() >= places).all() for begun in starts):
                for number in ids:
                    topics_of[number].add(topic)
    return topics_of


def _outputs(callbacks: list[Callback], kind: str) -> set[str]:
    """Return the topics that callbacks of a kind publish."""
    topics = {
        topic for callback in callbacks if callback.kind == kind for topic in callback.publishes
    }
    return topics - INTERNAL_TOPICS


def _by_topic(endpoints: pl.DataFrame) -> dict[str, tuple[str, ...]]:
    """Topic → names of the nodes that have such an endpoint."""
    named = endpoints.select("topic", "node").drop_nulls().unique().sort("topic", "node")
    grouped = named.group_by("topic", maintain_order=True).agg("node")
    return {topic: tuple(nodes) for topic, nodes in grouped.iter_rows()}


def goes_on_elsewhere(graph: ApplicationGraph, callback: Callback, topic: str) -> bool:
    """Return whether a message that ``callback`` reads may leave on ``topic`` through a sibling.

    It may where the callback passes the topic on, or publishes it in turns. It also may where a
    sibling passes the topic on, for any input may be the last of its set. Where each of several
    callbacks publishes the topic, they are inputs of one synchroniser if message_filters registered
    them, or if no event says who did; otherwise they publish independently.
    """
    if callback.kind != "subscription":
        return False
    siblings = [
        sibling
        for sibling in graph.callbacks
        if sibling.id != callback.id
        and (sibling.pid, sibling.node) == (callback.pid, callback.node)
        and topic in sibling.publishes
    ]
    if topic in {*callback.passes_on, *callback.in_turns} or any(
        topic in sibling.passes_on for sibling in siblings
    ):
        return True
    filtered = callback.symbol is None or MESSAGE_FILTER in callback.symbol
    return filtered and any(sibling.kind == "subscription" for sibling in siblings)


@dataclass(frozen=True)
class ApplicationDescription:
    """Everything that a picture of an application shows."""

    graph: ApplicationGraph
    services: pl.DataFrame  # see `services`
    lost: dict[str, int]  # number of events that are missing, by table
    notes: tuple[str, ...]  # what cannot be known, in plain words


def services(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of all services: ``service, role, node, pid``, a row per server and client."""
    roles = {"service": "server", "client": "client"}
    ends = endpoints(tables).filter(pl.col("role").is_in([*roles]))
    columns = ["service", "role", "node", "pid"]
    ends = ends.with_columns(pl.col("role").replace(roles), service="topic")
    return ends.select(columns).unique().sort(columns)
