"""Back end `scx`: the table of servers inside the kernel, as a sched_ext policy.

The policy (`policy/table.bpf.c`, which explains how it works) is compiled ahead. While it is
in force, *every* thread of the machine's fair class is scheduled by it: those assigned to servers
inside their slots, all others first come first served behind them. Real-time threads stand above
it, as they do above the fair class, so a thread that shall be governed must not be one.

Nothing has to be put back by hand. The policy hangs on a file descriptor of this process, and
however it ends, the kernel returns to its fair class. (A fork without exec inherits the
descriptor, and keeps the policy for as long as it lives.)
"""

import os
import subprocess
import threading
import time

from chainshaper.enforcement.scx.kicker import start_kicker
from chainshaper.enforcement.scx.libbpf import delete_element, look_up_element, update_element
from chainshaper.enforcement.scx.loading import (
    LoadedPolicy,
    attach_policy,
    load_policy,
    put_in_force,
    thread_descriptor,
    write_table,
)
from chainshaper.enforcement.scx.requirements import is_realtime_kernel, missing
from chainshaper.enforcement.scx.table import (
    COUNTERS,
    EXIT,
    check_table,
    number_servers,
    unpack_counters,
    unpack_exit,
)
from chainshaper.enforcement.servers import ServerCounters, ServerTable
from chainshaper.linux.own_processes import what_happened
from chainshaper.linux.scheduling import check_cores
from chainshaper.linux.threads import POLICIES, RESET_ON_FORK
from chainshaper.values.errors import InputError, OperationError, PlatformError

__all__ = ["ScxServers", "create", "missing"]

WATCH_S = 0.02

_FAIR_POLICIES = (os.SCHED_OTHER, os.SCHED_BATCH, os.SCHED_IDLE, 7)


def create(table: ServerTable) -> "ScxServers":
    """Servers for this table, not in force yet: nothing is loaded before :meth:`ScxServers.arm`.

    Raises:
        InputError: the table is wrong or too large for the policy.
        PlatformError: this machine has no such core, or lacks what :func:`missing` names.
    """
    _check(table)
    reason = missing()
    if reason is not None:
        raise PlatformError(f"back end scx: {reason}")
    return ScxServers(table)


class ScxServers:
    """A table of servers in the kernel; see :class:`chainshaper.enforcement.servers.BackEnd`.

    ``in_force_since_ns`` is the instant from which the present table has governed all cores.
    """

    name = "scx"

    def __init__(self, table: ServerTable) -> None:
        self.in_force_since_ns = 0
        self._table = table
        self._ids = number_servers(table, {})
        self._members: dict[int, tuple[int, int]] = {}  # tid -> (thread descriptor, server id)
        self._policy: LoadedPolicy | None = None
        self._link = 0
        self._kickers: dict[int, subprocess.Popen[bytes]] = {}
        self._generation = 0
        self._failure: str | None = None
        self._released = threading.Event()
        self._last_counters: dict[str, ServerCounters] = {}
        self._lock = threading.RLock()

    def assign(self, tid: int, server: str) -> None:
        """Put a thread into a server; before :meth:`arm` it goes on running freely.

        Raises:
            InputError: the table has no such server.
            OperationError: the thread is real-time, or may not run on the core.
        """
        core = next((s.core for s in self._table.servers if s.name == server), None)
        if core is None:
            raise InputError(f"server {server} does not stand in the table")
        with self._lock:
            self._check_in_use()
            descriptor = _examine_thread(tid, server, core)
            if descriptor is None:
                return
            known = self._members.pop(tid, None)
            if known is not None:
                os.close(known[0])
            self._members[tid] = (descriptor, self._ids[server])
            if self._policy is not None:
                self._hand_over(self._policy, tid)
                self._policy.decide()

    def arm(self, anchor_ns: int) -> None:
        """Enforce the slots; cycles start at ``anchor_ns`` + k * CT, for every whole k.

        Returns when they are in force. Once more with another anchor, all cores change over at
        one instant.

        Raises:
            OperationError: the kernel refuses the policy, or it has ended (:meth:`failure`).
        """
        self.change(self._table, anchor_ns)

    def in_force_from(self) -> int | None:
        """See :meth:`BackEnd.in_force_from`."""
        return self.in_force_since_ns or None

    def change(self, table: ServerTable, anchor_ns: int) -> None:
        """Put another table in force, on all cores at one instant.

        Threads stay in the server of the same name; those of a server that is no longer there run
        as best effort until they are assigned anew.

        Raises:
            InputError: as for :func:`create`.
            PlatformError: as for :func:`create`.
            OperationError: as for :meth:`arm`.
        """
        _check(table)
        with self._lock:
            self._check_in_use()
            self._ids = number_servers(table, self._ids)
            cores = sorted({s.core for s in (*self._table.servers, *table.servers)})
            policy = self._policy or self._begin(cores)
            self._start_kickers(policy, cores)
            self._generation = 1 - self._generation
            write_table(policy, table, self._ids, self._generation, anchor_ns)
            instant = put_in_force(
                policy, self._generation, cores, replaces=self.in_force_since_ns > 0
            )
            while (left := instant - time.monotonic_ns()) > 0:
                time.sleep(left / 1e9)
            self._table, self.in_force_since_ns = table, instant
            self._forget_removed(policy)

    def counters(self) -> dict[str, ServerCounters]:
        """Per server's name, since the first :meth:`arm`; after :meth:`release`, the last ones.

        A slot counts as opened with the core's first decision inside it, and as late if that was
        more than 100 us after the start: because a real-time thread had the core, say.
        """
        with self._lock:
            if self._policy is not None:
                for name, number in self._ids.items():
                    value = look_up_element(self._policy.counters, number, COUNTERS.size)
                    self._last_counters[name] = unpack_counters(value)
            none = ServerCounters(0, 0, 0, 0)
            return {s.name: self._last_counters.get(s.name, none) for s in self._table.servers}

    def failure(self) -> str | None:
        """Why the servers are no longer enforced, None while they are (or were released)."""
        with self._lock:
            if self._failure is None and self._policy is not None:
                ended = unpack_exit(look_up_element(self._policy.ended, 0, EXIT.size))
                if ended.kind:
                    detail = f": {ended.message}" if ended.message else ""
                    self._failure = (
                        f"the kernel has ended the scheduling policy ({ended.reason}{detail}); "
                        "all threads run freely"
                    )
            return self._failure

    def release(self) -> None:
        """Give the machine back to the fair class; harmless when repeated."""
        self._released.set()
        with self._lock:
            self._end()
            for descriptor, _ in self._members.values():
                os.close(descriptor)
            self._members.clear()

    def _check_in_use(self) -> None:
        if self._released.is_set():
            raise OperationError("these servers were released; create them anew")
        failure = self.failure()
        if failure is not None:
            raise OperationError(f"{failure}; release these servers and create them anew")

    def _begin(self, cores: list[int]) -> LoadedPolicy:
        """The policy with an empty table in force: for now, everything runs as best effort."""
        policy = load_policy(has_timer=not is_realtime_kernel())
        try:
            for tid in tuple(self._members):
                self._hand_over(policy, tid)
            self._start_kickers(policy, cores)
            self._link = attach_policy(policy)
        except OperationError:
            self._stop_kickers()
            policy.bpf.close()
            raise
        self._policy = policy
        if not policy.has_timer:
            threading.Thread(target=self._watch, name="scx watch", daemon=True).start()
        return policy

    def _hand_over(self, policy: LoadedPolicy, tid: int) -> None:
        """Tell the policy the server of a thread; one that has ended is forgotten."""
        descriptor, number = self._members[tid]
        try:
            update_element(policy.assignments, descriptor, number.to_bytes(4, "little"))
        except (ProcessLookupError, FileNotFoundError):
            os.close(descriptor)
            del self._members[tid]
        except OSError as error:
            raise OperationError(
                f"the kernel refuses to put thread {tid} into a server: {error.strerror}"
            ) from error

    def _forget_removed(self, policy: LoadedPolicy) -> None:
        """Threads whose server no longer stands in the table are best effort from here on."""
        present = {self._ids[server.name] for server in self._table.servers}
        for tid, (descriptor, number) in tuple(self._members.items()):
            if number not in present:
                delete_element(policy.assignments, descriptor)
                os.close(descriptor)
                del self._members[tid]

    def _start_kickers(self, policy: LoadedPolicy, cores: list[int]) -> None:
        if policy.has_timer:
            return
        for core in cores:
            if core not in self._kickers:
                self._kickers[core] = start_kicker(core, policy.boundary)

    def _watch(self) -> None:
        """Fail open when a kicker stops: an idle core would never notice by itself."""
        while not self._released.wait(WATCH_S):
            with self._lock:
                if self.failure() is None:
                    self._failure = self._kicker_failure()
                if self._failure is not None:
                    self._end()
                    return

    def _kicker_failure(self) -> str | None:
        for core, kicker in self._kickers.items():
            what = what_happened(kicker)
            if what is not None:
                return (
                    f"the kicker of core {core} (process {kicker.pid}) {what}, so its slots "
                    "cannot be kept; the policy was taken away and all threads run freely"
                )
        return None

    def _end(self) -> None:
        """Take the policy away, keeping what it has counted and why it ended."""
        policy = self._policy
        if policy is None:
            return
        self.counters()
        self.failure()
        policy.bpf.detach(self._link)
        self._stop_kickers()
        policy.bpf.close()
        self._policy = None

    def _stop_kickers(self) -> None:
        for kicker in self._kickers.values():
            kicker.kill()
            kicker.communicate()
        self._kickers.clear()


def _check(table: ServerTable) -> None:
    check_table(table)
    check_cores({server.core: f"server {server.name}" for server in table.servers})


def _examine_thread(tid: int, server: str, core: int) -> int | None:
    """A descriptor of a thread that the policy can govern on this core; None when it has ended."""
    try:
        descriptor = thread_descriptor(tid)
        policy = os.sched_getscheduler(tid) & ~RESET_ON_FORK
        cores = os.sched_getaffinity(tid)
    except ProcessLookupError:
        return None
    except OSError as error:
        raise OperationError(
            f"thread {tid} cannot be put into server {server}: {error.strerror}"
        ) from error
    problem = None
    if policy not in _FAIR_POLICIES:
        problem = (
            f"it runs under {POLICIES.get(policy, policy)}, above every server: give it another "
            f"class first (`chrt --other --pid 0 {tid}`)"
        )
    elif core not in cores:
        problem = (
            f"it may not run on core {core}: allow it to first (`taskset --pid --cpu-list {core} "
            f"{tid}`)"
        )
    if problem is not None:
        os.close(descriptor)
        raise OperationError(f"thread {tid} cannot be put into server {server}: {problem}")
    return descriptor
