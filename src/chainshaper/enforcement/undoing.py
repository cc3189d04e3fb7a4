"""Runs from their claim to their end: which cores and nodes, what they say, and undoing them.

Two plans never govern the same core or node: each run claims its own in its journal, under a lock
of the folder of all runs. A run that is in force is asked to end; one whose owner is gone, or does
not react, is undone from its journal, by whichever process is left. Where the journal itself is
gone, cgroups of ours are found by their names.
"""

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from chainshaper.enforcement import freezer, litmus
from chainshaper.enforcement.journal import (
    DISPATCHER,
    GUARDIAN,
    OPENED,
    PROCESS,
    STATE_FILE,
    Journal,
    LockHolder,
    all_runs_locked,
    discard_journal,
    find_journals,
    journals_folder,
    locked,
    open_journal,
    process_of,
    processes_of_role,
    read_process,
)
from chainshaper.enforcement.scheduling_memory import (
    DESCENDANTS,
    KIND,
    read_change,
    release_threads,
)
from chainshaper.enforcement.servers import ReservationServer, ServerCounters
from chainshaper.linux import cgroups, own_processes
from chainshaper.linux.scheduling import state_of
from chainshaper.linux.threads import find_thread, open_process
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import OperationError, PlatformError, storable
from chainshaper.values.files import open_output, read_regular

CLAIMS = "claims"
PATIENCE_S = 20.0
"""A run has so long to begin, or to end when asked (its command not counted); who undoes one has
half of that."""


@dataclass(frozen=True)
class ServerState(ReservationServer):
    """A server in force; a back end, or a node's ``gate``, restricts its threads (``kept_by``)."""

    threads: tuple[int, ...]
    kept_by: str
    counters: ServerCounters


@dataclass(frozen=True)
class SlotMove:
    """From an instant on a chain's slots are ``moved_ns`` behind the plan's, its output's last one
    ``start_ns`` after its origin.
    """

    from_ns: int
    chain: str
    moved_ns: int
    start_ns: int
    why: str

    @property
    def text(self) -> str:
        start = duration_text(self.start_ns)
        return f"the last slot of {self.chain} begins at {start} now: {self.why}"


@dataclass(frozen=True)
class RunState:
    """A plan in force. Instants are ns of CLOCK_MONOTONIC, None if they are still to come. Cycles
    start at ``anchor_ns`` + k * ``cycle_ns``, the first enforced as a whole ``in_force_ns``; the
    chain's beginning has moved by ``drift_ns`` since; ``failure``: why it is not enforced.
    """

    run: str
    owner: int
    plan: str
    command: tuple[str, ...]
    back_end: str
    reason: str
    started_ns: int
    cycle_ns: int
    anchor_ns: int | None = None
    phase_spread_ns: int | None = None
    drift_ns: int | None = None
    servers: tuple[ServerState, ...] = ()
    notes: tuple[str, ...] = ()
    failure: str | None = None
    in_force_ns: int | None = None
    ended_ns: int | None = None
    moves: tuple[SlotMove, ...] = ()  # the latest, of as many as a chain's gate has had


def save_run_state(folder: Path, state: RunState) -> None:
    """Write `run.json`, whole. Raises OSError; a plan in force needs it for nothing."""
    partial_file = folder / f"{STATE_FILE}.partial"
    try:
        partial_file.unlink(missing_ok=True)
        with os.fdopen(open_output(partial_file), "w") as file:
            file.write(json.dumps(storable(asdict(state))))
        partial_file.replace(folder / STATE_FILE)
    finally:
        partial_file.unlink(missing_ok=True)  # a part of it would fill the disk for good


def find_runs(folder: Path | None = None) -> Iterator[tuple[Journal, RunState | None]]:
    """All runs that are not over, crashed ones included, with what they last said of themselves."""
    from pydantic import TypeAdapter  # guardians have Python alone

    for journal in find_journals(folder):
        state = None
        with contextlib.suppress(OSError, ValueError):
            content = read_regular(journal.path.with_name(STATE_FILE))
            state = TypeAdapter(RunState).validate_json(content)
        if journal.path.exists():  # not over meanwhile
            yield journal, state


def runs_as_json(folder: Path | None = None) -> list[dict[str, Any]]:
    """The same as plain data; ``unreadable`` are :func:`strange_lines`."""
    return [
        {
            "run": journal.name,
            "folder": str(journal.path.parent),
            "alive": journal.owner is not None,
            "unreadable": strange_lines(journal),
            "state": None if state is None else asdict(state),
        }
        for journal, state in find_runs(folder)
    ]


def claim_run(
    cores: Collection[int],
    nodes: Collection[str],
    folder: Path | None = None,
    go_on: Callable[[], None] = lambda: None,
) -> Journal:
    """Begin a run that governs these cores and nodes: the journal for all that it changes. While
    another begins, ``go_on`` is called, and may raise. Raises OperationError: a living run governs
    one of them, a crashed one cannot be undone, or one that begins does not get on with it.
    PlatformError: nothing may be written to the folder.
    """
    base = journals_folder(folder)
    wanted: dict[str, set[Any]] = {"core": set(cores), "node": set(nodes)}

    def waiting(holder: LockHolder | None, waited_s: float) -> None:
        go_on()
        if waited_s > PATIENCE_S:
            late = f"begins a run, and has not got on with it for {PATIENCE_S:g} s"
            if holder is None:
                raise OperationError(f"a process that is not to be seen from here {late}: end it")
            pid = holder.pid
            raise OperationError(
                f"process {pid} {late}: let it go on (`kill -CONT {pid}`), or end it "
                f"(`kill -KILL {pid}`)"
            )

    with contextlib.ExitStack() as stack:
        try:
            base.mkdir(mode=0o755, parents=True, exist_ok=True)  # ours alone: it is believed
            stack.enter_context(all_runs_locked(base, waiting))
        except OSError as error:
            raise PlatformError(
                f"{base}, where runs keep a journal of what they change, cannot be used "
                f"({error.strerror}): run as root, or set $XDG_RUNTIME_DIR to a folder of yours"
            ) from error
        for other in find_journals(base):
            shared = " and ".join(
                f"{kind} {', '.join(map(str, sorted(claimed & wanted[kind])))}"
                for claim in other.read(CLAIMS, _read_claim)
                for kind, claimed in claim.items()
                if claimed & wanted[kind]
            )
            if (owner := other.owner) is not None and shared:
                raise OperationError(
                    f"the run {other.name} of process {owner} governs {shared} already: end it "
                    f"first (`chainshaper release {other.name}`)"
                )
            is_in_the_way = owner is None and (shared or not other.entries(CLAIMS))
            if is_in_the_way and (left := undo_run(other)):
                why = "; ".join(left)
                raise OperationError(f"the crashed run {other.name} cannot be undone: {why}")
        journal = open_journal(base)
        journal.note(CLAIMS, cores=sorted(cores), nodes=sorted(nodes))
        return journal


def _read_claim(entry: Mapping[str, Any]) -> dict[str, set[Any]]:
    return {"core": set(map(int, entry["cores"])), "node": set(map(str, entry["nodes"]))}


_READERS: Mapping[str, Callable[[Mapping[str, Any]], object]] = {
    OPENED: process_of,
    CLAIMS: _read_claim,
    KIND: read_change,
    DESCENDANTS: process_of,
    PROCESS: read_process,
    freezer.FREEZER: freezer.read_run,
    litmus.NOTE: litmus.read_note,
}
"""All that a journal may speak of, and how it is read."""


def strange_lines(journal: Journal) -> tuple[str, ...]:
    """Lines of a journal that say nothing, in sentences: what they spoke of is not undone."""
    return tuple(
        f"{journal.path}, line {number} is not a line of a journal, so what it may have said is "
        f"not undone: {line[:200]!r}"
        for number, line in journal.strange_lines(_READERS)
    )


def end_run(journal: Journal) -> tuple[str, ...]:
    """End a run: its owner does it, made to go on if it was stopped (Ctrl-Z), or we do, if it is
    gone or has to be killed. What could not be undone. Raises OperationError: it is not ours.
    """
    if (pidfd := journal.open_owner()) is not None:
        try:
            for numbers in ((signal.SIGTERM, signal.SIGCONT), (signal.SIGKILL,)):
                for number in numbers:
                    signal.pidfd_send_signal(pidfd, number)
                if _wait_for_end(journal):
                    break
        except ProcessLookupError:
            pass
        except PermissionError:
            raise OperationError(
                f"the run {journal.name} is of another user: end it as that user, or as root"
            ) from None
        finally:
            os.close(pidfd)
    left = undo_run(journal)
    if not left and (left := strange_lines(journal)):
        remove_run(journal)  # trying again would not help
    return left


def _wait_for_end(journal: Journal) -> bool:
    # Its command, which it ends on its way, has so long as well, and would run on without it.
    deadline = time.monotonic() + PATIENCE_S + 4 * own_processes.PATIENCE_S
    while journal.path.exists() and journal.owner is not None:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def undo_run(journal: Journal, *, by_owner: bool = False) -> tuple[str, ...]:
    """Undo what a run has changed; what could not be undone, in sentences. If its owner is gone or
    asks for it, the run is removed, unless something is left, or its journal has strange lines.
    """
    left: list[str] = []
    with contextlib.ExitStack() as stack:
        try:
            if not journal.keep():
                return ()
            stack.enter_context(locked(journal.path.parent, _hasten))
        except FileNotFoundError:
            return ()  # another process was quicker
        except OperationError as error:
            return (str(error),)
        except OSError:
            pass  # its folder is gone, and there is no room for another: it is in memory
        _end_processes(journal, DISPATCHER)
        # Threads run first; those born in our groups are known by them, as long as these are.
        groups = freezer.groups_of(freezer.run_of(journal))
        freezer.thaw(groups)
        for undo in (
            partial(release_threads, journal, groups),
            partial(_restore_groups, journal),
            partial(litmus.restore_plugin, journal),
        ):
            try:
                if not journal.outdated:
                    undo()
            except Exception as error:
                left.append(str(error) or type(error).__name__)
        is_over = by_owner or journal.owner is None
        if is_over and not left and not strange_lines(journal):
            _end_processes(journal, GUARDIAN)
            remove_run(journal)
    return tuple(left)


def _hasten(holder: LockHolder | None, waited_s: float) -> None:
    """Another process undoes this run: one that was stopped goes on, one that hangs is ended."""
    if holder is None or holder.pid == os.getpid():
        return
    if (pidfd := open_process(holder.pid, holder.started)) is not None:
        with contextlib.suppress(OSError):
            signal.pidfd_send_signal(pidfd, signal.SIGCONT)
            if waited_s > PATIENCE_S / 2:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        os.close(pidfd)


def _end_processes(journal: Journal, role: str) -> None:
    """Kill all processes of a role, this one excepted: one that was stopped hears nothing else."""
    for process in processes_of_role(journal, role):
        if process.pid == os.getpid():
            continue
        if (pidfd := open_process(process.pid, process.started)) is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            os.close(pidfd)


def _restore_groups(journal: Journal) -> None:
    left = freezer.restore(freezer.run_of(journal))
    if journal.owner is None and strange_lines(journal):  # one of them may have spoken of groups
        left += tuple(filter(None, map(cgroups.dissolve, freezer.stray_groups(()))))
    if left:
        raise OperationError("; ".join(left))


def remove_run(journal: Journal) -> None:
    """Remove the folder of a run that is over: what it shows of itself, then the journal."""
    with contextlib.suppress(FileNotFoundError):
        for path in journal.path.parent.iterdir():
            if path != journal.path and not path.is_dir():
                path.unlink(missing_ok=True)
    discard_journal(journal)


def release_strays(journals: Iterable[Journal]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Dissolve :func:`.stray_groups`: their threads run again, and it is mounted as before. Returns
    the groups that are gone, and what could not be put back, since nothing says what was there.
    """
    gone, left = [], []
    for folder in freezer.stray_groups(journals):
        tids = cgroups.threads_in(folder)
        if (why := cgroups.dissolve(folder)) is None:
            gone.append(folder)
        else:
            left.append(why)
        real_time = (one for one in map(find_thread, tids) if one is not None and one.priority)
        for thread in real_time:
            with contextlib.suppress(ProcessLookupError):
                left.append(
                    f"{thread.text} runs on under {state_of(thread.tid).text}, and what it had"
                    f" before is not known: `chrt --other --pid 0 {thread.tid}`,"
                    f" `taskset -pc CORES {thread.tid}`"
                )
    freezer.restore_mount()
    if left and cgroups.moves_are_quick():
        left.append(
            f"{cgroups.mount_point()} is mounted with {cgroups.QUICK_MOVES}, perhaps by that run: "
            "it does no harm, and is gone with the next boot"
        )
    return tuple(gone), tuple(left)
