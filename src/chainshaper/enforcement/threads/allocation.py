"""Which thread does what in an application: the paper's Thread Allocator (section 4.2).

What is known of a thread, the stronger evidence first:

1. a recording saw it: the callbacks that it ran say which nodes it executes;
2. its name, which DDS implementations choose (:mod:`chainshaper.linux.dds_threads`);
3. its place: executors spin on the main thread, unless the program arranges it otherwise.

What no evidence covers stays unknown. Which nodes a process has, a recording says (also one of an
earlier run, where the command line names one of them), or the remap rules of its command line; the
name of its program is a guess, and called one.

Whoever may say such things of himself: only processes of the users that are asked for are nodes
(:mod:`.users`). Those of others that repeat a node's name are named, and left alone.

Everything here is a function of what was seen at one instant (:mod:`.processes`). Threads that
appear later are found by looking again and comparing (:func:`new_and_ended`).
"""

import time
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from chainshaper.linux.dds_threads import ThreadRole
from chainshaper.linux.node_names import (
    guessed_name,
    named_nodes,
    takes_ros_arguments,
)
from chainshaper.linux.processes import Process, descendants
from chainshaper.linux.threads import TICK_NS, Thread
from chainshaper.linux.users import user_name

__all__ = [
    "LEFT_ALONE",
    "Allocation",
    "NodeThread",
    "RecordedProcess",
    "RecordedThread",
    "allocate",
    "new_and_ended",
    "strangers_text",
]

LEFT_ALONE = "left alone, since users run them whom this run does not name: "
_MOST_NAMED = 5


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
    """One line about processes that are none of the users', and carry a name of one of ``nodes``.

    Of any node if none are given.
    """
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
