"""Splicing the shaping node into a described application (paper, section 3.2.2, Design 2).

The publisher's output topic is remapped to ``…_tmp``, and a node that subscribes to that topic and
republishes on the original one is added. Where the plan gates the publisher's own thread instead
(section 3.2.1, Design 1), the application is compared with what the plan takes it for, and its
output gets the lifespan by which DDS discards what overran.
"""

from typing import Any

from chainshaper.planning.chain_plan import (
    ChainPlan,
    ShapingNode,
    publisher_servers,
    publishing_servers,
)
from chainshaper.planning.overruns import Writer, check_publication, output_lifespan
from chainshaper.planning.plan import Plan
from chainshaper.robot.gate import values_of
from chainshaper.splicing.gate_settings import gate_of
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import wrong_values_refused
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    GateDescription,
    NodeDescription,
    node_name,
    origin_timer,
)


def splice_application(application: Application, plan: Plan) -> Application:
    """Return the application as it runs under a plan, with shaping nodes and chains at offsets.

    Raises InputError: the plan shapes nothing, or does not fit the application.
    """
    application = placed_application(application, plan)
    for chain in plan.chains:
        application = _with_chain(application, chain)
    described = {*map(node_name, application.nodes)}
    planned = {thread.node for server in plan.servers for thread in server.threads}
    unknown = planned - described - {node.thread.node for node in plan.shaping_nodes}
    if unknown:
        raise InputError(
            f"the plan names {', '.join(sorted(unknown))}, which {application.name!r} does not have"
            f" (its nodes: {', '.join(sorted(described))}): correct the plan, or plan from a"
            " recording of this application"
        )
    return application


def placed_application(application: Application, plan: Plan) -> Application:
    """Return the application with timers at their chains' offsets, and nodes where servers are.

    Raises InputError: as :func:`at_offsets`.
    """
    return _placed(at_offsets(application, plan), plan)


def at_offsets(application: Application, plan: Plan) -> Application:
    """Return the application with timers that expire at the offsets of the chains they start.

    Raises InputError: the application lacks a chain of the plan, or it has another period there.
    """
    for chain in plan.chains:
        name, timer = origin_timer(application, chain.chain.spec)
        period_ns = chain.chain.period_ns
        if timer.period_ns != period_ns:
            raise InputError(
                f"the plan is for a chain with the period {duration_text(period_ns)}, but"
                f" {chain.chain.spec or application.chain} of {application.name!r} has"
                f" {duration_text(timer.period_ns or 0)}: plan again from a recording of this"
                " application"
            )
        if plan.moves_timers:
            node = application.nodes[name]
            moved = timer.model_copy(update={"phase_ns": chain.offset_ns})
            callbacks = tuple(
                moved if callback is timer else callback for callback in node.callbacks
            )
            nodes = {**application.nodes, name: node.model_copy(update={"callbacks": callbacks})}
            application = application.model_copy(update={"nodes": nodes})
    return application


def _with_chain(application: Application, plan: ChainPlan) -> Application:
    """Return the application with the shaping nodes, or the topic's lifespan, of one chain."""
    shaping = plan.shaping_node
    if shaping is None and any(publisher_servers(plan)):
        check_publication(plan, writers_of(application))
        topic, lifespan_ns = plan.chain.output, output_lifespan(plan)
        if topic is None or lifespan_ns is None:
            return application
        described = application.topic(topic)
        shortest = min(lifespan_ns, described.lifespan_ns or lifespan_ns)
        changed = described.model_copy(update={"lifespan_ns": shortest})
        return application.model_copy(update={"topics": {**application.topics, topic: changed}})
    if shaping is None:
        raise nothing_to_splice(plan)
    if plan.modes is not None and plan.modes.topic not in application.announced():
        raise InputError(
            f"the plan's modes are named on {plan.modes.topic}, but no callback of the application "
            "`announces` modes there: describe one, or remove `modes` from the plan"
        )
    for node in (shaping, *plan.further_shaping_nodes):
        if node.delivery_ns is not None:
            raise InputError(
                f"the plan hands {node.output} to its subscribers at a constant time, which a"
                " library in ROS 2 nodes does, and a described application has none: plan without"
                " --delivery, or generate ROS 2 nodes (`chainshaper generate`)"
            )
        application = _spliced(application, plan, node)
    return application


def nothing_to_splice(plan: ChainPlan) -> InputError:
    """Return the error for a plan without a shaping node."""
    return InputError(
        f"the plan has no `shaping_node`, so there is nothing to splice: put {plan.policy} in force"
        " with `chainshaper apply plan.yaml`, or plan with --policy shaped"
    )


def _placed(application: Application, plan: Plan) -> Application:
    """Return the application with its nodes on the cores and priorities of their servers.

    Nodes that receive an output get the place that the plan has for them, below the shaping nodes,
    and so do the threads of loops that read it. A loop that is to be moved starts later.
    """
    publishing = {server.name for chain in plan.chains for server in publishing_servers(chain)}
    running = [server for server in plan.servers if server.name not in publishing]
    server_of = {thread.node: server for server in running for thread in server.threads}
    best = min((server.priority for server in running), default=1)
    nodes = dict(application.nodes)
    for name, node in application.nodes.items():
        if (server := server_of.get(node_name(name))) is not None:
            described = application.scheduling_of(name)
            rank = max(1, described.priority - (server.priority - best))
            if (described.core, described.priority, node.bound) != (server.core, rank, True):
                placed = {"core": server.core, "priority": rank, "bound": True}
                nodes[name] = node.model_copy(update=placed)
        elif (place := plan.receivers_at.get(node_name(name))) is not None:
            gates = (shaping.fifo_priority for shaping in plan.shaping_nodes)
            receiving = {"core": place.core, "priority": max(1, min(gates) - 1)}
            nodes[name] = node.model_copy(update=receiving)
        if (place := plan.loops_at.get(node_name(name))) is not None:
            gates = (shaping.fifo_priority for shaping in plan.shaping_nodes)
            raised = {"core": place.core, "priority": max(1, min(gates) - 1)}
            nodes[name] = _with_loop(nodes[name], raised)
    moved_ns = {chain.loop.node: chain.loop.move_ns for chain in plan.chains if chain.loop}
    for name, node in application.nodes.items():
        if node.loop is not None and (by_ns := moved_ns.get(node_name(name))):
            nodes[name] = _with_loop(nodes[name], {"phase_ns": node.loop.phase_ns + by_ns})
    return application.model_copy(update={"nodes": nodes})


def _with_loop(node: NodeDescription, changes: dict[str, int]) -> NodeDescription:
    """Return a node with changes of its loop."""
    callbacks = (
        callback if callback.loop_ns is None else callback.model_copy(update=changes)
        for callback in node.callbacks
    )
    return node.model_copy(update={"callbacks": tuple(callbacks)})


def _spliced(application: Application, plan: ChainPlan, shaping: ShapingNode) -> Application:
    """Return the application with one shaping node behind the publisher of its output."""
    if shaping.name in {name.strip("/") for name in application.nodes}:
        raise InputError(
            f"the application has a node {shaping.name!r} already, the name that the plan gives to "
            "the shaping node: change it in the plan"
        )
    publishers = [name for name, cb in application.callbacks() if shaping.output in cb.publishes]
    if len(publishers) != 1:
        raise InputError(
            f"the plan shapes {shaping.output}, which "
            f"{', '.join(publishers) or 'no node'} of the application publishes; exactly one node "
            "must"
        )
    if any(shaping.input in callback.publishes for _, callback in application.callbacks()):
        raise InputError(
            f"the application publishes {shaping.input} already, the name that the plan gives to "
            "the unshaped output: change `shaping_node.input` in the plan"
        )
    nodes, topics = dict(application.nodes), dict(application.topics)
    publisher = nodes[publishers[0]]
    callbacks = []
    for callback in publisher.callbacks:
        topics_published = [
            shaping.input if topic == shaping.output else topic for topic in callback.publishes
        ]
        callbacks.append(callback.model_copy(update={"publishes": tuple(topics_published)}))
    nodes[publishers[0]] = publisher.model_copy(update={"callbacks": tuple(callbacks)})
    depth = shaping.depth or max(10, application.topic(shaping.output).depth)
    _, timer = origin_timer(application, plan.chain.spec)
    nodes[shaping.name] = _described(plan, shaping, depth, timer.phase_ns)
    if shaping.output in topics:
        topics[shaping.input] = topics[shaping.output]  # the same quality of service
    first, arrow, rest = application.chain.partition("..")
    starts = arrow and first.strip() == shaping.output  # the chain begins with the same message
    chain = f"{shaping.input}..{rest}" if starts else application.chain
    return application.model_copy(update={"nodes": nodes, "topics": topics, "chain": chain})


def writers_of(application: Application) -> list[Writer]:
    """Return who publishes what in a described application, and how."""
    return [
        Writer(
            node=node_name(name),
            topic=topic,
            depth=application.topic(topic).depth,
            asynchronous=application.topic(topic).publication == "asynchronous",
        )
        for name, callback in application.callbacks()
        for topic in callback.publishes
    ]


def _described(plan: ChainPlan, shaping: ShapingNode, depth: int, phase_ns: int) -> NodeDescription:
    """Return the description of a shaping node."""
    gate = gate_of(plan, shaping, depth)
    described: dict[str, Any] = {**values_of(gate), "slots": gate.slots, "depth": gate.depth}
    described |= {"phase_ns": phase_ns, "spin_ns": shaping.spin_ns, "pause_ns": shaping.pause_ns}
    if gate.modes is not None and plan.modes is not None:
        described["modes"] = plan.modes.model_dump()
    with wrong_values_refused(NodeDescription, "the plan's shaping node cannot be run: "):
        callback = CallbackDescription(
            subscription=shaping.input,
            publishes=(shaping.output,),
            gate=GateDescription.model_validate(described),
        )
        core, priority = shaping.core, shaping.fifo_priority
        return NodeDescription(core=core, priority=priority, callbacks=(callback,))
