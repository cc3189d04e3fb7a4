"""Shaping a real application from measuring to the proof: `chainshaper shape -- ros2 launch …`.

    first/ ─► which chain ─► before/ ─► plan.yaml ─► launch/ ─► after/ ─► comparison.json, figures
    record    which cores    profile    plan         splice     apply,
                                                                recorded

Each step is what the verb of its name does, and leaves its result in the folder. The first, short
recording shows which chains there are, which nodes a chain has and which of these run at the same
time; the second measures it under the paper's profiling condition (section 2.4), as far as that is
permitted. Chains that would delay each other have recordings of their own.
"""

import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

from chainshaper import planning
from chainshaper.analysis import ChainEnumeration, graph_of, recorded_flow
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow import launch_splicing
from chainshaper.flow.apply import START_NS, apply_plan
from chainshaper.flow.exploration import list_chains
from chainshaper.flow.in_step import loops_in_step
from chainshaper.flow.launch_splicing import Splicing, ThrottledInput
from chainshaper.flow.plan import profile_chains
from chainshaper.flow.profiling_condition import (
    chain_nodes,
    profiled_cores,
    profiling_condition,
    undelayed,
)
from chainshaper.flow.record import Scheduling, check_loops, record_command
from chainshaper.linux.processes import RunningProcess, run_users
from chainshaper.linux.scheduling import check_cores, may_use_fifo
from chainshaper.planning import ChainPlan, Plan, PlanRequest, Profile
from chainshaper.planning import request as requests
from chainshaper.planning.profile import doubts_about
from chainshaper.reporting.figures import write_comparison
from chainshaper.reporting.page import write_report
from chainshaper.splicing.node_kinds import language_of
from chainshaper.splicing.node_packages import SETUP, build_package, check_build_tools
from chainshaper.splicing.shaped_outputs import remove_abandoned_pages
from chainshaper.splicing.spliced_launch import NODES, LaunchCommand, parse_launch_command
from chainshaper.values.application import ApplicationGraph
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import NodeChoice
from chainshaper.values.recording import Recording, refuse_existing
from chainshaper.verify.measure import Comparison, compare_recordings

IN_STEP_NS = 20_000_000_000  # within which loops are in step, or the run says why they are not
FIRST_LOOK_NS = 10_000_000_000  # long enough for everything to have started and run
NOT_PERMITTED = "measured under ordinary scheduling: SCHED_FIFO is not permitted."


@dataclass(frozen=True)
class ShapedLaunch:
    """The results of shaping a launched application; all of them lie in ``folder`` too."""

    folder: Path
    chain: str  # the first
    plan: ChainPlan  # of the first chain
    splicing: Splicing | None  # None: no output has a shaping node
    comparison: Comparison  # of the first chain
    notes: tuple[str, ...]
    application: Plan
    comparisons: tuple[Comparison, ...]  # of every chain and sink
    cores: Mapping[str, int]  # where each node's executor ran

    @property
    def setup(self) -> Path | None:
        """The file to source before the shaped launch file is launched again; None: none is."""
        if self.splicing is None or not _has_packages(self.splicing):
            return None
        return self.splicing.folder / NODES / SETUP


Choose: TypeAlias = Callable[[ApplicationGraph, ChainEnumeration], str]
"""Which of the chains in a graph the user means, by its words."""


def shape_launch(
    command: Sequence[str],
    folder: str | Path,
    *,
    chain: str | Sequence[str] | None = None,
    sinks: Sequence[str] = (),
    throttled: Sequence[ThrottledInput] = (),
    choose: Choose | None = None,
    request: PlanRequest | None = None,
    period_ns: int | None = None,
    mode_recordings: Mapping[str, str | Path] | None = None,
    since_ns: int = 0,
    until_ns: int | None = None,
    duration_ns: int = 60_000_000_000,
    source: Literal["lttng", "preload", "ebpf"] | None = None,
    loops: Sequence[str] = (),
    node: NodeChoice = "auto",
    back_end: str = "auto",
    adapt: bool = False,
    max_latency_ns: int | None = None,
    users: Collection[str | int] = (),
    stop: threading.Event | None = None,
    planned: Callable[[Plan], None] = lambda _: None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> ShapedLaunch:
    """Measure chains of a launched application, plan, splice, apply, and measure again.

    ``chain`` is the chain to shape, or several; without it, ``choose`` is asked. ``sinks`` are
    chains to further outputs of the graph of one chain, ``throttled`` inputs with the nodes that
    get them by way of a throttler, from the first recording on. ``request.cores`` are where
    executors run (default: the last core, and others that are worth it). The application is
    launched briefly, and for ``duration_ns`` before and after. ``loops`` are names of nodes and
    threads whose loops are recorded although they publish nothing (`preload` only). ``planned``
    gets the plan before it is used. ``stop`` ends everything. The rest is for
    :func:`.profile_chains` and :func:`.apply_plan`.

    Raises InputError: ``folder`` is not empty, the command is not `ros2 launch`, or what it
    launches does not fit. PlatformError, OperationError: there is no such core, or a step failed;
    what the steps before it left stays.
    """
    launch, request = parse_launch_command(command), request or PlanRequest()
    chains = [chain] if isinstance(chain, str) else [*(chain or ())]
    _refuse_early(request, chains, sinks, throttled, bool(mode_recordings))
    check_loops(loops, source)
    if language_of(node, builds=True)[0] == "cpp":
        check_build_tools()
    folder, user_ids = refuse_existing(folder), run_users(users)
    folder.mkdir(exist_ok=True)
    ends = stop or threading.Event()
    recorder = _Recorder(folder, source, duration_ns, ends, progress, tuple(loops))
    launched = _Launched(tuple(command), launch)
    if throttled:
        request = replace(request, anchor="cycle")  # messages have the stamps of their sensors
        launched = _with_throttlers(launched, throttled, folder / "throttled", node)
    look = _first_look(
        recorder, launched, chains, sinks, choose=choose, request=request, period_ns=period_ns
    )
    profile = partial(
        profile_chains,
        period_ns=period_ns,
        since_ns=since_ns,
        until_ns=until_ns,
        modes=request.modes,
        mode_recordings=mode_recordings or {},
    )
    before = _measured_before(recorder, launched, look, request, profile)
    progress(0.0, "planning")
    plan, doubts = _planned(before.profiles, look.chains, request)
    planning.save_plan(plan, folder / "plan.yaml")
    planned(plan)
    notes = [*before.notes, *doubts]
    splicing = None
    if plan.shaping_nodes:
        recordings = [look.recording, *before.recordings]
        splicing = _with_shaping_nodes(launched, plan, folder / "launch", node, recordings)
        launched = launched.launching(splicing)
        notes += splicing.notes
    in_force = plan_in_force(
        plan, back_end, look.recording, user_ids, notes, adapt=adapt, max_latency_ns=max_latency_ns
    )
    after = _recorded_after(recorder, launched, plan, splicing, in_force, chain=look.wanted[0])
    progress(0.0, "comparing")
    comparisons = _compared(look.wanted, before.recordings, after, folder)
    notes += after.info.notes
    return ShapedLaunch(
        folder=folder,
        chain=look.wanted[0],
        plan=plan.chains[0],
        splicing=splicing,
        comparison=comparisons[0],
        notes=tuple(dict.fromkeys(notes)),
        application=plan,
        comparisons=comparisons,
        cores=look.core_of,
    )


@dataclass(frozen=True)
class _Launched:
    """The command that launches the application, as it is at a step of the flow."""

    command: tuple[str, ...]  # all words
    launch: LaunchCommand  # the same without what is sourced before it
    setup: tuple[str, ...] = ()  # the words before it, which source what throttlers need

    def launching(self, splicing: Splicing) -> "_Launched":
        """Return the command that launches what was spliced, in the same way."""
        files = dict.fromkeys(splicing.launch.values())
        words = (*self.setup, *_sourced(splicing), *self.launch.with_file(*files))
        return replace(self, command=words)


@dataclass(frozen=True)
class _FirstLook:
    """What the first, short recording shows of the chains and sinks that are wanted."""

    recording: Recording
    chains: int  # how many of ``wanted`` are chains; the others are sinks of the first
    wanted: tuple[str, ...]  # chains, then sinks
    profiles: Sequence[Profile]  # of each that is wanted; empty: too little was to be seen
    core_of: Mapping[str, int]  # where each node's executor runs


@dataclass(frozen=True)
class _MeasuredBefore:
    """The chains and sinks as measured under the profiling condition, in the order of ``wanted``.

    Chains that were recorded together have the same recording.
    """

    recordings: tuple[Recording, ...]
    profiles: tuple[Profile, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Recorder:
    """Records the launched application again and again, into folders of one folder."""

    folder: Path
    source: Literal["lttng", "preload", "ebpf"] | None
    duration_ns: int  # of all recordings but the first
    stop: threading.Event
    progress: Callable[[float, str], None]
    loops: tuple[str, ...] = ()

    def record(
        self,
        name: str,
        launched: _Launched,
        *,
        scheduling: Scheduling | None = None,
        plan: Plan | None = None,
        gate_logs: Sequence[Path] = (),
        chain: str | None = None,
    ) -> Recording:
        """Record into the folder of this name; the rest is as for :func:`.record_command`.

        Raises OperationError: it was stopped, or the application ended by itself.
        """
        recorded = record_command(
            self.folder / name,
            launched.command,
            source=self.source,
            loops=self.loops,
            duration_ns=FIRST_LOOK_NS if name == "first" else self.duration_ns,
            chain=chain,
            scheduling=scheduling,
            plan=plan,
            gate_logs=gate_logs,
            command_stdout=sys.stderr.fileno(),
            watch_stalls=name != "first",
            stop=self.stop,
            progress=lambda share, doing: self.progress(share, f"{name}: {doing}"),
        )
        if self.stop.is_set() or recorded.exit_code is not None:
            ended = "was stopped" if recorded.exit_code is None else "ended by itself"
            path = recorded.recording.path
            raise OperationError(
                f"the application {ended} during the recording {path}, which stays;"
                " nothing was shaped"
            )
        return recorded.recording


def _refuse_early(
    request: PlanRequest,
    chains: Sequence[str],
    sinks: Sequence[str],
    throttled: Sequence[ThrottledInput],
    modes: bool,
) -> None:
    """Refuse what would be refused only after minutes of recording. Raises InputError."""
    requests.refuse_contradictions(request, sinks=bool(sinks), modes=modes)
    check_cores(dict.fromkeys(request.cores or (), "--cores"))
    if sinks and len(chains) > 1:
        raise InputError("--sink goes with one chain: name each output with a --chain of its own")
    for throttled_input in throttled:
        topic = throttled_input.topic
        if throttled_input.subscriber is None:
            raise InputError(
                f"which node gets {topic} is not known before the first recording: name it, as in"
                f" --throttle NODE:{topic}=PERIOD"
            )


def _with_throttlers(
    launched: _Launched, throttled: Sequence[ThrottledInput], folder: Path, node: NodeChoice
) -> _Launched:
    """Splice throttlers into the launch file; return the command that launches it with them."""
    launch = launched.launch
    splicing = launch_splicing.splice_throttlers(
        throttled, [launch.file], folder, node=node, builds=True
    )
    launch = replace(launch, file=next(iter(splicing.launch.values())))
    setup = tuple(_sourced(splicing))
    return _Launched((*setup, *launch.with_file(launch.file)), launch, setup)


def _first_look(
    recorder: _Recorder,
    launched: _Launched,
    chains: Sequence[str],
    sinks: Sequence[str],
    *,
    choose: Choose | None,
    request: PlanRequest,
    period_ns: int | None,
) -> _FirstLook:
    """Record the application briefly, to see its chains and to choose their cores.

    Raises InputError: the request cannot be fulfilled for these chains, however long they take.
    """
    first = recorder.record("first", launched)
    chains = chains or [_chosen(first, choose)]
    wanted = (*chains, *sinks)
    profiles, core_of = profiled_cores(first, wanted, request, period_ns)
    requests.refuse_entangled(profiles, request.policy, sinks=len(profiles) > len(chains))
    requests.refuse_simulated(profiles, request)
    if profiles and request.policy != "shaped":
        with suppress(OperationError):
            _planned(profiles, len(chains), request)
    return _FirstLook(first, len(chains), wanted, profiles, core_of)


def _chosen(first: Recording, choose: Choose | None) -> str:
    """Return the chain that is meant, of those that were recorded."""
    flow = recorded_flow(first)
    enumeration = list_chains(flow)
    if not enumeration.chains:
        raise InputError(
            f"{first.path}: no chain was seen: do its callbacks publish, and do others take that?"
        )
    if choose is None:
        known = ", ".join(candidate.spec for candidate in enumeration.chains[:5])
        raise InputError(f"which chain is meant? Name it with --chain: {known}")
    return choose(graph_of(flow), enumeration)


def _measured_before(
    recorder: _Recorder,
    launched: _Launched,
    look: _FirstLook,
    request: PlanRequest,
    profile: Callable[[Recording, Sequence[str]], tuple[Profile, ...]],
) -> _MeasuredBefore:
    """Record the chains under the profiling condition, and profile them.

    Chains that would delay each other are recorded one after the other. The notes are those of the
    recordings, and a first one if SCHED_FIFO is not permitted.
    """
    permitted = may_use_fifo()
    notes = [] if permitted else [NOT_PERMITTED]
    measured: dict[int, tuple[Recording, Profile]] = {}  # by place in `wanted`
    for number, places in enumerate(undelayed(look.profiles, look.core_of), start=1):
        chains = [look.wanted[place] for place in places]
        # Nodes behind the shaped output, as those of a loop that reads it, have no core here.
        nodes = [*chain_nodes(look.recording, *chains)]
        cores = {node: look.core_of[node] for node in nodes if node in look.core_of}
        condition = profiling_condition(
            cores,
            cores,
            like=look.recording,
            before=requests.stages_before(look.profiles, request),
            best_effort=requests.best_effort_cores(look.profiles, request, look.core_of),
            policy=request.policy,
        )
        recording = recorder.record(
            "before" if number == 1 else f"before_{number}",
            launched,
            scheduling=condition if permitted else None,
            chain=chains[0],
        )
        notes += recording.info.notes
        for place, of_chain in zip(places, profile(recording, chains), strict=True):
            measured[place] = recording, of_chain
    recordings, profiles = zip(*(measured[place] for place in range(len(look.wanted))), strict=True)
    return _MeasuredBefore(recordings, profiles, tuple(notes))


def _planned(
    profiles: Sequence[Profile], chains: int, request: PlanRequest
) -> tuple[Plan, list[str]]:
    """Plan the first of the profiles and its sinks, or all, on the cores where they were measured.

    Returns the plan, and what a person must know about it.
    """
    if request.policy != "pipelined":  # whose stages may have a core twice
        request = replace(request, cores=None)
    texts = (text for profile in profiles[:chains] for text in doubts_about(profile))
    doubts = list(dict.fromkeys(texts))
    if chains > 1:
        plan, remarks = planning.plan_application(profiles, request)
        return plan, remarks + doubts
    return Plan.of(planning.plan_chain(profiles[0], request, profiles[1:])), doubts


def _with_shaping_nodes(
    launched: _Launched,
    plan: Plan,
    folder: Path,
    node: NodeChoice,
    recordings: Sequence[Recording],
) -> Splicing:
    """Splice the plan's shaping nodes into the launch file."""
    return launch_splicing.splice_launch_files(
        plan,
        [launched.launch.file],
        folder,
        node=node,
        builds=True,
        recording=_with_types(recordings, plan),
    )


def _with_types(recordings: Sequence[Recording], plan: Plan) -> Recording:
    """Return the first recording by whose end discovery had shown the types of all outputs.

    If none has, return the first of all.
    """
    outputs = {node.output for node in plan.shaping_nodes}

    def knows_types(recording: Recording) -> bool:
        return outputs <= {end.topic for end in recording.info.endpoints if end.type}

    return next(filter(knows_types, recordings), recordings[0])


def _has_packages(splicing: Splicing) -> bool:
    """Return whether some of our nodes are to be built."""
    return any(process.package is not None for process in splicing.processes)


def _sourced(splicing: Splicing) -> list[str]:
    """Build our nodes; return the words before a command that source the environment they need."""
    if not _has_packages(splicing):
        return []
    setup = build_package(splicing.folder / NODES)
    return ["bash", "-c", 'source "$0" && exec "$@"', str(setup)]


def _recorded_after(
    recorder: _Recorder,
    launched: _Launched,
    plan: Plan,
    splicing: Splicing | None,
    in_force: Scheduling,
    *,
    chain: str,
) -> Recording:
    """Record the application with its shaping nodes and the plan in force."""
    try:
        return recorder.record(
            "after",
            launched,
            scheduling=in_force,
            plan=plan,
            gate_logs=() if splicing is None else splicing.logs,
            chain=chain,
        )
    finally:
        remove_abandoned_pages()  # of the shaping nodes, which have ended


def _compared(
    wanted: Sequence[str], before: Sequence[Recording], after: Recording, folder: Path
) -> tuple[Comparison, ...]:
    """Compare each chain and sink before and after, and write the figures into the folder."""
    comparisons = tuple(
        compare_recordings([recording, after], chain)
        for chain, recording in zip(wanted, before, strict=True)
    )
    for place, comparison in enumerate(comparisons):
        results = folder / f"chain_{place + 1}" if place else folder
        write_comparison(comparison, results)
        write_report([comparison], results / "report.html")
    return comparisons


@contextmanager
def plan_in_force(
    plan: Plan,
    back_end: str,
    recording: Recording,
    users: frozenset[int],
    notes: list[str],
    *,
    adapt: bool = False,
    max_latency_ns: int | None = None,
) -> Iterator[Callable[[Sequence[RunningProcess]], bool]]:
    """Have a thread apply the plan to what runs, until the context ends.

    Yields a function that says whether all servers have opened and, for ``IN_STEP_NS`` at most,
    whether outputs and loops are in step. At the end the notes of the run are added to ``notes``.
    """
    stop, states = threading.Event(), list[RunState]()
    loops = {loop.node for _, _, loop in loops_in_step(plan)}
    opened_ns: int | None = None  # when all servers were first seen to have opened
    with ThreadPoolExecutor(1, "apply") as beside:
        applied = beside.submit(
            apply_plan,
            plan,
            back_end=back_end,
            recording=recording,
            adapt=adapt,
            max_latency_ns=max_latency_ns,
            wait_ns=START_NS,
            users=users,
            stop=stop,
            watch=states.append,
        )

        def opened(_: Sequence[RunningProcess]) -> bool:
            nonlocal opened_ns
            if applied.done():
                applied.result()  # raises what it failed with
                raise OperationError("the plan was released meanwhile")
            if not states:
                return False
            state = states[-1]
            ours = [server for server in state.servers if server.kept_by == state.back_end]
            if not all(server.counters.slots for server in ours):
                return False
            opened_ns = opened_ns or time.monotonic_ns()
            in_step = {step.loop for step in state.steps if step.moved_ns is not None}
            return loops <= in_step or time.monotonic_ns() - opened_ns > IN_STEP_NS

        try:
            yield opened
        finally:
            stop.set()
    notes += applied.result().state.notes
