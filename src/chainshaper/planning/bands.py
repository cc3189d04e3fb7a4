"""Where to put the publish slots of several latency bands, exactly (sections 3.3 and 4.1).

With ν bands an execution publishes in the first slot that ends after it is done, so most of them
come earlier than the longest latency. The average is eq. 5,

    Σ_α (φ(x_α) − φ(x_{α−1}))·x_α,

x_α the end of slot α and φ the measured distribution; the last slot stays where single-band shaping
has it. The optimum is found on a grid of instants by dynamic programming from the last slot
backwards: B_m(i), the least cost of the m bands behind a band that ends at x_i, is

    B_m(i) = min over j of (c_j − c_i)·x_j + B_{m−1}(j),    B_1(i) = (n − c_i)·x_ν,

c_i being the number of latencies ≤ x_i among n.

**Why this is exact, also under tight constraints.** For row i, column j costs the value of the line
with intercept c_j·x_j + B_{m−1}(j) and slope −x_j at c_i. Every constraint on neighbouring bands
says that j lies in a window whose both ends ascend with i: Δ and LV bound x_j − x_i, the cap on a
band's share bounds c_j − c_i, and x and c ascend. So B_m(i) is the least of the lines of a moving
window at c_i, and all the c_i ascend too. The kernel keeps the lower envelope of the lines, in an
order of rows in which windows only grow, so that no line is lost that a later row may need, and
positions from which no placement leads on are left out. Each layer is linear in the number of grid
points. (The cost is Monge as well, w(i, j) + w(i', j') ≤ w(i, j') + w(i', j) for i < i', j < j',
which is why the average gains less with every further band.)

Placement by particle swarm, as the paper does it, and at random (section 5.1.5, the rows "PSO" and
"Random" of tables 3 and 4) are for comparison: neither better nor faster.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.margins import check_latencies
from chainshaper.planning.plan import (
    Plan,
    Prediction,
    Slot,
    below_executors,
    output_server,
    publish_slots,
    revised,
    with_slots,
)
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError, extra_library
from chainshaper.values.plan_choices import Goal, Solver

UNREACHABLE = 2**63 - 1  # the cost of what cannot be placed
MOST_CELLS = 120_000_000  # grid points × bands: more than a gigabyte
MOST_BANDS = 12  # as far as `auto` looks; figure 7 is flat from the fourth on

# Section 5.1.5.
PARTICLES = 100
ITERATIONS = 150
OPTIONS = {"c1": 0.5, "c2": 0.3, "w": 0.9}

RANDOM_TRIES = 10_000


def counts_and_mean(
    ordered_ns: NDArray[np.int64], ends_ns: NDArray[np.int64] | Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How many of ascending latencies publish in each slot, and the average of eq. 5.

    An execution whose latency is in (x_{α−1}, x_α] publishes in slot α: φ(x_α) − φ(x_{α−1}) times
    the sample. ``ends_ns`` ascend along the last axis, none before the longest latency behind.
    """
    ends = np.asarray(ends_ns)
    counts = np.diff(np.searchsorted(ordered_ns, ends, side="right"), prepend=0, axis=-1)
    return counts, (counts * ends).sum(axis=-1) / ordered_ns.size


def predict_bands(
    latencies_ns: NDArray[np.int64], slot_ends_ns: Sequence[int], publish_slot_ns: int
) -> Prediction:
    """What publication in given slots makes of measured latencies.

    A band is represented by the end of its slot, x_α. The latest output is at x_ν, the earliest at
    the start of the first slot, so the jitter is x_ν − (x_1 − Δ): 25 ms for the paper's slots [62,
    63], [77, 78], [86, 87] ms. ``slot_ends_ns`` ascend; Δ is ``publish_slot_ns``.

    Raises:
        InputError: slot ends that do not ascend, or the last is before the longest latency.
    """
    ends = [int(end) for end in slot_ends_ns]
    if not ends or any(after <= before for before, after in pairwise(ends)):
        raise InputError(f"slot ends must ascend, at least one: found {ends}")
    _refuse_before_longest(ends[-1], int(latencies_ns.max()))
    counts, mean = counts_and_mean(np.sort(latencies_ns), ends)
    return Prediction(
        mean_ns=round(float(mean)),
        max_ns=ends[-1],
        jitter_ns=ends[-1] - (ends[0] - publish_slot_ns),
        shares=tuple((counts / counts.sum()).tolist()),
    )


def _refuse_before_longest(last_end_ns: int, longest_ns: int) -> None:
    if last_end_ns < longest_ns:
        raise InputError(
            f"the last slot ends at {format_duration(last_end_ns)}, before the longest latency"
            f" {format_duration(longest_ns)}: move it behind"
        )


@dataclass(frozen=True)
class BandProblem:
    """What a placement must respect; made by :func:`band_problem`.

    ``latencies_ns`` ascend. Slots are ``publish_slot_ns`` long (Δ), the last ends at
    ``last_end_ns``, the others at multiples of ``grid_ns``. Neighbouring slot ends are at most
    ``max_gap_ns`` apart (LV), a band has at most ``max_share`` of the executions.
    """

    latencies_ns: NDArray[np.int64]
    last_end_ns: int
    publish_slot_ns: int
    grid_ns: int
    max_gap_ns: int | None = None
    max_share: float | None = None

    @property
    def most_per_band(self) -> int:
        """How many of the sample's latencies one band may hold."""
        size = self.latencies_ns.size
        return size if self.max_share is None else int(self.max_share * size + 1e-9)


@dataclass(frozen=True)
class Placement:
    """Slot ends, ascending, and the average that eq. 5 predicts for them."""

    slot_ends_ns: tuple[int, ...]
    mean_ns: float


def band_problem(
    latencies_ns: NDArray[np.int64],
    last_end_ns: int,
    *,
    publish_slot_ns: int = 1_000_000,
    grid_ns: int = 1_000,
    max_gap_ns: int | None = None,
    max_share: float | None = None,
) -> BandProblem:
    """Check and sort what a placement needs.

    Raises:
        InputError: values that make no sense for any number of bands; the message names them.
    """
    latencies = np.sort(check_latencies(latencies_ns))
    if publish_slot_ns <= 0 or grid_ns <= 0:
        raise InputError("the publish slot and the grid must be longer than 0ms")
    _refuse_before_longest(last_end_ns, int(latencies[-1]))
    if max_gap_ns is not None and max_gap_ns <= publish_slot_ns:
        raise InputError(
            f"a largest gap of {format_duration(max_gap_ns)} is not longer than the publish slot"
            f" {format_duration(publish_slot_ns)}, so no two slots could follow each other: allow"
            " a longer gap or use a shorter slot"
        )
    if max_share is not None and not 0 < max_share <= 1:
        raise InputError(f"the largest share per band must be above 0, at most 1: not {max_share}")
    if latencies.size * last_end_ns >= 2**62:
        raise InputError("latencies this long and this many overflow the planner: plan with fewer")
    return BandProblem(latencies, last_end_ns, publish_slot_ns, grid_ns, max_gap_ns, max_share)


def with_bands(
    plan: Plan,
    latencies_ns: NDArray[np.int64],
    bands: int | Literal["auto"],
    *,
    solver: Solver = "exact",
    minimise: Goal = "mean",
    mean_at_most_ns: int | None = None,
    least_gain: float = 0.02,
    seed: int | None = None,
    **limits: Any,
) -> Plan:
    """A shaped plan with ``bands`` publish slots; the last stays where the plan has it.

    The slots are as long as the plan's own (Δ). ``exact`` finds the best placement on the grid;
    ``pso`` and ``random`` take a ``seed``. ``auto`` takes as many bands as each lower the average
    by ``least_gain`` of it at least. With ``mean_at_most_ns`` the exact solver can ``minimise`` the
    ``jitter`` or the largest ``gap`` instead of the average. ``limits`` are ``grid_ns``,
    ``max_gap_ns`` (LV) and ``max_share``, as in :func:`band_problem`.

    Raises:
        InputError: a plan without a publish slot, or values that make no sense together.
        OperationError: no such placement exists; the message names the binding constraint.
    """
    problem = _problem(plan, latencies_ns, limits)
    length = problem.publish_slot_ns
    if (bands == "auto" or solver != "exact") and (
        minimise != "mean" or mean_at_most_ns is not None
    ):
        raise InputError("another goal than the average needs the exact solver and fixed bands")
    if bands == "auto":
        if solver != "exact":
            raise InputError("only the exact solver chooses the number of bands by itself")
        placement = choose_bands(plan, latencies_ns, least_gain=least_gain, **limits).chosen
    elif solver == "pso":
        placement = place_by_swarm(problem, bands, seed)
    elif solver == "random":
        placement = place_randomly(problem, bands, seed)
    else:
        placement = place_bands(problem, bands, minimise=minimise, mean_at_most_ns=mean_at_most_ns)
    slots = tuple((end - length, end) for end in placement.slot_ends_ns)
    predicted = predict_bands(problem.latencies_ns, placement.slot_ends_ns, length)
    return _with_publish_slots(plan, slots, predicted)


@dataclass(frozen=True)
class BandChoice:
    """A curve of figure 7, the placement that ``auto`` takes from it, and why it stops there."""

    curve: tuple[Placement, ...]
    chosen: Placement
    reason: str


def choose_bands(
    plan: Plan, latencies_ns: NDArray[np.int64], *, least_gain: float = 0.02, **limits: Any
) -> BandChoice:
    """What :func:`with_bands` takes for ``auto``, with its grounds.

    Raises:
        InputError: a plan without a publish slot, or a least gain that is no share.
        OperationError: no number of bands can be placed.
    """
    if not 0 < least_gain < 1:
        raise InputError(
            f"the least gain is a share of the average, such as 0.02: not {least_gain}"
        )
    curve = placement_curve(_problem(plan, latencies_ns, limits), MOST_BANDS)
    chosen = enough_bands(curve, least_gain)
    bands, longest = len(chosen.slot_ends_ns), len(curve[-1].slot_ends_ns)
    if chosen is not curve[-1]:
        gain = 1 - curve[curve.index(chosen) + 1].mean_ns / chosen.mean_ns
        reason = (
            f"stopped at {bands}: another band would lower the average by {gain:.2%}, less than"
            f" {least_gain:.2%}"
        )
    elif longest < MOST_BANDS:
        reason = f"stopped at {bands}: no more bands can be placed"
    else:
        reason = f"stopped at {bands}: more bands are not tried"
    return BandChoice(tuple(curve), chosen, reason)


def with_long_slot(plan: Plan, latencies_ns: NDArray[np.int64], slot_start_ns: int) -> Plan:
    """A shaped plan with one long publish slot, from ``slot_start_ns`` to where it ended before.

    An execution that is done earlier waits for the slot, any other publishes at once: the average
    falls and the jitter grows as the start moves towards the shortest latency (end of section 4.1).

    Raises:
        InputError: a start that is not before the plan's own publish slot, or negative.
    """
    start, end = _last_publish_slot(plan)
    if not 0 <= slot_start_ns <= start:
        raise InputError(
            f"a long publish slot may start from 0ms to {format_duration(start)}, where the plan's"
            f" own does; {format_duration(slot_start_ns)} does not"
        )
    published = np.maximum(check_latencies(latencies_ns), slot_start_ns)
    # Published at once, the output is late by the publication itself, which the slot's end bounds.
    predicted = Prediction(
        mean_ns=round(int(published.sum()) / published.size),
        max_ns=end,
        jitter_ns=end - slot_start_ns,
        shares=(1.0,),
    )
    slots = ((slot_start_ns, end),)
    return revised(_with_publish_slots(plan, slots, predicted), policy="one-long-slot")


def _problem(plan: Plan, latencies_ns: NDArray[np.int64], limits: dict[str, Any]) -> BandProblem:
    start, end = _last_publish_slot(plan)
    return band_problem(latencies_ns, end, publish_slot_ns=end - start, **limits)


def _last_publish_slot(plan: Plan) -> Slot:
    slots = publish_slots(plan)
    if not slots:
        raise InputError(f"a plan of policy {plan.policy} has no publish slot: plan shaping first")
    return slots[-1]


def _with_publish_slots(plan: Plan, slots: tuple[Slot, ...], predicted: Prediction) -> Plan:
    publishing = output_server(plan)
    servers = with_slots(plan.servers, {} if publishing is None else {publishing.name: slots})
    return revised(plan, servers=below_executors(servers), predicted=predicted)


def place_bands(
    problem: BandProblem, bands: int, *, minimise: Goal = "mean", mean_at_most_ns: int | None = None
) -> Placement:
    """The best placement of ``bands`` slots that exists on the grid.

    ``minimise`` the average (eq. 5; among equals the one with the smallest jitter), or, while the
    average stays at or below ``mean_at_most_ns``, the overall jitter x_ν − (x_1 − Δ), or the
    largest gap between neighbouring bands.

    Raises:
        InputError: a goal that makes no sense, or as :func:`refuse_more_than_fit`.
        OperationError: no placement exists; the message names the constraint that prevents it.
    """
    refuse_more_than_fit(problem, bands)
    if minimise == "jitter" and mean_at_most_ns is None:
        raise InputError("the smallest jitter is that of one band: say which average it may cost")
    if minimise == "gap":
        return _smallest_gap(problem, bands, mean_at_most_ns)
    tables = _solve(problem, bands)
    best = _best(tables, bands)
    if best is None:
        raise OperationError(_why_none(problem, bands))
    _refuse_slower(best, mean_at_most_ns)
    if minimise == "jitter" and bands > 1 and mean_at_most_ns is not None:
        allowed = mean_at_most_ns * problem.latencies_ns.size
        return _read(tables, bands, int(np.flatnonzero(tables.totals(bands) <= allowed)[-1]))
    return best


def placement_curve(problem: BandProblem, most_bands: int) -> list[Placement]:
    """The best placement for each number of bands from one upwards, as far as they fit (figure 7).

    Raises:
        OperationError: no number of bands up to ``most_bands`` can be placed.
    """
    most = min(most_bands, _room(problem))
    tables = _solve(problem, most)
    curve: list[Placement] = []
    for bands in range(1, most + 1):
        best = _best(tables, bands)
        if best is not None:
            curve.append(best)
        elif curve:
            break
    if not curve:
        raise OperationError(_why_none(problem, most))
    return curve


def refuse_more_than_fit(problem: BandProblem, bands: int) -> None:
    """Refuse no bands, or more than publish slots fit behind the shortest latency."""
    if bands < 1:
        raise InputError(f"{bands} bands: plan with one band at least")
    most = _room(problem)
    if bands > most:
        raise InputError(
            f"{bands} bands cannot be placed: between the shortest latency"
            f" {format_duration(int(problem.latencies_ns[0]))} and the last slot's end"
            f" {format_duration(problem.last_end_ns)} there is room for {most} publish slots of"
            f" {format_duration(problem.publish_slot_ns)}; use fewer bands or a shorter slot"
        )


def enough_bands(curve: list[Placement], least_gain: float = 0.02) -> Placement:
    """The first placement of a curve behind which another band gains less than ``least_gain``."""
    for placement, following in pairwise(curve):
        if placement.mean_ns - following.mean_ns < least_gain * placement.mean_ns:
            return placement
    return curve[-1]


def broken_constraint(problem: BandProblem, slot_ends_ns: tuple[int, ...]) -> str | None:
    """The first constraint that given slot ends break, in words; the grid is not among them."""
    ends = np.array(slot_ends_ns)
    slot, shortest = problem.publish_slot_ns, int(problem.latencies_ns[0])
    if ends.size > 1 and ends[0] - slot <= shortest:
        return f"the first slot must begin after the shortest latency {format_duration(shortest)}"
    if (np.diff(ends) <= slot).any():
        return f"slot ends must be more than the publish slot {format_duration(slot)} apart"
    if problem.max_gap_ns is not None and (np.diff(ends) > problem.max_gap_ns).any():
        return f"slot ends must be at most {format_duration(problem.max_gap_ns)} apart"
    counts, _ = counts_and_mean(problem.latencies_ns, ends)
    if (counts > problem.most_per_band).any():
        return f"a band must hold at most {problem.max_share:.1%} of the executions"
    return None


@dataclass(frozen=True)
class _Tables:
    """Grid positions and, for each number of bands behind one, their cost and the next band."""

    problem: BandProblem
    ends: NDArray[np.int64]
    counts: NDArray[np.int64]
    costs: NDArray[np.int64]  # row m: m + 1 bands behind the position, UNREACHABLE if impossible
    successors: NDArray[np.int32]  # position of the next band; −1 where the last one follows

    def totals(self, bands: int) -> NDArray[np.int64]:
        """The cost of all bands for every position of the first; two bands at least."""
        behind = self.costs[bands - 2]
        allowed = (behind != UNREACHABLE) & (self.counts <= self.problem.most_per_band)
        return np.where(allowed, behind + self.counts * self.ends * allowed, UNREACHABLE)


def _solve(problem: BandProblem, bands: int) -> _Tables:
    slot, grid, last = problem.publish_slot_ns, problem.grid_ns, problem.last_end_ns
    # Positions: multiples of the grid above L̲ + Δ (x_1 − Δ > L̲) and below x_ν − Δ.
    first = (int(problem.latencies_ns[0]) + slot) // grid + 1
    size = max(0, -(-(last - slot) // grid) - first) if bands > 1 else 0
    layers = min(bands, size + 1)
    if size * layers > MOST_CELLS:
        raise InputError(
            f"{size} positions for {layers} bands are too many to search: use a grid coarser than"
            f" {format_duration(grid)}"
        )
    ends = (first + np.arange(size, dtype=np.int64)) * grid
    counts = np.searchsorted(problem.latencies_ns, ends, side="right").astype(np.int64)
    behind = problem.latencies_ns.size - counts
    reachable = behind <= problem.most_per_band
    # x_α − x_{α−1} > Δ, at most LV, and no more latencies in between than a band may hold.
    positions = np.arange(size, dtype=np.int64)
    nearest = np.minimum(positions + slot // grid + 1, size)
    farthest = np.full(size, size - 1)
    if problem.max_share is not None:
        farthest = np.searchsorted(counts, counts + problem.most_per_band, side="right") - 1
    if problem.max_gap_ns is not None:
        reachable &= last - ends <= problem.max_gap_ns
        farthest = np.minimum(farthest, positions + problem.max_gap_ns // grid)
    costs = np.where(reachable, behind * last, UNREACHABLE)[np.newaxis, :]
    costs = np.vstack([costs, np.full((max(0, layers - 2), size), UNREACHABLE)])
    successors = np.full(costs.shape, -1, dtype=np.int32)
    if layers > 2:
        # What loads machine code takes a moment to import, and two bands do without it.
        from chainshaper.values.compiled import kernel

        fill_costs = kernel("chainshaper.planning.band_kernel", "fill_costs")
        grid_rows, windows = np.stack([counts, ends]), np.stack([nearest, farthest])
        work = np.empty((12, size + 1), dtype=np.int64)
        fill_costs(
            grid_rows.ctypes.data, windows.ctypes.data, costs.ctypes.data,
            successors.ctypes.data, work.ctypes.data, size, layers - 1,
        )  # fmt: skip
    return _Tables(problem, ends, counts, costs, successors)


def _best(tables: _Tables, bands: int) -> Placement | None:
    problem = tables.problem
    if bands == 1:
        fits = problem.latencies_ns.size <= problem.most_per_band
        return Placement((problem.last_end_ns,), float(problem.last_end_ns)) if fits else None
    if bands - 1 > tables.ends.size:
        return None
    totals = tables.totals(bands)
    if totals.min() == UNREACHABLE:
        return None
    # Of equally good placements the one that begins last: the smallest jitter.
    return _read(tables, bands, int(np.flatnonzero(totals == totals.min())[-1]))


def _read(tables: _Tables, bands: int, position: int) -> Placement:
    total = int(tables.totals(bands)[position])
    ends = [int(tables.ends[position])]
    for behind in range(bands - 2, 0, -1):
        position = int(tables.successors[behind, position])
        ends.append(int(tables.ends[position]))
    ends.append(tables.problem.last_end_ns)
    return Placement(tuple(ends), total / tables.problem.latencies_ns.size)


def _smallest_gap(problem: BandProblem, bands: int, mean_at_most_ns: int | None) -> Placement:
    # A larger gap only ever allows more: the smallest one that is enough is found by halving.
    found = place_bands(problem, bands, mean_at_most_ns=mean_at_most_ns)
    low = problem.publish_slot_ns
    high = max(np.diff(found.slot_ends_ns), default=low + 1)
    while high - low > 1:
        middle = int(low + high) // 2
        try:
            found = place_bands(
                replace(problem, max_gap_ns=middle), bands, mean_at_most_ns=mean_at_most_ns
            )
            high = max(np.diff(found.slot_ends_ns))
        except OperationError:
            low = middle
    return found


def _room(problem: BandProblem) -> int:
    """How many publish slots fit: x_1 ≥ L̲ + Δ + 1 ns, then steps of Δ + 1 ns at least."""
    behind = problem.last_end_ns - int(problem.latencies_ns[0])
    return max(1, behind // (problem.publish_slot_ns + 1))


def _refuse_slower(best: Placement, mean_at_most_ns: int | None) -> None:
    if mean_at_most_ns is not None and best.mean_ns > mean_at_most_ns:
        raise OperationError(
            f"no placement of {len(best.slot_ends_ns)} bands has an average of"
            f" {format_duration(mean_at_most_ns)} or less; the best is"
            f" {format_duration(round(best.mean_ns))}: allow that, or more bands"
        )


def _why_none(problem: BandProblem, bands: int) -> str:
    """Which constraint leaves no placement: the one without which there is one."""
    said = f"{bands} bands cannot be placed: "
    limits = []
    if problem.max_share is not None:
        without = replace(problem, max_share=None)
        reason = f"no placement keeps every band at {problem.max_share:.1%} of the executions"
        limits.append((without, f"{reason}; allow a larger share or more bands"))
    if problem.max_gap_ns is not None:
        without = replace(problem, max_gap_ns=None)
        reason = f"no placement keeps neighbours within {format_duration(problem.max_gap_ns)}"
        limits.append((without, f"{reason}; allow a larger gap"))
    for without, reason in limits:
        if _best(_solve(without, bands), bands) is not None:
            return said + reason
    if len(limits) == 2 and _best(
        _solve(replace(problem, max_share=None, max_gap_ns=None), bands), bands
    ):
        return f"{said}the largest gap and the largest share exclude each other; relax one"
    return (
        f"{said}the grid of {format_duration(problem.grid_ns)} is too coarse for slots of"
        f" {format_duration(problem.publish_slot_ns)}; use a finer one"
    )


def place_by_swarm(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands with PySwarms and the paper's parameters; the same ``seed``, the same result.

    Particles are the ends of all slots but the last, on the grid. A particle that breaks a
    constraint costs more than any that does not, in proportion to how far it is off.

    Raises:
        InputError: as :func:`refuse_more_than_fit`.
        OperationError: the swarm ended at a placement that breaks a constraint.
        PlatformError: PySwarms is not installed.
    """
    refuse_more_than_fit(problem, bands)
    if bands == 1:
        return _checked(problem, (problem.last_end_ns,), "the single band")
    lowest = float(problem.latencies_ns[0] + problem.publish_slot_ns)
    highest = float(problem.last_end_ns - problem.publish_slot_ns)
    bounds = (np.full(bands - 1, lowest), np.full(bands - 1, highest))
    with _quiet_and_seeded(seed):
        swarm = extra_library("pyswarms", "placement by particle swarm").single.GlobalBestPSO(
            n_particles=PARTICLES, dimensions=bands - 1, options=OPTIONS, bounds=bounds
        )
        _, best = swarm.optimize(
            lambda particles: _costs(problem, particles), iters=ITERATIONS, verbose=False
        )
    ends = _slot_ends(problem, best[np.newaxis, :])[0]
    return _checked(problem, tuple(int(end) for end in ends), "the swarm")


def place_randomly(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands at random, every allowed placement on the grid being equally likely.

    Raises:
        InputError: as :func:`refuse_more_than_fit`.
        OperationError: the grid is too coarse for so many, or no draw of many respects the limits.
    """
    refuse_more_than_fit(problem, bands)
    if bands == 1:
        return _checked(problem, (problem.last_end_ns,), "the single band")
    grid, slot = problem.grid_ns, problem.publish_slot_ns
    first = (int(problem.latencies_ns[0]) + slot) // grid + 1
    size = -(-(problem.last_end_ns - slot) // grid) - first
    # Draw from the positions that remain when each gap's minimum beyond one step is taken out.
    spare = slot // grid
    remaining = size - spare * (bands - 2)
    if remaining < bands - 1:
        raise OperationError(
            f"{bands} bands cannot be placed: the grid of {format_duration(grid)} is too coarse for"
            f" slots of {format_duration(slot)}; use a finer one"
        )
    random = np.random.default_rng(seed)
    for _ in range(RANDOM_TRIES):
        drawn = np.sort(random.choice(remaining, size=bands - 1, replace=False))
        ends = (first + drawn + spare * np.arange(bands - 1)) * grid
        placed = (*(int(end) for end in ends), problem.last_end_ns)
        if broken_constraint(problem, placed) is None:
            break
    return _checked(problem, placed, "the last random draw")


def _checked(problem: BandProblem, ends: tuple[int, ...], what: str) -> Placement:
    broken = broken_constraint(problem, ends)
    if broken is not None:
        raise OperationError(
            f"{what} ended at a placement that is not allowed ({broken}); use the exact solver"
        )
    _, mean = counts_and_mean(problem.latencies_ns, ends)
    return Placement(ends, float(mean))


def _slot_ends(problem: BandProblem, particles: NDArray[np.float64]) -> NDArray[np.int64]:
    grid = problem.grid_ns
    ends = np.ceil(np.sort(particles, axis=1) / grid).astype(np.int64) * grid
    last = np.full((len(ends), 1), problem.last_end_ns)
    return np.hstack([ends, last])


def _costs(problem: BandProblem, particles: NDArray[np.float64]) -> NDArray[np.float64]:
    ends = _slot_ends(problem, particles)
    gaps = np.diff(ends, axis=1)
    counts, means = counts_and_mean(problem.latencies_ns, ends)
    slot = problem.publish_slot_ns
    off = np.clip(problem.latencies_ns[0] + slot + 1 - ends[:, 0], 0, None)
    off = off + np.clip(slot + 1 - gaps, 0, None).sum(axis=1)
    if problem.max_gap_ns is not None:
        off = off + np.clip(gaps - problem.max_gap_ns, 0, None).sum(axis=1)
    too_many = np.clip(counts - problem.most_per_band, 0, None).sum(axis=1)
    off = off + too_many * problem.last_end_ns / problem.latencies_ns.size
    return np.where(off > 0, problem.last_end_ns + off, means)


@contextmanager
def _quiet_and_seeded(seed: int | None) -> Iterator[None]:
    """PySwarms draws from NumPy's global generator and sets up logging into the current folder.

    The generator's state comes back; a logging configuration that changes nothing (named by
    PySwarms' own environment variable) makes it write no files.
    """
    state = np.random.get_state()
    configured = os.environ.get("LOG_CFG")
    with tempfile.TemporaryDirectory(prefix="chainshaper-") as folder:
        configuration = Path(folder) / "logging.yaml"
        configuration.write_text("version: 1\nincremental: true\n")
        os.environ["LOG_CFG"] = str(configuration)
        try:
            np.random.seed(seed)
            yield
        finally:
            np.random.set_state(state)
            if configured is None:
                del os.environ["LOG_CFG"]
            else:
                os.environ["LOG_CFG"] = configured
