"""Who receives a shaped output: their place in a plan, and what it promises for them.

An output is of use when its receiver's callback starts. Where it leaves while the chain computes
for the next cycle (logical execution time, a slot at the cycle's end, a pipeline, other chains), a
receiver below all servers waits until that is over. So receivers have a place:

* where they were recorded on a core without servers, they stay there;
* else they run on the shaping node's core, behind shaping nodes and above the servers of chains,
  and the plan leaves the core to them for as long as they took in a cycle: it is part of what other
  chains wait for, and where a chain is hit by those that receive its own output, its slot has to
  have that room.

Where there is no room, or nothing says how long they take, they run below all servers, as the core
is free, and nothing is promised for them.
"""

from collections.abc import Sequence
from dataclasses import replace

from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Prediction,
    ReceiverPlace,
    ShapingNode,
    revised,
    shaping_nodes,
)
from chainshaper.planning.margins import with_part_taken
from chainshaper.planning.profile import GATE_TAKES_NS, Profile
from chainshaper.planning.shaping import OUTPUT_PRIORITY


def without_reception(profile: Profile) -> Profile:
    """The profile of a chain whose receivers have no place."""
    return replace(profile, reception=None)


def without_places(plan: ChainPlan) -> ChainPlan:
    """The plan with no place for those that receive its output."""
    node = plan.shaping_node
    if node is None or node.receivers_at is None:
        return plan
    return revised(
        plan,
        shaping_node=node.model_copy(update={"receivers_at": None}),
        predicted=plan.predicted.model_copy(update={"receivers": None}),
    )


def has_places(plan: ChainPlan) -> bool:
    """Whether a plan has a place for those that receive its output."""
    return plan.shaping_node is not None and plan.shaping_node.receivers_at is not None


def with_receivers_placed(
    plans: Sequence[ChainPlan], profiles: Sequence[Profile]
) -> list[ChainPlan]:
    """The plans with a place for those that receive their outputs, where there is room for it."""
    plans = list(map(without_places, plans))
    running = {thread.node for one in plans for server in one.servers for thread in server.threads}
    busy = {one.core for plan in plans for one in plan.servers if not one.best_effort}
    nodes = [node for plan in plans for node in shaping_nodes(plan)]
    shared = [
        {one.core for other in plans if other is not plan for one in other.servers}
        for plan in plans
    ]
    return [
        _placed(plan, profile, running, busy, nodes)
        if plan.policy not in PER_CALLBACK
        or plan.shaping_node is None
        # What has the core in slots of other chains' callbacks is not in these.
        or plan.shaping_node.core not in theirs
        else plan
        for plan, profile, theirs in zip(plans, profiles, shared, strict=True)
    ]


def _placed(
    plan: ChainPlan,
    profile: Profile,
    running: set[str],
    busy: set[int],
    nodes: Sequence[ShapingNode],
) -> ChainPlan:
    node, one = plan.shaping_node, profile.reception
    if node is None or one is None or running.issuperset(node.receivers):
        return plan
    core = node.core if one.core is None or one.core in busy else one.core
    time_ns = one.time_ns + one.beside_ns
    waits_ns = one.beside_once_ns
    margin = plan.margin
    if core in busy:
        if not _has_room(plan, profile, time_ns):
            return plan
        if _reaches_next_cycle(plan, time_ns + one.longest_ns):
            # They delay the next instance by so much, for which the margin is there.
            margin = with_part_taken(margin, profile.every, profile.longest_ns, time_ns)
        waits_ns += GATE_TAKES_NS
        waits_ns += sum(node_work_ns(plan, n) for n in nodes if n is not node and n.core == core)
    place = ReceiverPlace(core=core, priority=OUTPUT_PRIORITY, time_ns=time_ns)
    predicted = plan.predicted
    received = Prediction(
        mean_ns=predicted.mean_ns + one.mean_ns,
        max_ns=predicted.max_ns + one.longest_ns + waits_ns,
        jitter_ns=predicted.jitter_ns + one.longest_ns - one.shortest_ns + waits_ns,
    )
    delivery = (one.shortest_ns, one.mean_ns, one.longest_ns)
    return revised(
        plan,
        margin=margin,
        evidence=plan.evidence.model_copy(update={"delivery_ns": delivery}),
        shaping_node=node.model_copy(update={"receivers_at": place}),
        predicted=predicted.model_copy(update={"receivers": received}),
    )


def node_work_ns(plan: ChainPlan, node: ShapingNode) -> int:
    """For how long a shaping node has its core for a message, watching the clock included."""
    return node.spin_ns + (plan.evidence.longest_publication_ns or 0) + GATE_TAKES_NS


def _reaches_next_cycle(plan: ChainPlan, after_ns: int) -> bool:
    """Whether what follows the last output for so long reaches the next instance of its chain."""
    return plan.predicted.max_ns % plan.cycle_ns + after_ns > plan.cycle_ns


def _has_room(plan: ChainPlan, profile: Profile, time_ns: int) -> bool:
    """Whether a plan keeps what it promises while receivers run above its servers for so long."""
    node, period = plan.shaping_node, plan.chain.period_ns
    work_ns = time_ns + (0 if node is None else node_work_ns(plan, node))
    if plan.policy == "let-per-chain":
        return plan.evidence.max_latency_ns + work_ns < period
    if plan.policy == "let-per-callback":
        nodes = shaping_nodes(plan)
        took_ns = sum(one.max_response_ns for one in profile.callbacks)
        gates_ns = sum(node_work_ns(plan, one) for one in nodes)
        return took_ns + gates_ns + len(nodes) * time_ns < period
    if plan.policy == "pipelined":  # its stages have that room
        return True
    delivery_ns = 0 if profile.reception is None else profile.reception.longest_ns
    return time_ns < plan.margin.epsilon_ns or not _reaches_next_cycle(plan, time_ns + delivery_ns)
