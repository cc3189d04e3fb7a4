"""What the nodes have in common on the side of ROS 2: parameters, topics, real-time scheduling.

Written for rclpy of Humble to Rolling; where they differ, it is said.
"""

import ctypes
import gc
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from chainshaper.gate.decision import DEPTH, READER_DEPTH, NodeParameters


def parameters_of(node: Node) -> NodeParameters:
    """What the parameter file says, and the rest as usual."""
    known = {
        name: node.get_parameter_or(name, Parameter(name, value=usual)).value
        for name, usual in vars(NodeParameters()).items()
    }
    return NodeParameters(**known)


def wait(seconds: float) -> None:
    """Wait, unless the process is to stop.

    Raises:
        ExternalShutdownException: it is.
    """
    until = time.monotonic() + seconds
    while rclpy.ok() and (left := until - time.monotonic()) > 0:
        time.sleep(min(left, 0.05))
    if not rclpy.ok():
        raise ExternalShutdownException


def wait_for_publisher(node: Node, topic: str) -> Any:
    """A topic's publisher as discovery knows it (`TopicEndpointInfo`), waiting until there is one.

    Raises:
        ExternalShutdownException: the process is to stop.
    """
    logger, name = node.get_logger(), node.resolve_topic_name(topic)
    said = False
    while rclpy.ok():
        found = [info for info in node.get_publishers_info_by_topic(topic) if info.topic_type]
        if found:
            if len(found) > 1:
                logger.warning(
                    f"{name} has {len(found)} publishers: the QoS of the first is copied"
                )
            node_name = f"{found[0].node_namespace.rstrip('/')}/{found[0].node_name}"
            logger.info(f"{name} is published by {node_name} as {found[0].topic_type}")
            return found[0]
        if not said:
            logger.info(f"waiting for a publisher of {name}")
            said = True
        wait(0.01)
    raise ExternalShutdownException


def message_class(type_name: str) -> Any:
    """The class of a type such as ``sensor_msgs/msg/Image``; rclpy cannot do without.

    Raises:
        ModuleNotFoundError: its package is not installed here.
    """
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def offered_by(info: Any, node: Node) -> QoSProfile:
    """The quality of service of a publisher, for the one that stands in for it.

    Discovery does not always tell everything: unknown reliability is taken to be reliable, unknown
    durability volatile, unknown liveliness automatic, and an unknown history keeps the last
    ``output_depth``.
    """
    offered = info.qos_profile
    best_effort = offered.reliability == QoSReliabilityPolicy.BEST_EFFORT
    latched = offered.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    manual = offered.liveliness == QoSLivelinessPolicy.MANUAL_BY_TOPIC
    keep_all = offered.history == QoSHistoryPolicy.KEEP_ALL
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_ALL if keep_all else QoSHistoryPolicy.KEEP_LAST,
        depth=offered.depth or parameters_of(node).output_depth,
        reliability=(
            QoSReliabilityPolicy.BEST_EFFORT if best_effort else QoSReliabilityPolicy.RELIABLE
        ),
        durability=(
            QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE
        ),
        lifespan=offered.lifespan,
        deadline=offered.deadline,
        liveliness=(
            QoSLivelinessPolicy.MANUAL_BY_TOPIC if manual else QoSLivelinessPolicy.AUTOMATIC
        ),
        liveliness_lease_duration=offered.liveliness_lease_duration,
    )


def asked_of(offered: QoSProfile) -> QoSProfile:
    """With what to subscribe to a publisher: its reliability and durability, and nothing more."""
    return QoSProfile(
        history=offered.history,
        depth=offered.depth,
        reliability=offered.reliability,
        durability=offered.durability,
    )


def room_of(node: Node, info: Any) -> tuple[int, QoSProfile, QoSProfile]:
    """How many messages may wait at the gate of a topic, and the QoS of its output and input."""
    offered = offered_by(info, node)
    depth = parameters_of(node).depth or max(DEPTH, offered.depth)
    if offered.durability != QoSDurabilityPolicy.TRANSIENT_LOCAL:
        # What leaves in one slot must find room in the writer, too.
        offered.depth = max(offered.depth, depth)
    asked = asked_of(offered)
    asked.depth = max(READER_DEPTH, depth)
    return depth, offered, asked


def become_realtime(node: Node) -> None:
    """Lock the memory, and give the calling thread its core and SCHED_FIFO priority.

    They are the parameters ``core`` and ``fifo_priority``. To be called when all endpoints exist:
    threads inherit, and those of DDS must not; later ones do not get the class. What is not
    permitted is warned of.
    """
    logger, parameters = node.get_logger(), parameters_of(node)
    core, priority = parameters.core, parameters.fifo_priority
    if ctypes.CDLL(None).mlockall(1 | 2):  # MCL_CURRENT | MCL_FUTURE
        logger.warning(
            "memory cannot be locked; it works on without: give the user a memlock limit of "
            "unlimited"
        )
    try:
        if priority > 0:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        logger.warning(
            f"SCHED_FIFO is refused: {error.strerror}; it works on without: give the user an "
            "rtprio limit of 98"
        )
    try:
        if core >= 0:
            os.sched_setaffinity(0, {core})
    except OSError as error:
        logger.warning(
            f"core {core} is refused: {error.strerror}; it works on without: name another in the "
            "plan"
        )
    gc.collect()
    gc.freeze()
    gc.disable()


def run(name: str, set_up: Callable[[Node], Callable[[], bool]], *, realtime: bool = True) -> None:
    """Run a node until it is interrupted.

    ``set_up`` makes its endpoints. What it returns is called behind each callback, and says
    whether it wants to be called again although nothing has come.
    """
    rclpy.init()
    # What is in the parameter file, is declared.
    node = Node(name, automatically_declare_parameters_from_overrides=True)
    try:
        work_off = set_up(node)
        if realtime:
            become_realtime(node)
        executor = rclpy.get_global_executor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=0 if work_off() else None)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ValueError, OSError, ImportError) as error:
        node.get_logger().fatal(str(error))
        sys.exit(1)
    finally:
        # Ctrl-C reaches a node from its terminal, and then again from `ros2 launch`.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        node.destroy_node()
        rclpy.try_shutdown()
