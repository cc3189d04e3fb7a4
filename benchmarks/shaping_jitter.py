"""Jitter before and after shaping, live, with a compile running beside it.

    python benchmarks/shaping_jitter.py [--cycles N] [--runs N] [--keep DIR]

Prints one column per run; with --keep the recordings stay, to look into them.
All figures are of one machine in one session: compare columns, not
machines. Nothing is asserted; the figures to reach stand in the last column.
"""

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from chainshaper.flow.demonstration import run_demo
from chainshaper.values.durations import milliseconds
from chainshaper.verify.measure import Measurement

SOURCE = "".join(
    f"#include <stdio.h>\nint f{i}(int x) {{ return x * {i} + (x >> {i % 31}); }}\n"
    for i in range(3000)
)


@contextlib.contextmanager
def compile_beside(folder: Path) -> Iterator[str]:
    """A compiler at work on every core for as long as the block lasts: what it is, in words."""
    compiler = shutil.which("cc")
    if compiler is not None:
        (folder / "load.c").write_text(SOURCE)
        command = f"while :; do {compiler} -O2 -c load.c -o load.$$.o; done"
        what = "cc -O2 in a loop"
    else:
        command = f"while :; do {sys.executable} -m compileall -qf {Path(os.__file__).parent}"
        command += "/email >/dev/null; done"
        what = "Python's own compiler in a loop"
    cores = os.cpu_count() or 1
    loops = [
        subprocess.Popen(["sh", "-c", command], cwd=folder, start_new_session=True)
        for _ in range(cores)
    ]
    try:
        yield f"{what}, {cores} at a time"
    finally:
        for loop in loops:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(loop.pid, 9)
            loop.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description="Jitter before and after shaping.")
    parser.add_argument("--cycles", type=int, default=320)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the recordings, made if needed")
    options = parser.parse_args()
    results: list[tuple[str, Measurement, Measurement]] = []
    with tempfile.TemporaryDirectory(prefix="chainshaper-benchmark-") as name:
        folder = options.keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for run in range(1, options.runs + 1):
            with compile_beside(Path(name)) as load:
                print(f"run {run}: {options.cycles} cycles each, beside: {load}", flush=True)
                shown = run_demo(folder / f"run{run}", cycles=options.cycles)
            if shown.comparison is None:
                print(f"  nothing could be planned: {shown.unplanned}")
                continue
            before, after = shown.comparison.measurements
            for note in dict.fromkeys(before.recording.info.notes + after.recording.info.notes):
                print(f"  note: {note}")
            results.append((f"run {run}", before, after))
    Console(width=120).print(table_of(results))


def table_of(results: list[tuple[str, Measurement, Measurement]]) -> Table:
    table = Table(title="Synthetic chain, undisturbed cycles [ms]")
    table.add_column("")
    for name, _, _ in results:
        table.add_column(name, justify="right")
    table.add_column("to reach", justify="right")

    def row(title: str, target: str, values: list[float | None], digits: int = 3) -> None:
        texts = ["–" if v is None else milliseconds(v, digits) for v in values]
        table.add_row(title, *texts, target)

    befores = [before.analysis for _, before, _ in results]
    afters = [after.analysis for _, _, after in results]
    row("unshaped jitter", "about 30", [a.undisturbed.jitter_ns for a in befores])
    row("shaped jitter, p0.5–p99.5", "≤ 0.1", [a.undisturbed.spread_ns for a in afters])
    row("shaped jitter, max − min", "≤ 0.2", [a.undisturbed.jitter_ns for a in afters])
    row("maximum behind the slot's start", "≤ 0.3", [behind_slot(m) for _, _, m in results])
    received = [a.subscriber_undisturbed for a in afters]
    row("at the subscriber, p0.5–p99.5", "", [None if r is None else r.spread_ns for r in received])
    row("at the subscriber, max − min", "", [None if r is None else r.jitter_ns for r in received])
    row("all cycles, max − min", "", [a.statistics.jitter_ns for a in afters])
    counts = [
        f"{a.statistics.disturbed} of {a.statistics.count} / {b.statistics.disturbed}"
        for b, a in zip(befores, afters, strict=True)
    ]
    table.add_row("disturbed after / before", *counts, "")
    row("longest stall while shaped", "", [m.longest_stall_ns for _, _, m in results])
    return table


def behind_slot(measurement: Measurement) -> int | None:
    """Maximum latency minus (L̄ + ε), the start of the publish slot."""
    maximum, plan = measurement.analysis.undisturbed.max_ns, measurement.plan
    if maximum is None or plan is None:
        return None
    return maximum - plan.servers[0].slots[0][1]


if __name__ == "__main__":
    main()
