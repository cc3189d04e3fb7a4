"""A chain's latency, as tables and as plain data.

They show its figures, several recordings beside each other, a prediction beside its measurement,
where the time goes, and cycles that have no latency.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.analysis import (
    REASONS,
    LatencyAnalysis,
    LatencyStatistics,
    latency_statistics,
)
from chainshaper.analysis.data_age import DataAge
from chainshaper.analysis.host_clocks import BoundedStatistics
from chainshaper.planning import ChainPlan, publish_slots
from chainshaper.planning.overruns import expected
from chainshaper.reporting.live_control import live_cost_json, live_costs
from chainshaper.reporting.tables import (
    ABSENT,
    YES_NO,
    Column,
    ResultTable,
    counted,
    counts,
    figures,
    interval_ms,
    min_mean_max,
    ms,
    percent,
    slots_ms,
    words,
)
from chainshaper.values.durations import duration_text, milliseconds
from chainshaper.values.files import write_whole
from chainshaper.values.hosts import Interval
from chainshaper.verify.measure import PARTS, Comparison, Measurement, hop_breakdown, part_shares
from chainshaper.verify.overruns import (
    dropped_text,
    moves_in,
    moves_text,
    next_cycles,
    overruns_text,
)
from chainshaper.verify.predictions import JudgedFigure, JudgedPrediction, jitter_within_band
from chainshaper.verify.promises import outputs_due

LATE = ("came late", "maximum", "jitter (max − min)")
"""The rows of all cycles that disturbed cycles change."""

BETWEEN_HOSTS_NS = 1_000
"""A communication that is known no better than this is shown as an interval."""

JSON_FORMAT = 1
"""Version of the JSON that `latency`, `compare` and `check` print.

It changes when a key changes its meaning.
"""

CONVENTION = (
    "at_start: every output leaves as its slot starts, as a gate does it; at_end: at its slot's"
    " end, eq. 5's convention; from, to: with room for what two samples may differ by, the bounds"
    " of `holds`"
)


def _rows(columns: Sequence[LatencyStatistics | None]) -> dict[str, list[str]]:
    """Make the rows of figures by their titles, with a cell for each column's statistics."""
    cells: dict[str, Callable[[LatencyStatistics], str]] = {
        "average": lambda statistics: figure_ms(statistics, "mean_ns"),
        "minimum": lambda statistics: figure_ms(statistics, "min_ns"),
        "maximum": lambda statistics: figure_ms(statistics, "max_ns"),
        "jitter (max − min)": lambda statistics: figure_ms(statistics, "jitter_ns"),
        "spread p0.5–p99.5": lambda statistics: figure_ms(statistics, "spread_ns"),
        "median": lambda statistics: figure_ms(statistics, "50"),
        "99th percentile": lambda statistics: figure_ms(statistics, "99"),
        "cycles": lambda statistics: str(statistics.count),
        "came late": lambda statistics: (
            ABSENT if statistics.late is None else f"{statistics.late} of {statistics.count}"
        ),
    }
    return {
        title: [ABSENT if column is None else cell(column) for column in columns]
        for title, cell in cells.items()
    }


def figure_ms(statistics: LatencyStatistics, name: str) -> str:
    """A figure, or a percentile, in ms: between hosts as an interval, ``53.100 ± 0.200``."""
    if isinstance(statistics, BoundedStatistics):
        return interval_ms({**statistics.bounds_ns, **statistics.percentile_bounds_ns}[name])
    return ms({**asdict(statistics), **statistics.percentiles_ns}.get(name))


def latency_json(measurement: Measurement, *, instances: bool = False) -> dict[str, Any]:
    """A chain's latency as plain data; ``instances`` adds every complete traversal, and every cycle
    of a loop that it goes through.

    If ``stalls_watched`` is false, stalls of the machine are not known, and ``disturbed`` is 0.
    ``late``, ``max_all_ns`` and ``jitter_all_ns`` are over all cycles. Instances have their start
    and end in ns of the wall clock.
    """
    analysis, info = measurement.analysis, measurement.recording.info
    overruns, dropped = measurement.overruns, measurement.dropped
    calm, received = analysis.subscriber_undisturbed, analysis.subscriber
    result = {
        "format": JSON_FORMAT,
        "chain": analysis.chain.spec,
        **asdict(analysis.statistics),
        "max_all_ns": analysis.statistics.max_ns,
        "jitter_all_ns": analysis.statistics.jitter_ns,
        "undisturbed": asdict(analysis.undisturbed),
        "subscriber": None if received is None else asdict(received),
        "subscriber_undisturbed": None if calm is None else asdict(calm),
        "incomplete_by_reason": analysis.incomplete,
        "silent": analysis.silent,
        "data_age": data_age_json(analysis.data_age),
        "promise": promise_json(measurement),
        "overruns": None if overruns is None else sum(overruns.values()),
        "overruns_by_policy": overruns,
        "overrun_outcomes": {
            name: asdict(outcome) for name, outcome in measurement.outcomes.items()
        },
        "into_open_slots": measurement.into_open_slots,
        "moves": moves_in(analysis),
        "dropped": None if dropped is None else sum(dropped.values()),
        "dropped_by_reason": dropped,
        "stalls_watched": measurement.longest_stall_ns is not None,
        "longest_stall_ns": measurement.longest_stall_ns,
        "in_force": None if info.in_force is None else info.in_force.model_dump(),
        "slot_ends": None if measurement.plan is None else measurement.plan.slot_ends,
        "left_out": asdict(measurement.left_out),
        "realtime": info.realtime,
        "lost": info.lost,
        "notes": list(analysis.notes),
    }
    if instances:
        times = [
            (pl.col(end) + info.clock_offset_ns).alias(f"{end}_ns") for end in ("start", "end")
        ]
        complete = analysis.traversals.filter("complete")
        columns = ["latency_ns", "disturbed"]
        columns += [name for name in ("latency_low_ns", "latency_high_ns") if name in complete]
        result["instances"] = complete.select(*times, *columns).to_dicts()
        if analysis.data_age is not None:
            times = [
                (pl.col(end) + info.clock_offset_ns).alias(f"{end}_ns")
                for end in ("start", "publish", "end")
            ]
            ages = ("age_at_loop_ns", "age_at_end_ns", "use", "ambiguous")
            result["loop_cycles"] = analysis.data_age.cycles.select(*times, *ages).to_dicts()
    return result


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """A comparison as plain data, one entry per recording."""
    entries = []
    costs = live_costs(comparison.measurements)
    for measurement, cost in zip(comparison.measurements, costs, strict=True):
        entry = {"recording": str(measurement.recording.path), **latency_json(measurement)}
        if cost is not None:
            entry["control"] = live_cost_json(cost)
        if measurement.plan is not None:
            entry["predicted"] = measurement.plan.predicted.model_dump(mode="json")
        if measurement.prediction is not None:
            entry["prediction"] = prediction_json(measurement.prediction)
        entries.append(entry)
    about = {"format": JSON_FORMAT, "chain": comparison.chain, "remark": comparison.remark}
    return {**about, "recordings": entries}


def write_comparison_json(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.json` into a folder. Raises OperationError: it cannot be written."""
    text = json.dumps(comparison_json(comparison), indent=2) + "\n"
    return write_whole(folder / "comparison.json", [text.encode()])


def comparisons_json(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """A comparison as plain data; several of them as an object with the key ``chains``."""
    several = [comparison_json(comparison) for comparison in comparisons]
    return several[0] if len(several) == 1 else {"format": JSON_FORMAT, "chains": several}


def latency_table(measurement: Measurement) -> ResultTable:
    """Make a table of end-to-end latency, at the publication and at the subscriber.

    There are columns of all cycles, and, if the machine was watched, of undisturbed ones.
    """
    analysis = measurement.analysis
    columns: dict[str, LatencyStatistics | None] = {
        "all cycles": analysis.statistics,
        "undisturbed": analysis.undisturbed,
        "at the subscriber": analysis.subscriber,
        "…undisturbed": analysis.subscriber_undisturbed,
    }
    if measurement.longest_stall_ns is None:
        columns = {
            "all cycles": analysis.statistics,
            "at the subscriber": analysis.subscriber,
        }
    title = f"End-to-end latency of {analysis.chain.spec} [ms]"
    table = ResultTable(title, [*words(""), *figures(*columns)], measurement.left_out.text)
    for name, cells in _rows([*columns.values()]).items():
        # Without a plan outputs are not due at any instant; late means longer than the period.
        title = "longer than the period" if name == LATE[0] and measurement.plan is None else name
        table.add(title, *cells, detail=title in ("median", "99th percentile"))
    return table


def promise_json(measurement: Measurement) -> dict[str, Any] | None:
    """Whether what a plan promised was kept, as plain data; None: no plan was in force."""
    if measurement.plan is None or measurement.prediction is None:
        return None
    met, text = verdict(measurement)
    age = measurement.age
    values = None if age is None else {**asdict(age), "kept": age.kept}
    return {"met": met, "text": text, "age": values}


def data_age_json(age: DataAge | None) -> dict[str, Any] | None:
    """What a loop of a chain worked with, as plain data: ages over its cycles, uses of messages."""
    if age is None:
        return None
    known = age.cycles.drop_nulls("traversal")
    at_end = known["age_at_end_ns"].drop_nulls()
    return {
        "loop": age.loop.label,
        "topic": age.topic,
        "cycles": age.cycles.height,
        "at_loop": asdict(latency_statistics(known["age_at_loop_ns"])),
        "at_end": asdict(latency_statistics(at_end, incomplete=known.height - at_end.len())),
        "messages": {**age.uses, "most_uses": age.most_uses},
        "ambiguous": age.ambiguous,
    }


def data_age_table(age: DataAge) -> ResultTable:
    """Make a table of the age of a loop's data, when it reads them and at the chain's end."""
    known = age.cycles.drop_nulls("traversal")
    columns = [known[name].drop_nulls() for name in ("age_at_loop_ns", "age_at_end_ns")]
    never, once, again = (age.uses[name] for name in ("never", "once", "again"))
    repeats = f", up to {age.most_uses} times" if again else ""
    below = (
        f"Messages used once: {once}; in several cycles: {again}{repeats}; never: {never}. That a"
        " cycle uses the newest message is inferred; no event shows it."
    )
    if age.ambiguous:
        below += (
            f" In {age.ambiguous} of {age.cycles.height} cycles a message was being stored between"
            " wake-up and output: whether they used it, or the one before, cannot be told."
        )
    title = f"Age of the data of {age.loop.label}, over all of its cycles [ms]"
    table = ResultTable(title, [*words(""), *figures("at the loop", "at the end")], below)
    for name, cells in _rows([latency_statistics(column) for column in columns]).items():
        if name != LATE[0]:
            table.add(name, *cells, detail=name in ("median", "99th percentile"))
    return table


def doubts_text(measurement: Measurement) -> str:
    """Text, in one line: how many cycles were disturbed, incomplete, late or dropped."""
    analysis = measurement.analysis
    parts = [f"{counted(analysis.statistics.disturbed, 'cycle')} disturbed by the machine"]
    if measurement.longest_stall_ns is None:
        parts = ["stalls of the machine not watched"]
    if analysis.incomplete:
        reasons = ", ".join(f"{number} {reason}" for reason, number in analysis.incomplete.items())
        parts.append(f"incomplete: {reasons}")
    if measurement.overruns:
        parts.append(overruns_text(measurement.overruns))
    if measurement.outcomes:
        parts.append(f"the next cycle was hit in {next_cycles(measurement.outcomes)}")
    if measurement.dropped:
        parts.append(dropped_text(measurement.dropped))
    return "; ".join(parts)


def comparison_table(comparison: Comparison, names: Sequence[str] = ()) -> ResultTable:
    """Make a table of several recordings beside each other, usually before and after shaping.

    ``names`` are those of the recordings; without them the names of their folders. On the terminal
    the table has the figures of undisturbed cycles, and of all cycles only the rows ``LATE``.
    """
    measurements = comparison.measurements
    analyses = [measurement.analysis for measurement in measurements]
    names = names or [measurement.recording.path.name for measurement in measurements]
    table = ResultTable(
        f"End-to-end latency of {comparison.chain} [ms]", [*words(""), *figures(*names)]
    )

    def add(title: str, columns: Sequence[LatencyStatistics | None], details: set[str]) -> None:
        rows = _rows(columns)
        table.group(title, detail=details == rows.keys())
        for name, cells in rows.items():
            table.add(name, *cells, detail=name in details)

    # Where the machine was not watched, no cycle is called undisturbed.
    watched = any(measurement.longest_stall_ns is not None for measurement in measurements)
    details_of_all, details_of_calm = {"median", "99th percentile", "cycles"}, {"came late"}
    titles = set(_rows([]))
    for place, undisturbed, field, brief in (
        ("publication", "undisturbed", "statistics", set(LATE)),
        ("the subscriber's callback", "subscriber_undisturbed", "subscriber", set[str]()),
    ):
        if watched:
            columns = [getattr(analysis, undisturbed) for analysis in analyses]
            left_out = [analysis.statistics.disturbed for analysis in analyses]
            without = f" (without {' / '.join(map(str, left_out))} disturbed)"
            without = without if any(left_out) else ""
            add(
                f"at {place}, undisturbed cycles{without} [ms]",
                columns,
                details_of_all | details_of_calm,
            )
        columns = [getattr(analysis, field) for analysis in analyses]
        add(
            f"at {place}, all complete cycles [ms]",
            columns,
            titles - brief if watched else details_of_all,
        )
    table.group("cycles")
    for title, cells in _counts(measurements).items():
        table.add(title, *cells, detail=title == "begun without publishing")
    remarks = [
        f"{measurement.recording.path.name}: {measurement.left_out.text}"
        for measurement in measurements
        if measurement.left_out.text
    ]
    if comparison.remark:
        remarks.append(comparison.remark)
    planned = [measurement.plan for measurement in measurements if measurement.plan is not None]
    if planned:
        remarks.append(
            f"planned: slots {slots_ms(*publish_slots(planned[-1]))};"
            f" {expected_jitter_text(planned[-1])}"
        )
    table.caption = "\n".join(remarks) or None
    return table


def expected_text(plan: ChainPlan) -> str:
    """Text: when a plan's outputs will leave, in ms."""
    seen, predicted = expected(plan), plan.predicted
    if seen is None:
        figures = map(milliseconds, (predicted.mean_ns, predicted.max_ns, predicted.jitter_ns))
        return "expected average {}, maximum {}, jitter {} at most".format(*figures)
    places = ", ".join(map(milliseconds, seen.leave_ns))
    average = f", average {milliseconds(seen.mean_ns)}" if len(seen.leave_ns) > 1 else ""
    if average and plan.evidence.interference_ns:  # by how far other chains delay it
        average += f" to {milliseconds(predicted.mean_ns)}"
    return f"outputs leave at {places}{average}"


def expected_jitter_text(plan: ChainPlan) -> str:
    """The text of :func:`expected_text`, with the jitter that is expected within each band."""
    seen, slots = expected(plan), publish_slots(plan)
    if seen is None:
        return expected_text(plan)
    if len(slots) == 1 or plan.modes is not None:
        return f"{expected_text(plan)}; expected jitter {milliseconds(seen.jitter_ns, 1)}"
    within = (jitter_within_band(plan, slot, last=slot == slots[-1]) for slot in slots)
    jitters = ", ".join(milliseconds(jitter_ns, 1) for jitter_ns in within)
    return f"{expected_text(plan)}; jitter within bands at most {jitters}"


def verdict(measurement: Measurement) -> tuple[bool | None, str]:
    """Judge whether a recording has what its plan promised (None: it cannot be judged); say why."""
    judged, name = measurement.prediction, measurement.recording.path.name
    if judged is None or measurement.plan is None:
        return None, f"{name}: no plan was in force, so nothing was promised"
    effect = stall_effect(measurement)
    aside = "" if effect is None else f"; {effect}"
    age = measurement.age
    broken = (*judged.broken, *(() if age is None else age.broken))
    if broken:
        return False, f"{name}: promise broken: {'; '.join(broken)}{aside}"
    if age is not None:
        aside = f"; {age.text}{aside}"
    elif measurement.plan.loop is not None:
        loop = f"the loop of {measurement.plan.loop.node}"
        aside = f"; how old the data of {loop} are is not known: it is not in the recording{aside}"
    if judged.mean.measured_ns is None:
        return None, f"{name}: no undisturbed cycle to judge the promise by{aside}"
    met = f"{name}: promise met: {judged.jitter_text}; {judged.outputs.text}"
    if (received := judged.receivers) is not None:
        met += f"; received with jitter {ms(received.jitter_ns)} ms, at most"
        met += f" {milliseconds(received.predicted_jitter_ns)} ms"
    return True, f"{met} ({expected_text(measurement.plan)}){aside}"


def stall_effect(measurement: Measurement) -> str | None:
    """Text: a chain's figures at publication with, and without, the cycles that stalls disturbed.

    None: no stall was seen.
    """
    all_cycles, calm = measurement.analysis.statistics, measurement.analysis.undisturbed
    if not measurement.longest_stall_ns:
        return None
    longest = duration_text(round(measurement.longest_stall_ns, -5) or measurement.longest_stall_ns)
    stalls = f"stalls of the machine, {longest} at most, disturbed"
    if not all_cycles.disturbed:
        return f"{stalls} no cycle"
    kinds = (("with these", all_cycles), ("without them", calm))
    bands = 1 if measurement.plan is None else len(publish_slots(measurement.plan))
    figures = "; ".join(f"{kind} {_brief(statistics, bands)}" for kind, statistics in kinds)
    return f"{stalls} {all_cycles.disturbed} of {all_cycles.count} cycles: {figures}"


def _brief(statistics: LatencyStatistics, bands: int) -> str:
    """Jitter, spread and late outputs in a few words.

    If there are several bands, the longest latency: the distance between bands is no jitter.
    """
    late = "" if statistics.late is None else f", {statistics.late} late"
    if bands > 1:
        return f"longest {figure_ms(statistics, 'max_ns')} ms{late}"
    jitter, spread = (figure_ms(statistics, f"{name}_ns") for name in ("jitter", "spread"))
    return f"jitter {jitter} ms, spread {spread} ms{late}"


def _counts(measurements: Sequence[Measurement]) -> dict[str, list[str]]:
    """Make the rows of how many cycles were complete, disturbed, late…, a cell a measurement."""
    columns = []
    for measurement in measurements:
        statistics, info = measurement.analysis.statistics, measurement.recording.info
        watched, open_slots = measurement.longest_stall_ns is not None, measurement.into_open_slots
        columns.append(
            {
                "complete": str(statistics.count),
                "disturbed by the machine": str(statistics.disturbed) if watched else "not watched",
                "incomplete": counts(measurement.analysis.incomplete),
                "too late for their slot": counts(measurement.overruns, "not gated"),
                "next cycle hit": next_cycles(measurement.outcomes)
                if measurement.outcomes
                else ABSENT,
                "arrived during their slot": "not gated" if open_slots is None else str(open_slots),
                "messages lost at the gate": counts(measurement.dropped, "not gated"),
                "begun without publishing": str(measurement.analysis.silent),
                "longest stall of the machine [ms]": ms(measurement.longest_stall_ns),
                "lost while recording": str(sum(info.lost.values())),
                "real-time scheduling": YES_NO.get(info.realtime, ABSENT),
            }
        )
    rows = {title: [column[title] for column in columns] for title in columns[0]}
    moves = [moves_in(measurement.analysis) for measurement in measurements]
    if any(moves):
        rows["slots followed latencies"] = [
            moves_text(moves_of_recording) if moves_of_recording else ABSENT
            for moves_of_recording in moves
        ]
    return rows


def headline(names: Sequence[str], measurements: Sequence[Measurement]) -> str:
    """The sentence that a reader remembers: jitter and average before and after.

    At publication, of undisturbed cycles. With whether they are as the plan predicted, and what
    stalls did to the last recording.
    """
    calm = [measurement.analysis.undisturbed for measurement in measurements]
    ends = [0, -1] if len(calm) > 1 else [0]
    jitter, average = (
        " → ".join(f"{figure_ms(calm[n], field)} ms ({names[n]})" for n in ends)
        for field in ("jitter_ns", "mean_ns")
    )
    text, judged = f"Jitter {jitter}; average {average}", measurements[-1].prediction
    effect = stall_effect(measurements[-1])
    aside = f" {effect[0].upper()}{effect[1:]}." if effect is not None else ""
    if judged is None:
        return f"{text}.{aside}"
    age = measurements[-1].age
    broken = (*judged.broken, *(() if age is None else age.broken))
    aside = f" {age.text[0].upper()}{age.text[1:]}.{aside}" if age is not None else aside
    if broken:
        return f"{text}; differs from the prediction: {'; '.join(broken)}.{aside}"
    holds = {figure.holds for figure in (judged.mean, judged.max, judged.jitter)}
    verdict = "not judged" if holds == {None} else "as predicted"
    return f"{text}; {verdict}, {judged.outputs.text}.{aside}"


def overview_table(comparisons: Sequence[Comparison], names: Sequence[str] = ()) -> ResultTable:
    """Make a table of an application's chains: each recording's figures of undisturbed cycles."""
    names = names or [
        measurement.recording.path.name for measurement in comparisons[0].measurements
    ]
    fields = {"jitter": "jitter_ns", "average": "mean_ns", "maximum": "max_ns"}
    titles = [f"{title}\n{name}" for title in (*fields, "missed of all") for name in names]
    table = ResultTable("At publication [ms]", [*words("chain"), *figures(*titles)])
    for chain in comparisons:
        analyses = [measurement.analysis for measurement in chain.measurements]
        times = (
            getattr(analysis.undisturbed, field)
            for field in fields.values()
            for analysis in analyses
        )
        outputs = (
            outputs_due(measurement.analysis, measurement.plan)
            for measurement in chain.measurements
        )
        missed = (ABSENT if due.late is None and not due.missed else due.missed for due in outputs)
        table.add(chain.chain, *map(ms, times), *missed)
    return table


def prediction_table(judged: JudgedPrediction, name: str = "") -> ResultTable:
    """Make a table of predicted beside measured figures: of all cycles, then of each band."""
    whence = ", from the start of the cycle" if judged.counted_from == "cycle" else ""
    columns = [*words(""), *figures("predicted", "measured"), *words("verdict")]
    columns += figures("jitter", "share predicted", "measured")
    title = f"Prediction and measurement{f' of {name}' if name else ''}{whence} [ms]"
    table = ResultTable(title, columns)
    for title, figure in (
        ("average", judged.mean),
        ("maximum", judged.max),
        ("jitter (max − min)", judged.jitter),
    ):
        differs = "worse" if figure.worse else "better"
        verdict = {True: "as predicted", False: differs, None: ABSENT}[figure.holds]
        table.add(title, figure.range_text, ms(figure.measured_ns), verdict, "", "", "")
    if (received := judged.receivers) is not None:
        promised = f"{milliseconds(received.predicted_max_ns)} at most"
        verdict = f"{received.behind} of {received.count} behind"
        table.add("received, maximum", promised, ms(received.max_ns), verdict, "", "", "")
        promised = f"{milliseconds(received.predicted_jitter_ns)} at most"
        table.add("received, jitter", promised, ms(received.jitter_ns), "", "", "", "")
    table.line()
    for number, band in enumerate(judged.bands, start=1):
        name = band.mode or f"band {number}"
        table.add(
            f"{name}, {band.late} late" if band.mode and band.late else name,
            slots_ms((band.slot_start_ns, band.slot_end_ns)),
            ms(band.mean_ns),
            f"{band.inside} of {band.count} inside" if band.count else "no cycles",
            ms(band.jitter_ns),
            percent(band.predicted_share),
            percent(band.share),
        )
    of_mode = "; shares of a mode: its outputs that were in time for its slot"
    late = of_mode if any(band.mode for band in judged.bands) else ""
    late += "" if judged.outputs.late is None else f"; {late_text(judged)}"
    table.caption = (
        "undisturbed cycles; ranges run from slot start to slot end: expect the start. Averages"
        f" have room for chance{late}"
    )
    return table


def late_text(judged: JudgedPrediction) -> str:
    """Text: how many outputs that were due came late or never, of all cycles."""
    disturbed = (judged.outputs.late or 0) - judged.late
    among = f", {disturbed} of the late ones in disturbed cycles" if disturbed else ""
    return f"of all cycles: {judged.outputs.text}{among}"


def prediction_json(judged: JudgedPrediction) -> dict[str, Any]:
    """A judged prediction as plain data, in whole nanoseconds."""

    def plain(figure: JudgedFigure) -> dict[str, Any]:
        return {name.removesuffix("_ns"): value for name, value in vars(figure).items()}

    return {
        "convention": CONVENTION,
        "mean_ns": plain(judged.mean),
        "max_ns": plain(judged.max),
        "jitter_ns": plain(judged.jitter),
        "receivers": None if judged.receivers is None else vars(judged.receivers),
        "bands": [vars(band) for band in judged.bands],
        "late": judged.late,
        "late_of_all": judged.outputs.late,
        "due": judged.outputs.due,
        "absent": dict(judged.outputs.absent),
        "missed": judged.outputs.missed,
        "most_missed": judged.outputs.most_missed,
        "counted_from": judged.counted_from,
        "kept": not judged.broken if judged.broken or judged.mean.measured_ns is not None else None,
        "broken": list(judged.broken),
    }


def breakdown_json(analysis: LatencyAnalysis) -> dict[str, Any]:
    """The breakdown by hops as plain data, with the parts' shares of the mean latency."""
    frame = hop_breakdown(analysis)
    shares = {f"{part}_share": share for part, share in part_shares(frame).items()}
    return {"hops": frame.to_dicts(), **shares}


def breakdown_table(analysis: LatencyAnalysis) -> ResultTable:
    """Make a table of each hop's communication, computation and waiting, with their shares.

    If no message waits in a node, there are no columns for waiting.
    """
    frame = hop_breakdown(analysis)
    waits = frame["waiting_ns"].struct.field("max").fill_null(0).max()
    between = _communication_intervals(analysis)
    shown = PARTS if waits else PARTS[:2]
    cycles = Column("cycles", footer=str(analysis.statistics.count), detail=True)
    columns = [Column("hop", words=True, footer="together"), cycles]
    for part, share in part_shares(frame).items():
        if part in shown:
            columns += [Column(f"{part}\nmin", detail=True), *figures(f"{part}\nmean", "max")]
            columns.append(Column("share", footer=percent(share)))
    table = ResultTable("Where it goes, hop by hop [ms]", columns)
    for row in frame.iter_rows(named=True):
        cells: list[str] = []
        for part in shown:
            cells += [*min_mean_max(row[f"{part}_ns"]), percent(row[f"{part}_share"])]
        if (intervals := between.get(row["hop"])) is not None:
            cells[:3] = map(interval_ms, intervals)
        table.add(f"{row['callback']} → {row['topic']}", row["count"], *cells)
    return table


def _communication_intervals(
    analysis: LatencyAnalysis,
) -> dict[int, tuple[Interval, Interval, Interval]]:
    """Return the least, mean and longest communication of each hop between hosts, as intervals."""
    low, high = "communication_low_ns", "communication_high_ns"
    if low not in analysis.hops.columns:
        return {}
    complete = analysis.traversals.filter("complete")
    hops = analysis.hops.join(complete, on="traversal", how="semi").drop_nulls(low)
    between = hops.filter((pl.col(high) - pl.col(low)).max().over("hop") > BETWEEN_HOSTS_NS)
    rows = between.group_by("hop").agg(
        pl.concat_list(
            pl.col(column).min(), pl.col(column).mean().round().cast(pl.Int64), pl.col(column).max()
        )
        for column in (low, high)
    )
    return {
        hop: ((lows[0], highs[0]), (lows[1], highs[1]), (lows[2], highs[2]))
        for hop, lows, highs in rows.iter_rows()
    }


def incomplete_table(names: Sequence[str], measurements: Sequence[Measurement]) -> ResultTable:
    """Make a table of why cycles have no latency, with the numbers of the first ones."""
    table = ResultTable("", [*words("", "reason", "at"), *figures("cycles", "numbers")])
    for name, measurement in zip(names, measurements, strict=True):
        broken = measurement.analysis.traversals.drop_nulls("reason")
        grouped = broken.group_by("reason", "broken_at", maintain_order=True).agg("traversal")
        for reason, topic, numbers in grouped.iter_rows():
            first = ", ".join(map(str, numbers[:5])) + (", …" if len(numbers) > 5 else "")
            table.add(name, f"{reason}: {REASONS[reason]}", topic, len(numbers), first)
    return table
