"""What expressions in a Python launch file stand for, as far as reading it can tell.

Texts, numbers, lists, tuples and dictionaries stand for themselves, and so do the actions and
conditions of :mod:`chainshaper.splicing.launch.actions`. Paths are texts, a launch description is
the list of its actions. The rest is here; above all :class:`Unknown`, which whatever is not
understood turns into.
"""

import ast
from collections import ChainMap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

from chainshaper.splicing.launch.actions import Action, Span, Substitution, Template, Unreadable
from chainshaper.splicing.launch.substitutions import UNKNOWN

__all__ = [
    "Bound",
    "Function",
    "GivenUpError",
    "Named",
    "Source",
    "Text",
    "Unknown",
    "actions_in",
    "joined_path",
    "leaves",
    "template_of",
    "weighed",
]

Names: TypeAlias = "ChainMap[str, Any]"


_MOST_LEAVES = 10_000


class GivenUpError(Exception):
    """The file computes more than a launch file does."""


@dataclass(frozen=True)
class Unknown:
    """A value that only running the file would tell."""

    line: int
    source: str


@dataclass(frozen=True)
class Text:
    """A text that is known at launch: a substitution, or several."""

    template: Template


@dataclass(frozen=True)
class Named:
    """Something imported, or built in, by its full name: ``launch_ros.actions.Node``."""

    name: str

    @property
    def last(self) -> str:
        return self.name.rpartition(".")[2]


@dataclass(frozen=True, eq=False)
class Function:
    """A function of the file, with the names that it sees."""

    definition: ast.FunctionDef
    names: Names


@dataclass(frozen=True)
class Bound:
    """An attribute of a value, which is about to be called."""

    value: Any
    attribute: str


@dataclass(frozen=True)
class Source:
    """Where an include takes its launch description from."""

    path: Template
    span: Span | None


def leaves(value: Any) -> Iterator[Any]:
    """What lists, tuples and dictionaries hold, at any depth.

    Raises:
        GivenUpError: too much; a list that holds another twice, and so on, soon has no end.
    """
    pending, visited = [value], 0
    while pending:
        one = pending.pop()
        visited += 1
        if visited > _MOST_LEAVES:
            raise GivenUpError
        if isinstance(one, list | tuple):
            pending.extend(reversed(one))
        elif isinstance(one, dict):
            pending.extend(reversed(one.values()))
        else:
            yield one


def weighed(value: Any) -> None:
    """Raises GivenUpError where a text for launch has too many parts to be looked at."""
    parts: list[Any] = list(value.template)
    for visited, one in enumerate(parts):
        if visited > _MOST_LEAVES:
            raise GivenUpError
        if isinstance(one, Substitution):
            parts.extend(part for argument in one.arguments for part in argument)


def template_of(value: Any) -> Template:
    """A value where launch wants a text: lists are concatenated."""
    if isinstance(value, Text):
        return value.template
    if isinstance(value, bool | int | float | str):
        return (str(value),)
    if isinstance(value, list | tuple):
        return tuple(part for leaf in leaves(value) for part in template_of(leaf))
    return UNKNOWN


def joined_path(parts: list[Any]) -> Text:
    """``os.path.join``, as a text that is known at launch."""
    return Text((Substitution("join", tuple(template_of(part) for part in parts)),))


def actions_in(value: Any, line: int) -> list[Action]:
    """The actions that a value holds where launch wants some."""
    if isinstance(value, Unknown):
        return [Unreadable(value.line, value.source)]
    if isinstance(value, Action):
        return [value]
    if isinstance(value, list | tuple):
        return [action for leaf in leaves(value) for action in actions_in(leaf, line)]
    return []
