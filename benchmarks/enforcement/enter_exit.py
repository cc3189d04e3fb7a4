"""How exactly the freezer lets threads in and out of their slots, and what that costs.

    python benchmarks/freezer.py [--slots N] [--load]

A SCHED_FIFO thread that reads the clock without pause is gated, and tells when it ran. `enter` is
its first reading behind a slot's start, `exit` its last one behind a slot's end (negative: before
it), `leakage` the share of its time outside of slots. With --load two processes per core compute
beside it. Machine stalls are watched from the other core meanwhile: slots at whose start or end
one was under way are counted, and left out of the second maximum. All figures are of one machine
in one session; nothing is asserted, and the figures to reach stand in the last column.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from chainshaper.enforcement.freezer import Freezer, create
from chainshaper.enforcement.realtime import available_cores, may_use_fifo
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.workload.stall_watch import measure_stalls

MS = 1_000_000
GAP_NS = 200_000
CORE, OTHER_CORE = available_cores()[-1], available_cores()[0]


@dataclass(frozen=True)
class Case:
    """A table to measure with, and which of its servers' threads are started."""

    title: str
    table: ServerTable
    threads: tuple[str, ...]

    @property
    def measured(self) -> ReservationServer:
        """The server whose thread is looked at: the last one."""
        return next(s for s in self.table.servers if s.name == self.threads[-1])


@dataclass(frozen=True)
class Outcome:
    """Times in ns, one per slot; what else was seen."""

    enter: np.ndarray
    leave: np.ndarray
    enter_disturbed: np.ndarray
    leave_disturbed: np.ndarray
    leakage: float
    late_entries: int | None
    cost_per_slot: float
    longest_stall: int
    stalls: int


def cases() -> tuple[Case, ...]:
    def server(name: str, start: float, end: float, core: int = CORE) -> ReservationServer:
        return ReservationServer(name, core, 1, ((int(start * MS), int(end * MS)),))

    many = tuple(server(f"s{number}", number, number + 1) for number in range(32))
    return (
        Case("idle before", ServerTable(10 * MS, (server("a", 3, 7),)), ("a",)),
        Case(
            "taking turns",
            ServerTable(10 * MS, (server("a", 1, 5), server("b", 5, 9))),
            ("a", "b"),
        ),
        Case("32 servers", ServerTable(40 * MS, many), ("s14", "s15", "s16")),
        Case(
            "from another core",
            ServerTable(10 * MS, (server("a", 3, 7, OTHER_CORE),)),
            ("a",),
        ),
    )


def spin(seconds: float, output: Path) -> None:
    """Note when this process runs; SCHED_FIFO before the core, and an end whatever happens."""
    if may_use_fifo():
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()  # until it is gated: it would keep the core from everybody
    os.sched_setaffinity(0, {CORE})
    clock = time.monotonic_ns
    windows = []
    first = last = clock()
    end = last + int(seconds * 1e9)
    while last < end:
        now = clock()
        if now - last > GAP_NS:
            windows.append((first, last))
            first = now
        last = now
    output.write_text(json.dumps(windows))


@contextlib.contextmanager
def spinners(folder: Path, names: tuple[str, ...], seconds: float) -> Iterator[dict[str, int]]:
    """Spinners that wait for a line; their process ids by name."""
    started = {}
    try:
        for name in names:
            command = [sys.executable, __file__, "--spin", str(seconds), str(folder / name)]
            started[name] = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            started[name].stdout.readline()  # type: ignore[union-attr]
        yield {name: process.pid for name, process in started.items()}
        for process in started.values():
            process.stdin.write("go\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]
        for process in started.values():
            process.wait(timeout=seconds + 30)
    finally:
        for process in started.values():
            process.kill()
            process.wait()


@contextlib.contextmanager
def load_beside(wanted: bool) -> Iterator[None]:
    command = [sys.executable, "-c", "x = list(range(200_000))\nwhile True: sorted(x)"]
    count = 2 * len(available_cores()) if wanted else 0
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def cpu_ns(pid: int) -> int:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])


def measure(case: Case, slots: int, folder: Path) -> Outcome:
    seconds = (slots + 5) * case.table.cycle_ns / 1e9
    servers = create(case.table, folder / "run")
    try:
        with (
            ThreadPoolExecutor() as pool,
            spinners(folder, case.threads, seconds) as pids,
        ):
            for name, pid in pids.items():
                servers.assign(pid, name)
            servers.arm(0)
            begin = servers.in_force_from() or 0
            time.sleep(max(0, begin - time.monotonic_ns()) / 1e9)
            watching = pool.submit(measure_stalls, [OTHER_CORE], int(seconds * 1e9), may_use_fifo())
            dispatcher = servers.dispatchers[case.measured.core]
            before, used = total_slots(servers), cpu_ns(dispatcher)
        stalls = watching.result()[0]
        cost = (cpu_ns(dispatcher) - used) / max(1, total_slots(servers) - before)
        late = servers.counters()[case.measured.name].late_entries
    finally:
        servers.release()
    windows = np.array(json.loads((folder / case.threads[-1]).read_text())[1:-1])
    stalled = np.array([stalls["time"].to_numpy(), stalls["duration"].to_numpy()])
    return judge(case, windows, stalled, late, cost)


def total_slots(servers: Freezer) -> int:
    return sum(counters.slots or 0 for counters in servers.counters().values())


def judge(
    case: Case, windows: np.ndarray, stalled: np.ndarray, late: int | None, cost: float
) -> Outcome:
    """Compare the windows in which the thread ran with the slots that it should have run in."""
    ((start, end),) = case.measured.slots
    cycle = case.table.cycle_ns
    number = (windows[:, 0] - start + MS) // cycle
    opened, closed = number * cycle + start, number * cycle + end
    _, first = np.unique(number, return_index=True)
    last = np.append(first[1:], len(number)) - 1
    outside = np.maximum(0, opened - windows[:, 0]) + np.maximum(0, windows[:, 1] - closed)
    return Outcome(
        enter=(windows[:, 0] - opened)[first],
        leave=(windows[:, 1] - closed)[last],
        enter_disturbed=under_way(opened[first], stalled),
        leave_disturbed=under_way(closed[last], stalled),
        leakage=float(outside.sum() / (windows[:, 1] - windows[:, 0]).sum()),
        late_entries=late,
        cost_per_slot=cost,
        longest_stall=int(stalled[1].max(initial=0)),
        stalls=stalled.shape[1],
    )


def under_way(instants: np.ndarray, stalled: np.ndarray) -> np.ndarray:
    """Which instants a stall was near: as far as its own length before and 1 ms behind."""
    begin, late = stalled
    near = (instants[:, None] >= begin - MS) & (instants[:, None] <= begin + late + MS)
    return np.asarray(near.any(axis=1))


def table_of(results: dict[str, Outcome]) -> Table:
    table = Table(title="Freezer: enter and exit error [µs]")
    table.add_column("")
    for title in results:
        table.add_column(title, justify="right")
    table.add_column("to reach", justify="right")

    def row(title: str, target: str, values: list[float], digits: int = 1) -> None:
        table.add_row(title, *[f"{value:.{digits}f}" for value in values], target)

    all_of = list(results.values())
    row("slots", "", [len(o.enter) for o in all_of], 0)
    for percent, target in ((50, "≤ 50"), (99, "")):
        row(f"enter p{percent}", target, [np.percentile(o.enter, percent) / 1000 for o in all_of])
    row("enter max", "", [o.enter.max() / 1000 for o in all_of])
    undisturbed = [o.enter[~o.enter_disturbed] for o in all_of]
    row("enter max, no stall near", "", [e.max(initial=0) / 1000 for e in undisturbed])
    for percent, target in ((50, "≤ 10 (same core)"), (99, "")):
        row(f"exit p{percent}", target, [np.percentile(o.leave, percent) / 1000 for o in all_of])
    row("exit max", "", [o.leave.max() / 1000 for o in all_of])
    undisturbed = [o.leave[~o.leave_disturbed] for o in all_of]
    row("exit max, no stall near", "", [e.max(initial=-(10**9)) / 1000 for e in undisturbed])
    row("leakage [%]", "< 1.5", [100 * o.leakage for o in all_of], 3)
    row("late entries (> 100 µs)", "", [o.late_entries or 0 for o in all_of], 0)
    row("dispatcher's CPU time per slot", "", [o.cost_per_slot / 1000 for o in all_of])
    row("stalls > 100 µs seen", "", [o.stalls for o in all_of], 0)
    row("slots entered near a stall", "", [o.enter_disturbed.sum() for o in all_of], 0)
    row("longest stall", "", [o.longest_stall / 1000 for o in all_of])
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="Enter and exit errors of the freezer.")
    parser.add_argument("--slots", type=int, default=500)
    parser.add_argument("--load", action="store_true", help="two processes per core beside")
    parser.add_argument("--spin", nargs=2, metavar=("SECONDS", "FILE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.spin:
        spin(float(options.spin[0]), Path(options.spin[1]))
        return
    results = {}
    with tempfile.TemporaryDirectory(prefix="chainshaper-benchmark-") as name:
        for case in cases():
            with load_beside(options.load):
                results[case.title] = measure(case, options.slots, Path(name))
    beside = "two busy processes per core beside" if options.load else "nothing of ours beside"
    print(f"{beside}; load average {os.getloadavg()[0]:.1f}")
    Console(width=120).print(table_of(results))


if __name__ == "__main__":
    main()
