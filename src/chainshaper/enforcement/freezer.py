"""The freezer: reservation servers for unmodified threads on a stock kernel.

Each server's threads are put into cgroups of its own, and a dispatcher on the server's core opens
and closes these by freezing them (DESIGN section 6). A thread sees nothing of it but the time,
except that ``epoll_wait``, ``recvmsg`` with a timeout, ``sigtimedwait`` and ``semtimedop`` return
EINTR. What a gated thread creates is born in its server, and put back with it.

The journal says, before anything is changed, which servers there will be and how the hierarchy was
mounted. Groups need no line each: their names say which process made them and for which server. A
group is made directly beneath the one from which its threads came: their way back is its parent.

Dispatchers write their numbers to memory of the owner, reached through its descriptors. Not to a
file on a disk: a store to a mapped page that is being written back waits for 0.1 s and more.
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

from chainshaper.enforcement.scheduling_memory import release_threads
from chainshaper.enforcement.servers import (
    ReservationServer,
    ServerCounters,
    ServerTable,
    server_named,
)
from chainshaper.linux import cgroups
from chainshaper.linux.own_processes import end_in_words, module_command
from chainshaper.linux.runs import DISPATCHER, Journal, note_process
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import OperationError, PlatformError

FREEZER = "freezer"
_PREFIX = "chainshaper-"
_NAME = re.compile(rf"{_PREFIX}(\d+)(?:\.(\d+)\.(\d+))?-(\d+)-")
"""The owner's id; its start and which of its runs (older ones: without); the server's place."""
# Dispatchers listen every 20 ms at the latest, every 200 ms where boundaries leave no room.
_HEARD_WITHIN_NS = 300_000_000
_ANSWER_S = 5.0
_START_S = 10.0
_LOOK_S = 0.002


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


def read_run(entry: Mapping[str, Any]) -> FreezerRun:
    """A journal's entry as a value."""
    table, (pid, started) = entry["table"], entry["owner"]
    servers = tuple(
        ReservationServer(**{**one, "slots": tuple((start, end) for start, end in one["slots"])})
        for one in table["servers"]
    )
    table = ServerTable(int(table["cycle_ns"]), servers)
    return FreezerRun((int(pid), int(started)), table, Path(entry["page"]), entry["mount_options"])


def run_of(journal: Journal) -> FreezerRun | None:
    """What a journal says of a freezer, None if it does not."""
    return next(iter(journal.read(FREEZER, read_run)), None)


def groups_of(run: FreezerRun | None, core: int | None = None) -> tuple[Path, ...]:
    """The groups of a run that there are; of the servers of one core, if one is given."""
    if run is None:
        return ()
    whose = (*map(str, run.owner), run.page.name)
    places = [number for number, one in enumerate(run.table.servers) if one.core == core]
    return tuple(
        folder
        for folder, name in _all_groups()
        if name.group(1, 2, 3) == whose and (core is None or int(name[4]) in places)
    )


def stray_groups(journals: Iterable[Journal]) -> tuple[Path, ...]:
    """Groups of ours of none of these journals, and whose owner has ended.

    Not those with threads that cannot be seen from here: their owner is outside of this container.
    """
    known = {run.owner for journal in journals if (run := run_of(journal)) is not None}
    strays = []
    for folder, name in _all_groups():
        pid = int(name[1])
        started = start_of(pid, pid) if name[2] is None else int(name[2])
        owned = (pid, started) in known or not (started is None or has_ended(pid, started))
        if not owned and not cgroups.has_unseen_threads(folder):
            strays.append(folder)
    return tuple(strays)


def _all_groups() -> list[tuple[Path, "re.Match[str]"]]:
    while True:
        try:
            found = sorted(cgroups.mount_point().rglob(f"{_PREFIX}*"))
        except PlatformError:
            return []
        except FileNotFoundError:  # one was removed while we looked: once more
            continue
        names = ((folder, _NAME.match(folder.name)) for folder in found)
        return [(folder, name) for folder, name in names if name is not None]


def thaw(groups: Iterable[Path]) -> None:
    """Let the threads of these groups run; one that is gone has no thread."""
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
    left = tuple(why for folder in groups if (why := cgroups.dissolve(folder)) is not None)
    if run is not None and run.mount_options is not None:
        cgroups.restore_mount(run.mount_options)
    return left


def restore_stray_mount() -> None:
    """Mount the hierarchy as it was before a run whose journal is gone, if no group is in use."""
    with contextlib.suppress(PlatformError):
        in_use = not cgroups.moves_are_quick() or _all_groups()
        before = None if in_use else cgroups.options_before_ours()
        if before is not None:
            cgroups.restore_mount(before)


def _numbers(*names: str) -> list[tuple[str, type[ctypes.c_int64]]]:
    return [(name, ctypes.c_int64) for name in names]


class CoreNumbers(ctypes.Structure):
    """``beats`` move as long as the dispatcher does; ``acknowledged`` is its last command.

    Guardians write ``let_go``, when they thawed the threads of one that was still for a moment
    (ns), and ``silent``: it was still for too long.
    """

    beats: int
    acknowledged: int
    let_go: int
    silent: int
    _fields_ = _numbers("beats", "acknowledged", "let_go", "silent")


class ServerNumbers(ctypes.Structure):
    """Slots, late entries, longest lateness (ns), overruns (-1: unknown), groups lost."""

    slots: int
    late: int
    longest: int
    overruns: int
    lost: int
    _fields_ = _numbers("slots", "late", "longest", "overruns", "lost")


class CounterPage:
    """The numbers of a table's cores and servers, and whether the owner has released them."""

    def __init__(self, path: Path, table: ServerTable) -> None:
        """Map them. Raises OSError: their owner has ended, or is another user's."""
        with path.open("r+b") as file:
            memory = mmap.mmap(file.fileno(), 0)
        self.released = ctypes.c_int64.from_buffer(memory)
        place = ctypes.sizeof(ctypes.c_int64)
        self.cores: dict[int, CoreNumbers] = {}
        for core in sorted({server.core for server in table.servers}):
            self.cores[core] = CoreNumbers.from_buffer(memory, place)
            place += ctypes.sizeof(CoreNumbers)
        self.servers: dict[str, ServerNumbers] = {}
        for server in table.servers:
            self.servers[server.name] = ServerNumbers.from_buffer(memory, place)
            place += ctypes.sizeof(ServerNumbers)


@dataclass(frozen=True)
class Anchoring:
    """Cycles start at ``begin_ns`` and every cycle time thereafter; the old ones end at ``end_ns``.

    Both are instants of CLOCK_MONOTONIC. The earlier of the two is when the old cycles are left.
    """

    begin_ns: int
    end_ns: int


def first_anchoring(anchor_ns: int, cycle_ns: int, earliest_ns: int) -> Anchoring:
    """The first start of a cycle at or after ``earliest_ns``; before it nothing is enforced."""
    begin = anchor_ns + -((anchor_ns - earliest_ns) // cycle_ns) * cycle_ns
    return Anchoring(begin, begin)


def next_anchoring(
    in_force: Anchoring, anchor_ns: int, cycle_ns: int, earliest_ns: int
) -> Anchoring:
    """From the anchoring in force to another anchor, at the first end of a cycle that allows it.

    No thread slips between: the last cycle is cut short, or all servers wait, closed, for the first
    of the new ones, whichever is shorter. Worked by hand, cycle time 100, cycles at 0, 100, …:

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


class Freezer:
    """A table of servers in force by freezing; see :class:`BackEnd` for what each method does.

    Making one starts a dispatcher per core; ``go_on`` is called again and again while something is
    waited for, and may raise. The run's guardians watch over all of them: whichever is lost, no
    thread stays stopped. Raises OperationError: a dispatcher does not start. PlatformError: no
    cgroup v2 here, or a core is missing.
    """

    name = "freezer"

    def __init__(
        self, table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
    ) -> None:
        mounts, pid = cgroups.options_before_ours(), os.getpid()
        self.table = table
        self._journal = journal
        self._go_on = go_on
        self._groups: dict[Path, str] = {}
        self._born: dict[int, int] = {}  # the threads that were assigned, and when they started
        self._anchoring: Anchoring | None = None
        self._command = 0
        self._sent: dict[int, int] = {}
        self._released = False
        self._pipes: dict[int, int] = {}
        self._dispatchers: dict[int, subprocess.Popen[str]] = {}
        self._ends: dict[int, str] = {}
        self._memory = os.memfd_create("counters")
        os.truncate(self._memory, 8 + 80 * len(table.servers))  # there are not more cores
        page = Path(f"/proc/{pid}/fd/{self._memory}")
        self._page = CounterPage(page, table)
        self._run = FreezerRun((pid, start_of(pid, pid) or 0), table, page, mounts)
        try:
            journal.note(FREEZER, **{**asdict(self._run), "page": str(page)})
            for core in sorted({server.core for server in table.servers}):
                self._dispatchers[core] = self._start_dispatcher(core)
            self._wait_until_running()
            if mounts is not None:
                cgroups.make_moves_quick(mounts)
        except BaseException:
            self._end()
            raise

    def assign(self, tid: int, server: str) -> None:
        """See :meth:`BackEnd.assign`. While armed, a thread whose server is closed stops at once.

        Raises InputError: there is no such server. OperationError: it belongs to another run, or
        the servers are no longer in force. PlatformError: its cgroup or our privileges do not allow
        it.
        """
        number = self.table.servers.index(server_named(self.table, server))
        self._check_in_force()
        born = start_of(tid, tid)
        if born is None:
            return
        try:
            parent = cgroups.cgroup_of(tid)
            if parent in self._groups:
                parent = parent.parent
            elif parent.name.startswith(_PREFIX):
                raise OperationError(
                    f"thread {tid} is in the cgroup {parent} of another run: end that run first "
                    "(`chainshaper release`)"
                )
            readable = re.sub(r"[^A-Za-z0-9_.-]+", "_", server)[:64]
            (pid, started), page = self._run.owner, self._run.page.name
            folder = parent / f"{_PREFIX}{pid}.{started}.{page}-{number}-{readable}"
            if folder not in self._groups:
                cgroups.make_threaded_child(parent, folder.name)
                self._groups[folder] = server
                self._send(self.table.servers[number].core, server=server, folder=str(folder))
                if self._anchoring is not None:
                    self._await_answers()
            if cgroups.move_thread(tid, folder):
                self._born[tid] = born
        except OperationError:
            if not has_ended(tid, born):
                raise

    def change(self, table: ServerTable, anchor_ns: int) -> None:
        """Other slots for the same servers, on all cores from the same end of a cycle on."""
        self.table = table
        self.arm(anchor_ns)

    def arm(self, anchor_ns: int) -> None:
        """See :meth:`BackEnd.arm`; returns when all dispatchers have heard of it.

        In force from the first start of a cycle after that on; once more, from the end of a cycle
        on (:func:`next_anchoring`).
        """
        self._check_in_force()
        earliest = time.monotonic_ns() + _HEARD_WITHIN_NS
        if self._anchoring is None:
            anchoring = first_anchoring(anchor_ns, self.table.cycle_ns, earliest)
        else:
            anchoring = next_anchoring(self._anchoring, anchor_ns, self.table.cycle_ns, earliest)
        for core in self._pipes:
            slots = [server.slots for server in self.table.servers if server.core == core]
            self._send(core, **asdict(anchoring), slots=slots)
        self._anchoring = anchoring
        self._await_answers()

    def in_force_from(self) -> int | None:
        return None if self._anchoring is None else self._anchoring.begin_ns

    def members(self) -> dict[str, tuple[int, ...]]:
        """The living threads of every server, those that were born there included."""
        found: dict[str, tuple[int, ...]] = {server.name: () for server in self.table.servers}
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
        """See :meth:`BackEnd.failure`. A lost group or thread leaves the others enforced."""
        if self._released:
            return None
        # Threads are let go when a dispatcher is lost: that is looked at last.
        lost = self._lost()
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

    def _start_dispatcher(self, core: int) -> "subprocess.Popen[str]":
        reading, self._pipes[core] = os.pipe()
        command = module_command("chainshaper.enforcement.slot_dispatcher")
        try:
            process = subprocess.Popen(
                [*command, str(self._journal.path), str(os.getpid()), str(core), str(reading)],
                pass_fds=(reading,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        finally:
            os.close(reading)
        note_process(self._journal, DISPATCHER, process.pid, core)
        return process

    def _wait_until_running(self) -> None:
        deadline = time.monotonic() + _START_S
        for core, process in self._dispatchers.items():
            while self._page.cores[core].beats == 0:
                self._go_on()
                if (code := process.poll()) is not None:
                    kind = PlatformError if code == PlatformError.exit_code else OperationError
                    raise kind(self._end_of_dispatcher(core))
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} did not start within {_START_S:g} s: is a "
                        "real-time process keeping that core from everybody?"
                    )
                time.sleep(_LOOK_S)

    def _dispatcher_failure(self) -> str | None:
        for core, process in self._dispatchers.items():
            if core not in self._ends and process.poll() is not None:
                self._ends[core] = self._end_of_dispatcher(core)
        return next(iter(self._ends.values()), None)

    def _end_of_dispatcher(self, core: int) -> str:
        """Why a dispatcher has ended: what it said, or what was done to it."""
        process = self._dispatchers[core]
        if self._page.cores[core].silent:
            return f"the dispatcher of core {core} hung, or was stopped"
        said = process.stderr.read().splitlines() if process.stderr else []
        ended = f"the dispatcher of core {core} {end_in_words(process.returncode)}"
        return ": ".join(filter(None, (ended, "; ".join(said))))

    def _lost(self) -> str | None:
        for name, numbers in self._page.servers.items():
            if numbers.lost:
                return (
                    f"a cgroup of server {name} was removed: the threads that were "
                    "in it run freely; release, and apply again"
                )
        inside = {tid for tids in self.members().values() for tid in tids}
        for tid, born in list(self._born.items()):
            if tid not in inside:
                if not has_ended(tid, born):
                    return (
                        f"thread {tid} was moved out of its server's cgroup: it runs freely; "
                        "release, and apply again"
                    )
                del self._born[tid]
        return None

    def _check_in_force(self) -> None:
        reason = "they were released" if self._released else self._dispatcher_failure()
        if reason is not None:
            raise OperationError(f"the servers are no longer in force: {reason}")

    def _send(self, core: int, **fields: object) -> None:
        self._command += 1
        self._sent[core] = self._command
        line = json.dumps({"number": self._command, **fields}) + "\n"
        with contextlib.suppress(BrokenPipeError):  # `failure` will say what has become of it
            os.write(self._pipes[core], line.encode())

    def _await_answers(self) -> None:
        deadline = time.monotonic() + _ANSWER_S
        for core, number in self._sent.items():
            while self._page.cores[core].acknowledged < number:
                self._go_on()
                self._check_in_force()
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} has not answered for {_ANSWER_S:g} s"
                    )
                time.sleep(_LOOK_S)

    def _end(self) -> tuple[str, ...]:
        """Put threads and groups back, and end the dispatchers; what is left, in sentences.

        In this order: should we be killed in between, the dispatchers are there to finish it.
        """
        self._page.released.value = 1
        left = restore(self._run)
        for process in self._dispatchers.values():
            process.kill()  # one that was stopped hears nothing else
            process.communicate()
        for file in [*self._pipes.values(), self._memory]:
            os.close(file)
        return left
