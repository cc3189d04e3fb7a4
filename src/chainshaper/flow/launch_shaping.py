"""Shaping a real application from measuring to the proof: `chainshaper shape -- ros2 launch …`.

    first/ ─► which chain ─► before/ ─► plan.yaml ─► launch/ ─► after/ ─► comparison.json, figures
    record                   profile    plan         splice     apply,
                                                                recorded

Each step is what the verb of its name does, and leaves its result in the folder. The first, short
recording tells which chains there are and which nodes a chain has; the second measures it under the
paper's profiling condition (section 2.4), as far as that is permitted.
"""

import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from chainshaper.analysis import ChainEnumeration, data_flow, graph_of
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.apply import START_NS, apply_plan
from chainshaper.flow.exploration import list_chains
from chainshaper.flow.launch_splicing import Splicing, splice_launch_files
from chainshaper.flow.plan import plan_recording
from chainshaper.flow.profiling import chain_nodes, profiling_condition
from chainshaper.flow.record import record_command
from chainshaper.linux.processes import Process, run_users
from chainshaper.linux.scheduling import may_use_fifo
from chainshaper.planning import Plan, PlanRequest, save_plan
from chainshaper.reporting.figures import write_comparison
from chainshaper.splicing.shaping_process import NodeKind, build_package, check_build_tools
from chainshaper.splicing.spliced_launch import NODES, LaunchCommand, parse_launch_command
from chainshaper.values.application import ApplicationGraph
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording, refuse_existing
from chainshaper.verify.measure import Comparison, compare_recordings

FIRST_LOOK_NS = 10_000_000_000  # long enough for everything to have started and run

Choose: TypeAlias = Callable[[ApplicationGraph, ChainEnumeration], str]
"""Asked which of the chains that were found is meant."""


@dataclass(frozen=True)
class ShapedLaunch:
    """What came of it; everything lies in ``folder`` too."""

    folder: Path
    chain: str
    plan: Plan
    splicing: Splicing
    comparison: Comparison
    notes: tuple[str, ...]


def shape_launch(
    command: Sequence[str],
    folder: str | Path,
    *,
    chain: str | None = None,
    choose: Choose | None = None,
    request: PlanRequest | None = None,
    duration_ns: int = 60_000_000_000,
    source: Literal["lttng", "ebpf"] = "lttng",
    node: NodeKind = "python",
    back_end: str = "auto",
    users: Collection[str | int] = (),
    stop: threading.Event | None = None,
    planned: Callable[[Plan], None] = lambda _: None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> ShapedLaunch:
    """Measure a chain of a launched application, plan, splice, apply, and measure again.

    ``chain`` is the one to shape; without it, ``choose`` is asked. The application is launched
    three times: briefly, and for ``duration_ns`` before and after. ``planned``
    gets the plan before it is used, to say what is doubtful about it. ``stop`` ends the step that
    is under way, and with it everything. ``users`` are for :func:`.apply_plan`.

    Raises:
        InputError: ``folder`` is not empty, the command is not `ros2 launch`, or what it launches
            does not fit: no such chain, a launch file with a mistake …
        PlatformError, OperationError: a step failed; what the steps before it left is kept.
    """
    launch = parse_launch_command(command)
    if node != "python":
        check_build_tools()
    folder, stop = refuse_existing(folder), stop or threading.Event()
    taken = run_users(users)
    folder.mkdir(exist_ok=True)

    def record(name: str, words: Sequence[str], lasting_ns: int, **how: Any) -> Recording:
        done = record_command(
            folder / name,
            words,
            source=source,
            duration_ns=lasting_ns,
            command_stdout=sys.stderr.fileno(),
            stop=stop,
            progress=lambda share, what: progress(share, f"{name}: {what}"),
            **how,
        )
        if stop.is_set() or done.exit_code is not None:
            how_it_ended = "was stopped" if done.exit_code is None else "ended by itself"
            raise OperationError(
                f"the application {how_it_ended} during the recording {done.recording.path}, "
                "which is kept; nothing was shaped"
            )
        return done.recording

    first = record("first", command, FIRST_LOOK_NS)
    chain = _chain(first, chain, choose)
    permitted = may_use_fifo()  # else it is measured under ordinary scheduling
    profiled = profiling_condition(chain_nodes(first, chain), like=first) if permitted else None
    measured: dict[str, Any] = {"chain": chain, "watch_stalls": True}
    before = record("before", command, duration_ns, scheduling=profiled, **measured)
    progress(0.0, "planning")
    plan = plan_recording(before, chain, request or PlanRequest())
    save_plan(plan, folder / "plan.yaml")
    planned(plan)
    splicing = splice_launch_files(
        *(plan, [launch.file], folder / "launch"),
        node=node,
        arguments=launch.arguments,
        recording=first,
    )
    after = record(
        "after",
        _with_shaping_node(launch, splicing),
        duration_ns,
        scheduling=_in_force(plan, back_end, first, taken, applied := list[str]()),
        plan=plan,
        gate_logs=splicing.logs,
        **measured,
    )
    progress(0.0, "comparing")
    comparison = compare_recordings([before, after], chain)
    write_comparison(comparison, folder)
    found = [*before.info.notes, *splicing.notes, *applied, *after.info.notes]
    if not permitted:
        found.insert(0, "measured under ordinary scheduling: SCHED_FIFO is not permitted.")
    return ShapedLaunch(folder, chain, plan, splicing, comparison, tuple(dict.fromkeys(found)))


def _chain(first: Recording, chain: str | None, choose: Choose | None) -> str:
    """The chain that is meant; names that no recorded chain has are refused where it is used."""
    if chain is not None:
        return chain
    flow = data_flow(first.events, first.info.clock_offset_ns)
    found = list_chains(flow)
    if not found.chains:
        raise InputError(
            f"{first.path}: no chain was seen: do its callbacks publish, and do others take that?"
        )
    if choose is None:
        raise InputError(
            "which chain is meant? Name it with --chain: "
            + ", ".join(one.spec for one in found.chains[:5])
        )
    return choose(graph_of(flow), found)


def _with_shaping_node(launch: LaunchCommand, splicing: Splicing) -> list[str]:
    """The command that launches both, in the environment that the shaping node needs."""
    words = launch.with_file(next(iter(splicing.launch.values())))
    if all(process.package is None for process in splicing.processes):
        return words
    setup = build_package(splicing.folder / NODES)
    return ["bash", "-c", 'source "$0" && exec "$@"', str(setup), *words]


@contextmanager
def _in_force(
    plan: Plan, back_end: str, recording: Recording, users: frozenset[int], notes: list[str]
) -> Iterator[Callable[[Sequence[Process]], bool]]:
    """The plan in force on what runs; what it gives says whether all servers have opened.

    A thread of its own does what `chainshaper apply` does, until the context ends; ``notes`` are
    what it has to say then.
    """
    stop, states = threading.Event(), list[RunState]()
    with ThreadPoolExecutor(1, "apply") as beside:
        applied = beside.submit(
            apply_plan,
            plan,
            back_end=back_end,
            recording=recording,
            wait_ns=START_NS,
            users=users,
            stop=stop,
            watch=states.append,
        )

        def opened(_: Sequence[Process]) -> bool:
            if applied.done():
                applied.result()  # raises what it failed with
                raise OperationError("the plan was released meanwhile")
            if not states:
                return False
            ours = [one for one in states[-1].servers if one.kept_by == states[-1].back_end]
            return all(server.counters.slots for server in ours)

        try:
            yield opened
        finally:
            stop.set()
    notes += applied.result().state.notes
