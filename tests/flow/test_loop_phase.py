"""Where a loop is, from its starts: known phases and drifts, with lateness, gaps and restarts."""

import random

import pytest

from chainshaper.flow.loop_phase import FEWEST, RESTARTED, PhaseTrack, phase_of

MS = 1_000_000
PERIOD = 10 * MS


def starts(
    count: int,
    *,
    first_ns: int = 123_456_789_000,
    ppm: float = 0.0,
    late_ns: int = 0,
    missing: float = 0.0,
    seed: int = 1,
) -> list[int]:
    """Starts of a loop whose clock is off, each late by a drawn time, and some of them missing."""
    draw = random.Random(seed)
    return [
        first_ns + round(turn * PERIOD * (1 + ppm * 1e-6)) + round(draw.expovariate(1) * late_ns)
        for turn in range(count)
        if draw.random() >= missing
    ]


@pytest.mark.parametrize("ppm", [-200.0, -50.0, 0.0, 50.0, 200.0])
@pytest.mark.parametrize(("late_ns", "missing"), [(0, 0.0), (20_000, 0.2)])
def test_phase_and_drift_are_found(ppm: float, late_ns: int, missing: float) -> None:
    seen = starts(2_000, ppm=ppm, late_ns=late_ns, missing=missing)
    phase = phase_of(seen, PERIOD)
    assert phase is not None
    assert phase.drift_ppm == pytest.approx(ppm, abs=1.0)
    exact = starts(2_000, ppm=ppm)
    for turn in (0, 700, 1_999):  # and everything else lies on the line between them
        assert abs(phase.near(exact[turn]) - exact[turn]) <= 2 * late_ns + 50
    assert phase.spread_ns <= 8 * late_ns + 10
    assert phase.phase_ns == phase.at_ns % PERIOD


def test_a_start_that_is_late_moves_nothing() -> None:
    seen = starts(101)
    seen[50] += 4 * MS
    phase, undisturbed = phase_of(seen, PERIOD), phase_of(starts(101), PERIOD)
    assert phase is not None and undisturbed is not None
    assert (phase.at_ns, phase.drift_ppm) == (undisturbed.at_ns, undisturbed.drift_ppm)


def test_what_is_no_loop_of_the_period_has_no_phase() -> None:
    draw = random.Random(1)
    assert phase_of(starts(FEWEST - 1), PERIOD) is None
    assert phase_of([draw.randrange(10**10) for _ in range(100)], PERIOD) is None
    assert phase_of(sorted(draw.randrange(10**10) for _ in range(100)), PERIOD) is None
    assert phase_of(starts(100, ppm=5_000), PERIOD) is None


def test_a_track_follows_a_drift() -> None:
    track, seen = PhaseTrack(PERIOD), starts(6_000, ppm=50, late_ns=10_000)
    for at in range(0, 6_000, 10):
        track.saw(seen[at : at + 10])
        if at > 200:
            assert track.phase is not None
            assert abs(track.phase.near(seen[at + 9]) - seen[at + 9]) < 150_000
    assert track.phase is not None
    assert track.phase.drift_ppm == pytest.approx(50, abs=1)
    assert track.restarts == 0


def test_a_loop_that_starts_elsewhere_is_measured_anew() -> None:
    track, seen = PhaseTrack(PERIOD), starts(100)
    track.saw(seen)
    again = starts(100, first_ns=seen[-1] + PERIOD + 3 * MS)
    track.saw(again[: RESTARTED - 1])
    assert track.restarts == 0 and track.phase is not None
    assert track.phase.at_ns == seen[-1]
    track.saw(again[RESTARTED - 1 : RESTARTED])
    assert track.restarts == 1 and track.phase is None
    track.saw(again[RESTARTED:])
    assert track.phase is not None
    assert track.phase.at_ns == again[-1]


def test_a_stall_is_no_restart() -> None:
    track, seen = PhaseTrack(PERIOD), starts(100)
    track.saw(seen)
    track.saw([seen[-1] + turn * PERIOD + 4 * MS for turn in range(1, RESTARTED)])
    later = [seen[-1] + turn * PERIOD for turn in range(RESTARTED, 40)]
    track.saw(later)
    assert track.restarts == 0
    assert track.phase is not None and track.phase.at_ns == later[-1]
