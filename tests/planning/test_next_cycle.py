"""A slot at the end of a cycle and what it costs the next instance: by hand, by brute force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.planning.margins import planned_margin
from chainshaper.planning.next_cycle import (
    NextCycle,
    latencies_behind_slot,
    latency_with_fewest_late,
)
from chainshaper.robot.gate import OVERRUNS, Overrun
from chainshaper.values.plan_choices import Wishes

MS = 1_000_000


def behind(
    measured: list[int], in_time: int, work: int, overrun: Overrun, cycle: int = 100
) -> list[int]:
    """Latencies behind a slot that begins 1 after the longest latency in time."""
    following = NextCycle(cycle, 1, work, overrun)
    return list(latencies_behind_slot(np.array(measured), in_time, 1, following))


@pytest.mark.parametrize(
    ("overrun", "latencies"),
    [
        # The second output leaves at 99, and the core is free at 104, as it was recorded.
        ("publish", [60, 99, 60, 60]),
        # It leaves in the slot of the third cycle, at 95, with that one's: free at 105.
        ("wait", [60, 99, 60, 65]),
        ("discard", [60, 99, 60, 60]),
    ],
)
def test_what_a_late_output_does_to_the_next_ones(overrun: Overrun, latencies: list[int]) -> None:
    assert behind([60, 99, 60, 60], in_time=94, work=5, overrun=overrun) == latencies


@pytest.mark.parametrize("overrun", OVERRUNS)
def test_a_slot_with_room_changes_no_latency(overrun: Overrun) -> None:
    measured = [60, 89, 95, 110, 70]
    assert behind(measured, in_time=89, work=5, overrun=overrun) == measured


def test_a_slot_without_room_delays_each_next_instance() -> None:
    # The slot is at 98, so the core is free at 103: 3 into the next cycle. The third output is late
    # by that, and leaves at 98: in the recording its work reached as far, from 95 to 100.
    assert behind([60, 60, 95, 60], in_time=97, work=5, overrun="publish") == [60, 63, 98, 63]
    # Recorded at 97, its work had reached 2 into the next cycle already.
    assert behind([60, 60, 97, 60], in_time=97, work=5, overrun="publish") == [60, 63, 100, 63]


def test_fewest_late_decides_where_there_is_no_room() -> None:
    """Slots behind 91 have room. The one behind 97 would make all 93 to 97 late by its work."""
    measured = np.array([91] * 50 + [94, 95, 95, 96, 96, 97] * 5)
    tight = NextCycle(100, 1, 8, "publish")
    assert latency_with_fewest_late(measured, 91, 91, 1, tight) == 91, "it has room"
    chosen = latency_with_fewest_late(measured, 97, 91, 1, tight)
    assert chosen == fewest_late(measured.tolist(), 97, 91, 1, tight)
    roomy = tight._replace(work_ns=2)
    assert latency_with_fewest_late(measured, 97, 91, 1, roomy) == 97


def late_by_hand(measured: list[int], in_time: int, behind_ns: int, following: NextCycle) -> int:
    """One cycle after the other, on one time axis."""
    cycle, work = following.cycle_ns, following.work_ns
    late, free_at, recorded_free_at, in_gate = 0, 0, 0, 0
    for number, latency in enumerate(measured):
        begin = number * cycle
        done = begin + latency + max(0, max(0, free_at - begin) - max(0, recorded_free_at - begin))
        recorded_free_at = begin + latency + work
        slot = begin + in_time + behind_ns
        free_at, in_gate_now = done, 0
        in_slot = in_gate
        if done <= begin + in_time:
            in_slot += 1
        else:
            late += 1
            if following.overrun == "publish":
                free_at = done + work
            elif following.overrun == "wait":
                in_gate_now = 1
        if in_slot:
            free_at = max(free_at, slot + in_slot * work)
        in_gate = in_gate_now
    return late


def fewest_late(
    measured: list[int], covered: int, least: int, behind_ns: int, following: NextCycle
) -> int:
    if covered + behind_ns + following.work_ns <= following.cycle_ns:
        return covered
    latest = following.latest_slot_ns - behind_ns
    late = {covered: late_by_hand(measured, covered, behind_ns, following)}
    for latency in sorted(set(measured)):
        if least <= latency <= latest:
            late.setdefault(latency, late_by_hand(measured, latency, behind_ns, following))
    best = min(late.values())
    return covered if late[covered] == best else min(at for at in late if late[at] == best)


@given(
    measured=st.lists(st.integers(50, 130), min_size=1, max_size=40),
    covered=st.integers(60, 98),
    work=st.integers(0, 20),
    overrun=st.sampled_from(OVERRUNS),
)
def test_the_choice_is_that_of_brute_force(
    measured: list[int], covered: int, work: int, overrun: Overrun
) -> None:
    following = NextCycle(100, 1, work, overrun)
    chosen = latency_with_fewest_late(np.array(measured), covered, 50, 1, following)
    assert chosen == fewest_late(measured, covered, 50, 1, following)


def test_a_margin_counts_what_its_slot_delays() -> None:
    """299 cycles cover 1 % by their longest, at 98 ms, whose slot delays all others by 2 ms."""
    latencies = np.full(299, 60 * MS)
    latencies[100], latencies[200] = 98 * MS, 97 * MS
    following = NextCycle(100 * MS, MS, 3 * MS, "publish")
    undisturbed = np.full(297, 60 * MS)
    alone = planned_margin(undisturbed, latencies, Wishes())
    assert alone.stalls_ns == 38 * MS
    assert alone.overrun_probability == 0.01
    planned = planned_margin(undisturbed, latencies, Wishes(), following=following)
    assert planned.stalls_ns == 38 * MS, "two are late with either slot: it stays"
    assert planned.overrun_probability is not None
    assert planned.overrun_probability > 0.01
