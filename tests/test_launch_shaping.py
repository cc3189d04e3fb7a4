"""Shaping a `ros2 launch`: what is refused before anything is launched, and the margin planned.

The flow itself needs ROS 2 and minutes; every step of it is tested where it is at home.
"""

from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from story import OFFSET, Story

from chainshaper import shape_launch
from chainshaper.errors import InputError, PlatformError
from chainshaper.launch_shaping import plan_launched
from chainshaper.planning import PlanRequest
from chainshaper.recording import Recording, RecordingInfo

MS = 1_000_000


@pytest.fixture
def launch_file(tmp_path: Path) -> Path:
    path = tmp_path / "robot.launch.xml"
    path.write_text("<launch/>\n")
    return path


def test_what_is_not_launched_by_ros2_cannot_be_shaped_so(tmp_path: Path) -> None:
    assert "is not `ros2 launch" in refused(2, "shape", "-o", tmp_path / "out", "--", "sleep", "1")
    assert not (tmp_path / "out").exists()


def test_a_description_needs_its_plan(tmp_path: Path) -> None:
    said = refused(2, "shape", "robot.yaml", "-o", tmp_path / "out")
    assert "chainshaper shape APP.yaml plan.yaml -o REC" in said


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path, launch_file: Path) -> None:
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        shape_launch(["ros2", "launch", str(launch_file)], tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == [launch_file.name]


def test_missing_build_tools_are_named_before_minutes_are_spent(
    tmp_path: Path, launch_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlatformError, match="colcon, which building the shaping node needs"):
        shape_launch(["ros2", "launch", str(launch_file)], tmp_path / "out", node="cpp")
    assert not (tmp_path / "out").exists()


def _recorded(cycles: int, largest_share: float) -> Recording:
    """One timer that publishes after five uniform parts of 5 to 15 ms, or less of each."""
    story = Story()
    node = story.node("/first", 1)
    timer, writer = story.timer(node, period=100 * MS), story.publisher(node, "/out")
    parts = np.random.default_rng(7).uniform(5, 5 + 10 * largest_share, (cycles, 5))
    for cycle, latency in enumerate(parts.sum(axis=1)):
        begins = (1000 + 100 * cycle) * MS
        ends = begins + int(latency * MS)
        story.runs(timer, begins, ends + 1, writes=((writer, ends),))
    info = RecordingInfo(source="simulated", clock_offset_ns=OFFSET)
    return Recording(Path("measured"), info, story.tables())


def test_without_a_margin_given_it_covers_the_tail_and_the_way_to_the_shaping_node() -> None:
    plan, notes = plan_launched(_recorded(400, 1.0), "/out", PlanRequest())
    assert notes == ()
    assert plan.margin.source == "derived"
    assert plan.margin.epsilon_ns > 1 * MS
    even, _ = plan_launched(_recorded(400, 0.1), "/out", PlanRequest())
    assert even.margin.epsilon_ns == 1 * MS, "the tail ends before"
    given, notes = plan_launched(_recorded(400, 1.0), "/out", PlanRequest(epsilon_ns=2 * MS))
    assert (given.margin.epsilon_ns, given.margin.source, notes) == (2 * MS, "given", ())


def test_where_no_margin_can_be_derived_it_says_so() -> None:
    plan, (note,) = plan_launched(_recorded(120, 1.0), "/out", PlanRequest())
    assert plan.margin.epsilon_ns == 1 * MS
    assert "the standard 1ms" in note
    assert "120 latencies are too few" in note
