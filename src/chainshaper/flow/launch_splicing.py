"""Splicing nodes into launch files: the paper's Republisher Editor and Throttler (4.2, 5.1).

Nothing of the user's is edited, copied or parsed: a launch file is written that includes theirs,
starts our nodes, and redirects a topic where `ros2 launch` starts the node that has it
(:mod:`.redirection`). Before a shaping node it is the publisher that is redirected, behind a
throttler the subscribers: a player or a driver is often started elsewhere.
"""

import difflib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from chainshaper.flow.plan_checks import refuse_several_hosts
from chainshaper.planning.chain_plan import ChainPlan, ShapingNode, revised, shaping_nodes
from chainshaper.planning.plan import Plan
from chainshaper.robot.throttling import Rule
from chainshaper.sources.preload import ANY_ORDER, SANITIZER
from chainshaper.sources.ros import own_environment, run_with_rclpy
from chainshaper.splicing import gate_settings, node_kinds, redirection
from chainshaper.splicing import spliced_launch as launching
from chainshaper.splicing.application import nothing_to_splice
from chainshaper.splicing.message_types import has_bytes, message_type_named
from chainshaper.splicing.node_kinds import NodeKind
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

_Endpoints: TypeAlias = Mapping[str, Sequence[str]]
"""The nodes that publish, or subscribe to, each topic."""


@dataclass(frozen=True)
class Splicing:
    """What was spliced."""

    folder: Path
    # By launch file, or executable: the file to launch instead; by itself what includes none.
    launch: Mapping[Path, Path]
    originals: Mapping[Path, Path]  # by that file: the first that it includes
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


@dataclass(frozen=True)
class _Added:
    """What a launch file adds to the application."""

    processes: Sequence[ShapingProcess]
    redirects: Sequence[Redirect]
    environment: Mapping[str, str] = field(default_factory=dict)  # that loads gates into processes


# Shaping nodes --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ShapedOutput:
    """An output of a plan, and what its shaping node has to know."""

    chain: ChainPlan
    node: ShapingNode
    publisher: str  # the application's node that publishes it
    log: Path
    message_type: str | None = None  # None: not known
    kind: NodeKind | None = None  # None: the gate is in the publisher's process


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

    ``launch_files`` may be the words of `ros2 run …` as well, or none: then the new launch file is
    to be included first in another, whose nodes it shapes. With the ``node`` ``auto`` shaping
    nodes are in C++ only where the caller ``builds`` what is written (:func:`.build_package`); the
    notes say which kinds were chosen (:mod:`.node_kinds`). ``recording`` says who publishes a topic
    and of which type it is, as far as the plan does not. ``fallback`` goes before the plan's.
    A folder that was spliced before and not changed since is replaced. With ``dry_run`` nothing is
    written: our own ROS 2 carries out the launch files with ``arguments``, but starts no process.

    Raises InputError: the plan shapes nothing, or does not say who publishes; no launch file; the
    folder is not ours. OperationError: the folder cannot be written, or a dry run finds too few or
    too many redirections. PlatformError: there is no ROS 2 environment for a dry run.
    """
    if fallback is not None:
        plan = Plan.of(*[revised(chain, fallback=fallback) for chain in plan.chains])
    refuse_several_hosts(plan)
    if without := [chain for chain in plan.chains if chain.shaping_node is None]:
        raise nothing_to_splice(without[0])
    folder = launching.usable(Path(output))
    for path in (folder, *launch_files):
        if storable(str(path)) != str(path):
            raise InputError(
                f"{path}: the files that are written for ROS 2 name it, and hold names in UTF-8"
                " only: rename it"
            )
    outputs = _shaped_outputs(plan, folder, recording, message_type)
    language, reason = node_kinds.language_of(node, builds=builds)
    outputs, notes = _with_kinds(outputs, language, reason, recording)
    if recording is not None:
        _refuse_undelivered(recording, outputs)
    spliced = _spliced(
        launch_files,
        folder,
        lambda into: _write_shaping_nodes(outputs, folder, into),
        throttled=False,
        dry_run_arguments=dict(arguments or {}) if dry_run else None,
    )
    logs = {shaped.node.name: shaped.log for shaped in outputs}
    standbys = [
        logs[process.name].with_stem(process.standby.name)
        for process in spliced.processes
        if process.standby is not None
    ]
    return replace(spliced, logs=(*logs.values(), *standbys), notes=(*notes, *spliced.notes))


def _shaped_outputs(
    plan: Plan, folder: Path, recording: "Recording | None", message_type: str | None
) -> list[_ShapedOutput]:
    """Return the outputs of a plan, with their publishers and types.

    All are of ``message_type``, or of those that the recording shows. Raises InputError: there is
    no such type, or it is not known who publishes an output.
    """
    publishers = _endpoints(recording, "publisher")
    outputs = [
        _ShapedOutput(
            chain=chain,
            node=node,
            publisher=_publisher(chain, node, publishers),
            log=folder / launching.LOGS / f"{node.name}.csv",
        )
        for chain in plan.chains
        for node in shaping_nodes(chain)
    ]
    if message_type is not None:
        message_type_named(message_type)
        return [replace(shaped, message_type=message_type) for shaped in outputs]
    seen = () if recording is None else recording.info.endpoints
    # Where an output has several, the type that was seen first.
    types = {endpoint.topic: endpoint.type for endpoint in reversed(seen) if endpoint.type}
    return [replace(shaped, message_type=types.get(shaped.node.output)) for shaped in outputs]


def _publisher(plan: ChainPlan, node: ShapingNode, publishers: _Endpoints | None) -> str:
    """Return the application's node that publishes the output of a shaping node.

    Raises InputError: it is not known, or there are several.
    """
    standby = f"/{node.name}{STANDBY}"
    names = sorted(name for name in (publishers or {}).get(node.output, ()) if name != standby)
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


def _with_kinds(
    outputs: Sequence[_ShapedOutput],
    language: NodeLanguage,
    reason: str,
    recording: "Recording | None",
) -> tuple[list[_ShapedOutput], list[str]]:
    """Choose the kind of each shaping node; return the outputs with it, and what to say of it.

    ``reason`` is why nodes are in this language; "": the user chose it.
    """
    chosen, notes = list[_ShapedOutput](), list[str]()
    for shaped in outputs:
        if shaped.node.in_process:
            chosen.append(shaped)
            continue
        within = node_kinds.passes_within_container(shaped.chain, shaped.publisher, recording)
        kind, kind_text = node_kinds.kind_of(language, shaped.message_type, within_container=within)
        chosen.append(replace(shaped, kind=kind))
        if reason or language == "cpp":
            why = f"{kind_text}; {reason}" if reason else kind_text
            notes.append(f"{shaped.node.output}: the shaping node is {why}")
        if shaped.node == shaped.chain.shaping_node:
            notes += node_kinds.copies_made(shaped.chain, kind, within_container=within)
    return chosen, notes


def _refuse_undelivered(recording: "Recording", outputs: Sequence[_ShapedOutput]) -> None:
    """Refuse nodes that take their messages serialized where none of their type is delivered so.

    Which middleware does not deliver them is in :mod:`chainshaper.values.middleware`
    (``undelivered_bytes``). Raises InputError.
    """
    info = recording.info
    middleware = middleware_of(info.rmw)
    if middleware is None or info.rmw != middleware.rmw:
        return
    if info.distribution not in middleware.undelivered_bytes:
        return
    for shaped in outputs:
        if shaped.kind in _SERIALIZED and has_bytes(shaped.message_type or ""):
            raise InputError(
                f"{shaped.node.output} is of {shaped.message_type}: on {info.distribution},"
                f" {info.rmw} delivers no message with a field uint8[] to nodes that take it"
                " serialized: source the workspace with the headers of the type and use --node cpp,"
                " for the type, whose standby gets none either; or use another RMW"
            )


def _write_shaping_nodes(outputs: Sequence[_ShapedOutput], folder: Path, into: Path) -> _Added:
    """Write shaping nodes and gates of publishers' processes ``into`` a folder.

    Its content is moved below ``folder`` later.
    """
    processes, redirects = list[ShapingProcess](), list[Redirect]()
    blocks = list[str]()  # of the file that gates in publishers' processes read
    for shaped in outputs:
        node = shaped.node
        if shaped.kind is None:
            settings = gate_settings.gate_settings(shaped.chain, node, shaped.publisher, shaped.log)
            blocks.append(settings)
            continue
        process = write_shaping_process(
            shaped.chain,
            node,
            shaped.kind,
            folder / launching.NODES,
            message_type=shaped.message_type,
            log=shaped.log,
            into=into,
        )
        processes.append(process)
        redirect = Redirect(
            kind="publisher",
            topic=node.output,
            target=node.input,
            nodes=(shaped.publisher,),
            added=(f"/{node.name}", f"/{node.name}{STANDBY}"),
            component=process.component,
        )
        redirects.append(redirect)
    blocks += [gate_settings.delivery_settings(shaped.node) for shaped in outputs]
    if not any(blocks):
        return _Added(processes, redirects)
    into.mkdir(parents=True, exist_ok=True)
    write_whole(into / "gates", ["".join(blocks).encode()])
    environment = {
        "LD_PRELOAD": str(gate_settings.gate_library()),
        SANITIZER: ANY_ORDER,
        gate_settings.GATES: str(folder / launching.NODES / "gates"),
    }
    return _Added(processes, redirects, environment)


# Throttlers -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Throttler:
    """A throttler, and the nodes that get each of its topics by way of it."""

    name: str
    period_ns: int
    rule: Rule
    subscribers: dict[str, tuple[str, ...]]  # by topic


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
    throttlers = _throttlers(inputs, _endpoints(recording, "subscription"))
    spliced = _spliced(
        launch_files,
        folder,
        lambda into: _write_throttlers(throttlers, language, folder, into),
        throttled=True,
        dry_run_arguments=dict(arguments or {}) if dry_run else None,
    )
    if not reason:
        return spliced
    named = "Python" if language == "python" else "C++"
    return replace(spliced, notes=(f"throttlers are in {named}: {reason}", *spliced.notes))


def _throttlers(
    inputs: Sequence[ThrottledInput], subscriptions: _Endpoints | None
) -> list[_Throttler]:
    """Return a throttler for each period and rule of the inputs. Raises InputError."""
    throttlers = dict[tuple[int, Rule], _Throttler]()
    for throttled in inputs:
        topic, rule = throttled.topic, (throttled.period_ns, throttled.rule)
        for key, throttler in throttlers.items():
            if key != rule and topic in throttler.subscribers:
                reason = f"{topic} is throttled twice, with another period or rule"
                raise InputError(f"{reason}: name it with one")
        if rule not in throttlers:
            name = f"{THROTTLER}_{len(throttlers) + 1}" if throttlers else THROTTLER
            throttlers[rule] = _Throttler(name, *rule, {})
        subscribers = throttlers[rule].subscribers
        names = (*subscribers.get(topic, ()), *_subscribers(throttled, subscriptions))
        subscribers[topic] = tuple(dict.fromkeys(names))
    return list(throttlers.values())


def _subscribers(throttled: ThrottledInput, subscriptions: _Endpoints | None) -> Sequence[str]:
    """Return the nodes that an input is throttled for. Raises InputError: they are not known."""
    if throttled.subscriber:
        return [throttled.subscriber]
    topic = throttled.topic
    if subscriptions is None:
        raise InputError(
            f"who subscribes to {topic} is not known: name a recording of the application with"
            f" --recording REC, or the node with --throttle NODE:{topic}=PERIOD"
        )
    if not subscriptions.get(topic):
        raise InputError(
            f"no node subscribes to {topic} in the recording; to these topics nodes do:"
            f" {', '.join(sorted(subscriptions)) or 'nothing'}"
        )
    return sorted(subscriptions[topic])


def _write_throttlers(
    throttlers: Sequence[_Throttler], language: NodeLanguage, folder: Path, into: Path
) -> _Added:
    """Write throttlers ``into`` a folder whose content is moved below ``folder`` later."""
    processes, redirects = list[ShapingProcess](), list[Redirect]()
    for throttler in throttlers:
        process = write_throttler(
            {topic: f"{topic}_throttled" for topic in throttler.subscribers},
            throttler.period_ns,
            language,
            folder / launching.NODES,
            rule=throttler.rule,
            name=throttler.name,
            fifo_priority=THROTTLER_PRIORITY,
            into=into,
        )
        processes.append(process)
        redirects += [
            Redirect(
                kind="subscription",
                topic=topic,
                target=f"{topic}_throttled",
                nodes=subscribers,
                added=(f"/{throttler.name}",),
            )
            for topic, subscribers in throttler.subscribers.items()
        ]
    return _Added(processes, redirects)


# What both have in common ---------------------------------------------------------------------


def _endpoints(recording: "Recording | None", kind: str) -> _Endpoints | None:
    """Return the nodes with an endpoint of this kind, by topic; None without a recording.

    Events show those in use, discovery the others.
    """
    if recording is None:
        return None
    from chainshaper.analysis.graph import application_graph

    graph = application_graph(recording.events)
    nodes = dict(graph.publishers if kind == "publisher" else graph.subscribers)
    for endpoint in recording.info.endpoints:
        if endpoint.kind == kind:
            known = nodes.get(endpoint.topic, ())
            nodes[endpoint.topic] = tuple(dict.fromkeys((*known, endpoint.node)))
    return nodes


def _spliced(
    launch_files: Sequence[str | Path],
    folder: Path,
    write_nodes: Callable[[Path], _Added],
    *,
    throttled: bool,
    dry_run_arguments: dict[str, str] | None,
) -> Splicing:
    """Write the folder with the launch file; ``write_nodes`` writes our nodes into a part of it.

    With launch arguments for a dry run, the folder does not stay, and `ros2 launch` is tried.
    """
    given = [str(word) for word in launch_files]
    words = launching.original_words(given, throttled=not throttled)
    executable = launching.executable_of(given)
    files = [Path(executable)] if executable else [Path(word).absolute() for word in given]
    name = launching.launch_file_name(words)
    copy = folder / name
    place: AbstractContextManager[str | Path]
    if dry_run_arguments is not None and not words:
        raise InputError("a dry run needs the launch files, which it carries out: name them")
    if dry_run_arguments is None:
        place = launching.new_folder(folder, {name: words}, throttled=throttled)
    else:
        place = scratch_folder()
    with place as unfinished:
        added = write_nodes(Path(unfinished, launching.NODES))
        text = launching.launch_text(words, added.processes, added.redirects, added.environment)
        write_whole(Path(unfinished, name), [text.encode()])
    redirected = list[dict[str, Any]]()
    if dry_run_arguments is not None:
        redirected = _tried(words, added.redirects, dry_run_arguments)
    diff = difflib.unified_diff([], text.splitlines(keepends=True), "/dev/null", str(copy))
    # The user named a launch file that was spliced before.
    strange = [file for file in files if not executable and str(file) not in words]
    return Splicing(
        folder=folder,
        launch=dict.fromkeys(files or [copy], copy),
        originals={} if not words or launching.is_run(words) else {copy: Path(words[0])},
        processes=tuple(added.processes),
        logs=(),
        diff="".join(diff),
        notes=tuple(f"{file}: spliced from its original, {', '.join(words)}" for file in strange),
        redirects=tuple(added.redirects),
        redirected=tuple(redirected),
        environment=added.environment,
    )


def _tried(
    words: Sequence[str], redirects: Sequence[Redirect], arguments: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Have `ros2 launch` redirect the topics without starting a process; return what it found."""
    is_run = launching.is_run(words)
    question = {
        "files": [] if is_run else words,
        "processes": [{"cmd": words}] if is_run else [],
        "redirects": [redirect.values() for redirect in redirects],
        "arguments": arguments,
        "folder": str(Path.cwd()),
    }
    answer, problem = run_with_rclpy(
        own_environment(), redirection.__file__, json.dumps(question), within_s=DRY_RUN_S
    )
    if problem is not None and "No module named 'launch" in problem:
        raise PlatformError(f"a dry run needs ROS 2: source its setup.bash first ({problem})")
    if problem is not None:
        raise OperationError(f"{', '.join(words)} cannot be carried out: {problem}")
    redirected: list[dict[str, Any]] = json.loads(answer.splitlines()[-1])  # behind what is logged
    problems = [
        f"{redirect['topic']}: {redirect['problem']}"
        for redirect in redirected
        if redirect["problem"]
    ]
    if problems:
        raise OperationError("; ".join(problems))
    return redirected
