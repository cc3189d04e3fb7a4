"""The timeline of chosen cycles, as plain data for the page's script.

Of a short recording all cycles are kept. Of a long one those that somebody looks for: the longest
and the shortest, the median, those without an end, those that were asked for by number, and a
sample of the others. Times are integer ns, counted from the first cycle's start.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.disturbance import overlapping
from chainshaper.planning import Plan
from chainshaper.reporting.timeline import Timeline
from chainshaper.verify.measure import Measurement

__all__ = ["timeline_data"]

CYCLES = 500
SLICES = 20_000
"""How many cycles, and callbacks in them, the timeline of one recording keeps."""

EXTREMES = 20
"""How many of the longest cycles, and of the shortest, are among them in any case."""

Times = npt.NDArray[np.int64]


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
