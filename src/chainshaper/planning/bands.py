"""Where to put the publish slots of several latency bands, exactly (sections 3.3 and 4.1).

With ν bands an execution publishes in the first slot that ends after it is done, so most of
them come earlier than the longest latency. The average is eq. 5,

    Σ_α (φ(x_α) − φ(x_{α−1}))·x_α,

x_α the end of slot α and φ the measured distribution; the last slot stays where single-band
shaping has it. The optimum is found on a grid of instants by dynamic programming from the last
slot backwards: B_m(i), the least cost of the m bands behind a band that ends at x_i, is

    B_m(i) = min over j of (c_j − c_i)·x_j + B_{m−1}(j),    B_1(i) = (n − c_i)·x_ν,

c_i being the number of latencies ≤ x_i among n.

**Why this is exact, also under tight constraints.** For row i, column j costs the value of the
line with intercept c_j·x_j + B_{m−1}(j) and slope −x_j at c_i. Every constraint on neighbouring
bands says that j lies in a window whose both ends ascend with i: Δ and LV bound x_j − x_i, the cap
on a band's share bounds c_j − c_i, and x and c ascend. So B_m(i) is the least of the lines of a
moving window at c_i, and all the c_i ascend too. The kernel keeps the lower envelope of the
lines, in an order of rows in which windows only grow, so that no line is lost that a later row
may need, and positions from which no placement leads on are left out. Each layer is linear in
the number of grid points. (The cost is Monge as well, w(i, j) + w(i', j') ≤ w(i, j') + w(i', j) for
i < i', j < j', which is why the average gains less with every further band.)
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.latency_file import check_latencies
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Goal

__all__ = [
    "BandProblem",
    "Placement",
    "band_problem",
    "broken_constraint",
    "enough_bands",
    "mean_of",
    "place_bands",
    "placement_curve",
    "refuse_more_than_fit",
]

UNREACHABLE = 2**63 - 1  # the cost of what cannot be placed
MOST_CELLS = 120_000_000  # grid points × bands: more than a gigabyte


@dataclass(frozen=True)
class BandProblem:
    """What a placement must respect; all times in nanoseconds. Made by :func:`band_problem`.

    ``latencies_ns`` ascend. Slots are ``publish_slot_ns`` long (Δ), the last ends at
    ``last_end_ns``, the others at multiples of ``grid_ns``. Neighbouring slot ends are at most
    ``max_gap_ns`` apart (LV), a band holds at most ``max_share`` of the executions; None: no
    such limit.
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
    if last_end_ns < latencies[-1]:
        raise InputError(
            f"the last slot ends at {format_duration(last_end_ns)}, before the longest latency"
            f" {format_duration(int(latencies[-1]))}: move it behind"
        )
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


def place_bands(
    problem: BandProblem,
    bands: int,
    *,
    minimise: Goal = "mean",
    mean_at_most_ns: int | None = None,
) -> Placement:
    """The best placement of ``bands`` slots that exists on the grid.

    ``minimise`` the average (eq. 5; among equals the one with the smallest jitter), or, under
    the condition that the average stays at or below ``mean_at_most_ns``, the overall jitter
    x_ν − (x_1 − Δ), or the largest gap between neighbouring bands.

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
    """The best placement for each number of bands from one upwards (figure 7).

    Ends early where more bands do not fit.

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
    """Refuse a number of bands for which there is no room, whatever the grid and other limits.

    Raises:
        InputError: no bands, or more than publish slots fit behind the shortest latency.
    """
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
    """The first placement of a curve behind which another band gains less than ``least_gain``.

    The gain is the share of the average that one more band takes away: beyond the point that
    this picks, figure 7 is flat.
    """
    for placement, following in pairwise(curve):
        if placement.mean_ns - following.mean_ns < least_gain * placement.mean_ns:
            return placement
    return curve[-1]


def mean_of(problem: BandProblem, slot_ends_ns: tuple[int, ...]) -> float:
    """The average that eq. 5 gives for any slot ends."""
    reached = np.searchsorted(problem.latencies_ns, slot_ends_ns, side="right")
    return float(np.diff(reached, prepend=0) @ np.array(slot_ends_ns)) / problem.latencies_ns.size


def broken_constraint(problem: BandProblem, slot_ends_ns: tuple[int, ...]) -> str | None:
    """The first constraint that given slot ends break, in words; None when they keep all.

    The grid is not among them: a solver may place slots anywhere.
    """
    ends = np.array(slot_ends_ns)
    slot, shortest = problem.publish_slot_ns, int(problem.latencies_ns[0])
    reached = np.searchsorted(problem.latencies_ns, ends, side="right")
    if ends.size > 1 and ends[0] - slot <= shortest:
        return f"the first slot must begin after the shortest latency {format_duration(shortest)}"
    if (np.diff(ends) <= slot).any():
        return f"slot ends must be more than the publish slot {format_duration(slot)} apart"
    if problem.max_gap_ns is not None and (np.diff(ends) > problem.max_gap_ns).any():
        return f"slot ends must be at most {format_duration(problem.max_gap_ns)} apart"
    if (np.diff(reached, prepend=0) > problem.most_per_band).any():
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
