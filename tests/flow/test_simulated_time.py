"""Nodes that follow /clock: no slot counts from simulated stamps, and no timer is misread."""

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from applied_plans import node_command
from command_line import called
from processes import children_of, in_time_namespace, wait_for
from roles import role
from story import OFFSET, Story

from chainshaper.flow.plan import profile_chains
from chainshaper.flow.planned_changes import planned_changes
from chainshaper.planning import (
    Plan,
    PlanRequest,
    Profile,
    plan_application,
    plan_chain,
    plan_shaping,
)
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.recording import Recording, RecordingInfo

pytestmark = pytest.mark.timed

MS = 1_000_000
FOLLOWS = r"/source follows /clock \(use_sim_time\): its stamps are of simulated time"


def profile_at(speed: float, simulated: bool = True) -> Profile:
    """/source every 100 ms of a clock → /t1 → /relay → /t2, for ten cycles."""
    story = Story()
    source, relay, clock = (
        story.node(f"/{n}", p) for p, n in enumerate(("source", "relay", "bag"), 1)
    )
    timer, t1 = story.timer(source, period=100 * MS), story.publisher(source, "/t1")
    reader, t2 = story.subscription(relay, "/t1"), story.publisher(relay, "/t2")
    ticks, time = story.publisher(clock, "/clock"), story.subscription(source, "/clock")
    for number in range(1, 11):
        begun = round(number * 100 * MS / speed)
        story.publish(ticks, begun - 2 * MS)
        if simulated:
            story.runs(time, begun - MS, begun - MS + 1000, reads=begun - 2 * MS)
        story.runs(timer, begun, begun + MS, writes=((t1, begun + MS - 1),))
        end = begun + 5 * MS + number * 1000
        story.runs(reader, begun + 2 * MS, end, reads=begun + MS - 1, writes=((t2, end - 1),))
    info = RecordingInfo(source="simulated", clock_offset_ns=OFFSET)
    (profile,) = profile_chains(Recording(Path("bag"), info, story.tables()), ["/source../t2"])
    return profile


def test_stamps_of_nodes_that_follow_clock_are_no_anchor() -> None:
    profile = profile_at(1.0)
    assert profile.simulated == ("/source",)
    with pytest.raises(InputError, match=FOLLOWS + ".*use_sim_time:=false.*--anchor cycle"):
        plan_chain(profile)
    with pytest.raises(InputError, match=FOLLOWS):
        plan_application([replace(profile, topics=("/a", "/b"), begins=None), profile])
    assert plan_chain(profile, PlanRequest(anchor="cycle")).anchor == "cycle"
    assert plan_chain(profile, PlanRequest(policy="server-per-chain")).shaping_node is None
    assert plan_chain(profile_at(1.0, simulated=False)).anchor == "stamp"


@pytest.mark.parametrize(("speed", "said"), [(0.5, r"0\.50 .* every 200 ms"), (3, r"3\.00 .* 33")])
def test_a_clock_of_another_speed_is_no_period(speed: float, said: str) -> None:
    with pytest.raises(InputError, match=r"/clock, which runs at " + said) as refused:
        profile_at(speed)
    assert "--rate 1.0" in str(refused.value)


@pytest.mark.parametrize("given", ["parameter", "file", "otherwise"])
def test_running_nodes_that_follow_clock_are_refused_before_anything_changes(
    tmp_path: Path, given: str
) -> None:
    asked = {"parameter": ["-p", "use_sim_time:=True"], "file": ["--params-file", "parameters"]}
    asked["otherwise"] = ["-p", "use_sim_time:=false", "-p", "level:=true"]
    (tmp_path / "parameters").write_text("/**:\n  ros__parameters:\n    use_sim_time: true\n")
    about: dict[str, Any] = {"spec": "/t1../t2", "output": "/t2", "publisher": "/origin"}
    stamped, cycled = (
        plan_shaping(np.array([8, 12]) * MS, 100 * MS, **about, nodes=("/origin",), anchor=anchor)
        for anchor in ("stamp", "cycle")
    )
    output = tmp_path / "ran"
    command = [*node_command("origin", output), *asked[given]]
    with subprocess.Popen(command, cwd=tmp_path) as process:
        try:
            wait_for(lambda: output.exists() and output.stat().st_size > 0, "the node")
            if given != "otherwise":
                with pytest.raises(InputError, match="/origin follows /clock"):
                    planned_changes(Plan.of(stamped), "fifo")
            with pytest.raises(OperationError, match=r"/chainshaper_t2 .* is not running"):
                planned_changes(Plan.of(stamped if given == "otherwise" else cycled), "fifo")
        finally:
            process.kill()


def test_a_shaping_node_of_another_clock_is_refused_before_anything_changes(
    tmp_path: Path,
) -> None:
    """In a time namespace it would count its slots from an instant that is none of its own."""
    about: dict[str, Any] = {"spec": "/t1../t2", "output": "/t2", "publisher": "/origin"}
    plan = plan_shaping(np.array([8, 12]) * MS, 100 * MS, **about, nodes=("/origin",))
    output = tmp_path / "ran"
    words = in_time_namespace(100_000, *node_command("chainshaper_t2", output))
    with subprocess.Popen(words) as process:
        try:
            wait_for(lambda: output.exists() and output.stat().st_size > 0, "the node")
            (pid,) = children_of(process.pid)
            said = rf"/chainshaper_t2 \(process {pid}\) has another clock .*nsenter --time"
            with pytest.raises(PlatformError, match=said):
                planned_changes(Plan.of(plan), "fifo")
        finally:
            process.kill()


NODES = """
trap 'kill $(jobs -p)' INT TERM
"$0" clock $1 & "$0" sink & "$0" managed --ros-args -p use_sim_time:=true &
"$0" source 100 --ros-args -p use_sim_time:=$2 &
ros2 lifecycle set /managed configure; ros2 lifecycle set /managed activate
wait; wait
"""


@pytest.mark.ros2("rclcpp_lifecycle", "ros2lifecycle")
@pytest.mark.usefixtures("in_ros2")
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("percent", "simulated", "said"),
    [
        (100, "true", "/source follows /clock (use_sim_time): its stamps are of simulated time"),
        (50, "true", "/source follows /clock, which runs at 0."),
        # The timer counts with ROS's clock all the same, which is the system's then.
        (100, "false", "/managed follows /clock"),
    ],
)
def test_a_replayed_clock_is_seen_in_ros(
    tmp_path: Path, percent: int, simulated: str, said: str
) -> None:
    made = called(
        *("record", "--source", "preload", "-o", tmp_path / "recording", "--duration", "12s"),
        *("--", "bash", "-c", NODES, role(), str(percent), simulated),
    )
    assert made.code == 0, made.err
    planned = called("plan", tmp_path / "recording", "--chain", "/source../t2")
    assert planned.code == 2
    assert said in planned.err
    if percent == 100:
        anchored = ("--chain", "/source../t2", "--anchor", "cycle", "--percentile", "50")
        assert called("plan", tmp_path / "recording", *anchored).code == 0
