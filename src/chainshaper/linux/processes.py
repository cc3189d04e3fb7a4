"""Processes that may belong to a ROS 2 or DDS application, and the nodes that they name.

A process takes part in DDS when it has a thread that receives or one for timed events, by the names
of a DDS implementation; where those do not name theirs (Fast DDS before 2.13), a mapped library
together with further threads has to do. That distinguishes a node from what only carries its
command line: `ros2 run`, `gdb --args`, or a forked helper.

Users name nodes by remap rules behind `--ros-args`: ``-r __node:=NAME`` and ``-r __ns:=/NAMESPACE``
hold for every node of the process, ``-r OLD:__node:=NAME`` for its node that would be called OLD
only. Of rules that apply, the first one counts. What is quoted for a shell is one argument here, so
a parameter's value that looks like a rule is not taken for one.

Upstream: rcl, `arguments.c` and `remap.c`, whose tests say which rules are valid.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from chainshaper.linux.threads import (
    Thread,
    innermost_id,
    list_threads,
    parents,
    read_proc,
)
from chainshaper.linux.users import process_folder, user_in

_RULE = re.compile(r"(?:([A-Za-z_]\w*):)?__(node|name|ns):=(\S+)", re.ASCII)
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/|(/[A-Za-z_]\w*)+", re.ASCII)
_WITH_VALUE = frozenset(
    ("-p", "--param", "--params-file", "--log-level", "--log-config-file", "--log-file-name")
) | frozenset(("-e", "--enclave"))
_LIBRARIES_WITHOUT_NAMED_THREADS = (
    b"/libfastrtps.so",
    b"/libfastdds.so",
    b"/libnddscore.so",
    b"/libgurumdds.so",
    b"/librmw_zenoh_cpp.so",
)


@dataclass(frozen=True)
class Process:
    """A process at one instant; ``inner_pid`` is its id in its own pid namespace.

    ``user`` is whose it is, None if no single user's (:mod:`.users`).
    """

    pid: int
    parent: int
    command: tuple[str, ...]
    inner_pid: int
    participates: bool  # in DDS
    threads: tuple[Thread, ...]
    user: int | None = None


def list_processes(pids: Iterable[int] | None = None) -> tuple[Process, ...]:
    """Processes with a command line (kernel threads have none), by id; all if none are given."""
    found = (read_process(pid) for pid in sorted(parents() if pids is None else pids))
    return tuple(process for process in found if process is not None)


def read_process(pid: int) -> Process | None:
    """A process, None when it is gone, dead, or the kernel's own."""
    try:
        with process_folder(pid) as folder:
            user = user_in(folder)
            command = read_proc("cmdline", folder)
            if not command:
                return None
            status = read_proc("status", folder).decode(errors="replace")
            threads = list_threads(pid)
            # It is the same process still, and the same user's: its id is no other's by now.
            if not threads or user_in(folder) != user:
                return None
    except OSError:
        return None
    parent = next(line.split()[1] for line in status.splitlines() if line.startswith("PPid:"))
    return Process(
        pid=pid,
        parent=int(parent),
        command=tuple(command.rstrip(b"\0").decode(errors="replace").split("\0")),
        inner_pid=innermost_id(status) or pid,
        participates=_participates(pid, threads),
        threads=threads,
        user=user,
    )


def descendants(parent_of: Mapping[int, int], pid: int) -> frozenset[int]:
    """A process and all its children, theirs and so on; ``parent_of`` maps each to its parent."""
    family, grown = {pid}, True
    while grown:
        more = {child for child, parent in parent_of.items() if parent in family} - family
        family |= more
        grown = bool(more)
    return frozenset(family)


def find_applications(processes: Iterable[Process]) -> tuple[Process, ...]:
    """Those that look like applications of ROS 2 or DDS."""
    return tuple(
        process
        for process in processes
        if process.participates or takes_ros_arguments(process.command)
    )


def _participates(pid: int, threads: tuple[Thread, ...]) -> bool:
    if any(thread.kind in ("receive", "event") for thread in threads):
        return True
    if len(threads) == 1:
        return False
    try:
        mapped = read_proc(f"/proc/{pid}/maps")
    except OSError:
        return False  # another user's: its threads' names are all there is to see
    return any(library in mapped for library in _LIBRARIES_WITHOUT_NAMED_THREADS)


def takes_ros_arguments(command: Sequence[str]) -> bool:
    return "--ros-args" in command


def named_nodes(command: Sequence[str]) -> tuple[str, ...]:
    """Full names of the nodes that a command line names, in the order of their rules.

    A node's own namespace is not known from outside; without a rule it is taken for `/`, which
    it is unless the program says otherwise.

        >>> named_nodes(["talker", "--ros-args", "-r", "__node:=front", "-r", "__ns:=/lidar"])
        ('/lidar/front',)
        >>> named_nodes(["two", "--ros-args", "-r", "a:__node:=x", "-r", "b:__node:=y"])
        ('/x', '/y')
    """
    names: dict[str | None, str] = {}
    namespaces: dict[str | None, str] = {}
    for owner, what, value in _rules(command):
        if what == "ns":
            namespaces.setdefault(owner, value)
        elif None not in names:
            names.setdefault(owner, value)  # rules behind one for all nodes never apply
    found = []
    for owner, name in names.items():
        # A rule for all nodes that stands first would apply instead of a node's own behind it.
        namespace = namespaces.get(None, "/")
        if owner in namespaces and _first(namespaces, owner):
            namespace = namespaces[owner]
        found.append(_full(namespace, name))
    if None not in names:
        found += [
            _full(namespace, owner)
            for owner, namespace in namespaces.items()
            if owner is not None and owner not in names and _first(namespaces, owner)
        ]
    return tuple(dict.fromkeys(found))


def guessed_name(command: Sequence[str]) -> str | None:
    """A node's name by that of its program: no more than a guess, None without a program."""
    interpreted = bool(command) and re.fullmatch(r"python[0-9.]*", PurePath(command[0]).name)
    for argument in command[1:] if interpreted else command[:1]:
        if argument == "-c":
            return None
        if not argument.startswith("-"):
            stem = PurePath(argument).name.removesuffix(".py")
            return f"/{re.sub(r'[^A-Za-z0-9_]', '_', stem)}" if stem else None
    return None


def _first(namespaces: dict[str | None, str], owner: str | None) -> bool:
    """Whether a node's own namespace rule stands before the rule for all nodes, if there is one."""
    order = list(namespaces)
    return None not in namespaces or order.index(owner) <= order.index(None)


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _rules(command: Sequence[str]) -> Iterator[tuple[str | None, str, str]]:
    """Valid rules about names: (node they are for or None, ``node`` or ``ns``, value)."""
    arguments = iter(command)
    for argument in arguments:
        if argument != "--ros-args":
            continue
        for ros_argument in arguments:
            if ros_argument == "--":
                break
            if ros_argument in _WITH_VALUE:
                next(arguments, None)
            elif ros_argument in ("-r", "--remap"):
                rule = _RULE.fullmatch(next(arguments, ""))
                if rule is None:
                    continue
                owner, what, value = rule.groups()
                if what == "ns" and _NAMESPACE.fullmatch(value):
                    yield owner, "ns", value
                elif what != "ns" and _NAME.fullmatch(value):
                    yield owner, "node", value
