"""Read YAML files that people write into Pydantic models.

A message about a wrong value names the line, which PyYAML knows, and the key, which Pydantic knows:
``robot.yaml:14: nodes.node3.callbacks[0].execution: …``.
"""

import difflib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

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

from chainshaper.values.durations import duration_text, format_duration, parse_duration
from chainshaper.values.errors import InputError

Model = TypeVar("Model", bound=BaseModel)
_Path: TypeAlias = tuple[str | int, ...]

_KINDS = {
    "tuple_type": "a list in [square brackets]",
    "model_type": "a mapping of keys and values",
    "string_type": "a text",
    "int_type": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
}
AS_YAML = "yaml"
"""The Pydantic context in which durations are texts with units, when read and when written."""

LONGEST_DURATION_NS = 2**63 - 1
LARGEST_FILE = 8 << 20  # bytes
DEEPEST = 100  # lists and mappings inside each other
MOST_VALUES = 200_000  # in a file, its aliases written out
_MOST_PROBLEMS = 20  # in a message


def _duration_in(value: object, info: ValidationInfo) -> object:
    if isinstance(value, str):
        try:
            value = parse_duration(value)
        except InputError as error:
            raise ValueError(str(error)) from error
    elif info.context == AS_YAML and value != 0:
        raise ValueError(f"{value!r} is not a duration: write a number and a unit, such as 59ms")
    if isinstance(value, int) and value < 0:
        raise ValueError(f"{duration_text(value)} is negative: a duration here is 0 ms or more")
    if isinstance(value, int) and value > LONGEST_DURATION_NS:
        raise ValueError("longer than 292 years, which no clock here counts: write a shorter one")
    return value


def _duration_out(value: int, info: SerializationInfo) -> int | str:
    return format_duration(value) if info.context == AS_YAML else value


def _above_zero(value: int) -> int:
    if value == 0:
        raise ValueError("is zero: write a duration longer than 0 ms")
    return value


def _full_name(value: str) -> str:
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", value):
        remedy = "write /name or /namespace/name, of letters, digits and underscores"
        raise ValueError(f"{value!r} is not a full ROS 2 name: {remedy}, no digit leading a part")
    return value


Duration = Annotated[int, BeforeValidator(_duration_in), PlainSerializer(_duration_out)]
"""Nanoseconds; in the context :data:`AS_YAML` a text with a unit, when read and when written."""
PositiveDuration = Annotated[Duration, AfterValidator(_above_zero)]
FullName = Annotated[str, AfterValidator(_full_name)]


class Part(BaseModel):
    """A part of a YAML file. A field ``length_ns`` is called ``length`` there, and has a unit."""

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        populate_by_name=True,
        alias_generator=lambda name: name.removesuffix("_ns"),
    )


def wrong_value(reason: str, *where: str | int) -> PydanticCustomError:
    """Make the error for a wrong value, which is at ``where`` in the model that is validated."""
    return PydanticCustomError("wrong_value", "{reason}", {"reason": reason, "where": where})


KINDS = {
    "a plan": {"format", "chains"},
    "a plan of an earlier version, converted by `chainshaper plan --convert {path} -o NEW.yaml`": {
        "servers",
        "predicted",
    },
    "the description of an application": {"nodes", "scheduling"},
}
"""Kinds of files, for messages, and the keys that only files of this kind have."""


def read_model(
    path: str | Path,
    model: type[Model],
    *,
    made_by: str,
    under: str | None = None,
) -> Model:
    """Read a YAML file into a Pydantic model; ``made_by`` completes "such a file is …" in messages.

    ``under`` is a key: where the file has it, the model is what stands there, and the rest of the
    file is not looked at.

    Raises InputError: no such file, not YAML, or wrong values, each with its line, key, reason and
    remedy.
    """
    path = Path(path)
    root, plain = compose(read_text(path, made_by), path), PlainData(path)
    values = plain.of(root) if root is not None else None
    if not isinstance(values, dict):
        problem = "the file is empty" if root is None else "expected a YAML mapping (key: value)"
        raise InputError(f"{path}:1: {problem}; such a file is {made_by}")
    inside: _Path = ()
    if under is not None and isinstance(values.get(under), dict):
        inside, values = (under,), values[under]
    try:
        return model.model_validate(values, context=AS_YAML)
    except ValidationError as error:
        known = {name.removesuffix("_ns") for name in model.model_fields}
        for kind, keys in KINDS.items():
            if keys <= values.keys() and not keys <= known:
                reason = f"is {kind.format(path=path)}; wanted is a file {made_by}"
                raise InputError(f"{path}: {reason}") from error
        raise plain.problems(error, model, inside) from error


def read_text(path: Path, made_by: str) -> str:
    """Read a file that a person writes. Raises InputError: it is not readable, or no such text."""
    such = f"such a file is {made_by}"
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except IsADirectoryError as error:
        kind = "the folder of a recording" if (path / "recording.json").exists() else "a folder"
        raise InputError(f"{path}: is {kind}; wanted is a file {made_by}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {such}") from error
    if len(content) > LARGEST_FILE:
        most = f"{LARGEST_FILE >> 20} MiB, the most that is read of such a file"
        raise InputError(f"{path}: larger than {most}; {such}")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{path}:{line}: not a text in UTF-8 ({error.reason}); {such}") from error


class _Loader(yaml.SafeLoader):
    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.depth > DEEPEST:
            reason = f"more than {DEEPEST} lists and mappings inside each other"
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, reason, mark)
        self.depth += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self.depth -= 1
        return node


def compose(text: str, name: str | Path) -> yaml.Node | None:
    """Parse a text, called ``name`` in messages. Raises InputError: it is not YAML."""
    try:
        return yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        reason = error.problem or error.context
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        reason = f"the character {error.character:#06x} may not stand here"
    raise InputError(f"{name}:{line}: not YAML: {reason}; correct the line")


_SCALARS = yaml.SafeLoader("")


def _scalar(node: yaml.ScalarNode) -> str | int | float | bool | None:
    """Return a scalar's value. Dates and other types that no file of ours has are texts.

    Raises ValueError: its tag claims a type that the value does not have (``!!int ""``), or a
    number has more than 64 bits.
    """
    try:
        value = _SCALARS.construct_object(node)
    except Exception as error:
        # PyYAML's constructors raise any error that int, re or a dictionary does.
        resolve: Any = _SCALARS.resolve
        if node.tag == resolve(yaml.ScalarNode, node.value, (True, False)):
            return str(node.value)  # PyYAML, not a tag in the file, takes it for a (wrong) date
        tag = node.tag.replace("tag:yaml.org,2002:", "!!")
        raise ValueError(f"{node.value!r} is no {tag}: write the value without a tag") from error
    if isinstance(value, int) and not -(1 << 63) <= value < 1 << 64:
        raise ValueError("a number of more than 64 bits: write a smaller one")
    return value if isinstance(value, str | int | float | None) else str(node.value)


@dataclass
class PlainData:
    """Makes plain data of YAML nodes, and notes the line of every value.

    Files of formats that are ``ours`` have neither aliases nor keys in ``_ns`` (units are in the
    values). In other files aliases are written out, but not without end: an alias could make a file
    contain itself, or a page be a billion values.
    """

    name: str | Path  # of the file, in messages
    ours: bool = True
    lines: dict[_Path, int] = field(default_factory=dict)  # by the value's path
    _seen: set[int] = field(default_factory=set)  # nodes, by their identity

    def of(self, node: yaml.Node, where: _Path = ()) -> object:
        """Return the value of a node, which is at ``where`` in the file.

        Raises InputError: it is wrong, or has a key twice.
        """
        self.lines[where] = node.start_mark.line + 1
        if isinstance(node, yaml.ScalarNode):
            try:
                return _scalar(node)
            except ValueError as error:
                raise self._wrong(node, where, str(error)) from error
        if id(node) in self._seen and self.ours:
            reason = "refers to this by a YAML alias (*name): write the value out"
            raise self._wrong(node, where, reason)
        if len(self.lines) > MOST_VALUES or len(where) > DEEPEST:
            reason = f"more than {MOST_VALUES} values, with its aliases (*name): write it without"
            raise self._wrong(node, where, f"the file has {reason} them")
        self._seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            return tuple(self.of(item, (*where, number)) for number, item in enumerate(node.value))
        values: dict[str, object] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise self._wrong(key_node, where, "a key here is a list or mapping: write a text")
            key = str(key_node.value)
            place = (*where, key)
            if key in values:
                raise self._wrong(key_node, place, "stands here a second time: remove one")
            if self.ours and key.endswith("_ns"):
                right = key.removesuffix("_ns")
                reason = f"unknown key: write {right!r}, and its value with a unit"
                raise self._wrong(key_node, place, reason)
            values[key] = self.of(value_node, place)
            self.lines[place] = key_node.start_mark.line + 1
        return values

    def _wrong(self, node: yaml.Node, where: _Path, reason: str) -> InputError:
        line = node.start_mark.line + 1
        return InputError(f"{self.name}:{line}: {_key_text(where)}: {reason}")

    def problems(
        self, error: ValidationError, model: type[BaseModel], inside: _Path = ()
    ) -> InputError:
        """Make an error of all values that a model has refused, each with its line.

        The model's values are those ``inside`` the file at this path.
        """
        lines = []
        for at, reason in _explanations(error, model):
            where = (*inside, *at)
            # A missing key has no line, so that of the mapping from which it is missing counts.
            places = (where[:end] for end in range(len(where), -1, -1))
            line = next((self.lines[place] for place in places if place in self.lines), 1)
            lines.append(f"{self.name}:{line}: {_key_text(where)}: {reason}")
        return InputError("\n".join(lines))


@contextmanager
def wrong_values_refused(model: type[BaseModel], beginning: str = "") -> Iterator[None]:
    """Turn a model's ValidationError into an InputError with this ``beginning``."""
    try:
        yield
    except ValidationError as error:
        wrong = [f"{_key_text(at)}: {reason}" for at, reason in _explanations(error, model)]
        raise InputError(beginning + "; ".join(wrong)) from error


def _key_text(where: _Path) -> str:
    """Return a path as text, such as ``servers[1].slots[0]``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return text.removeprefix(".") or "the file"


def _explanations(error: ValidationError, model: type[BaseModel]) -> list[tuple[_Path, str]]:
    """Return the first wrong values: where each is, and why it is wrong.

    Pydantic also calls a list too short that has wrong elements, which is left out.
    """
    details = error.errors()
    parents = {detail["loc"][:end] for detail in details for end in range(len(detail["loc"]))}
    wrong = [
        detail
        for detail in details
        if detail["type"] != "too_short" or detail["loc"] not in parents
    ]
    explanations = [_explain(detail, model) for detail in wrong[:_MOST_PROBLEMS]]
    if len(wrong) > _MOST_PROBLEMS:
        explanations.append(((), f"{len(wrong) - _MOST_PROBLEMS} more values are wrong"))
    return explanations


def _explain(error: ErrorDetails, model: type[BaseModel]) -> tuple[_Path, str]:
    """Return where a value is wrong, and in words why, and what to do."""
    where, context = tuple(error["loc"]), error.get("ctx", {})
    value = error["input"]
    shown = repr(value) if isinstance(value, str | int | float | None) else "what stands here"
    match error["type"]:
        case "wrong_value":
            return where + tuple(context["where"]), str(context["reason"])
        case "value_error":
            reason = str(context["error"])
        case "missing":
            reason = "is missing: add it"
        case "too_short":
            reason = "is too short: write one element at least"
        case "extra_forbidden":
            near = difflib.get_close_matches(str(where[-1]), _known_keys(model), n=1, cutoff=0.75)
            reason = "unknown key: " + (f"did you mean {near[0]!r}?" if near else "remove it")
        case kind if kind in _KINDS:
            reason = f"{shown} is not {_KINDS[kind]}: write one"
        case _:
            reason = error["msg"].removeprefix("Input ")
            reason = f"{shown} {reason}: correct it" if reason.startswith("should") else reason
    return where, reason


@cache
def _known_keys(model: type[BaseModel]) -> list[str]:
    """Return all keys that a file of this model may have anywhere."""
    schema = model.model_json_schema(by_alias=True)
    parts = [schema, *schema.get("$defs", {}).values()]
    return sorted({key for part in parts for key in part.get("properties", {})})
