"""Threads as the kernel shows them, and giving them class and cores.

The paper's Thread Allocator (section 4.2) schedules executors, which run the callbacks, and DDS
threads, which carry the messages, differently. This module looks at single threads; which node
a thread belongs to is found in :mod:`chainshaper.enforcement.threads.allocation`.

A thread is identified by its id *and* the time at which it started: ids are used again.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from chainshaper.linux.dds_threads import DdsKind, ThreadRole, dds_kind, role_of
from chainshaper.values.errors import OperationError

__all__ = [
    "POLICIES",
    "RESET_ON_FORK",
    "SCHED_DEADLINE",
    "TICK_NS",
    "Scheduling",
    "Thread",
    "apply_scheduling",
    "find_thread",
    "foreign_realtime_processes",
    "has_ended",
    "innermost_id",
    "list_threads",
    "parents",
    "read_proc",
    "start_of",
]

SCHED_DEADLINE = 6
RESET_ON_FORK = getattr(os, "SCHED_RESET_ON_FORK", 0x40000000)
"""A flag that shares the word with the policy."""
TICK_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
"""The kernel tells the start of a thread in ticks of 10 ms."""

POLICIES = {
    os.SCHED_OTHER: "SCHED_OTHER",
    os.SCHED_FIFO: "SCHED_FIFO",
    os.SCHED_RR: "SCHED_RR",
    os.SCHED_BATCH: "SCHED_BATCH",
    os.SCHED_IDLE: "SCHED_IDLE",
    SCHED_DEADLINE: "SCHED_DEADLINE",
    7: "SCHED_LITMUS" if Path("/proc/litmus").is_dir() else "SCHED_EXT",
}


@dataclass(frozen=True)
class Thread:
    """A thread as the kernel shows it at one instant.

    ``started`` counts clock ticks (:data:`TICK_NS`) since the machine booted. ``inner_tid`` is
    the id that the thread has for itself: in a container, tracers record that one. ``role`` and
    ``kind`` are what its name and place say (:mod:`chainshaper.linux.dds_threads`).
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
    kind: DdsKind | None = None

    @property
    def identity(self) -> tuple[int, int]:
        """What no other thread has until the machine boots again: id and start."""
        return (self.tid, self.started)


@dataclass(frozen=True)
class Scheduling:
    """What a thread should get; what is None is left alone.

    ``priority`` is that of SCHED_FIFO or, with ``takes_turns``, of SCHED_RR, under which threads
    of one priority share their time; 0 is an ordinary thread's, of SCHED_OTHER.
    """

    priority: int | None
    cores: tuple[int, ...] | None
    takes_turns: bool = False

    @property
    def policy(self) -> int:
        """The scheduling class that goes with ``priority``."""
        if self.priority == 0:
            return os.SCHED_OTHER
        return os.SCHED_RR if self.takes_turns else os.SCHED_FIFO


def list_threads(pid: int) -> tuple[Thread, ...]:
    """The threads of a process, main thread first; empty when the process is gone."""
    try:
        with os.scandir(f"/proc/{pid}/task") as entries:
            tids = [int(entry.name) for entry in entries]
        inner_pid = innermost_id(read_proc(f"/proc/{pid}/status").decode(errors="replace"))
    except OSError:
        return ()
    tids.sort(key=lambda tid: (tid != pid, tid))
    found = (_thread(pid, tid, inner_pid) for tid in tids)
    return tuple(thread for thread in found if thread is not None)


def find_thread(tid: int) -> Thread | None:
    """The thread with this id, None when there is none."""
    try:
        status = read_proc(f"/proc/{tid}/status").decode(errors="replace")
    except OSError:
        return None
    pid = int(next(line.split()[1] for line in status.splitlines() if line.startswith("Tgid:")))
    return _thread(pid, tid, innermost_id(status) if pid == tid else None)


def _thread(pid: int, tid: int, inner_pid: int | None) -> Thread | None:
    """One thread, None if it has ended; ``inner_pid`` is its process's, None if not known.

    Looked at every second, on machines with thousands of threads: a single file is read.
    """
    folder = f"/proc/{pid}/task/{tid}"
    try:
        comm, fields = _stat(folder)
        cores = tuple(sorted(os.sched_getaffinity(tid)))
        inner_tid = tid
        if inner_pid != pid:  # in a pid namespace of its own
            inner_tid = innermost_id(read_proc(f"{folder}/status").decode(errors="replace")) or tid
    except OSError:
        return None
    policy = int(fields[38])
    return Thread(
        tid=tid,
        pid=pid,
        comm=comm,
        role=role_of(comm, is_main=tid == pid),
        policy=POLICIES.get(policy, str(policy)),
        priority=int(fields[37]),
        cores=cores,
        started=int(fields[19]),
        inner_tid=inner_tid,
        kind=None if tid == pid else dds_kind(comm),
    )


def parents() -> dict[int, int]:
    """All processes with their parents, by id."""
    with os.scandir("/proc") as entries:
        pids = sorted(int(entry.name) for entry in entries if entry.name.isdigit())
    found = {}
    for pid in pids:
        try:
            found[pid] = int(_stat(f"/proc/{pid}")[1][1])
        except OSError:
            continue  # it ended meanwhile
    return found


def read_proc(path: str, folder: int | None = None) -> bytes:
    """A whole file of /proc; ``folder`` is an open one that ``path`` begins in.

    Raises:
        OSError: what it is about has ended, or belongs to somebody else.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder)
    try:
        content = b""
        while part := os.read(descriptor, 1 << 16):
            content += part
    finally:
        os.close(descriptor)
    return content


def _stat(folder: str) -> tuple[str, list[bytes]]:
    """A task's name, and the fields of /proc/…/stat from its state on (proc(5), the third)."""
    stat = read_proc(f"{folder}/stat")
    name_end = stat.rindex(b")")  # a name may contain spaces and brackets
    name = stat[stat.index(b"(") + 1 : name_end]
    return name.decode(errors="replace"), stat[name_end + 1 :].split()


def innermost_id(status: str) -> int | None:
    """A task's id in its own pid namespace: the last number of `NSpid:` in /proc/…/status."""
    line = next((line for line in status.splitlines() if line.startswith("NSpid:")), "")
    numbers = line.split()[1:]
    return int(numbers[-1]) if numbers else None


def start_of(pid: int, tid: int) -> int | None:
    """When a thread started, in clock ticks since the machine booted; None if there is none."""
    try:
        return int(_stat(f"/proc/{pid}/task/{tid}")[1][19])
    except OSError:
        return None


def has_ended(tid: int, started: int) -> bool:
    """Whether the thread that started then is gone, or a zombie that nobody has waited for."""
    try:
        fields = _stat(f"/proc/{tid}")[1]
    except OSError:
        return True
    return int(fields[19]) != started or fields[0] in {b"Z", b"X"}


def apply_scheduling(thread: Thread, wanted: Scheduling) -> None:
    """Give a thread its class and cores; a thread that has ended meanwhile is no error.

    The class goes first: on a core where a FIFO thread spins, a thread moved there as
    SCHED_OTHER would not run again to be promoted.

    Raises:
        OperationError: the kernel refuses.
    """
    try:
        if wanted.priority is not None:
            os.sched_setscheduler(thread.tid, wanted.policy, os.sched_param(wanted.priority))
        if wanted.cores is not None:
            os.sched_setaffinity(thread.tid, wanted.cores)
    except ProcessLookupError:
        return
    except OSError as error:
        raise OperationError(
            f"thread {thread.tid} ({thread.comm}) of process {thread.pid}: the kernel refuses "
            f"priority {wanted.priority} on cores {wanted.cores}: {error.strerror}"
        ) from error


def foreign_realtime_processes() -> tuple[str, ...]:
    """Real-time threads of other user processes, as ``comm (pid)``: they spoil measurements.

    Kernel threads (which have no executable), our own children and what enforces a plan are not
    among them.
    """
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
        if realtime:
            found.append(f"{realtime[0].comm} ({pid})")
    return tuple(sorted(found))
