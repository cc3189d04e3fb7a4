"""The dispatcher: a process that opens and closes the servers of one core, on that core.

    python -m chainshaper.enforcement.slot_dispatcher JOURNAL CORE

It sleeps until a boundary, writes ``1`` to the ``cgroup.freeze`` of what closes and then ``0`` to
that of what opens, and sleeps again. It runs on the core that it gates, above everything there: the
timer interrupt alone takes the core from a thread whose slot has ended, so a slot is left exactly.
The next thread runs only when the dispatcher sleeps again, so all that can wait is done at
**ticks** between boundaries: counting, the owner's commands on the standard input, and looking for
overruns.

It ends when the owner is gone, and thaws its threads however it ends; against SIGKILL and SIGSTOP
there are guardians. Should those be gone together with the owner, it undoes the whole run.
"""

import contextlib
import errno
import json
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from itertools import chain, takewhile
from pathlib import Path
from typing import NamedTuple

from chainshaper.enforcement.freezer import Anchoring, CounterPage, FreezerRun, run_of
from chainshaper.enforcement.journal import remembered_journal
from chainshaper.linux.scheduling import (
    become_fifo,
    lock_memory,
    set_thread_name,
    stop_garbage_collection,
)
from chainshaper.linux.threads import read_proc
from chainshaper.robot.clocks import sleep_until, watch_until
from chainshaper.values.errors import ChainshaperError, OperationError, PlatformError, shown

PRIORITY = 97
_LATE_NS = 100_000
_TICK_NS = 20_000_000
# After a boundary: frozen threads, too, need the core to reach the freezer; and a gate may publish.
_REST_NS = 1_000_000
_ROOM_NS = 200_000  # at least, between a tick and the boundaries around it
_WATCH_NS = 100_000  # before a boundary, instead of sleeping
_THAWED_AFTER_NS = 60_000_000  # guardians wait for a sign of life a little longer
_FAR = 1 << 62


class Boundary(NamedTuple):
    """An instant in the cycle: the servers, by place, that are open from it on, or start a slot."""

    offset_ns: int
    open: frozenset[int]
    starts: frozenset[int]


def boundaries_of(
    cycle_ns: int, slots: tuple[tuple[tuple[int, int], ...], ...]
) -> tuple[Boundary, ...]:
    """The boundaries of one cycle, ascending; ``slots`` has one entry per server. One stands at 0
    always: cycles of another anchor may begin there.

    >>> [(b.offset_ns, set(b.open)) for b in boundaries_of(10, (((0, 4),), ((4, 10),)))]
    [(0, {0}), (4, {1})]
    """
    offsets = {0} | {edge % cycle_ns for own in slots for slot in own for edge in slot}
    found = []
    for at in sorted(offsets):
        inside = (n for n, own in enumerate(slots) if any(a <= at < b for a, b in own))
        begun = (n for n, own in enumerate(slots) if any(a == at for a, _ in own))
        found.append(Boundary(at, frozenset(inside), frozenset(begun)))
    return tuple(found)


def instants(
    boundaries: tuple[Boundary, ...], cycle_ns: int, begin_ns: int
) -> Iterator[tuple[int, Boundary]]:
    """Every boundary with its time (ns), without end, from the cycle at ``begin_ns`` on; from the
    second on without the one at 0 where nothing changes there: no dispatcher wakes up.
    """
    first, *others = boundaries
    idle = bool(others) and first.open == others[-1].open and not first.starts
    yield begin_ns, first
    while True:
        yield from ((begin_ns + boundary.offset_ns, boundary) for boundary in others)
        begin_ns += cycle_ns
        if not idle:
            yield begin_ns, first


def moved(
    ahead: Iterator[tuple[int, Boundary]],
    anchoring: Anchoring,
    boundaries: tuple[Boundary, ...],
    cycle_ns: int,
) -> Iterator[tuple[int, Boundary]]:
    """The boundaries ``ahead`` until the new anchoring's turn comes, and its own from there on."""
    turn = min(anchoring.begin_ns, anchoring.end_ns)
    yield from takewhile(lambda item: item[0] < turn, ahead)
    del ahead  # it may itself be a stream that was moved: only the last move matters now
    if anchoring.end_ns < anchoring.begin_ns:
        yield anchoring.end_ns, Boundary(cycle_ns, frozenset(), frozenset())
    yield from instants(boundaries, cycle_ns, anchoring.begin_ns)


class Dispatcher:
    """The servers of one core at work. ``groups`` are, for each of them, its cgroups by folder:
    open files of `cgroup.freeze` and `cgroup.threads`, since a path takes longer than writing.
    """

    def __init__(self, run: FreezerRun, core: int) -> None:
        table, page = run.table, CounterPage(run.page, run.table)
        servers = tuple(server for server in table.servers if server.core == core)
        self.cycle_ns = table.cycle_ns
        self.boundaries = boundaries_of(table.cycle_ns, tuple(s.slots for s in servers))
        self.places = {server.name: number for number, server in enumerate(servers)}
        self.counters = [page.servers[server.name] for server in servers]
        self.own = page.cores[core]
        self.heard = b""
        self.groups: list[dict[str, tuple[int, int]]] = [{} for _ in servers]
        self.all = frozenset(range(len(servers)))
        self.open: frozenset[int] | None = None  # None: not armed, all are
        self.upcoming = (_FAR, self.boundaries[0])
        self.ahead: Iterator[tuple[int, Boundary]] = iter(())
        self.rest_until = 0  # no tick before
        self.begun: list[tuple[int, int]] = []  # servers, and how late, since the last tick
        self.unexamined: set[int] = set()
        self.last_tick = self.last_sign = time.monotonic_ns()
        self.let_go = self.own.let_go
        self.owner, _ = run.owner

    def run(self) -> None:
        """Until the owner or a signal ends it. Raises OperationError: the owner is gone."""
        while True:
            self._tick_until_boundary()
            at, boundary = self.upcoming
            following = next(self.ahead)
            before = self.all if self.open is None else self.open
            begun = dict.fromkeys(boundary.starts, at)
            if boundary.open and not before:
                # Waking an idle core takes longest, and delays no thread of ours now.
                sleep_until(at - _WATCH_NS)
                watch_until(at)
            else:
                sleep_until(at)
            while following[0] <= time.monotonic_ns():
                # A stall took more than a boundary: what should be open by now counts.
                (at, boundary), following = following, next(self.ahead)
                begun = {one: since for one, since in begun.items() if one in boundary.open}
                begun.update(dict.fromkeys(boundary.starts, at))
            closing = before - boundary.open
            self._write(closing, b"1")
            self._write(boundary.open - before, b"0")
            switched = time.monotonic_ns()
            self.begun += [(server, switched - since) for server, since in begun.items()]
            if self.open is not None:
                self.unexamined |= closing
            self.open, self.upcoming, self.rest_until = boundary.open, following, at + _REST_NS
            self._give_sign(switched)

    def thaw_all(self) -> None:
        self._write(self.all, b"0")
        self.open = None

    def _write(self, servers: Iterable[int], value: bytes) -> None:
        for server in sorted(servers):
            for folder, files in list(self.groups[server].items()):
                try:
                    os.pwrite(files[0], value, 0)
                except OSError as error:
                    if error.errno != errno.ENODEV:
                        raise
                    self._forget(server, folder)  # its threads have ended: the others go on

    def _tick_until_boundary(self) -> None:
        """Tick until the boundary is near. Where there is never room, after ten at the latest."""
        tick_at = time.monotonic_ns()
        if tick_at - self.last_tick > 10 * _TICK_NS:
            self._tick()
        tick_at = max(tick_at, self.rest_until)
        while tick_at + _ROOM_NS <= self.upcoming[0]:
            sleep_until(tick_at)
            self._tick()
            tick_at = self.last_tick + _TICK_NS

    def _tick(self) -> None:
        """A sign of life, and all that has waited."""
        self.last_tick = time.monotonic_ns()
        for server, late_ns in self.begun:
            counters = self.counters[server]
            counters.slots += 1
            counters.late += late_ns > _LATE_NS
            counters.longest = max(counters.longest, late_ns)
        self.begun.clear()
        self._give_sign(self.last_tick)
        if os.getppid() != self.owner:
            raise OperationError("the owner is gone")
        self._examine()
        self._obey()

    def _give_sign(self, now: int) -> None:
        """Show that we live, and close again what a guardian, or the other later, has thawed."""
        self.own.beats += 1
        let_go = self.own.let_go
        thawed = let_go != self.let_go or now - self.last_sign > _THAWED_AFTER_NS
        if self.open is not None and thawed:
            self._write(self.all - self.open, b"1")
        self.last_sign, self.let_go = now, let_go

    def _examine(self) -> None:
        """Count overruns of servers that have closed, as soon as their threads have stopped."""
        for server in list(self.unexamined):
            counters = self.counters[server]
            ran: bool | None = False
            if self.open is not None and server not in self.open:
                try:
                    ran = overrun(threads for _, threads in self.groups[server].values())
                except PermissionError:
                    counters.overruns = -1
            if ran is not None:
                self.unexamined.discard(server)
                counters.overruns += ran and counters.overruns >= 0

    def _obey(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while received := os.read(sys.stdin.fileno(), 65536):
                self.heard += received
            raise OperationError("the owner is gone")
        *lines, self.heard = self.heard.split(b"\n")
        for line in lines:
            command = json.loads(line)
            if "folder" in command:
                self._add(self.places[command["server"]], command["folder"])
            else:
                anchoring = Anchoring(command["begin_ns"], command["end_ns"])
                slots = tuple(tuple((a, b) for a, b in own) for own in command["slots"])
                self.boundaries = boundaries_of(self.cycle_ns, slots)
                ahead = chain([self.upcoming], self.ahead)
                self.ahead = moved(ahead, anchoring, self.boundaries, self.cycle_ns)
                self.upcoming = next(self.ahead)
            self.own.acknowledged = command["number"]

    def _forget(self, server: int, folder: str) -> None:
        for file in self.groups[server].pop(folder, ()):
            os.close(file)

    def _add(self, server: int, folder: str) -> None:
        self._forget(server, folder)  # of a container of that name that ended
        with contextlib.suppress(FileNotFoundError):  # another process was quick to remove it
            self.groups[server][folder] = (
                os.open(f"{folder}/cgroup.freeze", os.O_WRONLY | os.O_CLOEXEC),
                os.open(f"{folder}/cgroup.threads", os.O_RDONLY | os.O_CLOEXEC),
            )
        closed = self.open is not None and server not in self.open
        self._write([server], b"1" if closed else b"0")


def overrun(groups: Iterable[int]) -> bool | None:
    """Whether a frozen thread was computing when it was stopped, at the end of its slot: in user
    mode, which is -1 in ``/proc/TID/syscall``; one inside a system call passes for one that waits.
    None: one has not reached the freezer yet, for want of the core. ``groups`` are open
    ``cgroup.threads`` files. Raises PermissionError: not to be seen by us.
    """
    undecided = False
    for group in groups:
        tids = list[str]()
        with contextlib.suppress(OSError):  # the group is gone
            tids = os.pread(group, 32768, 0).decode().split()
        for tid in tids:
            with contextlib.suppress(
                FileNotFoundError, ProcessLookupError
            ):  # it ended while frozen
                where = read_proc(f"/proc/{tid}/syscall")
                if where.startswith(b"-1"):
                    return True
                undecided |= where.startswith(b"running")
    return None if undecided else False


def _become_real_time(core: int) -> None:
    """Highest class, if it is permitted, then the core. Raises PlatformError: no such core."""
    become_fifo(PRIORITY)  # first: where a SCHED_FIFO thread spins, SCHED_OTHER would not run again
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        raise PlatformError(
            f"core {core}, which a server of the plan asks for, is not available "
            f"({error.strerror}): name another core in the plan"
        ) from error
    lock_memory()
    stop_garbage_collection()


def main() -> None:
    path, core = Path(sys.argv[1]), int(sys.argv[2])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    for ignored in (signal.SIGINT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    os.set_blocking(sys.stdin.fileno(), False)
    journal = remembered_journal(path)
    run = run_of(journal)
    if run is None:
        sys.exit(f"{path} speaks of no servers")
    dispatcher = Dispatcher(run, core)
    set_thread_name(f"dispatcher/{core}")
    try:
        _become_real_time(core)
        dispatcher.run()
    except ChainshaperError as error:
        dispatcher.thaw_all()
        with contextlib.suppress(OSError):  # the owner may be gone, who would read it
            sys.stderr.write(shown(str(error)) + "\n")
        if isinstance(error, OperationError):
            # Guardians have learnt of it earlier. If there is none left, it is for us.
            from chainshaper.enforcement.undoing import undo_run

            undo_run(journal)
        sys.exit(error.exit_code)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        dispatcher.thaw_all()


if __name__ == "__main__":
    main()
