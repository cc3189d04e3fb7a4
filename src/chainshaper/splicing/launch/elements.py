"""The grammar that XML and YAML launch files share: from elements to actions.

Both frontends of ROS 2 read entities with attributes and children; only the notation differs
(`launch/frontend/parser.py`, `launch_ros/actions/` upstream). Elements that are not known here
start no nodes themselves, but those inside them do: a timer's children, for instance.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from chainshaper.splicing.launch.actions import (
    Action,
    Condition,
    Conditions,
    Edit,
    Group,
    Include,
    LaunchFile,
    NodeAction,
    PushNamespace,
    RemapRule,
    SetConfiguration,
    SetRemap,
    Span,
    Template,
    Unreadable,
)
from chainshaper.splicing.launch.substitutions import parse_template

__all__ = ["Attribute", "Element", "actions_of", "command_line_rules", "location_edits"]

_NODES = ("node", "lifecycle_node", "node_container", "composable_node")
_NOT_ACTIONS = ("param", "remap", "env", "arg", "extra_arg", "keep", "choice")
_LOCATION = re.compile(r"\$\((dirname|filename)\)")
_REMAP_IN_ARGUMENTS = re.compile(r"(?:^|\s)(?:-r|--remap)\s+(\S+?):=(\S+)")


@dataclass(frozen=True)
class Attribute:
    """An attribute's value, and where the file writes it, without quotes.

    ``span`` is None where the characters cannot be replaced: they serve other places too (a YAML
    alias), or are not those of the value (escapes, several lines).
    """

    value: str
    span: Span | None


@dataclass(frozen=True, eq=False)
class Element:
    """``<tag attribute="…">children</tag>``, or the same in YAML.

    ``place`` is what the notation's edits need, None where the element must not be edited.
    """

    tag: str
    line: int
    attributes: Mapping[str, Attribute]
    children: tuple["Element", ...]
    place: object

    def template(self, name: str) -> Template | None:
        """The value of an attribute, None where it is absent."""
        attribute = self.attributes.get(name)
        return None if attribute is None else parse_template(attribute.value)


def actions_of(elements: tuple[Element, ...]) -> tuple[Action, ...]:
    """What a sequence of elements does."""
    return tuple(action for element in elements for action in _actions(element))


def _actions(element: Element) -> Iterator[Action]:
    tag, conditions = element.tag, _conditions(element)
    children = tuple(child for child in element.children if child.tag not in _NOT_ACTIONS)
    if tag in _NODES:
        yield _node(element)
        yield from actions_of(children)
    elif tag in ("push_ros_namespace", "push-ros-namespace"):
        yield PushNamespace(element.template("namespace") or ())
    elif tag == "set_remap":
        yield SetRemap(element.line, _rule(element), element.place)
    elif tag in ("let", "arg"):
        yield _configuration(element, "default" if tag == "arg" else "value", tag == "arg")
    elif tag == "include":
        yield _include(element)
    elif tag == "group":
        keeps = [child for child in element.children if child.tag == "keep"]
        yield Group(
            (
                *(_configuration(keep, "value", False) for keep in keeps),
                *actions_of(children),
            ),
            scoped=_flag(element, "scoped"),
            forwarding=_flag(element, "forwarding"),
            conditions=conditions,
        )
    elif children:
        yield Group(actions_of(children), scoped=False, forwarding=True, conditions=conditions)


def _node(element: Element) -> NodeAction:
    values = {name: attribute.value for name, attribute in element.attributes.items()}
    own = tuple(_rule(child) for child in element.children if child.tag == "remap")
    from_arguments = tuple(
        rule
        for name in ("args", "ros_args")
        if name in element.attributes
        for rule in command_line_rules(element.attributes[name])
    )
    return NodeAction(
        label=f"{values.get('pkg', '')}/{values.get('exec', values.get('plugin', ''))}".strip("/"),
        line=element.line,
        name=element.template("name"),
        namespace=element.template("namespace"),
        rules=from_arguments + own,
        arguments=len(from_arguments),
        conditions=_conditions(element),
        place=element.place,
    )


def command_line_rules(attribute: Attribute) -> list[RemapRule]:
    """The remap rules among command-line arguments: ``-r from:=to``."""
    begin = None if attribute.span is None else attribute.span.start
    return [
        RemapRule(
            parse_template(match[1]),
            parse_template(match[2]),
            None if begin is None else Span(begin + match.start(2), begin + match.end(2)),
        )
        for match in _REMAP_IN_ARGUMENTS.finditer(attribute.value)
    ]


def _rule(element: Element) -> RemapRule:
    target = element.attributes.get("to")
    span = None if target is None else target.span
    return RemapRule(element.template("from") or (), element.template("to") or (), span)


def _include(element: Element) -> Action:
    path = element.attributes.get("file")
    if path is None:
        return Unreadable(element.line, "an include without a file")
    return Include(
        line=element.line,
        path=parse_template(path.value),
        span=path.span,
        configurations=tuple(
            _configuration(child, "value", False)
            for child in element.children
            if child.tag in ("arg", "let")
        ),
        conditions=_conditions(element),
    )


def _configuration(element: Element, value: str, declared: bool) -> SetConfiguration:
    return SetConfiguration(element.template("name") or (), element.template(value), declared)


def _flag(element: Element, name: str) -> bool:
    attribute = element.attributes.get(name)
    return attribute is None or attribute.value.strip().lower() not in ("false", "0", "no", "off")


def _conditions(element: Element) -> Conditions:
    given = element.attributes
    return frozenset(
        Condition(kind, given[kind].value) for kind in ("if", "unless") if kind in given
    )


def location_edits(
    file: LaunchFile, spans: Iterable[Span], written: Callable[[str], str]
) -> list[Edit]:
    """What ``$(dirname)`` and ``$(filename)`` stand for, written out, because a copy moves."""
    places = {"dirname": str(file.path.parent), "filename": str(file.path)}
    return [
        Edit(Span(*match.span()), written(places[match[1]]))
        for span in spans
        for match in _LOCATION.finditer(file.text, *span)
    ]
