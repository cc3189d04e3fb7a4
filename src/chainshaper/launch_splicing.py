"""Splicing a plan's shaping nodes into launch files: the paper's Republisher Editor (section 4.2).

The function behind `chainshaper splice`. Launch files are followed as `ros2 launch` would follow
them, without running anything; copies of the files that have to change are written into a folder,
together with the shaping nodes that they start. Originals are never touched.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from chainshaper.errors import InputError
from chainshaper.planning.plan import Plan, ShapingNode
from chainshaper.splicing.launch_edit import Copies, edited_copies, unified_diff
from chainshaper.splicing.launch_file import read_launch_file
from chainshaper.splicing.launch_folder import (
    LOGS,
    NODES,
    new_folder,
    original_of,
    remove_folder,
    usable,
)
from chainshaper.splicing.launch_targets import Wanted
from chainshaper.splicing.launch_walk import follow
from chainshaper.splicing.shaping_process import NodeKind, ShapingProcess, write_shaping_process

if TYPE_CHECKING:
    from chainshaper.recording import Recording

__all__ = ["Splicing", "splice_launch_files", "undo_splice"]


@dataclass(frozen=True)
class Splicing:
    """What was spliced.

    ``launch`` maps each launch file that changed to the copy to launch instead; ``originals`` maps
    every copy to what it was made from. ``logs`` are where the shaping nodes note what they did.
    ``diff`` is a unified diff of all launch files, ``notes`` what to know before relying on it.
    """

    folder: Path
    launch: Mapping[Path, Path]
    originals: Mapping[Path, Path]
    processes: tuple[ShapingProcess, ...]
    logs: tuple[Path, ...]
    diff: str
    notes: tuple[str, ...]


def splice_launch_files(
    plan: Plan,
    launch_files: Sequence[str | Path],
    output: str | Path,
    *,
    node: NodeKind = "python",
    arguments: Mapping[str, str] | None = None,
    message_type: str | None = None,
    recording: "Recording | None" = None,
) -> Splicing:
    """Write copies of launch files that start the plan's shaping nodes, into a new folder.

    ``arguments`` are launch arguments by name, where the files are launched with other values
    than their defaults. ``recording`` is one of the application: it tells who publishes a topic
    and of which type it is, as far as the plan does not. A folder that was spliced before and
    not changed since is replaced.

    Raises:
        InputError: the plan shapes nothing; nobody publishes its output, or a node's name
            matches twice; a mistake in a launch file, with its line; the folder is not ours.
        OperationError: a remap can only be changed by hand; the folder cannot be written.
    """
    folder = usable(Path(output))
    wanted = _wanted(plan, recording)
    given = [Path(file).absolute() for file in launch_files]
    files = [original_of(file) for file in given]
    notes = [
        f"{copy}: spliced from its original, {file}"
        for copy, file in zip(given, files, strict=True)
        if copy != file
    ]
    walk = follow([read_launch_file(file) for file in dict.fromkeys(files)], dict(arguments or {}))
    originals: dict[str, str] = {}
    with new_folder(folder, originals) as partial:
        processes: list[ShapingProcess] = []
        logs: list[Path] = []
        for want in wanted:
            log = folder / LOGS / f"{want.shaping.name}.csv"
            type_ = message_type or _type_of(want.shaping.output, recording)
            process = write_shaping_process(
                plan, want.shaping, node, partial / NODES, message_type=type_, log=log
            )
            processes.append(_moved(process, partial, folder))
            logs.append(log)
        copies = edited_copies(walk, list(zip(wanted, processes, strict=True)), folder)
        for copy in copies.files:
            (partial / copy.name).write_bytes(copy.text.encode())
            originals[copy.name] = str(copy.original)
    return Splicing(
        folder=folder,
        launch={file: folder / name for file, name in copies.launch.items()},
        originals={folder / name: Path(original) for name, original in originals.items()},
        processes=tuple(processes),
        logs=tuple(logs),
        diff="".join(unified_diff(copy, folder) for copy in copies.files),
        notes=(*notes, *copies.notes, *_unchanged(files, copies)),
    )


def undo_splice(folder: str | Path) -> None:
    """Remove what :func:`splice_launch_files` wrote, unless it was changed since.

    Raises:
        InputError: it is not such a folder, or something in it was changed or added.
        OperationError: it cannot be removed.
    """
    remove_folder(Path(folder))


def _wanted(plan: Plan, recording: "Recording | None") -> list[Wanted]:
    """The shaping nodes of a plan, each with the node that publishes what it shapes."""
    if plan.shaping_node is None:
        raise InputError(
            "the plan has no `shaping_node`, so there is nothing to splice: plan again with"
            " `chainshaper plan REC --chain FIRST..LAST -o plan.yaml`"
        )
    nodes = (plan.shaping_node, *plan.further_shaping_nodes)
    return [Wanted(node, _publisher(plan, node, recording)) for node in nodes]


def _publisher(plan: Plan, node: ShapingNode, recording: "Recording | None") -> str:
    names: set[str] = set()
    if recording is not None:
        from chainshaper.analysis.graph import application_graph

        names = set(application_graph(recording.events).publishers.get(node.output, ()))
        names |= {
            endpoint.node
            for endpoint in recording.info.endpoints
            if endpoint.kind == "publisher" and endpoint.topic == node.output
        }
    if len(names) > 1:
        raise InputError(
            f"{node.output} has {len(names)} publishers, {', '.join(sorted(names))}: a shaping node"
            " stands behind one, so plan for a topic that has one"
        )
    if node is plan.shaping_node and plan.chain.publisher is not None:
        return plan.chain.publisher
    if not names:
        raise InputError(
            f"the plan does not say who publishes {node.output}: name a recording of the"
            " application with --recording REC"
        )
    return names.pop()


def _type_of(topic: str, recording: "Recording | None") -> str | None:
    endpoints = () if recording is None else recording.info.endpoints
    return next((one.type for one in endpoints if one.topic == topic and one.type), None)


def _moved(process: ShapingProcess, here: Path, there: Path) -> ShapingProcess:
    """The same process once its folder stands where it belongs."""
    command = process.command and tuple(
        word.replace(str(here), str(there), 1) for word in process.command
    )
    parameters = there / process.parameters_file.relative_to(here)
    return replace(process, command=command, parameters_file=parameters)


def _unchanged(files: Sequence[Path], copies: Copies) -> list[str]:
    return [
        f"{file}: nothing to change, launch it as before"
        for file in dict.fromkeys(files)
        if file not in copies.launch
    ]
