"""Stall meters: what one notes while it sleeps and wakes, when it does, and since when."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import known

from chainshaper.linux.scheduling import available_cores
from chainshaper.workload.stall_meter import (
    NO_PACE,
    PERIOD_NS,
    WAKEUPS_PER_PACE,
    far_from,
    stalls_watched,
    watch,
)

pytestmark = pytest.mark.timed


def test_the_pace_of_all_wake_ups_is_noted_stretch_by_stretch() -> None:
    begin = time.monotonic_ns()
    used = time.thread_time_ns()
    seen, wakeups, _ = watch(begin, begin + 100_000_000, threshold_ns=10_000_000)
    used = time.thread_time_ns() - used
    rows = np.array(seen).reshape(-1, 3)
    start, duration, cpu_time = rows[rows[:, 2] != NO_PACE].T
    assert len(start) == wakeups // WAKEUPS_PER_PACE > 0
    assert start[0] == begin
    assert (start[1:] == (start + duration)[:-1]).all()
    assert (cpu_time > 0).all()
    assert cpu_time.sum() * WAKEUPS_PER_PACE <= used


def test_a_wake_up_that_came_late_is_a_stall_and_no_pace() -> None:
    begin = time.monotonic_ns() - 5_000_000  # it should have woken long ago
    seen, _, _ = watch(begin, begin + 5_500_000, threshold_ns=1_000_000)
    due, late, pace = seen[:3]
    assert (due, pace) == (begin, NO_PACE)
    assert late >= 5_000_000


def _distance(place: int, instants: list[int], period: int) -> int:
    return min(min((place - one) % period, (one - place) % period) for one in instants)


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=6), st.integers(2, 60))
def test_no_other_place_is_farther_from_all_instants(instants: list[int], period: int) -> None:
    place = far_from(instants, period)
    farthest = max(_distance(other, instants, period) for other in range(period))
    assert 0 <= place < period
    assert _distance(place, instants, period) == farthest


def test_without_instants_any_place_is_as_good() -> None:
    assert far_from([]) == 0


def test_meters_wake_at_their_place_from_when_the_watch_begins() -> None:
    cores = available_cores()[:1]
    with stalls_watched(cores, realtime=False) as watch:
        before = time.monotonic_ns()
        begun = watch.begin(123_456)
        time.sleep(0.2)
        after = time.monotonic_ns()
    assert begun > before
    assert begun % PERIOD_NS == 123_456
    assert watch.table is not None
    assert known(watch.info).wakeups > 0
    assert (watch.table["time"] % PERIOD_NS == 123_456).all()
    assert watch.table["time"].is_between(begun, after + 2_000_000_000).all()


def test_a_watch_that_is_never_begun_ends_and_has_seen_nothing() -> None:
    with stalls_watched(available_cores()[:1], realtime=False) as watch:
        pass
    assert known(watch.info).wakeups <= 1
