"""The shaping node of a plan as a ROS 2 process: its files, and what a launch file has to start.

Four kinds do the same, with the same parameters and log: ``python`` needs no building, ``cpp`` is
one package for all types, ``typed`` is the paper's package (section 4.2), generated for one type,
and ``component`` is that as a component, for the container of the output's publisher. So does the
gate in the publisher's process, for plans with ``in_process``: a library in front of rmw.
"""

import ast
import hashlib
import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from chainshaper.analysis.chains import close_names
from chainshaper.linux.threads import gate_thread_name
from chainshaper.planning.application_plan import ApplicationPlan
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.plan import Plan, ShapingNode, server_of
from chainshaper.robot.gate import DEPTH, Gate, Modes
from chainshaper.robot.node_parameters import gate_parameters
from chainshaper.robot.schema_header import schema_header
from chainshaper.robot.throttling import Rule
from chainshaper.sources.preload import native_library
from chainshaper.values.errors import InputError, OperationError, PlatformError, text_of
from chainshaper.values.files import write_whole
from chainshaper.values.plan_choices import STANDBY, NodeKind

OF_ONE_TYPE = ("typed", "component")
_SOURCES = Path(__file__).parents[2]
_NODES = Path(__file__).parents[1] / "robot"
_RESPAWNING = _NODES / "python/respawning.py"
_CORE = native_library("core")  # the headers that the library was built from


@dataclass(frozen=True)
class ShapingProcess:
    """A process that a launch file starts, again when it ends: a shaping node, or a throttler.

    It is either a ``command`` (without ``--ros-args``) or an ``executable`` of a ``package``; with
    ``plugin`` a component of it, which is loaded into the publisher's container and ends with that.
    """

    name: str
    command: tuple[str, ...] | None
    package: str | None
    executable: str | None
    parameters_file: Path  # of ROS 2
    remappings: tuple[tuple[str, str], ...] = ()  # such as ("input", "/t5_tmp")
    plugin: str | None = None
    standby: "ShapingProcess | None" = None  # passes its output on meanwhile

    @property
    def command_line(self) -> list[str]:
        """The command with name, remaps and parameters as ROS arguments behind it."""
        rules = [("__node", self.name), ("__ns", "/"), *self.remappings]
        remaps = [word for match, target in rules for word in ("-r", f"{match}:={target}")]
        parameters = ["--params-file", str(self.parameters_file)]
        return [*(self.command or ()), "--ros-args", *remaps, *parameters]

    @property
    def action(self) -> dict[str, Any]:
        """The arguments of launch's `ExecuteProcess`, or of `Node`."""
        # It may end at once each time: without a delay (s) that takes a core.
        common = {"name": self.name, "output": "screen", "respawn": True, "respawn_delay": 0.1}
        if self.command is not None:
            return {"cmd": self.command_line, **common}
        own = {"package": self.package, "executable": self.executable, "namespace": "/"}
        parameters = {"parameters": [str(self.parameters_file)]}
        return {**own, **parameters, "remappings": [*self.remappings], **common}

    @property
    def component(self) -> dict[str, Any] | None:
        """What is needed to have a container load it (`redirection.component_request`)."""
        if self.plugin is None:
            return None
        own = {"package": self.package, "plugin": self.plugin, "name": self.name}
        return {**own, "remappings": self.remappings, "parameters": str(self.parameters_file)}


def write_shaping_process(
    plan: Plan,
    node: ShapingNode,
    kind: NodeKind,
    folder: Path,
    *,
    message_type: str | None = None,
    log: Path | None = None,
    into: Path | None = None,
) -> ShapingProcess:
    """Write a shaping node of a plan into ``folder``; what a launch file has to start.

    ``message_type`` is the output's, such as ``sensor_msgs/msg/Image``, for which ``typed``
    and ``component`` are generated. ``log`` is where the node notes what it did with each message.
    Files that are to be moved to ``folder`` later are written ``into`` another one. Raises
    InputError: a file is there with another content; no type for a kind that needs one, or none
    that there is. OperationError: a file cannot be written.
    """
    if kind in OF_ONE_TYPE and message_type is None:
        raise InputError(
            f"the {kind} shaping node is generated for one type, and that of {node.output} is not "
            "known: name it, as `ros2 topic type` prints it, or choose the kind cpp"
        )
    topics = (("input", node.input), ("output", node.output))
    parameters = shaping_parameters(plan, node, log) | {"handover": _page_name(node, log or folder)}
    shaped = message_type_named(message_type) if kind in OF_ONE_TYPE and message_type else None
    process, files = _process(kind, "shaping_node", node.name, folder, parameters, topics, shaped)
    if process.plugin is None:  # that ends with its publisher, and a standby would cost a copy
        name = f"{node.name}{STANDBY}"
        same = {key: parameters[key] for key in ("handover", "output_depth", "depth")}
        of_standby = same | {
            "shaping_node": node.name,
            "fallback": plan.fallback,
            # A node later than that hangs; in its server's slots only, it may be a cycle later.
            "patience_ns": max(plan.cycle_ns // 2, 10_000_000)
            + (plan.cycle_ns if plan.shaping_thread == "in-slots" else 0),
            "server_cores": sorted({server.core for server in plan.servers}),
            "log": "" if log is None else str(log.with_stem(name).absolute()),
        }
        standby, others = _process("python", "standby", name, folder, of_standby, topics)
        process, files = replace(process, standby=standby), files | others
    _write(into or folder, files)
    return process


def zero_copy_lost(plan: ApplicationPlan, kind: NodeKind) -> list[str]:
    """A line for each output of which a node of this kind would need copies that are not made now,
    or would be a component where none was seen to be of use.
    """
    within = (
        f"get its messages without a copy; with --node {kind} each message is serialized and "
        "copied, to the shaping node and back: choose --node component"
    )
    outside = (
        "do not get its messages now; --node component needs a publisher that a launch file has a "
        "container load: for one that is a process of its own choose --node typed"
    )
    component = kind == "component"
    return [
        f"{chain.chain.output}: subscribers in the process of {chain.chain.publisher} "
        f"{outside if component else within}"
        for chain in plan.chains
        if chain.shaping_node is not None and component is not bool(chain.evidence.intra_process)
    ]


def _page_name(node: ShapingNode, place: Path) -> str:
    """Of the page of an output: the files may be moved before they are used, the log may not."""
    return f"{node.name}.{hashlib.sha256(str(place.absolute()).encode()).hexdigest()[:8]}"


def write_throttler(
    topics: Mapping[str, str],
    period_ns: int,
    kind: Literal["python", "cpp"],
    folder: Path,
    *,
    rule: Rule = "newest",
    name: str = "chainshaper_throttler",
    phase_ns: int = 0,
    core: int | None = None,
    fifo_priority: int | None = None,
    depth: int = DEPTH,
    into: Path | None = None,
) -> ShapingProcess:
    """Write a throttler into ``folder`` (paper, section 5.1); what a launch file has to start.

    Each of the ``topics`` is republished on the one it maps to, once every ``period_ns``: by the
    ``rule`` ``newest`` at ``phase_ns`` after multiples of it on CLOCK_MONOTONIC, by ``first`` as it
    comes. ``depth`` is the history of the publishers where that of the originals is not known;
    ``into``, and errors, as for a shaping process; InputError also: no topics or period, or
    ``first`` with a phase.
    """
    if not topics or period_ns <= 0:
        raise InputError("a throttler needs topics and a period longer than nothing")
    if rule == "first" and phase_ns:
        raise InputError("the rule `first` has no phase: leave out phase_ns, or choose `newest`")
    parameters = {
        "inputs": list(topics),
        "outputs": list(topics.values()),
        "period_ns": period_ns,
        "phase_ns": phase_ns,
        "rule": rule,
        "core": -1 if core is None else core,
        "fifo_priority": fifo_priority or 0,
        "output_depth": depth,
    }
    process, files = _process(kind, "throttler", name, folder, parameters)
    _write(into or folder, files)
    return process


def gate_of(plan: Plan, node: ShapingNode, depth: int = DEPTH) -> Gate:
    """The gate of a plan's shaping node, with room for so many messages."""
    server = server_of(plan, node.thread)  # a plan without one for a shaping node is refused
    modes = plan.modes if node == plan.shaping_node else None
    # Plans number bands from 1, as people do; a gate numbers its slots from 0.
    bands = {} if modes is None else {mode: band - 1 for mode, band in modes.bands.items()}
    return Gate(
        slots=() if server is None else server.slots,
        cycle_ns=plan.cycle_ns,
        anchor=plan.anchor,
        phase_ns=plan.offset_ns,
        overrun=plan.overrun,
        due_cycles=cycles_until_output(plan, node),
        modes=None if modes is None else Modes(bands, modes.default, modes.late),
        messages=plan.messages,
        into_open_slot=plan.into_open_slot,
        depth=depth,
    )


def shaping_parameters(plan: Plan, node: ShapingNode, log: Path | None) -> dict[str, Any]:
    """The ROS parameters of a shaping node, by the names of :class:`NodeParameters`."""
    mode_topic = "" if plan.modes is None else plan.modes.topic
    parameters = gate_parameters(gate_of(plan, node), mode_topic) | {
        "depth": node.depth or 0,
        "spin_ns": node.spin_ns,
        "pause_ns": node.pause_ns,
        "core": node.core,
        "fifo_priority": node.fifo_priority,
        "output_depth": plan.chain.output_depth or DEPTH,
        "log": "" if log is None else str(log.absolute()),
    }
    if node.receivers:
        parameters["server_cores"] = sorted({server.core for server in plan.servers})
    return parameters


def _process(  # noqa: PLR0917 - all of a process
    kind: NodeKind,
    executable: str,
    name: str,
    folder: Path,
    parameters: dict[str, Any],
    remappings: tuple[tuple[str, str], ...] = (),
    shaped: "MessageType | None" = None,
) -> tuple[ShapingProcess, dict[str, str]]:
    """A process with its files, by their paths below the folder."""
    file, plugin = folder.absolute() / f"{name}.yaml", None
    if kind == "component":  # a list without elements has no type
        parameters = {key: value for key, value in parameters.items() if value != []}
    # The name or namespace that a launch file gives the node may be another one.
    text = yaml.safe_dump({"/**": {"ros__parameters": parameters}}, sort_keys=False)
    files = {file.name: text}
    if kind == "python":
        files[f"{name}.py"] = python_node(executable)
        if executable != "standby":  # that stands beside one that has it
            files["respawning.py"] = _RESPAWNING.read_text(encoding="utf-8")
        command = ("python3", str(file.with_suffix(".py")))
        return ShapingProcess(name, command, None, None, file, remappings), files
    package = GENERIC_PACKAGE if shaped is None else shaped.node_package
    if kind == "component":
        plugin = f"{package}::ShapingNode"
    filled = cpp_package(shaped, component=plugin is not None)
    files |= {f"{package}/{path}": text for path, text in filled.items()}
    runs = executable if plugin is None else None
    return ShapingProcess(name, None, package, runs, file, remappings, plugin), files


def _write(folder: Path, files: dict[str, str]) -> None:
    """Write files beside and rename them, once all that are there already were looked at."""
    try:
        for name, text in files.items():
            path = folder / name
            if path.exists() and path.read_bytes() != text.encode():
                raise InputError(
                    f"{path} exists already with another content and is not overwritten: name "
                    "another folder, or remove it"
                )
        for name, text in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, [text.encode()])
    except OSError as error:
        raise OperationError(f"{error.filename}: cannot be written: {error.strerror}") from error


def python_node(executable: str) -> str:
    """The one file of a Python node: the gate as it is, what it needs of ROS 2, and the node."""
    parts: dict[Path, str] = {}

    def add(path: Path) -> None:  # without its imports of ours, behind the files that these name
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines(keepends=True)
        for statement in reversed(ast.parse(text).body):
            module = getattr(statement, "module", None) or ""
            if isinstance(statement, ast.ImportFrom) and module.startswith("chainshaper."):
                del lines[statement.lineno - 1 : statement.end_lineno]
                imported = _SOURCES / f"{module.replace('.', '/')}.py"
                if imported not in parts:
                    add(imported)
        parts[path] = "".join(lines)

    add(_NODES / "python" / f"{executable}.py")
    return "#!/usr/bin/env python3\n" + "\n\n".join(parts.values())


# Gates in the processes that publish and subscribe ------------------------------------------------

GATES = "CHAINSHAPER_GATES"
"""The variable that names the file with all gates of an application (`in_front_of_rmw.hpp`)."""


def gate_settings(plan: Plan, node: ShapingNode, publisher: str, log: Path) -> str:
    """The block of an output in the file that :data:`GATES` names, a line for each value."""
    values = {
        "output": node.output,
        "input": node.input,
        "node": node.name,
        "publisher": publisher,
        "thread": gate_thread_name(node.name),
        "handover": _page_name(node, log),
    }
    return settings_text(values | shaping_parameters(plan, node, log))


def delivery_settings(node: ShapingNode) -> str:
    """The block of an output that is handed to its receivers at a constant time; none: empty."""
    if node.delivery_ns is None:
        return ""
    values = {"output": node.output, "delivery_ns": node.delivery_ns}
    return settings_text({**values, "receiver": list(node.receivers)})


def settings_text(values: Mapping[str, Any]) -> str:
    """A block of that file: ``NAME VALUE``, once for each value of a list; ``output`` is first."""
    several = {name: one if isinstance(one, list) else [one] for name, one in values.items()}
    return "".join(f"{name} {value}\n" for name, own in several.items() for value in own)


def gate_library() -> Path:
    """The library with both gates, which was built with the package."""
    return native_library("libchainshaper_gate.so")


# Packages in C++ ----------------------------------------------------------------------------------

GENERIC_PACKAGE = "chainshaper_shaping"
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")


@dataclass(frozen=True)
class MessageType:
    """A message type, such as ``sensor_msgs/msg/PointCloud2``."""

    package: str
    name: str

    @property
    def full_name(self) -> str:
        """As `ros2 topic type` prints it."""
        return f"{self.package}/msg/{self.name}"

    @property
    def snake_name(self) -> str:
        """As rosidl_pycommon's `convert_camel_case_to_lower_case_underscore`: ``point_cloud2``."""
        words = re.sub(r"(.)([A-Z][a-z]+)", r"\1_\2", self.name)
        return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", words).lower()

    @property
    def node_package(self) -> str:
        """The name of the package that is generated for this type."""
        return f"shaping_{self.package}_{self.snake_name}"


def message_type_named(text: str) -> MessageType:
    """The message type of this name.

    Raises InputError: it is no type's name, or not installed where there is a ROS 2 environment.
    """
    match = _TYPE.fullmatch(text)
    if match is None:
        raise InputError(
            f"{text!r} is not a message type: write PACKAGE/msg/TYPE, such as "
            "sensor_msgs/msg/PointCloud2, as `ros2 topic type TOPIC` prints it"
        )
    package, name = match.groups()
    folders = _message_folders(package)
    installed = sorted({path.stem for folder in folders for path in folder.glob("*.msg")})
    if folders and not installed:
        raise InputError(
            f"{text}: no package {package} with messages in this ROS 2 environment: source the "
            "workspace that has it, or correct the name"
        )
    if folders and name not in installed:
        near = ", ".join(close_names(name, installed)) or ", ".join(installed[:5])
        raise InputError(
            f"{text}: the package {package} has no message {name}: did you mean {near}?"
        )
    return MessageType(package, name)


def has_bytes(message_type: str) -> bool:
    """Whether a message of the ROS 2 environment has a field ``uint8[]``."""
    package, _, name = message_type.partition("/msg/")
    definitions = (folder / f"{name}.msg" for folder in _message_folders(package))
    found = next((text_of(one.read_bytes()) for one in definitions if one.is_file()), "")
    return re.search(r"^\s*(uint8|char)\[\]", found, re.MULTILINE) is not None


def _message_folders(package: str) -> list[Path]:
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    return [Path(prefix) / "share" / package / "msg" for prefix in prefixes]


def cpp_package(shaped: MessageType | None = None, *, component: bool = False) -> dict[str, str]:
    """The files of the package for one type, or for all: paths inside it, and their text."""
    # The modes of the system are a std_msgs/String.
    messages = sorted({"std_msgs", *([] if shaped is None else [shaped.package])})
    depends = [*messages, "rclcpp_components"] if component else messages
    values = {
        "PROJECT": GENERIC_PACKAGE,
        "FOR": "topics of any type",
        "NODES": "shaping_node throttler",
        "COMPONENT": str(component).upper(),
        "FIND_MESSAGES": "\n".join(f"find_package({name} REQUIRED)" for name in messages),
        "MESSAGE_TARGETS": " ".join(f"${{{name}_TARGETS}}" for name in messages),
        "DEPENDS": "\n".join(f"  <depend>{name}</depend>" for name in depends),
    }
    left_out = "include/message.hpp"
    if shaped is not None:
        left_out = "src/throttler.cpp"
        values |= {
            "PROJECT": shaped.node_package,
            "FOR": shaped.full_name,
            "NODES": "" if component else "shaping_node",
            "TYPE": shaped.full_name,
            "HEADER": f"{shaped.package}/msg/{shaped.snake_name}.hpp",
            "CLASS": f"{shaped.package}::msg::{shaped.name}",
        }
    files = {"scripts/respawning": _RESPAWNING.read_text(encoding="utf-8")}
    for path in sorted((_NODES / "cpp").rglob("*.*")):
        text = path.read_text(encoding="utf-8")
        if path.name == "schema.hpp.in":
            text = schema_header(text)
        elif path.suffix == ".in":
            text = re.sub("@([A-Z_]+)@", lambda found: values.get(found[1], found[0]), text)
        files[str(path.relative_to(_NODES / "cpp")).removesuffix(".in")] = text
    for path in sorted((_CORE / "gate").glob("*.hpp")):
        files[f"include/gate/{path.name}"] = path.read_text(encoding="utf-8")
    del files[left_out]
    return files


def check_build_tools() -> None:
    """PlatformError: colcon, CMake, a compiler or the ROS 2 environment is missing."""
    compiler = os.environ.get("CXX", "c++").split()[0]
    packages = {"colcon": "python3-colcon-common-extensions", "cmake": "cmake", compiler: "g++"}
    for program, package in packages.items():
        if shutil.which(program) is None:
            raise PlatformError(
                f"{program}, which building the shaping node needs, is not on the PATH: install it "
                f"(`apt install {package}`), or choose `--node python`, which needs no building"
            )
    if not os.environ.get("AMENT_PREFIX_PATH"):
        raise PlatformError(
            "building the shaping node needs a ROS 2 environment, and none is sourced: "
            "`source /opt/ros/DISTRIBUTION/setup.bash` first, or choose `--node python`"
        )


def build_package(folder: Path) -> Path:
    """Build the packages in a folder with colcon; the file to source, ``install/setup.bash``.

    Raises PlatformError: see :func:`check_build_tools`. OperationError: the build failed.
    """
    check_build_tools()
    build = subprocess.run(
        ["colcon", "--log-base", "log", "build", "--base-paths", ".", "--merge-install"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    if build.returncode:
        end = "\n".join(text_of(build.stdout).splitlines()[-20:])
        raise OperationError(
            f"{folder}: `colcon build` failed with exit code {build.returncode}; all it said is in "
            f"{folder / 'log' / 'latest_build'}. It ended with:\n{end}"
        )
    return folder / "install" / "setup.bash"
