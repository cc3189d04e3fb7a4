"""What a recording says about an application: its processes' threads, and its endpoints.

Tracers number processes and threads as these do themselves, in their own pid namespace. Which nodes
a process has, its creation events say; which threads execute, the callbacks that they ran. /proc
shows threads, and DDS discovery endpoints; the events add which node each thread executes, and how
deep the queues are, which not every RMW shows to others.
"""

import platform
import time
from collections.abc import Sequence

import polars as pl

from chainshaper.analysis import callback_statistics, data_flow
from chainshaper.analysis.objects import resolve_objects
from chainshaper.enforcement.threads import RecordedProcess, RecordedThread, allocate
from chainshaper.linux.processes import Process
from chainshaper.linux.threads import ThreadRole
from chainshaper.values import events
from chainshaper.values.recording import EndpointInfo, Recording, ThreadInfo

KNOWN_ROLES: dict[str, ThreadRole] = {
    "executor": "executor",
    "publisher": "publisher",
    "dds": "dds",
}


def recorded_processes(recording: Recording) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """The processes of a recording, and why it says nothing about this machine, if that is so."""
    if platform.node() not in recording.info.host.split(", "):
        return (), (
            f"{recording.path} was taken on {recording.info.host or 'an unknown machine'}, so its "
            f"thread ids say nothing about {platform.node()}",
        )
    nodes = _nodes(recording.events)
    ran = _executors(recording)
    seen = _last_seen(recording.events)
    if any(instant > time.monotonic_ns() for instant in seen.values()):
        return (), (
            f"{recording.path} is from before this machine booted, so its thread ids say nothing",
        )
    threads: dict[int, dict[int, RecordedThread]] = {}
    for info in recording.info.threads:
        role = KNOWN_ROLES.get(info.role)
        if role is not None:
            own = (info.node,) if info.node else ()
            threads.setdefault(info.pid, {})[info.tid] = RecordedThread(info.tid, role, own)
            nodes.setdefault(info.pid, list(own))
    for (pid, tid), names in ran.items():
        threads.setdefault(pid, {})[tid] = RecordedThread(tid, "executor", tuple(names))
    found = [
        RecordedProcess(pid, tuple(names), tuple(threads.get(pid, {}).values()), seen[pid])
        for pid, names in nodes.items()
        if pid in seen
    ]
    return tuple(found), ()


def _nodes(tables: events.EventTables) -> dict[int, list[str]]:
    created = events.table(tables, "rcl_node_init").select("pid", node=events.NODE_NAME)
    found: dict[int, list[str]] = {}
    for pid, node in created.unique(maintain_order=True).iter_rows():
        found.setdefault(pid, []).append(node)
    return found


def _executors(recording: Recording) -> dict[tuple[int, int], list[str]]:
    """The nodes whose callbacks each thread ran, by process and thread."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    ran = callback_statistics(flow).filter(pl.col("node").is_not_null()).explode("tids")
    found: dict[tuple[int, int], list[str]] = {}
    for pid, tid, node in ran.select("pid", "tids", pl.col("node").cast(pl.String)).iter_rows():
        names = found.setdefault((pid, tid), [])
        if node not in names:
            names.append(node)
    return found


def _last_seen(tables: events.EventTables) -> dict[int, int]:
    seen = pl.concat(
        [
            events.table(tables, name).select("pid", "time")
            for name in ("rcl_node_init", "callback_start")
        ]
    )
    return dict(seen.drop_nulls().group_by("pid").agg(pl.col("time").max()).iter_rows())


def recorded_threads_of(
    processes: Sequence[Process], recording: Recording
) -> tuple[ThreadInfo, ...]:
    """The threads of the nodes among ``processes``, numbered as in the recording.

    Nodes are the processes that the recording saw one in; where it saw none (tracing began later),
    those that take part in DDS. A thread that works for several nodes (a component container's) is
    given to none.
    """
    recorded, _ = recorded_processes(recording)
    pids = {seen.pid for seen in recorded}
    nodes = [one for one in processes if one.inner_pid in pids]
    nodes = nodes or [one for one in processes if one.participates]
    inner_pids = {process.pid: process.inner_pid for process in nodes}
    return tuple(
        ThreadInfo(
            tid=found.thread.inner_tid,
            pid=inner_pids[found.thread.pid],
            comm=found.thread.comm,
            node=found.nodes[0] if len(found.nodes) == 1 else "",
            role=found.thread.role,
            policy=found.thread.policy,
            priority=found.thread.priority,
            cores=found.thread.cores,
        )
        for found in allocate(nodes, recorded, among=processes).threads
    )


def scheduled_in_real_time(threads: Sequence[ThreadInfo]) -> bool | None:
    """Whether all executors ran under a real-time class; None when no executor is known."""
    executors = [thread for thread in threads if thread.role == "executor"]
    if not executors:
        return None
    return all(thread.policy in ("SCHED_FIFO", "SCHED_RR") for thread in executors)


def known_endpoints(
    tables: events.EventTables, asked: Sequence[EndpointInfo]
) -> tuple[EndpointInfo, ...]:
    """The graph's endpoints with their depths from the trace, then those that only it saw.

    Several of one node, topic and kind are taken in the order in which they were created.
    """
    traced = _traced_endpoints(tables)
    found = []
    for one in asked:
        same = [t for t in traced if (t.node, t.topic, t.kind) == (one.node, one.topic, one.kind)]
        depth = one.depth or None  # 0: not known
        if same:
            traced.remove(same[0])
            depth = depth or same[0].depth
        found.append(one.model_copy(update={"depth": depth}))
    return (*found, *traced)


def _traced_endpoints(tables: events.EventTables) -> list[EndpointInfo]:
    objects = resolve_objects(tables)
    found = []
    for kind, owners in (
        ("publisher", objects.publishers),
        ("subscription", objects.subscriptions),
    ):
        created = events.table(tables, f"rcl_{kind}_init", ["queue_depth"]).select(
            "pid", handle=f"{kind}_handle", valid_from="time", depth="queue_depth"
        )
        rows = owners.join(created, on=["pid", "handle", "valid_from"]).sort("valid_from")
        rows = rows.drop_nulls(["node", "topic"]).select("node", "topic", "depth")
        found += [
            EndpointInfo.model_validate({"kind": kind, **row}) for row in rows.iter_rows(named=True)
        ]
    return found
