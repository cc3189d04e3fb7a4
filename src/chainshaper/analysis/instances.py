"""Callback instances: every execution of every callback, with response and execution time.

An instance runs from `callback_start` to `callback_end` of the same callback on the same thread
(paper, section 2.4). Instances of different processes and threads overlap freely.
"""

from typing import Any

import polars as pl

from chainshaper import events
from chainshaper.analysis.matching import key_numbers, latest_before

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
      has them, else from `sched_switch` (:func:`cpu_time`), else null, also where a thread seems
      to have used none;
    * ``intra_process``: whether its message came through a ring buffer;
    * ``assumed``: always false here, see :mod:`~chainshaper.analysis.flow`.
    """
    paired = _paired(tables)
    owners = callbacks.filter(pl.col("observed")).select(
        "callback_id", "pid", callback="handle", registered="valid_from"
    )
    started = paired.select("pid", "callback", "start")  # in order of time, and stays so
    owned = latest_before(started, owners, ["pid", "callback"], "start", "registered")
    frame = paired.select(
        owned["callback_id"],
        "pid",
        "tid",
        "start",
        "end",
        pl.when(pl.col("used") >= 0).then("used").alias("execution_ns"),
        "intra_process",
        pl.lit(False).alias("assumed"),
    ).drop_nulls("callback_id")
    if frame["execution_ns"].null_count() == frame.height and "sched_switch" in tables:
        frame = _plausible(frame.with_columns(cpu_time(tables, frame).alias("execution_ns")))
    return frame.with_row_index("instance")


def _paired(tables: events.EventTables) -> pl.DataFrame:
    """Starts with the end that follows them in their (process, thread, callback).

    Columns: ``pid, tid, callback, start, end, used, intra_process``; ``used`` is the thread's
    CPU time between start and end where the source tells it.
    """
    # Numba takes a moment to import: only who asks for instances pays for it.
    from chainshaper.analysis.pairing import ends_of_starts

    starts = events.table(tables, "callback_start", ["is_intra_process", "thread_time"])
    ends = events.table(tables, "callback_end", ["thread_time"])
    found = ends_of_starts(_keyed(starts), _keyed(ends))
    row = pl.Series(found, dtype=pl.Int64)
    row = row.set(row < 0, None) if (found < 0).any() else row
    return starts.select(
        *_THREAD,
        pl.col("time").alias("start"),
        ends["time"].gather(row).alias("end"),
        (ends["thread_time"].gather(row) - starts["thread_time"]).alias("used"),
        pl.col("is_intra_process").fill_null(0).ne(0).alias("intra_process"),
    )


def _keyed(table: pl.DataFrame) -> tuple[Any, Any, Any]:
    """Thread, callback and time of a table's rows as arrays; both pid and tid in one number."""
    callback, thread = key_numbers(table, ["callback", "pid", "tid"])
    return thread, callback, table["time"].to_numpy()


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


def _plausible(frame: pl.DataFrame) -> pl.DataFrame:
    """``execution_ns`` without what cannot be: a callback that ran used its core.

    Where most instances of a thread used none, `sched_switch` speaks of another thread with the
    same number (the trace was taken inside a container); where single ones did, switches were lost.
    """
    used, thread = pl.col("execution_ns"), ["pid", "tid"]
    never = (used == 0) & (pl.col("end") > pl.col("start"))
    stranger = never.sum().over(thread) * 2 > used.count().over(thread)
    return frame.with_columns(pl.when(~(never | stranger)).then(used).alias("execution_ns"))


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
