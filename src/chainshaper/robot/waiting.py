"""The messages that wait at a gate, and which of them leave.

The same in C++ is `core/gate/queue.hpp`.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from chainshaper.robot.decision import Release, moved_at, release_of
from chainshaper.robot.gate import Gate

CHANGES = 64  # so many changes of the mode, or moves, reach back further than the oldest stamp


@dataclass(eq=False)
class Waiting:
    """A message that has come and not left; times are ns of CLOCK_MONOTONIC."""

    payload: bytes
    arrival_ns: int
    stamp_ns: int | None
    phase_ns: int
    about: Any = None  # what its owner knows of it: the source timestamp, in ROS 2 nodes
    lost: int | None = None  # how many, between the one before it and this one; None: not known


@dataclass(frozen=True)
class Outcome:
    """What became of a message: it may leave now, or is dropped."""

    message: Waiting
    release: Release
    awake_ns: int  # when that was clear (CLOCK_MONOTONIC)


class Queue:
    """The messages that wait at a gate, and which of them leave. It knows no clock."""

    def __init__(self, gate: Gate) -> None:
        self.gate = gate
        self.phase_ns = gate.phase_ns
        self.waiting: deque[Waiting] = deque()
        self.changes: deque[tuple[int, str]] = deque(maxlen=CHANGES)
        self.moves: deque[tuple[int, int]] = deque(maxlen=CHANGES)
        self.free_ns = 0  # when it is the turn of the oldest message, if it is there then
        # When cycles start: the one that the oldest message, or another for it, leaves in, and
        # the one in which the last has left.
        self._leaving: int | None = None
        self._left: int | None = None
        self._unsure_until_ns = 0

    def doubt_stamps(self, now_ns: int) -> None:
        """The wall clock was stepped: stamps of messages that are under way may be of either side
        of the step. They are of no use until the last of these has come.
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
        """A message came; the one for which there is no room any more."""
        stamp_ns = None if arrival_ns < self._unsure_until_ns else stamp_ns
        message = Waiting(payload, arrival_ns, stamp_ns, self.phase_ns, about, lost)
        self.waiting.append(message)
        if stamp_ns is not None and self.gate.counts_from(stamp_ns, arrival_ns):
            self.phase_ns = stamp_ns % self.gate.cycle_ns
        if len(self.waiting) <= self.gate.depth:
            return None
        oldest = self.waiting.popleft()
        return Outcome(oldest, self._release(oldest, arrival_ns).dropping("overflowed"), arrival_ns)

    def decide(self) -> Release:
        """When the oldest message may leave, or why it never does."""
        oldest = self.waiting[0]
        ready = max(oldest.arrival_ns, self.free_ns)
        release = self._release(oldest, ready)
        if release.slot is None or self.gate.messages == "all-in-order":
            return release
        if self._left is not None and self._same_cycle(release, self._left):
            last_end = self._left + moved_at(self.moves, self._left) + self.gate.slots[-1][1]
            release = self._release(oldest, max(ready, last_end))
            if release.slot is None:
                return release if release.at_ns is None else replace(release, at_ns=ready)
        if not self._same_cycle(release, self._leaving):
            self._leaving = release.start_ns(self.gate.cycle_ns)
        return release

    def replaced(self, release: Release, now_ns: int) -> bool:
        """Whether a newer message leaves for the oldest one, which was to leave like this."""
        if self.gate.messages != "newest" or release.slot is None:
            return False
        others = (self._release(newer, now_ns) for newer in islice(self.waiting, 1, None))
        return any(one.slot is not None and self._same_cycle(one, self._leaving) for one in others)

    def leave(self, release: Release | None, now_ns: int) -> None:
        """The oldest message leaves, or is dropped; None: it is not this gate's to decide."""
        self.waiting.popleft()
        self.free_ns = now_ns
        if release is not None and release.slot is not None:
            self._left = self._leaving

    def _release(self, message: Waiting, ready_ns: int) -> Release:
        return release_of(
            *(self.gate, message.arrival_ns, message.stamp_ns, self.changes),
            ready_ns=ready_ns,
            phase_ns=message.phase_ns,
            moves=self.moves,
        )

    def _same_cycle(self, release: Release, start_ns: int | None) -> bool:
        """Stamps are not quite periodic: cycles are the same less than half a cycle apart."""
        cycle_ns = self.gate.cycle_ns
        return start_ns is not None and 2 * abs(release.start_ns(cycle_ns) - start_ns) < cycle_ns
