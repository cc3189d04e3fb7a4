"""Spliced launch files in ROS 2 itself: what each node's topics are called, and a launch that runs.

`launch` says what each node would be started with, and `rclpy` what its topics are called then;
neither knows anything of our reading of remap rules.
"""

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused
from launch_cases import CASES, PACKAGES, ROBOTS, Case, plan_for
from ros2 import require_packages, ros2_environment

from chainshaper import ThrottledInput, splice_launch_files, splice_throttlers
from chainshaper.planning import Plan, save_plan

pytestmark = [pytest.mark.ros2("launch_ros"), pytest.mark.timeout(300)]

ASKED = Path(__file__).parent / "launched_nodes.py"
LAUNCHED = Path(__file__).parent / "launched_for_a_while.py"
OUTPUT = Path(__file__).parent / "ros_output.py"
NAMES = ["input", "output", "out", "points", "in", "a", "ndt_pose", "~/out"]
ADDED = ("/chainshaper_pose", "/chainshaper_pose_standby")


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    found = ros2_environment()
    found["AMENT_PREFIX_PATH"] = f"{PACKAGES}{os.pathsep}{found.get('AMENT_PREFIX_PATH', '')}"
    return found | {"ROS_DOMAIN_ID": "94"}


@pytest.fixture(scope="module")
def answers(
    tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]
) -> dict[str, list[Any]]:
    """What ROS 2 says of every case, by its name: pairs of before and after."""
    jobs: list[dict[str, Any]] = []
    names: list[str] = []
    for case in CASES:
        plan = plan_for(case.publisher, case.output)
        for original in case.launch:
            out = tmp_path_factory.mktemp(case.name) / "spliced"
            (copy,) = splice_launch_files(Plan.of(plan), [original], out).launch.values()
            for arguments in (case.arguments, *case.variants):
                more = {"arguments": arguments, "topics": [case.output, *NAMES]}
                jobs += [{"file": str(file), **more} for file in (original, copy)]
                names.append(case.name)
    found = asked(jobs, environment)
    pairs = list(zip(names, zip(found[::2], found[1::2], strict=True), strict=True))
    return {name: [pair for other, pair in pairs if other == name] for name in names}


def asked(jobs: list[dict[str, Any]], environment: dict[str, str]) -> list[Any]:
    """What ROS 2 says: for each job pairs of a node and its names of the topics."""
    run = subprocess.run(
        ["env", "python3", str(ASKED)],
        env=environment,
        input=json.dumps(jobs),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    found: list[Any] = json.loads(run.stdout.splitlines()[-1])  # before it stands what is logged
    return found


def test_ros_2_remaps_who_listens_to_a_throttler_and_nobody_else(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    topics = ["/rear", "/front", "/pose"]
    jobs = []
    for name, text in ROBOTS.items():
        (tmp_path / name).write_text(text)
        inputs = [ThrottledInput(topic="/rear", period_ns=1, subscriber="/fusion")]
        throttled = splice_throttlers(inputs, [tmp_path / name], tmp_path / f"{name}.throttled")
        files = [*throttled.launch.values()]
        plan = plan_for("/fusion", "/pose")
        files += splice_launch_files(
            Plan.of(plan), files, tmp_path / f"{name}.both"
        ).launch.values()
        jobs += [{"file": str(file), "arguments": {}, "topics": topics} for file in files]
    same = {topic: topic for topic in topics}
    throttled_only = {**same, "/rear": "/rear_throttled"}
    wanted = {"/chainshaper_throttler": same, "/player": same, "/fusion": throttled_only}
    both = {**wanted, "/fusion": {**throttled_only, "/pose": "/pose_tmp"}} | dict.fromkeys(
        ADDED, same
    )
    assert [dict(nodes) for nodes in asked(jobs, environment)] == [wanted, both] * len(ROBOTS)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_ros_2_remaps_the_publisher_and_nobody_else(
    case: Case, answers: dict[str, list[Any]]
) -> None:
    shaping, tmp = "/chainshaper" + case.output.replace("/", "_"), f"{case.output}_tmp"
    publishers = 0
    for before, after in answers[case.name]:
        if "cannot import name" in str(before):  # PushROSNamespace, before Jazzy
            pytest.skip(f"this distribution cannot launch the original: {before}")
        assert isinstance(before, list), before
        assert isinstance(after, list), after
        added = (shaping, f"{shaping}_standby")
        ours = [
            (node, topics["input"], topics["output"]) for node, topics in after if node in added
        ]
        assert ours == [(node, tmp, case.output) for node in added]
        others = [(node, topics) for node, topics in after if node not in added]
        assert [node for node, _ in others] == [node for node, _ in before]
        for (node, was), (_, now) in zip(before, others, strict=True):
            has = {name for name, full in was.items() if full == case.output}
            meant = has if node == case.publisher else set()
            publishers += bool(meant)
            assert now == {**was, **dict.fromkeys(meant, tmp)}, node
    assert publishers == len((case.arguments, *case.variants))


@pytest.mark.parametrize(
    "name", ["python_loop", "xml_no_name", "python_event_handler", "xml_container"]
)
def test_a_dry_run_finds_who_would_be_redirected(
    name: str, tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (case,) = (case for case in CASES if case.name == name)
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    save_plan(Plan.of(plan_for(case.publisher, case.output)), tmp_path / "plan.yaml")
    out = tmp_path / "out"
    said = json_of("splice", tmp_path / "plan.yaml", *case.launch, "-o", out, "--dry-run")
    (found,) = said["redirected"]
    assert {one["node"] for one in found["redirected"]} == {case.publisher}
    assert not out.exists()


def test_a_dry_run_fails_where_nothing_would_be_redirected_or_too_much(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    robot, plan = tmp_path / "robot.launch.xml", tmp_path / "plan.yaml"
    save_plan(Plan.of(plan_for("/ndt", "/pose")), plan)
    node = '<node pkg="l" exec="n" name="{}"/>'
    arguments = ("splice", plan, robot, "-o", tmp_path / "out", "--dry-run")
    for names, said in {
        ("icp", "player"): "no node /ndt runs; started were /icp, /player",
        ("ndt", "ndt"): "more was redirected than meant: /ndt was started more than once",
    }.items():
        robot.write_text(f"<launch>{''.join(map(node.format, names))}</launch>")
        assert said in refused(1, *arguments)
    robot.write_text('<launch><arg name="n"/><node pkg="l" exec="n" name="$(var n)"/></launch>')
    assert "ndt:/pose:=/pose_tmp" in called(*arguments, "n:=ndt").out
    run = ("--", "ros2", "run", "l", "n", "--ros-args", "-r", "__node:=ndt")
    assert "ndt:/pose:=/pose_tmp" in called(*arguments[:2], *arguments[3:], *run).out


NODES = """
import sys
from launch import LaunchDescription
from launch.actions import ExecuteProcess, RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessStart
from launch_ros.actions import *
from launch_ros.descriptions import ComposableNode

PROGRAM = [{program!r}, "publisher", {log!r}]
MORE = dict(executable="python3", arguments=PROGRAM, remappings=[("output", "/pose")])
TALKER = [ComposableNode(package="composition", plugin="composition::Talker", name="ndt",
                         remappings=[("chatter", "/pose")])]
CONTAINER = dict(package="rclcpp_components", executable="component_container", name="c",
                 namespace="")
RUN = [*("python3", *PROGRAM), "--ros-args", "-r", "__node:=ndt", "-r", "output:=/pose"]


def generate_launch_description():
    return LaunchDescription([{actions}])
"""


@pytest.fixture
def launched(tmp_path: Path, environment: dict[str, str]) -> Iterator[Any]:
    """Launch actions for a while, spliced for `/ndt`; the exit code, and what was said."""
    running: list[subprocess.Popen[str]] = []

    def launch(actions: str, publisher: str = "/ndt") -> tuple[int, str]:
        robot = tmp_path / "robot.launch.py"
        texts = {"program": str(OUTPUT), "log": str(tmp_path / "log"), "actions": actions}
        robot.write_text(NODES.format(**texts))
        plan = plan_for(publisher, "/pose")
        (copy,) = splice_launch_files(Plan.of(plan), [robot], tmp_path / "spliced").launch.values()
        run = subprocess.Popen(
            ["env", "python3", str(LAUNCHED), str(copy), "chainshaper_within:=10"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        running.append(run)
        said, _ = run.communicate(timeout=120)
        return run.returncode, said

    yield launch
    for run in running:
        with contextlib.suppress(ProcessLookupError):  # a shell leaves its child behind
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()


@pytest.mark.parametrize(
    ("actions", "publisher"),
    [
        ("Node(name='ndt', **MORE)", "/ndt"),
        ("Node(name='ndt', namespace='loc', **MORE)", "/loc/ndt"),
        ("Node(**MORE)", "/publisher"),  # the program gives the name
        ("LifecycleNode(name='ndt', namespace='', **MORE)", "/ndt"),
        (
            "ComposableNodeContainer(composable_node_descriptions=TALKER, **CONTAINER)",
            "/ndt",
        ),
        (
            "Node(**CONTAINER), "
            "LoadComposableNodes(target_container='c', composable_node_descriptions=TALKER)",
            "/ndt",
        ),
        ("ExecuteProcess(cmd=RUN)", "/ndt"),
        ("ExecuteProcess(cmd=[' '.join(RUN)], shell=True)", "/ndt"),
        ("TimerAction(period=3.0, actions=[Node(name='ndt', **MORE)])", "/ndt"),
        (
            "RegisterEventHandler(OnProcessStart(on_start=lambda event, context: "
            "None if 'later' in sys.argv else (sys.argv.append('later'), "
            "[Node(name='ndt', **MORE)])[1]))",
            "/ndt",
        ),
    ],
)
def test_a_launch_that_redirects_what_is_meant_goes_on(
    launched: Any, actions: str, publisher: str
) -> None:
    if "TALKER" in actions:
        require_packages("composition")
    code, said = launched(actions, publisher)
    assert f"/pose of {publisher} is redirected: /pose_tmp" in said, said
    assert code == 0, said


@pytest.mark.parametrize(
    ("actions", "mistake"),
    [
        (
            "Node(name='icp', **MORE)",
            "/pose: nothing was redirected: no node /ndt runs; started were /icp. Publishers "
            "found: of /pose /icp; of /pose_tmp none.",
        ),
        (
            "Node(name='ndt', **MORE), Node(name='ndt', **MORE)",
            "/pose: more was redirected than meant: /ndt was started more than once.",
        ),
        (
            "Node(name='ndt', **MORE), Node(name='icp', **MORE)",
            "/pose: /icp publishes it past /chainshaper_pose, /chainshaper_pose_standby.",
        ),
    ],
)
def test_a_launch_that_redirects_nothing_or_too_much_ends_and_says_so(
    launched: Any, actions: str, mistake: str
) -> None:
    code, said = launched(actions)
    assert mistake in said, said
    assert code == 1, said
