"""Slots that follow what runs: a chain's timer, and the latencies of its output.

A chain that a sensor starts has the sensor's clock, 50 ppm off: its servers' slots have to move
with it. A thread that waits for its slot begins as that opens: only a timer that expires in the
open slot shows where it is. So the slots open a little before the timer is expected, once in a
while, just to see; in between they move at the rate that was found.

A thread that its slot lets go takes a while to begin, on a busy machine longer. So slots soon open
still earlier once more: the timer stays where it is, while a thread that only begins late moves
with the opening. What is late in spite of that is so in one direction only: the timer is the line
beneath all sightings, the edge of their convex hull in the middle (Moon, Skelly and Towsley,
INFOCOM 1999).
"""

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import mean, median

from chainshaper.enforcement.undoing import SlotMove
from chainshaper.flow.background import Background
from chainshaper.planning.adaptation import Tail
from chainshaper.planning.chain_plan import Adaptation, ChainPlan, publish_slots
from chainshaper.planning.margins import allowed_late_share
from chainshaper.planning.offsets import chain_name
from chainshaper.splicing.shaped_outputs import FollowedOutput
from chainshaper.values.errors import ChainshaperError

SEEN_NS = 250_000  # later than usual by so much, a thread was woken by its timer, not the slot
MOVE_NS = 250_000  # slots move by no less
AHEAD_NS = 400_000  # so long before the timer they open, to see it
ONCE_MORE_NS = 400_000  # and so much earlier, to be sure
SOONEST_NS, LATEST_NS = 10_000_000_000, 300_000_000_000  # from one time to the next
SIGHTINGS, USUAL = 16, 9
MOST_RATE = 500e-6  # of a quartz, and of timers that a program counts itself


@dataclass
class TimerTrack:
    """Where a timer expires, and where slots open for it (ns behind the first such opening)."""

    lead_ns: int  # how long before the opening the timer is to expire
    at_ns: int  # when the first opening was (CLOCK_MONOTONIC)
    cycle_ns: int
    looks: bool = True  # whether slots may open before the timer to see it
    opens_ns: int = 0  # where slots open
    sightings: list[tuple[int, int]] = field(init=False)  # when (CLOCK_MONOTONIC), and where it did
    _step_ns: int = 0  # while the timer is looked for: slots open so much earlier the next time
    _every_ns: int = SOONEST_NS  # how long after the last sighting the timer is looked for again
    _perhaps_ns: int | None = None  # where the timer seemed to expire, if the thread was not late
    _lost: int = 0  # how often in turn the timer was seen where it cannot be
    # How late the thread began, the latest times that a slot let it go.
    _let_go: deque[int] = field(default_factory=lambda: deque(maxlen=USUAL))

    def __post_init__(self) -> None:
        self.sightings = [(self.at_ns, -self.lead_ns)]

    @property
    def rate(self) -> float:
        """How fast the timer moves (ns per ns); 0 until it was seen again."""
        (at, place), (later, there) = self._beneath()
        return max(-MOST_RATE, min(MOST_RATE, (there - place) / max(1, later - at)))

    @property
    def is_unsure(self) -> bool:
        """Whether the timer is being looked for: look again soon, before it has moved."""
        return self._perhaps_ns is not None or self._step_ns > 0

    def expected(self, now_ns: int) -> int:
        """Return where the timer expires now, as far as is known."""
        _, (at, place) = self._beneath()
        return place + round(self.rate * (now_ns - at))

    def saw(self, begins_ns: int, now_ns: int) -> int:
        """Take note of how long behind their opening the thread began; return where slots open now.

        A thread that a slot let go says nothing. A thread that was late without reason, or that
        began before the slot, was woken by its timer.
        """
        expires_ns, expected = self.opens_ns + begins_ns, self.expected(now_ns)
        perhaps_ns, self._perhaps_ns = self._perhaps_ns, None
        furthest = self._furthest(now_ns - self.sightings[-1][0])
        stayed = perhaps_ns is not None and expires_ns - perhaps_ns > -ONCE_MORE_NS // 2
        first = begins_ns if 0 <= begins_ns < self.lead_ns // 2 else 0  # no timer can be seen yet
        is_late = begins_ns > SEEN_NS + median(self._let_go or [first])
        if begins_ns >= 0 and not is_late:
            self._let_go.append(begins_ns)
        if (is_late or begins_ns < -SEEN_NS) and abs(expires_ns - expected) > furthest:
            self._go_on(expected, lost=True)
        elif begins_ns < -SEEN_NS or (is_late and stayed):  # nothing stopped it
            self.sightings = [*self.sightings, (now_ns, expires_ns)][-SIGHTINGS:]
            surprised = abs(expires_ns - expected) > MOVE_NS
            self._every_ns = SOONEST_NS if surprised else min(LATEST_NS, 2 * self._every_ns)
            self._go_on(self.expected(now_ns), lost=False)
        elif is_late:
            self._perhaps_ns = expires_ns
            self.opens_ns -= ONCE_MORE_NS if self.looks else 0
        elif self._step_ns:  # the timer is earlier still
            self.opens_ns -= self._step_ns
            self._step_ns *= 2
            if expected - self.opens_ns > furthest:
                self._go_on(expected, lost=True)
        elif self.looks and now_ns - self.sightings[-1][0] >= self._every_ns:
            self.opens_ns, self._step_ns = expected - AHEAD_NS, AHEAD_NS
        elif abs(expected + self.lead_ns - self.opens_ns) > MOVE_NS:
            self.opens_ns = expected + self.lead_ns
        return self.opens_ns

    def _beneath(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the edge of the lower convex hull of all sightings that has their middle in it."""
        hull: list[tuple[int, int]] = []
        for at, place in self.sightings:
            while len(hull) > 1:
                (first, low), (second, high) = hull[-2:]
                if (high - low) * (at - first) < (place - low) * (second - first):
                    break
                hull.pop()
            hull.append((at, place))
        middle = mean(at for at, _ in self.sightings)
        edges = (edge for edge in pairwise(hull) if edge[1][0] >= middle)
        return next(edges, (hull[0], hull[0]))

    def _furthest(self, elapsed_ns: int) -> int:
        """Return how far from where it is expected the timer can be: further, the longer lost."""
        return min(self.cycle_ns // 4, (4 * AHEAD_NS + round(MOST_RATE * elapsed_ns)) << self._lost)

    def _go_on(self, expected_ns: int, *, lost: bool) -> None:
        """Open slots behind the timer again, until it is time to look for it the next time."""
        self.opens_ns, self._step_ns = expected_ns + self.lead_ns, 0
        self._lost = self._lost + 1 if lost else 0


MOVES = 20  # so many of the latest moves are shown


class SlotFollower:
    """Has the slots of a chain's output follow its latencies, in a thread of its own.

    The gate's page of memory has the latencies, from which
    :class:`~chainshaper.planning.adaptation.Tail` says where slots shall be. The thread may end by
    itself, with a ``failure``.

    * ``pids``: processes of which one may be the gate.
    * ``reach_ns``: how far slots may be moved, earlier and later.
    * ``put_in_force``: has servers move their slots by so much (ns), and returns from when on the
      gate has to move its own.
    * ``cores``: where the thread runs; none: anywhere.

    Raises OperationError: see :class:`.FollowedOutput`.
    """

    def __init__(
        self,
        chain: ChainPlan,
        pids: Collection[int],
        reach_ns: tuple[int, int],
        put_in_force: Callable[[int], int],
        *,
        cores: Collection[int] = (),
    ) -> None:
        self.moves: tuple[SlotMove, ...] = ()
        self._chain, self._put_in_force = chain, put_in_force
        assert chain.shaping_node is not None  # noqa: S101 - else the chain cannot be followed
        self._output = FollowedOutput(chain.shaping_node.output, pids)
        self._planned_ns = publish_slots(chain)[-1][0]
        earliest_ns, latest_ns = (self._planned_ns + moved_ns for moved_ns in reach_ns)
        self._tail = Tail(
            chain.adaptation or Adaptation(),
            allowed_late_share(chain.margin),
            self._planned_ns,
            chain.evidence.mean_latency_ns,
            latest_ns,
            earliest_ns,
            math.inf if chain.policy == "pipelined" else chain.cycle_ns,
        )
        self._thread = Background("slot-follower", self._follow, "following", cores)
        self._thread.start()

    @property
    def failure(self) -> ChainshaperError | None:
        """Why slots do not follow any more, also a place where they may not be; None: they do."""
        return self._thread.failure

    def end(self) -> None:
        """Have the slots go back to where the plan has them, and follow no more."""
        self._thread.end()
        self._output.close()

    def _follow(self) -> None:
        """Move the slots whenever latencies say so, until the end."""
        look_s = min(0.1, max(0.005, self._chain.cycle_ns / 2e9))
        while not self._thread.stop.wait(look_s):
            before_ns = self._tail.start_ns
            for latency_ns in self._output.latencies():
                self._tail.add(latency_ns)
            if self._tail.start_ns != before_ns:
                self._move(self._tail.start_ns, before_ns)

    def _move(self, start_ns: int, before_ns: int) -> None:
        """Move the slots, so that the last one opens at ``start_ns`` in place of ``before_ns``."""
        moved_ns = start_ns - self._planned_ns
        from_ns = self._put_in_force(moved_ns)
        self._output.move(moved_ns, from_ns)
        why = "its promise did not hold any more" if start_ns > before_ns else "latency given back"
        move = SlotMove(from_ns, chain_name(self._chain), moved_ns, start_ns, why)
        self.moves = (*self.moves, move)[-MOVES:]
