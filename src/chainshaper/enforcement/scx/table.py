"""A table of servers as the sched_ext policy wants it: bytes for its maps.

The layouts are those of `policy/table_abi.h`; a test compares them with what a C compiler
makes of that file. Times are ns of CLOCK_MONOTONIC.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from chainshaper.enforcement.servers import ReservationServer, ServerCounters, ServerTable
from chainshaper.values.errors import InputError

MAX_SERVERS = 128
"""With id 0, which means best effort."""
MAX_SLOTS = 64
MAX_SERVERS_PER_CORE = 32
MAX_CORES = 512
VISITOR = 0xFFFFFFFF
ROTATION_NS = 2_000_000
"""How long one thread of a server runs before the next one has its turn."""

SERVER = struct.Struct("<QQQIIII")
SLOT = struct.Struct("<QQ")
CORE = struct.Struct(f"<I{MAX_SERVERS_PER_CORE}I")
COUNTERS = struct.Struct("<QQQQQQ")
EXIT = struct.Struct("<iiq64s192s")
CONFIG = struct.Struct("<II")
WAKE = struct.Struct("<qqqq")
INSTANT = struct.Struct("<qq")
WORD = struct.Struct("<Q")
OPERATIONS_FLAGS = struct.Struct("<Q")

ServerIds: TypeAlias = Mapping[str, int]


def check_table(table: ServerTable) -> None:
    """Refuse a table that the policy cannot hold or that contradicts itself.

    Raises InputError: a limit is exceeded, a name or slot is wrong.
    """
    if table.cycle_ns <= 0:
        raise InputError(f"the cycle time is {table.cycle_ns} ns; it must be positive")
    names = [server.name for server in table.servers]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"server {name} stands in the table twice; rename one of them")
    if len(names) >= MAX_SERVERS:
        raise InputError(
            f"{len(names)} servers are more than the {MAX_SERVERS - 1} that back end scx can "
            "hold; join servers that share slots"
        )
    for server in table.servers:
        _check_server(server, table.cycle_ns)
    for core in {server.core for server in table.servers}:
        count = sum(server.core == core for server in table.servers)
        if count > MAX_SERVERS_PER_CORE:
            raise InputError(
                f"{count} servers on core {core} are more than the {MAX_SERVERS_PER_CORE} that "
                "back end scx can hold there; move some to other cores"
            )


def _check_server(server: ReservationServer, cycle_ns: int) -> None:
    if not 0 <= server.core < MAX_CORES:
        raise InputError(
            f"server {server.name} is on core {server.core}; back end scx knows 0 to "
            f"{MAX_CORES - 1}"
        )
    if not 0 <= server.priority < 0xFFFFFFFF:
        raise InputError(
            f"server {server.name} has priority {server.priority}; it must not be negative"
        )
    if not 1 <= len(server.slots) <= MAX_SLOTS:
        raise InputError(
            f"server {server.name} has {len(server.slots)} slots; back end scx takes 1 to "
            f"{MAX_SLOTS}"
        )
    end_before = 0
    for start, end in server.slots:
        if not end_before <= start < end <= cycle_ns:
            raise InputError(
                f"server {server.name}: slot [{start}, {end}) ns is not inside [0, {cycle_ns}), "
                f"or does not begin after {end_before}; slots are ascending and disjoint"
            )
        end_before = end


def number_servers(table: ServerTable, known: ServerIds) -> dict[str, int]:
    """Ids for all servers of a table; those in ``known`` keep theirs, even when no longer used.

    Raises InputError: no id is left.
    """
    ids = dict(known)
    for server in table.servers:
        ids.setdefault(server.name, len(ids) + 1)
    if len(ids) >= MAX_SERVERS:
        raise InputError(
            f"back end scx has had {len(ids)} servers of different names by now and cannot hold "
            f"more than {MAX_SERVERS - 1}; release it and start again"
        )
    return ids


def pack_servers(table: ServerTable, ids: ServerIds, anchor_ns: int) -> dict[int, bytes]:
    """Map `servers` by id: every id below :data:`MAX_SERVERS`, empty where there is no server.

    ``anchor_ns`` must lie in the past.
    """
    size = SERVER.size + MAX_SLOTS * SLOT.size
    packed = dict.fromkeys(range(MAX_SERVERS), bytes(size))
    for server in table.servers:
        head = SERVER.pack(
            table.cycle_ns,
            anchor_ns,
            ROTATION_NS,
            server.core,
            server.priority,
            len(server.slots),
            0,
        )
        slots = b"".join(SLOT.pack(start, end) for start, end in server.slots)
        packed[ids[server.name]] = (head + slots).ljust(size, b"\0")
    return packed


def pack_cores(table: ServerTable, ids: ServerIds, core_count: int) -> dict[int, bytes]:
    """Map `cpus` by core below ``core_count``: its servers, best priority first.

    Equal priorities are taken in the order of the table.
    """
    packed = dict.fromkeys(range(core_count), bytes(CORE.size))
    for core in sorted({server.core for server in table.servers}):
        here = sorted((s for s in table.servers if s.core == core), key=lambda s: s.priority)
        numbers = [ids[server.name] for server in here]
        padding = [0] * (MAX_SERVERS_PER_CORE - len(numbers))
        packed[core] = CORE.pack(len(numbers), *numbers, *padding)
    return packed


def change_word(generation: int, instant_ns: int, *, replaces: bool) -> bytes:
    """Map `in_force`: this generation from the instant on, the other one before it.

    ``replaces``: that one holds a table; otherwise nothing is governed before the instant.
    """
    return WORD.pack(instant_ns << 2 | replaces << 1 | generation)


def unpack_counters(value: bytes) -> ServerCounters:
    """An element of map `counters`."""
    slots, late, longest, overruns, _, _ = COUNTERS.unpack(value)
    return ServerCounters(slots, late, longest, overruns)


@dataclass(frozen=True)
class PolicyExit:
    """Why the kernel ended the policy; ``kind`` 0: it has not, 64: the link was closed."""

    kind: int
    reason: str
    message: str


def unpack_exit(value: bytes) -> PolicyExit:
    """The element of map `ended`."""
    kind, _, _, reason, message = EXIT.unpack(value)
    return PolicyExit(kind, _text(reason), _text(message))


def _text(value: bytes) -> str:
    return value.split(b"\0", 1)[0].decode(errors="replace")
