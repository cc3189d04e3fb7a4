"""Coroutines and tasks of rclpy run in several pieces, between which their thread runs others.

A callback that is a coroutine has one instance from its first piece to its last one. It computes
in its pieces only, and what it publishes is what its thread publishes within them, whatever ran in
between: pieces of several instances may take turns on one thread, and those of one instance may
run on several threads.

A task (`Executor.create_task`, and what `Future.add_done_callback` leaves to the executor) is a
part of the instance that created it: what it publishes is that instance's output, although that has
mostly ended before.
"""

import polars as pl

from chainshaper.analysis.matching import latest_before
from chainshaper.values import events
from chainshaper.values.event_declarations import COROUTINE_STATES

_BEGINS, _RUNS, _WAITS, _DONE, _CREATED = range(len(COROUTINE_STATES))
_CALL = ["pid", "call"]


def coroutine_pieces(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of all pieces of coroutines and tasks, sorted by start.

    Columns: ``pid, tid``; ``callback`` (0: a task's); ``call``; ``start``; ``end`` (ns; null: it
    was lost, or the piece still runs); ``used``, its CPU time (ns); ``is_first``; ``is_last``.
    """
    steps = events.table(tables, "coroutine_step").filter(pl.col("state") != _CREATED)
    steps = steps.sort("pid", "call", "time", maintain_order=True)
    begins = pl.col("state").is_in([_BEGINS, _RUNS])
    following = {name: pl.col(name).shift(-1).over(_CALL) for name in ("state", "tid", "time")}
    is_end = (
        following["state"].is_in([_WAITS, _DONE]) & (following["tid"] == pl.col("tid"))
    ).fill_null(value=False)
    used = pl.col("thread_time").shift(-1).over(_CALL) - pl.col("thread_time")
    pieces = steps.with_columns(
        start="time",
        end=pl.when(is_end).then(following["time"]),
        used=pl.when(is_end).then(used),
        is_first=pl.col("state") == _BEGINS,
        is_last=is_end & (following["state"] == _DONE),
    ).filter(begins)
    columns = ("pid", "tid", "callback", "call", "start", "end", "used", "is_first", "is_last")
    return pieces.select(columns).sort("start", maintain_order=True)


def coroutine_instances(pieces: pl.DataFrame, owners: pl.DataFrame) -> pl.DataFrame:
    """Make a frame of the instances of callbacks that are coroutines, in order of start.

    ``pieces`` is the frame of :func:`coroutine_pieces`; ``owners`` has ``callback_id, pid,
    callback, registered``. Columns: those of
    :func:`~chainshaper.analysis.flow.callback_instances` but ``instance``. An instance has the
    thread on which it began.
    """
    calls = (
        pieces.filter(pl.col("callback") != 0)
        .group_by(_CALL, maintain_order=True)
        .agg(
            pl.col("callback", "tid", "start", "is_first").first(),
            end=pl.when(pl.col("is_last").last()).then(pl.col("end").last()),
            execution_ns=pl.when(pl.col("used").null_count() == 0).then(pl.col("used").sum()),
        )
    )
    calls = calls.filter("is_first").sort("start", maintain_order=True)
    named = latest_before(calls, owners, ["pid", "callback"], "start", "registered")
    return named.drop_nulls("callback_id").select(
        *("callback_id", "pid", "tid", "start", "end", "execution_ns"),
        intra_process=pl.lit(False),
        assumed=pl.lit(False),
    )


def instances_of_pieces(pieces: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """Add ``instance`` and ``callback_id`` to the pieces of coroutines; tasks have none yet."""
    first = pieces.filter(pl.col("is_first") & (pl.col("callback") != 0))
    began = instances.select("pid", "tid", "start", "instance", "callback_id")
    began = first.select(*_CALL, "tid", "start").join(began, on=["pid", "tid", "start"])
    began = began.unique(_CALL, keep="last").select(*_CALL, "instance", "callback_id")
    return pieces.join(began, on=_CALL, how="left", maintain_order="left")


def created_tasks(tables: events.EventTables) -> pl.DataFrame:
    """Make a frame of when tasks were created: ``time, pid, tid, call``."""
    created = events.table(tables, "coroutine_step").filter(pl.col("state") == _CREATED)
    return created.select("time", "pid", "tid", "call")
