"""What the report's charts draw, as plain data: small enough for a page, exact where it counts.

A screen has some thousand columns of pixels. Of many more cycles, the chart over time keeps of
every stretch the shortest and the longest, so that no extreme is lost, and of the others every
n-th, so that their density is not distorted; the histogram counts all cycles in bins so fine that
they are joined for every drawing. The timeline keeps all cycles of a short recording; of a long
one the longest and the shortest, the median, those without an end, those that were asked for by
number, and a sample of the others. Times are integer ns, counted from the first cycle's start.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.disturbance import overlapping
from chainshaper.planning import Plan, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.reporting.tables import ms, slots_ms
from chainshaper.reporting.timeline import Timeline
from chainshaper.verify.measure import PARTS, Measurement, hop_breakdown

__all__ = [
    "hop_bars",
    "latency_histogram",
    "latency_points",
    "latency_range",
    "recording_data",
    "slot_bars",
    "timeline_data",
]

POINTS = 4_000
"""Points of the chart over time, per recording."""

BINS = 10_000
"""Fine bins over a recording's latencies at most."""

CYCLES = 500
SLICES = 20_000
"""How many cycles, and callbacks in them, the timeline of one recording keeps."""

EXTREMES = 20
"""How many of the longest cycles, and of the shortest, are among them in any case."""

KINDS = ("cycle", "callback", "unended", "held", "slot", "stall")
CYCLE, CALLBACK, UNENDED, HELD, SLOT, STALL = range(len(KINDS))
BARS = ("row", "start", "length", "kind", "cycle", "text", "used")
"""What bars the timeline has, and what is said of each."""

FAR = 10**15
"""Outside every recording: 11 days."""

Bar = tuple[float, float, str, float, str]
TimelineBar = tuple[int, int, int, int, int, str, int | None]
Times = npt.NDArray[np.int64]


def recording_data(
    name: str, measurement: Measurement, timeline: Timeline, cycles: Sequence[int]
) -> dict[str, Any]:
    """Everything that is drawn of one recording; its timeline has ``cycles`` in any case."""
    starts = measurement.analysis.traversals["start"]
    zero = int(starts[0]) if len(starts) else 0
    return {
        "name": name,
        "slots": _output_slots(measurement.plan),
        "points": latency_points(measurement.analysis.traversals, zero),
        "histogram": latency_histogram(measurement.analysis.traversals),
        "timeline": timeline_data(measurement, timeline, cycles, zero),
    }


def _output_slots(plan: Plan | None) -> list[tuple[int, int]]:
    """Publish slots as latencies: under LET they belong to a later cycle."""
    if plan is None:
        return []
    delay = cycles_until_output(plan) * plan.cycle_ns
    return [(start + delay, end + delay) for start, end in publish_slots(plan)]


def latency_range(recordings: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """The range of undisturbed latencies and slots, with a little air."""
    ends = [end for one in recordings for slot in one["slots"] for end in slot]
    for histogram in (one["histogram"] for one in recordings if one["histogram"]["bin"]):
        first, *_, last = histogram["bin"][0], histogram["bin"][-1]
        ends += [first * histogram["width"], (last + 1) * histogram["width"]]
    if not ends:
        return 0, 1e6
    low, high = min(ends), max(ends)
    air = max((high - low) * 0.04, high * 1e-4)
    return 0 if low < 0.25 * high else low - air, high + air


def hop_bars(names: Sequence[str], measurements: Sequence[Measurement]) -> dict[str, Any]:
    """Mean communication (pale) and computation (full) of every hop, a row per recording."""
    rows, longest = [], 1.0
    for series, (name, measurement) in enumerate(zip(names, measurements, strict=True)):
        bars: list[Bar] = []
        at = 0.0
        for number, hop in enumerate(hop_breakdown(measurement.analysis).iter_rows(named=True)):
            for part in (part for part in PARTS if hop[f"{part}_ns"] is not None):
                mean, share = hop[f"{part}_ns"]["mean"], hop[f"{part}_share"]
                opacity = 0.35 if part == "communication" else 0.8 if number % 2 else 1
                text = f"{hop['callback']} → {hop['topic']}\n{part} {ms(mean)} ms, {share:.1%}"
                bars.append((at, at + mean, f"series-{series % 4}", opacity, text))
                at += mean
        rows.append((name, bars))
        longest = max(longest, at)
    label = "mean, from the start of the cycle"
    return {"label": label, "length": longest * 1.01, "rows": rows}


def slot_bars(plan: Plan) -> dict[str, Any]:
    """The servers' slots over one cycle, a row per server."""
    publishing = publish_slots(plan)
    rows = []
    for server in plan.servers:
        look = "series-1" if server.slots == publishing else "slot"
        bars = [
            (start, end, look, 1, f"{server.name}\n{slots_ms((start, end))} ms")
            for start, end in server.slots
        ]
        where = f"{server.name}: core {server.core}, priority {server.priority}"
        rows.append((where, bars))
    return {"label": "in the cycle", "length": plan.cycle_ns, "zoom": "x", "rows": rows}


def latency_points(traversals: pl.DataFrame, zero: int, limit: int = POINTS) -> dict[str, Any]:
    """Latency over time: ``cycle, time, latency`` of those that are drawn, in order of time.

    ``disturbed`` are their places in these lists. ``of`` says how many complete cycles there are,
    ``incomplete`` when the others began.
    """
    complete = traversals.filter("complete").select("traversal", "start", "latency_ns", "disturbed")
    drawn = complete
    if complete.height > limit:
        stretches = max(1, limit // 8)  # two extremes each of two kinds: half of the points
        stretch = pl.int_range(pl.len()) * stretches // pl.len()
        extremes = (
            complete.with_columns(row=pl.int_range(pl.len()))
            .group_by(stretch.alias("stretch"), "disturbed")
            .agg(
                pl.col("row").get(pl.col("latency_ns").arg_min()).alias("shortest"),
                pl.col("row").get(pl.col("latency_ns").arg_max()).alias("longest"),
            )
        )
        sample = pl.arange(0, complete.height, -(-2 * complete.height // limit), eager=True)
        rows = pl.concat([extremes["shortest"], extremes["longest"], sample]).unique().sort()
        drawn = complete[rows]
    broken = traversals.filter(~pl.col("complete"))["start"] - zero
    return {
        "of": complete.height,
        "cycle": drawn["traversal"].to_list(),
        "time": (drawn["start"] - zero).to_list(),
        "latency": drawn["latency_ns"].to_list(),
        "disturbed": np.flatnonzero(drawn["disturbed"].to_numpy()).tolist(),
        "incomplete": broken.gather_every(max(1, -(-len(broken) // limit))).to_list(),
    }


def latency_histogram(traversals: pl.DataFrame, bins: int = BINS) -> dict[str, Any]:
    """Undisturbed latencies counted in bins [n·width, (n+1)·width) of a width that is 10^k ns.

    ``bin`` are the numbers n of those that are not empty, ``count`` how many are in them, ``total``
    how many there are.
    """
    latencies = traversals.filter(pl.col("complete") & ~pl.col("disturbed"))[
        "latency_ns"
    ].to_numpy()
    if not len(latencies):
        return {"width": 1, "bin": [], "count": [], "total": 0}
    width = 1
    while int(latencies.max()) // width - int(latencies.min()) // width >= bins:
        width *= 10
    numbers, counts = np.unique(latencies // width, return_counts=True)
    counted = {"bin": numbers.tolist(), "count": counts.tolist()}
    return {"width": width, **counted, "total": len(latencies)}


def timeline_data(
    measurement: Measurement, timeline: Timeline, cycles: Sequence[int], zero: int
) -> dict[str, Any]:
    """The timeline around the cycles in the page, and which of them are worst, median and best.

    ``rows`` are the chain, threads, servers and cores, each with a remark; ``gaps`` are stretches
    of which the page has nothing. Bars are in the columns of :data:`BARS`: ``kind`` is the number
    of one of :data:`KINDS`, ``cycle`` -1 where it is of none, ``text`` its number in ``texts``,
    ``used`` the execution time.
    """
    analysis = measurement.analysis
    chosen = _cycles_in_page(analysis.traversals, timeline.slices.height, cycles)
    traversals = analysis.traversals.filter(pl.col("traversal").is_in(chosen))
    began, ended = _windows(traversals, timeline)
    threads = timeline.threads.select("pid", "tid").with_row_index("row", offset=1)
    hops = _hops(measurement, timeline, traversals, threads)
    rows, bars = _bars(measurement, timeline, traversals, (began, ended), threads, hops)
    texts = {text: number for number, text in enumerate(dict.fromkeys(bar[5] for bar in bars))}
    table = [(row, at - zero, *rest, texts[text], used) for row, at, *rest, text, used in bars]
    columns = zip(*table, strict=True) if table else [()] * len(BARS)
    edges = [-FAR, *np.column_stack([began - zero, ended - zero]).ravel().tolist(), FAR]
    labels = {callback.id: callback.label for callback in analysis.graph.callbacks}
    passed = zip(analysis.chain.callbacks, analysis.chain.topics, strict=True)
    return {
        "rows": rows,
        **dict(zip(BARS, map(list, columns), strict=True)),
        "texts": list(texts),
        "gaps": list(zip(edges[::2], edges[1::2], strict=True)),
        "cycles": _cycles(traversals, hops, timeline.slots, zero),
        "hops": [f"{labels[callback]} → {topic}" for callback, topic in passed],
        "of": analysis.traversals.height,
        "chosen": _chosen(analysis.traversals),
    }


def _bars(  # noqa: PLR0917 - what a timeline is made of
    measurement: Measurement,
    timeline: Timeline,
    traversals: pl.DataFrame,
    windows: tuple[Times, Times],
    threads: pl.DataFrame,
    hops: pl.DataFrame,
) -> tuple[list[tuple[str, str]], list[TimelineBar]]:
    """The timeline's rows, and its bars: cycles, callbacks, what gates did, slots, stalls."""
    labels = {one.id: one.label for one in measurement.analysis.graph.callbacks}
    servers = () if measurement.plan is None else measurement.plan.servers
    stalls = _inside(timeline.stalls.sort("start"), *windows)
    rows = [("chain", ""), *timeline.threads.select("nodes", pl.col("about").fill_null("")).rows()]
    server_rows = {one.name: number for number, one in enumerate(servers, start=len(rows))}
    rows += [(f"server {one.name}", f"core {one.core}, priority {one.priority}") for one in servers]
    cores = {core: number for number, core in enumerate(dict.fromkeys(stalls["core"]), len(rows))}
    rows += [("stalls" if core is None else f"stalls of core {core}", "") for core in cores]
    slices = _inside(timeline.slices, *windows).join(
        threads, on=["pid", "tid"], maintain_order="left"
    )
    bars = [
        *_cycle_bars(traversals.filter("complete")),
        *_callback_bars(slices, labels),
        *_held_bars(timeline.holds, hops.drop_nulls("row")),
        *_server_bars(timeline, traversals, server_rows),
    ]
    for core, start, end in stalls.iter_rows():
        bars.append((cores[core], start, end - start, STALL, -1, "the machine stalled", None))
    return rows, bars


def _cycle_bars(complete: pl.DataFrame) -> Iterator[TimelineBar]:
    columns = ("traversal", "start", "latency_ns", "disturbed")
    for cycle, start, latency, hit in complete.select(columns).iter_rows():
        text = f"cycle {cycle}{', disturbed by the machine' if hit else ''}"
        yield 0, start, latency, CYCLE, cycle, text, None


def _callback_bars(slices: pl.DataFrame, labels: dict[int, str]) -> Iterator[TimelineBar]:
    columns = ("row", "callback_id", "start", "end", "ended", "execution_ns")
    for row, callback, start, end, whole, used in slices.select(columns).iter_rows():
        text = labels[callback] + ("" if whole else "\nits end was not recorded")
        yield row, start, end - start, CALLBACK if whole else UNENDED, -1, text, used


def _held_bars(holds: pl.DataFrame, hops: pl.DataFrame) -> Iterator[TimelineBar]:
    columns = ("row", "traversal", "arrival", "let_go", "overrun")
    found = holds.join(hops, on=["traversal", "hop"], maintain_order="left").select(columns)
    for row, cycle, arrival, let_go, overrun in found.iter_rows():
        text = f"cycle {cycle}: held{f', overran: {overrun}' if overrun else ''}"
        yield row, arrival, let_go - arrival, HELD, cycle, text, None


def _server_bars(
    timeline: Timeline, traversals: pl.DataFrame, rows: dict[str, int]
) -> Iterator[TimelineBar]:
    # A cycle that two traversals share has its slots once, with either of them.
    shown = timeline.origins.join(traversals.select("traversal"), on="traversal", how="semi")
    slots = timeline.slots.join(timeline.origins, on="traversal", maintain_order="left").join(
        shown, on="origin", how="semi", maintain_order="left"
    )
    columns = ("server", "traversal", "start", "end", "origin", "assumed")
    for server, cycle, start, end, origin, assumed in slots.select(columns).iter_rows():
        text = f"server {server}, cycle {cycle}\n{slots_ms((start - origin, end - origin))} ms"
        text += "\nthe cycle's start is not recorded but assumed" if assumed else ""
        yield rows[server], start, end - start, SLOT, cycle, text, None


def _hops(
    measurement: Measurement, timeline: Timeline, traversals: pl.DataFrame, threads: pl.DataFrame
) -> pl.DataFrame:
    """``traversal, hop, row`` and the times of the hops, counted from their cycle's start."""
    times = (pl.col(name) - pl.col("begun") for name in ("take", "start", "publish", "end"))
    return (
        measurement.analysis.hops.join(
            traversals.select("traversal", begun="start"), on="traversal"
        )
        .join(timeline.slices.select("instance", "pid", "tid"), on="instance", how="left")
        .join(threads, on=["pid", "tid"], how="left")
        .sort("traversal", "hop")
        .select("traversal", "hop", "row", *times)
    )


def _cycles(
    traversals: pl.DataFrame, hops: pl.DataFrame, slots: pl.DataFrame, zero: int
) -> list[dict[str, Any]]:
    """Each cycle in the page; its hops ``[row, take, start, publish, end]`` count from its start.

    ``length`` is the time that it takes on the timeline, with its servers' slots.
    """
    closes = dict(slots.group_by("traversal").agg(pl.col("end").max()).iter_rows())
    hops_of: dict[int, list[list[int | None]]] = {}
    for traversal, _, *hop in hops.iter_rows():
        hops_of.setdefault(traversal, []).append(hop)
    found = []
    for row in traversals.iter_rows(named=True):
        number, start = row["traversal"], row["start"]
        own = hops_of.get(number, [])
        state = f"incomplete: {row['reason']} ({row['broken_at']})"
        about = f"{ms(row['latency_ns'])} ms" if row["complete"] else state
        about += ", disturbed by the machine" if row["disturbed"] else ""
        received = None if row["received"] is None else row["received"] - start
        about += "" if received is None else f"; {ms(received)} ms at the subscriber"
        about += f"; began {(start - zero) / 1e9:.3f} s after the first"
        cycle = {"n": number, "start": start - zero, "hops": own, "about": about}
        if row["complete"]:
            cycle["latency"] = row["latency_ns"]
        ends = [time for hop in own for time in hop[2:] if time is not None]
        ends.append(closes.get(number, start) - start)
        cycle["length"] = max(1000, row["latency_ns"] or 0, received or 0, *ends)
        found.append(cycle)
    return found


def _chosen(traversals: pl.DataFrame) -> dict[str, int]:
    """The longest, median and shortest undisturbed cycle; of all complete if all are disturbed."""
    complete = traversals.filter("complete")
    calm = complete.filter(~pl.col("disturbed"))
    ordered = (calm if calm.height else complete).sort("latency_ns", maintain_order=True)
    numbers = ordered["traversal"]
    if not len(numbers):
        return {}
    chosen = {"longest": -1, "median": (len(numbers) - 1) // 2, "shortest": 0}
    return {name: int(numbers[place]) for name, place in chosen.items()}


def _cycles_in_page(traversals: pl.DataFrame, slices: int, asked: Sequence[int]) -> list[int]:
    """All cycles where they are few; else those asked for, extremes, incomplete, and a sample."""
    per_cycle = max(1.0, slices / max(1, traversals.height))
    room = max(2 * EXTREMES + 1, min(CYCLES, int(SLICES / per_cycle)))
    every = traversals["traversal"].to_list()
    if len(every) <= room:
        return every
    known = set(every)
    ordered = traversals.filter("complete").sort("latency_ns", maintain_order=True)["traversal"]
    incomplete = traversals.filter(~pl.col("complete"))["traversal"]
    candidates = [
        *(cycle for cycle in asked if cycle in known),
        *_chosen(traversals).values(),
        *ordered.tail(EXTREMES),
        *ordered.head(EXTREMES),
        *incomplete.head(EXTREMES),
        *every[:: max(1, len(every) // room)],
    ]
    return sorted(list(dict.fromkeys(candidates))[: room + len(asked)])


def _windows(traversals: pl.DataFrame, timeline: Timeline) -> tuple[Times, Times]:
    """From a little before each cycle to a little behind its output's reception; merged."""
    slots = timeline.slots.group_by("traversal").agg(closes=pl.col("end").max())
    rows = traversals.join(slots, on="traversal", how="left", maintain_order="left")
    usual = rows["latency_ns"].median()
    length = int(usual) if isinstance(usual, float) else 100_000_000
    ends = rows.select(
        end=pl.max_horizontal("end", "received", "closes", pl.col("start") + length)
    )["end"].to_numpy()
    began = rows["start"].to_numpy() - length // 20
    ended = np.maximum.accumulate(ends + length // 20) if len(ends) else ends
    fresh = np.ones(len(began), dtype=bool)
    fresh[1:] = began[1:] > ended[:-1]
    last = np.append(fresh[1:], True) if len(fresh) else fresh
    return began[fresh], ended[last]


def _inside(slices: pl.DataFrame, began: Times, ended: Times) -> pl.DataFrame:
    start, end = slices["start"].to_numpy(), slices["end"].to_numpy()
    return slices.filter(pl.Series(overlapping(start, end, began, ended), dtype=pl.Boolean))
