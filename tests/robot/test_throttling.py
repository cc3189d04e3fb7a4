"""The throttler's rule `first`: worked by hand, what may never be, and the same in C++."""

import random
import subprocess
from itertools import accumulate, combinations, pairwise
from pathlib import Path

import pytest
from cpp_program import compiled
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.robot.throttling import FirstOfPeriod

P, EARLY = 100, 20
NS_PERIOD = 100_000_000

# When messages come, and which of them pass. The period is 100, so a message may be 20 early.
TABLE: dict[str, tuple[list[int], list[int]]] = {
    "a regular input passes whole": ([7, 107, 207, 307], [7, 107, 207, 307]),
    "late ones too, and those behind them": ([0, 119, 200, 319, 400], [0, 119, 200, 319, 400]),
    # The paper's interval: 25 late, the next in time, so 75 apart.
    "one that comes too soon behind a late one does not": ([0, 125, 200, 300], [0, 125, 300]),
    "the interval is four fifths of a period": ([0, 79, 80, 179, 180], [0, 80, 180]),
    "of many the first of each period": ([*range(0, 400, 10)], [0, 80, 180, 280, 380]),
    "twice as fast: every second": ([*range(0, 450, 50)], [0, 100, 200, 300, 400]),
    # Eleven periods behind the first they come 22 before they are due: one is left out.
    "2 % too fast: one in 50 is left out": (
        [*range(0, 98 * 120, 98)],
        [n * 98 for n in range(120) if n not in (11, 61, 111)],
    ),
    "slower than the period: whole": ([*range(0, 900, 130)], [*range(0, 900, 130)]),
    # What was due at 100 did not come; what comes at 185 is in time, and the next due at 285.
    "behind a pause periods begin anew": ([0, 185, 264, 265, 364], [0, 185, 265]),
    "just not yet anew: 179 counts for 100": ([0, 179, 258, 259, 279], [0, 179, 259]),
}


def passed(arrivals: list[int], period: int = P) -> list[int]:
    rule = FirstOfPeriod(period)
    return [now for now in arrivals if rule.passes(now)]


@pytest.mark.parametrize("name", TABLE)
def test_what_passes_worked_by_hand(name: str) -> None:
    arrivals, wanted = TABLE[name]
    assert passed(arrivals) == wanted


@given(st.lists(st.integers(0, 2 * P)))
def test_no_two_are_closer_than_the_interval_and_no_more_than_one_comes_in_a_period(
    gaps: list[int],
) -> None:
    found = passed([*accumulate(gaps, initial=5)])
    assert found[0] == 5
    assert all(after - before >= P - EARLY for before, after in pairwise(found))
    for (first, start), (last, end) in combinations(enumerate(found), 2):
        assert end - start > (last - first - 1) * P


@given(st.lists(st.integers(P, 3 * P)), st.lists(st.none() | st.integers(0, EARLY)))
def test_an_input_that_is_slower_or_late_by_a_fifth_at_most_passes_whole(
    gaps: list[int], delays: list[int | None]
) -> None:
    slower = [*accumulate(gaps, initial=0)]
    assert passed(slower) == slower
    late = [n * P + delay for n, delay in enumerate(delays) if delay is not None]
    assert passed(late) == late


@given(st.lists(st.integers(P - EARLY, P)))
def test_an_input_a_little_faster_is_not_halved_each_period_has_its_message(
    gaps: list[int],
) -> None:
    arrivals = [*accumulate(gaps, initial=0)]
    periods = [(now + EARLY) // P for now in passed(arrivals)]
    assert periods == [*range((arrivals[-1] + EARLY) // P + 1)]


def test_the_rule_in_cpp_passes_the_same(tmp_path: Path) -> None:
    draw = random.Random(20241122)
    cases = [(P, arrivals) for arrivals, _ in TABLE.values()]
    for _ in range(2000):
        period = draw.choice([1, 3, 7, P, NS_PERIOD])
        longest = draw.choice([period // 8, period, 2 * period])
        gaps = [draw.randint(0, longest + 1) for _ in range(draw.randint(0, 40))]
        cases.append((period, [*accumulate(gaps, initial=draw.randint(0, 10 * period))]))
    program = compiled(Path(__file__).parent / "throttled.cpp", tmp_path)
    lines = "\n".join(" ".join(map(str, (period, *arrivals))) for period, arrivals in cases)
    run = subprocess.run(
        [program], input=lines, capture_output=True, text=True, check=True, timeout=60
    )
    answers = run.stdout.splitlines()
    assert len(answers) == len(cases)
    for (period, arrivals), answer in zip(cases, answers, strict=True):
        found = [now for now, digit in zip(arrivals, answer, strict=True) if digit == "1"]
        assert found == passed(arrivals, period), (period, arrivals)
