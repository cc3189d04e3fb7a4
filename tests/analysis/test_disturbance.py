"""Which traversals a stall of the machine counts against."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from story import Story

from chainshaper.analysis import data_flow, disturbance, disturbed, find_chain, graph_of, traverse
from chainshaper.analysis.disturbance import Due, overlapping, stalled_within, with_punctuality


@pytest.fixture(autouse=True, scope="module")
def small_thresholds() -> Iterator[None]:
    """Single stalls count from 50, computing ones from 200 in all, and gates wake up within 100."""
    with pytest.MonkeyPatch.context() as patch:
        for name, ns in (("STALL_NS", 50), ("COMPUTING_THRESHOLD_NS", 200), ("WAKING_NS", 100)):
            patch.setattr(disturbance, name, ns)
        yield


def masked(story: Story, spec: str, due: Due | None = None) -> list[bool]:
    """Which traversals are disturbed."""
    flow = data_flow(story.tables())
    frame, _ = with_punctuality(flow, traverse(flow, find_chain(graph_of(flow), spec)), due)
    return list(disturbed(flow, frame, 0 if due is None else due.margin_ns))


def one_traversal(
    stalls: list[tuple[int, int]],
    release: int | None = None,
    overran: bool = False,
    arrival: int = 2_000,
    due: Due | None = None,
) -> bool:
    """A traversal from 1,000 to 100 behind ``release``, or to 10,000 without a gate.

    The gate has the origin 1,300.
    """
    end = 10_000 if release is None else release + 100
    story = Story()
    timer, t1 = story.source("/source", 1, "/tmp")
    hold, out = story.relay("/gate", 2, "/tmp", "/t1")
    story.runs(timer, 1_000, 1_200, writes=((t1, 1_100),))
    story.runs(hold, 2_000, end + 100, reads=1_100, writes=((out, end),))
    if release is not None:
        waited = {"cycles_waited": 1, "overrun": "wait"} if overran else {}
        story.gate(hold, 1_100, arrival, release, origin=1_300, **waited)
    for time, duration in stalls:
        story.event("machine_stall", time, 9, duration=duration)
    (mask,) = masked(story, "/tmp../t1", due)
    return bool(mask)


@pytest.mark.parametrize(
    ("stalls", "hit"),
    [
        ([(5_000, 200)], True),
        ([(5_000, 199)], False),
        ([(2_000, 100), (5_000, 100)], True),  # they add up
        ([(2_000, 49), (3_000, 49), (4_000, 49), (5_000, 49), (6_000, 49)], False),  # too short
        ([(800, 400)], True),  # 200 of it inside
        ([(800, 399)], False),
        ([(9_800, 5_000)], True),  # 200 of it inside
        ([(9_801, 5_000)], False),
        ([(0, 50_000)], True),  # longer than the traversal
        ([], False),
    ],
)
def test_stalls_of_a_computing_traversal_add_up(stalls: list[tuple[int, int]], hit: bool) -> None:
    assert one_traversal(stalls) is hit


@pytest.mark.parametrize(
    ("stall", "hit"),
    [
        ((5_000, 3_000), False),  # the margin has room for it
        ((5_000, 3_001), True),
        ((9_000, 800), False),  # over 100 before the output is due, at 9,900
        ((9_000, 801), True),  # leaves too little time to wake up
        ((9_950, 60), True),
        ((9_950, 49), False),
        ((10_001, 60), False),  # the output was due
        ((10_001, 9_000), False),
        ((1_200, 100), True),  # while the origin is stamped
        ((1_301, 100), False),
        ((900, 100), False),  # over before the start
    ],
)
@pytest.mark.parametrize("late", [False, True])
def test_a_stall_counts_alike_whether_the_output_is_late_or_not(
    stall: tuple[int, int], hit: bool, late: bool
) -> None:
    """Slot [8,600, 8,700) of a cycle of 20,000: what misses it leaves 20,000 later."""
    due = Due(20_000, slots=((8_600, 8_700),), margin_ns=3_000)
    release, arrival = (29_900, 10_050) if late else (9_900, 2_000)
    assert one_traversal([stall], release, late, arrival, due) is hit


def test_when_an_output_was_due_bounds_what_counts() -> None:
    """Without a plan, when others were let go; without a gate the end of the cycle, at 7,000."""
    assert one_traversal([(5_000, 200)], release=9_900)
    assert not one_traversal([(5_000, 199)], release=9_900)
    assert one_traversal([(6_800, 200)], due=Due(6_000))
    assert not one_traversal([(6_801, 3_000)], due=Due(6_000))


@pytest.mark.parametrize(("first_end", "hit"), [(2_100, [True, True]), (1_900, [True, False])])
def test_who_queued_behind_a_disturbed_traversal_is_disturbed_with_it(
    first_end: int, hit: list[bool]
) -> None:
    """Two traversals that start at 1,000 and 2,000; a stall hits only the first."""
    story = Story()
    timer, t1 = story.source("/source", 1, "/t1")
    story.runs(timer, 1_000, first_end, writes=((t1, first_end),), tid=1)
    story.runs(timer, 2_000, 2_150, writes=((t1, 2_150),), tid=2)
    story.event("machine_stall", 1_200, 9, duration=300)
    assert masked(story, "/source../t1") == hit


SPANS = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 8)), max_size=12)


@given(SPANS, st.lists(st.tuples(st.integers(0, 30), st.integers(1, 5), st.integers(0, 1))))
def test_overlaps_and_lost_time_agree_with_counting_nanoseconds(
    windows: list[tuple[int, int]], seen: list[tuple[int, int, int]]
) -> None:
    start = np.array([a for a, _ in windows], dtype=np.int64)
    end = start + np.array([d for _, d in windows], dtype=np.int64)
    stalls = [(began, began + lasted, core) for began, lasted, core in seen]  # by two, it may be
    columns = np.array(stalls, dtype=np.int64).reshape(-1, 3).T
    pairs = list(zip(start, end, strict=True))
    met = [any(s <= b and t > a for s, t, _ in stalls) for a, b in pairs]
    assert overlapping(start, end, *columns[:2]).tolist() == met
    lost = [{t for a, b, core in stalls if core == k for t in range(a, b)} for k in (0, 1)]
    most = [max(len(one.intersection(range(a, b))) for one in lost) for a, b in pairs]
    assert stalled_within(start, end, *columns).tolist() == most
