"""The inner loop of exact band placement, compiled by Numba when it is first used.

Everything here is about positions on a grid: position k is the instant ``ends[k]``, and
``counts[k]`` latencies are not longer. The equations and the proof are in
:mod:`chainshaper.planning.bands`.
"""

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.extras import extra_library

__all__ = ["UNREACHABLE", "cheapest_successors"]

UNREACHABLE = np.iinfo(np.int64).max

_Ints = NDArray[np.int64]


def cheapest_successors(
    counts: _Ints, ends: _Ints, nearest: _Ints, farthest: _Ints, costs: _Ints
) -> tuple[_Ints, _Ints]:
    """For every position, the best next band and the cost of all bands behind the position.

    Row i may be followed by the columns j from ``nearest[i]`` to ``farthest[i]``; both bounds
    ascend with i. ``costs[j]`` is the cost of the bands behind j, :data:`UNREACHABLE` where
    there is no way to place them. The result holds, per row, the smallest
    ``costs[j] + (counts[j] − counts[i])·ends[j]`` and the j it comes from (−1: none).
    """
    return _compiled()(counts, ends, nearest, farthest, costs)


@functools.cache
def _compiled() -> Callable[..., tuple[_Ints, _Ints]]:
    numba = extra_library("numba", "exact placement of latency bands")
    try:
        compiled = numba.njit(cache=True)(_cheapest_successors)
    except RuntimeError:  # no folder to keep the machine code in: compile in every process
        compiled = numba.njit(_cheapest_successors)
    return compiled  # type: ignore[no-any-return]


def _cheapest_successors(  # noqa: PLR0915 - one kernel: calls would cost what it saves
    counts: _Ints, ends: _Ints, nearest: _Ints, farthest: _Ints, costs: _Ints
) -> tuple[_Ints, _Ints]:
    unreachable = np.iinfo(np.int64).max
    size = counts.size
    best_costs = np.full(size, unreachable)
    successors = np.full(size, -1)

    # Columns that cannot be reached are left out, so that a row's columns are one run of
    # `columns` and each of them counts. `rank[k]`: how many columns lie before position k.
    columns = np.empty(size, np.int64)
    base = np.empty(size, np.int64)
    slope = np.empty(size, np.int64)
    rank = np.empty(size + 1, np.int64)
    width = 0
    for k in range(size):
        rank[k] = width
        if costs[k] != unreachable:
            columns[width] = k
            base[width] = costs[k] + counts[k] * ends[k]
            slope[width] = ends[k]
            width += 1
    rank[size] = width

    rows = np.empty(size, np.int64)
    low = np.empty(size, np.int64)
    high = np.empty(size, np.int64)
    height = 0
    for i in range(size):
        if nearest[i] < size and nearest[i] <= farthest[i]:
            low[height] = rank[nearest[i]]
            high[height] = rank[farthest[i] + 1] - 1
            if low[height] <= high[height]:
                rows[height] = i
                height += 1

    # Divide and conquer: the best column of the middle row bounds those of the rows on either
    # side. Each entry of the stack is (first row, last row, first column, last column).
    stack = np.empty((128, 4), np.int64)
    depth = 0
    if height:
        stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0, height - 1, 0, width - 1
        depth = 1
    while depth:
        depth -= 1
        first, last = stack[depth, 0], stack[depth, 1]
        left, right = stack[depth, 2], stack[depth, 3]
        middle = (first + last) // 2
        count = counts[rows[middle]]
        start = max(left, low[middle])
        best = start
        least = base[start] - count * slope[start]
        for column in range(start + 1, min(right, high[middle]) + 1):
            cost = base[column] - count * slope[column]
            if cost < least:
                least = cost
                best = column
        best_costs[rows[middle]] = least
        successors[rows[middle]] = columns[best]
        if first < middle:
            stack[depth, 0], stack[depth, 1] = first, middle - 1
            stack[depth, 2], stack[depth, 3] = left, best
            depth += 1
        if middle < last:
            stack[depth, 0], stack[depth, 1] = middle + 1, last
            stack[depth, 2], stack[depth, 3] = best, right
            depth += 1
    return best_costs, successors
