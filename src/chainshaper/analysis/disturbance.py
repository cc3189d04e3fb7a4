"""Which traversals the machine itself disturbed.

Virtual machines and firmware stop all threads of a core now and then, for up to several ms. A
sleeper at the highest priority, run beside the application, sees it: a row of `machine_stall`
says that on core ``cpu`` no thread ran from ``time`` for ``duration``. A latency measured across a
stall says something about the machine, not about the application.

A cycle is disturbed by stalls **before the moment at which its output was due** (`due_at` of
:mod:`~chainshaper.analysis.punctuality`), and by no other: what happens to an output that is late
already, and waits for a later slot, is no excuse for it. Whether it was late plays no part:

* **At two instants** any stall disturbs what a gate lets go: where the origin is taken (between the
  traversal's start and the anchor's origin), and around the moment at which the output was due.
* **In between** stalls add up, on one core, within [start, due]. Without a gate they disturb from
  ``COMPUTING_THRESHOLD_NS`` in all. A gate absorbs what the plan's margin ε has room for, whatever
  the cycle's own latency: only more than that disturbs.
* A traversal that began before its disturbed predecessor was computed may have queued behind it,
  and counts as disturbed with it, unless the plan has them overlap (logical execution time).

A core can also run without a stall, and yet at half its **pace**: a neighbour of a virtual machine
uses the same hardware, caches are cold, the clock is throttled. Each wake-up of the stall meter is
the same work; `machine_pace` says what CPU time it took. A pace is relative to an ordinary one: 2
means that everything takes twice as long.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.gate.decision import STALL_NS
from chainshaper.values import events
from chainshaper.values.events import EventTables

__all__ = [
    "COMPUTING_THRESHOLD_NS",
    "disturbed",
    "ordinary_pace",
    "overlapping",
    "relative_pace",
    "stalled_after",
    "stalled_within",
]


def ordinary_pace(tables: EventTables) -> dict[int, float]:
    """The median CPU time of a wake-up on each core that was watched (ns)."""
    frame = events.table(tables, "machine_pace", ["cpu"])
    medians = frame.group_by("cpu").median().select("cpu", "cpu_time").iter_rows()
    return {core: median for core, median in medians if median}


def relative_pace(
    tables: EventTables,
    start: npt.NDArray[np.int64],
    end: npt.NDArray[np.int64],
    ordinary: Mapping[int, float],
) -> npt.NDArray[np.float64]:
    """Per core of ``ordinary`` a row: the mean pace in each window [start, end) of ``start``.

    Not a number where the core was not watched. A window begins with the stretch of wake-ups that
    was under way.
    """
    frame = events.table(tables, "machine_pace", ["cpu"]).sort("time")
    rows = []
    for core, usual in ordinary.items():
        time, cpu_time = (
            frame.filter(cpu=core)[column].to_numpy() for column in ("time", "cpu_time")
        )
        first = np.maximum(np.searchsorted(time, start, side="right") - 1, 0)
        behind = np.searchsorted(time, end, side="left")
        total = np.concatenate(([0], np.cumsum(cpu_time)))
        count = behind - first
        used = np.where(count > 0, total[behind] - total[np.minimum(first, behind)], np.nan)
        rows.append(used / np.maximum(count, 1) / usual)
    return np.array(rows).reshape(len(ordinary), len(start))


WAKING_NS = 200_000
"""A gate wakes up and publishes within this time of a release: a stall this shortly before or
behind the release moves the output."""

COMPUTING_THRESHOLD_NS = 1_000_000
"""A chain that computes for tens of milliseconds is hardly changed by less than this."""

Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Stalls:
    """Stalls as intervals [began, ended) on cores."""

    began: Times
    ended: Times
    core: Times

    @classmethod
    def of(cls, flow: DataFlow, threshold_ns: int) -> "_Stalls":
        table = events.table(flow.events, "machine_stall", ["cpu"]).filter(
            pl.col("duration") >= threshold_ns
        )
        began = table["time"].to_numpy()
        core = table["cpu"].fill_null(-1).cast(pl.Int64).to_numpy()
        return cls(began, began + table["duration"].to_numpy(), core)


def disturbed(
    flow: DataFlow,
    frame: pl.DataFrame,
    margin_ns: int = 0,
    *,
    threshold_ns: int = STALL_NS,
    computing_threshold_ns: int = COMPUTING_THRESHOLD_NS,
    waking_ns: int = WAKING_NS,
) -> Mask:
    """A mask over the rows of ``frame``; incomplete traversals are never marked.

    ``frame`` is that of :func:`~chainshaper.analysis.punctuality.with_punctuality`, ``margin_ns``
    the margin of the plan in force.
    """
    stalls = _Stalls.of(flow, threshold_ns)
    if not len(stalls.began):
        return np.zeros(frame.height, dtype=np.bool_)
    complete, gated = frame["complete"].to_numpy(), frame["origin"].is_not_null().to_numpy()
    start, due, origin, computed = (
        frame[name].fill_null(frame["start"]).to_numpy()
        for name in ("start", "due_at", "origin", "computed_at")
    )
    first, last = np.minimum(start, origin), np.maximum(start, origin)
    at_instants = overlapping(first, last, stalls.began, stalls.ended)
    at_instants |= overlapping(due - waking_ns, due + waking_ns, stalls.began, stalls.ended)
    lost = stalled_within(start, due, stalls.began, stalls.ended, stalls.core)
    most = np.where(gated, max(computing_threshold_ns, margin_ns + 1), computing_threshold_ns)
    hit = complete & ((gated & at_instants) | (lost >= most))
    # A predecessor that was to be out later than the next began is not waited for.
    following = np.append(start[1:], np.iinfo(np.int64).max) if len(start) else start
    busy_until = np.where(gated & (due > following), start, computed)
    return complete & (hit | _queued_behind(hit, start, busy_until, complete))


def stalled_after(flow: DataFlow, start: Times, end: Times, threshold_ns: int = STALL_NS) -> Mask:
    """Which windows [start, end] any stall meets: a delivery that the machine disturbed."""
    stalls = _Stalls.of(flow, threshold_ns)
    return overlapping(start, end, stalls.began, stalls.ended)


def _queued_behind(hit: Mask, start: Times, busy_until: Times, may_queue: Mask) -> Mask:
    """Traversals, in order of start, linked to a disturbed one by predecessors still computed."""
    if not len(start):
        return hit
    linked = np.zeros(len(start), dtype=np.bool_)
    linked[1:] = may_queue[1:] & (start[1:] < np.maximum.accumulate(busy_until)[:-1])
    position = np.arange(len(start))
    run_start = np.maximum.accumulate(np.where(linked, 0, position))
    last_hit = np.maximum.accumulate(np.where(hit, position, -1))
    return np.asarray(last_hit >= run_start, dtype=np.bool_)


def stalled_within(start: Times, end: Times, began: Times, ended: Times, core: Times) -> Times:
    """Per window [start, end] the time lost in it to stalls of one core, the worst one (ns).

    Stalls of one core do not overlap, so what they took up to an instant is a running sum plus
    the part of the stall that the instant lies in; a window's share is a difference of two.
    """
    worst = np.zeros(len(start), dtype=np.int64)
    for one in np.unique(core):
        mine = core == one
        order = np.argsort(began[mine], kind="stable")
        first, length = began[mine][order], (ended - began)[mine][order]
        total = np.concatenate(([0], np.cumsum(length)))

        def lost_until(
            instant: Times, first: Times = first, length: Times = length, total: Times = total
        ) -> Times:
            index = np.searchsorted(first, instant, side="right")
            before = np.maximum(index - 1, 0)
            part = np.minimum(instant - first[before], length[before])
            return np.asarray(total[before] + np.where(index > 0, part, 0), dtype=np.int64)

        worst = np.maximum(worst, lost_until(end) - lost_until(start))
    return worst


def overlapping(start: Times, end: Times, began: Times, ended: Times) -> npt.NDArray[np.bool_]:
    """Whether each closed window [start, end] meets any of the intervals [began, ended).

    Of all intervals those that begin in time for the window, minus those that are over before
    it: both are counted in sorted arrays, so the cost is (windows + intervals) · log.
    """
    begun_by_end = np.searchsorted(np.sort(began), end, side="right")
    over_by_start = np.searchsorted(np.sort(ended), start, side="right")
    return np.asarray(begun_by_end > over_by_start, dtype=np.bool_)
