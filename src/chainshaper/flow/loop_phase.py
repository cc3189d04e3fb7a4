"""Where a loop is at the moment: its phase, its spread and its drift, from its latest starts.

The phase of a loop is another one each time it is started, and moves where its clock is not the
chain's. So it is followed: :class:`PhaseTrack` gets instants as they come, and says where the next
ones will be.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FEWEST = 16  # starts from which a phase is known
FEWEST_FOR_DRIFT = 32  # with fewer, lateness would pass for a drift: there is taken to be none
MOST = 1024  # starts that are remembered
LONGEST_NS = 20_000_000_000  # of the starts that are remembered, the first is no older
RESTARTED = 8  # so many starts in turn elsewhere: the loop was started again, or has been moved
# Of a period: a loop that deviates by more has another one; of few starts, some of them late, more.
_LARGEST_DRIFT, _LARGEST_OF_FEW = 1e-3, 0.02


@dataclass(frozen=True)
class LoopPhase:
    """Where a loop is, from its latest starts. Times are ns.

    * ``at_ns``: the latest start, as the line through all of them has it (CLOCK_MONOTONIC).
    * ``period_ns``: from one start to the next, as measured.
    * ``phase_ns``: ``at_ns`` behind a multiple of the period that it is said to have.
    * ``spread_ns``: of the starts around the line, from p0.5 to p99.5.
    * ``drift_ppm``: by how much the period is longer than it is said to be (parts per million).
    * ``starts``: how many there are.
    """

    at_ns: int
    period_ns: float
    phase_ns: int
    spread_ns: int
    drift_ppm: float
    starts: int

    def near(self, instant_ns: int) -> int:
        """Return the loop's start that is next to an instant, before or behind it (ns)."""
        turns = round((instant_ns - self.at_ns) / self.period_ns)
        return self.at_ns + round(turns * self.period_ns)


def phase_of(starts_ns: Sequence[int] | npt.NDArray[np.int64], period_ns: int) -> LoopPhase | None:
    """Find a loop's phase; None: there are too few starts, or they are irregular.

    ``starts_ns`` are in order, some may be missing; ``period_ns`` is the period that the loop is
    said to have. The line through the starts has the median slope between the first half of them
    and the second, and the median place: a start that is late does not move it.

        >>> phase_of([7 + 100 * turn for turn in range(40)], 100).phase_ns
        7
    """
    starts = np.asarray(starts_ns, np.int64)
    if starts.size < FEWEST:
        return None
    since = starts - starts[0]
    turns = np.concatenate([[0], np.cumsum(np.rint(np.diff(starts) / period_ns))])
    if np.any(np.diff(turns) < 1):  # two starts within half a period
        keep = np.concatenate([[True], np.diff(turns) >= 1])
        if keep.mean() < 0.9:
            return None
        since, turns = since[keep], turns[keep]
    half = since.size // 2
    apart = turns[half : 2 * half] - turns[:half]
    measured = float(np.median((since[half : 2 * half] - since[:half]) / apart))
    is_few = since.size < FEWEST_FOR_DRIFT
    if abs(measured / period_ns - 1) > (_LARGEST_OF_FEW if is_few else _LARGEST_DRIFT):
        return None
    measured = float(period_ns) if is_few else measured
    off = since - turns * measured
    usual = float(np.median(off))
    low, high = np.percentile(off, (0.5, 99.5))
    at_ns = int(starts[0]) + round(usual + float(turns[-1]) * measured)
    return LoopPhase(
        at_ns=at_ns,
        period_ns=measured,
        phase_ns=at_ns % period_ns,
        spread_ns=round(high - low),
        drift_ppm=(measured / period_ns - 1) * 1e6,
        starts=int(since.size),
    )


@dataclass
class PhaseTrack:
    """The phase of something that happens once in a period, which is followed as instants come.

    * ``restarts``: how often instants have come elsewhere, so that all was measured again.
    """

    period_ns: int
    longest_ns: int = LONGEST_NS
    restarts: int = 0
    _starts: list[int] = field(default_factory=list)
    _elsewhere: list[int] = field(default_factory=list)  # the latest ones, where none is expected
    _known: LoopPhase | None = None

    @property
    def phase(self) -> LoopPhase | None:
        """What is known by now; None: too little."""
        return self._known

    def forget(self) -> None:
        """Begin anew: it was started again, or moved."""
        self._starts, self._elsewhere, self._known = [], [], None

    def saw(self, starts_ns: Sequence[int]) -> LoopPhase | None:
        """Take further instants (ns, in order); return what is known by now.

        Instants that are far from where they are expected count only when many in turn are: then
        the loop was started again, and what was before is forgotten.
        """
        known = self._known
        for start in starts_ns:
            tolerance = self.period_ns / 8 if known is None else _tolerance(known)
            if known is None or abs(start - known.near(start)) <= tolerance:
                self._elsewhere = []
                self._starts.append(start)
                continue
            self._elsewhere.append(start)
            if len(self._elsewhere) >= RESTARTED:
                self._starts, self._elsewhere, self._known = self._elsewhere, [], None
                known = None
                self.restarts += 1
        if starts_ns and self._starts:
            oldest = self._starts[-1] - self.longest_ns
            first = int(np.searchsorted(self._starts, oldest))
            self._starts = self._starts[max(first, len(self._starts) - MOST) :]
            self._known = phase_of(self._starts, self.period_ns)
        return self._known


def _tolerance(known: LoopPhase) -> float:
    """Return how far from where it is expected a start belongs to the loop as it was."""
    return min(known.period_ns / 8, 3 * known.spread_ns + 100_000)
