"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing at that moment. Both questions are
"the latest row before this one with the same key" (or the next after it), an asof join, whose
cost is linear in the rows once both sides are sorted by time.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.values.compiled import kernel

__all__ = [
    "Keys",
    "by_number",
    "first_after",
    "grows",
    "in_order",
    "key_table",
    "latest_before",
    "nearest",
]

_walk = kernel("chainshaper.analysis.asof", "walk")
_FIRST_SLOTS = 1024
_MOST_KEYS = 3
_NONE = 0xFFFFFFFF


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
    (``first_after``). ``by`` are the key columns that both have (none: time alone decides),
    ``left_on`` and ``right_on`` their time columns. Of rows of ``right`` with the same time the
    last counts, or the first; ``strictly`` leaves out rows at the very time of the left one. The
    result is sorted by ``left_on`` and also has ``right_on``. Rows of ``right`` without a time or
    key match nothing.
    """
    right = right.drop_nulls([*by, right_on])
    left, right = _in_order(left, left_on), _in_order(right, right_on)
    keys = Keys.of(left, by), Keys.of(right, by)
    if keys[0] is None or keys[1] is None or any(left.schema[k] != right.schema[k] for k in by):
        strategy: Literal["backward", "forward"] = "backward" if step > 0 else "forward"
        return _by_polars(left, right, by, left_on, right_on, strategy=strategy, strictly=strictly)
    index = _rows((left[left_on], keys[0]), (right[right_on], keys[1]), step, strictly=strictly)
    for key in by:
        if left[key].null_count():
            index = index.set(left[key].is_null(), None)
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
    right = right.drop_nulls([*by, right_on])
    return _by_polars(left, right, by, left_on, right_on, strategy="nearest", strictly=False)


def _rows(
    left: tuple[pl.Series, "Keys"],
    right: tuple[pl.Series, "Keys"],
    step: int,
    *,
    strictly: bool,
) -> pl.Series:
    """For every row of ``left`` that of ``right`` which matches it, or null; both in order."""
    (at, left_keys), (times, right_keys) = left, right
    timeless = at.null_count()  # sorted, they come first, and match nothing
    own, its, keys = _as_array(at[timeless:]), _as_array(times), left_keys.beyond(timeless)
    found = np.empty(len(own), np.uint32)
    slots, missing = _FIRST_SLOTS, -1
    while missing < 0:
        table = key_table(slots)
        missing = _walk(
            keys.ctypes.data, own.ctypes.data, len(own), right_keys.table.ctypes.data,
            its.ctypes.data, len(its), step, strictly, found.ctypes.data, table.ctypes.data, slots,
        )  # fmt: skip
        slots *= 8
    index = pl.Series(found)
    if missing:
        index = index.set(index == _NONE, None)
    if timeless:
        index = pl.repeat(None, timeless, dtype=pl.UInt32, eager=True).append(index)
    return index


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


def key_table(slots: int) -> npt.NDArray[np.int64]:
    """An empty table of keys, as compiled walks want it (:mod:`~chainshaper.analysis.asof`)."""
    return np.zeros((slots + 1, 5), np.int64)


@dataclass(frozen=True)
class Keys:
    """Key columns as compiled walks read them: where they lie, without a copy.

    ``table`` has a row (address, bytes per value) for each, ``columns`` keep the memory alive.
    """

    table: npt.NDArray[np.int64]
    columns: tuple[npt.NDArray[Any], ...]

    @classmethod
    def of(cls, frame: pl.DataFrame, by: list[str]) -> "Keys | None":
        """The keys of a frame; None where they are not up to three columns of integers."""
        columns = []
        for key in by:
            column = frame[key].to_physical()
            if not column.dtype.is_integer() or len(by) > _MOST_KEYS:
                return None
            values = _as_array(column)
            columns.append(values if values.itemsize >= 4 else values.astype(np.uint32))
        table = np.zeros((_MOST_KEYS, 2), np.int64)
        for row, values in zip(table, columns, strict=False):
            row[:] = values.ctypes.data, values.itemsize
        return cls(table, tuple(columns))

    def beyond(self, rows: int) -> npt.NDArray[np.int64]:
        """The table without the first ``rows`` rows of the frame."""
        table: npt.NDArray[np.int64] = self.table.copy()
        table[:, 0] += rows * table[:, 1]
        return table


def _as_array(column: pl.Series) -> npt.NDArray[Any]:
    """A column of integers as an array, nulls as 0; a copy only where there are any."""
    if column.null_count():
        column = column.fill_null(0)
    values: npt.NDArray[Any] = column.rechunk().to_numpy()
    return values


def _in_order(frame: pl.DataFrame, time: str) -> pl.DataFrame:
    # Events come sorted, and looking costs far less time and memory than sorting again.
    return frame if frame[time].is_sorted() else frame.sort(time, maintain_order=True)


def in_order(frame: pl.DataFrame, time: str, *ties: str, nulls_last: bool = False) -> pl.DataFrame:
    """``frame`` sorted by ``time`` and, where times are equal, by ``ties``; else as it was.

    Looking whether all times grow costs a fraction of what sorting by several columns does.
    """
    if grows(frame[time]):
        return frame
    return frame.sort(time, *ties, nulls_last=nulls_last, maintain_order=True)


def grows(times: pl.Series) -> bool:
    """Whether every time is later than the one before it; nulls say nothing."""
    return bool((times.slice(1) > times.head(max(len(times) - 1, 0))).all())


def by_number(rows: pl.DataFrame, number: str, column: str, height: int) -> pl.Series:
    """``column`` of ``rows`` laid out by their ``number``: a series of ``height``, null elsewhere.

    What a left join on a frame's own row numbers gives, without copying the frame. Of several rows
    with one number the last counts.
    """
    values = pl.repeat(None, height, dtype=rows.schema[column], eager=True).alias(column)
    return values.scatter(rows[number], rows[column])
