"""Where to put the publish slots of several latency bands, exactly (sections 3.3 and 4.1).

With ν bands an execution publishes in the first slot that ends after it is done. With x_α the end
of slot α and φ the measured distribution, the average is eq. 5,

    Σ_α (φ(x_α) − φ(x_{α−1}))·x_α,

and the last slot stays where single-band shaping has it. Where an output that comes into an open
slot waits for the next one, φ(x_α − Δ) stands for φ(x_α), as if all latencies were Δ longer. The
optimum on a grid of instants is found by dynamic programming from the last slot backwards. With c_j
of n latencies ≤ x_j, the least cost of the m bands behind one that ends at x_i is

    B_m(i) = min over j of (c_j − c_i)·x_j + B_{m−1}(j),    B_1(i) = (n − c_i)·x_ν.

**Why this is exact.** For row i, column j costs the value at c_i of a line with intercept
c_j·x_j + B_{m−1}(j) and slope −x_j. Every constraint (Δ, LV, the cap on a band's share) says that j
lies in a window whose ends ascend with i, and so do the c_i. The kernel keeps the lower envelope of
the lines, in an order of rows in which windows only grow, so that it loses no line that a later row
needs. Each layer is linear in the number of grid points.

Particle swarm and chance (section 5.1.5, tables 3 and 4) are for comparison.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

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

UNREACHABLE = _core.UNREACHABLE  # the cost of what cannot be placed
MOST_CELLS = 120_000_000  # grid points × bands: more than a gigabyte
MOST_BANDS = 12  # as far as `auto` looks; figure 7 is flat from the fourth on
RANDOM_TRIES = 10_000
# Section 5.1.5:
PARTICLES, ITERATIONS, OPTIONS = 100, 150, {"c1": 0.5, "c2": 0.3, "w": 0.9}


def counts_and_mean(
    ordered_ns: NDArray[np.int64], ends_ns: NDArray[np.int64] | Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How many of ascending latencies publish in each slot, and the average of eq. 5. Ends ascend
    along the last axis; the last is not before the longest latency.
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
    """What publication in slots with these ends, Δ long, makes of measured latencies.

    The latest output is at x_ν, the earliest at x_1 − Δ: a jitter of 25 ms for the paper's slots
    [62, 63], [77, 78], [86, 87] ms. Where none leaves but when a slot begins, it is x_ν − x_1.
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
    """What a placement must respect, checked; ``latencies_ns`` ascend afterwards.

    Slots are ``publish_slot_ns`` long (Δ), the last ends at ``last_end_ns``, the others at
    multiples of ``grid_ns``. Neighbouring slot ends are at most ``max_gap_ns`` apart (LV), a band
    has at most ``max_share`` of the executions.
    """

    latencies_ns: NDArray[np.int64]
    last_end_ns: int
    publish_slot_ns: int = 1_000_000
    grid_ns: int = 1_000
    max_gap_ns: int | None = None
    max_share: float | None = None
    into_open_slot: IntoOpenSlot = "at-once"

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
        """How long before a slot's end what leaves in it has to be ready: 0, or Δ."""
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
        """How many publish slots fit: x_1 ≥ L̲ + Δ + 1 ns, then steps of Δ + 1 ns at least."""
        behind = self.last_end_ns - int(self.latencies_ns[0])
        return max(1, behind // (self.publish_slot_ns + 1))

    @property
    def positions(self) -> tuple[int, int]:
        """The first multiple of the grid above L̲ + Δ (x_1 − Δ > L̲), how many below x_ν − Δ."""
        first = (int(self.latencies_ns[0]) + self.publish_slot_ns) // self.grid_ns + 1
        return first, -(-(self.last_end_ns - self.publish_slot_ns) // self.grid_ns) - first


class Placement(NamedTuple):
    """Slot ends, ascending, and the average that eq. 5 predicts for them."""

    slot_ends_ns: tuple[int, ...]
    mean_ns: float


class BandChoice(NamedTuple):
    """A curve of figure 7, the placement that ``auto`` takes from it, and why it stops there."""

    curve: tuple[Placement, ...]
    chosen: Placement
    reason: str


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
    **limits: Any,
) -> ChainPlan:
    """A shaped plan with ``bands`` publish slots of the plan's length (Δ); the last one stays.

    ``most_ns`` are the latencies where others delay all executions, behind which the average is
    not. For ``auto`` see :func:`choose_bands`, for ``minimise`` and ``mean_at_most_ns``
    :func:`place_bands`; ``limits`` are those of :class:`BandProblem`.

    Raises OperationError: no such placement exists; the message names the binding constraint.
    """
    problem = _problem(plan, latencies_ns, limits)
    other_goal = minimise != "mean" or mean_at_most_ns is not None
    if other_goal and (bands == "auto" or solver != "exact"):
        raise InputError("another goal than the average needs the exact solver and fixed bands")
    if bands == "auto":
        if solver != "exact":
            raise InputError("only the exact solver chooses the number of bands by itself")
        placement = choose_bands(plan, latencies_ns, least_gain=least_gain, **limits).chosen
    elif solver == "exact":
        placement = place_bands(problem, bands, minimise=minimise, mean_at_most_ns=mean_at_most_ns)
    else:
        placement = (place_by_swarm if solver == "pso" else place_randomly)(problem, bands, seed)
    length, ends = problem.publish_slot_ns, placement.slot_ends_ns
    most = latencies_ns if most_ns is None else most_ns
    latest = predict_bands(most, ends, length, plan.into_open_slot)
    likely = predict_bands(latencies_ns, ends, length, plan.into_open_slot)
    predicted = likely.model_copy(update={"mean_ns": latest.mean_ns})
    return with_publish_slots(plan, [(end - length, end) for end in ends], predicted=predicted)


def choose_bands(
    plan: ChainPlan, latencies_ns: NDArray[np.int64], *, least_gain: float = 0.02, **limits: Any
) -> BandChoice:
    """What :func:`with_bands` takes for ``auto``: the first number of bands behind which another
    one gains less than ``least_gain`` of the average.
    """
    if not 0 < least_gain < 1:
        raise InputError(f"the least gain is a share, such as 0.02: not {least_gain}")
    curve = placement_curve(_problem(plan, latencies_ns, limits), MOST_BANDS)
    chosen, most = curve[-1], len(curve[-1].slot_ends_ns)
    why = "no more bands can be placed" if most < MOST_BANDS else "more bands are not tried"
    gains = ((1 - two.mean_ns / one.mean_ns, one) for one, two in pairwise(curve))
    if small := next((own for own in gains if own[0] < least_gain), None):
        gain, chosen = small
        why = f"another band would lower the average by {gain:.2%}, less than {least_gain:.2%}"
    return BandChoice(tuple(curve), chosen, f"stopped at {len(chosen.slot_ends_ns)}: {why}")


def with_long_slot(
    plan: ChainPlan, latencies_ns: NDArray[np.int64], slot_start_ns: int
) -> ChainPlan:
    """A shaped plan with one long publish slot, from ``slot_start_ns`` to where it ended before:
    the average falls and the jitter grows as it starts earlier (end of section 4.1).
    """
    start, end = _last_publish_slot(plan)
    if not 0 <= slot_start_ns <= start:
        raise InputError(f"a long publish slot may start from 0 ms to {duration_text(start)}")
    published = np.maximum(check_latencies(latencies_ns), slot_start_ns)
    # Published at once, the output is late by the publication itself, which the slot's end bounds.
    mean_ns = round(int(published.sum()) / published.size)
    predicted = plans.in_one_slot((slot_start_ns, end), mean_ns)
    slots = ((slot_start_ns, end),)
    return with_publish_slots(plan, slots, predicted=predicted, policy="one-long-slot")


def _problem(
    plan: ChainPlan, latencies_ns: NDArray[np.int64], limits: dict[str, Any]
) -> BandProblem:
    start, end = _last_publish_slot(plan)
    limits = {**limits, "into_open_slot": plan.into_open_slot}
    return BandProblem(latencies_ns, end, publish_slot_ns=end - start, **limits)


def _last_publish_slot(plan: ChainPlan) -> Slot:
    if slots := publish_slots(plan):
        return slots[-1]
    raise InputError(f"a plan of policy {plan.policy} has no publish slot: plan shaping first")


def with_publish_slots(plan: ChainPlan, slots: Sequence[Slot], **changes: object) -> ChainPlan:
    """The plan with other slots for its output, and other fields."""
    publishing = plans.output_server(plan)
    others = {} if publishing is None else {publishing.name: slots}
    servers = plans.below_executors(plans.with_slots(plan.servers, others))
    return plans.revised(plan, servers=servers, **changes)


def place_bands(
    problem: BandProblem, bands: int, *, minimise: Goal = "mean", mean_at_most_ns: int | None = None
) -> Placement:
    """The best placement of ``bands`` slots that exists on the grid.

    ``minimise`` the average (eq. 5; among equals the one with the smallest jitter), or, while the
    average stays at or below ``mean_at_most_ns``, the overall jitter x_ν − (x_1 − Δ), or the
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
    """The best placement for each number of bands from one on, as far as they fit (figure 7)."""
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
        where = (
            f"behind the shortest latency {duration_text(int(problem.latencies_ns[0]))} there is"
        )
        reason = (
            f"room for {problem.room} publish slots of {duration_text(problem.publish_slot_ns)}"
        )
        raise InputError(f"{bands} bands cannot be placed: {where} {reason}: use fewer or shorter")


class _Tables:
    """Grid positions and, for each number of bands behind one, their cost and the next band.

    Row m of ``costs`` is for m + 1 bands behind a position; ``successors`` are positions, −1 where
    the last band follows.
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
        """The cost of all bands for every position of the first; two bands at least."""
        behind = self.costs[bands - 2]
        allowed = (behind != UNREACHABLE) & (self.counts <= self.problem.most_per_band)
        return np.where(allowed, behind + self.counts * self.ends * allowed, UNREACHABLE)

    def best(self, bands: int) -> Placement | None:
        """Of equally good placements the one that begins last, which has the smallest jitter."""
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
        """The placement whose first band is at a position."""
        mean = int(self.totals(bands)[position]) / self.problem.latencies_ns.size
        ends = [int(self.ends[position])]
        for behind in range(bands - 2, 0, -1):
            position = int(self.successors[behind, position])
            ends.append(int(self.ends[position]))
        return Placement((*ends, self.problem.last_end_ns), mean)


def _smallest_gap(problem: BandProblem, found: Placement, mean_at_most_ns: int | None) -> Placement:
    # A larger gap only ever allows more: the smallest one that is enough is found by halving.
    low = problem.publish_slot_ns
    high = max(np.diff(found.slot_ends_ns), default=low + 1)
    while high - low > 1:
        middle = int(low + high) // 2
        closer = replace(problem, max_gap_ns=middle)
        try:
            found = place_bands(closer, len(found.slot_ends_ns), mean_at_most_ns=mean_at_most_ns)
            high = max(np.diff(found.slot_ends_ns))
        except OperationError:
            low = middle
    return found


def _why_none(problem: BandProblem, bands: int) -> str:
    """Which constraint leaves no placement: the one without which there is one."""
    share, gap = problem.max_share or 1, duration_text(problem.max_gap_ns or 0)
    reasons = {
        ("max_share",): f"no placement has every band at {share:.1%} of the executions; allow a"
        " larger share or more bands",
        ("max_gap_ns",): f"no placement has neighbours within {gap}; allow a larger gap",
        ("max_share", "max_gap_ns"): "the largest gap and the largest share exclude each other;"
        " relax one",
    }
    for names, reason in reasons.items():
        changes: dict[str, Any] = dict.fromkeys(names)
        if _Tables(replace(problem, **changes), bands).best(bands) is not None:
            return f"{bands} bands cannot be placed: {reason}"
    return _too_coarse(problem, bands)


def _too_coarse(problem: BandProblem, bands: int) -> str:
    grid, slot = duration_text(problem.grid_ns), duration_text(problem.publish_slot_ns)
    return f"{bands} bands cannot be placed: the grid of {grid} is too coarse for slots of {slot}"


def broken_constraint(problem: BandProblem, slot_ends_ns: Sequence[int]) -> str | None:
    """The first constraint that given slot ends break, in words; the grid is not among them."""
    broken = _broken(problem, np.array(slot_ends_ns))
    return next((words for words, off in broken if off > 0), None)


def _broken(
    problem: BandProblem, ends: NDArray[np.int64]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Each constraint in words, and by how much (ns) each row of slot ends breaks it."""
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
    """Place bands with PySwarms and the paper's parameters. Particles are the ends of all slots but
    the last; one that breaks a constraint costs more, the further it is off, than any that does
    not.
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
        off = sum(off for _, off in _broken(problem, ends))
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
    """Place bands at random, every allowed placement on the grid being equally likely. Raises
    OperationError: the grid is too coarse, or no draw of many respects the limits.
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


def _checked(problem: BandProblem, ends: list[int], what: str) -> Placement:
    if broken := broken_constraint(problem, ends):
        reason = f"{what} ended at a placement that is not allowed ({broken})"
        raise OperationError(f"{reason}; use the exact solver")
    return Placement(tuple(ends), float(counts_and_mean(problem.ready_ns, ends)[1]))


@contextmanager
def _quiet_and_seeded(seed: int | None) -> Iterator[None]:
    """PySwarms draws from NumPy's global generator, whose state comes back, and logs into the
    current folder, unless a configuration says otherwise.
    """
    state, configured = np.random.get_state(), os.environ.get("LOG_CFG")
    with os.fdopen(os.memfd_create("logging"), "w", encoding="utf-8") as configuration:
        configuration.write("version: 1\nincremental: true\n")
        configuration.flush()
        os.environ["LOG_CFG"] = f"/proc/self/fd/{configuration.fileno()}"  # gone with us
        try:
            np.random.seed(seed)
            yield
        finally:
            np.random.set_state(state)
            del os.environ["LOG_CFG"]
            if configured is not None:
                os.environ["LOG_CFG"] = configured
