"""What a recording of a described loop shows: its instances, and what each of them used."""

import polars as pl

from chainshaper.values.recording import Recording


def of_node(recording: Recording, table: str, node: str) -> pl.DataFrame:
    """The rows of an event that are of a node's process."""
    (pid,) = (pid for pid, name in recording.info.processes.items() if name == f"/{node}")
    return recording.events[table].filter(pid=pid)


def awake(recording: Recording, node: str = "controller") -> list[tuple[int, int, int]]:
    """When instances began and ended, and until when the thread slept then (ns).

    Each lasts for some time. When timers have ended, the thread also sleeps again and again without
    an instance in between.
    """
    begins = of_node(recording, "thread_wake", node)["time"]
    sleeps = of_node(recording, "thread_sleep", node).select("time", "until")
    places = sleeps["time"].search_sorted(begins, side="right")
    ended = [(begin, place) for begin, place in zip(begins, places, strict=True)]
    return [(begin, *sleeps.row(place)) for begin, place in ended if place < sleeps.height]


def used(recording: Recording, node: str = "seen") -> dict[int, int]:
    """The stamp of the message that each instance used, by when it published (ns).

    They are those of a gate's node that subscribes to what the loop publishes.
    """
    table = of_node(recording, "gate_release", node)
    return dict(table.select("source_timestamp", "origin").iter_rows())
