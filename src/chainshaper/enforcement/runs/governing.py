"""Since when, and until when, plans govern the processes that somebody records.

Who records looks now and then: a run that is over leaves nothing behind. What it says of itself
(`run.json`, and its plan) is taken then.
"""

import contextlib
import json
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from chainshaper.enforcement.runs.state import find_runs
from chainshaper.linux.threads import find_thread
from chainshaper.values.errors import OperationError, PlatformError

__all__ = ["PLAN_FILE", "Governed", "governing", "in_force_throughout"]

PLAN_FILE = "plan.json"
"""The plan of a run as plain data, in the folder of the run."""


@dataclass(frozen=True)
class Governed:
    """A run that governs processes, as it was seen last (ns of CLOCK_MONOTONIC).

    In force from ``since_ns`` on, where its first whole cycle starts, and seen so at ``seen_ns``;
    ``until_ns`` is when it ended (None: it has not been seen to).
    """

    run: str
    since_ns: int
    seen_ns: int
    until_ns: int | None
    plan: dict[str, Any] | None


def governing(
    pids: Collection[int],
    now_ns: int,
    before: Collection[Governed] = (),
    folder: Path | None = None,
) -> tuple[Governed, ...]:
    """The runs that govern threads of these processes, those of an earlier look included.

    One that has gone without a word is over since the last look. ``folder`` is where runs keep what
    they need (default: `/run/chainshaper`).
    """
    found = {one.run: one for one in before}
    living = set()
    with contextlib.suppress(OperationError, PlatformError, OSError):
        for journal, state in find_runs(folder):
            if state is None or state.in_force_ns is None or journal.owner is None:
                continue
            name = journal.path.parent.name
            threads = [tid for server in state.servers for tid in server.threads]
            if name in found or _own(pids, threads):
                living.add(name)
                plan = found[name].plan if name in found else _plan(journal.path.parent)
                found[name] = Governed(name, state.in_force_ns, now_ns, state.ended_ns, plan)
    return tuple(
        one if one.run in living or one.until_ns is not None else replace(one, until_ns=one.seen_ns)
        for one in found.values()
    )


def in_force_throughout(runs: Collection[Governed]) -> Governed | None:
    """All runs as one: while they were in force together, with the plan if there was one alone.

    Of runs that followed each other the last one counts; None: there was none.
    """
    if not runs:
        return None
    latest = max(runs, key=lambda one: one.since_ns)
    others = [
        one
        for one in runs
        if one is not latest and (one.until_ns is None or one.until_ns > latest.since_ns)
    ]
    ends = [one.until_ns for one in (latest, *others) if one.until_ns is not None]
    plan = None if others else latest.plan
    return replace(latest, until_ns=min(ends, default=None), plan=plan)


def _own(pids: Collection[int], tids: Collection[int]) -> bool:
    """Whether one of the threads is of one of the processes."""
    found = (find_thread(tid) for tid in tids)
    return any(thread is not None and thread.pid in pids for thread in found)


def _plan(folder: Path) -> dict[str, Any] | None:
    with contextlib.suppress(OSError, ValueError):
        content = json.loads((folder / PLAN_FILE).read_text())
        return content if isinstance(content, dict) else None
    return None
