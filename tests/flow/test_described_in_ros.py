"""A described application as nodes of a real ROS 2: recorded, shaped in two ways, and shown."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from command_line import called
from known import known
from small_chain import DDS_CORE, EXECUTOR_CORE, PERIOD_NS, small_chain, small_chain_text

from chainshaper import load_application, measure_latency, open_recording
from chainshaper.analysis import callback_statistics, data_flow
from chainshaper.flow import described_in_ros
from chainshaper.flow.described_in_ros import check_ros, run_in_ros
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.recording import Recording

MS = 1_000_000
CYCLES = 40


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of others on this machine are not heard."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(100 + os.getpid() % 100))


def latencies(path: Path) -> npt.NDArray[np.int64]:
    traversals = measure_latency(path, "/t1../t3").analysis.traversals
    return traversals["latency_ns"].drop_nulls().to_numpy()


@pytest.mark.ros2
@pytest.mark.usefixtures("in_ros2")
@pytest.mark.timeout(400)
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_a_real_ros_2_is_recorded_planned_for_shaped_in_two_ways_and_judged(tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text(small_chain_text())
    folder = tmp_path / "shown"
    words = ("demo", "--ros", "--application", tmp_path / "app.yaml", "--cycles", str(CYCLES))
    done = called(*words, "-o", folder)
    assert done.code == 0, done.err
    assert {path.name for path in folder.iterdir()} == {
        "before", "in_process", "by_node", "plan_in_process.yaml", "plan_by_node.yaml",
        "application.yaml", "comparison.json", "report.html",
    }  # fmt: skip
    assert "ROS 2 nodes, held in the publisher's process" in done.out
    assert "ROS 2 nodes, held by a shaping node" in done.out
    assert "report.html" in done.out
    compared = json.loads((folder / "comparison.json").read_text())["recordings"]
    assert [Path(entry["recording"]).name for entry in compared] == [
        "before", "in_process", "by_node"
    ]  # fmt: skip
    assert_recorded_whole(open_recording(folder / "before"))
    for name in ("in_process", "by_node"):
        recording = open_recording(folder / name)
        assert len(recording.info.pauses_ns) >= 1, "it took turns"
        gates = {thread.comm for thread in recording.info.threads if thread.comm[:5] == "gate-"}
        assert bool(gates) == (name == "in_process")
        before, after = latencies(folder / "before"), latencies(folder / name)
        assert after.size >= CYCLES - 4
        assert middle(after) < middle(before) / 4, "whatever the machine does at times"


def assert_recorded_whole(recording: Recording) -> None:
    info, analysis = recording.info, measure_latency(recording, "/t1../t3").analysis
    assert info.distribution == os.environ.get("ROS_DISTRO", info.distribution)
    assert {*info.processes.values()} == {"/first", "/second", "/third", "/actuator"}
    assert (info.lost, info.realtime) == ({"lost_events": 0}, True)
    executors = [thread for thread in info.threads if thread.role == "executor"]
    assert {(one.policy, one.priority) for one in executors} == {("SCHED_FIFO", 80)}
    assert analysis.period_ns == pytest.approx(PERIOD_NS, rel=0.01)
    assert analysis.statistics.count >= CYCLES + CYCLES // 2 - 4
    assert latencies(recording.path).min() >= 3 * MS, "what is described is spent"


def middle(values: npt.NDArray[np.int64]) -> float:
    """How far apart the middle half of the values is."""
    least, most = np.percentile(values, (25, 75))
    return float(most - least)


@pytest.mark.ros2
@pytest.mark.usefixtures("in_ros2")
@pytest.mark.timeout(200)
def test_a_node_that_fails_is_an_error_with_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "100000")
    with pytest.raises(OperationError, match=r"its nodes said last: .*omain"):
        run_in_ros(small_chain(tmp_path), tmp_path / "recording", cycles=CYCLES)
    assert {path.name for path in tmp_path.iterdir()} <= {"small_chain.yaml", "recording"}


LOOP = f"""\
name: a loop
chain: /scan../command
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  sensor: {{callbacks: [{{timer: 40ms, execution: {{constant: 1ms}}, publishes: [/scan]}}]}}
  controller:
    callbacks:
      - {{loop: 20ms, reads: [/scan], execution: {{constant: 1ms}}, publishes: [/command]}}
  arm: {{callbacks: [{{subscription: /command, execution: {{constant: 100us}}}}]}}
"""


@pytest.mark.ros2
@pytest.mark.usefixtures("in_ros2")
@pytest.mark.timeout(400)
def test_a_chain_leads_through_the_loop_of_a_node_in_python(tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text(LOOP)
    application = load_application(tmp_path / "app.yaml")
    recording = run_in_ros(application, tmp_path / "recording", cycles=CYCLES)
    assert recording.events["loop_named"].select("name", "is_thread").unique().rows() == [
        ("loop", 1)
    ]
    statistics = callback_statistics(data_flow(recording.events))
    (loop,) = statistics.filter(kind="loop", node="/controller").to_dicts()
    assert loop["period_ns"] == 20 * MS
    assert loop["count"] > CYCLES
    for chain in ("/scan../command", "/scan../controller:end"):
        complete = measure_latency(recording.path, chain).analysis.traversals.filter("complete")
        assert CYCLES // 2 < complete.height <= CYCLES + 10, "no repeat counts as a cycle"


def test_without_ros_2_it_says_where_one_comes_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is begun: the folder is not made."""
    (tmp_path / "python3").write_text("#!/bin/sh\necho 'ModuleNotFoundError: rclpy' >&2\nexit 1\n")
    (tmp_path / "python3").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    said = r"no ROS 2 for Python in this environment \(ModuleNotFoundError: rclpy\).*make demo-ros"
    with pytest.raises(PlatformError, match=said):
        check_ros()
    run = subprocess.run(
        [sys.executable, "-m", "chainshaper", "demo", "--ros", "-o", str(tmp_path / "shown")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stderr.count("\n")) == (3, 1)
    assert not (tmp_path / "shown").exists()


def test_the_script_that_brings_the_wheels_says_what_it_lacks(tmp_path: Path) -> None:
    """In a copy of the clone, on a machine without Python 3.12."""
    script = Path(described_in_ros.__file__).parents[3] / "scripts/ros2-wheels"
    (tmp_path / "scripts").mkdir()
    copy = tmp_path / "scripts/ros2-wheels"
    copy.write_bytes(script.read_bytes())
    (tmp_path / "bin").mkdir()
    for tool in ("cat", "cksum", "dirname", "rm"):
        (tmp_path / "bin" / tool).symlink_to(known(shutil.which(tool)))
    run = subprocess.run(
        ["/bin/sh", str(copy)],
        env={"PATH": str(tmp_path / "bin"), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 3
    assert run.stderr.startswith("error: the wheels of ROS 2 Jazzy are for Python 3.12")
    assert run.stderr.count("\n") == 1
    assert not (tmp_path / ".venv-ros").exists()
