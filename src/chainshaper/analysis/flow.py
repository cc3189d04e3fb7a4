"""From events to the data flow: which instance took which message and published which.

This is the step that everything about chains builds on: it joins objects, callback instances,
publications and takes into four frames that refer to each other by number. It costs a fixed
number of sorts and joins, however many events there are.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.messages import with_departures
from chainshaper.analysis.instances import (
    callback_instances,
    with_assumed_readers,
    with_assumed_writers,
)
from chainshaper.analysis.matching import by_number, latest_before
from chainshaper.analysis.messages import link_takes, publications, takes
from chainshaper.analysis.objects import Objects, resolve_objects
from chainshaper.values import events

__all__ = ["DataFlow", "data_flow"]


@dataclass(frozen=True)
class DataFlow:
    """A recording, resolved.

    * ``objects``: who exists, see :class:`~chainshaper.analysis.objects.Objects`.
    * ``instances``: see :func:`~chainshaper.analysis.instances.callback_instances`, with those
      that no event shows added (:mod:`~chainshaper.analysis.instances`). An instance's number is
      its row.
    * ``publications``: see :func:`~chainshaper.analysis.messages.publications`, with the
      ``instance`` in which each was published and its ``callback_id`` (null: outside callbacks),
      and when it was ``sent`` (:mod:`~chainshaper.analysis.messages`).
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
    with ThreadPoolExecutor(max_workers=1) as beside:  # instances and messages meet only below
        running = beside.submit(callback_instances, tables, objects.callbacks)
        taken = takes(tables, objects)
        published = publications(tables, objects)
        taken = link_takes(tables, taken, published, clock_offset_ns)
        instances = running.result()
    instances, taken = with_assumed_readers(instances, taken, objects)
    taken = _consumed(taken, instances)
    published = _published_in(published, instances, objects)
    objects, instances, published = with_assumed_writers(objects, instances, published)
    published = with_departures(published, tables, objects)
    notes = (
        *objects.notes,
        *_about_execution_times(tables, instances),
        *_about_messages_within_processes(tables, instances),
    )
    return DataFlow(objects, instances, published, taken, tables, notes)


def _about_execution_times(tables: events.EventTables, instances: pl.DataFrame) -> tuple[str, ...]:
    if "sched_switch" not in tables or instances["execution_ns"].count() or not instances.height:
        return ()
    return (
        "sched_switch was recorded, but shows none of the application's threads (inside a "
        "container threads have other numbers): execution times cannot be known.",
    )


def _about_messages_within_processes(
    tables: events.EventTables, instances: pl.DataFrame
) -> tuple[str, ...]:
    count = int(instances["intra_process"].sum())
    if not count or events.table(tables, "rclcpp_ring_buffer_dequeue").height:
        return ()
    return (
        f"{count} callback instances got their message within their process, of which no other "
        "event tells (before Iron, or not enabled): chains cannot be followed through them.",
    )


def _consumed(taken: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """Add ``instance``: the next start of the subscription's callback on the thread of the take.

    Only when it comes before the thread's next take for that callback: an instance reads the
    latest message taken for it, and a message is read by one instance.
    """
    key = ["tid", "callback_id"]
    read = []
    for through_buffer in (False, True):
        same = pl.col("intra_process") == through_buffer
        began = instances.filter(same & ~pl.col("assumed")).select(*key, "instance", "start")
        got = taken.filter(same).select(*key, "take", took="time")
        if began.height and got.height:
            read.append(latest_before(began, got, key, "start", "took").select("take", "instance"))
    if not read:
        return taken.rename({"assumed_instance": "instance"})
    first = pl.concat(read).filter(pl.col("take").is_not_null())
    # In order of start: of several instances after one take the first had it, so it comes last.
    first = first.reverse()
    return taken.with_columns(
        pl.coalesce("assumed_instance", by_number(first, "take", "instance", taken.height)).alias(
            "instance"
        )
    ).drop("assumed_instance")


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
    nodes = nodes.select("callback_id", owner=pl.col("node").cast(published.schema["node"]))
    running = instances.join(nodes, on="callback_id", how="left", maintain_order="left").select(
        "pid", "tid", "instance", "callback_id", "start", "end", "assumed", "owner"
    )
    rest = published.select("publication", "time", "pid", "tid", "node")
    found = [_within(rest, running, strictly=True)]
    rest = _without(rest, found[0], published.height)
    while running.height and rest.height:
        found.append(_within(rest, running, strictly=False))
        rest = _without(rest, found[-1], published.height)
        running = running.sort("start", maintain_order=True)
        inner_start = pl.col("start").shift(-1).over("pid", "tid")
        inner_end = pl.col("end").shift(-1).over("pid", "tid")
        contains = (inner_start < pl.col("end")) & (inner_end <= pl.col("end")).fill_null(True)
        running = running.filter(contains.fill_null(False))
    inside = pl.concat(found)
    return published.with_columns(
        by_number(inside, "publication", column, published.height)
        for column in ("instance", "callback_id")
    )


def _without(rest: pl.DataFrame, found: pl.DataFrame, height: int) -> pl.DataFrame:
    """The publications of ``rest`` that are not among ``found``; both in their numbers."""
    hit = by_number(found.select("publication", hit=pl.lit(True)), "publication", "hit", height)
    return rest.filter(hit.gather(rest["publication"]).is_null())


def _within(published: pl.DataFrame, running: pl.DataFrame, *, strictly: bool) -> pl.DataFrame:
    """The publications that the latest instance started before them includes."""
    key = ["pid", "tid"]
    joined = latest_before(published, running, key, "time", "start", strictly=strictly)
    inside = (pl.col("end").is_null() | (pl.col("time") <= pl.col("end"))) & (
        ~pl.col("assumed") | (pl.col("owner") == pl.col("node"))
    )
    hit = joined.filter(inside.fill_null(False) & pl.col("instance").is_not_null())
    return hit.select("publication", "instance", "callback_id")
