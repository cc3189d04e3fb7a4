"""Messages that subscriptions' callbacks got although no event shows their takes.

Loaned messages are taken by functions that have no events, and Foxy and plain Galactic have no
events of takes at all. The callbacks' events are there. If a single publisher writes the topic, and
one callback starts between a publication and the next, the two belong together, provided that no
older message can be waiting. None is waiting if the thread had nothing to do for a while since the
publication before, or if all messages since such a pause are linked without a gap.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.matching import latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.values.application import INTERNAL_TOPICS

_FEWEST = 3  # how many linked callbacks show that publications and callbacks alternate
_MOSTLY = 0.5  # share of the publications, from the first to the last linked, that must be linked
_THREAD = ["pid", "tid"]
_WHILE = 0.1  # share of the usual distance of starts: a pause is longer than an executor's work


@dataclass(frozen=True)
class UnseenTakes:
    """A subscription's callback that ran without any event of a take."""

    callback_id: int
    node: str
    topic: str
    tid: int  # of the thread of its first instance
    first_ns: int  # instant of that
    runs: int  # number of its instances
    linked: int  # number of those whose message is known
    publishers: int  # number of publishers that wrote the topic


def with_unseen_takes(
    taken: pl.DataFrame, instances: pl.DataFrame, published: pl.DataFrame, objects: Objects
) -> tuple[pl.DataFrame, tuple[UnseenTakes, ...]]:
    """Add a take at the start of each instance whose message is certain, and number takes anew.

    Also return the subscriptions without events of takes.
    """
    listening = objects.callbacks.filter(
        pl.col("observed") & (pl.col("kind") == "subscription") & pl.col("topic").is_not_null()
    )
    listening = listening.unique("callback_id", keep="first", maintain_order=True)
    seen = taken["callback_id"].unique().implode()
    bare = listening.filter(~pl.col("callback_id").is_in(seen))
    internal = pl.col("topic").cast(pl.String).is_in(sorted(INTERNAL_TOPICS))
    bare = bare.filter(~internal)
    if bare.is_empty():
        return taken, ()
    ran_bare = instances.filter(~pl.col("intra_process") & ~pl.col("assumed"))
    ran_bare = ran_bare.join(bare.select("callback_id", "node", "topic"), on="callback_id")
    # Hundreds of subscriptions, of as many topics and threads: the frames are parted once.
    topics = bare["topic"].cast(pl.String).unique().implode()
    written_on = _parted(published.filter(pl.col("topic").cast(pl.String).is_in(topics)), "topic")
    over = pl.coalesce("end", "until").alias("over")
    busy_in = _parted(instances.select(*_THREAD, over, began="start"), *_THREAD)
    unseen, parts = [], []
    for (number,), ran in ran_bare.sort("start").group_by("callback_id", maintain_order=True):
        node, topic, tid, first = ran.select("node", "topic", "tid", "start").row(0)
        written = written_on.get((topic,), published.clear())
        publishers, linked = written["publisher"].n_unique(), ran.clear()
        if publishers == 1:
            threads = ran.select(_THREAD).unique(maintain_order=True).iter_rows()
            linked = _linked(ran, written, pl.concat([busy_in[thread] for thread in threads]))
            parts.append(linked)
        unseen.append(
            UnseenTakes(
                callback_id=int(str(number)),
                node=node,
                topic=str(topic),
                tid=tid,
                first_ns=first,
                runs=ran.height,
                linked=linked.height,
                publishers=publishers,
            )
        )
    if parts:
        taken = pl.concat([taken, _as_takes(pl.concat(parts), ran_bare, taken)])
        taken = taken.sort("time", "pid", "tid", maintain_order=True)
        taken = taken.drop("take").with_row_index("take")
    return taken, tuple(unseen)


def _parted(frame: pl.DataFrame, *by: str) -> dict[tuple[object, ...], pl.DataFrame]:
    """Part a frame by the values of some columns, which the parts have as well."""
    return frame.partition_by(*by, maintain_order=True, as_dict=True)


def _linked(ran: pl.DataFrame, written: pl.DataFrame, busy: pl.DataFrame) -> pl.DataFrame:
    """Select the rows of ``ran`` whose message is certain, and add its ``publication``.

    ``busy`` has when each instance on the threads of ``ran`` ``began`` and was ``over``.
    """
    sent, thread = written["time"].to_numpy(), _THREAD
    place = np.searchsorted(sent, ran["start"].to_numpy(), side="right") - 1
    counts = np.bincount(place[place >= 0], minlength=len(sent))
    started = ran.select(*thread, "start", "instance", place=pl.Series(place, dtype=pl.Int64))
    rows = written.select("publication", "time", single=pl.Series(counts == 1, dtype=pl.Boolean))
    rows = (
        rows.with_columns(before=pl.col("time").shift(1))
        .with_row_index("place")
        .cast({"place": pl.Int64})
    )
    rows = rows.join(started.unique("place", keep="first"), on="place", how="left")
    rows = latest_before(rows, busy, thread, "time", "began")
    free = (pl.col("over") <= pl.col("time")) | pl.col("began").is_null()
    # The thread that reads may publish as well. So the pause may lie before any of its instances
    # since the publication before.
    usual = float(ran["start"].diff().median() or 0)  # type: ignore[arg-type]
    apart = pl.col("began") - pl.col("over").shift(1).over(thread)
    after_pause = busy.filter((apart > _WHILE * usual).fill_null(True))
    pauses = after_pause.select(*thread, paused="began")
    rows = latest_before(rows, pauses, thread, "time", "paused").sort("place")
    free |= pl.col("paused") > pl.col("before").fill_null(0)
    stretch = (~pl.col("single")).cum_sum()
    rows = rows.with_columns(stretch=stretch, free=free.fill_null(False) & pl.col("single"))
    linked = rows.filter(pl.col("single") & pl.col("free").cum_max().over("stretch"))
    between = 0 if linked.is_empty() else linked["place"][-1] - linked["place"][0] + 1
    return linked if linked.height >= max(_FEWEST, _MOSTLY * between) else linked.clear()


def _as_takes(linked: pl.DataFrame, ran: pl.DataFrame, taken: pl.DataFrame) -> pl.DataFrame:
    """Make rows of ``taken`` from linked instances; columns that no event shows are null."""
    about = ran.select("instance", "callback_id", "node", "topic")
    rows = linked.join(about, on="instance").with_columns(
        time=pl.col("start"), intra_process=pl.lit(False)
    )
    nulls = {name: kind for name, kind in taken.schema.items() if name not in rows.columns}
    rows = rows.with_columns(pl.lit(None, kind).alias(name) for name, kind in nulls.items())
    return rows.select(pl.col(name).cast(kind) for name, kind in taken.schema.items())
