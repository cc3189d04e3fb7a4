"""What is simulated, in words: an application with everything that runs in it, numbered.

The order is that of the lists that the engine has: a number in its log leads to a name.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from chainshaper.analysis.chains import find_chain
from chainshaper.planning.chain_plan import ReceiverPlace, Server, Thread
from chainshaper.planning.plan import Plan
from chainshaper.values.application import ApplicationGraph, Callback, Chain, Node
from chainshaper.values.errors import InputError
from chainshaper.values.recording import ThreadInfo
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    node_name,
)

FIRST_PID, FIRST_TID = 1000, 100_000  # of processes, and of executors' threads but the first
ROLES = ("executor", "publisher", "dds")
KINDS = ("timer", "subscription", "service", "client")
STATIC_ORDER = ("subscription", "timer", "client", "service")
"""The orders in which executors look at what is ready, the static one and others (Jazzy)."""


@dataclass(frozen=True)
class Entity:
    """A timer or a subscription with its callback."""

    process: int
    index: int  # of the callback in its node
    number: int  # of the input of a synchronising callback
    kind: str
    topic: str | None  # None: a timer
    described: CallbackDescription
    publishers: tuple[int, ...]
    listens: bool = False  # for modes on behalf of the gate


class SimulatedPublisher(NamedTuple):
    """One callback's publisher of a topic."""

    process: int
    topic: str
    asynchronous: bool


class SimulatedProcess(NamedTuple):
    """A node's process; ``key`` is the node's name in the description."""

    node: str
    key: str
    pid: int


@dataclass(frozen=True)
class System:
    """An application with everything that runs in it, numbered as the engine has it.

    ``servers`` are by thread, and ``receivers`` of outputs, which are in none, with their places.
    ``chain`` has its callbacks by entity; it is empty where it is not followed.
    """

    application: Application
    processes: tuple[SimulatedProcess, ...]
    threads: tuple[ThreadInfo, ...]
    servers: Mapping[int, Server]
    receivers: Mapping[int, ReceiverPlace]
    cores: tuple[int, ...]
    entities: tuple[Entity, ...]
    publishers: tuple[SimulatedPublisher, ...]
    chain: Chain
    modes: tuple[str, ...]

    def depth(self, topic: str) -> int:
        """How many messages of a topic a history has."""
        return self.application.topic(topic).depth


def build_system(
    application: Application, plan: Plan | None = None, *, follow_chain: bool
) -> System:
    """Everything that runs in an application; ``follow_chain`` if its chain has to be known.

    Raises InputError: the application's chain is not one path through it, or a server of the plan
    has a thread that the application does not have.
    """
    processes = tuple(
        SimulatedProcess(node_name(key), key, FIRST_PID + 10 * number)
        for number, key in enumerate(application.nodes)
    )
    entities: list[Entity] = []
    publishers: list[SimulatedPublisher] = []
    order = STATIC_ORDER if application.simulation.executor == "static" else KINDS
    for number, process in enumerate(processes):
        own = list(_entities(application, number, process.key, publishers))
        entities += sorted(own, key=lambda entity: order.index(entity.kind))
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
    homes = {number: one.core for number, one in (servers | receivers).items()}
    for number, core in homes.items():
        threads[number] = threads[number].model_copy(update={"cores": (core,)})
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


def _entities(
    application: Application, process: int, key: str, publishers: list[SimulatedPublisher]
) -> Iterator[Entity]:
    """A node's entities in the order of registration; their publishers are added to the list."""
    for index, described in enumerate(application.nodes[key].callbacks):
        own = tuple(range(len(publishers), len(publishers) + len(described.publishes)))
        for topic in described.publishes:
            asynchronous = application.topic(topic).publication == "asynchronous"
            publishers.append(SimulatedPublisher(process, topic, asynchronous))
        if described.timer_ns is not None:
            yield Entity(process, index, 0, "timer", None, described, own)
        of_modes = len(described.subscriptions) - len(described.inputs)
        for number, topic in enumerate(described.subscriptions):
            if number < of_modes:
                yield Entity(process, index, number, "subscription", topic, described, (), True)
            else:
                yield Entity(process, index, number, described.kind, topic, described, own)


def _threads(
    application: Application,
    processes: Sequence[SimulatedProcess],
    publishers: Sequence[SimulatedPublisher],
) -> Iterator[ThreadInfo]:
    for number, process in enumerate(processes):
        own = application.scheduling_of(process.key)
        named = process.node.strip("/").replace("/", ".")[:15]
        executing = application.cores_of(process.key)
        wanted = [("executor", named, core, own.priority) for core in executing]
        if any(p.asynchronous for p in publishers if p.process == number):
            below = max(1, own.priority - 1)  # as the live workload has it
            wanted.append(("publisher", "dds.publisher", own.core, below))
        if application.simulation.receive is not None:
            dds = application.dds_scheduling_of(process.key)
            wanted.append(("dds", "dds.dds", dds.core, dds.priority))
        for place, (role, comm, core, priority) in enumerate(wanted):
            beside = 0 < place < len(executing)
            yield ThreadInfo(
                tid=FIRST_TID + 100 * number + place if beside else process.pid + ROLES.index(role),
                pid=process.pid,
                comm=comm,
                node=process.node,
                role=role,
                policy="SCHED_FIFO",
                priority=priority,
                cores=(core,),
            )


def _servers(plan: Plan, threads: Sequence[ThreadInfo]) -> dict[int, Server]:
    """The server of each thread that is in one."""
    numbers: dict[Thread, list[int]] = {}
    for number, one in enumerate(threads):
        if one.role != "dds":
            named = Thread(node=one.node, role=one.role)  # type: ignore[arg-type]
            numbers.setdefault(named, []).append(number)
    found: dict[int, Server] = {}
    for server in plan.servers:
        for thread in server.threads:
            if thread not in numbers:
                raise InputError(
                    f"server {server.name!r} of the plan holds {thread.text}, which the application"
                    " does not have: plan again from a recording of it"
                )
            found |= dict.fromkeys(numbers[thread], server)
    return found


def _receivers(
    plan: Plan, threads: Sequence[ThreadInfo], servers: Mapping[int, Server]
) -> dict[int, ReceiverPlace]:
    """The place of each thread that receives an output, and is in no server."""
    place_of = plan.receivers_at
    return {
        number: place
        for number, one in enumerate(threads)
        if number not in servers and one.role == "executor"
        if (place := place_of.get(one.node or "")) is not None
    }


def _graph(
    processes: Sequence[SimulatedProcess],
    entities: Sequence[Entity],
    publishers: Sequence[SimulatedPublisher],
) -> ApplicationGraph:
    """Where the chain is found: callbacks alone publish, so topics need not name their nodes."""
    callbacks = [
        Callback(
            id=number,
            kind="timer" if entity.kind == "timer" else "subscription",
            node=processes[entity.process].node,
            pid=processes[entity.process].pid,
            handle=number,
            topic=entity.topic,
            period_ns=entity.described.timer_ns,
            publishes=tuple(publishers[publisher].topic for publisher in entity.publishers),
        )
        for number, entity in enumerate(entities)
    ]
    nodes = tuple(Node(process.node, process.pid) for process in processes)
    return ApplicationGraph(nodes, tuple(callbacks))
