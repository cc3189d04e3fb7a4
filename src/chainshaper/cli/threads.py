"""`chainshaper threads`: which thread of a running application does what."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import JsonOption

if TYPE_CHECKING:
    from chainshaper.planning import Plan
    from chainshaper.recording import Recording

__all__ = ["threads"]


def threads(
    where: Annotated[
        str | None,
        typer.Argument(
            metavar="[PID|PLAN]",
            help="A process, which stands for its descendants too, or a plan.yaml for the nodes "
            "of its servers. Default: all that looks like ROS 2 or DDS.",
            show_default=False,
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            "--recording",
            metavar="REC",
            help="A recording or trace of the processes while they ran: it tells nodes and "
            "executors for sure. Default: the plan's own, where it exists.",
            show_default=False,
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show the threads of running nodes: executors, DDS threads, publishers; class and cores."""
    from chainshaper.cli.output import notes, print_json, show
    from chainshaper.reporting.threads import threads_json, threads_table
    from chainshaper.thread_search import find_threads

    place = _place(where)
    if recording is None and place is not None and not isinstance(place, int):
        own = Path(place.evidence.recording or "")
        recording = own if place.evidence.recording and own.is_dir() else None
    found = find_threads(place, _opened(recording))
    if json:
        print_json(threads_json(found))
        return
    show(threads_table(found))
    notes(found.notes)


def _opened(recording: Path | None) -> "Recording | None":
    if recording is None:
        return None
    from chainshaper.sources import open_source

    return open_source(recording)


def _place(where: str | None) -> "int | Plan | None":
    if where is None:
        return None
    if where.isdecimal():
        return int(where)
    from chainshaper.planning import load_plan

    return load_plan(where)
