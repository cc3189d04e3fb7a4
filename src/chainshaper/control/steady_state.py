"""The cost of a loop in its steady state: of a constant latency, or of a distribution.

Of a constant latency the loop is periodic, and its covariance solves a Lyapunov equation. Of
latencies that are drawn anew each cycle, the covariance solves a linear equation of the same kind
(a jump-linear system without memory; Lincoln and Cervin, Jitterbug, CDC 2002):

    P = Σ pᵢ·Mᵢ·P·Mᵢᵀ + N,     J = (Σ pᵢ·tr(Sᵢ·P) + s) / h.

Mᵢ changes with the latency in few directions only, so that P follows from as few averages of the
distribution: :class:`LatencyCosts` computes these directions once, and then the cost of any
distribution from its averages, as a planner needs it that tries many.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.control.costs import NEVER, sampling
from chainshaper.control.flows import Flow, Flows
from chainshaper.control.loop import Loop, Matrix
from chainshaper.control.lyapunov import solve_lyapunov
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError

STABLE = 1.0 - 1e-9  # the spectral radius below which a loop is stable
MOST_PERIODS = 20  # of delay that the margin is looked for in
DIRECTIONS = 1e-12  # relative size of what is left out of M and S
BASIS_POINTS = 257  # latencies from which their directions are taken


class _Period:
    """The maps of one period, from behind a sample to behind the next, as a state of slots."""

    def __init__(self, loop: Loop, slots: int, flows: Flows | None = None) -> None:
        self.loop, self.slots = loop, slots
        self.flows = flows or Flows(loop.problem)
        self.parts = loop.slices(slots)
        self.size = self.parts["all"].stop
        self.rows, self.sample_noise = sampling(loop)

    def flow(self, over: Flow) -> Matrix:
        whole = np.eye(self.size)
        inputs = self.flows.inputs
        plant = self.parts["plant"]
        whole[plant, : inputs + self.flows.states] = over.rows
        return whole

    def arrival(self, slot: int) -> Matrix:
        whole = np.eye(self.size)
        applied = self.parts["applied"]
        whole[applied] = 0.0
        whole[applied, self.parts[f"slot{slot}"]] = np.eye(self.flows.inputs)
        return whole

    def sample(self) -> tuple[Matrix, Matrix]:
        """Return the map of a sample, after which the newest output is in slot 0, and its noise."""
        whole, noise = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        parts, m = self.parts, self.flows.inputs
        for name in ("applied", "plant"):
            whole[parts[name], parts[name]] = np.eye(parts[name].stop - parts[name].start)
        for slot in range(1, self.slots):
            whole[parts[f"slot{slot}"], parts[f"slot{slot - 1}"]] = np.eye(m)
        seen = slice(parts["plant"].start, parts["controller"].stop)
        states = self.loop.controller.states
        whole[parts["controller"], seen] = self.rows[:states]
        whole[parts["slot0"], seen] = self.rows[states:]
        computed = np.r_[parts["controller"], parts["slot0"]]
        noise[np.ix_(computed, computed)] = self.sample_noise
        return whole, noise

    def cost(self, over: Flow, before: Matrix) -> Matrix:
        """Return the cost of a flow over the state that ``before`` makes its start of."""
        start = before[: self.flows.inputs + self.flows.states]
        weights: Matrix = start.T @ over.cost @ start
        return weights


def steady_period(
    loop: Loop, latency_s: float, slots: int, flows: Flows
) -> tuple[Matrix, Matrix, Matrix, float]:
    """Return M, N, S and s of a period in which every output has one latency.

    ``slots`` is how many outputs the state has places for, if more than may be under way.
    """
    period = loop.problem.period_s
    whole_periods = int(latency_s / period + 1e-9)
    into = max(0.0, latency_s - whole_periods * period)
    period_maps = _Period(loop, max(slots, whole_periods + 1), flows)
    before, behind = flows.over(into), flows.over(period - into)
    first = period_maps.flow(before)
    applied = period_maps.arrival(whole_periods) @ first
    moved = period_maps.flow(behind) @ applied
    sampled, noise = period_maps.sample()
    whole = flows.over(period)
    process = np.zeros_like(noise)
    plant = period_maps.parts["plant"]
    process[plant, plant] = whole.noise
    weights = period_maps.cost(before, np.eye(period_maps.size))
    weights = weights + period_maps.cost(behind, applied)
    return sampled @ moved, sampled @ process @ sampled.T + noise, weights, whole.noise_cost


def radius_of_constant(loop: Loop, latency_s: float, flows: Flows | None = None) -> float:
    """Return the spectral radius of the loop with a constant latency; it is stable below 1."""
    whole, *_ = steady_period(loop, latency_s, 1, flows or Flows(loop.problem))
    return float(np.abs(np.linalg.eigvals(whole)).max())


def cost_of_constant(loop: Loop, latency_s: float, flows: Flows | None = None) -> float:
    """Return the cost per second with a constant latency, also above the period; inf: unstable."""
    whole, noise, weights, noise_cost = steady_period(
        loop, latency_s, 1, flows or Flows(loop.problem)
    )
    if np.abs(np.linalg.eigvals(whole)).max() >= STABLE:
        return float("inf")
    covariance = solve_lyapunov(whole, noise)
    return float((np.trace(weights @ covariance) + noise_cost) / loop.problem.period_s)


def covariance_of_constant(loop: Loop, latency_s: float, flows: Flows | None = None) -> Matrix:
    """Return the steady covariance of [applied; x; controller] just before a sample.

    Of an unstable loop it is 0.
    """
    flows = flows or Flows(loop.problem)
    whole, noise, _, _ = steady_period(loop, latency_s, 1, flows)
    known = loop.slices(1)["controller"].stop
    if np.abs(np.linalg.eigvals(whole)).max() >= STABLE:
        return np.zeros((known, known))
    behind = solve_lyapunov(whole, noise)
    # Carry it through the period, up to the next sample.
    period = loop.problem.period_s
    slots = int(latency_s / period + 1e-9)
    maps = _Period(loop, slots + 1, flows)
    into = max(0.0, latency_s - slots * period)
    moved = maps.flow(flows.over(period - into)) @ maps.arrival(slots) @ maps.flow(flows.over(into))
    process = np.zeros_like(behind)
    process[maps.parts["plant"], maps.parts["plant"]] = flows.over(period).noise
    before: Matrix = (moved @ behind @ moved.T + process)[:known, :known]
    return before


class StableLatencies(NamedTuple):
    """The constant latencies, from the shortest on, with which a loop is stable (s)."""

    from_s: float  # 0, but for a controller that counts on a delay
    until_s: float | None  # the delay margin; None: beyond 20 periods

    @property
    def text(self) -> str:
        """``stable with constant latencies from 0 ms to 81 ms``."""
        first = duration_text(round(self.from_s * 1e6) * 1_000)
        if self.until_s is None:
            return f"stable with constant latencies from {first} on, to {MOST_PERIODS} periods"
        last = duration_text(round(self.until_s * 1e6) * 1_000)
        return f"stable with constant latencies from {first} to {last}"


def stable_latencies(loop: Loop, flows: Flows | None = None) -> StableLatencies | None:
    """Return the first range of constant latencies with which a loop is stable; None: with none.

    It is looked for in steps of a twentieth of the period, and then to a ten-millionth.
    """
    flows = flows or Flows(loop.problem)
    period = loop.problem.period_s

    def is_stable(latency: float) -> bool:
        return radius_of_constant(loop, latency, flows) < STABLE

    def change(before: float, behind: float) -> float:
        """Halve the interval in which the loop becomes stable, or unstable."""
        at_first = is_stable(before)
        while behind - before > 1e-7 * period:
            middle = (before + behind) / 2
            before, behind = (middle, behind) if is_stable(middle) == at_first else (before, middle)
        return behind

    begins = 0.0 if is_stable(0.0) else None
    for step in range(1, MOST_PERIODS * 20 + 1):
        before, latency = (step - 1) * period / 20, step * period / 20
        if is_stable(latency) == (begins is not None):
            continue
        if begins is not None:
            return StableLatencies(begins, change(before, latency))
        begins = change(before, latency)
    return None if begins is None else StableLatencies(begins, None)


class LatencyCosts:
    """The cost of a loop whose latencies are drawn anew in each cycle, from any distribution.

    Latencies are from 0 to the period; an output may be lost, too. Raises InputError: longer ones.
    """

    def __init__(self, loop: Loop, flows: Flows | None = None) -> None:
        self.loop = loop
        self.flows = flows or Flows(loop.problem)
        self._maps = _Period(loop, 1, self.flows)
        self.size = self._maps.size
        self._sample, self._sample_noise = self._maps.sample()
        whole = self.flows.over(loop.problem.period_s)
        process = np.zeros((self.size, self.size))
        process[self._maps.parts["plant"], self._maps.parts["plant"]] = whole.noise
        self._noise = self._sample @ process @ self._sample.T + self._sample_noise
        self._noise_cost = whole.noise_cost
        self._upper = np.triu_indices(self.size)

    def _matrices(self, latencies_s: NDArray[np.float64]) -> tuple[Matrix, Matrix]:
        """Return M and S of each latency, flat: count x size², and count x size·(size + 1)/2."""
        n = self.size
        period = self.loop.problem.period_s
        rows, _, cost, _ = self.flows.many(latencies_s)
        later_rows, _, later_cost, _ = self.flows.many(period - latencies_s)
        count, inputs = len(latencies_s), self.flows.inputs
        plant, flowing = self._maps.parts["plant"], inputs + self.flows.states
        first = np.tile(np.eye(n), (count, 1, 1))
        first[:, plant, :flowing] = rows
        applied = self._maps.arrival(0) @ first
        behind = np.tile(np.eye(n), (count, 1, 1))
        behind[:, plant, :flowing] = later_rows
        whole = self._sample @ behind @ applied
        weights = np.zeros((count, n, n))
        weights[:, :flowing, :flowing] = cost
        start = applied[:, :flowing]
        weights = weights + np.swapaxes(start, 1, 2) @ later_cost @ start
        return whole.reshape(count, n * n), weights.reshape(count, n * n)

    def _lost(self) -> tuple[Matrix, Matrix]:
        """Return M and S of a cycle without an output, flat."""
        n, whole = self.size, self.flows.over(self.loop.problem.period_s)
        moved = self._sample @ self._maps.flow(whole)
        return moved.reshape(1, n * n), self._maps.cost(whole, np.eye(n)).reshape(1, n * n)

    @cached_property
    def _basis(self) -> tuple[Matrix, Matrix, NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions of M and S: those of M, of S, and maps of averages to equations.

        A cycle's averages are products a·aᵀ of the coordinates of M, and the coordinates of S.
        """
        grid = np.linspace(0.0, self.loop.problem.period_s, BASIS_POINTS)
        moved, weights = self._matrices(grid)
        lost_moved, lost_weights = self._lost()
        of_moved = _directions(np.vstack([moved, lost_moved]))
        of_weights = _directions(np.vstack([weights, lost_weights]))
        n, count = self.size, len(of_moved)
        operators = []
        for first in range(count):
            for second in range(first, count):
                left = of_moved[first].reshape(n, n)
                right = of_moved[second].reshape(n, n)
                operator = _symmetric_product(left, right, self._upper)
                if second > first:
                    operator = operator + _symmetric_product(right, left, self._upper)
                operators.append(operator.ravel())
        # tr(S·P) from the upper half of P: what is not on the diagonal counts twice.
        doubled = np.where(self._upper[0] == self._upper[1], 1.0, 2.0)
        linear = of_weights.reshape(-1, n, n)[:, self._upper[0], self._upper[1]] * doubled
        return of_moved, of_weights, np.array(operators), linear

    def averaged(self, latencies_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return what is averaged over the cycles of a distribution, a row for each latency.

        :data:`~.costs.NEVER` is an output that is lost.
        """
        latencies = np.asarray(latencies_ns)
        period_ns = self.loop.problem.period_s * 1e9
        if latencies.size and latencies.max() > period_ns * (1 + 1e-9):
            longest, period = duration_text(int(latencies.max())), duration_text(round(period_ns))
            reason = f"a latency of {longest} is above the period {period}, and cycles that are"
            raise InputError(f"{reason} drawn one by one do not overlap: use the sequence's cost")
        of_moved, of_weights, _, _ = self._basis
        rows = np.empty((latencies.size, self._averages))
        for begin in range(0, latencies.size, 4096):
            part = latencies[begin : begin + 4096]
            moved, weights = self._matrices(np.clip(part / 1e9, 0.0, None))
            lost = part == NEVER
            if lost.any():
                moved[lost], weights[lost] = self._lost()
            a = moved @ of_moved.T
            first, second = np.triu_indices(len(of_moved))
            rows[begin : begin + 4096] = np.hstack(
                [a[:, first] * a[:, second], weights @ of_weights.T]
            )
        return rows

    @cached_property
    def _averages(self) -> int:
        of_moved, of_weights, _, _ = self._basis
        return len(of_moved) * (len(of_moved) + 1) // 2 + len(of_weights)

    def costs(self, averages: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the cost per second of each row of averages; inf where the loop is unstable."""
        of_moved, _, operators, linear = self._basis
        products = len(of_moved) * (len(of_moved) + 1) // 2
        size = len(self._upper[0])
        averages = np.atleast_2d(averages)
        result = np.empty(len(averages))
        noise = self._noise[self._upper]
        for begin in range(0, len(averages), 256):
            part = averages[begin : begin + 256]
            left = np.eye(size) - (part[:, :products] @ operators).reshape(-1, size, size)
            try:
                covariance = np.linalg.solve(
                    left, np.broadcast_to(noise, (len(part), size))[..., None]
                )[..., 0]
            except np.linalg.LinAlgError:
                covariance = np.full((len(part), size), np.nan)
            weights = part[:, products:] @ linear
            cost = (weights * covariance).sum(axis=1) + self._noise_cost
            cost /= self.loop.problem.period_s
            cost[~self._positive(covariance)] = np.inf
            result[begin : begin + 256] = cost
        return result

    def _positive(self, upper: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which solutions are covariances: of an unstable loop the equation has none."""
        n = self.size
        full = np.zeros((len(upper), n, n))
        full[:, self._upper[0], self._upper[1]] = upper
        full[:, self._upper[1], self._upper[0]] = upper
        finite = np.isfinite(upper).all(axis=1)
        full[~finite] = 0.0
        least = np.linalg.eigvalsh(full)[:, 0]
        scale = np.abs(full).max(axis=(1, 2))
        good: NDArray[np.bool_] = finite & (least >= -1e-7 * scale)
        return good

    def cost(self, latencies_ns: NDArray[np.int64]) -> float:
        """Return the cost per second of a sample's distribution; inf: unstable."""
        return float(self.costs(self.averaged(latencies_ns).mean(axis=0))[0])


def _directions(rows: Matrix) -> Matrix:
    """Return an orthonormal basis of rows, without what is too small to matter."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    kept: Matrix = directions[sizes > DIRECTIONS * sizes[0]]
    return kept


def _symmetric_product(left: Matrix, right: Matrix, upper: tuple[NDArray[np.intp], ...]) -> Matrix:
    """Return the map P → left·P·rightᵀ between upper halves, its result made symmetric."""
    row, column = upper
    # Column (i, j) of the map is left·(Eᵢⱼ + Eⱼᵢ)·rightᵀ, or left·Eᵢᵢ·rightᵀ.
    images = left[:, None, row] * right[None, :, column]
    twin = left[:, None, column] * right[None, :, row]
    images = np.where(row == column, images, images + twin)
    images = (images + np.swapaxes(images, 0, 1)) / 2
    result: Matrix = images[row, column]
    return result
