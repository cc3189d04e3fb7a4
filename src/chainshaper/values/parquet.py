"""Tables of integers as Parquet files, quickly: most events have nothing else.

Parquet knows a packing of differences that suits them (`core/columns/delta_packing.hpp`): as small
as what Polars writes, which has no choice of packings, and several times as fast. Any reader of
Parquet reads it (apache/parquet-format: README.md, src/main/thrift/parquet.thrift; the descriptions
of a file and its pages are in Thrift's compact protocol).
"""

from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper import _core

GROUP_ROWS = 1 << 18  # a reader may take groups of rows one by one
MAGIC = b"PAR1"

# Of Thrift, and of Parquet: types, a repetition, encodings, a converted type.
_BOOL_FALSE, _BYTE, _I32, _I64, _BINARY, _LIST, _STRUCT = 2, 3, 5, 6, 8, 9, 12
_PARQUET_TYPES: dict[pl.DataType, int] = {pl.Int32(): 1, pl.Int64(): 2, pl.UInt64(): 2}
_REQUIRED, _RLE, _DELTA_BINARY_PACKED, _UINT_64 = 0, 3, 5, 14


def is_packable(frame: pl.DataFrame) -> bool:
    """Whether a table has integers only, and some of them, and none is null."""
    packable = all(kind in _PARQUET_TYPES for kind in frame.dtypes)
    return packable and frame.height > 0 and not any(column.null_count() for column in frame)


Page: TypeAlias = tuple[bytes, bytes]  # what is said of values, and the values
Pages: TypeAlias = dict[tuple[int, int, str], tuple[npt.NDArray[Any], Page]]
"""Columns that are packed already, by their place in memory, length and type; they are kept, since
their place would be another's as soon as nobody had them."""


def packed(frame: pl.DataFrame, known: Pages) -> list[bytes]:
    """The Parquet file of a table that :func:`is_packable`, in parts.

    Events of the same instants have columns in common: what is ``known`` is not packed again.
    """
    parts, size, groups = [MAGIC], len(MAGIC), []
    for first in range(0, frame.height, GROUP_ROWS):
        rows, before = frame.slice(first, GROUP_ROWS), size
        chunks = []
        for column in rows:
            page = _page(column, known)
            length = sum(map(len, page))
            chunks.append(_chunk(column, size, length))
            parts += page
            size += length
        groups.append(
            _struct(
                (1, _LIST, _list(_STRUCT, chunks)),
                (2, _I64, _int(size - before)),
                (3, _I64, _int(rows.height)),
            )
        )
    about = _struct(
        (1, _I32, _int(1)),
        (2, _LIST, _list(_STRUCT, list(_schema(frame)))),
        (3, _I64, _int(frame.height)),
        (4, _LIST, _list(_STRUCT, groups)),
        (6, _BINARY, _text("chainshaper")),
    )
    return [*parts, about, len(about).to_bytes(4, "little"), MAGIC]


def _page(column: pl.Series, known: Pages) -> Page:
    """A column's values, and in front what is said of them."""
    if column.n_chunks() > 1:  # their copy is nobody else's
        return _packed_page(column.rechunk().to_numpy())
    values = column.to_numpy(allow_copy=False)
    key = (values.__array_interface__["data"][0], len(values), values.dtype.str)
    if key not in known:
        known[key] = values, _packed_page(values)
    return known[key][1]


def _packed_page(values: npt.NDArray[Any]) -> Page:
    content = _core.delta_packed(values.view(np.int64) if values.dtype == np.uint64 else values)
    header = _struct(
        (1, _I32, _int(0)),  # a page of data
        (2, _I32, _int(len(content))),
        (3, _I32, _int(len(content))),
        (
            5,
            _STRUCT,
            _struct(
                (1, _I32, _int(len(values))),
                (2, _I32, _int(_DELTA_BINARY_PACKED)),
                (3, _I32, _int(_RLE)),
                (4, _I32, _int(_RLE)),
            ),
        ),
    )
    return header, content


def _chunk(column: pl.Series, offset: int, size: int) -> bytes:
    """What a file says of a column's values in a group of rows: where they are, and how."""
    return _struct(
        (2, _I64, _int(offset)),
        (
            3,
            _STRUCT,
            _struct(
                (1, _I32, _int(_PARQUET_TYPES[column.dtype])),
                (2, _LIST, _list(_I32, [_int(_DELTA_BINARY_PACKED)])),
                (3, _LIST, _list(_BINARY, [_text(column.name)])),
                (4, _I32, _int(0)),  # not compressed
                (5, _I64, _int(len(column))),
                (6, _I64, _int(size)),
                (7, _I64, _int(size)),
                (9, _I64, _int(offset)),
            ),
        ),
    )


def _schema(frame: pl.DataFrame) -> Iterator[bytes]:
    """The root, and each column."""
    yield _struct((4, _BINARY, _text("root")), (5, _I32, _int(frame.width)))
    for column in frame:
        unsigned = _struct((10, _STRUCT, _struct((1, _BYTE, b"\x40"), (2, _BOOL_FALSE, b""))))
        further = ((6, _I32, _int(_UINT_64)), (10, _STRUCT, unsigned))
        yield _struct(
            (1, _I32, _int(_PARQUET_TYPES[column.dtype])),
            (3, _I32, _int(_REQUIRED)),
            (4, _BINARY, _text(column.name)),
            *(further if column.dtype == pl.UInt64() else ()),
        )


def _struct(*fields: tuple[int, int, bytes]) -> bytes:
    """Fields, each with its number, which ascend, its type and its value."""
    found, before = bytearray(), 0
    for number, kind, value in fields:
        found.append((number - before) << 4 | kind)
        found += value
        before = number
    return bytes(found) + b"\0"


def _list(kind: int, values: list[bytes]) -> bytes:
    count = len(values)
    begin = bytes([count << 4 | kind]) if count < 15 else bytes([0xF0 | kind]) + _unsigned(count)
    return begin + b"".join(values)


def _text(text: str) -> bytes:
    encoded = text.encode()
    return _unsigned(len(encoded)) + encoded


def _int(value: int) -> bytes:
    return _unsigned(value << 1)  # none is negative


def _unsigned(value: int) -> bytes:
    found = bytearray()
    while value >= 128:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])
