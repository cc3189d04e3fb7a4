"""Threads as the kernel shows them, and what their names say.

A thread is identified by its id *and* its start, since ids are used again. The names of the threads
of middlewares are in :mod:`chainshaper.values.middleware`.

Upstream: proc(5).
"""

import ctypes
import functools
import os
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

from chainshaper.values.durations import format_duration
from chainshaper.values.errors import text_of
from chainshaper.values.middleware import ThreadWork, is_runtime_name, runtime_work, thread_work

SCHED_DEADLINE = 6
_SCHED_GETATTR = {"x86_64": 315, "aarch64": 275}  # the number of the system call
_ATTRIBUTES = struct.Struct("=IIQiIQQQ")  # `struct sched_attr`, until the period
_libc = ctypes.CDLL(None, use_errno=True)
RESET_ON_FORK = getattr(os, "SCHED_RESET_ON_FORK", 0x40000000)
"""A flag that is in the same number as the policy."""
TICK_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
"""The unit in which the kernel shows when a thread started, mostly 10 ms."""
_STARTED = 19  # the place of a thread's start in the fields of `read_stat`
_DEAD = {b"Z", b"X"}  # states of threads that have ended

_OF_PYTHON = ("SCHED_OTHER", "SCHED_FIFO", "SCHED_RR", "SCHED_BATCH", "SCHED_IDLE")
POLICIES: dict[int, str] = {getattr(os, name): name for name in _OF_PYTHON}
POLICIES[SCHED_DEADLINE] = "SCHED_DEADLINE"
POLICIES[7] = "SCHED_LITMUS" if Path("/proc/litmus").is_dir() else "SCHED_EXT"

ThreadRole: TypeAlias = Literal["executor", "publisher", "dds", "loop", "unknown"]
"""``publisher``: sends what executors hand over to it (paper, section 2.2)."""


def gate_thread_name(node: str) -> str:
    """Return the name of a gate's thread in its publisher's process; it has 13 characters."""
    return f"gate-{zlib.crc32(node.strip('/').encode()):08x}"


def role_of(comm: str, is_main: bool) -> ThreadRole:
    """Return the role of a thread of a node's process, as far as its name shows."""
    if is_main:
        return "executor"  # executors spin there, unless a program arranges it otherwise
    kind = thread_work(comm)
    if kind == "asynchronous publisher":
        return "publisher"
    return "unknown" if kind is None else "dds"


@dataclass(frozen=True)
class Reservation:
    """What SCHED_DEADLINE guarantees: ``runtime_ns`` within ``deadline_ns``, each period."""

    runtime_ns: int
    deadline_ns: int
    period_ns: int

    @property
    def text(self) -> str:
        """For a person: ``1ms of 100ms``, with the deadline where that is not the period."""
        runtime, period = format_duration(self.runtime_ns), format_duration(self.period_ns)
        if self.deadline_ns == self.period_ns:
            return f"{runtime} of {period}"
        return f"{runtime} within {format_duration(self.deadline_ns)} of {period}"


@dataclass(frozen=True)
class RunningThread:
    """A thread as the kernel shows it at one instant."""

    tid: int
    pid: int
    comm: str  # its name
    role: ThreadRole
    policy: str  # such as SCHED_FIFO
    priority: int  # of a real-time thread; 0: of all other threads
    cores: tuple[int, ...]  # where it may run
    started: int = 0  # ticks (TICK_NS) after the machine booted
    inner_tid: int = 0  # its id in its own pid namespace, which tracers record in a container
    kind: ThreadWork | None = None  # what it does, of a DDS thread
    reservation: Reservation | None = None  # of SCHED_DEADLINE; None: another class, or not shown

    @property
    def identity(self) -> tuple[int, int]:
        """Id and start, which no other thread has until the machine boots again."""
        return (self.tid, self.started)

    @property
    def text(self) -> str:
        return f"thread {self.tid} ({self.comm}) of process {self.pid}"


def list_threads(pid: int) -> tuple[RunningThread, ...]:
    """Return the threads of a process, the main thread first; empty: the process has ended."""
    try:
        tids = [int(name) for name in os.listdir(f"/proc/{pid}/task")]  # noqa: PTH208 - quicker
        inner_pid = innermost_id(read_proc(f"/proc/{pid}/status"))
    except OSError:
        return ()
    tids.sort(key=lambda tid: (tid != pid, tid))
    threads: dict[int, RunningThread] = {}
    for tid in tids:
        if (thread := _thread(pid, tid, inner_pid)) is not None:
            threads[tid] = thread
    works = runtime_work(thread.comm for thread in threads.values())
    for tid, thread in threads.items():
        if tid != pid and thread.comm in works:
            threads[tid] = replace(thread, role="dds", kind=works[thread.comm])
    return tuple(threads.values())


def is_of_zenoh(thread: RunningThread) -> bool:
    """Whether a thread with its role is one of Zenoh's runtimes."""
    return thread.kind is not None and is_runtime_name(thread.comm)


def find_thread(tid: int) -> RunningThread | None:
    """Return the thread with an id; None: there is none."""
    with suppress(OSError):
        return _thread(status_field(read_proc(f"/proc/{tid}/status"), "Tgid")[0], tid, None)
    return None


def _thread(pid: int, tid: int, inner_pid: int | None) -> RunningThread | None:
    """Read a thread; None: it has ended.

    It is read from a single file where possible, since this happens to thousands every second.
    """
    folder = f"/proc/{pid}/task/{tid}"
    try:
        comm, fields = read_stat(folder)
        cores = tuple(sorted(os.sched_getaffinity(tid)))
        inner_tid = tid
        if inner_pid != pid:  # in a pid namespace of its own
            inner_tid = innermost_id(read_proc(f"{folder}/status")) or tid
    except OSError:
        return None
    policy = int(fields[38])
    return RunningThread(
        tid=tid,
        pid=pid,
        comm=comm,
        role=role_of(comm, is_main=tid == pid),
        policy=POLICIES.get(policy, str(policy)),
        priority=int(fields[37]),
        cores=cores,
        started=int(fields[_STARTED]),
        inner_tid=inner_tid,
        kind=None if tid == pid else thread_work(comm),
        reservation=_reservation_of(tid) if policy == SCHED_DEADLINE else None,
    )


def _reservation_of(tid: int) -> Reservation | None:
    """Return what SCHED_DEADLINE guarantees a thread; None: it has ended, or has another class.

    The C library has no function for `sched_getattr(2)` before glibc 2.41.
    """
    number = _SCHED_GETATTR.get(os.uname().machine)
    attributes = ctypes.create_string_buffer(_ATTRIBUTES.size)
    if number is None or _libc.syscall(number, tid, attributes, _ATTRIBUTES.size, 0) != 0:
        return None
    _, policy, _, _, _, runtime, deadline, period = _ATTRIBUTES.unpack(attributes.raw)
    if policy != SCHED_DEADLINE:
        return None
    return Reservation(runtime, deadline, period or deadline)


def all_stats() -> Iterator[tuple[int, list[bytes]]]:
    """Yield all processes by id, with the fields of :func:`read_stat`."""
    for pid in sorted(int(name) for name in os.listdir("/proc") if name.isdigit()):  # noqa: PTH208
        with suppress(OSError):  # it ended meanwhile
            yield pid, read_stat(f"/proc/{pid}")[1]


def living_processes() -> Iterator[tuple[int, int]]:
    """Yield all processes except zombies by id and start.

    A process of another pid namespace, as in a container, comes with its id there as well.
    """
    for pid, fields in all_stats():
        with suppress(OSError):  # it ended meanwhile
            if fields[0] not in _DEAD:
                status = read_proc(f"/proc/{pid}/status")
                started = int(fields[_STARTED])
                for known_as in {pid, innermost_id(status) or pid}:
                    yield known_as, started


def parents() -> dict[int, int]:
    """Return the parent of each process, by id."""
    return {pid: int(fields[1]) for pid, fields in all_stats()}


def read_proc(path: str | Path, folder: int | None = None) -> bytes:
    """Read a whole file of /proc or /sys, or of an open ``folder`` in it.

    It is bytes, since names of programs, files and groups may be any. Raises OSError: the file is
    gone, or reading it is forbidden.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder)
    with os.fdopen(descriptor, "rb", buffering=0) as file:
        return file.readall()


def lines_of(content: bytes) -> list[bytes]:
    """Return the lines of a file of the kernel, which end with a line feed and nothing else.

    Names in them may have other characters that end lines elsewhere: with `splitlines`, a program
    called ``a\\rUid:\\t0`` would be root's. An empty file has none.
    """
    return content.removesuffix(b"\n").split(b"\n") if content else []


def read_stat(folder: str) -> tuple[str, list[bytes]]:
    """Return a task's name, and the fields of its `stat` from the third on, its state (proc(5))."""
    stat = read_proc(f"{folder}/stat")
    name_end = stat.rindex(b")")  # a name may contain spaces and brackets
    name = stat[stat.index(b"(") + 1 : name_end]
    fields = stat[name_end + 1 :].split()
    if _started_later():
        fields[_STARTED] = b"%d" % (int(fields[_STARTED]) - _started_later())
    return text_of(name), fields


@functools.cache
def _started_later() -> int:
    """Return by how many ticks the kernel shows starts too late in our time namespace.

    See time_namespaces(7). If these ticks were not taken off, processes outside the namespace would
    know a process by another start than we do.
    """
    with suppress(OSError, ValueError):  # before Linux 5.6
        for line in lines_of(read_proc("/proc/self/timens_offsets")):
            clock, seconds, ns = line.split()
            if clock == b"boottime":
                return (int(seconds) * 1_000_000_000 + int(ns)) // TICK_NS
    return 0


def of_another_clock(pid: int) -> bool:
    """Whether a process may see another CLOCK_MONOTONIC than we do.

    It may if it is in another time namespace (time_namespaces(7)), as in a container that was moved
    here while it ran.
    """
    return time_namespace(pid) not in (0, time_namespace())


def time_namespace(pid: int | Literal["self"] = "self") -> int:
    """Return the time namespace of a process (its inode); 0: it is not known."""
    with suppress(OSError):  # it has ended, is another user's, or the kernel is older than 5.6
        return Path(f"/proc/{pid}/ns/time").stat().st_ino
    return 0


def since_boot_ns() -> int:
    """Return how long ago the machine booted, its sleep included.

    That is the clock of :attr:`RunningThread.started`.
    """
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - _started_later() * TICK_NS


def status_field(status: bytes, name: str, base: int = 10) -> list[int]:
    """Return the numbers in a line of /proc/…/status; empty: it has no such line."""
    start = f"{name}:".encode()
    line = next((line for line in lines_of(status) if line.startswith(start)), b"")
    return [int(number, base) for number in line.split()[1:]]


def innermost_id(status: bytes) -> int | None:
    """Return a task's id in its own pid namespace, the last number of `NSpid:` in its status."""
    numbers = status_field(status, "NSpid")
    return numbers[-1] if numbers else None


def start_of(pid: int, tid: int) -> int | None:
    """Return when a thread started, in ticks after the machine booted; None: there is none."""
    with suppress(OSError):
        return int(read_stat(f"/proc/{pid}/task/{tid}")[1][_STARTED])
    return None


def has_ended(tid: int, started: int) -> bool:
    """Whether the thread with this id and start has ended; a zombie has."""
    with suppress(OSError):
        fields = read_stat(f"/proc/{tid}")[1]
        return int(fields[_STARTED]) != started or fields[0] in _DEAD
    return True


def open_process(pid: int, started: int) -> int | None:
    """Open a pidfd of the process with this id and start; None: it has ended."""
    with suppress(ProcessLookupError):
        pidfd = os.pidfd_open(pid)
        if start_of(pid, pid) == started:
            return pidfd
        os.close(pidfd)
    return None


def foreign_realtime_processes() -> tuple[str, ...]:
    """Return real-time threads of other programs, which spoil measurements, as ``comm (pid)``.

    It is one thread of each process.
    """
    foreign = []
    for pid, parent in parents().items():
        try:
            command = read_proc(f"/proc/{pid}/cmdline")
            enforces = b"chainshaper.enforcement." in command
            enforces &= Path(f"/proc/{pid}").stat().st_uid in (0, os.geteuid())
        except OSError:
            continue
        if os.getpid() in (pid, parent) or not command or enforces:
            continue
        for thread in list_threads(pid):
            if thread.policy in ("SCHED_FIFO", "SCHED_RR", "SCHED_DEADLINE"):
                foreign.append(f"{thread.comm} ({pid})")
                break
    return tuple(sorted(foreign))
