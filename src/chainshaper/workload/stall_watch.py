"""Watching the machine's own stalls from outside: one stall meter process per core.

Beside a run of the live workload the launcher starts, times and ends the meters with everything
else; :func:`stalls_watched` does it beside whatever else runs, and :func:`measure_stalls` answers
"how badly does this machine stall?".
"""

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.gate.decision import STALL_NS
from chainshaper.linux.scheduling import Scheduling, apply_scheduling
from chainshaper.linux.threads import list_threads
from chainshaper.values import events
from chainshaper.values.recording import StallMeterInfo
from chainshaper.workload import stall_meter
from chainshaper.workload.launcher import Child, end_all, start_child
from chainshaper.workload.stall_meter import NO_PACE

__all__ = [
    "StallWatch",
    "far_from",
    "measure_stalls",
    "meter_tables",
    "promote_meters",
    "read_meters",
    "stalls_watched",
    "start_meters",
]

MODULE = "chainshaper.workload.stall_meter"
LONGEST_NS = 7 * 24 * 3600 * 1_000_000_000
LEAD_NS = 50_000_000


def far_from(instants_ns: npt.ArrayLike, period_ns: int = stall_meter.PERIOD_NS) -> int:
    """Where in its period a meter is to wake up, to be as far as may be from recurring instants.

    A wake-up takes its core for some 40 us, and delays by that what is published or delivered
    then. Most cycles are whole multiples of the period: there it would do so in every cycle of a
    run, or in none. What happens at a release its gate sees more exactly anyway.

        >>> far_from([20_100_000, 40_200_000], 1_000_000)
        650000

    0 where there are no such instants.
    """
    places = np.unique(np.asarray(instants_ns, dtype=np.int64) % period_ns)
    if not len(places):
        return 0
    gaps = np.diff(places, append=places[0] + period_ns)
    widest = int(gaps.argmax())
    return int(places[widest] + gaps[widest] // 2) % period_ns


def start_meters(cores: Iterable[int], meters: dict[int, Child]) -> None:
    """Start a meter per core into ``meters``, so that those started can be ended whatever fails."""
    for core in sorted(cores):
        meters[core] = start_child(f"stall meter of core {core}", MODULE, {})
        meters[core].tell(parent=os.getpid())


def promote_meters(meters: Mapping[int, Child], realtime: bool) -> None:
    """Put each meter on its core, above everything else there if that is permitted."""
    for core, child in meters.items():
        for thread in list_threads(child.pid):
            priority = stall_meter.PRIORITY if realtime else None
            apply_scheduling(thread, Scheduling(priority, cores=(core,)))


def read_meters(
    meters: Mapping[int, Child], realtime: bool
) -> tuple[list[tuple[int, int, bytes]], StallMeterInfo]:
    """What the meters saw: (pid, core, rows of `stall_meter.watch`), and how they watched."""
    seen, wakeups, lateness = [], 0, []
    for core, child in meters.items():
        answer = child.hear()
        seen.append((child.pid, core, child.hear_bytes(answer["bytes"])))
        wakeups += answer["wakeups"]
        lateness.append(answer["median_lateness_ns"])
    info = StallMeterInfo(
        cores=tuple(meters),
        period_ns=stall_meter.PERIOD_NS,
        threshold_ns=STALL_NS,
        wakeups=wakeups,
        median_lateness_ns=tuple(lateness),
        realtime=realtime,
    )
    return seen, info


@dataclass
class StallWatch:
    """What meters saw, once the watch is over: the `machine_stall` table, and how it was taken."""

    table: pl.DataFrame | None = None
    info: StallMeterInfo | None = None
    meters: dict[int, Child] = field(default_factory=dict)
    begun: bool = False

    def begin(self, place_ns: int = 0) -> int:
        """Begin to watch, with wake-ups at that place of their period; from when on they do."""
        start = time.monotonic_ns() + LEAD_NS
        start += (place_ns - start) % stall_meter.PERIOD_NS
        for child in self.meters.values():
            child.tell(start_ns=start, meter_from_ns=start, stop_ns=start + LONGEST_NS)
        self.begun = True
        return start


@contextmanager
def stalls_watched(cores: Iterable[int], realtime: bool) -> Iterator[StallWatch]:
    """Watch cores from when the watch is begun until the context ends.

    Raises:
        OperationError: a meter died.
    """
    watch, finished = StallWatch(), False
    meters = watch.meters
    try:
        start_meters(cores, meters)
        for child in meters.values():
            child.hear()
        promote_meters(meters, realtime)
        yield watch
        if not watch.begun:
            watch.begin()
        for child in meters.values():
            child.process.send_signal(stall_meter.ENOUGH)
        seen, watch.info = read_meters(meters, realtime)
        watch.table, finished = meter_tables(seen)["machine_stall"], True
    finally:
        end_all(meters.values(), patience_s=2.0 if finished else 0.0)


def measure_stalls(
    cores: Iterable[int], duration_ns: int, realtime: bool
) -> tuple[pl.DataFrame, StallMeterInfo]:
    """Watch cores for a while: the `machine_stall` table, and how it was taken.

    Raises:
        OperationError: a meter died.
    """
    with stalls_watched(cores, realtime) as watch:
        watch.begin()
        time.sleep(duration_ns / 1e9)
    assert watch.table is not None  # noqa: S101 - the watch is over
    assert watch.info is not None  # noqa: S101
    return watch.table, watch.info


def meter_tables(
    seen: Sequence[tuple[int, int, bytes]], seen_by_gates: pl.DataFrame | None = None
) -> dict[str, pl.DataFrame]:
    """`machine_stall` and `machine_pace` from (pid, core, rows of `stall_meter.watch`) per meter.

    What a gate noticed while it watched the clock is added to the stalls.
    """
    rows = [
        pl.DataFrame(
            np.frombuffer(block, dtype=np.int64).reshape(-1, 3),
            schema=["time", "duration", "cpu_time"],
        ).with_columns(pl.lit(pid, pl.Int32()).alias("pid"), pl.lit(core, pl.Int32()).alias("cpu"))
        for pid, core, block in seen
    ]
    by_meters = pl.concat([events.empty("machine_pace").drop("tid"), *rows], how="diagonal")
    by_meters = by_meters.with_columns(tid=pl.col("pid"))
    is_stall = pl.col("cpu_time") == NO_PACE
    stalls = by_meters.filter(is_stall).select(events.empty("machine_stall").columns)
    paces = by_meters.filter(~is_stall).select(events.empty("machine_pace").columns)
    if seen_by_gates is not None:
        stalls = pl.concat([seen_by_gates, stalls])
    return {
        "machine_stall": stalls.sort("time", maintain_order=True),
        "machine_pace": paces.sort("time", maintain_order=True),
    }
