"""How far clocks are apart: against a linear program, and against clocks that are known."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import linprog

from chainshaper.analysis import clocks
from chainshaper.analysis.clocks import ContradictingClocksError, OffsetBounds, corridor, steps

Times = npt.NDArray[np.int64]
Offset = Callable[[Times], Times]
SECOND = 1_000_000_000
DELAY_NS = 200_000


def offset_of(
    ppm: float, jumps: Sequence[tuple[int, int]] = (), wave_ns: int = 0, wave_s: int = 600
) -> Offset:
    """Return by how much a clock is ahead, at times of the reference."""

    def offset(times: Times) -> Times:
        waves = wave_ns * np.sin(times / SECOND * 2 * np.pi / wave_s)
        ahead = 7 * SECOND + times * (ppm / 1e6) + waves
        for at, by in jumps:
            ahead = ahead + np.where(times >= at, by, 0)
        return np.asarray(np.rint(ahead), dtype=np.int64)

    return offset


def messages(
    offset: Offset, count: int, seconds: int, seed: int
) -> tuple[OffsetBounds, OffsetBounds, Times, Times]:
    """Return the bounds of messages both ways, and the events of host and reference."""
    random = np.random.default_rng(seed)
    sent = np.sort(random.integers(0, seconds * SECOND, count))
    took = sent + DELAY_NS + random.exponential(DELAY_NS / 2, count).astype(np.int64)
    there = random.random(count) < 0.5
    arrived, left = (took + offset(took))[there], (sent + offset(sent))[~there]
    upper = OffsetBounds(sent[there], arrived - sent[there])
    lower = OffsetBounds(took[~there], left - took[~there])
    of_host = np.sort(np.concatenate((arrived, left)))
    return upper, lower, of_host, np.sort(np.concatenate((sent[there], took[~there])))


def highest_and_lowest(
    upper: OffsetBounds, lower: OffsetBounds, at: Sequence[int], rates: tuple[float, float]
) -> list[tuple[float, float]]:
    """Solve the same as a linear program: one unknown for the offset at each bound, and at ``at``.

    Between two of them the offset rises by what the rates allow.
    """
    times = np.unique(np.concatenate((upper.times, lower.times, np.array(at))))
    row = {int(time): number for number, time in enumerate(times)}
    base = int(lower.offsets[0])
    limits = [[-np.inf, np.inf] for _ in times]
    for time, offset in zip(upper.times, upper.offsets, strict=True):
        limit = limits[row[int(time)]]
        limit[1] = min(limit[1], float(offset - base))
    for time, offset in zip(lower.times, lower.offsets, strict=True):
        limit = limits[row[int(time)]]
        limit[0] = max(limit[0], float(offset - base))
    rise = np.diff(np.eye(len(times)), axis=0)
    apart = np.diff(times).astype(np.float64)
    matrix = np.concatenate((rise, -rise))
    most = np.concatenate((rates[1] * apart, -rates[0] * apart))
    found = []
    for time in at:
        cost = np.zeros(len(times))
        cost[row[time]] = 1.0
        low, high = (
            linprog(sign * cost, matrix, most, bounds=limits, method="highs") for sign in (1, -1)
        )
        found.append((low.fun + base, base - high.fun))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_the_rates_of_all_lines_that_fit_are_those_of_a_linear_program(seed: int) -> None:
    upper, lower, *_ = messages(offset_of(40.0 - 20 * seed), 200, 30, seed)
    (piece,) = corridor(upper, lower, wander=0.0).pieces
    base = int(lower.offsets[0])
    one = np.ones((len(upper.times), 1))
    # Height and rate in ns a second, below the upper bounds and above the lower ones.
    above = np.hstack((one, upper.times[:, None] / SECOND))
    below = -np.hstack((np.ones((len(lower.times), 1)), lower.times[:, None] / SECOND))
    most = np.concatenate((upper.offsets - base, -(lower.offsets - base))).astype(np.float64) + 1
    rates = [
        sign * linprog((0, sign), np.vstack((above, below)), most, bounds=(None, None)).fun / 1e9
        for sign in (1, -1)
    ]
    assert piece.rates == pytest.approx(rates, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_corridor_is_that_of_a_linear_program(seed: int) -> None:
    upper, lower, *_ = messages(offset_of(30.0), 50, 20, seed)
    found = corridor(upper, lower)
    (piece,) = found.pieces
    at = [int(time) for time in np.linspace(SECOND, 19 * SECOND, 5)]
    expected = np.array(highest_and_lowest(upper, lower, at, piece.rates))
    above, below = found.errors(np.array(at, dtype=np.int64))
    line = piece.line(np.array(at, dtype=np.int64))
    # A cell is as wide as it is at its widest: by its length, at rates a few ppm apart, wider.
    cell_ns = 20 * SECOND / 4096 * (piece.rates[1] - piece.rates[0]) + 10
    assert (line + above >= expected[:, 1] - 1).all()
    assert (line - below <= expected[:, 0] + 1).all()
    assert line + above == pytest.approx(expected[:, 1], abs=cell_ns)
    assert line - below == pytest.approx(expected[:, 0], abs=cell_ns)


CLOCKS = {
    "drift": offset_of(50.0),
    "no drift": offset_of(0.0),
    "a jump forwards": offset_of(50.0, [(300 * SECOND, 100_000_000)]),
    "a jump back": offset_of(-50.0, [(300 * SECOND, -100_000_000)]),
    "small jumps": offset_of(-20.0, [(200 * SECOND, 1_000_000), (400 * SECOND, -1_500_000)]),
    "a rate that changes": offset_of(10.0, wave_ns=500_000),
}


@pytest.mark.parametrize("kind", CLOCKS)
@pytest.mark.parametrize("seed", range(2))
def test_the_truth_lies_in_the_interval(kind: str, seed: int) -> None:
    offset = CLOCKS[kind]
    upper, lower, of_host, of_reference = messages(offset, 20_000, 600, seed)
    found = corridor(upper, lower, host_events=of_host, reference_events=of_reference)
    true = np.random.default_rng(seed).integers(0, 600 * SECOND, 100_000)
    converted = found.converted(true + offset(true))
    earlier, later = found.errors(converted)
    inside = (true >= converted - earlier) & (true <= converted + later)
    assert inside.mean() >= 0.999
    assert np.median(earlier + later) <= 2 * 1.1 * DELAY_NS, "of the shortest one-way delay"
    # The host's own events keep their order.
    assert (np.diff(found.converted(of_host)) >= 0).all()


def test_jumps_are_found_where_they_were() -> None:
    jumps = [(200 * SECOND, 5_000_000), (400 * SECOND, -3_000_000)]
    upper, lower, of_host, of_reference = messages(offset_of(20.0, jumps), 20_000, 600, 1)
    found = list(steps(corridor(upper, lower, host_events=of_host, reference_events=of_reference)))
    assert len(found) == 2
    for (since, until, by), (at, truly) in zip(found, jumps, strict=True):
        assert since <= at <= until
        assert by == pytest.approx(truly, abs=DELAY_NS)
    upper, lower, *_ = messages(CLOCKS["a rate that changes"], 20_000, 600, 1)
    assert not list(steps(corridor(upper, lower))), "a rate that changes is no jump"


def test_clocks_that_contradict_each_other() -> None:
    upper, lower, *_ = messages(offset_of(0.0), 2000, 600, 1)
    random = np.random.default_rng(1)
    wrong = OffsetBounds(
        lower.times, lower.offsets + random.integers(-SECOND, SECOND, len(lower.times))
    )
    with pytest.raises(ContradictingClocksError, match="no offset that changes by less than 1000"):
        corridor(upper, wrong)


def test_two_messages_are_enough_and_say_little() -> None:
    upper = OffsetBounds(np.array([0]), np.array([500]))
    lower = OffsetBounds(np.array([1000]), np.array([-500]))
    found = corridor(upper, lower)
    earlier, later = found.errors(np.array([0, 1000, SECOND]))
    line = found.pieces[0].line(np.array([0, 1000]))
    assert (line + earlier[:2] >= [500, 499]).all()
    assert (line - later[:2] <= [-499, -500]).all()
    assert earlier[2] >= clocks.MOST_RATE * 0.99 * SECOND, "far from them all is uncertain"
