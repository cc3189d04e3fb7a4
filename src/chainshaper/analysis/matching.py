"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing then: "the latest row before this one
with the same key" (or the next after it), an asof join. Events come sorted by time, so one compiled
walk over both tables that remembers the latest row of each key is enough: some ten ns a row.

Columns are read where they lie. A key is a table of three rows (address, bytes per value); unused
ones have 0 bytes. The table of keys has ``slots`` rows, a power of two, of (three numbers, whether
it is taken, the latest row), and one more whose first number counts them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.values.compiled import kernel
from chainshaper.values.compiled.memory import compiled, get, load_half, load_word, put, store_word

_walk = kernel("chainshaper.analysis.matching", "walk")
_walk_pairs = kernel("chainshaper.analysis.matching", "walk_pairs")


def _asof(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    step: Literal[1, -1],
    strictly: bool = False,
) -> pl.DataFrame:
    """``left`` with the columns of the matching row of ``right``, else nulls.

    That is the latest one at or before it (``latest_before``), or the first one at or after it
    (``first_after``). ``by`` are up to three key columns of integers that both have (none: time
    alone decides), ``left_on`` and ``right_on`` their time columns. Of rows of ``right`` with the
    same time the last counts, or the first; ``strictly`` leaves out rows at the very time of the
    left one. The result is sorted by ``left_on`` and also has ``right_on``. Rows without a time or
    key match nothing.
    """
    right = _sorted(right.drop_nulls([*by, right_on]), right_on)
    left = _sorted(left, left_on)
    timeless = left[left_on].null_count()  # sorted, they come first
    known = left.slice(timeless)
    (keys, _own), (others, _its) = _keys(known, by), _keys(right, by)
    at, times = _as_array(known[left_on]), _as_array(right[right_on])
    found = np.empty(len(at), np.uint32)

    def walk_over(slots: int, table: npt.NDArray[np.int64]) -> int:
        return _walk(
            keys.ctypes.data, at.ctypes.data, len(at), others.ctypes.data, times.ctypes.data,
            len(times), step, strictly, found.ctypes.data, table.ctypes.data, slots,
        )  # fmt: skip

    index = _rows(found) if _with_room(walk_over) else pl.Series(found)
    for key in by:
        if known[key].null_count():
            index = index.set(known[key].is_null(), None)
    if timeless:
        index = pl.repeat(None, timeless, dtype=pl.UInt32, eager=True).append(index)
    columns = right.drop(by).select(pl.all().gather(index))
    return left.hstack(columns.rename({n: f"{n}_right" for n in columns.columns if n in left}))


latest_before = partial(_asof, step=1)
first_after = partial(_asof, step=-1)


def nearest(
    left: pl.DataFrame, right: pl.DataFrame, by: list[str], left_on: str, right_on: str
) -> pl.DataFrame:
    """As :func:`latest_before`, but the row of ``right`` nearest in time, before or after.

    For two events of one constructor whose order differs between versions of a library.
    """
    return _sorted(left, left_on).join_asof(
        _sorted(right.drop_nulls([*by, right_on]), right_on),
        left_on=left_on,
        right_on=right_on,
        by=by,
        strategy="nearest",
        coalesce=False,
        check_sortedness=False,  # both are sorted; Polars cannot check it within groups
    )


def ends_of_starts(starts: pl.DataFrame, ends: pl.DataFrame) -> pl.Series:
    """For every row of `callback_start` the row of its `callback_end`, null for none.

    Both are sorted by time. An instance ends with the next event of the same callback on the same
    thread, if that is an end. It may begin in the nanosecond in which the one before ended (end
    first), or last no time at all (start first): the former when one was open before.
    """
    (keys, _own), (others, _its) = (_keys(t, ["pid", "tid", "callback"]) for t in (starts, ends))
    began, ended = _as_array(starts["time"]), _as_array(ends["time"])
    found = np.empty(len(began), np.uint32)

    def walk_over(slots: int, table: npt.NDArray[np.int64]) -> int:
        found.fill(NONE)
        states = np.zeros((slots, 4), np.int64)
        return _walk_pairs(
            keys.ctypes.data, began.ctypes.data, len(began), others.ctypes.data, ended.ctypes.data,
            len(ended), found.ctypes.data, table.ctypes.data, states.ctypes.data, slots,
        )  # fmt: skip

    _with_room(walk_over)
    return _rows(found)


def _with_room(walk_over: Callable[[int, npt.NDArray[np.int64]], int]) -> int:
    """What a compiled walk returns, given an empty table that has room for all keys."""
    slots, result = 1024, FULL
    while result == FULL:
        result = walk_over(slots, np.zeros((slots + 1, 5), np.int64))
        slots *= 8
    return result


def _rows(found: npt.NDArray[np.uint32]) -> pl.Series:
    index = pl.Series(found)
    return index.set(index == NONE, None) if (found == NONE).any() else index


def _keys(
    frame: pl.DataFrame, by: list[str]
) -> tuple[npt.NDArray[np.int64], list[npt.NDArray[Any]]]:
    """Key columns as compiled walks read them, and what has to stay alive meanwhile."""
    columns = [_as_array(frame[key].to_physical()) for key in by]
    columns = [values if values.itemsize >= 4 else values.astype(np.uint32) for values in columns]
    table = np.zeros((3, 2), np.int64)
    for row, values in zip(table, columns, strict=False):
        row[:] = values.ctypes.data, values.itemsize
    return table, columns


def _as_array(column: pl.Series) -> npt.NDArray[Any]:
    """A column of integers as an array, nulls as 0; a copy only where there are any."""
    known = column.fill_null(0) if column.null_count() else column
    values: npt.NDArray[Any] = known.rechunk().to_numpy()
    return values


def _sorted(frame: pl.DataFrame, time: str) -> pl.DataFrame:
    # Events come sorted, and looking costs far less time and memory than sorting again.
    return frame if frame[time].is_sorted() else frame.sort(time, maintain_order=True)


def in_order(frame: pl.DataFrame, time: str, *ties: str, nulls_last: bool = False) -> pl.DataFrame:
    """``frame`` sorted by ``time`` and ``ties``, if not all times grow: looking is cheap."""
    if grows(frame[time]):
        return frame
    return frame.sort(time, *ties, nulls_last=nulls_last, maintain_order=True)


def grows(times: pl.Series) -> bool:
    """Whether every time is later than the one before it; nulls say nothing."""
    return bool((times.slice(1) > times.head(max(len(times) - 1, 0))).all())


def by_number(rows: pl.DataFrame, number: str, column: str, height: int) -> pl.Series:
    """``column`` of ``rows`` laid out by their ``number``: a series of ``height``, null elsewhere.

    A left join on a frame's own row numbers. Of several rows with one number the last counts.
    """
    values = pl.repeat(None, height, dtype=rows.schema[column], eager=True).alias(column)
    return values.scatter(rows[number], rows[column])


# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which are slow to pass.
# ruff: noqa: PLR0917

KEY_ROW = 8 * 5
LATEST = 4
NONE = 0xFFFFFFFF
FULL = -1

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
                    put(place, DEPTH, get(place, DEPTH) - 1)
        i, j = next_i, next_j
    return np.int64(0)
