"""Which thread does what in an application, and what each shall get for a plan.

The paper's Thread Allocator (section 4.2). Evidence for a thread's role, the stronger first: the
callbacks that a recording saw it run; its name, by DDS; its place: executors spin on the main
thread unless the program arranges it otherwise.

On a stock kernel the order of servers is an order of SCHED_FIFO priorities (DESIGN section 6). From
the most urgent:

* DDS threads and Zenoh's router, on cores without servers where there are any: what they deliver
  must not wait for its receiver. Those that receive come first; where the output is received, they
  have the first of these cores;
* servers, below 88, in the order of their own priority; threads of one server in the order in which
  the plan names their nodes: at one priority, callbacks that become ready at once would run in the
  order in which DDS happens to deliver. Where priorities are too few, the last of a server share
  one; where slots are made of what single callbacks took, all but the first do, as while that was
  measured (:attr:`~chainshaper.planning.application_plan.ApplicationPlan.most_urgent_first`). Turns
  (SCHED_RR), only if the plan wants them, end within a callback, which then waits for another;
* who receives what a shaping node publishes: where the plan has a place for them, there, behind
  the shaping nodes and above all others; else below all servers, on the shaping node's core, or, of
  several chains, whose servers keep that core busy, on the first core without servers;
* an asynchronous publisher, below every other thread of its process on its core: it spins on the
  writer's lock, and above them would never let them release it;
* the thread by which Fast DDS sends what synchronous writers could not (`dds.asyn.N.0`), under the
  fair class, on the cores of DDS threads, since it spins on the same locks
  (`FlowControllerImpl::run`), and what is in best-effort servers. All others are left alone.
"""

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain as joined
from types import MappingProxyType
from typing import NamedTuple

from chainshaper.enforcement.servers import ReservationServer
from chainshaper.linux.processes import (
    MIDDLEWARE_LIMITS,
    ROUTERS,
    RunningProcess,
    descendants,
    guessed_name,
    middleware_limit,
    named_nodes,
    takes_ros_arguments,
    user_name,
)
from chainshaper.linux.scheduling import SchedulingRequest
from chainshaper.linux.threads import (
    TICK_NS,
    RunningThread,
    ThreadRole,
    gate_thread_name,
    is_of_zenoh,
    since_boot_ns,
)
from chainshaper.planning.application_plan import ApplicationPlan
from chainshaper.planning.plan import Plan, ReceiverPlace, Server, ShapingNode, shaping_nodes
from chainshaper.planning.plan import Thread as PlannedThread
from chainshaper.values.errors import InputError, OperationError

IN_ORDER = "its executors are known by the order in which it started its threads, as when recorded"
NOT_RECOGNISED = "not running, or not recognised: "
LEFT_ALONE = "left alone, since users run them whom this run does not name: "
DDS_PRIORITY = 90
_BEST_SERVER_PRIORITY = 87
_BELOW = 1  # room for a publisher below a server's threads
_RECEIVES, _RECEIVES_IN_PLACE = "receives the output", "receives the output, in its place"
_MOST_NAMED = 5
_COMM_LENGTH = 15  # the kernel cuts names of threads off behind this


@dataclass(frozen=True)
class RecordedThread:
    """A thread in a recording, by its id there, and whose callbacks it ran: those of its executor
    by node and trigger, where the process has several.
    """

    tid: int
    role: ThreadRole
    nodes: tuple[str, ...]
    comm: str = ""
    callbacks: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class RecordedProcess:
    """A process in a recording, seen last at ``seen_ns`` (ns of CLOCK_MONOTONIC), by the numbers
    that it and its threads have here (``numbered_here``), or by their own.
    """

    pid: int
    nodes: tuple[str, ...]
    threads: tuple[RecordedThread, ...]
    seen_ns: int
    numbered_here: bool = False


@dataclass(frozen=True)
class NodeThread:
    """A thread of an application, what its role is ``known_by``, if at all, and its nodes, known by
    ``recording``, ``command line``, or, a guess, ``program's name``.
    """

    thread: RunningThread
    nodes: tuple[str, ...]
    known_by: str
    nodes_known_by: str
    callbacks: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Allocation:
    """All threads of an application at one instant, what is not certain about them, and a line
    about processes of other users that say they are nodes.
    """

    threads: tuple[NodeThread, ...]
    notes: tuple[str, ...]
    strangers: str | None = None


class _Identified(NamedTuple):
    """A process, its nodes, how they are known, and its threads (by their ids in its pid namespace)
    in a recording of itself, or (``in_order``) of an earlier run.
    """

    process: RunningProcess
    nodes: tuple[str, ...] = ()
    nodes_known_by: str = ""
    recorded: Mapping[int, RecordedThread] = MappingProxyType({})
    in_order: bool = False
    main_executes: bool = True


def allocate(
    processes: Sequence[RunningProcess],
    recorded: Sequence[RecordedProcess] = (),
    among: Sequence[RunningProcess] | None = None,
    users: Collection[int] | None = None,
) -> Allocation:
    """Find out what each thread of ``processes`` does, ``among`` all that were looked at: who
    started whom tells a node from the commands that run it. Others' than ``users``' have no nodes.
    """
    looked_at = processes if among is None else among
    identified = [
        _identify(one, recorded) if users is None or one.user in users else _Identified(one)
        for one in looked_at
    ]
    wanted = {process.pid for process in processes}
    chosen = [one for one in _with_unique_names(identified) if one.process.pid in wanted]
    notes = [
        f"process {one.process.pid} is called {one.nodes[0]} after its program, which is a guess: "
        "name its recording, or start it with `--ros-args -r __node:=NAME`"
        for one in chosen
        if one.nodes_known_by == "program's name" and one.nodes and one.nodes[0] not in ROUTERS
    ]
    notes += [_ambiguous(name, pids) for name, pids in _claims(chosen).items()]
    notes += [
        f"process {one.process.pid} of {', '.join(one.nodes)}: {IN_ORDER}"
        for one in chosen
        if one.in_order
    ]
    threads = tuple(thread for one in chosen for thread in _threads_of(one))
    return Allocation(threads, (*notes, *_limits(chosen)))


def _ambiguous(node: str, pids: Iterable[int]) -> str:
    return (
        f"node {node} is ambiguous: processes {', '.join(map(str, pids))} all have it; give each a "
        "name or a namespace of its own, or end those that are not meant"
    )


def _limits(identified: Iterable[_Identified]) -> Iterator[str]:
    """A line for each middleware that is supported in part only, with whom it concerns."""
    found: dict[str, set[str]] = {}
    for one in identified:
        if one.nodes and (limit := middleware_limit(one.process)) is not None:
            found.setdefault(limit, set()).update(one.nodes)
    for limit, nodes in found.items():
        more = ["…"] * (len(nodes) > _MOST_NAMED)
        yield f"{', '.join(sorted(nodes)[:_MOST_NAMED] + more)}: {MIDDLEWARE_LIMITS[limit]}"


def with_gates(found: Allocation, nodes: Iterable[ShapingNode]) -> Allocation:
    """The threads, of which those that work for gates in publishers' processes are these nodes'."""
    names = {gate_thread_name(one.name): one.thread.node for one in nodes}
    threads = tuple(
        replace(one, thread=replace(one.thread, role="executor"), nodes=(node,), known_by="name")
        if (node := names.get(one.thread.comm))
        else one
        for one in found.threads
    )
    return replace(found, threads=threads)


def new_and_ended(
    before: Allocation, now: Allocation
) -> tuple[tuple[NodeThread, ...], tuple[NodeThread, ...]]:
    """The threads that have appeared and those that are gone since an earlier look."""
    known, alive = ({one.thread.identity for one in found.threads} for found in (before, now))
    new = tuple(one for one in now.threads if one.thread.identity not in known)
    return new, tuple(one for one in before.threads if one.thread.identity not in alive)


def strangers_text(
    processes: Iterable[RunningProcess],
    users: Collection[int],
    nodes: Collection[str] | None = None,
) -> str | None:
    """One line about others' processes that carry a name of one of ``nodes`` (None: any node)."""
    found = [
        f"{', '.join(names[:_MOST_NAMED])} (process {process.pid} of {user_name(process.user)})"
        for process in processes
        if process.user not in users
        and (names := [n for n in _own_words(process)[0] if nodes is None or n in nodes])
    ]
    if not found:
        return None
    more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    named = f"{', '.join(found[:_MOST_NAMED])}{more}"
    return f"{LEFT_ALONE}{named}; to take them for nodes, name their user (--user)"


def _identify(process: RunningProcess, recorded: Sequence[RecordedProcess]) -> _Identified:
    named = named_nodes(process.command)
    nodes, known_by = _own_words(process)
    itself = next((seen for seen in recorded if _is_same(process, named, seen)), None)
    namesake = next((seen for seen in recorded if nodes and set(nodes) <= set(seen.nodes)), None)
    run = itself or namesake or _same_program(nodes, named, recorded)
    if run is None:
        return _Identified(process, nodes, known_by)
    # A container's command line does not name its components, others' no node at all.
    knows_better = itself or not namesake or (named and set(named) < set(run.nodes))
    if knows_better and run.nodes:
        nodes, known_by = run.nodes, "recording"
    if itself is None:
        known = _in_order(process, run)
    elif run.numbered_here:
        inner = {one.tid: one.inner_tid for one in process.threads}
        known = {inner[one.tid]: one for one in run.threads if one.tid in inner}
    else:
        known = {one.tid: one for one in run.threads}
    executing = [one.tid for one in run.threads if one.role == "executor"]
    main = not executing or run.pid in executing
    return _Identified(process, nodes, known_by, known, itself is None and bool(known), main)


def _same_program(
    guess: Sequence[str], named: Sequence[str], recorded: Sequence[RecordedProcess]
) -> RecordedProcess | None:
    """The one earlier run of a program that names its nodes in its code, by its main thread."""
    if named or not guess:
        return None
    main = guess[0][1:][:_COMM_LENGTH]
    runs = [
        seen
        for seen in recorded
        if seen.nodes and any((one.tid, one.comm) == (seen.pid, main) for one in seen.threads)
    ]
    return runs[0] if len(runs) == 1 else None


def _in_order(process: RunningProcess, earlier: RecordedProcess) -> dict[int, RecordedThread]:
    """The threads of a process as an earlier run of its program had them; none if it is not sure. A
    program starts its threads in one order, so those of one name are the same by turns, once there
    are as many. It is asked for executors beside the main thread only.
    """
    executing = [one for one in earlier.threads if one.role == "executor"]
    found: dict[int, RecordedThread] = {}
    if all(one.tid == earlier.pid for one in executing):
        return found
    for name in {one.comm for one in executing}:
        before = [one for one in earlier.threads if one.comm == name]
        now = [one.inner_tid for one in process.threads if one.comm == name]
        if len(before) != len(now):
            return {}
        # Ids ascend, and begin again at the lowest that is free.
        now.sort(key=lambda tid: (tid < process.inner_pid, tid))
        before.sort(key=lambda one: (one.tid < earlier.pid, one.tid))
        found |= zip(now, before, strict=True)
    return found


def _own_words(process: RunningProcess) -> tuple[tuple[str, ...], str]:
    """The nodes that a process has by its command line, and which part of that says so."""
    if named := named_nodes(process.command):
        return named, "command line"
    guess = guessed_name(process.command)
    looks_like_a_node = process.participates or takes_ros_arguments(process.command)
    return ((guess,), "program's name") if guess is not None and looks_like_a_node else ((), "")


def _is_same(process: RunningProcess, named: tuple[str, ...], seen: RecordedProcess) -> bool:
    """Whether a process is the one that was recorded: its id, alive by then, no other name."""
    pid = process.pid if seen.numbered_here else process.inner_pid
    if seen.pid != pid or not process.threads:
        return False
    asleep_ns = since_boot_ns() - time.monotonic_ns()
    if process.threads[0].started * TICK_NS - asleep_ns > seen.seen_ns + TICK_NS:
        return False
    return not (named and seen.nodes) or not set(named).isdisjoint(seen.nodes)


def _claims(identified: Iterable[_Identified]) -> dict[str, list[int]]:
    """The names that several processes have, with these."""
    claims: dict[str, list[int]] = {}
    for one in identified:
        for name in one.nodes:
            claims.setdefault(name, []).append(one.process.pid)
    return {name: pids for name, pids in claims.items() if len(pids) > 1}


def _with_unique_names(identified: list[_Identified]) -> list[_Identified]:
    """Take a node's name from processes that carry it for another: the node takes part in DDS or,
    if none does, is the innermost (`ros2 run` and the like start it).
    """
    parent_of = {one.process.pid: one.process.parent for one in identified}
    participants = {one.process.pid for one in identified if one.process.participates}
    carried = set[tuple[int, str]]()
    for name, pids in _claims(identified).items():
        innermost = {pid for pid in pids if descendants(parent_of, pid).intersection(pids) == {pid}}
        node = participants.intersection(pids) or innermost
        carried |= {(pid, name) for pid in pids if pid not in node}
    return [
        one._replace(nodes=tuple(n for n in one.nodes if (one.process.pid, n) not in carried))
        for one in identified
    ]


def _threads_of(one: _Identified) -> Iterable[NodeThread]:
    for thread in one.process.threads:
        nodes, role, known_by = one.nodes, thread.role, ""
        recorded = one.recorded.get(thread.inner_tid)
        if recorded is not None and recorded.role != "unknown":
            nodes, role = recorded.nodes or nodes, recorded.role
            known_by = "order of start" if one.in_order else "recording"
        elif thread.role == "executor":
            main = bool(nodes) and one.main_executes
            role, known_by = ("executor", "main thread") if main else ("unknown", "")
        elif thread.role != "unknown":
            known_by = "name"
        kind = thread.kind if role in ("dds", "publisher") else None
        known = replace(thread, role=role, kind=kind)
        callbacks = () if recorded is None else recorded.callbacks
        yield NodeThread(known, nodes, known_by, one.nodes_known_by, callbacks)


@dataclass(frozen=True)
class WantedScheduling:
    """What a thread shall get, for which server (None: it is in none), and why."""

    thread: NodeThread
    wanted: SchedulingRequest
    server: str | None
    reason: str


def server_members(
    plan: ApplicationPlan, allocation: Allocation
) -> dict[str, tuple[NodeThread, ...]]:
    """The threads of each server of a plan, by its name. Raises OperationError: a planned thread is
    not running, two processes are the same node, or one thread executes nodes of two servers.
    """
    homes: dict[tuple[int, int], str] = {}
    members: dict[str, tuple[NodeThread, ...]] = {}
    for server in plan.servers:
        found = [one for planned in server.threads for one in threads_for(planned, allocation)]
        for one in found:
            if (home := homes.setdefault(one.thread.identity, server.name)) != server.name:
                raise OperationError(
                    f"{one.thread.text} executes {', '.join(one.nodes)}, which the plan has in the"
                    f" servers {home} and {server.name}: put them into one server, or start them"
                    " as processes of their own"
                )
        members[server.name] = tuple({one.thread.identity: one for one in found}.values())
    return members


def threads_for(planned: PlannedThread, allocation: Allocation) -> list[NodeThread]:
    """The threads that a plan means. Raises OperationError: as :func:`server_members`."""
    owners = [one for one in allocation.threads if planned.node in one.nodes]
    pids = sorted({one.thread.pid for one in owners})
    if len(pids) > 1:
        raise OperationError(_ambiguous(planned.node, pids))
    if not pids:
        known = sorted({node for one in allocation.threads for node in one.nodes})
        raise OperationError(
            f"node {planned.node} of the plan is not running, or cannot be recognised; running: "
            f"{', '.join(known) or 'no node'}; start it with `--ros-args -r __node:=NAME`, or name "
            "a recording of it" + (f"; {allocation.strangers}" if allocation.strangers else "")
        )
    process = f"process {pids[0]} of node {planned.node}"
    found = [one for one in owners if one.thread.role == planned.role]
    if not found:
        what = "executor: name a recording of this very process (--recording)"
        if planned.role == "publisher":
            what = (
                "asynchronous publisher, which Fast DDS alone has, if RMW_FASTRTPS_PUBLICATION_MODE"
                " is ASYNCHRONOUS: plan with --publication synchronous"
            )
        raise OperationError(
            f"{process} has no thread that is known to be its {what}, or see "
            f"`chainshaper threads {pids[0]}`"
        )
    wanted = {(planned.node, name) for name in planned.callbacks}
    own = [one for one in found if not wanted.isdisjoint(one.callbacks)] if wanted else found
    if not own:
        known = sorted({name for one in found for _, name in one.callbacks})
        raise OperationError(
            f"{process}: which of its threads runs {', '.join(planned.callbacks)} is not known"
            + (f" (known are those that run {', '.join(known)})" if known else "")
            + ": name a recording of it, or of an earlier run of the same program (--recording)"
        )
    return own


def server_priorities(sizes: Mapping[int, int]) -> dict[int, tuple[int, ...]]:
    """The real-time priorities of each server priority, 87, 86, … for as many nodes as its largest
    server has (``sizes``); fewer, where those of all do not fit. Raises InputError: too many.
    """
    room = _BEST_SERVER_PRIORITY - 1 - _BELOW * len(sizes)
    if room < len(sizes):
        many = f"{len(sizes)} different server priorities do not fit below {DDS_PRIORITY}"
        raise InputError(f"{many}: give servers that never overlap the same one")
    most = max(sizes.values(), default=1)
    while sum(min(size, most) for size in sizes.values()) > room:
        most -= 1
    found, best = dict[int, tuple[int, ...]](), _BEST_SERVER_PRIORITY
    for rank in sorted(sizes):
        below = best - min(sizes[rank], most)
        found[rank] = tuple(range(best, below, -1))
        best = below - _BELOW
    return found


def plan_scheduling(
    plan: ApplicationPlan, allocation: Allocation, available_cores: Sequence[int]
) -> tuple[WantedScheduling, ...]:
    """What every thread concerned by a plan shall get: servers' threads first, then the others.
    Raises: as :func:`server_members` and :func:`scheduling_around`.
    """
    members = server_members(plan, allocation)
    cores = {receiver: node.core for node in plan.shaping_nodes for receiver in node.receivers}
    free = set(available_cores) - {server.core for server in plan.servers}
    if free and len(plan.chains) > 1:
        cores = dict.fromkeys(cores, min(free))
    return scheduling_around(
        *(members, plan.servers, allocation, available_cores),
        order=plan.most_urgent_first,
        behind=plan.behind_outputs,
        receivers=cores,
        places=plan.receivers_at,
        take_turns=plan.takes_turns,
        clear={node.core for node in plan.shaping_nodes},
    )


def waiting_receivers(plan: ApplicationPlan, wanted: Iterable[WantedScheduling]) -> list[str]:
    """A note on who receives an output on a core that the servers of other chains keep busy."""
    busy = {(server.core,) for server in plan.servers if len(plan.chains) > 1}
    ours = [one for one in wanted if one.reason == _RECEIVES and one.wanted.cores in busy]
    if not ours:
        return []
    nodes = ", ".join(sorted({node for one in ours for node in one.thread.nodes}))
    reason = "have cores with servers, since all cores have some, and wait for other chains' slots"
    return [f"callbacks of {nodes} {reason}: leave a core without, or plan with --no-receivers"]


def absent_receivers(nodes: Iterable[ShapingNode], running: Collection[str]) -> str | None:
    """A line about receivers of outputs that are not among the nodes that run."""
    absent = [
        f"{receiver}, which receives {node.output}"
        for node in nodes
        for receiver in node.receivers
        if receiver not in running
    ]
    if not absent:
        return None
    named = ", ".join(dict.fromkeys(absent))
    return (
        f"{NOT_RECOGNISED}{named}: callbacks there keep their priority and cores, and may wait for"
        " the chain. Where a node runs, but no command line names it (as in a container), name a"
        " recording of it (--recording)"
    )


def first_planned(chain: Plan) -> PlannedThread | None:
    """The thread that begins a chain: the first executor, of no shaping node, by servers' slots."""
    run_it = (planned for _, planned in in_order_of_slots(chain))
    return next((one for one in run_it if one.role == "executor"), None)


def in_order_of_slots(chain: Plan) -> Iterator[tuple[Server, PlannedThread]]:
    """The planned threads that run a chain, with their servers: those of shaping nodes left out."""
    gates = {node.thread for node in shaping_nodes(chain)}
    for server in sorted(chain.servers, key=lambda one: (one.slots[0][0], one.priority)):
        yield from ((server, planned) for planned in server.threads if planned not in gates)


def closed_before(chain: Plan) -> int | None:
    """How long (ns) before a cycle the server of a chain's first thread closes, if it does."""
    slots = next(in_order_of_slots(chain))[0].slots
    is_always_open = slots[0][0] == 0 and slots[-1][1] >= chain.cycle_ns
    return None if is_always_open else chain.cycle_ns - slots[-1][1]


def place_of(one: NodeThread, order: Sequence[str]) -> int:
    """Where a thread stands in an order of nodes: with the first of its own, or behind all."""
    return min((order.index(node) for node in one.nodes if node in order), default=len(order))


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
) -> tuple[WantedScheduling, ...]:
    """What the threads of servers, and the others of their processes, shall get.

    ``members`` are by server's name, within a server in the ``order`` of their nodes, the most
    urgent first; others come behind these, and share a priority. Threads of servers that are
    ``behind``, by name, come behind the first of each server of their priority. ``receivers`` are
    nodes that receive an output, and the core for their executors; one that is real-time already,
    on cores of no server, stays as it is: its other callbacks were placed there. Some of them have
    ``places`` in the plan, with another priority, and core, if it is available. With
    ``take_turns``, servers of one priority share it by turns. DDS threads leave the cores of all
    servers or, where these are all that there are, those to be ``clear``.

    Raises OperationError: a thread cannot leave the core of a publisher that would outrank it.
    InputError: see :func:`server_priorities`.
    """
    taken = {name: sorted({place_of(one, order) for one in own}) for name, own in members.items()}
    sizes: dict[int, int] = {}
    for its in (one for one in servers if not getattr(one, "best_effort", False)):
        size = len(taken[its.name]) + (its.name in behind)
        sizes[its.priority] = max(1, sizes.get(its.priority, 0), size)
    for rank in {place.priority for place in places.values()} & sizes.keys():
        sizes[rank] += 1  # behind all of it
    priorities = server_priorities(sizes)

    def wanted_in(server: Server | ReservationServer, one: NodeThread) -> SchedulingRequest:
        if getattr(server, "best_effort", False):
            return SchedulingRequest(0, (server.core,))
        own, place = priorities[server.priority], taken[server.name].index(place_of(one, order))
        place += server.name in behind
        return SchedulingRequest(own[min(place, len(own) - 1)], (server.core,), take_turns)

    own = [
        WantedScheduling(one, wanted_in(its, one), its.name, f"server priority {its.priority}")
        for its in sorted(servers, key=lambda one: one.priority)
        for one in members[its.name]
    ]
    planned = {one.thread.thread.identity for one in own}
    busy = {server.core for server in servers}
    below = max(1, min(map(min, priorities.values()), default=DDS_PRIORITY) - 1 - _BELOW)
    receiving, receiving_pids = list[WantedScheduling](), set[int]()
    for one in allocation.threads:
        core = next((receivers[node] for node in one.nodes if node in receivers), None)
        if one.thread.role != "executor" or one.thread.identity in planned or core is None:
            continue
        receiving_pids.add(one.thread.pid)
        place = next((places[node] for node in one.nodes if node in places), None)
        priority, reason = below, _RECEIVES
        if place is not None and place.priority in priorities:
            priority, reason = priorities[place.priority][-1], _RECEIVES_IN_PLACE
            core = place.core if place.core in available_cores else core
        if one.thread.priority in (0, priority) or not busy.isdisjoint(one.thread.cores):
            receiving.append(
                WantedScheduling(one, SchedulingRequest(priority, (core,)), None, reason)
            )
    planned |= {one.thread.thread.identity for one in receiving}
    free_cores = tuple(sorted(set(available_cores) - busy))
    free_cores = free_cores or tuple(sorted(set(available_cores) - set(clear or available_cores)))
    concerned = receiving_pids | {one.thread.thread.pid for one in own}
    if any(one.thread.pid in concerned and is_of_zenoh(one.thread) for one in allocation.threads):
        concerned |= {one.thread.pid for one in allocation.threads if set(one.nodes) & ROUTERS}
    beside = (
        _beside(one, own, free_cores, one.thread.pid in receiving_pids)
        for one in allocation.threads
        if one.thread.pid in concerned and one.thread.identity not in planned
    )
    wanted = [*own, *receiving, *(one for one in beside if one is not None)]
    # What a person reads: servers' threads, DDS threads, the others.
    wanted.sort(key=lambda one: one.wanted.priority is None)
    return tuple(
        _below(one, wanted) if one.thread.thread.role == "publisher" else one for one in wanted
    )


def _beside(
    one: NodeThread, own: Sequence[WantedScheduling], cores: tuple[int, ...], receives_output: bool
) -> WantedScheduling | None:
    """What a thread in no server shall get, in a process that has one in a server. DDS threads stay
    where they are if no core is left to them; others, of no class of their own, leave the core of a
    publisher, which would outrank them.
    """
    thread = one.thread
    if thread.kind == "resend":
        reason = "spins on its siblings' locks, and has nothing to do as a rule"
        return WantedScheduling(one, SchedulingRequest(0, cores or None), None, reason)
    if thread.role == "dds":
        receives = thread.kind == "receive"
        allowed = cores[:1] if receives and receives_output else cores
        scheduling = SchedulingRequest(DDS_PRIORITY + receives, allowed or None)
        return WantedScheduling(one, scheduling, None, "DDS threads deliver for the servers")
    publishers = (
        publisher.wanted.cores or ()
        for publisher in own
        if publisher.thread.thread.role == "publisher" and publisher.thread.thread.pid == thread.pid
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
    return WantedScheduling(
        one, SchedulingRequest(0 if inherits else None, elsewhere), None, reason
    )


def _below(publisher: WantedScheduling, wanted: Iterable[WantedScheduling]) -> WantedScheduling:
    """A publisher below the other threads of its process on its core."""
    core = (publisher.wanted.cores or (None,))[0]
    siblings = (
        one.wanted.priority - 1
        for one in wanted
        if one.thread.thread.pid == publisher.thread.thread.pid
        and one.thread.thread.role != "publisher"
        and one.wanted.priority is not None
        and core in (one.wanted.cores or one.thread.thread.cores)
    )
    below = max(1, min(siblings, default=99))
    if below >= (publisher.wanted.priority or 0):
        return publisher
    scheduling = replace(publisher.wanted, priority=below)
    reason = "below its siblings, whose locks it spins on"
    return replace(publisher, wanted=scheduling, reason=reason)


def left_by_back_end(
    back_end: str, wanted: Iterable[WantedScheduling], free: Collection[PlannedThread] = ()
) -> tuple[WantedScheduling, ...]:
    """What threads get from us where a back end schedules its servers' threads itself: no priority,
    and under sched_ext none may be left, since the kernel runs real-time threads above it. ``free``
    threads, which no back end keeps in their slots, do stand above, and so do receivers that have a
    place there; others are left as they are.
    """
    if back_end not in ("scx", "litmus"):
        return tuple(wanted)
    left, themselves = [], {thread.node for thread in free}
    for one in wanted:
        if one.server is not None and themselves.isdisjoint(one.thread.nodes):
            priority = 0 if back_end == "scx" and one.thread.thread.priority else None
            left.append(replace(one, wanted=SchedulingRequest(priority, one.wanted.cores)))
        elif one.reason != _RECEIVES:
            left.append(one)
    return tuple(left)
