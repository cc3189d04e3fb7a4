"""Tables for the terminal, and the same figures as plain data for ``--json``."""

from collections.abc import Sequence
from typing import Any

import polars as pl
from rich.markup import escape
from rich.table import Table

from chainshaper.analysis import LatencyStatistics
from chainshaper.durations import format_duration, milliseconds
from chainshaper.planning import Plan, band_predictions, publish_slots
from chainshaper.reporting.application_graph import short_symbol
from chainshaper.reporting.predictions import prediction_json
from chainshaper.steps import Comparison, Measurement

__all__ = [
    "bands_table",
    "callback_rows",
    "callback_table",
    "comparison_json",
    "comparison_table",
    "latency_json",
    "latency_table",
    "plan_table",
    "statistics_json",
]

ABSENT = "–"


def statistics_json(statistics: LatencyStatistics) -> dict[str, Any]:
    """Statistics as DESIGN's contract has them: integers in nanoseconds."""
    return {
        "count": statistics.count,
        "incomplete": statistics.incomplete,
        "disturbed": statistics.disturbed,
        "min_ns": statistics.min_ns,
        "mean_ns": statistics.mean_ns,
        "max_ns": statistics.max_ns,
        "jitter_ns": statistics.jitter_ns,
        "spread_ns": statistics.spread_ns,
        "percentiles_ns": statistics.percentiles_ns,
    }


def latency_json(measurement: Measurement, *, instances: bool = False) -> dict[str, Any]:
    """One chain's latency as plain data; ``instances`` adds every complete traversal.

    Without ``stalls_watched`` nobody looked for stalls of the machine, so ``disturbed`` is 0
    whatever it did.
    Instances have their start and end in ns of the trace clock (wall clock).
    """
    analysis = measurement.analysis
    result = {
        "chain": analysis.chain.spec,
        **statistics_json(analysis.statistics),
        "undisturbed": statistics_json(analysis.undisturbed),
        "subscriber": _optional(analysis.subscriber),
        "subscriber_undisturbed": _optional(analysis.subscriber_undisturbed),
        "incomplete_by_reason": analysis.incomplete,
        "silent": analysis.silent,
        "overruns": None if measurement.overruns is None else sum(measurement.overruns.values()),
        "overruns_by_policy": measurement.overruns,
        "stalls_watched": measurement.longest_stall_ns is not None,
        "longest_stall_ns": measurement.longest_stall_ns,
        "realtime": measurement.recording.info.realtime,
        "lost": measurement.recording.info.lost,
        "notes": list(analysis.notes),
    }
    if instances:
        offset = measurement.recording.info.clock_offset_ns
        complete = analysis.traversals.filter("complete")
        result["instances"] = complete.select(
            (pl.col("start") + offset).alias("start_ns"),
            (pl.col("end") + offset).alias("end_ns"),
            "latency_ns",
            "disturbed",
        ).to_dicts()
    return result


def _optional(statistics: LatencyStatistics | None) -> dict[str, Any] | None:
    return None if statistics is None else statistics_json(statistics)


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """A comparison as plain data, one entry per recording."""
    entries = []
    for measurement in comparison.measurements:
        entry = {"recording": str(measurement.recording.path), **latency_json(measurement)}
        if measurement.plan is not None:
            entry["predicted"] = measurement.plan.predicted.model_dump(mode="json")
        if measurement.held is not None:
            entry["prediction"] = prediction_json(measurement.held)
        entries.append(entry)
    return {"chain": comparison.chain, "recordings": entries}


def _titled(title: str) -> Table:
    # Units in brackets are not Rich's markup.
    return Table(title=escape(title), title_justify="left")


def latency_table(measurement: Measurement) -> Table:
    """End-to-end latency: at publication and at the subscriber, all cycles and undisturbed ones.

    Where nobody watched the machine, no cycle is called undisturbed.
    """
    analysis = measurement.analysis
    table = _titled(f"End-to-end latency of {analysis.chain.spec} [ms]")
    table.add_column("")
    columns: list[tuple[str, LatencyStatistics | None]] = [
        ("all cycles", analysis.statistics),
        ("undisturbed", analysis.undisturbed),
        ("at the subscriber", analysis.subscriber),
        ("…undisturbed", analysis.subscriber_undisturbed),
    ]
    if measurement.longest_stall_ns is None:
        columns = columns[::2]
    for name, _ in columns:
        table.add_column(name, justify="right")
    for title, field in _FIGURES:
        table.add_row(title, *(_figure(statistics, field) for _, statistics in columns))
    table.add_row("cycles", *(ABSENT if s is None else str(s.count) for _, s in columns))
    return table


_FIGURES = (
    ("average", "mean_ns"),
    ("minimum", "min_ns"),
    ("maximum", "max_ns"),
    ("jitter (max − min)", "jitter_ns"),
    ("spread p0.5–p99.5", "spread_ns"),
)


def _figure(statistics: LatencyStatistics | None, field: str) -> str:
    value = None if statistics is None else getattr(statistics, field)
    return ABSENT if value is None else milliseconds(value)


def comparison_table(comparison: Comparison) -> Table:
    """Before and after in one table: what this project is for."""
    table = _titled(f"End-to-end latency of {comparison.chain} [ms]")
    table.add_column("")
    for measurement in comparison.measurements:
        table.add_column(escape(measurement.recording.path.name), justify="right")
    analyses = [measurement.analysis for measurement in comparison.measurements]
    _add_section(table, "at publication", [a.undisturbed for a in analyses])
    _add_section(
        table, "at the subscriber's callback", [a.subscriber_undisturbed for a in analyses]
    )
    table.add_row("[bold]including disturbed cycles[/]", *[""] * len(analyses))
    table.add_row("  maximum", *(_figure(a.statistics, "max_ns") for a in analyses))
    table.add_row("  jitter (max − min)", *(_figure(a.statistics, "jitter_ns") for a in analyses))
    table.add_section()
    table.add_row("cycles", *(str(a.statistics.count) for a in analyses))
    table.add_row(
        "  disturbed by the machine",
        *(
            "not watched" if m.longest_stall_ns is None else str(m.analysis.statistics.disturbed)
            for m in comparison.measurements
        ),
    )
    table.add_row("  incomplete", *(str(a.statistics.incomplete) for a in analyses))
    table.add_row(
        "  too late for their slot",
        *(_overruns(measurement) for measurement in comparison.measurements),
    )
    table.add_row(
        "longest stall of the machine",
        *(
            ABSENT if m.longest_stall_ns is None else milliseconds(m.longest_stall_ns)
            for m in comparison.measurements
        ),
    )
    lost = [sum(m.recording.info.lost.values()) for m in comparison.measurements]
    table.add_row("lost while recording", *map(str, lost))
    realtime = [measurement.recording.info.realtime for measurement in comparison.measurements]
    table.add_row(
        "real-time scheduling", *({True: "yes", False: "no", None: ABSENT}[r] for r in realtime)
    )
    for measurement in comparison.measurements:
        if measurement.plan is not None:
            predicted = measurement.plan.predicted
            table.caption = (
                f"planned: slots {slots_text(measurement.plan)}, "
                f"predicted maximum {milliseconds(predicted.max_ns)}, "
                f"jitter at most {milliseconds(predicted.jitter_ns)}"
            )
    return table


def _overruns(measurement: Measurement) -> str:
    """How many outputs overran, and what was done about them: ``3 (2 discard, 1 wait)``."""
    if measurement.overruns is None:
        return ABSENT
    done = ", ".join(f"{count} {policy}" for policy, count in measurement.overruns.items())
    return f"{sum(measurement.overruns.values())}{f' ({done})' if done else ''}"


def _add_section(table: Table, title: str, columns: Sequence[LatencyStatistics | None]) -> None:
    table.add_row(f"[bold]{title}[/]", *[""] * len(columns))
    for name, field in _FIGURES:
        if field != "min_ns":
            table.add_row(f"  {name}", *(_figure(statistics, field) for statistics in columns))
    table.add_section()


def slots_text(plan: Plan) -> str:
    """The publish slots: ``[64.213, 65.213)``."""
    return " ".join(
        f"[{milliseconds(start)}, {milliseconds(end)})" for start, end in publish_slots(plan)
    )


def plan_table(plan: Plan) -> Table:
    """Servers and slots of a plan."""
    table = _titled(f"Plan for {plan.chain.spec or 'a chain'} [ms]")
    for name in ("server", "core", "priority", "slots", "threads"):
        table.add_column(name, justify="right" if name in ("core", "priority") else "left")
    for server in plan.servers:
        slots = " ".join(f"[{milliseconds(a)}, {milliseconds(b)})" for a, b in server.slots)
        threads = ", ".join(
            thread.node + (" (publisher)" if thread.role == "publisher" else "")
            for thread in server.threads
        )
        # Brackets of half-open intervals are not Rich's markup.
        table.add_row(
            server.name,
            str(server.core),
            str(server.priority),
            slots.replace("[", "\\["),
            threads,
        )
    predicted = plan.predicted
    offset = f", starting {milliseconds(plan.offset_ns)} late" if plan.offset_ns else ""
    table.caption = (
        f"cycle {milliseconds(plan.cycle_ns)}{offset}; "
        f"predicted average {milliseconds(predicted.mean_ns)}, "
        f"maximum {milliseconds(predicted.max_ns)}, jitter at most "
        f"{milliseconds(predicted.jitter_ns)}"
    )
    return table


def bands_table(plan: Plan) -> Table:
    """What a plan predicts of each latency band."""
    table = _titled("Predicted latency bands [ms]")
    for name in ("slot", "share of cycles", "jitter at most"):
        table.add_column(name, justify="right")
    for start, end, share, jitter in band_predictions(plan):
        slot = escape(f"[{milliseconds(start)}, {milliseconds(end)})")
        table.add_row(slot, f"{share:.1%}", milliseconds(jitter))
    return table


def callback_rows(statistics: pl.DataFrame) -> list[dict[str, Any]]:
    """Callback statistics as plain data: response and execution times in ns."""
    keys = ("node", "kind", "topic", "period_ns", "pid", "tids", "count")
    times = ("response_ns", "execution_ns")
    return [{key: row[key] for key in (*keys, *times)} for row in statistics.to_dicts()]


def callback_table(statistics: pl.DataFrame) -> Table:
    """Every callback: its thread, how often it ran, and its execution and response times.

    Execution times have columns only where there are any.
    """
    table = _titled("Callbacks [ms]")
    for name in ("node", "callback", "thread", "count"):
        right = name in {"thread", "count"}
        table.add_column(name, justify="right" if right else "left", overflow="fold")
    measured = [name for name in ("execution", "response") if statistics[f"{name}_ns"].count()]
    for name in measured:
        for figure in ("min", "mean", "max"):
            table.add_column(f"{name}\n{figure}", justify="right", no_wrap=True)
    rows = statistics.to_dicts()
    triggers = [(row["pid"], row["node"], _trigger(row)) for row in rows]
    for row, (pid, node, trigger) in zip(rows, triggers, strict=True):
        alike = triggers.count((pid, node, trigger)) > 1
        function = f" ({short_symbol(row['symbol'])})" if alike and row["symbol"] else ""
        tids = row["tids"]
        table.add_row(
            escape(node),
            escape(trigger + function),
            str(tids[0]) if len(tids) == 1 else f"{len(tids)} threads",
            str(row["count"]),
            *(
                ABSENT if row[f"{name}_ns"] is None else milliseconds(row[f"{name}_ns"][figure])
                for name in measured
                for figure in ("min", "mean", "max")
            ),
        )
    return table


def _trigger(row: dict[str, Any]) -> str:
    period = row["period_ns"]
    what = row["topic"] if period is None else f"every {format_duration(period)}"
    return f"{row['kind']} {what or ''}".rstrip()
