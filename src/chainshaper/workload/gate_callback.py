"""The latency-shaping callback of a live node (paper, section 3.2.2): delay, then republish."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from chainshaper.robot.clear_core import ClearCore
from chainshaper.robot.handover import Turn
from chainshaper.robot.shaper import STALL_NS, Shaper
from chainshaper.robot.waiting import Outcome
from chainshaper.workload import dds
from chainshaper.workload.description import GateDescription
from chainshaper.workload.event_log import ABSENT, LAYOUT, EventLog, number_of
from chainshaper.workload.traced import TracedPublisher, traced_callback


def shaper_of(
    gate: GateDescription, origin_phase_ns: int, delivery_core: int | None, turn: Turn | None
) -> Shaper:
    """Make the shaper of a described gate; its phase and moves count from the run's start."""
    phase_ns = origin_phase_ns if gate.phase_ns is None else gate.phase_ns
    shaper = Shaper(replace(gate.gate(), phase_ns=phase_ns), gate.spin_ns)
    if delivery_core is not None:
        clear_until = ClearCore(delivery_core).clear_until
        shaper.on_waking = lambda release_ns: clear_until(release_ns + gate.pause_ns)
    if turn is not None:
        turn.go_on(shaper)
    return shaper


@dataclass(frozen=True)
class GateHandles:
    """The handles under which a gate's events are recorded."""

    callback: int
    rmw_subscription: int


class GateCallback:
    """Holds each message until its slot, then publishes it.

    Between waking and publishing nothing is computed. After publishing the thread pauses, unless
    another message has to leave, so that threads that it outranks can deliver; then it records the
    events. A delay that no other thread has caused is recorded as a stall of the machine.

    A message that comes while another is held waits behind that one. The executor has such messages
    worked off before it takes the next. A message is recorded as taken when its turn comes.
    """

    def __init__(
        self,
        gate: GateDescription,
        *,
        shaper: Shaper,
        subscription: dds.Subscription,
        publisher: TracedPublisher,
        turn: Turn | None,
        log: EventLog,
        handles: GateHandles,
        record_take: Callable[[int, dds.Message], None],
    ) -> None:
        self._pause_ns = gate.pause_ns
        self._modes = () if gate.modes is None else tuple(gate.modes.bands)
        self._shaper, self._waiting = shaper, shaper.queue.waiting
        self._subscription, self._publisher, self._turn = subscription, publisher, turn
        self._handles, self._record_take = handles, record_take
        self._record_stall = log.point("machine_stall")
        self._record_release = log.point("gate_release")
        self._hold = traced_callback(log, handles.callback, self._hold_oldest)
        self._note_overflowed = traced_callback(log, handles.callback, self._note)
        shaper.look = self._look

    def body(self, message: dds.Message) -> None:
        """Take a message from the executor; hold it, unless another is held."""
        alone = not self._waiting
        self._shaper.arrive(message.payload, time.monotonic_ns(), about=message)
        if alone:
            self._let_one_pass()

    def work_off(self) -> bool:
        """Hold the messages that came meanwhile while one is due; return whether more wait."""
        served = False
        while self._waiting and not (served and self._shaper.nothing_due()):
            self._record_take(self._handles.rmw_subscription, self._waiting[0].about)
            self._let_one_pass()
            served = True
        return bool(self._waiting)

    def _look(self) -> None:
        """Take the messages that came while one is held."""
        while self._subscription.ready():
            if (message := self._subscription.take()) is not None:
                now_ns = time.monotonic_ns()
                stamp = message.source_timestamp
                self._shaper.arrive(message.payload, now_ns, stamp, message)

    def _let_one_pass(self) -> None:
        """Hold the oldest message until its release; record those that overflowed meanwhile."""
        self._hold()
        for outcome in self._shaper.overflowed:
            self._record_take(self._handles.rmw_subscription, outcome.message.about)
            self._note_overflowed(outcome)
        self._shaper.overflowed.clear()

    def _hold_oldest(self) -> None:
        """Hold the oldest message until its release, publish it, and record what happened."""
        shaper, publisher = self._shaper, self._publisher
        if (outcome := shaper.hold()) is None:
            return
        if outcome.release.at_ns is not None:
            payload = outcome.message.payload
            published_ns, source_timestamp = publisher.send(payload)
            lost_ns = shaper.time_lost(outcome.release, published_ns)
            shaper.rest(published_ns, self._pause_ns)
            publisher.record(payload, published_ns, source_timestamp)
            if lost_ns >= STALL_NS:
                self._record_stall(outcome.release.at_ns, lost_ns)
        self._note(outcome)

    def _note(self, outcome: Outcome) -> None:
        """Record what became of a message."""
        message, release = outcome.message, outcome.release
        if self._turn is not None:
            self._turn.count(outcome)
        fields = {
            "callback": self._handles.callback,
            "source_timestamp": message.about.source_timestamp,
            "arrival": message.arrival_ns,
            "origin": release.origin_ns,
            "release": release.at_ns,
            "slot": release.slot,
            "cycles_waited": release.cycles_waited,
            "anchor": number_of("anchor", release.anchor),
            "overrun": number_of("overrun", release.overrun),
            "mode": self._modes.index(release.mode) if release.mode else None,
            "dropped": number_of("dropped", release.dropped),
            "moved": release.moved_ns,
        }
        values = [fields[name] for name in LAYOUT["gate_release"]]
        numbers = [ABSENT if value is None else value for value in values]
        self._record_release(outcome.awake_ns, *numbers)
