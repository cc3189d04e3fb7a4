"""How long messages were under way, without what the simulator counts as costs of its own."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.flow.recorded_description.evidence import Evidence
from chainshaper.flow.recorded_description.timers import EVIDENCE

_LEAST = 0.05  # the quantile of free deliveries that costs are not to exceed


class Costs(NamedTuple):
    """What an executor takes before a callback starts (medians, ns)."""

    wake_up_ns: int  # CPU time from being woken to being at work
    take_ns: int  # from there to a callback


def costs_of(evidence: Evidence) -> Costs:
    """Return what executors take before a callback starts.

    It is what passed between the end of a callback that kept a message waiting, and the start of
    the message's own: a callback of the same thread needs no waking.
    """
    waited = evidence.hops.drop_nulls("kept_ns").with_columns(
        cost=pl.col("delay_ns") - pl.col("kept_ns")
    )
    free = evidence.hops.filter(pl.col("kept_ns").is_null())["delay_ns"]
    most = int(free.quantile(_LEAST) or 0) if len(free) else 1 << 40
    by_same_thread = waited.filter(by_thread=True)["cost"]
    by_others = waited.filter(by_thread=False)["cost"]
    take = 0
    if len(by_same_thread) >= EVIDENCE:
        take = int(by_same_thread.median() or 0)  # type: ignore[arg-type]
    both = take
    if len(by_others) >= EVIDENCE:
        both = int(by_others.median() or 0)  # type: ignore[arg-type]
    take = min(take, most)
    return Costs(max(0, min(both, most) - take), take)


def delivery_times(evidence: Evidence, rows: pl.DataFrame) -> npt.NDArray[np.int64]:
    """Return how long each message was under way, before its thread began to take it (ns).

    Of a message that waited for another callback that is not known: as long as others, though not
    longer than it was kept waiting.
    """
    costs = sum(costs_of(evidence))
    kept_waiting = rows["kept_ns"].is_not_null()
    alone = (rows["delay_ns"] - costs).clip(0).set(kept_waiting, None)
    usual = alone.median()
    shorter = rows["kept_ns"].clip(0, int(usual or 0))
    unseen = rows["before_ns"]  # when its thread began that callback, else it had begun with it
    waited = pl.select(pl.max_horizontal(shorter, unseen)).to_series()
    known = waited.zip_with(kept_waiting, alone)
    filled: npt.NDArray[np.int64] = (
        known.fill_null(int(known.median() or 0)).to_numpy().astype(np.int64)
    )
    return filled
