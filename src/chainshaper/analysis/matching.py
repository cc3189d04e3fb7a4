"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing then: "the latest row before this one
with the same key" (or the next after it), an asof join. Events come sorted by time, so one compiled
walk over both tables that remembers the latest row of each key is enough: some ten ns a row.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.values.compiled import kernel

_walk = kernel("chainshaper.analysis.matching_kernels", "walk")
_walk_pairs = kernel("chainshaper.analysis.matching_kernels", "walk_pairs")
NONE, FULL = 0xFFFFFFFF, -1  # no row matches; a table of keys is too small


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
