"""Measured latencies, and how far beyond the longest undisturbed one a slot must reach.

**By default** (:func:`covered_latency`) so far that a stated share of *all* cycles is in time, also
of those that the machine disturbed: an actuator does not care who caused a delay. How many of n
measured cycles may lie beyond follows from the binomial distribution alone (Wilks, Annals of
Mathematical Statistics 12, 1941), if the cycles to come are like those measured.

**Clusters** (:func:`independent_cycles`): where one long cycle follows another, n cycles tell as
much as n / d independent ones do, where d = 1 + 2 Σ ρ_h is the variance of the number of long
cycles beside that of independent ones (ρ_h: the correlation at h cycles' distance). All of the
above holds with that number in place of n.

**Beyond the sample** (:func:`fit_tail`) the excesses of latencies over a high threshold u follow,
in the limit, a generalised Pareto distribution (Pickands–Balkema–de Haan). With ζ the share of
latencies above u, ξ the shape and σ the scale, the latency exceeded with probability p is

    x_p = u + σ/ξ · ((ζ/p)^ξ − 1).

This holds for independent executions of an unchanging system and such a tail. Each of the three is
tested; where one fails there is no number. The parameters are estimated by L-moments (Hosking and
Wallis, Technometrics 29, 1987). They may put the end of a bounded tail before the longest latency
measured, which is then made the end (Dupuis and Tsao, Communications in Statistics 27, 1998). The
goodness of fit (Anderson–Darling) and the bounds come from one parametric bootstrap.

**What is planned is a bound, not the estimate.** The upper end of x_p is taken with no tail lighter
than an exponential one, over all thresholds above which the fit is good, and not farther than to a
:data:`FARTHEST` part of what the sample has one cycle of: an estimate alone is too low in half of
all plans, and one that passes a test of its own width is too low in most. So the promise holds in
95 % of plans (`experiments/promises.py`), and less risk never gives an earlier slot.

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

from chainshaper.planning.chain_plan import Adaptation, Margin
from chainshaper.values.durations import duration_text, parse_duration
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Publication

LONGEST_NS = 24 * 3_600 * 1_000_000_000  # beyond a day it is a wrong unit, not a latency
EPSILON_NS = 1_000_000  # a margin's beyond latencies: the way to the shaping node is not in them
HOP_NS = 200_000  # so long that way takes: measured 0.07 to 0.2 ms; a gate in the process has none
OVERRUN_PROBABILITY = 0.01  # the share of all cycles that may be late by default, at most

# A tail is the n^(2/3) longest of n latencies, or these parts of it. A fixed share would leave
# large samples with a systematic error.
TAILS = (1.0, 0.7, 0.5)
FEWEST_EXCESSES, MOST_EXCESSES = 50, 2_000
FEWEST_CYCLES = 1_000  # with fewer, the shape of a heavy tail is too uncertain for any bound
FARTHEST = 10  # times as rare as one cycle of the sample: so far a tail is followed
SIGNIFICANCE = 0.01  # below it, an unchanging system is given up
GOODNESS = 0.10  # the fit's own test must not come near rejection
CONFIDENCE = 0.95
WELL_COVERED = 0.99  # confidence of a smaller share of late outputs than was asked for
OF_TAIL = 0.99  # of the bound on a tail: what the fit itself may be wrong by comes on top
BOOTSTRAPS = 499
# Long cycles are the longest such parts of all; they are counted together so many cycles apart.
LONG_CYCLES, FEWEST_LONG = (4, 8, 16, 32, 64, 128, 256), 8
APART = (1, 2, 4, 8, 16, 32, 64, 128)
DOUBT_CLUSTER = 3e-4  # more pairs of long cycles than chance makes in so many samples
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
    the latency that is exceeded with the probability asked for, and the bounds on it: 2.5 %, and
    the upper one that is planned with.
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
    return math.ceil(math.log1p(-CONFIDENCE) / math.log1p(-overrun_probability))


def independent_cycles(latencies_ns: _Latencies) -> int:
    """As many independent cycles tell as much about long ones as these do, in the order of time.

    Of the longest quarter, eighth, … the pairs are counted that are a few cycles apart. Where they
    are more than chance makes of independent cycles, the variance of the number of long cycles
    grows by twice the excess for each of them.
    """
    size, growth = latencies_ns.size, 1.0
    drawn = np.random.default_rng(0).permutation(size)  # which of equal ones are the longer
    ascending = drawn[np.argsort(latencies_ns[drawn], kind="stable")]
    for part in LONG_CYCLES:
        count = size // part
        if count < FEWEST_LONG:
            break
        places = np.sort(ascending[-count:])
        for apart in APART:
            if apart > size // 20:
                break
            within = np.searchsorted(places, places + apart, side="right")
            pairs = int((within - np.arange(1, count + 1)).sum())
            by_chance = apart * count * (count - 1) / size
            if pairs > by_chance and _more_than(pairs, by_chance) < DOUBT_CLUSTER:
                growth = max(growth, 1 + 2 * (pairs - by_chance) / count)
    return max(1, int(size / growth))


def _more_than(count: int, mean: float) -> float:
    """The probability that a Poisson variable of this ``mean`` is ``count`` or more."""
    term = math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))
    total, number = 0.0, float(count)
    while term > 1e-12 * total or number < mean:
        total += term
        number += 1
        term *= mean / number
    return total


def late_share(every_latency_ns: _Latencies, latency_ns: int, independent: int = 0) -> float:
    """The share of cycles that take longer than ``latency_ns``, at most, with 95 % confidence
    (Clopper and Pearson's upper bound); of cycles that are worth so many ``independent`` ones.

        >>> round(late_share(np.arange(1, 300), 299), 4)
        0.01
    """
    size = every_latency_ns.size
    beyond = int(np.count_nonzero(every_latency_ns > latency_ns))
    trials = independent or size
    return most_probable(math.ceil(beyond * trials / size), trials)


def most_probable(hits: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """The probability of a hit, at most, with 95 % confidence, where so many trials had ``hits``.

    >>> round(most_probable(0, 299), 4)
    0.01
    """
    if hits >= trials:
        return 1.0
    # P(Bin(n, p) ≤ hits) falls with p, to what is not confident. Far below the last, terms are 0.
    low, high = hits / trials, 1.0
    logarithms = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, trials + 1)))])
    few = np.arange(max(0, hits - 40 * math.isqrt(trials) - 40), hits + 1)
    ways = logarithms[-1] - logarithms[few] - logarithms[trials - few]
    for _ in range(60):
        share = (low + high) / 2
        terms = ways + few * math.log(share) + (trials - few) * math.log1p(-share)
        low, high = (share, high) if np.exp(terms).sum() > 1 - confidence else (low, share)
    return high


def covering_rank(independent: int, overrun_probability: float) -> int:
    """Which longest latency covers all cycles but a share: the largest k of
    :func:`covered_latency`.

    >>> covering_rank(299, 0.01), covering_rank(473, 0.01)
    (1, 2)
    """
    return max(1, _by_chance(independent, overrun_probability, CONFIDENCE))


def covered_latency(
    latencies_ns: _Latencies,
    overrun_probability: float,
    latest_ns: int | None = None,
    independent: int = 0,
) -> int:
    """The shortest measured latency that covers all cycles but a share, with 95 % confidence (ns).

    It is the k-th longest of n, with the largest k for which P(Bin(n, p) ≥ k) is 95 % at least, or
    the longest of too small a sample; where that is behind ``latest_ns``, the longest that is not.
    In place of n are the ``independent`` cycles that the sample is worth, where they are known.

        >>> covered_latency(np.arange(1, 300), 0.01), covered_latency(np.arange(1, 601), 0.01)
        (299, 599)
    """
    ordered = np.sort(latencies_ns)
    covered = ordered[-covering_rank(independent or ordered.size, overrun_probability)]
    if latest_ns is not None and covered > latest_ns:
        covered = ordered[ordered <= latest_ns].max(initial=0)
    return int(covered)


def derive_margin(
    latencies_ns: _Latencies,
    probability: float,
    seed: int = 0,
    *,
    longest_ns: int | None = None,
    least_ns: int = EPSILON_NS,
) -> Margin:
    """The margin ε beyond ``longest_ns`` (default: the longest of them) with which a cycle is late
    with the given probability, at most: ``least_ns`` behind the latency that covers it.

    Where the sample is large enough, that is one of its own latencies, without any assumption
    (:func:`covered_latency`), otherwise the bound on its tail (:func:`fit_tail`). Less risk never
    gives an earlier slot. Raises OperationError: the sample cannot say; how many cycles could.
    """
    latencies = check_latencies(latencies_ns)
    if not 0 < probability < 1:
        raise InputError(f"an overrun probability of {probability}: write one between 0 and 1")
    longest = int(latencies.max()) if longest_ns is None else longest_ns
    independent = independent_cycles(latencies)
    interval = None
    if independent >= cycles_needed(probability):
        covered = covered_latency(latencies, probability, independent=independent)
    else:
        low, covered = fit_tail(latencies, probability, seed).interval_ns
        interval = (max(0, low - longest) + least_ns, max(0, covered - longest) + least_ns)
    beyond = max(0, covered - longest)
    return Margin(
        epsilon_ns=least_ns + beyond,
        source="measured" if interval is None else "derived",
        overrun_probability=probability,
        stalls_ns=beyond if interval is None else 0,
        confidence_interval_ns=interval,
        independent_cycles=independent if independent < latencies.size else None,
    )


def fit_tail(latencies_ns: _Latencies, probability: float, seed: int = 0) -> TailFit:
    """The tail of a sample, in the order of time, over a few thresholds of good fit.

    The estimate is that above the lowest of them; the upper bound is the largest of all, with an
    exponential tail in place of a lighter one, and not below the longest latency measured.

    Raises OperationError: the data do not allow an answer: too few, not stationary, not
    independent, or no generalised Pareto tail; and how many cycles would.
    """
    latencies = check_latencies(latencies_ns)
    _refuse_too_few(latencies, probability)
    _refuse_not_stationary(latencies, probability)
    ordered = np.sort(latencies)
    longest = min(ordered.size ** (2 / 3), MOST_EXCESSES)
    thresholds = []
    for share in TAILS:
        threshold = int(ordered[-round(share * longest) - 1])
        beyond = ordered[ordered > threshold]
        # Equal latencies may leave too few beyond, or none but equal ones, which have no shape.
        if beyond.size >= FEWEST_EXCESSES and beyond[0] < beyond[-1]:
            thresholds.append(threshold)
    random, fits = np.random.default_rng(seed), list[TailFit]()
    fits = [_fit_above(latencies, one, probability, random) for one in thresholds]
    good = [fit for fit in fits if fit.goodness >= GOODNESS]
    if not good:
        best = max((fit.goodness for fit in fits), default=0.0)
        raise OperationError(
            "the longest latencies do not follow a generalised Pareto distribution above any of"
            f" {len(fits)} thresholds (best p {best:.3f}). {_remedy(latencies.size, probability)}."
            " Or look for two modes of the application in one recording"
        )
    upper = max(int(ordered[-1]), *(fit.interval_ns[1] for fit in good))
    first = good[0]
    return first._replace(interval_ns=(min(first.interval_ns[0], upper), upper))


def _refuse_too_few(latencies: _Latencies, probability: float) -> None:
    size, independent = latencies.size, independent_cycles(latencies)
    asked = f"an overrun probability of {probability:g}"
    if independent < size:
        needed = math.ceil(cycles_needed(probability) * size / independent)
        raise OperationError(
            f"long latencies come in clusters, as when one delays the next: {size} cycles tell as"
            f" much as {independent} independent ones, too few for {asked}. Remove the cause,"
            f" measure {needed} cycles, or give the margin (--epsilon)"
        )
    if size < FEWEST_CYCLES or size * FARTHEST * probability < 1:
        raise OperationError(f"{size} cycles are too few for {asked}. {_remedy(size, probability)}")


def _remedy(size: int, probability: float) -> str:
    """What would make an answer possible: more cycles, or a promise that these can give."""
    by_tail = max(FEWEST_CYCLES, math.ceil(round(1 / (FARTHEST * probability), 6)))
    needed, shown = cycles_needed(probability), 1 - (1 - CONFIDENCE) ** (1 / size)
    cycles = f"{needed} cycles, with which it holds for any distribution"
    if size < by_tail < needed:
        cycles = f"{by_tail} cycles, if their tail is regular, or {cycles}"
    least = math.ceil(shown * 1e6) / 1e6
    return f"Measure {cycles}; or ask for {least:g} or more, which {size} cycles show"


def _fit_above(
    latencies: _Latencies, threshold: int, probability: float, random: np.random.Generator
) -> TailFit:
    excesses = np.sort(latencies[latencies > threshold] - threshold).astype(float)[np.newaxis, :]
    shape, scale = _l_moment_fit(excesses)
    distance = _anderson_darling(excesses, shape, scale)[0]
    share = excesses.size / latencies.size

    uniform = random.random((BOOTSTRAPS, excesses.size))
    drawn = scale * np.expm1(-_not_zero(shape) * np.log1p(-uniform)) / _not_zero(shape)
    drawn.sort(axis=1)
    shapes, scales = _l_moment_fit(drawn)
    distances = _anderson_darling(drawn, shapes, scales)
    shares = random.binomial(latencies.size, share, BOOTSTRAPS) / latencies.size
    low = np.quantile(_quantile(shapes, scales, shares, probability), (1 - CONFIDENCE) / 2)
    # An exponential tail of the same mean stands for a lighter one.
    scales = np.where(shapes < 0, scales / (1 - np.minimum(shapes, 0.0)), scales)
    bounds = _quantile(np.maximum(shapes, 0.0), scales, shares, probability)
    high = np.quantile(bounds, OF_TAIL)
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


def _refuse_not_stationary(latencies: _Latencies, probability: float) -> None:
    halves, trend = _halves_alike(latencies), _no_trend(latencies)
    if min(halves, trend) < SIGNIFICANCE / 2:
        raise OperationError(
            f"the latencies are not stationary (two halves alike: p = {halves:.2g}; no trend:"
            f" p = {trend:.2g}): measure after start-up, in one mode and the order of time, or"
            f" give the margin (--epsilon). Without a tail, {probability:g} needs"
            f" {cycles_needed(probability)} cycles"
        )


def _halves_alike(latencies: _Latencies) -> float:
    """The p-value of Kolmogorov and Smirnov's test (its limit) that two halves are alike."""
    half = latencies.size // 2
    first, second = np.sort(latencies[:half]), np.sort(latencies[half:])
    shares = [np.searchsorted(part, latencies, "right") / part.size for part in (first, second)]
    apart = float(np.abs(shares[0] - shares[1]).max())
    scaled = apart * math.sqrt(half * (latencies.size - half) / latencies.size)
    if scaled < 0.2:  # the series converges slowly there, and to one
        return 1.0
    terms = (2 * (-1) ** (k - 1) * math.exp(-2 * (k * scaled) ** 2) for k in range(1, 101))
    return float(np.clip(sum(terms), 0.0, 1.0))


def _no_trend(latencies: _Latencies) -> float:
    """The p-value of Spearman's rank correlation of the latencies with time."""
    _, places, counts = np.unique(latencies, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[places]  # of equal ones the middle
    if counts.size == 1:
        return 1.0
    correlation = float(np.corrcoef(np.arange(latencies.size), ranks)[0, 1])
    return math.erfc(abs(correlation) * math.sqrt((latencies.size - 1) / 2))


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
