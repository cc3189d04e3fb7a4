"""Table 4: the slots of every schedule of valet parking, and the averages of table 3.

    python experiments/table_4.py

Slots are in ms, boundaries on whole ms as in the paper. Simulated are those of a latency sample
that is calibrated on table 3 (:mod:`avp_sample`), live those of the latencies that table 3 has
measured of the localisation that really computes; nothing is run here. Averages are those of
eq. 5, with every output at the start of its slot instead of the end, where it leaves; the paper's
came 0.6 ms after it. Slots are half-open here: the paper's [86, 87] is [86, 87).
"""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from avp_sample import MS, ORIGIN, PERIOD_NS, avp_sample
from numpy.typing import NDArray
from results import Column, Line, Run, Value, earlier_runs, figure, machines_of, save

from chainshaper.planning import CallbackTimes, ChainPlan, plan_shaping
from chainshaper.planning.bands import with_bands, with_long_slot
from chainshaper.planning.shaping import (
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
)

__all__ = [
    "FIFO",
    "MARGIN_NS",
    "MWCETS_US",
    "latencies_by_column",
    "parse_only_simulated",
    "planned_from",
    "plans",
]

FIFO = "SCHED_FIFO"
SAMPLE = "calibrated sample"

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
    """The predicted average (ms), for outputs at the start of their slots.

    In a long slot, and without one, outputs leave as they come.
    """
    if plan.policy == "server-per-callback":
        return None
    early = MS if plan.policy == "shaped" else 0
    return (plan.predicted.mean_ns - early) / MS


def planned_from(of_table_3: Sequence[Run]) -> list[Run]:
    """What table 4 and figure 7 are planned from: the sample, and table 3's latencies, if any.

    These are left out where the longest does not fit into a cycle, which no plan can help.
    """
    sample = avp_sample()
    runs = [Run(SAMPLE, "simulated", sample, np.zeros(sample.size, np.bool_))]
    for run in of_table_3:
        if run.name == FIFO and run.undisturbed_ns.max() <= PERIOD_NS - 3 * MS:
            runs.append(run)
    return runs


def latencies_by_column(runs: Sequence[Run]) -> dict[Column, NDArray[np.int64]]:
    """The latencies that a column is planned from."""
    return {run.column: run.undisturbed_ns for run in runs if run.name in (SAMPLE, FIFO)}


def lines(runs: Sequence[Run]) -> list[Line]:
    """Slots and average of each row; of the first, both are table 3's live, the average is always.

    The servers of the first follow from table 2, not from latencies.
    """
    planned = {column: plans(found) for column, found in latencies_by_column(runs).items()}
    row_1 = {run.column: run for run in runs if run.name == ROW_1}
    made = []
    for row, (slots, mean) in PAPER_ROWS.items():
        texts: dict[str, Any] = {"simulated": None, "live": None}
        means: dict[str, Any] = {"simulated": None, "live": None}
        for column, plans_of in planned.items():
            texts[column], means[column] = slots_text(plans_of[row]), average(plans_of[row])
        if row == ROW_1:
            texts["live"] = row_1["live"].facts.get("slots") if "live" in row_1 else None
            means |= {
                column: figure("average", run.undisturbed_ns) for column, run in row_1.items()
            }
        about: dict[str, Any] = {"why": WHY.get(row, ""), "machines": machines_of(runs)}
        about["no_evidence"] = OF_TABLE_2 if row == ROW_1 else FITTED
        made.append(Line(f"{row}: slots", "ms", slots, **texts, **about))
        made.append(Line(f"{row}: average", "ms", mean, **means, **about))
    return made


def main() -> None:
    parse_only_simulated(__doc__)
    of_table_3 = earlier_runs("table_3", "simulated", "live")
    measured = [run for run in of_table_3 if run.column == "live"]
    runs = [*planned_from(measured), *(run for run in of_table_3 if run.name == ROW_1)]
    notes = ORIGIN.replace("\n", " ")
    save("table_4", "Table 4: slots of valet parking", lines, runs=runs, notes=notes)


def parse_only_simulated(about: str) -> None:
    """Parse the command line of an experiment that measures nothing."""
    parser = argparse.ArgumentParser(description=about.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is run live here anyway")
    parser.parse_args()


if __name__ == "__main__":
    main()
