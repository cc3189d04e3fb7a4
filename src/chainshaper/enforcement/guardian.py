"""A guardian: a process that outlives the owner of a run, and undoes what it leaves behind.

    python -m chainshaper.enforcement.guardian FOLDER

Every run has two, in case one is killed or stopped at the same instant as what they watch over.
They learn of a death from a pidfd, at once, and of a dispatcher that hangs from its sign of life;
then they undo all that the journal says. Each has a session and a cgroup of its own, and a priority
above the dispatchers' where it shares a core with one. On its standard output it says when it
watches.

A dispatcher without a sign of life for a tenth of a second may hang, or its core may have been
taken from the machine for a moment: its threads are let go. One that stays away for half a second
has failed. Looks are counted, not time: that a machine stalls as a whole is no fault.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

from chainshaper.enforcement.freezer import CounterPage, groups_of, run_of, thaw
from chainshaper.enforcement.journal import (
    DISPATCHER,
    GUARDIAN,
    JOURNAL_FILE,
    Journal,
    note_process,
    processes_of_role,
    remembered_journal,
)
from chainshaper.enforcement.undoing import claim_run, strange_lines, undo_run
from chainshaper.linux import cgroups
from chainshaper.linux.own_processes import start_module, what_happened
from chainshaper.linux.scheduling import become_fifo, set_thread_name
from chainshaper.linux.threads import open_process
from chainshaper.values.errors import OperationError

GROUP = "chainshaper.guardians"
_HOW_MANY = 2
_PRIORITY = 98
_ELSEWHERE_PRIORITY = 88
"""On cores without a dispatcher: above all servers, below DDS, whose outputs looks would delay."""
_LOOK_S = 0.02
_LOOKS_UNTIL_THAWED = 4
_LOOKS_UNTIL_HUNG = 24
_IDLE_S = 1.0  # where no dispatcher is known: looks delay others
_LOOKS_AT_ONCE = 5  # between two at the journal, which can wait
_START_S = 20.0


class Guardians:
    """The guardians of a run, as its owner has them; making them starts them."""

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self.processes: list[subprocess.Popen[bytes]] = []
        self.renew()

    def renew(self) -> None:
        """Start anew those that are lost."""
        for lost in [one for one in self.processes if what_happened(one) is not None]:
            lost.kill()
            lost.communicate()
            self.processes.remove(lost)
        while len(self.processes) < _HOW_MANY:
            folder = str(self.journal.path.parent)
            self.processes.append(start_module(__name__, folder, stderr=subprocess.DEVNULL))

    def await_ready(self, go_on: Callable[[], None] = lambda: None) -> None:
        """Until they watch; ``go_on`` may raise. Raises OperationError: one does not start."""
        for pipe in [one.stdout for one in self.processes if one.stdout is not None]:
            looks = int(_START_S / _LOOK_S)
            while looks and not select.select([pipe], [], [], _LOOK_S)[0]:  # it says so, or ends
                go_on()
                looks -= 1
            if not looks or not pipe.read(1):
                raise OperationError("a guardian does not start: is the machine overloaded?")

    def end(self) -> None:
        """Kill them, when there is nothing left to undo."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.communicate()
        cgroups.remove_own_group(GROUP)


@contextlib.contextmanager
def run_claimed(
    cores: Collection[int], nodes: Collection[str], folder: Path | None = None
) -> Iterator[Journal]:
    """A run that governs these, watched over: all in its journal is as before when it is over.
    Raises: as :func:`.claim_run` and :meth:`Guardians.await_ready`; or not all could be put back.
    """
    journal = claim_run(cores, nodes, folder)
    guardians = None
    try:
        guardians = Guardians(journal)
        guardians.await_ready()
        yield journal
    finally:
        put_back(journal, guardians)


def put_back(journal: Journal, guardians: Guardians | None, problems: Iterable[str] = ()) -> None:
    """End a run of ours. Raises OperationError: not all could be put back, or ``problems``."""
    left = (*problems, *undo_run(journal, by_owner=True), *strange_lines(journal))
    if guardians is not None:
        guardians.end()
    if left:
        raise OperationError(
            f"not everything could be put back: {'; '.join(left)}; {journal.path} says what was "
            "there, `chainshaper release` tries again"
        )


class _Watch:
    """What a guardian sees. ``owner`` is a pidfd."""

    def __init__(self, owner: int, journal: Journal) -> None:
        self.owner, self.journal = owner, journal
        self.available = os.sched_getaffinity(0)
        self.read_until = -1
        self.page: CounterPage | None = None
        self.cores: dict[int, int] = {}  # by pidfd of its dispatcher
        self.beats: dict[int, tuple[int, int]] = {}  # by core: the last one, and how often seen
        self.poll = select.poll()
        self.poll.register(owner, select.POLLIN)

    def run(self) -> bool:
        """Until something is lost, or the run is over: whether there is something to undo."""
        while self.journal_is_there():
            lost = self.look_for_dispatchers()
            for _ in range(_LOOKS_AT_ONCE):
                ended = self.poll.poll(1000 * (_LOOK_S if self.cores else _IDLE_S))
                if any(pidfd == self.owner for pidfd, _ in ended):
                    return True
                if self.page is None or self.page.released.value:
                    self.forget_dispatchers()
                    break
                if lost or ended or self.hangs(self.page):
                    self.forget_dispatchers()
                    return True
        return False

    def journal_is_there(self) -> bool:
        with contextlib.suppress(OSError):
            return self.journal.keep()
        return True  # in memory: its folder is gone, and there is no room for another

    def look_for_dispatchers(self) -> bool:
        """Learn of new ones; whether one of them has ended already."""
        if self.page is not None and self.beats.keys() >= self.page.cores.keys():
            return False  # all are known
        lost, size = False, self.journal.size()
        run = None if size == self.read_until else run_of(self.journal)
        self.read_until = size
        if run is None:
            return False
        if self.page is None:
            try:
                self.page = CounterPage(run.page, run.table)
            except OSError:  # the owner is gone, which its pidfd will say
                return False
        for dispatcher in processes_of_role(self.journal, DISPATCHER):
            if dispatcher.core is None or dispatcher.core in self.beats:
                continue
            self.beats[dispatcher.core] = (-1, 0)
            if (pidfd := open_process(dispatcher.pid, dispatcher.started)) is None:
                lost = True
            else:
                self.cores[pidfd] = dispatcher.core
                self.poll.register(pidfd, select.POLLIN)
        elsewhere = self.available - set(self.cores.values())
        os.sched_setaffinity(0, elsewhere or self.available)
        become_fifo(_ELSEWHERE_PRIORITY if elsewhere else _PRIORITY)
        return lost

    def forget_dispatchers(self) -> None:
        for pidfd in self.cores:
            self.poll.unregister(pidfd)
            os.close(pidfd)
        self.cores.clear()

    def hangs(self, page: CounterPage) -> bool:
        """Whether a dispatcher does; threads of one that may are let go."""
        for core in self.cores.values():
            beat, (last, still) = page.cores[core].beats, self.beats[core]
            still = still + 1 if beat == last else 0
            self.beats[core] = (beat, still)
            if beat == 0:
                continue  # it starts; the owner waits for it
            if still == _LOOKS_UNTIL_THAWED:
                let_go(self.journal, page, core)
            if still >= _LOOKS_UNTIL_HUNG:
                page.cores[core].silent = 1
                return True
        return False


def let_go(journal: Journal, page: CounterPage, core: int) -> None:
    """Thaw the threads of all servers of a core; a dispatcher that is back by then sees it."""
    thaw(groups_of(run_of(journal), core))
    page.cores[core].let_go = time.monotonic_ns()


def main() -> None:
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    set_thread_name("guardian")
    try:
        journal = remembered_journal(Path(sys.argv[1], JOURNAL_FILE))
    except OSError:
        return  # the run is over already
    with contextlib.suppress(OperationError):  # a full disk: it watches all the same
        note_process(journal, GUARDIAN, os.getpid())
    cgroups.enter_own_group(GROUP)
    try:
        owner = journal.open_owner()
        become_fifo(_PRIORITY)
        with contextlib.suppress(BrokenPipeError):
            os.write(1, b"!")
        watch = None if owner is None else _Watch(owner, journal)
        while watch is None or watch.run():
            undo_run(journal)
            if journal.owner is None:
                break
    finally:
        cgroups.leave_own_group(GROUP)


if __name__ == "__main__":
    main()
