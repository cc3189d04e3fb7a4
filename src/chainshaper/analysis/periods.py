"""Periods of timers as their callbacks' starts show them, where they are not those declared.

A timer says its period once, when it is created. It can be changed at run time, of which no event
tells, or a library traces it in another unit. rclcpp keeps to the grid of the period however late
single starts are, so that their number in a time tells. Starts may be rarer for other reasons: the
executor is busy when the timer is due, it is cancelled, or reset. Those are no other period: it
takes regular starts for which the thread waited although the declared period was over.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

FEWEST = 8
"""So many distances of starts it takes to say something."""
_SAME = 0.02  # by this share a period may be off
_REGULAR = 0.1  # by this share of the usual one, distances of starts are off at most
_MOSTLY = 0.8  # so many of them
_IDLE = 0.1  # for this share of its period a thread waits in vain
_CLOCKS = 1e-4  # so far may the clock of timers and that of events run apart


@dataclass(frozen=True)
class OtherPeriod:
    """A timer's callback whose starts contradict the declared period.

    ``period_ns`` is what they show; None: they come more often than declared, but not regularly.
    """

    callback_id: int
    node: str
    declared_ns: int
    usual_ns: int
    period_ns: int | None
    starts: int
    first_ns: int


def other_periods(
    callbacks: pl.DataFrame, instances: pl.DataFrame, taken: pl.DataFrame
) -> Iterator[OtherPeriod]:
    """The timers whose starts contradict their period; nodes that follow `/clock` have its pace."""
    timers = callbacks.filter(pl.col("kind") == "timer", pl.col("period_ns") > 0)
    simulated = taken.filter(topic="/clock")["node"].unique().cast(pl.String)
    timers = timers.filter(~pl.col("node").is_in(simulated.implode()))
    timers = timers.unique("callback_id", keep="first", maintain_order=True)
    for number, node, declared in _off_their_grid(timers, instances):
        starts = instances.filter(pl.col("callback_id") == number)["start"].sort().to_numpy()
        apart = np.diff(starts)
        usual = float(np.median(apart))
        often = _too_often(starts, declared)
        rare = usual > declared * (1 + _SAME) and not often
        regular = float(np.mean(np.abs(apart - usual) <= _REGULAR * usual)) >= _MOSTLY
        if not often and not (
            rare and regular and _waited_in_vain(callbacks, instances, number, declared, usual)
        ):
            continue
        period = _period(apart, usual) if regular else None
        yield OtherPeriod(number, node, declared, round(usual), period, len(starts), int(starts[0]))


def _off_their_grid(
    timers: pl.DataFrame, instances: pl.DataFrame
) -> Iterator[tuple[int, str, int]]:
    """``callback_id, node, period_ns`` of timers whose number of starts does not fit the period."""
    start = pl.col("start")
    started = instances.lazy().select("callback_id", "start")
    started = started.join(timers.lazy().select("callback_id"), on="callback_id", how="semi")
    counted = started.group_by("callback_id").agg(
        count=pl.len() - 1, span=start.max() - start.min()
    )
    declared, expected = pl.col("period_ns"), pl.col("count") * pl.col("period_ns")
    off = (pl.col("span") < expected * (1 - _SAME) - declared) | (
        pl.col("span") > expected * (1 + _SAME) + declared
    )
    found = counted.join(timers.lazy(), on="callback_id").filter(off, pl.col("count") >= FEWEST)
    columns = ("callback_id", "node", "period_ns")
    return found.sort("callback_id").select(columns).collect().iter_rows()


def _too_often(starts: npt.NDArray[np.int64], declared: int) -> bool:
    """Whether there are more starts than a timer of this period has in the time."""
    span, count = float(starts[-1] - starts[0]), len(starts) - 1
    return span < count * declared * (1 - _SAME) - declared


def _waited_in_vain(
    callbacks: pl.DataFrame, instances: pl.DataFrame, timer: int, declared: int, usual: float
) -> bool:
    """Whether before a start, as a rule, neither its thread nor its node had anything to do, though
    the declared period was over."""
    nodes = callbacks.unique("callback_id").select("callback_id", "node")
    rows = instances.join(nodes, on="callback_id", how="left", maintain_order="left")
    rows = rows.with_columns(over=pl.coalesce("end", "start"))
    rows = rows.with_columns(
        pl.col("over").shift(1).over("pid", key).alias(f"over_{key}") for key in ("tid", "node")
    )
    own = rows.filter(pl.col("callback_id") == timer)
    due = pl.col("start").shift(1) + declared
    free = pl.max_horizontal(due, "over_tid", "over_node")
    waited = (pl.col("start") - free > _IDLE * usual).filter(due.is_not_null())
    return float(own.select(waited.mean()).item() or 0.0) >= _MOSTLY


def _period(apart: npt.NDArray[np.int64], usual: float) -> int:
    """The roundest period that the distances of regular starts agree with (ns)."""
    cycles = int(np.maximum(1, np.round(apart / usual)).sum())
    mean = float(apart.sum() / cycles)
    low, high = np.percentile(apart, (10, 90))
    unsure = float(high - low) / len(apart) + _CLOCKS * mean
    for digits in range(9, -1, -1):
        rounded = int(round(mean / 10**digits) * 10**digits)
        if rounded and abs(rounded - mean) <= unsure:
            return rounded
    return round(mean)
