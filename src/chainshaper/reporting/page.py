"""The report: one HTML page with everything in it that a timing engineer sends to a colleague.

It loads nothing: it works from a disk, in an archive, and without a network. Tables are written
here; charts are drawn in the page by its script, from data that it carries.

Nothing that a recording says is trusted. Text is escaped where tables are written; data stands in
a block that browsers do not execute, with every character escaped that could end it; and the page
forbids itself, by its content security policy, to run any script but its own and to load anything.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import polars as pl

from chainshaper.analysis import DataFlow, callback_statistics, data_flow
from chainshaper.planning import Plan, dump_plan
from chainshaper.reporting.latency import (
    breakdown_table,
    comparison_table,
    headline_table,
    incomplete_table,
    prediction_table,
)
from chainshaper.reporting.page_data import hop_bars, latency_range, recording_data, slot_bars
from chainshaper.reporting.plans import plan_table
from chainshaper.reporting.recordings import (
    callback_table,
    condition_table,
    recorded_thread_table,
    stall_table,
)
from chainshaper.reporting.tables import ResultTable, figures, ms, words
from chainshaper.reporting.timeline import Timeline, timeline_of
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.safe_text import escape, shown
from chainshaper.verify.measure import Comparison, Measurement
from chainshaper.verify.overruns import overruns_text

__all__ = ["ENDINGS", "report_page", "write_report"]

ENDINGS = (".html", ".htm")
LISTED = 50
"""Rows of a list that may be endless."""

WAITING = '<p class="waiting">This chart is drawn by a script: allow scripts to see it.</p>'


@dataclass(frozen=True)
class _Part:
    """A measurement under the ``name`` that tells it from the report's others."""

    name: str
    measurement: Measurement
    flow: DataFlow
    timeline: Timeline


def write_report(
    measurements: Sequence[Measurement], path: str | Path, cycles: Sequence[int] = ()
) -> Path:
    """Write the report of one chain in one or several recordings, whole or not at all.

    ``cycles`` are numbers of cycles that the timeline has to show, should there be so many that it
    cannot show all.

    Raises:
        InputError: the path exists already or is no HTML file, or there is no such cycle.
        OperationError: it cannot be written; nothing is left behind.
    """
    path = new_file(path, ENDINGS)
    return write_whole(path, [report_page(measurements, cycles).encode("utf-8")])


def report_page(measurements: Sequence[Measurement], cycles: Sequence[int] = ()) -> str:
    """The report as the text of an HTML file."""
    if not measurements:
        raise InputError("a report needs a recording at least")
    most = max(measurement.analysis.traversals.height for measurement in measurements)
    for cycle in cycles:
        if not 0 <= cycle < most:
            raise InputError(
                f"there is no cycle {cycle}: the recordings have {most} at most, numbered from 0"
            )
    names = distinct_names([measurement.recording.path for measurement in measurements])
    parts = [_part(*named) for named in zip(names, measurements, strict=True)]
    plans = _plans(parts)
    recordings = [recording_data(one.name, one.measurement, one.timeline, cycles) for one in parts]
    times = [time for one in recordings for time in one["points"]["time"][-1:]]
    data = {
        "recordings": recordings,
        "publishSlots": list(dict.fromkeys(slot for one in recordings for slot in one["slots"])),
        "longest": max([1, *times]),
        "range": latency_range(recordings),
        "bars": {"breakdown": hop_bars(names, measurements)}
        | {f"slots-{number}": slot_bars(plan) for number, plan in enumerate(plans.values())},
    }
    folder = resources.files("chainshaper.reporting")
    page, style, script = (
        (folder / name).read_text("utf-8") for name in ("page.html", "page.css", "page.js")
    )
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return Template(page).substitute(
        _tables(parts, plans),
        **_beside_charts(parts, recordings),
        title=escape(f"End-to-end latency of {measurements[0].analysis.chain.spec}"),
        style=style,
        data=_embedded(data),
        script=script,
        digest=digest,
    )


def _part(name: str, measurement: Measurement) -> _Part:
    recording = measurement.recording
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    timeline = timeline_of(recording, flow, measurement.analysis, measurement.plan)
    return _Part(name, measurement, flow, timeline)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """The last parts of each path, as many as it takes to tell them apart."""
    parts = [path.absolute().parts for path in paths]
    for length in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{path} ({number})" for number, path in enumerate(paths, start=1)]


def _plans(parts: Sequence[_Part]) -> dict[str, Plan]:
    """Different plans, each under the names of the recordings it was in force in."""
    found: list[tuple[Plan, list[str]]] = []
    for one in parts:
        plan = one.measurement.plan
        known = next((users for other, users in found if other == plan), None)
        if known is not None:
            known.append(one.name)
        elif plan is not None:
            found.append((plan, [one.name]))
    return {", ".join(users): plan for plan, users in found}


def _tables(parts: Sequence[_Part], plans: dict[str, Plan]) -> dict[str, str]:
    """What the page's tables say, by the places that the template has for them."""
    names = [one.name for one in parts]
    measurements = [one.measurement for one in parts]
    compared = Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
    left_out = [(one.name, one.measurement.left_out.text) for one in parts]
    incomplete = incomplete_table(names, measurements)
    hops = [(one.name, breakdown_table(one.measurement.analysis).html()) for one in parts]
    notes = [(one.name, dict.fromkeys(one.measurement.analysis.notes)) for one in parts]
    items = "".join(f"<li>{escape(f'{name}: {note}')}</li>" for name, own in notes for note in own)
    conditions = condition_table(names, measurements).html(), *map(_recorded_threads, parts)
    return {
        "headline": headline_table(names, measurements).html()
        + "".join(_paragraph(f"{name}: {text}.") for name, text in left_out if text),
        "before_and_after": "Before and after" if len(parts) > 1 else "Figures",
        "comparison": comparison_table(compared, names).html(),
        "predictions": "\n".join(map(_prediction, parts)),
        "hops": "\n".join(
            _paragraph(f"{name}, all complete cycles [ms]:") + table for name, table in hops
        ),
        "callbacks": "\n".join(map(_callbacks, parts)),
        "overruns": "\n".join(map(_overruns, parts)),
        "incomplete": incomplete.html()
        if incomplete.rows
        else _paragraph("Every cycle that began is complete."),
        "stalls": "\n".join(map(_stalls, parts)),
        "plans": "\n".join(_plan(number, *one) for number, one in enumerate(plans.items())),
        "conditions": "\n".join([*conditions, f'<ul class="notes">{items}</ul>']),
    }


def _beside_charts(parts: Sequence[_Part], data: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Legends, choices, and what charts leave out."""
    every, sample, points, cycles = [], [], "", ""
    for part, one in zip(parts, data, strict=True):
        total, drawn = one["points"]["of"], len(one["points"]["cycle"])
        number, here = one["timeline"]["of"], len(one["timeline"]["cycles"])
        kind = "complete" if part.measurement.longest_stall_ns is None else "undisturbed"
        every.append(f"{part.name} ({total} cycles)")
        sample.append(f"{part.name} ({one['histogram']['total']} {kind} cycles)")
        if drawn < total:
            points += (
                f" Of {total} cycles of {part.name} {drawn} are drawn: of every stretch the"
                " shortest and the longest, disturbed and not, and of the others every n-th."
            )
        if here < number:
            cycles += (
                f" Of {number} cycles of {part.name} {here} are here: the longest, the shortest,"
                " incomplete ones, those asked for, and a sample of the others."
            )
    return {
        "legend": _legend(every),
        "legend_of_sample": _legend(sample),
        "fewer_points": escape(points),
        "fewer_cycles": escape(cycles),
        "options": "".join(f"<option>{escape(part.name)}</option>" for part in parts),
        "waiting": WAITING,
    }


def _legend(names: Sequence[str]) -> str:
    items = (
        f'<span class="series-{number % 4}">{escape(name)}</span>'
        for number, name in enumerate(names)
    )
    return f'<div class="legend">{"".join(items)}</div>'


def _prediction(part: _Part) -> str:
    """Predicted beside measured, where a plan was in force."""
    held = part.measurement.held
    if held is None:
        return ""
    table = prediction_table(held)
    about = f"The plan's prediction and {part.name} [ms]: {table.caption}."
    if held.counted_from == "cycle":
        about += " Times count from the start of the cycle."
    return _paragraph(about) + table.html()


def _callbacks(part: _Part) -> str:
    table = callback_table(callback_statistics(part.flow))
    title = f"Callbacks of {part.name} ({len(table.rows)}) [ms]"
    return _details(title, table.html(), unfolded=len(table.rows) <= LISTED)


def _overruns(part: _Part) -> str:
    """Outputs that came behind their slot, one by one."""
    measurement = part.measurement
    if measurement.overruns is None:
        return _paragraph(f"{part.name}: nothing was gated, so nothing could overrun.")
    if not measurement.overruns:
        return _paragraph(f"{part.name}: no output was too late for its slot.")
    about = _paragraph(f"{part.name}: {overruns_text(measurement.overruns)}.")
    latencies = measurement.analysis.traversals.select("traversal", "latency_ns")
    late = part.timeline.holds.filter(pl.col("overrun").is_not_null()).join(
        latencies, on="traversal", how="left", maintain_order="left"
    )
    if not late.height:
        return about
    table = ResultTable(
        "",
        [
            *figures("cycle", "arrived, from its anchor [ms]"),
            *words("what was done"),
            *figures("latency [ms]"),
        ],
    )
    for cycle, arrival, origin, done, latency in (
        late.head(LISTED)
        .select("traversal", "arrival", "origin", "overrun", "latency_ns")
        .iter_rows()
    ):
        table.add(str(cycle), ms(arrival - origin), done, ms(latency))
    rest = f"The first {LISTED} of {late.height} are listed." if late.height > LISTED else ""
    return about + table.html() + _paragraph(rest)


def _stalls(part: _Part) -> str:
    meter = part.measurement.recording.info.stall_meter
    if meter is None:
        return _paragraph(f"{part.name}: no meter watched, so its stalls are unknown.")
    stalls = part.timeline.stalls.select(cpu="core", duration=pl.col("end") - pl.col("start"))
    statistics = part.measurement.analysis.statistics
    about = (
        f"{part.name}: stalls of the machine from {format_duration(meter.threshold_ns)} in "
        f"{meter.wakeups:,} wake-ups of a sleeper at the highest priority; they disturbed "
        f"{statistics.disturbed} of {statistics.count} cycles."
    )
    return _paragraph(about) + stall_table(meter, stalls).html()


def _plan(number: int, users: str, plan: Plan) -> str:
    title = "The servers' slots over one cycle"
    return (
        f'<section id="plan-{number}">\n<h2>{escape(f"The plan of {users}")}</h2>\n'
        f'<figure id="slots-{number}">'
        f'<div class="chart" role="group" tabindex="0" aria-label="{title}">{WAITING}</div>'
        "<figcaption>Blue: the server in whose slots the output is published. Slots are half-open"
        " and drawn at least 1.5 pixels wide; drag to zoom.</figcaption></figure>\n"
        + plan_table(plan).html()
        + _details("The plan as YAML", f"<pre>{escape(dump_plan(plan))}</pre>")
        + "</section>"
    )


def _recorded_threads(part: _Part) -> str:
    threads = part.measurement.recording.info.threads
    table = recorded_thread_table(threads).html()
    return _details(f"Threads of {part.name} ({len(threads)})", table) if threads else ""


def _paragraph(text: str) -> str:
    return f'<p class="about">{escape(text)}</p>' if text else ""


def _details(summary: str, content: str, *, unfolded: bool = False) -> str:
    state = " open" if unfolded else ""
    return f"<details{state}><summary>{escape(summary)}</summary>\n{content}\n</details>"


def _embedded(data: dict[str, Any]) -> str:
    """JSON in which nothing can end the block that it stands in."""
    text = json.dumps(_safe(data), ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _safe(value: Any) -> Any:
    """Plain data with all its texts as they are shown."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict):
        return {key: _safe(one) for key, one in value.items()}
    return [_safe(one) for one in value] if isinstance(value, list | tuple) else value
