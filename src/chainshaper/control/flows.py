"""What happens to a plant while its input is constant, exactly, for any duration.

Over t seconds: x(t) = Φ(t)·x + Γ(t)·u + noise of covariance R(t), and the cost
[u; x]ᵀ·S(t)·[u; x] + s(t). All are read off matrix exponentials (Van Loan, IEEE Transactions on
Automatic Control 23(3), 1978). For many durations they are tabulated: polynomials of degree three
between instants at which values and derivatives are exact.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chainshaper.control.loop import Matrix, Problem, scipy_linalg

LEAST_INTERVALS = 256
MOST_INTERVALS = 32_768
FINENESS = 256  # intervals for each unit of ‖A‖·duration: the error is below 1e-12


@dataclass(frozen=True)
class Flow:
    """The plant over one duration, its input first: ``[u; x]``."""

    rows: Matrix  # n x (inputs + n): [Γ Φ]
    noise: Matrix  # R, n x n
    cost: Matrix  # S, over [u; x]
    noise_cost: float  # s

    @property
    def flat(self) -> NDArray[np.float64]:
        return np.concatenate(
            [self.rows.ravel(), self.noise.ravel(), self.cost.ravel(), [self.noise_cost]]
        )


class Flows:
    """The flows of a plant over all durations up to one period."""

    def __init__(self, problem: Problem) -> None:
        plant = problem.plant
        n, inputs = plant.states, plant.inputs
        size = n + inputs
        self.inputs, self.states, self.longest_s = inputs, n, problem.period_s
        # d/dt [u; x] = dynamics · [u; x]
        self.dynamics = np.zeros((size, size))
        self.dynamics[inputs:, :inputs], self.dynamics[inputs:, inputs:] = plant.b, plant.a
        order = [*range(n, n + inputs), *range(n)]
        self.weights = problem.cost[np.ix_(order, order)]
        self.noise = np.zeros((size, size))
        self.noise[inputs:, inputs:] = problem.process_noise

    def over(self, duration_s: float) -> Flow:
        """Return the flow over one duration, from matrix exponentials."""
        size, inputs = len(self.dynamics), self.inputs
        exponential = scipy_linalg().expm
        # S and its integral s by one exponential, R by another.
        block = np.zeros((3 * size, 3 * size))
        block[:size, :size] = -self.dynamics.T
        block[:size, size : 2 * size] = np.eye(size)
        block[size : 2 * size, size : 2 * size] = -self.dynamics.T
        block[size : 2 * size, 2 * size :] = self.weights
        block[2 * size :, 2 * size :] = self.dynamics
        # A stiff plant's exponential of −Aᵀ overflows: go on from half the time, doubling.
        halves = max(
            0, int(np.ceil(np.log2(max(np.abs(self.dynamics).sum() * duration_s, 1e-300))))
        )
        step = duration_s / 2**halves
        whole = exponential(block * step)
        transition = whole[2 * size :, 2 * size :]
        cost = transition.T @ whole[size : 2 * size, 2 * size :]
        integral = transition.T @ whole[:size, 2 * size :]
        noise_block = np.zeros((2 * size, 2 * size))
        noise_block[:size, :size] = -self.dynamics
        noise_block[:size, size:] = self.noise
        noise_block[size:, size:] = self.dynamics.T
        noisy = exponential(noise_block * step)
        gained = noisy[size:, size:].T @ noisy[:size, size:]
        noise_cost = float(np.trace(integral @ self.noise))
        for _ in range(halves):
            noise_cost = 2 * noise_cost + float(np.trace(cost @ gained))
            cost = cost + transition.T @ cost @ transition
            gained = transition @ gained @ transition.T + gained
            transition = transition @ transition
        return Flow(
            rows=transition[inputs:],
            noise=(gained + gained.T)[inputs:, inputs:] / 2,
            cost=(cost + cost.T) / 2,
            noise_cost=noise_cost,
        )

    def _derivative(self, flow: Flow) -> NDArray[np.float64]:
        """Return the derivative of a flow's values by its duration."""
        inputs, size = self.inputs, len(self.dynamics)
        whole = np.eye(size)
        whole[inputs:] = flow.rows
        rows = (self.dynamics @ whole)[inputs:]
        a = self.dynamics[inputs:, inputs:]
        noise = a @ flow.noise + flow.noise @ a.T + self.noise[inputs:, inputs:]
        cost = whole.T @ self.weights @ whole
        noise_cost = float(np.trace(self.weights[inputs:, inputs:] @ flow.noise))
        return Flow(rows, noise, cost, noise_cost).flat

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """The polynomials: interval x coefficient (4) x value, over [0, 1) within an interval."""
        reach = float(np.abs(np.linalg.eigvals(self.dynamics)).max()) * self.longest_s
        wanted = max(LEAST_INTERVALS, FINENESS * reach)
        intervals = int(min(MOST_INTERVALS, 2 ** np.ceil(np.log2(wanted))))
        step = self.longest_s / intervals
        one, flow = self.over(step), self.over(0.0)
        values, slopes = [flow.flat], [self._derivative(flow)]
        for _ in range(intervals):
            flow = self._joined(flow, one)
            values.append(flow.flat)
            slopes.append(self._derivative(flow))
        value, slope = np.array(values), np.array(slopes) * step
        first, last = value[:-1], value[1:]
        begin, end = slope[:-1], slope[1:]
        return np.ascontiguousarray(
            np.stack(
                [
                    first,
                    begin,
                    3 * (last - first) - 2 * begin - end,
                    2 * (first - last) + begin + end,
                ],
                axis=1,
            )
        )

    def _joined(self, before: Flow, after: Flow) -> Flow:
        """Return the flow over two durations, one behind the other."""
        inputs, size = self.inputs, len(self.dynamics)
        whole, later = np.eye(size), np.eye(size)
        whole[inputs:], later[inputs:] = before.rows, after.rows
        transition = after.rows[:, inputs:]
        weights = after.cost[inputs:, inputs:]
        return Flow(
            rows=(later @ whole)[inputs:],
            noise=transition @ before.noise @ transition.T + after.noise,
            cost=before.cost + whole.T @ after.cost @ whole,
            noise_cost=before.noise_cost
            + after.noise_cost
            + float(np.trace(weights @ before.noise)),
        )

    def many(self, durations_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return rows, noises, costs and costs of noise over many durations, from the table."""
        table, size = self.table, len(self.dynamics)
        place = np.clip(durations_s / self.longest_s, 0.0, 1.0) * len(table)
        interval = np.minimum(place.astype(np.int64), len(table) - 1)
        inside = (place - interval)[:, np.newaxis]
        c = table[interval]
        flat = c[:, 0] + inside * (c[:, 1] + inside * (c[:, 2] + inside * c[:, 3]))
        n, count = self.states, len(durations_s)
        ends = np.cumsum([n * size, n * n, size * size])
        rows, noise, cost, noise_cost = np.split(flat, ends, axis=1)
        return (
            rows.reshape(count, n, size),
            noise.reshape(count, n, n),
            cost.reshape(count, size, size),
            noise_cost[:, 0],
        )
