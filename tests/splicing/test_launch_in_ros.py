"""Spliced launch files, before and after, asked of ROS 2 itself.

`launch` says what each node would be started with, and `rclpy` what its topics are called then.
Neither knows anything of our reading of launch files or of remap rules.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from launch_cases import CASES, PACKAGES, ROBOTS, Case, splice_case
from ros2 import ros2_environment

from chainshaper import ThrottledInput, splice_throttlers

pytestmark = pytest.mark.ros2

ASKED = Path(__file__).parent / "launched_nodes.py"
NAMES = ["input", "output", "out", "points", "in", "a", "ndt_pose", "~/out"]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """What ROS 2 says of every case, by its name: pairs of before and after."""
    environment = ros2_environment()
    prefixes = environment.get("AMENT_PREFIX_PATH", "")
    environment["AMENT_PREFIX_PATH"] = f"{PACKAGES}{os.pathsep}{prefixes}"
    jobs: list[dict[str, Any]] = []
    names: list[str] = []
    for case in CASES:
        with pytest.MonkeyPatch.context() as monkeypatch:
            spliced = splice_case(case, tmp_path_factory.mktemp(case.name), monkeypatch)
        ((original, copy),) = spliced.launch.items()
        for arguments in (case.arguments, *case.variants):
            more = {"arguments": arguments, "topics": [case.output, *NAMES]}
            jobs += [{"file": str(file), **more} for file in (original, copy)]
            names.append(case.name)
    found = _asked(jobs, environment)
    pairs = list(zip(names, zip(found[::2], found[1::2], strict=True), strict=True))
    return {name: [pair for other, pair in pairs if other == name] for name in names}


def _asked(jobs: list[dict[str, Any]], environment: dict[str, str]) -> list[Any]:
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
    answers: list[Any] = json.loads(run.stdout.splitlines()[-1])  # before it stands what is logged
    return answers


def test_ros_2_remaps_who_listens_to_a_throttler_and_nobody_else(tmp_path: Path) -> None:
    topics = ["/rear", "/front"]
    jobs = []
    for name, text in ROBOTS.items():
        (tmp_path / name).write_text(text)
        inputs = [ThrottledInput(topic="/rear", period_ns=1, subscriber="/fusion")]
        out = tmp_path / f"{name}.throttled"
        (copy,) = splice_throttlers(inputs, [tmp_path / name], out).launch.values()
        jobs.append({"file": str(copy), "arguments": {}, "topics": topics})
    same = {topic: topic for topic in topics}
    for nodes in _asked(jobs, ros2_environment()):
        assert dict(nodes) == {
            "/chainshaper_throttler": same,
            "/player": same,
            "/fusion": {**same, "/rear": "/rear_throttled"},
        }


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_ros_2_remaps_the_publisher_and_nobody_else(
    case: Case, answers: dict[str, list[Any]]
) -> None:
    shaping, tmp = "/chainshaper" + case.output.replace("/", "_"), f"{case.output}_tmp"
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
        assert case.publisher in [node for node, _ in before]
        for (node, was), (_, now) in zip(before, others, strict=True):
            changed = {name: full for name, full in now.items() if full != was[name]}
            if node == case.publisher:
                # What a rule led to the output; without one, the output's own name counts.
                led = {name for name in NAMES if was[name] == case.output}
                assert changed == dict.fromkeys(changed, tmp)
                assert changed.keys() - {case.output} == led
                assert led or case.output in changed
            else:
                # A rule bound to a name is heard by whoever has it, in any namespace.
                namesake = node.rpartition("/")[2] == case.publisher.rpartition("/")[2]
                assert not changed or (namesake and changed == {case.output: tmp}), node
