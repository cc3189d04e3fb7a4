"""When each output was due, and which outputs came late.

Where a gate decided, its row (`gate_release`) says from which instant the slots count, and what
became of an output that overran. Where no gate decided, an output is due in the cycle that the
plan says, and without a plan within a period of the chain's start. ``late`` is what a consumer
sees: it does not depend on who caused it, and no cycle is left out.

With the anchor `cycle` a gate takes an output for one of the cycle that it arrives in. The
traversal knows better: a chain that began in an earlier cycle is late by whole cycles.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.messages import gated_hops
from chainshaper.analysis.traversals import Traversals

__all__ = ["Due", "lateness_in_cycle", "with_punctuality"]

WAKE_UP_NS = 250_000


@dataclass(frozen=True)
class Due:
    """When a plan has the outputs of a chain, those on a topic, leave (ns).

    ``output`` None: the plan is for any chain. An output leaves in one of ``slots``, ``cycles``
    cycles after the one in which its chain began; with ``slots`` empty at any time of that cycle.
    ``last_slot`` is the place of the last slot that is open to a mode, where the plan has modes.
    ``from_cycle``: slots count from the start of the
    cycle, else from the chain's own start. ``margin_ns`` is ε, what a gate absorbs in every
    cycle.
    """

    cycle_ns: int
    cycles: int = 0
    slots: tuple[tuple[int, int], ...] = ()
    last_slot: Mapping[str, int] = field(default_factory=dict)
    from_cycle: bool = False
    margin_ns: int = 0
    output: str | None = None


def with_punctuality(
    flow: DataFlow, traversals: Traversals, due: Due | None
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The frame of traversals with more columns, and all decisions of gates about them.

    * ``place_ns``: where the output left, from the instant that the slots count from.
    * ``due_at``: when it should have left; of several slots the one it was let go in. Where no gate
      decided it is when it left, or the end of the cycle that it was due in, if that came first.
    * ``late``: whether it left behind the last slot it was due in, or the cycle (null: nothing says
      when it was due).
    * ``origin``: from when the gate counted (null: no gate decided); ``computed_at``: when the
      chain was done, at the gate's door or with the publication.

    The decisions are those of :func:`~chainshaper.analysis.messages.gated_hops`.
    """
    releases = gated_hops(
        flow.events, flow.objects, traversals.hops, 0 if due is None else due.cycles
    )
    last = len(traversals.chain.callbacks) - 1
    decided = releases.filter(pl.col("hop") == last).drop("hop")
    frame = traversals.frame.join(decided, on="traversal", how="left", maintain_order="left")
    period = _period(flow, traversals)
    gated = pl.col("origin").is_not_null()
    began = _began(frame, due)
    limit = pl.lit(period if due is None else (due.cycles + 1) * due.cycle_ns, dtype=pl.Int64)
    origin = pl.col("origin") - _cycles_behind(period if due is None else due.cycle_ns)
    opens, closes = _last_slot(frame, due)
    place = pl.col("end") - pl.when(gated).then(origin).otherwise(began)
    overran = pl.col("overrun").is_not_null() | (origin < pl.col("origin"))
    late = pl.when(gated).then(overran | (place >= closes).fill_null(False))
    due_at = pl.when(gated).then(pl.min_horizontal("release", origin + opens))
    bound = began + limit if due is not None else pl.lit(None, dtype=pl.Int64)
    judged = frame.with_columns(
        place_ns=place,
        due_at=due_at.otherwise(pl.min_horizontal("end", bound)),
        late=late.otherwise(place >= limit) & pl.col("end").is_not_null(),
        computed_at=pl.coalesce("arrival", "end"),
    )
    added = ("place_ns", "due_at", "late", "origin", "computed_at")
    return judged.select(*traversals.frame.columns, *added), releases


def lateness_in_cycle(starts: pl.Series, cycle_ns: int) -> pl.Series:
    """How long after the start of the cycle each chain began (ns).

    When cycles started is not recorded. The earliest beginning stands for it, which is the one
    behind the widest part of the cycle that has none, and came a wake-up after the start.
    """
    places = (starts % cycle_ns).sort()
    if not len(places):
        return starts
    gaps = places.diff().fill_null(places[0] + cycle_ns - places[-1])
    earliest: int = places[gaps.arg_max() or 0]
    behind: pl.Series = starts - (earliest - WAKE_UP_NS)
    return pl.select(behind % cycle_ns).to_series()


def _period(flow: DataFlow, traversals: Traversals) -> int | None:
    """The period of the timer that starts the chain; None where no timer does."""
    callbacks = flow.objects.callbacks
    own = callbacks.filter(pl.col("callback_id") == traversals.chain.callbacks[0])["period_ns"]
    found: int | None = own.drop_nulls().max()  # type: ignore[assignment]
    return found


def _began(frame: pl.DataFrame, due: Due | None) -> pl.Expr:
    """From when slots count where no gate says so."""
    if due is None or not due.from_cycle:
        return pl.col("start")
    return pl.col("start") - pl.lit(lateness_in_cycle(frame["start"], due.cycle_ns))


def _cycles_behind(cycle_ns: int | None) -> pl.Expr:
    """How long before the gate's cycle the one began in which the chain did: whole cycles (ns).

    A chain may begin a little before its cycle does, by a tenth of it at most.
    """
    if cycle_ns is None:
        return pl.lit(0, dtype=pl.Int64)
    before = pl.col("origin") - pl.col("start") - cycle_ns // 10
    whole = ((before + cycle_ns - 1) // cycle_ns).clip(lower_bound=0) * cycle_ns
    return pl.when(pl.col("anchor") == "cycle").then(whole).otherwise(0)


def _last_slot(frame: pl.DataFrame, due: Due | None) -> tuple[pl.Expr, pl.Expr]:
    """Start and end of the last slot that is open to each output, from the slots' origin on.

    Without a plan the latest place at which one in time was let go stands for the start.
    """
    if due is None or not due.slots:
        in_time = frame.filter(pl.col("overrun").is_null() & (pl.col("cycles_waited") == 0))
        latest = (in_time["release"] - in_time["origin"]).max()
        return pl.lit(latest, dtype=pl.Int64), pl.lit(None, dtype=pl.Int64)
    ends = [
        pl.coalesce(
            *(
                pl.when(pl.col("mode") == mode).then(due.slots[slot][side])
                for mode, slot in due.last_slot.items()
            ),
            pl.lit(due.slots[-1][side], dtype=pl.Int64),
        )
        + due.cycles * due.cycle_ns
        for side in (0, 1)
    ]
    return ends[0], ends[1]
