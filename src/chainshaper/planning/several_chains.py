"""From the profiles of several chains to one plan of their application.

Each chain is planned as if it were alone (:func:`~chainshaper.planning.request.plan_chain`). Then
the plans are joined. Chains that begin at the same callback are branches of one graph: they share
the servers that run it, which stay open for the slowest chain, and each output has slots of its
own. Chains of different beginnings take turns on the threads of nodes that they share, and on
cores, or run there at priorities of their own
(:func:`~chainshaper.planning.offsets.place_chains`).
"""

from bisect import bisect
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from chainshaper.planning import loops
from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Server,
    predicted_later,
    publishing_servers,
    revised,
    running_servers,
    with_slots,
)
from chainshaper.planning.offsets import TIME_LIMIT_SECONDS, chain_name, place_chains
from chainshaper.planning.plan import Plan
from chainshaper.planning.profile import Profile, with_interference
from chainshaper.planning.receivers import (
    has_places,
    with_receivers_placed,
    without_reception,
)
from chainshaper.planning.request import (
    PlanRequest,
    best_effort_cores,
    keeps_places,
    moved_to,
    on_cores,
    plan_chain,
    refuse_entangled,
    refuse_simulated,
    slot_ns,
)
from chainshaper.planning.shaping import behind_others, with_best_effort
from chainshaper.values.durations import duration_text, format_duration
from chainshaper.values.errors import InputError, OperationError

_STANDARD = PlanRequest()
_SHARING = ("shaped", "one-long-slot")
_MARGIN_STEP_NS = 100_000  # smaller margins that are tried are multiples of it


def plan_application(
    profiles: Sequence[Profile],
    request: PlanRequest = _STANDARD,
    *,
    time_limit_s: float = TIME_LIMIT_SECONDS,
) -> tuple[Plan, list[str]]:
    """Plan several chains of an application; return the plan, and remarks about it.

    The outputs of each chain move by what the others can delay it.

    Raises: as :func:`.plan_chain` and :func:`.place_chains`; OperationError names what would fit.
    """
    if not profiles:
        raise InputError("no chain is named: give one at least")
    refuse_entangled(profiles, request.policy)
    refuse_simulated(profiles, request)
    if not keeps_places(request):
        profiles = [without_reception(profile) for profile in profiles]
    try:
        return _on_wished_cores(profiles, request, time_limit_s)
    except OperationError as error:
        if any(profile.reception for profile in profiles):
            # There may be room for the chains without their receivers.
            alone = [without_reception(profile) for profile in profiles]
            return plan_application(alone, request, time_limit_s=time_limit_s)
        fits = list(_fitting(profiles, request, time_limit_s)) if len(profiles) > 1 else []
        if not fits:
            raise
        reason = str(error).rstrip(".")
        raise OperationError(f"{reason}. It fits with {', or with '.join(fits)}") from error


def with_own_names(
    plans: Sequence[ChainPlan], together: Sequence[Sequence[int]] = ()
) -> list[ChainPlan]:
    """Return the plans of chains with servers of different names.

    Alone, each plan has a server ``chain``, and one ``output``. Equal servers keep one name in
    chains of one group (places in ``together``), or whose cycles start at the same instants.
    """
    group_of = {place: number for number, group in enumerate(together) for place in group}
    known: dict[str, tuple[object, Server]] = {}
    renamed = []
    for place, chain_plan in enumerate(plans):
        group = group_of.get(place, (chain_plan.cycle_ns, chain_plan.offset_ns))
        servers = []
        for server in chain_plan.servers:
            identity = (group, server)
            same = (name for name, taken in known.items() if taken == identity)
            name = next(same, server.name)
            while name in known and (known[name] != identity or not server.threads):
                name += f"_{place + 1}"
            servers.append(server.model_copy(update={"name": name}))
            known[name] = identity
        renamed.append(revised(chain_plan, servers=tuple(servers)))
    return renamed


def _on_wished_cores(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> tuple[Plan, list[str]]:
    """Return the plan on the wished cores.

    Where chains collide on as few of them as are enough by the lengths of their slots, they stay on
    the cores of the recording, if these are among the wished ones; or, where one of the cores is
    idle, one chain moves there: return the first such plan without collisions.
    """
    moved, doubts = on_cores(profiles, request)
    candidates = [(moved, doubts)]
    if request.policy != "pipelined":
        recorded: dict[str, int] = {}
        for profile in profiles:
            recorded |= profile.core_of
        if request.cores and len(profiles) > 1 and {*recorded.values()} <= {*request.cores}:
            candidates.append(moved_to(profiles, request.cores, recorded))
        used = {core for profile in moved for core in profile.core_of.values()}
        idle = next((core for core in request.cores or () if core not in used), None)
        if idle is not None:
            candidates += (
                moved_to(profiles, request.cores or (), core_of)
                for core_of in _with_a_chain_on(moved, idle)
            )
        request = replace(request, cores=None)
    plans, errors = [], []
    for moved, doubts in candidates:
        try:
            plan, remarks = _planned(moved, request, time_limit_s)
        except OperationError as error:
            errors.append(error)
            continue
        if not remarks:
            return plan, doubts
        plans.append((plan, [*doubts, *remarks]))
    if not plans:
        raise errors[0]
    return plans[0]


def _with_a_chain_on(profiles: Sequence[Profile], core: int) -> Iterator[dict[str, int]]:
    """Yield the core of each node, with one chain moved to ``core`` that shares no node.

    Chains on few cores come first: their latencies change least.
    """
    core_of: dict[str, int] = {}
    for profile in profiles:
        core_of |= profile.core_of
    for moved in sorted(profiles, key=lambda profile: len(set(profile.core_of.values()))):
        beside = {node for profile in profiles if profile is not moved for node in profile.core_of}
        if beside.isdisjoint(moved.core_of):
            yield {**core_of, **dict.fromkeys(moved.core_of, core)}


def _planned(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> tuple[Plan, list[str]]:
    """Return the plan of chains on the cores of their profiles, and remarks about it."""
    alone, groups = replace(request, best_effort=()), beginning_together(profiles)
    slots_ns = [slot_ns(profile, request) for profile in profiles]
    profiles = loops.one_before_another(profiles, request, slots_ns)

    def plans_of_chains(shifting: bool = False, *, at_once: bool) -> list[ChainPlan]:
        delayed = with_interference(profiles, groups, request, at_once=at_once, shifting=shifting)
        plans = [
            _beside_others(profile, delayed, _for_loops(profile, delayed, alone))
            for profile in delayed
        ]
        for group in groups:
            sharing = _sharing_servers([plans[place] for place in group])
            for place, chain_plan in zip(group, sharing, strict=True):
                plans[place] = chain_plan
        return with_own_names(plans, groups)

    at_once = None if request.policy in PER_CALLBACK else partial(plans_of_chains, at_once=True)
    placed, remarks = place_chains(
        plans_of_chains(at_once=False), together=groups, time_limit_s=time_limit_s, at_once=at_once
    )
    # Receivers without a place in the plan of their chain alone have none beside other chains.
    with_places = [
        profile if has_places(chain_plan) else without_reception(profile)
        for chain_plan, profile in zip(placed, profiles, strict=True)
    ]
    placed = tuple(with_receivers_placed(placed, with_places))
    placed = tuple(
        loops.with_thread_placed(chain_plan, profile, placed)
        for chain_plan, profile in zip(placed, with_places, strict=True)
    )
    return Plan.of(*with_best_effort(placed, best_effort_cores(profiles, request))), remarks


def _for_loops(profile: Profile, every: Sequence[Profile], request: PlanRequest) -> PlanRequest:
    """Return the wishes for a chain: those about loops are for chains that go through some."""
    if profile.loop is not None or not any(beside.loop for beside in every):
        return request
    return replace(request, in_step=False, move_loop=False)


def _beside_others(profile: Profile, every: Sequence[Profile], request: PlanRequest) -> ChainPlan:
    """Plan one of several chains. An error names the chains that take the room that it lacks."""
    try:
        return plan_chain(profile, request)
    except OperationError as error:
        core = profile.core_of.get(profile.last or "")
        names = [
            beside.name
            for beside in every
            if beside is not profile and core in beside.core_of.values()
        ]
        if core is None or not profile.interference_ns:
            raise
        behind = f"{duration_text(profile.interference_ns)} behind {' and '.join(names)}"
        reason = str(error).rstrip(".")
        raise OperationError(f"{profile.name} on core {core}, {behind}: {reason}") from error


def beginning_together(profiles: Sequence[Profile]) -> list[list[int]]:
    """Return groups of chains, by their places, that begin at the same callback."""
    groups: dict[Any, list[int]] = {}
    for place, profile in enumerate(profiles):
        key = place if profile.begins is None else (profile.begins, profile.period_ns)
        groups.setdefault(key, []).append(place)
    return list(groups.values())


def _sharing_servers(plans: list[ChainPlan]) -> list[ChainPlan]:
    """Return plans for branches of one graph: the same servers run it, and outputs are apart."""
    if len(plans) == 1:
        return plans
    if plans[0].policy not in _SHARING:
        names = " and ".join(map(chain_name, plans))
        reason = f"{names} begin at the same callback, and are not planned as {plans[0].policy}"
        raise InputError(f"{reason}: shape them, or plan them one by one")
    shared: dict[tuple[int, int], Server] = {}  # by core and where the first slot starts
    for plan in plans:
        for server in running_servers(plan):
            place = (server.core, server.slots[0][0])
            known = shared.get(place, server)
            slots = max(known.slots, server.slots, key=lambda slots: slots[-1][1])
            threads = tuple(dict.fromkeys((*known.threads, *server.threads)))
            shared[place] = known.model_copy(update={"slots": slots, "threads": threads})
    taken: list[Server] = []
    changed = []
    for plan in plans:
        gates = publishing_servers(plan)
        # Publish slots move so much later that none meet on their core.
        by_ns = behind_others(chain_name(plan), gates, taken, plan.cycle_ns)
        slots_of = {
            server.name: [(start + by_ns, end + by_ns) for start, end in server.slots]
            for server in gates
        }
        moved = with_slots(gates, slots_of)
        if by_ns and plan.loop is not None and plan.loop.in_step is not None:
            reason = f"the output of {chain_name(plan)} is in step with the loop of"
            reason += f" {plan.loop.node}, in a slot that those of other chains meet on its core"
            remedy = "plan the chain alone, give it another core, or leave out --in-step"
            raise OperationError(f"{reason}: {remedy}")
        taken += moved
        predicted = predicted_later(plan.predicted, by_ns)
        sharing = revised(plan, servers=(*shared.values(), *moved), predicted=predicted)
        changed.append(loops.stated(sharing))
    return changed


def _fitting(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> Iterator[str]:
    """Yield what would make the chains fit, in words, after having tried it."""

    def fits(wished: PlanRequest, candidates: Sequence[Profile] = profiles) -> bool:
        try:
            _on_wished_cores(candidates, wished, min(time_limit_s, 2.0))
        except (OperationError, InputError):
            return False
        return True

    recorded = sorted({core for profile in profiles for core in profile.core_of.values()})
    named = request.cores or tuple(recorded)
    free = 1 + max(named, default=0)
    if request.policy != "pipelined":
        more = ((*named, *range(free, free + count)) for count in range(1, len(profiles)))
        enough = next((cores for cores in more if fits(replace(request, cores=cores))), None)
        if enough:
            yield f"--cores {','.join(map(str, enough))}"
    elif request.cores and fits(replace(request, cores=None)):
        yield f"the cores of the recording, {','.join(map(str, recorded))}: without --cores"
    elif not request.cores:
        for core_of in _with_a_chain_on(profiles, free):
            if fits(request, moved_to(profiles, (), core_of)[0]):
                moved = next(
                    profile.name
                    for profile in profiles
                    if free in map(core_of.get, profile.core_of)
                )
                yield f"{moved} on a core of its own while it is recorded"
    if request.epsilon_ns and fits(replace(request, epsilon_ns=0)):
        margins = range(_MARGIN_STEP_NS, request.epsilon_ns + 1, _MARGIN_STEP_NS)
        most = bisect(margins, False, key=lambda ns: not fits(replace(request, epsilon_ns=ns)))
        yield f"--epsilon {format_duration(most * _MARGIN_STEP_NS)}"
    smaller = replace(request, ideal_machine=True, overrun_probability=None)
    if request.epsilon_ns is None and not request.ideal_machine and fits(smaller):
        yield "a margin for a machine that does not stall (--ideal-machine)"
