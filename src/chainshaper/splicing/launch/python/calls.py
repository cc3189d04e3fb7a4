"""What the calls in a Python launch file make: the constructors of `launch` and `launch_ros`.

Each takes the values of a call's arguments and gives an action, or the value of a substitution.
Classes that are not known here start no nodes themselves, but actions inside their arguments are
carried out: those of an event handler, for instance.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from chainshaper.splicing.launch.actions import (
    Condition,
    Conditions,
    Group,
    Include,
    NodeAction,
    PushNamespace,
    RemapRule,
    SetConfiguration,
    SetRemap,
    Span,
    Substitution,
    Template,
    Unreadable,
)
from chainshaper.splicing.launch.python.values import (
    Source,
    Text,
    actions_in,
    joined_path,
    leaves,
    template_of,
)
from chainshaper.splicing.launch.substitutions import UNKNOWN

__all__ = ["Call", "constructed"]

_NODES = ("Node", "LifecycleNode", "ComposableNode", "ComposableNodeContainer")
_SUBSTITUTIONS = {
    "LaunchConfiguration": "var",
    "EnvironmentVariable": "env",
    "FindPackageShare": "find-pkg-share",
    "FindPackagePrefix": "find-pkg-prefix",
    "FindPackage": "find-pkg-prefix",
    "ThisLaunchFileDir": "dirname",
    "ThisLaunchFile": "filename",
    "TextSubstitution": "text",
    "PathJoinSubstitution": "join",
    "get_package_share_directory": "find-pkg-share",
    "get_package_share_path": "find-pkg-share",
    "get_package_prefix": "find-pkg-prefix",
}
_NOT_STARTED = ("target", "matcher", "package", "executable", "name", "condition")


@dataclass(frozen=True)
class Call:
    """A call whose arguments are known: positional, by keyword, and whether that is all of them.

    ``place`` is None where the call must not be edited, ``first`` the place of its first argument.
    ``elements`` gives the places of what a list or tuple was written with.
    """

    name: str
    line: int
    positional: Sequence[Any]
    keywords: Mapping[str, Any]
    complete: bool
    conditions: Conditions
    place: object
    first: Span | None
    elements: Mapping[int, tuple[object, tuple[Span, ...]]]

    def argument(self, position: int, *names: str) -> Any:
        """An argument by its keywords or its position; None where it is not given."""
        given = next((self.keywords[name] for name in names if name in self.keywords), None)
        if given is None and 0 <= position < len(self.positional):
            given = self.positional[position]
        return given

    def when(self) -> Conditions:
        """The conditions under which the action is carried out."""
        condition = self.keywords.get("condition")
        if condition is None:
            return self.conditions
        if not isinstance(condition, Condition):
            condition = Condition("if", _written(condition))
        return self.conditions | {condition}


def constructed(call: Call) -> Any:  # noqa: PLR0911 - one case per kind of action
    """What a call of a class of `launch` or `launch_ros` makes."""
    if call.name in _NODES:
        return _node(call)
    if call.name in _SUBSTITUTIONS:
        return _substitution(call)
    if call.name.endswith("LaunchDescriptionSource"):
        return Source(template_of(call.argument(0, "launch_file_path", "location")), call.first)
    match call.name:
        case "LaunchDescription":
            return actions_in(call.argument(0, "initial_entities"), call.line)
        case "IfCondition" | "UnlessCondition":
            text = _written(call.argument(0, "predicate_expression"))
            return Condition(call.name.removesuffix("Condition").lower(), text)
        case "PushRosNamespace" | "PushROSNamespace":
            return PushNamespace(template_of(call.argument(0, "namespace")))
        case "SetRemap":
            target = call.argument(1, "dst")
            rule = RemapRule(template_of(call.argument(0, "src")), template_of(target), None)
            return SetRemap(call.line, rule, call.place)
        case "DeclareLaunchArgument" | "SetLaunchConfiguration":
            return _configuration(call)
        case "GroupAction":
            return _group(call)
        case "IncludeLaunchDescription":
            return _include(call)
    if call.name.endswith(("Substitution", "Expression", "Command", "Equals", "Executable")):
        return Text(UNKNOWN)
    return _other(call)


def _node(call: Call) -> Any:
    rules = [
        RemapRule(template_of(pair[0]), template_of(pair[1]), _spans(call, pair, 2)[1])
        for pair in _pairs(call.keywords.get("remappings"))
    ]
    from_arguments = [
        rule
        for name in ("arguments", "ros_arguments")
        for rule in _command_line_rules(call, call.keywords.get(name))
    ]
    label = [call.keywords.get("package"), call.argument(-1, "executable", "plugin")]
    node = NodeAction(
        label="/".join(part for part in label if isinstance(part, str)),
        line=call.line,
        name=_optional(call.argument(-1, "name", "node_name")),
        namespace=_optional(call.argument(-1, "namespace", "node_namespace")),
        rules=(*from_arguments, *rules),
        arguments=len(from_arguments),
        conditions=call.when(),
        place=call.place if call.complete else None,
    )
    composed = call.argument(-1, "composable_node_descriptions")
    if call.name != "ComposableNodeContainer":
        return node
    return Group((node, *actions_in(composed, call.line)), False, True, call.when())


def _written(value: Any) -> str:
    """The text that distinguishes a condition from others."""
    for _ in leaves(value):
        pass  # a value that holds itself many times is given up
    return repr(value)


def _optional(value: Any) -> Template | None:
    return None if value is None else template_of(value)


def _items(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else ()


def _pairs(value: Any) -> list[Sequence[Any]]:
    return [pair for pair in _items(value) if isinstance(pair, list | tuple) and len(pair) == 2]


def _spans(call: Call, sequence: Any, length: int) -> Sequence[Span | None]:
    """Where the elements of a list or tuple are written, if they are written out in one place."""
    _, spans = call.elements.get(id(sequence), (None, ()))
    return spans if len(spans) == length else (None,) * length


def _command_line_rules(call: Call, arguments: Any) -> list[RemapRule]:
    """``['-r', 'out:=/t5']``; a target's place is the end of the word, if it is written out."""
    words = [word if isinstance(word, str) else "" for word in _items(arguments)]
    spans = _spans(call, arguments, len(words))
    rules: list[RemapRule] = []
    for option, word, span in zip(words, words[1:], spans[1:], strict=False):
        match, separator, target = word.partition(":=")
        if option in ("-r", "--remap") and separator:
            literal = span is not None and span.end - span.start == len(word)
            place = Span(span.end - len(target), span.end) if span and literal else None
            rules.append(RemapRule((match,), (target,), place))
    return rules


def _substitution(call: Call) -> Any:
    name = _SUBSTITUTIONS[call.name]
    first = call.argument(
        0, "variable_name", "name", "package", "package_name", "substitutions", "text"
    )
    if name == "text":
        return first
    if name == "join":
        return joined_path(list(_items(first)))
    if name in ("dirname", "filename"):
        return Text((Substitution(name),))
    default = call.argument(1, "default", "default_value")
    arguments = [template_of(value) for value in (first, default) if value is not None]
    return Text((Substitution(name, tuple(arguments)),))


def _configuration(call: Call) -> SetConfiguration:
    declared = call.name == "DeclareLaunchArgument"
    value = _optional(call.argument(1, "default_value" if declared else "value"))
    return SetConfiguration(template_of(call.argument(0, "name")), value, declared)


def _group(call: Call) -> Group:
    kept = call.keywords.get("launch_configurations")
    settings = _settings(kept.items() if isinstance(kept, dict) else ())
    return Group(
        (*settings, *actions_in(call.argument(0, "actions"), call.line)),
        scoped=call.keywords.get("scoped", True) is not False,
        forwarding=call.keywords.get("forwarding", True) is not False,
        conditions=call.when(),
    )


def _include(call: Call) -> Include:
    source = call.argument(0, "launch_description_source")
    if not isinstance(source, Source):
        source = Source(template_of(source), call.first)
    settings = _settings(_pairs(call.keywords.get("launch_arguments")))
    return Include(call.line, source.path, source.span, settings, call.when())


def _settings(pairs: Iterable[Sequence[Any]]) -> tuple[SetConfiguration, ...]:
    return tuple(
        SetConfiguration(template_of(name), template_of(value), declared=False)
        for name, value in pairs
    )


def _other(call: Call) -> Group:
    """Actions in the arguments of something else; an argument of unknown actions is said."""
    inside = [
        action
        for name, value in [*(("", value) for value in call.positional), *call.keywords.items()]
        if not name.startswith(_NOT_STARTED)
        for action in actions_in(value, call.line)
        if not isinstance(action, Unreadable) or name in ("actions", "composable_node_descriptions")
    ]
    return Group(tuple(inside), scoped=False, forwarding=True, conditions=call.when())
