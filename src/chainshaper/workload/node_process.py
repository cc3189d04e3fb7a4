"""One node of the live workload, in a process of its own: ``python -m …node_process``.

Started by :mod:`chainshaper.workload.live`, with which it talks as
:mod:`chainshaper.workload.event_log` says. This module imports little on purpose: every page of
it is locked into memory.
"""

import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

from chainshaper.gate.clear_core import ClearCore
from chainshaper.gate.decision import READER_DEPTH, STALL_NS, Gate, Modes, Outcome, Shaper, text_of
from chainshaper.linux.scheduling import (
    lock_memory,
    set_thread_name,
    signalled_with_parent,
    stop_garbage_collection,
)
from chainshaper.workload import dds
from chainshaper.workload.event_log import (
    ABSENT,
    LAYOUT,
    EventLog,
    number_of,
    receive,
    send,
    send_events,
    wait_for_leave,
)
from chainshaper.workload.execution import ExecutionTimes
from chainshaper.workload.executor import (
    AsynchronousWriter,
    Executor,
    PublisherThread,
    SubscriptionEntity,
    Synchroniser,
    Timer,
    Work,
    computing,
    load_function,
    noting_sends,
    spending,
)

__all__ = ["NodeProcess", "main"]

GATE_FIELDS = ("cycle_ns", "anchor", "overrun", "due_cycles", "messages", "depth")
FIRST_HANDLE = 0x55D0_0000_0100
"""Handles are like real addresses: unique in this process and reused by the others."""


@dataclass(frozen=True)
class TracedPublisher:
    """A publisher with its trace points, which are recorded apart from sending."""

    write: Callable[[bytes, int], None]
    template: bytearray
    handle: int
    rmw_handle: int
    point: dict[str, Callable[..., None]]

    def send(self, payload: bytes) -> tuple[int, int]:
        """Publish; the time of publication (ns) and the source timestamp.

        As the rmw layers do: one time stamp, given to the trace point and to DDS. With
        asynchronous publication that is when the message was handed over, not when it was sent.
        """
        source_timestamp, now = time.time_ns(), time.monotonic_ns()
        self.write(payload, source_timestamp)
        return now, source_timestamp

    def record(self, payload: bytes, now: int, source_timestamp: int) -> None:
        """Record what :meth:`send` did."""
        address = id(payload)
        self.point["rclcpp_publish"](now, address)
        self.point["rcl_publish"](now, self.handle, address)
        self.point["rmw_publish"](now, self.rmw_handle, address, source_timestamp)


class NodeProcess:
    """A node built from its description, ready to run."""

    def __init__(self, spec: dict[str, Any]) -> None:
        self.spec = spec
        self.log = EventLog()
        self.new_handle = partial(next, count(FIRST_HANDLE, 0x100))
        self.participant = dds.join_domain(spec["domain"])
        self.executor = Executor(self.participant, self.log)
        self.publishers: dict[str, dds.Publisher] = {}
        self.subscriptions: list[tuple[str, dds.Subscription]] = []
        self.publisher_thread: PublisherThread | None = None
        self.shapers: list[Shaper] = []
        self.first_due: list[tuple[Timer, int]] = []
        self.execution_times: list[ExecutionTimes] = []
        self._point = {name: self.log.point(name) for name, _ in LAYOUT}
        self.node_handle = self.new_handle()
        self.log.init("rcl_init", context_handle=self.new_handle(), version="live workload")
        namespace, _, name = spec["node"].rpartition("/")
        self.log.init(
            "rcl_node_init",
            node_handle=self.node_handle,
            rmw_handle=self.new_handle(),
            node_name=name,
            namespace="/" + namespace.strip("/"),
        )
        kinds = ("subscription", "service", "client")  # as executors look at them
        numbered = list(enumerate(spec["callbacks"]))
        for index, callback in sorted(numbered, key=lambda each: kinds.index(each[1]["kind"])):
            self._add_callback(index, callback)

    # Building -----------------------------------------------------------------------------

    def _add_callback(self, index: int, callback: dict[str, Any]) -> None:
        handle = self.new_handle()
        publishers = [self._publisher(topic) for topic in callback["publishes"]]
        subscription, rmw_handle = None, self.new_handle()
        if callback["subscription"] is not None:
            depth = 0 if callback["gate"] is None else READER_DEPTH
            subscription = self._subscription(callback["subscription"], depth)
        if callback["gate"] is not None and subscription is not None:
            shaper = self._shaper(callback["gate"])
            body = self._shaping_body(
                (handle, rmw_handle), shaper, callback["gate"], publishers[0], subscription
            )
            if callback["gate"]["modes"] is not None:  # before the messages that it concerns
                self._add_modes(callback["gate"]["modes"]["topic"], shaper)
        else:
            work = self._work(index, callback, publishers)
            if callback["synchronises"]:
                self._add_inputs(index, callback["synchronises"], work, publishers)
                return
            body = self._working_body(handle, work, publishers)
        if subscription is None:
            self._add_timer(handle, callback, body)
        else:
            topic = callback["subscription"]
            self._add_subscription(handle, topic, subscription, body, rmw_handle)
        symbol = f"{self.spec['node']}::callback{index}"
        self.log.init("rclcpp_callback_register", callback=handle, symbol=symbol)

    def _work(
        self, index: int, callback: dict[str, Any], publishers: list["TracedPublisher"]
    ) -> Work:
        """What the callback does: call the function that it names, or spend drawn times."""
        if callback["computes"] is not None:
            function = load_function(callback["computes"])
            return computing(callback["computes"], function, len(publishers))
        times = ExecutionTimes(callback["execution"], self.spec["seed"], self.spec["node"], index)
        self.execution_times.append(times)
        announced = [dds.text_message(mode) for mode in callback["announces"]]
        return spending(times, [publisher.template for publisher in publishers], announced)

    def _add_inputs(
        self,
        index: int,
        topics: Sequence[str],
        work: Work,
        publishers: list["TracedPublisher"],
    ) -> None:
        """The subscriptions of a synchronising callback, each with a callback of its own."""
        depths = [self.spec["topics"][topic]["depth"] for topic in topics]
        synchroniser = Synchroniser[dds.Message](depths)
        for number, topic in enumerate(topics):
            handle = self.new_handle()
            complete = partial(synchroniser.add, number)
            body = self._working_body(handle, work, publishers, complete)
            self._add_subscription(handle, topic, self._subscription(topic), body)
            # As in ROS 2, by which the analysis knows the inputs of one synchroniser.
            symbol = f"message_filters::{self.spec['node']}::callback{index}.{number}"
            self.log.init("rclcpp_callback_register", callback=handle, symbol=symbol)

    def _add_timer(
        self, handle: int, callback: dict[str, Any], body: Callable[[dds.Message | None], None]
    ) -> None:
        timer = Timer(self.new_handle(), callback["timer_ns"], lambda: body(None))
        self.executor.timers.append(timer)
        self.first_due.append((timer, callback["phase_ns"]))
        self.log.init("rcl_timer_init", timer_handle=timer.handle, period=timer.period_ns)
        self.log.init("rclcpp_timer_callback_added", timer_handle=timer.handle, callback=handle)
        self.log.init(
            "rclcpp_timer_link_node", timer_handle=timer.handle, node_handle=self.node_handle
        )

    def _add_subscription(
        self,
        handle: int,
        topic: str,
        subscription: dds.Subscription,
        body: Callable[[dds.Message | None], None],
        rmw_handle: int | None = None,
    ) -> None:
        entity = SubscriptionEntity(
            handle=self.new_handle(),
            rmw_handle=rmw_handle or self.new_handle(),
            subscription=subscription,
            callback=body,
        )
        rclcpp_handle = self.new_handle()
        self.executor.add_subscription(entity)
        self.log.init(
            "rcl_subscription_init",
            subscription_handle=entity.handle,
            node_handle=self.node_handle,
            rmw_subscription_handle=entity.rmw_handle,
            topic_name=topic,
            queue_depth=self.spec["topics"][topic]["depth"],
        )
        own = {"subscription_handle": entity.handle, "subscription": rclcpp_handle}
        self.log.init("rclcpp_subscription_init", **own)
        self.log.init(
            "rclcpp_subscription_callback_added", subscription=rclcpp_handle, callback=handle
        )

    def _add_modes(self, topic: str, shaper: Shaper) -> None:
        """Listen to the modes that are announced."""
        handle = self.new_handle()
        start, end = self._point["callback_start"], self._point["callback_end"]

        def body(message: dds.Message | None) -> None:
            assert message is not None  # noqa: S101 - it is a subscription's
            now = time.monotonic_ns()
            start(now, handle, time.thread_time_ns(), 0)
            shaper.switch(text_of(message.payload), now)
            end(time.monotonic_ns(), handle, time.thread_time_ns())

        self._add_subscription(handle, topic, self._subscription(topic), body)

    def _subscription(self, topic: str, depth: int = 0) -> dds.Subscription:
        qos = self.spec["topics"][topic]
        subscription = dds.Subscription(
            self.participant,
            topic,
            qos["reliability"],
            max(depth, qos["depth"]),
            carries_text=topic in self.spec["announced"],
        )
        self.subscriptions.append((topic, subscription))
        return subscription

    def _publisher(self, topic: str) -> "TracedPublisher":
        qos = self.spec["topics"][topic]
        publisher = dds.Publisher(
            self.participant,
            topic,
            qos["reliability"],
            qos["depth"],
            qos["lifespan_ns"],
            carries_text=topic in self.spec["announced"],
        )
        self.publishers[topic] = publisher
        handle, rmw_handle = self.new_handle(), self.new_handle()
        self.log.init(
            "rcl_publisher_init",
            publisher_handle=handle,
            node_handle=self.node_handle,
            rmw_publisher_handle=rmw_handle,
            topic_name=topic,
            queue_depth=qos["depth"],
            asynchronous=int(qos["publication"] == "asynchronous"),
        )
        return TracedPublisher(
            write=(
                self._asynchronously(publisher.write, qos, rmw_handle)
                if qos["publication"] == "asynchronous"
                else publisher.write
            ),
            template=dds.message_template(qos["payload"]),
            handle=handle,
            rmw_handle=rmw_handle,
            point=self._point,
        )

    def _asynchronously(
        self, write: Callable[[bytes, int], None], qos: dict[str, Any], rmw_handle: int
    ) -> Callable[[bytes, int], None]:
        """Let the process's publisher thread do the writing."""
        if self.publisher_thread is None:
            self.publisher_thread = PublisherThread()
        note = noting_sends(self._point["asynchronous_send"], rmw_handle)
        writer = AsynchronousWriter(write, qos["depth"], qos["lifespan_ns"], note)
        return partial(self.publisher_thread.publish, writer)

    def _working_body(
        self,
        handle: int,
        work: Work,
        publishers: list["TracedPublisher"],
        complete: Callable[[dds.Message], tuple[dds.Message, ...]] | None = None,
    ) -> Callable[[dds.Message | None], None]:
        """An ordinary callback: work, then publish.

        With ``complete`` nothing is done until a message completes a set, for which it is then.
        """
        start, end = self._point["callback_start"], self._point["callback_end"]

        def body(message: dds.Message | None) -> None:
            now, wall, used = time.monotonic_ns(), time.time_ns(), time.thread_time_ns()
            start(now, handle, used, 0)
            messages: tuple[dds.Message, ...] = () if message is None else (message,)
            if complete is not None and message is not None:
                messages = complete(message)
            if messages or complete is None:
                for payload, publisher in zip(work(messages, wall, used), publishers, strict=False):
                    publisher.record(payload, *publisher.send(payload))
            end(time.monotonic_ns(), handle, time.thread_time_ns())

        return body

    def _shaper(self, gate: dict[str, Any]) -> Shaper:
        modes, core = gate["modes"], self.spec["delivery_core"]
        delivery_core = None if core is None else ClearCore(core)

        def get_ready(release_ns: int) -> None:
            if delivery_core is not None:
                delivery_core.clear_until(release_ns + gate["pause_ns"])

        shaper = Shaper(
            Gate(
                slots=tuple((begin, finish) for begin, finish in gate["slots"]),
                modes=modes and Modes(modes["bands"], modes["default"], modes["late"]),
                **{name: gate[name] for name in GATE_FIELDS},
            ),
            gate["spin_ns"],
            get_ready,
        )
        self.shapers.append(shaper)
        return shaper

    def _shaping_body(
        self,
        handles: tuple[int, int],
        shaper: Shaper,
        gate: dict[str, Any],
        publisher: "TracedPublisher",
        subscription: dds.Subscription,
    ) -> Callable[[dds.Message | None], None]:
        """The latency-shaping callback (paper, section 3.2.2): hold, then republish unchanged.

        Between waking and writing nothing is computed, and after writing the thread pauses, so
        that threads it outranks can deliver; only then are its events recorded. It does not
        pause when another message has to leave meanwhile.

        What comes while one waits for its release waits behind it. The executor has it worked off
        before it takes the next: a message is recorded as taken when it is its turn.

        Delay that no other thread caused is recorded like the stall meter's own findings. A
        message that is dropped is recorded, and not published.
        """
        start, end = self._point["callback_start"], self._point["callback_end"]
        stalled, (handle, rmw_handle) = self._point["machine_stall"], handles
        pause_ns = gate["pause_ns"]
        note = partial(self._note_release, handle, gate)
        waiting, overflowed = shaper.queue.waiting, shaper.overflowed

        def look() -> None:
            while subscription.ready():
                if (message := subscription.take()) is not None:
                    now = time.monotonic_ns()
                    shaper.arrive(message.payload, now, message.source_timestamp, message)

        def let_one_pass() -> None:
            start(time.monotonic_ns(), handle, time.thread_time_ns(), 0)
            if (held := shaper.hold()) is not None:
                if held.release.at_ns is not None:
                    payload = held.message.payload
                    published, source_timestamp = publisher.send(payload)
                    lost = shaper.time_lost(held.release, published)
                    shaper.rest(published, pause_ns)
                    publisher.record(payload, published, source_timestamp)
                    if lost >= STALL_NS:
                        stalled(held.release.at_ns, lost)
                note(held)
            end(time.monotonic_ns(), handle, time.thread_time_ns())
            for gone in overflowed:
                self.executor.record_take(rmw_handle, gone.message.about)
                start(time.monotonic_ns(), handle, time.thread_time_ns(), 0)
                note(gone)
                end(time.monotonic_ns(), handle, time.thread_time_ns())
            overflowed.clear()

        def body(message: dds.Message | None) -> None:
            assert message is not None  # noqa: S101 - a gate has a subscription, by validation
            alone = not waiting
            shaper.arrive(message.payload, time.monotonic_ns(), about=message)
            if alone:
                let_one_pass()

        def work_off() -> bool:
            served = False
            while waiting and not (served and shaper.nothing_due()):
                self.executor.record_take(rmw_handle, waiting[0].about)
                let_one_pass()
                served = True
            return bool(waiting)

        shaper.look = look
        self.executor.backlogs.append(work_off)
        return body

    def _note_release(self, handle: int, gate: dict[str, Any], held: Outcome) -> None:
        """Record what became of a message at a gate."""
        modes = [] if gate["modes"] is None else list(gate["modes"]["bands"])
        release = held.release
        self._point["gate_release"](
            held.awake_ns,
            handle,
            held.message.about.source_timestamp,
            held.message.arrival_ns,
            release.origin_ns,
            ABSENT if release.at_ns is None else release.at_ns,
            ABSENT if release.slot is None else release.slot,
            release.cycles_waited,
            number_of("anchor", release.anchor),
            number_of("overrun", release.overrun),
            ABSENT if release.mode is None else modes.index(release.mode),
            number_of("dropped", held.dropped),
        )

    # Running ------------------------------------------------------------------------------

    def wait_for_counterparts(self, deadline_ns: int) -> list[str]:
        """Wait until DDS discovery is complete; what is still missing at the deadline."""
        expected = self.spec["expected"]
        while True:
            missing = [
                f"publisher of {topic} found {publisher.matched()} of {expected[topic][1]} readers"
                for topic, publisher in self.publishers.items()
                if publisher.matched() < expected[topic][1]
            ]
            missing += [
                f"subscription to {topic} found {subscription.matched()} of "
                f"{expected[topic][0]} writers"
                for topic, subscription in self.subscriptions
                if subscription.matched() < expected[topic][0]
            ]
            if not missing or time.monotonic_ns() > deadline_ns:
                return missing
            time.sleep(0.01)

    def run(self, start_ns: int, last_timer_ns: int, stop_ns: int) -> None:
        """Execute callbacks from the common start until the end."""
        for timer, phase in self.first_due:
            timer.due_ns = start_ns + phase
        periods = [timer.period_ns for timer in self.executor.timers] or [100_000_000]
        for times in self.execution_times:
            times.refill(min(1 + (stop_ns - start_ns) // min(periods), 100_000))
        for shaper in self.shapers:
            shaper.queue.phase_ns = start_ns + self.spec["origin_phase"]
        stop_garbage_collection()
        self.executor.spin_until(stop_ns, last_timer_ns)


def main() -> None:
    """Run one node as the launcher says."""
    spec = receive()
    signalled_with_parent(spec["parent"], signal.SIGKILL)
    set_thread_name(spec["node"].strip("/").replace("/", "."))
    node = NodeProcess(spec)
    missing = node.wait_for_counterparts(time.monotonic_ns() + spec["discovery_ns"])
    send(missing=missing, memory_locked=lock_memory())
    times = receive()
    node.run(times["start_ns"], times["last_timer_ns"], times["stop_ns"])
    send_events(node.log.rows.tobytes(), objects=node.log.objects)
    wait_for_leave()
    os._exit(0)  # DDS teardown of a closed domain is of no use, and not always quick


if __name__ == "__main__":
    main()
