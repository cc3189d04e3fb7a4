"""A loop of rclpy that is faster than its input, as those of looping.cpp: NOTES PERIOD_MS."""

import sys
import time
from contextlib import suppress
from pathlib import Path

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.executors import ExternalShutdownException


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("actor")
    stored = PointStamped()

    def store(message: PointStamped) -> None:
        nonlocal stored
        stored = message

    node.create_subscription(PointStamped, "/scan", store, 1)
    output = node.create_publisher(PointStamped, "/command", 1)
    with (
        Path(sys.argv[1]).open("w", encoding="utf-8", buffering=1) as notes,
        suppress(KeyboardInterrupt, ExternalShutdownException),
    ):
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=0.0)
            before = time.monotonic_ns()
            output.publish(stored)
            stamp = stored.header.stamp
            origin = stamp.sec * 1_000_000_000 + stamp.nanosec
            notes.write(f"{origin} {before} {time.monotonic_ns()}\n")
            time.sleep(float(sys.argv[2]) / 1e3)


main()
