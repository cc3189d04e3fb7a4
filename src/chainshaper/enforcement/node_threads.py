"""Which node each thread of an application belongs to, and what it does there.

A thread's role is known by, the strongest evidence first:

1. the callbacks that it ran in a recording;
2. its name, if DDS has given it one;
3. its being the main thread: executors spin there unless the program arranges it otherwise.

The nodes of a process are known by, the strongest evidence first:

1. a recording of this very process, or of an earlier run of the same program;
2. its command line (`--ros-args -r __node:=NAME`);
3. the name of its program, which is a guess.
"""

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

from chainshaper.linux.processes import (
    RunningProcess,
    descendants,
    guessed_name,
    middleware_limit,
    named_nodes,
    takes_ros_arguments,
    user_name,
)
from chainshaper.linux.threads import (
    TICK_NS,
    RunningThread,
    ThreadRole,
    gate_thread_name,
    since_boot_ns,
)
from chainshaper.planning.chain_plan import ShapingNode
from chainshaper.values.middleware import MIDDLEWARE_LIMITS, ROUTERS, MiddlewareLimit

IN_ORDER = "its executors are known by the order in which it started its threads, as when recorded"
LEFT_ALONE = "left alone, since users run them whom this run does not name: "
_MOST_NAMED = 5  # nodes or processes in a line
_COMM_LENGTH = 15  # characters: the kernel cuts off what is longer in a thread's name


@dataclass(frozen=True)
class RecordedThread:
    """A thread in a recording, and whose callbacks it ran."""

    tid: int  # its id in the recording
    role: ThreadRole
    nodes: tuple[str, ...]
    comm: str = ""  # its name
    # (node, trigger) of the callbacks of its executor, where the process has several executors
    callbacks: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class RecordedProcess:
    """A process in a recording."""

    pid: int
    nodes: tuple[str, ...]
    threads: tuple[RecordedThread, ...]
    seen_ns: int  # when it was seen last (ns of CLOCK_MONOTONIC)
    # Whether ids are those of our pid namespace; else they are those of the process's own.
    numbered_here: bool = False


@dataclass(frozen=True)
class NodeThread:
    """A running thread of an application, and the nodes that it works for."""

    thread: RunningThread
    nodes: tuple[str, ...]
    known_by: str  # what its role is known by; "": its role is not known
    nodes_known_by: str  # "recording", "command line" or, a guess, "program's name"
    callbacks: tuple[tuple[str, str], ...] = ()  # see RecordedThread


@dataclass(frozen=True)
class Allocation:
    """All threads of an application at one instant."""

    threads: tuple[NodeThread, ...]
    notes: tuple[str, ...]  # what is not certain about them
    strangers: str | None = None  # a line about other users' processes that say they are nodes


class _Identified(NamedTuple):
    """A process, and what is known of its nodes and threads."""

    process: RunningProcess
    nodes: tuple[str, ...] = ()
    nodes_known_by: str = ""  # see NodeThread
    # The recorded threads, by the ids that they have now in the process's pid namespace
    recorded: Mapping[int, RecordedThread] = MappingProxyType({})
    in_order: bool = False  # whether threads were matched with those of an earlier run, by order
    main_executes: bool = True  # whether the main thread may be an executor


def allocate(
    processes: Sequence[RunningProcess],
    recorded: Sequence[RecordedProcess] = (),
    among: Sequence[RunningProcess] | None = None,
    users: Collection[int] | None = None,
) -> Allocation:
    """Find out what each thread of ``processes`` does.

    ``among`` are all processes that were looked at: which of them started which tells a node from
    the commands that run it. Only processes of ``users`` can have nodes (None: of all users).
    """
    looked_at = processes if among is None else among
    identified = [
        _identify(process, recorded)
        if users is None or process.user in users
        else _Identified(process)
        for process in looked_at
    ]
    wanted = {process.pid for process in processes}
    chosen = [known for known in _with_unique_names(identified) if known.process.pid in wanted]
    notes = [
        f"process {known.process.pid} is called {known.nodes[0]} after its program, which is a"
        " guess: name its recording, or start it with `--ros-args -r __node:=NAME`"
        for known in chosen
        if known.nodes_known_by == "program's name"
        and known.nodes
        and known.nodes[0] not in ROUTERS
    ]
    notes += [ambiguous_node(name, pids) for name, pids in _claims(chosen).items()]
    notes += [
        f"process {known.process.pid} of {', '.join(known.nodes)}: {IN_ORDER}"
        for known in chosen
        if known.in_order
    ]
    threads = tuple(thread for known in chosen for thread in _threads_of(known))
    return Allocation(threads, (*notes, *_middleware_limits(chosen)))


def ambiguous_node(node: str, pids: Iterable[int]) -> str:
    """Say that several processes have a node's name, and what to do."""
    return (
        f"node {node} is ambiguous: processes {', '.join(map(str, pids))} all have it; give each a "
        "name or a namespace of its own, or end those that are not meant"
    )


def _middleware_limits(identified: Iterable[_Identified]) -> Iterator[str]:
    """A line for each middleware that is supported in part only, with the nodes that use it."""
    nodes_by_limit: dict[MiddlewareLimit, set[str]] = {}
    for known in identified:
        if known.nodes and (limit := middleware_limit(known.process)) is not None:
            nodes_by_limit.setdefault(limit, set()).update(known.nodes)
    for limit, nodes in nodes_by_limit.items():
        named = sorted(nodes)[:_MOST_NAMED]
        if len(nodes) > _MOST_NAMED:
            named.append("…")
        yield f"{', '.join(named)}: {MIDDLEWARE_LIMITS[limit]}"


def with_gates(allocation: Allocation, nodes: Iterable[ShapingNode]) -> Allocation:
    """Give the threads that work for gates in publishers' processes to these shaping nodes."""
    node_of = {gate_thread_name(node.name): node.thread.node for node in nodes}
    threads = []
    for listed in allocation.threads:
        if node := node_of.get(listed.thread.comm):
            thread = replace(listed.thread, role="executor")
            threads.append(replace(listed, thread=thread, nodes=(node,), known_by="name"))
        else:
            threads.append(listed)
    return replace(allocation, threads=tuple(threads))


def new_and_ended(
    before: Allocation, now: Allocation
) -> tuple[tuple[NodeThread, ...], tuple[NodeThread, ...]]:
    """Return the threads that have appeared, and those that are gone, since an earlier look."""
    before_ids = {listed.thread.identity for listed in before.threads}
    now_ids = {listed.thread.identity for listed in now.threads}
    new = tuple(listed for listed in now.threads if listed.thread.identity not in before_ids)
    ended = tuple(listed for listed in before.threads if listed.thread.identity not in now_ids)
    return new, ended


def strangers_text(
    processes: Iterable[RunningProcess],
    users: Collection[int],
    nodes: Collection[str] | None = None,
) -> str | None:
    """Return a line about processes of users not in ``users`` that say they are nodes.

    ``nodes`` are the names that matter; None: all.
    """
    strangers = []
    for process in processes:
        if process.user in users:
            continue
        names = [name for name in _nodes_by_command(process)[0] if nodes is None or name in nodes]
        if names:
            named = ", ".join(names[:_MOST_NAMED])
            strangers.append(f"{named} (process {process.pid} of {user_name(process.user)})")
    if not strangers:
        return None
    more = f" and {len(strangers) - _MOST_NAMED} more" if len(strangers) > _MOST_NAMED else ""
    listed = f"{', '.join(strangers[:_MOST_NAMED])}{more}"
    return f"{LEFT_ALONE}{listed}; to take them for nodes, name their user (--user)"


def _identify(process: RunningProcess, recorded: Sequence[RecordedProcess]) -> _Identified:
    """Find the nodes and the recorded threads of a process."""
    named = named_nodes(process.command)
    nodes, known_by = _nodes_by_command(process)
    itself = next((seen for seen in recorded if _is_same(process, named, seen)), None)
    namesake = next((seen for seen in recorded if nodes and set(nodes) <= set(seen.nodes)), None)
    run = itself or namesake or _same_program(nodes, named, recorded)
    if run is None:
        return _Identified(process, nodes, known_by)
    # The command line of a container does not name its components, and many name no node at all.
    recording_knows_more = itself or not namesake or (named and set(named) < set(run.nodes))
    if recording_knows_more and run.nodes:
        nodes, known_by = run.nodes, "recording"
    if itself is None:
        threads = _in_order(process, run)
    elif run.numbered_here:
        inner = {thread.tid: thread.inner_tid for thread in process.threads}
        threads = {inner[thread.tid]: thread for thread in run.threads if thread.tid in inner}
    else:
        threads = {thread.tid: thread for thread in run.threads}
    executing = [thread.tid for thread in run.threads if thread.role == "executor"]
    return _Identified(
        process,
        nodes,
        nodes_known_by=known_by,
        recorded=threads,
        in_order=itself is None and bool(threads),
        main_executes=not executing or run.pid in executing,
    )


def _same_program(
    guess: Sequence[str], named: Sequence[str], recorded: Sequence[RecordedProcess]
) -> RecordedProcess | None:
    """Find the recorded run of a program that names its nodes in its code; None: not one only.

    It is known by the name of its main thread, which is the program's.
    """
    if named or not guess:
        return None
    main = guess[0][1:][:_COMM_LENGTH]
    runs = [
        seen
        for seen in recorded
        if seen.nodes
        and any((thread.tid, thread.comm) == (seen.pid, main) for thread in seen.threads)
    ]
    return runs[0] if len(runs) == 1 else None


def _in_order(process: RunningProcess, earlier: RecordedProcess) -> dict[int, RecordedThread]:
    """Match the threads of a process with those of an earlier run; none if that is not sure.

    A program starts its threads in the same order every time. So among threads of the same name,
    the first now is the first then, and so on, if there are as many. Executors are matched only if
    they ran on others than the main thread. Threads of loops always are.
    """
    executing = [thread for thread in earlier.threads if thread.role == "executor"]
    looping = [thread for thread in earlier.threads if thread.role == "loop"]
    matched: dict[int, RecordedThread] = {}
    if all(thread.tid == earlier.pid for thread in executing):
        executing = []
    for name in {thread.comm for thread in (*executing, *looping)}:
        before = [thread for thread in earlier.threads if thread.comm == name]
        now = [thread.inner_tid for thread in process.threads if thread.comm == name]
        if len(before) != len(now):
            return {}
        # Ids ascend in order of start, but begin again at the lowest that is free.
        now.sort(key=lambda tid: (tid < process.inner_pid, tid))
        before.sort(key=lambda thread: (thread.tid < earlier.pid, thread.tid))
        matched |= zip(now, before, strict=True)
    return matched


def _nodes_by_command(process: RunningProcess) -> tuple[tuple[str, ...], str]:
    """Return the nodes of a process by its command line, and which part of that says so."""
    if named := named_nodes(process.command):
        return named, "command line"
    guess = guessed_name(process.command)
    looks_like_a_node = process.participates or takes_ros_arguments(process.command)
    if guess is not None and looks_like_a_node:
        return (guess,), "program's name"
    return (), ""


def _is_same(process: RunningProcess, named: tuple[str, ...], seen: RecordedProcess) -> bool:
    """Whether a process is the recorded one: it has the id, was alive then, has no other name."""
    pid = process.pid if seen.numbered_here else process.inner_pid
    if seen.pid != pid or not process.threads:
        return False
    asleep_ns = since_boot_ns() - time.monotonic_ns()
    if process.threads[0].started * TICK_NS - asleep_ns > seen.seen_ns + TICK_NS:
        return False
    return not (named and seen.nodes) or not set(named).isdisjoint(seen.nodes)


def _claims(identified: Iterable[_Identified]) -> dict[str, list[int]]:
    """Return the names that several processes have, with the ids of these processes."""
    claims: dict[str, list[int]] = {}
    for known in identified:
        for name in known.nodes:
            claims.setdefault(name, []).append(known.process.pid)
    return {name: pids for name, pids in claims.items() if len(pids) > 1}


def _with_unique_names(identified: list[_Identified]) -> list[_Identified]:
    """Take a node's name from the commands that run the node, such as `ros2 run`.

    Of several processes with a name, the node is the one that takes part in DDS; if none does, it
    is the innermost one, which the others have started.
    """
    parent_of = {known.process.pid: known.process.parent for known in identified}
    participants = {known.process.pid for known in identified if known.process.participates}
    carried = set[tuple[int, str]]()
    for name, pids in _claims(identified).items():
        innermost = {pid for pid in pids if descendants(parent_of, pid).intersection(pids) == {pid}}
        node = participants.intersection(pids) or innermost
        carried |= {(pid, name) for pid in pids if pid not in node}
    unique = []
    for known in identified:
        pid = known.process.pid
        nodes = tuple(name for name in known.nodes if (pid, name) not in carried)
        unique.append(known._replace(nodes=nodes))
    return unique


def _threads_of(known: _Identified) -> Iterable[NodeThread]:
    """Yield the threads of a process, with their roles."""
    for thread in known.process.threads:
        nodes, role, known_by = known.nodes, thread.role, ""
        recorded = known.recorded.get(thread.inner_tid)
        if recorded is not None and recorded.role != "unknown":
            nodes, role = recorded.nodes or nodes, recorded.role
            known_by = "order of start" if known.in_order else "recording"
        elif thread.role == "executor":
            main = bool(nodes) and known.main_executes
            role, known_by = ("executor", "main thread") if main else ("unknown", "")
        elif thread.role != "unknown":
            known_by = "name"
        kind = thread.kind if role in ("dds", "publisher") else None
        with_role = replace(thread, role=role, kind=kind)
        callbacks = () if recorded is None else recorded.callbacks
        yield NodeThread(with_role, nodes, known_by, known.nodes_known_by, callbacks)
