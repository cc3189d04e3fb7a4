"""YAML launch files: where everything stands, and edits that leave all the rest as it is.

PyYAML's nodes know at which characters they begin and end; edits replace or insert just these, so
that comments, quotes, block and flow style stay as they were. New keys and items are written in
the style of what surrounds them, before what is there.
"""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import yaml

from chainshaper.splicing.launch.actions import Edit, LaunchFile, Rules, Span
from chainshaper.splicing.launch.elements import Attribute, Element, actions_of, location_edits
from chainshaper.splicing.shaping_process import RESPAWN, ShapingProcess
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import DEEPEST, compose

__all__ = ["add_at_start", "add_remaps", "add_set_remaps", "keep_folder", "read", "replaced"]

_MOST_ELEMENTS = 50_000
_MERGE = "tag:yaml.org,2002:merge"
_RESPAWN = {
    name: str(value).lower() if isinstance(value, bool) else value
    for name, value in RESPAWN.items()
}
"""From Jazzy on, the frontend takes flags as texts only; Humble's takes either."""


@dataclass(frozen=True, eq=False)
class _Place:
    """An item of a list: the attributes it has, and the list."""

    attributes: yaml.MappingNode
    item: yaml.Node
    items: yaml.SequenceNode


def read(path: Path, text: str) -> LaunchFile:
    """A launch file in YAML.

    Raises:
        InputError: it is not YAML, or not a launch file; the line is named.
    """
    return _launch_file(path, text, compose(text, path))


def _launch_file(path: Path, text: str, root: yaml.Node | None) -> LaunchFile:
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    if len(pairs) != 1 or pairs[0][0].value != "launch":
        line = 1 if root is None else root.start_mark.line + 1
        raise InputError(f"{path}:{line}: a launch file in YAML is one key, `launch`, with a list")
    content = pairs[0][1]
    if not isinstance(content, yaml.SequenceNode) or not content.value:
        line = content.start_mark.line + 1
        raise InputError(f"{path}:{line}: `launch` holds no list of actions: write one")
    reading = _Reading(path, text, _aliased(content))
    actions = actions_of(tuple(reading.entities(content)))
    return LaunchFile(path, "yaml", text, actions, content)


def _aliased(root: yaml.Node) -> set[int]:
    """Nodes that stand in several places by an alias, with all that is inside them."""
    seen: set[int] = set()
    found: set[int] = set()

    def visit(node: yaml.Node, inside: bool) -> None:
        inside = inside or id(node) in seen
        if id(node) in found:
            return
        (found if inside else seen).add(id(node))
        for value in node.value if not isinstance(node, yaml.ScalarNode) else ():
            for one in value if isinstance(value, tuple) else (value,):
                visit(one, inside)

    visit(root, False)
    return found


@dataclass(frozen=True)
class _Reading:
    """From PyYAML's nodes to elements; those in ``aliased`` have no place that could be edited."""

    path: Path
    text: str
    aliased: set[int]
    inside: list[int] = field(default_factory=list)
    made: list[int] = field(default_factory=lambda: [0])

    def entities(self, items: yaml.SequenceNode) -> Iterator[Element]:
        """The items of a list of actions: mappings of one key, which says what the item is."""
        for item in items.value:
            pairs = item.value if isinstance(item, yaml.MappingNode) else []
            if len(pairs) != 1 or not isinstance(pairs[0][0], yaml.ScalarNode):
                raise InputError(
                    f"{self.path}:{item.start_mark.line + 1}: an action is one key, such as"
                    " `node`, with its attributes below: correct the item"
                )
            key, value = item.value[0]
            yield self.entity(key.value, value, item, items)

    def entity(
        self, tag: str, value: yaml.Node, item: yaml.Node, items: yaml.SequenceNode
    ) -> Element:
        """One element: its attributes are scalars, its children lists."""
        line = item.start_mark.line + 1
        self.made[0] += 1
        if self.made[0] > _MOST_ELEMENTS or len(self.inside) > DEEPEST:
            raise InputError(
                f"{self.path}:{line}: with its aliases (*name) the file has more than"
                f" {_MOST_ELEMENTS} elements, or {DEEPEST} inside each other: write it without them"
            )
        self.inside.append(line)
        element = self._element(tag, value, item, items)
        self.inside.pop()
        return element

    def _element(
        self, tag: str, value: yaml.Node, item: yaml.Node, items: yaml.SequenceNode
    ) -> Element:
        line = item.start_mark.line + 1
        place = None
        if isinstance(value, yaml.MappingNode) and id(value) not in self.aliased:
            place = _Place(value, item, items)
        if isinstance(value, yaml.SequenceNode):
            return Element(tag, line, {}, tuple(self.entities(value)), place)
        attributes: dict[str, Attribute] = {}
        children: list[Element] = []
        if isinstance(value, yaml.MappingNode):
            value.value = _merged(value, self.path)  # `<<: *defaults`
        for key, content in value.value if isinstance(value, yaml.MappingNode) else []:
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(
                    f"{self.path}:{key.start_mark.line + 1}: an attribute's name is a list or"
                    " mapping: write a text"
                )
            if isinstance(content, yaml.ScalarNode):
                attributes[key.value] = Attribute(content.value, self.span(content))
            elif key.value == "children" and isinstance(content, yaml.SequenceNode):
                children += self.entities(content)
            elif isinstance(content, yaml.SequenceNode):
                children += [self.entity(key.value, one, one, content) for one in content.value]
        return Element(tag, line, attributes, tuple(children), place)

    def span(self, node: yaml.ScalarNode) -> Span | None:
        """Where a scalar's characters stand, without quotes."""
        quotes = node.style in ("'", '"')
        span = Span(node.start_mark.index + quotes, node.end_mark.index - quotes)
        plain = self.text[span.start : span.end] == node.value
        return span if plain and id(node) not in self.aliased else None


def _merged(
    node: yaml.MappingNode, path: Path, depth: int = 0
) -> list[tuple[yaml.Node, yaml.Node]]:
    """A mapping's own keys and values, behind those of the mappings that it merges into it.

    Each key is merged once: PyYAML would repeat it for each of its merges, and theirs.
    """
    own = [(key, value) for key, value in node.value if key.tag != _MERGE]
    sources: list[yaml.Node] = []
    for key, value in node.value:
        if key.tag == _MERGE:
            sources += value.value if isinstance(value, yaml.SequenceNode) else [value]
    merged: dict[str, tuple[yaml.Node, yaml.Node]] = {}
    for source in dict.fromkeys(sources):
        if not isinstance(source, yaml.MappingNode) or depth > DEEPEST:
            line = source.start_mark.line + 1
            raise InputError(f"{path}:{line}: not YAML: no mapping to merge; correct the line")
        source.value = _merged(source, path, depth + 1)
        for key, value in source.value:
            merged.setdefault(str(key.value), (key, value))
    names = {str(key.value) for key, _ in own}
    return [pair for name, pair in merged.items() if name not in names] + own


def replaced(file: LaunchFile, span: Span, value: str) -> Edit:  # noqa: ARG001 - as for Python
    """Another value in the place of a scalar's characters."""
    return Edit(span, value)


def add_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit]:
    """Give a node further remaps, which are tried before its own."""
    node = cast(_Place, place).attributes
    own = next((value for key, value in node.value if key.value == "remap"), None)
    added = [{"from": match, "to": target} for match, target in rules]
    if isinstance(own, yaml.SequenceNode) and own.value:
        return [_items_edit(file.text, own, own.value[0], added)]
    start = node.start_mark.index
    if node.flow_style:
        return [Edit(Span(start + 1, start + 1), f"remap: {_flow(added)}, ")]
    lines = _lines({"remap": added}, node.start_mark.column)
    return [Edit(Span(start, start), _in_newlines_of(file.text, lines))]


def add_set_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit]:
    """Put remaps for the scope before one that is there."""
    found = cast(_Place, place)
    return [_items_edit(file.text, found.items, found.item, _set_remaps(rules))]


def add_at_start(file: LaunchFile, rules: Rules, processes: Sequence[ShapingProcess]) -> list[Edit]:
    """Let the launch file begin with added nodes, and with remaps for all that follows."""
    items = cast(yaml.SequenceNode, file.syntax)
    added = [_process(process) for process in processes] + _set_remaps(rules)
    return [_items_edit(file.text, items, items.value[0], added)]


def keep_folder(file: LaunchFile) -> list[Edit]:
    """Let a copy refer to the folder of its original."""
    scalars = (token for token in yaml.scan(file.text) if isinstance(token, yaml.ScalarToken))
    spans = [Span(token.start_mark.index, token.end_mark.index) for token in scalars]
    return location_edits(file, spans, str)


def _set_remaps(rules: Rules) -> list[dict[str, Any]]:
    return [{"set_remap": {"from": match, "to": target}} for match, target in rules]


def _process(process: ShapingProcess) -> dict[str, Any]:
    if process.command is not None:
        command = shlex.join(process.command_line)
        return {"executable": {"cmd": command, "output": "screen", **_RESPAWN}}
    return {
        "node": {
            "pkg": process.package,
            "exec": process.executable,
            "name": process.name,
            "namespace": process.namespace,
            "output": "screen",
            **_RESPAWN,
            "param": [{"from": str(process.parameters_file)}],
            "remap": [{"from": match, "to": target} for match, target in process.remappings],
        }
    }


def _items_edit(
    text: str, items: yaml.SequenceNode, before: yaml.Node, added: Sequence[dict[str, Any]]
) -> Edit:
    """Insert items into a list before one of its own."""
    if items.flow_style:
        start = before.start_mark.index
        return Edit(Span(start, start), "".join(f"{_flow(item)}, " for item in added))
    column = items.start_mark.column
    start = _dash(text, before.start_mark.index, column)
    return Edit(Span(start, start), _in_newlines_of(text, _lines(list(added), column)))


def _dash(text: str, position: int, column: int) -> int:
    """Where the dash of a block list's item stands; comments may lie between them."""
    while True:
        line = text.rfind("\n", 0, position) + 1
        if position >= line + column and text[line + column : line + column + 1] == "-":
            return line + column
        position = line - 1


def _lines(value: object, column: int) -> str:
    """A value in block style, to stand at a column before what is there."""
    block = yaml.safe_dump(value, sort_keys=False, width=1_000_000, allow_unicode=True)
    return block.replace("\n", "\n" + " " * column)


def _flow(value: object) -> str:
    flow = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1_000_000)
    return flow.strip()


def _in_newlines_of(text: str, added: str) -> str:
    return added.replace("\n", "\r\n") if "\r\n" in text else added
