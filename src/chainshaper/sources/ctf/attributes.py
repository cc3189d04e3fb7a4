"""The types that attributes describe: ``integer``, ``floating_point`` and ``string`` (CTF 1.8,
sections 4.1.5, 4.1.7 and 4.2.5).

Attributes are the ``name = value;`` pairs between braces, read by
`declarations.Parser.attributes`.
"""

from __future__ import annotations

from chainshaper.sources.ctf.types import ByteOrder, FloatType, IntegerType, StringType

__all__ = [
    "Attributes",
    "TsdlError",
    "Value",
    "checked_alignment",
    "float_type",
    "integer_type",
    "string_type",
]

Value = int | str

Attributes = dict[str, tuple[Value, int]]
"""Name → value and its character offset."""

_BYTE_ORDERS: dict[str, ByteOrder] = {
    "le": "le",
    "be": "be",
    "network": "be",
    "native": "native",
}
_BASES = {"decimal": 10, "dec": 10, "d": 10, "i": 10, "u": 10, "hexadecimal": 16, "hex": 16}
_BASES |= {"x": 16, "X": 16, "p": 16, "octal": 8, "oct": 8, "o": 8, "binary": 2, "b": 2}


class TsdlError(ValueError):
    """Metadata that is no TSDL; ``args`` are the character offset and the reason."""


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
    signed, signed_at = found.get("signed", (0, 0))
    if signed not in (0, 1, "true", "false", "TRUE", "FALSE"):
        raise TsdlError(signed_at, f"signed must be true or false, not {signed!r}")
    base, base_at = found.get("base", (10, 0))
    base = _BASES.get(base, base) if isinstance(base, str) else base
    if base not in (2, 8, 10, 16):
        raise TsdlError(base_at, f"unknown base {base!r}")
    return IntegerType(
        size=size,
        align=checked_alignment(_number(found, "align", 1 if size % 8 else 8), offset),
        signed=signed in (1, "true", "TRUE"),
        byte_order=_byte_order(found),
        base=int(base),
        encoding=_encoding(found),  # type: ignore[arg-type]
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
    return FloatType(exponent + mantissa, align, _byte_order(found))


def string_type(found: Attributes) -> StringType:
    """``string``, with or without attributes; raises `TsdlError`."""
    encoding = _encoding(found) if "encoding" in found else "utf8"
    return StringType(encoding)  # type: ignore[arg-type]


def _number(found: Attributes, name: str, default: int) -> int:
    value, offset = found.get(name, (default, 0))
    if not isinstance(value, int):
        raise TsdlError(offset, f"{name} must be an integer, not {value!r}")
    return value


def _byte_order(found: Attributes) -> ByteOrder:
    value, offset = found.get("byte_order", ("native", 0))
    if value not in _BYTE_ORDERS:
        raise TsdlError(offset, f"unknown byte order {value!r}")
    return _BYTE_ORDERS[str(value)]


def _encoding(found: Attributes) -> str:
    value, offset = found.get("encoding", ("none", 0))
    encoding = str(value).lower().replace("-", "").replace("_", "")
    if encoding not in ("none", "utf8", "ascii"):
        raise TsdlError(offset, f"unknown encoding {value!r}")
    return encoding
