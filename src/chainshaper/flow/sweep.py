"""`sweep` as a function: one application in many variants, each profiled, planned and judged.

An axis is a name with the values that it takes, those of YAML. What the name says, in this order:

    bands, epsilon, publish-slot, policy, …     a wish for the plan: a field of PlanRequest
    interference                                the load of section 2.5 beside the chain
    plan.servers.0.slots.0.1, plan.overrun, …   a value of the plan's file
    nodes.node3.core, seed, …                   a value of the application's description

For a point the application is simulated with its chain in front of all others (the profile),
planned, shaped, and simulated again with another seed: a margin is tried against latencies that the
plan has not seen.
"""

import dataclasses
import difflib
import fcntl
import importlib.metadata
import io
import json
import os
import re
import time
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path
from typing import IO, Any, TypeAlias, TypeVar

import numpy as np
import polars as pl
import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from chainshaper.analysis import latency_statistics
from chainshaper.analysis.statistics import PERCENTILES
from chainshaper.control.costs import NEVER, cost_over
from chainshaper.control.plant_file import LoopDescription, load_loop
from chainshaper.flow.plan import profile_chains
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning import ChainPlan, Plan, PlanRequest, Profile, plan_chain
from chainshaper.planning.overruns import slots_of_latency
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.simulation.system import build_system
from chainshaper.values.durations import format_duration, parse_duration
from chainshaper.values.errors import ChainshaperError, InputError, OperationError
from chainshaper.values.files import new_file, open_output, scratch_folder, write_whole
from chainshaper.values.many_tasks import engine
from chainshaper.values.progress import Progress
from chainshaper.values.yaml_file import AS_YAML, PlainData, compose, wrong_values_refused
from chainshaper.verify.promises import OutputsDue
from chainshaper.workload.description import Application, application_as_written, origin_timer

Values: TypeAlias = Mapping[str, Any]
"""A point: a value for every axis."""
Row: TypeAlias = Mapping[str, Any]
"""What became of a point: :data:`FIGURES` by name."""
_Model = TypeVar("_Model", bound=BaseModel)

INTERFERENCE = "interference"
PLAN = "plan."
UNPLANNED = "none"  # the policy of a point whose application runs as it is described
MOST_POINTS = 1_000_000
BY_CALLBACK = ("server-per-callback", "pipelined")  # need response times, which take events
STRUCTURE_CYCLES = 100  # enough of a recording to see who publishes what where
MOST_RECORDED = 100_000
URGENT = 90  # a chain's profile has this priority where it is not the most urgent anyway
OTHER_RUN = 1 << 32  # on top of the seed for the judged run: seeds counted up never meet it
_REQUEST = TypeAdapter(PlanRequest)
_WISHES = {
    field.name.removesuffix("_ns"): field.name
    for field in dataclasses.fields(PlanRequest)
    if field.name not in ("seed", "cores")  # those of the application are meant
}
_RANGE = re.compile(r"(-?\d{1,18})\.\.(-?\d{1,18})")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)e[+-]?\d+", re.IGNORECASE)
_BAND = {
    "start_ns": pl.Int64,
    "end_ns": pl.Int64,
    "predicted_share": pl.Float64,
    "share": pl.Float64,
    "jitter_ns": pl.Int64,
}
_OF_RUN = ("min_ns", "mean_ns", "max_ns", "jitter_ns", "spread_ns")

FIGURES: dict[str, Any] = {
    **dict.fromkeys(("profile_min_ns", "profile_mean_ns", "profile_max_ns"), pl.Int64),
    **dict.fromkeys(("predicted_mean_ns", "predicted_max_ns", "predicted_jitter_ns"), pl.Int64),
    **dict.fromkeys(("count", "incomplete", "late", "missed", "most_missed", *_OF_RUN), pl.Int64),
    **{f"p{percentile:g}_ns": pl.Int64 for percentile in PERCENTILES},
    "kept": pl.Boolean,
    "control_cost": pl.Float64,
    "band_jitter_ns": pl.Int64,
    "per_band": pl.List(pl.Struct(_BAND)),
    "error": pl.String,
    "seconds": pl.Float64,
}
"""The columns of a row behind those of the axes.

    profile_min_ns, profile_mean_ns, profile_max_ns: L̲, the average and L̄ that the plan rests on.
    predicted_…_ns: what the plan predicts (eq. 5).
    count, min_ns … p99.99_ns: latencies of the judged run, as are all that follow.
    incomplete: instances of the chain without an output.
    late: outputs behind the last slot (without slots: later than the plan says).
    missed: both.
    most_missed: so many at most, as the plan promises.
    kept: whether it is so (:class:`~chainshaper.verify.promises.OutputsDue`).
    control_cost: what the latencies cost a plant's controller per second; null: no plant is given,
    or the loop is unstable.
    band_jitter_ns: the widest of those ``per_band``.
    per_band: slot, shares and jitter of each band.
    error: why the point could not be judged.
    seconds: of computing, without the profile, which points share.
"""


@dataclass(frozen=True)
class Grid:
    """What :func:`sweep` is asked for: every combination of the axes' values is a point."""

    application: Application
    plan: ChainPlan | None
    axes: Mapping[str, tuple[Any, ...]]
    cycles: int
    plant: LoopDescription | None = None  # whose controller's cost is a figure


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
    plant: str | Path | None = None,
    progress: Progress = lambda *_: None,
) -> pl.DataFrame:
    """Simulate an application at every combination of some values, planned and shaped for each.

    ``vary`` has the values of each axis, durations as texts. With a ``plan``, this one is in force
    everywhere. Each point is a run of ``cycles`` periods to plan from, and another one with the
    plan in force; ``seed`` replaces the description's. ``workers`` threads compute (default: one
    per core that we may use), or the Dask cluster whose ``scheduler`` is at that address. Of a
    ``plant``, the file that describes a control loop, the cost is a figure.

    The frame, also written to ``output`` (Parquet), has a row for each point, in the order of the
    axes: their columns (durations in ns, with ``_ns`` behind the name), ``cycles``, ``seed``, and
    :data:`FIGURES`. Until it is whole, finished rows stand beside it, and the same call goes on.

    Raises InputError: unknown axes or impossible values; ``output`` exists, or rows beside it are
    of another sweep. OperationError: the cluster failed, or the disk is full. PlatformError:
    `distributed` is not installed.
    """
    if plan is not None and len(plan.chains) > 1:
        raise InputError("the plan is of several chains, and that of one is wanted here")
    output = new_file(output, (".parquet",))
    of_chain = None if plan is None else plan.chains[0]
    grid = grid_of(application, vary, of_chain, cycles=cycles, seed=seed)
    described = None
    if plant is not None:
        described = Path(plant)
        grid = dataclasses.replace(grid, plant=load_loop(described))
    if workers is not None and workers < 1:
        raise InputError(f"{workers} workers compute nothing: ask for at least 1")
    points = points_of(grid)
    rows_file = rows_beside(output)
    about = {  # what rows depend on, under the names that are said when it changed
        "the version of chainshaper": importlib.metadata.version("chainshaper"),
        "the application or the seed": application_as_written(grid.application),
        "the plan": None if grid.plan is None else grid.plan.model_dump(mode="json"),
        "the axes": {name: list(values) for name, values in grid.axes.items()},
        "the number of cycles": grid.cycles,
    }
    if described is not None:
        about["the plant"] = described.read_text(encoding="utf-8")
    with finished_rows(rows_file, about) as (rows, add):
        missing = [(number, values) for number, values in enumerate(points) if number not in rows]
        if missing:
            most = min(workers or len(available_cores()), len(missing))
            progress(len(rows) / len(points), f"{len(points)} points")
            with closing(rows_of(grid, missing, most, scheduler)) as coming:
                for number, row in coming:
                    add(number, row)
                    progress(len(rows) / len(points), f"{len(points)} points")
        axes = [_axis(name, [values[name] for values in points]) for name in grid.axes]
        constants = {"cycles": grid.cycles, "seed": grid.application.seed}
        columns = [
            pl.lit(value, pl.Int64).alias(name)
            for name, value in constants.items()
            if name not in grid.axes
        ]
        in_order = [dict(rows[number]) for number in range(len(points))]
        figures = pl.DataFrame(in_order, schema=FIGURES)
        frame = pl.DataFrame(axes).with_columns(columns).hstack(figures)
        content = io.BytesIO()
        frame.write_parquet(content)
        write_whole(output, [content.getvalue()])
        rows_file.unlink()
    return frame


def _axis(name: str, column: Sequence[Any]) -> pl.Series:
    """Return an axis as a column: times (ns), numbers, truth values, or texts as YAML has them."""
    if is_duration(name, column):
        times = [parse_duration(value) if isinstance(value, str) else value for value in column]
        return pl.Series(f"{name}_ns", times, dtype=pl.Int64)
    kinds = {type(value) for value in column if value is not None}
    for dtype, fitting in ((pl.Boolean, {bool}), (pl.Int64, {int}), (pl.Float64, {int, float})):
        if kinds and kinds <= fitting:
            return pl.Series(name, column, dtype=dtype)

    def text(value: Any) -> str:
        flow = yaml.safe_dump(value, default_flow_style=True, width=1000)
        return value if isinstance(value, str) else flow.split("\n")[0]

    texts = [None if value is None else text(value) for value in column]
    return pl.Series(name, texts, dtype=pl.String)


def parse_axis(text: str) -> tuple[str, tuple[Any, ...]]:
    """Return the name and values of an axis: ``bands=1..5``, ``epsilon=0,1ms``, ``policy=none``.

    Raises InputError: it is no axis.
    """
    name, _, values = text.partition("=")
    try:
        root = compose(f"[{values}]", "value")
        listed = None if root is None else PlainData("value").of(root)
        if not name.strip() or not isinstance(listed, tuple) or not listed:
            raise InputError("it has no name, or no values")
    except InputError as error:
        raise InputError(
            f"--vary {text!r} is no axis: write NAME=VALUE,VALUE…, such as epsilon=0ms,1ms,2ms or"
            f" bands=1..5 ({error})"
        ) from error
    plain = json.loads(json.dumps(listed))  # lists where YAML's reader has tuples
    return name.strip(), tuple(value for written in plain for value in _expanded(written))


def _expanded(written: Any) -> Iterator[Any]:
    """Yield the numbers of a range, the number that a text such as 1e-6 is, or the value."""
    if isinstance(written, str) and (ends := _RANGE.fullmatch(written)):
        numbers = range(int(ends[1]), int(ends[2]) + 1)
        if numbers[MOST_POINTS:]:
            raise InputError(f"{written}: more than {MOST_POINTS} values: write a shorter range")
        yield from numbers
    elif isinstance(written, str) and _NUMBER.fullmatch(written):
        yield float(written)
    else:
        yield written


def grid_of(
    application: Application,
    axes: Mapping[str, Sequence[Any]],
    plan: ChainPlan | None = None,
    *,
    cycles: int,
    seed: int | None = None,
) -> Grid:
    """Return a grid. Raises InputError: an unknown or empty axis, or a value it cannot have."""
    if seed is not None:
        application = application.model_copy(update={"seed": seed})
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be simulated: ask for at least 1")
    # Wishes are called as the command line calls them, or as Python does.
    python = {name: name.replace("-", "_").removesuffix("_ns") for name in axes}
    known = {name: wish if wish in _WISHES else name for name, wish in python.items()}
    named = {known[name]: tuple(values) for name, values in axes.items()}
    if len(named) < len(axes):
        raise InputError(f"an axis is given twice, of {', '.join(axes)}: give all values at once")
    grid = Grid(application, plan, named, cycles)
    for name, values in named.items():
        _refuse_unknown(name, plan)
        texts = [json.dumps(value) for value in values]
        if not values or len(set(texts)) < len(texts):
            raise InputError(f"axis {name}: give at least one value, and none of them twice")
    if (points := prod(map(len, named.values()))) > MOST_POINTS:
        raise InputError(f"{points} points: give fewer values, for {MOST_POINTS} points at most")
    first = {name: values[0] for name, values in named.items()}
    for point in ({**first, name: value} for name, values in named.items() for value in values):
        application_at(grid, point)
        plan_at(grid, point)
        request_at(grid, point)
    return grid


def points_of(grid: Grid) -> list[Values]:
    """Return all points, in the order of the axes: the last axis changes fastest."""
    return [dict(zip(grid.axes, values, strict=True)) for values in product(*grid.axes.values())]


def _changes_application(name: str) -> bool:
    """Return whether an axis is a value of the application's description."""
    return name not in _WISHES and not name.startswith(PLAN)


def _refuse_unknown(name: str, plan: ChainPlan | None) -> None:
    """Refuse an axis that says nothing. Raises InputError."""
    if plan is not None and name in _WISHES:
        raise InputError(
            f"axis {name} is a wish for a plan, but a plan is given: leave it out, or vary a value"
            " of its file, such as plan.overrun"
        )
    if plan is None and name.startswith(PLAN):
        raise InputError(f"axis {name} is a value of a plan's file: give the plan, too")
    keys = [field.removesuffix("_ns") for field in Application.model_fields]
    first, named = name.partition(".")[0], [*_WISHES, INTERFERENCE]
    if _changes_application(name) and first not in (*keys, INTERFERENCE):
        near = difflib.get_close_matches(first, [*named, *keys], n=1)
        meant = f", did you mean {near[0]}?" if near else ""
        raise InputError(
            f"axis {name}: no such thing{meant} There are"
            f" {', '.join(named)}, plan.PATH with a plan, and values of the description, by paths"
            f" that begin with {', '.join(keys)}"
        )


def is_duration(name: str, values: Sequence[Any]) -> bool:
    """Return whether an axis has durations only: all with units, but for zeros."""
    durations = []
    with suppress(InputError):
        texts = {str(value) for value in values if value not in (0, None)}
        durations = [parse_duration(text) for text in texts]
    return bool(durations) or _WISHES.get(name, "").endswith("_ns")


def application_at(grid: Grid, values: Values) -> Application:
    """Return the application of a point. Raises InputError: it cannot be."""
    changes = {name: value for name, value in values.items() if _changes_application(name)}
    if not changes:
        return grid.application
    described: Any = application_as_written(grid.application)
    for name in changes:
        _refuse_unknown_node(name, described)
    if (load := changes.get(INTERFERENCE)) is not None:
        _, timer = origin_timer(grid.application)
        described = _interfered(described, timer.period_ns or 0, _nanoseconds(INTERFERENCE, load))
    return _changed(Application, described, changes, without=INTERFERENCE)


def plan_at(grid: Grid, values: Values) -> ChainPlan | None:
    """Return the given plan, if any, with the point's values in it.

    Raises InputError: that is no plan.
    """
    changes = {name: value for name, value in values.items() if name.startswith(PLAN)}
    if grid.plan is None or not changes:
        return grid.plan
    written = grid.plan.model_dump(mode="json", by_alias=True, context=AS_YAML)
    return _changed(ChainPlan, written, changes)


def request_at(grid: Grid, values: Values) -> PlanRequest | None:
    """Return what is asked for of a point's plan; None: no plan is made for it.

    Raises InputError: that cannot be asked for.
    """
    if grid.plan is not None or values.get("policy") == UNPLANNED:
        return None
    wishes: dict[str, Any] = {"seed": values.get("seed", grid.application.seed)}
    for name in values.keys() & _WISHES.keys():
        field, value = _WISHES[name], values[name]
        wishes[field] = _nanoseconds(name, value) if field.endswith("_ns") else value
    try:
        return _REQUEST.validate_json(json.dumps(wishes), strict=True)
    except ValidationError as error:
        wrong, name = error.errors()[0], str(error.errors()[0]["loc"][0])
        axis = f"axis {name.removesuffix('_ns')}"
        raise InputError(
            f"{axis}: {wishes.get(name)!r} is no value of it: {wrong['msg']}"
        ) from error


def _changed(model: type[_Model], data: Any, changes: Values, without: str = "") -> _Model:
    """Return a model's plain data with values replaced by their paths, validated.

    Raises InputError: the values do not fit.
    """
    for name, value in changes.items():
        if name != without:
            data = _replaced(data, name.removeprefix(PLAN).split("."), value)
    assignments = ", ".join(f"{name}={value}" for name, value in changes.items())
    with wrong_values_refused(model, f"{assignments}: "):
        return model.model_validate_json(json.dumps(data), context=AS_YAML)


def _refuse_unknown_node(name: str, described: Mapping[str, Any]) -> None:
    """Refuse a path to a node that the description has not: it would be added, with one value."""
    (first, *within), known = name.split("."), [*described.get("nodes", {})]
    node = within[0] if within else ""
    if first == "nodes" and within[1:] and node not in (*known, INTERFERENCE):
        near = difflib.get_close_matches(node, known, n=1)
        meant = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        raise InputError(f"axis {name}: the application has no node {node!r}; {meant}")


def _replaced(data: Any, path: list[str], value: Any) -> Any:
    """Return plain data with the value at a path replaced; mappings on the way to it are made."""
    if not path:
        return value
    key, *rest = path
    if isinstance(data, list) and key.isdecimal() and (at := int(key)) < len(data):
        return [*data[:at], _replaced(data[at], rest, value), *data[at + 1 :]]
    mapping = data if isinstance(data, dict) else {}
    return {**mapping, key: _replaced(mapping.get(key), rest, value)}


def _interfered(described: dict[str, Any], period_ns: int, longest_ns: int) -> dict[str, Any]:
    """Return the description with the load of section 2.5 once a period, least urgent of all."""
    given = described["nodes"].get(INTERFERENCE, {})
    first, *further = given.get("callbacks", [{"timer": format_duration(period_ns)}])
    times = [format_duration(longest_ns // 2), format_duration(longest_ns)]
    callbacks = [{**first, "execution": {"uniform": times}}, *further]
    node = {"priority": 1, "dds_priority": 1, **given, "callbacks": callbacks}
    return {**described, "nodes": {**described["nodes"], INTERFERENCE: node}}


def _nanoseconds(name: str, value: Any) -> Any:
    """Return a duration of an axis (ns), or what is none: null or 0. Raises InputError."""
    if value is None or value == 0:
        return value
    if not isinstance(value, str):
        raise InputError(f"axis {name}: {value!r} has no unit: write a duration, such as 1ms")
    return parse_duration(value)


def profile_at(grid: Grid, values: Values, progress: Progress | None = None) -> Profile | str:
    """Return the measurements that a point is planned from, or why there are none."""
    try:
        application = _urgent(application_at(grid, values))
        most = MOST_RECORDED if values.get("policy") in BY_CALLBACK else STRUCTURE_CYCLES
        recorded = min(grid.cycles, most)
        with scratch_folder() as folder:
            place = folder / "profile"
            recording = simulate(application, place, cycles=recorded, progress=progress)
            (profile,) = profile_chains(recording)
        latencies = simulate_latencies(application, cycles=grid.cycles, progress=progress)
    except ChainshaperError as error:
        return str(error)
    complete = latencies[latencies >= 0]
    return dataclasses.replace(
        profile,
        latencies_ns=complete,
        every_latency_ns=complete,
        starts_ns=None,  # those known are of the cycles that were recorded
        measured_ns=None,
        incomplete=int(latencies.size - complete.size),
        recording=None,
    )


def _urgent(application: Application) -> Application:
    """Return the application in the profiling condition (section 3.1).

    The chain's executors are more urgent than all others.
    """
    system = build_system(application, follow_chain=True)
    places = [system.entities[callback].process for callback in system.chain.callbacks]
    chain = {system.processes[place].key for place in places}
    priority = {name: application.scheduling_of(name).priority for name in application.nodes}
    others = [priority[name] for name in application.nodes if name not in chain]
    if min(priority[name] for name in chain) > max(others, default=0):
        return application
    nodes = dict(application.nodes)
    for name, node in application.nodes.items():
        urgent = URGENT if name in chain else min(priority[name], URGENT - 1)
        nodes[name] = node.model_copy(update={"priority": urgent})
    return application.model_copy(update={"nodes": nodes})


def row_at(
    grid: Grid, values: Values, profile: Profile | str | None, progress: Progress | None = None
) -> dict[str, Any]:
    """Return the :data:`FIGURES` of a point, which is planned from a ``profile``, if any.

    A profile that is a text says why there is none; this, too, is in the figures.
    """
    began = time.perf_counter()
    figures: dict[str, Any] = dict.fromkeys(FIGURES)
    try:
        if isinstance(profile, str):
            raise InputError(profile)
        application, plan = application_at(grid, values), plan_at(grid, values)
        request = request_at(grid, values)
        if profile is not None and request is not None:
            plan = plan_chain(profile, request)
        latencies = simulate_latencies(
            application,
            None if plan is None else Plan.of(plan),
            cycles=grid.cycles,
            seed=application.seed + OTHER_RUN,
            progress=progress,
        )
        complete = latencies[latencies >= 0]
        measured = latency_statistics(complete, incomplete=latencies.size - complete.size)
        figures |= {name: getattr(measured, name) for name in ("count", "incomplete", *_OF_RUN)}
        figures |= {f"p{name}_ns": value for name, value in measured.percentiles_ns.items()}
        if plan is not None:
            figures |= _judged(plan, complete, measured.incomplete)
        planned_for = None if request is None else request.plant
        described = grid.plant if planned_for is None else load_loop(planned_for)
        if described is not None:
            figures["control_cost"] = _control_cost(described, application, latencies)
    except ChainshaperError as error:
        figures["error"] = str(error)
    return {**figures, "seconds": round(time.perf_counter() - began, 6)}


def _control_cost(
    described: LoopDescription, application: Application, latencies_ns: Any
) -> float | None:
    """Return what latencies, a period apart, cost a control loop; None: it is unstable."""
    _, timer = origin_timer(application)
    period_ns = timer.period_ns or 0
    latencies = np.where(latencies_ns < 0, NEVER, latencies_ns)
    samples = np.arange(latencies.size, dtype=np.int64) * period_ns
    cost = cost_over(described.loop(period_ns), samples, latencies).cost
    return cost if np.isfinite(cost) else None


def _judged(plan: ChainPlan, latencies: Any, incomplete: int) -> dict[str, Any]:
    """Return what the plan says, what became of its bands, and whether its promise was kept."""
    slots = slots_of_latency(plan)
    shares: Sequence[float | None] = plan.predicted.shares
    if len(shares) != len(slots):  # slots were edited in number
        shares = [None] * len(slots)
    # An output belongs to the last slot that had started when it left, if it is not late.
    until = [start for start, _ in slots[1:]] + [end for _, end in slots[-1:]]
    bands, jitters = [], []
    for (start, end), before, share in zip(slots, until, shares, strict=True):
        inside = latencies[(latencies >= start) & (latencies < before)]
        jitter = int(np.ptp(inside)) if inside.size else None
        if jitter is not None:
            jitters.append(jitter)
        band = {
            "start_ns": start,
            "end_ns": end,
            "predicted_share": share,
            "share": inside.size / latencies.size if latencies.size else None,
            "jitter_ns": jitter,
        }
        bands.append(band)
    latest = slots[-1][1] - 1 if slots else plan.predicted.max_ns
    evidence, predicted = plan.evidence, plan.predicted
    late = int(np.count_nonzero(latencies > latest))
    outputs = OutputsDue.of(latencies.size, late, incomplete, plan)
    return {
        "profile_min_ns": evidence.min_latency_ns,
        "profile_mean_ns": evidence.mean_latency_ns,
        "profile_max_ns": evidence.max_latency_ns,
        "predicted_mean_ns": predicted.mean_ns,
        "predicted_max_ns": predicted.max_ns,
        "predicted_jitter_ns": predicted.jitter_ns,
        "late": late,
        "missed": outputs.missed,
        "most_missed": outputs.most_missed,
        "kept": outputs.kept,
        "band_jitter_ns": max(jitters, default=None),
        "per_band": bands,
    }


def changing_nothing(frame: pl.DataFrame, axes: Sequence[str]) -> list[str]:
    """Return a sentence for each axis that changes no figure of the judged run.

    An axis may change something beside some values of the others only: then the sentence says
    beside which it does not.
    """
    percentiles = [name for name in FIGURES if name.startswith("p9")]
    figures = ["count", "incomplete", "late", *_OF_RUN, *percentiles]
    sentences = []
    for axis in axes:
        further = [name for name in axes if name != axis]
        run = frame.filter(pl.col("error").is_null()).with_columns(together=pl.lit(0))
        groups = run.group_by("together", *further, maintain_order=True)
        compared = groups.agg(points=pl.len(), same=pl.struct(figures).n_unique() == 1)
        compared = compared.filter(pl.col("points") > 1)
        same = compared.filter("same")
        if not same.height:
            continue
        name = axis.removesuffix("_ns")
        where = "" if same.height == compared.height else _where(same, further)
        why = ": its load has the lowest priority, or another core" if name == INTERFERENCE else ""
        sentences.append(f"{name} changes nothing{where}{why}")
    return sentences


def _where(same: pl.DataFrame, axes: Sequence[str]) -> str:
    """Say at which values of these axes the figures are the same: `` where policy is shaped``."""
    shown = [
        " and ".join(f"{name.removesuffix('_ns')} is {row[name]}" for name in axes)
        for row in same.head(3).to_dicts()
    ]
    more = f" (and {same.height - 3} more)" if same.height > 3 else ""
    return f" where {', or '.join(shown)}{more}"


Points: TypeAlias = list[tuple[int, Values]]
"""Points, each behind its number."""


def groups_of(grid: Grid, points: Iterable[tuple[int, Values]]) -> Iterator[tuple[bool, Points]]:
    """Yield points that share a profile, behind whether they need one."""
    groups = defaultdict[tuple[bool, bool, str], Points](list)
    for number, values in points:
        profiled = request_at(grid, values) is not None
        application = {name: value for name, value in values.items() if _changes_application(name)}
        per_callback = profiled and values.get("policy") in BY_CALLBACK
        groups[profiled, per_callback, json.dumps(application)].append((number, values))
    return ((profiled, group) for (profiled, *_), group in groups.items())


def rows_of(
    grid: Grid, points: Iterable[tuple[int, Values]], workers: int, scheduler: str | None = None
) -> Generator[tuple[int, Row], None, None]:
    """Yield rows behind their points' numbers, as they are finished.

    Few profiles are in memory at once.
    """
    groups, pending = list(groups_of(grid, points)), dict[Any, Points | int]()
    bare = (point for profiled, group in groups if not profiled for point in group)
    ready = deque[tuple[int, Values, Any]]((number, values, None) for number, values in bare)
    coming = iter([group for profiled, group in groups if profiled])
    with engine(workers, scheduler, "a sweep", "; finished rows stay") as computing:
        while True:
            while len(pending) < computing.under_way:
                if ready:
                    number, values, profile = ready.popleft()
                    pending[computing.submit(row_at, grid, values, profile)] = number
                elif group := next(coming, None):
                    pending[computing.submit(profile_at, grid, group[0][1])] = group
                else:
                    break
            if not pending:
                return
            future, result = computing.finished()
            point = pending.pop(future)
            if isinstance(point, int):
                yield point, result
            else:  # a profile is there for its points
                ready.extend((number, values, future) for number, values in point)


def rows_beside(output: Path) -> Path:
    """Return the file in which the finished rows of a sweep stand until it is whole."""
    return output.with_name(output.name + ".rows")


@contextmanager
def finished_rows(
    path: Path, about: Mapping[str, Any]
) -> Iterator[tuple[dict[int, Row], Callable[[int, Row], None]]]:
    """Open the file of finished rows, until the context ends.

    Yields the rows by the number of their point, and a function that adds a row. The file has a
    line of JSON for each, behind a first that says what is swept (``about``, plain data). Each is
    on disk before the next; a crash leaves half a line at most, which is removed.

    Raises InputError: the file is of another sweep. OperationError: another process works on it, or
    it cannot be read or written.
    """
    about = json.loads(json.dumps(about))
    try:
        descriptor = open_output(path, os.O_RDWR | os.O_APPEND)
        with os.fdopen(descriptor, "a+", encoding="utf-8", errors="surrogateescape") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                why = "another process works on this sweep: wait for it, or name another output"
                raise OperationError(f"{path}: {why}") from error
            rows = _read(file, path, about)

            def append(value: Mapping[str, Any]) -> None:
                file.write(json.dumps(value) + "\n")
                file.flush()
                os.fsync(file.fileno())

            def add(number: int, row: Row) -> None:
                rows[number] = row  # first: an interruption must not take it for an empty file
                append({"number": number, "row": row})

            try:
                if not path.stat().st_size:
                    append(about)
                yield rows, add
            finally:
                if not rows:
                    path.unlink()
    except OSError as error:
        raise OperationError(
            f"{path}: finished rows cannot be written ({error.strerror or error}); what is in it"
            " stays, and the same command goes on from there"
        ) from error


def _read(file: IO[str], path: Path, about: Mapping[str, Any]) -> dict[int, Row]:
    """Return the rows of whole lines; cut off what is behind them.

    Raises InputError: these are no rows, or those of another sweep.
    """
    file.seek(0)
    text = file.read()
    whole = text[: text.rfind("\n") + 1]
    try:
        length = len(whole.encode())  # ValueError, as below: not all of it is UTF-8
        begun = json.dumps(about)
        if not whole and not begun.startswith(text):
            raise ValueError  # it has no whole line, and not what a crash leaves of the first
        first, *rows = map(json.loads, whole.split("\n")[:-1] or [begun])
        finished = {row["number"]: row["row"] for row in rows}
        changed = [name for name in about if first[name] != about[name]]
    except (ValueError, KeyError, TypeError) as error:
        remedy = "move the file away, or name another output"
        raise InputError(f"{path}: these are no rows of a sweep: {remedy}") from error
    if changed:
        raise InputError(
            f"{path} has {len(finished)} finished rows of another sweep: {' and '.join(changed)}"
            " changed since. Undo that to go on with them, name another output, or remove the file"
        )
    file.truncate(length)
    return finished
