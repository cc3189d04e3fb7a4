"""The freezer: reservation servers for unmodified threads on a stock kernel.

Each server's threads are put into cgroups of its own, and a dispatcher on the server's core opens
and closes these by freezing them (DESIGN section 6). What a slot does not cover does not run, not
even on an idle core. A thread sees nothing of it but the time, except that ``epoll_wait``,
``recvmsg`` with a timeout, ``sigtimedwait`` and ``semtimedop`` return EINTR.

The owner (this process) starts one dispatcher per core, and the run's guardians watch over all of
them: whichever is lost, no thread stays stopped. Threads that a gated thread creates, and processes
that it forks, are born in its server, count as its members and are put back with it.
"""

import contextlib
import json
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from chainshaper.enforcement.freezer_state import (
    GROUP_PREFIX,
    FreezerRun,
    create_page,
    group_name,
    note_freezer,
    read_counters,
    restore,
    thaw,
)
from chainshaper.enforcement.scheduling_memory import release_threads
from chainshaper.enforcement.servers import ServerCounters, ServerTable
from chainshaper.enforcement.slot_dispatcher import Anchoring, first_anchoring, next_anchoring
from chainshaper.linux import cgroups
from chainshaper.linux.own_processes import end_in_words, module_command
from chainshaper.linux.runs import DISPATCHER, Journal, note_process
from chainshaper.linux.threads import has_ended, start_of
from chainshaper.values.errors import InputError, OperationError, PlatformError

# Dispatchers listen every 20 ms at the latest, every 200 ms where boundaries leave no room.
_HEARD_WITHIN_NS = 300_000_000
_ANSWER_S = 5.0
_START_S = 10.0


def create(
    table: ServerTable, journal: Journal, go_on: Callable[[], None] = lambda: None
) -> "Freezer":
    """Start the processes for a table; nothing is gated yet.

    ``journal`` remembers what was there. ``go_on`` is called again and again while something is
    waited for, and may raise. Raises OperationError: a process of ours does not start.
    PlatformError: no cgroup v2 here, or a core is missing.
    """
    cgroups.mount_point()
    return Freezer(table, journal, go_on)


class Freezer:
    """A table of servers in force by freezing; see :class:`BackEnd` for what each method does."""

    name = "freezer"

    def __init__(self, table: ServerTable, journal: Journal, go_on: Callable[[], None]) -> None:
        self.table = table
        self._journal = journal
        self._go_on = go_on
        self._cores = {server.name: server.core for server in table.servers}
        self._groups: dict[Path, str] = {}
        self._born: dict[int, int] = {}
        self._anchoring: Anchoring | None = None
        self._command = 0
        self._sent: dict[int, int] = {}
        self._released = False
        self._pipes: dict[int, int] = {}
        self._dispatchers: dict[int, subprocess.Popen[str]] = {}
        self._ends: dict[int, str] = {}
        self._page, page, self._memory = create_page(table)
        mounts = cgroups.options_before_ours()
        pid = os.getpid()
        self._run = FreezerRun((pid, start_of(pid, pid) or 0), table, page, mounts)
        try:
            note_freezer(journal, self._run)
            for core in sorted(set(self._cores.values())):
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
        if server not in self._cores:
            raise InputError(f"no server is named {server}: {', '.join(self._cores)} are")
        self._check_in_force()
        born = start_of(tid, tid)
        if born is None:
            return
        try:
            folder = self._parent_for(tid) / group_name(self._run, server)
            if folder not in self._groups:
                self._make(folder, server)
            if cgroups.move_thread(tid, folder):
                self._born[tid] = born
        except OperationError:
            if not has_ended(tid, born):
                raise

    def arm(self, anchor_ns: int) -> None:
        """See :meth:`BackEnd.arm`.

        Returns when all dispatchers have heard of it. In force from the first start of a cycle
        after that on; with another anchor, from the end of a cycle on, where the shorter of
        two ways is taken: the last cycle is cut short, or all servers wait, closed, for the
        first of the new ones (less than half a cycle either way).
        """
        self._check_in_force()
        earliest = time.monotonic_ns() + _HEARD_WITHIN_NS
        cycle = self.table.cycle_ns
        if self._anchoring is None:
            anchoring = first_anchoring(anchor_ns, cycle, earliest)
        else:
            anchoring = next_anchoring(self._anchoring, anchor_ns, cycle, earliest)
        for core in self._pipes:
            self._send(core, begin_ns=anchoring.begin_ns, end_ns=anchoring.end_ns)
        self._anchoring = anchoring
        self._await_answers()

    def in_force_from(self) -> int | None:
        return None if self._anchoring is None else self._anchoring.begin_ns

    def members(self) -> dict[str, tuple[int, ...]]:
        """The living threads of every server, those that were born there included."""
        found: dict[str, tuple[int, ...]] = dict.fromkeys(self._cores, ())
        for folder, server in self._groups.items():
            found[server] += cgroups.threads_in(folder)
        return found

    def counters(self) -> dict[str, ServerCounters]:
        """See :meth:`BackEnd.counters`; up to 20 ms old."""
        return read_counters(self._page)

    @property
    def dispatchers(self) -> dict[int, int]:
        """The process id of each core's dispatcher."""
        return {core: process.pid for core, process in self._dispatchers.items()}

    def real_time(self) -> bool:
        """Whether the dispatchers may be SCHED_FIFO; if not, slots open and close late."""
        return all(own.real_time for own in self._page.cores.values())

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
            release_threads(self._journal)
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
                code = process.poll()
                if code is not None:
                    kind = PlatformError if code == PlatformError.exit_code else OperationError
                    raise kind(self._end_of_dispatcher(core))
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} did not start within {_START_S:g} s: is a "
                        "real-time process keeping that core from everybody?"
                    )
                time.sleep(0.002)

    def _dispatcher_failure(self) -> str | None:
        for core, process in self._dispatchers.items():
            if core not in self._ends and process.poll() is not None:
                self._ends[core] = self._end_of_dispatcher(core)
        return next(iter(self._ends.values()), None)

    def _end_of_dispatcher(self, core: int) -> str:
        """Why a dispatcher has ended: what it said, or what was done to it."""
        if self._page.cores[core].silent:
            return f"the dispatcher of core {core} hung, or was stopped"
        process = self._dispatchers[core]
        stream = process.stderr
        said = stream.read().strip() if stream is not None and not stream.closed else ""
        ended = f"the dispatcher of core {core} {end_in_words(process.returncode)}"
        return f"{ended}: {'; '.join(said.splitlines())}" if said else ended

    def _lost(self) -> str | None:
        for server in self.table.servers:
            if self._page.servers[server.name].lost:
                return (
                    f"a cgroup of server {server.name} was removed: the threads that were "
                    "in it run freely; release, and apply again"
                )
        inside = {tid for tids in self.members().values() for tid in tids}
        for tid, born in list(self._born.items()):
            if tid in inside:
                continue
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

    def _parent_for(self, tid: int) -> Path:
        folder = cgroups.cgroup_of(tid)
        if folder in self._groups:
            return folder.parent
        if folder.name.startswith(GROUP_PREFIX):
            raise OperationError(
                f"thread {tid} is in the cgroup {folder} of another run: end that run first "
                "(`chainshaper release`)"
            )
        return folder

    def _make(self, folder: Path, server: str) -> None:
        cgroups.make_threaded_child(folder.parent, folder.name)
        self._groups[folder] = server
        self._send(self._cores[server], server=server, folder=str(folder))
        if self._anchoring is not None:
            self._await_answers()

    def _send(self, core: int, **fields: str | int) -> None:
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
                time.sleep(0.002)

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
