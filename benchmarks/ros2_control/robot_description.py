"""Keeps a URDF on the latched topic /robot_description, as robot_state_publisher does."""

import sys
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("robot_description")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
publisher = node.create_publisher(String, "robot_description", latched)
publisher.publish(String(data=Path(sys.argv[1]).read_text(encoding="utf-8")))
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
