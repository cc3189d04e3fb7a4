"""Waiting for an instant: never early, whatever interrupts the sleep."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from passing import held

from chainshaper.gate.decision import Gate, Shaper, clock_offset, sleep_until, watch_until

MS = 1_000_000


def test_sleep_until_is_never_early() -> None:
    for milliseconds in (0, 1, 3, 10):
        deadline = time.monotonic_ns() + milliseconds * MS
        sleep_until(deadline)
        assert time.monotonic_ns() >= deadline


def test_an_instant_that_has_passed_is_not_waited_for() -> None:
    # These would never return if they were taken for the future.
    sleep_until(time.monotonic_ns() - 1)
    sleep_until(0)
    sleep_until(-5)


def test_a_signal_does_not_shorten_the_sleep() -> None:
    handled: list[int] = []
    previous = signal.signal(signal.SIGUSR1, lambda number, _: handled.append(number))
    sleeper = threading.get_ident()
    timers = [
        threading.Timer(delay, signal.pthread_kill, (sleeper, signal.SIGUSR1))
        for delay in (0.005, 0.010, 0.015)
    ]
    try:
        deadline = time.monotonic_ns() + 60 * MS
        for timer in timers:
            timer.start()
        sleep_until(deadline)
        assert time.monotonic_ns() >= deadline
    finally:
        for timer in timers:
            timer.join()
        signal.signal(signal.SIGUSR1, previous)
    assert handled, "the signal was to be handled during the sleep"


def test_an_exception_from_a_signal_handler_ends_the_sleep() -> None:
    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGUSR1, interrupt)
    timer = threading.Timer(0.005, signal.pthread_kill, (threading.get_ident(), signal.SIGUSR1))
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            sleep_until(time.monotonic_ns() + 60_000 * MS)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, previous)


def test_watching_the_clock_is_never_early() -> None:
    deadline = time.monotonic_ns() + 2 * MS
    assert deadline <= watch_until(deadline) <= time.monotonic_ns()
    assert watch_until(deadline) >= deadline, "an instant that has passed"


@pytest.mark.parametrize("spin", [0, 300_000, 5 * MS])  # the last begins before the message comes
def test_a_held_message_leaves_inside_its_slot_or_later(spin: int) -> None:
    gate = Gate(slots=((4 * MS, 5 * MS),), cycle_ns=10 * MS, anchor="cycle")
    shaper = Shaper(gate, spin_ns=spin)
    for _ in range(5):
        one = held(shaper)
        release = one.release
        assert release.at_ns is not None
        assert one.message.arrival_ns <= release.at_ns <= one.awake_ns
        assert 4 * MS <= release.at_ns % (10 * MS) < 5 * MS


def test_time_that_others_ran_is_not_the_machines() -> None:
    """A delay is the machine's only as far as the kernel counts no other thread for it."""
    shaper = Shaper(Gate(slots=((4 * MS, 5 * MS),), cycle_ns=10 * MS, anchor="cycle"))
    one = held(shaper)
    release, woke = one.release, one.awake_ns
    assert release.at_ns is not None
    lost = shaper.time_lost(release, woke)
    assert 0 <= lost <= woke - release.at_ns


def test_time_spent_behind_a_competitor_is_told_from_time_that_nobody_had() -> None:
    """Two processes on one core: each waits for about half of the time, by the kernel's account."""
    shaper = Shaper(Gate(slots=((4 * MS, 5 * MS),), cycle_ns=10 * MS, anchor="cycle"))
    core = min(os.sched_getaffinity(0))
    mine = os.sched_getaffinity(0)
    busy = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{core}])\nwhile True: pass"]
    competitor = subprocess.Popen(busy)
    try:
        os.sched_setaffinity(0, {core})
        time.sleep(0.2)  # let it start
        release = held(shaper).release
        assert release.at_ns is not None
        until = release.at_ns + 100 * MS
        while time.monotonic_ns() < until:
            pass
        late = time.monotonic_ns() - release.at_ns
        assert shaper.time_lost(release, release.at_ns + late) < 0.8 * late
    finally:
        competitor.kill()
        competitor.wait()
        os.sched_setaffinity(0, mine)


def test_the_clock_offset_turns_monotonic_time_into_wall_clock_time() -> None:
    earliest = time.time_ns()
    converted = time.monotonic_ns() + clock_offset()
    latest = time.time_ns()
    # The offset is measured between two readings of a clock; 100 us is far above its error.
    assert earliest - 100_000 <= converted <= latest + 100_000
