"""Which traversals a stall of the machine counts against."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from story import OFFSET, Story

from chainshaper.analysis import data_flow, disturbed, find_chain, graph_of, traverse
from chainshaper.analysis.disturbance import overlapping


def one_traversal(
    stalls: list[tuple[int, int]],
    release: int | None = None,
    cycles_waited: int = 0,
    arrival: int = 2_000,
) -> bool:
    """A traversal from 1,000 to 10,000, whose last hop may be a gate; guard 500, threshold 50."""
    story = Story()
    source, gate = story.node("/source", 1), story.node("/gate", 2)
    timer, t1 = story.timer(source), story.publisher(source, "/tmp")
    hold, out = story.subscription(gate, "/tmp"), story.publisher(gate, "/t1")
    story.runs(timer, 1_000, 1_200, writes=((t1, 1_100),))
    story.runs(hold, 2_000, 10_100, reads=1_100, writes=((out, 10_000),))
    if release is not None:
        story.event(
            "gate_release",
            release,
            2,
            callback=hold.handle,
            source_timestamp=1_100 + OFFSET,
            arrival=arrival,
            origin=1_000,
            release=release,
            slot=0,
            cycles_waited=cycles_waited,
            anchor="stamp",
        )
    for time, duration in stalls:
        story.event("machine_stall", time, 9, duration=duration)
    flow = data_flow(story.tables())
    graph = graph_of(flow)
    found = traverse(flow, find_chain(graph, "/tmp../t1"), graph)
    (mask,) = disturbed(flow, found, threshold_ns=50, guard_ns=500)
    return bool(mask)


@pytest.mark.parametrize(
    ("stall", "hit"),
    [
        ((5_000, 100), True),
        ((5_000, 49), False),  # below the threshold
        ((900, 100), False),  # over just as the traversal starts: [900, 1000)
        ((900, 101), True),
        ((10_000, 50), True),  # begins in its last nanosecond
        ((10_001, 50), False),
        ((0, 50_000), True),  # longer than the traversal
    ],
)
def test_unshaped_traversals_count_every_stall(stall: tuple[int, int], hit: bool) -> None:
    assert one_traversal([stall]) is hit


@pytest.mark.parametrize(
    ("stall", "hit"),
    [
        ((5_000, 100), False),  # absorbed by the wait
        ((9_300, 100), False),  # over before the guard begins: 9,900 - 500
        ((9_350, 100), True),  # reaches into it
        ((9_950, 60), True),
        ((1_200, 100), True),  # while the origin is stamped
        ((1_600, 100), False),
    ],
)
def test_a_gate_absorbs_stalls_before_its_release(stall: tuple[int, int], hit: bool) -> None:
    assert one_traversal([stall], release=9_900) is hit


def test_a_message_that_missed_its_slot_absorbed_nothing() -> None:
    assert one_traversal([(5_000, 100)], release=9_900, cycles_waited=1)
    assert one_traversal([(5_000, 100)], release=9_900, arrival=9_950)


def test_without_stalls_nothing_is_disturbed() -> None:
    assert not one_traversal([])


SPANS = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 8)), max_size=12)


@given(SPANS, SPANS)
def test_overlaps_agree_with_comparing_all_pairs(
    windows: list[tuple[int, int]], stalls: list[tuple[int, int]]
) -> None:
    start = np.array([a for a, _ in windows], dtype=np.int64)
    end = np.array([a + d for a, d in windows], dtype=np.int64)
    began = np.array([a for a, _ in stalls], dtype=np.int64)
    ended = np.array([a + d + 1 for a, d in stalls], dtype=np.int64)
    expected = [
        any(s <= b and t > a for s, t in zip(began, ended, strict=True))
        for a, b in zip(start, end, strict=True)
    ]
    assert overlapping(start, end, began, ended).tolist() == expected
