"""Following launch files as `ros2 launch` would, without launching: which node ends up where.

Actions are carried out in order on a context of launch configurations, a namespace and remaps
(`launch_ros/actions/` upstream); a scoped group gets a copy of it, an include shares it with the
file it includes. Conditions are not evaluated: both sides are followed, and nodes remember under
which conditions they run. The same file, included twice, is followed twice.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.errors import InputError
from chainshaper.splicing.launch.actions import (
    Action,
    Conditions,
    Group,
    Include,
    LaunchFile,
    NodeAction,
    PushNamespace,
    RemapRule,
    SetConfiguration,
    SetRemap,
    Template,
    Unreadable,
)
from chainshaper.splicing.launch.file import is_launch_file, read_launch_file
from chainshaper.splicing.launch.remaps import PlacedRule, joined
from chainshaper.splicing.launch.substitutions import Surroundings, resolve

__all__ = ["Instance", "PlacedNode", "Walk", "follow"]


@dataclass(frozen=True, eq=False)
class Instance:
    """A launch file where it is included: ``parent`` is the number of the including instance.

    ``required`` are arguments that it declares without a default.
    """

    file: LaunchFile
    parent: int | None
    include: Include | None
    required: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PlacedNode:
    """A node and where it will be.

    ``name`` is None where the file gives none, or one that only a launch would tell;
    ``namespace`` is None where unknown and empty where nothing sets one, so that the executable
    decides. ``sheltered`` nodes hear nothing from outside a group that forwards nothing.
    """

    action: NodeAction
    instance: int
    name: str | None
    namespace: str | None
    rules: tuple[PlacedRule, ...]
    conditions: Conditions
    sheltered: bool


@dataclass
class Walk:
    """What following launch files found: instances of files, nodes, and what stayed unknown.

    ``not_followed`` are includes whose file could not be found, ``unreadable`` actions that
    may start nodes which nobody knows; both with the number of the instance that holds them.
    """

    instances: list[Instance] = field(default_factory=list)
    nodes: list[PlacedNode] = field(default_factory=list)
    not_followed: list[tuple[int, Include]] = field(default_factory=list)
    unreadable: list[tuple[int, Unreadable]] = field(default_factory=list)


@dataclass
class _Context:
    configurations: dict[str, str | None] = field(default_factory=dict)
    namespace: str | None = ""
    rules: list[PlacedRule] = field(default_factory=list)
    conditions: Conditions = frozenset()
    sheltered: bool = False

    def copy(self) -> "_Context":
        return _Context(
            dict(self.configurations),
            self.namespace,
            list(self.rules),
            self.conditions,
            self.sheltered,
        )


def follow(files: Sequence[LaunchFile], arguments: dict[str, str]) -> Walk:
    """Follow launch files, each as if it were launched with these arguments.

    Raises:
        InputError: an included file is not a launch file, or includes itself.
    """
    walk = Walk()
    for file in files:
        walk.instances.append(Instance(file, None, None))
        _follow_file(walk, len(walk.instances) - 1, _Context({**arguments}))
    return walk


def _follow_file(walk: Walk, number: int, context: _Context) -> None:
    _carry_out(walk, number, walk.instances[number].file.actions, context, set())


def _carry_out(
    walk: Walk, number: int, actions: Iterable[Action], context: _Context, done: set[int]
) -> None:
    for action in actions:
        match action:
            case NodeAction() if id(action) not in done:
                done.add(id(action))  # an event handler's target is the node again
                walk.nodes.append(_placed(walk, number, action, context))
            case SetRemap():
                placed = _rule(walk, number, action.rule, context, scope=(number, action))
                context.rules.append(placed)
            case PushNamespace():
                pushed = _text(walk, number, action.namespace, context)
                context.namespace = _below(context.namespace, pushed)
            case SetConfiguration():
                _configure(walk, number, action, context)
            case Group():
                _carry_out_group(walk, number, action, context, done)
            case Include():
                _include(walk, number, action, context)
            case Unreadable():
                walk.unreadable.append((number, action))


def _carry_out_group(
    walk: Walk, number: int, group: Group, context: _Context, done: set[int]
) -> None:
    inner = context
    if group.scoped:
        inner = context.copy() if group.forwarding else _Context(sheltered=True)
    before = context.conditions
    inner.conditions = before | group.conditions
    _carry_out(walk, number, group.actions, inner, done)
    inner.conditions = before


def _include(walk: Walk, number: int, include: Include, context: _Context) -> None:
    for setting in include.configurations:
        _configure(walk, number, setting, context)
    text = _text(walk, number, include.path, context)
    path = None if text is None else Path(text)
    if path is None or not path.is_file() or not is_launch_file(path):
        walk.not_followed.append((number, include))
        return
    if path.resolve() in _including(walk, number):
        raise InputError(
            f"{walk.instances[number].file.path}:{include.line}: includes {path}, which includes it"
            " in turn: there is no end to that"
        )
    walk.instances.append(Instance(read_launch_file(path), number, include))
    before = context.conditions
    context.conditions = before | include.conditions
    _follow_file(walk, len(walk.instances) - 1, context)
    context.conditions = before


def _including(walk: Walk, number: int | None) -> set[Path]:
    found: set[Path] = set()
    while number is not None:
        found.add(walk.instances[number].file.path.resolve())
        number = walk.instances[number].parent
    return found


def _configure(walk: Walk, number: int, setting: SetConfiguration, context: _Context) -> None:
    name = _text(walk, number, setting.name, context)
    if name is None:
        return
    if setting.declared and setting.value is None:
        walk.instances[number].required.append(name)
    if not setting.declared or name not in context.configurations:
        value = setting.value
        known = None if value is None else _text(walk, number, value, context)
        context.configurations[name] = known


def _placed(walk: Walk, number: int, action: NodeAction, context: _Context) -> PlacedNode:
    own = [_rule(walk, number, rule, context) for rule in action.rules]
    namespace = context.namespace
    if action.namespace is not None:
        namespace = _below(namespace, _text(walk, number, action.namespace, context))
    from_arguments = [
        PlacedRule(rule.match, rule.target, rule.rule, from_arguments=True)
        for rule in own[: action.arguments]
    ]
    # ROS 2 tries rules of the command line first, then those of the scope, then the node's own.
    return PlacedNode(
        action=action,
        instance=number,
        name=None if action.name is None else _text(walk, number, action.name, context),
        namespace=namespace,
        rules=(*from_arguments, *context.rules, *own[action.arguments :]),
        conditions=context.conditions | action.conditions,
        sheltered=context.sheltered,
    )


def _rule(
    walk: Walk,
    number: int,
    rule: RemapRule,
    context: _Context,
    scope: tuple[int, SetRemap] | None = None,
) -> PlacedRule:
    match = _text(walk, number, rule.match, context)
    target = _text(walk, number, rule.target, context)
    return PlacedRule(match, target, rule, scope)


def _text(walk: Walk, number: int, template: Template, context: _Context) -> str | None:
    where = Surroundings(context.configurations, walk.instances[number].file.path)
    return resolve(template, where)


def _below(namespace: str | None, name: str | None) -> str | None:
    """A namespace below another; None is unknown, empty is none at all."""
    if name is None or (namespace is None and not name.startswith("/")):
        return None
    if not name.strip("/"):
        return "/" if name else namespace
    return joined(namespace or "/", name).rstrip("/")
