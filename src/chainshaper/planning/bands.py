"""Where to put the publish slots of several latency bands, exactly (sections 3.3 and 4.1).

With ν bands an execution publishes in the first slot that ends after it is done. With x_α the end
of slot α and φ the measured distribution, the average is eq. 5,

    Σ_α (φ(x_α) − φ(x_{α−1}))·x_α,

and the last slot stays where single-band shaping has it. Where an output that comes into an open
slot waits for the next one, φ(x_α − Δ) stands for φ(x_α), as if all latencies were Δ longer.
Dynamic programming finds the optimum on a grid of instants, from the last slot backwards. With c_j
of n latencies ≤ x_j, the least cost of the m bands behind one that ends at x_i is

    B_m(i) = min over j of (c_j − c_i)·x_j + B_{m−1}(j),    B_1(i) = (n − c_i)·x_ν.

**Why this is exact.** For row i, column j costs the value at c_i of a line with intercept
c_j·x_j + B_{m−1}(j) and slope −x_j. Every constraint (Δ, LV, the cap on a band's share) says that j
lies in a window whose ends ascend with i, and so do the c_i. The kernel keeps the lower envelope of
the lines, in an order of rows in which windows only grow, so that it loses no line that a later row
needs. Each layer is linear in the number of grid points.

Placement by a particle swarm and at random (section 5.1.5, tables 3 and 4) is for comparison.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.planning import chain_plan as plans
from chainshaper.planning.chain_plan import ChainPlan, Prediction, Slot, publish_slots
from chainshaper.planning.latencies import check_latencies
from chainshaper.robot.gate import IntoOpenSlot
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, extra_library
from chainshaper.values.plan_choices import Goal, Solver

UNREACHABLE = _core.UNREACHABLE  # the cost of a placement that is not allowed
MOST_CELLS = 120_000_000  # grid points × bands: more would take more than a gigabyte
MOST_BANDS = 12  # as far as `auto` looks; figure 7 is flat from the fourth on
RANDOM_TRIES = 10_000
# Section 5.1.5:
PARTICLES, ITERATIONS, OPTIONS = 100, 150, {"c1": 0.5, "c2": 0.3, "w": 0.9}


def counts_and_mean(
    ordered_ns: NDArray[np.int64], ends_ns: NDArray[np.int64] | Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Count how many of ascending latencies publish in each slot; return the average of eq. 5, too.

    Slot ends ascend along the last axis; the last is not before the longest latency.
    """
    ends = np.asarray(ends_ns)
    counts = np.diff(np.searchsorted(ordered_ns, ends, side="right"), prepend=0, axis=-1)
    return counts, (counts * ends).sum(axis=-1) / ordered_ns.size


def predict_bands(
    latencies_ns: NDArray[np.int64],
    slot_ends_ns: Sequence[int],
    publish_slot_ns: int,
    into_open_slot: IntoOpenSlot = "at-once",
) -> Prediction:
    """Predict what publication in slots with these ends, Δ long, makes of measured latencies.

    The latest output is at x_ν, the earliest at x_1 − Δ: a jitter of 25 ms for the paper's slots
    [62, 63], [77, 78], [86, 87] ms. Where outputs leave only when a slot begins, it is x_ν − x_1.
    """
    ends = [int(end) for end in slot_ends_ns]
    if not ends or any(after <= before for before, after in pairwise(ends)):
        raise InputError(f"slot ends must ascend, at least one: found {ends}")
    at_start = publish_slot_ns if into_open_slot == "next-slot" else 0
    _refuse_before_longest(ends[-1] - at_start, int(latencies_ns.max()))
    counts, mean = counts_and_mean(np.sort(latencies_ns) + at_start, ends)
    return Prediction(
        mean_ns=round(float(mean)),
        max_ns=ends[-1],
        jitter_ns=ends[-1] - (ends[0] - publish_slot_ns) - at_start,
        shares=tuple((counts / counts.sum()).tolist()),
    )


def _refuse_before_longest(latest_ns: int, longest_ns: int) -> None:
    if latest_ns < longest_ns:
        reason = f"the last slot takes outputs until {duration_text(latest_ns)}, before the longest"
        raise InputError(f"{reason} latency {duration_text(longest_ns)}: move it behind")


@dataclass(frozen=True)
class BandProblem:
    """The constraints of a placement, checked.

    Raises InputError: no placement could obey them.
    """

    latencies_ns: NDArray[np.int64]  # the sample; ascending, once the problem is made
    last_end_ns: int  # where the last slot ends
    publish_slot_ns: int = 1_000_000  # how long slots are (Δ)
    grid_ns: int = 1_000  # all slots but the last end at multiples of it
    max_gap_ns: int | None = None  # how far neighbouring slot ends may be apart (LV); None: any
    max_share: float | None = None  # the share of the executions that a band may have; None: any
    into_open_slot: IntoOpenSlot = "at-once"  # when an output leaves that comes into an open slot

    def __post_init__(self) -> None:
        slot, gap, share = self.publish_slot_ns, self.max_gap_ns, self.max_share
        latencies = np.sort(check_latencies(self.latencies_ns))
        object.__setattr__(self, "latencies_ns", latencies)
        if slot <= 0 or self.grid_ns <= 0:
            raise InputError("the publish slot and the grid must be longer than 0 ms")
        _refuse_before_longest(self.last_end_ns - self.at_start_ns, int(latencies[-1]))
        if gap is not None and gap <= slot:
            reason = f"not longer than the publish slot {duration_text(slot)}: allow more"
            gap_is = f"the largest gap {duration_text(gap)} is"
            raise InputError(f"no two slots could follow each other: {gap_is} {reason}")
        if share is not None and not 0 < share <= 1:
            raise InputError(f"the largest share per band must be above 0, at most 1: not {share}")
        if latencies.size * self.last_end_ns >= 2**62:
            raise InputError("latencies this long and this many overflow: plan with fewer")

    @property
    def at_start_ns(self) -> int:
        """How long before a slot's end an output that leaves in it has to be ready: 0, or Δ."""
        return self.publish_slot_ns if self.into_open_slot == "next-slot" else 0

    @property
    def ready_ns(self) -> NDArray[np.int64]:
        """The earliest slot end, ascending, at which each execution may publish."""
        return self.latencies_ns + self.at_start_ns

    @property
    def most_per_band(self) -> int:
        """How many of the sample's latencies one band may hold."""
        size = self.latencies_ns.size
        return size if self.max_share is None else int(self.max_share * size + 1e-9)

    @property
    def room(self) -> int:
        """How many publish slots fit: the first from L̲ + Δ + 1 ns on, then each Δ + 1 ns later."""
        behind = self.last_end_ns - int(self.latencies_ns[0])
        return max(1, behind // (self.publish_slot_ns + 1))

    @property
    def positions(self) -> tuple[int, int]:
        """Where other slots may end: the first place on the grid with x_1 − Δ > L̲, and how many
        places there are from it on below x_ν − Δ.
        """
        first = (int(self.latencies_ns[0]) + self.publish_slot_ns) // self.grid_ns + 1
        return first, -(-(self.last_end_ns - self.publish_slot_ns) // self.grid_ns) - first


class Placement(NamedTuple):
    """Where the slots of latency bands are."""

    slot_ends_ns: tuple[int, ...]  # ascending
    mean_ns: float  # the average latency that eq. 5 predicts


class BandChoice(NamedTuple):
    """What ``auto`` takes from the placements with one, two, … bands (figure 7)."""

    curve: tuple[Placement, ...]
    chosen: Placement
    reason: str  # why it takes no more bands


def with_bands(
    plan: ChainPlan,
    latencies_ns: NDArray[np.int64],
    bands: int | Literal["auto"],
    *,
    most_ns: NDArray[np.int64] | None = None,
    solver: Solver = "exact",
    minimise: Goal = "mean",
    mean_at_most_ns: int | None = None,
    least_gain: float = 0.02,
    seed: int | None = None,
    grid_ns: int = 1_000,
    max_gap_ns: int | None = None,
    max_share: float | None = None,
) -> ChainPlan:
    """Return a shaped plan with ``bands`` publish slots of the plan's length; the last one stays.

    ``most_ns`` are the latencies where others delay all executions: the average is not beyond
    theirs. For ``auto`` see :func:`choose_bands`, for ``minimise`` and ``mean_at_most_ns``
    :func:`place_bands`, for ``grid_ns`` to ``max_share`` :class:`BandProblem`.

    Raises OperationError: no such placement exists; the message names the constraint.
    """
    problem = band_problem(plan, latencies_ns, grid_ns, max_gap_ns, max_share)
    has_other_goal = minimise != "mean" or mean_at_most_ns is not None
    if has_other_goal and (bands == "auto" or solver != "exact"):
        raise InputError("another goal than the average needs the exact solver and fixed bands")
    if bands == "auto":
        if solver != "exact":
            raise InputError("only the exact solver chooses the number of bands by itself")
        placement = _choose(problem, least_gain).chosen
    elif solver == "exact":
        placement = place_bands(problem, bands, minimise=minimise, mean_at_most_ns=mean_at_most_ns)
    elif solver == "pso":
        placement = place_by_swarm(problem, bands, seed)
    else:
        placement = place_randomly(problem, bands, seed)
    most = latencies_ns if most_ns is None else most_ns
    return with_slots_ending_at(
        plan, latencies_ns, most, placement.slot_ends_ns, problem.publish_slot_ns
    )


def with_slots_ending_at(
    plan: ChainPlan,
    latencies_ns: NDArray[np.int64],
    most_ns: NDArray[np.int64],
    slot_ends_ns: Sequence[int],
    publish_slot_ns: int,
) -> ChainPlan:
    """Return a shaped plan with these publish slots, and what they make of the latencies.

    ``most_ns`` as for :func:`with_bands`.
    """
    length, ends = publish_slot_ns, slot_ends_ns
    latest = predict_bands(most_ns, ends, length, plan.into_open_slot)
    likely = predict_bands(latencies_ns, ends, length, plan.into_open_slot)
    predicted = likely.model_copy(update={"mean_ns": latest.mean_ns})
    return with_publish_slots(plan, [(end - length, end) for end in ends], predicted=predicted)


def choose_bands(
    plan: ChainPlan,
    latencies_ns: NDArray[np.int64],
    *,
    least_gain: float = 0.02,
    grid_ns: int = 1_000,
    max_gap_ns: int | None = None,
    max_share: float | None = None,
) -> BandChoice:
    """Choose the number of bands, as :func:`with_bands` does for ``auto``.

    It is the first with which another band takes less than ``least_gain`` off the average.
    """
    return _choose(band_problem(plan, latencies_ns, grid_ns, max_gap_ns, max_share), least_gain)


def _choose(problem: BandProblem, least_gain: float) -> BandChoice:
    if not 0 < least_gain < 1:
        raise InputError(f"the least gain is a share, such as 0.02: not {least_gain}")
    curve = placement_curve(problem, MOST_BANDS)
    chosen, most = curve[-1], len(curve[-1].slot_ends_ns)
    reason = "no more bands can be placed" if most < MOST_BANDS else "more bands are not tried"
    for placement, with_another in pairwise(curve):
        gain = 1 - with_another.mean_ns / placement.mean_ns
        if gain < least_gain:
            chosen = placement
            reason = f"another band would lower the average by {gain:.2%}, less than"
            reason += f" {least_gain:.2%}"
            break
    return BandChoice(tuple(curve), chosen, f"stopped at {len(chosen.slot_ends_ns)}: {reason}")


def with_long_slot(
    plan: ChainPlan, latencies_ns: NDArray[np.int64], slot_start_ns: int
) -> ChainPlan:
    """Return a shaped plan with one long publish slot, from ``slot_start_ns`` to where it ended.

    The earlier it starts, the smaller is the average and the larger the jitter (end of section
    4.1).
    """
    start, end = _last_publish_slot(plan)
    if not 0 <= slot_start_ns <= start:
        raise InputError(f"a long publish slot may start from 0 ms to {duration_text(start)}")
    published = np.maximum(check_latencies(latencies_ns), slot_start_ns)
    # An output that leaves at once is late by its publication, which ends with the slot at the
    # latest.
    mean_ns = round(int(published.sum()) / published.size)
    predicted = plans.in_one_slot((slot_start_ns, end), mean_ns)
    slots = ((slot_start_ns, end),)
    return with_publish_slots(plan, slots, predicted=predicted, policy="one-long-slot")


def band_problem(
    plan: ChainPlan,
    latencies_ns: NDArray[np.int64],
    grid_ns: int,
    max_gap_ns: int | None,
    max_share: float | None,
) -> BandProblem:
    """Return the constraints for bands of a plan, whose last publish slot stays."""
    start, end = _last_publish_slot(plan)
    return BandProblem(
        latencies_ns,
        last_end_ns=end,
        publish_slot_ns=end - start,
        grid_ns=grid_ns,
        max_gap_ns=max_gap_ns,
        max_share=max_share,
        into_open_slot=plan.into_open_slot,
    )


def _last_publish_slot(plan: ChainPlan) -> Slot:
    if slots := publish_slots(plan):
        return slots[-1]
    raise InputError(f"a plan of policy {plan.policy} has no publish slot: plan shaping first")


def with_publish_slots(plan: ChainPlan, slots: Sequence[Slot], **changes: object) -> ChainPlan:
    """Return the plan with other slots for its output, and other fields."""
    publishing = plans.output_server(plan)
    slots_of = {} if publishing is None else {publishing.name: slots}
    servers = plans.below_executors(plans.with_slots(plan.servers, slots_of))
    return plans.revised(plan, servers=servers, **changes)


def place_bands(
    problem: BandProblem, bands: int, *, minimise: Goal = "mean", mean_at_most_ns: int | None = None
) -> Placement:
    """Find the best placement of ``bands`` slots on the grid.

    Minimise the average (eq. 5; of equal placements take that with the smallest jitter), or, while
    the average stays at or below ``mean_at_most_ns``, the overall jitter x_ν − (x_1 − Δ), or the
    largest gap between neighbouring bands.

    Raises OperationError: no placement exists; the message names the constraint that prevents it.
    """
    _refuse_more_than_fit(problem, bands)
    if minimise == "jitter" and mean_at_most_ns is None:
        raise InputError("the smallest jitter is that of one band: say which average it may cost")
    tables = _Tables(problem, bands)
    best = tables.best(bands)
    if best is None:
        raise OperationError(_why_none(problem, bands))
    if mean_at_most_ns is not None and best.mean_ns > mean_at_most_ns:
        wanted, least = duration_text(mean_at_most_ns), duration_text(round(best.mean_ns))
        reason = f"no placement of {bands} bands has an average of {wanted} or less"
        raise OperationError(f"{reason}; the best is {least}: allow that, or more bands")
    if minimise == "gap":
        return _smallest_gap(problem, best, mean_at_most_ns)
    if minimise == "jitter" and bands > 1 and mean_at_most_ns is not None:
        allowed = tables.totals(bands) <= mean_at_most_ns * problem.latencies_ns.size
        return tables.read(bands, int(np.flatnonzero(allowed)[-1]))
    return best


def placement_curve(problem: BandProblem, most_bands: int) -> list[Placement]:
    """Find the best placement for each number of bands from 1 on, as far as they fit (figure 7)."""
    most = min(most_bands, problem.room)
    tables = _Tables(problem, most)
    curve: list[Placement] = []
    for bands in range(1, most + 1):
        if best := tables.best(bands):
            curve.append(best)
        elif curve:
            break
    if not curve:
        raise OperationError(_why_none(problem, most))
    return curve


def _refuse_more_than_fit(problem: BandProblem, bands: int) -> None:
    if bands < 1:
        raise InputError(f"{bands} bands: plan with one band at least")
    if bands > problem.room:
        shortest, slot = problem.latencies_ns[0], problem.publish_slot_ns
        where = f"behind the shortest latency {duration_text(int(shortest))} there is"
        reason = f"room for {problem.room} publish slots of {duration_text(slot)}"
        raise InputError(f"{bands} bands cannot be placed: {where} {reason}: use fewer or shorter")


class _Tables:
    """The tables of the dynamic programming: a column for each grid position.

    * ``ends``: the instant (ns) of each position.
    * ``counts``: how many latencies may publish in a slot that ends there.
    * ``costs``: row m is the least cost of m + 1 bands behind a band that ends there.
    * ``successors``: row m is the position of the first of these bands; −1: only the last follows.
    """

    def __init__(self, problem: BandProblem, bands: int) -> None:
        slot, grid, last = problem.publish_slot_ns, problem.grid_ns, problem.last_end_ns
        first, fitting = problem.positions
        size = max(0, fitting) if bands > 1 else 0
        layers = min(bands, size + 1)
        if size * layers > MOST_CELLS:
            reason = f"{size} positions for {layers} bands are too many to search"
            raise InputError(f"{reason}: use a grid coarser than {duration_text(grid)}")
        self.problem = problem
        self.ends = (first + np.arange(size, dtype=np.int64)) * grid
        counts = np.searchsorted(problem.ready_ns, self.ends, side="right").astype(np.int64)
        behind = problem.latencies_ns.size - counts
        reachable = behind <= problem.most_per_band
        # x_α − x_{α−1} > Δ, at most LV, and no more latencies in between than a band may hold.
        positions = np.arange(size, dtype=np.int64)
        nearest = np.minimum(positions + slot // grid + 1, size)
        farthest = np.full(size, size - 1)
        if problem.max_share is not None:
            farthest = np.searchsorted(counts, counts + problem.most_per_band, side="right") - 1
        if problem.max_gap_ns is not None:
            reachable &= last - self.ends <= problem.max_gap_ns
            farthest = np.minimum(farthest, positions + problem.max_gap_ns // grid)
        costs = np.full((max(1, layers - 1), size), UNREACHABLE)
        costs[0] = np.where(reachable, behind * last, UNREACHABLE)
        self.counts, self.costs = counts, costs
        self.successors = np.full(costs.shape, -1, dtype=np.int32)
        for layer in range(1, layers - 1):
            _core.add_band(
                ends_ns=self.ends,
                counts=counts,
                nearest=nearest,
                farthest=farthest,
                behind=costs[layer - 1],
                costs=costs[layer],
                successors=self.successors[layer],
            )

    def totals(self, bands: int) -> NDArray[np.int64]:
        """Return the cost of all bands for each position of the first; of two bands at least."""
        behind = self.costs[bands - 2]
        allowed = (behind != UNREACHABLE) & (self.counts <= self.problem.most_per_band)
        return np.where(allowed, behind + self.counts * self.ends * allowed, UNREACHABLE)

    def best(self, bands: int) -> Placement | None:
        """Return the best placement; of equally good ones that which begins last: it has the
        smallest jitter.
        """
        if bands == 1:
            fits = self.problem.latencies_ns.size <= self.problem.most_per_band
            last = self.problem.last_end_ns
            return Placement((last,), float(last)) if fits else None
        if bands - 1 > self.ends.size:
            return None
        totals = self.totals(bands)
        least = totals.min()
        place = int(np.flatnonzero(totals == least)[-1])
        return None if least == UNREACHABLE else self.read(bands, place)

    def read(self, bands: int, position: int) -> Placement:
        """Return the placement whose first band is at a position."""
        mean = int(self.totals(bands)[position]) / self.problem.latencies_ns.size
        ends = [int(self.ends[position])]
        for behind in range(bands - 2, 0, -1):
            position = int(self.successors[behind, position])
            ends.append(int(self.ends[position]))
        return Placement((*ends, self.problem.last_end_ns), mean)


def _smallest_gap(problem: BandProblem, best: Placement, mean_at_most_ns: int | None) -> Placement:
    """Return the placement with the smallest of its largest gaps, with as many bands as ``best``.

    A larger gap only ever allows more placements: halve the interval.
    """
    low = problem.publish_slot_ns
    high = max(np.diff(best.slot_ends_ns), default=low + 1)
    while high - low > 1:
        middle = int(low + high) // 2
        closer = replace(problem, max_gap_ns=middle)
        try:
            best = place_bands(closer, len(best.slot_ends_ns), mean_at_most_ns=mean_at_most_ns)
            high = max(np.diff(best.slot_ends_ns))
        except OperationError:
            low = middle
    return best


def _why_none(problem: BandProblem, bands: int) -> str:
    """Say which constraint leaves no placement: that without which there is a placement."""
    share, gap = problem.max_share or 1, duration_text(problem.max_gap_ns or 0)
    without_share, without_gap = replace(problem, max_share=None), replace(problem, max_gap_ns=None)
    for relaxed, reason in (
        (
            without_share,
            f"no placement has every band at {share:.1%} of the executions; allow a larger share or"
            " more bands",
        ),
        (without_gap, f"no placement has neighbours within {gap}; allow a larger gap"),
        (
            replace(without_share, max_gap_ns=None),
            "the largest gap and the largest share exclude each other; relax one",
        ),
    ):
        if _Tables(relaxed, bands).best(bands) is not None:
            return f"{bands} bands cannot be placed: {reason}"
    return _too_coarse(problem, bands)


def _too_coarse(problem: BandProblem, bands: int) -> str:
    grid, slot = duration_text(problem.grid_ns), duration_text(problem.publish_slot_ns)
    return f"{bands} bands cannot be placed: the grid of {grid} is too coarse for slots of {slot}"


def broken_constraint(problem: BandProblem, slot_ends_ns: Sequence[int]) -> str | None:
    """Return the first constraint that given slot ends break, in words; None: they break none.

    The grid is not checked.
    """
    broken = _broken(problem, np.array(slot_ends_ns))
    return next((words for words, off in broken if off > 0), None)


def violation_ns(problem: BandProblem, ends_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return by how much (ns) each row of slot ends breaks the constraints; 0: it is allowed."""
    off = [off_ns for _, off_ns in _broken(problem, ends_ns)]
    total = np.zeros(len(ends_ns))
    for amount in off:
        total += amount
    return total


def _broken(
    problem: BandProblem, ends: NDArray[np.int64]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield each constraint in words, and by how much (ns) each row of slot ends breaks it."""
    slot, shortest = problem.publish_slot_ns, int(problem.latencies_ns[0])
    gaps = np.diff(ends, axis=-1)
    if ends.shape[-1] > 1:
        words = f"the first slot must begin after the shortest latency {duration_text(shortest)}"
        yield words, np.clip(shortest + slot + 1 - ends[..., 0], 0, None)
    words = f"slot ends must be more than the publish slot {duration_text(slot)} apart"
    yield words, np.clip(slot + 1 - gaps, 0, None).sum(axis=-1)
    if problem.max_gap_ns is not None:
        words = f"slot ends must be at most {duration_text(problem.max_gap_ns)} apart"
        yield words, np.clip(gaps - problem.max_gap_ns, 0, None).sum(axis=-1)
    if problem.max_share is not None:
        counts, _ = counts_and_mean(problem.ready_ns, ends)
        too_many = np.clip(counts - problem.most_per_band, 0, None).sum(axis=-1)
        words = f"a band must hold at most {problem.max_share:.1%} of the executions"
        yield words, too_many * problem.last_end_ns / problem.latencies_ns.size


def place_by_swarm(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands with PySwarms and the paper's parameters.

    A particle is the ends of all slots but the last. One that breaks a constraint costs more than
    any that breaks none, and the more, the further it is off.
    """
    _refuse_more_than_fit(problem, bands)
    last, slot, grid = problem.last_end_ns, problem.publish_slot_ns, problem.grid_ns
    if bands == 1:
        return _checked(problem, [last], "the single band")

    def slot_ends(particles: NDArray[np.float64]) -> NDArray[np.int64]:
        ends = np.ceil(np.sort(particles, axis=1) / grid).astype(np.int64) * grid
        return np.hstack([ends, np.full((len(ends), 1), last)])

    def cost(particles: NDArray[np.float64]) -> NDArray[np.float64]:
        ends = slot_ends(particles)
        _, means = counts_and_mean(problem.ready_ns, ends)
        off = sum(off_ns for _, off_ns in _broken(problem, ends))
        return np.where(off > 0, last + off, means)

    lowest = np.full(bands - 1, float(problem.latencies_ns[0] + slot))
    bounds = (lowest, np.full(bands - 1, float(last - slot)))
    with _quiet_and_seeded(seed):
        swarm = extra_library("pyswarms", "placement by particle swarm").single.GlobalBestPSO(
            n_particles=PARTICLES, dimensions=bands - 1, options=OPTIONS, bounds=bounds
        )
        _, best = swarm.optimize(cost, iters=ITERATIONS, verbose=False)
    return _checked(problem, slot_ends(best[np.newaxis, :])[0].tolist(), "the swarm")


def place_randomly(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands at random; every allowed placement on the grid is equally likely.

    Raises OperationError: the grid is too coarse, or no draw of many obeys the constraints.
    """
    _refuse_more_than_fit(problem, bands)
    if bands == 1:
        return _checked(problem, [problem.last_end_ns], "the single band")
    first, size = problem.positions
    # Draw from the positions that remain when each gap's minimum beyond one step is taken out.
    spare = problem.publish_slot_ns // problem.grid_ns
    remaining = size - spare * (bands - 2)
    if remaining < bands - 1:
        raise OperationError(_too_coarse(problem, bands))
    random = np.random.default_rng(seed)
    for _ in range(RANDOM_TRIES):
        drawn = np.sort(random.choice(remaining, size=bands - 1, replace=False))
        ends = (first + drawn + spare * np.arange(bands - 1)) * problem.grid_ns
        placed = [*ends.tolist(), problem.last_end_ns]
        if broken_constraint(problem, placed) is None:
            break
    return _checked(problem, placed, "the last random draw")


def _checked(problem: BandProblem, ends: list[int], solver: str) -> Placement:
    """Return the placement at which a ``solver``, so called in the error, ended."""
    if broken := broken_constraint(problem, ends):
        reason = f"{solver} ended at a placement that is not allowed ({broken})"
        raise OperationError(f"{reason}; use the exact solver")
    return Placement(tuple(ends), float(counts_and_mean(problem.ready_ns, ends)[1]))


@contextmanager
def _quiet_and_seeded(seed: int | None) -> Iterator[None]:
    """Seed PySwarms, and keep it from logging.

    It draws from NumPy's global generator, whose state is restored afterwards, and logs into the
    current folder, unless a configuration says otherwise.
    """
    state, configured = np.random.get_state(), os.environ.get("LOG_CFG")
    with os.fdopen(os.memfd_create("logging"), "w", encoding="utf-8") as configuration:
        configuration.write("version: 1\nincremental: true\n")
        configuration.flush()
        # A file in memory: the kernel removes it with this process, however that ends.
        os.environ["LOG_CFG"] = f"/proc/self/fd/{configuration.fileno()}"
        try:
            np.random.seed(seed)
            yield
        finally:
            np.random.set_state(state)
            del os.environ["LOG_CFG"]
            if configured is not None:
                os.environ["LOG_CFG"] = configured
