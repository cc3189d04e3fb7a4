"""From measured latencies to servers and slots: shaping, and the schedules it is compared with.

**Shaping** (sections 3.1 and 3.2): the chain runs in a server that is open from the start of a
cycle until every execution seen so far was complete, and its output is published in a server whose
slot comes then. :func:`plan_shaping` plans one chain; further functions take its plan and return
one that covers more of a graph (5.1 and 5.4), or of another policy (2.5, 5.1 and 5.3).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product, zip_longest
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

OUTPUT_PRIORITY = 1  # better than the chain's: a publish slot inside its slot has to pre-empt it
CHAIN_PRIORITY = 2
BOUNDARY_NS = 1_000_000  # slots of callbacks are whole multiples of it
PAUSE_NS = 2_000_000  # a receiver on a slow machine takes a millisecond to get to its callback
_WISHES = {field.name for field in fields(Wishes)}
_OF_PLAN = ("anchor", "into_open_slot", "messages", "fallback", "shaping_thread")  # of these
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
    1 ms unless the wishes say otherwise. ``nodes`` are those whose executors run the chain,
    ``fifo_priority`` and ``receivers`` for the shaping node.
    ``values`` are fields of :class:`~chainshaper.planning.chain_plan.ChainOfPlan` and
    :class:`~chainshaper.planning.chain_plan.Evidence`, and single
    :class:`~chainshaper.values.plan_choices.Wishes`. OperationError: L̄ + ε + Δ does not fit.
    """
    latencies = check_latencies(latencies_ns)
    of_chain = {n: values.pop(n) for n in plans.ChainOfPlan.model_fields.keys() & values.keys()}
    wishes = replace(wishes or Wishes(), **{n: values.pop(n) for n in _WISHES & values.keys()})
    length = plans.SHORTEST_SLOT_NS if wishes.publish_slot_ns is None else wishes.publish_slot_ns
    longest = int(latencies.max())
    epsilon = given_or_least_epsilon_ns(wishes) if margin is None else margin.epsilon_ns
    if epsilon < 0 or length <= 0 or period_ns <= 0:
        found = ", ".join(map(duration_text, (epsilon, length, period_ns)))
        raise InputError(f"epsilon must be 0 ms or more, slot and period longer than 0 ms: {found}")
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
    """A server that runs the executors of these nodes."""
    threads = tuple(Thread(node=node) for node in nodes)
    return Server(name=name, core=core, priority=priority, slots=tuple(slots), threads=threads)


def _publishing(thread: Thread | None, core: int, slot: Slot, name: str | None = None) -> Server:
    """The server in whose slot a thread publishes; with bare latencies it is not known."""
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
    """The shaping node of a chain's output, if any, and the thread that publishes it."""
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
    """The chain publishes on a topic of its own, and the shaping node takes over the output's."""
    name = "chainshaper" + output.replace("/", "_")
    return {"name": name, "input": f"{output}_tmp", "output": output}


def _node_like(
    node: ShapingNode, output: str, publisher: str | None, receivers: Sequence[str] = ()
) -> ShapingNode:
    """A shaping node for another topic, with the core, priority and waiting of a given one."""
    delivery_ns = node.delivery_ns if receivers else None
    others = {"publisher": publisher, "receivers": tuple(receivers), "delivery_ns": delivery_ns}
    others["receivers_at"] = None
    return ShapingNode.model_validate({**node.model_dump(), **_names(output), **others})


def _inside(node: ShapingNode) -> ShapingNode:
    """The same for a topic inside the chain: how exactly it leaves is of no consequence there, so
    it neither watches the clock nor keeps the gate of an output from its core.
    """
    behind = max(1, node.fifo_priority - 1)
    return node.model_copy(update={"spin_ns": 0, "fifo_priority": behind})


def with_gates_level(chains: Sequence[ChainPlan]) -> tuple[ChainPlan, ...]:
    """The plans of several chains whose shaping nodes run above the executors of all: those of
    outputs at one priority, so that the one that wakes first publishes first.
    """
    every = [node.fifo_priority for plan in chains for node in plans.shaping_nodes(plan)]
    return tuple(_with_gates_at(plan, max(every, default=0)) for plan in chains)


def _with_gates_at(plan: ChainPlan, priority: int) -> ChainPlan:
    node = plan.shaping_node
    if node is None or node.fifo_priority == priority:
        return plan
    level = node.model_copy(update={"fifo_priority": priority})
    further = [
        one.model_copy(update={"fifo_priority": priority}) for one in plan.further_shaping_nodes
    ]
    if plans.inner_gates(plan):
        further = [_inside(one) for one in further]
    return plans.revised(plan, shaping_node=level, further_shaping_nodes=tuple(further))


def evidence_of(latencies_ns: NDArray[np.int64], **conditions: Any) -> Evidence:
    """The latencies' statistics, with the conditions they were taken under: Evidence's fields.
    Others may delay a cycle, but need not: the shortest is without that.
    """
    return Evidence(
        samples=int(latencies_ns.size),
        min_latency_ns=int(latencies_ns.min()) - (conditions.get("interference_ns") or 0),
        mean_latency_ns=round(int(latencies_ns.sum()) / latencies_ns.size),
        max_latency_ns=int(latencies_ns.max()),
        **conditions,
    )


def _too_long(longest: int, epsilon: int, publish_slot: int, period: int, *, alone: bool) -> str:
    """What would make the chain fit: unless it is ``alone``, others may not fit then."""
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
    """One server per core for the chain's threads, each with the chain's slot (section 5.4).

    ``core_of`` names the core of every node that takes part, also on branches that the chain waits
    for, the most urgent first. Raises InputError: a node is missing.
    """
    chain, others = _chain_and_others(plan)
    if missing := [thread.node for thread in chain.threads if thread.node not in core_of]:
        raise InputError(f"no core is named for {', '.join(missing)}: name one for each node")
    split = []
    for core in dict.fromkeys(core_of.values()):
        name = chain.name if len(set(core_of.values())) == 1 else f"{chain.name}_core{core}"
        nodes = (node for node, its in core_of.items() if its == core)
        split.append(server_for(nodes, name, core, chain.priority, chain.slots))
    return plans.revised(plan, servers=(*split, *others))


def with_first_node_apart(
    plan: ChainPlan, node: str, slot_end_ns: int, core: int | None = None
) -> ChainPlan:
    """The chain's first node in a server of its own, [0, ``slot_end_ns``), on a ``core`` (default:
    the chain's), the rest behind it. So a first callback that is no timer starts every execution at
    the beginning of a cycle (table 4, rows 2 to 5: [0, 2] and [2, 86] ms).
    """
    chain, others = _chain_and_others(plan)
    (start, end), thread = chain.slots[0], Thread(node=node)
    if thread not in chain.threads:
        raise InputError(f"{node} is no node of the chain's server: name its first node")
    if not start < slot_end_ns < end:
        limits = f"after {duration_text(start)} and before {duration_text(end)}"
        raise InputError(f"the first node's slot must end {limits}, where the chain's does")
    own_core, slots = chain.core if core is None else core, [(start, slot_end_ns)]
    alone = server_for([node], "first", own_core, chain.priority, slots)
    rest = tuple(other for other in chain.threads if other != thread)
    behind = chain.model_copy(update={"slots": ((slot_end_ns, end),), "threads": rest})
    return plans.revised(plan, servers=(alone, behind, *others))


@wrong_values_refused(ChainPlan)
def with_best_effort(chains: Sequence[ChainPlan], core_of: Mapping[str, int]) -> list[ChainPlan]:
    """Plans whose first has a server on each core for these nodes, which are in none of the chains:
    R_m' of section 3.1, R_int of section 5.1. Raises InputError: a node is in a server already.
    """
    first, *others = chains
    known = {
        one.node: server.name for p in chains for server in p.servers for one in server.threads
    }
    for node in sorted(known.keys() & core_of.keys()):
        reason = f"{node} is in the server {known[node]!r}"
        raise InputError(f"{reason}: best effort are nodes beside chains")
    worst = max(server.priority for plan in chains for server in plan.servers)
    # Threads of publishers come behind their executors where overruns may finish.
    worst += any(any(plans.publisher_servers(plan)) for plan in chains)
    added = []
    for core in sorted(set(core_of.values())):
        nodes = (node for node, its in core_of.items() if its == core)
        own = server_for(nodes, f"best_effort_core{core}", core, worst + 1, [(0, first.cycle_ns)])
        added.append(own.model_copy(update={"best_effort": True}))
    return [plans.revised(first, servers=(*first.servers, *added)), *others]


def with_turns(plan: ChainPlan, equal_priorities: EqualPriorities) -> ChainPlan:
    """A plan whose servers take turns at one priority (eq. 3), if that is wished."""
    if equal_priorities == "apart":
        return plan
    best = min(server.priority for server in plan.servers)
    equal = tuple(one.model_copy(update={"priority": best}) for one in plan.servers)
    return plans.revised(plan, servers=plans.below_executors(equal), equal_priorities="round-robin")


def _chain_and_others(plan: ChainPlan) -> tuple[Server, list[Server]]:
    for server in plan.servers:
        if server.name == "chain":
            return server, [other for other in plan.servers if other is not server]
    raise InputError("the plan has no server named 'chain': begin with a shaped plan")


def with_executors(
    plan: ChainPlan, executors: Sequence[Mapping[str, Sequence[tuple[str, ...]]]]
) -> ChainPlan:
    """The plan with those executors of nodes in its servers that run the given callbacks; others of
    a node whose callback groups have executors of their own run on (section 6).
    """
    servers = []
    for server in plan.servers:
        threads: list[Thread] = []
        for one in server.threads:
            own = dict.fromkeys(names for known in executors for names in known.get(one.node, ()))
            apart = own if own and one.role == "executor" else [()]
            threads += [one.model_copy(update={"callbacks": names}) for names in apart]
        servers.append(server.model_copy(update={"threads": tuple(threads)}))
    return plans.revised(plan, servers=tuple(servers))


def behind_others(name: str, own: Sequence[Server], taken: Sequence[Server], cycle_ns: int) -> int:
    """How much later (ns) slots have to be to meet none of those taken on their core. Raises
    OperationError: then they leave the cycle, and the output of that ``name`` with them.
    """
    same_core = (pair for pair in product(own, taken) if pair[0].core == pair[1].core)
    pairs = [pair for one, other in same_core for pair in product(one.slots, other.slots)]
    later_ns = min(
        later
        for later in {0, *(max(0, end - start) for (start, _), (_, end) in pairs)}
        if not any(plans.meet((one[0] + later, one[1] + later), two) for one, two in pairs)
    )
    if (end := later_ns + max(one.slots[-1][1] for one in own)) > cycle_ns:
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
    """A shaped plan with one more shaped output: another sink of the same graph (end of 5.4).

    The sink gets a shaping node; where the plan's output is published asynchronously, the thread of
    its ``publisher`` is gated instead. ``latencies_ns`` are from the start of the graph to this
    sink. Its slot starts the plan's margin after the longest, or where a publish slot that is in
    the way on the same core ends; the chain's servers stay open as long as the slowest sink needs.

    Raises InputError: the plan shapes nothing, or this sink already. OperationError: the slot does
    not fit into the cycle.
    """
    node, publishing = plan.shaping_node, plans.output_server(plan)
    if publishing is None or not publishing.threads:
        raise InputError("a further sink needs a plan that shapes one output already")
    if output in {plan.chain.output, *(other.output for other in plan.further_shaping_nodes)}:
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
    added = () if node is None else (_node_like(node, output, publisher, receivers),)
    thread = added[0].thread if added else Thread(node=publisher or "", role="publisher")
    server = _publishing(thread, publishing.core, (start, start + length))
    further = (*plan.further_shaping_nodes, *added)
    servers = plans.below_executors([*longer, server])
    return plans.revised(plan, servers=servers, further_shaping_nodes=further)


# What shaping is compared with -----------------------------------------------------------------


@dataclass(frozen=True)
class CallbackTimes:
    """Measured response times of one callback; ``after`` are the places, in the sequence that this
    stands in, of the callbacks whose data it needs. It ``publishes`` this topic of the graph's.
    """

    node: str
    core: int
    min_response_ns: int
    mean_response_ns: int
    max_response_ns: int
    after: tuple[int, ...] = ()
    publishes: str | None = None


def server_per_chain(plan: ChainPlan) -> ChainPlan:
    """One server for the chain, nothing shaped (section 3.1; table 4 row 2): what was measured."""
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
    """Time-triggered scheduling: each callback runs in a slot of its own (table 4 row 1).

    It starts when the slots of all callbacks that this one waits for have ended, and the slot
    before it on its core, and lasts for the longest response time plus ``margin_ns``, rounded up to
    whole milliseconds. Each of ``callbacks`` comes after those it waits for, the chain's last last.

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
        own = united([slot for callback, slot in pairs if callback.node == node])
        servers.append(server_for([node], node.strip("/"), cores.pop(), OUTPUT_PRIORITY, own))
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
    """Logical execution time for the chain as one task: its output leaves at the start of the next
    cycle (section 5.3, table 5).
    """
    publishing, length = _one_slot(plan)
    if plan.evidence.min_latency_ns <= length:
        shortest = f"the shortest latency {duration_text(plan.evidence.min_latency_ns)}"
        raise InputError(f"{shortest} could leave in its own cycle: use a shorter publish slot")
    ends = {s.name: length if s is publishing else plan.cycle_ns for s in plan.servers}
    slots = {name: ((0, end),) for name, end in ends.items()}
    predicted = _after_periods(plan, 1, length)
    servers = plans.with_slots(plan.servers, slots)
    return plans.revised(plan, policy="let-per-chain", servers=servers, predicted=predicted)


@wrong_values_refused(ChainPlan)
def let_per_callback(
    plan: ChainPlan, topics: Sequence[str], publishers: Sequence[str] = ()
) -> ChainPlan:
    """Logical execution time for every callback: each one's output waits for the next cycle.

    ``topics`` are the outputs of the chain's callbacks in order, the chain's own last;
    ``publishers`` their nodes, where known. Behind each topic a shaping node republishes in the
    next cycle, or the publishers' threads run then, where the plan gates one (5.3, table 5).
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
    # Backwards: whatever a fast callback makes of the data of one slot, that of its output is over.
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
    """The server of the output, and how long its only slot is."""
    publishing, slots = plans.output_server(plan), plans.publish_slots(plan)
    if publishing is None or len(slots) != 1:
        raise InputError(f"LET needs a plan with one publish slot; this one has {len(slots)}")
    return publishing, slots[0][1] - slots[0][0]


def _after_periods(plan: ChainPlan, periods: int, slot_ns: int) -> Prediction:
    start = periods * plan.chain.period_ns
    return plans.in_one_slot((start, start + slot_ns))
