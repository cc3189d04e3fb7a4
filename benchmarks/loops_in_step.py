"""How old are a loop's data when it reads them: unshaped, shaped, and in step with the loop?

    python benchmarks/loops_in_step.py [--seconds 30] [--drift 50] [--loops 10 1] [--output FOLDER]

A described application runs live: a sensor every 20 ms, a filter of 2 to 8 ms, and a loop of
100 Hz or 1 kHz that reads what the filter publishes. It runs unshaped, shaped, in step by moving
the output (`in_step: output`) and by moving the loop (`in_step: loop`), and in step with a loop
whose clock is off by so many ppm. Ages count from the start of the sensor's callback to the start
of the loop's instance, over all instances from four seconds behind the start on, by when both are
in step: at the first use of a message (p0.5, median, p99.5, largest), their spread p0.5-p99.5, the
largest age of all instances, messages that were never used, and moves. Nothing is asserted.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.chain_plan import LoopAge, PlannedLoop, publish_slots, revised
from chainshaper.planning.plan import Plan
from chainshaper.values.durations import milliseconds
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application

MS = 1_000_000
SENSOR_NS = 20 * MS
LEAD_NS = 1 * MS  # from the output to the loop's start: delivery, and a margin
CHAIN_NS = 3 * MS, 9 * MS  # how long the chain takes, as it is described
MARGIN_NS = 3 * MS  # for what the machine adds
SLOT_NS = 3 * MS  # with which the output's gate is done, at the end of a cycle
SETTLED_NS = 4_000_000_000  # by then output and loop are in step
TEXT = """\
name: loop in step
chain: /scan../command
scheduling:
  executors: {{core: {core}, priority: 80}}
  dds: {{core: {dds_core}, priority: 90}}
nodes:
  sensor: {{callbacks: [{{timer: 20ms, execution: {{uniform: [500us, 1ms]}}, publishes: [/scan]}}]}}
  filter:
    callbacks: [{{subscription: /scan, execution: {{uniform: [2ms, 8ms]}}, publishes: [/filtered]}}]
  controller:
    callbacks:
      - loop: {period}ns
        phase: {phase}us
        priority: 85
        reads: [/filtered]
        execution: {{constant: {execution}us}}
        publishes: [/command]
  driver:
    callbacks: [{{subscription: /command, execution: {{constant: 10us}}}}]
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="The age of a loop's data, in step and not.")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--drift", type=float, default=50.0, metavar="PPM")
    parser.add_argument("--loops", type=int, nargs="+", default=[10, 1], metavar="MS")
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="only these rows of the table")
    parser.add_argument("--phase", type=int, default=8000, metavar="US", help="of the loop")
    parser.add_argument("--output", type=Path, help="where the recordings stay")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        output = chosen.output or Path(folder)
        output.mkdir(parents=True, exist_ok=True)
        for period_ms in chosen.loops:
            title = f"sensor 20 ms, loop {period_ms} ms, {chosen.seconds:g} s a row [ms]"
            table = Table(title=title)
            table.add_column("", no_wrap=True)
            for name in FIGURES:
                table.add_column(name, justify="right")
            for name, recording in _runs(output, period_ms, chosen):
                table.add_row(name, *_row(recording))
            Console(width=140).print(table)


def _runs(
    output: Path, period_ms: int, chosen: argparse.Namespace
) -> Iterator[tuple[str, Recording]]:
    cycles = round(chosen.seconds * 1e9 / SENSOR_NS)
    period_ns = period_ms * MS
    profile_path = output / f"unshaped_{period_ms}ms"
    application = _application(output, period_ns, chosen.phase)
    if profile_path.exists():
        unshaped = cs.open_recording(profile_path)
    else:
        unshaped = cs.run_application(application, profile_path, cycles=max(cycles // 2, 250))
    chain = cs.plan_shaping(
        np.array(CHAIN_NS),
        SENSOR_NS,
        spec="/scan../filtered",
        output="/filtered",
        publisher="/filter",
        nodes=("/sensor", "/filter"),
        epsilon_ns=MARGIN_NS,
    )
    drifting = round(period_ns * (1 + chosen.drift * 1e-6))
    rows: dict[str, tuple[Plan, int]] = {
        "unshaped": (Plan.of(chain), period_ns),
        "shaped": (Plan.of(chain), period_ns),
        "output": (_in_step(chain, period_ns, "output"), period_ns),
        "loop": (_in_step(chain, period_ns, "loop"), period_ns),
        "output-drift": (_in_step(chain, period_ns, "output"), drifting),
        "loop-drift": (_in_step(chain, period_ns, "loop"), drifting),
    }
    for name, (plan, of_loop_ns) in rows.items():
        if chosen.rows and name not in chosen.rows:
            continue
        if name == "unshaped":
            yield name, unshaped
            continue
        application = _application(output, of_loop_ns, chosen.phase)
        path = output / f"{name}_{period_ms}ms"
        yield name, cs.shape_application(application, plan, path, cycles=cycles)


def _application(folder: Path, period_ns: int, phase_us: int) -> Application:
    cores = available_cores()
    execution_us = 500 if period_ns > 5 * MS else 100
    values = {"core": cores[-1], "dds_core": cores[0], "period": period_ns, "phase": phase_us}
    path = folder / "application.yaml"
    path.write_text(TEXT.format(**values, execution=execution_us))
    return cs.load_application(path)


def _in_step(chain: cs.ChainPlan, period_ns: int, moved: Literal["output", "loop"]) -> Plan:
    """The chain's plan with the loop in step; phases are measured when it runs.

    It is made by hand: for the loop's own clock, which differs, no recording is needed.
    """
    start_ns, _ = publish_slots(chain)[0]
    age = LoopAge(first_ns=(0, 0), every_ns=(0, 0), constant=True, uses=(1, 1))
    loop = PlannedLoop(
        node="/controller",
        topic="/filtered",
        period_ns=period_ns,
        samples=1,
        delivery_ns=(LEAD_NS // 4, LEAD_NS // 2, LEAD_NS),
        lead_ns=LEAD_NS,
        in_step=moved,
        starts_ns=(start_ns, SENSOR_NS - SLOT_NS) if moved == "output" else None,
        move_ns=0 if moved == "loop" else None,
        age=age,
    )
    return Plan.of(revised(chain, loop=loop))


FIGURES = (
    "p0.5", "median", "p99.5", "largest", "spread", "oldest of all", "cycles", "messages",
    "never used", "moves",
)  # fmt: skip


def _row(recording: Recording) -> list[str]:
    age = cs.measure_latency(recording, "/scan../command").analysis.data_age
    if age is None:
        raise SystemExit("the recording has no loop in /scan../command")
    since = age.cycles["start"][0] + SETTLED_NS
    cycles = age.cycles.filter(pl.col("start") > since).drop_nulls("age_at_loop_ns")
    first = cycles.filter(use=1)["age_at_loop_ns"].to_numpy()
    low, usual, high = np.percentile(first, (0.5, 50, 99.5))
    moved = recording.events.get("loop_moved")
    moves = 0 if moved is None else moved.height
    gates = recording.events.get("gate_release")
    if gates is not None and not moves:
        moves = int((gates["moved"].diff().fill_null(0) != 0).sum())
    return [
        *(milliseconds(float(figure)) for figure in (low, usual, high, first.max(), high - low)),
        milliseconds(float(cycles["age_at_loop_ns"].to_numpy().max())),
        str(cycles.height),
        str(first.size),
        str(age.uses["never"]),
        str(moves),
    ]


if __name__ == "__main__":
    main()
