"""Chains longer than their period: the shortest cut, against brute force and by hand."""

from collections.abc import Sequence
from itertools import combinations, pairwise, product

from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning.pipeline import in_cycle
from chainshaper.planning.stages import Longest, Stage, shortest_cut


def longest_of(rows: Sequence[Sequence[int]]) -> Longest:
    count = len(rows[0])
    return [
        [max(sum(row[i:j]) for row in rows) for j in range(count + 1)] for i in range(count + 1)
    ]


def apart(slots: Sequence[tuple[int, int]], cycle: int) -> bool:
    """Whether slots of the latency axis overlap at no instant of the cycle: by counting."""
    taken = [instant % cycle for start, end in slots for instant in range(start, end)]
    return len(taken) == len(set(taken))


def brute_force(
    longest: Longest, cuts: Sequence[int], margin: int, cycle: int, places: int
) -> tuple[int, int, int] | None:
    """The least (end, stages, cores): every cut, every core of each stage, every start."""
    best = None
    inner = cuts[1:-1]
    for chosen in (c for n in range(len(inner) + 1) for c in combinations(inner, n)):
        bounds = [cuts[0], *chosen, cuts[-1]]
        lengths = [longest[i][j] for i, j in pairwise(bounds)]
        for core_of in product(range(places), repeat=len(lengths)):
            for waits in product(range(cycle), repeat=len(lengths) - 1):
                starts = [0]
                for wait, length in zip(waits, lengths, strict=False):
                    starts.append(starts[-1] + length + wait)
                found = starts[-1] + lengths[-1], len(lengths), len(set(core_of))
                if best is not None and best <= found:
                    continue
                slots = [(s, s + w + margin) for s, w in zip(starts, lengths, strict=True)]
                of_core = [
                    [slot for slot, own in zip(slots, core_of, strict=True) if own == core]
                    for core in range(places)
                ]
                if all(apart(own, cycle) for own in of_core):
                    best = found
    return best


def found(stages: tuple[Stage, ...] | None, margin: int) -> tuple[int, int, int] | None:
    if stages is None:
        return None
    return stages[-1].closes_ns - margin, len(stages), len({stage.place for stage in stages})


@st.composite
def problems(draw: st.DrawFn) -> tuple[Longest, list[int], int, int, int]:
    count = draw(st.integers(1, 4))
    step = st.integers(1, 4)
    rows = draw(st.lists(st.lists(step, min_size=count, max_size=count), min_size=1, max_size=3))
    cuts = [0, *(cut for cut in range(1, count) if draw(st.integers(0, 4))), count]
    cycle, places = draw(st.integers(3, 6)), draw(st.integers(1, 3))
    return longest_of(rows), cuts, draw(st.integers(0, 1)), cycle, places


@settings(max_examples=300, deadline=None)
@given(problems())
def test_the_cut_is_the_shortest_there_is(
    problem: tuple[Longest, list[int], int, int, int],
) -> None:
    longest, cuts, margin, cycle, places = problem
    stages = shortest_cut(longest, cuts, margin, cycle, places)
    assert found(stages, margin) == brute_force(longest, cuts, margin, cycle, places)
    if stages is None:
        return
    assert (stages[0].first, stages[0].opens_ns, stages[-1].end) == (0, 0, cuts[-1])
    for before, after in pairwise(stages):
        assert before.end == after.first in cuts
        assert before.closes_ns - margin <= after.opens_ns
    for place in range(places):
        own = [s for s in stages if s.place == place]
        slots = [slot for s in own for slot in in_cycle(s.opens_ns, s.closes_ns, cycle)]
        assert all(0 <= start < end <= cycle for start, end in slots)
        assert apart(slots, cycle)
