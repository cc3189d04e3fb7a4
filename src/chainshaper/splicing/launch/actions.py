"""What a launch file says, whichever of the three languages it is written in.

A launch file is read into actions, plain values in the order in which `ros2 launch` would carry
them out: nodes with their remaps, namespaces, groups, includes, launch configurations. Reading
executes nothing and needs no ROS 2. Values that only a launch can tell are templates
(:mod:`chainshaper.splicing.launch.substitutions`). Whatever an edit may have to replace knows its
place in the text, as a span of characters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

__all__ = [
    "Action",
    "Condition",
    "Conditions",
    "Edit",
    "Group",
    "Include",
    "Language",
    "LaunchFile",
    "NodeAction",
    "PushNamespace",
    "RemapRule",
    "Rules",
    "SetConfiguration",
    "SetRemap",
    "Span",
    "Substitution",
    "Template",
    "Unreadable",
    "apply_edits",
    "flattened",
]

Language: TypeAlias = Literal["python", "xml", "yaml"]


@dataclass(frozen=True)
class Substitution:
    """A part of a text that is known at launch only: ``$(var x)`` is ``var`` of ``(("x",),)``.

    Names are those of the XML and YAML frontends; ``unknown`` stands for what is not understood.
    """

    name: str
    arguments: tuple["Template", ...] = ()


Template: TypeAlias = tuple["str | Substitution", ...]
"""A text with substitutions in it; without any, it is one text or nothing."""


class Span(NamedTuple):
    """Characters of a file's text, from ``start`` up to but not including ``end``."""

    start: int
    end: int


class Edit(NamedTuple):
    """Characters of a text that are replaced by others; an insertion where the span is empty."""

    span: Span
    text: str


class Condition(NamedTuple):
    """When an action is carried out: ``if`` or ``unless`` this text, written as in the file."""

    kind: str
    text: str


Conditions: TypeAlias = frozenset[Condition]

Rules: TypeAlias = Sequence[tuple[str, str]]
"""Remap rules to write, each ``(match, target)``."""


@dataclass(frozen=True)
class RemapRule:
    """What a node calls ``match`` is named ``target``; ``span`` is the target's place, if it has
    one that can be replaced.
    """

    match: Template
    target: Template
    span: Span | None


@dataclass(frozen=True)
class NodeAction:
    """A node, or a composable one. ``name`` and ``namespace`` are None where the file gives none.

    ``rules`` stand in the order in which ROS 2 tries them; ``arguments`` of them come from the
    command line and so before those of :class:`SetRemap`. ``place`` is the construct to edit in
    the terms of the file's language, None where it must not be edited.
    """

    label: str
    line: int
    name: Template | None
    namespace: Template | None
    rules: tuple[RemapRule, ...]
    arguments: int
    conditions: Conditions
    place: object


@dataclass(frozen=True)
class SetRemap:
    """A remap rule for every node that follows in the same scope; it precedes their own."""

    line: int
    rule: RemapRule
    place: object


@dataclass(frozen=True)
class PushNamespace:
    """Nodes that follow in the same scope stand below this namespace."""

    namespace: Template


@dataclass(frozen=True)
class SetConfiguration:
    """A launch configuration; one that is only ``declared`` gives way to a value set before.

    ``value`` is None for a declared argument that must be given.
    """

    name: Template
    value: Template | None
    declared: bool


@dataclass(frozen=True)
class Group:
    """Actions in a scope of their own, unless they are not ``scoped``.

    Without ``forwarding`` nothing that was set outside counts inside.
    """

    actions: tuple["Action", ...]
    scoped: bool
    forwarding: bool
    conditions: Conditions


@dataclass(frozen=True)
class Include:
    """Another launch file, with configurations set for it; ``span`` is where its path stands."""

    line: int
    path: Template
    span: Span | None
    configurations: tuple[SetConfiguration, ...]
    conditions: Conditions


@dataclass(frozen=True)
class Unreadable:
    """Something that may start nodes, and that only a launch would tell more about."""

    line: int
    reason: str


Action: TypeAlias = (
    NodeAction | SetRemap | PushNamespace | SetConfiguration | Group | Include | Unreadable
)


@dataclass(frozen=True, eq=False)
class LaunchFile:
    """A launch file: its text and what it says. ``syntax`` is the root in its language's terms."""

    path: Path
    language: Language
    text: str = field(repr=False)
    actions: tuple[Action, ...] = field(repr=False)
    syntax: object = field(repr=False)


def flattened(actions: tuple[Action, ...], seen: set[int] | None = None) -> Iterator[Action]:
    """Every action, those inside groups included; what is in a group that stands twice once."""
    seen = set() if seen is None else seen
    for action in actions:
        yield action
        if isinstance(action, Group) and id(action) not in seen:
            seen.add(id(action))
            yield from flattened(action.actions, seen)


def apply_edits(text: str, edits: list[Edit]) -> str:
    """The text after all edits; insertions at one place stay in the order given.

    Raises:
        ValueError: two edits overlap.
    """
    pieces: list[str] = []
    position = 0
    for edit in sorted(edits, key=lambda one: one.span):
        if edit.span.start < position:
            raise ValueError(f"edits overlap at character {edit.span.start}")
        pieces += [text[position : edit.span.start], edit.text]
        position = edit.span.end
    return "".join([*pieces, text[position:]])
