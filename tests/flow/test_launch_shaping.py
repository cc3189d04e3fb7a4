"""Shaping a `ros2 launch`: what is refused before anything is launched.

The flow itself needs ROS 2 and minutes; every step of it is tested where it is at home.
"""

from pathlib import Path

import pytest
from bare_recordings import recorded
from command_line import refused
from small_chain import small_chain_plan

from chainshaper.flow.launch_shaping import _with_types
from chainshaper.planning.application_plan import whole


def test_what_cannot_be_shaped_is_refused_before_anything_is_launched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = tmp_path / "robot.launch.xml", tmp_path / "out"
    file.write_text("<launch/>\n")
    for words, reason in {
        "robot.yaml": "`shape APP.yaml plan.yaml -o REC`",
        "robot.yaml plan.yaml --bands 2": "is shaped as plan.yaml says",
        "-- sleep 1": "is not `ros2 launch",
        "--chain /a../b --chain /c../d --sink /a../e LAUNCH": "--sink goes with one chain",
        "--throttle /in=100ms LAUNCH": "Name it: NODE:/in=PERIOD",
        "--throttle /node:/in LAUNCH": "write a topic and a period",
        "--policy pipelined --sink /a../e LAUNCH": "further sinks are shaped",
        "--modes /mode:city,highway LAUNCH": "nothing says which mode was in force",
        "--mode-profile city=before LAUNCH": "goes with --modes",
    }.items():
        given = words.replace("LAUNCH", f"-- ros2 launch {file}").split()
        assert reason in refused(2, "shape", "-o", out, *given)
    launch = ("--", "ros2", "launch", file)
    said = refused(3, "shape", "-o", out, "--cores", "0,4000", *launch)
    assert "core 4000, which --cores asks for" in said
    assert "exists already and is not overwritten" in refused(2, "shape", "-o", tmp_path, *launch)
    monkeypatch.setenv("PATH", str(tmp_path))
    said = refused(3, "shape", "-o", out, "--node", "cpp", *launch)
    assert "colcon, which building the shaping node needs" in said, "before minutes are spent"
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


def test_types_are_those_of_the_recording_that_saw_them(tmp_path: Path) -> None:
    """Discovery of Fast DDS has not always shown all types when a recording ends."""
    plan = whole(small_chain_plan(5_000_000, 20_000_000, core=1))
    ends, known = [("/n", "/t3", "publisher")], "std_msgs/msg/Header"
    folders = [tmp_path / name for name in ("first", "before")]
    for folder in folders:
        folder.mkdir()
    first, before = recorded(folders[0], *ends), recorded(folders[1], *ends, type_=known)
    assert _with_types([first, before], plan) is before
    assert _with_types([first], plan) is first
