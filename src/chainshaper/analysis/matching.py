"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It has an address, which means the object that was last
created there; or it belongs to what its thread was doing then. Both are "the latest row before this
one with the same key" (or the next after it), an asof join. Events come sorted by time, so a single
walk over both tables that remembers the latest row of each key is enough (core/matching): some ten
ns a row.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import _core


def _asof(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    rows_of: Callable[..., npt.NDArray[np.uint32]],
    strictly: bool = False,
) -> pl.DataFrame:
    """Add to each row of ``left`` the columns of the matching row of ``right``, else nulls.

    `latest_before` matches the latest row at or before the left one, `first_after` the first row at
    or after it. The result is sorted by ``left_on`` and also has the column ``right_on``.

    * ``by``: up to three key columns of integers that both frames have ([]: time alone decides).
    * ``left_on``, ``right_on``: their time columns. Rows without a time or a key match nothing.
    * ``strictly``: rows at the very time of the left one do not match.

    Of rows of ``right`` with one time, `latest_before` takes the last, `first_after` the first.
    """
    right = _sorted(right.drop_nulls([*by, right_on]), right_on)
    left = _sorted(left, left_on)
    timeless = left[left_on].null_count()  # sorted, they come first
    known = left.slice(timeless)
    index = _rows(
        rows_of(
            left_keys=_keys(known, by),
            left_times_ns=_as_array(known[left_on]),
            right_keys=_keys(right, by),
            right_times_ns=_as_array(right[right_on]),
            strictly=strictly,
        )
    )
    for key in by:
        if known[key].null_count():
            index = index.set(known[key].is_null(), None)
    if timeless:
        index = pl.repeat(None, timeless, dtype=pl.UInt32, eager=True).append(index)
    columns = right.drop(by).select(pl.all().gather(index))
    return left.hstack(columns.rename({n: f"{n}_right" for n in columns.columns if n in left}))


latest_before = partial(_asof, rows_of=_core.latest_before)
first_after = partial(_asof, rows_of=_core.first_after)


def nearest(
    left: pl.DataFrame, right: pl.DataFrame, by: list[str], left_on: str, right_on: str
) -> pl.DataFrame:
    """Do the same as `latest_before` with the row of ``right`` nearest in time, before or after.

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
    """Find for each row of `callback_start` the row of its `callback_end`; null: there is none.

    Both are sorted by time. An instance ends with the next event of the same callback on the same
    thread, if that is an end. An end in the nanosecond of the start is that of the instance before,
    if one was open; else the instance itself took no time at all.
    """
    key = ["pid", "tid", "callback"]
    return _rows(
        _core.ends_of_starts(
            start_keys=_keys(starts, key),
            start_times_ns=_as_array(starts["time"]),
            end_keys=_keys(ends, key),
            end_times_ns=_as_array(ends["time"]),
        )
    )


def _rows(numbers: npt.NDArray[np.uint32]) -> pl.Series:
    """Make a series of numbers of rows, null for none."""
    index = pl.Series(numbers)
    none = index == _core.NO_ROW
    return index.set(none, None) if none.any() else index


def _keys(frame: pl.DataFrame, by: list[str]) -> list[npt.NDArray[Any]]:
    """Key columns as integers of 32 or 64 bits."""
    columns = [_as_array(frame[key].to_physical()) for key in by]
    return [values if values.itemsize >= 4 else values.astype(np.uint32) for values in columns]


def _as_array(column: pl.Series) -> npt.NDArray[Any]:
    """Return a column of integers as an array, nulls as 0; a copy only where there are any."""
    known = column.fill_null(0) if column.null_count() else column
    values: npt.NDArray[Any] = known.rechunk().to_numpy()
    return values


def _sorted(frame: pl.DataFrame, time: str) -> pl.DataFrame:
    """Sort a frame by time, unless it is sorted."""
    # Events come sorted, and a test costs far less time and memory than sorting again.
    return frame if frame[time].is_sorted() else frame.sort(time, maintain_order=True)


def in_order(frame: pl.DataFrame, time: str, *ties: str, nulls_last: bool = False) -> pl.DataFrame:
    """Sort a frame by ``time`` and ``ties``, unless its times grow."""
    if grows(frame[time]):
        return frame
    return frame.sort(time, *ties, nulls_last=nulls_last, maintain_order=True)


def grows(times: pl.Series) -> bool:
    """Return whether each time is later than the one before it; nulls are ignored."""
    return bool((times.slice(1) > times.head(max(len(times) - 1, 0))).all())


def by_number(rows: pl.DataFrame, number: str, column: str, height: int) -> pl.Series:
    """Put the values of ``column`` at the places that ``number`` gives in a series of ``height``.

    All other places are null. It is a left join on a frame's own row numbers. Of several rows with
    one number the last counts.
    """
    values = pl.repeat(None, height, dtype=rows.schema[column], eager=True).alias(column)
    return values.scatter(rows[number], rows[column])
