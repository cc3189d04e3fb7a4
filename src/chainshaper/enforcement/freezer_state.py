"""What the freezer's processes share: what it has changed on this machine, and its counters.

The journal says, *before* anything is changed, which servers there will be and how the hierarchy
was mounted. Cgroups of ours need no line each: their names say which process made them and for
which server, so a stranger finds them even where the journal is gone. A group is made directly
beneath the one from which its threads came: their way back is its parent, for them and for the
children that they have had since.

A dispatcher must not wait, so it writes its numbers to memory that others read. Not to a file on a
disk: a store to a mapped page that is being written back waits for the disk, for 0.1 s and more.
The memory belongs to the owner, and is reached through its descriptors. All numbers are 64-bit
integers in the machine's order, each written by one kind of process only:

    the owner    released: servers that need no dispatcher any more
    per core     beats (moves as long as its process does), acknowledged (the last command carried
                 out), real time, and by guardians: let go (when they thawed the threads of one that
                 was still for a moment, ns), silent (it was still for too long)
    per server   slots, late entries, longest lateness (ns), overruns (-1: unknown), groups lost
"""

import contextlib
import ctypes
import mmap
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.servers import ReservationServer, ServerCounters, ServerTable
from chainshaper.linux.cgroups import (
    dissolve,
    has_unseen_threads,
    mount_point,
    moves_are_quick,
    options_before_ours,
    restore_mount,
)
from chainshaper.linux.runs import Journal
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import PlatformError

FREEZER = "freezer"
GROUP_PREFIX = "chainshaper-"
_NAME = re.compile(rf"{GROUP_PREFIX}(\d+)(?:\.(\d+)\.(\d+))?-(\d+)-")
"""The owner's id; its start and which of its runs (older ones: without); the server's place."""


@dataclass(frozen=True)
class FreezerRun:
    """The servers that are enforced, and by whom: id and start of the owner.

    ``page`` is where the counters are for as long as the owner lives. ``mount_options`` are those
    that the hierarchy had, where we have it mounted differently.
    """

    owner: tuple[int, int]
    table: ServerTable
    page: Path
    mount_options: str | None = None


def note_freezer(journal: Journal, run: FreezerRun) -> None:
    """Write down that servers are about to be made. Raises OperationError: it cannot be written."""
    journal.note(FREEZER, **{**asdict(run), "page": str(run.page)})


def read_run(entry: Mapping[str, Any]) -> FreezerRun:
    table, (pid, started) = entry["table"], entry["owner"]
    servers = tuple(
        ReservationServer(**{**one, "slots": tuple((start, end) for start, end in one["slots"])})
        for one in table["servers"]
    )
    return FreezerRun(
        (int(pid), int(started)),
        ServerTable(int(table["cycle_ns"]), servers),
        Path(entry["page"]),
        entry["mount_options"],
    )


def run_of(journal: Journal) -> FreezerRun | None:
    return next(iter(journal.read(FREEZER, read_run)), None)


def group_name(run: FreezerRun, server: str) -> str:
    """The name of a server's group: whose it is, the server's place, and what a person reads."""
    pid, started, page = *run.owner, run.page.name
    number = [one.name for one in run.table.servers].index(server)
    readable = re.sub(r"[^A-Za-z0-9_.-]+", "_", server)[:64]
    return f"{GROUP_PREFIX}{pid}.{started}.{page}-{number}-{readable}"


def groups_of(run: FreezerRun | None, core: int | None = None) -> tuple[Path, ...]:
    """The groups of a run that there are; of the servers of one core, if one is given."""
    if run is None:
        return ()

    def belongs(name: "re.Match[str]") -> bool:
        if name.group(1, 2, 3) != (*map(str, run.owner), run.page.name):
            return False
        return core is None or run.table.servers[int(name[4])].core == core

    return _groups(belongs)


def stray_groups(journals: Iterable[Journal]) -> tuple[Path, ...]:
    """Groups of ours of none of these journals, and whose owner has ended.

    Not those with threads that cannot be seen from here: their owner is outside of this container.
    """
    known = {run.owner for journal in journals if (run := run_of(journal)) is not None}

    def is_stray(name: "re.Match[str]") -> bool:
        pid = int(name[1])
        started = start_of(pid, pid) if name[2] is None else int(name[2])
        return (pid, started) not in known and (started is None or has_ended(pid, started))

    return tuple(folder for folder in _groups(is_stray) if not has_unseen_threads(folder))


def thaw(groups: Iterable[Path]) -> None:
    """Let the threads of these groups run; one that is gone has no thread."""
    for folder in groups:
        with contextlib.suppress(OSError):
            (folder / "cgroup.freeze").write_text("0")


def restore(run: FreezerRun | None) -> tuple[str, ...]:
    """Put every thread back, remove the groups, mount as before; what could not be, in sentences.

    Of several runs at a time, the one that has it mounted differently changes that back; that
    another has it so again at once is no failure.
    """
    groups = groups_of(run)
    thaw(groups)
    left = tuple(why for folder in groups if (why := dissolve(folder)) is not None)
    before = None if run is None else run.mount_options
    if before is not None:
        restore_mount(before)
    return left


def restore_stray_mount() -> None:
    """Mount the hierarchy as it was before a run whose journal is gone, if no group is in use."""
    with contextlib.suppress(PlatformError):
        in_use = not moves_are_quick() or _groups(lambda _: True)
        before = None if in_use else options_before_ours()
        if before is not None:
            restore_mount(before)


def _groups(wanted: Callable[["re.Match[str]"], bool]) -> tuple[Path, ...]:
    while True:
        try:
            found = sorted(mount_point().rglob(f"{GROUP_PREFIX}*"))
        except PlatformError:
            return ()
        except FileNotFoundError:  # one was removed while we looked: once more
            continue
        names = ((folder, _NAME.match(folder.name)) for folder in found)
        return tuple(folder for folder, name in names if name is not None and wanted(name))


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
    """Make the memory, all numbers 0; also where others find it, and the descriptor to close."""
    memory = os.memfd_create("counters")
    each = ctypes.sizeof(_Core) + ctypes.sizeof(_Server)  # there are not more cores than servers
    os.truncate(memory, ctypes.sizeof(ctypes.c_int64) + each * len(table.servers))
    path = Path(f"/proc/{os.getpid()}/fd/{memory}")
    return open_page(path, table), path, memory


def open_page(path: Path, table: ServerTable) -> CounterPage:
    """Map the numbers of a run. Raises OSError: its owner has ended, or is another user's."""
    with path.open("r+b") as file:
        return CounterPage(mmap.mmap(file.fileno(), 0), table)


def read_counters(page: CounterPage) -> dict[str, ServerCounters]:
    return {
        name: ServerCounters(
            its.slots, its.late, its.longest, its.overruns if its.overruns >= 0 else None
        )
        for name, its in page.servers.items()
    }
