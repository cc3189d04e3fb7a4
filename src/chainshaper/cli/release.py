"""`chainshaper release`: end what is in force, and undo what a crash has left."""

from typing import Annotated

import typer

__all__ = ["release"]


def release(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN]", help="The run, as `chainshaper status` names it. Default: all of them."
        ),
    ] = None,
) -> None:
    """End plans in force, and put back what crashed runs have left changed."""
    from chainshaper.cli.output import notes, show_line
    from chainshaper.enforcement.scheduling_memory import look_alikes
    from chainshaper.enforcement.undoing import end_run, release_strays
    from chainshaper.linux.runs import find_journals
    from chainshaper.values.errors import InputError, OperationError

    runs = find_journals()
    chosen = [journal for journal in runs if run in (None, journal.path.parent.name)]
    if run is not None and not chosen:
        known = ", ".join(journal.path.parent.name for journal in runs) or "there are none"
        raise InputError(f"no run {run!r}: {known}")
    problems: list[str] = []
    strangers: list[str] = []
    for journal in chosen:
        try:
            strangers += look_alikes(journal)
            left = end_run(journal)
        except OperationError as error:  # the others are ended all the same
            left = (str(error),)
        problems += left
        if not left:
            show_line(f"{journal.path.parent.name}: everything is as it was before")
    strays, left = release_strays(runs) if run is None else ((), ())
    for folder in strays:
        show_line(f"{folder}, of a run whose journal is gone: its threads run again")
    problems += left
    notes(strangers)
    if problems:
        raise OperationError("; ".join(problems))
    if not chosen and not strays:
        show_line("no plan is in force, and nothing was left behind")
