"""Making what follows a release take the same time in every cycle.

Publishing is fast when its code and data are in the processor's caches, and slow, never equally
slow, when the chain has run there since the last time. So it is rehearsed shortly before each
release: a message that nobody receives goes the way of the real one, through the same layers of
ROS 2 and DDS, and a datagram to ourselves the way through the network stack. Measured on a chain of
five nodes, from the release to `rmw_publish` and from there until the message is sent, p50 / p99.5
in µs: 66 / 163 and 99 / 171 without, 15 / 55 and 45 / 107 with it.
"""

import os
import socket
import sys
import time
from contextlib import suppress

from rclpy.node import Node
from std_msgs.msg import Empty

from chainshaper.gate.clear_core import KeptCore

__all__ = ["Readiness"]

REHEARSAL_TOPIC = "/_chainshaper_rehearsal"
"""Of all shaping nodes, and hidden, since its name begins with an underscore."""

EMPTY = bytes((0, 1, 0, 0, 0))
"""A serialized ``std_msgs/Empty``."""

REHEARSAL_NS = 400_000
"""A rehearsal is not begun later before a release than this: the first may take most of it."""


class Readiness:
    """Rehearses the publication, and keeps idle cores from sleeping until it is over.

    A core that sleeps takes tens of microseconds to wake up, on virtual machines more, and never
    the same: most of what a subscriber sees of an output's jitter. While `/dev/cpu_dma_latency` is
    held open, cores wake up within the microseconds written there, 0 at best
    (Documentation/power/pm_qos_interface.rst). What is written ends with the process.
    """

    AWAKE, AS_USUAL = (value.to_bytes(4, sys.byteorder, signed=True) for value in (0, -1))

    def __init__(self, node: Node, delivery_core: int | None, pause_ns: int) -> None:
        """The output is delivered on that core, for ``pause_ns`` after it was published."""
        self._delivery_core = None if delivery_core is None else KeptCore(delivery_core)
        self._pause_ns = pause_ns
        self._rehearsal = node.create_publisher(Empty, REHEARSAL_TOPIC, 1)
        self._to_itself = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to_itself.setblocking(False)
        self._latency = None
        with suppress(OSError):
            self._to_itself.bind(("127.0.0.1", 0))
            self._to_itself.connect(self._to_itself.getsockname())
        try:
            self._latency = os.open("/dev/cpu_dma_latency", os.O_WRONLY | os.O_CLOEXEC)
        except OSError as error:
            node.get_logger().warning(
                f"/dev/cpu_dma_latency: {error.strerror}: idle cores sleep, and deliver less "
                "regularly; run as root, or give the user the right to write it"
            )

    def get_ready(self, release_ns: int) -> None:
        """For a release at that time of CLOCK_MONOTONIC, as far as there is time left for it."""
        self._ask_for(self.AWAKE)
        if self._delivery_core is not None:
            self._delivery_core.keep_until(release_ns + self._pause_ns)
        for _ in range(2):  # the second time all that the first has loaded is in order
            if time.monotonic_ns() > release_ns - REHEARSAL_NS:
                return
            self._rehearsal.publish(EMPTY)
            with suppress(OSError):
                self._to_itself.send(EMPTY)
                self._to_itself.recv(len(EMPTY))

    def relax(self) -> None:
        """The message is delivered: cores may sleep."""
        self._ask_for(self.AS_USUAL)

    def _ask_for(self, latency: bytes) -> None:
        if self._latency is not None:
            os.write(self._latency, latency)
