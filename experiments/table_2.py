"""Table 2: the longest execution time of each callback of valet parking (section 5.1.1).

    python experiments/table_2.py [--simulated] [--cycles 280] [--keep FOLDER]

Simulated is the graph with drawn execution times, live the localisation that really computes, both
under SCHED_FIFO. CPU time from a callback's start to its end: with publishing, which the drawn
times do not contain.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import polars as pl
from avp_drawn import APPLICATION as DRAWN
from avp_drawn import MWCETS
from configurations import parse_options
from results import MS, Column, Line, Run, earlier_runs, machines_of, save
from table_3 import run_under_fifo

from chainshaper import load_application, open_recording, simulate
from chainshaper.analysis import data_flow
from chainshaper.values.recording import Recording

CALLBACKS = {
    "throttler, rear": ("/throttler", "/lidar_rear/points_raw"),
    "throttler, front": ("/throttler", "/lidar_front/points_raw"),
    "rear filter": ("/rear_filter", None),
    "front filter": ("/front_filter", None),
    "fusion": ("/fusion", None),
    "voxel grid": ("/voxel_grid", None),
    "localizer": ("/localizer", None),
}
"""Nodes, and topics where a node has several callbacks; fusion's inputs count as one."""

WHY = {
    "throttler, rear": "live, other work filled the machine, which slows caches and CPU time down",
    "throttler, front": "",
    "rear filter": "live: its time is that of outlier removal, so of how many points are seen",
    "front filter": "live: as the rear filter; denser scans leave a slow machine no room in 100 ms",
    "fusion": "live: NumPy moves and joins arrays; Autoware iterates over messages",
    "voxel grid": "live: NumPy sorts the points by cell, in one go",
    "localizer": "live: generalised ICP of small_gicp, at most 12 iterations; the paper's is NDT",
}

DRAWN_FROM: dict[Column, str] = {
    "simulated": "simulated, execution times are drawn up to the paper's longest: its own input,"
    " and what the simulator adds"
}


def times_of(recording: Recording, column: Column) -> list[Run]:
    """The execution times of each callback in a recording, one run for each: its CPU time."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    about = flow.objects.callbacks.unique("callback_id").select("callback_id", "node", "topic")
    instances = flow.instances.filter(~pl.col("assumed"), pl.col("execution_ns").is_not_null())
    instances = instances.join(about, on="callback_id").sort("start")
    runs = []
    for name, (node, topic) in CALLBACKS.items():
        times = instances.filter(pl.col("node") == node)
        if topic is not None and times["topic"].null_count() == 0:  # a drawn throttler has timers
            times = times.filter(pl.col("topic") == topic)
        used = times["execution_ns"].to_numpy()
        runs.append(Run(name, column, used, np.zeros(used.size, np.bool_)))
    return runs


def lines(runs: Sequence[Run]) -> list[Line]:
    """The longest execution time of each callback."""
    made = []
    for name, paper in MWCETS.items():
        measured = [run for run in runs if run.name == name]
        values: dict[str, Any] = {"simulated": None, "live": None}
        values |= {run.column: float(run.latency_ns.max()) / MS for run in measured}
        values |= {"no_evidence": DRAWN_FROM, "machines": machines_of(measured)}
        made.append(Line(name, "ms", paper, why=WHY[name], **values))
    return made


def main() -> None:
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=280, until=until)
        folder = Path(until.enter_context(TemporaryDirectory()))
        drawn = simulate(load_application(DRAWN), folder / "drawn", cycles=options.simulated_cycles)
        runs = times_of(drawn, "simulated")
        if options.live:
            _, recording = run_under_fifo(options)
            runs += times_of(open_recording(recording), "live")
        else:
            runs += earlier_runs("table_2", "live")
    save("table_2", "Table 2: longest execution times in valet parking", lines, runs=runs)


if __name__ == "__main__":
    main()
