"""From events to the data flow: which instance took which message and published which.

This is the step that everything about chains builds on: it joins objects, callback instances,
publications and takes into four frames that refer to each other by number. It costs a fixed
number of sorts and joins, however many events there are.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper import events
from chainshaper.analysis.instances import callback_instances
from chainshaper.analysis.matching import latest_before
from chainshaper.analysis.messages import link_takes, publications, takes
from chainshaper.analysis.objects import Objects, resolve_objects

__all__ = ["DataFlow", "data_flow"]


@dataclass(frozen=True)
class DataFlow:
    """A recording, resolved.

    * ``objects``: who exists, see :class:`~chainshaper.analysis.objects.Objects`.
    * ``instances``: see :func:`~chainshaper.analysis.instances.callback_instances`. Instances of
      subscriptions without callback events (rclpy) are added with ``assumed`` true: each begins
      at a take; its end is not known.
    * ``publications``: see :func:`~chainshaper.analysis.messages.publications`, with the
      ``instance`` in which each was published and its ``callback_id`` (null: outside callbacks).
    * ``takes``: see :func:`~chainshaper.analysis.messages.takes`, with the ``publication`` that
      was read and the ``instance`` that got the message (null: none did).
    * ``events``: the tables all this came from.
    * ``notes``: what cannot be known, in plain words.
    """

    objects: Objects
    instances: pl.DataFrame
    publications: pl.DataFrame
    takes: pl.DataFrame
    events: events.EventTables
    notes: tuple[str, ...]


def data_flow(tables: events.EventTables, clock_offset_ns: int = 0) -> DataFlow:
    """Resolve a recording's events.

    ``clock_offset_ns`` is what to add to event times for CLOCK_REALTIME; recordings carry it. It
    matters only for traces from before Jazzy (:mod:`~chainshaper.analysis.messages`).
    """
    objects = resolve_objects(tables)
    instances = callback_instances(tables, objects.callbacks)
    taken = takes(tables, objects)
    published = publications(tables, objects)
    taken = link_takes(tables, taken, published, clock_offset_ns)
    instances, taken = _with_assumed(instances, taken, objects)
    taken = _consumed(taken, instances)
    published = _published_in(published, instances, objects)
    return DataFlow(objects, instances, published, taken, tables, objects.notes)


def _with_assumed(
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
        none = pl.lit(None, dtype=pl.Int64).alias("assumed_instance")
        return instances, taken.with_columns(none)
    every = pl.concat([instances.drop("instance"), assumed], how="diagonal_relaxed")
    every = every.sort("start", maintain_order=True).with_row_index("instance")
    every = every.with_columns(pl.col("instance").cast(pl.Int64))
    of_take = every.drop_nulls("take").select("take", assumed_instance="instance")
    taken = taken.join(of_take, on="take", how="left", maintain_order="left")
    return every.drop("take").select(instances.columns), taken


def _consumed(taken: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """Add ``instance``: the next start of the subscription's callback on the thread of the take.

    Only when it comes before the thread's next take for that callback: an instance reads the
    latest message taken for it, and a message is read by one instance.
    """
    key = ["pid", "tid", "callback_id", "intra_process"]
    began = instances.filter(~pl.col("assumed")).select(*key, "instance", "start")
    read = latest_before(
        began, taken.select(*key, "take", took="time"), key, "start", "took"
    ).drop_nulls("take")
    first = read.group_by("take").agg(pl.col("instance").min())
    joined = taken.join(first, on="take", how="left", maintain_order="left")
    return joined.with_columns(pl.coalesce("instance", "assumed_instance")).drop("assumed_instance")


def _published_in(
    published: pl.DataFrame, instances: pl.DataFrame, objects: Objects
) -> pl.DataFrame:
    """Add ``instance`` and ``callback_id``: the innermost instance running on the thread then.

    An instance without an end is taken to run until the thread's next instance. A publication in
    the very nanosecond in which one instance ends and the next begins, as simulators have it, is
    the first one's. Where a callback runs others inside itself (it spins an executor), what it
    publishes after them is its own: the search is repeated among the instances that contain
    others, once per level of nesting.
    """
    nodes = objects.callbacks.unique("callback_id", maintain_order=True)
    nodes = nodes.select("callback_id", owner="node")
    running = instances.join(nodes, on="callback_id", how="left", maintain_order="left").select(
        "pid", "tid", "instance", "callback_id", "start", "end", "assumed", "owner"
    )
    found = [_within(published, running, strictly=True)]
    rest = published.join(found[0], on="publication", how="anti")
    while running.height and rest.height:
        found.append(_within(rest, running, strictly=False))
        rest = rest.join(found[-1], on="publication", how="anti")
        running = running.sort("start", maintain_order=True)
        next_start = pl.col("start").shift(-1).over("pid", "tid")
        running = running.filter((next_start < pl.col("end")).fill_null(False))
    return published.join(pl.concat(found), on="publication", how="left", maintain_order="left")


def _within(published: pl.DataFrame, running: pl.DataFrame, *, strictly: bool) -> pl.DataFrame:
    """The publications that the latest instance started before them includes."""
    key = ["pid", "tid"]
    joined = latest_before(published, running, key, "time", "start", strictly=strictly)
    inside = (pl.col("end").is_null() | (pl.col("time") <= pl.col("end"))) & (
        ~pl.col("assumed") | (pl.col("owner") == pl.col("node"))
    )
    hit = joined.filter(inside.fill_null(False) & pl.col("instance").is_not_null())
    return hit.select("publication", "instance", "callback_id")
