"""Setting an integer parameter of nodes that run, by the Python of a ROS 2 installation.

    python3 parameter.py NAME VALUE NODE...

This file is run, not imported, like :mod:`chainshaper.sources.ros.graph`. It ends with an error
that names each node which has no such parameter, refuses the value, or does not answer in time;
all of them together have five seconds.

Who answers is whoever offers the service under the node's name: DDS does not prove who that is
without its security plug-ins (SROS 2). All that offer it are asked, the node among them; where
there are several (rclpy counts them since Jazzy), an answer says nothing, and that is an error.
"""

import importlib
import sys
import time
from typing import Any

NODE = "_chainshaper_parameter"
PATIENCE_S = 5.0
LOOK_S = 0.05


def main() -> None:
    """Call the service ``set_parameters`` of all nodes at once."""
    rclpy: Any = importlib.import_module("rclpy")
    service: Any = importlib.import_module("rcl_interfaces.srv").SetParameters
    parameter: Any = importlib.import_module("rclpy.parameter").Parameter
    name, value, *nodes = sys.argv[1:]
    rclpy.init(args=[])
    node = rclpy.create_node(NODE, enable_rosout=False, start_parameter_services=False)
    try:
        wanted = parameter(name, parameter.Type.INTEGER, int(value)).to_parameter_msg()
        request = service.Request(parameters=[wanted])
        clients = {one: node.create_client(service, f"{one}/set_parameters") for one in nodes}
        answers: dict[str, Any] = {}
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            for one, client in clients.items():
                if one not in answers and client.service_is_ready():
                    answers[one] = client.call_async(request)
            rclpy.spin_once(node, timeout_sec=LOOK_S)
            if len(answers) == len(nodes) and all(answer.done() for answer in answers.values()):
                break
        count = getattr(node, "count_services", lambda _: 1)
        offered = {one: count(f"{one}/set_parameters") for one in nodes}
    finally:
        node.destroy_node()
        rclpy.shutdown()
    asked = [_problem(one, name, answers.get(one), offered[one]) for one in nodes]
    problems = [problem for problem in asked if problem is not None]
    if problems:
        sys.exit("; ".join(problems))


def _problem(node: str, name: str, answer: Any, offered: int) -> "str | None":
    if offered > 1:
        return f"{offered} participants answer for {node}, so none of them is believed"
    if answer is None:
        return f"{node} offers no parameters"
    if not answer.done():
        return f"{node} did not answer"
    (result,) = answer.result().results
    if result.successful:
        return None
    return f"{node} refused {name}: {result.reason or 'no reason given'}"


if __name__ == "__main__":
    main()
