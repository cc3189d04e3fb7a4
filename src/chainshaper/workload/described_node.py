"""A node of a described application, for `rclpy` of Humble or later.

    python3 described_node.py NODE.json --ros-args -r __node:=NAME -r __ns:=/

This file is run, not imported: by the interpreter that has `rclpy`, where nothing of ours may be
installed. `ros_nodes.py` writes what it reads.

Its timers expire at multiples of their periods on CLOCK_MONOTONIC, each after its phase; its loop
is a thread that sleeps until such multiples. They begin when every topic of the node has someone at
the other end; then the file ``ready`` appears.
"""

import ctypes
import gc
import itertools
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage

LOOK_S = 0.02
SECOND = 1_000_000_000
LOOP_NAME = b"loop"  # of the thread of the node's loop


def main(file: str) -> None:
    """Run the node that a file describes until it is interrupted."""
    described = json.loads(Path(file).read_text(encoding="utf-8"))
    rclpy.init()
    node = DescribedNode(described)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.await_counterparts()
        scheduling = described["scheduling"] or {}
        loop_scheduling = scheduling.pop("loop", None)
        if scheduling:
            schedule(**scheduling)
        gc.collect()
        gc.freeze()  # a collection does not go through all that was imported
        Path(described["ready"]).touch()
        node.start_loop(loop_scheduling)
        node.start_timers(executor)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # it may come twice
        node.end_loop()
        node.destroy_node()
        with suppress(RuntimeError):  # rclpy's thread for signals does so now; Zenoh takes its time
            rclpy.try_shutdown()


class DescribedNode(Node):  # type: ignore[misc]
    """A node whose callbacks spend the described times, and pass a stamp on."""

    def __init__(self, described: dict[str, Any]) -> None:
        super().__init__("described_node")
        self._topics: dict[str, Any] = described["topics"]
        self._outputs: list[Any] = []
        self._inputs: list[str] = []
        self._timers_due: list[tuple[int, int, Any]] = []  # of each: phase, period, timer
        self._loop: Loop | None = None
        for callback in described["callbacks"]:
            work = self._work(callback)
            if callback["loop_ns"] is not None:
                self._add_loop(callback, work)
            elif callback["timer_ns"] is not None:
                self._add_timer(callback["timer_ns"], callback["phase_ns"], work)
            else:
                self._subscribe(callback["subscription"], work)

    def await_counterparts(self) -> None:
        """Wait until each topic that has both is published and subscribed to elsewhere."""
        while rclpy.ok():
            taken = all(output.get_subscription_count() for output in self._outputs)
            if taken and all(map(self.count_publishers, self._inputs)):
                return
            time.sleep(LOOK_S)
        raise ExternalShutdownException

    def start_timers(self, executor: Any) -> None:
        """Let each timer begin at its phase; what arrives before is worked on."""
        now = time.monotonic_ns()
        begins = [
            (now + (phase_ns - now) % period_ns, number)
            for number, (phase_ns, period_ns, _) in enumerate(self._timers_due)
        ]
        for begin_ns, number in sorted(begins):
            while (left_ns := begin_ns - time.monotonic_ns()) > 0:
                executor.spin_once(timeout_sec=left_ns / SECOND)
            self._timers_due[number][2].reset()  # it expires first a period later

    def start_loop(self, scheduling: dict[str, int] | None) -> None:
        """Let the node's loop begin, if it has one, with the core and priority of its thread."""
        if self._loop is not None:
            self._loop.start(scheduling)

    def end_loop(self) -> None:
        """Wait until the node's loop has ended."""
        if self._loop is not None:
            self._loop.end()

    def _work(self, callback: dict[str, Any]) -> Callable[[Any, int], None]:
        """Return what a callback does: spend its time, publish with a stamp, and do the rest."""
        publishers, messages = [], []
        for topic in callback["publishes"]:
            quality = self._quality(topic)
            if (lifespan_ns := self._topics[topic]["lifespan_ns"]) is not None:
                quality.lifespan = Duration(nanoseconds=lifespan_ns)
            publishers.append(self.create_publisher(CompressedImage, topic, quality))
            if self._topics[topic]["is_taken"]:
                self._outputs.append(publishers[-1])
            messages.append(CompressedImage(data=bytes(self._topics[topic]["payload"])))
        times, rest = (repeated(callback[name]) for name in ("execution_ns", "afterwards_ns"))

        def work(stamp: Any, since_ns: int) -> None:
            spend(next(times), since_ns)
            for publisher, message in zip(publishers, messages):  # noqa: B905 - Humble's is older
                message.header.stamp = stamp
                publish(publisher, message)
            spend(next(rest), time.thread_time_ns())

        return work

    def _subscribe(self, topic: str, work: Callable[[Any, int], None]) -> None:
        def received(message: Any) -> None:
            work(message.header.stamp, time.thread_time_ns())

        self._inputs.append(topic)
        self.create_subscription(CompressedImage, topic, received, self._quality(topic))

    def _add_loop(self, callback: dict[str, Any], work: Callable[[Any, int], None]) -> None:
        topics = callback["reads"]
        loop = self._loop = Loop(callback["loop_ns"], callback["phase_ns"], len(topics), work)
        for number, topic in enumerate(topics):
            self._store(topic, loop.stored, number)

    def _store(self, topic: str, stored: list[Any], number: int) -> None:
        """Store the stamp of a topic's newest message."""

        def received(message: Any) -> None:
            stored[number] = message.header.stamp

        self._inputs.append(topic)
        self.create_subscription(CompressedImage, topic, received, self._quality(topic))

    def _add_timer(self, period_ns: int, phase_ns: int, work: Callable[[Any, int], None]) -> None:
        def expired() -> None:
            work(stamp_of_now(), time.thread_time_ns())

        clock = Clock(clock_type=ClockType.STEADY_TIME)
        # rclpy takes seconds and cuts off behind the nanosecond.
        timer = self.create_timer((period_ns + 0.5) / SECOND, expired, clock=clock)
        timer.cancel()
        self._timers_due.append((phase_ns, period_ns, timer))

    def _quality(self, topic: str) -> Any:
        reliability = QoSReliabilityPolicy[self._topics[topic]["reliability"].upper()]
        return QoSProfile(depth=self._topics[topic]["depth"], reliability=reliability)


class Loop:
    """A loop in a thread of its own, which uses the newest stamp ``stored`` of its first topic."""

    def __init__(
        self, period_ns: int, phase_ns: int, topics: int, work: Callable[[Any, int], None]
    ) -> None:
        self.stored: list[Any] = [None] * topics
        self._period_ns, self._phase_ns, self._work = period_ns, phase_ns, work
        self._scheduling: dict[str, int] | None = None
        self._over = False
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self, scheduling: dict[str, int] | None) -> None:
        """Let it begin, with this core and SCHED_FIFO priority, if any."""
        self._scheduling = scheduling
        self._thread.start()

    def end(self) -> None:
        """Wait until its last instance has ended."""
        self._over = True
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        tid = threading.get_native_id()
        Path(f"/proc/self/task/{tid}/comm").write_bytes(LOOP_NAME)  # by which it is recorded
        if self._scheduling is not None:
            set_scheduling(0, self._scheduling)
        now = time.monotonic_ns()
        due_ns = now + (self._phase_ns - now) % self._period_ns
        with suppress(ExternalShutdownException):
            while rclpy.ok():
                sleep_until(due_ns)
                if self._over:
                    return
                stamp = self.stored[0] if self.stored else None
                self._work(stamp_of_now() if stamp is None else stamp, time.thread_time_ns())
                due_ns += self._period_ns
                missed_ns = max(0, time.monotonic_ns() - due_ns)
                due_ns += -(-missed_ns // self._period_ns) * self._period_ns


def sleep_until(deadline_ns: int) -> None:
    """Sleep until an instant of CLOCK_MONOTONIC, unless a signal ends the sleep."""
    deadline = (ctypes.c_long * 2)(*divmod(deadline_ns, SECOND))
    absolute = 1  # TIMER_ABSTIME
    ctypes.CDLL(None).clock_nanosleep(time.CLOCK_MONOTONIC, absolute, deadline, None)


def stamp_of_now() -> Any:
    """Return the time of the system's clock as a stamp."""
    seconds, nanoseconds = divmod(time.time_ns(), SECOND)
    return Time(sec=seconds, nanosec=nanoseconds)


def publish(publisher: Any, message: Any) -> None:
    """Publish a message. Raises ExternalShutdownException: the node was asked to end meanwhile."""
    try:
        publisher.publish(message)
    except RuntimeError as error:  # rclpy's RCLError is one
        if rclpy.ok():
            raise
        raise ExternalShutdownException from error


def repeated(times_ns: list[int]) -> Iterator[int]:
    """Yield the times again and again, in their order."""
    return itertools.cycle(times_ns)


def spend(cpu_ns: int, since_ns: int) -> None:
    """Compute until this thread has used ``cpu_ns`` since its CPU clock showed ``since_ns``."""
    clock, until = time.thread_time_ns, since_ns + cpu_ns
    while clock() < until:
        pass


def schedule(executor: dict[str, int], dds: dict[str, int]) -> None:
    """Give this thread and all others, which are of DDS, their cores and SCHED_FIFO priorities.

    A gate in this process has seen to its thread by itself.
    """
    for thread in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            if (thread / "comm").read_bytes().startswith(b"gate-"):
                continue
            tid = int(thread.name)
            set_scheduling(tid, executor if tid == os.getpid() else dds)


def set_scheduling(tid: int, wanted: dict[str, int]) -> None:
    """Give a thread, or this one (0), its core and SCHED_FIFO priority."""
    os.sched_setscheduler(tid, os.SCHED_FIFO, os.sched_param(wanted["priority"]))
    os.sched_setaffinity(tid, {wanted["core"]})


if __name__ == "__main__":
    main(sys.argv[1])
