"""`plan`, `offsets` and `sweep`: what the options mean, and what the figures are.

Placements themselves are proven in tests/planning.
"""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from command_line import called, json_of, refused

from chainshaper import convert_plan, load_plan, plan_shaping, save_plan
from chainshaper.planning import (
    ChainPlan,
    Modes,
    Plan,
    PlanRequest,
    Profile,
    plan_chain,
    plan_json,
    read_latencies,
)
from chainshaper.planning.chain_plan import revised
from chainshaper.values.recording import Recording

MS = 1_000_000
TWO_CHAINS = Path(__file__).parents[2] / "examples" / "two_chains.yaml"
EARLIER = Path(__file__).with_name("plan_of_an_earlier_version.yaml")
PNG = b"\x89PNG\r\n"
TINY = "--period 1ms --epsilon 0 --grid 1us --publish-slot 3us"
Words: TypeAlias = list[str | Path]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Latencies; each test may write others."""
    path = tmp_path / "latencies.txt"
    path.write_text("40ms\n61ms\n70ms\n85ms\n")
    return path


@pytest.fixture
def common(file: Path) -> Words:
    return ["plan", "--latencies", file, "--period", "100ms"]


def _triangular(file: Path) -> None:
    generator = random.Random(1)
    file.write_text("".join(f"{generator.triangular(33, 85, 68):.3f}ms\n" for _ in range(200)))


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
def test_a_plan_from_bare_latencies(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"latencies{suffix}"
    if suffix == ".npy":
        np.save(file, np.array([60_000_000, 63_250_000]))
    else:
        file.write_text("# from another tool\n60ms\n\n63.25ms  # the longest\n")
    options = ("--publish-slot", "500us", "--anchor", "cycle", "--chain", "/t1../t5")
    values = json_of("plan", "--latencies", file, "--period", "100ms", *options)
    assert values["bands_ns"] == [63_250_000 + 1_000_000 + 500_000]
    assert values["evidence"]["max_latency_ns"] == 63_250_000
    assert (values["anchor"], values["chain"]["spec"]) == ("cycle", "/t1../t5")


def test_options_reach_the_planner(common: Words, file: Path) -> None:
    _triangular(file)
    options = ["--bands", "4", "--publish-slot", "2ms", "--epsilon", "3ms", "--grid", "1ms"]
    values = json_of(*common, *options, "--max-gap", "12ms", "--max-share", "60%")
    wishes: dict[str, Any] = {"bands": 4, "publish_slot_ns": 2 * MS, "epsilon_ns": 3 * MS}
    request = PlanRequest(**wishes, grid_ns=MS, max_gap_ns=12 * MS, max_share=0.6)
    expected = plan_json(plan_chain(Profile(read_latencies(file), 100 * MS), request))
    assert {key: values[key] for key in expected} == json.loads(json.dumps(expected))
    assert values["bands_ns"] != json_of(*common, "--bands", "4")["bands_ns"]


def test_bands_have_their_shares_and_jitter_and_doubts(common: Words) -> None:
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
    # Nothing but close to each other, all bands stand behind the longest latency but one.
    gap = (*common, "--bands", "3", "--minimise", "gap")
    assert any("less than 2% of the cycles: 3 of 3" in one for one in json_of(*gap)["warnings"])
    bound = json_of(*gap, "--max-share", "50%")["warnings"]
    assert not any("less than 2%" in one for one in bound)


def test_auto_shows_the_curve_and_says_why_it_stops(common: Words, file: Path) -> None:
    curve = file.with_name("curve.png")
    _triangular(file)
    common += ["--bands", "auto"]
    values = json_of(*common, "--curve", curve)
    chosen = values["choice"]["chosen"]
    means = [row["mean_ns"] for row in values["choice"]["curve"]]
    assert curve.read_bytes().startswith(PNG)
    assert len(values["bands_ns"]) == chosen
    assert means == sorted(means, reverse=True)
    assert 1 - means[chosen] / means[chosen - 1] < 0.02 <= 1 - means[chosen - 1] / means[chosen - 2]
    assert "less than 5.00%" in called(*common, "--least-gain", "5%").out
    with file.open("a") as latencies:
        latencies.write("98ms\n")
    without = json_of(*common, "--percentile", "99.5")
    assert without["choice"]["curve"][chosen - 1]["bands_ns"] == without["bands_ns"]
    assert without["bands_ns"] == values["bands_ns"]
    plan, other = file.with_name("plan.yaml"), curve.with_name("other.png")
    assert "exists already" in refused(2, *common, "--curve", curve, "-o", plan)
    said = refused(2, *common, "--curve", curve.with_name("curve.txt"), "-o", plan)
    assert "ends in .png or .pdf or .svg" in said
    assert not plan.exists()
    assert "add --bands auto" in refused(2, *common[:-1], "2", "--curve", other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--bands 0", "neither a number of bands"),
        ("--bands many", "neither a number of bands"),
        ("--max-share 1.5", "is no share"),
        ("--minimise jitter --bands 3", "say which average it may cost"),
        ("--policy one-long-slot", "add --slot-start"),
        ("--slot-start 50ms", "goes with the policy one-long-slot"),
        ("--policy let-per-chain --bands 3", "--bands places latency bands"),
        ("--policy let-per-callback", "needs the chain's callbacks"),
        ("--policy server-per-callback", "needs the chain's callbacks"),
        ("--epsilon 1ms --overrun-probability 1e-6", "either given or covers a share"),
        ("--sink /a../b", "give a recording for several"),
        ("--period 0ms", "0ms is no time: write more than 0"),
        ("--skip 1s --percentile 99", "0 latencies are too few to plan with"),
        # The constraint that binds is named, for latencies of 40 us.
        (f"{TINY} --bands 11", "there is room for 10 publish slots of 3 us"),
        (f"{TINY} --bands 1000000000", "there is room for 10 publish slots of 3 us"),
        (f"{TINY} --bands 2 --max-gap 3us", "no two slots could follow each other"),
        (f"{TINY} --bands 2 --max-share 30%", "1: at 30.0% of the executions"),
        (f"{TINY} --bands 5 --grid 20us", "1: too coarse"),
    ],
)
def test_wrong_use_is_refused(options: str, message: str, common: Words, file: Path) -> None:
    if TINY in options:
        file.write_text("10us\n20us\n40us\n")
    code = 1 if message.startswith("1: ") else 2
    finished = called(*common, *options.split(), "--json")
    assert (finished.code, finished.out) == (code, "")
    assert message.removeprefix("1: ") in " ".join(finished.err.split())


def test_policies_from_bare_latencies(common: Words, file: Path) -> None:
    common += ["--policy"]
    long = json_of(*common, "one-long-slot", "--slot-start", "62ms")
    assert long["servers"][-1]["slots"] == [[62_000_000, 87_000_000]]
    assert long["predicted"]["mean_ns"] == (62 + 62 + 70 + 85) * 1_000_000 // 4
    let = json_of(*common, "let-per-chain")
    assert let["predicted"]["mean_ns"] == 101_000_000, "one period, and the slot"
    alone = json_of(*common, "server-per-chain")
    assert (alone["bands_ns"], alone["predicted"]["jitter_ns"]) == ([], 45_000_000)
    for policy in ("shaped", "server-per-chain", "let-per-chain"):
        # Eq. 2 and eq. 4 differ in what Δ is the longest time of, and in the thread in the slot.
        by = (*common, policy, "--overrun", "wait", "--publication")
        assert json_of(*by, "asynchronous") == json_of(*by, "synchronous")
    file.write_text("40ms\n99.5ms\n")  # too long for a slot behind it, short enough for LET
    nearly = json_of(*common, "let-per-chain")
    assert nearly["predicted"] == let["predicted"]
    assert nearly["evidence"]["max_latency_ns"] == 99_500_000
    file.write_text("40ms\n100ms\n")
    assert "has to be done" in refused(1, *common, "let-per-chain")


@pytest.mark.parametrize(
    ("policy", "servers"),
    [
        ("shaped", ["chain", "output"]),
        ("server-per-chain", ["chain"]),
        ("server-per-callback", ["first", "second", "third"]),
        ("let-per-chain", ["chain", "output"]),
        ("let-per-callback", ["chain", "output", "output_chainshaper_t2", "output_chainshaper_t1"]),
    ],
)
def test_every_policy_is_planned_from_a_recording(
    policy: str, servers: list[str], tmp_path: Path, unshaped: Recording
) -> None:
    file = tmp_path / "plan.yaml"
    values = json_of("plan", unshaped.path, "--policy", policy, "-o", file)
    assert values["policy"] == load_plan(file).chains[0].policy == policy
    assert [server["name"] for server in values["servers"]] == servers
    assert values["evidence"]["utilisation"] > 0


@pytest.fixture
def saved(tmp_path: Path) -> Callable[..., Path]:
    """Writes the plan of a chain."""

    def save(name: str, longest_ms: int, period_ms: int = 100) -> Path:
        latencies = np.array([longest_ms // 2, longest_ms]) * MS
        about = {"spec": name, "output": f"/{name}", "publisher": "/p", "nodes": [f"/{name}_node"]}
        planned = plan_shaping(latencies, period_ms * MS, **about)  # type: ignore[arg-type]
        save_plan(Plan.of(planned), tmp_path / f"{name}.yaml")
        return tmp_path / f"{name}.yaml"

    return save


def test_chains_take_turns_where_they_can(saved: Callable[..., Path], tmp_path: Path) -> None:
    files = [saved("a", 40), saved("b", 50)]
    values = json_of("offsets", *files, "-o", tmp_path / "placed")
    first, second = values["plans"]
    assert (first["offset_ns"], second["offset_ns"]) == (0, 41 * MS)
    assert "cycle 100.000, offset 41.000" in " ".join(called("offsets", *files).out.split())
    assert [Path(file).name for file in values["files"]] == ["1_a.yaml", "2_b.yaml"]
    assert load_plan(tmp_path / "placed" / "2_b.yaml").chains[0].offset_ns == 41 * MS
    again = refused(2, "offsets", *files, "-o", tmp_path / "placed")
    assert "exists already and is not overwritten" in again
    assert "a, c fill 102.0% of the time of core 1" in refused(
        1, "offsets", files[0], saved("c", 60)
    )
    colliding = refused(1, "offsets", files[0], saved("d", 20, 40))
    assert "`chainshaper plan REC --chain a --chain d`" in colliding


def test_an_offset_is_refused_where_nothing_stops_the_chain(
    application_file: Path, plan: ChainPlan
) -> None:
    file, output = application_file.with_name("plan.yaml"), application_file.with_name("rec")
    save_plan(Plan.of(revised(plan, offset_ns=7 * MS)), file)
    for words in (("apply", file, "--dry-run"), ("apply", file)):
        said = refused(2, *words, "--backend", "fifo")
        assert "fifo sets priorities only, and chains whose cycles start at offsets" in said
    assert called("simulate", application_file, file, "-o", output, "--cycles", "3").code == 0


def test_several_chains_of_a_recording_and_a_further_sink(tmp_path: Path) -> None:
    recording, file = tmp_path / "rec", tmp_path / "both.yaml"
    assert called("simulate", TWO_CHAINS, "-o", recording, "--cycles", "100").code == 0
    chains = ("--chain", "/scan../command", "--chain", "/image../label")
    values = json_of("plan", recording, *chains, "-o", file)
    assert [plan["chain"]["spec"] for plan in values["plans"]] == list(chains[1::2])
    written = load_plan(file)
    assert [plan.chain.spec for plan in written.chains] == list(chains[1::2])
    assert "the plan is of several chains" in refused(
        *(2, "sweep", TWO_CHAINS, file, "--vary", "plan.margin.epsilon=1ms", "-o", "x.parquet")
    )
    assert "with --chain, too" in refused(2, "plan", recording, *chains, "--sink", "/scan../map")
    values = json_of("plan", recording, *chains[:2], "--sink", "/scan../map")
    assert [node["output"] for node in values["further_shaping_nodes"]] == ["/map"]
    twice = refused(2, "plan", recording, "--sink", "/scan../command")
    assert "/scan../command is given twice" in twice


def test_a_plan_of_an_earlier_version_is_refused_and_converted(
    plan: ChainPlan, application_file: Path, tmp_path: Path
) -> None:
    new = tmp_path / "new.yaml"
    convert = ("plan", "--convert", EARLIER, "-o", new)
    for verb in (
        ("apply", EARLIER, "--dry-run"),
        ("simulate", application_file, EARLIER, "-o", new),
    ):
        said = refused(2, *verb)
        assert (
            f"a plan of an earlier version, converted by `chainshaper plan --convert {EARLIER}"
            in said
        )
    assert called(*convert).out.strip() == str(new)
    assert load_plan(new) == convert_plan(EARLIER)
    assert load_plan(new).chains[0].servers == plan.servers
    assert "not overwritten" in refused(2, *convert)
    assert "a plan; wanted is a file that" in refused(2, "plan", "--convert", new, "-o", "x.yaml")
    assert "goes with --output" in refused(2, "plan", "--convert", EARLIER)


def test_modes_get_their_bands(unshaped: Recording, tmp_path: Path) -> None:
    plan = ("plan", unshaped.path, "--publish-slot", "100us", "--epsilon", "1ms")
    modes = ("--modes", "/mode:city=2,highway=1")
    two = (*plan, "--bands", "2", *modes)
    values = json_of(*two, "--late", "discard", "-o", tmp_path / "plan.yaml")
    wanted = {"topic": "/mode", "default": "city", "bands": {"city": 2, "highway": 1}}
    assert values["modes"] == {**wanted, "late": "discard"}
    assert load_plan(tmp_path / "plan.yaml").chains[0].modes == Modes.model_validate(
        values["modes"]
    )
    assert "from 1 to 1, or add a slot" in refused(2, *plan, *modes)
    asynchronous = ("--publication", "asynchronous", "--publish-slot", "1ms")
    assert "/third has no thread that publishes" in refused(2, *two, *asynchronous)
    assert "--late publish goes with modes" in refused(2, *plan, "--late", "publish")
    for wrong, reason in {
        "/mode:city,highway=1": "all with a band or none",
        "/mode:city=1,city=2": "each mode once",
        "/mode:city,city": "each mode once",
        "/mode": "each mode once",
        "/mode:city": "nothing says which mode was in force",
        "mode:city=1": "topic: 'mode' is not a full ROS 2 name",
        "/mode:1st=1": "'1st' is not a mode's name",
        "/t3:city=1": "/t3 carries the chain's output",
    }.items():
        assert reason in refused(2, *plan, "--modes", wrong)
    assert any("share bands of them all" in warning for warning in values["warnings"])
    apart = [f"--mode-profile={mode}={unshaped.path}" for mode in ("city", "highway")]
    found = json_of(*plan, *apart, "--modes", "/mode:city,highway")
    assert found["modes"]["bands"] == {"city": 1, "highway": 1}, "as long as each other"
    assert found["evidence"]["modes"]["city"]["recording"] == str(unshaped.path)
    assert "Modes, as measured" in called(*plan, *apart, *modes).out
    assert "goes with --modes, as MODE=REC" in refused(2, *plan, *apart)
    assert "goes with --modes, as MODE=REC" in refused(2, *two, "--mode-profile", "city")


@pytest.fixture
def sweep(application_file: Path) -> Words:
    output = application_file.with_name("out.parquet")
    return ["sweep", application_file, "--cycles", "20", "--workers", "1", "-o", output]


def test_a_sweep_makes_a_table_a_picture_and_a_file(sweep: Words, tmp_path: Path) -> None:
    picture = tmp_path / "out.png"
    finished = called(*sweep, "--vary", "bands=1,40", "--vary", "epsilon=0,1ms", "--draw", picture)
    assert finished.code == 0, finished
    lines = finished.out.splitlines()
    assert lines[-2:] == [str(picture), str(tmp_path / "out.parquet")]
    assert sum("failed" in line for line in lines) == 2
    assert "note: " in finished.err, "why they failed"
    assert picture.read_bytes().startswith(PNG)
    assert (tmp_path / "out.parquet").is_file()


def test_a_plan_is_in_force_at_all_points_of_a_sweep(
    sweep: Words, application_file: Path, tmp_path: Path
) -> None:
    plan, recording = tmp_path / "plan.yaml", tmp_path / "recording"
    assert called("simulate", application_file, "-o", recording, "--cycles", "20").code == 0
    assert called("plan", recording, "-o", plan).code == 0
    axis = "nodes.first.callbacks.0.execution={constant: 1ms},{constant: 20ms}"
    early, late = json_of(*sweep, plan, "--vary", axis)
    assert (early["late"], early["jitter_ns"]) == (0, 0)
    assert late["late"] > 0
    assert early["predicted_max_ns"] == late["predicted_max_ns"]
    assert early["error"] is None
    assert early["per_band"][0]["jitter_ns"] == early["band_jitter_ns"]


def test_wrong_use_of_a_sweep_is_named(sweep: Words, tmp_path: Path) -> None:
    assert "is no axis" in refused(2, *sweep, "--vary", "bands")
    assert "given twice" in refused(2, *sweep, "--vary", "bands=1", "--vary", "bands=2")
    said = refused(2, *sweep, "--vary", "bands=1", "--scheduler", "host:8786")
    assert "leave out --workers, or --scheduler" in said
    said = refused(2, *sweep, "--vary", "bands=1", "--draw", tmp_path / "out.txt")
    assert "ends in .png or .pdf or .svg" in said
