"""Figures about latencies and callbacks: what the paper's tables and our JSON print."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.flow import DataFlow

__all__ = ["PERCENTILES", "LatencyStatistics", "callback_statistics", "latency_statistics"]

PERCENTILES: tuple[float, ...] = (0.5, 1, 5, 25, 50, 75, 95, 99, 99.5)


@dataclass(frozen=True)
class LatencyStatistics:
    """Statistics of a sample of latencies, in whole nanoseconds; None where there is no sample.

    ``count`` latencies were measured; ``incomplete`` traversals have none; ``disturbed`` of
    ``count`` were hit by a stall of the machine; ``late`` of them came behind the slot or cycle
    they were due in (None: when they were due is not known). ``jitter_ns`` is max − min (paper: J),
    ``spread_ns`` p99.5 − p0.5. ``percentiles_ns`` has the keys 0.5, 1, 5, 25, 50, 75, 95, 99 and
    99.5 as text; they interpolate linearly between the two nearest values (NumPy's default),
    then are rounded.
    """

    count: int
    incomplete: int
    disturbed: int
    min_ns: int | None
    mean_ns: int | None
    max_ns: int | None
    jitter_ns: int | None
    spread_ns: int | None
    percentiles_ns: dict[str, int]
    late: int | None = None


def latency_statistics(
    latency_ns: npt.ArrayLike,
    disturbed: npt.ArrayLike | None = None,
    incomplete: int = 0,
    late: int | None = None,
) -> LatencyStatistics:
    """Statistics of latencies in ns; ``disturbed`` marks those that the machine hit.

    Disturbed latencies are counted and included: to leave them out, pass the others only.
    """
    sample = np.asarray(latency_ns, dtype=np.int64)
    hit = 0 if disturbed is None else int(np.count_nonzero(np.asarray(disturbed, dtype=bool)))
    if not len(sample):
        return LatencyStatistics(0, incomplete, hit, None, None, None, None, None, {}, late)
    values = np.percentile(sample, PERCENTILES)
    percentiles = {f"{p:g}": round(float(v)) for p, v in zip(PERCENTILES, values, strict=True)}
    low, high = int(sample.min()), int(sample.max())
    return LatencyStatistics(
        count=len(sample),
        incomplete=incomplete,
        disturbed=hit,
        min_ns=low,
        mean_ns=round(int(sample.sum()) / len(sample)),
        max_ns=high,
        jitter_ns=high - low,
        spread_ns=percentiles["99.5"] - percentiles["0.5"],
        percentiles_ns=percentiles,
        late=late,
    )


def callback_statistics(flow: DataFlow) -> pl.DataFrame:
    """Count, response and execution times of every callback that was seen to run, one row each.

    Columns: ``callback_id, node, kind, topic, period_ns, symbol, pid, tids, count, unfinished,
    response_ns, execution_ns``. The last two are structs ``{min, mean, max}`` in ns (means as
    floats), null where no instance has such a time. ``period_ns`` is the timer's own period.
    """
    about = flow.objects.callbacks.unique("callback_id", maintain_order=True)
    response = pl.col("end") - pl.col("start")
    seen = flow.instances.filter(~pl.col("assumed"))
    figures = seen.group_by("callback_id").agg(
        pl.col("tid").unique().sort().alias("tids"),
        pl.len().alias("count"),
        pl.col("end").null_count().alias("unfinished"),
        _summary(response).alias("response_ns"),
        _summary(pl.col("execution_ns")).alias("execution_ns"),
    )
    joined = about.join(figures, on="callback_id", how="inner").sort("callback_id")
    columns = ["callback_id", "node", "kind", "topic", "period_ns", "symbol", "pid"]
    times = [
        pl.when(pl.col(name).struct.field("min").is_not_null()).then(pl.col(name)).alias(name)
        for name in ("response_ns", "execution_ns")
    ]
    return joined.select(*columns, "tids", "count", "unfinished", *times)


def _summary(values: pl.Expr) -> pl.Expr:
    return pl.struct(min=values.min(), mean=values.mean(), max=values.max())
