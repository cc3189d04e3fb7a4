"""Splicing nodes into launch files: the paper's Republisher Editor and Throttler (4.2, 5.1).

The functions behind `chainshaper splice`. Launch files are followed as `ros2 launch` would follow
them, without running anything; copies of the files that have to change are written into a folder,
together with the nodes that they start. Originals are never touched.

A shaping node stands behind an output: its publisher is remapped, and subscribers notice nothing. A
throttler stands before an input: its subscribers are remapped, because what publishes it, a player
or a driver, often is started elsewhere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from chainshaper.planning.plan import Plan, ShapingNode, revised
from chainshaper.splicing.launch.edit import Copies, edited_copies, unified_diff
from chainshaper.splicing.launch.file import read_launch_file
from chainshaper.splicing.launch.folder import (
    LOGS,
    NODES,
    new_folder,
    original_of,
    remove_folder,
    usable,
)
from chainshaper.splicing.launch.targets import Wanted
from chainshaper.splicing.launch.walk import follow
from chainshaper.splicing.shaping_process import (
    STANDBY,
    NodeKind,
    ShapingProcess,
    write_shaping_process,
    write_throttler,
)
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback
from chainshaper.values.yaml_file import FullName, Part, PositiveDuration

if TYPE_CHECKING:
    from chainshaper.values.application import ApplicationGraph
    from chainshaper.values.recording import Recording

__all__ = [
    "Splicing",
    "ThrottledInput",
    "splice_launch_files",
    "splice_throttlers",
    "undo_splice",
]

THROTTLER = "chainshaper_throttler"
THROTTLER_PRIORITY = 85
"""Of SCHED_FIFO, until `apply` puts it into its server: it is to wake in time from the start."""
_Remaps: TypeAlias = list[tuple[Wanted, ShapingProcess]]


@dataclass(frozen=True)
class Splicing:
    """What was spliced.

    ``launch`` maps each launch file that changed to the copy to launch instead; ``originals`` maps
    every copy to what it was made from. ``processes`` are the nodes that were added, ``logs`` where
    shaping nodes and their standbys note what they did. ``diff`` is a unified diff of all launch
    files, ``notes`` what to know before relying on it.
    """

    folder: Path
    launch: Mapping[Path, Path]
    originals: Mapping[Path, Path]
    processes: tuple[ShapingProcess, ...]
    logs: tuple[Path, ...]
    diff: str
    notes: tuple[str, ...]


class ThrottledInput(Part):
    """A topic that is to reach its ``subscriber`` once every ``period_ns``, at the most.

    Without a ``subscriber`` all of them are meant, as a recording knows them.
    """

    topic: FullName
    period_ns: PositiveDuration
    subscriber: FullName | None = None


def splice_launch_files(
    plan: Plan,
    launch_files: Sequence[str | Path],
    output: str | Path,
    *,
    node: NodeKind = "python",
    arguments: Mapping[str, str] | None = None,
    message_type: str | None = None,
    recording: "Recording | None" = None,
    fallback: Fallback | None = None,
) -> Splicing:
    """Write copies of launch files that start the plan's shaping nodes, into a new folder.

    ``arguments`` are launch arguments by name, where the files are launched with other values
    than their defaults. ``recording`` is one of the application: it tells who publishes a topic
    and of which type it is, as far as the plan does not. ``fallback`` goes before the plan's. A
    folder that was spliced before and not changed since is replaced.

    Raises:
        InputError: the plan shapes nothing; nobody publishes its output, or a node's name
            matches twice; a mistake in a launch file, with its line; the folder is not ours.
        OperationError: a remap can only be changed by hand; the folder cannot be written.
    """
    folder = usable(Path(output))
    wanted = _wanted(plan, recording)
    plan = plan if fallback is None else revised(plan, fallback=fallback)
    logs = {shaping.name: folder / LOGS / f"{shaping.name}.csv" for shaping, _ in wanted}

    def written(nodes: Path) -> _Remaps:
        return [
            (
                want,
                write_shaping_process(
                    *(plan, shaping, node, nodes),
                    message_type=message_type or _type_of(shaping.output, recording),
                    log=logs[shaping.name],
                ),
            )
            for shaping, want in wanted
        ]

    spliced = _spliced(launch_files, folder, arguments, written, throttled=False)
    standbys = [log.with_stem(f"{log.stem}{STANDBY}") for log in logs.values()]
    return replace(spliced, logs=(*logs.values(), *standbys))


def splice_throttlers(
    inputs: Sequence[ThrottledInput],
    launch_files: Sequence[str | Path],
    output: str | Path,
    *,
    node: Literal["python", "cpp"] = "python",
    arguments: Mapping[str, str] | None = None,
    recording: "Recording | None" = None,
) -> Splicing:
    """Write copies of launch files whose nodes get these inputs by way of a throttler.

    It takes ``/points`` and republishes it as ``/points_throttled``, where the subscribers listen
    now. Inputs with the same period have one throttler, as in the paper. A plan is spliced into
    such copies later, since it is made from a recording of them. The rest is as for
    :func:`splice_launch_files`.

    Raises:
        InputError: who subscribes to a topic is not known, or is not started by the launch files;
            and what :func:`splice_launch_files` refuses.
        OperationError: a remap can only be changed by hand; the folder cannot be written.
    """
    if not inputs:
        raise InputError("no input to throttle: name one, such as /points_raw=100ms")
    folder = usable(Path(output))
    graph = None if recording is None else _graph(recording)
    by_period: dict[int, list[Wanted]] = {}
    for one in inputs:
        by_period.setdefault(one.period_ns, []).extend(_subscriptions(one, graph))

    def written(nodes: Path) -> _Remaps:
        remaps: _Remaps = []
        for number, (period_ns, wanted) in enumerate(by_period.items(), start=1):
            process = write_throttler(
                *({want.topic: want.target for want in wanted}, period_ns, node, nodes),
                name=THROTTLER if number == 1 else f"{THROTTLER}_{number}",
                fifo_priority=THROTTLER_PRIORITY,
            )
            remaps += [(want, process) for want in wanted]
        return remaps

    return _spliced(launch_files, folder, arguments, written, throttled=True)


def _spliced(
    launch_files: Sequence[str | Path],
    folder: Path,
    arguments: Mapping[str, str] | None,
    written: Callable[[Path], _Remaps],
    *,
    throttled: bool,
) -> Splicing:
    """The copies; ``written`` writes the nodes into a folder and tells which remaps they need."""
    given = [Path(file).absolute() for file in launch_files]
    files = [original_of(file, throttled=not throttled) for file in given]
    notes = [
        f"{copy}: spliced from its original, {file}"
        for copy, file in zip(given, files, strict=True)
        if copy != file
    ]
    walk = follow([read_launch_file(file) for file in dict.fromkeys(files)], dict(arguments or {}))
    originals: dict[str, str] = {}
    with new_folder(folder, originals, throttled=throttled) as partial:
        remaps = [(want, _moved(made, partial, folder)) for want, made in written(partial / NODES)]
        copies = edited_copies(walk, remaps, folder)
        for copy in copies.files:
            (partial / copy.name).write_bytes(copy.text.encode())
            originals[copy.name] = str(copy.original)
    return Splicing(
        folder=folder,
        launch={file: folder / name for file, name in copies.launch.items()},
        originals={folder / name: Path(original) for name, original in originals.items()},
        processes=tuple(dict.fromkeys(process for _, process in remaps)),
        logs=(),
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


def _subscriptions(one: ThrottledInput, graph: "ApplicationGraph | None") -> list[Wanted]:
    nodes = [one.subscriber] if one.subscriber else []
    if not nodes and graph is not None:
        nodes = sorted(graph.subscribers.get(one.topic, ()))
        if not nodes:
            raise InputError(
                f"nobody subscribes to {one.topic} in the recording; what somebody does:"
                f" {', '.join(sorted(graph.subscribers)) or 'nothing'}"
            )
    if not nodes:
        raise InputError(
            f"who subscribes to {one.topic} is not known: name a recording of the application with"
            f" --recording REC, or the node with --throttle NODE:{one.topic}=PERIOD"
        )
    target = f"{one.topic}_throttled"
    return [Wanted(node, "subscribes to", one.topic, target) for node in nodes]


def _graph(recording: "Recording") -> "ApplicationGraph":
    """Who publishes and subscribes what: events tell, and discovery about those not in use."""
    from chainshaper.analysis.graph import application_graph

    graph = application_graph(recording.events)
    named: dict[str, dict[str, tuple[str, ...]]] = {
        "publisher": dict(graph.publishers),
        "subscription": dict(graph.subscribers),
    }
    for one in recording.info.endpoints:
        known = named[one.kind].get(one.topic, ())
        named[one.kind][one.topic] = tuple(dict.fromkeys((*known, one.node)))
    return replace(graph, publishers=named["publisher"], subscribers=named["subscription"])


def _wanted(plan: Plan, recording: "Recording | None") -> list[tuple[ShapingNode, Wanted]]:
    """The shaping nodes of a plan, each with the node that publishes what it shapes."""
    if plan.shaping_node is None:
        raise InputError(
            "the plan has no `shaping_node`, so there is nothing to splice: plan again with"
            " `chainshaper plan REC --chain FIRST..LAST -o plan.yaml`"
        )
    graph = None if recording is None else _graph(recording)
    return [
        (node, Wanted(_publisher(plan, node, graph), "publishes", node.output, node.input))
        for node in (plan.shaping_node, *plan.further_shaping_nodes)
    ]


def _publisher(plan: Plan, node: ShapingNode, graph: "ApplicationGraph | None") -> str:
    names = () if graph is None else graph.publishers.get(node.output, ())
    names = tuple(name for name in names if name != f"/{node.name}{STANDBY}")
    if len(names) > 1:
        raise InputError(
            f"{node.output} has {len(names)} publishers, {', '.join(sorted(names))}: a shaping node"
            " stands behind one, so plan for a topic that has one"
        )
    known = plan.chain.publisher if node is plan.shaping_node else node.publisher
    if known is not None:
        return known
    if not names:
        raise InputError(
            f"the plan does not say who publishes {node.output}: name a recording of the"
            " application with --recording REC"
        )
    return names[0]


def _type_of(topic: str, recording: "Recording | None") -> str | None:
    endpoints = () if recording is None else recording.info.endpoints
    return next((one.type for one in endpoints if one.topic == topic and one.type), None)


def _moved(process: ShapingProcess, here: Path, there: Path) -> ShapingProcess:
    """The same process once its folder stands where it belongs."""
    command = process.command and tuple(
        word.replace(str(here), str(there), 1) for word in process.command
    )
    parameters = there / process.parameters_file.relative_to(here)
    standby = process.standby and _moved(process.standby, here, there)
    return replace(process, command=command, parameters_file=parameters, standby=standby)


def _unchanged(files: Sequence[Path], copies: Copies) -> list[str]:
    return [
        f"{file}: nothing to change, launch it as before"
        for file in dict.fromkeys(files)
        if file not in copies.launch
    ]
