"""`plan --latencies … --bands N`: against trying every placement, written down independently."""

import itertools
import random
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_line import called, json_of, message_of, refused

US = 1_000


@dataclass(frozen=True)
class Case:
    """A small problem of section 4.1, all times in microseconds."""

    latencies: tuple[int, ...]
    bands: int
    slot: int
    epsilon: int
    gap: int | None
    grid: int

    @property
    def last(self) -> int:
        return max(self.latencies) + self.epsilon + self.slot


def _mean(case: Case, ends: tuple[int, ...]) -> float:
    """Every execution leaves at the end of the first slot that ends after it is done."""
    waits = [min(end for end in ends if latency <= end) for latency in case.latencies]
    return sum(waits) / len(waits)


def _allowed(case: Case, ends: tuple[int, ...]) -> bool:
    if len(ends) > 1 and ends[0] - case.slot <= min(case.latencies):
        return False
    distances = [after - before for before, after in itertools.pairwise(ends)]
    return all(
        distance > case.slot and (case.gap is None or distance <= case.gap)
        for distance in distances
    )


def _least_mean(case: Case) -> float | None:
    positions = range(0, case.last, case.grid)
    means = [
        _mean(case, (*chosen, case.last))
        for chosen in itertools.combinations(positions, case.bands - 1)
        if _allowed(case, (*chosen, case.last))
    ]
    return min(means, default=None)


def _cases() -> Iterator[Case]:
    generator = random.Random(4)
    for number in range(60):
        low = generator.randint(5, 30)
        yield Case(
            latencies=tuple(
                generator.randint(low, low + generator.choice([3, 12, 30]))
                for _ in range(generator.choice([2, 5, 20]))
            ),
            bands=generator.choice([1, 2, 3, 3, 4]),
            slot=generator.choice([1, 2, 5]),
            epsilon=generator.choice([0, 1, 4]),
            gap=generator.choice([None, None, 6, 7, 10, 20]),
            grid=1 if number % 3 else 3,
        )


def _arguments(case: Case, folder: Path) -> list[str | Path]:
    file = folder / "latencies.txt"
    file.write_text("".join(f"{latency}us\n" for latency in case.latencies))
    arguments: list[str | Path] = ["plan", "--latencies", file, "--period", "1ms"]
    arguments += ["--bands", str(case.bands), "--publish-slot", f"{case.slot}us"]
    arguments += ["--epsilon", f"{case.epsilon}us", "--grid", f"{case.grid}us"]
    return arguments + ([] if case.gap is None else ["--max-gap", f"{case.gap}us"])


def test_the_exact_solver_finds_what_trying_everything_finds(tmp_path: Path) -> None:
    possible = impossible = 0
    for case in _cases():
        least = _least_mean(case)
        arguments = _arguments(case, tmp_path)
        if least is None:
            impossible += 1
            finished = called(*arguments, "--solver", "exact", "--json")
            # More bands than find room in any way are wrong use, other limits a failure.
            message = message_of(finished, 2 if "there is room for" in finished.err else 1)
            assert "cannot be placed" in message, case
            continue
        possible += 1
        values = json_of(*arguments, "--solver", "exact")
        ends = tuple(end // US for end in values["bands_ns"])
        assert _allowed(case, ends), case
        assert ends[-1] == case.last, "the last slot stays at the single-band place"
        assert _mean(case, ends) == pytest.approx(least), case
        assert values["predicted"]["mean_ns"] == pytest.approx(least * US, abs=0.51), case
    assert possible > 30
    assert impossible > 5


def test_the_binding_constraint_is_named(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("10us\n20us\n40us\n")
    common: list[str | Path] = [
        "plan",
        "--latencies",
        file,
        "--period",
        "1ms",
        "--epsilon",
        "0",
        "--grid",
        "1us",
    ]
    common += ["--publish-slot", "3us"]
    for too_many in ("11", "1000000000"):
        said = refused(2, *common, "--bands", too_many)
        assert "there is room for 10 publish slots of 3us" in said
    assert "at 30.0% of the executions" in refused(1, *common, "--bands", "2", "--max-share", "30%")
    coarse: list[str | Path] = [*common, "--bands", "5"]
    coarse[coarse.index("1us")] = "20us"
    assert "too coarse" in refused(1, *coarse)
    long: list[str | Path] = [*common, "--bands", "2", "--max-gap", "3us"]
    assert "no two slots could follow each other" in refused(2, *long)


def test_the_solvers_and_their_seeds(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    generator = random.Random(1)
    file.write_text("".join(f"{generator.triangular(33, 85, 68):.3f}ms\n" for _ in range(200)))
    common: list[str | Path] = ["plan", "--latencies", file, "--period", "100ms", "--bands", "3"]
    exact = json_of(*common)["predicted"]["mean_ns"]
    drawn = [json_of(*common, "--solver", "random", "--seed", seed) for seed in ("1", "1", "2")]
    assert drawn[0]["bands_ns"] == drawn[1]["bands_ns"] != drawn[2]["bands_ns"]
    assert all(values["predicted"]["mean_ns"] >= exact for values in drawn)
    if find_spec("pyswarms") is None:
        pytest.skip("pyswarms is not installed")
    swarm = [json_of(*common, "--solver", "pso", "--seed", "3") for _ in range(2)]
    assert swarm[0]["bands_ns"] == swarm[1]["bands_ns"]
    assert swarm[0]["predicted"]["mean_ns"] >= exact


def test_each_band_is_told_its_share_and_jitter(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("40ms\n61ms\n70ms\n85ms\n")
    common: list[str | Path] = ["plan", "--latencies", file, "--period", "100ms"]
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


def test_auto_shows_the_curve_and_says_why_it_stops(tmp_path: Path) -> None:
    file, curve = tmp_path / "latencies.txt", tmp_path / "curve.png"
    generator = random.Random(1)
    file.write_text("".join(f"{generator.triangular(33, 85, 68):.3f}ms\n" for _ in range(200)))
    common: list[str | Path] = ["plan", "--latencies", file, "--period", "100ms", "--bands", "auto"]
    values = json_of(*common, "--curve", curve)
    chosen, means = (
        values["choice"]["chosen"],
        [row["mean_ns"] for row in values["choice"]["curve"]],
    )
    assert curve.read_bytes().startswith(b"\x89PNG")
    assert len(values["bands_ns"]) == chosen
    assert means == sorted(means, reverse=True)
    assert 1 - means[chosen] / means[chosen - 1] < 0.02 <= 1 - means[chosen - 1] / means[chosen - 2]
    printed = called(*common, "--least-gain", "5%")
    assert "less than 5.00%" in printed.out
    assert "exists already" in refused(2, *common, "--curve", curve)
    assert "add --bands auto" in refused(2, *common[:-1], "2", "--curve", tmp_path / "other.png")


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
def test_wrong_use_is_refused(options: tuple[str, ...], said: str, tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("52ms\n61.5ms\n58ms\n")
    finished = called("plan", "--latencies", file, "--period", "100ms", *options, "--json")
    assert (finished.code, finished.out) == (2, "")
    assert said in " ".join(finished.err.replace("│", " ").split())


def test_policies_from_bare_latencies(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("40ms\n61ms\n70ms\n85ms\n")
    common: list[str | Path] = ["plan", "--latencies", file, "--period", "100ms", "--policy"]
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
    file.write_text("40ms\n61ms\n70ms\n85ms\n")
    alone = json_of(*common, "server-per-chain")
    assert (alone["bands_ns"], alone["predicted"]["jitter_ns"]) == ([], 45_000_000)


@pytest.mark.parametrize("policy", ["shaped", "server-per-chain", "let-per-chain"])
def test_slots_do_not_depend_on_who_publishes(policy: str, tmp_path: Path) -> None:
    # Eq. 2 and eq. 4 differ in what Δ is the longest time of, and in the thread in the slot.
    file = tmp_path / "latencies.txt"
    file.write_text("40ms\n61ms\n70ms\n85ms\n")
    common: list[str | Path] = ["plan", "--latencies", file, "--period", "100ms"]
    common += ["--policy", policy, "--overrun", "wait", "--publication"]
    assert json_of(*common, "asynchronous") == json_of(*common, "synchronous")


def test_a_margin_is_derived_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    generator = random.Random(6)
    drawn = [f"{60 + sum(generator.random() for _ in range(12)):.6f}ms\n" for _ in range(2000)]
    common: list[str | Path] = [
        "plan",
        "--latencies",
        file,
        "--period",
        "100ms",
        "--overrun-probability",
        "1e-5",
    ]
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
