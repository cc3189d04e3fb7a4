"""Offsets of several chains, against playing out the hyper-period and trying every offset."""

import itertools
import math
import random
import sys
from collections.abc import Sequence

import pytest
from bare_plans import MS, bare_plan

from chainshaper.planning import offsets
from chainshaper.planning.chain_plan import ChainPlan, Server, Thread, revised
from chainshaper.planning.offsets import place_chains, with_offsets
from chainshaper.values.errors import InputError, OperationError


def _plan(name: str, cycle: int, *servers: tuple[int, int, list[tuple[int, int]]]) -> ChainPlan:
    own = (
        Server(name=f"s{number}", core=core, priority=priority, slots=tuple(slots))
        for number, (core, priority, slots) in enumerate(servers)
    )
    return bare_plan(name, cycle, *own, policy="shaped")


def collides(plans: Sequence[ChainPlan], shifts: Sequence[int]) -> bool:
    """Play out one hyper-period, instant by instant."""
    hyper_period = math.lcm(*(plan.cycle_ns for plan in plans))
    taken = set()
    for plan, shift in zip(plans, shifts, strict=True):
        for server in plan.servers:
            for start, end in server.slots:
                for cycle in range(0, hyper_period, plan.cycle_ns):
                    for instant in range(cycle + start, cycle + end):
                        place = (server.core, server.priority, (instant + shift) % hyper_period)
                        if place in taken:
                            return True
                        taken.add(place)
    return False


def _random_plans(generator: random.Random, count: int) -> list[ChainPlan]:
    plans = []
    for number in range(count):
        cycle = generator.choice([4, 6, 8, 12])
        servers = []
        for core in generator.sample([0, 1], generator.choice([1, 1, 2])):
            bounds = sorted(generator.sample(range(cycle + 1), 2 * generator.choice([1, 1, 2])))
            slots = [(a, min(b, a + 3)) for a, b in zip(bounds[::2], bounds[1::2], strict=True)]
            servers.append((core, 1, slots))
        plans.append(_plan(f"c{number}", cycle, *servers))
    return plans


@pytest.mark.parametrize("solver", ["fitted", "cp-sat"])
def test_offsets_are_found_exactly_when_there_are_any(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if solver == "cp-sat":
        pytest.importorskip("ortools")
        monkeypatch.setattr(offsets, "MOST_FITTINGS", 0)
    else:  # as where OR-tools are not installed
        monkeypatch.setitem(sys.modules, "ortools.sat.python.cp_model", None)
    generator = random.Random(5)
    possible = impossible = 0
    for _ in range(150):
        plans = _random_plans(generator, generator.choice([2, 3, 3, 4]))
        every = itertools.product([0], *(range(plan.cycle_ns) for plan in plans[1:]))
        if any(not collides(plans, shifts) for shifts in every):
            possible += 1
            assert not collides(plans, [plan.offset_ns for plan in with_offsets(plans)])
        else:
            impossible += 1
            with pytest.raises(OperationError):
                with_offsets(plans)
    assert possible > 25
    assert impossible > 25


def _chain(
    name: str, cycle_ms: int, latency_ms: int, core: int = 1, priority: int = 2
) -> ChainPlan:
    busy = latency_ms * MS
    return _plan(name, cycle_ms * MS, (core, priority, [(0, busy)]), (0, 1, [(busy, busy + MS)]))


def test_chains_that_share_nothing_stay_where_they_are() -> None:
    chains = [_chain("a", 100, 60), _chain("b", 70, 60, core=2)]
    apart = [revised(chain, servers=chain.servers[:1]) for chain in chains]
    assert with_offsets(apart) == tuple(apart)
    # Different priorities may overlap, but not their publish slots.
    _, second = with_offsets([_chain("a", 100, 60), _chain("b", 100, 60, priority=3)])
    assert second.offset_ns % (100 * MS) >= MS
    with pytest.raises(InputError, match="one per chain"):
        with_offsets([])


def _assert_apart(plans: Sequence[ChainPlan]) -> None:
    """No two slots of one core and priority overlap in hyper-periods of 200 ms."""
    places: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for plan in plans:
        for server, cycle in itertools.product(
            plan.servers, range(-200 * MS, 400 * MS, plan.cycle_ns)
        ):
            begun = plan.offset_ns + cycle
            slots = [(begun + start, begun + end) for start, end in server.slots]
            places.setdefault((server.core, server.priority), []).extend(slots)
    for slots in places.values():
        for (_, end), (start, _) in itertools.pairwise(sorted(slots)):
            assert end <= start


def _loaded(periods: list[int], load: float) -> list[ChainPlan]:
    """Thirty chains of different lengths that fill this share of one core."""
    generator = random.Random(3)
    cycles = [generator.choice(periods) * MS for _ in range(30)]
    weights = [generator.uniform(0.5, 1.5) for _ in range(30)]
    return [
        _plan(f"c{number}", cycle, (1, 2, [(0, int(cycle * load * weight / sum(weights)))]))
        for number, (cycle, weight) in enumerate(zip(cycles, weights, strict=True))
    ]


@pytest.mark.parametrize(
    ("periods", "load"),
    # Of chains with 40 and 50 ms, every two meet in each distance modulo 10 ms.
    [([50, 100, 200], 0.87), ([40, 50, 100, 200], 0.93)],
)
def test_thirty_chains_that_nearly_fill_a_core_are_fitted(periods: list[int], load: float) -> None:
    plans = _loaded(periods, load)
    found = with_offsets(plans)
    _assert_apart(found)
    assert found[0].offset_ns == 0
    assert with_offsets(plans) == found


def test_a_core_too_full_for_many_chains_is_proven() -> None:
    pytest.importorskip("ortools")
    # Seven slots of 11 ms and one of 10.5 ms every 50 ms fill 98 ms of 100, but do not fit: the
    # 39.5 ms that the latter leaves twice have room for three each.
    chains = [_plan("half", 50 * MS, (1, 2, [(0, 21 * MS // 2)]))]
    chains += [_plan(f"c{number}", 100 * MS, (1, 2, [(0, 11 * MS)])) for number in range(7)]
    with pytest.raises(OperationError, match=r"no offsets at which half, c0, .* any two"):
        with_offsets(chains, time_limit_s=100)


def test_what_is_not_known_is_said_not_to_be_known() -> None:
    pytest.importorskip("ortools")
    with pytest.raises(OperationError, match=r"undecided: .* fill 99\.0% of core 1"):
        with_offsets(_loaded([40, 50, 100, 200], 0.99), time_limit_s=0.3)


def test_chains_that_cannot_take_turns_run_at_priorities_of_their_own() -> None:
    chains = [_shaped("a", 100, 50), _shaped("b", 50, 20)]
    with pytest.raises(OperationError, match="collide at every offset"):
        with_offsets(chains)
    again = [_shaped("a", 100, 60), _shaped("b", 50, 30)]
    placed, remarks = place_chains(chains, at_once=lambda _: again)
    assert [[server.priority for server in plan.servers] for plan in placed] == [[3, 1], [2, 1]]
    assert ["only their publish slots do not overlap" in remark for remark in remarks] == [True]
    slots = [plan.offset_ns + plan.servers[1].slots[0][0] for plan in placed]
    assert (slots[1] - slots[0]) % (50 * MS) in range(MS, 49 * MS + 1)
    # The worse chain begins while the better one's slot, 30 ms of 50, is closed.
    assert (placed[0].offset_ns - placed[1].offset_ns) % (50 * MS) >= 30 * MS
    # A server for best effort, always open, is not what a chain begins with: 15 ms of its slot.
    rest = Server(name="rest", core=1, priority=4, slots=((0, 100 * MS),), best_effort=True)
    beside = [revised(placed[0], servers=(*placed[0].servers, rest)), placed[1]]
    offsets_ns = [[one.offset_ns for one in with_offsets(p, alone=0.25)] for p in (placed, beside)]
    assert offsets_ns[0] == offsets_ns[1]
    turns, none = place_chains([_shaped("a", 100, 40), _shaped("b", 100, 40)])
    assert none == []
    assert [plan.servers[0].priority for plan in turns] == [2, 2]
    # Priorities that the plans have already say that latencies were measured with them.
    assert place_chains(placed)[1] == []


def test_chains_at_once_whose_delays_no_plan_has_are_refused() -> None:
    chains = [_shaped("a", 100, 50), _shaped("b", 50, 20)]
    apart = [revised(one, policy="server-per-callback") for one in chains]
    thread = Thread(node="/filter")
    shared = [
        revised(one, servers=(one.servers[0].model_copy(update={"threads": (thread,)}), gate))
        for one in chains
        for gate in one.servers[1:]
    ]
    # Priorities of their own help as little where they fill more than the core's time.
    both = [_shaped("a", 100, 60), _shaped("b", 100, 50)]
    worse = both[1].servers[0].model_copy(update={"priority": 3})
    both[1] = revised(both[1], servers=(worse, *both[1].servers[1:]))
    longest = [one.evidence.model_copy(update={"max_latency_ns": 55 * MS}) for one in both]
    full = [revised(p, evidence=e) for p, e in zip(both, longest, strict=True)]
    for plans, reason in (
        (
            chains,
            r"a and b on core 1 at priority 2 .* modulo 50 ms, and their longest take 70 ms, 20 ms"
            r" too long. At the same time .* \(`chainshaper plan REC --chain a --chain b`\)",
        ),
        (apart, r"Planned as server-per-callback, .* take turns"),
        (shared, r"share the executor of /filter, and so have to"),
        (full, r"a, b fill 110.0% of the time of core 1"),
    ):
        with pytest.raises(OperationError, match=reason):
            place_chains(plans)
    with pytest.raises(OperationError, match=r"share the executor of /filter, and so have to"):
        place_chains(shared, at_once=lambda _: shared)


def _shaped(name: str, cycle_ms: int, latency_ms: int) -> ChainPlan:
    busy = latency_ms * MS
    plan = _plan(name, cycle_ms * MS, (1, 2, [(0, busy)]), (1, 1, [(busy, busy + MS)]))
    named = plan.servers[1].model_copy(update={"name": "output"})
    return revised(plan, servers=(plan.servers[0], named))


@pytest.mark.parametrize(
    ("chains", "words"),
    [
        # Who collides is named where both are.
        (
            [
                _plan("a", 100, (1, 2, [(0, 90)]), (0, 2, [(0, 60)])),
                _plan("b", 100, (0, 2, [(0, 50)])),
            ],
            r"slots of a and b on core 0 at priority 2 collide at every.* 110 ns, 10 ns too long",
        ),
        ([_chain("a", 100, 6), _chain("b", 70, 5)], "modulo 10 ms"),
        ([_chain(name, 100, 40) for name in "abc"], "core 1 at priority 2 fill 120.0% of its time"),
        # Each gap that b leaves holds one of the others, and there are two gaps.
        (
            [_chain("b", 50, 5), *(_chain(name, 100, 30) for name in "acd")],
            "no offsets at which b, a, c, d keep their slots apart, although any two",
        ),
    ],
)
def test_impossible_demands_are_explained(chains: list[ChainPlan], words: str) -> None:
    with pytest.raises(OperationError, match=words):
        with_offsets(chains)
