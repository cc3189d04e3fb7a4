"""ROS 2 for tests marked `ros2`: sourced already, by `$ROS2_SETUP`, from below /opt/ros, or wheels.

The wheels are those that `scripts/ros2-wheels` brings. They have `rclpy` and messages; a test that
needs more names the packages: `@pytest.mark.ros2("rclcpp", "launch_ros")`.
"""

import functools
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

MIDDLEWARES = ("rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_zenoh_cpp")
"""The middlewares that chainshaper is run on: tests skip those that are not installed."""

_WHEELS = Path(__file__).parents[2] / ".venv-ros/setup.sh"
_LISTED_BY_LTTNG = """
if [ "$(id -u)" -eq 0 ]; then
    mkdir -p /var/run/lttng && mount -t tmpfs tmpfs /var/run/lttng || exit
fi
lttng-sessiond --quiet &
daemon=$!
trap 'kill $daemon; wait $daemon' EXIT
until lttng --no-sessiond list > /dev/null 2>&1; do kill -0 $daemon && sleep 0.1 || exit; done
exec 3>&1
python3 -c 'import os, rclpy; rclpy.init(); os.system("lttng --no-sessiond list --userspace >&3")'
"""
"""Prints the trace points of a process of ROS 2, as a session daemon of its own lists them."""


def ros2_environment() -> dict[str, str]:
    """The environment of ROS 2, without what others publish on the network.

    Without ROS 2 the test is skipped, with the reason.
    """
    environment = _environment()
    if environment is None:
        pytest.skip(
            "no ROS 2: source its setup.bash, name it in ROS2_SETUP, or scripts/ros2-wheels"
        )
    return {**environment, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def require_packages(*names: str) -> None:
    """Skip a test where ROS 2 lacks one of these packages."""
    prefixes = ros2_environment().get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for name in names:
        place = f"share/ament_index/resource_index/packages/{name}"
        if not any(Path(prefix, place).is_file() for prefix in prefixes):
            pytest.skip(f"the package {name} is not installed in this ROS 2")


@contextmanager
def running_middleware(rmw: str, zenoh: str = "") -> Iterator[dict[str, str]]:
    """The variables that choose a middleware; Zenoh has its router as long as they are used.

    ``zenoh`` is added to the configuration of Zenoh's nodes and router. A test is skipped where the
    middleware is not installed.
    """
    require_packages(rmw)
    if rmw != "rmw_zenoh_cpp":
        yield {"RMW_IMPLEMENTATION": rmw}
        return
    port = free_port()
    with zenoh_router(port, zenoh):
        yield zenoh_variables(port, zenoh)


def free_port() -> int:
    """A port of this machine at which nothing is heard."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def zenoh_variables(port: int, zenoh: str = "") -> dict[str, str]:
    """The variables of nodes on Zenoh whose router hears them at a port."""
    override = f'connect/endpoints=["tcp/127.0.0.1:{port}"]{zenoh}'
    return {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ZENOH_CONFIG_OVERRIDE": override}


@contextmanager
def zenoh_router(port: int, zenoh: str = "") -> Iterator["subprocess.Popen[bytes]"]:
    """Zenoh's router, which hears nodes at a port of this machine."""
    override = f'listen/endpoints=["tcp/127.0.0.1:{port}"]{zenoh}'
    environment = {**ros2_environment(), "ZENOH_CONFIG_OVERRIDE": override}
    folders = environment["AMENT_PREFIX_PATH"].split(os.pathsep)
    programs = (Path(folder, "lib/rmw_zenoh_cpp/rmw_zenohd") for folder in folders)
    program = next(filter(Path.is_file, programs))
    with subprocess.Popen([program], env=environment, stdout=subprocess.DEVNULL) as router:
        try:
            while router.poll() is None:
                with (
                    suppress(ConnectionRefusedError),
                    socket.create_connection(("127.0.0.1", port)),
                ):
                    break
                time.sleep(0.05)
            yield router
        finally:
            router.terminate()


def require_lttng_of_ros2() -> None:
    """Skip a test that records ROS 2 with LTTng where the two do not find each other.

    The tracetools of ROS 2 may be built without trace points, or for another version of LTTng than
    the session daemon here: one of 2.13 and later does not hear what is built for 2.12.
    """
    ros2_environment()
    if (reason := _why_not_traced()) is not None:
        pytest.skip(reason)


@functools.cache
def _why_not_traced() -> str | None:
    """Return why LTTng does not record ROS 2 here; None: it does."""
    for tool in ("lttng", "lttng-sessiond"):
        if shutil.which(tool) is None:
            return f"{tool} is not installed here (package lttng-tools)"
    # Root's daemon has its sockets in one place, where another one may have them already.
    apart = ["unshare", "--mount", "--propagation=slave"] if os.geteuid() == 0 else []
    # The paths of the sockets may have 108 characters only.
    with tempfile.TemporaryDirectory(prefix="lttng-", dir="/tmp") as home:
        listed = subprocess.run(
            ["env", *apart, "bash", "-c", _LISTED_BY_LTTNG],
            env={**ros2_environment(), "LTTNG_HOME": home, "LTTNG_UST_REGISTER_TIMEOUT": "30000"},
            capture_output=True,
            text=True,
            check=False,
        )
    if " ros2:rcl_init " in listed.stdout:
        return None
    printed = " ".join((listed.stdout + listed.stderr).split())
    return f"LTTng here finds no trace points of this ROS 2: {printed}"


@functools.cache
def _environment() -> dict[str, str] | None:
    candidates = [os.environ["ROS2_SETUP"]] if "ROS2_SETUP" in os.environ else []
    candidates += [str(path) for path in sorted(Path("/opt/ros").glob("*/setup.bash"))[::-1]]
    candidates += [str(_WHEELS)] if _WHEELS.is_file() else []
    environments = [dict(os.environ)] if "AMENT_PREFIX_PATH" in os.environ else []
    for setup in candidates:
        command = ["bash", "-c", 'source "$1" >&2 && env -0', "bash", setup]
        sourced = subprocess.run(command, capture_output=True, check=False)
        pairs = [line.split("=", 1) for line in sourced.stdout.decode().split("\0") if "=" in line]
        environments.append(dict(pairs))
    for environment in environments:
        command = ["python3", "-c", "import rclpy"]
        # `env` looks it up on that PATH, not on ours
        run = subprocess.run(["env", *command], env=environment, capture_output=True, check=False)
        if run.returncode == 0:
            return environment
    return None
