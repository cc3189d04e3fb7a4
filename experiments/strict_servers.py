"""Both servers in force, strictly: R_m closes where eq. 1 ends it (no table of the paper).

    python experiments/strict_servers.py [--simulated] [--cycles 100] [--keep FOLDER]

By default a server that runs a chain stays open until the chain is done. The paper's servers are
open in their slots only; here they are (``slot_ends: closed``), live by freezing threads. Beside
each stands the same plan with servers that stay open, and beside each jitter at the publication that
at the receiver: until the callback of the actuator begins.

Designs 1 to 3, LET, and the time-driven servers of table 1. The chain is that of section 5.2, with
its execution times of 5 to 12 ms; time-driven servers have table 1's, of 5 to 15 ms, under a load of
40 ms. Plans are made from a profile that is as long as a live run, with slots as in the paper's:
R_m ends on the next whole ms behind the profile's longest cycle. All runs draw other execution times
than the profile's: a cycle may be longer than R_m, and what that costs is what the servers differ in.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace

import figure_8
import table_1
import table_5
from configurations import (
    Configuration,
    Options,
    Panel,
    block_seed,
    draw_latencies,
    live,
    live_in_turns,
    parse_options,
    simulated,
)
from results import COLUMNS, MS, PICTURES, Column, Line, Run, Value, earlier_runs, lines_of, save

from chainshaper import load_application
from chainshaper.planning import ChainPlan, plan_shaping
from chainshaper.planning.bands import with_bands
from chainshaper.planning.shaping import let_per_callback, let_per_chain
from chainshaper.values.plan_choices import SlotEnds
from chainshaper.workload.description import Application

PERIOD_NS = 100 * MS
LOAD_MS = 40
CLOSED, OPEN = "closed", "open until done"
ENDS: dict[str, SlotEnds] = {OPEN: "open-until-done", CLOSED: "closed"}

BLOCKS = 2

DESIGNS: dict[str, tuple[Value, Value, int]] = {  # the paper's maximum and jitter, late from (ms)
    "five time-driven servers": ("≈ 80", "≈ 10", 100),
    "design 1, asynchronous": (59.6, "≈ 0.2", 100),
    "design 2, one band": (59.2, None, 100),
    "design 3, three bands": (None, None, 100),
    "LET per callback": (500.0, None, 550),
    "LET per chain": (100.0, None, 150),
}
UNSHAPED = ("SCHED_FIFO, 5 to 15 ms", "SCHED_FIFO, asynchronous", "SCHED_FIFO")

WHY = {
    OPEN: "",
    CLOSED: "what is not done as R_m closes goes on in the next cycle's slot, and takes its time",
}
SLOTS: dict[Column, str] = dict.fromkeys(
    ("simulated", "live"), "the slots are as the paper's, or follow from the chosen execution times"
)


def applications() -> dict[str, Application]:
    """The application of each unshaped run, by the run's name."""
    times = (table_1.application(LOAD_MS), load_application(figure_8.APPLICATION))
    return dict(zip(UNSHAPED, (*times, table_5.synthetic()), strict=True))


def shaped(profile: Run) -> ChainPlan:
    """One band of the synchronous chain: R_m ends on the next whole ms behind the longest."""
    longest = int(profile.undisturbed_ns.max())
    return plan_shaping(
        profile.undisturbed_ns,
        PERIOD_NS,
        spec="/node1../t5",
        output="/t5",
        publisher=figure_8.NODES[-1],
        nodes=figure_8.NODES,
        epsilon_ns=-(-longest // MS) * MS - longest,
        overrun="wait",
        core=1,
    )


def plans(profiles: Sequence[Run]) -> Iterator[tuple[str, str, ChainPlan]]:
    """Each design's name, that of its unshaped run, and its plan; servers stay open."""
    five, asynchronous, synchronous = profiles
    one = shaped(synchronous)
    made = {
        "five time-driven servers": table_1.five_servers(five.undisturbed_ns),
        "design 1, asynchronous": figure_8.plan_with_slot(asynchronous.undisturbed_ns, 10),
        "design 2, one band": one,
        "design 3, three bands": with_bands(one, synchronous.undisturbed_ns, 3, grid_ns=MS),
        "LET per callback": let_per_callback(one, table_5.TOPICS["synthetic"]),
        "LET per chain": let_per_chain(one),
    }
    for name, plan in made.items():
        of = UNSHAPED[0] if "five" in name else UNSHAPED[1] if "design 1" in name else UNSHAPED[2]
        yield name, of, plan


def configurations(profiles: Sequence[Run]) -> list[Configuration]:
    """All unshaped applications, and each design with servers that stay open and that close."""
    described = applications()
    made = [Configuration(name, application) for name, application in described.items()]
    for name, unshaped, plan in plans(profiles):
        for ends, slot_ends in ENDS.items():
            own = plan.model_copy(update={"slot_ends": slot_ends})
            made.append(Configuration(f"{name}, {ends}", described[unshaped], own))
    return made


def run_simulated(options: Options) -> list[Run]:
    """All by simulation, with other execution times than the profiles'."""
    profiles = [
        simulated(name, application, cycles=2 * options.cycles)
        for name, application in applications().items()
    ]
    runs = []
    for one in configurations(profiles):
        others = one.application.model_copy(update={"seed": block_seed(one.application, 0)})
        runs.append(simulated(one.name, others, one.plan, cycles=options.simulated_cycles))
    return runs


def run_live(options: Options) -> list[Run]:
    """All live, in turns, planned from profiles before."""
    profiles = [
        live(
            f"profile, {name}", application, cycles=2 * options.cycles, folder=options.keep
        )
        for name, application in applications().items()
    ]
    return live_in_turns(
        configurations(profiles), cycles=options.cycles, folder=options.keep, blocks=BLOCKS
    )


def lines(runs: Sequence[Run]) -> list[Line]:
    """Maximum, jitter at the publication and at the receiver, and what was late."""
    made = []
    for name in UNSHAPED:
        figures: dict[str, Value] = dict.fromkeys(("maximum", "jitter"))
        made += lines_of(name, runs, figures)
    for design, (maximum, jitter, late_ms) in DESIGNS.items():
        for ends in ENDS:
            figures = {"maximum": maximum, "jitter": jitter, "late": None}
            made += lines_of(
                *(f"{design}, {ends}", runs, figures),
                late_from_ns=late_ms * MS,
                why=WHY[ends],
                no_evidence=SLOTS,
            )
    return made


NOTES = (
    "Live rows are measured by `flock /tmp/machine.lock python experiments/strict_servers.py`, as root,"
    " on a machine with nothing else to do: ten minutes. A dash is what was not measured. On ROS 2"
    " nothing of this is: `chainshaper shape --slot-ends closed --backend freezer … -- ros2 launch …`"
    " would."
)


def main() -> None:
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=100, until=until)
        runs = run_simulated(options)
        runs += run_live(options) if options.live else earlier_runs("strict_servers", "live")
    pictures = [
        draw_latencies(
            PICTURES / f"strict_servers_{column}.png",
            [
                Panel(
                    design,
                    [
                        replace(run, name=run.name.removeprefix(f"{design}, "))
                        for ends in ENDS
                        for run in runs
                        if (run.name, run.column) == (f"{design}, {ends}", column)
                    ],
                )
                for design in DESIGNS
            ],
            columns=3,
        )
        for column in COLUMNS
        if any(run.column == column for run in runs)
    ]
    save(
        "strict_servers",
        "Both servers in force, strictly: R_m closed where eq. 1 ends it, and what receivers see",
        lines,
        runs=runs,
        pictures=pictures,
        notes=NOTES,
    )


if __name__ == "__main__":
    main()
