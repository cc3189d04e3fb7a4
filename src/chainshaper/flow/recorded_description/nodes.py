"""The nodes of a description, and their callbacks."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cmp_to_key, partial
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.chains import parse_chain
from chainshaper.analysis.graph import MESSAGE_FILTER
from chainshaper.flow.recorded_description.costs import delivery_times
from chainshaper.flow.recorded_description.evidence import Evidence, own_topics
from chainshaper.flow.recorded_description.timers import Expiry, blocker_of, expiry_of
from chainshaper.values.application import INTERNAL_TOPICS, LOOP_END, LOOP_ENDS, Callback
from chainshaper.values.durations import duration_text, format_duration

Numbers = npt.NDArray[np.int64]

_SHORTEST_TURN_NS = 1_000  # an instance of a described loop takes some time
_UNEXPLAINED = 0.05  # the share of a synchroniser's sets that may be completed by chance elsewhere


@dataclass
class DescribedCallback:
    """A callback in the description's words."""

    ids: tuple[int, ...]  # of the callbacks that it stands for
    values: dict[str, Any]
    before: int | None = None  # the timer that goes first where both are due


@dataclass
class DescribedNode:
    """A node as it will be described."""

    callbacks: list[DescribedCallback] = field(default_factory=list)
    deliveries: dict[str, Numbers] = field(default_factory=dict)  # by topic (ns)
    values: dict[str, Any] = field(default_factory=dict)  # but for its callbacks
    stored: list[int] = field(default_factory=list)  # callbacks that store what its loop reads

    @property
    def ids(self) -> list[int]:
        """Those of all its callbacks."""
        return [number for callback in self.callbacks for number in callback.ids]

    @property
    def loop(self) -> DescribedCallback | None:
        """Its loop, which has a thread of its own; None: it has none."""
        return next((callback for callback in self.callbacks if "loop" in callback.values), None)

    @property
    def of_executor(self) -> list[int]:
        """Ids of the callbacks that its executor runs; of a node with a loop alone, the loop's."""
        loop = () if self.loop is None else self.loop.ids
        ids = [number for number in self.ids if number not in loop]
        return [*ids, *self.stored] or self.ids


def described_nodes(evidence: Evidence) -> dict[str, DescribedNode]:
    """Return the nodes with the callbacks that ran, in the order of the graph."""
    loops = _loops(evidence)
    seen = {
        store.id
        for loop, stores in loops.items()
        for store in stores
        if store.node == evidence.callbacks[loop].node
    }
    chosen: list[tuple[int, ...]] = []
    for callback in evidence.callbacks.values():
        if callback.id in seen or not (callback.id in loops or _describable(callback)):
            continue
        members = _inputs(evidence, callback)
        seen |= {*members}
        if len(evidence.instances(members)) >= 2:
            chosen.append(members)
    ran = [evidence.callbacks[number] for members in chosen for number in members]
    published = {topic for callback in ran for topic in own_topics(callback)}
    names = _names(evidence, ran)
    nodes: dict[str, DescribedNode] = {}
    for members in chosen:
        first = evidence.callbacks[members[0]]
        node = nodes.setdefault(names[first.node, first.pid], DescribedNode())
        stores = loops.get(first.id)
        described = (
            _described(evidence, node, members, published)
            if stores is None
            else _described_loop(evidence, node, first, stores, published)
        )
        node.callbacks.append(described)
    for node in nodes.values():
        _sort_by_turn(evidence, node)
    calls = {
        str(callback.topic)
        for callback in evidence.callbacks.values()
        if callback.kind in ("service", "client") and callback.publishes
    }
    if calls:
        evidence.notes.append(
            f"Services and their clients ({', '.join(sorted(calls))}) are left out: a description"
            " has topics only."
        )
    return nodes


def _names(evidence: Evidence, ran: Sequence[Callback]) -> dict[tuple[str, int], str]:
    """Return the name in the description of each node and process: permitted there, and unique."""
    nodes = dict.fromkeys((callback.node, callback.pid) for callback in ran)
    processes = Counter(node for node, _ in nodes)
    names: dict[tuple[str, int], str] = {}
    for node, pid in nodes:
        name = re.sub(r"[^A-Za-z0-9_/]", "_", node).strip("/")
        if not re.match(r"[A-Za-z_]", name):
            name = f"node_{name}"
        if processes[node] > 1:
            name = f"{name}_{pid}"
            evidence.notes.append(
                f"{node} ran in {processes[node]} processes at once: that in process {pid} is"
                f" {name} in the description."
            )
        alike = name
        for number in count(2):
            if name not in names.values():
                break
            name = f"{alike}_{number}"
        if processes[node] == 1 and name != node.strip("/"):
            evidence.notes.append(
                f"{node} is no name of a node in a description: it is {name} there."
            )
        names[node, pid] = name
    return names


def described_chain(evidence: Evidence, nodes: Mapping[str, DescribedNode]) -> str:
    """Return the chain by the names that its nodes have in the description."""
    named = dict[str, str]()
    for name, node in nodes.items():
        first = evidence.callbacks[node.ids[0]]
        for known_by in (first.node, *(f"{first.node}@{pid}" for pid in first.processes)):
            named |= {known_by: f"/{name}", known_by.removeprefix("/"): f"/{name}"}
    topics = {topic for callback in evidence.callbacks.values() for topic in callback.publishes}
    points = parse_chain(evidence.chain.spec)
    return "..".join(_point(point, topics, named) for point in points)


def _point(point: str, topics: Collection[str], named: Mapping[str, str]) -> str:
    """Return a chain's way point by the name that it has in the description."""
    for ending in LOOP_ENDS:  # in a description, that of a controller manager is a loop's as well
        if point.endswith(ending):
            node = point.removesuffix(ending)
            return named.get(node, node) + LOOP_END
    return point if {point, f"/{point}"} & {*topics} else named.get(point, point)


def _loops(evidence: Evidence) -> dict[int, list[Callback]]:
    """Return the loops that a description can have, with the callbacks that store what they read.

    They have a period, and an output or an input. A node has one loop there: others are described
    as timers.
    """
    loops = dict[int, list[Callback]]()
    nodes = set[tuple[str, int]]()
    for loop in evidence.callbacks.values():
        if loop.kind != "loop" or not loop.period_ns:
            continue
        stores = [
            store
            for store in evidence.callbacks.values()
            if (store.kind, store.pid) == ("subscription", loop.pid)
            and store.topic not in INTERNAL_TOPICS
            and {*store.passes_on}.intersection(loop.publishes)
        ]
        if (loop.node, loop.pid) in nodes or not (stores or own_topics(loop)):
            continue
        nodes.add((loop.node, loop.pid))
        loops[loop.id] = list({store.topic: store for store in stores}.values())
    return loops


def _described_loop(
    evidence: Evidence,
    node: DescribedNode,
    loop: Callback,
    stores: Sequence[Callback],
    published: Collection[str],
) -> DescribedCallback:
    """Describe a loop, and what it reads: ``stores`` are the callbacks that store its inputs."""
    instances = evidence.instances([loop.id])
    described = DescribedCallback((loop.id,), {})
    timing = _timer_values(evidence, described, loop, instances)
    described.values["loop"] = timing.pop("timer")
    described.values |= timing
    reads = [store for store in stores if store.topic in published]
    if unknown := [str(store.topic) for store in stores if store.topic not in published]:
        evidence.notes.append(
            f"{loop.label} also reads {', '.join(unknown)}, which nothing described publishes: it"
            " does not in the description."
        )
    for store in reads:
        _instances_by_message(evidence, node, store)
    if reads:
        described.values["reads"] = [str(store.topic) for store in reads]
    node.stored += [store.id for store in reads]
    rows: Numbers = instances["instance"].to_numpy().astype(np.int64)
    before, after = _execution_times(evidence, loop, rows)
    described.values["execution"] = before.clip(_SHORTEST_TURN_NS)
    if topics := own_topics(loop):
        described.values["publishes"] = topics
        if after.any():
            described.values["afterwards"] = after
        if silent := int(instances["published"].null_count()):
            evidence.notes.append(
                f"{loop.label} published nothing in {silent} of {len(instances)} instances: in the"
                " description it publishes in all."
            )
    return described


def _describable(callback: Callback) -> bool:
    """Return whether a description can have a callback: a timer, a subscription, or a driver."""
    if callback.kind in ("loop", "unknown"):
        return bool(own_topics(callback))
    return callback.kind in ("timer", "subscription") and callback.topic not in INTERNAL_TOPICS


def _inputs(evidence: Evidence, callback: Callback) -> tuple[int, ...]:
    """Return the callback, with the other inputs of the synchroniser that it is an input of."""
    of_node = (callback.pid, callback.node, "subscription")
    siblings = [
        sibling
        for sibling in evidence.callbacks.values()
        if (sibling.pid, sibling.node, sibling.kind) == of_node
        and sibling.topic not in INTERNAL_TOPICS
    ]
    through = {*callback.in_turns}
    if callback.symbol is None or MESSAGE_FILTER in callback.symbol:
        through |= {*callback.publishes}
    through -= INTERNAL_TOPICS
    together = [sibling for sibling in siblings if through.intersection(sibling.publishes)]
    distinct = len({sibling.topic for sibling in together}) == len(together) > 1
    if callback.kind != "subscription" or not distinct:
        return (callback.id,)
    ids = (sibling.id for sibling in together)
    return tuple(sorted(ids, key=cmp_to_key(partial(_turn, evidence))))


def _turn(evidence: Evidence, first: int, second: int) -> int:
    """Compare two callbacks: which an executor looks at first, as far as it was seen."""
    return evidence.first.get((second, first), 0) - evidence.first.get((first, second), 0)


def _described(
    evidence: Evidence, node: DescribedNode, members: tuple[int, ...], published: set[str]
) -> DescribedCallback:
    """Describe a callback, or a synchroniser with several inputs.

    ``published`` are the topics that described callbacks publish.
    """
    callbacks = [evidence.callbacks[number] for number in members]
    topics = list(dict.fromkeys(topic for callback in callbacks for topic in own_topics(callback)))
    read = [str(callback.topic) for callback in callbacks]
    instances = evidence.instances(members)
    described = DescribedCallback(members, {})
    rows: Numbers = instances["instance"].to_numpy().astype(np.int64)
    if callbacks[0].kind == "subscription" and published.issuperset(read):
        orders = [_instances_by_message(evidence, node, callback) for callback in callbacks]
        rows = orders[0]
        described.values = {"subscription": read[0]}
        if len(read) > 1:
            described.values = {"synchronises": read}
            if (trigger := _trigger(instances, members)) is not None:
                described.values["triggered_by"] = evidence.callbacks[trigger].topic
            rows = instances.drop_nulls("published")["instance"].to_numpy().astype(np.int64)
    else:
        described.values = _timer_values(evidence, described, callbacks[0], instances)
    before, after = _execution_times(evidence, callbacks[0], rows)
    described.values["execution"] = before
    if topics:
        described.values["publishes"] = topics
        if after.any():
            described.values["afterwards"] = after
        if len(members) == 1 and (silent := int(instances["published"].null_count())):
            evidence.notes.append(
                f"{callbacks[0].label} published nothing in {silent} of {len(instances)}"
                " executions: in the description it publishes in all."
            )
    return described


def _trigger(instances: pl.DataFrame, members: Sequence[int]) -> int | None:
    """Return the input of a synchroniser whose messages complete all sets, if they need not.

    None: a wait for a message of each input explains which messages complete the sets. That is
    tried: which would have completed them by the order in which messages came?
    """
    wrote = instances.drop_nulls("published")["callback_id"].unique().to_list()
    if len(wrote) != 1:
        return None
    waiting, surprises = Counter[int](), 0
    for number, published in instances.select("callback_id", "published").iter_rows():
        waiting[number] += 1
        complete = all(waiting[member] for member in members)
        if complete:
            waiting.subtract(members)
        surprises += complete != (published is not None)
    return int(wrote[0]) if surprises > _UNEXPLAINED * len(instances) else None


def _instances_by_message(evidence: Evidence, node: DescribedNode, callback: Callback) -> Numbers:
    """Return the instances of a subscription by message of its topic.

    A message that did not arrive has none (-1). Adds the topic's deliveries to the node.
    """
    topic = str(callback.topic)
    writers = [writer.id for writer in evidence.callbacks.values() if topic in own_topics(writer)]
    writing = evidence.instances(writers).select("instance")
    sent = evidence.flow.publications.filter(pl.col("topic").cast(pl.String) == topic)
    sent = sent.join(writing, on="instance", how="semi").sort("sent", nulls_last=True)
    hops = evidence.hops.filter(pl.col("callback_id") == callback.id).unique("publication")
    rows = sent.select("publication").join(
        hops, on="publication", how="left", maintain_order="left"
    )
    arrived = rows["instance"].is_not_null().to_numpy()
    if not arrived.any():
        return evidence.instances([callback.id])["instance"].to_numpy().astype(np.int64)
    rows = rows[: int(np.flatnonzero(arrived)[-1]) + 1]
    if missing := rows["instance"].null_count():
        evidence.notes.append(
            f"{missing} of {len(rows)} messages on {topic} did not reach {callback.node}: in the"
            " description all do."
        )
    node.deliveries[topic] = delivery_times(evidence, rows)
    instances: Numbers = rows["instance"].cast(pl.Int64).fill_null(-1).to_numpy()
    return instances


def _execution_times(
    evidence: Evidence, callback: Callback, instances: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the CPU time of instances up to their publication (or end), and behind it (ns)."""
    known = instances >= 0
    frame = evidence.occupation.instances[instances[known]].select("before_ns", "after_ns")
    if frame["before_ns"].null_count() == len(frame):
        evidence.notes.append(f"How long {callback.label} computes is not in the recording: 0.")
    filled = frame.select(pl.all().fill_null(pl.all().median()).fill_null(0))
    times = []
    for column in filled.columns:
        spent = np.full(len(instances), int(np.median(filled[column].to_numpy())), np.int64)
        spent[known] = filled[column].to_numpy()
        times.append(spent)
    return times[0], times[1]


def _timer_values(
    evidence: Evidence,
    described: DescribedCallback,
    callback: Callback,
    instances: pl.DataFrame,
) -> dict[str, Any]:
    """Return a timer's period and phase, in the description's words.

    A callback that nothing described triggers has those of its starts.
    """
    period, expiry_ns = _noted_expiry(evidence, callback, instances)
    if callback.kind != "timer" and callback.id not in _loops(evidence):
        evidence.notes.append(
            f"{callback.label} is started by nothing that is described: in the description a timer"
            f" starts it, every {duration_text(period)}."
        )
    blocker = blocker_of(evidence.callbacks, evidence.occupation, instances)
    if blocker is not None:
        described.before = blocker
        of_blocker = evidence.instances([blocker])
        expiry_ns = _noted_expiry(evidence, evidence.callbacks[blocker], of_blocker).at_ns
    if callback.id == evidence.origin:
        return {"timer": format_duration(period)}
    origin = evidence.callbacks[evidence.origin]
    begins_ns = _noted_expiry(evidence, origin, evidence.instances([origin.id])).at_ns
    phase = 0 if described.before == origin.id else (expiry_ns - begins_ns) % period
    values: dict[str, Any] = {"timer": format_duration(period)}
    if phase:
        values["phase"] = format_duration(phase)
    return values


def _noted_expiry(evidence: Evidence, callback: Callback, instances: pl.DataFrame) -> Expiry:
    """Return when a timer expires; note where that is not as it was declared."""
    expiry = expiry_of(callback, instances)
    if callback.declared_ns not in (None, callback.period_ns):
        # Of the period as the graph has it, before a drift is added.
        period = callback.period_ns or expiry.period_ns
        evidence.notes.append(
            f"{callback.node} has a timer that was declared with a period of"
            f" {duration_text(callback.declared_ns or 0)} and started every"
            f" {duration_text(period)}: that is its period in the description."
        )
    return expiry


def _sort_by_turn(evidence: Evidence, node: DescribedNode) -> None:
    """Put callbacks behind those that go first: executors look at them in this order."""

    def turn(first: DescribedCallback, second: DescribedCallback) -> int:
        return _turn(evidence, first.ids[0], second.ids[0])

    node.callbacks.sort(key=cmp_to_key(turn))
    for described in [*node.callbacks]:
        before = [
            place
            for place, callback in enumerate(node.callbacks)
            if described.before in callback.ids
        ]
        if before and node.callbacks.index(described) < before[0]:
            node.callbacks.remove(described)
            node.callbacks.insert(before[0], described)
