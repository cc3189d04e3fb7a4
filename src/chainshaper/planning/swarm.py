"""Band placement by particle swarm, as the paper does it, and at random: for comparison.

The exact placement (:mod:`chainshaper.planning.bands`) is never worse and is faster; these two
reproduce the paper's rows "Random" and "PSO" of tables 3 and 4 (section 4.1 and 5.1.5).
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import (
    BandProblem,
    Placement,
    broken_constraint,
    mean_of,
    refuse_more_than_fit,
)
from chainshaper.planning.extras import extra_library
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import OperationError

__all__ = ["place_by_swarm", "place_randomly"]

# Section 5.1.5.
PARTICLES = 100
ITERATIONS = 150
OPTIONS = {"c1": 0.5, "c2": 0.3, "w": 0.9}

RANDOM_TRIES = 10_000


def place_by_swarm(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands with PySwarms and the paper's parameters; the same ``seed``, the same result.

    Particles are the ends of all slots but the last, on the problem's grid. A particle that
    breaks a constraint costs more than any that does not, in proportion to how far it is off.

    Raises:
        InputError: as :func:`~chainshaper.planning.bands.refuse_more_than_fit`.
        OperationError: the swarm ended at a placement that breaks a constraint.
        PlatformError: PySwarms is not installed.
    """
    refuse_more_than_fit(problem, bands)
    if bands == 1:
        return _checked(problem, (problem.last_end_ns,), "the single band")
    lowest = float(problem.latencies_ns[0] + problem.publish_slot_ns)
    highest = float(problem.last_end_ns - problem.publish_slot_ns)
    bounds = (np.full(bands - 1, lowest), np.full(bands - 1, highest))
    with _quiet_and_seeded(seed):
        swarm = extra_library("pyswarms", "placement by particle swarm").single.GlobalBestPSO(
            n_particles=PARTICLES, dimensions=bands - 1, options=OPTIONS, bounds=bounds
        )
        _, best = swarm.optimize(
            lambda particles: _costs(problem, particles), iters=ITERATIONS, verbose=False
        )
    ends = _slot_ends(problem, best[np.newaxis, :])[0]
    return _checked(problem, tuple(int(end) for end in ends), "the swarm")


def place_randomly(problem: BandProblem, bands: int, seed: int | None = None) -> Placement:
    """Place bands at random, every allowed placement on the grid being equally likely.

    Raises:
        InputError: as :func:`~chainshaper.planning.bands.refuse_more_than_fit`.
        OperationError: the grid is too coarse for so many, or no draw out of ten thousand keeps
            all constraints.
    """
    refuse_more_than_fit(problem, bands)
    if bands == 1:
        return _checked(problem, (problem.last_end_ns,), "the single band")
    grid, slot = problem.grid_ns, problem.publish_slot_ns
    first = (int(problem.latencies_ns[0]) + slot) // grid + 1
    size = -(-(problem.last_end_ns - slot) // grid) - first
    # Draw from the positions that remain when each gap's minimum beyond one step is taken out.
    spare = slot // grid
    remaining = size - spare * (bands - 2)
    if remaining < bands - 1:
        raise OperationError(
            f"{bands} bands cannot be placed: the grid of {format_duration(grid)} is too coarse for"
            f" slots of {format_duration(slot)}; use a finer one"
        )
    random = np.random.default_rng(seed)
    for _ in range(RANDOM_TRIES):
        drawn = np.sort(random.choice(remaining, size=bands - 1, replace=False))
        ends = (first + drawn + spare * np.arange(bands - 1)) * grid
        placed = (*(int(end) for end in ends), problem.last_end_ns)
        if broken_constraint(problem, placed) is None:
            break
    return _checked(problem, placed, "the last random draw")


def _checked(problem: BandProblem, ends: tuple[int, ...], what: str) -> Placement:
    broken = broken_constraint(problem, ends)
    if broken is not None:
        raise OperationError(
            f"{what} ended at a placement that is not allowed ({broken}); use the exact solver"
        )
    return Placement(ends, mean_of(problem, ends))


def _slot_ends(problem: BandProblem, particles: NDArray[np.float64]) -> NDArray[np.int64]:
    grid = problem.grid_ns
    ends = np.ceil(np.sort(particles, axis=1) / grid).astype(np.int64) * grid
    last = np.full((len(ends), 1), problem.last_end_ns)
    return np.hstack([ends, last])


def _costs(problem: BandProblem, particles: NDArray[np.float64]) -> NDArray[np.float64]:
    ends = _slot_ends(problem, particles)
    gaps = np.diff(ends, axis=1)
    reached = np.searchsorted(problem.latencies_ns, ends, side="right")
    counts = np.diff(reached, axis=1, prepend=0)
    means = (counts * ends).sum(axis=1) / problem.latencies_ns.size
    slot = problem.publish_slot_ns
    off = np.clip(problem.latencies_ns[0] + slot + 1 - ends[:, 0], 0, None)
    off = off + np.clip(slot + 1 - gaps, 0, None).sum(axis=1)
    if problem.max_gap_ns is not None:
        off = off + np.clip(gaps - problem.max_gap_ns, 0, None).sum(axis=1)
    too_many = np.clip(counts - problem.most_per_band, 0, None).sum(axis=1)
    off = off + too_many * problem.last_end_ns / problem.latencies_ns.size
    result: NDArray[np.float64] = np.where(off > 0, problem.last_end_ns + off, means)
    return result


@contextmanager
def _quiet_and_seeded(seed: int | None) -> Iterator[None]:
    """PySwarms draws from NumPy's global generator and sets up logging into the current folder.

    Both are put right here: the generator's state comes back, and a logging configuration that
    changes nothing (named by PySwarms' own environment variable) keeps it from writing files.
    """
    state = np.random.get_state()
    configured = os.environ.get("LOG_CFG")
    with tempfile.TemporaryDirectory(prefix="chainshaper-") as folder:
        configuration = Path(folder) / "logging.yaml"
        configuration.write_text("version: 1\nincremental: true\n")
        os.environ["LOG_CFG"] = str(configuration)
        try:
            np.random.seed(seed)
            yield
        finally:
            np.random.set_state(state)
            if configured is None:
                del os.environ["LOG_CFG"]
            else:
                os.environ["LOG_CFG"] = configured
