"""The eBPF tracer on a real ROS 2, attached to two nodes of its demonstration that run already."""

import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import called, json_of
from traced_program import skip_without_bpftrace

PACKAGE = "demo_nodes_cpp"


@pytest.fixture
def nodes(in_ros2: None) -> Iterator[list[int]]:
    """Processes of a talker and a listener."""
    skip_without_bpftrace()
    package = ["ros2", "pkg", "prefix", PACKAGE]
    prefix = subprocess.run(package, capture_output=True, text=True, check=True)
    folder = Path(prefix.stdout.strip()) / "lib" / PACKAGE
    running = [
        subprocess.Popen(
            [folder / name, "--ros-args", "-r", "__ns:=/traced", "-r", "chatter:=/traced/chatter"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for name in ("talker", "listener")
    ]
    time.sleep(2)  # for their objects to exist, and for them to have found each other
    yield [process.pid for process in running]
    for process in running:
        process.send_signal(signal.SIGINT)
        process.wait(20)


@pytest.mark.ros2("demo_nodes_cpp", "ros2pkg")
def test_running_nodes_get_their_names_topics_and_callbacks(
    nodes: list[int], tmp_path: Path
) -> None:
    recording = tmp_path / "recording"
    pids = [argument for pid in nodes for argument in ("--pid", str(pid))]
    made = called("record", "--source", "ebpf", "-o", recording, "--duration", "8s", *pids)
    assert made.code == 0, made.err
    callbacks = {
        (row["node"], row["kind"], row["topic"]): row
        for row in json_of("callbacks", recording, "--json")
    }
    timer = callbacks["/traced/talker", "timer", None]
    reader = callbacks["/traced/listener", "subscription", "/traced/chatter"]
    assert 0 < reader["execution_ns"]["mean"] <= reader["response_ns"]["mean"]
    assert abs(reader["count"] - timer["count"]) <= 1
    functions = {
        callback["kind"]: callback["symbol"]
        for callback in json_of("graph", recording)["callbacks"]
    }
    assert "Talker" in functions["timer"]
    contents = json_of("info", recording, "--json")
    assert sorted(contents["processes"].values()) == ["/traced/listener", "/traced/talker"]
    assert contents["lost"] == {"lost_events": 0}
