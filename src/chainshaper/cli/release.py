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
    from chainshaper.cli.output import show_line
    from chainshaper.enforcement.runs.state import end_run, find_runs
    from chainshaper.errors import InputError, OperationError

    runs = [journal for journal, _ in find_runs()]
    chosen = [journal for journal in runs if run in (None, journal.path.parent.name)]
    if run is not None and not chosen:
        known = ", ".join(journal.path.parent.name for journal in runs) or "there are none"
        raise InputError(f"no run {run!r}: {known}")
    problems: list[str] = []
    for journal in chosen:
        try:
            left = end_run(journal)
        except OperationError as error:  # the others are ended all the same
            left = (str(error),)
        problems += left
        if not left:
            show_line(f"{journal.path.parent.name}: everything is as it was before")
    if problems:
        raise OperationError("; ".join(problems))
    if not chosen:
        show_line("no plan is in force, and nothing was left behind")
