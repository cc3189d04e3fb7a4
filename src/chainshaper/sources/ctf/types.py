"""What a trace's metadata says: field types, event, stream and trace classes (CTF 1.8).

All of it is immutable plain data. Names stay as TSDL writes them, with LTTng's leading underscore;
`field_name` gives the name that users see. Sizes and alignments are in bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from chainshaper.values.errors import InputError

ByteOrder = Literal["native", "le", "be"]
Encoding = Literal["none", "utf8", "ascii"]


class CtfError(InputError):
    """A trace that cannot be read: which file or folder, where in it (bytes), why, what to do."""

    def __init__(self, path: Path | str, offset: int | None, reason: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.offset = offset
        self.reason = reason
        place = f"{path}" if offset is None else f"{path}, byte {offset}"
        super().__init__(f"{place}: {reason}" + (f" ({remedy})" if remedy else ""))


@dataclass(frozen=True, slots=True)
class IntegerType:
    """``integer { … }`` (section 4.1.5); ``clock`` is the name of the clock it is mapped to."""

    size: int
    align: int
    signed: bool = False
    byte_order: ByteOrder = "native"
    encoding: Encoding = "none"
    clock: str | None = None


@dataclass(frozen=True, slots=True)
class FloatType:
    """``floating_point { … }`` (section 4.1.7), IEEE 754 of 32 or 64 bits."""

    size: int
    align: int
    byte_order: ByteOrder = "native"


@dataclass(frozen=True, slots=True)
class EnumMapping:
    """One label of an enumeration and the closed range of values that carry it."""

    label: str
    low: int
    high: int


@dataclass(frozen=True, slots=True)
class EnumType:
    """``enum : container { … }`` (section 4.1.8); ranges may overlap."""

    container: IntegerType
    mappings: tuple[EnumMapping, ...]


@dataclass(frozen=True, slots=True)
class StringType:
    """``string`` (section 4.2.5): bytes up to and including the first NUL."""

    encoding: Encoding = "utf8"


@dataclass(frozen=True, slots=True)
class ArrayType:
    """``T name[length]`` (section 4.2.3)."""

    element: Type
    length: int


@dataclass(frozen=True, slots=True)
class SequenceType:
    """``T name[path]`` (section 4.2.4); ``length`` is the path as written, ``a.b.c``."""

    element: Type
    length: str


@dataclass(frozen=True, slots=True)
class Field:
    """A named member of a structure or option of a variant."""

    name: str
    type: Type


@dataclass(frozen=True, slots=True)
class StructType:
    """``struct { … } align(n)`` (section 4.2.1); ``align`` is at least ``n`` and each field's."""

    fields: tuple[Field, ...] = ()
    align: int = 1


@dataclass(frozen=True, slots=True)
class VariantType:
    """``variant <tag> { … }`` (section 4.2.2); ``tag`` is the path as written or ``None``."""

    tag: str | None
    options: tuple[Field, ...]


Type = (
    IntegerType
    | FloatType
    | EnumType
    | StringType
    | ArrayType
    | SequenceType
    | StructType
    | VariantType
)


@dataclass(frozen=True, slots=True)
class Clock:
    """``clock { … }`` (section 8): ``frequency`` in Hz, ``offset_ns`` from the Epoch, exact."""

    name: str
    frequency: int = 1_000_000_000
    offset_ns: int = 0
    uuid: str | None = None


@dataclass(frozen=True, slots=True)
class EventClass:
    """``event { … }`` (section 7.2)."""

    id: int
    name: str
    context: StructType | None = None
    fields: StructType | None = None


@dataclass(frozen=True, slots=True)
class StreamClass:
    """``stream { … }`` (section 7.2) with its event classes by id."""

    id: int
    packet_context: StructType | None = None
    event_header: StructType | None = None
    event_context: StructType | None = None
    events: Mapping[int, EventClass] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TraceClass:
    """Everything one ``metadata`` file declares."""

    byte_order: Literal["le", "be"]
    uuid: str | None
    packet_header: StructType | None
    env: Mapping[str, str | int]
    clocks: Mapping[str, Clock]
    streams: Mapping[int, StreamClass]


@dataclass(frozen=True)
class CtfFolder:
    """A folder with a ``metadata`` file: what it declares, and its clock (1 GHz without one)."""

    path: Path
    declared: TraceClass = field(repr=False)

    @property
    def clock(self) -> Clock:
        return next(iter(self.declared.clocks.values()), Clock("none"))


def field_name(name: str) -> str:
    """The name users see: TSDL's without one leading underscore, as babeltrace2 shows it."""
    return name[1:] if name.startswith("_") and len(name) > 1 else name


def alignment(kind: Type) -> int:
    """The alignment of a type in bits (section 4.1.2, 4.2); a variant has none of its own."""
    match kind:
        case IntegerType(align=align) | FloatType(align=align) | StructType(align=align):
            return align
        case EnumType(container=container):
            return container.align
        case StringType():
            return 8
        case ArrayType(element=element) | SequenceType(element=element):
            return alignment(element)
        case VariantType():
            return 1
