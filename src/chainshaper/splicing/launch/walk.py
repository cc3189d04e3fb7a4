"""Following launch files as `ros2 launch` would, without launching: which node ends up where.

Actions are carried out in order on a context of launch configurations, a namespace and remaps
(`launch_ros/actions/` upstream); a scoped group gets a copy of it, an include shares it with the
file it includes. Conditions are not evaluated: both sides are followed, and nodes remember under
which conditions they run. The same file, included twice, is followed twice.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

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
from chainshaper.values.errors import InputError

__all__ = ["Instance", "PlacedNode", "Walk", "follow"]

_MOST_ACTIONS = 100_000
_MOST_NODES = 5_000
_MOST_FILES = 2_000
_DEEPEST = 150
_MOST_COPIES = 5_000_000
"""What the largest robots need ten times over."""


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

    @property
    def full_name(self) -> str:
        """As people write it, where both parts are known."""
        return f"{(self.namespace or '').rstrip('/')}/{self.name}"


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
class _Patience:
    """How much a launch has done so far, and the files that it has read."""

    files: dict[Path, LaunchFile] = field(default_factory=dict)
    real_paths: dict[Path, Path] = field(default_factory=dict)
    actions: int = 0
    copies: int = 0
    depth: int = 0

    def real(self, path: Path) -> Path:
        """A path without symbolic links."""
        if path not in self.real_paths:
            self.real_paths[path] = path.resolve()
        return self.real_paths[path]


@dataclass
class _Context:
    """What holds where the walk has come to, in the launch file that is instance ``number``."""

    walk: Walk
    number: int
    patience: _Patience
    configurations: dict[str, str | None] = field(default_factory=dict)
    namespace: str | None = ""
    rules: list[PlacedRule] = field(default_factory=list)
    conditions: Conditions = frozenset()
    sheltered: bool = False

    @property
    def instance(self) -> Instance:
        return self.walk.instances[self.number]

    def copy(self) -> "_Context":
        return replace(self, configurations={**self.configurations}, rules=[*self.rules])

    def text(self, template: Template) -> str | None:
        return resolve(template, Surroundings(self.configurations, self.instance.file.path))

    def rule(self, rule: RemapRule) -> PlacedRule:
        return PlacedRule(self.text(rule.match), self.text(rule.target), rule)


def follow(files: Sequence[LaunchFile], arguments: dict[str, str]) -> Walk:
    """Follow launch files, each as if it were launched with these arguments.

    Raises:
        InputError: an included file is not a launch file, or includes itself.
    """
    walk, patience = Walk(), _Patience()
    for file in files:
        walk.instances.append(Instance(file, None, None))
        context = _Context(walk, len(walk.instances) - 1, patience, {**arguments})
        _carry_out(file.actions, context, set())
    return walk


def _carry_out(actions: Iterable[Action], context: _Context, done: set[int]) -> None:
    for action in actions:
        context.patience.actions += 1
        _refuse_more(context, context.patience.actions, _MOST_ACTIONS, "actions")
        match action:
            case NodeAction() if id(action) not in done:
                done.add(id(action))  # an event handler's target is the node again
                _copied(context, len(context.rules))
                context.walk.nodes.append(_placed(action, context))
                _refuse_more(context, len(context.walk.nodes), _MOST_NODES, "nodes")
            case SetRemap():
                scope = (context.number, action)
                context.rules.append(replace(context.rule(action.rule), scope=scope))
            case PushNamespace():
                context.namespace = _below(context.namespace, context.text(action.namespace))
            case SetConfiguration():
                _configure(action, context)
            case Group():
                _carry_out_group(action, context, done)
            case Include():
                _include(action, context)
            case Unreadable():
                context.walk.unreadable.append((context.number, action))


def _carry_out_group(group: Group, context: _Context, done: set[int]) -> None:
    inner = context
    if group.scoped and group.forwarding:
        _copied(context, len(context.configurations) + len(context.rules))
        inner = context.copy()
    elif group.scoped:
        inner = _Context(context.walk, context.number, context.patience, sheltered=True)
    before = context.conditions
    inner.conditions = before | group.conditions
    with _deeper(context):
        _carry_out(group.actions, inner, done)
    inner.conditions = before


def _include(include: Include, context: _Context) -> None:
    for setting in include.configurations:
        _configure(setting, context)
    walk, number, before = context.walk, context.number, context.conditions
    text = context.text(include.path)
    path = None if text is None else Path(text)
    if path is None or not path.is_file() or not is_launch_file(path):
        walk.not_followed.append((number, include))
        return
    real = context.patience.real
    if real(path) in {real(one.file.path) for one in _including(walk, number)}:
        raise InputError(
            f"{context.instance.file.path}:{include.line}: includes {path}, which includes it in"
            " turn: there is no end to that"
        )
    files = context.patience.files
    if path not in files:
        files[path] = read_launch_file(path)
    walk.instances.append(Instance(files[path], number, include))
    context.number, context.conditions = len(walk.instances) - 1, before | include.conditions
    _refuse_more(context, len(walk.instances), _MOST_FILES, "included files")
    with _deeper(context):
        _carry_out(context.instance.file.actions, context, set())
    context.number, context.conditions = number, before


def _including(walk: Walk, number: int | None) -> Iterator[Instance]:
    while number is not None:
        yield walk.instances[number]
        number = walk.instances[number].parent


@contextmanager
def _deeper(context: _Context) -> Iterator[None]:
    context.patience.depth += 1
    what = "groups and includes inside each other"
    _refuse_more(context, context.patience.depth, _DEEPEST, what)
    yield
    context.patience.depth -= 1


def _copied(context: _Context, count: int) -> None:
    """Note how many rules and configurations a node or a group hears."""
    context.patience.copies += count
    what = "rules and configurations, counted for each group and node that hears them"
    _refuse_more(context, context.patience.copies, _MOST_COPIES, what)


def _refuse_more(context: _Context, found: int, most: int, what: str) -> None:
    if found > most:
        first = context.walk.instances[0].file.path
        raise InputError(
            f"{context.instance.file.path}: {first} has more than {most} {what}, the most that is"
            " followed: give a part of it"
        )


def _configure(setting: SetConfiguration, context: _Context) -> None:
    name = context.text(setting.name)
    if name is None:
        return
    if setting.declared and setting.value is None:
        context.instance.required.append(name)
    if not setting.declared or name not in context.configurations:
        value = setting.value
        context.configurations[name] = None if value is None else context.text(value)


def _placed(action: NodeAction, context: _Context) -> PlacedNode:
    own = [context.rule(rule) for rule in action.rules]
    namespace = context.namespace
    if action.namespace is not None:
        namespace = _below(namespace, context.text(action.namespace))
    from_arguments = [replace(rule, from_arguments=True) for rule in own[: action.arguments]]
    # ROS 2 tries rules of the command line first, then those of the scope, then the node's own.
    return PlacedNode(
        action=action,
        instance=context.number,
        name=None if action.name is None else context.text(action.name),
        namespace=namespace,
        rules=(*from_arguments, *context.rules, *own[action.arguments :]),
        conditions=context.conditions | action.conditions,
        sheltered=context.sheltered,
    )


def _below(namespace: str | None, name: str | None) -> str | None:
    """A namespace below another; None is unknown, empty is none at all."""
    if name is None or (namespace is None and not name.startswith("/")):
        return None
    if not name.strip("/"):
        return "/" if name else namespace
    return joined(namespace or "/", name).rstrip("/")
