"""The trace points of `libtracetools.so` as C functions: which libraries export which of them.

Every ROS 2 build with tracing compiled in calls `ros_trace_<event>(arguments…)` of that library,
whether or not LTTng is there. The arguments are the fields of the event's table
(:mod:`chainshaper.values.events`) in the same order, with these exceptions:

* `rcl_init` has no version among them: that is the library's own, from its `package.xml`;
* `rclcpp_publish` has the publisher's address before the message's, mostly null, and no column;
* `rmw_publish` had the message only, before tracetools 8 (Humble and Iron).

`rclcpp_callback_register` is not called from Iron on, except under an LTTng session.

An application to be started finds the library as the dynamic linker will: below the prefixes of the
environment that ROS 2's set-up files make. Applications that run already have mapped it; what they
mapped is reached through `/proc/PID/root` where they run in a container. The same file found twice
counts once, because uprobes belong to the file. Distributions differ in what they trace, so what a
library exports is read from its symbol table.

Upstream: ros2_tracing, `tracetools/include/tracetools/tracetools.h`, tags 4.1.1 to 8.10.1;
elf(5); proc(5).
"""

import os
import re
import stat
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import polars as pl

from chainshaper.values import events

FUNCTION_PREFIX = "ros_trace_"
LIBRARY = "libtracetools.so"
_INSTALLATIONS = Path("/opt/ros")
_VERSION = re.compile(r"<version>\s*((\d{1,9})(?!\d)[^<\s]{0,99})\s*</version>")
_LONGEST, _LONGEST_PACKAGE = 512 << 20, 1 << 20  # bytes
_SYMTAB, _DYNSYM, _FUNCTION, _LOAD = 2, 11, 2, 1  # elf.h: SHT_…, STT_FUNC, PT_LOAD
_UNREADABLE = (OSError, LookupError, struct.error, ValueError)


@dataclass(frozen=True)
class TracingLibrary:
    """A `libtracetools.so`; ``functions`` are those that it exports."""

    path: Path
    functions: frozenset[str]
    version: str | None

    @property
    def major(self) -> int | None:
        """The first number of the version."""
        return None if self.version is None else int(self.version.partition(".")[0])

    @property
    def handles_at_rmw(self) -> bool:
        """Whether `rmw_publish` of this version names its publisher."""
        return self.major is None or self.major >= 8


@dataclass(frozen=True)
class Argument:
    """A function's argument that becomes a column; ``place`` counts from 0."""

    column: str
    place: int
    kind: Literal["number", "flag", "text", "gid"]


@dataclass(frozen=True)
class TracePoint:
    """One event's function in one library, which is ``file`` of this ``version`` (None: unknown).

    ``handles_at_rmw`` is whether `rmw_publish` of this version names its publisher.
    """

    event: str
    file: Path
    arguments: tuple[Argument, ...]
    version: str | None
    handles_at_rmw: bool


_Known: TypeAlias = dict[tuple[int, int], TracingLibrary]
"""Libraries by device and inode."""


def trace_points(libraries: Sequence[TracingLibrary]) -> tuple[TracePoint, ...]:
    """All trace points that the libraries export and a table is for, in the tables' order."""
    return tuple(
        TracePoint(
            event=event,
            file=library.path,
            arguments=_arguments(event, library),
            version=library.version,
            handles_at_rmw=library.handles_at_rmw,
        )
        for event in events.FIELDS
        for library in libraries
        if FUNCTION_PREFIX + event in library.functions
    )


def _arguments(event: str, library: TracingLibrary) -> tuple[Argument, ...]:
    columns: tuple[str | None, ...] = tuple(events.FIELDS[event])
    if event == "rcl_init":
        columns = ("context_handle",)
    elif event == "rclcpp_publish":
        columns = (None, "message")
    elif event == "rmw_publish" and not library.handles_at_rmw:
        columns = ("message",)
    found = []
    for place, column in enumerate(columns):
        match events.FIELDS[event].get(column or ""):
            case pl.String():
                found.append(Argument(str(column), place, "text"))
            case pl.List():
                found.append(Argument(str(column), place, "gid"))
            case pl.Int32():
                found.append(Argument(str(column), place, "flag"))
            case pl.DataType():
                found.append(Argument(str(column), place, "number"))
    return tuple(found)


def installed_libraries(environment: Mapping[str, str]) -> tuple[TracingLibrary, ...]:
    """The libraries that a command started with this environment can find.

    All below `/opt/ros` are among them: the command may be a script that sets up its ROS 2 itself.
    """
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(":")
    folders = [Path(prefix) / "lib" for prefix in prefixes if prefix]
    folders += [Path(entry) for entry in environment.get("LD_LIBRARY_PATH", "").split(":") if entry]
    folders += sorted(_INSTALLATIONS.glob("*/lib"))
    known: _Known = {}
    for folder in folders:
        if (folder / LIBRARY).is_file():
            _library((folder / LIBRARY).absolute(), known)
    return tuple(known.values())


def mapped_libraries(pids: Iterable[int]) -> dict[int, tuple[TracingLibrary, ...]]:
    """Process → the libraries that it has mapped; only those that have one."""
    known: _Known = {}
    found = {pid: tuple(_library(path, known) for path in _mapped(pid)) for pid in pids}
    return {pid: libraries for pid, libraries in found.items() if libraries}


def _mapped(pid: int) -> Iterator[Path]:
    """Files of that name which a process has mapped, by paths that lead there from here."""
    with suppress(OSError):  # it is gone, or another user's
        maps = Path(f"/proc/{pid}/maps").read_text(errors="replace")
        paths = {line.split(maxsplit=5)[5] for line in maps.splitlines() if f"/{LIBRARY}" in line}
        for mapped in sorted(paths):
            inside = Path(f"/proc/{pid}/root{mapped}")
            if not inside.is_file():
                continue  # replaced since: its new contents are not what runs
            outside = Path(mapped)
            yield outside if outside.is_file() and outside.samefile(inside) else inside


def _library(path: Path, known: _Known) -> TracingLibrary:
    status = path.stat()
    key = status.st_dev, status.st_ino
    if key not in known:
        known[key] = TracingLibrary(path, exported_functions(path), _version(path))
    return known[key]


def _version(library: Path) -> str | None:
    """The version of tracetools, as its package says beside the library."""
    for folder in library.parents[1:3]:  # `lib`, or `lib/x86_64-linux-gnu`, is in the prefix
        with suppress(OSError):
            package = folder / "share/tracetools/package.xml"
            text = _read_regular(package, _LONGEST_PACKAGE).decode(errors="replace")
            found = _VERSION.search(text)
            if found is not None:
                return found[1]
    return None


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


def _read_regular(path: Path, longest: int = _LONGEST) -> bytes:
    with open(open_regular(path), "rb") as file:
        content = file.read(longest + 1)
    if len(content) > longest:
        raise OSError(f"{path} has more than {longest} bytes")
    return content


def exported_functions(path: Path) -> frozenset[str]:
    """The functions in an ELF-64 file's dynamic symbol table; none if it is no such file."""
    try:
        return frozenset(name for _, name in _functions(_read_regular(path), (_DYNSYM,)))
    except _UNREADABLE:
        return frozenset()


def function_offsets(path: Path) -> dict[int, str]:
    """Where functions begin in a file, in bytes, and their names; also of those not exported."""
    try:
        content = _read_regular(path)
        loaded = list(_segments(content))
        return {
            address - memory + offset: name
            for address, name in _functions(content, (_DYNSYM, _SYMTAB))
            for offset, memory, size in loaded
            if memory <= address < memory + size
        }
    except _UNREADABLE:
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
