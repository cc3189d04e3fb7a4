"""From a plan's servers to threads, and from threads to their real-time priorities.

On a stock kernel the order of servers is an order of SCHED_FIFO priorities (DESIGN section 6):

* DDS threads of the application stand above all servers, on other cores where there are any:
  what they deliver must not wait for what it is delivered to;
* those of them that receive stand above the others, since they are waited for; where the output is
  received, they have the first of these cores, which the shaping node keeps clear;
* servers stand below 88 in the order of their own priority, smaller first;
* who receives what a shaping node publishes stands below all servers, on the shaping node's core:
  idle then, and just awake. It may take as long as it likes, and delays no chain;
* several threads of one server share a priority under SCHED_RR, so that they take turns;
* an asynchronous publisher stands below every other thread of its process on its core. It shares
  the writer's lock with them and spins on it: above them, it would never let them release it;
* all others, best effort, are left alone.

The result is a list that can be looked at before anything is done.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain as joined

from chainshaper.enforcement.servers import ReservationServer
from chainshaper.enforcement.threads.allocation import Allocation, NodeThread
from chainshaper.linux.threads import Scheduling
from chainshaper.planning.plan import Plan, Server, shaping_nodes
from chainshaper.planning.plan import Thread as PlannedThread
from chainshaper.values.errors import InputError, OperationError

__all__ = [
    "DDS_PRIORITY",
    "WantedScheduling",
    "below_their_siblings",
    "left_by_back_end",
    "plan_scheduling",
    "scheduling_around",
    "server_members",
    "server_priorities",
    "wanted_of_members",
]

DDS_PRIORITY = 90
DDS_RECEIVE_PRIORITY = 91
BEST_SERVER_PRIORITY = 87
RECEIVES = "receives the output"
STEP = 2
"""Between two servers there is room for a publisher below the better one's threads."""


@dataclass(frozen=True)
class WantedScheduling:
    """What a thread shall get, for which server (None: it is in none), and why."""

    thread: NodeThread
    wanted: Scheduling
    server: str | None
    reason: str


def server_members(plan: Plan, allocation: Allocation) -> dict[str, tuple[NodeThread, ...]]:
    """The threads of each server of a plan, by the server's name.

    Nodes of one process may share an executor: then it is one thread of their server.

    Raises:
        OperationError: a planned thread is not running, two processes are the same node, or one
            thread executes nodes of two servers.
    """
    homes: dict[tuple[int, int], str] = {}
    members: dict[str, tuple[NodeThread, ...]] = {}
    for server in plan.servers:
        found = {
            thread.thread.identity: thread
            for planned in server.threads
            for thread in _threads_for(planned, allocation)
        }
        for identity, thread in found.items():
            if identity in homes:
                raise OperationError(
                    f"thread {thread.thread.tid} ({thread.thread.comm}) executes "
                    f"{', '.join(thread.nodes)}, which the plan has in the servers "
                    f"{homes[identity]} and {server.name}: put them into one server, or start "
                    "them as processes of their own"
                )
            homes[identity] = server.name
        members[server.name] = tuple(found.values())
    return members


def server_priorities(priorities: Iterable[int]) -> dict[int, int]:
    """The real-time priority for each server priority: 87 for the best, 85, 83 …

    Raises:
        InputError: there are more than 43 of them.
    """
    ranks = sorted(set(priorities))
    lowest = BEST_SERVER_PRIORITY - STEP * (len(ranks) - 1)
    if lowest <= 1:
        raise InputError(
            f"{len(ranks)} different server priorities do not fit below {DDS_PRIORITY}: give "
            "servers that never overlap the same priority"
        )
    return {rank: BEST_SERVER_PRIORITY - STEP * place for place, rank in enumerate(ranks)}


def plan_scheduling(
    plan: Plan, allocation: Allocation, available_cores: Sequence[int]
) -> tuple[WantedScheduling, ...]:
    """What every thread concerned by a plan shall get: servers' threads first, then the others.

    Receivers that do not run are left out: not everybody who subscribes is always there.

    Raises:
        OperationError: see :func:`server_members`.
        InputError: see :func:`server_priorities`.
    """
    members = server_members(plan, allocation)
    receiving = _receiving(plan, members, allocation)
    return scheduling_around(
        members, plan.servers, allocation, available_cores, receiving=receiving
    )


def scheduling_around(
    members: Mapping[str, Sequence[NodeThread]],
    servers: Collection[Server | ReservationServer],
    allocation: Allocation,
    available_cores: Sequence[int],
    *,
    receiving: Sequence[WantedScheduling] = (),
) -> tuple[WantedScheduling, ...]:
    """What the threads of servers, and the others of their processes, shall get.

    ``members`` are by server's name. ``receiving`` is what threads
    that receive an output shall get, whose processes are treated alike.

    Raises:
        OperationError: a thread cannot leave the core of a publisher that would outrank it.
        InputError: see :func:`server_priorities`.
    """
    own = wanted_of_members(members, servers)
    ours = [*joined.from_iterable(members.values()), *(one.thread for one in receiving)]
    pids = {member.thread.pid for member in ours}
    planned = {member.thread.identity for member in ours}
    others = [
        thread
        for thread in allocation.threads
        if thread.thread.pid in pids and thread.thread.identity not in planned
    ]
    free_cores = tuple(sorted(set(available_cores) - {server.core for server in servers}))
    beside = _dds_threads(others, free_cores, {one.thread.thread.pid for one in receiving})
    return below_their_siblings((*own, *receiving, *beside, *_out_of_the_way(own, others)))


def left_by_back_end(
    back_end: str, wanted: Iterable[WantedScheduling]
) -> tuple[WantedScheduling, ...]:
    """What threads get from us where a back end schedules its servers' threads itself.

    Under sched_ext and LITMUS^RT servers are scheduling classes of their own: their threads need
    no priority, and sched_ext's may have none, since the kernel runs real-time threads above it.
    A receiver would stand above the servers then, instead of below: it is left as it is.
    """
    if back_end not in ("scx", "litmus"):
        return tuple(wanted)
    wanted = (one for one in wanted if one.reason != RECEIVES)
    return tuple(
        one
        if one.server is None
        else replace(
            one,
            wanted=Scheduling(
                0 if back_end == "scx" and one.thread.thread.priority else None, one.wanted.cores
            ),
        )
        for one in wanted
    )


def wanted_of_members(
    members: Mapping[str, Sequence[NodeThread]], servers: Collection[Server | ReservationServer]
) -> tuple[WantedScheduling, ...]:
    """Class, priority and core of servers' threads; ``members`` are by server's name."""
    ranks = server_priorities(server.priority for server in servers)
    return tuple(
        WantedScheduling(
            member,
            Scheduling(
                ranks[server.priority], (server.core,), takes_turns=len(members[server.name]) > 1
            ),
            server.name,
            f"server priority {server.priority}",
        )
        for server in sorted(servers, key=lambda one: one.priority)
        for member in members[server.name]
    )


def below_their_siblings(wanted: Sequence[WantedScheduling]) -> tuple[WantedScheduling, ...]:
    """The same with each publisher below the other threads of its process on its core."""
    lowered = []
    for one in wanted:
        thread, core = one.thread.thread, (one.wanted.cores or (None,))[0]
        siblings = [
            other.wanted.priority - 1
            for other in wanted
            if other.thread.thread.pid == thread.pid
            and other.thread.thread.role != "publisher"
            and other.wanted.priority is not None
            and core in (other.wanted.cores or other.thread.thread.cores)
        ]
        below = max(1, min(siblings, default=99))
        if thread.role == "publisher" and below < (one.wanted.priority or 0):
            scheduling = replace(one.wanted, priority=below)
            reason = "below its siblings, whose locks it spins on"
            one = replace(one, wanted=scheduling, reason=reason)  # noqa: PLW2901
        lowered.append(one)
    return tuple(lowered)


def _threads_for(planned: PlannedThread, allocation: Allocation) -> list[NodeThread]:
    owners = [thread for thread in allocation.threads if planned.node in thread.nodes]
    found = [owner for owner in owners if owner.thread.role == planned.role]
    pids = sorted({owner.thread.pid for owner in owners})
    if len(pids) > 1:
        raise OperationError(
            f"node {planned.node} is ambiguous: processes {', '.join(map(str, pids))} all have it; "
            "end those that are not meant, or give each a namespace of its own"
        )
    if not pids:
        known = sorted({node for thread in allocation.threads for node in thread.nodes})
        raise OperationError(
            f"node {planned.node} of the plan is not running, or cannot be recognised; running: "
            f"{', '.join(known) or 'no node'}; start it with `--ros-args -r __node:=NAME`, or name "
            "a recording of it" + (f"; {allocation.strangers}" if allocation.strangers else "")
        )
    if not found:
        what = "asynchronous publisher" if planned.role == "publisher" else planned.role
        raise OperationError(
            f"process {pids[0]} of node {planned.node} has no thread that is known to be its "
            f"{what}: see `chainshaper threads {pids[0]}`"
        )
    return found


def _receiving(
    plan: Plan, members: Mapping[str, Sequence[NodeThread]], allocation: Allocation
) -> list[WantedScheduling]:
    """The executors of nodes that receive an output, unless they are in a server themselves."""
    planned = {one.thread.identity for group in members.values() for one in group}
    below = min(server_priorities(server.priority for server in plan.servers).values()) - STEP
    cores = {receiver: node.core for node in shaping_nodes(plan) for receiver in node.receivers}
    return [
        WantedScheduling(one, Scheduling(max(1, below), (core,)), None, RECEIVES)
        for one in allocation.threads
        if one.thread.role == "executor" and one.thread.identity not in planned
        for core in [cores[node] for node in one.nodes if node in cores][:1]
    ]


def _dds_threads(
    others: Sequence[NodeThread], cores: tuple[int, ...], receivers: Collection[int]
) -> list[WantedScheduling]:
    """DDS threads above all servers; on machines without a free core they stay where they are.

    ``receivers`` are the processes that receive an output.
    """
    wanted = []
    for one in others:
        if one.thread.role != "dds":
            continue
        receives = one.thread.kind == "receive"
        own = cores[:1] if receives and one.thread.pid in receivers else cores
        priority = DDS_RECEIVE_PRIORITY if receives else DDS_PRIORITY
        reason = "DDS threads deliver for the servers"
        wanted.append(WantedScheduling(one, Scheduling(priority, own or None), None, reason))
    return wanted


def _out_of_the_way(
    own: Sequence[WantedScheduling], others: Sequence[NodeThread]
) -> list[WantedScheduling]:
    """Siblings of no class of their own leave the core of a publisher, which would outrank them."""
    cores: dict[int, set[int]] = {}
    for one in own:
        if one.thread.thread.role == "publisher" and one.wanted.cores:
            cores.setdefault(one.thread.thread.pid, set()).update(one.wanted.cores)
    moved = []
    for thread in others:
        shared = cores.get(thread.thread.pid, set()) & set(thread.thread.cores)
        if not shared or thread.thread.role == "dds":
            continue
        elsewhere = tuple(sorted(set(thread.thread.cores) - shared))
        if not elsewhere:
            raise OperationError(
                f"thread {thread.thread.tid} ({thread.thread.comm}) of process "
                f"{thread.thread.pid} may run on core {min(shared)} only, where the process's "
                "asynchronous publisher would outrank it and never let it release the writer's "
                "lock: let it run on another core too (`taskset`)"
            )
        reason = "not on the core of its process's asynchronous publisher"
        moved.append(WantedScheduling(thread, Scheduling(None, elsewhere), None, reason))
    return moved
