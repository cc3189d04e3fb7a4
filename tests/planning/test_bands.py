"""Band placement: exact, proven against trying out every placement; by swarm; on a whole plan."""

import itertools
import math
import random
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest

from chainshaper.planning.bands import (
    BandProblem,
    Placement,
    broken_constraint,
    choose_bands,
    counts_and_mean,
    place_bands,
    place_by_swarm,
    place_randomly,
    placement_curve,
    with_bands,
    with_long_slot,
)
from chainshaper.planning.chain_plan import ChainPlan, band_predictions, publish_slots, revised
from chainshaper.planning.shaping import plan_shaping, server_per_chain
from chainshaper.robot.gate import IntoOpenSlot
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000
LATENCIES = (np.random.default_rng(3).triangular(33, 68, 85, 2000) * MS).astype(np.int64)


class Tried(NamedTuple):
    """One placement that keeps every constraint, judged without the code under test."""

    ends: tuple[int, ...]
    total: int
    jitter: int
    gap: int


def every_placement(problem: BandProblem, bands: int) -> list[Tried]:
    """All placements on the grid, straight from the text of sections 3.3 and 4.1."""
    sample = problem.latencies_ns.tolist()
    slot, last = problem.publish_slot_ns, problem.last_end_ns
    found = []
    for first_ends in itertools.combinations(range(0, last, problem.grid_ns), bands - 1):
        ends = (*first_ends, last)
        gaps = [after - before for before, after in itertools.pairwise(ends)]
        if any(not gap > slot for gap in gaps) or (bands > 1 and not ends[0] - slot > min(sample)):
            continue
        if problem.max_gap_ns is not None and any(gap > problem.max_gap_ns for gap in gaps):
            continue
        early = slot if problem.into_open_slot == "next-slot" else 0  # in time for a slot's start
        published = [min(end for end in ends if latency <= end - early) for latency in sample]
        shares = [published.count(end) / len(sample) for end in ends]
        if problem.max_share is not None and max(shares) > problem.max_share + 1e-12:
            continue
        jitter = last - (ends[0] - slot)
        found.append(Tried(ends, sum(published), jitter, max(gaps, default=0)))
    return found


def random_problem(random: random.Random) -> tuple[BandProblem, int]:
    """A small problem; slots, gaps and caps are tight as often as not."""
    span, low, size = random.randint(2, 18), random.randint(0, 6), random.randint(2, 10)
    sample = [low + random.randint(0, span) for _ in range(size)]
    if random.random() < 0.3:  # few distinct values: plateaus and jumps of the distribution
        sample = [low + random.choice([0, span // 2, span]) for _ in range(size)]
    slot = random.choice([1, 1, 2, 3, random.randint(1, 8)])
    limits: dict[str, Any] = {}
    if random.random() < 0.6:
        limits["max_gap_ns"] = slot + random.choice([1, 1, 2, 3, random.randint(1, 12)])
    if random.random() < 0.4:
        shares = [0.2, 0.25, 1 / 3, 0.5, 0.6, 0.75, random.uniform(0.1, 1)]
        limits["max_share"] = random.choice(shares)
    limits["into_open_slot"] = random.choice(["at-once", "next-slot"])
    last, grid = max(sample) + random.randint(0, 3) + slot, random.choice([1, 1, 1, 2, 3])
    return BandProblem(np.array(sample), last, slot, grid, **limits), random.randint(1, 5)


@pytest.mark.parametrize("seed", range(2))
def test_the_optimum_is_that_of_trying_everything(seed: int) -> None:
    generator = random.Random(seed)
    feasible = tight = 0
    for _ in range(900):
        problem, bands = random_problem(generator)
        tried = every_placement(problem, bands)
        size = problem.latencies_ns.size
        if not tried:
            with pytest.raises((InputError, OperationError), match="cannot be placed"):
                place_bands(problem, bands)
            continue
        feasible += 1
        tight += len(tried) < 4
        by_ends = {one.ends: one for one in tried}
        placement = place_bands(problem, bands)
        least = min(one.total for one in tried)
        assert placement.mean_ns == least / size
        assert broken_constraint(problem, placement.slot_ends_ns) is None
        assert counts_and_mean(problem.ready_ns, placement.slot_ends_ns)[1] == placement.mean_ns
        best_jitter = min(one.jitter for one in tried if one.total == least)
        assert by_ends[placement.slot_ends_ns].jitter == best_jitter

        mean = math.ceil(least / size) + generator.choice([0, 1, 1, 2, 5])
        allowed = {one.ends: one for one in tried if one.total <= mean * size}
        calm = place_bands(problem, bands, minimise="jitter", mean_at_most_ns=mean)
        assert allowed[calm.slot_ends_ns].jitter == min(one.jitter for one in allowed.values())
        close = place_bands(problem, bands, minimise="gap", mean_at_most_ns=mean)
        assert allowed[close.slot_ends_ns].gap == min(one.gap for one in allowed.values())
    assert feasible > 320
    assert tight > 45


def test_the_curve_is_every_number_of_bands_at_once() -> None:
    generator = random.Random(7)
    for _ in range(150):
        problem, _ = random_problem(generator)
        alone = []
        for bands in range(1, 6):
            with suppress(InputError, OperationError):
                alone.append(place_bands(problem, bands))
        if alone:
            assert placement_curve(problem, 5) == alone
        else:
            with pytest.raises(OperationError):
                placement_curve(problem, 5)


EVEN = np.linspace(10 * MS, 50 * MS, 100).astype(np.int64)
THREE, FOUR = np.array([10, 20, 30]) * MS, np.array([40, 61, 70, 85]) * MS
LONG = plan_shaping(FOUR, 100 * MS, output="/t5")


def three(**wrong: Any) -> BandProblem:
    return BandProblem(THREE, **{"last_end_ns": 32 * MS, **wrong})


def even(bands: int, **limits: Any) -> Placement:
    return place_bands(BandProblem(EVEN, 52 * MS, **limits), bands)


def banded(bands: int | Literal["auto"], **how: Any) -> ChainPlan:
    return with_bands(LONG, FOUR, bands, **how)


@pytest.mark.parametrize(
    ("attempt", "words"),
    [
        # The constraint that binds is named.
        (lambda: even(4, grid_ns=30 * MS), "grid of 30 ms is too coarse"),
        (lambda: even(3, max_gap_ns=1_000_001), "within 1.000001 ms"),
        (lambda: even(3, max_share=0.1), r"10\.0% of the executions"),
        (lambda: even(1, max_share=0.5), r"50\.0% of the executions"),
        (lambda: even(3, max_share=0.34, max_gap_ns=5 * MS), "exclude each other|34.0%"),
        *(
            (
                partial(place_bands, three(grid_ns=MS), 2, minimise=goal, mean_at_most_ns=20 * MS),
                "the best is 24 ms",
            )
            for goal in ("mean", "jitter", "gap")
        ),
        (lambda: three(publish_slot_ns=0), "longer than 0 ms"),
        (lambda: three(grid_ns=0), "longer than 0 ms"),
        (lambda: three(max_gap_ns=MS), "not longer than the publish slot"),
        (lambda: three(max_share=0.0), "above 0"),
        (lambda: three(max_share=float("nan")), "above 0"),
        (lambda: three(last_end_ns=29 * MS), "before the longest latency"),
        (lambda: three(last_end_ns=2**61), "overflow"),
        (lambda: place_bands(three(), 2, minimise="jitter"), "which average"),
        (lambda: place_bands(three(grid_ns=1, last_end_ns=2000 * MS), 2), "coarser than 1 ns"),
        # Slots of 1 ms that are more than 1 ms apart:
        *(
            (partial(place, three(), bands), words)
            for place in (place_bands, place_by_swarm, place_randomly)
            for bands, words in ((0, "one band at least"), (22, "room for 21 publish slots"))
        ),
        (lambda: banded(3, solver="pso", mean_at_most_ns=80 * MS), "needs the exact solver"),
        (lambda: banded("auto", solver="random"), "only the exact solver"),
        (lambda: banded("auto", least_gain=2), "the least gain is a share"),
        (lambda: with_bands(server_per_chain(LONG), FOUR, 2), "chain has no publish slot"),
        (lambda: with_long_slot(LONG, FOUR, -1), "may start from 0 ms to 86 ms"),
        (lambda: with_long_slot(LONG, FOUR, 86 * MS + 1), "may start from 0 ms to 86 ms"),
        (lambda: place_by_swarm(_problem(1), 40, 1), "use the exact solver"),
        (lambda: place_randomly(_problem(1, max_gap_ns=1_001_000), 3), "last random draw ended"),
        (lambda: place_randomly(_problem(1, grid_ns=20 * MS), 10), "grid of 20 ms is too coarse"),
    ],
)
def test_what_cannot_be_placed_is_refused(attempt: Callable[[], object], words: str) -> None:
    with pytest.raises((InputError, OperationError), match=words):
        attempt()


def test_one_band_ends_where_the_last_does() -> None:
    for place in (place_bands, place_by_swarm, place_randomly):
        assert place(three(), 1).slot_ends_ns == (32 * MS,)


def _plan() -> ChainPlan:
    return plan_shaping(LATENCIES, 100 * MS, output="/t5", publisher="/n5", nodes=["/n5"])


def test_bands_are_enough_when_another_gains_little() -> None:
    choice = choose_bands(_plan(), LATENCIES)
    means = [placement.mean_ns for placement in choice.curve]
    bands = len(choice.chosen.slot_ends_ns)
    gains = [(before - after) / before for before, after in itertools.pairwise(means)]
    assert all(gain >= 0.02 for gain in gains[: bands - 1])
    assert 0 <= gains[bands - 1] < 0.02
    assert len(publish_slots(with_bands(_plan(), LATENCIES, "auto"))) == bands
    every = choose_bands(_plan(), LATENCIES, least_gain=1e-9)
    assert every.chosen == every.curve[-1]
    assert every.reason == "stopped at 12: more bands are not tried"
    # Where a band may not have more than 30 %, the curve begins with four.
    limited = choose_bands(_plan(), LATENCIES, least_gain=0.9, max_share=0.3)
    assert limited.reason.startswith("stopped at 4: another band would lower")


def test_bands_without_jitter_are_for_what_is_ready_when_they_begin() -> None:
    # Δ is 5 ms: the first slot at once is best from 10 ms and 1 µs on, open at 14 ms still.
    latencies = np.array([10, 10, 14, 50]) * MS
    ways: tuple[IntoOpenSlot, ...] = ("at-once", "next-slot")
    shaped = plan_shaping(latencies, 100 * MS, publish_slot_ns=5 * MS)
    planned = {way: with_bands(revised(shaped, into_open_slot=way), latencies, 2) for way in ways}
    assert planned["at-once"].predicted.shares == (0.75, 0.25)
    assert planned["at-once"].predicted.jitter_ns == 56 * MS - 10_001_000
    strict = planned["next-slot"]
    ((start, end), last) = publish_slots(strict)
    assert (start, last) == (14 * MS, (51 * MS, 56 * MS)), "what comes as it begins is in time"
    assert strict.predicted.shares == (0.75, 0.25)
    assert strict.predicted.mean_ns == (3 * end + last[1]) // 4
    assert strict.predicted.jitter_ns == last[0] - start
    assert [band.jitter_ns for band in band_predictions(strict)] == [0, 0]
    edited = with_bands(strict, latencies, 2, max_share=0.5)
    assert edited.predicted.shares == (0.5, 0.5)
    gated = plan_shaping(
        latencies, 100 * MS, output="/t", publication="asynchronous", publisher="/n"
    )
    other = revised(plan_shaping(latencies, 100 * MS, output="/t"), policy="let-per-chain")
    for plan in (gated, other):
        with pytest.raises(InputError, match="into_open_slot: only a shaping node sees when"):
            revised(plan, into_open_slot="next-slot")


def test_goals_and_limits_reach_the_placement() -> None:
    plan = _plan()
    ends = [end for _, end in publish_slots(with_bands(plan, LATENCIES, 4, max_gap_ns=5 * MS))]
    assert max(np.diff(ends)) <= 5 * MS
    assert max(with_bands(plan, LATENCIES, 4, max_share=0.3).predicted.shares) <= 0.3
    banded = with_bands(plan, LATENCIES, 3)
    least, slots = banded.predicted, publish_slots(banded)
    goal: dict[str, Any] = {"minimise": "jitter", "mean_at_most_ns": least.mean_ns + 2 * MS}
    calm = with_bands(plan, LATENCIES, 3, **goal).predicted
    assert calm.jitter_ns < least.jitter_ns
    assert calm.mean_ns <= least.mean_ns + 2 * MS
    # Bands replace the publish slot, the last of them, and nothing else.
    assert (len(slots), slots[-1:], banded.servers[0]) == (3, publish_slots(plan), plan.servers[0])
    assert least.jitter_ns == slots[-1][1] - slots[0][0]
    unchanged = {"servers", "predicted"}
    assert banded.model_dump(exclude=unchanged) == plan.model_dump(exclude=unchanged)


def test_one_long_slot_trades_jitter_for_the_average() -> None:
    long = with_long_slot(LONG, FOUR, 62 * MS)
    assert long.policy == "one-long-slot"
    assert publish_slots(long) == ((62 * MS, 87 * MS),)
    assert long.predicted.mean_ns == (62 + 62 + 70 + 85) * MS // 4
    assert long.predicted.jitter_ns == 25 * MS  # as the paper's three bands, earlier on average


def _problem(seed: int, **limits: Any) -> BandProblem:
    latencies = np.random.default_rng(seed).normal(67 * MS, 9 * MS, 400)
    return BandProblem(latencies.clip(33 * MS, 85 * MS).astype(np.int64), 87 * MS, **limits)


def test_the_swarm_is_repeatable_and_leaves_no_traces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyswarms")
    monkeypatch.chdir(tmp_path)
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    assert place_by_swarm(_problem(1), 3, 1) == place_by_swarm(_problem(1), 3, 1)
    assert np.random.random() == expected
    assert not list(tmp_path.iterdir())


def test_the_exact_placement_is_never_worse_than_swarm_or_chance() -> None:
    pytest.importorskip("pyswarms")
    compared = 0
    for seed, max_gap in enumerate([None, 20 * MS, 2 * MS] * 4):
        bands, problem = 2 + seed % 7, _problem(seed, max_gap_ns=max_gap)
        for place in [place_by_swarm] if max_gap else [place_by_swarm, place_randomly]:
            with suppress(OperationError):
                other = place(problem, bands, seed)
                assert broken_constraint(problem, other.slot_ends_ns) is None
                assert place_bands(problem, bands).mean_ns <= other.mean_ns
                compared += 1
    assert compared > 8


def test_random_placements_keep_the_constraints_and_reach_everywhere() -> None:
    problem = BandProblem(np.array([0, 10]), 12, publish_slot_ns=1, grid_ns=1)
    seen = {place_randomly(problem, 3, seed).slot_ends_ns for seed in range(300)}
    assert seen == {(one, two, 12) for one in range(2, 11) for two in range(one + 2, 11)}
    assert place_randomly(_problem(1), 3, 8) == place_randomly(_problem(1), 3, 8)
