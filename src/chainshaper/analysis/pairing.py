"""Which `callback_end` belongs to which `callback_start`: one walk over both, in order of time.

An instance ends with the next event of the same callback on the same thread, if that is an end.
Sorting millions of events by thread and callback to see that would be the most expensive step of
the whole analysis. They come sorted by time, so one walk that remembers the open instance of each
(process, thread, callback) is enough, and takes some ten nanoseconds per event.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

import numba
import numpy as np
import numpy.typing as npt

from chainshaper.analysis.asof import key_table, place_of

__all__ = ["ends_of_starts"]

Int64s = npt.NDArray[np.int64]


def ends_of_starts(
    starts: tuple[Int64s, Int64s, Int64s], ends: tuple[Int64s, Int64s, Int64s]
) -> Int64s:
    """For every start the row of its end, −1 for none.

    Both are given as (thread, callback, time), sorted by time; a thread number stands for a
    (process, thread). Clocks tick coarsely and simulators exactly, so an instance may begin in
    the very nanosecond in which the one before ended (end first), or last no time at all (start
    first): it is the former when one was open before that nanosecond.
    """
    slots = 1024
    result = np.full(len(starts[2]), -1, dtype=np.int64)
    while not _walk(starts, ends, result, slots):
        slots *= 8
        result[:] = -1
    return result


@numba.njit(cache=True, nogil=True)
def _walk(starts, ends, result, slots):  # noqa: PLR0912 - one compiled loop
    """Fill ``result``; false where ``slots`` are too few for all keys."""
    keys = key_table(slots)
    latest = np.full(slots, -1, dtype=np.int64)  # the open start; −1: the last event was an end
    opened = np.zeros(slots, dtype=np.int64)  # starts minus ends
    seen = np.full(slots, -1, dtype=np.int64)  # the moment for which `was_open` holds
    was_open = np.zeros(slots, dtype=np.bool_)
    start_count, end_count = len(starts[2]), len(ends[2])
    i = j = moment = 0
    while i < start_count or j < end_count:
        now = starts[2][i] if i < start_count else ends[2][j]
        if j < end_count and ends[2][j] < now:
            now = ends[2][j]
        next_i, next_j = i, j
        while next_i < start_count and starts[2][next_i] == now:
            next_i += 1
        while next_j < end_count and ends[2][next_j] == now:
            next_j += 1
        moment += 1
        # First the ends of what was open before this moment, then starts, then other ends.
        for step in range(3):
            if step == 1:
                for row in range(i, next_i):
                    at = place_of(keys, starts[0][row], starts[1][row], True)
                    if at < 0:
                        return False
                    latest[at] = row
                    opened[at] += 1
                continue
            for row in range(j, next_j):
                at = place_of(keys, ends[0][row], ends[1][row], True)
                if at < 0:
                    return False
                if seen[at] != moment:
                    seen[at], was_open[at] = moment, opened[at] > 0
                if was_open[at] == (step == 0):
                    if latest[at] >= 0:
                        result[latest[at]] = row
                    latest[at] = -1
                    opened[at] -= 1
        i, j = next_i, next_j
    return True
