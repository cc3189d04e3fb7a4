"""The swarm and the random placement: repeatable, never better than the exact one."""

import random
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from chainshaper.planning.bands import (
    BandProblem,
    Placement,
    band_problem,
    broken_constraint,
    place_bands,
    place_by_swarm,
    place_randomly,
)
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000


def _problem(seed: int, **limits: float) -> BandProblem:
    latencies = np.random.default_rng(seed).normal(67 * MS, 9 * MS, 400)
    latencies = latencies.clip(33 * MS, 85 * MS).astype(np.int64)
    return band_problem(latencies, 87 * MS, **limits)  # type: ignore[arg-type]


def _swarm(problem: BandProblem, bands: int, seed: int = 1) -> Placement:
    if find_spec("pyswarms") is None:
        pytest.skip("pyswarms is not installed")
    return place_by_swarm(problem, bands, seed)


def test_the_swarm_is_repeatable_and_leaves_no_traces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    assert _swarm(_problem(1), 3) == _swarm(_problem(1), 3)
    assert np.random.random() == expected
    assert not list(tmp_path.iterdir())


def test_the_exact_placement_is_never_worse_than_the_swarm() -> None:
    generator = random.Random(11)
    infeasible = 0
    for seed in range(25):
        bands = generator.randint(2, 8)
        max_gap = generator.choice([None, 20 * MS, 2 * MS])
        problem = _problem(seed, max_gap_ns=max_gap)  # type: ignore[arg-type]
        exact = place_bands(problem, bands)
        try:
            swarm = _swarm(problem, bands, seed)
        except OperationError:
            infeasible += 1
            continue
        assert broken_constraint(problem, swarm.slot_ends_ns) is None
        assert exact.mean_ns <= swarm.mean_ns
    assert infeasible < 25


def test_random_placements_keep_the_constraints_and_reach_everywhere() -> None:
    problem = band_problem(np.array([0, 10]), 12, publish_slot_ns=1, grid_ns=1)
    seen = {place_randomly(problem, 3, seed).slot_ends_ns for seed in range(500)}
    allowed = {
        (first, second, 12)
        for first in range(2, 11)
        for second in range(first + 2, 11)
        if first - 1 > 0
    }
    assert seen == allowed
    assert place_randomly(_problem(1), 3, 8) == place_randomly(_problem(1), 3, 8)
    tight = _problem(1, max_gap_ns=25 * MS)
    assert broken_constraint(tight, place_randomly(tight, 3, 2).slot_ends_ns) is None


def test_what_cannot_be_placed_is_said() -> None:
    with pytest.raises(OperationError, match="last random draw ended"):
        place_randomly(_problem(1, max_gap_ns=1_001_000), 3)
    with pytest.raises(OperationError, match="grid of 20ms is too coarse"):
        place_randomly(replace(_problem(1), grid_ns=20 * MS), 10)
    with pytest.raises(OperationError, match="use the exact solver"):
        _swarm(_problem(1), 40)
    equal = band_problem(np.array([50, 50]) * MS, 51 * MS)
    for place in (place_by_swarm, place_randomly):
        with pytest.raises(InputError, match="room for 1 publish slots"):
            place(equal, 2)
        assert place(equal, 1).slot_ends_ns == (51 * MS,)
        with pytest.raises(InputError, match="one band at least"):
            place(equal, 0)
