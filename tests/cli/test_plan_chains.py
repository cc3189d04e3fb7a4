"""Plans of recordings: policies, and several chains with their offsets."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import called, json_of, refused

from chainshaper import load_plan, plan_shaping, save_plan
from chainshaper.planning import Modes, Plan
from chainshaper.planning.plan import revised
from chainshaper.values.recording import Recording

MS = 1_000_000


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
    assert values["policy"] == load_plan(file).policy == policy
    assert [server["name"] for server in values["servers"]] == servers
    assert values["evidence"]["utilisation"] > 0


def _saved(folder: Path, name: str, longest_ms: int, period_ms: int = 100) -> Path:
    planned = plan_shaping(
        np.array([longest_ms // 2, longest_ms]) * MS,
        period_ms * MS,
        spec=name,
        output=f"/{name}",
        publisher="/p",
        nodes=[f"/{name}_node"],
    )
    save_plan(planned, folder / f"{name}.yaml")
    return folder / f"{name}.yaml"


def test_chains_take_turns_where_they_can(tmp_path: Path) -> None:
    files = [_saved(tmp_path, "a", 40), _saved(tmp_path, "b", 50)]
    values = json_of("offsets", *files, "-o", tmp_path / "placed")
    first, second = values["plans"]
    assert (first["offset_ns"], second["offset_ns"]) == (0, 41 * MS)
    assert "cycle 100.000, starting 41.000 late" in " ".join(called("offsets", *files).out.split())
    assert [Path(file).name for file in values["files"]] == ["1_a.yaml", "2_b.yaml"]
    assert load_plan(tmp_path / "placed" / "2_b.yaml").offset_ns == 41 * MS
    again = refused(2, "offsets", *files, "-o", tmp_path / "placed")
    assert "exists already and is not overwritten" in again


def test_an_offset_is_refused_where_the_chains_timer_starts_its_cycles(
    application_file: Path, plan: Plan
) -> None:
    file, output = application_file.with_name("plan.yaml"), application_file.with_name("rec")
    save_plan(revised(plan, offset_ns=7 * MS), file)
    for words in (
        ("apply", file, "--dry-run"),
        ("apply", file),
        ("shape", application_file, file, "-o", output),
    ):
        assert "offset: 7ms cannot be carried out here" in refused(2, *words)
    assert not output.exists()
    assert called("simulate", application_file, file, "-o", output, "--cycles", "3").code == 0


def test_chains_that_overlap_keep_their_publish_slots_apart(tmp_path: Path) -> None:
    # [61, 62) and [71, 72) of one cycle are apart as they are; two equal chains are not.
    files = [_saved(tmp_path, name, 60) for name in ("a", "b")]
    values = json_of("offsets", *files)
    first, second = values["plans"]
    assert second["offset_ns"] % (100 * MS) in range(MS, 99 * MS + 1)
    assert [plan["servers"][0]["priority"] for plan in (first, second)] == [2, 3]
    assert any("only their publish slots are kept apart" in text for text in values["warnings"])
    assert "only their publish slots" in called("offsets", *files).err


def test_impossible_offsets_are_explained(tmp_path: Path) -> None:
    files = [_saved(tmp_path, "a", 6, 20), _saved(tmp_path, "b", 7, 21)]
    assert "collide at every offset" in refused(1, "offsets", *files)


TWO_CHAINS = Path(__file__).parents[2] / "examples" / "two_chains.yaml"


@pytest.fixture(scope="module")
def two_chains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("numba")
    folder = tmp_path_factory.mktemp("two_chains") / "rec"
    assert called("simulate", TWO_CHAINS, "-o", folder, "--cycles", "100").code == 0
    return folder


def test_several_chains_of_a_recording(tmp_path: Path, two_chains: Path) -> None:
    folder = tmp_path / "plans"
    chains = ("--chain", "/scan../command", "--chain", "/image../label")
    values = json_of("plan", two_chains, *chains, "-o", folder)
    assert [plan["chain"]["spec"] for plan in values["plans"]] == list(chains[1::2])
    assert sorted(path.name for path in folder.iterdir()) == ["1_command.yaml", "2_label.yaml"]
    assert "one by one" in refused(2, "plan", two_chains, *chains, "--sink", "/scan../map")


def test_a_further_sink(two_chains: Path) -> None:
    values = json_of("plan", two_chains, "--chain", "/scan../command", "--sink", "/scan../map")
    assert [node["output"] for node in values["further_shaping_nodes"]] == ["/map"]
    twice = refused(2, "plan", two_chains, "--sink", "/scan../command")
    assert "both publish /command" in twice


def test_what_would_be_planned_wrong_is_refused(unshaped: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "plans"
    chains = ("--chain", "/t1../t3", "--chain", "/t1../t2")
    for wanted in (chains, ("--sink", "/t1../t2")):
        said = refused(2, "plan", unshaped.path, *wanted, "-o", folder, "--publish-slot", "100us")
        assert "/t1../t3 waits for /t2, which the plan for /t1../t2" in said
        assert not folder.exists()


def test_a_plan_says_that_events_were_lost(unshaped: Recording, tmp_path: Path) -> None:
    recording = tmp_path / "lossy"
    shutil.copytree(unshaped.path, recording)
    info = json.loads((recording / "recording.json").read_text())
    (recording / "recording.json").write_text(json.dumps({**info, "lost": {"lost_events": 7}}))
    values = json_of("plan", recording, "--publish-slot", "100us")
    assert values["evidence"]["lost_events"] == 7
    assert any(warning.startswith("7 events were lost") for warning in values["warnings"])


def test_modes_get_their_bands(unshaped: Recording, tmp_path: Path) -> None:
    plan = ("plan", unshaped.path, "--publish-slot", "100us", "--epsilon", "1ms")
    modes = ("--modes", "/mode:city=2,highway=1")
    two = (*plan, "--bands", "2", *modes)
    values = json_of(*two, "--late", "discard", "-o", tmp_path / "plan.yaml")
    wanted = {"topic": "/mode", "default": "city", "bands": {"city": 2, "highway": 1}}
    assert values["modes"] == {**wanted, "late": "discard"}
    assert load_plan(tmp_path / "plan.yaml").modes == Modes.model_validate(values["modes"])
    assert "from 1 to 1, or add a slot" in refused(2, *plan, *modes)
    asynchronous = ("--publication", "asynchronous", "--publish-slot", "1ms")
    assert "no `shaping_node`" in refused(2, *two, *asynchronous, "--bands", "1")
    assert "--late publish goes with modes" in refused(2, *plan, "--late", "publish")
    for wrong, reason in {
        "/mode:city": "a band for each mode once",
        "/mode:city=1,city=2": "a band for each mode once",
        "/mode": "a band for each mode once",
        "mode:city=1": "topic: 'mode' is not a full ROS 2 name",
        "/mode:1st=1": "'1st' is not a mode's name",
        "/t3:city=1": "/t3 carries the chain's output",
    }.items():
        assert reason in refused(2, *plan, "--modes", wrong)


def test_compare_shows_prediction_beside_measurement(
    unshaped: Recording, shaped: Recording
) -> None:
    prediction = json_of("compare", unshaped.path, shaped.path)["recordings"][1]["prediction"]
    assert prediction["max_ns"]["at_start"] == 21 * MS
    assert prediction["max_ns"]["at_end"] == 22 * MS
    (band,) = prediction["bands"]
    assert (band["slot_start_ns"], band["slot_end_ns"]) == (21 * MS, 22 * MS)
    assert band["predicted_share"] == 1.0
    shown = called("compare", unshaped.path, shaped.path).out
    assert "Prediction and measurement [ms]" in shown
    assert "[21.000, 22.000)" in shown
