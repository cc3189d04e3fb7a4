"""Back end `scx`: the table of servers inside the kernel, as a sched_ext policy.

While the policy (`policy/table.bpf.c`, compiled ahead) is in force, it schedules *every* thread of
the machine's fair class. Real-time threads run above it, so threads in servers must not be
real-time. Nothing has to be put back: the policy lives as long as a file descriptor of this process
(the loader), so the kernel returns to its fair class however the process ends. (A process that
forks without exec inherits the descriptor.)

PREEMPT_RT kernels refuse BPF timers. There each core has a **kicker**, which has the policy
reconsider at each boundary:

    python -m chainshaper.enforcement.scx.back_end CORE DESCRIPTOR

It sleeps on its core until the next boundary, under SCHED_FIFO with the lowest priority. It is a
process, since a thread of the loader would wait for the interpreter's lock.
"""

import ctypes
import os
import platform
import re
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
from chainshaper.linux.child_processes import start_module, what_happened
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
_VISITOR = 0xFFFFFFFF  # server of the thread that starts the timers
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
ROTATION_NS = 2_000_000  # a thread of a server runs so long before the next one has its turn
_WATCH_S = 0.02  # between two looks at the kickers
_VISIT_NS = 1_000_000  # that starting a core's timer may take
_KICKER_ROUND_NS = 60_000_000  # for all kickers to see a new table: each looks every 20 ms at least
_FAIR_POLICIES = (os.SCHED_OTHER, os.SCHED_BATCH, os.SCHED_IDLE, 7)
_CAPABILITIES = {"CAP_IPC_LOCK": 14, "CAP_SYS_ADMIN": 21, "CAP_PERFMON": 38, "CAP_BPF": 39}


def missing() -> str | None:
    """Say why there can be no sched_ext servers here, with the remedy; None: there can."""
    if not SCHED_EXT.is_dir():
        return _without_sched_ext(platform.release())
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


def _without_sched_ext(release: str) -> str:
    """Say why a kernel of this release has no sched_ext, and the remedy."""
    numbers = [int(number) for number in re.findall(r"\d+", release)[:2]]
    if numbers >= [6, 12]:
        return f"this kernel ({release}) was built without CONFIG_SCHED_CLASS_EXT: use one with it"
    return f"this kernel ({release}) has no sched_ext: use Linux 6.12 or newer"


def is_realtime_kernel() -> bool:
    """Whether this is a PREEMPT_RT kernel, which refuses BPF timers."""
    return "PREEMPT_RT" in os.uname().version


def scheduler_in_force() -> str | None:
    """Return the name of the sched_ext scheduler that is loaded; None: there is none."""
    try:
        if read_proc(SCHED_EXT / "state").strip() == b"disabled":
            return None
        return text_of(read_proc(SCHED_EXT / "root" / "ops")).strip()
    except OSError:
        return None


def _lacking_privileges() -> list[str]:
    """Return the capabilities that this process needs and lacks."""
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
    """Return where there are too many servers: the place in words, how many, and the most."""
    crowds = [("", len(table.servers), MAX_SERVERS - 1)]
    for core, count in Counter(server.core for server in table.servers).items():
        crowds.append((f" on core {core}", count, MAX_SERVERS_PER_CORE))
    return [crowd for crowd in crowds if crowd[1] > crowd[2]]


def with_places_apart(table: ServerTable) -> ServerTable:
    """Return a table with a server for each place, so that the most urgent thread runs first.

    The new servers have priorities in the order of the old ones' priorities, then of places. If the
    policy cannot hold so many, the last places of a server share one.
    """
    for most in range(max((server.places for server in table.servers), default=1), 0, -1):
        places = [
            (server, place) for server in table.servers for place in range(min(server.places, most))
        ]
        ranks = sorted({(server.priority, place) for server, place in places})
        servers = [
            replace(
                server,
                name=_of_place(server.name, place),
                priority=1 + ranks.index((server.priority, place)),
            )
            for server, place in places
        ]
        apart = replace(table, servers=tuple(servers))
        if not _too_many(apart):
            break
    return apart


def _of_place(server: str, place: int) -> str:
    """Return the name of the server for a place of a server."""
    return f"{server}\0{place}" if place else server


def numbered(table: ServerTable) -> dict[str, int]:
    """Return an id for each server; 0 means best effort."""
    return {server.name: number for number, server in enumerate(table.servers, start=1)}


def pack_servers(table: ServerTable) -> dict[int, bytes]:
    """Return the elements of the map `servers`, by their keys: the servers' ids."""
    packed = {}
    for number, server in enumerate(table.servers, start=1):
        head = SERVER.pack(
            table.cycle_ns, ROTATION_NS, server.core, server.priority, len(server.slots), 0
        )
        slots = b"".join(SLOT.pack(start, end) for start, end in server.slots)
        packed[number] = (head + slots).ljust(SERVER.size + MAX_SLOTS * SLOT.size, b"\0")
    return packed


def pack_cores(table: ServerTable) -> dict[int, bytes]:
    """Return the elements of the map `cpus`, by core: the ids of the core's servers.

    The most urgent comes first; those of one priority are in the order of the table.
    """
    ids, packed = numbered(table), {}
    for core in {server.core for server in table.servers}:
        here = [server for server in table.servers if server.core == core]
        here.sort(key=lambda server: server.priority)
        here_ids = [ids[server.name] for server in here]
        padding = [0] * (MAX_SERVERS_PER_CORE - len(here))
        packed[core] = CORE.pack(len(here), *here_ids, *padding)
    return packed


def pack_in_force(place: int, anchors: Sequence[int], instant_ns: int, *, replaces: bool) -> bytes:
    """Return the element of the map `in_force`: which of two anchors holds, and from when on.

    From the instant on it is the anchor in this place. Before, it is the other one, if there is one
    that it ``replaces``; else none.
    """
    return IN_FORCE.pack(instant_ns << 2 | replaces << 1 | place, *anchors)


def unpack_counters(value: bytes) -> ServerCounters:
    """Make counters of an element of the map `counters`."""
    return ServerCounters(*COUNTERS.unpack(value)[:4])


def in_all_places(counters: Sequence[ServerCounters]) -> ServerCounters:
    """Join the counters of a server's places, which all have the same slots.

    A slot counts as overrun once, however many threads wanted to run at its end.
    """
    first = counters[0]
    overruns = min(first.slots or 0, sum(of_place.overruns or 0 for of_place in counters))
    return replace(first, overruns=overruns)


def unpack_exit(value: bytes) -> str | None:
    """Read the element of the map `ended`: why the kernel has ended the policy, or None."""
    kind, *texts = EXIT.unpack(value)
    said = [text.split(b"\0", 1)[0].decode(errors="replace") for text in texts]
    return ": ".join(filter(None, said)) if kind else None


def create(table: ServerTable) -> "ScxServers":
    """Make servers for a table; nothing is loaded before :meth:`ScxServers.arm`.

    Raises InputError: as :func:`check_table`. PlatformError: there is no such core, or as
    :func:`missing` says.
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
        self._members: dict[int, tuple[int, int]] = {}  # by tid: thread descriptor, server id
        self._has_timer = not is_realtime_kernel()
        self._policy: BpfObject | None = None
        self._link = 0
        self._kickers: dict[int, subprocess.Popen[bytes]] = {}  # by core
        self._anchors = [0, 0]  # the anchor in force, and the one before or after
        self._place = 0  # of the latest anchor
        self._failure: str | None = None
        self._released = threading.Event()
        self._last_counters = dict.fromkeys(
            (server.name for server in table.servers), ServerCounters(0, 0, 0, 0)
        )
        self._lock = threading.RLock()

    def assign(self, tid: int, server: str, place: int = 0) -> None:
        """Put a thread into a server; see :meth:`BackEnd.assign`.

        Raises OperationError: it is real-time, or may not use the server's core.
        """
        core = server_named(self._table, server).core
        with self._lock:
            self._check_in_use()
            descriptor = _examine_thread(tid, server, core)
            if descriptor is None:
                return
            if tid in self._members:
                os.close(self._members.pop(tid)[0])
            # The last places may share a server.
            names = (_of_place(server, earlier) for earlier in range(place, -1, -1))
            number = next(self._ids[name] for name in names if name in self._ids)
            self._members[tid] = (descriptor, number)
            if self._policy is not None:
                self._hand_over(self._policy, tid)
                self._policy.run("table_decide", WAKE.size)()

    def arm(self, anchor_ns: int) -> None:
        """Enforce the slots; see :meth:`BackEnd.arm`. Returns when they are in force.

        That is at the same instant on all cores.
        """
        with self._lock:
            self._check_in_use()
            if self._policy is None:
                self._policy = self._begin()
            instant = self._put_in_force(self._policy, anchor_ns)
            while (left := instant - time.monotonic_ns()) > 0:
                time.sleep(left / 1e9)
            self._since_ns = instant

    def counters(self) -> dict[str, ServerCounters]:
        """Return the counters; see :meth:`BackEnd.counters`. After the release, the last ones.

        A slot counts from the core's first decision inside it on.
        """
        with self._lock:
            if self._policy is not None:
                places: dict[str, list[ServerCounters]] = {}
                for name, number in self._ids.items():
                    element = self._policy.element("counters", number, COUNTERS.size)
                    server = name.partition("\0")[0]
                    places.setdefault(server, []).append(unpack_counters(element))
                self._last_counters = {
                    server: in_all_places(counters) for server, counters in places.items()
                }
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
        """Raise OperationError if the servers were released, or have failed."""
        if self._released.is_set():
            raise OperationError("these servers were released; create them anew")
        if (failure := self.failure()) is not None:
            raise OperationError(f"{failure}; release these servers and create them anew")

    def _begin(self) -> BpfObject:
        """Load the policy with the table, which is not in force yet: all runs as best effort."""
        try:
            policy = BpfObject(POLICY)
        except OSError as error:
            raise OperationError(f"the policy cannot be read: {error.strerror}") from error
        try:
            config = policy.initial_bytes(".rodata.config", CONFIG.size)
            core_count = min(os.sysconf("SC_NPROCESSORS_CONF"), MAX_CORES)
            CONFIG.pack_into(config, 0, self._has_timer, core_count)
            # With this flag the policy places threads that must not migrate, too. Older kernels
            # do not have it.
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
            if not self._has_timer:
                boundary = policy.program_descriptor("table_boundary")
                for core in self._cores:
                    self._kickers[core] = _start_kicker(core, boundary)
            if (reason := missing()) is not None:  # another scheduler was loaded meanwhile
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
        """Write the anchor and have all cores change over to it; return the instant of that.

        The instant is so far ahead that each core knows of the anchor by then. Kickers look for it
        by themselves. A timer belongs to the core on which it is started, so the calling thread
        runs on one core after the other; the policy runs it before all other threads. Raises
        OperationError: it may not run on one of the cores.
        """
        place = 1 - self._place
        self._anchors[place] = anchor_ns % self._table.cycle_ns  # the same cycles, from long ago
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
        """Tell the policy the server of a thread; a thread that has ended is forgotten."""
        descriptor, number = self._members[tid]
        try:
            policy.update("assignments", descriptor, number.to_bytes(4, "little"))
        except (ProcessLookupError, FileNotFoundError):
            os.close(descriptor)
            del self._members[tid]
        except OSError as error:
            raise OperationError(f"thread {tid} gets no server: {error.strerror}") from error

    def _watch(self) -> None:
        """Take the policy away when a kicker stops, or watching them fails.

        Without its kicker, an idle core would keep its threads waiting for ever.
        """
        try:
            self._watch_kickers()
        except Exception as error:  # otherwise the thread would end, and nobody would watch
            with self._lock:
                reason = f"watching the kickers has failed ({type(error).__name__}: {error})"
                self._failure = self._failure or f"{reason}; {_FREELY}"
                self._end()

    def _watch_kickers(self) -> None:
        """Watch the kickers until the servers are released or have failed."""
        while not self._released.wait(_WATCH_S):
            with self._lock:
                for core, kicker in self._kickers.items():
                    end = what_happened(kicker)
                    if self.failure() is None and end is not None:
                        named = f"the kicker of core {core} (process {kicker.pid})"
                        self._failure = f"{named} {end}, which makes slots inexact; {_FREELY}"
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
    """Open a file descriptor that stands for a thread. Raises OSError: there is no such thread."""
    return os.pidfd_open(tid, os.O_EXCL)  # PIDFD_THREAD


def _examine_thread(tid: int, server: str, core: int) -> int | None:
    """Open a descriptor of a thread that the policy can schedule on this core.

    None: the thread has ended. Raises OperationError: the policy cannot schedule it there.
    """
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
    """Start a core's kicker, which runs ``program``, the descriptor of `table_boundary`.

    Raises OperationError: it ends at once.
    """
    # It is in a session of its own, so that Ctrl-C reaches the loader only, which ends it last.
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
    # The class first: on a busy core it might not run any more as SCHED_OTHER to ask for it.
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
