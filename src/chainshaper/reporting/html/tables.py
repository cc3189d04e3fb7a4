"""The report's figures in rows: all of them the library's own, with sample counts beside them."""

from collections.abc import Sequence

import polars as pl

from chainshaper.analysis import REASONS, LatencyStatistics
from chainshaper.durations import format_duration, milliseconds
from chainshaper.overruns import overruns_text
from chainshaper.planning import Plan
from chainshaper.predictions import FigureHeld
from chainshaper.reporting.application_graph import short_symbol
from chainshaper.reporting.breakdown import PARTS, hop_breakdown
from chainshaper.reporting.html.markup import Group, Row, details, paragraph, table
from chainshaper.reporting.timeline import Timeline
from chainshaper.steps import Measurement

__all__ = [
    "breakdown_table",
    "callback_table",
    "comparison_table",
    "headline",
    "incomplete_table",
    "overrun_table",
    "prediction_tables",
    "server_table",
    "stall_tables",
]

ABSENT = "–"
LISTED = 50
"""Rows of a list that may be endless."""

_FIGURES = (
    ("average", "mean_ns"),
    ("minimum", "min_ns"),
    ("maximum", "max_ns"),
    ("jitter (max − min)", "jitter_ns"),
    ("spread p0.5–p99.5", "spread_ns"),
)


def _ms(value: float | None) -> str:
    return ABSENT if value is None else milliseconds(value)


def headline(measurements: Sequence[Measurement], names: Sequence[str]) -> str:
    """One line per recording: what a reader remembers."""
    lines = []
    for name, measurement in zip(names, measurements, strict=True):
        found = measurement.analysis.undisturbed
        lines.append(
            [name, _ms(found.jitter_ns), _ms(found.mean_ns), _ms(found.max_ns), f"{found.count:,}"]
        )
    return table(["at publication [ms]", "jitter", "average", "maximum", "cycles"], lines)


def comparison_table(measurements: Sequence[Measurement], names: Sequence[str]) -> str:
    """Before and after, or one recording alone."""
    analyses = [measurement.analysis for measurement in measurements]
    rows: list[Row] = []
    for place, all_cycles, calm in (
        ("publication", [a.statistics for a in analyses], [a.undisturbed for a in analyses]),
        (
            "the subscriber's callback",
            [a.subscriber for a in analyses],
            [a.subscriber_undisturbed for a in analyses],
        ),
    ):
        # Where nobody watched the machine, no cycle is called undisturbed.
        if any(measurement.longest_stall_ns is not None for measurement in measurements):
            rows += [Group(f"at {place}, undisturbed cycles [ms]"), *_statistics(calm)]
        rows += [Group(f"at {place}, all complete cycles [ms]"), *_statistics(all_cycles)]
    rows += [
        Group("cycles"),
        ["complete", *(str(a.statistics.count) for a in analyses)],
        ["disturbed by the machine", *map(_disturbed, measurements)],
        ["incomplete", *map(_incomplete, measurements)],
        ["too late for their slot", *map(_overruns, measurements)],
        ["begun without publishing", *(str(a.silent) for a in analyses)],
        ["longest stall of the machine [ms]", *(_ms(m.longest_stall_ns) for m in measurements)],
    ]
    return table(["", *names], rows)


def _statistics(columns: Sequence[LatencyStatistics | None]) -> list[Row]:
    rows: list[Row] = [
        [title, *(ABSENT if one is None else _ms(getattr(one, field)) for one in columns)]
        for title, field in _FIGURES
    ]
    for title, key in (("median", "50"), ("99th percentile", "99")):
        values = [None if one is None else one.percentiles_ns.get(key) for one in columns]
        rows.append([title, *map(_ms, values)])
    rows.append(["cycles", *(ABSENT if one is None else str(one.count) for one in columns)])
    return rows


def _disturbed(measurement: Measurement) -> str:
    if measurement.longest_stall_ns is None:
        return "not watched"
    return str(measurement.analysis.statistics.disturbed)


def _incomplete(measurement: Measurement) -> str:
    reasons = measurement.analysis.incomplete
    total = measurement.analysis.statistics.incomplete
    told = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    return f"{total} ({told})" if told else str(total)


def _overruns(measurement: Measurement) -> str:
    if measurement.overruns is None:
        return "not gated"
    return str(sum(measurement.overruns.values()))


def prediction_tables(measurements: Sequence[Measurement], names: Sequence[str]) -> str:
    """Predicted beside measured, where a plan was in force."""
    parts = []
    for name, measurement in zip(names, measurements, strict=True):
        held = measurement.held
        if held is None:
            continue
        rows: list[Row] = [
            _held("average", held.mean),
            _held("maximum", held.max),
            _held("jitter (max − min)", held.jitter),
        ]
        rows += [
            [
                f"band {number}: {band.count} cycles, {band.inside} inside its slot",
                f"[{_ms(band.slot_start_ns)}, {_ms(band.slot_end_ns)})",
                _ms(band.mean_ns),
                f"jitter {_ms(band.jitter_ns)}",
            ]
            for number, band in enumerate(held.bands, start=1)
        ]
        about = (
            f"The plan's prediction and {name}, undisturbed cycles [ms]. Predicted: outputs at the "
            "start … the end of their slots."
        )
        head = ["", "predicted", "measured", "verdict"]
        parts += [paragraph(about), table(head, rows)]
    return "\n".join(parts)


def _held(title: str, figure: FigureHeld) -> list[str]:
    predicted = f"{_ms(figure.at_start_ns)} … {_ms(figure.at_end_ns)}"
    verdict = {True: "as predicted", False: "differs", None: ABSENT}[figure.holds]
    return [title, predicted, _ms(figure.measured_ns), verdict]


def incomplete_table(measurements: Sequence[Measurement], names: Sequence[str]) -> str:
    """Why cycles have no latency, with the first cycles' numbers."""
    rows = []
    for name, measurement in zip(names, measurements, strict=True):
        broken = measurement.analysis.traversals.filter(pl.col("reason").is_not_null())
        grouped = broken.group_by("reason", "broken_at", maintain_order=True).agg("traversal")
        for reason, topic, numbers in grouped.iter_rows():
            first = ", ".join(map(str, numbers[:5])) + (", …" if len(numbers) > 5 else "")
            what = f"{reason}: {REASONS[reason]}"
            rows.append([name, what, topic or ABSENT, str(len(numbers)), first])
    if not rows:
        return paragraph("Every cycle that began is complete.")
    return table(["", "reason", "at", "cycles", "numbers"], rows, words=[1, 2])


def overrun_table(name: str, measurement: Measurement, timeline: Timeline) -> str:
    """Outputs that came behind their slot, one by one."""
    if measurement.overruns is None:
        return paragraph(f"{name}: nothing was gated, so nothing could overrun.")
    if not measurement.overruns:
        return paragraph(f"{name}: no output was too late for its slot.")
    told = paragraph(f"{name}: {overruns_text(measurement.overruns)}.")
    origin = timeline.holds.filter(pl.col("overrun").is_not_null())
    latencies = measurement.analysis.traversals.select("traversal", "latency_ns")
    late = origin.join(latencies, on="traversal", how="left", maintain_order="left")
    if not late.height:
        return told
    rows = [
        [str(cycle), _ms(arrival - origin), done, _ms(latency)]
        for cycle, arrival, origin, done, latency in late.head(LISTED)
        .select("traversal", "arrival", "origin", "overrun", "latency_ns")
        .iter_rows()
    ]
    head = ["cycle", "arrived, from its anchor [ms]", "what was done", "latency [ms]"]
    return told + _some(table(head, rows, words=[2]), late.height)


def _some(content: str, total: int) -> str:
    rest = f"The first {LISTED} of {total} are listed." if total > LISTED else ""
    return content + paragraph(rest)


def stall_tables(name: str, measurement: Measurement, timeline: Timeline) -> str:
    """Stalls per core, and the longest."""
    meter = measurement.recording.info.stall_meter
    if meter is None:
        return paragraph(f"{name}: nobody watched the machine, so its stalls are not known.")
    stalls = timeline.stalls.with_columns(duration=pl.col("end") - pl.col("start"))
    rows = []
    for core, usual in zip(meter.cores, meter.median_lateness_ns, strict=True):
        own = stalls.filter(pl.col("core") == core)["duration"]
        longest = own.max()
        rows.append(
            [
                f"core {core}",
                f"{len(own)}",
                _ms(int(own.sum())),
                _ms(longest if isinstance(longest, int) else None),
                f"{usual / 1e3:.0f}",
            ]
        )
    about = (
        f"{name}: stalls of the machine from {format_duration(meter.threshold_ns)} in "
        f"{meter.wakeups:,} wake-ups of a sleeper at the highest priority; they disturbed "
        f"{measurement.analysis.statistics.disturbed} of "
        f"{measurement.analysis.statistics.count} cycles."
    )
    head = ["", "stalls", "in all [ms]", "longest [ms]", "usual wake-up [µs]"]
    return paragraph(about) + table(head, rows)


def breakdown_table(name: str, measurement: Measurement) -> str:
    """Communication and computation, hop by hop."""
    frame = hop_breakdown(measurement.analysis)
    rows: list[Row] = []
    for row in frame.iter_rows(named=True):
        cells = [f"{row['callback']} → {row['topic']}", str(row["count"])]
        for part in PARTS:
            times = row[f"{part}_ns"] or {"min": None, "mean": None, "max": None}
            cells += [_ms(times["min"]), _ms(times["mean"]), _ms(times["max"])]
            cells.append(_percent(row[f"{part}_share"]))
        rows.append(cells)
    sums = []
    for part in PARTS:
        shares = frame[f"{part}_share"].drop_nulls()
        sums += ["", "", "", _percent(float(shares.sum()) if len(shares) else None)]
    rows.append(["in all", str(measurement.analysis.statistics.count), *sums])
    head = ["hop [ms]", "cycles"]
    for part in PARTS:
        head += [f"{part}: min", "mean", "max", "share"]
    return paragraph(f"{name}, all complete cycles:") + table(head, rows)


def _percent(share: float | None) -> str:
    return ABSENT if share is None else f"{share:.1%}"


def callback_table(name: str, statistics: pl.DataFrame) -> str:
    """Every callback of the recording, and how long it ran and took."""
    parts = [part for part in ("execution", "response") if statistics[f"{part}_ns"].count()]
    rows = []
    for row in statistics.iter_rows(named=True):
        period = row["period_ns"]
        trigger = row["topic"] if period is None else f"every {format_duration(period)}"
        what = f"{row['kind']} {trigger or ''}".rstrip()
        times = []
        for part in parts:
            found = row[f"{part}_ns"] or {"min": None, "mean": None, "max": None}
            times += [_ms(found["min"]), _ms(found["mean"]), _ms(found["max"])]
        threads = ", ".join(map(str, row["tids"]))
        symbol = short_symbol(row["symbol"])
        cells = [row["node"] or ABSENT, what, symbol, threads, str(row["count"]), *times]
        rows.append(cells)
    head = ["node [ms]", "callback", "function", "thread", "count"]
    for part in parts:
        head += [f"{part}: min", "mean", "max"]
    content = table(head, rows, words=[1, 2])
    return details(f"Callbacks of {name} ({len(rows)})", content, unfolded=len(rows) <= LISTED)


def server_table(plan: Plan) -> str:
    """The plan's servers: where, when and whom they let run."""
    rows = [
        [
            server.name,
            str(server.core),
            str(server.priority),
            " ".join(f"[{_ms(start)}, {_ms(end)})" for start, end in server.slots),
            ", ".join(
                thread.node + (" (publisher)" if thread.role == "publisher" else "")
                for thread in server.threads
            ),
        ]
        for server in plan.servers
    ]
    return table(["server", "core", "priority", "slots [ms]", "threads"], rows, words=[3, 4])
