"""A run from its claim to its end: the cores and nodes it claims, its state, and undoing it.

Two plans never govern the same core or node. So each run writes into its journal which cores and
nodes it claims, while it has the folder of all runs locked.

A run that is in force is asked to end. If its owner has ended, or does not react, any other process
can undo the run from its journal. Where even the journal is gone, the run's cgroups are known by
their names (:func:`release_strays`).
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
from chainshaper.linux import cgroups, child_processes
from chainshaper.linux.scheduling import state_of
from chainshaper.linux.threads import find_thread, open_process
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import OperationError, PlatformError, storable
from chainshaper.values.files import open_output, read_regular

CLAIMS = "claims"
PATIENCE_S = 20.0
"""How long a run may take to begin, or to end when asked, its command's end not counted.

A process that undoes a run has half of that.
"""


@dataclass(frozen=True)
class ServerState(ReservationServer):
    """A server in force."""

    threads: tuple[int, ...]  # their ids
    kept_by: str  # what restricts them to the slots: a back end's name or, in a node, "gate"
    counters: ServerCounters


@dataclass(frozen=True)
class SlotMove:
    """A shift of a chain's slots against those of the plan."""

    from_ns: int  # the instant from which it holds (CLOCK_MONOTONIC)
    chain: str
    moved_ns: int  # how much later than planned the slots begin
    start_ns: int  # when the last slot of the chain's output begins now, after the chain's origin
    why: str

    @property
    def text(self) -> str:
        start = duration_text(self.start_ns)
        return f"the last slot of {self.chain} begins at {start} now: {self.why}"


@dataclass(frozen=True)
class LoopStep:
    """A move of a chain's output, or of a loop, so that both are in step."""

    at_ns: int  # when it was asked for (CLOCK_MONOTONIC)
    chain: str
    loop: str  # its node
    moves: str  # what is moved: "output" or "loop"
    moved_ns: int | None  # how much later than by itself that comes now; None: nothing was moved
    drift_ppm: float | None  # of the loop's clock against that of this machine
    why: str

    @property
    def text(self) -> str:
        moved = "stays" if self.moved_ns is None else f"comes {duration_text(self.moved_ns)} later"
        subject = f"the loop of {self.loop}" if self.moves == "loop" else f"output of {self.chain}"
        return f"in step: {subject} {moved}: {self.why}"


@dataclass(frozen=True)
class LoopState:
    """A chain's output and a loop that are kept in step, as they are now. Times are ns."""

    chain: str
    loop: str  # its node
    moves: str  # what is moved: "output" or "loop"
    lead_ns: int  # so long before the loop starts, the output's slot is to begin
    is_there: bool  # whether the loop is seen
    in_step: bool
    waits_for: str | None  # why they are not in step; None: they are
    moved_ns: int | None  # how much later than by itself comes what is moved; None: it was not yet
    # How much later than the lead the loop starts behind the output, as measured; negative: sooner.
    error_ns: int | None
    drift_ppm: float | None  # of the loop's clock against that of the chain
    age_ns: int | None  # of what the loop reads, from the chain's origin; None: not known yet
    starts: int  # of the loop, over the last minute in step
    misses: int  # of these, how many were off by more than the lead: their data are other ones

    @property
    def name(self) -> str:
        """Text: both."""
        return f"{self.chain} and the loop of {self.loop}"

    @property
    def text(self) -> str:
        """How both are now, in a part of a sentence."""
        if not self.in_step:
            return f"{self.name} are not in step: {self.waits_for}"
        parts = [f"lead {duration_text(self.lead_ns)}"]
        if self.error_ns is not None:
            parts.append(f"off by {self.error_ns / 1e6:+.3f} ms")
        if self.drift_ppm is not None:
            parts.append(f"drift {self.drift_ppm:+.1f} ppm")
        if self.moved_ns is not None:
            parts.append(f"{self.moves} moved by {duration_text(self.moved_ns)}")
        parts.append(f"{self.misses} of {self.starts} starts missed in the last minute")
        return f"{self.name} are in step: {', '.join(parts)}"


@dataclass(frozen=True)
class RunState:
    """The state of a run, as `run.json` shows it.

    Instants are of CLOCK_MONOTONIC (ns), and None as long as they are still to come.
    """

    run: str  # its name
    owner: int  # the id of the process that keeps the plan in force
    plan: str  # the path of its file
    command: tuple[str, ...]  # that the run has started; (): none
    back_end: str
    reason: str  # why this back end was chosen
    started_ns: int
    cycle_ns: int
    anchor_ns: int | None = None  # cycles start at this instant + k * cycle_ns
    phase_spread_ns: int | None = None  # of the chain's beginnings, when the anchor was measured
    drift_ns: int | None = None  # how far the chain's beginning has moved since
    servers: tuple[ServerState, ...] = ()
    notes: tuple[str, ...] = ()
    failure: str | None = None  # why the plan is not enforced; None: it is
    in_force_ns: int | None = None  # when the first whole cycle that was enforced began
    ended_ns: int | None = None
    moves: tuple[SlotMove, ...] = ()  # the latest ones of each chain's gate
    steps: tuple[LoopStep, ...] = ()  # the latest ones of each loop that is kept in step
    loops: tuple[LoopState, ...] = ()  # those, as they are now


def save_run_state(folder: Path, state: RunState) -> None:
    """Write `run.json` whole, so that nobody reads a part of it.

    Raises OSError: it cannot be written. That may be ignored: a plan in force does not read it.
    """
    partial_file = folder / f"{STATE_FILE}.partial"
    try:
        partial_file.unlink(missing_ok=True)
        with os.fdopen(open_output(partial_file), "w") as file:
            file.write(json.dumps(storable(asdict(state))))
        partial_file.replace(folder / STATE_FILE)
    finally:
        partial_file.unlink(missing_ok=True)  # what a full disk did not take would stay on it


def find_runs(folder: Path | None = None) -> Iterator[tuple[Journal, RunState | None]]:
    """Yield all runs that are not over, crashed ones included, each with its last state."""
    from pydantic import TypeAdapter  # here: guardians import this module, and need no pydantic

    for journal in find_journals(folder):
        state = None
        with contextlib.suppress(OSError, ValueError):
            content = read_regular(journal.path.with_name(STATE_FILE))
            state = TypeAdapter(RunState).validate_json(content)
        if journal.path.exists():  # not over meanwhile
            yield journal, state


def runs_as_json(folder: Path | None = None) -> list[dict[str, Any]]:
    """Return all runs that are not over as plain data; ``unreadable`` are its strange lines."""
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
    """Begin a run that governs these cores and nodes; return the journal for its changes.

    ``go_on`` is called while another run begins, and may raise an exception to stop waiting.

    Raises OperationError: a living run governs one of the cores or nodes, a crashed one cannot be
    undone, or one that begins takes too long. PlatformError: nothing may be written to the folder.
    """
    base = journals_folder(folder)
    wanted: dict[str, set[Any]] = {"core": set(cores), "node": set(nodes)}

    def waiting(holder: LockHolder | None, waited_s: float) -> None:
        go_on()
        if waited_s > PATIENCE_S:
            raise OperationError(_late_beginning(holder))

    with contextlib.ExitStack() as stack:
        try:
            # No other user may write there: what journals say is believed, and undone.
            base.mkdir(mode=0o755, parents=True, exist_ok=True)
            stack.enter_context(all_runs_locked(base, waiting))
        except OSError as error:
            raise PlatformError(
                f"{base}, where runs keep a journal of what they change, cannot be used "
                f"({error.strerror}): run as root, or set $XDG_RUNTIME_DIR to a folder of yours"
            ) from error
        for earlier in find_journals(base):
            _make_way(earlier, wanted)
        journal = open_journal(base)
        journal.note(CLAIMS, cores=sorted(cores), nodes=sorted(nodes))
        return journal


def _late_beginning(holder: LockHolder | None) -> str:
    """Say that a process has had the folder of all runs locked for too long, and the remedy."""
    late = f"begins a run, and has not got on with it for {PATIENCE_S:g} s"
    if holder is None:
        return f"a process that is not to be seen from here {late}: end it"
    pid = holder.pid
    return (
        f"process {pid} {late}: let it go on (`kill -CONT {pid}`), or end it (`kill -KILL {pid}`)"
    )


def _make_way(earlier: Journal, wanted: Mapping[str, set[Any]]) -> None:
    """Undo an earlier run that has crashed, if it governs one of the cores or nodes ``wanted``.

    Raises OperationError: it cannot be undone, or it has not crashed.
    """
    shared = " and ".join(
        f"{kind} {', '.join(map(str, sorted(claimed & wanted[kind])))}"
        for claim in earlier.read(CLAIMS, _read_claim)
        for kind, claimed in claim.items()
        if claimed & wanted[kind]
    )
    owner = earlier.owner
    if owner is not None:
        if shared:
            raise OperationError(
                f"the run {earlier.name} of process {owner} governs {shared} already: end it "
                f"first (`chainshaper release {earlier.name}`)"
            )
        return
    may_have_claimed = shared or not earlier.entries(CLAIMS)
    if may_have_claimed and (left := undo_run(earlier)):
        why = "; ".join(left)
        raise OperationError(f"the crashed run {earlier.name} cannot be undone: {why}")


def _read_claim(entry: Mapping[str, Any]) -> dict[str, set[Any]]:
    """Return the claimed cores and nodes of a journal's entry, by their kind."""
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
"""The kinds of entries that a journal may have, and what reads each."""


def strange_lines(journal: Journal) -> tuple[str, ...]:
    """Return a sentence for each line of a journal that cannot be read, so nor undone."""
    return tuple(
        f"{journal.path}, line {number} is not a line of a journal, so what it may have said is "
        f"not undone: {line[:200]!r}"
        for number, line in journal.strange_lines(_READERS)
    )


def end_run(journal: Journal) -> tuple[str, ...]:
    """End a run; return what could not be undone, in sentences.

    Its owner is asked to end it, and made to go on if it was stopped (Ctrl-Z). If the owner has
    ended, or has to be killed, the run is undone here. Raises OperationError: it is another user's.
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
    """Wait until a run has ended; return whether it has in time."""
    # The owner first ends the run's command, which would run on if the owner were killed.
    deadline = time.monotonic() + PATIENCE_S + 4 * child_processes.PATIENCE_S
    while journal.path.exists() and journal.owner is not None:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def undo_run(journal: Journal, *, by_owner: bool = False) -> tuple[str, ...]:
    """Undo what a run has changed; return what could not be undone, in sentences.

    If its owner has ended, or calls this, the run is removed as well, unless something could not be
    undone, or its journal has strange lines.
    """
    left: list[str] = []
    with contextlib.ExitStack() as stack:
        try:
            if not journal.keep():
                return ()
            stack.enter_context(locked(journal.path.parent, _hasten))
        except FileNotFoundError:
            return ()  # another process has undone it meanwhile
        except OperationError as error:
            return (str(error),)
        except OSError:
            pass  # its folder is gone, and cannot be made anew: the journal in memory is enough
        _end_processes(journal, DISPATCHER)
        # Threads run first. The groups go last: threads that were born in them are known by them.
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
    """Make the process that undoes a run go on, if it was stopped, or end it, if it hangs."""
    if holder is None or holder.pid == os.getpid():
        return
    if (pidfd := open_process(holder.pid, holder.started)) is not None:
        with contextlib.suppress(OSError):
            signal.pidfd_send_signal(pidfd, signal.SIGCONT)
            if waited_s > PATIENCE_S / 2:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        os.close(pidfd)


def _end_processes(journal: Journal, role: str) -> None:
    """Kill all processes of a role, this one excepted.

    SIGKILL, since a process that was stopped does not react to other signals.
    """
    for process in processes_of_role(journal, role):
        if process.pid == os.getpid():
            continue
        if (pidfd := open_process(process.pid, process.started)) is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            os.close(pidfd)


def _restore_groups(journal: Journal) -> None:
    """Dissolve the cgroups of a run. Raises OperationError: some are left."""
    left = freezer.restore(freezer.run_of(journal))
    if journal.owner is None and strange_lines(journal):  # one of them may have spoken of groups
        left += tuple(filter(None, map(cgroups.dissolve, freezer.stray_groups(()))))
    if left:
        raise OperationError("; ".join(left))


def remove_run(journal: Journal) -> None:
    """Remove the folder of a run that is over, its journal last."""
    with contextlib.suppress(FileNotFoundError):
        for path in journal.path.parent.iterdir():
            if path != journal.path and not path.is_dir():
                path.unlink(missing_ok=True)
    discard_journal(journal)


def release_strays(journals: Iterable[Journal]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Dissolve cgroups that no journal names (:func:`.stray_groups`), so that their threads run.

    Returns the groups that are gone, and sentences that name what could not be put back: without a
    journal it is not known what was there before.
    """
    gone, left = [], []
    for folder in freezer.stray_groups(journals):
        tids = cgroups.threads_in(folder)
        if (why := cgroups.dissolve(folder)) is None:
            gone.append(folder)
        else:
            left.append(why)
        for thread in map(find_thread, tids):
            if thread is None or not thread.priority:
                continue
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
