"""An application as it was seen while it was recorded: its threads, and its endpoints.

/proc shows threads, and DDS discovery shows endpoints; the events that were recorded say which
node each thread executes, and how deep the queues are, which not every RMW tells to others.
"""

from collections.abc import Sequence

from chainshaper.analysis.objects import resolve_objects
from chainshaper.enforcement.threads.allocation import allocate
from chainshaper.flow.recorded_threads import recorded_processes
from chainshaper.linux.processes import Process
from chainshaper.values import events
from chainshaper.values.recording import EndpointInfo, Recording, ThreadInfo

__all__ = ["known_endpoints", "recorded_threads_of", "scheduled_in_real_time"]


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
