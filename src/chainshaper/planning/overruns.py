"""What a plan asks of the application and the machine: overruns, publishers, warnings.

An **overrun** is an output that comes behind the last slot it was due in (section 6). A shaping
node sees them and treats them as the plan says (:mod:`chainshaper.robot.gate`). The thread of
an asynchronous publisher cannot, but DDS can, by an output's age: with a **lifespan** on the topic,
what waited for the slot of a later cycle has expired when the thread may run again.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, pairwise, product
from typing import NamedTuple

from chainshaper.planning import chain_plan as plans
from chainshaper.planning.chain_plan import PER_CALLBACK, ChainPlan, ShapingNode, Slot, Thread
from chainshaper.planning.late_shares import cycles_needed
from chainshaper.planning.margins import OVERRUN_PROBABILITY
from chainshaper.values.durations import duration_text, milliseconds
from chainshaper.values.errors import InputError

IDLE_BAND = 0.02  # of the cycles: a band that has less does next to nothing for the average
NEARLY_FULL = 0.95  # of the cycle; also the kernel's default share for real-time threads
# How far apart a gate's outputs of one slot are (p0.5–p99.5 measured: 0.02–0.1 ms, see
# experiments/RESULTS.md), and those of a publisher's thread stopped until its slot (0.02–0.49 ms):
GATE_NS, STOPPED_THREAD_NS = 100_000, 500_000
ROOMY_SLOT_NS = 10_000_000  # suffices for many sends where the machine stalls for 1 to 8 ms


def cycles_until_output(plan: ChainPlan, node: ShapingNode | None = None) -> int:
    """How many cycles after its own the chain's output, or what ``node`` republishes, is due: under
    LET per callback, each topic a cycle after the one before it.
    """
    if plan.policy == "let-per-chain":
        return 1
    if plan.policy == "let-per-callback":
        if node in plan.further_shaping_nodes:
            return plan.further_shaping_nodes.index(node) + 1
        return len(plans.publishing_servers(plan))
    return (plan.predicted.max_ns - 1) // plan.cycle_ns if plan.policy in PER_CALLBACK else 0


class Expected(NamedTuple):
    """What is seen of outputs that gates let go as slots start, at ``leave_ns`` (all in ns); a
    plan's prediction counts the ends of slots (eq. 5), the bound of what comes in an open one.
    """

    leave_ns: tuple[int, ...]
    mean_ns: int
    max_ns: int
    jitter_ns: int


def expected(plan: ChainPlan) -> Expected | None:
    """What a plan's outputs will look like; None where no slots give them their places."""
    leave, shares = tuple(start for start, _ in slots_of_latency(plan)), plan.predicted.shares
    if plan.policy == "one-long-slot" or not 0 < len(leave) == len(shares):
        return None
    apart = STOPPED_THREAD_NS if any(plans.publisher_servers(plan)) else GATE_NS
    mean = round(sum(share * start for share, start in zip(shares, leave, strict=True)))
    return Expected(leave, mean, leave[-1] + apart, leave[-1] - leave[0] + apart)


def output_lifespan(plan: ChainPlan) -> int | None:
    """The lifespan (ns) by which DDS discards what overruns; None where it is not needed.

    An output in time waits at most until the end of the first slot, or of the next slot when it
    just missed one; an overrun with latency l for the first slot of the next cycle, CT + (x_1 − Δ)
    − l. Under LET, where every output waits for the next cycle, age tells nothing.
    """
    publisher = plan.chain.publisher
    if plan.overrun != "discard" or publisher is None or cycles_until_output(plan):
        return None
    if plans.server_of(plan, Thread(node=publisher, role="publisher")) is None:
        return None
    slots = plans.publish_slots(plan)
    return max([slots[0][1], *(after[1] - before[1] for before, after in pairwise(slots))])


def open_until_done(plan: ChainPlan, closed_ns: int = 0) -> ChainPlan:
    """The plan as back ends and the simulator carry it out: what overruns may finish.

    The servers that run the chain to its end stay open until the cycle's end (section 6): stopped
    at L̄ + ε, the chain would go on in the next cycle, and delay its output too. Where an output
    that missed its slot is to leave at once, so does the last publish slot of an asynchronous
    publisher. The slots of other servers of the same core and priority are left out, and the last
    ``closed_ns`` of a cycle: a thread whose timer expires in these waits for its slot. A stage of a
    pipeline stays open until the next slot of its core begins.

    Servers of callbacks stay open too, but for one in which chains begin: a callback that was
    stopped would take its next slot, and every output would be late until two short executions met.
    A server of a whole chain that shapes nothing is there for what runs beside it: it is closed.
    So are all servers of a plan whose ``slot_ends`` are closed.
    """
    if plan.slot_ends == "closed":
        return plan
    end_ns = plan.cycle_ns - closed_ns
    longer: dict[str, Sequence[Slot]] = {}
    if plan.policy == "pipelined" and plan.overrun == "publish":
        for one in plans.running_servers(plan):
            same_core = (other.slots for other in plan.servers if other.core == one.core)
            starts = sorted(start for slots in same_core for start, _ in slots)
            longer[one.name] = [
                (start, next((later for later in starts if later >= end), max(end, end_ns)))
                for start, end in one.slots
            ]
        return plans.revised(plan, servers=plans.with_slots(plan.servers, longer))
    if plan.policy == "server-per-callback":
        for one in plan.servers:
            begins = one.slots[0][0] == 0 and len(plan.servers) > 1
            if not begins and not one.best_effort:
                longer[one.name] = plans.until(one, end_ns)
        # Not checked: behind what is planned, slots of servers meet.
        return plan.model_copy(update={"servers": plans.with_slots(plan.servers, longer)})
    if plan.policy not in ("shaped", "one-long-slot") or plans.output_server(plan) is None:
        return plan
    done, _ = plans.publish_slots(plan)[-1]
    to_the_end = [
        one for one in plans.running_servers(plan) if one.slots[-1][0] < done <= one.slots[-1][1]
    ]
    at_once = [one for _, one, _ in plans.publisher_servers(plan) if plan.overrun == "publish"]
    in_turn = [one for one in plan.servers if one in to_the_end or one in at_once]
    for one in sorted(in_turn, key=lambda server: server.slots[-1][1], reverse=True):
        taken = [
            slot
            for other in plan.servers
            if other is not one and plan.equal_priorities == "apart"
            if (other.core, other.priority) == (one.core, one.priority)
            for slot in longer.get(other.name, other.slots)
        ]
        longer[one.name] = slots_without(plans.until(one, end_ns), taken)
    try:
        return plans.revised(
            plan, servers=plans.below_executors(plans.with_slots(plan.servers, longer))
        )
    except InputError:  # below its executor, a publisher would meet another server's slot
        return plan


def with_output_moved(plan: ChainPlan, by_ns: int) -> ChainPlan:
    """The plan with the slots of its output moved by so much, and with them the ends of those that
    run the chain until then. Raises InputError: there they may not be.
    """
    edges = {edge for slot in plans.publish_slots(plan) for edge in slot}
    slots = {
        server.name: [
            (start + by_ns * (start in edges), end + by_ns * (end in edges))
            for start, end in server.slots
        ]
        for server in plan.servers
        if not server.best_effort
    }
    return plans.revised(plan, servers=plans.with_slots(plan.servers, slots))


def why_not_followed(plan: ChainPlan) -> str | None:
    """Why the slots of a plan cannot follow the latencies, None where they can."""
    if plan.policy != "shaped":
        return f"under {plan.policy} slots are where the policy has them"
    if plan.modes is not None:
        return "each mode has latencies and a slot of its own, and one promise is for all"
    if plan.shaping_node is None:
        return "no shaping node sees when outputs come (plan with --publication synchronous)"
    if plan.further_shaping_nodes:
        return "its other outputs are published in slots of the same servers"
    return None


def united(slots: Sequence[Slot]) -> tuple[Slot, ...]:
    """Slots ascending; those that overlap or touch are one."""
    found: list[Slot] = []
    for start, end in sorted(slots):
        first, before = found.pop() if found and start <= found[-1][1] else (start, end)
        found.append((first, max(end, before)))
    return tuple(found)


def in_cycle(opens_ns: int, closes_ns: int, cycle_ns: int) -> tuple[Slot, ...]:
    """A slot that repeats every cycle, in one of these: one slot, or two."""
    start = opens_ns % cycle_ns
    end = start + closes_ns - opens_ns
    return ((start, end),) if end <= cycle_ns else ((0, end - cycle_ns), (start, cycle_ns))


def slots_without(slots: Sequence[Slot], taken: Sequence[Slot]) -> tuple[Slot, ...]:
    """Slots but for what is taken of them."""
    left = []
    for start, end in slots:
        free_from = start
        for begins, ends in sorted([*taken, (end, end)]):
            if free_from < min(begins, end):
                left.append((free_from, min(begins, end)))
            free_from = max(free_from, ends)
    return tuple(left)


@dataclass(frozen=True)
class Writer:
    """A writer of an application, ``depth`` its history; ``asynchronous``: a thread sends for all
    such writers of its ``process``. None is: not known.
    """

    node: str
    topic: str
    depth: int | None = None
    asynchronous: bool | None = None
    process: int | None = None


def check_publication(plan: ChainPlan, writers: Sequence[Writer]) -> list[str]:
    """What a person must know of a plan that gates the publishers' threads of these writers.

    Raises InputError: the output is published by another node, or synchronously, or its history is
    too shallow for what is handed over while the thread may not run.
    """
    warnings: list[str] = []
    output = plan.chain.output
    for _, server, nodes in plans.publisher_servers(plan):
        for node in nodes:
            own = {writer.topic: writer for writer in writers if writer.node == node}
            if node == plan.chain.publisher and output is not None:
                _check_output(output, node, own.get(output), plans.messages_waiting(plan, server))
            processes = {writer.process for writer in own.values()} - {None}
            beside = (one for one in writers if one.node == node or one.process in processes)
            others = [
                one
                for one in beside
                if one.asynchronous is not False and (one.node, one.topic) != (node, output)
            ]
            if others:
                doubt = {True: "", None: " (if asynchronous)"}
                topics = sorted({f"{one.topic}{doubt[one.asynchronous]}" for one in others})
                said = f"{', '.join(topics)} of {', '.join(sorted({one.node for one in others}))}"
                said += f" will be delayed as well, until the slots of server {server.name!r}:"
                remedy = "publish synchronously, or from another process, which has its own thread."
                warnings.append(f"{said} {remedy}")
    return warnings


def _check_output(topic: str, node: str, writer: Writer | None, waiting: int) -> None:
    if writer is None:
        gated = f"{node} is to publish {topic}, but {node} does not publish it"
        raise InputError(f"{gated}: plan again from a recording of this application")
    if writer.asynchronous is False:
        reason = f"{node} publishes {topic} synchronously, so gating its thread would hold nothing"
        raise InputError(
            f"{reason}: publish asynchronously, or plan with --publication synchronous"
        )
    if writer.depth is not None and writer.depth < waiting:
        reason = f"{topic} has a history of {writer.depth}, but {waiting} messages come while the"
        raise InputError(f"{reason} thread of {node} may not run: give it a depth of {waiting + 1}")


def publication_warnings(plan: ChainPlan) -> list[str]:
    """What a plan for asynchronous publication asks of the application; one sentence each."""
    warnings = []
    for _, server, nodes in plans.publisher_servers(open_until_done(plan)):
        names = ", ".join(nodes)
        said = f"all asynchronous publication is shaped: what else {names} publishes so, such as"
        warnings.append(f"{said} /rosout, waits for the slots of {server.name!r} too.")
        shortest = min(end - start for start, end in server.slots)
        if shortest < ROOMY_SLOT_NS:
            said = (
                f"a slot of {duration_text(shortest)} that opens late may end while {names} sends"
            )
            said += ", which blocks the whole process until the next one; one of"
            said += f" {duration_text(ROOMY_SLOT_NS)} (--publish-slot) costs nothing."
            warnings.append(said)
        depth, mine = plan.chain.output_depth, plan.chain.publisher in nodes
        if mine and plan.overrun == "wait" and depth == plans.messages_waiting(plan, server):
            said = f"a history of {depth} has no room for an output that overran"
            warnings.append(f"{said}: give it one more.")
    if plan.overrun == "discard" and warnings:
        lifespan, topic = output_lifespan(plan), plan.chain.output or "their topic"
        warnings.append(
            "outputs due in a later cycle look like overruns by their age: none will be discarded."
            if lifespan is None
            else f"outputs that overran are discarded by DDS if {topic} has a lifespan of"
            f" {duration_text(lifespan)}: give it one."
        )
    return warnings


def plan_warnings(*chains: ChainPlan) -> list[str]:
    """What a person must know before relying on plans; one sentence each, none if all is well."""
    found = []
    for plan in chains:
        name = f"{plan.chain.spec or plan.chain.output}: " if chains[1:] else ""
        about = chain(
            *(_about_stages(plan), _about_late_outputs(plan), _about_evidence(plan)),
            _about_receivers(plan),
        )
        found += [f"{name}{warning}" for warning in (*about, *publication_warnings(plan))]
    return found


def _about_stages(plan: ChainPlan) -> Iterator[str]:
    """Where a pipeline is cut, what it costs, and what has to be right for it."""
    if plan.policy != "pipelined":
        return
    longest, cycle = plan.evidence.max_latency_ns, plan.cycle_ns
    stages = plans.running_servers(plan)
    where = (f"{', '.join(t.node for t in one.threads)} on core {one.core}" for one in stages)
    cost = _leaves_at(plan) - longest - plan.margin.epsilon_ns
    waits = f"; {milliseconds(cost)} ms of it for stages that wait for their turn" if cost else ""
    said = f"the chain takes up to {milliseconds(longest)} ms, {longest / cycle:.2f} times its"
    said += f" cycle, and has {len(stages)} stages: {'; '.join(where)}. Outputs leave at"
    yield f"{said} {milliseconds(_leaves_at(plan))} ms, once a cycle{waits}."
    for one, two in combinations(stages, 2):
        both = product(one.slots, two.slots) if one.core == two.core else ()
        if any(plans.meet(*pair) for pair in both):
            said = f"{one.name} and {two.name} have core {one.core} at the same time"
            yield f"{said}: right only where their callbacks wait rather than compute."


def _leaves_at(plan: ChainPlan) -> int:
    """When outputs leave, from the start of their chain on, if they come in time."""
    slots = slots_of_latency(plan)
    return slots[-1][0] if slots else plan.evidence.max_latency_ns + plan.margin.epsilon_ns


def evidence_cycles(plan: ChainPlan) -> int:
    """How many cycles a plan rests on, disturbed ones included."""
    evidence = plan.evidence
    if evidence.all_disturbed:
        return max(evidence.samples, evidence.disturbed)
    return evidence.samples + evidence.disturbed


def _about_late_outputs(plan: ChainPlan) -> Iterator[str]:
    """Which bands hardly any cycle takes, how many outputs will be late, if the sample tells, and
    what the machine's stalls cost.
    """
    evidence, margin, shares = plan.evidence, plan.margin, plan.predicted.shares
    idle = [str(number) for number, share in enumerate(shares, start=1) if share < IDLE_BAND]
    if idle and len(shares) > 1 and plan.modes is None:
        said = f"bands with less than {IDLE_BAND:.0%} of the cycles: {', '.join(idle)} of"
        yield f"{said} {len(shares)}: limit --mean-at-most or --max-share, or plan fewer."
    cycles, needed = evidence_cycles(plan), cycles_needed(OVERRUN_PROBABILITY)
    apart = [one.samples + one.disturbed for one in (evidence.modes or {}).values()]
    fewest = min([cycles, *apart])
    independent = margin.independent_cycles
    if independent is not None and independent < needed:
        more = math.ceil(needed * evidence_cycles(plan) / independent)
        said = f"long cycles come in clusters: {evidence_cycles(plan)} cycles tell as much as"
        said += f" {independent} independent ones, too few to say how late one output in a hundred"
        yield f"{said} will be. Record {more} cycles or more."
    elif fewest < needed:
        of = " of a mode" if fewest < cycles else ""
        said = f"the sample is small: {fewest} cycles{of} are too few to say how late one output in"
        yield f"{said} a hundred will be. Record {needed} cycles{of} or more."
    stall = evidence.longest_stall_ns
    what = "" if stall is None else f", longest stall {milliseconds(stall)} ms"
    if evidence.all_disturbed:
        said = f"the machine disturbed every cycle, but one at most{what}"
        yield f"{said}: its stalls are in the plan. Record again on a calmer machine."
    elif evidence.disturbed:
        yield f"the machine disturbed {evidence.disturbed} of {cycles} cycles{what}."
    if margin.stalls_ns:
        end = _leaves_at(plan)
        said = f"covering the disturbed cycles costs {milliseconds(margin.stalls_ns)} ms: outputs"
        said += f" leave at {milliseconds(end)} ms; on a machine that does not stall it would be"
        yield f"{said} {milliseconds(end - margin.stalls_ns)} ms (--ideal-machine)."
    late = margin.overrun_probability or 0.0
    if cycles >= needed and late > OVERRUN_PROBABILITY and margin.source != "derived":
        said = f"by the latencies of all cycles, up to {late:.1%} of the outputs will miss their"
        yield f"{said} slot ({plan.overrun}): a larger margin (--epsilon) or calmer machine helps."


def _about_receivers(plan: ChainPlan) -> Iterator[str]:
    """Who receives an output without a place in the plan, or a promise."""
    node = plan.shaping_node
    if node is not None and node.receivers and node.receivers_at is None:
        said = f"{', '.join(node.receivers)}, which get {node.output}, run below all servers, and"
        said += " when their callbacks start is not promised: the plan has no room for them, or the"
        yield f"{said} recording does not say how long they take. A core without servers helps."
    placed = () if node is None or node.receivers_at is None else node.receivers
    for sink in plan.further_shaping_nodes:
        if not sink.receivers:
            continue
        said = (
            f"{', '.join(sink.receivers)}, which get {sink.output}, have no place in the plan, as"
        )
        said += " those that receive a further sink have none: when their callbacks start is not"
        if waiting := [name for name in sink.receivers if name not in placed]:
            said += f" promised, and {', '.join(waiting)} run below all servers"
        else:
            said += f" promised, although they run where those that get {plan.chain.output} do"
        yield f"{said}. Planned as a chain of its own (--chain instead of --sink) it has a place."
    if node is None and plan.chain.output is not None and any(plans.publisher_servers(plan)):
        said = f"who receives {plan.chain.output} has no place in the plan, since the publisher's"
        said += " own thread is gated: callbacks of receivers start when their core is free, which"
        yield f"{said} is not promised. With --publication synchronous they have a place."


def modes_with_one_slot(plan: ChainPlan) -> Iterator[tuple[tuple[str, ...], Slot]]:
    """Modes that the announcement of another does not change anything for, and their slot."""
    slots = plans.publish_slots(plan)
    bands = {} if plan.modes is None else plan.modes.bands
    for number, slot in enumerate(slots, start=1):
        modes = tuple(mode for mode, band in bands.items() if band == number)
        if len(modes) > 1:
            yield modes, slot


def _about_evidence(plan: ChainPlan) -> Iterator[str]:
    """What is doubtful about the measurements, or about how much of the cycle is used."""
    for modes, slot in modes_with_one_slot(plan):
        opens, closes = map(milliseconds, slot)
        yield (
            f"the modes {', '.join(modes)} have the same slot, [{opens}, {closes}) ms: their"
            " longest latencies are too near for two, so outputs leave at the same time in each"
        )
    if plan.modes is not None and plan.evidence.modes is None:
        said = "nothing says which mode was in force, so the modes share bands of them all"
        yield f"{said}: one that takes longer is late. Give each one's profile (--mode-profile)."
    evidence, cycle, margin = plan.evidence, plan.cycle_ns, plan.margin
    longest, used = evidence.max_latency_ns, evidence.utilisation or 0.0
    last = max((end for _, end in plans.publish_slots(plan)), default=longest)
    if evidence.realtime is False:
        said = "the latencies were taken without real-time scheduling: other programs are in them."
        yield f"{said} Record again with the privilege to use SCHED_FIFO."
    if evidence.lost_events:
        said = f"{evidence.lost_events} events were lost while recording, maybe the longest"
        yield f"{said} latency's: record again, see the recording's notes."
    if evidence.interference_ns:
        delay = milliseconds(evidence.interference_ns)
        yield f"{delay} ms of the slot are for other chains, which may have the core first."
    if evidence.incomplete:
        said = f"{evidence.incomplete} executions of the chain have no end in the recording; their"
        yield f"{said} latencies, which may be the longest, are not in the plan."
    if margin.confidence_interval_ns:
        low, high = map(duration_text, margin.confidence_interval_ns)
        said = f"the margin {high} is the upper end of an estimate from the tail of the latencies"
        yield f"{said}, which lies between {low} and that."
    if NEARLY_FULL * cycle < last <= cycle:
        said = f"the plan fills {last / cycle:.1%} of the cycle {duration_text(cycle)}"
        yield f"{said}: an execution a little longer than any measured delays the next one."
    if longest >= cycle and plan.policy != "pipelined":
        said = f"the longest latency {duration_text(longest)} is not shorter than the cycle"
        yield f"{said} {duration_text(cycle)}: executions delayed each other while measured."
    if NEARLY_FULL * cycle < longest < cycle:
        said = f"the longest execution takes more than {NEARLY_FULL:.0%} of a cycle, where the"
        yield f"{said} kernel throttles real-time threads (/proc/sys/kernel/sched_rt_runtime_us)."
    if used > NEARLY_FULL:
        yield f"the chain takes {used:.1%} of its core: latencies will pile up, whatever the slots."


def slots_of_latency(plan: ChainPlan) -> tuple[Slot, ...]:
    """The publish slots as latencies: under LET, and in a pipeline, they are of a later cycle."""
    delay = cycles_until_output(plan) * plan.cycle_ns
    return tuple((start + delay, end + delay) for start, end in plans.publish_slots(plan))
