"""The back end `fifo`: servers as SCHED_FIFO priorities, on any kernel, without slots.

Each server's threads get its core and a real-time priority in the order of the servers
(:mod:`.server_threads`). That isolates a chain from what is less important; it does not hold back
anything, so a shaping node's gate has to. Several threads of one server take turns under SCHED_RR.

Who carries out a whole plan has given its threads their priorities already
(:func:`.server_threads.plan_scheduling`), in an order that also knows what no table says, such as
a shaping node. Threads that stand in the journal by then are left as they are.
"""

import time

from chainshaper.enforcement.runs.journal import Journal
from chainshaper.enforcement.runs.scheduling_memory import (
    change_all,
    release_threads,
    remembered_threads,
)
from chainshaper.enforcement.servers import ServerCounters, ServerTable
from chainshaper.enforcement.threads.allocation import NodeThread
from chainshaper.enforcement.threads.server_threads import (
    below_their_siblings,
    server_priorities,
    wanted_of_members,
)
from chainshaper.linux.threads import find_thread
from chainshaper.values.errors import InputError

__all__ = ["Fifo", "create"]


def create(table: ServerTable, journal: Journal) -> "Fifo":
    """Prepare servers; nothing is changed before :meth:`Fifo.arm`.

    What was there is kept in ``journal``.

    Raises:
        InputError: the table has more priorities than there are.
    """
    server_priorities(server.priority for server in table.servers)
    return Fifo(table, journal)


class Fifo:
    """A table of servers in force as priorities; see :class:`.servers.BackEnd`."""

    name = "fifo"

    def __init__(self, table: ServerTable, journal: Journal) -> None:
        self._table = table
        self._journal = journal
        self._members: dict[str, list[NodeThread]] = {s.name: [] for s in table.servers}
        self._scheduled = {one.identity for one in remembered_threads(journal)}
        self._armed = False
        self._since_ns: int | None = None

    def assign(self, tid: int, server: str) -> None:
        """Put a thread into a server; one that has ended is passed over.

        Raises:
            InputError: no such server.
            OperationError: the kernel refuses.
        """
        if server not in self._members:
            raise InputError(f"no server {server!r}: choose of {', '.join(self._members)}")
        thread = find_thread(tid)
        if thread is None or thread.identity in self._scheduled:
            return
        self._scheduled.add(thread.identity)
        self._members[server].append(NodeThread(thread, (), "", ""))
        if self._armed:
            self._schedule()

    def arm(self, anchor_ns: int) -> None:  # noqa: ARG002 - priorities know no cycle
        """Give all threads the priority and core of their servers.

        Raises:
            OperationError: the kernel refuses; what was given before stays until the release.
        """
        self._armed = True
        self._schedule()
        self._since_ns = time.monotonic_ns()

    def in_force_from(self) -> int | None:
        """See :meth:`BackEnd.in_force_from`."""
        return self._since_ns

    def counters(self) -> dict[str, ServerCounters]:
        """Nothing is counted: there are no slots."""
        return {server.name: ServerCounters() for server in self._table.servers}

    def failure(self) -> str | None:
        """None: there is nothing that could stop."""
        return None

    def release(self) -> None:
        """Every thread as it was before.

        Raises:
            OperationError: the kernel refuses for some; the others are as before.
        """
        self._armed = False
        release_threads(self._journal)

    def _schedule(self) -> None:
        wanted = wanted_of_members(self._members, self._table.servers)
        changes = ((one.thread.thread, one.wanted) for one in below_their_siblings(wanted))
        change_all(self._journal, changes)
