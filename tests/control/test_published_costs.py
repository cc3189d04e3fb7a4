"""Costs against closed forms, and against values that the authors of other tools have published.

* Jitterbug: its reference manual 1.24, section "Multirate Controller" (J = 3.40, and 1.93 with both
  controllers at the fast rate); its example `multirate.m` gives 3.3955 and 1.9329.
* JitterTime: examples 1 and 3 of its reference manual 1.2. Of example 1, figures with all digits
  stand in the tests of JitterTime.jl. A comment in its `lqg_dcmotor.m` says 1.4583, but with the
  parameters in that file the optimum is 1.0382, by the Riccati equations of continuous time; that
  comment is of others.
* The minimum variance of an integrator: Åström and Wittenmark, Computer-Controlled Systems.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chainshaper.control.costs import cost_of_events, cost_over, events_of
from chainshaper.control.design import design_controller
from chainshaper.control.loop import (
    Controller,
    Loop,
    Plant,
    Problem,
    plant_of_transfer_function,
    static_controller,
)
from chainshaper.control.steady_state import LatencyCosts, cost_of_constant

S = 1_000_000_000


def integrator(gain: float, period_s: float = 1.0) -> Loop:
    """dx = u·dt + dw, u = −gain·x, J = E x²."""
    plant = Plant(np.zeros((1, 1)), np.eye(1), np.eye(1))
    problem = Problem(plant, np.eye(1), np.zeros((1, 1)), np.diag([1.0, 0.0]), period_s)
    return Loop(problem, static_controller([[gain]]))


def moments_of_integrator(
    gain: float, period: float, delays: list[float], shares: list[float]
) -> tuple[float, float]:
    """Return E x² and E xₖ·xₖ₋₁ at the samples: xₖ₊₁ = (1 − K(h − τ))·xₖ − K·τ·xₖ₋₁ + w."""
    first = [1 - gain * (period - delay) for delay in delays]
    second = [-gain * delay for delay in delays]

    def mean(values: list[float]) -> float:
        return sum(share * value for share, value in zip(shares, values, strict=True))

    a, b = mean(first), mean(second)
    aa = mean([value**2 for value in first])
    bb = mean([value**2 for value in second])
    ab = mean([one * two for one, two in zip(first, second, strict=True)])
    # γ₁ = a·γ₀ + b·γ₁ and γ₀ = aa·γ₀ + bb·γ₀ + 2·ab·γ₁ + h
    ratio = a / (1 - b)
    variance = period / (1 - aa - bb - 2 * ab * ratio)
    return variance, ratio * variance


def cost_of_integrator(
    gain: float, period: float, delays: list[float], shares: list[float]
) -> float:
    """Integrate E x(t)² over a period by hand, and average it over the delays."""
    g0, g1 = moments_of_integrator(gain, period, delays, shares)
    total = 0.0
    for delay, share in zip(delays, shares, strict=True):
        k, r = gain, period - delay
        # Until the delay is over x(t) = xₖ − K·t·xₖ₋₁ + w; then it has the slope −K·xₖ.
        before = g0 * delay - 2 * k * g1 * delay**2 / 2 + k**2 * g0 * delay**3 / 3
        # behind it: xₖ·(1 − K·t) − K·τ·xₖ₋₁
        square = r - k * r**2 + k**2 * r**3 / 3
        cross = -2 * k * delay * (r - k * r**2 / 2)
        behind = g0 * square + g1 * cross + g0 * (k * delay) ** 2 * r
        total += share * (before + behind)
    return (total + period**2 / 2) / period


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.35, 0.7])
def test_the_cost_of_an_integrator_with_a_constant_delay_is_that_by_hand(delay: float) -> None:
    loop = integrator(0.8)
    expected = cost_of_integrator(0.8, 1.0, [delay], [1.0])
    assert cost_of_constant(loop, delay) == pytest.approx(expected, rel=1e-12)
    assert LatencyCosts(loop).cost(np.array([round(delay * S)])) == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize(("first", "second", "share"), [(0.0, 0.9, 0.5), (0.2, 0.6, 0.1)])
def test_the_cost_of_a_delay_with_two_values_is_that_by_hand(
    first: float, second: float, share: float
) -> None:
    loop = integrator(0.8)
    expected = cost_of_integrator(0.8, 1.0, [first, second], [1 - share, share])
    latencies = np.array(
        [round(first * S)] * round(10 * (1 - share)) + [round(second * S)] * round(10 * share)
    )
    assert LatencyCosts(loop).cost(latencies) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("period", [0.5, 1.0, 2.0])
def test_the_least_variance_of_an_integrator_is_that_of_the_textbook(period: float) -> None:
    least = (3 + math.sqrt(3)) / 6 * period
    gain = (3 + math.sqrt(3)) / (2 + math.sqrt(3)) / period
    assert cost_of_constant(integrator(gain, period), 0.0) == pytest.approx(least, rel=1e-12)
    problem = integrator(gain, period).problem
    designed = Loop(problem, design_controller(problem, 0.0))
    assert cost_of_constant(designed, 0.0) == pytest.approx(least, rel=1e-9)


def test_the_accumulated_cost_of_jittertimes_first_example() -> None:
    """An integrator is controlled from its third sample on: 7.420841162336913 after 6 s."""
    loop = integrator((3 + math.sqrt(3)) / (2 + math.sqrt(3)))
    samples = np.array([3, 4, 5, 6]) * S
    start = np.zeros((2, 2))
    start[1, 1] = 3.0  # E x² after 3 s of noise
    events = events_of(samples, np.zeros(4, dtype=np.int64), end_ns=6 * S + 1)
    result = cost_of_events(loop, events, start)
    assert 4.5 + result.costs[:3].sum() == pytest.approx(7.420841162336913, rel=1e-9)


def ball_and_beam(period: float) -> Loop:
    """Jitterbug's cascade of a PID and a P controller on 4.4/s and −9/s², executed at once."""
    a = np.array([[0.0, 0, 0], [-9, 0, 0], [0, 1, 0]])
    plant = Plant(a, np.array([[4.4], [0], [0]]), np.array([[0, 0, 1.0], [1, 0, 0]]))
    cost = np.diag([1.0, 0, 1, 0])
    problem = Problem(plant, np.diag([4.4**2, 0, 0]), np.zeros((2, 2)), cost, period)
    # 0.2·(1 + 1/(10·s) + s/(1 + 0.1·s)), poles and zeros matched, and the gain at s = 0.1/h.
    above, below = [11, 10.1, 1], [1, 10, 0]
    numerator, denominator = (np.poly(np.exp(np.roots(p) * period)) for p in (above, below))
    s, z = 0.1 / period, math.exp(0.1)
    wanted = 0.2 * np.polyval(above, s) / np.polyval(below, s)
    b0, b1, b2 = numerator * wanted / (np.polyval(numerator, z) / np.polyval(denominator, z))
    _, a1, a2 = denominator
    return Loop(
        problem,
        Controller(
            f=np.array([[-a1, -a2], [1.0, 0]]),
            g=np.array([[1.0, 0], [0, 0]]),
            h=4 * np.array([[b1 - a1 * b0, b2 - a2 * b0]]),
            k=np.array([[4 * b0, -4.0]]),
        ),
    )


@pytest.mark.parametrize(("period", "published"), [(0.1, 3.3955), (0.05, 1.9329)])
def test_the_costs_of_jitterbugs_cascade(period: float, published: float) -> None:
    loop = ball_and_beam(period)
    assert cost_of_constant(loop, 0.0) == pytest.approx(published, abs=5e-5)


def test_an_lqg_controller_that_samples_often_costs_what_the_continuous_one_does() -> None:
    """JitterTime's motor, by its Riccati equations: tr(S·W) + tr(P·Lᵀ·Q₂·L)."""
    from scipy.linalg import solve_continuous_are

    period, q1, q2, r2 = 0.001, np.diag([1.1, 0.3]), 0.7, 0.1**2
    a, b, c = np.array([[0, 1.0], [0, -1]]), np.array([[0], [1.0]]), np.array([[1.0, 0]])
    value = solve_continuous_are(a, b, q1, np.array([[q2]]))
    error = solve_continuous_are(a.T, c.T, b @ b.T, np.array([[r2]]))
    gain = b.T @ value / q2
    expected = np.trace(value @ b @ b.T) + q2 * np.trace(error @ gain.T @ gain)
    cost = np.diag([1.1, 0.3, q2])
    problem = Problem(Plant(a, b, c), b @ b.T, np.array([[r2 / period]]), cost, period)
    loop = Loop(problem, design_controller(problem, 0.0))
    assert cost_of_constant(loop, 0.0) == pytest.approx(expected, rel=1e-3)


def least_urgent_latencies(period_us: int, until_us: int) -> tuple[NDArray[np.int64], ...]:
    """Return samples and latencies (ns) of a task of 25 ms below two others, by simulating it.

    The others take 27 ms of each 80 ms and 44 ms of each 140 ms. As in JitterTime's example the
    controller samples when it begins to run.
    """
    busy = np.zeros(until_us // 1000, dtype=bool)
    for length, execution in ((80, 27), (140, 44)):
        # By priority: the first task's work comes as it is, the second's where that leaves room.
        for begin in range(0, busy.size, length):
            free = np.flatnonzero(~busy[begin:])[:execution] + begin
            busy[free] = True
    samples, latencies = [], []
    free = np.flatnonzero(~busy)
    at = 0
    for release in range(0, until_us - 2_000_000, period_us):
        # Free time is in whole milliseconds, and so are releases.
        at = max(at, int(np.searchsorted(free, release // 1000)))
        if at + 25 >= free.size:
            break
        samples.append(int(free[at]) * 1_000_000)
        at += 25
        latencies.append((int(free[at - 1]) + 1) * 1_000_000 - samples[-1])
    return np.array(samples), np.array(latencies)


def test_the_best_period_of_jittertimes_third_example() -> None:
    """The cost is least at 75 ms, about 28 % below that at 195 ms."""
    plant = plant_of_transfer_function([1], [1, 0, -1])
    costs = {}
    for period in (*range(60, 100, 5), 195):
        cost = np.zeros((3, 3))
        cost[:2, :2] = plant.c.T @ plant.c
        cost[2, 2] = 0.01
        problem = Problem(plant, plant.b @ plant.b.T, np.array([[0.01]]), cost, period / 1000)
        loop = Loop(problem, design_controller(problem, 0.025))
        samples, latencies = least_urgent_latencies(period * 1000, 60_000_000)
        costs[period] = cost_over(loop, samples, latencies).cost
    assert min(costs, key=costs.__getitem__) == 75
    assert 1 - costs[75] / costs[195] == pytest.approx(0.28, abs=0.01)
