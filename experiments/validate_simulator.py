"""The simulator against the machine: same description, same seed, cycle by cycle.

    python experiments/validate_simulator.py [APP.yaml] [--cycles 1000] [--keep FOLDER]

The application runs live, and is simulated twice: with what waking up, taking and publishing cost
by default, and with what they cost here, measured in a short run before with another seed, so that
nothing is taken over from the run that is compared with. Execution times are the same ones in all.
Cycles that the machine disturbed are left out. Recordings that are in FOLDER already are used.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from chainshaper import load_application, open_recording, run_application, simulate
from chainshaper.analysis import analyse_latency
from chainshaper.recording import Recording
from chainshaper.simulation.samples import measured_costs
from chainshaper.workload.description import Application

MS = 1_000_000
MEDIAN_MS, P99_MS, MAXIMA = 0.3, 1.5, 0.03
"""The goals: of |simulated − measured| per cycle, and of the two maxima."""

CALIBRATION_SEED = 1_000_003
CALIBRATION_CYCLES = 100


def live(application: Application, path: Path, cycles: int) -> Recording:
    """A live run, unless it has been recorded already."""
    if path.exists():
        return open_recording(path)
    print(f"running {application.name} live for {cycles} cycles", flush=True)
    return run_application(application, path, cycles=cycles)


def by_cycle(recording: Recording, period_ns: int) -> pl.DataFrame:
    """Latency and disturbance by the number of the cycle."""
    frame = analyse_latency(recording, recording.info.chain or "").traversals
    first = frame["start"].min()
    return frame.drop_nulls("latency_ns").select(
        ((pl.col("start") - first) / period_ns).round().cast(pl.Int64).alias("cycle"),
        "latency_ns",
        "disturbed",
    )


def compare(name: str, measured: pl.DataFrame, simulated: pl.DataFrame) -> None:
    """Print how far apart the two are."""
    both = measured.join(simulated, on="cycle", suffix="_simulated").filter(~pl.col("disturbed"))
    ours = both["latency_ns_simulated"].to_numpy() / MS
    theirs = both["latency_ns"].to_numpy() / MS
    apart = np.abs(ours - theirs)
    maxima = abs(ours.max() / theirs.max() - 1)
    median, p99 = np.percentile(apart, [50, 99])
    met = median <= MEDIAN_MS and p99 <= P99_MS and maxima <= MAXIMA
    print(
        f"{name:<18}{len(both):>7}{median:>9.3f}{p99:>9.3f}{apart.max():>9.3f}"
        f"{(ours - theirs).mean():>9.3f}{theirs.max():>10.3f}{ours.max():>10.3f}{maxima:>8.2%}"
        f"  {'met' if met else 'missed'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("application", nargs="?", default="examples/synthetic_chain.yaml")
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="keep the recordings here, and use those there")
    options = parser.parse_args()
    application = load_application(options.application)
    period = min(cb.timer_ns for _, cb in application.callbacks() if cb.timer_ns is not None)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        other_seed = application.model_copy(update={"seed": CALIBRATION_SEED})
        costs = measured_costs(live(other_seed, folder / "calibration", CALIBRATION_CYCLES))
        measured = by_cycle(live(application, folder / "live", options.cycles), period)
        calibrated = application.model_copy(update={"simulation": costs})
        print(
            f"{'|simulated − live|':<18}{'cycles':>7}{'median':>9}{'p99':>9}{'max':>9}"
            f"{'bias':>9}{'max live':>10}{'max sim.':>10}{'apart':>8}   (ms)"
        )
        for name, described in (("default costs", application), ("measured costs", calibrated)):
            recording = simulate(described, Path(scratch) / name.split()[0], cycles=options.cycles)
            compare(name, measured, by_cycle(recording, period))
        print(f"{'goal':<18}{'':>7}{MEDIAN_MS:>9.3f}{P99_MS:>9.3f}{'':>38}{MAXIMA:>8.2%}")


if __name__ == "__main__":
    main()
