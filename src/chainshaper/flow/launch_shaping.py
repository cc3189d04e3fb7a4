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
from chainshaper.flow.launch_splicing import Splicing, ThrottledInput
from chainshaper.flow.plan import profile_chains
from chainshaper.flow.profiling import chain_nodes, profiled_cores, profiling_condition, undelayed
from chainshaper.flow.record import Scheduling, record_command
from chainshaper.linux.processes import RunningProcess, run_users
from chainshaper.linux.scheduling import check_cores, may_use_fifo
from chainshaper.planning import ChainPlan, Plan, PlanRequest, Profile
from chainshaper.planning import request as requests
from chainshaper.planning.profile import doubts_about
from chainshaper.reporting.figures import write_comparison
from chainshaper.splicing.node_kinds import language_of
from chainshaper.splicing.node_packages import build_package, check_build_tools
from chainshaper.splicing.shaped_outputs import remove_abandoned_pages
from chainshaper.splicing.spliced_launch import NODES, parse_launch_command
from chainshaper.values.application import ApplicationGraph
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import NodeChoice
from chainshaper.values.recording import Recording, refuse_existing
from chainshaper.verify.measure import Comparison, compare_recordings

FIRST_LOOK_NS = 10_000_000_000  # long enough for everything to have started and run
NOT_PERMITTED = "measured under ordinary scheduling: SCHED_FIFO is not permitted."


@dataclass(frozen=True)
class ShapedLaunch:
    """What came of it; everything lies in ``folder`` too."""

    folder: Path
    chain: str  # the first
    plan: ChainPlan  # of the first chain
    splicing: Splicing | None  # None: no output has a shaping node
    comparison: Comparison  # of the first chain
    notes: tuple[str, ...]
    application: Plan
    comparisons: tuple[Comparison, ...]  # of every chain and sink
    cores: Mapping[str, int]  # where each node's executor ran


Choose: TypeAlias = Callable[[ApplicationGraph, ChainEnumeration], str]  # which chain is meant


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

    ``chain`` is the one to shape, or several; without it, ``choose`` is asked. ``sinks`` are chains
    to further outputs of the graph of one chain, ``throttled`` inputs with the nodes that get them
    by way of a throttler, from the first recording on. ``request.cores`` are where executors run
    (default: the last core, and others that are worth it). The application is launched briefly, and
    for ``duration_ns`` before and after. ``planned`` gets the plan before it is used. ``stop`` ends
    everything. The rest is for :func:`.profile_chains` and :func:`.apply_plan`.

    Raises InputError: ``folder`` is not empty, the command is not `ros2 launch`, or what it
    launches does not fit. PlatformError, OperationError: there is no such core, or a step failed;
    what the steps before it left stays.
    """
    launch, request = parse_launch_command(command), request or PlanRequest()
    chains = [chain] if isinstance(chain, str) else [*(chain or ())]
    _refuse_early(request, chains, sinks, throttled, bool(mode_recordings))
    if language_of(node, builds=True)[0] == "cpp":
        check_build_tools()
    folder, user_ids = refuse_existing(folder), run_users(users)
    folder.mkdir(exist_ok=True)
    recorder = _Recorder(folder, source, stop or threading.Event(), progress)
    shaped, setup = list(command), list[str]()
    if throttled:
        request = replace(request, anchor="cycle")  # messages have the stamps of their sensors
        inputs = launch_splicing.splice_throttlers(
            throttled, [launch.file], folder / "throttled", node=node, builds=True
        )
        launch, setup = replace(launch, file=next(iter(inputs.launch.values()))), _sourced(inputs)
        shaped = [*setup, *launch.with_file(launch.file)]
    first = recorder.record("first", shaped, FIRST_LOOK_NS)
    chains = chains or [_chosen(first, choose)]
    wanted = (*chains, *sinks)
    seen, core_of = profiled_cores(first, wanted, request, period_ns)
    _refuse_at_first_look(seen, len(chains), request)
    look = _FirstLook(first, wanted, seen, core_of)
    profile = partial(
        profile_chains,
        period_ns=period_ns,
        since_ns=since_ns,
        until_ns=until_ns,
        modes=request.modes,
        mode_recordings=mode_recordings or {},
    )
    notes: list[str] = []
    measured = _measured(
        recorder,
        shaped,
        duration_ns=duration_ns,
        look=look,
        request=request,
        profile=profile,
        notes=notes,
    )
    progress(0.0, "planning")
    profiles = [measured[place].profile for place in range(len(wanted))]
    plan, remarks = _planned(profiles, len(chains), request)
    planning.save_plan(plan, folder / "plan.yaml")
    planned(plan)
    notes += remarks
    splicing = None
    if plan.shaping_nodes:
        recordings = [first, *(chain.recording for chain in measured.values())]
        splicing = launch_splicing.splice_launch_files(
            plan,
            [launch.file],
            folder / "launch",
            node=node,
            builds=True,
            recording=_with_types(recordings, plan),
        )
        notes += splicing.notes
        shaped = [*setup, *_sourced(splicing), *launch.with_file(*set(splicing.launch.values()))]
    in_force = plan_in_force(
        plan, back_end, first, user_ids, notes, adapt=adapt, max_latency_ns=max_latency_ns
    )
    try:
        after = recorder.record(
            "after",
            shaped,
            duration_ns,
            scheduling=in_force,
            plan=plan,
            gate_logs=() if splicing is None else splicing.logs,
            chain=chains[0],
        )
    finally:
        remove_abandoned_pages()  # of the shaping nodes, which have ended
    progress(0.0, "comparing")
    comparisons = [
        compare_recordings([measured[place].recording, after], chain_or_sink)
        for place, chain_or_sink in enumerate(wanted)
    ]
    for place, comparison in enumerate(comparisons):
        write_comparison(comparison, folder / f"chain_{place + 1}" if place else folder)
    notes += after.info.notes
    return ShapedLaunch(
        folder=folder,
        chain=chains[0],
        plan=plan.chains[0],
        splicing=splicing,
        comparison=comparisons[0],
        notes=tuple(dict.fromkeys(notes)),
        application=plan,
        comparisons=tuple(comparisons),
        cores=core_of,
    )


@dataclass(frozen=True)
class _FirstLook:
    """What the first, short recording shows of the chains and sinks that are wanted."""

    recording: Recording
    wanted: tuple[str, ...]
    profiles: Sequence[Profile]
    core_of: Mapping[str, int]  # where each node's executor runs


@dataclass(frozen=True)
class _MeasuredChain:
    """A chain's profile, and the recording that it is of."""

    recording: Recording
    profile: Profile


def _measured(
    recorder: "_Recorder",
    command: Sequence[str],
    *,
    duration_ns: int,
    look: _FirstLook,
    request: PlanRequest,
    profile: Callable[[Recording, Sequence[str]], tuple[Profile, ...]],
    notes: list[str],
) -> dict[int, _MeasuredChain]:
    """Record the chains under the profiling condition; what was measured, by place in ``wanted``.

    Chains that would delay each other are recorded one after the other. ``notes`` gets the notes of
    the recordings, and a first one if SCHED_FIFO is not permitted.
    """
    permitted = may_use_fifo()
    if not permitted:
        notes.append(NOT_PERMITTED)
    measured: dict[int, _MeasuredChain] = {}
    for number, places in enumerate(undelayed(look.profiles, look.core_of), start=1):
        chains = [look.wanted[place] for place in places]
        cores = {node: look.core_of[node] for node in chain_nodes(look.recording, *chains)}
        condition = profiling_condition(
            cores,
            cores,
            like=look.recording,
            before=requests.stages_before(look.profiles, request),
            best_effort=requests.best_effort_cores(look.profiles, request, look.core_of),
            policy=request.policy,
        )
        before = recorder.record(
            "before" if number == 1 else f"before_{number}",
            command,
            duration_ns,
            scheduling=condition if permitted else None,
            chain=chains[0],
        )
        notes += before.info.notes
        for place, of_chain in zip(places, profile(before, chains), strict=True):
            measured[place] = _MeasuredChain(before, of_chain)
    return measured


@dataclass(frozen=True)
class _Recorder:
    """Records the launched application again and again, into folders of one folder."""

    folder: Path
    source: Literal["lttng", "preload", "ebpf"] | None
    stop: threading.Event
    progress: Callable[[float, str], None]

    def record(
        self,
        name: str,
        command: Sequence[str],
        duration_ns: int,
        *,
        scheduling: Scheduling | None = None,
        plan: Plan | None = None,
        gate_logs: Sequence[Path] = (),
        chain: str | None = None,
    ) -> Recording:
        """Record for ``duration_ns``; the rest is as for :func:`.record_command`.

        Raises OperationError: it was stopped, or the application ended by itself.
        """
        recorded = record_command(
            self.folder / name,
            command,
            source=self.source,
            duration_ns=duration_ns,
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
    """What need not be tried: it would be refused minutes later."""
    requests.refuse_contradictions(request, sinks=bool(sinks), modes=modes)
    check_cores(dict.fromkeys(request.cores or (), "--cores"))
    if sinks and len(chains) > 1:
        raise InputError("--sink goes with one chain: name each output with a --chain of its own")
    if unknown := [one.topic for one in throttled if one.subscriber is None]:
        raise InputError(
            f"which node gets {unknown[0]} is not known before the first recording: name it, as in"
            f" --throttle NODE:{unknown[0]}=PERIOD"
        )


def _refuse_at_first_look(seen: Sequence[Profile], chains: int, request: PlanRequest) -> None:
    """What is not to be had of these chains, however long they take."""
    requests.refuse_entangled(seen, request.policy, sinks=len(seen) > chains)
    requests.refuse_simulated(seen, request)
    if seen and request.policy != "shaped":
        with suppress(OperationError):
            _planned(seen, chains, request)


def _planned(
    profiles: Sequence[Profile], chains: int, request: PlanRequest
) -> tuple[Plan, list[str]]:
    """The plan for the first of the profiles and its sinks, or for all; cores as measured."""
    if request.policy != "pipelined":  # whose stages may have a core twice
        request = replace(request, cores=None)
    doubts = list(dict.fromkeys(text for one in profiles[:chains] for text in doubts_about(one)))
    if chains > 1:
        plan, remarks = planning.plan_application(profiles, request)
        return plan, remarks + doubts
    return Plan.of(planning.plan_chain(profiles[0], request, profiles[1:])), doubts


def _with_types(recordings: Sequence[Recording], plan: Plan) -> Recording:
    """The first recording by whose end discovery had shown the types of all outputs, if any."""
    outputs = {node.output for node in plan.shaping_nodes}

    def knows(one: Recording) -> bool:
        return outputs <= {end.topic for end in one.info.endpoints if end.type}

    return next(filter(knows, recordings), recordings[0])


def _chosen(first: Recording, choose: Choose | None) -> str:
    """The chain that is meant, of those that were recorded."""
    flow = recorded_flow(first)
    found = list_chains(flow)
    if not found.chains:
        what = "no chain was seen: do its callbacks publish, and do others take that?"
        raise InputError(f"{first.path}: {what}")
    if choose is None:
        known = ", ".join(one.spec for one in found.chains[:5])
        raise InputError(f"which chain is meant? Name it with --chain: {known}")
    return choose(graph_of(flow), found)


def _sourced(splicing: Splicing) -> list[str]:
    """What stands before a command for the environment that our nodes need; they are built."""
    if all(process.package is None for process in splicing.processes):
        return []
    setup = build_package(splicing.folder / NODES)
    return ["bash", "-c", 'source "$0" && exec "$@"', str(setup)]


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
    """Have a thread apply the plan to what runs, as `chainshaper apply` does, until the context
    ends.

    Yields a function that says whether all servers have opened. At the end the notes of the run
    are added to ``notes``.
    """
    stop, states = threading.Event(), list[RunState]()
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
            if applied.done():
                applied.result()  # raises what it failed with
                raise OperationError("the plan was released meanwhile")
            if not states:
                return False
            state = states[-1]
            ours = [server for server in state.servers if server.kept_by == state.back_end]
            return all(server.counters.slots for server in ours)

        try:
            yield opened
        finally:
            stop.set()
    notes += applied.result().state.notes
