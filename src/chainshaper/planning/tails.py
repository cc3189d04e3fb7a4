"""How far beyond a sample its tail reaches, where the sample alone is too small to say.

The excesses of latencies over a high threshold u follow, in the limit, a generalised Pareto
distribution (Pickands–Balkema–de Haan). With ζ the share of latencies above u, ξ the shape and σ
the scale, the latency exceeded with probability p is

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
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.late_shares import CONFIDENCE, cycles_needed, independent_cycles
from chainshaper.planning.latencies import check_latencies
from chainshaper.values.errors import OperationError

# A tail is the n^(2/3) longest of n latencies, or these parts of it. A fixed share would leave
# large samples with a systematic error.
TAILS = (1.0, 0.7, 0.5)
FEWEST_EXCESSES, MOST_EXCESSES = 50, 2_000
FEWEST_CYCLES = 1_000  # with fewer, the shape of a heavy tail is too uncertain for any bound
FARTHEST = 10  # a tail is followed to what is so many times as rare as one cycle of the sample
SIGNIFICANCE = 0.01  # below it, the tests say that the system changes
GOODNESS = 0.10  # the fit's own test must not come near rejection
OF_TAIL = 0.99  # quantile of the bootstrapped bounds that is taken: the fit itself may be wrong
BOOTSTRAPS = 499
LEAST_LOG = np.log(1e-12)  # of a probability: a fitted end may stand at the longest excess itself

_Latencies = NDArray[np.int64]
_Floats = NDArray[np.float64]


class TailFit(NamedTuple):
    """A generalised Pareto tail of a sample, and what it says of the probability asked for."""

    shape: float  # ξ
    goodness: float  # p-value of the Anderson–Darling test of the fit
    latency_ns: int  # the estimate of the latency exceeded with that probability
    interval_ns: tuple[int, int]  # bounds on it: 2.5 %, and the upper one that is planned with


def fit_tail(latencies_ns: _Latencies, probability: float, seed: int = 0) -> TailFit:
    """Fit the tail of a sample, which is in the order of time, above a few thresholds.

    The estimate is that above the lowest threshold with a good fit. The upper bound is the largest
    above all of these, with an exponential tail in place of a lighter one, and not below the
    longest latency measured.

    Raises OperationError: the sample allows no answer: it is too small, not stationary, not
    independent, or has no generalised Pareto tail. The message says how many cycles would do.
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
        # Equal latencies may leave too few beyond it, or only equal ones, which have no shape.
        if beyond.size >= FEWEST_EXCESSES and beyond[0] < beyond[-1]:
            thresholds.append(threshold)
    random = np.random.default_rng(seed)
    fits = [_fit_above(latencies, threshold, probability, random) for threshold in thresholds]
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
    """Say what would make an answer possible: more cycles, or a promise that these can give."""
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
    """Fit the excesses over one threshold; bootstrap the goodness of fit and the bounds."""
    excesses = np.sort(latencies[latencies > threshold] - threshold).astype(float)[np.newaxis, :]
    shape, scale = l_moment_fit(excesses)
    distance = anderson_darling(excesses, shape, scale)[0]
    share = excesses.size / latencies.size

    uniform = random.random((BOOTSTRAPS, excesses.size))
    drawn = scale * np.expm1(-not_zero(shape) * np.log1p(-uniform)) / not_zero(shape)
    drawn.sort(axis=1)
    shapes, scales = l_moment_fit(drawn)
    distances = anderson_darling(drawn, shapes, scales)
    shares = random.binomial(latencies.size, share, BOOTSTRAPS) / latencies.size
    low = np.quantile(_quantile(shapes, scales, shares, probability), (1 - CONFIDENCE) / 2)
    # In place of a lighter tail take an exponential one of the same mean.
    scales = np.where(shapes < 0, scales / (1 - np.minimum(shapes, 0.0)), scales)
    bounds = _quantile(np.maximum(shapes, 0.0), scales, shares, probability)
    high = np.quantile(bounds, OF_TAIL)
    return TailFit(
        shape=float(shape[0]),
        goodness=float((1 + np.sum(distances >= distance)) / (1 + BOOTSTRAPS)),
        latency_ns=threshold + round(float(_quantile(shape, scale, share, probability)[0])),
        interval_ns=(threshold + round(low), threshold + round(high)),
    )


def l_moment_fit(ordered: _Floats) -> tuple[_Floats, _Floats]:
    """Return shape and scale for each row of ascending excesses.

    With λ₁ the mean and λ₂ half the mean difference of two excesses, ξ = 2 − λ₁/λ₂ and σ = λ₁(1 −
    ξ). A distribution that would end, at −σ/ξ, before the longest excess is made to end there.
    """
    size = ordered.shape[1]
    first = ordered.mean(axis=1)
    second = ordered @ ((2 * np.arange(size) - (size - 1)) / (size * (size - 1)))
    shape = 2 - first / second
    scale = first * (1 - shape)
    return np.maximum(shape, -scale / ordered[:, -1]), scale


def not_zero(shape: _Floats) -> _Floats:
    """Return the shapes, without any so near to zero that dividing by it would fail.

    The difference to the true shape changes no result.
    """
    return np.where(np.abs(shape) < 1e-9, 1e-9, shape)


def _quantile(
    shape: _Floats, scale: _Floats, share: float | _Floats, probability: float
) -> _Floats:
    """Return by how much x_p is beyond the threshold, of which this share is above."""
    ratio, divisor = np.log(np.maximum(share / probability, 1.0)), not_zero(shape)
    result: _Floats = scale * np.expm1(divisor * ratio) / divisor
    return result


def anderson_darling(ordered: _Floats, shape: _Floats, scale: _Floats) -> _Floats:
    """Return A², the distance of each row of ascending excesses from its fit."""
    size, divisor = ordered.shape[1], not_zero(shape)[:, np.newaxis]
    with np.errstate(divide="ignore"):  # the fit has no probability beyond its end
        above = -np.log1p(np.maximum(-1.0, divisor * ordered / scale[:, np.newaxis])) / divisor
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
    """Return the p-value of Kolmogorov and Smirnov's test (its limit) that two halves are alike."""
    half = latencies.size // 2
    first, second = np.sort(latencies[:half]), np.sort(latencies[half:])
    shares = [np.searchsorted(part, latencies, "right") / part.size for part in (first, second)]
    apart = float(np.abs(shares[0] - shares[1]).max())
    scaled = apart * math.sqrt(half * (latencies.size - half) / latencies.size)
    if scaled < 0.2:  # the series converges slowly there, and to 1
        return 1.0
    terms = (2 * (-1) ** (k - 1) * math.exp(-2 * (k * scaled) ** 2) for k in range(1, 101))
    return float(np.clip(sum(terms), 0.0, 1.0))


def _no_trend(latencies: _Latencies) -> float:
    """Return the p-value of Spearman's rank correlation of the latencies with time."""
    _, places, counts = np.unique(latencies, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[places]  # equal latencies: the middle rank
    if counts.size == 1:
        return 1.0
    correlation = float(np.corrcoef(np.arange(latencies.size), ranks)[0, 1])
    return math.erfc(abs(correlation) * math.sqrt((latencies.size - 1) / 2))
