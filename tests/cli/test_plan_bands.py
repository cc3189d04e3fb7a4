"""`plan --latencies …`: what the options mean, and what the figures are."""

import json
import random
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias

import pytest
from command_line import called, json_of, refused

from chainshaper.planning import PlanRequest, Profile, plan_chain, plan_json, read_latencies

MS = 1_000_000
SIMPLE = "40ms\n61ms\n70ms\n85ms\n"
Words: TypeAlias = list[str | Path]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Latencies; each test may write others."""
    path = tmp_path / "latencies.txt"
    path.write_text(SIMPLE)
    return path


@pytest.fixture
def common(file: Path) -> Words:
    return ["plan", "--latencies", file, "--period", "100ms"]


def _triangular(file: Path) -> None:
    generator = random.Random(1)
    file.write_text("".join(f"{generator.triangular(33, 85, 68):.3f}ms\n" for _ in range(200)))


def test_options_reach_the_planner(common: Words, file: Path) -> None:
    """Placements themselves are proven in tests/planning/test_bands.py."""
    _triangular(file)
    options = ["--bands", "4", "--publish-slot", "2ms", "--epsilon", "3ms", "--grid", "1ms"]
    values = json_of(*common, *options, "--max-gap", "12ms", "--max-share", "60%")
    request = PlanRequest(
        bands=4, publish_slot_ns=2 * MS, epsilon_ns=3 * MS, grid_ns=MS, max_gap_ns=12 * MS,
        max_share=0.6,
    )  # fmt: skip
    expected = plan_json(plan_chain(Profile(read_latencies(file), 100 * MS), request))
    assert {key: values[key] for key in expected} == json.loads(json.dumps(expected))
    assert values["bands_ns"] != json_of(*common, "--bands", "4")["bands_ns"]


def test_the_binding_constraint_is_named(file: Path) -> None:
    file.write_text("10us\n20us\n40us\n")
    common: Words = ["plan", "--latencies", file, "--period", "1ms", "--epsilon", "0"]
    common += ["--grid", "1us", "--publish-slot", "3us"]
    for too_many in ("11", "1000000000"):
        said = refused(2, *common, "--bands", too_many)
        assert "there is room for 10 publish slots of 3us" in said
    assert "at 30.0% of the executions" in refused(1, *common, "--bands", "2", "--max-share", "30%")
    coarse: Words = [*common, "--bands", "5"]
    coarse[coarse.index("1us")] = "20us"
    assert "too coarse" in refused(1, *coarse)
    long: Words = [*common, "--bands", "2", "--max-gap", "3us"]
    assert "no two slots could follow each other" in refused(2, *long)


def test_the_solvers_and_their_seeds(common: Words, file: Path) -> None:
    _triangular(file)
    common += ["--bands", "3"]
    exact = json_of(*common)["predicted"]["mean_ns"]
    drawn = [json_of(*common, "--solver", "random", "--seed", seed) for seed in ("1", "1", "2")]
    assert drawn[0]["bands_ns"] == drawn[1]["bands_ns"] != drawn[2]["bands_ns"]
    assert all(values["predicted"]["mean_ns"] >= exact for values in drawn)
    if find_spec("pyswarms") is None:
        pytest.skip("pyswarms is not installed")
    swarm = [json_of(*common, "--solver", "pso", "--seed", "3") for _ in range(2)]
    assert swarm[0]["bands_ns"] == swarm[1]["bands_ns"]
    assert swarm[0]["predicted"]["mean_ns"] >= exact


def test_each_band_has_its_share_and_jitter(common: Words) -> None:
    bands = json_of(*common, "--bands", "3")["predicted_bands"]
    assert [(band["share"], band["jitter_ns"]) for band in bands] == [
        (0.25, 1_000_000),  # slots [40.001, 41.001), [69, 70), [86, 87) ms
        (0.5, 1_000_000),
        (0.25, 1_000_000),
    ]
    shown = called(*common, "--bands", "3").out
    assert "Predicted latency bands" in shown
    assert "50.0%" in shown
    assert "Predicted latency bands" not in called(*common).out


def test_auto_shows_the_curve_and_says_why_it_stops(common: Words, file: Path) -> None:
    curve = file.with_name("curve.png")
    _triangular(file)
    common += ["--bands", "auto"]
    values = json_of(*common, "--curve", curve)
    chosen = values["choice"]["chosen"]
    means = [row["mean_ns"] for row in values["choice"]["curve"]]
    assert curve.read_bytes().startswith(b"\x89PNG")
    assert len(values["bands_ns"]) == chosen
    assert means == sorted(means, reverse=True)
    assert 1 - means[chosen] / means[chosen - 1] < 0.02 <= 1 - means[chosen - 1] / means[chosen - 2]
    printed = called(*common, "--least-gain", "5%")
    assert "less than 5.00%" in printed.out
    assert "exists already" in refused(2, *common, "--curve", curve)
    assert "add --bands auto" in refused(
        2, *common[:-1], "2", "--curve", curve.with_name("other.png")
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--bands", "0"), "neither a number of bands"),
        (("--bands", "many"), "neither a number of bands"),
        (("--max-share", "1.5"), "is no share"),
        (("--minimise", "jitter", "--bands", "3"), "say which average it may cost"),
        (("--policy", "one-long-slot"), "add --slot-start"),
        (("--slot-start", "50ms"), "goes with the policy one-long-slot"),
        (("--policy", "let-per-chain", "--bands", "3"), "--bands places latency bands"),
        (("--policy", "let-per-callback"), "needs the chain's callbacks"),
        (("--policy", "server-per-callback"), "needs the chain's callbacks"),
        (("--epsilon", "1ms", "--overrun-probability", "1e-6"), "either given or covers a share"),
        (("--sink", "/a../b"), "give a recording for several"),
    ],
)
def test_wrong_use_is_refused(options: tuple[str, ...], said: str, common: Words) -> None:
    finished = called(*common, *options, "--json")
    assert (finished.code, finished.out) == (2, "")
    assert said in " ".join(finished.err.split())


def test_policies_from_bare_latencies(common: Words, file: Path) -> None:
    common += ["--policy"]
    long = json_of(*common, "one-long-slot", "--slot-start", "62ms")
    assert long["servers"][-1]["slots"] == [[62_000_000, 87_000_000]]
    assert long["predicted"]["mean_ns"] == (62 + 62 + 70 + 85) * 1_000_000 // 4
    let = json_of(*common, "let-per-chain")
    assert let["predicted"]["mean_ns"] == 101_000_000, "one period, and the slot"
    file.write_text("40ms\n99.5ms\n")  # too long for a slot behind it, short enough for LET
    nearly = json_of(*common, "let-per-chain")
    assert nearly["predicted"] == let["predicted"]
    assert nearly["evidence"]["max_latency_ns"] == 99_500_000
    file.write_text("40ms\n100ms\n")
    assert "has to be done" in refused(1, *common, "let-per-chain")
    file.write_text(SIMPLE)
    alone = json_of(*common, "server-per-chain")
    assert (alone["bands_ns"], alone["predicted"]["jitter_ns"]) == ([], 45_000_000)


@pytest.mark.parametrize("policy", ["shaped", "server-per-chain", "let-per-chain"])
def test_slots_do_not_depend_on_who_publishes(policy: str, common: Words) -> None:
    # Eq. 2 and eq. 4 differ in what Δ is the longest time of, and in the thread in the slot.
    common += ["--policy", policy, "--overrun", "wait", "--publication"]
    assert json_of(*common, "asynchronous") == json_of(*common, "synchronous")


def test_a_margin_is_derived_or_refused(common: Words, file: Path) -> None:
    common += ["--overrun-probability", "1e-5"]
    generator = random.Random(6)
    drawn = [f"{60 + sum(generator.random() for _ in range(12)):.6f}ms\n" for _ in range(2000)]
    file.write_text("".join(drawn))
    values = json_of(*common)
    assert values["margin"]["source"] == "derived"
    assert values["margin"]["overrun_probability"] == 1e-5
    low, high = values["margin"]["confidence_interval_ns"]
    assert low <= values["margin"]["epsilon_ns"] <= high
    assert any("is an estimate" in warning for warning in values["warnings"])
    file.write_text("".join(drawn[:300]))
    assert "300 latencies are too few" in refused(1, *common)
    file.write_text("".join(sorted(drawn)))
    assert "not stationary" in refused(1, *common)
