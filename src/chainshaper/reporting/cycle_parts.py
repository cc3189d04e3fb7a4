"""Which cycles pictures show where a recording has many, and how each one's latency adds up.

PNG figures and the report's charts are drawn from these same numbers.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.analysis import LatencyAnalysis
from chainshaper.verify.measure import PARTS, cycle_parts

OPACITY = {"communication": 0.35, "computation": 1.0, "waiting": 0.15}
"""How the parts of a hop look, in the hop's colour; in the order in which they are stacked."""


@dataclass(frozen=True)
class StackedCycles:
    """The latency of cycles as the sum of the parts of their hops."""

    cycles: NDArray[np.int64]  # numbers of the traversals, in order
    disturbed: NDArray[np.bool_]
    parts_ns: dict[str, NDArray[np.int64]]  # part → a row per cycle, a column per hop
    complete: int  # how many complete cycles the recording has

    @property
    def latency_ns(self) -> NDArray[np.int64]:
        """The latency of each cycle: the sum of all its parts."""
        rows = [parts.sum(axis=1) for parts in self.parts_ns.values()]
        return np.asarray(np.sum(rows, axis=0), dtype=np.int64)


def drawn_cycles(traversals: pl.DataFrame, limit: int) -> pl.DataFrame:
    """Select the complete traversals that a picture shows, about ``limit`` at most.

    Of every stretch the shortest and the longest, disturbed and not, and of the others every n-th.
    """
    complete = traversals.filter("complete")
    if complete.height <= limit:
        return complete
    stretches = max(1, limit // 8)  # two extremes each of two kinds: half of the cycles
    stretch = (pl.int_range(pl.len()) * stretches // pl.len()).alias("stretch")
    rows = complete.select("disturbed", "latency_ns", stretch).with_row_index("row")
    latency, groups = pl.col("latency_ns"), rows.group_by("stretch", "disturbed")
    places = (latency.arg_min(), latency.arg_max())
    extremes = [groups.agg(pl.col("row").get(place))["row"] for place in places]
    sample = pl.arange(0, complete.height, -(-2 * complete.height // limit), eager=True)
    drawn: pl.DataFrame = complete[pl.concat([*extremes, sample.cast(pl.UInt32)]).unique().sort()]
    return drawn


def stacked_cycles(analysis: LatencyAnalysis, limit: int) -> StackedCycles:
    """Return the parts of each hop in the cycles that a picture shows (:func:`drawn_cycles`)."""
    drawn = drawn_cycles(analysis.traversals, limit)
    parts = cycle_parts(analysis).join(drawn, on="traversal", how="semi", maintain_order="left")
    shape = (drawn.height, len(analysis.chain.callbacks))
    return StackedCycles(
        cycles=drawn["traversal"].to_numpy().astype(np.int64),
        disturbed=drawn["disturbed"].to_numpy(),
        parts_ns={part: parts[f"{part}_ns"].to_numpy().reshape(shape) for part in PARTS},
        complete=int(analysis.traversals["complete"].sum()),
    )
