"""The dispatcher: a process that opens and closes the servers of one core, on that core.

    python -m chainshaper.enforcement.slot_dispatcher JOURNAL CORE

It sleeps until a boundary, freezes the cgroups of the servers that close (``cgroup.freeze``), thaws
those of the servers that open, and sleeps again. It runs on the core that it gates, above
everything there. So the timer interrupt takes the core from a thread exactly when its slot ends.

The next thread runs only when the dispatcher sleeps again. So all that can wait is done at
**ticks** between boundaries: counting, obeying the owner's commands on the standard input, and
looking for overruns.

It ends when its owner has ended, and thaws its threads before. It cannot do so after SIGKILL and
SIGSTOP, for which there are guardians. If owner and guardians are gone, it undoes the whole run.
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
_LATE_NS = 100_000  # a slot that is entered later than this counts as late
_TICK_NS = 20_000_000  # between two ticks
# No tick for so long after a boundary: threads that were frozen need the core to stop, and a gate
# may publish.
_REST_NS = 1_000_000
_ROOM_NS = 200_000  # from a tick to the next boundary, at least
_WATCH_NS = 100_000  # before a boundary the clock is watched for so long, where nobody is delayed
_THAWED_AFTER_NS = 60_000_000  # guardians thaw a little later than this after a sign of life
_FAR = 1 << 62  # an instant that never comes


class Boundary(NamedTuple):
    """An instant in the cycle at which a slot starts or ends. Servers are given by their index."""

    offset_ns: int  # after the start of the cycle
    open: frozenset[int]  # servers that are open from it on
    starts: frozenset[int]  # servers of which a slot starts there


def boundaries_of(
    cycle_ns: int, slots: tuple[tuple[tuple[int, int], ...], ...]
) -> tuple[Boundary, ...]:
    """Return the boundaries of a cycle, ascending; ``slots`` are those of each server.

    There is always a boundary at 0, since cycles may begin there that have another anchor.

    >>> [(b.offset_ns, set(b.open)) for b in boundaries_of(10, (((0, 4),), ((4, 10),)))]
    [(0, {0}), (4, {1})]
    """
    offsets = {0}
    for slots_of_server in slots:
        for start, end in slots_of_server:
            offsets |= {start % cycle_ns, end % cycle_ns}
    boundaries = []
    for at in sorted(offsets):
        is_open, starts = set[int](), set[int]()
        for server, slots_of_server in enumerate(slots):
            if any(start <= at < end for start, end in slots_of_server):
                is_open.add(server)
            if any(start == at for start, _ in slots_of_server):
                starts.add(server)
        boundaries.append(Boundary(at, frozenset(is_open), frozenset(starts)))
    return tuple(boundaries)


def instants(
    boundaries: tuple[Boundary, ...], cycle_ns: int, begin_ns: int
) -> Iterator[tuple[int, Boundary]]:
    """Yield every boundary with its instant (ns), for ever, from the cycle at ``begin_ns`` on.

    From the second cycle on, the boundary at 0 is left out if nothing changes there, so that no
    dispatcher wakes up for it.
    """
    first, *later = boundaries
    is_idle = bool(later) and first.open == later[-1].open and not first.starts
    yield begin_ns, first
    while True:
        yield from ((begin_ns + boundary.offset_ns, boundary) for boundary in later)
        begin_ns += cycle_ns
        if not is_idle:
            yield begin_ns, first


def moved(
    ahead: Iterator[tuple[int, Boundary]],
    anchoring: Anchoring,
    boundaries: tuple[Boundary, ...],
    cycle_ns: int,
) -> Iterator[tuple[int, Boundary]]:
    """Yield the boundaries ``ahead`` until another anchoring begins to hold, then those of that.

    Between the old cycles and the new ones all servers are closed.
    """
    turn = min(anchoring.begin_ns, anchoring.end_ns)
    yield from takewhile(lambda item: item[0] < turn, ahead)
    del ahead  # it may hold the streams of earlier changes, which would pile up
    if anchoring.end_ns < anchoring.begin_ns:
        yield anchoring.end_ns, Boundary(cycle_ns, frozenset(), frozenset())
    yield from instants(boundaries, cycle_ns, anchoring.begin_ns)


class Dispatcher:
    """Opens and closes the servers of a core, which are numbered here from 0.

    ``groups`` are the cgroups of each server, by folder: the open files `cgroup.freeze` and
    `cgroup.threads`. They stay open because opening them takes longer than writing.
    """

    def __init__(self, run: FreezerRun, core: int) -> None:
        table, page = run.table, CounterPage(run.page, run.table)
        servers = tuple(server for server in table.servers if server.core == core)
        self.cycle_ns = table.cycle_ns
        self.boundaries = boundaries_of(table.cycle_ns, tuple(server.slots for server in servers))
        self.numbers_by_name = {server.name: number for number, server in enumerate(servers)}
        self.counters = [page.servers[server.name] for server in servers]
        self.shared = page.cores[core]
        self.received = b""  # the beginning of a command
        self.groups: list[dict[str, tuple[int, int]]] = [{} for _ in servers]
        self.all = frozenset(range(len(servers)))
        self.open: frozenset[int] | None = None  # None: nothing is enforced yet, so all are
        self.upcoming = (_FAR, self.boundaries[0])
        self.ahead: Iterator[tuple[int, Boundary]] = iter(())  # behind the upcoming one
        self.rest_until = 0  # no tick before this instant
        self.begun: list[tuple[int, int]] = []  # servers opened since the last tick; how late (ns)
        self.unexamined: set[int] = set()  # servers closed, but not yet examined for an overrun
        self.last_tick = self.last_sign = time.monotonic_ns()
        self.let_go = self.shared.let_go
        self.owner, _ = run.owner

    def run(self) -> None:
        """Open and close servers until a signal comes. Raises OperationError: the owner is gone."""
        while True:
            self._tick_until_boundary()
            at, boundary = self.upcoming
            following = next(self.ahead)
            before = self.all if self.open is None else self.open
            begun = dict.fromkeys(boundary.starts, at)
            if boundary.open and not before:
                # An idle core takes longest to wake up, and no server is open to be delayed.
                sleep_until(at - _WATCH_NS)
                watch_until(at)
            else:
                sleep_until(at)
            while following[0] <= time.monotonic_ns():
                # The machine stalled past more than a boundary: only the last one counts.
                (at, boundary), following = following, next(self.ahead)
                begun = {
                    server: since for server, since in begun.items() if server in boundary.open
                }
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
        """Open all servers, and enforce nothing any more."""
        self._write(self.all, b"0")
        self.open = None

    def _write(self, servers: Iterable[int], value: bytes) -> None:
        """Freeze (``1``) or thaw (``0``) all cgroups of these servers."""
        for server in sorted(servers):
            for folder, files in list(self.groups[server].items()):
                try:
                    os.pwrite(files[0], value, 0)
                except OSError as error:
                    if error.errno != errno.ENODEV:
                        raise
                    self._forget(server, folder)  # it was removed, since its threads have ended

    def _tick_until_boundary(self) -> None:
        """Tick until the boundary is near."""
        tick_at = time.monotonic_ns()
        if tick_at - self.last_tick > 10 * _TICK_NS:  # boundaries leave no room for ticks
            self._tick()
        tick_at = max(tick_at, self.rest_until)
        while tick_at + _ROOM_NS <= self.upcoming[0]:
            sleep_until(tick_at)
            self._tick()
            tick_at = self.last_tick + _TICK_NS

    def _tick(self) -> None:
        """Do all that has waited: count, look for overruns, obey commands; give a sign of life."""
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
        """Show guardians that we live, and close again what one of them may have thawed."""
        self.shared.beats += 1
        let_go = self.shared.let_go
        # A guardian notes it after thawing, so the time since our last sign counts as well.
        may_be_thawed = let_go != self.let_go or now - self.last_sign > _THAWED_AFTER_NS
        if self.open is not None and may_be_thawed:
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
                if ran and counters.overruns >= 0:
                    counters.overruns += 1

    def _obey(self) -> None:
        """Obey the commands that the owner has sent. Raises OperationError: it is gone."""
        with contextlib.suppress(BlockingIOError):
            while received := os.read(sys.stdin.fileno(), 65536):
                self.received += received
            raise OperationError("the owner is gone")
        *lines, self.received = self.received.split(b"\n")
        for line in lines:
            command = json.loads(line)
            if "folder" in command:
                self._add(self.numbers_by_name[command["server"]], command["folder"])
            else:
                anchoring = Anchoring(command["begin_ns"], command["end_ns"])
                slots = tuple(
                    tuple((start, end) for start, end in slots_of_server)
                    for slots_of_server in command["slots"]
                )
                self.boundaries = boundaries_of(self.cycle_ns, slots)
                ahead = chain([self.upcoming], self.ahead)
                self.ahead = moved(ahead, anchoring, self.boundaries, self.cycle_ns)
                self.upcoming = next(self.ahead)
            self.shared.acknowledged = command["number"]

    def _forget(self, server: int, folder: str) -> None:
        """Close the files of a cgroup."""
        for file in self.groups[server].pop(folder, ()):
            os.close(file)

    def _add(self, server: int, folder: str) -> None:
        """Add a cgroup to a server, closed if the server is."""
        self._forget(server, folder)  # an earlier group of the same path, which was removed
        with contextlib.suppress(FileNotFoundError):  # it was removed meanwhile
            self.groups[server][folder] = (
                os.open(f"{folder}/cgroup.freeze", os.O_WRONLY | os.O_CLOEXEC),
                os.open(f"{folder}/cgroup.threads", os.O_RDONLY | os.O_CLOEXEC),
            )
        closed = self.open is not None and server not in self.open
        self._write([server], b"1" if closed else b"0")


def overrun(groups: Iterable[int]) -> bool | None:
    """Return whether a frozen thread was computing when its slot ended.

    It was if it stopped in user mode, for which ``/proc/TID/syscall`` has -1; a thread inside a
    system call is taken for one that waits. None: a thread has not stopped yet, since it did not
    get the core. ``groups`` are open ``cgroup.threads`` files.

    Raises PermissionError: we may not see it.
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
    """Take the highest class, if it is permitted, then the core.

    Raises PlatformError: there is no such core.
    """
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
            # Guardians have undone the run by now. If none is left, it is up to this process.
            from chainshaper.enforcement.undoing import undo_run

            undo_run(journal)
        sys.exit(error.exit_code)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        dispatcher.thaw_all()


if __name__ == "__main__":
    main()
