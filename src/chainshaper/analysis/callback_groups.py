"""Which callback groups a recording shows, where each has a thread of its own.

No event of ROS 2 tells of callback groups. A process of callback_isolated_executor announces its
own on a topic (:data:`~chainshaper.values.callback_groups.ANNOUNCEMENTS`), and then what one
executor ran is one group. What never ran may be in any group. But what rclcpp makes itself for
every node, its parameter services and the subscription of /parameter_events, is in the node's
default group, whose thread is known once it has run any of that.
"""

from collections import Counter, defaultdict
from typing import NamedTuple

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.latency import RecordedExecutor, executors
from chainshaper.analysis.objects import endpoints
from chainshaper.values.application import INTERNAL_SERVICES, INTERNAL_TOPICS
from chainshaper.values.callback_groups import ANNOUNCEMENTS, CallbackGroup, sorted_group

_ACTION = "/_action/"
"""Part of the names of what an action has: it is one waitable, which no id names."""
_KINDS = {"subscription": "Subscription", "service": "Service", "client": "Client"}


class RecordedGroup(NamedTuple):
    """A callback group with a thread of its own, or with several if it is reentrant."""

    group: CallbackGroup
    pid: int
    tids: tuple[int, ...]
    callbacks: frozenset[int]  # their ids
    names: tuple[str, ...]  # of timers and subscriptions, as plans name them
    # Whether the id is theirs for sure: nothing of the node is left that may be in this group.
    certain: bool


def recorded_groups(flow: DataFlow) -> tuple[RecordedGroup, ...]:
    """Find the callback groups of all processes that announce theirs, in order of their ids."""
    announcing = flow.objects.publishers.filter(pl.col("topic").cast(pl.String) == ANNOUNCEMENTS)
    pids = {*announcing["pid"].to_list()}
    if not pids:
        return ()
    made = defaultdict[tuple[int, str], Counter[str]](Counter)  # by process and node
    ends = endpoints(flow.events).select("pid", "node", "role", "topic")
    for pid, node, role, name in ends.iter_rows():
        if role in _KINDS and pid in pids and _ACTION not in name:
            made[pid, node][f"{_KINDS[role]}({name})"] += 1
    entry_of = dict[int, str]()  # by the callback's id
    columns = ("callback_id", "pid", "node", "kind", "topic", "declared_ns")
    callbacks = flow.objects.callbacks.select(columns)
    for number, pid, node, kind, name, period in callbacks.iter_rows():
        if kind == "timer" and period is not None:
            entry_of[number] = f"Timer({period})"
            if pid in pids:
                made[pid, node][entry_of[number]] += 1
        elif kind in _KINDS and name is not None and _ACTION not in name:
            entry_of[number] = f"{_KINDS[kind]}({name})"
    of_nodes = defaultdict[tuple[int, str], list[RecordedExecutor]](list)
    for executor in executors(flow):
        nodes = {node for of_thread in executor.threads.values() for node in of_thread}
        if executor.pid in pids and len(nodes) == 1:
            of_nodes[executor.pid, nodes.pop()].append(executor)
    groups = [
        group
        for (pid, node), of_node in of_nodes.items()
        for group in _groups_of(node, of_node, made[pid, node], entry_of)
    ]
    return tuple(sorted(groups, key=lambda group: (group.group.id, group.pid)))


def _groups_of(
    node: str,
    executors_of_node: list[RecordedExecutor],
    made: Counter[str],
    entry_of: dict[int, str],
) -> list[RecordedGroup]:
    """Return the groups of a node; ``made`` are all entries that it has."""
    entries = [
        [entry_of[number] for number in sorted(executor.callbacks) if number in entry_of]
        for executor in executors_of_node
    ]
    left = made - Counter(entry for of_executor in entries for entry in of_executor)
    left -= Counter({"Subscription(/clock)": left["Subscription(/clock)"]})  # a group by itself
    by_default = Counter({entry: many for entry, many in left.items() if _is_internal(entry)})
    default = [any(map(_is_internal, of_executor)) for of_executor in entries]
    certain = not left - by_default and (not by_default or sum(default) == 1)
    return [
        RecordedGroup(
            sorted_group(node, [*of_executor, *(by_default.elements() if is_default else ())]),
            executor.pid,
            tuple(executor.threads),
            executor.callbacks,
            tuple(name for owner, name in executor.names if owner == node),
            certain,
        )
        for executor, of_executor, is_default in zip(
            executors_of_node, entries, default, strict=True
        )
    ]


def _is_internal(entry: str) -> bool:
    """Whether rclcpp makes this itself for every node, in the node's default group."""
    kind, _, name = entry.removesuffix(")").partition("(")
    if kind == "Service":
        return name.rpartition("/")[2] in INTERNAL_SERVICES
    return kind == "Subscription" and name in INTERNAL_TOPICS - {"/clock"}
