"""Splicing nodes into launch files: the paper's Republisher Editor and Throttler (4.2, 5.1).

Nothing of the user's is edited, copied or parsed: a launch file is written that includes theirs,
starts our nodes, and redirects a topic where `ros2 launch` starts the node that has it
(:mod:`.redirection`). Before a shaping node it is the publisher that is redirected, behind a
throttler the subscribers: a player or a driver often is started elsewhere.
"""

import difflib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from chainshaper.planning.chain_plan import ChainPlan, ShapingNode, revised, shaping_nodes
from chainshaper.planning.plan import Plan
from chainshaper.robot.throttling import Rule
from chainshaper.sources.preload import ANY_ORDER, SANITIZER
from chainshaper.sources.ros import own_environment, run_with_rclpy
from chainshaper.splicing import gate_settings, node_kinds, redirection
from chainshaper.splicing import spliced_launch as launching
from chainshaper.splicing.application import nothing_to_splice
from chainshaper.splicing.message_types import has_bytes, message_type_named
from chainshaper.splicing.redirection import Redirect
from chainshaper.splicing.shaping_process import (
    ShapingProcess,
    write_shaping_process,
    write_throttler,
)
from chainshaper.values.errors import InputError, OperationError, PlatformError, storable
from chainshaper.values.files import scratch_folder, write_whole
from chainshaper.values.middleware import middleware_of
from chainshaper.values.plan_choices import STANDBY, Fallback, NodeChoice, NodeLanguage
from chainshaper.values.yaml_file import FullName, Part, PositiveDuration

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording

THROTTLER = "chainshaper_throttler"
THROTTLER_PRIORITY = 85  # of SCHED_FIFO, until `apply` puts it into its server
DRY_RUN_S = 120.0  # how long a dry run may take

_SERIALIZED = ("python", "generic")  # nodes that take their messages serialized

_Names: TypeAlias = Mapping[str, Sequence[str]]
_Written: TypeAlias = tuple[list[ShapingProcess], dict[str, str]]  # and the environment


@dataclass(frozen=True)
class Splicing:
    """What was spliced."""

    folder: Path
    launch: Mapping[Path, Path]  # each launch file, or executable: the one to launch instead
    originals: Mapping[Path, Path]  # that one: the first that it includes
    processes: tuple[ShapingProcess, ...]  # that were added
    logs: tuple[Path, ...]  # of shaping nodes and their standbys
    diff: str  # the new launch file as a unified diff
    notes: tuple[str, ...]  # what to know before relying on it
    redirects: tuple[Redirect, ...]  # nodes that get another topic
    redirected: tuple[Mapping[str, Any], ...] = ()  # what a dry run found of each
    environment: Mapping[str, str] = field(default_factory=dict)  # that loads gates into processes


class ThrottledInput(Part):
    """A topic that is to reach its ``subscriber`` (None: all) once every ``period_ns`` at most.

    The ``rule`` says which messages reach it, and when (:mod:`chainshaper.robot.throttling`).
    """

    topic: FullName
    period_ns: PositiveDuration
    subscriber: FullName | None = None
    rule: Rule = "newest"


def splice_launch_files(
    plan: Plan,
    launch_files: Sequence[str | Path],
    output: str | Path,
    *,
    node: NodeChoice = "auto",
    builds: bool = False,
    arguments: Mapping[str, str] | None = None,
    message_type: str | None = None,
    recording: "Recording | None" = None,
    fallback: Fallback | None = None,
    dry_run: bool = False,
) -> Splicing:
    """Write a launch file that starts the plan's shaping nodes and launch files, into a new folder.

    ``launch_files`` may be the words of `ros2 run …` as well. With the ``node`` ``auto`` shaping
    nodes are in C++ only where the caller ``builds`` what is written (:func:`.build_package`); the
    notes say which kinds were found (:mod:`.node_kinds`). ``recording`` tells who publishes a topic
    and of which type it is, as far as the plan does not. ``fallback`` goes before the plan's.
    A folder that was spliced before and not changed since is replaced. With ``dry_run`` nothing is
    written: our own ROS 2 carries out the launch files with ``arguments``, but starts no process.

    Raises InputError: the plan shapes nothing, or does not say who publishes; no launch file; the
    folder is not ours. OperationError: the folder cannot be written, or a dry run finds too few or
    too many redirections. PlatformError: there is no ROS 2 environment for a dry run.
    """
    if fallback is not None:
        plan = Plan.of(*[revised(chain, fallback=fallback) for chain in plan.chains])
    if without := [chain for chain in plan.chains if chain.shaping_node is None]:
        raise nothing_to_splice(without[0])
    folder = launching.usable(Path(output))
    for path in (folder, *launch_files):
        if storable(str(path)) != str(path):
            raise InputError(
                f"{path}: the files that are written for ROS 2 name it, and hold names in UTF-8"
                " only: rename it"
            )
    known = _endpoints(recording, "publisher")
    every = [
        (chain, one, _publisher(chain, one, known))
        for chain in plan.chains
        for one in shaping_nodes(chain)
    ]
    redirects = []
    for _, one, publisher in every:
        if not one.in_process:
            added = (f"/{one.name}", f"/{one.name}{STANDBY}")
            redirects.append(Redirect("publisher", one.output, one.input, (publisher,), added))
    seen = () if recording is None else recording.info.endpoints
    types = {one.topic: one.type for one in reversed(seen) if one.type}
    if message_type is not None:
        message_type_named(message_type)
        types |= {one.output: message_type for _, one, _ in every}
    found = _kinds_of(every, node_kinds.language_of(node, builds=builds), types, recording)
    kinds = {name: kind for name, (kind, _) in found.items()}
    notes = [line for _, lines in found.values() for line in lines]
    if recording is not None:
        serialized = [one.output for _, one, _ in every if kinds.get(one.name) in _SERIALIZED]
        _refuse_undelivered(recording, {output: types.get(output, "") for output in serialized})
    logs = {
        shaping.name: folder / launching.LOGS / f"{shaping.name}.csv"
        for shaping in plan.shaping_nodes
    }

    def written(into: Path) -> _Written:
        made, blocks = list[ShapingProcess](), list[str]()
        for chain, one, publisher in every:
            if one.in_process:
                blocks.append(gate_settings.gate_settings(chain, one, publisher, logs[one.name]))
                continue
            process = write_shaping_process(
                *(chain, one, kinds[one.name], folder / launching.NODES),
                message_type=types.get(one.output),
                log=logs[one.name],
                into=into,
            )
            redirects[len(made)].component = process.component
            made.append(process)
        blocks += [gate_settings.delivery_settings(one) for _, one, _ in every]
        if not any(blocks):
            return made, {}
        into.mkdir(parents=True, exist_ok=True)
        write_whole(into / "gates", ["".join(blocks).encode()])
        return made, {
            "LD_PRELOAD": str(gate_settings.gate_library()),
            SANITIZER: ANY_ORDER,
            gate_settings.GATES: str(folder / launching.NODES / "gates"),
        }

    dry = dict(arguments or {}) if dry_run else None
    spliced = _spliced(launch_files, folder, redirects, written, throttled=False, dry=dry)
    pairs = [(logs[one.name], one.standby) for one in spliced.processes]
    standbys = (log.with_stem(standby.name) for log, standby in pairs if standby is not None)
    return replace(spliced, logs=(*logs.values(), *standbys), notes=(*notes, *spliced.notes))


def _kinds_of(
    every: Sequence[tuple[ChainPlan, ShapingNode, str]],
    chosen: tuple[NodeLanguage, str],
    types: Mapping[str, str],
    recording: "Recording | None",
) -> dict[str, tuple[node_kinds.NodeKind, list[str]]]:
    """Return the kind of each shaping node, by its name, with lines to be said about it."""
    language, reason = chosen
    kinds = {}
    for chain, shaping, publisher in every:
        if shaping.in_process:
            continue
        within = node_kinds.passes_within_container(chain, publisher, recording)
        kind, found_out = node_kinds.kind_of(
            language, types.get(shaping.output), within_container=within
        )
        lines = list[str]()
        if reason or language == "cpp":
            why = f"{found_out}; {reason}" if reason else found_out
            lines.append(f"{shaping.output}: the shaping node is {why}")
        if shaping == chain.shaping_node:
            lines += node_kinds.copies_made(chain, kind, within_container=within)
        kinds[shaping.name] = kind, lines
    return kinds


def _refuse_undelivered(recording: "Recording", types: Mapping[str, str]) -> None:
    """Refuse nodes that take outputs of these types serialized where none is delivered so.

    Which middleware does not deliver them is in :mod:`chainshaper.values.middleware`
    (``undelivered_bytes``). Raises InputError.
    """
    info = recording.info
    middleware = middleware_of(info.rmw)
    if middleware is None or info.rmw != middleware.rmw:
        return
    if info.distribution not in middleware.undelivered_bytes:
        return
    for output, message_type in types.items():
        if has_bytes(message_type):
            raise InputError(
                f"{output} is of {message_type}: on {info.distribution}, {info.rmw} delivers no"
                " message with a field uint8[] to nodes that take it serialized: source the"
                " workspace with the headers of the type and use --node cpp, for the type, whose"
                " standby gets none either; or use another RMW"
            )


def splice_throttlers(
    inputs: Sequence[ThrottledInput],
    launch_files: Sequence[str | Path],
    output: str | Path,
    *,
    node: NodeChoice = "auto",
    builds: bool = False,
    arguments: Mapping[str, str] | None = None,
    recording: "Recording | None" = None,
    dry_run: bool = False,
) -> Splicing:
    """Write a launch file whose nodes get these inputs by way of a throttler.

    It takes ``/points`` and republishes it as ``/points_throttled``, where the subscribers listen
    now. Inputs with the same period and rule have one throttler, as in the paper. The rest is as
    for :func:`splice_launch_files`. Raises InputError: who subscribes is not known.
    """
    if not inputs:
        raise InputError("no input to throttle: name one, such as /points_raw=100ms")
    language, reason = node_kinds.language_of(node, builds=builds)
    folder = launching.usable(Path(output))
    subscribers = _endpoints(recording, "subscription")
    alike: dict[tuple[int, Rule], dict[str, tuple[str, ...]]] = {}
    for one in inputs:
        how = (one.period_ns, one.rule)
        if any(one.topic in topics for other, topics in alike.items() if other != how):
            reason = f"{one.topic} is throttled twice, with another period or rule"
            raise InputError(f"{reason}: name it with one")
        topics = alike.setdefault(how, {})
        nodes = (*topics.get(one.topic, ()), *_subscribers(one, subscribers))
        topics[one.topic] = tuple(dict.fromkeys(nodes))

    names = [THROTTLER, *(f"{THROTTLER}_{number}" for number in range(2, len(alike) + 1))]
    redirects = [
        Redirect("subscription", topic, f"{topic}_throttled", nodes, (f"/{name}",))
        for name, topics in zip(names, alike.values(), strict=True)
        for topic, nodes in topics.items()
    ]

    def throttler(name: str, how: tuple[int, Rule], into: Path) -> ShapingProcess:
        return write_throttler(
            {topic: f"{topic}_throttled" for topic in alike[how]},
            *(how[0], language, folder / launching.NODES),
            rule=how[1],
            name=name,
            fifo_priority=THROTTLER_PRIORITY,
            into=into,
        )

    def written(into: Path) -> _Written:
        return [throttler(*one, into) for one in zip(names, alike, strict=True)], {}

    dry = dict(arguments or {}) if dry_run else None
    spliced = _spliced(launch_files, folder, redirects, written, throttled=True, dry=dry)
    if not reason:
        return spliced
    named = "Python" if language == "python" else "C++"
    return replace(spliced, notes=(f"throttlers are in {named}: {reason}", *spliced.notes))


def _spliced(
    launch_files: Sequence[str | Path],
    folder: Path,
    redirects: Sequence[Redirect],
    written: Callable[[Path], _Written],
    *,
    throttled: bool,
    dry: dict[str, str] | None,
) -> Splicing:
    """The folder, or with launch arguments for a ``dry`` run none; ``written`` writes our nodes."""
    given = [str(word) for word in launch_files]
    words = launching.original_words(given, throttled=not throttled)
    executable = launching.executable_of(given)
    files = [Path(executable)] if executable else [Path(word).absolute() for word in given]
    name = launching.launch_file_name(words)
    copy = folder / name
    place: AbstractContextManager[str | Path]
    if dry is None:
        place = launching.new_folder(folder, {name: words}, throttled=throttled)
    else:
        place = scratch_folder()
    with place as partial:
        made, environment = written(Path(partial, launching.NODES))
        text = launching.launch_text(words, made, redirects, environment)
        write_whole(Path(partial, name), [text.encode()])
    found = [] if dry is None else _tried(words, redirects, dry)
    diff = difflib.unified_diff([], text.splitlines(keepends=True), "/dev/null", str(copy))
    strange = [file for file in files if not executable and str(file) not in words]
    return Splicing(
        folder=folder,
        launch=dict.fromkeys(files, copy),
        originals={} if launching.is_run(words) else {copy: Path(words[0])},
        processes=tuple(made),
        logs=(),
        diff="".join(diff),
        notes=tuple(f"{one}: spliced from its original, {', '.join(words)}" for one in strange),
        redirects=tuple(redirects),
        redirected=tuple(found),
        environment=environment,
    )


def _tried(
    words: Sequence[str], redirects: Sequence[Redirect], arguments: Mapping[str, str]
) -> list[dict[str, Any]]:
    """What `ros2 launch` would redirect, found without starting a process."""
    ran = launching.is_run(words)
    asked = {
        "files": [] if ran else words,
        "processes": [{"cmd": words}] if ran else [],
        "redirects": [one.values() for one in redirects],
        "arguments": arguments,
        "folder": str(Path.cwd()),
    }
    said, problem = run_with_rclpy(
        *(own_environment(), redirection.__file__, json.dumps(asked)), within_s=DRY_RUN_S
    )
    if problem is not None and "No module named 'launch" in problem:
        raise PlatformError(f"a dry run needs ROS 2: source its setup.bash first ({problem})")
    if problem is not None:
        raise OperationError(f"{', '.join(words)} cannot be carried out: {problem}")
    found: list[dict[str, Any]] = json.loads(said.splitlines()[-1])  # behind what is logged
    problems = [f"{one['topic']}: {one['problem']}" for one in found if one["problem"]]
    if problems:
        raise OperationError("; ".join(problems))
    return found


def _endpoints(recording: "Recording | None", kind: str) -> _Names | None:
    """Who publishes or subscribes what: events tell, and discovery about those not in use."""
    if recording is None:
        return None
    from chainshaper.analysis.graph import application_graph

    graph = application_graph(recording.events)
    nodes = dict(graph.publishers if kind == "publisher" else graph.subscribers)
    for one in recording.info.endpoints:
        if one.kind == kind:
            nodes[one.topic] = tuple(dict.fromkeys((*nodes.get(one.topic, ()), one.node)))
    return nodes


def _subscribers(one: ThrottledInput, known: _Names | None) -> Sequence[str]:
    if one.subscriber:
        return [one.subscriber]
    if known is None:
        raise InputError(
            f"who subscribes to {one.topic} is not known: name a recording of the application with"
            f" --recording REC, or the node with --throttle NODE:{one.topic}=PERIOD"
        )
    if not known.get(one.topic):
        raise InputError(
            f"no node subscribes to {one.topic} in the recording; to these topics nodes do:"
            f" {', '.join(sorted(known)) or 'nothing'}"
        )
    return sorted(known[one.topic])


def _publisher(plan: ChainPlan, node: ShapingNode, known: _Names | None) -> str:
    standby = f"/{node.name}{STANDBY}"
    names = sorted(name for name in (known or {}).get(node.output, ()) if name != standby)
    if len(names) > 1:
        raise InputError(
            f"{node.output} has {len(names)} publishers, {', '.join(names)}: only one can be shaped"
        )
    planned = plan.chain.publisher if node is plan.shaping_node else node.publisher
    if planned is None and not names:
        raise InputError(
            f"the plan does not say who publishes {node.output}: name a recording (--recording REC)"
        )
    return planned or names[0]
