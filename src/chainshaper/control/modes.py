"""Controllers for the modes of a system, each for its own latency, and what changing them costs.

A change from one mode to another begins in the first's steady state, and goes on with the second's
latency and controller, which takes over the state of the first: both remember equally many outputs.
The cost of switching is what the transient costs beyond the second's steady state, once:

    Σₖ (Jₖ − J₂)·h = tr(V₂·(P₁ − P₂)),     V₂ = M₂ᵀ·V₂·M₂ + S₂.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from chainshaper.control.design import design_controller, periods_of_delay
from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop, Problem
from chainshaper.control.lyapunov import solve_lyapunov
from chainshaper.control.steady_state import STABLE, steady_period
from chainshaper.values.errors import InputError


@dataclass(frozen=True)
class ModeCosts:
    """The costs of modes, each with the controller for its latency."""

    latency_ns: Mapping[str, int]
    cost: Mapping[str, float]  # per second, in the steady state
    switching: Mapping[tuple[str, str], float]  # of a change from one to another, once


def mode_costs(problem: Problem, latencies_ns: Mapping[str, int]) -> ModeCosts:
    """Return what each mode and each change between two of them costs.

    Raises InputError: no controller stabilises the plant at a mode's latency.
    """
    flows = Flows(problem)
    remembered = max(periods_of_delay(problem, latency / 1e9) for latency in latencies_ns.values())
    steady = {}
    for mode, latency_ns in latencies_ns.items():
        try:
            controller = design_controller(problem, latency_ns / 1e9, remembered)
        except InputError as error:
            raise InputError(f"mode {mode}: {error}") from error
        steady[mode] = steady_period(Loop(problem, controller), latency_ns / 1e9, remembered, flows)
    covariance, value, cost = {}, {}, {}
    for mode, (whole, noise, weights, noise_cost) in steady.items():
        if np.abs(np.linalg.eigvals(whole)).max() >= STABLE:
            raise InputError(f"mode {mode}: no controller stabilises it: leave it out")
        covariance[mode] = solve_lyapunov(whole, noise)
        value[mode] = solve_lyapunov(whole.T, weights)
        per_period = float(np.trace(weights @ covariance[mode]) + noise_cost)
        cost[mode] = per_period / problem.period_s
    switching = {
        (first, second): float(np.trace(value[second] @ (covariance[first] - covariance[second])))
        for first in steady
        for second in steady
        if first != second
    }
    return ModeCosts(dict(latencies_ns), cost, switching)
