"""Exact band placement against PySwarms, on the same data in one run.

    python benchmarks/band_placement.py [--instances 1000]

First the time to place bands for growing samples, sorted beforehand: each row is the fastest of
several runs of either solver, and their ratio. Then many small random instances, with gap and
slot limits from loose to tight: how often the swarm ends at a placement that is not allowed,
how often it misses the optimum and by how much, and that it is never better.
"""

import argparse
import random
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import (
    BandProblem,
    Placement,
    place_bands,
    place_by_swarm,
)
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000
ROUNDS = 5


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--instances", type=int, default=1000)
    arguments.add_argument(
        "--samples", type=int, nargs="*", default=[1_000, 10_000, 100_000, 1_000_000]
    )
    options = arguments.parse_args()
    place_bands(_problem(1000, 0), 3)  # compiles
    print("samples   bands  grid points  exact [ms]  PySwarms [ms]  ratio  swarm above optimum")
    for samples in options.samples:
        for bands in (3, 10):
            _compare(_problem(samples, 1), bands)
    _race(options.instances)


def _latencies(size: int, seed: int) -> NDArray[np.int64]:
    """Like the paper's chain: 32.9 to 84.7 ms, 67.4 on average, skewed to the right end."""
    drawn = np.random.default_rng(seed).beta(4.2, 2.1, size)
    return (32.9 * MS + drawn * 51.8 * MS).astype(np.int64)


def _problem(size: int, seed: int) -> BandProblem:
    return BandProblem(_latencies(size, seed), 87 * MS)


def _fastest(place: Callable[[], Placement]) -> tuple[float, Placement]:
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        placement = place()
        times.append(time.perf_counter() - start)
    return min(times), placement


def _compare(problem: BandProblem, bands: int) -> None:
    exact_time, exact = _fastest(lambda: place_bands(problem, bands))
    swarm_time, swarm = _fastest(lambda: place_by_swarm(problem, bands, seed=1))
    points = (problem.last_end_ns - int(problem.latencies_ns[0])) // problem.grid_ns
    above = swarm.mean_ns / exact.mean_ns - 1
    print(
        f"{problem.latencies_ns.size:<9} {bands:<6} {points:<12} {exact_time * 1e3:<11.1f}"
        f" {swarm_time * 1e3:<14.1f} {swarm_time / exact_time:<6.1f} {above:.4%}"
    )


def _race(instances: int) -> None:
    generator = random.Random(1)
    infeasible = better = worse = unsolvable = 0
    exact_total = swarm_total = 0.0
    excess = []
    for seed in range(instances):
        problem = BandProblem(
            _latencies(generator.choice([20, 100, 500]), seed),
            87 * MS,
            publish_slot_ns=generator.choice([MS // 4, MS, 3 * MS]),
            grid_ns=generator.choice([1_000, 10_000]),
            max_gap_ns=generator.choice([None, 20 * MS, 8 * MS, 4 * MS, 3 * MS + 50_000]),
        )
        bands = generator.randint(2, 10)
        start = time.perf_counter()
        try:
            exact = place_bands(problem, bands)
        except (InputError, OperationError):  # no room for so many, or a limit is in the way
            unsolvable += 1
            continue
        exact_total += time.perf_counter() - start
        start = time.perf_counter()
        try:
            swarm = place_by_swarm(problem, bands, seed)
            excess.append(swarm.mean_ns / exact.mean_ns - 1)
            better += swarm.mean_ns < exact.mean_ns
            worse += swarm.mean_ns > exact.mean_ns
        except OperationError:
            infeasible += 1
        swarm_total += time.perf_counter() - start
    print(f"\n{instances} random instances, {unsolvable} of them without any placement:")
    print(f"  swarm not allowed   {infeasible}")
    print(f"  swarm worse         {worse}")
    if excess:
        print(f"    above optimum     {np.mean(excess):.3%} on average, {max(excess):.2%} at most")
    print(f"  swarm better        {better}")
    if exact_total:
        print(f"  time, swarm/exact   {swarm_total / exact_total:.1f}")


if __name__ == "__main__":
    main()
