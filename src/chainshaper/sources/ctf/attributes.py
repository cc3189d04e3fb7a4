"""The types that attributes describe: ``integer``, ``floating_point`` and ``string`` (CTF 1.8,
sections 4.1.5, 4.1.7 and 4.2.5).

Attributes are the ``name = value;`` pairs between braces, read by
`declarations.Parser.attributes`.
"""

from collections.abc import Mapping
from typing import TypeVar

from chainshaper.sources.ctf.tokens import TsdlError
from chainshaper.sources.ctf.types import ByteOrder, Encoding, FloatType, IntegerType, StringType

__all__ = [
    "Attributes",
    "Value",
    "checked_alignment",
    "float_type",
    "integer_type",
    "string_type",
]

Value = int | str

Attributes = dict[str, tuple[Value, int]]
"""Name → value and its character offset."""

_T = TypeVar("_T")
_BYTE_ORDERS: dict[Value, ByteOrder] = {
    "le": "le",
    "be": "be",
    "network": "be",
    "native": "native",
}
_SIGNED: dict[Value, bool] = {
    0: False,
    "false": False,
    "FALSE": False,
    1: True,
    "true": True,
    "TRUE": True,
}
_BASES: dict[Value, int] = {
    **dict.fromkeys(("decimal", "dec", "d", "i", "u", 10), 10),
    **dict.fromkeys(("hexadecimal", "hex", "x", "X", "p", 16), 16),
    **dict.fromkeys(("octal", "oct", "o", 8), 8),
    **dict.fromkeys(("binary", "b", 2), 2),
}
_ENCODINGS: dict[Value, Encoding] = {"none": "none", "utf8": "utf8", "ascii": "ascii"}


def checked_alignment(align: int, offset: int) -> int:
    """``align`` in bits, if it is one; else `TsdlError`."""
    if not 0 < align <= 1 << 20 or align & (align - 1):
        raise TsdlError(offset, f"alignment {align} is not a power of two")
    return align


def integer_type(found: Attributes, offset: int) -> IntegerType:
    """``integer { … }``, which begins at character ``offset``; raises `TsdlError`."""
    size = _number(found, "size", 0)
    if not 0 < size <= 64:
        raise TsdlError(offset, f"integer of {size} bits; 1 to 64 are supported")
    _one_of(_BASES, found, "base", 10)  # how a person would like to see it
    return IntegerType(
        size=size,
        align=checked_alignment(_number(found, "align", 1 if size % 8 else 8), offset),
        signed=_one_of(_SIGNED, found, "signed", 0),
        byte_order=_one_of(_BYTE_ORDERS, found, "byte_order", "native"),
        encoding=_encoding(found, "none"),
        clock=_clock(found),
    )


def _clock(found: Attributes) -> str | None:
    if "map" not in found:
        return None
    target, offset = found["map"]
    parts = str(target).split(".")
    if len(parts) != 3 or parts[0] != "clock" or parts[2] != "value":
        raise TsdlError(offset, f"map must be clock.NAME.value, not {target!r}")
    return parts[1]


def float_type(found: Attributes, offset: int) -> FloatType:
    """``floating_point { … }``, which begins at character ``offset``; raises `TsdlError`."""
    exponent, mantissa = _number(found, "exp_dig", 0), _number(found, "mant_dig", 0)
    if (exponent, mantissa) not in ((8, 24), (11, 53)):
        raise TsdlError(
            offset, f"floating point of {exponent} + {mantissa} bits; IEEE 32 or 64 supported"
        )
    align = checked_alignment(_number(found, "align", 8), offset)
    return FloatType(
        exponent + mantissa, align, _one_of(_BYTE_ORDERS, found, "byte_order", "native")
    )


def string_type(found: Attributes) -> StringType:
    """``string``, with or without attributes; raises `TsdlError`."""
    return StringType(_encoding(found, "utf8"))


def _number(found: Attributes, name: str, default: int) -> int:
    value, offset = found.get(name, (default, 0))
    if not isinstance(value, int):
        raise TsdlError(offset, f"{name} must be an integer, not {value!r}")
    return value


def _one_of(choices: Mapping[Value, _T], found: Attributes, name: str, default: Value) -> _T:
    value, offset = found.get(name, (default, 0))
    if value not in choices:
        known = ", ".join(map(str, choices))
        raise TsdlError(offset, f"unknown {name.replace('_', ' ')} {value!r}: none of {known}")
    return choices[value]


def _encoding(found: Attributes, default: Encoding) -> Encoding:
    plain: Attributes = {
        name: (str(value).lower().replace("-", "").replace("_", ""), offset)
        for name, (value, offset) in found.items()
    }
    return _one_of(_ENCODINGS, plain, "encoding", default)
