"""What the freezer's processes tell each other and everybody: a few numbers in shared memory.

A dispatcher must not wait for anybody, so it tells nothing: it keeps its numbers in memory that
others can read. Not in a file on a disk, though: a store to a mapped page that is being written
back waits for the disk, for 0.1 s and more. The memory belongs to the owner and has no file; it is
reached through the owner's descriptors for as long as the owner lives. All numbers are 64-bit
integers in the machine's order, each written by one kind of process only:

    the owner    released
    per core     beats, acknowledged, real time, and (by guardians) let go (ns), silent
    per server   slots, late entries, longest lateness (ns), overruns, groups lost

``beats`` moves as long as its process does; one that did not for too long was ``silent``.
A guardian that thaws the threads of one that is still for a moment says when it has: ``let go``.
``acknowledged`` is the number of the last command that a dispatcher has carried out. Servers that
are ``released`` need no dispatcher any more. Overruns of -1 cannot be known here.
"""

import ctypes
import mmap
import os
from pathlib import Path

from chainshaper.enforcement.servers import ServerCounters, ServerTable

__all__ = ["CounterPage", "create_page", "open_page", "read_counters"]


def _numbers(*names: str) -> list[tuple[str, type[ctypes.c_int64]]]:
    return [(name, ctypes.c_int64) for name in names]


class _Core(ctypes.Structure):
    beats: int
    acknowledged: int
    real_time: int
    let_go: int
    silent: int
    _fields_ = _numbers("beats", "acknowledged", "real_time", "let_go", "silent")


class _Server(ctypes.Structure):
    slots: int
    late: int
    longest: int
    overruns: int
    lost: int
    _fields_ = _numbers("slots", "late", "longest", "overruns", "lost")


class CounterPage:
    """The numbers of a table's owner, cores and servers, in memory that is theirs."""

    def __init__(self, memory: mmap.mmap, table: ServerTable) -> None:
        place = ctypes.sizeof(ctypes.c_int64)
        self.released = ctypes.c_int64.from_buffer(memory)
        self.cores: dict[int, _Core] = {}
        for core in sorted({server.core for server in table.servers}):
            self.cores[core] = _Core.from_buffer(memory, place)
            place += ctypes.sizeof(_Core)
        self.servers: dict[str, _Server] = {}
        for server in table.servers:
            self.servers[server.name] = _Server.from_buffer(memory, place)
            place += ctypes.sizeof(_Server)


def create_page(table: ServerTable) -> tuple[CounterPage, Path, int]:
    """Make the memory, all numbers 0.

    Returns as well where others find it, and the descriptor: closing it ends that.
    """
    memory = os.memfd_create("counters")
    each = ctypes.sizeof(_Core) + ctypes.sizeof(_Server)  # there are not more cores than servers
    os.truncate(memory, ctypes.sizeof(ctypes.c_int64) + each * len(table.servers))
    path = Path(f"/proc/{os.getpid()}/fd/{memory}")
    return open_page(path, table), path, memory


def open_page(path: Path, table: ServerTable) -> CounterPage:
    """Map the numbers of a run for reading and writing.

    Raises:
        OSError: its owner has ended, or belongs to another user.
    """
    with path.open("r+b") as file:
        return CounterPage(mmap.mmap(file.fileno(), 0), table)


def read_counters(page: CounterPage) -> dict[str, ServerCounters]:
    """The counters of every server, as :meth:`BackEnd.counters` gives them."""
    return {
        name: ServerCounters(
            its.slots, its.late, its.longest, its.overruns if its.overruns >= 0 else None
        )
        for name, its in page.servers.items()
    }
