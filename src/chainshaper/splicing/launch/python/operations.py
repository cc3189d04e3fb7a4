"""Operators, built-in functions and methods in a Python launch file, on values that are known.

Only what launch files use to put names and paths together, and nothing that could grow beyond
bounds: this is reading, and a file's author must not be able to keep the reader busy. Whatever
else there is gives NotImplemented.
"""

import ast
import operator
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from chainshaper.splicing.launch.actions import Substitution
from chainshaper.splicing.launch.python.values import (
    Bound,
    Text,
    actions_in,
    joined_path,
    leaves,
    template_of,
)

__all__ = ["BUILTINS", "combined", "compared", "is_known", "library_value", "method_value"]

_LONGEST_LOOP = 1_000
_LONGEST_VALUE = 10_000
_FIELD_WITH_FORMAT = re.compile(r"%[^sd%]|\{[^{}]*[:.\[!]")  # such as a width of a million
_TEXT_METHODS = ("format", "join", "replace", "strip", "lstrip", "rstrip", "lower", "upper")
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda one, many: one in many,
    ast.NotIn: lambda one, many: one not in many,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}


def is_known(value: Any) -> bool:
    """Whether it is known if a value is true."""
    return value is None or isinstance(value, bool | int | float | str | list | tuple | dict)


def _plain(value: Any) -> bool:
    """Whether a value is wholly known, and short enough to be compared and printed."""
    length = 0
    for leaf in leaves(value):
        if leaf is not None and not isinstance(leaf, bool | int | float | str):
            return False
        length += len(leaf) if isinstance(leaf, str) else 1
    return length < _LONGEST_VALUE


def _is_text(value: Any) -> bool:
    return isinstance(value, str | Text)


def combined(op: ast.operator, left: Any, right: Any) -> Any:  # noqa: PLR0911 - one per operator
    """``left + right``, ``folder / name``, ``pattern % values``."""
    texts = _is_text(left) and _is_text(right)
    if isinstance(op, ast.Div) and texts:
        known = isinstance(left, str) and isinstance(right, str)
        return str(Path(left) / right) if known else joined_path([left, right])
    if isinstance(op, ast.Mod) and isinstance(left, str) and _plain(right):
        return _tried(operator.mod, left, right) if _simple(left) else NotImplemented
    if isinstance(op, ast.Sub) and type(left) is type(right) is int:
        return left - right
    if not isinstance(op, ast.Add):
        return NotImplemented
    if type(left) is type(right) and isinstance(left, str | int | float | list | tuple):
        return left + right
    if texts:
        return Text((*template_of(left), *template_of(right)))
    if isinstance(left, list) or isinstance(right, list):  # one part of it is known
        return [left, right]
    return NotImplemented


def compared(op: ast.cmpop, left: Any, right: Any) -> Any:
    """``left == right`` and its like, on values that are wholly known."""
    wholly = type(op) in _COMPARISONS and _plain(left) and _plain(right)
    return _tried(_COMPARISONS[type(op)], left, right) if wholly else NotImplemented


def _tried(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (TypeError, ValueError, LookupError):
        return NotImplemented


def _simple(pattern: str) -> bool:
    return not _FIELD_WITH_FORMAT.search(pattern)


def library_value(name: str, arguments: Sequence[Any]) -> Any:
    """The value of a call of the standard library."""
    one = arguments[0] if len(arguments) == 1 else None
    if name in ("os.path.join", "pathlib.Path", "pathlib.PurePath"):
        known = bool(arguments) and all(isinstance(part, str) for part in arguments)
        return str(Path(*arguments)) if known else joined_path(list(arguments))
    if name in ("os.environ.get", "os.getenv"):
        return Text((Substitution("env", tuple(template_of(part) for part in arguments)),))
    if name in ("os.path.abspath", "os.path.realpath", "os.path.normpath", "str") and _is_text(one):
        return one
    if name == "os.path.dirname" and isinstance(one, str):
        return os.path.dirname(one)  # noqa: PTH120 - the very function that the file calls
    printable = name != "str" or _plain(arguments)
    if name in BUILTINS and printable and all(is_known(argument) for argument in arguments):
        return _tried(BUILTINS[name], *arguments)
    return NotImplemented


def _range(*bounds: int) -> list[int]:
    numbers = range(*bounds)
    if len(numbers) > _LONGEST_LOOP:
        raise ValueError
    return list(numbers)


BUILTINS: dict[str, Callable[..., Any]] = {
    "str": str,
    "int": int,
    "len": len,
    "list": list,
    "tuple": tuple,
    "dict": dict,
    "range": _range,
    "enumerate": lambda values, start=0: list(enumerate(values, start)),
    "zip": lambda *values: list(zip(*values, strict=False)),
}


def method_value(  # noqa: PLR0911 - one per method
    method: Bound, arguments: Sequence[Any], line: int
) -> Any:
    """The value of a method's call; a description or list that it adds to is changed."""
    holder, name = method.value, method.attribute
    first = arguments[0] if arguments else None
    if isinstance(holder, list) and name in ("add_action", "add_entity"):  # a launch description
        holder.extend(actions_in(first, line))
        return None
    if isinstance(holder, list) and name in ("append", "extend", "insert"):
        many = first if isinstance(first, list | tuple) else [first]
        holder.extend(many if name == "extend" else arguments[-1:])
        return None
    if isinstance(holder, dict) and name in ("items", "keys", "values"):
        return list(getattr(holder, name)())
    if isinstance(holder, dict) and name == "get" and isinstance(first, str):
        return holder.get(*arguments[:2])
    if isinstance(holder, Text) and name == "perform":
        return holder
    if _is_text(holder) and name == "joinpath":
        return joined_path([holder, *arguments])
    if _is_text(holder) and name in ("resolve", "absolute", "as_posix", "expanduser"):
        return holder
    wholly = isinstance(holder, str) and all(_plain(argument) for argument in arguments)
    if wholly and name in _TEXT_METHODS and (name != "format" or _simple(holder)):
        return _tried(getattr(holder, name), *arguments)
    return NotImplemented
