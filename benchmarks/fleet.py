"""How fast `check` goes through a fleet's traces: in threads, and on a local Dask cluster.

    python benchmarks/fleet.py [--traces 100] [--events 2000000] [--rounds 3]

Makes a trace of so many events (examples/write_trace.py, scaled), with hard links for the others,
and checks all of them against a budget proposed from it. The efficiency is

    traces × seconds of one alone on one core / (cores × seconds of all)

where "alone" is the median of checks one after the other in a process that has one core only, its
threads included. Rounds alternate; the best and the median are printed. On a machine that others
use, the processor seconds that were there show what could have been reached.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ctf_decode import read_records, scaled
from trace_to_latency import example

from chainshaper.linux.scheduling import available_cores
from chainshaper.sources import open_source
from chainshaper.verify.budgets import check_budgets, load_budget, propose_budget, save_budget

_ALONE = """
import os, statistics, sys, time
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before Polars counts its cores
from pathlib import Path
from chainshaper.verify.budgets import check_budgets, load_budget
trace, budget, taken = [Path(sys.argv[1])], load_budget(sys.argv[2]), []
for _ in range(9):
    started = time.monotonic()
    check_budgets(trace, budget)
    taken.append(time.monotonic() - started)
print(statistics.median(taken[1:]))
"""


def linked(trace: Path, folder: Path, count: int) -> list[Path]:
    """The trace under many names."""
    robots = [folder / f"robot{number:04}" for number in range(count)]
    for robot in robots:
        for file in filter(Path.is_file, trace.rglob("*")):
            place = robot / file.relative_to(trace)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, place)
    return robots


def stolen() -> float:
    """Seconds that the host gave to others since the machine began, over all cores."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--traces", type=int, default=100)
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    from distributed import LocalCluster

    cores = len(available_cores())
    with (
        tempfile.TemporaryDirectory() as temporary,
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=cores, threads_per_worker=1, dashboard_address=None
        ) as cluster,
    ):
        folder = Path(temporary)
        trace = folder / "trace"
        events = scaled(trace, read_records(example(folder)), arguments.events)
        robots = linked(trace, folder, arguments.traces)
        proposed = propose_budget(open_source(trace), ["/image../command"])
        file = save_budget(proposed, folder / "budget.yaml")
        budget = load_budget(file)
        ways = {"threads": None, "Dask, a process per core": cluster.scheduler_address}
        taken: dict[str, list[float]] = {way: [] for way in ways}
        for way in ways.values():  # what is compiled is loaded
            check_budgets(robots[: 2 * cores], budget, scheduler=way)
        for _ in range(arguments.rounds):
            command = [sys.executable, "-c", _ALONE, str(trace), str(file)]
            alone = float(subprocess.run(command, check=True, capture_output=True).stdout)
            for way, scheduler in ways.items():
                started, before = time.monotonic(), stolen()
                check_budgets(robots, budget, scheduler=scheduler)
                seconds = time.monotonic() - started
                taken[way].append(arguments.traces * alone / (cores * seconds))
                print(
                    f"{way}: {arguments.traces} traces of {events} events in {seconds:.1f} s, one "
                    f"alone {alone:.3f} s, {cores} cores, {stolen() - before:.1f} s stolen by the "
                    f"host: efficiency {taken[way][-1]:.0%}; 1,000 take "
                    f"{1000 * seconds / arguments.traces:.0f} s",
                    flush=True,
                )
    for way, found in taken.items():
        print(f"{way}: best {max(found):.0%}, median {statistics.median(found):.0%}")


if __name__ == "__main__":
    main()
