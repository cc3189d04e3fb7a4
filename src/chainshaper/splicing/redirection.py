"""Redirects topics of nodes while `ros2 launch` starts them, in the Python of ROS 2.

This file is written beside the launch file that loads it: it needs the standard library, `launch`
and `launch_ros` only. Two of their functions know a node's name and remap rules in full (Humble to
Rolling): `Executable.prepare` makes the command line of a process, and
`get_composable_node_load_request` the request to a container. After both, this module adds rules
for the nodes to be redirected, each bound to the node's name (``ndt:/pose:=…``). Where the shaping
node is a component, a request to load it follows the one for the publisher.

ROS 2 follows the first rule that matches a name, and does not match the result again (upstream:
`rcl_remap_first_match`). So a rule that leads to the topic is preceded by ours for the same name,
and a last one is for a node that uses the topic's own name.
"""

import itertools
import json
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

WITHIN = "chainshaper_within"  # launch argument: seconds from the start until all nodes run
WITHIN_S = 30.0
DISCOVERY_S = 5.0  # for so long before that, at least, it listens for publishers and subscribers
# By then the user's launch files have set the environment. Later a node that joins the graph would
# be in the way: with Fast DDS it may hold up every publication of the robot for a third of a
# second, as whoever opens a shared memory port looks at its health (`SharedMemGlobal.hpp` there).
LISTEN_S = 1.0
MOST_LOOKS = 10  # looks for publishers, a second apart, while discovery has not named all nodes
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # of an endpoint that was discovered before its node was (rmw)

_DRY_RUN = "chainshaper_dry_run"
# A remap rule: the node it is for, what it matches, and the new name.
_REMAP_RULE = re.compile(r"(?:(\w+):(?!//|=))?(?:rostopic://)?([^:]+):=(.+)", re.DOTALL)
_NOT_LOADED = (
    "no launch file has a container load {}, and its shaping node is a component (what `ros2 "
    "component load` loads cannot be redirected: load it in a launch file; if it is a process, "
    "splice with --node python)"
)
_FOR_A_SHELL = re.compile(r"[\[;&|<>()$`*?~#\n]")
_LITERAL = re.compile(r"""'[^']*'|("(?:\\.|[^"\\])*"|\\.)""", re.DOTALL)
"""Text in single quotes; or (group 1) text in double quotes, or a character behind a backslash."""


@dataclass
class Started:
    """A process or component that is, or may be, a node to be redirected.

    * ``node``: that node, by its full name.
    * ``label``: what messages call it.
    * ``named``: whether the launch names the node; else the rules apply if the executable does so.
    * ``rules``: the remap rules that were added.
    * ``action``: of launch, for a process; it knows when that has ended.
    """

    node: str
    label: str
    named: bool
    rules: Sequence[str]
    action: Any = None


@dataclass
class Redirect:
    """A topic in whose place some nodes get another one, and what the launch has shown of them.

    * ``kind``: of the nodes' endpoints, ``publisher`` or ``subscription``.
    * ``topic``, ``target``: the topic, and the one in its place.
    * ``nodes``: the nodes to be redirected, by their full names.
    * ``added``: the nodes that splicing added, which have the topic instead.
    * ``component``: the node that was added, if a container is to load it.
    * ``started``: processes and components that are, or may be, nodes to be redirected.
    * ``others``: whatever was started, but for nodes that splicing added; for messages.
    * ``elsewhere``: nodes that have another topic by a remap rule of the user's.
    * ``loaded``: whether a container was asked to load the component.
    """

    kind: str
    topic: str
    target: str
    nodes: Sequence[str]
    added: Sequence[str]
    component: dict[str, Any] | None = None
    started: list[Started] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    elsewhere: list[str] = field(default_factory=list)
    loaded: bool = False

    def values(self) -> dict[str, Any]:
        """Return the arguments of the same redirect in the launch file, or in a dry run."""
        keys = ("kind", "topic", "target", "nodes", "added", "component")
        values = {key: getattr(self, key) for key in keys}
        return {key: value for key, value in values.items() if value is not None}

    def see(
        self, rules: Sequence[str], label: str, action: Any = None, given: Sequence[str] = ("", "")
    ) -> list[tuple[int, str]]:
        """Note a process or component; return the rules to add, each with the place to put it.

        The name and namespace of its node are those of its ``rules``, or else ``given``, or else
        the executable decides. A node with a name only is in no namespace.
        """
        name = _of_rule(rules, "__node", "__name") or given[0] or None
        namespace = _of_rule(rules, "__ns") or given[1] or None
        added: list[tuple[int, str]] = []
        label = f"{(namespace or '').rstrip('/')}/{name}" if name else f"an unnamed one ({label})"
        if label not in self.added:
            self.others.append(label)
        for node in self.nodes:
            parent, _, base = node.rpartition("/")
            unknown = namespace is None and name is None
            started_in = parent if unknown else namespace or ""
            if name not in (None, base) or started_in.strip("/") != parent.strip("/"):
                continue
            for_node = redirecting(rules, node, self.topic, self.target)
            if for_node is None:
                if name:
                    self.elsewhere.append(node)
                continue
            texts = [rule for _, rule in for_node]
            self.started.append(Started(node, label, name is not None, texts, action))
            added += for_node
        return sorted(added, key=lambda placed: placed[0])

    def mistake(self, on_topic: Sequence[str], on_target: Sequence[str]) -> str | None:
        """Return what is wrong with the nodes on the topic and on the target; None: nothing.

        A node that launch runs under its name need not have the target yet, but may run only once.
        """
        running = [
            started.node
            for started in self.started
            if started.named and getattr(started.action, "return_code", None) is None
        ]
        if twice := [node for node in self.nodes if running.count(node) > 1]:
            return f"more was redirected than meant: {_names(twice)} was started more than once"
        lacking = [node for node in self.nodes if node not in {*on_target, *running}]
        elsewhere = [node for node in lacking if node in self.elsewhere]
        if elsewhere:
            return f"nothing was redirected: {_names(elsewhere)} has another topic in place of it"
        if lacking:
            problem = "no node {} runs" if self.component is None else _NOT_LOADED
            problem = problem.format(_names(lacking))
            return f"nothing was redirected: {problem}; started were {_names(self.others)}"
        if self.kind == "subscription":
            past, does = [node for node in on_topic if node in self.nodes], "subscribes to"
        else:
            past, does = [node for node in on_topic if node not in self.added], "publishes"
            if surplus := [node for node in on_target if node not in self.nodes]:
                too = f"{_names(surplus)} publishes {self.target} too"
                return f"more was redirected than meant: {too}"
        if self.loaded and not on_topic:
            return f"the container did not load {_names(self.added)}, which was to publish it"
        return f"{_names(past)} {does} it past {_names(self.added)}" if past else None

    def message(self, problem: str, on_topic: Sequence[str], on_target: Sequence[str]) -> str:
        """Return the text of a problem, with all endpoints that were found and the remedy."""
        return (
            f"{self.topic}: {problem}. {self.kind.capitalize()}s found: of {self.topic} "
            f"{_names(on_topic)}; of {self.target} {_names(on_target)}. Correct the plan or the "
            f"launch files and splice again; where the node starts later, launch with {WITHIN}:=60"
        )


def redirecting(
    rules: Sequence[str], node: str, topic: str, target: str
) -> list[tuple[int, str]] | None:
    """Return the rules that give a node a target in place of a topic, each with its place.

    The rule goes before the node's own rule in that place. None: the node's own rules give it
    another topic.
    """
    base = node.rpartition("/")[2]
    added: list[tuple[int, str]] = []
    leads: dict[str, str] = {}
    for place, rule in enumerate(rules):
        parts = _REMAP_RULE.fullmatch(rule)
        if parts is None or parts[1] not in (None, base) or parts[2].startswith("__"):
            continue
        match = expanded(parts[2], node)
        if match not in leads:
            leads[match] = expanded(parts[3], node)
            if leads[match] == topic:
                added.append((place, f"{base}:{parts[2]}:={target}"))
    if topic not in leads:
        added.append((len(rules), f"{base}:{topic}:={target}"))
    return added if added or target in leads.values() else None


def expanded(name: str, node: str) -> str:
    """Return the full name of an absolute, relative or private (``~/…``) name in a node."""
    namespace, _, base = node.rpartition("/")
    name = name.removeprefix("rostopic://").replace("{node}", base)
    name = name.replace("{ns}", namespace).replace("{namespace}", namespace)
    if name == "~" or name.startswith("~/"):
        return node + name[1:]
    return name if name.startswith("/") else f"{namespace}/{name}"


def redirect_command(
    words: list[str], redirects: Sequence[Redirect], label: str = "", action: Any = None
) -> None:
    """Add rules to a command line in place, if it starts a node of ROS 2.

    Of commands for a shell, only a plain one is understood, with variables set before it.
    """
    shell, parts = getattr(action, "shell", False), words
    if shell:
        text = " ".join(words)
        try:
            understood = not _FOR_A_SHELL.search(_LITERAL.sub(r"\1", text))
            parts = shlex.split(text) if understood else []
        except ValueError:
            parts = []
    runs = (
        word.endswith("ros2") and following == "run"
        for word, following in itertools.pairwise(parts)
    )
    if "--ros-args" not in parts and not any(runs):
        return
    changed = False
    for redirect in redirects:
        if redirect.component is not None:  # for containers only
            redirect.others.append(label)
            continue
        places = list(_places(parts))
        added = redirect.see([parts[place + 1] for place in places], label, action)
        changed = changed or bool(added)
        for number, rule in reversed(added):
            if number < len(places):
                parts[places[number] : places[number]] = ["-r", rule]
            else:
                parts += ["--ros-args", "-r", rule]
    if shell and changed:
        words[:] = [" ".join(map(_quoted, parts))]


def _quoted(word: str) -> str:
    """Return a word for a shell; in quotes, the name of a variable would be a command."""
    variable = re.match(r"\w+=", word)
    name = variable[0] if variable else ""
    return name + shlex.quote(word.removeprefix(name))


def redirect_request(request: Any, redirects: Sequence[Redirect]) -> list[Redirect]:
    """Add rules to a request to load a component; return the redirects that added some.

    The request is a `composition_interfaces/srv/LoadNode`.
    """
    applied, given = list[Redirect](), (request.node_name, request.node_namespace)
    for redirect in redirects:
        rules = list(request.remap_rules)
        added = redirect.see(rules, request.plugin_name, given=given)
        for number, rule in reversed(added):
            rules.insert(number, rule)
        request.remap_rules = rules
        if added:
            applied.append(redirect)
    return applied


def component_request(component: dict[str, Any], publisher: Any, context: Any) -> Any:
    """Return the request to load the shaping node into the container of a publisher.

    It has intra-process communication if the publisher was loaded with it.
    """
    from pathlib import Path

    from launch_ros.utilities import to_parameters_list

    request = type(publisher)()
    request.package_name, request.plugin_name = component["package"], component["plugin"]
    request.node_name, request.node_namespace = component["name"], "/"
    request.remap_rules = [f"{match}:={target}" for match, target in component["remappings"]]
    file = Path(component["parameters"])
    parameters = to_parameters_list(context, component["name"], "/", [file])
    request.parameters = [parameter.to_parameter_msg() for parameter in parameters]
    request.extra_arguments = [
        argument
        for argument in publisher.extra_arguments
        if argument.name == "use_intra_process_comms"
    ]
    return request


def _places(words: Sequence[str]) -> Iterator[int]:
    """Yield the places of each ``-r`` or ``--remap`` among the words of a command line."""
    for_ros = rule = False
    for place, word in enumerate(words[:-1]):
        for_ros = word == "--ros-args" or (for_ros and word != "--")
        rule = for_ros and not rule and word in ("-r", "--remap")
        if rule:
            yield place


def _of_rule(rules: Sequence[str], *kinds: str) -> str | None:
    """Return the name or namespace that rules give to every node of a process."""
    matches = (_REMAP_RULE.fullmatch(rule) for rule in rules)
    targets = (match[3] for match in matches if match and not match[1] and match[2] in kinds)
    return next(targets, None)


def _names(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(names)) or "none"


def launch_description(
    files: Sequence[str],
    processes: Sequence[dict[str, Any]],
    redirects: Sequence[Redirect],
    environment: Mapping[str, str],
) -> Any:
    """Return what the launch file beside this module launches: added nodes, and the user's files.

    ``processes`` are keyword arguments of `Node` or `ExecuteProcess`. A library of the
    ``environment`` is loaded before those that are loaded anyway. Arguments that the user's files
    require are declared here too, because launch asks for them to be handed on.
    """
    from launch import LaunchContext, LaunchDescription, LaunchDescriptionSource, actions
    from launch.launch_description_sources import AnyLaunchDescriptionSource
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    within = actions.DeclareLaunchArgument(
        WITHIN,
        default_value=str(WITHIN_S),
        description="after how many seconds a topic that was not redirected ends the launch",
    )
    every: list[Any] = [within, actions.OpaqueFunction(function=_begin, args=[redirects])]
    for name, value in environment.items():
        words = [value]
        if name == "LD_PRELOAD":  # the first library is asked first
            words = [value, os.environ.get(name, "")]
        elif name == "ASAN_OPTIONS":  # the last word counts
            words = [os.environ.get(name, ""), value]
        every.append(actions.SetEnvironmentVariable(name, ":".join(filter(None, words))))
    for process in processes:
        if "package" in process:
            every.append(Node(**process))
        else:
            every.append(actions.ExecuteProcess(**process))
    for file in files:
        description = AnyLaunchDescriptionSource(file).get_launch_description(LaunchContext())
        declared = description.get_launch_arguments_with_include_launch_description_actions()
        handed_on = []
        for argument, includes in declared:
            required = argument.default_value is None and not argument._conditionally_included
            if includes is None and required:
                name, description_of = argument.name, argument.description
                every.append(actions.DeclareLaunchArgument(name, description=description_of))
                handed_on.append((name, LaunchConfiguration(name)))
        source = LaunchDescriptionSource(description, file, "spliced launch file")
        every.append(actions.IncludeLaunchDescription(source, launch_arguments=handed_on))
    return LaunchDescription(every)


def _begin(context: Any, redirects: Sequence[Redirect]) -> list[Any] | None:
    """Redirect from now on, and check the redirections once the application runs."""
    from launch.actions import OpaqueFunction, TimerAction
    from launch_ros.ros_adapters import get_ros_node

    def listen(context: Any) -> None:
        get_ros_node(context)  # a node that takes part in ROS 2 for a while knows its graph

    redirect_from_now_on(redirects)
    if hasattr(context.locals, _DRY_RUN):
        return None
    within_s = float(context.launch_configurations.get(WITHIN, WITHIN_S))
    begin = OpaqueFunction(function=listen)
    check = OpaqueFunction(function=_check, args=[redirects])
    return [
        TimerAction(period=min(LISTEN_S, max(0.0, within_s - DISCOVERY_S)), actions=[begin]),
        TimerAction(period=within_s, actions=[check]),
    ]


def redirect_from_now_on(redirects: Sequence[Redirect]) -> None:
    """Redirect everything that this process launches."""
    from launch.descriptions import Executable
    from launch_ros.actions import load_composable_nodes as loading

    prepare, requested = Executable.prepare, loading.get_composable_node_load_request
    load = loading.LoadComposableNodes._load_node
    redirected: list[tuple[Any, list[Redirect]]] = []

    def prepare_redirected(executable: Any, context: Any, action: Any) -> None:
        prepare(executable, context, action)
        # The action takes this very list.
        redirect_command(executable.final_cmd, redirects, executable.final_name, action)

    def request_redirected(description: Any, context: Any) -> Any:
        request = requested(description, context)
        if request is not None:  # None: its condition does not hold
            redirected.append((request, redirect_request(request, redirects)))
        return request

    def load_with_shaping_node(action: Any, request: Any, context: Any) -> None:
        of_request = [
            redirect
            for seen, redirects_of in redirected
            if seen is request
            for redirect in redirects_of
        ]
        before = [_times_loaded(context, redirect) for redirect in of_request]
        load(action, request, context)
        for redirect, times in zip(of_request, before, strict=True):
            # A component that the launch does not name may be another node.
            if redirect.component is not None and _times_loaded(context, redirect) > times:
                load(action, component_request(redirect.component, request, context), context)
                redirect.loaded = True

    Executable.prepare = prepare_redirected
    loading.get_composable_node_load_request = request_redirected
    loading.LoadComposableNodes._load_node = load_with_shaping_node


def _times_loaded(context: Any, redirect: Redirect) -> int:
    """Return how often launch has seen containers load the publishers of a redirect."""
    from launch_ros.utilities import get_node_name_count

    return sum(get_node_name_count(context, node) for node in redirect.nodes)


def nodes_of(endpoints: Sequence[Any]) -> tuple[list[str], bool]:
    """Return the full names of the nodes that publishers or subscriptions belong to.

    The second value says whether there are some whose node discovery has not found yet.
    """
    with_node = [info for info in endpoints if info.node_name != UNKNOWN_NODE]
    names = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in with_node]
    return names, len(with_node) < len(endpoints)


def _check(context: Any, redirects: Sequence[Redirect], looks: int = MOST_LOOKS) -> Any:
    """Compare what was redirected with the graph of ROS 2; a RuntimeError ends the launch.

    Where discovery has not named all nodes yet, it looks again a second later, ``looks`` times in
    all.
    """
    import launch.logging
    from launch.actions import OpaqueFunction, TimerAction
    from launch_ros.ros_adapters import get_ros_node

    logger, asked = launch.logging.get_logger("chainshaper"), get_ros_node(context)
    seen = []
    for redirect in redirects:
        ask = getattr(asked, f"get_{redirect.kind}s_info_by_topic")
        seen.append([nodes_of(ask(topic)) for topic in (redirect.topic, redirect.target)])
    if looks > 1 and any(unknown for both in seen for _, unknown in both):
        again = OpaqueFunction(function=_check, args=[redirects, looks - 1])
        return [TimerAction(period=1.0, actions=[again])]
    messages = []
    for redirect, ((on_topic, _), (on_target, _)) in zip(redirects, seen, strict=True):
        if mistake := redirect.mistake(on_topic, on_target):
            messages.append(redirect.message(mistake, on_topic, on_target))
        all_there = {*redirect.nodes} <= {*on_target}
        state = "is redirected" if all_there else "is redirected when it comes"
        logger.info(f"{redirect.topic} of {_names(redirect.nodes)} {state}: {redirect.target}")
    if messages:
        raise RuntimeError("; ".join(messages))
    return None


def dry_run(
    files: Sequence[str],
    processes: Sequence[dict[str, Any]],
    redirects: Sequence[dict[str, Any]],
    arguments: dict[str, str],
    folder: str,
) -> list[dict[str, Any]]:
    """Carry out launch files in a folder without starting a process.

    Return which nodes would be redirected, and what is wrong with that. Timers fire at once, and
    everything that event handlers would start counts as started.
    """
    import asyncio

    from launch import LaunchContext
    from launch.actions import RegisterEventHandler, TimerAction
    from launch.actions.execute_local import ExecuteLocal
    from launch_ros.actions import LifecycleNode, LoadComposableNodes, Node
    from launch_ros.actions import load_composable_nodes as loading
    from launch_ros.substitutions import ExecutableInPackage

    def load(action: Any, context: Any) -> None:
        for described in action._LoadComposableNodes__composable_node_descriptions:
            loading.get_composable_node_load_request(described, context)

    def carry_out(entity: Any, context: Any) -> None:
        for inner in entity.visit(context) or ():
            carry_out(inner, context)

    ExecuteLocal.execute = lambda action, context: action.prepare(context)
    ExecutableInPackage.perform = lambda substitution, context: "".join(
        context.perform_substitution(part) for part in substitution.executable
    )
    LifecycleNode.execute = Node.execute
    LoadComposableNodes.execute = load
    for timer in (TimerAction, *TimerAction.__subclasses__()):
        timer.execute = lambda action, _: action.actions
    RegisterEventHandler.execute = lambda action, _: action.event_handler.describe()[1]
    os.chdir(folder)
    parts = [Redirect(**values) for values in redirects]
    context = LaunchContext()
    context.extend_globals({_DRY_RUN: True})
    context._set_asyncio_loop(asyncio.new_event_loop())
    context.launch_configurations.update(arguments)
    carry_out(launch_description(files, processes, parts, {}), context)
    return [
        {
            "topic": part.topic,
            "target": part.target,
            "problem": part.mistake([], [seen.node for seen in part.started if not seen.named]),
            "redirected": [
                {"node": seen.node, "as": seen.label, "rules": seen.rules} for seen in part.started
            ],
        }
        for part in parts
    ]


if __name__ == "__main__":
    sys.stdout.write(json.dumps(dry_run(**json.loads(sys.argv[1]))) + "\n")
