"""`chainshaper export`: a recording in the format of another tool."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, TraceArgument
from chainshaper.values.errors import InputError

__all__ = ["export"]


def export(
    trace: TraceArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write, such as trace.pftrace; must not exist.",
        ),
    ],
    perfetto: Annotated[
        bool, typer.Option("--perfetto", help="A trace that ui.perfetto.dev opens.")
    ] = False,
    chain: ChainOption = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            metavar="plan.yaml", help="The plan in force, where the recording does not say so."
        ),
    ] = None,
) -> None:
    """Write a recording for another tool: threads, callbacks, messages, slots, stalls.

    The chain's traversals are a track of their own where a chain is named or recorded.
    """
    if not perfetto:
        raise InputError("the format is missing: add --perfetto")
    from chainshaper.cli.output import late_progress, notes, show_line
    from chainshaper.flow.exploration import lost_events
    from chainshaper.planning import load_plan
    from chainshaper.reporting.perfetto import ENDINGS, export_perfetto
    from chainshaper.sources import open_source
    from chainshaper.values.whole_file import new_file
    from chainshaper.verify.measure import measure_latency

    new_file(output, ENDINGS)
    in_force = None if plan is None else load_plan(plan)
    with late_progress("export") as report:
        opened = open_source(*trace, progress=report)
        report(0.5, "analysing")
        named = chain or opened.info.chain
        source = opened if named is None else measure_latency(opened, named, in_force)
        report(0.7, "writing")
        written = export_perfetto(source, output)
    show_line(str(written.absolute()))
    notes((*opened.info.notes, lost_events(opened.info)))
