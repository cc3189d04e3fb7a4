"""The latency-shaping node, for messages of any type (paper, section 3.2.2).

What it receives on ``input`` it republishes on ``output``, byte for byte, in the slots of its
server. It has one thread, which receives, holds, publishes, rests so that the message is delivered
although this thread out-ranks others, and only then notes what it did. What comes meanwhile it
takes, too: it waits at the gate, and a callback is executed for it when it is its turn.
"""

import gc
import os
import time
from dataclasses import replace
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import String

from chainshaper.gate.decision import Gate, Held, Modes, Release, Shaper
from chainshaper.gate.handover import Turn
from chainshaper.splicing.nodes.python.callback_events import create_subscription
from chainshaper.splicing.nodes.python.endpoints import (
    message_class,
    parameter,
    run,
    wait,
    wait_for_publisher,
)
from chainshaper.splicing.nodes.python.gate_log import log_of
from chainshaper.splicing.nodes.python.message_events import publish_function, take_event
from chainshaper.splicing.nodes.python.readiness import Readiness
from chainshaper.splicing.nodes.python.room import room_of

DISCOVERY_S, SETTLING_S = 2.0, 0.1


class Gaps:
    """How many messages are missing before each, by the publisher's numbers (None: not known)."""

    def __init__(self) -> None:
        self._last: int | None = None

    def before(self, info: dict[str, int]) -> int | None:
        """What is missing between a message and the one before it."""
        number = info.get("publication_sequence_number")
        last, self._last = self._last, number
        if number is None or last is None:
            return None if number is None else 0
        return max(0, number - last - 1)  # a publisher that is started again counts anew


def gate_from(node: Node) -> Gate:
    """The gate that a node's parameters describe.

    Raises:
        ValueError: they describe none.
    """
    bounds = parameter(node, "slots_ns", [0])
    modes = None
    if parameter(node, "mode_topic", ""):
        bands = zip(
            parameter(node, "mode_names", [""]), parameter(node, "mode_slots", [0]), strict=True
        )
        default, late = parameter(node, "mode_default", ""), parameter(node, "mode_late", "wait")
        modes = Modes(dict(bands), default, late)
    return Gate(
        slots=tuple(zip(bounds[::2], bounds[1::2], strict=False)),
        cycle_ns=parameter(node, "cycle_ns", 0),
        anchor=parameter(node, "anchor", "stamp"),
        phase_ns=parameter(node, "phase_ns", 0),
        overrun=parameter(node, "overrun", "wait"),
        due_cycles=parameter(node, "due_cycles", 0),
        messages=parameter(node, "messages", "all-in-order"),
        modes=modes,
    )


def listen_to_modes(node: Node, shaper: Shaper) -> None:
    """Subscribe to the topic of the modes, if there is one.

    A mode that was announced before is only delivered when it is asked for, and only if its
    publisher keeps it; so discovery should have had its time.
    """
    topic = parameter(node, "mode_topic", "")
    if not topic:
        return
    qos, logger = QoSProfile(depth=10), node.get_logger()
    for info in node.get_publishers_info_by_topic(topic):
        if info.qos_profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL:
            qos.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL

    def announced(message: Any) -> None:
        if shaper.switch(message.data, time.monotonic_ns()):
            logger.info(f"mode {message.data}")
        else:
            logger.warning(f"there is no mode {message.data!r}")

    create_subscription(node, String, topic, announced, qos)


def change_phase_with(node: Node, shaper: Shaper) -> None:
    """Let the parameter ``phase_ns`` be set while the node runs.

    It is in force from the next cycle on; the log shows it as the origin of what comes then.
    """

    def changed(parameters: Any) -> Any:
        for changed_one in parameters:
            if changed_one.name == "phase_ns":
                shaper.set_phase(changed_one.value, time.monotonic_ns())
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(changed)


def delivery_core(node: Node) -> int | None:
    """Where DDS threads deliver the output: the first core that is ours to use and has no server.

    None where the plan does not name its servers' cores, because it leaves receivers alone.
    """
    taken = parameter(node, "server_cores", [-1])
    return None if -1 in taken else min(os.sched_getaffinity(0) - set(taken), default=None)


def turn_of(node: Node) -> Turn | None:
    """What is agreed with the standby; None: the node is alone, since nothing names a page.

    After several nodes that failed at once this one waits, so that starting over and over does not
    take a core. To be called before anything that may fail.
    """
    name, logger = parameter(node, "handover", ""), node.get_logger()
    if not name:
        return None
    try:
        turn = Turn(name, node.resolve_topic_name("output"))
    except OSError as error:  # the standby has none either
        logger.error(f"nothing can be agreed with the standby, which does nothing: {error}")
        return None
    if turn.wait_s:
        failed = turn.page["failed_starts"] - 1
        logger.warning(f"has failed {failed} times: starting in {turn.wait_s:g} s")
        wait(turn.wait_s)
    return turn


def go_on(shaper: Shaper, turn: Turn) -> None:
    """Have cycles begin where they did for the node before this one, in its mode."""
    gate, mode = shaper.gate, turn.page["mode"]
    if turn.phase_ns is not None:  # from now on, not the next cycle
        shaper.set_phase(turn.phase_ns, time.monotonic_ns() - gate.cycle_ns)
    if gate.modes is not None and 0 < mode <= len(gate.modes.bands):
        shaper.switch(list(gate.modes.bands)[mode - 1], 0)


def await_receivers(node: Node, turn: Turn, publisher: Any) -> None:
    """Leave the output to the standby, if there is one, until its receivers know this node too.

    What is published before is lost to them. How far discovery has come at the other side cannot
    be seen: it is given a little longer.
    """
    topic, give_up = node.resolve_topic_name("output"), time.monotonic() + DISCOVERY_S
    while turn.page.has_standby and time.monotonic() < give_up:
        if publisher.get_subscription_count() >= node.count_subscribers(topic):
            wait(SETTLING_S)
            return
        wait(0.01)


class Shaping:
    """The gate of a node, with its endpoints and its log."""

    def __init__(self, node: Node) -> None:
        self._turn = turn_of(node)
        self._log = log_of(node)
        self._pause_ns = parameter(node, "pause_ns", 0)
        self._readiness = Readiness(node, delivery_core(node), self._pause_ns)
        gate = gate_from(node)
        info = wait_for_publisher(node, "input")
        depth, offered, asked = room_of(node, info)
        self._shaper = Shaper(
            replace(gate, depth=depth),
            parameter(node, "spin_ns", 0),
            self._readiness.get_ready,
            self._look,
            self._decided,
        )
        if self._turn is not None:
            go_on(self._shaper, self._turn)
        self._gaps = Gaps()
        self._its_turn = False  # of the oldest message
        change_phase_with(node, self._shaper)
        self._type = message_class(info.topic_type)
        publisher = node.create_publisher(self._type, "output", offered)
        self._publish = publish_function(publisher)
        listen_to_modes(node, self._shaper)
        # Humble gives a callback the message only: the log lacks its source time stamp.
        self._informed = hasattr(Subscription, "CallbackType")
        shape = self._shape if self._informed else self._shape_uninformed
        self._input = create_subscription(node, self._type, "input", shape, asked, raw=True)
        self._taken_again = take_event(self._input)
        if self._turn is not None:
            await_receivers(node, self._turn, publisher)

    def work_off(self) -> bool:
        """Deal with what waits at the gate, until there is time for the node's other callbacks.

        Each message is the subscription's callback's. Whether some are left.
        """
        waiting, overflowed = self._shaper.queue.waiting, self._shaper.overflowed
        served = False
        while rclpy.ok():
            for gone in overflowed:
                self._note(gone)
            overflowed.clear()
            if not waiting or (served and self._shaper.nothing_due()):
                break
            oldest, self._its_turn = waiting[0], True
            self._taken_again(oldest.about)
            self._input.callback(oldest.payload, *([{}] if self._informed else []))
            self._its_turn, served = False, True
        return bool(waiting)

    def _shape(self, payload: bytes, info: dict[str, int]) -> None:
        if not self._its_turn:  # the executor took it
            alone = not self._shaper.queue.waiting
            self._arrive(payload, info, waited=False)
            if not alone:
                return
        key, turn = self._shaper.queue.waiting[0].about, self._turn
        if turn is not None and not turn.take(key):
            self._shaper.queue.leave(None, time.monotonic_ns())
            return
        held = self._shaper.hold()
        if held is None:
            return
        if turn is not None and turn.was_bypassed(key):
            self._readiness.relax()
            return
        published = stalled = None
        if held.release.at_ns is not None:
            try:
                self._publish(held.message.payload)
            except RuntimeError:  # rclpy's RCLError is one
                if rclpy.ok():
                    raise
                return  # it was interrupted meanwhile; to ask before publishing would cost time
            published = time.monotonic_ns()
            if turn is not None:
                turn.done(key)
            stalled = self._shaper.time_lost(held.release, held.awake_ns)
            self._shaper.rest(published, self._pause_ns)
        elif turn is not None:
            turn.done(key)
        self._readiness.relax()
        self._note(held, published, stalled)
        if not self._shaper.queue.waiting:
            gc.collect()  # here is time for it; all that is older is frozen

    def _note(self, held: Held, published: int | None = None, stalled: int | None = None) -> None:
        """Note what became of a message: in the log, and for the standby and `status`."""
        self._log.write(held, published, stalled)
        if self._turn is not None:
            late = held.release.overrun is not None
            self._turn.count(held.dropped, held.message.lost, late=late)

    def _shape_uninformed(self, payload: bytes) -> None:
        self._shape(payload, {})

    def _arrive(self, payload: bytes, info: dict[str, int], *, waited: bool) -> None:
        source, lost = info.get("source_timestamp"), self._gaps.before(info)
        now = time.monotonic_ns()
        overflowed, before = self._shaper.overflowed, len(self._shaper.overflowed)
        self._shaper.arrive(payload, now, source if waited else None, source, lost)
        if self._turn is None or len(overflowed) == before:
            return
        gone = overflowed[-1].message.about
        if self._turn.was_bypassed(gone):
            overflowed.pop()
        else:
            self._turn.drop(gone)

    def _decided(self, release: Release, phase_ns: int) -> None:
        """The standby sees it."""
        if self._turn is not None:
            names = [] if self._shaper.gate.modes is None else list(self._shaper.gate.modes.bands)
            mode = 0 if release.mode is None else names.index(release.mode) + 1
            self._turn.hold(release.at_ns, phase_ns, mode)

    def _look(self) -> None:
        """Take all that has come."""
        handle = self._input.handle
        with handle:
            while (taken := handle.take_message(self._type, True)) is not None:
                self._arrive(*taken, waited=True)


if __name__ == "__main__":
    run("chainshaper_shaping", lambda node: Shaping(node).work_off)
