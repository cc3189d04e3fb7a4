"""The process of executing.cpp with rclpy:

LOG single|multi|events line PERIOD_MS LEAST_MS MOST_MS compute|sleep
"""

import random
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node


class Worker(Node):  # type: ignore[misc]
    """A timer → /begun → /worked → /done, the second callback in a reentrant group."""

    def __init__(self, words: list[str]) -> None:
        super().__init__("worker")
        self.notes: list[tuple[object, ...]] = []
        self.origin = 0
        self.least, self.most = (float(word) / 1e3 for word in words[5:7])
        self.clock = time.monotonic if words[7] == "sleep" else time.thread_time
        groups = [MutuallyExclusiveCallbackGroup(), ReentrantCallbackGroup(), None]
        topics = {"timer": "/begun", "work": "/worked", "last": "/done"}
        self.outputs = {n: self.create_publisher(PointStamped, t, 50) for n, t in topics.items()}
        self.timer = self.create_timer(float(words[4]) / 1e3, self.begin, groups[0])
        for name, topic, group in (("work", "/begun", groups[1]), ("last", "/worked", groups[2])):
            self.create_subscription(
                PointStamped, topic, lambda m, n=name: self.work(n, m), 50, callback_group=group
            )

    def begin(self) -> None:
        message = PointStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = str(self.origin)
        self.origin += 1
        self.work("timer", message)

    def work(self, name: str, message: PointStamped) -> None:
        began, since = time.monotonic_ns(), self.clock()
        duration = (name == "work" or 0.1) * random.uniform(self.least, self.most)
        while (left := since + duration - self.clock()) > 0:
            if self.clock is time.monotonic:
                time.sleep(left)
        before = time.monotonic_ns()
        self.outputs[name].publish(message)
        at = (threading.get_native_id(), message.header.frame_id, began, before)
        self.notes.append((name, *at, time.monotonic_ns()))


def executor_of(name: str) -> Executor:
    if name == "events":  # Kilted and later
        from rclpy.experimental import EventsExecutor

        return EventsExecutor()
    return MultiThreadedExecutor(4) if name == "multi" else SingleThreadedExecutor()


def main() -> None:
    rclpy.init()
    words = rclpy.utilities.remove_ros_args(sys.argv)
    node = Worker(words)
    executor = executor_of(words[2])
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    with Path(words[1]).open("w") as file:
        file.writelines(" ".join(map(str, line)) + "\n" for line in node.notes)


main()
