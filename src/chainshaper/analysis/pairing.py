"""Which `callback_end` belongs to which `callback_start`: one walk over both, in order of time.

An instance ends with the next event of the same callback on the same thread, if that is an end.
Sorting millions of events by thread and callback to see that would be the most expensive step of
the whole analysis. They come sorted by time, so one walk that remembers the open instance of each
(process, thread, callback) is enough, and takes some ten nanoseconds per event.

Clocks tick coarsely and simulators exactly, so an instance may begin in the very nanosecond in
which the one before ended (end first), or last no time at all (start first): it is the former when
one was open before that nanosecond.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.analysis.asof import KEY_ROW, place_of
from chainshaper.values.compiled.memory import compiled, get, put, store_word

__all__ = ["walk_pairs"]

# What is kept per key: 1 + the open start, or 0; starts minus ends; the moment of its latest end,
# and whether it was open before that.
OPEN, DEPTH, MOMENT, WAS_OPEN = 0, 1, 2, 3
STATE_ROW = 8 * 4
FULL = -1


@compiled(inline=True)
def end_at(place, moment, early, row, found):
    """Note an end: the ``early`` ones close what was open before this moment, others the rest."""
    if get(place, MOMENT) != moment:
        put(place, MOMENT, moment)
        put(place, WAS_OPEN, np.int64(1) if get(place, DEPTH) > 0 else np.int64(0))
    if get(place, WAS_OPEN) == early:
        if get(place, OPEN) > 0:
            store_word(found + 4 * (get(place, OPEN) - 1), np.uint64(row))
        put(place, OPEN, np.int64(0))
        put(place, DEPTH, get(place, DEPTH) - 1)


@compiled()
def walk_ends(ends, first, last, moment, early, found, table, states, slots):
    """Note the ends [first, last) of a moment; 0, or FULL."""
    for row in range(first, last):
        key = place_of(table, slots, ends, row, np.int64(1))
        if key == 0:
            return np.int64(FULL)
        end_at(states + (key - table) // KEY_ROW * STATE_ROW, moment, early, row, found)
    return np.int64(0)


@compiled()
def walk_pairs(starts, began, start_count, ends, ended, end_count, found, table, states, slots):
    """For every start write the row of its end to ``found`` (uint32; other rows are left alone).

    ``starts`` and ``ends`` are keys as in :mod:`~chainshaper.analysis.asof`, ``began`` and
    ``ended`` their ascending times; ``states`` has four zeros for each of the ``slots``. Returns
    0, or FULL where those are too few for all keys.
    """
    i = j = moment = np.int64(0)
    while i < start_count or j < end_count:
        now = get(began, i) if i < start_count else get(ended, j)
        if j < end_count and get(ended, j) < now:
            now = get(ended, j)
        next_i, next_j = i, j
        while next_i < start_count and get(began, next_i) == now:
            next_i += 1
        while next_j < end_count and get(ended, next_j) == now:
            next_j += 1
        moment += 1
        # First the ends of what was open before this moment, then starts, then other ends.
        status = walk_ends(ends, j, next_j, moment, np.int64(1), found, table, states, slots)
        if status < 0:
            return status
        for row in range(i, next_i):
            key = place_of(table, slots, starts, row, np.int64(1))
            if key == 0:
                return np.int64(FULL)
            place = states + (key - table) // KEY_ROW * STATE_ROW
            put(place, OPEN, row + 1)
            put(place, DEPTH, get(place, DEPTH) + 1)
        status = walk_ends(ends, j, next_j, moment, np.int64(0), found, table, states, slots)
        if status < 0:
            return status
        i, j = next_i, next_j
    return np.int64(0)
