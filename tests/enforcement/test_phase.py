"""Where in a cycle a thread begins, found from when it woke up."""

import subprocess
import sys

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.flow.phase import find_drift, find_phase, measure_phase, watch_wake_ups
from chainshaper.values.errors import OperationError

MS = 1_000_000
CYCLE = 100 * MS
TICKING = """
import sys, time
period, first = int(sys.argv[1]), int(sys.argv[2])
now = time.monotonic_ns()
due = now - now % period + first
print("ready", flush=True)
while True:
    while due <= time.monotonic_ns():
        due += period
    time.sleep((due - time.monotonic_ns()) / 1e9)
    busy = time.monotonic_ns() + 2_000_000
    while time.monotonic_ns() < busy:
        pass
"""


def circular(one: int, other: int, cycle: int = CYCLE) -> int:
    return abs((one - other + cycle // 2) % cycle - cycle // 2)


def test_what_comes_in_every_cycle_is_told_from_what_comes_now_and_then() -> None:
    wake_ups = np.array([1020, 1030, 1090, 1120, 1131, 1220, 1229, 1320])
    phase = find_phase(wake_ups, 100, 4)
    assert phase is not None
    assert phase.at_ns == 20
    assert phase.wake_ups == 4


def test_of_two_regular_places_the_one_after_the_longer_rest_is_the_beginning() -> None:
    """A thread that is pre-empted at 30 % of the cycle begins at 10 % nevertheless."""
    wake_ups = np.array([cycle * CYCLE + place * MS for cycle in range(10) for place in (10, 30)])
    phase = find_phase(wake_ups, CYCLE, 10)
    assert phase is not None
    assert phase.at_ns == 10 * MS


def test_wake_ups_all_over_the_cycle_have_no_phase() -> None:
    steps = np.arange(12) * (CYCLE + 7 * MS)
    assert find_phase(steps, CYCLE, 12) is None
    assert find_phase(np.array([], dtype=np.int64), CYCLE, 12) is None


@given(
    at=st.integers(0, CYCLE - 1),
    lateness=st.lists(st.integers(0, MS), min_size=12, max_size=12),
    others=st.lists(st.tuples(st.integers(0, 11), st.integers(3 * MS, 60 * MS)), max_size=20),
    missing=st.integers(0, 2),
)
def test_a_timer_is_found_wherever_it_lies_and_whatever_else_wakes_its_thread(
    at: int, lateness: list[int], others: list[tuple[int, int]], missing: int
) -> None:
    """Lateness up to 1 ms, two cycles without, others within 60 ms: the rest before is longest."""
    begins = [n * CYCLE + at + late for n, late in enumerate(lateness)][: 12 - missing]
    extra = [n * CYCLE + at + MS + place for n, place in others]
    phase = find_phase(np.sort(np.array(begins + extra, dtype=np.int64)), CYCLE, 12)
    assert phase is not None
    assert circular(phase.at_ns, at) <= 2 * MS


def test_a_process_that_ticks_is_measured() -> None:
    """The reference is the phase that it was given; half a slot's lead is the tolerance."""
    period, first = 50 * MS, 17 * MS
    with subprocess.Popen(
        [sys.executable, "-c", TICKING, str(period), str(first)], stdout=subprocess.PIPE
    ) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            phase = measure_phase(process.pid, process.pid, period)
        finally:
            process.kill()
    assert circular(phase.at_ns, first, period) < period // 10


def test_a_thread_that_ends_meanwhile_is_said_so() -> None:
    with (
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(0.2)"]) as process,
        pytest.raises(OperationError, match=r"ended while its phase was measured"),
    ):
        measure_phase(process.pid, process.pid, CYCLE)


def test_a_thread_that_never_wakes_has_no_phase_and_the_remedy_is_named() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        try:
            with pytest.raises(OperationError, match=r"does not wake up once .*--phase"):
                measure_phase(process.pid, process.pid, 10 * MS)
        finally:
            process.kill()


def test_being_stopped_at_a_slots_end_is_no_beginning() -> None:
    """Wake-ups as seen of a node on a chain's server [0, 70): it begins with the slot, or in it."""
    slots = ((0, 70 * MS),)
    for begins in (0, 3 * MS):
        wake_ups = [
            1_000 * CYCLE + 17 * MS + cycle * CYCLE + at
            for cycle in range(8)
            for at in (begins + 100_000, begins + 9 * MS, 70 * MS + 900_000)
        ]
        seen, anchor = np.array(wake_ups), 17 * MS
        assert find_drift(seen, CYCLE, 8, anchor, slots) == begins + 100_000
        assert find_drift(seen, CYCLE, 8, anchor) == -29_100_000, "which is why slots are looked at"
    assert find_drift(np.array([], dtype=np.int64), CYCLE, 8, 0, slots) is None


def test_wake_ups_without_work_can_be_left_out_and_others_not_looked_for() -> None:
    """It wakes five times per period and works in one of them.

    At a real-time priority: whoever shares its core in slices does not work through.
    """
    body = (
        "import contextlib, os, time\n"
        "with contextlib.suppress(PermissionError):\n"
        "    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))\n"
        "due, number = time.monotonic_ns(), 0\n"
        "print(due, flush=True)\n"
        "while number < 1_000:\n"
        "    due, number = due + 40_000_000, number + 1\n"
        "    time.sleep(max(0, due - time.monotonic_ns()) / 1e9)\n"
        "    used = time.thread_time_ns()\n"
        "    while number % 5 == 0 and time.thread_time_ns() - used < 12_000_000:\n"
        "        pass\n"
    )
    with subprocess.Popen([sys.executable, "-c", body], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            begins = int(process.stdout.readline())
            every = watch_wake_ups(process.pid, process.pid, 1200 * MS)
            working = watch_wake_ups(process.pid, process.pid, 1200 * MS, least_ns=MS)
            closes = begins + 70 * MS  # and opens 100 ms later, 30 ms before it works

            def until_then(now_ns: int) -> int:
                place = (now_ns - closes) % (200 * MS)
                return 0 if place > 100 * MS else 100 * MS - place

            some = watch_wake_ups(process.pid, process.pid, 1200 * MS, rest_ns=until_then)
        finally:
            process.kill()
    assert len(some) > 0
    assert ((some - closes) % (200 * MS) > 99 * MS).all()
    assert len(working) >= 3
    assert _longest_rest(working, 200 * MS) > 100 * MS > _longest_rest(every, 200 * MS)


def _longest_rest(wake_ups: npt.NDArray[np.int64], period: int) -> int:
    places = np.sort(wake_ups % period)
    return int(np.diff(np.append(places, places[0] + period)).max())
