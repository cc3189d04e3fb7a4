"""Opening CTF traces: what was recorded, where, by which clock, and what was lost."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Wanted, assemble
from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.losses import count_losses
from chainshaper.sources.ctf.metadata import CtfFolder, read_metadata
from chainshaper.sources.ctf.streams import packet_table, stream_paths

__all__ = ["CtfFolder", "CtfStream", "CtfTrace", "open_trace"]


@dataclass(frozen=True)
class CtfStream:
    """One stream file.

    ``begin_ns`` and ``end_ns`` are those of its packets on the raw trace clock, None where
    unknown.  ``discarded_events`` and ``lost_packets`` are counted over the whole stream that
    the file belongs to, and reported with its first file.
    """

    path: Path
    folder: int
    instance: int | None
    packets: int
    begin_ns: int | None
    end_ns: int | None
    discarded_events: int
    lost_packets: int
    table: NDArray[np.int64] = field(repr=False, compare=False)


@dataclass(frozen=True)
class CtfTrace:
    """Traces opened together.

    ``env`` is the first folder's environment (``hostname``, ``domain``, ``tracer_name``, …) and
    the clock its clock: ``clock_offset_ns`` added to an event's time gives ns since the Epoch.
    ``discarded_events`` and ``lost_packets`` are what the tracer says that it dropped.
    """

    folders: tuple[CtfFolder, ...]
    streams: tuple[CtfStream, ...]
    event_names: tuple[str, ...]
    env: Mapping[str, str | int]
    clock_offset_ns: int
    packets: int
    discarded_events: int
    lost_packets: int
    warnings: tuple[str, ...]


def open_trace(*paths: Path | str) -> CtfTrace:
    """Find and open every CTF trace in ``paths``, folders searched recursively.

    Reads metadata and packet headers only.  Raises `CtfError` where a path holds no trace or
    metadata cannot be understood; stream files with damage give ``warnings`` instead.
    """
    folders = [CtfFolder(path, read_metadata(path / "metadata")) for path in _find(paths)]
    assembly = assemble(folders, Wanted())
    warnings = _clock_warnings(folders)
    streams: list[CtfStream] = []
    for number, folder in enumerate(folders):
        tables: list[tuple[Path, NDArray[np.int64]]] = []
        for path in stream_paths(folder.path):
            table, found = packet_table(path, assembly, number)
            warnings += found
            if len(table):
                tables.append((path, table))
        rates = [row[tb.S_FREQUENCY] for row in assembly.stream_rows]
        streams += _streams(number, tables, rates, warnings)
    clock = folders[0].clock
    names = {
        e.name for f in folders for s in f.declared.streams.values() for e in s.events.values()
    }
    return CtfTrace(
        folders=tuple(folders),
        streams=tuple(streams),
        event_names=tuple(sorted(names)),
        env=folders[0].declared.env,
        clock_offset_ns=clock.offset_ns,
        packets=sum(stream.packets for stream in streams),
        discarded_events=sum(stream.discarded_events for stream in streams),
        lost_packets=sum(stream.lost_packets for stream in streams),
        warnings=tuple(warnings),
    )


def _find(paths: Iterable[Path | str]) -> list[Path]:
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise CtfError(path, None, "no such file or folder")
        here = sorted(p.parent for p in path.rglob("metadata") if p.is_file())
        if not here:
            raise CtfError(
                path, None, "no CTF trace: no file named metadata in it", "give a trace's folder"
            )
        for folder in here:
            found.setdefault(folder.resolve(), folder)
    if not found:
        raise CtfError(".", None, "no trace given")
    return list(found.values())


def _clock_warnings(folders: list[CtfFolder]) -> list[str]:
    first = folders[0].clock
    return [
        f"{folder.path}: clock {folder.clock.name!r} is not the clock of {folders[0].path};"
        " times of the two cannot be compared"
        for folder in folders[1:]
        if (folder.clock.name, folder.clock.uuid) != (first.name, first.uuid)
    ]


def _streams(
    folder: int,
    tables: list[tuple[Path, NDArray[np.int64]]],
    rates: list[int],
    warnings: list[str],
) -> list[CtfStream]:
    """The streams of a folder's files, with what was lost counted per stream."""
    groups: dict[Any, list[int]] = {}
    for index, (path, table) in enumerate(tables):
        first = table[0]
        instance = int(first[tb.P_INSTANCE])
        own = path if instance < 0 else instance
        groups.setdefault((int(first[tb.P_STREAM]), own), []).append(index)
    losses = {
        group[0]: count_losses([tables[i] for i in group], warnings) for group in groups.values()
    }
    found = []
    for index, (path, table) in enumerate(tables):
        stream = int(table[0, tb.P_STREAM])
        begin, end = int(table[0, tb.P_BEGIN]), int(table[-1, tb.P_LAST])
        instance = int(table[0, tb.P_INSTANCE])
        discarded, lost = losses.get(index, (0, 0))
        rate = rates[stream]
        found.append(
            CtfStream(
                path=path,
                folder=folder,
                instance=None if instance < 0 else instance,
                packets=len(table),
                begin_ns=begin * 1_000_000_000 // rate if begin >= 0 else None,
                end_ns=end * 1_000_000_000 // rate if end >= 0 else None,
                discarded_events=discarded,
                lost_packets=lost,
                table=table,
            )
        )
    return found
