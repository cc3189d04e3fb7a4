"""What the stall meter notes while it sleeps and wakes."""

import time

import numpy as np

from chainshaper.workload.stall_meter import NO_PACE, WAKEUPS_PER_PACE, watch


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
