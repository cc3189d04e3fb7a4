"""What is asked of a plan, and what was measured of a chain: together they make the plan.

:class:`Profile` holds the measurements, :class:`PlanRequest` the wishes, and :func:`plan_chain`
turns one of each into a plan of any policy. A profile may come from a recording or consist of
bare latencies and a period; a policy that needs more says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain as joined
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chainshaper.gate.decision import Anchor, Messages, Overrun
from chainshaper.planning.baselines import (
    CallbackTimes,
    let_per_callback,
    let_per_callback_asynchronous,
    let_per_chain,
    server_per_callback,
    server_per_chain,
)
from chainshaper.planning.entangled import refuse_entangled
from chainshaper.planning.graphs import over_cores, with_first_node_apart, with_sink
from chainshaper.planning.latency_file import check_latencies
from chainshaper.planning.margins import (
    EPSILON_NS,
    MOST_PROBABLE,
    OVERRUN_PROBABILITY,
    covered_latency,
    cycles_needed,
    derive_margin,
    late_share,
)
from chainshaper.planning.placement import (
    BandChoice,
    choose_bands,
    with_bands,
    with_long_slot,
)
from chainshaper.planning.plan import (
    PER_CALLBACK,
    Evidence,
    Margin,
    Modes,
    Plan,
    revised,
)
from chainshaper.planning.shaping import evidence_of, plan_shaping
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Fallback, Goal, Policy, Publication, Solver

__all__ = ["PlanRequest", "Profile", "band_choice", "plan_chain", "plan_chains"]

DEFAULT_CORE = 1
OWN_SLOTS = (*PER_CALLBACK, "let-per-chain")
"""Policies whose plan has no slot behind the chain's, in the same cycle."""


@dataclass(frozen=True)
class Profile:
    """What was measured of one chain, under a high SCHED_FIFO priority. Times in nanoseconds.

    ``latencies_ns`` are those of undisturbed cycles, ``every_latency_ns`` those of all (None: all
    were undisturbed), both in the order of time. ``nodes`` are those of the chain's callbacks, one
    per callback, ``topics`` what each of these publishes for the chain. ``core_of`` names the
    core of every node whose executor takes part, also on branches that the chain waits for.
    ``begins`` is the first callback's number in the graph, and its name, ``upstream`` the topics
    that the output waits for: on the chain, on those branches, and before the chain begins.
    ``receivers`` are the nodes that subscribe to the chain's output and are none of these.
    ``callbacks`` are those of the chain and its branches, see
    :func:`~chainshaper.planning.baselines.server_per_callback`. ``output_depth`` is the history
    of the output's writer, ``longest_send_ns`` how long its asynchronous publisher took to send.
    The rest is evidence.
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
    recording: str | None = None
    incomplete: int = 0
    disturbed: int = 0
    realtime: bool | None = None
    longest_stall_ns: int | None = None
    utilisation: float | None = None
    longest_send_ns: int | None = None
    lost_events: int | None = None
    output_depth: int | None = None


@dataclass(frozen=True)
class PlanRequest:
    """The wishes for a plan; every field has the default that the command line has.

    The margin is ``epsilon_ns`` behind the longest undisturbed latency where that is given.
    Otherwise it covers all cycles, also disturbed ones, but a share of ``overrun_probability``
    (None: 1 %, or as few as the sample shows); with ``ideal_machine`` undisturbed cycles only.
    ``overrun`` says what becomes of an output that missed its slot (None: it leaves at once, where
    the policy and the publisher allow it). ``bands`` to
    ``seed`` are those of :func:`~chainshaper.planning.placement.with_bands` and go with the
    policy ``shaped``, ``slot_start_ns`` goes with ``one-long-slot``. ``first_slot_ns`` puts the
    chain's first node into a server of its own that ends there. ``modes`` give each mode of the
    system one of the bands. ``depth`` is the shaping nodes'. Without ``with_receivers`` those of
    the output are left alone.
    """

    policy: Policy = "shaped"
    publication: Publication = "synchronous"
    epsilon_ns: int | None = None
    overrun_probability: float | None = None
    ideal_machine: bool = False
    publish_slot_ns: int = 1_000_000
    bands: int | Literal["auto"] = 1
    solver: Solver = "exact"
    grid_ns: int = 1_000
    max_gap_ns: int | None = None
    max_share: float | None = None
    minimise: Goal = "mean"
    mean_at_most_ns: int | None = None
    least_gain: float = 0.02
    seed: int = 0
    slot_start_ns: int | None = None
    first_slot_ns: int | None = None
    modes: Modes | None = None
    anchor: Anchor = "stamp"
    overrun: Overrun | None = None
    messages: Messages = "all-in-order"
    depth: int | None = None
    fallback: Fallback = "bypass"
    spin_ns: int = 1_000_000
    pause_ns: int | None = None
    with_receivers: bool = True


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
    refuse_entangled((profile, *sinks), request.policy, sinks=True)
    margin = _margin(profile, request)
    if request.policy == "let-per-chain":
        _refuse_longer_than_period(profile)
    if request.policy in OWN_SLOTS:
        plan = _with_policy(
            _shaped(_shortened(profile, request, margin), request, margin, sinks), profile, request
        )
        plan = revised(plan, evidence=_measured(plan.evidence, profile.latencies_ns))
    else:
        plan = _with_policy(_shaped(profile, request, margin, sinks), profile, request)
    for sink in sinks:
        publisher = sink.nodes[-1] if sink.nodes else None
        plan = with_sink(
            plan,
            sink.latencies_ns,
            _output(sink),
            publisher=publisher,
            receivers=sink.receivers if request.with_receivers else (),
        )
    if request.fallback != _STANDARD.fallback and plan.shaping_node is None:
        raise InputError(
            f"--fallback {request.fallback} is for an output with a shaping node, and the plan has"
            " none: leave it out, or plan with synchronous publication"
        )
    return revised(plan, modes=request.modes, fallback=request.fallback)


def plan_chains(profiles: Sequence[Profile], request: PlanRequest = _STANDARD) -> tuple[Plan, ...]:
    """A plan for each of several chains that have nothing in common but cores.

    Raises: as :func:`plan_chain`; InputError also where one chain's plan would move another's
        outputs.
    """
    refuse_entangled(profiles, request.policy)
    return tuple(plan_chain(profile, request) for profile in profiles)


def band_choice(plan: Plan, profile: Profile, request: PlanRequest) -> BandChoice:
    """The curve of figure 7 for a plan, and the number of bands that ``auto`` takes from it."""
    values = _placement(request, "least_gain")
    return choose_bands(plan, profile.latencies_ns, **values)


def _shortened(profile: Profile, request: PlanRequest, margin: Margin) -> Profile:
    """The profile with no latency beyond what shaping could hold in a cycle.

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


def _measured(evidence: Evidence, latencies_ns: NDArray[np.int64]) -> Evidence:
    figures = evidence_of(latencies_ns)
    names = ("min_latency_ns", "mean_latency_ns", "max_latency_ns")
    return evidence.model_copy(update={name: getattr(figures, name) for name in names})


def _shaped(
    profile: Profile, request: PlanRequest, margin: Margin, sinks: Sequence[Profile]
) -> Plan:
    last = profile.nodes[-1] if profile.nodes else None
    asynchronous = request.publication == "asynchronous"
    conditions = {n: getattr(profile, n) for n in Evidence.model_fields if hasattr(profile, n)}
    conditions["max_of_all_ns"] = int(_every_latency(profile).max())
    if not asynchronous:  # how long sends take is no evidence for it
        del conditions["longest_send_ns"]
    plan = plan_shaping(
        profile.latencies_ns,
        profile.period_ns,
        spec=profile.spec,
        output=profile.topics[-1] if profile.topics else None,
        publisher=last,
        nodes=tuple(dict.fromkeys(profile.nodes)),
        margin=margin,
        publish_slot_ns=request.publish_slot_ns,
        publication=request.publication,
        output_depth=profile.output_depth if asynchronous else None,
        core=profile.core_of.get(last or "", DEFAULT_CORE),
        anchor=request.anchor,
        overrun=_overrun(request),
        messages=request.messages,
        depth=request.depth,
        fifo_priority=profile.fifo_priority,
        spin_ns=request.spin_ns,
        pause_ns=request.pause_ns,
        receivers=profile.receivers if request.with_receivers else (),
        **conditions,
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
    if request.overrun is not None:
        return request.overrun
    bound = request.publication == "asynchronous" and request.policy in OWN_SLOTS
    return "wait" if bound else "publish"


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


def _placement(request: PlanRequest, *names: str) -> dict[str, Any]:
    """What a request says about placing bands: the limits, and what else is named."""
    return {n: getattr(request, n) for n in ("grid_ns", "max_gap_ns", "max_share", *names)}


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


def _output(profile: Profile) -> str:
    if not profile.topics:
        raise InputError("a sink needs the topic it is published on: plan from a recording")
    return profile.topics[-1]
