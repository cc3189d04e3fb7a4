"""`chainshaper graph`: nodes, callbacks, topics and services, as text or as a picture."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import JsonOption, TraceArgument

__all__ = ["graph"]


def graph(
    trace: TraceArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write: .svg, .dot or .json; must not exist.",
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Also what every node has for itself: parameter services, /rosout, "
            "/parameter_events. In JSON they are always there, marked as internal.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show the application: nodes, callbacks with kind, period and function, topics, services."""
    from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
    from chainshaper.flow.exploration import describe_application, lost_events
    from chainshaper.reporting.application_graph import (
        application_json,
        application_table,
        without_internals,
    )
    from chainshaper.reporting.graph_drawing import ENDINGS, write_picture
    from chainshaper.sources import open_source
    from chainshaper.values.whole_file import new_file

    if output is not None:
        new_file(output, ENDINGS)
    with late_progress("graph") as report:
        opened = open_source(*trace, progress=report)
        application = describe_application(opened)
        if output is not None:
            report(0.9, "drawing")
            write_picture(application, output, everything=everything)
    if json:
        print_json(application_json(application))
    elif output is None:
        show(application_table(application if everything else without_internals(application)))
        show_line(lost_events(opened.info))
        notes(application.notes)
    else:
        show_line(str(output.absolute()))
        notes((*application.notes, lost_events(opened.info)))
