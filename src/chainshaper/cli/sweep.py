"""`chainshaper sweep`: what every combination of some values would do, by simulation."""

from pathlib import Path
from typing import Annotated

import typer

from chainshaper.cli.options import ApplicationArgument, JsonOption

__all__ = ["sweep"]


def sweep(
    application: ApplicationArgument,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="An axis (repeat it for more): a wish for the plan, such as epsilon=0ms,1ms or"
            " bands=1..5; interference=0ms,20ms; or a value of the description by its path, such"
            " as nodes.node3.core=0,1.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE.parquet", help="File to write, a row for each point."
        ),
    ],
    plan: Annotated[
        Path | None,
        typer.Argument(
            metavar="plan.yaml",
            help="A plan that is in force at all points. Default: each is planned.",
        ),
    ] = None,
    cycles: Annotated[
        int, typer.Option(min=1, help="Cycles to plan from, and to judge by.")
    ] = 100_000,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the description's.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads that compute. Default: one per core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the Dask cluster whose scheduler is there, such as tcp://host:8786.",
        ),
    ] = None,
    draw: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png", help="Draw average and jitter over the first axis."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Simulate an application at every combination of some values: planned, shaped, judged.

    Ended before it is whole, it keeps the finished points beside the file that it writes; the same
    command goes on with the others.
    """
    from chainshaper.cli.output import notes, print_json, progress, show, show_line
    from chainshaper.flow.sweep import sweep as run_sweep
    from chainshaper.planning import load_plan
    from chainshaper.reporting.sweeps import draw_sweep, sweep_table
    from chainshaper.simulation.grid import parse_axis
    from chainshaper.simulation.sweeping import rows_beside
    from chainshaper.values.errors import InputError
    from chainshaper.values.whole_file import new_file
    from chainshaper.workload.description import load_application

    if workers is not None and scheduler is not None:
        raise InputError("a cluster has workers of its own: leave out --workers, or --scheduler")
    if draw is not None:
        draw = new_file(draw, (".png", ".pdf", ".svg"))
    description = load_application(application)
    in_force = None if plan is None else load_plan(plan)
    axes = [parse_axis(text) for text in vary]
    if len(dict(axes)) < len(axes):
        raise InputError("an axis is given twice: give all of its values in one --vary")
    try:
        with progress("sweep") as report:
            frame = run_sweep(
                description,
                dict(axes),
                output,
                in_force,
                cycles=cycles,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                progress=report,
            )
    except KeyboardInterrupt:
        if rows_beside(output).exists():
            notes([f"finished points are in {rows_beside(output)}: the same command goes on"])
        raise
    if draw is not None:
        draw_sweep(frame, draw)
    if json:
        print_json(frame.to_dicts())
        return
    show(sweep_table(frame))
    notes([f"{error}" for error in frame["error"].drop_nulls().unique(maintain_order=True)])
    for path in (draw, output):
        if path is not None:
            show_line(str(path))
