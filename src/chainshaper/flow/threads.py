"""The threads of a running application, and what each of them does.

What /proc shows is joined with what a recording of the same processes saw
(:mod:`.recorded_processes`).
"""

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from chainshaper.enforcement.node_threads import (
    Allocation,
    RecordedProcess,
    allocate,
    strangers_text,
    with_gates,
)
from chainshaper.enforcement.planned_threads import absent_receivers
from chainshaper.flow.recorded_processes import evidence_of, recorded_in
from chainshaper.linux import processes as running
from chainshaper.linux.processes import RunningProcess, list_processes
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import InputError
from chainshaper.values.middleware import ROUTERS

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


def find_threads(
    where: int | Plan | None = None,
    recording: "Recording | None" = None,
    *,
    recorded: Sequence[RecordedProcess] | None = None,
    users: Collection[str | int] = (),
) -> Allocation:
    """Find the threads of an application and what each of them does.

    ``where`` is a process, which stands for its descendants too; a plan, for the nodes of its
    servers, its receivers and its loops; or None for all that looks like an application of ROS 2 or
    DDS.
    ``recording`` is one of the processes that still run, or of an earlier run (default: those that
    the plan names); a caller that looks often gives its processes, ``recorded``, instead. Only
    processes of ``users`` (names or numbers; default: the user who launched us, and root) are
    nodes; a process that is asked for is a node whoever runs it.

    Raises InputError: there is no such process, or no such user.
    """
    processes, taken = list_processes(), running.run_users(users)
    plan = None if where is None or isinstance(where, int) else where
    shaping = () if plan is None else plan.shaping_nodes
    notes, strangers = tuple[str, ...](), None
    if recorded is None:
        recorded, notes = recorded_in(*evidence_of(plan, recording))
    if isinstance(where, int):
        chosen = _family_of(where, processes)
        taken |= {process.user for process in chosen if process.user is not None}
    else:
        candidates = running.find_applications(processes)
        allocation = with_gates(allocate(candidates, recorded, processes, taken), shaping)
        nodes_in = defaultdict[int, set[str]](set)  # by pid
        for listed in allocation.threads:
            nodes_in[listed.thread.pid].update(listed.nodes)
        hosted = None if plan is None else ROUTERS.union(*_planned_nodes(plan))
        chosen = [
            process
            for process in processes
            if process.user in taken
            and _is_wanted(process, nodes_in.get(process.pid, set()), hosted)
        ]
        strangers = strangers_text(processes, taken, hosted)
        notes += _missing(plan, sorted(set().union(*nodes_in.values())))
        if plan is None and not chosen:
            notes += ("no process looks like an application of ROS 2 or DDS",)
    allocation = with_gates(allocate(chosen, recorded, processes, taken), shaping)
    if recorded and not any(listed.nodes_known_by == "recording" for listed in allocation.threads):
        notes += ("none of these processes is in the recording: they were started after it",)
    notes += allocation.notes
    if strangers is not None:
        notes += (strangers,)
    return replace(allocation, notes=notes, strangers=strangers)


def _family_of(pid: int, processes: Sequence[RunningProcess]) -> list[RunningProcess]:
    """Return a process and its descendants. Raises InputError: it does not run."""
    parent_of = {process.pid: process.parent for process in processes}
    if pid not in parent_of:
        raise InputError(f"no process {pid}: it has ended, or is the kernel's own")
    family = running.descendants(parent_of, pid)
    return [process for process in processes if process.pid in family]


def _planned_nodes(plan: Plan) -> tuple[set[str], set[str]]:
    """Return the nodes of a plan's servers, and its receivers and loops, which need not run."""
    in_servers = {thread.node for server in plan.servers for thread in server.threads}
    receivers = {receiver for node in plan.shaping_nodes for receiver in node.receivers}
    loops = {chain.loop.node for chain in plan.chains if chain.loop is not None}
    return in_servers, receivers | loops


def _is_wanted(process: RunningProcess, nodes: set[str], hosted: frozenset[str] | None) -> bool:
    """Return whether a process has one of the nodes that a plan needs (None: any node)."""
    if hosted is None:
        return bool(nodes) or process.participates
    return not nodes.isdisjoint(hosted)


def _missing(plan: Plan | None, there: Sequence[str]) -> tuple[str, ...]:
    """Return sentences about the nodes of a plan that are not among those ``there``."""
    if plan is None:
        return ()
    seen = f"is not running, or cannot be recognised; running: {', '.join(there) or 'no node'}"
    planned = {thread.node: server.name for server in plan.servers for thread in server.threads}
    notes = [
        f"node {node} of server {server} {seen}"
        for node, server in planned.items()
        if node not in there
    ]
    absent = absent_receivers(plan.shaping_nodes, there)
    return tuple(notes) if absent is None else (*notes, absent)
