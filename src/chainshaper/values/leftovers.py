"""Find and remove what killed runs have left beside their output.

That is folders and files called ``.NAME.partial-…``, ``.NAME.tracing-…`` or ``.NAME.older-…``. The
process that fills one has it locked, and the kernel takes the lock back when the process ends. So
whatever is locked belongs to a run that goes on, and all else is left over.
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
"""Names of files that chainshaper makes end like this; other files may be somebody else's."""
_YOUNG_S = 10
"""What is younger may have just been made, and not be locked yet."""
_ENTRY = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
_FOLDER = _ENTRY | os.O_DIRECTORY


def claim(descriptor: int) -> None:
    """Lock an open file or folder until it is closed, if its file system has locks."""
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """Lock a folder for the context.

    Where the file system has no locks, nothing ever counts as left over. Raises OSError: it is no
    folder any more.
    """
    descriptor = os.open(folder, _FOLDER)
    try:
        claim(descriptor)
        yield folder
    finally:
        os.close(descriptor)


def leftovers(folder: Path, output: str | None = None) -> list[Path]:
    """Return what killed runs of our user have left in a folder, of an ``output`` or of all."""
    left: list[Path] = []
    with suppress(OSError):
        for path in sorted(folder.iterdir()):
            match = _HIDDEN.fullmatch(path.name)
            if match is not None and output in (None, match["name"]) and _abandoned(path):
                left.append(path)
    return left


def _abandoned(path: Path) -> bool:
    """Whether a file or folder is our user's, not young, and locked by no process."""
    try:
        descriptor = os.open(path, _ENTRY)
    except OSError:
        return False
    try:
        state = os.fstat(descriptor)
        is_file = stat.S_ISREG(state.st_mode) and _FILE.fullmatch(path.name) is not None
        if state.st_uid != os.geteuid() or not (is_file or stat.S_ISDIR(state.st_mode)):
            return False
        if time.time() - state.st_mtime < _YOUNG_S:
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # a process has it locked, or its file system has no locks
        return False
    else:
        return True
    finally:
        os.close(descriptor)


def is_trace(path: Path) -> bool:
    """Whether a leftover was written by a tracer: it can often be read, and is the only copy."""
    match = _HIDDEN.fullmatch(path.name)
    return match is not None and match["kind"] == "tracing"


def leftover_text(path: Path) -> str:
    """Say what is left over, and what to do about it."""
    said = f"{path} was left by a run that was killed: "
    if is_trace(path):
        return f"{said}see whether `chainshaper info` reads it, or remove it"
    return f"{said}`chainshaper release` removes it, in that folder"


def clear_leftovers(folder: Path, output: str | None = None) -> tuple[list[str], list[str]]:
    """Remove what killed runs have left in a folder, of an ``output`` or of all; traces stay.

    Returns what was removed and what stays, each as lines for people.
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
