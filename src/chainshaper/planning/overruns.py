"""Overruns: outputs that come behind the last slot they were due in (section 6).

A shaping node sees them and treats them as the plan says (:mod:`chainshaper.enforcement.gate`).
The thread of an asynchronous publisher cannot tell an overrun from an output that came early, but
DDS can, by its age: with a **lifespan** on the topic, what waited for the slot of a later cycle
has expired when the thread may run again.
"""

from itertools import pairwise

from chainshaper.errors import InputError
from chainshaper.planning.plan import Plan, output_server, publish_slots, revised, server_of
from chainshaper.planning.plan_parts import ShapingNode, Thread

__all__ = ["cycles_until_output", "output_lifespan", "with_room_for_overruns"]


def cycles_until_output(plan: Plan, node: ShapingNode | None = None) -> int:
    """How many cycles after its own an output is due: 0, and more under LET.

    It is the chain's output, or what ``node`` republishes: under LET per callback, each topic
    inside the chain is due a cycle after the one before it.
    """
    if plan.policy == "let-per-callback" and node in plan.further_shaping_nodes:
        return plan.further_shaping_nodes.index(node) + 1
    return (plan.predicted.max_ns - 1) // plan.cycle_ns


def output_lifespan(plan: Plan) -> int | None:
    """The lifespan (ns) by which DDS discards what overruns; None where it is not needed.

    It is as short as it may be: an output that comes in time waits no longer than until the end
    of the first slot when it was handed over at the very start of the cycle, or of the next slot
    when it just missed one. An overrun waits from when it is handed over, at latency l, to the
    first slot of the next cycle, CT + (x_1 − Δ) − l. So overruns are discarded up to a latency of
    CT − Δ with one slot; one that took longer still is taken for an early output of the next
    cycle. Under LET, where every output waits for the next cycle, age tells nothing.
    """
    publisher = plan.chain.publisher
    if plan.overrun != "discard" or publisher is None or cycles_until_output(plan):
        return None
    if server_of(plan, Thread(node=publisher, role="publisher")) is None:
        return None
    slots = publish_slots(plan)
    waits = [after[1] - before[1] for before, after in pairwise(slots)]
    return max([slots[0][1], *waits])


def with_room_for_overruns(plan: Plan) -> Plan:
    """The plan with its last publish slot a tenth of the cycle long, where there is room for it.

    A gate publishes at a slot's start, so its width does not move the output. But what comes late
    by less than the width then leaves at once, instead of a whole cycle later. The chain's servers
    go on until the end of that slot, so that it can finish (section 6), and a back end that stops
    its threads does not do so in the very moment of the publication. Predictions stay: they are
    for outputs in time.
    """
    output = output_server(plan)
    if output is None or plan.overrun != "wait" or plan.policy != "shaped":
        return plan
    start, end = output.slots[-1]
    until = min(plan.cycle_ns, max(end, start + plan.cycle_ns // 10))
    servers = tuple(
        server.model_copy(update={"slots": (*server.slots[:-1], (server.slots[-1][0], until))})
        if server is output or server.slots[-1][1] == start
        else server
        for server in plan.servers
    )
    try:
        return revised(plan, servers=servers)
    except InputError:  # somebody else has a slot there
        return plan
