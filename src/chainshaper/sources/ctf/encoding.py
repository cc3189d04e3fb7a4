"""Values to bits, by the types of a trace's metadata: the reverse of decoding, for the writer.

Values are plain Python: int, float, str, list for arrays and sequences, mapping (by the names
users see) for structures, (option name, value) for variants.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from chainshaper.sources.ctf.types import (
    ArrayType,
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

__all__ = ["Bits", "encode"]


@dataclass
class Bits:
    """Bytes being filled bit by bit; ``position`` in bits, ``big`` the trace's byte order.

    ``clocks`` and ``names`` note the bit positions of 64-bit clock values (members of the
    outermost structures that ``stamps`` names count as such) and of the integer members of the
    outermost structures.
    """

    big: bool
    data: bytearray = field(default_factory=bytearray)
    position: int = 0
    clocks: list[int] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)
    stamps: frozenset[str] = frozenset()

    def align(self, bits: int) -> None:
        """Advance to a multiple of ``bits``."""
        self.position += -self.position % bits
        self._reserve()

    def _reserve(self) -> None:
        missing = -(-self.position // 8) - len(self.data)
        if missing > 0:
            self.data += bytes(missing)

    def integer(self, value: int, size: int, big: bool) -> None:
        """Write ``size`` bits at the position; raises ValueError where they cannot hold it."""
        if not -(1 << size - 1) <= value < 1 << size:
            raise ValueError(f"{value} does not fit {size} bits")
        value &= (1 << size) - 1
        first, shift = divmod(self.position, 8)
        self.position += size
        self._reserve()
        if shift == 0 and size % 8 == 0:
            order: Literal["big", "little"] = "big" if big else "little"
            self.data[first : first + size // 8] = value.to_bytes(size // 8, order)
            return
        count = len(self.data) - first
        around = int.from_bytes(self.data[first:], "big" if big else "little")
        around |= value << (8 * count - shift - size if big else shift)
        self.data[first:] = around.to_bytes(count, "big" if big else "little")

    def raw(self, data: bytes) -> None:
        """Write bytes at the next whole byte."""
        self.align(8)
        first = self.position // 8
        self.position += 8 * len(data)
        self._reserve()
        self.data[first : first + len(data)] = data


def encode(bits: Bits, kind: Type, value: Any, name: str = "", depth: int = 0) -> None:
    """Append ``value`` as ``kind``; raises ValueError or KeyError where it does not fit."""
    match kind:
        case IntegerType() | EnumType():
            _integer(bits, kind, value, name, depth)
        case FloatType(size=size, align=align, byte_order=order):
            bits.align(align)
            packed = struct.pack("<d" if size == 64 else "<f", value)
            big = bits.big if order == "native" else order == "be"
            bits.integer(int.from_bytes(packed, "little"), size, big)
        case StringType():
            bits.raw((value.encode() if isinstance(value, str) else value) + b"\0")
        case StructType():
            bits.align(alignment(kind))
            for member in kind.fields:
                shown = field_name(member.name)
                inside = member.type
                empty = isinstance(inside, StructType) and not inside.fields
                encode(bits, inside, {} if empty else value[shown], shown, depth + 1)
        case VariantType(options=options):
            chosen, inside_value = value
            option = next(o for o in options if field_name(o.name) == chosen)
            encode(bits, option.type, inside_value, chosen, depth + 1)
        case ArrayType() | SequenceType():
            _array(bits, kind, value, depth)


def _integer(bits: Bits, kind: IntegerType | EnumType, value: Any, name: str, depth: int) -> None:
    number = kind.container if isinstance(kind, EnumType) else kind
    if isinstance(kind, EnumType) and isinstance(value, str):
        value = next(m.low for m in kind.mappings if m.label == value)
    bits.align(number.align)
    is_stamp = depth == 1 and name in bits.stamps
    if (number.clock is not None or is_stamp) and number.size == 64:
        bits.clocks.append(bits.position)
    if depth == 1:
        bits.names[name] = bits.position
    if number.clock is not None:
        value &= (1 << number.size) - 1
    big = bits.big if number.byte_order == "native" else number.byte_order == "be"
    bits.integer(value, number.size, big)


def _array(bits: Bits, kind: ArrayType | SequenceType, value: Any, depth: int) -> None:
    bits.align(alignment(kind))
    element = kind.element
    if isinstance(value, str):
        value = value.encode()
    if isinstance(kind, ArrayType):
        if isinstance(value, bytes):
            value = value.ljust(kind.length, b"\0")
        if len(value) != kind.length:
            raise ValueError(f"{len(value)} elements for an array of {kind.length}")
    if isinstance(value, Mapping):
        raise ValueError("an array needs a list")
    signed = isinstance(element, IntegerType) and element.signed
    for item in value:
        encode(bits, element, item - 256 if signed and item > 127 else item, "", depth + 1)
