"""What the report's charts draw, as plain data: small enough for a page, exact where it counts.

A screen has some thousand columns of pixels. Of many more cycles, the chart over time keeps of
every stretch the shortest and the longest, so that no extreme is lost, and of the others every
n-th, so that their density is not distorted; the histogram counts all cycles in bins so fine that
they are joined for every drawing. The timeline keeps all cycles of a short recording; of a long
one the longest and the shortest, the median, those without an end, those that were asked for by
number, and a sample of the others. Times are integer ns, counted from the first cycle's start.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.disturbance import overlapping
from chainshaper.planning import Plan, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.reporting.latency import PARTS, hop_breakdown
from chainshaper.reporting.timeline import Timeline
from chainshaper.verify.measure import Measurement

__all__ = [
    "latency_histogram",
    "latency_points",
    "plan_drawing",
    "recording_data",
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
        "hops": [
            {
                "name": f"{row['callback']} → {row['topic']}",
                **{
                    part: [row[f"{part}_ns"]["mean"], row[f"{part}_share"]]
                    for part in PARTS
                    if row[f"{part}_ns"] is not None
                },
            }
            for row in hop_breakdown(measurement.analysis).iter_rows(named=True)
        ],
        "timeline": timeline_data(measurement, timeline, cycles, zero),
    }


def _output_slots(plan: Plan | None) -> list[tuple[int, int]]:
    """Publish slots as latencies: under LET they belong to a later cycle."""
    if plan is None:
        return []
    delay = cycles_until_output(plan) * plan.cycle_ns
    return [(start + delay, end + delay) for start, end in publish_slots(plan)]


def plan_drawing(plan: Plan) -> dict[str, Any]:
    """The servers' slots over one cycle."""
    publishing = publish_slots(plan)
    return {
        "cycle": plan.cycle_ns,
        "servers": [
            {
                "name": f"{server.name}: core {server.core}, priority {server.priority}",
                "slots": server.slots,
                "output": server.slots == publishing,
            }
            for server in plan.servers
        ],
    }


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

    ``bin`` are the numbers n of those that are not empty, ``count`` how many are in them.
    """
    kept = traversals.filter(pl.col("complete") & ~pl.col("disturbed"))["latency_ns"].to_numpy()
    if not len(kept):
        return {"width": 1, "bin": [], "count": []}
    width = 1
    while int(kept.max()) // width - int(kept.min()) // width >= bins:
        width *= 10
    numbers, counts = np.unique(kept // width, return_counts=True)
    return {"width": width, "bin": numbers.tolist(), "count": counts.tolist()}


def timeline_data(
    measurement: Measurement, timeline: Timeline, cycles: Sequence[int], zero: int
) -> dict[str, Any]:
    """The timeline of the cycles that are kept, and which of them are worst, median and best."""
    traversals = measurement.analysis.traversals
    kept = _kept_cycles(traversals, timeline.slices.height, cycles)
    windows = _windows(traversals.filter(pl.col("traversal").is_in(kept)), timeline)
    began, ended = windows
    slices = _inside(timeline.slices, began, ended)
    lanes = timeline.threads.select("pid", "tid").with_row_index("lane")
    slices = slices.join(lanes, on=["pid", "tid"], how="left", maintain_order="left")
    names = {callback.id: callback.label for callback in measurement.analysis.graph.callbacks}
    used, numbers = np.unique(slices["callback_id"].to_numpy(), return_inverse=True)
    return {
        "threads": timeline.threads.select("nodes", pl.col("about").fill_null("")).rows(),
        "callbacks": [names[callback] for callback in used.tolist()],
        "lane": slices["lane"].to_list(),
        "callback": numbers.tolist(),
        "start": (slices["start"] - zero).to_list(),
        "length": (slices["end"] - slices["start"]).to_list(),
        "used": slices["execution_ns"].to_list(),
        "unended": np.flatnonzero(~slices["ended"].to_numpy()).tolist(),
        "windows": np.column_stack([began - zero, ended - zero]).tolist(),
        "cycles": _cycles(measurement, timeline, kept, lanes, zero),
        "of": traversals.height,
        "chosen": _chosen(traversals),
        "stalls": _stalls(timeline, began, ended, zero),
        "watched": measurement.longest_stall_ns is not None,
        "assumed": bool(timeline.origins["assumed"].any()),
        "servers": _servers(measurement.plan),
    }


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


def _kept_cycles(traversals: pl.DataFrame, slices: int, asked: Sequence[int]) -> list[int]:
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


def _windows(kept: pl.DataFrame, timeline: Timeline) -> tuple[Times, Times]:
    """From a little before each cycle to a little behind its output's reception; merged."""
    slots = timeline.slots.group_by("traversal").agg(closes=pl.col("end").max())
    rows = kept.join(slots, on="traversal", how="left", maintain_order="left")
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


def _cycles(
    measurement: Measurement,
    timeline: Timeline,
    kept: Sequence[int],
    lanes: pl.DataFrame,
    zero: int,
) -> list[dict[str, Any]]:
    """Each kept cycle; its hops ``[lane, take, start, publish, end]`` count from its start."""
    cycles = measurement.analysis.traversals.filter(pl.col("traversal").is_in(kept))
    times = (pl.col(name) - pl.col("begun") for name in ("take", "start", "publish", "end"))
    hops = (
        measurement.analysis.hops.join(cycles.select("traversal", begun="start"), on="traversal")
        .join(timeline.slices.select("instance", "pid", "tid"), on="instance", how="left")
        .join(lanes, on=["pid", "tid"], how="left")
        .sort("traversal", "hop")
        .select("traversal", "lane", *times)
    )
    hops_of: dict[int, list[list[int | None]]] = {}
    for traversal, *hop in hops.iter_rows():
        hops_of.setdefault(traversal, []).append(hop)
    origins = timeline.origins.select("traversal", "origin")
    held = timeline.holds.unique("traversal", keep="last", maintain_order=True)
    rows = cycles.join(origins, on="traversal", how="left", maintain_order="left").join(
        held.select("traversal", "arrival", "let_go", "overrun"),
        on="traversal",
        how="left",
        maintain_order="left",
    )
    found = []
    for row in rows.iter_rows(named=True):
        number, start = row["traversal"], row["start"]
        cycle = {"n": number, "start": start - zero, "hops": hops_of.get(number, [])}
        if row["complete"]:
            cycle["latency"] = row["latency_ns"]
        else:
            cycle["reason"] = f"{row['reason']} ({row['broken_at']})"
        if row["disturbed"]:
            cycle["disturbed"] = 1
        for name in ("received", "origin"):
            if row[name] is not None:
                cycle[name] = row[name] - start
        if row["arrival"] is not None:
            cycle["held"] = [row["arrival"] - start, row["let_go"] - start, row["overrun"]]
        found.append(cycle)
    return found


def _stalls(timeline: Timeline, began: Times, ended: Times, zero: int) -> list[list[int]]:
    inside = _inside(timeline.stalls.sort("start"), began, ended)
    lasted = pl.col("end") - pl.col("start")
    rows = inside.select(pl.col("core").fill_null(-1), pl.col("start") - zero, lasted)
    return [list(row) for row in rows.iter_rows()]


def _servers(plan: Plan | None) -> list[list[Any]]:
    servers = () if plan is None else plan.servers
    return [
        [server.name, f"core {server.core}, priority {server.priority}", server.slots]
        for server in servers
    ]
