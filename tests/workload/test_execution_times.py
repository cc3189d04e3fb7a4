"""Execution times: the same sequence for the same seed, and spent as CPU time."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.workload.description import ExecutionTime
from chainshaper.workload.execution import BLOCK, ExecutionTimes, draw, spend

UNIFORM = ExecutionTime(uniform_ns=(5_000_000, 15_000_000))
NORMAL = ExecutionTime(normal_ns=(8_000_000, 2_000_000), within_ns=(7_000_000, 14_000_000))
CONSTANT = ExecutionTime(constant_ns=100_000)


def _first(count: int, times: ExecutionTimes) -> list[int]:
    return [times.next() for _ in range(count)]


def test_seed_node_and_index_determine_the_sequence() -> None:
    reference = _first(50, ExecutionTimes(UNIFORM, 1, "/node1", 0))
    assert _first(50, ExecutionTimes(UNIFORM, 1, "/node1", 0)) == reference
    for other in ((2, "/node1", 0), (1, "/node2", 0), (1, "/node1", 1)):
        assert _first(50, ExecutionTimes(UNIFORM, *other)) != reference


@pytest.mark.parametrize("execution", [UNIFORM, NORMAL])
@given(refills=st.lists(st.integers(1, 3 * BLOCK), min_size=1, max_size=3))
def test_drawing_ahead_does_not_change_the_sequence(
    execution: ExecutionTime, refills: list[int]
) -> None:
    """A long run and a short one spend the same time in the same instance."""
    one_by_one = _first(3 * BLOCK, ExecutionTimes(execution, 1, "/node1", 0))
    ahead = ExecutionTimes(execution, 1, "/node1", 0)
    taken = []
    for count in refills:
        ahead.refill(count)
        taken += _first(count // 2, ahead)
    taken += _first(3 * BLOCK - len(taken), ahead) if len(taken) < 3 * BLOCK else []
    assert taken[: 3 * BLOCK] == one_by_one


def test_values_stay_within_their_limits_and_fill_them() -> None:
    random = np.random.default_rng(3)
    uniform = draw(ExecutionTime(uniform_ns=(10, 12)), 2000, random)
    assert set(uniform.tolist()) == {10, 11, 12}, "both ends belong to it"
    normal = draw(NORMAL, 20_000, random)
    assert normal.min() >= 7_000_000
    assert normal.max() <= 14_000_000
    # Cut half a deviation below its mean, the rest of a normal distribution averages above it:
    # mean + deviation · (pdf(−0.5) − pdf(3)) / (cdf(3) − cdf(−0.5)) = 9.01 ms.
    assert normal.mean() == pytest.approx(9.01e6, rel=0.01)
    assert set(draw(CONSTANT, 10, random).tolist()) == {100_000}


def test_spending_costs_at_least_this_much_cpu_time() -> None:
    for cpu_ns in (0, 1, 200_000, 3_000_000):
        before = time.thread_time_ns()
        spend(cpu_ns, before)
        assert time.thread_time_ns() - before >= cpu_ns


def test_what_others_run_meanwhile_does_not_count() -> None:
    """Two threads share the interpreter: each needs its CPU time, so both together need twice."""
    cpu_ns = 30_000_000
    spent: list[int] = []

    def body() -> None:
        before = time.thread_time_ns()
        spend(cpu_ns, before)
        spent.append(time.thread_time_ns() - before)

    threads = [threading.Thread(target=body) for _ in range(2)]
    before = time.monotonic_ns()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    elapsed = time.monotonic_ns() - before
    assert min(spent) >= cpu_ns
    assert elapsed >= 2 * cpu_ns, "time in which the other thread ran was counted"
