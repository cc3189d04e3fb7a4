"""The ROS graph with types and QoS, printed as JSON by the Python of a ROS 2 installation.

    python3 graph.py [SECONDS]

This file is run, not imported: by the interpreter that has `rclpy`, in the environment of the
application, where nothing of ours may be installed. So it needs nothing but `rclpy` (Humble or
later).

It prints one object: ``endpoints``, one per publisher and subscription of each topic, two of a kind
included. Discovery is over when nothing new has appeared for two seconds, or after SECONDS (10).
Durations are ns; null where the application set none, or the RMW does not tell.
"""

import importlib
import json
import sys
import time
from typing import Any

NODE = "_chainshaper_snapshot"  # hidden: `ros2 node list` does not show it
QUIET_S = 2.0
LOOK_S = 0.2
INFINITE_NS = 1 << 62
"""Durations beyond are no durations: RMW_DURATION_INFINITE, and what RMWs make of it."""


def main() -> None:
    """Join the graph, wait until it is known, print it, leave."""
    rclpy: Any = importlib.import_module("rclpy")
    patience = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    rclpy.init(args=[])
    node = rclpy.create_node(NODE, enable_rosout=False, start_parameter_services=False)
    try:
        begun = quiet_since = time.monotonic()
        known = -1
        found: list[dict[str, Any]] = []
        while time.monotonic() - quiet_since < QUIET_S and time.monotonic() - begun < patience:
            found = endpoints(node)
            if len(found) != known:
                known, quiet_since = len(found), time.monotonic()
            time.sleep(LOOK_S)
        json.dump({"endpoints": found}, sys.stdout)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def endpoints(node: Any) -> list[dict[str, Any]]:
    """All publishers and subscriptions that ``node`` knows of, its own left out."""
    found = []
    for topic, _ in node.get_topic_names_and_types():
        for kind, infos in (
            ("publisher", node.get_publishers_info_by_topic(topic)),
            ("subscription", node.get_subscriptions_info_by_topic(topic)),
        ):
            found += [_as_json(topic, kind, info) for info in infos if info.node_name != NODE]
    return found


def _as_json(topic: str, kind: str, info: Any) -> dict[str, Any]:
    qos = info.qos_profile
    return {
        "node": info.node_namespace.rstrip("/") + "/" + info.node_name,
        "topic": topic,
        "kind": kind,
        "type": info.topic_type,
        "reliability": qos.reliability.name.lower(),
        "durability": qos.durability.name.lower(),
        "history": qos.history.name.lower(),
        "depth": qos.depth,
        "deadline_ns": _nanoseconds(qos.deadline),
        "lifespan_ns": _nanoseconds(qos.lifespan),
        "liveliness": qos.liveliness.name.lower(),
        "liveliness_lease_ns": _nanoseconds(qos.liveliness_lease_duration),
    }


def _nanoseconds(duration: Any) -> "int | None":
    nanoseconds = int(duration.nanoseconds)
    return nanoseconds if 0 < nanoseconds < INFINITE_NS else None


if __name__ == "__main__":
    main()
