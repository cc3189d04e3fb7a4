"""From steps to the table of operations that the compiled kernels interpret.

One row of 16 int64 per operation, the columns named by `Op`.  Runs of fixed size that nobody asks
for become one `SKIP`, so that an event that is not wanted costs one addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf.layout import (
    Align,
    Characters,
    Choice,
    Number,
    Repeat,
    Step,
    Text,
)

__all__ = ["ROW", "Code", "Op", "Program", "Storage"]

# Rows are two cache lines, and a shift away from each other.
ROW = 16
# More bits than any packet has: sizes beyond are all the same and must not overflow int64.
_ENDLESS = 1 << 56


class Op(IntEnum):
    """Columns of the table of operations."""

    CODE = 0
    ALIGN = 1  # bits
    SIZE = 2  # bits; of one element for SKIP_MANY and COPY
    FLAGS = 3  # 1 signed, 2 big-endian, 4 advances the clock
    ADDRESS = 4  # where row 0 of the slot lies, 0 for no slot
    WIDTH = 5  # bytes per row of the slot
    COUNTER = 6  # the level's row counter
    REGISTER = 7  # written by NUMBER, the length or tag for others; -1 for none
    COUNT = 8  # constant length; first range of SWITCH
    TARGET = 9  # operation to go on with
    INNER = 10  # the element level's row counter, -1 where nobody wants it
    INNER_ADDRESS = 11  # where COPY writes
    LEAST = 12  # the least bits an element takes; number of ranges of SWITCH
    OFFSET = 13  # bytes from the aligned start of an event of constant layout


class Code(IntEnum):
    """Operations."""

    SKIP = 0
    NUMBER = 1
    TEXT = 2
    CHARACTERS = 3
    SKIP_MANY = 4
    COPY = 5
    LOOP = 6
    AGAIN = 7
    SWITCH = 8
    JUMP = 9
    # A NUMBER of 8, 4, 2 or 1 bytes as they lie in the packet, one per event.
    MOVE_LONG = 10
    MOVE_WORD = 11
    MOVE_HALF = 12
    MOVE_BYTE = 13


_MOVES = {64: Code.MOVE_LONG, 32: Code.MOVE_WORD, 16: Code.MOVE_HALF, 8: Code.MOVE_BYTE}
_CONSTANT = {Code.SKIP, Code.CHARACTERS, *_MOVES.values()}


@dataclass(frozen=True, slots=True)
class Storage:
    """Where a table's slots lie (addresses and bytes per row) and its first row counter.

    Without addresses (``()``) rows are counted only.
    """

    counter: int
    addresses: Sequence[int] = ()
    widths: Sequence[int] = ()


@dataclass
class Program:
    """Operations and tag ranges (low, high, target, 1 + option) of everything in a trace."""

    rows: list[list[int]] = field(default_factory=list)
    ranges: list[tuple[int, int, int, int]] = field(default_factory=list)
    # Operations may not be joined across a place that is jumped to.
    joint: int = 0

    def add(self, steps: list[Step], storage: Storage | None) -> tuple[int, int]:
        """Append ``steps``; returns their first operation and the one after their last."""
        start = self.joint = len(self.rows)
        self._emit(steps, storage)
        self.joint = len(self.rows)
        return start, len(self.rows)

    def offsets(self, start: int, stop: int) -> bool:
        """Note where each of an event's operations reads, if that is the same in every event."""
        position = 0
        for row in self.rows[start:stop]:
            code = row[Op.CODE]
            if code not in _CONSTANT or row[Op.REGISTER] >= 0:
                return False
            position += -position % row[Op.ALIGN]
            row[Op.OFFSET] = position >> 3
            position += 8 * row[Op.COUNT] if code == Code.CHARACTERS else row[Op.SIZE]
        return True

    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Operations (n x 16) and ranges (m x 4), never empty."""
        rows = self.rows or [[0] * ROW]
        return np.array(rows, np.int64), np.array(self.ranges or [(0, 0, 0, 0)], np.int64)

    def _row(self, code: Code, **values: int) -> list[int]:
        row = [0] * ROW
        row[Op.CODE] = code
        row[Op.ALIGN] = 1
        row[Op.REGISTER] = row[Op.INNER] = -1
        for name, value in values.items():
            row[Op[name]] = value
        self.rows.append(row)
        return row

    def _skip(self, align: int, size: int) -> None:
        size = min(size, _ENDLESS)
        if len(self.rows) > self.joint and self.rows[-1][Op.CODE] == Code.SKIP:
            last = self.rows[-1]
            joined = _joined((last[Op.ALIGN], last[Op.SIZE]), (align, size))
            if joined is not None:
                last[Op.ALIGN], last[Op.SIZE] = joined[0], min(joined[1], _ENDLESS)
                return
        self._row(Code.SKIP, ALIGN=align, SIZE=size)

    def _place(self, slot: int, level: int, storage: Storage | None) -> dict[str, int]:
        if slot < 0 or storage is None or not storage.addresses:
            return {}
        return {
            "ADDRESS": storage.addresses[slot],
            "WIDTH": storage.widths[slot],
            "COUNTER": storage.counter + level,
        }

    def _emit(self, steps: list[Step], storage: Storage | None) -> None:
        for step in steps:
            match step:
                case Align(align=align):
                    self._skip(align, 0)
                case Number():
                    self._number(step, storage)
                case Text(slot=slot, level=level):
                    self._row(Code.TEXT, ALIGN=8, **self._place(slot, level, storage))
                case Characters():
                    self._characters(step, storage)
                case Repeat():
                    self._repeat(step, storage)
                case Choice():
                    self._choice(step, storage)

    def _number(self, step: Number, storage: Storage | None) -> None:
        place = self._place(step.slot, step.level, storage)
        if not place and step.register < 0 and not step.clock:
            self._skip(step.align, step.size)
            return
        code = Code.NUMBER
        if place and step.level == 0 and step.register < 0 and _as_it_lies(step):
            code = _MOVES[step.size]
        self._row(
            code,
            ALIGN=step.align,
            SIZE=step.size,
            FLAGS=step.signed + 2 * step.big + 4 * step.clock,
            REGISTER=step.register,
            **place,
        )

    def _characters(self, step: Characters, storage: Storage | None) -> None:
        place = self._place(step.slot, step.level, storage)
        register = step.length.register if step.length is not None else -1
        if place:
            self._row(Code.CHARACTERS, ALIGN=8, REGISTER=register, COUNT=step.count, **place)
        elif step.length is None:
            self._skip(8, 8 * step.count)
        else:
            self._row(Code.SKIP_MANY, ALIGN=8, SIZE=8, REGISTER=register)

    def _repeat(self, step: Repeat, storage: Storage | None) -> None:
        counted = storage is not None and step.inner >= 0
        fixed = _fixed(step.body) if not (counted and storage and storage.addresses) else None
        even = fixed is not None and fixed[1] % fixed[0] == 0
        register = step.length.register if step.length is not None else -1
        inner = storage.counter + step.inner if counted and storage is not None else -1
        if fixed is not None and even and step.length is None and not counted:
            self._skip(max(step.align, fixed[0]), fixed[1] * step.count)
            return
        shared = {"ALIGN": step.align, "REGISTER": register, "COUNT": step.count, "INNER": inner}
        shared |= self._place(step.slot, step.level, storage)
        if fixed is not None and even and fixed[1] > 0:
            self._row(Code.SKIP_MANY, SIZE=fixed[1], **shared)
            return
        copied = self._copied(step, storage)
        if copied is not None and storage is not None:
            address = storage.addresses[copied.slot]
            self._row(Code.COPY, SIZE=copied.size, INNER_ADDRESS=address, **shared)
            return
        loop = self._row(Code.LOOP, LEAST=_least(step.body), **shared)
        self.joint = len(self.rows)
        start = len(self.rows)
        self._emit(step.body, storage)
        self._row(Code.AGAIN, TARGET=start, INNER=inner)
        loop[Op.TARGET] = self.joint = len(self.rows)

    def _copied(self, step: Repeat, storage: Storage | None) -> Number | None:
        """An array's element, if elements lie in the packet just as they lie in its slot."""
        if len(step.body) != 1 or storage is None or not storage.addresses:
            return None
        only = step.body[0]
        alike = (
            isinstance(only, Number)
            and only.slot >= 0
            and only.register < 0
            and only.size % only.align == 0
            and _as_it_lies(only)
        )
        return only if alike and isinstance(only, Number) else None

    def _choice(self, step: Choice, storage: Storage | None) -> None:
        place = self._place(step.slot, step.level, storage)
        switch = self._row(Code.SWITCH, REGISTER=step.tag.register, **place)
        # Unsigned tags are compared as signed numbers, both with their top bit turned.
        unsigned = not step.tag.signed
        switch[Op.FLAGS] = int(not unsigned)
        first, ends = len(self.ranges), []
        for index, (ranges, _) in enumerate(step.options):
            for ends_at in ranges:
                low, high = (max(v, 0) - (1 << 63) if unsigned else v for v in ends_at)
                low, high = max(low, -(1 << 63)), min(high, (1 << 63) - 1)
                self.ranges.append((low, high, 0, index + 1))
        switch[Op.COUNT], switch[Op.LEAST] = first, len(self.ranges) - first
        places = range(first, len(self.ranges))
        for index, (_, body) in enumerate(step.options):
            self.joint = len(self.rows)
            for place_at in places:
                low, high, _, option = self.ranges[place_at]
                if option == index + 1:
                    self.ranges[place_at] = (low, high, len(self.rows), option)
            self._emit(body, storage)
            ends.append(self._row(Code.JUMP))
        for jump in ends:
            jump[Op.TARGET] = len(self.rows)
        self.joint = len(self.rows)


def _as_it_lies(step: Number) -> bool:
    """Whether a number's bytes in a packet are those in memory."""
    return (
        step.align >= 8
        and step.size in (8, 16, 32, 64)
        and (step.size == 8 or not step.big)
        and not step.clock
    )


def _joined(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int] | None:
    """Two skips (alignment, size) as one, or None where that depends on where they begin."""
    (align, size), (next_align, next_size) = first, second
    if next_align <= align and size % next_align == 0:
        return align, size + next_size
    if size == 0:
        return max(align, next_align), next_size
    return None


def _fixed(steps: list[Step]) -> tuple[int, int] | None:
    """Alignment and size of steps that always take the same bits and that nobody refers to."""
    whole = (1, 0)
    for step in steps:
        part: tuple[int, int] | None = None
        match step:
            case Align(align=align):
                part = (align, 0)
            case Number(size=size, align=align, register=register, clock=clock):
                part = (align, size) if register < 0 and not clock else None
            case Characters(count=count, length=None):
                part = (8, 8 * count)
            case Repeat(align=align, count=count, length=None, body=body):
                element = _fixed(body)
                if element is not None and element[1] % element[0] == 0 and step.inner < 0:
                    part = (max(align, element[0]), element[1] * count)
            case _:
                part = None
        joined = _joined(whole, part) if part is not None else None
        if joined is None:
            return None
        whole = joined
    return whole


def _least(steps: list[Step]) -> int:
    """The least number of bits that steps take, alignment aside."""
    total = 0
    for step in steps:
        match step:
            case Number(size=size):
                total += size
            case Text():
                total += 8
            case Characters(count=count):
                total += 8 * count
            case Repeat(count=count, body=body):
                total += count * _least(body)
            case Choice(options=options):
                total += min((_least(body) for _, body in options), default=0)
            case Align():
                pass
    return min(total, _ENDLESS)
