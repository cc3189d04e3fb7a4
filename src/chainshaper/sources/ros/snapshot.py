"""Topics' types and QoS while an application runs.

Types and QoS travel in DDS discovery only, so somebody has to join the graph and listen:
:mod:`chainshaper.sources.ros.graph`, run by the application's own ROS 2, in the environment of one
of its nodes (domain, RMW, its configuration). One participant for a few seconds tells of all
topics; `ros2 topic info -v` would be one per topic, and leave a daemon behind. It is asked when
tracing is over, because discovery costs every node some time.

A snapshot that fails never fails the recording: it is a note.
"""

import json
from collections.abc import Mapping

from pydantic import ValidationError

from chainshaper.recording import EndpointInfo
from chainshaper.sources.ros import graph as ros_graph
from chainshaper.sources.ros.interpreter import run_with_rclpy

__all__ = ["ask_graph"]

_PATIENCE_S = 10
"""Discovery is waited for that long at most, and longer than that for Python and RMW to load."""
_START_S = 20


def ask_graph(environment: Mapping[str, str]) -> tuple[tuple[EndpointInfo, ...], str | None]:
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
        return tuple(EndpointInfo.model_validate(one) for one in found), None
    except (ValueError, KeyError, ValidationError) as error:
        return (), str(error)
