"""A small process that outlives the owner of a run, and undoes what it leaves behind.

    python -m chainshaper.enforcement.runs.release_after PID FOLDER

It waits for the end of process PID. An owner that ended in order has taken its journal away; one
that was killed has not, and then the run in FOLDER is undone here. The back ends see to it that
nothing stays stopped; this is about everything else, priorities and cores first of all.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

from chainshaper.enforcement.own_processes import module_command
from chainshaper.enforcement.runs.claims import claim_run
from chainshaper.enforcement.runs.journal import FILE, Journal
from chainshaper.enforcement.runs.scheduling_memory import release_threads
from chainshaper.enforcement.runs.state import remove_run, undo_run
from chainshaper.errors import OperationError

__all__ = ["run_claimed", "start_watching"]

_START_S = 20.0


@contextlib.contextmanager
def run_claimed(
    cores: Collection[int], nodes: Collection[str], folder: Path | None = None
) -> Iterator[Journal]:
    """A run that governs these, watched over: all in its journal is as before when it is over.

    Raises:
        OperationError, PlatformError: see :func:`.claim_run`, :func:`start_watching` and
            :func:`.release_threads`.
    """
    journal = claim_run(cores, nodes, folder)
    watcher = None
    try:
        watcher = start_watching(journal.path.parent)
        yield journal
    finally:
        release_threads(journal)
        remove_run(journal)
        if watcher is not None:
            watcher.kill()
            watcher.wait()


def start_watching(folder: Path) -> subprocess.Popen[bytes]:
    """Have a process watch the caller, in a session of its own; it is ready when this returns.

    Raises:
        OperationError: it does not start.
    """
    reading, writing = os.pipe()
    try:
        watcher = subprocess.Popen(
            [*module_command(__name__), str(os.getpid()), str(folder), str(writing)],
            pass_fds=(writing,),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    finally:
        os.close(writing)
    there, _, _ = select.select([reading], [], [], _START_S)  # it says so, or ends
    said = os.read(reading, 1) if there else b""
    os.close(reading)
    if not said:
        watcher.kill()
        watcher.wait()
        raise OperationError(
            "the process that undoes our changes should we be killed does not start: is the "
            "machine overloaded, or somebody ending our processes?"
        )
    return watcher


def main() -> None:
    """Wait, then undo if need be."""
    owner, folder, ready = int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    # It may have been killed already, and then nobody listens.
    with contextlib.suppress(ProcessLookupError, BrokenPipeError):
        ended = os.pidfd_open(owner)
        os.write(ready, b"!")
        os.close(ready)
        select.select([ended], [], [])
    journal = Journal(folder / FILE)
    if journal.path.exists():
        undo_run(journal)


if __name__ == "__main__":
    main()
