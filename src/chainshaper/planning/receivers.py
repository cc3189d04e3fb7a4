"""The place of a shaped output's receivers in a plan, and what the plan promises for them.

An output is of use when its receiver's callback starts. Where it leaves while the chain computes
for the next cycle (logical execution time, a slot at the cycle's end, a pipeline, other chains), a
receiver below all servers waits until that is over. So receivers have a place:

* where they were recorded on a core without servers, they stay there;
* else they run on the shaping node's core, behind shaping nodes and above the servers of chains.
  The plan leaves the core to them for as long as they took in a cycle: other chains wait for it,
  and where a chain is delayed by the receivers of its own output, its slot has to have that room.

Where there is no room, or nothing says how long they take, they run below all servers, when the
core is free, and nothing is promised for them.
"""

from collections.abc import Sequence
from dataclasses import replace

from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Prediction,
    ReceiverPlace,
    ShapingNode,
    publish_slots,
    revised,
    shaping_nodes,
)
from chainshaper.planning.margins import with_part_taken
from chainshaper.planning.profile import GATE_TAKES_NS, Profile
from chainshaper.planning.shaping import OUTPUT_PRIORITY


def without_reception(profile: Profile) -> Profile:
    """Return the profile without what is known of receivers, so that they get no place."""
    return replace(profile, reception=None)


def without_places(plan: ChainPlan) -> ChainPlan:
    """Return the plan without a place for the receivers of its output."""
    node = plan.shaping_node
    if node is None or node.receivers_at is None:
        return plan
    return revised(
        plan,
        shaping_node=node.model_copy(update={"receivers_at": None}),
        predicted=plan.predicted.model_copy(update={"receivers": None}),
    )


def has_places(plan: ChainPlan) -> bool:
    """Whether a plan has a place for the receivers of its output."""
    return plan.shaping_node is not None and plan.shaping_node.receivers_at is not None


def with_receivers_placed(
    plans: Sequence[ChainPlan], profiles: Sequence[Profile]
) -> list[ChainPlan]:
    """Return the plans with a place for the receivers of their outputs, where there is room."""
    plans = list(map(without_places, plans))
    running = {
        thread.node for plan in plans for server in plan.servers for thread in server.threads
    }
    busy = {server.core for plan in plans for server in plan.servers if not server.best_effort}
    nodes = [node for plan in plans for node in shaping_nodes(plan)]
    placed = []
    for plan, profile in zip(plans, profiles, strict=True):
        cores_of_others = {
            server.core for beside in plans if beside is not plan for server in beside.servers
        }
        # The slots of callbacks have no room for receivers of other chains' outputs.
        has_no_room = (
            plan.policy in PER_CALLBACK
            and plan.shaping_node is not None
            and plan.shaping_node.core in cores_of_others
        )
        placed.append(plan if has_no_room else _placed(plan, profile, running, busy, nodes))
    return placed


def _placed(
    plan: ChainPlan,
    profile: Profile,
    running: set[str],
    busy: set[int],
    nodes: Sequence[ShapingNode],
) -> ChainPlan:
    """Return a plan with a place for the receivers of its output, if there is room.

    ``running`` are the nodes in servers, ``busy`` the cores of servers, ``nodes`` all shaping
    nodes.
    """
    node, reception = plan.shaping_node, profile.reception
    if node is None or reception is None or running.issuperset(node.receivers):
        return plan
    core = node.core
    if reception.core is not None and reception.core not in busy:
        core = reception.core
    time_ns = reception.time_ns + reception.beside_ns
    waits_ns = reception.beside_once_ns
    margin = plan.margin
    if core in busy:
        if not _has_room(plan, profile, time_ns):
            return plan
        if _reaches_next_cycle(plan, time_ns + reception.longest_ns):
            # They delay the next instance by so much, for which the margin has room.
            margin = with_part_taken(margin, profile.every, profile.longest_ns, time_ns)
        waits_ns += GATE_TAKES_NS
        waits_ns += sum(
            node_work_ns(plan, beside)
            for beside in nodes
            if beside is not node and beside.core == core
        )
    place = ReceiverPlace(core=core, priority=OUTPUT_PRIORITY, time_ns=time_ns)
    predicted = plan.predicted
    received = Prediction(
        mean_ns=predicted.mean_ns + reception.mean_ns,
        max_ns=predicted.max_ns + reception.longest_ns + waits_ns,
        jitter_ns=predicted.jitter_ns + reception.longest_ns - reception.shortest_ns + waits_ns,
    )
    delivery = (reception.shortest_ns, reception.mean_ns, reception.longest_ns)
    return revised(
        plan,
        margin=margin,
        evidence=plan.evidence.model_copy(update={"delivery_ns": delivery}),
        shaping_node=node.model_copy(update={"receivers_at": place}),
        predicted=predicted.model_copy(update={"receivers": received}),
    )


def node_work_ns(plan: ChainPlan, node: ShapingNode) -> int:
    """Return how long a shaping node has its core for a message, watching the clock included."""
    return node.spin_ns + (plan.evidence.longest_publication_ns or 0) + GATE_TAKES_NS


def _reaches_next_cycle(plan: ChainPlan, after_ns: int) -> bool:
    """Whether work that follows the last output for so long delays the chain's next instance."""
    return plan.predicted.max_ns % plan.cycle_ns + after_ns > plan.cycle_ns


def _has_room(plan: ChainPlan, profile: Profile, time_ns: int) -> bool:
    """Whether a plan keeps what it promises while receivers run above its servers for so long."""
    node, period = plan.shaping_node, plan.chain.period_ns
    work_ns = time_ns + (0 if node is None else node_work_ns(plan, node))
    if plan.policy == "let-per-chain":
        return plan.evidence.max_latency_ns + work_ns < period
    if plan.policy == "let-per-callback":
        nodes = shaping_nodes(plan)
        took_ns = sum(callback.max_response_ns for callback in profile.callbacks)
        gates_ns = sum(node_work_ns(plan, gate) for gate in nodes)
        return took_ns + gates_ns + len(nodes) * time_ns < period
    if plan.policy == "pipelined":  # its stages have that room
        return True
    if _leaves_while_computing(plan) and work_ns >= plan.margin.epsilon_ns:
        return False
    delivery_ns = 0 if profile.reception is None else profile.reception.longest_ns
    return time_ns < plan.margin.epsilon_ns or not _reaches_next_cycle(plan, time_ns + delivery_ns)


def _leaves_while_computing(plan: ChainPlan) -> bool:
    """Whether an output that is a cycle late leaves while the chain still computes the next one.

    It does where bands begin before the longest latency. What its gate and its receivers take then
    comes on top of the next instance's latency: beyond the margin, that output is late as well, and
    so on for ever.
    """
    slots = publish_slots(plan)
    return bool(slots) and slots[0][0] < plan.evidence.max_latency_ns
