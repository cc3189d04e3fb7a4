"""Which traversals the machine itself disturbed.

Virtual machines and firmware stop all threads of a core now and then, for up to several ms. A
sleeper at the highest priority, run beside the application, sees it: a row of `machine_stall`
says that on core ``cpu`` nobody ran from ``time`` for ``duration``. A latency measured across a
stall says something about the machine, not about the application.

* A traversal is disturbed when a stall overlaps it: [start, end].
* A traversal that a gate released (`gate_release`) waited for its slot; a stall before the
  release only shortened the wait. Stalls count when they overlap [start, start + guard], where
  the cycle's anchor is taken, or [release − guard, end], where the gate must be awake. If the
  message missed its slot and waited for a later cycle, or a stall made it arrive after the
  planned release, nothing was absorbed and the whole of [start, end] counts.
"""

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import events
from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.traversals import Traversals

__all__ = ["GUARD_NS", "THRESHOLD_NS", "disturbed", "overlapping"]

THRESHOLD_NS = 100_000
"""Stalls shorter than this are what an ordinary wake-up takes."""

GUARD_NS = 500_000
"""Before a release the gate wakes and may spin (300 µs); after the start it stamps the origin."""

Times = npt.NDArray[np.int64]


def disturbed(
    flow: DataFlow,
    traversals: Traversals,
    threshold_ns: int = THRESHOLD_NS,
    guard_ns: int = GUARD_NS,
) -> npt.NDArray[np.bool_]:
    """A mask over the rows of ``traversals.frame``; incomplete traversals are never marked."""
    stalls = events.table(flow.events, "machine_stall").filter(pl.col("duration") >= threshold_ns)
    began = stalls["time"].to_numpy()
    ended = (stalls["time"] + stalls["duration"]).to_numpy()
    frame = traversals.frame.join(
        _releases(flow, traversals), on="traversal", how="left", maintain_order="left"
    )
    complete = frame["complete"].to_numpy()
    start = frame["start"].to_numpy()
    end = frame["end"].fill_null(0).to_numpy()
    absorbed = frame["release"].is_not_null().to_numpy()
    release = frame["release"].fill_null(0).to_numpy()
    anywhere = overlapping(start, end, began, ended)
    at_start = overlapping(start, np.minimum(start + guard_ns, end), began, ended)
    at_release = overlapping(np.maximum(release - guard_ns, start), end, began, ended)
    hit = np.where(absorbed, at_start | at_release, anywhere)
    return np.asarray(hit & complete, dtype=np.bool_)


def overlapping(start: Times, end: Times, began: Times, ended: Times) -> npt.NDArray[np.bool_]:
    """Whether each closed window [start, end] meets any of the intervals [began, ended).

    Of all intervals those that begin in time for the window, minus those that are over before
    it: both are counted in sorted arrays, so the cost is (windows + intervals) · log.
    """
    begun_by_end = np.searchsorted(np.sort(began), end, side="right")
    over_by_start = np.searchsorted(np.sort(ended), start, side="right")
    return np.asarray(begun_by_end > over_by_start, dtype=np.bool_)


def _releases(flow: DataFlow, traversals: Traversals) -> pl.DataFrame:
    """``traversal, release``: the planned release of those whose last hop was a gate.

    The gate's row is found by its callback and the source timestamp of the message it held.
    Messages that were not released as planned have none.
    """
    last = len(traversals.chain.callbacks) - 1
    held = traversals.hops.filter(pl.col("hop") == last).select(
        "traversal", "callback_id", "source_timestamp"
    )
    gates = flow.objects.callbacks.select("pid", "callback_id", callback="handle").unique()
    on_time = (pl.col("cycles_waited").fill_null(0) == 0) & (
        pl.col("arrival").fill_null(pl.col("release")) <= pl.col("release")
    )
    released = (
        events.table(flow.events, "gate_release")
        .filter(on_time)
        .select("pid", "callback", "source_timestamp", "release")
        .join(gates, on=["pid", "callback"], how="inner")
        .unique(["callback_id", "source_timestamp"], keep="last", maintain_order=True)
        .select("callback_id", "source_timestamp", "release")
    )
    return held.join(released, on=["callback_id", "source_timestamp"], how="inner").select(
        "traversal", "release"
    )
