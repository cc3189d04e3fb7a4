"""Processes that may belong to a ROS 2 or DDS application, whose they are, and their nodes' names.

A process takes part in DDS when it has a thread that receives or one for timed events, by the names
of a DDS implementation, or, where those name none (Fast DDS before 2.13), a mapped library and
further threads.

A process is a user's when that user both runs it, by all four of its user ids, and has started its
program: set-user-ID programs, such as `sudo`, carry the command line and the environment of another
user than the one they run as. Root may start programs for all.

Upstream: proc(5), credentials(7), getauxval(3); rcl, `arguments.c` and `remap.c`.
"""

import os
import platform
import pwd
import re
import struct
from bisect import bisect
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import NamedTuple

from chainshaper.linux.threads import (
    RunningThread,
    innermost_id,
    is_of_zenoh,
    lines_of,
    list_threads,
    parents,
    read_proc,
    status_field,
)
from chainshaper.values.errors import InputError, text_of
from chainshaper.values.middleware import (
    MIDDLEWARES,
    ZENOH,
    Middleware,
    MiddlewareLimit,
    limit_by_thread,
    thread_work,
)

_AT_UID = 11
_AUXILIARY = struct.Struct("@NN")
_RULE = re.compile(
    r"(?:([A-Za-z_]\w*):)?__(?:(?:node|name):=([A-Za-z_]\w*)|ns:=(/|(?:/[A-Za-z_]\w*)+))", re.ASCII
)
_WITH_VALUE = {"-p", "--param", "--params-file", "-e", "--enclave"}
_WITH_VALUE |= {"--log-level", "--log-config-file", "--log-file-name"}


def run_users(named: Collection[str | int] = ()) -> frozenset[int]:
    """The ids of users, by names or numbers; by default who has launched us, also by `sudo`, and
    root. Raises InputError: no such user.
    """
    users = set()
    for name in map(str, named):
        try:
            users.add(int(name) if name.isdecimal() else pwd.getpwnam(name).pw_uid)
        except KeyError:
            raise InputError(f"no user is named {name!r}: `getent passwd` lists them") from None
    launched = {os.getuid(), os.geteuid(), 0}
    behind_sudo = os.environ.get("SUDO_UID", "")
    if os.geteuid() == 0 and behind_sudo.isdecimal():
        launched.add(int(behind_sudo))
    return frozenset(users or launched)


def user_name(user: int | None) -> str:
    if user is None:
        return "several users"
    with suppress(KeyError):
        return pwd.getpwuid(user).pw_name
    return str(user)


@contextmanager
def process_folder(pid: int) -> Iterator[int]:
    """A process's folder in /proc, open: never another process's. Raises OSError: it has ended."""
    folder = os.open(f"/proc/{pid}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield folder
    finally:
        os.close(folder)


def user_of(pid: int) -> int | None:
    """The user whose process this is; None if it is no single user's, or gone."""
    with suppress(OSError), process_folder(pid) as folder:
        return user_in(folder)
    return None


def user_in(folder: int) -> int | None:
    """The same from a process's open folder. Raises OSError: the process has ended."""
    user, *others = status_field(read_proc("status", folder), "Uid")
    if any(other != user for other in others):
        return None
    auxiliary = b""
    with suppress(OSError):  # it may not be looked at
        auxiliary = read_proc("auxv", folder)
    entries = _AUXILIARY.iter_unpack(auxiliary[: len(auxiliary) & -_AUXILIARY.size])
    # The real user when it began its program: who chose command line and environment.
    started_by = next((value for kind, value in entries if kind == _AT_UID), None)
    if started_by is None:  # what is root's by its ids may be a set-user-ID program
        return None if user == 0 and os.geteuid() == 0 else user
    starters = {started_by}
    for line in lines_of(read_proc("uid_map", folder)):  # of its user namespace
        inside, outside, count = map(int, line.split())
        if inside <= started_by < inside + count:
            starters.add(outside + started_by - inside)
    return user if starters & {user, 0} else None


@dataclass(frozen=True)
class RunningProcess:
    """A process at one instant; ``inner_pid`` is its id in its own pid namespace, ``user`` None if
    it is no single user's. Whether it ``participates`` in DDS.
    """

    pid: int
    parent: int
    command: tuple[str, ...]
    inner_pid: int
    participates: bool
    threads: tuple[RunningThread, ...]
    user: int | None = None


def list_processes(pids: Iterable[int] | None = None) -> tuple[RunningProcess, ...]:
    """Processes with a command line (kernel threads have none), by id; all if none are given."""
    found = (read_process(pid) for pid in sorted(parents() if pids is None else pids))
    return tuple(process for process in found if process is not None)


def read_process(pid: int) -> RunningProcess | None:
    """A process, None when it is gone, dead, or the kernel's own."""
    try:
        with process_folder(pid) as folder:
            user = user_in(folder)
            command = read_proc("cmdline", folder)
            if not command:
                return None
            status = read_proc("status", folder)
            participates, threads = _participation(pid, list_threads(pid))
            # It is the same process still, and the same user's: its id is no other's by now.
            if not threads or user_in(folder) != user:
                return None
    except OSError:
        return None
    return RunningProcess(
        pid=pid,
        parent=status_field(status, "PPid")[0],
        command=tuple(map(text_of, command.rstrip(b"\0").split(b"\0"))),
        inner_pid=innermost_id(status) or pid,
        participates=participates,
        threads=threads,
        user=user,
    )


def descendants(parent_of: Mapping[int, int], *pids: int) -> frozenset[int]:
    """Processes and all their children, theirs and so on; ``parent_of`` maps each to its parent."""
    family, born = set(pids), set(pids)
    while born:
        born = {child for child, parent in parent_of.items() if parent in born} - family
        family |= born
    return frozenset(family)


def find_applications(processes: Iterable[RunningProcess]) -> tuple[RunningProcess, ...]:
    """Those that look like applications of ROS 2 or DDS."""
    return tuple(one for one in processes if one.participates or takes_ros_arguments(one.command))


def _participation(
    pid: int, threads: tuple[RunningThread, ...]
) -> tuple[bool, tuple[RunningThread, ...]]:
    """Whether a process takes part in DDS, and its threads with what they do there."""
    if any(thread.kind in ("receive", "event") for thread in threads):
        return True, threads
    if len(threads) > 1:
        with suppress(OSError):  # another user's: its threads' names are all there is to see
            mapped = read_proc(f"/proc/{pid}/maps")
            for middleware in MIDDLEWARES:
                waited_in = middleware.receivers_wait_in
                if waited_in and waited_in.encode() in mapped:
                    regions = list(regions_in(mapped))
                    threads = tuple(
                        replace(thread, role="dds", kind="receive")
                        if thread.tid != pid and _receives(thread, regions, middleware)
                        else thread
                        for thread in threads
                    )
            names = [name for middleware in MIDDLEWARES for name in middleware.nameless_libraries]
            return any(f"/lib{name}.so".encode() in mapped for name in names), threads
    return False, threads


class Region(NamedTuple):
    """An area of a process's memory, ``offset`` bytes into the file ``path``, or with no file, or
    the kernel's name for it (``[stack]``).
    """

    start: int
    end: int
    offset: int
    executable: bool
    path: str


def regions_in(maps: bytes) -> Iterator[Region]:
    """The regions in the content of a file /proc/PID/maps, by address."""
    for line in filter(None, lines_of(maps)):
        span, rights, offset, _, _, *path = line.split(maxsplit=5)
        start, end = (int(bound, 16) for bound in span.split(b"-"))
        name = os.fsdecode(path[0]) if path else ""  # it may be opened
        yield Region(start, end, int(offset, 16), b"x" in rights, name)


def region_at(regions: Sequence[Region], address: int) -> Region | None:
    """The region, of those of a process by address, that has this one."""
    number = bisect(regions, address, key=lambda one: one.start) - 1
    return regions[number] if number >= 0 and address < regions[number].end else None


_SYSCALLS = {"x86_64": ((45, 47), 202), "aarch64": ((207, 212), 98)}  # recvfrom, recvmsg; futex
_OF_LANGUAGE = re.compile(r"/(lib(c|pthread|stdc\+\+|gcc_s)|ld-linux[-\w]*)[-.]|\[vdso\]")
_OUTERMOST = 16_384  # so near are a thread's first frames to where it waits, and to its stack's end


def _receives(thread: RunningThread, regions: Sequence[Region], middleware: Middleware) -> bool:
    """Whether a thread without a name receives for a middleware.

    It does if it waits for a datagram, or for a word in the memory of a port, and the middleware's
    function is the first on its stack. False too for one that runs just now, and without
    ptrace(2)'s PTRACE_MODE_ATTACH.
    """
    receive, futex = _SYSCALLS.get(platform.machine(), ((), -1))
    try:
        number, *values = read_proc(f"/proc/{thread.pid}/task/{thread.tid}/syscall").split()
        if len(values) < 8:  # it runs, or sleeps outside of a system call
            return False
        word, stack = (region_at(regions, int(values[k], 16)) for k in (0, 6))
        at_port = int(number) == futex and word is not None and middleware.port_memory in word.path
        if stack is None or not (at_port or int(number) in receive):
            return False
        top = int(values[6], 16)
        with Path(f"/proc/{thread.pid}/mem").open("rb") as memory:
            data = os.pread(memory.fileno(), min(_OUTERMOST, stack.end - top) & -8, top)
    except OSError:  # it ended, or may not be looked at
        return False
    lowest = regions[0].start
    for (address,) in reversed([*struct.iter_unpack("=Q", data)]):  # the outermost frame first
        found = region_at(regions, address) if address >= lowest else None
        if found is not None and found.executable and not _OF_LANGUAGE.search(found.path):
            return middleware.receivers_wait_in in found.path
    return False


def middleware_limit(process: RunningProcess) -> MiddlewareLimit | None:
    """What is limited in a process that takes part in DDS, as far as its threads tell."""
    others = [thread for thread in process.threads if thread.tid != process.pid]
    if not process.participates or not others:
        return None
    if any(map(is_of_zenoh, others)):
        return ZENOH.limit
    for thread in others:
        if (limit := limit_by_thread(thread.comm)) is not None:
            return limit
    return None if any(thread_work(thread.comm) is not None for thread in others) else "unnamed"


def takes_ros_arguments(command: Sequence[str]) -> bool:
    return "--ros-args" in command


def named_nodes(command: Sequence[str]) -> tuple[str, ...]:
    """Full names of the nodes that a command line names, in the order of their remap rules.

    ``__node:=NAME`` and ``__ns:=/NAMESPACE`` apply to every node of the process,
    ``OLD:__node:=NAME`` to the one that would be called OLD; the first that applies counts. Without
    a rule a namespace is taken for `/`, which it is unless the program says otherwise.

        >>> named_nodes(["talker", "--ros-args", "-r", "__node:=front", "-r", "__ns:=/lidar"])
        ('/lidar/front',)
        >>> named_nodes(["two", "--ros-args", "-r", "a:__node:=x", "-r", "b:__node:=y"])
        ('/x', '/y')
    """
    names: dict[str | None, str] = {}
    namespaces: dict[str | None, str] = {}
    for rule in filter(None, map(_RULE.fullmatch, _remap_rules(command))):
        owner, name, namespace = rule.groups()
        found = names if name else namespaces
        if None not in found:  # rules behind one for all nodes never apply
            found.setdefault(owner, name or namespace)
    if None not in names:  # nodes of which only the namespace is remapped
        names |= {owner: owner for owner in namespaces if owner and owner not in names}
    for_all = namespaces.get(None, "/")
    full = (f"{namespaces.get(o, for_all).rstrip('/')}/{name}" for o, name in names.items())
    return tuple(dict.fromkeys(full))


def _remap_rules(command: Sequence[str]) -> Iterator[str]:
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
                yield next(arguments, "")


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
