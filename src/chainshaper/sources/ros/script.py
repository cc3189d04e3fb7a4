"""What is asked of a ROS 2 that runs, by the Python of its installation.

    python3 script.py graph [SECONDS]
    python3 script.py parameter NAME VALUE NODE...
    python3 script.py diagnostics DESCRIPTOR

This file is run, not imported: by the interpreter that has `rclpy` (Humble or later), where nothing
of ours may be installed.

`graph` prints one JSON object: ``endpoints``, one per publisher and subscription of each topic with
type and QoS. Discovery is over when nothing new has appeared for two seconds, or after SECONDS
(10). Durations are ns; null where the application set none, or the RMW does not tell.

`parameter` sets an integer parameter. It ends with an error that names each node which has no such
parameter, refuses the value, or does not answer within five seconds. The answer comes from whoever
offers the service under the node's name. Where several offer it (rclpy counts them since Jazzy), an
answer says nothing, and that is an error.

`diagnostics` publishes each line that it reads from DESCRIPTOR on `/diagnostics`, until that ends:
a JSON list of objects with ``name``, ``level`` (0: OK, 1: WARN, 2: ERROR), ``message``, ``values``.
"""

import importlib
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SNAPSHOT = "_chainshaper_snapshot"  # nodes' names; hidden: `ros2 node list` does not show them
SETTER = "_chainshaper_parameter"
WATCHER = "_chainshaper_watch"
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # of an endpoint that was discovered before its node was (rmw)
QUIET_S, LOOK_S = 2.0, 0.2
FIRST_S = 4.0  # to hear of any node: one of Fast DDS may call again only after three seconds
ANSWER_S, SPIN_S = 5.0, 0.05
INFINITE_NS = 1 << 62
"""Durations beyond are no durations: RMW_DURATION_INFINITE, and what RMWs make of it."""


@contextmanager
def node_named(name: str) -> "Iterator[tuple[Any, Any]]":
    """`rclpy` and a node, for as long as it is used."""
    rclpy: Any = importlib.import_module("rclpy")
    rclpy.init(args=[])
    node = rclpy.create_node(name, enable_rosout=False, start_parameter_services=False)
    try:
        yield rclpy, node
    finally:
        node.destroy_node()
        rclpy.shutdown()


def publish_diagnostics(descriptor: int) -> None:
    """Publish the statuses of each line that is read, until there are no more."""
    messages = importlib.import_module("diagnostic_msgs.msg")
    kind = messages.DiagnosticStatus
    with node_named(WATCHER) as (_, node), open(descriptor, encoding="utf-8") as lines:
        publisher = node.create_publisher(messages.DiagnosticArray, "/diagnostics", 10)
        for line in lines:
            array = messages.DiagnosticArray()
            array.header.stamp = node.get_clock().now().to_msg()
            try:
                statuses = json.loads(line)
            except ValueError:  # a pipe that was full took a part of it
                continue
            for given in statuses:
                status = kind(
                    name=given["name"], message=given["message"], hardware_id="chainshaper"
                )
                status.level = (kind.OK, kind.WARN, kind.ERROR)[given["level"]]
                values = given["values"].items()
                status.values = [messages.KeyValue(key=key, value=text) for key, text in values]
                array.status.append(status)
            publisher.publish(array)


def print_graph(patience: float = 10.0) -> None:
    """Print all endpoints as soon as discovery is over, at most after so many seconds."""
    with node_named(SNAPSHOT) as (_, node):
        begun = quiet_since = time.monotonic()
        known = -1
        seen: list[dict[str, Any]] = []
        while time.monotonic() < min(
            quiet_since + (QUIET_S if seen else FIRST_S), begun + patience
        ):
            seen = endpoints(node)
            # The node of an endpoint is discovered behind the endpoint.
            unknown = any(endpoint["node"].endswith(UNKNOWN_NODE) for endpoint in seen)
            if unknown or len(seen) != known:
                known, quiet_since = len(seen), time.monotonic()
            time.sleep(LOOK_S)
        json.dump({"endpoints": seen}, sys.stdout)


def endpoints(node: Any) -> list[dict[str, Any]]:
    """Return all publishers and subscriptions that ``node`` knows of, without its own."""
    return [
        as_json(topic, kind, info)
        for topic, _ in node.get_topic_names_and_types()
        for kind, infos in (
            ("publisher", node.get_publishers_info_by_topic(topic)),
            ("subscription", node.get_subscriptions_info_by_topic(topic)),
        )
        for info in infos
        if info.node_name != SNAPSHOT
    ]


def as_json(topic: str, kind: str, info: Any) -> dict[str, Any]:
    """Return an endpoint with its type and QoS."""
    qos = info.qos_profile
    endpoint = {
        "node": info.node_namespace.rstrip("/") + "/" + info.node_name,
        "topic": topic,
        "kind": kind,
        "type": info.topic_type,
        "depth": qos.depth,
    }
    for word in ("reliability", "durability", "history", "liveliness"):
        endpoint[word] = getattr(qos, word).name.lower()
    for name, duration in (
        ("deadline_ns", qos.deadline),
        ("lifespan_ns", qos.lifespan),
        ("liveliness_lease_ns", qos.liveliness_lease_duration),
    ):
        nanoseconds = int(duration.nanoseconds)
        endpoint[name] = nanoseconds if 0 < nanoseconds < INFINITE_NS else None
    return endpoint


def set_parameter(name: str, value: str, *nodes: str) -> None:
    """Set an integer parameter of nodes; exit with the problems, if there are any."""
    with node_named(SETTER) as (rclpy, node):
        service: Any = importlib.import_module("rcl_interfaces.srv").SetParameters
        parameter: Any = importlib.import_module("rclpy.parameter").Parameter
        wanted = parameter(name, parameter.Type.INTEGER, int(value)).to_parameter_msg()
        request = service.Request(parameters=[wanted])
        clients = {
            target: node.create_client(service, f"{target}/set_parameters") for target in nodes
        }
        answers: dict[str, Any] = {}
        until = time.monotonic() + ANSWER_S
        while time.monotonic() < until:
            for target, client in clients.items():
                if target not in answers and client.service_is_ready():
                    answers[target] = client.call_async(request)
            rclpy.spin_once(node, timeout_sec=SPIN_S)
            if len(answers) == len(nodes) and all(answer.done() for answer in answers.values()):
                break
        count = getattr(node, "count_services", lambda _: 1)
        offered = {target: count(f"{target}/set_parameters") for target in nodes}
    problems = [problem(target, name, answers.get(target), offered[target]) for target in nodes]
    if any(problems):
        sys.exit("; ".join(filter(None, problems)))


def problem(node: str, name: str, answer: Any, offered: int) -> "str | None":
    """Return why a node's parameter is not what it was set to; None: it is."""
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
    if sys.argv[1] == "graph":
        print_graph(*(float(seconds) for seconds in sys.argv[2:]))
    elif sys.argv[1] == "diagnostics":
        publish_diagnostics(int(sys.argv[2]))
    else:
        set_parameter(*sys.argv[2:])
