"""A guardian: a process that outlives the owner of a run, and undoes what it leaves behind.

    python -m chainshaper.enforcement.guardian FOLDER

Every run has two guardians, in case one is killed or stopped at the same instant as the owner or a
dispatcher. They learn from a pidfd at once that a process has ended, and from its signs of life
that a dispatcher hangs; then they undo all that the journal names. Each has a session and a cgroup
of its own, and a priority above the dispatchers' where it shares a core with one. On its standard
output it says when it watches.

A dispatcher that gives no sign of life for a tenth of a second may hang, or the host may have taken
its core for a moment: its threads are let go. After half a second it has failed. Guardians count
their looks instead of the time, so that a stall of the whole machine is not taken for a failure.
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
from chainshaper.linux.child_processes import start_module, what_happened
from chainshaper.linux.scheduling import become_fifo, set_thread_name
from chainshaper.linux.threads import open_process
from chainshaper.values.errors import OperationError

GROUP = "chainshaper.guardians"
_GUARDIANS = 2
_PRIORITY = 98
_ELSEWHERE_PRIORITY = 88
"""On cores without a dispatcher: above all servers, below DDS, whose outputs looks would delay."""
_LOOK_S = 0.02  # between two looks at the dispatchers
_LOOKS_UNTIL_THAWED = 4
_LOOKS_UNTIL_HUNG = 24
_IDLE_S = 1.0  # between two looks where no dispatcher is known, since a look delays other threads
_LOOKS_AT_ONCE = 5  # looks at the dispatchers for each look at the journal
_START_S = 20.0  # how long a guardian may take to start


class Guardians:
    """The guardians of a run, which are started when this is made."""

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self.processes: list[subprocess.Popen[bytes]] = []
        self.renew()

    def renew(self) -> None:
        """Replace the guardians that have ended or were stopped."""
        lost = [guardian for guardian in self.processes if what_happened(guardian) is not None]
        for guardian in lost:
            guardian.kill()
            guardian.communicate()
            self.processes.remove(guardian)
        while len(self.processes) < _GUARDIANS:
            folder = str(self.journal.path.parent)
            self.processes.append(start_module(__name__, folder, stderr=subprocess.DEVNULL))

    def await_ready(self, go_on: Callable[[], None] = lambda: None) -> None:
        """Wait until all guardians watch.

        ``go_on`` is called meanwhile, and may raise an exception. Raises OperationError: a guardian
        does not start.
        """
        pipes = [guardian.stdout for guardian in self.processes if guardian.stdout is not None]
        for pipe in pipes:
            looks = int(_START_S / _LOOK_S)
            while (
                looks and not select.select([pipe], [], [], _LOOK_S)[0]
            ):  # it writes, or has ended
                go_on()
                looks -= 1
            if not looks or not pipe.read(1):
                raise OperationError("a guardian does not start: is the machine overloaded?")

    def end(self) -> None:
        """Kill the guardians, when there is nothing left to undo."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.communicate()
        cgroups.remove_own_group(GROUP)


@contextlib.contextmanager
def run_claimed(
    cores: Collection[int], nodes: Collection[str], folder: Path | None = None
) -> Iterator[Journal]:
    """Claim a run with guardians for the context; at its end, undo all that the journal names.

    Raises OperationError: not all could be put back; and as :func:`.claim_run` and
    :meth:`Guardians.await_ready`.
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
    """Undo and end a run, as its owner.

    Raises OperationError: not all could be put back, or there are ``problems``, which are said.
    """
    left = (*problems, *undo_run(journal, by_owner=True), *strange_lines(journal))
    if guardians is not None:
        guardians.end()
    if left:
        raise OperationError(
            f"not everything could be put back: {'; '.join(left)}; {journal.path} says what was "
            "there, `chainshaper release` tries again"
        )


class _Watch:
    """Watches the owner of a run, given by a pidfd, and the run's dispatchers."""

    def __init__(self, owner: int, journal: Journal) -> None:
        self.owner, self.journal = owner, journal
        self.available = os.sched_getaffinity(0)  # cores
        self.read_until = -1  # the size of the journal when it was read last
        self.page: CounterPage | None = None
        self.cores: dict[int, int] = {}  # by the pidfd of the core's dispatcher
        self.beats: dict[int, tuple[int, int]] = {}  # by core: the last value; how often seen again
        self.poll = select.poll()
        self.poll.register(owner, select.POLLIN)

    def run(self) -> bool:
        """Watch until a process is lost (returns True), or the run is over (returns False)."""
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
        """Return whether the run has a journal still; without, it is over."""
        with contextlib.suppress(OSError):
            return self.journal.keep()
        return True  # its folder is gone and cannot be made anew, but the journal is in memory

    def look_for_dispatchers(self) -> bool:
        """Look for new dispatchers in the journal; return whether one has ended already."""
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
            except OSError:  # the owner has ended, as its pidfd will say
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
        """Watch the dispatchers known so far no more."""
        for pidfd in self.cores:
            self.poll.unregister(pidfd)
            os.close(pidfd)
        self.cores.clear()

    def hangs(self, page: CounterPage) -> bool:
        """Return whether a dispatcher hangs; let go the threads of each that may hang."""
        for core in self.cores.values():
            beat, (last_beat, looks) = page.cores[core].beats, self.beats[core]
            looks = looks + 1 if beat == last_beat else 0
            self.beats[core] = (beat, looks)
            if beat == 0:
                continue  # it still starts, and the owner waits for it
            if looks == _LOOKS_UNTIL_THAWED:
                let_go(self.journal, page, core)
            if looks >= _LOOKS_UNTIL_HUNG:
                page.cores[core].silent = 1
                return True
        return False


def let_go(journal: Journal, page: CounterPage, core: int) -> None:
    """Thaw the threads of all servers of a core, and note it for the core's dispatcher.

    If that works again by then, it closes the servers again.
    """
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
    with contextlib.suppress(OperationError):  # a full disk is no reason not to watch
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
