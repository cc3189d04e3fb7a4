"""Messages that subscriptions' callbacks got although no event tells of their takes.

Loaned messages are taken past the functions that have events, and Foxy and plain Galactic have no
events of takes at all. The callbacks' events are there. Where one publisher alone writes the topic,
and one callback starts between a publication and the next, publication and callback determine each
other, as long as no older message can be waiting: since the publication before, the thread had
nothing to do for a while, or the messages before are linked without a gap since it last had not.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.matching import latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.values.application import INTERNAL_TOPICS

_FEWEST = 3  # callbacks, each with a publication of its own, that show that they alternate
_MOSTLY = 0.5  # of the publications between the first and the last of them
_WHILE = 0.1  # of the usual distance of the callback's starts: longer than executors take for work


@dataclass(frozen=True)
class UnseenTakes:
    """A subscription's callback that ran without any event of a take.

    ``runs`` counts its instances, the first of them at ``first_ns`` in thread ``tid``, ``linked``
    those whose message is known, ``publishers`` the publishers that wrote the topic.
    """

    callback_id: int
    node: str
    topic: str
    tid: int
    first_ns: int
    runs: int
    linked: int
    publishers: int


def with_unseen_takes(
    taken: pl.DataFrame, instances: pl.DataFrame, published: pl.DataFrame, objects: Objects
) -> tuple[pl.DataFrame, tuple[UnseenTakes, ...]]:
    """``taken`` with a take at the start of each instance whose message is known, numbered anew,
    and what is known of the subscriptions without events of takes.
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
    own = instances.filter(~pl.col("intra_process") & ~pl.col("assumed"))
    own = own.join(bare.select("callback_id", "node", "topic"), on="callback_id")
    found, more = [], [taken]
    for (number,), ran in own.sort("start").group_by("callback_id", maintain_order=True):
        node, topic, tid, first = ran.select("node", "topic", "tid", "start").row(0)
        written = published.filter(pl.col("topic") == topic)
        publishers, linked = written["publisher"].n_unique(), ran.clear()
        if publishers == 1:
            linked = _linked(ran, written, instances)
            more.append(_as_takes(linked, ran, taken))
        about = (node, str(topic), tid, first, ran.height, linked.height, publishers)
        found.append(UnseenTakes(int(str(number)), *about))
    if len(more) > 1:
        taken = pl.concat(more).sort("time", "pid", "tid", maintain_order=True)
        taken = taken.drop("take").with_row_index("take")
    return taken, tuple(found)


def _linked(ran: pl.DataFrame, written: pl.DataFrame, instances: pl.DataFrame) -> pl.DataFrame:
    """The rows of ``ran`` of which the publication is certain, with ``publication``."""
    sent, thread = written["time"].to_numpy(), ["pid", "tid"]
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
    over = pl.coalesce("end", "until").alias("over")
    busy = instances.select(*thread, over, began="start")
    rows = latest_before(rows, busy, thread, "time", "began")
    free = (pl.col("over") <= pl.col("time")) | pl.col("began").is_null()
    # The thread that reads may publish as well, and have had nothing to do before that.
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
    """Linked instances as rows of ``taken``: no event says more of these takes."""
    about = ran.select("instance", "callback_id", "node", "topic")
    rows = linked.join(about, on="instance").with_columns(
        time=pl.col("start"), intra_process=pl.lit(False)
    )
    nulls = {name: kind for name, kind in taken.schema.items() if name not in rows.columns}
    rows = rows.with_columns(pl.lit(None, kind).alias(name) for name, kind in nulls.items())
    return rows.select(pl.col(name).cast(kind) for name, kind in taken.schema.items())
