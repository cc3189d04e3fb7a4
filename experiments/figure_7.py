"""Figure 7: the average end-to-end latency of valet parking over the number of latency bands.

    python experiments/figure_7.py

The paper prints the curve without numbers; known are its first point and its third (table 3) and
what it says about its shape: "the average changes negligibly beyond 4 bands", which is read as
less than 1 % here. Simulated are predictions for the calibrated sample, live those for the
latencies that table 3 has measured. As in table 4, slots are on whole ms, and averages are for
outputs at the start of their slots; the paper's came 0.6 ms after it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from avp_sample import MS, ORIGIN, PERIOD_NS
from numpy.typing import NDArray
from results import PICTURES, Column, Line, Run, earlier_runs, machines_of, save
from table_4 import latencies_by_column, parse_only_simulated, planned_from

from chainshaper.planning import BandChoice, plan_shaping
from chainshaper.planning.bands import choose_bands

PAPER = {1: 86.6, 3: 71.3}
MOST_BANDS = 8
FITTED: dict[Column, str] = {
    "simulated": "simulated, the sample was fitted to these averages",
    "live": "live, nothing is run: planned from table 3's latencies under SCHED_FIFO",
}


def choice(latencies: NDArray[np.int64]) -> BandChoice:
    """The curve, and where `--bands auto` stops on it; L̄ + ε is the whole ms behind L̄'s."""
    epsilon = -(-int(latencies.max()) // MS) * MS + MS - int(latencies.max())
    shaped = plan_shaping(latencies, PERIOD_NS, epsilon_ns=epsilon)
    return choose_bands(shaped, latencies, least_gain=0.01, grid_ns=MS)


def averages(found: BandChoice) -> list[float]:
    """By number of bands, from one (ms), with outputs at the start of their slots of 1 ms."""
    return [placement.mean_ns / MS - 1 for placement in found.curve[:MOST_BANDS]]


def lines(runs: Sequence[Run]) -> list[Line]:
    """The average by number of bands."""
    curves = {column: averages(choice(own)) for column, own in latencies_by_column(runs).items()}
    made = []
    for bands in range(1, MOST_BANDS + 1):
        values: dict[str, Any] = {"simulated": None, "live": None}
        values |= {of: curve[bands - 1] for of, curve in curves.items() if len(curve) >= bands}
        what = f"{bands} band{'s' if bands > 1 else ''}: average"
        said = PAPER.get(bands, "negligible change" if bands > 4 else None)
        about: dict[str, Any] = {"no_evidence": FITTED, "machines": machines_of(runs)}
        made.append(Line(what, "ms", said, **values, **about))
    return made


def _drawn(means: Sequence[float], path: Path) -> Path:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    axes.plot(range(1, len(means) + 1), means, "o-", color="#1b6ca8")
    axes.set(xlabel="number of latency bands", ylabel="average, slots' starts [ms]")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path


def main() -> None:
    parse_only_simulated(__doc__)
    runs = planned_from(earlier_runs("table_3", "live"))
    found = {column: choice(own) for column, own in latencies_by_column(runs).items()}
    pictures = [
        _drawn(averages(one), PICTURES / f"figure_7_{column}.png") for column, one in found.items()
    ]
    reason = f"{ORIGIN} Bands chosen by `--bands auto`: {found['simulated'].reason}."
    notes = reason.replace("\n", " ")
    save(
        "figure_7", "Figure 7: average over bands", lines, runs=runs, pictures=pictures, notes=notes
    )


if __name__ == "__main__":
    main()
