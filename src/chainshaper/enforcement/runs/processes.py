"""The processes that a run has of its own, in its journal: who they are, and ending them.

A guardian outlives the owner to undo the run, a dispatcher opens and closes the servers of a core.
Each is known by its id and its start, so that no other process is ever taken for it.
"""

import contextlib
import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from chainshaper.enforcement.runs.journal import Journal, process_of
from chainshaper.linux.threads import start_of

__all__ = [
    "DISPATCHER",
    "GUARDIAN",
    "PROCESS",
    "OwnProcess",
    "end_processes",
    "note_process",
    "open_process",
    "own_processes",
    "read_process",
]

PROCESS = "process"
GUARDIAN, DISPATCHER = "guardian", "dispatcher"


@dataclass(frozen=True)
class OwnProcess:
    """A process of a run; ``core`` is the one that a dispatcher gates."""

    role: str
    pid: int
    started: int
    core: int | None = None


def note_process(journal: Journal, role: str, pid: int, core: int | None = None) -> None:
    """Write down a process of the run, unless it has ended.

    Raises:
        OperationError: the journal cannot be written.
    """
    started = start_of(pid, pid)
    if started is not None:
        journal.note(PROCESS, role=role, pid=pid, started=started, core=core)


def read_process(entry: Mapping[str, Any]) -> OwnProcess:
    """What :func:`note_process` wrote."""
    return OwnProcess(str(entry["role"]), *process_of(entry), entry["core"])


def own_processes(journal: Journal, role: str) -> tuple[OwnProcess, ...]:
    """All processes of a role that the run has ever had."""
    return tuple(one for one in journal.read(PROCESS, read_process) if one.role == role)


def open_process(pid: int, started: int) -> int | None:
    """A pidfd of the process that started then, None when it has ended."""
    with contextlib.suppress(ProcessLookupError):
        pidfd = os.pidfd_open(pid)
        if start_of(pid, pid) == started:
            return pidfd
        os.close(pidfd)
    return None


def end_processes(journal: Journal, role: str) -> None:
    """Kill all processes of a role, this one excepted: one that was stopped hears nothing else."""
    for one in own_processes(journal, role):
        if one.pid != os.getpid() and (pidfd := open_process(one.pid, one.started)) is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            os.close(pidfd)
