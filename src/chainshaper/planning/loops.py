"""A loop that reads the output of a plan: the age of its data, and slots in step with it.

A loop samples the shaped output at its own phase, which is another one at each start of the loop.
A plan states how old its data are then, exactly (:mod:`.loop_ages`), for the phase of the recording
and for any phase.

* Where an instance of the loop may begin while a message is stored, chance decides which message
  it uses, and ages differ by a period of the loop. So slots of shaping are moved to the nearest
  later place where none begins. Where there is none, such a plan is refused.
* **In step**, the slot is put so long before the loop's instance, the *lead*, that the message is
  stored in time: its age is constant. It ends with the cycle: before an instance that begins in the
  next one, while the chain computes already, the message waits where it is stored. Or the loop's
  sleep is moved, once, so that its instance begins the lead behind the slot's start.

The lead is the time from the start of the slot until a message is stored, all but 0.5 % of those in
the recording, and a margin: a quarter of it, at least what outputs of a gate are apart.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from chainshaper.planning import chain_plan as plans
from chainshaper.planning.chain_plan import (
    UNSHAPED,
    ChainPlan,
    LoopAge,
    PlannedLoop,
    Slot,
    in_one_slot,
    publish_slots,
    revised,
)
from chainshaper.planning.loop_ages import (
    Ages,
    LoopTimes,
    ages,
    at_any_phase,
    later_without_straddling,
    move_into_step,
    start_in_step,
    straddles,
)
from chainshaper.planning.overruns import (
    GATE_NS,
    STOPPED_THREAD_NS,
    slots_of_latency,
    with_output_moved,
)
from chainshaper.planning.profile import Profile, RecordedLoop
from chainshaper.planning.receivers import node_work_ns
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import InStep, Wishes

_MARGIN = 4  # so many margins are as long as the delivery


def with_loop(plan: ChainPlan, profile: Profile, wishes: Wishes) -> ChainPlan:
    """Return the plan of a chain with the loop that reads its output, if it has one.

    Its slots are where the loop's instances do not begin while a message is stored, or in step with
    the loop, as the wishes are.

    Raises InputError: nothing can be in step with the loop, or no loop reads the output.
    OperationError: there is no such place for the slots.
    """
    in_step, loop = step_of(wishes), profile.loop
    if loop is None:
        if in_step is None:
            return plan
        raise InputError(
            f"{_option(in_step)}: {profile.name or 'the chain'} goes through no loop that reads its"
            " output. Name a chain that ends in the loop, or goes through it: its topic, or"
            " NODE:end of a loop that was named when it was recorded (`record --loop NODE`). A"
            " loop that is paced by data is none of these (`chainshaper callbacks` says so)"
        )
    planned = _planned(plan, loop, wishes)
    if in_step is not None:
        _refuse_step(plan, loop, planned, in_step)
        _refuse_timing(plan, loop, planned, in_step)
        return stated(_in_step(plan, planned, in_step, loop.before_ns))
    plan = plan.model_copy(update={"loop": planned})
    if plan.policy == "shaped" and planned.period_ns is not None and not planned.drift_ppm:
        plan = _without_straddling(plan)
    return stated(plan)


def step_of(wishes: Wishes) -> InStep | None:
    """Return what is put in step, by the wishes; None: nothing. Raises InputError: both are."""
    if wishes.in_step and wishes.move_loop:
        reason = "--in-step moves the output's slot, and --move-loop the loop instead"
        raise InputError(f"{reason}: give one of the two")
    return "output" if wishes.in_step else "loop" if wishes.move_loop else None


def one_before_another(
    profiles: Sequence[Profile], wishes: Wishes, slots_ns: Sequence[int]
) -> list[Profile]:
    """Return profiles of chains whose outputs leave one before another for a loop that they share.

    Of outputs in step that leave on one core, the first chain's leaves last. ``slots_ns`` are how
    long their slots are.

    Raises InputError: the loop is to be moved, which only one of its chains decides.
    """
    in_step = step_of(wishes)
    taken: dict[tuple[str, str | None, int | None], int] = {}
    first: dict[tuple[str, str | None], str] = {}
    placed = []
    for profile, slot_ns in zip(profiles, slots_ns, strict=True):
        loop = profile.loop
        if loop is None or in_step is None:
            placed.append(profile)
            continue
        named = first.setdefault((loop.node, loop.thread), profile.name)
        if in_step == "loop" and named != profile.name:
            raise InputError(
                f"--move-loop: {named} and {profile.name} both go into the loop of {loop.node},"
                " which moves for one of them: put their slots in step (--in-step)"
            )
        where = (loop.node, loop.thread, profile.core_of.get(profile.last or ""))
        before = taken.get(where, 0)
        taken[where] = before + slot_ns
        placed.append(replace(profile, loop=replace(loop, before_ns=before)))
    return placed


def stated(plan: ChainPlan) -> ChainPlan:
    """Return a plan whose loop states the ages that come of the plan's slots."""
    loop = plan.loop
    if loop is None:
        return plan
    known = [_times(plan, loop, stored) for stored in _stored(plan, loop)]
    whole = replace(known[0], stored_ns=(known[0].stored_ns[0], known[-1].stored_ns[1]))
    is_steady = loop.period_ns is not None and (not loop.drift_ppm or loop.in_step is not None)
    any_phase = _joined([ages(at_any_phase(whole))], whole, loop)
    age = any_phase
    if is_steady:
        age = _joined([ages(times) for times in known], whole, loop)
    if loop.in_step is not None:
        any_phase = _at_any_start(plan, loop, age)
    return plan.model_copy(
        update={"loop": loop.model_copy(update={"age": age, "age_at_any_phase": any_phase})}
    )


def _at_any_start(plan: ChainPlan, loop: PlannedLoop, age: LoopAge) -> LoopAge:
    """Return the ages in step, whatever phase the loop starts with: the slot, or it, is moved."""
    if loop.starts_ns is None:
        return age
    earliest_ns = loop.starts_ns[0] + loop.lead_ns
    later_ns = plans.loop_common_ns(plan) - 1
    ranges = {}
    for name in ("first_ns", "every_ns"):
        low, high = getattr(age, name)
        ranges[name] = (earliest_ns, earliest_ns + high - low + later_ns)
    return age.model_copy(update=ranges)


def with_thread_placed(
    plan: ChainPlan, profile: Profile, beside: Sequence[ChainPlan] = ()
) -> ChainPlan:
    """Return a plan that says where the thread of its loop runs while it is in force.

    It has the priority of the output's receivers: on the core where it was recorded, if no server
    is there, also of the chains ``beside``; else where the receivers are. One that is real-time by
    itself is left as it is; and so is one for which the plan has no room.
    """
    loop, node, recorded = plan.loop, plan.shaping_node, profile.loop
    if loop is None or recorded is None or loop.realtime_priority is not None:
        return plan
    if node is None or node.receivers_at is None:
        return plan
    busy = {
        server.core
        for chain in (plan, *beside)
        for server in chain.servers
        if not server.best_effort
    }
    core = node.receivers_at.core
    if recorded.core is not None and recorded.core not in busy:
        core = recorded.core
    place = node.receivers_at.model_copy(update={"core": core, "time_ns": recorded.time_ns})
    return plan.model_copy(update={"loop": loop.model_copy(update={"runs_at": place})})


def beside_receivers(profile: Profile) -> Profile:
    """Return the profile with the loop's time among that of the receivers of the output.

    A loop that has no real-time priority by itself gets theirs, and may delay them.
    """
    loop, reception = profile.loop, profile.reception
    if loop is None or reception is None or loop.realtime_priority is not None:
        return profile
    if loop.core is not None and loop.core not in (reception.core, *profile.core_of.values()):
        return profile
    reception = reception._replace(
        beside_ns=reception.beside_ns + loop.time_ns,
        beside_once_ns=reception.beside_once_ns + loop.once_ns,
    )
    return replace(profile, reception=reception)


def _planned(plan: ChainPlan, loop: RecordedLoop, wishes: Wishes) -> PlannedLoop:
    """Return what a plan says of a loop before the slots are placed for it."""
    delivery = loop.stored_ns
    if wishes.delivery_ns is not None and not loop.takes_itself:  # it is handed over then
        storing = loop.storing_ns
        delivery = (wishes.delivery_ns, wishes.delivery_ns + storing, wishes.delivery_ns + storing)
    exact_ns = GATE_NS if plan.shaping_node is not None else STOPPED_THREAD_NS
    lead_ns = delivery[1] + max(exact_ns, -(-delivery[1] // _MARGIN)) + loop.before_ns
    unknown = LoopAge(first_ns=(0, 0), every_ns=(0, 0), constant=False, uses=(0, 0))
    return PlannedLoop(
        chain=loop.chain,
        node=loop.node,
        thread=loop.thread,
        topic=loop.topic,
        period_ns=loop.period_ns,
        intervals_ns=loop.intervals_ns,
        phase_ns=loop.phase_ns,
        jitter_ns=loop.jitter_ns,
        drift_ppm=loop.drift_ppm,
        samples=loop.samples,
        inferred=True if loop.inferred else None,
        delivery_ns=delivery,
        lead_ns=lead_ns,
        realtime_priority=loop.realtime_priority,
        age=unknown,
    )


def _stored(plan: ChainPlan, loop: PlannedLoop) -> list[Slot]:
    """Return when messages are stored, behind the start of a cycle: for each slot from, and until.

    Outputs leave when their slot begins; where the chain may be done behind that, as in bands, at
    any time of the slot, and where nothing is shaped, when the chain is done.
    """
    shortest, longest = loop.stored_ns
    if plan.policy in UNSHAPED or not publish_slots(plan):
        done = (plan.evidence.min_latency_ns, plan.evidence.max_latency_ns)
        return [(done[0] + shortest, done[1] + longest)]
    slots = slots_of_latency(plan)
    stored = []
    for start, end in slots:
        is_exact = plan.into_open_slot == "next-slot" or start >= plan.evidence.max_latency_ns
        stored.append((start + shortest, (start if is_exact else end) + longest))
    return stored


def _times(plan: ChainPlan, loop: PlannedLoop, stored: Slot) -> LoopTimes:
    """Return the times of chain and loop, with the phase of the recording, or in step."""
    if loop.period_ns is None:  # whatever it is, the newest message is used
        _, _, longest = loop.intervals_ns or (0, 0, plan.cycle_ns)
        return LoopTimes(plan.cycle_ns, stored, longest, None)
    phase = loop.phase_ns
    if loop.in_step == "loop":
        phase += loop.move_ns or 0
    return LoopTimes(plan.cycle_ns, stored, loop.period_ns, phase, loop.jitter_ns)


def _joined(known: Sequence[Ages], whole: LoopTimes, loop: PlannedLoop) -> LoopAge:
    """Return the ages of messages that are stored at one of several times, one for each cycle."""
    uses = ages(whole).uses
    if loop.period_ns is None:
        shortest = max(1, (loop.intervals_ns or (0, 0, 0))[0])
        uses = uses[0], ages(replace(whole, period_ns=shortest)).uses[1]
    first = [ages_of.first_ns for ages_of in known]
    every = [ages_of.every_ns for ages_of in known]
    lowest, highest = min(low for low, _ in first), max(high for _, high in first)
    straddled = any(ages_of.straddled for ages_of in known)
    return LoopAge(
        first_ns=(lowest, highest),
        every_ns=(min(low for low, _ in every), max(high for _, high in every)),
        constant=not straddled and highest - lowest <= whole.jitter_ns,
        uses=uses,
    )


def _without_straddling(plan: ChainPlan) -> ChainPlan:
    """Return the plan with its slots moved to where no instance begins while they are stored."""
    loop = plan.loop
    if loop is None:
        return plan
    common = plans.loop_common_ns(plan)
    first = None  # the instance that is in the way
    moved, room = 0, plan.cycle_ns - publish_slots(plan)[-1][1]
    while moved < common and moved <= room:
        every = [
            _times(plan, loop, (start + moved, end + moved)) for start, end in _stored(plan, loop)
        ]
        straddled = [times for times in every if straddles(times)]
        if not straddled:
            break
        first = first or straddled[0]
        later = later_without_straddling(straddled[0])
        if later is None:
            moved = common
            break
        moved += later
    if first is None:
        return plan
    if moved >= common or moved > room:
        raise OperationError(_no_place(plan, loop, first, moved, room))
    later_plan = with_output_moved(plan, moved)
    return revised(
        later_plan,
        predicted=plans.predicted_later(plan.predicted, moved),
        loop=loop.model_copy(update={"moved_ns": moved}),
    )


def _no_place(
    plan: ChainPlan, loop: PlannedLoop, first: LoopTimes, moved_ns: int, room_ns: int
) -> str:
    """Say why there is no place for slots where the loop does not begin while they are stored."""
    start, end = first.stored_ns
    text = f"messages on {loop.topic} are stored for the loop of {loop.node} between"
    text += f" {duration_text(start)} and {duration_text(end)} of a cycle, which is when the loop"
    text += f" starts, every {duration_text(loop.period_ns or 0)} with a jitter of"
    text += f" {duration_text(loop.jitter_ns)}: chance would decide which of two messages, a cycle"
    text += " apart, it uses"
    if moved_ns >= plans.loop_common_ns(plan):
        text += ". No later slot helps, since it starts every"
        text += f" {duration_text(plans.loop_common_ns(plan))} of the cycle, and storing and jitter"
        text += " take as long"
    else:
        text += f". A slot {duration_text(moved_ns)} later would not be in its way, and the cycle"
        text += f" of {duration_text(plan.cycle_ns)} has {duration_text(room_ns)} behind it"
    remedies = ["shorten the chain"]
    if not first.cycle_ns % first.period_ns or not first.period_ns % first.cycle_ns:
        remedies.insert(0, "plan in step with the loop (--in-step, --move-loop)")
    remedies.append(f"plan it to the topic alone (--chain {plan.chain.spec or loop.topic})")
    return f"{text}. What helps: {', or '.join(remedies)}."


# In step --------------------------------------------------------------------------------------


def _option(in_step: InStep) -> str:
    return "--in-step" if in_step == "output" else "--move-loop"


def _refuse_step(
    plan: ChainPlan, recorded: RecordedLoop, loop: PlannedLoop, in_step: InStep
) -> None:
    """Refuse what cannot be in step, with the reason. Raises InputError."""
    option, named = _option(in_step), f"the loop of {loop.node}"
    if loop.period_ns is None:
        low, usual, high = map(duration_text, loop.intervals_ns or (0, 0, 0))
        raise InputError(
            f"{option}: {named} sleeps irregularly: {usual} lie between its starts, from {low} (p5)"
            f" to {high} (p95). Nothing is in step with it: leave this out"
        )
    if recorded.inferred:
        raise InputError(
            f"{option}: the recording has no events of the sleeps of {named}, so that when it"
            " starts to compute is not known: record with --source preload, or leave this out"
        )
    cycle, period = plan.cycle_ns, loop.period_ns
    if cycle % period and period % cycle:
        common = math.gcd(cycle, period)
        apart = min(cycle, period) - common
        raise InputError(
            f"{option}: neither of the loop's period {duration_text(period)} and the chain's cycle"
            f" {duration_text(cycle)} is a multiple of the other: at their first use the ages are"
            f" {duration_text(common)} apart, over {duration_text(apart)}, wherever the slot is."
            " Give the two such periods, or leave this out"
        )
    if plan.policy != "shaped" or plan.modes is not None or len(publish_slots(plan)) != 1:
        reason = "one slot in a cycle is put in step with a loop, of the policy shaped, with one"
        raise InputError(f"{option}: {reason} band and without modes: leave out the others")
    if plan.shaping_node is None:
        reason = "a shaping node's slot is put in step, not a publisher's thread"
        raise InputError(f"{option}: {reason}: plan with --publication synchronous, or in-process")


def _refuse_timing(
    plan: ChainPlan, recorded: RecordedLoop, loop: PlannedLoop, in_step: InStep
) -> None:
    """Refuse times of which no slot, or none in this cycle, is in step with a loop of a period.

    Raises InputError: they vary too much. OperationError: the cycle is too short.
    """
    option, named = _option(in_step), f"the loop of {loop.node}"
    cycle, period = plan.cycle_ns, loop.period_ns or plan.cycle_ns
    stored, common = loop.lead_ns - loop.stored_ns[0], math.gcd(cycle, period)
    if stored + loop.jitter_ns > common:
        why = " (its own thread takes them)" if recorded.takes_itself else ""
        raise InputError(
            f"{option}: messages on {loop.topic} are stored for {named} within"
            f" {duration_text(stored)} (with margin){why}, and its starts have a jitter of"
            f" {duration_text(loop.jitter_ns)}: together no shorter than the"
            f" {duration_text(common)} between its starts, so that chance decides which message it"
            f" uses. Record with {loop.node} under SCHED_FIFO, or leave this out"
        )
    ((start, _),) = publish_slots(plan)
    # Before an instance in the next cycle the slot ends with its own, so much sooner at most.
    sooner = max(0, start + common - 1 - _latest_start(plan, recorded.before_ns))
    if in_step == "output" and sooner + stored + loop.jitter_ns > common:
        raise OperationError(
            f"{option}: the slot has to start behind {duration_text(start)}, and to end with the"
            f" cycle of {duration_text(cycle)}, while messages are stored within"
            f" {duration_text(stored)} (with margin) and the loop's starts have a jitter of"
            f" {duration_text(loop.jitter_ns)}: where an instance, every {duration_text(period)},"
            f" begins in the next cycle, a message would come"
            f" {duration_text(sooner + stored + loop.jitter_ns - common)} too soon for it. Move the"
            " loop instead (--move-loop), or shorten the chain, its margin or its slot"
        )


def _in_step(plan: ChainPlan, loop: PlannedLoop, in_step: InStep, before_ns: int) -> ChainPlan:
    """Return the plan with slot and loop in step."""
    ((start, end),), cycle = publish_slots(plan), plan.cycle_ns
    common = math.gcd(cycle, loop.period_ns or cycle)
    if in_step == "loop":
        move = move_into_step(start, loop.lead_ns, loop.phase_ns, common)
        return revised(plan, loop=loop.model_copy(update={"in_step": in_step, "move_ns": move}))
    starts = (start, _latest_start(plan, before_ns))
    begins = start_in_step(starts, loop.lead_ns, loop.phase_ns, common)
    return revised(
        with_output_alone_at(plan, begins),
        predicted=in_one_slot((begins, begins + end - start)),
        loop=loop.model_copy(update={"in_step": in_step, "starts_ns": starts}),
    )


def _latest_start(plan: ChainPlan, before_ns: int) -> int:
    """Return where a slot starts at the latest: it ends, and its gate is done, with the cycle.

    It starts ``before_ns`` sooner, where outputs of other chains leave behind it.
    """
    ((start, end),), node = publish_slots(plan), plan.shaping_node
    done_ns = 0 if node is None else node_work_ns(plan, node) - node.spin_ns + node.pause_ns
    return max(start, plan.cycle_ns - max(end - start, done_ns) - before_ns)


def with_output_alone_at(plan: ChainPlan, start_ns: int) -> ChainPlan:
    """Return a plan whose output's only slot starts there; the chain's servers stay as they are."""
    publishing = plans.output_server(plan)
    ((start, end),) = publish_slots(plan)
    slots = {} if publishing is None else {publishing.name: [(start_ns, start_ns + end - start)]}
    return plan.model_copy(update={"servers": plans.with_slots(plan.servers, slots)})
