"""Publish slots that let a controller cost least, in place of those with the least average latency.

The candidates are one slot, several bands, and one long slot, which begins anywhere before the last
slot's end (the unshaped chain is the long slot that begins at once). Of each, the cost is that of
the steady state in which every cycle's latency is drawn from those measured, and leaves as the
slots have it (:mod:`chainshaper.control.steady_state`). The controller is the one that is given;
or, with one slot, it may be designed anew for the delay, which is constant then.

**What is searched.** Up to `MOST_TRIED` placements on the grid are all tried. Of more, those on a
coarser grid are; from the best of these the search goes on by halving the grid, down to the one
wanted. The cost is no sum over bands, as the average is (eq. 5): a dynamic program cannot find it.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.control.loop import Loop
from chainshaper.control.plant_file import LoopDescription, load_loop
from chainshaper.control.steady_state import LatencyCosts, cost_of_constant, stable_latencies
from chainshaper.planning.bands import (
    BandProblem,
    band_problem,
    counts_and_mean,
    violation_ns,
    with_long_slot,
    with_slots_ending_at,
)
from chainshaper.planning.chain_plan import ChainPlan, ControlCost, revised
from chainshaper.planning.profile import Profile
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError

MOST_TRIED = 12_000  # placements of one kind of which all are tried
LEAST_GAIN = 1e-3  # of the cost, for which shaping is worth it
STARTS = 8  # placements of the coarser grid from which the search goes on
MOST_BANDS = 3  # that are tried where the request names no number; 4 for `auto`
ONE_SLOT, LONG_SLOT, REDESIGNED = "one slot", "one long slot", "one slot, redesigned"


class Candidate(NamedTuple):
    """Publish slots of one kind at the place where they cost least."""

    name: str
    slots: tuple[tuple[int, int], ...]
    cost: float  # per second; inf: the loop is unstable


class _Averages:
    """What the cost follows from, for outputs that leave in slots: sums over the measured cycles.

    ``latencies_ns`` ascend.
    """

    def __init__(self, costs: LatencyCosts, problem: BandProblem) -> None:
        self.costs, self.problem = costs, problem
        self.latencies = problem.latencies_ns
        every = costs.averaged(self.latencies)
        self.until = np.vstack([np.zeros(every.shape[1]), np.cumsum(every, axis=0)])
        self.count = self.latencies.size

    def before(self, instants_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Count the outputs that are there at instants."""
        return np.searchsorted(self.latencies, instants_ns, side="right")

    def band_costs(self, ends_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the cost of each row of slot ends."""
        length, at_once = self.problem.publish_slot_ns, self.problem.at_start_ns == 0
        ends = np.atleast_2d(ends_ns)
        starts = ends - length
        unique, where = np.unique(starts, return_inverse=True)
        at_start = self.costs.averaged(unique)[where.reshape(starts.shape)]
        waiting, gone = self.before(starts), self.before(ends if at_once else starts)
        left = np.hstack([np.zeros((len(ends), 1), dtype=np.int64), gone[:, :-1]])
        sums = ((waiting - left)[..., np.newaxis] * at_start).sum(axis=1)
        if at_once:
            sums += (self.until[gone] - self.until[waiting]).sum(axis=1)
        return self.costs.costs(sums / self.count)

    def long_slot_costs(self, starts_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the cost of one long slot for each of these starts."""
        starts = np.asarray(starts_ns).ravel()
        waiting = self.before(starts)
        sums = waiting[:, np.newaxis] * self.costs.averaged(starts)
        sums += self.until[-1] - self.until[waiting]
        return self.costs.costs(sums / self.count)


def searched(
    size: int,
    chosen: int,
    cost_of: Callable[[NDArray[np.int64]], NDArray[np.float64]],
    most: int = MOST_TRIED,
) -> tuple[tuple[int, ...], float] | None:
    """Return the places 0 … size − 1, ``chosen`` of them ascending, that cost least.

    ``cost_of`` takes rows of places, and returns inf for those that are not allowed. None: all are.
    """
    stride = 1
    while comb(-(-size // stride), chosen) > most:
        stride *= 2
    places = np.arange(0, size, stride, dtype=np.int64)
    rows = np.array([*combinations(places.tolist(), chosen)], dtype=np.int64).reshape(-1, chosen)
    if not len(rows):
        return None
    costs = cost_of(rows)
    starts = rows[np.argsort(costs, kind="stable")[:STARTS]]
    best: tuple[tuple[int, ...], float] | None = None
    for start, before in zip(starts, np.sort(costs, kind="stable")[:STARTS], strict=True):
        row, cost, step = start, float(before), stride
        while step > 1 and np.isfinite(cost):
            step //= 2
            moved = True
            while moved:
                moves = np.array(np.meshgrid(*[[-step, 0, step]] * chosen)).reshape(chosen, -1).T
                near = np.clip(row + moves, 0, size - 1)
                near = near[(np.diff(near, axis=1) > 0).all(axis=1)]
                near_costs = cost_of(near)
                least = int(np.argmin(near_costs))
                moved = near_costs[least] < cost
                if moved:
                    row, cost = near[least], float(near_costs[least])
        if best is None or cost < best[1]:
            best = (tuple(int(place) for place in row), cost)
    return None if best is None or not np.isfinite(best[1]) else best


def best_bands(
    averages: _Averages, bands: int, mean_at_most_ns: int | None = None
) -> Candidate | None:
    """Return the placement of so many bands that costs least; None: there is none."""
    problem = averages.problem
    first, fitting = problem.positions
    last = problem.last_end_ns

    def ends_of(rows: NDArray[np.int64]) -> NDArray[np.int64]:
        ends = (first + rows) * problem.grid_ns
        return np.hstack([ends, np.full((len(rows), 1), last)])

    def cost_of(rows: NDArray[np.int64]) -> NDArray[np.float64]:
        ends = ends_of(rows)
        allowed = violation_ns(problem, ends) == 0
        if mean_at_most_ns is not None:
            allowed &= counts_and_mean(problem.ready_ns, ends)[1] <= mean_at_most_ns
        costs = np.full(len(rows), np.inf)
        if allowed.any():
            costs[allowed] = averages.band_costs(ends[allowed])
        return costs

    if bands == 1:
        cost = float(cost_of(np.empty((1, 0), dtype=np.int64))[0])
        slot = (last - problem.publish_slot_ns, last)
        return Candidate(ONE_SLOT, (slot,), cost)
    best = searched(max(0, fitting), bands - 1, cost_of)
    if best is None:
        return None
    ends = ends_of(np.array([best[0]]))[0].tolist()
    slots = tuple((end - problem.publish_slot_ns, end) for end in ends)
    return Candidate(f"{bands} bands", slots, best[1])


def best_long_slot(averages: _Averages) -> Candidate | None:
    """Return the long slot that costs least, by where it begins."""
    problem = averages.problem
    grid, end = problem.grid_ns, problem.last_end_ns
    first = int(problem.latencies_ns[0]) // grid
    size = (end - problem.publish_slot_ns) // grid - first + 1
    best = searched(size, 1, lambda rows: averages.long_slot_costs((first + rows) * grid))
    if best is None:
        return None
    return Candidate(LONG_SLOT, (((first + best[0][0]) * grid, end),), best[1])


def with_least_cost(
    plan: ChainPlan,
    profile: Profile,
    *,
    plant: str,
    redesign: bool = False,
    bands: int | str = 1,
    grid_ns: int = 1_000,
    max_gap_ns: int | None = None,
    max_share: float | None = None,
    mean_at_most_ns: int | None = None,
) -> ChainPlan:
    """Return a shaped plan whose slots let the controller of a ``plant`` file cost least.

    The last slot ends where the plan's did. ``bands`` other than 1 or ``auto`` are the only number
    that is tried. With ``redesign`` the controller may be designed anew for a constant delay.

    Raises InputError: as :func:`~chainshaper.control.plant_file.load_loop`, or latencies are above
    the period. OperationError: the loop is unstable with any slots. PlatformError: no SciPy.
    """
    description = load_loop(plant)
    loop = description.loop(profile.period_ns)
    problem = band_problem(plan, profile.measured, grid_ns, max_gap_ns, max_share)
    costs = LatencyCosts(loop)
    averages = _Averages(costs, problem)
    unshaped = costs.cost(problem.latencies_ns)
    numbers: Sequence[int] = range(1, MOST_BANDS + 1 + (bands == "auto"))
    if bands not in (1, "auto"):
        numbers = [int(bands)]
    tried = [
        best_bands(averages, number, mean_at_most_ns)
        for number in numbers
        if number <= problem.room
    ]
    if bands in (1, "auto") and plan.into_open_slot == "at-once":
        tried.append(best_long_slot(averages))
    candidates = [candidate for candidate in tried if candidate is not None]
    redesigned = None
    start = problem.last_end_ns - problem.publish_slot_ns
    if redesign and 1 in numbers:
        redesigned = _redesigned(description, profile.period_ns, start)
        candidates.append(Candidate(REDESIGNED, ((start, problem.last_end_ns),), redesigned))
    chosen = min(candidates, key=lambda candidate: candidate.cost, default=None)
    if chosen is None or not np.isfinite(chosen.cost):
        raise OperationError(_unstable(loop, plant, start))
    kept = {candidate.name: _finite(candidate.cost) for candidate in candidates}
    control = ControlCost(
        plant=plant,
        cost=chosen.cost,
        unshaped=_finite(unshaped),
        chosen=chosen.name,
        delay_ns=start if chosen.name == REDESIGNED else None,
        alternatives=kept,
        worth=chosen.cost < unshaped * (1 - LEAST_GAIN),
    )
    return revised(_with_slots(plan, profile, problem, chosen), control=control)


def _with_slots(
    plan: ChainPlan, profile: Profile, problem: BandProblem, chosen: Candidate
) -> ChainPlan:
    """Return the plan with a candidate's slots, and what they predict."""
    if chosen.name == LONG_SLOT:
        return with_long_slot(plan, profile.latencies_ns, chosen.slots[0][0])
    ends = [end for _, end in chosen.slots]
    return with_slots_ending_at(
        plan, profile.measured, profile.latencies_ns, ends, problem.publish_slot_ns
    )


def _redesigned(description: LoopDescription, period_ns: int, delay_ns: int) -> float:
    """Return the cost with a controller for this constant delay; inf: none stabilises the plant."""
    try:
        return cost_of_constant(description.redesigned(delay_ns, period_ns), delay_ns / 1e9)
    except InputError:
        return float("inf")


def _finite(cost: float) -> float | None:
    return cost if np.isfinite(cost) else None


def _unstable(loop: Loop, plant: str, start_ns: int) -> str:
    stable = stable_latencies(loop)
    known = "unstable with every constant latency" if stable is None else stable.text
    reason = f"{plant}: the loop is unstable with any slots, of which the last begins at"
    reason += f" {duration_text(start_ns)}; it is {known}"
    return f"{reason}: let the controller be designed for the delay (--redesign), or correct it"
