"""A gate at work in a thread: it takes messages, sleeps until their release, and minds the clocks.

The same in C++ is `chainshaper_shaping/shaper.hpp`.
"""

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from chainshaper.robot.clocks import clock_offset, sleep_until, watch_until
from chainshaper.robot.decision import Release, missed
from chainshaper.robot.gate import Gate
from chainshaper.robot.serialized import origin_of
from chainshaper.robot.waiting import Outcome, Queue

READER_DEPTH = 1000  # history of the gate's reader: the gate itself drops, and counts, the rest
STALL_NS = 100_000  # on a machine that does not stall, a thread may wake up this late
STEP_NS = 500_000  # a step of the wall clock: slewing moves it by at most 50 us in 100 ms
LOOK_NS = 50_000_000  # between two looks for messages: often enough for the reader's history
OTHERS_NS = 2_000_000  # the executor's other callbacks take less


class Shaper:
    """A gate at work: holds each message until its release.

    Stamps are CLOCK_REALTIME, and the wall clock may be stepped: the shaper measures its offset for
    every message. Messages under way during a step are anchored to the cycle instead, at the phase
    that the last good stamp had.

    A shaper belongs to one thread, which does nothing else at the time of a release. The owner sets
    the functions that it calls:

    * ``look`` takes what has come and calls :meth:`arrive` for it; while messages wait, before each
      release and behind it.
    * ``follow`` puts into the queue's schedules what was asked for meanwhile; with each message.
    * ``on_waking`` gets the time of a release, ``spin_ns`` before it.
    * ``on_decision`` gets each decision before the wait for it.

    ``overflowed`` are the messages that overflowed since the owner emptied this list.
    """

    def __init__(self, gate: Gate, spin_ns: int = 0) -> None:
        self.gate, self.queue = gate, Queue(gate)
        self.spin_ns = spin_ns
        self.overflowed: list[Outcome] = []
        self.look: Callable[[], None] = lambda: None
        self.follow: Callable[[], None] = lambda: None
        self.on_waking: Callable[[int], None] = lambda _: None
        self.on_decision: Callable[[Release], None] = lambda _: None
        self._looked_ns = self._waited_ns = self._turn_ns = 0
        self._offset = clock_offset()
        self._thread, self._schedstat = 0, -1

    def arrive(
        self,
        payload: bytes,
        now_ns: int,
        source_ns: int | None = None,
        about: Any = None,
        lost: int | None = None,
    ) -> None:
        """Queue a message that was taken now.

        ``source_ns`` (CLOCK_REALTIME) is for one that waited in the reader: it counts as having
        come then, if that is after the last look.
        """
        offset = clock_offset()
        stepped = abs(offset - self._offset) > STEP_NS
        self._offset = offset
        if stepped:
            self.queue.doubt_stamps(now_ns)
        stamp, arrival = origin_of(payload), now_ns
        if source_ns is not None and not stepped:
            arrival = min(now_ns, max(self._looked_ns, source_ns - offset))
        self.follow()
        stamp = None if stamp is None else stamp - offset
        overflowed = self.queue.arrive(payload, arrival, stamp, about, lost)
        if overflowed is not None:
            self.overflowed.append(overflowed)

    def hold(self) -> Outcome | None:
        """Wait until the oldest message leaves or is dropped; None: it overflowed meanwhile.

        Where overruns are discarded, so is a message that came in time but would leave behind its
        slot because this thread woke up late.
        """
        queue = self.queue
        message, now = queue.waiting[0], time.monotonic_ns()
        self._turn_ns = now  # before, this thread was busy with the message before it
        release = queue.decide()
        self.on_decision(release)
        if release.at_ns is not None:
            self._waited_ns = self._others_ran_ns()
            slept = release.at_ns > now
            while (awake := release.at_ns - self.spin_ns) > now:
                sleep_until(min(awake, now + LOOK_NS))
                self._look()
                now = time.monotonic_ns()
            # The first time, it may have come long ago, and newer ones since.
            if not slept and (self.gate.messages == "newest" or not self._looked_ns):
                self._look()
            if queue.waiting[0] is not message:
                return None
            if queue.replaced(release, now):
                release = release.dropping("replaced")
        if release.at_ns is not None:
            if slept:
                self.on_waking(release.at_ns)
                if time.monotonic_ns() < release.at_ns:
                    # This thread is awake in time: other threads before that delayed nothing.
                    self._waited_ns = self._others_ran_ns()
            now = watch_until(release.at_ns)
            if self.gate.policy == "discard" and missed(self.gate, release, now):
                release = replace(release.dropping("discarded"), overrun="discard")
        queue.leave(release, now)
        return Outcome(message, release, now)

    def _look(self) -> None:
        now = time.monotonic_ns()
        self.look()
        self._looked_ns = now

    def nothing_due(self, until_ns: int | None = None) -> bool:
        """Return whether nothing is to be released until an instant (default: in a short while)."""
        if not self.queue.waiting:
            return True
        at_ns = self.queue.decide().at_ns
        until_ns = time.monotonic_ns() + OTHERS_NS if until_ns is None else until_ns
        return at_ns is not None and at_ns > until_ns + self.spin_ns

    def rest(self, published_ns: int, pause_ns: int) -> None:
        """Rest behind a publication, unless another message has to leave meanwhile."""
        self.queue.free_ns = published_ns
        self._look()
        if self.nothing_due(published_ns + pause_ns):
            sleep_until(published_ns + pause_ns)
            self.queue.free_ns = time.monotonic_ns()

    def time_lost(self, release: Release, until_ns: int) -> int:
        """Return how much of the delay from a release until ``until_ns`` no thread used (ns).

        Interrupts took that, or the core was taken away from the whole system. To be called right
        after publishing.
        """
        since_ns = max(release.at_ns or 0, self._turn_ns)
        return max(0, until_ns - since_ns - (self._others_ran_ns() - self._waited_ns))

    def _others_ran_ns(self) -> int:
        """Return for how long this thread has been ready while others ran (ns).

        That is the second number of its schedstat (kernel: scheduler/sched-stats.rst); without one,
        all delay counts as other threads'.
        """
        if self._thread != threading.get_ident():  # the file belongs to the thread that opened it
            self._thread, self._schedstat = threading.get_ident(), -1
            with suppress(OSError):
                self._schedstat = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        if self._schedstat < 0:
            return time.monotonic_ns()
        return int(os.pread(self._schedstat, 128, 0).split()[1])
