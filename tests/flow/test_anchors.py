"""From when on the cycles of several running chains count, by hand and against brute force."""

import math
from collections.abc import Sequence
from itertools import product

import pytest
from bare_plans import MS, bare_plan
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.flow.anchoring import placed
from chainshaper.flow.phase import Phase
from chainshaper.planning.chain_plan import ChainPlan, Server, Thread
from chainshaper.planning.offsets import LEAD_NS
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError

LEAD = LEAD_NS // MS


def _chain(
    name: str, cycle: int, offset: int, end: int, *, core: int = 1, rank: int = 2
) -> ChainPlan:
    """A chain whose one server is open for its first ``end`` ms."""
    own = (Thread(node=f"/{name}"),)
    slots = ((0, end * MS),)
    server = Server(name=name, core=core, priority=rank, slots=slots, threads=own)
    return bare_plan(f"{name}..", cycle * MS, server, output=f"/{name}", offset_ns=offset * MS)


def _waits(plan: Plan, anchor_ns: int, phases: Sequence[int]) -> list[int]:
    """From each chain's timer to its slot, in ms."""
    pairs = zip(plan.chains, phases, strict=True)
    return [(anchor_ns + c.offset_ns - at * MS) % c.cycle_ns // MS for c, at in pairs]


def _placed(chains: Sequence[ChainPlan], phases: Sequence[int], *, gated: bool = True) -> list[int]:
    found = [Phase(at * MS, 0) for at in phases]
    return _waits(*placed(Plan.of(*chains), found, gated=gated), phases)


def test_chains_of_one_core_are_moved_together_and_wait_for_no_other() -> None:
    """Two that share core 1 stay 30 ms apart, wherever the third is; with one anchor for all, a
    timer at 40 ms would expire in its slot of 83 ms.
    """
    one, two = _chain("a", 100, 0, 83), _chain("b", 100, 0, 83, core=0)
    plan, anchor_ns = placed(Plan.of(one, two), [Phase(10 * MS, 0), Phase(40 * MS, 0)])
    assert (anchor_ns, plan.chains[1].offset_ns) == ((10 + LEAD) * MS, 30 * MS)
    assert _waits(plan, anchor_ns, [10, 40]) == [LEAD, LEAD]
    shared = _chain("a", 100, 0, 20), _chain("c", 100, 30, 20)
    chains = [shared[0], _chain("b", 100, 70, 20, core=0), shared[1]]
    plan, _ = placed(Plan.of(*chains), [Phase(at * MS, 0) for at in (0, 50, 40)])
    first, second, third = (chain.offset_ns // MS for chain in plan.chains)
    assert (third - first) % 100 == 30
    assert (second - first) % 100 == 40  # its wait is LEAD, a's 10 ms longer, for c's is LEAD


def test_by_hand_no_timer_expires_in_its_own_slot_where_that_can_be() -> None:
    """b's slot begins 30 ms after a's, and takes 30 of 50 ms. Timers at the same instant: where a
    waits for 2 ms, b waits for 32 and expires 18 ms after its slot has opened. Where b waits for
    2, a does for 22 of the 80 ms for which it is closed.
    """
    chains = [_chain("a", 100, 0, 20), _chain("b", 50, 30, 20 + 10, rank=3)]
    assert _placed(chains, [0, 0]) == [20 + LEAD, LEAD]
    # Nothing stops threads under priorities alone: there the longest wait is the shortest.
    assert _placed(chains, [0, 10], gated=False) == [LEAD, 20 + LEAD]
    never_stopped = [_chain("a", 100, 0, 100), _chain("b", 100, 0, 60, rank=3)]
    assert _placed(never_stopped, [0, 40]) == [40 + LEAD, LEAD]


def test_timers_that_allow_no_beginning_are_named() -> None:
    """Three that take turns, each for 33 of 100 ms, and so begin at 2, 35 and 68 at the earliest:
    then the third has waited for 68 ms, and its slot before was over 67 ms before that.
    """
    chains = [_chain(name, 100, 33 * k, 33) for k, name in enumerate("abc")]
    with pytest.raises(OperationError, match=r"timers of a\.\., b\.\., c\.\. .* nodes again"):
        _placed(chains, [0, 0, 0])
    assert sorted(_placed(chains, [0, 1, 1])) == [LEAD, LEAD + 32, LEAD + 65]


@given(
    st.lists(
        st.tuples(st.sampled_from([20, 40, 80]), st.integers(0, 79), st.integers(1, 80)),
        min_size=2,
        max_size=4,
    ),
    st.lists(st.integers(0, 79), min_size=4, max_size=4),
)
def test_the_anchor_is_the_best_of_all(
    wanted: list[tuple[int, int, int]], phases: list[int]
) -> None:
    """Against every millisecond of the hyper-period: hardly a slot open, then the longest wait."""
    chains = [
        _chain(f"c{k}", cycle, offset % cycle, min(end, cycle - 1), rank=k + 2)
        for k, (cycle, offset, end) in enumerate(wanted)
    ]
    phases = phases[: len(chains)]
    closed = [(chain.cycle_ns - chain.servers[0].slots[0][1]) // MS for chain in chains]
    plan, hyper = Plan.of(*chains), math.lcm(*(cycle for cycle, _, _ in wanted))

    def cost(waits: Sequence[int]) -> tuple[int, int]:
        # Before its lead is over, a chain waits for its slot in the next cycle.
        cycles = (cycle for cycle, _, _ in wanted)
        full = [w if w >= LEAD else w + cycle for w, cycle in zip(waits, cycles, strict=True)]
        pairs = zip(full, closed, strict=True)
        return sum(wait > max(LEAD, most) for wait, most in pairs), max(full)

    best = min(cost(_waits(plan, at * MS, phases)) for at in range(hyper))
    placed_at = _placed(chains, phases)  # at priorities of their own any offsets are allowed
    assert cost(placed_at) == best if not best[0] else cost(placed_at)[0] == 0


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([20, 40]), st.integers(1, 20)), min_size=2, max_size=3
    ).filter(lambda them: sum(length for _, length in them) <= 20),
    st.lists(st.integers(0, 39), min_size=3, max_size=3),
)
def test_chains_that_take_turns_are_refused_only_where_nothing_helps(
    wanted: list[tuple[int, int]], phases: list[int]
) -> None:
    """Against all beginnings, in milliseconds, of chains whose slots fit one behind the other."""
    behind = [sum(length for _, length in wanted[:k]) for k in range(len(wanted))]
    chains = [_chain(f"c{k}", cycle, behind[k], length) for k, (cycle, length) in enumerate(wanted)]
    phases = phases[: len(chains)]

    def apart(begins: Sequence[int]) -> bool:
        taken = [
            (at + n * cycle + ms) % 40
            for at, (cycle, length) in zip(begins, wanted, strict=True)
            for n in range(40 // cycle)
            for ms in range(length)
        ]
        return len(taken) == len(set(taken))

    windows = [
        range(at + LEAD, at + max(LEAD, cycle - length) + 1)
        for at, (cycle, length) in zip(phases, wanted, strict=True)
    ]
    if any(map(apart, product(*windows))):
        plan, anchor_ns = placed(Plan.of(*chains), [Phase(at * MS, 0) for at in phases])
        waits = _waits(plan, anchor_ns, phases)
        # By how much a chain waits is known up to a cycle.
        at = [(begin % cycle) for begin, (cycle, _) in zip(waits, wanted, strict=True)]
        inside = (
            (place - LEAD) % cycle <= max(0, cycle - length - LEAD)
            for place, (cycle, length) in zip(at, wanted, strict=True)
        )
        assert all(inside)
    else:
        with pytest.raises(OperationError, match="nodes again"):
            _placed(chains, phases)
