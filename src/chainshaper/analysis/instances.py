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
    frame = owned.filter(pl.col("callback_id").is_not_null()).select(
        "callback_id",
        "pid",
        "tid",
        "start",
        "end",
        pl.when(pl.col("used") >= 0).then("used").alias("execution_ns"),
        "intra_process",
        pl.lit(False).alias("assumed"),
    )
    if frame["execution_ns"].null_count() == frame.height and "sched_switch" in tables:
        frame = frame.with_columns(cpu_time(tables, frame).alias("execution_ns"))
    return frame.with_row_index("instance")


def _paired(tables: events.EventTables) -> pl.DataFrame:
    """Starts with the end that follows them in their (process, thread, callback).

    Columns: ``pid, tid, callback, start, end, used, intra_process``; ``used`` is the thread's
    CPU time between start and end where the source tells it.
    """
    starts = events.table(tables, "callback_start", ["is_intra_process", "thread_time"])
    ends = events.table(tables, "callback_end", ["thread_time"])
    clock = ["thread_time"] if starts["thread_time"].count() else []  # a column less to sort
    intra = pl.col("is_intra_process").fill_null(0).ne(0).alias("intra_process")
    never = pl.lit(False).alias("intra_process")
    both = pl.concat(
        [
            starts.select(*_THREAD, "time", *clock, intra, is_end=pl.lit(False)),
            ends.select(*_THREAD, "time", *clock, never, is_end=pl.lit(True)),
        ]
    ).sort(*_THREAD, "time", "is_end", maintain_order=True)
    both = _simultaneous_in_order(both)
    ended = ~_differs(_THREAD, -1) & pl.col("is_end").shift(-1, fill_value=False)
    used = pl.col("thread_time").shift(-1) - pl.col("thread_time")
    return both.select(
        *_THREAD,
        pl.col("time").alias("start"),
        pl.when(ended).then(pl.col("time").shift(-1)).alias("end"),
        pl.when(ended).then(used if clock else pl.lit(None, pl.Int64)).alias("used"),
        "intra_process",
        "is_end",
    ).filter(~pl.col("is_end"))


def _differs(keys: list[str], shift: int) -> pl.Expr:
    """Whether a row has another key than the one before (``shift`` 1) or after it (−1)."""
    return pl.any_horizontal(pl.col(key).ne_missing(pl.col(key).shift(shift)) for key in keys)


def _simultaneous_in_order(both: pl.DataFrame) -> pl.DataFrame:
    """Order starts and ends that share one time stamp and one key.

    Clocks tick coarsely and simulators exactly, so an instance may begin in the very
    nanosecond in which the one before ended (end first), or last no time at all (start first).
    It is the former when an instance was open before that nanosecond.
    """
    if both.is_empty():
        return both
    new_moment, new_thread = both.select(
        _differs([*_THREAD, "time"], 1).alias("moment"), _differs(_THREAD, 1).alias("thread")
    )
    first = np.flatnonzero(new_moment.to_numpy())
    if len(first) == len(both):
        return both
    is_end = both["is_end"].to_numpy()
    step = np.where(is_end, -1, 1)
    opened = np.cumsum(step) - step  # starts minus ends of all rows before this one
    thread_first = np.flatnonzero(new_thread.to_numpy())
    length = np.diff(np.append(thread_first, len(both)))
    opened -= np.repeat(opened[thread_first], length)  # counted within the thread and callback
    open_before = np.repeat(opened[first] > 0, np.diff(np.append(first, len(both))))
    return (
        both.with_columns(pl.Series("rank", is_end ^ open_before))
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
    changes = changes.with_columns(ran.fill_null(0).alias("used"))
    return changes.with_columns(pl.col("used").cum_sum().over("tid"))
