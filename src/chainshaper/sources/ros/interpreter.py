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
from chainshaper.errors import OperationError

__all__ = ["environment_of", "run_with_rclpy", "start_with_rclpy", "why_it_failed"]

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
    """Run a script file in a node's environment, and wait for its end.

    Returns:
        What it printed, and why it failed, if it did.
    """
    try:
        process = start_with_rclpy(environment, script, *arguments)
    except OperationError as error:
        return "", str(error)
    with process:
        try:
            printed, said = process.communicate(timeout=within_s)
        except subprocess.TimeoutExpired:
            process.kill()
            return "", f"ROS 2 did not answer within {within_s:g} s"
    problem = why_it_failed(process, said)
    return ("" if problem else printed), problem


def start_with_rclpy(
    environment: Mapping[str, str], script: str, *arguments: str
) -> "subprocess.Popen[str]":
    """Start a script file in a node's environment; what it prints is for the caller to read.

    Raises:
        OperationError: there is no such Python.
    """
    command = [*_interpreter(environment), script, *arguments]
    try:
        return subprocess.Popen(
            command,
            env={name: text for name, text in environment.items() if name not in _NOT_FOR_US},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
    except OSError as error:
        raise OperationError(f"{command[0]} cannot be started: {error.strerror}") from error


def why_it_failed(process: "subprocess.Popen[str]", said: str) -> str | None:
    """The last line of what a script that has ended ``said`` on standard error, if it failed."""
    if process.returncode == 0:
        return None
    last = next((line for line in reversed(said.splitlines()) if line.strip()), "")
    return last.strip() or f"the script ended with code {process.returncode}"


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
