"""The servers of a plan as back ends take them."""

from collections.abc import Iterable, Sequence

from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.flow.plan_checks import refuse_several_hosts
from chainshaper.planning.chain_plan import Server
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError


def server_table(plan: Plan) -> ServerTable:
    """Return the servers of a plan whose threads a back end has to keep inside their slots.

    Raises OperationError: there are none. InputError: the plan's chain goes over several hosts.
    """
    refuse_several_hosts(plan)
    servers = [server for server in plan.servers if set(server.threads) - plan.free_threads]
    if not servers:
        raise OperationError(
            "the plan's servers name no threads of the application, so there is nothing to apply:"
            " plan from a recording (`chainshaper plan REC --chain FIRST..LAST`)"
        )
    return table_of(plan.cycle_ns, servers, plan.most_urgent_first)


def table_of(cycle_ns: int, servers: Iterable[Server], order: Sequence[str] = ()) -> ServerTable:
    """Return servers of a plan without their nodes, whose threads are in this order."""
    return ServerTable(
        cycle_ns,
        tuple(
            ReservationServer(
                server.name,
                server.core,
                server.priority,
                server.slots,
                places=places_in(server, order),
            )
            for server in servers
        ),
    )


def order_in(server: Server, order: Sequence[str]) -> list[str]:
    """Return the nodes of a server that are in the order, in that."""
    in_server = {thread.node for thread in server.threads}
    return [node for node in order if node in in_server]


def places_in(server: Server, order: Sequence[str]) -> int:
    """Return how many places threads of a server have.

    Each node in the order has one; the others share one.
    """
    nodes, ordered = {thread.node for thread in server.threads}, order_in(server, order)
    return max(1, len(ordered) + (len(ordered) < len(nodes)))
