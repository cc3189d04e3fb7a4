"""The messages that wait at a gate, and which of them leave.

The same in C++ is `core/gate/queue.hpp`.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from chainshaper.robot.decision import Release, release_of
from chainshaper.robot.gate import Gate
from chainshaper.robot.schedules import (
    Schedules,
    first_schedule,
    schedule_in_force,
    with_change,
    with_phase_seen,
)


@dataclass(eq=False)
class Waiting:
    """A message that waits at a gate. Times are ns of CLOCK_MONOTONIC.

    * ``payload``: the serialized message.
    * ``arrival_ns``: when it came.
    * ``stamp_ns``: its origin; None: it has none that is of use.
    * ``phase_ns``: where cycles started when it came.
    * ``about``: what the owner of the gate knows of it; in ROS 2 nodes its source timestamp.
    * ``lost``: messages lost between the one before it and this one; None: not known.
    """

    payload: bytes
    arrival_ns: int
    stamp_ns: int | None
    phase_ns: int
    about: Any = None
    lost: int | None = None


@dataclass(frozen=True)
class Outcome:
    """A message that leaves the queue: it may be published now, or is dropped.

    ``awake_ns`` is when the thread of the gate knew that (CLOCK_MONOTONIC).
    """

    message: Waiting
    release: Release
    awake_ns: int


class Queue:
    """The messages that wait at a gate, and which of them leave. It reads no clock.

    * ``schedules``: what holds from which cycle on.
    * ``waiting``: the messages, the oldest first.
    * ``free_ns``: when the gate's thread was done with the message before; the oldest one leaves
      after that.
    """

    def __init__(self, gate: Gate) -> None:
        self.gate = gate
        self.schedules: Schedules = (first_schedule(gate),)
        self.waiting: deque[Waiting] = deque()
        self.free_ns = 0
        # The start of the cycle that the oldest message leaves in, or a newer one in its place.
        self._leaving: int | None = None
        # The start of the cycle in which the last message left.
        self._left: int | None = None
        self._unsure_until_ns = 0

    def set_phase(self, phase_ns: int, from_ns: int) -> None:
        """Start cycles at another phase, from the first such start at ``from_ns`` or later on."""
        cycle_ns = self.gate.cycle_ns
        start_ns = from_ns + (phase_ns - from_ns) % cycle_ns
        self.schedules = with_change(self.schedules, start_ns, phase_ns=phase_ns % cycle_ns)

    def move_slots(self, by_ns: int, from_ns: int) -> None:
        """Move the slots of cycles that start at ``from_ns`` or later from where the gate has them.

        Nothing changes where they would leave the cycle.
        """
        if self.gate.may_move(by_ns):
            self.schedules = with_change(self.schedules, from_ns, moved_ns=by_ns)

    def switch(self, mode: str | None, from_ns: int) -> bool:
        """Put a mode in force in cycles that start at ``from_ns`` or later.

        Returns False if there is no such mode.
        """
        if self.gate.modes is None or mode is None or mode not in self.gate.modes.slots:
            return False
        self.schedules = with_change(self.schedules, from_ns, mode=mode)
        return True

    def doubt_stamps(self, now_ns: int) -> None:
        """Use no stamps until all messages that are under way now have come.

        The wall clock was stepped: the stamps of these are from before or from after the step.
        """
        self._unsure_until_ns = now_ns + (self.gate.due_cycles + 1) * self.gate.cycle_ns

    def arrive(
        self,
        payload: bytes,
        arrival_ns: int,
        stamp_ns: int | None,
        about: Any = None,
        lost: int | None = None,
    ) -> Outcome | None:
        """Queue a message; return the one that overflowed, or None."""
        stamp_ns = None if arrival_ns < self._unsure_until_ns else stamp_ns
        if stamp_ns is not None and self.gate.counts_from(stamp_ns, arrival_ns):
            seen_ns = stamp_ns % self.gate.cycle_ns
            self.schedules = with_phase_seen(self.schedules, seen_ns, arrival_ns)
        phase_ns = schedule_in_force(self.schedules, arrival_ns).phase_ns
        self.waiting.append(Waiting(payload, arrival_ns, stamp_ns, phase_ns, about, lost))
        if len(self.waiting) <= self.gate.depth:
            return None
        oldest = self.waiting.popleft()
        return Outcome(oldest, self._release(oldest, arrival_ns).dropping("overflowed"), arrival_ns)

    def decide(self) -> Release:
        """Decide when the oldest message may leave, or why it never does."""
        oldest = self.waiting[0]
        ready = max(oldest.arrival_ns, self.free_ns)
        release = self._release(oldest, ready)
        if release.slot is None or self.gate.messages == "all-in-order":
            return release
        if self._left is not None and self._same_cycle(release, self._left):
            moved_ns = schedule_in_force(self.schedules, self._left).moved_ns
            last_end = self._left + moved_ns + self.gate.slots[-1][1]
            release = self._release(oldest, max(ready, last_end))
            if release.slot is None:
                return release if release.at_ns is None else replace(release, at_ns=ready)
        if not self._same_cycle(release, self._leaving):
            self._leaving = release.start_ns(self.gate.cycle_ns)
        return release

    def replaced(self, release: Release, now_ns: int) -> bool:
        """Return whether a newer message leaves in place of the oldest, which was to leave so."""
        if self.gate.messages != "newest" or release.slot is None:
            return False
        newer = (self._release(message, now_ns) for message in islice(self.waiting, 1, None))
        return any(
            decision.slot is not None and self._same_cycle(decision, self._leaving)
            for decision in newer
        )

    def leave(self, release: Release | None, now_ns: int) -> None:
        """Take the oldest message out, as decided; ``release`` None: another process decided."""
        self.waiting.popleft()
        self.free_ns = now_ns
        if release is not None and release.slot is not None:
            self._left = self._leaving

    def _release(self, message: Waiting, ready_ns: int) -> Release:
        return release_of(
            self.gate,
            message.arrival_ns,
            message.stamp_ns,
            self.schedules,
            ready_ns=ready_ns,
            phase_ns=message.phase_ns,
        )

    def _same_cycle(self, release: Release, start_ns: int | None) -> bool:
        """Return whether a message leaves in the cycle that starts at this time.

        Stamps are not quite periodic: starts less than half a cycle apart are of one cycle.
        """
        cycle_ns = self.gate.cycle_ns
        return start_ns is not None and 2 * abs(release.start_ns(cycle_ns) - start_ns) < cycle_ns
