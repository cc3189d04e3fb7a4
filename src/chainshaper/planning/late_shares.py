"""Which share of cycles is late, by a sample: binomial bounds that hold for any distribution.

How many of n measured cycles may lie beyond a latency, of which at most a share p does, follows
from the binomial distribution alone (Wilks, Annals of Mathematical Statistics 12, 1941), if the
cycles to come are like those measured.

**Clusters** (:func:`independent_cycles`): where one long cycle follows another, n cycles tell as
much as n / d independent ones do, where d = 1 + 2 Σ ρ_h is the variance of the number of long
cycles beside that of independent ones (ρ_h: the correlation at h cycles' distance). All bounds hold
with that number in place of n.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

CONFIDENCE = 0.95
# Long cycles are the longest 1/4, 1/8, … of all, FEWEST_LONG of them at least. Pairs of them are
# counted that are at most so many cycles APART.
LONG_CYCLES, FEWEST_LONG = (4, 8, 16, 32, 64, 128, 256), 8
APART = (1, 2, 4, 8, 16, 32, 64, 128)
DOUBT_CLUSTER = 3e-4  # how often chance makes as many pairs of long cycles: rarer is a cluster


def cycles_needed(overrun_probability: float) -> int:
    """Return how many cycles a sample needs so that its longest covers all but such a share.

    With 95 % confidence: the least n with 1 − (1 − p)ⁿ ≥ 0.95.

    >>> cycles_needed(0.01)
    299
    """
    return math.ceil(math.log1p(-CONFIDENCE) / math.log1p(-overrun_probability))


def independent_cycles(latencies_ns: NDArray[np.int64]) -> int:
    """Return how many independent cycles tell as much about long ones as these, in order of time.

    Of the longest quarter, eighth, … of all cycles, count the pairs that are a few cycles apart.
    Where these are more than chance makes of independent cycles, the variance of the number of long
    cycles grows by twice the excess for each of them.
    """
    size, growth = latencies_ns.size, 1.0
    shuffled = np.random.default_rng(0).permutation(size)  # equal latencies rank in any order
    ascending = shuffled[np.argsort(latencies_ns[shuffled], kind="stable")]
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
            expected = apart * count * (count - 1) / size
            if pairs > expected and _poisson_at_least(pairs, expected) < DOUBT_CLUSTER:
                growth = max(growth, 1 + 2 * (pairs - expected) / count)
    return max(1, int(size / growth))


def _poisson_at_least(count: int, mean: float) -> float:
    """Return the probability that a Poisson variable of this ``mean`` is ``count`` or more."""
    term = math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))
    total, number = 0.0, float(count)
    while term > 1e-12 * total or number < mean:
        total += term
        number += 1
        term *= mean / number
    return total


def late_share(every_latency_ns: NDArray[np.int64], latency_ns: int, independent: int = 0) -> float:
    """Return the largest share of cycles that may take longer than ``latency_ns``.

    With 95 % confidence (Clopper and Pearson's upper bound), from the latencies of all cycles.
    ``independent`` is how many cycles the sample is worth; 0: all.

        >>> round(late_share(np.arange(1, 300), 299), 4)
        0.01
    """
    size = every_latency_ns.size
    beyond = int(np.count_nonzero(every_latency_ns > latency_ns))
    trials = independent or size
    return most_probable(math.ceil(beyond * trials / size), trials)


def most_probable(hits: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """Return the largest probability of a hit with which so many of ``trials`` are hit.

    A larger one would make more hits, with this confidence.

    >>> round(most_probable(0, 299), 4)
    0.01
    """
    if hits >= trials:
        return 1.0
    # P(Bin(n, p) ≤ hits) falls with p: halve the interval until it is 1 − confidence. Terms far
    # below the last one are 0.
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
    """Return which longest latency covers all cycles but a share: k of :func:`covered_latency`.

    >>> covering_rank(299, 0.01), covering_rank(473, 0.01)
    (1, 2)
    """
    return max(1, most_hits(independent, overrun_probability, CONFIDENCE))


def covered_latency(
    latencies_ns: NDArray[np.int64],
    overrun_probability: float,
    latest_ns: int | None = None,
    independent: int = 0,
) -> int:
    """Return the shortest measured latency (ns) that covers all cycles but a share.

    It is the k-th longest of n, with the largest k for which P(Bin(n, p) ≥ k) is 95 % at least, or
    the longest, if the sample is too small. Where that is beyond ``latest_ns``, it is the longest
    that is not. ``independent`` is how many cycles the sample is worth, in place of n; 0: all.

        >>> covered_latency(np.arange(1, 300), 0.01), covered_latency(np.arange(1, 601), 0.01)
        (299, 599)
    """
    ordered = np.sort(latencies_ns)
    covered = ordered[-covering_rank(independent or ordered.size, overrun_probability)]
    if latest_ns is not None and covered > latest_ns:
        covered = ordered[ordered <= latest_ns].max(initial=0)
    return int(covered)


@cache
def most_hits(trials: int, probability: float, doubt: float) -> int:
    """Return the largest k for which k or more of independent trials are hit more often than
    ``doubt``. Computed here since robots lack SciPy.
    """
    hits = np.arange(trials + 1)
    factorials = np.concatenate([[0.0], np.cumsum(np.log(hits[1:]))])
    logarithm = factorials[-1] - factorials - factorials[::-1]
    logarithm += hits * math.log(probability) + hits[::-1] * math.log1p(-probability)
    at_least = np.cumsum(np.exp(logarithm[::-1]))[::-1]  # the small terms first
    return int(np.count_nonzero(at_least[1:] > doubt))
