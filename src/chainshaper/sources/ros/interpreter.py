"""Running a script with the `rclpy` of an application that runs: its Python, its environment.

The Python that has `rclpy` is seldom ours, and domain and RMW are those of the application's nodes.
So what has to be asked of ROS 2 is asked by a small script of its own, in a process of its own.
"""

import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

from chainshaper.enforcement.threads.listing import read_proc

__all__ = ["environment_of", "run_with_rclpy"]

_NOT_FOR_US = ("LD_PRELOAD",)
"""What is loaded into the nodes for tracing shall not trace us."""


def environment_of(pid: int) -> dict[str, str]:
    """The environment that a process was started with; empty when it may not be read."""
    try:
        content = read_proc(f"/proc/{pid}/environ").decode(errors="replace")
    except OSError:
        return {}
    pairs = (entry.partition("=") for entry in content.split("\0") if "=" in entry)
    return {name: value for name, _, value in pairs}


def run_with_rclpy(
    environment: Mapping[str, str], script: str, *arguments: str, within_s: float
) -> tuple[str, str | None]:
    """Run a script file in a node's environment.

    Returns:
        What it printed, and why it failed, if it did.
    """
    command = [*_interpreter(environment), script, *arguments]
    try:
        run = subprocess.run(
            command,
            env={name: text for name, text in environment.items() if name not in _NOT_FOR_US},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=within_s,
            check=False,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        return "", f"ROS 2 did not answer within {within_s:g} s"
    except OSError as error:
        return "", str(error)
    if run.returncode != 0:
        last = next((line for line in reversed(run.stderr.splitlines()) if line.strip()), "")
        return "", last.strip() or f"{command[0]} ended with code {run.returncode}"
    return run.stdout, None


def _interpreter(environment: Mapping[str, str]) -> list[str]:
    """The Python that this environment's `ros2` runs with: another one cannot load `rclpy`."""
    path = environment.get("PATH", os.defpath)
    ros2 = shutil.which("ros2", path=path)
    if ros2 is not None:
        with Path(ros2).open("rb") as script:
            first = script.readline().decode(errors="replace")
        if first.startswith("#!"):
            return shlex.split(first[2:])
    return [shutil.which("python3", path=path) or "python3"]
