"""Reservation servers as the back ends see them, and what every back end can do.

A **table** has servers with slots that repeat every cycle (paper, section 2.2.1). Between its slots
a server's threads do not run at all (the back end ``fifo`` isolates only). Where slots of several
servers overlap on a core, the server with the smaller priority number runs. Within a server the
threads of the first place are the most urgent (``litmus``: threads take turns). Threads outside
servers run when no thread of a server wants to.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from chainshaper.values.errors import InputError


@dataclass(frozen=True)
class ReservationServer:
    """A server of a plan, for processes that have nothing but Python's standard library."""

    name: str
    core: int
    priority: int  # the smaller, the more urgent
    slots: tuple[tuple[int, int], ...]  # [start, end) in ns after the start of a cycle, ascending
    places: int = field(default=1, kw_only=True)  # how many degrees of urgency its threads have


@dataclass(frozen=True)
class ServerTable:
    """All servers that are in force together, and the cycle time that they share (ns)."""

    cycle_ns: int
    servers: tuple[ReservationServer, ...]


def server_named(table: ServerTable, name: str) -> ReservationServer:
    """Return the server of a name. Raises InputError: there is none."""
    servers = {server.name: server for server in table.servers}
    if name not in servers:
        raise InputError(f"no server is named {name}: {', '.join(servers)} are")
    return servers[name]


@dataclass(frozen=True)
class ServerCounters:
    """What a server has done since it was armed; None: the back end cannot know."""

    slots: int | None = None
    late_entries: int | None = None  # slots entered more than 100 us after their start
    longest_lateness_ns: int | None = None
    overruns: int | None = None  # slots at whose end a thread still wanted to run


class BackEnd(ABC):
    """Puts a table of servers in force on this machine.

    Making a back end changes nothing that an application could notice. ``assign`` and ``arm`` may
    be called in any order, any number of times; ``release`` ends it. All raise OperationError where
    the kernel refuses.
    """

    def __init__(self, table: ServerTable) -> None:
        self._table = table
        self._since_ns: int | None = None

    @abstractmethod
    def assign(self, tid: int, server: str, place: int = 0) -> None:
        """Put a thread into a server; before ``arm`` it runs on freely.

        ``place`` says how urgent it is there (0: the most), for back ends that choose between a
        server's threads. A thread that has ended is passed over. Raises InputError: no such server.
        """

    @abstractmethod
    def arm(self, anchor_ns: int) -> None:
        """Enforce the slots from now on; cycles start at ``anchor_ns`` (CLOCK_MONOTONIC) + k * CT.

        Another anchor moves the cycles without letting threads slip between. Where the kernel
        refuses, what was done before stays until the release.
        """

    def in_force_from(self) -> int | None:
        """Return since when the latest ``arm`` is enforced (CLOCK_MONOTONIC, ns); None: never."""
        return self._since_ns

    def counters(self) -> dict[str, ServerCounters]:
        """Return the counters of each server since the first ``arm``, by the server's name."""
        return {server.name: ServerCounters() for server in self._table.servers}

    def failure(self) -> str | None:
        """Say why the servers are no longer enforced; None: they are."""
        return None

    @abstractmethod
    def release(self) -> None:
        """Put everything back as it was before, as far as possible; harmless when repeated."""
