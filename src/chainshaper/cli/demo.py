"""`chainshaper demo`: the whole flow on a live chain, on one command."""

import sys
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import CyclesOption, JsonOption, RealtimeOption
from chainshaper.cli.plan_options import IdealMachineOption

__all__ = ["demo"]


def demo(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder for everything. Default: chainshaper-demo-DATE-TIME here.",
        ),
    ] = None,
    application: Annotated[
        Path | None,
        typer.Option(
            metavar="APP.yaml", help="Another application than the paper's synthetic chain."
        ),
    ] = None,
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
    ideal_machine: IdealMachineOption = False,
    json: JsonOption = False,
) -> None:
    """Measure a live chain, plan, splice the shaping node, measure again, show the gain.

    Runs the paper's synthetic chain as real processes over real DDS topics, for about a minute
    and a half. Needs no ROS 2.
    """
    from chainshaper.cli.output import notes, print_json, progress, show, show_line
    from chainshaper.flow.demo import run_demo
    from chainshaper.planning import PlanRequest, plan_warnings
    from chainshaper.reporting.latency import comparison_json, comparison_table
    from chainshaper.reporting.plans import plan_table
    from chainshaper.reporting.recordings import callback_table

    folder = output or Path(f"chainshaper-demo-{datetime.now():%Y%m%d-%H%M%S}")
    with progress("demo") as report:
        result = run_demo(
            folder,
            application=application,
            cycles=cycles,
            request=PlanRequest(ideal_machine=ideal_machine),
            realtime=realtime,
            command=sys.argv,
            planned=lambda plan: notes(plan_warnings(plan)),
            progress=report,
        )
    if json:
        print_json({**comparison_json(result.comparison), "folder": str(folder)})
        return
    show(
        callback_table(result.callbacks),
        plan_table(result.plan),
        comparison_table(result.comparison),
    )
    notes(result.notes)
    show_line(str(folder.absolute()))
