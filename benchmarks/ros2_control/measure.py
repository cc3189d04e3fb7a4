"""How old is a command when ros2_control hands it to the hardware: unshaped, shaped, in step?

    source /opt/ros/jazzy/setup.bash
    python benchmarks/ros2_control/measure.py --output FOLDER [--rate 100] [--seconds 60]
        [--chain paper|short] [--tick PPM] [--rows plain in-step move-loop] [--long SECONDS]

A chain of C++ nodes ends at a forward controller of ros2_control, whose update thread runs at
``--rate`` Hz. `chainshaper shape -- ros2 launch` measures it, plans, and runs it shaped: without
more (``plain``), with the output in step with the loop (``in-step``), and with the loop in step
with the output (``move-loop``). With ``--tick`` the hardware blocks in `read()` on a clock of its
own, which is so many ppm slower than the chain's.

The **hardware notes** at each `write()` which command it got; that is what the table shows, over
all cycles of the recording: the age of a command at its first use, from the start of its chain
(p0.5, median, p99.5, largest, spread p0.5-p99.5), commands that were used once, twice, more often
and never, and the same spread as `chainshaper latency` has it, with the share of turns in which
both name the same command. ``--long`` applies the last plan once more for so long, without a
recording: only the hardware's notes say how it went. Nothing is asserted.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.analysis import analyse_latency
from chainshaper.splicing.node_packages import SETUP
from chainshaper.splicing.spliced_launch import NODES

HERE = Path(__file__).resolve().parent
MS = 1_000_000
CHAIN = "/t1../controller_manager:write"
PERIODS_NS = {"paper": 100 * MS, "short": 20 * MS}
CHAINS = {
    # Section 2.5 of the paper: five callbacks of 5 to 15 ms, every 100 ms.
    "paper": {
        "node1": ["/t1", "5000", "15000", "every", "100000"],
        "node2": ["/t2", "5000", "15000", "on", "/t1"],
        "node3": ["/t3", "5000", "15000", "on", "/t2"],
        "node4": ["/t4", "5000", "15000", "on", "/t3"],
        "node5": ["/forward/commands", "5000", "15000", "on", "/t4"],
    },
    "short": {
        "node1": ["/t1", "200", "500", "every", "20000"],
        "node2": ["/forward/commands", "2000", "8000", "on", "/t1"],
    },
}
DESCRIPTION = """\
<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="arm"/>
  <joint name="joint1" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1e18" upper="1e18" effort="10" velocity="10"/>
  </joint>
  <ros2_control name="arm" type="system">
    <hardware><plugin>chainshaper_benchmark/Witness</plugin>{tick}</hardware>
    <joint name="joint1">
      <command_interface name="position"/><state_interface name="position"/>
    </joint>
  </ros2_control>
</robot>
"""
PARAMETERS = """\
controller_manager:
  ros__parameters:
    update_rate: {rate}
    hardware_synchronization: {{expect_blocking_read_write: {blocks}}}
forward:
  ros__parameters:
    type: forward_command_controller/ForwardCommandController
    joints: [joint1]
    interface_name: position
"""
OPTIONS = {"plain": [], "in-step": ["--in-step"], "move-loop": ["--move-loop"]}


@dataclass(frozen=True)
class Used:
    """What the hardware got: ns; ``uses`` counts the turns that used each command."""

    first_ages: npt.NDArray[np.int64]
    uses: npt.NDArray[np.int64]
    never: int


def main() -> None:
    parser = argparse.ArgumentParser(description="The age of ros2_control's commands.")
    parser.add_argument("--output", type=Path, required=True, help="where all files stay")
    parser.add_argument("--rate", type=int, nargs="+", default=[100], metavar="HZ")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--chain", choices=CHAINS, default="paper")
    parser.add_argument("--tick", type=float, metavar="PPM", help="hardware blocks in read()")
    parser.add_argument("--rows", nargs="+", choices=OPTIONS, default=list(OPTIONS))
    parser.add_argument("--long", type=int, metavar="SECONDS", help="apply the last plan so long")
    chosen = parser.parse_args()
    if "AMENT_PREFIX_PATH" not in os.environ:
        sys.exit("error: source ROS 2 first: source /opt/ros/DISTRO/setup.bash")
    output = chosen.output.resolve()
    if output.exists():
        parser.error(
            f"{output} exists: name a folder that does not, so that nothing is overwritten"
        )
    output.mkdir(parents=True)
    prefix = build(output)
    for rate in chosen.rate:
        folder = output / f"{rate}_Hz"
        environment = arm(folder, prefix, rate, chosen.chain, chosen.tick)
        middleware = os.environ.get("RMW_IMPLEMENTATION", "the default middleware")
        table = new_table(f"{chosen.chain} chain, {rate} Hz, {middleware} [ms]")
        before_is_shown = False
        for row in chosen.rows:
            shape(folder / row, OPTIONS[row], chosen.seconds, environment)
            if not before_is_shown:
                add_recorded(table, "unshaped", folder / row / "before", folder, chosen.chain)
                before_is_shown = True
            name = "shaped" if row == "plain" else row
            add_recorded(table, name, folder / row / "after", folder, chosen.chain)
            Console(width=150).print(table)
        if chosen.long:
            began_ns = time.monotonic_ns()
            apply(folder / chosen.rows[-1], chosen.long, environment)
            (turns,) = noted(folder, (began_ns, time.monotonic_ns()))
            settled = turns[0, 0] + 30_000 * MS, turns[-1, 0] - 1_000 * MS
            used = used_commands([turns], settled, PERIODS_NS[chosen.chain])
            add_row(table, f"{chosen.rows[-1]}, {chosen.long} s", used)
            Console(width=150).print(table)


def build(output: Path) -> Path:
    """Build the nodes and the hardware; return where they were installed."""
    prefix = output / "prefix"
    for step in (
        ["-S", HERE, "-B", output / "build", f"-DCMAKE_INSTALL_PREFIX={prefix}"],
        ["--build", output / "build", "--target", "install"],
    ):
        run = subprocess.run(
            ["cmake", *map(str, step)], capture_output=True, text=True, check=False
        )
        if run.returncode:
            sys.exit(run.stdout[-3000:] + run.stderr[-3000:])
    return prefix


def arm(folder: Path, prefix: Path, rate: int, chain: str, ppm: float | None) -> dict[str, str]:
    """Write what the launch file starts; return the environment in which it does."""
    notes = folder / "notes"
    notes.mkdir(parents=True, exist_ok=True)
    description, parameters = folder / "arm.urdf", folder / "controllers.yaml"
    tick = ""
    if ppm is not None:
        tick_ns = round(1e9 / rate * (1 + ppm / 1e6))
        tick = f'<param name="tick_ns">{tick_ns}</param>'
    description.write_text(DESCRIPTION.format(tick=tick))
    parameters.write_text(PARAMETERS.format(rate=rate, blocks=str(ppm is not None).lower()))
    settings = {
        "program": str(prefix / "lib/chainshaper_benchmark/chain_node"),
        "chain": CHAINS[chain],
        "description": str(description),
        "parameters": str(parameters),
    }
    environment = dict(os.environ)
    for variable, below in (("AMENT_PREFIX_PATH", "."), ("LD_LIBRARY_PATH", "lib")):
        paths = [str(prefix / below), environment.get(variable, "")]
        environment[variable] = os.pathsep.join(filter(None, paths))
    environment |= {"ARM": json.dumps(settings), "WITNESS_NOTES": str(notes)}
    return environment


def shape(output: Path, options: list[str], seconds: int, environment: dict[str, str]) -> None:
    """Have `chainshaper shape` measure, plan and shape; what it prints stands beside."""
    output.parent.mkdir(parents=True, exist_ok=True)
    words = ["shape", "--chain", CHAIN, "--duration", f"{seconds}s", *options, "-o", str(output)]
    launch = ["ros2", "launch", "--noninteractive", str(HERE / "arm.launch.py")]
    with chainshaper([*words, "--", *launch], output.with_suffix(".log"), environment) as run:
        if run.wait():
            sys.exit(f"error: shape ended with {run.returncode}: see {output.with_suffix('.log')}")


def apply(shaped: Path, seconds: int, environment: dict[str, str]) -> None:
    """Apply a plan to a further start of the shaped launch file, for so long."""
    launch = ["ros2", "launch", "--noninteractive", str(shaped / "launch/arm.launch.py")]
    setup = shaped / "launch" / NODES / SETUP  # of the shaping node, where it was built
    if setup.exists():
        launch = ["bash", "-c", 'source "$0" && exec "$@"', str(setup), *launch]
    words = ["apply", str(shaped / "plan.yaml"), "--", *launch]
    with chainshaper(words, shaped.parent / "apply.log", environment) as run:
        try:
            run.wait(seconds)
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGINT)
        run.wait(60)


@contextmanager
def chainshaper(
    words: list[str], log: Path, environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a verb, until it ends or this does."""
    with log.open("wb") as file:
        command = [sys.executable, "-m", "chainshaper", *words]
        run = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=environment)
        try:
            yield run
        finally:
            if run.poll() is None:
                run.send_signal(signal.SIGINT)
                run.wait()


def used_commands(
    notes: list[npt.NDArray[np.int64]], window_ns: tuple[int, int], period_ns: int
) -> Used:
    """Return which commands were used between two instants, by the notes of the hardware."""
    turns = np.concatenate(notes)
    turns = turns[(turns[:, 0] >= window_ns[0]) & (turns[:, 0] < window_ns[1]) & (turns[:, 1] > 0)]
    written, began = turns.T
    new = np.flatnonzero(np.diff(began, prepend=-1))[1:]  # the first may have been used before
    uses = np.diff(np.append(new, len(began)))[:-1]
    skipped = np.rint(np.diff(began[new]) / period_ns) - 1
    return Used((written - began)[new], uses, int(np.maximum(skipped, 0).sum()))


def noted(folder: Path, window_ns: tuple[int, int]) -> list[npt.NDArray[np.int64]]:
    """Return what the hardware noted in the runs of which a part lies between two instants.

    In rows: when a command was written, and when its chain began (CLOCK_MONOTONIC, ns).
    """
    files = sorted((folder / "notes").iterdir())
    runs = [np.fromfile(file, np.int64).reshape(-1, 2) for file in files]
    runs = [turns for turns in runs if turns[-1, 0] > window_ns[0] and turns[0, 0] < window_ns[1]]
    if not runs:
        sys.exit(f"error: {folder / 'notes'}: the hardware noted nothing between {window_ns}")
    return runs


def new_table(title: str) -> Table:
    table = Table(title=title)
    table.add_column("", no_wrap=True)
    for name in (
        "cycles", "p0.5", "median", "p99.5", "largest", "spread", "uses", "never",
        "spread by latency", "same command",
    ):  # fmt: skip
        table.add_column(name, justify="right")
    return table


def add_recorded(table: Table, name: str, recording: Path, folder: Path, chain: str) -> None:
    """Add what the hardware noted while a recording was made, and what the recording says."""
    analysis = analyse_latency(cs.open_recording(recording), CHAIN)
    if analysis.data_age is None:
        sys.exit(f"error: {recording}: no turn of the loop was recorded")
    cycles = analysis.data_age.cycles.drop_nulls("traversal").sort("start")
    window = int(cycles["start"][0]), int(cycles["end"][-1])
    notes = noted(folder, window)
    used = used_commands(notes, window, PERIODS_NS[chain])
    first = cycles.filter(use=1)["age_at_end_ns"].to_numpy()
    low, high = np.percentile(first, (0.5, 99.5))
    starts = analysis.traversals.sort("traversal")["start"].to_numpy()
    written, began = np.concatenate(notes).T
    place = np.searchsorted(written, cycles["end"].to_numpy(), side="right") - 1
    claimed = starts[cycles["traversal"].to_numpy()]
    same = np.abs(began[np.maximum(place, 0)] - claimed) < 2 * MS
    add_row(table, name, used, f"{(high - low) / MS:.3f}", f"{same.sum()} of {len(same)}")


def add_row(table: Table, name: str, used: Used, *by_latency: str) -> None:
    low, median, high = np.percentile(used.first_ages, (0.5, 50, 99.5))
    figures = low, median, high, used.first_ages.max(), high - low
    counts = np.unique(used.uses, return_counts=True)
    uses = ", ".join(f"{count} × {number}" for number, count in zip(*counts, strict=True))
    texts = [f"{figure / MS:.3f}" for figure in figures]
    table.add_row(name, str(len(used.first_ages)), *texts, uses, str(used.never), *by_latency)


if __name__ == "__main__":
    main()
