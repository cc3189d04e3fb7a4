"""Plans for chains inside a larger graph: several cores, several sinks, a first node apart.

Each step takes a shaped plan and returns one that covers more of the graph (sections 5.1 and
5.4). Within the graph's given assignment of callbacks to cores, shaping needs no new idea: one
server per core while the graph runs, one publish slot per sink.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.latency_file import check_latencies
from chainshaper.planning.plan import (
    Plan,
    Server,
    ShapingNode,
    Thread,
    output_server,
    publish_slots,
    publishing_servers,
    revised,
    wrong_values_refused,
)
from chainshaper.planning.publisher_threads import below_executors
from chainshaper.planning.shaping import OUTPUT_PRIORITY, shaping_node_like
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError

__all__ = ["over_cores", "with_first_node_apart", "with_sink"]


def over_cores(plan: Plan, core_of: Mapping[str, int]) -> Plan:
    """One server per core for the chain's threads, each with the chain's slot (section 5.4).

    ``core_of`` names the core of every node whose executor takes part, also of nodes that the
    plan does not know yet: branches that the chain waits for.

    Raises:
        InputError: a node of the plan is missing.
    """
    chain = _chain_server(plan)
    missing = [thread.node for thread in chain.threads if thread.node not in core_of]
    if missing:
        raise InputError(f"no core is named for {', '.join(missing)}: name one for each node")
    cores = sorted(set(core_of.values()))
    with wrong_values_refused():
        split = [
            Server(
                name=f"{chain.name}_core{core}" if len(cores) > 1 else chain.name,
                core=core,
                priority=chain.priority,
                slots=chain.slots,
                threads=tuple(Thread(node=node) for node, its in core_of.items() if its == core),
            )
            for core in cores
        ]
        others = tuple(server for server in plan.servers if server is not chain)
        return revised(plan, servers=(*split, *others))


def with_first_node_apart(plan: Plan, node: str, slot_end_ns: int) -> Plan:
    """The chain's first node in a server of its own, [0, ``slot_end_ns``), the rest behind it.

    For a chain whose first callback is not a timer: held back until its slot, it starts every
    execution at the beginning of a cycle as if it were one (table 4, rows 2 to 5: [0, 2] and
    [2, 86] ms).

    Raises:
        InputError: the chain's server has no thread of that node, or is shorter than the slot.
    """
    chain = _chain_server(plan)
    (start, end), thread = chain.slots[0], Thread(node=node)
    if thread not in chain.threads:
        raise InputError(f"{node} is no node of the chain's server: name its first node")
    if not start < slot_end_ns < end:
        raise InputError(
            f"the first node's slot must end after {format_duration(start)} and before"
            f" {format_duration(end)}, where the chain's does: not at"
            f" {format_duration(slot_end_ns)}"
        )
    rest = tuple(other for other in chain.threads if other != thread)
    first = chain.model_copy(
        update={"name": "first", "slots": ((start, slot_end_ns),), "threads": (thread,)}
    )
    behind = chain.model_copy(update={"slots": ((slot_end_ns, end),), "threads": rest})
    others = tuple(server for server in plan.servers if server is not chain)
    return revised(plan, servers=(first, behind, *others))


def with_sink(
    plan: Plan,
    latencies_ns: NDArray[np.int64],
    output: str,
    *,
    publisher: str | None = None,
    receivers: Sequence[str] = (),
) -> Plan:
    """A shaped plan with one more shaped output: another sink of the same graph (end of 5.4).

    The sink gets a shaping node of its own, behind its ``publisher`` and before its ``receivers``;
    where the plan's output is published asynchronously, that node's publisher thread is gated
    instead.

    ``latencies_ns`` are those from the start of the graph to this sink. Its publish slot starts
    the plan's margin after the longest of them, or where a publish slot that is in the way on
    the same core ends; the chain's servers stay open as long as the slowest sink needs. The
    plan's prediction goes on to describe its first output.

    Raises:
        InputError: a plan that shapes nothing or publishes in the other way, a sink that it
            shapes already, latencies or a topic that no plan may have.
        OperationError: the slot does not fit into the cycle.
    """
    node, publishing = plan.shaping_node, output_server(plan)
    if publishing is None or not publishing.threads:
        raise InputError("a further sink needs a plan that shapes one output already")
    if output in {plan.chain.output, *(other.output for other in plan.further_shaping_nodes)}:
        raise InputError(f"the plan shapes {output} already: name each sink once")
    slot_start, slot_end = publish_slots(plan)[-1]
    length = slot_end - slot_start
    done = int(check_latencies(latencies_ns).max()) + plan.margin.epsilon_ns
    start = done
    taken = [
        slot
        for server in publishing_servers(plan)
        if server.core == publishing.core
        for slot in server.slots
    ]
    for other_start, other_end in sorted(taken):
        if start < other_end and other_start < start + length:
            start = other_end
    if start + length > plan.cycle_ns:
        raise OperationError(
            f"the sink {output} would be published until {format_duration(start + length)}, after"
            f" the cycle of {format_duration(plan.cycle_ns)}: plan with a longer period, a"
            " shorter slot, or another core for one of the outputs"
        )
    with wrong_values_refused():
        added, thread = _gate_like(node, output, publisher, receivers)
        server = Server(
            name=f"output_{thread.node.strip('/')}",
            core=publishing.core,
            priority=OUTPUT_PRIORITY,
            slots=((start, start + length),),
            threads=(thread,),
        )
        return revised(
            plan,
            servers=below_executors([*_open_until(plan, done), server]),
            further_shaping_nodes=(*plan.further_shaping_nodes, *added),
        )


def _gate_like(
    node: ShapingNode | None, output: str, publisher: str | None, receivers: Sequence[str]
) -> tuple[tuple[ShapingNode, ...], Thread]:
    """The shaping node that a further sink needs, if any, and the thread that publishes it."""
    if node is not None:
        added = shaping_node_like(node, output, publisher, receivers)
        return (added,), added.thread
    if publisher is not None:
        return (), Thread(node=publisher, role="publisher")
    raise InputError(
        f"the plan gates publishers' threads, and who publishes {output} is not known: name it"
    )


def _chain_server(plan: Plan) -> Server:
    found = next((server for server in plan.servers if server.name == "chain"), None)
    if found is None:
        raise InputError("the plan has no server named 'chain': begin with a shaped plan")
    return found


def _open_until(plan: Plan, end: int) -> tuple[Server, ...]:
    """The servers, of which those that run the graph to its end stay open until ``end``."""
    publishing = publishing_servers(plan)
    running = [server for server in plan.servers if server not in publishing]
    latest = max((server.slots[-1][1] for server in running), default=end)
    return tuple(
        server.model_copy(update={"slots": (*server.slots[:-1], (server.slots[-1][0], end))})
        if server in running and server.slots[-1][1] == latest < end
        else server
        for server in plan.servers
    )
