"""How fast a trace becomes chain latencies, against iterating it with babeltrace2's Python API.

    python benchmarks/trace_to_latency.py [--trace FOLDER --chain CHAIN] [--events 2000000 …]

Scales a trace (by default the one of examples/write_trace.py) to each number of events and prints
a table. Every row is a fresh process of ours from its start to its end: Python's own start,
importing, opening, decoding, data flow, traversals, the statistics of one chain. The reference is
a Python loop over ``bt2.TraceCollectionMessageIterator`` that looks at every event's name, time and
payload, which every other analysis begins with; it runs over the first events of the same trace, in
between, and its rate is taken for all. Ratios are of wall-clock time and of processor time; the
memory is the process's peak.

With decoder and joins compiled by Numba before, and in C++ now, in turns in one run on two busy
cores: 20,000,000 events in 8.0 and 5.5 s of processor time, with peaks of 1,897 and 1,831 MiB.
Since the analysis lets go of tables that are spent, the peak is 1,490 MiB; since it does so inside
the data flow, large columns have memory of their own, and filters copy only columns that are read,
1,190 MiB. Opening takes 1,000 of which the tables keep 730. At the peak, hops are made: the data
flow has 540 then, hops and traversals 320, the program and its libraries 110, and what Polars keeps
for its next frames some 100. Less would need narrower types or fewer columns in these frames.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from ctf_decode import read_records, scaled, timed

ROOT = Path(__file__).parents[1]
BT2_PYTHON = "/usr/bin/python3"  # python3-bt2 is a Debian package, not on PyPI
_OURS = """
import sys
from chainshaper import analyse_latency, open_source
found = analyse_latency(open_source(sys.argv[1]), sys.argv[2])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]
print(int(peak) / 1024, found.statistics.count, found.statistics.incomplete)
"""
_BT2 = """
import sys, time
import bt2
started, count = (time.monotonic(), time.process_time()), 0
for message in bt2.TraceCollectionMessageIterator(sys.argv[1]):
    if type(message) is bt2._EventMessageConst:
        event = message.event
        name, now = event.name, message.default_clock_snapshot.ns_from_origin
        payload = {field: value for field, value in event.payload_field.items()}
        count += 1
        if count == int(sys.argv[2]):
            break
print(count / (time.monotonic() - started[0]), count / (time.process_time() - started[1]))
"""


def run(*command: str | Path) -> list[float]:
    """The numbers that a program prints."""
    finished = subprocess.run([*map(str, command)], capture_output=True, text=True, check=True)
    return [float(word) for word in finished.stdout.split()]


def example(folder: Path) -> Path:
    """The trace that the project carries."""
    trace = folder / "example"
    script = ROOT / "examples" / "write_trace.py"
    subprocess.run([sys.executable, str(script), str(trace)], check=True)
    return trace / "ust"


def run_ours(trace: Path, chain: str) -> list[float]:
    """Seconds, processor seconds, peak MiB, traversals and incomplete ones of a whole process."""
    figures: list[float] = []
    taken = timed(lambda: figures.extend(run(sys.executable, "-c", _OURS, trace, chain)))
    return [*taken, *figures]


def measure(trace: Path, chain: str, events: int, runs: int, sample: int) -> None:
    """One row of the table: medians over interleaved runs."""
    ours, peers = [], []
    for _ in range(runs):
        ours.append(run_ours(trace, chain))
        if Path(BT2_PYTHON).exists():
            peers.append(run(BT2_PYTHON, "-c", _BT2, trace, str(sample)))
    wall, cpu, peak, count, incomplete = (
        statistics.median(values) for values in zip(*ours, strict=True)
    )
    row = f"{events:>12,}{wall:9.2f}{cpu:9.2f}{events / wall / 1e6:9.2f}{peak:11,.0f}"
    row += f"{int(count):>12,}{int(incomplete):>12,}"
    if peers:
        rate, cpu_rate = (statistics.median(values) for values in zip(*peers, strict=True))
        row += f"{rate:12,.0f}{events / wall / rate:9.1f}{events / cpu / cpu_rate:11.1f}"
    print(row, flush=True)


def main() -> None:
    """Parse arguments, scale, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, nargs="+", default=[2_000_000, 20_000_000])
    parser.add_argument("--trace", type=Path, help="a real trace of one folder to scale")
    parser.add_argument("--chain", default="/image../command")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--sample", type=int, default=200_000, help="events for bt2 to iterate")
    options = parser.parse_args()
    head = f"{'events':>12}{'s':>9}{'cpu s':>9}{'M/s':>9}{'peak MiB':>11}{'traversals':>12}"
    print(head + f"{'incomplete':>12}{'bt2 /s':>12}{'ratio':>9}{'cpu ratio':>11}")
    folder = Path(tempfile.mkdtemp(prefix="trace_to_latency_"))
    try:
        base = read_records(options.trace or example(folder))
        run(sys.executable, "-c", _OURS, options.trace or folder / "example", options.chain)
        for events in options.events:
            written = scaled(folder / str(events), base, events)
            measure(
                folder / str(events) / "scaled",
                options.chain,
                written,
                options.runs,
                options.sample,
            )
            shutil.rmtree(folder / str(events))
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
