"""The standby: it publishes an output while the shaping node is not there.

While no shaping node is in force (:mod:`chainshaper.robot.handover`), the standby publishes what
that node would receive, on the same output, byte for byte and at once. With the fallback
``silence`` it only counts these messages. Either way it reports them: in a log like the gate's, by
a warning, and on `/diagnostics` where diagnostic_msgs is installed. It has no real-time priority.
"""

import importlib
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node

from chainshaper.robot.decision import Release
from chainshaper.robot.handover import Standby
from chainshaper.robot.python.node import (
    HUMBLE,
    GateLog,
    message_class,
    parameters_of,
    room_of,
    run,
    wait,
    wait_for_publisher,
)
from chainshaper.robot.waiting import Outcome, Waiting


def watch(node: Node, standby: Standby) -> None:
    """Watch the shaping node; end the process if that fails: the launch starts it again."""
    try:
        standby.watch()
    except BaseException as error:
        if rclpy.ok():
            node.get_logger().fatal(f"cannot look after the shaping node: {error}")
            os._exit(1)
        raise


def diagnostics_of(node: Node, standby: Standby, shaping_node: str) -> None:
    """Publish the state of the output on `/diagnostics`, once a second."""
    try:
        messages = importlib.import_module("diagnostic_msgs.msg")
    except ImportError:
        return
    publisher = node.create_publisher(messages.DiagnosticArray, "/diagnostics", 10)

    def report() -> None:
        page, level, text = standby.page, 0, "shaped"
        if since := page["bypassing_since_ns"]:
            level, word = 1 + page["silent"], ("bypassed", "silent")[page["silent"]]
            seconds = (time.monotonic_ns() - since) / 1e9
            count = page["bypassed"] - page["bypassed_before"]
            text = f"{word} for {seconds:.1f} s, {count} messages"
        values = {"output": page.topic, "shaping node": shaping_node, "starts": page["starts"]}
        values["messages without it since boot"] = page["bypassed"]
        pairs = [messages.KeyValue(key=key, value=str(value)) for key, value in values.items()]
        about = {"name": f"chainshaper: {page.topic}", "message": text, "hardware_id": ""}
        status = messages.DiagnosticStatus(level=bytes([level]), values=pairs, **about)
        array = messages.DiagnosticArray(status=[status])
        array.header.stamp = node.get_clock().now().to_msg()
        with suppress(RuntimeError):  # the process is to stop
            publisher.publish(array)

    node.create_timer(1.0, report)


def set_up(node: Node) -> Callable[[], bool]:
    """Make the node's endpoints, and start to watch the shaping node."""
    parameters = parameters_of(node)
    ours = os.sched_getaffinity(0) - set(parameters.server_cores)
    if ours:  # servers have the other cores
        for thread in Path("/proc/self/task").iterdir():
            with suppress(OSError):
                os.sched_setaffinity(int(thread.name), ours)
    silent, shaping_node = parameters.fallback == "silence", parameters.shaping_node
    log, logger = GateLog(node), node.get_logger()
    info = wait_for_publisher(node, "input")
    _, offered, asked = room_of(node, info)
    message_type, topic = message_class(info.topic_type), node.resolve_topic_name("output")
    publisher = None if silent else node.create_publisher(message_type, "output", offered)

    def publish(payload: bytes, source_timestamp: int | None, arrival: int) -> None:
        published = None
        if publisher is not None:
            try:
                publisher.publish(payload)
            except RuntimeError:  # rclpy's RCLError is one
                if rclpy.ok():
                    raise
                return  # the process is to stop
            published = time.monotonic_ns()
        treated = "silence" if silent else "bypass"
        release = Release(None if silent else arrival, arrival, None, 0, "cycle", treated)
        message = Waiting(payload, arrival, None, 0, about=source_timestamp)
        log.write(Outcome(message, release, time.monotonic_ns()), published)

    def changed(state: str) -> None:
        until = "nothing is published" if silent else "messages go around it"
        text = f"{shaping_node} {state}"
        logger.warning(text if state.startswith("is back") else f"{text}: {topic}: {until}")

    standby = None
    while standby is None:
        try:
            standby = Standby(
                parameters.handover,
                topic,
                publish,
                changed,
                parameters.patience_ns,
                asked.depth,
                silent=silent,
            )
        except OSError as error:
            logger.error(f"{topic} falls silent when {shaping_node} does: {error}")
            wait(10.0)

    def without_info(payload: bytes) -> None:
        # Without a source timestamp messages cannot be told apart: those that the shaping node has
        # when it dies are lost.
        standby.arrived(payload, None)

    def with_info(payload: bytes, message_info: Any) -> None:
        standby.arrived(payload, message_info["source_timestamp"])

    callback = without_info if HUMBLE else with_info
    node.create_subscription(message_type, "input", callback, asked, raw=True)
    threading.Thread(target=watch, args=(node, standby), name="watch", daemon=True).start()
    diagnostics_of(node, standby, shaping_node)
    return lambda: False


if __name__ == "__main__":
    run("chainshaper_standby", set_up, realtime=False)
