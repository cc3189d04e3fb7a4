"""The schedules that the paper compares, live on its synthetic chains, with its figures beside.

    python benchmarks/enforcement/configurations.py [--cycles N] [--configurations NAME …]
                                                    [--keep FOLDER]

Each chain is profiled first under SCHED_FIFO, which is the first configuration; the others are
planned from that recording and carried out: one server per callback (section 2.5) and one server
per chain (section 3.1) by freezing the application's threads (`chainshaper apply`), one band and
three bands by a shaping node, the asynchronous publisher by gating its thread.

Columns are over the cycles that no stall of the machine disturbed, and under `apply` over those
that began when all servers had been seen to open. A callback that overruns its slot goes on in the
next cycle, which makes its output a period late: such outputs are counted, and left out of `jitter,
in time`. Profiles of few cycles miss the longest execution times, and plan for too little.

The paper ran most of its servers on another chain than section 2.5's: where `paper's chain` says
so, the ratios to FIFO compare, not the milliseconds. All figures are of one machine in one session,
and nothing is asserted.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import polars as pl
from rich.console import Console
from rich.table import Table

from chainshaper.analysis import LatencyStatistics, latency_statistics
from chainshaper.applying import apply_plan
from chainshaper.durations import milliseconds
from chainshaper.enforcement.runs import RunState
from chainshaper.errors import ChainshaperError, OperationError
from chainshaper.planning import Plan, PlanRequest, save_plan
from chainshaper.recording import Recording, open_recording
from chainshaper.steps import measure_latency, plan_recording, shape_application
from chainshaper.workload.description import load_application
from chainshaper.workload.live import origin_timer, run_application

EXAMPLES = Path(__file__).parents[2] / "examples"
SYNTHETIC = EXAMPLES / "synthetic_chain.yaml"
ASYNCHRONOUS = EXAMPLES / "asynchronous_chain.yaml"
BEFORE_IN_FORCE = 80
"""Cycles that a command runs longer: finding the nodes and measuring their phase takes a while."""


@dataclass(frozen=True)
class Paper:
    """The paper's figures (ms) for a configuration and for FIFO on the same chain, and where."""

    average: float | None
    maximum: float
    jitter: str
    fifo_average: float | None
    fifo_maximum: float
    chain: str
    source: str


@dataclass(frozen=True)
class Configuration:
    """One column: what is planned (None: FIFO, from which the others are planned), and how it runs.

    ``applied`` are put in force on the threads of a command that runs unchanged.
    """

    name: str
    application: Path
    request: PlanRequest | None
    applied: bool
    paper: Paper


@dataclass(frozen=True)
class Figures:
    """One configuration as measured.

    ``late`` counts undisturbed outputs that came a period or more after their chain began,
    ``in_time`` is without them; ``widest_band_ns`` is the jitter within a band.
    """

    publication: LatencyStatistics
    in_time: LatencyStatistics
    subscriber: LatencyStatistics
    cycles: int
    late: int
    widest_band_ns: int | None


def configurations() -> tuple[Configuration, ...]:
    """All of them; each chain's FIFO stands before what is planned from it.

    Section 2.5's figures are those under its interfering load of 20 ms, which the example has.
    """
    interfered = "synthetic", "2.5, table 1"
    path, request, parking = SYNTHETIC, PlanRequest, "valet parking"
    return (
        Configuration(
            "FIFO", path, None, False, Paper(None, 58.7, "34.2", None, 58.7, *interfered)
        ),
        Configuration(
            "five servers",
            path,
            request(policy="server-per-callback"),
            True,
            Paper(None, 80, "≈ 10", None, 58.7, *interfered),
        ),
        Configuration(
            "one server",
            path,
            request(policy="server-per-chain"),
            True,
            Paper(64.2, 84.4, "51.6", 67.4, 84.7, parking, "5.1.3, table 3"),
        ),
        Configuration(
            "one band",
            path,
            request(),
            False,
            Paper(86.6, 86.7, "≈ 0.2", 67.4, 84.7, parking, "5.1.4, table 3"),
        ),
        Configuration(
            "three bands",
            path,
            request(bands=3),
            False,
            Paper(71.3, 86.5, "≈ 0.2 each", 67.4, 84.7, parking, "5.1.5, table 3"),
        ),
        Configuration(
            "FIFO, async",
            ASYNCHRONOUS,
            None,
            False,
            Paper(None, 58.5, "33", None, 58.5, "synthetic", "5.2, figure 8"),
        ),
        Configuration(
            "asynchronous",
            ASYNCHRONOUS,
            request(publication="asynchronous", publish_slot_ns=10_000_000),
            False,
            Paper(None, 59.6, "≈ 0.2", None, 58.5, "synthetic", "5.2, figure 8"),
        ),
    )


def carry_out(one: Configuration, fifo: Path, cycles: int, folder: Path) -> Figures:
    """Run one configuration; its recording and plan stay in ``folder``, beside those of FIFO."""
    output = folder / one.name.replace(", ", "_").replace(" ", "_")
    application = load_application(one.application)
    period = origin_timer(application).timer_ns or 0
    if one.request is None:
        return figures_of(run_application(application, output, cycles=cycles), period)
    plan = plan_recording(fifo, request=one.request)
    save_plan(plan, output.with_suffix(".yaml"))
    if not one.applied:
        return figures_of(shape_application(application, plan, output, cycles=cycles), period)
    since = apply_to_command(plan, one.application, output, cycles + BEFORE_IN_FORCE)
    return figures_of(open_recording(output), period, since)


def apply_to_command(plan: Plan, application: Path, output: Path, cycles: int) -> int:
    """Put a plan in force on `chainshaper run`; from when (CLOCK_MONOTONIC, ns) all servers were.

    Raises:
        OperationError: they were not in force before the command ended; and what
            :func:`chainshaper.applying.apply_plan` raises.
    """
    seen: list[int] = []

    def watch(state: RunState) -> None:
        if not seen and all(server.counters.slots for server in state.servers):
            seen.append(time.monotonic_ns())

    run = [sys.executable, "-m", "chainshaper", "run", str(application), "-o", str(output)]
    done = apply_plan(plan, [*run, "--cycles", str(cycles)], back_end="freezer", watch=watch)
    if done.exit_code or not seen:
        raise OperationError(f"{output.name}: the run ended before all servers were in force")
    return seen[0]


def figures_of(recording: Recording, period_ns: int, since_ns: int = 0) -> Figures:
    """Statistics over the undisturbed cycles that began at ``since_ns`` or later."""
    measured = measure_latency(recording)
    frame = measured.analysis.traversals.filter(pl.col("start") >= since_ns)
    bands = measured.held.bands if measured.held else ()
    late = pl.col("latency_ns") >= period_ns
    publication = _undisturbed(frame, "latency_ns", "disturbed")
    in_time = _undisturbed(frame.filter(~late), "latency_ns", "disturbed")
    return Figures(
        publication=publication,
        in_time=in_time,
        late=publication.count - in_time.count,
        subscriber=_undisturbed(frame, "reception_ns", "reception_disturbed"),
        cycles=frame.height,
        widest_band_ns=max((band.jitter_ns or 0 for band in bands), default=None),
    )


def _undisturbed(frame: pl.DataFrame, column: str, disturbed_by: str) -> LatencyStatistics:
    measured = frame.drop_nulls(column)
    calm = measured.filter(~pl.col(disturbed_by))
    return latency_statistics(calm[column], incomplete=frame.height - measured.height)


def table_of(results: list[tuple[Configuration, Figures]]) -> Table:
    """One column per configuration; ours at the publication and at the subscriber, the paper's."""
    table = Table(title="End-to-end latency in ms, undisturbed cycles")
    table.add_column("", no_wrap=True)
    for one, _ in results:
        table.add_column(one.name, justify="right")

    def row(title: str, cell: Callable[[Configuration, Figures], str]) -> None:
        table.add_row(title, *[cell(one, figures) for one, figures in results])

    def section(title: str, of: Callable[[Figures], LatencyStatistics]) -> None:
        table.add_row(f"[bold]{title}[/bold]")
        row("  average", lambda _, f: _text(of(f).mean_ns))
        row("  maximum", lambda _, f: _text(of(f).max_ns))
        row("  jitter (max − min)", lambda _, f: _text(of(f).jitter_ns))
        row("  disturbed", lambda _, f: str(f.cycles - of(f).count - of(f).incomplete))
        row("  without an end", lambda _, f: str(of(f).incomplete))

    section("at the publication", lambda f: f.publication)
    row("  a period late", lambda _, f: str(f.late))
    row("  jitter, in time", lambda _, f: _text(f.in_time.jitter_ns))
    row("  jitter within a band", lambda _, f: _text(f.widest_band_ns))
    table.add_section()
    section("at the subscriber", lambda f: f.subscriber)
    table.add_section()
    row("cycles", lambda _, f: str(f.cycles))
    fifo = {one.application: f.publication for one, f in results if one.request is None}
    row("average / FIFO's", lambda c, f: _ratio(f.publication.mean_ns, fifo[c.application].mean_ns))
    row("maximum / FIFO's", lambda c, f: _ratio(f.publication.max_ns, fifo[c.application].max_ns))
    table.add_section()
    table.add_row("[bold]the paper[/bold]")
    row("  average", lambda c, _: "–" if c.paper.average is None else f"{c.paper.average:g}")
    row("  maximum", lambda c, _: f"{c.paper.maximum:g}")
    row("  jitter", lambda c, _: c.paper.jitter)
    row("  average / FIFO's", lambda c, _: _ratio(c.paper.average, c.paper.fifo_average))
    row("  maximum / FIFO's", lambda c, _: _ratio(c.paper.maximum, c.paper.fifo_maximum))
    row("  paper's chain", lambda c, _: c.paper.chain)
    row("  section", lambda c, _: c.paper.source)
    return table


def _text(value_ns: int | None) -> str:
    return "–" if value_ns is None else milliseconds(value_ns, 2)


def _ratio(value: float | None, reference: float | None) -> str:
    return "–" if value is None or reference is None else f"{value / reference:.2f}"


def main() -> None:
    names = [one.name for one in configurations()]
    parser = argparse.ArgumentParser(description="The paper's configurations, live.")
    parser.add_argument("--cycles", type=int, default=320)
    parser.add_argument("--configurations", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--keep", type=Path, help="folder for recordings and plans, made if needed")
    options = parser.parse_args()
    chosen = [one for one in configurations() if one.name in options.configurations]
    applications = {one.application for one in chosen}
    results: list[tuple[Configuration, Figures]] = []
    failed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="chainshaper-benchmark-") as name:
        folder = options.keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for one in configurations():
            profile = one.request is None and one.application in applications
            if one not in chosen and not profile:
                continue
            print(f"{one.name}: {options.cycles} cycles", flush=True)
            fifo = folder / ("FIFO" if one.application == SYNTHETIC else "FIFO_async")
            try:
                results.append((one, carry_out(one, fifo, options.cycles, folder)))
            except ChainshaperError as error:
                failed.append(f"{one.name}: {error}")
                if profile:
                    break
    if results:
        Console(width=150).print(table_of(results))
    for line in failed:
        print(line)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
