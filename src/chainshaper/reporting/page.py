"""The report: one HTML page with everything in it that a timing engineer sends to a colleague.

The page loads nothing: it works from a disk, in an archive, and without a network. Tables are
written here. The page's script draws the charts, from data in the page. If a recording has many
cycles, the chart over time shows a selection: of each stretch the shortest and the longest, so that
no extreme is lost, and of the others every n-th, so that their density is right. The histogram
counts all cycles in fine bins, which the script joins for each drawing.

No text from a recording is trusted. Tables escape it. Data stands in a block that browsers do not
execute, and every character that could end that block is escaped. The page's content security
policy forbids to run any script but the page's own, and to load anything.
"""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Literal

import numpy as np
import polars as pl

from chainshaper.analysis import (
    DataFlow,
    LatencyAnalysis,
    callback_statistics,
    recorded_flow,
)
from chainshaper.planning import ChainPlan, Plan, dump_plan, publish_slots
from chainshaper.planning.overruns import slots_of_latency
from chainshaper.reporting import latency as of_chain
from chainshaper.reporting import overviews
from chainshaper.reporting.cycle_parts import OPACITY, drawn_cycles, stacked_cycles
from chainshaper.reporting.graph_drawing import timed_fold_svgs, timed_graph_svg
from chainshaper.reporting.live_control import live_cost_table, live_costs, live_verdict
from chainshaper.reporting.tables import ResultTable, figures, ms, slots_ms, words
from chainshaper.reporting.timeline import Timeline, timeline_data, timeline_of
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, escape, shown
from chainshaper.values.files import new_file, write_whole
from chainshaper.verify.measure import (
    PARTS,
    Comparison,
    Measurement,
    hop_breakdown,
    hop_names,
)
from chainshaper.verify.overruns import moves_in, moves_text, next_cycles, overruns_text

ENDINGS = (".html", ".htm")
LISTED = 50
"""Rows of a list that are shown at most."""

POINTS = 4_000
"""Points of the chart over time, per recording, at most."""

STACKED = 1_000
"""Cycles of the chart that stacks their hops, per recording, at most."""

BINS = 10_000
"""Fine bins over a recording's latencies at most."""

WAITING = '<p class="waiting">This chart is drawn by a script: allow scripts to see it.</p>'


@dataclass(frozen=True)
class _NamedMeasurement:
    """A measurement with the ``name`` of its recording in this report."""

    name: str
    measurement: Measurement
    flow: DataFlow
    timeline: Timeline


def write_report(
    measurements: Sequence[Measurement] | Sequence[Comparison],
    path: str | Path,
    cycles: Sequence[int] = (),
) -> Path:
    """Write the report of chains in recordings as an HTML file, whole or not at all.

    ``measurements`` are of one chain, in one or several recordings; or they are comparisons of
    several chains, each in the same recordings. ``cycles`` are numbers of cycles that the timeline
    shows at any rate, even if it has no room for all.

    Raises InputError: the path exists already or is no HTML file, or there is no such cycle.
    OperationError: it cannot be written; nothing is left behind.
    """
    path = new_file(path, ENDINGS)
    return write_whole(path, [report_page(measurements, cycles).encode("utf-8")])


def report_page(
    measurements: Sequence[Measurement] | Sequence[Comparison], cycles: Sequence[int] = ()
) -> str:
    """Make the report as the text of an HTML file."""
    if not measurements:
        raise InputError("a report needs a recording at least")
    chains = [given for given in measurements if isinstance(given, Comparison)]
    if of_single_chain := tuple(given for given in measurements if isinstance(given, Measurement)):
        chains = [Comparison(of_single_chain[0].analysis.chain.spec, of_single_chain)]
    all_measurements = [measurement for chain in chains for measurement in chain.measurements]
    most = max(measurement.analysis.traversals.height for measurement in all_measurements)
    for cycle in cycles:
        if not 0 <= cycle < most:
            raise InputError(
                f"there is no cycle {cycle}: the recordings have {most} at most, numbered from 0"
            )
    shared, several = chains[0].measurements, len(chains) > 1
    names = distinct_names([measurement.recording.path for measurement in shared])
    # A recording is resolved once, however many chains it has.
    flows: dict[int, DataFlow] = {}
    for measurement in all_measurements:
        if (key := id(measurement.recording)) not in flows:
            flows[key] = measurement.flow or recorded_flow(measurement.recording)
    page, of_each, style, *scripts = (
        (resources.files("chainshaper.reporting") / name).read_text("utf-8")
        for name in ("page.html", "chain.html", "page.css", "page.js", "graph.js")
    )
    script = "\n".join(f"{{{text}}}" for text in scripts)  # each with names of its own
    blocks, drawn = [], []
    for number, chain in enumerate(chains):
        parts = []
        for name, measurement in zip(names, chain.measurements, strict=True):
            flow = flows[id(measurement.recording)]
            timeline = timeline_of(
                measurement.recording, flow, measurement.analysis, measurement.plan
            )
            parts.append(_NamedMeasurement(name, measurement, flow, timeline))
        data = _drawn(parts, cycles, number)
        places = _tables(parts, data["n"], several) | _beside_charts(parts, data["recordings"])
        blocks.append(Template(of_each).substitute(places, n=data["n"]))
        drawn.append(data)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    embedded = json.dumps(_safe(drawn), ensure_ascii=True, separators=(",", ":"))
    about = f"{len(chains)} chains" if several else chains[0].chain
    headline = _paragraph(of_chain.headline(names, shared), "verdict")
    if several:
        headline = of_chain.overview_table(chains, names).html()
    left_out = [
        (name, measurement.left_out.text) for name, measurement in zip(names, shared, strict=True)
    ]
    return Template(page).substitute(
        title=escape(f"End-to-end latency of {about}"),
        headline=headline + "".join(_paragraph(f"{n}: {t}.") for n, t in left_out if t),
        chains="\n".join(blocks),
        conditions=_conditions(names, chains),
        style=style,
        # JSON in which nothing can end the block that it stands in.
        data=embedded.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"),
        script=script,
        digest=digest,
    )


def _plans_of(parts: Sequence[_NamedMeasurement]) -> dict[str, ChainPlan]:
    """Map names of recordings to the plan that was in force in them; equal plans stand once."""
    plans: dict[str, tuple[list[str], ChainPlan]] = {}
    for part in parts:
        if (plan := part.measurement.plan) is not None:
            plans.setdefault(dump_plan(Plan.of(plan)), ([], plan))[0].append(part.name)
    return {", ".join(users): plan for users, plan in plans.values()}


def _drawn(
    parts: Sequence[_NamedMeasurement], cycles: Sequence[int], number: int
) -> dict[str, Any]:
    """Collect the data of a chain's charts; ``n`` is the end of their ids, "" for the first."""
    suffix = f"-{number + 1}" if number else ""
    series = _series(parts)
    recordings = [_recording_data(part, cycles, series) for part in parts]
    points = [recording["points"] for recording in recordings]
    times = [time for drawn in points for time in (*drawn["time"][-1:], *drawn["incomplete"][-1:])]
    slots = enumerate(_plans_of(parts).values())
    bars = {f"slots-{place}{suffix}": slot_bars(plan) for place, plan in slots}
    return {
        "n": suffix,
        "recordings": recordings,
        "publishSlots": list(
            dict.fromkeys(slot for recording in recordings for slot in recording["slots"])
        ),
        "longest": max([1, *times]),
        "range": latency_range(recordings),
        "opacity": OPACITY,
        "bars": {f"breakdown{suffix}": _hop_bars(parts), **bars},
    }


def _safe(value: Any) -> Any:
    """Plain data with control characters of all its texts made visible."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict):
        return {key: _safe(item) for key, item in value.items()}
    return [_safe(item) for item in value] if isinstance(value, list | tuple) else value


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Names of paths: their last parts, as few as set them apart."""
    parts = [path.absolute().parts for path in paths]
    for length in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{path} ({number})" for number, path in enumerate(paths, start=1)]


def _data_age(analysis: LatencyAnalysis) -> str:
    """Make the HTML of the table of the age of a loop's data; empty: the chain has no loop."""
    if analysis.data_age is None:
        return ""
    table = of_chain.data_age_table(analysis.data_age)
    return _paragraph(f"{table.title}:") + table.html() + _paragraph(table.caption or "")


def _tables(parts: Sequence[_NamedMeasurement], suffix: str, several: bool) -> dict[str, str]:
    """Make the HTML of a chain's tables, by the placeholders of the template.

    If there are ``several`` chains, each has a heading, and the first has the callbacks of all.
    """
    names = [part.name for part in parts]
    measurements = [part.measurement for part in parts]
    compared = Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
    incomplete = of_chain.incomplete_table(names, measurements)
    verdict = _paragraph(of_chain.headline(names, measurements), "verdict")
    callbacks = "\n".join(map(_callbacks, parts))
    hops = (
        _paragraph(f"{part.name}, all complete cycles [ms]:")
        + of_chain.breakdown_table(part.measurement.analysis).html()
        + _data_age(part.measurement.analysis)
        for part in parts
    )
    plans = (
        _plan(f"{number}{suffix}", users, plan)
        for number, (users, plan) in enumerate(_plans_of(parts).items())
    )
    none_incomplete = "Every cycle that began is complete."
    section = f'<section id="callbacks">\n<h2>Callbacks</h2>\n{callbacks}\n</section>'
    return {
        "heading": f"<h1>{escape(compared.chain)}</h1>\n{verdict}" if several else "",
        "callbacks": "" if suffix else section,
        "before_and_after": "Before and after" if len(parts) > 1 else "Figures",
        "comparison": of_chain.comparison_table(compared, names).html(),
        "predictions": "\n".join(map(_prediction, parts)),
        "control": _control(names, measurements),
        "hops": "\n".join(hops),
        "graphs": "\n".join(map(_graph, parts)),
        "overruns": "\n".join(_overruns(part) + _moves(part) for part in parts),
        "incomplete": incomplete.html() if incomplete.rows else _paragraph(none_incomplete),
        "stalls": "\n".join(map(_stalls, parts)),
        "plans": "\n".join(plans),
    }


def _conditions(names: Sequence[str], chains: Sequence[Comparison]) -> str:
    """Make the HTML on how each recording was taken, with its threads and notes."""
    recordings = [*zip(*(chain.measurements for chain in chains), strict=True)]
    parts, items = [overviews.condition_table(names, recordings).html()], ""
    for name, of_recording in zip(names, recordings, strict=True):
        parts.append(_recorded_threads(name, of_recording[0]))
        for note in dict.fromkeys(
            note for measurement in of_recording for note in measurement.analysis.notes
        ):
            items += f"<li>{escape(f'{name}: {note}')}</li>"
    return "\n".join([*parts, f'<ul class="notes">{items}</ul>'])


def _beside_charts(
    parts: Sequence[_NamedMeasurement], data: Sequence[dict[str, Any]]
) -> dict[str, str]:
    """Make the HTML beside charts: legends, choices, and notes on what charts leave out."""
    all_cycles, sample, points, stacked, cycles = [], [], "", "", ""
    for part, of_part in zip(parts, data, strict=True):
        total, drawn = of_part["points"]["of"], len(of_part["points"]["cycle"])
        number, here = of_part["timeline"]["of"], len(of_part["timeline"]["cycles"])
        kind = "complete" if part.measurement.longest_stall_ns is None else "undisturbed"
        all_cycles.append(f"{part.name} ({total} cycles)")
        sample.append(f"{part.name} ({of_part['histogram']['total']} {kind} cycles)")
        if drawn < total:
            points += (
                f" Of {total} cycles of {part.name} {drawn} are drawn: of every stretch the"
                " shortest and the longest, disturbed and not, and of the others every n-th."
            )
        if (of_stacked := len(of_part["stacked"]["cycle"])) < total:
            stacked += (
                f" Of {total} cycles of {part.name} {of_stacked} are drawn, each as wide as those"
                " left out behind it: of every stretch the shortest and the longest, and of the"
                " others every n-th."
            )
        if here < number:
            cycles += (
                f" Of {number} cycles of {part.name} {here} are here: the longest, the shortest,"
                " incomplete ones, those asked for, and a sample of the others."
            )
    return {
        "legend": _legend(all_cycles),
        "legend_of_sample": _legend(sample),
        "legend_of_hops": _legend(_series(parts)),
        "fewer_points": escape(points),
        "fewer_stacked": escape(stacked),
        "fewer_cycles": escape(cycles),
        "options": "".join(f"<option>{escape(part.name)}</option>" for part in parts),
        "waiting": WAITING,
    }


def _legend(names: Iterable[str]) -> str:
    items = (
        f'<span class="series-{number % 4}">{escape(name)}</span>'
        for number, name in enumerate(names)
    )
    return f'<div class="legend">{"".join(items)}</div>'


def _graph(part: _NamedMeasurement) -> str:
    """Make the HTML of the application's graph, with times of its edges and callbacks."""
    analysis = part.measurement.analysis
    drawing = timed_graph_svg(part.flow, analysis.graph, analysis.chain)
    parts = timed_fold_svgs(part.flow, analysis.graph, analysis.chain)
    about = "Beside arrows: from publication to the start of the callback; beside callbacks: from"
    about += " start to end; mean, and maximum, of all that was recorded. Thick: the chain."
    title = f"The graph of {part.name}, with times"
    content = f'{_paragraph(about)}<div class="drawing">{drawing}</div>'
    if parts:
        nodes = sum(len(fold.nodes) for fold, _ in parts)
        about = f"Its {nodes} nodes are folded by namespace, but those of the chain. A thin arrow"
        about += " stands for several topics: point at it. Each namespace is below, unfolded."
        field = '<input type="search" placeholder="a node, topic or function">'
        search = f'<p class="search"><label>Find {field}</label> <output></output></p>'
        inside = "".join(
            f'<details class="fold"><summary>{escape(f"{fold.name} ({fold.text})")}</summary>'
            f'<div class="drawing">{svg}</div></details>'
            for fold, svg in parts
        )
        content = f'<div class="folded">{_paragraph(about)}{search}{content}{inside}</div>'
    return _details(title, content, unfolded=True)


def _prediction(part: _NamedMeasurement) -> str:
    """Make the HTML of predicted beside measured figures, if a plan was in force."""
    judged = part.measurement.prediction
    if judged is None:
        return ""
    table = of_chain.prediction_table(judged)
    about = f"The plan's prediction and {part.name} [ms]: {table.caption}."
    if judged.counted_from == "cycle":
        about += " Times count from the start of the cycle."
    return _paragraph(about) + table.html()


def _control(names: Sequence[str], measurements: Sequence[Measurement]) -> str:
    """Make the HTML of what the control loop of live runs cost; empty: they had none."""
    costs = live_costs(measurements)
    if not any(costs):
        return ""
    table = live_cost_table(names, costs)
    verdict = _paragraph(live_verdict(costs) or "", "verdict")
    return f"{_paragraph(f'{table.title}: {table.caption}.')}{table.html()}{verdict}"


def _callbacks(part: _NamedMeasurement) -> str:
    table = overviews.callback_table(callback_statistics(part.flow))
    title = f"Callbacks of {part.name} ({len(table.rows)}) [ms]"
    return _details(title, table.html(), unfolded=len(table.rows) <= LISTED)


def _moves(part: _NamedMeasurement) -> str:
    """Make the HTML of the moves of slots that followed the latencies."""
    moves = moves_in(part.measurement.analysis)
    if not moves:
        return ""
    begun = int(part.measurement.analysis.traversals["start"][0])
    table = ResultTable("", figures("from the recording's second", "moved by [ms]"))
    for move in moves:
        table.add(f"{(move['from_ns'] - begun) / 1e9:.3f}", f"{move['moved_ns'] / 1e6:+.3f}")
    title = f"{part.name}: slots followed the latencies, {moves_text(moves)}"
    return _details(title, table.html(), unfolded=len(moves) <= LISTED)


def _overruns(part: _NamedMeasurement) -> str:
    """Make the HTML of the outputs that came behind their slot."""
    measurement = part.measurement
    if measurement.overruns is None:
        return _paragraph(f"{part.name}: nothing was gated, so nothing could overrun.")
    if not measurement.overruns:
        return _paragraph(f"{part.name}: no output was too late for its slot.")
    about = _paragraph(f"{part.name}: {overruns_text(measurement.overruns)}.")
    columns = [*words("policy"), *figures("late", "discarded", "next cycle hit")]
    outcomes = ResultTable("", columns)
    for policy, outcome in measurement.outcomes.items():
        outcomes.add(policy, outcome.late, outcome.discarded, next_cycles({policy: outcome}))
    about += outcomes.html() if outcomes.rows else ""
    latencies = measurement.analysis.traversals.select("traversal", "latency_ns")
    late = part.timeline.holds.filter(pl.col("overrun").is_not_null()).join(
        latencies, on="traversal", how="left", maintain_order="left"
    )
    if not late.height:
        return about
    columns = [*figures("cycle", "arrived, from its anchor [ms]"), *words("what was done")]
    table = ResultTable("", [*columns, *figures("latency [ms]")])
    shown = late.select("traversal", "arrival", "origin", "overrun", "latency_ns").head(LISTED)
    for cycle, arrival, origin, done, latency in shown.iter_rows():
        table.add(cycle, ms(arrival - origin), done, ms(latency))
    rest = f"The first {LISTED} of {late.height} are listed." if late.height > LISTED else ""
    return about + table.html() + _paragraph(rest)


def _stalls(part: _NamedMeasurement) -> str:
    meter = part.measurement.recording.info.stall_meter
    if meter is None:
        return _paragraph(f"{part.name}: no meter watched, so its stalls are unknown.")
    stalls = part.timeline.stalls.select(cpu="core", duration=pl.col("end") - pl.col("start"))
    statistics = part.measurement.analysis.statistics
    about = (
        f"{part.name}: stalls of the machine from {duration_text(meter.threshold_ns)} in "
        f"{meter.wakeups:,} wake-ups of a sleeper at the highest priority; they disturbed "
        f"{statistics.disturbed} of {statistics.count} cycles."
    )
    return _paragraph(about) + overviews.stall_table(meter, stalls).html()


def _plan(number: str, users: str, plan: ChainPlan) -> str:
    title = "The servers' slots over one cycle"
    return (
        f'<section id="plan-{number}">\n<h2>{escape(f"The plan of {users}")}</h2>\n'
        f'<figure id="slots-{number}">'
        f'<div class="chart" role="group" tabindex="0" aria-label="{title}">{WAITING}</div>'
        "<figcaption>Blue: the server in whose slots the output is published. Slots are half-open"
        " and drawn at least 1.5 pixels wide; drag to zoom.</figcaption></figure>\n"
        + overviews.plan_table(plan).html()
        + _details("The plan as YAML", f"<pre>{escape(dump_plan(Plan.of(plan)))}</pre>")
        + "</section>"
    )


def _recorded_threads(name: str, measurement: Measurement) -> str:
    threads = measurement.recording.info.threads
    table = overviews.recorded_thread_table(threads).html()
    return _details(f"Threads of {name} ({len(threads)})", table) if threads else ""


def _paragraph(text: str, kind: Literal["about", "verdict"] = "about") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if text else ""


def _details(summary: str, content: str, *, unfolded: bool = False) -> str:
    state = " open" if unfolded else ""
    return f"<details{state}><summary>{escape(summary)}</summary>\n{content}\n</details>"


def _recording_data(
    part: _NamedMeasurement, cycles: Sequence[int], series: dict[str, int]
) -> dict[str, Any]:
    """Collect the data of a recording's charts; its timeline has ``cycles`` at any rate."""
    measurement, plan = part.measurement, part.measurement.plan
    traversals = measurement.analysis.traversals
    zero = next(iter(traversals["start"]), 0)
    return {
        "name": part.name,
        "slots": () if plan is None else slots_of_latency(plan),
        "points": latency_points(traversals, zero),
        "histogram": latency_histogram(traversals),
        "stacked": _stacked(part, series),
        "timeline": timeline_data(measurement, part.timeline, cycles, zero),
    }


def latency_range(recordings: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """The range (ns) of undisturbed latencies and slots, with a little air."""
    ends = [end for recording in recordings for slot in recording["slots"] for end in slot]
    for recording in recordings:
        histogram = recording["histogram"]
        if not histogram["bin"]:
            continue
        first, last = histogram["bin"][0], histogram["bin"][-1]
        ends += [first * histogram["width"], (last + 1) * histogram["width"]]
    if not ends:
        return 0, 1e6
    low, high = min(ends), max(ends)
    air = max((high - low) * 0.04, high * 1e-4)
    return 0 if low < 0.25 * high else low - air, high + air


def _series(parts: Sequence[_NamedMeasurement]) -> dict[str, int]:
    """Number the hops of a chain in all recordings, by their names, for their colours."""
    names = (name for part in parts for name in hop_names(part.measurement.analysis))
    return {name: number for number, name in enumerate(dict.fromkeys(names))}


def _hop_bars(parts: Sequence[_NamedMeasurement]) -> dict[str, Any]:
    """Collect the bars of mean communication, computation and waiting of each hop.

    A row per hop of each recording, from the mean end of the hop before it.
    """
    rows, longest = [], 1.0
    series = _series(parts)
    for recording in parts:
        analysis, at = recording.measurement.analysis, 0.0
        breakdown = hop_breakdown(analysis).iter_rows(named=True)
        for name, hop in zip(hop_names(analysis), breakdown, strict=True):
            bars, begun = [], at
            for share_of in PARTS:
                mean, share = (hop[f"{share_of}_ns"] or {}).get("mean"), hop[f"{share_of}_share"]
                if not mean:
                    continue
                text = f"{hop['callback']} → {hop['topic']}\n{share_of} {ms(mean)} ms, {share:.1%}"
                look = (f"series-{series[name] % 4}", OPACITY[share_of])
                bars.append((at, at + mean, *look, text))
                at += mean
            of_recording = f"{recording.name}: " if len(parts) > 1 else ""
            rows.append((f"{of_recording}{name}, {ms(at - begun)} ms", bars))
        longest = max(longest, at)
    label = "mean, from the start of the cycle"
    return {"label": label, "length": longest * 1.01, "rows": rows}


def _stacked(part: _NamedMeasurement, series: dict[str, int]) -> dict[str, Any]:
    """Collect the data of the chart of cycles stacked by hop.

    * ``of``: how many complete cycles there are.
    * ``cycle``: lists of number; ``disturbed``: places in it of the disturbed cycles.
    * ``hops``: of each the ``name`` and ``series``, and per part the times of all cycles (ns).
    * ``highest``: the longest undisturbed latency (ns).
    """
    analysis = part.measurement.analysis
    stacked = stacked_cycles(analysis, STACKED)
    hops = [
        {"name": name, "series": series[name]}
        | {key: times[:, hop].tolist() for key, times in stacked.parts_ns.items()}
        for hop, name in enumerate(hop_names(analysis))
    ]
    return {
        "of": stacked.complete,
        "cycle": stacked.cycles.tolist(),
        "disturbed": np.flatnonzero(stacked.disturbed).tolist(),
        "hops": hops,
        "highest": analysis.undisturbed.max_ns or analysis.statistics.max_ns or 1,
    }


def slot_bars(plan: ChainPlan) -> dict[str, Any]:
    """Collect the bars of the servers' slots over one cycle, a row per server."""
    rows = []
    for server in plan.servers:
        look = "series-1" if server.slots == publish_slots(plan) else "slot"
        bars = [(*slot, look, 1, f"{server.name}\n{slots_ms(slot)} ms") for slot in server.slots]
        rows.append((f"{server.name}: core {server.core}, priority {server.priority}", bars))
    return {"label": "in the cycle", "length": plan.cycle_ns, "zoom": "x", "rows": rows}


def latency_points(traversals: pl.DataFrame, zero: int, limit: int = POINTS) -> dict[str, Any]:
    """Select at most ``limit`` cycles for the chart of latency over time.

    * ``of``: how many complete cycles there are.
    * ``cycle``, ``time``, ``latency``: lists of number, start and latency (ns) of those drawn.
    * ``disturbed``: the places in these lists of the disturbed cycles.
    * ``incomplete``: when incomplete cycles began (ns).

    Times count from ``zero``.
    """
    drawn = drawn_cycles(traversals, limit)
    broken = traversals.filter(~pl.col("complete"))["start"] - zero
    gaps = broken.gather_every(max(1, -(-len(broken) // limit)))
    return {
        "of": int(traversals["complete"].sum()),
        "cycle": drawn["traversal"].to_list(),
        "time": (drawn["start"] - zero).to_list(),
        "latency": drawn["latency_ns"].to_list(),
        "disturbed": np.flatnonzero(drawn["disturbed"].to_numpy()).tolist(),
        "incomplete": sorted({*gaps, *broken.tail(1)}),
    }


def latency_histogram(traversals: pl.DataFrame, bins: int = BINS) -> dict[str, Any]:
    """Count undisturbed latencies in bins [n·width, (n+1)·width) of a width that is 10^k ns.

    * ``width``: of a bin (ns).
    * ``bin``: the numbers n of bins that are not empty.
    * ``count``: of the latencies in each of these.
    * ``total``: of all latencies.
    """
    calm = traversals.filter(pl.col("complete") & ~pl.col("disturbed"))
    latencies, width = calm["latency_ns"].to_numpy(), 1
    while len(latencies) and latencies.max() // width - latencies.min() // width >= bins:
        width *= 10
    numbers, counts = np.unique(latencies // width, return_counts=True)
    counted = {"bin": numbers.tolist(), "count": counts.tolist()}
    return {"width": width, **counted, "total": len(latencies)}
