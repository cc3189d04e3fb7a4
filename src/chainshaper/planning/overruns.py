"""What a plan asks of the application and the machine: overruns, publishers, warnings.

An **overrun** is an output that comes behind the last slot it was due in (section 6). A shaping
node sees them and treats them as the plan says (:mod:`chainshaper.gate.decision`). The thread of an
asynchronous publisher cannot, but DDS can, by an output's age: with a **lifespan** on the topic,
what waited for the slot of a later cycle has expired when the thread may run again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from chainshaper.planning.margins import OVERRUN_PROBABILITY, cycles_needed
from chainshaper.planning.plan import (
    PER_CALLBACK,
    Plan,
    ShapingNode,
    Thread,
    below_executors,
    messages_waiting,
    output_server,
    publish_slots,
    publisher_servers,
    publishing_servers,
    revised,
    server_of,
    until,
    with_slots,
)
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.errors import InputError

NEARLY_FULL = 0.95  # of the cycle; also the kernel's default share for real-time threads
ROOMY_SLOT_NS = 10_000_000  # suffices for many sends where the machine stalls for 1 to 8 ms


def cycles_until_output(plan: Plan, node: ShapingNode | None = None) -> int:
    """How many cycles after its own an output is due, and leaves at the earliest: 0 but under LET.

    It is the chain's output, or what ``node`` republishes: under LET per callback, each topic is
    due a cycle after the one before it. Without slots for outputs: as predicted.
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

    It is as short as it may be: an output in time waits at most until the end of the first slot,
    or of the next slot when it just missed one. An overrun with latency l waits for the first slot
    of the next cycle, CT + (x_1 − Δ) − l. So overruns are discarded up to a latency of CT − Δ with
    one slot; one that took longer still is taken for an early output of the next cycle. Under LET,
    where every output waits for the next cycle, age tells nothing.
    """
    publisher = plan.chain.publisher
    if plan.overrun != "discard" or publisher is None or cycles_until_output(plan):
        return None
    if server_of(plan, Thread(node=publisher, role="publisher")) is None:
        return None
    slots = publish_slots(plan)
    return max([slots[0][1], *(after[1] - before[1] for before, after in pairwise(slots))])


def refuse_offset(plan: Plan) -> None:
    """Refuse an offset where the phase of the chain's own timer says when its cycles start.

    Raises InputError: the plan has one; the message says how to carry it out.
    """
    if plan.offset_ns:
        raise InputError(
            f"offset: {format_duration(plan.offset_ns)} cannot be carried out here, where the"
            " chain's first timer starts its cycles: let this timer start so much later, and"
            " remove `offset` from the plan"
        )


def open_until_done(plan: Plan) -> Plan:
    """The plan as back ends and the simulator carry it out: what overruns may finish.

    Where an output that missed its slot is to leave at once, the servers that run the chain to its
    end stay open until the cycle's end (section 6), and so does the last publish slot of an
    asynchronous publisher: stopping either would delay the output by a whole cycle. The plan itself
    states what is reserved (eq. 1); where another server of the same priority has a slot there, it
    stays as planned.
    """
    shaped = plan.policy in ("shaped", "one-long-slot") and output_server(plan) is not None
    if plan.overrun != "publish" or not shaped:
        return plan
    publishers = [server for _, server, _ in publisher_servers(plan)]
    beside = [*publishing_servers(plan), *(one for one in plan.servers if one.best_effort)]
    last_start, _ = publish_slots(plan)[-1]
    longer = {
        server.name: until(server, plan.cycle_ns)
        for server in plan.servers
        if server in publishers or (server not in beside and server.slots[-1][1] >= last_start)
    }
    try:
        return revised(plan, servers=below_executors(with_slots(plan.servers, longer)))
    except InputError:  # another server has a slot there
        return plan


@dataclass(frozen=True)
class Writer:
    """A writer of an application: node, topic, history (keep last), and whether a publisher thread
    sends for it. None is: not known.
    """

    node: str
    topic: str
    depth: int | None = None
    asynchronous: bool | None = None


def check_publication(plan: Plan, writers: Sequence[Writer]) -> list[str]:
    """Check a plan that gates publishers' threads against the writers of the application; returns
    what a person must know, one sentence each.

    Raises InputError: the output is published by another node, or synchronously, or its history is
    too shallow for what is handed over while the thread may not run.
    """
    warnings: list[str] = []
    output = plan.chain.output
    for _, server, nodes in publisher_servers(plan):
        for node in nodes:
            own = {writer.topic: writer for writer in writers if writer.node == node}
            if node == plan.chain.publisher and output is not None:
                _check_output(output, node, own.get(output), messages_waiting(plan, server))
            delayed = sorted(t for t, writer in own.items() if writer.asynchronous and t != output)
            if delayed:
                warnings.append(
                    f"{', '.join(delayed)} of {node} will be delayed as well, until the slots of"
                    f" server {server.name!r}: one thread sends for all asynchronous writers of a"
                    " process. Publish them synchronously, or from another process."
                )
    return warnings


def _check_output(topic: str, node: str, writer: Writer | None, waiting: int) -> None:
    if writer is None:
        raise InputError(
            f"the plan gates the thread by which {node} publishes {topic}, but {node} does not"
            " publish it: plan again from a recording of this application"
        )
    if writer.asynchronous is False:
        raise InputError(
            f"{node} publishes {topic} synchronously, so gating its publisher thread would hold"
            " nothing: publish it asynchronously, or plan with --publication synchronous"
        )
    if writer.depth is not None and writer.depth < waiting:
        raise InputError(
            f"{topic} has a history of {writer.depth}, but {waiting} messages are handed over while"
            f" the publisher thread of {node} may not run: give it a depth of {waiting + 1}"
        )


def publication_warnings(plan: Plan) -> list[str]:
    """What a plan for asynchronous publication asks of the application; one sentence each."""
    warnings = []
    for _, server, nodes in publisher_servers(open_until_done(plan)):
        names = ", ".join(nodes)
        warnings.append(
            f"only asynchronous publication can be shaped like this, and all of it is: whatever"
            f" else {names} publishes asynchronously, such as /rosout, waits for the slots of"
            f" server {server.name!r} too."
        )
        shortest = min(end - start for start, end in server.slots)
        if shortest < ROOMY_SLOT_NS:
            warnings.append(
                f"a slot of {format_duration(shortest)} that opens late may end while {names}"
                " sends, which blocks the whole process until the next one; it costs nothing to"
                f" give it {format_duration(ROOMY_SLOT_NS)} (--publish-slot), since outputs leave"
                " when it opens."
            )
        depth, mine = plan.chain.output_depth, plan.chain.publisher in nodes
        if mine and plan.overrun == "wait" and depth == messages_waiting(plan, server):
            warnings.append(
                f"a history of {depth} has no room for an output that overran: it will be"
                " overwritten by the next. A depth of one more would keep it."
            )
    if plan.overrun == "discard" and warnings:
        lifespan, topic = output_lifespan(plan), plan.chain.output or "their topic"
        warnings.append(
            "outputs that are due in a later cycle than their own look like overruns by"
            " their age: none will be discarded."
            if lifespan is None
            else f"outputs that overran are discarded by DDS if {topic} has a lifespan of"
            f" {format_duration(lifespan)}: give it one."
        )
    return warnings


def plan_warnings(plan: Plan) -> list[str]:
    """What a person must know before relying on a plan; one sentence each, none if all is well."""
    return [*_about_late_outputs(plan), *_about_evidence(plan), *publication_warnings(plan)]


def _about_late_outputs(plan: Plan) -> Iterator[str]:
    """How many outputs will be late, if the sample tells, and what the machine's stalls cost."""
    evidence, margin = plan.evidence, plan.margin
    cycles, needed = evidence.samples + evidence.disturbed, cycles_needed(OVERRUN_PROBABILITY)
    if evidence.all_disturbed:
        cycles = max(evidence.samples, evidence.disturbed)
    if cycles < needed:
        yield (
            f"the sample is small: {cycles} cycles are too few to say how late one output in a"
            f" hundred will be. Record {needed} cycles or more."
        )
    stall = evidence.longest_stall_ns
    what = "" if stall is None else f", longest stall {milliseconds(stall)} ms"
    if evidence.all_disturbed:
        yield (
            f"the machine disturbed every cycle, but one at most{what}: the plan rests on latencies"
            " with its stalls in them. Record again on a calmer machine."
        )
    elif evidence.disturbed:
        yield f"the machine disturbed {evidence.disturbed} of {cycles} cycles{what}."
    if margin.stalls_ns:
        end = evidence.max_latency_ns + margin.epsilon_ns
        yield (
            f"covering the disturbed cycles costs {milliseconds(margin.stalls_ns)} ms: outputs"
            f" leave at {milliseconds(end)} ms; on a machine that does not stall it would be"
            f" {milliseconds(end - margin.stalls_ns)} ms (--ideal-machine)."
        )
    late = margin.overrun_probability or 0.0
    if cycles >= needed and late > OVERRUN_PROBABILITY and margin.source != "derived":
        yield (
            f"by the latencies of all cycles, up to {late:.1%} of the outputs will miss their slot"
            f" ({plan.overrun}): a larger margin (--epsilon) or a calmer machine helps."
        )


def _about_evidence(plan: Plan) -> Iterator[str]:
    """What is doubtful about the measurements, or about how much of the cycle is used."""
    evidence, cycle, margin = plan.evidence, plan.cycle_ns, plan.margin
    longest, used = evidence.max_latency_ns, evidence.utilisation or 0.0
    last = max((end for _, end in publish_slots(plan)), default=longest)
    if evidence.realtime is False:
        yield (
            "the latencies were taken without real-time scheduling: other programs are in them,"
            " and the chain's slot is longer than it needs to be. Record again with the privilege"
            " to use SCHED_FIFO."
        )
    if evidence.lost_events:
        yield (
            f"{evidence.lost_events} events were lost while recording: cycles are missing, and the"
            " longest latency may be among them. Record again, see the recording's notes."
        )
    if evidence.incomplete:
        yield (
            f"{evidence.incomplete} executions of the chain have no end in the recording; their"
            " latencies, which may be the longest, are not in the plan."
        )
    if margin.confidence_interval_ns:
        low, high = map(format_duration, margin.confidence_interval_ns)
        yield (
            f"the margin {format_duration(margin.epsilon_ns)} is an estimate; with 95 % confidence"
            f" it lies between {low} and {high}."
        )
    if NEARLY_FULL * cycle < last <= cycle:
        yield (
            f"the plan fills {last / cycle:.1%} of the cycle {format_duration(cycle)}: an execution"
            " a little longer than any measured delays the next one."
        )
    if longest >= cycle:
        yield (
            f"the longest latency {format_duration(longest)} is not shorter than the cycle"
            f" {format_duration(cycle)}: executions of the chain overlapped while they were"
            " measured, and response times have each other's interference in them."
        )
    if NEARLY_FULL * cycle < longest < cycle:
        yield (
            "a cycle as long as the longest measured has its core busy for more than"
            f" {NEARLY_FULL:.0%}, where the kernel throttles real-time threads"
            " (/proc/sys/kernel/sched_rt_runtime_us)."
        )
    if used > NEARLY_FULL:
        yield (
            f"the chain's execution takes {used:.1%} of its core: latencies will pile up from"
            " cycle to cycle, whatever the slots."
        )
