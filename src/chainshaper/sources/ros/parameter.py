"""Setting an integer parameter of a node that runs, by the Python of a ROS 2 installation.

    python3 ros_parameter.py NODE NAME VALUE [SECONDS]

This file is run, not imported, like :mod:`chainshaper.sources.ros.graph`. It ends with an error
when the node has no such parameter, refuses the value, or does not answer within SECONDS (5).
"""

import importlib
import sys
from typing import Any

NODE = "_chainshaper_parameter"


def main() -> None:
    """Call the node's service ``set_parameters``."""
    rclpy: Any = importlib.import_module("rclpy")
    service: Any = importlib.import_module("rcl_interfaces.srv").SetParameters
    parameter_class: Any = importlib.import_module("rclpy.parameter").Parameter
    name, parameter, value = sys.argv[1], sys.argv[2], int(sys.argv[3])
    patience = float(sys.argv[4]) if len(sys.argv) > 4 else 5.0
    rclpy.init(args=[])
    node = rclpy.create_node(NODE, enable_rosout=False, start_parameter_services=False)
    try:
        client = node.create_client(service, f"{name}/set_parameters")
        if not client.wait_for_service(timeout_sec=patience):
            sys.exit(f"{name} offers no parameters")
        request = service.Request()
        wanted = parameter_class(parameter, parameter_class.Type.INTEGER, value)
        request.parameters = [wanted.to_parameter_msg()]
        answer = client.call_async(request)
        rclpy.spin_until_future_complete(node, answer, timeout_sec=patience)
        if not answer.done():
            sys.exit(f"{name} did not answer")
        (result,) = answer.result().results
        if not result.successful:
            sys.exit(f"{name} refused {parameter}: {result.reason or 'no reason given'}")
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
