"""A whole sweep: what is to be computed, by whom, and what is left in the end."""

import importlib.metadata
import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import polars as pl
import yaml

from chainshaper.linux.scheduling import available_cores
from chainshaper.planning import Plan
from chainshaper.simulation.sweeping.grid import Grid, grid_of, is_duration, points_of
from chainshaper.simulation.sweeping.kept_rows import Row, kept_rows, rows_beside
from chainshaper.simulation.sweeping.points import FIGURES
from chainshaper.simulation.sweeping.workers import groups_of, rows_from_cluster, rows_from_here
from chainshaper.values.durations import parse_duration
from chainshaper.values.errors import InputError
from chainshaper.values.whole_file import new_file, write_whole
from chainshaper.workload.description import Application, application_as_written

__all__ = ["rows_beside", "sweep"]

Progress = Callable[[float, str], None]


def sweep(
    application: Application,
    vary: Mapping[str, Sequence[Any]],
    output: str | Path,
    plan: Plan | None = None,
    *,
    cycles: int = 100_000,
    seed: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> pl.DataFrame:
    """Simulate an application at every combination of some values, planned and shaped for each.

    ``vary`` has the values of each axis (:mod:`chainshaper.simulation.sweeping.grid`), durations as
    texts. With a ``plan``, this one is in force everywhere. Each point is a run of ``cycles``
    periods to plan from, and another one with the plan in force; ``seed`` replaces the
    description's.

    ``workers`` processes compute (default: one per core that we may use), or a Dask cluster, whose
    ``scheduler`` is at that address.

    The frame has a row for each point, in the order of the axes: a column for each axis (durations
    in ns, with ``_ns`` behind the name), ``cycles``, ``seed``, and the figures of
    :data:`chainshaper.simulation.sweeping.points.FIGURES`. A point that cannot be has an ``error``.
    The same frame is in ``output``, a Parquet file. Until it is whole, finished rows are kept
    beside it, and the same call goes on with what is missing.

    Raises:
        InputError: unknown axes or impossible values; ``output`` exists, or rows beside it are of
            another sweep.
        OperationError: a process was killed, the cluster failed, or the disk is full.
        PlatformError: `distributed` is not installed.
    """
    output = new_file(output, (".parquet",))
    grid = grid_of(application, vary, plan, cycles=cycles, seed=seed)
    if workers is not None and workers < 1:
        raise InputError(f"{workers} workers compute nothing: ask for at least 1")
    points = points_of(grid)
    rows_file = rows_beside(output)
    with kept_rows(rows_file, _about(grid)) as (rows, keep):
        groups = groups_of(grid, ((n, p) for n, p in enumerate(points) if n not in rows))
        if groups:
            most = workers or len(available_cores())
            coming = (
                rows_from_here(grid, groups, min(most, len(points) - len(rows)))
                if scheduler is None
                else rows_from_cluster(grid, groups, scheduler)
            )
            _tell(progress, rows, points)
            with closing(coming):
                for number, row in coming:
                    keep(number, row)
                    _tell(progress, rows, points)
        frame = _frame(grid, points, [rows[number] for number in range(len(points))])
        content = io.BytesIO()
        frame.write_parquet(content)
        write_whole(output, [content.getvalue()])
        rows_file.unlink()
    return frame


def _tell(progress: Progress | None, rows: Mapping[int, Row], points: Sequence[object]) -> None:
    if progress is not None:
        progress(len(rows) / len(points), f"{len(points)} points")


def _about(grid: Grid) -> dict[str, Any]:
    """What rows depend on, under the names that are said when it changed."""
    return {
        "the version of chainshaper": importlib.metadata.version("chainshaper"),
        "the application or the seed": application_as_written(grid.application),
        "the plan": None if grid.plan is None else grid.plan.model_dump(mode="json"),
        "the axes": {name: list(values) for name, values in grid.axes.items()},
        "the number of cycles": grid.cycles,
    }


def _frame(grid: Grid, points: Sequence[Mapping[str, Any]], rows: Sequence[Row]) -> pl.DataFrame:
    axes = [_axis(name, values, points) for name, values in grid.axes.items()]
    seeds = [values.get("seed", grid.application.seed) for values in points]
    own = [pl.Series("cycles", [grid.cycles] * len(points), dtype=pl.Int64)]
    if "seed" not in grid.axes:
        own.append(pl.Series("seed", seeds, dtype=pl.Int64))
    figures = pl.DataFrame([dict(row) for row in rows], schema=FIGURES)
    return pl.DataFrame([*axes, *own]).hstack(figures)


def _axis(name: str, values: Sequence[Any], points: Sequence[Mapping[str, Any]]) -> pl.Series:
    """An axis as a column: nanoseconds, numbers, truth values, or else texts as YAML has them."""
    column = [values_of_point[name] for values_of_point in points]
    if is_duration(name, values):
        times = [parse_duration(v) if isinstance(v, str) else v for v in column]
        return pl.Series(f"{name}_ns", times, dtype=pl.Int64)
    kinds = {type(value) for value in values if value is not None}
    for dtype, those in ((pl.Boolean, {bool}), (pl.Int64, {int}), (pl.Float64, {int, float})):
        if kinds and kinds <= those:
            return pl.Series(name, column, dtype=dtype)
    return pl.Series(name, [_text(value) for value in column], dtype=pl.String)


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    return yaml.safe_dump(value, default_flow_style=True, width=1000).split("\n")[0]
