"""YAML files that people write: read them, and say exactly where they are wrong.

A message such as ``robot.yaml:14: nodes.node3.callbacks[0].execution: …`` saves its reader the
search. PyYAML knows the line of every key, Pydantic knows the path of every wrong value; here
the two are put together.
"""

import difflib
import re
from pathlib import Path
from typing import Annotated, TypeAlias, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    PlainSerializer,
    SerializationInfo,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from chainshaper.durations import format_duration, parse_duration
from chainshaper.errors import InputError

__all__ = [
    "AS_YAML",
    "Duration",
    "FullName",
    "Part",
    "PositiveDuration",
    "explanations",
    "key_text",
    "read_model",
    "wrong_value",
]

Model = TypeVar("Model", bound=BaseModel)
_Path: TypeAlias = tuple[str | int, ...]

_WANTED = {
    "tuple_type": "a list in [square brackets]",
    "model_type": "a mapping of keys and values",
    "string_type": "a text",
    "int_type": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
}

_SAID = {
    "missing": "is missing: add it",
    "too_short": "is too short: write one element at least",
}

AS_YAML = "yaml"
"""The Pydantic context in which durations are texts with units, on the way in and out."""

LONGEST_DURATION_NS = 2**63 - 1


def _duration_in(value: object, info: ValidationInfo) -> object:
    if isinstance(value, str):
        try:
            value = parse_duration(value)
        except InputError as error:
            raise ValueError(str(error)) from error
    elif info.context == AS_YAML and value != 0:
        raise ValueError(f"{value!r} is not a duration: write a number and a unit, such as 59ms")
    if isinstance(value, int) and value < 0:
        raise ValueError(f"{format_duration(value)} is negative: a duration here is 0ms or more")
    if isinstance(value, int) and value > LONGEST_DURATION_NS:
        raise ValueError("longer than 292 years, which no clock here counts: write a shorter one")
    return value


def _duration_out(value: int, info: SerializationInfo) -> int | str:
    return format_duration(value) if info.context == AS_YAML else value


def _above_zero(value: int) -> int:
    if value == 0:
        raise ValueError("is zero: write a duration longer than 0ms")
    return value


def _full_name(value: str) -> str:
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", value):
        raise ValueError(
            f"{value!r} is not a full ROS 2 name: write /name or /namespace/name, of letters,"
            " digits and underscores, no part beginning with a digit"
        )
    return value


Duration = Annotated[int, BeforeValidator(_duration_in), PlainSerializer(_duration_out)]
"""Nanoseconds; with the context :data:`AS_YAML` a text with a unit, on the way in and out."""
PositiveDuration = Annotated[Duration, AfterValidator(_above_zero)]
FullName = Annotated[str, AfterValidator(_full_name)]


class Part(BaseModel):
    """A part of a YAML file: frozen, strict, no unknown keys.

    Fields that end in ``_ns`` stand in YAML without the suffix, their values with a unit.
    """

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        populate_by_name=True,
        alias_generator=lambda name: name.removesuffix("_ns"),
    )


def wrong_value(reason: str, *where: str | int) -> PydanticCustomError:
    """The error for a wrong value that a validator found.

    ``where`` leads from the model that is being checked to the value at fault.
    """
    return PydanticCustomError("wrong_value", "{reason}", {"reason": reason, "where": where})


def read_model(path: str | Path, model: type[Model], *, made_by: str) -> Model:
    """A YAML file as a Pydantic model.

    ``made_by`` completes the sentence "such a file is …" for those who have none.

    Raises:
        InputError: no such file, not YAML, or wrong values; each is named with its line, key,
            reason and remedy.
    """
    path = Path(path)
    root = _compose(path, made_by)
    lines: dict[_Path, int] = {}
    values = _values(root, (), lines, path, set())
    if not isinstance(values, dict):
        raise InputError(
            f"{path}:1: expected a YAML mapping (key: value); such a file is {made_by}"
        )
    try:
        return model.model_validate(values, context=AS_YAML)
    except ValidationError as error:
        problems = [
            f"{path}:{_line(lines, where)}: {key_text(where)}: {reason}"
            for where, reason in explanations(error, model)
        ]
        raise InputError("\n".join(problems)) from error


def _compose(path: Path, made_by: str) -> yaml.Node:
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise InputError(
            f"{path}:{line}: not YAML: {error.problem or error.context}; correct the line"
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())  # PyYAML writes some over several lines
        raise InputError(f"{path}: not a YAML text ({reason}); such a file is {made_by}") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); such a file is {made_by}"
        ) from error
    if root is None:
        raise InputError(f"{path}:1: the file is empty; such a file is {made_by}")
    return root


def _values(
    node: yaml.Node, where: _Path, lines: dict[_Path, int], path: Path, seen: set[int]
) -> object:
    """The plain data of a YAML node; ``lines`` learns the line of every value on the way.

    Each collection may be used once: aliases could make a file refer to itself.
    """
    lines[where] = node.start_mark.line + 1
    if isinstance(node, yaml.ScalarNode):
        try:
            return yaml.SafeLoader("").construct_object(node)
        except (ValueError, yaml.YAMLError):  # a malformed date or an unknown tag
            return node.value
    if id(node) in seen:
        raise InputError(
            f"{path}:{node.start_mark.line + 1}: {key_text(where)}: refers to this by a YAML"
            " alias (*name): write the value out"
        )
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        return tuple(
            _values(item, (*where, number), lines, path, seen)
            for number, item in enumerate(node.value)
        )
    values: dict[str, object] = {}
    for key_node, value_node in node.value:
        key = str(key_node.value)
        place = (*where, key)
        if key in values or key.endswith("_ns"):
            reason = (
                "stands here a second time: remove one"
                if key in values
                else f"unknown key: write {key.removesuffix('_ns')!r}, and its value with a unit"
            )
            line = key_node.start_mark.line + 1
            raise InputError(f"{path}:{line}: {key_text(place)}: {reason}")
        values[key] = _values(value_node, place, lines, path, seen)
        lines[place] = key_node.start_mark.line + 1
    return values


def _line(lines: dict[_Path, int], where: _Path) -> int:
    # A missing key has no line of its own: the mapping it is missing from has.
    while where not in lines:
        where = where[:-1]
    return lines[where]


def key_text(where: _Path) -> str:
    """``servers[1].slots[0]``"""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return text.removeprefix(".") or "the file"


def explanations(error: ValidationError, model: type[BaseModel]) -> list[tuple[_Path, str]]:
    """Each wrong value once: a list is not too short because one of its elements is wrong."""
    details = error.errors()
    places = [detail["loc"] for detail in details]
    return [
        _explain(detail, model)
        for detail in details
        if detail["type"] != "too_short"
        or not any(place[:-1][: len(detail["loc"])] == detail["loc"] for place in places)
    ]


def _explain(error: ErrorDetails, model: type[BaseModel]) -> tuple[_Path, str]:
    """Where a value is wrong, and why and what to do, in words."""
    where = tuple(error["loc"])
    kind, context, found = error["type"], error.get("ctx", {}), error["input"]
    if kind == "wrong_value":
        return where + tuple(context["where"]), str(context["reason"])
    if kind == "value_error":
        return where, str(context["error"])
    if kind in _SAID:
        return where, _SAID[kind]
    if kind == "extra_forbidden":
        near = difflib.get_close_matches(str(where[-1]), _known_keys(model), n=1, cutoff=0.75)
        return where, "unknown key: " + (f"did you mean {near[0]!r}?" if near else "remove it")
    shown = repr(found) if isinstance(found, str | int | float | None) else "what stands here"
    if kind in _WANTED:
        return where, f"{shown} is not {_WANTED[kind]}: write one"
    reason = error["msg"].removeprefix("Input ")
    return where, f"{shown} {reason}: correct it" if reason.startswith("should") else reason


def _known_keys(model: type[BaseModel]) -> list[str]:
    keys: set[str] = set()
    pending = [model.model_json_schema(by_alias=True)]
    while pending:
        schema = pending.pop()
        keys.update(schema.get("properties", {}))
        pending.extend(schema.get("$defs", {}).values())
    return sorted(keys)
