"""Statistics of a sample of latencies."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chainshaper.values.durations import milliseconds

PERCENTILES: tuple[float, ...] = (0.5, 1, 5, 25, 50, 75, 95, 99, 99.5)


@dataclass(frozen=True)
class LatencyStatistics:
    """Statistics of a sample of latencies, in whole nanoseconds; None where there is no sample."""

    count: int  # of latencies
    incomplete: int  # of traversals without a latency, less those that met an inactive node
    disturbed: int  # how many of `count` were hit by a stall of the machine
    min_ns: int | None
    mean_ns: int | None
    max_ns: int | None
    jitter_ns: int | None  # max − min (paper: J)
    spread_ns: int | None  # p99.5 − p0.5
    percentiles_ns: dict[str, int]  # by `PERCENTILES` as text; linear between the nearest values
    late: int | None = None  # how many of `count` left behind their slot or cycle; None: not known

    @property
    def text(self) -> str:
        """The most important figures in a line."""
        if self.mean_ns is None or self.max_ns is None or self.jitter_ns is None:
            return f"no complete cycle, {self.incomplete} incomplete"
        figures = ("average", self.mean_ns), ("maximum", self.max_ns), ("jitter", self.jitter_ns)
        parts = [f"{self.count} cycles"]
        parts += [f"{name} {milliseconds(time_ns)} ms" for name, time_ns in figures]
        parts += [f"{self.disturbed} disturbed"] if self.disturbed else []
        parts += [f"{self.incomplete} incomplete"] if self.incomplete else []
        return ", ".join(parts)


def latency_statistics(
    latency_ns: npt.ArrayLike,
    disturbed: npt.ArrayLike | None = None,
    incomplete: int = 0,
    late: int | None = None,
) -> LatencyStatistics:
    """Compute statistics of latencies in ns; ``disturbed`` marks those that a stall hit.

    Disturbed latencies are counted and included. To leave them out, pass only the undisturbed ones.
    """
    sample = np.asarray(latency_ns, dtype=np.int64)
    hit = 0 if disturbed is None else int(np.count_nonzero(np.asarray(disturbed, dtype=bool)))
    if not len(sample):
        return LatencyStatistics(0, incomplete, hit, None, None, None, None, None, {}, late)
    values = np.percentile(sample, PERCENTILES)
    percentiles = {f"{p:g}": round(float(v)) for p, v in zip(PERCENTILES, values, strict=True)}
    low, high, mean = int(sample.min()), int(sample.max()), round(int(sample.sum()) / len(sample))
    spread = percentiles["99.5"] - percentiles["0.5"]
    return LatencyStatistics(
        count=len(sample),
        incomplete=incomplete,
        disturbed=hit,
        min_ns=low,
        mean_ns=mean,
        max_ns=high,
        jitter_ns=high - low,
        spread_ns=spread,
        percentiles_ns=percentiles,
        late=late,
    )
