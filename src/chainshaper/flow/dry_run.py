"""What carrying out a plan would change, before anything is: `chainshaper apply --dry-run`.

Also what both need to know of a plan beside the threads that run: the table of servers for a back
end, and the thread with which the chain begins.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from chainshaper.enforcement.back_ends import choose_back_end
from chainshaper.enforcement.litmus.resctl import litmus_commands
from chainshaper.enforcement.phase import measure_phase
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.threads.allocation import Allocation
from chainshaper.enforcement.threads.server_threads import (
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
    server_members,
)
from chainshaper.flow.thread_search import find_threads
from chainshaper.linux.scheduling import available_cores
from chainshaper.linux.threads import Thread
from chainshaper.planning import Plan
from chainshaper.planning.overruns import open_until_done, refuse_offset
from chainshaper.planning.plan import shaping_nodes
from chainshaper.values.errors import OperationError

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import

__all__ = [
    "LEAD_NS",
    "Changes",
    "first_thread",
    "planned_changes",
    "server_table",
]

LEAD_NS = 2_000_000
"""The cycle starts so long after the chain's timer expires (DESIGN section 6)."""


@dataclass(frozen=True)
class Changes:
    """What a plan would change: threads, or the commands of LITMUS^RT's tools."""

    back_end: str
    reason: str
    threads: tuple[WantedScheduling, ...]
    commands: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def planned_changes(
    plan: Plan,
    back_end: str = "auto",
    *,
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    users: Collection[str | int] = (),
) -> Changes:
    """What :func:`.applying.apply_plan` would do; nothing is changed.

    LITMUS^RT's commands are given on any kernel, with ``TID:NODE`` for threads that do not run.

    Raises: as :func:`.applying.apply_plan`.
    """
    refuse_offset(plan)
    plan = open_until_done(plan)
    table = server_table(plan)
    found = find_threads(plan, recording, users=users)
    if back_end != "litmus":
        choice = choose_back_end(back_end)
        wanted = plan_scheduling(plan, found, available_cores())
        threads = left_by_back_end(choice.name, wanted)
        return Changes(choice.name, choice.reason, threads, (), found.notes)
    notes = found.notes
    try:
        members: dict[str, list[int | str]] = {
            name: [member.thread.tid for member in group]
            for name, group in server_members(plan, found).items()
        }
        if phase_ns is None:
            origin = first_thread(plan, found)
            phase_ns = measure_phase(origin.pid, origin.tid, plan.cycle_ns).at_ns
    except OperationError:
        members = {s.name: [f"TID:{t.node}" for t in s.threads] for s in plan.servers}
        notes += ("slots are counted from a beginning that is measured when the chain runs",)
    anchor = 0 if phase_ns is None else phase_ns + LEAD_NS
    commands = litmus_commands(table, members, anchor)
    return Changes("litmus", "asked for", (), commands, notes)


def server_table(plan: Plan) -> ServerTable:
    """The servers of a plan whose threads a back end has to keep inside their slots.

    Raises:
        OperationError: there are none.
    """
    gated_by_themselves = {node.thread for node in shaping_nodes(plan)}
    servers = tuple(
        ReservationServer(server.name, server.core, server.priority, server.slots)
        for server in plan.servers
        if any(thread not in gated_by_themselves for thread in server.threads)
    )
    if not servers:
        raise OperationError(
            "the plan's servers name no threads of the application, so there is nothing to apply: "
            "plan from a recording (`chainshaper plan REC --chain FIRST..LAST`)"
        )
    return ServerTable(plan.cycle_ns, servers)


def first_thread(plan: Plan, found: Allocation) -> Thread:
    """The thread that begins the chain: the first executor of the server whose slot comes first.

    Raises:
        OperationError: no server holds an executor, or see :func:`.server_members`.
    """
    members = server_members(plan, found)
    for server in sorted(plan.servers, key=lambda one: (one.slots[0][0], one.priority)):
        for member in members[server.name]:
            if member.thread.role == "executor":
                return member.thread
    raise OperationError(
        "no server of the plan holds an executor, so nothing says where in a cycle the chain "
        "begins: give its phase (--phase)"
    )
