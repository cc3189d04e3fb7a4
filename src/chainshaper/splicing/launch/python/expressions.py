"""What the expressions of a Python launch file stand for, found without running it.

Variables, lists, texts put together, comprehensions over known values and calls: of the file's own
functions, of the few others that launch files use, and of the classes of `launch` and
`launch_ros`, which make actions (:mod:`chainshaper.splicing.launch.python.calls`). Whatever else
there is becomes an :class:`~chainshaper.splicing.launch.python.values.Unknown`, never a guess.
"""

import ast
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from chainshaper.splicing.launch.actions import (
    Conditions,
    Group,
    NodeAction,
    Span,
    Substitution,
    Unreadable,
)
from chainshaper.splicing.launch.python.calls import Call, constructed
from chainshaper.splicing.launch.python.offsets import Offsets
from chainshaper.splicing.launch.python.operations import (
    BUILTINS,
    combined,
    compared,
    is_known,
    library_value,
    method_value,
)
from chainshaper.splicing.launch.python.values import (
    Bound,
    Function,
    GivenUpError,
    Named,
    Names,
    Text,
    Unknown,
    actions_in,
    template_of,
    weighed,
)

__all__ = ["Reading", "bind", "called", "evaluate", "not_editable", "spend", "unknown"]

_PATIENCE = 100_000
"""Steps to follow before a file is given up: a launch file is not a computation."""

_LONGEST = 1_000
_DEEPEST_CALL = 20
_LIBRARIES = ("launch", "launch_ros", "ament_index_python")


@dataclass
class Reading:
    """How far reading a file has come.

    ``follow`` follows the statements of a function. ``elements`` are the places of what lists and
    tuples were written with, ``made`` all nodes, ``conditions`` those of the branches around.
    ``returned`` are the values of the functions under way; ``unsure`` counts the constructs
    around that forbid edits.
    """

    offsets: Offsets
    follow: Callable[["Reading", Sequence[ast.stmt], Names], object]
    elements: dict[int, tuple[object, tuple[Span, ...]]] = field(default_factory=dict)
    made: list[NodeAction] = field(default_factory=list)
    conditions: Conditions = frozenset()
    returned: list[list[Any]] = field(default_factory=list)
    unsure: int = 0
    steps: int = 0
    anything_imported: bool = False


@contextmanager
def not_editable(reading: Reading) -> Iterator[None]:
    """Inside, nothing that is made has a place to edit."""
    reading.unsure += 1
    yield
    reading.unsure -= 1


def bind(reading: Reading, target: ast.expr, value: Any, names: Names) -> None:
    """Give a value to a variable, or to several, or to an item."""
    if isinstance(target, ast.Name):
        names[target.id] = value
    elif isinstance(target, ast.Tuple | ast.List):
        known = isinstance(value, list | tuple) and len(value) == len(target.elts)
        for number, part in enumerate(target.elts):
            unknown = Unknown(target.lineno, ast.unparse(part))
            bind(reading, part, value[number] if known else unknown, names)
    elif isinstance(target, ast.Subscript):
        holder, key = evaluate(reading, target.value, names), evaluate(reading, target.slice, names)
        if isinstance(holder, dict) and isinstance(key, str | int):
            holder[key] = value


def spend(reading: Reading) -> None:
    """Take one more step. Raises GivenUpError where there were too many."""
    reading.steps += 1
    if reading.steps > _PATIENCE:
        raise GivenUpError


def evaluate(reading: Reading, expression: ast.expr, names: Names) -> Any:
    """What an expression stands for."""
    spend(reading)
    value = _value(reading, expression, names)
    if isinstance(value, str | list | tuple) and len(value) > _LONGEST:
        raise GivenUpError
    if isinstance(value, Text):
        weighed(value)
    return unknown(expression) if value is NotImplemented else value


def unknown(node: ast.expr | ast.stmt) -> Unknown:
    source = " ".join(ast.unparse(node).split())
    return Unknown(node.lineno, source if len(source) < 60 else source[:57] + "...")


def _value(  # noqa: PLR0911, PLR0912 - one case per kind of expression
    reading: Reading, expression: ast.expr, names: Names
) -> Any:
    match expression:
        case ast.Constant():
            return expression.value
        case ast.JoinedStr():
            return _formatted(reading, expression, names)
        case ast.Name():
            guess = Named(expression.id) if reading.anything_imported else NotImplemented
            return names.get(expression.id, guess)
        case ast.Attribute():
            return _attribute(evaluate(reading, expression.value, names), expression.attr)
        case ast.Call():
            return _call(reading, expression, names)
        case ast.List() | ast.Tuple():
            return _sequence(reading, expression, names)
        case ast.Dict():
            return _dictionary(reading, expression, names)
        case ast.ListComp() | ast.GeneratorExp():
            return list(_comprehended(reading, expression, expression.generators, names))
        case ast.BinOp():
            left = evaluate(reading, expression.left, names)
            return combined(expression.op, left, evaluate(reading, expression.right, names))
        case ast.Compare(ops=[op], comparators=[other]):
            sides = evaluate(reading, expression.left, names), evaluate(reading, other, names)
            return compared(op, *sides)
        case ast.UnaryOp(op=ast.Not()):
            operand = evaluate(reading, expression.operand, names)
            return not operand if is_known(operand) else NotImplemented
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as number)):
            return -number
        case ast.IfExp():
            return _chosen(reading, expression, names)
        case ast.Subscript():
            return _item(reading, expression, names)
    return NotImplemented


def _formatted(reading: Reading, expression: ast.JoinedStr, names: Names) -> Any:
    parts: list[Any] = []
    for piece in expression.values:
        if isinstance(piece, ast.FormattedValue):
            plain = piece.format_spec is None and piece.conversion == -1
            parts.append(evaluate(reading, piece.value, names) if plain else NotImplemented)
        else:
            parts.append(evaluate(reading, piece, names))
    known = all(isinstance(part, str | int | float) for part in parts)
    return "".join(map(str, parts)) if known else Text(template_of(parts))


def _attribute(holder: Any, name: str) -> Any:
    if isinstance(holder, Named):
        return Named(f"{holder.name}.{name}")
    if isinstance(holder, str) and name == "parent":
        return str(Path(holder).parent)
    return NotImplemented if isinstance(holder, Unknown) else Bound(holder, name)


def _sequence(reading: Reading, expression: ast.List | ast.Tuple, names: Names) -> Any:
    values: list[Any] = []
    for element in expression.elts:
        if isinstance(element, ast.Starred):
            inner = evaluate(reading, element.value, names)
            values += inner if isinstance(inner, list | tuple) else [unknown(element)]
        else:
            values.append(evaluate(reading, element, names))
    found = values if isinstance(expression, ast.List) else tuple(values)
    if not reading.unsure:  # kept alive, so that its identity stays its own
        spans = tuple(reading.offsets.written(element) for element in expression.elts)
        reading.elements[id(found)] = (found, spans)
    return found


def _dictionary(reading: Reading, expression: ast.Dict, names: Names) -> Any:
    found: dict[Any, Any] = {}
    for key, value in zip(expression.keys, expression.values, strict=True):
        held = evaluate(reading, value, names)
        if key is None:
            found.update(held if isinstance(held, dict) else {})
        elif isinstance(name := evaluate(reading, key, names), str | int):
            found[name] = held
    return found


def _comprehended(
    reading: Reading,
    expression: ast.ListComp | ast.GeneratorExp,
    generators: Sequence[ast.comprehension],
    names: Names,
) -> Iterator[Any]:
    if not generators:
        yield evaluate(reading, expression.elt, names)
        return
    generator, inner = generators[0], names.new_child()
    items = evaluate(reading, generator.iter, names)
    if not isinstance(items, list | tuple | dict):
        with not_editable(reading):
            bind(reading, generator.target, unknown(generator.iter), inner)
            yield from _comprehended(reading, expression, generators[1:], inner)
        return
    for item in items:
        bind(reading, generator.target, item, inner)
        tests = [evaluate(reading, test, inner) for test in generator.ifs]
        if all(test or not is_known(test) for test in tests):
            yield from _comprehended(reading, expression, generators[1:], inner)


def _chosen(reading: Reading, expression: ast.IfExp, names: Names) -> Any:
    test = evaluate(reading, expression.test, names)
    if is_known(test):
        return evaluate(reading, expression.body if test else expression.orelse, names)
    with not_editable(reading):
        both = [evaluate(reading, one, names) for one in (expression.body, expression.orelse)]
    return both if any(actions_in(one, 0) for one in both) else NotImplemented


def _item(reading: Reading, expression: ast.Subscript, names: Names) -> Any:
    holder, key = (
        evaluate(reading, expression.value, names),
        evaluate(reading, expression.slice, names),
    )
    if isinstance(holder, Named):
        kind = {"environ": "env", "launch_configurations": "var"}.get(holder.last)
        return Text((Substitution(kind, (template_of(key),)),)) if kind else NotImplemented
    try:
        return holder[key] if isinstance(holder, list | tuple | dict) else NotImplemented
    except (LookupError, TypeError):
        return NotImplemented


def _call(reading: Reading, expression: ast.Call, names: Names) -> Any:
    function = evaluate(reading, expression.func, names)
    positional: list[Any] = []
    for argument in expression.args:
        if isinstance(argument, ast.Starred):
            inner = evaluate(reading, argument.value, names)
            positional += inner if isinstance(inner, list | tuple) else []
        else:
            positional.append(evaluate(reading, argument, names))
    keywords: dict[str, Any] = {}
    for keyword in expression.keywords:
        value = evaluate(reading, keyword.value, names)
        if keyword.arg is not None:
            keywords[keyword.arg] = value
        elif isinstance(value, dict):
            keywords.update(value)
    if isinstance(function, Function):
        return called(reading, function, positional, keywords)
    if isinstance(function, Bound):
        return method_value(function, positional, expression.lineno)
    if isinstance(function, Named):
        return _library(reading, function, expression, positional, keywords)
    return NotImplemented


def called(
    reading: Reading, function: Function, positional: list[Any], keywords: dict[str, Any]
) -> Any:
    """What a function of the file returns."""
    if len(reading.returned) >= _DEEPEST_CALL:
        raise GivenUpError
    parameters = function.definition.args
    named = [one.arg for one in (*parameters.posonlyargs, *parameters.args)]
    names = function.names.new_child()
    with_default = zip(named[::-1], parameters.defaults[::-1], strict=False)
    for name, default in (
        *with_default,
        *zip([one.arg for one in parameters.kwonlyargs], parameters.kw_defaults, strict=True),
    ):
        if default is not None:
            names[name] = evaluate(reading, default, function.names)
    names.update(zip(named, positional, strict=False))
    if parameters.vararg is not None:
        names[parameters.vararg.arg] = positional[len(named) :]
    names.update(keywords)
    reading.returned.append([])
    reading.follow(reading, function.definition.body, names)
    results = list({id(one): one for one in reading.returned.pop()}.values())
    return results[0] if len(results) == 1 else results


def _library(
    reading: Reading,
    function: Named,
    node: ast.Call,
    positional: list[Any],
    keywords: dict[str, Any],
) -> Any:
    package = function.name.partition(".")[0]
    if function.name.endswith("launch_configurations.get"):
        return Text((Substitution("var", tuple(template_of(one) for one in positional)),))
    starred = reading.anything_imported and package == function.name not in BUILTINS
    if package not in _LIBRARIES and not starred:
        return library_value(function.name, positional)
    if function.last == "OpaqueFunction":
        return _opaque(reading, node, positional, keywords)
    complete = not any(keyword.arg is None for keyword in node.keywords)
    made = constructed(
        Call(
            name=function.last,
            line=node.lineno,
            positional=positional,
            keywords=keywords,
            complete=complete and not node.args,
            conditions=reading.conditions,
            place=None if reading.unsure else node,
            first=_first_argument(reading, node),
            elements=reading.elements,
        )
    )
    nodes = made.actions[:1] if isinstance(made, Group) else (made,)
    reading.made += [one for one in nodes if isinstance(one, NodeAction)]
    return made


def _first_argument(reading: Reading, node: ast.Call) -> Span | None:
    expressions = [*node.args, *(keyword.value for keyword in node.keywords)]
    return None if reading.unsure or not expressions else reading.offsets.span(expressions[0])


def _opaque(
    reading: Reading, node: ast.Call, positional: list[Any], keywords: dict[str, Any]
) -> Any:
    """An OpaqueFunction: its function is followed, but nothing it makes is to be edited."""
    function = keywords.get("function", positional[0] if positional else None)
    if not isinstance(function, Function):
        return Unreadable(node.lineno, unknown(node).source)
    arguments = keywords.get("args", [])
    given = keywords.get("kwargs", {})
    with not_editable(reading):
        result = called(
            reading,
            function,
            [Named("context"), *(arguments if isinstance(arguments, list | tuple) else [])],
            given if isinstance(given, dict) else {},
        )
    return Group(tuple(actions_in(result, node.lineno)), False, True, reading.conditions)
