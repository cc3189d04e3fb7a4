"""From a process, a plan, or nothing to go by, to the threads of a running application.

The function behind `chainshaper threads`. It joins what /proc shows with what a recording of the
same processes saw, as far as they are still the same.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from chainshaper.enforcement.threads.allocation import (
    Allocation,
    RecordedProcess,
    allocate,
    strangers_text,
)
from chainshaper.linux.processes import (
    Process,
    descendants,
    find_applications,
    list_processes,
)
from chainshaper.linux.users import run_users
from chainshaper.values.errors import InputError

if TYPE_CHECKING:
    from chainshaper.planning.plan import Plan
    from chainshaper.values.recording import Recording

__all__ = ["find_threads"]


def find_threads(
    where: "int | Plan | None" = None,
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
        nodes = {} if where is None else _planned_nodes(where)
        hosted = None if where is None else nodes.keys() | _receivers(where)
        chosen = tuple(
            process
            for process in processes
            if process.user in taken and _hosts(process, found, hosted)
        )
        strangers = strangers_text(processes, taken, hosted)
        notes += _missing(found, nodes)
        if where is None and not chosen:
            notes += ("no process looks like an application of ROS 2 or DDS",)
    found = allocate(chosen, recorded, processes, taken)
    if recorded and not any(one.nodes_known_by == "recording" for one in found.threads):
        notes += ("none of these processes is in the recording: they were started after it",)
    notes += found.notes + (() if strangers is None else (strangers,))
    return replace(found, notes=notes, strangers=strangers)


def _planned_nodes(plan: "Plan") -> dict[str, str]:
    """The nodes of a plan's servers, with the server's name."""
    return {thread.node: server.name for server in plan.servers for thread in server.threads}


def _receivers(plan: "Plan") -> set[str]:
    """The nodes that receive what a plan's shaping nodes publish; they need not run."""
    from chainshaper.planning.plan import shaping_nodes

    return {receiver for node in shaping_nodes(plan) for receiver in node.receivers}


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
