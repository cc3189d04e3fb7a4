"""Undoing what a run has changed, from whichever process is left, and ending one from outside.

A run that is in force is asked to end; one whose owner is gone, or does not react, is undone from
what its journal says. Where the journal itself is gone, cgroups of ours are found by their names.
"""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.enforcement.freezer import state as freezer
from chainshaper.enforcement.litmus import back_end as litmus
from chainshaper.enforcement.runs.journal import (
    CLAIMS,
    OPENED,
    Journal,
    discard_journal,
    process_of,
    read_claim,
)
from chainshaper.enforcement.runs.locking import holder_of, locked, wake
from chainshaper.enforcement.runs.processes import (
    DISPATCHER,
    GUARDIAN,
    PROCESS,
    end_processes,
    open_process,
    read_process,
)
from chainshaper.enforcement.runs.scheduling_memory import (
    DESCENDANTS,
    KIND,
    read_change,
    release_threads,
)
from chainshaper.linux import cgroups
from chainshaper.linux.scheduling_state import state_of, state_text
from chainshaper.linux.threads import find_thread
from chainshaper.values.errors import OperationError, PlatformError

__all__ = ["end_run", "release_strays", "remove_run", "strange_lines", "undo_run"]

PATIENCE_S = 20.0
"""A run that is asked to end has so long for it; who undoes one has half of that."""

_SHOWN = 200
_READERS: Mapping[str, Callable[[dict[str, Any]], object]] = {
    OPENED: process_of,
    CLAIMS: read_claim,
    KIND: read_change,
    DESCENDANTS: process_of,
    PROCESS: read_process,
    freezer.FREEZER: freezer.read_run,
    litmus.NOTE: lambda entry: (str(entry["previous"]), Path(entry["proc"])),
}
"""All that a journal may speak of, and how it is read."""


def end_run(journal: Journal) -> tuple[str, ...]:
    """End a run: its owner does it, or we do where it is gone or hangs. What could not be undone.

    An owner that was stopped (Ctrl-Z) is made to go on: it could not end otherwise. A run
    is over afterwards unless something can be tried again.

    Raises:
        OperationError: the owner is not ours to end.
    """
    owner = journal.owner
    if owner is not None:
        _ask_to_end(journal, owner)
    left = undo_run(journal)
    if left or not journal.path.exists():
        return left
    strange = strange_lines(journal)
    remove_run(journal)
    return strange


def undo_run(journal: Journal, *, by_owner: bool = False) -> tuple[str, ...]:
    """Undo what a run has changed; what could not be undone, in sentences.

    The run is removed, if its owner is gone or asks for it. It stays where something is left, so
    that it can be tried again, and where its journal has lines that say nothing. Who is at it
    while another process is waits, and finds it done.
    """
    left: list[str] = []
    with contextlib.ExitStack() as stack:
        try:
            if not journal.keep():
                return ()
            waiting = partial(_hasten, journal)
            stack.enter_context(locked(journal.path.parent, waiting))
        except FileNotFoundError:
            return ()  # another process was quicker
        except OSError:
            pass  # its folder is gone, and there is no room for another: it is in memory
        end_processes(journal, DISPATCHER)
        for undo in () if journal.outdated else _STEPS:
            try:
                undo(journal)
            except (OperationError, PlatformError) as error:
                left.append(str(error))
        is_over = by_owner or journal.owner is None
        if is_over and not left and not strange_lines(journal):
            end_processes(journal, GUARDIAN)
            remove_run(journal)
    return tuple(left)


def strange_lines(journal: Journal) -> tuple[str, ...]:
    """Lines of a journal that say nothing, in sentences: what they spoke of is not undone."""
    return tuple(
        f"{journal.path}, line {number} is not a line of a journal, so what it may have said is "
        f"not undone: {line[:_SHOWN]!r}"
        for number, line in journal.strange_lines(_READERS)
    )


def remove_run(journal: Journal) -> None:
    """Remove the folder of a run that is over: what it shows of itself, then the journal."""
    with contextlib.suppress(FileNotFoundError):
        for path in journal.path.parent.iterdir():
            if path != journal.path and not path.is_dir():
                path.unlink(missing_ok=True)
    discard_journal(journal)


def release_strays(journals: Iterable[Journal]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Dissolve cgroups of ours of which none of these journals speaks, and whose owner has ended.

    Their threads run again, where they were, and the hierarchy is mounted as before. Returns the
    groups that are gone, and what could not be put back, since nothing says any more what was
    there.
    """
    gone, left = [], []
    for folder in freezer.stray_groups(journals):
        tids = cgroups.threads_in(folder)
        why = cgroups.dissolve(folder)
        if why is None:
            gone.append(folder)
        else:
            left.append(why)
        left += [said for tid in tids if (said := _class_text(tid)) is not None]
    freezer.restore_stray_mount()
    if left and cgroups.moves_are_quick():
        left.append(
            f"{cgroups.mount_point()} is mounted with {cgroups.QUICK_MOVES}, perhaps by that run: "
            "it does no harm, and is gone with the next boot"
        )
    return tuple(gone), tuple(left)


def _class_text(tid: int) -> str | None:
    """What a thread still has of a run whose journal is gone, if that is a real-time class."""
    thread = find_thread(tid)
    if thread is None or thread.priority == 0:
        return None
    with contextlib.suppress(ProcessLookupError):
        return (
            f"thread {tid} ({thread.comm}) of process {thread.pid} runs on under "
            f"{state_text(state_of(tid))}: the journal that says what it had before is gone; give "
            f"it back with `chrt --other --pid 0 {tid}` and `taskset --pid --cpu-list CORES {tid}`"
        )
    return None


def _ask_to_end(journal: Journal, owner: int) -> None:
    """Have the owner end the run; one that does not is ended itself."""
    pidfd = open_process(*journal.read(OPENED, process_of)[0])
    if pidfd is None:
        return
    try:
        for number in (signal.SIGTERM, signal.SIGCONT):
            signal.pidfd_send_signal(pidfd, number)
        if not _wait_for_end(journal, PATIENCE_S):
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            _wait_for_end(journal, PATIENCE_S)
    except ProcessLookupError:
        return
    except PermissionError:
        raise OperationError(
            f"the run {journal.path.parent.name} belongs to process {owner} of another user: end "
            "it as that user, or as root"
        ) from None
    finally:
        os.close(pidfd)


def _wait_for_end(journal: Journal, within_s: float) -> bool:
    deadline = time.monotonic() + within_s
    while journal.path.exists() and journal.owner is not None:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def _hasten(journal: Journal, waited_s: float) -> None:
    """Another process undoes this run: one that was stopped goes on, one that hangs is ended."""
    holder = holder_of(journal.path.parent)
    if holder in (None, os.getpid()):
        return
    wake(holder)
    if waited_s > PATIENCE_S / 2:
        with contextlib.suppress(ProcessLookupError):
            os.kill(holder, signal.SIGKILL)


def _thaw(journal: Journal) -> None:
    freezer.thaw(freezer.groups_of(freezer.run_of(journal)))


def _restore_groups(journal: Journal) -> None:
    left = freezer.restore(freezer.run_of(journal))
    if journal.owner is None and strange_lines(journal):  # one of them may have spoken of groups
        strays = map(cgroups.dissolve, freezer.stray_groups(()))
        left += tuple(why for why in strays if why is not None)
    if left:
        raise OperationError("; ".join(left))


_STEPS = (_thaw, release_threads, _restore_groups, litmus.restore_plugin)
"""Threads run first; those that were born in our groups are known by them, as long as these are."""
