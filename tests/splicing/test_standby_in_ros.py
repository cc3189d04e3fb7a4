"""Killing the shaping node, its standby, or both, on a real `ros2 launch`.

``CHAINSHAPER_KILLS=100`` kills so often (default: 3 times); ``pytest -s`` shows the figures.
"""

import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from known import known
from processes import wait_for
from ros2 import ros2_environment

from chainshaper import measure_latency, splice_launch_files
from chainshaper.planning import ChainPlan, Plan, plan_shaping
from chainshaper.splicing.node_packages import build_package
from chainshaper.splicing.shaped_outputs import ShapedOutput, find_outputs
from chainshaper.splicing.spliced_launch import NODES
from chainshaper.values.plan_choices import NodeLanguage

pytestmark = [pytest.mark.ros2("launch_ros"), pytest.mark.timeout(1200)]

OUTPUT = Path(__file__).parent / "ros_output.py"
KILLS = int(os.environ.get("CHAINSHAPER_KILLS", "3"))
DOMAIN = "93"


@dataclass(frozen=True)
class Launched:
    """An application that `ros2 launch` runs from a spliced copy."""

    folder: Path
    process: "subprocess.Popen[bytes]"

    @property
    def output(self) -> ShapedOutput | None:
        found = [one for one in find_outputs() if f".{DOMAIN}.v" in one.page]
        return next((one for one in found if one.topic == "/t5"), None)

    def numbers(self, who: str) -> list[tuple[int, int]]:
        """The messages that a node has published or received, with the times (ns)."""
        lines = (self.folder / who).read_text().splitlines()
        return [(int(number), int(at)) for number, at in map(str.split, lines)]


def plan() -> ChainPlan:
    return plan_shaping(
        np.array([5_000_000, 49_000_000]),
        100_000_000,
        spec="/t1../t5",
        output="/t5",
        publisher="/node5",
        nodes=("/node5",),
        core=0,
        publish_slot_ns=20_000_000,
    )


@pytest.fixture(params=["python", "cpp"])
def kind(request: pytest.FixtureRequest) -> NodeLanguage:
    wanted: NodeLanguage = request.param
    return wanted


@pytest.fixture
def launched(kind: NodeLanguage, tmp_path: Path) -> Iterator[Launched]:
    with launching(kind, tmp_path) as app:
        yield app


@contextmanager
def launching(kind: NodeLanguage, tmp_path: Path, *recorder: str) -> Iterator[Launched]:
    """The spliced application, which `ros2 launch` runs, behind a recorder's words if there are."""
    environment = {**ros2_environment(), "ROS_DOMAIN_ID": DOMAIN, "CHAINSHAPER_TEST": str(tmp_path)}
    if kind == "cpp" and shutil.which("colcon", path=environment["PATH"]) is None:
        pytest.skip("colcon is not on the PATH, so no package can be built")
    robot = tmp_path / "robot.launch.py"
    nodes = "".join(
        f"        Node(executable='python3', name={name!r},\n"
        f"             arguments=[{str(OUTPUT)!r}, {what!r}, {str(tmp_path / what)!r}],\n"
        "             remappings=[('output', '/t5')]),\n"
        for name, what in (("node5", "publisher"), ("actuator", "receiver"))
    )
    robot.write_text(
        "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n"
        f"def generate_launch_description():\n    return LaunchDescription([\n{nodes}    ])\n"
    )
    splicing = splice_launch_files(Plan.of(plan()), [robot], tmp_path / "spliced", node=kind)
    command = [*recorder, "ros2", "launch", str(splicing.launch[robot])]
    if kind == "cpp":
        with pytest.MonkeyPatch.context() as monkeypatch:
            for name, value in environment.items():
                monkeypatch.setenv(name, value)
            setup = build_package(splicing.folder / NODES)
        command = ["bash", "-c", 'source "$0" && exec "$@"', str(setup), *command]
    with (tmp_path / "said").open("wb") as said:
        process = subprocess.Popen(
            ["env", *command],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
    try:
        yield Launched(tmp_path, process)
        process.send_signal(signal.SIGINT)
        process.wait(120 if recorder else 30)  # a recorder reads the events then
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def await_shaped(app: Launched, *without: int | None) -> ShapedOutput:
    """Its output, once it is shaped and has a standby, by other processes than those."""

    def shaped() -> bool:
        output = app.output
        return (
            output is not None
            and output.state == "shaped"
            and None not in (output.shaping_node, output.standby)
            and {output.shaping_node, output.standby}.isdisjoint(without)
        )

    wait_for(shaped, f"/t5 to be shaped: {(app.folder / 'said').read_text()[-3000:]}", 60, 0.005)
    return known(app.output)


@pytest.mark.parametrize("victims", [("shaping_node",), ("standby",), ("shaping_node", "standby")])
def test_whichever_is_killed_the_output_goes_on_and_both_are_back(
    launched: Launched, victims: tuple[str, ...]
) -> None:
    await_shaped(launched)
    receiver = launched.folder / "receiver"
    wait_for(lambda: receiver.is_file() and receiver.stat().st_size > 0, "a message to arrive", 60)
    time.sleep(1)  # the standby has found the receiver as well
    begun, dice, back_s = time.monotonic_ns(), random.Random(13), []
    kills_ns = []
    for _ in range(KILLS):
        time.sleep(0.8 + dice.random() * 0.7)
        output = await_shaped(launched)
        killed = [getattr(output, victim) for victim in victims]
        since = time.monotonic()
        kills_ns.append(time.monotonic_ns())
        for pid in killed:
            os.kill(pid, signal.SIGKILL)
        await_shaped(launched, *killed)
        back_s.append(time.monotonic() - since)
    time.sleep(1)
    until = time.monotonic_ns() - 500_000_000
    sent = [number for number, at in launched.numbers("publisher") if begun < at < until]
    received = [(number, at) for number, at in launched.numbers("receiver") if number in set(sent)]
    came = [number for number, _ in received]
    times = np.array([at for _, at in received])
    lost = {*sent} - {*came}
    lost_at = [at for number, at in launched.numbers("publisher") if number in lost]
    figures = {
        "victims": victims,
        "kills": KILLS,
        "sent": len(sent),
        "lost": len(lost),
        "lost_behind_a_kill_ms": [
            round((at - max((kill for kill in kills_ns if kill < at), default=begun)) / 1e6)
            for at in lost_at
        ],
        "doubled": len(came) - len(set(came)),
        "reordered": sum(after < before for before, after in itertools.pairwise(came)),
        "longest_gap_ms": round(float(np.diff(times).max()) / 1e6),
        "back_s": {"p50": round(float(np.median(back_s)), 2), "max": round(max(back_s), 2)},
    }
    print(json.dumps(figures))  # noqa: T201
    assert figures["reordered"] == 0
    # Killed between a publication and its note of it, the node has left one message to the standby.
    again = [at for place, (number, at) in enumerate(received) if number in came[:place]]
    assert all(any(0 < at - kill < 500_000_000 for kill in kills_ns) for at in again), figures
    if len(victims) == 1:
        assert not lost, figures
    assert came[-1] == sent[-1], "it goes on"


def test_a_recording_in_which_the_shaping_node_was_killed_is_of_one_chain(
    kind: NodeLanguage, tmp_path: Path
) -> None:
    folder, pids = tmp_path / "recording", list[int]()
    words = ("-m", "chainshaper", "record", "-o", str(folder), "--source", "preload", "--")
    with launching(kind, tmp_path, sys.executable, *words) as app:
        for _ in range(2):
            pids.append(known(await_shaped(app, *pids).shaping_node))
            time.sleep(2)
            os.kill(pids[-1], signal.SIGKILL)
        pids.append(known(await_shaped(app, *pids).shaping_node))
        time.sleep(2)
    found = measure_latency(folder, "/t5_tmp../t5").analysis
    (gate,) = (one for one in found.graph.path(found.chain) if one.node == "/chainshaper_t5")
    assert gate.processes == tuple(pids)
    whole, missing = found.statistics.count, found.incomplete
    # Of each process that was killed, what it held and had not published may be missing.
    assert whole > 20 * missing.get("not published", 0), missing
    assert not [note for note in found.notes if "took the next message" in note]
    page = ("-m", "chainshaper", "report", str(folder), "--chain", "/t5_tmp../t5")
    subprocess.run([sys.executable, *page, "-o", str(tmp_path / "page.html")], check=True)
