"""The functions that an ELF-64 file defines: which it exports, and where in the file they begin.

Upstream: elf(5).
"""

import os
import stat
import struct
from collections.abc import Iterator
from pathlib import Path

__all__ = ["exported_functions", "function_offsets", "open_regular", "read_regular"]

_LONGEST = 512 << 20

_SYMTAB, _DYNSYM, _FUNCTION, _LOAD = 2, 11, 2, 1  # elf.h: SHT_…, STT_FUNC, PT_LOAD


def open_regular(path: Path) -> int:
    """Open a file at a path that a process of the application has named: no pipe, no device.

    Raises:
        OSError: it is no ordinary file, or cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is no ordinary file")
    return descriptor


def read_regular(path: Path, longest: int = _LONGEST) -> bytes:
    """The contents of such a file.

    Raises:
        OSError: as :func:`open_regular`, or it is longer than that.
    """
    with open(open_regular(path), "rb") as file:
        content = file.read(longest + 1)
    if len(content) > longest:
        raise OSError(f"{path} has more than {longest} bytes")
    return content


def exported_functions(path: Path) -> frozenset[str]:
    """The functions in a file's dynamic symbol table; none if it is no such file."""
    try:
        content = read_regular(path)
        return frozenset(name for _, name in _functions(content, (_DYNSYM,)))
    except (OSError, LookupError, struct.error, ValueError):
        return frozenset()


def function_offsets(path: Path) -> dict[int, str]:
    """Where functions begin in a file, in bytes, and their names; also of those not exported."""
    try:
        content = read_regular(path)
        loaded = list(_segments(content))
        return {
            address - memory + offset: name
            for address, name in _functions(content, (_DYNSYM, _SYMTAB))
            for offset, memory, size in loaded
            if memory <= address < memory + size
        }
    except (OSError, LookupError, struct.error, ValueError):
        return {}


def _order(content: bytes) -> str:
    if content[:5] != b"\x7fELF\x02":
        raise ValueError("no ELF-64 file")
    return {1: "<", 2: ">"}[content[5]]


def _segments(content: bytes) -> Iterator[tuple[int, int, int]]:
    """What is loaded: place in the file, address, and length there."""
    order = _order(content)
    (begin,) = struct.unpack_from(f"{order}Q", content, 32)
    size, count = struct.unpack_from(f"{order}HH", content, 54)
    for number in range(count):
        kind, _, offset, address, _, length, _, _ = struct.unpack_from(
            f"{order}IIQQQQQQ", content, begin + size * number
        )
        if kind == _LOAD:
            yield offset, address, length


def _functions(content: bytes, tables: tuple[int, ...]) -> Iterator[tuple[int, str]]:
    """Addresses and names of the functions that a file's symbol tables define."""
    order = _order(content)
    (sections_at,) = struct.unpack_from(f"{order}Q", content, 40)
    size, count = struct.unpack_from(f"{order}HH", content, 58)
    sections = [
        struct.unpack_from(f"{order}IIQQQQIIQQ", content, sections_at + size * number)
        for number in range(count)
    ]
    for _, kind, _, _, start, length, names, *_ in sections:
        if kind not in tables:
            continue
        names_at = sections[names][4]
        for at in range(start, start + length, 24):
            name, info, _, section, address = struct.unpack_from(f"{order}IBBHQ", content, at)
            if info & 0xF == _FUNCTION and section:  # of section 0: imported, not defined
                begin = names_at + name
                yield address, content[begin : content.index(b"\0", begin)].decode()
