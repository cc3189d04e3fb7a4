"""The log of a shaping node, comma-separated values, as the event table ``gate_release``."""

import contextlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.robot.gate_log import LOG_COLUMNS
from chainshaper.robot.shaper import STALL_NS
from chainshaper.values import events
from chainshaper.values.errors import InputError

_LATER = ("dropped", "lost", "row", "moved")
"""Columns that older logs do not have: since then messages may wait at a gate, and slots move."""
_TYPES = events.column_types("gate_release")


def read_gate_log(path: str | Path) -> pl.DataFrame:
    """Return the event table ``gate_release`` of a shaping node's log, and of ``….1``, by time.

    ``callback`` is null. A last line that is not whole is left out. Raises InputError: no such
    file, or it is no shaping node's log.
    """
    path = Path(path)
    # Rows have numbers: where two are equal, it is one row, in a log and a copy of it.
    table = pl.concat(map(_read_part, _parts(path) or [path])).unique(maintain_order=True)
    return table.with_columns(gate=pl.lit(path.stem)).sort("time", maintain_order=True)


def _parts(path: Path) -> list[Path]:
    """Return the existing files of a log, without empty ones, which a full disk leaves."""
    before = path.with_name(f"{path.name}.1")
    return [file for file in (before, path) if file.is_file() and file.stat().st_size]


def _read_part(path: Path) -> pl.DataFrame:
    """Return the rows of one file of a log. Raises InputError: it is none."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    whole = text[: text.rfind(b"\n") + 1]
    names = whole.split(b"\n", 1)[0].decode(errors="replace").split(",")
    if set(LOG_COLUMNS) - {*_LATER, *names} or set(names) - set(LOG_COLUMNS):
        raise InputError(
            f"{path}:1: this is not the log of a shaping node, which begins with the names of its"
            " columns: name the file that the node's parameter `log` names"
        )
    try:
        table = pl.read_csv(whole, schema={name: _TYPES[name] for name in names})
    except pl.exceptions.PolarsError as error:
        raise InputError(f"{path}: a line is not as a shaping node writes it: {error}") from error
    return events.table({"gate_release": table}, "gate_release", _TYPES).select(*_TYPES)


def rows_missing(releases: pl.DataFrame) -> tuple[int, int]:
    """Return how many rows of logs are in no file: removed to make room, and never written.

    Rows are numbered from 1 since a gate began; logs of before are taken to be whole.
    """
    first, last = pl.min("row"), pl.max("row")
    spans = releases.drop_nulls("row").group_by("gate", "pid")
    counts = spans.agg(removed=first - 1, unwritten=last - first + 1 - pl.len().cast(pl.Int64))
    removed, unwritten = counts.select("removed", "unwritten").sum().row(0)
    return removed, unwritten


def releases_so_far(logs: Iterable[Path]) -> npt.NDArray[np.int64]:
    """Return the latest planned releases (ns) of running shaping nodes, at most 100 of each."""
    latest = [np.empty(0, dtype=np.int64)]
    for log in logs:
        with contextlib.suppress(InputError):  # not there yet, or nothing is in it
            releases = read_gate_log(log).filter(pl.col("slot").is_not_null())
            latest.append(releases["release"].drop_nulls().tail(100).to_numpy())
    return np.concatenate(latest)


def with_gate_logs(
    tables: events.EventTables, logs: Sequence[Path], since_ns: int, until_ns: int
) -> tuple[events.EventTables, tuple[str, ...]]:
    """Add `gate_release`, and stalls, from the logs of shaping nodes to event tables; and notes.

    Cycles count that began at ``since_ns`` or later, and whose message was let go before
    ``until_ns`` (CLOCK_MONOTONIC). Raises InputError: no such log.
    """
    there = [log for log in logs if _parts(log)]
    notes = [
        f"the shaping node's log {log} is not there: it has let nothing through, or did not start."
        for log in logs
        if log not in there
    ]
    if not there:
        return tables, tuple(notes)
    releases = pl.concat([read_gate_log(log) for log in dict.fromkeys(there)])
    releases = releases.sort("time", maintain_order=True)
    removed, unwritten = rows_missing(releases)
    rows = "rows of shaping nodes' logs"
    if removed:
        notes.append(f"{removed} {rows} were removed to make room for newer ones.")
    if unwritten:
        unknown = "what became of those messages is not known. See to room on the disk."
        notes.append(f"{unwritten} {rows} could not be written: {unknown}")
    releases = releases.filter(pl.col("origin") >= since_ns, pl.col("time") < until_ns)
    seen = releases.filter(pl.col("stalled") >= STALL_NS).select(
        "pid", "tid", "cpu", time="release", duration="stalled"
    )
    stalls = pl.concat([events.table(tables, "machine_stall"), seen], how="diagonal")
    stalls = stalls.sort("time", maintain_order=True)
    return {**tables, "gate_release": releases, "machine_stall": stalls}, tuple(notes)
