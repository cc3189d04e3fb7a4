"""Which thread does what in a process of the application, and giving it class and core.

The paper's Thread Allocator (section 4.2): executors run the callbacks, DDS threads carry the
messages, and the two are scheduled differently. A thread is recognised by its name, because that
is all an unmodified process shows: executors run on the main thread (tid = pid), DDS
implementations name their own threads.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from chainshaper.errors import OperationError

__all__ = [
    "Scheduling",
    "Thread",
    "ThreadRole",
    "apply_scheduling",
    "foreign_realtime_processes",
    "list_threads",
]

ThreadRole: TypeAlias = Literal["executor", "dds", "publisher", "unknown"]

POLICIES = {
    os.SCHED_OTHER: "SCHED_OTHER",
    os.SCHED_FIFO: "SCHED_FIFO",
    os.SCHED_RR: "SCHED_RR",
    os.SCHED_BATCH: "SCHED_BATCH",
    os.SCHED_IDLE: "SCHED_IDLE",
    6: "SCHED_DEADLINE",
}

# Cyclone DDS 0.10 and 11 (`xmit.user` and `dq.*` are per channel), then Fast DDS from 2.13 on.
_DDS_NAMES = {"recv", "recvUC", "recvMC", "tev", "gc", "lease", "debmon"}
_DDS_PREFIXES = ("dq.", "xmit.", "rcv.", "dds.ev", "dds.udp", "dds.tcp", "dds.shm")
# Threads that publish on behalf of an executor: Fast DDS's, and the live workload's own.
_PUBLISHER_PREFIXES = ("dds.asyn",)


@dataclass(frozen=True)
class Thread:
    """A thread as the kernel shows it at one instant."""

    tid: int
    pid: int
    comm: str
    role: ThreadRole
    policy: str
    priority: int
    cores: tuple[int, ...]


@dataclass(frozen=True)
class Scheduling:
    """What a thread should get: SCHED_FIFO ``priority`` (None: its class is left alone), cores."""

    priority: int | None
    cores: tuple[int, ...] | None


def role_of(comm: str, is_main: bool) -> ThreadRole:
    if comm.startswith(_PUBLISHER_PREFIXES):
        return "publisher"
    if comm in _DDS_NAMES or comm.startswith(_DDS_PREFIXES):
        return "dds"
    return "executor" if is_main else "unknown"


def list_threads(pid: int) -> tuple[Thread, ...]:
    """The threads of a process, main thread first; empty when the process is gone."""
    found = []
    try:
        tids = sorted(int(entry.name) for entry in Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return ()
    for tid in tids:
        try:
            comm = Path(f"/proc/{pid}/task/{tid}/comm").read_text().rstrip("\n")
            # The reset-on-fork flag shares the word with the policy.
            policy = os.sched_getscheduler(tid) & ~getattr(os, "SCHED_RESET_ON_FORK", 0)
            priority = os.sched_getparam(tid).sched_priority
            cores = tuple(sorted(os.sched_getaffinity(tid)))
        except (OSError, ProcessLookupError):
            continue  # it ended between the listing and the look
        found.append(
            Thread(
                tid=tid,
                pid=pid,
                comm=comm,
                role=role_of(comm, is_main=tid == pid),
                policy=POLICIES.get(policy, str(policy)),
                priority=priority,
                cores=cores,
            )
        )
    return tuple(found)


def apply_scheduling(thread: Thread, wanted: Scheduling) -> None:
    """Give a thread its class and cores; a thread that has ended meanwhile is no error.

    The class goes first: on a core where a FIFO thread spins, a thread moved there as
    SCHED_OTHER would not run again to be promoted.

    Raises:
        OperationError: the kernel refuses.
    """
    try:
        if wanted.priority is not None:
            os.sched_setscheduler(thread.tid, os.SCHED_FIFO, os.sched_param(wanted.priority))
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

    Kernel threads (which have no executable) and our own children are not among them.
    """
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        pid = int(entry.name)
        try:
            if not (entry / "cmdline").read_bytes():
                continue  # a kernel thread
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue
        if os.getpid() in (pid, parent):
            continue
        realtime = [t for t in list_threads(pid) if t.policy in ("SCHED_FIFO", "SCHED_RR")]
        if realtime:
            found.append(f"{realtime[0].comm} ({pid})")
    return tuple(sorted(found))
