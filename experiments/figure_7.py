"""Figure 7: the average end-to-end latency of valet parking over the number of latency bands.

    python experiments/figure_7.py [--measured results/table_3.parquet]

The paper prints the curve without numbers; known are its first point and its third (table 3) and
what it says about its shape: "the average changes negligibly beyond 4 bands", which is read as
less than 1 % here. Simulated are predictions for the calibrated sample, live those for the
latencies that table 3 has measured. Averages are for outputs at the start of their slots; the
paper's came 0.6 ms after it.
"""

from pathlib import Path

import numpy as np
from avp_sample import MS, ORIGIN, PERIOD_NS, avp_sample
from numpy.typing import NDArray
from results import PICTURES, Column, Line, save
from table_4 import parse_measured

from chainshaper.planning import BandChoice, plan_shaping
from chainshaper.planning.bands import choose_bands
from chainshaper.reporting.figures import draw_curve

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
    return choose_bands(shaped, latencies, least_gain=0.01)


def averages(found: BandChoice) -> list[float]:
    """By number of bands, from one (ms)."""
    return [placement.mean_ns / MS - 1 for placement in found.curve[:MOST_BANDS]]


def _drawn(found: BandChoice, path: Path) -> Path:
    path.unlink(missing_ok=True)  # the picture of the last time
    return draw_curve(found, path)


def main() -> None:
    measured = parse_measured(__doc__)
    found = choice(avp_sample())
    pictures = [_drawn(found, PICTURES / "figure_7_simulated.png")]
    notes = f"{ORIGIN} Bands chosen by `--bands auto`: {found.reason}.".replace("\n", " ")
    live: list[float] = []
    if measured is not None:
        real = choice(measured)
        live = averages(real)
        pictures.append(_drawn(real, PICTURES / "figure_7_live.png"))
    simulated = averages(found)
    lines = []
    for bands in range(1, MOST_BANDS + 1):
        ours, real_ours = (
            values[bands - 1] if len(values) >= bands else None for values in (simulated, live)
        )
        what = f"{bands} band{'s' if bands > 1 else ''}: average"
        said = PAPER.get(bands, "negligible change" if bands > 4 else None)
        lines.append(Line(what, "ms", said, ours, real_ours, no_evidence=FITTED))
    save("figure_7", "Figure 7: average over bands", lines, pictures=pictures, notes=notes)


if __name__ == "__main__":
    main()
