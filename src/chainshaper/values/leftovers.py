"""What a killed run has left beside its output: ``.NAME.partial-…``, ``.NAME.tracing-…``,
``.NAME.older-…``, each a folder or a file.

Who fills one holds a lock of it, which the kernel takes back with the process: whatever is locked
belongs to a run that goes on, whoever started it and under whatever number.
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

_HIDDEN = re.compile(r"\.(?P<name>.+)\.(?P<kind>partial|tracing|older)-\w+", re.DOTALL)
_FILE = re.compile(r".+-[0-9a-f]{8}", re.DOTALL)
"""How names of such files end; a name that is less like ours may be of a file that is not."""
_YOUNG_S = 10
"""Younger than this, it may be without its lock since it has just been made."""
_ENTRY = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
_FOLDER = _ENTRY | os.O_DIRECTORY


def claim(descriptor: int) -> None:
    """Lock an open file or folder of ours until it is closed, where its file system has locks."""
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """A folder that is ours inside. Where the file system has no locks, it counts as live for ever.

    Raises OSError: it is no folder any more.
    """
    descriptor = os.open(folder, _FOLDER)
    try:
        claim(descriptor)
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
        descriptor = os.open(path, _ENTRY)
    except OSError:
        return False
    try:
        state = os.fstat(descriptor)
        plain = stat.S_ISREG(state.st_mode) and _FILE.fullmatch(path.name) is not None
        ours = state.st_uid == os.geteuid() and (plain or stat.S_ISDIR(state.st_mode))
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


def clear_leftovers(folder: Path, output: str | None = None) -> tuple[list[str], list[str]]:
    """Remove what killed runs have left in a folder, of one ``output`` or of all, but for traces:
    what was removed, what stays.

    Each is a line for people.
    """
    removed, stays = list[str](), list[str]()
    for path in leftovers(folder, output):
        if is_trace(path):
            stays.append(leftover_text(path))
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
        if path.exists():
            stays.append(f"{path} was left by a run that was killed, and cannot be removed whole")
        else:
            removed.append(f"{path}, left by a run that was killed, is removed")
    return removed, stays
