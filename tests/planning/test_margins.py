"""Latencies from files, and margins: right where the truth is known, silent where it is not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bare_plans import MS
from numpy.typing import NDArray
from promises import held_of
from scipy import stats

from chainshaper.planning import (
    ChainPlan,
    Plan,
    PlanRequest,
    Profile,
    plan_chain,
    plan_shaping,
    plan_warnings,
)
from chainshaper.planning.late_shares import (
    covered_latency,
    cycles_needed,
    independent_cycles,
    late_share,
)
from chainshaper.planning.latencies import read_latencies
from chainshaper.planning.margins import derive_margin
from chainshaper.planning.plan_file import dump_plan
from chainshaper.planning.tails import fit_tail
from chainshaper.values.errors import InputError, OperationError


def _uniform_sums(seed: int, size: int = 4000) -> NDArray[np.int64]:
    """The synthetic chain of section 2.5: five callbacks of 5 to 15 ms."""
    random = np.random.default_rng(seed)
    sums: NDArray[np.float64] = random.uniform(5 * MS, 15 * MS, (size, 5)).sum(axis=1)
    return sums.astype(np.int64)


def test_the_tail_of_a_known_distribution() -> None:
    # The sum of five uniform variables on [0, 1] exceeds 5 − d with probability d⁵/5!.
    probability = 1e-4
    truth = (75 - 10 * (probability * 120) ** (1 / 5)) * MS
    fits = [fit_tail(_uniform_sums(seed), probability) for seed in range(15)]
    estimates = np.array([fit.latency_ns for fit in fits])
    assert abs(np.median(estimates) - truth) < 1 * MS
    covered = [fit.interval_ns[0] <= truth <= fit.interval_ns[1] for fit in fits]
    assert sum(covered) >= 14
    assert all(fit.shape < 0 for fit in fits)  # a bounded distribution has a bounded tail


def test_a_pareto_tail_is_recovered() -> None:
    random = np.random.default_rng(4)
    for shape in (-0.3, 0.0, 0.2):
        drawn = 20 * MS + stats.genpareto.rvs(shape, scale=MS, size=50_000, random_state=random)
        fit = fit_tail(drawn.astype(np.int64), 2e-5)
        assert fit.shape == pytest.approx(shape, abs=0.1)
        truth = 20 * MS + stats.genpareto.isf(2e-5, shape, scale=MS)
        assert fit.interval_ns[0] <= truth <= fit.interval_ns[1]


def test_a_derived_margin_reaches_the_plan() -> None:
    latencies = _uniform_sums(1)
    fit = fit_tail(latencies, 1e-4)
    margin = derive_margin(latencies, 1e-4)
    assert (margin.source, margin.overrun_probability) == ("derived", 1e-4)
    assert margin.epsilon_ns == fit.interval_ns[1] - latencies.max() + MS, "the upper end"
    assert derive_margin(latencies, 1e-4) == margin  # repeatable
    plan = plan_shaping(latencies, 100 * MS, margin=margin)
    assert plan.servers[0].slots[0][1] == fit.interval_ns[1] + MS
    assert "overrun_probability: 0.0001" in dump_plan(Plan.of(plan))
    assert any("upper end of an estimate" in warning for warning in plan_warnings(plan))


SHARES = (0.3, 0.05, 0.01, 5e-3, 1e-3, 9e-4, 5e-4, 2e-4, 1e-4, 5e-5, 2.5e-5)


@pytest.mark.parametrize("seed", range(6))
def test_less_risk_never_gives_an_earlier_slot(seed: int) -> None:
    """Nor one below the default's, which has 1 ms behind what covers 99 % of the cycles."""
    latencies = _uniform_sums(seed)
    default = plan_chain(Profile(latencies, 100 * MS)).servers[0].slots[0][1]
    ends = []
    for share in SHARES:
        request = PlanRequest(overrun_probability=share)
        ends.append(plan_chain(Profile(latencies, 100 * MS), request).servers[0].slots[0][1])
    assert ends == sorted(ends)
    assert ends[SHARES.index(0.01)] == default
    assert ends[-1] > latencies.max() + MS


def test_the_issue_s_sample_has_more_margin_for_less_risk() -> None:
    """2,000 latencies: 0.05 % was promised with ε = 0, where 1 % had 1 ms."""
    latencies = _uniform_sums(1, 2_000)
    epsilon = [derive_margin(latencies, share).epsilon_ns for share in (0.01, 5e-4, 5e-5)]
    assert epsilon[0] == MS
    assert epsilon == sorted(epsilon)
    assert epsilon[1] > MS


def test_what_a_sample_cannot_say_is_refused_with_how_many_cycles_could() -> None:
    latencies = _uniform_sums(1, 2_000)
    with pytest.raises(OperationError) as refused:
        derive_margin(latencies, 1e-5)
    assert str(refused.value) == (
        "2000 cycles are too few for an overrun probability of 1e-05. Measure 10000 cycles, if"
        " their tail is regular, or 299572 cycles, with which it holds for any distribution; or ask"
        " for 0.001497 or more, which 2000 cycles show"
    )
    assert derive_margin(latencies, 0.001497).source == "measured"


@pytest.mark.parametrize(
    ("name", "size", "share", "repeats"),
    [
        ("exponential", 1_000, None, 60),
        ("exponential, in whole ms", 4_000, 1e-3, 60),
        ("lognormal (σ 0.4)", 1_000, 1e-3, 25),
        ("beta (2, 5)", 4_000, 1e-4, 15),
        ("slow stretches (4 cycles)", 1_000, None, 40),
        ("autoregressive (0.7)", 400, None, 40),
    ],
)
def test_the_promise_holds_in_95_of_100_plans(
    name: str, size: int, share: float | None, repeats: int
) -> None:
    """A part of `experiments/promises.py`, with other samples: as far as chance goes."""
    held, made = held_of(name, size, share, repeats, seed=1)
    assert made > 0.8 * repeats
    assert made - held <= stats.binom.ppf(0.999, made, 0.05)


def test_what_depends_on_the_cycles_before_is_refused_for_a_rare_share() -> None:
    for name in ("autoregressive (0.7)", "slow stretches (4 cycles)"):
        assert held_of(name, 1_000, 1e-3, 20) == (0, 0)
    assert held_of("Pareto (α 3)", 400, 1e-3, 20) == (0, 0), "too few for a tail"


def test_clusters_of_long_cycles_count_as_few() -> None:
    """Blocks of eight equal cycles: as much as an eighth of them; independent ones count whole."""
    random = np.random.default_rng(3)
    drawn = random.integers(0, 10**9, 600)
    assert independent_cycles(drawn) == 600
    blocks = np.repeat(drawn, 8)
    assert independent_cycles(blocks) == pytest.approx(600, rel=0.2)
    assert derive_margin(drawn, 0.01).independent_cycles is None
    margin = derive_margin(blocks, 0.01)
    assert margin.independent_cycles == independent_cycles(blocks)
    longest = np.sort(blocks)[::-1]
    assert margin.epsilon_ns == MS  # 473 or more would be worth the second longest
    assert late_share(blocks, int(longest[0]), 600) == pytest.approx(1 - 0.05 ** (1 / 600))
    with pytest.raises(OperationError, match=r"clusters.* 4800 cycles tell as much as \d+ indep"):
        derive_margin(blocks, 0.001)


def test_binomial_bounds_are_those_of_the_beta_distribution() -> None:
    random = np.random.default_rng(8)
    for size in (1, 2, 30, 299, 5_000, 200_000):
        sample = np.arange(size)
        for beyond in {0, 1, size // 300, size // 3, size - 1, size} & set(range(size + 1)):
            found = late_share(sample, size - 1 - beyond)
            known = 1.0 if beyond == size else stats.beta.ppf(0.95, beyond + 1, size - beyond)
            assert found == pytest.approx(known, rel=1e-9), (size, beyond)
    assert late_share(random.permutation(1_000), 899, 100) == pytest.approx(
        stats.beta.ppf(0.95, 11, 90), rel=1e-9
    )


def _of_no_use() -> dict[str, NDArray[np.int64]]:
    """Samples from which nothing follows, by what is said about them."""
    shuffled = np.random.default_rng(1).permutation
    two_modes, clustered = _uniform_sums(3), _uniform_sums(5)
    two_modes[::70] = 90 * MS + np.arange(len(two_modes[::70])) * 1000
    # Every long execution delays the next: the second of each pair is the larger of both.
    clustered[1:] = np.maximum(clustered[1:], clustered[:-1])
    drift = np.linspace(0, 2 * MS, 4000).astype(np.int64)
    return {
        "300 cycles are too few.* Measure 1000 cycles": _uniform_sums(1, 300),
        "not stationary": _uniform_sums(2) + drift,
        "in clusters": np.sort(_uniform_sums(1)),
        "do not follow a generalised Pareto": two_modes,
        "Pareto": shuffled(np.repeat([50 * MS, 60 * MS], [600, 600])),
        # A hundred are beyond each threshold, all by 10 ms.
        "above any of 0 thresholds": shuffled(np.repeat([50 * MS, 60 * MS], [3900, 100])),
        "come in clusters": clustered,
    }


@pytest.mark.parametrize(("words", "latencies"), _of_no_use().items())
def test_data_that_allow_no_answer_get_none(words: str, latencies: NDArray[np.int64]) -> None:
    with pytest.raises(OperationError, match=words):
        fit_tail(latencies, 1e-4)
    for outside in (0.0, -1e-6, 1.0, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            derive_margin(latencies, outside)


def _planned(every_ms: list[float], disturbed: int, **request: object) -> ChainPlan:
    """A plan for latencies of which the last so many are of disturbed cycles."""
    random = np.random.default_rng(0)
    calm, behind = np.split(np.array(every_ms) * MS, [len(every_ms) - disturbed])
    every = np.concatenate([random.permutation(calm), behind]).astype(np.int64)
    profile = Profile(
        every[: every.size - disturbed], 100 * MS, every_latency_ns=every, disturbed=disturbed
    )
    return plan_chain(profile, PlanRequest(**request))  # type: ignore[arg-type]


def test_the_covered_latency_is_the_first_that_few_enough_exceed() -> None:
    """Against the definition by SciPy's distribution, one order statistic after the other."""
    random = np.random.default_rng(5)
    for _ in range(200):
        sample = random.integers(1, 10**6, random.integers(1, 700))
        share = float(random.uniform(0.003, 0.3))
        ordered = sorted(sample, reverse=True)
        enough = stats.binom.sf(np.arange(sample.size), sample.size, share) >= 0.95
        few = [latency for latency, covers in zip(ordered, enough, strict=True) if covers]
        assert covered_latency(sample, share) == (few or ordered)[-1 if few else 0]
        assert (sample.size >= cycles_needed(share)) == bool(few)


def test_the_share_of_late_cycles_is_stated_with_the_confidence_that_it_has() -> None:
    """500 pairs of measurements of a machine that stalls: the bound holds in 95 % at least."""
    random = np.random.default_rng(11)
    latencies = random.triangular(40, 52, 65, (500, 5_600)) + (
        random.exponential(8, (500, 5_600)) * (random.random((500, 5_600)) < 0.05)
    )
    right = 0
    for run in (latencies * MS).astype(np.int64):
        before, after = run[:600], run[600:]
        covered = covered_latency(before, 0.01)
        assert late_share(before, covered) < 0.01
        right += np.mean(after > covered) <= 0.01
    assert 0.95 <= right / 500 < 1


@pytest.mark.parametrize(
    ("behind", "wishes", "margin_and_stalls_ms", "late", "said"),
    [
        # By default all cycles are covered, and the cost is said.
        ([75, 72], {}, (16, 15), 0.01, "costs 15.000 ms: outputs leave at 76.000"),
        ([75, 72], {"ideal_machine": True}, (1, 0), 0.0207, "up to 2.1% of the outputs will miss"),
        ([75, 72], {"epsilon_ns": 13 * MS}, (13, 0), 0.0156, "up to 1.6% of the outputs will miss"),
        # What does not fit into the cycle is not covered: 98 ms is the latest start of a slot.
        ([97, 170, 180], {}, (38, 37), 0.0206, "up to 2.1% of the outputs will miss"),
        # A quiet machine costs one millisecond, under any policy.
        ([], {"policy": "let-per-chain"}, (1, 0), 1 - 0.05 ** (1 / 300), None),
        ([], {"policy": "server-per-chain"}, (1, 0), 0.01, None),
        # Without the way to a shaping node a little less.
        ([], {"publication": "in-process"}, (0.8, 0), 0.01, None),
    ],
)
def test_the_margin_covers_what_is_asked_for_and_says_the_rest(
    behind: list[float], wishes: Any, margin_and_stalls_ms: object, late: float, said: str | None
) -> None:
    plan = _planned([*np.linspace(40, 60, 300), *behind], len(behind), **wishes)
    margin = plan.margin
    assert (margin.epsilon_ns / MS, margin.stalls_ns / MS) == margin_and_stalls_ms
    assert margin.source == ("given" if "epsilon_ns" in wishes else "measured")
    assert margin.overrun_probability == pytest.approx(late, abs=1e-4)
    assert plan.evidence.max_of_all_ns == max([60, *behind]) * MS
    assert said is None or any(said in warning for warning in plan_warnings(plan))


def test_a_percentile_holds_also_where_the_machine_disturbed_every_cycle() -> None:
    """Ninety of a hundred take 45 ms at most; a margin would cover the longest, 50 ms."""
    latencies = np.arange(1, 101) * MS // 2
    profile = Profile(latencies, 100 * MS, disturbed=100, all_disturbed=True)
    for percentile, longest_ms in ((90, 45), (None, 50)):
        plan = plan_chain(profile, PlanRequest(percentile=percentile))
        assert plan.evidence.max_latency_ns == longest_ms * MS
        assert plan.servers[0].slots == ((0, (longest_ms + 1) * MS),)


def test_more_cycles_than_measured_cannot_be_promised() -> None:
    with pytest.raises(OperationError, match=r"302 cycles are too few .* or 2995 "):
        _planned(list(np.linspace(40, 60, 302)), disturbed=0, overrun_probability=0.001)
    with pytest.raises(InputError, match="between 0 and 1"):
        _planned([40, 50], disturbed=0, overrun_probability=1.5)
    plan = _planned([*np.linspace(40, 60, 250), 90], disturbed=1, overrun_probability=0.02)
    assert plan.margin.stalls_ns == 0, "one in fifty may be late"


def test_latencies_are_read_from_lines_and_arrays(tmp_path: Path) -> None:
    text, array = tmp_path / "latencies.txt", tmp_path / "latencies.npy"
    text.write_text("# on Monday\n59.1ms\n\n  250us  # fast\n1s")
    assert read_latencies(text).tolist() == [59_100_000, 250_000, 1_000_000_000]
    text.write_bytes("\ufeff59.1ms\r\n60ms\r\n".encode())  # as spreadsheets write it
    assert read_latencies(text).tolist() == [59_100_000, 60_000_000]
    for dtype in (np.int64, np.uint32, np.float64):
        np.save(array, np.array([5, 7, 6], dtype=dtype))
        assert read_latencies(array).tolist() == [5, 7, 6]
        assert read_latencies(array).dtype == np.int64


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1ms\n2\n", ":2: '2' is not a duration"),
        ("1ms\nnan\n", ":2: 'nan' is not a duration"),
        ("1ms\n\n-2ms\n", ":3: -2ms is no latency"),
        ("1ms\n999999999s\n", ":2: 999999999s is no latency"),
        ("", ": 0 latencies are too few"),
        ("0ms\n0ms\n", ": every latency is 0 ms"),
    ],
)
def test_wrong_lines_are_named(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text(text)
    with pytest.raises(InputError, match=f"^{file}{words}"):
        read_latencies(file)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1.0, np.nan], r"number 1 \(nan\) is not a number"),
        ([np.inf, 1.0], r"number 0 \(inf\) is not a number"),
        ([1.0, 1.5], r"number 1 \(1\.5\) is not a whole number"),
        ([1, 2, -3], r"number 2 \(-3\) is negative"),
        ([1, 2**62], "check the unit"),
        ([[1, 2], [3, 4]], "2-dimensional"),
        (["a", "b"], "one row of numbers"),
        ([5], "too few"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, values: list[Any], words: str) -> None:
    file = tmp_path / "latencies.npy"
    np.save(file, np.array(values))
    with pytest.raises(InputError, match=words):
        read_latencies(file)


def test_files_that_are_not_what_they_say(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_text("59ms")
    (tmp_path / "objects.npy").write_bytes(b"")
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    for name in ("a.npy", "objects.npy", "pickled.npy", "b.txt", "absent.txt"):
        with pytest.raises(InputError, match=f"{name}: cannot be read"):
            read_latencies(tmp_path / name)
