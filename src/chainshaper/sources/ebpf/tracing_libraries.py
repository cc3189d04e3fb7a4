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

from chainshaper.sources.ebpf.elf_symbols import exported_functions

__all__ = ["LIBRARY", "TracingLibrary", "installed_libraries", "mapped_libraries"]

LIBRARY = "libtracetools.so"
_INSTALLATIONS = Path("/opt/ros")
_VERSION = re.compile(r"<version>\s*((\d+)[^<\s]*)\s*</version>")


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


def installed_libraries(environment: Mapping[str, str]) -> tuple[TracingLibrary, ...]:
    """The libraries that a command started with this environment can find.

    All below `/opt/ros` are among them: the command may be a script that sets up its ROS 2 itself.
    """
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(":")
    folders = [Path(prefix) / "lib" for prefix in prefixes if prefix]
    folders += [Path(entry) for entry in environment.get("LD_LIBRARY_PATH", "").split(":") if entry]
    folders += sorted(_INSTALLATIONS.glob("*/lib"))
    return _read(folder / LIBRARY for folder in folders)


def mapped_libraries(pids: Iterable[int]) -> dict[int, tuple[TracingLibrary, ...]]:
    """Process → the libraries that it has mapped; only those that have one."""
    known: dict[tuple[int, int], TracingLibrary] = {}
    found = {}
    for pid in pids:
        libraries = []
        for path in _mapped(pid):
            status = path.stat()
            key = status.st_dev, status.st_ino
            if key not in known:
                known[key] = _library(path)
            libraries.append(known[key])
        if libraries:
            found[pid] = tuple(libraries)
    return found


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


def _read(paths: Iterable[Path]) -> tuple[TracingLibrary, ...]:
    files: dict[tuple[int, int], Path] = {}
    for path in paths:
        if path.is_file():
            status = path.stat()
            files.setdefault((status.st_dev, status.st_ino), path.absolute())
    return tuple(_library(path) for path in files.values())


def _library(path: Path) -> TracingLibrary:
    return TracingLibrary(path, exported_functions(path), _version(path))


def _version(library: Path) -> str | None:
    """The version of tracetools, as its package says beside the library."""
    for folder in library.parents[1:3]:  # `lib`, or `lib/x86_64-linux-gnu`, is in the prefix
        with suppress(OSError):
            text = (folder / "share/tracetools/package.xml").read_text(errors="replace")
            found = _VERSION.search(text)
            if found is not None:
                return found[1]
    return None
