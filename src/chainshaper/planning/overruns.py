"""What a plan asks of the application and the machine: overruns, publishers, warnings.

An **overrun** is an output that comes behind the last slot it was due in (section 6). A shaping
node sees overruns and treats them as the plan says (:mod:`chainshaper.robot.gate`). The thread of
an asynchronous publisher does not see them, but DDS can discard them by their age: with a
**lifespan** on the topic, an output that waited for the slot of a later cycle has expired when the
thread may run again.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import NamedTuple

from chainshaper.planning import chain_plan as plans
from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Server,
    ShapingNode,
    Slot,
    Thread,
)
from chainshaper.planning.late_shares import cycles_needed
from chainshaper.planning.margins import OVERRUN_PROBABILITY, allowed_late_share
from chainshaper.values.durations import duration_text, milliseconds
from chainshaper.values.errors import InputError

IDLE_BAND = 0.02  # a band with a smaller share of the cycles hardly lowers the average
NEARLY_FULL = 0.95  # of the cycle; also the kernel's default share for real-time threads
# How far apart outputs of one slot are: of a gate (p0.5–p99.5 measured: 0.02–0.1 ms, see
# experiments/RESULTS.md), and of a publisher's thread that is stopped until its slot (0.02–0.49 ms)
GATE_NS, STOPPED_THREAD_NS = 100_000, 500_000
ROOMY_SLOT_NS = 10_000_000  # suffices for many sends where the machine stalls for 1 to 8 ms


def cycles_until_output(plan: ChainPlan, node: ShapingNode | None = None) -> int:
    """Return how many cycles after its own the chain's output is due, or that of a ``node``.

    Under LET per callback each topic is due a cycle after the topic before it.
    """
    if plan.policy == "let-per-chain":
        return 1
    if plan.policy == "let-per-callback":
        if node in plan.further_shaping_nodes:
            return plan.further_shaping_nodes.index(node) + 1
        return len(plans.publishing_servers(plan))
    return (plan.predicted.max_ns - 1) // plan.cycle_ns if plan.policy in PER_CALLBACK else 0


class Expected(NamedTuple):
    """The latencies with which outputs will be seen, which leave when slots start.

    The prediction of a plan counts the ends of slots (eq. 5) instead: the bound for outputs that
    come while a slot is open.
    """

    leave_ns: tuple[int, ...]  # the start of each slot
    mean_ns: int
    max_ns: int
    jitter_ns: int


def expected(plan: ChainPlan) -> Expected | None:
    """Return the latencies with which a plan's outputs will be seen; None: no slots decide them."""
    leave, shares = tuple(start for start, _ in slots_of_latency(plan)), plan.predicted.shares
    if plan.policy == "one-long-slot" or not 0 < len(leave) == len(shares):
        return None
    apart = STOPPED_THREAD_NS if any(plans.publisher_servers(plan)) else GATE_NS
    mean = round(sum(share * start for share, start in zip(shares, leave, strict=True)))
    return Expected(leave, mean, leave[-1] + apart, leave[-1] - leave[0] + apart)


def output_lifespan(plan: ChainPlan) -> int | None:
    """Return the lifespan (ns) by which DDS discards overruns; None: none is needed.

    An output in time waits at most until the end of the first slot, or of the next slot when it
    just missed one. An overrun with latency l waits for the first slot of the next cycle, CT + (x_1
    − Δ) − l. Under LET, where every output waits for the next cycle, age tells nothing.
    """
    publisher = plan.chain.publisher
    if plan.overrun != "discard" or publisher is None or cycles_until_output(plan):
        return None
    if plans.server_of(plan, Thread(node=publisher, role="publisher")) is None:
        return None
    slots = plans.publish_slots(plan)
    return max([slots[0][1], *(after[1] - before[1] for before, after in pairwise(slots))])


def open_until_done(
    plan: ChainPlan, closed_ns: int = 0, shared_cores: Collection[int] = ()
) -> ChainPlan:
    """Return the plan as back ends and the simulator carry it out: overruns may finish.

    The servers that run the chain to its end stay open until the cycle's end (section 6): stopped
    at L̄ + ε, the chain would go on in the next cycle, and delay the output of that as well. Where
    an output that missed its slot is to leave at once, the last publish slot of an asynchronous
    publisher stays open, too. The slots of other servers of the same core and priority are left
    out, and so are the last ``closed_ns`` of a cycle: a thread whose timer expires in these waits
    for its slot.

    A stage of a pipeline stays open until the next slot of its core begins. If that is of a later
    stage of the same instance, it stays open until that closes, and has a worse priority: a stage
    that overran goes on while the later one, which may wait for it, has nothing to do. Stopped, it
    would go on in the next cycle, and each output would be a cycle late until short executions made
    up for it. On ``shared_cores``, which other chains have as well, this is left out.

    Servers of callbacks stay open too, except those in which chains begin: a callback that was
    stopped would take its next slot, and every output would be late until two short executions met.
    A server of a whole chain that shapes nothing closes: it is there for the threads that run
    beside it. So do all servers of a plan whose ``slot_ends`` are closed.
    """
    if plan.slot_ends == "closed":
        return plan
    end_ns = plan.cycle_ns - closed_ns
    if plan.policy == "pipelined" and plan.overrun == "publish":
        opened = plans.with_slots(plan.servers, _until_next_stage(plan, end_ns))
        with_longer = plan.model_copy(update={"servers": opened})
        through = _through_next_stage(with_longer, end_ns, shared_cores)
        servers = tuple(through.get(server.name, server) for server in opened)
        return plans.revised(plan, servers=servers)
    if plan.policy == "server-per-callback":
        slots = {}
        for server in plan.servers:
            chain_begins = server.slots[0][0] == 0 and len(plan.servers) > 1
            if not chain_begins and not server.best_effort:
                slots[server.name] = plans.until(server, end_ns)
        # Not checked: behind what is planned, slots of servers meet.
        return plan.model_copy(update={"servers": plans.with_slots(plan.servers, slots)})
    if plan.policy not in ("shaped", "one-long-slot") or plans.output_server(plan) is None:
        return plan
    opened = plans.with_slots(plan.servers, _until_cycle_end(plan, end_ns))
    try:
        return plans.revised(plan, servers=plans.below_executors(opened))
    except InputError:  # below its executor, a publisher would meet another server's slot
        return plan


def _until_next_stage(plan: ChainPlan, end_ns: int) -> dict[str, Sequence[Slot]]:
    """Return slots of stages that stay open until the next slot of their core, or ``end_ns``."""
    longer: dict[str, Sequence[Slot]] = {}
    for stage in plans.running_servers(plan):
        same_core = (server.slots for server in plan.servers if server.core == stage.core)
        starts = sorted(start for slots in same_core for start, _ in slots)
        longer[stage.name] = [
            (start, next((later for later in starts if later >= end), max(end, end_ns)))
            for start, end in stage.slots
        ]
    return longer


def _through_next_stage(
    plan: ChainPlan, end_ns: int, shared_cores: Collection[int]
) -> dict[str, Server]:
    """Return, by name, the stages of cores that have several, with priorities of their own.

    A stage behind which a later one of the same instance has the core stays open until that closes,
    the first of all until ``end_ns`` at the latest.
    """
    cycle_ns, stages = plan.cycle_ns, [*plans.running_servers(plan)]
    through: dict[str, Server] = {}
    for core in {stage.core for stage in stages}.difference(shared_cores):
        of_core = [stage for stage in stages if stage.core == core]  # in the chain's order
        best = min(stage.priority for stage in of_core)
        if any(stage.priority != best for stage in of_core):
            continue  # the core is named twice, and has two stages at a time
        for place, stage in enumerate(of_core):
            opens, closes = _whole_slot(stage, cycle_ns)
            behind = []  # how long after this stage each other one opens and closes
            for number, beside in enumerate(of_core):
                if beside is not stage:
                    begins, ends = _whole_slot(beside, cycle_ns)
                    wait = (begins - closes) % cycle_ns
                    behind.append((wait, wait + ends - begins, number))
            slots = stage.slots
            if behind and min(behind)[2] > place:
                until = closes + min(behind)[1]
                if stage is stages[0]:
                    until = min(until, max(closes, end_ns))
                slots = united(in_cycle(opens, until, cycle_ns))
            change = {"slots": slots, "priority": best + len(of_core) - 1 - place}
            through[stage.name] = stage.model_copy(update=change)
    return through


def _whole_slot(stage: Server, cycle_ns: int) -> Slot:
    """Return a stage's slot, which may go beyond the end of the cycle, as one."""
    (first_opens, first_closes), (last_opens, last_closes) = stage.slots[0], stage.slots[-1]
    if len(stage.slots) > 1 and first_opens == 0 and last_closes == cycle_ns:
        return last_opens, cycle_ns + first_closes
    return first_opens, last_closes


def _until_cycle_end(plan: ChainPlan, end_ns: int) -> dict[str, Sequence[Slot]]:
    """Return slots of the servers that overruns need, open until ``end_ns``, by their names.

    These run a chain to its end; and an asynchronous publisher, if overruns leave at once.
    """
    done, _ = plans.publish_slots(plan)[-1]
    needed = [
        server
        for server in plans.running_servers(plan)
        if server.slots[-1][0] < done <= server.slots[-1][1]
    ]
    if plan.overrun == "publish":
        needed += [server for _, server, _ in plans.publisher_servers(plan)]
    in_turn = [server for server in plan.servers if server in needed]
    longer: dict[str, Sequence[Slot]] = {}
    for opened in sorted(in_turn, key=lambda server: server.slots[-1][1], reverse=True):
        taken = [
            slot
            for server in plan.servers
            if server is not opened and plan.equal_priorities == "apart"
            if (server.core, server.priority) == (opened.core, opened.priority)
            for slot in longer.get(server.name, server.slots)
        ]
        longer[opened.name] = slots_without(plans.until(opened, end_ns), taken)
    return longer


def with_output_moved(plan: ChainPlan, by_ns: int) -> ChainPlan:
    """Return the plan with the slots of its output moved by so much.

    Slots that run the chain until then begin or end where the moved slots do. Raises InputError:
    the slots may not be there.
    """
    edges = {edge for slot in plans.publish_slots(plan) for edge in slot}

    def moved(instant: int) -> int:
        return instant + by_ns if instant in edges else instant

    slots = {
        server.name: [(moved(start), moved(end)) for start, end in server.slots]
        for server in plan.servers
        if not server.best_effort
    }
    return plans.revised(plan, servers=plans.with_slots(plan.servers, slots))


def why_not_followed(plan: ChainPlan) -> str | None:
    """Say why the slots of a plan cannot follow the latencies; None: they can."""
    if plan.policy != "shaped":
        return f"under {plan.policy} slots are where the policy has them"
    if plan.modes is not None:
        return "each mode has latencies and a slot of its own, and one promise is for all"
    if plan.loop is not None and plan.loop.in_step is not None:
        return f"they are in step with the loop of {plan.loop.node}"
    if plan.shaping_node is None:
        return "no shaping node sees when outputs come (plan with --publication synchronous)"
    if plan.further_shaping_nodes:
        return "its other outputs are published in slots of the same servers"
    return None


def united(slots: Sequence[Slot]) -> tuple[Slot, ...]:
    """Return slots ascending; those that overlap or touch are joined."""
    joined: list[Slot] = []
    for start, end in sorted(slots):
        if joined and start <= joined[-1][1]:
            first, before = joined[-1]
            joined[-1] = first, max(end, before)
        else:
            joined.append((start, end))
    return tuple(joined)


def in_cycle(opens_ns: int, closes_ns: int, cycle_ns: int) -> tuple[Slot, ...]:
    """Return a slot that repeats every cycle as it lies inside one cycle: as one slot, or two."""
    start = opens_ns % cycle_ns
    end = start + closes_ns - opens_ns
    return ((start, end),) if end <= cycle_ns else ((0, end - cycle_ns), (start, cycle_ns))


def slots_without(slots: Sequence[Slot], taken: Sequence[Slot]) -> tuple[Slot, ...]:
    """Return slots without the parts of them that are taken."""
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
    """A DDS writer of an application. None: not known."""

    node: str
    topic: str
    depth: int | None = None  # of its history
    # Whether a thread of its process sends for it, and for all such writers of the process.
    asynchronous: bool | None = None
    process: int | None = None


def check_publication(plan: ChainPlan, writers: Sequence[Writer]) -> list[str]:
    """Return what a person must know of a plan that gates the publishers' threads of these writers.

    Raises InputError: another node publishes the output, or it is published synchronously, or its
    history is too shallow for the messages that come while the thread may not run.
    """
    warnings: list[str] = []
    output = plan.chain.output
    for _, server, nodes in plans.publisher_servers(plan):
        for node in nodes:
            of_node = {writer.topic: writer for writer in writers if writer.node == node}
            if node == plan.chain.publisher and output is not None:
                waiting = plans.messages_waiting(plan, server)
                _check_output(output, node, of_node.get(output), waiting)
            processes = {writer.process for writer in of_node.values()} - {None}
            delayed = [
                writer
                for writer in writers
                if writer.node == node or writer.process in processes
                if writer.asynchronous is not False
                if (writer.node, writer.topic) != (node, output)
            ]
            if delayed:
                doubt = {True: "", None: " (if asynchronous)"}
                topics = sorted(
                    {f"{writer.topic}{doubt[writer.asynchronous]}" for writer in delayed}
                )
                names = sorted({writer.node for writer in delayed})
                warning = f"{', '.join(topics)} of {', '.join(names)} will be delayed as well,"
                warning += f" until the slots of server {server.name!r}: publish synchronously, or"
                warning += " from another process, which has its own thread."
                warnings.append(warning)
    return warnings


def _check_output(topic: str, node: str, writer: Writer | None, waiting: int) -> None:
    """Refuse to gate the thread of a publisher whose writer does not allow it."""
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
    """Say what a plan for asynchronous publication asks of the application; a sentence each."""
    warnings = []
    for _, server, nodes in plans.publisher_servers(open_until_done(plan)):
        names = ", ".join(nodes)
        warning = f"all asynchronous publication is shaped: what else {names} publishes so, such as"
        warnings.append(f"{warning} /rosout, waits for the slots of {server.name!r} too.")
        shortest = min(end - start for start, end in server.slots)
        if shortest < ROOMY_SLOT_NS:
            warning = f"a slot of {duration_text(shortest)} that opens late may end while {names}"
            warning += " sends, which blocks the whole process until the next one; one of"
            warning += f" {duration_text(ROOMY_SLOT_NS)} (--publish-slot) costs nothing."
            warnings.append(warning)
        depth, runs_output = plan.chain.output_depth, plan.chain.publisher in nodes
        if runs_output and plan.overrun == "wait" and depth == plans.messages_waiting(plan, server):
            warning = f"a history of {depth} has no room for an output that overran"
            warnings.append(f"{warning}: give it one more.")
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
    """Say what a person must know before relying on plans; a sentence each, none if all is well."""
    warnings = []
    for plan in chains:
        of_plan = (
            *_about_stages(plan),
            *_about_late_outputs(plan),
            *_about_evidence(plan),
            *_about_receivers(plan),
            *_about_loop(plan),
            *publication_warnings(plan),
        )
        name = f"{plan.chain.spec or plan.chain.output}: " if len(chains) > 1 else ""
        warnings += [f"{name}{warning}" for warning in of_plan]
    return warnings


def _about_stages(plan: ChainPlan) -> Iterator[str]:
    """Say where a pipeline is cut, what it costs, and what has to be right for it."""
    if plan.policy != "pipelined":
        return
    longest, cycle = plan.evidence.max_latency_ns, plan.cycle_ns
    stages = plans.running_servers(plan)
    where = (
        f"{', '.join(thread.node for thread in stage.threads)} on core {stage.core}"
        for stage in stages
    )
    cost = _leaves_at(plan) - longest - plan.margin.epsilon_ns
    waits = f"; {milliseconds(cost)} ms of it for stages that wait for their turn" if cost else ""
    warning = f"the chain takes up to {milliseconds(longest)} ms, {longest / cycle:.2f} times its"
    warning += f" cycle, and has {len(stages)} stages: {'; '.join(where)}. Outputs leave at"
    yield f"{warning} {milliseconds(_leaves_at(plan))} ms, once a cycle{waits}."
    for first, second in combinations(stages, 2):
        if first.core != second.core:
            continue
        if any(plans.meet(*slots) for slots in product(first.slots, second.slots)):
            warning = f"{first.name} and {second.name} have core {first.core} at the same time"
            yield f"{warning}: right only where their callbacks wait rather than compute."


def _leaves_at(plan: ChainPlan) -> int:
    """Return when outputs that come in time leave, from the start of their chain on (ns)."""
    slots = slots_of_latency(plan)
    return slots[-1][0] if slots else plan.evidence.max_latency_ns + plan.margin.epsilon_ns


def evidence_cycles(plan: ChainPlan) -> int:
    """Return how many cycles a plan rests on, disturbed ones included."""
    evidence = plan.evidence
    if evidence.all_disturbed:
        return max(evidence.samples, evidence.disturbed)
    return evidence.samples + evidence.disturbed


def _about_late_outputs(plan: ChainPlan) -> Iterator[str]:
    """Say which bands are hardly used, how many outputs will be late, and what stalls cost."""
    evidence, margin, shares = plan.evidence, plan.margin, plan.predicted.shares
    idle = [str(number) for number, share in enumerate(shares, start=1) if share < IDLE_BAND]
    if idle and len(shares) > 1 and plan.modes is None:
        warning = f"bands with less than {IDLE_BAND:.0%} of the cycles: {', '.join(idle)} of"
        yield f"{warning} {len(shares)}: limit --mean-at-most or --max-share, or plan fewer."
    cycles, needed = evidence_cycles(plan), cycles_needed(OVERRUN_PROBABILITY)
    of_modes = (evidence.modes or {}).values()
    fewest = min([cycles, *(mode.samples + mode.disturbed for mode in of_modes)])
    independent = margin.independent_cycles
    if independent is not None and independent < needed:
        more = math.ceil(needed * evidence_cycles(plan) / independent)
        text = f"long cycles come in clusters: {evidence_cycles(plan)} cycles tell as much as"
        text += f" {independent} independent ones, too few to say how late one output in a hundred"
        yield f"{text} will be. Record {more} cycles or more."
    elif fewest < needed:
        kind = "cycles of a mode" if fewest < cycles else "cycles"
        text = f"the sample is small: {fewest} {kind} are too few to say how late one output in"
        yield f"{text} a hundred will be. Record {needed} {kind} or more."
    stall = evidence.longest_stall_ns
    stall_text = "" if stall is None else f", longest stall {milliseconds(stall)} ms"
    if evidence.all_disturbed:
        text = f"the machine disturbed every cycle, but one at most{stall_text}"
        yield f"{text}: its stalls are in the plan. Record again on a calmer machine."
    elif evidence.disturbed:
        yield f"the machine disturbed {evidence.disturbed} of {cycles} cycles{stall_text}."
    if margin.stalls_ns:
        end = _leaves_at(plan)
        text = f"covering the disturbed cycles costs {milliseconds(margin.stalls_ns)} ms: outputs"
        text += f" leave at {milliseconds(end)} ms; on a machine that does not stall it would be"
        yield f"{text} {milliseconds(end - margin.stalls_ns)} ms (--ideal-machine)."
    late = allowed_late_share(margin)
    if cycles >= needed and late > OVERRUN_PROBABILITY and margin.source != "derived":
        text = f"by the latencies of all cycles, up to {late:.1%} of the outputs will miss their"
        yield f"{text} slot ({plan.overrun}): a larger margin (--epsilon) or calmer machine helps."


def _about_receivers(plan: ChainPlan) -> Iterator[str]:
    """Say which nodes receive an output without a place in the plan, or a promise."""
    node = plan.shaping_node
    if node is not None and node.receivers and node.receivers_at is None:
        text = f"{', '.join(node.receivers)}, which get {node.output}, run below all servers, and"
        text += " when their callbacks start is not promised: the plan has no room for them, or the"
        yield f"{text} recording does not say how long they take. A core without servers helps."
    placed = () if node is None or node.receivers_at is None else node.receivers
    for sink in plan.further_shaping_nodes:
        if not sink.receivers:
            continue
        text = (
            f"{', '.join(sink.receivers)}, which get {sink.output}, have no place in the plan, as"
        )
        text += " those that receive a further sink have none: when their callbacks start is not"
        if waiting := [name for name in sink.receivers if name not in placed]:
            text += f" promised, and {', '.join(waiting)} run below all servers"
        else:
            text += f" promised, although they run where those that get {plan.chain.output} do"
        yield f"{text}. Planned as a chain of its own (--chain instead of --sink) it has a place."
    if node is None and plan.chain.output is not None and any(plans.publisher_servers(plan)):
        text = f"who receives {plan.chain.output} has no place in the plan, since the publisher's"
        text += " own thread is gated: callbacks of receivers start when their core is free, which"
        yield f"{text} is not promised. With --publication synchronous they have a place."


def _about_loop(plan: ChainPlan) -> Iterator[str]:
    """Say what the loop that reads the output makes of its age, what that costs, and what helps."""
    loop = plan.loop
    if loop is None:
        return
    named = f"the loop of {loop.node}"
    if loop.period_ns is None:
        low, usual, high = map(duration_text, loop.intervals_ns or (0, 0, 0))
        text = f"{named} sleeps irregularly: {usual} lie between its starts, from {low} (p5) to"
        yield f"{text} {high} (p95). Nothing is planned in step with it."
        return
    if loop.inferred:
        text = f"the recording has no events of the sleeps of {named}: its ages are those at its"
        yield f"{text} publications, and it reads its data sooner. Record with --source preload."
    cycle, period = plan.cycle_ns, loop.period_ns
    common = plans.loop_common_ns(plan)
    can_be_constant = common == min(cycle, period)
    if loop.moved_ns:
        text = f"{named} starts while messages are stored that leave at"
        text += f" {milliseconds(_leaves_at(plan) - loop.moved_ns)} ms, and chance would decide"
        text += f" which it uses: their slot is {milliseconds(loop.moved_ns)} ms later, at"
        yield f"{text} {milliseconds(_leaves_at(plan))} ms."
    if loop.drift_ppm:
        text = f"the clocks of the chain and of {named} drift apart by"
        text += f" {milliseconds(abs(loop.drift_ppm) * 3_600_000, 1)} ms in an hour, and its phase"
        helps = "" if loop.in_step == "output" else ": --in-step follows it"
        yield f"{text} changes by that{helps if can_be_constant else ''}."
    if not can_be_constant:
        text = f"neither of the period {duration_text(period)} of {named} and the cycle"
        text += f" {duration_text(cycle)} is a multiple of the other: wherever the slot is, ages at"
        text += f" the first use are {duration_text(common)} apart, over"
        yield f"{text} {duration_text(min(cycle, period) - common)}."
    elif loop.in_step is None and plan.policy not in plans.UNSHAPED:
        ages = tuple(map(milliseconds, (loop.age_at_any_phase or loop.age).first_ns))
        text = f"the phase of {named} is another one at each start of it: the age at the first use"
        text += f" lies between {ages[0]} and {ages[1]} ms then. --in-step puts the slot before its"
        yield f"{text} instances at each start, --move-loop moves the loop."
    elif loop.in_step == "loop":
        text = f"{named} has to start {milliseconds(loop.move_ns or 0)} ms later than it was"
        yield f"{text} recorded; how much it is, is measured at each start."
    is_placed = plan.policy == "shaped" and len(plans.publish_slots(plan)) > 1
    if can_be_constant and not (is_placed or loop.age.constant or loop.drift_ppm):
        text = f"{named} may start while a message is stored, and chance decides whether it uses it"
        yield f"{text}: ages at the first use differ by up to a period of the loop."
    if plan.shaping_node is not None and not (loop.runs_at or loop.realtime_priority):
        text = f"the thread of {named} has no real-time priority, and the plan no place for it"
        yield f"{text} beside receivers: it may wait for the chain, and start late."


def modes_with_one_slot(plan: ChainPlan) -> Iterator[tuple[tuple[str, ...], Slot]]:
    """Modes that the announcement of another does not change anything for, and their slot."""
    slots = plans.publish_slots(plan)
    bands = {} if plan.modes is None else plan.modes.bands
    for number, slot in enumerate(slots, start=1):
        modes = tuple(mode for mode, band in bands.items() if band == number)
        if len(modes) > 1:
            yield modes, slot


def _about_evidence(plan: ChainPlan) -> Iterator[str]:
    """Say what is doubtful about the measurements, or about how much of the cycle is used."""
    for modes, slot in modes_with_one_slot(plan):
        opens, closes = map(milliseconds, slot)
        yield (
            f"the modes {', '.join(modes)} have the same slot, [{opens}, {closes}) ms: their"
            " longest latencies are too near for two, so outputs leave at the same time in each"
        )
    if plan.modes is not None and plan.evidence.modes is None:
        text = "nothing says which mode was in force, so the modes share bands of them all"
        yield f"{text}: one that takes longer is late. Give each one's profile (--mode-profile)."
    evidence, cycle, margin = plan.evidence, plan.cycle_ns, plan.margin
    if evidence.hosts:
        text = (
            f"the chain goes over {', '.join(evidence.hosts)}: its latencies count with the upper"
        )
        yield f"{text} ends of their intervals. Nothing puts such a plan in force yet."
    longest, used = evidence.max_latency_ns, evidence.utilisation or 0.0
    last = max((end for _, end in plans.publish_slots(plan)), default=longest)
    if evidence.realtime is False:
        text = "the latencies were taken without real-time scheduling: other programs are in them."
        yield f"{text} Record again with the privilege to use SCHED_FIFO."
    if evidence.lost_events:
        text = f"{evidence.lost_events} events were lost while recording, maybe the longest"
        yield f"{text} latency's: record again, see the recording's notes."
    if evidence.interference_ns:
        delay = milliseconds(evidence.interference_ns)
        yield f"{delay} ms of the slot are for other chains, which may have the core first."
    if evidence.incomplete:
        text = f"{evidence.incomplete} executions of the chain have no end in the recording; their"
        yield f"{text} latencies, which may be the longest, are not in the plan."
    if margin.confidence_interval_ns:
        low, high = map(duration_text, margin.confidence_interval_ns)
        text = f"the margin {high} is the upper end of an estimate from the tail of the latencies"
        yield f"{text}, which lies between {low} and that."
    if NEARLY_FULL * cycle < last <= cycle:
        text = f"the plan fills {last / cycle:.1%} of the cycle {duration_text(cycle)}"
        yield f"{text}: an execution a little longer than any measured delays the next one."
    if longest >= cycle and plan.policy != "pipelined":
        text = f"the longest latency {duration_text(longest)} is not shorter than the cycle"
        yield f"{text} {duration_text(cycle)}: executions delayed each other while measured."
    if NEARLY_FULL * cycle < longest < cycle:
        text = f"the longest execution takes more than {NEARLY_FULL:.0%} of a cycle, where the"
        yield f"{text} kernel throttles real-time threads (/proc/sys/kernel/sched_rt_runtime_us)."
    if used > NEARLY_FULL:
        yield f"the chain takes {used:.1%} of its core: latencies will pile up, whatever the slots."


def slots_of_latency(plan: ChainPlan) -> tuple[Slot, ...]:
    """Return the publish slots as latencies: under LET, and in a pipeline, of a later cycle."""
    delay = cycles_until_output(plan) * plan.cycle_ns
    return tuple((start + delay, end + delay) for start, end in plans.publish_slots(plan))
