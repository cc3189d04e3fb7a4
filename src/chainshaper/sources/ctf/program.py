"""From steps to the table of operations that the compiled kernels interpret.

One row per operation, with the columns `O_…` of `tables`.  Runs of fixed size that nobody asks
for become one `SKIP`, so that an event that is not wanted costs one addition.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.layout import (
    Align,
    Characters,
    Choice,
    Number,
    Repeat,
    Step,
    Text,
)

__all__ = ["Program", "Storage"]

# More bits than any packet has: sizes beyond are all the same and must not overflow int64.
_ENDLESS = 1 << 56


_MOVES = {64: tb.MOVE_LONG, 32: tb.MOVE_WORD, 16: tb.MOVE_HALF, 8: tb.MOVE_BYTE}
_CONSTANT = {tb.SKIP, tb.CHARACTERS, *_MOVES.values()}


@dataclass(frozen=True, slots=True)
class Storage:
    """Where a table's slots lie (addresses and bytes per row) and its first row counter.

    Without addresses (``()``) rows are counted only; ``costs`` are then the bytes that a row of
    each level takes.
    """

    counter: int
    costs: Sequence[int] = ()
    addresses: Sequence[int] = ()
    widths: Sequence[int] = ()


@dataclass
class Program:
    """Operations and tag ranges (low, high, target, 1 + option) of everything in a trace."""

    rows: list[list[int]] = field(default_factory=list)
    ranges: list[tuple[int, int, int, int]] = field(default_factory=list)
    # Operations may not be joined across a place that is jumped to.
    joint: int = 0
    _made: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None

    def add(self, steps: list[Step], storage: Storage | None) -> tuple[int, int]:
        """Append ``steps``; returns their first operation and the one after their last."""
        start = self.joint = len(self.rows)
        self._emit(steps, storage)
        self.joint = len(self.rows)
        self._made = None
        return start, len(self.rows)

    def offsets(self, start: int, stop: int) -> bool:
        """Note where each of an event's operations reads, if that is the same in every event."""
        position = 0
        for row in self.rows[start:stop]:
            code = row[tb.O_CODE]
            if code not in _CONSTANT or row[tb.O_REGISTER] >= 0:
                return False
            position += -position % row[tb.O_ALIGN]
            row[tb.O_OFFSET] = position >> 3
            position += 8 * row[tb.O_COUNT] if code == tb.CHARACTERS else row[tb.O_SIZE]
        return True

    def cost(self, start: int, stop: int) -> int:
        """What running operations once costs at most, the turns of their loops aside."""
        switches = sum(
            row[tb.O_LEAST] for row in self.rows[start:stop] if row[tb.O_CODE] == tb.SWITCH
        )
        return stop - start + switches

    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Operations (n x 16) and ranges (m x 4), never empty."""
        if self._made is None:
            rows = self.rows or [[0] * tb.OPERATION_COLUMNS]
            ranges = self.ranges or [(0, 0, 0, 0)]
            self._made = np.array(rows, np.int64), np.array(ranges, np.int64)
        return self._made

    def _row(self, code: int, values: Mapping[int, int]) -> list[int]:
        row = [0] * tb.OPERATION_COLUMNS
        row[tb.O_CODE] = code
        row[tb.O_ALIGN] = 1
        row[tb.O_REGISTER] = row[tb.O_INNER] = -1
        for column, value in values.items():
            row[column] = value
        self.rows.append(row)
        return row

    def _skip(self, align: int, size: int) -> None:
        size = min(size, _ENDLESS)
        if len(self.rows) > self.joint and self.rows[-1][tb.O_CODE] == tb.SKIP:
            last = self.rows[-1]
            joined = _joined((last[tb.O_ALIGN], last[tb.O_SIZE]), (align, size))
            if joined is not None:
                last[tb.O_ALIGN], last[tb.O_SIZE] = joined[0], min(joined[1], _ENDLESS)
                return
        self._row(tb.SKIP, {tb.O_ALIGN: align, tb.O_SIZE: size})

    def _place(self, slot: int, level: int, storage: Storage | None) -> dict[int, int]:
        if slot < 0 or storage is None or not storage.addresses:
            return {}
        return {
            tb.O_ADDRESS: storage.addresses[slot],
            tb.O_WIDTH: storage.widths[slot],
            tb.O_COUNTER: storage.counter + level,
        }

    def _emit(self, steps: list[Step], storage: Storage | None) -> None:
        for step in steps:
            match step:
                case Align(align=align):
                    self._skip(align, 0)
                case Number():
                    self._number(step, storage)
                case Text(slot=slot, level=level):
                    self._row(tb.TEXT, {tb.O_ALIGN: 8, **self._place(slot, level, storage)})
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
        code = tb.NUMBER
        if place and step.level == 0 and step.register < 0 and _as_it_lies(step):
            code = _MOVES[step.size]
        self._row(
            code,
            {
                tb.O_ALIGN: step.align,
                tb.O_SIZE: step.size,
                tb.O_FLAGS: step.signed + 2 * step.big + 4 * step.clock,
                tb.O_REGISTER: step.register,
                **place,
            },
        )

    def _characters(self, step: Characters, storage: Storage | None) -> None:
        place = self._place(step.slot, step.level, storage)
        register = step.length.register if step.length is not None else -1
        if place:
            own = {tb.O_ALIGN: 8, tb.O_REGISTER: register, tb.O_COUNT: step.count}
            self._row(tb.CHARACTERS, own | place)
        elif step.length is None:
            self._skip(8, 8 * step.count)
        else:
            self._row(tb.SKIP_MANY, {tb.O_ALIGN: 8, tb.O_SIZE: 8, tb.O_REGISTER: register})

    def _repeat(self, step: Repeat, storage: Storage | None) -> None:
        counted = storage is not None and step.inner >= 0
        fixed = _fixed(step.body) if not (counted and storage and storage.addresses) else None
        even = fixed is not None and fixed[1] % fixed[0] == 0
        register = step.length.register if step.length is not None else -1
        inner = storage.counter + step.inner if counted and storage is not None else -1
        if fixed is not None and even and step.length is None and not counted:
            self._skip(max(step.align, fixed[0]), fixed[1] * step.count)
            return
        shared = {
            tb.O_ALIGN: step.align,
            tb.O_REGISTER: register,
            tb.O_COUNT: step.count,
            tb.O_INNER: inner,
            tb.O_COST: storage.costs[step.inner] if counted and storage and storage.costs else 0,
            **self._place(step.slot, step.level, storage),
        }
        if fixed is not None and even and fixed[1] > 0:
            self._row(tb.SKIP_MANY, {tb.O_SIZE: fixed[1], **shared})
            return
        copied = self._copied(step, storage)
        if copied is not None and storage is not None:
            address = storage.addresses[copied.slot]
            self._row(tb.COPY, {tb.O_SIZE: copied.size, tb.O_INNER_ADDRESS: address, **shared})
            return
        loop = self._row(tb.LOOP, {tb.O_LEAST: _least(step.body), **shared})
        self.joint = len(self.rows)
        start = len(self.rows)
        self._emit(step.body, storage)
        self._row(tb.AGAIN, {tb.O_TARGET: start, tb.O_INNER: inner})
        loop[tb.O_TARGET] = self.joint = len(self.rows)
        loop[tb.O_COST] += self.cost(start, len(self.rows))

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
        switch = self._row(tb.SWITCH, {tb.O_REGISTER: step.tag.register, **place})
        # Unsigned tags are compared as signed numbers, both with their top bit turned.
        unsigned = not step.tag.signed
        switch[tb.O_FLAGS] = int(not unsigned)
        first, ends = len(self.ranges), []
        for index, (ranges, _) in enumerate(step.options):
            for ends_at in ranges:
                low, high = (max(v, 0) - (1 << 63) if unsigned else v for v in ends_at)
                low, high = max(low, -(1 << 63)), min(high, (1 << 63) - 1)
                self.ranges.append((low, high, 0, index + 1))
        switch[tb.O_COUNT], switch[tb.O_LEAST] = first, len(self.ranges) - first
        places = range(first, len(self.ranges))
        for index, (_, body) in enumerate(step.options):
            self.joint = len(self.rows)
            for place_at in places:
                low, high, _, option = self.ranges[place_at]
                if option == index + 1:
                    self.ranges[place_at] = (low, high, len(self.rows), option)
            self._emit(body, storage)
            ends.append(self._row(tb.JUMP, {}))
        for jump in ends:
            jump[tb.O_TARGET] = len(self.rows)
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
