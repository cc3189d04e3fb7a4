"""Nodes of rclpy that note themselves when their callbacks run:
NOTES single|multi|events SECONDS [raising]

A line of NOTES is the note of an instance, in JSON: `callback`, `node`, `tids`, and `runs`, when it
ran: pairs of ns of CLOCK_MONOTONIC (of a coroutine several). `raising`: a timer raises an exception
in each third call.
"""

import functools
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import Imu, Temperature

notes: list[dict[str, Any]] = []


def busy(duration: float) -> None:
    until = time.thread_time() + duration
    while time.thread_time() < until:
        pass


class Note:
    """Notes an instance from when its callback begins, on the thread that runs it."""

    def __init__(self, callback: str, node: Any) -> None:
        self.kept: dict[str, Any] = {"callback": callback, "node": node.get_name()}
        self.kept |= {"tids": [], "runs": []}
        self.run()

    def run(self) -> None:
        self.kept["tids"].append(threading.get_native_id())
        self.kept["runs"].append([time.monotonic_ns(), 0])

    def wait(self) -> None:
        self.kept["runs"][-1][1] = time.monotonic_ns()

    def done(self) -> None:
        self.wait()
        notes.append(self.kept)


def noted(function: Callable[..., Any]) -> Callable[..., Any]:
    """The method notes each of its calls, also of one that raises."""

    @functools.wraps(function)
    def noting(self: Any, *arguments: Any) -> Any:
        note = Note(function.__name__, self)
        try:
            return function(self, *arguments)
        finally:
            note.done()

    return noting


class Sensor(Node):  # type: ignore[misc]
    def __init__(self, raises: bool) -> None:
        super().__init__("sensor")
        self.raises, self.calls = raises, 0
        self.output = self.create_publisher(Imu, "/raw", 10)
        self.slow = self.create_publisher(Temperature, "/slow", 10)

    def begin(self) -> None:
        """Called when the other nodes are there: the last one made is not this timer's node."""
        self.timers_ = [self.create_timer(0.03, self.tick), self.create_timer(0.05, self.tock)]

    @noted
    def tick(self) -> None:
        self.calls += 1
        busy(0.002)
        self.output.publish(Imu())
        if self.raises and self.calls % 3 == 0:
            raise ArithmeticError("as asked for")

    @noted
    def tock(self) -> None:
        busy(0.001)
        self.slow.publish(Temperature())


class Worker(Node):  # type: ignore[misc]
    def __init__(self, kind: str) -> None:
        super().__init__("worker")
        group = ReentrantCallbackGroup()
        self.outputs = {
            topic: self.create_publisher(Imu, topic, 10)
            for topic in ("/done", "/asked", "/later", "/condition", "/by_task", "/answered")
        }
        self.client = self.create_client(ListParameters, "/judge", callback_group=group)
        self.create_service(ListParameters, "/judge", self.judge, callback_group=group)
        # The events executor refuses guard conditions.
        self.condition = self.create_guard_condition(self.triggered) if kind != "events" else None
        qos = QoSProfile(depth=10)
        self.create_subscription(Imu, "/raw", self.work, qos)
        self.create_subscription(Imu, "/raw", self.ask, qos, callback_group=group)
        self.create_subscription(Temperature, "/slow", self.sleep, qos, callback_group=group)
        self.create_subscription(Temperature, "/slow", self.hand_over, qos, callback_group=group)
        self.due: list[tuple[float, Any]] = []
        self.create_timer(0.01, self.alarm, callback_group=group)

    @noted
    def work(self, message: Any) -> None:
        busy(0.003)
        self.outputs["/done"].publish(message)
        if self.condition:
            self.condition.trigger()

    @noted
    def triggered(self) -> None:
        busy(0.0005)
        self.outputs["/condition"].publish(Imu())

    @noted
    def judge(self, request: Any, response: Any) -> Any:
        busy(0.001)
        response.result.names = request.prefixes
        return response

    async def ask(self, message: Any) -> None:
        """A coroutine that waits for a service of its own executor."""
        note = Note("ask", self)
        busy(0.001)
        request = self.client.call_async(ListParameters.Request())
        note.wait()
        await request
        note.run()
        busy(0.001)
        self.outputs["/asked"].publish(message)
        note.done()

    async def sleep(self, _: Any) -> None:
        """A coroutine that waits for a time, and whose instances overlap those of `ask`."""
        note = Note("sleep", self)
        for _ in range(2):
            busy(0.0005)
            over = Future(executor=self.executor)
            self.due.append((time.monotonic() + 0.015, over))
            note.wait()
            await over
            note.run()
        self.outputs["/later"].publish(Imu())
        note.done()

    @noted
    def alarm(self) -> None:
        for entry in [entry for entry in self.due if entry[0] < time.monotonic()]:
            self.due.remove(entry)
            entry[1].set_result(None)

    @noted
    def hand_over(self, _: Any) -> None:
        """Leaves its output to a task, and asks a service whose answer another task handles."""
        self.executor.create_task(self.task)
        self.client.call_async(ListParameters.Request()).add_done_callback(self.answered)

    def task(self) -> None:
        busy(0.0005)
        self.outputs["/by_task"].publish(Imu())

    def answered(self, _: Any) -> None:
        self.outputs["/answered"].publish(Imu())


class Sink(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("sink")
        for topic in ("/done", "/asked", "/later"):
            self.create_subscription(Imu, topic, functools.partial(self.take, topic), 10)

    def take(self, topic: str, _: Any) -> None:
        note = Note("take" + topic, self)
        note.done()


def executor_of(name: str) -> Any:
    if name == "events":
        from rclpy.experimental import EventsExecutor

        return EventsExecutor()
    return MultiThreadedExecutor(4) if name == "multi" else SingleThreadedExecutor()


def main() -> None:
    file, kind, seconds, *options = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    rclpy.init()
    sensor = Sensor("raising" in options)
    nodes = [sensor, Worker(kind), Sink()]
    executor = executor_of(kind)
    for node in nodes:
        executor.add_node(node)
    sensor.begin()
    until, raised = time.monotonic() + float(seconds), 0
    while time.monotonic() < until:
        try:
            executor.spin_once(timeout_sec=0.1)
        except ArithmeticError:
            raised += 1
        except (KeyboardInterrupt, ExternalShutdownException):
            break
    with Path(file).open("w") as output:
        for note in notes:
            output.write(json.dumps(note) + "\n")
    assert bool(raised) == bool(sensor.raises)
    sys.stdout.flush()
    os._exit(0)  # threads of the pool still wait


main()
