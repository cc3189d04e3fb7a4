"""From field types to the order in which their bits are read.

`compile_fields` turns a structure type into a list of steps (`Number`, `Characters`, `Repeat`,
`Choice`, …) with lengths of sequences and tags of variants resolved to the numbers that hold
them (CTF 1.8, section 7.3.2), and into the `Shape` of the columns that the values go to.

Values go to *slots*, one flat array each.  A slot belongs to a *level*: level 0 has one row per
event; every array or sequence opens a level of its own, with one row per element.
"""

# ruff: noqa: PLR0917 - every type is laid out with the same parameters

from __future__ import annotations

from dataclasses import dataclass, field

from chainshaper.sources.ctf.shapes import (
    ListShape,
    OptionShape,
    RecordShape,
    ScalarShape,
    Shape,
    Slot,
    TextShape,
)
from chainshaper.sources.ctf.tables import REGISTERS
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

__all__ = [
    "Align",
    "Characters",
    "Choice",
    "LayoutError",
    "Number",
    "Reader",
    "Repeat",
    "Step",
    "Text",
    "compile_fields",
]

_DEEPEST = 12
_MOST_STEPS = 200_000
"""Types to lay out in a trace: one with all the kernel's events has some 10,000."""


class LayoutError(ValueError):
    """Types that cannot be laid out: an unresolved length or tag, too deep a nesting."""


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


@dataclass(slots=True, eq=False)
class Text:
    """A string that ends with NUL."""

    slot: int = -1
    level: int = 0


@dataclass(slots=True, eq=False)
class Characters:
    """An array or sequence of bytes that is text, up to its first NUL."""

    count: int
    length: Number | None
    slot: int = -1
    level: int = 0


@dataclass(slots=True, eq=False)
class Repeat:
    """An array (``length`` is None) or sequence; ``slot`` takes the length of each sequence."""

    align: int
    count: int
    length: Number | None
    body: list[Step]
    slot: int = -1
    level: int = 0
    inner: int = -1


@dataclass(slots=True, eq=False)
class Choice:
    """A variant: ranges of the tag and the steps behind them; ``slot`` takes 1 + the option."""

    tag: Number
    options: list[tuple[tuple[tuple[int, int], ...], list[Step]]]
    slot: int = -1
    level: int = 0


Step = Align | Number | Text | Characters | Repeat | Choice


Frame = dict[str, "Number | Frame | None"]


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

    def slot(self, level: int, dtype: str) -> int:
        """A new slot's index."""
        self.slots.append(Slot(level, dtype, self.sparse))
        return len(self.slots) - 1

    def register(self, number: Number) -> Number:
        """Have ``number`` kept in a register."""
        if number.register < 0:
            number.register = self.registers
            self.registers += 1
        return number

    def number(self, path: str, frames: list[Frame]) -> Number:
        """The number that a length or tag path names, relative or absolute; kept in a register."""
        for root, frame in self.roots.items():
            if path.startswith(root + "."):
                found = _follow(frame, path[len(root) + 1 :])
                if found is not None:
                    return self.register(found)
        for frame in [*reversed(frames), *reversed(self.roots.values())]:
            found = _follow(frame, path)
            if found is not None:
                return self.register(found)
        raise LayoutError(f"length or tag {path!r} names no number that is read before it")


def _follow(frame: Frame, path: str) -> Number | None:
    found: Number | Frame | None = frame
    for name in path.split("."):
        if not isinstance(found, dict):
            return None
        found = found.get(name)
    return found if isinstance(found, Number) else None


def compile_fields(
    reader: Reader,
    scope: str,
    kind: StructType | None,
    wanted: frozenset[str] | None = frozenset(),
    fixed: bool = False,
) -> tuple[list[Step], tuple[tuple[str, Shape], ...]]:
    """Lay out the structure ``kind`` as the dynamic scope ``scope``.

    ``wanted`` are the TSDL names of the fields that get columns, None for all.  ``fixed`` has
    the numbers of `REGISTERS` kept there, as for packet headers and contexts.  Returns the
    steps and the columns by user's name.  Raises `LayoutError`.
    """
    frame: Frame = {}
    reader.roots[scope] = frame
    if kind is None:
        return [], ()
    steps: list[Step] = [Align(alignment(kind))]
    columns: list[tuple[str, Shape]] = []
    for member in kind.fields:
        keep = wanted is None or member.name in wanted
        if fixed and member.name == "uuid" and _is_uuid(member.type):
            steps += [_half("uuid_low"), _half("uuid_high")]
            continue
        more, shape = _compile(reader, member.name, member.type, [frame], 0, keep)
        steps += more
        if shape is not None:
            columns.append((field_name(member.name), shape))
        if fixed:
            _keep_known(frame, member.name)
    return steps, tuple(columns)


def _keep_known(frame: Frame, name: str) -> None:
    """Give a header's numbers their registers; an event's id may also lie in a variant."""
    found = frame.get(name)
    if isinstance(found, Number) and name in REGISTERS:
        found.register = REGISTERS[name]
        # The end of a packet is no instant that its events follow.
        found.clock = found.clock and name != "timestamp_end"
    elif isinstance(found, dict):
        for inner in found:
            if inner == "id" or isinstance(found[inner], dict):
                _keep_known(found, inner)


def _is_uuid(kind: Type) -> bool:
    return isinstance(kind, ArrayType) and kind.length == 16 and _plain_byte(kind.element)


def _plain_byte(kind: Type) -> bool:
    return isinstance(kind, IntegerType) and kind.size == 8 and kind.align == 8


def _half(name: str) -> Number:
    return Number(size=64, align=8, signed=False, big=False, register=REGISTERS[name])


def _compile(
    reader: Reader, name: str, kind: Type, frames: list[Frame], level: int, keep: bool
) -> tuple[list[Step], Shape | None]:
    reader.steps += 1
    if len(frames) > _DEEPEST or reader.steps > _MOST_STEPS:
        raise LayoutError(f"{name}: types nested too deeply")
    match kind:
        case IntegerType() | EnumType() | FloatType():
            return _number(reader, name, kind, frames, level, keep)
        case StringType():
            slot = reader.slot(level, "u4") if keep else -1
            return [Text(slot, level)], TextShape(slot) if keep else None
        case StructType():
            return _record(reader, name, kind, frames, level, keep)
        case ArrayType() | SequenceType():
            return _repeat(reader, name, kind, frames, level, keep)
        case VariantType():
            return _choice(reader, name, kind, frames, level, keep)


def _number(
    reader: Reader,
    name: str,
    kind: IntegerType | EnumType | FloatType,
    frames: list[Frame],
    level: int,
    keep: bool,
) -> tuple[list[Step], Shape | None]:
    base = kind.container if isinstance(kind, EnumType) else kind
    big = reader.big if base.byte_order == "native" else base.byte_order == "be"
    code = "f" if isinstance(base, FloatType) else "i" if base.signed else "u"
    width = next(width for width in (1, 2, 4, 8) if base.size <= 8 * width)
    slot = reader.slot(level, f"{code}{width}") if keep else -1
    clock = isinstance(base, IntegerType) and base.clock is not None
    number = Number(base.size, base.align, code == "i", big, clock, slot, level)
    number.mappings = kind.mappings if isinstance(kind, EnumType) else ()
    frames[-1][name] = None if isinstance(base, FloatType) else number
    return [number], ScalarShape(slot) if keep else None


def _record(
    reader: Reader, name: str, kind: StructType, frames: list[Frame], level: int, keep: bool
) -> tuple[list[Step], Shape | None]:
    frame: Frame = {}
    frames[-1][name] = frame
    steps: list[Step] = [Align(alignment(kind))]
    columns: list[tuple[str, Shape]] = []
    for member in kind.fields:
        more, shape = _compile(reader, member.name, member.type, [*frames, frame], level, keep)
        steps += more
        if shape is not None:
            columns.append((field_name(member.name), shape))
    return steps, RecordShape(tuple(columns)) if columns else None


def _repeat(
    reader: Reader,
    name: str,
    kind: ArrayType | SequenceType,
    frames: list[Frame],
    level: int,
    keep: bool,
) -> tuple[list[Step], Shape | None]:
    element = kind.element
    count = kind.length if isinstance(kind, ArrayType) else 0
    length = reader.number(kind.length, frames) if isinstance(kind, SequenceType) else None
    if _plain_byte(element) and getattr(element, "encoding", "none") != "none":
        slot = reader.slot(level, "u4") if keep else -1
        return [Characters(count, length, slot, level)], TextShape(slot) if keep else None
    slot = reader.slot(level, "u4") if keep and length is not None else -1
    inner = reader.levels
    reader.levels += keep
    body, shape = _compile(reader, name, element, [*frames, {}], inner, keep)
    repeat = Repeat(alignment(kind), count, length, body, slot, level, inner if keep else -1)
    if all(isinstance(step, Align) for step in body):  # an array of empty structures
        return [Align(repeat.align)], None
    if shape is None:
        return [repeat], None
    return [repeat], ListShape(slot, inner, -1 if length is not None else count, shape)


def _choice(
    reader: Reader, name: str, kind: VariantType, frames: list[Frame], level: int, keep: bool
) -> tuple[list[Step], Shape | None]:
    if kind.tag is None:
        raise LayoutError(f"variant {name!r} has no tag")
    tag = reader.number(kind.tag, frames)
    slot = reader.slot(level, "u2") if keep else -1
    outer, reader.sparse = reader.sparse, True
    ranges_of = _ranges_by_label(reader, tag)
    options: list[tuple[tuple[tuple[int, int], ...], list[Step]]] = []
    columns: list[tuple[str, Shape | None]] = []
    frame: Frame = {}
    frames[-1][name] = frame
    for option in kind.options:
        bare = option.name.removeprefix("_")
        ranges = tuple(ranges_of.get(option.name, []))
        ranges += tuple(ranges_of.get(bare, [])) if bare != option.name else ()
        reader.steps += len(ranges)
        steps, shape = _compile(reader, option.name, option.type, [*frames, frame], level, keep)
        options.append((ranges, steps))
        columns.append((field_name(option.name), shape))
    reader.sparse = outer
    choice = Choice(tag, options, slot, level)
    return [choice], OptionShape(slot, tuple(columns)) if keep else None


def _ranges_by_label(reader: Reader, tag: Number) -> dict[str, list[tuple[int, int]]]:
    """The values that choose each option of a variant; many variants may share one enumeration."""
    found = reader.labels.get(id(tag.mappings))
    if found is None:
        found = reader.labels[id(tag.mappings)] = {}
        for mapping in tag.mappings:
            found.setdefault(mapping.label, []).append((mapping.low, mapping.high))
    return found
