"""The compiled walks of :mod:`~chainshaper.analysis.matching`, over addresses and counts.

Columns are read where they lie. A key is a table of three rows (address, bytes per value); unused
ones have 0 bytes. The table of keys has ``slots`` rows, a power of two, of (three numbers, whether
it is taken, the latest row), and one more whose first number counts them. This module is imported
to compile it: it imports Numba, which takes half a second.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.analysis.matching import FULL, NONE
from chainshaper.values.compiled.memory import compiled, get, load_half, load_word, put, store_word

KEY_ROW = 8 * 5
LATEST = 4

STATE_ROW = 8 * 4
# What is known per key: 1 + the open start, or 0; starts minus ends; the moment of its latest
# event, and whether it was open before that.
OPEN, DEPTH, MOMENT, WAS_OPEN = 0, 1, 2, 3


@compiled(inline=True)
def number_at(column, row):
    """A key column's value in a row, whatever its sign."""
    address, width = get(column, 0), get(column, 1)
    if width == 8:
        return np.int64(load_word(address + 8 * row))
    if width == 4:
        return np.int64(load_half(address + 4 * row))
    return np.int64(0)


@compiled()
def place_of(table, slots, columns, row, add):
    """The address of a row's key in a table; with ``add`` it gets one, 0 once that is half full.

    Without ``add``, 0 for a key that is not there.
    """
    first, second = number_at(columns, row), number_at(columns + 16, row)
    third = number_at(columns + 32, row)
    mixed = (np.uint64(first) * np.uint64(0x9E3779B97F4A7C15)) ^ (
        np.uint64(second) * np.uint64(0xC2B2AE3D27D4EB4F)
    )
    mixed = (mixed ^ (mixed >> np.uint64(29))) + np.uint64(third) * np.uint64(0x165667B19E3779F9)
    at = np.int64((mixed >> np.uint64(17)) & np.uint64(slots - 1))
    place = table + at * KEY_ROW
    while get(place, 3) != 0:
        if get(place, 0) == first and get(place, 1) == second and get(place, 2) == third:
            return place
        at = (at + 1) & (slots - 1)
        place = table + at * KEY_ROW
    count = table + slots * KEY_ROW
    if add == 0 or 2 * get(count, 0) >= slots:
        return np.int64(0)
    put(count, 0, get(count, 0) + 1)
    put(place, 0, first)
    put(place, 1, second)
    put(place, 2, third)
    put(place, 3, np.int64(1))
    return place


@compiled()
def walk(left, at, count, right, times, others, step, strictly, found, table, slots):
    """Fill ``found`` (uint32) with the row of ``right`` that matches each row of ``left``.

    ``step`` −1 walks from the end. ``at`` and ``times`` (int64, ns) ascend, ``left`` and ``right``
    are their keys. Returns how many rows have none (NONE), or FULL: ``slots`` are too few.
    """
    row, other = (0, 0) if step > 0 else (count - 1, others - 1)
    missing = 0
    for _ in range(count):
        now = get(at, row)
        while 0 <= other < others and (get(times, other) - now) * step + strictly <= 0:
            place = place_of(table, slots, right, other, 1)
            if place == 0:
                return FULL
            put(place, LATEST, other)
            other += step
        place = place_of(table, slots, left, row, 0)
        if place == 0:
            store_word(found + 4 * row, np.uint64(NONE))
            missing += 1
        else:
            store_word(found + 4 * row, np.uint64(get(place, LATEST)))
        row += step
    return missing


@compiled()
def walk_pairs(starts, began, start_count, ends, ended, end_count, found, table, states, slots):
    """For every start write the row of its end to ``found`` (uint32; other rows are left alone).

    ``starts`` and ``ends`` are keys, ``began`` and ``ended`` their ascending times; ``states`` has
    four zeros for each of the ``slots``. Returns 0, or FULL: they are too few.
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
        for part in range(3):
            columns, first, last = (starts, i, next_i) if part == 1 else (ends, j, next_j)
            for row in range(first, last):
                key = place_of(table, slots, columns, row, np.int64(1))
                if key == 0:
                    return np.int64(FULL)
                place = states + (key - table) // KEY_ROW * STATE_ROW
                if get(place, MOMENT) != moment:
                    put(place, MOMENT, moment)
                    put(place, WAS_OPEN, np.int64(1) if get(place, DEPTH) > 0 else np.int64(0))
                if part == 1:
                    put(place, OPEN, row + 1)
                    put(place, DEPTH, get(place, DEPTH) + 1)
                elif (get(place, WAS_OPEN) == 1) == (part == 0):
                    if get(place, OPEN) > 0:
                        store_word(found + 4 * (get(place, OPEN) - 1), np.uint64(row))
                    put(place, OPEN, np.int64(0))
                    if get(place, DEPTH) > 0:  # else it is of an instance that began unrecorded
                        put(place, DEPTH, get(place, DEPTH) - 1)
        i, j = next_i, next_j
    return np.int64(0)
