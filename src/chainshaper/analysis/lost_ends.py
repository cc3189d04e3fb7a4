"""Ends of callback instances that events of the same thread disprove.

Where the end of one instance and the start of the next are both lost, the first start and the last
end look like one long instance. The thread's events in between disprove that: an executor takes up
work only when no callback runs. It takes the next message for the same callback, or it looks, or
waits, for work, or runs another callback. A callback that spins an executor itself does the same,
but as a habit: so the events count only if few of the callback's instances have them.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.matching import first_after, latest_before
from chainshaper.values import events

LOOKS = ("rclcpp_executor_get_next_ready", "rclcpp_executor_wait_for_work")
"""The events of an executor that looks for work."""

HABIT = 0.2
"""If an executor looks for work in more than this share of a callback's instances, the callback
spins an executor itself."""
MOST_TAKEN = 0.5
"""If its next message is taken in more than this share of a callback's instances, the callback
takes it itself."""
_OFTEN = 0.5  # share of the usual distance of starts from which an instance may be two
_LONGER = 1.5  # times the usual response time from which it may be two
_NO_TIME = pl.lit(None, dtype=pl.Int64)
_NONE = pl.Series([], dtype=pl.UInt32)


@dataclass(frozen=True)
class LostEnds:
    """Callback instances, without the ends that cannot be theirs.

    * ``instances``: the frame with one more column, ``until``: when an instance without an end had
      ended at the latest (ns, null: not known).
    * ``by_take``: numbers of the instances whose end is disproved because the thread took, or
      executed, the same callback's next message or timer before it.
    * ``by_wait``: numbers of those whose end is disproved only because the thread looked for other
      work before it. If no event was lost, they still have their ends.
    * ``complete``: whether no event was lost.
    """

    instances: pl.DataFrame
    by_take: pl.Series
    by_wait: pl.Series
    complete: bool


def without_disproved_ends(
    tables: events.EventTables,
    instances: pl.DataFrame,
    taken: pl.DataFrame,
    callbacks: pl.DataFrame,
    *,
    complete: bool,
) -> LostEnds:
    """Find the ends that other events of the thread disprove, and leave them out.

    Where no event was lost (``complete``), an instance in which the thread looked for work, or took
    a message, did so itself. Shaping nodes do that: they take messages while they hold another one.

    The events of executors are read only if an instance is suspiciously long, or has no end: as a
    rule no other step needs these large tables.
    """
    thread, key = ["pid", "tid"], ["tid", "callback_id"]
    from_dds = taken.lazy().filter(~pl.col("intra_process")).drop_nulls("callback_id")
    takes = from_dds.select(*key, took="time").collect()
    rows = first_after(instances, takes, key, "start", "took", strictly=True)
    if not _suspicious(rows):
        return LostEnds(instances.with_columns(until=_NO_TIME), _NONE, _NONE, complete)
    if complete:
        takes = takes.clear()
    takes = pl.concat([takes, _executions_of_timers(tables, callbacks)]).sort("took")
    rows = first_after(rows.drop("took"), takes, key, "start", "took", strictly=True)
    looks = pl.concat(events.table(tables, name).select(*thread, looked="time") for name in LOOKS)
    rows = first_after(rows, looks.sort("looked"), thread, "start", "looked", strictly=True)
    # The next instance on the thread is of another callback, or this one has no end already.
    following = pl.col("start").shift(-1).over(thread)
    rows = rows.with_columns(looked=pl.min_horizontal("looked", following))
    took, looked = (pl.col(n) < pl.col("end") for n in ("took", "looked"))
    closed = pl.col("end").count()
    takes_inside = (took.sum() <= MOST_TAKEN * closed).over("callback_id")
    looks_inside = (looked.sum() <= HABIT * closed).over("callback_id")
    by_take = (took & takes_inside).fill_null(False)
    by_wait = (looked & looks_inside & ~by_take).fill_null(False)
    until = pl.min_horizontal(
        pl.when(takes_inside).then("took"), pl.when(looks_inside).then("looked")
    )
    rows = rows.sort("instance").with_columns(by_take=by_take, by_wait=by_wait, until=until)
    lost = pl.col("by_take") | (pl.col("by_wait") & ~pl.lit(complete))
    left = rows.with_columns(pl.when(~lost).then(n).alias(n) for n in ("end", "execution_ns"))
    left = left.with_columns(pl.when(pl.col("end").is_null()).then("until"))
    by_take_rows, by_wait_rows = (rows.filter(n)["instance"] for n in ("by_take", "by_wait"))
    return LostEnds(left.select(*instances.columns, "until"), by_take_rows, by_wait_rows, complete)


def _executions_of_timers(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of when executors took up timers, which take no message.

    Columns: ``tid``, ``callback_id``, ``took`` (ns).
    """
    added = events.table(tables, "rclcpp_timer_callback_added")
    added = added.select("pid", "timer_handle", handle="callback", valid_from="time")
    timers = callbacks.join(added, on=["pid", "handle", "valid_from"])
    timers = timers.select("pid", "callback_id", "valid_from", handle="timer_handle")
    executed = events.table(tables, "rclcpp_executor_execute")
    executed = latest_before(executed, timers, ["pid", "handle"], "time", "valid_from")
    return executed.drop_nulls("callback_id").select("tid", "callback_id", took="time")


def _suspicious(rows: pl.DataFrame) -> bool:
    """Return whether one of the instances may be two, because events were lost.

    It may be if the callback's next take lies inside it; or if it has no end and another instance
    began on its thread; or if it is longer than usual, and not much shorter than starts are apart.
    """
    if (rows["took"] < rows["end"]).any():
        return True
    if rows["end"].null_count():
        last = pl.col("start").max().over("pid", "tid")
        if rows.select((pl.col("end").is_null() & (pl.col("start") < last)).any()).item():
            return True
    start, lasted = pl.col("start"), pl.col("end") - pl.col("start")
    apart = (start.max() - start.min()) / (pl.len() - 1)
    figures = rows.lazy().group_by("callback_id").agg(longest=lasted.max(), apart=apart)
    long = figures.filter(pl.col("longest") > _OFTEN * pl.col("apart")).collect()
    if long.is_empty():
        return False
    usual = rows.lazy().join(long.lazy(), on="callback_id").group_by("callback_id")
    longer = usual.agg(pl.col("longest").first() > _LONGER * lasted.median())
    return bool(longer.select(pl.col("longest").any()).collect().item())
