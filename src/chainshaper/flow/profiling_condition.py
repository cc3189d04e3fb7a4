"""The paper's profiling condition: a chain alone with its interference (sections 2.5 and 4.2).

The executors of the nodes of the chain, and of the branches that it waits for, run under SCHED_FIFO
at a high priority, on one core or distributed over several (:mod:`chainshaper.planning.cores`),
their DDS threads above them on the others. Threads that appear later get theirs at the next look.
"""

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

from chainshaper.analysis import find_chain, graph_of, recorded_flow
from chainshaper.enforcement.guardian import run_claimed
from chainshaper.enforcement.node_threads import Allocation, NodeThread, allocate
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import ReservationServer
from chainshaper.enforcement.thread_scheduling import scheduling_around
from chainshaper.flow.plan import profile_chains
from chainshaper.flow.recorded_processes import recorded_processes
from chainshaper.flow.recorded_profile.stages import graph_stages, taking_part
from chainshaper.linux.processes import RunningProcess
from chainshaper.linux.scheduling import (
    SchedulingRequest,
    available_cores,
    check_cores,
    may_use_fifo,
)
from chainshaper.planning.chain_plan import PER_CALLBACK
from chainshaper.planning.profile import Profile
from chainshaper.planning.request import PlanRequest, cores_for
from chainshaper.planning.several_chains import beginning_together
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError, OperationError, PlatformError
from chainshaper.values.plan_choices import Policy
from chainshaper.values.recording import Recording

START_NS = 30_000_000_000  # so long the nodes have to appear
WORTH = 0.05  # a further core is taken unasked if it takes this share off the latencies


@contextmanager
def profiling_condition(
    nodes: Collection[str] = (),
    core: int | Mapping[str, int] | None = None,
    folder: Path | None = None,
    like: Recording | None = None,
    *,
    before: Mapping[str, int] = MappingProxyType({}),
    best_effort: Mapping[str, int] = MappingProxyType({}),
    policy: Policy = "shaped",
) -> Iterator[Callable[[Sequence[RunningProcess]], bool]]:
    """Have threads run as the paper profiles a chain, until the context ends.

    It is the ``scheduling`` of :func:`.record_command`.

    * ``nodes``: those whose threads are scheduled, in the order of a plan of this ``policy``: the
      first are the most urgent (default: all nodes, at one priority).
    * ``core``: where the executors run, or the core of each node (default: the last that we may
      use).
    * ``folder``: for journals (default: `/run/chainshaper`).
    * ``like``: an earlier recording of the application, which knows components and executors'
      threads.
    * ``before``: of each node, how many stages of a pipeline are more urgent on its core.
    * ``best_effort``: the core of each node that runs when these do not.

    Raises PlatformError: no such core, or SCHED_FIFO is not permitted. OperationError: `apply`
    governs one of the nodes, or the core; a node does not appear; not all could be changed or put
    back.
    """
    wanted, core_of = frozenset(nodes), core if isinstance(core, Mapping) else {}
    order = tuple(nodes)[: 1 if policy in PER_CALLBACK else None]
    cores = check_profiling([core] if isinstance(core, int) else [*dict.fromkeys(core_of.values())])
    homes = {(core, before.get(node, 0)) for node, core in core_of.items()} or {(cores[0], 0)}
    servers = {
        (core, rank): ReservationServer(f"core {core}, {rank}", core, 1 + rank, ())
        for core, rank in homes
    }
    recorded = recorded_processes(like)[0] if like is not None else ()
    begun_ns, done = time.monotonic_ns(), set[tuple[int, int]]()
    appeared = False

    def schedule(processes: Sequence[RunningProcess]) -> bool:
        """Schedule new threads; return whether all nodes' threads are, and none was new."""
        nonlocal appeared
        allocation = allocate(processes, recorded)
        there = {node for listed in allocation.threads for node in listed.nodes}
        members = executors_of(allocation, wanted, processes)
        if not members or not wanted <= there:
            # Of an application that ends, or a node that is started again, the recording goes on.
            if not appeared and time.monotonic_ns() - begun_ns > START_NS:
                missing, running = ", ".join(sorted(wanted - there)), ", ".join(sorted(there))
                raise OperationError(
                    f"{f'node {missing}' if missing else 'a node'} has not appeared within"
                    f" {duration_text(START_NS)}; running: {running or 'no node'}"
                )
            return False
        appeared = True
        at_home: dict[str, list[NodeThread]] = {server.name: [] for server in servers.values()}
        for member in members:
            node = next((node for node in member.nodes if node in core_of), "")
            server = servers[core_of.get(node, cores[0]), before.get(node, 0)]
            at_home[server.name].append(member)
        clear = cores[:1] if len(cores) > 1 else ()  # the plan's, whose output it has mostly
        around = scheduling_around(
            at_home, servers.values(), allocation, available_cores(), order=order, clear=clear
        )
        requests = [(planned.node_thread.thread, planned.scheduling) for planned in around]
        requests += [
            (listed.thread, SchedulingRequest(0, (best_effort[node],)))
            for listed in allocation.threads
            if listed.thread.role == "executor" and listed not in members
            for node in listed.nodes
            if node in best_effort
        ]
        new = [(thread, request) for thread, request in requests if thread.identity not in done]
        change_all(journal, new)
        done.update(thread.identity for thread, _ in new)
        return not new

    with run_claimed(cores, nodes, folder) as journal:
        yield schedule


def check_profiling(cores: Sequence[int] | None) -> Sequence[int]:
    """Return the cores on which executors will run.

    Raises InputError: a core is named twice. PlatformError: no such core, or SCHED_FIFO is not
    permitted.
    """
    cores = cores or available_cores()[-1:]
    if len(set(cores)) < len(cores):
        raise InputError("--cores names a core twice: name each once")
    if not may_use_fifo():
        raise PlatformError(
            "profiling needs SCHED_FIFO: run as root, or give your user an rtprio limit of 98 in "
            "/etc/security/limits.conf; without, `chainshaper record` records as things are"
        )
    check_cores(dict.fromkeys(cores, "the chain"))
    return cores


def chain_nodes(recording: Recording, *chains: str) -> tuple[str, ...]:
    """Return the nodes of recorded chains, each in order, then those of its branches."""
    graph = graph_of(recorded_flow(recording))
    nodes = list[str]()
    for spec in chains:
        chain = find_chain(graph, spec)
        nodes += taking_part(graph, chain, graph_stages(graph, chain))
    return tuple(dict.fromkeys(nodes))


def profiled_cores(
    recording: Recording, chains: Sequence[str], request: PlanRequest, period_ns: int | None = None
) -> tuple[tuple[Profile, ...], dict[str, int]]:
    """Return what an earlier recording shows of chains, and each node's core to profile it on.

    Without ``request.cores`` these are the last core, and others as far as they are worth it; of
    three and more, the first is for DDS threads. A chain of which too little is to be seen runs on
    the last, and has no profile.

    Raises: as :func:`.profile_chains`; PlatformError: no such core.
    """
    available = available_cores()
    offered = (available[1:] if len(available) > 2 else available)[::-1]
    cores, worth = (offered, WORTH) if request.cores is None else (request.cores, 0.0)
    check_cores(dict.fromkeys(cores, "the chain"))
    try:
        seen = profile_chains(recording, chains, period_ns=period_ns)
    except (InputError, OperationError):
        if len(chains) > 1 or len(request.cores or ()) > 1:
            raise
        return (), dict.fromkeys(chain_nodes(recording, *chains), cores[0])
    core_of = cores_for(seen, cores, request, worth)
    return seen, {node: core_of[node] for profile in seen for node in profile.core_of}


def undelayed(seen: Sequence[Profile], core_of: Mapping[str, int]) -> list[list[int]]:
    """Group chains, by their places, that a recording can measure together as if alone."""
    groups: list[tuple[list[int], set[int]]] = []  # places of chains, and the cores they have
    for together in beginning_together(seen):
        cores = {core_of[node] for place in together for node in seen[place].core_of}
        for places, taken in groups:
            if taken.isdisjoint(cores):
                places.extend(together)
                taken.update(cores)
                break
        else:
            groups.append((list(together), cores))
    return [places for places, _ in groups] or [[0]]


def executors_of(
    allocation: Allocation, nodes: frozenset[str], processes: Sequence[RunningProcess]
) -> list[NodeThread]:
    """Return the threads that execute these nodes or publish for them.

    Without nodes, they are those of all nodes, but for launchers.
    """
    running = [
        listed for listed in allocation.threads if listed.thread.role in ("executor", "publisher")
    ]
    if nodes:
        return [listed for listed in running if not nodes.isdisjoint(listed.nodes)]
    owners = {listed.thread.pid for listed in allocation.threads if listed.nodes}
    launchers = {process.parent for process in processes if process.pid in owners}
    return [listed for listed in running if listed.nodes and listed.thread.pid not in launchers]
