"""Many demonstrations on a machine that others use: does any end in an error, or claim too much?

    python benchmarks/demonstrations.py [--runs 10] [--cycles 320] [--machine quiet|busy|stalling]

Runs `chainshaper demo` so often, alone, beside two processes that compute without end (busy), or on
a machine whose cores a thread of the highest priority takes for 2 to 40 ms now and then (stalling).
Each screen is judged by the recordings beside it, whose figures are computed here once more, from
when each output was published: its jitter, the late outputs, before and after. Prints a row for
each run and what each run's screen said that its recordings do not. Nothing is asserted. A run of
320 cycles takes 90 seconds, and up to twice as long where it goes on.

`late before` counts the cycles behind those that the plan was made from: the slot was chosen so
that few of these were late, so they would say less than a machine's stalls cost.
"""

import argparse
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.planning import publish_slots
from chainshaper.values.durations import milliseconds

MS = 1_000_000
FEWEST = 20  # undisturbed cycles; of fewer, the screen's figures are of all cycles
LONGEST_S = 1200  # a run, and what is beside it, end after this at the latest


def main() -> None:
    parser = argparse.ArgumentParser(description="Many demonstrations on a machine that is used.")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--cycles", type=int, default=320)
    parser.add_argument("--machine", choices=("quiet", "busy", "stalling"), default="quiet")
    parser.add_argument("--output", type=Path, help="a folder for the recordings, which are kept")
    chosen = parser.parse_args()
    table = Table(title=f"{chosen.machine}: {chosen.cycles} cycles before and after")
    for name in ("run", "exit", "disturbed", "jitter [ms]", "late before", "after", "verdict"):
        table.add_column(name, justify="right")
    wrong: list[str] = []
    sums = np.zeros((2, 2), np.int64)
    with tempfile.TemporaryDirectory() as place, beside(chosen.machine):
        for number in range(chosen.runs):
            folder = (chosen.output or Path(place)) / f"{chosen.machine}{number}"
            folder.parent.mkdir(parents=True, exist_ok=True)
            code, screen = demonstrated(folder, chosen.cycles)
            row, faults = judged(folder, code, screen, chosen.cycles)
            if (folder / "after").exists():
                sums += late_outputs(folder, chosen.cycles)
            table.add_row(str(number), str(code), *row)
            wrong += [f"run {number}: {fault}" for fault in faults]
            print(number, code, *row, *faults, flush=True, file=sys.stderr)
    Console(width=110).print(table)
    print("\n".join(wrong) or "Every screen says what its recordings say.")
    for name, (number, outputs) in zip(("unshaped", "shaped"), sums.tolist(), strict=True):
        print(f"{name}: {number} of {outputs} outputs later than the slot's end")


def demonstrated(folder: Path, cycles: int) -> tuple[int, str]:
    """Run the demonstration; return its exit code and its screen."""
    options = ["-o", str(folder), "--cycles", str(cycles)]
    command = [sys.executable, "-m", "chainshaper", "demo", *options]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_S,
        env={**os.environ, "COLUMNS": "80"},
    )
    if folder.exists():
        (folder / "screen.txt").write_text(done.stdout)
    elif done.returncode:
        print(done.stderr, file=sys.stderr)
    return done.returncode, done.stdout


def judged(folder: Path, code: int, screen: str, planned_from: int) -> tuple[list[str], list[str]]:
    """Return the cells of a run's row, and what its screen says that its recordings do not.

    The plan was made from so many cycles.
    """
    faults = [f"it ended with {code}"] if code else []
    verdict = next((line.strip() for line in screen.splitlines() if re.match("  [✓!] ", line)), "")
    if not (folder / "after").exists():
        if "Nothing can be said" not in verdict:
            faults.append(f"nothing was shaped, and it says: {verdict!r}")
        return ["", "", "", "", verdict[:40]], faults
    before, after = published(folder / "before"), published(folder / "after")
    few = min(np.count_nonzero(~run["disturbed"]) for run in (before, after)) < FEWEST
    jitter = [jitter_of(run["latency"][few | ~run["disturbed"]]) for run in (before, after)]
    late = late_outputs(folder, planned_from)
    shown = re.search(r"jitter +(\S+) ms +→ +(\S+) ms(.*)", screen)
    if shown is None:
        faults.append("it shows no jitter")
    else:
        for text, measured in zip(shown.groups(), jitter, strict=False):
            if abs(float(text) * MS - measured) > 0.02 * measured + 0.01 * MS:
                faults.append(f"jitter {text} ms, and measured were {milliseconds(measured)}")
        if jitter[1] >= jitter[0] and "less" in shown[3]:
            faults.append(f"it claims a gain: {shown[3].strip()}")
    if "none late" in verdict and late[1, 0]:
        faults.append(f"it says that none is late, and {late[1, 0]} are")
    return [
        " → ".join(f"{run['disturbed'].sum()}/{run['disturbed'].size}" for run in (before, after)),
        " → ".join(str(milliseconds(round(value, -4))) for value in jitter),
        *(f"{number} of {outputs}" for number, outputs in late.tolist()),
        verdict[:40],
    ], faults


def late_outputs(folder: Path, planned_from: int) -> NDArray[np.int64]:
    """Return how many outputs were later than the slot's end, or lost, and of how many; two rows:
    without the plan, behind the cycles that it was made from; and with it.
    """
    ((_, end),) = publish_slots(cs.load_plan(folder / "plan.yaml").chains[0])
    counts = []
    for name, first in (("before", planned_from), ("after", 0)):
        latency = cs.measure_latency(folder / name).analysis.traversals["latency_ns"][first:]
        is_late = (latency > end).fill_null(value=True)
        counts.append((np.count_nonzero(is_late), len(latency)))
    return np.array(counts, np.int64)


def published(recording: Path) -> dict[str, NDArray[Any]]:
    """Return of each cycle its latency [ns], and whether the machine disturbed it."""
    traversals = cs.measure_latency(recording).analysis.traversals.filter("complete")
    return {
        "latency": traversals["latency_ns"].to_numpy(),
        "disturbed": traversals["disturbed"].fill_null(value=False).to_numpy(),
    }


def jitter_of(latencies: NDArray[np.int64]) -> float:
    """Return the jitter as the paper has it: the longest latency less the shortest."""
    return float(np.ptp(latencies))


@contextmanager
def beside(machine: str) -> Iterator[None]:
    """Have others use the machine meanwhile."""
    parts = {"quiet": [], "busy": ["computing"] * 2, "stalling": ["0", "1"]}[machine]
    processes = [subprocess.Popen([sys.executable, __file__, f"--as={part}"]) for part in parts]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def compute() -> None:
    """Compute until the process that started this one is gone."""
    parent = os.getppid()
    while os.getppid() == parent:
        sum(range(1_000_000))


def stall(core: int) -> None:
    """Take a core for 2 to 40 ms, twice a second or so, above everything else."""
    parent, drawn = os.getppid(), random.Random(core)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))
    os.sched_setaffinity(0, {core})
    while os.getppid() == parent:
        time.sleep(drawn.expovariate(2))
        until = time.monotonic() + drawn.uniform(0.002, 0.04)
        while time.monotonic() < until:
            pass


if __name__ == "__main__":
    if sys.argv[1:] == ["--as=computing"]:
        compute()
    elif sys.argv[1:] and sys.argv[1].startswith("--as="):
        stall(int(sys.argv[1].removeprefix("--as=")))
    else:
        main()
