"""How far times between hosts are known: latencies as intervals, in a recording of several hosts.

Instants of a host other than the reference were converted to the reference's clock, and may truly
have been earlier or later, as the table `host_clock` says. A time that begins on one host and ends
on another is known to both errors together. One that begins and ends on the same host is known to
how far the host's clock may run faster or slower than by the line it was converted with; unless
that clock jumped meanwhile.
"""

from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.statistics import LatencyStatistics, latency_statistics
from chainshaper.values import events
from chainshaper.values.hosts import Interval, host_of

Times = npt.NDArray[np.int64]

_ROUNDED_NS = 2  # converting both ends


@dataclass(frozen=True)
class BoundedStatistics(LatencyStatistics):
    """Statistics of latencies that are known as intervals; each figure's own interval.

    ``bounds_ns`` has the lowest and the highest value that `min_ns`, `mean_ns`, `max_ns`,
    `jitter_ns` and `spread_ns` may truly have, ``percentile_bounds_ns`` the same of percentiles.
    That of the jitter holds whatever the errors of single latencies are.
    """

    bounds_ns: dict[str, Interval] = field(default_factory=dict)
    percentile_bounds_ns: dict[str, Interval] = field(default_factory=dict)


def bounded_statistics(
    statistics: LatencyStatistics, low: npt.ArrayLike, high: npt.ArrayLike
) -> LatencyStatistics:
    """Add to statistics the intervals that follow from those of all latencies (ns)."""
    lowest, highest = latency_statistics(low), latency_statistics(high)
    values = {each.name: getattr(statistics, each.name) for each in fields(LatencyStatistics)}
    if not lowest.count:
        return statistics
    bounds = {
        name: (int(getattr(lowest, name)), int(getattr(highest, name)))
        for name in ("min_ns", "mean_ns", "max_ns")
    }
    of_percentiles = {
        name: (value, highest.percentiles_ns[name]) for name, value in lowest.percentiles_ns.items()
    }
    bounds["jitter_ns"] = _difference(bounds["max_ns"], bounds["min_ns"])
    bounds["spread_ns"] = _difference(of_percentiles["99.5"], of_percentiles["0.5"])
    return BoundedStatistics(**values, bounds_ns=bounds, percentile_bounds_ns=of_percentiles)


def _difference(larger: Interval, smaller: Interval) -> Interval:
    return max(0, larger[0] - smaller[1]), larger[1] - smaller[0]


def with_intervals(flow: DataFlow, frame: pl.DataFrame, hops: pl.DataFrame) -> pl.DataFrame:
    """Add the intervals of latencies to a frame of traversals, if the recording has several hosts.

    ``frame`` has ``traversal, start, end, publication, received, received_by`` (a process).
    Columns that are added: ``latency_low_ns``, ``latency_high_ns``, and the same two of
    ``reception``; ns, null where there is no latency. ``received_by`` goes.
    """
    clocks = _clocks(flow)
    if clocks is None:
        return frame.drop("received_by")
    first = hops.filter(pl.col("hop") == 0).select("traversal", "instance")
    instance = frame.select("traversal").join(
        first, on="traversal", how="left", maintain_order="left"
    )
    began = host_of(flow.instances["pid"]).gather(instance["instance"])
    ended = host_of(flow.publications["pid"]).gather(frame["publication"])
    latency = _interval(clocks, frame["start"], began, frame["end"], ended)
    received = host_of(frame["received_by"])
    reception = _interval(clocks, frame["start"], began, frame["received"], received)
    return frame.drop("received_by").with_columns(
        latency_low_ns=latency[0],
        latency_high_ns=latency[1],
        reception_low_ns=reception[0],
        reception_high_ns=reception[1],
    )


def with_hop_intervals(flow: DataFlow, hops: pl.DataFrame) -> pl.DataFrame:
    """Add ``communication_low_ns, communication_high_ns``, if the recording has several hosts.

    They are those of the time from the publication before a hop to its start.
    """
    clocks = _clocks(flow)
    if clocks is None or hops.is_empty():
        return hops
    here = host_of(flow.instances["pid"]).gather(hops["instance"])
    before = hops.select("traversal", hop=pl.col("hop") + 1, sent_in="publication")
    rows = hops.select("traversal", "hop").join(
        before, on=["traversal", "hop"], how="left", maintain_order="left"
    )
    there = host_of(flow.publications["pid"]).gather(rows["sent_in"])
    sent = hops["start"] - hops["communication_ns"]
    low, high = _interval(clocks, sent, there, hops["start"], here)
    return hops.with_columns(communication_low_ns=low, communication_high_ns=high)


def hosts_of_chain(flow: DataFlow, callbacks: tuple[int, ...]) -> list[int]:
    """Return the numbers of the hosts on which a chain's callbacks ran, in order."""
    ran = flow.instances.filter(pl.col("callback_id").is_in(callbacks))
    return sorted(host_of(ran["pid"]).unique().drop_nulls().to_list())


def _clocks(flow: DataFlow) -> dict[int, pl.DataFrame] | None:
    """Return the rows of `host_clock` by host; None: the recording has one host."""
    table = events.table(flow.events, "host_clock")
    if table.is_empty():
        return None
    return {int(rows["host"][0]): rows for rows in table.partition_by("host")}


def _interval(
    clocks: dict[int, pl.DataFrame],
    start: pl.Series,
    began: pl.Series,
    end: pl.Series,
    ended: pl.Series,
) -> tuple[pl.Series, pl.Series]:
    """Return the lowest and the highest time from ``start`` on one host to ``end`` on another."""
    absent = start.is_null() | end.is_null() | began.is_null() | ended.is_null()
    starts, ends = (times.fill_null(0).to_numpy() for times in (start, end))
    first, last = (hosts.fill_null(0).to_numpy() for hosts in (began, ended))
    earlier_start, later_start, slack, piece = _errors(clocks, starts, first)
    earlier_end, later_end, _, last_piece = _errors(clocks, ends, last)
    span = ends - starts
    low, high = span - earlier_end - later_start, span + later_end + earlier_start
    one_clock = (first == last) & (piece == last_piece) & (piece >= 0)
    drifted = np.ceil(np.abs(span) * slack).astype(np.int64) + np.where(first > 0, _ROUNDED_NS, 0)
    low = np.where(one_clock, span - drifted, low)
    high = np.where(one_clock, span + drifted, high)
    sides = (pl.Series(np.maximum(low, 0)), pl.Series(np.maximum(high, 0)))
    low_side, high_side = (side.set(absent, None) for side in sides)
    return low_side, high_side


def _errors(
    clocks: dict[int, pl.DataFrame], times: Times, hosts: npt.NDArray[np.int64]
) -> tuple[Times, Times, npt.NDArray[np.float64], Times]:
    """Return how much earlier and later instants may be, the clock's slack, and its piece."""
    earlier, later, piece = (np.zeros(len(times), dtype=np.int64) for _ in range(3))
    slack = np.zeros(len(times))
    for host, rows in clocks.items():
        here = hosts == host
        begins = rows["time"].to_numpy()
        at = np.clip(np.searchsorted(begins, times[here], side="right") - 1, 0, len(begins) - 1)
        slack[here] = rows["slack"].to_numpy()[at] / 1e9
        outside = np.maximum(begins[0] - times[here], 0) + np.maximum(times[here] - begins[-1], 0)
        more = np.ceil(outside * slack[here]).astype(np.int64)
        earlier[here] = rows["earlier"].to_numpy()[at] + more
        later[here] = rows["later"].to_numpy()[at] + more
        piece[here] = rows["piece"].to_numpy()[at]
    return earlier, later, slack, piece
