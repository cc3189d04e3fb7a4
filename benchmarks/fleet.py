"""How fast `check` goes through a fleet's traces: in threads, and on a local Dask cluster of a
worker for each core, which has it alone (`taskset -c N dask worker … --nthreads 1`).

    python benchmarks/fleet.py [--traces 100] [--events 2000000] [--rounds 3]

Makes a trace of so many events (examples/write_trace.py, scaled), with hard links for the others,
and checks all of them against a budget proposed from it. The efficiency is

    traces × seconds of one alone on one core / (cores × seconds of all - what others used)

where "alone" is the median of checks one after the other in a process that has one core only, its
threads included, in processor seconds; and what other processes of the machine used of its cores is
taken out (/proc/stat), since they may be busy. Rounds alternate. A quiet machine's plain
efficiency is the same without that, and stands beside it.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ctf_decode import read_records, scaled
from trace_to_latency import example

from chainshaper.linux.scheduling import available_cores
from chainshaper.monitor.budgets import check_budgets, load_budget, propose_budget, save_budget
from chainshaper.sources import open_source

_ALONE = """
import os, statistics, sys, time
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before Polars counts its cores
from pathlib import Path
from chainshaper.monitor.budgets import check_budgets, load_budget
trace, budget, taken = [Path(sys.argv[1])], load_budget(sys.argv[2]), []
for _ in range(9):
    started = time.process_time()
    check_budgets(trace, budget)
    taken.append(time.process_time() - started)
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


def busy() -> float:
    """Seconds for which the cores were not idle, since the machine began."""
    user, nice, system, _, _, *others = Path("/proc/stat").read_text().split()[1:9]
    return sum(map(int, (user, nice, system, *others))) / os.sysconf("SC_CLK_TCK")


def used(processes: list[int]) -> float:
    """Processor seconds of processes."""
    stats = (Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in processes)
    return sum(int(one[11]) + int(one[12]) for one in stats) / os.sysconf("SC_CLK_TCK")


@contextmanager
def dask_cluster(cores: Iterable[int]) -> Iterator[tuple[str, list[int]]]:
    """A scheduler and its workers: where it listens, and their processes."""
    from distributed import LocalCluster

    dask, options = Path(sys.executable).with_name("dask"), ("--nthreads", "1", "--no-dashboard")
    with LocalCluster(n_workers=0, dashboard_address=None) as cluster, ExitStack() as until:  # type: ignore[no-untyped-call]
        address, workers = cluster.scheduler_address, []
        for core in cores:
            command = ["taskset", "-c", str(core), dask, "worker", address, *options, "--no-nanny"]
            workers.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))
            until.callback(workers[-1].wait)
            until.callback(workers[-1].terminate)
        yield address, [one.pid for one in workers]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--traces", type=int, default=100)
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    cores = len(available_cores())
    with (
        tempfile.TemporaryDirectory() as temporary,
        dask_cluster(available_cores()) as (address, workers),
    ):
        folder = Path(temporary)
        trace = folder / "trace"
        events = scaled(trace, read_records(example(folder)), arguments.events)
        robots = linked(trace, folder, arguments.traces)
        proposed = propose_budget(open_source(trace), ["/image../command"])
        file = save_budget(proposed, folder / "budget.yaml")
        budget = load_budget(file)
        ways = {"threads": None, "Dask, a process per core": address}
        processes = [os.getpid(), *workers]
        taken: dict[str, list[float]] = {way: [] for way in ways}
        for way in ways.values():  # what is compiled is loaded
            check_budgets(robots[: 2 * cores], budget, scheduler=way)
        for _ in range(arguments.rounds):
            command = [sys.executable, "-c", _ALONE, str(trace), str(file)]
            alone = float(subprocess.run(command, check=True, capture_output=True).stdout)
            for way, scheduler in ways.items():
                before, ours, started = busy(), used(processes), time.monotonic()
                check_budgets(robots, budget, scheduler=scheduler)
                seconds, ours = time.monotonic() - started, used(processes) - ours
                others = max(0.0, busy() - before - ours)
                work, there = arguments.traces * alone, cores * seconds
                taken[way].append(work / (there - others))
                print(
                    f"{way}: {arguments.traces} traces of {events} events in {seconds:.1f} s on "
                    f"{cores} cores, of which others used {others / there:.0%}; one alone "
                    f"{alone:.3f} s: efficiency {taken[way][-1]:.0%} ({work / there:.0%} with the "
                    "others); at this pace 1,000 take "
                    f"{1000 * (there - others) / cores / arguments.traces:.0f} s",
                    flush=True,
                )
    for way, found in taken.items():
        print(f"{way}: best {max(found):.0%}, median {statistics.median(found):.0%}")


if __name__ == "__main__":
    main()
