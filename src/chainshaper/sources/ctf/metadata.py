"""A trace's ``metadata`` file: plain TSDL text or packets of it (CTF 1.8, section 7.1)."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.tokens import TsdlError
from chainshaper.sources.ctf.tsdl import parse_tsdl
from chainshaper.sources.ctf.types import Clock, TraceClass

__all__ = ["METADATA_MAGIC", "CtfFolder", "read_metadata", "read_metadata_text"]

METADATA_MAGIC = 0x75D11D57
_HEADER = "I16sIIIBBBBB"
_LARGEST = 64 << 20
_RECORD_SEPARATOR = b"\x1e"  # begins every fragment of CTF 2's JSON text sequence


@dataclass(frozen=True)
class CtfFolder:
    """One folder with a ``metadata`` file: what it declares."""

    path: Path
    declared: TraceClass = field(repr=False)

    @property
    def clock(self) -> Clock:
        """The folder's clock; one of 1 GHz without offset where the metadata has none."""
        return next(iter(self.declared.clocks.values()), Clock("none"))


def read_metadata(path: Path) -> TraceClass:
    """Read and parse a metadata file; raises `CtfError` naming the file and the byte offset."""
    text, pieces = read_metadata_text(path)
    try:
        return parse_tsdl(text)
    except TsdlError as error:
        character, reason = error.args
        position = len(text[:character].encode())
        start, offset = next(p for p in reversed(pieces) if p[0] <= position)
        raise CtfError(
            path,
            offset + position - start,
            f"metadata cannot be understood: {reason}",
            "record again, or report this with the file",
        ) from None


def read_metadata_text(path: Path) -> tuple[str, list[tuple[int, int]]]:
    """The TSDL text of a metadata file, and where its pieces lie.

    Each piece is a pair (byte offset in the text, byte offset in the file).  Raises
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
    for order in "<>":
        if data[:4] == struct.pack(order + "I", METADATA_MAGIC):
            return _packets(path, data, order)
    return _decode(path, data, [(0, 0)]), [(0, 0)]


def _packets(path: Path, data: bytes, order: str) -> tuple[str, list[tuple[int, int]]]:
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
    return _decode(path, text, pieces), pieces


def _decode(path: Path, text: bytes | bytearray, pieces: list[tuple[int, int]]) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError as error:
        start, offset = next(p for p in reversed(pieces) if p[0] <= error.start)
        raise CtfError(
            path,
            offset + error.start - start,
            "metadata is not UTF-8 text",
            "is this a CTF 1.8 trace?",
        ) from None
