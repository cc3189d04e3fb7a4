"""The paper's profiling condition: a chain alone with its interference (sections 2.5 and 4.2).

L̄ and L̲, from which slots are computed, are measured with the executors of the chain's nodes under
SCHED_FIFO at a high priority on one core, and their DDS threads above them on the others. What else
runs cannot disturb the chain; interference that remains is what no schedule avoids (section 2.3).
Threads are changed as `apply` changes them; those that appear later get theirs at the next look.
"""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from chainshaper.analysis import data_flow, find_chain, graph_of
from chainshaper.enforcement.guardian import run_claimed
from chainshaper.enforcement.scheduling_memory import change_all
from chainshaper.enforcement.servers import ReservationServer
from chainshaper.enforcement.threads import (
    Allocation,
    NodeThread,
    RecordedProcess,
    allocate,
    scheduling_around,
)
from chainshaper.flow.threads import recorded_processes
from chainshaper.linux.processes import Process
from chainshaper.linux.runs import Journal
from chainshaper.linux.scheduling import available_cores, check_cores, may_use_fifo
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.recording import Recording

START_NS = 30_000_000_000
"""The nodes have this long to appear."""


@contextmanager
def profiling_condition(
    nodes: Collection[str] = (),
    core: int | None = None,
    folder: Path | None = None,
    like: Recording | None = None,
) -> Iterator[Callable[[Sequence[Process]], bool]]:
    """Have the threads of ``nodes`` (default: of all) run as the paper profiles a chain.

    It gives what :func:`chainshaper.flow.record.record_command` wants for its ``scheduling``.
    ``core`` is where the executors run; by default the last that we may use. ``folder`` is where
    runs keep their journals (default: `/run/chainshaper`). ``like`` is an earlier recording of the
    application: it tells what a container's components are, and which executors have several
    threads.

    Raises:
        PlatformError: no such core, or SCHED_FIFO is not permitted.
        OperationError: `apply` governs one of the nodes, or the core; not all could be put back.
            And where it is called: a node does not appear, or the kernel refuses something.
    """
    core = check_profiling(core)
    recorded = recorded_processes(like)[0] if like is not None else ()
    with run_claimed({core}, nodes, folder) as journal:
        yield _Condition(frozenset(nodes), core, journal, recorded).see_to_it


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


@dataclass
class _Condition:
    """What is wished for, and which threads have it already. No ``nodes``: all of them."""

    nodes: frozenset[str]
    core: int
    journal: Journal
    recorded: Sequence[RecordedProcess]
    begun_ns: int = field(default_factory=time.monotonic_ns)
    done: set[tuple[int, int]] = field(default_factory=set)

    def see_to_it(self, processes: Sequence[Process]) -> bool:
        """Give new threads what they shall have; whether all nodes have it, and nothing was new."""
        found = allocate(processes, self.recorded)
        there = {node for one in found.threads for node in one.nodes}
        members = executors_of(found, self.nodes, processes, self.recorded)
        if not members or not self.nodes <= there:
            if time.monotonic_ns() - self.begun_ns > START_NS:
                raise OperationError(
                    f"{_missing(self.nodes - there)} has not appeared within "
                    f"{format_duration(START_NS)}; running: {', '.join(sorted(there)) or 'no node'}"
                )
            return False
        server = ReservationServer("the chain", self.core, 1, ())
        wanted = scheduling_around({server.name: members}, [server], found, available_cores())
        new = [one for one in wanted if one.thread.thread.identity not in self.done]
        # One after the other, as under SCHED_FIFO in the paper: no turns.
        changes = [(one.thread.thread, replace(one.wanted, takes_turns=False)) for one in new]
        change_all(self.journal, changes)
        self.done.update(thread.identity for thread, _ in changes)
        return not new


def executors_of(
    found: Allocation,
    nodes: frozenset[str],
    processes: Sequence[Process],
    recorded: Sequence[RecordedProcess],
) -> list[NodeThread]:
    """The threads that execute these nodes, or publish for them; of all nodes if none are named.

    What has started other nodes is left out: `ros2 launch` is a node as well, and in no chain.
    Where several threads of a process executed before, unnamed ones are taken for such: they do not
    differ from others that do next to nothing, as the one that waits for signals.
    """
    owners = {one.thread.pid for one in found.threads if one.nodes}
    launchers = {one.parent for one in processes if one.pid in owners}
    names = {one.pid: one.threads[0].comm for one in processes if one.threads}
    several = {
        node
        for seen in recorded
        if sum(thread.role == "executor" for thread in seen.threads) > 1
        for node in seen.nodes
    }
    return [
        one
        for one in found.threads
        if (
            one.thread.role in ("executor", "publisher")
            or (
                one.thread.role == "unknown"
                and one.thread.comm == names[one.thread.pid]
                and not several.isdisjoint(one.nodes)
            )
        )
        and (nodes & set(one.nodes) if nodes else one.nodes and one.thread.pid not in launchers)
    ]


def _missing(nodes: Collection[str]) -> str:
    return f"node {', '.join(sorted(nodes))}" if nodes else "a node"
