"""From measured latencies to servers and slots: shaping, and the schedules it is compared with.

**Shaping** (sections 3.1 and 3.2): the chain runs in a server that is open from the start of a
cycle until every execution seen so far was complete. Its output is published in a server whose slot
begins then. :func:`plan_shaping` plans one chain. Further functions take its plan and return one
that covers more of a graph (5.1 and 5.4), or follows another policy (2.5, 5.1 and 5.3).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product, zip_longest
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning import chain_plan as plans
from chainshaper.planning.bands import predict_bands
from chainshaper.planning.chain_plan import (
    ChainPlan,
    Evidence,
    Margin,
    Prediction,
    Server,
    ShapingNode,
    Slot,
    Thread,
)
from chainshaper.planning.latencies import check_latencies
from chainshaper.planning.margins import given_or_least_epsilon_ns
from chainshaper.planning.overruns import united
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import EqualPriorities, Wishes
from chainshaper.values.yaml_file import wrong_values_refused

OUTPUT_PRIORITY = 1  # better than the chain's: the output pre-empts a chain in whose slot it leaves
CHAIN_PRIORITY = 2
BOUNDARY_NS = 1_000_000  # slots of callbacks begin and end at multiples of it
PAUSE_NS = 2_000_000  # a receiver on a slow machine takes a millisecond to get to its callback
_WISHES = {field.name for field in fields(Wishes)}
# The wishes that are fields of a plan as well.
_OF_PLAN = ("anchor", "into_open_slot", "messages", "fallback", "shaping_thread")
_NO_NODES: dict[str, object] = {"shaping_node": None, "further_shaping_nodes": ()}


@wrong_values_refused(ChainPlan)
def plan_shaping(
    latencies_ns: NDArray[np.int64],
    period_ns: int,
    *,
    wishes: Wishes | None = None,
    margin: Margin | None = None,
    nodes: Sequence[str] = (),
    core: int = 1,
    fifo_priority: int = 84,
    receivers: Sequence[str] = (),
    **values: Any,
) -> ChainPlan:
    """Plan single-band shaping: one publish slot right behind the longest latency measured.

    With L̄ the longest latency, ε the margin, Δ the length of the publish slot and CT the period,
    the chain's server R_m gets the slot [0, L̄ + ε) (eq. 1) and the output's server R_m° gets [L̄ +
    ε, L̄ + ε + Δ) (eq. 4 with a shaping node, eq. 2 with an asynchronous publisher thread), in the
    same cycle (eq. 3) and on the same core, at the better priority.

    ε is the margin's or, without one, 1 ms (0.8 ms with a gate in the publisher's process), Δ is
    1 ms unless the wishes say otherwise. The executors of ``nodes`` run the chain;
    ``fifo_priority`` and ``receivers`` are those of the shaping node. ``values`` are fields of
    :class:`~chainshaper.planning.chain_plan.ChainOfPlan` and
    :class:`~chainshaper.planning.chain_plan.Evidence`, and single
    :class:`~chainshaper.values.plan_choices.Wishes`.

    Raises OperationError: L̄ + ε + Δ does not fit into the period.
    """
    latencies = check_latencies(latencies_ns)
    of_chain = {
        name: values.pop(name) for name in plans.ChainOfPlan.model_fields.keys() & values.keys()
    }
    single = {name: values.pop(name) for name in _WISHES & values.keys()}
    wishes = replace(wishes or Wishes(), **single)
    length = plans.SHORTEST_SLOT_NS if wishes.publish_slot_ns is None else wishes.publish_slot_ns
    longest = int(latencies.max())
    epsilon = given_or_least_epsilon_ns(wishes) if margin is None else margin.epsilon_ns
    if epsilon < 0 or length <= 0 or period_ns <= 0:
        given = ", ".join(map(duration_text, (epsilon, length, period_ns)))
        raise InputError(f"epsilon must be 0 ms or more, slot and period longer than 0 ms: {given}")
    start = longest + epsilon
    if (end := start + length) > period_ns:
        alone = values.get("interference_ns") is None
        raise OperationError(_too_long(longest, epsilon, length, period_ns, alone=alone))
    chain = plans.ChainOfPlan(period_ns=period_ns, **of_chain)
    node, gated = _gate(chain, wishes, core, fifo_priority, receivers)
    running = server_for(nodes, "chain", core, CHAIN_PRIORITY, [(0, start)])
    return ChainPlan(
        chain=chain,
        evidence=evidence_of(latencies, **values),
        margin=margin or Margin(epsilon_ns=epsilon),
        policy="shaped",
        cycle_ns=period_ns,
        overrun=wishes.overrun or "publish",
        servers=(running, _publishing(gated, core, (start, end), "output")),
        shaping_node=node,
        predicted=predict_bands(latencies, [end], length, wishes.into_open_slot),
        **{name: getattr(wishes, name) for name in _OF_PLAN},
    )


def server_for(
    nodes: Iterable[str], name: str, core: int, priority: int, slots: Sequence[Slot]
) -> Server:
    """Return a server that runs the executors of these nodes."""
    threads = tuple(Thread(node=node) for node in nodes)
    return Server(name=name, core=core, priority=priority, slots=tuple(slots), threads=threads)


def _publishing(thread: Thread | None, core: int, slot: Slot, name: str | None = None) -> Server:
    """Return the server in whose slot a thread publishes; with bare latencies that is not known."""
    name = name or f"output_{thread.node.strip('/') if thread else ''}"
    threads = (thread,) if thread else ()
    return Server(name=name, core=core, priority=OUTPUT_PRIORITY, slots=(slot,), threads=threads)


def _gate(
    chain: plans.ChainOfPlan,
    wishes: Wishes,
    core: int,
    fifo_priority: int,
    receivers: Sequence[str],
) -> tuple[ShapingNode | None, Thread | None]:
    """Return the shaping node of a chain's output, if any, and the thread that publishes it."""
    if wishes.publication == "asynchronous" and chain.publisher is not None:
        return None, Thread(node=chain.publisher, role="publisher")
    if chain.output is None:
        return None, None
    if wishes.publication == "asynchronous":
        raise InputError("asynchronous publication: name the node that publishes the output")
    pause = min(PAUSE_NS, chain.period_ns // 20) if wishes.pause_ns is None else wishes.pause_ns
    node = ShapingNode(
        **_names(chain.output),  # type: ignore[arg-type]
        depth=wishes.depth,
        core=core,
        fifo_priority=fifo_priority,
        spin_ns=wishes.spin_ns,
        pause_ns=pause,
        receivers=tuple(receivers),
        in_process=wishes.publication == "in-process",
        delivery_ns=wishes.delivery_ns,
    )
    return node, node.thread


def _names(output: str) -> dict[str, str]:
    """Return the names of a shaping node and of its topics.

    The chain publishes on a new topic, and the shaping node on the output's.
    """
    name = "chainshaper" + output.replace("/", "_")
    return {"name": name, "input": f"{output}_tmp", "output": output}


def _node_like(
    node: ShapingNode, output: str, publisher: str | None, receivers: Sequence[str] = ()
) -> ShapingNode:
    """Return a shaping node for another topic, which has core, priority and waiting of ``node``."""
    of_topic: dict[str, object] = {
        "publisher": publisher,
        "receivers": tuple(receivers),
        "receivers_at": None,
        "delivery_ns": node.delivery_ns if receivers else None,
    }
    return ShapingNode.model_validate({**node.model_dump(), **_names(output), **of_topic})


def _inside(node: ShapingNode) -> ShapingNode:
    """Return the same shaping node for a topic inside the chain, where nothing has to be exact.

    It neither watches the clock nor keeps the shaping node of an output from its core.
    """
    behind = max(1, node.fifo_priority - 1)
    return node.model_copy(update={"spin_ns": 0, "fifo_priority": behind})


def with_gates_level(chains: Sequence[ChainPlan]) -> tuple[ChainPlan, ...]:
    """Return plans of several chains whose shaping nodes run above the executors of all chains.

    Those of outputs have one priority, so that the node that wakes up first publishes first.
    """
    priorities = [node.fifo_priority for plan in chains for node in plans.shaping_nodes(plan)]
    return tuple(_with_gates_at(plan, max(priorities, default=0)) for plan in chains)


def _with_gates_at(plan: ChainPlan, priority: int) -> ChainPlan:
    node = plan.shaping_node
    if node is None or node.fifo_priority == priority:
        return plan
    change = {"fifo_priority": priority}
    further = [inner.model_copy(update=change) for inner in plan.further_shaping_nodes]
    if plans.inner_gates(plan):
        further = [_inside(inner) for inner in further]
    return plans.revised(
        plan,
        shaping_node=node.model_copy(update=change),
        further_shaping_nodes=tuple(further),
    )


def evidence_of(latencies_ns: NDArray[np.int64], **conditions: Any) -> Evidence:
    """Return the statistics of latencies; ``conditions`` are further fields of the evidence.

    Other chains may delay a cycle, but need not: the shortest latency is without that delay.
    """
    return Evidence(
        samples=int(latencies_ns.size),
        min_latency_ns=int(latencies_ns.min()) - (conditions.get("interference_ns") or 0),
        mean_latency_ns=round(int(latencies_ns.sum()) / latencies_ns.size),
        max_latency_ns=int(latencies_ns.max()),
        **conditions,
    )


def _too_long(longest: int, epsilon: int, publish_slot: int, period: int, *, alone: bool) -> str:
    """Say that a chain does not fit into its cycle, and what helps.

    Beside other chains (not ``alone``) a smaller margin may leave these no room, so it is no help.
    """
    missing = longest + epsilon + publish_slot - period
    remedies = ["a longer period", "a shorter chain"]
    if alone and longest + epsilon < period:
        remedies.insert(0, f"a publish slot of {duration_text(period - longest - epsilon)}")
    if alone and longest + publish_slot <= period:
        remedies.insert(0, f"a margin of {duration_text(period - longest - publish_slot)}")
    if alone and longest >= period:
        remedies.append("a pipeline of stages, each shorter than the cycle (--policy pipelined)")
    return (
        f"the longest latency {duration_text(longest)}, the margin {duration_text(epsilon)} and"
        f" the publish slot {duration_text(publish_slot)} do not fit into the cycle of"
        f" {duration_text(period)}: {duration_text(missing)} too long. What helps:"
        f" {', or '.join(remedies)}."
    )


@wrong_values_refused(ChainPlan)
def over_cores(plan: ChainPlan, core_of: Mapping[str, int]) -> ChainPlan:
    """Return the plan with a server on each core for the chain's threads (section 5.4).

    Each has the chain's slot. ``core_of`` is the core of each node that takes part, also on
    branches that the chain waits for, the most urgent first. Raises InputError: a node is missing.
    """
    chain, others = _chain_and_others(plan)
    if missing := [thread.node for thread in chain.threads if thread.node not in core_of]:
        raise InputError(f"no core is named for {', '.join(missing)}: name one for each node")
    split = []
    for core in dict.fromkeys(core_of.values()):
        name = chain.name if len(set(core_of.values())) == 1 else f"{chain.name}_core{core}"
        nodes = (node for node, node_core in core_of.items() if node_core == core)
        split.append(server_for(nodes, name, core, chain.priority, chain.slots))
    return plans.revised(plan, servers=(*split, *others))


def with_first_node_apart(
    plan: ChainPlan, node: str, slot_end_ns: int, core: int | None = None
) -> ChainPlan:
    """Return the plan with a server [0, ``slot_end_ns``) for the chain's first node alone.

    It is on ``core`` (default: the chain's); the rest of the chain comes behind it. So a first
    callback that is no timer starts each execution at the beginning of a cycle (table 4, rows 2 to
    5: [0, 2] and [2, 86] ms).
    """
    chain, others = _chain_and_others(plan)
    (start, end), thread = chain.slots[0], Thread(node=node)
    if thread not in chain.threads:
        raise InputError(f"{node} is no node of the chain's server: name its first node")
    if not start < slot_end_ns < end:
        limits = f"after {duration_text(start)} and before {duration_text(end)}"
        raise InputError(f"the first node's slot must end {limits}, where the chain's does")
    first = server_for(
        [node],
        "first",
        chain.core if core is None else core,
        chain.priority,
        [(start, slot_end_ns)],
    )
    rest = tuple(of_chain for of_chain in chain.threads if of_chain != thread)
    behind = chain.model_copy(update={"slots": ((slot_end_ns, end),), "threads": rest})
    return plans.revised(plan, servers=(first, behind, *others))


@wrong_values_refused(ChainPlan)
def with_best_effort(chains: Sequence[ChainPlan], core_of: Mapping[str, int]) -> list[ChainPlan]:
    """Return plans of chains, the first with servers for nodes that are in none of the chains.

    There is such a server on each core (R_m' of section 3.1, R_int of section 5.1). ``core_of`` is
    the core of each of these nodes. Raises InputError: one is in a server already.
    """
    first, *others = chains
    server_of = {
        thread.node: server.name
        for plan in chains
        for server in plan.servers
        for thread in server.threads
    }
    for node in sorted(server_of.keys() & core_of.keys()):
        reason = f"{node} is in the server {server_of[node]!r}"
        raise InputError(f"{reason}: best effort are nodes beside chains")
    worst = max(server.priority for plan in chains for server in plan.servers)
    # Where overruns may finish, threads of publishers get a priority behind their executors.
    if any(any(plans.publisher_servers(plan)) for plan in chains):
        worst += 1
    added = []
    for core in sorted(set(core_of.values())):
        nodes = (node for node, node_core in core_of.items() if node_core == core)
        name, slots = f"best_effort_core{core}", [(0, first.cycle_ns)]
        server = server_for(nodes, name, core, worst + 1, slots)
        added.append(server.model_copy(update={"best_effort": True}))
    return [plans.revised(first, servers=(*first.servers, *added)), *others]


def with_turns(plan: ChainPlan, equal_priorities: EqualPriorities) -> ChainPlan:
    """Return the plan with servers that take turns at one priority (eq. 3), if that is wished."""
    if equal_priorities == "apart":
        return plan
    best = min(server.priority for server in plan.servers)
    equal = tuple(server.model_copy(update={"priority": best}) for server in plan.servers)
    return plans.revised(plan, servers=plans.below_executors(equal), equal_priorities="round-robin")


def _chain_and_others(plan: ChainPlan) -> tuple[Server, list[Server]]:
    """Return the server of the chain of a plan that was just shaped, and its other servers."""
    for server in plan.servers:
        if server.name == "chain":
            return server, [further for further in plan.servers if further is not server]
    raise InputError("the plan has no server named 'chain': begin with a shaped plan")


def with_executors(
    plan: ChainPlan,
    executors: Sequence[Mapping[str, Sequence[tuple[str, ...]]]],
    groups: Mapping[tuple[str, tuple[str, ...]], str] = MappingProxyType({}),
) -> ChainPlan:
    """Return the plan with single executors of nodes that have several (section 6).

    ``executors`` has, for each output, the executors that take part of each such node, by the names
    of their callbacks. The node's other executors are in no server. ``groups`` has the ids of those
    that run one callback group each.
    """
    servers = []
    for server in plan.servers:
        threads: list[Thread] = []
        for thread in server.threads:
            callbacks = dict.fromkeys(
                names for of_output in executors for names in of_output.get(thread.node, ())
            )
            if not callbacks or thread.role != "executor":
                callbacks = {(): None}  # all executors of the node
            threads += [
                thread.model_copy(
                    update={"callbacks": names, "callback_group": groups.get((thread.node, names))}
                )
                for names in callbacks
            ]
        servers.append(server.model_copy(update={"threads": tuple(threads)}))
    return plans.revised(plan, servers=tuple(servers))


def behind_others(
    name: str, servers: Sequence[Server], taken: Sequence[Server], cycle_ns: int
) -> int:
    """Return how much later (ns) slots of servers have to be to meet none taken on their core.

    Raises OperationError: then they leave the cycle, and the output of that ``name`` with them.
    """
    pairs = [
        slots
        for server, other_server in product(servers, taken)
        if server.core == other_server.core
        for slots in product(server.slots, other_server.slots)
    ]
    later_ns = min(
        later
        for later in {0, *(max(0, end - start) for (start, _), (_, end) in pairs)}
        if not any(plans.meet((slot[0] + later, slot[1] + later), busy) for slot, busy in pairs)
    )
    if (end := later_ns + max(server.slots[-1][1] for server in servers)) > cycle_ns:
        reason = f"until {duration_text(end)}, after the cycle of {duration_text(cycle_ns)}"
        remedy = "use a shorter slot, or another core for an output"
        raise OperationError(f"{name} would be published {reason}: {remedy}")
    return later_ns


@wrong_values_refused(ChainPlan)
def with_sink(
    plan: ChainPlan,
    latencies_ns: NDArray[np.int64],
    output: str,
    *,
    publisher: str | None = None,
    receivers: Sequence[str] = (),
) -> ChainPlan:
    """Return a shaped plan with a further shaped output: another sink of the graph (end of 5.4).

    The sink gets a shaping node. Where the plan's output is published asynchronously, the thread of
    the sink's ``publisher`` is gated instead. ``latencies_ns`` are from the start of the graph to
    this sink. Its slot starts the plan's margin after the longest, or where a publish slot that is
    in the way on the same core ends. The chain's servers stay open as long as the slowest sink
    needs.

    Raises InputError: the plan shapes nothing, or this sink already. OperationError: the slot does
    not fit into the cycle.
    """
    node, publishing = plan.shaping_node, plans.output_server(plan)
    if publishing is None or not publishing.threads:
        raise InputError("a further sink needs a plan that shapes one output already")
    if output in {plan.chain.output, *(further.output for further in plan.further_shaping_nodes)}:
        raise InputError(f"the plan shapes {output} already: name each sink once")
    if node is None and publisher is None:
        raise InputError(f"a thread is to be gated, but who publishes {output} is not known")
    done = start = int(check_latencies(latencies_ns).max()) + plan.margin.epsilon_ns
    length = publishing.slots[-1][1] - publishing.slots[-1][0]
    gates, wanted = plans.publishing_servers(plan), {"slots": ((start, start + length),)}
    start += behind_others(output, [publishing.model_copy(update=wanted)], gates, plan.cycle_ns)
    # Servers that run the graph to its end stay open until the slowest sink is done.
    running = plans.running_servers(plan)
    latest = max((server.slots[-1][1] for server in running), default=done)
    slowest = [server for server in running if server.slots[-1][1] == latest]
    longer = plans.with_slots(
        plan.servers, {server.name: plans.until(server, done) for server in slowest}
    )
    further = plan.further_shaping_nodes
    if node is None:
        thread = Thread(node=publisher or "", role="publisher")
    else:
        of_sink = _node_like(node, output, publisher, receivers)
        thread, further = of_sink.thread, (*further, of_sink)
    server = _publishing(thread, publishing.core, (start, start + length))
    servers = plans.below_executors([*longer, server])
    return plans.revised(plan, servers=servers, further_shaping_nodes=further)


# The schedules that shaping is compared with ----------------------------------------------------


@dataclass(frozen=True)
class CallbackTimes:
    """Measured response times of a callback, one in a sequence of callbacks."""

    node: str
    core: int
    min_response_ns: int
    mean_response_ns: int
    max_response_ns: int
    after: tuple[int, ...] = ()  # the places in the sequence of the callbacks whose data it needs
    publishes: str | None = None  # the topic of the graph


def server_per_chain(plan: ChainPlan) -> ChainPlan:
    """Return a plan with one server for the chain, and nothing shaped (section 3.1; table 4 row 2).

    Its prediction is what was measured.
    """
    publishing, evidence = plans.output_server(plan), plan.evidence
    longest, jitter = evidence.max_latency_ns, evidence.max_latency_ns - evidence.min_latency_ns
    return plans.revised(
        plan,
        policy="server-per-chain",
        servers=tuple(server for server in plan.servers if server is not publishing),
        **_NO_NODES,
        predicted=Prediction(mean_ns=evidence.mean_latency_ns, max_ns=longest, jitter_ns=jitter),
    )


@wrong_values_refused(ChainPlan)
def server_per_callback(
    plan: ChainPlan, callbacks: Sequence[CallbackTimes], *, margin_ns: int = 0
) -> ChainPlan:
    """Return a time-triggered plan: each callback runs in a slot of its own (table 4 row 1).

    The slot starts when those of all callbacks that this one waits for have ended, and the slot
    before it on its core. It lasts for the longest response time plus ``margin_ns``, rounded up to
    whole milliseconds. ``callbacks`` come after those they wait for, that of the output last.

    Raises InputError: no callbacks, or one that waits for itself or a later one. OperationError:
    the slots do not fit into the cycle.
    """
    slots = _slots_in_sequence(callbacks, margin_ns)
    end = max(slot[1] for slot in slots)
    if end > plan.cycle_ns:
        reason = f"one slot per callback takes {duration_text(end)}, the cycle is"
        reason += f" {duration_text(plan.cycle_ns)}: shape the chain, plan with a smaller margin"
        raise OperationError(f"{reason} (--epsilon), or move callbacks to another core")
    last, (start, _) = callbacks[-1], slots[-1]
    servers = []
    for node in dict.fromkeys(callback.node for callback in callbacks):
        cores = {callback.core for callback in callbacks if callback.node == node}
        if len(cores) > 1:
            raise InputError(f"{node} runs on one core, not on {sorted(cores)}: correct it")
        pairs = zip(callbacks, slots, strict=True)
        of_node = united([slot for callback, slot in pairs if callback.node == node])
        servers.append(server_for([node], node.strip("/"), cores.pop(), OUTPUT_PRIORITY, of_node))
    return plans.revised(
        plan,
        policy="server-per-callback",
        **_NO_NODES,
        servers=tuple(servers),
        predicted=Prediction(
            mean_ns=start + last.mean_response_ns,
            max_ns=start + last.max_response_ns,
            jitter_ns=last.max_response_ns - last.min_response_ns,
        ),
    )


def _slots_in_sequence(callbacks: Sequence[CallbackTimes], margin_ns: int) -> list[Slot]:
    """Return the slot of each callback: behind those it waits for, and those of its core."""
    if not callbacks or margin_ns < 0:
        raise InputError("slots per callback need callbacks, and a margin of 0 ms or more")
    slots: list[Slot] = []
    busy_until: dict[int, int] = {}
    for number, callback in enumerate(callbacks):
        if any(not 0 <= before < number for before in callback.after):
            waits = f"callback {number} of {callback.node} waits for {callback.after}"
            raise InputError(f"{waits}, no callbacks before it: order them along the graph")
        waited_for = [slots[before][1] for before in callback.after]
        start = max([busy_until.get(callback.core, 0), *waited_for])
        steps = -(-(callback.max_response_ns + margin_ns) // BOUNDARY_NS)
        slots.append((start, start + max(1, steps) * BOUNDARY_NS))
        busy_until[callback.core] = slots[-1][1]
    return slots


def let_per_chain(plan: ChainPlan) -> ChainPlan:
    """Return a plan with logical execution time for the chain as one task (section 5.3, table 5).

    Its output leaves at the start of the next cycle.
    """
    publishing, length = _one_slot(plan)
    if plan.evidence.min_latency_ns <= length:
        shortest = f"the shortest latency {duration_text(plan.evidence.min_latency_ns)}"
        raise InputError(f"{shortest} could leave in its own cycle: use a shorter publish slot")
    slots = {server.name: ((0, plan.cycle_ns),) for server in plan.servers}
    slots[publishing.name] = ((0, length),)
    predicted = _after_periods(plan, 1, length)
    servers = plans.with_slots(plan.servers, slots)
    return plans.revised(plan, policy="let-per-chain", servers=servers, predicted=predicted)


@wrong_values_refused(ChainPlan)
def let_per_callback(
    plan: ChainPlan, topics: Sequence[str], publishers: Sequence[str] = ()
) -> ChainPlan:
    """Return a plan with logical execution time for every callback (section 5.3, table 5).

    The output of each callback waits for the next cycle. ``topics`` are these outputs in order, the
    chain's own last; ``publishers`` are their nodes, where known. Behind each topic a shaping node
    republishes in the next cycle; or, where the plan gates the publisher's thread, the threads of
    all publishers run then.
    """
    publishing, length = _one_slot(plan)
    last = plan.shaping_node
    end, given = (plan.chain.publisher, publishers) if last is None else (last.output, topics)
    if end is None or list(given[-1:]) != [end]:
        raise InputError(
            "LET per callback needs all topics of the chain, its output last; or, with asynchronous"
            " publication, its nodes, the one that publishes its output last"
        )
    if length * len(given) > plan.cycle_ns:
        reason = f"{len(given)} publish slots of {duration_text(length)} do not fit into the cycle"
        raise OperationError(f"{reason} {duration_text(plan.cycle_ns)}: use shorter slots")
    others = [server for server in plan.servers if server is not publishing]
    chain = plans.with_slots(others, {server.name: ((0, plan.cycle_ns),) for server in others})
    inside: tuple[ShapingNode, ...] = ()
    threads = [Thread(node=name, role="publisher") for name in publishers]
    if last is not None:
        known = zip_longest(topics[:-1], publishers[: len(topics) - 1])
        inside = tuple(_inside(_node_like(last, topic, publisher)) for topic, publisher in known)
        threads = [node.thread for node in (*inside, last)]
    gates = []
    # Backwards, the chain's output first: when a fast callback has used the data of a slot, the
    # slot of its own output is over in this cycle.
    for number, thread in enumerate(reversed(threads)):
        slot = (number * length, (number + 1) * length)
        gates.append(_publishing(thread, publishing.core, slot, None if number else "output"))
    return plans.revised(
        plan,
        policy="let-per-callback",
        servers=(*chain, *gates),
        further_shaping_nodes=inside,
        predicted=_after_periods(plan, len(threads), length),
    )


def _one_slot(plan: ChainPlan) -> tuple[Server, int]:
    """Return the server of the output, and how long its only slot is (ns)."""
    publishing, slots = plans.output_server(plan), plans.publish_slots(plan)
    if publishing is None or len(slots) != 1:
        raise InputError(f"LET needs a plan with one publish slot; this one has {len(slots)}")
    return publishing, slots[0][1] - slots[0][0]


def _after_periods(plan: ChainPlan, periods: int, slot_ns: int) -> Prediction:
    start = periods * plan.chain.period_ns
    return plans.in_one_slot((start, start + slot_ns))
