"""One node of the live workload, in a process of its own: ``python -m …node_process``.

It talks with :mod:`chainshaper.workload.live` as :mod:`chainshaper.workload.launcher` says. It
imports little on purpose: every page of it is locked into memory.
"""

import os
import queue
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from chainshaper.linux import scheduling
from chainshaper.robot.clear_core import ClearCore
from chainshaper.robot.gate import VALUES, Gate, Modes
from chainshaper.robot.handover import Turn
from chainshaper.robot.serialized import text_of
from chainshaper.robot.shaper import READER_DEPTH, STALL_NS, Shaper
from chainshaper.robot.waiting import Outcome
from chainshaper.workload import dds, executor, launcher
from chainshaper.workload.event_log import ABSENT, LAYOUT, EventLog, number_of
from chainshaper.workload.execution import FIRST_AFTER, ExecutionTimes, spend

NEVER_S = 1e6
Body: TypeAlias = Callable[[dds.Message], None]


@dataclass(frozen=True)
class TracedPublisher:
    """A publisher with its trace point, which is recorded apart from sending."""

    write: Callable[[bytes, int], None]
    template: bytes
    handle: int
    rmw_handle: int
    point: Callable[..., None]

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
        self.point(now, self.handle, self.rmw_handle, id(payload), source_timestamp)


class NodeProcess:
    """A node built from its description, ready to run."""

    def __init__(self, spec: dict[str, Any]) -> None:
        self.spec = spec
        self.log = EventLog()
        self.participant = dds.Participant(spec["domain"])
        sys.setswitchinterval(NEVER_S)  # the kernel alone decides which thread of an executor runs
        self.executor = executor.Executor(self.participant, self.log, spec["threads"])
        # What waits for its counterparts: its name, itself, how many of what it is to find.
        self.ends: list[tuple[str, dds.Publisher | dds.Subscription, int, str]] = []
        self.to_send: queue.SimpleQueue[executor.AsynchronousWriter] | None = None
        self.shapers: list[tuple[Shaper, list[tuple[int, int]]]] = []  # with their moves
        self.execution_times: list[ExecutionTimes] = []
        self._point = {name: self.log.point(name) for name in LAYOUT}
        self.log.node(spec["node"], "live workload")
        kinds = ("subscription", "service", "client")  # as executors look at them
        numbered = list(enumerate(spec["callbacks"]))
        for index, callback in sorted(numbered, key=lambda each: kinds.index(each[1]["kind"])):
            self._add_callback(index, callback)

    # Building -----------------------------------------------------------------------------

    def _add_callback(self, index: int, callback: dict[str, Any]) -> None:
        symbol, topic = f"{self.spec['node']}::callback{index}", callback["subscription"]
        if callback["gate"] is not None:
            self._add_gate(symbol, topic, callback["gate"], callback["publishes"][0])
            return
        publishers = [self._publisher(topic) for topic in callback["publishes"]]
        work = self._work(index, callback, publishers)
        rest = self._rest(index, callback)
        if callback["synchronises"]:
            topics = callback["synchronises"]
            depths = [self.spec["topics"][topic]["depth"] for topic in topics]
            trigger = callback["triggered_by"]
            place = None if trigger is None else topics.index(trigger)
            synchroniser = executor.Synchroniser[dds.Message](depths, place)
            for number, topic in enumerate(topics):
                # As in ROS 2, by which the analysis knows the inputs of one synchroniser.
                handle = self.log.callback(f"message_filters::{symbol}.{number}")
                complete = partial(synchroniser.add, number)
                body = self._working_body(handle, work, publishers, rest, complete)
                self._subscribe(handle, topic, body, callback["group"])
            return
        handle = self.log.callback(symbol)
        body = self._working_body(handle, work, publishers, rest)
        if topic is not None:
            self._subscribe(handle, topic, body, callback["group"])
            return
        period, due = callback["timer_ns"], callback["phase_ns"]  # behind the common start
        own = (self.log.timer(handle, period), period, body, due, callback["group"])
        self.executor.timers.append(executor.Timer(*own))

    def _work(
        self, index: int, callback: dict[str, Any], publishers: Sequence[TracedPublisher]
    ) -> executor.Work:
        """What the callback does: call the function that it names, or spend drawn times."""
        if callback["computes"] is not None:
            function = executor.load_function(callback["computes"])
            return executor.computing(callback["computes"], function, len(publishers))
        times = ExecutionTimes(callback["execution"], self.spec["seed"], self.spec["node"], index)
        self.execution_times.append(times)
        announced = [dds.text_message(mode) for mode in callback["announces"]]
        templates, several = [one.template for one in publishers], self.spec["threads"] > 1
        return executor.spending(times, templates, announced, beside_others=several)

    def _rest(self, index: int, callback: dict[str, Any]) -> Callable[[], None]:
        """What the callback does when it has published: spend drawn times, if it has any."""
        if callback["afterwards"] is None:
            return lambda: None
        own = (self.spec["seed"], self.spec["node"], FIRST_AFTER + index)
        times = ExecutionTimes(callback["afterwards"], *own)
        self.execution_times.append(times)
        several = self.spec["threads"] > 1
        return lambda: spend(times.next(), time.thread_time_ns(), beside_others=several)

    def _subscribe(self, handle: int, topic: str, body: Body, group: str | None = None) -> None:
        subscription, depth = self._subscription(topic), self.spec["topics"][topic]["depth"]
        own = self.log.subscription(handle, topic, depth)
        entity = executor.SubscriptionEntity(*own, subscription, body, group)
        self.executor.add_subscription(entity)

    def _subscription(self, topic: str, depth: int = 0) -> dds.Subscription:
        qos, text = self.spec["topics"][topic], topic in self.spec["announced"]
        own = (topic, qos["reliability"], max(depth, qos["depth"]))
        subscription = dds.Subscription(self.participant, *own, carries_text=text)
        writers = self.spec["expected"][topic][0]
        self.ends.append((f"subscription to {topic}", subscription, writers, "writers"))
        return subscription

    def _publisher(self, topic: str) -> TracedPublisher:
        qos, text = self.spec["topics"][topic], topic in self.spec["announced"]
        own = (topic, qos["reliability"], qos["depth"], qos["lifespan_ns"])
        publisher = dds.Publisher(self.participant, *own, carries_text=text)
        readers = self.spec["expected"][topic][1]
        self.ends.append((f"publisher of {topic}", publisher, readers, "readers"))
        asynchronous, write = qos["publication"] == "asynchronous", publisher.write
        handle, rmw_handle = self.log.publisher(topic, qos["depth"], asynchronous)
        if asynchronous:  # the process's publisher thread does the writing
            self.to_send = self.to_send or executor.start_publisher_thread()
            note, history = partial(self._note_send, rmw_handle), (qos["depth"], qos["lifespan_ns"])
            write = executor.AsynchronousWriter(write, *history, note, self.to_send).publish
        point = self._point["publish"]
        return TracedPublisher(write, bytes(qos["payload"]), handle, rmw_handle, point)

    def _note_send(self, handle: int, at_ns: int, stamp: int, outcome: str, lasted: int) -> None:
        """Record what became of a message, in whichever thread."""
        number = number_of("outcome", outcome)
        self._point["asynchronous_send"](at_ns, handle, stamp, number, lasted)

    def _working_body(
        self,
        handle: int,
        work: executor.Work,
        publishers: Sequence[TracedPublisher],
        rest: Callable[[], None],
        complete: Callable[[dds.Message], tuple[dds.Message, ...]] | None = None,
    ) -> Callable[..., None]:
        """An ordinary callback: work, publish, and do the rest.

        With ``complete`` nothing is done until a message completes a set, for which it is then.
        """

        def body(message: dds.Message | None = None) -> None:
            wall, used = time.time_ns(), time.thread_time_ns()
            messages: tuple[dds.Message, ...] = () if message is None else (message,)
            if complete is not None and message is not None:
                messages = complete(message)
            if messages or complete is None:
                for payload, publisher in zip(work(messages, wall, used), publishers, strict=False):
                    publisher.record(payload, *publisher.send(payload))
                rest()

        return self._recorded(handle, body)

    def _recorded(self, handle: int, body: Callable[..., None]) -> Callable[..., None]:
        """A callback, whose instances are recorded."""
        start, end = self._point["callback_start"], self._point["callback_end"]

        def callback(*arguments: Any) -> None:
            start(time.monotonic_ns(), handle, time.thread_time_ns(), 0)
            body(*arguments)
            end(time.monotonic_ns(), handle, time.thread_time_ns())

        return callback

    # Gates --------------------------------------------------------------------------------

    def _add_gate(self, symbol: str, topic: str, gate: dict[str, Any], output: str) -> None:
        """The latency-shaping callback (paper, section 3.2.2): delay, then republish unchanged.

        Between waking and writing nothing is computed, and after writing the thread pauses, so
        that threads it outranks can deliver, unless another message has to leave meanwhile; only
        then are its events recorded. Delay that no other thread caused is a stall of the machine.

        What comes while one waits for its release waits behind it. The executor has it worked off
        before it takes the next: a message is recorded as taken when it is its turn.
        """
        publisher, turn = self._publisher(output), self._turn(output)
        shaper, subscription = self._shaper(gate, turn), self._subscription(topic, READER_DEPTH)
        if gate["modes"] is not None:  # before the messages that it concerns
            self._listen(gate["modes"]["topic"], shaper)
        handle = self.log.callback(symbol)
        depth = self.spec["topics"][topic]["depth"]
        own_handle, rmw_handle = self.log.subscription(handle, topic, depth)
        stalled, pause_ns = self._point["machine_stall"], gate["pause_ns"]
        note = partial(self._note_release, handle, gate, turn)
        note_alone = self._recorded(handle, note)
        waiting, overflowed = shaper.queue.waiting, shaper.overflowed

        def look() -> None:
            while subscription.ready():
                if (message := subscription.take()) is not None:
                    now = time.monotonic_ns()
                    shaper.arrive(message.payload, now, message.source_timestamp, message)

        @partial(self._recorded, handle)
        def hold() -> None:
            if (outcome := shaper.hold()) is not None:
                if outcome.release.at_ns is not None:
                    payload = outcome.message.payload
                    published, source_timestamp = publisher.send(payload)
                    lost = shaper.time_lost(outcome.release, published)
                    shaper.rest(published, pause_ns)
                    publisher.record(payload, published, source_timestamp)
                    if lost >= STALL_NS:
                        stalled(outcome.release.at_ns, lost)
                note(outcome)

        def let_one_pass() -> None:
            hold()
            for gone in overflowed:
                self.executor.record_take(rmw_handle, gone.message.about)
                note_alone(gone)
            overflowed.clear()

        def body(message: dds.Message) -> None:
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
        entity = executor.SubscriptionEntity(own_handle, rmw_handle, subscription, body)
        self.executor.add_subscription(entity)

    def _shaper(self, gate: dict[str, Any], turn: Turn | None) -> Shaper:
        modes, core = gate["modes"], self.spec["delivery_core"]
        if gate["phase_ns"] is None:
            gate["phase_ns"] = self.spec["origin_phase"]
        own = Gate(
            slots=tuple((begin, finish) for begin, finish in gate["slots"]),
            modes=modes and Modes(modes["bands"], modes["default"], modes["late"]),
            depth=gate["depth"],
            **{declared.name: gate[declared.name] for declared in VALUES},
        )
        shaper, first = Shaper(own, gate["spin_ns"]), own.slots[0][0]
        if core is not None:
            clear_until, pause_ns = ClearCore(core).clear_until, gate["pause_ns"]
            shaper.on_waking = lambda release_ns: clear_until(release_ns + pause_ns)
        if turn is not None:
            shaper.moved = turn.moved
        self.shapers.append((shaper, [(since, begin - first) for since, begin in gate["moves"]]))
        return shaper

    def _listen(self, topic: str, shaper: Shaper) -> None:
        """Listen to the modes that are announced."""
        handle = self.log.new_handle()

        @partial(self._recorded, handle)
        def switch(message: dds.Message) -> None:
            shaper.switch(text_of(message.payload), time.monotonic_ns())

        self._subscribe(handle, topic, switch)

    def _turn(self, output: str) -> Turn | None:
        """The page by which others know an output, as that of a shaping node, but without standby.

        None where there cannot be one, or another run has the same output.
        """
        with suppress(OSError):
            turn = Turn(f"live{output.replace('/', '.')}", output)
            if turn.take(None):
                return turn
        return None

    def _note_release(
        self, handle: int, gate: dict[str, Any], turn: Turn | None, outcome: Outcome
    ) -> None:
        """Record what became of a message at a gate."""
        message, release = outcome.message, outcome.release
        mode = release.mode and [*gate["modes"]["bands"]].index(release.mode)
        if turn is not None:
            turn.count(outcome)
        came = (message.about.source_timestamp, message.arrival_ns)
        leaves = (release.origin_ns, release.at_ns, release.slot, release.cycles_waited)
        why = (number_of("anchor", release.anchor), number_of("overrun", release.overrun), mode)
        row = (*came, *leaves, *why, number_of("dropped", release.dropped), release.moved_ns)
        absent = (ABSENT if number is None else number for number in row)
        self._point["gate_release"](outcome.awake_ns, handle, *absent)

    # Running ------------------------------------------------------------------------------

    def wait_for_counterparts(self, deadline_ns: int) -> list[str]:
        """Wait until DDS discovery is complete; what is still missing at the deadline."""
        while True:
            missing = [
                f"{name} found {end.matched()} of {expected} {others}"
                for name, end, expected, others in self.ends
                if end.matched() < expected
            ]
            if not missing or time.monotonic_ns() > deadline_ns:
                return missing
            time.sleep(0.01)

    def run(self, start_ns: int, last_timer_ns: int, stop_ns: int) -> None:
        """Execute callbacks from the common start until the end."""
        for timer in self.executor.timers:
            timer.due_ns += start_ns
        periods = [timer.period_ns for timer in self.executor.timers] or [100_000_000]
        for times in self.execution_times:
            times.refill(min(1 + (stop_ns - start_ns) // min(periods), 100_000))
        for shaper, moves in self.shapers:
            shaper.queue.phase_ns = start_ns + shaper.gate.phase_ns
            shaper.queue.moves.extend((start_ns + since, by) for since, by in moves)
        scheduling.stop_garbage_collection()
        self.executor.spin_until(stop_ns, last_timer_ns)


def main() -> None:
    """Run one node as the launcher says."""
    output = launcher.own_output()  # what callbacks compute may print
    spec = launcher.receive()
    scheduling.signalled_with_parent(spec["parent"], signal.SIGKILL)
    scheduling.set_thread_name(spec["node"].strip("/").replace("/", "."))
    node = NodeProcess(spec)
    signal.signal(launcher.ENOUGH, lambda *_: setattr(node.executor, "over", True))
    missing = node.wait_for_counterparts(time.monotonic_ns() + spec["discovery_ns"])
    launcher.send(output, missing=missing, memory_locked=scheduling.lock_memory())
    times = launcher.receive()
    node.run(times["start_ns"], times["last_timer_ns"], times["stop_ns"])
    launcher.send_events(output, node.log.rows, objects=node.log.objects)
    launcher.wait_for_leave()
    os._exit(0)  # DDS teardown of a closed domain is of no use, and not always quick


if __name__ == "__main__":
    main()
