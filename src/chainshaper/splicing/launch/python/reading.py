"""Reading a Python launch file without running it: which actions its launch description holds.

Statements are followed in order, as far as values are known: variables, lists that are filled,
loops over known values, helper functions, the function of an OpaqueFunction. Where a test is not
known, both branches are followed. A construct that is carried out several times, or nobody knows
how often, has no place in the text that could be edited.
"""

import ast
from collections import ChainMap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

from chainshaper.splicing.launch.actions import Action, Condition, Unreadable, flattened
from chainshaper.splicing.launch.python.expressions import (
    Reading,
    bind,
    called,
    evaluate,
    not_editable,
    spend,
    unknown,
)
from chainshaper.splicing.launch.python.offsets import Offsets
from chainshaper.splicing.launch.python.operations import BUILTINS, combined, is_known
from chainshaper.splicing.launch.python.values import (
    Function,
    GivenUpError,
    Named,
    Names,
    Unknown,
    actions_in,
)

__all__ = ["read_actions"]

_End: TypeAlias = Literal["return", "break", "continue"] | None


def read_actions(path: Path, text: str, tree: ast.Module) -> tuple[Action, ...] | None:
    """What the file's launch description does; None without `generate_launch_description`."""
    reading = Reading(Offsets.of(text), _run)
    names: Names = ChainMap({"__file__": str(path), **{name: Named(name) for name in BUILTINS}})
    try:
        _run(reading, tree.body, names)
        generate = names.get("generate_launch_description")
        if not isinstance(generate, Function):
            return None
        actions = actions_in(called(reading, generate, [], {}), generate.definition.lineno)
    except (GivenUpError, RecursionError):
        return (Unreadable(1, "it computes more than can be followed"),)
    reached = {id(action) for action in flattened(tuple(actions))}
    lost = [
        Unreadable(node.line, f"where the node {node.label} goes that is made here")
        for node in reading.made
        if id(node) not in reached
    ]
    return (*actions, *lost)


def _run(reading: Reading, statements: Sequence[ast.stmt], names: Names) -> _End:
    """Follow statements; how they ended, if before their last one."""
    for statement in statements:
        spend(reading)
        end = _statement(reading, statement, names)
        if end is not None:
            return end
    return None


def _statement(  # noqa: PLR0911, PLR0912 - one case per kind of statement
    reading: Reading, statement: ast.stmt, names: Names
) -> _End:
    match statement:
        case ast.Import() | ast.ImportFrom():
            _import(reading, statement, names)
        case ast.FunctionDef():
            names[statement.name] = Function(statement, names)
        case ast.Assign():
            value = evaluate(reading, statement.value, names)
            for target in statement.targets:
                bind(reading, target, value, names)
        case ast.AnnAssign(value=ast.expr() as expression):
            bind(reading, statement.target, evaluate(reading, expression, names), names)
        case ast.AugAssign():
            _augment(reading, statement, names)
        case ast.Expr():
            evaluate(reading, statement.value, names)
        case ast.Return():
            value = None if statement.value is None else evaluate(reading, statement.value, names)
            reading.returned[-1].append(value)
            return "return"
        case ast.Break():
            return "break"
        case ast.Continue():
            return "continue"
        case ast.If():
            return _if(reading, statement, names)
        case ast.For():
            return _for(reading, statement, names)
        case ast.With():
            return _run(reading, statement.body, names)
        case ast.Try():
            return _try(reading, statement, names)
        case ast.While():
            with not_editable(reading):
                _run(reading, statement.body, names)
        case ast.ClassDef():
            names[statement.name] = Unknown(statement.lineno, f"class {statement.name}")
    return None


def _import(reading: Reading, statement: ast.Import | ast.ImportFrom, names: Names) -> None:
    for alias in statement.names:
        if isinstance(statement, ast.ImportFrom):
            reading.anything_imported |= alias.name == "*"
            names[alias.asname or alias.name] = Named(f"{statement.module}.{alias.name}")
        elif alias.asname:
            names[alias.asname] = Named(alias.name)
        else:
            package = alias.name.partition(".")[0]
            names[package] = Named(package)


def _augment(reading: Reading, statement: ast.AugAssign, names: Names) -> None:
    if not isinstance(statement.target, ast.Name) or not isinstance(statement.op, ast.Add):
        return
    before = names.get(statement.target.id)
    added = evaluate(reading, statement.value, names)
    if isinstance(before, list) and isinstance(added, list | tuple):
        before += added
    else:
        total = combined(ast.Add(), before, added)
        known = total is not NotImplemented
        names[statement.target.id] = total if known else unknown(statement)


def _if(reading: Reading, statement: ast.If, names: Names) -> _End:
    test = evaluate(reading, statement.test, names)
    if is_known(test):
        return _run(reading, statement.body if test else statement.orelse, names)
    outcomes: list[tuple[_End, dict[str, Any]]] = []
    text = ast.unparse(statement.test)
    before = reading.conditions
    for kind, block in (("if", statement.body), ("unless", statement.orelse)):
        reading.conditions = before | {Condition(kind, text)}
        branch = names.new_child()
        outcomes.append((_run(reading, block, branch), dict(branch.maps[0])))
    reading.conditions = before
    for name in {name for _, changed in outcomes for name in changed}:
        values = [changed.get(name, names.get(name)) for _, changed in outcomes]
        same = values[0] is values[1]
        names[name] = values[0] if same else Unknown(statement.lineno, name)
    ends = {end for end, _ in outcomes}
    return ends.pop() if len(ends) == 1 else None


def _for(reading: Reading, statement: ast.For, names: Names) -> _End:
    items = evaluate(reading, statement.iter, names)
    if not isinstance(items, list | tuple | dict):
        with not_editable(reading):
            bind(reading, statement.target, Unknown(statement.lineno, "a loop's value"), names)
            _run(reading, statement.body, names)
        return None
    for item in list(items):
        bind(reading, statement.target, item, names)
        end = _run(reading, statement.body, names)
        if end == "return":
            return end
        if end == "break":
            return None
    return _run(reading, statement.orelse, names)


def _try(reading: Reading, statement: ast.Try, names: Names) -> _End:
    end = _run(reading, statement.body, names)
    with not_editable(reading):
        for handler in statement.handlers:
            _run(reading, handler.body, names.new_child())
    return end or _run(reading, [*statement.orelse, *statement.finalbody], names)
