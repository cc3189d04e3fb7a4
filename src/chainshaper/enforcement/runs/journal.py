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

import contextlib
import errno
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, TypeVar

from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import OperationError, PlatformError

__all__ = [
    "CLAIMS",
    "OPENED",
    "Journal",
    "boot_id",
    "discard_journal",
    "find_journals",
    "journals_folder",
    "open_journal",
    "process_of",
    "read_claim",
    "remembered_journal",
]

_T = TypeVar("_T")

FILE = "journal.jsonl"
FORMAT = 1
OPENED, CLAIMS = "opened", "claims"


@dataclass(frozen=True)
class Journal:
    """A journal on disk; what it says is read anew each time, since others may write to it too.

    ``memory`` is the open file, for those who must be able to undo what it says even where its
    folder is removed (:meth:`keep`).
    """

    path: Path
    memory: FileIO | None = None

    def note(self, kind: str, **fields: Any) -> None:
        """:meth:`note_all` for one change."""
        self.note_all(kind, (fields,))

    def note_all(self, kind: str, changes: Iterable[Mapping[str, Any]]) -> None:
        """Write down changes that are about to be made: plain data that says how to undo each.

        They are on the disk together (one `fsync`), so that many threads take no longer than one.

        Raises:
            OperationError: they cannot be written; then no change must be made.
        """
        lines = b"".join(json.dumps({"kind": kind, **one}).encode() + b"\n" for one in changes)
        try:
            self.keep()
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CLOEXEC)
            try:
                size = _remove_cut_off_line(descriptor)
                if os.write(descriptor, lines) != len(lines):
                    os.ftruncate(descriptor, size)
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

        A last line that a crash cut off is left out: what it speaks of was never done. So are lines
        that are not a journal's (:meth:`strange_lines`). A journal that has been discarded says
        nothing.

        Raises:
            OperationError: the file cannot be read.
        """
        entries = (_entry(line) for line in self._lines())
        return tuple(one for one in entries if one and kind in (None, one["kind"]))

    def read(self, kind: str, reader: Callable[[dict[str, Any]], _T]) -> tuple[_T, ...]:
        """The entries of a kind as values; one that ``reader`` cannot make sense of is left out."""
        found = (_value(entry, reader) for entry in self.entries(kind))
        return tuple(value for value in found if value is not None)

    def strange_lines(
        self, readers: Mapping[str, Callable[[dict[str, Any]], object]]
    ) -> tuple[tuple[int, str], ...]:
        """Lines, with their numbers, that are no entries, or that none of these could read."""
        strange = []
        for number, line in enumerate(self._lines(), start=1):
            entry = _entry(line)
            reader = readers.get(entry["kind"]) if entry else None
            if entry is None or reader is None or _value(entry, reader) is None:
                strange.append((number, line))
        return tuple(strange)

    def keep(self) -> bool:
        """See that the file is there; whether it still is to be, and was not discarded.

        Where its folder has been removed, it is written again from ``memory``.

        Raises:
            OSError: it cannot be.
        """
        if self.memory is None or self.memory.closed:
            return self.path.exists()
        if not self.path.exists():
            content = self._remembered()
            if not content:
                return False
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            written = self.path.with_name(f"{FILE}.{os.getpid()}")
            try:
                written.touch(mode=0o600)
                written.write_bytes(content)
                with contextlib.suppress(FileExistsError):  # another process of the run was first
                    os.link(written, self.path)
            finally:
                written.unlink(missing_ok=True)
        with self.path.open("rb") as file:
            os.dup2(file.fileno(), self.memory.fileno(), inheritable=False)
        return True

    def size(self) -> int:
        """How long it is: it only grows."""
        with contextlib.suppress(OSError):
            return self.path.stat().st_size
        return len(self._remembered())

    @property
    def outdated(self) -> bool:
        """Whether the machine has booted since: then nothing of it is left to undo."""
        opened = self.entries(OPENED)
        return bool(opened) and opened[0].get("boot_id") != boot_id()

    @property
    def owner(self) -> int | None:
        """The process that opened it and still lives; None when it is gone."""
        opened = self.read(OPENED, process_of)
        if not opened or self.outdated:
            return None
        pid, started = opened[0]
        return None if has_ended(pid, started) else pid

    def _lines(self) -> list[str]:
        """Whole lines."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            content = self._remembered()
        except OSError as error:
            raise OperationError(
                f"{self.path}: the journal cannot be read: {error.strerror}"
            ) from error
        return content.decode(errors="replace").split("\n")[:-1]

    def _remembered(self) -> bytes:
        """The file as it is in ``memory``."""
        if self.memory is None or self.memory.closed:
            return b""
        return os.pread(self.memory.fileno(), os.fstat(self.memory.fileno()).st_size, 0)


def process_of(entry: Mapping[str, Any]) -> tuple[int, int]:
    """The process that an entry names: its id, and when it started."""
    return int(entry["pid"]), int(entry["started"])


def read_claim(entry: Mapping[str, Any]) -> tuple[set[int], set[str]]:
    """The cores and nodes that a run governs, of an entry :data:`CLAIMS`."""
    return set(map(int, entry["cores"])), set(map(str, entry["nodes"]))


def _entry(line: str) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
        return entry if isinstance(entry["kind"], str) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _value(entry: dict[str, Any], reader: Callable[[dict[str, Any]], _T]) -> _T | None:
    try:
        return reader(entry)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return None


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
    journal, pid = remembered_journal(journal.path), os.getpid()
    journal.note(OPENED, format=FORMAT, boot_id=boot_id(), pid=pid, started=start_of(pid, pid))
    return journal


def remembered_journal(path: Path) -> Journal:
    """The journal at a path, for a process that must be able to undo what it says.

    Raises:
        OSError: there is none.
    """
    return Journal(path, FileIO(path, "r"))


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
    """Remove a journal when all is undone; harmless when it is gone. What else is there stays.

    It is emptied first: who has it open knows then that nothing is left to undo.
    """
    with contextlib.suppress(FileNotFoundError):
        os.truncate(journal.path, 0)
        journal.path.unlink()
    if journal.memory is not None:
        journal.memory.close()
    with contextlib.suppress(OSError):  # there is more in it, or it is gone
        journal.path.parent.rmdir()


def _remove_cut_off_line(descriptor: int) -> int:
    """Cut off what a crash, or a full disk, has left of a line: it speaks of no change.

    Returns the length of what is left.
    """
    size = os.fstat(descriptor).st_size
    if size and os.pread(descriptor, 1, size - 1) != b"\n":
        size = os.pread(descriptor, size, 0).rfind(b"\n") + 1
        os.ftruncate(descriptor, size)
    return size


def boot_id() -> str:
    """What the kernel calls this boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
