"""A latency sample with the statistics that the paper states for valet parking (table 3, row 1).

The measured latencies were not published; their statistics were: average 67.4 ms, maximum
84.7 ms, jitter 51.8 ms, so minimum 32.9 ms. Rows 4 to 6 of table 3 tell more about the
distribution φ, because eq. 5 must give their averages for the slots of table 4. With outputs
0.6 ms after their slots start, as row 4 (86.6 ms for [86, 87]) has them,

    50.6·φ(51) + 70.6·(φ(71) − φ(51)) + 86.6·(1 − φ(71)) = 76.4      random slots
    62.6·φ(63) + 77.6·(φ(78) − φ(63)) + 86.6·(1 − φ(78)) = 71.3      slots placed by PSO

which φ(51) = 0.02, φ(71) = 0.61 and φ(63) = 0.44, φ(78) = 0.97 solve. The distribution through
these points that also averages 67.4 ms has most of its mass shortly before 63 and before 78 ms:
two modes. :data:`KNOTS` is such a distribution, and the sample is drawn from it with a fixed
seed, its extremes and its average then made exact.

What follows from it for tables 4 and 5 and for figure 7 is thus a test of consistency: slots,
averages and curve of the paper belong to one distribution, which the planner finds again.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["MS", "ORIGIN", "PERIOD_NS", "avp_sample", "synthetic_sample"]

MS = 1_000_000
PERIOD_NS = 100 * MS

ORIGIN = (
    "The paper's latencies are not published: those of valet parking here are drawn from a"
    " distribution\ncalibrated on table 3 (average 67.4, maximum 84.7, jitter 51.8 ms, and the"
    " averages of its rows 4 to 6),\nso what follows tests that the paper's figures are consistent"
    " with each other. It is no measurement."
)

KNOTS = (  # (φ, latency in ms)
    (0.0, 32.9),
    (0.02, 51.0),
    (0.10, 59.3),
    (0.44, 63.0),
    (0.50, 68.0),
    (0.61, 71.0),
    (0.68, 75.6),
    (0.97, 78.0),
    (1.0, 84.7),
)
SAMPLES = 3_000


def avp_sample(samples: int = SAMPLES, seed: int = 1) -> NDArray[np.int64]:
    """End-to-end latencies in ns, in the order of time: average 67.4, maximum 84.7, jitter 51.8."""
    levels, values = np.array(KNOTS).T
    drawn = np.interp(np.random.default_rng(seed).random(samples), levels, values)
    return _pinned(drawn, 32.9, 84.7, 67.4)


def synthetic_sample(samples: int = SAMPLES, seed: int = 1) -> NDArray[np.int64]:
    """The synthetic chain of section 5.2: five callbacks of 5 to 15 ms; maximum 58.5, jitter 33.

    The sum of five uniform execution times, squeezed into the range that the paper measured.
    """
    drawn = np.random.default_rng(seed).uniform(5, 15, (samples, 5)).sum(axis=1)
    low, high = drawn.min(), drawn.max()
    return _in_ns(25.5 + (drawn - low) / (high - low) * 33.0)


def _pinned(drawn: NDArray[np.float64], low: float, high: float, mean: float) -> NDArray[np.int64]:
    """The sample with its extremes and its average made exact.

    What lies between the extremes is bent by c·(x − low)·(high − x), which keeps them in place.
    """
    sample = low + (drawn - drawn.min()) / (drawn.max() - drawn.min()) * (high - low)
    bend = (sample - low) * (high - sample)
    sample = sample + (mean - sample.mean()) / bend.mean() * bend
    return _in_ns(sample)


def _in_ns(milliseconds: NDArray[np.float64]) -> NDArray[np.int64]:
    result: NDArray[np.int64] = np.round(milliseconds * MS).astype(np.int64)
    return result
