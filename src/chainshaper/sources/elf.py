"""Functions in ELF files, and the files that a process has mapped.

Upstream: elf(5), proc(5).
"""

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from chainshaper.linux.processes import Region, regions_in
from chainshaper.linux.threads import read_proc
from chainshaper.values.errors import text_of
from chainshaper.values.files import read_regular

_SYMTAB, _DYNSYM, _FUNCTION, _LOAD = 2, 11, 2, 1  # elf.h: SHT_…, STT_FUNC, PT_LOAD
_NO_ELF = (OSError, LookupError, struct.error, ValueError)


def exported_functions(path: Path) -> frozenset[str]:
    """Return the functions in an ELF-64 file's dynamic symbol table; none if it is no such file."""
    with suppress(*_NO_ELF):
        return frozenset(name for _, name in _functions(read_regular(path), (_DYNSYM,)))
    return frozenset()


def function_offsets(path: Path) -> dict[int, str]:
    """Return where functions begin in a file, in bytes, and their names, exported or not."""
    with suppress(*_NO_ELF):
        content = read_regular(path)
        segments = _entries(content, 32, 54, "IIQQQQQQ")
        loaded = [segment[2:6] for segment in segments if segment[0] == _LOAD]
        return {
            address - memory + offset: name
            for address, name in _functions(content, (_DYNSYM, _SYMTAB))
            for offset, memory, _, size in loaded
            if memory <= address < memory + size
        }
    return {}


def _entries(content: bytes, at: int, count_at: int, layout: str) -> Iterator[tuple[int, ...]]:
    """Yield the entries of a table: the header says at ``at`` where it is, then how long."""
    if content[:5] != b"\x7fELF\x02":
        raise ValueError("no ELF-64 file")
    order = {1: "<", 2: ">"}[content[5]]
    (begin,) = struct.unpack_from(f"{order}Q", content, at)
    size, count = struct.unpack_from(f"{order}HH", content, count_at)
    for number in range(count):
        yield struct.unpack_from(order + layout, content, begin + size * number)


def _functions(content: bytes, tables: tuple[int, ...]) -> Iterator[tuple[int, str]]:
    """Yield addresses and names of the functions that a file's symbol tables define."""
    sections = list(_entries(content, 40, 58, "IIQQQQIIQQ"))
    layout = {1: "<IBBHQ", 2: ">IBBHQ"}[content[5]]
    for _, kind, _, _, start, length, names, *_ in sections:
        for at in range(start, start + length, 24) if kind in tables else ():
            name, info, _, section, address = struct.unpack_from(layout, content, at)
            if info & 0xF == _FUNCTION and section:  # of section 0: imported, not defined
                begin = sections[names][4] + name
                yield address, text_of(content[begin : content.index(b"\0", begin)])


def mapped_regions(pid: int) -> Iterator[Region]:
    """Return the regions that files are mapped to, by address.

    Raises OSError: the process is gone, or another user's.
    """
    regions = regions_in(read_proc(f"/proc/{pid}/maps"))
    return (region for region in regions if region.path.startswith("/"))
