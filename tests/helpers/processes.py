"""What /proc says about the processes that a test started, directly or through others."""

import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from chainshaper.linux.threads import list_threads, parents


def children_of(pid: int) -> list[int]:
    """Processes whose parent is ``pid``, zombies included."""
    return [child for child, parent in parents().items() if parent == pid]


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that is dead but not yet waited for does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()  # with its name, which may be no text
    except OSError:
        return False
    return stat.rpartition(b")")[2].split()[0] not in {b"Z", b"X"}


def marked_processes(marker: str) -> dict[int, str]:
    """Living processes that inherited an environment with ``marker`` in it, with their names.

    Orphans are found as well: an environment stays when the parent is gone.
    """
    names = {}
    for pid in parents():
        if _is_marked(pid, marker):
            with suppress(OSError):  # it ended meanwhile
                comm = Path(f"/proc/{pid}/comm").read_bytes()
                names[pid] = comm.decode(errors="replace").strip()
    return names


def _is_marked(pid: int, marker: str) -> bool:
    try:
        return marker.encode() in Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:  # it has ended, or is another user's
        return False


def send_to_marked(marker: str, pid: int, *numbers: signal.Signals) -> None:
    """Send signals to a process that has ``marker`` in its environment, if it is still there.

    A stranger that has got its id meanwhile has not this marker, and gets none of them.
    """
    with suppress(ProcessLookupError):
        pidfd = os.pidfd_open(pid)
        try:
            for number in numbers:
                if _is_marked(pid, marker):
                    signal.pidfd_send_signal(pidfd, number)
        finally:
            os.close(pidfd)


def kill_marked(marker: str) -> None:
    """Kill all processes that have ``marker`` in their environment."""
    for pid in marked_processes(marker):
        send_to_marked(marker, pid, signal.SIGKILL)


def real_time_threads(pids: list[int]) -> list[str]:
    """Names of the threads of these processes that run under SCHED_FIFO."""
    return [t.comm for pid in pids for t in list_threads(pid) if t.policy == "SCHED_FIFO"]


def wait_for(
    condition: Callable[[], bool], event: str, seconds: float = 20.0, pause: float = 0.02
) -> None:
    """Wait until something has happened; a test that waits in vain fails, and says for what."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited {seconds} s in vain for {event}"
        time.sleep(pause)


def in_time_namespace(offset_s: int, *command: str) -> list[str]:
    """A command whose CLOCK_MONOTONIC and CLOCK_BOOTTIME are so far ahead of ours; skips where the
    kernel makes no such namespaces, or not for us.
    """
    offsets = (f"--monotonic={offset_s}", f"--boottime={offset_s}")
    words = ["unshare", "--time", *offsets, "--fork", "--kill-child"]
    if subprocess.run([*words, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no time namespace can be made here")
    return [*words, *command]
