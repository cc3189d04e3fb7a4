"""The latency-shaping node, for messages of any type (paper, section 3.2.2).

What it receives on ``input`` it republishes on ``output``, byte for byte, in the slots of its
server. It has one thread, which receives, holds, publishes, rests so that the message is delivered
although this thread out-ranks others, and only then notes what it did.
"""

import gc
import os
import threading
import time
from contextlib import suppress
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import String

from chainshaper.enforcement.gate import Gate, Modes, Release, Shaper, sleep_until
from chainshaper.splicing.nodes.python.callback_events import create_subscription
from chainshaper.splicing.nodes.python.endpoints import (
    asked_of,
    message_class,
    offered_by,
    parameter,
    run,
    wait_for_publisher,
)
from chainshaper.splicing.nodes.python.message_events import publish_function
from chainshaper.splicing.nodes.python.readiness import Readiness

LOG_HEADER = (
    "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
    "mode,published,stalled\n"
)


class GateLog:
    """What the gate did, a line of comma-separated values per message.

    Each is handed to the page cache with one write, after the message has left: what was written
    stays when the process is killed. Lines are added to a file that is there.
    """

    def __init__(self, node: Node, path: str) -> None:
        self._file = None
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        try:
            if path:
                self._file = os.open(path, flags, 0o644)
                if os.lseek(self._file, 0, os.SEEK_END) == 0:
                    os.write(self._file, LOG_HEADER.encode())
        except OSError as error:
            node.get_logger().warning(f"no log is written to {path}: {error.strerror}")
        self._process = f"{os.getpid()},{threading.get_native_id()}"

    def write(self, release: Release, *times: int | None) -> None:
        """Note a decision: woke at, source time stamp, arrival, published, and for how long the
        machine stood still behind the release (ns, None: not known)."""
        if self._file is None:
            return
        woke, source_timestamp, arrival, published, stalled = times
        core = next(iter(os.sched_getaffinity(0)))
        before = (source_timestamp, arrival, release.origin_ns, release.at_ns, release.slot)
        after = (release.cycles_waited, release.anchor, release.overrun, release.mode)
        fields = (*before, *after, published, stalled)
        texts = ["" if field is None else str(field) for field in fields]
        # A full disk must not stop the output: a line that cannot be written is missing.
        with suppress(OSError):
            os.write(self._file, f"{woke},{self._process},{core},{','.join(texts)}\n".encode())


def gate_from(node: Node) -> Gate:
    """The gate that a node's parameters describe.

    Raises:
        ValueError: they describe none.
    """
    bounds = parameter(node, "slots_ns", [0])
    modes = None
    if parameter(node, "mode_topic", ""):
        bands = zip(
            parameter(node, "mode_names", [""]), parameter(node, "mode_slots", [0]), strict=True
        )
        default, late = parameter(node, "mode_default", ""), parameter(node, "mode_late", "wait")
        modes = Modes(dict(bands), default, late)
    return Gate(
        slots=tuple(zip(bounds[::2], bounds[1::2], strict=False)),
        cycle_ns=parameter(node, "cycle_ns", 0),
        anchor=parameter(node, "anchor", "stamp"),
        phase_ns=parameter(node, "phase_ns", 0),
        overrun=parameter(node, "overrun", "wait"),
        due_cycles=parameter(node, "due_cycles", 0),
        modes=modes,
    )


def listen_to_modes(node: Node, shaper: Shaper) -> None:
    """Subscribe to the topic of the modes, if there is one.

    A mode that was announced before is only delivered when it is asked for, and only if its
    publisher keeps it; so discovery should have had its time.
    """
    topic = parameter(node, "mode_topic", "")
    if not topic:
        return
    qos, logger = QoSProfile(depth=10), node.get_logger()
    for info in node.get_publishers_info_by_topic(topic):
        if info.qos_profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL:
            qos.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL

    def announced(message: Any) -> None:
        if shaper.switch(message.data, time.monotonic_ns()):
            logger.info(f"mode {message.data}")
        else:
            logger.warning(f"there is no mode {message.data!r}")

    create_subscription(node, String, topic, announced, qos)


def change_phase_with(node: Node, shaper: Shaper) -> None:
    """Let the parameter ``phase_ns`` be set while the node runs.

    It is in force from the next cycle on; the log shows it as the origin of what comes then.
    """

    def changed(parameters: Any) -> Any:
        for changed_one in parameters:
            if changed_one.name == "phase_ns":
                shaper.set_phase(changed_one.value, time.monotonic_ns())
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(changed)


def delivery_core(node: Node) -> int | None:
    """Where DDS threads deliver the output: the first core that is ours to use and has no server.

    None where the plan does not name its servers' cores, because it leaves receivers alone.
    """
    taken = parameter(node, "server_cores", [-1])
    return None if -1 in taken else min(os.sched_getaffinity(0) - set(taken), default=None)


def set_up(node: Node) -> None:
    """Make the node's endpoints."""
    log, pause_ns = GateLog(node, parameter(node, "log", "")), parameter(node, "pause_ns", 0)
    readiness = Readiness(node, delivery_core(node), pause_ns)
    shaper = Shaper(gate_from(node), parameter(node, "spin_ns", 0), readiness.get_ready)
    change_phase_with(node, shaper)
    info = wait_for_publisher(node, "input")
    offered = offered_by(info, parameter(node, "output_depth", 10))
    message_type = message_class(info.topic_type)
    publisher = node.create_publisher(message_type, "output", offered)
    publish = publish_function(publisher)
    listen_to_modes(node, shaper)

    def shape(payload: bytes, source_timestamp: int | None) -> None:
        release, arrival, woke = shaper.hold(payload)
        published = stalled = None
        if release.at_ns is not None:
            try:
                publish(payload)
            except RuntimeError:  # rclpy's RCLError is one
                if rclpy.ok():
                    raise
                return  # it was interrupted meanwhile; to ask before publishing would cost time
            published = time.monotonic_ns()
            stalled = shaper.time_lost(release, woke)
            if release.overrun is None:  # else the next message may be waiting already
                sleep_until(published + pause_ns)
        readiness.relax()
        log.write(release, woke, source_timestamp, arrival, published, stalled)
        gc.collect()  # here is time for it; all that is older is frozen

    def with_info(payload: bytes, message_info: Any) -> None:
        shape(payload, message_info["source_timestamp"])

    def without_info(payload: bytes) -> None:
        shape(payload, None)

    # Humble gives a callback the message only: the log lacks its source time stamp.
    callback = with_info if hasattr(Subscription, "CallbackType") else without_info
    create_subscription(node, message_type, "input", callback, asked_of(offered), raw=True)


if __name__ == "__main__":
    run("chainshaper_shaping", set_up)
