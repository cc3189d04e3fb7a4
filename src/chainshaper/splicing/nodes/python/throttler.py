"""The throttler: a strictly periodic start for chains whose input is not quite periodic (paper,
section 5.1).

Each topic of ``inputs`` is republished on the topic of ``outputs`` in the same place, once every
``period_ns``, at ``phase_ns`` after multiples of it on CLOCK_MONOTONIC: the newest message that
came since the last time. Where none came nothing is published, and where several came the older
ones are dropped; both are counted, and said at the end.

The paper's is triggered by its input, and its server, a slot of 2 ms in every cycle, makes the
output periodic. Here a timer does that, on every kernel; the first message of a period would have
become old by then.
"""

import atexit
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from chainshaper.gate.decision import sleep_until
from chainshaper.splicing.nodes.python.node import (
    asked_of,
    create_subscription,
    create_timer,
    message_class,
    offered_by,
    parameters_of,
    publish_function,
    run,
    wait_for_publisher,
)


@dataclass
class Channel:
    """One topic on its way through, and what became of its messages."""

    output: str
    send: Callable[[bytes], None]
    logger: Any
    newest: bytes | None = None
    published: int = 0
    dropped: int = 0
    missing: int = 0

    def take(self, payload: bytes) -> None:
        """Keep a message until the next tick."""
        self.dropped += self.newest is not None
        self.newest = payload

    def publish(self) -> None:
        """Publish what is new."""
        if self.newest is None:
            self.missing += 1
            self.logger.warning(
                f"nothing new for {self.output}; this is no. {self.missing}",
                throttle_duration_sec=10.0,
            )
            return
        self.send(self.newest)
        self.newest = None
        self.published += 1

    def __str__(self) -> str:
        return (
            f"{self.output}: {self.published} published, {self.missing} times nothing new, "
            f"{self.dropped} dropped for newer ones"
        )


def set_up(node: Node) -> Callable[[], bool]:
    """Make the node's endpoints and timers; behind their callbacks nothing is left to do."""
    parameters = parameters_of(node)
    inputs, outputs, phase = parameters.inputs, parameters.outputs, parameters.phase_ns
    period = parameters.period_ns
    if not inputs or len(inputs) != len(outputs) or period <= 0:
        raise ValueError("inputs, as many outputs, and a period are needed")
    channels: list[Channel] = []
    atexit.register(lambda: print(*channels, sep="\n", flush=True))  # noqa: T201
    for source, target in zip(inputs, outputs, strict=True):
        info = wait_for_publisher(node, source)
        offered = offered_by(info, node)
        message_type = message_class(info.topic_type)
        publisher = node.create_publisher(message_type, target, offered)
        channel = Channel(target, publish_function(publisher), node.get_logger())
        asked = asked_of(offered)
        create_subscription(node, message_type, source, channel.take, asked, raw=True)
        channels.append(channel)
    # A timer keeps the phase at which it was made, on the same clock.
    since = time.monotonic_ns() - phase
    sleep_until(phase + (since // period + 1) * period)
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    for channel in channels:
        create_timer(node, period, channel.publish, steady)
    return lambda: False


if __name__ == "__main__":
    run("chainshaper_throttler", set_up)
