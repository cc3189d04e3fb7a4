"""Packed tables of integers: other readers of Parquet read them, bit for bit."""

import io
import random
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import polars as pl
import pytest

from chainshaper import _core
from chainshaper.values import parquet

LIMITS = {
    pl.Int32(): (-(2**31), 2**31 - 1),
    pl.Int64(): (-(2**63), 2**63 - 1),
    pl.UInt64(): (0, 2**64 - 1),
}


def read(parts: list[bytes]) -> pl.DataFrame:
    return pl.read_parquet(io.BytesIO(b"".join(parts)))


@pytest.mark.parametrize("rows", [1, 2, 32, 33, 128, 129, 130, 1000, 4097])
def test_polars_reads_what_was_packed(rows: int) -> None:
    draw = random.Random(rows)
    series = []
    for kind, (low, high) in LIMITS.items():
        for bits in (0, 1, 7, 31, 33, 63, 64):
            least, most = max(low, -(2**bits)), min(high, 2**bits)
            values = [draw.randint(least, most) for _ in range(rows)]
            values[draw.randrange(rows)] = draw.choice((low, high))
            series.append(pl.Series(f"{kind} {bits}", values, dtype=kind))
        series.append(pl.Series(f"{kind} ascends", range(rows), dtype=kind))
        series.append(pl.Series(f"{kind} constant", [high] * rows, dtype=kind))
    frame = pl.DataFrame(series)
    assert parquet.is_packable(frame)
    assert read(parquet.packed(frame, parquet.PackedColumns())).equals(frame)


def test_groups_of_rows_and_chunks_are_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "GROUP_ROWS", 100)
    part = pl.DataFrame({"time": range(170), "µ": [2] * 170}).cast({"µ": pl.Int32()})
    frame = pl.concat([part, part.with_columns(pl.col("time") + 1000)], rechunk=False)
    columns = parquet.PackedColumns()
    assert read(parquet.packed(frame, columns)).equals(frame)
    content = parquet.packed(part, columns)
    assert read(content).equals(part)
    assert parquet.packed(part.select("time", "µ"), columns) == content
    assert pl.scan_parquet(io.BytesIO(b"".join(content))).select("µ").collect().height == 170


def test_columns_that_come_and_go_are_not_taken_for_each_other() -> None:
    columns = parquet.PackedColumns()
    for number in range(200):  # as Polars has it, a constant is an array only while it is looked at
        frame = pl.DataFrame({"time": range(5), "pid": number})
        assert read(parquet.packed(frame, columns)).equals(frame)
        del frame


def test_threads_share_columns() -> None:
    columns = parquet.PackedColumns()
    table = pl.DataFrame({"time": range(100_000), "tid": 7})
    tables = [table.with_columns(pl.lit(number).alias("handle")) for number in range(8)]
    with ThreadPoolExecutor(4) as threads:
        files = list(threads.map(lambda frame: parquet.packed(frame, columns), tables))
    assert all(read(file).equals(frame) for file, frame in zip(files, tables, strict=True))


def test_other_tables_are_left_to_polars() -> None:
    assert not parquet.is_packable(pl.DataFrame({"a": [1, None]}))
    assert not parquet.is_packable(pl.DataFrame({"a": ["1"]}))
    assert not parquet.is_packable(pl.DataFrame({"a": [1]}).clear())


def test_numbers_are_packed_as_parquet_says() -> None:
    # Of apache/parquet-format, Encodings.md: 1, 2, 3, 4, 5 and 7, 5, 3, 1, 2, 3, 4, 5, with its
    # own sizes of blocks; the first bytes are 128 values in 4 parts, how many, and the first.
    assert _core.delta_packed(np.arange(1, 6)) == bytes([128, 1, 4, 5, 2, 2, 0, 0, 0, 0])
    packed = _core.delta_packed(np.array([7, 5, 3, 1, 2, 3, 4, 5]))
    assert packed == bytes([128, 1, 4, 8, 14, 3, 2, 0, 0, 0, 0xC0, 0x3F, 0, 0, 0, 0, 0, 0])
