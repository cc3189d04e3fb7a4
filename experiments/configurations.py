"""One configuration of an experiment, simulated or live, as latencies; and drawing them.

A configuration is an application and a plan, or none. Without a plan the application runs under
SCHED_FIFO. A plan that shapes is carried out by its shaping nodes, or by gating the thread of the
asynchronous publisher, as `chainshaper shape` does it: the executors' priorities isolate the chain.
A plan that has servers only, or one that is to have all its servers in force (``servers``), is
carried out by freezing the application's threads, as `chainshaper apply` does it.

Live, configurations that are compared take turns, in blocks: A B A B …, so that what the machine
does to one it does to the other as well. Every block draws execution times of its own, which a plan
that was made before has not seen.

    with ExitStack() as until:
        options = parse_options(__doc__, cycles=200, until=until)
        runs = [simulated("FIFO", application, cycles=options.simulated_cycles)]
        if options.live:
            live("profile", application, cycles=options.cycles, folder=options.keep)
            plan = plan_recording(options.keep / "profile").chains[0]
            both = Configuration("FIFO", application), Configuration("1 band", application, plan)
            runs += live_in_turns(both, cycles=options.cycles, folder=options.keep)
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import polars as pl
import yaml
from results import MS, Column, Run

from chainshaper import (
    apply_plan,
    measure_latency,
    open_recording,
    run_application,
    shape_application,
    simulate,
)
from chainshaper.enforcement.undoing import RunState
from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.chain_plan import Slot, publisher_servers
from chainshaper.splicing.application import splice_application
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, application_as_written

__all__ = [
    "Configuration",
    "Options",
    "Panel",
    "block_seed",
    "draw_latencies",
    "first_cycles",
    "joined",
    "latencies_of",
    "live",
    "live_in_turns",
    "missing_for_live",
    "missing_for_ros",
    "output_of",
    "parse_options",
    "simulated",
    "taking_turns",
]

BEFORE_IN_FORCE = 80
"""Cycles that a command runs longer: finding the nodes and measuring their phase takes a while."""

BLOCKS = 5
MOST_REPEATS = 3
STOOD_STILL = 0.01
"""A block is repeated where a core stood still for a larger share of it, whatever its latencies."""

T = TypeVar("T")

COLOURS = ("#d95f02", "#1b6ca8", "#4d9221", "#7b3294")


@dataclass(frozen=True)
class Options:
    """How an experiment is run; ``keep`` is where recordings and plans of measured runs are."""

    live: bool
    ros: bool
    cycles: int
    simulated_cycles: int
    keep: Path


def parse_options(
    about: str, *, cycles: int, simulated_cycles: int = 10_000, until: ExitStack
) -> Options:
    """The command line that every experiment has; the reason is printed for runs that cannot be.

    Recordings are removed as ``until`` ends, unless `--keep FOLDER` says where they stay: those
    that are there already are used, and not measured again.
    """
    parser = argparse.ArgumentParser(description=about.partition("\n")[0])
    parser.add_argument("--simulated", action="store_true", help="nothing is measured")
    parser.add_argument("--without", choices=("live", "ros"), help="this is not measured")
    parser.add_argument("--cycles", type=int, default=cycles, help="of every measured run")
    parser.add_argument("--simulated-cycles", type=int, default=simulated_cycles)
    parser.add_argument("--keep", type=Path, help="keep recordings here, and use those there")
    given = parser.parse_args()
    missing = missing_for_live()
    measured = {
        "live": not missing and given.without != "live",
        "ros": not (missing or missing_for_ros()) and given.without != "ros",
    }
    if not given.simulated:
        for reason in filter(None, (missing, missing_for_ros())):
            print(f"not measured: {reason}")
    keep = given.keep or Path(until.enter_context(tempfile.TemporaryDirectory()))
    keep.mkdir(parents=True, exist_ok=True)
    live, ros = (one and not given.simulated for one in measured.values())
    return Options(live, ros, given.cycles, given.simulated_cycles, keep)


def missing_for_live() -> str:
    if len(available_cores()) < 2:
        return "a live run needs two cores, one of them for the threads of DDS"
    if not may_use_fifo():
        return "a live run needs SCHED_FIFO: run as root, or with an rtprio limit of 98"
    return ""


def missing_for_ros() -> str:
    needed = [one for one in ("ros2", "colcon") if shutil.which(one) is None]
    if needed or "AMENT_PREFIX_PATH" not in os.environ:
        return f"runs on ROS 2 need it sourced, and {', '.join(needed) or 'AMENT_PREFIX_PATH'}"
    return ""


def simulated(
    name: str,
    application: Application,
    plan: ChainPlan | None = None,
    *,
    cycles: int,
    chain: str | None = None,
) -> Run:
    """Simulate a configuration; the latencies of its chain, or of ``chain``, cycle by cycle.

    Raises: as :func:`chainshaper.simulate`.
    """
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate(
            application, Path(folder) / "simulated", Plan.of(plan) if plan else None, cycles=cycles
        )
        return latencies_of(name, recording, chain)


def live(
    name: str,
    application: Application,
    plan: ChainPlan | None = None,
    *,
    cycles: int,
    folder: Path,
    chain: str | None = None,
    servers: bool = False,
) -> Run:
    """Run a configuration; its recording is `FOLDER/NAME`, and is used if it is there already.

    ``chain`` as in :func:`simulated`. ``servers`` puts all servers of a plan in force by freezing,
    also where its shaping node could do without.

    Raises:
        PlatformError: SCHED_FIFO, freezing threads or a core is not to be had here.
        OperationError: a run failed, or the servers were not in force before it ended.
    """
    output = output_of(folder, name)
    in_force = output.with_name(f"{output.name}.in_force")
    if not output.exists():
        print(f"{application.name}, {name}: {cycles} cycles live", flush=True)
        if plan is None:
            run_application(application, output, cycles=cycles, realtime=True)
        elif servers or not _shapes(plan):
            in_force.write_text(str(_apply(application, plan, output, cycles)))
        else:
            shape_application(application, Plan.of(plan), output, cycles=cycles, realtime=True)
    since = int(in_force.read_text()) if in_force.exists() else 0
    found = latencies_of(name, open_recording(output), chain, since_ns=since)
    return first_cycles(found, cycles)


def first_cycles(run: Run, cycles: int) -> Run:
    reception = None if run.reception_ns is None else run.reception_ns[:cycles]
    latency, disturbed = run.latency_ns[:cycles], run.disturbed[:cycles]
    return replace(run, latency_ns=latency, disturbed=disturbed, reception_ns=reception)


@dataclass(frozen=True)
class Configuration:
    """What :func:`live` runs, when it takes turns with others."""

    name: str
    application: Application
    plan: ChainPlan | None = None
    chain: str | None = None
    servers: bool = False


def live_in_turns(
    configurations: Sequence[Configuration], *, cycles: int, folder: Path, blocks: int = BLOCKS
) -> list[Run]:
    """Run configurations one after the other, and all again, until each has had ``blocks`` turns.

    Recordings are `FOLDER/block_N/NAME`; configurations of one name, with other chains, share them.
    Raises: as :func:`live`.
    """

    def measure(number: int, block: int) -> tuple[Run, Path]:
        one, own = configurations[number], folder / f"block_{block}"
        own.mkdir(exist_ok=True)
        seed = block_seed(one.application, block)
        run = live(
            one.name,
            one.application.model_copy(update={"seed": seed}),
            one.plan,
            cycles=-(-cycles // blocks),
            folder=own,
            chain=one.chain,
            servers=one.servers,
        )
        return run, output_of(own, one.name)

    return [joined(*one) for one in taking_turns(len(configurations), blocks, measure)]


def block_seed(application: Application, block: int) -> int:
    """What execution times of a block are drawn from: others than a profile's, which has the seed
    of the application itself.
    """
    return application.seed + 1 + block


def taking_turns(
    count: int, blocks: int, measure: Callable[[int, int], tuple[T, Path]]
) -> list[tuple[list[T], int]]:
    """Measure one of ``count`` configurations after the other, and all again in the next block.

    ``measure`` gets the number of a configuration and of a block; it gives what it measured and the
    recording. Blocks in which the machine stood still are measured again, three of a configuration
    at most. Of each configuration come what was measured in its blocks, and how many were repeated.
    """
    found: list[list[T]] = [[] for _ in range(count)]
    repeats = [0] * count
    for block in range(blocks):
        for number, own in enumerate(found):
            one, output = measure(number, block)
            while repeats[number] < MOST_REPEATS and stood_still(open_recording(output)):
                repeats[number] += 1
                shutil.rmtree(output)
                one, output = measure(number, block)
            own.append(one)
    return list(zip(found, repeats, strict=True))


def stood_still(recording: Recording) -> bool:
    """Whether a core stood still for more than 1 % of a recording, by its stall meters."""
    stalls, starts = recording.events["machine_stall"], recording.events["callback_start"]["time"]
    longest = stalls.group_by("cpu").agg(pl.col("duration").sum())["duration"].max() or 0
    lasted = int(starts.max()) - int(starts.min())  # type: ignore[arg-type]
    return int(longest) > STOOD_STILL * lasted  # type: ignore[arg-type]


def joined(blocks: Sequence[Run], repeats: int) -> Run:
    """The blocks of one configuration as one run."""
    receptions = [block.reception_ns for block in blocks if block.reception_ns is not None]
    return replace(
        blocks[0],
        latency_ns=np.concatenate([block.latency_ns for block in blocks]),
        disturbed=np.concatenate([block.disturbed for block in blocks]),
        block=np.repeat(np.arange(len(blocks)), [block.latency_ns.size for block in blocks]),
        repeats=repeats,
        reception_ns=np.concatenate(receptions) if len(receptions) == len(blocks) else None,
    )


def output_of(folder: Path, name: str) -> Path:
    return folder / name.replace(" ", "_")


def latencies_of(
    name: str,
    recording: Recording,
    chain: str | None = None,
    *,
    column: Column | None = None,
    since_ns: int = 0,
) -> Run:
    """The latencies of a recorded chain, of the cycles that began at ``since_ns`` or later.

    ``column`` is where it was recorded; by default, the recording tells.
    """
    analysis = measure_latency(recording, chain).analysis
    frame = analysis.traversals.filter(pl.col("start") >= since_ns).sort("start")
    received = analysis.subscriber is not None
    return Run(
        name,
        column or ("live" if recording.info.source == "live" else "simulated"),
        latency_ns=frame["latency_ns"].fill_null(-1).to_numpy(),
        disturbed=frame["disturbed"].to_numpy(),
        reception_ns=frame["reception_ns"].fill_null(-1).to_numpy() if received else None,
    )


def _shapes(plan: ChainPlan) -> bool:
    return plan.shaping_node is not None or any(publisher_servers(plan))


def _apply(application: Application, plan: ChainPlan, output: Path, cycles: int) -> int:
    """Put a plan in force on `chainshaper run`; since when (CLOCK_MONOTONIC, ns) all of it is."""
    described = output.with_name(f"{output.name}_application.yaml")
    spliced = splice_application(application, Plan.of(plan)) if _shapes(plan) else application
    described.write_text(yaml.safe_dump(application_as_written(spliced), sort_keys=False))
    seen: list[int] = []

    def watch(state: RunState) -> None:
        gated = [server for server in state.servers if server.kept_by != "gate"]
        if not seen and all(server.counters.slots for server in gated):
            seen.append(time.monotonic_ns())

    run = [sys.executable, "-m", "chainshaper", "run", str(described), "-o", str(output)]
    command = [*run, "--cycles", str(cycles + BEFORE_IN_FORCE)]
    done = apply_plan(Plan.of(plan), command, back_end="freezer", watch=watch)
    if done.exit_code or not seen:
        raise OperationError(
            f"{output.name}: the servers were not in force before the run ended, which was with"
            f" exit code {done.exit_code}: run the experiment again"
        )
    return seen[0]


@dataclass(frozen=True)
class Panel:
    """One picture of latencies over cycles; the times at which ``slots`` are open are shaded."""

    title: str
    runs: Sequence[Run]
    slots: Sequence[Slot] = ()


def draw_latencies(
    path: Path, panels: Sequence[Panel], *, columns: int = 1, most: int = 400
) -> Path:
    """Latencies over cycles, one panel beside the other; ``most`` cycles of a run are drawn.

    Crosses are cycles that the machine disturbed; the longest undisturbed one ends the axis.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = -(-len(panels) // columns)
    figure, grid = plt.subplots(
        rows,
        columns,
        figsize=(4.6 * max(columns, 1.6), 2.9 * rows),
        layout="constrained",
        squeeze=False,
        sharey=True,
    )
    highest = max(int(run.undisturbed_ns.max()) for panel in panels for run in panel.runs)
    for axes, panel in zip(grid.flat, panels, strict=False):
        for start, end in panel.slots:
            axes.axhspan(start / MS, end / MS, color="0.8", zorder=0)
        for run, colour in zip(panel.runs, COLOURS, strict=False):
            cycles, latency = np.arange(run.latency_ns.size)[:most], run.latency_ns[:most] / MS
            calm, hit = (  # what came to no end is not drawn
                (latency >= 0) & marks for marks in (~run.disturbed[:most], run.disturbed[:most])
            )
            axes.plot(cycles[calm], latency[calm], ".", markersize=3, color=colour, label=run.name)
            axes.plot(cycles[hit], latency[hit], "x", markersize=4, color=colour, alpha=0.6)
        axes.set_title(panel.title, loc="left", fontsize=9)
        axes.set_ylim(0, highest / MS * 1.1)
        axes.grid(alpha=0.3)
        if len(panel.runs) > 1:
            axes.legend(loc="lower right", fontsize=8)
    for axes in grid[-1]:
        axes.set_xlabel("cycle")
    for row in grid:
        row[0].set_ylabel("latency [ms]")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path
