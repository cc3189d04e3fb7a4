"""Which outputs of a chain were due while it was recorded, whether they came or not.

An output is due for every traversal, but for

* one that was under way as the recording, or the plan's time in force, ended: it was to be out
  later than that;
* one of a lifecycle node that was not active, or of a message of which a timer or a synchroniser
  used a newer one (:data:`~.traversals.OWES_NO_OUTPUT`);
* one that a gate replaced by another of its cycle, or let another go first, as its plan has it
  (``messages``).

With a plan an output of a chain that a timer begins is due in each cycle, also in one in which it
did not begin: a timer that skipped its expiry, a node that died. How often a chain did not begin
shows where its beginnings fall behind by whole cycles and stay there. As an application ends, its
nodes do so one by one: beginnings are not missed in the last tenth of a recording, 3 s at most.
"""

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.disturbance import Due, timer_period
from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.traversals import OWES_NO_OUTPUT
from chainshaper.values.application import Chain

ENDING_NS = 3_000_000_000  # in so long an application ends,
ENDING_PART = 10  # or in such a part of a short recording
_CATCHES_UP = 8  # beginnings in which one that was delayed catches up
_AS_PLANNED = ["replaced", "surplus"]  # "surplus": in recordings of before


def with_outputs_due(
    flow: DataFlow,
    frame: pl.DataFrame,
    releases: pl.DataFrame,
    limit_ns: int | None,
    until_ns: int | None,
) -> pl.DataFrame:
    """The frame of traversals with the column ``was_due``.

    ``limit_ns`` is how long after its beginning an output is to be out (None: as long as the
    longest took), ``until_ns`` when the plan was released (None: not before the recording ended).
    """
    ended = int(flow.instances["start"].max() or 0) if until_ns is None else until_ns  # type: ignore[arg-type]
    longest = frame["latency_ns"].max() or 0
    limit = longest if limit_ns is None else limit_ns
    replaced = releases.filter(pl.col("dropped").is_in(_AS_PLANNED))["traversal"]
    reason = pl.col("reason").cast(pl.String)
    expected = (reason == "discarded") | (pl.col("start") + limit <= ended)
    owes_none = reason.is_in(OWES_NO_OUTPUT).fill_null(False)
    due = pl.col("complete") | (expected & ~owes_none)
    as_planned = pl.col("traversal").is_in(replaced.implode()) & ~pl.col("complete")
    return frame.with_columns(was_due=(due & ~as_planned).fill_null(False))


def _running_until(flow: DataFlow, until_ns: int | None) -> int:
    """Until when every node of an application ran, as far as none ended by itself."""
    if until_ns is not None:
        return until_ns
    times = flow.instances["start"]
    first, last = int(times.min() or 0), int(times.max() or 0)  # type: ignore[arg-type]
    return last - min(ENDING_NS, (last - first) // ENDING_PART)


def not_begun(
    flow: DataFlow,
    chain: Chain,
    due: Due,
    between: tuple[int, int | None] | None,
) -> int:
    """In how many cycles of a plan a chain that a timer begins did not begin, after it first had.

    Cycles in which its first callback ran and published nothing are not among them. Where a message
    begins the chain nothing was due without one.
    """
    if timer_period(flow, chain) is None:
        return 0
    own = flow.instances.filter(pl.col("callback_id") == chain.callbacks[0])["start"].sort()
    since_ns, until_ns = between or (0, None)
    own = own.filter(own >= since_ns)
    own = own if until_ns is None else own.filter(own < until_ns)
    if not len(own):
        return 0
    behind = own.to_numpy() - np.arange(len(own)) * due.cycle_ns
    skipped = int(_stays_behind(behind, due.cycle_ns).sum())
    quiet = _running_until(flow, until_ns) - int(own[-1]) - due.cycles * due.cycle_ns
    return skipped + max(0, round(quiet / due.cycle_ns - 1))


def _stays_behind(behind: npt.NDArray[np.int64], cycle_ns: int) -> npt.NDArray[np.int64]:
    """By how many whole cycles each beginning, and those after it, are behind the one before."""
    ahead = np.append(behind[1:], np.full(_CATCHES_UP, behind[-1]))
    least = np.lib.stride_tricks.sliding_window_view(ahead, _CATCHES_UP)[: len(behind) - 1]
    rise = least.min(axis=1) - behind[:-1]
    whole: npt.NDArray[np.int64] = np.rint(rise / cycle_ns).astype(np.int64).clip(min=0)
    return whole
