"""The age of the data that a loop works with, in each of its cycles.

A chain's latency is its reaction: from the sensor to the first output into which a message went. A
loop also works between two messages, with older data, and at its own phase. So this module says of
each of its cycles which message it used, how old that was when the loop read it, and how old when
the chain's output left. The age counts from the start of the chain's first callback, as the latency
does.

Which message that is, the traversals say (:mod:`~chainshaper.analysis.traversals`): the newest that
was stored before the turn began, or that the loop took itself in this turn. That the newest one
wins is an inference, unless the loop evidently queues its messages.

Two instants are not known: when a callback stores its message, between its start and its end, and
when the loop reads it, between its wake-up and its output. Mostly a loop reads at once. But a lock,
or another thread on its core, may hold it up behind its wake-up; then it reads what was stored
meanwhile. And a callback may have stored its message, or not yet, as the loop wakes up. So where
both overlap the cycle is **ambiguous**: which message it used cannot be told, only that it was this
one or the one before. A message counts as stored at the start of its callback.
"""

from dataclasses import dataclass
from typing import NamedTuple

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.graph import readers
from chainshaper.analysis.traversals import Traversals, reading_instants, traverse
from chainshaper.values.application import ApplicationGraph, Callback, Chain

_NEVER = 1 << 62  # ns


@dataclass(frozen=True)
class DataAge:
    """What a loop of a chain worked with.

    ``cycles`` has one row for each publication of the loop on the chain's topic, in order:

    * ``start``: of the loop's instance (ns).
    * ``publish``: when the output left the loop's process (ns).
    * ``end``: when the chain's last output left that came of it (ns; null: none did).
    * ``traversal``: whose message it used (null: none had come yet).
    * ``age_at_loop_ns``: how old the message was when the loop read it.
    * ``age_at_end_ns``: how old it was when the chain's output left.
    * ``use``: 1 for the first cycle that used this message, 2 for the second, and so on.
    * ``ambiguous``: whether another thread's callback may have stored a message between the loop's
      wake-up and its output (null: when it woke up is not known).

    ``messages`` has a row for each message that came: ``traversal``, ``stored`` (ns).
    ``uses`` counts messages: ``never`` used, used ``once``, and ``again`` (in more than one cycle).
    """

    loop: Callback
    topic: str
    cycles: pl.DataFrame
    messages: pl.DataFrame
    uses: dict[str, int]
    most_uses: int

    @property
    def ambiguous(self) -> int | None:
        """In how many cycles it cannot be told which message was used; None: not known."""
        known = self.cycles["ambiguous"].drop_nulls()
        return int(known.sum()) if len(known) or self.cycles.is_empty() else None

    @property
    def at_loop_ns(self) -> pl.Series:
        """The age of the message (ns), when it was read, of each cycle that used one."""
        return self.cycles.drop_nulls("traversal")["age_at_loop_ns"]


def data_age(
    flow: DataFlow,
    traversals: Traversals,
    graph: ApplicationGraph,
    between: tuple[int, int | None] | None = None,
) -> DataAge | None:
    """Find what the chain's last loop worked with; None: no loop reads what the chain stores.

    ``between``: two instants (ns; the second may be None) between which its cycles began.
    """
    reading = last_loop(graph, traversals.chain)
    if reading is None:
        return None
    return _ages_at(flow, traversals, graph, reading.hop, loop=reading.loop, between=between)


class LoopReading(NamedTuple):
    """A loop that a chain goes through.

    ``hop`` is the place of the chain's callback that stores for it what the topic before brings;
    on the topic of that place the loop publishes.
    """

    hop: int
    loop: Callback


def last_loop(graph: ApplicationGraph, chain: Chain) -> LoopReading | None:
    """Return the last loop that a chain goes through; None: it goes through none."""
    path = graph.path(chain)
    for hop in reversed(range(len(path))):
        topic = chain.topics[hop]
        reading = readers(graph, path[hop], topic) if topic in path[hop].passes_on else []
        loops = [reader for reader in reading if reader.kind == "loop"]
        if loops and len(reading) == 1:
            return LoopReading(hop, loops[0])
    return None


def _ages_at(
    flow: DataFlow,
    traversals: Traversals,
    graph: ApplicationGraph,
    hop: int,
    *,
    loop: Callback,
    between: tuple[int, int | None] | None,
) -> DataAge:
    """Say what a loop worked with that reads what the chain's callback at ``hop`` stores."""
    topic = traversals.chain.topics[hop]
    begun = traversals.frame.select("traversal", begun="start")
    messages = traversals.hops.filter(pl.col("hop") == hop)
    messages = messages.select("traversal", "publication", "instance", stored="start")
    messages = messages.join(begun, on="traversal", maintain_order="left")
    outputs = flow.publications.filter(
        pl.col("instance").is_not_null(), callback_id=loop.id, topic=topic
    ).select("publication", "instance", "time", publish="sent")
    start = pl.lit(flow.instances["start"]).gather("instance")
    reads = pl.lit(reading_instants(flow)).gather("instance")
    outputs = outputs.with_columns(start=start, reads=reads).sort("time", maintain_order=True)
    outputs = outputs.with_columns(ambiguous=_ambiguous(flow, outputs, messages["instance"]))
    # What is published without a new message repeats the one before.
    first_uses = messages.drop("instance").drop_nulls("publication")
    used = outputs.join(first_uses, on="publication", how="left", maintain_order="left")
    used = used.with_columns(pl.col("traversal", "stored", "begun").forward_fill())
    used = used.join(
        _ends(flow, traversals.chain, graph, hop, loop),
        on="publication",
        how="left",
        maintain_order="left",
    )
    read = pl.max_horizontal("reads", "stored")
    cycles = used.select(
        "start",
        "publish",
        "end",
        "traversal",
        age_at_loop_ns=read - pl.col("begun"),
        age_at_end_ns=pl.col("end") - pl.col("begun"),
        use=pl.when(pl.col("traversal").is_not_null()).then(
            pl.int_range(1, pl.len() + 1).over("traversal")
        ),
        ambiguous="ambiguous",
    )
    if between is not None:
        since, until = between
        last = _NEVER if until is None else until
        cycles = cycles.filter(pl.col("start").is_between(since, last))
        messages = messages.filter(pl.col("stored").is_between(since, last))
    uses, most_uses = count_uses(cycles, messages)
    came = messages.select("traversal", "stored")
    return DataAge(loop, topic, cycles, came, uses, most_uses)


def _ambiguous(flow: DataFlow, outputs: pl.DataFrame, storing: pl.Series) -> pl.Series:
    """Say of each output of a loop whether a message may have been stored while it was made.

    ``storing`` are the instances of the callback that stores. Those on the loop's own thread are
    left out: it takes messages itself, before or behind its publication.
    """
    columns = flow.instances.select("tid", "start", "end")
    stored = columns[storing.drop_nulls().unique()].sort("start")
    turns = outputs.select("time", row=pl.int_range(pl.len()), instance="instance")
    turns = turns.hstack(columns[outputs["instance"]].rename({"start": "woke", "end": "slept"}))
    parts = []
    for of_thread in turns.partition_by("tid"):
        others = stored.filter(pl.col("tid") != of_thread["tid"][0])
        ends = others.select(pl.coalesce("end", "start").cum_max()).to_series()
        before = others["start"].search_sorted(of_thread["time"], side="left").cast(pl.Int64) - 1
        last = pl.when(before >= 0).then(pl.lit(ends).gather(before.clip(0))) if len(ends) else None
        over = pl.lit(None, pl.Int64) if last is None else last
        parts.append(
            of_thread.select(
                "row",
                ambiguous=pl.when(pl.col("slept").is_not_null()).then(
                    (over > pl.col("woke")).fill_null(False)
                ),
            )
        )
    if not parts:
        return pl.Series("ambiguous", [], pl.Boolean)
    return pl.concat(parts).sort("row")["ambiguous"]


def _ends(
    flow: DataFlow, chain: Chain, graph: ApplicationGraph, hop: int, loop: Callback
) -> pl.DataFrame:
    """Make a frame of when the chain's output left that came of each output of the loop.

    Columns: ``publication`` (of the loop), ``end``.
    """
    rest = Chain(chain.spec, (loop.id, *chain.callbacks[hop + 1 :]), chain.topics[hop:])
    if len(rest.topics) == 1:
        return flow.publications.select("publication", end="sent")
    onward = traverse(flow, rest, graph)
    instances = onward.hops.filter(hop=0).select("traversal", "instance")
    ends = onward.frame.filter("complete").join(instances, on="traversal")
    ends = ends.group_by("instance").agg(pl.col("end").min())
    outputs = flow.publications.filter(callback_id=loop.id, topic=rest.topics[0])
    return outputs.select("publication", "instance").join(ends, on="instance").drop("instance")


def use_shares(uses: dict[str, int]) -> tuple[float | None, float | None]:
    """Return the shares of messages that were never used, and used again; None: none came."""
    count = sum(uses.values())
    return (uses["never"] / count, uses["again"] / count) if count else (None, None)


def count_uses(cycles: pl.DataFrame, messages: pl.DataFrame) -> tuple[dict[str, int], int]:
    """Count how often messages were used that came before the loop's last cycle; and the most.

    ``cycles`` has the columns ``start`` and ``traversal``, ``messages`` has ``traversal`` and
    ``stored``.
    """
    counts = cycles.drop_nulls("traversal").group_by("traversal").agg(uses=pl.len())
    last = cycles["start"].max()
    came = messages.filter(pl.col("stored") < pl.lit(last, pl.Int64)).select("traversal").unique()
    joined = came.join(counts, on="traversal", how="left")["uses"].fill_null(0)
    taken_in_last = counts.join(came, on="traversal", how="anti")["uses"]
    uses = joined.append(taken_in_last.cast(joined.dtype))
    return {
        "never": int((uses == 0).sum()),
        "once": int((uses == 1).sum()),
        "again": int((uses > 1).sum()),
    }, int(uses.max() or 0)
