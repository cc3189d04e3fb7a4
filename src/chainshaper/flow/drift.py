"""Slots that follow a chain whose timer drifts against CLOCK_MONOTONIC.

A chain that a sensor starts has the sensor's clock: 50 ppm off, it has moved by a whole cycle of
100 ms after half an hour. Its servers' slots have to move with it, so that they open shortly after
the timer has expired. When it expires cannot be seen while its thread waits for the slot: the
thread begins as the slot opens, however long before that the timer was. Only a timer that expires
in the open slot shows where it is. So the slots open a little before the timer is expected, once in
a while, just to see; in between they move at the rate that was found. Outputs are not moved by
this: they count from the stamp of their own cycle.
"""

from dataclasses import dataclass, field

SEEN_NS = 250_000  # so long behind the opening a thread begins that its timer woke, not the slot
MOVE_NS = 250_000  # slots move by no less
AHEAD_NS = 500_000  # so long before the timer they open, to see it
SOONEST_NS, LATEST_NS = 10_000_000_000, 300_000_000_000  # from one time to the next


@dataclass
class TimerTrack:
    """Where a timer expires, and where slots open for it; ns behind the first such opening.

    ``lead_ns`` is how long before the opening the timer is to expire. It was seen to expire at
    ``expires_ns`` at the time ``at_ns`` (CLOCK_MONOTONIC), and moves at ``rate`` (ns per ns).
    Unless it ``looks``, the slots never open before the timer to see it.
    """

    lead_ns: int
    at_ns: int
    expires_ns: int = field(init=False)
    rate: float = 0.0
    opens_ns: int = 0
    looks: bool = True
    _step_ns: int = 0  # while it is looked for: so much earlier the next time
    _every_ns: int = SOONEST_NS

    def __post_init__(self) -> None:
        self.expires_ns = -self.lead_ns

    def saw(self, begins_ns: int, now_ns: int) -> int:
        """Where slots are to open from now on, the thread having begun so long behind their
        opening.
        """
        elapsed = now_ns - self.at_ns
        expected = self.expires_ns + round(self.rate * elapsed)
        if abs(begins_ns) > SEEN_NS:  # before the opening: nothing stopped it
            self._learn(self.opens_ns + begins_ns, expected, now_ns)
            self.opens_ns = self.expires_ns + self.lead_ns
        elif self._step_ns:  # the timer is earlier still
            self.opens_ns -= self._step_ns
            self._step_ns *= 2
        elif self.looks and elapsed >= self._every_ns:
            self.opens_ns, self._step_ns = expected - AHEAD_NS, AHEAD_NS
        elif abs(expected + self.lead_ns - self.opens_ns) > MOVE_NS:
            self.opens_ns = expected + self.lead_ns
        return self.opens_ns

    def _learn(self, expires_ns: int, expected_ns: int, now_ns: int) -> None:
        """The timer was seen: it has moved at this rate since the time before."""
        elapsed, surprised = now_ns - self.at_ns, abs(expires_ns - expected_ns) > MOVE_NS
        if elapsed >= SOONEST_NS // 2:
            self.rate = (expires_ns - self.expires_ns) / elapsed
        self.expires_ns, self.at_ns, self._step_ns = expires_ns, now_ns, 0
        self._every_ns = SOONEST_NS if surprised else min(LATEST_NS, 2 * self._every_ns)
