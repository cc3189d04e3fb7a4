"""Several chains on shared cores: when each one's cycles start, so that no slots collide.

The paper leaves this open (section 3.1). Two slots [a, a + d) and [b, b + e) that repeat every T
and U collide in some cycle unless the distance of their starts, modulo g = gcd(T, U), is in [d, g −
e]: the distances that occur are all numbers congruent to it. So each pair of chains allows a set of
differences of offsets modulo g, and nothing else matters.

**Candidates.** From any solution, take the chains that are not linked to the first by a chain of
tight pairs (pairs whose difference is at an end of an allowed interval), and start all of them
earlier until some pair becomes tight. Repeated, that links every chain to the first without
breaking a constraint: it is enough to try the ends of allowed intervals.

Chains are fitted in one after the other, which is quick and mostly enough, but proves nothing.
Where it finds nothing, the CP-SAT solver of OR-tools decides, which is exact but may run out of
time; with 30 chains that nearly fill a core it does, where the fitting takes two seconds.
"""

import math
import random
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import combinations, product
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    Server,
    Slot,
    below_executors,
    publish_slots,
    publisher_servers,
    publishing_servers,
    revised,
    running_servers,
    server_of,
    shaping_nodes,
)
from chainshaper.planning.overruns import in_cycle, slots_without
from chainshaper.planning.shaping import BOUNDARY_NS, OUTPUT_PRIORITY, with_gates_level
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError, extra_library

TIME_LIMIT_SECONDS = 60.0
MOST_CYCLES = 2_000  # of all chains in a hyper-period that is played out for the solver
SHARES = (0.9, 0.75, 0.5, 0.25, 0.1, 0.0)  # of a slot that begins while no better one is open
START_NS = 1_000_000  # at the least, so that the first callback begins in time
LEAD_NS = 2_000_000  # a cycle starts so long after the chain's timer expires (DESIGN section 6)
# Where a shaping node's server is in force, it is open for so long before the node watches for its
# slot: 2 ms to take messages, and 2 ms for cycles whose beginning no server holds back
# (:data:`LEAD_NS`); and behind its pause, for its notes.
BEFORE_NS, BEHIND_NS = 4_000_000, 2_000_000
WAKE_UP_NS = 150_000  # of a gate that waits for the others
SURELY_FITTED = 4  # chains: in tests these were fitted wherever they have offsets
MOST_FITTINGS = 300  # of each chain, before the solver is asked; some seconds for 30 chains


_Slots: TypeAlias = Mapping[tuple[int, int], Sequence[Slot]]


class Timetable(NamedTuple):
    """What moves as one against others: a cycle, and the slots in it by core and priority.

    ``begins`` are slots, by core and priority, in which no better server of others may run: that
    which they do in ``busy``, by the same, with the time for which gates watch the clock before.
    """

    name: str
    cycle_ns: int
    slots: dict[tuple[int, int], list[Slot]]
    begins: _Slots = MappingProxyType({})
    busy: _Slots = MappingProxyType({})


def _timetable(
    own: Sequence[ChainPlan], plans: Sequence[ChainPlan], alone: float | None
) -> Timetable:
    """The slots of a chain, or of several that share servers, of which each counts once; and the
    share of the slot that it begins with in which no better server of the plans may run.
    """
    named = {one.name: one for plan in own for one in plan.servers if not one.best_effort}
    watched_ns = {server.name: spin_ns for plan in own for server, spin_ns in _watching(plan)}
    slots: dict[tuple[int, int], list[Slot]] = {}
    begins: dict[tuple[int, int], list[Slot]] = {}
    busy: dict[tuple[int, int], list[Slot]] = {}
    for server in named.values():
        before = watched_ns.get(server.name, 0)
        place = server.core, server.priority
        slots.setdefault(place, []).extend(server.slots)
        watched = ((start - before, end) for start, end in server.slots)
        busy.setdefault(place, []).extend(watched)
    first = {one.core: one for one in named.values() if one.slots[0][0] == 0}
    for core, best in sorted({(one.core, one.priority) for p in plans for one in p.servers}):
        if alone is not None and core in first and best < first[core].priority:
            length_ns = max(START_NS, int(alone * first[core].slots[0][1]))
            begins.setdefault((core, best), []).append((0, length_ns))
    name = " and ".join(map(chain_name, own))
    return Timetable(name, own[0].cycle_ns, slots, begins, busy)


def _watching(plan: ChainPlan) -> Iterator[tuple[Server, int]]:
    """The servers of shaping nodes, and for how long these watch the clock before a slot."""
    for node in shaping_nodes(plan):
        if (server := server_of(plan, node.thread)) is not None:
            yield server, node.spin_ns


def place_chains(
    plans: Sequence[ChainPlan],
    *,
    together: Sequence[Sequence[int]] | None = None,
    time_limit_s: float = TIME_LIMIT_SECONDS,
    at_once: Callable[[bool], Sequence[ChainPlan]] | None = None,
) -> tuple[tuple[ChainPlan, ...], list[str]]:
    """Offsets for chains that share cores, and what is to be known about them.

    The chains take turns where they can (:func:`with_offsets`). Where they cannot, ``at_once``
    plans them again, with the latencies that they have when they run at the same time: the chain
    with the shorter period at the better priority, and only their publish slots stay apart. None
    begins while a better one runs, where that can be, for slots count from when a chain begins.
    Where it cannot, ``at_once`` plans for stamps that shift (it is given True). The shaping nodes
    of all run above the executors of all.

    Raises: as :func:`with_offsets`; OperationError also where chains that cannot take turns may not
    run at the same time, nothing says how long they delay each other then, or stamps shift so far
    that an output may have to wait for others beyond its slot.
    """
    groups = together or [[k] for k in range(len(plans))]
    if at_once is None:
        _refuse_too_full(plans)
    try:
        turns = with_offsets(plans, together=together, time_limit_s=time_limit_s)
    except OperationError as error:
        shared = _shared_threads(plans, groups)
        if at_once is None or shared:
            raise OperationError(f"{error}. {_turns_only(plans, shared)}") from error
        remark = f"{error}. Instead, the chains run at the same time at priorities of their own,"
        remark += " and only their publish slots do not overlap."
        apart = partial(with_offsets, together=together, time_limit_s=time_limit_s)
        placed = _longest_alone(partial(apart, _ranked(at_once(False), groups)))
        if placed is None:
            placed = apart(_ranked(at_once(True), groups))
        turns, remarks = placed, [remark]
    else:
        remarks = []
    _refuse_outputs_behind_others(turns)
    return with_gates_level(turns), remarks


def _longest_alone(apart: Callable[..., tuple[ChainPlan, ...]]) -> tuple[ChainPlan, ...] | None:
    """The offsets with which no better chain has the core for the largest of the shares, if any."""
    for share in SHARES:
        with suppress(OperationError):
            return apart(alone=share)
    return None


def stamp_shift_ns(plan: ChainPlan, plans: Sequence[ChainPlan]) -> int:
    """How much later than its cycle begins a chain may take the stamp from which its slots count:
    0 where no better server, of any of the plans, has the core then.
    """
    (first, *_) = sorted(running_servers(plan), key=lambda one: one.slots[0][0])
    own = {one.name for one in plan.servers}
    for other in plans:
        better = _timetable([other], [other], None)
        common = math.gcd(plan.cycle_ns, other.cycle_ns)
        named = {(one.core, one.priority) for one in other.servers if one.name not in own}
        for core, priority in named if other is not plan else ():
            if core != first.core or priority >= first.priority:
                continue
            for start, end in better.busy[core, priority]:
                later = (start + other.offset_ns - plan.offset_ns) % common
                if later < START_NS or later + end - start > common:
                    return plan.evidence.interference_ns or 0
    return 0


def _refuse_outputs_behind_others(plans: Sequence[ChainPlan]) -> None:
    """Refuse outputs that have to wait for those of others beyond their slot when stamps shift.

    The gate that wakes up first publishes first, so an output waits for publications that are due
    at the same time, and for no watching of the clock.
    """
    shifts = [
        stamp_shift_ns(one, plans) if one.anchor == "stamp" and one.shaping_node else 0
        for one in plans
    ]
    for plan, shift in zip(plans, shifts, strict=True):
        if plan.shaping_thread == "in-slots" and shift > BEHIND_NS:
            said = f"{chain_name(plan)}: its stamps shift by up to {duration_text(shift)} where"
            said += " chains run at the same time, and the slots of its shaping node's server do"
            said += " not: leave the node's thread free (--shaping-thread free), or count slots"
            raise OperationError(f"{said} from the cycle (--anchor cycle)")
    longest = (one.evidence.longest_publication_ns for one in plans)
    cost = [WAKE_UP_NS + (START_NS if one is None else one) for one in longest]
    for k, plan in enumerate(plans):
        if plan.shaping_node is None or not (slots := publish_slots(plan)):
            continue
        start, end = slots[-1]
        waits, names = 0, []
        for j, other in enumerate(plans):
            if j == k or other.shaping_node is None or not (shifts[j] or shifts[k]):
                continue
            if other.shaping_node.core != plan.shaping_node.core:
                continue
            common = math.gcd(plan.cycle_ns, other.cycle_ns)
            distance = other.offset_ns - plan.offset_ns - start
            for its, _ in publish_slots(other):
                later = (its + distance) % common
                if later <= shifts[k] or common - later <= shifts[j] + cost[j]:
                    waits += cost[j]
                    names.append(chain_name(other))
                    break
        if waits >= end - start:
            said = f"{chain_name(plan)}: stamps shift by up to"
            said += f" {duration_text(max(shifts))} where chains run at the same time, and its slot"
            said += f" of {duration_text(end - start)} may be over before the outputs of"
            said += f" {', '.join(names)} are published: count slots from the cycle (--anchor"
            said += f" cycle), or make them {duration_text(waits + BOUNDARY_NS)} long"
            raise OperationError(f"{said} (--publish-slot)")


def _shared_threads(plans: Sequence[ChainPlan], together: Sequence[Sequence[int]]) -> set[str]:
    """The threads that several groups of chains have in their servers: each has one priority."""
    threads = [
        {thread.text for k in group for server in plans[k].servers for thread in server.threads}
        for group in together
    ]
    return {thread for one, two in combinations(threads, 2) for thread in one & two}


def _refuse_too_full(plans: Sequence[ChainPlan]) -> None:
    """Refuse chains that take more than all of a core, whatever their priorities are."""
    shares: dict[int, dict[str, float]] = {}
    for plan in plans:
        cores = {one.core for one in running_servers(plan)}
        longest_ns = plan.evidence.max_latency_ns - (plan.evidence.interference_ns or 0)
        if len(cores) == 1 and plan.policy not in PER_CALLBACK:  # these take turns
            share = (longest_ns + plan.margin.epsilon_ns) / plan.cycle_ns
            shares.setdefault(cores.pop(), {})[chain_name(plan)] = share
    for core, of in sorted(shares.items()):
        if len(of) > 1 and (load := sum(of.values())) > 1 + 1e-9:
            reason = f"with their margins, {', '.join(of)} fill {load:.1%} of the time of core"
            remedy = "another core, longer periods, or smaller margins help"
            raise OperationError(f"{reason} {core}: {remedy}")


def _turns_only(plans: Sequence[ChainPlan], shared: set[str]) -> str:
    """Why chains that cannot take turns are not planned at the same time, and what helps."""
    helps = "periods with a larger common divisor, a smaller margin, or shorter chains"
    if shared:
        reason = f"They share {', '.join(sorted(shared))}, and so have to take turns"
        return f"{reason}. What helps: {helps}"
    if policies := ", ".join(sorted({one.policy for one in plans} & {*PER_CALLBACK})):
        reason = f"Planned as {policies}, chains on one core have to take turns"
        return f"{reason}. What helps: a core for each chain, {helps}"
    recordings = {one.evidence.recording or "REC" for one in plans}
    recording = recordings.pop() if len(recordings) == 1 else "REC"
    chains = " ".join(f"--chain {chain_name(one)}" for one in plans)
    said = "At the same time they would delay each other, and these plans do not say by how much:"
    said += f" plan them together (`chainshaper plan {recording} {chains}`), which adds it. Where"
    return f"{said} all were measured at priorities of their own, write these into the plans"


def _ranked(plans: Sequence[ChainPlan], together: Sequence[Sequence[int]]) -> list[ChainPlan]:
    """The plans with a priority for each group of chains, and one behind it where the threads of
    asynchronous publishers may have to run below their executors.
    """
    ranked = list(plans)
    shortest_first = sorted(together, key=lambda group: (plans[group[0]].cycle_ns, group[0]))
    apart = 2 if any(any(publisher_servers(plan)) for plan in plans) else 1
    for rank, group in enumerate(shortest_first):
        own = {"priority": OUTPUT_PRIORITY + 1 + rank * apart}
        publishing = {server.name for k in group for server in publishing_servers(plans[k])}
        for k in group:
            servers = [
                one if one.name in publishing else one.model_copy(update=own)
                for one in plans[k].servers
            ]
            ranked[k] = revised(plans[k], servers=below_executors(servers))
    return ranked


def with_offsets(
    plans: Sequence[ChainPlan],
    *,
    together: Sequence[Sequence[int]] | None = None,
    time_limit_s: float = TIME_LIMIT_SECONDS,
    alone: float | None = None,
    windows: Mapping[int, tuple[int, int]] = MappingProxyType({}),
) -> tuple[ChainPlan, ...]:
    """The plans of several chains with offsets that keep their slots apart.

    ``together`` are groups of chains (places in ``plans``) that begin at the same callback: they
    have one offset (default: none do). The first group, and any that shares no core with another,
    has the offset 0, unless groups have ``windows``: from when and until when cycles may begin. For
    the share ``alone`` of its slot no chain that begins loses its core to one of a better priority.

    Raises InputError: plans that govern the same output. OperationError: there are no such offsets,
    or the time was up before an answer. PlatformError: many chains collide and OR-tools is missing.
    """
    if not plans:
        raise InputError("no plans to find offsets for: give one per chain")
    for one, two in combinations(plans, 2):
        refuse_common((chain_name(one), chain_name(two)), (one.chain.output, two.chain.output))
        begins = [(plan.chain.spec or "").split("..")[0].strip() for plan in (one, two)]
        # Where groups are given, it is known which begin at one callback, not only their names.
        if together is None and begins[0] and begins[0] == begins[1]:
            names = f"{chain_name(one)} and {chain_name(two)} begin at the same callback"
            raise InputError(f"{names}: plan them together (--chain twice)")
    together = together or [[k] for k in range(len(plans))]
    tables = [_timetable([plans[k] for k in one], plans, alone) for one in together]
    found = _find_offsets(tables, time_limit_s, windows)
    offset_of = {k: found[number] for number, one in enumerate(together) for k in one}
    return tuple(revised(plan, offset_ns=offset_of[k]) for k, plan in enumerate(plans))


def with_windows(
    plans: Sequence[ChainPlan],
    windows_ns: Sequence[tuple[int, int] | None],
    time_limit_s: float = 5.0,
) -> tuple[ChainPlan, ...]:
    """The plans with offsets at which each cycle begins inside its chain's window: from and to, on
    a common clock (None: anywhere). So chains are placed around timers that cannot be moved.

    Raises: as :func:`with_offsets`.
    """
    names = [{server.name for server in plan.servers} for plan in plans]
    pairs = combinations(range(len(plans)), 2)
    together = linked(len(plans), [(j, k) for j, k in pairs if names[j] & names[k]])
    own = {n: at for n, (k, *_) in enumerate(together) if (at := windows_ns[k]) is not None}
    found = partial(with_offsets, plans, together=together, time_limit_s=time_limit_s, windows=own)
    return _longest_alone(found) or found()


def _find_offsets(
    tables: Sequence[Timetable], time_limit_s: float, windows: Mapping[int, tuple[int, int]]
) -> dict[int, int]:
    clock = len(tables)
    if windows:  # they are to a timetable without slots what the slots of others are to each
        tables = [*tables, Timetable("timers", math.lcm(*(one.cycle_ns for one in tables)), {})]
    puzzle = _Puzzle(tables)
    for k, (first, last) in windows.items():
        if last - first < (cycle := tables[k].cycle_ns):
            puzzle.free[k, clock] = cycle, in_cycle(-last, 1 - first, cycle)
    for place, load in _loads(tables).items():
        if load > 1 + 1e-9:
            names = ", ".join(one.name for one in tables if place in one.slots)
            where = f"core {place[0]} at priority {place[1]}"
            raise OperationError(f"the slots of {names} on {where} fill {load:.1%} of its time")
    offsets = dict.fromkeys(range(len(tables)), 0)
    for group in linked(len(tables), puzzle.free):
        if len(group) == 1:
            continue
        deadline = time.monotonic() + time_limit_s
        solution = puzzle.fitted(group, deadline)
        if solution is None:
            solution = puzzle.solved(group, max(0.0, deadline - time.monotonic()))
        if solution is None:
            names = ", ".join(tables[k].name for k in group)
            reason = f"no offsets at which {names} keep their slots apart, although any two"
            raise OperationError(f"there are {reason} of them could: {_fullest(tables, group)}")
        zero = solution.get(clock, 0)
        offsets.update((k, (at - zero) % tables[k].cycle_ns) for k, at in solution.items())
    return offsets


def linked(count: int, pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """The numbers below ``count``, together where pairs link them, directly or through others."""
    of = {number: {number} for number in range(count)}
    for one, two in pairs:
        joined = of[one] | of[two]
        of.update(dict.fromkeys(joined, joined))
    return sorted(sorted(group) for group in {id(group): group for group in of.values()}.values())


class _Puzzle:
    """Timetables to be placed against each other. Where j < k can collide, ``free[j, k]`` are their
    g and the slots in which (offset k − offset j) mod g may be.
    """

    def __init__(self, tables: Sequence[Timetable]) -> None:
        self.tables = tables
        self.free: dict[tuple[int, int], tuple[int, tuple[Slot, ...]]] = {}
        for (j, one), (k, two) in combinations(enumerate(tables), 2):
            common = math.gcd(one.cycle_ns, two.cycle_ns)
            taken: list[Slot] = []
            both: Sequence[tuple[_Slots, _Slots]] = (
                (one.slots, two.slots),
                (one.begins, two.busy),
                (one.busy, two.begins),
            )
            for ours, theirs in both:
                for place in ours.keys() & theirs.keys():
                    for (start, end), (its, ends) in product(ours[place], theirs[place]):
                        # They collide if `two` starts later by more than start − ends, less than:
                        taken += in_cycle(start - ends + 1, end - its, common)
            if taken:
                self.free[j, k] = common, slots_without([(0, common)], taken)
                if not self.free[j, k][1]:
                    raise OperationError(_pair_too_long(one, two, common))

    def _candidates(self, k: int, placed: dict[int, int]) -> NDArray[np.int64]:
        """Offsets of k, ascending, at which it is tight with one of what is placed; or 0."""
        found = [np.zeros(1, dtype=np.int64)]
        for j, base in placed.items():
            if pair := self.free.get((min(j, k), max(j, k))):
                common, free = pair
                ends = np.array([(start, end - 1) for start, end in free], dtype=np.int64).ravel()
                first = (base + (ends if j < k else -ends)) % common
                repeats = np.arange(0, self.tables[k].cycle_ns, common, dtype=np.int64)
                found.append(np.add.outer(first, repeats).ravel())
        return np.unique(np.concatenate(found))

    def _apart(self, j: int, k: int, distances: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which distances from an offset of j to one of k keep their slots apart."""
        common, free = self.free.get((min(j, k), max(j, k)), (1, ((0, 1),)))
        places = (distances if j < k else -distances) % common
        apart = np.zeros(places.size, dtype=bool)
        for start, end in free:
            apart |= (start <= places) & (places < end)
        return apart

    def fitted(self, group: list[int], deadline: float) -> dict[int, int] | None:
        """Chains fitted in one after the other; None says nothing.

        A chain that fits nowhere pushes out what weighs least, and weighs more from then on
        (guided ejection: Nagata and Bräysy, Operations Research Letters 37, 2009).
        """
        tables = self.tables
        busy = [sum(b - a for slots in one.slots.values() for a, b in slots) for one in tables]
        waiting = sorted(group[1:], key=lambda k: (-tables[k].cycle_ns, busy[k]))
        weight = dict.fromkeys(group, 1)
        placed = {group[0]: 0}
        generator = random.Random(0)  # noqa: S311 - no secrets; the same plans, the same offsets
        for _ in range(MOST_FITTINGS * len(group)):
            if not waiting:
                first = placed[group[0]]
                return {k: (offset - first) % tables[k].cycle_ns for k, offset in placed.items()}
            if time.monotonic() > deadline:
                break
            k = waiting.pop()
            candidates = self._candidates(k, placed)
            in_the_way = {j: ~self._apart(j, k, candidates - placed[j]) for j in placed}
            cost = np.zeros(candidates.size)
            cost += sum(weight[j] * hit for j, hit in in_the_way.items())
            least = np.flatnonzero(cost == cost.min())
            chosen = least[0]
            if cost[chosen]:
                weight[k] += 1
                chosen = generator.choice(least)
            for j, hit in in_the_way.items():
                if hit[chosen]:
                    del placed[j]
                    waiting.append(j)
            placed[k] = int(candidates[chosen])
        return None

    def solved(self, group: list[int], time_limit_s: float) -> dict[int, int] | None:
        """The same by CP-SAT; None: there are none."""
        try:
            cp_model = extra_library("ortools.sat.python.cp_model", "offsets for this many chains")
        except PlatformError:
            if len(group) > SURELY_FITTED:
                raise
            names = ", ".join(self.tables[k].name for k in group)
            reason = f"no offsets were found at which {names} keep their slots apart"
            remedy = "whether there are any, `pip install 'chainshaper[solvers]'` lets find out"
            raise OperationError(f"{reason}: {_fullest(self.tables, group)}; {remedy}") from None
        model, cycles = cp_model.CpModel(), {k: self.tables[k].cycle_ns for k in group}
        offsets = {k: model.new_int_var(0, cycles[k] - 1, f"offset{k}") for k in group}
        model.add(offsets[group[0]] == 0)
        for (j, k), (common, free) in self.free.items():
            if j not in offsets:
                continue
            least, most = -(cycles[j] // common) - 1, cycles[k] // common + 1
            times = model.new_int_var(least, most, f"n{j}_{k}")
            domain = cp_model.Domain.from_intervals([[start, end - 1] for start, end in free])
            difference = offsets[k] - offsets[j] - common * times
            model.add_linear_expression_in_domain(difference, domain)
        # Only from slots side by side does a solver see that a core is too full for all of them.
        hyper_period = math.lcm(*cycles.values())
        few = sum(hyper_period // cycle for cycle in cycles.values()) <= MOST_CYCLES
        for place in sorted({place for k in group for place in self.tables[k].slots if few}):
            model.add_no_overlap(
                [
                    model.new_fixed_size_interval_var(offsets[k] + start + cycle, end - start, "")
                    for k in group
                    for start, end in self.tables[k].slots.get(place, [])
                    for cycle in range(-cycles[k], hyper_period, cycles[k])
                ]
            )
        solver = cp_model.CpSolver()
        solver.parameters.max_time_in_seconds = time_limit_s
        solver.parameters.num_workers = 1  # the same plans give the same offsets
        status = solver.solve(model)
        if status == cp_model.INFEASIBLE:
            return None
        if status in (cp_model.OPTIMAL, cp_model.FEASIBLE):
            return {k: int(solver.value(offset)) for k, offset in offsets.items()}
        reason = f"undecided: no offsets for {len(group)} chains were found in time, nor a proof"
        remedy = f"{_fullest(self.tables, group)}. Put fewer chains on it, or allow more time"
        raise OperationError(f"{reason} that there are none: {remedy}")


def _loads(tables: Sequence[Timetable]) -> dict[tuple[int, int], float]:
    """The share of time that slots take, per core and priority."""
    loads: dict[tuple[int, int], float] = {}
    for table in tables:
        for place, slots in table.slots.items():
            busy = sum((end - start) / table.cycle_ns for start, end in slots)
            loads[place] = loads.get(place, 0.0) + busy
    return dict(sorted(loads.items()))


def _fullest(tables: Sequence[Timetable], group: Sequence[int]) -> str:
    loads = _loads([tables[k] for k in group])
    core, priority = max(loads, key=lambda place: (loads[place], place))
    return f"their slots fill {loads[core, priority]:.1%} of core {core} at priority {priority}"


def _pair_too_long(one: Timetable, two: Timetable, common: int) -> str:
    places = one.slots.keys() & two.slots.keys()
    if not places:
        reason = "one begins while a better one runs, at every offset"
        return f"{one.name} and {two.name}: {reason} modulo {duration_text(common)}"
    needed, (core, priority) = max(
        (sum(max(end - start for start, end in own.slots[place]) for own in (one, two)), place)
        for place in places
    )
    excess = f", {duration_text(needed - common)} too long" if needed > common else ""
    said = f"the slots of {one.name} and {two.name} on core {core} at priority {priority} collide"
    said += f" at every offset: they meet in every distance modulo {duration_text(common)}, and"
    return f"{said} their longest take {duration_text(needed)}{excess}"


def chain_name(plan: ChainPlan) -> str:
    """What a plan's chain is called in messages."""
    return plan.chain.spec or plan.chain.output or "a chain without a name"


def refuse_common(names: tuple[str, str], outputs: tuple[str | None, str | None]) -> None:
    """Refuse to plan two chains whose plans would have one output."""
    if outputs[0] is not None and outputs[0] == outputs[1]:
        reason = f"{' and '.join(names)} both publish {outputs[0]}"
        raise InputError(f"{reason}: name it once, with the chain that takes longest")
