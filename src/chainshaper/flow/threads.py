"""The threads of a running application, and what carrying out a plan would change of them.

The functions behind `chainshaper threads` and `chainshaper apply --dry-run`; nothing is changed.
What /proc shows is joined with what a recording of the same processes saw, as far as they are still
the same.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from chainshaper.enforcement import threads as allocation
from chainshaper.enforcement.back_ends import choose_back_end
from chainshaper.enforcement.litmus import litmus_commands
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.threads import Allocation, RecordedProcess, WantedScheduling, allocate
from chainshaper.flow.phase import measure_phase
from chainshaper.linux.processes import (
    Process,
    descendants,
    find_applications,
    list_processes,
    run_users,
)
from chainshaper.linux.scheduling import available_cores
from chainshaper.linux.threads import Thread
from chainshaper.planning.overruns import open_until_done, refuse_offset
from chainshaper.planning.plan import Plan, Server, shaping_nodes
from chainshaper.values.errors import InputError, OperationError

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


LEAD_NS = 2_000_000
"""The cycle starts so long after the chain's timer expires (DESIGN section 6)."""


def find_threads(
    where: int | Plan | None = None,
    recording: "Recording | None" = None,
    *,
    recorded: Sequence[RecordedProcess] = (),
    users: Collection[str | int] = (),
) -> Allocation:
    """Find the threads of an application and what each of them does.

    ``where`` is a process, which stands for its descendants too; a plan, for the nodes of its
    servers; or None for all that looks like an application of ROS 2 or DDS. ``recording`` is one
    of the processes that still run, if there is one; who looks often gives what it says about them,
    ``recorded``, instead. Only processes of ``users`` (names or numbers; default: who launched us,
    and root) are nodes; a process that is asked for is, whoever runs it.

    Raises:
        InputError: there is no such process, or no such user.
    """
    processes, taken = list_processes(), run_users(users)
    notes: tuple[str, ...] = ()
    strangers = None
    if recording is not None:
        # Reading events is slow to import: only who has a recording pays for it.
        from chainshaper.flow.recorded_threads import recorded_processes

        recorded, notes = recorded_processes(recording)
    if isinstance(where, int):
        family = descendants({process.pid: process.parent for process in processes}, where)
        chosen = tuple(process for process in processes if process.pid in family)
        if not any(process.pid == where for process in chosen):
            raise InputError(f"no process {where}: it has ended, or is the kernel's own")
        taken |= {process.user for process in chosen if process.user is not None}
    else:
        found = allocate(find_applications(processes), recorded, processes, taken)
        servers = () if where is None else where.servers
        nodes = {thread.node: server.name for server in servers for thread in server.threads}
        gates = () if where is None else shaping_nodes(where)
        # Receivers need not run.
        hosted = None if where is None else nodes.keys() | {r for g in gates for r in g.receivers}
        chosen = tuple(
            process
            for process in processes
            if process.user in taken and _hosts(process, found, hosted)
        )
        strangers = allocation.strangers_text(processes, taken, hosted)
        notes += _missing(found, nodes)
        if where is None and not chosen:
            notes += ("no process looks like an application of ROS 2 or DDS",)
    found = allocate(chosen, recorded, processes, taken)
    if recorded and not any(one.nodes_known_by == "recording" for one in found.threads):
        notes += ("none of these processes is in the recording: they were started after it",)
    notes += found.notes + (() if strangers is None else (strangers,))
    return replace(found, notes=notes, strangers=strangers)


def _hosts(process: Process, found: Allocation, nodes: Collection[str] | None) -> bool:
    """Whether a process has one of these nodes; if None, any node, or takes part in DDS."""
    own = {node for one in found.threads if one.thread.pid == process.pid for node in one.nodes}
    if nodes is None:
        return bool(own) or process.participates
    return not own.isdisjoint(nodes)


def _missing(found: Allocation, nodes: dict[str, str]) -> tuple[str, ...]:
    running = {node for one in found.threads for node in one.nodes}
    return tuple(
        f"node {node} of server {server} is not running, or cannot be recognised; running: "
        f"{', '.join(sorted(running)) or 'no node'}"
        for node, server in nodes.items()
        if node not in running
    )


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
    """What :func:`.apply_plan` would do; nothing is changed.

    LITMUS^RT's commands are given on any kernel, with ``TID:NODE`` for threads that do not run.

    Raises: as :func:`.apply_plan`.
    """
    refuse_offset(plan)
    plan = open_until_done(plan)
    table = server_table(plan)
    found = find_threads(plan, recording, users=users)
    if back_end != "litmus":
        choice = choose_back_end(back_end)
        wanted = allocation.plan_scheduling(plan, found, available_cores())
        threads = allocation.left_by_back_end(choice.name, wanted)
        return Changes(choice.name, choice.reason, threads, (), found.notes)
    notes = found.notes
    try:
        members: dict[str, list[int | str]] = {
            name: [member.thread.tid for member in group]
            for name, group in allocation.server_members(plan, found).items()
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

    Raises OperationError: there are none.
    """
    gated_by_themselves = {node.thread for node in shaping_nodes(plan)}
    servers = [
        server
        for server in plan.servers
        if any(thread not in gated_by_themselves for thread in server.threads)
    ]
    if not servers:
        raise OperationError(
            "the plan's servers name no threads of the application, so there is nothing to apply: "
            "plan from a recording (`chainshaper plan REC --chain FIRST..LAST`)"
        )
    return table_of(plan.cycle_ns, servers)


def table_of(cycle_ns: int, servers: Iterable[Server]) -> ServerTable:
    """Servers of a plan without their nodes."""
    bare = (ReservationServer(one.name, one.core, one.priority, one.slots) for one in servers)
    return ServerTable(cycle_ns, tuple(bare))


def first_thread(plan: Plan, found: Allocation) -> Thread:
    """The thread that begins the chain: the first executor of the server whose slot comes first.

    Raises OperationError: no server holds an executor, or see :func:`.server_members`.
    """
    members = allocation.server_members(plan, found)
    for server in sorted(plan.servers, key=lambda one: (one.slots[0][0], one.priority)):
        for member in members[server.name]:
            if member.thread.role == "executor":
                return member.thread
    raise OperationError(
        "no server of the plan holds an executor, so nothing says where in a cycle the chain "
        "begins: give its phase (--phase)"
    )
