"""Latency shaping: from measured latencies to the chain's server and its publish slots.

The chain runs in a server that is open from the start of a cycle until every execution seen so far
was complete, and its output is published in a server whose slot comes then: late for most cycles,
but at the same time in all of them (paper, sections 3.1 and 3.2).

:func:`plan_shaping` plans one chain; further steps take its plan and return one that covers more of
a graph (sections 5.1 and 5.4). Within the graph's given assignment of callbacks to cores, shaping
needs no new idea: one server per core while the graph runs, one publish slot per sink.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import predict_bands
from chainshaper.planning.margins import EPSILON_NS, check_latencies
from chainshaper.planning.plan import (
    ChainOfPlan,
    Evidence,
    Margin,
    Plan,
    Server,
    ShapingNode,
    Thread,
    below_executors,
    output_server,
    publish_slots,
    publishing_servers,
    revised,
    until,
    with_slots,
)
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Wishes
from chainshaper.values.yaml_file import wrong_values_refused

OUTPUT_PRIORITY = 1  # better than the chain's: a publish slot inside its slot has to pre-empt it
CHAIN_PRIORITY = 2
PAUSE_NS = 2_000_000  # a receiver on a slow machine takes a millisecond to get to its callback

_WISHES = {field.name for field in fields(Wishes)}


def plan_shaping(
    latencies_ns: NDArray[np.int64],
    period_ns: int,
    *,
    wishes: Wishes | None = None,
    margin: Margin | None = None,
    nodes: Sequence[str] = (),
    core: int = 1,
    output_core: int | None = None,
    fifo_priority: int = 84,
    receivers: Sequence[str] = (),
    **values: Any,
) -> Plan:
    """Plan single-band shaping: one publish slot right behind the longest latency measured.

    With L̄ the longest latency, ε the margin, Δ the length of the publish slot and CT the period,
    the chain's server R_m gets the slot [0, L̄ + ε) (eq. 1) and the output's server R_m° gets [L̄ +
    ε, L̄ + ε + Δ) (eq. 4 with a shaping node, eq. 2 with an asynchronous publisher thread), in the
    same cycle (eq. 3). R_m° gets the better priority and, unless ``output_core`` says otherwise,
    the same core.

    Args:
        latencies_ns: every end-to-end latency to be covered; leave out beforehand what the chain
            is not to be planned for.
        period_ns: the chain's period.
        wishes, margin: ε is the margin's or, without one, 1 ms unless the wishes say otherwise.
        nodes: those whose executors run the chain's callbacks.
        core, output_core: cores of the two servers.
        fifo_priority, receivers: for the shaping node.
        values: fields of :class:`~chainshaper.planning.plan.ChainOfPlan` (without ``output`` the
            plan names no publishing thread: it can be studied, not carried out), single
            :class:`~chainshaper.values.plan_choices.Wishes`, and how the latencies were taken:
            fields of :class:`~chainshaper.planning.plan.Evidence`.

    Raises:
        InputError: latencies or values that no plan may have.
        OperationError: L̄ + ε + Δ does not fit into the period.
    """
    latencies = check_latencies(latencies_ns)
    of_chain = {n: values.pop(n) for n in ChainOfPlan.model_fields.keys() & values.keys()}
    wishes = replace(wishes or Wishes(), **{n: values.pop(n) for n in _WISHES & values.keys()})
    given = EPSILON_NS if wishes.epsilon_ns is None else wishes.epsilon_ns
    epsilon = given if margin is None else margin.epsilon_ns
    if epsilon < 0 or wishes.publish_slot_ns <= 0 or period_ns <= 0:
        raise InputError(
            "epsilon must be 0ms or more, the publish slot and the period longer than 0ms;"
            f" found {format_duration(epsilon)}, {format_duration(wishes.publish_slot_ns)} and"
            f" {format_duration(period_ns)}"
        )
    chain_end = int(latencies.max()) + epsilon
    slot_end = chain_end + wishes.publish_slot_ns
    _refuse_too_long(int(latencies.max()), epsilon, wishes.publish_slot_ns, period_ns)
    output_core = core if output_core is None else output_core
    with wrong_values_refused(Plan):
        chain = ChainOfPlan(period_ns=period_ns, **of_chain)
        node, gated = _gate(chain, wishes, output_core, fifo_priority, receivers)
        return Plan(
            chain=chain,
            evidence=evidence_of(latencies, **values),
            margin=margin or Margin(epsilon_ns=epsilon),
            policy="shaped",
            cycle_ns=period_ns,
            anchor=wishes.anchor,
            overrun=wishes.overrun or "publish",
            messages=wishes.messages,
            fallback=wishes.fallback,
            servers=(
                Server(
                    name="chain",
                    core=core,
                    priority=CHAIN_PRIORITY,
                    slots=((0, chain_end),),
                    threads=tuple(Thread(node=name) for name in nodes),
                ),
                Server(
                    name="output",
                    core=output_core,
                    priority=OUTPUT_PRIORITY,
                    slots=((chain_end, slot_end),),
                    threads=gated,
                ),
            ),
            shaping_node=node,
            predicted=predict_bands(latencies, [slot_end], wishes.publish_slot_ns),
        )


def _gate(
    chain: ChainOfPlan, wishes: Wishes, core: int, fifo_priority: int, receivers: Sequence[str]
) -> tuple[ShapingNode | None, tuple[Thread, ...]]:
    """The shaping node of a chain's output, if any, and the threads that publish it."""
    if wishes.publication == "asynchronous":
        if chain.publisher is not None:
            return None, (Thread(node=chain.publisher, role="publisher"),)
        if chain.output is not None:
            raise InputError(
                "asynchronous publication gates the publisher's own thread: name the node that"
                " publishes the chain's output"
            )
    if chain.output is None:
        return None, ()
    pause = min(PAUSE_NS, chain.period_ns // 20) if wishes.pause_ns is None else wishes.pause_ns
    node = ShapingNode(
        **_names(chain.output),
        depth=wishes.depth,
        core=core,
        fifo_priority=fifo_priority,
        spin_ns=wishes.spin_ns,
        pause_ns=pause,
        receivers=tuple(receivers),
    )
    return node, (node.thread,)


def _names(output: str) -> dict[str, str]:
    # The chain publishes on a topic of its own, and the shaping node takes over the output's.
    name = "chainshaper" + output.replace("/", "_")
    return {"name": name, "input": f"{output}_tmp", "output": output}


def shaping_node_like(
    node: ShapingNode, output: str, publisher: str | None, receivers: Sequence[str] = ()
) -> ShapingNode:
    """A shaping node for another topic, with the core, priority and waiting of a given one."""
    others = {**_names(output), "publisher": publisher, "receivers": tuple(receivers)}
    return ShapingNode.model_validate({**node.model_dump(), **others})


def evidence_of(latencies_ns: NDArray[np.int64], **conditions: Any) -> Evidence:
    """The latencies' statistics, with the conditions they were taken under: Evidence's fields."""
    return Evidence(
        samples=int(latencies_ns.size),
        min_latency_ns=int(latencies_ns.min()),
        mean_latency_ns=round(int(latencies_ns.sum()) / latencies_ns.size),
        max_latency_ns=int(latencies_ns.max()),
        **conditions,
    )


def _refuse_too_long(longest: int, epsilon: int, publish_slot: int, period: int) -> None:
    missing = longest + epsilon + publish_slot - period
    if missing <= 0:
        return
    remedies = ["a longer period", "a shorter chain"]
    if longest + epsilon < period:
        remedies.insert(0, f"a publish slot of {format_duration(period - longest - epsilon)}")
    if longest + publish_slot <= period:
        remedies.insert(0, f"a margin of {format_duration(period - longest - publish_slot)}")
    if longest >= period:
        remedies.append("a pipeline over several cores (section 3.1 of the paper)")
    raise OperationError(
        f"the longest latency {format_duration(longest)}, the margin {format_duration(epsilon)} and"
        f" the publish slot {format_duration(publish_slot)} do not fit into the cycle of"
        f" {format_duration(period)}: {format_duration(missing)} too long. What helps:"
        f" {', or '.join(remedies)}."
    )


def over_cores(plan: Plan, core_of: Mapping[str, int]) -> Plan:
    """One server per core for the chain's threads, each with the chain's slot (section 5.4).

    ``core_of`` names the core of every node whose executor takes part, also of nodes that the plan
    does not know yet: branches that the chain waits for.

    Raises:
        InputError: a node of the plan is missing.
    """
    chain = _chain_server(plan)
    missing = [thread.node for thread in chain.threads if thread.node not in core_of]
    if missing:
        raise InputError(f"no core is named for {', '.join(missing)}: name one for each node")
    cores = sorted(set(core_of.values()))
    with wrong_values_refused(Plan):
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

    For a chain whose first callback is not a timer: stopped until its slot, it starts every
    execution at the beginning of a cycle as if it were one (table 4, rows 2 to 5: [0, 2] and [2,
    86] ms).

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

    The sink gets a shaping node behind its ``publisher`` and before its ``receivers``; where the
    plan's output is published asynchronously, that node's publisher thread is gated instead.
    ``latencies_ns`` are those from the start of the graph to this sink. Its slot starts the plan's
    margin after the longest, or where a publish slot that is in the way on the same core ends; the
    chain's servers stay open as long as the slowest sink needs. The prediction stays that of the
    first output.

    Raises:
        InputError: a plan that shapes nothing or publishes in the other way, a sink that it shapes
            already, latencies or a topic that no plan may have.
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
    with wrong_values_refused(Plan):
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
    longer = [server for server in running if server.slots[-1][1] == latest < end]
    return with_slots(plan.servers, {server.name: until(server, end) for server in longer})
