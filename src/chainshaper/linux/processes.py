"""Processes that may belong to a ROS 2 or DDS application: their users, and their nodes' names.

**DDS.** A process takes part in DDS if a thread has the name of a thread that receives, or that
handles timed events, in a DDS implementation. Where threads have no names (Fast DDS before 2.13),
it does if it has mapped the library and has further threads.

**Users.** A process is a user's if that user both runs it, by all four of its user ids, and has
started its program. A set-user-ID program, such as `sudo`, has the command line and environment of
another user than the one it runs as. Root may start programs for every user.

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
    Middleware,
    MiddlewareLimit,
    limit_by_thread,
    thread_work,
)

_AT_UID = 11
_AUXILIARY = struct.Struct("@NN")
# Remap rules that name nodes. Those for topics are in splicing/redirection.py, which stands alone.
_NODE_NAME_RULE = re.compile(
    r"(?:([A-Za-z_]\w*):)?__(?:(?:node|name):=([A-Za-z_]\w*)|ns:=(/|(?:/[A-Za-z_]\w*)+))", re.ASCII
)
_WITH_VALUE = {"-p", "--param", "--params-file", "-e", "--enclave"}
_WITH_VALUE |= {"--log-level", "--log-config-file", "--log-file-name"}


def boot_id() -> str:
    """Return the id that the kernel has given itself when it booted."""
    return text_of(read_proc("/proc/sys/kernel/random/boot_id")).strip()


def run_users(named: Collection[str | int] = ()) -> frozenset[int]:
    """Return the ids of users that are named, by name or number.

    By default they are root and the user that has started us, also by `sudo`. Raises InputError:
    there is no such user.
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
    """Return a user's name, or the id of one without; None: the process is of several users."""
    if user is None:
        return "several users"
    with suppress(KeyError):
        return pwd.getpwuid(user).pw_name
    return str(user)


@contextmanager
def process_folder(pid: int) -> Iterator[int]:
    """Open a process's folder in /proc, which never becomes another process's.

    Raises OSError: the process has ended.
    """
    folder = os.open(f"/proc/{pid}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield folder
    finally:
        os.close(folder)


def user_of(pid: int) -> int | None:
    """Return the user of a process; None: it is of no single user, or has ended."""
    with suppress(OSError), process_folder(pid) as folder:
        return user_in(folder)
    return None


def user_in(folder: int) -> int | None:
    """Return the user of a process, given its open folder. Raises OSError: it has ended."""
    ids = status_field(read_proc("status", folder), "Uid")  # real, effective, saved, file system
    user = ids[0]
    if ids.count(user) != len(ids):
        return None
    auxiliary = b""
    with suppress(OSError):  # reading it is not permitted
        auxiliary = read_proc("auxv", folder)
    entries = _AUXILIARY.iter_unpack(auxiliary[: len(auxiliary) & -_AUXILIARY.size])
    # The real user when the program was started, who chose command line and environment.
    started_by = next((value for kind, value in entries if kind == _AT_UID), None)
    if started_by is None:  # a process with root's ids may be a set-user-ID program
        return None if user == 0 and os.geteuid() == 0 else user
    starters = {started_by}
    for line in lines_of(read_proc("uid_map", folder)):  # of its user namespace; empty in a new one
        inside, outside, count = map(int, line.split())
        if inside <= started_by < inside + count:
            starters.add(outside + started_by - inside)
    return user if starters & {user, 0} else None


@dataclass(frozen=True)
class RunningProcess:
    """A process as the kernel shows it at an instant."""

    pid: int
    parent: int  # the id of its parent
    command: tuple[str, ...]  # its command line
    inner_pid: int  # its id in its own pid namespace
    participates: bool  # in DDS
    threads: tuple[RunningThread, ...]
    user: int | None = None  # None: it is of no single user


def list_processes(pids: Iterable[int] | None = None) -> tuple[RunningProcess, ...]:
    """Return processes with a command line, which kernel threads lack, by id (None: all)."""
    read = (read_process(pid) for pid in sorted(parents() if pids is None else pids))
    return tuple(process for process in read if process is not None)


def read_process(pid: int) -> RunningProcess | None:
    """Read a process; None: it has ended, is a zombie, or belongs to the kernel."""
    try:
        with process_folder(pid) as folder:
            user = user_in(folder)
            command = read_proc("cmdline", folder)
            if not command:
                return None
            status = read_proc("status", folder)
            participates, threads = _participation(pid, list_threads(pid))
            # If the user is still the same, all of this was read of the same process.
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
    """Return processes with their children, grandchildren and so on, given each one's parent."""
    family, generation = set(pids), set(pids)
    while generation:
        children = {child for child, parent in parent_of.items() if parent in generation}
        generation = children - family
        family |= generation
    return frozenset(family)


def find_applications(processes: Iterable[RunningProcess]) -> tuple[RunningProcess, ...]:
    """Return the processes that look like applications of ROS 2 or DDS."""
    return tuple(
        process
        for process in processes
        if process.participates or takes_ros_arguments(process.command)
    )


def _participation(
    pid: int, threads: tuple[RunningThread, ...]
) -> tuple[bool, tuple[RunningThread, ...]]:
    """Return whether a process takes part in DDS, and its threads with what they do there."""
    if any(thread.kind in ("receive", "event") for thread in threads):
        return True, threads
    if len(threads) > 1:
        with suppress(OSError):  # of another user's process only the threads' names can be seen
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
    """An area of a process's memory."""

    start: int  # address
    end: int  # the address behind it
    offset: int  # bytes from the beginning of the file
    executable: bool
    path: str  # of the file, the kernel's name of the area (``[stack]``), or empty


def regions_in(maps: bytes) -> Iterator[Region]:
    """Yield the regions in the content of a file /proc/PID/maps, by address."""
    for line in lines_of(maps):
        span, rights, offset, _, _, *path = line.split(maxsplit=5)
        start, end = (int(bound, 16) for bound in span.split(b"-"))
        name = os.fsdecode(path[0]) if path else ""  # exactly, so that it can be opened
        yield Region(start, end, int(offset, 16), b"x" in rights, name)


def region_at(regions: Sequence[Region], address: int) -> Region | None:
    """Return the region with an address; None: none has it. The regions are sorted by address."""
    number = bisect(regions, address, key=lambda region: region.start) - 1
    return regions[number] if number >= 0 and address < regions[number].end else None


_SYSCALLS = {"x86_64": ((45, 47), 202), "aarch64": ((207, 212), 98)}  # recvfrom, recvmsg; futex
_OF_LANGUAGE = re.compile(r"/(lib(c|pthread|stdc\+\+|gcc_s)|ld-linux[-\w]*)[-.]|\[vdso\]")
"""Regions of the language's libraries, whose functions are around a middleware's on a stack."""
_OUTERMOST = 16_384  # bytes of a waiting thread's stack in which its outermost frames are


def _receives(thread: RunningThread, regions: Sequence[Region], middleware: Middleware) -> bool:
    """Whether a thread without a name receives for a middleware.

    It does if it waits for a datagram, or for a word in the shared memory of a port, and its
    outermost function is the middleware's. It is not known (False) of a thread that runs just now,
    and if we may not look at its memory (ptrace(2), PTRACE_MODE_ATTACH).
    """
    receive, futex = _SYSCALLS.get(platform.machine(), ((), -1))
    try:
        number, *values = read_proc(f"/proc/{thread.pid}/task/{thread.tid}/syscall").split()
        if len(values) < 8:  # it runs, or sleeps outside of a system call
            return False
        word = region_at(regions, int(values[0], 16))  # its first argument
        top = int(values[6], 16)  # its stack pointer
        stack = region_at(regions, top)
        at_port = int(number) == futex and word is not None and middleware.port_memory in word.path
        if stack is None or not (at_port or int(number) in receive):
            return False
        with Path(f"/proc/{thread.pid}/mem").open("rb") as memory:
            data = os.pread(memory.fileno(), min(_OUTERMOST, stack.end - top) & -8, top)
    except OSError:  # it ended, or may not be looked at
        return False
    lowest = regions[0].start
    for (address,) in reversed([*struct.iter_unpack("=Q", data)]):  # the outermost frame first
        region = region_at(regions, address) if address >= lowest else None
        if region is not None and region.executable and not _OF_LANGUAGE.search(region.path):
            return middleware.receivers_wait_in in region.path
    return False


def middleware_limit(process: RunningProcess) -> MiddlewareLimit | None:
    """Return what is limited in a process that takes part in DDS, as far as its threads tell."""
    started = [thread for thread in process.threads if thread.tid != process.pid]
    if not process.participates or not started:
        return None
    for thread in started:
        if (limit := limit_by_thread(thread.comm)) is not None:
            return limit
    is_named = any(
        thread_work(thread.comm) is not None or is_of_zenoh(thread) for thread in started
    )
    return None if is_named else "unnamed"


def takes_ros_arguments(command: Sequence[str]) -> bool:
    """Whether a command line has arguments for ROS 2."""
    return "--ros-args" in command


def named_nodes(command: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of the nodes that a command line names, in order of its remap rules.

    ``__node:=NAME`` and ``__ns:=/NAMESPACE`` apply to every node of the process,
    ``OLD:__node:=NAME`` to the node that would be called OLD. The first rule that applies counts.
    Without a rule, a node's namespace is taken to be `/`, as it is unless the program sets it.

        >>> named_nodes(["talker", "--ros-args", "-r", "__node:=front", "-r", "__ns:=/lidar"])
        ('/lidar/front',)
        >>> named_nodes(["two", "--ros-args", "-r", "a:__node:=x", "-r", "b:__node:=y"])
        ('/x', '/y')
    """
    names: dict[str | None, str] = {}
    namespaces: dict[str | None, str] = {}
    for rule in filter(None, map(_NODE_NAME_RULE.fullmatch, _remap_rules(command))):
        owner, name, namespace = rule.groups()
        remapped = names if name else namespaces
        if None not in remapped:  # rules behind one for all nodes never apply
            remapped.setdefault(owner, name or namespace)
    if None not in names:  # nodes of which only the namespace is remapped
        names |= {owner: owner for owner in namespaces if owner and owner not in names}
    for_all = namespaces.get(None, "/")
    full_names = []
    for owner, name in names.items():
        namespace = namespaces.get(owner, for_all).rstrip("/")
        full_names.append(f"{namespace}/{name}")
    return tuple(dict.fromkeys(full_names))


def _remap_rules(command: Sequence[str]) -> Iterator[str]:
    """Yield the remap rules of a command line."""
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
    """Guess a node's full name from the name of its program; None: there is no program's name."""
    interpreted = bool(command) and re.fullmatch(r"python[0-9.]*", PurePath(command[0]).name)
    for argument in command[1:] if interpreted else command[:1]:
        if argument == "-c":
            return None
        if not argument.startswith("-"):
            stem = PurePath(argument).name.removesuffix(".py")
            return f"/{re.sub(r'[^A-Za-z0-9_]', '_', stem)}" if stem else None
    return None
