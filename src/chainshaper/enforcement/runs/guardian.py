"""A guardian: a process that outlives the owner of a run, and undoes what it leaves behind.

    python -m chainshaper.enforcement.runs.guardian OWNER FOLDER READY_FD

A dispatcher that is killed leaves its threads frozen, and an owner that is killed leaves an
application under real-time priorities, or in slots, for ever. So every run has guardians, whatever
its back end. They learn of a death from a pidfd, at once, and of a dispatcher that hangs from the
sign of life that stands still. Whoever is lost, a guardian undoes all that the journal says.

There are two of them, which do the same: each is there should the other be killed or stopped at
the same instant as what they watch over. The owner starts anew the one that it has lost. They are
out of reach of what befalls the application or the owner: each has a session of its own, a cgroup
that is neither's, and a priority above the dispatchers'.

A dispatcher that gives no sign of life for a tenth of a second may hang, or its core may have been
taken from the machine for a moment. So its threads are let go first, and questions asked later: one
that comes back closes what has to be closed, at the price of a cycle or less in which a server's
threads ran freely; one that stays away for half a second has failed. The sign of life must stand
still over several looks, rather than for some time: that a machine stalls as a whole is no fault.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.enforcement.freezer.counters import CounterPage, open_page
from chainshaper.enforcement.freezer.state import groups_of, run_of, thaw
from chainshaper.enforcement.runs.claims import claim_run
from chainshaper.enforcement.runs.journal import FILE, Journal, remembered_journal
from chainshaper.enforcement.runs.processes import (
    DISPATCHER,
    GUARDIAN,
    note_process,
    open_process,
    own_processes,
)
from chainshaper.enforcement.runs.undoing import undo_run
from chainshaper.linux import cgroups
from chainshaper.linux.own_processes import module_command, what_happened
from chainshaper.linux.scheduling import set_thread_name
from chainshaper.values.errors import OperationError

__all__ = ["Guardians", "let_go", "run_claimed", "start_guardians"]

HOW_MANY = 2
PRIORITY = 98
LOOK_S = 0.02
LOOKS_UNTIL_THAWED = 4
LOOKS_UNTIL_HUNG = 24
GROUP = "chainshaper.guardians"
_IDLE_S = 0.1
_LOOKS_AT_ONCE = 5
"""Between two at the journal: nothing that can wait is to keep a core from those in their slots."""
_START_S = 20.0


@dataclass
class Guardians:
    """The guardians of a run, as its owner has them."""

    journal: Journal
    processes: list["subprocess.Popen[bytes]"] = field(default_factory=list)
    ready: dict[int, int] = field(default_factory=dict)
    """By process: the pipe by which it says that it watches."""

    def start_one(self) -> None:
        """Start one, without waiting for it."""
        reading, writing = os.pipe()
        folder = str(self.journal.path.parent)
        try:
            process = subprocess.Popen(
                [*module_command(__name__), str(os.getpid()), folder, str(writing)],
                pass_fds=(writing,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        finally:
            os.close(writing)
        self.processes.append(process)
        self.ready[process.pid] = reading

    def await_ready(self, go_on: Callable[[], None] = lambda: None) -> None:
        """Until they watch. ``go_on`` is called again and again meanwhile, and may raise.

        Raises:
            OperationError: one does not start.
        """
        for process in self.processes:
            reading = self.ready.pop(process.pid, None)
            if reading is None:
                continue
            try:
                for _ in range(int(_START_S / LOOK_S)):
                    go_on()
                    if select.select([reading], [], [], LOOK_S)[0]:  # it says so, or ends
                        break
                said = os.read(reading, 1) if select.select([reading], [], [], 0)[0] else b""
            finally:
                os.close(reading)
            if not said:
                raise OperationError(
                    "a process that undoes our changes should we be killed does not start: is the "
                    "machine overloaded, or are our processes being ended?"
                )

    def renew(self) -> None:
        """Replace those that were killed, or stopped."""
        for lost in [one for one in self.processes if what_happened(one) is not None]:
            lost.kill()
            lost.wait()
            self.processes.remove(lost)
        while len(self.processes) < HOW_MANY:
            self.start_one()

    def end(self) -> None:
        """End them, when nothing is left to undo."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()
        for reading in self.ready.values():
            os.close(reading)
        self.ready.clear()
        cgroups.remove_own_group(GROUP)


@contextlib.contextmanager
def run_claimed(
    cores: Collection[int], nodes: Collection[str], folder: Path | None = None
) -> Iterator[Journal]:
    """A run that governs these, watched over: all in its journal is as before when it is over.

    Raises:
        OperationError, PlatformError: see :func:`.claim_run` and :meth:`Guardians.await_ready`; or
            not all could be put back.
    """
    journal = claim_run(cores, nodes, folder)
    guardians = None
    try:
        guardians = start_guardians(journal)
        guardians.await_ready()
        yield journal
    finally:
        left = undo_run(journal, by_owner=True)
        if guardians is not None:
            guardians.end()
        if left:
            raise OperationError(
                f"not everything could be put back: {'; '.join(left)}; {journal.path} says what "
                "was there, `chainshaper release` tries again"
            )


def start_guardians(journal: Journal) -> Guardians:
    """Have processes watch over the caller's run; see :meth:`Guardians.await_ready`."""
    guardians = Guardians(journal)
    for _ in range(HOW_MANY):
        guardians.start_one()
    return guardians


class _Watch:
    """What a guardian sees. ``owner`` is a pidfd."""

    def __init__(self, owner: int, journal: Journal) -> None:
        self.owner, self.journal = owner, journal
        self.available = os.sched_getaffinity(0)
        self.read_until = -1
        self.page: CounterPage | None = None
        self.cores: dict[int, int] = {}  # by pidfd of its dispatcher
        self.seen: dict[int, int] = {}
        self.still: dict[int, int] = {}
        self.poll = select.poll()
        self.poll.register(owner, select.POLLIN)

    def run(self) -> bool:
        """Until something is lost, or the run is over: whether there is something to undo."""
        while self.keep_journal():
            lost = self.look_for_dispatchers()
            for _ in range(_LOOKS_AT_ONCE):
                ended = self.poll.poll(1000 * (LOOK_S if self.cores else _IDLE_S))
                if any(pidfd == self.owner for pidfd, _ in ended):
                    return True
                if self.page is None or self.page.released.value:
                    self.forget_dispatchers()
                    break
                if lost or ended or self.hangs(self.page):
                    self.forget_dispatchers()
                    return True
        return False

    def keep_journal(self) -> bool:
        """Whether the run goes on."""
        try:
            return self.journal.keep()
        except OSError:  # its folder is gone, and there is no room for another: it is in memory
            return True

    def look_for_dispatchers(self) -> bool:
        """Learn of new ones; whether one of them has ended already."""
        lost, size = False, self.journal.size()
        if size == self.read_until:
            return False
        self.read_until = size
        run = run_of(self.journal)
        if run is None:
            return False
        if self.page is None:
            try:
                self.page = open_page(run.page, run.table)
            except OSError:  # the owner is gone, which its pidfd will say
                return False
        for one in own_processes(self.journal, DISPATCHER):
            if one.core is None or one.core in self.seen:
                continue
            self.seen[one.core], self.still[one.core] = -1, 0
            pidfd = open_process(one.pid, one.started)
            if pidfd is None:
                lost = True
                continue
            self.cores[pidfd] = one.core
            self.poll.register(pidfd, select.POLLIN)
        if elsewhere := self.available - set(self.cores.values()):
            os.sched_setaffinity(0, elsewhere)
        return lost

    def forget_dispatchers(self) -> None:
        """They have ended, or are about to."""
        for pidfd in self.cores:
            self.poll.unregister(pidfd)
            os.close(pidfd)
        self.cores.clear()

    def hangs(self, page: CounterPage) -> bool:
        """Whether a dispatcher does; threads of one that may are let go."""
        for core in self.cores.values():
            beats = page.cores[core].beats
            self.still[core] = self.still[core] + 1 if beats == self.seen[core] else 0
            self.seen[core] = beats
            if beats == 0:
                continue  # it starts; the owner waits for it
            if self.still[core] == LOOKS_UNTIL_THAWED:
                let_go(self.journal, page, core)
            if self.still[core] >= LOOKS_UNTIL_HUNG:
                page.cores[core].silent = 1
                return True
        return False


def let_go(journal: Journal, page: CounterPage, core: int) -> None:
    """Thaw the threads of all servers of a core; they stay in their groups.

    The dispatcher may be back by then, and have closed them: it has to know.
    """
    thaw(groups_of(run_of(journal), core))
    page.cores[core].let_go = time.monotonic_ns()


def main() -> None:
    """Wait, and undo if need be."""
    owner_pid, folder, ready = int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    set_thread_name("guardian")
    try:
        journal = remembered_journal(folder / FILE)
    except OSError:
        return  # the run is over already
    with contextlib.suppress(OperationError):  # a full disk: it watches all the same
        note_process(journal, GUARDIAN, os.getpid())
    cgroups.enter_own_group(GROUP)
    try:
        owner = os.pidfd_open(owner_pid)
        if os.getppid() != owner_pid:
            raise ProcessLookupError(owner_pid)
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        with contextlib.suppress(BrokenPipeError):
            os.write(ready, b"!")
        os.close(ready)
        watch = _Watch(owner, journal)
        while watch.run():
            undo_run(journal)
            if journal.owner is None:
                break
    except ProcessLookupError:
        undo_run(journal)
    finally:
        cgroups.leave_own_group(GROUP)


if __name__ == "__main__":
    main()
