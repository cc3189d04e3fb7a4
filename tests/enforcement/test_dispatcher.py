"""When servers open and close: the boundaries of cycles, and moving to another anchor."""

import os
import time
from itertools import chain, takewhile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.enforcement.freezer import (
    Anchoring,
    CoreNumbers,
    ServerNumbers,
    first_anchoring,
    next_anchoring,
)
from chainshaper.enforcement.slot_dispatcher import (
    Boundary,
    Dispatcher,
    boundaries_of,
    instants,
    moved,
)

MS = 1_000_000
Slots = tuple[tuple[tuple[int, int], ...], ...]


@st.composite
def tables(draw: st.DrawFn) -> tuple[int, Slots]:
    """A cycle time and the slots of up to three servers, which may overlap each other."""
    cycle = draw(st.integers(2, 30))
    slots = []
    for _ in range(draw(st.integers(1, 3))):
        cuts = sorted(draw(st.sets(st.integers(0, cycle), min_size=2, max_size=6)))
        slots.append(tuple(zip(cuts[::2], cuts[1::2], strict=False)))
    return cycle, tuple(slots)


def open_at(instant: int, cycle: int, slots: Slots) -> frozenset[int]:
    return frozenset(
        server
        for server, own in enumerate(slots)
        if any(start <= instant % cycle < end for start, end in own)
    )


def walk(stream: list[tuple[int, Boundary]], until: int) -> dict[int, frozenset[int]]:
    """What a dispatcher that follows the boundaries has open at each instant."""
    found = {}
    for (at, boundary), following in zip(stream, [*stream[1:], (until, None)], strict=True):
        found.update(dict.fromkeys(range(at, following[0]), boundary.open))
    return found


@pytest.mark.parametrize(
    ("slots", "opened"),
    [
        # R_m [0, 60), its output's server [60, 70): one instant, never both.
        ((((0, 60),), ((60, 70),)), {0: {0}, 60: {1}, 70: set()}),
        # A slot that ends with the cycle goes over into the one that begins it.
        ((((0, 20), (80, 100)),), {0: {0}, 20: set(), 80: {0}}),
        ((((0, 100),),), {0: {0}}),
        (((),), {0: set()}),
    ],
)
def test_the_boundaries_of_a_cycle(slots: Slots, opened: dict[int, set[int]]) -> None:
    assert boundaries_of(100, slots) == tuple(
        Boundary(at, frozenset(servers), frozenset(servers)) for at, servers in opened.items()
    )


def test_nobody_wakes_up_where_nothing_changes() -> None:
    ahead = instants(boundaries_of(100, (((20, 60),),)), 100, 1000)
    assert [at for at, _ in takewhile(lambda item: item[0] < 1300, ahead)] == [
        *(1000, 1020, 1060),  # at 1000 cycles of another anchor may have ended
        *(1120, 1160),
        *(1220, 1260),
    ]


@given(tables(), st.integers(-50, 50))
def test_servers_are_open_exactly_inside_their_slots(table: tuple[int, Slots], begin: int) -> None:
    cycle, slots = table
    until = begin + 3 * cycle
    ahead = instants(boundaries_of(cycle, slots), cycle, begin)
    stream = list(takewhile(lambda item: item[0] < until, ahead))
    assert walk(stream, until) == {t: open_at(t - begin, cycle, slots) for t in range(begin, until)}
    started = [(at, server) for at, boundary in stream for server in boundary.starts]
    assert sorted(started) == sorted(
        (begin + k * cycle + start, server)
        for k in range(3)
        for server, own in enumerate(slots)
        for start, _ in own
    )


@given(tables(), st.integers(-200, 200), st.integers(-200, 200), st.integers(-300, 300))
def test_moving_to_another_anchor_lets_no_thread_slip_between(
    table: tuple[int, Slots], old: int, new: int, earliest: int
) -> None:
    cycle, slots = table
    boundaries = boundaries_of(cycle, slots)
    before = first_anchoring(old, cycle, earliest - 50)
    anchoring = next_anchoring(before, new, cycle, earliest)
    turn = min(anchoring.begin_ns, anchoring.end_ns)

    assert turn >= earliest
    assert (anchoring.begin_ns - new) % cycle == 0
    assert (anchoring.end_ns - old) % cycle == 0
    assert abs(anchoring.begin_ns - anchoring.end_ns) <= cycle // 2
    assert turn - max(earliest, before.begin_ns) < 3 * cycle, "it takes its time"

    until = anchoring.begin_ns + 2 * cycle
    ahead = moved(instants(boundaries, cycle, before.begin_ns), anchoring, boundaries, cycle)
    expected = {}
    for t in range(before.begin_ns, until):
        if t < turn:
            expected[t] = open_at(t - old, cycle, slots)
        elif t < anchoring.begin_ns:
            expected[t] = frozenset()
        else:
            expected[t] = open_at(t - new, cycle, slots)
    stream = list(takewhile(lambda item: item[0] < until, ahead))
    if turn >= before.begin_ns:
        assert walk(stream, until) == expected


def test_a_move_that_is_overtaken_by_another_leaves_only_the_last() -> None:
    boundaries = boundaries_of(100, (((0, 60),),))
    ahead = moved(instants(boundaries, 100, 0), Anchoring(230, 200), boundaries, 100)
    upcoming = next(ahead)
    ahead = moved(chain([upcoming], ahead), Anchoring(410, 430), boundaries, 100)
    times = [at for at, _ in takewhile(lambda item: item[0] < 600, ahead)]
    assert times == [0, 60, 100, 160, 200, 230, 290, 330, 390, 410, 470, 510, 570]


def test_the_first_cycle_begins_as_soon_as_it_may() -> None:
    assert first_anchoring(30, 100, 950) == Anchoring(1030, 1030)
    assert first_anchoring(30, 100, 1030) == Anchoring(1030, 1030)
    assert first_anchoring(5_030, 100, 950) == Anchoring(1030, 1030), "an anchor yet to come"


def test_a_slot_whose_start_passed_in_a_stall_is_late_and_one_that_passed_was_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """50 ms into a cycle of 1 s: of [0, 900), [20, 30) and [40, 900) ms the second is over."""
    slots = (((0, 900 * MS),), ((20 * MS, 30 * MS),), ((40 * MS, 900 * MS),))
    dispatcher, looks = object.__new__(Dispatcher), iter([None])

    def wait_for_boundary(_: Dispatcher) -> None:
        next(looks)  # the second look is the end

    monkeypatch.setattr(Dispatcher, "_tick_until_boundary", wait_for_boundary)
    monkeypatch.setattr(Dispatcher, "_obey", lambda _: None)
    dispatcher.groups, dispatcher.all = [{}, {}, {}], frozenset({0, 1, 2})
    dispatcher.shared, dispatcher.counters = CoreNumbers(), [ServerNumbers() for _ in slots]
    dispatcher.open, dispatcher.unexamined, dispatcher.begun = frozenset(), set(), []
    dispatcher.let_go, dispatcher.owner = 0, os.getppid()
    dispatcher.last_sign = now = time.monotonic_ns()
    dispatcher.ahead = instants(boundaries_of(1000 * MS, slots), 1000 * MS, now - 50 * MS)
    dispatcher.upcoming = next(dispatcher.ahead)
    with pytest.raises(StopIteration):
        dispatcher.run()
    dispatcher._tick()
    assert [one.slots for one in dispatcher.counters] == [1, 0, 1]
    assert [one.late for one in dispatcher.counters] == [1, 0, 1]
    first, _, third = (one.longest for one in dispatcher.counters)
    assert first >= 50 * MS
    assert first - third == 40 * MS
