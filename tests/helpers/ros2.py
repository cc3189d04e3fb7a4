"""ROS 2 for tests marked `ros2`: sourced already, by `$ROS2_SETUP`, or from below /opt/ros."""

import functools
import os
import subprocess
from pathlib import Path

import pytest


def ros2_environment() -> dict[str, str]:
    """The environment of ROS 2, without what others publish on the network.

    Without ROS 2 the test is skipped, with the reason.
    """
    environment = _environment()
    if environment is None:
        pytest.skip("no ROS 2: source its setup.bash, or name it in ROS2_SETUP")
    return {**environment, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@functools.cache
def _environment() -> dict[str, str] | None:
    candidates = [os.environ["ROS2_SETUP"]] if "ROS2_SETUP" in os.environ else []
    candidates += [str(path) for path in sorted(Path("/opt/ros").glob("*/setup.bash"))[::-1]]
    environments = [dict(os.environ)] if "AMENT_PREFIX_PATH" in os.environ else []
    for setup in candidates:
        command = ["bash", "-c", 'source "$1" >&2 && env -0', "bash", setup]
        said = subprocess.run(command, capture_output=True, check=False)
        pairs = [line.split("=", 1) for line in said.stdout.decode().split("\0") if "=" in line]
        environments.append(dict(pairs))
    for environment in environments:
        command = ["python3", "-c", "import launch_ros.actions, rclpy"]
        # `env` looks it up on that PATH, not on ours
        run = subprocess.run(["env", *command], env=environment, capture_output=True, check=False)
        if run.returncode == 0:
            return environment
    return None
