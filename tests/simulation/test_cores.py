"""Cores: fixed priorities, places in the queue, what switching costs, worked out by hand."""

from pathlib import Path

import pytest
from schedules import application, callbacks, ran, simulated


def test_the_more_urgent_thread_preempts_and_the_other_goes_on_behind_it(tmp_path: Path) -> None:
    described = application(
        """
        chain: low
        nodes:
          low:
            priority: 10
            callbacks: [{timer: 20ms, execution: {constant: 6ms}}]
          high:
            priority: 80
            callbacks: [{timer: 20ms, phase: 2ms, execution: {constant: 3ms}}]
        """
    )
    recording = simulated(tmp_path, described)
    assert callbacks(recording) == [("low", 0, 9), ("high", 2, 5)]
    assert ran(recording)[:3] == [("low", 0, 2), ("high", 2, 5), ("low", 5, 9)]


def test_equals_run_one_after_the_other_in_order_of_arrival(tmp_path: Path) -> None:
    described = application(
        """
        chain: one
        nodes:
          one: {callbacks: [{timer: 20ms, execution: {constant: 3ms}}]}
          late: {callbacks: [{timer: 20ms, phase: 2ms, execution: {constant: 1ms}}]}
          early: {callbacks: [{timer: 20ms, phase: 1ms, execution: {constant: 1ms}}]}
        """
    )
    assert ran(simulated(tmp_path, described)) == [
        ("one", 0, 3),
        ("early", 3, 4),
        ("late", 4, 5),
    ]


def test_a_preempted_thread_keeps_its_place_before_equals_that_came_later(tmp_path: Path) -> None:
    described = application(
        """
        chain: one
        nodes:
          one: {callbacks: [{timer: 20ms, execution: {constant: 4ms}}]}
          equal: {callbacks: [{timer: 20ms, phase: 1ms, execution: {constant: 1ms}}]}
          urgent: {priority: 90, callbacks: [{timer: 20ms, phase: 2ms, execution: {constant: 1ms}}]}
        """
    )
    assert ran(simulated(tmp_path, described)) == [
        ("one", 0, 2),
        ("urgent", 2, 3),
        ("one", 3, 5),
        ("equal", 5, 6),
    ]


def test_cores_run_side_by_side(tmp_path: Path) -> None:
    described = application(
        """
        chain: one
        nodes:
          one: {callbacks: [{timer: 20ms, execution: {constant: 4ms}}]}
          two: {core: 3, callbacks: [{timer: 20ms, execution: {constant: 5ms}}]}
        """
    )
    recording = simulated(tmp_path, described)
    assert ran(recording, 1) == [("one", 0, 4)]
    assert ran(recording, 3) == [("two", 0, 5)]


@pytest.mark.parametrize(
    ("costs", "low", "high"),
    [
        ({"context_switch": "1ms"}, (0, 11), (3, 6)),  # to high, and back
        ({"preemption": "1ms"}, (0, 10), (2, 5)),
        ({"context_switch": "1ms", "preemption": "1ms"}, (0, 12), (3, 6)),
    ],
)
def test_switching_and_being_resumed_cost_the_thread_that_goes_on(
    tmp_path: Path,
    costs: dict[str, str],
    low: tuple[float, float],
    high: tuple[float, float],
) -> None:
    described = application(
        """
        chain: low
        nodes:
          low: {priority: 10, callbacks: [{timer: 40ms, execution: {constant: 6ms}}]}
          high: {callbacks: [{timer: 40ms, phase: 2ms, execution: {constant: 3ms}}]}
        """,
        **costs,
    )
    assert callbacks(simulated(tmp_path, described)) == [("low", *low), ("high", *high)]


def test_timers_have_a_phase_and_their_clock_may_be_fast(tmp_path: Path) -> None:
    described = application(
        """
        chain: steady
        nodes:
          steady: {callbacks: [{timer: 10ms}]}
          fast: {callbacks: [{timer: 10ms, phase: 3ms}]}
        """,
        drift={"fast": 10_000.0},  # one per cent: every period lasts 9.9 ms
    )
    instances = callbacks(simulated(tmp_path, described, cycles=3))
    assert [start for node, start, _ in instances if node == "steady"] == [0, 10, 20]
    # Five periods before the recording began: 3 − 5 · 0.1 ms.
    fast = [start for node, start, _ in instances if node == "fast"]
    assert fast == pytest.approx([2.5, 12.4, 22.3])


def test_a_timer_that_missed_periods_fires_once_and_keeps_its_phase(tmp_path: Path) -> None:
    described = application(
        """
        chain: timer
        nodes:
          timer: {priority: 10, callbacks: [{timer: 10ms, execution: {constant: 1ms}}]}
          busy: {callbacks: [{timer: 100ms, phase: 55ms, execution: {constant: 34ms}}]}
        """
    )
    instances = callbacks(simulated(tmp_path, described, cycles=6))
    # Expiries at 10, 20, 30 of this recording met a core that was busy from 5 to 39.
    starts = [start for node, start, _ in instances if node == "timer"]
    assert starts == [0, 39, 40, 50]
