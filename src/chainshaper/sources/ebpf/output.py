"""What the bpftrace script printed, as event tables.

The lines are those that :mod:`~chainshaper.sources.ebpf.script` describes. Others are bpftrace's
own: what it attaches, and how many events it lost, which are counted. Every core has a buffer of
its own, so lines of different cores are in no order; the tables are sorted.
"""

import mmap
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper.sources.ebpf.script import (
    CODE,
    FIRST_POINT,
    NAME_PLACE,
    RMW_PLACE,
    SWITCH_CODE,
    TEXT_CODE,
    VALUES,
)
from chainshaper.sources.ebpf.trace_points import TracePoint
from chainshaper.values import events

__all__ = ["HEADER", "Printed", "lost_events", "read_printed"]

_COMMS = ("prev_comm", "next_comm")
_SCHEMA: dict[str, pl.DataType] = {
    **dict.fromkeys((*CODE, *VALUES), pl.Int64()),
    **dict.fromkeys(_COMMS, pl.String()),
}
HEADER = "\t".join(_SCHEMA) + "\n"
"""What the file begins with that bpftrace prints into: lines may have fewer columns, not more."""

_SWITCH_COLUMNS = ("prev_tid", "prev_prio", "prev_state", "next_tid", "next_prio")
_LOST = re.compile(rb"^Lost (\d+) events", re.MULTILINE)

_Texts = dict[tuple[int, int, int], str]
"""(time, tid, place) → text."""


@dataclass(frozen=True)
class Printed:
    """The output of one run; times are ns of CLOCK_MONOTONIC.

    * ``tables``: the events.
    * ``handles``: ``pid, event, handle, topic``, the names of handles that were in use when
      tracing began; the event is the one that the handle was read from.
    * ``rmw``: the RMW's name from such a handle.
    * ``cut_names``: how many names were longer than what is printed of one.
    """

    tables: dict[str, pl.DataFrame]
    handles: pl.DataFrame
    rmw: str | None
    cut_names: int


def lost_events(*paths: Path) -> int:
    """How many events bpftrace says it has lost, in what it wrote into these files."""
    count = 0
    for path in paths:
        if path.is_file() and path.stat().st_size:
            with (
                path.open("rb") as stream,
                mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as said,
            ):
                count += sum(int(found[1]) for found in _LOST.finditer(said))
    return count


def read_printed(path: Path, points: Sequence[TracePoint], ahead_ns: int) -> Printed:
    """Read the file that the script of these trace points printed into, behind :data:`HEADER`.

    ``ahead_ns`` is CLOCK_BOOTTIME, which bpftrace reads, minus CLOCK_MONOTONIC.
    """
    lines = _lines(path).with_columns(pl.col("time") - ahead_ns)
    texts, cut_names = _texts(lines.filter(code=TEXT_CODE))
    parts: dict[str, list[pl.DataFrame]] = {}
    for code, point in enumerate(points, FIRST_POINT):
        rows = lines.filter(code=code)
        if rows.height:
            parts.setdefault(point.event, []).append(_table(rows, point, texts))
    switches = lines.filter(code=SWITCH_CODE)
    if switches.height:
        named = dict(zip(_SWITCH_COLUMNS, VALUES, strict=False))
        parts["sched_switch"] = [_typed(switches, "sched_switch", named | {c: c for c in _COMMS})]
    tables = {
        event: pl.concat(tables, how="diagonal").sort("time", maintain_order=True)
        for event, tables in parts.items()
    }
    handles = _handles(lines, points, texts)
    rmw = next((text for (_, _, place), text in texts.items() if place == RMW_PLACE), None)
    return Printed(tables, handles, rmw, cut_names)


def _lines(path: Path) -> pl.DataFrame:
    """Our lines as rows; bpftrace's own have no number in front."""
    lines = pl.read_csv(
        path,
        separator="\t",
        quote_char=None,
        schema=_SCHEMA,
        truncate_ragged_lines=True,
        ignore_errors=True,
        encoding="utf8-lossy",
    )
    with path.open("rb") as stream:
        stream.seek(-1, 2)
        if stream.read() != b"\n":  # bpftrace was killed while it wrote
            lines = lines.head(-1)
    return lines.drop_nulls(CODE)


def _texts(lines: pl.DataFrame) -> tuple[_Texts, int]:
    """The texts, put together from their words, and how many of them are cut."""
    key = ["time", "tid", "place", "line"]
    lines = lines.with_columns(place=pl.col(VALUES[0]) // 16, line=pl.col(VALUES[0]) % 16)
    lines = lines.sort(key)
    words = lines.select(VALUES[2:]).fill_null(0).to_numpy().astype("<i8")
    parts: dict[tuple[int, int, int], bytes] = {}
    for row, (time, tid, place, line, skipped) in enumerate(
        lines.select(*key, VALUES[1]).iter_rows()
    ):
        before = parts.get((time, tid, place), b"")
        here = line * words[row].nbytes - (skipped if line else 0)
        if b"\0" not in before and here == len(before):  # else it has ended, or a line was lost
            part = words[row].tobytes()
            parts[time, tid, place] = before + (part if line else part[skipped:])
    ended = {key: part.partition(b"\0") for key, part in parts.items()}
    texts = {key: text.decode(errors="replace") for key, (text, _, _) in ended.items()}
    return texts, sum(not end for _, end, _ in ended.values())


def _table(rows: pl.DataFrame, point: TracePoint, texts: _Texts) -> pl.DataFrame:
    """The table of one trace point's rows."""
    sources: dict[str, str | pl.Series] = {}
    free = iter(VALUES)
    for argument in point.arguments:
        match argument.kind:
            case "text":
                keys = rows.select("time", "tid").iter_rows()
                names = [texts.get((time, tid, argument.place)) for time, tid in keys]
                sources[argument.column] = pl.Series(argument.column, names, dtype=pl.String)
            case "gid":
                sources[argument.column] = _gids(rows[next(free)], rows[next(free)])
            case _:
                sources[argument.column] = next(free)
    table = _typed(rows, point.event, sources)
    if point.event == "rcl_init":
        table = table.with_columns(version=pl.lit(point.version, dtype=pl.String))
    return table


def _typed(
    rows: pl.DataFrame, event: str, sources: dict[str, str] | dict[str, str | pl.Series]
) -> pl.DataFrame:
    """The rows' values under the columns' names and types."""
    types = {**events.COMMON_COLUMNS, **events.FIELDS[event]}
    columns = {name: name for name in events.COMMON_COLUMNS} | sources
    return rows.select(
        (pl.col(source) if isinstance(source, str) else pl.lit(source))
        .cast(types[column])
        .alias(column)
        for column, source in columns.items()
    )


def _gids(first: pl.Series, second: pl.Series) -> pl.Series:
    words = np.column_stack([first.to_numpy(), second.to_numpy()]).astype("<i8")
    return pl.Series([list(word.tobytes()) for word in words], dtype=pl.List(pl.UInt8))


def _handles(lines: pl.DataFrame, points: Sequence[TracePoint], texts: _Texts) -> pl.DataFrame:
    """Whose names were read at which event: ``pid, event, handle, topic``."""
    named = pl.DataFrame(
        [(time, tid, name) for (time, tid, place), name in texts.items() if place == NAME_PLACE],
        schema={"time": pl.Int64, "tid": pl.Int64, "topic": pl.String},
        orient="row",
    )
    event_of = {code: point.event for code, point in enumerate(points, FIRST_POINT)}
    return (
        lines.filter(pl.col("code").is_in(list(event_of)))
        .join(named, on=["time", "tid"])
        .select(
            pl.col("pid").cast(pl.Int32),
            pl.col("code").replace_strict(event_of, return_dtype=pl.String).alias("event"),
            pl.col(VALUES[0]).cast(pl.UInt64).alias("handle"),
            "topic",
        )
        .unique(maintain_order=True)
    )
