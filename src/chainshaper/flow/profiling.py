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
    """Have the threads of ``nodes`` (default: of all, at one priority) run as the paper profiles a
    chain: what :func:`.record_command` wants for its ``scheduling``.

    The first of ``nodes`` are the most urgent, as in a plan of this ``policy``. ``core`` is where
    the executors run (default: the last that we may use), or the core of each of ``nodes``,
    ``before`` how many stages of a pipeline are more urgent there, and ``best_effort`` the core of
    nodes that run when these do not. ``folder`` is for journals (default: `/run/chainshaper`).
    An earlier recording that this one is ``like`` knows components and executors' threads.

    Raises PlatformError: no such core, or SCHED_FIFO is not permitted. OperationError: `apply`
    governs one of the nodes, or the core; a node does not appear; not all could be changed or put
    back.
    """
    wanted, core_of = frozenset(nodes), core if isinstance(core, Mapping) else {}
    order = tuple(nodes)[: 1 if policy in PER_CALLBACK else None]
    cores = check_profiling([core] if isinstance(core, int) else [*dict.fromkeys(core_of.values())])
    homes = {(core, before.get(node, 0)) for node, core in core_of.items()} or {(cores[0], 0)}
    servers = {(c, k): ReservationServer(f"core {c}, {k}", c, 1 + k, ()) for c, k in homes}
    recorded = recorded_processes(like)[0] if like is not None else ()
    begun_ns, done = time.monotonic_ns(), set[tuple[int, int]]()
    appeared = False

    def see_to_it(processes: Sequence[RunningProcess]) -> bool:
        """Give new threads what they shall have; whether all nodes have it, and nothing was new."""
        nonlocal appeared
        found = allocate(processes, recorded)
        there = {node for one in found.threads for node in one.nodes}
        members = executors_of(found, wanted, processes)
        if not members or not wanted <= there:
            # Of an application that ends, or a node that is started again, the recording goes on.
            if not appeared and time.monotonic_ns() - begun_ns > START_NS:
                missing, running = (", ".join(sorted(n)) for n in (wanted - there, there))
                raise OperationError(
                    f"{f'node {missing}' if missing else 'a node'} has not appeared within"
                    f" {duration_text(START_NS)}; running: {running or 'no node'}"
                )
            return False
        appeared = True
        at_home: dict[str, list[NodeThread]] = {server.name: [] for server in servers.values()}
        for one in members:
            node = next((node for node in one.nodes if node in core_of), "")
            server = servers[core_of.get(node, cores[0]), before.get(node, 0)]
            at_home[server.name].append(one)
        clear = cores[:1] if len(cores) > 1 else ()  # the plan's, whose output it has mostly
        around = scheduling_around(
            *(at_home, servers.values(), found, available_cores()), order=order, clear=clear
        )
        wishes = [(wanted.node_thread.thread, wanted.scheduling) for wanted in around]
        wishes += [
            (one.thread, SchedulingRequest(0, (best_effort[node],)))
            for one in found.threads
            if one.thread.role == "executor" and one not in members
            for node in one.nodes
            if node in best_effort
        ]
        new = [(thread, wish) for thread, wish in wishes if thread.identity not in done]
        change_all(journal, new)
        done.update(thread.identity for thread, _ in new)
        return not new

    with run_claimed(cores, nodes, folder) as journal:
        yield see_to_it


def check_profiling(cores: Sequence[int] | None) -> Sequence[int]:
    """The cores on which executors will run. Raises InputError: a core is named twice.
    PlatformError: no such core, or SCHED_FIFO is not permitted.
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
    """The nodes of recorded chains, each in order, then those of the branches that it waits for."""
    graph = graph_of(recorded_flow(recording))
    found = ((one, graph_stages(graph, one)) for one in (find_chain(graph, c) for c in chains))
    return tuple(dict.fromkeys(node for own in found for node in taking_part(graph, *own)))


def profiled_cores(
    recording: Recording, chains: Sequence[str], request: PlanRequest, period_ns: int | None = None
) -> tuple[tuple[Profile, ...], dict[str, int]]:
    """What an earlier recording shows of chains, and on which cores to profile their executors:
    without ``request.cores`` the last, and others as far as they are worth it, but the first of
    three and more, for DDS threads. One chain of which too little is to be seen runs on the last.

    Raises: as :func:`.profile_chains`; PlatformError: no such core.
    """
    available = available_cores()
    found = (available[1:] if len(available) > 2 else available)[::-1]
    cores, worth = (found, WORTH) if request.cores is None else (request.cores, 0.0)
    check_cores(dict.fromkeys(cores, "the chain"))
    try:
        seen = profile_chains(recording, chains, period_ns=period_ns)
    except (InputError, OperationError):
        if len(chains) > 1 or len(request.cores or ()) > 1:
            raise
        return (), dict.fromkeys(chain_nodes(recording, *chains), cores[0])
    core_of = cores_for(seen, cores, request, worth)
    return seen, {node: core_of[node] for one in seen for node in one.core_of}


def undelayed(seen: Sequence[Profile], core_of: Mapping[str, int]) -> list[list[int]]:
    """The places of chains, those together that one recording can measure as if alone."""
    found: list[tuple[list[int], set[int]]] = []
    for group in beginning_together(seen):
        cores = {core_of[node] for place in group for node in seen[place].core_of}
        apart = next((one for one in found if one[1].isdisjoint(cores)), None)
        if apart is None:
            found.append(apart := ([], set()))
        apart[0].extend(group)
        apart[1].update(cores)
    return [places for places, _ in found] or [[0]]


def executors_of(
    found: Allocation, nodes: frozenset[str], processes: Sequence[RunningProcess]
) -> list[NodeThread]:
    """The threads that execute these nodes or publish for them; by default all but launchers'."""
    running = [one for one in found.threads if one.thread.role in ("executor", "publisher")]
    if nodes:
        return [one for one in running if not nodes.isdisjoint(one.nodes)]
    owners = {one.thread.pid for one in found.threads if one.nodes}
    launchers = {one.parent for one in processes if one.pid in owners}
    return [one for one in running if one.nodes and one.thread.pid not in launchers]
