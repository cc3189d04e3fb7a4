"""Loops that are no callbacks, on real ROS 2: what they really used, turn by turn, is what we say.

The nodes of `looping.cpp` and `looping.py` note for each turn which message they used.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from ros2 import ros2_environment

from chainshaper.analysis import analyse_latency
from chainshaper.values.recording import open_recording

HERE = Path(__file__).parent
pytestmark = [pytest.mark.ros2, pytest.mark.timed, pytest.mark.timeout(600)]
SENSOR_MS, LOOP_MS = 20, 10


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("looping", tmp_path_factory.mktemp("looping"))


def built(target: str, folder: Path) -> Path:
    for step in (["-S", HERE, "-B", folder], ["--build", folder, "--target", target]):
        words = ["env", "cmake", *map(str, step)]
        run = subprocess.run(
            words, env=ros2_environment(), capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stdout + run.stderr
    return folder / target


def recorded(folder: Path, sensor: str, loop: str, *options: str) -> Path:
    script = f"trap 'kill $(jobs -p)' INT TERM\n{sensor} &\n{loop} &\nwait; wait"
    command = [sys.executable, "-m", "chainshaper", "record", "-o", str(folder / "recording")]
    run = subprocess.run(
        [*command, *options, "--duration", "10s", "--json", "--", "bash", "-c", script],
        env={**ros2_environment(), "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return folder / "recording"


def noted(file: Path) -> npt.NDArray[np.int64]:
    """The origin that each turn used, and the instants before it published and behind that."""
    lines = file.read_text().splitlines()
    return np.array([[int(word) for word in line.split()] for line in lines[:-1]], np.int64)


def assert_as_noted(recording: Path, notes: Path, chain: str) -> None:
    """Each cycle of the loop used the message that it noted."""
    analysis = analyse_latency(open_recording(recording), chain)
    assert analysis.data_age is not None
    cycles = analysis.data_age.cycles.drop_nulls("traversal")
    starts = analysis.traversals.sort("traversal")["start"].to_numpy()
    turns = noted(notes)
    place = np.searchsorted(turns[:, 1], cycles["publish"].to_numpy(), side="right") - 1
    known = (place >= 0) & (place < len(turns) - 1)
    assert known.sum() > 500
    used = turns[place[known], 0]
    expected = np.searchsorted(starts, used, side="right") - 1
    traversal = cycles["traversal"].to_numpy()[known]
    wrong = np.flatnonzero(traversal != expected)
    assert cycles["ambiguous"].to_numpy()[known][wrong].all(), (len(wrong), len(used))
    assert len(wrong) <= 0.02 * len(used)
    # The first use of a message is its cycle: there are no more cycles than messages.
    outputs = analysis.traversals.filter("complete")
    assert outputs["traversal"].n_unique() == outputs.height
    assert outputs["publication"].n_unique() == outputs.height


@pytest.mark.ros2("rclcpp")
@pytest.mark.parametrize("kind", ["thread", "spin_some"])
def test_a_loop_in_cpp(program: Path, tmp_path: Path, kind: str) -> None:
    notes = tmp_path / "notes"
    sensor = f'"{program}" /dev/null sensor {SENSOR_MS}'
    recording = recorded(tmp_path, sensor, f'"{program}" "{notes}" {kind} {LOOP_MS}')
    assert_as_noted(recording, notes, "/scan../command")
    (loop,) = loops_of(recording)
    assert abs(loop["period_ns"] - LOOP_MS * 1_000_000) < 100_000
    assert loop["execution_ns"]["mean"] > 900_000, "it computes for 1 ms"


@pytest.mark.ros2("rclcpp", "rclcpp_action", "example_interfaces")
def test_a_rate_loop_in_the_threads_of_an_action(program: Path, tmp_path: Path) -> None:
    """A stand-in for Nav2's controller server: a thread for each goal of 2 s, and one loop."""
    acting, notes = built("acting", tmp_path / "built"), tmp_path / "notes"
    sensor = f'"{program}" /dev/null sensor {SENSOR_MS}'
    recording = recorded(tmp_path, sensor, f'"{acting}" "{notes}" {LOOP_MS} 2000')
    assert_as_noted(recording, notes, "/scan../command")
    (loop,) = loops_of(recording)
    assert len(loop["tids"]) > 3
    assert abs(loop["period_ns"] - LOOP_MS * 1_000_000) < 100_000


def loops_of(recording: Path) -> list[dict[str, Any]]:
    """The loops that `callbacks` shows."""
    words = [sys.executable, "-m", "chainshaper", "callbacks", str(recording), "--json"]
    shown = subprocess.run(words, capture_output=True, text=True, check=True)
    return [row for row in json.loads(shown.stdout) if row["kind"] == "loop"]


@pytest.mark.ros2("rclcpp")
def test_a_loop_that_publishes_nothing_is_named(program: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    sensor = f'"{program}" /dev/null sensor {SENSOR_MS}'
    silent = f'"{program}" "{notes}" silent {LOOP_MS}'
    recording = recorded(tmp_path, sensor, silent, "--loop", "/actor")
    assert_as_noted(recording, notes, "/scan../actor:end")


@pytest.mark.ros2("rclcpp")
def test_a_loop_in_python_that_is_faster_than_its_input(program: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    sensor = f'"{program}" /dev/null sensor {SENSOR_MS}'
    loop = f'python3 "{HERE / "looping.py"}" "{notes}" {LOOP_MS / 2}'
    assert_as_noted(recorded(tmp_path, sensor, loop), notes, "/scan../command")
