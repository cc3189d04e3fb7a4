"""What the freezer's processes tell each other and everybody: a few numbers in shared memory.

A dispatcher must not wait for anybody, so it tells nothing: it keeps its numbers in memory that
others can read. Not in a file on a disk, though: a store to a mapped page that is being written
back waits for the disk, for 0.1 s and more. The memory belongs to the owner and has no file; a link
in the run directory leads to it for as long as the owner lives. All numbers are 64-bit integers
in the machine's order, each written by one process only:

    supervisor   beats
    per core     beats, acknowledged, real time, process id
    per server   slots, late entries, longest lateness (ns), overruns, groups lost

``beats`` moves as long as its process does. ``acknowledged`` is the number of the last command
that a dispatcher has carried out. Overruns of -1 cannot be known here.
"""

import mmap
import os
from pathlib import Path

from chainshaper.enforcement.servers import ServerCounters, ServerTable

__all__ = [
    "ACKNOWLEDGED",
    "BEATS",
    "LATE",
    "LONGEST",
    "LOST",
    "OVERRUNS",
    "PROCESS",
    "REAL_TIME",
    "SLOTS",
    "SUPERVISOR",
    "CounterPage",
    "create_page",
    "open_page",
    "read_counters",
]

SUPERVISOR = 0
BEATS, ACKNOWLEDGED, REAL_TIME, PROCESS = range(4)
SLOTS, LATE, LONGEST, OVERRUNS, LOST = range(5)
_PER_CORE, _PER_SERVER = 4, 5


class CounterPage:
    """The numbers as one sequence, and where in it those of a core or a server begin."""

    def __init__(self, words: memoryview, table: ServerTable) -> None:
        self.words = words
        cores = sorted({server.core for server in table.servers})
        self._cores = {core: 1 + place * _PER_CORE for place, core in enumerate(cores)}
        first = 1 + len(cores) * _PER_CORE
        self._servers = {
            server.name: first + place * _PER_SERVER for place, server in enumerate(table.servers)
        }

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return 8 * (1 + len(self._cores) * _PER_CORE + len(self._servers) * _PER_SERVER)

    def core(self, core: int) -> int:
        """Where the numbers of a core's dispatcher begin."""
        return self._cores[core]

    def server(self, name: str) -> int:
        """Where the numbers of a server begin."""
        return self._servers[name]


def create_page(path: Path, table: ServerTable) -> tuple[CounterPage, int]:
    """Make the memory, all numbers 0, and the link to it.

    Returns the file descriptor as well: closing it makes the link lead nowhere.
    """
    memory = os.memfd_create(path.name)
    os.truncate(memory, CounterPage(memoryview(b""), table).size)
    path.unlink(missing_ok=True)
    path.symlink_to(f"/proc/{os.getpid()}/fd/{memory}")
    return open_page(path, table), memory


def open_page(path: Path, table: ServerTable) -> CounterPage:
    """Map the numbers of a run for reading and writing.

    Raises:
        OSError: its owner has ended, or belongs to another user.
    """
    with path.open("r+b") as file:
        return CounterPage(memoryview(mmap.mmap(file.fileno(), 0)).cast("q"), table)


def read_counters(page: CounterPage, table: ServerTable) -> dict[str, ServerCounters]:
    """The counters of every server, as :meth:`BackEnd.counters` gives them."""
    found = {}
    for server in table.servers:
        place = page.server(server.name)
        slots, late, longest, overruns, _ = page.words[place : place + _PER_SERVER].tolist()
        found[server.name] = ServerCounters(
            slots, late, longest, overruns if overruns >= 0 else None
        )
    return found
