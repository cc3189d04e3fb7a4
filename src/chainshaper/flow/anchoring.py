"""From when on the cycles of a plan count: its slots open behind the timers of the application."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
from types import MappingProxyType
from typing import NamedTuple

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.planned_threads import (
    closed_before,
    first_planned,
    server_members,
    threads_for,
)
from chainshaper.flow.phase import Phase, measure_phase
from chainshaper.linux.threads import RunningThread
from chainshaper.planning.chain_plan import ChainPlan, revised
from chainshaper.planning.offsets import LEAD_NS, chain_name, linked, with_windows
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError


class CarriedOut(NamedTuple):
    """A plan as it is carried out."""

    plan: Plan
    anchor_ns: int  # its cycles count from here (CLOCK_MONOTONIC, modulo the hyper-period)
    waits_ns: list[int]  # of each chain: how long before slots its timer expires; [] if not known
    phases: list[Phase]  # of each chain: where in a cycle its timer expires; [] if not measured


def first_threads(plan: Plan, allocation: Allocation) -> list[tuple[RunningThread, ...]]:
    """Return the running threads that may begin each chain: all of its first executor.

    Raises OperationError: no server of a chain holds an executor.
    """
    server_members(plan, allocation)  # none is in two servers
    beginning: list[tuple[RunningThread, ...]] = []
    for chain in plan.chains:
        planned = first_planned(chain)
        if planned is None:
            raise OperationError(
                f"no server of {chain_name(chain)} holds an executor, so nothing says where in a"
                " cycle the chain begins: give its phase (--phase)"
            )
        beginning.append(tuple(listed.thread for listed in threads_for(planned, allocation)))
    return beginning


def chain_phases(
    plan: Plan,
    allocation: Allocation,
    progress: Callable[[float], None] = lambda _: None,
    known: Mapping[int, Phase] = MappingProxyType({}),
) -> list[Phase]:
    """Measure where in its cycle each chain begins; some are ``known``, by their chains' places."""
    beginnings = [
        (threads[0].pid, tuple(thread.tid for thread in threads), chain.cycle_ns)
        for chain, threads in zip(plan.chains, first_threads(plan, allocation), strict=True)
    ]
    # Chains of one graph begin alike.
    unknown = [beginning for place, beginning in enumerate(beginnings) if place not in known]
    measured = dict.fromkeys(unknown)
    phases = {}
    for number, (pid, tids, cycle_ns) in enumerate(measured):
        report = partial(lambda number, share: progress((number + share) / len(measured)), number)
        phases[pid, tids, cycle_ns] = measure_phase(pid, tids, cycle_ns, progress=report)
    return [
        known[place] if place in known else phases[beginning]
        for place, beginning in enumerate(beginnings)
    ]


def carried_out(
    plan: Plan,
    allocation: Allocation,
    phase_ns: int | None,
    *,
    gated: bool = True,
    progress: Callable[[float], None] = lambda _: None,
    known: Mapping[int, Phase] = MappingProxyType({}),
) -> CarriedOut:
    """Anchor a plan to what runs, whose first timer expires at ``phase_ns``.

    None: the phases of all chains are measured that are not ``known`` (:func:`chain_phases`).
    Raises OperationError: a chain has no regular beginning, or as :func:`placed`.
    """
    if phase_ns is not None:
        anchor_ns = (phase_ns + LEAD_NS - plan.chains[0].offset_ns) % plan.cycle_ns
        return CarriedOut(plan, anchor_ns, [], [])
    phases = chain_phases(plan, allocation, progress, known)
    plan, anchor_ns = placed(plan, phases, gated=gated)
    waits_ns = [
        (anchor_ns + chain.offset_ns - phase.at_ns) % chain.cycle_ns
        for chain, phase in zip(plan.chains, phases, strict=True)
    ]
    return CarriedOut(plan, anchor_ns, waits_ns, phases)


def placed(plan: Plan, phases: Sequence[Phase], *, gated: bool = True) -> tuple[Plan, int]:
    """Place the cycles of a plan so that every slot opens soon after its chain's timer expires.

    Returns the plan, and the instant of CLOCK_MONOTONIC, modulo the hyper-period, from which its
    cycles count. Every slot opens :data:`LEAD_NS` after its chain's timer at least.

    The longest wait of chains that share a core is as short as can be, but no timer is to expire
    while its slot is open (``gated``): the thread would begin in that of the instance before. Where
    it does with the plan's offsets, the chains get others. Timers of chains that share no core
    expire independently: their offsets are moved, so that these do not wait for each other's.

    Raises OperationError: no offsets help.
    """
    cores = [{server.core for server in chain.servers} for chain in plan.chains]
    pairs = combinations(range(len(cores)), 2)
    groups = linked(len(cores), [(j, k) for j, k in pairs if cores[j] & cores[k]])
    chains, first_ns = list(plan.chains), None
    for group in groups:
        of_group = [chains[place] for place in group]
        group_phases = [phases[place] for place in group]
        placed_chains, anchor_ns = _placed_on_shared_cores(of_group, group_phases, gated)
        first_ns = anchor_ns if first_ns is None else first_ns
        for place, chain in zip(group, placed_chains, strict=True):
            offset_ns = (chain.offset_ns + anchor_ns - first_ns) % chain.cycle_ns
            chains[place] = revised(chain, offset_ns=offset_ns)
    return Plan.of(*chains), first_ns or 0


def _placed_on_shared_cores(
    chains: Sequence[ChainPlan], phases: Sequence[Phase], gated: bool
) -> tuple[Sequence[ChainPlan], int]:
    """Place the cycles of chains that share cores, as :func:`placed`."""
    # Waits only grow with the anchor, but where one starts again: the best is at such a place.
    hyper_period = math.lcm(*(chain.cycle_ns for chain in chains))
    ready = [phase.at_ns + LEAD_NS for phase in phases]  # so early a slot may open
    beginnings = [
        (ready_ns - chain.offset_ns, chain.cycle_ns)
        for ready_ns, chain in zip(ready, chains, strict=True)
    ]
    candidates = {
        (at_ns + cycle * cycle_ns) % hyper_period
        for at_ns, cycle_ns in beginnings
        for cycle in range(hyper_period // cycle_ns)
    }
    # The longest wait with which a timer expires while its slot is closed. None: with any.
    longest_waits = [closed_before(chain) if gated else None for chain in chains]

    def cost(anchor_ns: int) -> tuple[int, int]:
        """How many timers expire while their slot is open, and the longest wait."""
        waits = [LEAD_NS + (anchor_ns - at_ns) % cycle_ns for at_ns, cycle_ns in beginnings]
        inside = sum(
            longest is not None and wait > max(LEAD_NS, longest)
            for wait, longest in zip(waits, longest_waits, strict=True)
        )
        return inside, max(waits)

    best = min(sorted(candidates), key=cost)
    if cost(best)[0] == 0:
        return chains, best
    windows = [
        None if longest is None else (ready_ns, ready_ns + max(0, longest - LEAD_NS))
        for ready_ns, longest in zip(ready, longest_waits, strict=True)
    ]
    try:
        return with_windows(chains, windows), 0
    except OperationError as error:
        names = ", ".join(map(chain_name, chains))
        raise OperationError(
            f"the timers of {names} expire so that, whatever their offsets, one does while the slot"
            f" of its instance before is open: start the nodes again, one by one ({error})"
        ) from error
