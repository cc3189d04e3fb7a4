"""Tables for the terminal, and the same figures as plain data for ``--json``."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import polars as pl
from rich.table import Table

from chainshaper.analysis import LatencyStatistics
from chainshaper.planning import Plan, band_predictions, publish_slots
from chainshaper.reporting.application_graph import short_symbol
from chainshaper.reporting.cells import (
    ABSENT,
    FIGURES,
    YES_NO,
    count,
    min_mean_max,
    ms,
    percent,
    slot_ms,
    slots_ms,
    terminal_table,
    thread_nodes,
    trigger,
)
from chainshaper.reporting.predictions import prediction_json
from chainshaper.reporting.terminal import plain
from chainshaper.values.durations import milliseconds
from chainshaper.verify.measure import Comparison, Measurement

__all__ = [
    "bands_table",
    "callback_rows",
    "callback_table",
    "comparison_json",
    "comparison_table",
    "latency_json",
    "latency_table",
    "plan_table",
]


def latency_json(measurement: Measurement, *, instances: bool = False) -> dict[str, Any]:
    """One chain's latency as plain data; ``instances`` adds every complete traversal.

    Without ``stalls_watched`` nobody looked for stalls of the machine, so ``disturbed`` is 0
    whatever it did. ``late``, ``max_all_ns`` and ``jitter_all_ns`` leave no cycle out.
    Instances have their start and end in ns of the trace clock (wall clock).
    """
    analysis, in_force = measurement.analysis, measurement.recording.info.in_force
    result = {
        "chain": analysis.chain.spec,
        **asdict(analysis.statistics),
        "max_all_ns": analysis.statistics.max_ns,
        "jitter_all_ns": analysis.statistics.jitter_ns,
        "undisturbed": asdict(analysis.undisturbed),
        "subscriber": _as_dict(analysis.subscriber),
        "subscriber_undisturbed": _as_dict(analysis.subscriber_undisturbed),
        "incomplete_by_reason": analysis.incomplete,
        "silent": analysis.silent,
        "overruns": None if measurement.overruns is None else sum(measurement.overruns.values()),
        "overruns_by_policy": measurement.overruns,
        "into_open_slots": measurement.into_open_slots,
        "dropped": None if measurement.dropped is None else sum(measurement.dropped.values()),
        "dropped_by_reason": measurement.dropped,
        "stalls_watched": measurement.longest_stall_ns is not None,
        "longest_stall_ns": measurement.longest_stall_ns,
        "in_force": None if in_force is None else in_force.model_dump(),
        "left_out": asdict(measurement.left_out),
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


def _as_dict(statistics: LatencyStatistics | None) -> dict[str, Any] | None:
    return None if statistics is None else asdict(statistics)


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


def latency_table(measurement: Measurement) -> Table:
    """End-to-end latency: at publication and at the subscriber, all cycles and undisturbed ones.

    Where nobody watched the machine, no cycle is called undisturbed.
    """
    analysis = measurement.analysis
    columns: list[tuple[str, LatencyStatistics | None]] = [
        ("all cycles", analysis.statistics),
        ("undisturbed", analysis.undisturbed),
        ("at the subscriber", analysis.subscriber),
        ("…undisturbed", analysis.subscriber_undisturbed),
    ]
    if measurement.longest_stall_ns is None:
        columns = columns[::2]
    title = f"End-to-end latency of {analysis.chain.spec} [ms]"
    table = terminal_table(title, [""], [name for name, _ in columns])
    for title, field in FIGURES:
        table.add_row(title, *(_figure(statistics, field) for _, statistics in columns))
    table.add_row("cycles", *(ABSENT if s is None else str(s.count) for _, s in columns))
    table.add_row("came late", *(ABSENT if s is None else count(s.late) for _, s in columns))
    table.caption = measurement.left_out.text
    return table


def _figure(statistics: LatencyStatistics | None, field: str) -> str:
    return ms(None if statistics is None else getattr(statistics, field))


def comparison_table(comparison: Comparison) -> Table:
    """Before and after in one table: what this project is for."""
    measurements = comparison.measurements
    names = [measurement.recording.path.name for measurement in measurements]
    table = terminal_table(f"End-to-end latency of {comparison.chain} [ms]", [""], names)
    analyses = [measurement.analysis for measurement in measurements]
    _add_section(table, "at publication", [a.undisturbed for a in analyses])
    _add_section(
        table, "at the subscriber's callback", [a.subscriber_undisturbed for a in analyses]
    )
    table.add_row(plain("all cycles, disturbed ones included", "bold"), *[""] * len(analyses))
    table.add_row("  came late", *(_of(a.statistics) for a in analyses))
    table.add_row("  maximum", *(_figure(a.statistics, "max_ns") for a in analyses))
    table.add_row("  jitter (max − min)", *(_figure(a.statistics, "jitter_ns") for a in analyses))
    table.add_section()
    table.add_row("cycles", *(str(a.statistics.count) for a in analyses))
    table.add_row(
        "  disturbed by the machine",
        *(
            "not watched" if m.longest_stall_ns is None else str(m.analysis.statistics.disturbed)
            for m in measurements
        ),
    )
    table.add_row("  incomplete", *(str(a.statistics.incomplete) for a in analyses))
    table.add_row("  too late for their slot", *(_counts(m.overruns) for m in measurements))
    table.add_row("  came when it was open", *(count(m.into_open_slots) for m in measurements))
    table.add_row("messages lost at the gate", *(_counts(m.dropped) for m in measurements))
    table.add_row("longest stall of the machine", *(ms(m.longest_stall_ns) for m in measurements))
    infos = [measurement.recording.info for measurement in measurements]
    table.add_row("lost while recording", *(str(sum(info.lost.values())) for info in infos))
    table.add_row("real-time scheduling", *(YES_NO.get(info.realtime, ABSENT) for info in infos))
    captions = [
        f"{name}: {measurement.left_out.text}"
        for name, measurement in zip(names, measurements, strict=True)
        if measurement.left_out.text is not None
    ]
    planned = [m.plan for m in measurements if m.plan is not None]
    if planned:
        predicted = planned[-1].predicted
        captions.append(
            f"planned: slots {slots_ms(publish_slots(planned[-1]))}, "
            f"predicted maximum {milliseconds(predicted.max_ns)}, "
            f"jitter at most {milliseconds(predicted.jitter_ns)}"
        )
    table.caption = "\n".join(captions) or None
    return table


def _of(statistics: LatencyStatistics) -> str:
    """``3 of 200``, where it is known when outputs were due."""
    return ABSENT if statistics.late is None else f"{statistics.late} of {statistics.count}"


def _counts(by_kind: dict[str, int] | None) -> str:
    """How many there are, and of which kinds: ``3 (2 discard, 1 wait)``."""
    if by_kind is None:
        return ABSENT
    kinds = ", ".join(f"{count} {kind}" for kind, count in by_kind.items())
    return f"{sum(by_kind.values())}{f' ({kinds})' if kinds else ''}"


def _add_section(table: Table, title: str, columns: Sequence[LatencyStatistics | None]) -> None:
    table.add_row(plain(title, "bold"), *[""] * len(columns))
    for name, field in FIGURES:
        if field != "min_ns":
            table.add_row(f"  {name}", *(_figure(statistics, field) for statistics in columns))
    table.add_section()


def plan_table(plan: Plan) -> Table:
    """Servers and slots of a plan."""
    title = f"Plan for {plan.chain.spec or 'a chain'} [ms]"
    table = terminal_table(title, (), ("server", "core", "priority", "slots", "threads"))
    for column in (0, 3, 4):
        table.columns[column].justify = "left"
    for server in plan.servers:
        where = str(server.core), str(server.priority)
        table.add_row(server.name, *where, slots_ms(server.slots), thread_nodes(server))
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
    figures = ("slot", "share of cycles", "jitter at most")
    table = terminal_table("Predicted latency bands [ms]", (), figures)
    for start, end, share, jitter in band_predictions(plan):
        table.add_row(slot_ms(start, end), percent(share), ms(jitter))
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
    table = terminal_table("Callbacks [ms]", ("node", "callback"), ("thread", "count"))
    measured = [name for name in ("execution", "response") if statistics[f"{name}_ns"].count()]
    for name in measured:
        for figure in ("min", "mean", "max"):
            table.add_column(f"{name}\n{figure}", justify="right", no_wrap=True)
    rows = statistics.to_dicts()
    triggers = [(row["pid"], row["node"], trigger(row)) for row in rows]
    for row, (pid, node, what) in zip(rows, triggers, strict=True):
        alike = triggers.count((pid, node, what)) > 1
        function = f" ({short_symbol(row['symbol'])})" if alike and row["symbol"] else ""
        tids = row["tids"]
        table.add_row(
            node,
            what + function,
            str(tids[0]) if len(tids) == 1 else f"{len(tids)} threads",
            str(row["count"]),
            *(cell for name in measured for cell in min_mean_max(row[f"{name}_ns"])),
        )
    return table
