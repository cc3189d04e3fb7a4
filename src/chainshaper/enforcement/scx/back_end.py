"""Back end `scx`: the table of servers inside the kernel, as a sched_ext policy.

While the policy (`policy/table.bpf.c`, compiled ahead) is in force, *every* thread of the machine's
fair class is scheduled by it. Real-time threads stand above it, so a thread that shall be governed
must not be one. Nothing has to be put back by hand: the policy hangs on a file descriptor of this
process, and however it ends, the kernel returns to its fair class. (A fork without exec inherits
it.)

PREEMPT_RT kernels refuse BPF timers. There each core has a **kicker**, a process of its own, since
a thread of the loader would wait for the interpreter's lock:

    python -m chainshaper.enforcement.scx.back_end CORE DESCRIPTOR

Under SCHED_FIFO, of the lowest priority, it sleeps on the core until the next boundary.
"""

import ctypes
import os
import resource
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from chainshaper.enforcement.scx.libbpf import (
    BpfObject,
    ProgramRun,
    kernel_enum_value,
    load_libbpf,
)
from chainshaper.enforcement.servers import BackEnd, ServerCounters, ServerTable, server_named
from chainshaper.linux.own_processes import start_module, what_happened
from chainshaper.linux.scheduling import (
    check_cores,
    lock_memory,
    may_use_fifo,
    set_thread_name,
    stop_garbage_collection,
)
from chainshaper.linux.threads import POLICIES, RESET_ON_FORK, read_proc, status_field
from chainshaper.values.errors import InputError, OperationError, PlatformError, text_of

POLICY = Path(__file__).with_name("policy") / "table.bpf.o"
SCHED_EXT = Path("/sys/kernel/sched_ext")
KERNEL_TYPES = Path("/sys/kernel/btf/vmlinux")
STATUS = Path("/proc/self/status")

# As in policy/table_abi.h; a test compares them with what a C compiler makes of that file.
MAX_SERVERS = 128  # with id 0, which means best effort
MAX_SLOTS = 64
MAX_SERVERS_PER_CORE = 32
MAX_CORES = 512
_VISITOR = 0xFFFFFFFF
SERVER = struct.Struct("<QQIIII")
SLOT = struct.Struct("<QQ")
CORE = struct.Struct(f"<I{MAX_SERVERS_PER_CORE}I")
IN_FORCE = struct.Struct("<QQQ")
COUNTERS = struct.Struct("<QQQQQQ")
EXIT = struct.Struct("<i64s192s")
CONFIG = struct.Struct("<II")
WAKE = struct.Struct("<qqqq")
INSTANT = struct.Struct("<qq")
_FLAGS = struct.Struct("<Q")

_FREELY = "the policy is gone, and all threads run freely"
ROTATION_NS = 2_000_000  # one thread of a server runs so long before the next has its turn
_WATCH_S = 0.02
_VISIT_NS = 1_000_000
_KICKER_ROUND_NS = 60_000_000  # each kicker looks for a new table every 20 ms at least
_FAIR_POLICIES = (os.SCHED_OTHER, os.SCHED_BATCH, os.SCHED_IDLE, 7)
_CAPABILITIES = {"CAP_IPC_LOCK": 14, "CAP_SYS_ADMIN": 21, "CAP_PERFMON": 38, "CAP_BPF": 39}


def missing() -> str | None:
    """Why sched_ext servers cannot be had here, with the remedy; None when they can."""
    if not SCHED_EXT.is_dir():
        return "this kernel has no sched_ext: use Linux 6.12 or newer with CONFIG_SCHED_CLASS_EXT"
    if not KERNEL_TYPES.exists():
        return f"this kernel has no {KERNEL_TYPES}: use one with CONFIG_DEBUG_INFO_BTF"
    try:
        load_libbpf()
    except PlatformError as error:
        return str(error)
    if lacking := _lacking_privileges():
        return (
            f"this process lacks {' and '.join(lacking)}: run as root, or give it these "
            "capabilities (AmbientCapabilities= of a systemd unit, or capsh --addamb=)"
        )
    if (scheduler := scheduler_in_force()) is not None:
        return f"sched_ext scheduler {scheduler} is in force, and there can be one only: end it"
    return None


def is_realtime_kernel() -> bool:
    """Whether this is a PREEMPT_RT kernel, which refuses BPF timers."""
    return "PREEMPT_RT" in os.uname().version


def scheduler_in_force() -> str | None:
    """The name of the sched_ext scheduler that is loaded, None when there is none."""
    try:
        if read_proc(SCHED_EXT / "state").strip() == b"disabled":
            return None
        return text_of(read_proc(SCHED_EXT / "root" / "ops")).strip()
    except OSError:
        return None


def _lacking_privileges() -> list[str]:
    (mask,) = status_field(STATUS.read_bytes(), "CapEff", base=16)
    granted = {name for name, bit in _CAPABILITIES.items() if mask >> bit & 1}
    wanted = [] if "CAP_SYS_ADMIN" in granted else ["CAP_BPF", "CAP_PERFMON"]
    if is_realtime_kernel():
        if not may_use_fifo():
            wanted.append("CAP_SYS_NICE")
        if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
            wanted.append("CAP_IPC_LOCK")
    return [name for name in wanted if name not in granted]


def check_table(table: ServerTable) -> None:
    """Refuse a table that the policy cannot hold. Raises InputError: a limit is exceeded."""
    for where, count, most in _too_many(table):
        raise InputError(
            f"{count} servers{where} are more than the {most} that back end scx can have; join"
            " servers that share slots"
        )
    for server in table.servers:
        name, slots = f"server {server.name}", len(server.slots)
        if server.core >= MAX_CORES:
            known = f"back end scx knows 0 to {MAX_CORES - 1}"
            raise InputError(f"{name} is on core {server.core}; {known}")
        if not 1 <= slots <= MAX_SLOTS:
            raise InputError(f"{name} has {slots} slots; back end scx takes 1 to {MAX_SLOTS}")


def _too_many(table: ServerTable) -> list[tuple[str, int, int]]:
    """Where there are how many servers, and how many there may be."""
    crowds = [("", len(table.servers), MAX_SERVERS - 1)]
    for core, count in Counter(server.core for server in table.servers).items():
        crowds.append((f" on core {core}", count, MAX_SERVERS_PER_CORE))
    return [crowd for crowd in crowds if crowd[1] > crowd[2]]


def with_places_apart(table: ServerTable) -> ServerTable:
    """The table with a server for each place, in the order of priorities and places: so the policy
    runs the most urgent of a server's threads. If it cannot hold so many, the last places are one.
    """
    for most in range(max((server.places for server in table.servers), default=1), 0, -1):
        places = [(one, k) for one in table.servers for k in range(min(one.places, most))]
        ranks = sorted({(one.priority, k) for one, k in places})
        apart = (
            replace(one, name=_of_place(one.name, k), priority=1 + ranks.index((one.priority, k)))
            for one, k in places
        )
        found = replace(table, servers=tuple(apart))
        if not _too_many(found):
            break
    return found


def _of_place(server: str, place: int) -> str:
    return f"{server}\0{place}" if place else server


def numbered(table: ServerTable) -> dict[str, int]:
    """An id for each server; 0 means best effort."""
    return {server.name: number for number, server in enumerate(table.servers, start=1)}


def pack_servers(table: ServerTable) -> dict[int, bytes]:
    """Map `servers` by id."""
    packed = {}
    for number, server in enumerate(table.servers, start=1):
        where = (server.core, server.priority, len(server.slots), 0)
        head = SERVER.pack(table.cycle_ns, ROTATION_NS, *where)
        slots = b"".join(SLOT.pack(start, end) for start, end in server.slots)
        packed[number] = (head + slots).ljust(SERVER.size + MAX_SLOTS * SLOT.size, b"\0")
    return packed


def pack_cores(table: ServerTable) -> dict[int, bytes]:
    """Map `cpus`: the ids of a core's servers, best first, equals as in the table."""
    ids, packed = numbered(table), {}
    for core in {server.core for server in table.servers}:
        here = sorted((s for s in table.servers if s.core == core), key=lambda s: s.priority)
        padding = [0] * (MAX_SERVERS_PER_CORE - len(here))
        packed[core] = CORE.pack(len(here), *(ids[server.name] for server in here), *padding)
    return packed


def pack_in_force(place: int, anchors: Sequence[int], instant_ns: int, *, replaces: bool) -> bytes:
    """Map `in_force`: the anchor in this place from the instant on; before, the other, if any."""
    return IN_FORCE.pack(instant_ns << 2 | replaces << 1 | place, *anchors)


def unpack_counters(value: bytes) -> ServerCounters:
    """An element of map `counters`."""
    return ServerCounters(*COUNTERS.unpack(value)[:4])


def in_all_places(counters: Sequence[ServerCounters]) -> ServerCounters:
    """What a server has done, from what it has in each place: all have the same slots."""
    first = counters[0]
    overruns = min(first.slots or 0, sum(one.overruns or 0 for one in counters))
    return replace(first, overruns=overruns)


def unpack_exit(value: bytes) -> str | None:
    """The element of map `ended`: why the kernel ended the policy, None if it has not."""
    kind, *texts = EXIT.unpack(value)
    said = [text.split(b"\0", 1)[0].decode(errors="replace") for text in texts]
    return ": ".join(filter(None, said)) if kind else None


def create(table: ServerTable) -> "ScxServers":
    """Servers for this table; nothing is loaded before :meth:`ScxServers.arm`. Raises InputError:
    as :func:`check_table`. PlatformError: there is no such core, or as :func:`missing` says.
    """
    check_table(table)
    check_cores({server.core: f"server {server.name}" for server in table.servers})
    if (reason := missing()) is not None:
        raise PlatformError(f"back end scx: {reason}")
    return ScxServers(table)


class ScxServers(BackEnd):
    """A table of servers in the kernel; see :class:`chainshaper.enforcement.servers.BackEnd`."""

    def __init__(self, table: ServerTable) -> None:
        super().__init__(table)
        self._apart = with_places_apart(table)
        self._ids = numbered(self._apart)
        self._cores = sorted({server.core for server in table.servers})
        self._members: dict[int, tuple[int, int]] = {}  # tid -> (thread descriptor, server id)
        self._has_timer = not is_realtime_kernel()
        self._policy: BpfObject | None = None
        self._link = 0
        self._kickers: dict[int, subprocess.Popen[bytes]] = {}
        self._anchors, self._place = [0, 0], 0
        self._failure: str | None = None
        self._released = threading.Event()
        self._last_counters = dict.fromkeys(
            (server.name for server in table.servers), ServerCounters(0, 0, 0, 0)
        )
        self._lock = threading.RLock()

    def assign(self, tid: int, server: str, place: int = 0) -> None:
        """See :meth:`BackEnd.assign`; refused where it is real-time, or may not use the core."""
        core = server_named(self._table, server).core
        with self._lock:
            self._check_in_use()
            descriptor = _examine_thread(tid, server, core)
            if descriptor is None:
                return
            if tid in self._members:
                os.close(self._members.pop(tid)[0])
            places = (_of_place(server, k) for k in range(place, -1, -1))
            number = next(self._ids[name] for name in places if name in self._ids)
            self._members[tid] = (descriptor, number)
            if self._policy is not None:
                self._hand_over(self._policy, tid)
                self._policy.run("table_decide", WAKE.size)()

    def arm(self, anchor_ns: int) -> None:
        """See :meth:`BackEnd.arm`; returns when the slots are in force, on all cores at once."""
        with self._lock:
            self._check_in_use()
            if self._policy is None:
                self._policy = self._begin()
            instant = self._put_in_force(self._policy, anchor_ns)
            while (left := instant - time.monotonic_ns()) > 0:
                time.sleep(left / 1e9)
            self._since_ns = instant

    def counters(self) -> dict[str, ServerCounters]:
        """See :meth:`BackEnd.counters`; after :meth:`release`, the last ones. A slot opens with the
        core's first decision inside it, and counts once as overrun, by however many threads.
        """
        with self._lock:
            if self._policy is not None:
                places: dict[str, list[ServerCounters]] = {}
                for name, number in self._ids.items():
                    own = unpack_counters(self._policy.element("counters", number, COUNTERS.size))
                    places.setdefault(name.partition("\0")[0], []).append(own)
                self._last_counters = {name: in_all_places(all_) for name, all_ in places.items()}
            return dict(self._last_counters)

    def failure(self) -> str | None:
        with self._lock:
            if self._failure is None and self._policy is not None:
                reason = unpack_exit(self._policy.element("ended", 0, EXIT.size))
                if reason is not None:
                    self._failure = f"the kernel has ended the policy ({reason}); {_FREELY}"
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
        if (failure := self.failure()) is not None:
            raise OperationError(f"{failure}; release these servers and create them anew")

    def _begin(self) -> BpfObject:
        """The policy, with a table that is not in force yet: everything runs as best effort."""
        try:
            policy = BpfObject(POLICY)
        except OSError as error:
            raise OperationError(f"the policy cannot be read: {error.strerror}") from error
        try:
            config = policy.initial_bytes(".rodata.config", CONFIG.size)
            core_count = min(os.sysconf("SC_NPROCESSORS_CONF"), MAX_CORES)
            CONFIG.pack_into(config, 0, self._has_timer, core_count)
            # Where the kernel has it: threads that must not migrate are ours to place, too.
            flags = policy.initial_bytes("table_ops", _FLAGS.size)
            wanted = kernel_enum_value("scx_ops_flags", "SCX_OPS_ENQ_MIGRATION_DISABLED") or 0
            _FLAGS.pack_into(flags, 0, _FLAGS.unpack_from(flags)[0] | wanted)
            policy.load()
            for number, value in pack_servers(self._apart).items():
                policy.update("servers", number, value)
            for core, value in pack_cores(self._apart).items():
                policy.update("cpus", core, value)
            for tid in tuple(self._members):
                self._hand_over(policy, tid)
            for core in () if self._has_timer else self._cores:
                boundary = policy.program_descriptor("table_boundary")
                self._kickers[core] = _start_kicker(core, boundary)
            if (reason := missing()) is not None:  # another scheduler's, since it was looked for
                raise OperationError(reason)
            self._link = policy.attach_operations("table_ops")
        except (OperationError, OSError) as error:
            self._stop_kickers()
            policy.close()
            if isinstance(error, OperationError):
                raise
            raise OperationError(
                f"the kernel ({os.uname().release}) refuses the scheduling policy: {error.strerror}"
            ) from error
        if not self._has_timer:
            threading.Thread(target=self._watch, name="scx watch", daemon=True).start()
        return policy

    def _put_in_force(self, policy: BpfObject, anchor_ns: int) -> int:
        """Write the anchor and have all cores change over; the instant at which they will, a little
        ahead, for each core to learn of it. Kickers look by themselves. A timer belongs to the core
        that starts it, so the calling thread goes round; the policy lets it pass before everything
        else. Raises OperationError: it may not run on one of the cores.
        """
        place = 1 - self._place
        self._anchors[place] = anchor_ns % self._table.cycle_ns  # in the past: cycles repeat
        start_timer, home = policy.run("table_boundary", WAKE.size), os.sched_getaffinity(0)
        visited = self._cores if self._has_timer else ()
        descriptor = _thread_descriptor(threading.get_native_id())
        policy.update("assignments", descriptor, _VISITOR.to_bytes(4, "little"))
        try:
            ahead = _VISIT_NS * (1 + len(visited)) if self._has_timer else _KICKER_ROUND_NS
            instant = time.monotonic_ns() + ahead
            replaces = self._since_ns is not None
            value = pack_in_force(place, self._anchors, instant, replaces=replaces)
            policy.update("in_force", 0, value)
            self._place = place
            for core in visited:
                os.sched_setaffinity(0, {core})
                start_timer()
        except OSError as error:
            raise OperationError(
                f"the table cannot be put in force on the cores {self._cores}: {error}"
            ) from error
        finally:
            policy.delete("assignments", descriptor)
            os.close(descriptor)
            os.sched_setaffinity(0, home)
        return instant

    def _hand_over(self, policy: BpfObject, tid: int) -> None:
        """Give the policy the server of a thread; one that has ended is forgotten."""
        descriptor, number = self._members[tid]
        try:
            policy.update("assignments", descriptor, number.to_bytes(4, "little"))
        except (ProcessLookupError, FileNotFoundError):
            os.close(descriptor)
            del self._members[tid]
        except OSError as error:
            raise OperationError(f"thread {tid} gets no server: {error.strerror}") from error

    def _watch(self) -> None:
        """Fail open when a kicker stops, or watching does: an idle core would never notice."""
        try:
            self._watch_kickers()
        except Exception as error:  # a thread that ends in silence watches no more
            with self._lock:
                why = f"watching the kickers has failed ({type(error).__name__}: {error})"
                self._failure = self._failure or f"{why}; {_FREELY}"
                self._end()

    def _watch_kickers(self) -> None:
        while not self._released.wait(_WATCH_S):
            with self._lock:
                for core, kicker in self._kickers.items():
                    what = what_happened(kicker)
                    if self.failure() is None and what is not None:
                        who = f"the kicker of core {core} (process {kicker.pid})"
                        self._failure = f"{who} {what}, which makes slots inexact; {_FREELY}"
                if self.failure() is not None:
                    self._end()
                    return

    def _end(self) -> None:
        """Take the policy away, and remember what it has counted and why it ended."""
        if self._policy is not None:
            self.counters()
            self.failure()
            self._policy.detach(self._link)
            self._stop_kickers()
            self._policy.close()
            self._policy = None

    def _stop_kickers(self) -> None:
        for kicker in self._kickers.values():
            kicker.kill()
            kicker.communicate()
        self._kickers.clear()


def _thread_descriptor(tid: int) -> int:
    """A file descriptor that stands for a thread. Raises OSError: there is no such thread."""
    return os.pidfd_open(tid, os.O_EXCL)  # PIDFD_THREAD


def _examine_thread(tid: int, server: str, core: int) -> int | None:
    """A descriptor of a thread that the policy can govern on this core; None when it has ended."""
    refused = f"thread {tid} cannot be put into server {server}"
    try:
        descriptor = _thread_descriptor(tid)
        policy = os.sched_getscheduler(tid) & ~RESET_ON_FORK
        cores = os.sched_getaffinity(tid)
    except ProcessLookupError:
        return None
    except OSError as error:
        raise OperationError(f"{refused}: {error.strerror}") from error
    if policy not in _FAIR_POLICIES:
        problem = f"it is under {POLICIES.get(policy, policy)}: `chrt --other --pid 0 {tid}` first"
    elif core not in cores:
        problem = f"it may not run on core {core}: `taskset --pid --cpu-list {core} {tid}` first"
    else:
        return descriptor
    os.close(descriptor)
    raise OperationError(f"{refused}: {problem}")


def _start_kicker(core: int, program: int) -> subprocess.Popen[bytes]:
    """Start a core's kicker, with `table_boundary`'s descriptor. Raises OperationError: it ends."""
    # In its own session, Ctrl-C is for the loader, which ends the kicker last.
    process = start_module(__name__, str(core), str(program), pass_fds=(program,))
    if not process.stdout or not process.stdout.readline():
        _, said = process.communicate()
        reason = said.decode(errors="replace").strip().rpartition("\n")[2]
        raise OperationError(f"the kicker of core {core} cannot start: {reason}")
    return process


def _kick(core: int, program: int) -> None:
    """Kick the core at each boundary until the loader has gone."""
    loader = os.getppid()
    set_thread_name(f"kicker/{core}")
    # The class first: moved to a busy core as SCHED_OTHER, it might not run again to ask for it.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    os.sched_setaffinity(0, {core})
    lock_memory()
    stop_garbage_collection()
    sleep, monotonic, absolute = ctypes.CDLL(None).clock_nanosleep, 1, 1
    boundary = ProgramRun(program, WAKE.size)
    until = ctypes.c_void_p(ctypes.addressof(boundary.context))
    once_more = ctypes.c_void_p(ctypes.addressof(boundary.context) + INSTANT.size)
    boundary()
    sys.stdout.write("at work\n")
    sys.stdout.close()
    # From here on each microsecond delays the threads that wait for a slot to begin.
    parent, plan, (descriptor, options) = os.getppid, boundary.function, boundary.arguments
    while parent() == loader:
        plan(descriptor, options)
        sleep(monotonic, absolute, until, None)
        sleep(monotonic, absolute, once_more, None)


if __name__ == "__main__":
    _kick(int(sys.argv[1]), int(sys.argv[2]))
