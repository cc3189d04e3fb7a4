"""What the freezer has changed on this machine, on disk, and putting it back.

Whoever of the freezer's processes survives must be able to put everything back, and so must a
stranger after all of them have been killed at once. So the file is written *before* each change.
It holds the groups: a group is made directly beneath the one from which its threads came, so their
way back is its parent, for them and for the children that they have had since. And it holds how the
hierarchy was mounted.

The run's log stands beside it. It is at the same time the lock of the run directory: the owner
opens it and all its processes inherit it, so it stays locked until the last of them is gone.
"""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from chainshaper.enforcement.freezer.cgroups import (
    QUICK_MOVES,
    dissolve,
    mount_point,
    moves_are_quick,
    remount,
)
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.errors import OperationError

__all__ = [
    "COUNTERS",
    "FreezerState",
    "Group",
    "clean_up",
    "load_state",
    "lock_run_directory",
    "log_text",
    "remove_state",
    "restore",
    "save_state",
    "start_log",
    "thaw",
]

STATE, COUNTERS, LOG = "freezer.json", "freezer.counters", "freezer.log"


@dataclass(frozen=True)
class Group:
    """A cgroup of ours: the threads of one server that came from the folder's parent."""

    folder: Path
    server: str


@dataclass(frozen=True)
class FreezerState:
    """A run: the process it belongs to, the table it enforces, the groups it has made.

    ``mount_options`` are those that the hierarchy had, where we have it mounted differently.
    """

    owner: int
    table: ServerTable
    mount_options: str | None = None
    groups: tuple[Group, ...] = ()


def save_state(run_directory: Path, state: FreezerState) -> None:
    """Write the file beside and rename it: it is whole at every instant."""
    partial = run_directory / f"{STATE}.partial"
    partial.write_text(json.dumps(asdict(state), indent=1, default=str))
    partial.replace(run_directory / STATE)


def load_state(run_directory: Path) -> FreezerState | None:
    """The state of the run, None when there is none.

    Raises:
        OperationError: the file is not one of ours.
    """
    path = run_directory / STATE
    try:
        content = json.loads(path.read_text())
        servers = tuple(
            ReservationServer(**{**one, "slots": tuple(map(tuple, one["slots"]))})
            for one in content["table"]["servers"]
        )
        groups = tuple(Group(Path(g["folder"]), g["server"]) for g in content["groups"])
        table = ServerTable(content["table"]["cycle_ns"], servers)
        return FreezerState(content["owner"], table, content.get("mount_options"), groups)
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise OperationError(
            f"{path} does not say which cgroups to restore ({error!r}): thaw and remove those "
            "named chainshaper-* under /sys/fs/cgroup, then delete the file"
        ) from error


def thaw(groups: Iterable[Group]) -> None:
    """Let the threads of these groups run; one that is gone holds nobody."""
    for group in groups:
        with contextlib.suppress(OSError):
            (group.folder / "cgroup.freeze").write_text("0")


def restore(state: FreezerState | None) -> tuple[str, ...]:
    """Put every thread back, remove the groups, mount as before; what could not be, in sentences.

    Of several runs at a time, the one that has it mounted differently changes that back.
    """
    if state is None:
        return ()
    left = tuple(told for group in state.groups if (told := dissolve(group.folder)) is not None)
    before = state.mount_options
    if before is not None and moves_are_quick():
        remount(before)
        if moves_are_quick():
            left += (f"{mount_point()} is still mounted with {QUICK_MOVES}, and was with {before}",)
    return left


def remove_state(run_directory: Path) -> None:
    """Remove the files of a run, the log excepted."""
    for name in (STATE, f"{STATE}.partial", COUNTERS):
        with contextlib.suppress(FileNotFoundError):
            (run_directory / name).unlink()


def lock_run_directory(run_directory: Path) -> IO[str]:
    """The run's log, open and locked.

    Raises:
        OperationError: another run holds it.
    """
    log = (run_directory / LOG).open("a+")
    try:
        fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.close()
        state = load_state(run_directory)
        whose = "another process" if state is None else f"process {state.owner}"
        raise OperationError(
            f"{whose} enforces servers already, from {run_directory}: end it first "
            "(`chainshaper release`)"
        ) from None
    return log


def clean_up(run_directory: Path) -> tuple[Path, ...]:
    """Restore what a run left behind whose processes were all killed; harmless when repeated.

    Returns the groups that were dissolved.

    Raises:
        OperationError: the run is alive, or something cannot be restored.
    """
    if not (run_directory / STATE).exists():
        return ()
    with lock_run_directory(run_directory):
        state = load_state(run_directory)
        if state is None:
            return ()
        dissolved = tuple(g.folder for g in state.groups if g.folder.is_dir())
        left = restore(state)
        if left:
            raise OperationError("; ".join(left))
        remove_state(run_directory)
        return dissolved


def log_text(run_directory: Path) -> str:
    """What the processes of the run had to say about its end."""
    try:
        return (run_directory / LOG).read_text().strip()
    except OSError:
        return ""


def start_log(log: IO[str]) -> None:
    """A new run begins with an empty log."""
    os.ftruncate(log.fileno(), 0)
