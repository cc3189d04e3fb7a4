"""The stall meter: a sleeper that notices when the machine itself stood still.

Virtual machines and firmware stop all threads of a core for milliseconds now and then. A thread at
the highest priority that only sleeps and looks at the clock wakes up late exactly then. Virtual
machines also run at half their pace while others keep the hardware busy. Then a wake-up, which is
the same work each time, takes twice as much CPU time.

There is a process for each core, ``python -m chainshaper.workload.stall_meter``, to which the
launcher talks (:mod:`chainshaper.workload.launcher`); ``ENOUGH`` ends its watch early.
"""

import os
import signal
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from chainshaper.linux import scheduling
from chainshaper.linux.threads import list_threads
from chainshaper.robot.clocks import sleep_until
from chainshaper.robot.shaper import STALL_NS
from chainshaper.workload import launcher
from chainshaper.workload.launcher import ENOUGH, Child

if TYPE_CHECKING:  # a meter runs with the standard library alone
    import polars as pl

    from chainshaper.values.recording import StallMeterInfo

PERIOD_NS = 1_000_000  # a wake-up costs some 20 us on a virtual machine
PRIORITY = 98  # above everything it watches, so that none of it looks like a stall
WAKEUPS_PER_PACE = 10
"""The CPU time of so many wake-ups is read at once, since reading that clock is a system call."""
NO_PACE = -1  # in place of the CPU time: the row is a stall
ORDINARY = 1_000_000  # so many ordinary wake-ups are enough to know their median
LONGEST_NS = 7 * 24 * 3600 * 1_000_000_000  # of a watch whose end is not given
LEAD_NS = 50_000_000  # a watch begins so much later than it is asked to, at least


def watch(
    start_ns: int,
    stop_ns: int,
    period_ns: int = PERIOD_NS,
    threshold_ns: int = STALL_NS,
    enough: Callable[[], bool] = lambda: False,
) -> "tuple[array[int], int, int]":
    """Sleep in steps of ``period_ns`` from ``start_ns`` until ``stop_ns`` or ``enough`` says so.

    Returns rows of three numbers, the number of wake-ups, and the median lateness of ordinary ones
    (all ns). A row is

    * a stall: when the thread should have woken, how late it was, NO_PACE; or
    * the pace of some wake-ups: when they began, how long they lasted, the CPU time of one.
    """
    seen, lateness = array("q"), array("q")
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
    spec = launcher.receive()
    scheduling.signalled_with_parent(spec["parent"], signal.SIGKILL)
    scheduling.set_thread_name("stall-meter")
    signals: list[int] = []
    signal.signal(ENOUGH, lambda number, _: signals.append(number))
    launcher.send(sys.stdout, ready=scheduling.lock_memory())
    times = launcher.receive()
    scheduling.stop_garbage_collection()
    seen, wakeups, late = watch(times["start_ns"], times["stop_ns"], enough=lambda: bool(signals))
    launcher.send_events(sys.stdout, seen.tobytes(), wakeups=wakeups, median_lateness_ns=late)
    launcher.wait_for_leave()


# From outside


def far_from(instants_ns: Iterable[int], period_ns: int = PERIOD_NS) -> int:
    """Return when in its period a meter is to wake up, as far as possible from recurring instants.

    A wake-up delays what is published or delivered then by some 40 us. Most cycles are whole
    multiples of the period, so it would do so in every cycle of a run.

        >>> far_from([20_100_000, 40_200_000], 1_000_000)
        650000

    Without such instants it is 0.
    """
    places = sorted({int(instant) % period_ns for instant in instants_ns})
    if not places:
        return 0
    gaps = [(end - begin, begin) for begin, end in pairwise([*places, places[0] + period_ns])]
    widest, begin = max(gaps, key=lambda gap: gap[0])
    return (begin + widest // 2) % period_ns


@dataclass
class StallWatch:
    """The meters of some cores and, when the watch is over, what they saw."""

    meters: dict[int, Child] = field(default_factory=dict)  # by core
    seen: list[tuple[int, int, bytes]] = field(default_factory=list)  # pid, core, rows of `watch`
    table: "pl.DataFrame | None" = None  # `machine_stall`
    info: "StallMeterInfo | None" = None
    begun: bool = False

    def begin(self, start_ns: int = 0, stop_ns: int | None = None) -> int:
        """Begin to watch at an instant; return it.

        If it is too soon, or past, that is as few whole periods later as possible.
        """
        soonest = time.monotonic_ns() + LEAD_NS
        start_ns += max(0, -(-(soonest - start_ns) // PERIOD_NS)) * PERIOD_NS
        for child in self.meters.values():
            child.tell(start_ns=start_ns, stop_ns=stop_ns or start_ns + LONGEST_NS)
        self.begun = True
        return start_ns

    def end(self, realtime: bool) -> None:
        """End the watch, and collect what the meters saw."""
        if not self.begun:
            self.begin()
        for child in self.meters.values():
            child.process.send_signal(ENOUGH)
        from chainshaper.values.recording import StallMeterInfo  # here: importing takes a while

        wakeups, lateness = 0, []
        for core, child in self.meters.items():
            answer = child.hear()
            self.seen.append((child.pid, core, child.hear_bytes(answer["bytes"])))
            wakeups += answer["wakeups"]
            lateness.append(answer["median_lateness_ns"])
        self.table = meter_tables(self.seen)["machine_stall"]
        self.info = StallMeterInfo(
            cores=tuple(self.meters),
            period_ns=PERIOD_NS,
            threshold_ns=STALL_NS,
            wakeups=wakeups,
            median_lateness_ns=tuple(lateness),
            realtime=realtime,
        )


@contextmanager
def stalls_watched(cores: Iterable[int], realtime: bool) -> Iterator[StallWatch]:
    """Watch cores, from when the watch is begun until the context ends.

    With ``realtime`` the meters have a priority above everything else. Raises OperationError: a
    meter has ended.
    """
    watch, finished = StallWatch(), False
    try:
        for core in sorted(cores):
            module = "chainshaper.workload.stall_meter"
            watch.meters[core] = launcher.start_child(f"stall meter of core {core}", module, {})
            watch.meters[core].tell(parent=os.getpid())
        for core, child in watch.meters.items():
            child.hear()
            wanted = scheduling.SchedulingRequest(PRIORITY if realtime else None, cores=(core,))
            for thread in list_threads(child.pid):
                scheduling.apply_scheduling(thread, wanted)
        yield watch
        watch.end(realtime)
        finished = True
    finally:
        launcher.end_all(watch.meters.values(), patience_s=2.0 if finished else 0.0)


def measure_stalls(
    cores: Iterable[int], duration_ns: int, realtime: bool
) -> "tuple[pl.DataFrame, StallMeterInfo]":
    """Watch cores for a while; return the `machine_stall` table, and how it was measured.

    Raises OperationError: a meter has ended.
    """
    with stalls_watched(cores, realtime) as watch:
        watch.begin()
        time.sleep(duration_ns / 1e9)
    assert watch.table is not None and watch.info is not None  # noqa: S101 - the watch is over
    return watch.table, watch.info


def meter_tables(
    seen: Sequence[tuple[int, int, bytes]], seen_by_gates: "pl.DataFrame | None" = None
) -> "dict[str, pl.DataFrame]":
    """Make the tables `machine_stall` and `machine_pace` of what meters saw.

    ``seen`` has, of each meter, its pid, its core, and the rows of :func:`watch`. Stalls that gates
    noticed while they watched the clock are added.
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
    stalls, paces = by_meters.filter(is_stall), by_meters.filter(~is_stall)
    tables = {
        "machine_stall": stalls.select(events.empty("machine_stall").columns),
        "machine_pace": paces.select(events.empty("machine_pace").columns),
    }
    if seen_by_gates is not None:
        tables["machine_stall"] = pl.concat([seen_by_gates, tables["machine_stall"]])
    return {name: table.sort("time", maintain_order=True) for name, table in tables.items()}


if __name__ == "__main__":
    main()
