"""`chainshaper threads`: which thread of a running application does what."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import JsonOption, UsersOption

if TYPE_CHECKING:
    from chainshaper.planning import Plan

__all__ = ["threads"]


def threads(
    where: Annotated[
        str | None,
        typer.Argument(
            metavar="[PID|PLAN]",
            help="A process, which stands for its descendants too, or a plan.yaml for the nodes "
            "of its servers. Default: all that looks like ROS 2 or DDS.",
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            metavar="REC",
            help="A recording or trace of the processes while they ran: it tells nodes and "
            "executors for sure. Default: the plan's own, where it exists.",
        ),
    ] = None,
    user: UsersOption = None,
    json: JsonOption = False,
) -> None:
    """Show the threads of running nodes: executors, DDS threads, publishers; class and cores."""
    from chainshaper.cli.output import notes, print_json, show
    from chainshaper.flow.thread_search import find_threads
    from chainshaper.planning import load_plan
    from chainshaper.reporting.recordings import threads_json, threads_table
    from chainshaper.sources import open_source

    place: int | Plan | None = None
    if where is not None and where.isdecimal():
        place = int(where)
    elif where is not None:
        place = load_plan(where)
        own = place.evidence.recording
        if recording is None and own and Path(own).is_dir():
            recording = Path(own)
    recorded = None if recording is None else open_source(recording)
    found = find_threads(place, recorded, users=user or ())
    if json:
        print_json(threads_json(found))
        return
    show(threads_table(found))
    notes(found.notes)
