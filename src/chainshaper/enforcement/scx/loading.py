"""The sched_ext policy in the kernel: loading it, giving it a table, taking it away.

A policy begins with an empty table, under which everything is best effort. Each table after that
is written into the generation that is not in force, and comes into force on all cores at one
instant that lies a little ahead: until then, every core must learn that it has to decide there.
"""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from chainshaper.enforcement.scx.libbpf import (
    BpfObject,
    ProgramRun,
    delete_element,
    kernel_enum_value,
    update_element,
)
from chainshaper.enforcement.scx.requirements import scheduler_in_force
from chainshaper.enforcement.scx.table import (
    CONFIG,
    MAX_CORES,
    MAX_SERVERS,
    OPERATIONS_FLAGS,
    VISITOR,
    WAKE,
    ServerIds,
    change_word,
    pack_cores,
    pack_servers,
)
from chainshaper.enforcement.servers import ServerTable
from chainshaper.values.errors import OperationError

__all__ = [
    "LoadedPolicy",
    "attach_policy",
    "load_policy",
    "put_in_force",
    "thread_descriptor",
    "write_table",
]

POLICY = Path(__file__).with_name("policy") / "table.bpf.o"
PIDFD_THREAD = os.O_EXCL
VISIT_NS = 1_000_000
KICKER_ROUND_NS = 60_000_000
"""Each kicker looks for a new table every 20 ms at least."""


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
    """Have the kernel verify and keep the policy.

    Raises:
        OperationError: it refuses.
    """
    try:
        bpf = BpfObject(POLICY)
    except OSError as error:
        raise OperationError(f"the scheduling policy cannot be read: {error.strerror}") from error
    CONFIG.pack_into(bpf.initial_bytes(".rodata.config", CONFIG.size), 0, has_timer, core_count())
    # Where the kernel has it: threads that must not migrate are ours to place, too.
    flags = bpf.initial_bytes("table_ops", OPERATIONS_FLAGS.size)
    wanted = kernel_enum_value("scx_ops_flags", "SCX_OPS_ENQ_MIGRATION_DISABLED") or 0
    OPERATIONS_FLAGS.pack_into(flags, 0, OPERATIONS_FLAGS.unpack_from(flags)[0] | wanted)
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
        decide=ProgramRun(bpf.program_descriptor("table_decide"), WAKE.size),
    )


def attach_policy(policy: LoadedPolicy) -> int:
    """Put the policy in force; the address of the link that keeps it there.

    Raises:
        OperationError: the kernel refuses, or another scheduler was quicker.
    """
    scheduler = scheduler_in_force()
    if scheduler is not None:
        raise OperationError(
            f"sched_ext scheduler {scheduler} is in force, and there can be one only: end it"
        )
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
    return min(os.sysconf("SC_NPROCESSORS_CONF"), MAX_CORES)


def write_table(
    policy: LoadedPolicy, table: ServerTable, ids: ServerIds, generation: int, anchor_ns: int
) -> None:
    """Write a table into a generation that is not in force."""
    past_anchor_ns = anchor_ns % table.cycle_ns  # cycles repeat: within the first after booting
    for number, value in pack_servers(table, ids, past_anchor_ns).items():
        update_element(policy.servers, generation * MAX_SERVERS + number, value)
    for core, value in pack_cores(table, ids, core_count()).items():
        update_element(policy.cpus, generation * MAX_CORES + core, value)


def put_in_force(policy: LoadedPolicy, generation: int, cores: list[int], *, replaces: bool) -> int:
    """Have all cores change over to a generation; the instant at which they will, a little ahead.

    Until then each core has to learn that it must decide at that instant. Kickers look by
    themselves. A timer belongs to the core that starts it, so the calling thread goes round; the
    policy lets it pass before everything else, because it must not wait for a core that servers
    keep busy. ``replaces``: another table is in force until then.

    Raises:
        OperationError: the calling thread may not run on one of the cores.
    """
    start_timer = ProgramRun(policy.boundary, WAKE.size)
    home = os.sched_getaffinity(0)
    ahead = VISIT_NS * (1 + len(cores)) if policy.has_timer else KICKER_ROUND_NS
    to_visit = cores if policy.has_timer else []
    descriptor = thread_descriptor(threading.get_native_id())
    update_element(policy.assignments, descriptor, VISITOR.to_bytes(4, "little"))
    try:
        instant = time.monotonic_ns() + ahead
        update_element(policy.in_force, 0, change_word(generation, instant, replaces=replaces))
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

    Raises:
        OSError: there is no such thread.
    """
    return os.pidfd_open(tid, PIDFD_THREAD)
