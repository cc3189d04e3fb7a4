"""The throttler, for chains whose input is not quite periodic (paper, section 5.1).

Each topic of ``inputs`` is republished on the topic of ``outputs`` in the same place, by a ``rule``
of :mod:`chainshaper.robot.throttling`. At its end the node prints what it dropped, and how often
nothing had come. The output of ``first`` is periodic only behind the paper's server, a slot of 2 ms
in every cycle; the timer of ``newest`` makes it periodic on every kernel.
"""

import atexit
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from chainshaper.robot.clocks import sleep_until
from chainshaper.robot.python.node import (
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
from chainshaper.robot.throttling import RULES, FirstOfPeriod


@dataclass
class Channel:
    """One topic, and counts of what happened to its messages."""

    output: str
    send: Callable[[bytes], None]
    logger: Any
    periods: FirstOfPeriod | None  # None: the rule is `newest`
    newest: bytes | None = None
    published: int = 0
    dropped: int = 0
    missing: int = 0

    def take(self, payload: bytes) -> None:
        """Publish a message if it is the first of its period; or keep it until the next tick."""
        passes = self.periods is None or self.periods.passes(time.monotonic_ns())
        self.dropped += self.newest is not None or not passes
        self.newest = payload if passes else None
        if passes and self.periods is not None:
            self.publish()

    def publish(self) -> None:
        """Publish the newest message that came since the last one."""
        if self.newest is None:
            self.missing += 1
            text = f"nothing new for {self.output}; this is no. {self.missing}"
            self.logger.warning(text, throttle_duration_sec=10.0)
            return
        self.send(self.newest)
        self.newest = None
        self.published += 1

    def __str__(self) -> str:
        passed = f"{self.published} published, {self.missing} times nothing new"
        return f"{self.output}: {passed}, {self.dropped} dropped"


def set_up(node: Node) -> Callable[[], bool]:
    """Make the node's endpoints and timers; return what :func:`.run` calls, which does nothing."""
    parameters = parameters_of(node)
    inputs, outputs, phase = parameters.inputs, parameters.outputs, parameters.phase_ns
    period, rule = parameters.period_ns, parameters.rule
    if not inputs or len(inputs) != len(outputs) or period <= 0 or rule not in RULES:
        raise ValueError("inputs, as many outputs, a period, and a rule are needed")
    channels: list[Channel] = []
    atexit.register(lambda: print(*channels, sep="\n", flush=True))  # noqa: T201
    for source, target in zip(inputs, outputs, strict=True):
        info = wait_for_publisher(node, source)
        offered, message_type = offered_by(info, node), message_class(info.topic_type)
        publish = publish_function(node.create_publisher(message_type, target, offered))
        periods = FirstOfPeriod(period) if rule == "first" else None
        channel = Channel(target, publish, node.get_logger(), periods)
        create_subscription(node, message_type, source, channel.take, asked_of(offered), raw=True)
        channels.append(channel)
    if rule == "first":
        return lambda: False
    # A timer keeps the phase at which it was made, on the same clock.
    since = time.monotonic_ns() - phase
    sleep_until(phase + (since // period + 1) * period)
    for channel in channels:
        create_timer(node, period, channel.publish)
    return lambda: False


if __name__ == "__main__":
    run("chainshaper_throttler", set_up)
