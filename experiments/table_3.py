"""Table 3 and figure 6: valet parking under six schedules (section 5.1).

    python experiments/table_3.py [--simulated] [--cycles 280] [--keep FOLDER]

Simulated is the graph with drawn execution times (`avp_drawn.yaml`), calibrated on the paper's
first row, under the slots of table 4. Live is the localisation that really computes
(`avp/avp.yaml`): measured under SCHED_FIFO first, then under plans made from that measurement.
Servers hold threads by freezing them; bands are made by the shaping node alone, whose chain runs at
a high priority as in the first row.
"""

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from avp_drawn import APPLICATION as DRAWN
from configurations import (
    Configuration,
    Options,
    Panel,
    draw_latencies,
    live,
    live_in_turns,
    parse_options,
    simulated,
)
from numpy.typing import NDArray
from on_ros import Shaping, ros_runs
from results import (
    HERE,
    MS,
    OURS,
    PICTURES,
    ROS,
    Column,
    Line,
    Run,
    Value,
    earlier_runs,
    lines_of,
    machines_of,
    save,
)
from table_4 import FIFO, ROW_1, plans, slots_text

from chainshaper import load_application
from chainshaper.flow.plan import plan_recording
from chainshaper.planning import ChainPlan, PlanRequest, publish_slots
from chainshaper.simulation.simulating import with_recorded_times
from chainshaper.values.errors import ChainshaperError
from chainshaper.workload.description import Application

__all__ = ["FIFO", "PERIOD_NS", "run_under_fifo", "widest_band"]

PERIOD_NS = 100 * MS
FIRST_SLOT_NS = 3 * MS
"""The throttler's: its two callbacks copy a cloud of half a megabyte each."""

LIVE_MARGIN_NS = 3 * MS
LIVE_MARGIN_OF_A_CALLBACK_NS = 1 * MS
"""A live profile is one drive of half a minute, and the next one has its own longest cycle."""

RESAMPLED = "SCHED_FIFO, execution times from the live run"


@dataclass(frozen=True)
class Row:
    """A schedule: the paper's figures (ms), the row of table 4, and what is asked of the plan."""

    average: float
    maximum: float
    jitter: float | str
    slots: str
    request: PlanRequest
    why: str
    spread: float | None = None  # from the first band to the last, where the paper says it


WHY_LIVE = "live is another localizer on another machine: compare with its own first row"
WHY_AGAIN = (
    "the simulator delivers and takes clouds as fast as small messages, and has no other work: live"
    " was measured while that filled the machine, and disturbed 271 of 275 cycles"
)
WHY_LATE = (
    "late are outputs of cycles in which something took longer than ever in the profile and its"
    " margin, and those behind them; " + WHY_LIVE
)
WHY_PACE = (
    "live, where a cycle's latency falls among the bands depends on the machine's pace; in turns,"
    " over all cycles, PSO took 46.5 ms on average and random places 50.4, in the paper's order,"
    " which a run without turns had the other way round on 2026-11-21; "
)
WHY_BANDS = "outputs leave as their slot opens, or at once while it is open; " + WHY_LATE

ROWS = {
    "1 server per callback": Row(
        *(72.8, 95.7, 48.6, "1 server per callback"),
        PlanRequest(policy="server-per-callback", epsilon_ns=LIVE_MARGIN_OF_A_CALLBACK_NS),
        "the localizer's slot opens at 47 ms, live where the plan puts it, then comes its"
        " execution time; on ROS 2 no callback has a margin, and over Fast DDS the slots would take"
        " 101 of 100 ms, so that nothing was shaped; " + WHY_LATE,
    ),
    "1 server per chain": Row(
        *(64.2, 84.4, 51.6, "2 server per chain"),
        PlanRequest(
            policy="server-per-chain", first_slot_ns=FIRST_SLOT_NS, epsilon_ns=LIVE_MARGIN_NS
        ),
        "the chain waits for its server behind the throttler's slot; " + WHY_LATE,
    ),
    "1-band": Row(
        86.6,
        86.7,
        "≈ 0.2",
        "3 1-band",
        PlanRequest(epsilon_ns=LIVE_MARGIN_NS, overrun="wait"),
        WHY_BANDS,
    ),
    "3-band, random": Row(
        *(76.4, 86.6, "≈ 0.2 per band", "4 3-band, random"),
        PlanRequest(
            bands=3, solver="random", grid_ns=MS, seed=1, epsilon_ns=LIVE_MARGIN_NS, overrun="wait"
        ),
        "random places are others; " + WHY_PACE + WHY_BANDS,
    ),
    "3-band, PSO": Row(
        *(71.3, 86.5, "≈ 0.2 per band", "5 3-band, PSO"),
        PlanRequest(
            bands=3, solver="pso", grid_ns=MS, seed=1, epsilon_ns=LIVE_MARGIN_NS, overrun="wait"
        ),
        WHY_PACE + WHY_BANDS,
        spread=25.0,
    ),
}


FITTED: dict[Column, str] = dict.fromkeys(
    ("simulated", *ROS),
    "simulated and on ROS 2, the execution times were fitted to this table's averages, maximum and"
    " jitter",
)
ELSEWHERE: dict[Column, str] = dict.fromkeys(OURS, "the slots lie at other, random places")


def real_application() -> Application:
    """The localisation that computes; its functions are found wherever this is started."""
    from avp.drive import recorded_drive

    recorded_drive()  # made now, if there is none yet
    path = [str(HERE.parent), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(filter(None, path)))
    return load_application(HERE / "avp" / "avp.yaml")


def run_under_fifo(options: Options) -> tuple[Run, Path]:
    """The first row, live, and its recording, which plans are made from.

    Poses' errors are beside it, in `FOLDER/errors`.
    """
    os.environ["AVP_ERRORS"] = str(options.keep / "errors")
    run = live(FIFO, real_application(), cycles=options.cycles, folder=options.keep)
    del os.environ["AVP_ERRORS"]
    return run, options.keep / FIFO


def live_plan(recording: Path, request: PlanRequest) -> ChainPlan:
    """The plan of a row from the live recording of the first."""
    return plan_recording(recording, request=request, period_ns=PERIOD_NS).chains[0]


def run_live(options: Options) -> tuple[list[Run], dict[str, ChainPlan], list[str]]:
    """All rows live, in turns: latencies, the plans, and what could not be planned, and why."""
    _, recording = run_under_fifo(options)
    application, planned, failed = real_application(), dict[str, ChainPlan](), list[str]()
    for name, row in ROWS.items():
        try:
            planned[name] = live_plan(recording, row.request)
        except ChainshaperError as error:
            failed.append(f"{name}: {error}")
            print(failed[-1])
    in_turns = [Configuration(FIFO, application)]
    in_turns += [Configuration(name, application, plan) for name, plan in planned.items()]
    return live_in_turns(in_turns, cycles=options.cycles, folder=options.keep), planned, failed


def shapings() -> list[Shaping]:
    """All rows on ROS 2, of the graph with drawn execution times; margins are the command's own.

    Slots of callbacks have none: with the paper's times they fill the period but for 2 ms, and a
    margin for each of them would exceed it.
    """
    return [
        Shaping(
            name=name,
            package="valet_parking",
            application=load_application(DRAWN),
            shaped={name: None},
            request=replace(row.request, epsilon_ns=0 if name == ROW_1 else None),
            unshaped={FIFO: None} if number == 0 else {},
        )
        for number, (name, row) in enumerate(ROWS.items())
    ]


def run_simulated(cycles: int) -> tuple[list[Run], dict[str, ChainPlan]]:
    """All rows by simulation, with the slots of table 4."""
    application = load_application(DRAWN)
    runs = [simulated(FIFO, application, cycles=cycles)]
    of_table_4 = plans(runs[0].undisturbed_ns)
    planned = {name: of_table_4[row.slots] for name, row in ROWS.items()}
    runs += [simulated(name, application, plan, cycles=cycles) for name, plan in planned.items()]
    return runs, planned


def resampled(options: Options) -> list[Run]:
    """The first row of what was measured live, beside its simulation with the recorded times.

    These are drawn in stretches of consecutive cycles, the same of all callbacks, so that what
    belongs together in the drive stays together.
    """
    measured, recording = run_under_fifo(options)
    described = with_recorded_times(real_application(), recording, block=20)
    again = simulated(RESAMPLED, described, cycles=options.simulated_cycles)
    return [again, replace(measured, name=RESAMPLED)]


def widest_band(latency_ns: NDArray[np.int64], bands: int) -> float:
    """The largest jitter within a band (ms) of outputs in their own cycle.

    Bands are what the widest gaps between latencies keep apart.
    """
    in_time = np.sort(latency_ns[latency_ns < PERIOD_NS])
    gaps = np.sort(np.argsort(np.diff(in_time))[-(bands - 1) :])
    return float(max(np.ptp(band) for band in np.split(in_time, gaps + 1))) / MS


def lines(runs: Sequence[Run]) -> list[Line]:
    """Average, maximum and jitter of every row; what was late; what a band's jitter is."""
    paper: dict[str, Value] = {"average": 67.4, "maximum": 84.7, "jitter": 51.8}
    made = lines_of(FIFO, runs, paper, why=WHY_LIVE, no_evidence=FITTED)
    for name, row in ROWS.items():
        paper = {"average": row.average, "maximum": row.maximum, "late": None}
        marks = ELSEWHERE if "random" in name else FITTED
        bands = row.request.bands if isinstance(row.request.bands, int) else 1
        if bands == 1 or row.spread is not None:
            paper["jitter"] = row.spread or row.jitter
        made += lines_of(name, runs, paper, late_from_ns=PERIOD_NS, why=row.why, no_evidence=marks)
        if bands > 1:
            banded = [run for run in runs if run.name == name]
            widths: dict[str, Any] = {
                run.column: widest_band(run.undisturbed_ns, bands) for run in banded
            }
            values = {"simulated": None, "live": None, "machines": machines_of(banded)} | widths
            what = f"{name}: jitter within a band"
            made.append(Line(what, "ms", row.jitter, why=row.why, **values))
    figures: dict[str, Value] = dict.fromkeys(("average", "maximum", "jitter"))
    return made + lines_of(RESAMPLED, runs, figures, why=WHY_AGAIN)


def picture(runs: Sequence[Run], planned: dict[str, ChainPlan], name: str) -> Path:
    """Figure 6, (a) to (f)."""
    panels = [
        Panel(
            f"({letter}) {run.name}",
            [run],
            publish_slots(planned[run.name])
            if run.name in planned and planned[run.name].shaping_node
            else (),
        )
        for letter, run in zip("abcdef", runs, strict=False)
    ]
    return draw_latencies(PICTURES / name, panels, columns=3)


def notes_of(keep: Path, failed: Sequence[str]) -> str:
    """How well the localizer knew where it was, and what could not be run live."""
    from avp.checking import root_mean_square_error

    notes = [f"Not run live: {reason}" for reason in failed]
    if (keep / "errors").exists():
        mean, worst = (1000 * error for error in root_mean_square_error(keep / "errors"))
        notes.append(
            f"The localizer's error under SCHED_FIFO was {mean:.1f} mm (root mean square) and at"
            f" most {worst:.1f} mm."
        )
    return "\n\n".join(notes)


def main() -> None:
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=280, until=until)
        runs, drawn_plans = run_simulated(options.simulated_cycles)
        pictures = [picture(runs, drawn_plans, "figure_6_simulated.png")]
        notes = ""
        if options.live:
            real, live_plans, failed = run_live(options)
            pictures.append(picture(real, live_plans, "figure_6_live.png"))
            notes = notes_of(options.keep, failed)
            slots = {name: {"slots": slots_text(plan)} for name, plan in live_plans.items()}
            runs += [replace(run, facts=slots.get(run.name, {})) for run in real]
            runs += resampled(options)
        else:
            runs += earlier_runs("table_3", "live")
            runs += [run for run in earlier_runs("table_3", "simulated") if run.name == RESAMPLED]
        on_ros = ros_runs("table_3", shapings(), options)
        for column in ROS:
            if own := [run for run in on_ros if run.column == column]:
                pictures.append(picture(own, {}, f"figure_6_{column}.png"))
        save(
            "table_3",
            "Table 3 and figure 6: valet parking under six schedules",
            lines,
            runs=[*runs, *on_ros],
            pictures=pictures,
            notes=notes,
        )


if __name__ == "__main__":
    main()
