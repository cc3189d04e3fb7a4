"""From the profiles of several chains to one plan of their application.

Each chain is planned as if it were alone (:func:`~chainshaper.planning.request.plan_chain`), and
what they share is then made one: chains that begin at the same callback, branches of one graph,
share the servers that run it, which stay open for the slowest of them; each has its output in slots
of its own. Chains of different beginnings take turns on the threads of nodes that they share, and
on cores, or run there at priorities of their own
(:func:`~chainshaper.planning.offsets.place_chains`).
"""

from bisect import bisect
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Prediction,
    Server,
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
)
from chainshaper.planning.shaping import behind_others, with_best_effort
from chainshaper.values.durations import duration_text, format_duration
from chainshaper.values.errors import InputError, OperationError

_STANDARD = PlanRequest()
_SHARING = ("shaped", "one-long-slot")
_MARGIN_STEP_NS = 100_000  # of a smaller margin that is tried


def plan_application(
    profiles: Sequence[Profile],
    request: PlanRequest = _STANDARD,
    *,
    time_limit_s: float = TIME_LIMIT_SECONDS,
) -> tuple[Plan, list[str]]:
    """One plan for several chains of an application, and what is to be known about it.

    A chain that is added to others moves their outputs by what it can delay them, once.

    Raises: as :func:`.plan_chain` and :func:`.place_chains`; OperationError names what would fit.
    """
    if not profiles:
        raise InputError("no chain is named: give one at least")
    refuse_entangled(profiles, request.policy)
    refuse_simulated(profiles, request)
    if not keeps_places(request):
        profiles = [without_reception(one) for one in profiles]
    try:
        return _on_wished_cores(profiles, request, time_limit_s)
    except OperationError as error:
        if any(one.reception for one in profiles):  # there may be room for the chains alone
            alone = [without_reception(one) for one in profiles]
            return plan_application(alone, request, time_limit_s=time_limit_s)
        fits = list(_fitting(profiles, request, time_limit_s)) if len(profiles) > 1 else []
        if not fits:
            raise
        reason = str(error).rstrip(".")
        raise OperationError(f"{reason}. It fits with {', or with '.join(fits)}") from error


def with_own_names(
    plans: Sequence[ChainPlan], together: Sequence[Sequence[int]] = ()
) -> list[ChainPlan]:
    """The plans, whose servers have names of their own: each had a ``chain``, and an ``output``.
    Equal servers are one in chains of one group, or whose cycles start at the same instants.
    """
    group_of = {k: number for number, group in enumerate(together) for k in group}
    known, renamed = dict[str, tuple[object, Server]](), []
    for place, plan in enumerate(plans):
        group = group_of.get(place, (plan.cycle_ns, plan.offset_ns))
        servers = []
        for server in plan.servers:
            own = (group, server)
            name = next((n for n, one in known.items() if one == own), server.name)
            while name in known and (known[name] != own or not server.threads):
                name += f"_{place + 1}"
            servers.append(server.model_copy(update={"name": name}))
            known[name] = own
        renamed.append(revised(plan, servers=tuple(servers)))
    return renamed


def _on_wished_cores(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> tuple[Plan, list[str]]:
    """The plan on the wished cores. Where chains collide although one of these is idle, the first
    plan in which they do not, with one of them there.
    """
    moved, doubts = on_cores(profiles, request)
    ways = [(moved, doubts)]
    if request.policy != "pipelined":
        used = {core for one in moved for core in one.core_of.values()}
        for idle in [core for core in request.cores or () if core not in used][:1]:
            ways += (moved_to(profiles, request.cores or (), of) for of in _one_on(moved, idle))
        request = replace(request, cores=None)
    found, refused = [], []
    for moved, doubts in ways:
        try:
            plan, remarks = _planned(moved, request, time_limit_s)
        except OperationError as error:
            refused.append(error)
            continue
        found.append((plan, [*doubts, *remarks]))
        if not remarks:
            return found[-1]
    if not found:
        raise refused[0]
    return found[0]


def _one_on(profiles: Sequence[Profile], core: int) -> Iterator[dict[str, int]]:
    """The core of each node, with one chain on this core that shares no node: those of few cores,
    whose latencies change least, first.
    """
    core_of = {node: at for one in profiles for node, at in one.core_of.items()}
    for one in sorted(profiles, key=lambda profile: len(set(profile.core_of.values()))):
        others = {node for other in profiles if other is not one for node in other.core_of}
        if others.isdisjoint(one.core_of):
            yield {**core_of, **dict.fromkeys(one.core_of, core)}


def _planned(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> tuple[Plan, list[str]]:
    own, groups = replace(request, best_effort=()), beginning_together(profiles)

    def plans(shifting: bool = False, *, at_once: bool) -> list[ChainPlan]:
        delayed = with_interference(profiles, groups, request, at_once=at_once, shifting=shifting)
        found = [_beside_others(profile, delayed, own) for profile in delayed]
        for group in groups:
            for k, plan in zip(group, _sharing_servers([found[k] for k in group]), strict=True):
                found[k] = plan
        return with_own_names(found, groups)

    at_once = None if request.policy in PER_CALLBACK else partial(plans, at_once=True)
    placed, remarks = place_chains(
        plans(at_once=False), together=groups, time_limit_s=time_limit_s, at_once=at_once
    )
    # What has no place in the chain's plan alone has none beside others.
    pairs = zip(placed, profiles, strict=True)
    placed_for = [one if has_places(plan) else without_reception(one) for plan, one in pairs]
    placed = tuple(with_receivers_placed(placed, placed_for))
    return Plan.of(*with_best_effort(placed, best_effort_cores(profiles, request))), remarks


def _beside_others(profile: Profile, every: Sequence[Profile], request: PlanRequest) -> ChainPlan:
    """The plan of one of several chains; who takes the room that it lacks is named."""
    try:
        return plan_chain(profile, request)
    except OperationError as error:
        core = profile.core_of.get(profile.last or "")
        others = [one.name for one in every if one is not profile and core in one.core_of.values()]
        if core is None or not profile.interference_ns:
            raise
        behind = f"{duration_text(profile.interference_ns)} behind {' and '.join(others)}"
        reason = str(error).rstrip(".")
        raise OperationError(f"{profile.name} on core {core}, {behind}: {reason}") from error


def beginning_together(profiles: Sequence[Profile]) -> list[list[int]]:
    """The places of chains, together where they begin at the same callback."""
    groups: dict[Any, list[int]] = {}
    for place, profile in enumerate(profiles):
        key = place if profile.begins is None else (profile.begins, profile.period_ns)
        groups.setdefault(key, []).append(place)
    return list(groups.values())


def _sharing_servers(plans: list[ChainPlan]) -> list[ChainPlan]:
    """Branches of one graph: the same servers run it, and their outputs have slots apart."""
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
            slots = max(known.slots, server.slots, key=lambda own: own[-1][1])
            threads = tuple(dict.fromkeys((*known.threads, *server.threads)))
            shared[place] = known.model_copy(update={"slots": slots, "threads": threads})
    taken: list[Server] = []
    changed = []
    for plan in plans:  # so much later that no publish slots meet on their core
        gates = publishing_servers(plan)
        by_ns = behind_others(chain_name(plan), gates, taken, plan.cycle_ns)
        later = {s.name: [(start + by_ns, end + by_ns) for start, end in s.slots] for s in gates}
        own = with_slots(gates, later)
        taken += own
        predicted = _later(plan.predicted, by_ns)
        changed.append(revised(plan, servers=(*shared.values(), *own), predicted=predicted))
    return changed


def _later(predicted: Prediction, later_ns: int) -> Prediction:
    times = {"mean_ns": predicted.mean_ns + later_ns, "max_ns": predicted.max_ns + later_ns}
    modes = {mode: _later(own, later_ns) for mode, own in (predicted.modes or {}).items()}
    return predicted.model_copy(update={**times, "modes": modes or None})


def _fitting(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> Iterator[str]:
    """What would make the chains fit, in words: each was tried."""

    def fits(wished: PlanRequest, those: Sequence[Profile] = profiles) -> bool:
        try:
            _on_wished_cores(those, wished, min(time_limit_s, 2.0))
        except (OperationError, InputError):
            return False
        return True

    recorded = sorted({core for one in profiles for core in one.core_of.values()})
    named = request.cores or tuple(recorded)
    free = 1 + max(named, default=0)
    if request.policy != "pipelined":
        more = ((*named, *range(free, free + count)) for count in range(1, len(profiles)))
        enough = next((one for one in more if fits(replace(request, cores=one))), None)
        if enough:
            yield f"--cores {','.join(map(str, enough))}"
    elif request.cores and fits(replace(request, cores=None)):
        yield f"the cores of the recording, {','.join(map(str, recorded))}: without --cores"
    elif not request.cores:
        for core_of in _one_on(profiles, free):
            if fits(request, moved_to(profiles, (), core_of)[0]):
                names = (one.name for one in profiles if free in map(core_of.get, one.core_of))
                yield f"{''.join(names)} on a core of its own while it is recorded"
    if request.epsilon_ns and fits(replace(request, epsilon_ns=0)):
        margins = range(_MARGIN_STEP_NS, request.epsilon_ns + 1, _MARGIN_STEP_NS)
        most = bisect(margins, False, key=lambda ns: not fits(replace(request, epsilon_ns=ns)))
        yield f"--epsilon {format_duration(most * _MARGIN_STEP_NS)}"
    smaller = replace(request, ideal_machine=True, overrun_probability=None)
    if request.epsilon_ns is None and not request.ideal_machine and fits(smaller):
        yield "a margin for a machine that does not stall (--ideal-machine)"
