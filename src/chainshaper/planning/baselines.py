"""The schedules that latency shaping is compared with (sections 2.5, 5.1 and 5.3).

Each takes a shaped plan, for the chain, the evidence and the cores it names, and returns the plan
of another policy for the same chain. Predictions follow the shaped plan's convention: an output in
a slot is represented by the slot's end.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from chainshaper.planning.plan import (
    Plan,
    Prediction,
    Server,
    Slot,
    Thread,
    output_server,
    publish_slots,
    revised,
    with_slots,
)
from chainshaper.planning.shaping import OUTPUT_PRIORITY, shaping_node_like
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.yaml_file import wrong_values_refused


@dataclass(frozen=True)
class CallbackTimes:
    """Measured response times of one callback, and what it waits for.

    ``after`` are the places, in the sequence that this stands in, of the callbacks whose data it
    needs: one for a link of a chain, several for a synchronising callback.
    """

    node: str
    core: int
    min_response_ns: int
    mean_response_ns: int
    max_response_ns: int
    after: tuple[int, ...] = ()


def server_per_chain(plan: Plan) -> Plan:
    """One server for the whole chain, nothing shaped (section 3.1; table 4 row 2).

    The chain is isolated from best-effort work and its latency is what was measured.
    """
    publishing, evidence = output_server(plan), plan.evidence
    return revised(
        plan,
        policy="server-per-chain",
        servers=tuple(server for server in plan.servers if server is not publishing),
        shaping_node=None,
        further_shaping_nodes=(),
        predicted=Prediction(
            mean_ns=evidence.mean_latency_ns,
            max_ns=evidence.max_latency_ns,
            jitter_ns=evidence.max_latency_ns - evidence.min_latency_ns,
        ),
    )


def server_per_callback(
    plan: Plan,
    callbacks: Sequence[CallbackTimes],
    *,
    margin_ns: int = 0,
    boundary_ns: int = 1_000_000,
) -> Plan:
    """Time-triggered scheduling: each callback runs in a slot of its own, as long as its longest.

    A slot starts when the slots of all callbacks that this one waits for have ended, the
    synchronisation points of a graph (table 4 row 1), and the slot before it on its core. It is the
    longest response time plus ``margin_ns`` long, rounded up to a multiple of ``boundary_ns``.
    Callbacks of one node share its thread, hence a server with several slots. Each of ``callbacks``
    comes after those it waits for; the chain's last stands last, the first starts the cycle.

    Raises:
        InputError: no callbacks, or one that waits for itself or a later one.
        OperationError: the slots do not fit into the cycle.
    """
    slots = _slots_in_sequence(callbacks, margin_ns, boundary_ns)
    end = max(slot[1] for slot in slots)
    if end > plan.cycle_ns:
        raise OperationError(
            f"one slot per callback takes {format_duration(end)}, the cycle is"
            f" {format_duration(plan.cycle_ns)}: shape the chain instead, plan with a smaller"
            " margin (--epsilon), or move callbacks to another core"
        )
    last, (start, _) = callbacks[-1], slots[-1]
    with wrong_values_refused(Plan):
        return revised(
            plan,
            policy="server-per-callback",
            servers=tuple(
                _server_of_node(node, callbacks, slots)
                for node in dict.fromkeys(callback.node for callback in callbacks)
            ),
            shaping_node=None,
            further_shaping_nodes=(),
            predicted=Prediction(
                mean_ns=start + last.mean_response_ns,
                max_ns=start + last.max_response_ns,
                jitter_ns=last.max_response_ns - last.min_response_ns,
            ),
        )


def let_per_chain(plan: Plan) -> Plan:
    """Logical execution time for the chain as one task: output at the next cycle's start.

    The output is published in a slot at the beginning of the following cycle, so the latency is one
    period (section 5.3, table 5).

    Raises:
        InputError: a plan without a publish slot, or a chain so fast that it could publish in the
            cycle it began in.
    """
    start, end = _one_slot(plan)
    length = end - start
    if plan.evidence.min_latency_ns <= length:
        raise InputError(
            f"the shortest latency {format_duration(plan.evidence.min_latency_ns)} is not longer"
            f" than the publish slot {format_duration(length)}, so an output could leave in its"
            " own cycle: use a shorter slot"
        )
    publishing = output_server(plan)
    ends = {s.name: length if s is publishing else plan.cycle_ns for s in plan.servers}
    return revised(
        plan,
        policy="let-per-chain",
        servers=with_slots(plan.servers, {name: ((0, end),) for name, end in ends.items()}),
        predicted=_after_periods(plan, 1, length),
    )


def let_per_callback(plan: Plan, topics: Sequence[str], publishers: Sequence[str] = ()) -> Plan:
    """Logical execution time for every callback: each one's output waits for the next cycle.

    ``topics`` are the outputs of the chain's callbacks in order, the chain's own last;
    ``publishers`` their nodes, where known. Behind each topic a shaping node republishes at the
    beginning of the next cycle: as many periods as there are callbacks (section 5.3, table 5).

    Raises:
        InputError: a plan without a shaping node, topics that do not end with the chain's output,
            or repeat one.
        OperationError: the slots do not fit into the cycle.
    """
    last = plan.shaping_node
    if last is None or not topics or topics[-1] != last.output:
        raise InputError(
            "LET per callback needs a plan with a shaping node and all topics of the chain, its"
            " output last"
        )
    with wrong_values_refused(Plan):
        inside = tuple(
            shaping_node_like(last, topic, publisher)
            for topic, publisher in zip_longest(topics[:-1], publishers[: len(topics) - 1])
        )
        threads = [node.thread for node in (*inside, last)]
        return revised(_let_per_thread(plan, threads), further_shaping_nodes=inside)


def let_per_callback_asynchronous(plan: Plan, publishers: Sequence[str]) -> Plan:
    """:func:`let_per_callback` for callbacks that publish asynchronously: no nodes are added.

    The publisher threads of ``publishers``, the nodes of the chain's callbacks in order, run in the
    slots.

    Raises:
        InputError: a plan that does not gate the publisher's thread, or nodes that do not end with
            it, or repeat one.
        OperationError: the slots do not fit into the cycle.
    """
    if plan.shaping_node is not None or not publishers or publishers[-1] != plan.chain.publisher:
        raise InputError(
            "asynchronous LET per callback needs a plan for asynchronous publication and the"
            " nodes of the chain, the one that publishes its output last"
        )
    with wrong_values_refused(Plan):
        threads = [Thread(node=name, role="publisher") for name in publishers]
        return _let_per_thread(plan, threads)


def _let_per_thread(plan: Plan, threads: list[Thread]) -> Plan:
    """Publishing threads in slots at the beginning of the cycle, in reverse order of the chain.

    Whatever a fast callback makes of the data of one slot, the slot of its own output is over.
    """
    start, end = _one_slot(plan)
    length, publishing = end - start, output_server(plan)
    if length * len(threads) > plan.cycle_ns:
        raise OperationError(
            f"{len(threads)} publish slots of {format_duration(length)} do not fit into the cycle"
            f" {format_duration(plan.cycle_ns)}: use shorter slots"
        )
    gates = [
        Server(
            name="output" if number == 0 else f"output_{thread.node.strip('/')}",
            core=publishing.core if publishing is not None else 0,
            priority=OUTPUT_PRIORITY,
            slots=((number * length, (number + 1) * length),),
            threads=(thread,),
        )
        for number, thread in enumerate(reversed(threads))
    ]
    others = [server for server in plan.servers if server is not publishing]
    chain = with_slots(others, {server.name: ((0, plan.cycle_ns),) for server in others})
    return revised(
        plan,
        policy="let-per-callback",
        servers=(*chain, *gates),
        predicted=_after_periods(plan, len(threads), length),
    )


def _slots_in_sequence(
    callbacks: Sequence[CallbackTimes], margin_ns: int, boundary_ns: int
) -> list[Slot]:
    if not callbacks or margin_ns < 0 or boundary_ns <= 0:
        raise InputError(
            "slots per callback need callbacks, a margin of 0ms or more and a boundary longer"
            " than 0ms"
        )
    slots: list[Slot] = []
    busy_until: dict[int, int] = {}
    for number, callback in enumerate(callbacks):
        if any(not 0 <= before < number for before in callback.after):
            raise InputError(
                f"callback {number} of {callback.node} waits for {callback.after}, which must be"
                " callbacks before it: order them along the graph"
            )
        start = max(
            [busy_until.get(callback.core, 0), *(slots[before][1] for before in callback.after)]
        )
        steps = -(-(callback.max_response_ns + margin_ns) // boundary_ns)
        slots.append((start, start + max(1, steps) * boundary_ns))
        busy_until[callback.core] = slots[-1][1]
    return slots


def _server_of_node(node: str, callbacks: Sequence[CallbackTimes], slots: list[Slot]) -> Server:
    own = [number for number, callback in enumerate(callbacks) if callback.node == node]
    cores = {callbacks[number].core for number in own}
    if len(cores) > 1:
        raise InputError(f"{node} runs on one core, not on {sorted(cores)}: correct it")
    return Server(
        name=node.strip("/"),
        core=cores.pop(),
        priority=OUTPUT_PRIORITY,
        slots=_joined([slots[number] for number in own]),
        threads=(Thread(node=node),),
    )


def _joined(slots: list[Slot]) -> tuple[Slot, ...]:
    joined: list[Slot] = []
    for start, end in slots:
        if joined and joined[-1][1] == start:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return tuple(joined)


def _one_slot(plan: Plan) -> Slot:
    slots = publish_slots(plan)
    if len(slots) != 1:
        raise InputError(f"LET needs a plan with one publish slot; this one has {len(slots)}")
    return slots[0]


def _after_periods(plan: Plan, periods: int, slot_ns: int) -> Prediction:
    latency = periods * plan.chain.period_ns + slot_ns
    return Prediction(mean_ns=latency, max_ns=latency, jitter_ns=slot_ns, shares=(1.0,))
