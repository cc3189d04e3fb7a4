"""The application around a shaping node in ROS 2: publishes its input, subscribes to its output.

Run with the Python of the ROS 2 environment: messages are stamped and numbered, and every line on
standard output is one that came back. Arguments: how many, the quality of service, and every how
many seconds.
"""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import String

PERIOD_S = float(sys.argv[3]) if len(sys.argv) > 3 else 0.05


def quality(name: str) -> QoSProfile:
    """What the publisher of the input offers."""
    if name == "latched":
        return QoSProfile(
            depth=3,
            reliability=QoSReliabilityPolicy.RELIABLE,
            durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
            deadline=Duration(seconds=1),
            lifespan=Duration(seconds=2),
        )
    return QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)


def say(**what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main() -> None:
    count, qos = int(sys.argv[1]), quality(sys.argv[2])
    rclpy.init()
    node = Node("counterpart")
    publisher = node.create_publisher(PointStamped, "/t3_tmp", qos)
    modes = node.create_publisher(String, "/mode", 1)

    def came_back(message: PointStamped) -> None:
        now, stamp = time.time_ns(), message.header.stamp
        since_start = now - (stamp.sec * 1_000_000_000 + stamp.nanosec)
        say(number=int(message.point.x), frame=message.header.frame_id, since_start=since_start)

    node.create_subscription(PointStamped, "/t3", came_back, qos)
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    give_up = time.monotonic() + 30
    while not (publisher.get_subscription_count() and node.count_publishers("/t3")):
        if time.monotonic() > give_up:
            raise SystemExit("the shaping node did not appear")
        executor.spin_once(timeout_sec=0.1)
    (offered,) = node.get_publishers_info_by_topic("/t3")
    known = offered.qos_profile
    say(
        type=offered.topic_type,
        reliability=known.reliability.name,
        durability=known.durability.name,
        deadline=known.deadline.nanoseconds,
        lifespan=known.lifespan.nanoseconds,
    )
    time.sleep(1)  # both sides have to know each other
    for number in range(count):
        if number == count // 2:
            modes.publish(String(data="highway"))
        message = PointStamped()
        message.header.stamp = node.get_clock().now().to_msg()
        message.header.frame_id = f"frame {number}"
        message.point.x = float(number)
        publisher.publish(message)
        until = time.monotonic() + PERIOD_S
        while (rest := until - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=rest)
    until = time.monotonic() + 0.5
    while (rest := until - time.monotonic()) > 0:
        executor.spin_once(timeout_sec=rest)


main()
