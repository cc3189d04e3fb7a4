"""Cycles whose timer was late since the machine had stalled, with answers worked by hand."""

import polars as pl
import pytest
from story import Story

from chainshaper.analysis import analyse_latency
from chainshaper.analysis.disturbance import timer_due

MS, US = 1_000_000, 1_000
PERIOD = 200 * MS


def late_in_one_cycle(
    late_ns: int, stall: tuple[int, int], *, gated: bool = False, cycles: int = 20, late: int = 10
) -> list[bool]:
    """Which of the cycles are disturbed; a timer starts each of them 50 µs behind its expiry, one
    of them ``late_ns`` behind it, and the stall begins so long behind that expiry, for so long."""
    story = Story()
    timer, raw = story.source("/source", 1, "/raw", PERIOD)
    relay, out = story.relay("/relay", 2, "/raw", "/out")
    for cycle in range(cycles):
        due = MS + (cycle + 1) * PERIOD
        start = due + (late_ns if cycle == late else 50 * US)
        story.runs(timer, start, start + 2 * MS, writes=((raw, start + MS),))
        writes = ((out, start + 5 * MS),)
        story.runs(relay, start + 2 * MS, start + 6 * MS, reads=start + MS, writes=writes)
        if gated:
            story.gate(relay, start + MS, start + 2 * MS, start + 5 * MS, origin=start)
    began, lasted = stall
    story.event("machine_stall", MS + (late + 1) * PERIOD + began, 9, cpu=1, duration=lasted)
    found = analyse_latency(story.tables(), "/raw../out")
    return found.traversals["disturbed"].to_list()


@pytest.mark.parametrize(
    ("late_ns", "stall"),
    [
        (104 * MS + 200 * US, (0, 104 * MS)),  # it ended 0.2 ms before the callback's start
        (54 * MS + 200 * US, (-50 * MS, 104 * MS)),  # the timer was due in the middle of it
        (4 * MS, (2 * MS, 2 * MS)),
        (150 * MS, (1 * MS, 100 * MS)),
    ],
)
def test_a_stall_that_made_the_timer_late_disturbs_the_cycle(
    late_ns: int, stall: tuple[int, int]
) -> None:
    assert late_in_one_cycle(late_ns, stall) == [cycle == 10 for cycle in range(20)]


@pytest.mark.parametrize("stall", [(-104 * MS, 104 * MS), (-10 * MS, 10 * MS), (150 * MS, 20 * MS)])
def test_a_stall_while_no_timer_was_due_disturbs_none(stall: tuple[int, int]) -> None:
    """Also where it ends just before the callback begins, in time."""
    assert not any(late_in_one_cycle(50 * US, stall))


def test_what_a_gate_releases_is_looked_at_from_its_origin() -> None:
    """With the stamp of the callback as origin, the latency has no part of what was before."""
    assert not any(late_in_one_cycle(104 * MS + 200 * US, (0, 104 * MS), gated=True))


def test_several_missed_expiries_are_one_start() -> None:
    """Due at 300, 400 and 500, a timer that comes to run at 501 was due at 300."""
    starts = pl.Series([100, 200, 501, 600, 707, 800]) * MS
    due = timer_due(starts, 100 * MS).to_list()
    expected = [100, 200, 300, 600, 700, 800]
    assert [round(at / MS) for at in due] == expected
    assert due[0] == 100 * MS, "nothing is known of what was before"


def test_where_starts_show_no_phase_the_start_before_says_when_the_next_was_due() -> None:
    starts = pl.Series([0, 70, 140, 210, 400, 480, 550, 640]) * MS
    assert timer_due(starts, 100 * MS).to_list() == [
        at * MS for at in (0, 70, 140, 210, 310, 480, 550, 640)
    ]


def test_a_timer_that_always_starts_less_often_than_declared_is_not_always_late() -> None:
    starts = pl.Series([0, 300, 600, 900, 1350, 1500]) * MS
    due = timer_due(starts, 100 * MS).to_list()
    assert [round(at / MS) for at in due[1:4]] == [300, 600, 900]


def test_each_process_of_a_node_has_a_timer_of_its_own() -> None:
    """Started again, its timer expires 30 ms later in the period: these starts are not late."""
    story = Story()
    for pid, begin in ((1, 0), (2, 2_030 * MS)):
        node = story.node("/source", pid, begin)
        timer, topic = story.timer(node, 100 * MS, begin), story.publisher(node, "/t1", begin)
        for cycle in range(1, 20):
            start = begin + cycle * 100 * MS
            story.runs(timer, start, start + 2 * MS, writes=((topic, start + MS),))
            story.event("machine_stall", start - 30 * MS, 9, cpu=1, duration=25 * MS)
    found = analyse_latency(story.tables(), "/t1")
    assert found.statistics.count == 38
    assert found.statistics.disturbed == 0
