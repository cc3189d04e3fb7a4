"""Plans in force as tables: servers with their slots, threads and counters, and runs."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from chainshaper.enforcement.threads import WantedScheduling
from chainshaper.enforcement.undoing import RunState, ServerState
from chainshaper.linux.runs import Journal
from chainshaper.linux.scheduling import Scheduling
from chainshaper.linux.threads import POLICIES
from chainshaper.planning.plan import slot_text
from chainshaper.reporting.cells import terminal_table
from chainshaper.values.durations import format_duration

__all__ = ["changes_table", "run_line", "runs_table", "servers_table"]


def servers_table(state: RunState) -> Table:
    """The servers of a run, a row each, with what they have done since they were armed."""
    table = terminal_table(
        f"{state.plan or 'plan'} in force with {state.back_end}",
        ("server", "core", "priority", "slots", "threads", "kept by"),
        ("slots opened", "late", "worst", "overruns"),
    )
    table.caption = _caption(state)
    for server in state.servers:
        table.add_row(
            server.name,
            str(server.core),
            str(server.priority),
            " ".join(slot_text(slot) for slot in server.slots),
            ", ".join(map(str, server.threads)) or "none",
            server.kept_by,
            *_counted(server),
        )
    return table


def runs_table(runs: Sequence[tuple[Journal, RunState | None]]) -> Table:
    """Every run on this machine: its plan, back end and owner, and how it is doing."""
    table = terminal_table("Plans in force", ("run", "plan", "back end", "owner", "state"))
    for journal, state in runs:
        owner = journal.owner
        table.add_row(
            journal.path.parent.name,
            state.plan if state else "not known yet",
            state.back_end if state else "",
            str(owner) if owner is not None else "gone",
            _condition(owner is not None, state),
        )
    return table


def changes_table(changes: Sequence[WantedScheduling]) -> Table:
    """What a plan would give to each thread, a row each."""
    names = ("node", "pid", "tid", "name", "role", "server", "class", "core", "why")
    table = terminal_table("What threads would get", names)
    for one in changes:
        thread, wanted = one.thread.thread, one.wanted
        table.add_row(
            ", ".join(one.thread.nodes),
            str(thread.pid),
            str(thread.tid),
            thread.comm,
            thread.role,
            one.server or "",
            _class_text(wanted),
            ", ".join(map(str, wanted.cores)) if wanted.cores else "as they are",
            one.reason,
        )
    return table


def _class_text(wanted: Scheduling) -> str:
    if wanted.priority is None:
        return "as it is"
    policy = POLICIES[wanted.policy].removeprefix("SCHED_")
    return f"{policy} {wanted.priority}" if wanted.priority else policy


def run_line(state: RunState) -> str:
    """The state of a run in one line, for where there is no terminal."""
    parts = []
    for server in state.servers:
        counted = dict(zip(("slots", "late", "worst", "overruns"), _counted(server), strict=True))
        told = ", ".join(f"{key} {value}" for key, value in counted.items() if value != "-")
        if told:
            parts.append(f"{server.name}: {told}")
    return "; ".join(parts) or f"in force with {state.back_end}"


def _caption(state: RunState) -> str:
    if state.anchor_ns is None:
        return ""
    said = f"cycles of {format_duration(state.cycle_ns)}"
    if state.drift_ns is not None:
        said += f"; the chain begins {_signed(state.drift_ns)} from where it did"
    return said


def _signed(duration_ns: int) -> str:
    sign = "-" if duration_ns < 0 else "+"
    return sign + format_duration(abs(duration_ns))


def _counted(server: ServerState) -> list[str]:
    counters = server.counters
    lateness = counters.longest_lateness_ns
    values: list[Any] = [
        counters.slots,
        counters.late_entries,
        None if lateness is None else format_duration(lateness),
        counters.overruns,
    ]
    return ["-" if value is None else str(value) for value in values]


def _condition(alive: bool, state: RunState | None) -> str:
    if not alive:
        return "crashed: `chainshaper release` undoes it"
    if state is None:
        return "being set up"
    return f"failed: {state.failure}" if state.failure else run_line(state)
