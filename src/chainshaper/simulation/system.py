"""An application as it is simulated: its processes, threads, callbacks and publishers in lists.

The engine has the same lists in the same order: a number in its log is a place in one of these.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from chainshaper.analysis.chains import find_chain
from chainshaper.planning.chain_plan import ReceiverPlace, Server, Thread
from chainshaper.planning.plan import Plan
from chainshaper.values.application import LOOP_END, ApplicationGraph, Callback, Chain, Node
from chainshaper.values.errors import InputError
from chainshaper.values.recording import ThreadInfo
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    node_name,
)
from chainshaper.workload.launcher import LOOP_NAME

FIRST_PID = 1000  # of the processes
FIRST_TID = 100_000  # of an executor's threads behind its first
ROLES = ("executor", "publisher", "dds", "loop")
KINDS = ("timer", "subscription", "service", "client", "loop")
"""The order in which executors look for ready callbacks (Jazzy); at loops they do not look."""
STATIC_ORDER = ("subscription", "timer", "client", "service", "loop")
"""The order in which the static single-threaded executor looks for them (Jazzy)."""


@dataclass(frozen=True)
class Entity:
    """A timer or a subscription with its callback, or a loop."""

    process: int  # place in the system's processes
    index: int  # of the callback in its node
    number: int  # of the input of a synchronising callback, or of what a loop reads
    kind: str  # one of KINDS
    topic: str | None  # None: a timer or a loop
    described: CallbackDescription
    publishers: tuple[int, ...]  # places in the system's publishers
    listens: bool = False  # to the modes that are announced for the callback's gate

    @property
    def stores(self) -> bool:
        """Whether it is a subscription whose messages are stored for its node's loop."""
        return self.topic is not None and self.described.loop_ns is not None


class SimulatedPublisher(NamedTuple):
    """One callback's publisher of a topic."""

    process: int  # place in the system's processes
    topic: str
    asynchronous: bool


class SimulatedProcess(NamedTuple):
    """A node's process, or its part of a container's."""

    node: str  # full name
    key: str  # the node's name in the description
    pid: int  # nodes of a container have it in common


@dataclass(frozen=True)
class System:
    """An application with everything that runs in it, in the order of the engine's lists."""

    application: Application
    processes: tuple[SimulatedProcess, ...]
    threads: tuple[ThreadInfo, ...]
    servers: Mapping[int, Server]  # by place of the thread, of threads that are in one
    receivers: Mapping[int, ReceiverPlace]  # by place of the thread, of outputs' receivers
    cores: tuple[int, ...]
    entities: tuple[Entity, ...]
    publishers: tuple[SimulatedPublisher, ...]
    chain: Chain  # its callbacks are places of entities; empty where no chain is followed
    modes: tuple[str, ...]

    def depth(self, topic: str) -> int:
        """How many messages of a topic a history holds."""
        return self.application.topic(topic).depth


def build_system(
    application: Application, plan: Plan | None = None, *, follow_chain: bool
) -> System:
    """List everything that runs in an application; find its chain where ``follow_chain`` asks.

    Raises InputError: the application's chain is not one path through it, or a server of the plan
    has a thread that the application does not have.
    """
    processes = tuple(_processes(application))
    entities: list[Entity] = []
    publishers: list[SimulatedPublisher] = []
    order = STATIC_ORDER if application.simulation.executor == "static" else KINDS
    for number, process in enumerate(processes):
        of_process = list(_entities(application, number, process.key, publishers))
        entities += sorted(of_process, key=lambda entity: order.index(entity.kind))
    modes: list[str] = []
    for _, callback in application.callbacks():
        modes += callback.announces
    for _, callback in application.callbacks():
        if callback.gate is not None and callback.gate.modes is not None:
            modes += callback.gate.modes.bands
    threads = list(_threads(application, processes, publishers))
    servers = {} if plan is None else _servers(plan, threads)
    cores = sorted({thread.cores[0] for thread in threads})
    receivers = {} if plan is None else _receivers(plan, threads, servers)
    homes = {thread: place.core for thread, place in (servers | receivers).items()}
    for thread, core in homes.items():
        threads[thread] = threads[thread].model_copy(update={"cores": (core,)})
    chain = Chain(application.chain, (), ())
    if follow_chain:
        chain = find_chain(_graph(processes, entities, publishers), application.chain)
    return System(
        application=application,
        processes=processes,
        threads=tuple(threads),
        servers=servers,
        receivers=receivers,
        cores=tuple(dict.fromkeys([*cores, *homes.values()])),
        entities=tuple(entities),
        publishers=tuple(publishers),
        chain=chain,
        modes=tuple(dict.fromkeys(modes)),
    )


def _processes(application: Application) -> Iterator[SimulatedProcess]:
    """Yield each node's process; nodes of a container share the pid of its first."""
    pids: dict[str, int] = {}
    for number, (key, node) in enumerate(application.nodes.items()):
        pid = FIRST_PID + 10 * number
        if node.container is not None:
            pid = pids.setdefault(node.container, pid)
        yield SimulatedProcess(node_name(key), key, pid)


def _entities(
    application: Application, process: int, key: str, publishers: list[SimulatedPublisher]
) -> Iterator[Entity]:
    """Yield a node's entities in the order of registration; add their publishers to the list."""
    for index, described in enumerate(application.nodes[key].callbacks):
        places = tuple(range(len(publishers), len(publishers) + len(described.publishes)))
        for topic in described.publishes:
            asynchronous = application.topic(topic).publication == "asynchronous"
            publishers.append(SimulatedPublisher(process, topic, asynchronous))
        if described.timer_ns is not None:
            yield Entity(process, index, 0, "timer", None, described, places)
        if described.loop_ns is not None:
            yield Entity(process, index, 0, "loop", None, described, places)
            for number, topic in enumerate(described.reads):
                yield Entity(process, index, number, "subscription", topic, described, ())
            continue
        # Subscriptions to the modes of a gate stand before the inputs.
        of_modes = len(described.subscriptions) - len(described.inputs)
        for number, topic in enumerate(described.subscriptions):
            if number < of_modes:
                yield Entity(
                    process, index, number, "subscription", topic, described, (), listens=True
                )
            else:
                yield Entity(process, index, number, described.kind, topic, described, places)


def _threads(
    application: Application,
    processes: Sequence[SimulatedProcess],
    publishers: Sequence[SimulatedPublisher],
) -> Iterator[ThreadInfo]:
    """Yield each process's threads: of its executor, its publisher, DDS, its loop."""
    for number, process in enumerate(processes):
        executor = application.scheduling_of(process.key)
        name = process.node.strip("/").replace("/", ".")[:15]
        executing = application.cores_of(process.key)
        threads = [("executor", name, core, executor.priority) for core in executing]
        if any(p.asynchronous for p in publishers if p.process == number):
            below = max(1, executor.priority - 1)  # as the live workload has it
            threads.append(("publisher", "dds.publisher", executor.core, below))
        if application.simulation.receive is not None:
            dds = application.dds_scheduling_of(process.key)
            threads.append(("dds", "dds.dds", dds.core, dds.priority))
        if (loop := application.loop_scheduling_of(process.key)) is not None:
            threads.append(("loop", LOOP_NAME, loop.core, loop.priority))
        for place, (role, comm, core, priority) in enumerate(threads):
            tid = FIRST_PID + 10 * number + ROLES.index(role)
            if 0 < place < len(executing):
                tid = FIRST_TID + 100 * number + place
            yield ThreadInfo(
                tid=tid,
                pid=process.pid,
                comm=comm,
                node=process.node,
                role=role,
                policy="SCHED_FIFO",
                priority=priority,
                cores=(core,),
            )


def _servers(plan: Plan, threads: Sequence[ThreadInfo]) -> dict[int, Server]:
    """The server of each thread that is in one, by the thread's place.

    Raises InputError: a server has a thread that the application does not have.
    """
    places: dict[Thread, list[int]] = {}
    for place, info in enumerate(threads):
        if info.role in ("executor", "publisher"):
            planned = Thread(node=info.node, role=info.role)  # type: ignore[arg-type]
            places.setdefault(planned, []).append(place)
    server_of: dict[int, Server] = {}
    for server in plan.servers:
        for thread in server.threads:
            if thread not in places:
                raise InputError(
                    f"server {server.name!r} of the plan holds {thread.text}, which the application"
                    " does not have: plan again from a recording of it"
                )
            server_of |= dict.fromkeys(places[thread], server)
    return server_of


def _receivers(
    plan: Plan, threads: Sequence[ThreadInfo], servers: Mapping[int, Server]
) -> dict[int, ReceiverPlace]:
    """Core and priority of the threads that receive an output outside servers, by place.

    So does a loop's thread that reads an output.
    """
    places = {"executor": plan.receivers_at, "loop": plan.loops_at}
    return {
        number: place
        for number, info in enumerate(threads)
        if number not in servers and info.role in places
        if (place := places[info.role].get(info.node or "")) is not None
    }


def _publishes(
    entity: Entity,
    processes: Sequence[SimulatedProcess],
    publishers: Sequence[SimulatedPublisher],
) -> tuple[str, ...]:
    """The topics of an entity; those of a loop are also of what is stored for it, with its end."""
    if entity.described.loop_ns is None:
        return tuple(publishers[publisher].topic for publisher in entity.publishers)
    return (*entity.described.publishes, processes[entity.process].node + LOOP_END)


def _graph(
    processes: Sequence[SimulatedProcess],
    entities: Sequence[Entity],
    publishers: Sequence[SimulatedPublisher],
) -> ApplicationGraph:
    """The graph in which the chain is found; the id of a callback is its entity's place.

    Callbacks alone publish here, so topics need not name their nodes. What is stored for a loop
    passes on what the loop publishes.
    """
    callbacks = [
        Callback(
            id=number,
            kind="loop"
            if entity.kind == "loop"
            else "timer"
            if entity.topic is None
            else "subscription",
            node=processes[entity.process].node,
            pid=processes[entity.process].pid,
            handle=number,
            topic=entity.topic,
            period_ns=None if entity.topic is not None else entity.described.period_ns,
            publishes=_publishes(entity, processes, publishers),
            passes_on=_publishes(entity, processes, publishers) if entity.stores else (),
        )
        for number, entity in enumerate(entities)
    ]
    nodes = tuple(Node(process.node, process.pid) for process in processes)
    return ApplicationGraph(nodes, tuple(callbacks))
