"""The shaping node and the throttler in a real ROS 2 environment, all three kinds."""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import polars as pl
import pytest
from known import known
from node_run import SLOTS, banded
from ros2 import ros2_environment

from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import revised
from chainshaper.robot.throttling import RULES, Rule
from chainshaper.sources.gate_log import read_gate_log
from chainshaper.sources.ros import own_environment, run_with_rclpy
from chainshaper.sources.ros import script as ros_script
from chainshaper.splicing.node_kinds import NodeKind
from chainshaper.splicing.node_packages import build_package
from chainshaper.splicing.shaping_process import (
    ShapingProcess,
    write_shaping_process,
    write_throttler,
)
from chainshaper.values.plan_choices import NodeLanguage

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(600)]

MS = 1_000_000
TYPE = "geometry_msgs/msg/PointStamped"
COUNTERPART = Path(__file__).parent / "ros_counterpart.py"
COUNT = 30

GENERIC, TYPED = (
    pytest.param(kind, marks=pytest.mark.ros2("rclcpp")) for kind in ("generic", "typed")
)


@pytest.fixture(autouse=True, scope="module")
def in_ros_environment() -> Iterator[None]:
    with mock.patch.dict(os.environ, ros2_environment()):
        yield


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, plan: ChainPlan) -> Path:
    if shutil.which("colcon") is None:
        pytest.skip("colcon is not on the PATH, so no package can be built")
    folder = tmp_path_factory.mktemp("workspace")
    for kind in ("generic", "typed"):
        written(plan, kind, folder)
    build_package(folder)
    return folder


@pytest.fixture
def place(kind: NodeKind, request: pytest.FixtureRequest) -> Path | None:
    return None if kind == "python" else request.getfixturevalue("workspace")


def written(
    plan: ChainPlan, kind: NodeKind, folder: Path, log: Path | None = None
) -> ShapingProcess:
    assert plan.shaping_node is not None
    return write_shaping_process(plan, plan.shaping_node, kind, folder, message_type=TYPE, log=log)


@contextmanager
def started(
    process: ShapingProcess, workspace: Path | None, exit_code: int = 0
) -> Iterator["subprocess.Popen[str]"]:
    """The process as a launch file would start it; ended by SIGINT, which it must obey."""
    command = process.command_line
    if process.package is not None and workspace is not None and process.executable is not None:
        folder = workspace / "install" / "lib" / process.package
        command = [str(folder / process.executable), *command]
    child = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield child
        for _ in range(20_000):  # `ros2 launch` hands on what it got itself, whenever that is
            child.send_signal(signal.SIGINT)
            if child.poll() is not None:
                break
            time.sleep(0.001)
        assert child.wait(1) == exit_code
    finally:
        child.kill()
        child.wait()


def exchanged(quality: str, count: int = COUNT, period_s: float = 0.05) -> list[dict[str, Any]]:
    """What the counterpart saw of the output: its quality of service, then each message."""
    run = subprocess.run(
        ["python3", COUNTERPART, str(count), quality, str(period_s)],
        capture_output=True,
        text=True,
        check=True,
        timeout=90,
    )
    return [json.loads(line) for line in run.stdout.splitlines()]


def rclpy_has_source_timestamps() -> bool:
    """Humble's does not; a ROS 2 that was built from source need not say its name."""
    asked = "from rclpy.subscription import Subscription; Subscription.CallbackType"
    return (
        subprocess.run(["python3", "-c", asked], capture_output=True, check=False).returncode == 0
    )


@pytest.mark.parametrize("quality", ["latched", "best_effort"])
@pytest.mark.parametrize("kind", ["python", GENERIC, TYPED])
def test_messages_come_back_in_the_slot_of_their_mode(
    tmp_path: Path, plan: ChainPlan, kind: NodeKind, quality: str, place: Path | None
) -> None:
    plan, log = banded(plan), tmp_path / "gate.csv"
    process = written(plan, kind, tmp_path, log)
    with started(process, place):
        offered, *messages = exchanged(quality)
    assert offered["type"] == TYPE
    assert (offered["reliability"], offered["durability"]) == (
        ("RELIABLE", "TRANSIENT_LOCAL") if quality == "latched" else ("BEST_EFFORT", "VOLATILE")
    )
    if quality == "latched":
        assert (offered["deadline"], offered["lifespan"]) == (1000 * MS, 2000 * MS)
        assert [message["number"] for message in messages] == list(range(COUNT))
    assert len(messages) > COUNT // 2
    for message in messages:
        assert message["frame"] == f"frame {message['number']}"
        assert message["since_start"] >= SLOTS[0][0], "it left before its slot"

    releases = read_gate_log(log)
    assert releases.height == len(messages)
    stamped = kind != "python" or rclpy_has_source_timestamps()
    assert releases["source_timestamp"].is_not_null().unique().to_list() == [stamped]
    assert set(releases["mode"]) == {"city", "highway"}
    in_time = releases.filter(pl.col("overrun").is_null())
    assert in_time.height > 0
    for mode, band in {"city": 2, "highway": 1}.items():
        own = in_time.filter(pl.col("mode") == mode)
        assert set(own["slot"]) <= {band - 1}
        start, end = SLOTS[band - 1]
        assert (own["release"] - own["origin"]).is_between(start, end - 1).all()
    assert (releases["time"] >= releases["release"]).all()
    assert (releases["published"] >= releases["time"]).all()


@pytest.mark.parametrize("messages", ["all-in-order", "newest"])
@pytest.mark.parametrize("kind", ["python", GENERIC, TYPED])
def test_of_more_than_one_a_cycle_none_is_lost_that_is_not_counted(
    tmp_path: Path, plan: ChainPlan, kind: NodeKind, messages: str, place: Path | None
) -> None:
    plan = revised(plan, anchor="cycle", messages=messages, overrun="wait")
    log = tmp_path / "gate.csv"
    process = written(plan, kind, tmp_path, log)
    count = 200
    with started(process, place):
        exchanged("latched", count, plan.cycle_ns / 1e9 / 8)
    rows = read_gate_log(log)
    assert rows.height == count, "in = out + lost"
    assert rows["release"].is_null().to_list() == rows["dropped"].is_not_null().to_list()
    cycles = rows["release"].drop_nulls() // plan.cycle_ns  # which begin at multiples of it
    assert messages != "newest" or cycles.is_unique().all(), "one a cycle"
    reasons = set(rows["dropped"].drop_nulls())
    assert reasons <= ({"replaced", "overflowed"} if messages == "newest" else {"overflowed"})


@pytest.mark.parametrize("kind", ["python", GENERIC])
def test_a_running_node_is_told_where_cycles_begin(
    tmp_path: Path, plan: ChainPlan, kind: NodeKind, place: Path | None
) -> None:
    plan, log = revised(plan, anchor="cycle"), tmp_path / "gate.csv"
    process = written(plan, kind, tmp_path, log)
    node = f"/{process.name}"
    phase = 12_345_678
    with started(process, place), ThreadPoolExecutor() as beside:
        coming = beside.submit(exchanged, "best_effort", 200)
        arguments = (ros_script.__file__, "parameter", "phase_ns", str(phase), "/nobody", node)
        said = run_with_rclpy(own_environment(), *arguments, within_s=30)
        coming.result()
    assert said == ("", "/nobody offers no parameters"), "and the other has it"
    origins = read_gate_log(log)["origin"]
    assert origins[-1] % plan.cycle_ns == phase
    assert set(origins % plan.cycle_ns) <= {0, phase}


@pytest.mark.parametrize("kind", ["python", GENERIC])
def test_it_stops_while_it_waits_for_its_input(
    tmp_path: Path, plan: ChainPlan, kind: NodeKind, place: Path | None
) -> None:
    process = written(plan, kind, tmp_path)
    with started(process, place) as child:
        for line in known(child.stdout):
            if "waiting for a publisher of /t3_tmp" in line:
                break


@pytest.mark.parametrize("kind", [TYPED])
def test_a_typed_node_refuses_another_type(
    tmp_path: Path, plan: ChainPlan, kind: NodeKind, place: Path | None
) -> None:
    process = written(plan, kind, tmp_path)
    say = [*("ros2", "topic", "pub", "/t3_tmp", "std_msgs/msg/Header"), "{}"]
    other = subprocess.Popen(say, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with started(process, place, exit_code=1) as child:
            output, _ = child.communicate(timeout=60)
        assert f"made for {TYPE}, but its input is std_msgs/msg/Header" in output
    finally:
        other.kill()
        other.wait()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("kind", ["python", GENERIC])
def test_the_throttler_publishes_once_a_period(
    tmp_path: Path, kind: NodeKind, place: Path | None, rule: Rule
) -> None:
    # Messages come every 50 ms, so that two are there each time.
    language: NodeLanguage = "python" if kind == "python" else "cpp"
    process = write_throttler({"/t3_tmp": "/t3"}, 100 * MS, language, tmp_path, rule=rule)
    with started(process, place) as child:
        _, *messages = exchanged("latched")
        time.sleep(0.3)
        child.send_signal(signal.SIGINT)
        output, _ = child.communicate(timeout=20)
    numbers = [message["number"] for message in messages]
    assert numbers == sorted(set(numbers)), "none twice, in order"
    assert COUNT // 4 <= len(numbers) <= COUNT * 3 // 4
    (summary,) = [line for line in output.splitlines() if line.startswith("/t3: ")]
    published, missing, dropped = [int(word) for word in summary.split() if word.isdigit()]
    assert published == len(numbers)
    assert published + dropped in (COUNT - 1, COUNT)  # one may have been taken and not published
    if rule == "newest":
        assert missing > 0, "none came before and after"
    else:
        assert (numbers[0], missing) == (0, 0)
        delays = sorted(message["since_start"] for message in messages)
        # What waits for a period's end waits nearly as long each time; a busy machine, at times.
        assert delays[len(delays) // 4] < 20 * MS, "they leave as they come: a fifth of a period"
        assert delays[len(delays) // 2] < 50 * MS, "before the next message"
