"""Offsets of several chains, against playing out the hyper-period and trying every offset."""

import itertools
import math
import random
from collections.abc import Sequence
from importlib.util import find_spec

import pytest

from chainshaper.errors import InputError, OperationError
from chainshaper.planning import offsets
from chainshaper.planning.offsets import with_offsets
from chainshaper.planning.plan import (
    ChainOfPlan,
    Evidence,
    Margin,
    Plan,
    Prediction,
    Server,
    revised,
)

MS = 1_000_000


def _plan(name: str, cycle: int, *servers: tuple[int, int, list[tuple[int, int]]]) -> Plan:
    return Plan(
        chain=ChainOfPlan(spec=name, period_ns=cycle),
        evidence=Evidence(samples=1, min_latency_ns=0, mean_latency_ns=1, max_latency_ns=1),
        margin=Margin(epsilon_ns=0),
        policy="shaped",
        cycle_ns=cycle,
        servers=tuple(
            Server(name=f"s{number}", core=core, priority=priority, slots=tuple(slots))
            for number, (core, priority, slots) in enumerate(servers)
        ),
        predicted=Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
    )


def collides(plans: Sequence[Plan], shifts: Sequence[int]) -> bool:
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


def _shifts(plans: Sequence[Plan]) -> list[int]:
    return [plan.offset_ns for plan in plans]


def _random_plans(generator: random.Random, count: int) -> list[Plan]:
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


@pytest.mark.parametrize("solver", ["search", "cp-sat"])
def test_offsets_are_found_exactly_when_there_are_any(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if solver == "cp-sat":
        if find_spec("ortools") is None:
            pytest.skip("ortools is not installed")
        monkeypatch.setattr(offsets, "MOST_SEARCHED", 1)
    generator = random.Random(5)
    possible = impossible = 0
    for _ in range(150):
        plans = _random_plans(generator, generator.choice([2, 3, 3, 4]))
        every = itertools.product([0], *(range(plan.cycle_ns) for plan in plans[1:]))
        if any(not collides(plans, shifts) for shifts in every):
            possible += 1
            assert not collides(plans, _shifts(with_offsets(plans)))
        else:
            impossible += 1
            with pytest.raises(OperationError):
                with_offsets(plans)
    assert possible > 25
    assert impossible > 25


def _chain(name: str, cycle_ms: int, latency_ms: int, core: int = 1, priority: int = 2) -> Plan:
    busy = latency_ms * MS
    return _plan(
        name,
        cycle_ms * MS,
        (core, priority, [(0, busy)]),
        (0, 1, [(busy, busy + MS)]),
    )


def test_two_chains_take_turns_on_a_core() -> None:
    first, second = with_offsets([_chain("a", 100, 60), _chain("b", 100, 40)])
    assert first.offset_ns == 0
    assert second.offset_ns == 60 * MS
    assert second.servers == _chain("b", 100, 40).servers  # slots count from their own cycle


def test_chains_that_share_nothing_stay_where_they_are() -> None:
    chains = [_chain("a", 100, 60), _chain("b", 70, 60, core=2)]
    apart = [revised(chain, servers=chain.servers[:1]) for chain in chains]
    assert with_offsets(apart) == tuple(apart)
    assert with_offsets(apart[:1]) == tuple(apart[:1])


def test_different_priorities_may_overlap_but_not_their_publish_slots() -> None:
    _, second = with_offsets([_chain("a", 100, 60), _chain("b", 100, 60, priority=3)])
    assert second.offset_ns % (100 * MS) >= MS


def test_many_chains_are_solved() -> None:
    if find_spec("ortools") is None:
        pytest.skip("ortools is not installed")
    generator = random.Random(2)
    chains = [
        _chain(f"c{number}", generator.choice([50, 100, 200]), generator.randint(1, 4))
        for number in range(12)
    ]
    found = with_offsets(chains)
    for one, two in itertools.combinations(found, 2):
        for (_, a), (_, b) in itertools.product(_absolute(one), _absolute(two)):
            if a[0] == b[0]:
                assert not (a[1] < b[2] and b[1] < a[2])
    assert with_offsets(chains) == found


def _absolute(plan: Plan) -> list[tuple[str, tuple[int, int, int]]]:
    """Every slot of two hyper-periods of 200 ms: (place, start, end)."""
    return [
        (
            server.name,
            (server.core, plan.offset_ns + cycle + start, plan.offset_ns + cycle + end),
        )
        for server in plan.servers
        for start, end in server.slots
        for cycle in range(-200 * MS, 400 * MS, plan.cycle_ns)
    ]


@pytest.mark.parametrize(
    ("chains", "words"),
    [
        ([_chain("a", 100, 60), _chain("b", 100, 50)], "slots of a and b collide at every offset"),
        ([_chain("a", 100, 6), _chain("b", 70, 5)], "modulo 10ms"),
        (
            [_chain("a", 100, 40), _chain("b", 100, 40), _chain("c", 100, 40)],
            "core 1 at priority 2 fill 120.0% of its time",
        ),
        (
            # Each gap that b leaves holds one of the others, and there are two gaps.
            [_chain("b", 50, 5), *(_chain(name, 100, 30) for name in "acd")],
            "no offsets at which b, a, c, d keep their slots apart, although any two",
        ),
    ],
)
def test_impossible_demands_are_explained(chains: list[Plan], words: str) -> None:
    with pytest.raises(OperationError, match=words):
        with_offsets(chains)


def test_no_plans_are_refused() -> None:
    with pytest.raises(InputError, match="one per chain"):
        with_offsets([])
