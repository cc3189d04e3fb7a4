"""Which thread does what in an application, and what each shall get for a plan.

The paper's Thread Allocator (section 4.2). What is known of a thread, the stronger evidence first:
a recording saw the callbacks that it ran; its name, which DDS implementations choose; its place:
executors spin on the main thread, unless the program arranges it otherwise. Which nodes a process
has, a recording says (also one of an earlier run, where the command line names one of them), or the
remap rules of its command line; the name of its program is a guess, and called one. Only processes
of the users that are asked for are nodes (:mod:`chainshaper.linux.processes`); those of others that
repeat a node's name are named, and left alone.

On a stock kernel the order of servers is an order of SCHED_FIFO priorities (DESIGN section 6):

* DDS threads of the application stand above all servers, on other cores where there are any:
  what they deliver must not wait for what it is delivered to;
* those of them that receive stand above the others, since they are waited for; where the output is
  received, they have the first of these cores, which the shaping node leaves clear;
* servers stand below 88 in the order of their own priority, smaller first;
* who receives what a shaping node publishes stands below all servers, on the shaping node's core:
  idle then, and just awake. It may take as long as it likes, and delays no chain;
* several threads of one server share a priority under SCHED_RR, so that they take turns;
* an asynchronous publisher stands below every other thread of its process on its core. It shares
  the writer's lock with them and spins on it: above them, it would never let them release it;
* all others, best effort, are left alone.

All is a function of what was seen at one instant. Threads that appear later are found by looking
again (:func:`new_and_ended`).
"""

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain as joined

from chainshaper.enforcement.servers import ReservationServer
from chainshaper.linux.processes import (
    Process,
    descendants,
    guessed_name,
    named_nodes,
    takes_ros_arguments,
    user_name,
)
from chainshaper.linux.scheduling import Scheduling
from chainshaper.linux.threads import TICK_NS, Thread, ThreadRole
from chainshaper.planning.plan import Plan, Server, shaping_nodes
from chainshaper.planning.plan import Thread as PlannedThread
from chainshaper.values.errors import InputError, OperationError

LEFT_ALONE = "left alone, since users run them whom this run does not name: "
_MOST_NAMED = 5
DDS_PRIORITY = 90
DDS_RECEIVE_PRIORITY = 91
BEST_SERVER_PRIORITY = 87
RECEIVES = "receives the output"
STEP = 2
"""Between two servers there is room for a publisher below the better one's threads."""


@dataclass(frozen=True)
class RecordedThread:
    """A thread that a recording saw, by its id in its own pid namespace.

    ``nodes`` are those whose callbacks it ran.
    """

    tid: int
    role: ThreadRole
    nodes: tuple[str, ...]


@dataclass(frozen=True)
class RecordedProcess:
    """A process that a recording saw, last at ``seen_ns`` (ns of CLOCK_MONOTONIC)."""

    pid: int
    nodes: tuple[str, ...]
    threads: tuple[RecordedThread, ...]
    seen_ns: int


@dataclass(frozen=True)
class NodeThread:
    """A thread of an application, the nodes it works for, and how its role is known.

    ``known_by`` is empty when the role is unknown. ``nodes_known_by`` is ``recording``,
    ``command line``, or ``program's name``: a guess.
    """

    thread: Thread
    nodes: tuple[str, ...]
    known_by: str
    nodes_known_by: str


@dataclass(frozen=True)
class Allocation:
    """All threads of an application at one instant, and what is not certain about them.

    ``strangers`` is a line about processes of other users that say they are nodes, if any do.
    """

    threads: tuple[NodeThread, ...]
    notes: tuple[str, ...]
    strangers: str | None = None


@dataclass(frozen=True)
class _Identified:
    """A process with its nodes, how they are known, and its recorded self if there is one."""

    process: Process
    nodes: tuple[str, ...]
    nodes_known_by: str
    recorded: RecordedProcess | None


def allocate(
    processes: Sequence[Process],
    recorded: Sequence[RecordedProcess] = (),
    among: Sequence[Process] | None = None,
    users: Collection[int] | None = None,
) -> Allocation:
    """Find out what each thread of ``processes`` does.

    ``among`` are all processes that were looked at, where these are some of them: who started
    whom tells a node from the commands that run it. Two processes that both are a node, as far
    as can be seen, are a note, and both are given the node. Where ``users`` are given, processes
    of others have no nodes.
    """
    everybody = processes if among is None else among
    identified = _with_unique_names(
        [
            _identify(process, recorded)
            if users is None or process.user in users
            else _Identified(process, (), "", None)
            for process in everybody
        ]
    )
    wanted = {process.pid for process in processes}
    chosen = [one for one in identified if one.process.pid in wanted]
    threads = [thread for one in chosen for thread in _threads_of(one)]
    return Allocation(tuple(threads), (*_guesses(chosen), *_ambiguities(chosen)))


def new_and_ended(
    before: Allocation, now: Allocation
) -> tuple[tuple[NodeThread, ...], tuple[NodeThread, ...]]:
    """The threads that have appeared and those that are gone since an earlier look."""
    known = {known.thread.identity for known in before.threads}
    alive = {known.thread.identity for known in now.threads}
    return (
        tuple(found for found in now.threads if found.thread.identity not in known),
        tuple(gone for gone in before.threads if gone.thread.identity not in alive),
    )


def strangers_text(
    processes: Iterable[Process], users: Collection[int], nodes: Collection[str] | None = None
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
    return (
        f"{LEFT_ALONE}{', '.join(found[:_MOST_NAMED])}{more}; to take them for nodes, name their "
        "user (--user)"
    )


def _identify(process: Process, recorded: Sequence[RecordedProcess]) -> _Identified:
    named = named_nodes(process.command)
    match = next((seen for seen in recorded if _is_same(process, named, seen)), None)
    if match is not None and match.nodes:
        return _Identified(process, match.nodes, "recording", match)
    if named:
        # A container's command line names the container only; an earlier run tells its components.
        earlier = next((seen.nodes for seen in recorded if set(named) < set(seen.nodes)), None)
        known_by = "command line" if earlier is None else "recording"
        return _Identified(process, earlier or named, known_by, match)
    return _Identified(process, *_own_words(process), match)


def _own_words(process: Process) -> tuple[tuple[str, ...], str]:
    """The nodes that a process has by its command line, and which part of that says so."""
    named = named_nodes(process.command)
    if named:
        return named, "command line"
    guess = guessed_name(process.command)
    looks_like_a_node = process.participates or takes_ros_arguments(process.command)
    return ((guess,), "program's name") if guess is not None and looks_like_a_node else ((), "")


def _is_same(process: Process, named: tuple[str, ...], seen: RecordedProcess) -> bool:
    """Whether a process is the one that was recorded: its id, alive by then, no other name."""
    if seen.pid != process.inner_pid or not process.threads:
        return False
    asleep_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
    started_ns = process.threads[0].started * TICK_NS - asleep_ns
    if started_ns > seen.seen_ns + TICK_NS:
        return False
    return not (named and seen.nodes) or not set(named).isdisjoint(seen.nodes)


def _with_unique_names(identified: list[_Identified]) -> list[_Identified]:
    """Take a node's name from processes that carry it in their command line for another.

    Those that take part in DDS are the node, if any does. Of others, `ros2 run` and the like,
    the innermost is.
    """
    parent_of = {one.process.pid: one.process.parent for one in identified}
    claims: dict[str, list[_Identified]] = {}
    for one in identified:
        for name in one.nodes:
            claims.setdefault(name, []).append(one)
    carriers: set[tuple[int, str]] = set()
    for name, claimants in claims.items():
        if len(claimants) == 1:
            continue
        pids = {one.process.pid for one in claimants}
        for one in claimants:
            if any(other.process.participates for other in claimants):
                carries = not one.process.participates
            else:
                below = descendants(parent_of, one.process.pid) - {one.process.pid}
                carries = bool(below & pids)
            if carries:
                carriers.add((one.process.pid, name))
    return [
        replace(
            one, nodes=tuple(name for name in one.nodes if (one.process.pid, name) not in carriers)
        )
        for one in identified
    ]


def _threads_of(one: _Identified) -> list[NodeThread]:
    seen = {thread.tid: thread for thread in one.recorded.threads} if one.recorded else {}
    executors_seen = any(thread.role == "executor" for thread in seen.values())
    found = []
    for thread in one.process.threads:
        nodes, role, known_by = one.nodes, thread.role, ""
        recorded = seen.get(thread.inner_tid)
        if recorded is not None and recorded.role != "unknown":
            nodes, role, known_by = recorded.nodes or nodes, recorded.role, "recording"
        elif thread.role == "executor":
            role, known_by = ("executor", "main thread") if nodes else ("unknown", "")
            if executors_seen:  # others execute: a program that keeps its main thread out of it
                role, known_by = "unknown", ""
        elif thread.role != "unknown":
            known_by = "name"
        kind = thread.kind if role in ("dds", "publisher") else None
        found.append(
            NodeThread(replace(thread, role=role, kind=kind), nodes, known_by, one.nodes_known_by)
        )
    return found


def _guesses(identified: Iterable[_Identified]) -> list[str]:
    return [
        f"process {one.process.pid} is called {one.nodes[0]} after its program, which is a guess: "
        "name its recording, or start it with `--ros-args -r __node:=NAME`"
        for one in identified
        if one.nodes_known_by == "program's name" and one.nodes
    ]


def _ambiguities(identified: Iterable[_Identified]) -> list[str]:
    owners: dict[str, list[int]] = {}
    for one in identified:
        for name in one.nodes:
            owners.setdefault(name, []).append(one.process.pid)
    return [
        f"node {name} is ambiguous: processes {', '.join(map(str, pids))} all have it; give each "
        "a name or a namespace of its own, or end those that are not meant"
        for name, pids in owners.items()
        if len(pids) > 1
    ]


@dataclass(frozen=True)
class WantedScheduling:
    """What a thread shall get, for which server (None: it is in none), and why."""

    thread: NodeThread
    wanted: Scheduling
    server: str | None
    reason: str


def server_members(plan: Plan, allocation: Allocation) -> dict[str, tuple[NodeThread, ...]]:
    """The threads of each server of a plan, by the server's name.

    Nodes of one process may share an executor: then it is one thread of their server. Raises
    OperationError: a planned thread is not running, two processes are the same node, or one thread
    executes nodes of two servers.
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

    Raises InputError: there are more than 43 of them.
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

    Receivers that do not run are left out: not everybody who subscribes is always there. Raises
    OperationError: see :func:`server_members`. InputError: see :func:`server_priorities`.
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

    ``members`` are by server's name. ``receiving`` is what threads that receive an output shall
    get, whose processes are treated alike. Raises OperationError: a thread cannot leave the core of
    a publisher that would outrank it. InputError: see :func:`server_priorities`.
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
    family: dict[int, list[WantedScheduling]] = {}
    for one in wanted:
        if one.thread.thread.role != "publisher" and one.wanted.priority is not None:
            family.setdefault(one.thread.thread.pid, []).append(one)
    return tuple(
        _below(one, family.get(one.thread.thread.pid, ()))
        if one.thread.thread.role == "publisher"
        else one
        for one in wanted
    )


def _below(publisher: WantedScheduling, family: Iterable[WantedScheduling]) -> WantedScheduling:
    core = (publisher.wanted.cores or (None,))[0]
    siblings = [
        (one.wanted.priority or 0) - 1
        for one in family
        if core in (one.wanted.cores or one.thread.thread.cores)
    ]
    below = max(1, min(siblings, default=99))
    if below >= (publisher.wanted.priority or 0):
        return publisher
    wanted = replace(publisher.wanted, priority=below)
    return replace(publisher, wanted=wanted, reason="below its siblings, whose locks it spins on")


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
