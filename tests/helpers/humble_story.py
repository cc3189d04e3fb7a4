"""A chain on Humble, where no event tells a publication's stamp, while the wall clock moves."""

import random
from collections.abc import Callable
from dataclasses import dataclass

from story import Publisher, Story

from chainshaper.values import events

MS = 1_000_000
WALL = 1_700_000_000_000_000_000
BEGIN = 3_600_000_000_000

Wall = Callable[[int], int]
"""By how much the wall clock is moved (ns) at a time since the beginning (ns)."""


@dataclass(frozen=True)
class HumbleRun:
    """What was recorded, and the truth: message's stamp → when it was published, per topic."""

    tables: events.EventTables
    truth: dict[tuple[str, int], int]


def stepped(*steps: tuple[int, float]) -> Wall:
    """The clock jumps by so many ms at each of these times (ms)."""
    return lambda time: round(sum(by * MS for at, by in steps if time >= at * MS))


def slewed(since_ms: int, until_ms: int, share: float) -> Wall:
    """The clock runs faster by a share of time, for a while."""
    return lambda time: round(share * max(0, min(time, until_ms * MS) - since_ms * MS))


def humble_run(
    wall: Wall,
    *,
    cycles: int = 40,
    period_ns: int = 50 * MS,
    jitter_ns: int = 1_000_000,
    communication_ns: tuple[int, int] = (100_000, 500_000),
    lost: frozenset[int] = frozenset(),
    seed: int = 1,
) -> HumbleRun:
    """/camera → /image → /detector → /objects → /sink, in cycles from 100 ms on.

    /camera needs 1 ms and up to ``jitter_ns`` more until it publishes, /detector from 9 to 14 ms; a
    message is stamped from 3 to 60 µs behind its event. Of the images of cycles ``lost`` the events
    of publication and take are not there.
    """
    story, chance = Story(), random.Random(seed)
    truth: dict[tuple[str, int], int] = {}
    source, image = story.source("/camera", 100, "/image", period_ns)
    reader, objects = story.relay("/detector", 200, "/image", "/objects")
    sink = story.subscription(story.node("/sink", 300), "/objects")
    for rows in story.rows.values():
        for row in rows:
            row["time"] += BEGIN

    def published(topic: str, publisher: Publisher, time: int) -> int:
        pid, handle = publisher.pid, publisher.handle
        story.event("rcl_publish", time - 3_000, pid, publisher_handle=handle, message=12)
        story.event("rmw_publish", time, pid, message=12)
        stamped = time + chance.randrange(3_000, 60_000)
        stamp = WALL + stamped + wall(stamped - BEGIN)
        truth[topic, stamp] = time
        return stamp

    for cycle in range(cycles):
        start = BEGIN + 100 * MS + cycle * period_ns
        story.start(source, start)
        sent = start + MS + chance.randrange(jitter_ns + 1)
        stamp = published("/image", image, sent)
        story.end(source, sent + 100_000)
        came = sent + chance.randrange(*communication_ns)
        taken = {"message": 12, "source_timestamp": stamp, "taken": 1}
        if cycle in lost:
            for name in ("rcl_publish", "rmw_publish"):
                story.rows[name].pop()
            del truth["/image", stamp]
        handle = {"rmw_subscription_handle": reader.rmw_subscription}
        story.event("rmw_take", came, 200, **handle, **taken)
        story.start(reader, came + 10_000)
        out = came + chance.randrange(9 * MS, 14 * MS)
        stamp = published("/objects", objects, out)
        story.end(reader, out + 100_000)
        came = out + chance.randrange(*communication_ns)
        taken |= {"source_timestamp": stamp}
        handle = {"rmw_subscription_handle": sink.rmw_subscription}
        story.event("rmw_take", came, 300, **handle, **taken)
        story.start(sink, came + 10_000)
        story.end(sink, came + 500_000)
    tables = story.tables()
    lacks = {"rmw_publish": ["rmw_publisher_handle", "timestamp"]}
    tables = {
        name: table.drop(n for n in lacks.get(name, ()) if n in table.columns)
        for name, table in tables.items()
    }
    return HumbleRun(tables, truth)
