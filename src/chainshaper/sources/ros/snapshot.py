"""Topics' types and QoS while an application runs.

Types and QoS travel in DDS discovery only, so somebody has to join the graph and listen:
:mod:`chainshaper.sources.ros.graph`, run by the application's own ROS 2, in the environment of one
of its nodes (domain, RMW, its configuration). One participant for a few seconds tells of all
topics; `ros2 topic info -v` would be one per topic, and leave a daemon behind. It is asked when
tracing is over, because discovery costs every node some time.

Whoever is in the graph says what it likes, and DDS without its security plug-ins does not prove who
is: the answer is bounded and checked in its form, and believed in nothing but names, types and QoS.

A snapshot that fails never fails the recording: it is a note.
"""

import json
import re

from chainshaper.sources.ros import graph as ros_graph
from chainshaper.sources.ros.interpreter import Environment, run_with_rclpy
from chainshaper.values.recording import EndpointInfo

__all__ = ["ask_graph"]

_PATIENCE_S = 10
"""Discovery is waited for that long at most, and longer than that for Python and RMW to load."""
_START_S = 20
_NAME = re.compile(r"[!-~]{0,255}/[!-~]{1,255}")
_LARGEST = 1 << 63


def ask_graph(environment: Environment) -> tuple[tuple[EndpointInfo, ...], str | None]:
    """All endpoints of the ROS graph that a node with this environment belongs to.

    Returns:
        The endpoints, and why there are none, if so.
    """
    said, problem = run_with_rclpy(
        environment, ros_graph.__file__, str(_PATIENCE_S), within_s=_PATIENCE_S + _START_S
    )
    if problem is not None:
        return (), problem
    try:
        # Libraries may have printed something before.
        found = json.loads(said[said.index('{"endpoints"') :])["endpoints"]
        endpoints = (EndpointInfo.model_validate(one) for one in found)
        return tuple(one for one in endpoints if _is_ros(one)), None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        return (), str(error)


def _is_ros(one: EndpointInfo) -> bool:
    """Whether an endpoint's names and numbers are such as ROS 2 has; others are no endpoints."""
    values = one.model_dump(exclude_none=True).values()
    names = all(_NAME.fullmatch(name) for name in (one.node, one.topic, one.type) if name)
    return names and all(value < _LARGEST for value in values if isinstance(value, int))
