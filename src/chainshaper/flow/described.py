"""A described application, live, shaped by a plan."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import polars as pl

from chainshaper.enforcement.back_ends import choose_back_end, make_back_end
from chainshaper.enforcement.guardian import run_claimed
from chainshaper.flow.drift import SlotFollower
from chainshaper.flow.followed_chains import followed_chains
from chainshaper.flow.in_step import InStep, find_loop, loops_in_step, with_loops_as_they_are
from chainshaper.flow.server_tables import table_of
from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import Server, Thread
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.planning.plan_file import plan_values
from chainshaper.sources.preload import named_loops
from chainshaper.splicing.application import splice_application
from chainshaper.splicing.shaped_outputs import remove_abandoned_pages
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.event_declarations import LOOP_MOVES
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application
from chainshaper.workload.launcher import LOOP_NAME
from chainshaper.workload.live import (
    Enforcement,
    StartedNodes,
    Tables,
    node_threads,
    run_application,
    typed_table,
)


def shape_application(
    application: Application,
    plan: Plan,
    output: str | Path,
    *,
    cycles: int = 320,
    realtime: bool | None = None,
    enforcement: Enforcement | None = None,
    adapt: bool = False,
    max_latency_ns: int | None = None,
    command: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Recording:
    """Splice the plan's shaping nodes into an application, run it and record it.

    ``enforcement`` puts the plan's servers in force while it runs; without, the
    :func:`gated_threads` are gated. With ``adapt`` slots follow the latencies, to no later end than
    ``max_latency_ns`` (None: as the plan says). Where the plan has a loop in step, output or loop
    are moved so that they are: the loop's node runs with the tracing library in front for this.

    Raises InputError: the plan does not fit the application, or no slot can follow; PlatformError:
    threads cannot be frozen here; and as :func:`~chainshaper.workload.live.run_application`.
    """
    if enforcement is None and gated_threads(plan):
        enforcement = partial(threads_gated, plan)
    loops_in_front = dict[str, str]()
    if loops_in_step(plan, adapt):
        enforcement = partial(loops_kept_in_step, plan, enforcement)
        loops_in_front = named_loops.in_front_of([LOOP_NAME])
    if adapt:
        plan, reaches_ns, _ = followed_chains(plan, "fifo", max_latency_ns)
        enforcement = partial(slots_followed, plan, reaches_ns, enforcement)
    try:
        return run_application(
            splice_application(application, with_loops_as_they_are(plan)),
            output,
            cycles=cycles,
            realtime=realtime,
            plan=plan_values(plan),
            enforcement=enforcement,
            loops_in_front=loops_in_front,
            command=command,
            progress=progress,
        )
    finally:
        remove_abandoned_pages()  # of the shaping nodes, which have ended


def gated_threads(plan: Plan) -> list[tuple[Server, list[Thread]]]:
    """Return the servers without which a plan does not do what it says, and the threads they gate.

    These are publishers, stages of pipelines, and where servers close at their slots' ends all
    that is in them, but for shaping nodes that see to their slots themselves.
    """
    gates = {node.thread for node in plan.shaping_nodes}
    closed = _threads_in([chain for chain in plan.chains if chain.slot_ends == "closed"])
    closed -= plan.free_threads
    staged = _threads_in([chain for chain in plan.chains if chain.policy == "pipelined"])
    gating = list[tuple[Server, list[Thread]]]()
    for server in open_until_done(plan).servers:
        has_gate = not gates.isdisjoint(server.threads)
        gated = [
            thread
            for thread in server.threads
            if thread in closed
            or (not has_gate and (thread.role == "publisher" or thread in staged))
        ]
        if gated:
            gating.append((server, gated))
    return gating


def _threads_in(chains: Sequence[ChainPlan]) -> set[Thread]:
    """Return the threads in the servers of some chains."""
    return {thread for chain in chains for server in chain.servers for thread in server.threads}


@contextmanager
def threads_gated(plan: Plan, nodes: StartedNodes) -> Iterator[None]:
    """Gate the :func:`gated_threads` of a plan, until the context ends.

    They run in the slots of their servers only (paper, section 3.2.1, design 1).

    Raises PlatformError: threads cannot be frozen here. OperationError: another run governs one of
    the cores or nodes, a node has no such thread, or the servers failed meanwhile.
    """
    choice = choose_back_end("freezer")  # other back ends need threads of the fair class
    gating = gated_threads(plan)
    table = table_of(plan.cycle_ns, (server for server, _ in gating))
    cores = {server.core for server, _ in gating}
    governed = {thread.node for _, threads in gating for thread in threads}
    with run_claimed(cores, governed) as journal:
        servers = make_back_end(choice.name, table, journal)
        try:
            for server, threads in gating:
                for thread in threads:
                    for tid in _threads_of(thread, nodes):
                        servers.assign(tid, server.name)
            servers.arm(nodes.start_ns if plan.moves_timers else nodes.anchor_ns)
            yield
            failure = servers.failure()
        finally:
            servers.release()
    if failure is not None:
        raise OperationError(f"the servers failed while the application ran: {failure}")


def _in_force_from(plan: Plan, chain: ChainPlan, nodes: StartedNodes, _: int) -> int:
    """Return from when on slots may move: the middle of the second cycle from now on (ns).

    No slot is there.
    """
    anchor_ns = nodes.start_ns if plan.moves_timers else nodes.anchor_ns
    since = time.monotonic_ns() + 2 * chain.cycle_ns
    return since + (anchor_ns + chain.offset_ns + chain.cycle_ns // 2 - since) % chain.cycle_ns


@contextmanager
def slots_followed(
    plan: Plan,
    reaches_ns: Mapping[int, tuple[int, int]],
    enforcement: Enforcement | None,
    nodes: StartedNodes,
) -> Iterator[None]:
    """Have slots of gates follow latencies within their reach, until the context ends.

    ``enforcement`` is entered as well, if there is one; raises as that does.
    """
    with ExitStack() as until:
        if enforcement is not None:
            until.enter_context(enforcement(nodes))
        followers = []
        for place, reach_ns in reaches_ns.items():
            chain = plan.chains[place]
            in_force = partial(_in_force_from, plan, chain, nodes)
            follower = SlotFollower(chain, nodes.pids.values(), reach_ns, in_force)
            followers.append(follower)
            until.callback(follower.end)
        yield
    for follower in followers:
        if follower.failure is not None:
            raise follower.failure


@contextmanager
def loops_kept_in_step(
    plan: Plan, enforcement: Enforcement | None, nodes: StartedNodes
) -> Iterator[Tables]:
    """Keep outputs and loops in step, as a plan says, until the context ends.

    Gives the events of how loops were moved. ``enforcement`` is entered as well, if there is one;
    raises as that does.
    """
    with ExitStack() as until:
        if enforcement is not None:
            until.enter_context(enforcement(nodes))
        kept = list[InStep]()
        for _, chain, loop in loops_in_step(plan):
            if loop.node not in nodes.pids:
                raise InputError(f"{loop.node}, the plan's loop, is no node of the application")
            find = partial(find_loop, nodes.pids[loop.node], loop)
            step = InStep(
                chain, nodes.pids.values(), find, partial(_in_force_from, plan, chain, nodes)
            )
            kept.append(step)
            until.callback(step.end)
        yield partial(_moves_of_loops, kept, nodes)
    for step in kept:
        if step.failure is not None:
            raise step.failure


def _moves_of_loops(kept: Sequence[InStep], nodes: StartedNodes) -> dict[str, pl.DataFrame]:
    """Return the table of the event `loop_moved`; none where no loop was moved."""
    rows = [
        {
            "time": move.at_ns,
            "pid": nodes.pids[step.loop.node],
            "tid": step.tid,
            "cpu": None,
            "request": move.number,
            "asked": move.asked_ns,
            "added": move.added_ns,
            "kept": move.kept_ns,
            "why": LOOP_MOVES.index(move.why) if move.why in LOOP_MOVES else len(LOOP_MOVES),
        }
        for step in kept
        for move in step.loop_moves
    ]
    return {"loop_moved": typed_table("loop_moved", pl.DataFrame(rows))} if rows else {}


def _threads_of(planned: Thread, nodes: StartedNodes) -> list[int]:
    """Return the threads that run for a thread of the plan. Raises OperationError: none does."""
    pid, tids = nodes.pids.get(planned.node), list[int]()
    if pid is not None:
        tids = [thread.tid for thread in node_threads(pid) if thread.role == planned.role]
    if not tids and planned.role == "executor":
        raise OperationError(f"{planned.node} of the plan is no node of the application")
    if not tids:
        raise OperationError(
            f"{planned.node} has no thread that publishes for it: let it publish asynchronously "
            "(`publication: asynchronous` under `topics`), or plan with --publication synchronous"
        )
    return tids
