"""Plans in force on this machine: what each run says of itself.

A run has a folder (`/run/chainshaper/RUN`): the journal of all that it changed
(:mod:`.journal`), the back end's own files, and `run.json`, which it writes anew every second for
whoever wants to look (`chainshaper status`).
"""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.runs.journal import Journal, find_journals
from chainshaper.enforcement.runs.undoing import strange_lines
from chainshaper.enforcement.servers import ServerCounters

__all__ = [
    "RunState",
    "ServerState",
    "find_runs",
    "runs_as_json",
    "save_run_state",
]

FILE = "run.json"


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
    are no longer enforced. The first cycle that was enforced as a whole started at ``in_force_ns``
    (None: not yet), enforcing ended at ``ended_ns`` (None: it has not).
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
    in_force_ns: int | None = None
    ended_ns: int | None = None


def save_run_state(folder: Path, state: RunState) -> None:
    """Write `run.json`; a reader sees the old or the new one, whole.

    Raises:
        OSError: it cannot be written; a plan in force needs it for nothing.
    """
    partial = folder / f"{FILE}.partial"
    try:
        partial.write_text(json.dumps(asdict(state)))
        partial.replace(folder / FILE)
    except OSError:
        partial.unlink(missing_ok=True)  # a part of it would fill the disk for good
        raise


def find_runs(folder: Path | None = None) -> Iterator[tuple[Journal, RunState | None]]:
    """All runs that are not over, crashed ones included, with what they last said of themselves."""
    for journal in find_journals(folder):
        state = None
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            state = _from_json(json.loads((journal.path.parent / FILE).read_text()))
        if journal.path.exists():  # not over meanwhile
            yield journal, state


def runs_as_json(folder: Path | None = None) -> list[dict[str, Any]]:
    """The same as plain data: ``alive`` tells whether the owner still is.

    ``unreadable`` are lines of the journal that say nothing.
    """
    return [
        {
            "run": journal.path.parent.name,
            "folder": str(journal.path.parent),
            "alive": journal.owner is not None,
            "unreadable": strange_lines(journal),
            "state": None if state is None else asdict(state),
        }
        for journal, state in find_runs(folder)
    ]


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
