"""How loops keep their rate: period, jitter of start, overruns; in a recording, or as they run."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.loops import loop_period
from chainshaper.values import events
from chainshaper.values.application import LOOP_ENDS
from chainshaper.values.durations import duration_text


@dataclass(frozen=True)
class LoopRate:
    """How a loop kept its rate over some time. Times are in ns."""

    node: str
    publishes: tuple[str, ...]  # its topics; (): it is named, and publishes nothing
    tids: tuple[int, ...]
    count: int  # of its instances
    period_ns: int | None  # None: it sleeps irregularly, or had less than three instances
    start_jitter_ns: int | None
    """Of starts behind the end of its time to sleep, the latest less the earliest; None: no event
    shows how it sleeps."""
    overruns: int | None
    """Instances that ended when the next one should have begun; None: not known."""
    apart_ns: tuple[int, int, int] | None = None
    """How far apart starts are: 5th, 50th and 95th percentile; None: less than three."""

    @property
    def irregular(self) -> str:
        """Why it has no period, in words."""
        if self.apart_ns is None:
            return "it had fewer than three instances: it has no period"
        low, usual, high = map(duration_text, self.apart_ns)
        return (
            f"it sleeps irregularly, usually {usual} lie between its starts, from {low} (p5) to"
            f" {high} (p95): it has no period"
        )

    @property
    def overrun_share(self) -> float | None:
        """The share of its instances that overran."""
        return None if self.overruns is None or not self.count else self.overruns / self.count

    @property
    def label(self) -> str:
        """The loop in words: ``loop of /actor to /cmd``."""
        return loop_label(self.node, self.publishes)


def loop_label(node: str, topics: tuple[str, ...]) -> str:
    """Name a loop by its node and topics, in words."""
    return f"loop of {node}" + (f" to {', '.join(topics)}" if topics else "")


def loop_instances(flow: DataFlow) -> pl.DataFrame:
    """Make a frame of the instances of all loops, sorted by start. Columns:

    * ``node``; ``publishes``: the topics of its loop, a sorted list.
    * ``pid``, ``tid``; ``cpu``: the core on which it woke up (null: not known).
    * ``start``, ``end``, ``due``: when it woke up, slept again, and had wanted to wake up
      (ns; null: not known).
    * ``execution_ns``: its CPU time (null: not known).
    * ``overran``: whether it ended when the next one should have begun (null: not known).
    """
    loops = flow.objects.callbacks.filter(pl.col("kind") == "loop", pl.col("node").is_not_null())
    names = loops.select("callback_id", pl.col("node").cast(pl.String))
    names = names.unique("callback_id", keep="first", maintain_order=True)
    topic = pl.col("topic").cast(pl.String)
    topics = flow.publications.select("callback_id", topic).drop_nulls()
    for ending in LOOP_ENDS:
        topics = topics.filter(~topic.str.ends_with(ending))
    published = topics.group_by("callback_id").agg(publishes=topic.unique().sort())
    names = names.join(published, on="callback_id", how="left")
    rows = flow.instances.join(names, on="callback_id").join(flow.turns, on="instance", how="left")
    woke = events.table(flow.events, "thread_wake", ["cpu"]).select(
        "pid", "tid", "cpu", start="time"
    )
    woke = woke.unique(["pid", "tid", "start"], keep="last", maintain_order=True)
    rows = rows.join(woke, on=["pid", "tid", "start"], how="left")
    return rows.sort("start", maintain_order=True).select(
        "node",
        pl.col("publishes").fill_null(pl.lit([], pl.List(pl.String))),
        *("pid", "tid", "cpu", "start", "end", "due", "execution_ns", "overran"),
    )


def loop_rates(instances: pl.DataFrame) -> list[LoopRate]:
    """Say of each loop how it kept its rate; ``instances`` is a frame of :func:`loop_instances`.

    Loops of a node that publish the same topic are one loop: its node may have been started again.
    """
    return [_rate(node, topics, rows) for node, topics, rows in _by_loop(instances)]


def of_rate(instances: pl.DataFrame, rate: LoopRate) -> pl.DataFrame:
    """Select the instances of the loop that a rate is of."""
    shared = pl.col("publishes").list.set_intersection(
        pl.lit([*rate.publishes], pl.List(pl.String))
    )
    same = shared.list.len() > 0 if rate.publishes else pl.col("publishes").list.len() == 0
    return instances.filter(pl.col("node") == rate.node, same)


def _by_loop(instances: pl.DataFrame) -> list[tuple[str, tuple[str, ...], pl.DataFrame]]:
    """Return node, topics and instances of each loop, in the order of nodes and topics."""
    groups: list[tuple[str, set[str], list[pl.DataFrame]]] = []
    parts = instances.partition_by("node", "publishes", maintain_order=True)
    for part in parts:
        node, topics = part["node"][0], {*part["publishes"][0]}
        rows = [part]
        for group in [group for group in groups if group[0] == node]:
            if group[1] & topics or not (group[1] or topics):
                groups.remove(group)
                topics |= group[1]
                rows = [*group[2], *rows]
        groups.append((node, topics, rows))
    named = [(node, tuple(sorted(topics)), rows) for node, topics, rows in groups]
    named.sort(key=lambda group: group[:2])
    return [(node, topics, pl.concat(rows).sort("start")) for node, topics, rows in named]


def _rate(node: str, topics: tuple[str, ...], rows: pl.DataFrame) -> LoopRate:
    """Say how the loop of these instances, in order, kept its rate."""
    periods = [
        period
        for of_thread in rows.partition_by("pid", "tid", maintain_order=True)
        if (period := loop_period(of_thread["start"], of_thread["due"])) is not None
    ]
    late = (rows["start"] - rows["due"]).drop_nulls()
    lateness = late.to_list()
    jitter = max(lateness) - min(lateness) if lateness else None
    known = rows["overran"].count()
    return LoopRate(
        node=node,
        publishes=topics,
        tids=tuple(rows["tid"].unique().sort()),
        count=rows.height,
        period_ns=max(periods, default=None),
        start_jitter_ns=jitter,
        overruns=int(rows["overran"].sum()) if known else None,
        apart_ns=_apart(rows),
    )


def _apart(rows: pl.DataFrame) -> tuple[int, int, int] | None:
    """Return percentiles of the distances of starts in each thread (ns)."""
    apart = rows.select(pl.col("start").diff().over("pid", "tid")).drop_nulls().to_series()
    if len(apart) < 2:
        return None
    low, usual, high = (round(float(v)) for v in np.percentile(apart.to_numpy(), (5, 50, 95)))
    return low, usual, high
