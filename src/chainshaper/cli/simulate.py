"""`chainshaper simulate`: run a described application in simulation and record it."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ApplicationArgument, CyclesOption, RecordingOutput

__all__ = ["simulate"]


def simulate(
    application: ApplicationArgument,
    output: RecordingOutput,
    plan: Annotated[
        Path | None, typer.Argument(metavar="plan.yaml", help="The plan in force.")
    ] = None,
    cycles: CyclesOption = 320,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the description's.")] = None,
    switches: Annotated[
        bool, typer.Option("--switches", help="Record what ran on which core, too.")
    ] = False,
    execution_times: Annotated[
        Path | None,
        typer.Option(metavar="REC", help="Draw execution times from those recorded there."),
    ] = None,
    block: Annotated[
        int, typer.Option(min=1, max=1024, help="So many consecutive ones at a time.")
    ] = 1,
) -> None:
    """Simulate an application, with a plan in force or without, and record its events.

    The recording is like that of a live run: every other verb takes it.
    """
    from chainshaper.cli.output import late_progress, show_line
    from chainshaper.planning import load_plan
    from chainshaper.simulation import simulate as run_simulation
    from chainshaper.simulation.samples import with_recorded_times
    from chainshaper.workload.description import load_application

    description = load_application(application)
    if execution_times is not None:
        description = with_recorded_times(description, execution_times, block=block)
    with late_progress(f"simulating {description.name}") as report:
        recording = run_simulation(
            description,
            output,
            None if plan is None else load_plan(plan),
            cycles=cycles,
            seed=seed,
            switches=switches,
            command=sys.argv,
            progress=report,
        )
    show_line(str(recording.path))
