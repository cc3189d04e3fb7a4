"""The freezer: reservation servers for unmodified threads on a stock kernel.

Each server's threads are put into cgroups of the server's own. A dispatcher on the server's core
freezes them to close the server, and thaws them to open it (DESIGN section 6). A frozen thread
notices nothing but the time that has passed, except that ``epoll_wait``, ``recvmsg`` with a
timeout, ``sigtimedwait`` and ``semtimedop`` return EINTR. Threads that a thread in a server creates
begin in the same cgroup, and are put back with it.

The journal has no line for each cgroup. A cgroup's name says to which run and server it belongs,
and its parent is the group from which the threads came, and to which they go back.

Dispatchers count in memory that the owner shares through its file descriptors. It is not a file on
a disk, where a store to a page that is being written back waits for 0.1 s and more.
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
from chainshaper.linux.child_processes import end_in_words, start_module
from chainshaper.linux.threads import has_ended, living_processes, start_of
from chainshaper.values.errors import OperationError, PlatformError

FREEZER = "freezer"
_PREFIX = "chainshaper-"
_NAME = re.compile(rf"{_PREFIX}(\d+)(?:\.(\d+)\.(\d+))?-(\d+)-")
"""Name of a cgroup: the owner's id, its start, the descriptor of its page, the server's index.

Runs of older versions have neither start nor descriptor.
"""
# Dispatchers read commands every 20 ms at the latest, every 200 ms where boundaries leave no room.
_HEARD_WITHIN_NS = 300_000_000
_AGAIN = "release, and apply again"
_ANSWER_S = 5.0  # how long a dispatcher may take to answer a command
_START_S = 10.0  # how long a dispatcher may take to start
_LOOK_S = 0.002  # between two looks at what dispatchers have written


@dataclass(frozen=True)
class FreezerRun:
    """A run that enforces its plan by freezing."""

    owner: tuple[int, int]  # id and start of the process
    table: ServerTable  # the servers in force
    page: Path  # of the counters; it leads nowhere when the owner has ended


def read_run(entry: Mapping[str, Any]) -> FreezerRun:
    """Make a run of a journal's entry."""
    table, (pid, started) = entry["table"], entry["owner"]
    servers = tuple(
        ReservationServer(
            **{**fields, "slots": tuple((start, end) for start, end in fields["slots"])}
        )
        for fields in table["servers"]
    )
    table = ServerTable(int(table["cycle_ns"]), servers)
    return FreezerRun((int(pid), int(started)), table, Path(entry["page"]))


def run_of(journal: Journal) -> FreezerRun | None:
    """Return the run that a journal names; None: that run does not freeze threads."""
    return next(iter(journal.read(FREEZER, read_run)), None)


def groups_of(run: FreezerRun | None, core: int | None = None) -> tuple[Path, ...]:
    """Return the cgroups that a run has now; with ``core``, those of that core's servers."""
    if run is None:
        return ()
    of_run = (*map(str, run.owner), run.page.name)
    indices = {
        index
        for index, server in enumerate(run.table.servers)
        if core is None or server.core == core
    }
    return tuple(
        path
        for path, name in _all_groups()
        if name.group(1, 2, 3) == of_run and int(name[4]) in indices
    )


def stray_groups(journals: Iterable[Journal]) -> tuple[Path, ...]:
    """Return the cgroups of runs that have ended and are in none of these journals.

    A group may belong to a run in another container, which has process ids of its own. It is left
    out if it has threads that are not to be seen from here.
    """
    if not (groups := _all_groups()):
        return ()
    known = {run.owner for journal in journals if (run := run_of(journal)) is not None}
    owners, strays = known.union(living_processes()), []
    for folder, name in groups:
        pid = int(name[1])
        started = start_of(pid, pid) if name[2] is None else int(name[2])
        if (pid, started) not in owners and not cgroups.has_unseen_threads(folder):
            strays.append(folder)
    return tuple(strays)


def _all_groups() -> list[tuple[Path, "re.Match[str]"]]:
    """Return the cgroups of all runs, with the parts of their names (see `_NAME`)."""
    try:
        unseen = [cgroups.mount_point()]
    except PlatformError:
        return []
    groups = []
    while unseen:
        # Other programs make and remove groups all the time, and name them as they like.
        with contextlib.suppress(OSError), os.scandir(unseen.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    unseen.append(Path(entry.path))
                    if (name := _NAME.match(entry.name)) is not None:
                        groups.append((unseen[-1], name))
    return sorted(groups, key=lambda group: group[0])


def thaw(groups: Iterable[Path]) -> None:
    """Let the threads of these groups run; groups that are gone are passed over."""
    for folder in groups:
        with contextlib.suppress(OSError):
            (folder / "cgroup.freeze").write_text("0")


def restore(run: FreezerRun | None) -> tuple[str, ...]:
    """Put every thread of a run back, remove its groups, and mount the hierarchy as before.

    Returns what could not be done, in sentences.
    """
    groups = groups_of(run)
    thaw(groups)
    left = tuple(filter(None, map(cgroups.dissolve, groups)))
    restore_mount()
    return left


def restore_mount() -> None:
    """Mount the hierarchy as it was before the first run, unless a run still has groups."""
    if not _all_groups():
        with contextlib.suppress(PlatformError):  # there is no hierarchy
            cgroups.restore_mount()


class CoreNumbers(ctypes.Structure):
    """Numbers about the dispatcher of a core, by which it and the other processes communicate.

    The dispatcher writes:
        beats: grows as long as the dispatcher works.
        acknowledged: the number of the last command that it has obeyed.
    Guardians write:
        let_go: when they thawed the threads of a dispatcher that seems to hang (ns).
        silent: 1 if they take the dispatcher for dead.
    """

    _fields_ = [
        ("beats", ctypes.c_int64),
        ("acknowledged", ctypes.c_int64),
        ("let_go", ctypes.c_int64),
        ("silent", ctypes.c_int64),
    ]


class ServerNumbers(ctypes.Structure):
    """Counters of a server: slots, late entries, longest lateness (ns), overruns (-1: unknown)."""

    _fields_ = [
        ("slots", ctypes.c_int64),
        ("late", ctypes.c_int64),
        ("longest", ctypes.c_int64),
        ("overruns", ctypes.c_int64),
    ]


class CounterPage:
    """The memory that owner, dispatchers and guardians share.

    * ``released``: 1 when the owner has released the servers.
    * ``cores``: the numbers of each core's dispatcher, by core.
    * ``servers``: the counters of each server, by its name.
    """

    def __init__(self, path: Path, table: ServerTable) -> None:
        """Map the memory. Raises OSError: its owner has ended, or is another user's."""
        with path.open("r+b") as file:
            memory = mmap.mmap(file.fileno(), 0)
        names = [server.name for server in table.servers]
        cores = sorted({server.core for server in table.servers})
        self.released = ctypes.c_int64.from_buffer(memory)
        offset = ctypes.sizeof(self.released)
        of_cores = (CoreNumbers * len(cores)).from_buffer(memory, offset)
        self.cores = dict(zip(cores, of_cores, strict=True))
        offset += ctypes.sizeof(of_cores)
        of_servers = (ServerNumbers * len(names)).from_buffer(memory, offset)
        self.servers = dict(zip(names, of_servers, strict=True))


@dataclass(frozen=True)
class Anchoring:
    """When cycles start from now on (instants of CLOCK_MONOTONIC)."""

    begin_ns: int  # the first new cycle starts
    end_ns: int  # the last old cycle ends; if begin_ns is before, it is cut short there


def first_anchoring(anchor_ns: int, cycle_ns: int, earliest_ns: int) -> Anchoring:
    """Start cycles for the first time, at the first start at or after ``earliest_ns``."""
    begin = earliest_ns + (anchor_ns - earliest_ns) % cycle_ns
    return Anchoring(begin, begin)


def next_anchoring(
    in_force: Anchoring, anchor_ns: int, cycle_ns: int, earliest_ns: int
) -> Anchoring:
    """Change to another anchor, at the first end of a cycle at or after ``earliest_ns``.

    Either the last old cycle is cut short, or all servers wait, closed, for the first new cycle,
    whichever changes less. Worked by hand for a cycle time of 100 and cycles at 0, 100, …:

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
    """A table of servers in force by freezing; see :class:`BackEnd`.

    Making one starts a dispatcher on each core. ``go_on`` is called while a dispatcher is waited
    for, and may raise an exception. Raises OperationError: a dispatcher does not start.
    PlatformError: there is no such core.
    """

    def __init__(
        self, table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(table)
        pid = os.getpid()
        self._journal = journal
        self._go_on = go_on
        self._groups: dict[Path, str] = {}  # server names by cgroup
        self._born: dict[int, int] = {}  # when the assigned threads started, by their ids
        self._anchoring: Anchoring | None = None
        self._command = 0  # the number of the last command
        self._sent: dict[int, int] = {}  # the number of each core's last command
        self._released = False
        self._dispatchers: dict[int, subprocess.Popen[bytes]] = {}  # by core
        self._ends: dict[int, str] = {}  # why dispatchers have ended, by core
        self._memory = os.memfd_create("counters")
        os.truncate(self._memory, 8 + 64 * len(table.servers))  # at most one core for each server
        page = Path(f"/proc/{pid}/fd/{self._memory}")
        self._page = CounterPage(page, table)
        self._run = FreezerRun((pid, start_of(pid, pid) or 0), table, page)
        try:
            journal.note(FREEZER, **{**asdict(self._run), "page": str(page)})
            for core in sorted({server.core for server in table.servers}):
                process = self._dispatchers[core] = start_module(
                    "chainshaper.enforcement.slot_dispatcher",
                    str(journal.path),
                    str(core),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                )
                note_process(journal, DISPATCHER, process.pid, core)
            self._await(_START_S, "start", lambda core: self._page.cores[core].beats > 0)
        except BaseException:
            self._end()
            raise

    def assign(self, tid: int, server: str, place: int = 0) -> None:  # noqa: ARG002 - by priority
        """Put a thread into a server; see :meth:`BackEnd.assign`.

        If the slots are enforced already and the server is closed, the thread stops at once. Raises
        OperationError: it belongs to another run, or the servers are no longer in force.
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
                cgroups.make_moves_quick()  # until no run has groups any more
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
        """Give the same servers other slots, on all cores from the same end of a cycle on."""
        self._table = table
        self.arm(anchor_ns)

    def arm(self, anchor_ns: int) -> None:
        """Enforce the slots; see :meth:`BackEnd.arm`. Returns when all dispatchers know of it."""
        self._check_in_force()
        cycle_ns, earliest_ns = self._table.cycle_ns, time.monotonic_ns() + _HEARD_WITHIN_NS
        if self._anchoring is None:
            anchoring = first_anchoring(anchor_ns, cycle_ns, earliest_ns)
        else:
            anchoring = next_anchoring(self._anchoring, anchor_ns, cycle_ns, earliest_ns)
        for core in self._dispatchers:
            slots = [server.slots for server in self._table.servers if server.core == core]
            self._send(core, **asdict(anchoring), slots=slots)
        self._anchoring, self._since_ns = anchoring, anchoring.begin_ns
        self._await_answers()

    def members(self) -> dict[str, tuple[int, ...]]:
        """Return the living threads of every server, those that began there included."""
        members = dict.fromkeys((server.name for server in self._table.servers), tuple[int, ...]())
        for folder, server in self._groups.items():
            members[server] += cgroups.threads_in(folder)
        return members

    def counters(self) -> dict[str, ServerCounters]:
        """Return what dispatchers have counted; see :meth:`BackEnd.counters`. Up to 20 ms old."""
        return {
            name: ServerCounters(
                slots=numbers.slots,
                late_entries=numbers.late,
                longest_lateness_ns=numbers.longest,
                overruns=numbers.overruns if numbers.overruns >= 0 else None,
            )
            for name, numbers in self._page.servers.items()
        }

    @property
    def dispatchers(self) -> dict[int, int]:
        """The process id of each core's dispatcher."""
        return {core: process.pid for core, process in self._dispatchers.items()}

    def failure(self) -> str | None:
        """Say why servers are not enforced; see :meth:`BackEnd.failure`.

        Where the reason is a thread that runs freely, the other threads are enforced still.
        """
        if self._released:
            return None
        # Looked for first: guardians let threads go when a dispatcher has failed, which says more.
        free_thread = self._free_thread()
        return self._dispatcher_failure() or free_thread

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

    def _await(self, within_s: float, action: str, done: Callable[[int], bool]) -> None:
        """Wait until ``done`` holds for each core; a message calls what is waited for ``action``.

        Raises OperationError: it takes too long, or a dispatcher has ended.
        """
        deadline = time.monotonic() + within_s
        for core in self._dispatchers:
            while not done(core):
                self._go_on()
                self._check_in_force()
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} did not {action} within {within_s:g} s:"
                        " has a real-time process that core for itself?"
                    )
                time.sleep(_LOOK_S)

    def _dispatcher_failure(self) -> str | None:
        """Say why a dispatcher has ended; None: all work."""
        for core, process in self._dispatchers.items():
            if core in self._ends or process.poll() is None:
                continue
            said = process.stderr.read().decode(errors="replace") if process.stderr else ""
            reason = end_in_words(process.returncode)
            if said:
                reason += ": "
            if self._page.cores[core].silent:
                reason = "hung, or was stopped"
            lines = "; ".join(said.splitlines())
            self._ends[core] = f"the dispatcher of core {core} {reason}{lines}"
        return next(iter(self._ends.values()), None)

    def _free_thread(self) -> str | None:
        """Say which assigned thread runs freely, since it was moved; None: none does.

        Groups that are gone are forgotten: a service or container that ends takes them with it.
        """
        for folder in [folder for folder in self._groups if not folder.is_dir()]:
            del self._groups[folder]
        inside = {tid for tids in self.members().values() for tid in tids}
        for tid in self._born.keys() - inside:
            if not has_ended(tid, self._born[tid]):
                return f"thread {tid} was moved out of its cgroup, and runs freely; {_AGAIN}"
            del self._born[tid]
        return None

    def _check_in_force(self) -> None:
        """Raise OperationError, or PlatformError, if the servers are not in force any more."""
        reason = "they were released" if self._released else self._dispatcher_failure()
        if reason is not None:
            codes = [process.returncode for process in self._dispatchers.values()]
            kind = PlatformError if PlatformError.exit_code in codes else OperationError
            raise kind(f"the servers are no longer in force: {reason}")

    def _send(self, core: int, **fields: object) -> None:
        """Send a command with these fields to the dispatcher of a core, with the next number."""
        self._command += 1
        self._sent[core] = self._command
        line = json.dumps({"number": self._command, **fields}) + "\n"
        if (commands := self._dispatchers[core].stdin) is not None:
            with contextlib.suppress(BrokenPipeError):  # it has ended: `failure` will say why
                os.write(commands.fileno(), line.encode())

    def _await_answers(self) -> None:
        """Wait until all dispatchers have obeyed their last command."""
        numbers, sent = self._page.cores, self._sent
        self._await(
            _ANSWER_S, "answer", lambda core: numbers[core].acknowledged >= sent.get(core, 0)
        )

    def _end(self) -> tuple[str, ...]:
        """Put threads and groups back, then end the dispatchers; return what is left, in sentences.

        Dispatchers come last: they would put things back if this process were killed before.
        """
        self._page.released.value = 1
        left = restore(self._run)
        for process in self._dispatchers.values():
            process.kill()  # one that was stopped hears nothing else
            process.communicate()
        os.close(self._memory)
        return left
