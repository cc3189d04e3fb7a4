"""callback_isolated_executor itself: a plan's export is what its thread configurator puts in force.

Its packages have to be in the ROS 2 that is sourced. The nodes are `callback_isolated/nodes.cpp`.
"""

import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of
from processes import wait_for
from ros2 import ros2_environment

from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.values.callback_groups import read_group_configuration

pytestmark = [
    pytest.mark.ros2("rclcpp", "cie_thread_configurator", "callback_isolated_executor"),
    pytest.mark.timeout(400),
    pytest.mark.skipif(
        not may_use_fifo(),
        reason="SCHED_FIFO is not permitted here: run as root to have this tested",
    ),
]

SOURCE = Path(__file__).parent / "callback_isolated/nodes.cpp"
LIBRARIES = (
    *("callback_isolated_executor", "thread_configurator", "rclcpp", "rcl", "rmw", "rcutils"),
    *("tracetools", "libstatistics_collector", "statistics_msgs__rosidl_typesupport_cpp"),
    *("geometry_msgs__rosidl_typesupport_cpp", "cie_config_msgs__rosidl_typesupport_cpp"),
)
GROUPS = {
    "/source@Timer(100000000)",
    "/filter@Subscription(/points)",
    "/control@Subscription(/filtered)",
}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The nodes, compiled with the ROS 2 that is here."""
    environment, compiler = ros2_environment(), shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so a node in C++ cannot be compiled")
    prefixes = [Path(prefix) for prefix in environment["AMENT_PREFIX_PATH"].split(":")]
    # Behind the system's own: message packages have headers of such names.
    folders = [folder for prefix in prefixes for folder in (prefix / "include").glob("*/")]
    include = [f"-idirafter{folder}" for folder in (*folders, *(p / "include" for p in prefixes))]
    linked = [f"-L{prefix / 'lib'}" for prefix in prefixes] + [f"-l{name}" for name in LIBRARIES]
    path = tmp_path_factory.mktemp("isolated") / "nodes"
    words = [compiler, "-std=c++17", str(SOURCE), "-o", str(path), *include, *linked]
    subprocess.run([*words, "-Wl,--allow-shlib-undefined"], check=True, timeout=300)
    return path


def _threads(pid: int, *options: str) -> list[dict[str, Any]]:
    return list(json_of("threads", str(pid), *options)["threads"])


@pytest.mark.usefixtures("in_ros2")
def test_their_configurator_puts_in_force_what_a_plan_was_exported_as(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "96")
    recording, plan, file = (tmp_path / name for name in ("rec", "plan.yaml", "groups.yaml"))
    sink = subprocess.Popen([program, "sink"])
    try:
        finished = called(
            "record", "-o", recording, "--duration", "6s", "--", str(program), "chain"
        )
        assert finished.code == 0, finished
        chain = ("--chain", "/source../command")
        finished = called("plan", recording, *chain, "--policy", "server-per-chain", "-o", plan)
        assert finished.code == 0, finished
        written = plan.read_text()
        assert all(f"callback_group: {group}" in written for group in GROUPS), written
        options = ("--callback-groups", "--plan", plan, "-o", file)
        finished = called("export", recording, *options)
        assert finished.code == 0, finished
        entries = {
            entry.id: entry for entry in read_group_configuration(file).callback_groups or ()
        }
        assert entries.keys() == GROUPS
        words = ("ros2", "run", "cie_thread_configurator", "thread_configurator_node")
        configurator = subprocess.Popen(
            [*words, "--config-file", str(file)], stdout=subprocess.PIPE, text=True
        )
        run = subprocess.Popen([program, "chain"])
        try:
            given = ("--callback-groups", str(file), "--recording", str(recording))
            wait_for(
                lambda: (
                    {
                        thread["callback_group"]
                        for thread in _threads(run.pid, *given)
                        if thread["callback_group"] and thread["differs"] is None
                    }
                    == GROUPS
                ),
                "what the file gives",
            )
            out, _ = configurator.communicate(timeout=60)
            assert configurator.returncode == 0, out
        finally:
            for process in (run, configurator):
                process.send_signal(signal.SIGINT)
                process.wait(timeout=60)
    finally:
        sink.send_signal(signal.SIGINT)
        sink.wait(timeout=60)
