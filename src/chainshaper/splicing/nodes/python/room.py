"""How many messages have room, at a gate with its endpoints and at its standby."""

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from chainshaper.gate.decision import READER_DEPTH, Gate
from chainshaper.splicing.nodes.python.endpoints import asked_of, offered_by, parameter

__all__ = ["room_of"]


def room_of(node: Node, info: Any) -> tuple[int, QoSProfile, QoSProfile]:
    """How many messages may wait at the gate of a topic, and the QoS of its output and input."""
    offered = offered_by(info, parameter(node, "output_depth", 10))
    depth = parameter(node, "depth", 0) or max(Gate.depth, offered.depth)
    if offered.durability != QoSDurabilityPolicy.TRANSIENT_LOCAL:
        # What leaves in one slot must find room in the writer, too.
        offered.depth = max(offered.depth, depth)
    asked = asked_of(offered)
    asked.depth = max(READER_DEPTH, depth)
    return depth, offered, asked
