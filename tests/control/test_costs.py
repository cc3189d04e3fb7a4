"""Costs over sequences: against maps multiplied one by one, against noise that is drawn, and
against the steady state; and what is refused.
"""

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from chainshaper import _core
from chainshaper.control.costs import (
    NEVER,
    Events,
    constant_events,
    cost_of_events,
    cost_over,
    events_of,
    sampling,
)
from chainshaper.control.design import design_controller
from chainshaper.control.drawn import draw
from chainshaper.control.flows import Flows
from chainshaper.control.loop import (
    Loop,
    Plant,
    Problem,
    plant_of,
    plant_of_transfer_function,
    static_controller,
)
from chainshaper.control.modes import mode_costs
from chainshaper.control.steady_state import (
    LatencyCosts,
    cost_of_constant,
    covariance_of_constant,
    radius_of_constant,
    stable_latencies,
    steady_period,
)
from chainshaper.values.errors import InputError

control: Any = import_module("control")  # python-control, not the folder that this file is in
MS = 1_000_000
PERIOD = 100 * MS


def problem_of(numerator: list[float], denominator: list[float], period_s: float = 0.1) -> Problem:
    plant = plant_of_transfer_function(numerator, denominator)
    n = plant.states
    cost = np.zeros((n + 1, n + 1))
    cost[:n, :n] = plant.c.T @ plant.c
    cost[n, n] = 0.01
    return Problem(plant, plant.b @ plant.b.T, np.array([[0.01]]), cost, period_s)


def pendulum(delay_s: float = 0.03) -> Loop:
    problem = problem_of([1], [1, 0, -1])
    return Loop(problem, design_controller(problem, delay_s))


def plant_of_order_four() -> Loop:
    """Two inputs and two outputs, lightly damped."""
    a = np.array([[0, 1.0, 0, 0], [-4, -0.2, 1, 0], [0, 0, 0, 1], [0.5, 0, -9, -0.3]])
    b = np.array([[0, 0], [1.0, 0], [0, 0], [0.2, 2]])
    plant = Plant(a, b, np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]]))
    cost = np.diag([1.0, 0.1, 2, 0.1, 0.05, 0.02])
    cost[0, 4] = cost[4, 0] = 0.01
    problem = Problem(plant, b @ b.T + 0.01 * np.eye(4), 0.02 * np.eye(2), cost, 0.1)
    return Loop(problem, design_controller(problem, 0.04))


def cycles(
    count: int, seed: int, longest_ns: int, lost: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    random = np.random.default_rng(seed)
    samples = np.arange(count) * PERIOD + random.integers(0, 3 * MS, count)
    latencies = random.integers(5 * MS, longest_ns, count)
    latencies[random.random(count) < lost] = NEVER
    return samples, latencies


def steps(events: Events) -> Iterator[tuple[float, int]]:
    yield from zip(events.waits_s.tolist(), events.slots.tolist(), strict=True)


def by_dense_maps(loop: Loop, events: Events) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Carry the covariance by whole matrices, and integrate costs over small steps of Simpson's."""
    flows, parts = Flows(loop.problem), loop.slices(events.under_way)
    size, flowing = parts["all"].stop, parts["plant"].stop
    covariance = np.zeros((size, size))
    rows, noise = sampling(loop)
    whole = np.zeros((size, size))
    whole[:flowing, :flowing] = flows.dynamics
    intensity = np.zeros((size, size))
    intensity[:flowing, :flowing] = flows.noise
    costs: list[float] = []
    cost = 0.0
    for wait, slot in steps(events):
        count = 16
        step = wait / count
        if wait:
            half = expm(whole * step / 2)
            block = np.zeros((2 * size, 2 * size))
            block[:size, :size], block[:size, size:] = -whole, intensity
            block[size:, size:] = whole.T
            gained = expm(block * step / 2)
            gained = gained[size:, size:].T @ gained[:size, size:]
        for _ in range(count if wait else 0):
            rates = []
            for place in range(3):
                rates.append(np.trace(flows.weights @ covariance[:flowing, :flowing]))
                if place < 2:
                    covariance = half @ covariance @ half.T + gained
            cost += step * (rates[0] + 4 * rates[1] + rates[2]) / 6
        event = np.eye(size)
        if slot == _core.NO_EVENT:
            continue
        if slot >= 0:
            event[parts["applied"]] = 0
            event[parts["applied"], parts[f"slot{slot}"]] = np.eye(flows.inputs)
            covariance = event @ covariance @ event.T
            continue
        costs.append(cost)
        cost = 0.0
        computed = np.r_[parts["controller"], parts[f"slot{~slot}"]]
        event[computed] = 0
        event[computed, parts["plant"].start : parts["controller"].stop] = rows
        covariance = event @ covariance @ event.T
        covariance[np.ix_(computed, computed)] += noise
    return np.array([*costs[1:], cost]), covariance


@pytest.mark.parametrize("make", [pendulum, plant_of_order_four])
@pytest.mark.parametrize(("longest", "lost"), [(90, 0.0), (90, 0.3), (330, 0.1)])
def test_the_covariance_is_that_of_whole_matrices(make: object, longest: int, lost: float) -> None:
    loop = make()  # type: ignore[operator]
    events = events_of(*cycles(12, 4, longest * MS, lost))
    result = cost_of_events(loop, events)
    costs, covariance = by_dense_maps(loop, events)
    assert result.costs == pytest.approx(costs, rel=1e-6)
    assert result.covariance == pytest.approx(covariance, rel=1e-8, abs=1e-10)
    assert result.cost == pytest.approx(costs.sum() / result.durations_s.sum(), rel=1e-6)


@pytest.mark.parametrize(("longest", "lost"), [(95, 0.0), (95, 0.2), (180, 0.05)])
def test_the_cost_is_the_average_of_runs_with_drawn_noise(longest: int, lost: float) -> None:
    loop = pendulum()
    events = events_of(*cycles(80, 7, longest * MS, lost))
    exact = cost_of_events(loop, events).cost
    drawn = draw(loop, events, runs=1_500, seed=5).costs
    error = drawn.std() / np.sqrt(drawn.size)
    assert abs(drawn.mean() - exact) < 4 * error
    assert error < 0.05 * exact  # else the comparison says nothing


@pytest.mark.parametrize("latency_ns", [0, 1, 40 * MS, 100 * MS, 130 * MS, 210 * MS])
def test_a_constant_latency_costs_what_the_steady_state_does(latency_ns: int) -> None:
    problem = problem_of([1], [1, 0, -1])
    loop = Loop(problem, design_controller(problem, latency_ns / 1e9))
    steady = cost_of_constant(loop, latency_ns / 1e9)
    begin = covariance_of_constant(loop, latency_ns / 1e9)
    long = cost_of_events(loop, constant_events(PERIOD, latency_ns, 3_000), begin)
    assert long.cost == pytest.approx(steady, rel=2e-3)
    assert long.costs[-500:].mean() / 0.1 == pytest.approx(steady, rel=1e-6)


def test_latencies_in_any_order_cost_what_their_distribution_does() -> None:
    loop, random = pendulum(), np.random.default_rng(3)
    latencies = random.integers(5 * MS, 95 * MS, 60_000)
    latencies[random.random(latencies.size) < 0.05] = NEVER
    sequence = cost_over(loop, np.arange(latencies.size) * PERIOD, latencies)
    steady = LatencyCosts(loop).cost(latencies)
    assert abs(sequence.cost - steady) < 2 * sequence.margin
    assert sequence.margin < 0.03 * steady


def test_the_order_of_latencies_matters() -> None:
    """Long latencies in a row cost not what the same ones apart do: no average knows it."""
    loop = pendulum()
    apart = np.tile([10 * MS, 90 * MS], 2_000)
    in_rows = np.repeat(np.tile([10 * MS, 90 * MS], 100), 20)
    samples = np.arange(apart.size) * PERIOD
    assert cost_over(loop, samples, in_rows).cost != pytest.approx(
        cost_over(loop, samples, apart).cost, rel=0.01
    )


def test_an_unstable_loop_is_reported_with_the_delay_from_which_on_it_is() -> None:
    loop = pendulum(0.0)
    stable = stable_latencies(loop)
    assert stable is not None
    assert stable.until_s is not None
    margin = stable.until_s
    assert stable.from_s == 0
    assert radius_of_constant(loop, margin - 1e-4) < 1 < radius_of_constant(loop, margin + 1e-4)
    assert np.isfinite(cost_of_constant(loop, margin - 1e-3))
    assert cost_of_constant(loop, margin + 1e-3) == np.inf
    late = round((margin + 0.05) * 1e9)
    over = cost_of_events(loop, constant_events(PERIOD, late, 4_000))
    assert over.diverged
    # Of a distribution: lost so often that the variance has no bound.
    mostly_lost = np.array([50 * MS] * 1 + [NEVER] * 60)
    assert LatencyCosts(loop).cost(mostly_lost) == np.inf


def test_loops_are_stable_with_any_latency_or_none_or_with_longer_ones_alone() -> None:
    problem = problem_of([1], [1, 1])
    assert stable_latencies(Loop(problem, static_controller([[0.2]]))) == (0.0, None)
    assert stable_latencies(Loop(problem, static_controller([[-2.0]]))) is None
    # A controller without a price on its input counts on the delay that it was designed for.
    fast = problem_of([1], [1, 0, -9])
    cost = fast.cost.copy()
    cost[2, 2] = 1e-6
    fast = replace(fast, cost=cost, measurement_noise=np.array([[1e-6]]))
    loop = Loop(fast, design_controller(fast, 0.086))
    stable = stable_latencies(loop)
    assert stable is not None
    assert stable.until_s is not None
    assert 0 < stable.from_s < 0.086 < stable.until_s
    assert radius_of_constant(loop, stable.from_s - 1e-4) > 1
    assert radius_of_constant(loop, stable.from_s + 1e-4) < 1


def test_the_designed_controller_is_the_best() -> None:
    """Any other gain or delay that it is designed for costs more."""
    problem = problem_of([2], [1, 0.5, 0])
    for delay in (0.0, 0.04, 0.1, 0.17, 0.2):
        best = cost_of_constant(Loop(problem, design_controller(problem, delay)), delay)
        for further in (0.0, 0.02, 0.07, 0.12, 0.25):
            designed = Loop(problem, design_controller(problem, further))
            assert cost_of_constant(designed, delay) >= best * (1 - 1e-9)


def test_the_design_without_delay_is_that_of_python_control() -> None:
    problem = problem_of([1], [1, 0.3, 2])
    whole = Flows(problem).over(0.1)
    phi, gamma = whole.rows[:, 1:], whole.rows[:, :1]
    q, r = whole.cost[1:, 1:], whole.cost[:1, :1]
    cross = whole.cost[1:, :1]
    gain, _, _ = control.dlqr(phi, gamma, q, r, cross)
    predicted, _, _ = (
        control.dlqe(phi, np.eye(2), problem.plant.c, whole.noise, problem.measurement_noise)[1],
        None,
        None,
    )
    kalman = (
        predicted
        @ problem.plant.c.T
        @ np.linalg.inv(problem.plant.c @ predicted @ problem.plant.c.T + problem.measurement_noise)
    )
    ours = design_controller(problem, 0.0)
    assert ours.k == pytest.approx(-gain @ kalman, rel=1e-6)


def test_objects_of_python_control_are_plants() -> None:
    space = control.ss([[0, 1], [1, 0]], [[0], [1]], [[1, 0]], 0)
    plant = plant_of(space)
    assert plant.a.tolist() == [[0, 1], [1, 0]]
    function = plant_of(control.tf([1], [1, 0, -1]))
    frequencies = np.array([0.3, 1.0, 4.0])
    for frequency in frequencies:
        s = 1j * frequency
        response = function.c @ np.linalg.solve(s * np.eye(2) - function.a, function.b)
        assert response[0, 0] == pytest.approx(1 / (s**2 - 1))
    with pytest.raises(InputError, match="discrete"):
        plant_of(control.tf([1], [1, 0.5], 0.1))
    with pytest.raises(InputError, match="not strictly proper"):
        plant_of(control.ss([[0]], [[1]], [[1]], [[1]]))
    with pytest.raises(InputError, match="no plant"):
        plant_of("1/s")


@pytest.mark.parametrize("stiff", [0.1, 20.0, 2_000.0])
def test_flows_from_the_table_are_those_of_matrix_exponentials(stiff: float) -> None:
    problem = problem_of([1], [1, 2 + stiff, 2 * stiff])
    flows = Flows(problem)
    durations = np.array([0.0, 1e-6, 0.0123456, 0.07, 0.1])
    rows, noise, cost, noise_cost = flows.many(durations)
    for place, duration in enumerate(durations):
        exact = flows.over(float(duration))
        assert rows[place] == pytest.approx(exact.rows, abs=1e-8)
        assert noise[place] == pytest.approx(exact.noise, abs=1e-8)
        assert cost[place] == pytest.approx(exact.cost, abs=1e-8)
        assert noise_cost[place] == pytest.approx(exact.noise_cost, abs=1e-8)


def test_the_cost_of_switching_is_what_the_transient_costs() -> None:
    problem = problem_of([1], [1, 0, -1])
    modes = mode_costs(problem, {"near": 20 * MS, "far": 80 * MS})
    assert modes.cost["near"] < modes.cost["far"]
    flows, steady = Flows(problem), {}
    for name, delay in (("near", 0.02), ("far", 0.08)):
        loop = Loop(problem, design_controller(problem, delay, 1))
        whole, noise, weights, _ = steady_period(loop, delay, 1, flows)
        covariance = np.zeros_like(noise)
        for _ in range(600):
            covariance = whole @ covariance @ whole.T + noise
        steady[name] = whole, noise, weights, covariance
    *_, begin = steady["near"]
    whole, noise, weights, end = steady["far"]
    extra, covariance = 0.0, begin
    for _ in range(600):
        extra += np.trace(weights @ (covariance - end))
        covariance = whole @ covariance @ whole.T + noise
    assert modes.switching["near", "far"] == pytest.approx(extra, rel=1e-6)


def test_arrays_that_do_not_fit_are_refused_by_the_kernel() -> None:
    loop = pendulum()
    flows = Flows(loop.problem)
    rows, noise = sampling(loop)
    right: dict[str, Any] = {
        "sizes": (1, 2, 3, 1),
        "longest_s": 0.1,
        "flows": flows.table.ravel(),
        "rows": rows.ravel(),
        "noise": noise.ravel(),
        "waits_s": np.zeros(2),
        "slots": np.array([-1, 0], dtype=np.int32),
        "covariance": np.zeros(49),
    }
    _core.propagate_covariance(**right)
    for name, wrong in (
        ("rows", np.zeros(3)),
        ("flows", np.zeros(5)),
        ("covariance", np.zeros(4)),
        ("slots", np.array([-1, 7], dtype=np.int32)),
        ("waits_s", np.array([0.0, -1.0])),
        ("waits_s", np.array([0.0, np.nan])),
        ("sizes", (1, 2, 3, 65)),
    ):
        with pytest.raises(ValueError, match=r".+"):
            _core.propagate_covariance(**{**right, name: wrong})


def test_two_cycles_at_one_instant_are_refused() -> None:
    with pytest.raises(InputError, match="same instant"):
        events_of(np.array([0, 0]), np.array([1, 1]))
    with pytest.raises(InputError, match="two cycles"):
        events_of(np.array([0]), np.array([1]))
    with pytest.raises(InputError, match="under way"):
        events_of(np.arange(50) * MS, np.full(50, 40 * MS))
