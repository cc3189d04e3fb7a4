"""Matching events to events by time: the joins that the rest of the analysis is built from.

An event rarely names what it belongs to. It carries an address, which means whatever was last
created there, or it belongs to whatever its thread was doing at that moment. Both questions are
"the latest row before this one with the same key" (or the next after it), an asof join, whose
cost is linear in the rows once both sides are sorted by time.
"""

from typing import Literal

import polars as pl

__all__ = ["first_after", "latest_before", "nearest"]


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
    return left.sort(left_on, maintain_order=True).join_asof(
        right.drop_nulls([*by, right_on]).sort(right_on, maintain_order=True),
        left_on=left_on,
        right_on=right_on,
        by=by or None,
        strategy=strategy,
        allow_exact_matches=not strictly,
        coalesce=False,
        check_sortedness=False,  # both were sorted above; Polars cannot check it within groups
    )
