"""From what was measured of a chain, and what is wished, to its plan of any policy.

Further outputs of a chain's graph can be planned with it (``sinks``). A plan is made from latencies
that were measured while nothing was shaped: shaping a topic that another chain's output waits for
makes that one later than was measured. Such chains are refused.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from itertools import combinations, permutations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning import chain_plan as plans
from chainshaper.planning import margins, shaping
from chainshaper.planning.bands import (
    BandChoice,
    choose_bands,
    with_bands,
    with_long_slot,
    with_publish_slots,
)
from chainshaper.planning.chain_plan import (
    UNSHAPED,
    ChainPlan,
    Evidence,
    Margin,
    Modes,
    Prediction,
    Slot,
)
from chainshaper.planning.cores import assign_cores
from chainshaper.planning.latencies import check_latencies
from chainshaper.planning.offsets import refuse_common
from chainshaper.planning.pipeline import Work, pipelined, stage_places, work_of
from chainshaper.planning.profile import (
    UNKNOWN,
    Profile,
    alone,
    deciding_cycles,
    up_to,
    with_interference,
)
from chainshaper.planning.receivers import with_receivers_placed, without_reception
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Policy, Wishes

DEFAULT_CORE = 1
OWN_SLOTS = (*plans.PER_CALLBACK, "let-per-chain")
"""Policies whose plan has no slot behind the chain's, in the same cycle."""
_LIMITS = ("grid_ns", "max_gap_ns", "max_share")


@dataclass(frozen=True)
class PlanRequest(Wishes):
    """The wishes for a plan; every field has the default that the command line has.

    ``modes`` give each mode of the system one of the bands, which may have to be ``found``.
    """

    modes: Modes | None = None
    bands_of_modes: Literal["given", "found"] = "given"


_STANDARD = PlanRequest()


def plan_chain(
    profile: Profile, request: PlanRequest = _STANDARD, sinks: Sequence[Profile] = ()
) -> ChainPlan:
    """The plan of the requested policy for a measured chain.

    ``sinks`` are profiles of further outputs of the same graph, each of which is shaped too.

    Raises InputError: wishes that exclude each other, or need more than was measured.
    OperationError: no such plan exists; the message names what prevents it. PlatformError: a
    library that only this request needs is not installed.
    """
    try:
        return _plan_chain(profile, request, sinks)
    except OperationError as error:
        if profile.reception is not None:  # there may be room for the chain alone
            return plan_chain(without_reception(profile), request, sinks)
        remark = next(filter(None, map(deciding_cycles, (profile, *sinks))), None)
        if remark is None or request.percentile is not None:
            raise
        raise OperationError(f"{str(error).rstrip('.')}. {remark}") from error


def _plan_chain(profile: Profile, request: PlanRequest, sinks: Sequence[Profile]) -> ChainPlan:
    refuse_contradictions(request, sinks=bool(sinks), modes=bool(profile.of_modes))
    refuse_entangled((profile, *sinks), request.policy, sinks=True)
    refuse_simulated((profile, *sinks), request)
    if not keeps_places(request):
        profile = without_reception(profile)
    profile, *sinks = _prepared((profile, *map(without_reception, sinks)), request)
    if (modes := request.modes) is not None and profile.of_modes and request.policy == "shaped":
        profile, margin, modes, finish = _together(profile, request, modes)
    else:
        finish = partial(_with_policy, profile=profile, request=request)
        margin = _margin(profile, request)
    longest, period = profile.longest_ns, profile.period_ns
    if request.policy == "let-per-chain" and longest >= period:
        reason = f"LET per chain has to be done in the period {duration_text(period)}, and the"
        reason += f" longest latency is {duration_text(longest)}"
        raise OperationError(f"{reason}: plan LET per callback, or a longer period")
    measured = profile
    if request.policy in OWN_SLOTS:  # shaping, only the start of the plan, must fit into a cycle
        length = _slot_ns(profile, request)
        if (most := period - margin.epsilon_ns - length) < 1:
            both = f"margin {duration_text(margin.epsilon_ns)} and the publish slot"
            reason = (
                f"{duration_text(length)} leave nothing of the cycle of {duration_text(period)}"
            )
            raise OperationError(
                f"the {both} {reason}: plan with a shorter slot, or smaller margin"
            )
        latencies = np.minimum(check_latencies(profile.latencies_ns), most)
        measured = replace(profile, latencies_ns=latencies)
    plan = finish(_shaped(measured, request, margin, sinks))
    if request.policy in OWN_SLOTS:
        own = shaping.evidence_of(profile.latencies_ns, interference_ns=profile.interference_ns)
        figures = own.model_dump(exclude_unset=True)
        plan = plans.revised(plan, evidence=plan.evidence.model_copy(update=figures))
    for sink in sinks:
        if not sink.topics:
            raise InputError("a sink needs the topic it is published on: plan from a recording")
        ends, receivers = sink.topics[-1], sink.receivers if request.with_receivers else ()
        plan = shaping.with_sink(
            plan, sink.latencies_ns, ends, publisher=sink.last, receivers=receivers
        )
    no_process = plan.shaping_node is None or plan.shaping_node.in_process
    if request.fallback != _STANDARD.fallback and no_process:
        reason = f"--fallback {request.fallback} is for a shaping node that is a process"
        raise InputError(f"{reason}: leave it out, or plan with --publication synchronous")
    plan = shaping.with_executors(plan, [one.executors for one in (profile, *sinks)])
    plan = plans.revised(plan, modes=modes, slot_ends=request.slot_ends)
    plan = shaping.with_turns(plan, request.equal_priorities)
    (plan,) = with_receivers_placed([plan], [profile])
    return shaping.with_best_effort([plan], best_effort_cores([profile], request))[0]


def keeps_places(request: PlanRequest) -> bool:
    """Whether a plan keeps places for those that receive what shaping nodes publish."""
    gates = request.policy not in UNSHAPED and request.publication != "asynchronous"
    return gates and request.with_receivers


def _prepared(every: Sequence[Profile], request: PlanRequest) -> list[Profile]:
    """The profiles of a chain, and of its sinks, with the latencies that they are planned from."""
    if request.percentile is not None:
        every = [up_to(one, request.percentile) for one in every]
    every = [_apart(one) for one in every] if request.policy == "pipelined" else every
    every, _ = on_cores(every, request)
    every = with_interference(every, [range(len(every))], request, at_once=False)
    return [_covered(one, request) for one in every]


def _apart(profile: Profile) -> Profile:
    """The profile of a chain whose instances do not overlap: what its callbacks took, in sum, or,
    where branches join, on the longest way.
    """
    name = profile.name or "a chain"
    if not profile.steps_ns.size:
        raise InputError(f"{name}: stages are cut by what callbacks took: plan from a recording")
    if not profile.graph_steps_ns.size:
        if beside := sorted(Counter(p.node for p in profile.callbacks) - Counter(profile.nodes)):
            reason = f"{name} waits for {', '.join(beside)} beside it, and what these took"
            raise InputError(f"{reason} is not known: plan from a recording")
        return alone(profile)
    if UNKNOWN in profile.begins_ns:
        node = profile.callbacks[profile.begins_ns.index(UNKNOWN)].node
        reason = f"{name} waits for what {node} begins, and how long after {profile.nodes[0]} that"
        reason += " is varies in the recording, in which instances wait for each other: record its"
        raise InputError(f"{reason} nodes on more cores (`chainshaper profile --policy pipelined`)")
    return replace(
        profile,
        latencies_ns=_work(profile, profile.graph_steps_ns).finished_ns[:, -1],
        every_latency_ns=_work(profile, profile.every_graph_step_ns).finished_ns[:, -1],
    )


def _work(profile: Profile, steps_ns: NDArray[np.int64]) -> Work:
    """What a pipeline is made of: these steps, of the chain or, with branches, of the graph."""
    if not profile.graph_steps_ns.size:
        along = [range(k - 1, k) if k else () for k in range(len(profile.nodes))]
        return work_of(profile.nodes, along, steps_ns, [0] * len(along))
    callbacks = profile.callbacks
    nodes, first = [one.node for one in callbacks], profile.topics[0]
    begins = next(
        k
        for k, one in enumerate(callbacks)
        if (one.node, one.publishes) == (profile.nodes[0], first)
    )
    return work_of(nodes, [one.after for one in callbacks], steps_ns, profile.begins_ns, begins)


def best_effort_cores(
    profiles: Sequence[Profile], request: PlanRequest, core_of: Mapping[str, int] | None = None
) -> dict[str, int]:
    """The core of each node that is best effort: its own, or the first chain's, by ``core_of``."""
    if not request.best_effort:
        return {}
    cores = {node: core for one in profiles for node, core in one.cores.items()}
    homes = core_of or profiles[0].core_of
    last = (profiles[0].last if profiles else None) or ""
    chain = homes.get(last, next(iter(homes.values()), DEFAULT_CORE))
    names = ["/" + name.strip("/") for name in request.best_effort]
    known = sorted({node for one in profiles for node in one.every_node})
    for name in names if known else ():
        if name not in known:
            near = " or ".join(get_close_matches(name, known) or known[:5])
            raise InputError(f"--best-effort {name}: no node of the recording, name {near}")
    return {name: cores.get(name, chain) for name in names}


def _places(profiles: Sequence[Profile], cores: Sequence[int]) -> dict[str, int]:
    """The place in ``cores`` of the stage that each node of a pipeline is in."""
    places: dict[str, int] = {}
    for one in profiles:
        apart = _apart(one)
        steps = apart.graph_steps_ns if apart.graph_steps_ns.size else apart.steps_ns
        places |= stage_places(_work(apart, steps), one.period_ns, len(cores))
    return places


def stages_before(profiles: Sequence[Profile], request: PlanRequest) -> dict[str, int]:
    """How many stages of a pipeline are more urgent than a node's, where cores are named twice."""
    if request.policy != "pipelined" or request.cores is None:
        return {}
    cores, places = request.cores, _places(profiles, request.cores)
    return {node: cores[:place].count(cores[place]) for node, place in places.items()}


def cores_for(
    profiles: Sequence[Profile],
    cores: Sequence[int],
    request: PlanRequest = _STANDARD,
    worth: float = 0.0,
) -> dict[str, int]:
    """The core of each node of these chains, see :func:`~chainshaper.planning.cores.assign_cores`
    and, for stages, :func:`.stage_places`. Raises InputError: a profile is bare latencies.
    """
    for profile in profiles:
        if not profile.callbacks:
            reason = f"--cores distributes callbacks, and latencies do not say {profile.name}'s"
            raise InputError(f"{reason}: plan from a recording")
    if request.policy == "pipelined":
        return {node: cores[k] for node, k in _places(profiles, cores).items()}
    margin_ns = margins.given_or_least_epsilon_ns(request)
    return assign_cores(profiles, cores, margin_ns=margin_ns, worth=worth)


def on_cores(
    profiles: Sequence[Profile], request: PlanRequest
) -> tuple[tuple[Profile, ...], list[str]]:
    """The profiles with their executors on the wished cores, and whose latency is another there."""
    if request.cores is None or request.policy == "pipelined":  # there, stages get them
        return tuple(profiles), []
    return moved_to(profiles, request.cores, cores_for(profiles, request.cores, request))


def moved_to(
    profiles: Sequence[Profile], cores: Sequence[int], core_of: Mapping[str, int]
) -> tuple[tuple[Profile, ...], list[str]]:
    """The profiles with nodes on these of the wished cores, and whose latency is another there."""
    moved, doubts = [], []
    for one in profiles:
        own = {node: core_of[node] for node in one.core_of}
        homes = {(own[node], core) for node, core in one.core_of.items()}
        if not len(homes) == len(set(own.values())) == len(set(one.core_of.values())):
            said = f"{one.name} was measured with its executors on cores in another way than"
            said += " planned, which is another latency: measure it so (`chainshaper profile"
            doubts.append(f"{said} --cores {','.join(map(str, cores))}`)")
        callbacks = tuple(replace(each, core=core_of[each.node]) for each in one.callbacks)
        moved.append(replace(one, core_of=own, callbacks=callbacks))
    return tuple(moved), doubts


def band_choice(
    plan: ChainPlan, profile: Profile, request: PlanRequest, sinks: Sequence[Profile] = ()
) -> BandChoice:
    """The curve of figure 7 for a plan that :func:`plan_chain` made of this, and what ``auto``
    takes from it.
    """
    latencies = _prepared((profile, *sinks), request)[0].measured
    return choose_bands(plan, latencies, **_of(request, *_LIMITS, "least_gain"))


def _of(one: PlanRequest | Profile, *names: str) -> dict[str, Any]:
    return {name: getattr(one, name) for name in names}


def _covered(profile: Profile, request: PlanRequest) -> Profile:
    """Where no cycle was undisturbed, the profile of those that a margin would cover."""
    if not profile.all_disturbed:
        return profile
    if request.ideal_machine:
        reason = f"the machine disturbed every cycle of {profile.name}, but one at most"
        remedy = "leave out --ideal-machine, or record again"
        raise OperationError(f"{profile.recording or profile.name}: {reason}: {remedy}")
    if request.percentile is not None:  # what takes longer has been left out
        return profile
    every = profile.every
    latest_slot_ns = _latest_slot_ns(profile, request)
    covered = every[every <= margins.covering_latency(every, request, latest_slot_ns)]
    latencies = covered if covered.size > 1 else every  # none fits, which the planner refuses
    return replace(profile, latencies_ns=latencies, every_latency_ns=every)


def _latest_slot_ns(profile: Profile, request: PlanRequest) -> int | None:
    """Return when the publish slot has to begin to end in the cycle; None: the policy places it."""
    if request.policy in OWN_SLOTS:
        return None
    return profile.period_ns - _slot_ns(profile, request)


def _slot_ns(profile: Profile, request: PlanRequest) -> int:
    """Δ, long enough for a publication (eq. 2 and 4): given, or as long as the longest measured,
    1 ms at least; several sends of an asynchronous publisher, whose thread must not stop in one.
    """
    if request.publish_slot_ns is not None:
        return request.publish_slot_ns
    longest = profile.longest_publication_ns or 0
    if request.publication == "asynchronous":
        longest = plans.SENDS_PER_SLOT * (profile.longest_send_ns or 0)
    grid = max(1, request.grid_ns)
    return max(plans.SHORTEST_SLOT_NS, -(-longest // grid) * grid)


def place_modes(
    starts_ns: Mapping[str, int], length_ns: int, given: Mapping[str, int] | None = None
) -> tuple[dict[str, int], tuple[Slot, ...]]:
    """The band of each mode, and the slots: each behind the one before, when all outputs of its
    modes may leave (from L̄ + ε of the cycles that began in a mode on: eq. 1 for each by itself).
    Unless bands are ``given``, slots that would overlap are one.
    """
    first, band, bands = 0, 0, dict(given or {})
    for mode in () if given else sorted(starts_ns, key=starts_ns.__getitem__):
        if not band or starts_ns[mode] >= first + length_ns:
            first, band = starts_ns[mode], band + 1
        bands[mode] = band
    slots: list[Slot] = []
    for band in range(1, max(bands.values()) + 1):
        if band not in bands.values():
            raise InputError(f"no mode has the band {band}: number them from 1 on, or leave it out")
        own = (start for mode, start in starts_ns.items() if bands[mode] == band)
        start = max(*own, slots[-1][1] if slots else 0)
        slots.append((start, start + length_ns))
    return bands, tuple(slots)


def with_modes(
    plan: ChainPlan, modes: Modes, slots: tuple[Slot, ...], measured: Mapping[str, Evidence]
) -> ChainPlan:
    """A shaped plan with slots for modes of which each was measured.

    The prediction of the whole is for modes in force as often as they were measured.
    """
    cycles = [0] * len(slots)
    for mode, own in measured.items():
        cycles[modes.bands[mode] - 1] += own.samples
    shares = tuple(own / sum(cycles) for own in cycles)
    predicted = Prediction(
        mean_ns=round(sum(share * end for share, (_, end) in zip(shares, slots, strict=True))),
        max_ns=slots[-1][1],
        jitter_ns=slots[-1][1] - slots[0][0],
        shares=shares,
        modes={mode: plans.in_one_slot(slots[modes.bands[mode] - 1]) for mode in measured},
    )
    evidence = plan.evidence.model_copy(update={"modes": dict(measured)})
    return with_publish_slots(plan, slots, evidence=evidence, predicted=predicted, modes=modes)


def _together(
    profile: Profile, request: PlanRequest, modes: Modes
) -> tuple[Profile, Margin, Modes, Callable[[ChainPlan], ChainPlan]]:
    """The profile of all modes, the margin up to their last slot, the modes with bands, and what
    gives a plan the slots.
    """
    apart = {mode: _covered(profile.of_modes[mode], request) for mode in modes.bands}
    own = {mode: _margin(one, request) for mode, one in apart.items()}
    starts = {mode: one.longest_ns + own[mode].epsilon_ns for mode, one in apart.items()}
    given = None if request.bands_of_modes == "found" else modes.bands
    bands, slots = place_modes(starts, _slot_ns(profile, request), given)
    modes = modes.model_copy(update={"bands": bands})
    why = f"but each mode's slot is placed from its own latencies, here {len(slots)}: leave it out"
    _refuse_placement(replace(request, bands=1) if request.bands == len(slots) else request, why)
    measured = {}
    for mode, one in apart.items():
        conditions = _of(one, "recording", "disturbed", "all_disturbed")
        measured[mode] = shaping.evidence_of(one.latencies_ns, **conditions)
    both = replace(
        profile,
        latencies_ns=np.concatenate([one.latencies_ns for one in apart.values()]),
        every_latency_ns=np.concatenate([one.every for one in apart.values()]),
        disturbed=sum(one.disturbed for one in apart.values()),
        all_disturbed=any(one.all_disturbed for one in apart.values()) or None,
    )
    late = [margin.overrun_probability or 0.0 for margin in own.values()]
    last = {"epsilon_ns": slots[-1][0] - both.longest_ns, "overrun_probability": max(late) or None}
    margin = own[max(starts, key=starts.__getitem__)].model_copy(update=last)
    return both, margin, modes, partial(with_modes, modes=modes, slots=slots, measured=measured)


def _shaped(
    profile: Profile, request: PlanRequest, margin: Margin, sinks: Sequence[Profile]
) -> ChainPlan:
    last = profile.last
    values = {n: getattr(profile, n) for n in Evidence.model_fields if hasattr(profile, n)}
    if request.publication == "asynchronous":
        if profile.asynchronous is False:
            reason = f"{last} has no thread that publishes for it: plan with --publication"
            reason += " synchronous, or record with rmw_fastrtps_cpp,"
            raise InputError(f"{reason} RMW_FASTRTPS_PUBLICATION_MODE=ASYNCHRONOUS")
        values["output_depth"] = profile.output_depth
    if request.publication == "in-process" and profile.intra_process:
        reason = f"subscribers of {profile.topics[-1]} get its messages inside the process of"
        reason += f" {last}, where no gate before DDS sees them: switch that off, or plan with"
        raise InputError(f"{reason} --publication synchronous, and splice with --node cpp")
    unused = "publication" if request.publication == "asynchronous" else "send"
    del values[f"longest_{unused}_ns"]  # no evidence for it
    length = _slot_ns(profile, request)
    found = "measured" if length > plans.SHORTEST_SLOT_NS else "least"
    values["publish_slot"] = found if request.publish_slot_ns is None else "given"
    # At once by default, unless the thread of an asynchronous publisher has outputs due later.
    bound = request.publication == "asynchronous" and request.policy in OWN_SLOTS
    plan = shaping.plan_shaping(
        profile.latencies_ns,
        profile.period_ns,
        wishes=request,
        publish_slot_ns=length,
        margin=margin,
        spec=profile.spec,
        output=profile.topics[-1] if profile.topics else None,
        publisher=last,
        nodes=tuple(dict.fromkeys(profile.nodes)),
        core=profile.core_of.get(last or "", DEFAULT_CORE),
        overrun=request.overrun or ("wait" if bound else "publish"),
        fifo_priority=profile.fifo_priority,
        receivers=profile.receivers if request.with_receivers else (),
        max_of_all_ns=int(profile.every.max()),
        **values,
    )
    core_of = {node: core for one in (profile, *sinks) for node, core in one.core_of.items()}
    if request.first_slot_ns is not None:
        if not profile.nodes:
            raise InputError("a slot for the first node needs the chain's nodes: give a recording")
        first = profile.nodes[0]
        plan = shaping.with_first_node_apart(
            plan, first, request.first_slot_ns, core_of.pop(first, None)
        )
    return shaping.over_cores(plan, core_of) if core_of else plan


def _margin(profile: Profile, request: PlanRequest) -> Margin:
    """Return the margin behind the longest latency that a chain is planned from."""
    return margins.planned_margin(
        profile.latencies_ns,
        profile.every,
        request,
        latest_slot_ns=_latest_slot_ns(profile, request),
        decides_slot=request.policy not in OWN_SLOTS or request.policy == "pipelined",
    )


def _with_policy(plan: ChainPlan, profile: Profile, request: PlanRequest) -> ChainPlan:
    if request.policy == "shaped":
        names = ("solver", "minimise", "mean_at_most_ns", "least_gain", "seed")
        values = _of(request, *_LIMITS, *names)
        most = profile.latencies_ns
        return with_bands(plan, profile.measured, request.bands, most_ns=most, **values)
    if request.policy == "one-long-slot":
        if request.slot_start_ns is None:
            raise InputError("one long slot needs its start: add --slot-start, such as 62ms")
        return with_long_slot(plan, profile.latencies_ns, request.slot_start_ns)
    if request.policy in ("server-per-chain", "let-per-chain"):
        unshaped = request.policy in UNSHAPED
        return (shaping.server_per_chain if unshaped else shaping.let_per_chain)(plan)
    if not profile.callbacks or not profile.topics:
        reason = f"the policy {request.policy} needs the chain's callbacks"
        raise InputError(f"{reason}: plan from a recording")
    if request.policy == "pipelined":
        with_branches = bool(profile.graph_steps_ns.size)
        steps = profile.graph_steps_ns if with_branches else profile.steps_ns
        if profile.all_disturbed:
            every = profile.every_graph_step_ns if with_branches else profile.every_step_ns
            steps = every[_work(profile, every).finished_ns[:, -1] <= profile.longest_ns]
        work, cores = _work(profile, steps), request.cores
        one, room_ns = profile.reception, profile.others_ns
        if one is not None and one.core in (None, *(cores or profile.core_of.values())):
            room_ns += one.time_ns + one.beside_ns
        return pipelined(plan, work, profile.core_of, cores, room_ns=room_ns)
    if request.policy == "server-per-callback":
        margin_ns = plan.margin.epsilon_ns
        return shaping.server_per_callback(plan, profile.callbacks, margin_ns=margin_ns)
    return shaping.let_per_callback(plan, profile.topics, profile.nodes)


def refuse_contradictions(request: PlanRequest, *, sinks: bool, modes: bool) -> None:
    """Refuse wishes that nothing fulfils, with further ``sinks``, and ``modes`` measured or not."""
    if request.bands_of_modes == "found" and not (modes and request.policy == "shaped"):
        reason = "nothing says which mode was in force while latencies were measured"
        raise InputError(f"{reason}: add --mode-profile MODE=REC, or say what `announces` them")
    margins.refuse_contradictory_margin(request)
    if request.policy != "one-long-slot" and request.slot_start_ns is not None:
        raise InputError("a slot's start goes with the policy one-long-slot: add it")
    cores = request.cores or ()
    if request.policy != "pipelined" and len(set(cores)) < len(cores):
        raise InputError("--cores names a core twice, which only stages may have: name each once")
    if request.first_slot_ns is not None and request.policy in ("pipelined", "server-per-callback"):
        reason = f"and the policy {request.policy} cuts the whole chain into servers"
        raise InputError(f"--first-slot gives the first node a server, {reason}: leave it out")
    if request.policy == "shaped":
        return
    why = f"which the policy {request.policy} has not: leave it out, or plan with the policy shaped"
    _refuse_placement(request, why)
    if sinks:
        raise InputError(f"further sinks are shaped, not planned as {request.policy}")


def _refuse_placement(request: PlanRequest, why: str) -> None:
    for name in ("bands", "solver", "max_gap_ns", "max_share", "minimise", "mean_at_most_ns"):
        if getattr(request, name) != getattr(_STANDARD, name):
            option = name.removesuffix("_ns").replace("_", "-")
            raise InputError(f"--{option} places latency bands, {why}")


def refuse_entangled(profiles: Sequence[Profile], policy: Policy, *, sinks: bool = False) -> None:
    """Refuse chains of which one waits for what another's plan delays, or with one output.

    With ``sinks`` all are planned as one: the first chain, and further outputs of its graph.
    """
    for one, two in combinations(profiles, 2):
        if one.topics and (one.begins, one.topics) == (two.begins, two.topics):
            raise InputError(f"the chain {two.name} is given twice: name it once")
        outputs = [profile.topics[-1] if profile.topics else None for profile in (one, two)]
        refuse_common((one.name, two.name), (outputs[0], outputs[1]))
    for shaped, waiting in permutations(profiles, 2):
        # The topics that come later under the plan than they were measured:
        delayed = shaped.topics if policy == "let-per-callback" else shaped.topics[-1:]
        on_the_way = sorted(waiting.upstream.intersection(delayed))
        if on_the_way and policy not in UNSHAPED:
            reason = f"{waiting.name} waits for {', '.join(on_the_way)}, which the plan for"
            reason += f" {shaped.name} publishes later than it was measured"
            raise InputError(f"{reason}: plan one of the two alone")
    for one, two in combinations(profiles, 2):
        if sinks and one.period_ns != two.period_ns:
            reason = f"{two.name} has the period {duration_text(two.period_ns)}, {one.name}"
            raise InputError(f"{reason} {duration_text(one.period_ns)}: plan one of the two alone")
        if one.begins is None or two.begins is None or one.begins == two.begins:
            continue
        begin = (
            f"{two.name} begins at {two.begins[1]}, {one.name} at another callback, {one.begins[1]}"
        )
        if sinks:
            reason = f"{begin}, and slots of a sink count from the beginning of the chain"
            raise InputError(f"{reason}: name one behind the same callback, or plan one alone")
        if common := sorted(_waited_for(one, two) | _waited_for(two, one)):
            reason = f"{begin}, and both need {', '.join(common)}: neither's cycles can start"
            reason += " without the other's. Begin both where all of it comes from, or plan one of"
            raise InputError(f"{reason} the two alone")


def refuse_simulated(profiles: Sequence[Profile], request: PlanRequest) -> None:
    """Refuse to count slots from stamps that are not of the clock of gates and servers."""
    for one in profiles:
        if one.simulated and request.anchor == "stamp" and request.policy not in UNSHAPED:
            raise InputError(simulated_stamps(one.simulated[0]))


def simulated_stamps(node: str) -> str:
    """Why no slot counts from the stamps of a node that follows `/clock`, and what to do."""
    return (
        f"{node} follows /clock (use_sim_time): its stamps are of simulated time. Start it with"
        " use_sim_time:=false; or, where /clock is as fast as time, plan with --anchor cycle"
    )


def _waited_for(one: Profile, two: Profile) -> frozenset[str]:
    """Topics that a chain waits for and are not on its way, which another has or waits for too."""
    return (one.upstream - set(one.topics)) & (two.upstream | set(two.topics))
