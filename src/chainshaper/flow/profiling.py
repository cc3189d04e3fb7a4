"""The paper's profiling condition: a chain alone with its interference (sections 2.5 and 4.2).

The executors of the chain's nodes run under SCHED_FIFO at a high priority on one core, their DDS
threads above them on the others, so that nothing else disturbs the chain. Threads are changed as
`apply` changes them; those that appear later get theirs at the next look.
"""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from chainshaper.analysis import data_flow, find_chain, graph_of
from chainshaper.enforcement.guardian import run_claimed
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import ReservationServer
from chainshaper.enforcement.threads import (
    Allocation,
    NodeThread,
    allocate,
    scheduling_around,
)
from chainshaper.flow.threads import recorded_processes
from chainshaper.linux.processes import Process
from chainshaper.linux.scheduling import available_cores, check_cores, may_use_fifo
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.recording import Recording

START_NS = 30_000_000_000  # so long the nodes have to appear


@contextmanager
def profiling_condition(
    nodes: Collection[str] = (),
    core: int | None = None,
    folder: Path | None = None,
    like: Recording | None = None,
) -> Iterator[Callable[[Sequence[Process]], bool]]:
    """Have the threads of ``nodes`` (default: of all) run as the paper profiles a chain.

    It gives what :func:`chainshaper.flow.record.record_command` wants for its ``scheduling``.
    ``core`` is where the executors run (default: the last that we may use), ``folder`` where
    journals are (default: `/run/chainshaper`). An earlier recording of the application that this
    one is ``like`` says which components a container has, and which executors several threads.

    Raises PlatformError: no such core, or SCHED_FIFO is not permitted. OperationError: `apply`
    governs one of the nodes, or the core; not all could be put back. And where it is called: a node
    does not appear, or the kernel refuses something.
    """
    core, wanted = check_profiling(core), frozenset(nodes)
    recorded = recorded_processes(like)[0] if like is not None else ()
    begun_ns, done = time.monotonic_ns(), set[tuple[int, int]]()

    def see_to_it(processes: Sequence[Process]) -> bool:
        """Give new threads what they shall have; whether all nodes have it, and nothing was new."""
        found = allocate(processes, recorded)
        there = {node for one in found.threads for node in one.nodes}
        members = executors_of(found, wanted, processes)
        if not members or not wanted <= there:
            if time.monotonic_ns() - begun_ns > START_NS:
                missing, running = (", ".join(sorted(n)) for n in (wanted - there, there))
                raise OperationError(
                    f"{f'node {missing}' if missing else 'a node'} has not appeared within"
                    f" {format_duration(START_NS)}; running: {running or 'no node'}"
                )
            return False
        server = ReservationServer("the chain", core, 1, ())
        around = scheduling_around({server.name: members}, [server], found, available_cores())
        new = [one for one in around if one.thread.thread.identity not in done]
        # One after the other, as under SCHED_FIFO in the paper: no turns.
        changes = [(one.thread.thread, replace(one.wanted, takes_turns=False)) for one in new]
        change_all(journal, changes)
        done.update(thread.identity for thread, _ in changes)
        return not new

    with run_claimed({core}, nodes, folder) as journal:
        yield see_to_it


def check_profiling(core: int | None = None) -> int:
    """The core on which executors will run, once it is sure that they may.

    Raises PlatformError: no such core, or SCHED_FIFO is not permitted.
    """
    if not may_use_fifo():
        raise PlatformError(
            "profiling needs SCHED_FIFO: run as root, or give your user an rtprio limit of 98 in "
            "/etc/security/limits.conf; without, `chainshaper record` records as things are"
        )
    core = available_cores()[-1] if core is None else core
    check_cores({core: "the chain"})
    return core


def chain_nodes(recording: Recording, chain: str) -> tuple[str, ...]:
    """The nodes of a chain in an earlier recording of the application, in its order.

    Raises InputError: no such chain.
    """
    graph = graph_of(data_flow(recording.events, recording.info.clock_offset_ns))
    found = find_chain(graph, chain)
    return tuple(dict.fromkeys(graph.callbacks[number].node for number in found.callbacks))


def executors_of(
    found: Allocation,
    nodes: frozenset[str],
    processes: Sequence[Process],
) -> list[NodeThread]:
    """The threads that execute these nodes, or publish for them; of all nodes if none are named.

    What has started other nodes is left out: `ros2 launch` is a node as well, and in no chain.
    """
    owners = {one.thread.pid for one in found.threads if one.nodes}
    launchers = {one.parent for one in processes if one.pid in owners}

    def is_meant(one: NodeThread) -> bool:
        if nodes:
            return not nodes.isdisjoint(one.nodes)
        return bool(one.nodes) and one.thread.pid not in launchers

    running = (one for one in found.threads if one.thread.role in ("executor", "publisher"))
    return [one for one in running if is_meant(one)]
