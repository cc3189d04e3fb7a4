"""What the freezer has changed on this machine, as others find it, and putting it back.

Whoever survives must be able to put everything back, and so must a stranger after all of a run's
processes have been killed at once. So the journal says, *before* anything is changed, which servers
there will be and how the hierarchy was mounted. Cgroups of ours need no line each: their names say
which process made them and for which server, so they are found even where the journal is gone. A
group is made directly beneath the one from which its threads came: their way back is its parent,
for them and for the children that they have had since.
"""

import contextlib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.runs.journal import Journal
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.linux.cgroups import (
    dissolve,
    has_unseen_threads,
    mount_point,
    moves_are_quick,
    options_before_ours,
    restore_mount,
)
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import PlatformError

__all__ = [
    "FREEZER",
    "GROUP_PREFIX",
    "FreezerRun",
    "group_name",
    "groups_of",
    "note_freezer",
    "read_run",
    "restore",
    "restore_stray_mount",
    "run_of",
    "stray_groups",
    "thaw",
]

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
    """Write down that servers are about to be made.

    Raises:
        OperationError: it cannot be written.
    """
    journal.note(FREEZER, **{**asdict(run), "page": str(run.page)})


def read_run(entry: Mapping[str, Any]) -> FreezerRun:
    """What :func:`note_freezer` wrote."""
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
    """The freezer's run, None where there is none."""
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

    Those with threads that cannot be seen from here are not ours to judge: their owner is where
    they are, outside of this container.
    """
    known = {run.owner for journal in journals if (run := run_of(journal)) is not None}

    def is_stray(name: "re.Match[str]") -> bool:
        pid = int(name[1])
        started = start_of(pid, pid) if name[2] is None else int(name[2])
        return (pid, started) not in known and (started is None or has_ended(pid, started))

    return tuple(folder for folder in _groups(is_stray) if not has_unseen_threads(folder))


def thaw(groups: Iterable[Path]) -> None:
    """Let the threads of these groups run; one that is gone holds no thread."""
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
