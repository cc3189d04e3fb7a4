"""A core that is cleared: by a real process, at the lowest real-time priority, until a time."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from chainshaper.gate.clear_core import ClearCore
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import list_threads

TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def _wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _worked_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def test_it_watches_the_clock_until_the_time_it_is_given_and_ends_with_its_owner() -> None:
    if not may_use_fifo():
        pytest.skip("SCHED_FIFO is not permitted")
    core = available_cores()[0]
    clearing = ClearCore(core)
    _wait_for(lambda: list_threads(clearing.pid)[0].policy == "SCHED_FIFO")
    _wait_for(lambda: list_threads(clearing.pid)[0].cores == (core,))
    assert list_threads(clearing.pid)[0].priority == 1
    before = _worked_s(clearing.pid)
    begun = time.monotonic()
    clearing.clear_until(time.monotonic_ns() + 300_000_000)
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
    clearing.clear_until(time.monotonic_ns() + 3_600_000_000_000)
    clearing.end()
