"""The report's figures in rows: all of them the library's own, with sample counts beside them."""

from collections.abc import Sequence

import polars as pl

from chainshaper.analysis import REASONS, LatencyStatistics, callback_statistics
from chainshaper.planning import Plan
from chainshaper.reporting.application_graph import short_symbol
from chainshaper.reporting.breakdown import PARTS, hop_breakdown
from chainshaper.reporting.cells import (
    ABSENT,
    FIGURES,
    count,
    min_mean_max,
    ms,
    percent,
    slot_ms,
    slots_ms,
    thread_nodes,
    trigger,
)
from chainshaper.reporting.html.markup import Group, Row, details, paragraph, table
from chainshaper.reporting.html.told import Told
from chainshaper.reporting.machine import stall_rows
from chainshaper.reporting.predictions import band_name, late_text, range_ms, verdict
from chainshaper.values.durations import format_duration
from chainshaper.verify.measure import Measurement
from chainshaper.verify.overruns import overruns_text
from chainshaper.verify.predictions import FigureHeld

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

LISTED = 50
"""Rows of a list that may be endless."""


def headline(recordings: Sequence[Told]) -> str:
    """One line per recording: what a reader remembers."""
    lines = []
    for told in recordings:
        found, every = told.measurement.analysis.undisturbed, told.measurement.analysis.statistics
        times = map(ms, (found.jitter_ns, found.mean_ns, found.max_ns))
        whole = ms(every.max_ns), count(every.late)
        lines.append([told.name, *times, f"{found.count:,}", *whole])
    head = ["at publication [ms]", "jitter", "average", "maximum", "cycles"]
    content = table([*head, "maximum of all", "late of all"], lines)
    spells = [(told.name, told.measurement.left_out.text) for told in recordings]
    return content + "".join(paragraph(f"{name}: {text}.") for name, text in spells if text)


def comparison_table(recordings: Sequence[Told]) -> str:
    """Before and after, or one recording alone."""
    measurements = [told.measurement for told in recordings]
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
        ["came when it was open", *map(_into_open_slots, measurements)],
        ["messages lost at the gate", *map(_dropped, measurements)],
        ["begun without publishing", *(str(a.silent) for a in analyses)],
        ["longest stall of the machine [ms]", *(ms(m.longest_stall_ns) for m in measurements)],
    ]
    return table(["", *(told.name for told in recordings)], rows)


def _statistics(columns: Sequence[LatencyStatistics | None]) -> list[Row]:
    rows: list[Row] = [
        [title, *(ABSENT if one is None else ms(getattr(one, field)) for one in columns)]
        for title, field in FIGURES
    ]
    for title, key in (("median", "50"), ("99th percentile", "99")):
        values = [None if one is None else one.percentiles_ns.get(key) for one in columns]
        rows.append([title, *map(ms, values)])
    rows.append(["cycles", *(ABSENT if one is None else str(one.count) for one in columns)])
    rows.append(["came late", *(ABSENT if one is None else count(one.late) for one in columns)])
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


def _dropped(measurement: Measurement) -> str:
    if measurement.dropped is None:
        return "not gated"
    total = sum(measurement.dropped.values())
    why = ", ".join(f"{count} {reason}" for reason, count in measurement.dropped.items())
    return f"{total} ({why})" if why else str(total)


def _into_open_slots(measurement: Measurement) -> str:
    count = measurement.into_open_slots
    return "not gated" if count is None else str(count)


def prediction_tables(recordings: Sequence[Told]) -> str:
    """Predicted beside measured, where a plan was in force."""
    parts = []
    for told in recordings:
        held = told.measurement.held
        if held is None:
            continue
        rows: list[Row] = [
            _held("average", held.mean),
            _held("maximum", held.max),
            _held("jitter (max − min)", held.jitter),
        ]
        rows += [
            [
                f"{band_name(band, number)}: {band.count} cycles, {band.inside} inside its slot",
                slot_ms(band.slot_start_ns, band.slot_end_ns),
                ms(band.mean_ns),
                f"jitter {ms(band.jitter_ns)}",
            ]
            for number, band in enumerate(held.bands, start=1)
        ]
        about = (
            f"The plan's prediction and {told.name}, undisturbed cycles [ms]. Predicted: outputs"
            " at the start … the end of their slots."
        )
        if held.counted_from == "cycle":
            about += " Times count from the start of the cycle."
        if held.late_of_all is not None:
            said = late_text(held)
            about += f" {said[0].upper()}{said[1:]}."
        head = ["", "predicted", "measured", "verdict"]
        parts += [paragraph(about), table(head, rows)]
    return "\n".join(parts)


def _held(title: str, figure: FigureHeld) -> list[str]:
    return [title, range_ms(figure), ms(figure.measured_ns), verdict(figure)]


def incomplete_table(recordings: Sequence[Told]) -> str:
    """Why cycles have no latency, with the first cycles' numbers."""
    rows = []
    for told in recordings:
        broken = told.measurement.analysis.traversals.filter(pl.col("reason").is_not_null())
        grouped = broken.group_by("reason", "broken_at", maintain_order=True).agg("traversal")
        for reason, topic, numbers in grouped.iter_rows():
            first = ", ".join(map(str, numbers[:5])) + (", …" if len(numbers) > 5 else "")
            what = f"{reason}: {REASONS[reason]}"
            rows.append([told.name, what, topic or ABSENT, str(len(numbers)), first])
    if not rows:
        return paragraph("Every cycle that began is complete.")
    return table(["", "reason", "at", "cycles", "numbers"], rows, words=[1, 2])


def overrun_table(told: Told) -> str:
    """Outputs that came behind their slot, one by one."""
    name, measurement = told.name, told.measurement
    if measurement.overruns is None:
        return paragraph(f"{name}: nothing was gated, so nothing could overrun.")
    if not measurement.overruns:
        return paragraph(f"{name}: no output was too late for its slot.")
    about = paragraph(f"{name}: {overruns_text(measurement.overruns)}.")
    origin = told.timeline.holds.filter(pl.col("overrun").is_not_null())
    latencies = measurement.analysis.traversals.select("traversal", "latency_ns")
    late = origin.join(latencies, on="traversal", how="left", maintain_order="left")
    if not late.height:
        return about
    rows = [
        [str(cycle), ms(arrival - origin), done, ms(latency)]
        for cycle, arrival, origin, done, latency in late.head(LISTED)
        .select("traversal", "arrival", "origin", "overrun", "latency_ns")
        .iter_rows()
    ]
    head = ["cycle", "arrived, from its anchor [ms]", "what was done", "latency [ms]"]
    return about + _some(table(head, rows, words=[2]), late.height)


def _some(content: str, total: int) -> str:
    rest = f"The first {LISTED} of {total} are listed." if total > LISTED else ""
    return content + paragraph(rest)


def stall_tables(told: Told) -> str:
    """Stalls per core, and the longest."""
    name, measurement = told.name, told.measurement
    meter = measurement.recording.info.stall_meter
    if meter is None:
        return paragraph(f"{name}: nobody watched the machine, so its stalls are not known.")
    stalls = told.timeline.stalls.select(cpu="core", duration=pl.col("end") - pl.col("start"))
    rows = [
        [
            f"core {row['core']}",
            str(row["count"]),
            ms(row["total_ns"]),
            ms(row["longest_ns"] or None),
            f"{row['median_wakeup_ns'] / 1e3:.0f}",
        ]
        for row in stall_rows(meter, stalls)
    ]
    about = (
        f"{name}: stalls of the machine from {format_duration(meter.threshold_ns)} in "
        f"{meter.wakeups:,} wake-ups of a sleeper at the highest priority; they disturbed "
        f"{measurement.analysis.statistics.disturbed} of "
        f"{measurement.analysis.statistics.count} cycles."
    )
    head = ["", "stalls", "in all [ms]", "longest [ms]", "usual wake-up [µs]"]
    return paragraph(about) + table(head, rows)


def breakdown_table(told: Told) -> str:
    """Communication and computation, hop by hop."""
    frame = hop_breakdown(told.measurement.analysis)
    rows: list[Row] = []
    for row in frame.iter_rows(named=True):
        cells = [f"{row['callback']} → {row['topic']}", str(row["count"])]
        for part in PARTS:
            cells += [*min_mean_max(row[f"{part}_ns"]), percent(row[f"{part}_share"])]
        rows.append(cells)
    sums = []
    for part in PARTS:
        shares = frame[f"{part}_share"].drop_nulls()
        sums += ["", "", "", percent(float(shares.sum()) if len(shares) else None)]
    rows.append(["in all", str(told.measurement.analysis.statistics.count), *sums])
    head = ["hop [ms]", "cycles"]
    for part in PARTS:
        head += [f"{part}: min", "mean", "max", "share"]
    return paragraph(f"{told.name}, all complete cycles:") + table(head, rows)


def callback_table(told: Told) -> str:
    """Every callback of the recording, and how long it ran and took."""
    statistics = callback_statistics(told.flow)
    parts = [part for part in ("execution", "response") if statistics[f"{part}_ns"].count()]
    rows = []
    for row in statistics.iter_rows(named=True):
        times = []
        for part in parts:
            times += min_mean_max(row[f"{part}_ns"])
        threads = ", ".join(map(str, row["tids"]))
        symbol = short_symbol(row["symbol"])
        rows.append(
            [row["node"] or ABSENT, trigger(row), symbol, threads, str(row["count"]), *times]
        )
    head = ["node [ms]", "callback", "function", "thread", "count"]
    for part in parts:
        head += [f"{part}: min", "mean", "max"]
    content = table(head, rows, words=[1, 2])
    return details(f"Callbacks of {told.name} ({len(rows)})", content, unfolded=len(rows) <= LISTED)


def server_table(plan: Plan) -> str:
    """The plan's servers: where, when and whom they let run."""
    rows = [
        [
            server.name,
            str(server.core),
            str(server.priority),
            slots_ms(server.slots),
            thread_nodes(server),
        ]
        for server in plan.servers
    ]
    return table(["server", "core", "priority", "slots [ms]", "threads"], rows, words=[3, 4])
