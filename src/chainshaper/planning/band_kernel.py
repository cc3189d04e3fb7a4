"""The inner loop of exact band placement, compiled (:mod:`chainshaper.values.compiled`).

:mod:`chainshaper.planning.bands`, where the equations and the proof are, calls it with tables of
int64, given by their addresses. Position k of the grid is the instant ``ends[k]``, and
``counts[k]`` latencies are not longer.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False
# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.planning.bands import UNREACHABLE
from chainshaper.values.compiled.memory import compiled, store_word, table_at


@compiled()
def fill_layer(counts, ends, low, high, before, after, chosen, work, positions):
    """For every position, the cost of one band more behind it, and which is the next of them.

    A band at i may be followed by one at j in ``low[i] … high[i]``, which ascend, where
    ``before[j]``, the cost of the bands behind that, is not UNREACHABLE. ``after[i]`` becomes the
    smallest ``(counts[j] − counts[i])·ends[j] + before[j]``, ``chosen[i]`` (int32) this j; both
    stay as they are where there is none. ``work`` has 3 rows of ``positions``. Returns 0.

    Column j is a line; the least of lines is found on their lower envelope, in constant time per
    row and line as long as lines are only added. Windows that move lose lines too, so rows are
    taken in blocks whose windows share a column: left of it they only grow from the last row to
    the first, right of it from the first to the last.
    """
    counts, slope, low, high = table_at(counts), table_at(ends), table_at(low), table_at(high)
    before, after, base = table_at(before), table_at(after), table_at(work)
    envelope = table_at(work + 8 * positions)
    # The count from which a line of the envelope beats its forerunner:
    takes_over = table_at(work + 16 * positions)
    block = 0
    while block < positions:
        pivot, stop = high[block], block
        while stop < positions and low[stop] <= pivot:
            stop += 1
        for step in (-1, 1):
            left = step < 0
            row, end, column = (stop - 1, block - 1, pivot) if left else (block, stop, pivot + 1)
            front = size = 0
            while row != end:
                bound = low[row] if left else high[row]
                while (bound - column) * step >= 0:
                    if before[column] != UNREACHABLE:
                        base[column] = before[column] + counts[column] * slope[column]
                        limit = 0
                        while size > front:
                            top = envelope[size - 1]
                            # Counts come in the order −step: negated, they descend in both passes.
                            apart = step * (slope[column] - slope[top])
                            limit = (base[top] - base[column]) // apart
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
                    if cost < after[row]:
                        after[row] = cost
                        store_word(chosen + 4 * row, np.uint64(envelope[front]))
                row += step
        block = max(stop, block + 1)  # no column is in the window of the first row
    return 0
