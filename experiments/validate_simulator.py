"""The simulator against the machine: same description, same seed, cycle by cycle.

    python experiments/validate_simulator.py [APP.yaml] [--cycles 1000] [--keep FOLDER]

The application runs live under SCHED_FIFO, with and without the nodes that only interfere, and with
the servers of its plan in force by freezing, with one band and with three. These cases take turns,
in blocks, and what waking up, taking and publishing cost is measured in a short run of the same
case with another seed just before each block: it changes with the machine. Execution times are the
same ones live and simulated. Every block runs twice, with the same execution times: no simulation
can be expected to be nearer to a run than another run is. With bands, outputs that missed the slot
they have in the simulation, or made one that they miss there, are off by a whole band or period: so
many of them as the median and p99 say. Recordings that are in FOLDER already are used.

Cycles that the machine stalled are left out of what is judged, on the stall meters' evidence and no
other. A simulation does not know either how the pace of the cores changes within a block: beside
what is judged stands the same without cycles in which it was another than in the block's short run,
by a factor of 1.5 or more.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from configurations import BLOCKS, Configuration, block_seed, live, live_in_turns, output_of
from measured_costs import measured_costs

from chainshaper import (
    load_application,
    measure_latency,
    open_recording,
    plan_recording,
    simulate,
)
from chainshaper.planning import ChainPlan, Plan, PlanRequest
from chainshaper.planning.chain_plan import publish_slots, shaping_nodes
from chainshaper.values import events
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application

MS = 1_000_000
MEDIAN_MS, P99_MS, MAXIMA = 0.3, 1.5, 0.03
"""The goals: of |simulated − measured| per cycle, and of the two maxima."""

SHARE_OF_BAND = 0.03
"""The goal of the share of cycles that leave with each band."""

CALIBRATION_SEED = 1_000_003
PROFILE_CYCLES = 100
OFF_PACE = 1.5


def with_and_without_interference(application: Application) -> Iterator[tuple[str, Application]]:
    """The application, and without nodes that exchange no messages with others if it has any."""
    yield "beside interference", application
    nodes = {
        name: node
        for name, node in application.nodes.items()
        if any(callback.publishes or callback.subscriptions for callback in node.callbacks)
    }
    if len(nodes) < len(application.nodes):
        yield "alone", application.model_copy(update={"nodes": nodes})


def by_cycle(output: Path, ordinary: Mapping[int, float] | None = None) -> pl.DataFrame:
    """Latency by the number of the cycle, whether the machine stalled it, and ran at another pace
    than ``ordinary``; of those cycles that began with all servers in force.

    Numbers are those of the chain's traversals, which count from the first that was recorded: a
    timer that is held over an expiry draws its next execution time in the cycle behind.
    """
    recording = open_recording(output)
    in_force = output.with_name(f"{output.name}.in_force")
    since_ns = int(in_force.read_text()) if in_force.exists() else 0
    frame = measure_latency(recording).analysis.traversals.drop_nulls("latency_ns")
    frame = frame.filter(pl.col("start") >= since_ns)
    columns = pl.col("traversal").alias("cycle"), "latency_ns", "disturbed"
    return frame.select(*columns, off_pace(recording, frame, ordinary or {}))


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


def block_of(
    name: str, described: Application, plan: ChainPlan | None, block: int, folder: Path
) -> tuple[pl.DataFrame, ...]:
    """The cycles of a block: measured, measured again, and simulated with default costs and with
    its calibration's.

    Cycles of block ``block`` are numbered from ``block`` million.
    """
    own = folder / f"block_{block}"
    calibration = open_recording(output_of(own, f"{name} calibration"))
    ordinary = ordinary_pace(calibration.events)
    measured, again = (by_cycle(output_of(own, one), ordinary) for one in (name, f"{name} again"))
    shaping = [node.thread.node for node in shaping_nodes(plan)] if plan else []
    costs = measured_costs(calibration, but_for=shaping)
    default = described.model_copy(update={"seed": block_seed(described, block)})
    frames = [measured, again]
    for one in (default, default.model_copy(update={"simulation": costs})):
        with tempfile.TemporaryDirectory() as scratch:
            most = int(measured["cycle"].max()) + 1  # type: ignore[arg-type]
            output, in_force = Path(scratch) / "simulated", Plan.of(plan) if plan else None
            simulate(one, output, in_force, cycles=most)
            frames.append(by_cycle(output))
    numbered = pl.col("cycle") + block * 1_000_000
    return tuple(frame.with_columns(numbered) for frame in frames)


def shares(plan: ChainPlan, measured: pl.DataFrame, others: Mapping[str, pl.DataFrame]) -> None:
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


def cases(
    described: Application, folder: Path
) -> Iterator[tuple[str, Application, ChainPlan | None]]:
    """What is compared: the application without a plan, and with plans from a run of its own."""
    for name, application in with_and_without_interference(described):
        yield name, application, None
    other = described.model_copy(update={"seed": CALIBRATION_SEED})
    live("profile", other, cycles=PROFILE_CYCLES, folder=folder)
    for bands in (1, 3):
        request = PlanRequest(bands=bands, overrun="wait")
        plan = plan_recording(output_of(folder, "profile"), request=request).chains[0]
        yield f"{bands} band{'s' if bands > 1 else ''}", described, plan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("application", nargs="?", default="examples/synthetic_chain.yaml")
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="keep the recordings here, and use those there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        all_cases = list(cases(load_application(options.application), folder))
        configurations = [
            Configuration(
                f"{name}{which}",
                application.model_copy(update={"seed": seed}),
                plan,
                servers=plan is not None,
            )
            for name, application, plan in all_cases
            for which, seed in (
                (" calibration", CALIBRATION_SEED),
                ("", application.seed),
                (" again", application.seed),
            )
        ]
        runs = live_in_turns(configurations, cycles=options.cycles, folder=folder)
        print(f"{sum(run.repeats for run in runs)} blocks repeated, the machine stood still")
        for name, application, plan in all_cases:
            report(
                name,
                plan,
                [block_of(name, application, plan, block, folder) for block in range(BLOCKS)],
            )


def report(name: str, plan: ChainPlan | None, blocks: list[tuple[pl.DataFrame, ...]]) -> None:
    """Print how far a case is apart from its simulation, and from itself."""
    measured, again, default, simulated = (
        pl.concat(frames) for frames in zip(*blocks, strict=True)
    )
    not_stalled, again = (frame.filter(~pl.col("disturbed")) for frame in (measured, again))
    print(
        f"\n{name}\n{'|simulated − live|':<28}{'cycles':>7}{'median':>9}{'p99':>9}{'max':>9}"
        f"{'bias':>9}{'max live':>10}{'max sim.':>10}{'apart':>8}   (ms)"
    )
    compare("default costs", not_stalled, default)
    compare("stalled ones too", measured, simulated)
    compare("judged: not stalled", not_stalled, simulated)
    compare("not stalled, at pace", not_stalled.filter(~pl.col("off_pace")), simulated)
    compare("live again", not_stalled, again)
    if plan:
        shares(plan, not_stalled, {"simulated": simulated, "live again": again})
    print(f"{'goal':<28}{'':>7}{MEDIAN_MS:>9.3f}{P99_MS:>9.3f}{'':>38}{MAXIMA:>8.2%}")


if __name__ == "__main__":
    main()
