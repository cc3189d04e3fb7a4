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
    plan: ChainPlan,
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
            "known: name it, as `ros2 topic type` prints it, or choose the kind generic"
        )
    topics = (("input", node.input), ("output", node.output))
    parameters = shaping_parameters(plan, node, log) | {"handover": page_name(node, log or folder)}
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
            files["respawning.py"] = RESPAWNING.read_text(encoding="utf-8")
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
