"""`chainshaper compare`: the same chain in several recordings, before and after."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption, PlanInForceOption

__all__ = ["compare"]


def compare(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC REC...", help="Recordings' folders.")
    ],
    chain: ChainOption = None,
    figures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw latency.png and distribution.png into this folder."),
    ] = None,
    plan: PlanInForceOption = None,
    json: JsonOption = False,
) -> None:
    """Show the same chain in several recordings side by side, usually before and after shaping.

    Where a plan was in force, its prediction is held against the measurement, band by band.
    """
    from chainshaper.cli.output import print_json, show
    from chainshaper.planning import load_plan
    from chainshaper.reporting.latency import comparison_json, comparison_table, prediction_table
    from chainshaper.verify.measure import compare_recordings

    in_force = None if plan is None else load_plan(plan)
    comparison = compare_recordings(recordings, chain, in_force)
    if figures is not None:
        from chainshaper.reporting.figures import draw_comparison

        draw_comparison(comparison.measurements, figures)
    if json:
        print_json(comparison_json(comparison))
        return
    held = [measurement.held for measurement in comparison.measurements]
    show(comparison_table(comparison), *(prediction_table(one) for one in held if one is not None))
