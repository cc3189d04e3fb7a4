"""The freezer: reservation servers for unmodified threads on a stock kernel.

Each server's threads are put into cgroups of its own, and a dispatcher on the server's core opens
and closes these by freezing them (DESIGN section 6). A thread sees nothing of it but the time,
except that ``epoll_wait``, ``recvmsg`` with a timeout, ``sigtimedwait`` and ``semtimedop`` return
EINTR. What a gated thread creates is born in its server, and put back with it.

Groups need no line each in the journal: their names say whose they are and for which server, and
they stand directly beneath those from which threads came, where these go back to.

Dispatchers write their numbers to memory of the owner, reached through its descriptors: in a file
on a disk, a store to a page that is being written back waits for 0.1 s and more.
"""

import contextlib
import ctypes
import json
import mmap
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chainshaper.enforcement.journal import DISPATCHER, Journal, note_process
from chainshaper.enforcement.scheduling_memory import release_threads
from chainshaper.enforcement.servers import (
    BackEnd,
    ReservationServer,
    ServerCounters,
    ServerTable,
    server_named,
)
from chainshaper.linux import cgroups
from chainshaper.linux.own_processes import end_in_words, start_module
from chainshaper.linux.threads import has_ended, living_processes, start_of
from chainshaper.values.errors import OperationError, PlatformError

FREEZER = "freezer"
_PREFIX = "chainshaper-"
_NAME = re.compile(rf"{_PREFIX}(\d+)(?:\.(\d+)\.(\d+))?-(\d+)-")
"""The owner's id; its start and which of its runs (older ones: without); the server's place."""
# Dispatchers listen every 20 ms at the latest, every 200 ms where boundaries leave no room.
_HEARD_WITHIN_NS = 300_000_000
_AGAIN = "release, and apply again"
_ANSWER_S = 5.0
_START_S = 10.0
_LOOK_S = 0.002


@dataclass(frozen=True)
class FreezerRun:
    """The servers in force, id and start of their owner, and, while it lives, the counters."""

    owner: tuple[int, int]
    table: ServerTable
    page: Path


def read_run(entry: Mapping[str, Any]) -> FreezerRun:
    """A journal's entry as a value."""
    table, (pid, started) = entry["table"], entry["owner"]
    servers = tuple(
        ReservationServer(**{**one, "slots": tuple((start, end) for start, end in one["slots"])})
        for one in table["servers"]
    )
    table = ServerTable(int(table["cycle_ns"]), servers)
    return FreezerRun((int(pid), int(started)), table, Path(entry["page"]))


def run_of(journal: Journal) -> FreezerRun | None:
    """What a journal says of a freezer, None if it does not."""
    return next(iter(journal.read(FREEZER, read_run)), None)


def groups_of(run: FreezerRun | None, core: int | None = None) -> tuple[Path, ...]:
    """The groups of a run that there are; of the servers of one core, if one is given."""
    if run is None:
        return ()
    whose = (*map(str, run.owner), run.page.name)
    places = [k for k, one in enumerate(run.table.servers) if core in (None, one.core)]
    own = ((path, int(name[4])) for path, name in _all_groups() if name.group(1, 2, 3) == whose)
    return tuple(path for path, place in own if place in places)


def stray_groups(journals: Iterable[Journal]) -> tuple[Path, ...]:
    """Groups of ours of no journal of these, whose owner (by its id in a container) has ended."""
    if not (groups := _all_groups()):
        return ()
    known = {run.owner for journal in journals if (run := run_of(journal)) is not None}
    owners, strays = known.union(living_processes()), []
    for folder, name in groups:
        pid = int(name[1])
        started = start_of(pid, pid) if name[2] is None else int(name[2])
        if (pid, started) not in owners and not cgroups.has_unseen_threads(folder):
            strays.append(folder)  # where some are not to be seen, it is another container's
    return tuple(strays)


def _all_groups() -> list[tuple[Path, "re.Match[str]"]]:
    try:
        unseen = [cgroups.mount_point()]
    except PlatformError:
        return []
    found = []
    while unseen:
        # Others make and remove groups all the time, and name them as they like.
        with contextlib.suppress(OSError), os.scandir(unseen.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    unseen.append(Path(entry.path))
                    if (name := _NAME.match(entry.name)) is not None:
                        found.append((unseen[-1], name))
    return sorted(found, key=lambda group: group[0])


def thaw(groups: Iterable[Path]) -> None:
    """Let the threads of these groups run; one that is gone has no thread."""
    for folder in groups:
        with contextlib.suppress(OSError):
            (folder / "cgroup.freeze").write_text("0")


def restore(run: FreezerRun | None) -> tuple[str, ...]:
    """Put every thread back, remove the groups, mount as before; what could not be, in words."""
    groups = groups_of(run)
    thaw(groups)
    left = tuple(filter(None, map(cgroups.dissolve, groups)))
    restore_mount()
    return left


def restore_mount() -> None:
    """Mount the hierarchy as it was before the first of our runs, when no group of any is left."""
    if not _all_groups():
        with contextlib.suppress(PlatformError):  # there is no hierarchy
            cgroups.restore_mount()


class CoreNumbers(ctypes.Structure):
    """``beats`` move as long as the dispatcher does; ``acknowledged`` is its last command.
    Guardians write ``let_go``, when (ns) they thawed the threads of one that hangs, and ``silent``.
    """

    _fields_ = [(name, ctypes.c_int64) for name in ("beats", "acknowledged", "let_go", "silent")]


class ServerNumbers(ctypes.Structure):
    """Slots, late entries, longest lateness (ns), overruns (-1: unknown)."""

    _fields_ = [(name, ctypes.c_int64) for name in ("slots", "late", "longest", "overruns")]


class CounterPage:
    """The numbers of a table's cores and servers, and whether the owner has released them."""

    def __init__(self, path: Path, table: ServerTable) -> None:
        """Map them. Raises OSError: their owner has ended, or is another user's."""
        with path.open("r+b") as file:
            memory = mmap.mmap(file.fileno(), 0)
        names, cores = [one.name for one in table.servers], {one.core for one in table.servers}
        self.released = ctypes.c_int64.from_buffer(memory)
        place = ctypes.sizeof(self.released)
        own = (CoreNumbers * len(cores)).from_buffer(memory, place)
        self.cores = dict(zip(sorted(cores), own, strict=True))
        theirs = (ServerNumbers * len(names)).from_buffer(memory, place + ctypes.sizeof(own))
        self.servers = dict(zip(names, theirs, strict=True))


@dataclass(frozen=True)
class Anchoring:
    """Cycles start at ``begin_ns``, again and again; the old ones end at ``end_ns``, or there."""

    begin_ns: int
    end_ns: int


def first_anchoring(anchor_ns: int, cycle_ns: int, earliest_ns: int) -> Anchoring:
    """The first start of a cycle at or after ``earliest_ns``; before it nothing is enforced."""
    begin = earliest_ns + (anchor_ns - earliest_ns) % cycle_ns
    return Anchoring(begin, begin)


def next_anchoring(
    in_force: Anchoring, anchor_ns: int, cycle_ns: int, earliest_ns: int
) -> Anchoring:
    """To another anchor at the first end of a cycle that allows it: the last cycle is cut short or,
    if that is shorter, all servers wait, closed, for the first new one. Worked by hand, cycle time
    100, cycles at 0, 100, …:

        >>> next_anchoring(Anchoring(0, 0), 30, 100, 950)       # wait, closed, from 1000 to 1030
        Anchoring(begin_ns=1030, end_ns=1000)
        >>> next_anchoring(Anchoring(0, 0), 80, 100, 950)       # cut the cycle from 900 short
        Anchoring(begin_ns=980, end_ns=1000)
    """
    end = first_anchoring(in_force.begin_ns, cycle_ns, max(earliest_ns, in_force.begin_ns)).begin_ns
    shift = (anchor_ns - end) % cycle_ns
    if shift > cycle_ns // 2:
        shift -= cycle_ns
    if end + shift < earliest_ns:
        end += cycle_ns
    return Anchoring(end + shift, end)


class Freezer(BackEnd):
    """A table of servers in force by freezing; see :class:`BackEnd`. Making one starts a dispatcher
    per core; ``go_on`` is called while something is waited for, and may raise. Raises
    OperationError: a dispatcher does not start. PlatformError: no such core.
    """

    def __init__(
        self, table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(table)
        pid = os.getpid()
        self._journal = journal
        self._go_on = go_on
        self._groups: dict[Path, str] = {}
        self._born: dict[int, int] = {}  # the threads that were assigned, and when they started
        self._anchoring: Anchoring | None = None
        self._command = 0
        self._sent: dict[int, int] = {}
        self._released = False
        self._dispatchers: dict[int, subprocess.Popen[bytes]] = {}
        self._ends: dict[int, str] = {}
        self._memory = os.memfd_create("counters")
        os.truncate(self._memory, 8 + 64 * len(table.servers))  # there are not more cores
        page = Path(f"/proc/{pid}/fd/{self._memory}")
        self._page = CounterPage(page, table)
        self._run = FreezerRun((pid, start_of(pid, pid) or 0), table, page)
        try:
            journal.note(FREEZER, **{**asdict(self._run), "page": str(page)})
            for core in sorted({server.core for server in table.servers}):
                process = self._dispatchers[core] = start_module(
                    "chainshaper.enforcement.slot_dispatcher",
                    *(str(journal.path), str(core)),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                )
                note_process(journal, DISPATCHER, process.pid, core)
            self._await(_START_S, "start", lambda core: self._page.cores[core].beats > 0)
        except BaseException:
            self._end()
            raise

    def assign(self, tid: int, server: str, place: int = 0) -> None:  # noqa: ARG002 - by priority
        """See :meth:`BackEnd.assign`. While armed, a thread whose server is closed stops at once.
        Raises OperationError: it belongs to another run, or the servers are no longer in force.
        PlatformError: its cgroup or our privileges do not allow it.
        """
        number = self._table.servers.index(server_named(self._table, server))
        self._check_in_force()
        born = start_of(tid, tid)
        if born is None:
            return
        try:
            parent = cgroups.cgroup_of(tid)
            if parent in self._groups:
                parent = parent.parent
            elif parent.name.startswith(_PREFIX):
                raise OperationError(f"thread {tid} is in {parent} of another run: end that first")
            readable = re.sub(r"[^A-Za-z0-9_.-]+", "_", server)[:64]
            (pid, started), page = self._run.owner, self._run.page.name
            folder = parent / f"{_PREFIX}{pid}.{started}.{page}-{number}-{readable}"
            if folder not in self._groups:
                cgroups.make_threaded_child(parent, folder.name)
                cgroups.make_moves_quick()  # for as long as there are groups of any run
                self._groups[folder] = server
                self._send(self._table.servers[number].core, server=server, folder=str(folder))
                if self._anchoring is not None:
                    self._await_answers()
            if cgroups.move_thread(tid, folder):
                self._born[tid] = born
        except (OperationError, PlatformError):
            if not has_ended(tid, born):
                raise

    def change(self, table: ServerTable, anchor_ns: int) -> None:
        """Other slots for the same servers, on all cores from the same end of a cycle on."""
        self._table = table
        self.arm(anchor_ns)

    def arm(self, anchor_ns: int) -> None:
        """See :meth:`BackEnd.arm`; returns when all dispatchers have heard of it."""
        self._check_in_force()
        when = (anchor_ns, self._table.cycle_ns, time.monotonic_ns() + _HEARD_WITHIN_NS)
        old = self._anchoring
        anchoring = first_anchoring(*when) if old is None else next_anchoring(old, *when)
        for core in self._dispatchers:
            slots = [server.slots for server in self._table.servers if server.core == core]
            self._send(core, **asdict(anchoring), slots=slots)
        self._anchoring, self._since_ns = anchoring, anchoring.begin_ns
        self._await_answers()

    def members(self) -> dict[str, tuple[int, ...]]:
        """The living threads of every server, those that were born there included."""
        found = dict.fromkeys((server.name for server in self._table.servers), tuple[int, ...]())
        for folder, server in self._groups.items():
            found[server] += cgroups.threads_in(folder)
        return found

    def counters(self) -> dict[str, ServerCounters]:
        """See :meth:`BackEnd.counters`; up to 20 ms old."""
        return {
            name: ServerCounters(
                its.slots, its.late, its.longest, its.overruns if its.overruns >= 0 else None
            )
            for name, its in self._page.servers.items()
        }

    @property
    def dispatchers(self) -> dict[int, int]:
        """The process id of each core's dispatcher."""
        return {core: process.pid for core, process in self._dispatchers.items()}

    def failure(self) -> str | None:
        """See :meth:`BackEnd.failure`. A lost thread leaves the others enforced."""
        if self._released:
            return None
        lost = self._lost()  # first: threads are let go when a dispatcher is lost
        return self._dispatcher_failure() or lost

    def release(self) -> None:
        if self._released:
            return
        self._released = True
        self._page.released.value = 1
        thaw(self._groups)
        try:
            release_threads(self._journal, self._groups)
        finally:
            left = self._end()
        if left:
            raise OperationError("; ".join(left))

    def _await(self, within_s: float, what: str, done: Callable[[int], bool]) -> None:
        """Wait until all cores' dispatchers have done something; ``what`` is for messages."""
        deadline = time.monotonic() + within_s
        for core in self._dispatchers:
            while not done(core):
                self._go_on()
                self._check_in_force()
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} did not {what} within {within_s:g} s: has "
                        "a real-time process that core for itself?"
                    )
                time.sleep(_LOOK_S)

    def _dispatcher_failure(self) -> str | None:
        """Why a dispatcher has ended: what it said, or what was done to it."""
        for core, process in self._dispatchers.items():
            if core in self._ends or process.poll() is None:
                continue
            said = process.stderr.read().decode(errors="replace") if process.stderr else ""
            why = end_in_words(process.returncode) + ": " * bool(said)
            why = "hung, or was stopped" if self._page.cores[core].silent else why
            self._ends[core] = f"the dispatcher of core {core} {why}{'; '.join(said.splitlines())}"
        return next(iter(self._ends.values()), None)

    def _lost(self) -> str | None:
        """A thread that runs freely. A service or container that ends takes its groups with it."""
        for folder in [one for one in self._groups if not one.is_dir()]:
            del self._groups[folder]
        inside = {tid for tids in self.members().values() for tid in tids}
        for tid in self._born.keys() - inside:
            if not has_ended(tid, self._born[tid]):
                return f"thread {tid} was moved out of its cgroup, and runs freely; {_AGAIN}"
            del self._born[tid]
        return None

    def _check_in_force(self) -> None:
        reason = "they were released" if self._released else self._dispatcher_failure()
        if reason is not None:
            codes = [process.returncode for process in self._dispatchers.values()]
            kind = PlatformError if PlatformError.exit_code in codes else OperationError
            raise kind(f"the servers are no longer in force: {reason}")

    def _send(self, core: int, **fields: object) -> None:
        self._command += 1
        self._sent[core] = self._command
        line = json.dumps({"number": self._command, **fields}) + "\n"
        if (commands := self._dispatchers[core].stdin) is not None:
            with contextlib.suppress(BrokenPipeError):  # `failure` will say what has become of it
                os.write(commands.fileno(), line.encode())

    def _await_answers(self) -> None:
        numbers, sent = self._page.cores, self._sent
        self._await(_ANSWER_S, "answer", lambda c: numbers[c].acknowledged >= sent.get(c, 0))

    def _end(self) -> tuple[str, ...]:
        """Put threads and groups back, then end the dispatchers, who would finish it should we be
        killed in between; what is left, in sentences.
        """
        self._page.released.value = 1
        left = restore(self._run)
        for process in self._dispatchers.values():
            process.kill()  # one that was stopped hears nothing else
            process.communicate()
        os.close(self._memory)
        return left
