"""A node in rclpy that talks, or listens: `chatting.py talker|listener`."""

import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node(sys.argv[1])
if sys.argv[1] == "talker":
    publisher = node.create_publisher(String, "chatter", 10)
    node.create_timer(1.0, lambda: publisher.publish(String(data="hello")))
else:
    node.create_subscription(String, "chatter", lambda _: None, 10)
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
