"""Table 2: the longest execution time of each callback of valet parking (section 5.1.1).

    python experiments/table_2.py [--simulated] [--cycles 280] [--keep FOLDER]

Simulated is the graph with drawn execution times, live the localisation that really computes, both
under SCHED_FIFO. CPU time from a callback's start to its end: with publishing, which the drawn
times do not contain.
"""

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl
from avp_drawn import APPLICATION as DRAWN
from avp_drawn import MWCETS
from configurations import latencies_of, parse_options
from results import MS, Column, Line, Run, earlier_runs, save
from table_3 import FIFO, run_under_fifo

from chainshaper import load_application, open_recording, simulate
from chainshaper.analysis import callback_statistics, data_flow
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
    "throttler, rear": "",
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


def longest_ms(recording: Recording) -> dict[str, float]:
    """The longest execution time of each callback in a recording."""
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    statistics = callback_statistics(flow).select(
        "node", "topic", longest=pl.col("execution_ns").struct.field("max")
    )
    found = {}
    for name, (node, topic) in CALLBACKS.items():
        own = statistics.filter(pl.col("node") == node)
        if topic is not None and own["topic"].null_count() == 0:  # a drawn throttler has timers
            own = own.filter(pl.col("topic") == topic)
        found[name] = float(own["longest"].max()) / MS  # type: ignore[arg-type]
    return found


def main() -> None:
    runs: list[Run] = []
    live: dict[str, float] = {}
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=280, until=until)
        folder = Path(until.enter_context(TemporaryDirectory()))
        drawn = simulate(load_application(DRAWN), folder / "drawn", cycles=options.simulated_cycles)
        simulated = longest_ms(drawn)
        runs.append(latencies_of(FIFO, drawn))
        if options.live:
            run, recording = run_under_fifo(options)
            runs.append(run)
            live = longest_ms(open_recording(recording))
        else:
            runs += earlier_runs("table_2", "live")
    lines = [
        Line(name, "ms", paper, simulated[name], live.get(name), WHY[name], no_evidence=DRAWN_FROM)
        for name, paper in MWCETS.items()
    ]
    save("table_2", "Table 2: longest execution times in valet parking", lines, runs=runs)


if __name__ == "__main__":
    main()
