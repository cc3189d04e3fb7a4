"""Gating asynchronous publishers of the live workload (paper, section 3.2.1, design 1).

Everything about the nodes is known here, since they are ours: which process each is, and when
cycles start. So nothing has to be found or measured, and the thread of each publisher that the plan
names goes into its server; executors and DDS threads of the same process run on.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from chainshaper.enforcement.back_ends import choose_back_end, make_back_end
from chainshaper.enforcement.runs.guardian import run_claimed
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.linux.threads import list_threads
from chainshaper.planning import Plan
from chainshaper.planning.overruns import open_until_done
from chainshaper.planning.plan import publisher_servers
from chainshaper.values.errors import OperationError
from chainshaper.workload.live import StartedNodes

__all__ = ["publishers_gated"]


@contextmanager
def publishers_gated(plan: Plan, nodes: StartedNodes) -> Iterator[None]:
    """Inside, the publisher threads that a plan names run in the slots of their servers only.

    Raises:
        PlatformError: threads cannot be frozen here.
        OperationError: another run governs one of the cores or nodes, a node has no such thread,
            or the servers failed meanwhile.
    """
    choice = choose_back_end("freezer")  # the others want threads that nobody scheduled before
    held = [(server, names) for _, server, names in publisher_servers(open_until_done(plan))]
    table = ServerTable(
        plan.cycle_ns,
        tuple(ReservationServer(s.name, s.core, s.priority, s.slots) for s, _ in held),
    )
    cores = {server.core for server, _ in held}
    with run_claimed(cores, {name for _, names in held for name in names}) as journal:
        servers = make_back_end(choice.name, table, journal)
        try:
            for server, names in held:
                for name in names:
                    for tid in _publisher_threads(name, nodes):
                        servers.assign(tid, server.name)
            servers.arm(nodes.anchor_ns)
            yield
            failure = servers.failure()
        finally:
            servers.release()
    if failure is not None:
        raise OperationError(f"the servers failed while the application ran: {failure}")


def _publisher_threads(node: str, nodes: StartedNodes) -> list[int]:
    pid = nodes.pids.get(node)
    found = [t.tid for t in list_threads(pid) if t.role == "publisher"] if pid is not None else []
    if not found:
        raise OperationError(
            f"{node} has no thread that publishes for it: let it publish asynchronously "
            "(`publication: asynchronous` under `topics`), or plan with --publication synchronous"
        )
    return found
