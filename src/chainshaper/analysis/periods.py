"""Periods of timers that their callbacks' starts show, where these differ from the declared ones.

The event of a timer's creation has its period. A program can change it at run time, which no event
shows, and some libraries trace it in another unit. rclcpp keeps to the grid of the period however
late single starts are, so the number of starts in a span shows the period. Starts may be rarer for
other reasons: the executor is busy when the timer is due, or the timer is cancelled or reset. These
do not count as another period. That needs regular starts before which the thread waited although
the declared period was over.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

FEWEST = 8
"""How many distances between starts are needed for a verdict."""
_SAME = 0.02  # share of a period by which another one may differ and still be the same
REGULAR = 0.1  # share of the usual distance of starts by which regular ones may differ from it
MOSTLY = 0.8  # the share of starts that must be regular, or come after waiting
_IDLE = 0.1  # share of the period for which a thread that waited had nothing to do
_CLOCKS = 1e-4  # how far the clock of timers and that of events may run apart


@dataclass(frozen=True)
class ShownPeriod:
    """The period that a timer's starts show, where it differs from the declared one."""

    callback_id: int
    node: str
    declared_ns: int
    usual_ns: int  # median distance of its starts
    period_ns: int | None  # None: starts come more often than declared, but not regularly
    starts: int  # their number
    first_ns: int  # instant of the first


def shown_periods(
    callbacks: pl.DataFrame, instances: pl.DataFrame, taken: pl.DataFrame
) -> Iterator[ShownPeriod]:
    """Find the timers whose starts contradict their declared period.

    Timers of nodes that take `/clock` are left out: they have the pace of the simulation.
    """
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
        regular = float(np.mean(np.abs(apart - usual) <= REGULAR * usual)) >= MOSTLY
        if not often and not (
            rare and regular and _waited_in_vain(callbacks, instances, number, declared, usual)
        ):
            continue
        period = roundest_period(apart, usual) if regular else None
        yield ShownPeriod(
            callback_id=number,
            node=node,
            declared_ns=declared,
            usual_ns=round(usual),
            period_ns=period,
            starts=len(starts),
            first_ns=int(starts[0]),
        )


def _off_their_grid(
    timers: pl.DataFrame, instances: pl.DataFrame
) -> Iterator[tuple[int, str, int]]:
    """Find timers whose number of starts does not fit their period: id, node and period (ns)."""
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
    off_grid = counted.join(timers.lazy(), on="callback_id").filter(off, pl.col("count") >= FEWEST)
    columns = ("callback_id", "node", "period_ns")
    return off_grid.sort("callback_id").select(columns).collect().iter_rows()


def _too_often(starts: npt.NDArray[np.int64], declared: int) -> bool:
    """Return whether there are more starts than a timer of this period has in their span."""
    span, count = float(starts[-1] - starts[0]), len(starts) - 1
    return span < count * declared * (1 - _SAME) - declared


def _waited_in_vain(
    callbacks: pl.DataFrame, instances: pl.DataFrame, timer: int, declared: int, usual: float
) -> bool:
    """Return whether most starts came late although their thread and their node had nothing to do.

    Late means: the declared period was over since the start before.
    """
    nodes = callbacks.unique("callback_id").select("callback_id", "node")
    of_timer = pl.col("callback_id") == timer
    beside = instances.filter(of_timer)["tid"].unique().implode()
    node = nodes.filter(of_timer).select(pl.col("node").cast(pl.String)).item()
    of_node = nodes.filter(pl.col("node").cast(pl.String).eq_missing(pl.lit(node, pl.String)))
    rows = instances.filter(
        pl.col("tid").is_in(beside) | pl.col("callback_id").is_in(of_node["callback_id"].implode())
    ).join(nodes, on="callback_id", how="left", maintain_order="left")
    rows = rows.with_columns(over=pl.coalesce("end", "start"))
    rows = rows.with_columns(
        pl.col("over").shift(1).over("pid", key).alias(f"over_{key}") for key in ("tid", "node")
    )
    due = pl.col("start").shift(1) + declared
    free = pl.max_horizontal(due, "over_tid", "over_node")
    waited = (pl.col("start") - free > _IDLE * usual).filter(due.is_not_null())
    return float(rows.filter(of_timer).select(waited.mean()).item() or 0.0) >= MOSTLY


def roundest_period(apart: npt.NDArray[np.int64], usual: float) -> int:
    """Return the roundest period (ns) that agrees with the distances of regular starts."""
    cycles = int(np.maximum(1, np.round(apart / usual)).sum())
    mean = float(apart.sum() / cycles)
    low, high = np.percentile(apart, (10, 90))
    unsure = float(high - low) / len(apart) + _CLOCKS * mean
    for digits in range(9, -1, -1):
        rounded = int(round(mean / 10**digits) * 10**digits)
        if rounded and abs(rounded - mean) <= unsure:
            return rounded
    return round(mean)
