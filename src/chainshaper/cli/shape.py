"""`chainshaper shape`: run an application with the plan's shaping node spliced in."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import (
    ApplicationArgument,
    CyclesOption,
    RealtimeOption,
    RecordingOutput,
)

__all__ = ["shape"]


def shape(
    application: ApplicationArgument,
    plan: Annotated[
        Path, typer.Argument(metavar="plan.yaml", help="The plan in force.", show_default=False)
    ],
    output: RecordingOutput,
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
) -> None:
    """Run an application with its output shaped as planned, and record it.

    The publisher's output topic is remapped, and the shaping node republishes it in its slots.
    """
    from chainshaper.cli.output import notes, progress, show_line
    from chainshaper.overruns import overruns_in, overruns_text
    from chainshaper.planning import load_plan
    from chainshaper.steps import shape_application
    from chainshaper.workload.description import load_application

    description, planned = load_application(application), load_plan(plan)
    with progress(f"shaping {description.name}") as report:
        recording = shape_application(
            description,
            planned,
            output,
            cycles=cycles,
            realtime=realtime,
            command=sys.argv,
            progress=report,
        )
    overruns = overruns_in(recording, planned)
    if overruns:
        notes([overruns_text(overruns)])
    notes(recording.info.notes)
    show_line(str(recording.path))
