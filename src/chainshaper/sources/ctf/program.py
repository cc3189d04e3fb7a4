"""From field types to the operations that the compiled kernels interpret.

`Reader` turns a structure type into steps (`Number`, `Characters`, `Repeat`, `Choice`, …) with
lengths of sequences and tags of variants resolved to the numbers that hold them (CTF 1.8, section
7.3.2), and into the `Shape` of the columns that the values go to. `Program` turns steps into rows
of operations, with the columns ``O_…`` of `tables`. Runs of fixed size that are not asked for
become one `SKIP`, so that an event that is not wanted costs one addition.

Values go to *slots*, one flat array each. A slot belongs to a *level*: level 0 has one row per
event; every array or sequence opens a level of its own, with one row per element. A `Shape` says
how a column's slots belong together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.types import (
    ArrayType,
    EnumMapping,
    EnumType,
    FloatType,
    IntegerType,
    SequenceType,
    StringType,
    StructType,
    Type,
    VariantType,
    alignment,
    field_name,
)

_DEEPEST = 12
_MOST_STEPS = 200_000
"""Types to lay out in a trace: one with all the kernel's events has some 10,000."""
# More bits than any packet has: sizes beyond are all the same and must not overflow int64.
_ENDLESS = 1 << 56
_MOVES = {64: tb.MOVE_LONG, 32: tb.MOVE_WORD, 16: tb.MOVE_HALF, 8: tb.MOVE_BYTE}
_CONSTANT = {tb.SKIP, tb.CHARACTERS, *_MOVES.values()}


class LayoutError(ValueError):
    """Types that cannot be laid out: an unresolved length or tag, too deep a nesting."""


# Where values go


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


# In which order values are read


@dataclass(slots=True, eq=False)
class Align:
    """Advance to a multiple of ``align`` bits from the start of the packet."""

    align: int


@dataclass(slots=True, eq=False)
class Number:
    """An integer, an enumeration's integer or a float's bits."""

    size: int
    align: int
    signed: bool
    big: bool
    clock: bool = False
    slot: int = -1
    level: int = 0
    register: int = -1
    mappings: tuple[EnumMapping, ...] = ()

    @property
    def as_it_lies(self) -> bool:
        """Whether its bytes in a packet are those in memory."""
        whole = self.align >= 8 and self.size in _MOVES
        return whole and (self.size == 8 or not self.big) and not self.clock


@dataclass(slots=True, eq=False)
class Characters:
    """Text up to its first NUL: an array or sequence of bytes, or a string (``count`` None)."""

    count: int | None
    length: Number | None
    slot: int
    level: int


@dataclass(slots=True, eq=False)
class Repeat:
    """An array (``length`` is None) or sequence; ``slot`` takes the length of each sequence."""

    align: int
    count: int
    length: Number | None
    body: list[Step]
    slot: int
    level: int
    inner: int


@dataclass(slots=True, eq=False)
class Choice:
    """A variant: ranges of the tag and the steps behind them; ``slot`` takes 1 + the option."""

    tag: Number
    options: list[tuple[tuple[tuple[int, int], ...], list[Step]]]
    slot: int
    level: int


Step = Align | Number | Characters | Repeat | Choice
Frame = dict[str, "Number | Frame | None"]


class _Place(NamedTuple):
    """Where a type stands: the numbers around it, its level, and whether it gets a column."""

    frames: tuple[Frame, ...]
    level: int
    keep: bool

    def inside(self, frame: Frame) -> _Place:
        return self._replace(frames=(*self.frames, frame))


_Compiled = tuple[list[Step], Shape | None]


@dataclass
class Reader:
    """What is known while one event class (or one header) is laid out.

    ``roots`` maps a dynamic scope (``stream.event.context``, …) to the numbers read there so
    far; ``slots`` and ``levels`` grow with every column wanted; ``registers`` is the next free
    register for a number that a length or a tag refers to. ``steps`` counts the types of the whole
    trace that were laid out, ``labels`` has its enumerations by label.
    """

    big: bool
    registers: int
    roots: dict[str, Frame] = field(default_factory=dict)
    slots: list[Slot] = field(default_factory=list)
    levels: int = 1
    steps: int = 0
    sparse: bool = False
    labels: dict[int, dict[str, list[tuple[int, int]]]] = field(default_factory=dict)

    def child(self) -> Reader:
        """A reader for what follows in one of several places."""
        return replace(self, roots=dict(self.roots), slots=[], levels=1)

    def join(self, child: Reader) -> None:
        """Go on behind what a child has laid out, whose registers others may use again."""
        self.registers, self.steps = max(self.registers, child.registers), child.steps

    def scope(
        self,
        scope: str,
        kind: StructType | None,
        wanted: frozenset[str] | None = frozenset(),
        fixed: bool = False,
    ) -> tuple[list[Step], list[tuple[str, Shape]]]:
        """Lay out the structure ``kind`` as the dynamic scope ``scope``.

        ``wanted`` are the TSDL names of the fields that get columns, None for all. ``fixed`` has
        the numbers of `REGISTERS` stay there, as for packet headers and contexts. Returns the
        steps and the columns by user's name. Raises `LayoutError`.
        """
        frame: Frame = {}
        self.roots[scope] = frame
        columns: list[tuple[str, Shape]] = []
        if kind is None:
            return [], columns
        steps: list[Step] = [Align(alignment(kind))]
        for member in kind.fields:
            if fixed and member.name == "uuid" and _is_uuid(member.type):
                steps += [_half("uuid_low"), _half("uuid_high")]
                continue
            place = _Place((frame,), 0, wanted is None or member.name in wanted)
            more, shape = self._compile(member.name, member.type, place)
            steps += more
            if shape is not None:
                columns.append((field_name(member.name), shape))
            if fixed:
                _keep_known(frame, member.name)
        return steps, columns

    def _compile(self, name: str, kind: Type, at: _Place) -> _Compiled:
        self.steps += 1
        if len(at.frames) > _DEEPEST or self.steps > _MOST_STEPS:
            raise LayoutError(f"{name}: types nested too deeply")
        match kind:
            case IntegerType() | EnumType() | FloatType():
                return self._number(name, kind, at)
            case StringType():
                slot = self._slot(at, "u4")
                text = Characters(None, None, slot, at.level)
                return [text], TextShape(slot) if at.keep else None
            case StructType():
                return self._record(name, kind, at)
            case ArrayType() | SequenceType():
                return self._repeat(name, kind, at)
            case VariantType():
                return self._choice(name, kind, at)

    def _slot(self, at: _Place, dtype: str) -> int:
        """A new slot's index, -1 where none is wanted."""
        if not at.keep:
            return -1
        self.slots.append(Slot(at.level, dtype, self.sparse))
        return len(self.slots) - 1

    def _number(self, name: str, kind: IntegerType | EnumType | FloatType, at: _Place) -> _Compiled:
        base = kind.container if isinstance(kind, EnumType) else kind
        big = self.big if base.byte_order == "native" else base.byte_order == "be"
        code = "f" if isinstance(base, FloatType) else "i" if base.signed else "u"
        width = next(width for width in (1, 2, 4, 8) if base.size <= 8 * width)
        slot = self._slot(at, f"{code}{width}")
        clock = isinstance(base, IntegerType) and base.clock is not None
        number = Number(base.size, base.align, code == "i", big, clock, slot, at.level)
        number.mappings = kind.mappings if isinstance(kind, EnumType) else ()
        at.frames[-1][name] = None if isinstance(base, FloatType) else number
        return [number], ScalarShape(slot) if at.keep else None

    def _record(self, name: str, kind: StructType, at: _Place) -> _Compiled:
        frame: Frame = {}
        at.frames[-1][name] = frame
        steps: list[Step] = [Align(alignment(kind))]
        columns: list[tuple[str, Shape]] = []
        for member in kind.fields:
            more, shape = self._compile(member.name, member.type, at.inside(frame))
            steps += more
            if shape is not None:
                columns.append((field_name(member.name), shape))
        return steps, RecordShape(tuple(columns)) if columns else None

    def _repeat(self, name: str, kind: ArrayType | SequenceType, at: _Place) -> _Compiled:
        element = kind.element
        count = kind.length if isinstance(kind, ArrayType) else 0
        length = self._referred(kind.length, at) if isinstance(kind, SequenceType) else None
        if _is_byte(element) and getattr(element, "encoding", "none") != "none":
            slot = self._slot(at, "u4")
            text = Characters(count, length, slot, at.level)
            return [text], TextShape(slot) if at.keep else None
        slot = self._slot(at, "u4") if length is not None else -1
        inner = self.levels
        self.levels += at.keep
        body, shape = self._compile(name, element, at.inside({})._replace(level=inner))
        if all(isinstance(step, Align) for step in body):  # an array of empty structures
            return [Align(alignment(kind))], None
        own = inner if at.keep else -1
        repeat = Repeat(alignment(kind), count, length, body, slot, at.level, own)
        if shape is None:
            return [repeat], None
        return [repeat], ListShape(slot, inner, -1 if length is not None else count, shape)

    def _choice(self, name: str, kind: VariantType, at: _Place) -> _Compiled:
        if kind.tag is None:
            raise LayoutError(f"variant {name!r} has no tag")
        tag = self._referred(kind.tag, at)
        slot = self._slot(at, "u2")
        outer, self.sparse = self.sparse, True
        ranges_of = self._ranges_by_label(tag)
        choice, frame = Choice(tag, [], slot, at.level), Frame()
        columns: list[tuple[str, Shape | None]] = []
        at.frames[-1][name] = frame
        for option in kind.options:
            names = dict.fromkeys((option.name, option.name.removeprefix("_")))
            ranges = tuple(pair for label in names for pair in ranges_of.get(label, []))
            self.steps += len(ranges)
            steps, shape = self._compile(option.name, option.type, at.inside(frame))
            choice.options.append((ranges, steps))
            columns.append((field_name(option.name), shape))
        self.sparse = outer
        return [choice], OptionShape(slot, tuple(columns)) if at.keep else None

    def _ranges_by_label(self, tag: Number) -> dict[str, list[tuple[int, int]]]:
        """The values that choose each option of a variant; variants may share an enumeration."""
        found = self.labels.get(id(tag.mappings))
        if found is None:
            found = self.labels[id(tag.mappings)] = {}
            for mapping in tag.mappings:
                found.setdefault(mapping.label, []).append((mapping.low, mapping.high))
        return found

    def _referred(self, path: str, at: _Place) -> Number:
        """The number that a length or tag path names, relative or absolute, with a register."""
        absolute = [
            (frame, path[len(root) + 1 :])
            for root, frame in self.roots.items()
            if path.startswith(root + ".")
        ]
        around = [*reversed(at.frames), *reversed(self.roots.values())]
        for frame, names in [*absolute, *((frame, path) for frame in around)]:
            found: Number | Frame | None = frame
            for name in names.split("."):
                found = found.get(name) if isinstance(found, dict) else None
            if isinstance(found, Number):
                if found.register < 0:
                    found.register = self.registers
                    self.registers += 1
                return found
        raise LayoutError(f"length or tag {path!r} names no number that is read before it")


def _keep_known(frame: Frame, name: str) -> None:
    """Give a header's numbers their registers; an event's id may also lie in a variant."""
    found = frame.get(name)
    if isinstance(found, Number) and name in tb.REGISTERS:
        found.register = tb.REGISTERS[name]
        # The end of a packet is no instant that its events follow.
        found.clock = found.clock and name != "timestamp_end"
    elif isinstance(found, dict):
        for inner in found:
            if inner == "id" or isinstance(found[inner], dict):
                _keep_known(found, inner)


def _is_uuid(kind: Type) -> bool:
    return isinstance(kind, ArrayType) and kind.length == 16 and _is_byte(kind.element)


def _is_byte(kind: Type) -> bool:
    return isinstance(kind, IntegerType) and kind.size == 8 and kind.align == 8


def _half(name: str) -> Number:
    return Number(size=64, align=8, signed=False, big=False, register=tb.REGISTERS[name])


# Operations


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
        switches = (r[tb.O_LEAST] for r in self.rows[start:stop] if r[tb.O_CODE] == tb.SWITCH)
        return stop - start + sum(switches)

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

    def _emit(self, steps: list[Step], storage: Storage | None) -> None:
        for step in steps:
            match step:
                case Align(align=align):
                    self._skip(align, 0)
                case Number():
                    self._number(step, storage)
                case Characters():
                    self._characters(step, storage)
                case Repeat():
                    self._repeat(step, storage)
                case Choice():
                    self._choice(step, storage)

    def _number(self, step: Number, storage: Storage | None) -> None:
        place = _place(step, storage)
        if not place and step.register < 0 and not step.clock:
            self._skip(step.align, step.size)
            return
        code = tb.NUMBER
        if place and step.level == 0 and step.register < 0 and step.as_it_lies:
            code = _MOVES[step.size]
        own = {
            tb.O_ALIGN: step.align,
            tb.O_SIZE: step.size,
            tb.O_FLAGS: step.signed + 2 * step.big + 4 * step.clock,
            tb.O_REGISTER: step.register,
        }
        self._row(code, own | place)

    def _characters(self, step: Characters, storage: Storage | None) -> None:
        place = _place(step, storage)
        own = {tb.O_ALIGN: 8, tb.O_REGISTER: _register(step.length)}
        if step.count is None:
            self._row(tb.TEXT, own | place)
        elif place:
            self._row(tb.CHARACTERS, {**own, tb.O_COUNT: step.count, **place})
        elif step.length is None:
            self._skip(8, 8 * step.count)
        else:
            self._row(tb.SKIP_MANY, {**own, tb.O_SIZE: 8})

    def _repeat(self, step: Repeat, storage: Storage | None) -> None:
        counted = storage if step.inner >= 0 else None
        fixed = None if counted and counted.addresses else _fixed(step.body)
        even = fixed if fixed is not None and fixed[1] % fixed[0] == 0 else None
        if even is not None and step.length is None and not counted:
            self._skip(max(step.align, even[0]), even[1] * step.count)
            return
        inner = counted.counter + step.inner if counted else -1
        shared = {
            tb.O_ALIGN: step.align,
            tb.O_REGISTER: _register(step.length),
            tb.O_COUNT: step.count,
            tb.O_INNER: inner,
            tb.O_COST: counted.costs[step.inner] if counted and counted.costs else 0,
            **_place(step, storage),
        }
        copied = _copied(step, storage)
        if even is not None and even[1] > 0:
            self._row(tb.SKIP_MANY, {tb.O_SIZE: even[1], **shared})
        elif copied is not None and storage is not None:
            address = storage.addresses[copied.slot]
            self._row(tb.COPY, {tb.O_SIZE: copied.size, tb.O_INNER_ADDRESS: address, **shared})
        else:
            loop = self._row(tb.LOOP, {tb.O_LEAST: _least(step.body), **shared})
            start = self.joint = len(self.rows)
            self._emit(step.body, storage)
            self._row(tb.AGAIN, {tb.O_TARGET: start, tb.O_INNER: inner})
            loop[tb.O_TARGET] = self.joint = len(self.rows)
            loop[tb.O_COST] += self.cost(start, len(self.rows))

    def _choice(self, step: Choice, storage: Storage | None) -> None:
        own = {tb.O_REGISTER: step.tag.register, **_place(step, storage)}
        switch = self._row(tb.SWITCH, own)
        # Unsigned tags are compared as signed numbers, both with their top bit turned.
        unsigned = not step.tag.signed
        switch[tb.O_FLAGS] = int(not unsigned)
        first, ends = len(self.ranges), []
        for index, (ranges, _) in enumerate(step.options):
            for ends_at in ranges:
                low, high = (max(v, 0) - (1 << 63) if unsigned else v for v in ends_at)
                low, high = max(low, -(1 << 63)), min(high, (1 << 63) - 1)
                self.ranges.append((low, high, 0, index + 1))
        last = len(self.ranges)
        switch[tb.O_COUNT], switch[tb.O_LEAST] = first, last - first
        for index, (_, body) in enumerate(step.options):
            self.joint = len(self.rows)
            for place_at in range(first, last):
                low, high, _, option = self.ranges[place_at]
                if option == index + 1:
                    self.ranges[place_at] = (low, high, len(self.rows), option)
            self._emit(body, storage)
            ends.append(self._row(tb.JUMP, {}))
        for jump in ends:
            jump[tb.O_TARGET] = len(self.rows)
        self.joint = len(self.rows)


def _place(step: Number | Characters | Repeat | Choice, storage: Storage | None) -> dict[int, int]:
    """The columns of an operation that say where its value goes; none where it is not wanted."""
    if step.slot < 0 or storage is None or not storage.addresses:
        return {}
    return {
        tb.O_ADDRESS: storage.addresses[step.slot],
        tb.O_WIDTH: storage.widths[step.slot],
        tb.O_COUNTER: storage.counter + step.level,
    }


def _register(length: Number | None) -> int:
    return length.register if length is not None else -1


def _copied(step: Repeat, storage: Storage | None) -> Number | None:
    """An array's element, if elements lie in the packet just as they lie in its slot."""
    if len(step.body) != 1 or storage is None or not storage.addresses:
        return None
    match step.body[0]:
        case Number(slot=slot, register=-1, as_it_lies=True) as only if slot >= 0:
            return only if only.size % only.align == 0 else None
    return None


def _joined(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int] | None:
    """Two skips (alignment, size) as one, or None where that depends on where they begin."""
    (align, size), (next_align, next_size) = first, second
    if next_align <= align and size % next_align == 0:
        return align, size + next_size
    if size == 0:
        return max(align, next_align), next_size
    return None


def _fixed(steps: list[Step]) -> tuple[int, int] | None:
    """Alignment and size of steps that always take the same bits and that nothing refers to."""
    whole = (1, 0)
    for step in steps:
        part: tuple[int, int] | None = None
        match step:
            case Align(align=align):
                part = (align, 0)
            case Number(size=size, align=align, register=-1, clock=False):
                part = (align, size)
            case Characters(count=int(count), length=None):
                part = (8, 8 * count)
            case Repeat(align=align, count=count, length=None, body=body):
                element = _fixed(body)
                if element is not None and element[1] % element[0] == 0 and step.inner < 0:
                    part = (max(align, element[0]), element[1] * count)
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
            case Characters(count=count):
                total += 8 if count is None else 8 * count
            case Repeat(count=count, body=body):
                total += count * _least(body)
            case Choice(options=options):
                total += min((_least(body) for _, body in options), default=0)
    return min(total, _ENDLESS)
