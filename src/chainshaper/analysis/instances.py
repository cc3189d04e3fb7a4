"""Callback instances: every execution of every callback, with response and execution time.

An instance runs from `callback_start` to `callback_end` of the same callback on the same thread
(paper, section 2.4). Instances of different processes and threads overlap freely.
"""

import numpy as np
import polars as pl

from chainshaper import events
from chainshaper.analysis.matching import latest_before

__all__ = ["callback_instances", "cpu_time"]

_THREAD = ["pid", "tid", "callback"]


def callback_instances(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """All instances of all callbacks, one row each, sorted by start.

    ``callbacks`` is the frame of :func:`~chainshaper.analysis.objects.resolve_objects`. The
    result has the columns

    * ``instance``: numbered from 0 in order of start; ``callback_id``; ``pid``, ``tid``;
    * ``start``, ``end``: ns of the event clock. An instance's end is the next event of the same
      callback on the same thread if that is a `callback_end`; ``end`` is null when it is not (the
      end was lost) or when there is none (still running as the recording stopped). A
      `callback_end` without a start belongs to nobody;
    * ``execution_ns``: CPU time (paper: e), from the ``thread_time`` columns where the source
      has them, else from `sched_switch` (:func:`cpu_time`), else null;
    * ``intra_process``: whether its message came through a ring buffer;
    * ``assumed``: always false here, see :mod:`~chainshaper.analysis.flow`.
    """
    paired = _paired(tables)
    owners = callbacks.filter(pl.col("observed")).select(
        "callback_id", "pid", callback="handle", registered="valid_from"
    )
    owned = latest_before(paired, owners, ["pid", "callback"], "start", "registered")
    by_thread_time = pl.col("end_thread_time") - pl.col("thread_time")
    frame = owned.drop_nulls("callback_id").select(
        "callback_id",
        "pid",
        "tid",
        "start",
        "end",
        pl.when(by_thread_time >= 0).then(by_thread_time).alias("execution_ns"),
        pl.col("is_intra_process").fill_null(0).ne(0).alias("intra_process"),
        pl.lit(False).alias("assumed"),
    )
    if frame["execution_ns"].null_count() == frame.height and "sched_switch" in tables:
        frame = frame.with_columns(cpu_time(tables, frame).alias("execution_ns"))
    return frame.with_row_index("instance").with_columns(pl.col("instance").cast(pl.Int64))


def _paired(tables: events.EventTables) -> pl.DataFrame:
    """Starts with the end that follows them in their (process, thread, callback)."""
    starts = events.table(tables, "callback_start", ["is_intra_process", "thread_time"])
    ends = events.table(tables, "callback_end", ["thread_time"])
    both = pl.concat(
        [
            starts.select(
                "time", *_THREAD, "thread_time", "is_intra_process", is_end=pl.lit(False)
            ),
            ends.select(
                "time",
                *_THREAD,
                "thread_time",
                pl.lit(None, dtype=pl.Int32).alias("is_intra_process"),
                is_end=pl.lit(True),
            ),
        ]
    ).sort(*_THREAD, "time", "is_end", maintain_order=True)
    both = _simultaneous_in_order(both)
    same = pl.all_horizontal(pl.col(key).eq_missing(pl.col(key).shift(-1)) for key in _THREAD)
    ended = same & pl.col("is_end").shift(-1)
    return (
        both.with_columns(
            pl.when(ended).then(pl.col("time").shift(-1)).alias("end"),
            pl.when(ended).then(pl.col("thread_time").shift(-1)).alias("end_thread_time"),
        )
        .filter(~pl.col("is_end"))
        .rename({"time": "start"})
    )


def _simultaneous_in_order(both: pl.DataFrame) -> pl.DataFrame:
    """Order starts and ends that share one time stamp and one key.

    Clocks tick coarsely and simulators exactly, so an instance may begin in the very
    nanosecond in which the one before ended (end first), or last no time at all (start first).
    It is the former when an instance was open before that nanosecond.
    """
    if both.is_empty():
        return both
    keys = pl.struct(*_THREAD, "time")
    moment = both.select(keys.ne_missing(keys.shift(1)).fill_null(True)).to_series().to_numpy()
    first = np.flatnonzero(moment)
    if len(first) == len(both):
        return both
    thread = both.select(pl.struct(_THREAD).ne_missing(pl.struct(_THREAD).shift(1))).to_series()
    step = np.where(both["is_end"].to_numpy(), -1, 1)
    opened = np.cumsum(step) - step  # starts minus ends of all rows before this one
    thread_first = np.flatnonzero(thread.fill_null(True).to_numpy())
    length = np.diff(np.append(thread_first, len(both)))
    opened -= np.repeat(opened[thread_first], length)  # counted within the thread and callback
    open_before = np.repeat(opened[first] > 0, np.diff(np.append(first, len(both))))
    rank = both["is_end"].to_numpy() ^ open_before
    return (
        both.with_columns(pl.Series("rank", rank))
        .sort(*_THREAD, "time", "rank", maintain_order=True)
        .drop("rank")
    )


def cpu_time(tables: events.EventTables, spans: pl.DataFrame) -> pl.Series:
    """CPU time of thread ``tid`` between ``start`` and ``end`` of every row, from `sched_switch`.

    Exact: the thread's running time at an instant is what it had accumulated at its last switch
    plus, if that switched it in, the time since. A thread whose first switch takes it off its
    core is taken to have run since the recording began. Null without an end, and for threads
    that never appear in `sched_switch`.
    """
    curve = _running_time(tables)
    rows = spans.select("tid", "start", "end").with_row_index("row")
    for edge in ("start", "end"):
        rows = latest_before(rows, curve, ["tid"], edge, "switched")
        since = pl.when("running").then(pl.col(edge) - pl.col("switched")).otherwise(0)
        rows = rows.with_columns((pl.col("used") + since).alias(f"used_at_{edge}"))
        rows = rows.drop("switched", "used", "running")
    used = pl.col("used_at_end") - pl.col("used_at_start")
    return rows.sort("row").select(used.alias("execution_ns")).to_series()


def _running_time(tables: events.EventTables) -> pl.DataFrame:
    """``tid, switched, used, running``: CPU time used by each thread at each of its switches."""
    switches = events.table(tables, "sched_switch")
    began = switches["time"].min()
    changes = pl.concat(
        [
            switches.select(tid="prev_tid", switched="time", running=pl.lit(False)),
            switches.select(tid="next_tid", switched="time", running=pl.lit(True)),
        ]
    ).filter(pl.col("tid") != 0)  # 0 is every core's idle thread
    changes = changes.sort("tid", "switched", "running", maintain_order=True)
    ran_from_start = (
        changes.group_by("tid", maintain_order=True)
        .agg(pl.col("running").first())
        .filter(~pl.col("running"))
        .select("tid", pl.lit(began, dtype=pl.Int64).alias("switched"), running=pl.lit(True))
    )
    changes = pl.concat([ran_from_start, changes]).sort("tid", "switched", maintain_order=True)
    elapsed = (pl.col("switched") - pl.col("switched").shift(1)).over("tid")
    ran = pl.when(pl.col("running").shift(1).over("tid")).then(elapsed).otherwise(0)
    return changes.with_columns(ran.fill_null(0).cum_sum().over("tid").alias("used"))
