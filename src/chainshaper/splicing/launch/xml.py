"""XML launch files: where everything stands, and edits that leave all the rest as it is.

The text is parsed by expat, which tells where each tag begins; attributes are then found in the
tag's own text. A file is never written anew from a tree: comments, quotes, order and indentation
stay, because an edit replaces or inserts just the characters it has to.
"""

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast
from xml.parsers import expat
from xml.sax.saxutils import escape

from chainshaper.splicing.launch.actions import Edit, LaunchFile, Rules, Span
from chainshaper.splicing.launch.elements import Attribute, Element, actions_of, location_edits
from chainshaper.splicing.shaping_process import RESPAWN, ShapingProcess
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import DEEPEST

__all__ = ["add_at_start", "add_remaps", "add_set_remaps", "keep_folder", "read", "replaced"]

_LONGEST_ENTITY = 200
_ATTRIBUTE = re.compile(r"""([^\s=/>"']+)\s*=\s*("[^"]*"|'[^']*')""")
_RESPAWN = " ".join(f'{name}="{str(value).lower()}"' for name, value in RESPAWN.items())
_START_TAG = re.compile(r"""<([^\s/>]+)(?:[^"'>]|"[^"]*"|'[^']*')*>""")


@dataclass(frozen=True, eq=False)
class _Tag:
    """A start tag, and the elements inside."""

    name: str
    span: Span
    line: int
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)


def read(path: Path, text: str) -> LaunchFile:
    """A launch file in XML.

    Raises:
        InputError: it is not well-formed, or not a launch file; the line is named.
    """
    root = _parse(path, text)
    if root.tag != "launch":
        raise InputError(
            f"{path}:{root.line}: the root element is <{root.tag}>, a launch file's is <launch>"
        )
    actions = actions_of(root.children)
    return LaunchFile(path, "xml", text, actions, root.place)


def _parse(path: Path, text: str) -> Element:
    data = text.encode()
    parser = expat.ParserCreate("UTF-8")  # the text is decoded already, whatever it declares
    outermost = _Tag("", Span(0, 0), 1, {})
    open_tags = [outermost]
    bytes_read = characters_read = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal bytes_read, characters_read
        if len(open_tags) > DEEPEST:
            raise InputError(
                f"{path}:{parser.CurrentLineNumber}: <{tag}>: more than {DEEPEST} elements inside"
                " each other: no launch file needs that many"
            )
        characters_read += len(data[bytes_read : parser.CurrentByteIndex].decode())
        bytes_read = parser.CurrentByteIndex
        begin = characters_read
        found = _START_TAG.match(text, begin)
        if found is None or found[1] != tag:
            raise InputError(
                f"{path}:{parser.CurrentLineNumber}: <{tag}> comes out of an XML entity: write"
                " the element itself"
            )
        open_tags.append(_Tag(tag, Span(*found.span()), parser.CurrentLineNumber, attributes))

    def end(tag: str) -> None:  # noqa: ARG001 - expat gives it
        closed = open_tags.pop()
        open_tags[-1].children.append(_element(closed, text))

    def entity(name: str, parameter: bool, value: str | None, *_: object) -> None:
        if parameter or value is None or len(value) > _LONGEST_ENTITY or "&" in value:
            raise InputError(
                f"{path}:{parser.CurrentLineNumber}: the XML entity {name} is not a text of up to"
                f" {_LONGEST_ENTITY} characters without another entity: write the text itself"
            )

    parser.EntityDeclHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise InputError(
            f"{path}:{error.lineno}: not well-formed XML: {reason}; correct the line"
        ) from error
    return outermost.children[0]


def _element(tag: _Tag, text: str) -> Element:
    begin = tag.span.start + len(tag.name) + 1
    attributes = {
        match[1]: Attribute(tag.attributes[match[1]], Span(match.start(2) + 1, match.end(2) - 1))
        for match in _ATTRIBUTE.finditer(text, begin, tag.span.end)
    }
    return Element(tag.name, tag.line, attributes, tuple(tag.children), tag)


def replaced(file: LaunchFile, span: Span, value: str) -> Edit:  # noqa: ARG001 - as for Python
    """Another value between an attribute's quotes."""
    return Edit(span, _written(value))


def _written(value: str) -> str:
    return escape(value, {'"': "&quot;", "'": "&apos;"})


def add_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit]:
    """Give a node further remaps, which are tried before its own."""
    return [_child_edit(file, cast(_Tag, place), [_rule("remap", rule) for rule in rules])]


def add_set_remaps(file: LaunchFile, place: object, rules: Rules) -> list[Edit]:
    """Put remaps for the scope before one that is there."""
    start = cast(_Tag, place).span.start
    behind = _newline(file.text) + _indent(file.text, start)
    text = "".join(_rule("set_remap", rule) + behind for rule in rules)
    return [Edit(Span(start, start), text)]


def add_at_start(file: LaunchFile, rules: Rules, processes: Sequence[ShapingProcess]) -> list[Edit]:
    """Let the launch file begin with added nodes, and with remaps for all that follows."""
    added = [_process(process) for process in processes]
    added += [_rule("set_remap", rule) for rule in rules]
    return [_child_edit(file, cast(_Tag, file.syntax), added)]


def keep_folder(file: LaunchFile) -> list[Edit]:
    """Let a copy refer to the folder of its original."""
    spans = [
        attribute.span
        for element in _descendants(cast(_Tag, file.syntax))
        for attribute in element.attributes.values()
        if attribute.span is not None
    ]
    return location_edits(file, spans, _written)


def _descendants(tag: _Tag) -> Iterator[Element]:
    for child in tag.children:
        yield child
        yield from _descendants(cast(_Tag, child.place))


def _rule(tag: str, rule: tuple[str, str]) -> str:
    return f'<{tag} from="{_written(rule[0])}" to="{_written(rule[1])}"/>'


def _process(process: ShapingProcess) -> str:
    if process.command is not None:
        command = _written(shlex.join(process.command_line))
        return f'<executable cmd="{command}" output="screen" {_RESPAWN}/>'
    inside = [f'<param from="{_written(str(process.parameters_file))}"/>']
    inside += [_rule("remap", rule) for rule in process.remappings]
    return "\n".join(
        [
            f'<node pkg="{process.package}" exec="{process.executable}" name="{process.name}"'
            f' namespace="{process.namespace}" output="screen" {_RESPAWN}>',
            *(f"  {line}" for line in inside),
            "</node>",
        ]
    )


def _child_edit(file: LaunchFile, tag: _Tag, children: Sequence[str]) -> Edit:
    """Insert elements as the first ones inside another."""
    text, (start, end) = file.text, tag.span
    indent, newline = _indent(text, start), _newline(text)
    step = _step(text, tag) or _step(text, cast(_Tag, file.syntax)) or "  "
    lines = [f"{indent}{step}{line}" for child in children for line in child.split("\n")]
    inside = "".join(newline + line for line in lines)
    if not text.startswith("/>", end - 2):
        same_line = "\n" not in text[end : text.find("<", end)]
        return Edit(Span(end, end), inside + (newline + indent) * same_line)
    slash = len(text[: end - 2].rstrip())
    return Edit(Span(slash, end), f">{inside}{newline}{indent}</{tag.name}>")


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


def _indent(text: str, position: int) -> str:
    """The white space that a line begins with, up to a position at most."""
    line = text[text.rfind("\n", 0, position) + 1 : position]
    return line[: len(line) - len(line.lstrip())]


def _step(text: str, tag: _Tag) -> str:
    """By how much the children of an element are indented more than itself."""
    indent = _indent(text, tag.span.start)
    for child in tag.children:
        inner = _indent(text, cast(_Tag, child.place).span.start)
        if inner.startswith(indent):
            return inner[len(indent) :]
    return ""
