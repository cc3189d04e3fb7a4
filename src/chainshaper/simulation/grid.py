"""The grid of a sweep: axes, the combinations of their values, and what each of these means.

An axis is a name with the values that it takes. What the name says is found out in this order:

    bands, epsilon, publish-slot, policy, …     a wish for the plan: a field of PlanRequest
    interference                                the load of section 2.5 beside the chain
    plan.servers.0.slots.0.1, plan.overrun, …   a value of the plan's file
    nodes.node3.core, seed, …                   a value of the application's description

Paths lead through mappings by key and through lists by number, from 0. Values are those of YAML,
so a whole part of a description may be one: ``{uniform: [5ms, 10ms]}``.
"""

import dataclasses
import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Any, TypeAlias, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from chainshaper.planning import Plan, PlanRequest
from chainshaper.values.durations import format_duration, parse_duration
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import AS_YAML, PlainData, compose, wrong_values_refused
from chainshaper.workload.description import Application, application_as_written
from chainshaper.workload.live import origin_timer

__all__ = [
    "Grid",
    "Values",
    "application_at",
    "changes_application",
    "grid_of",
    "is_duration",
    "parse_axis",
    "plan_at",
    "points_of",
    "request_at",
]

Values: TypeAlias = Mapping[str, Any]
"""One value for every axis: a point."""

INTERFERENCE = "interference"
PLAN = "plan."
UNPLANNED = "none"
"""The policy of a point whose application runs as it is described."""

_REQUEST = TypeAdapter(PlanRequest)
_WISHES = {
    field.name.removesuffix("_ns"): field.name
    for field in dataclasses.fields(PlanRequest)
    if field.name != "seed"  # that of the application is meant
}
MOST_POINTS = 1_000_000
_RANGE = re.compile(r"(-?\d{1,18})\.\.(-?\d{1,18})")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)e[+-]?\d+", re.IGNORECASE)
_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True)
class Grid:
    """Every combination of the axes' values, for one application.

    ``plan`` is in force in all of them; without one each point is planned. Each point is
    simulated for ``cycles`` periods of the chain.
    """

    application: Application
    plan: Plan | None
    axes: Mapping[str, tuple[Any, ...]]
    cycles: int


def parse_axis(text: str) -> tuple[str, tuple[Any, ...]]:
    """An axis as it is written: ``bands=1..5``, ``epsilon=0,1ms``, ``policy=none,shaped``.

    Raises:
        InputError: it is not of this form.
    """
    name, equals, values = text.partition("=")
    usage = "write NAME=VALUE,VALUE…, such as epsilon=0ms,1ms,2ms or bands=1..5"
    try:
        root = compose(f"[{values}]", "value")
        listed = None if root is None else PlainData("value").of(root)
    except InputError as error:
        raise InputError(f"--vary {text!r} is no axis: {usage} ({error})") from error
    if not equals or not name.strip() or not isinstance(listed, tuple) or not listed:
        raise InputError(f"--vary {text!r} is no axis: {usage}")
    return name.strip(), tuple(value for one in _as_json(listed) for value in _expanded(one))


def _as_json(value: Any) -> Any:
    """Plain data as JSON would have it: with lists."""
    if isinstance(value, dict):
        return {key: _as_json(one) for key, one in value.items()}
    return [_as_json(one) for one in value] if isinstance(value, tuple) else value


def _expanded(written: Any) -> Iterator[Any]:
    """A range as its numbers, and numbers that YAML 1.1 takes for texts (1e-6)."""
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
    plan: Plan | None = None,
    *,
    cycles: int,
    seed: int | None = None,
) -> Grid:
    """A grid, once it is sure that each value of each axis means something.

    Raises:
        InputError: an axis that is unknown or empty, or a value that it cannot have.
    """
    if seed is not None:
        application = application.model_copy(update={"seed": seed})
    if cycles < 1:
        raise InputError(f"{cycles} cycles cannot be simulated: ask for at least 1")
    named = {_normal(name): tuple(values) for name, values in axes.items()}
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
    for name, values in named.items():
        for value in values:
            point = {**first, name: value}
            application_at(grid, point)
            plan_at(grid, point)
            request_at(grid, point)
    return grid


def points_of(grid: Grid) -> list[Values]:
    """All points, in the order of the axes: the last one changes fastest."""
    return [dict(zip(grid.axes, values, strict=True)) for values in product(*grid.axes.values())]


def changes_application(name: str) -> bool:
    """Whether an axis is about the application, and not about the plan only."""
    return name not in _WISHES and not name.startswith(PLAN)


def is_duration(name: str, values: Sequence[Any]) -> bool:
    """Whether an axis has durations only: all with units, but for zeros."""
    if _WISHES.get(name, "").endswith("_ns"):
        return True
    texts = [value for value in values if value not in (0, None)]
    return bool(texts) and all(isinstance(text, str) and _has_unit(text) for text in texts)


def application_at(grid: Grid, values: Values) -> Application:
    """The application of a point.

    Raises:
        InputError: it cannot be; the values and the reason are named.
    """
    changes = {name: value for name, value in values.items() if changes_application(name)}
    if not changes:
        return grid.application
    described: Any = application_as_written(grid.application)
    if (load := changes.get(INTERFERENCE)) is not None:
        timer = origin_timer(grid.application)
        described = _interfered(described, timer.timer_ns or 0, _nanoseconds(INTERFERENCE, load))
    for name, value in changes.items():
        if name != INTERFERENCE:
            described = _replaced(described, name.split("."), value)
    return _validated(Application, described, changes)


def plan_at(grid: Grid, values: Values) -> Plan | None:
    """The given plan with the point's values in it; None without one.

    Raises:
        InputError: that is no plan.
    """
    changes = {name: value for name, value in values.items() if name.startswith(PLAN)}
    if grid.plan is None or not changes:
        return grid.plan
    written: Any = grid.plan.model_dump(mode="json", by_alias=True, context=AS_YAML)
    for name, value in changes.items():
        written = _replaced(written, name.removeprefix(PLAN).split("."), value)
    return _validated(Plan, written, changes)


def request_at(grid: Grid, values: Values) -> PlanRequest | None:
    """What is wished of a point's plan; None where none is made.

    Raises:
        InputError: a value that no such wish can have.
    """
    if grid.plan is not None or values.get("policy") == UNPLANNED:
        return None
    wishes: dict[str, Any] = {"seed": values.get("seed", grid.application.seed)}
    for name, value in values.items():
        field = _WISHES.get(name)
        if field is not None:
            wishes[field] = _nanoseconds(name, value) if field.endswith("_ns") else value
    try:
        return _REQUEST.validate_json(json.dumps(wishes), strict=True)
    except ValidationError as error:
        wrong = error.errors()[0]
        where = str(wrong["loc"][0]).removesuffix("_ns")
        found = wishes.get(str(wrong["loc"][0]))
        raise InputError(f"axis {where}: {found!r} is no value of it: {wrong['msg']}") from error


def _normal(name: str) -> str:
    """Wishes are called as the command line calls them, or as Python does."""
    python = name.replace("-", "_").removesuffix("_ns")
    return python if python in _WISHES else name


def _refuse_unknown(name: str, plan: Plan | None) -> None:
    if plan is not None and name in _WISHES:
        raise InputError(
            f"axis {name} is a wish for a plan, but a plan is given: leave it out, or vary a value"
            " of its file, such as plan.overrun"
        )
    if plan is None and name.startswith(PLAN):
        raise InputError(f"axis {name} is a value of a plan's file: give the plan, too")
    keys = [field.removesuffix("_ns") for field in Application.model_fields]
    first = name.partition(".")[0]
    if changes_application(name) and first not in (*keys, INTERFERENCE):
        near = difflib.get_close_matches(first, [*_WISHES, *keys, INTERFERENCE], n=1)
        raise InputError(
            f"axis {name}: no such thing{f', did you mean {near[0]}?' if near else ''} There are"
            f" {', '.join([*_WISHES, INTERFERENCE])}, plan.PATH with a plan, and values of the"
            f" description, by paths that begin with {', '.join(keys)}"
        )


def _replaced(data: Any, path: list[str], value: Any) -> Any:
    """Plain data with one value in it replaced; mappings on the way to it are made."""
    if not path:
        return value
    key, *rest = path
    if isinstance(data, list) and key.isdecimal() and int(key) < len(data):
        number = int(key)
        return [*data[:number], _replaced(data[number], rest, value), *data[number + 1 :]]
    mapping = data if isinstance(data, dict) else {}
    return {**mapping, key: _replaced(mapping.get(key), rest, value)}


def _interfered(described: dict[str, Any], period_ns: int, longest_ns: int) -> dict[str, Any]:
    """The description with a load beside the chain, as in section 2.5.

    Once a period, for between half the time and all of it, at the lowest priority on the
    executors' core. A node of that name that is described keeps everything else that it has.
    """
    own = described["nodes"].get(INTERFERENCE, {})
    first, *others = own.get("callbacks", [{"timer": format_duration(period_ns)}])
    times = [format_duration(longest_ns // 2), format_duration(longest_ns)]
    callbacks = [{**first, "execution": {"uniform": times}}, *others]
    node = {"priority": 1, "dds_priority": 1, **own, "callbacks": callbacks}
    return {**described, "nodes": {**described["nodes"], INTERFERENCE: node}}


def _validated(model: type[_Model], data: Any, changes: Values) -> _Model:
    said = ", ".join(f"{name}={value}" for name, value in changes.items())
    with wrong_values_refused(model, f"{said}: "):
        return model.model_validate_json(json.dumps(data), context=AS_YAML)


def _nanoseconds(name: str, value: Any) -> Any:
    if value is None or value == 0:
        return value
    if not isinstance(value, str):
        raise InputError(f"axis {name}: {value!r} has no unit: write a duration, such as 1ms")
    return parse_duration(value)


def _has_unit(text: str) -> bool:
    try:
        parse_duration(text)
    except InputError:
        return False
    return True
