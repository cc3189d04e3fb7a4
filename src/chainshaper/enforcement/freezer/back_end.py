"""The freezer: reservation servers for unmodified threads on a stock kernel.

Each server's threads are put into cgroups of its own, and a dispatcher on the server's core opens
and closes these by freezing them (DESIGN section 6). What a slot does not cover does not run, not
even on an idle core. Nothing happens between slots to a thread that anybody could see but the
time: futexes, condition variables, sleeps and polls go on as if the thread had been pre-empted.
Only ``epoll_wait``, ``recvmsg`` with a timeout, ``sigtimedwait`` and ``semtimedop`` return EINTR.

Processes of ours, and who puts things back when one of them is lost:

    owner (this process)  ── starts ──►  supervisor  ── starts ──►  one dispatcher per core

    dispatcher lost, hung or stopped     the supervisor
    owner lost                           the supervisor
    supervisor lost, hung or stopped     the dispatchers thaw, the owner restores
    all of them killed at once           :func:`chainshaper.enforcement.freezer.state.clean_up`

Threads that a gated thread creates, and processes that it forks, are born in its server and stay
there: they count as its members and are put back with it.
"""

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import IO

from chainshaper.enforcement.freezer import cgroups
from chainshaper.enforcement.freezer.counters import create_page, read_counters
from chainshaper.enforcement.freezer.slot_boundaries import (
    Anchoring,
    first_anchoring,
    next_anchoring,
)
from chainshaper.enforcement.freezer.state import (
    COUNTERS,
    FreezerState,
    Group,
    load_state,
    lock_run_directory,
    log_text,
    remove_state,
    restore,
    save_state,
    start_log,
)
from chainshaper.enforcement.own_processes import end_in_words, module_command
from chainshaper.enforcement.servers import ServerCounters, ServerTable
from chainshaper.enforcement.threads.listing import has_ended, start_of
from chainshaper.errors import InputError, OperationError, PlatformError

__all__ = ["Freezer", "create"]

GROUP_PREFIX = "chainshaper-"
# Dispatchers listen every 20 ms at the latest, every 200 ms where boundaries leave no room.
_HEARD_WITHIN_NS = 300_000_000
_ANSWER_S = 5.0
_START_S = 15.0
_LOOK_MS = 100
_LOOKS_UNTIL_HUNG = 20


def create(table: ServerTable, run_directory: Path) -> "Freezer":
    """Start the processes for a table; nothing is gated yet.

    ``run_directory`` is made if need be. It holds the run's state, counters and log, and belongs
    to one run at a time; what a run left there that was killed altogether is restored first.

    Raises:
        OperationError: another run is in force, or a process of ours does not start.
        PlatformError: no cgroup v2 here, a core is missing, or the folder cannot be written to.
    """
    cgroups.mount_point()
    try:
        run_directory.mkdir(parents=True, exist_ok=True)
        log = lock_run_directory(run_directory)
    except OSError as error:
        raise PlatformError(
            f"the run directory {run_directory} cannot be used ({os.strerror(error.errno or 0)}): "
            "name one that you may write to"
        ) from error
    try:
        stale = load_state(run_directory)
        if left := restore(stale):
            raise OperationError("; ".join(left))
        start_log(log)
        return Freezer(table, run_directory, log)
    except BaseException:
        log.close()
        raise


class Freezer:
    """A table of servers in force by freezing; see :class:`BackEnd` for what each method does."""

    name = "freezer"

    def __init__(self, table: ServerTable, run_directory: Path, log: IO[str]) -> None:
        self.table = table
        self.run_directory = run_directory
        self._log = log
        self._cores = {server.name: server.core for server in table.servers}
        mounts = None if cgroups.moves_are_quick() else cgroups.mount_options()
        self._state = FreezerState(os.getpid(), table, mounts)
        self._born: dict[int, int] = {}
        self._anchoring: Anchoring | None = None
        self._failure: str | None = None
        self._command = 0
        self._lock = threading.RLock()
        self._ending = self._released = False
        self._page, self._memory = create_page(run_directory / COUNTERS, table)
        save_state(run_directory, self._state)
        self._pipes: dict[int, int] = {}
        self._pidfds: list[int] = []
        self._supervisor = self._start_supervisor()
        try:
            self._wait_until_running()  # from here on somebody is there to put things back
            if mounts is not None:
                cgroups.remount(f"{mounts},{cgroups.QUICK_MOVES}")
            self._hold_dispatchers()
        except BaseException:
            self._supervisor.kill()  # the dispatchers notice, and have nothing to thaw
            self._supervisor.wait()
            self._close(self._restore())
            raise
        self._watcher = threading.Thread(target=self._watch, name="freezer-watch", daemon=True)
        self._watcher.start()

    def assign(self, tid: int, server: str) -> None:
        """See :meth:`BackEnd.assign`. While armed, a thread whose server is closed stops at once.

        Raises:
            InputError: there is no such server.
            OperationError: there is no such thread, it belongs to another run, or the servers
                are no longer in force.
            PlatformError: its cgroup or our privileges do not allow it.
        """
        if server not in self._cores:
            raise InputError(f"no server is named {server}: {', '.join(self._cores)} are")
        with self._lock:
            self._check_in_force()
            born = start_of(tid, tid)
            parent = self._parent_for(tid)
            group = Group(parent / self._folder_name(server), server)
            if group not in self._state.groups:
                self._make(group)
            if born is None or not cgroups.move_thread(tid, group.folder):
                raise OperationError(f"thread {tid} has ended before it was in server {server}")
            self._born[tid] = born

    def arm(self, anchor_ns: int) -> None:
        """See :meth:`BackEnd.arm`.

        Returns when all dispatchers have heard of it. In force from the first start of a cycle
        after that on; with another anchor, from the end of a cycle on, where the shorter of
        two ways is taken: the last cycle is cut short, or all servers wait, closed, for the
        first of the new ones (less than half a cycle either way).
        """
        with self._lock:
            self._check_in_force()
            earliest = time.monotonic_ns() + _HEARD_WITHIN_NS
            cycle = self.table.cycle_ns
            if self._anchoring is None:
                anchoring = first_anchoring(anchor_ns, cycle, earliest)
            else:
                anchoring = next_anchoring(self._anchoring, anchor_ns, cycle, earliest)
            told = {
                core: self._tell(core, begin_ns=anchoring.begin_ns, end_ns=anchoring.end_ns)
                for core in self._pipes
            }
            self._anchoring = anchoring
            self._await_answers(told)

    def in_force_from(self) -> int | None:
        """When (CLOCK_MONOTONIC, ns) the cycles of the latest :meth:`arm` begin."""
        return None if self._anchoring is None else self._anchoring.begin_ns

    def members(self) -> dict[str, tuple[int, ...]]:
        """The living threads of every server, those that were born there included."""
        found: dict[str, tuple[int, ...]] = dict.fromkeys(self._cores, ())
        for group in self._state.groups:
            found[group.server] += cgroups.threads_in(group.folder)
        return found

    def counters(self) -> dict[str, ServerCounters]:
        """See :meth:`BackEnd.counters`; up to 20 ms old."""
        return read_counters(self._page)

    @property
    def supervisor(self) -> int:
        """The supervisor's process id."""
        return self._supervisor.pid

    @property
    def dispatchers(self) -> dict[int, int]:
        """The process id of each core's dispatcher."""
        return {core: self._page.cores[core].process for core in self._pipes}

    def real_time(self) -> bool:
        """Whether the dispatchers may be SCHED_FIFO; if not, slots open and close late."""
        return all(own.real_time for own in self._page.cores.values())

    def failure(self) -> str | None:
        """See :meth:`BackEnd.failure`. A lost group or thread leaves the others enforced."""
        if self._failure is not None or self._ending:
            return self._failure
        for server in self.table.servers:
            if self._page.servers[server.name].lost:
                return (
                    f"somebody removed a cgroup of server {server.name}: the threads that were "
                    "in it run freely; release, and apply again"
                )
        inside = {tid for tids in self.members().values() for tid in tids}
        for tid, born in list(self._born.items()):
            if tid in inside:
                continue
            if not has_ended(tid, born):
                self._watcher.join(1.0)  # it was the supervisor, perhaps, which ends then
                return self._failure or (
                    f"somebody moved thread {tid} out of its server's cgroup: it runs freely; "
                    "release, and apply again"
                )
            del self._born[tid]
        return None

    def release(self) -> None:
        """See :meth:`BackEnd.release`.

        Raises:
            OperationError: something could not be put back; the rest is.
        """
        with self._lock:
            if self._released:
                return
            self._ending = True
            self._supervisor.terminate()
            try:
                self._supervisor.wait(timeout=3)
            except subprocess.TimeoutExpired:
                self._supervisor.kill()
                self._supervisor.wait()
            left = self._restore()
            self._released = True
            self._close(left)
        self._watcher.join()
        if left:
            raise OperationError("; ".join(left))

    def _start_supervisor(self) -> subprocess.Popen[bytes]:
        arguments, ends = [], []
        for core in sorted(set(self._cores.values())):
            reading, self._pipes[core] = os.pipe()
            arguments.append(f"{core}={reading}")
            ends.append(reading)
        try:
            return subprocess.Popen(
                [
                    *module_command("chainshaper.enforcement.freezer.supervisor"),
                    str(self.run_directory.absolute()),
                    str(os.getpid()),
                    *arguments,
                ],
                pass_fds=ends,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                start_new_session=True,
            )
        finally:
            for end in ends:
                os.close(end)

    def _wait_until_running(self) -> None:
        deadline = time.monotonic() + _START_S
        while self._page.supervisor.value == 0:
            if self._supervisor.poll() is not None:
                raise self._end_at_start()
            if time.monotonic() > deadline:
                raise OperationError(
                    f"the servers' processes did not start within {_START_S:g} s: is the machine "
                    "overloaded?"
                )
            time.sleep(0.002)

    def _hold_dispatchers(self) -> None:
        """A pidfd of each: should they have to be ended, nobody is who has got their number."""
        for pid in self.dispatchers.values():
            try:
                self._pidfds.append(os.pidfd_open(pid))
            except ProcessLookupError:
                raise self._end_at_start() from None

    def _end_at_start(self) -> OperationError | PlatformError:
        """Why the supervisor has ended, or is about to, because a dispatcher has."""
        try:
            code = self._supervisor.wait(_ANSWER_S)
        except subprocess.TimeoutExpired:
            return OperationError("a dispatcher has ended at its start, and its supervisor hangs")
        kind = PlatformError if code == PlatformError.exit_code else OperationError
        return kind(self._why_it_ended(code))

    def _why_it_ended(self, code: int, hung: str = "") -> str:
        """What the supervisor and its dispatchers have said, and what they could not say."""
        said = log_text(self.run_directory).splitlines()
        if code < 0 or not said:
            said.insert(0, f"the supervisor {end_in_words(code)}{hung}")
        return "; ".join(said)

    def _check_in_force(self) -> None:
        if self._ending or self._failure is not None:
            raise OperationError(
                f"the servers are no longer in force: {self._failure or 'they were released'}"
            )

    def _parent_for(self, tid: int) -> Path:
        """The group beneath which the thread's own is, or is to be, made."""
        folder = cgroups.cgroup_of(tid)
        if any(group.folder == folder for group in self._state.groups):
            return folder.parent
        if folder.name.startswith(GROUP_PREFIX):
            raise OperationError(
                f"thread {tid} is in the cgroup {folder} of another run: end that run first "
                "(`chainshaper release`)"
            )
        return folder

    def _folder_name(self, server: str) -> str:
        number = list(self._cores).index(server)
        readable = re.sub(r"[^A-Za-z0-9_.-]+", "_", server)[:64]
        return f"{GROUP_PREFIX}{os.getpid()}-{number}-{readable}"

    def _make(self, group: Group) -> None:
        """A new group: written down first, then made, then known to its dispatcher."""
        before = self._state
        self._state = replace(before, groups=(*before.groups, group))
        save_state(self.run_directory, self._state)
        try:
            cgroups.make_threaded_child(group.folder.parent, group.folder.name)
        except (OperationError, PlatformError):
            self._state = before
            save_state(self.run_directory, before)
            raise
        core = self._cores[group.server]
        told = self._tell(core, server=group.server, folder=str(group.folder))
        self._await_answers({core: told})

    def _tell(self, core: int, **fields: str | int) -> int:
        """Send a dispatcher a command; returns the number under which it will be acknowledged."""
        self._command += 1
        line = json.dumps({"number": self._command, **fields}) + "\n"
        with contextlib.suppress(BrokenPipeError):  # the watch will say what has become of it
            os.write(self._pipes[core], line.encode())
        return self._command

    def _await_answers(self, told: dict[int, int]) -> None:
        deadline = time.monotonic() + _ANSWER_S
        for core, number in told.items():
            while self._page.cores[core].acknowledged < number:
                self._check_in_force()
                if time.monotonic() > deadline:
                    raise OperationError(
                        f"the dispatcher of core {core} has not answered for {_ANSWER_S:g} s"
                    )
                time.sleep(0.002)

    def _watch(self) -> None:
        """A thread of the owner: the supervisor restores what others break; who restores its?"""
        pidfd = os.pidfd_open(self._supervisor.pid)
        poll = select.poll()
        poll.register(pidfd, select.POLLIN)
        seen, still = -1, 0
        while not poll.poll(_LOOK_MS):
            beats = self._page.supervisor.value
            still = still + 1 if beats == seen else 0
            seen = beats
            if still >= _LOOKS_UNTIL_HUNG:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        os.close(pidfd)
        if self._ending:
            return
        code = self._supervisor.wait()
        hung = " (it hung, or was stopped)" if still >= _LOOKS_UNTIL_HUNG else ""
        self._failure = self._why_it_ended(code, hung)
        with self._lock:
            if not self._released:
                self._restore()

    def _restore(self) -> tuple[str, ...]:
        left = restore(self._state)
        for dispatcher in self._pidfds:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(dispatcher, signal.SIGKILL)
        return left

    def _close(self, left: tuple[str, ...]) -> None:
        """Let go of the run directory; what could not be restored stays written down in it."""
        for file in [*self._pipes.values(), *self._pidfds, self._memory]:
            os.close(file)
        if not left:
            remove_state(self.run_directory)
        self._log.close()
