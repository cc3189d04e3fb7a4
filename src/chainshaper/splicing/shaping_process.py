"""The shaping node of a plan as a ROS 2 process: its files, and what a launch file has to start.

Three kinds do the same: ``python`` needs no building, ``cpp`` is one package for all types,
``typed`` is the paper's package, generated for one type. All read the same parameters, which say
what the plan says, and write the same log (:mod:`chainshaper.sources.gate_log`).
"""

import ast
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import yaml

from chainshaper.gate.decision import DEPTH, Gate, Modes
from chainshaper.gate.parameters import gate_parameters
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.plan import Plan, ShapingNode, server_of
from chainshaper.splicing.generated_package import (
    GENERIC_PACKAGE,
    generic_package,
    message_type_named,
    typed_package,
)
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import write_whole

NodeKind: TypeAlias = Literal["python", "cpp", "typed"]
_PACKAGE = Path(__file__).parents[1]
_PYTHON_NODES = _PACKAGE / "splicing" / "nodes" / "python"

RESPAWN = {"respawn": True, "respawn_delay": 0.1}
"""What a launch file says of every process that is added, in the words of all its languages.

The delay (s) is for a program that ends at once, such as one that lacks a library.
"""

STANDBY = "_standby"  # what a standby's name has behind that of its shaping node
SHORTEST_PATIENCE_NS = 10_000_000  # a node later than that hangs, or than half a cycle


@dataclass(frozen=True)
class ShapingProcess:
    """A process that a launch file starts: a shaping node, or a throttler.

    It is either a ``command`` (without ``--ros-args``; name, namespace, parameters and remappings
    are for the launch file to add) or an ``executable`` of a ``package``. ``parameters_file`` is
    a ROS 2 parameters file; ``remappings`` are pairs such as ``("input", "/t5_tmp")``. The
    launch starts it again when it ends, and its ``standby`` as well, which passes its output on
    meanwhile.
    """

    name: str
    namespace: str
    command: tuple[str, ...] | None
    package: str | None
    executable: str | None
    parameters_file: Path
    remappings: tuple[tuple[str, str], ...]
    standby: "ShapingProcess | None" = None

    @property
    def command_line(self) -> list[str]:
        """The command with name, remaps and parameters as ROS arguments behind it."""
        rules = [("__node", self.name), ("__ns", self.namespace), *self.remappings]
        remaps = [word for match, target in rules for word in ("-r", f"{match}:={target}")]
        parameters = ["--params-file", str(self.parameters_file)]
        return [*(self.command or ()), "--ros-args", *remaps, *parameters]


def write_shaping_process(
    plan: Plan,
    node: ShapingNode,
    kind: NodeKind,
    folder: Path,
    *,
    message_type: str | None = None,
    log: Path | None = None,
) -> ShapingProcess:
    """Write a shaping node of a plan into ``folder``; what a launch file has to start.

    ``message_type`` is the type of the chain's output, such as ``sensor_msgs/msg/Image``: the
    ``typed`` kind is generated for it, the others find it out when they run. ``log`` is where the
    node notes what it did with each message. Files that are there and equal are left alone.

    Raises:
        InputError: a file is there with another content; no type for the typed kind, or none that
            there is.
        OperationError: a file cannot be written.
    """
    if kind == "typed" and message_type is None:
        raise InputError(
            f"the typed shaping node is generated for one type, and that of {node.output} is not "
            "known: name it, as `ros2 topic type` prints it, or choose the kind cpp"
        )
    package, files = _program(kind, "shaping_node", node.name, message_type)
    remappings = (("input", node.input), ("output", node.output))
    parameters = shaping_parameters(plan, node, log)
    # The files may be moved before they are used; the log stays where it is.
    place = hashlib.sha256(str((log or folder).absolute()).encode()).hexdigest()
    parameters["handover"] = page = f"{node.name}.{place[:8]}"
    standby = f"{node.name}{STANDBY}"
    of_standby = {
        "handover": page,
        "shaping_node": node.name,
        "fallback": plan.fallback,
        "patience_ns": max(plan.cycle_ns // 2, SHORTEST_PATIENCE_NS),
        "output_depth": parameters["output_depth"],
        "depth": parameters["depth"],
        "server_cores": _server_cores(plan),
        "log": "" if log is None else str(log.with_stem(standby).absolute()),
    }
    files |= {
        f"{node.name}.yaml": _yaml(parameters),
        f"{standby}.py": python_node("standby"),
        f"{standby}.yaml": _yaml(of_standby),
    }
    _write(folder, files)
    beside = _process(folder, standby, None, "standby", remappings)
    process = _process(folder, node.name, package, "shaping_node", remappings)
    return replace(process, standby=beside)


def write_throttler(
    topics: Mapping[str, str],
    period_ns: int,
    kind: Literal["python", "cpp"],
    folder: Path,
    *,
    name: str = "chainshaper_throttler",
    phase_ns: int = 0,
    core: int | None = None,
    fifo_priority: int | None = None,
    depth: int = DEPTH,
) -> ShapingProcess:
    """Write a throttler into ``folder`` (paper, section 5.1); what a launch file has to start.

    Each of the ``topics`` is republished on the one it maps to, once every ``period_ns``, at
    ``phase_ns`` after multiples of it on CLOCK_MONOTONIC. ``depth`` is the history of the
    publishers where that of the originals is not known.

    Raises:
        InputError: no topics, no period, or a file is there with another content.
        OperationError: a file cannot be written.
    """
    if not topics or period_ns <= 0:
        raise InputError("a throttler needs topics and a period longer than nothing")
    parameters = {
        "inputs": list(topics),
        "outputs": list(topics.values()),
        "period_ns": period_ns,
        "phase_ns": phase_ns,
        "core": -1 if core is None else core,
        "fifo_priority": fifo_priority or 0,
        "output_depth": depth,
    }
    package, files = _program(kind, "throttler", name, None)
    _write(folder, {**files, f"{name}.yaml": _yaml(parameters)})
    return _process(folder, name, package, "throttler", ())


def gate_of(plan: Plan, node: ShapingNode, depth: int = DEPTH) -> Gate:
    """The gate of a plan's shaping node, with room for so many messages.

    Plans number bands from 1, as people do; a gate numbers its slots from 0.
    """
    server = server_of(plan, node.thread)  # a plan without one for a shaping node is refused
    modes = plan.modes if node == plan.shaping_node else None
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
        parameters["server_cores"] = _server_cores(plan)
    return parameters


def _server_cores(plan: Plan) -> list[int]:
    return sorted({server.core for server in plan.servers})


def python_node(executable: str) -> str:
    """The one file of a Python node: the gate as it is, what it needs of ROS 2, and the node.

    What one of these parts imports from another is there already, so such imports are left out.
    """
    parts: dict[Path, str] = {}
    _add_part(_PYTHON_NODES / f"{executable}.py", parts)
    return "#!/usr/bin/env python3\n" + "\n\n".join(parts.values())


def _add_part(path: Path, parts: dict[Path, str]) -> None:
    """Add the text of a file without its imports of ours, behind the files that these name."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    for statement in reversed(ast.parse(text).body):
        module = getattr(statement, "module", None) or ""
        if isinstance(statement, ast.ImportFrom) and module.startswith("chainshaper."):
            del lines[statement.lineno - 1 : statement.end_lineno]
            imported = _PACKAGE.parent / f"{module.replace('.', '/')}.py"
            if imported not in parts:
                _add_part(imported, parts)
    parts[path] = "".join(lines)


def _program(
    kind: NodeKind, executable: str, name: str, message_type: str | None
) -> tuple[str | None, dict[str, str]]:
    """The package that has an executable, if it has one, and the files by their paths."""
    if kind == "python":
        return None, {
            f"{name}.py": python_node(executable),
            "respawning.py": (_PYTHON_NODES / "respawning.py").read_text(encoding="utf-8"),
        }
    package, files = GENERIC_PACKAGE, generic_package()
    if kind == "typed" and message_type is not None:
        known = message_type_named(message_type)
        package, files = known.node_package, typed_package(known)
    return package, {f"{package}/{path}": text for path, text in files.items()}


def _process(
    folder: Path,
    name: str,
    package: str | None,
    executable: str,
    remappings: tuple[tuple[str, str], ...],
) -> ShapingProcess:
    folder = folder.absolute()
    return ShapingProcess(
        name=name,
        namespace="/",
        command=("python3", str(folder / f"{name}.py")) if package is None else None,
        package=package,
        executable=None if package is None else executable,
        parameters_file=folder / f"{name}.yaml",
        remappings=remappings,
    )


def _yaml(parameters: dict[str, Any]) -> str:
    # The name or namespace that a launch file gives the node may be another one.
    return yaml.safe_dump({"/**": {"ros__parameters": parameters}}, sort_keys=False)


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
