"""The simulator against the machine: same description, same seed, cycle by cycle.

    python experiments/validate_simulator.py [APP.yaml] [--cycles 1000] [--keep FOLDER]

The application runs live, with and without the nodes that only interfere, and each is simulated
twice: with what waking up, taking and publishing cost by default, and with what they cost here,
measured in a short run before with another seed, so that nothing is taken over from the runs that
are compared with. Execution times are the same ones in all. Recordings that are in FOLDER already
are used.

The same application then runs shaped: with the servers of its plan in force by freezing, with one
band and with three, planned from the short run. It runs in blocks, one and three bands in turns,
and each block is simulated with the costs of a short run under the same plan just before it: what
opens and closes servers takes time too, and what it takes changes with the machine. Every block
runs twice, with the same execution times: no simulation can be expected to be nearer to a run than
another run is. Outputs that missed the slot they have in the simulation, or made one that they miss
there, are off by a whole band or period: so many of them as the median and p99 say.

Cycles that the machine disturbed are left out, on the stall meters' evidence and no other: those
that it stalled, and then those in which one of the cores ran at another pace than in the short
run, by a factor of 1.5 or more. (What a simulation does not know, hops, publications, interrupts,
takes some 2.3 ms of a cycle of the example; at 1.5 times that it is off by more than 1 ms.)
Unshaped, figures with both kinds left out are judged; those without stalled cycles only stand
beside them. Shaped, all cycles that were not stalled are judged, with the share of each band.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from configurations import BLOCKS, Configuration, block_seed, live_in_turns, output_of
from measured_costs import measured_costs

from chainshaper import (
    load_application,
    measure_latency,
    open_recording,
    plan_recording,
    run_application,
    simulate,
)
from chainshaper.planning import Plan, PlanRequest
from chainshaper.planning.plan import publish_slots, shaping_nodes
from chainshaper.values import events
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application

MS = 1_000_000
MEDIAN_MS, P99_MS, MAXIMA = 0.3, 1.5, 0.03
"""The goals: of |simulated − measured| per cycle, and of the two maxima."""

SHARE_OF_BAND = 0.03
"""The goal of the share of cycles that leave with each band."""

CALIBRATION_SEED = 1_000_003
CALIBRATION_CYCLES = 100
OFF_PACE = 1.5


def live(application: Application, path: Path, cycles: int) -> Recording:
    """A live run, unless it has been recorded already."""
    if path.exists():
        return open_recording(path)
    print(f"running {application.name} live for {cycles} cycles", flush=True)
    return run_application(application, path, cycles=cycles)


def with_and_without_interference(application: Application) -> Iterator[tuple[str, Application]]:
    """The application, and without nodes that exchange no messages with others if it has any."""
    yield "live", application
    nodes = {
        name: node
        for name, node in application.nodes.items()
        if any(callback.publishes or callback.subscriptions for callback in node.callbacks)
    }
    if len(nodes) < len(application.nodes):
        yield "alone", application.model_copy(update={"nodes": nodes})


def by_cycle(recording: Recording, since_ns: int = 0) -> pl.DataFrame:
    """Start, end, latency and disturbance by the number of the cycle, of those since ``since_ns``.

    Numbers are those of the chain's traversals, which count from the first that was recorded: a
    timer that is held over an expiry draws its next execution time in the cycle behind.
    """
    frame = measure_latency(recording).analysis.traversals.drop_nulls("latency_ns")
    own = frame.select(
        pl.col("traversal").alias("cycle"), "start", "end", "latency_ns", "disturbed"
    )
    return own.filter(pl.col("start") >= since_ns)


def ordinary_pace(tables: events.EventTables) -> dict[int, float]:
    """The median CPU time of a wake-up on each core that was watched (ns)."""
    frame = events.table(tables, "machine_pace", ["cpu"])
    medians = frame.group_by("cpu").median().select("cpu", "cpu_time").iter_rows()
    return {core: median for core, median in medians if median}


def relative_pace(
    tables: events.EventTables,
    start: npt.NDArray[np.int64],
    end: npt.NDArray[np.int64],
    ordinary: Mapping[int, float],
) -> npt.NDArray[np.float64]:
    """Per core of ``ordinary`` a row: the mean pace in each window [start, end) of ``start``.

    Not a number where the core was not watched. A window begins with the stretch of wake-ups that
    was under way.
    """
    frame = events.table(tables, "machine_pace", ["cpu"]).sort("time")
    rows = []
    for core, usual in ordinary.items():
        time, cpu_time = (
            frame.filter(cpu=core)[column].to_numpy() for column in ("time", "cpu_time")
        )
        first = np.maximum(np.searchsorted(time, start, side="right") - 1, 0)
        behind = np.searchsorted(time, end, side="left")
        total = np.concatenate(([0], np.cumsum(cpu_time)))
        count = behind - first
        used = np.where(count > 0, total[behind] - total[np.minimum(first, behind)], np.nan)
        rows.append(used / np.maximum(count, 1) / usual)
    return np.array(rows).reshape(len(ordinary), len(start))


def off_pace(
    recording: Recording, cycles: pl.DataFrame, ordinary: Mapping[int, float]
) -> pl.Series:
    """Whether a core ran faster or slower in a cycle than it ordinarily does."""
    start, end = (cycles[column].to_numpy() for column in ("start", "end"))
    pace = relative_pace(recording.events, start, end, ordinary)
    usual = (pace > 1 / OFF_PACE) & (pace < OFF_PACE)
    return pl.Series("off_pace", ~usual.all(axis=0))


def compare(name: str, measured: pl.DataFrame, simulated: pl.DataFrame) -> None:
    """Print how far apart the two are."""
    both = measured.join(simulated, on="cycle", suffix="_simulated")
    if both.is_empty():
        print(f"{name:<28}{0:>7}  the machine's pace has changed: nothing to compare")
        return
    ours = both["latency_ns_simulated"].to_numpy() / MS
    theirs = both["latency_ns"].to_numpy() / MS
    apart = np.abs(ours - theirs)
    maxima = abs(ours.max() / theirs.max() - 1)
    median, p99 = np.percentile(apart, [50, 99])
    met = median <= MEDIAN_MS and p99 <= P99_MS and maxima <= MAXIMA
    print(
        f"{name:<28}{len(both):>7}{median:>9.3f}{p99:>9.3f}{apart.max():>9.3f}"
        f"{(ours - theirs).mean():>9.3f}{theirs.max():>10.3f}{ours.max():>10.3f}{maxima:>8.2%}"
        f"  {'met' if met else 'missed'}"
    )


def shaped(
    described: Application, calibration: Recording, options: argparse.Namespace, folder: Path
) -> None:
    """Print how far apart the two are with one band and with three, servers in force."""
    other = described.model_copy(update={"seed": CALIBRATION_SEED})
    plans = {
        f"{bands} band{'s' if bands > 1 else ''}": plan_recording(
            calibration, request=PlanRequest(bands=bands, overrun="wait")
        )
        for bands in (1, 3)
    }
    configurations = [
        Configuration(f"{name}{which}", application, plan, servers=True)
        for name, plan in plans.items()
        for which, application in ((" calibration", other), ("", described), (" again", described))
    ]
    runs = live_in_turns(configurations, cycles=options.cycles, folder=folder)
    print(f"{sum(run.repeats for run in runs)} blocks repeated, in which the machine stood still")
    for name, plan in plans.items():
        blocks = [shaped_block(name, described, plan, block, folder) for block in range(BLOCKS)]
        measured, again, simulated = (pl.concat(frames) for frames in zip(*blocks, strict=True))
        not_stalled = measured.filter(~pl.col("disturbed"))
        calm_again = again.filter(~pl.col("disturbed"))
        compare(f"{name}, all", measured, simulated)
        compare(f"{name}, not stalled", not_stalled, simulated)
        compare(f"{name}, live again", not_stalled, calm_again)
        shares(plan, not_stalled, {"simulated": simulated, "live again": calm_again})


def shaped_block(
    name: str, described: Application, plan: Plan, block: int, folder: Path
) -> tuple[pl.DataFrame, ...]:
    """The cycles of a block: measured, measured again, and simulated with its calibration's costs.

    Cycles of block ``block`` are numbered from ``block`` million.
    """
    own = folder / f"block_{block}"
    measured, again = (
        by_cycle(
            open_recording(output_of(own, one)),
            int(output_of(own, f"{one}.in_force").read_text()),
        )
        for one in (name, f"{name} again")
    )
    shaping = [node.thread.node for node in shaping_nodes(plan)]
    costs = measured_costs(output_of(own, f"{name} calibration"), but_for=shaping)
    as_live = {"simulation": costs, "seed": block_seed(described, block)}
    most = int(measured["cycle"].max()) + 1  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as scratch:
        calibrated = described.model_copy(update=as_live)
        simulated = by_cycle(simulate(calibrated, Path(scratch) / "simulated", plan, cycles=most))
    numbered = pl.col("cycle") + block * 1_000_000
    return tuple(frame.with_columns(numbered) for frame in (measured, again, simulated))


def shares(plan: Plan, measured: pl.DataFrame, others: Mapping[str, pl.DataFrame]) -> None:
    """Print which share of outputs left with each band and which was late, of the same cycles."""
    starts = [start for start, _ in publish_slots(plan)]
    edges = [*starts, starts[0] + plan.cycle_ns]

    def of(frame: pl.DataFrame) -> npt.NDArray[np.float64]:
        place = np.searchsorted(edges, frame["latency_ns"].to_numpy(), side="right") - 1
        return np.bincount(np.maximum(place, 0), minlength=len(edges)) / max(len(frame), 1)

    for which, frame in others.items():
        same = of(measured.join(frame, on="cycle", how="semi"))
        theirs = of(frame.join(measured, on="cycle", how="semi"))
        apart = np.abs(same - theirs).max()
        met = "met" if apart <= SHARE_OF_BAND else "missed"
        for one, row in (("live", same), (which, theirs)):
            bands = ", ".join(f"{share:.1%}" for share in row[:-1])
            print(f"{'':<28}{one}: share per band {bands}; late {row[-1]:.1%}")
        print(f"{'':<28}at most {apart:.1%} apart, goal {SHARE_OF_BAND:.0%}  {met}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("application", nargs="?", default="examples/synthetic_chain.yaml")
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="keep the recordings here, and use those there")
    options = parser.parse_args()
    application = load_application(options.application)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        other_seed = application.model_copy(update={"seed": CALIBRATION_SEED})
        calibration = live(other_seed, folder / "calibration", CALIBRATION_CYCLES)
        costs = measured_costs(calibration)
        ordinary = ordinary_pace(calibration.events)
        if not ordinary:
            raise SystemExit("nobody watched the machine's pace: run it with real-time scheduling")
        for which, described in with_and_without_interference(application):
            recording = live(described, folder / which, options.cycles)
            measured = by_cycle(recording)
            not_stalled = measured.filter(~pl.col("disturbed"))
            at_pace = not_stalled.filter(~off_pace(recording, not_stalled, ordinary))
            print(
                f"\n{', '.join(described.nodes)}\n"
                f"{'|simulated − live|':<28}{'cycles':>7}{'median':>9}{'p99':>9}{'max':>9}"
                f"{'bias':>9}{'max live':>10}{'max sim.':>10}{'apart':>8}   (ms)"
            )
            calibrated = described.model_copy(update={"simulation": costs})
            for name, simulated in (("default costs", described), ("measured costs", calibrated)):
                path = Path(scratch) / f"{which} {name}"
                cycles = by_cycle(simulate(simulated, path, cycles=options.cycles))
                compare(f"{name}, not stalled", not_stalled, cycles)
                compare(f"{name}, at pace too", at_pace, cycles)
            print(f"{'goal':<28}{'':>7}{MEDIAN_MS:>9.3f}{P99_MS:>9.3f}{'':>38}{MAXIMA:>8.2%}")
        print("\nshaped, servers in force")
        shaped(application, calibration, options, folder)


if __name__ == "__main__":
    main()
