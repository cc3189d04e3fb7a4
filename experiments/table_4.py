"""Table 4: the slots of every schedule of valet parking, and the averages of table 3.

    python experiments/table_4.py [--measured results/table_3.parquet]

Slots are in ms, boundaries on whole ms as in the paper. Simulated are those of a latency sample
that is calibrated on table 3 (:mod:`avp_sample`), live those of the latencies that table 3 has
measured of the localisation that really computes; nothing is run here. Averages and maxima are
predicted with outputs at the start of their slots (eq. 5); the paper's came 0.6 ms after it.
Slots are half-open here: the paper's [86, 87] is [86, 87).
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from avp_sample import MS, ORIGIN, PERIOD_NS, avp_sample
from numpy.typing import NDArray
from results import RESULTS, Column, Line, Value, save

from chainshaper.planning import CallbackTimes, ChainPlan, plan_shaping
from chainshaper.planning.bands import with_bands, with_long_slot
from chainshaper.planning.shaping import (
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
)

__all__ = ["MARGIN_NS", "MWCETS_US", "parse_measured", "plans"]

NODES = ("/throttler", "/rear_filter", "/fusion", "/voxel_grid", "/localizer")

# Row 1 rests on table 2, in microseconds, and on the graph: fusion waits for both filters.
MWCETS_US = (
    ("/throttler", 1, 600, ()),
    ("/throttler", 1, 600, ()),
    ("/rear_filter", 1, 19_900, (0,)),
    ("/front_filter", 0, 30_700, (1,)),
    ("/fusion", 1, 3_300, (2, 3)),
    ("/voxel_grid", 1, 9_200, (4,)),
    ("/localizer", 1, 50_800, (5,)),
)

MARGIN_NS = 200_000
"""What a callback takes besides executing: to be woken, and to take and publish a message. With
it the rear filter's slot is the paper's, [2, 23]."""

PAPER_ROWS: dict[str, tuple[str, Value]] = {  # slots (table 4), average (table 3)
    "1 server per callback": ("[0,2] [2,23] [2,33] [33,37] [37,47] [47,98]", 72.8),
    "2 server per chain": ("[0,2] [2,86]", 64.2),
    "3 1-band": ("[0,2] [2,86] [86,87]", 86.6),
    "4 3-band, random": ("[0,2] [2,86] [50,51] [70,71] [86,87]", 76.4),
    "5 3-band, PSO": ("[0,2] [2,86] [62,63] [77,78] [86,87]", 71.3),
    "5 3-band, exact": ("–", None),
    "one long slot": ("[62,87]", "less than row 5"),
}
WHY = {
    "1 server per callback": "its slots follow from table 2's times and the graph; its averages are"
    " those of table 3's runs",
    "4 3-band, random": "drawn at random, in the paper as here",
    "5 3-band, exact": "what PSO looks for, found exactly",
}

ROW_1 = "1 server per callback"
FITTED: dict[Column, str] = {
    "simulated": "simulated, the slots' ends and averages in the paper are what the sample was"
    " fitted to",
    "live": "live, nothing is run: planned from table 3's latencies under SCHED_FIFO",
}
OF_TABLE_2: dict[Column, str] = {
    "simulated": "simulated, the first row's slots follow from the paper's own table 2"
}


def plans(latencies: NDArray[np.int64]) -> dict[str, ChainPlan]:
    """The plan of every row."""
    epsilon = -(-int(latencies.max()) // MS) * MS + MS - int(latencies.max())  # L̄ + ε = 86 ms
    shaped = plan_shaping(
        latencies,
        PERIOD_NS,
        output="/localization/pose",
        publisher=NODES[-1],
        nodes=NODES,
        epsilon_ns=epsilon,
        overrun="wait",
    )
    callbacks = [
        CallbackTimes(node, core, longest * 1000, longest * 1000, longest * 1000, after)
        for node, core, longest, after in MWCETS_US
    ]
    apart = with_first_node_apart(shaped, NODES[0], 2 * MS)
    bands = {
        solver: with_bands(apart, latencies, 3, solver=solver, grid_ns=MS, seed=1)
        for solver in ("random", "pso", "exact")
    }
    return {
        "1 server per callback": server_per_callback(shaped, callbacks, margin_ns=MARGIN_NS),
        "2 server per chain": server_per_chain(apart),
        "3 1-band": apart,
        "4 3-band, random": bands["random"],
        "5 3-band, PSO": bands["pso"],
        "5 3-band, exact": bands["exact"],
        "one long slot": with_long_slot(apart, latencies, bands["exact"].servers[-1].slots[0][0]),
    }


def slots_text(plan: ChainPlan) -> str:
    """All slots of a plan on one line: ``[0,2) [2,86) [86,87)``."""
    slots = [slot for server in plan.servers for slot in server.slots]
    return " ".join(f"[{start // MS},{end // MS})" for start, end in slots)


def average(plan: ChainPlan) -> Value:
    """The predicted average (ms), for outputs at the start of their slots."""
    if plan.policy == "server-per-callback":
        return None
    early = MS if plan.policy == "shaped" else 0
    return (plan.predicted.mean_ns - early) / MS


def measured_latencies(path: Path) -> NDArray[np.int64] | None:
    """The live latencies under SCHED_FIFO that table 3 has kept; None where it never ran live."""
    if not path.exists():
        return None
    rows = pl.read_parquet(path).filter(
        pl.col("column") == "live",
        pl.col("run") == "SCHED_FIFO",
        ~pl.col("disturbed"),
        pl.col("latency_ns") >= 0,
    )
    return rows["latency_ns"].to_numpy() if rows.height else None


def row_1(folder: Path = RESULTS) -> dict[str, Any]:
    """Of the first row what table 3 has: the live slots, both averages (ms), and the day."""
    path = folder / "table_3.json"
    lines = json.loads(path.read_text())["lines"] if path.exists() else []
    found = {line["what"]: line for line in lines if line["what"].startswith(f"{ROW_1}: ")}
    slots, mean = (found.get(f"{ROW_1}: {what}", {}) for what in ("slots", "average"))
    return {
        "slots": slots.get("live"),
        "simulated": mean.get("simulated"),
        "live": mean.get("live"),
        "measured": mean.get("measured"),
    }


def parse_measured(about: str) -> NDArray[np.int64] | None:
    """The command line of what is planned from table 3's latencies; those, where there are any.

    None as well where the longest does not fit into a cycle, which no plan can help.
    """
    parser = argparse.ArgumentParser(description=about.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is run live here anyway")
    parser.add_argument("--measured", type=Path, default=RESULTS / "table_3.parquet")
    measured = measured_latencies(parser.parse_args().measured)
    if measured is not None and measured.max() > PERIOD_NS - 3 * MS:
        print(f"not planned: table 3's live chain took up to {measured.max() / MS:.1f} ms")
        return None
    return measured


def main() -> None:
    measured = parse_measured(__doc__)
    calibrated = plans(avp_sample())
    # Slots per callback follow from table 2, not from latencies.
    live = {} if measured is None else plans(measured)
    live.pop(ROW_1, None)
    lines, day = [], row_1().get("measured")
    for row, (slots, mean) in PAPER_ROWS.items():
        plan, real, marks = calibrated[row], live.get(row), FITTED
        real_slots: Value = None if real is None else slots_text(real)
        our_mean, real_mean = average(plan), None if real is None else average(real)
        if row == ROW_1:
            marks, of_table_3 = OF_TABLE_2, row_1()
            real_slots, our_mean, real_mean = map(of_table_3.get, ("slots", "simulated", "live"))
        why = WHY.get(row, "")
        for what, paper, ours, theirs in (
            ("slots", slots, slots_text(plan), real_slots),
            ("average", mean, our_mean, real_mean),
        ):
            own = Line(f"{row}: {what}", "ms", paper, ours, theirs, why, no_evidence=marks)
            lines.append(replace(own, measured=None if theirs is None else day))
    save("table_4", "Table 4: slots of valet parking", lines, notes=ORIGIN.replace("\n", " "))


if __name__ == "__main__":
    main()
