"""Measured latencies, and how far beyond the longest undisturbed one a slot must reach.

**By default** (:func:`covered_latency`) so far that a stated share of *all* cycles is in time, also
of those that the machine disturbed: an actuator does not care who caused a delay. How many of n
measured cycles may lie beyond follows from the binomial distribution alone (Wilks, Annals of
Mathematical Statistics 12, 1941), if the cycles to come are like those measured.

**Beyond the sample** (:func:`derive_margin`) the excesses of latencies over a high threshold u
follow, in the limit, a generalised Pareto distribution (Pickands–Balkema–de Haan). With ζ the share
of latencies above u, ξ the shape and σ the scale, the latency exceeded with probability p is

    x_p = u + σ/ξ · ((ζ/p)^ξ − 1),

and the margin is ε = x_p − L̄, if that is positive. This holds for independent executions of an
unchanging system and such a tail. Each of the three is tested; where one fails there is no number.

The parameters are estimated by L-moments (Hosking and Wallis, Technometrics 29, 1987). They may put
the end of a bounded tail before the longest latency measured, which is then made the end (Dupuis
and Tsao, Communications in Statistics 27, 1998). The goodness of fit (Anderson–Darling) and the
confidence interval come from one parametric bootstrap.

**On line** (:class:`Tail`) the same is estimated from the latencies as they come, so that slots can
follow them: on stationary input a move is the rare exception, however long that lasts.
"""

import math
import warnings
from collections import deque
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.plan import Adaptation, Margin
from chainshaper.values.durations import duration_text, parse_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Publication

LONGEST_NS = 24 * 3_600 * 1_000_000_000  # beyond a day it is a wrong unit, not a latency
EPSILON_NS = 1_000_000  # a margin's beyond latencies: the way to the shaping node is not in them
HOP_NS = 200_000  # so long that way takes: measured 0.07 to 0.2 ms; a gate in the process has none
OVERRUN_PROBABILITY = 0.01  # the share of all cycles that may be late by default, at most

# A tail is the n^(2/3) longest of n latencies, or these parts of it. A fixed share would leave
# large samples with a systematic error.
TAILS = (1.0, 0.85, 0.7, 0.6, 0.5)
FEWEST_EXCESSES, MOST_EXCESSES = 50, 2_000
MOST_PROBABLE = 0.001
SIGNIFICANCE = 0.01  # below it, independence or an unchanging system is given up
GOODNESS = 0.10  # the fit's own test must not come near rejection
CONFIDENCE = 0.95
BOOTSTRAPS = 999
WIDEST_INTERVAL = 0.5  # of the latency itself; wider, the sample does not tell
# On line: what slots are moved to is late in this part of the promised share. Counts that chance
# makes rarer than this are none of chance: looked at once in a while, and with every late output.
AIM = 0.8
DOUBT, DOUBT_AT_ONCE = 1e-6, 1e-9
AT_ONCE = (8, 16, 32, 64, 128)  # so many cycles are looked at for a step
LATEST = 64  # so many are compared with those before
LOOKS = 80  # in a window
FEWEST_BEYOND = 5  # with fewer in the sample, a latency is extrapolated
SURELY = 3.0  # standard errors of what is extrapolated
REJECTED = 1.2  # A² of a tail that is none: p is some 0.01 (Choulakian and Stephens, 2001, table 2)

LEAST_LOG = np.log(1e-12)  # of a probability: a fitted end may stand at the longest excess itself

_Latencies = NDArray[np.int64]
_Floats = NDArray[np.float64]


def read_latencies(path: str | Path) -> _Latencies:
    """End-to-end latencies of a file, in nanoseconds, in the file's order: one duration a line with
    its unit (``59.3ms``; ``#`` begins a comment), or a ``.npy`` file of nanoseconds.

    Raises InputError: no such file, or what cannot be planned with; a wrong line by its number.
    """
    path = Path(path)
    bare = path.suffix == ".npy"
    try:
        latencies = check_latencies(_array(path) if bare else _lines(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError) as error:
        content = "whole nanoseconds in one row, by numpy.save"
        content = content if bare else "a text of one duration a line"
        raise InputError(f"{path}: cannot be read ({error}): write {content}") from error
    except InputError as error:
        # Lines are named already; what concerns the whole sample gets the file's name here.
        named = str(error).startswith(str(path))
        raise InputError(str(error) if named else f"{path}: {error}") from error
    if not latencies.any():
        raise InputError(f"{path}: every latency is 0 ms: check the unit, and what was measured")
    return latencies


def _array(path: Path) -> object:
    """What `numpy.save` wrote. Raises OSError; ValueError: it is damaged, or something else."""
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about headers that Python 2 wrote
            return np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError):
        raise
    except (
        Exception
    ) as error:  # its header is Python, and a damaged one may raise all that Python can
        raise ValueError(f"its header is damaged: {error or type(error).__name__}") from error


def _lines(path: Path) -> _Latencies:
    found = []
    # Spreadsheets begin a file with a byte-order mark.
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        if content := line.partition("#")[0].strip():
            try:
                found.append(parse_duration(content))
            except InputError as error:
                raise InputError(f"{path}:{number}: {error}") from error
            if not 0 <= found[-1] <= LONGEST_NS:
                reason = f"{content} is no latency: write 0 ms or more, up to a day"
                raise InputError(f"{path}:{number}: {reason}")
    return np.array(found, dtype=np.int64)


def least_epsilon_ns(publication: Publication) -> int:
    """ε where the machine does not stall and no other is wished."""
    return EPSILON_NS - (HOP_NS if publication == "in-process" else 0)


def check_latencies(latencies: object) -> _Latencies:
    """A sample that can be planned with: at least two latencies, whole nanoseconds, none negative.

    Raises InputError: anything else, with the first wrong element named by its place from 0.
    """
    array = np.asarray(latencies)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        kind = f"{array.ndim}-dimensional {array.dtype}"
        raise InputError(f"latencies must be one row of numbers in nanoseconds, not {kind}")
    if array.size < 2:
        raise InputError(f"{array.size} latencies are too few to plan with: measure 100 at least")
    for wrong, reason in (
        (~np.isfinite(array), "is not a number: remove it"),
        (array != np.floor(array), "is not a whole number of nanoseconds: convert it"),
        (array < 0, "is negative: a latency is not; check the clocks"),
        (array > LONGEST_NS, f"is longer than {duration_text(LONGEST_NS)}: check the unit"),
    ):
        if wrong.any():
            place = int(np.argmax(wrong))
            raise InputError(f"latency number {place} ({array[place]}) {reason}")
    return array.astype(np.int64)


class TailFit(NamedTuple):
    """The shape of a generalised Pareto tail, the p-value of the Anderson–Darling test of the fit,
    the latency that is exceeded with the probability asked for, and its 95 % confidence interval.
    """

    shape: float
    goodness: float
    latency_ns: int
    interval_ns: tuple[int, int]


def cycles_needed(overrun_probability: float) -> int:
    """The fewest cycles whose longest covers all but so many, with 95 % confidence: 1 − (1 − p)ⁿ.

    >>> cycles_needed(0.01)
    299
    """
    return math.ceil(math.log(1 - CONFIDENCE) / math.log(1 - overrun_probability))


def late_share(every_latency_ns: _Latencies, latency_ns: int) -> float:
    """The share of cycles that take longer than ``latency_ns``, at most, with 95 % confidence
    (Clopper and Pearson's upper bound).
    """
    from scipy.special import betaincinv

    beyond = int(np.count_nonzero(every_latency_ns > latency_ns))
    if beyond == every_latency_ns.size:
        return 1.0
    return float(betaincinv(beyond + 1, every_latency_ns.size - beyond, CONFIDENCE))


def covered_latency(
    latencies_ns: _Latencies, overrun_probability: float, latest_ns: int | None = None
) -> int:
    """The shortest measured latency that covers all cycles but a share, with 95 % confidence (ns).

    It is the k-th longest of n, with the largest k for which P(Bin(n, p) ≥ k) is 95 % at least, or
    the longest of too small a sample; where that is behind ``latest_ns``, the longest that is not.

        >>> covered_latency(np.arange(1, 300), 0.01), covered_latency(np.arange(1, 601), 0.01)
        (299, 599)
    """
    ordered = np.sort(latencies_ns)
    covered = ordered[-max(1, _by_chance(ordered.size, overrun_probability, CONFIDENCE))]
    if latest_ns is not None and covered > latest_ns:
        covered = ordered[ordered <= latest_ns].max(initial=0)
    return int(covered)


def derive_margin(
    latencies_ns: _Latencies, probability: float, seed: int = 0, *, longest_ns: int | None = None
) -> Margin:
    """The margin ε, with its confidence interval, beyond ``longest_ns`` (default: the longest of
    them) with which an execution overruns its slot with the given probability: :func:`fit_tail`.
    """
    fit = fit_tail(latencies_ns, probability, seed)
    longest = int(np.max(latencies_ns)) if longest_ns is None else longest_ns
    low, high = (max(0, end - longest) for end in fit.interval_ns)
    return Margin(
        epsilon_ns=max(0, fit.latency_ns - longest),
        source="derived",
        overrun_probability=probability,
        confidence_interval_ns=(low, high),
    )


def fit_tail(latencies_ns: _Latencies, probability: float, seed: int = 0) -> TailFit:
    """The tail of a sample, in the order of time, above the lowest of a few thresholds of good fit.

    Raises OperationError: the data do not allow an answer: too few, not stationary, not
    independent, no generalised Pareto tail, or an answer too vague to plan with.
    """
    latencies = check_latencies(latencies_ns)
    if not 0 < probability < MOST_PROBABLE:
        reason = f"must be between 0 and {MOST_PROBABLE}"
        raise InputError(f"overrun probability {probability}: {reason}")
    fewest = round(FEWEST_EXCESSES**1.5)
    if latencies.size <= fewest:
        reason = f"{latencies.size} latencies are too few to say anything about rarer ones: measure"
        raise OperationError(f"{reason} more than {fewest} cycles, or give the margin yourself")
    _refuse_not_stationary(latencies)
    ordered = np.sort(latencies)
    longest = min(ordered.size ** (2 / 3), MOST_EXCESSES)
    thresholds = []
    for share in TAILS:
        threshold = int(ordered[-round(share * longest) - 1])
        beyond = ordered[ordered > threshold]
        # Equal latencies may leave too few beyond, or none but equal ones, which have no shape.
        if beyond.size >= FEWEST_EXCESSES and beyond[0] < beyond[-1]:
            thresholds.append(threshold)
    random, best = np.random.default_rng(seed), 0.0
    for threshold in thresholds[:1]:
        _refuse_clusters(latencies, threshold)
    for threshold in thresholds:
        fit = _fit_above(latencies, threshold, probability, random)
        best = max(best, fit.goodness)
        if fit.goodness >= GOODNESS:
            low, high = fit.interval_ns
            if high - low <= WIDEST_INTERVAL * fit.latency_ns:
                return fit
            reason = f"{latencies.size} latencies are too few for an overrun probability of"
            where = f"its latency lies between {duration_text(low)} and {duration_text(high)}"
            remedy = "Measure more cycles, or ask for less"
            raise OperationError(f"{reason} {probability:g}: {where}. {remedy}")
    reason = "the longest latencies do not follow a generalised Pareto distribution above any of"
    remedy = "look for two modes of the application in one recording, or give the margin"
    raise OperationError(f"{reason} {len(thresholds)} thresholds (best p {best:.3f}): {remedy}")


def _fit_above(
    latencies: _Latencies, threshold: int, probability: float, random: np.random.Generator
) -> TailFit:
    from scipy.stats import genpareto  # SciPy takes a moment to import

    excesses = np.sort(latencies[latencies > threshold] - threshold).astype(float)[np.newaxis, :]
    shape, scale = _l_moment_fit(excesses)
    distance = _anderson_darling(excesses, shape, scale)[0]
    share = excesses.size / latencies.size

    size = (BOOTSTRAPS, excesses.size)
    drawn = genpareto.rvs(shape[0], scale=scale[0], size=size, random_state=random)
    drawn.sort(axis=1)
    shapes, scales = _l_moment_fit(drawn)
    distances = _anderson_darling(drawn, shapes, scales)
    shares = random.binomial(latencies.size, share, BOOTSTRAPS) / latencies.size
    quantiles = _quantile(shapes, scales, shares, probability)
    low, high = np.quantile(quantiles, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return TailFit(
        shape=float(shape[0]),
        goodness=float((1 + np.sum(distances >= distance)) / (1 + BOOTSTRAPS)),
        latency_ns=threshold + round(float(_quantile(shape, scale, share, probability)[0])),
        interval_ns=(threshold + round(low), threshold + round(high)),
    )


def _l_moment_fit(ordered: _Floats) -> tuple[_Floats, _Floats]:
    """Shape and scale for each row of ascending excesses.

    With λ₁ the mean and λ₂ half the mean difference of two, ξ = 2 − λ₁/λ₂ and σ = λ₁(1 − ξ). Where
    that distribution would end, at −σ/ξ, before the longest excess, it is made to end there.
    """
    size = ordered.shape[1]
    first = ordered.mean(axis=1)
    second = ordered @ ((2 * np.arange(size) - (size - 1)) / (size * (size - 1)))
    shape = 2 - first / second
    scale = first * (1 - shape)
    return np.maximum(shape, -scale / ordered[:, -1]), scale


def _not_zero(shape: _Floats) -> _Floats:
    """Shapes by which one can divide; what is that near to zero makes no difference."""
    return np.where(np.abs(shape) < 1e-9, 1e-9, shape)


def _quantile(
    shape: _Floats, scale: _Floats, share: float | _Floats, probability: float
) -> _Floats:
    ratio, own = np.log(np.maximum(share / probability, 1.0)), _not_zero(shape)
    result: _Floats = scale * np.expm1(own * ratio) / own
    return result


def _anderson_darling(ordered: _Floats, shape: _Floats, scale: _Floats) -> _Floats:
    """A² of each row of ascending excesses."""
    size, own = ordered.shape[1], _not_zero(shape)[:, np.newaxis]
    with np.errstate(divide="ignore"):  # nothing is beyond the end, nor below the beginning
        above = -np.log1p(np.maximum(-1.0, own * ordered / scale[:, np.newaxis])) / own
        below = np.log(-np.expm1(above))
    weights = (2 * np.arange(1, size + 1) - 1) / size
    logarithms = np.maximum(below, LEAST_LOG) + np.maximum(above[:, ::-1], LEAST_LOG)
    result: _Floats = -size - (logarithms * weights).sum(axis=1)
    return result


def _refuse_not_stationary(latencies: _Latencies) -> None:
    from scipy import stats

    half = latencies.size // 2
    halves = stats.ks_2samp(latencies[:half], latencies[half:], method="asymp").pvalue
    trend = stats.kendalltau(np.arange(latencies.size), latencies).pvalue
    if min(halves, trend) < SIGNIFICANCE / 2:
        reason = f"not stationary (two halves alike: p = {halves:.2g}; no trend: p = {trend:.2g})"
        remedy = "measure after start-up, in one mode and the order of time, or give the margin"
        raise OperationError(f"the latencies are {reason}: {remedy} yourself")


def _refuse_clusters(latencies: _Latencies, threshold: int) -> None:
    from scipy import stats

    above = latencies > threshold
    long, followed = int(above[:-1].sum()), int(np.count_nonzero(above[:-1] & above[1:]))
    share = float(above.mean())
    chance = stats.binomtest(followed, long, share, alternative="greater").pvalue
    if chance < SIGNIFICANCE:
        reason = f"({followed} of {long} are followed by another, p = {chance:.2g})"
        remedy = "as when one delays the next: remove the cause, or give the margin"
        raise OperationError(f"long latencies come in clusters {reason}, {remedy}")


# On line ------------------------------------------------------------------------------------------


@dataclass
class Tail:
    """Where the slot of an output has to begin, from latencies as they come (ns).

    Those later than ``start_ns``, where it begins now, are to be the share ``promised`` at most.
    ``usual_ns`` is the median as planned. An output behind one that took longer than ``cycle_ns``
    waited for that: one standstill makes several late, which are no sign that the tail has grown.

    The window is what came since the last change, :attr:`.Adaptation.window` cycles at most:

    * A **step** shows at once, in more late outputs than chance makes. What came before is
      forgotten; the tail is taken to have grown as much as the median.
    * Every now and then the window is looked at. If its latest cycles lie elsewhere than those
      before, it begins with them. A **drift**, where thirds of it lie apart, is taken out. Then the
      share that is late is compared with the promise; of a share that the window has hardly any
      beyond, the generalised Pareto distribution says.
    * Slots move earlier when far fewer than promised are late, or latencies fall, and that has been
      worth it for :attr:`.Adaptation.after` cycles on end; for twice as many, each time that this
      was wrong and nothing has changed since.
    """

    rules: Adaptation
    promised: float
    start_ns: int
    usual_ns: float
    latest_ns: int
    earliest_ns: int = 0
    cycle_ns: float = math.inf
    seen: int = 0
    _window: deque[float] = field(init=False)
    _lates: deque[int] = field(default_factory=lambda: deque(maxlen=AT_ONCE[-1]))
    _worth_since: int | None = None
    _earlier_at: int | None = None
    _after: int = field(init=False)
    _shape: tuple[float, float] = field(init=False)  # median, and latency to aim at

    def __post_init__(self) -> None:
        self._window = deque(maxlen=self.rules.window)
        self._after, self._shape = self.rules.after, (self.usual_ns, float(self.start_ns))

    def saw(self, latency_ns: int) -> int | None:
        """The next output; where the slot is to begin from now on (None: where it does)."""
        waited = bool(self._window) and self._window[-1] > self.cycle_ns
        self._window.append(latency_ns)
        self.seen += 1
        if latency_ns > self.start_ns and not waited:
            self._lates.append(self.seen)
            for cycles in AT_ONCE:
                most = _by_chance(cycles, min(0.5, self.rules.late * self.promised), DOUBT_AT_ONCE)
                if len(self._lates) > most and self._lates[-most - 1] > self.seen - cycles:
                    return self._step(cycles)
        if self.seen % max(1, self.rules.window // LOOKS) == 0:
            return self._look()
        return None

    def _step(self, cycles: int) -> int | None:
        """Of the last ``cycles`` too many are late, to be chance, from the first late one on."""
        first = next(one for one in self._lates if one > self.seen - cycles)
        new = self._begin_with(1 + self.seen - first)
        usual, aim = self._shape
        error = 1.25 * (aim - usual) / 3 / math.sqrt(new.size)  # of a median, if it were normal
        grown = (float(np.median(new)) + 2 * error) / usual
        return self._move_to(max(aim * grown, float(np.median(new[new > self.start_ns]))))

    def _begin_with(self, latest: int) -> _Floats:
        """So many latencies are the window; of what came before, the shape is remembered."""
        window = np.array(self._window, dtype=float)
        before = window[:-latest]
        if before.size >= self.rules.window // 8:
            aim = _beyond(before, AIM * self.promised)[0]
            self._shape = float(np.median(before)), aim
        self._window = deque(window[-latest:], maxlen=self.rules.window)
        self._after, self._worth_since = self.rules.after, None
        return window[-latest:]

    def _look(self) -> int | None:
        size = len(self._window)
        if size < max(LATEST + 1, self.rules.window // 8):
            return None
        now, rise = _without_drift(np.array(self._window, dtype=float))
        low, high = np.quantile(now[:-LATEST], (0.25, 0.75))
        most = _by_chance(LATEST, 0.25, DOUBT_AT_ONCE)
        latest = now[-LATEST:]
        if max(np.count_nonzero(latest < low), np.count_nonzero(latest > high)) > most:
            self._begin_with(LATEST)
            return None
        if rise:
            self._after = self.rules.after
        late = int(np.count_nonzero(now > self.start_ns))
        unlikely = _by_chance(size, self.promised, DOUBT)
        aim, error = _beyond(now, AIM * self.promised)
        if error:
            if size < self.rules.window:
                return None  # there will be more
            least, its = _beyond(now, self.rules.late * self.promised)
            broken = late > unlikely or self.start_ns < least - SURELY * its
            aim += SURELY * error if error < math.inf else 0.0
            loose = error < math.inf and self.start_ns > aim
        else:
            broken = late > max(unlikely, self.rules.late * self.promised * size)
            loose = late < _by_chance(size, AIM * self.promised, 1 - DOUBT)
        if broken:
            if self._earlier_at and self.seen - self._earlier_at < 2 * self.rules.window:
                self._after *= 2  # that was wrong
            return self._move_to(aim)
        if (
            not (loose or (rise < 0 and not error))
            or self.start_ns - aim < self.rules.gain * self.start_ns
        ):
            self._worth_since = None
        elif self._worth_since is None:
            self._worth_since = self.seen
        elif self.seen - self._worth_since >= self._after:
            self._earlier_at = self.seen
            return self._move_to(aim, earlier=True)
        return None

    def _move_to(self, start: float, *, earlier: bool = False) -> int | None:
        """Begin there, as far as it may, to whole microseconds."""
        self._worth_since = None
        wanted = min(self.latest_ns, max(self.earliest_ns, math.ceil(start / 1_000) * 1_000))
        if (wanted < self.start_ns) is not earlier or wanted == self.start_ns:
            return None
        self._lates.clear()
        self.start_ns = wanted
        return wanted


@cache
def _by_chance(trials: int, probability: float, doubt: float) -> int:
    """The most of independent trials that are hit, but for this doubt. Robots lack SciPy for it."""
    hits = np.arange(trials + 1)
    factorials = np.concatenate([[0.0], np.cumsum(np.log(hits[1:]))])
    logarithm = factorials[-1] - factorials - factorials[::-1]
    logarithm += hits * math.log(probability) + hits[::-1] * math.log1p(-probability)
    beyond = np.cumsum(np.exp(logarithm[::-1]))[::-1]  # the small ones first
    return int(np.count_nonzero(beyond[1:] > doubt))


def _without_drift(latencies: _Floats) -> tuple[_Floats, float]:
    """Latencies in their order as they would be now, and by how much they rise from their first
    third to the last; 0, where the medians differ by less than four standard errors.
    """
    third, size = latencies.size // 3, latencies.size
    first, middle, last = latencies[:third], latencies[third : size - third], latencies[-third:]
    rise = float(np.median(last) - np.median(first))
    spread = 1.4826 * float(np.median(np.abs(middle - np.median(middle))))
    if abs(rise) <= 4 * 1.2533 * spread * math.sqrt(2 / third):
        return latencies, 0.0
    return latencies + rise / (size - third) * np.arange(size - 1, -1, -1), rise


def _beyond(latencies: _Floats, share: float) -> tuple[float, float]:
    """The latency beyond which a share of a sample lies, and, if extrapolated, its standard error.

    The error is that of a generalised Pareto tail with both parameters estimated. Where the longest
    latencies do not look like one, the longest stands for it, with any error.
    """
    if (beyond := int(latencies.size * share)) >= FEWEST_BEYOND:
        place = latencies.size - beyond - 1
        return float(np.partition(latencies, place)[place]), 0.0
    count = int(min(latencies.size ** (2 / 3), MOST_EXCESSES))
    ordered = np.sort(latencies)[-count - 1 :]
    threshold, excesses = ordered[0], (ordered[1:] - ordered[0])[np.newaxis, :]
    fit = _l_moment_fit(excesses) if excesses[0, 0] < excesses[0, -1] else None
    if fit is None or _anderson_darling(excesses, *fit)[0] > REJECTED:
        return float(ordered[-1]), math.inf
    shape, scale = min(float(_not_zero(fit[0])[0]), 0.5), float(fit[1][0])
    logarithm = math.log(max(1.0, count / latencies.size / share))
    by_scale = math.expm1(shape * logarithm) / shape
    by_shape = scale * logarithm**2 / 2
    if abs(shape) >= 1e-6:
        by_shape = scale * (math.exp(shape * logarithm) * logarithm - by_scale) / shape
    one = 1 + shape
    variance = 2 * (scale * by_scale) ** 2 * one + (one * by_shape) ** 2
    variance -= 2 * scale * one * by_scale * by_shape
    return float(threshold) + scale * by_scale, max(1.0, math.sqrt(max(0.0, variance) / count))
