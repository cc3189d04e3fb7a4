"""What is simulated, in words: processes, threads, entities and publishers of an application.

These are plain values between the description, which people write, and the arrays, which the
engine runs on (:mod:`.arrays`). Their order is that of the arrays' rows, so a row's number in the
engine's log leads back to a name.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from chainshaper.analysis.chains import find_chain
from chainshaper.values.application import ApplicationGraph, Callback, Chain, Node
from chainshaper.workload.description import Application, CallbackDescription
from chainshaper.workload.live import node_name

__all__ = ["Entity", "Process", "Publisher", "SimulatedThread", "System", "build_system"]

FIRST_PID = 1000
ORDERS = {
    "single-threaded": ("timer", "subscription", "service", "client"),
    "static": ("subscription", "timer", "client", "service"),
    "events": ("timer", "subscription", "service", "client"),
}
"""The order in which executors look at what is ready (rclcpp's Jazzy)."""


@dataclass(frozen=True)
class Entity:
    """A timer or a subscription with its callback.

    ``index`` is the callback's place in its node, ``number`` the input of a synchronising
    callback, ``topic`` None for a timer. ``listens`` for modes on behalf of the gate.
    """

    process: int
    index: int
    number: int
    kind: str
    topic: str | None
    described: CallbackDescription
    publishers: tuple[int, ...]
    listens: bool = False


@dataclass(frozen=True)
class Publisher:
    """One callback's publisher of a topic."""

    process: int
    topic: str
    asynchronous: bool


@dataclass(frozen=True)
class SimulatedThread:
    """A thread; ``role`` is executor, publisher or dds."""

    process: int
    tid: int
    role: str
    core: int
    priority: int


@dataclass(frozen=True)
class Process:
    """A node's process."""

    node: str
    key: str  # the node's name in the description
    pid: int


@dataclass(frozen=True)
class System:
    """An application with everything that runs in it, numbered as in the engine's arrays.

    ``readers`` are the entities that each topic's messages reach. ``chain`` has its callbacks by
    entity; it is empty where nobody follows it.
    """

    application: Application
    processes: tuple[Process, ...]
    threads: tuple[SimulatedThread, ...]
    entities: tuple[Entity, ...]
    publishers: tuple[Publisher, ...]
    readers: Mapping[str, tuple[int, ...]]
    chain: Chain
    modes: tuple[str, ...]


def build_system(application: Application, *, follow_chain: bool) -> System:
    """Everything that runs in an application; ``follow_chain`` if its chain has to be known.

    Raises:
        InputError: the application's chain is not one path through it.
    """
    processes = tuple(
        Process(node_name(key), key, FIRST_PID + 10 * number)
        for number, key in enumerate(application.nodes)
    )
    entities: list[Entity] = []
    publishers: list[Publisher] = []
    for number, process in enumerate(processes):
        own = list(_entities(application, number, process.key, publishers))
        order = ORDERS[application.simulation.executor]
        entities += sorted(own, key=lambda entity: order.index(entity.kind))
    readers: dict[str, tuple[int, ...]] = {}
    for number, entity in enumerate(entities):
        if entity.topic is not None:
            readers[entity.topic] = (*readers.get(entity.topic, ()), number)
    announced = {mode: 0 for _, cb in application.callbacks() for mode in cb.announces}
    known = {
        mode: 0
        for _, cb in application.callbacks()
        if cb.gate is not None and cb.gate.modes is not None
        for mode in cb.gate.modes.bands
    }
    return System(
        application=application,
        processes=processes,
        threads=tuple(_threads(application, processes, publishers)),
        entities=tuple(entities),
        publishers=tuple(publishers),
        readers=readers,
        chain=(
            find_chain(_graph(processes, entities, publishers), application.chain)
            if follow_chain
            else Chain(application.chain, (), ())
        ),
        modes=tuple(announced | known),
    )


def _entities(
    application: Application, process: int, key: str, publishers: list[Publisher]
) -> Iterator[Entity]:
    """A node's entities in the order of registration; their publishers are added to the list."""
    for index, described in enumerate(application.nodes[key].callbacks):
        first = len(publishers)
        for topic in described.publishes:
            asynchronous = application.topic(topic).publication == "asynchronous"
            publishers.append(Publisher(process, topic, asynchronous))
        own = tuple(range(first, len(publishers)))
        if described.timer_ns is not None:
            yield Entity(process, index, 0, "timer", None, described, own)
        listens = described.gate is not None and described.gate.modes is not None
        for number, topic in enumerate(described.subscriptions):
            if listens and number == 0:
                yield Entity(process, index, number, "subscription", topic, described, (), True)
            else:
                yield Entity(process, index, number, described.kind, topic, described, own)


def _threads(
    application: Application, processes: tuple[Process, ...], publishers: list[Publisher]
) -> Iterator[SimulatedThread]:
    for number, process in enumerate(processes):
        executor = application.scheduling_of(process.key)
        yield SimulatedThread(number, process.pid, "executor", executor.core, executor.priority)
        if any(p.asynchronous for p in publishers if p.process == number):
            priority = max(1, executor.priority - 1)  # as the live workload has it
            yield SimulatedThread(number, process.pid + 1, "publisher", executor.core, priority)
        if application.simulation.receive is not None:
            dds = application.dds_scheduling_of(process.key)
            yield SimulatedThread(number, process.pid + 2, "dds", dds.core, dds.priority)


def _graph(
    processes: tuple[Process, ...], entities: list[Entity], publishers: list[Publisher]
) -> ApplicationGraph:
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
    writers: dict[str, tuple[str, ...]] = {}
    readers: dict[str, tuple[str, ...]] = {}
    for publisher in publishers:
        node = processes[publisher.process].node
        writers[publisher.topic] = (*writers.get(publisher.topic, ()), node)
    for entity in entities:
        if entity.topic is not None:
            node = processes[entity.process].node
            readers[entity.topic] = (*readers.get(entity.topic, ()), node)
    nodes = tuple(Node(process.node, process.pid) for process in processes)
    return ApplicationGraph(nodes, tuple(callbacks), writers, readers)
