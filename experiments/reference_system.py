"""The field's own benchmark of executors, ros-realtime's reference system, as it is and shaped.

    python experiments/reference_system.py [--seconds 30] [--blocks 5] [--keep FOLDER]

`autoware_reference_system` is a graph like Autoware's: 24 nodes in one process. Its hot path leads
from two lidars over their fusion to the ObjectCollisionEstimator. It runs as its executables have
it, under real-time priorities by hand, and shaped by one command, with interference beside it. The
system is neither part of this repository nor built by it: an environment in which it was built
(https://github.com/ros-realtime/reference-system) has to be sourced. It needs one executable that
upstream has not: `autoware_default_events`, the single-threaded one with rclcpp's EventsExecutor.
Without ROS 2 or one of the executables the script says so, and the earlier results stay.

**Calibration.** Upstream wants each node to compute for about 10 ms. Together its callbacks run
:data:`CALLS` times a second, so that would be 1.9 cores, and a single-threaded executor has one.
Here it shares two cores with two programs that compute all the time, so half a core is sure. A node
may fill 80 % of that: 2.1 ms. The limit for that is printed from upstream's own benchmark of the
machine, and what nodes took is in the results.

**By hand** is `autoware_default_prioritized`: SCHED_RR 1 for the hot path's three executors on core
1, 30 for the planner's on core 0. `autoware_default_cbg` means to do the same for callback groups,
but with Jazzy's rclcpp the EuclideanClusterDetector's hot callback ran on the executor of the rest.

**Two latencies.** The program prints a hot path latency that ends when the
ObjectCollisionEstimator's callback begins, counted from the later lidar. Shaping acts behind that,
so the latency until its publication is measured from recordings too, from the front lidar's timer.
"""

import argparse
import math
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from configurations import (
    BLOCKS,
    first_cycles,
    joined,
    latencies_of,
    missing_for_live,
    missing_for_ros,
    output_of,
    taking_turns,
)
from numpy.typing import NDArray
from on_ros import record_shaped
from results import (
    HERE,
    MS,
    RESULTS,
    Line,
    Run,
    Value,
    earlier_runs,
    figure,
    figures_of,
    machines_of,
    save,
    value_text,
)

from chainshaper import callback_statistics, data_flow, open_recording, shape_launch
from chainshaper.flow.record import record_command
from chainshaper.planning import PlanRequest
from chainshaper.values.recording import Recording

NAME = "reference_system"
PACKAGE = "autoware_reference_system"
LAUNCH = HERE / f"{NAME}.launch.xml"
CHAIN = "/FrontLidarDriver../ObjectCollisionEstimator"

REQUEST = PlanRequest(
    epsilon_ns=2_000_000, publication="in-process", best_effort=("/EuclideanClusterSettings",)
)
"""The EuclideanClusterDetector, a node of the hot path, has another callback on the same thread,
which a node beside the path triggers every 25 ms. It ran in 26 to 89 % of the path's cycles, and
made them 2.2 ms longer. `plan` says so, and what helps: that node runs when the hot path does not.

With a margin of 2 ms the slot is earlier than the longest latency by hand still, and later than
cycles in which the machine is slower than usual, and every callback up to 15 % longer.

The gate is in the program's own process: with a shaping node and its standby beside it DDS finds
more participants, the program's nodes are created three times as slowly, and its two lidars'
timers, which begin as they are created, stood 2.8 to 4.6 ms apart instead of 1.0 to 1.5: another
chain than the one that was profiled."""

CALLS = 7 * 10 + 40 + 6 * 1000 / 120 + 3 * 10
"""Crunching callbacks a second: the lidars' seven, the EuclideanClusterSettings' of 25 ms, the six
that follow the point cloud map's 120 ms, and planner, controller and vehicle interface."""
SURE_CORES, FILLED = 0.5, 0.8
CRUNCH_MS = 1000 * SURE_CORES * FILLED / CALLS

SECOND, PROFILED_S = 1_000_000_000, 60
SETTLING_S = 9
"""So long after its launch all of it runs, the interference too, and shaping is in force."""
UNCOUNTED = 60
"""So many of the program's first printed values are left out: 6 s, as it starts 3 s late."""

WHATS = ("average", "maximum", "p0.5–p99.5")
PRINTED = {
    "hot path": re.compile(r"hot path latency: +([-+.\de]+)ms"),
    "planner's period": re.compile(r"behavior planner period: +([-+.\de]+)ms"),
}
DROPS = re.compile(r"hot path drops: +(\d+)")
LAUNCHED = "All log files can be found below"

GOAL_MS, GOAL_LONGER = 0.1, 1.02


@dataclass(frozen=True)
class Configuration:
    """An executable of the reference system, as it is or shaped."""

    name: str
    executable: str
    shaped: bool = False


CONFIGURATIONS = (
    Configuration("single-threaded", "autoware_default_singlethreaded"),
    Configuration("static", "autoware_default_staticsinglethreaded"),
    Configuration("multi-threaded", "autoware_default_multithreaded"),
    Configuration("events", "autoware_default_events"),
    Configuration("by hand", "autoware_default_prioritized"),
    Configuration("shaped", "autoware_default_prioritized", shaped=True),
)


@dataclass(frozen=True)
class Block:
    """What one block of a configuration gave; ``printed`` has the program's own figures in ns."""

    latency: Run
    printed: Mapping[str, Run]
    drops: int
    response_ns: float


def missing_here() -> str:
    """Why the system cannot be measured here; nothing, where it can."""
    if reason := missing_for_live() or missing_for_ros():
        return reason
    if not (folder := executables()).is_dir():
        return (
            f"{PACKAGE} is not in this environment: clone"
            " https://github.com/ros-realtime/reference-system, build it as its README says, and"
            " source its workspace"
        )
    names = sorted({one.executable for one in CONFIGURATIONS})
    absent = ", ".join(name for name in names if not (folder / name).exists())
    return absent and f"{folder} has no {absent}, which are compared here"


def executables() -> Path:
    """The folder of the reference system's executables, whether it is there or not."""
    prefixes = map(Path, os.environ["AMENT_PREFIX_PATH"].split(":"))
    folders = [prefix / "lib" / PACKAGE for prefix in prefixes]
    return next((one for one in folders if one.is_dir()), folders[0])


def limit_for(benchmark: str, wanted_ms: float) -> int:
    """The number cruncher's limit that takes this long, by its benchmark's fastest runs."""
    rows = sorted((int(n), -float(ms)) for n, ms in re.findall(r"(\d+) +([.\de+-]+)ms", benchmark))
    fastest = {limit: -ms for limit, ms in rows}
    limits, times = [*fastest], [*fastest.values()]
    return round(math.exp(np.interp(math.log(wanted_ms), np.log(times), np.log(limits))))


def recorded(one: Configuration, output: Path, seconds: int, shaped: Path) -> tuple[Recording, str]:
    """The recording of one block, and what the program printed in it; measured if not there yet."""
    log, words = output.with_suffix(".txt"), launch_of(one)
    if not output.exists():
        with log.open("w") as text:
            record: Callable[..., object]
            if one.shaped:
                record = partial(record_shaped, shaped, words, output, chain=CHAIN)
            else:
                record = partial(record_command, output, words, watch_stalls=True)
            lasting_s = seconds if one.shaped else seconds + SETTLING_S
            record(duration_ns=lasting_s * SECOND, command_stdout=text.fileno())
    return open_recording(output), log.read_text().rpartition(LAUNCHED)[2]


def launch_of(one: Configuration) -> list[str]:
    return ["ros2", "launch", str(LAUNCH), f"executable:={one.executable}"]


def block_of(one: Configuration, recording: Recording, text: str) -> Block:
    """What a recording and the printed text say, from when all of it ran."""
    starts = recording.events["callback_start"]["time"]
    since_ns = 0 if one.shaped else int(starts.min()) + (SETTLING_S - 3) * 1000 * MS  # type: ignore[arg-type]
    run = latencies_of(one.name, recording, CHAIN, column="ros", since_ns=since_ns)
    ended = 1 + int(np.flatnonzero(run.latency_ns >= 0)[-1])  # the last was under way at the end
    run = first_cycles(run, ended)
    printed = {}
    for what, pattern in PRINTED.items():
        values = np.array([float(value) for value in pattern.findall(text)[UNCOUNTED:]])
        ns, calm = (values * MS).astype(np.int64), np.zeros(values.size, np.bool_)
        printed[what] = Run(f"{one.name}, printed {what}", "ros", ns, calm)
    drops = sum(int(count) for count in DROPS.findall(text)[UNCOUNTED:])
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    own = (pl.col("node") == "/PointsTransformerFront") & (pl.col("topic") == "/FrontLidarDriver")
    response = callback_statistics(flow).filter(own)["response_ns"].struct.field("mean")
    return Block(run, printed, drops, float(response.item()))


def in_turns(folder: Path, *, seconds: int, blocks: int) -> dict[str, tuple[list[Block], int]]:
    """The blocks of each configuration, A B … A B …, and how many of them were repeated.

    The one command comes first; all shaped blocks have its plan.
    """
    shaped, (one,) = folder / "shaped", [own for own in CONFIGURATIONS if own.shaped]
    if not (shaped / "comparison.json").exists():
        shutil.rmtree(shaped, ignore_errors=True)
        folder.mkdir(exist_ok=True, parents=True)
        lasting = max(seconds, PROFILED_S) * SECOND
        shape_launch(launch_of(one), shaped, chain=CHAIN, request=REQUEST, duration_ns=lasting)

    def measure(number: int, block: int) -> tuple[Block, Path]:
        one, own = CONFIGURATIONS[number], folder / f"block_{block}"
        own.mkdir(exist_ok=True, parents=True)
        output = output_of(own, one.name)
        print(f"block {block + 1} of {blocks}, {one.name}", flush=True)
        recording, text = recorded(one, output, seconds, shaped)
        return block_of(one, recording, text), recording.path

    turns = taking_turns(len(CONFIGURATIONS), blocks, measure)
    return {one.name: own for one, own in zip(CONFIGURATIONS, turns, strict=True)}


def value_of(what: str, latency_ns: NDArray[np.int64]) -> Value:
    """One figure in ms, None of nothing."""
    if what != "p0.5–p99.5" or not latency_ns.size:
        return figure(what, latency_ns)
    low, high = np.percentile(latency_ns, (0.5, 99.5))
    return float(high - low) / MS


def lines_of_run(run: Run) -> Iterator[Line]:
    """The figures of one run, of undisturbed cycles and of all that came to an end."""
    about: dict[str, Any] = {"simulated": None, "live": None, "machines": machines_of([run])}
    for what in WHATS:
        of = partial(value_of, what)
        values, intervals = figures_of(run, of, of)
        yield Line(f"{run.name}: {what}", "ms", None, **about, **values, intervals=intervals)


def runs_of(found: Mapping[str, tuple[Sequence[Block], int]]) -> list[Run]:
    """Each configuration's latencies, and what the program printed of itself.

    Drops and what a node computes are facts of the run.
    """
    runs = list[Run]()
    for blocks, repeats in found.values():
        crunch = float(np.mean([block.response_ns for block in blocks])) / MS
        drops = sum(block.drops for block in blocks)
        latency = joined([block.latency for block in blocks], repeats)
        runs.append(replace(latency, facts={DROPPED: drops, RESPONSE: crunch}))
        for figure_name in PRINTED:
            runs.append(joined([block.printed[figure_name] for block in blocks], repeats))
    return runs


def lines(runs: Sequence[Run]) -> list[Line]:
    """All figures of all runs, one configuration after the other."""
    made = list[Line]()
    for configuration in CONFIGURATIONS:
        configured = [run for run in runs if run.name.partition(",")[0] == configuration.name]
        for run in configured:
            made += lines_of_run(run)
        for run in configured:
            if run.name == configuration.name:
                about: dict[str, Any] = {"simulated": None, "live": None, "paper": None}
                about |= {"machines": machines_of([run])}
                lost = int((run.latency_ns < 0).sum())
                name = f"{configuration.name}: without an end"
                made.append(Line(name, "cycles", ros_all=lost, **about))
                for fact, title, unit in FACTS:
                    name, value = configuration.name + title, run.facts.get(fact)
                    made.append(Line(name, unit, ros_all=value, **about))
    return made


DROPPED, RESPONSE = "printed drops", "a node's mean response (ms)"
FACTS = (
    (DROPPED, ", printed hot path: drops", "cycles"),
    (RESPONSE, ": a node's mean response", "ms"),
)

COLUMNS = (
    ("maximum", ": maximum"),
    ("p0.5–p99.5", ": p0.5–p99.5"),
    ("without an end", ": without an end"),
    ("printed maximum", ", printed hot path: maximum"),
    ("printed p0.5–p99.5", ", printed hot path: p0.5–p99.5"),
    ("printed drops", ", printed hot path: drops"),
    ("planner's period p0.5–p99.5", ", printed planner's period: p0.5–p99.5"),
)


def notes(lines: Sequence[Line], shaped: Sequence[Block], seconds: int) -> str:
    """One row per configuration over all cycles, whether the goal is met, also in the single blocks
    that were ``shaped``, and what is not kept.
    """
    of = {line.what: line.ros_all for line in lines}
    names = [one.name for one in CONFIGURATIONS]
    table = [f"| all cycles, ms | {' | '.join(title for title, _ in COLUMNS)} |"]
    table.append(f"|---|{'---:|' * len(COLUMNS)}")
    for name in names:
        cells = (value_text(of[f"{name}{suffix}"]) for _, suffix in COLUMNS)
        table.append(f"| {name} | {' | '.join(cells)} |")

    def best(suffix: str) -> float:
        return min(float(of[f"{name}{suffix}"] or 0) for name in names[:-1])

    spread, longest = (
        float(of[f"shaped{suffix}"] or 0) for suffix in (": p0.5–p99.5", ": maximum")
    )
    lost, dropped = ": without an end", ", printed hot path: drops"
    fewer = all(int(of[f"shaped{one}"] or 0) <= best(one) for one in (lost, dropped))
    share = longest / best(": maximum")
    goals = (
        (f"p0.5–p99.5 {value_text(spread)} ms, goal {GOAL_MS} ms", spread <= GOAL_MS),
        ("no more drops than the best other", fewer),
        (f"maximum {share:.1%} of the best other's, goal {GOAL_LONGER:.0%}", share <= GOAL_LONGER),
    )
    verdict = "; ".join(f"{text}: {'met' if met else '**not met**'}" for text, met in goals)
    finished = (one.latency.latency_ns[one.latency.latency_ns >= 0] for one in shaped)
    single = ", ".join(value_text(value_of("p0.5–p99.5", one)) for one in finished)
    return (
        "\n".join(table)
        + f"\n\nShaped, over all cycles: {verdict}. "
        + f"p0.5–p99.5 of the single blocks: {single} ms.\n\n"
        + f"{len(shaped)} blocks of {seconds} s, two programs that compute all the time beside"
        + " each."
        + f" What is not kept: a node computes for {CRUNCH_MS:.1f} ms at the most instead of about"
        + f" 10 ms ({CALLS:.0f} callbacks a second would fill {CALLS / 100:.1f} cores); two cores"
        + " of a virtual machine, shared with others, instead of four of a Raspberry Pi 4; no core"
        + " is isolated, and the clock frequency is not fixed. `printed` is what the program says"
        + " of itself: up to the beginning of the last callback, before the shaping node."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--simulated", action="store_true", help="keep the results of the last time"
    )
    parser.add_argument("--seconds", type=int, default=30, help="of every block")
    parser.add_argument("--blocks", type=int, default=BLOCKS, help="of every configuration")
    parser.add_argument("--keep", type=Path, help="keep recordings here, and use those there")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder to write results to")
    given = parser.parse_args()
    title = "The reference system of ROS 2's real-time working group, not in the paper"
    missing = "" if given.simulated else missing_here()
    if missing or given.simulated:
        print(f"not measured: {missing}" if missing else "not measured")
        if runs := earlier_runs(NAME, "ros", folder=given.results):
            save(NAME, title, lines, runs=runs, folder=given.results)
        return
    benchmark = executables() / "number_cruncher_benchmark"
    times = (subprocess.check_output([benchmark], text=True) for _ in range(3))
    said = "".join(times)
    print(f"{CRUNCH_MS:.2f} ms a node: a limit of {limit_for(said, CRUNCH_MS)} on this machine")
    with ExitStack() as until:
        keep = given.keep or Path(until.enter_context(tempfile.TemporaryDirectory()))
        found = in_turns(keep, seconds=given.seconds, blocks=given.blocks)
    runs = runs_of(found)
    said = notes(lines(runs), found["shaped"][0], given.seconds)
    save(NAME, title, lines, runs=runs, notes=said, folder=given.results)
    print(said)


if __name__ == "__main__":
    main()
