"""Figure 7: the average end-to-end latency of valet parking over the number of latency bands.

    python experiments/figure_7.py [--samples 3000] [--draw figure_7.png]

The paper prints the curve without numbers; known are its first point and its third (table 3) and
what it says about its shape: "the average changes negligibly beyond 4 bands", which is read as
less than 1 % here. Averages are
predicted at the start and at the end of slots; the paper's outputs came 0.6 ms after the start.
"""

import argparse
from pathlib import Path

import numpy as np
from avp_sample import MS, ORIGIN, PERIOD_NS, avp_sample
from numpy.typing import NDArray

from chainshaper.planning import BandChoice, choose_bands, plan_shaping
from chainshaper.reporting.figures import draw_curve

PAPER = {1: "86.6", 3: "71.3"}
MOST_BANDS = 8


def choice(latencies: NDArray[np.int64]) -> BandChoice:
    """The curve, and where `--bands auto` stops on it."""
    shaped = plan_shaping(latencies, PERIOD_NS, epsilon_ns=86 * MS - int(latencies.max()))
    return choose_bands(shaped, latencies, least_gain=0.01)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--draw", type=Path)
    arguments = parser.parse_args()
    found = choice(avp_sample(arguments.samples))
    print(f"{ORIGIN}\n")
    print("bands   ours [ms]        gain     paper [ms]")
    before = found.curve[0].mean_ns
    for placement in found.curve[:MOST_BANDS]:
        bands, mean = len(placement.slot_ends_ns), placement.mean_ns
        said = PAPER.get(bands, "negligible change" if bands > 4 else "–")
        ours = f"{mean / MS - 1:.1f} … {mean / MS:.1f}"
        print(f"{bands:<8}{ours:<17}{1 - mean / before:<9.1%}{said}")
        before = mean
    print(found.reason)
    if arguments.draw is not None:
        draw_curve(found, arguments.draw)


if __name__ == "__main__":
    main()
