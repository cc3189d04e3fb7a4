"""From flat arrays to Polars columns."""

# ruff: noqa: PLR0911, PLR0917 - one branch per shape, all with the same parameters

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.sources.ctf.shapes import (
    ListShape,
    OptionShape,
    RecordShape,
    ScalarShape,
    Shape,
    TextShape,
)

__all__ = ["column", "ragged"]


def column(
    name: str,
    shape: Shape,
    slots: Sequence[NDArray[Any]],
    rows: Sequence[int],
    texts: pl.Series,
    level: int = 0,
) -> pl.Series:
    """One column of a table.

    ``slots`` are the table's arrays, ``rows`` the rows of each level, ``texts`` the strings
    that text slots hold codes of.  Numbers keep their type; arrays become Polars arrays,
    sequences lists, structures and variants structs, an absent option null.
    """
    match shape:
        case ScalarShape(slot=slot):
            return pl.Series(name, slots[slot])
        case TextShape(slot=slot):
            return texts.gather(pl.Series(slots[slot])).alias(name)
        case ListShape(slot=slot, level=inner, count=count, element=element):
            values = column(name, element, slots, rows, texts, inner)
            if slot < 0 and count > 0:
                deeper = values.dtype.shape if isinstance(values.dtype, pl.Array) else ()
                return values.reshape((rows[level], count, *deeper))
            lengths = slots[slot] if slot >= 0 else np.zeros(rows[level], np.uint32)
            return ragged(values, lengths)
        case RecordShape(fields=fields):
            parts = [column(n, s, slots, rows, texts, level) for n, s in fields]
            return pl.DataFrame(_distinct(parts)).to_struct(name)
        case OptionShape(slot=slot, options=options):
            chosen = pl.Series(slots[slot])
            parts = []
            for number, (option, inside) in enumerate(options, start=1):
                if inside is not None:
                    values = column(option, inside, slots, rows, texts, level)
                    present = pl.Series(chosen == number)
                    parts.append(
                        pl.select(
                            pl.when(present).then(pl.lit(values)).otherwise(None).alias(option)
                        ).to_series()
                    )
            if not parts:
                return pl.Series(name, [None] * rows[level], dtype=pl.Null)
            return pl.DataFrame(_distinct(parts)).to_struct(name)


def ragged(values: pl.Series, lengths: NDArray[Any]) -> pl.Series:
    """``values`` cut into lists of the given lengths, in order."""
    full = np.flatnonzero(lengths)
    if not len(full):
        return pl.Series(values.name, [[]] * len(lengths), dtype=pl.List(values.dtype))
    owner = pl.Series("owner", np.repeat(full, lengths[full])).set_sorted()
    lists = (
        pl.DataFrame([owner, values.alias("value")])
        .group_by("owner", maintain_order=True)
        .agg("value")["value"]
        .alias(values.name)
    )
    if len(full) == len(lengths):
        return lists
    # Rows without an element point at an empty list behind the others.
    empty = pl.Series(values.name, [[]], dtype=lists.dtype)
    places = np.full(len(lengths), len(full), np.uint32)
    places[full] = np.arange(len(full), dtype=np.uint32)
    return pl.concat([lists, empty]).gather(pl.Series(places))


def _distinct(parts: list[pl.Series]) -> list[pl.Series]:
    """Columns with a name each: ``_a`` and ``a`` of one structure are both shown as ``a``."""
    taken: set[str] = set()
    found = []
    for part in parts:
        name = part.name
        while name in taken:
            name = "_" + name
        taken.add(name)
        found.append(part.alias(name))
    return found
