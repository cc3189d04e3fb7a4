"""Opening CTF traces: metadata files, what was recorded where by which clock, what was lost."""

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.assembly import Wanted, assemble
from chainshaper.sources.ctf.decode import CtfStream, packet_table
from chainshaper.sources.ctf.tsdl import TsdlError, parse_tsdl
from chainshaper.sources.ctf.types import CtfError, CtfFolder, TraceClass

__all__ = ["METADATA_MAGIC", "CtfTrace", "open_trace", "read_metadata", "read_metadata_text"]

METADATA_MAGIC = 0x75D11D57
_HEADER = "I16sIIIBBBBB"
_LARGEST = 64 << 20
_RECORD_SEPARATOR = b"\x1e"  # begins every fragment of CTF 2's JSON text sequence

_Tables = list[tuple[Path, NDArray[np.int64]]]
"""Stream files and their packets."""


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

    Reads metadata and packet headers only. Raises `CtfError` where a path holds no trace or
    metadata cannot be understood; stream files with damage give ``warnings`` instead.
    """
    folders = [CtfFolder(path, read_metadata(path / "metadata")) for path in _find(paths)]
    assembly = assemble(folders, Wanted())
    rates = [row[tb.S_FREQUENCY] for row in assembly.stream_rows]
    warnings = _clock_warnings(folders)
    streams: list[CtfStream] = []
    for number, folder in enumerate(folders):
        tables: _Tables = []
        for path in _stream_paths(folder.path):
            table, found = packet_table(path, assembly, number)
            warnings += found
            if len(table):
                tables.append((path, table))
        streams += _streams(number, tables, rates, warnings)
    names = {
        e.name for f in folders for s in f.declared.streams.values() for e in s.events.values()
    }
    return CtfTrace(
        folders=tuple(folders),
        streams=tuple(streams),
        event_names=tuple(sorted(names)),
        env=folders[0].declared.env,
        clock_offset_ns=folders[0].clock.offset_ns,
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


def _stream_paths(folder: Path) -> list[Path]:
    """The stream files of a trace folder: all plain files but ``metadata`` and hidden ones."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.name != "metadata" and not path.name.startswith(".")
    )


def _clock_warnings(folders: list[CtfFolder]) -> list[str]:
    first = folders[0].clock
    return [
        f"{folder.path}: clock {folder.clock.name!r} is not the clock of {folders[0].path};"
        " times of the two cannot be compared"
        for folder in folders[1:]
        if (folder.clock.name, folder.clock.uuid) != (first.name, first.uuid)
    ]


def _streams(
    folder: int, tables: _Tables, rates: list[int], warnings: list[str]
) -> list[CtfStream]:
    """The streams of a folder's files, with what was lost counted per stream."""
    groups: dict[Any, list[int]] = {}
    for index, (path, table) in enumerate(tables):
        stream, instance = table[0, [tb.P_STREAM, tb.P_INSTANCE]].tolist()
        groups.setdefault((stream, path if instance < 0 else instance), []).append(index)
    losses = {
        group[0]: _count_losses([tables[i] for i in group], warnings) for group in groups.values()
    }
    found = []
    for index, (path, table) in enumerate(tables):
        stream, instance, begin = table[0, [tb.P_STREAM, tb.P_INSTANCE, tb.P_BEGIN]].tolist()
        end, rate = int(table[-1, tb.P_LAST]), rates[stream]
        discarded, lost = losses.get(index, (0, 0))
        found.append(
            CtfStream(
                path=path,
                folder=folder,
                instance=None if instance < 0 else instance,
                packets=len(table),
                begin_ns=begin * tb.BILLION // rate if begin >= 0 else None,
                end_ns=end * tb.BILLION // rate if end >= 0 else None,
                discarded_events=discarded,
                lost_packets=lost,
                table=table,
            )
        )
    return found


def _count_losses(
    files: Sequence[tuple[Path, NDArray[np.int64]]], warnings: list[str]
) -> tuple[int, int]:
    """Discarded events and lost packets of one stream (LTTng's packet context, section 5.2).

    ``events_discarded`` counts from the beginning of the stream (32-bit tracers' counters wrap).
    What the first packet says counts where it is the stream's first; a snapshot or a rotated
    trace begins anywhere, and what was lost before it is not its own. A gap in
    ``packet_seq_num`` is that many packets lost.
    """
    table = np.concatenate([table for _, table in files])
    # Files of one stream follow each other (tracefile rotation), not always by name.
    table = table[np.argsort(table[:, tb.P_BEGIN], kind="stable")]
    counter, sequence = table[:, tb.P_DISCARDED], table[:, tb.P_SEQUENCE]
    steps = np.diff(counter, prepend=0 if sequence[0] <= 0 else counter[0])
    steps[steps < 0] += 1 << 32
    discarded = int(steps[steps > 0].sum()) if (counter >= 0).all() else 0
    gaps = np.diff(sequence) - 1
    lost = int(gaps[gaps > 0].sum()) if (sequence >= 0).all() else 0
    path = files[0][0]
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
    return discarded, lost


def read_metadata(path: Path) -> TraceClass:
    """Read and parse a metadata file; raises `CtfError` naming the file and the byte offset."""
    text, pieces = read_metadata_text(path)
    try:
        return parse_tsdl(text)
    except TsdlError as error:
        character, reason = error.args
        raise CtfError(
            path,
            _in_file(len(text[:character].encode()), pieces),
            f"metadata cannot be understood: {reason}",
            "record again, or report this with the file",
        ) from None


def read_metadata_text(path: Path) -> tuple[str, list[tuple[int, int]]]:
    """The TSDL text of a metadata file, plain or in packets (section 7.1), and its pieces.

    Each piece is a pair (byte offset in the text, byte offset in the file). Raises
    `CtfError` for a file that cannot be read, lying packet sizes, compression or encryption.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise CtfError(path, None, f"metadata of more than {_LARGEST >> 20} MiB")
        data = path.read_bytes()
    except OSError as error:
        raise CtfError(path, None, f"cannot read metadata: {error.strerror}") from error
    if data[:1] == _RECORD_SEPARATOR:
        raise CtfError(
            path,
            0,
            "CTF 2 metadata; CTF 1.8 is supported",
            "LTTng 2.15 and later: record with `lttng create --trace-format=ctf-1.8`",
        )
    pieces = [(0, 0)]
    for order in "<>":
        if data[:4] == struct.pack(order + "I", METADATA_MAGIC):
            data, pieces = _unpacked(path, data, order)
    try:
        return data.decode(), pieces
    except UnicodeDecodeError as error:
        raise CtfError(
            path,
            _in_file(error.start, pieces),
            "metadata is not UTF-8 text",
            "is this a CTF 1.8 trace?",
        ) from None


def _in_file(position: int, pieces: list[tuple[int, int]]) -> int:
    """Where a byte of the text lies in the file."""
    start, offset = next(p for p in reversed(pieces) if p[0] <= position)
    return offset + position - start


def _unpacked(path: Path, data: bytes, order: str) -> tuple[bytes, list[tuple[int, int]]]:
    header_size = struct.calcsize(order + _HEADER)
    text, pieces, offset = bytearray(), [], 0
    while offset < len(data):
        if offset + header_size > len(data):
            raise CtfError(path, offset, "metadata packet header cut short", "file is truncated")
        magic, _, _, content, size, compression, encryption, _, _, _ = struct.unpack_from(
            order + _HEADER, data, offset
        )
        content_bytes, size_bytes = content // 8, size // 8
        if magic != METADATA_MAGIC:
            raise CtfError(path, offset, f"metadata packet begins with 0x{magic:08X}")
        if compression or encryption:
            raise CtfError(path, offset, "compressed or encrypted metadata is not supported")
        if not header_size <= content_bytes <= size_bytes:
            raise CtfError(path, offset, f"metadata packet of {content} content, {size} bits")
        if offset + content_bytes > len(data):
            raise CtfError(path, offset, "metadata packet reaches past the end of the file")
        pieces.append((len(text), offset + header_size))
        text += data[offset + header_size : offset + content_bytes]
        offset += size_bytes
    return bytes(text), pieces
