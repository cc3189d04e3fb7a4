"""Folders that a killed run has left beside its output: ``.NAME.partial-…``, ``.NAME.tracing-…``.

Who fills such a folder holds a lock of it, which the kernel takes back with the process: whatever
is locked belongs to a run that goes on, whoever started it and under whatever number.
"""

import fcntl
import os
import re
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_HIDDEN = re.compile(r"\.(?P<name>.+)\.(?P<kind>partial|tracing)-\w+")
_YOUNG_S = 10
"""Younger than this, a folder may be without its lock since it has just been made."""
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


@contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """A folder that is ours inside. Where the file system has no locks, it counts as live for ever.

    Raises OSError: it is no folder any more.
    """
    descriptor = os.open(folder, _FOLDER)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield folder
    finally:
        os.close(descriptor)


def leftovers(folder: Path, output: str | None = None) -> list[Path]:
    """What our user's killed runs have left in a folder, of one ``output`` or of all."""
    left: list[Path] = []
    with suppress(OSError):
        for path in sorted(folder.iterdir()):
            found = _HIDDEN.fullmatch(path.name)
            if found is not None and output in (None, found["name"]) and _abandoned(path):
                left.append(path)
    return left


def _abandoned(path: Path) -> bool:
    try:
        descriptor = os.open(path, _FOLDER)
    except OSError:
        return False
    try:
        state = os.fstat(descriptor)
        ours = state.st_uid == os.geteuid() and stat.S_ISDIR(state.st_mode)
        if not ours or time.time() - state.st_mtime < _YOUNG_S:
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # somebody has the lock, or there are none
        return False
    else:
        return True
    finally:
        os.close(descriptor)


def is_trace(path: Path) -> bool:
    """Whether a leftover is what a tracer wrote, which can often be read, and not a copy of it."""
    found = _HIDDEN.fullmatch(path.name)
    return found is not None and found["kind"] == "tracing"


def leftover_text(path: Path) -> str:
    """What is left where, and what to do about it."""
    said = f"{path} was left by a run that was killed: "
    if is_trace(path):
        return f"{said}see whether `chainshaper info` reads it, or remove it"
    return f"{said}`chainshaper release` removes it, in that folder"


def clear_leftovers(folder: Path) -> tuple[list[str], list[str]]:
    """Remove what killed runs have left in a folder, but for traces: what was removed, what stays.

    Each is a line for people.
    """
    removed, stays = list[str](), list[str]()
    for path in leftovers(folder):
        if is_trace(path):
            stays.append(leftover_text(path))
            continue
        shutil.rmtree(path, ignore_errors=True)
        if path.exists():
            stays.append(f"{path} was left by a run that was killed, and cannot be removed whole")
        else:
            removed.append(f"{path}, left by a run that was killed, is removed")
    return removed, stays
