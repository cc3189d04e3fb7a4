"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing at that moment. Both questions are
"the latest row before this one with the same key" (or the next after it), an asof join, whose
cost is linear in the rows once both sides are sorted by time.
"""

from typing import Literal

import polars as pl

__all__ = ["by_number", "first_after", "in_order", "latest_before", "nearest"]


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
    return _asof(left, right, by, left_on, right_on, strategy="nearest", strictly=False)


def _asof(
    left: pl.DataFrame,
    right: pl.DataFrame,
    by: list[str],
    left_on: str,
    right_on: str,
    *,
    strategy: Literal["backward", "forward", "nearest"],
    strictly: bool,
) -> pl.DataFrame:
    right = right.drop_nulls([*by, right_on])
    packed = len(by) == 2 and all(left.schema[key] in _HALF for key in by)
    if packed:
        left, right = (frame.with_columns(_pack(*by).alias("key")) for frame in (left, right))
        right = right.drop(by)
    joined = _in_order(left, left_on).join_asof(
        _in_order(right, right_on),
        left_on=left_on,
        right_on=right_on,
        by="key" if packed else by or None,
        strategy=strategy,
        allow_exact_matches=not strictly,
        coalesce=False,
        check_sortedness=False,  # both are sorted; Polars cannot check it within groups
    )
    return joined.drop("key") if packed else joined


_HALF = (pl.Int32(), pl.UInt32())


def _pack(first: str, second: str) -> pl.Expr:
    """Two 32-bit keys as one of 64 bits, with which Polars groups in a fraction of the memory."""
    return (pl.col(first).cast(pl.Int64) * 2**32) + pl.col(second).cast(pl.Int64)


def _in_order(frame: pl.DataFrame, time: str) -> pl.DataFrame:
    # Events come sorted, and looking costs far less time and memory than sorting again.
    return frame if frame[time].is_sorted() else frame.sort(time, maintain_order=True)


def in_order(frame: pl.DataFrame, time: str, *ties: str) -> pl.DataFrame:
    """``frame`` sorted by ``time`` and, where times are equal, by ``ties``; else as it was.

    Looking whether all times grow costs a fraction of what sorting by several columns does.
    """
    if bool((frame[time].diff().drop_nulls() > 0).all()):
        return frame
    return frame.sort(time, *ties, maintain_order=True)


def by_number(rows: pl.DataFrame, number: str, column: str, height: int) -> pl.Series:
    """``column`` of ``rows`` laid out by their ``number``: a series of ``height``, null elsewhere.

    What a left join on a frame's own row numbers gives, without copying the frame. Of several rows
    with one number the last counts.
    """
    values = pl.repeat(None, height, dtype=rows.schema[column], eager=True).alias(column)
    return values.scatter(rows[number], rows[column])
