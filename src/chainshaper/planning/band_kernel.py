"""The inner loops of exact band placement, compiled by Numba.

Importing this module needs Numba; :mod:`chainshaper.planning.bands`, where the equations and the
proof are, does so when it first places bands. Everything here is about positions on a grid:
position k is the instant ``ends[k]``, and ``counts[k]`` latencies are not longer.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import UNREACHABLE
from chainshaper.planning.extras import extra_library

__all__ = ["costs_behind"]

_Ints = NDArray[np.int64]


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    numba = extra_library("numba", "exact placement of latency bands")
    try:
        return numba.njit(cache=True)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder to keep the machine code in: compile in every process
        return numba.njit(function)  # type: ignore[no-any-return]


def _compress(grid: _Ints, windows: _Ints, costs: _Ints, work: _Ints) -> tuple[int, int]:
    """Columns from which the bands behind can be placed, and rows that have such a column.

    Only these are left, so that a row's columns are one run of those that remain and each of
    them counts. ``work`` holds, per remaining column, its position, intercept and slope, and
    per remaining row its position, count, first and last column; the result says how many.
    """
    counts, ends = grid[0], grid[1]
    nearest, farthest = windows[0], windows[1]
    width = 0
    for k in range(costs.size):
        work[7, k] = width  # remaining columns before position k
        if costs[k] != UNREACHABLE:
            work[0, width] = k
            work[1, width] = costs[k] + counts[k] * ends[k]
            work[2, width] = ends[k]
            width += 1
    work[7, costs.size] = width
    height = 0
    for i in range(costs.size):
        if nearest[i] <= farthest[i]:
            low, high = work[7, nearest[i]], work[7, farthest[i] + 1] - 1
            if low <= high:
                work[3, height], work[4, height] = i, counts[i]
                work[5, height], work[6, height] = low, high
                height += 1
    return width, height


def _least_lines(lines: _Ints, rows: _Ints, least: _Ints, best: _Ints) -> None:
    """Per row r, the least ``base[q] − count[r]·slope[q]`` for q in ``low[r] … high[r]``, and q.

    ``lines`` are base and slope, which ascends strictly; ``rows`` are count, low and high, which
    ascend, and no row's run of q is empty.

    The least of lines is found on their lower envelope, in constant time per row and line as
    long as lines are only added. Windows that move lose lines too, so rows are taken in blocks
    whose windows share a column, the pivot: left of it windows only grow from the last row to
    the first, right of it they only grow from the first to the last.
    """
    base, slope = lines[0], lines[1]
    counts, low, high = rows[0], rows[1], rows[2]
    least[:] = UNREACHABLE
    envelope = np.empty(base.size, np.int64)
    takes_over = np.empty(base.size, np.int64)  # the count from which a line beats its forerunner
    block = 0
    while block < counts.size:
        pivot, stop = high[block], block
        while stop < counts.size and low[stop] <= pivot:
            stop += 1
        for step in (-1, 1):
            left = step < 0
            row, end, column = (stop - 1, block - 1, pivot) if left else (block, stop, pivot + 1)
            front = size = 0
            while row != end:
                bound = low[row] if left else high[row]
                while (bound - column) * step >= 0:
                    limit = 0
                    while size > front:
                        top = envelope[size - 1]
                        # Counts come in the order −step: negated, they descend in both passes.
                        limit = (base[top] - base[column]) // (step * (slope[column] - slope[top]))
                        if size - 1 == front or limit < takes_over[size - 1]:
                            break
                        size -= 1
                    envelope[size] = column
                    takes_over[size] = limit
                    size += 1
                    column += step
                while front + 1 < size and -step * counts[row] <= takes_over[front + 1]:
                    front += 1
                if front < size:
                    cost = base[envelope[front]] - counts[row] * slope[envelope[front]]
                    if cost < least[row]:
                        least[row] = cost
                        best[row] = envelope[front]
                row += step
        block = stop


_compress_fast = _compiled(_compress)
_least_lines_fast = _compiled(_least_lines)


def _costs_behind(
    grid: _Ints, windows: _Ints, last: _Ints, layers: int
) -> tuple[_Ints, NDArray[np.int32]]:
    positions = last.size
    costs = np.full((layers, positions), UNREACHABLE)
    successors = np.full((layers, positions), -1, np.int32)
    costs[0] = last
    work = np.empty((8, positions + 1), np.int64)
    least = np.empty(positions, np.int64)
    best = np.zeros(positions, np.int64)
    for layer in range(1, layers):
        width, height = _compress_fast(grid, windows, costs[layer - 1], work)
        _least_lines_fast(work[1:3, :width], work[4:7, :height], least[:height], best[:height])
        for r in range(height):
            costs[layer, work[3, r]] = least[r]
            successors[layer, work[3, r]] = work[0, best[r]]
    return costs, successors


_costs_behind_fast = _compiled(_costs_behind)


def costs_behind(
    grid: _Ints, windows: _Ints, last: _Ints, layers: int
) -> tuple[_Ints, NDArray[np.int32]]:
    """For every position, the cost of 1, 2, … ``layers`` bands behind it, and the next of them.

    ``grid`` are two rows, counts and ends. ``windows`` are two rows that ascend: a band at i may
    be followed by one at j from ``windows[0, i]`` (at most the number of positions) to
    ``windows[1, i]``. ``last[i]`` is the cost when only the last band is behind position i,
    ``UNREACHABLE`` where it cannot be. Row m of the result holds the smallest
    ``(counts[j] − counts[i])·ends[j]`` plus row m − 1 at j, and that j (−1: none).
    """
    result: tuple[_Ints, NDArray[np.int32]] = _costs_behind_fast(grid, windows, last, layers)
    return result
