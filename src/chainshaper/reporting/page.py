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
from chainshaper.values.safe_text import escape, shown
from chainshaper.values.whole_file import new_file, write_whole
from chainshaper.verify.measure import Comparison, Measurement
from chainshaper.verify.overruns import overruns_text

__all__ = ["ENDINGS", "report_page", "write_report"]

ENDINGS = (".html", ".htm")
LISTED = 50
"""Rows of a list that may be endless."""

OVER_TIME = (
    "Crosses: disturbed by the machine. Triangles: beyond the axis. Red ticks: incomplete cycles."
    " Grey: publish slots. Drag to zoom, double click or Escape to go back; arrow keys walk through"
    " the cycles, Enter or a click opens one below."
)
FEWER_POINTS = (
    " Of {total} cycles of {name} {drawn} are drawn: of every stretch the shortest and the longest,"
    " disturbed and not, and of the others every n-th."
)
HISTOGRAM = (
    "Without cycles that the machine disturbed, each recording on a scale of its own. Grey: publish"
    " slots. Zooming in makes the bins finer; every cycle is counted."
)
DISTRIBUTION = "Without cycles that the machine disturbed. Grey: publish slots."
HOPS = (
    "Full: computation, from a callback's start to its publication. Pale: communication, from the"
    " publication before to the start: transport, and waiting for the executor."
)
SLOTS = (
    "Blue: the server in whose slots the output is published. Slots are half-open and drawn at"
    " least 1.5 pixels wide; drag to zoom."
)
TIMELINE = (
    "Orange: what the cycle itself ran; pale: transport, and waiting; grey: other callbacks; blue:"
    " slots; hatched: held by the gate; red: stalls. A callback is pale where its end was not"
    " recorded. Drag, or the arrow keys, move; + and − or Ctrl with the wheel zoom."
)
FEWER_CYCLES = (
    " Of {total} cycles of {name} {number} are here: the longest, the shortest, incomplete ones,"
    " those asked for, and a sample of the others."
)
BUTTONS = (
    ("longest", "longest", "the longest undisturbed cycle"),
    ("median", "median", "the undisturbed cycle of median latency"),
    ("shortest", "shortest", "the shortest undisturbed cycle"),
    ("previous", "‹", "previous cycle"),
    ("next", "›", "next cycle"),
    ("in", "+", "zoom in"),
    ("out", "−", "zoom out"),
    ("whole", "whole cycle", "show the whole cycle"),
)
HOP_TIMES = ("hop [ms]", "taken", "started", "published", "communication", "computation")


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
    data = {
        "recordings": recordings,
        "publishSlots": list(dict.fromkeys(slot for one in recordings for slot in one["slots"])),
        "longest": max((1, *(time for one in recordings for time in one["points"]["time"][-1:]))),
        "range": latency_range(recordings),
        "bars": {"breakdown": hop_bars(names, measurements)}
        | {f"slots-{number}": slot_bars(plan) for number, plan in enumerate(plans.values())},
    }
    headline = headline_table(names, measurements).html() + "".join(
        _paragraph(f"{name}: {one.left_out.text}.")
        for name, one in zip(names, measurements, strict=True)
        if one.left_out.text
    )
    title = f"End-to-end latency of {measurements[0].analysis.chain.spec}"
    return _filled(title, headline, _sections(parts, plans, recordings), data)


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


def _sections(
    parts: Sequence[_Part], plans: dict[str, Plan], data: Sequence[dict[str, Any]]
) -> list[str]:
    names = [one.name for one in parts]
    measurements = [one.measurement for one in parts]
    compared = Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
    incomplete = incomplete_table(names, measurements)
    return [
        _section(
            "figures",
            "Before and after" if len(parts) > 1 else "Figures",
            comparison_table(compared, names).html(),
            *map(_prediction, parts),
        ),
        _section(
            "latency",
            "Latency over time, and its distribution",
            *_latency_charts(parts, data),
        ),
        _section(
            "hops",
            "Where the time goes",
            _chart("breakdown", "Mean communication and computation of every hop", HOPS),
            *(
                _paragraph(f"{one.name}, all complete cycles [ms]:")
                + breakdown_table(one.measurement.analysis).html()
                for one in parts
            ),
        ),
        _section("callbacks", "Callbacks", *map(_callbacks, parts)),
        _section(
            "cycles",
            "Cycle by cycle",
            _timeline(names, data),
        ),
        _section(
            "overruns",
            "Overruns and incomplete cycles",
            *map(_overruns, parts),
            incomplete.html()
            if incomplete.rows
            else _paragraph("Every cycle that began is complete."),
        ),
        _section("stalls", "Stalls of the machine", *map(_stalls, parts)),
        *(_plan_section(number, *one) for number, one in enumerate(plans.items())),
        _section(
            "conditions",
            "What was recorded, where and how",
            condition_table(names, measurements).html(),
            *map(_recorded_threads, parts),
            _notes(parts),
        ),
    ]


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
        return _paragraph(f"{part.name}: nobody watched the machine, so its stalls are not known.")
    stalls = part.timeline.stalls.select(cpu="core", duration=pl.col("end") - pl.col("start"))
    statistics = part.measurement.analysis.statistics
    about = (
        f"{part.name}: stalls of the machine from {format_duration(meter.threshold_ns)} in "
        f"{meter.wakeups:,} wake-ups of a sleeper at the highest priority; they disturbed "
        f"{statistics.disturbed} of {statistics.count} cycles."
    )
    return _paragraph(about) + stall_table(meter, stalls).html()


def _plan_section(number: int, users: str, plan: Plan) -> str:
    return _section(
        f"plan-{number}",
        f"The plan of {users}",
        _chart(f"slots-{number}", "The servers' slots over one cycle", SLOTS),
        plan_table(plan).html(),
        _details("The plan as YAML", f"<pre>{escape(dump_plan(plan))}</pre>"),
    )


def _recorded_threads(part: _Part) -> str:
    threads = part.measurement.recording.info.threads
    table = recorded_thread_table(threads).html()
    return _details(f"Threads of {part.name} ({len(threads)})", table) if threads else ""


def _notes(parts: Sequence[_Part]) -> str:
    """What a reader of the figures must know, recording by recording."""
    items = "".join(
        f"<li>{escape(f'{one.name}: {note}')}</li>"
        for one in parts
        for note in dict.fromkeys(one.measurement.analysis.notes)
    )
    return f'<ul class="notes">{items}</ul>' if items else ""


def _section(identifier: str, title: str, *contents: str) -> str:
    body = "\n".join(content for content in contents if content)
    return f'<section id="{identifier}">\n<h2>{escape(title)}</h2>\n{body}\n</section>'


def _paragraph(text: str, kind: str = "about") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if text else ""


def _details(summary: str, content: str, *, unfolded: bool = False) -> str:
    state = " open" if unfolded else ""
    return f"<details{state}><summary>{escape(summary)}</summary>\n{content}\n</details>"


def _chart(identifier: str, title: str, caption: str, above: str = "", below: str = "") -> str:
    """A place that the script draws into; without scripts it says so."""
    waiting = _paragraph("This chart is drawn by a script: allow scripts to see it.", "waiting")
    return (
        f'<figure id="{identifier}" aria-label="{escape(title)}">{above}{waiting}'
        f'<div class="chart" role="group" tabindex="0" aria-label="{escape(title)}"></div>'
        f"<figcaption>{escape(caption)}</figcaption>{below}</figure>"
    )


def _latency_charts(parts: Sequence[_Part], data: Sequence[dict[str, Any]]) -> list[str]:
    every, calm, few = [], [], ""
    for part, one in zip(parts, data, strict=True):
        total, drawn = one["points"]["of"], len(one["points"]["cycle"])
        every.append(f"{part.name} ({total} cycles)")
        watched = part.measurement.longest_stall_ns is not None
        kind = "undisturbed" if watched else "complete"
        calm.append(f"{part.name} ({one['histogram']['total']} {kind} cycles)")
        if drawn < total:
            few += FEWER_POINTS.format(total=total, name=part.name, drawn=drawn)
    names = [part.name for part in parts]
    return [
        _chart("over-time", "Latency of every cycle over time", OVER_TIME + few, _legend(every)),
        _chart("histogram", "Histogram of the latency", HISTOGRAM, _legend(calm)),
        _chart("cdf", "Cumulative distribution of the latency", DISTRIBUTION, _legend(names)),
    ]


def _legend(names: Sequence[str]) -> str:
    items = (
        f'<span class="series-{number % 4}">{escape(name)}</span>'
        for number, name in enumerate(names)
    )
    return f'<div class="legend">{"".join(items)}</div>'


def _timeline(names: Sequence[str], data: Sequence[dict[str, Any]]) -> str:
    """The timeline's figure: its controls, and the table of the hops, which the script fills."""
    caption = TIMELINE
    for name, timeline in zip(names, (one["timeline"] for one in data), strict=True):
        if len(timeline["cycles"]) < timeline["of"]:
            here = len(timeline["cycles"])
            caption += FEWER_CYCLES.format(total=timeline["of"], name=name, number=here)
    options = "".join(f"<option>{escape(name)}</option>" for name in names)
    buttons = [
        f'<button type="button" value="{value}" title="{title}">{text}</button>'
        for value, text, title in BUTTONS
    ]
    number = '<input type="number" min="0" aria-label="cycle number">'
    controls = [f'<select aria-label="recording">{options}</select>', *buttons]
    controls.insert(5, number)
    head = "".join(f'<th scope="col">{title}</th>' for title in HOP_TIMES)
    return _chart(
        "timeline",
        "Threads, servers and stalls in one cycle",
        caption,
        f'<div class="controls">{"".join(controls)}</div><p class="about" aria-live="polite"></p>',
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody></tbody></table></div>',
    )


def _filled(title: str, headline: str, sections: Sequence[str], data: dict[str, Any]) -> str:
    folder = resources.files("chainshaper.reporting")
    page, style, script = (
        (folder / name).read_text("utf-8") for name in ("page.html", "page.css", "page.js")
    )
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return Template(page).substitute(
        title=escape(title),
        headline=headline,
        style=style,
        sections="\n".join(sections),
        data=_embedded(data),
        script=script,
        digest=digest,
    )


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
