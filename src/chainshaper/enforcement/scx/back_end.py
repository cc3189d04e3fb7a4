"""Back end `scx`: the table of servers inside the kernel, as a sched_ext policy.

The policy (`policy/table.bpf.c`, which explains how it works) is compiled ahead. While it is
in force, *every* thread of the machine's fair class is scheduled by it: those assigned to servers
inside their slots, all others first come first served behind them. Real-time threads stand above
it, as they do above the fair class, so a thread that shall be governed must not be one.

A policy begins with an empty table, under which everything is best effort. Each table after that
is written into the generation that is not in force, and comes into force on all cores at one
instant that lies a little ahead: until then, every core must learn that it has to decide there.

Nothing has to be put back by hand. The policy hangs on a file descriptor of this process, and
however it ends, the kernel returns to its fair class. (A fork without exec inherits the
descriptor, and keeps the policy for as long as it lives.)
"""

import os
import resource
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from chainshaper.enforcement.scx import table as layout
from chainshaper.enforcement.scx.kicker import start_kicker
from chainshaper.enforcement.scx.libbpf import (
    BpfObject,
    ProgramRun,
    delete_element,
    kernel_enum_value,
    load_libbpf,
    look_up_element,
    update_element,
)
from chainshaper.enforcement.servers import ServerCounters, ServerTable
from chainshaper.linux.own_processes import what_happened
from chainshaper.linux.scheduling import check_cores, may_use_fifo
from chainshaper.linux.threads import POLICIES, RESET_ON_FORK
from chainshaper.values.errors import InputError, OperationError, PlatformError

POLICY = Path(__file__).with_name("policy") / "table.bpf.o"
SCHED_EXT = Path("/sys/kernel/sched_ext")
KERNEL_TYPES = Path("/sys/kernel/btf/vmlinux")
STATUS = Path("/proc/self/status")
WATCH_S = 0.02
PIDFD_THREAD = os.O_EXCL
VISIT_NS = 1_000_000
KICKER_ROUND_NS = 60_000_000
"""Each kicker looks for a new table every 20 ms at least."""

_FAIR_POLICIES = (os.SCHED_OTHER, os.SCHED_BATCH, os.SCHED_IDLE, 7)
_CAPABILITIES = {"CAP_IPC_LOCK": 14, "CAP_SYS_ADMIN": 21, "CAP_PERFMON": 38, "CAP_BPF": 39}


def missing() -> str | None:
    """Why sched_ext servers cannot be had here, with the remedy; None when they can."""
    if not SCHED_EXT.is_dir():
        return (
            "this kernel has no sched_ext: use Linux 6.12 or newer built with "
            "CONFIG_SCHED_CLASS_EXT, such as Debian's from 6.16 on"
        )
    if not KERNEL_TYPES.exists():
        return (
            f"this kernel does not describe its types ({KERNEL_TYPES} is absent): use one built "
            "with CONFIG_DEBUG_INFO_BTF"
        )
    try:
        load_libbpf()
    except PlatformError as error:
        return str(error)
    lacking = _lacking_privileges()
    if lacking:
        return (
            f"this process lacks {' and '.join(lacking)}: run as root, or give it these "
            "capabilities (AmbientCapabilities= of a systemd unit, or capsh --addamb=)"
        )
    return _other_scheduler()


def is_realtime_kernel() -> bool:
    """Whether this is a PREEMPT_RT kernel, which refuses BPF timers."""
    return "PREEMPT_RT" in os.uname().version


def scheduler_in_force() -> str | None:
    """The name of the sched_ext scheduler that is loaded, None when there is none."""
    try:
        if (SCHED_EXT / "state").read_text().strip() == "disabled":
            return None
        return (SCHED_EXT / "root" / "ops").read_text().strip()
    except OSError:
        return None


def _other_scheduler() -> str | None:
    scheduler = scheduler_in_force()
    if scheduler is None:
        return None
    return f"sched_ext scheduler {scheduler} is in force, and there can be one only: end it"


def _lacking_privileges() -> list[str]:
    granted = _capabilities()
    lacking = []
    if "CAP_SYS_ADMIN" not in granted:
        lacking += [name for name in ("CAP_BPF", "CAP_PERFMON") if name not in granted]
    if is_realtime_kernel():
        if not may_use_fifo():
            lacking.append("CAP_SYS_NICE")
        limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
        if "CAP_IPC_LOCK" not in granted and limit != resource.RLIM_INFINITY:
            lacking.append("CAP_IPC_LOCK")
    return lacking


def _capabilities() -> set[str]:
    for line in STATUS.read_text().splitlines():
        if line.startswith("CapEff:"):
            mask = int(line.split()[1], 16)
            return {name for name, bit in _CAPABILITIES.items() if mask >> bit & 1}
    return set()


@dataclass(frozen=True)
class LoadedPolicy:
    """The policy's programs and maps in the kernel (file descriptors), not in force by itself."""

    bpf: BpfObject
    has_timer: bool
    servers: int
    cpus: int
    in_force: int
    assignments: int
    counters: int
    ended: int
    boundary: int
    decide: ProgramRun


def load_policy(*, has_timer: bool) -> LoadedPolicy:
    """Have the kernel verify the policy; an OperationError where it refuses."""
    try:
        bpf = BpfObject(POLICY)
    except OSError as error:
        raise OperationError(f"the scheduling policy cannot be read: {error.strerror}") from error
    layout.CONFIG.pack_into(
        bpf.initial_bytes(".rodata.config", layout.CONFIG.size), 0, has_timer, core_count()
    )
    # Where the kernel has it: threads that must not migrate are ours to place, too.
    flags = bpf.initial_bytes("table_ops", layout.OPERATIONS_FLAGS.size)
    wanted = kernel_enum_value("scx_ops_flags", "SCX_OPS_ENQ_MIGRATION_DISABLED") or 0
    layout.OPERATIONS_FLAGS.pack_into(
        flags, 0, layout.OPERATIONS_FLAGS.unpack_from(flags)[0] | wanted
    )
    try:
        bpf.load()
    except OSError as error:
        bpf.close()
        raise _refusal(error) from error
    return LoadedPolicy(
        bpf=bpf,
        has_timer=has_timer,
        servers=bpf.map_descriptor("servers"),
        cpus=bpf.map_descriptor("cpus"),
        in_force=bpf.map_descriptor("in_force"),
        assignments=bpf.map_descriptor("assignments"),
        counters=bpf.map_descriptor("counters"),
        ended=bpf.map_descriptor("ended"),
        boundary=bpf.program_descriptor("table_boundary"),
        decide=ProgramRun(bpf.program_descriptor("table_decide"), layout.WAKE.size),
    )


def attach_policy(policy: LoadedPolicy) -> int:
    """Put the policy in force; the address of the link that keeps it there.

    Raises OperationError: the kernel refuses, or another scheduler was quicker.
    """
    if (reason := _other_scheduler()) is not None:
        raise OperationError(reason)
    try:
        return policy.bpf.attach_operations("table_ops")
    except OSError as error:
        raise _refusal(error) from error


def _refusal(error: OSError) -> OperationError:
    return OperationError(
        f"the kernel ({os.uname().release}) refuses the scheduling policy: {error.strerror}"
    )


def core_count() -> int:
    """How many cores the machine may have, as far as the policy can count."""
    return min(os.sysconf("SC_NPROCESSORS_CONF"), layout.MAX_CORES)


def write_table(
    policy: LoadedPolicy, table: ServerTable, ids: layout.ServerIds, generation: int, anchor_ns: int
) -> None:
    """Write a table into a generation that is not in force."""
    past_anchor_ns = anchor_ns % table.cycle_ns  # cycles repeat: within the first after booting
    for number, value in layout.pack_servers(table, ids, past_anchor_ns).items():
        update_element(policy.servers, generation * layout.MAX_SERVERS + number, value)
    for core, value in layout.pack_cores(table, ids, core_count()).items():
        update_element(policy.cpus, generation * layout.MAX_CORES + core, value)


def put_in_force(policy: LoadedPolicy, generation: int, cores: list[int], *, replaces: bool) -> int:
    """Have all cores change over to a generation; the instant at which they will, a little ahead.

    Until then each core has to learn that it must decide at that instant. Kickers look by
    themselves. A timer belongs to the core that starts it, so the calling thread goes round; the
    policy lets it pass before everything else, because it must not wait for a core that servers
    keep busy. ``replaces``: another table is in force until then. Raises OperationError: the
    calling thread may not run on one of the cores.
    """
    start_timer = ProgramRun(policy.boundary, layout.WAKE.size)
    home = os.sched_getaffinity(0)
    ahead = VISIT_NS * (1 + len(cores)) if policy.has_timer else KICKER_ROUND_NS
    to_visit = cores if policy.has_timer else []
    descriptor = thread_descriptor(threading.get_native_id())
    update_element(policy.assignments, descriptor, layout.VISITOR.to_bytes(4, "little"))
    try:
        instant = time.monotonic_ns() + ahead
        update_element(
            policy.in_force, 0, layout.change_word(generation, instant, replaces=replaces)
        )
        for core in to_visit:
            os.sched_setaffinity(0, {core})
            start_timer()
    except OSError as error:
        raise OperationError(
            f"the table cannot be put in force on the cores {cores}: {error}"
        ) from error
    finally:
        delete_element(policy.assignments, descriptor)
        os.close(descriptor)
        os.sched_setaffinity(0, home)
    return instant


def thread_descriptor(tid: int) -> int:
    """A file descriptor that stands for a thread, and never for another that gets its id.

    Raises OSError: there is no such thread.
    """
    return os.pidfd_open(tid, PIDFD_THREAD)


def create(table: ServerTable) -> "ScxServers":
    """Servers for this table; nothing is loaded before :meth:`ScxServers.arm`.

    Raises InputError: the table is wrong or too large for the policy. PlatformError: this machine
    has no such core, or lacks what :func:`missing` names.
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
        self._ids = layout.number_servers(table, {})
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
        """See :meth:`BackEnd.assign`; refused where it is real-time, or may not use the core."""
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
        """See :meth:`BackEnd.arm`; returns when the slots are in force, on all cores at once."""
        self.change(self._table, anchor_ns)

    def in_force_from(self) -> int | None:
        return self.in_force_since_ns or None

    def change(self, table: ServerTable, anchor_ns: int) -> None:
        """Put another table in force, on all cores at one instant.

        Threads stay in the server of the same name; those of a server that is no longer there run
        as best effort until they are assigned anew. Raises as :func:`create`, and

            OperationError: the kernel refuses the policy, or it has ended (:meth:`failure`).
        """
        _check(table)
        with self._lock:
            self._check_in_use()
            self._ids = layout.number_servers(table, self._ids)
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
        """See :meth:`BackEnd.counters`; after :meth:`release`, the last ones.

        A slot counts as opened with the core's first decision inside it.
        """
        with self._lock:
            if self._policy is not None:
                for name, number in self._ids.items():
                    value = look_up_element(self._policy.counters, number, layout.COUNTERS.size)
                    self._last_counters[name] = layout.unpack_counters(value)
            none = ServerCounters(0, 0, 0, 0)
            return {s.name: self._last_counters.get(s.name, none) for s in self._table.servers}

    def failure(self) -> str | None:
        with self._lock:
            if self._failure is None and self._policy is not None:
                ended = layout.unpack_exit(look_up_element(self._policy.ended, 0, layout.EXIT.size))
                if ended.kind:
                    detail = f": {ended.message}" if ended.message else ""
                    self._failure = (
                        f"the kernel has ended the scheduling policy ({ended.reason}{detail}); "
                        "all threads run freely"
                    )
            return self._failure

    def release(self) -> None:
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
    layout.check_table(table)
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
