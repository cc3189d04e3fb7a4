"""Opening CTF traces: metadata files, packets, what was recorded by which clock, what was lost."""

import ctypes
import mmap
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf.copies import CtfStream, stream_classes, without_copies
from chainshaper.sources.ctf.layout import Layout, lay_out
from chainshaper.sources.ctf.tsdl import (
    ArrayType,
    CtfError,
    IntegerType,
    TraceClass,
    TsdlError,
    parse_tsdl,
)
from chainshaper.values.compiled import kernel

_scan_packets = kernel("chainshaper.sources.ctf.kernels", "scan_packets")
_MOST_DAMAGED = 1000
"""Places in a file behind which it is read on."""
_MOST_WARNINGS = 20
_REASONS = {
    tb.BAD_MAGIC: "packet does not begin with the CTF magic number",
    tb.BAD_UUID: "packet belongs to another trace (uuid differs from the metadata's)",
    tb.BAD_STREAM: "packet of a stream class that the metadata does not declare (or no more)",
    tb.BAD_SIZE: "packet with impossible content or packet size",
    tb.BAD_HEADER: "packet header cut short",
    tb.COSTLY: "packet headers that take far more work than their size warrants",
    tb.CUT: "last packet cut short by the end of the file",
}


@dataclass(frozen=True)
class CtfTrace:
    """Traces opened together.

    ``clock_offset_ns`` added to an event's time gives ns since the Epoch; ``discarded_events`` and
    ``lost_packets`` are what the tracer says that it dropped, ``damaged_places`` the parts of
    stream files that are no packets.
    """

    folders: tuple[TraceClass, ...]
    streams: tuple[CtfStream, ...]
    event_names: tuple[str, ...]
    clock_offset_ns: int
    discarded_events: int
    lost_packets: int
    damaged_places: int
    warnings: tuple[str, ...]


def open_trace(*paths: Path | str) -> CtfTrace:
    """Find and open every CTF trace in ``paths``, folders searched recursively.

    Reads metadata and packet headers only. Raises `CtfError` where a path holds no trace or
    metadata cannot be understood; stream files with damage give ``warnings`` instead.
    """
    folders = [read_metadata(path / "metadata") for path in _find(paths)]
    layout = lay_out(folders, {})
    first = folders[0].clock
    warnings = [
        f"{one.path}: clock {one.clock.name!r} is not the clock of {folders[0].path};"
        " times of the two cannot be compared"
        for one in folders[1:]
        if (one.clock.name, one.clock.uuid) != (first.name, first.uuid)
    ]
    streams, damaged = list[CtfStream](), 0
    for number, folder in enumerate(folders):
        files = (p for p in folder.path.iterdir() if p.is_file() and p.name[0] != ".")
        for path in sorted(p for p in files if p.name != "metadata"):
            packets = _packets_of(path, layout, number, folder)
            warnings += packets.warnings
            damaged += packets.damaged
            if len(packets.table):
                streams.append(CtfStream(path, number, packets.table))
    classes_of_streams = stream_classes(folders)
    streams, copied = without_copies(streams, classes_of_streams)
    warnings += copied
    groups: dict[object, list[CtfStream]] = {}
    for stream in streams:
        kind, instance = stream.table[0, [tb.P_STREAM, tb.P_INSTANCE]].tolist()
        name = stream.path if instance < 0 else instance
        groups.setdefault((classes_of_streams[kind], name), []).append(stream)
    losses = [(group[0].path, *_losses(group)) for group in groups.values()]
    for path, discarded, lost in losses:
        if discarded:
            what = f"the tracer discarded {discarded} events of this stream"
            warnings.append(f"{path}: {what} (record with more or larger sub-buffers)")
        if lost:
            what = f"{lost} packets of this stream are missing"
            warnings.append(f"{path}: {what} (overwritten, or not copied with the trace)")
    classes = [s for folder in folders for s in folder.streams.values()]
    return CtfTrace(
        folders=tuple(folders),
        streams=tuple(streams),
        event_names=tuple(sorted({e.name for s in classes for e in s.events.values()})),
        clock_offset_ns=first.offset_ns,
        discarded_events=sum(discarded for _, discarded, _ in losses),
        lost_packets=sum(lost for *_, lost in losses),
        damaged_places=damaged,
        warnings=tuple(warnings),
    )


def _find(paths: Iterable[Path | str]) -> Iterable[Path]:
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        here = sorted(p.parent for p in path.rglob("metadata") if p.is_file())
        if not path.exists():
            raise CtfError(path, None, "no such file or folder")
        if not here:
            reason = "no CTF trace: no file named metadata in it"
            raise CtfError(path, None, reason, "give a trace's folder")
        for folder in here:
            found.setdefault(folder.resolve(), folder)
    if not found:
        raise CtfError(".", None, "no trace given")
    return found.values()


def _losses(files: list[CtfStream]) -> tuple[int, int]:
    """Discarded events and lost packets of one stream (LTTng's packet context, section 5.2).

    ``events_discarded`` counts from the beginning of the stream (32-bit tracers' counters wrap).
    What the first packet says counts where it is the stream's first; a snapshot or a rotated trace
    begins anywhere, and what was lost before it is not its own.
    """
    table = np.concatenate([file.table for file in files])
    # Files of one stream follow each other (tracefile rotation), not always by name.
    table = table[np.argsort(table[:, tb.P_BEGIN], kind="stable")]
    counter, sequence = table[:, tb.P_DISCARDED], table[:, tb.P_SEQUENCE]
    steps = np.diff(counter, prepend=0 if sequence[0] <= 0 else counter[0])
    steps[steps < 0] += 1 << 32
    discarded = int(steps[steps > 0].sum()) if (counter >= 0).all() else 0
    gaps = np.diff(sequence) - 1
    return discarded, int(gaps[gaps > 0].sum()) if (sequence >= 0).all() else 0


# Stream files and the kernels' memory


class MappedFile:
    """A file mapped for reading: ``address`` and ``size`` in bytes, valid as long as this lives."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise CtfError(path, None, f"cannot map the file: {error}") from error
        self.address = int(np.frombuffer(self._map, np.uint8).ctypes.data)
        self.size = len(self._map)

    def find(self, content: bytes, start: int) -> int:
        """Where ``content`` lies from ``start`` on, -1 for nowhere."""
        return self._map.find(content, start)

    def begins_with_zeros(self, start: int) -> bool:
        """Whether nothing but zeros is where a packet would have its magic number."""
        return not any(self._map[start : start + 4])

    def forget(self, packets: NDArray[np.int64]) -> None:
        """Give back the memory of packets in a row; the file's pages stay cached."""
        first = -(-int(packets[0, tb.P_BYTE]) // mmap.PAGESIZE) * mmap.PAGESIZE
        last = int(packets[-1, tb.P_BYTE] + packets[-1, tb.P_BYTES])
        if last - first >= mmap.PAGESIZE:
            self._map.madvise(mmap.MADV_DONTNEED, first, last - first)


class Scratch:
    """The tables that kernels work with in one thread, and the ``address`` of that of addresses."""

    def __init__(self, layout: Layout) -> None:
        counters = max(len(layout.tables), 1)
        self.state = np.zeros(tb.STATE_WORDS, np.int64)
        self.state[tb.X_BUDGET] = 1 << 62
        self.rows = np.zeros(counters, np.int64)
        self.caps = np.full(counters, 1 << 62, np.int64)
        self.registers = np.zeros(layout.registers, np.int64)
        self.batches = np.zeros((len(layout.events), 1 + 2 * tb.BATCH), np.int64)
        self._tables = {**layout.arrays(), tb.M_STATE: self.state, tb.M_ROWS: self.rows}
        self._tables |= {tb.M_CAPS: self.caps, tb.M_BATCHES: self.batches}
        self._words = np.zeros(tb.MACHINE_WORDS, np.int64)
        self._words[list(self._tables)] = [table.ctypes.data for table in self._tables.values()]
        self.address = int(self._words.ctypes.data)
        self.entries = np.zeros((0, 4), np.int64)
        self.grow()

    def run(
        self, run: Callable[..., int], file: MappedFile, packets: NDArray[np.int64], *numbers: int
    ) -> int:
        """Run a kernel over a file's packets."""
        given = (file.address, file.size, packets.ctypes.data)
        return run(self.address, self.registers.ctypes.data, *given, *numbers)

    def strings(self) -> list[bytes]:
        entries = self.entries[: self.state[tb.X_STRINGS]].tolist()
        return [ctypes.string_at(address, length) for address, length, _, _ in entries]

    def grow(self) -> None:
        """Begin anew with a dictionary of four times the places."""
        room = max(512, 4 * len(self.entries))
        self.entries, self.state[tb.X_STRINGS] = np.zeros((room, 4), np.int64), 0
        # One place more than used: places are read eight bytes at a time.
        self._slots = np.zeros(2 * room + 1, np.int32)
        self._words[tb.M_SLOTS], self._words[tb.M_MASK] = self._slots.ctypes.data, 2 * room - 1
        self._words[tb.M_ENTRIES], self._words[tb.M_ROOM] = self.entries.ctypes.data, room


class _Packets(NamedTuple):
    """The packets of a stream file (see `layout`), how many places are damaged, and warnings."""

    table: NDArray[np.int64]
    damaged: int = 0
    warnings: tuple[str, ...] = ()


def _packets_of(path: Path, layout: Layout, number: int, folder: TraceClass) -> _Packets:
    """Find the packets of a stream file.

    Behind a part that makes no sense the file is read on from the next packet of its trace.
    """
    packets = np.zeros((256, tb.PACKET_COLUMNS), np.int64)
    if path.stat().st_size == 0:
        return _Packets(packets[:0])
    file, scratch = MappedFile(path), Scratch(layout)
    scratch.state[tb.X_BUDGET] = tb.BUDGET * file.size
    reached, beginning = np.zeros(2, np.int64), _beginning(folder)
    places = list[str]()
    while True:
        numbers = (len(packets), reached.ctypes.data, *layout.folders[number])
        status = scratch.run(_scan_packets, file, packets, *numbers)
        if status == tb.FULL:
            packets = np.concatenate([packets, np.zeros_like(packets)])
            continue
        if status == tb.DONE:
            break
        offset, found = reached.tolist()
        searched = beginning and status != tb.COSTLY and len(places) < _MOST_DAMAGED
        following = file.find(beginning, offset + 1) if searched else -1
        places.append(_damage(path, file, status, offset, following))
        if following < 0:
            break
        if status == tb.CUT:
            packets[found - 1, tb.P_BYTES] = following - offset
            most = 8 * (following - offset)
            packets[found - 1, tb.P_END] = min(int(packets[found - 1, tb.P_END]), most)
        reached[0] = following
    table = packets[: int(reached[1])].copy()
    table[:, [tb.P_EARLIEST, tb.P_LATEST]] = _times_of_events(table, folder, layout, number)
    # A file without any packet is another program's, but for one that has nothing but zeros.
    ours = len(table) > 0 or file.begins_with_zeros(0)
    if (more := len(places) - _MOST_WARNINGS) > 0:
        places[_MOST_WARNINGS:] = [f"{path}: {more} more places are like that"]
        return _Packets(table, _MOST_WARNINGS + more, tuple(places))
    return _Packets(table, len(places) if ours else 0, tuple(places))


def _damage(path: Path, file: MappedFile, status: int, offset: int, following: int) -> str:
    """A warning of what is wrong at an offset; the next packet is at ``following`` (-1: none)."""
    reason = _REASONS[status]
    if status == tb.BAD_MAGIC and file.begins_with_zeros(offset):
        reason = "zeros instead of a packet: the disk was full, or the recording was not stopped"
    unread = f"{following - offset} bytes are not read"
    if following < 0:
        unread = f"the last {file.size - offset} bytes of the file are not read"
    if status == tb.CUT:
        unread = "events up to the cut are read"
        if following >= 0:
            reason = "packet with a size that reaches over the next one"
    return str(CtfError(path, offset, reason, unread))


def _beginning(folder: TraceClass) -> bytes:
    """The bytes that each packet of a trace begins with; none where they are too few to be sure."""
    header = folder.packet_header.fields if folder.packet_header is not None else ()
    match header[:2]:
        case [
            ("magic", IntegerType(size=32, align=8 | 16 | 32)),
            ("uuid", ArrayType(IntegerType(8, 8), 16)),
        ] if folder.uuid is not None:
            order: Literal["little", "big"] = "big" if folder.byte_order == "be" else "little"
            return tb.MAGIC.to_bytes(4, order) + UUID(folder.uuid).bytes
    return b""


def _times_of_events(
    table: NDArray[np.int64], folder: TraceClass, layout: Layout, number: int
) -> NDArray[np.int64]:
    """The earliest and the latest time (cycles) that an event of each packet can have.

    Tracers of LTTng before 2.11 closed a packet without the events that were being written, which
    the next packet's beginning bounds; so do packets of a crash, which say no end.
    """
    times = np.full((len(table), 2), tb.ALWAYS, np.int64)
    major, minor = (folder.env.get(f"tracer_{part}") for part in ("major", "minor"))
    known_version = isinstance(major, int) and isinstance(minor, int)
    late = known_version and (major, minor) < (2, 11)
    begin, last = table[:, tb.P_BEGIN], table[:, tb.P_LAST]
    following = np.append(begin[1:], -1)
    following[following < begin] = tb.ALWAYS[1]
    latest = np.where((last < begin) | late, np.maximum(last, following), last)
    for row, stream in enumerate(folder.streams.values(), layout.folders[number][0]):
        context = dict(stream.packet_context.fields) if stream.packet_context is not None else {}
        stamps = (context.get(name) for name in ("timestamp_begin", "timestamp_end"))
        if all(isinstance(one, IntegerType) and one.clock and one.size == 64 for one in stamps):
            known = (table[:, tb.P_STREAM] == row) & (begin > 0)
            times[known, 0], times[known, 1] = begin[known], latest[known]
    return times


# The metadata file

METADATA_MAGIC = 0x75D11D57
_LARGEST = 64 << 20
_RECORD_SEPARATOR = b"\x1e"  # begins every fragment of CTF 2's JSON text sequence


def read_metadata(path: Path) -> TraceClass:
    """Read and parse a metadata file; raises `CtfError` naming the file and the byte offset."""
    text, pieces = read_metadata_text(path)
    if not text.strip(" \t\r\n\0"):
        raise _not_whole(path, _in_file(0, pieces), "the metadata is empty (no trace block)")
    try:
        return replace(parse_tsdl(text), path=path.parent)
    except TsdlError as error:
        offset, why = error.args
        place = _in_file(len(text[:offset].encode()), pieces)
        # What is whole ends with a block; what stops too early is all right up to where it stops.
        written = text.rstrip(" \t\r\n\0")
        if offset >= len(written) or not written.endswith((";", "*/")):
            raise _not_whole(path, place, f"the metadata ends in the middle ({why})") from None
        remedy = "record again, or report this with the file"
        raise CtfError(path, place, f"metadata cannot be understood: {why}", remedy) from None


def _not_whole(path: Path, place: int, what: str) -> CtfError:
    """What to do about metadata that the tracer did not finish."""
    uuid = next(filter(None, map(_uuid_in, sorted(path.parent.iterdir()))), None)
    whose = "this trace's UUID" if uuid is None else f"the UUID of this trace, {uuid},"
    return CtfError(
        path,
        place,
        f"{what}: the session was not stopped and destroyed in order (`lttng destroy`), or the disk"
        " was full; babeltrace2 cannot read it either",
        "record again; or copy the metadata of a run with the same set-up, whose nodes started in "
        f"the same order, and write {whose} in place of its own: `sed -i s/OLD/NEW/ metadata`",
    )


def _uuid_in(path: Path) -> UUID | None:
    """The UUID that a stream file's first packet says; None where it is no stream."""
    if path.name == "metadata" or not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(20)
    if len(head) == 20 and head[:4] in {
        tb.MAGIC.to_bytes(4, "little"),
        tb.MAGIC.to_bytes(4, "big"),
    }:
        return UUID(bytes=head[4:])
    return None


def read_metadata_text(path: Path) -> tuple[str, list[tuple[int, int]]]:
    """The TSDL text of a metadata file, plain or in packets (section 7.1), and its pieces.

    Each piece is a pair (byte offset in the text, byte offset in the file). Raises `CtfError`.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise CtfError(path, None, f"metadata of more than {_LARGEST >> 20} MiB")
        data = path.read_bytes()
    except OSError as error:
        raise CtfError(path, None, f"cannot read metadata: {error.strerror}") from error
    if data[:1] == _RECORD_SEPARATOR:
        remedy = "LTTng 2.15 and later: record with `lttng create --trace-format=ctf-1.8`"
        raise CtfError(path, 0, "CTF 2 metadata; CTF 1.8 is supported", remedy)
    pieces = [(0, 0)]
    for order in "<>":
        if data[:4] == struct.pack(order + "I", METADATA_MAGIC):
            data, pieces = _unpacked(path, data, order)
    try:
        return data.decode(), pieces
    except UnicodeDecodeError as error:
        if error.end == len(data) and error.start > 0:
            raise _not_whole(path, len(data), "the metadata ends in the middle") from None
        place, remedy = _in_file(error.start, pieces), "is this a CTF 1.8 trace?"
        raise CtfError(path, place, "metadata is not UTF-8 text", remedy) from None


def _in_file(position: int, pieces: list[tuple[int, int]]) -> int:
    start, offset = next(p for p in reversed(pieces) if p[0] <= position)
    return offset + position - start


def _unpacked(path: Path, data: bytes, order: str) -> tuple[bytes, list[tuple[int, int]]]:
    header = struct.Struct(order + "I16sIIIBBBBB")
    text, pieces, offset = bytearray(), [], 0
    while offset < len(data):
        begin = offset + header.size
        if begin > len(data):
            raise _not_whole(path, offset, "the metadata ends in the middle")
        magic, _, _, content, size, compression, encryption, *_ = header.unpack_from(data, offset)
        end = offset + content // 8
        if not any(data[offset:]) or (not size and not any(data[begin:])):
            raise _not_whole(path, offset, "the metadata ends in zeros")
        if magic != METADATA_MAGIC:
            raise CtfError(path, offset, f"metadata packet begins with 0x{magic:08X}")
        if compression or encryption:
            raise CtfError(path, offset, "compressed or encrypted metadata is not supported")
        if not begin <= end <= offset + size // 8:
            raise CtfError(path, offset, f"metadata packet of {content} content, {size} bits")
        if end > len(data):
            raise _not_whole(path, offset, "the metadata ends in the middle of a packet")
        pieces.append((len(text), begin))
        text += data[begin:end]
        offset += size // 8
    return bytes(text), pieces
