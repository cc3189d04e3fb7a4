"""When each output was due, which came late, and which traversals the machine itself disturbed.

Where a gate decided, its row of `gate_release` says from which instant the slots count, and what
became of an output that overran. Where no gate decided, an output is due in the cycle that the
plan says, and without a plan within a period of the chain's start. A gate with the anchor `cycle`
counts an output to the cycle that it arrives in; the traversal knows better: a chain that began in
an earlier cycle is late by whole cycles.

A sleeper at the highest priority sees when the machine stops: a row of `machine_stall` says that on
core ``cpu`` no thread ran from ``time`` for ``duration``. Only stalls **before the moment at which
its output was due** disturb a cycle:

* **At two instants** any stall disturbs an output of a gate: where the origin is taken (between the
  traversal's start and the anchor's origin), and around the moment at which the output was due.
* **In between**, within [start, due], the stalls of a core add up. Without a gate they disturb if
  they take ``COMPUTING_THRESHOLD_NS`` or more in all; with a gate, if they take more than the
  plan's margin ε. Without a gate the window begins when the timer that starts the cycle was due: a
  stall that ends just before a late callback begins has made it late, and whatever piled up
  meanwhile runs beside it.
* A traversal that began before its disturbed predecessor was computed may have queued behind it,
  and counts as disturbed as well. Not so where traversals overlap as the plan says (logical
  execution time, pipelines), or always, in a chain that mostly takes longer than its period.
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

WAKE_UP_NS = 250_000  # from the start of a cycle to that of its first callback
WAKING_NS = 200_000  # a gate wakes up and publishes within this time of a release
COMPUTING_THRESHOLD_NS = 1_000_000  # less hardly changes a chain that computes for tens of ms

Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Due:
    """When, by a plan, the outputs of a chain leave. Times are in ns."""

    cycle_ns: int
    cycles: int = 0  # how many cycles after the one in which the chain began
    slots: tuple[tuple[int, int], ...] = ()  # in one of these of that cycle; (): at any time of it
    last_slot: Mapping[str, int] = field(default_factory=dict)  # mode → place of its last slot
    from_cycle: bool = False  # slots count from the cycle's start, else from the chain's own start
    margin_ns: int = 0  # ε, what a gate absorbs in every cycle
    output: str | None = None  # the topic; None: the plan is for any chain


def with_punctuality(
    flow: DataFlow, traversals: Traversals, due: Due | None
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add to the frame of traversals when outputs were due; also return all decisions of gates.

    Columns that are added, in ns:

    * ``place_ns``: when the output left, counted from the instant that the slots count from.
    * ``due_at``: when it should have left; of several slots, in the one in which the gate let it
      go. Where no gate decided: when it left, or the end of the cycle in which it was due, if that
      came first.
    * ``late``: whether it left behind the last slot, or the cycle, in which it was due (null: when
      it was due is not known).
    * ``origin``: the instant from which the gate counted (null: no gate decided).
    * ``computed_at``: when the chain had computed: the arrival at the gate, or the publication.
    * ``expected_at``: when the timer that starts the chain was due (:func:`timer_due`), or else the
      start.

    The decisions are the frame of :func:`~chainshaper.analysis.messages.gated_hops`.
    """
    hops, chain = traversals.hops, traversals.chain
    releases = gated_hops(flow.events, flow.objects, hops, 0 if due is None else due.cycles)
    decided = releases.filter(pl.col("hop") == len(chain.callbacks) - 1).drop("hop")
    # A message that went around the gate is published at once by the standby: it has no slot.
    decided = decided.filter(pl.col("overrun").ne_missing("bypass"))
    if decided.is_empty():  # the nulls that the join would give, but as literals, without memory
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
    # Under LET per callback, each of the gates before the last has delayed the message by a cycle.
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
    """When the timer that starts each traversal was due (ns); without a timer its start."""
    if period_ns is None:
        return pl.col("start")
    instances = flow.instances.lazy()
    first = instances.filter(pl.col("callback_id") == traversals.chain.callbacks[0])
    starts = first.select("pid", "start").collect()
    processes = starts.sort("start").partition_by("pid")  # each has its own timer
    due = [
        of_process.select("start", expected=timer_due(of_process["start"], period_ns))
        for of_process in processes
    ]
    if not due:
        return pl.col("start")
    known = pl.concat(due)
    if not known["start"].is_sorted():
        known = known.sort("start", maintain_order=True)
    # Every traversal's start is one of them; of equal ones the first counts.
    place = known["start"].search_sorted(traversals.frame["start"])
    return pl.lit(known.select(pl.coalesce("expected", "start")).to_series().gather(place))


def timer_due(starts: pl.Series, period_ns: int) -> pl.Series:
    """Find when a timer was due for each start of its callback (ns), at the latest at the start.

    ``starts`` are in order. A timer keeps its phase, and one that missed several expiries fires
    once: it was due at the first expiry after the start before. Where starts show no phase (the
    clock of a simulation, a timer that was reset), it was due a period after the start before. A
    timer that mostly starts less often than its period says is not late each time: the median
    distance of its starts counts as its period.
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
    """Return the latency from which on an output is late (ns); None: not known.

    The output is late at the end of the cycle in which it is due. Without a plan, the cycle is the
    period of the timer that starts the chain.
    """
    return timer_period(flow, chain) if due is None else (due.cycles + 1) * due.cycle_ns


def timer_period(flow: DataFlow, chain: Chain) -> int | None:
    """Return the period that a chain's timer shows (ns); None: no timer starts the chain."""
    first = flow.objects.callbacks.filter(pl.col("callback_id") == chain.callbacks[0])
    return first["period_ns"].max()  # type: ignore[return-value]


def lateness_in_cycle(starts: pl.Series, cycle_ns: int) -> pl.Series:
    """Return how long after the start of its cycle each chain began (ns).

    No event shows when cycles start. So the chains' places in the cycle are looked at: the one that
    follows the widest gap between them is the earliest, and came a wake-up after the start.
    """
    places = (starts % cycle_ns).sort()
    if not len(places):
        return starts
    gaps = places.diff().fill_null(places[0] + cycle_ns - places[-1])
    earliest: int = places[gaps.arg_max() or 0]
    late: pl.Series = (starts - (earliest - WAKE_UP_NS)) % cycle_ns
    return late


def _cycles_behind(cycle_ns: int | None) -> pl.Expr:
    """Return how long before the gate's cycle the chain's own cycle began: whole cycles (ns).

    A chain may begin a little before its cycle does, by a tenth of the cycle at most.
    """
    if cycle_ns is None:
        return pl.lit(0, dtype=pl.Int64)
    before = pl.col("origin") - pl.col("start") - cycle_ns // 10
    whole = ((before + cycle_ns - 1) // cycle_ns).clip(lower_bound=0) * cycle_ns
    return pl.when(pl.col("anchor") == "cycle").then(whole).otherwise(0)


def _last_slot(frame: pl.DataFrame, due: Due | None) -> tuple[pl.Expr, pl.Expr]:
    """Start and end of the last slot that is open to each output, counted from the slots' origin.

    A shift of the slots (``moved_ns``) is part of it. Without a plan the slot starts where the last
    output that was in time was let go, and has no end.
    """
    if due is None or not due.slots:
        in_time = frame.filter(pl.col("overrun").is_null() & (pl.col("cycles_waited") == 0))
        latest = (in_time["release"] - in_time["origin"]).max()
        return pl.lit(latest, dtype=pl.Int64), pl.lit(None, dtype=pl.Int64)
    last = pl.lit(len(due.slots) - 1)
    for mode, slot in due.last_slot.items():
        last = pl.when(pl.col("mode") == mode).then(slot).otherwise(last)
    delay = due.cycles * due.cycle_ns
    sides = (pl.Series([time + delay for time in side]) for side in zip(*due.slots, strict=True))
    opens, closes = (pl.lit(side).gather(last) + pl.col("moved_ns") for side in sides)
    return opens, closes


def disturbed(flow: DataFlow, frame: pl.DataFrame, margin_ns: int = 0) -> Mask:
    """Mark the traversals that stalls disturbed; incomplete ones are never marked.

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
    # A traversal does not wait for a predecessor whose output was due after it began.
    following = np.append(start[1:], np.iinfo(np.int64).max)[: len(start)]
    overlapped = (computed[:-1] > start[1:])[~hit[:-1]]
    anyhow = 2 * np.count_nonzero(overlapped) > len(overlapped)
    busy_until = np.where((gated & (due > following)) | anyhow, start, computed)
    return complete & (hit | _queued_behind(hit, start, busy_until, complete))


def stalled_after(flow: DataFlow, start: Times, end: Times) -> Mask:
    """Mark the windows [start, end], those of deliveries, that any stall meets."""
    began, ended, _ = _stalls(flow)
    return overlapping(start, end, began, ended)


def _stalls(flow: DataFlow) -> tuple[Times, Times, Times]:
    """List stalls of STALL_NS or more: when each began and ended (ns), its core (−1: not known)."""
    table = events.table(flow.events, "machine_stall", ["cpu"])
    table = table.filter(pl.col("duration") >= STALL_NS)
    core = table["cpu"].fill_null(-1).cast(pl.Int64).to_numpy()
    return table["time"].to_numpy(), (table["time"] + table["duration"]).to_numpy(), core


def _queued_behind(hit: Mask, start: Times, busy_until: Times, may_queue: Mask) -> Mask:
    """Mark traversals that may have queued behind a disturbed one.

    ``start`` is in order. A traversal may queue if a predecessor was computed until after it began;
    it did so behind a disturbed one if an unbroken row of such links leads back to that.
    """
    linked = np.zeros(len(start), dtype=np.bool_)
    linked[1:] = may_queue[1:] & (start[1:] < np.maximum.accumulate(busy_until)[:-1])
    position = np.arange(len(start))
    run_start = np.maximum.accumulate(np.where(linked, 0, position))
    last_hit = np.maximum.accumulate(np.where(hit, position, -1))
    return np.asarray(last_hit >= run_start, dtype=np.bool_)


def stalled_within(start: Times, end: Times, began: Times, ended: Times, core: Times) -> Times:
    """Return how much time (ns) each window [start, end] lost to stalls, on the worst core.

    A gate and a meter may both have seen one stall: where stalls overlap, each ns counts once. The
    time lost in a window is the difference of two sums: what stalls took until its end, and until
    its start.
    """
    worst = np.zeros(len(start), dtype=np.int64)
    for single_core in np.unique(core):
        order = np.argsort(began[core == single_core], kind="stable")
        first, last = began[core == single_core][order], ended[core == single_core][order]
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
    """Mark the closed windows [start, end] that meet any of the intervals [began, ended).

    How many meet it: the intervals that begin before its end, less those that end before its start.
    """
    begun_by_end = np.searchsorted(np.sort(began), end, side="right")
    over_by_start = np.searchsorted(np.sort(ended), start, side="right")
    return np.asarray(begun_by_end > over_by_start, dtype=np.bool_)
