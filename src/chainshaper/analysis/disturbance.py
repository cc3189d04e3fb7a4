"""Which traversals the machine itself disturbed.

Virtual machines and firmware stop all threads of a core now and then, for up to several ms. A
sleeper at the highest priority, run beside the application, sees it: a row of `machine_stall`
says that on core ``cpu`` nobody ran from ``time`` for ``duration``. A latency measured across a
stall says something about the machine, not about the application.

What a stall does to a traversal depends on whether a gate held its output (`gate_release`):

* **A gate** makes two instants decide the latency: when the origin was taken (between the
  traversal's start and the anchor's origin), and from shortly before the planned release to the
  publication. Any stall at one of them disturbs. While the message was held, a stall only
  shortened the wait.
* **Not held**: no gate, or the message came in or behind its slot. Stalls while it was computed
  add up, and disturb it from ``COMPUTING_THRESHOLD_NS`` in all: on one core, within [start, end].
  A traversal that began before its disturbed predecessor had ended may have queued behind it,
  and counts as disturbed with it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import events
from chainshaper.analysis.departures import gate_decisions
from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.traversals import Traversals
from chainshaper.enforcement.gate import STALL_NS

__all__ = [
    "COMPUTING_THRESHOLD_NS",
    "disturbed",
    "overlapping",
    "stalled_after",
    "stalled_within",
]

WAKING_NS = 200_000
"""A stall that ends this shortly before a release leaves the gate no time to wake up for it."""

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
    traversals: Traversals,
    threshold_ns: int = STALL_NS,
    computing_threshold_ns: int = COMPUTING_THRESHOLD_NS,
    waking_ns: int = WAKING_NS,
) -> Mask:
    """A mask over the rows of ``traversals.frame``; incomplete traversals are never marked."""
    stalls = _Stalls.of(flow, threshold_ns)
    if not len(stalls.began):
        return np.zeros(traversals.frame.height, dtype=np.bool_)
    frame = traversals.frame.join(
        _releases(flow, traversals), on="traversal", how="left", maintain_order="left"
    )
    complete = frame["complete"].to_numpy()
    start, end = frame["start"].to_numpy(), frame["end"].fill_null(0).to_numpy()
    gated, held = (
        frame["release"].is_not_null().to_numpy(),
        frame["held"].fill_null(False).to_numpy(),
    )
    release, origin = (frame[name].fill_null(0).to_numpy() for name in ("release", "origin"))
    first, last = np.minimum(start, origin), np.maximum(start, origin)
    at_instants = overlapping(first, last, stalls.began, stalls.ended)
    at_instants |= overlapping(release - waking_ns, end, stalls.began, stalls.ended)
    lost = stalled_within(start, end, stalls.began, stalls.ended, stalls.core)
    hit = complete & ((gated & at_instants) | (~held & (lost >= computing_threshold_ns)))
    return complete & (hit | _queued_behind(hit, start, end, ~held & complete))


def stalled_after(flow: DataFlow, start: Times, end: Times, threshold_ns: int = STALL_NS) -> Mask:
    """Which windows [start, end] any stall meets: a delivery that the machine disturbed."""
    stalls = _Stalls.of(flow, threshold_ns)
    return overlapping(start, end, stalls.began, stalls.ended)


def _queued_behind(hit: Mask, start: Times, end: Times, may_queue: Mask) -> Mask:
    """Traversals, in order of start, linked to a disturbed one by predecessors still under way."""
    if not len(start):
        return hit
    linked = np.zeros(len(start), dtype=np.bool_)
    linked[1:] = may_queue[1:] & (start[1:] < np.maximum.accumulate(end)[:-1])
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


def _releases(flow: DataFlow, traversals: Traversals) -> pl.DataFrame:
    """``traversal, release, origin, held`` of those whose last hop was a gate.

    The gate's row is found by its callback and the source timestamp of the message. ``held`` are
    messages that came before their slot in their own cycle.
    """
    last = len(traversals.chain.callbacks) - 1
    arrived = traversals.hops.filter(pl.col("hop") == last).select(
        "traversal", "callback_id", "source_timestamp"
    )
    in_time = (pl.col("cycles_waited") == 0) & (pl.col("arrival") < pl.col("release"))
    released = (
        gate_decisions(flow.events, flow.objects)
        .select("callback_id", "source_timestamp", "release", "origin", held=in_time)
        .unique(["callback_id", "source_timestamp"], keep="last", maintain_order=True)
    )
    return arrived.join(released, on=["callback_id", "source_timestamp"], how="inner").select(
        "traversal", "release", "origin", "held"
    )
