"""What we changed on this machine, on disk before it is changed.

Whatever ends us, SIGKILL included, somebody must be able to put things back. So each change is
first written down: one line of JSON in a file, which is on the disk (`fsync`) before the change is
made. A later process reads it and undoes what is still there. Each kind of change is undone by
the module that made it (thread classes by :mod:`.scheduling_memory`); this one keeps the lines.

The file lies in a folder of its own per run, where a back end may keep more:
`/run/chainshaper/RUN/journal.jsonl` for root, below `$XDG_RUNTIME_DIR` for others. Both are gone
when the machine boots again, as is all that was changed; a journal elsewhere says by its boot id
that it is from before.
"""

import errno
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.threads.listing import start_of
from chainshaper.errors import OperationError, PlatformError

__all__ = [
    "Journal",
    "boot_id",
    "discard_journal",
    "find_journals",
    "journals_folder",
    "open_journal",
]

FILE = "journal.jsonl"
FORMAT = 1


@dataclass(frozen=True)
class Journal:
    """A journal on disk; what it says is read anew each time, since others may write to it too."""

    path: Path

    def note(self, kind: str, **fields: Any) -> None:
        """Write down a change that is about to be made: plain data that says how to undo it.

        Raises:
            OperationError: it cannot be written; then the change must not be made.
        """
        line = json.dumps({"kind": kind, **fields}).encode() + b"\n"
        try:
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CLOEXEC)
            try:
                _remove_cut_off_line(descriptor)
                if os.write(descriptor, line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise OperationError(
                f"{self.path}: what was there before cannot be written down ({error.strerror}), so "
                "nothing is changed; make room there, or name another folder"
            ) from error

    def entries(self, kind: str | None = None) -> tuple[dict[str, Any], ...]:
        """All that was noted, oldest first; a ``kind`` alone if one is given.

        A last line that a crash cut off is left out: what it speaks of was never done. A journal
        that has been discarded says nothing.

        Raises:
            OperationError: the file cannot be read, or is no journal.
        """
        try:
            lines = self.path.read_text().split("\n")
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise OperationError(
                f"{self.path}: the journal cannot be read: {error.strerror}"
            ) from error
        entries = []
        for number, line in enumerate(lines[:-1], start=1):
            try:
                entry = json.loads(line)
                found = entry["kind"]
            except (ValueError, TypeError, KeyError):
                raise OperationError(
                    f"{self.path}, line {number}: not a line of a journal; somebody else has "
                    "written here. Remove the line to have the others undone"
                ) from None
            if kind is None or found == kind:
                entries.append(entry)
        return tuple(entries)

    @property
    def outdated(self) -> bool:
        """Whether the machine has booted since: then nothing of it is left to undo."""
        opened = self.entries("opened")
        return bool(opened) and opened[0]["boot_id"] != boot_id()

    @property
    def owner(self) -> int | None:
        """The process that opened it and still lives; None when it is gone."""
        opened = self.entries("opened")
        if not opened or self.outdated:
            return None
        pid, started = opened[0]["pid"], opened[0]["started"]
        return pid if start_of(pid, pid) == started else None


def open_journal(folder: str | Path | None = None, run: str | None = None) -> Journal:
    """Begin a journal in ``folder``/``run``; both have defaults.

    Raises:
        OperationError: there is one already, or it cannot be written.
        PlatformError: the system has no folder for it.
    """
    base = journals_folder() if folder is None else Path(folder)
    place = base / (run or f"{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}")
    journal = Journal(place / FILE)
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.close(os.open(journal.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        for directory in (place, base):  # the names themselves must survive as well
            descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            os.fsync(descriptor)
            os.close(descriptor)
    except FileExistsError:
        raise OperationError(
            f"{journal.path} exists: that run is going on, or has crashed; undo it first "
            "(`chainshaper release`)"
        ) from None
    except OSError as error:
        raise OperationError(
            f"{place}: a journal of changes cannot be written there ({error.strerror}): name "
            "another folder"
        ) from error
    pid = os.getpid()
    journal.note("opened", format=FORMAT, boot_id=boot_id(), pid=pid, started=start_of(pid, pid))
    return journal


def journals_folder() -> Path:
    """Where journals are kept unless somebody names another place.

    Raises:
        PlatformError: not root, and no session of a user either.
    """
    if os.geteuid() == 0:
        return Path("/run/chainshaper")
    if unit := os.environ.get("RUNTIME_DIRECTORY"):  # RuntimeDirectory= of a systemd unit
        return Path(unit.split(":")[0])
    session = os.environ.get("XDG_RUNTIME_DIR")
    if not session:
        raise PlatformError(
            "$XDG_RUNTIME_DIR is not set, so there is no place for the journal of changes: name "
            "a folder for it, or run in a login session"
        )
    return Path(session) / "chainshaper"


def find_journals(folder: str | Path | None = None) -> tuple[Journal, ...]:
    """All journals that have not been discarded, oldest name first."""
    base = journals_folder() if folder is None else Path(folder)
    return tuple(Journal(path) for path in sorted(base.glob(f"*/{FILE}")))


def discard_journal(journal: Journal) -> None:
    """Remove a journal when all is undone; harmless when it is gone. What else is there stays."""
    journal.path.unlink(missing_ok=True)
    folder = journal.path.parent
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _remove_cut_off_line(descriptor: int) -> None:
    """Cut off what a crash, or a full disk, has left of a line: it speaks of no change."""
    size = os.fstat(descriptor).st_size
    content = os.pread(descriptor, size, 0)
    whole = content.rfind(b"\n") + 1
    if whole != size:
        os.ftruncate(descriptor, whole)


def boot_id() -> str:
    """What the kernel calls this boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
