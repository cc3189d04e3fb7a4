"""Real component containers, in which one point cloud of 4 MB is handed on, and shaped, uncopied.

The nodes are in `clouds`, which counts what the container's process allocates.
"""

import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ros2 import ros2_environment

from chainshaper import measure_latency, open_recording, splice_launch_files
from chainshaper.analysis import data_flow
from chainshaper.analysis.messages import gate_decisions
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.planning import ChainPlan, Plan, Profile, plan_chain
from chainshaper.splicing.spliced_launch import NODES
from chainshaper.values import events

pytestmark = [pytest.mark.ros2("rclcpp_components", "launch_ros"), pytest.mark.timeout(900)]

HERE = Path(__file__).parent
MS = 1_000_000
TYPE = "sensor_msgs/msg/PointCloud2"
CLOUD = re.compile(r"cloud (same|copied), (\d+) large allocations")


def built(folder: Path, what: Path, environment: dict[str, str]) -> dict[str, str]:
    """The environment with the packages in a folder, built below another one."""
    command = ["colcon", "build", "--base-paths", str(what), "--merge-install"]
    run = subprocess.run(
        ["env", *command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    sourced = ["bash", "-c", 'source "$1" && env -0', "bash", str(folder / "install/setup.bash")]
    said = subprocess.run(sourced, env=environment, capture_output=True, check=True).stdout
    return dict(pair.split("=", 1) for pair in said.decode().split("\0") if "=" in pair)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("clouds")
    return built(folder, HERE / "clouds", ros2_environment())


@pytest.fixture(scope="module")
def plan() -> ChainPlan:
    latencies = np.linspace(5 * MS, 26 * MS, 300).astype(np.int64)
    profile = Profile(latencies, 100 * MS, nodes=("/source", "/filter"), topics=("/raw", "/points"))
    profile = replace(profile, core_of={"/source": 1, "/filter": 1}, intra_process=True)
    return plan_chain(profile)


@pytest.fixture(scope="module")
def with_node(
    clouds: dict[str, str], plan: ChainPlan, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, str]:
    """The environment with the shaping node's package too."""
    folder = tmp_path_factory.mktemp("node")
    launch = HERE / "clouds/launch/clouds.launch.py"
    splice_launch_files(Plan.of(plan), [launch], folder / "out", node="cpp", message_type=TYPE)
    return built(folder, folder / "out" / NODES, clouds)


def handed_on(said: str) -> list[tuple[str, int]]:
    """Of each cloud whether it is the same, and the large allocations so far."""
    return [(how, int(count)) for how, count in CLOUD.findall(said)]


@pytest.mark.parametrize(
    ("language", "arguments"),
    [
        ("py", ["container:=component_container"]),
        ("xml", ["container:=component_container_isolated"]),
        ("yaml", ["container:=component_container_mt"]),
        ("py", ["apart:=source"]),
    ],
)
def test_a_container_loads_the_shaping_node_and_nothing_is_copied(
    with_node: dict[str, str], plan: ChainPlan, language: str, arguments: list[str], tmp_path: Path
) -> None:
    launch = HERE / f"clouds/launch/clouds.launch.{language}"
    spliced = splice_launch_files(
        Plan.of(plan), [launch], tmp_path / "out", node="cpp", message_type=TYPE
    )
    (file,) = spliced.launch.values()
    counting = Path(with_node["AMENT_PREFIX_PATH"].split(":")[1]) / "lib/liblarge_allocations.so"
    assert counting.is_file()
    environment = {**with_node, "LD_PRELOAD": str(counting), "PYTHONUNBUFFERED": "1"}
    apart = "apart:=source" in arguments
    running = subprocess.Popen(
        ["env", "ros2", "launch", str(file), *arguments, "chainshaper_within:=8"],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = running.communicate(timeout=12)
    except subprocess.TimeoutExpired:
        running.send_signal(signal.SIGINT)  # without a terminal, launch signals its nodes itself
        said, _ = running.communicate(timeout=20)
    assert "/points of /filter is redirected: /points_tmp" in said
    # At times launch itself loses the child that it waits for, and says so.
    ended = len(re.findall("process has finished cleanly|Unknown child process", said))
    assert ended == 1 + apart, said
    found = handed_on(said)
    assert len(found) > 50
    assert {how for how, _ in found} == {"same"}
    if not apart:  # one for each cloud, that of the source; some are overwritten on a busy machine
        assert found[-1][1] - found[0][1] < 1.3 * len(found)


@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
@pytest.mark.skipif(len(available_cores()) < 2, reason="two cores are needed")
def test_it_is_shaped_by_one_command(clouds: dict[str, str], tmp_path: Path) -> None:
    words = ["shape", "--node", "cpp", "--chain", "/raw../points", "--duration", "12s"]
    application = ["ros2", "launch", "clouds", "clouds.launch.xml"]
    run = subprocess.run(
        [sys.executable, "-m", "chainshaper", *words, "-o", "out", "--", *application],
        cwd=tmp_path,
        env=clouds,
        capture_output=True,
        text=True,
        check=False,
    )
    # 1: a promise is broken on a busy machine. Without a comparison, it is an error's.
    assert run.returncode in (0, 1), run.stderr
    assert (tmp_path / "out/comparison.json").is_file(), run.stderr
    assert {how for how, _ in handed_on(run.stderr)} == {"same"}
    before, after = (open_recording(tmp_path / "out" / name) for name in ("before", "after"))
    unshaped, shaped = (measure_latency(one, "/raw../points").analysis for one in (before, after))
    was, now = unshaped.statistics.spread_ns, shaped.statistics.spread_ns
    assert was is not None
    assert now is not None
    assert now < was / 10
    flow = data_flow(after.events, after.info.clock_offset_ns)
    publishers = flow.objects.publishers
    own = publishers.filter(publishers["topic"].is_in(["/raw", "/points", "/points_tmp"]))
    written = events.table(after.events, "rmw_publish")["rmw_publisher_handle"]
    assert own.height == 3
    assert {*own["rmw_handle"]}.isdisjoint(written), "nothing is serialized"
    decided = gate_decisions(after.events, flow.objects)
    assert decided.height == events.table(after.events, "gate_release").height > 50
    assert decided["source_timestamp"].null_count() == decided.height
