"""Chains of a real `ros2 launch` shaped by one command.

Two chains, one of them over two cores: valley parking in small (paper, section 5.1), whose front
filter runs beside the rear one on a core of its own; the second shares a core with it. And one
whose output a thread of Fast DDS publishes, which is held until its slot (design 1).
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, TypeAlias

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
Run: TypeAlias = subprocess.CompletedProcess[str]
LAUNCH = """
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    words = [line.split() for line in {nodes!r}.split('\\n') if line]
    return LaunchDescription([
        Node(executable={program!r}, name=name, arguments=rest,
             prefix='chrt -f 60' if name == 'reader' else '',  # whatever else runs here
             additional_env={profiles!r} if name == 'control' else {{}})
        for name, *rest in words
    ])
"""
PARKING = """
throttler    /raw      0.2  0.5  every 100
rear_filter  /rear     1    4    on /raw
front_filter /front    1    5    on /raw
fusion       /fused    0.2  1    on /rear /front
ndt          /pose     1    5    on /fused
planner      -         0    0.01 on /pose
tick         /ticked   0.2  1    every 50
control      /commands 0.5  3    on /ticked
motor        -         0    0.01 on /commands
"""
DRIVING = """
tick     /ticked    0.2  1     every 100
work     /worked    2    15    on /ticked
control  /commands  1    10    on /worked
reader   -          0    0.01  on /commands
"""
PROFILES = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_writer profile_name="{topic}">
    <qos><publishMode><kind>ASYNCHRONOUS</kind></publishMode></qos>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_writer>
</profiles></dds>
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A node of C++, which is built first."""
    folder = tmp_path_factory.mktemp("nodes")
    for step in (["-S", str(HERE), "-B", str(folder)], ["--build", str(folder)]):
        command = ["env", "cmake", *step]
        run = subprocess.run(
            command, env=ros2_environment(), capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stdout + run.stderr
    return str(folder / "vertex")


def _shaped(file: Path, text: str, *options: str, **variables: str) -> Run:
    """What shaping a launch file says, into the folder `shaped` beside it."""
    file.write_text(text)
    domain = {"ROS_DOMAIN_ID": str(100 + os.getpid() % 100), **variables}
    environment = {**ros2_environment(), **domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, "-m", "chainshaper", "shape", "-o", str(file.parent / "shaped")]
    command += [*options, "--epsilon", "2ms", "--json", "--", "ros2", "launch", str(file)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_two_chains_are_shaped_by_one_command(program: str, tmp_path: Path) -> None:
    folder, (first, *_, last) = tmp_path / "shaped", available_cores()
    chains = ["/raw../rear../pose", "/ticked../commands"]
    options = ["--cores", f"{last},{first}", "--duration", "30s"]
    options += [word for chain in chains for word in ("--chain", chain)]
    text = LAUNCH.format(nodes=PARKING, program=program, profiles={})
    run = _shaped(tmp_path / "parking.launch.py", text, *options)
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


def _driving(program: str, folder: Path, topic: str, duration: str) -> Run:
    """Shape a chain on Fast DDS, whose last node publishes one topic asynchronously."""
    prefixes, rmw = ros2_environment()["AMENT_PREFIX_PATH"].split(":"), "rmw_fastrtps_cpp"
    if not any(Path(prefix, "share", rmw).is_dir() for prefix in prefixes):
        pytest.skip(f"the package {rmw} is not installed in this ROS 2")
    profiles, file = folder / "profiles.xml", folder / "driving.launch.py"
    profiles.write_text(PROFILES.format(topic=topic))
    asked = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profiles), "RMW_FASTRTPS_USE_QOS_FROM_XML": "1"}
    text = LAUNCH.format(nodes=DRIVING, program=program, profiles=asked)
    options = ["--chain", "/ticked../commands", "--publication", "asynchronous"]
    options += ["--publish-slot", "10ms", "--duration", duration]
    return _shaped(file, text, *options, RMW_IMPLEMENTATION=rmw)


def test_the_thread_by_which_fast_dds_publishes_is_held_until_its_slot(
    program: str, tmp_path: Path
) -> None:
    run = _driving(program, tmp_path, "/commands", "30s")
    assert run.returncode == 0, run.stderr[-3000:]
    before, after = json.loads(run.stdout)["recordings"]
    held = open_recording(tmp_path / "shaped" / "after").info.threads
    (thread,) = (one for one in held if one.role == "publisher")
    assert (thread.node, thread.comm) == ("/control", "dds.asyn.0.1")
    assert after["count"] > 200
    assert after["undisturbed"]["spread_ns"] < before["undisturbed"]["spread_ns"] / 4
    assert after["prediction"]["late"] < 5


def test_what_is_published_synchronously_is_not_held_by_anothers_thread(
    program: str, tmp_path: Path
) -> None:
    run = _driving(program, tmp_path, "/rosout", "15s")
    assert run.returncode == 2
    assert "/control publishes /commands synchronously" in run.stderr
    assert not (tmp_path / "shaped" / "after").exists()
