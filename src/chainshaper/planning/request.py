"""From what was measured of a chain, and what is wished, to its plan of any policy.

:class:`Profile` has the measurements, :class:`PlanRequest` the wishes, and :func:`plan_chain` turns
one of each into a plan. A profile may come from a recording or consist of bare latencies and a
period; a policy that needs more says so.

Several chains cannot be planned together where one's plan would move another's outputs. A plan is
made from latencies that were measured while nothing was shaped: shaping a topic that another
chain's output waits for makes that one later than was measured, and its slot too early. Nor can two
plans have one thread. Chains that share no more than cores, and sinks that fork off behind the
first callback, are planned right; the others are refused with what they have in common.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain as joined
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.gate.decision import Overrun
from chainshaper.planning.bands import BandChoice, choose_bands, with_bands, with_long_slot
from chainshaper.planning.margins import (
    EPSILON_NS,
    MOST_PROBABLE,
    OVERRUN_PROBABILITY,
    check_latencies,
    covered_latency,
    cycles_needed,
    derive_margin,
    late_share,
)
from chainshaper.planning.offsets import same_nodes, same_output
from chainshaper.planning.plan import PER_CALLBACK, Evidence, Margin, Modes, Plan, revised
from chainshaper.planning.shaping import (
    CallbackTimes,
    evidence_of,
    let_per_callback,
    let_per_callback_asynchronous,
    let_per_chain,
    over_cores,
    plan_shaping,
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
    with_sink,
)
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Policy, Wishes

DEFAULT_CORE = 1
OWN_SLOTS = (*PER_CALLBACK, "let-per-chain")
"""Policies whose plan has no slot behind the chain's, in the same cycle."""
UNSHAPED = ("server-per-chain", "server-per-callback")


@dataclass(frozen=True)
class Profile:
    """What was measured of one chain, under a high SCHED_FIFO priority. Times in nanoseconds.

    ``latencies_ns`` are those of undisturbed cycles, ``every_latency_ns`` those of all (None: all
    were undisturbed), both in the order of time. ``nodes`` are those of the chain's callbacks, one
    per callback, ``topics`` what each of these publishes for the chain. ``core_of`` names the core
    of every node whose executor takes part, also on branches that the chain waits for. ``begins``
    is the first callback's number in the graph, and its name, ``upstream`` the topics that the
    output waits for: on the chain, on those branches, and before the chain begins. ``receivers``
    are the nodes that subscribe to the chain's output and are none of these. ``callbacks`` are
    those of the chain and its branches, see
    :func:`~chainshaper.planning.shaping.server_per_callback`. ``output_depth`` is the history of
    the output's writer. The rest is :class:`~chainshaper.planning.plan.Evidence`.
    """

    latencies_ns: NDArray[np.int64]
    period_ns: int
    every_latency_ns: NDArray[np.int64] | None = None
    spec: str | None = None
    nodes: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    begins: tuple[int, str] | None = None
    upstream: frozenset[str] = frozenset()
    core_of: Mapping[str, int] = field(default_factory=dict)
    receivers: tuple[str, ...] = ()
    callbacks: tuple[CallbackTimes, ...] = ()
    fifo_priority: int = 84
    output_depth: int | None = None
    recording: str | None = None
    incomplete: int = 0
    disturbed: int = 0
    realtime: bool | None = None
    longest_stall_ns: int | None = None
    utilisation: float | None = None
    longest_send_ns: int | None = None
    lost_events: int | None = None


@dataclass(frozen=True)
class PlanRequest(Wishes):
    """The wishes for a plan; every field has the default that the command line has.

    ``modes`` give each mode of the system one of the bands.
    """

    modes: Modes | None = None


_STANDARD = PlanRequest()


def plan_chain(
    profile: Profile, request: PlanRequest = _STANDARD, sinks: Sequence[Profile] = ()
) -> Plan:
    """The plan of the requested policy for a measured chain.

    ``sinks`` are profiles of further outputs of the same graph, each of which is shaped too.

    Raises:
        InputError: wishes that exclude each other, or a policy that needs more than the profile
            has.
        OperationError: no such plan exists; the message names what prevents it.
        PlatformError: a library that only this request needs is not installed.
    """
    _refuse_contradictions(request, bool(sinks))
    _refuse_entangled((profile, *sinks), request.policy, sinks=True)
    margin = _margin(profile, request)
    if request.policy == "let-per-chain":
        _refuse_longer_than_period(profile)
    own_slots = request.policy in OWN_SLOTS
    measured = _shortened(profile, request, margin) if own_slots else profile
    plan = _with_policy(_shaped(measured, request, margin, sinks), profile, request)
    if own_slots:
        figures = evidence_of(profile.latencies_ns)
        names = ("min_latency_ns", "mean_latency_ns", "max_latency_ns")
        update = {name: getattr(figures, name) for name in names}
        plan = revised(plan, evidence=plan.evidence.model_copy(update=update))
    for sink in sinks:
        if not sink.topics:
            raise InputError("a sink needs the topic it is published on: plan from a recording")
        plan = with_sink(
            plan,
            sink.latencies_ns,
            sink.topics[-1],
            publisher=sink.nodes[-1] if sink.nodes else None,
            receivers=sink.receivers if request.with_receivers else (),
        )
    if request.fallback != _STANDARD.fallback and plan.shaping_node is None:
        raise InputError(
            f"--fallback {request.fallback} is for an output with a shaping node, and the plan has"
            " none: leave it out, or plan with synchronous publication"
        )
    return revised(plan, modes=request.modes)


def plan_chains(profiles: Sequence[Profile], request: PlanRequest = _STANDARD) -> tuple[Plan, ...]:
    """A plan for each of several chains that have nothing in common but cores.

    Raises: as :func:`plan_chain`; InputError also where one chain's plan would move another's
        outputs.
    """
    _refuse_entangled(profiles, request.policy)
    return tuple(plan_chain(profile, request) for profile in profiles)


def band_choice(plan: Plan, profile: Profile, request: PlanRequest) -> BandChoice:
    """The curve of figure 7 for a plan, and the number of bands that ``auto`` takes from it."""
    return choose_bands(plan, profile.latencies_ns, **_placement(request, "least_gain"))


def _shortened(profile: Profile, request: PlanRequest, margin: Margin) -> Profile:
    """The profile with no latency beyond what shaping could fit into a cycle.

    Where the policy has slots of its own, shaping is only the start of the plan.
    """
    longest = profile.period_ns - margin.epsilon_ns - request.publish_slot_ns
    latencies = check_latencies(profile.latencies_ns)
    return replace(profile, latencies_ns=np.minimum(latencies, max(1, longest)))


def _refuse_longer_than_period(profile: Profile) -> None:
    longest, period = int(check_latencies(profile.latencies_ns).max()), profile.period_ns
    if longest >= period:
        raise OperationError(
            f"the longest latency {format_duration(longest)} is not shorter than the period"
            f" {format_duration(period)}, in which LET per chain has to be done: plan LET per"
            " callback, or a longer period"
        )


def _shaped(
    profile: Profile, request: PlanRequest, margin: Margin, sinks: Sequence[Profile]
) -> Plan:
    last = profile.nodes[-1] if profile.nodes else None
    values = {n: getattr(profile, n) for n in Evidence.model_fields if hasattr(profile, n)}
    if request.publication == "asynchronous":
        values["output_depth"] = profile.output_depth
    else:  # how long sends take is no evidence for it
        del values["longest_send_ns"]
    plan = plan_shaping(
        profile.latencies_ns,
        profile.period_ns,
        wishes=request,
        margin=margin,
        spec=profile.spec,
        output=profile.topics[-1] if profile.topics else None,
        publisher=last,
        nodes=tuple(dict.fromkeys(profile.nodes)),
        core=profile.core_of.get(last or "", DEFAULT_CORE),
        overrun=_overrun(request),
        fifo_priority=profile.fifo_priority,
        receivers=profile.receivers if request.with_receivers else (),
        max_of_all_ns=int(_every_latency(profile).max()),
        **values,
    )
    core_of = dict(joined.from_iterable(one.core_of.items() for one in (profile, *sinks)))
    if request.first_slot_ns is not None:
        if not profile.nodes:
            raise InputError("a slot for the first node needs the chain's nodes: give a recording")
        plan = with_first_node_apart(plan, profile.nodes[0], request.first_slot_ns)
        core_of.pop(profile.nodes[0], None)
    return over_cores(plan, core_of) if core_of else plan


def _overrun(request: PlanRequest) -> Overrun:
    """At once, unless slots only are asked for: age and gaps of what a receiver has are smallest.

    The thread of an asynchronous publisher cannot do that where outputs are due a cycle later.
    """
    bound = request.publication == "asynchronous" and request.policy in OWN_SLOTS
    return request.overrun or ("wait" if bound else "publish")


def _margin(profile: Profile, request: PlanRequest) -> Margin:
    every, longest = _every_latency(profile), int(check_latencies(profile.latencies_ns).max())
    if request.epsilon_ns is not None:
        if request.epsilon_ns < 0:
            raise InputError("epsilon must be 0ms or more")
        return Margin(
            epsilon_ns=request.epsilon_ns,
            overrun_probability=late_share(every, longest + request.epsilon_ns),
        )
    covered = profile.latencies_ns if request.ideal_machine else every
    probability = request.overrun_probability
    if probability is not None and not 0 < probability < 1:
        raise InputError(f"an overrun probability of {probability}: write one between 0 and 1")
    if probability is not None and probability < MOST_PROBABLE:
        return derive_margin(covered, probability, request.seed, longest_ns=longest)
    if probability is not None and covered.size < cycles_needed(probability):
        raise OperationError(
            f"{covered.size} cycles are too few for an overrun probability of {probability:g}:"
            f" measure {cycles_needed(probability)} or more"
        )
    stalls, latest = 0, profile.period_ns - request.publish_slot_ns - EPSILON_NS
    if request.policy not in OWN_SLOTS:  # what a stall adds belongs to no single callback
        share = probability or OVERRUN_PROBABILITY
        stalls = max(0, covered_latency(covered, share, latest) - longest)
    epsilon = EPSILON_NS + stalls
    return Margin(
        epsilon_ns=epsilon,
        source="measured",
        overrun_probability=late_share(every, longest + epsilon),
        stalls_ns=stalls,
    )


def _every_latency(profile: Profile) -> NDArray[np.int64]:
    every = profile.every_latency_ns
    return profile.latencies_ns if every is None else check_latencies(every)


def _placement(request: PlanRequest, *names: str) -> dict[str, Any]:
    """What a request says about placing bands: the limits, and what else is named."""
    return {n: getattr(request, n) for n in ("grid_ns", "max_gap_ns", "max_share", *names)}


def _with_policy(plan: Plan, profile: Profile, request: PlanRequest) -> Plan:
    if request.policy == "shaped":
        values = _placement(request, "solver", "minimise", "mean_at_most_ns", "least_gain", "seed")
        return with_bands(plan, profile.latencies_ns, request.bands, **values)
    if request.policy == "one-long-slot":
        if request.slot_start_ns is None:
            raise InputError("one long slot needs its start: add --slot-start, such as 62ms")
        return with_long_slot(plan, profile.latencies_ns, request.slot_start_ns)
    if request.policy == "server-per-chain":
        return server_per_chain(plan)
    if request.policy == "let-per-chain":
        return let_per_chain(plan)
    return _per_callback(plan, profile, request)


def _per_callback(plan: Plan, profile: Profile, request: PlanRequest) -> Plan:
    if not profile.callbacks or not profile.topics:
        raise InputError(
            f"the policy {request.policy} needs the chain's callbacks, which latencies do not tell:"
            " plan from a recording"
        )
    if request.policy == "server-per-callback":
        return server_per_callback(plan, profile.callbacks, margin_ns=plan.margin.epsilon_ns)
    if request.publication == "asynchronous":
        return let_per_callback_asynchronous(plan, profile.nodes)
    return let_per_callback(plan, profile.topics, profile.nodes)


def _refuse_contradictions(request: PlanRequest, sinks: bool) -> None:
    if request.epsilon_ns is not None and request.overrun_probability is not None:
        raise InputError(
            "the margin is either given or covers a share of the cycles: leave out --epsilon or the"
            " overrun probability"
        )
    if request.policy != "one-long-slot" and request.slot_start_ns is not None:
        raise InputError("a slot's start goes with the policy one-long-slot: add it")
    if request.policy == "shaped":
        return
    for name in ("bands", "solver", "max_gap_ns", "max_share", "minimise", "mean_at_most_ns"):
        if getattr(request, name) != getattr(_STANDARD, name):
            option = name.removesuffix("_ns").replace("_", "-")
            raise InputError(
                f"--{option} places latency bands, which the policy {request.policy} has not:"
                " leave it out, or plan with the policy shaped"
            )
    if sinks:
        raise InputError(f"further sinks are shaped, not planned as {request.policy}")


def _refuse_entangled(profiles: Sequence[Profile], policy: Policy, *, sinks: bool = False) -> None:
    """With ``sinks`` all are planned as one: the first chain, and further outputs of its graph."""
    for one, two in combinations(profiles, 2):
        if one.topics and one.topics[-1:] == two.topics[-1:]:
            raise InputError(same_output(_name(one), _name(two), one.topics[-1]))
    for shaped, waiting in permutations(profiles, 2):
        # The topics that come later under the plan than they were measured:
        delayed = shaped.topics if policy == "let-per-callback" else shaped.topics[-1:]
        if on_the_way := sorted(waiting.upstream.intersection(delayed)):
            if policy in UNSHAPED:
                continue
            raise InputError(
                f"{_name(waiting)} waits for {', '.join(on_the_way)}, which the plan for"
                f" {_name(shaped)} publishes later than it was measured: {_name(waiting)} would"
                f" miss its own slot. Plan {_name(waiting)} alone, whose output is constant then,"
                f" or {_name(shaped)} alone"
            )
    for one, two in combinations(profiles, 2):
        if sinks:
            _refuse_another_beginning(one, two)
        elif shared := set(one.core_of) & set(two.core_of):
            raise InputError(same_nodes(_name(one), _name(two), shared))


def _refuse_another_beginning(one: Profile, two: Profile) -> None:
    if one.begins is not None and two.begins is not None and one.begins != two.begins:
        raise InputError(
            f"{_name(two)} begins at {two.begins[1]}, {_name(one)} at another callback,"
            f" {one.begins[1]}: the slots of a sink count from the beginning of the chain. Name a"
            " sink behind the same first callback, or plan one of the two alone"
        )
    if one.period_ns != two.period_ns:
        raise InputError(
            f"{_name(two)} has the period {format_duration(two.period_ns)}, {_name(one)}"
            f" {format_duration(one.period_ns)}: a plan has one cycle. Plan one of the two alone"
        )


def _name(profile: Profile) -> str:
    return profile.spec or "..".join(profile.topics)
