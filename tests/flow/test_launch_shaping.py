"""Shaping a `ros2 launch`: what is refused before anything is launched.

The flow itself needs ROS 2 and minutes; every step of it is tested where it is at home.
"""

from pathlib import Path

import pytest
from bare_recordings import recorded
from command_line import called, refused
from small_chain import small_chain_plan

from chainshaper import shape_launch
from chainshaper.flow.launch_shaping import _with_types
from chainshaper.planning.application_plan import whole
from chainshaper.values.errors import InputError, PlatformError


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
    words = ("shape", "robot.yaml", "plan.yaml", "--bands", "2", "-o", tmp_path / "out")
    assert "is shaped as plan.yaml says" in refused(2, *words)


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path, launch_file: Path) -> None:
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        shape_launch(["ros2", "launch", str(launch_file)], tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == [launch_file.name]


def test_what_cannot_be_shaped_is_refused_before_anything_is_launched(
    tmp_path: Path, launch_file: Path
) -> None:
    launch = ("-o", tmp_path / "out", "--", "ros2", "launch", launch_file)
    assert "core 4000, which --cores asks for" in refused(3, "shape", "--cores", "0,4000", *launch)
    for words, reason in {
        "--chain /a../b --chain /c../d --sink /a../e": "--sink goes with one chain",
        "--throttle /in=100ms": "as in --throttle NODE:/in=PERIOD",
        "--throttle /node:/in": "write a topic and a period",
        "--policy pipelined --sink /a../e": "further sinks are shaped",
        "--modes /mode:city,highway": "nothing says which mode was in force",
        "--mode-profile city=before": "goes with --modes",
    }.items():
        assert reason in refused(2, "shape", *words.split(), *launch)
    assert "0ms is no time: write more than 0" in called("shape", "--period", "0ms", *launch).err
    assert not (tmp_path / "out").exists()


def test_missing_build_tools_are_named_before_minutes_are_spent(
    tmp_path: Path, launch_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlatformError, match="colcon, which building the shaping node needs"):
        shape_launch(["ros2", "launch", str(launch_file)], tmp_path / "out", node="cpp")
    assert not (tmp_path / "out").exists()


def test_types_are_those_of_the_recording_that_saw_them(tmp_path: Path) -> None:
    """Discovery of Fast DDS has not always shown all types when a recording ends."""
    plan = whole(small_chain_plan(5_000_000, 20_000_000, core=1))
    ends, known = [("/n", "/t3", "publisher")], "std_msgs/msg/Header"
    folders = [tmp_path / name for name in ("first", "before")]
    for folder in folders:
        folder.mkdir()
    first, before = recorded(folders[0], *ends), recorded(folders[1], *ends, type_=known)
    assert _with_types([first, before], plan) is before
    assert _with_types([before, first], plan) is before
    assert _with_types([first], plan) is first
