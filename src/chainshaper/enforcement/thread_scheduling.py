"""Which scheduling class and cores each thread of an application gets for a plan.

The paper's Thread Allocator (section 4.2). On a stock kernel the order of servers is an order of
SCHED_FIFO priorities (DESIGN section 6). From the most urgent:

* DDS threads and Zenoh's router, on cores without servers where there are any: what they deliver
  must not wait for its receiver. Those that receive come first; where the output is received, they
  have the first of these cores;
* servers, below 88, in the order of their own priority; threads of one server in the order in which
  the plan names their nodes: at one priority, callbacks that become ready at once would run in the
  order in which DDS happens to deliver. Where priorities are too few, the last threads of a server
  share one. Where slots are as long as single callbacks took, all but the first share one, as they
  did when that was measured (:attr:`~chainshaper.planning.plan.Plan.most_urgent_first`). Different
  executors take turns (SCHED_RR) only if the plan wants that: a turn ends within a callback, which
  then waits for another thread. The threads of a multi-threaded executor always do, since one that
  asks for work without pause would keep the core for ever (see below);
* nodes that receive what a shaping node publishes. Where the plan has a place for them, that is
  behind the shaping nodes and above everything else there. Otherwise they are below all servers, on
  the shaping node's core or, in a plan of several chains, whose servers keep that core busy, on the
  first core without servers; and below a loop of their process that reads the output and has raised
  itself: ros2_control's loop must not wait for its own node's executors. Several threads of a
  process on one core take turns. Where a callback of a mutually exclusive group runs and the group
  has more work, another thread of rclcpp's multi-threaded executor asks for that without pause; at
  one priority it would keep the core for ever once the callback has waited for a lock;
* the thread of a loop that reads an output, at the place that the plan has for it, unless it has a
  real-time priority by itself;
* an asynchronous publisher, below every other thread of its process on its core: it spins on the
  writer's lock, and above them would never let them release it;
* the thread by which Fast DDS sends what synchronous writers could not (`dds.asyn.N.0`), under the
  fair class on the cores of DDS threads, since it spins on the same locks
  (`FlowControllerImpl::run`); and the threads of best-effort servers.

All other threads are left alone, and so are threads under SCHED_DEADLINE, wherever a plan has them:
their reservation is what their own configuration gave them.
"""

from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain as joined
from types import MappingProxyType

from chainshaper.enforcement.node_threads import Allocation, NodeThread
from chainshaper.enforcement.planned_threads import place_of, server_members
from chainshaper.enforcement.servers import ReservationServer
from chainshaper.linux.scheduling import SchedulingRequest
from chainshaper.linux.threads import is_of_zenoh
from chainshaper.planning.chain_plan import PlannedLoop, ReceiverPlace, Server, Thread
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.middleware import ROUTERS

DDS_PRIORITY = 90
_BEST_SERVER_PRIORITY = 87
_BELOW = 1  # room for a publisher below a server's threads
_LOOPS = "a loop that reads the output, in its place"
_DEADLINE, _RESERVED = "SCHED_DEADLINE", "is under SCHED_DEADLINE, which is left as it is"
_RECEIVES, _RECEIVES_IN_PLACE = "receives the output", "receives the output, in its place"


@dataclass(frozen=True)
class WantedScheduling:
    """What a thread gets."""

    node_thread: NodeThread
    scheduling: SchedulingRequest
    server: str | None  # the name of the server that it is in, if any
    reason: str


def server_priorities(sizes: Mapping[int, int]) -> dict[int, tuple[int, ...]]:
    """Return the real-time priorities of each server priority: 87, 86, …, the most urgent first.

    ``sizes`` says how many places the largest server of each priority has. A server priority gets
    as many real-time priorities, or fewer where not all would fit. Raises InputError: there are too
    many server priorities.
    """
    room = _BEST_SERVER_PRIORITY - 1 - _BELOW * len(sizes)
    if room < len(sizes):
        many = f"{len(sizes)} different server priorities do not fit below {DDS_PRIORITY}"
        raise InputError(f"{many}: give servers that never overlap the same one")
    most = max(sizes.values(), default=1)
    while sum(min(size, most) for size in sizes.values()) > room:
        most -= 1
    priorities: dict[int, tuple[int, ...]] = {}
    best = _BEST_SERVER_PRIORITY
    for rank in sorted(sizes):
        below = best - min(sizes[rank], most)
        priorities[rank] = tuple(range(best, below, -1))
        best = below - _BELOW
    return priorities


def plan_scheduling(
    plan: Plan, allocation: Allocation, available_cores: Sequence[int]
) -> tuple[WantedScheduling, ...]:
    """Return what every thread gets that a plan concerns: servers' threads first, then the others.

    Raises OperationError, InputError: as :func:`.server_members` and :func:`scheduling_around`.
    """
    members = server_members(plan, allocation)
    cores = {receiver: node.core for node in plan.shaping_nodes for receiver in node.receivers}
    free = set(available_cores) - {server.core for server in plan.servers}
    if free and len(plan.chains) > 1:
        cores = dict.fromkeys(cores, min(free))
    return scheduling_around(
        members,
        plan.servers,
        allocation,
        available_cores,
        order=plan.most_urgent_first,
        behind=plan.behind_outputs,
        receivers=cores,
        places=plan.receivers_at,
        take_turns=plan.takes_turns,
        clear={node.core for node in plan.shaping_nodes},
        loops=[chain.loop for chain in plan.chains if chain.loop is not None],
    )


def waiting_receivers(plan: Plan, wanted: Iterable[WantedScheduling]) -> list[str]:
    """Return notes on nodes that receive an output on a core that is busy with other chains."""
    if len(plan.chains) == 1:
        return []
    busy = {(server.core,) for server in plan.servers}
    waiting = {
        node
        for item in wanted
        if item.reason == _RECEIVES and item.scheduling.cores in busy
        for node in item.node_thread.nodes
    }
    if not waiting:
        return []
    nodes = ", ".join(sorted(waiting))
    reason = "have cores with servers, since all cores have some, and wait for other chains' slots"
    return [f"callbacks of {nodes} {reason}: leave a core without, or plan with --no-receivers"]


def scheduling_around(
    members: Mapping[str, Sequence[NodeThread]],
    servers: Collection[Server | ReservationServer],
    allocation: Allocation,
    available_cores: Sequence[int],
    *,
    order: Sequence[str] = (),
    behind: Collection[str] = (),
    receivers: Mapping[str, int] = MappingProxyType({}),
    places: Mapping[str, ReceiverPlace] = MappingProxyType({}),
    take_turns: bool = False,
    clear: Collection[int] = (),
    loops: Sequence[PlannedLoop] = (),
) -> tuple[WantedScheduling, ...]:
    """Return what the threads of servers, and the other threads of their processes, get.

    * ``members``: the threads of each server, by its name.
    * ``order``: nodes, the most urgent first. So are a server's threads ordered; threads of other
      nodes come behind these, and share a priority.
    * ``behind``: the names of servers whose threads come behind the first thread of each server of
      their priority.
    * ``receivers``: nodes that receive an output, and the core for their executors. An executor
      that is real-time already, on cores of no server, stays as it is: it was placed there for its
      other callbacks.
    * ``places``: for some receivers, another priority and, if it is available, another core.
    * ``take_turns``: whether servers of one priority share it by turns (SCHED_RR).
    * ``loops``: loops that read an output. The thread of one that has a place gets it, unless it
      has raised itself: then it stays as it is, and receivers without a place are below it.
    * ``clear``: the cores that DDS threads leave where all cores have servers; otherwise they leave
      all cores with servers.

    Raises OperationError: a thread cannot leave the core of a publisher that would outrank it.
    InputError: see :func:`server_priorities`.
    """
    places_taken = {
        name: sorted({place_of(listed, order) for listed in group})
        for name, group in members.items()
    }
    of_loops = {loop.node: loop.runs_at for loop in loops if loop.runs_at is not None}
    priorities = server_priorities(_sizes(servers, places_taken, behind, {**of_loops, **places}))
    in_servers = [
        WantedScheduling(
            listed,
            _scheduling_in(
                server,
                priorities.get(server.priority, ()),
                places_taken[server.name].index(place_of(listed, order))
                + (1 if server.name in behind else 0),
                take_turns=take_turns,
            ),
            server.name,
            f"server priority {server.priority}",
        )
        for server in sorted(servers, key=lambda server: server.priority)
        for listed in members[server.name]
    ]
    planned = {item.node_thread.thread.identity for item in in_servers}
    busy = {server.core for server in servers}
    receiving, receiving_pids = _receiving(
        [listed for listed in allocation.threads if listed.thread.identity not in planned],
        receivers,
        places=places,
        priorities=priorities,
        available_cores=available_cores,
        busy=busy,
        raised={
            loop.node: loop.realtime_priority
            for loop in loops
            if loop.realtime_priority is not None
        },
    )
    receiving += _looping(allocation, planned, loops, priorities, available_cores)
    planned |= {item.node_thread.thread.identity for item in receiving}
    free_cores = tuple(sorted(set(available_cores) - busy))
    if not free_cores and clear:
        free_cores = tuple(sorted(set(available_cores) - set(clear)))
    concerned = receiving_pids | {item.node_thread.thread.pid for item in in_servers}
    concerned |= _routers_of(concerned, allocation)
    in_servers = _taking_turns(in_servers, of=lambda listed: (listed.thread.pid, listed.nodes))
    wanted = [*in_servers, *receiving]
    for listed in allocation.threads:
        if listed.thread.pid in concerned and listed.thread.identity not in planned:
            receives = listed.thread.pid in receiving_pids
            beside = _beside(listed, in_servers, free_cores, receives_output=receives)
            if beside is not None:
                wanted.append(beside)
    # The order in which a person reads them: servers' threads, DDS threads, the others.
    wanted.sort(key=lambda item: item.scheduling.priority is None)
    return tuple(
        _left_to_deadline(
            _below_siblings(item, wanted) if item.node_thread.thread.role == "publisher" else item
        )
        for item in wanted
    )


def _left_to_deadline(item: WantedScheduling) -> WantedScheduling:
    """Change nothing of a thread under SCHED_DEADLINE, which its own configuration put there."""
    if item.node_thread.thread.policy != _DEADLINE:
        return item
    return replace(item, scheduling=SchedulingRequest(None, None), reason=_RESERVED)


def left_reservations(wanted: Iterable[WantedScheduling]) -> list[str]:
    """Return a note on threads that stay under SCHED_DEADLINE, and what that means for the plan."""
    threads = [item.node_thread for item in wanted if item.reason == _RESERVED]
    if not threads:
        return []
    named = ", ".join(
        f"{listed.thread.text} of {', '.join(listed.nodes)}"
        + (f" ({listed.thread.reservation.text})" if listed.thread.reservation else "")
        for listed in threads
    )
    return [
        f"under SCHED_DEADLINE, and left so: {named}. Such threads come before all of SCHED_FIFO,"
        " gates included, on any core, until their runtime is used up"
    ]


def _is_best_effort(server: Server | ReservationServer) -> bool:
    return bool(getattr(server, "best_effort", False))


def _sizes(
    servers: Iterable[Server | ReservationServer],
    places_taken: Mapping[str, Sequence[int]],
    behind: Collection[str],
    places: Mapping[str, ReceiverPlace],
) -> dict[int, int]:
    """Return how many real-time priorities each server priority needs, receivers included."""
    sizes: dict[int, int] = {}
    for server in servers:
        if not _is_best_effort(server):
            size = len(places_taken[server.name]) + (1 if server.name in behind else 0)
            sizes[server.priority] = max(1, sizes.get(server.priority, 0), size)
    for rank in {place.priority for place in places.values()} & sizes.keys():
        sizes[rank] += 1  # for the receivers, behind the servers
    return sizes


def _scheduling_in(
    server: Server | ReservationServer,
    priorities: Sequence[int],
    place: int,
    *,
    take_turns: bool,
) -> SchedulingRequest:
    """Return what a thread gets that has this place in a server of these real-time priorities."""
    if _is_best_effort(server):
        return SchedulingRequest(0, (server.core,))
    priority = priorities[min(place, len(priorities) - 1)]
    return SchedulingRequest(priority, (server.core,), take_turns)


def _receiving(
    candidates: Iterable[NodeThread],
    receivers: Mapping[str, int],
    *,
    places: Mapping[str, ReceiverPlace],
    priorities: Mapping[int, Sequence[int]],
    available_cores: Collection[int],
    busy: Collection[int],
    raised: Mapping[str, int],
) -> tuple[list[WantedScheduling], set[int]]:
    """Return what executors of nodes that receive an output get, and their processes' ids.

    See :func:`scheduling_around`; ``busy`` are the cores of servers, and ``raised`` has the
    priorities that loops gave themselves, by their nodes.
    """
    below = max(1, min(map(min, priorities.values()), default=DDS_PRIORITY) - 1 - _BELOW)
    receiving, pids = list[WantedScheduling](), set[int]()
    for listed in candidates:
        core = next((receivers[node] for node in listed.nodes if node in receivers), None)
        if listed.thread.role != "executor" or core is None:
            continue
        pids.add(listed.thread.pid)
        place = next((places[node] for node in listed.nodes if node in places), None)
        below_loops = [raised[node] - 1 for node in listed.nodes if node in raised]
        priority, reason = max(1, min([below, *below_loops])), _RECEIVES
        if place is not None and place.priority in priorities:
            priority, reason = priorities[place.priority][-1], _RECEIVES_IN_PLACE
            core = place.core if place.core in available_cores else core
        is_placed = listed.thread.priority not in (0, priority)
        if not is_placed or not set(busy).isdisjoint(listed.thread.cores):
            request = SchedulingRequest(priority, (core,))
            receiving.append(WantedScheduling(listed, request, None, reason))
    return _taking_turns(receiving, of=lambda listed: listed.thread.pid), pids


def _taking_turns(
    wanted: Sequence[WantedScheduling], of: Callable[[NodeThread], Hashable]
) -> list[WantedScheduling]:
    """Have executors' threads take turns that share a core at one priority.

    ``of``: what such threads have in common. Threads of the ordinary class share it anyway.
    """
    sharing = Counter(
        (of(item.node_thread), item.scheduling)
        for item in wanted
        if item.node_thread.thread.role == "executor" and item.scheduling.priority
    )
    return [
        replace(item, scheduling=replace(item.scheduling, takes_turns=True))
        if sharing[of(item.node_thread), item.scheduling] > 1
        else item
        for item in wanted
    ]


def _looping(
    allocation: Allocation,
    planned: Collection[tuple[int, int]],
    loops: Sequence[PlannedLoop],
    priorities: Mapping[int, Sequence[int]],
    available_cores: Collection[int],
) -> list[WantedScheduling]:
    """Return what the threads of loops get that read an output, unless they have raised themselves.

    A loop's thread is known by its name. ``planned``: the identities of threads that have their
    place already.
    """
    looping = list[WantedScheduling]()
    for loop in loops:
        place = loop.runs_at
        if place is None or place.priority not in priorities or loop.thread is None:
            continue
        priority = priorities[place.priority][-1]
        for listed in allocation.threads:
            thread = listed.thread
            is_meant = loop.node in listed.nodes and thread.comm == loop.thread
            has_raised_itself = thread.priority not in (0, priority)
            if not is_meant or has_raised_itself or thread.identity in planned:
                continue
            cores = (place.core,) if place.core in available_cores else None
            looping.append(
                WantedScheduling(listed, SchedulingRequest(priority, cores), None, _LOOPS)
            )
    return looping


def _routers_of(pids: Collection[int], allocation: Allocation) -> set[int]:
    """Return the processes of Zenoh's router, if one of these processes uses Zenoh."""
    threads = allocation.threads
    if not any(listed.thread.pid in pids and is_of_zenoh(listed.thread) for listed in threads):
        return set()
    return {listed.thread.pid for listed in threads if set(listed.nodes) & ROUTERS}


def _beside(
    listed: NodeThread,
    in_servers: Iterable[WantedScheduling],
    cores: tuple[int, ...],
    *,
    receives_output: bool,
) -> WantedScheduling | None:
    """Return what a thread outside servers gets whose process has threads in one.

    None: it stays as it is. DDS threads stay on their cores if no others are left to them. Other
    threads leave the core of an asynchronous publisher, which would outrank them.
    """
    thread = listed.thread
    if thread.kind == "resend":
        reason = "spins on its siblings' locks, and has nothing to do as a rule"
        return WantedScheduling(listed, SchedulingRequest(0, cores or None), None, reason)
    if thread.role == "dds":
        receives = thread.kind == "receive"
        allowed = cores[:1] if receives and receives_output else cores
        priority = DDS_PRIORITY + 1 if receives else DDS_PRIORITY
        request = SchedulingRequest(priority, allowed or None)
        return WantedScheduling(listed, request, None, "DDS threads deliver for the servers")
    publishers = (
        item.scheduling.cores or ()
        for item in in_servers
        if item.node_thread.thread.role == "publisher" and item.node_thread.thread.pid == thread.pid
    )
    shared = set(thread.cores).intersection(joined.from_iterable(publishers))
    if not shared:
        return None
    elsewhere = tuple(sorted(set(thread.cores) - shared))
    inherits = not elsewhere and thread.priority > 0  # from the executor that we had raised
    elsewhere = cores if inherits else elsewhere
    if not elsewhere:
        raise OperationError(
            f"{thread.text} may run on core {min(shared)} only, where the process's asynchronous"
            " publisher would outrank it and never let it release the writer's lock: let it run on"
            " another core too (`taskset`)"
        )
    reason = "not on the core of its process's asynchronous publisher"
    request = SchedulingRequest(0 if inherits else None, elsewhere)
    return WantedScheduling(listed, request, None, reason)


def _below_siblings(
    publisher: WantedScheduling, wanted: Iterable[WantedScheduling]
) -> WantedScheduling:
    """Put a publisher below the other threads of its process on its core."""
    core = (publisher.scheduling.cores or (None,))[0]
    siblings = (
        item.scheduling.priority - 1
        for item in wanted
        if item.node_thread.thread.pid == publisher.node_thread.thread.pid
        and item.node_thread.thread.role != "publisher"
        and item.scheduling.priority is not None
        and core in (item.scheduling.cores or item.node_thread.thread.cores)
    )
    below = max(1, min(siblings, default=99))
    if below >= (publisher.scheduling.priority or 0):
        return publisher
    request = replace(publisher.scheduling, priority=below)
    reason = "below its siblings, whose locks it spins on"
    return replace(publisher, scheduling=request, reason=reason)


def left_by_back_end(
    back_end: str, wanted: Iterable[WantedScheduling], free: Collection[Thread] = ()
) -> tuple[WantedScheduling, ...]:
    """Leave out what a back end does itself that schedules its servers' threads in the kernel.

    * Servers' threads get no priority from us. Under sched_ext they may not even have one, since
      the kernel runs real-time threads above its policy.
    * ``free`` threads, which no back end keeps in their slots, keep their priority, above servers.
    * Receivers of an output keep theirs if they have a place in the plan; others are left alone.
    """
    if back_end not in ("scx", "litmus"):
        return tuple(wanted)
    free_nodes = {thread.node for thread in free}
    left = []
    for item in wanted:
        if item.server is not None and free_nodes.isdisjoint(item.node_thread.nodes):
            is_real_time = item.node_thread.thread.priority > 0
            priority = 0 if back_end == "scx" and is_real_time else None
            request = SchedulingRequest(priority, item.scheduling.cores)
            left.append(replace(item, scheduling=request))
        elif item.reason != _RECEIVES:
            left.append(item)
    return tuple(left)
