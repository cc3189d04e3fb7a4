"""Throttlers spliced into launch files: whose input they stand before, and what comes after."""

import json
from pathlib import Path

import pytest
import yaml
from launch_cases import ROBOTS, plan_for

from chainshaper import splice_launch_files, splice_throttlers, undo_splice
from chainshaper.flow.launch_splicing import Splicing, ThrottledInput
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording, open_recording

MS = 1_000_000
REAR = ThrottledInput(topic="/rear", period_ns=100 * MS)
FRONT = ThrottledInput(topic="/front", period_ns=100 * MS)


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    """One in which a player publishes both inputs, and one node subscribes to each."""
    place = tmp_path / "recording"
    place.mkdir()
    endpoints = [
        {"node": node, "topic": topic, "kind": kind}
        for topic in ("/rear", "/front")
        for node, kind in (("/player", "publisher"), ("/fusion", "subscription"))
    ]
    info = {"source": "lttng", "clock_offset_ns": 0, "endpoints": endpoints}
    (place / "recording.json").write_text(json.dumps(info))
    return open_recording(place)


def _robot(folder: Path, name: str = "robot.launch.yaml") -> Path:
    path = folder / name
    path.write_text(ROBOTS[name])
    return path


def _parameters(spliced: Splicing, number: int = 0) -> dict[str, object]:
    text = spliced.processes[number].parameters_file.read_text()
    return dict(yaml.safe_load(text)["/**"]["ros__parameters"])


@pytest.mark.parametrize("name", ROBOTS)
def test_the_subscriber_is_remapped_and_the_publisher_is_not(
    name: str, tmp_path: Path, recording: Recording
) -> None:
    robot = _robot(tmp_path, name)
    spliced = splice_throttlers([REAR, FRONT], [robot], tmp_path / "out", recording=recording)

    assert robot.read_text() == ROBOTS[name]
    changed = [line[1:] for line in spliced.diff.splitlines() if line[:1] in "+-"]
    assert any("fusion" in line for line in changed)
    assert not any("player" in line for line in changed)
    text = (tmp_path / "out" / name).read_text()
    assert text.count("/rear_throttled") == text.count("/front_throttled") == 1
    assert text.count("chainshaper_throttler.py") == 1, "one throttler, as in the paper"
    parameters = _parameters(spliced)
    assert parameters["inputs"] == ["/rear", "/front"]
    assert parameters["outputs"] == ["/rear_throttled", "/front_throttled"]
    assert (parameters["period_ns"], parameters["fifo_priority"]) == (100 * MS, 85)


def test_inputs_of_other_periods_have_a_throttler_of_their_own(
    tmp_path: Path, recording: Recording
) -> None:
    inputs = [REAR, ThrottledInput(topic="/front", period_ns=50 * MS)]
    spliced = splice_throttlers(inputs, [_robot(tmp_path)], tmp_path / "out", recording=recording)

    names = ["chainshaper_throttler", "chainshaper_throttler_2"]
    assert [process.name for process in spliced.processes] == names
    assert [_parameters(spliced, number)["period_ns"] for number in (0, 1)] == [100 * MS, 50 * MS]


def test_a_named_subscriber_needs_no_recording(tmp_path: Path) -> None:
    one = REAR.model_copy(update={"subscriber": "/fusion"})
    spliced = splice_throttlers([one], [_robot(tmp_path)], tmp_path / "out", node="cpp")

    (process,) = spliced.processes
    assert (process.package, process.executable) == ("chainshaper_shaping", "throttler")
    started, _, fusion = yaml.safe_load((tmp_path / "out/robot.launch.yaml").read_text())["launch"]
    assert started["node"]["name"] == "chainshaper_throttler"
    assert fusion["node"]["remap"] == [{"from": "/rear", "to": "/rear_throttled"}]


def test_a_plan_is_spliced_into_the_throttled_copy(tmp_path: Path, recording: Recording) -> None:
    robot = _robot(tmp_path)
    splice_throttlers([REAR], [robot], tmp_path / "throttled", recording=recording)
    throttled = tmp_path / "throttled/robot.launch.yaml"
    before = throttled.read_text()

    plan = plan_for("/fusion", "/pose")
    shaped = splice_launch_files(plan, [throttled], tmp_path / "shaped")
    again = splice_launch_files(plan, list(shaped.launch.values()), tmp_path / "again")

    for folder in ("shaped", "again"):
        text = (tmp_path / folder / "robot.launch.yaml").read_text()
        # Of the fusion's remap, the shaping node's, and its standby's.
        assert (text.count("/rear_throttled"), text.count("/pose_tmp")) == (1, 3)
        assert text.count("chainshaper_throttler.py") == text.count("chainshaper_pose.py") == 1
    assert throttled.read_text() == before
    assert "spliced from its original" in again.notes[0]


def test_throttling_a_copy_again_gives_the_same(tmp_path: Path, recording: Recording) -> None:
    robot, out = _robot(tmp_path), tmp_path / "out"
    first = splice_throttlers([REAR], [robot], out, recording=recording)
    texts = {path: path.read_text() for path in out.rglob("*") if path.is_file()}

    again = splice_throttlers([REAR], list(first.launch.values()), out, recording=recording)

    assert {path: path.read_text() for path in out.rglob("*") if path.is_file()} == texts
    assert again.diff == first.diff
    undo_splice(out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "with_recording", "message"),
    [
        ({}, False, "who subscribes to /rear is not known: name a recording"),
        ({"topic": "/side"}, True, "what somebody does: /front, /rear"),
        ({"subscriber": "/other"}, False, "nobody subscribes to /rear: .* no node /other"),
    ],
)
def test_what_cannot_be_throttled_is_named_and_nothing_written(
    change: dict[str, str], with_recording: bool, message: str, tmp_path: Path, recording: Recording
) -> None:
    with pytest.raises(InputError, match=message):
        splice_throttlers(
            [REAR.model_copy(update=change)],
            [_robot(tmp_path)],
            tmp_path / "out",
            recording=recording if with_recording else None,
        )
    assert not (tmp_path / "out").exists()
