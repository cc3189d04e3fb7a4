"""The compiled asof join: for every row the latest row of another table with the same key.

Events come sorted by time, so one walk over both tables that remembers the latest row of every key
is enough. Keys are few (threads, handles) and times many: a lookup stays in the processor's
nearest cache, and a row costs some ten nanoseconds, a fraction of grouping both tables by key.

Columns are read where they lie (:mod:`chainshaper.values.compiled.memory`): what a step costs is
mostly the fresh memory that it touches. A key is a table of three rows (address, bytes per value),
of which those that are not used have 0 bytes. The table of keys has ``slots`` rows, a power of two,
of (three numbers, whether it is taken, the latest row), and one more whose first number counts
them.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.values.compiled.memory import compiled, get, load_half, load_word, put, store_word

__all__ = ["KEY_ROW", "place_of", "walk"]

KEY_ROW = 8 * 5
LATEST = 4
NONE = np.uint64(0xFFFFFFFF)
FULL = -1


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

    That is the last one at or before it (``step`` 1), or the first one at or after it (``step``
    −1: the walk begins at the end). ``at`` and ``times`` (int64, ns) ascend, ``left`` and ``right``
    are their keys. Returns how many rows have none, which NONE stands for, or FULL where ``slots``
    are too few for all keys.
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
            store_word(found + 4 * row, NONE)
            missing += 1
        else:
            store_word(found + 4 * row, np.uint64(get(place, LATEST)))
        row += step
    return missing
