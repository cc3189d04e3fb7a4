"""Callback instances: every execution of every callback, with response and execution time.

An instance runs from `callback_start` to `callback_end` of the same callback on the same thread
(paper, section 2.4). Instances of different processes and threads overlap freely.

Some work has no callback event, but its messages prove it. Such instances are assumed
(``assumed``, no ``end``, no response time):

* A Python node (rclpy), or one that takes from a wait set, has no callback events. An instance of
  its subscription begins with each take. What its thread publishes for the same node until its
  next take counts as that instance's output.
* A driver's own thread, a player of recorded data, a Python timer or the callback of a service's
  client publishes outside all callbacks that events show. A topic that its node publishes only
  like this gets a callback of kind ``unknown``, with the handle 0 and one instance per
  publication, so that chains can begin there.
"""

from dataclasses import replace

import polars as pl

from chainshaper.analysis.matching import ends_of_starts, latest_before
from chainshaper.analysis.objects import CALLBACK_SCHEMA, Objects
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS

__all__ = [
    "callback_instances",
    "cpu_time",
    "ends_of_starts",
    "with_assumed_readers",
    "with_assumed_writers",
]


def callback_instances(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """All instances of all callbacks, one row each, sorted by start.

    ``callbacks`` is the frame of :func:`~chainshaper.analysis.objects.resolve_objects`. The
    result has the columns

    * ``instance``: numbered from 0 in order of start; ``callback_id``; ``pid``, ``tid``;
    * ``start``, ``end``: ns of the event clock. An instance's end is the next event of the same
      callback on the same thread if that is a `callback_end`; ``end`` is null when it is not (the
      end was lost) or when there is none (still running as the recording stopped). A
      `callback_end` without a start belongs to no instance;
    * ``execution_ns``: CPU time (paper: e), from the ``thread_time`` columns where the source
      has them, else from `sched_switch` (:func:`cpu_time`), else null, also where a thread seems
      to have used none;
    * ``intra_process``: whether its message came through a ring buffer;
    * ``assumed``: always false here, see :mod:`~chainshaper.analysis.flow`.
    """
    starts = events.table(tables, "callback_start", ["is_intra_process"])
    ends = events.table(tables, "callback_end")
    row = ends_of_starts(starts, ends)
    owners = callbacks.filter(pl.col("observed")).select(
        "callback_id", "pid", callback="handle", registered="valid_from"
    )
    started = starts.select("pid", "callback", "time")  # in order of time, and stays so
    frame = starts.select(
        latest_before(started, owners, ["pid", "callback"], "time", "registered")["callback_id"],
        "pid",
        "tid",
        pl.col("time").alias("start"),
        ends["time"].gather(row).alias("end"),
        _used(starts, ends, row),
        pl.col("is_intra_process").fill_null(0).ne(0).alias("intra_process"),
        pl.lit(False).alias("assumed"),
    )
    if frame["callback_id"].null_count():
        frame = frame.drop_nulls("callback_id")
    if frame["execution_ns"].null_count() == frame.height and "sched_switch" in tables:
        frame = _plausible(frame.with_columns(cpu_time(tables, frame).alias("execution_ns")))
    return frame.with_row_index("instance")


def _used(starts: pl.DataFrame, ends: pl.DataFrame, row: pl.Series) -> pl.Expr:
    """``execution_ns`` by the thread's CPU time at start and end, where the source tells it."""
    if "thread_time" not in starts.columns or "thread_time" not in ends.columns:
        return pl.lit(None, dtype=pl.Int64).alias("execution_ns")
    used = ends["thread_time"].gather(row) - starts["thread_time"]
    return pl.lit(used.set(used < 0, None)).alias("execution_ns")


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


def with_assumed_readers(
    instances: pl.DataFrame, taken: pl.DataFrame, objects: Objects
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add an instance for every take of a subscription that has no callback events.

    Returns the instances, renumbered in order of start, and the takes with ``assumed_instance``.
    """
    silent = objects.callbacks.filter(~pl.col("observed")).select("callback_id").unique()
    assumed = taken.join(silent, on="callback_id", how="semi").select(
        "callback_id",
        "pid",
        "tid",
        "take",
        pl.col("time").alias("start"),
        "intra_process",
        pl.lit(True).alias("assumed"),
    )
    if assumed.is_empty():
        none = pl.lit(None, dtype=pl.UInt32).alias("assumed_instance")
        return instances, taken.with_columns(none)
    every = pl.concat([instances.drop("instance"), assumed], how="diagonal_relaxed")
    every = every.sort("start", maintain_order=True).with_row_index("instance")
    of_take = every.drop_nulls("take").select("take", assumed_instance="instance")
    taken = taken.join(of_take, on="take", how="left", maintain_order="left")
    return every.drop("take").select(instances.columns), taken


def with_assumed_writers(
    objects: Objects, instances: pl.DataFrame, published: pl.DataFrame
) -> tuple[Objects, pl.DataFrame, pl.DataFrame]:
    """Add a callback, and instances, for topics published only outside callbacks.

    Returns the objects, the instances (the new ones last) and the publications with them.
    """
    key = ["pid", "node", "topic"]
    # By publisher first: one number per row to group by instead of three.
    of_publisher = published.group_by("publisher").agg(
        pl.col(key).first(),
        pl.col("instance").count().alias("inside"),
        pl.col("time").min().alias("valid_from"),
    )
    writers = of_publisher.group_by(key).agg(pl.col("inside").sum(), pl.col("valid_from").min())
    internal = pl.col("topic").cast(pl.String).is_in(sorted(INTERNAL_TOPICS))
    outside = writers.filter((pl.col("inside") == 0) & ~internal & pl.col("node").is_not_null())
    if outside.is_empty():
        return objects, instances, published
    first = objects.callbacks.select(pl.col("callback_id").max()).item()
    outside = outside.sort("valid_from", "topic").with_row_index(
        "assumed_id", offset=0 if first is None else first + 1
    )
    assumed = (
        published.join(outside, on=key, how="inner", maintain_order="left")
        .select("publication", "pid", "tid", start="time", callback_id="assumed_id")
        .with_row_index("assumed_instance", offset=instances.height)
    )
    more = assumed.select(
        "callback_id",
        "pid",
        "tid",
        "start",
        instance="assumed_instance",
        intra_process=pl.lit(False),
        assumed=pl.lit(True),
    )
    given = assumed.select("publication", "assumed_instance", assumed_id="callback_id")
    published = published.join(given, on="publication", how="left", maintain_order="left")
    published = published.with_columns(
        pl.coalesce("instance", "assumed_instance").alias("instance"),
        pl.coalesce("callback_id", "assumed_id").alias("callback_id"),
    ).drop("assumed_instance", "assumed_id")
    every = pl.concat([instances, more], how="diagonal").select(instances.columns)
    return _with_callbacks(objects, outside), every, published


def _with_callbacks(objects: Objects, outside: pl.DataFrame) -> Objects:
    new = outside.select(
        "pid",
        "valid_from",
        callback_id="assumed_id",
        node=pl.col("node").cast(pl.String),
        kind=pl.lit("unknown"),
        handle=pl.lit(0, dtype=pl.UInt64),
        observed=pl.lit(False),
    )
    callbacks = pl.concat([objects.callbacks, new], how="diagonal_relaxed").select(
        pl.col(name).cast(type_) for name, type_ in CALLBACK_SCHEMA.items()
    )
    notes = tuple(
        f"{node} publishes {topic} outside its callbacks (from a thread of its own, from Python, "
        "or from a service client's callback): a chain that begins there is measured from the "
        "publication."
        for node, topic in outside.select("node", "topic").iter_rows()
    )
    return replace(objects, callbacks=callbacks, notes=(*objects.notes, *notes))
