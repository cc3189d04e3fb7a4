"""Where the slot of an output has to begin, estimated from the latencies as they come.

:class:`Tail` estimates on line what :mod:`~chainshaper.planning.late_shares` and
:mod:`~chainshaper.planning.tails` estimate from a sample, so that slots can follow the latencies.
While the latencies stay as they are, slots hardly ever move, however long that lasts.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import Adaptation
from chainshaper.planning.late_shares import most_hits
from chainshaper.planning.tails import MOST_EXCESSES, anderson_darling, l_moment_fit, not_zero

AIM = 0.8  # slots are moved to where this part of the promised share would be late
# A number of late outputs that chance makes more rarely than this is no chance: where the window is
# looked at once in a while, and where it is looked at with every late output.
DOUBT, DOUBT_AT_ONCE = 1e-6, 1e-9
AT_ONCE = (8, 16, 32, 64, 128)  # of so many latest cycles each, too many late ones are a step
LATEST = 64  # so many latest cycles are compared with those before
LOOKS = 80  # at the window, while it is filled once
FEWEST_BEYOND = 5  # with fewer cycles beyond it in the sample, a latency is extrapolated
SURELY = 3.0  # standard errors of what is extrapolated
REJECTED = 1.2  # A² of a tail that is none: p is some 0.01 (Choulakian and Stephens, 2001, table 2)

_Floats = NDArray[np.float64]


@dataclass
class Tail:
    """Estimates where the slot of an output has to begin, so that the promised share is in time.

    The window holds the latencies since the last change, :attr:`.Adaptation.window` at most:

    * A **step** shows at once, in more late outputs than chance makes. The latencies before it are
      forgotten; the tail is taken to have grown as much as the median.
    * Every now and then the window is looked at. If its latest cycles lie elsewhere than those
      before, it begins with them. A **drift**, where thirds of it lie apart, is taken out. Then the
      share that is late is compared with the promise. Where hardly any cycle of the window is
      beyond such a share, the generalised Pareto distribution says where it lies.
    * Slots move earlier when far fewer than promised are late, or latencies fall, and that has been
      worth it for :attr:`.Adaptation.after` cycles on end; for twice as many, each time that this
      was wrong and nothing has changed since.
    """

    rules: Adaptation
    promised: float  # the share of outputs that may be late, at most
    start_ns: int  # where the slot begins now
    usual_ns: float  # the median latency as planned
    latest_ns: int  # where the slot may begin at the latest
    earliest_ns: int = 0  # where the slot may begin at the earliest
    # An output behind one that took longer than this waited for that one. So one standstill makes
    # several outputs late, which are no sign that the tail has grown.
    cycle_ns: float = math.inf
    seen: int = 0  # outputs
    _window: deque[float] = field(init=False)
    # Late outputs, each by the value of `seen` when it came.
    _lates: deque[int] = field(default_factory=lambda: deque(maxlen=AT_ONCE[-1]))
    _worth_since: int | None = None  # `seen` when it began to be worth to move earlier
    _earlier_at: int | None = None  # `seen` when the slot last moved earlier
    _after: int = field(init=False)  # for so many cycles it has to be worth it
    _shape: tuple[float, float] = field(init=False)  # median, and latency to aim at

    def __post_init__(self) -> None:
        self._window = deque(maxlen=self.rules.window)
        self._after, self._shape = self.rules.after, (self.usual_ns, float(self.start_ns))

    def add(self, latency_ns: int) -> int | None:
        """Take in the next output; return where the slot begins from now on, None: as before."""
        waited = bool(self._window) and self._window[-1] > self.cycle_ns
        self._window.append(latency_ns)
        self.seen += 1
        if latency_ns > self.start_ns and not waited:
            self._lates.append(self.seen)
            for cycles in AT_ONCE:
                most = most_hits(cycles, min(0.5, self.rules.late * self.promised), DOUBT_AT_ONCE)
                if len(self._lates) > most and self._lates[-most - 1] > self.seen - cycles:
                    return self._step(cycles)
        if self.seen % max(1, self.rules.window // LOOKS) == 0:
            return self._look()
        return None

    def _step(self, cycles: int) -> int | None:
        """Move behind a step: too many of the last ``cycles`` are late for chance.

        The step is where the first of them is late.
        """
        first = next(number for number in self._lates if number > self.seen - cycles)
        new = self._begin_with(1 + self.seen - first)
        usual, aim = self._shape
        error = 1.25 * (aim - usual) / 3 / math.sqrt(new.size)  # of a median, if it were normal
        grown = (float(np.median(new)) + 2 * error) / usual
        return self._move_to(max(aim * grown, float(np.median(new[new > self.start_ns]))))

    def _begin_with(self, latest: int) -> _Floats:
        """Let the window begin with so many latest latencies; remember the shape of the others."""
        window = np.array(self._window, dtype=float)
        before = window[:-latest]
        if before.size >= self.rules.window // 8:
            aim = _beyond(before, AIM * self.promised)[0]
            self._shape = float(np.median(before)), aim
        self._window = deque(window[-latest:], maxlen=self.rules.window)
        self._after, self._worth_since = self.rules.after, None
        return window[-latest:]

    def _look(self) -> int | None:
        """Compare the window with the promise; return where the slot begins, None: as before."""
        size = len(self._window)
        if size < max(LATEST + 1, self.rules.window // 8):
            return None
        now, rise = _without_drift(np.array(self._window, dtype=float))
        low, high = np.quantile(now[:-LATEST], (0.25, 0.75))
        most = most_hits(LATEST, 0.25, DOUBT_AT_ONCE)
        latest = now[-LATEST:]
        if max(np.count_nonzero(latest < low), np.count_nonzero(latest > high)) > most:
            self._begin_with(LATEST)
            return None
        if rise:
            self._after = self.rules.after
        late = int(np.count_nonzero(now > self.start_ns))
        unlikely = most_hits(size, self.promised, DOUBT)
        aim, error = _beyond(now, AIM * self.promised)
        if error:
            if size < self.rules.window:
                return None  # wait until the window is full
            least, least_error = _beyond(now, self.rules.late * self.promised)
            broken = late > unlikely or self.start_ns < least - SURELY * least_error
            aim += SURELY * error if error < math.inf else 0.0
            loose = error < math.inf and self.start_ns > aim
        else:
            broken = late > max(unlikely, self.rules.late * self.promised * size)
            loose = late < most_hits(size, AIM * self.promised, 1 - DOUBT)
        if broken:
            if self._earlier_at and self.seen - self._earlier_at < 2 * self.rules.window:
                self._after *= 2  # it was wrong to move earlier
            return self._move_to(aim)
        could_move_earlier = loose or (rise < 0 and not error)
        if not could_move_earlier or self.start_ns - aim < self.rules.gain * self.start_ns:
            self._worth_since = None
        elif self._worth_since is None:
            self._worth_since = self.seen
        elif self.seen - self._worth_since >= self._after:
            self._earlier_at = self.seen
            return self._move_to(aim, earlier=True)
        return None

    def _move_to(self, start: float, *, earlier: bool = False) -> int | None:
        """Begin there, as far as the slot may, rounded up to whole microseconds.

        Return the new start, None: the slot does not move in the wished direction.
        """
        self._worth_since = None
        wanted = min(self.latest_ns, max(self.earliest_ns, math.ceil(start / 1_000) * 1_000))
        if (wanted < self.start_ns) is not earlier or wanted == self.start_ns:
            return None
        self._lates.clear()
        self.start_ns = wanted
        return wanted


def _without_drift(latencies: _Floats) -> tuple[_Floats, float]:
    """Return the latencies without their drift, as they would be now, and how far they rise.

    They rise from the median of their first third to that of the last; by 0, where the medians
    differ by less than four standard errors.
    """
    third, size = latencies.size // 3, latencies.size
    first, middle, last = latencies[:third], latencies[third : size - third], latencies[-third:]
    rise = float(np.median(last) - np.median(first))
    spread = 1.4826 * float(np.median(np.abs(middle - np.median(middle))))
    if abs(rise) <= 4 * 1.2533 * spread * math.sqrt(2 / third):
        return latencies, 0.0
    return latencies + rise / (size - third) * np.arange(size - 1, -1, -1), rise


def _beyond(latencies: _Floats, share: float) -> tuple[float, float]:
    """Return the latency beyond which a share of a sample lies, and its standard error.

    The error is 0 unless the latency is extrapolated: then it is that of a generalised Pareto tail
    with both parameters estimated. Where the longest latencies do not follow such a tail, return
    the longest with an infinite error.
    """
    if (beyond := int(latencies.size * share)) >= FEWEST_BEYOND:
        place = latencies.size - beyond - 1
        return float(np.partition(latencies, place)[place]), 0.0
    count = int(min(latencies.size ** (2 / 3), MOST_EXCESSES))
    ordered = np.sort(latencies)[-count - 1 :]
    threshold, excesses = ordered[0], (ordered[1:] - ordered[0])[np.newaxis, :]
    fit = l_moment_fit(excesses) if excesses[0, 0] < excesses[0, -1] else None
    if fit is None or anderson_darling(excesses, *fit)[0] > REJECTED:
        return float(ordered[-1]), math.inf
    shape, scale = min(float(not_zero(fit[0])[0]), 0.5), float(fit[1][0])
    logarithm = math.log(max(1.0, count / latencies.size / share))
    by_scale = math.expm1(shape * logarithm) / shape
    by_shape = scale * logarithm**2 / 2
    if abs(shape) >= 1e-6:
        by_shape = scale * (math.exp(shape * logarithm) * logarithm - by_scale) / shape
    factor = 1 + shape
    variance = 2 * (scale * by_scale) ** 2 * factor + (factor * by_shape) ** 2
    variance -= 2 * scale * factor * by_scale * by_shape
    return float(threshold) + scale * by_scale, max(1.0, math.sqrt(max(0.0, variance) / count))
