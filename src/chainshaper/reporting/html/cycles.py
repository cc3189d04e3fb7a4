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
from chainshaper.steps import Measurement

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
    threads = timeline.threads
    lane_of = {key: lane for lane, key in enumerate(threads.select("pid", "tid").iter_rows())}
    lanes = [lane_of[key] for key in slices.select("pid", "tid").iter_rows()]
    names = {callback.id: callback.label for callback in measurement.analysis.graph.callbacks}
    used = slices["callback_id"].unique().sort().to_list()
    number_of = {callback: number for number, callback in enumerate(used)}
    return {
        "threads": [
            [nodes, about or ""] for nodes, about in threads.select("nodes", "about").iter_rows()
        ],
        "callbacks": [names[callback] for callback in used],
        "lane": lanes,
        "callback": [number_of[callback] for callback in slices["callback_id"]],
        "start": (slices["start"] - zero).to_list(),
        "length": (slices["end"] - slices["start"]).to_list(),
        "used": slices["execution_ns"].to_list(),
        "unended": np.flatnonzero(~slices["ended"].to_numpy()).tolist(),
        "windows": np.column_stack([began - zero, ended - zero]).tolist(),
        "cycles": _cycles(measurement, timeline, kept, lane_of, zero),
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
    lane_of: dict[tuple[Any, ...], int],
    zero: int,
) -> list[dict[str, Any]]:
    """Each kept cycle; its hops ``[lane, take, start, publish, end]`` count from its start."""
    analysis = measurement.analysis
    threads = timeline.slices.select("instance", "pid", "tid")
    hops = (
        analysis.hops.filter(pl.col("traversal").is_in(kept))
        .join(threads, on="instance", how="left", maintain_order="left")
        .sort("traversal", "hop")
    )
    rows: dict[int, list[list[int | None]]] = {}
    begun = dict(analysis.traversals.select("traversal", "start").iter_rows())
    for hop in hops.iter_rows(named=True):
        origin = begun[hop["traversal"]]
        times = [hop[name] for name in ("take", "start", "publish", "end")]
        rows.setdefault(hop["traversal"], []).append(
            [
                lane_of[(hop["pid"], hop["tid"])],
                *(None if time is None else time - origin for time in times),
            ]
        )
    origins = dict(timeline.origins.select("traversal", "origin").iter_rows())
    held = {
        traversal: [arrival, let_go, overrun]
        for traversal, arrival, let_go, overrun in timeline.holds.select(
            "traversal", "arrival", "let_go", "overrun"
        ).iter_rows()
    }
    found = []
    for row in analysis.traversals.filter(pl.col("traversal").is_in(kept)).iter_rows(named=True):
        number, start = row["traversal"], row["start"]
        cycle: dict[str, Any] = {"n": number, "start": start - zero, "hops": rows.get(number, [])}
        if row["complete"]:
            cycle["latency"] = row["latency_ns"]
        else:
            cycle["reason"] = f"{row['reason']} ({row['broken_at']})"
        if row["disturbed"]:
            cycle["disturbed"] = 1
        if row["received"] is not None:
            cycle["received"] = row["received"] - start
        if number in origins:
            cycle["origin"] = origins[number] - start
        if number in held:
            arrival, let_go, overrun = held[number]
            cycle["held"] = [arrival - start, let_go - start, overrun]
        found.append(cycle)
    return found


def _stalls(
    timeline: Timeline,
    began: Times,
    ended: Times,
    zero: int,
) -> list[list[int]]:
    inside = _inside(timeline.stalls.sort("start"), began, ended)
    return [
        [-1 if core is None else core, start - zero, end - start]
        for core, start, end in inside.iter_rows()
    ]


def _servers(plan: Plan | None) -> list[list[Any]]:
    servers = () if plan is None else plan.servers
    return [
        [server.name, f"core {server.core}, priority {server.priority}", server.slots]
        for server in servers
    ]
