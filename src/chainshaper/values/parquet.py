"""Tables of integers as Parquet files, quickly: most events have nothing else.

Polars writes them with compressed plain values, and cannot be asked for another encoding. Parquet
has one that suits events, DELTA_BINARY_PACKED (`core/columns/delta_packing.hpp`): the files are
about as large, and take a fraction of the time. Events of the same instants (`rclcpp_publish`,
`rcl_publish`, `rmw_publish`) have columns in common, which are packed once.

Any reader of Parquet reads such files. Their form: apache/parquet-format, README.md and
src/main/thrift/parquet.thrift; what a file says of itself is in Thrift's compact protocol. Tables
with texts, lists or nulls are left to Polars (:func:`is_packable`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from threading import Lock
from typing import Any

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


@dataclass(frozen=True)
class Page:
    """The packed values of a column, as they stand in a file."""

    header: bytes  # what the file says of the values
    content: bytes

    @property
    def size(self) -> int:
        """Bytes of both."""
        return len(self.header) + len(self.content)


class PackedColumns:
    """Columns that were packed already, for tables that have columns in common.

    They are known by their place in memory, length and type. Their values are referred to, since
    their place would be another column's as soon as they were freed. Threads may share this.
    """

    def __init__(self) -> None:
        self._pages: dict[tuple[int, int, str], tuple[npt.NDArray[Any], Page]] = {}
        self._lock = Lock()

    def page(self, column: pl.Series) -> Page:
        """The page of a column, packed at the first time."""
        if column.n_chunks() > 1:  # their copy is in no other table
            return _packed_page(column.rechunk().to_numpy())
        values = column.to_numpy(allow_copy=False)
        key = (values.__array_interface__["data"][0], len(values), values.dtype.str)
        with self._lock:  # a thread that wants the same column waits, and has not to pack it
            if key not in self._pages:
                self._pages[key] = values, _packed_page(values)
            return self._pages[key][1]


def packed(frame: pl.DataFrame, columns: PackedColumns) -> list[bytes]:
    """The Parquet file of a table that :func:`is_packable`, in parts that follow each other.

    What ``columns`` has is not packed again.
    """
    parts, size, groups = [MAGIC], len(MAGIC), []
    for first in range(0, frame.height, GROUP_ROWS):
        rows, size_before = frame.slice(first, GROUP_ROWS), size
        chunks = []
        for column in rows:
            page = columns.page(column)
            chunks.append(_chunk(column, offset=size, size=page.size))
            parts += [page.header, page.content]
            size += page.size
        groups.append(
            _struct(
                (1, _LIST, _list(_STRUCT, chunks)),
                (2, _I64, _int(size - size_before)),
                (3, _I64, _int(rows.height)),
            )
        )
    footer = _struct(
        (1, _I32, _int(1)),
        (2, _LIST, _list(_STRUCT, list(_schema(frame)))),
        (3, _I64, _int(frame.height)),
        (4, _LIST, _list(_STRUCT, groups)),
        (6, _BINARY, _text("chainshaper")),
    )
    return [*parts, footer, len(footer).to_bytes(4, "little"), MAGIC]


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
    return Page(header, content)


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
    content, number_before = bytearray(), 0
    for number, kind, value in fields:
        content.append((number - number_before) << 4 | kind)
        content += value
        number_before = number
    return bytes(content) + b"\0"


def _list(kind: int, values: list[bytes]) -> bytes:
    """Values of one type, behind their number and that type."""
    count = len(values)
    begin = bytes([count << 4 | kind]) if count < 15 else bytes([0xF0 | kind]) + _unsigned(count)
    return begin + b"".join(values)


def _text(text: str) -> bytes:
    """A text in UTF-8, behind its length."""
    encoded = text.encode()
    return _unsigned(len(encoded)) + encoded


def _int(value: int) -> bytes:
    """A signed number, which is not negative here: signs alternate, so it is doubled."""
    return _unsigned(value << 1)


def _unsigned(value: int) -> bytes:
    """A number in as many bytes as it needs, seven bits in each, the lowest first."""
    content = bytearray()
    while value >= 128:
        content.append(value & 127 | 128)
        value >>= 7
    return bytes([*content, value])
