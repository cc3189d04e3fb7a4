"""What the report's charts draw, as plain data: small enough for a page, exact where it counts.

A screen has some thousand columns of pixels. Of many more cycles, the chart over time keeps of
every stretch the shortest and the longest, so that no extreme is lost, and of the others every
n-th, so that their density is not distorted; the histogram counts
all cycles in bins so fine that they are joined for every drawing. Times are integer ns, counted
from the first cycle's start.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from chainshaper.planning import Plan, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.reporting.breakdown import PARTS, hop_breakdown
from chainshaper.reporting.html.cycles import timeline_data
from chainshaper.reporting.html.told import Told

__all__ = ["latency_histogram", "latency_points", "plan_drawing", "recording_data"]

POINTS = 4_000
"""Points of the chart over time, per recording."""

BINS = 10_000
"""Fine bins over a recording's latencies at most."""


def recording_data(told: Told, cycles: Sequence[int]) -> dict[str, Any]:
    """Everything that is drawn of one recording; ``cycles`` are kept in the timeline anyway."""
    measurement = told.measurement
    starts = measurement.analysis.traversals["start"]
    zero = int(starts[0]) if len(starts) else 0
    return {
        "name": told.name,
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
        "timeline": timeline_data(measurement, told.timeline, cycles, zero),
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
