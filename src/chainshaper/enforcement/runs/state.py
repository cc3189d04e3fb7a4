"""Plans in force on this machine: what each run says of itself, and ending one from outside.

A run has a folder (`/run/chainshaper/RUN`): the journal of all that it changed
(:mod:`.journal`), the back end's own files, and `run.json`, which it writes anew every second for
whoever wants to look (`chainshaper status`). Ending a run from outside asks its owner to; where
the owner is gone, all is undone from what the folder says (`chainshaper release`).
"""

import contextlib
import fcntl
import json
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.freezer import state as freezer_state
from chainshaper.enforcement.litmus import back_end as litmus
from chainshaper.enforcement.runs.journal import Journal, discard_journal, find_journals
from chainshaper.enforcement.runs.scheduling_memory import release_threads
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.errors import OperationError, PlatformError

__all__ = [
    "RunState",
    "ServerState",
    "end_run",
    "find_runs",
    "remove_run",
    "runs_as_json",
    "save_run_state",
    "undo_run",
]

FILE = "run.json"
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class ServerState:
    """A server in force: its slots (ns after the start of a cycle), threads and counters.

    ``kept_by`` says who keeps its threads inside the slots: the back end, or the shaping node's
    own ``gate``.
    """

    name: str
    core: int
    priority: int
    slots: tuple[tuple[int, int], ...]
    threads: tuple[int, ...]
    kept_by: str
    counters: ServerCounters


@dataclass(frozen=True)
class RunState:
    """A plan in force. Times are ns of CLOCK_MONOTONIC.

    Cycles start at ``anchor_ns`` and every ``cycle_ns`` from there. ``drift_ns`` is how far the
    chain's beginning has moved since (None: not looked at again yet), ``failure`` why the servers
    are no longer enforced.
    """

    run: str
    owner: int
    plan: str
    command: tuple[str, ...]
    back_end: str
    reason: str
    started_ns: int
    cycle_ns: int
    anchor_ns: int | None
    phase_spread_ns: int | None
    drift_ns: int | None
    servers: tuple[ServerState, ...]
    notes: tuple[str, ...]
    failure: str | None


def save_run_state(folder: Path, state: RunState) -> None:
    """Write `run.json`; a reader sees the old or the new one, whole."""
    partial = folder / f"{FILE}.partial"
    partial.write_text(json.dumps(asdict(state)))
    partial.replace(folder / FILE)


def find_runs(folder: Path | None = None) -> Iterator[tuple[Journal, RunState | None]]:
    """All runs that are not over, crashed ones included, with what they last said of themselves."""
    for journal in find_journals(folder):
        state = None
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            state = _from_json(json.loads((journal.path.parent / FILE).read_text()))
        if journal.path.exists():  # not over meanwhile
            yield journal, state


def runs_as_json(folder: Path | None = None) -> list[dict[str, Any]]:
    """The same as plain data: ``alive`` tells whether the owner still is."""
    return [
        {
            "run": journal.path.parent.name,
            "folder": str(journal.path.parent),
            "alive": journal.owner is not None,
            "state": None if state is None else asdict(state),
        }
        for journal, state in find_runs(folder)
    ]


def end_run(journal: Journal) -> tuple[str, ...]:
    """End a run: its owner does it, or we do where it is gone. What could not be undone, if so.

    An owner that somebody has stopped (Ctrl-Z) is made to go on: it could not end otherwise.

    Raises:
        OperationError: the owner does not react, or is not ours to end.
    """
    owner = journal.owner
    if owner is None:
        return undo_run(journal)
    try:
        os.kill(owner, signal.SIGTERM)
        os.kill(owner, signal.SIGCONT)
    except ProcessLookupError:
        return undo_run(journal)
    except PermissionError:
        raise OperationError(
            f"the run {journal.path.parent.name} belongs to process {owner} of another user: end "
            "it as that user, or as root"
        ) from None
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        if not journal.path.exists():
            return ()
        if journal.owner is None:
            return undo_run(journal)
        time.sleep(0.05)
    raise OperationError(
        f"process {owner} was asked to end the run {journal.path.parent.name} and has not within "
        f"{_PATIENCE_S:g} s: end it with `kill -KILL {owner}`, then run `chainshaper release` again"
    )


def undo_run(journal: Journal) -> tuple[str, ...]:
    """Undo what a run whose owner is gone has changed; what could not be undone, in sentences.

    The journal stays where something is left, so that it can be tried again. Who is at it while
    somebody else is waits, and finds it done.
    """
    left: list[str] = []
    with _locked(journal.path.parent):
        if not journal.path.exists():
            return ()
        for undo in (_thaw, release_threads, litmus.restore_plugin):
            try:
                undo(journal)
            except (OperationError, PlatformError) as error:
                left.append(str(error))
        if not left:
            remove_run(journal)
    return tuple(left)


def remove_run(journal: Journal) -> None:
    """Remove the folder of a run that is over: what the back end kept there, then the journal."""
    for path in journal.path.parent.iterdir():
        if path != journal.path and not path.is_dir():
            path.unlink(missing_ok=True)
    discard_journal(journal)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Nobody else undoes the run of this folder; a folder that is gone needs no lock."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except FileNotFoundError:
        yield
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _thaw(journal: Journal) -> None:
    # The freezer's own supervisor may be at it: it holds the folder's lock until it is done.
    deadline = time.monotonic() + 5
    while True:
        try:
            freezer_state.clean_up(journal.path.parent)
            return
        except OperationError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _from_json(content: dict[str, Any]) -> RunState:
    servers = tuple(
        ServerState(
            **{
                **server,
                "slots": tuple((start, end) for start, end in server["slots"]),
                "threads": tuple(server["threads"]),
                "counters": ServerCounters(**server["counters"]),
            }
        )
        for server in content["servers"]
    )
    fixed = {"servers": servers} | {name: tuple(content[name]) for name in ("command", "notes")}
    return RunState(**{**content, **fixed})
