"""The inner loops of exact band placement, compiled (:mod:`chainshaper.values.compiled`).

:mod:`chainshaper.planning.bands`, where the equations and the proof are, calls them. Everything
here is about positions on a grid: position k is the instant ``ends[k]``, and ``counts[k]``
latencies are not longer. Tables are of int64, given by their addresses.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False
# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.planning.bands import UNREACHABLE
from chainshaper.values.compiled.memory import compiled, store_word, table_at


@compiled()
def fill_costs(grid, windows, costs, successors, work, positions, layers):
    """For every position, the cost of 2, 3, … ``layers`` bands behind it, and the next of them.

    ``grid`` are two rows, counts and ends; ``windows`` two rows that ascend: a band at i may be
    followed by one at j from the first (at most ``positions``) to the second. Row 0 of ``costs`` is
    given: only the last band is behind position i. Row m becomes the smallest ``(counts[j] −
    counts[i])·ends[j]`` plus row m − 1 at j, that of ``successors`` (int32) this j; both stay as
    they are where there is none. ``work`` has 12 rows of ``positions`` + 1. Returns 0.
    """
    row = 8 * (positions + 1)
    column_of, row_of, best = table_at(work), table_at(work + 3 * row), table_at(work + 9 * row)
    least = table_at(work + 8 * row)
    for layer in range(1, layers):
        before = costs + 8 * (layer - 1) * positions
        height = _compress(grid, windows, before, work, positions)
        _least_lines(work, height, positions)
        after, chosen = table_at(before + 8 * positions), successors + 4 * layer * positions
        for r in range(height):
            after[row_of[r]] = least[r]
            store_word(chosen + 4 * row_of[r], np.uint64(column_of[best[r]]))
    return 0


@compiled()
def _compress(grid, windows, costs, work, positions):
    """Columns from which the bands behind can be placed, and rows that have such a column.

    So a row's columns are one run. ``work`` gets, per column, its position, intercept and slope,
    and per row its position, count, first and last column; returned is how many rows.
    """
    row = 8 * (positions + 1)
    counts, ends = table_at(grid), table_at(grid + 8 * positions)
    nearest, farthest = table_at(windows), table_at(windows + 8 * positions)
    cost, column_of, base = table_at(costs), table_at(work), table_at(work + row)
    slope, row_of = table_at(work + 2 * row), table_at(work + 3 * row)
    count_of, first = table_at(work + 4 * row), table_at(work + 5 * row)
    last = table_at(work + 6 * row)
    remaining = table_at(work + 7 * row)  # columns before a position
    width = height = 0
    for k in range(positions):
        remaining[k] = width
        if cost[k] != UNREACHABLE:
            column_of[width] = k
            base[width] = cost[k] + counts[k] * ends[k]
            slope[width] = ends[k]
            width += 1
    remaining[positions] = width
    for i in range(positions):
        if nearest[i] <= farthest[i]:
            low, high = remaining[nearest[i]], remaining[farthest[i] + 1] - 1
            if low <= high:
                row_of[height], count_of[height] = i, counts[i]
                first[height], last[height] = low, high
                height += 1
    return height


@compiled()
def _least_lines(work, height, positions):
    """Per row r, the least ``base[q] − count[r]·slope[q]`` for q in ``low[r] … high[r]``, and q.

    ``work`` is what :func:`_compress` has left: slopes ascend strictly; counts, low and high
    ascend, and no row's run of q is empty. Its rows 8 and 9 get the least and q.

    The least of lines is found on their lower envelope, in constant time per row and line as long
    as lines are only added. Windows that move lose lines too, so rows are taken in blocks whose
    windows share a column: left of it they only grow from the last row to the first, right of it
    from the first to the last.
    """
    row_bytes = 8 * (positions + 1)
    base, slope = table_at(work + row_bytes), table_at(work + 2 * row_bytes)
    counts, low = table_at(work + 4 * row_bytes), table_at(work + 5 * row_bytes)
    high, least = table_at(work + 6 * row_bytes), table_at(work + 8 * row_bytes)
    best, envelope = table_at(work + 9 * row_bytes), table_at(work + 10 * row_bytes)
    # The count from which a line of the envelope beats its forerunner:
    takes_over = table_at(work + 11 * row_bytes)
    for row in range(height):
        least[row] = UNREACHABLE
    block = 0
    while block < height:
        pivot, stop = high[block], block
        while stop < height and low[stop] <= pivot:
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
