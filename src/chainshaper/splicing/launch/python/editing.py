"""Python launch files: edits at the places that the syntax tree tells, and nowhere else.

A file is parsed, never imported. Calls whose place is known get arguments or list elements
inserted; what cannot be changed so without doubt gives None, and is left to be wrapped.
"""

import ast
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from chainshaper.splicing.launch.actions import Edit, LaunchFile, Rules, Span
from chainshaper.splicing.launch.python.offsets import Offsets
from chainshaper.splicing.launch.python.reading import read_actions
from chainshaper.splicing.shaping_process import RESPAWN, ShapingProcess
from chainshaper.values.errors import InputError

__all__ = [
    "add_at_start",
    "add_remaps",
    "add_set_remaps",
    "keep_folder",
    "process_text",
    "read",
    "replaced",
]

_RESPAWN = ", ".join(f"{name}={value!r}" for name, value in RESPAWN.items())
_OPENING = re.compile(r"\s*\(")
_BINDS_TIGHTLY = (ast.Name, ast.Attribute, ast.Call, ast.Subscript, ast.BinOp)


@dataclass(frozen=True, eq=False)
class _Syntax:
    tree: ast.Module
    offsets: Offsets


def read(path: Path, text: str) -> LaunchFile:
    """A launch file in Python.

    Raises:
        InputError: it is not Python, or has no `generate_launch_description`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about escapes in the file's texts
            tree = ast.parse(text.removeprefix("\ufeff"))
    except SyntaxError as error:
        raise InputError(
            f"{path}:{error.lineno or 1}: not Python: {error.msg}; correct the line"
        ) from error
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{path}: not Python that can be read ({error})") from error
    actions = read_actions(path, text, tree)
    if actions is None:
        raise InputError(
            f"{path}: no function generate_launch_description, which a launch file has: give a"
            " launch file"
        )
    return LaunchFile(path, "python", text, actions, _Syntax(tree, Offsets.of(text)))


def replaced(file: LaunchFile, span: Span, value: str) -> Edit:
    """Another value in the place of an expression, or of the characters between its quotes."""
    quotes = file.text[span.end : span.end + 1] in ("'", '"')
    return Edit(span, repr(value)[1:-1] if quotes else repr(value))


def add_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit] | None:
    """Give a node further remaps, which are tried before its own."""
    call, offsets = cast(ast.Call, place), cast(_Syntax, file.syntax).offsets
    pairs = [repr(rule) for rule in rules]
    own = next((one.value for one in call.keywords if one.arg == "remappings"), None)
    if own is not None:
        return _list_edits(offsets, own, pairs)
    opening = _OPENING.match(file.text, offsets.span(call.func).end)
    if opening is None:
        return None
    first = min((offsets.at(one.lineno, one.col_offset) for one in call.keywords), default=None)
    added = f"remappings=[{', '.join(pairs)}]"
    if first is None:
        return [Edit(Span(opening.end(), opening.end()), added)]
    return [_insertion(offsets, first, [added])]


def add_set_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit] | None:
    """Put remaps for the scope before one that is there, if it stands in a list."""
    call, syntax = cast(ast.Call, place), cast(_Syntax, file.syntax)
    lists = (node for node in ast.walk(syntax.tree) if isinstance(node, ast.List))
    if not any(call in node.elts for node in lists):
        return None
    name = ast.unparse(call.func)
    added = [f"{name}({match!r}, {target!r})" for match, target in rules]
    return [_insertion(syntax.offsets, syntax.offsets.span(call).start, added)]


def add_at_start(
    file: LaunchFile, rules: Rules, processes: Sequence[ShapingProcess]
) -> list[Edit] | None:
    """Let the launch description begin with added nodes, and with remaps for all that follows.

    None where there is not exactly one launch description.
    """
    tree, offsets = cast(_Syntax, file.syntax).tree, cast(_Syntax, file.syntax).offsets
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    made = [call for call in calls if _called(call) == "LaunchDescription"]
    if len(made) != 1 or any(word.arg is None for word in made[0].keywords):
        return None
    needed = {process_class(process) for process in processes} | ({"SetRemap"} if rules else set())
    classes = {name: _class(tree, offsets, name) for name in sorted(needed)}
    added = [process_text(process, classes[process_class(process)][0]) for process in processes]
    added += [f"{classes['SetRemap'][0]}({match!r}, {target!r})" for match, target in rules]
    imports = [edit for _, edits in classes.values() for edit in edits]
    values = [*made[0].args, *(word.value for word in made[0].keywords)]
    if values:
        return [*imports, *_list_edits(offsets, values[0], added)]
    end = offsets.span(made[0]).end - 1
    return [*imports, Edit(Span(end, end), f"[{', '.join(added)}]")]


def _called(call: ast.Call) -> str:
    return ast.unparse(call.func).rpartition(".")[2]


def keep_folder(file: LaunchFile) -> list[Edit] | None:
    """Let a copy refer to the folder of its original."""
    tree, offsets = cast(_Syntax, file.syntax).tree, cast(_Syntax, file.syntax).offsets
    attributed = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    edits: list[Edit] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            place = {"ThisLaunchFileDir": file.path.parent, "ThisLaunchFile": file.path}.get(
                _called(node)
            )
            if place is not None and id(node) in attributed:
                return None
            if place is not None:
                edits.append(Edit(offsets.span(node), repr(str(place))))
    if any(isinstance(node, ast.Name) and node.id == "__file__" for node in ast.walk(tree)):
        start = _behind_prologue(tree, offsets)
        text = f"__file__ = {str(file.path)!r}{_newline(file.text)}"
        edits.append(Edit(Span(start, start), text))
    return edits


def process_class(process: ShapingProcess) -> str:
    """The class of `launch` or `launch_ros` that starts a shaping node."""
    return "ExecuteProcess" if process.command is not None else "Node"


def process_text(process: ShapingProcess, name: str) -> str:
    """The call that starts a shaping node; ``name`` is what its class is called there."""
    if process.command is not None:
        return f"{name}(cmd={process.command_line!r}, output='screen', {_RESPAWN})"
    return (
        f"{name}(package={process.package!r}, executable={process.executable!r},"
        f" name={process.name!r}, namespace={process.namespace!r},"
        f" parameters=[{str(process.parameters_file)!r}],"
        f" remappings={list(process.remappings)!r}, output='screen', {_RESPAWN})"
    )


def _list_edits(offsets: Offsets, value: ast.expr, added: Sequence[str]) -> list[Edit]:
    """Let a list begin with further elements, whatever expression gives it."""
    span = offsets.span(value)
    if isinstance(value, ast.List | ast.Tuple) and value.elts:
        return [_insertion(offsets, offsets.span(value.elts[0]).start, added)]
    if isinstance(value, ast.List):
        return [Edit(Span(span.start + 1, span.start + 1), ", ".join(added))]
    opening, closing = ("*", "]") if isinstance(value, _BINDS_TIGHTLY) else ("*(", ")]")
    before = Edit(Span(span.start, span.start), f"[{', '.join(added)}, {opening}")
    return [before, Edit(Span(span.end, span.end), closing)]


def _insertion(offsets: Offsets, position: int, added: Sequence[str]) -> Edit:
    """Further elements or arguments before one, on lines of their own if it has one."""
    indent = offsets.indent(position)
    between = " " if indent is None else _newline(offsets.text) + indent
    return Edit(Span(position, position), "".join(f"{one},{between}" for one in added))


def _class(tree: ast.Module, offsets: Offsets, name: str) -> tuple[str, list[Edit]]:
    """What a class is called in the file, and the import it needs, if any."""
    module = "launch.actions" if name == "ExecuteProcess" else "launch_ros.actions"
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    for node in imports:
        for alias in node.names:
            if isinstance(node, ast.ImportFrom) and (node.module, alias.name) == (module, name):
                return alias.asname or name, []
    bound = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    bound |= {alias.asname or alias.name for node in imports for alias in node.names}
    called = f"Shaping{name}" if name in bound else name
    line = f"from {module} import {name}" + ("" if called == name else f" as {called}")
    start = _behind_prologue(tree, offsets)
    return called, [Edit(Span(start, start), line + _newline(offsets.text))]


def _behind_prologue(tree: ast.Module, offsets: Offsets) -> int:
    """Where a statement may stand that is to come first: behind docstring and future imports."""
    prologue = 0
    for number, node in enumerate(tree.body):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and number == 0
        if text or (isinstance(node, ast.ImportFrom) and node.module == "__future__"):
            prologue = number + 1
    if prologue < len(tree.body):
        return offsets.at(tree.body[prologue].lineno, 0)
    return offsets.starts[-1]


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"
