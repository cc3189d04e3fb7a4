"""The room that a publish slot leaves for the chain's next instance.

What publishing an output takes (its gate's turn, the callbacks of its receivers) has the core
before the chain. Behind a slot at the end of a cycle it reaches into the next one, whose output
then comes later, and may miss its slot in turn. A later slot is in time for more long cycles, and
leaves less room: :func:`latency_with_fewest_late` weighs one against the other, by running through
the measured cycles with each slot.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.robot.gate import Overrun

MOST_CANDIDATES = 500  # slots that are tried; of more, so many that are evenly spread

_Latencies = NDArray[np.int64]


class NextCycle(NamedTuple):
    """What the end of a chain's cycle has to have room for. Times in nanoseconds."""

    cycle_ns: int
    slot_ns: int  # the length of the publish slot, which ends in the cycle
    # How long publishing and receiving have the core on which the chain's next instance begins.
    work_ns: int
    overrun: Overrun  # what is done with an output that missed its slot

    @property
    def latest_slot_ns(self) -> int:
        """When the publish slot begins at the latest."""
        return self.cycle_ns - self.slot_ns


def latencies_behind_slot(
    every_latency_ns: _Latencies,
    in_time_ns: int | _Latencies,
    behind_ns: int,
    following: NextCycle,
) -> _Latencies:
    """Return the latencies that measured cycles would have had with a slot where it is planned.

    ``every_latency_ns`` are in the order of time. An output is in time with a latency of up to
    ``in_time_ns``, and its slot begins ``behind_ns`` after that; several such limits at a time give
    a row for each. In the recording the same work followed each output at once: only what is in
    the way of the next instance in addition delays it.

    A cycle of 10 ms, 2 ms of work: behind a slot at 9 ms the next instance begins 1 ms late.

        >>> following = NextCycle(10, 1, 2, "publish")
        >>> latencies_behind_slot(np.array([5, 5, 5]), 8, 1, following).tolist()
        [5, 6, 6]
    """
    in_time = np.atleast_1d(np.asarray(in_time_ns, np.int64))
    slot, work, cycle = in_time + behind_ns, following.work_ns, following.cycle_ns
    most_outputs = 2 if following.overrun == "wait" else 1  # in a slot
    if int(slot.max()) + most_outputs * work <= cycle:
        every_slot = np.tile(every_latency_ns, (in_time.size, 1))
        return every_slot if np.ndim(in_time_ns) else every_latency_ns
    delay, waiting = np.zeros_like(in_time), np.zeros(in_time.size, np.bool_)
    latencies = np.empty((in_time.size, every_latency_ns.size), np.int64)
    for number, measured in enumerate(every_latency_ns.tolist()):
        ready = measured + delay
        late = ready > in_time
        latencies[:, number] = ready
        # When the core is free again: behind the outputs of this slot, and behind the chain itself.
        outputs = waiting.astype(np.int64) + ~late
        free = np.maximum(np.where(outputs > 0, slot + outputs * work, 0), ready)
        if following.overrun == "publish":
            free = np.where(late, np.maximum(free, ready + work), free)
        waiting = late & (following.overrun == "wait")
        as_recorded = max(0, measured + work - cycle)
        delay = np.maximum(0, np.maximum(0, free - cycle) - as_recorded)
    return latencies if np.ndim(in_time_ns) else latencies[0]


def latency_with_fewest_late(
    every_latency_ns: _Latencies,
    covered_ns: int,
    least_ns: int,
    behind_ns: int,
    following: NextCycle,
) -> int:
    """Return up to which latency outputs should be in time, so that the fewest of all are late.

    ``covered_ns`` is the one that the margin would cover; where its slot leaves the next instance
    its room, or no other one has fewer late outputs, it stays. Otherwise it is another measured
    one, from ``least_ns`` on whose slot ends in the cycle; of equals, the shortest.
    """
    if covered_ns + behind_ns + following.work_ns <= following.cycle_ns:
        return covered_ns
    fit = np.unique(every_latency_ns)
    fit = fit[(fit >= least_ns) & (fit <= following.latest_slot_ns - behind_ns)]
    if fit.size > MOST_CANDIDATES:
        fit = fit[np.linspace(0, fit.size - 1, MOST_CANDIDATES).astype(np.int64)]
    candidates = np.append(fit, covered_ns)
    latencies = latencies_behind_slot(every_latency_ns, candidates, behind_ns, following)
    late = np.count_nonzero(latencies > candidates[:, np.newaxis], axis=1)
    return covered_ns if late[-1] <= late.min() else int(candidates[np.argmin(late)])
