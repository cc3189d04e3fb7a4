"""When each output was due, which came late, and which traversals the machine itself disturbed.

Where a gate decided, its row (`gate_release`) says from which instant the slots count, and what
became of an output that overran. Where no gate decided, an output is due in the cycle that the
plan says, and without a plan within a period of the chain's start. With the anchor `cycle` a gate
takes an output for one of the cycle that it arrives in; the traversal knows better: a chain that
began in an earlier cycle is late by whole cycles.

A sleeper at the highest priority sees the machine stop: a row of `machine_stall` says that on core
``cpu`` no thread ran from ``time`` for ``duration``. A cycle is disturbed by stalls **before the
moment at which its output was due**, and by no other:

* **At two instants** any stall disturbs what a gate lets go: where the origin is taken (between the
  traversal's start and the anchor's origin), and around the moment at which the output was due.
* **In between** stalls add up, on one core, within [start, due]. Without a gate they disturb from
  ``COMPUTING_THRESHOLD_NS`` in all; a gate absorbs what the plan's margin ε has room for. Without
  a gate a cycle is looked at from when the timer that starts it was due: a stall that ends just
  before a late callback begins has made it late, and what piled up meanwhile runs beside it.
* A traversal that began before its disturbed predecessor was computed may have queued behind it,
  and counts as disturbed with it, unless the plan has them overlap (logical execution time,
  pipelines), or they overlap anyhow, in a chain that mostly takes longer than its period.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.messages import gated_hops
from chainshaper.analysis.traversals import Traversals
from chainshaper.robot.shaper import STALL_NS
from chainshaper.values import events
from chainshaper.values.application import Chain

WAKE_UP_NS = 250_000

WAKING_NS = 200_000  # a gate wakes up and publishes within this time of a release
COMPUTING_THRESHOLD_NS = 1_000_000  # less hardly changes a chain that computes for tens of ms

Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Due:
    """When a plan has the outputs of a chain, those on a topic, leave (ns).

    ``output`` None: the plan is for any chain. An output leaves in one of ``slots``, ``cycles``
    cycles after the one in which its chain began; with ``slots`` empty at any time of that cycle.
    ``last_slot`` is the place of the last slot that is open to a mode, where the plan has modes.
    ``from_cycle``: slots count from the start of the cycle, else from the chain's own start.
    ``margin_ns`` is ε, what a gate absorbs in every cycle.
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
      chain was done, at the gate's door or with the publication; ``expected_at``: when the timer
      that starts the chain was due (:func:`timer_due`), or else the start.

    The decisions are those of :func:`~chainshaper.analysis.messages.gated_hops`.
    """
    hops, chain = traversals.hops, traversals.chain
    releases = gated_hops(flow.events, flow.objects, hops, 0 if due is None else due.cycles)
    decided = releases.filter(pl.col("hop") == len(chain.callbacks) - 1).drop("hop")
    # A standby publishes at once what went around the gate: no slot was chosen for it.
    decided = decided.filter(pl.col("overrun").ne_missing("bypass"))
    if decided.is_empty():  # nulls as the join would give them, which take no memory like this
        columns = decided.drop("traversal").schema.items()
        frame = traversals.frame.with_columns(pl.lit(None, kind).alias(n) for n, kind in columns)
    else:
        frame = traversals.frame.join(decided, on="traversal", how="left", maintain_order="left")
    start, end, counted_from = pl.col("start"), pl.col("end"), pl.col("origin")
    within = due_within(flow, chain, due)
    cycle_ns = within if due is None else due.cycle_ns
    limit = pl.lit(within, dtype=pl.Int64)
    began = start
    if due is not None and due.from_cycle:
        began = start - pl.lit(lateness_in_cycle(frame["start"], due.cycle_ns))
    gated = counted_from.is_not_null()
    origin = counted_from - _cycles_behind(cycle_ns)
    opens, closes = _last_slot(frame, due)
    place = end - pl.when(gated).then(origin).otherwise(began)
    # Under LET per callback, the gates before the last have each kept the message for a cycle.
    behind = counted_from - origin > (0 if due is None else due.cycles) * pl.lit(cycle_ns or 0)
    overran = pl.col("overrun").is_not_null() | behind
    late = pl.when(gated).then(overran | (place >= closes).fill_null(False))
    due_at = pl.when(gated).then(pl.min_horizontal("release", origin + opens))
    bound = pl.lit(None, dtype=pl.Int64) if due is None else began + limit
    return frame.select(
        *traversals.frame.columns,
        place_ns=place,
        due_at=due_at.otherwise(pl.min_horizontal("end", bound)),
        late=late.otherwise(place >= limit) & end.is_not_null(),
        origin="origin",
        computed_at=pl.coalesce("arrival", "end"),
        expected_at=_expected(flow, traversals, timer_period(flow, chain)),
    ), releases


def _expected(flow: DataFlow, traversals: Traversals, period_ns: int | None) -> pl.Expr:
    """When the timer of each traversal's first callback was due; without a timer its start."""
    if period_ns is None:
        return pl.col("start")
    first = flow.instances.filter(pl.col("callback_id") == traversals.chain.callbacks[0])
    processes = first.sort("start").partition_by("pid")  # each has its own timer
    due = [own.select("start", expected=timer_due(own["start"], period_ns)) for own in processes]
    if not due:
        return pl.col("start")
    known = pl.concat(due)
    if not known["start"].is_sorted():
        known = known.sort("start", maintain_order=True)
    # Every traversal's start is one of them; of equal ones the first counts.
    place = known["start"].search_sorted(traversals.frame["start"])
    return pl.lit(known.select(pl.coalesce("expected", "start")).to_series().gather(place))


def timer_due(starts: pl.Series, period_ns: int) -> pl.Series:
    """When a timer was due for each start of its callback, in order: at the latest at the start.

    A timer keeps its phase, and one that missed several expiries fires once: it was due at the
    first expiry behind the start before. Where starts show no phase (a clock of a simulation, a
    timer that was reset), it was due a period behind the start before. One that mostly starts less
    often than its period says is not late each time: it has the period that it shows.
    """
    usual: float = starts.diff().median() or 0.0  # type: ignore[assignment]
    if usual > 1.5 * period_ns:
        period_ns = round(usual)
    late = lateness_in_cycle(starts, period_ns)
    before = starts.shift(1)
    due = before + period_ns
    if starts.len() and (late.median() or 0) < period_ns / 4:  # type: ignore[operator]
        due = before - late.shift(1) + period_ns
    frame = pl.DataFrame({"start": starts, "due": due})
    return frame.select(pl.min_horizontal("start", "due")).to_series()


def due_within(flow: DataFlow, chain: Chain, due: Due | None) -> int | None:
    """How long after its beginning an output is late whatever the slots are (ns; None: not known).

    The period of the timer that starts the chain stands for the cycle of a plan.
    """
    return timer_period(flow, chain) if due is None else (due.cycles + 1) * due.cycle_ns


def timer_period(flow: DataFlow, chain: Chain) -> int | None:
    """The period of the timer that starts a chain, as its starts show it (ns; None: no timer)."""
    first = flow.objects.callbacks.filter(pl.col("callback_id") == chain.callbacks[0])
    return first["period_ns"].max()  # type: ignore[return-value]


def lateness_in_cycle(starts: pl.Series, cycle_ns: int) -> pl.Series:
    """How long after the start of the cycle each chain began (ns).

    When cycles started is not recorded. The beginning behind the widest part of the cycle that has
    none stands for it, which came a wake-up after the start.
    """
    places = (starts % cycle_ns).sort()
    if not len(places):
        return starts
    gaps = places.diff().fill_null(places[0] + cycle_ns - places[-1])
    earliest: int = places[gaps.arg_max() or 0]
    late: pl.Series = (starts - (earliest - WAKE_UP_NS)) % cycle_ns
    return late


def _cycles_behind(cycle_ns: int | None) -> pl.Expr:
    """How long before the gate's cycle the one began in which the chain did: whole cycles (ns).
    A chain may begin a little before its cycle does, by a tenth of it at most."""
    if cycle_ns is None:
        return pl.lit(0, dtype=pl.Int64)
    before = pl.col("origin") - pl.col("start") - cycle_ns // 10
    whole = ((before + cycle_ns - 1) // cycle_ns).clip(lower_bound=0) * cycle_ns
    return pl.when(pl.col("anchor") == "cycle").then(whole).otherwise(0)


def _last_slot(frame: pl.DataFrame, due: Due | None) -> tuple[pl.Expr, pl.Expr]:
    """Start and end of the last slot that is open to each output, from the slots' origin on, where
    it was moved to. Without a plan the latest place at which one in time was let go stands for it.
    """
    if due is None or not due.slots:
        in_time = frame.filter(pl.col("overrun").is_null() & (pl.col("cycles_waited") == 0))
        latest = (in_time["release"] - in_time["origin"]).max()
        return pl.lit(latest, dtype=pl.Int64), pl.lit(None, dtype=pl.Int64)
    last = pl.lit(len(due.slots) - 1)
    for mode, slot in due.last_slot.items():
        last = pl.when(pl.col("mode") == mode).then(slot).otherwise(last)
    delay = due.cycles * due.cycle_ns
    sides = (pl.Series([s + delay for s in side]) for side in zip(*due.slots, strict=True))
    opens, closes = (pl.lit(side).gather(last) + pl.col("moved_ns") for side in sides)
    return opens, closes


def disturbed(flow: DataFlow, frame: pl.DataFrame, margin_ns: int = 0) -> Mask:
    """A mask over the rows of ``frame``; incomplete traversals are never marked.

    ``frame`` is that of :func:`with_punctuality`, ``margin_ns`` the margin of the plan in force.
    """
    began, ended, core = _stalls(flow)
    if not len(began):
        return np.zeros(frame.height, dtype=np.bool_)
    complete, gated = frame["complete"].to_numpy(), frame["origin"].is_not_null().to_numpy()
    start, due, origin, computed, expected = (
        frame[name].fill_null(frame["start"]).to_numpy()
        for name in ("start", "due_at", "origin", "computed_at", "expected_at")
    )
    at_instants = overlapping(np.minimum(start, origin), np.maximum(start, origin), began, ended)
    at_instants |= overlapping(due - WAKING_NS, due + WAKING_NS, began, ended)
    lost = stalled_within(np.where(gated, start, expected), due, began, ended, core)
    most = np.where(gated, max(COMPUTING_THRESHOLD_NS, margin_ns + 1), COMPUTING_THRESHOLD_NS)
    hit = complete & ((gated & at_instants) | (lost >= most))
    # A predecessor that was to be out later than the next began is not waited for.
    following = np.append(start[1:], np.iinfo(np.int64).max)[: len(start)]
    overlapped = (computed[:-1] > start[1:])[~hit[:-1]]
    anyhow = 2 * np.count_nonzero(overlapped) > len(overlapped)
    busy_until = np.where((gated & (due > following)) | anyhow, start, computed)
    return complete & (hit | _queued_behind(hit, start, busy_until, complete))


def stalled_after(flow: DataFlow, start: Times, end: Times) -> Mask:
    """Which windows [start, end] any stall meets: a delivery that the machine disturbed."""
    began, ended, _ = _stalls(flow)
    return overlapping(start, end, began, ended)


def _stalls(flow: DataFlow) -> tuple[Times, Times, Times]:
    """Stalls of STALL_NS or more: when they began and ended, and their cores (−1: not known)."""
    table = events.table(flow.events, "machine_stall", ["cpu"])
    table = table.filter(pl.col("duration") >= STALL_NS)
    core = table["cpu"].fill_null(-1).cast(pl.Int64).to_numpy()
    return table["time"].to_numpy(), (table["time"] + table["duration"]).to_numpy(), core


def _queued_behind(hit: Mask, start: Times, busy_until: Times, may_queue: Mask) -> Mask:
    """Traversals, in order of start, linked to a disturbed one by predecessors still computed."""
    linked = np.zeros(len(start), dtype=np.bool_)
    linked[1:] = may_queue[1:] & (start[1:] < np.maximum.accumulate(busy_until)[:-1])
    position = np.arange(len(start))
    run_start = np.maximum.accumulate(np.where(linked, 0, position))
    last_hit = np.maximum.accumulate(np.where(hit, position, -1))
    return np.asarray(last_hit >= run_start, dtype=np.bool_)


def stalled_within(start: Times, end: Times, began: Times, ended: Times, core: Times) -> Times:
    """Per window [start, end] the time lost in it to stalls of one core, the worst one (ns).

    A gate and a meter may both have seen a stall: of those that overlap, each ns counts once. What
    stalls took up to an instant is then linear between their beginnings and ends, and a window's
    share is a difference of two.
    """
    worst = np.zeros(len(start), dtype=np.int64)
    for one in np.unique(core):
        order = np.argsort(began[core == one], kind="stable")
        first, last = began[core == one][order], ended[core == one][order]
        last = np.maximum.accumulate(last)
        first[1:] = np.maximum(first[1:], last[:-1])
        total = np.concatenate(([0], np.cumsum(last - first)))
        lost = []
        for instant in (start, end):
            index = np.searchsorted(first, instant, side="right")
            before = np.maximum(index - 1, 0)
            part = np.minimum(instant, last[before]) - first[before]
            lost.append(total[before] + np.where(index > 0, part, 0))
        worst = np.maximum(worst, lost[1] - lost[0])
    return worst


def overlapping(start: Times, end: Times, began: Times, ended: Times) -> Mask:
    """Whether each closed window [start, end] meets any of the intervals [began, ended).

    Of all intervals those that begin in time for the window, minus those that are over before it.
    """
    begun_by_end = np.searchsorted(np.sort(began), end, side="right")
    over_by_start = np.searchsorted(np.sort(ended), start, side="right")
    return np.asarray(begun_by_end > over_by_start, dtype=np.bool_)
