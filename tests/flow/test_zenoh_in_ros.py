"""Real nodes on `rmw_zenoh_cpp` with its router: their threads by name, with shared memory too.

Chains on all middlewares are in `test_executors_in_ros.py`; `test_shape_in_ros.py` shapes them, and
kills the router meanwhile.
"""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import wait_for
from ros2 import ros2_environment, running_middleware

from chainshaper import find_threads

PACKAGE, RMW = "demo_nodes_cpp", "rmw_zenoh_cpp"
SHARED_MEMORY = (
    ";transport/shared_memory/enabled=true"
    ";transport/shared_memory/transport_optimization/message_size_threshold=10"
)
KINDS = {
    "rx": "receive",
    "tx": "transmit",
    "acc": "connection",
    "net": "connection",
    "app": "event",
}
WATCHDOGS = {"Watchdog Confir": "housekeeping", "Watchdog Valida": "housekeeping"}

pytestmark = [pytest.mark.ros2(PACKAGE, RMW), pytest.mark.timeout(300)]


def program(name: str) -> str:
    """The program of a node of the demonstration."""
    prefixes = ros2_environment()["AMENT_PREFIX_PATH"].split(os.pathsep)
    places = (Path(prefix, "lib", PACKAGE, name) for prefix in prefixes)
    return str(next(filter(Path.is_file, places)))


@contextmanager
def nodes(variables: dict[str, str]) -> Iterator[list[int]]:
    """Processes of a talker and a listener that have met."""
    environment = {**ros2_environment(), **variables, "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    talker = subprocess.Popen([program("talker")], env=environment, stderr=subprocess.DEVNULL)
    listener = subprocess.Popen(
        [program("listener")], env=environment, text=True, stderr=subprocess.PIPE
    )
    try:
        assert listener.stderr is not None
        assert any("I heard" in line for line in listener.stderr), "until the first message"
        yield [talker.pid, listener.pid]
    finally:
        for process in (talker, listener):
            process.send_signal(signal.SIGINT)
        for process in (talker, listener):
            process.communicate(timeout=60)


def dds_threads(pid: int) -> dict[str, str | None]:
    """Name → kind of a process's threads of Zenoh, without their numbers."""
    threads = (listed.thread for listed in find_threads(pid).threads)
    return {
        thread.comm.rpartition("-")[0] or thread.comm: thread.kind
        for thread in threads
        if thread.kind
    }


def test_threads_of_nodes_and_router_are_known_by_name() -> None:
    with running_middleware(RMW) as variables, nodes(variables) as pids:
        found = find_threads().threads
        (router,) = {listed.thread.pid for listed in found if "/rmw_zenohd" in listed.nodes}
        assert [dds_threads(pid) for pid in (*pids, router)] == [KINDS] * 3
        # Beside them: signals, timers, and LTTng's, named after the program.
        left = {one.thread.comm for one in found if one.thread.pid in pids and not one.thread.kind}
        assert left <= {"talker", "talker-ust", "listener", "listener-ust"}


def test_threads_of_shared_memory_appear_with_the_first_large_message() -> None:
    with running_middleware(RMW, SHARED_MEMORY) as variables, nodes(variables) as pids:
        complete = [{**KINDS, **WATCHDOGS}] * 2
        wait_for(lambda: [*map(dds_threads, pids)] == complete, "their watchdogs")
