"""`ros2 launch --shape` and the action `Shape` in launch files, carried out by ROS 2 itself."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
from launch_cases import plan_for
from processes import wait_for
from ros2 import ros2_environment

import chainshaper
from chainshaper.planning import Plan, save_plan

pytestmark = [pytest.mark.ros2("launch_ros", "ros2launch"), pytest.mark.timeout(300)]

HERE = Path(__file__).parent
COMMAND = ["env", "python3", str(HERE / "launched_with_chainshaper.py"), sys.executable]
ROWS = 5  # of the shaping node's log, after which a launch is ended
PROGRAM = ["python3", str(HERE / "ros_output.py"), "publisher"]
PYTHON = """
from chainshaper.launch_actions import Shape
from launch import LaunchDescription
from launch.actions import ExecuteProcess

def generate_launch_description():
    return LaunchDescription([{shape}ExecuteProcess(cmd={words!r})])
"""
XML = """<launch>{shape}<executable cmd="{command}"/></launch>
"""
YAML = """launch:
{shape}- executable: {{cmd: "{command}"}}
"""
ROBOTS = {  # by file: its text, and that of the action in it
    "robot.launch.py": (PYTHON, "Shape(plan={plan!r}), "),
    "robot.launch.xml": (XML, '<shape plan="{plan}"/>'),
    "robot.launch.yaml": (YAML, "- shape: {{plan: {plan}}}\n"),
}


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """ROS 2, whose Python finds our modules and entry points, and nothing else of ours."""
    folder = tmp_path_factory.mktemp("installed")
    (folder / "chainshaper").symlink_to(Path(chainshaper.__file__).parent)
    ours = distribution("chainshaper")
    info = folder / f"chainshaper-{ours.version}.dist-info"
    info.mkdir()
    for name in ("METADATA", "entry_points.txt"):
        (info / name).write_text(ours.read_text(name) or "")
    found = ros2_environment()
    found["PYTHONPATH"] = f"{folder}{os.pathsep}{found.get('PYTHONPATH', '')}"
    return found | {"ROS_DOMAIN_ID": "95", "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.fixture
def launched(tmp_path: Path, environment: dict[str, str]) -> Iterator[Any]:
    """Run `ros2 launch` with these words until an output was shaped, or until it ends.

    Returns its exit code, and what it said.
    """
    running: list[subprocess.Popen[bytes]] = []

    def launch(*words: str) -> tuple[int, str]:
        with (tmp_path / "said").open("w") as said:
            run = subprocess.Popen(
                [*COMMAND, "launch", *words],
                env=environment | {"ROS_LOG_DIR": str(tmp_path / "logs")},
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        running.append(run)
        wait_for(
            lambda: run.poll() is not None or len(rows(tmp_path)) > ROWS, "a shaped output", 200
        )
        run.send_signal(signal.SIGINT)
        return run.wait(60), (tmp_path / "said").read_text()

    yield launch
    for run in running:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()


def rows(folder: Path) -> list[str]:
    """Return the lines of the shaping node's log, wherever the launch has it."""
    logs = (folder / "logs").rglob("chainshaper_pose.csv")
    return [line for log in logs for line in log.read_text().splitlines()]


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    save_plan(Plan.of(plan_for("/ndt", "/pose")), tmp_path / "plan.yaml")
    return tmp_path / "plan.yaml"


def robot_file(folder: Path, name: str, plan: Path | None) -> str:
    """A launch file in the language of its name, with the action if it gets a plan."""
    words = [*PROGRAM, str(folder / "published"), "--ros-args"]
    words += ["-r", "__node:=ndt", "-r", "output:=/pose"]
    text, action = ROBOTS[name]
    shape = "" if plan is None else action.format(plan=str(plan))
    (folder / name).write_text(text.format(shape=shape, words=words, command=" ".join(words)))
    return str(folder / name)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_action_shapes_what_is_launched_behind_it(
    launched: Any, tmp_path: Path, plan: Path, name: str
) -> None:
    code, said = launched(robot_file(tmp_path, name, plan))
    assert len(rows(tmp_path)) > ROWS, "the shaping node took the output, and noted what it did"
    (log,) = (tmp_path / "logs").rglob("chainshaper_pose.csv")
    assert str(log) in said
    assert code in (0, 1), said  # 1: launch was ended by Ctrl-C


def test_the_option_shapes_any_launch_file_and_leaves_it_alone(
    launched: Any, tmp_path: Path, plan: Path
) -> None:
    robot = robot_file(tmp_path, "robot.launch.xml", None)
    before = Path(robot).read_bytes()
    code, said = launched("--shape", str(plan), robot, "chainshaper_within:=60")
    assert len(rows(tmp_path)) > ROWS, said
    assert Path(robot).read_bytes() == before
    assert code in (0, 1), said


def test_a_wrong_plan_ends_the_launch_and_says_why(launched: Any, tmp_path: Path) -> None:
    robot = robot_file(tmp_path, "robot.launch.py", tmp_path / "none.yaml")
    code, said = launched(robot)
    assert f"nothing is shaped: {tmp_path}/none.yaml" in said, said
    assert code == 1
    assert not (tmp_path / "published").exists(), "and no node was started"
