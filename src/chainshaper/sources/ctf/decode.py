"""Stream files, and the passes over them (CTF 1.8, section 5).

`packet_table` finds a file's packets. Pass 1 (`walk`) steps over every event of every stream,
counts, and finds where each span of time begins in each file. Pass 2 (`fill`) merges the streams
of one span by time and writes the wanted events straight to their rows. Spans are independent and
run on several threads; with many of them only a part of a large trace is in memory at once.
"""

import ctypes
import mmap
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Assembly
from chainshaper.sources.ctf.types import CtfError
from chainshaper.values.compiled import kernel

__all__ = [
    "LARGE_BYTES",
    "CtfStream",
    "Stream",
    "Walk",
    "default_threads",
    "fill",
    "packet_table",
    "span_borders",
    "walk",
]

_scan_packets = kernel("chainshaper.sources.ctf.kernels", "scan_packets")
_walk_events = kernel("chainshaper.sources.ctf.kernels", "walk_events")
_fill_columns = kernel("chainshaper.sources.ctf.kernels", "fill_columns")
_rehash = kernel("chainshaper.sources.ctf.interpreter", "rehash")
_CHUNK_BYTES = 128 << 20
_MOST_WARNINGS = 20
_SMALL_BYTES = 4 << 20
LARGE_BYTES = 512 << 20
_REASONS = {
    tb.BAD_MAGIC: "packet does not begin with the CTF magic number",
    tb.BAD_UUID: "packet belongs to another trace (uuid differs from the metadata's)",
    tb.BAD_STREAM: "packet of a stream class that the metadata does not declare",
    tb.BAD_SIZE: "packet with impossible content or packet size",
    tb.BAD_HEADER: "packet header cut short",
    tb.COSTLY: "packet headers that take far more work than their size warrants",
    tb.CUT: "last packet cut short by the end of the file",
}
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


@dataclass(frozen=True)
class CtfStream:
    """One stream file; ``table`` has its packets (see `tables`).

    ``begin_ns`` and ``end_ns`` are those of its packets on the raw trace clock, None where
    unknown. ``discarded_events`` and ``lost_packets`` are counted over the whole stream that
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


class MappedFile:
    """A file mapped for reading: ``address`` and ``size`` in bytes, valid until `close`."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise CtfError(path, None, f"cannot map the file: {error}") from error
        self._view = np.frombuffer(self._map, np.uint8)
        self.address = int(self._view.ctypes.data)
        self.size = len(self._map)

    def forget(self, first: int, last: int) -> None:
        """Give back the memory of bytes [first, last); the file's pages stay cached."""
        first = -(-first // mmap.PAGESIZE) * mmap.PAGESIZE
        if last - first >= mmap.PAGESIZE and hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED, first, last - first)

    def close(self) -> None:
        """Unmap the file."""
        del self._view
        self._map.close()


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


class _Scratch:
    """The tables that kernels work with in one thread.

    ``address`` is that of the table of addresses (see `tables`), valid as long as this lives.
    """

    def __init__(self, assembly: Assembly, files: int = 1) -> None:
        counters = max(assembly.counters, 1)
        ops, ranges = assembly.program.arrays()
        self.state = np.zeros(tb.STATE_WORDS, np.int64)
        self.state[tb.X_BUDGET] = 1 << 62
        self.rows = np.zeros(counters, np.int64)
        self.caps = np.full(counters, 1 << 62, np.int64)
        self.registers = np.zeros((files, assembly.registers), np.int64)
        # One place more than used: places are read eight bytes at a time.
        self.slots = np.zeros(1024 + 1, np.int32)
        self.entries = np.zeros((512, 4), np.int64)
        self._words = np.zeros(tb.MACHINE_WORDS, np.int64)
        self._tables = {
            tb.M_OPS: ops,
            tb.M_RANGES: ranges,
            tb.M_STATE: self.state,
            tb.M_ROWS: self.rows,
            tb.M_CAPS: self.caps,
            tb.M_SAVED: np.zeros(counters, np.int64),
            tb.M_STREAMS: assembly.streams(),
            tb.M_EVENTS: assembly.event_rows(),
            tb.M_IDS: np.array(assembly.ids or [0], np.int64),
            tb.M_BATCHES: np.zeros((len(assembly.events), 1 + 2 * tb.BATCH), np.int64),
        }
        for word, table in self._tables.items():
            self._words[word] = table.ctypes.data
        self._words[tb.M_COUNTERS] = counters
        self._place_dictionary()
        self.address = int(self._words.ctypes.data)

    def _place_dictionary(self) -> None:
        self._words[tb.M_SLOTS] = self.slots.ctypes.data
        self._words[tb.M_MASK] = len(self.slots) - 2
        self._words[tb.M_ENTRIES] = self.entries.ctypes.data
        self._words[tb.M_ROOM] = len(self.entries)

    def strings(self) -> list[bytes]:
        """The strings in the dictionary, by code."""
        entries = self.entries[: self.state[tb.X_STRINGS]].tolist()
        return [ctypes.string_at(address, length) for address, length, _, _ in entries]

    def grow(self) -> None:
        """Give the dictionary four times its places."""
        entries = np.zeros((4 * len(self.entries), 4), np.int64)
        entries[: len(self.entries)] = self.entries
        self.entries = entries
        self.slots = np.zeros(4 * (len(self.slots) - 1) + 1, np.int32)
        self._place_dictionary()
        _rehash(self.address, int(self.state[tb.X_STRINGS]))


def packet_table(
    path: Path, assembly: Assembly, folder: int
) -> tuple[NDArray[np.int64], list[str]]:
    """The packets of a stream file (see `tables`) and warnings about it.

    Reading stops where a packet's header makes no sense, since nothing says where the next one
    begins; of a packet that the end of the file cuts short, what is there counts.
    """
    packets = np.zeros((256, tb.PACKET_COLUMNS), np.int64)
    if path.stat().st_size == 0:
        return packets[:0], []
    file = MappedFile(path)
    scratch = _Scratch(assembly)
    scratch.state[tb.X_BUDGET] = tb.BUDGET * file.size
    first, last = assembly.folders[folder]
    reached = np.zeros(2, np.int64)
    status = tb.FULL
    while status == tb.FULL:
        status = _scan_packets(
            scratch.address, scratch.registers.ctypes.data, file.address, file.size,
            packets.ctypes.data, len(packets), reached.ctypes.data, first, last,
        )  # fmt: skip
        if status == tb.FULL:
            packets = np.concatenate([packets, np.zeros_like(packets)])
    file.close()
    offset, found = reached.tolist()
    if status == tb.DONE:
        return packets[:found].copy(), []
    unread = f"the last {file.size - offset} bytes of the file are not read"
    remedy = "events up to the cut are read" if status == tb.CUT else unread
    return packets[:found].copy(), [str(CtfError(path, offset, _REASONS[status], remedy))]


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
    scratch = _Scratch(assembly)
    counts = np.zeros(max(len(assembly.events), 1), np.int64)
    marks = np.zeros((len(borders) + 1, 3 + len(scratch.rows)), np.int64)
    scratch.state[tb.X_LATEST] = -(1 << 62)
    packets = stream.packets
    border = first = 0
    while first < len(packets):
        limit = packets[first, tb.P_BYTE] + _CHUNK_BYTES
        last = max(int(np.searchsorted(packets[:, tb.P_BYTE], limit)), first + 1)
        border = _walk_events(
            scratch.address, scratch.registers.ctypes.data, stream.file.address,
            stream.file.size, packets.ctypes.data, first, last, counts.ctypes.data,
            borders.ctypes.data, border, len(borders), marks.ctypes.data,
        )  # fmt: skip
        if lean:
            _forget(stream.file, packets, first, last)
        first = last
    marks[border:, 0], marks[border:, 1], marks[border:, 3:] = len(packets), -1, scratch.rows
    reached = np.vstack([np.zeros_like(scratch.rows), marks[:, 3:]])
    ordered = not scratch.state[tb.X_UNSORTED]
    return Walk(counts, marks[:-1, :3], reached, _packet_warnings(stream), ordered)


def _forget(file: MappedFile, packets: NDArray[np.int64], first: int, last: int) -> None:
    """Let go of the pages of the packets [first, last)."""
    end = packets[last - 1, tb.P_BYTE] + packets[last - 1, tb.P_BYTES]
    file.forget(int(packets[first, tb.P_BYTE]), int(end))


def _packet_warnings(stream: Stream) -> list[str]:
    damaged = stream.packets[stream.packets[:, tb.P_ERROR] < 0]
    warnings = []
    for packet in damaged[:_MOST_WARNINGS]:
        place = int(packet[tb.P_BYTE] + (packet[tb.P_ERROR_AT] >> 3))
        reason = _FAILURES[int(packet[tb.P_ERROR])]
        remedy = "the rest of this packet is not read"
        warnings.append(str(CtfError(stream.path, place, reason, remedy)))
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

    ``packets`` are those of all ``streams``, one behind the other. Raises `CtfError` where a
    file changed since pass 1.
    """
    files = _span_files(span, streams, walks)
    count = len(streams)
    scratch = _Scratch(assembly, count)
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
        reason = f"{_FAILURES[status]}: the files changed while they were read"
        raise CtfError(streams[0].path.parent, None, reason, "stop the recording first")
    strings = scratch.strings()
    for row, stream in zip(files, streams, strict=True):
        if row[tb.F_PACKET] < row[tb.F_LAST_PACKET]:  # this span was the last to read these
            _forget(stream.file, packets, int(row[tb.F_PACKET]), int(row[tb.F_LAST_PACKET]))
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
