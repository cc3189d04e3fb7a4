"""A shaping node or throttler as a ROS 2 process: its files, and what a launch file has to start.

All kinds of shaping node do the same, with the same parameters and log (:mod:`.node_kinds`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from chainshaper.planning.chain_plan import ChainPlan, ShapingNode
from chainshaper.robot.gate import DEPTH
from chainshaper.robot.throttling import Rule
from chainshaper.splicing.gate_settings import page_name, shaping_parameters
from chainshaper.splicing.message_types import MessageType, message_type_named
from chainshaper.splicing.node_kinds import OF_ONE_TYPE, NodeKind
from chainshaper.splicing.node_packages import GENERIC_PACKAGE, cpp_package
from chainshaper.splicing.python_node import RESPAWNING, python_node
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import write_whole
from chainshaper.values.plan_choices import STANDBY, NodeLanguage


@dataclass(frozen=True)
class ShapingProcess:
    """A shaping node or a throttler, which a launch file starts, and restarts when it ends.

    * ``name``: of the node.
    * ``command``: what to start, without ``--ros-args``; None: an ``executable`` of a ``package``.
    * ``package``: the package in C++; None: the node is in Python.
    * ``executable``: in the package; None: a component, or in Python.
    * ``parameters_file``: of ROS 2.
    * ``remappings``: such as ``("input", "/t5_tmp")``.
    * ``plugin``: the component in the package, which the container of the publisher loads, and
      which ends with that; None: a process of its own.
    * ``standby``: what publishes the output while this process is not there.
    """

    name: str
    command: tuple[str, ...] | None
    package: str | None
    executable: str | None
    parameters_file: Path
    remappings: tuple[tuple[str, str], ...] = ()
    plugin: str | None = None
    standby: "ShapingProcess | None" = None

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
        # A process that ends at once each time would take a core without a delay (s).
        common = {"name": self.name, "output": "screen", "respawn": True, "respawn_delay": 0.1}
        if self.command is not None:
            return {"cmd": self.command_line, **common}
        return {
            "package": self.package,
            "executable": self.executable,
            "namespace": "/",
            "parameters": [str(self.parameters_file)],
            "remappings": [*self.remappings],
            **common,
        }

    @property
    def component(self) -> dict[str, Any] | None:
        """What a container has to load (`redirection.component_request`); None: no component."""
        if self.plugin is None:
            return None
        return {
            "package": self.package,
            "plugin": self.plugin,
            "name": self.name,
            "remappings": self.remappings,
            "parameters": str(self.parameters_file),
        }


def write_shaping_process(
    plan: ChainPlan,
    node: ShapingNode,
    kind: NodeKind,
    folder: Path,
    *,
    message_type: str | None = None,
    log: Path | None = None,
    into: Path | None = None,
) -> ShapingProcess:
    """Write a shaping node of a plan into ``folder``; return what a launch file has to start.

    * ``message_type``: the output's, such as ``sensor_msgs/msg/Image``, which the kinds ``typed``
      and ``component`` need.
    * ``log``: the file in which the node notes what it did with each message.
    * ``into``: the folder to write into, if the files are moved to ``folder`` later.

    Raises InputError: a file is there with another content; a kind needs a type, and none is given,
    or there is no such type. OperationError: a file cannot be written.
    """
    if kind in OF_ONE_TYPE and message_type is None:
        raise InputError(
            f"the {kind} shaping node is generated for one type, and that of {node.output} is not "
            "known: name it, as `ros2 topic type` prints it, or choose the kind generic"
        )
    topics = (("input", node.input), ("output", node.output))
    parameters = shaping_parameters(plan, node, log) | {"handover": page_name(node, log or folder)}
    shaped = message_type_named(message_type) if kind in OF_ONE_TYPE and message_type else None
    process, files = _process(kind, "shaping_node", node.name, folder, parameters, topics, shaped)
    # A component ends with its publisher, and its standby would cost a copy of each message.
    if process.plugin is None:
        name = f"{node.name}{STANDBY}"
        shared = {key: parameters[key] for key in ("handover", "output_depth", "depth")}
        of_standby = shared | {
            "shaping_node": node.name,
            "fallback": plan.fallback,
            "patience_ns": _patience_ns(plan),
            "server_cores": sorted({server.core for server in plan.servers}),
            "log": "" if log is None else str(log.with_stem(name).absolute()),
        }
        standby, standby_files = _process("python", "standby", name, folder, of_standby, topics)
        process, files = replace(process, standby=standby), files | standby_files
    _write(into or folder, files)
    return process


def _patience_ns(plan: ChainPlan) -> int:
    """Return how late a shaping node is for a release if it hangs (ns)."""
    patience_ns = max(plan.cycle_ns // 2, 10_000_000)
    if plan.shaping_thread == "in-slots":  # its thread may have to wait for the next slot
        patience_ns += plan.cycle_ns
    return patience_ns


def write_throttler(
    topics: Mapping[str, str],
    period_ns: int,
    language: NodeLanguage,
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
    """Write a throttler into ``folder`` (paper, section 5.1); return what a launch file starts.

    * ``topics``: each one is republished on the one it maps to.
    * ``period_ns``: once in each period.
    * ``rule``: ``newest`` publishes at ``phase_ns`` behind multiples of the period on
      CLOCK_MONOTONIC; ``first`` as messages come.
    * ``depth``: the history of the publishers, where that of the original ones is not known.
    * ``into``: as for :func:`write_shaping_process`.

    Raises the errors of that, and InputError: no topics or period, or ``first`` with a phase.
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
    kind: NodeKind = "generic" if language == "cpp" else "python"
    process, files = _process(kind, "throttler", name, folder, parameters)
    _write(into or folder, files)
    return process


def _process(  # noqa: PLR0917 - all of a process
    kind: NodeKind,
    executable: str,
    name: str,
    folder: Path,
    parameters: dict[str, Any],
    remappings: tuple[tuple[str, str], ...] = (),
    shaped: MessageType | None = None,
) -> tuple[ShapingProcess, dict[str, str]]:
    """Return a process, and the text of its files by their paths below the folder."""
    file, plugin = folder.absolute() / f"{name}.yaml", None
    if kind == "component":  # a list without elements has no type
        parameters = {key: value for key, value in parameters.items() if value != []}
    # The name or namespace that a launch file gives the node may be another one.
    text = yaml.safe_dump({"/**": {"ros__parameters": parameters}}, sort_keys=False)
    files = {file.name: text}
    if kind == "python":
        files[f"{name}.py"] = python_node(executable)
        if executable != "standby":  # the node that it stands beside brings this file
            files["respawning.py"] = RESPAWNING.read_text(encoding="utf-8")
        command = ("python3", str(file.with_suffix(".py")))
        return ShapingProcess(name, command, None, None, file, remappings), files
    package = GENERIC_PACKAGE if shaped is None else shaped.node_package
    if kind == "component":
        plugin = f"{package}::ShapingNode"
    package_files = cpp_package(shaped, component=plugin is not None)
    files |= {f"{package}/{path}": text for path, text in package_files.items()}
    if plugin is not None:  # the container runs it
        return ShapingProcess(name, None, package, None, file, remappings, plugin), files
    return ShapingProcess(name, None, package, executable, file, remappings), files


def _write(folder: Path, files: dict[str, str]) -> None:
    """Write files, each whole or not at all, unless one is there with another content."""
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
