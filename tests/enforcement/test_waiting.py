"""Waiting for an instant: never early, whatever interrupts the sleep."""

import signal
import threading
import time

import pytest

from chainshaper.enforcement.gate import Gate, Shaper, clock_offset, sleep_until, wait_until

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


@pytest.mark.parametrize("spin", [0, 300_000, 5 * MS])
def test_wait_until_is_never_early_and_reports_its_waking(spin: int) -> None:
    deadline = time.monotonic_ns() + 2 * MS  # the last spin begins before now
    woke = wait_until(deadline, spin)
    assert deadline <= woke.at_ns <= time.monotonic_ns()
    assert woke.gap_ns >= 0
    assert woke.gap_start_ns + woke.gap_ns <= woke.at_ns


def test_a_held_message_leaves_inside_its_slot_or_later() -> None:
    shaper = Shaper(Gate(slots=((4 * MS, 5 * MS),), cycle_ns=10 * MS, anchor="cycle"), spin_ns=MS)
    for _ in range(5):
        release, arrival, woke = shaper.hold(b"no header")
        assert arrival <= release.at_ns <= woke.at_ns
        assert 4 * MS <= release.at_ns % (10 * MS) < 5 * MS


def test_the_clock_offset_turns_monotonic_time_into_wall_clock_time() -> None:
    earliest = time.time_ns()
    converted = time.monotonic_ns() + clock_offset()
    latest = time.time_ns()
    # The offset is measured between two readings of a clock; 100 us is far above its error.
    assert earliest - 100_000 <= converted <= latest + 100_000
