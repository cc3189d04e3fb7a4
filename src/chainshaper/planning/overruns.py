"""Overruns: outputs that come behind the last slot they were due in (section 6).

A shaping node sees them and treats them as the plan says (:mod:`chainshaper.enforcement.gate`).
The thread of an asynchronous publisher cannot tell an overrun from an output that came early, but
DDS can, by its age: with a **lifespan** on the topic, what waited for the slot of a later cycle
has expired when the thread may run again.
"""

from itertools import pairwise

from chainshaper.planning.plan import Plan, publish_slots, server_of
from chainshaper.planning.plan_parts import ShapingNode, Thread

__all__ = ["cycles_until_output", "output_lifespan"]


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
