"""Plans in rows: servers and slots, predicted bands, figure 7's curve; plans in force; sweeps."""

from collections.abc import Sequence
from typing import Any

import polars as pl

from chainshaper.enforcement.threads import WantedScheduling
from chainshaper.enforcement.undoing import RunState, ServerState
from chainshaper.linux.runs import Journal
from chainshaper.linux.threads import POLICIES
from chainshaper.planning import BandChoice, Plan, band_predictions
from chainshaper.planning.plan import slot_text
from chainshaper.reporting.tables import (
    ABSENT,
    ResultTable,
    figures,
    ms,
    percent,
    scheduling_text,
    slots_ms,
    thread_nodes,
    words,
)
from chainshaper.values.durations import format_duration, milliseconds

__all__ = [
    "bands_table",
    "changes_table",
    "choice_json",
    "choice_table",
    "plan_table",
    "run_line",
    "runs_table",
    "servers_table",
    "sweep_axes",
    "sweep_table",
    "sweep_value",
]

MOST_ROWS = 50
SWEEP_FIGURES = {
    "mean_ns": "average",
    "max_ns": "maximum",
    "jitter_ns": "jitter",
    "band_jitter_ns": "jitter\nin a band",
    "late": "late",
    "incomplete": "no output",
}


def plan_table(plan: Plan) -> ResultTable:
    """Servers and slots of a plan."""
    columns = [*words("server"), *figures("core", "priority"), *words("slots", "threads")]
    table = ResultTable(f"Plan for {plan.chain.spec or 'a chain'} [ms]", columns)
    for server in plan.servers:
        where = str(server.core), str(server.priority)
        table.add(server.name, *where, slots_ms(*server.slots), thread_nodes(server))
    predicted = plan.predicted
    offset = f", starting {milliseconds(plan.offset_ns)} late" if plan.offset_ns else ""
    table.caption = (
        f"cycle {milliseconds(plan.cycle_ns)}{offset}; "
        f"predicted average {milliseconds(predicted.mean_ns)}, "
        f"maximum {milliseconds(predicted.max_ns)}, jitter at most "
        f"{milliseconds(predicted.jitter_ns)}"
    )
    return table


def bands_table(plan: Plan) -> ResultTable:
    """What a plan predicts of each latency band."""
    columns = figures("slot", "share of cycles", "jitter at most")
    table = ResultTable("Predicted latency bands [ms]", columns)
    for start, end, share, jitter in band_predictions(plan):
        table.add(slots_ms((start, end)), percent(share), ms(jitter))
    return table


def choice_table(choice: BandChoice) -> ResultTable:
    """Figure 7 in rows: the average over the number of bands, and where `auto` stops."""
    columns = [*figures("bands", "average", "gain"), *words("slots end at")]
    table = ResultTable("Average over the number of bands [ms]", columns, choice.reason)
    before: float | None = None
    for placement in choice.curve:
        ends = placement.slot_ends_ns
        table.add(
            f"{'→ ' if placement is choice.chosen else ''}{len(ends)}",
            milliseconds(placement.mean_ns),
            ABSENT if before is None else f"{1 - placement.mean_ns / before:.2%}",
            " ".join(milliseconds(end) for end in ends),
        )
        before = placement.mean_ns
    return table


def choice_json(choice: BandChoice) -> dict[str, Any]:
    """The same as plain data."""
    return {
        "curve": [
            {
                "bands": len(placement.slot_ends_ns),
                "mean_ns": round(placement.mean_ns),
                "bands_ns": list(placement.slot_ends_ns),
            }
            for placement in choice.curve
        ],
        "chosen": len(choice.chosen.slot_ends_ns),
        "reason": choice.reason,
    }


def servers_table(state: RunState) -> ResultTable:
    """The servers of a run, a row each, with what they have done since they were armed."""
    table = ResultTable(
        f"{state.plan or 'plan'} in force with {state.back_end}",
        [
            *words("server", "core", "priority", "slots", "threads", "kept by"),
            *figures("slots opened", "late", "worst", "overruns"),
        ],
    )
    if state.anchor_ns is not None:
        table.caption = f"cycles of {format_duration(state.cycle_ns)}"
        if state.drift_ns is not None:
            drift = f"{'-' if state.drift_ns < 0 else '+'}{format_duration(abs(state.drift_ns))}"
            table.caption += f"; the chain begins {drift} from where it did"
    for server in state.servers:
        table.add(
            server.name,
            str(server.core),
            str(server.priority),
            " ".join(slot_text(slot) for slot in server.slots),
            ", ".join(map(str, server.threads)) or "none",
            server.kept_by,
            *_counted(server),
        )
    return table


def run_line(state: RunState) -> str:
    """The state of a run in one line, for where there is no terminal."""
    parts = []
    for server in state.servers:
        counted = dict(zip(("slots", "late", "worst", "overruns"), _counted(server), strict=True))
        known = ", ".join(f"{key} {value}" for key, value in counted.items() if value != "-")
        if known:
            parts.append(f"{server.name}: {known}")
    return "; ".join(parts) or f"in force with {state.back_end}"


def _counted(server: ServerState) -> list[str]:
    counters = server.counters
    lateness = counters.longest_lateness_ns
    worst = None if lateness is None else format_duration(lateness)
    values = (counters.slots, counters.late_entries, worst, counters.overruns)
    return ["-" if value is None else str(value) for value in values]


def runs_table(runs: Sequence[tuple[Journal, RunState | None]]) -> ResultTable:
    """Every run on this machine: its plan, back end and owner, and how it is doing."""
    table = ResultTable("Plans in force", words("run", "plan", "back end", "owner", "state"))
    for journal, state in runs:
        owner = journal.owner
        table.add(
            journal.path.parent.name,
            state.plan if state else "not known yet",
            state.back_end if state else "",
            str(owner) if owner is not None else "gone",
            _condition(owner is not None, state),
        )
    return table


def _condition(alive: bool, state: RunState | None) -> str:
    if not alive:
        return "crashed: `chainshaper release` undoes it"
    if state is None:
        return "being set up"
    return f"failed: {state.failure}" if state.failure else run_line(state)


def changes_table(changes: Sequence[WantedScheduling]) -> ResultTable:
    """What a plan would give to each thread, a row each."""
    names = ("node", "pid", "tid", "name", "role", "server", "class", "core", "why")
    table = ResultTable("What threads would get", words(*names))
    for one in changes:
        thread, wanted = one.thread.thread, one.wanted
        scheduling = "as it is"
        if wanted.priority is not None:
            scheduling = scheduling_text(POLICIES[wanted.policy], wanted.priority)
        table.add(
            ", ".join(one.thread.nodes),
            str(thread.pid),
            str(thread.tid),
            thread.comm,
            thread.role,
            one.server or "",
            scheduling,
            ", ".join(map(str, wanted.cores)) if wanted.cores else "as they are",
            one.reason,
        )
    return table


def sweep_table(frame: pl.DataFrame) -> ResultTable:
    """The axes and the most important figures of each point, those of many only for the first."""
    axes = sweep_axes(frame)
    names = [name.removesuffix("_ns") for name in (*axes, *SWEEP_FIGURES.values())]
    table = ResultTable("Simulated end-to-end latency [ms]", figures(*names))
    for row in frame.head(MOST_ROWS).to_dicts():
        found = [
            ms(row[name]) if row[name] is None or name.endswith("_ns") else str(row[name])
            for name in SWEEP_FIGURES
        ]
        if row["error"] is not None:
            found = ["failed", *([""] * (len(found) - 1))]
        table.add(*(sweep_value(name, row[name]) for name in axes), *found)
    if frame.height > MOST_ROWS:
        table.caption = f"the first {MOST_ROWS} of {frame.height} points"
    return table


def sweep_axes(frame: pl.DataFrame) -> list[str]:
    """Axes stand before what all sweeps have; a seed that is varied is one of them."""
    return frame.columns[: frame.columns.index("cycles")]


def sweep_value(name: str, value: Any) -> str:
    """A point's place on an axis."""
    if value is None:
        return ABSENT
    return format_duration(value) if name.endswith("_ns") else str(value)
