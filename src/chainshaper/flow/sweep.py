"""`sweep` as a function: one application in many variants, each profiled, planned and judged."""

import importlib.metadata
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import yaml

from chainshaper.flow.plan import profile_chains
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning import Plan, Profile
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.simulation.arrays import build_system
from chainshaper.simulation.grid import (
    Grid,
    Values,
    application_at,
    grid_of,
    is_duration,
    points_of,
)
from chainshaper.simulation.sweeping import FIGURES, Row, finished_rows, rows_beside, rows_of
from chainshaper.values.durations import parse_duration
from chainshaper.values.errors import ChainshaperError, InputError
from chainshaper.values.files import new_file, write_whole
from chainshaper.workload.description import Application, application_as_written

__all__ = ["profile_at", "sweep"]

STRUCTURE_CYCLES = 100
"""Enough of a recording to see who publishes what where."""
MOST_RECORDED = 100_000
URGENT = 90
"""A chain is profiled at this priority where it is not more urgent than all others anyway."""

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

    ``vary`` has the values of each axis (:mod:`chainshaper.simulation.grid`), durations as texts.
    With a ``plan``, this one is in force everywhere. Each point is a run of ``cycles`` periods to
    plan from, and another one with the plan in force; ``seed`` replaces the description's.
    ``workers`` threads compute (default: one per core that we may use), or a Dask cluster, whose
    ``scheduler`` is at that address.

    The frame has a row for each point, in the order of the axes: a column for each axis (durations
    in ns, with ``_ns`` behind the name), ``cycles``, ``seed``, and the figures of
    :data:`chainshaper.simulation.sweeping.FIGURES`. A point that cannot be has an ``error``. The
    same frame is in ``output``, a Parquet file. Until it is whole, finished rows stand beside it,
    and the same call goes on with what is missing.

    Raises:
        InputError: unknown axes or impossible values; ``output`` exists, or rows beside it are of
            another sweep.
        OperationError: the cluster failed, or the disk is full.
        PlatformError: `distributed` is not installed.
    """
    output = new_file(output, (".parquet",))
    grid = grid_of(application, vary, plan, cycles=cycles, seed=seed)
    if workers is not None and workers < 1:
        raise InputError(f"{workers} workers compute nothing: ask for at least 1")
    points = points_of(grid)
    rows_file = rows_beside(output)
    with finished_rows(rows_file, _about(grid)) as (rows, add):
        missing = [(number, values) for number, values in enumerate(points) if number not in rows]
        most = min(workers or len(available_cores()), max(1, len(missing)))
        if missing and progress is not None:
            progress(len(rows) / len(points), f"{len(points)} points")
        with closing(rows_of(grid, missing, profile_at, most, scheduler)) as coming:
            for number, row in coming if missing else ():
                add(number, row)
                if progress is not None:
                    progress(len(rows) / len(points), f"{len(points)} points")
        frame = _frame(grid, points, [rows[number] for number in range(len(points))])
        content = io.BytesIO()
        frame.write_parquet(content)
        write_whole(output, [content.getvalue()])
        rows_file.unlink()
    return frame


def profile_at(grid: Grid, values: Values, progress: Progress | None = None) -> Profile | str:
    """The measurements that a point is planned from, or why there are none.

    They depend on the application, and on whether callbacks are planned one by one: then response
    times of as many cycles are needed, 100,000 at most, which takes events.
    """
    try:
        application = _urgent(application_at(grid, values))
        per_callback = values.get("policy") == "server-per-callback"
        recorded = min(grid.cycles, MOST_RECORDED if per_callback else STRUCTURE_CYCLES)
        with tempfile.TemporaryDirectory(prefix="chainshaper-sweep-") as folder:
            place = Path(folder) / "profile"
            recording = simulate(application, place, cycles=recorded, progress=progress)
            (profile,) = profile_chains(recording)
        latencies = simulate_latencies(application, cycles=grid.cycles, progress=progress)
    except ChainshaperError as error:
        return str(error)
    complete = latencies[latencies >= 0]
    incomplete = int(latencies.size - complete.size)
    return replace(profile, latencies_ns=complete, incomplete=incomplete, recording=None)


def _urgent(application: Application) -> Application:
    """The profiling condition (section 3.1): the chain's executors before all others."""
    system = build_system(application, follow_chain=True)
    places = [system.entities[callback].process for callback in system.chain.callbacks]
    chain = {system.processes[place].key for place in places}
    priority = {name: application.scheduling_of(name).priority for name in application.nodes}
    others = [priority[name] for name in application.nodes if name not in chain]
    if min(priority[name] for name in chain) > max(others, default=0):
        return application
    nodes = {
        name: node.model_copy(
            update={"priority": URGENT if name in chain else min(priority[name], URGENT - 1)}
        )
        for name, node in application.nodes.items()
    }
    return application.model_copy(update={"nodes": nodes})


def _about(grid: Grid) -> dict[str, Any]:
    """What rows depend on, under the names that are said when it changed."""
    return {
        "the version of chainshaper": importlib.metadata.version("chainshaper"),
        "the application or the seed": application_as_written(grid.application),
        "the plan": None if grid.plan is None else grid.plan.model_dump(mode="json"),
        "the axes": {name: list(values) for name, values in grid.axes.items()},
        "the number of cycles": grid.cycles,
    }


def _frame(grid: Grid, points: Sequence[Values], rows: Sequence[Row]) -> pl.DataFrame:
    axes = [_axis(name, values, points) for name, values in grid.axes.items()]
    seeds = [values.get("seed", grid.application.seed) for values in points]
    own = [pl.Series("cycles", [grid.cycles] * len(points), dtype=pl.Int64)]
    if "seed" not in grid.axes:
        own.append(pl.Series("seed", seeds, dtype=pl.Int64))
    figures = pl.DataFrame([dict(row) for row in rows], schema=FIGURES)
    return pl.DataFrame([*axes, *own]).hstack(figures)


def _axis(name: str, values: Sequence[Any], points: Sequence[Values]) -> pl.Series:
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
