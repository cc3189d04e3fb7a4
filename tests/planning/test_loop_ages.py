"""Ages of a loop's data: by hand, and against every sequence of a chain and a loop, tried out."""

import math
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning.loop_ages import (
    LoopTimes,
    ages,
    at_any_phase,
    later_without_straddling,
    move_into_step,
    start_in_step,
    straddles,
)


def tried_out(times: LoopTimes) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int], bool]:
    """The same as :func:`ages`, from all times at which messages are stored and instances begin.

    An instance begins with any of its jitter; of the messages around it, each is stored at any of
    its times. What is possible in one place of the hyper-period is looked at by itself, as all of
    these times are independent.
    """
    cycle, period, jitter = times.cycle_ns, times.period_ns, times.jitter_ns
    assert times.phase_ns is not None
    earliest, latest = times.stored_ns
    hyper_period = math.lcm(cycle, period)
    stores = range(earliest, latest + 1)
    firsts, every, used, by_chance = set[int](), set[int](), set[int](), False
    last = hyper_period + latest + cycle
    far = range((earliest - times.phase_ns) // period - 2, (last - times.phase_ns) // period + 3)
    for message in range(hyper_period // cycle):
        begun = message * cycle
        for stored, after in product(stores, stores):
            # The instances that may use it: those that begin behind it and before the next one is.
            can, must = 0, 0
            for number in far:
                starts = range(
                    times.phase_ns + number * period, times.phase_ns + number * period + jitter + 1
                )
                using = [
                    start for start in starts if begun + stored < start <= begun + cycle + after
                ]
                can += bool(using)
                must += len(using) == len(starts)
                every |= {start - begun for start in using}
                # It is the first use where the instance before may have come too early.
                before_comes_early = times.phase_ns + (number - 1) * period <= begun + stored
                firsts |= {start - begun for start in using if before_comes_early}
            used |= {can, must}
        for number in far:
            begins = times.phase_ns + number * period
            by_chance |= begins <= begun + latest and begins + jitter > begun + earliest
    return (min(firsts), max(firsts)), (min(every), max(every)), (min(used), max(used)), by_chance


SMALL = st.builds(
    lambda cycle, period, phase, earliest, apart, jitter: LoopTimes(
        cycle_ns=cycle,
        period_ns=period,
        phase_ns=phase,
        stored_ns=(earliest, earliest + apart % cycle),
        jitter_ns=jitter % period,
    ),
    st.integers(1, 8),
    st.integers(1, 16),
    st.integers(0, 20),
    st.integers(0, 10),
    st.integers(0, 4),
    st.integers(0, 3),
)


@settings(deadline=None, max_examples=150)
@given(SMALL)
def test_ages_are_what_comes_of_all_possible_times(times: LoopTimes) -> None:
    computed = ages(times)
    assert (
        computed.first_ns,
        computed.every_ns,
        computed.uses,
        computed.straddled,
    ) == tried_out(times)


@settings(deadline=None, max_examples=150)
@given(SMALL)
def test_the_nearest_time_that_no_instance_straddles_is_found(times: LoopTimes) -> None:
    later = later_without_straddling(times)

    def moved(by: int) -> LoopTimes:
        earliest, latest = times.stored_ns
        return LoopTimes(
            times.cycle_ns,
            (earliest + by, latest + by),
            times.period_ns,
            times.phase_ns,
            times.jitter_ns,
        )

    free = [by for by in range(times.common_ns) if not straddles(moved(by))]
    assert later == (free[0] if free else None)


@settings(deadline=None, max_examples=100)
@given(SMALL)
def test_any_phase_bounds_all_phases(times: LoopTimes) -> None:
    whichever = ages(at_any_phase(times))
    of_phases = [
        ages(LoopTimes(times.cycle_ns, times.stored_ns, times.period_ns, phase, times.jitter_ns))
        for phase in range(times.common_ns)
    ]
    for bounds in ("first_ns", "every_ns", "uses"):
        lows, highs = zip(*(getattr(known, bounds) for known in of_phases), strict=True)
        assert getattr(whichever, bounds) == (min(lows), max(highs)), bounds


MS = 1_000_000


@pytest.mark.parametrize(
    ("period", "first", "every", "uses"),
    [
        (10, (14, 14), (14, 24), (2, 2)),  # k instances in a cycle: the first use is constant
        (1, (13, 13), (13, 32), (20, 20)),
        (20, (14, 14), (14, 14), (1, 1)),
        (40, (14, 14), (14, 14), (0, 1)),  # every second message is never used
        (15, (14, 24), (14, 29), (1, 2)),  # no multiple: multiples of 5 ms
        (30, (14, 24), (14, 24), (0, 1)),
    ],
)
def test_ages_by_hand(
    period: int, first: tuple[int, int], every: tuple[int, int], uses: tuple[int, int]
) -> None:
    """A chain of 20 ms stores between 12 and 12.5 ms; the loop begins 14 ms after a cycle."""
    stored = (12 * MS, 12 * MS + MS // 2)
    known = ages(LoopTimes(20 * MS, stored, period * MS, 14 * MS))
    assert (known.first_ns, known.every_ns, known.uses, known.straddled) == (
        (first[0] * MS, first[1] * MS),
        (every[0] * MS, every[1] * MS),
        uses,
        False,
    )


def test_a_slot_that_straddles_the_read_gives_two_ages() -> None:
    """Messages are stored at 18.9 to 25.9 ms of 20: of a loop every 10 ms some see old data."""
    straddled = LoopTimes(20 * MS, (18_900_000, 25_900_000), 10 * MS, 5 * MS)
    known = ages(straddled)
    assert known.straddled
    assert known.first_ns == (25 * MS, 35 * MS)
    assert later_without_straddling(straddled) == 25 * MS - 18_900_000


def test_slot_and_loop_get_into_step() -> None:
    """The loop begins at 3 ms and every 10 ms; a slot from 12 ms on is to lie 1 ms before it."""
    assert start_in_step((12 * MS, 30 * MS), MS, 3 * MS, 10 * MS) == 12 * MS
    assert start_in_step((12 * MS + 1, 30 * MS), MS, 3 * MS, 10 * MS) == 22 * MS
    # The cycle of 20 ms ends before: the message waits for the instance of 23 ms.
    assert start_in_step((12 * MS + 1, 19 * MS), MS, 3 * MS, 10 * MS) == 19 * MS
    assert move_into_step(15 * MS, MS, 3 * MS, 10 * MS) == 3 * MS
    assert move_into_step(15 * MS, MS, 6 * MS, 10 * MS) == 0
