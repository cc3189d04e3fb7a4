"""The stall meter: a sleeper that notices when the machine itself stood still.

Virtual machines and firmware stop all threads of a core for milliseconds now and then. A thread
at the highest priority that only sleeps and looks at the clock wakes late exactly then; the
figures of a run can only be judged beside what it saw. They run at half their pace as well while
others keep their hardware busy; then the sleeper's wake-ups, which are the same work each time,
take it twice as much CPU time.

One process per core, ``python -m chainshaper.workload.stall_meter``, speaks the launcher's
protocol; ``ENOUGH`` ends its watch early. :func:`stalls_watched` has them watch beside whatever
runs, :func:`measure_stalls` answers "how badly does this machine stall?".
"""

import os
import signal
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from chainshaper.gate.decision import STALL_NS, sleep_until
from chainshaper.linux.scheduling import (
    Scheduling,
    apply_scheduling,
    lock_memory,
    set_thread_name,
    signalled_with_parent,
    stop_garbage_collection,
)
from chainshaper.linux.threads import list_threads
from chainshaper.workload.launcher import (
    ENOUGH,
    Child,
    end_all,
    receive,
    send,
    send_events,
    start_child,
    wait_for_leave,
)

if TYPE_CHECKING:  # a meter is Python alone
    import polars as pl

    from chainshaper.values.recording import StallMeterInfo

PERIOD_NS = 1_000_000
"""A wake-up costs some 20 us on a virtual machine: more of them would disturb what they watch."""
PRIORITY = 98
"""Above everything it watches, so that none of it looks like a stall."""
WAKEUPS_PER_PACE = 10
"""Wake-ups whose CPU time is taken together: reading that clock is a call of the kernel."""
NO_PACE = -1
ORDINARY = 1_000_000
"""So many ordinary wake-ups are enough to know their median, however long a run takes."""
LONGEST_NS = 7 * 24 * 3600 * 1_000_000_000
LEAD_NS = 50_000_000


def watch(
    start_ns: int,
    stop_ns: int,
    period_ns: int = PERIOD_NS,
    threshold_ns: int = STALL_NS,
    enough: Callable[[], bool] = lambda: False,
) -> "tuple[array[int], int, int]":
    """Sleep in steps of ``period_ns`` from ``start_ns`` until ``stop_ns`` or ``enough`` says so.

    Returns what was seen as rows of three, the number of wake-ups, and the median lateness of
    the ordinary ones (all ns). A row is a stall (when it should have woken, how late it was,
    NO_PACE) or the pace of some wake-ups (their beginning, how long they lasted, the CPU time of
    one).
    """
    seen = array("q")
    lateness = array("q")
    clock, cpu_clock = time.monotonic_ns, time.thread_time_ns
    due = since = start_ns
    wakeups, used = 0, cpu_clock()
    while due < stop_ns and not enough():
        sleep_until(due)
        now = clock()
        late = now - due
        wakeups += 1
        if late >= threshold_ns:
            seen.extend((due, late, NO_PACE))
            due += late // period_ns * period_ns  # stay on the grid
        elif len(lateness) < ORDINARY:
            lateness.append(late)
        due += period_ns
        if wakeups % WAKEUPS_PER_PACE == 0:
            used_before, used = used, cpu_clock()
            seen.extend((since, now - since, (used - used_before) // WAKEUPS_PER_PACE))
            since = now
    ordinary = sorted(lateness)
    return seen, wakeups, ordinary[len(ordinary) // 2] if ordinary else 0


def main() -> None:
    """Watch the core this process is put on, as the launcher says."""
    spec = receive()
    signalled_with_parent(spec["parent"], signal.SIGKILL)
    set_thread_name("stall-meter")
    signals: list[int] = []
    signal.signal(ENOUGH, lambda number, _: signals.append(number))
    send(sys.stdout, missing=[], memory_locked=lock_memory())
    times = receive()
    stop_garbage_collection()
    seen, wakeups, ordinary = watch(
        times["meter_from_ns"], times["stop_ns"], enough=lambda: bool(signals)
    )
    send_events(sys.stdout, seen.tobytes(), wakeups=wakeups, median_lateness_ns=ordinary)
    wait_for_leave()


# From outside -----------------------------------------------------------------------------


def far_from(instants_ns: Iterable[int], period_ns: int = PERIOD_NS) -> int:
    """Where in its period a meter is to wake up, to be as far as may be from recurring instants.

    A wake-up takes its core for some 40 us, and delays by that what is published or delivered
    then. Most cycles are whole multiples of the period: there it would do so in every cycle of a
    run, or in none. What happens at a release its gate sees more exactly anyway.

        >>> far_from([20_100_000, 40_200_000], 1_000_000)
        650000

    0 where there are no such instants.
    """
    places = sorted({int(instant) % period_ns for instant in instants_ns})
    if not places:
        return 0
    gaps = [(end - begin, begin) for begin, end in pairwise([*places, places[0] + period_ns])]
    widest, begin = max(gaps, key=lambda gap: gap[0])
    return (begin + widest // 2) % period_ns


def start_meters(cores: Iterable[int], meters: dict[int, Child]) -> None:
    """Start a meter per core into ``meters``, so that those started can be ended whatever fails."""
    for core in sorted(cores):
        module = "chainshaper.workload.stall_meter"
        meters[core] = start_child(f"stall meter of core {core}", module, {})
        meters[core].tell(parent=os.getpid())


def promote_meters(meters: Mapping[int, Child], realtime: bool) -> None:
    """Put each meter on its core, above everything else there if that is permitted."""
    for core, child in meters.items():
        for thread in list_threads(child.pid):
            apply_scheduling(thread, Scheduling(PRIORITY if realtime else None, cores=(core,)))


def read_meters(
    meters: Mapping[int, Child], realtime: bool
) -> "tuple[list[tuple[int, int, bytes]], StallMeterInfo]":
    """What the meters saw: (pid, core, rows of `watch`), and how they watched."""
    from chainshaper.values.recording import StallMeterInfo

    seen, wakeups, lateness = [], 0, []
    for core, child in meters.items():
        answer = child.hear()
        seen.append((child.pid, core, child.hear_bytes(answer["bytes"])))
        wakeups += answer["wakeups"]
        lateness.append(answer["median_lateness_ns"])
    info = StallMeterInfo(
        cores=tuple(meters),
        period_ns=PERIOD_NS,
        threshold_ns=STALL_NS,
        wakeups=wakeups,
        median_lateness_ns=tuple(lateness),
        realtime=realtime,
    )
    return seen, info


@dataclass
class StallWatch:
    """What meters saw, once the watch is over: the `machine_stall` table, and how it was taken."""

    table: "pl.DataFrame | None" = None
    info: "StallMeterInfo | None" = None
    meters: dict[int, Child] = field(default_factory=dict)
    begun: bool = False

    def begin(self, place_ns: int = 0) -> int:
        """Begin to watch, with wake-ups at that place of their period; from when on they do."""
        start = time.monotonic_ns() + LEAD_NS
        start += (place_ns - start) % PERIOD_NS
        for child in self.meters.values():
            child.tell(start_ns=start, meter_from_ns=start, stop_ns=start + LONGEST_NS)
        self.begun = True
        return start


@contextmanager
def stalls_watched(cores: Iterable[int], realtime: bool) -> Iterator[StallWatch]:
    """Watch cores from when the watch is begun until the context ends.

    Raises OperationError: a meter died.
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
            child.process.send_signal(ENOUGH)
        seen, watch.info = read_meters(meters, realtime)
        watch.table, finished = meter_tables(seen)["machine_stall"], True
    finally:
        end_all(meters.values(), patience_s=2.0 if finished else 0.0)


def measure_stalls(
    cores: Iterable[int], duration_ns: int, realtime: bool
) -> "tuple[pl.DataFrame, StallMeterInfo]":
    """Watch cores for a while: the `machine_stall` table, and how it was taken.

    Raises OperationError: a meter died.
    """
    with stalls_watched(cores, realtime) as watch:
        watch.begin()
        time.sleep(duration_ns / 1e9)
    assert watch.table is not None  # noqa: S101 - the watch is over
    assert watch.info is not None  # noqa: S101
    return watch.table, watch.info


def meter_tables(
    seen: Sequence[tuple[int, int, bytes]], seen_by_gates: "pl.DataFrame | None" = None
) -> "dict[str, pl.DataFrame]":
    """`machine_stall` and `machine_pace` from (pid, core, rows of `watch`) per meter.

    What a gate noticed while it watched the clock is added to the stalls.
    """
    import numpy as np
    import polars as pl

    from chainshaper.values import events

    rows = [events.empty("machine_pace").drop("tid")]
    for pid, core, block in seen:
        numbers = np.frombuffer(block, dtype=np.int64).reshape(-1, 3)
        frame = pl.DataFrame(numbers, schema=["time", "duration", "cpu_time"])
        rows.append(frame.with_columns(pid=pl.lit(pid, pl.Int32()), cpu=pl.lit(core, pl.Int32())))
    by_meters = pl.concat(rows, how="diagonal").with_columns(tid=pl.col("pid"))
    is_stall = pl.col("cpu_time") == NO_PACE
    stalls = by_meters.filter(is_stall).select(events.empty("machine_stall").columns)
    paces = by_meters.filter(~is_stall).select(events.empty("machine_pace").columns)
    if seen_by_gates is not None:
        stalls = pl.concat([seen_by_gates, stalls])
    return {
        "machine_stall": stalls.sort("time", maintain_order=True),
        "machine_pace": paces.sort("time", maintain_order=True),
    }


if __name__ == "__main__":
    main()
