"""Overruns: outputs that come behind the last slot they were due in (section 6).

A shaping node sees them and treats them as the plan says (:mod:`chainshaper.gate.decision`).
The thread of an asynchronous publisher cannot tell an overrun from an output that came early, but
DDS can, by its age: with a **lifespan** on the topic, what waited for the slot of a later cycle
has expired when the thread may run again.
"""

from itertools import pairwise

from chainshaper.planning.plan import (
    PER_CALLBACK,
    Plan,
    output_server,
    publish_slots,
    publishing_servers,
    revised,
    server_of,
)
from chainshaper.planning.plan_parts import ShapingNode, Thread
from chainshaper.planning.publisher_threads import below_executors, publisher_servers
from chainshaper.values.errors import InputError

__all__ = ["cycles_until_output", "open_until_done", "output_lifespan"]


def cycles_until_output(plan: Plan, node: ShapingNode | None = None) -> int:
    """How many cycles after its own an output is due, and leaves at the earliest: more than 0
    under LET only.

    It is the chain's output, or what ``node`` republishes: under LET per callback, each topic
    inside the chain is due a cycle after the one before it. (Without slots for outputs, as many as
    the prediction takes.)
    """
    if plan.policy == "let-per-chain":
        return 1
    if plan.policy == "let-per-callback":
        if node in plan.further_shaping_nodes:
            return plan.further_shaping_nodes.index(node) + 1
        return len(publishing_servers(plan))
    return (plan.predicted.max_ns - 1) // plan.cycle_ns if plan.policy in PER_CALLBACK else 0


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


def open_until_done(plan: Plan) -> Plan:
    """The plan as back ends and the simulator carry it out: what overruns may finish.

    Where an output that missed its slot is to leave at once, the servers that run the chain to its
    end stay open until the cycle's end (section 6), and so does the last publish slot of an
    asynchronous publisher's thread: a server that stopped either of them would delay the output by
    a whole cycle. The plan itself states what is reserved (eq. 1); it is also what is shared out
    among several chains of a core, and where another server of the same priority has a slot there,
    the servers stay as planned.

    In the next cycle the thread of an asynchronous publisher waits for its slot again.
    """
    shaped = plan.policy in ("shaped", "one-long-slot") and output_server(plan) is not None
    if plan.overrun != "publish" or not shaped:
        return plan
    publishers = [server for _, server, _ in publisher_servers(plan)]
    publishing, (last_start, _) = publishing_servers(plan), publish_slots(plan)[-1]
    servers = [
        server.model_copy(
            update={"slots": (*server.slots[:-1], (server.slots[-1][0], plan.cycle_ns))}
        )
        if server in publishers or (server not in publishing and server.slots[-1][1] >= last_start)
        else server
        for server in plan.servers
    ]
    try:
        return revised(plan, servers=below_executors(servers))
    except InputError:  # another server has a slot there
        return plan
