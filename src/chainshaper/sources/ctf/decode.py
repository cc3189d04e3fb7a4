"""Counting and reading events: the passes over all streams, in spans of time.

Pass 1 (`walk`) steps over every event of every stream, counts, and finds where each span of
time begins in each file.  Pass 2 (`fill`) merges the streams of one span by time and writes the
wanted events straight to their rows.  Spans are independent and run on several threads; with
many of them only a part of a large trace is in memory at once.
"""

import ctypes
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Assembly
from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.streams import MappedFile, Scratch
from chainshaper.sources.ctf.trace import CtfStream
from chainshaper.values.compiled import kernel

__all__ = ["LARGE_BYTES", "Stream", "Walk", "default_threads", "fill", "span_borders", "walk"]

_walk_events = kernel("chainshaper.sources.ctf.kernels", "walk_events")
_fill_columns = kernel("chainshaper.sources.ctf.filling", "fill_columns")
_CHUNK_BYTES = 128 << 20
_MOST_WARNINGS = 20
_SMALL_BYTES = 4 << 20
LARGE_BYTES = 512 << 20
_FAILURES = {
    tb.TRUNCATED: "an event reaches past the end of its packet's content",
    tb.NO_OPTION: "a variant's tag names none of its options",
    tb.BAD_LENGTH: "an array or sequence is longer than the rest of its packet",
    tb.UNTERMINATED: "a string does not end within its packet",
    tb.UNKNOWN_EVENT: "an event id that the metadata does not declare",
    tb.OVER_BUDGET: "its fields, most of them of no bits, would take far more memory than its size"
    f" warrants ({tb.BUDGET} times)",
    tb.FULL_TABLE: "more events than were counted",
}


@dataclass
class Stream:
    """A stream file that is being decoded: its packets (a copy of its own) and its map."""

    path: Path
    packets: NDArray[np.int64]
    file: MappedFile


@dataclass
class Walk:
    """What pass 1 found in one file.

    ``counts`` per event class; ``marks`` (spans - 1, 3) where each span but the first begins:
    packet, bit position, clock; ``reached`` (spans + 1, counters) the rows before each span and
    before the end; ``warnings`` about events that cannot be read; ``sorted`` whether time never
    went back.
    """

    counts: NDArray[np.int64]
    marks: NDArray[np.int64]
    reached: NDArray[np.int64]
    warnings: list[str]
    sorted: bool


def default_threads() -> int:
    """The cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def span_borders(streams: Collection[CtfStream], threads: int) -> NDArray[np.int64]:
    """Instants (ns) that cut the streams into spans of about equal size in bytes."""
    tables = [s.table for s in streams]
    total = sum(int(t[:, tb.P_BYTES].sum()) for t in tables)
    spans = max(-(-total // _CHUNK_BYTES), threads) if total > _SMALL_BYTES else 1
    known = [s.begin_ns is not None and s.table[0, tb.P_BEGIN] == s.begin_ns for s in streams]
    if spans <= 1 or not tables or not all(known):
        return np.zeros(0, np.int64)
    begins = np.concatenate([t[:, tb.P_BEGIN] for t in tables])
    sizes = np.concatenate([t[:, tb.P_BYTES] for t in tables])
    order = np.argsort(begins, kind="stable")
    reached = np.cumsum(sizes[order])
    places = np.searchsorted(reached, total * np.arange(1, spans) / spans)
    return np.unique(begins[order][np.minimum(places, len(order) - 1)])


def walk(stream: Stream, assembly: Assembly, borders: NDArray[np.int64], lean: bool) -> Walk:
    """Pass 1 over one file; shortens the packets of ``stream`` to what can be read.

    ``lean`` has it give back the file's memory behind it.
    """
    scratch = Scratch(assembly)
    counts = np.zeros(max(len(assembly.events), 1), np.int64)
    marks = np.zeros((len(borders) + 1, 3 + len(scratch.rows)), np.int64)
    scratch.state[tb.X_LATEST] = -(1 << 62)
    packets = stream.packets
    border = first = 0
    while first < len(packets):
        last = _chunk(packets, first)
        border = _walk_events(
            scratch.address, scratch.registers.ctypes.data, stream.file.address,
            stream.file.size, packets.ctypes.data, first, last, counts.ctypes.data,
            borders.ctypes.data, border, len(borders), marks.ctypes.data,
        )  # fmt: skip
        if lean:
            end = packets[last - 1, tb.P_BYTE] + packets[last - 1, tb.P_BYTES]
            stream.file.forget(int(packets[first, tb.P_BYTE]), int(end))
        first = last
    marks[border:, 0], marks[border:, 1], marks[border:, 3:] = len(packets), -1, scratch.rows
    warnings = _packet_warnings(stream)
    ordered = not scratch.state[tb.X_UNSORTED]
    reached = np.vstack([np.zeros_like(scratch.rows), marks[:, 3:]])
    return Walk(counts, marks[:-1, :3], reached, warnings, ordered)


def _chunk(packets: NDArray[np.int64], first: int) -> int:
    """The end of the packets from ``first`` on that make up a chunk of memory."""
    limit = packets[first, tb.P_BYTE] + _CHUNK_BYTES
    last = int(np.searchsorted(packets[:, tb.P_BYTE], limit))
    return max(last, first + 1)


def _packet_warnings(stream: Stream) -> list[str]:
    damaged = stream.packets[stream.packets[:, tb.P_ERROR] < 0]
    warnings = [
        str(
            CtfError(
                stream.path,
                int(packet[tb.P_BYTE] + (packet[tb.P_ERROR_AT] >> 3)),
                _FAILURES[int(packet[tb.P_ERROR])],
                "the rest of this packet is not read",
            )
        )
        for packet in damaged[:_MOST_WARNINGS]
    ]
    if len(damaged) > _MOST_WARNINGS:
        warnings.append(
            f"{stream.path}: {len(damaged) - _MOST_WARNINGS} more packets are like that"
        )
    return warnings


def fill(
    span: int,
    streams: Sequence[Stream],
    walks: Sequence[Walk],
    packets: NDArray[np.int64],
    assembly: Assembly,
) -> list[bytes]:
    """Pass 2 over one span; returns the strings that its text slots hold codes of.

    ``packets`` are those of all ``streams``, one behind the other.  Raises `CtfError` where a
    file changed since pass 1.
    """
    files = _span_files(span, streams, walks)
    count = len(streams)
    scratch = Scratch(assembly, count)
    scratch.rows[:] = sum(w.reached[span] for w in walks)
    scratch.caps[:] = sum(w.reached[span + 1] for w in walks)
    cursors = np.zeros((count, tb.CURSOR_COLUMNS), np.int64)
    ahead = np.zeros((count * tb.AHEAD, tb.AHEAD_COLUMNS), np.int64)
    leaves = 1 << (count - 1).bit_length()
    tree = np.full((2 * leaves, 2), tb.NEVER, np.int64)
    tree[0] = 0
    while True:
        status = _fill_columns(
            scratch.address, files.ctypes.data, count, cursors.ctypes.data, ahead.ctypes.data,
            tree.ctypes.data, leaves, packets.ctypes.data, scratch.registers.ctypes.data,
            assembly.registers, len(assembly.events),
        )  # fmt: skip
        if status != tb.FULL_DICTIONARY:
            break
        scratch.grow()
    if status < 0:
        raise CtfError(
            streams[0].path.parent,
            None,
            f"{_FAILURES[status]}: the files changed while they were read",
            "stop the recording first",
        )
    strings = [
        ctypes.string_at(address, length) for address, length, _, _ in scratch.strings().tolist()
    ]
    _forget(files, streams, packets)
    return strings


def _span_files(span: int, streams: Sequence[Stream], walks: Sequence[Walk]) -> NDArray[np.int64]:
    """The kernels' table of files for one span."""
    files = np.zeros((len(streams), tb.FILE_COLUMNS), np.int64)
    first = 0
    for row, stream, found in zip(files, streams, walks, strict=True):
        row[tb.F_BASE], row[tb.F_SIZE] = stream.file.address, stream.file.size
        row[tb.F_PACKET], row[tb.F_POSITION] = first, -1
        if span:
            packet, position, clock = found.marks[span - 1]
            row[tb.F_PACKET], row[tb.F_POSITION] = first + packet, position
            row[tb.F_CLOCK] = clock
        row[tb.F_LAST_PACKET], row[tb.F_LAST_POSITION] = first + len(stream.packets), -1
        if span < len(found.marks):
            packet, position, _ = found.marks[span]
            row[tb.F_LAST_PACKET] = first + packet
            row[tb.F_LAST_POSITION] = position
        first += len(stream.packets)
    return files


def _forget(
    files: NDArray[np.int64], streams: Sequence[Stream], packets: NDArray[np.int64]
) -> None:
    """Let go of the pages that a span was the last to read."""
    for row, stream in zip(files, streams, strict=True):
        first, last = int(row[tb.F_PACKET]), int(row[tb.F_LAST_PACKET])
        if first < last:
            begin = int(packets[first, tb.P_BYTE])
            end = packets[last - 1, tb.P_BYTE] + packets[last - 1, tb.P_BYTES]
            stream.file.forget(begin, int(end))
