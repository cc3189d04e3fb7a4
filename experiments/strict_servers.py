"""Both servers in force, strictly: R_m closes where eq. 1 ends it (no table of the paper).

    python experiments/strict_servers.py [--simulated] [--cycles 80] [--keep FOLDER]

By default a server that runs a chain stays open until the chain is done. The paper's servers are
open in their slots only; here they are (``slot_ends: closed``), live by freezing threads. Beside
each stands the same plan with servers that stay open, and beside each jitter at the publication
that at the receiver: until the callback of the actuator begins.

Designs 1 to 3, LET, and the time-driven servers of table 1. The chain is that of section 5.2, with
its execution times of 5 to 12 ms; time-driven servers have table 1's, of 5 to 15 ms, under a load
of 40 ms. Plans are made from a profile of 200 cycles, with slots as in the paper's: R_m ends on the
next whole ms behind the profile's longest cycle. All runs draw other execution times than the
profile's: a cycle may be longer than R_m, and what that costs is what the servers differ in.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import figure_8
import table_1
import table_5
from configurations import (
    Configuration,
    Options,
    Panel,
    block_seed,
    draw_latencies,
    latencies_of,
    live,
    live_in_turns,
    output_of,
    parse_options,
    simulated,
)
from results import COLUMNS, MS, PICTURES, Column, Line, Run, Value, earlier_runs, lines_of, save

from chainshaper import load_application, plan_recording, simulate
from chainshaper.planning import ChainPlan, PlanRequest
from chainshaper.planning.chain_plan import revised
from chainshaper.values.errors import OperationError
from chainshaper.values.plan_choices import SlotEnds
from chainshaper.workload.description import Application

PERIOD_NS = 100 * MS
LOAD_MS = 40
CLOSED, OPEN = "closed", "open until done"
ENDS: dict[str, SlotEnds] = {OPEN: "open-until-done", CLOSED: "closed"}

BLOCKS, PROFILE_CYCLES = 2, 200

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
WHY_SLOTS = "the slots are the paper's, or follow from execution times chosen to fit its maximum"
SLOTS: dict[str, dict[Column, str]] = {
    "maximum": {"simulated": WHY_SLOTS, "live": WHY_SLOTS},
    "jitter": {"simulated": WHY_SLOTS},
}


@dataclass(frozen=True)
class Profile:
    """What plans are made from."""

    recording: Path
    run: Run


def applications() -> dict[str, Application]:
    """The application of each unshaped run, by the run's name."""
    times = (table_1.application(LOAD_MS), load_application(figure_8.APPLICATION))
    return dict(zip(UNSHAPED, (*times, table_5.synthetic()), strict=True))


def plans(profiles: Sequence[Profile]) -> dict[str, tuple[str, ChainPlan]]:
    """The unshaped run and the plan of each design, with servers that stay open."""
    five, asynchronous, chain = profiles
    longest = int(chain.run.undisturbed_ns.max())
    wishes = PlanRequest(epsilon_ns=-(-longest // MS) * MS - longest, overrun="wait")
    of_chain = {
        "design 2, one band": wishes,
        "design 3, three bands": replace(wishes, bands=3, grid_ns=MS),
        "LET per callback": PlanRequest(policy="let-per-callback"),
        "LET per chain": PlanRequest(policy="let-per-chain"),
    }
    one_slot = figure_8.plan_with_slot(asynchronous.run.undisturbed_ns, 10)
    return {
        "five time-driven servers": (UNSHAPED[0], table_1.five_servers(five.run.undisturbed_ns)),
        "design 1, asynchronous": (UNSHAPED[1], one_slot),
    } | {
        name: (UNSHAPED[2], plan_recording(chain.recording, request=request).chains[0])
        for name, request in of_chain.items()
    }


def configurations(profiles: Sequence[Profile]) -> list[Configuration]:
    """All unshaped applications, and each design with servers that stay open and that close."""
    described = applications()
    made = [Configuration(name, application) for name, application in described.items()]
    for design, (unshaped, plan) in plans(profiles).items():
        for ends, slot_ends in ENDS.items():
            own = revised(plan, slot_ends=slot_ends)
            made.append(Configuration(f"{design}, {ends}", described[unshaped], own))
    return made


def run_simulated(options: Options) -> list[Run]:
    """All by simulation, with other execution times than the profiles'."""
    profiles, runs = [], []
    with TemporaryDirectory() as folder:
        for name, application in applications().items():
            recording = output_of(Path(folder), name)
            profile = simulate(application, recording, cycles=PROFILE_CYCLES)
            profiles.append(Profile(recording, latencies_of(name, profile)))
        compared = configurations(profiles)
    for one in compared:
        others = one.application.model_copy(update={"seed": block_seed(one.application, 0)})
        runs.append(simulated(one.name, others, one.plan, cycles=options.simulated_cycles))
    return runs


def run_live(options: Options) -> list[Run]:
    """All live, in turns, planned from profiles before."""
    profiles = []
    for name, application in applications().items():
        profile = f"profile of {name}"
        run = live(profile, application, cycles=PROFILE_CYCLES, folder=options.keep)
        if not run.undisturbed_ns.size:
            raise OperationError(
                f"{profile}: the machine disturbed each of {run.latency_ns.size} cycles, so that"
                " nothing can be planned: run this where nothing else does"
            )
        profiles.append(Profile(output_of(options.keep, profile), run))
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
            for what, paper in figures.items():
                made += lines_of(
                    *(f"{design}, {ends}", runs, {what: paper}),
                    late_from_ns=late_ms * MS,
                    why=WHY[ends],
                    no_evidence=None if paper is None else SLOTS.get(what),
                )
    return made


NOTES = (
    "The plans know 200 cycles, and run others, of which some are longer. R_m that stays open costs"
    " such a cycle its own output; R_m that closes may cost those behind it too, as what is left"
    " takes the time of the next cycle. What closing buys is a smaller jitter of outputs in their"
    " own cycle: a cycle that is a little too long does not end in the open publish slot.\n\n"
    "Live, servers close by freezing threads; two blocks of 40 cycles. Of time-driven servers"
    " that close 60 of 80 outputs were a cycle late or more, and none in simulation: their slots"
    " are 1 ms longer than the longest callback, and live a callback now and then begins later in"
    " its slot than that. It goes on in the next cycle's slot, and so does what came meanwhile,"
    " until two short callbacks fit into one slot: the backlog stays for ten cycles and more. Left"
    " open until done, such a callback ends 1 ms behind its slot, and nothing waits. With three"
    " bands one stall of the machine delayed five outputs by up to three cycles.\n\n"
    "**Not measured on ROS 2**: there it is"
    " `chainshaper shape --slot-ends closed --backend freezer … -- ros2 launch …`."
)


def main() -> None:
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=80, until=until)
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
