"""From what was measured of a chain, and what is wished, to its plan of any policy.

A :class:`Profile` may come from a recording or consist of bare latencies and a period; a policy
that needs more says so.

Further outputs of a chain's graph can be planned with it (``sinks``); several chains, of equal
standing, are planned by :mod:`chainshaper.planning.several_chains`. A plan is made from latencies
that were measured while nothing was shaped: shaping a topic that another chain's output waits for
makes that one later than was measured, and its slot too early. Such chains are refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.bands import BandChoice, choose_bands, with_bands, with_long_slot
from chainshaper.planning.cores import Work, assign_cores
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
from chainshaper.planning.offsets import refuse_common
from chainshaper.planning.plan import PER_CALLBACK, Evidence, Margin, Modes, Plan, revised
from chainshaper.planning.shaping import (
    CallbackTimes,
    evidence_of,
    let_per_callback,
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
_LIMITS = ("grid_ns", "max_gap_ns", "max_share")


@dataclass(frozen=True)
class Profile:
    """What was measured of one chain, under a high SCHED_FIFO priority. Times in nanoseconds.

    ``latencies_ns`` are those of undisturbed cycles (where ``all_disturbed``, of all),
    ``every_latency_ns`` those of all (None: all were undisturbed), both in the order of time.
    ``nodes`` are those of the chain's callbacks, one per callback, ``topics`` what each of these
    publishes for the chain. ``core_of`` names the core of every node whose executor takes part,
    also on branches that the chain waits for. ``begins`` is the first callback's number in the
    graph, and its name, ``upstream`` the topics that the output waits for: on the chain, on those
    branches, and before the chain begins. ``receivers`` are the nodes that subscribe to the chain's
    output and are none of these. ``callbacks`` are those of the chain and its branches, see
    :func:`~chainshaper.planning.shaping.server_per_callback`. ``together`` are nodes that share a
    process. ``output_depth`` is the history of the output's writer. The rest is
    :class:`~chainshaper.planning.plan.Evidence`.
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
    together: tuple[tuple[str, ...], ...] = ()
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
    all_disturbed: bool | None = None

    @property
    def name(self) -> str:
        """What the chain is called in messages."""
        return self.spec or "..".join(self.topics)

    @property
    def every(self) -> NDArray[np.int64]:
        """The latencies of all cycles."""
        every = self.every_latency_ns
        return check_latencies(self.latencies_ns if every is None else every)

    @property
    def longest_ns(self) -> int:
        """The longest of the latencies that are planned from."""
        return int(check_latencies(self.latencies_ns).max())


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

    Raises InputError: wishes that exclude each other, or a policy that needs more than the profile
    has. OperationError: no such plan exists; the message names what prevents it. PlatformError: a
    library that only this request needs is not installed.
    """
    _refuse_contradictions(request, bool(sinks))
    (profile, *sinks), _ = on_cores((profile, *sinks), request)
    refuse_entangled((profile, *sinks), request.policy, sinks=True)
    if any(sink.all_disturbed for sink in sinks) or profile.all_disturbed:
        profile, sinks = _covered(profile, request), [_covered(sink, request) for sink in sinks]
    margin = _margin(profile, request)
    longest, period = profile.longest_ns, profile.period_ns
    if request.policy == "let-per-chain" and longest >= period:
        raise OperationError(
            f"the longest latency {format_duration(longest)} is not shorter than the period"
            f" {format_duration(period)}, in which LET per chain has to be done: plan LET per"
            " callback, or a longer period"
        )
    measured = profile
    if request.policy in OWN_SLOTS:  # shaping, only the start of the plan, must fit into a cycle
        most = max(1, period - margin.epsilon_ns - request.publish_slot_ns)
        latencies = np.minimum(check_latencies(profile.latencies_ns), most)
        measured = replace(profile, latencies_ns=latencies)
    plan = _with_policy(_shaped(measured, request, margin, sinks), profile, request)
    if request.policy in OWN_SLOTS:
        figures = evidence_of(profile.latencies_ns).model_dump(exclude_unset=True)
        plan = revised(plan, evidence=plan.evidence.model_copy(update=figures))
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


def cores_for(
    profiles: Sequence[Profile],
    cores: Sequence[int],
    request: PlanRequest = _STANDARD,
    worth: float = 0.0,
) -> dict[str, int]:
    """The core of each node of these chains, see :func:`~chainshaper.planning.cores.assign_cores`.

    Raises InputError: a profile has no callbacks, being bare latencies.
    """
    if bare := [profile.name for profile in profiles if not profile.callbacks]:
        raise InputError(
            f"--cores distributes callbacks, and latencies do not tell those of {bare[0]}: plan"
            " from a recording"
        )
    margin = EPSILON_NS if request.epsilon_ns is None else request.epsilon_ns
    work = [Work((p.begins, p.period_ns), p.period_ns, p.callbacks, margin) for p in profiles]
    together = [group for profile in profiles for group in profile.together]
    return assign_cores(work, cores, together=together, worth=worth)


def on_cores(
    profiles: Sequence[Profile], request: PlanRequest
) -> tuple[tuple[Profile, ...], list[str]]:
    """The profiles with their executors on the wished cores, and whose latency is another there.

    Raises: as :func:`cores_for`.
    """
    if request.cores is None:
        return tuple(profiles), []
    core_of, moved, doubts = cores_for(profiles, request.cores, request), [], []
    for one in profiles:
        own = {node: core_of[node] for node in one.core_of}
        homes = {(own[node], core) for node, core in one.core_of.items()}
        if not len(homes) == len(set(own.values())) == len(set(one.core_of.values())):
            doubts.append(
                f"{one.name} was measured with its executors distributed over cores in another way"
                " than planned, which is another latency: measure it so (`chainshaper profile"
                f" --cores {','.join(map(str, request.cores))}`)"
            )
        callbacks = tuple(replace(each, core=core_of[each.node]) for each in one.callbacks)
        moved.append(replace(one, core_of=own, callbacks=callbacks))
    return tuple(moved), doubts


def band_choice(plan: Plan, profile: Profile, request: PlanRequest) -> BandChoice:
    """The curve of figure 7 for a plan, and the number of bands that ``auto`` takes from it."""
    latencies = _covered(profile, request).latencies_ns
    return choose_bands(plan, latencies, **_of(request, *_LIMITS, "least_gain"))


def _of(request: PlanRequest, *names: str) -> dict[str, Any]:
    return {name: getattr(request, name) for name in names}


def _covered(profile: Profile, request: PlanRequest) -> Profile:
    """Where no cycle was undisturbed, the profile of those that a margin would cover."""
    if not profile.all_disturbed:
        return profile
    if request.ideal_machine:
        raise OperationError(
            f"{profile.recording or profile.name}: the machine disturbed every cycle of"
            f" {profile.name}, but one at most, too few to plan an ideal machine from: leave out"
            " --ideal-machine, or record again on a calmer one"
        )
    share = request.overrun_probability or OVERRUN_PROBABILITY
    latest = None if request.policy in OWN_SLOTS else _latest(profile, request)
    every = profile.every
    covered = every[every <= covered_latency(every, share, latest)]
    latencies = covered if covered.size > 1 else every  # none fits, which the planner refuses
    return replace(profile, latencies_ns=latencies, every_latency_ns=every)


def _latest(profile: Profile, request: PlanRequest) -> int:
    """The longest latency behind which a publish slot fits into the cycle."""
    return profile.period_ns - request.publish_slot_ns - EPSILON_NS


def _shaped(
    profile: Profile, request: PlanRequest, margin: Margin, sinks: Sequence[Profile]
) -> Plan:
    last = profile.nodes[-1] if profile.nodes else None
    values = {n: getattr(profile, n) for n in Evidence.model_fields if hasattr(profile, n)}
    if request.publication == "asynchronous":
        values["output_depth"] = profile.output_depth
    else:  # how long sends take is no evidence for it
        del values["longest_send_ns"]
    # At once by default, unless the thread of an asynchronous publisher has outputs due later.
    bound = request.publication == "asynchronous" and request.policy in OWN_SLOTS
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
        plan = with_first_node_apart(plan, profile.nodes[0], request.first_slot_ns)
        core_of.pop(profile.nodes[0], None)
    return over_cores(plan, core_of) if core_of else plan


def _margin(profile: Profile, request: PlanRequest) -> Margin:
    every, longest, probability = profile.every, profile.longest_ns, request.overrun_probability
    if request.epsilon_ns is not None:
        if request.epsilon_ns < 0:
            raise InputError("epsilon must be 0ms or more")
        late = late_share(every, longest + request.epsilon_ns)
        return Margin(epsilon_ns=request.epsilon_ns, overrun_probability=late)
    covered = profile.latencies_ns if request.ideal_machine else every
    if probability is not None and not 0 < probability < 1:
        raise InputError(f"an overrun probability of {probability}: write one between 0 and 1")
    if probability is not None and probability < MOST_PROBABLE:
        return derive_margin(covered, probability, request.seed, longest_ns=longest)
    if probability is not None and covered.size < cycles_needed(probability):
        raise OperationError(
            f"{covered.size} cycles are too few for an overrun probability of {probability:g}:"
            f" measure {cycles_needed(probability)} or more"
        )
    stalls = 0
    if request.policy not in OWN_SLOTS:  # what a stall adds belongs to no single callback
        share = probability or OVERRUN_PROBABILITY
        stalls = max(0, covered_latency(covered, share, _latest(profile, request)) - longest)
    epsilon = EPSILON_NS + stalls
    return Margin(
        epsilon_ns=epsilon,
        source="measured",
        overrun_probability=late_share(every, longest + epsilon),
        stalls_ns=stalls,
    )


def _with_policy(plan: Plan, profile: Profile, request: PlanRequest) -> Plan:
    if request.policy == "shaped":
        names = ("solver", "minimise", "mean_at_most_ns", "least_gain", "seed")
        values = _of(request, *_LIMITS, *names)
        return with_bands(plan, profile.latencies_ns, request.bands, **values)
    if request.policy == "one-long-slot":
        if request.slot_start_ns is None:
            raise InputError("one long slot needs its start: add --slot-start, such as 62ms")
        return with_long_slot(plan, profile.latencies_ns, request.slot_start_ns)
    if request.policy in ("server-per-chain", "let-per-chain"):
        return (server_per_chain if request.policy in UNSHAPED else let_per_chain)(plan)
    if not profile.callbacks or not profile.topics:
        raise InputError(
            f"the policy {request.policy} needs the chain's callbacks, which latencies do not tell:"
            " plan from a recording"
        )
    if request.policy == "server-per-callback":
        return server_per_callback(plan, profile.callbacks, margin_ns=plan.margin.epsilon_ns)
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
            raise InputError(
                f"{waiting.name} waits for {', '.join(on_the_way)}, which the plan for"
                f" {shaped.name} publishes later than it was measured: {waiting.name} would miss"
                f" its own slot. Plan {waiting.name} alone, whose output is constant then, or"
                f" {shaped.name} alone"
            )
    for one, two in combinations(profiles, 2):
        if sinks and one.begins is not None and two.begins is not None and one.begins != two.begins:
            raise InputError(
                f"{two.name} begins at {two.begins[1]}, {one.name} at another callback,"
                f" {one.begins[1]}: the slots of a sink count from the beginning of the chain. Name"
                " a sink behind the same first callback, or plan one of the two alone"
            )
        if sinks and one.period_ns != two.period_ns:
            raise InputError(
                f"{two.name} has the period {format_duration(two.period_ns)}, {one.name}"
                f" {format_duration(one.period_ns)}: a plan has one cycle. Plan one of the two"
                " alone"
            )
