"""The column ROS 2: an application is generated, built, shaped by the command, and takes turns."""

import os
from pathlib import Path

import figure_8
import numpy as np
import pytest
from on_ros import MIDDLEWARES, ros_in_turns

from chainshaper.linux.scheduling import may_use_fifo


@pytest.mark.ros2("rclcpp", "launch_ros")
@pytest.mark.usefixtures("in_ros2")
@pytest.mark.timeout(600)
@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_what_was_profiled_and_what_was_shaped_take_turns(tmp_path: Path) -> None:
    before, (node, *_) = dict(os.environ), figure_8.shapings()
    runs = ros_in_turns([node], cycles=60, folder=tmp_path, blocks=2)
    assert dict(os.environ) == before
    measured = [run for run in runs if run.column == node.only]
    assert measured == runs, MIDDLEWARES
    if not runs:
        pytest.skip(f"{MIDDLEWARES['ros']} is not installed")
    unshaped, shaped = runs
    assert [run.name for run in runs] == [figure_8.UNSHAPED, figure_8.shaped_name(1)]
    for run in runs:
        assert np.unique(run.blocks, return_counts=True)[1].tolist() == [30, 30]
        assert (run.latency_ns >= 0).all(), "every cycle has its output"
    spread = [np.ptp(np.percentile(run.latency_ns, [10, 90])) for run in (unshaped, shaped)]
    assert spread[1] < 0.1 * spread[0], "outputs leave as the slot opens"
    again = ros_in_turns([node], cycles=60, folder=tmp_path, blocks=2)
    for run, known in zip(again, runs, strict=True):
        assert (run.latency_ns == known.latency_ns).all(), "what is there is not measured again"
