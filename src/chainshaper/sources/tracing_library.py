"""`libtracetools.so`, whose functions `ros_trace_<event>` emit the events: paths and versions.

Upstream: ros2_tracing, tags 4.1.1 to 8.10.1.
"""

import ctypes
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from chainshaper.sources.elf import exported_functions, mapped_regions
from chainshaper.values.files import read_regular

FUNCTION_PREFIX = "ros_trace_"
LIBRARY = "libtracetools.so"
_INSTALLATIONS = Path("/opt/ros")
_VERSION = re.compile(r"<version>\s*((\d{1,9})(?!\d)[^<\s]{0,99})\s*</version>")
_LONGEST_PACKAGE = 1 << 20  # bytes
_OVERLAY = 0x794C7630


@dataclass(frozen=True)
class TracingLibrary:
    """A `libtracetools.so`."""

    path: Path
    functions: frozenset[str]  # that it exports
    version: str | None  # of tracetools; None: not known

    @property
    def major(self) -> int:
        """The first number of the version; if it is not known, that of a present version."""
        return 8 if self.version is None else int(self.version.partition(".")[0])

    @property
    def handles_at_rmw(self) -> bool:
        """Whether `rmw_publish` has the publisher's handle."""
        return self.major >= 8


def installed_libraries(environment: Mapping[str, str]) -> tuple[TracingLibrary, ...]:
    """Return the libraries that a command in this environment can find, and all below /opt/ros."""
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(":")
    folders = [f"{prefix}/lib" for prefix in prefixes if prefix]
    folders += filter(None, environment.get("LD_LIBRARY_PATH", "").split(":"))
    folders += map(str, sorted(_INSTALLATIONS.glob("*/lib")))
    files = [Path(folder, LIBRARY) for folder in folders]
    there = [file.absolute() for file in files if file.is_file()]
    return tuple(dict.fromkeys(_libraries_at(there, {})))


def mapped_libraries(pids: Iterable[int]) -> dict[int, tuple[TracingLibrary, ...]]:
    """Return process → the libraries that it has mapped, if any."""
    known: dict[tuple[int, ...], TracingLibrary] = {}
    mapped = {pid: tuple(_libraries_at(_mapped(pid), known)) for pid in pids}
    return {pid: libraries for pid, libraries in mapped.items() if libraries}


def _mapped(pid: int) -> Iterator[Path]:
    """Yield the libraries that a process has mapped, by paths that lead there from here."""
    with suppress(OSError):  # it is gone, or another user's
        paths = {region.path for region in mapped_regions(pid) if f"/{LIBRARY}" in region.path}
        for mapped in sorted(paths):
            inside = Path(f"/proc/{pid}/root{mapped}")  # as a container has it
            if inside.is_file():  # else replaced since: its new contents are not what runs
                outside = Path(mapped)
                yield outside if outside.is_file() and outside.samefile(inside) else inside


def _libraries_at(
    paths: Iterable[Path], known: dict[tuple[int, ...], TracingLibrary]
) -> Iterator[TracingLibrary]:
    """Yield the libraries at some paths; ``known`` has those that were seen before.

    Uprobes are set in a device's inode, so that is their key. Containers of one image share it,
    each through an overlay of its own: a probe in every one of these would fire for all.
    """
    for path in paths:
        status = path.stat()
        key: tuple[int, ...] = (status.st_dev, status.st_ino)
        if _is_overlaid(path):
            key = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        if key not in known:
            known[key] = TracingLibrary(path, exported_functions(path), version_of(path))
        yield known[key]


def _is_overlaid(path: Path) -> bool:
    """Return whether an overlay shows the file. Upstream: statfs(2), OVERLAYFS_SUPER_MAGIC."""
    status = ctypes.create_string_buffer(256)
    ctypes.CDLL(None).statfs(os.fsencode(path), status)
    return int.from_bytes(status.raw[:4], sys.byteorder) == _OVERLAY


def version_of(library: Path) -> str | None:
    """Return the version of tracetools, by its package beside the library; None: there is none."""
    for folder in library.parents[1:3]:  # `lib`, or `lib/x86_64-linux-gnu`, is in the prefix
        with suppress(OSError):
            package = read_regular(folder / "share/tracetools/package.xml", _LONGEST_PACKAGE)
            if version := _VERSION.search(package.decode(errors="replace")):
                return version[1]
    return None
