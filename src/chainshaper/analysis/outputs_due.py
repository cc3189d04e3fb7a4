"""Which outputs of a chain were due while it was recorded, whether they came or not.

Every traversal owes an output, except

* a traversal under way when the recording, or the plan's time in force, ended, whose output was due
  later;
* one that met a lifecycle node that was not active, or whose message a timer or a synchroniser did
  not use because it had a newer one (:data:`~.traversals.OWES_NO_OUTPUT`);
* one whose message a gate replaced by a newer one of its cycle, as its plan has it (``messages``).

With a plan, a chain that a timer begins owes an output in each cycle, also if it did not begin: the
timer skipped an expiry, or the node died. Such cycles show where the chain's beginnings fall behind
by whole cycles and stay behind. When an application ends, its nodes end one by one: so in the last
tenth of a recording, 3 s at most, no beginning is missed.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.disturbance import Due, timer_period
from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.traversals import OWES_NO_OUTPUT
from chainshaper.values.application import Chain

ENDING_NS = 3_000_000_000  # how long an application takes to end,
ENDING_PART = 10  # but at most this part of a recording (a tenth)
_CATCHES_UP = 8  # a chain that was delayed catches up within so many beginnings
_AS_PLANNED = ["replaced", "surplus"]  # "surplus" is in older recordings


def with_outputs_due(
    flow: DataFlow,
    frame: pl.DataFrame,
    releases: pl.DataFrame,
    limit_ns: int | None,
    until_ns: int | None,
) -> pl.DataFrame:
    """Add the column ``was_due`` to the frame of traversals.

    ``limit_ns`` is how long after the chain's beginning an output must be out (None: the longest
    latency counts). ``until_ns`` is when the plan was released (None: not before the recording
    ended).
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


def _running_until(flow: DataFlow, since_ns: int, until_ns: int | None) -> int:
    """Return the instant until which every node ran, unless it ended by itself (ns).

    It is that of a run that ended with its recording.
    """
    times = flow.instances["start"]
    times = times.filter(times >= since_ns)
    times = times if until_ns is None else times.filter(times <= until_ns)
    first, last = int(times.min() or 0), int(times.max() or 0)
    return last - min(ENDING_NS, (last - first) // ENDING_PART)


def not_begun(
    flow: DataFlow,
    chain: Chain,
    due: Due,
    between: tuple[int, int | None] | None,
    pauses: Sequence[tuple[int, int]] = (),
) -> int:
    """Count the cycles of a plan, after the first, in which a chain did not begin.

    Cycles in which its first callback ran and published nothing do not count, nor do those in
    ``pauses``, each from an instant until another (ns), in which nothing ran. A chain that a
    message begins owes nothing without one: the number is 0.
    """
    if timer_period(flow, chain) is None:
        return 0
    starts = flow.instances.filter(pl.col("callback_id") == chain.callbacks[0])["start"].sort()
    since_ns, until_ns = between or (0, None)
    total, from_ns = 0, since_ns
    for paused_ns, resumed_ns in pauses:  # each run by itself
        running_until = _running_until(flow, from_ns, paused_ns)
        total += _not_begun_between(starts, due, from_ns, paused_ns + 1, running_until)
        from_ns = resumed_ns
    running_until = _running_until(flow, from_ns, None) if until_ns is None else until_ns
    return total + _not_begun_between(starts, due, from_ns, until_ns, running_until)


def _not_begun_between(
    starts: pl.Series, due: Due, since_ns: int, until_ns: int | None, running_until_ns: int
) -> int:
    """Count the cycles that did not begin, from one instant until another."""
    starts = starts.filter(starts >= since_ns)
    starts = starts if until_ns is None else starts.filter(starts < until_ns)
    if not len(starts):
        return 0
    behind = starts.to_numpy() - np.arange(len(starts)) * due.cycle_ns
    skipped = int(_stays_behind(behind, due.cycle_ns).sum())
    quiet = running_until_ns - int(starts[-1]) - due.cycles * due.cycle_ns
    return skipped + max(0, round(quiet / due.cycle_ns - 1))


def _stays_behind(behind: npt.NDArray[np.int64], cycle_ns: int) -> npt.NDArray[np.int64]:
    """Return by how many whole cycles each beginning, and all later ones, fall behind."""
    ahead = np.append(behind[1:], np.full(_CATCHES_UP, behind[-1]))
    least = np.lib.stride_tricks.sliding_window_view(ahead, _CATCHES_UP)[: len(behind) - 1]
    rise = least.min(axis=1) - behind[:-1]
    whole: npt.NDArray[np.int64] = np.rint(rise / cycle_ns).astype(np.int64).clip(min=0)
    return whole
