"""`chainshaper compare`: the same chain in several recordings, before and after."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption

__all__ = ["compare"]


def compare(
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="REC REC...", help="Recordings' folders.", show_default=False),
    ],
    chain: ChainOption = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            "--figures",
            metavar="DIR",
            help="Draw latency.png and distribution.png into this folder.",
            show_default=False,
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show the same chain in several recordings side by side, usually before and after shaping."""
    from chainshaper.cli.output import print_json, show
    from chainshaper.reporting.tables import comparison_json, comparison_table
    from chainshaper.steps import compare_recordings

    comparison = compare_recordings(recordings, chain)
    if figures is not None:
        from chainshaper.reporting.figures import draw_comparison

        draw_comparison(comparison.measurements, figures)
    if json:
        print_json(comparison_json(comparison))
        return
    show(comparison_table(comparison))
