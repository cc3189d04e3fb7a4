"""The dispatcher: a process that opens and closes the servers of one core, on that core.

It sleeps until a boundary, writes ``1`` to the ``cgroup.freeze`` of what closes and then ``0`` to
that of what opens, and sleeps again. It runs on the core that it gates, above everything there:
the timer interrupt alone takes the core from a thread whose slot has ended, whatever the writing
costs afterwards, so a slot is left exactly. The price is that the next thread runs only when the
dispatcher sleeps again; so between waking and sleeping it does nothing that can wait. All else is
done at **ticks** between boundaries: counting, commands of the owner, the sign of life, and
looking for overruns.

A thread that is caught in user mode by the end of its slot still wanted to run: an overrun. The
kernel remembers for a frozen thread where it was, and shows it in ``/proc/TID/syscall``; -1 is
user mode. (Its state says nothing any more: freezing wakes sleepers.) A thread that is caught
inside a system call passes for one that waits.

It must never leave threads frozen: it thaws them however it ends, and ends when the owner is gone.
Only SIGKILL and SIGSTOP prevent that, which is what guardians are for. Should those be gone
together with the owner, it undoes the whole run.

    python -m chainshaper.enforcement.freezer.slot_dispatcher JOURNAL OWNER CORE COMMANDS_FD
"""

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from chainshaper.enforcement.freezer.counters import CounterPage, open_page
from chainshaper.enforcement.freezer.slot_boundaries import (
    Anchoring,
    Boundary,
    boundaries_of,
    moved,
)
from chainshaper.enforcement.freezer.state import run_of
from chainshaper.enforcement.runs.journal import remembered_journal
from chainshaper.enforcement.servers import ServerTable
from chainshaper.gate.decision import sleep_until, watch_until
from chainshaper.linux.scheduling import lock_memory, set_thread_name, stop_garbage_collection
from chainshaper.values.errors import ChainshaperError, OperationError, PlatformError
from chainshaper.values.safe_text import shown

__all__ = ["Dispatcher", "main"]

PRIORITY = 97
LATE_NS = 100_000
TICK_NS = 20_000_000
_REST_NS = 1_000_000  # after a boundary; frozen threads, too, need the core to reach the freezer
_ROOM_NS = 200_000  # at least, between a tick and the boundaries around it
_WATCH_NS = 100_000  # before a boundary, instead of sleeping
_THAWED_AFTER_NS = 60_000_000  # guardians wait for a sign of life a little longer
_FAR = 1 << 62
_NOTHING: frozenset[int] = frozenset()


class OpenGroup(NamedTuple):
    """Files of a cgroup that are held open: looking up a path takes longer than writing."""

    freeze: int
    threads: int


class Dispatcher:
    """The servers of one core at work; ``groups`` are, for each of them, its cgroups by folder."""

    def __init__(
        self, table: ServerTable, core: int, page: CounterPage, owner: int, commands: int
    ) -> None:
        servers = tuple(server for server in table.servers if server.core == core)
        self.cycle_ns = table.cycle_ns
        self.boundaries = boundaries_of(table.cycle_ns, tuple(s.slots for s in servers))
        self.places = {server.name: number for number, server in enumerate(servers)}
        self.counters = [page.servers[server.name] for server in servers]
        self.own = page.cores[core]
        self.commands = commands
        self.heard = b""
        self.groups: list[dict[str, OpenGroup]] = [{} for _ in servers]
        self.open: frozenset[int] | None = None  # None: not armed, all are
        self.upcoming = (_FAR, self.boundaries[0])
        self.ahead: Iterator[tuple[int, Boundary]] = iter(())
        self.unexamined: set[int] = set()
        self.last_tick = self.last_sign = time.monotonic_ns()
        self.let_go = self.own.let_go
        self.owner = owner

    def run(self) -> None:
        """Until the owner or a signal ends it.

        Raises:
            OperationError: the owner is gone.
        """
        while True:
            self._tick_until_boundary()
            at, boundary = self.upcoming
            following = next(self.ahead)
            closing, opening = self._changes(boundary)
            rest = min(_REST_NS, (following[0] - at) // 2)
            if opening and not closing and self.open == _NOTHING:
                # Waking an idle core takes longest, and nobody of ours runs who could be delayed.
                sleep_until(at - _WATCH_NS)
                watch_until(at)
            else:
                sleep_until(at)
            while following[0] <= time.monotonic_ns():
                # A stall took more than a boundary: what should be open by now counts.
                (at, boundary), following = following, next(self.ahead)
                closing, opening = self._changes(boundary)
            for server in closing:
                self._write(server, b"1")
            for server in opening:
                self._write(server, b"0")
            switched = time.monotonic_ns()
            if rest >= _ROOM_NS:
                sleep_until(at + rest)  # those who were let in wait for us to sleep
            self._note(boundary, closing, switched - at)
            self._give_sign(switched)
            self.upcoming = following

    def thaw_all(self) -> None:
        """Let every thread run."""
        for server in range(len(self.groups)):
            self._write(server, b"0")
        self.open = None

    def _changes(self, boundary: Boundary) -> tuple[list[int], list[int]]:
        """Servers to close and servers to open at a boundary."""
        before = frozenset(range(len(self.groups))) if self.open is None else self.open
        return sorted(before - boundary.open), sorted(boundary.open - before)

    def _note(self, boundary: Boundary, closed: list[int], lateness: int) -> None:
        """What a switch has to leave behind for later."""
        for server in boundary.starts:
            counters = self.counters[server]
            counters.slots += 1
            counters.late += lateness > LATE_NS
            counters.longest = max(counters.longest, lateness)
        if self.open is not None:
            self.unexamined.update(closed)
        self.open = boundary.open

    def _write(self, server: int, value: bytes) -> None:
        try:
            for group in self.groups[server].values():
                os.pwrite(group.freeze, value, 0)
        except OSError:
            self._drop_lost(server, value)

    def _drop_lost(self, server: int, value: bytes) -> None:
        """Somebody removed a group, which takes its threads away from us: the others go on."""
        for folder, group in list(self.groups[server].items()):
            try:
                os.pwrite(group.freeze, value, 0)
            except OSError:
                del self.groups[server][folder]
                os.close(group.freeze)
                os.close(group.threads)
                self.counters[server].lost += 1

    def _tick_until_boundary(self) -> None:
        """Tick once, and on and on until the boundary is near.

        Where boundaries are so close that there is never room, ten ticks are let go by at most.
        """
        tick_at = time.monotonic_ns()
        if tick_at - self.last_tick > 10 * TICK_NS:
            self._tick()
        while tick_at + _ROOM_NS <= self.upcoming[0]:
            sleep_until(tick_at)
            self._tick()
            tick_at = self.last_tick + TICK_NS

    def _tick(self) -> None:
        """A sign of life, and all that has waited."""
        self.last_tick = time.monotonic_ns()
        self._give_sign(self.last_tick)
        if os.getppid() != self.owner:
            raise OperationError("the owner is gone")
        self._examine()
        self._obey()

    def _give_sign(self, now: int) -> None:
        """Show that we live. What a guardian has thawed meanwhile, we close again.

        That is so after long without a sign. Of two guardians the other may thaw after we are back:
        each says so when it has done it.
        """
        self.own.beats += 1
        let_go = self.own.let_go
        thawed = let_go != self.let_go or now - self.last_sign > _THAWED_AFTER_NS
        if thawed and self.open is not None:
            for server in sorted(set(range(len(self.groups))) - self.open):
                self._write(server, b"1")
        self.last_sign, self.let_go = now, let_go

    def _examine(self) -> None:
        """Count overruns of servers that have closed, as soon as their threads have stopped."""
        for server in list(self.unexamined):
            if self.open is None or server in self.open:
                self.unexamined.discard(server)  # open again before anybody could look
                continue
            try:
                wanted_to_run = overrun(group.threads for group in self.groups[server].values())
            except PermissionError:
                self.counters[server].overruns = -1
                self.unexamined.discard(server)
                continue
            if wanted_to_run is not None:
                self.unexamined.discard(server)
            if wanted_to_run and self.counters[server].overruns >= 0:
                self.counters[server].overruns += 1

    def _obey(self) -> None:
        """Carry out the owner's commands."""
        try:
            while True:
                received = os.read(self.commands, 65536)
                if not received:
                    raise OperationError("the owner is gone")
                self.heard += received
        except BlockingIOError:
            pass
        *lines, self.heard = self.heard.split(b"\n")
        for line in lines:
            command = json.loads(line)
            if "folder" in command:
                self._add(self.places[command["server"]], command["folder"])
            else:
                self._move(Anchoring(command["begin_ns"], command["end_ns"]))
            self.own.acknowledged = command["number"]

    def _add(self, server: int, folder: str) -> None:
        try:
            self.groups[server][folder] = OpenGroup(
                os.open(f"{folder}/cgroup.freeze", os.O_WRONLY | os.O_CLOEXEC),
                os.open(f"{folder}/cgroup.threads", os.O_RDONLY | os.O_CLOEXEC),
            )
        except OSError:  # somebody was quick to remove it
            self.counters[server].lost += 1
            return
        closed = self.open is not None and server not in self.open
        self._write(server, b"1" if closed else b"0")

    def _move(self, anchoring: Anchoring) -> None:
        ahead = chain([self.upcoming], self.ahead)
        self.ahead = moved(ahead, anchoring, self.boundaries, self.cycle_ns)
        self.upcoming = next(self.ahead)


def overrun(groups: Iterable[int]) -> bool | None:
    """Whether a frozen thread was computing when it was stopped.

    ``groups`` are open ``cgroup.threads`` files. None when a thread has not reached the freezer
    yet, for want of the core.
    """
    undecided = False
    for group in groups:
        try:
            tids = os.pread(group, 32768, 0).decode().split()
        except OSError:  # the group is gone
            continue
        for tid in tids:
            try:
                file = os.open(f"/proc/{tid}/syscall", os.O_RDONLY | os.O_CLOEXEC)
                try:
                    where = os.read(file, 8)
                finally:
                    os.close(file)
            except (FileNotFoundError, ProcessLookupError):
                continue  # it ended while frozen
            if where.startswith(b"-1"):
                return True
            undecided |= where.startswith(b"running")
    return None if undecided else False


def become_real_time(core: int) -> bool:
    """Highest class first, then the core, then memory; False when the class is not permitted.

    The class goes first: on a core where a SCHED_FIFO thread spins, a process that moves there
    as SCHED_OTHER would not run again.

    Raises:
        PlatformError: the core is not available.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        permitted = True
    except PermissionError:
        permitted = False
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        raise PlatformError(
            f"core {core}, which a server of the plan asks for, is not available "
            f"({os.strerror(error.errno or 0)}): name another core in the plan"
        ) from error
    lock_memory()
    stop_garbage_collection()
    return permitted


def _end(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)


def main() -> None:
    """The process of one core, as the owner starts it."""
    path, owner, core, commands = Path(sys.argv[1]), *map(int, sys.argv[2:5])
    signal.signal(signal.SIGTERM, _end)
    for ignored in (signal.SIGINT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    os.set_blocking(commands, False)
    journal = remembered_journal(path)
    run = run_of(journal)
    if run is None:
        sys.exit(f"{path} speaks of no servers")
    dispatcher = Dispatcher(run.table, core, open_page(run.page, run.table), owner, commands)
    set_thread_name(f"dispatcher/{core}")
    try:
        dispatcher.own.real_time = become_real_time(core)
        dispatcher.run()
    except OperationError as error:
        dispatcher.thaw_all()
        with contextlib.suppress(OSError):  # the owner may be gone, who would read it
            sys.stderr.write(shown(str(error)) + "\n")
        # Guardians have learnt of it earlier. If there is none left, it is for us.
        from chainshaper.enforcement.runs.undoing import undo_run

        undo_run(journal)
        sys.exit(error.exit_code)
    except ChainshaperError as error:
        sys.stderr.write(shown(str(error)) + "\n")
        sys.exit(error.exit_code)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        dispatcher.thaw_all()


if __name__ == "__main__":
    main()
