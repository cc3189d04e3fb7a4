"""Find the running threads that belong into the servers of a plan."""

from collections.abc import Collection, Iterable, Iterator, Sequence

from chainshaper.enforcement.node_threads import Allocation, NodeThread, ambiguous_node
from chainshaper.planning.chain_plan import ChainPlan, Server, ShapingNode, Thread, shaping_nodes
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError

NOT_RECOGNISED = "not running, or not recognised: "


def server_members(plan: Plan, allocation: Allocation) -> dict[str, tuple[NodeThread, ...]]:
    """Return the running threads of each server of a plan, by the server's name.

    Raises OperationError: a planned thread is not running, two processes are the same node, or one
    thread executes nodes of two servers.
    """
    homes: dict[tuple[int, int], str] = {}
    members: dict[str, tuple[NodeThread, ...]] = {}
    for server in plan.servers:
        running = [
            listed for planned in server.threads for listed in threads_for(planned, allocation)
        ]
        for listed in running:
            home = homes.setdefault(listed.thread.identity, server.name)
            if home != server.name:
                raise OperationError(
                    f"{listed.thread.text} executes {', '.join(listed.nodes)}, which the plan has"
                    f" in the servers {home} and {server.name}: put them into one server, or start"
                    " them as processes of their own"
                )
        unique = {listed.thread.identity: listed for listed in running}
        members[server.name] = tuple(unique.values())
    return members


def threads_for(planned: Thread, allocation: Allocation) -> list[NodeThread]:
    """Return the running threads that a thread of a plan stands for.

    Raises OperationError: as :func:`server_members`.
    """
    owners = [listed for listed in allocation.threads if planned.node in listed.nodes]
    pids = sorted({listed.thread.pid for listed in owners})
    if len(pids) > 1:
        raise OperationError(ambiguous_node(planned.node, pids))
    if not pids:
        running = sorted({node for listed in allocation.threads for node in listed.nodes})
        if not running:
            raise OperationError(
                f"no node of the plan runs, nor any other: start the robot first, or let it be"
                f" started: `chainshaper apply plan.yaml -- COMMAND` (waited for: {planned.node})"
                + (f"; {allocation.strangers}" if allocation.strangers else "")
            )
        raise OperationError(
            f"node {planned.node} of the plan is not running, or cannot be recognised; running: "
            f"{', '.join(running)}; start it with `--ros-args -r __node:=NAME`, or"
            " name a recording of it"
            + (f"; {allocation.strangers}" if allocation.strangers else "")
        )
    process = f"process {pids[0]} of node {planned.node}"
    with_role = [listed for listed in owners if listed.thread.role == planned.role]
    if not with_role:
        missing = "executor: name a recording of this very process (--recording)"
        if planned.role == "publisher":
            missing = (
                "asynchronous publisher, which Fast DDS alone has, if RMW_FASTRTPS_PUBLICATION_MODE"
                " is ASYNCHRONOUS: plan with --publication synchronous"
            )
        raise OperationError(
            f"{process} has no thread that is known to be its {missing}, or see "
            f"`chainshaper threads {pids[0]}`"
        )
    if not planned.callbacks:
        return with_role
    wanted = {(planned.node, name) for name in planned.callbacks}
    running_them = [listed for listed in with_role if not wanted.isdisjoint(listed.callbacks)]
    if not running_them:
        recorded = sorted({name for listed in with_role for _, name in listed.callbacks})
        raise OperationError(
            f"{process}: which of its threads runs {', '.join(planned.callbacks)} is not known"
            + (f" (known are those that run {', '.join(recorded)})" if recorded else "")
            + ": name a recording of it, or of an earlier run of the same program (--recording)"
        )
    return running_them


def absent_receivers(nodes: Iterable[ShapingNode], running: Collection[str]) -> str | None:
    """Return a line about receivers of outputs that do not run; None: all do."""
    absent = [
        f"{receiver}, which receives {node.output}"
        for node in nodes
        for receiver in node.receivers
        if receiver not in running
    ]
    if not absent:
        return None
    named = ", ".join(dict.fromkeys(absent))
    return (
        f"{NOT_RECOGNISED}{named}: callbacks there keep their priority and cores, and may wait for"
        " the chain. Where a node runs, but no command line names it (as in a container), name a"
        " recording of it (--recording)"
    )


def first_planned(chain: ChainPlan) -> Thread | None:
    """Return the thread that begins a chain: the first executor in the order of slots.

    Those of shaping nodes do not count.
    """
    for _, planned in in_order_of_slots(chain):
        if planned.role == "executor":
            return planned
    return None


def in_order_of_slots(chain: ChainPlan) -> Iterator[tuple[Server, Thread]]:
    """Yield the planned threads of a chain with their servers, without those of shaping nodes."""
    gates = {node.thread for node in shaping_nodes(chain)}
    for server in sorted(chain.servers, key=lambda server: (server.slots[0][0], server.priority)):
        yield from ((server, planned) for planned in server.threads if planned not in gates)


def closed_before(chain: ChainPlan) -> int | None:
    """Return how long before a cycle (ns) the server of the chain's first thread closes.

    None: that server never closes.
    """
    slots = next(in_order_of_slots(chain))[0].slots
    is_always_open = slots[0][0] == 0 and slots[-1][1] >= chain.cycle_ns
    return None if is_always_open else chain.cycle_ns - slots[-1][1]


def place_of(listed: NodeThread, order: Sequence[str]) -> int:
    """Return a thread's place in an order of nodes: that of its first node, or behind all."""
    return min((order.index(node) for node in listed.nodes if node in order), default=len(order))
