"""Open CTF traces: read their metadata, find their packets, say what was lost or is damaged."""

import mmap
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple
from uuid import UUID

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper import _core
from chainshaper.sources.ctf.copies import CtfStream, stream_classes, without_copies
from chainshaper.sources.ctf.layout import MAGIC, describe, lay_out
from chainshaper.sources.ctf.tsdl import (
    ArrayType,
    CtfError,
    IntegerType,
    TraceClass,
    TsdlError,
    parse_tsdl,
)

_MOST_WARNINGS = 20
"""Damaged places that are named, of each file; of more only the number is."""
_ALWAYS = (-(1 << 63), (1 << 63) - 1)
"""Earliest and latest time of the events of a packet that says no times."""
_REASONS = {
    _core.CtfDamage.BAD_MAGIC: "packet does not begin with the CTF magic number",
    _core.CtfDamage.BAD_UUID: "packet belongs to another trace (uuid differs from the metadata's)",
    _core.CtfDamage.BAD_STREAM: "packet of a stream class that the metadata does not declare (or"
    " no more)",
    _core.CtfDamage.BAD_SIZE: "packet with impossible content or packet size",
    _core.CtfDamage.BAD_HEADER: "packet header cut short",
    _core.CtfDamage.COSTLY: "packet headers that take far more work than their size warrants",
    _core.CtfDamage.CUT: "last packet cut short by the end of the file",
}


@dataclass(frozen=True)
class CtfTrace:
    """Traces that are opened together."""

    folders: tuple[TraceClass, ...]
    streams: tuple[CtfStream, ...]
    event_names: tuple[str, ...]  # that the metadata declares, sorted
    clock_offset_ns: int  # added to an event's time, it gives ns since the Epoch
    discarded_events: int  # as the tracer says
    lost_packets: int  # numbers of packets that are in no file
    damaged_places: int  # parts of stream files that are no packets
    warnings: tuple[str, ...]
    described: tuple[_core.CtfTraceClass, ...] = field(repr=False, compare=False)
    """The types of each folder, for the decoder."""


def open_trace(*paths: Path | str) -> CtfTrace:
    """Find and open every CTF trace in ``paths``, folders searched recursively.

    Reads metadata and packet headers only. Raises `CtfError` where a path holds no trace or
    metadata cannot be understood; stream files with damage give ``warnings`` instead.
    """
    folders = [read_metadata(path / "metadata") for path in _find(paths)]
    described = [describe(folder) for folder in folders]
    layout = lay_out(folders, described)
    first = folders[0].clock
    warnings = [
        f"{folder.path}: clock {folder.clock.name!r} is not the clock of {folders[0].path};"
        " times of the two cannot be compared"
        for folder in folders[1:]
        if (folder.clock.name, folder.clock.uuid) != (first.name, first.uuid)
    ]
    streams, damaged = list[CtfStream](), 0
    for number, folder in enumerate(folders):
        files = (p for p in folder.path.iterdir() if p.is_file() and p.name[0] != ".")
        for path in sorted(p for p in files if p.name != "metadata"):
            packets = _packets_of(path, layout, number, folder)
            warnings += packets.warnings
            damaged += packets.damaged
            if len(packets.packets):
                streams.append(CtfStream(path, number, packets.packets))
    classes_of_streams = stream_classes(folders)
    streams, warnings_of_copies = without_copies(streams, classes_of_streams)
    warnings += warnings_of_copies
    groups: dict[object, list[CtfStream]] = {}
    for stream in streams:
        kind, instance = (stream.packets[name][0] for name in ("stream_class", "instance"))
        name = stream.path if instance < 0 else instance
        groups.setdefault((classes_of_streams[kind], name), []).append(stream)
    losses = [(group[0].path, *_losses(group)) for group in groups.values()]
    for path, discarded, lost in losses:
        if discarded:
            warnings.append(
                f"{path}: the tracer discarded {discarded} events of this stream"
                " (record with more or larger sub-buffers)"
            )
        if lost:
            warnings.append(
                f"{path}: {lost} packets of this stream are missing"
                " (overwritten, or not copied with the trace)"
            )
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
        described=tuple(described),
    )


def _find(paths: Iterable[Path | str]) -> Iterable[Path]:
    """Return the folders with a file ``metadata`` in and below the paths, each once."""
    folders: dict[Path, Path] = {}  # by their path without symbolic links
    for path in map(Path, paths):
        here = sorted(p.parent for p in path.rglob("metadata") if p.is_file())
        if not path.exists():
            raise CtfError(path, None, "no such file or folder")
        if not here:
            reason = "no CTF trace: no file named metadata in it"
            raise CtfError(path, None, reason, "give a trace's folder")
        for folder in here:
            folders.setdefault(folder.resolve(), folder)
    if not folders:
        raise CtfError(".", None, "no trace given")
    return folders.values()


def _losses(files: list[CtfStream]) -> tuple[int, int]:
    """Count the discarded events and lost packets of a stream, which may have several files.

    A packet's context says how many events were discarded since the stream began (LTTng's packet
    context, section 5.2; counters of 32-bit tracers wrap). If the first packet here is the
    stream's first, all that it says counts. A snapshot or a rotated trace begins anywhere, and
    what was discarded before it does not count.
    """
    # Files of one stream follow each other (tracefile rotation), but not always in order of name.
    order = np.argsort(_column(files, "begin"), kind="stable")
    counter, sequence = (_column(files, name)[order] for name in ("discarded", "sequence"))
    steps = np.diff(counter, prepend=0 if sequence[0] <= 0 else counter[0])
    steps[steps < 0] += 1 << 32
    discarded = int(steps[steps > 0].sum()) if (counter >= 0).all() else 0
    gaps = np.diff(sequence) - 1
    return discarded, int(gaps[gaps > 0].sum()) if (sequence >= 0).all() else 0


def _column(files: list[CtfStream], name: str) -> NDArray[np.int64]:
    return np.concatenate([file.packets[name].to_numpy() for file in files])


# Stream files


class MappedFile:
    """A file mapped for reading: its ``bytes``, and their number, ``size``."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self.bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise CtfError(path, None, f"cannot map the file: {error}") from error
        self.size = len(self.bytes)

    def begins_with_zeros(self, start: int) -> bool:
        """Whether zeros stand where a packet that begins at ``start`` has its magic number."""
        return not any(self.bytes[start : start + 4])

    def forget(self, packets: pl.DataFrame) -> None:
        """Give back the memory of successive packets; the kernel may still cache the file."""
        first = -(-packets["offset"][0] // mmap.PAGESIZE) * mmap.PAGESIZE
        last = packets["offset"][-1] + packets["size"][-1]
        if last - first >= mmap.PAGESIZE:
            self.bytes.madvise(mmap.MADV_DONTNEED, first, last - first)


class _Packets(NamedTuple):
    """The packets of a stream file, and what is damaged in it."""

    packets: pl.DataFrame  # see `CtfStream`
    damaged: int = 0  # places that are no packets
    warnings: tuple[str, ...] = ()


def _packets_of(path: Path, layout: _core.CtfLayout, number: int, folder: TraceClass) -> _Packets:
    """Find the packets of a stream file of the folder with this number.

    Where bytes are no packet, the decoder goes on at the next packet of the same trace.
    """
    if path.stat().st_size == 0:
        return _Packets(pl.DataFrame())
    file = MappedFile(path)
    decoded = _core.find_packets(layout, number, file.bytes, beginning=_beginning(folder))
    times = _times_of_events(decoded.columns, folder, layout.traces[number][0])
    packets = pl.DataFrame({**decoded.columns, **times})
    warnings = [_damage(path, file, place) for place in decoded.damaged[:_MOST_WARNINGS]]
    # A file without any packet is another program's, unless it has nothing but zeros.
    is_stream = len(packets) > 0 or file.begins_with_zeros(0)
    damaged = len(decoded.damaged)
    if damaged > _MOST_WARNINGS:
        warnings.append(f"{path}: {damaged - _MOST_WARNINGS} more places are like that")
        return _Packets(packets, damaged, tuple(warnings))
    return _Packets(packets, damaged if is_stream else 0, tuple(warnings))


def _damage(path: Path, file: MappedFile, place: _core.CtfDamagedPlace) -> str:
    """Say what is wrong at a damaged place, and what is not read therefore."""
    reason = _REASONS[place.damage]
    if place.damage == _core.CtfDamage.BAD_MAGIC and file.begins_with_zeros(place.offset):
        reason = "zeros instead of a packet: the disk was full, or the recording was not stopped"
    unread = f"{place.following - place.offset} bytes are not read"
    if place.following < 0:
        unread = f"the last {file.size - place.offset} bytes of the file are not read"
    if place.damage == _core.CtfDamage.CUT:
        unread = "events up to the cut are read"
        if place.following >= 0:
            reason = "packet with a size that reaches over the next one"
    return str(CtfError(path, place.offset, reason, unread))


def _beginning(folder: TraceClass) -> bytes:
    """Return the bytes that each packet of a trace begins with: magic number and UUID.

    Returns none where packets have no UUID: the magic number alone may be in an event as well.
    """
    header = folder.packet_header.fields if folder.packet_header is not None else ()
    match header[:2]:
        case [
            ("magic", IntegerType(size=32, align=8 | 16 | 32)),
            ("uuid", ArrayType(IntegerType(8, 8), 16)),
        ] if folder.uuid is not None:
            order: Literal["little", "big"] = "big" if folder.byte_order == "be" else "little"
            return MAGIC.to_bytes(4, order) + UUID(folder.uuid).bytes
    return b""


def _times_of_events(
    packets: dict[str, NDArray[np.int64]], folder: TraceClass, first_class: int
) -> dict[str, NDArray[np.int64]]:
    """Return the columns ``earliest`` and ``latest``: which times events of each packet can have.

    ``first_class`` is the number of the folder's first stream class.
    LTTng before 2.11 may close a packet while an event is being written into it, so that event is
    later than the packet's end; and packets of a crash say no end. In both cases the beginning of
    the next packet is the limit.
    """
    begin, end, stream_class = packets["begin"], packets["end"], packets["stream_class"]
    earliest, latest = (np.full(len(begin), time, np.int64) for time in _ALWAYS)
    major, minor = (folder.env.get(f"tracer_{part}") for part in ("major", "minor"))
    known_version = isinstance(major, int) and isinstance(minor, int)
    closes_early = known_version and (major, minor) < (2, 11)
    following = np.append(begin[1:], -1)[: len(begin)]
    following[following < begin] = _ALWAYS[1]
    last = np.where((end < begin) | closes_early, np.maximum(end, following), end)
    for number, stream in enumerate(folder.streams.values(), first_class):
        context = dict(stream.packet_context.fields) if stream.packet_context is not None else {}
        stamps = (context.get(name) for name in ("timestamp_begin", "timestamp_end"))
        if all(isinstance(kind, IntegerType) and kind.clock and kind.size == 64 for kind in stamps):
            known = (stream_class == number) & (begin > 0)
            earliest[known], latest[known] = begin[known], last[known]
    return {"earliest": earliest, "latest": latest}


# The metadata file

METADATA_MAGIC = 0x75D11D57
_LARGEST = 64 << 20  # bytes
_RECORD_SEPARATOR = b"\x1e"  # begins every fragment of CTF 2's JSON text sequence


def read_metadata(path: Path) -> TraceClass:
    """Read and parse a metadata file; raises `CtfError` naming the file and the byte offset."""
    text, pieces = read_metadata_text(path)
    if not text.strip(" \t\r\n\0"):
        raise _not_whole(path, _in_file(0, pieces), "the metadata is empty (no trace block)")
    try:
        return replace(parse_tsdl(text), path=path.parent)
    except TsdlError as error:
        offset, reason = error.args
        place = _in_file(len(text[:offset].encode()), pieces)
        # Metadata that is whole ends with a block (`};`) or a comment. Of metadata that stops too
        # early all is right up to where it stops, so the error is at its end.
        written = text.rstrip(" \t\r\n\0")
        if offset >= len(written) or not written.endswith((";", "*/")):
            raise _not_whole(path, place, f"the metadata ends in the middle ({reason})") from None
        remedy = "record again, or report this with the file"
        raise CtfError(path, place, f"metadata cannot be understood: {reason}", remedy) from None


def _not_whole(path: Path, place: int, reason: str) -> CtfError:
    """Make the error for metadata that the tracer did not finish: what to do about it."""
    uuid = next(filter(None, map(_uuid_in, sorted(path.parent.iterdir()))), None)
    whose = "this trace's UUID" if uuid is None else f"the UUID of this trace, {uuid},"
    return CtfError(
        path,
        place,
        f"{reason}: the session was not stopped and destroyed in order (`lttng destroy`), or the"
        " disk was full; babeltrace2 cannot read it either",
        "record again; or copy the metadata of a run with the same set-up, whose nodes started in "
        f"the same order, and write {whose} in place of its own: `sed -i s/OLD/NEW/ metadata`",
    )


def _uuid_in(path: Path) -> UUID | None:
    """Return the UUID in a stream file's first packet; None where it is no stream file."""
    if path.name == "metadata" or not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(20)
    if len(head) == 20 and head[:4] in {
        MAGIC.to_bytes(4, "little"),
        MAGIC.to_bytes(4, "big"),
    }:
        return UUID(bytes=head[4:])
    return None


def read_metadata_text(path: Path) -> tuple[str, list[tuple[int, int]]]:
    """Read the TSDL text of a metadata file, plain or in packets (section 7.1), and its pieces.

    A piece is the part of the text in one packet: (where it begins in the text, and in the file),
    in bytes. Raises `CtfError`.
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
    """Return where in the file a byte of the text is."""
    start, offset = next(p for p in reversed(pieces) if p[0] <= position)
    return offset + position - start


def _unpacked(path: Path, data: bytes, order: str) -> tuple[bytes, list[tuple[int, int]]]:
    """Take the text and its pieces out of packets whose integers have this byte order."""
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
