"""The periods and phases of timers, as their callbacks started."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import polars as pl

from chainshaper.analysis.occupation import Occupation
from chainshaper.values.application import Callback

EVIDENCE = 10  # so many cases a figure is measured from
_NEXT_NS = 100_000  # so close behind an end on its thread, a start was waiting for that
_EXACT_PPM = 20  # a timer whose starts drift by more against its period has another one
_USUALLY = 0.1  # the quantile of starts behind expiries that is how far they are behind


class Expiry(NamedTuple):
    """When a timer expires."""

    period_ns: int
    at_ns: int  # one of the instants


def expiry_of(callback: Callback, instances: pl.DataFrame) -> Expiry:
    """Return when a timer expires, by the instances of its callback."""
    starts = instances["start"].sort().to_numpy().astype(np.int64)
    apart = int(np.median(np.diff(starts))) if len(starts) > 1 else 0
    period = callback.period_ns or max(1_000, round(apart, -3))
    number = np.rint((starts - starts[0]) / period).astype(np.int64)
    behind = starts - number * period
    third = len(starts) // 3
    if third >= EVIDENCE and number[-1] > number[0]:
        drift = np.median(behind[-third:]) - np.median(behind[:third])
        drift /= max(1.0, float(np.mean(number[-third:]) - np.mean(number[:third])))
        if abs(drift) > _EXACT_PPM * 1e-6 * period:
            period += round(drift)
            behind = starts - number * period
    # Starts come later than expiries, by a little as a rule.
    return Expiry(period, int(np.quantile(behind, _USUALLY)))


def blocker_of(
    callbacks: Mapping[int, Callback], occupied: Occupation, instances: pl.DataFrame
) -> int | None:
    """Return the timer's callback behind which these instances start as a rule, on one thread."""
    every = occupied.instances.drop_nulls("end").sort("end")
    last = (
        instances.select("pid", "tid", "start")
        .sort("start")
        .join_asof(
            every.select("pid", "tid", "callback_id", end="end"),
            left_on="start",
            right_on="end",
            by=["pid", "tid"],
            strategy="backward",
            check_sortedness=False,
        )
    )
    close = last.filter(pl.col("start") - pl.col("end") < _NEXT_NS)["callback_id"]
    if not len(close) or 2 * len(close) <= len(instances):
        return None
    blocker = int(close.mode()[0])
    return blocker if callbacks[blocker].kind == "timer" else None
