"""The journal of each run: what it has changed on this machine, and which processes it governs.

A run has a folder (:func:`journals_folder`) with three files:

* `journal.jsonl`: the journal;
* `run.json`: the run's state, which it writes anew every second;
* `plan.json`: the plan that it puts in force.

Whatever ends the run, SIGKILL included, another process must be able to undo its changes. So each
change is a line of JSON in the journal, and that line is on the disk (`fsync`) before the change is
made. The folder is gone after the next boot, as are all changes.
"""

import contextlib
import errno
import fcntl
import functools
import json
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

from chainshaper.linux.processes import boot_id, user_name, user_of
from chainshaper.linux.threads import (
    find_thread,
    has_ended,
    lines_of,
    open_process,
    read_proc,
    start_of,
)
from chainshaper.values.errors import OperationError, PlatformError, text_of
from chainshaper.values.files import open_output, read_regular

_T = TypeVar("_T")

JOURNAL_FILE, STATE_FILE, PLAN_FILE = "journal.jsonl", "run.json", "plan.json"
FORMAT = 1
OPENED, PROCESS = "opened", "process"  # kinds of entries
GUARDIAN, DISPATCHER = "guardian", "dispatcher"  # roles of a run's processes
_LOOK_S = 0.02  # between two attempts to lock a folder
_LOCK = ".lock"
_NO_LINK = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@dataclass(frozen=True)
class Journal:
    """A journal on disk. It is read anew each time, since other processes write to it too."""

    path: Path
    memory: FileIO | None = None  # the open file; the journal is restored from it if it is removed

    def note(self, kind: str, *changes: Mapping[str, Any], **fields: Any) -> None:
        """Write down, with one `fsync`, how to undo changes that are about to be made.

        Each of the ``changes`` is an entry of this kind; without them, the ``fields`` are one
        entry. Raises OperationError: they cannot be written; make no change then.
        """
        entries = [{"kind": kind, **change} for change in changes or (fields,)]
        lines = b"".join(json.dumps(entry).encode() + b"\n" for entry in entries)
        try:
            self.keep()
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | _NO_LINK)
            with os.fdopen(descriptor, "r+b", buffering=0) as file:
                size = os.fstat(descriptor).st_size
                if size and os.pread(descriptor, 1, size - 1) != b"\n":  # a crash cut a line off
                    size = os.pread(descriptor, size, 0).rfind(b"\n") + 1
                    file.truncate(size)
                if file.write(lines) != len(lines):
                    file.truncate(size)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file)
        except OSError as error:
            raise OperationError(
                f"{self.path}: what was there before cannot be written down ({error.strerror}), so "
                "nothing is changed; make room there, or name another folder"
            ) from error

    def entries(self, kind: str | None = None) -> tuple[Mapping[str, Any], ...]:
        """Return the entries (of a ``kind``), oldest first.

        A line that a crash cut off is left out: its change was not made. Raises OperationError: the
        journal cannot be read.
        """
        entries = (_entry(line) for line in self._lines())
        return tuple(entry for entry in entries if entry and kind in (None, entry["kind"]))

    def read(self, kind: str, reader: Callable[[Mapping[str, Any]], _T]) -> tuple[_T, ...]:
        """Return the entries of a kind, as values that ``reader`` makes of them.

        An entry is left out if ``reader`` raises an error that bad data cause.
        """
        values = (_value(entry, reader) for entry in self.entries(kind))
        return tuple(value for value in values if value is not None)

    def strange_lines(
        self, readers: Mapping[str, Callable[[Mapping[str, Any]], object]]
    ) -> Iterator[tuple[int, str]]:
        """Yield the lines that cannot be read, with their numbers.

        Such a line is no entry, or of a kind without a reader, or its reader refuses it.
        """
        for number, line in enumerate(self._lines(), start=1):
            entry = _entry(line)
            reader = readers.get(entry["kind"]) if entry else None
            if entry is None or reader is None or _value(entry, reader) is None:
                yield number, line

    def keep(self) -> bool:
        """Write the file again from ``memory`` if it was removed; return whether there is one.

        There is none if the journal was discarded (:func:`discard_journal`).
        """
        if self.memory is None or self.memory.closed:
            return self.path.exists()
        if not self.path.exists():
            content = self._remembered()
            if not content:
                return False
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            written = self.path.with_name(f"{JOURNAL_FILE}.{os.getpid()}")
            try:
                with os.fdopen(open_output(written, mode=0o600), "wb") as file:
                    file.write(content)
                with contextlib.suppress(FileExistsError):  # another process of the run was first
                    os.link(written, self.path)
            finally:
                written.unlink(missing_ok=True)
        descriptor = os.open(self.path, os.O_RDONLY | _NO_LINK)
        try:
            os.dup2(descriptor, self.memory.fileno(), inheritable=False)
        finally:
            os.close(descriptor)
        return True

    def size(self) -> int:
        """Return the size of the journal in bytes: it only grows."""
        with contextlib.suppress(OSError):
            return self.path.stat().st_size
        return len(self._remembered())

    @property
    def name(self) -> str:
        return self.path.parent.name

    @property
    def outdated(self) -> bool:
        """Whether the machine has booted since it was opened: then nothing is left to undo."""
        opened = self.entries(OPENED)
        return bool(opened) and opened[0].get("boot_id") != boot_id()

    @property
    def owner(self) -> int | None:
        """The id of the process that opened the journal; None: that process has ended."""
        opened = self.read(OPENED, process_of)
        gone = not opened or self.outdated or has_ended(*opened[0])
        return None if gone else opened[0][0]

    def open_owner(self) -> int | None:
        """Open a pidfd of the owner; None: it has ended."""
        return None if self.owner is None else open_process(*self.read(OPENED, process_of)[0])

    def _lines(self) -> list[str]:
        try:
            with os.fdopen(os.open(self.path, os.O_RDONLY | _NO_LINK), "rb") as file:
                content = file.read()
        except FileNotFoundError:
            content = self._remembered()
        except OSError as error:
            raise OperationError(f"{self.path} cannot be read: {error.strerror}") from error
        return text_of(content).split("\n")[:-1]

    def _remembered(self) -> bytes:
        if self.memory is None or self.memory.closed:
            return b""
        return os.pread(self.memory.fileno(), os.fstat(self.memory.fileno()).st_size, 0)


def process_of(entry: Mapping[str, Any]) -> tuple[int, int]:
    """Return the process that an entry names: its id, and when it started (ticks after boot)."""
    return int(entry["pid"]), int(entry["started"])


class HelperProcess(NamedTuple):
    """A process that a run has started to keep its plan in force, as its journal names it."""

    role: str  # GUARDIAN or DISPATCHER
    pid: int
    started: int  # ticks after the machine booted
    core: int | None = None  # the core of a dispatcher


def note_process(journal: Journal, role: str, pid: int, core: int | None = None) -> None:
    """Write down a process that helps the run, unless it has ended."""
    if (started := start_of(pid, pid)) is not None:
        journal.note(PROCESS, role=role, pid=pid, started=started, core=core)


def read_process(entry: Mapping[str, Any]) -> HelperProcess:
    """Make a helper process of a journal's entry."""
    pid, started = process_of(entry)
    return HelperProcess(str(entry["role"]), pid, started, entry["core"])


def processes_of_role(journal: Journal, role: str) -> tuple[HelperProcess, ...]:
    """Return all processes of a role that the run has ever had."""
    processes = journal.read(PROCESS, read_process)
    return tuple(process for process in processes if process.role == role)


@functools.lru_cache(maxsize=8192)  # a run reads its journal often, and lines never change
def _entry(line: str) -> Mapping[str, Any] | None:
    """Read a line of a journal; None: it is no entry."""
    try:
        entry = json.loads(line)
        return entry if isinstance(entry["kind"], str) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _value(entry: Mapping[str, Any], reader: Callable[[Mapping[str, Any]], _T]) -> _T | None:
    """Make a value of an entry; None: the entry is not what ``reader`` expects."""
    try:
        return reader(entry)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return None


def open_journal(folder: str | Path | None = None, run: str | None = None) -> Journal:
    """Begin the journal of a run in ``folder``/``run``; both have defaults.

    Raises OperationError: there is a journal already, or it cannot be written. PlatformError: as
    :func:`journals_folder`.
    """
    base = journals_folder(folder)
    place = base / (run or f"{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}")
    path = place / JOURNAL_FILE
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.close(open_output(path, mode=0o600))
        for directory in (place, base):  # the names themselves must survive as well
            descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            os.fsync(descriptor)
            os.close(descriptor)
    except FileExistsError:
        raise OperationError(
            f"{path} exists: that run is going on, or has crashed: `chainshaper release` undoes it"
        ) from None
    except OSError as error:
        raise OperationError(
            f"{place}: no journal of changes can be there ({error.strerror}): name another folder"
        ) from error
    journal, pid = remembered_journal(path), os.getpid()
    journal.note(OPENED, format=FORMAT, boot_id=boot_id(), pid=pid, started=start_of(pid, pid))
    return journal


def remembered_journal(path: Path) -> Journal:
    """Open the journal at a path, so that :meth:`Journal.keep` can write it again.

    Raises OSError: there is none.
    """
    return Journal(path, FileIO(os.open(path, os.O_RDONLY | _NO_LINK), "r"))


def journals_folder(named: str | Path | None = None) -> Path:
    """Return the folder in which runs have theirs: the one that is ``named``, or the default.

    Raises PlatformError: no default, since we are not root and not in a session of a user.
    """
    if named is not None:
        return Path(named)
    if os.geteuid() == 0:
        return Path("/run/chainshaper")
    if unit := os.environ.get("RUNTIME_DIRECTORY"):  # RuntimeDirectory= of a systemd unit
        return Path(unit.split(":")[0])
    if session := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(session) / "chainshaper"
    raise PlatformError("$XDG_RUNTIME_DIR is not set: name a folder for the journal of changes")


def find_journals(folder: str | Path | None = None) -> tuple[Journal, ...]:
    """Return all journals that have not been discarded, in the order of their names."""
    return tuple(
        Journal(path) for path in sorted(journals_folder(folder).glob(f"*/{JOURNAL_FILE}"))
    )


def discard_journal(journal: Journal) -> None:
    """Remove a journal when all is undone.

    It is emptied first, so that processes that have it open know that it was discarded.
    """
    with contextlib.suppress(FileNotFoundError):
        with contextlib.suppress(OSError):  # a link: nobody has what it leads to open as a journal
            descriptor = os.open(journal.path, os.O_WRONLY | _NO_LINK)
            os.ftruncate(descriptor, 0)
            os.close(descriptor)
        journal.path.unlink()
    if journal.memory is not None:
        journal.memory.close()
    with contextlib.suppress(OSError):  # there is more in it, or it is gone
        journal.path.parent.rmdir()


class LockHolder(NamedTuple):
    """A process that has a folder locked."""

    pid: int
    started: int  # ticks after the machine booted
    user: int | None  # None: it is of no single user, or has ended


Waiting: TypeAlias = Callable[[LockHolder | None, float], None]
"""A function that is called again and again while another process has a folder locked.

Its arguments are that process (None: not known), and the seconds for which we have waited for it.
It may raise an exception to end the wait.
"""


@contextlib.contextmanager
def locked(folder: Path, waiting: Waiting) -> Iterator[None]:
    """Lock a folder, which its user alone may open, until the context ends.

    ``waiting`` is called while another process has it locked. Raises OperationError: a process of
    another user has it locked, which is not waited for. OSError: there is no such folder.
    """
    descriptor = _lock(folder, waiting)
    try:
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def all_runs_locked(base: Path, waiting: Waiting) -> Iterator[None]:
    """Lock the folder of all runs until the context ends; see :func:`locked`.

    Other users may read that folder, so they could lock it. Therefore a folder inside it is locked
    instead, whose mode keeps them out. It is removed at the end, unless another process waits.
    """
    lock_folder = base / _LOCK
    with contextlib.ExitStack() as stack:
        while True:
            with contextlib.suppress(FileNotFoundError):  # the last holder has just removed it
                lock_folder.mkdir(mode=0o700, exist_ok=True)
                stack.enter_context(locked(lock_folder, waiting))
                break
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                lock_folder.rmdir()


def _lock(folder: Path, waiting: Waiting) -> int:
    """Lock a folder; return the descriptor that holds the lock until it is closed."""
    while True:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            _wait_for_lock(descriptor, folder, waiting)
            # It may have been removed and made anew while we waited.
            if os.path.samestat(os.fstat(descriptor), folder.lstat()):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _wait_for_lock(descriptor: int, folder: Path, waiting: Waiting) -> None:
    holder, since = None, time.monotonic()
    while True:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        before, holder = holder, _holder_of(descriptor)
        if holder != before:
            since = time.monotonic()
        if holder is not None and holder.user not in (0, os.geteuid()):
            raise OperationError(
                f"{folder} is locked by process {holder.pid} of another user "
                f"({user_name(holder.user)}): end that, or see that only you may open the folder"
            )
        waiting(holder, time.monotonic() - since)
        time.sleep(_LOOK_S)


def _holder_of(descriptor: int) -> LockHolder | None:
    """Return the process that has an open folder locked; None: the kernel does not show it.

    The kernel (proc_locks(5)) names the process that asked for the lock. That process may have
    ended since, and its id may be another's; so it counts only if it has the folder open.
    """
    state = os.fstat(descriptor)
    inode = b"%02x:%02x:%d" % (os.major(state.st_dev), os.minor(state.st_dev), state.st_ino)
    with contextlib.suppress(OSError):
        for line in lines_of(read_proc("/proc/locks")):
            fields = line.split()
            if fields[1:2] != [b"FLOCK"] or fields[5] != inode or int(fields[4]) <= 0:
                continue
            pid = int(fields[4])
            started = start_of(pid, pid)
            if started is not None and _has_open(pid, state) and start_of(pid, pid) == started:
                return LockHolder(pid, started, user_of(pid))
    return None


def _has_open(pid: int, state: os.stat_result) -> bool:
    """Whether a process has a file or folder open, which is known by its device and inode."""
    with contextlib.suppress(OSError):
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # closed meanwhile
                if os.path.samestat(entry.stat(), state):
                    return True
    return False


@dataclass(frozen=True)
class Governed:
    """A run that governs processes, and the time in which it did; instants of CLOCK_MONOTONIC."""

    run: str  # its name
    since_ns: int  # when its first whole cycle began
    seen_ns: int  # when it was seen last
    until_ns: int | None  # when it ended; None: it has not, as far as was seen
    plan: dict[str, Any] | None  # the content of its plan file; None: it could not be read


def governing(
    pids: Collection[int],
    now_ns: int,
    before: Collection[Governed] = (),
    folder: Path | None = None,
) -> tuple[Governed, ...]:
    """Return the runs that govern threads of these processes now, or did at an earlier look.

    ``before`` is what an earlier look returned. A run of it that is gone ended when it was seen
    last.
    """
    known = {governed.run: governed for governed in before}
    runs: dict[str, Governed] = {}
    for governed in before:
        until_ns = governed.seen_ns if governed.until_ns is None else governed.until_ns
        runs[governed.run] = replace(governed, until_ns=until_ns)
    with contextlib.suppress(OperationError, PlatformError, OSError):
        for journal in find_journals(folder):
            name, state = journal.name, _plain(journal.path.with_name(STATE_FILE))
            if state is None or journal.owner is None:
                continue
            with contextlib.suppress(KeyError, TypeError, ValueError):  # not as a run writes it
                tids = [int(tid) for server in state["servers"] for tid in server["threads"]]
                threads = [find_thread(tid) for tid in tids]
                if name in known:
                    plan = known[name].plan
                elif any(thread is not None and thread.pid in pids for thread in threads):
                    plan = _plain(journal.path.with_name(PLAN_FILE))
                else:
                    continue
                if (since_ns := state["in_force_ns"]) is not None:
                    runs[name] = Governed(name, since_ns, now_ns, state.get("ended_ns"), plan)
    return tuple(runs.values())


def in_force_throughout(runs: Collection[Governed]) -> Governed | None:
    """Join runs into one, in force while all of them were; None: there was no run.

    Of runs that followed each other only the last counts. The result has a plan only if it is
    one run's.
    """
    if not runs:
        return None
    latest = max(runs, key=lambda run: run.since_ns)
    together = [run for run in runs if run.until_ns is None or run.until_ns > latest.since_ns]
    together = [latest, *(run for run in together if run is not latest)]
    ends = [run.until_ns for run in together if run.until_ns is not None]
    plan = latest.plan if len(together) == 1 else None
    return replace(latest, until_ns=min(ends, default=None), plan=plan)


def _plain(path: Path) -> dict[str, Any] | None:
    """Read a file of JSON with an object in it; None: there is none."""
    with contextlib.suppress(OSError, ValueError):
        content = json.loads(read_regular(path))
        return content if isinstance(content, dict) else None
    return None
