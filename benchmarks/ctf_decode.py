"""How fast the CTF decoder is against babeltrace2's C counter, in one run on one trace.

    python benchmarks/ctf_decode.py [--events 2000000] [--trace FOLDER] [--out FOLDER]

Scales a trace (a real one, or one that the writer makes) to the number of events asked for and
prints a table: seconds and processor seconds of each way of reading, events per second, its
ratio to babeltrace2 by either (medians over interleaved runs), and peak memory of a process that
does only that.  babeltrace2 runs as
``babeltrace2 FOLDER --component sink.utils.counter`` where it is installed.

Processor seconds for 2,000,000 events, the decoder of before (Numba) and this one in turns in one
run, on two cores that others kept busy (so wall-clock times say nothing there); in brackets
babeltrace2's 1.58 s divided by them:

    =============  =============  =============
    way            Numba          C++
    =============  =============  =============
    count          0.054  (29)    0.030  (53)
    one event      0.105  (15)    0.068  (23)
    all fields     0.195  (8.1)   0.142  (11.1)
    =============  =============  =============

Since then sorting in blocks that fit the cache, and stepping from event to event by their spans,
save 7 of 100 parts of all fields' time, by either clock. What is left, in parts of 100: sorting
25; stepping and writing 17; counting 15; zeroing fresh memory 13; moving values, looking up texts
11; Polars, Python and the rest of the kernel 19.

All but a tenth of the work runs on as many threads as there are cores; Numba's sorted the rows, a
quarter of its work, on one. Its wall-clock ratio for all fields on two quiet cores was 16 to 17.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from chainshaper.sources.ctf import count_events, open_trace, read_events
from chainshaper.sources.ctf.trace import read_metadata_text
from chainshaper.sources.ctf.tsdl import parse_tsdl

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/helpers"))
from ctf_writing import (
    EncodedPacket,
    EventRecord,
    encode_packet,
    lttng_metadata,
    repeat_packets,
    write_trace,
)

EVENTS = {
    "ros2:rclcpp_publish": {"message": "x64"},
    "ros2:rcl_publish": {"publisher_handle": "x64", "message": "x64"},
    "ros2:rmw_publish": {"rmw_publisher_handle": "x64", "message": "x64", "timestamp": "s64"},
    "ros2:rmw_take": {
        "rmw_subscription_handle": "x64", "message": "x64",
        "source_timestamp": "s64", "taken": "s32",
    },
    "ros2:callback_start": {"callback": "x64", "is_intra_process": "s32"},
    "ros2:callback_end": {"callback": "x64"},
    "ros2:rclcpp_executor_get_next_ready": {},
    "ros2:rclcpp_executor_wait_for_work": {"timeout": "s64"},
}  # fmt: skip
CONTEXT = {"vpid": "s32", "vtid": "s32", "procname": "char[17]"}
CREATION = ("_init", "_added", "_register", "_link_node")
STAMPS = ("timestamp", "source_timestamp")
ONE_NAME = "ros2:callback_start"
_RUN = """
import re, sys, time
sys.path[:0] = sys.argv[3].split(":")
from chainshaper.sources.ctf import count_events, open_trace, read_events
trace = open_trace(sys.argv[1])
started = time.monotonic()
if sys.argv[2] == "count":
    total = sum(count_events(trace)[0].values())
else:
    names = None if sys.argv[2] == "all" else {sys.argv[2]}
    total = sum(len(frame) for frame in read_events(trace, names).values())
elapsed = time.monotonic() - started
status = open("/proc/self/status").read()
print(total, elapsed, int(re.search(r"VmHWM:\\s*(\\d+)", status)[1]) // 1024)
"""


def made_records() -> tuple[str, dict[int, list[EventRecord]]]:
    """Metadata and records per core of a made-up system: 8 cores, 40,000 events."""
    records: dict[int, list[EventRecord]] = {}
    for cpu in range(8):
        chance, now = random.Random(cpu), (1 << 42) + cpu
        own = records[cpu] = []
        for _ in range(5000):
            now += chance.randrange(2_000, 900_000)
            name = chance.choice(list(EVENTS))
            payload = {n: chance.randrange(1 << 31) for n in EVENTS[name]}
            process = chance.randrange(5)
            context = {"vpid": 9 + process, "vtid": 9 + process, "procname": f"node_{process}"}
            own.append(EventRecord(name, now, payload, context))
    return lttng_metadata(EVENTS, CONTEXT), records


def read_records(folder: Path) -> tuple[str, dict[int, list[EventRecord]]]:
    """Metadata and records per core of a real trace of one folder and one stream class.

    Events with a field that no table has a column for are left out.
    """
    trace = open_trace(folder)
    text, _ = read_metadata_text(trace.folders[0].path / "metadata")
    (stream,) = trace.folders[0].streams.values()
    fields = {e.name: e.fields.fields if e.fields else () for e in stream.events.values()}
    names = {"pid": "vpid", "tid": "vtid", "procname": "procname"}  # as `ros2 trace` asks for
    records: dict[int, list[EventRecord]] = {}
    for name, frame in read_events(trace).items():
        for row in frame.iter_rows(named=True):
            context = {own: row.pop(column) for column, own in names.items() if column in row}
            now, cpu = row.pop("time"), row.pop("cpu")
            payload = {column.removeprefix("payload."): value for column, value in row.items()}
            if len(payload) == len(fields[name]):
                records.setdefault(cpu, []).append(EventRecord(name, now, payload, context))
    for found in records.values():
        found.sort(key=lambda record: record.time)
    return text, records


def scaled(folder: Path, base: tuple[str, dict[int, list[EventRecord]]], events: int) -> int:
    """Write ``base``, then its course again and again, until there are ``events`` of them.

    Objects are created in the first round only; source time stamps move with the events, so
    that every round is as good a recording as the first. Returns the number of events written.
    """
    text, records = base
    declared = parse_tsdl(text)
    course = {
        cpu: [r for r in found if not r.name.endswith(CREATION)] for cpu, found in records.items()
    }
    once = sum(map(len, records.values()))
    again = sum(map(len, course.values()))
    turns = max(0, (events - once) // again)
    span = max(r[-1].time for r in records.values()) - min(r[0].time for r in records.values())
    period = -(-(span + 1) // (1 << 32)) * (1 << 32)

    def packets(cpu: int, found: list[EventRecord], first: int) -> list[EncodedPacket]:
        return [
            encode_packet(
                declared,
                found[start : start + 2000],
                {"cpu_id": cpu, "packet_seq_num": first + place},
                instance=cpu,
                stamps=STAMPS,
            )
            for place, start in enumerate(range(0, len(found), 2000))
        ]

    def stream(cpu: int) -> Iterator[EncodedPacket | bytes]:
        whole = packets(cpu, records[cpu], 0)
        yield from whole
        repeated = -(-len(course[cpu]) // 2000)
        rest = packets(cpu, course[cpu], len(whole) - repeated)
        yield from repeat_packets(rest, turns, period, first=1)

    write_trace(folder / "scaled", text, {f"channel_{cpu}": stream(cpu) for cpu in sorted(records)})
    return once + again * turns


def timed(action: Callable[[], object]) -> tuple[float, float]:
    """Seconds and processor seconds (children's included) that ``action`` takes."""
    started, before = time.monotonic(), sum(os.times()[:4])
    action()
    return time.monotonic() - started, sum(os.times()[:4]) - before


def peak_memory(folder: Path, what: str) -> int:
    """Peak resident MiB of a fresh process that reads ``what``."""
    paths = ":".join(path for path in sys.path if path)
    command = [sys.executable, "-c", _RUN, str(folder), what, paths]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return int(out.split()[2])


def main() -> None:
    """Parse arguments, scale, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--trace", type=Path, help="a real trace to scale")
    parser.add_argument("--out", type=Path, help="keep the scaled trace in this new folder")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    folder = options.out or Path(tempfile.mkdtemp(prefix="ctf_decode_"))
    try:
        base = read_records(options.trace) if options.trace else made_records()
        events = scaled(folder, base, options.events)
        measure(folder / "scaled", events, options.runs)
    finally:
        if options.out is None:
            shutil.rmtree(folder)


def measure(folder: Path, events: int, runs: int) -> None:
    """Time all ways of reading in turns and print the table."""
    size = sum(path.stat().st_size for path in folder.iterdir()) / 2**20
    print(f"{events:,} events, {size:,.0f} MiB, {len(list(folder.iterdir())) - 1} streams")
    trace = open_trace(folder)
    counter = ["babeltrace2", str(folder), "--component", "sink.utils.counter"]
    ways: dict[str, Callable[[], object]] = {
        "open": lambda: open_trace(folder),
        "count": lambda: count_events(trace),
        "one event": lambda: read_events(trace, {ONE_NAME}),
        "all fields": lambda: read_events(trace),
        "all fields, 1 thread": lambda: read_events(trace, threads=1),
    }
    if shutil.which("babeltrace2"):
        ways["babeltrace2 counter"] = lambda: subprocess.run(
            counter, stdout=subprocess.DEVNULL, check=True
        )
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for _ in range(runs):
        for name, action in ways.items():
            taken[name].append(timed(action))
    medians = {
        name: [statistics.median(values) for values in zip(*runs_of, strict=True)]
        for name, runs_of in taken.items()
    }
    reference = medians.get("babeltrace2 counter", [float("nan")] * 2)
    memory = {
        "count": peak_memory(folder, "count"),
        "one event": peak_memory(folder, ONE_NAME),
        "all fields": peak_memory(folder, "all"),
    }
    print(f"{'':22}{'s':>8}{'cpu s':>8}{'M/s':>8}{'ratio':>8}{'cpu ratio':>11}{'peak MiB':>10}")
    for name, (wall, cpu) in medians.items():
        rate, ratio = events / wall / 1e6, reference[0] / wall
        row = f"{name:22}{wall:8.3f}{cpu:8.3f}{rate:8.1f}{ratio:8.1f}"
        print(f"{row}{reference[1] / max(cpu, 0.01):11.1f}{memory.get(name, ''):>10}")


if __name__ == "__main__":
    main()
