"""Waiting for an instant, never early, and clearing a core until one."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest
from passing import held
from processes import wait_for

from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import list_threads
from chainshaper.robot.clear_core import ClearCore
from chainshaper.robot.clocks import clock_offset, sleep_until, watch_until
from chainshaper.robot.gate import Gate
from chainshaper.robot.shaper import Shaper

pytestmark = pytest.mark.timed

MS = 1_000_000
GATE = Gate(slots=((4 * MS, 5 * MS),), cycle_ns=10 * MS, anchor="cycle")


@pytest.mark.parametrize("wait", [sleep_until, watch_until])
def test_an_instant_is_waited_for_unless_it_has_passed(wait: Callable[[int], object]) -> None:
    for milliseconds in (0, 1, 10):
        deadline = time.monotonic_ns() + milliseconds * MS
        wait(deadline)
        assert time.monotonic_ns() >= deadline
    for passed in (time.monotonic_ns() - 1, 0, -5):
        wait(passed)  # which would never return if it were taken for the future


def _signalled(handler: Callable[[int, FrameType | None], object], sleep_ns: int) -> None:
    previous = signal.signal(signal.SIGUSR1, handler)
    timer = threading.Timer(0.005, signal.pthread_kill, (threading.get_ident(), signal.SIGUSR1))
    try:
        timer.start()
        sleep_until(time.monotonic_ns() + sleep_ns)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, previous)


def test_a_signal_does_not_shorten_the_sleep_unless_its_handler_raises() -> None:
    handled: list[int] = []
    deadline = time.monotonic_ns() + 40 * MS
    _signalled(lambda number, _: handled.append(number), 40 * MS)
    assert time.monotonic_ns() >= deadline
    assert handled, "the signal was to be handled during the sleep"

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _signalled(interrupt, 60_000 * MS)


@pytest.mark.parametrize("spin", [0, 300_000, 5 * MS])  # the last begins before the message comes
def test_a_held_message_leaves_inside_its_slot_or_later(spin: int) -> None:
    shaper = Shaper(GATE, spin_ns=spin)
    for _ in range(5):
        one = held(shaper)
        release = one.release
        assert release.at_ns is not None
        assert one.message.arrival_ns <= release.at_ns <= one.awake_ns
        assert 4 * MS <= release.at_ns % (10 * MS) < 5 * MS
        assert 0 <= shaper.time_lost(release, one.awake_ns) <= one.awake_ns - release.at_ns


def test_time_spent_behind_a_competitor_is_not_the_machine_s() -> None:
    """Two processes on one core: each waits for about half of the time, by the kernel's account."""
    shaper, mine = Shaper(GATE), os.sched_getaffinity(0)
    core = min(mine)
    busy = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{core}])\nwhile True: pass"]
    competitor = subprocess.Popen(busy)
    try:
        os.sched_setaffinity(0, {core})
        time.sleep(0.2)  # let it start
        release = held(shaper).release
        assert release.at_ns is not None
        late = watch_until(release.at_ns + 100 * MS) - release.at_ns
        assert shaper.time_lost(release, release.at_ns + late) < 0.8 * late
    finally:
        competitor.kill()
        competitor.wait()
        os.sched_setaffinity(0, mine)


def test_the_clock_offset_turns_monotonic_time_into_wall_clock_time() -> None:
    earliest = time.time_ns()
    converted = time.monotonic_ns() + clock_offset()
    # The offset is measured between two readings of a clock; 100 us is far above its error.
    assert earliest - 100_000 <= converted <= time.time_ns() + 100_000


# A clear core -----------------------------------------------------------------------------------


def _worked_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_it_watches_the_clock_until_the_time_it_is_given_and_ends_with_its_owner() -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted")
    core = available_cores()[0]
    clearing = ClearCore(core)

    def is_ready() -> bool:
        (thread,) = list_threads(clearing.pid)
        known = (thread.policy, thread.priority, thread.cores)
        return known == ("SCHED_FIFO", 1, (core,))

    wait_for(is_ready, "the core to be its")
    before, begun = _worked_s(clearing.pid), time.monotonic()
    clearing.clear_until(time.monotonic_ns() + 300 * MS)
    time.sleep(0.4)
    # Others of higher priority may take some of it, on a machine that has a core to spare.
    assert 0.1 < _worked_s(clearing.pid) - before < time.monotonic() - begun
    worked = _worked_s(clearing.pid)
    time.sleep(0.1)
    assert _worked_s(clearing.pid) == worked, "it rests again"
    os.kill(clearing.pid, signal.SIGKILL)
    clearing.clear_until(time.monotonic_ns())  # its death does no harm
    clearing.end()
    assert not list_threads(clearing.pid)


def test_what_cannot_be_cleared_is_not() -> None:
    clearing = ClearCore(100_000)
    clearing.clear_until(time.monotonic_ns() + 3_600_000 * MS)
    clearing.end()
