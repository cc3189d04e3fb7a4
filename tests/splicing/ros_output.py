"""The end of a chain in ROS 2: a node that publishes its output, or one that receives it.

Run with the Python of the ROS 2 environment: messages are stamped and numbered, and each number is
a line of the file that is named. Arguments: ``publisher`` or ``receiver``, and the file.
"""

import contextlib
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

PERIOD_S = 0.1
AT_ONCE = 3  # so many wait in the shaping node together
DEPTH = 200  # nothing is dropped on a machine that stands still for some seconds


def main() -> None:
    what, file = sys.argv[1:3]
    rclpy.init()
    node = Node(what)
    with Path(file).open("w", buffering=1) as log:

        def note(number: float) -> None:
            log.write(f"{int(number)} {time.monotonic_ns()}\n")

        if what == "receiver":
            node.create_subscription(
                PointStamped, "output", lambda message: note(message.point.x), DEPTH
            )
        else:
            publisher, message = (
                node.create_publisher(PointStamped, "output", DEPTH),
                PointStamped(),
            )

            def publish() -> None:
                message.header.stamp = node.get_clock().now().to_msg()
                for _ in range(AT_ONCE):
                    message.point.x += 1.0
                    note(message.point.x)
                    publisher.publish(message)

            node.create_timer(PERIOD_S, publish)
        with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(node)


main()
