"""Cores, priorities and threads: as recorded, or as they follow from who ran when."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import polars as pl

from chainshaper.analysis.occupation import ThreadKey
from chainshaper.flow.recorded_description.evidence import Evidence
from chainshaper.flow.recorded_description.nodes import DescribedNode
from chainshaper.linux.scheduling import available_cores
from chainshaper.values import events
from chainshaper.values.recording import ThreadInfo

_DEFAULT_PRIORITY, _DDS_PRIORITY, _MOST_URGENT = 80, 90, 97
_REAL_TIME = ("SCHED_FIFO", "SCHED_RR")


def described_scheduling(evidence: Evidence, nodes: Mapping[str, DescribedNode]) -> dict[str, Any]:
    """Return the scheduling of most nodes and of DDS threads; add what differs to the nodes."""
    threads = {name: _threads(evidence, node.of_executor) for name, node in nodes.items()}
    bound = {name: _core_of(evidence, of_node) for name, of_node in threads.items()}
    priorities = _priorities(evidence, threads)
    dds = _dds_scheduling(evidence)
    free = (core for core in count() if core not in {*bound.values(), dds["core"]})
    core_of_thread = dict[ThreadKey, int]()  # an executor's that runs several nodes, or is unbound
    roaming = []
    for name, node in nodes.items():
        _add_executor(evidence, node, threads[name])
        core = bound[name]
        if core is None:
            shared = (core_of_thread.get(thread) for thread in threads[name])
            core = next((known for known in shared if known is not None), None)
            if core is None:
                core = next(free)
            roaming.append(name)
            node.values["bound"] = False
        if node.values.get("executor") == "multi_threaded":
            node.values["cores"] = _cores_of_threads(evidence, node, threads[name], core, free)
        else:
            node.values["core"] = core
            core_of_thread |= dict.fromkeys(threads[name], core)
        node.values["priority"] = priorities[name]
    _add_loops(evidence, nodes, free)
    if roaming:
        evidence.notes.append(
            f"The threads of {', '.join(roaming)} are bound to no core that the recording shows:"
            " simulated, each has a core of its own; live, they run on any."
        )
    _note_shared_executors(evidence, threads)
    cores = Counter(node.values["core"] for node in nodes.values() if "core" in node.values)
    usual_core = cores.most_common(1)[0][0] if cores else dds["core"]
    usual_priority = Counter(priorities.values()).most_common(1)[0][0]
    for node in nodes.values():
        if node.values.get("core") == usual_core:
            del node.values["core"]
        if node.values["priority"] == usual_priority:
            del node.values["priority"]
    return {"executors": {"core": usual_core, "priority": usual_priority}, "dds": dds}


def _threads(evidence: Evidence, ids: Sequence[int]) -> list[ThreadKey]:
    """Return the threads that ran some callbacks."""
    ran = evidence.instances(ids).select("pid", "tid").unique(maintain_order=True)
    return [(int(pid), int(tid)) for pid, tid in ran.iter_rows()]


def _add_loops(evidence: Evidence, nodes: Mapping[str, DescribedNode], free: Iterator[int]) -> None:
    """Add core and priority of loops' threads, where they are not those of the executor."""
    looping = {name: node for name, node in nodes.items() if node.loop is not None}
    threads = {
        name: _threads(evidence, [] if node.loop is None else node.loop.ids)
        for name, node in looping.items()
    }
    said = len(evidence.notes)
    priorities = _priorities(evidence, threads) if threads else {}
    del evidence.notes[said:]  # of their nodes' executors the same was said
    for name, node in looping.items():
        if node.loop is None or {*threads[name]} <= {*_threads(evidence, node.of_executor)}:
            continue
        core = _core_of(evidence, threads[name])
        if core is None or "core" not in node.values:
            core = next(free)
        if core != node.values.get("core"):
            node.loop.values["core"] = core
        if priorities[name] != node.values["priority"]:
            node.loop.values["priority"] = priorities[name]


def _core_of(evidence: Evidence, threads: Sequence[ThreadKey]) -> int | None:
    """Return the core to which the first of some threads is bound; None: some are bound to none."""
    cores = [evidence.occupation.cores.get(thread) for thread in threads]
    return None if None in cores else cores[0]


def _priorities(evidence: Evidence, threads: Mapping[str, Sequence[ThreadKey]]) -> dict[str, int]:
    """Return each node's priority: as recorded, as the scheduler had it, or by who pre-empted whom.

    ``threads`` are those of each node.
    """
    known = {
        (thread.pid, thread.tid): _priority_of(thread) for thread in evidence.recording.info.threads
    }
    if not known:
        switches = events.table(evidence.flow.events, "sched_switch").drop_nulls("next_prio")
        seen = switches.group_by("next_tid").agg(pl.col("next_prio").mode().first())
        kernel = dict(seen.iter_rows())  # by tid: 99 minus the SCHED_FIFO priority
        known = {
            (pid, tid): max(0, 99 - kernel[tid])
            for of_node in threads.values()
            for pid, tid in of_node
            if tid in kernel
        }
    ordinary, unknown, priorities = [], [], dict[str, int]()
    for name, of_node in threads.items():
        recorded = [known[thread] for thread in of_node if thread in known]
        if not recorded:
            unknown.append(name)
            ranks = [evidence.occupation.urgency.get(thread, 0) for thread in of_node]
            priorities[name] = min(_MOST_URGENT, _DEFAULT_PRIORITY + max(ranks, default=0))
        else:
            priorities[name] = min(_MOST_URGENT, max(1, *recorded))
            if max(recorded) == 0:
                ordinary.append(name)
    if unknown:
        evidence.notes.append(
            f"Priorities of {', '.join(unknown)} are not in the recording: {_DEFAULT_PRIORITY}, and"
            " more for those that were seen to pre-empt others on their core."
        )
    if ordinary:
        evidence.notes.append(
            f"{', '.join(ordinary)} had no SCHED_FIFO priority: described with the lowest."
        )
    return priorities


def _priority_of(thread: ThreadInfo) -> int:
    """Return a thread's priority in the description, which has SCHED_FIFO alone; 0: none.

    Threads under SCHED_DEADLINE come before all of SCHED_FIFO.
    """
    if thread.policy == "SCHED_DEADLINE":
        return _MOST_URGENT
    return thread.priority if thread.policy in _REAL_TIME else 0


def _dds_scheduling(evidence: Evidence) -> dict[str, int]:
    """Return core and priority of most DDS threads, as recorded; else those of this machine."""
    recorded = [
        (thread.cores[0], thread.priority)
        for thread in evidence.recording.info.threads
        if thread.role == "dds" and len(thread.cores) == 1 and thread.policy in _REAL_TIME
    ]
    if recorded:
        core, priority = Counter(recorded).most_common(1)[0][0]
        return {"core": core, "priority": min(_MOST_URGENT, priority)}
    evidence.notes.append(
        "Cores and priorities of DDS threads are not in the recording: the first core, above all"
        " executors."
    )
    return {"core": available_cores()[0], "priority": _DDS_PRIORITY}


def _add_executor(evidence: Evidence, node: DescribedNode, threads: Sequence[ThreadKey]) -> None:
    """Say that a node has several threads, where its callbacks ran at the same time."""
    ran = evidence.instances(node.of_executor).drop_nulls("end").sort("start")
    if len(threads) < 2 or ran.is_empty():
        return
    overlaps = _overlaps(ran)
    if not overlaps:
        return
    starts, ends = ran["start"].to_numpy(), np.sort(ran["end"].to_numpy())
    running = np.arange(1, len(starts) + 1) - np.searchsorted(ends, starts, "right")
    node.values |= {"executor": "multi_threaded", "threads": int(max(2, running.max()))}
    groups, kinds = list[set[int]](), dict[str, str]()
    for described in node.callbacks:
        if described is node.loop:
            continue
        ids = {*described.ids}
        if any((first, second) in overlaps for first in ids for second in ids):
            kinds["beside_itself"] = "reentrant"
            described.values["group"] = "beside_itself"
            continue
        fitting = (
            number
            for number, members in enumerate(groups)
            if not any((number, member) in overlaps for number in ids for member in members)
        )
        number = next(fitting, len(groups))
        if number == len(groups):
            groups.append(set())
        groups[number] |= ids
        if number:
            kinds[f"group_{number}"] = "mutually_exclusive"
            described.values["group"] = f"group_{number}"
    if kinds:
        node.values["callback_groups"] = kinds
    name = evidence.callbacks[node.ids[0]].node
    evidence.notes.append(
        f"Callback groups of {name} follow from which of its callbacks ran at the same time."
    )


def _overlaps(instances: pl.DataFrame) -> set[tuple[int, int]]:
    """Return pairs of callbacks of which instances ran at the same time, both ways."""
    pairs, running = set[tuple[int, int]](), list[tuple[int, int]]()  # end and callback
    for number, start, end in instances.select("callback_id", "start", "end").iter_rows():
        running = [(end_beside, beside) for end_beside, beside in running if end_beside > start]
        for _, beside in running:
            pairs |= {(number, beside), (beside, number)}
        running.append((end, number))
    return pairs


def _cores_of_threads(
    evidence: Evidence,
    node: DescribedNode,
    threads: Sequence[ThreadKey],
    core: int,
    free: Iterator[int],
) -> list[int]:
    """Return the core of each thread of an executor; unbound threads have one each of the free."""
    if node.values.get("bound") is False:
        return [core, *(next(free) for _ in range(1, node.values["threads"]))]
    known = [evidence.occupation.cores.get(thread) for thread in threads]
    cores = [bound for bound in known if bound is not None]
    return cores[: node.values["threads"]]


def _note_shared_executors(evidence: Evidence, threads: Mapping[str, Sequence[ThreadKey]]) -> None:
    """Note which nodes share threads: described nodes have processes of their own."""
    groups: list[tuple[set[ThreadKey], list[str]]] = []  # threads, and the nodes that share them
    for name, of_node in threads.items():
        shared, names, apart = {*of_node}, list[str](), list[tuple[set[ThreadKey], list[str]]]()
        for keys, members in groups:
            if keys.isdisjoint(of_node):
                apart.append((keys, members))
            else:
                shared |= keys
                names += members
        groups = [*apart, (shared, [*names, name])]
    for _, names in groups:
        if len(names) > 1:
            evidence.notes.append(
                f"{', '.join(names)} share an executor: in the description each has one of its own."
            )
