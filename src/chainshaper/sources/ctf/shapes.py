"""Where decoded values go: slots, and how columns are made of them.

Values go to *slots*, one flat array each.  A slot belongs to a *level*: level 0 has one row per
event; every array or sequence opens a level of its own, with one row per element.  A `Shape` says
how a column's slots belong together.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "ListShape",
    "OptionShape",
    "RecordShape",
    "ScalarShape",
    "Shape",
    "Slot",
    "TextShape",
]


@dataclass(frozen=True, slots=True)
class Slot:
    """A flat array: its level, its NumPy type code and whether rows may stay unwritten."""

    level: int
    dtype: str
    sparse: bool


@dataclass(frozen=True, slots=True)
class ScalarShape:
    """A column of numbers."""

    slot: int


@dataclass(frozen=True, slots=True)
class TextShape:
    """A column of strings; its slot holds dictionary codes."""

    slot: int


@dataclass(frozen=True, slots=True)
class ListShape:
    """A column of lists; ``slot`` holds lengths, or is -1 for arrays of ``count``."""

    slot: int
    level: int
    count: int
    element: Shape


@dataclass(frozen=True, slots=True)
class RecordShape:
    """A column of structures."""

    fields: tuple[tuple[str, Shape], ...]


@dataclass(frozen=True, slots=True)
class OptionShape:
    """A column of variants: ``slot`` holds 1 + the index of the option that is present."""

    slot: int
    options: tuple[tuple[str, Shape | None], ...]


Shape = ScalarShape | TextShape | ListShape | RecordShape | OptionShape
