"""The thread of a live node's loop, by itself: when it sleeps, and what an instance gets."""

import time

import numpy as np
import numpy.typing as npt
import pytest

from chainshaper.workload.dds import Message
from chainshaper.workload.event_log import LAYOUT, WIDTH, EventLog
from chainshaper.workload.loop import Loop

MS = 1_000_000
PERIOD, PHASE = 4 * MS, 1 * MS
FIRST, SECOND = (Message(payload, 0) for payload in (b"first", b"second"))


def entries(log: EventLog, kind: str) -> npt.NDArray[np.int64]:
    """The entries of a kind: time, thread, fields."""
    rows = np.frombuffer(log.rows, dtype=np.int64).reshape(-1, WIDTH)
    return rows[rows[:, 0] == list(LAYOUT).index(kind), 1:]


def test_it_sleeps_until_multiples_of_its_period_and_wakes_up_behind_them() -> None:
    log, got = EventLog(), list[Message | None]()
    loop = Loop(PERIOD, PHASE, 2, got.append, log)
    start = time.monotonic_ns()
    loop.begin(start, start + 10 * PERIOD, start + 10 * PERIOD)
    loop.wait_for_end()
    sleeps, wakes = (entries(log, f"thread_{name}") for name in ("sleep", "wake"))
    due = sleeps[:, 2]
    assert len(due) == len(wakes) == len(got) > 0
    assert ((due - start - PHASE) % PERIOD == 0).all()
    assert (np.diff(due) >= PERIOD).all()
    assert (due <= wakes[:, 0]).all()
    assert set(got) == {None}, "nothing was stored"


def test_multiples_that_an_instance_missed_are_left_out() -> None:
    log = EventLog()
    loop = Loop(PERIOD, 0, 0, lambda _: time.sleep(2.5 * PERIOD / 1e9), log)
    start = time.monotonic_ns()
    loop.begin(start, start + 12 * PERIOD, start + 12 * PERIOD)
    loop.wait_for_end()
    assert (np.diff(entries(log, "thread_sleep")[:, 2]) >= 3 * PERIOD).all()


def test_when_timers_have_ended_it_runs_only_for_what_is_new() -> None:
    log, got = EventLog(), list[Message | None]()
    loop = Loop(PERIOD, 0, 2, got.append, log)
    start = time.monotonic_ns()
    loop.store(1, SECOND)
    loop.store(0, FIRST)
    loop.begin(start, start - 1, start + 5 * PERIOD)
    loop.wait_for_end()
    assert got == [FIRST]
    assert len(entries(log, "thread_wake")) == 1


def test_it_ends_early_when_it_is_told_so() -> None:
    loop = Loop(PERIOD, 0, 0, lambda _: None, EventLog())
    start = time.monotonic_ns()
    loop.begin(start, start + 3_600_000 * MS, start + 3_600_000 * MS)
    loop.over = True
    loop.wait_for_end()


def test_an_error_of_an_instance_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the thread alone would end, and the run look complete."""
    said = list[object]()
    monkeypatch.setattr("chainshaper.workload.loop.end_process", said.append)

    def fail(_: Message | None) -> None:
        raise ValueError("no such joint")

    loop = Loop(PERIOD, 0, 0, fail, EventLog())
    loop.begin(time.monotonic_ns(), 1 << 62, 1 << 62)
    loop.wait_for_end()
    (text,) = said
    assert "no such joint" in str(text)
