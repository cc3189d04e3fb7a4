"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing at that moment. Both questions are
"the latest row before this one with the same key" (or the next after it), an asof join, whose
cost is linear in the rows once both sides are sorted by time.
"""

from itertools import zip_longest
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

__all__ = ["by_number", "first_after", "in_order", "key_numbers", "latest_before", "nearest"]


def latest_before(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    strictly: bool = False,
) -> pl.DataFrame:
    """``left`` with the columns of the latest row of ``right`` at or before it, else nulls.

    ``by`` are the key columns that both have (none: time alone decides), ``left_on`` and
    ``right_on`` their time columns. Of rows of ``right`` with the same time the last counts;
    ``strictly`` leaves out rows at the very time of the left one. The result is sorted by
    ``left_on`` and also has ``right_on``. Rows of ``right`` without a time or key match nothing.
    """
    return _asof(left, right, by, left_on, right_on, strategy="backward", strictly=strictly)


def first_after(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    strictly: bool = False,
) -> pl.DataFrame:
    """As :func:`latest_before`, but the first row of ``right`` at or after each of ``left``."""
    return _asof(left, right, by, left_on, right_on, strategy="forward", strictly=strictly)


def nearest(
    left: pl.DataFrame, right: pl.DataFrame, by: list[str], left_on: str, right_on: str
) -> pl.DataFrame:
    """As :func:`latest_before`, but the row of ``right`` nearest in time, before or after.

    For two events of one constructor whose order differs between versions of a library.
    """
    right = right.drop_nulls([*by, right_on])
    return _by_polars(left, right, by, left_on, right_on, strategy="nearest", strictly=False)


def _asof(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    strategy: Literal["backward", "forward"],
    strictly: bool,
) -> pl.DataFrame:
    # Numba takes a moment to import: only who matches events pays for it.
    from chainshaper.analysis.asof import latest_rows, next_rows

    right = right.drop_nulls([*by, right_on])
    left, right = _in_order(left, left_on), _in_order(right, right_on)
    keys = key_numbers(left, by), key_numbers(right, by)
    if len(keys[0]) != 2 or any(left.schema[key] != right.schema[key] for key in by):
        return _by_polars(left, right, by, left_on, right_on, strategy=strategy, strictly=strictly)
    timeless = left[left_on].null_count()  # sorted, they come first, and match nothing
    found = (latest_rows if strategy == "backward" else next_rows)(
        (keys[0][0][timeless:], keys[0][1][timeless:]),
        left[left_on][timeless:].to_numpy(),
        (keys[1][0], keys[1][1]),
        right[right_on].to_numpy(),
        strictly=strictly,
    )
    index = pl.repeat(None, timeless, dtype=pl.Int64, eager=True).append(pl.Series(found))
    unknown = (index < 0).fill_null(True)
    for key in by:
        unknown |= left[key].is_null()
    if unknown.any():
        index = index.set(unknown, None)
    columns = right.drop(by).select(pl.all().gather(index))
    return left.hstack(columns.rename({n: f"{n}_right" for n in columns.columns if n in left}))


def _by_polars(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    strategy: Literal["backward", "forward", "nearest"],
    strictly: bool,
) -> pl.DataFrame:
    return _in_order(left, left_on).join_asof(
        _in_order(right, right_on),
        left_on=left_on,
        right_on=right_on,
        by=by or None,
        strategy=strategy,
        allow_exact_matches=not strictly,
        coalesce=False,
        check_sortedness=False,  # both are sorted; Polars cannot check it within groups
    )


def key_numbers(frame: pl.DataFrame, by: list[str]) -> list[npt.NDArray[np.int64]]:
    """The key columns as two 64-bit numbers per row; empty where they do not fit into those."""
    whole: list[npt.NDArray[Any]] = []
    halves: list[npt.NDArray[Any]] = []
    for key in by:
        column = frame[key].to_physical().fill_null(0).to_numpy()
        if column.dtype.kind not in "iu":
            return []
        (whole if column.dtype.itemsize == 8 else halves).append(column)
    for first, second in zip_longest(halves[::2], halves[1::2]):
        whole.append(_paired(first, first if second is None else second))
    if not whole:
        whole.append(np.zeros(frame.height, np.int64))
    if len(whole) == 1:
        whole.append(whole[0])
    return [column.view(np.int64) for column in whole]


def _paired(first: npt.NDArray[Any], second: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Two columns of 32 bits as one of 64, without a third in between."""
    both = np.empty((len(first), 2), np.int32)
    both[:, 0], both[:, 1] = first, second
    return both.view(np.int64)[:, 0]


def _in_order(frame: pl.DataFrame, time: str) -> pl.DataFrame:
    # Events come sorted, and looking costs far less time and memory than sorting again.
    return frame if frame[time].is_sorted() else frame.sort(time, maintain_order=True)


def in_order(frame: pl.DataFrame, time: str, *ties: str, nulls_last: bool = False) -> pl.DataFrame:
    """``frame`` sorted by ``time`` and, where times are equal, by ``ties``; else as it was.

    Looking whether all times grow costs a fraction of what sorting by several columns does.
    """
    if bool((frame[time].diff().drop_nulls() > 0).all()):
        return frame
    return frame.sort(time, *ties, nulls_last=nulls_last, maintain_order=True)


def by_number(rows: pl.DataFrame, number: str, column: str, height: int) -> pl.Series:
    """``column`` of ``rows`` laid out by their ``number``: a series of ``height``, null elsewhere.

    What a left join on a frame's own row numbers gives, without copying the frame. Of several rows
    with one number the last counts.
    """
    values = pl.repeat(None, height, dtype=rows.schema[column], eager=True).alias(column)
    return values.scatter(rows[number], rows[column])
