"""The `libtracetools.so` that an application uses, or will use, and what it exports.

The application to be started finds it as the dynamic linker will: below the prefixes of the
environment that ROS 2's set-up files make. Applications that run already have mapped it; what they
mapped is reached through `/proc/PID/root` where they run in a container. The same file found twice
counts once, because uprobes belong to the file.

Distributions differ in what they trace, so what a library exports is read from its symbol table,
and its version from the `package.xml` that is installed with it.

Upstream: proc(5).
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from chainshaper.sources.ebpf.elf_symbols import exported_functions, read_regular

__all__ = ["LIBRARY", "TracingLibrary", "installed_libraries", "mapped_libraries"]

LIBRARY = "libtracetools.so"
_INSTALLATIONS = Path("/opt/ros")
_VERSION = re.compile(r"<version>\s*((\d{1,9})(?!\d)[^<\s]{0,99})\s*</version>")
_LONGEST_PACKAGE = 1 << 20


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


_Known: TypeAlias = dict[tuple[int, int], TracingLibrary]
"""Libraries by device and inode."""


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
            text = read_regular(package, _LONGEST_PACKAGE).decode(errors="replace")
            found = _VERSION.search(text)
            if found is not None:
                return found[1]
    return None
