"""The real ros2_control behind a chain: one command brings its loop into step with the output.

It runs the program that measures this (`benchmarks/ros2_control`), whose hardware notes which
command each of its `write()` got.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from ros2 import ros2_environment

from chainshaper import measure_latency, open_recording
from chainshaper.linux.scheduling import may_use_fifo

MEASURE = Path(__file__).parents[2] / "benchmarks/ros2_control/measure.py"
CHAIN = "/t1../controller_manager:write"
MS = 1_000_000


@pytest.mark.ros2("controller_manager", "forward_command_controller", "launch_ros")
@pytest.mark.timed
@pytest.mark.timeout(600)
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_one_command_brings_the_loop_into_step(tmp_path: Path) -> None:
    """Commands come every 20 ms into a loop of 10 ms, which uses each twice, at one age."""
    output = tmp_path / "measured"
    words = ["--output", str(output), "--seconds", "15", "--chain", "short", "--rows", "move-loop"]
    run = subprocess.run(
        [sys.executable, str(MEASURE), *words],
        env={**ros2_environment(), "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    recording = open_recording(output / "100_Hz/move-loop/after")
    measured = measure_latency(recording, CHAIN)
    assert measured.age is not None
    assert measured.analysis.data_age is not None
    cycles = measured.analysis.data_age.cycles.drop_nulls("traversal").sort("start")
    used = cycles["traversal"].to_numpy()
    starts = measured.analysis.traversals.sort("traversal")["start"].to_numpy()
    written, began = noted(output / "100_Hz/notes")
    got = began[np.searchsorted(written, cycles["end"].to_numpy(), side="right") - 1]
    assert len(used) > 1_000
    assert np.mean(np.abs(got - starts[used]) < 2 * MS) > 0.98, "the hardware got what is said"
    # Stalls of a busy machine may spoil an age, but not the phase.
    low, median, high = np.percentile(
        cycles.filter(use=1)["age_at_loop_ns"].to_numpy(), (25, 50, 75)
    )
    assert high - low < MS, "it was moved"
    assert abs(median - measured.age.promised_first_ns[0]) < MS


def noted(folder: Path) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """When the hardware got commands, in order; and when their chain had begun (ns)."""
    turns = np.concatenate([np.fromfile(notes, np.int64) for notes in folder.iterdir()])
    written, began = turns.reshape(-1, 2).T
    order = np.argsort(written)
    return written[order], began[order]
