"""`chainshaper status`: the plans in force on this machine."""

from dataclasses import asdict
from typing import Annotated

import typer

from chainshaper.cli.options import JsonOption

__all__ = ["status"]


def status(
    outputs: Annotated[
        bool,
        typer.Option("--outputs", help="Only the outputs that are shaped, bypassed or silent."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show the plans in force: back end, servers, counters, and what crashed runs have left.

    And the outputs that have a shaping node: which of them go around it, or are silent.
    """
    from chainshaper.cli.output import notes, print_json, show, show_line
    from chainshaper.enforcement.freezer.state import stray_groups
    from chainshaper.enforcement.runs.state import find_runs, runs_as_json
    from chainshaper.enforcement.runs.undoing import strange_lines
    from chainshaper.reporting.plans import runs_table, servers_table
    from chainshaper.splicing.shaped_outputs import find_outputs, output_text

    found = find_outputs()
    if outputs and json:
        print_json([asdict(output) for output in found])
        return
    if json:
        print_json(runs_as_json())
        return
    for output in found:
        show_line(output_text(output))
    if outputs:
        if not found:
            show_line("no output has a shaping node")
        return
    runs = list(find_runs())
    strays = stray_groups(journal for journal, _ in runs)
    if runs:
        show(runs_table(runs), *(servers_table(state) for _, state in runs if state is not None))
    elif not strays:
        show_line("no plan is in force")
    notes(
        (
            *(line for journal, _ in runs for line in strange_lines(journal)),
            *(
                f"{folder} was left by a run whose journal is gone: `chainshaper release` lets its "
                "threads run"
                for folder in strays
            ),
        )
    )
