"""Where the jitter between a shaped output's publication and its subscriber's callback is made.

    python benchmarks/delivery.py OUT TOPIC -- chainshaper shape … -o OUT -- ros2 launch …

Runs the command with bpftrace beside it, and prints for each hop how long behind the write it ends:
the write (`rmw_publish`'s time stamp), a DDS thread of the receiver is woken and runs, its executor
is woken and runs, takes the message (`rmw_take`) and starts the callback (`callback_start`). The
kernel's stamps and those of the recording are of one clock. Nothing is asserted: compare the hops
of one run, and runs that were made in turns.
"""

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl
from rich.console import Console
from rich.table import Table

from chainshaper.values.recording import open_recording

PROGRAM = """
tracepoint:sched:sched_wakeup { @w[args->pid] = 1; printf("%llu woken %d\\n", nsecs, args->pid); }
tracepoint:sched:sched_switch /@w[args->next_pid]/ {
  delete(@w[args->next_pid]); printf("%llu runs %d\\n", nsecs, args->next_pid);
}
"""
DDS = re.compile(r"recv(UC|MC)?|dds\.(udp|shm)\..*|dq\.user")
PERCENTILES = (0.5, 5, 50, 95, 99.5)


def messages(folder: Path, topic: str) -> tuple[pl.DataFrame, dict[int, str]]:
    """One row a message of the last recording, and the names of its receivers' threads by id."""
    recording = open_recording(folder / "after")
    tables = recording.events
    subscriptions = tables["rcl_subscription_init"].filter(pl.col("topic_name") == topic)
    receivers = subscriptions.select("pid", "rmw_subscription_handle")
    written = tables["rmw_publish"].select(source_timestamp="timestamp", written="time")
    starts = tables["callback_start"].select("tid", started="time").sort("started")
    rows = (
        tables["rmw_take"]
        .filter(pl.col("taken") == 1)
        .join(receivers, on=["pid", "rmw_subscription_handle"])
        .join(written, on="source_timestamp")
        .select("pid", "tid", "written", taken="time")
        .sort("taken")
        .join_asof(
            starts,
            left_on="taken",
            right_on="started",
            by="tid",
            strategy="forward",
            check_sortedness=False,
        )
    )
    pids = set(rows["pid"])
    threads = {one.tid: one.comm for one in recording.info.threads if one.pid in pids}
    return rows, threads


def hops(rows: pl.DataFrame, threads: dict[int, str], trace: Path) -> dict[str, np.ndarray]:
    """How long behind the write each hop ended, in microseconds; first instants of each kind."""
    found: dict[str, list[int]] = {}
    seen = [line.split() for line in trace.read_text().splitlines() if line[:1].isdigit()]
    times = {
        (what, tid): np.array([int(one[0]) for one in seen if one[1:] == [what, str(tid)]])
        for tid in threads
        for what in ("woken", "runs")
    }
    executors = set(rows["tid"])
    for row in rows.iter_rows(named=True):
        for who in ("DDS thread", "executor"):
            own = [t for t in threads if (t in executors) == (who == "executor")]
            own = [t for t in own if who == "executor" or DDS.fullmatch(threads[t])]
            for what in ("woken", "runs"):
                every = np.concatenate([times[what, tid] for tid in own] or [np.array([])])
                within = every[(every >= row["written"]) & (every < row["taken"])]
                if within.size:
                    found.setdefault(f"{who} {what}", []).append(within.min() - row["written"])
    found["message taken"] = (rows["taken"] - rows["written"]).to_list()
    found["callback starts"] = (rows["started"] - rows["written"]).drop_nulls().to_list()
    return {what: np.array(values) / 1000 for what, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("topic")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    given = parser.parse_args()
    bpftrace = shutil.which("bpftrace")
    if bpftrace is None:
        sys.exit("bpftrace is not installed: apt install bpftrace")
    with tempfile.TemporaryDirectory() as nowhere:
        trace = Path(nowhere) / "sched.txt"
        tracer = subprocess.Popen([bpftrace, "-o", str(trace), "-e", PROGRAM])
        time.sleep(3)
        subprocess.run(given.command[given.command[0] == "--" :], check=False)
        tracer.send_signal(signal.SIGINT)
        tracer.wait()
        rows, threads = messages(given.folder, given.topic)
        table = Table("behind the write [us]", "count", *(f"p{one}" for one in PERCENTILES))
        for what, values in hops(rows, threads, trace).items():
            figures = (f"{one:.0f}" for one in np.percentile(values, PERCENTILES))
            table.add_row(what, str(values.size), *figures)
    Console().print(table)


if __name__ == "__main__":
    main()
