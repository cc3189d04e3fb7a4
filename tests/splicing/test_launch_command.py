"""Which launch file a `ros2 launch …` means, and the same command for another one."""

from pathlib import Path

import pytest

from chainshaper.splicing.spliced_launch import parse_launch_command
from chainshaper.values.errors import InputError

ROS2 = "/opt/ros/jazzy/bin/ros2"


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The share folder of a package `robot` in the environment, with one launch file."""
    index = tmp_path / "install/share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "robot").touch()
    share = tmp_path / "install/share/robot"
    (share / "launch").mkdir(parents=True)
    (share / "launch/all.launch.py").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'install'}")
    return share


def test_a_package_and_the_name_of_a_file_anywhere_in_it(share: Path) -> None:
    words = [ROS2, "launch", "-n", "--launch-prefix", "nice", "robot", "all.launch.py"]
    command = parse_launch_command([*words, "speed:=3", "map:=a:=b", "--debug"])
    assert command.file == share / "launch/all.launch.py"
    assert command.arguments == {"speed": "3", "map": "a:=b"}
    assert command.with_file(Path("/copy.py")) == [
        *words[:5],
        "/copy.py",
        "speed:=3",
        "map:=a:=b",
        "--debug",
    ]


def test_a_path_needs_no_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot.launch.xml").touch()
    command = parse_launch_command(["ros2", "launch", "robot.launch.xml", "speed:=3"])
    assert command.file == tmp_path / "robot.launch.xml"
    assert command.with_file(Path("/c.xml")) == ["ros2", "launch", "/c.xml", "speed:=3"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ros2", "run", "robot", "node"], "`ros2 run robot node` is not `ros2 launch"),
        (["ros2", "launch"], "is not `ros2 launch"),
        (["ros2", "launch", "-d"], "no launch file given"),
        (["ros2", "launch", "other", "all.launch.py"], "other: neither a launch file nor a pack"),
        (["ros2", "launch", "robot"], "no launch file given: `ros2 launch robot FILE`"),
        (["ros2", "launch", "robot", "a.launch.py"], "robot has no launch file a.launch.py in /"),
    ],
)
def test_what_cannot_be_launched_is_said(share: Path, words: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_launch_command(words)


def test_two_files_of_one_name_are_told_apart_by_their_path(share: Path) -> None:
    (share / "old").mkdir()
    (share / "old/all.launch.py").touch()
    with pytest.raises(InputError, match=r"has 2 files .*launch/all.launch.py or .*old/all"):
        parse_launch_command(["ros2", "launch", "robot", "all.launch.py"])
