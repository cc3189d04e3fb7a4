"""What a command line says about the names of a process's nodes.

ROS 2 programs choose their nodes' names themselves, and users override them by remap rules
behind `--ros-args`, as `ros2 launch` does for every node that a launch file names:

* ``-r __node:=NAME`` and ``-r __ns:=/NAMESPACE`` hold for every node of the process;
* ``-r OLD:__node:=NAME`` for its node that would be called OLD only, of which there may be
  several in one process.

Of rules that apply, the first one counts. What is quoted for a shell is one argument here, so a
parameter's value that looks like a rule is not taken for one.

Upstream: rcl, `arguments.c` and `remap.c`, whose tests say which rules are valid.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import PurePath

__all__ = ["guessed_name", "named_nodes", "takes_ros_arguments"]

_RULE = re.compile(r"(?:([A-Za-z_]\w*):)?__(node|name|ns):=(\S+)", re.ASCII)
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/|(/[A-Za-z_]\w*)+", re.ASCII)
_WITH_VALUE = frozenset(
    ("-p", "--param", "--params-file", "--log-level", "--log-config-file", "--log-file-name")
) | frozenset(("-e", "--enclave"))


def takes_ros_arguments(command: Sequence[str]) -> bool:
    """Whether a command line has arguments for ROS 2."""
    return "--ros-args" in command


def named_nodes(command: Sequence[str]) -> tuple[str, ...]:
    """Full names of the nodes that a command line names, in the order of their rules.

    A node's own namespace is not known from outside; without a rule it is taken for `/`, which
    it is unless the program says otherwise.

        >>> named_nodes(["talker", "--ros-args", "-r", "__node:=front", "-r", "__ns:=/lidar"])
        ('/lidar/front',)
        >>> named_nodes(["two", "--ros-args", "-r", "a:__node:=x", "-r", "b:__node:=y"])
        ('/x', '/y')
    """
    names: dict[str | None, str] = {}
    namespaces: dict[str | None, str] = {}
    for owner, what, value in _rules(command):
        if what == "ns":
            namespaces.setdefault(owner, value)
        elif None not in names:
            names.setdefault(owner, value)  # rules behind one for all nodes never apply
    found = []
    for owner, name in names.items():
        # A rule for all nodes that stands first would apply instead of a node's own behind it.
        namespace = namespaces.get(None, "/")
        if owner in namespaces and _first(namespaces, owner):
            namespace = namespaces[owner]
        found.append(_full(namespace, name))
    if None not in names:
        found += [
            _full(namespace, owner)
            for owner, namespace in namespaces.items()
            if owner is not None and owner not in names and _first(namespaces, owner)
        ]
    return tuple(dict.fromkeys(found))


def guessed_name(command: Sequence[str]) -> str | None:
    """A node's name by that of its program: no more than a guess, None without a program."""
    interpreted = bool(command) and re.fullmatch(r"python[0-9.]*", PurePath(command[0]).name)
    for argument in command[1:] if interpreted else command[:1]:
        if argument == "-c":
            return None
        if not argument.startswith("-"):
            stem = PurePath(argument).name.removesuffix(".py")
            return f"/{re.sub(r'[^A-Za-z0-9_]', '_', stem)}" if stem else None
    return None


def _first(namespaces: dict[str | None, str], owner: str | None) -> bool:
    """Whether a node's own namespace rule stands before the rule for all nodes, if there is one."""
    order = list(namespaces)
    return None not in namespaces or order.index(owner) <= order.index(None)


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _rules(command: Sequence[str]) -> Iterator[tuple[str | None, str, str]]:
    """Valid rules about names: (node they are for or None, ``node`` or ``ns``, value)."""
    arguments = iter(command)
    for argument in arguments:
        if argument != "--ros-args":
            continue
        for ros_argument in arguments:
            if ros_argument == "--":
                break
            if ros_argument in _WITH_VALUE:
                next(arguments, None)
            elif ros_argument in ("-r", "--remap"):
                rule = _RULE.fullmatch(next(arguments, ""))
                if rule is None:
                    continue
                owner, what, value = rule.groups()
                if what == "ns" and _NAMESPACE.fullmatch(value):
                    yield owner, "ns", value
                elif what != "ns" and _NAME.fullmatch(value):
                    yield owner, "node", value
