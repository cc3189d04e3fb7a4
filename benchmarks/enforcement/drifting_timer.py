"""Slots that follow a timer that is some ppm off, for as long as you like: live, two chains.

    python benchmarks/enforcement/drifting_timer.py [--minutes 60] [--ppm -50] [--epsilon 18ms]
        [--keep DIR]

As root. The chains take turns, and both timers are off alike, as those of one sensor; each slot of
the one is followed by one of the other, so one that stays behind its timer shows soon. The margin
takes what room the cycle has: a shared machine stands still for 10 ms now and then.
Prints for every five minutes how many outputs were late, and how far apart the others left; at the
end how far the timer and the slots have moved. Nothing is asserted: a machine that stalls makes
outputs late by itself.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.splicing.application import splice_application
from chainshaper.workload.description import application_as_written

APPLICATION = """
name: two chains in turns
chain: /a1../a3
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  a1: {callbacks: [{timer: 100ms, execution: {uniform: [500us, 1ms]}, publishes: [/a1]}]}
  a2: {callbacks: [{subscription: /a1, execution: {uniform: [1ms, 2ms]}, publishes: [/a2]}]}
  a3: {callbacks: [{subscription: /a2, execution: {uniform: [500us, 1ms]}, publishes: [/a3]}]}
  b1: {callbacks: [{timer: 50ms, execution: {uniform: [500us, 1ms]}, publishes: [/b1]}]}
  b2: {callbacks: [{subscription: /b1, execution: {uniform: [1ms, 1500us]}, publishes: [/b2]}]}
  sink:
    core: 0
    priority: 70
    callbacks: [{subscription: /a3}, {subscription: /b2}]
"""
TIMERS_NS = {"a1": 100_000_000, "b1": 50_000_000}
CHAINSHAPER = (sys.executable, "-m", "chainshaper")


def run(*arguments: str | Path) -> str:
    done = subprocess.run([*CHAINSHAPER, *map(str, arguments)], stdout=subprocess.PIPE, check=True)
    return done.stdout.decode()


def drifting(plan: Path, application: Path, ppm: float) -> dict[str, object]:
    """The application with its shaping nodes, and timers that are off."""
    spliced = splice_application(cs.load_application(application), cs.load_plan(plan))
    described = application_as_written(spliced)
    for node, period_ns in TIMERS_NS.items():
        timer = f"{(period_ns + round(period_ns * ppm / 1e6)) / 1e3}us"
        described["nodes"][node]["callbacks"][0]["timer"] = timer
    return described


def main() -> None:
    parser = argparse.ArgumentParser(description="Slots that follow a drifting timer.")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--ppm", type=float, default=-50)
    parser.add_argument("--epsilon", default="18ms", help="what is added to the longest latency")
    parser.add_argument("--keep", type=Path, help="a new folder for recordings and the plan")
    given = parser.parse_args()
    folder = given.keep or Path(tempfile.mkdtemp())
    folder.mkdir(exist_ok=given.keep is None)
    application, plan, shaped = folder / "app.yaml", folder / "plan.yaml", folder / "shaped"
    application.write_text(APPLICATION)
    run("run", application, "-o", folder / "before", "--cycles", "310")
    chains = ("--chain", "/a1../a3", "--chain", "/b1../b2", "--epsilon", given.epsilon)
    run("plan", folder / "before", *chains, "-o", plan)
    off = folder / "off.yaml"
    off.write_text(yaml.safe_dump(drifting(plan, application, given.ppm), sort_keys=False))
    cycles = str(round(given.minutes * 600))
    command = (*CHAINSHAPER, "run", off, "-o", shaped, "--cycles", cycles)
    state = json.loads(run("apply", plan, "--json", "--", *command))

    console, releases = Console(), cs.open_recording(shaped).events["gate_release"].sort("time")
    for _, own in releases.group_by("pid", maintain_order=True):
        place = (own["time"] - own["origin"]).to_numpy() / 1e6
        late = own["overrun"].is_not_null().to_numpy()
        minute = (own["time"] - own["time"][0]).to_numpy() // 300_000_000_000 * 5
        table = Table("from minute", "outputs", "late", "p0.5–p99.5 [ms]", "maximum [ms]")
        for start in np.unique(minute):
            here = place[minute == start]
            low, high = np.percentile(here, [0.5, 99.5])
            row = (start, here.size, late[minute == start].sum(), f"{high - low:.3f}")
            table.add_row(*map(str, row), f"{here.max():.3f}")
        console.print(table)
    console.print(
        f"timers moved by {given.ppm * given.minutes * 0.06:.1f} ms,"
        f" slots by {(state['drift_ns'] or 0) / 1e6:.1f} ms; see {folder}"
    )


if __name__ == "__main__":
    main()
