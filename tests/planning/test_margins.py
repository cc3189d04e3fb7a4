"""Margins from extreme value theory: right where the truth is known, silent where it is not."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from chainshaper.errors import InputError, OperationError
from chainshaper.planning.margins import derive_margin, fit_tail
from chainshaper.planning.plan_file import dump_plan
from chainshaper.planning.shaping import plan_shaping, plan_warnings

MS = 1_000_000


def _uniform_sums(seed: int, size: int = 4000) -> NDArray[np.int64]:
    """The synthetic chain of section 2.5: five callbacks of 5 to 15 ms."""
    random = np.random.default_rng(seed)
    sums: NDArray[np.float64] = random.uniform(5 * MS, 15 * MS, (size, 5)).sum(axis=1)
    return sums.astype(np.int64)


def test_the_tail_of_a_known_distribution() -> None:
    # The sum of five uniform variables on [0, 1] exceeds 5 − d with probability d⁵/5!.
    probability = 1e-5
    truth = (75 - 10 * (probability * 120) ** (1 / 5)) * MS
    fits = [fit_tail(_uniform_sums(seed), probability) for seed in range(30)]
    estimates = np.array([fit.latency_ns for fit in fits])
    assert abs(np.median(estimates) - truth) < 1 * MS
    covered = [fit.interval_ns[0] <= truth <= fit.interval_ns[1] for fit in fits]
    assert sum(covered) >= 25
    assert all(fit.shape < 0 for fit in fits)  # a bounded distribution has a bounded tail


def test_a_pareto_tail_is_recovered() -> None:
    random = np.random.default_rng(4)
    for shape in (-0.3, 0.0, 0.2):
        drawn = 20 * MS + stats.genpareto.rvs(shape, scale=MS, size=50_000, random_state=random)
        fit = fit_tail(drawn.astype(np.int64), 1e-4)
        assert fit.shape == pytest.approx(shape, abs=0.1)
        truth = 20 * MS + stats.genpareto.isf(1e-4, shape, scale=MS)
        assert fit.interval_ns[0] <= truth <= fit.interval_ns[1]


def test_a_derived_margin_reaches_the_plan() -> None:
    latencies = _uniform_sums(1)
    fit = fit_tail(latencies, 1e-6)
    margin = derive_margin(latencies, 1e-6)
    assert margin.source == "derived"
    assert margin.overrun_probability == 1e-6
    assert margin.epsilon_ns == fit.latency_ns - latencies.max() > 0
    assert derive_margin(latencies, 1e-6) == margin  # repeatable
    assert derive_margin(latencies, 5e-4).epsilon_ns == 0  # seen already
    plan = plan_shaping(latencies, 100 * MS, margin=margin)
    assert plan.servers[0].slots[0][1] == fit.latency_ns
    assert "overrun_probability: 1.0e-06" in dump_plan(plan)
    assert any("is an estimate" in warning for warning in plan_warnings(plan))


def _drifting() -> NDArray[np.int64]:
    return _uniform_sums(2) + np.linspace(0, 5 * MS, 4000).astype(np.int64)


def _two_modes() -> NDArray[np.int64]:
    latencies = _uniform_sums(3)
    latencies[::70] = 90 * MS + np.arange(len(latencies[::70])) * 1000
    return latencies


def _clustered() -> NDArray[np.int64]:
    # Every long execution delays the next: the second of each pair is the larger of both.
    latencies = _uniform_sums(5)
    latencies[1:] = np.maximum(latencies[1:], latencies[:-1])
    return latencies


def _heavy() -> NDArray[np.int64]:
    random = np.random.default_rng(6)
    drawn: NDArray[np.float64] = stats.genpareto.rvs(0.4, scale=MS, size=500, random_state=random)
    return (10 * MS + drawn).astype(np.int64)


@pytest.mark.parametrize(
    ("latencies", "words"),
    [
        (_uniform_sums(1, 300), "300 latencies are too few"),
        (_drifting(), "not stationary"),
        (np.sort(_uniform_sums(1)), "not stationary"),
        (_two_modes(), "do not follow a generalised Pareto"),
        (np.repeat([50 * MS, 60 * MS], 400)[np.random.default_rng(1).permutation(800)], "Pareto"),
        (_clustered(), "come in clusters"),
        (_heavy(), "500 latencies are too few for an overrun probability of 1e-06"),
    ],
)
def test_data_that_allow_no_answer_get_none(latencies: NDArray[np.int64], words: str) -> None:
    with pytest.raises(OperationError, match=words):
        fit_tail(latencies, 1e-6)


@pytest.mark.parametrize("probability", [0.0, -1e-6, 0.5, float("nan")])
def test_probabilities_outside_the_tail_are_refused(probability: float) -> None:
    with pytest.raises(InputError, match="none of the tail"):
        fit_tail(_uniform_sums(1), probability)
