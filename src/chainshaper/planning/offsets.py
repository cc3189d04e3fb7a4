"""Several chains on shared cores: when each one's cycles start, so that no slots collide.

The paper leaves this open (section 3.1). Two slots [a, a + d) and [b, b + e) that repeat every T
and U collide in some cycle unless the distance of their starts, modulo g = gcd(T, U), is in [d, g −
e], since every distance congruent to it occurs. So each pair of chains allows a set of differences
of offsets modulo g, and nothing else matters.

**Candidates.** From any solution, take the chains that are not linked to the first by a chain of
tight pairs (pairs whose difference is at an end of an allowed interval), and start all of them
earlier until some pair becomes tight. Repeated, that links every chain to the first without
breaking a constraint: it is enough to try the ends of allowed intervals.

First, chains are fitted in one after the other: that is quick and mostly enough, but proves
nothing. Where it finds no offsets, the CP-SAT solver of OR-tools decides. It is exact, but may run
out of time: with 30 chains that nearly fill a core it does, where the fitting takes two seconds.
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
MOST_CYCLES = 2_000  # of all chains, in a hyper-period whose slots the solver gets side by side
# The parts of a chain's first slot in which no better server may run; the first that fits is taken.
SHARES = (0.9, 0.75, 0.5, 0.25, 0.1, 0.0)
START_NS = 1_000_000  # that part at the least, so that the first callback begins in time
LEAD_NS = 2_000_000  # a cycle starts so long after the chain's timer expires (DESIGN section 6)
# Where a shaping node's server is in force, it is open for so long before the node watches for its
# slot: 2 ms to take messages, and 2 ms for cycles whose beginning no server holds back
# (:data:`LEAD_NS`); and for so long behind its pause, to log.
BEFORE_NS, BEHIND_NS = 4_000_000, 2_000_000
WAKE_UP_NS = 150_000  # a gate that waits for other gates takes so long to wake up
SURELY_FITTED = 4  # in tests so many chains were fitted wherever they have offsets
MOST_FITTINGS = 300  # of each chain, before the solver is asked; some seconds for 30 chains


_Slots: TypeAlias = Mapping[tuple[int, int], Sequence[Slot]]
"""Slots by core and priority."""


class Timetable(NamedTuple):
    """The slots of chains that have one offset."""

    name: str
    cycle_ns: int
    slots: dict[tuple[int, int], list[Slot]]
    # In these no server of other timetables may be `busy` at that core and priority.
    begins: _Slots = MappingProxyType({})
    busy: _Slots = MappingProxyType({})  # its slots, and when its gates watch the clock before


def _timetable(
    together: Sequence[ChainPlan], plans: Sequence[ChainPlan], alone: float | None
) -> Timetable:
    """Return the timetable of a chain, or of several that share servers: each server counts once.

    No better server of the ``plans`` may run for the share ``alone`` of the slot with which it
    begins; None: any may.
    """
    named = {
        server.name: server
        for plan in together
        for server in plan.servers
        if not server.best_effort
    }
    watched_ns = {server.name: spin_ns for plan in together for server, spin_ns in _watching(plan)}
    slots: dict[tuple[int, int], list[Slot]] = {}
    begins: dict[tuple[int, int], list[Slot]] = {}
    busy: dict[tuple[int, int], list[Slot]] = {}
    for server in named.values():
        before = watched_ns.get(server.name, 0)
        place = server.core, server.priority
        slots.setdefault(place, []).extend(server.slots)
        watched = ((start - before, end) for start, end in server.slots)
        busy.setdefault(place, []).extend(watched)
    first = {server.core: server for server in named.values() if server.slots[0][0] == 0}
    planned = {(server.core, server.priority) for plan in plans for server in plan.servers}
    for core, priority in sorted(planned):
        if alone is not None and core in first and priority < first[core].priority:
            length_ns = max(START_NS, int(alone * first[core].slots[0][1]))
            begins.setdefault((core, priority), []).append((0, length_ns))
    name = " and ".join(map(chain_name, together))
    return Timetable(name, together[0].cycle_ns, slots, begins, busy)


def _watching(plan: ChainPlan) -> Iterator[tuple[Server, int]]:
    """Yield the servers of shaping nodes, and how long these watch the clock before a slot."""
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
    """Find offsets for chains that share cores; return the plans with these, and remarks about it.

    The chains take turns where they can (:func:`with_offsets`). Where they cannot, ``at_once``
    plans them again, with the latencies that they have when they run at the same time: the chain
    with the shorter period at the better priority, and only their publish slots stay apart. Slots
    count from when a chain begins, so where that can be, none begins while a better one runs. Where
    it cannot be, ``at_once`` is called with True, and plans for stamps that shift. The shaping
    nodes of all chains run above the executors of all.

    Raises: as :func:`with_offsets`. OperationError also where chains that cannot take turns may not
    run at the same time, nothing says how long they delay each other then, or stamps shift so far
    that an output may have to wait for others beyond its slot.
    """
    groups = together or [[place] for place in range(len(plans))]
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
    level = with_gates_level(turns)
    if len(groups) > 1:
        level = tuple(map(_at_other_offset, level))
    return level, remarks


def _at_other_offset(plan: ChainPlan) -> ChainPlan:
    """Return the plan of a chain that begins at another time than when it was recorded.

    With what phase a loop that reads its output starts then is not known, unless it is in step.
    """
    loop = plan.loop
    if loop is None or loop.in_step is not None or loop.age_at_any_phase is None:
        return plan
    at_any_phase = {"age": loop.age_at_any_phase, "moved_ns": 0}
    return plan.model_copy(update={"loop": loop.model_copy(update=at_any_phase)})


def _longest_alone(apart: Callable[..., tuple[ChainPlan, ...]]) -> tuple[ChainPlan, ...] | None:
    """Return the plans in which chains begin alone for the largest share that can be, if any."""
    for share in SHARES:
        with suppress(OperationError):
            return apart(alone=share)
    return None


def stamp_shift_ns(plan: ChainPlan, plans: Sequence[ChainPlan]) -> int:
    """Return how much later than its cycle begins a chain may take its stamp (ns).

    Its slots count from the stamp. It is 0 where no better server of the plans has the core then.
    """
    first = min(running_servers(plan), key=lambda server: server.slots[0][0])
    names = {server.name for server in plan.servers}
    for beside in plans:
        if beside is plan:
            continue
        busy = _timetable([beside], [beside], None).busy
        common = math.gcd(plan.cycle_ns, beside.cycle_ns)
        better = {
            (server.core, server.priority)
            for server in beside.servers
            if server.name not in names
            and server.core == first.core
            and server.priority < first.priority
        }
        for place in better:
            for start, end in busy[place]:
                later = (start + beside.offset_ns - plan.offset_ns) % common
                if later < START_NS or later + end - start > common:
                    return plan.evidence.interference_ns or 0
    return 0


def _refuse_outputs_behind_others(plans: Sequence[ChainPlan]) -> None:
    """Refuse outputs that have to wait for those of others beyond their slot when stamps shift.

    The gate that wakes up first publishes first. So an output waits for publications that are due
    at the same time, but not while other gates watch the clock.
    """
    shifts = [
        stamp_shift_ns(plan, plans) if plan.anchor == "stamp" and plan.shaping_node else 0
        for plan in plans
    ]
    for plan, shift in zip(plans, shifts, strict=True):
        if plan.shaping_thread == "in-slots" and shift > BEHIND_NS:
            reason = f"{chain_name(plan)}: its stamps shift by up to {duration_text(shift)} where"
            reason += " chains run at the same time, and the slots of its shaping node's server do"
            reason += " not: leave the node's thread free (--shaping-thread free), or count slots"
            raise OperationError(f"{reason} from the cycle (--anchor cycle)")
    for place, plan in enumerate(plans):
        if plan.shaping_node is None or not (slots := publish_slots(plan)):
            continue
        start, end = slots[-1]
        waits_ns, names = _waits_for_outputs(plans, place, shifts)
        if waits_ns >= end - start:
            reason = f"{chain_name(plan)}: stamps shift by up to"
            reason += f" {duration_text(max(shifts))} where chains run at the same time, and its"
            reason += f" slot of {duration_text(end - start)} may be over before the outputs of"
            reason += f" {', '.join(names)} are published: count slots from the cycle (--anchor"
            reason += f" cycle), or make them {duration_text(waits_ns + BOUNDARY_NS)} long"
            raise OperationError(f"{reason} (--publish-slot)")


def _waits_for_outputs(
    plans: Sequence[ChainPlan], place: int, shifts: Sequence[int]
) -> tuple[int, list[str]]:
    """Return how long the output of a chain may wait for others on its core (ns), and for which.

    ``place`` is the chain's, ``shifts`` are how far the stamps of each chain shift (ns).
    """
    plan, waits_ns, names = plans[place], 0, []
    start, _ = publish_slots(plan)[-1]
    for place_beside, beside in enumerate(plans):
        if place_beside == place or not (shifts[place_beside] or shifts[place]):
            continue
        if _gate_core(beside) is None or _gate_core(beside) != _gate_core(plan):
            continue
        longest_ns = beside.evidence.longest_publication_ns
        cost = WAKE_UP_NS + (START_NS if longest_ns is None else longest_ns)
        common = math.gcd(plan.cycle_ns, beside.cycle_ns)
        distance = beside.offset_ns - plan.offset_ns - start
        for begins, _ in publish_slots(beside):
            later = (begins + distance) % common
            if later <= shifts[place] or common - later <= shifts[place_beside] + cost:
                waits_ns += cost
                names.append(chain_name(beside))
                break
    return waits_ns, names


def _gate_core(plan: ChainPlan) -> int | None:
    return None if plan.shaping_node is None else plan.shaping_node.core


def _shared_threads(plans: Sequence[ChainPlan], together: Sequence[Sequence[int]]) -> set[str]:
    """Return the threads that several groups of chains have in their servers."""
    threads = [
        {
            thread.text
            for place in group
            for server in plans[place].servers
            for thread in server.threads
        }
        for group in together
    ]
    return {thread for first, second in combinations(threads, 2) for thread in first & second}


def _refuse_too_full(plans: Sequence[ChainPlan]) -> None:
    """Refuse chains that take more than all of a core, whatever their priorities are."""
    shares: dict[int, dict[str, float]] = {}  # by core and name of the chain
    for plan in plans:
        cores = {server.core for server in running_servers(plan)}
        longest_ns = plan.evidence.max_latency_ns - (plan.evidence.interference_ns or 0)
        if len(cores) == 1 and plan.policy not in PER_CALLBACK:  # these take turns
            share = (longest_ns + plan.margin.epsilon_ns) / plan.cycle_ns
            shares.setdefault(cores.pop(), {})[chain_name(plan)] = share
    for core, share_of in sorted(shares.items()):
        if len(share_of) > 1 and (load := sum(share_of.values())) > 1 + 1e-9:
            reason = (
                f"with their margins, {', '.join(share_of)} fill {load:.1%} of the time of core"
            )
            remedy = "another core, longer periods, or smaller margins help"
            raise OperationError(f"{reason} {core}: {remedy}")


def _turns_only(plans: Sequence[ChainPlan], shared: set[str]) -> str:
    """Say why chains that cannot take turns are not planned at the same time, and what helps."""
    helps = "periods with a larger common divisor, a smaller margin, or shorter chains"
    if shared:
        reason = f"They share {', '.join(sorted(shared))}, and so have to take turns"
        return f"{reason}. What helps: {helps}"
    if policies := ", ".join(sorted({plan.policy for plan in plans} & {*PER_CALLBACK})):
        reason = f"Planned as {policies}, chains on one core have to take turns"
        return f"{reason}. What helps: a core for each chain, {helps}"
    recordings = {plan.evidence.recording or "REC" for plan in plans}
    recording = recordings.pop() if len(recordings) == 1 else "REC"
    chains = " ".join(f"--chain {chain_name(plan)}" for plan in plans)
    reason = "At the same time they would delay each other, and these plans do not say by how much:"
    reason += f" plan them together (`chainshaper plan {recording} {chains}`), which adds it. Where"
    return f"{reason} all were measured at priorities of their own, write these into the plans"


def _ranked(plans: Sequence[ChainPlan], together: Sequence[Sequence[int]]) -> list[ChainPlan]:
    """Return the plans with a priority for each group of chains, the shortest period the best.

    Where the threads of asynchronous publishers may have to run below their executors, a priority
    behind that of their group stays free for them.
    """
    ranked = list(plans)
    shortest_first = sorted(together, key=lambda group: (plans[group[0]].cycle_ns, group[0]))
    apart = 2 if any(any(publisher_servers(plan)) for plan in plans) else 1
    for rank, group in enumerate(shortest_first):
        change = {"priority": OUTPUT_PRIORITY + 1 + rank * apart}
        publishing = {server.name for place in group for server in publishing_servers(plans[place])}
        for place in group:
            servers = [
                server if server.name in publishing else server.model_copy(update=change)
                for server in plans[place].servers
            ]
            ranked[place] = revised(plans[place], servers=below_executors(servers))
    return ranked


def with_offsets(
    plans: Sequence[ChainPlan],
    *,
    together: Sequence[Sequence[int]] | None = None,
    time_limit_s: float = TIME_LIMIT_SECONDS,
    alone: float | None = None,
    windows: Mapping[int, tuple[int, int]] = MappingProxyType({}),
) -> tuple[ChainPlan, ...]:
    """Return the plans of several chains with offsets that keep their slots apart.

    ``together`` are groups of chains (places in ``plans``) that begin at the same callback: they
    have one offset (default: each chain is a group). The first group, and any that shares no core
    with another, has the offset 0, unless groups have ``windows``: from when and until when their
    cycles may begin. For the share ``alone`` of its first slot no chain loses its core to one of a
    better priority.

    Raises InputError: plans that govern the same output. OperationError: there are no such offsets,
    or the time was up before an answer. PlatformError: many chains collide and OR-tools is missing.
    """
    if not plans:
        raise InputError("no plans to find offsets for: give one per chain")
    for first, second in combinations(plans, 2):
        names = chain_name(first), chain_name(second)
        refuse_common(names, (first.chain.output, second.chain.output))
        begins = [(plan.chain.spec or "").split("..")[0].strip() for plan in (first, second)]
        # Where groups are given, they say which chains begin at one callback; else names have to.
        if together is None and begins[0] and begins[0] == begins[1]:
            reason = f"{' and '.join(names)} begin at the same callback"
            raise InputError(f"{reason}: plan them together (--chain twice)")
    together = together or [[place] for place in range(len(plans))]
    tables = [_timetable([plans[place] for place in group], plans, alone) for group in together]
    offsets = _find_offsets(tables, time_limit_s, windows)
    offset_of = {place: offsets[k] for k, group in enumerate(together) for place in group}
    return tuple(revised(plan, offset_ns=offset_of[place]) for place, plan in enumerate(plans))


def with_windows(
    plans: Sequence[ChainPlan],
    windows_ns: Sequence[tuple[int, int] | None],
    time_limit_s: float = 5.0,
) -> tuple[ChainPlan, ...]:
    """Return the plans with offsets at which each cycle begins inside its chain's window.

    A window is from and to, on a common clock (None: anywhere). So chains are placed around timers
    that cannot be moved.

    Raises: as :func:`with_offsets`.
    """
    names = [{server.name for server in plan.servers} for plan in plans]
    pairs = combinations(range(len(plans)), 2)
    together = linked(len(plans), [(j, k) for j, k in pairs if names[j] & names[k]])
    windows = {
        group: window
        for group, (place, *_) in enumerate(together)
        if (window := windows_ns[place]) is not None
    }
    apart = partial(
        with_offsets, plans, together=together, time_limit_s=time_limit_s, windows=windows
    )
    return _longest_alone(apart) or apart()


def _find_offsets(
    tables: Sequence[Timetable], time_limit_s: float, windows: Mapping[int, tuple[int, int]]
) -> dict[int, int]:
    """Return the offset of each timetable (its place), inside its window, if it has one."""
    clock = len(tables)
    if windows:
        # A timetable without slots is the clock: a window is the free place of a timetable at it.
        cycle_ns = math.lcm(*(table.cycle_ns for table in tables))
        tables = [*tables, Timetable("timers", cycle_ns, {})]
    puzzle = _Puzzle(tables)
    for k, (first, last) in windows.items():
        if last - first < (cycle := tables[k].cycle_ns):
            puzzle.free[k, clock] = cycle, in_cycle(-last, 1 - first, cycle)
    for (core, priority), load in _loads(tables).items():
        if load > 1 + 1e-9:
            names = ", ".join(table.name for table in tables if (core, priority) in table.slots)
            where = f"core {core} at priority {priority}"
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
        for place, offset in solution.items():
            offsets[place] = (offset - zero) % tables[place].cycle_ns
    return offsets


def linked(count: int, pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Return groups of the numbers below ``count`` that pairs link, directly or through others."""
    group_of = {number: {number} for number in range(count)}
    for first, second in pairs:
        joined = group_of[first] | group_of[second]
        group_of.update(dict.fromkeys(joined, joined))
    groups = {id(group): group for group in group_of.values()}.values()
    return sorted(sorted(group) for group in groups)


class _Puzzle:
    """Timetables to be placed against each other; j and k are their places.

    Where j < k can collide, ``free[j, k]`` has their g, and the slots in which (offset k − offset
    j) mod g may be.
    """

    def __init__(self, tables: Sequence[Timetable]) -> None:
        self.tables = tables
        self.free: dict[tuple[int, int], tuple[int, tuple[Slot, ...]]] = {}
        for (j, first), (k, second) in combinations(enumerate(tables), 2):
            common = math.gcd(first.cycle_ns, second.cycle_ns)
            taken: list[Slot] = []
            colliding: Sequence[tuple[_Slots, _Slots]] = (
                (first.slots, second.slots),
                (first.begins, second.busy),
                (first.busy, second.begins),
            )
            for slots_j, slots_k in colliding:
                for place in slots_j.keys() & slots_k.keys():
                    for slot_j, slot_k in product(slots_j[place], slots_k[place]):
                        # They collide if k starts so much later than j, at the least and the most.
                        least, most = slot_j[0] - slot_k[1] + 1, slot_j[1] - slot_k[0]
                        taken += in_cycle(least, most, common)
            if taken:
                self.free[j, k] = common, slots_without([(0, common)], taken)
                if not self.free[j, k][1]:
                    raise OperationError(_pair_too_long(first, second, common))

    def _candidates(self, k: int, placed: dict[int, int]) -> NDArray[np.int64]:
        """Return offsets of k, ascending, at which it is tight with a placed timetable; or 0."""
        candidates = [np.zeros(1, dtype=np.int64)]
        for j, base in placed.items():
            if pair := self.free.get((min(j, k), max(j, k))):
                common, free = pair
                ends = np.array([(start, end - 1) for start, end in free], dtype=np.int64).ravel()
                first = (base + (ends if j < k else -ends)) % common
                repeats = np.arange(0, self.tables[k].cycle_ns, common, dtype=np.int64)
                candidates.append(np.add.outer(first, repeats).ravel())
        return np.unique(np.concatenate(candidates))

    def _apart(self, j: int, k: int, distances: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which distances from an offset of j to one of k keep their slots apart."""
        common, free = self.free.get((min(j, k), max(j, k)), (1, ((0, 1),)))
        places = (distances if j < k else -distances) % common
        apart = np.zeros(places.size, dtype=bool)
        for start, end in free:
            apart |= (start <= places) & (places < end)
        return apart

    def fitted(self, group: list[int], deadline: float) -> dict[int, int] | None:
        """Fit timetables in one after the other; return their offsets. None proves nothing.

        A timetable that fits nowhere pushes out those that weigh least, and weighs more from then
        on (guided ejection: Nagata and Bräysy, Operations Research Letters 37, 2009).
        """
        tables = self.tables
        busy = [
            sum(end - start for slots in table.slots.values() for start, end in slots)
            for table in tables
        ]
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
            # For each placed timetable, the candidates with which it collides.
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
        """Find the offsets by CP-SAT; None: there are none."""
        try:
            cp_model = extra_library("ortools.sat.python.cp_model", "offsets for this many chains")
        except PlatformError:
            if len(group) > SURELY_FITTED:
                raise
            names = ", ".join(self.tables[k].name for k in group)
            reason = f"no offsets were found at which {names} keep their slots apart"
            remedy = "`pip install 'chainshaper[solvers]'` to find out whether there are any"
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
        places: set[tuple[int, int]] = set()
        if sum(hyper_period // cycle for cycle in cycles.values()) <= MOST_CYCLES:
            places = {place for k in group for place in self.tables[k].slots}
        for place in sorted(places):
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
    """Return the share of time that slots take, by core and priority."""
    loads: dict[tuple[int, int], float] = {}
    for table in tables:
        for place, slots in table.slots.items():
            busy = sum((end - start) / table.cycle_ns for start, end in slots)
            loads[place] = loads.get(place, 0.0) + busy
    return dict(sorted(loads.items()))


def _fullest(tables: Sequence[Timetable], group: Sequence[int]) -> str:
    """Say how full the core and priority is that the slots of a group fill most."""
    loads = _loads([tables[k] for k in group])
    core, priority = max(loads, key=lambda place: (loads[place], place))
    return f"their slots fill {loads[core, priority]:.1%} of core {core} at priority {priority}"


def _pair_too_long(first: Timetable, second: Timetable, common: int) -> str:
    """Say why two timetables collide at every offset modulo ``common`` (ns)."""
    names = f"{first.name} and {second.name}"
    places = first.slots.keys() & second.slots.keys()
    if not places:
        reason = "one begins while a better one runs, at every offset"
        return f"{names}: {reason} modulo {duration_text(common)}"
    needed, (core, priority) = max(
        (_longest(first.slots[place]) + _longest(second.slots[place]), place) for place in places
    )
    excess = f", {duration_text(needed - common)} too long" if needed > common else ""
    reason = f"the slots of {names} on core {core} at priority {priority} collide"
    reason += f" at every offset: they meet in every distance modulo {duration_text(common)}, and"
    return f"{reason} their longest take {duration_text(needed)}{excess}"


def _longest(slots: Sequence[Slot]) -> int:
    return max(end - start for start, end in slots)


def chain_name(plan: ChainPlan) -> str:
    """Return the name of a plan's chain in messages."""
    return plan.chain.spec or plan.chain.output or "a chain without a name"


def refuse_common(names: tuple[str, str], outputs: tuple[str | None, str | None]) -> None:
    """Refuse to plan two chains whose plans would have one output."""
    if outputs[0] is not None and outputs[0] == outputs[1]:
        reason = f"{' and '.join(names)} both publish {outputs[0]}"
        raise InputError(f"{reason}: name it once, with the chain that takes longest")
