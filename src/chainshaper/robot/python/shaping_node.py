"""The latency-shaping node, for messages of any type (paper, section 3.2.2).

It republishes on ``output`` what it receives on ``input``, byte for byte, in the slots of its
server. Its one thread receives, holds and publishes a message, rests so that the message is
delivered although this thread out-ranks others, and only then writes its log. Messages that come
meanwhile wait at the gate; a callback is executed for each when it is the oldest.
"""

import gc
import os
import socket
import sys
import time
from contextlib import suppress
from dataclasses import replace
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_msgs.msg import Empty, String

from chainshaper.robot.clear_core import ClearCore
from chainshaper.robot.clocks import clock_offset
from chainshaper.robot.handover import STANDING_BY, Turn
from chainshaper.robot.python.node import (
    HUMBLE,
    GateLog,
    create_subscription,
    delivery_core,
    message_class,
    parameters_of,
    publish_function,
    room_of,
    run,
    take_event,
    wait,
    wait_for_publisher,
)
from chainshaper.robot.shaper import Shaper
from chainshaper.robot.waiting import Outcome

DISCOVERY_S = 2.0
# With Fast DDS a receiver's process may wait for a third of a second as it opens the shared memory
# of each of this node's two ports (upstream: `SharedMemGlobal.hpp`, `healthy_check`).
SETTLING_S = 0.8
REHEARSAL_TOPIC = "/_chainshaper_rehearsal"  # of all shaping nodes; the underscore hides it
EMPTY = bytes((0, 1, 0, 0, 0))  # a serialized std_msgs/Empty
REHEARSAL_NS = 400_000  # no rehearsal begins later before a release: the first may take as long


class Readiness:
    """Makes a publication take the same time in every cycle: rehearsed, on cores that are awake.

    The chain has run since the last publication, so its code and data have left the processor's
    caches. Shortly before each release a message without receivers goes the way of the real one
    through ROS 2 and DDS, and a datagram to this process goes that through the network stack.

    While `/dev/cpu_dma_latency` is open, cores wake up within the microseconds written there
    (Documentation/power/pm_qos_interface.rst).
    """

    AWAKE, AS_USUAL = (value.to_bytes(4, sys.byteorder, signed=True) for value in (0, -1))

    def __init__(self, node: Node, delivery_core: int | None, pause_ns: int) -> None:
        """Prepare for outputs that are delivered on a core, for ``pause_ns`` behind publication."""
        self._delivery_core = None if delivery_core is None else ClearCore(delivery_core)
        self._pause_ns = pause_ns
        self._rehearsal = node.create_publisher(Empty, REHEARSAL_TOPIC, 1)
        self._to_itself = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to_itself.setblocking(False)
        with suppress(OSError):
            self._to_itself.bind(("127.0.0.1", 0))
            self._to_itself.connect(self._to_itself.getsockname())
        try:
            self._latency = os.open("/dev/cpu_dma_latency", os.O_WRONLY | os.O_CLOEXEC)
        except OSError as error:
            self._latency = -1
            node.get_logger().warning(
                f"/dev/cpu_dma_latency: {error.strerror}: idle cores sleep, and deliver less "
                "regularly; run as root, or give the user the right to write it"
            )

    def get_ready(self, release_ns: int) -> None:
        """Prepare a release at that time (ns of CLOCK_MONOTONIC), as far as time is left."""
        self.ask_for(self.AWAKE)
        if self._delivery_core is not None:
            self._delivery_core.clear_until(release_ns + self._pause_ns)
        for _ in range(2):  # the first loads caches
            if time.monotonic_ns() > release_ns - REHEARSAL_NS:
                return
            self._rehearsal.publish(EMPTY)
            with suppress(OSError):
                self._to_itself.send(EMPTY)
                self._to_itself.recv(len(EMPTY))

    def ask_for(self, latency: bytes = AS_USUAL) -> None:
        """Ask the kernel for cores that wake up fast; by default they may sleep as they like."""
        if self._latency >= 0:
            os.write(self._latency, latency)


def listen_to_modes(node: Node, shaper: Shaper, topic: str) -> None:
    """Subscribe to the topic of modes, with the durability of its publishers.

    To be called when discovery knows these.
    """
    qos, logger = QoSProfile(depth=10), node.get_logger()
    for info in node.get_publishers_info_by_topic(topic):
        if info.qos_profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL:
            qos.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL

    def announced(message: Any) -> None:
        if shaper.queue.switch(message.data, time.monotonic_ns()):
            logger.info(f"mode {message.data}")
        else:
            logger.warning(f"there is no mode {message.data!r}")

    create_subscription(node, String, topic, announced, qos)


def turn_of(node: Node, name: str) -> Turn | None:
    """Return what the node agrees with its standby on the page of this name; None: it has none.

    To be called before anything that may fail: a node whose predecessors have failed at once
    several times waits here.
    """
    if not name:
        return None
    logger = node.get_logger()
    try:
        turn = Turn(name, node.resolve_topic_name("output"))
    except OSError as error:  # the standby has no page either
        logger.error(f"nothing can be agreed with the standby, which does nothing: {error}")
        return None
    if turn.wait_s:
        failed = turn.page["failed_starts"] - 1
        logger.warning(f"has failed {failed} times: starting in {turn.wait_s:g} s")
        wait(turn.wait_s)
    return turn


class Shaping:
    """The gate of a node, with its endpoints and its log."""

    def __init__(self, node: Node) -> None:
        parameters = parameters_of(node)
        self._turn = turn_of(node, parameters.handover)
        self._log = GateLog(node)
        self._pause_ns = parameters.pause_ns
        self._readiness = Readiness(node, delivery_core(parameters.server_cores), self._pause_ns)
        parameters.gate()  # a gate that makes no sense is refused before its input is there
        info = wait_for_publisher(node, "input")
        depth, offered, asked = room_of(node, info)
        self._shaper = Shaper(parameters.gate(depth), parameters.spin_ns)
        self._shaper.on_waking, self._shaper.look = self._readiness.get_ready, self._look
        if self._turn is not None:
            self._turn.go_on(self._shaper)
        self._last_number: int | None = None  # of the last message, which its publisher gave it
        self._its_turn = False  # the callback is executed for the oldest message
        node.add_on_set_parameters_callback(self._parameters_set)
        self._type = message_class(info.topic_type)
        publisher = node.create_publisher(self._type, "output", offered)
        self._publish = publish_function(publisher)
        if parameters.mode_topic:
            listen_to_modes(node, self._shaper, parameters.mode_topic)
        # On Humble the log lacks the source timestamp.
        shape = self._shape_uninformed if HUMBLE else self._shape
        self._input = create_subscription(node, self._type, "input", shape, asked, raw=True)
        self._take = take_event(self._input)
        self._await_receivers(node, publisher)

    def _parameters_set(self, parameters: Any) -> Any:
        """Take over a ``phase_ns`` that is set while the node runs, from the next cycle on."""
        for parameter in parameters:
            if parameter.name == "phase_ns":
                self._shaper.queue.set_phase(parameter.value, time.monotonic_ns())
        return SetParametersResult(successful=True)

    def _await_receivers(self, node: Node, publisher: Any) -> None:
        """Leave the output to the standby, if there is one, until its receivers know this node too.

        This node cannot see whether discovery has ended on their side: it waits a little longer.
        """
        topic, give_up = node.resolve_topic_name("output"), time.monotonic() + DISCOVERY_S
        page = None if self._turn is None else self._turn.page
        while page is not None and page.is_locked(STANDING_BY) and time.monotonic() < give_up:
            if publisher.get_subscription_count() >= node.count_subscribers(topic):
                wait(SETTLING_S)
                return
            wait(0.01)

    def work_off(self) -> bool:
        """Deal with the messages that wait at the gate; return whether some are left.

        The subscription's callback deals with them, until there is time for the node's other
        callbacks.
        """
        waiting, overflowed = self._shaper.queue.waiting, self._shaper.overflowed
        served = False
        while rclpy.ok():
            for outcome in overflowed:
                self._note(outcome)
            overflowed.clear()
            if not waiting or (served and self._shaper.nothing_due()):
                break
            oldest, self._its_turn = waiting[0], True
            # Newer messages were taken since. In a trace a callback is for the last one taken: this
            # message is taken again.
            if HUMBLE:
                arrival = oldest.arrival_ns + clock_offset()  # CLOCK_REALTIME
                self._input.callback(oldest.payload, oldest.about or arrival)
            else:
                self._take(id(self._input), oldest.about or 0)
                self._input.callback(oldest.payload, {})
            self._its_turn, served = False, True
        return bool(waiting)

    def _shape(self, payload: bytes, info: dict[str, int]) -> None:
        if not self._its_turn:  # the executor took the message
            is_alone = not self._shaper.queue.waiting
            self._arrive(payload, info, waited=False)
            if not is_alone:
                return
        key, turn = self._shaper.queue.waiting[0].about, self._turn
        if turn is not None and not turn.take(key):
            self._shaper.queue.leave(None, time.monotonic_ns())
            return
        outcome = self._shaper.hold()
        if outcome is None:
            return
        if turn is not None:
            if turn.was_bypassed(key):
                self._readiness.ask_for()
                return
            outcome = self._in_order(outcome, turn)
        published = stalled = None
        if outcome.release.at_ns is not None:
            try:
                self._publish(outcome.message.payload)
            except RuntimeError:  # rclpy's RCLError is one
                if rclpy.ok():
                    raise
                return  # the node was interrupted; to ask before publishing would cost time
            published = time.monotonic_ns()
        if turn is not None:
            turn.done(key)
        if published is not None:
            stalled = self._shaper.time_lost(outcome.release, outcome.awake_ns)
            self._shaper.rest(published, self._pause_ns)
        self._readiness.ask_for()
        self._note(outcome, published, stalled)
        if not self._shaper.queue.waiting:
            gc.collect()  # there is time for it now; older objects are frozen

    def _in_order(self, outcome: Outcome, turn: Turn) -> Outcome:
        """Drop the message if the standby has published one that waits behind it."""
        if any(turn.is_overtaken_by(newer.about) for newer in self._shaper.queue.waiting):
            return replace(outcome, release=outcome.release.dropping("replaced"))
        return outcome

    def _shape_uninformed(self, payload: bytes) -> None:
        self._shape(payload, {})

    def _note(
        self, outcome: Outcome, published: int | None = None, stalled: int | None = None
    ) -> None:
        """Note what became of a message: in the log, and for the standby and `status`."""
        self._log.write(outcome, published, stalled)
        if self._turn is not None:
            self._turn.count(outcome)

    def _arrive(self, payload: bytes, info: dict[str, int], *, waited: bool) -> None:
        source, number = info.get("source_timestamp"), info.get("publication_sequence_number")
        last, self._last_number, lost = self._last_number, number, None
        if number is not None:  # a publisher that is started again counts anew
            lost = 0 if last is None else max(0, number - last - 1)
        now, overflowed = time.monotonic_ns(), self._shaper.overflowed
        before = len(overflowed)
        self._shaper.arrive(payload, now, source if waited else None, source, lost)
        if self._turn is None or len(overflowed) == before:
            return
        key = overflowed[-1].message.about
        if self._turn.was_bypassed(key):
            overflowed.pop()
        else:
            self._turn.page.add("released", key or 0)

    def _look(self) -> None:
        """Take all messages that have come."""
        handle = self._input.handle
        with handle:
            while (taken := handle.take_message(self._type, True)) is not None:
                self._arrive(*taken, waited=True)


if __name__ == "__main__":
    run("chainshaper_shaping", lambda node: Shaping(node).work_off)
