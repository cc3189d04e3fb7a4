"""A node of the live workload, in a process of its own: ``python -m …node_process``.

It talks with :mod:`chainshaper.workload.live` as :mod:`chainshaper.workload.launcher` says. All its
pages are locked into memory, so it imports nothing that it does not need.
"""

import ctypes
import os
import queue
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from chainshaper.linux import scheduling
from chainshaper.robot.handover import Turn
from chainshaper.robot.serialized import text_of
from chainshaper.robot.shaper import READER_DEPTH, Shaper
from chainshaper.workload import dds, executor, launcher
from chainshaper.workload.description import CallbackDescription, ExecutionTime, GateDescription
from chainshaper.workload.event_log import EventLog, number_of
from chainshaper.workload.execution import FIRST_AFTER, ExecutionTimes, spend
from chainshaper.workload.gate_callback import GateCallback, GateHandles, shaper_of
from chainshaper.workload.loop import Loop
from chainshaper.workload.node_setup import NodeSetup
from chainshaper.workload.traced import TracedPublisher, traced_callback

if TYPE_CHECKING:
    from chainshaper.workload.live_plant import LiveLoop, LivePlant

NEVER_S = 1e6
KINDS = ("subscription", "service", "client")  # in the order in which executors look at them
Body: TypeAlias = Callable[[dds.Message], None]
Completes: TypeAlias = Callable[[dds.Message], tuple[dds.Message, ...]]
"""Gives a message to a synchroniser; returns the set that it completes, or nothing."""


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscription that waits for its counterparts."""

    name: str  # in messages
    entity: dds.Publisher | dds.Subscription
    expected: int  # how many counterparts it shall have
    counterparts: str  # what these are called in messages


class NodeProcess:
    """A node built from its description, ready to run."""

    def __init__(self, setup: NodeSetup) -> None:
        self.setup = setup
        self.log = EventLog()
        self.participant = dds.Participant(setup.domain)
        sys.setswitchinterval(NEVER_S)  # the kernel alone decides which thread of an executor runs
        self.executor = executor.NodeExecutor(self.participant, self.log, setup.node.threads)
        self.endpoints: list[Endpoint] = []
        self.to_send: queue.SimpleQueue[executor.AsynchronousWriter] | None = None
        self.shapers: list[tuple[Shaper, GateDescription]] = []
        self.execution_times: list[ExecutionTimes] = []
        self.loop: Loop | None = None
        self._plant: LivePlant | None = None
        self._several = setup.node.threads > 1 or setup.node.loop is not None
        self.log.node(setup.name, "live workload")
        numbered = enumerate(setup.node.callbacks)
        for index, callback in sorted(numbered, key=lambda pair: KINDS.index(pair[1].kind)):
            self._add_callback(index, callback)

    # Building -----------------------------------------------------------------------------

    def _add_callback(self, index: int, callback: CallbackDescription) -> None:
        symbol = f"{self.setup.name}::callback{index}"
        if callback.gate is not None and callback.subscription is not None:
            self._add_gate(symbol, callback.subscription, callback.gate, callback.publishes[0])
            return
        group = self.setup.node.exclusive_group(callback)
        publishers = [self._publisher(topic) for topic in callback.publishes]
        work = self._work(index, callback, publishers)
        rest = self._rest(index, callback.afterwards)
        if callback.loop_ns is not None:
            body = _body(work, publishers, rest)
            topics = callback.reads
            _tell_library(self.setup.name)
            self.loop = Loop(callback.loop_ns, callback.phase_ns, len(topics), body, self.log)
            self.log.loop(self.setup.name)
            for number, topic in enumerate(topics):
                handle = self.log.callback(symbol)
                store = traced_callback(self.log, handle, partial(self.loop.store, number))
                self._subscribe(handle, topic, store, group)
            return
        if callback.synchronises:
            self._add_synchroniser(symbol, callback, partial(_body, work, publishers, rest))
            return
        handle = self.log.callback(symbol)
        body = traced_callback(self.log, handle, _body(work, publishers, rest))
        if callback.subscription is not None:
            self._subscribe(handle, callback.subscription, body, group)
        elif callback.timer_ns is not None:
            period_ns = callback.timer_ns
            self.executor.timers.append(
                executor.Timer(
                    handle=self.log.timer(handle, period_ns),
                    period_ns=period_ns,
                    callback=body,
                    due_ns=callback.phase_ns,  # behind the common start
                    group=group,
                )
            )

    def _add_synchroniser(
        self,
        symbol: str,
        callback: CallbackDescription,
        body_of: Callable[[Completes], Callable[..., None]],
    ) -> None:
        """Add a callback for each input; the one whose message completes a set does the work."""
        topics, trigger = callback.synchronises, callback.triggered_by
        synchroniser = executor.Synchroniser[dds.Message](
            depths=[self.setup.topics[topic].depth for topic in topics],
            trigger=None if trigger is None else topics.index(trigger),
        )
        for number, topic in enumerate(topics):
            # Named as in ROS 2: by that the analysis knows the inputs of a synchroniser.
            handle = self.log.callback(f"message_filters::{symbol}.{number}")
            body = traced_callback(self.log, handle, body_of(partial(synchroniser.add, number)))
            self._subscribe(handle, topic, body, self.setup.node.exclusive_group(callback))

    def _work(
        self, index: int, callback: CallbackDescription, publishers: Sequence[TracedPublisher]
    ) -> executor.Work:
        """Return what a callback does before it publishes: call a function, or spend time."""
        if callback.computes is not None:
            function = executor.load_function(callback.computes)
            return executor.computing(callback.computes, function, len(publishers))
        return executor.spending(
            self._times(callback.execution, index),
            templates=[publisher.template for publisher in publishers],
            announced=[dds.text_message(mode) for mode in callback.announces],
            numbers_of=self._numbers_of(callback),
            beside_others=self._several,
        )

    def _numbers_of(self, callback: CallbackDescription) -> executor.NumbersOf | None:
        """Return what gives the control loop's numbers that a callback publishes; None: nothing."""
        carried, inputs = self.setup.carried, callback.inputs or callback.reads
        if callback.control is not None:
            return self._part_in_loop(callback.control)
        if not carried or not inputs or inputs[0] in self.setup.announced:
            return None
        return lambda messages: (
            bytes(dds.data_of(messages[0].payload)[:carried]) if messages else b""
        )

    def _part_in_loop(self, part: str) -> executor.NumbersOf:
        """Return what a callback does in the control loop."""
        if part == "computes":
            compute = self._control_loop().controller().compute
            return lambda messages: compute(dds.data_of(messages[0].payload))
        plant = self._plant = self._plant or self._control_loop().plant(self.log)
        if part == "samples":
            return lambda _: plant.sample()

        def drive(messages: Sequence[dds.Message]) -> bytes:
            plant.drive(dds.data_of(messages[0].payload))
            return b""

        return drive

    def _control_loop(self) -> "LiveLoop":
        """Return the control loop: who has no part in it does not load what it needs."""
        from chainshaper.workload.live_plant import LiveLoop

        written = self.setup.control_loop
        assert written is not None  # noqa: S101 - a node whose callbacks have a part in it gets it
        return LiveLoop.described(written, self.setup.loop_period_ns, self.setup.seed)

    def _rest(self, index: int, afterwards: ExecutionTime | None) -> Callable[[], None]:
        """Return what a callback does after it has published: spend drawn times, or nothing."""
        if afterwards is None:
            return lambda: None
        times = self._times(afterwards, FIRST_AFTER + index)
        several = self._several
        return lambda: spend(times.next(), time.thread_time_ns(), beside_others=several)

    def _times(self, described: ExecutionTime, index: int) -> ExecutionTimes:
        times = ExecutionTimes(described, self.setup.seed, self.setup.name, index)
        self.execution_times.append(times)
        return times

    def _subscribe(self, handle: int, topic: str, body: Body, group: str | None = None) -> None:
        """Have the executor run a callback, by its handle, for each message of a topic."""
        subscription = self._subscription(topic)
        depth = self.setup.topics[topic].depth
        subscription_handle, rmw_handle = self.log.subscription(handle, topic, depth)
        self.executor.add_subscription(
            executor.SubscriptionEntity(subscription_handle, rmw_handle, subscription, body, group)
        )

    def _subscription(self, topic: str, least_depth: int = 0) -> dds.Subscription:
        described = self.setup.topics[topic]
        subscription = dds.Subscription(
            self.participant,
            topic,
            described.reliability,
            max(least_depth, described.depth),
            carries_text=topic in self.setup.announced,
        )
        expected = self.setup.counterparts[topic].publishers
        self.endpoints.append(
            Endpoint(f"subscription to {topic}", subscription, expected, "writers")
        )
        return subscription

    def _publisher(self, topic: str) -> TracedPublisher:
        described = self.setup.topics[topic]
        publisher = dds.Publisher(
            self.participant,
            topic,
            described.reliability,
            described.depth,
            described.lifespan_ns,
            carries_text=topic in self.setup.announced,
        )
        expected = self.setup.counterparts[topic].subscriptions
        self.endpoints.append(Endpoint(f"publisher of {topic}", publisher, expected, "readers"))
        asynchronous, write = described.publication == "asynchronous", publisher.write
        handle, rmw_handle = self.log.publisher(topic, described.depth, asynchronous)
        if asynchronous:  # the process's publisher thread does the writing
            self.to_send = self.to_send or executor.start_publisher_thread()
            write = executor.AsynchronousWriter(
                write,
                described.depth,
                described.lifespan_ns,
                note=self._note_sends(rmw_handle),
                to_send=self.to_send,
            ).publish
        template, point = bytes(described.payload), self.log.point("publish")
        return TracedPublisher(write, template, handle, rmw_handle, point)

    def _note_sends(self, rmw_handle: int) -> executor.Note:
        """Return a function that records what became of a publisher's messages, in any thread."""
        point = self.log.point("asynchronous_send")

        def note(at_ns: int, source_timestamp: int, outcome: str, lasted_ns: int) -> None:
            number = number_of("outcome", outcome)
            point(at_ns, rmw_handle, source_timestamp, number, lasted_ns)

        return note

    # Gates --------------------------------------------------------------------------------

    def _add_gate(self, symbol: str, topic: str, gate: GateDescription, output: str) -> None:
        """Add the latency-shaping callback between two topics."""
        publisher, turn = self._publisher(output), _turn(output)
        shaper = shaper_of(gate, self.setup.origin_phase_ns, self.setup.delivery_core, turn)
        self.shapers.append((shaper, gate))
        subscription = self._subscription(topic, READER_DEPTH)
        if gate.modes is not None:  # first, so that a mode holds for messages that come with it
            self._follow_modes(gate.modes.topic, shaper)
        handle, depth = self.log.callback(symbol), self.setup.topics[topic].depth
        subscription_handle, rmw_handle = self.log.subscription(handle, topic, depth)
        callback = GateCallback(
            gate,
            shaper=shaper,
            subscription=subscription,
            publisher=publisher,
            turn=turn,
            log=self.log,
            handles=GateHandles(handle, rmw_handle),
            record_take=self.executor.record_take,
        )
        self.executor.backlogs.append(callback.work_off)
        self.executor.add_subscription(
            executor.SubscriptionEntity(
                subscription_handle, rmw_handle, subscription, callback.body
            )
        )

    def _follow_modes(self, topic: str, shaper: Shaper) -> None:
        """Have a gate switch to the modes that are announced on a topic."""

        def switch(message: dds.Message) -> None:
            shaper.queue.switch(text_of(message.payload), time.monotonic_ns())

        handle = self.log.new_handle()
        self._subscribe(handle, topic, traced_callback(self.log, handle, switch))

    # Running ------------------------------------------------------------------------------

    def wait_for_counterparts(self, deadline_ns: int) -> list[str]:
        """Wait until DDS discovery is complete; return what is missing at the deadline."""
        while True:
            missing = [
                f"{end.name} found {end.entity.matched()} of {end.expected} {end.counterparts}"
                for end in self.endpoints
                if end.entity.matched() < end.expected
            ]
            if not missing or time.monotonic_ns() > deadline_ns:
                return missing
            time.sleep(0.01)

    def run(self, start_ns: int, last_timer_ns: int, stop_ns: int) -> None:
        """Execute callbacks from the common start until the end."""
        for timer in self.executor.timers:
            timer.due_ns += start_ns
        periods = [timer.period_ns for timer in self.executor.timers]
        periods += [] if self.loop is None else [self.loop.period_ns]
        periods = periods or [100_000_000]
        for times in self.execution_times:
            times.refill(min(1 + (stop_ns - start_ns) // min(periods), 100_000))
        for shaper, gate in self.shapers:
            shaper.queue.set_phase(start_ns + shaper.gate.phase_ns, 0)
            for from_ns, by_ns in gate.moved(start_ns):
                shaper.queue.move_slots(by_ns, from_ns)
        scheduling.stop_garbage_collection()
        if self.loop is not None:
            last_ns = last_timer_ns if self.setup.starts_chain else stop_ns
            self.loop.begin(start_ns, last_timer_ns, last_ns)
        self.executor.spin_until(stop_ns, last_timer_ns)
        if self.loop is not None:
            self.loop.over = True
            self.loop.wait_for_end()


def _body(
    work: executor.Work,
    publishers: Sequence[TracedPublisher],
    rest: Callable[[], None],
    complete: Completes | None = None,
) -> Callable[..., None]:
    """Return an ordinary callback, which works, publishes, and does the rest.

    With ``complete`` it does so only if its message completes a set, and for the whole set.
    """

    def body(message: dds.Message | None = None) -> None:
        wall_ns, cpu_ns = time.time_ns(), time.thread_time_ns()
        messages: tuple[dds.Message, ...] = () if message is None else (message,)
        if complete is not None and message is not None:
            messages = complete(message)
        if messages or complete is None:
            payloads = work(messages, wall_ns, cpu_ns)
            for payload, publisher in zip(payloads, publishers, strict=False):
                publisher.record(payload, *publisher.send(payload))
            rest()

    return body


def _tell_library(node: str) -> None:
    """Tell the tracing library of the node, if it is in front, so that the loop can be moved.

    It is what rcl does in nodes of ROS 2: `ros_trace_rcl_node_init`.
    """
    with suppress(AttributeError):  # the library is not there
        space, _, name = node.rpartition("/")
        handles = ctypes.c_void_p(1), ctypes.c_void_p(1)
        texts = ctypes.c_char_p(name.encode()), ctypes.c_char_p((space or "/").encode())
        ctypes.CDLL(None).ros_trace_rcl_node_init(*handles, *texts, ctypes.c_void_p(0))


def _turn(output: str) -> Turn | None:
    """Make the page by which others find the gate of an output; None: another run has it.

    It is as that of a shaping node, but without a standby. None, too, where there can be no page.
    """
    with suppress(OSError):
        turn = Turn(f"live{output.replace('/', '.')}", output)
        if turn.take(None):
            return turn
    return None


def main() -> None:
    """Run one node as the launcher says."""
    output = launcher.own_output()  # what callbacks compute may print
    setup = launcher.receive_model(NodeSetup)
    scheduling.signalled_with_parent(setup.parent, signal.SIGKILL)
    scheduling.set_thread_name(setup.name.strip("/").replace("/", "."))
    node = NodeProcess(setup)
    signal.signal(launcher.ENOUGH, lambda *_: setattr(node.executor, "over", True))
    missing = node.wait_for_counterparts(time.monotonic_ns() + setup.discovery_ns)
    launcher.send(output, missing=missing, memory_locked=scheduling.lock_memory())
    times = launcher.receive()
    node.run(times["start_ns"], times["last_timer_ns"], times["stop_ns"])
    launcher.send_events(output, node.log.rows, objects=node.log.objects)
    launcher.wait_for_leave()
    os._exit(0)  # DDS teardown of a closed domain is of no use, and not always quick


if __name__ == "__main__":
    main()
