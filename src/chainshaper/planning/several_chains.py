"""From the profiles of several chains to one plan of their application.

Each chain is planned as if it were alone (:func:`~chainshaper.planning.request.plan_chain`), and
what they share is then made one:

* chains that begin at the same callback, branches of one graph, share the servers that run it,
  which stay open for the slowest of them; each has its output in slots of its own;
* chains of different beginnings that pass the same node take turns on its thread;
* chains that share no more than a core take turns on it, or run at the same time at priorities of
  their own (:func:`~chainshaper.planning.offsets.place_chains`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from chainshaper.planning.application_plan import ApplicationPlan, combined
from chainshaper.planning.offsets import TIME_LIMIT_SECONDS, chain_name, place_chains
from chainshaper.planning.plan import (
    Plan,
    Prediction,
    Server,
    publishing_servers,
    revised,
    with_slots,
)
from chainshaper.planning.profile import Profile, with_interference
from chainshaper.planning.request import (
    PlanRequest,
    best_effort_cores,
    on_cores,
    plan_chain,
    refuse_entangled,
    refuse_simulated,
)
from chainshaper.planning.shaping import behind_others, with_best_effort
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError

_STANDARD = PlanRequest()
_SHARING = ("shaped", "one-long-slot")


def plan_application(
    profiles: Sequence[Profile],
    request: PlanRequest = _STANDARD,
    *,
    time_limit_s: float = TIME_LIMIT_SECONDS,
) -> tuple[ApplicationPlan, list[str]]:
    """One plan for several chains of an application, and what is to be known about it.

    A chain that is added to others moves their outputs by what it can delay them, once.

    Raises: as :func:`.plan_chain` and :func:`.place_chains`; OperationError names what would fit.
    """
    if not profiles:
        raise InputError("no chain is named: give one at least")
    profiles, doubts = on_cores(profiles, request)
    if request.policy != "pipelined":
        request = replace(request, cores=None)
    refuse_entangled(profiles, request.policy)
    refuse_simulated(profiles, request)
    try:
        plan, remarks = _planned(profiles, request, time_limit_s)
        return plan, [*doubts, *remarks]
    except OperationError as error:
        fits = list(_fitting(profiles, request, time_limit_s)) if len(profiles) > 1 else []
        if not fits:
            raise
        raise OperationError(
            f"{str(error).rstrip('.')}. It fits with {', or with '.join(fits)}"
        ) from error


def with_own_names(plans: Sequence[Plan]) -> list[Plan]:
    """The plans, whose servers have names of their own: each had a ``chain``, and an ``output``."""
    known, renamed = dict[str, Server](), []
    for place, plan in enumerate(plans, start=1):
        servers = []
        for server in plan.servers:
            name = next((n for n, one in known.items() if one == server), server.name)
            while name in known and (known[name] != server or not server.threads):
                name += f"_{place}"
            servers.append(server.model_copy(update={"name": name}))
            known[name] = server
        renamed.append(revised(plan, servers=tuple(servers)))
    return renamed


def _planned(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> tuple[ApplicationPlan, list[str]]:
    own, groups = replace(request, best_effort=()), beginning_together(profiles)

    def plans(at_once: bool) -> list[Plan]:
        delayed = with_interference(profiles, groups, request, at_once=at_once)
        found = [_beside_others(profile, delayed, own) for profile in delayed]
        for group in groups:
            for k, plan in zip(group, _sharing_servers([found[k] for k in group]), strict=True):
                found[k] = plan
        return with_own_names(found)

    placed, remarks = place_chains(
        plans(at_once=False),
        together=groups,
        time_limit_s=time_limit_s,
        at_once=partial(plans, at_once=True),
    )
    return combined(with_best_effort(placed, best_effort_cores(profiles, request))), remarks


def _beside_others(profile: Profile, every: Sequence[Profile], request: PlanRequest) -> Plan:
    """The plan of one of several chains; who takes the room that it lacks is named."""
    try:
        return plan_chain(profile, request)
    except OperationError as error:
        core = profile.core_of.get(profile.last or "")
        others = [one.name for one in every if one is not profile and core in one.core_of.values()]
        if core is None or not profile.interference_ns:
            raise
        raise OperationError(
            f"{profile.name} on core {core}, {duration_text(profile.interference_ns)} behind"
            f" {' and '.join(others)}: {str(error).rstrip('.')}"
        ) from error


def beginning_together(profiles: Sequence[Profile]) -> list[list[int]]:
    """The places of chains, together where they begin at the same callback."""
    groups: dict[Any, list[int]] = {}
    for place, profile in enumerate(profiles):
        key = place if profile.begins is None else (profile.begins, profile.period_ns)
        groups.setdefault(key, []).append(place)
    return list(groups.values())


def _sharing_servers(plans: list[Plan]) -> list[Plan]:
    """Branches of one graph: the same servers run it, and their outputs have slots apart."""
    if len(plans) == 1:
        return plans
    if plans[0].policy not in _SHARING:
        names = " and ".join(map(chain_name, plans))
        reason = f"{names} begin at the same callback, and are not planned as {plans[0].policy}"
        raise InputError(f"{reason}: shape them, or plan them one by one")
    shared: dict[tuple[int, int], Server] = {}  # by core and where the first slot starts
    for plan in plans:
        publishing = publishing_servers(plan)
        for server in (one for one in plan.servers if one not in publishing):
            place = (server.core, server.slots[0][0])
            shared[place] = _joined(shared.get(place, server), server)
    taken: list[Server] = []
    changed = []
    for plan in plans:
        later = _behind(plan, taken)
        own = publishing_servers(later)
        taken += own
        changed.append(revised(later, servers=(*shared.values(), *own)))
    return changed


def _joined(one: Server, two: Server) -> Server:
    """A server with the threads of both, open as long as the longer of them."""
    longest = max(one.slots, two.slots, key=lambda slots: slots[-1][1])
    threads = tuple(dict.fromkeys((*one.threads, *two.threads)))
    return one.model_copy(update={"slots": longest, "threads": threads})


def _behind(plan: Plan, taken: Sequence[Server]) -> Plan:
    """The plan with its publish slots so much later that none meets those taken on their core."""
    gates = publishing_servers(plan)
    later_ns = behind_others(chain_name(plan), gates, taken, plan.cycle_ns)
    slots = {s.name: [(a + later_ns, b + later_ns) for a, b in s.slots] for s in gates}
    predicted = _later(plan.predicted, later_ns)
    return revised(plan, servers=with_slots(plan.servers, slots), predicted=predicted)


def _later(predicted: Prediction, later_ns: int) -> Prediction:
    times = {"mean_ns": predicted.mean_ns + later_ns, "max_ns": predicted.max_ns + later_ns}
    modes = {mode: _later(own, later_ns) for mode, own in (predicted.modes or {}).items()}
    return predicted.model_copy(update={**times, "modes": modes or None})


def _fitting(
    profiles: Sequence[Profile], request: PlanRequest, time_limit_s: float
) -> Iterator[str]:
    """What would make the chains fit, in words: tried one after the other."""
    free = 1 + max(core for one in profiles for core in (*one.core_of.values(), 0))
    variants: list[tuple[str, Sequence[Profile], PlanRequest]] = []
    for place, profile in enumerate(profiles):
        shared = {
            node for other in profiles if other is not profile for node in other.core_of
        } & profile.core_of.keys()
        if profile.core_of and not shared:
            moved = replace(profile, core_of=dict.fromkeys(profile.core_of, free))
            others = [*profiles[:place], moved, *profiles[place + 1 :]]
            variants.append((f"{profile.name} on a core of its own", others, request))
    if request.epsilon_ns is None and not request.ideal_machine:
        smaller = replace(request, ideal_machine=True, overrun_probability=None)
        variants.append(("a margin for a machine that does not stall", profiles, smaller))
    for text, changed, wished in variants:
        try:
            _planned(changed, wished, min(time_limit_s, 5.0))
        except (OperationError, InputError):
            continue
        option = " (--ideal-machine)" if wished is not request else " (its nodes' `core`)"
        yield text + option
