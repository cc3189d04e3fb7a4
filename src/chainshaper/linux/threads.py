"""Threads as the kernel shows them, and what their names say.

A thread is identified by its id *and* its start: ids are used again. The names of a
middleware's threads are in :mod:`chainshaper.values.middleware`.

Upstream: proc(5).
"""

import functools
import os
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

from chainshaper.values.errors import text_of
from chainshaper.values.middleware import ThreadWork, is_runtime_name, runtime_work, thread_work

SCHED_DEADLINE = 6
RESET_ON_FORK = getattr(os, "SCHED_RESET_ON_FORK", 0x40000000)
"""A flag that shares the word with the policy."""
TICK_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
"""The kernel shows the start of a thread in ticks of 10 ms."""
_STARTED = 19  # of the fields of /proc/…/stat from the state on
_DEAD = {b"Z", b"X"}

_OF_PYTHON = ("SCHED_OTHER", "SCHED_FIFO", "SCHED_RR", "SCHED_BATCH", "SCHED_IDLE")
POLICIES: dict[int, str] = {getattr(os, name): name for name in _OF_PYTHON}
POLICIES[SCHED_DEADLINE] = "SCHED_DEADLINE"
POLICIES[7] = "SCHED_LITMUS" if Path("/proc/litmus").is_dir() else "SCHED_EXT"

ThreadRole: TypeAlias = Literal["executor", "publisher", "dds", "unknown"]
"""``publisher``: sends what executors hand over to it (asynchronous publication, section 2.2)."""


def gate_thread_name(node: str) -> str:
    """What a gate in its publisher's process calls its thread, which fits into 15 characters."""
    return f"gate-{zlib.crc32(node.strip('/').encode()):08x}"


def role_of(comm: str, is_main: bool) -> ThreadRole:
    """The role of a thread of a node's process, as far as its name shows."""
    if is_main:
        return "executor"  # executors spin there, unless a program arranges it otherwise
    kind = thread_work(comm)
    if kind == "asynchronous publisher":
        return "publisher"
    return "unknown" if kind is None else "dds"


@dataclass(frozen=True)
class RunningThread:
    """A thread as the kernel shows it at one instant: started so many ticks (:data:`TICK_NS`) after
    the machine, with the id that tracers record in a container (``inner_tid``).
    """

    tid: int
    pid: int
    comm: str
    role: ThreadRole
    policy: str
    priority: int
    cores: tuple[int, ...]
    started: int = 0
    inner_tid: int = 0
    kind: ThreadWork | None = None

    @property
    def identity(self) -> tuple[int, int]:
        """What no other thread has until the machine boots again: id and start."""
        return (self.tid, self.started)

    @property
    def text(self) -> str:
        return f"thread {self.tid} ({self.comm}) of process {self.pid}"


def list_threads(pid: int) -> tuple[RunningThread, ...]:
    """The threads of a process, main thread first; empty when the process is gone."""
    try:
        tids = [int(name) for name in os.listdir(f"/proc/{pid}/task")]  # noqa: PTH208 - quicker
        inner_pid = innermost_id(read_proc(f"/proc/{pid}/status"))
    except OSError:
        return ()
    tids.sort(key=lambda tid: (tid != pid, tid))
    found = {tid: one for tid in tids if (one := _thread(pid, tid, inner_pid)) is not None}
    works = runtime_work(thread.comm for thread in found.values())
    for tid, thread in found.items():
        if tid != pid and thread.comm in works:
            found[tid] = replace(thread, role="dds", kind=works[thread.comm])
    return tuple(found.values())


def is_of_zenoh(thread: RunningThread) -> bool:
    """Whether a thread with its role is one of Zenoh's runtimes."""
    return thread.kind is not None and is_runtime_name(thread.comm)


def find_thread(tid: int) -> RunningThread | None:
    """The thread with this id, None when there is none."""
    with suppress(OSError):
        return _thread(status_field(read_proc(f"/proc/{tid}/status"), "Tgid")[0], tid, None)
    return None


def _thread(pid: int, tid: int, inner_pid: int | None) -> RunningThread | None:
    """A thread, if it runs still, by reading one file: there are thousands, every second."""
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
    )


def all_stats() -> Iterator[tuple[int, list[bytes]]]:
    """All processes with the fields of :func:`read_stat`, by id."""
    for pid in sorted(int(name) for name in os.listdir("/proc") if name.isdigit()):  # noqa: PTH208
        with suppress(OSError):  # it ended meanwhile
            yield pid, read_stat(f"/proc/{pid}")[1]


def living_processes() -> Iterator[tuple[int, int]]:
    """All processes but zombies by id and start, those of containers by their ids there, too."""
    for pid, fields in all_stats():
        with suppress(OSError):  # it ended meanwhile
            if fields[0] not in _DEAD:
                status = read_proc(f"/proc/{pid}/status")
                started = int(fields[_STARTED])
                yield from ((one, started) for one in {pid, innermost_id(status) or pid})


def parents() -> dict[int, int]:
    """All processes with their parents, by id."""
    return {pid: int(fields[1]) for pid, fields in all_stats()}


def read_proc(path: str | Path, folder: int | None = None) -> bytes:
    """A whole file of /proc or /sys, or of an open ``folder`` in it: bytes, since whoever names a
    program, a file or a group chooses any. Raises OSError: gone, or forbidden.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder)
    with os.fdopen(descriptor, "rb", buffering=0) as file:
        return file.readall()


def lines_of(content: bytes) -> list[bytes]:
    """The lines of a file of the kernel, which ends each with a line feed.

    Names in them may have whatever else ends a line elsewhere: with `splitlines`, a program that is
    called ``a\\rUid:\\t0`` would be root's.
    """
    return content.removesuffix(b"\n").split(b"\n")


def read_stat(folder: str) -> tuple[str, list[bytes]]:
    """A task's name, and the fields of /proc/…/stat from its state on (proc(5), the third)."""
    stat = read_proc(f"{folder}/stat")
    name_end = stat.rindex(b")")  # a name may contain spaces and brackets
    name = stat[stat.index(b"(") + 1 : name_end]
    fields = stat[name_end + 1 :].split()
    if _started_later():
        fields[_STARTED] = b"%d" % (int(fields[_STARTED]) - _started_later())
    return text_of(name), fields


@functools.cache
def _started_later() -> int:
    """By how many ticks the kernel shows us all starts later than to those who share no time
    namespace with us (time_namespaces(7)): a start names a process to all of them alike.
    """
    with suppress(OSError, ValueError):  # before Linux 5.6
        for line in lines_of(read_proc("/proc/self/timens_offsets")):
            clock, seconds, ns = line.split()
            if clock == b"boottime":
                return (int(seconds) * 1_000_000_000 + int(ns)) // TICK_NS
    return 0


def of_another_clock(pid: int) -> bool:
    """Whether a process may see another CLOCK_MONOTONIC than we do: it has a time namespace of its
    own (time_namespaces(7)), as containers may have that were moved here while they ran.
    """
    return time_namespace(pid) not in (0, time_namespace())


def time_namespace(pid: int | Literal["self"] = "self") -> int:
    """The time namespace of a process (its inode); 0: not known."""
    with suppress(OSError):  # it has ended, is another user's, or the kernel is older than 5.6
        return Path(f"/proc/{pid}/ns/time").stat().st_ino
    return 0


def since_boot_ns() -> int:
    """For how long the machine has run, sleep included: the clock of :attr:`Thread.started`."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - _started_later() * TICK_NS


def status_field(status: bytes, name: str, base: int = 10) -> list[int]:
    """The numbers of one line of /proc/…/status, empty where it has no such line."""
    start = f"{name}:".encode()
    line = next((line for line in lines_of(status) if line.startswith(start)), b"")
    return [int(number, base) for number in line.split()[1:]]


def innermost_id(status: bytes) -> int | None:
    """A task's id in its own pid namespace: the last number of `NSpid:` in /proc/…/status."""
    numbers = status_field(status, "NSpid")
    return numbers[-1] if numbers else None


def start_of(pid: int, tid: int) -> int | None:
    """When a thread started, in clock ticks since the machine booted; None if there is none."""
    with suppress(OSError):
        return int(read_stat(f"/proc/{pid}/task/{tid}")[1][_STARTED])
    return None


def has_ended(tid: int, started: int) -> bool:
    """Whether the thread that started then is gone, or a zombie."""
    with suppress(OSError):
        fields = read_stat(f"/proc/{tid}")[1]
        return int(fields[_STARTED]) != started or fields[0] in _DEAD
    return True


def open_process(pid: int, started: int) -> int | None:
    """A pidfd of the process that started then, None when it has ended."""
    with suppress(ProcessLookupError):
        pidfd = os.pidfd_open(pid)
        if start_of(pid, pid) == started:
            return pidfd
        os.close(pidfd)
    return None


def foreign_realtime_processes() -> tuple[str, ...]:
    """Others' processes with real-time threads, as ``comm (pid)``: they spoil measurements."""
    found = []
    for pid, parent in parents().items():
        try:
            command = read_proc(f"/proc/{pid}/cmdline")
            enforces = b"chainshaper.enforcement." in command
            enforces &= Path(f"/proc/{pid}").stat().st_uid in (0, os.geteuid())
        except OSError:
            continue
        if os.getpid() in (pid, parent) or not command or enforces:
            continue
        realtime = [t for t in list_threads(pid) if t.policy in ("SCHED_FIFO", "SCHED_RR")]
        found += [f"{thread.comm} ({pid})" for thread in realtime[:1]]
    return tuple(sorted(found))
