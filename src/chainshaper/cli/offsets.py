"""`chainshaper offsets`: plans of several chains, moved against each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import JsonOption

if TYPE_CHECKING:
    from chainshaper.planning import Plan

__all__ = ["offsets", "place_and_print"]


def offsets(
    plans: Annotated[
        list[Path], typer.Argument(metavar="PLAN PLAN...", help="Plans, one a chain.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Folder to write the plans into; must not exist."
        ),
    ] = None,
    time_limit: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="How long to search, per group.")
    ] = 60.0,
    json: JsonOption = False,
) -> None:
    """Find when each chain's cycles start, so that no slots of one core collide.

    Where chains cannot take turns on a core, they run at the same time at different priorities,
    and only their publish slots are kept apart.
    """
    from chainshaper.planning import load_plan

    place_and_print([load_plan(path) for path in plans], output, json, time_limit)


def place_and_print(
    plans: "Sequence[Plan]", output: Path | None, json: bool, time_limit: float = 60.0
) -> None:
    """Find the offsets, write the plans into a folder and print them."""
    from chainshaper.cli.output import notes, print_json, show, show_line
    from chainshaper.planning import place_chains, plan_json, plan_warnings, save_plans
    from chainshaper.reporting.plans import plan_table

    placed, remarks = place_chains(plans, time_limit_s=time_limit)
    written = [] if output is None else save_plans(placed, output)
    warnings = [warning for planned in placed for warning in plan_warnings(planned)]
    if json:
        print_json(
            {
                "plans": [plan_json(planned) for planned in placed],
                "files": [str(path) for path in written],
                "warnings": [*remarks, *warnings],
            }
        )
        return
    show(*(plan_table(planned) for planned in placed))
    notes(list(dict.fromkeys([*remarks, *warnings])))
    for path in written:
        show_line(str(path))
