"""From the profile of a chain, and the wishes of a user, to its plan of any policy.

Further outputs of a chain's graph can be planned with it (``sinks``). A plan is made from latencies
that were measured while nothing was shaped. Shaping a topic that the output of another chain waits
for makes that output later than it was measured, so such chains are refused.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from itertools import combinations, permutations
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning import chain_plan as plans
from chainshaper.planning import loops, margins, shaping
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
from chainshaper.planning.next_cycle import NextCycle
from chainshaper.planning.offsets import refuse_common
from chainshaper.planning.pipeline import Work, pipelined, stage_places, work_of
from chainshaper.planning.profile import (
    GATE_TAKES_NS,
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
from chainshaper.values.plan_choices import Policy, Wishes, WishKeywords

DEFAULT_CORE = 1
OWN_SLOTS = (*plans.PER_CALLBACK, "let-per-chain")
"""Policies whose plan has no slot behind the chain's, in the same cycle."""


@dataclass(frozen=True)
class PlanRequest(Wishes):
    """The wishes for a plan; every field has the default that the command line has."""

    modes: Modes | None = None  # the modes of the system, each with a band
    # Whether the user gave each mode's band, or it is placed from the latencies in that mode.
    bands_of_modes: Literal["given", "found"] = "given"


class RequestKeywords(WishKeywords, total=False):
    """The fields of :class:`PlanRequest` as keyword arguments, for type checkers and editors."""

    modes: Modes | None
    bands_of_modes: Literal["given", "found"]


def with_keywords(request: PlanRequest, keywords: Mapping[str, Any]) -> PlanRequest:
    """Return a request with the fields that keyword arguments name.

    Raises InputError: a request has no field of such a name.
    """
    known = [field.name for field in fields(PlanRequest)]
    for name in keywords:
        if name not in known:
            near = get_close_matches(name, known, n=1)
            meant = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
            raise InputError(f"a plan request has no field {name!r}: {meant}")
    return replace(request, **keywords)


_STANDARD = PlanRequest()


def plan_chain(
    profile: Profile, request: PlanRequest = _STANDARD, sinks: Sequence[Profile] = ()
) -> ChainPlan:
    """Plan a measured chain by the requested policy.

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
    profile = loops.beside_receivers(profile)
    profile, *sinks = _prepared((profile, *map(without_reception, sinks)), request)
    modes = request.modes
    if modes is not None and profile.of_modes and request.policy == "shaped":
        placed = _placed_modes(profile, request, modes)
        profile, modes = placed.profile, placed.modes
        plan = _shaped(profile, request, placed.margin, sinks)
        plan = with_modes(plan, modes, placed.slots, placed.evidence)
    elif request.policy in OWN_SLOTS:
        margin = _margin(profile, request)
        start = _fitting_into_cycle(profile, request, margin)
        plan = _with_policy(_shaped(start, request, margin, sinks), profile, request)
        plan = _with_evidence_of(plan, profile)
    else:
        plan = _shaped(profile, request, _margin(profile, request), sinks)
        plan = _with_policy(plan, profile, request)
    for sink in sinks:
        if not sink.topics:
            raise InputError("a sink needs the topic it is published on: plan from a recording")
        plan = shaping.with_sink(
            plan,
            sink.latencies_ns,
            sink.topics[-1],
            publisher=sink.last,
            receivers=sink.receivers if request.with_receivers else (),
        )
    no_process = plan.shaping_node is None or plan.shaping_node.in_process
    if request.fallback != _STANDARD.fallback and no_process:
        reason = f"--fallback {request.fallback} is for a shaping node that is a process"
        raise InputError(f"{reason}: leave it out, or plan with --publication synchronous")
    plan = shaping.with_executors(
        plan,
        [output.executors for output in (profile, *sinks)],
        {
            executor: group_id
            for output in (profile, *sinks)
            for executor, group_id in output.callback_groups.items()
        },
    )
    plan = plans.revised(plan, modes=modes, slot_ends=request.slot_ends)
    plan = shaping.with_turns(plan, request.equal_priorities)
    plan = loops.with_loop(plan, profile, request)
    (plan,) = with_receivers_placed([plan], [profile])
    plan = loops.with_thread_placed(plan, profile)
    return shaping.with_best_effort([plan], best_effort_cores([profile], request))[0]


def _fitting_into_cycle(profile: Profile, request: PlanRequest, margin: Margin) -> Profile:
    """Return a profile with which shaping fits into a cycle, for a policy with slots of its own.

    Shaping is only the start of such a plan: the policy replaces its slots afterwards.
    """
    longest, period = profile.longest_ns, profile.period_ns
    if request.policy == "let-per-chain" and longest >= period:
        reason = f"LET per chain has to be done in the period {duration_text(period)}, and the"
        reason += f" longest latency is {duration_text(longest)}"
        raise OperationError(f"{reason}: plan LET per callback, or a longer period")
    length = slot_ns(profile, request)
    most = period - margin.epsilon_ns - length
    if most < 1:
        reason = f"the margin {duration_text(margin.epsilon_ns)} and the publish slot"
        reason += f" {duration_text(length)} leave nothing of the cycle of {duration_text(period)}"
        raise OperationError(f"{reason}: plan with a shorter slot, or smaller margin")
    return replace(profile, latencies_ns=np.minimum(check_latencies(profile.latencies_ns), most))


def _with_evidence_of(plan: ChainPlan, profile: Profile) -> ChainPlan:
    """Return a plan with the latencies as they were measured, not as they fit into a cycle."""
    measured = shaping.evidence_of(profile.latencies_ns, interference_ns=profile.interference_ns)
    figures = measured.model_dump(exclude_unset=True)
    return plans.revised(plan, evidence=plan.evidence.model_copy(update=figures))


def keeps_places(request: PlanRequest) -> bool:
    """Whether a plan has places for the nodes that receive what shaping nodes publish."""
    gates = request.policy not in UNSHAPED and request.publication != "asynchronous"
    return gates and request.with_receivers


def _prepared(profiles: Sequence[Profile], request: PlanRequest) -> list[Profile]:
    """Return profiles of a chain and its sinks with the latencies that they are planned from."""
    if request.percentile is not None:
        profiles = [up_to(profile, request.percentile) for profile in profiles]
    if request.policy == "pipelined":
        profiles = [_apart(profile) for profile in profiles]
    profiles, _ = on_cores(profiles, request)
    profiles = with_interference(profiles, [range(len(profiles))], request, at_once=False)
    return [_covered(profile, request) for profile in profiles]


def _apart(profile: Profile) -> Profile:
    """Return the profile of a chain as if its instances did not overlap, to be cut into stages.

    A latency is the sum of what its callbacks took, or, where branches join, that on the longest
    way.
    """
    name = profile.name or "a chain"
    if not profile.steps_ns.size:
        raise InputError(f"{name}: stages are cut by what callbacks took: plan from a recording")
    if not profile.graph_steps_ns.size:
        nodes = Counter(callback.node for callback in profile.callbacks)
        if beside := sorted(nodes - Counter(profile.nodes)):
            reason = f"{name} joins data of {', '.join(beside)}, whose times are not known"
            raise InputError(f"{reason}: plan from a recording")
        return alone(profile)
    if UNKNOWN in profile.begins_ns:
        node = profile.callbacks[profile.begins_ns.index(UNKNOWN)].node
        reason = f"{name} joins data of {node}, which starts at varying times after"
        reason += f" {profile.nodes[0]} in the recording, where instances wait for each other"
        remedy = "record its nodes on more cores (`chainshaper profile --policy pipelined`)"
        raise InputError(f"{reason}: {remedy}")
    return replace(
        profile,
        latencies_ns=_work(profile, profile.graph_steps_ns).finished_ns[:, -1],
        every_latency_ns=_work(profile, profile.every_graph_step_ns).finished_ns[:, -1],
    )


def _work(profile: Profile, steps_ns: NDArray[np.int64]) -> Work:
    """Return what a pipeline is cut from: steps of the chain, or of a graph with branches."""
    if not profile.graph_steps_ns.size:
        along = [range(place - 1, place) if place else () for place in range(len(profile.nodes))]
        return work_of(profile.nodes, along, steps_ns, [0] * len(along))
    callbacks = profile.callbacks
    nodes, first_topic = [callback.node for callback in callbacks], profile.topics[0]
    first_place = next(
        place
        for place, callback in enumerate(callbacks)
        if (callback.node, callback.publishes) == (profile.nodes[0], first_topic)
    )
    return work_of(
        nodes, [callback.after for callback in callbacks], steps_ns, profile.begins_ns, first_place
    )


def best_effort_cores(
    profiles: Sequence[Profile], request: PlanRequest, core_of: Mapping[str, int] | None = None
) -> dict[str, int]:
    """Return the core of each node that is best effort: where it was recorded, or with a chain.

    A node without a core is on that of the first chain's last node, by ``core_of`` (default: where
    that was recorded).
    """
    if not request.best_effort:
        return {}
    cores = {node: core for profile in profiles for node, core in profile.cores.items()}
    homes = core_of or profiles[0].core_of
    last = (profiles[0].last if profiles else None) or ""
    chain_core = homes.get(last, next(iter(homes.values()), DEFAULT_CORE))
    names = ["/" + name.strip("/") for name in request.best_effort]
    known = sorted({node for profile in profiles for node in profile.every_node})
    for name in names if known else ():
        if name not in known:
            near = " or ".join(get_close_matches(name, known) or known[:5])
            raise InputError(f"--best-effort {name}: no node of the recording, name {near}")
    return {name: cores.get(name, chain_core) for name in names}


def _places(profiles: Sequence[Profile], cores: Sequence[int]) -> dict[str, int]:
    """Return the place in ``cores`` of the stage that each node of a pipeline is in."""
    places: dict[str, int] = {}
    for profile in profiles:
        apart = _apart(profile)
        work = _work(apart, apart.planned_steps_ns)
        places |= stage_places(work, profile.period_ns, len(cores))
    return places


def stages_before(profiles: Sequence[Profile], request: PlanRequest) -> dict[str, int]:
    """Return how many stages of a pipeline are more urgent than each node's on its core.

    Only where the wished cores name one twice, several stages share it.
    """
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
    """Return the core of each node of these chains.

    See :func:`~chainshaper.planning.cores.assign_cores` and, for stages, :func:`.stage_places`.
    Raises InputError: a profile is bare latencies.
    """
    for profile in profiles:
        if not profile.callbacks:
            reason = f"--cores distributes callbacks, and latencies do not say {profile.name}'s"
            raise InputError(f"{reason}: plan from a recording")
    if request.policy == "pipelined":
        return {node: cores[place] for node, place in _places(profiles, cores).items()}
    margin_ns = margins.given_or_least_epsilon_ns(request)
    return assign_cores(profiles, cores, margin_ns=margin_ns, worth=worth)


def on_cores(
    profiles: Sequence[Profile], request: PlanRequest
) -> tuple[tuple[Profile, ...], list[str]]:
    """Move the executors to the wished cores; say of which chains the latency changes by that."""
    if request.cores is None or request.policy == "pipelined":  # a pipeline's stages get the cores
        return tuple(profiles), []
    return moved_to(profiles, request.cores, cores_for(profiles, request.cores, request))


def moved_to(
    profiles: Sequence[Profile], cores: Sequence[int], core_of: Mapping[str, int]
) -> tuple[tuple[Profile, ...], list[str]]:
    """Move nodes to ``core_of``, out of ``cores``; say of which chains the latency changes by that.

    It does where executors that shared a core do so no longer, or the other way round.
    """
    moved, doubts = [], []
    for profile in profiles:
        new_cores = {node: core_of[node] for node in profile.core_of}
        homes = {(new_cores[node], core) for node, core in profile.core_of.items()}
        if not len(homes) == len(set(new_cores.values())) == len(set(profile.core_of.values())):
            doubt = f"{profile.name} was measured with its executors on cores in another way than"
            doubt += " planned, which is another latency: measure it so (`chainshaper profile"
            doubts.append(f"{doubt} --cores {','.join(map(str, cores))}`)")
        callbacks = tuple(
            replace(callback, core=core_of[callback.node]) for callback in profile.callbacks
        )
        moved.append(replace(profile, core_of=new_cores, callbacks=callbacks))
    return tuple(moved), doubts


def band_choice(
    plan: ChainPlan, profile: Profile, request: PlanRequest, sinks: Sequence[Profile] = ()
) -> BandChoice:
    """Return how ``auto`` chose the bands of a plan that :func:`plan_chain` made of the same."""
    return choose_bands(
        plan,
        _prepared((profile, *sinks), request)[0].measured,
        least_gain=request.least_gain,
        grid_ns=request.grid_ns,
        max_gap_ns=request.max_gap_ns,
        max_share=request.max_share,
    )


def _covered(profile: Profile, request: PlanRequest) -> Profile:
    """Return the profile of the cycles that a margin would cover, where none was undisturbed."""
    if not profile.all_disturbed:
        return profile
    if request.ideal_machine:
        reason = f"the machine disturbed every cycle of {profile.name}, but one at most"
        remedy = "leave out --ideal-machine, or record again"
        raise OperationError(f"{profile.recording or profile.name}: {reason}: {remedy}")
    if request.percentile is not None:  # what takes longer has been left out
        return profile
    every = profile.every
    following = _next_cycle(profile, request)
    covered = every[every <= margins.covering_latency(every, request, following)]
    latencies = covered if covered.size > 1 else every  # no slot fits, which the planner refuses
    return replace(profile, latencies_ns=latencies, every_latency_ns=every)


def _next_cycle(profile: Profile, request: PlanRequest) -> NextCycle | None:
    """Return what the publish slot has to leave room for; None: the policy places the slot."""
    if request.policy in OWN_SLOTS:
        return None
    work_ns, reception = 0, profile.reception
    nodes = profile.nodes
    # The gate runs on the core of the output's publisher, before the executors of the chain.
    if not nodes or profile.core_of.get(nodes[0]) == profile.core_of.get(nodes[-1]):
        work_ns = GATE_TAKES_NS + (profile.longest_publication_ns or 0)
        if reception is not None and request.with_receivers:
            work_ns += reception.time_ns + reception.beside_ns
    length = slot_ns(profile, request)
    return NextCycle(profile.period_ns, length, work_ns, request.overrun or "publish")


def slot_ns(profile: Profile, request: PlanRequest) -> int:
    """Return Δ, the length of the publish slot, long enough for a publication (eq. 2 and 4).

    Unless it is given, it is the longest publication measured, 1 ms at least. An asynchronous
    publisher's thread must not stop in a send, so its slot is as long as several.
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
    """Return the band of each mode, from 1 on, and the slots.

    ``starts_ns`` is when the outputs of each mode may leave: at L̄ + ε of the cycles that began in
    it (eq. 1 for each mode by itself). A slot begins when the outputs of all its modes may leave,
    behind the slot before it. Unless the bands are ``given``, slots that would overlap are joined.
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
        of_modes = (start for mode, start in starts_ns.items() if bands[mode] == band)
        start = max(*of_modes, slots[-1][1] if slots else 0)
        slots.append((start, start + length_ns))
    return bands, tuple(slots)


def with_modes(
    plan: ChainPlan, modes: Modes, slots: tuple[Slot, ...], measured: Mapping[str, Evidence]
) -> ChainPlan:
    """Return a shaped plan with slots for modes, each of which was measured.

    The prediction is for modes that are in force as often as they were when measured.
    """
    cycles = [0] * len(slots)
    for mode, of_mode in measured.items():
        cycles[modes.bands[mode] - 1] += of_mode.samples
    shares = tuple(count / sum(cycles) for count in cycles)
    predicted = Prediction(
        mean_ns=round(sum(share * end for share, (_, end) in zip(shares, slots, strict=True))),
        max_ns=slots[-1][1],
        jitter_ns=slots[-1][1] - slots[0][0],
        shares=shares,
        modes={mode: plans.in_one_slot(slots[modes.bands[mode] - 1]) for mode in measured},
    )
    evidence = plan.evidence.model_copy(update={"modes": dict(measured)})
    return with_publish_slots(plan, slots, evidence=evidence, predicted=predicted, modes=modes)


class _PlacedModes(NamedTuple):
    """The modes of a system with slots, each from the latencies that were measured in it."""

    profile: Profile  # of the cycles in all modes
    margin: Margin  # from the longest latency in any mode to the last slot
    modes: Modes  # with their bands
    slots: tuple[Slot, ...]  # of the bands
    evidence: Mapping[str, Evidence]  # of each mode


def _placed_modes(profile: Profile, request: PlanRequest, modes: Modes) -> _PlacedModes:
    """Place the slots of modes, each of which was measured."""
    profiles = {mode: _covered(profile.of_modes[mode], request) for mode in modes.bands}
    margin_of = {mode: _margin(of_mode, request) for mode, of_mode in profiles.items()}
    starts = {
        mode: of_mode.longest_ns + margin_of[mode].epsilon_ns for mode, of_mode in profiles.items()
    }
    given = None if request.bands_of_modes == "found" else modes.bands
    bands, slots = place_modes(starts, slot_ns(profile, request), given)
    why = f"but each mode's slot is placed from its own latencies, here {len(slots)}: leave it out"
    _refuse_placement(replace(request, bands=1) if request.bands == len(slots) else request, why)
    together = replace(
        profile,
        latencies_ns=np.concatenate([of_mode.latencies_ns for of_mode in profiles.values()]),
        every_latency_ns=np.concatenate([of_mode.every for of_mode in profiles.values()]),
        disturbed=sum(of_mode.disturbed for of_mode in profiles.values()),
        all_disturbed=any(of_mode.all_disturbed for of_mode in profiles.values()) or None,
    )
    latest_mode = max(starts, key=starts.__getitem__)
    late = max(margin.overrun_probability or 0.0 for margin in margin_of.values())
    return _PlacedModes(
        together,
        margin_of[latest_mode].model_copy(
            update={
                "epsilon_ns": slots[-1][0] - together.longest_ns,
                "overrun_probability": late or None,
            }
        ),
        modes.model_copy(update={"bands": bands}),
        slots,
        {
            mode: shaping.evidence_of(
                of_mode.latencies_ns,
                recording=of_mode.recording,
                disturbed=of_mode.disturbed,
                all_disturbed=of_mode.all_disturbed,
            )
            for mode, of_mode in profiles.items()
        },
    )


def _shaped(
    profile: Profile, request: PlanRequest, margin: Margin, sinks: Sequence[Profile]
) -> ChainPlan:
    """Return a plan that shapes a chain in one slot, from which plans of all policies are made."""
    last = profile.last
    values = {
        name: getattr(profile, name) for name in Evidence.model_fields if hasattr(profile, name)
    }
    values["through"] = profile.through
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
    del values[f"longest_{unused}_ns"]  # nothing is published in that way
    length = slot_ns(profile, request)
    if request.publish_slot_ns is not None:
        values["publish_slot"] = "given"
    else:
        values["publish_slot"] = "measured" if length > plans.SHORTEST_SLOT_NS else "least"
    # By default an output that overran leaves at once. The thread of an asynchronous publisher,
    # whose outputs are due in a later cycle, would publish outputs too early.
    waits = request.publication == "asynchronous" and request.policy in OWN_SLOTS
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
        overrun=request.overrun or ("wait" if waits else "publish"),
        fifo_priority=profile.fifo_priority,
        receivers=profile.receivers if request.with_receivers else (),
        max_of_all_ns=int(profile.every.max()),
        **values,
    )
    core_of = {
        node: core for planned in (profile, *sinks) for node, core in planned.core_of.items()
    }
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
        following=_next_cycle(profile, request),
        decides_slot=request.policy not in OWN_SLOTS or request.policy == "pipelined",
    )


def _with_policy(plan: ChainPlan, profile: Profile, request: PlanRequest) -> ChainPlan:
    """Return the plan of the requested policy, made from a shaped one."""
    if request.policy == "shaped" and request.plant is not None:
        from chainshaper.planning.control_cost import with_least_cost

        return with_least_cost(
            plan,
            profile,
            plant=request.plant,
            redesign=request.redesign,
            bands=request.bands,
            grid_ns=request.grid_ns,
            max_gap_ns=request.max_gap_ns,
            max_share=request.max_share,
            mean_at_most_ns=request.mean_at_most_ns,
        )
    if request.policy == "shaped":
        return with_bands(
            plan,
            profile.measured,
            request.bands,
            most_ns=profile.latencies_ns,
            solver=request.solver,
            minimise=request.minimise,
            mean_at_most_ns=request.mean_at_most_ns,
            least_gain=request.least_gain,
            seed=request.seed,
            grid_ns=request.grid_ns,
            max_gap_ns=request.max_gap_ns,
            max_share=request.max_share,
        )
    if request.policy == "one-long-slot":
        if request.slot_start_ns is None:
            raise InputError("one long slot needs its start: add --slot-start, such as 62ms")
        return with_long_slot(plan, profile.latencies_ns, request.slot_start_ns)
    if request.policy == "server-per-chain":
        return shaping.server_per_chain(plan)
    if request.policy == "let-per-chain":
        return shaping.let_per_chain(plan)
    if not profile.callbacks or not profile.topics:
        reason = f"the policy {request.policy} needs the chain's callbacks"
        raise InputError(f"{reason}: plan from a recording")
    if request.policy == "pipelined":
        plan = _pipelined(plan, profile, request)
    elif request.policy == "server-per-callback":
        margin_ns = plan.margin.epsilon_ns
        plan = shaping.server_per_callback(plan, profile.callbacks, margin_ns=margin_ns)
    else:
        plan = shaping.let_per_callback(plan, profile.topics, profile.nodes)
        _refuse_full_cores(plan, profile)
    return plan


def _refuse_full_cores(plan: ChainPlan, profile: Profile) -> None:
    """Refuse LET per callback where callbacks of a core may take longer than a cycle, together.

    In each cycle all callbacks run, for as many instances. What is not done then delays the next
    cycle's, and so on: the outputs of a core that is full once stay late.
    """
    steps = profile.every_planned_step_ns
    if not steps.size:
        return
    nodes = profile.nodes
    if profile.graph_steps_ns.size:
        nodes = tuple(callback.node for callback in profile.callbacks)
    busy_ns = Counter[int]()
    for node, longest_ns in zip(nodes, steps.max(axis=0).tolist(), strict=True):
        busy_ns[profile.core_of.get(node, DEFAULT_CORE)] += longest_ns
    for gate in plans.shaping_nodes(plan):
        busy_ns[gate.core] += GATE_TAKES_NS + gate.spin_ns
    for core, taken_ns in busy_ns.items():
        if taken_ns + profile.others_ns > plan.cycle_ns:
            reason = f"{profile.name}: the callbacks of core {core} and their gates take up to"
            reason += f" {duration_text(taken_ns + profile.others_ns)} in a cycle, which has"
            reason += f" {duration_text(plan.cycle_ns)}, and what is not done delays the next"
            raise OperationError(f"{reason}: give the chain more cores (--cores), or shape it")


def _pipelined(plan: ChainPlan, profile: Profile, request: PlanRequest) -> ChainPlan:
    """Return the plan in stages, cut from what the callbacks of a profile took."""
    cores = request.cores
    steps = profile.planned_steps_ns
    if profile.all_disturbed:
        every = profile.every_planned_step_ns
        steps = every[_work(profile, every).finished_ns[:, -1] <= profile.longest_ns]
    reception, room_ns = profile.reception, profile.others_ns
    if reception is not None and reception.core in (None, *(cores or profile.core_of.values())):
        room_ns += reception.time_ns + reception.beside_ns
    return pipelined(
        plan,
        _work(profile, steps),
        profile.core_of,
        cores,
        room_ns=room_ns,
        gate_ns=GATE_TAKES_NS + request.spin_ns,
    )


def refuse_contradictions(request: PlanRequest, *, sinks: bool, modes: bool) -> None:
    """Refuse wishes that exclude each other.

    ``sinks``: whether further outputs are planned. ``modes``: whether each mode was measured.
    """
    if request.bands_of_modes == "found" and not (modes and request.policy == "shaped"):
        reason = "nothing says which mode was in force while latencies were measured"
        raise InputError(f"{reason}: add --mode-profile MODE=REC, or say what `announces` them")
    margins.refuse_contradictory_margin(request)
    if request.redesign and request.plant is None:
        raise InputError("--redesign is about the controller of a plant: add --plant PLANT.yaml")
    if request.plant is not None and (request.minimise != "mean" or request.solver != "exact"):
        reason = "--plant minimises the cost of its control loop, and nothing else"
        raise InputError(f"{reason}: leave out --minimise and --solver")
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
    """Refuse the wishes for the placement of bands, where bands are not placed by them."""
    for name in (
        *("bands", "solver", "max_gap_ns", "max_share", "minimise", "mean_at_most_ns"),
        *("plant", "redesign"),
    ):
        if getattr(request, name) != getattr(_STANDARD, name):
            option = name.removesuffix("_ns").replace("_", "-")
            raise InputError(f"--{option} places latency bands, {why}")


def refuse_entangled(profiles: Sequence[Profile], policy: Policy, *, sinks: bool = False) -> None:
    """Refuse chains that share an output, or of which one waits for what another's plan delays.

    With ``sinks`` all are planned as one chain: the first, and further outputs of its graph.
    """
    for first, second in combinations(profiles, 2):
        if first.topics and (first.begins, first.topics) == (second.begins, second.topics):
            raise InputError(f"the chain {second.name} is given twice: name it once")
        outputs = [profile.topics[-1] if profile.topics else None for profile in (first, second)]
        refuse_common((first.name, second.name), (outputs[0], outputs[1]))
    for shaped, waiting in permutations(profiles, 2):
        # The topics that come later under the plan than they were measured:
        delayed = shaped.topics if policy == "let-per-callback" else shaped.topics[-1:]
        on_the_way = sorted(waiting.upstream.intersection(delayed))
        if on_the_way and policy not in UNSHAPED:
            reason = f"{waiting.name} waits for {', '.join(on_the_way)}, which the plan for"
            reason += f" {shaped.name} publishes later than it was measured"
            raise InputError(f"{reason}: plan one of the two alone")
    for first, second in combinations(profiles, 2):
        if sinks and first.period_ns != second.period_ns:
            reason = f"{second.name} has the period {duration_text(second.period_ns)},"
            reason += f" {first.name} {duration_text(first.period_ns)}"
            raise InputError(f"{reason}: plan one of the two alone")
        if first.begins is None or second.begins is None or first.begins == second.begins:
            continue
        begin = f"{second.name} begins at {second.begins[1]}, {first.name} at another callback,"
        begin += f" {first.begins[1]}"
        if sinks:
            reason = f"{begin}, and slots of a sink count from the beginning of the chain"
            raise InputError(f"{reason}: name one behind the same callback, or plan one alone")
        if common := sorted(_waited_for(first, second) | _waited_for(second, first)):
            reason = f"{begin}, and both need {', '.join(common)}: neither's cycles can start"
            reason += " without the other's. Begin both where all of it comes from, or plan one of"
            raise InputError(f"{reason} the two alone")


def refuse_simulated(profiles: Sequence[Profile], request: PlanRequest) -> None:
    """Refuse to count slots from stamps of simulated time, which gates and servers do not have."""
    for profile in profiles:
        if profile.simulated and request.anchor == "stamp" and request.policy not in UNSHAPED:
            raise InputError(simulated_stamps(profile.simulated[0]))


def simulated_stamps(node: str) -> str:
    """Say why no slot counts from the stamps of a node that follows `/clock`, and what to do."""
    return (
        f"{node} follows /clock (use_sim_time): its stamps are of simulated time. Start it with"
        " use_sim_time:=false; or, where /clock is as fast as time, plan with --anchor cycle"
    )


def _waited_for(waiting: Profile, other_chain: Profile) -> frozenset[str]:
    """Return topics beside a chain that it waits for, and that another has or waits for too."""
    beside = waiting.upstream - set(waiting.topics)
    return beside & (other_chain.upstream | set(other_chain.topics))
