"""The threads of an application under a plan: found, scheduled, and put into their servers."""

import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.node_threads import (
    LEFT_ALONE,
    Allocation,
    RecordedProcess,
    new_and_ended,
)
from chainshaper.enforcement.planned_threads import (
    NOT_RECOGNISED,
    absent_receivers,
    place_of,
    server_members,
)
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import BackEnd
from chainshaper.enforcement.thread_scheduling import (
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
)
from chainshaper.enforcement.undoing import ServerState
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.flow.server_tables import order_in
from chainshaper.flow.threads import find_threads
from chainshaper.linux.child_processes import end_in_words
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError
from chainshaper.values.progress import Progress

LOOK_S = 1.0
GATE_START_NS = 10_000_000_000  # a shaping node appears so long after all others, or never
_SETTLING_LOOKS = 3  # nodes that have just started go on to start threads for a while


@dataclass
class RunThreads:
    """The application's threads at the latest look, and what is needed to look again."""

    journal: Journal
    recorded: tuple[RecordedProcess, ...]
    users: frozenset[int]
    unread: tuple[str, ...] = ()  # recordings that say nothing of this machine, or cannot be read
    latest: Allocation = field(default_factory=lambda: Allocation((), ()))

    def find(self, plan: Plan) -> Allocation:
        """Look which threads the plan's application has now."""
        return find_threads(plan, recorded=self.recorded, users=self.users)

    def schedule(self, plan: Plan, back_end: str) -> tuple[WantedScheduling, ...]:
        """Give threads their priorities and cores, as far as the back end leaves that to us."""
        wanted = plan_scheduling(plan, self.latest, available_cores())
        left = left_by_back_end(back_end, wanted, plan.free_threads)
        change_all(self.journal, ((item.node_thread.thread, item.scheduling) for item in left))
        return left


def await_nodes(
    threads: RunThreads,
    plan: Plan,
    wait_ns: int,
    *,
    command: subprocess.Popen[bytes] | None,
    stop: threading.Event,
    go_on: Callable[[], None],
    progress: Progress,
) -> None:
    """Look until all nodes of the plan run; where there is time, a little for late threads.

    ``go_on`` raises when the run is to end. Raises OperationError: a node is not running in time.
    """
    shaping = {node.thread.node for node in plan.shaping_nodes}
    begun, looks, before, others_ns = time.monotonic_ns(), 0, None, 0
    while True:
        go_on()
        threads.latest = threads.find(plan)
        waited = time.monotonic_ns() - begun
        try:
            server_members(plan, threads.latest)
            looks += 1
        except OperationError:
            looks = 0
            missing = _missing_nodes(plan, threads.latest)
            others_ns = waited if missing - shaping else others_ns
            has_ended = command is not None and command.poll() is not None
            over = has_ended or waited >= min(wait_ns, others_ns + GATE_START_NS)
            if over and missing and missing <= shaping:
                raise OperationError(_without_shaping_nodes(missing)) from None
            if has_ended and command is not None:
                ended = f"the command {end_in_words(command.returncode)} before all nodes"
                named = ", ".join(sorted(missing))
                reason = f"{ended} of the plan were running: {named or 'all'} were not"
                raise OperationError(reason) from None
            if waited >= wait_ns:
                raise
        quiet = before is not None and not any(new_and_ended(before, threads.latest))
        if looks and (quiet or looks > _SETTLING_LOOKS or waited >= wait_ns):
            return
        before = threads.latest
        progress(min(1.0, waited / wait_ns), "finding the nodes")
        stop.wait(min(LOOK_S, (wait_ns - waited) / 1e9))


def _missing_nodes(plan: Plan, allocation: Allocation) -> set[str]:
    """The nodes of servers that do not run."""
    wanted = {thread.node for server in plan.servers for thread in server.threads}
    return wanted - {node for listed in allocation.threads for node in listed.nodes}


def _without_shaping_nodes(missing: set[str]) -> str:
    return (
        f"the plan's shaping node {', '.join(sorted(missing))} is not running, all other nodes are:"
        " start it too (`chainshaper splice`, or `shape` where it is described),"
        " or plan without one (--policy server-per-chain)"
    )


def assign_threads(
    threads: RunThreads,
    anchored: AnchoredPlan,
    servers: BackEnd,
    report: RunReport,
    go_on: Callable[[], None],
) -> None:
    """Put the threads that are not in their servers yet there."""
    plan = anchored.plan
    free_nodes = {thread.node for thread in plan.free_threads}
    already = {server.name: server.threads for server in report.state.servers}
    members = server_members(plan, threads.latest)
    order = {server.name: order_in(server, plan.most_urgent_first) for server in plan.servers}
    for name, group in members.items():
        for member in group:
            go_on()
            tid = member.thread.tid
            if tid not in already[name] and free_nodes.isdisjoint(member.nodes):
                with anchored.lock:
                    servers.assign(tid, name, place_of(member, order[name]))

    def with_threads(server: ServerState) -> ServerState:
        return replace(server, threads=tuple(item.thread.tid for item in members[server.name]))

    report.update_servers(with_threads)


def note_strangers(report: RunReport, allocation: Allocation) -> None:
    """One line about strangers who say they are nodes: the latest replaces the one before."""
    if allocation.strangers is not None:
        report.replace_notes(LEFT_ALONE, allocation.strangers)


def note_absent(
    report: RunReport, plan: Plan, allocation: Allocation, unread: tuple[str, ...]
) -> None:
    """One line about receivers that do not run, or are not recognised, for as long as so.

    It ends with why recordings say nothing of them (``unread``).
    """
    running = {node for listed in allocation.threads for node in listed.nodes}
    absent = absent_receivers(plan.shaping_nodes, running)
    if absent is None:
        report.replace_notes(NOT_RECOGNISED)
    else:
        reasons = "".join(f"; {reason}" for reason in unread)
        report.replace_notes(NOT_RECOGNISED, absent + reasons)
