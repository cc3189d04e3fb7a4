"""The page: sections from the tables, data for the charts, style and scripts, in one file.

Nothing that a recording says is trusted. Text is escaped where tables are written; data stands in
a block that browsers do not execute, with every character escaped that could end it; and the page
forbids itself, by its content security policy, to run any script but its own and to load anything.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from chainshaper.analysis import data_flow
from chainshaper.planning import Plan, dump_plan
from chainshaper.reporting.html import conditions, tables
from chainshaper.reporting.html.markup import details, paragraph, section
from chainshaper.reporting.html.series import plan_drawing, recording_data
from chainshaper.reporting.html.told import Told
from chainshaper.reporting.timeline import timeline_of
from chainshaper.values.errors import InputError
from chainshaper.values.safe_text import escape, shown
from chainshaper.values.whole_file import new_file, write_whole
from chainshaper.verify.measure import Measurement

__all__ = ["ENDINGS", "report_page", "write_report"]

ENDINGS = (".html", ".htm")
SCRIPTS = ("charts.js", "plots.js", "timeline.js", "report.js")


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
    told = [_told(*named) for named in zip(names, measurements, strict=True)]
    plans = _plans(told)
    sections = [
        *_measured(told),
        section("callbacks", "Callbacks", *map(tables.callback_table, told)),
        *_cycle_by_cycle(told),
        *_plan_sections(plans),
        section(
            "conditions",
            "What was recorded, where and how",
            conditions.condition_tables(told),
            conditions.note_lists(told),
        ),
    ]
    data = {
        "recordings": [recording_data(one, cycles) for one in told],
        "plans": [plan_drawing(plan) for plan in plans.values()],
    }
    chain = measurements[0].analysis.chain.spec
    return _filled(f"End-to-end latency of {chain}", tables.headline(told), sections, data)


def _told(name: str, measurement: Measurement) -> Told:
    recording = measurement.recording
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    timeline = timeline_of(recording, flow, measurement.analysis, measurement.plan)
    return Told(name, measurement, flow, timeline)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """The last parts of each path, as many as it takes to tell them apart."""
    parts = [path.absolute().parts for path in paths]
    for length in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{path} ({number})" for number, path in enumerate(paths, start=1)]


def _measured(told: Sequence[Told]) -> list[str]:
    return [
        section(
            "figures",
            "Before and after" if len(told) > 1 else "Figures",
            tables.comparison_table(told),
            tables.prediction_tables(told),
        ),
        section(
            "latency",
            "Latency over time, and its distribution",
            _chart("over-time", "Latency of every cycle over time"),
            _chart("histogram", "Histogram of the latency"),
            _chart("cdf", "Cumulative distribution of the latency"),
        ),
        section(
            "hops",
            "Where the time goes",
            _chart("breakdown", "Mean communication and computation of every hop"),
            *map(tables.breakdown_table, told),
        ),
    ]


def _cycle_by_cycle(told: Sequence[Told]) -> list[str]:
    return [
        section(
            "cycles",
            "Cycle by cycle",
            _chart("timeline", "Threads, servers and stalls in one cycle"),
        ),
        section(
            "overruns",
            "Overruns and incomplete cycles",
            *map(tables.overrun_table, told),
            tables.incomplete_table(told),
        ),
        section("stalls", "Stalls of the machine", *map(tables.stall_tables, told)),
    ]


def _plans(told: Sequence[Told]) -> dict[str, Plan]:
    """Different plans, each under the names of the recordings it was in force in."""
    found: list[tuple[Plan, list[str]]] = []
    for one in told:
        plan = one.measurement.plan
        known = next((users for other, users in found if other == plan), None)
        if known is not None:
            known.append(one.name)
        elif plan is not None:
            found.append((plan, [one.name]))
    return {", ".join(users): plan for plan, users in found}


def _plan_sections(plans: dict[str, Plan]) -> list[str]:
    return [
        section(
            f"plan-{number}",
            f"The plan of {users}",
            _chart(f"slots-{number}", "The servers' slots over one cycle"),
            tables.server_table(plan),
            details("The plan as YAML", f"<pre>{escape(dump_plan(plan))}</pre>"),
        )
        for number, (users, plan) in enumerate(plans.items())
    ]


def _chart(identifier: str, title: str) -> str:
    """A place that a script draws into; without scripts it says so."""
    waiting = paragraph("This chart is drawn by a script: allow scripts to see it.", "waiting")
    return f'<figure id="{identifier}" aria-label="{escape(title)}">{waiting}</figure>'


def _filled(title: str, headline: str, sections: Sequence[str], data: dict[str, Any]) -> str:
    folder = resources.files("chainshaper.reporting.html")
    texts = {
        name: (folder / name).read_text("utf-8") for name in ("page.html", "page.css", *SCRIPTS)
    }
    script = "\n".join(texts[name] for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return Template(texts["page.html"]).substitute(
        title=escape(title),
        headline=headline,
        style=texts["page.css"],
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
