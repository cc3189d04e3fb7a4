"""Two chains of a real `ros2 launch` shaped by one command, one of them over two cores.

The first is valley parking in small (paper, section 5.1): the front filter runs beside the rear one
on a core of its own. The second shares a core with it.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ros2 import ros2_environment

from chainshaper import load_application_plan, open_recording
from chainshaper.linux.scheduling import available_cores, may_use_fifo

pytestmark = [
    pytest.mark.ros2,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here"),
    pytest.mark.skipif(len(available_cores()) < 2, reason="two cores are needed"),
]

HERE = Path(__file__).parent
LAUNCH = """
from launch import LaunchDescription
from launch_ros.actions import Node

NODES = '''
throttler    /raw      0.2  0.5  every 100
rear_filter  /rear     1    4    on /raw
front_filter /front    1    5    on /raw
fusion       /fused    0.2  1    on /rear /front
ndt          /pose     1    5    on /fused
planner      -         0    0.01 on /pose
tick         /ticked   0.2  1    every 50
control      /commands 0.5  3    on /ticked
motor        -         0    0.01 on /commands
'''


def generate_launch_description():
    words = [line.split() for line in NODES.split('\\n') if line]
    return LaunchDescription(
        [Node(executable={program!r}, name=name, arguments=rest) for name, *rest in words]
    )
"""


@pytest.fixture(scope="module")
def launch_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A launch file of nodes of C++, which are built first."""
    folder = tmp_path_factory.mktemp("nodes")
    for step in (["-S", str(HERE), "-B", str(folder)], ["--build", str(folder)]):
        command = ["env", "cmake", *step]
        run = subprocess.run(
            command, env=ros2_environment(), capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stdout + run.stderr
    file = folder / "parking.launch.py"
    file.write_text(LAUNCH.replace("{program!r}", repr(str(folder / "vertex"))))
    return file


def test_two_chains_are_shaped_by_one_command(launch_file: Path, tmp_path: Path) -> None:
    domain = {"ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    environment = {**ros2_environment(), **domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    folder, (first, *_, last) = tmp_path / "shaped", available_cores()
    chains = ["/raw../rear../pose", "/ticked../commands"]
    options = ["--cores", f"{last},{first}", "--epsilon", "2ms", "--duration", "30s", "--json"]
    options += [word for chain in chains for word in ("--chain", chain)]
    command = [sys.executable, "-m", "chainshaper", "shape", "-o", str(folder), *options]
    command += ["--", "ros2", "launch", str(launch_file)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-3000:]
    values: dict[str, Any] = json.loads(run.stdout)

    cores = values["cores"]
    beside, *others = (cores[f"/{one}"] for one in ("front_filter", "throttler", "fusion", "ndt"))
    assert (beside, {*others}) == (first, {last}), "a branch that the chain waits for"
    assert cores["/rear_filter"] == last
    assert [one["chain"] for one in values["chains"]] == chains
    assert values["recordings"] == values["chains"][0]["recordings"], "as for one chain"
    profiled = [open_recording(folder / name).info for name in ("before", "before_2")]
    raised = [{t.node for t in one.threads if t.policy == "SCHED_FIFO"} for one in profiled]
    assert {"/front_filter", "/ndt"} <= raised[0]
    assert {"/tick", "/control"} <= raised[1]
    assert not raised[0] & raised[1], "each is measured as if it were alone"
    plan = load_application_plan(folder / "plan.yaml")
    assert [chain.chain.output for chain in plan.chains] == ["/pose", "/commands"]
    assert {server.core for server in plan.chains[0].servers} == {first, last}
    for one in values["chains"]:
        before, after = one["recordings"]
        assert after["count"] > 100
        assert after["prediction"]
        assert after["spread_ns"] < before["spread_ns"]
    assert (folder / "chain_2" / "latency.png").is_file()
