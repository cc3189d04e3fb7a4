"""A chain's latency, as tables and as plain data: its figures, recordings beside each other, a
prediction beside its measurement, where the time goes, and what has no latency."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import polars as pl

from chainshaper.analysis import REASONS, LatencyAnalysis, LatencyStatistics
from chainshaper.planning import publish_slots
from chainshaper.reporting.tables import (
    ABSENT,
    YES_NO,
    Column,
    ResultTable,
    count,
    counts,
    figures,
    min_mean_max,
    ms,
    percent,
    slots_ms,
    words,
)
from chainshaper.values.durations import milliseconds
from chainshaper.verify.measure import PARTS, Comparison, Measurement, hop_breakdown, part_shares
from chainshaper.verify.predictions import BandHeld, FigureHeld, PredictionHeld

__all__ = [
    "breakdown_json",
    "breakdown_table",
    "comparison_json",
    "comparison_table",
    "headline_table",
    "incomplete_table",
    "late_text",
    "latency_json",
    "latency_table",
    "prediction_json",
    "prediction_table",
]

FIGURES = (
    ("average", "mean_ns"),
    ("minimum", "min_ns"),
    ("maximum", "max_ns"),
    ("jitter (max − min)", "jitter_ns"),
    ("spread p0.5–p99.5", "spread_ns"),
)
"""What tables say of latencies, and the fields of their statistics."""

ALL = frozenset(title for title, _ in FIGURES)
LATE = frozenset(("came late", "maximum", "jitter (max − min)"))

CONVENTION = (
    "at_start: every output leaves as its slot starts, as a gate does it; at_end: at its slot's"
    " end, eq. 5's convention; from, to: with room for what two samples may differ by, the bounds"
    " of `holds`"
)


def latency_json(measurement: Measurement, *, instances: bool = False) -> dict[str, Any]:
    """One chain's latency as plain data; ``instances`` adds every complete traversal.

    Without ``stalls_watched`` stalls of the machine are not known, so ``disturbed`` is 0 whatever
    it did. ``late``, ``max_all_ns`` and ``jitter_all_ns`` leave no cycle out. Instances have their
    start and end in ns of the trace clock (wall clock).
    """
    analysis, info = measurement.analysis, measurement.recording.info
    subscriber = {
        name: None if found is None else asdict(found)
        for name, found in (
            ("subscriber", analysis.subscriber),
            ("subscriber_undisturbed", analysis.subscriber_undisturbed),
        )
    }
    result = {
        "chain": analysis.chain.spec,
        **asdict(analysis.statistics),
        "max_all_ns": analysis.statistics.max_ns,
        "jitter_all_ns": analysis.statistics.jitter_ns,
        "undisturbed": asdict(analysis.undisturbed),
        **subscriber,
        "incomplete_by_reason": analysis.incomplete,
        "silent": analysis.silent,
        "overruns": None if measurement.overruns is None else sum(measurement.overruns.values()),
        "overruns_by_policy": measurement.overruns,
        "into_open_slots": measurement.into_open_slots,
        "dropped": None if measurement.dropped is None else sum(measurement.dropped.values()),
        "dropped_by_reason": measurement.dropped,
        "stalls_watched": measurement.longest_stall_ns is not None,
        "longest_stall_ns": measurement.longest_stall_ns,
        "in_force": None if info.in_force is None else info.in_force.model_dump(),
        "left_out": asdict(measurement.left_out),
        "realtime": info.realtime,
        "lost": info.lost,
        "notes": list(analysis.notes),
    }
    if instances:
        complete = analysis.traversals.filter("complete")
        result["instances"] = complete.select(
            (pl.col("start") + info.clock_offset_ns).alias("start_ns"),
            (pl.col("end") + info.clock_offset_ns).alias("end_ns"),
            "latency_ns",
            "disturbed",
        ).to_dicts()
    return result


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


def latency_table(measurement: Measurement) -> ResultTable:
    """End-to-end latency: at publication and at the subscriber, all cycles and undisturbed ones.

    Where the machine was not watched, no cycle is called undisturbed.
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
    table = ResultTable(title, [*words(""), *figures(*(name for name, _ in columns))])
    for title, field in FIGURES:
        table.add(title, *(_figure(statistics, field) for _, statistics in columns))
    table.add("cycles", *(ABSENT if s is None else str(s.count) for _, s in columns))
    table.add("came late", *(ABSENT if s is None else count(s.late) for _, s in columns))
    table.caption = measurement.left_out.text
    return table


def _figure(statistics: LatencyStatistics | None, field: str) -> str:
    return ms(None if statistics is None else getattr(statistics, field))


def comparison_table(comparison: Comparison, names: Sequence[str] = ()) -> ResultTable:
    """The same figures of every recording beside each other, usually before and after shaping.

    ``names`` tell the recordings apart; their folders' names do otherwise.
    """
    measurements = comparison.measurements
    analyses = [measurement.analysis for measurement in measurements]
    names = names or [measurement.recording.path.name for measurement in measurements]
    title = f"End-to-end latency of {comparison.chain} [ms]"
    table = ResultTable(title, [*words(""), *figures(*names)], _comparison_caption(comparison))
    # Where the machine was not watched, no cycle is called undisturbed.
    watched = any(measurement.longest_stall_ns is not None for measurement in measurements)
    places = (
        ("publication", "undisturbed", "statistics", LATE),
        ("the subscriber's callback", "subscriber_undisturbed", "subscriber", frozenset[str]()),
    )
    for place, calm, every, brief in places:
        if watched:
            table.group(f"at {place}, undisturbed cycles [ms]")
            _add_statistics(table, [getattr(one, calm) for one in analyses], ALL)
        shown = brief if watched else ALL | LATE
        table.group(f"at {place}, all complete cycles [ms]", detail=not shown)
        _add_statistics(table, [getattr(one, every) for one in analyses], shown)
    _add_counts(table, measurements)
    return table


def _add_statistics(
    table: ResultTable, columns: Sequence[LatencyStatistics | None], brief: frozenset[str]
) -> None:
    """Rows of one place; those that are not ``brief`` are details."""
    rows = {title: [_figure(one, field) for one in columns] for title, field in FIGURES}
    for title, key in (("median", "50"), ("99th percentile", "99")):
        rows[title] = [
            ABSENT if one is None else ms(one.percentiles_ns.get(key)) for one in columns
        ]
    rows["cycles"] = [ABSENT if one is None else str(one.count) for one in columns]
    rows["came late"] = [
        ABSENT if one is None or one.late is None else f"{one.late} of {one.count}"
        for one in columns
    ]
    for title, cells in rows.items():
        table.add(title, *cells, detail=title not in brief)


def _add_counts(table: ResultTable, measurements: Sequence[Measurement]) -> None:
    statistics = [(m, m.analysis.statistics) for m in measurements]
    rows = {
        "complete": [str(s.count) for _, s in statistics],
        "disturbed by the machine": [
            "not watched" if m.longest_stall_ns is None else str(s.disturbed) for m, s in statistics
        ],
        "incomplete": [counts(m.analysis.incomplete) for m in measurements],
        "too late for their slot": [counts(m.overruns, "not gated") for m in measurements],
        "came when it was open": [count(m.into_open_slots, "not gated") for m in measurements],
        "messages lost at the gate": [counts(m.dropped, "not gated") for m in measurements],
        "begun without publishing": [str(m.analysis.silent) for m in measurements],
        "longest stall of the machine [ms]": [ms(m.longest_stall_ns) for m in measurements],
        "lost while recording": [str(sum(m.recording.info.lost.values())) for m in measurements],
        "real-time scheduling": [
            YES_NO.get(m.recording.info.realtime, ABSENT) for m in measurements
        ],
    }
    table.group("cycles")
    for title, cells in rows.items():
        table.add(title, *cells, detail=title == "begun without publishing")


def _comparison_caption(comparison: Comparison) -> str | None:
    lines = [
        f"{measurement.recording.path.name}: {measurement.left_out.text}"
        for measurement in comparison.measurements
        if measurement.left_out.text is not None
    ]
    planned = [m.plan for m in comparison.measurements if m.plan is not None]
    if planned:
        predicted = planned[-1].predicted
        lines.append(
            f"planned: slots {slots_ms(*publish_slots(planned[-1]))}, "
            f"predicted maximum {milliseconds(predicted.max_ns)}, "
            f"jitter at most {milliseconds(predicted.jitter_ns)}"
        )
    return "\n".join(lines) or None


def headline_table(names: Sequence[str], measurements: Sequence[Measurement]) -> ResultTable:
    """One row per recording: what a reader remembers."""
    titles = ("jitter", "average", "maximum", "cycles", "maximum of all", "late of all")
    table = ResultTable("", [*words("at publication [ms]"), *figures(*titles)])
    for name, measurement in zip(names, measurements, strict=True):
        calm, every = measurement.analysis.undisturbed, measurement.analysis.statistics
        times = map(ms, (calm.jitter_ns, calm.mean_ns, calm.max_ns))
        table.add(name, *times, f"{calm.count:,}", ms(every.max_ns), count(every.late))
    return table


def prediction_table(held: PredictionHeld) -> ResultTable:
    """Predicted beside measured: the whole, then band by band."""
    whence = ", from the start of the cycle" if held.counted_from == "cycle" else ""
    table = ResultTable(
        f"Prediction and measurement{whence} [ms]",
        [
            *words(""),
            *figures("predicted", "measured"),
            *words("verdict"),
            *figures("jitter", "share predicted", "measured"),
        ],
    )
    for title, figure in (
        ("average", held.mean),
        ("maximum", held.max),
        ("jitter (max − min)", held.jitter),
    ):
        verdict = {True: "as predicted", False: "differs", None: ABSENT}[figure.holds]
        table.add(title, range_ms(figure), ms(figure.measured_ns), verdict, "", "", "")
    table.line()
    for number, band in enumerate(held.bands, start=1):
        table.add(
            band_name(band, number),
            slots_ms((band.slot_start_ns, band.slot_end_ns)),
            ms(band.mean_ns),
            f"{band.inside} of {band.count} inside" if band.count else "no cycles",
            ms(band.jitter_ns),
            percent(band.predicted_share),
            percent(band.share),
        )
    of_mode = "; shares of a mode: its outputs that were in time for its slot"
    late = of_mode if any(band.mode for band in held.bands) else ""
    late += "" if held.late_of_all is None else f"; {late_text(held)}"
    table.caption = (
        "undisturbed cycles; predicted: outputs at the start … the end of their slots (a gate"
        " publishes at the start, eq. 5 counts the end), averages with three standard errors, no"
        f" band that may well be empty{late}"
    )
    return table


def late_text(held: PredictionHeld) -> str:
    """How many outputs came late, no cycle left out."""
    disturbed = (held.late_of_all or 0) - held.late
    among = f", {disturbed} of them in disturbed cycles" if disturbed else ""
    return f"of all {held.cycles} outputs {held.late_of_all} came late{among}"


def prediction_json(held: PredictionHeld) -> dict[str, Any]:
    """The same as plain data, integers in nanoseconds."""
    return {
        "convention": CONVENTION,
        "mean_ns": _figure_json(held.mean),
        "max_ns": _figure_json(held.max),
        "jitter_ns": _figure_json(held.jitter),
        "bands": [vars(band) for band in held.bands],
        "late": held.late,
        "late_of_all": held.late_of_all,
        "counted_from": held.counted_from,
    }


def _figure_json(figure: FigureHeld) -> dict[str, Any]:
    return {name.removesuffix("_ns"): value for name, value in vars(figure).items()}


def band_name(band: BandHeld, number: int) -> str:
    """``band 2``, or whose it is: ``city, 3 late``."""
    if band.mode is None:
        return f"band {number}"
    return f"{band.mode}, {band.late} late" if band.late else band.mode


def range_ms(figure: FigureHeld) -> str:
    """What a figure was predicted to lie in: the verdict's own bounds."""
    if figure.from_ns == figure.to_ns:
        return milliseconds(figure.to_ns)
    return f"{milliseconds(figure.from_ns)} … {milliseconds(figure.to_ns)}"


def breakdown_json(analysis: LatencyAnalysis) -> dict[str, Any]:
    """The breakdown as plain data: ``hops``, and the two parts' shares of the mean latency."""
    frame = hop_breakdown(analysis)
    shares = {f"{part}_share": share for part, share in part_shares(frame).items()}
    return {"hops": frame.to_dicts(), **shares}


def breakdown_table(analysis: LatencyAnalysis) -> ResultTable:
    """Every hop's communication and computation, and their shares of the mean latency."""
    frame = hop_breakdown(analysis)
    cycles = Column("cycles", footer=str(analysis.statistics.count), detail=True)
    columns = [Column("hop", words=True, footer="together"), cycles]
    for part, share in part_shares(frame).items():
        columns += [
            Column(f"{part}\nmin", detail=True),
            *figures(f"{part}\nmean", "max"),
            Column("share", footer=percent(share)),
        ]
    table = ResultTable("Where it goes, hop by hop [ms]", columns)
    for row in frame.iter_rows(named=True):
        cells = [f"{row['callback']} → {row['topic']}", str(row["count"])]
        for part in PARTS:
            cells += [*min_mean_max(row[f"{part}_ns"]), percent(row[f"{part}_share"])]
        table.add(*cells)
    return table


def incomplete_table(names: Sequence[str], measurements: Sequence[Measurement]) -> ResultTable:
    """Why cycles have no latency, with the first cycles' numbers; no row where all have one."""
    table = ResultTable("", [*words("", "reason", "at"), *figures("cycles", "numbers")])
    for name, measurement in zip(names, measurements, strict=True):
        broken = measurement.analysis.traversals.filter(pl.col("reason").is_not_null())
        grouped = broken.group_by("reason", "broken_at", maintain_order=True).agg("traversal")
        for reason, topic, numbers in grouped.iter_rows():
            first = ", ".join(map(str, numbers[:5])) + (", …" if len(numbers) > 5 else "")
            what = f"{reason}: {REASONS[reason]}"
            table.add(name, what, topic or ABSENT, str(len(numbers)), first)
    return table
