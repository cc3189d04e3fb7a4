"""Topics' types and QoS while an application runs, and what its environment says of ROS 2.

Types and QoS travel in DDS discovery only, so somebody has to join the graph and listen:
:mod:`chainshaper.sources.ros_graph`, run by the application's own ROS 2, in the environment of one
of its nodes (domain, RMW, its configuration). One participant for a few seconds tells of all
topics; `ros2 topic info -v` would be one per topic, and leave a daemon behind. It is asked when
tracing is over, because discovery costs every node some time.

A snapshot that fails never fails the recording: it is a note.
"""

import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from chainshaper.enforcement.threads import read_proc
from chainshaper.recording import EndpointInfo
from chainshaper.sources import ros_graph

__all__ = ["ask_graph", "environment_of"]

_PATIENCE_S = 10
"""Discovery is waited for that long at most, and longer than that for Python and RMW to load."""
_START_S = 20
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


def ask_graph(environment: Mapping[str, str]) -> tuple[tuple[EndpointInfo, ...], str | None]:
    """All endpoints of the ROS graph that a node with this environment belongs to.

    Returns:
        The endpoints, and why there are none, if so.
    """
    command = [*_interpreter(environment), ros_graph.__file__, str(_PATIENCE_S)]
    try:
        run = subprocess.run(
            command,
            env={name: text for name, text in environment.items() if name not in _NOT_FOR_US},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE_S + _START_S,
            check=False,
            start_new_session=True,
        )
        if run.returncode != 0:
            last = next((line for line in reversed(run.stderr.splitlines()) if line.strip()), "")
            return (), last.strip() or f"{command[0]} ended with code {run.returncode}"
        # Libraries may have printed something before.
        found = json.loads(run.stdout[run.stdout.index('{"endpoints"') :])["endpoints"]
        return tuple(EndpointInfo.model_validate(one) for one in found), None
    except subprocess.TimeoutExpired:
        return (), f"the ROS graph did not answer within {_PATIENCE_S + _START_S} s"
    except (OSError, ValueError, KeyError, ValidationError) as error:
        return (), str(error)


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
