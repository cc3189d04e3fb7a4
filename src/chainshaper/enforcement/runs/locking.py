"""Folders of runs, each used by one process at a time; who waits for one can be asked to stop."""

import contextlib
import fcntl
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from chainshaper.linux.threads import read_proc

__all__ = ["holder_of", "locked", "wake"]

_LOOK_S = 0.02


@contextlib.contextmanager
def locked(folder: Path, waiting: Callable[[float], None]) -> Iterator[None]:
    """Inside, no other process has this folder locked.

    ``waiting`` is called with the seconds for which that has been waited for, again and again; it
    may raise.

    Raises:
        OSError: there is no such folder, or it may not be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        begun = time.monotonic()
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                waiting(time.monotonic() - begun)
                time.sleep(_LOOK_S)
        yield
    finally:
        os.close(descriptor)


def holder_of(folder: Path) -> int | None:
    """The process that has a folder locked, as far as the kernel shows it (proc_locks(5))."""
    with contextlib.suppress(OSError):
        inode = str(folder.stat().st_ino)
        for line in read_proc("/proc/locks").decode().splitlines():
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].rpartition(":")[2] == inode and fields[4] != "-1":
                return int(fields[4])
    return None


def wake(pid: int) -> None:
    """Have a process go on that was stopped."""
    with contextlib.suppress(OSError):
        os.kill(pid, signal.SIGCONT)
