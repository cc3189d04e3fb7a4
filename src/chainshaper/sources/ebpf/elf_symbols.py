"""The functions that an ELF-64 file defines: which it exports, and where in the file they begin.

Upstream: elf(5).
"""

import struct
from collections.abc import Iterator
from pathlib import Path

__all__ = ["exported_functions", "function_offsets"]

_SYMTAB, _DYNSYM, _FUNCTION, _LOAD = 2, 11, 2, 1  # elf.h: SHT_…, STT_FUNC, PT_LOAD


def exported_functions(path: Path) -> frozenset[str]:
    """The functions in a file's dynamic symbol table; none if it is no such file."""
    try:
        content = path.read_bytes()
        return frozenset(name for _, name in _functions(content, (_DYNSYM,)))
    except (OSError, LookupError, struct.error, ValueError):
        return frozenset()


def function_offsets(path: Path) -> dict[int, str]:
    """Where functions begin in a file, in bytes, and their names; also of those not exported."""
    try:
        content = path.read_bytes()
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
