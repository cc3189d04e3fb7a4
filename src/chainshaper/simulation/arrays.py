"""What is simulated: an application in words (:class:`System`), then in the engine's arrays.

The words are plain values between the description, which people write, and the arrays, which the
engine runs on. Their order is that of the arrays' rows, so a row's number in the engine's log
leads back to a name.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from chainshaper.analysis.chains import find_chain
from chainshaper.planning.plan import Plan, Server, Thread, shaping_nodes
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import FOREVER, NONE, Int64s, Memory, refer_to_places
from chainshaper.values.application import ApplicationGraph, Callback, Chain, Node
from chainshaper.values.errors import InputError
from chainshaper.workload.description import Application, CallbackDescription, ExecutionTime
from chainshaper.workload.event_log import WORDS
from chainshaper.workload.execution import BLOCK, blocks
from chainshaper.workload.live import Timing, node_name

__all__ = ["Streams", "System", "build_machine", "build_system"]

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
    entity; it is empty where it is not followed.
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


AHEAD = 16 * BLOCK
"""So many values of every stream are drawn beforehand."""

FIRST_COST = 1 << 20
"""Costs are numbered from here, callbacks of a node from 0: no two draw the same sequence."""


class Streams:
    """All streams of a simulation: drawn in Python, consumed by the engine.

    A callback's stream is that of the live workload, value for value: it depends on the seed, the
    node's full name and the callback's place in it. So does a cost's; constants need no drawing.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._constants: list[int] = []
        self._sources: list[Iterator[Int64s] | None] = []

    def callback(self, times: ExecutionTime, node: str, index: int) -> int:
        """The number of a stream of execution times (ns)."""
        constant = times.constant_ns
        values = (
            None if constant is not None else blocks(times.model_dump(), self._seed, node, index)
        )
        self._sources.append(values)
        self._constants.append(at.NONE if constant is None else constant)
        return len(self._sources) - 1

    def cost(self, times: ExecutionTime, node: str, number: int) -> int:
        """The number of a stream of costs or delays (ns)."""
        return self.callback(times, node, FIRST_COST + number)

    def __len__(self) -> int:
        return len(self._sources)

    def rows(self) -> Int64s:
        """The streams' rows of the engine's array, before any value is drawn."""
        rows = np.zeros((len(self), at.STREAM_COLUMNS), dtype=np.int64)
        rows[:, at.D_CONSTANT] = self._constants
        return rows

    def fill(self, memory: Memory) -> None:
        """Draw for all streams that run short (all, the first time)."""
        first, rows, draws = memory.place("draws", 0), memory["streams"], memory["draws"]
        for stream, source in enumerate(self._sources):
            row, begin = rows[stream], first + stream * AHEAD
            if source is None or (row[at.D_NEXT] and row[at.D_NEXT] < row[at.D_LIMIT] - BLOCK):
                continue
            used = (int(row[at.D_NEXT]) - begin) // BLOCK * BLOCK if row[at.D_NEXT] else AHEAD
            values = draws[stream]
            values[: AHEAD - used] = values[used:].copy()
            for place in range(AHEAD - used, AHEAD, BLOCK):
                values[place : place + BLOCK] = next(source)
            row[at.D_NEXT] = row[at.D_NEXT] - used if row[at.D_NEXT] else begin
            row[at.D_LIMIT] = begin + AHEAD - at.RESERVE


LOG_ENTRIES = 1 << 17
POOL = 4096
"""Messages under way, besides those in histories."""

BEST_EFFORT = 1000
KINDS = ("timer", "subscription", "service", "client")
EXECUTORS = ("single-threaded", "static", "events")
COSTS = ("wake_up", "take", "publish", "receive", "delivery")


def build_machine(
    system: System,
    plan: Plan | None,
    timing: Timing,
    streams: Streams,
    *,
    events: bool,
    switches: bool,
    latencies: int,
    warm_up: int,
) -> tuple[Memory, tuple[int, ...]]:
    """The arrays of a system before anything has happened, and the numbers of its cores.

    ``events`` and ``switches`` say what is logged, ``latencies`` for how many instances of the
    chain the latency is noted, behind the first ``warm_up`` ones.

    Raises:
        InputError: a server of the plan holds a thread that the system does not have.
    """
    places = {core: row for row, core in enumerate(sorted({t.core for t in system.threads}))}
    servers = _assigned(system, plan)
    for server in servers.values():
        places.setdefault(server.core, len(places))
    rings: list[int] = []

    def ring(depth: int) -> int:
        rings.extend([NONE] * depth)
        return len(rings) - depth

    cores, core_threads, boundaries, threads = _cores(system, plan, servers, places, timing)
    _describe_threads(system, threads, streams)
    gates, slots, bands, gate_rows = _gates(system, timing)
    synchronisers, inputs, synchroniser_rows = _synchronisers(system, ring)
    entities = _entity_rows(system, timing, streams, {**gate_rows, **synchroniser_rows}, ring)
    publishers, readers, announced = _publishers(system)
    unsent = sum(system.application.topic(p.topic).depth for p in system.publishers)
    pool = POOL + len(rings) + unsent + at.RESERVE
    heap = pool + len(entities) + len(threads) + at.RESERVE
    entries = LOG_ENTRIES if events else 0
    areas = {
        "control": np.zeros((1, at.CONTROL_COLUMNS), dtype=np.int64),
        "threads": threads,
        "entities": entities,
        "publishers": publishers,
        "readers": readers,
        "gates": gates,
        "synchronisers": synchronisers,
        "inputs": inputs,
        "cores": cores,
        "core_threads": core_threads,
        "boundaries": boundaries,
        "slots": slots,
        "bands": bands,
        "changes": np.zeros((len(gates) * at.CHANGES_KEPT, 2), dtype=np.int64),
        "announced": announced,
        "rings": np.full((len(rings), 1), NONE, dtype=np.int64),
        "streams": streams.rows(),
        "draws": np.zeros((len(streams), AHEAD), dtype=np.int64),
        "messages": np.full((pool, at.MESSAGE_COLUMNS), NONE, dtype=np.int64),
        "heap": np.zeros((heap, at.HEAP_COLUMNS), dtype=np.int64),
        "counts": np.zeros((at.LOG_KINDS, at.LOG_COLUMNS), dtype=np.int64),
        **{
            f"log {kind}": np.zeros((fields, entries), dtype=np.int64)
            for kind, fields in enumerate(at.LOG_FIELDS)
        },
        "latencies": np.full((1, latencies), NONE, dtype=np.int64),
    }
    memory = Memory(areas)
    refer_to_places(memory)
    control = memory["control"][0]
    described = system.application.simulation
    control[at.X_UNUSED] = pool
    control[at.X_STOP] = timing.stop_ns
    control[at.X_LAST_TIMER] = timing.last_timer_ns
    control[at.X_RECORD_FROM] = timing.record_from_ns
    control[at.X_LOGGING] = events
    control[at.X_SWITCHES] = switches
    control[at.X_SWITCH_COST] = described.context_switch_ns
    control[at.X_PREEMPTION_COST] = described.preemption_ns
    control[at.X_QUANTUM] = described.quantum_ns
    control[at.X_AWAY] = round(1e6 * described.interrupts / (1 - described.interrupts))
    control[at.X_CYCLE] = plan.cycle_ns if plan is not None else 0
    control[at.X_WARM_UP] = warm_up
    expiries = sorted(
        (int(entities[row, at.E_DUE]), row)
        for row, entity in enumerate(system.entities)
        if entity.kind == "timer"
    )
    for order, (due, row) in enumerate(expiries):  # in order, they are a heap
        memory["heap"][order] = due, order, at.EXPIRY, memory.place("entities", row)
    control[at.X_COUNTER] = len(expiries)
    control[at.X_HEAP_END] = memory.place("heap", len(expiries))
    streams.fill(memory)
    return memory, tuple(places)


def _rows(rows: Sequence[Sequence[int]], columns: int) -> Int64s:
    return np.array(rows, dtype=np.int64).reshape(-1, columns)


def _assigned(system: System, plan: Plan | None) -> dict[int, Server]:
    """The server of each thread that is in one."""
    if plan is None:
        return {}
    threads = {
        Thread(node=system.processes[t.process].node, role=t.role): number  # type: ignore[arg-type]
        for number, t in enumerate(system.threads)
        if t.role != "dds"
    }
    found: dict[int, Server] = {}
    for server in plan.servers:
        for thread in server.threads:
            if thread not in threads:
                raise InputError(
                    f"server {server.name!r} of the plan holds the {thread.role} of {thread.node},"
                    " which the application does not have: plan again from a recording of it"
                )
            found[threads[thread]] = server
    return found


def _cores(
    system: System,
    plan: Plan | None,
    servers: dict[int, Server],
    places: dict[int, int],
    timing: Timing,
) -> tuple[Int64s, Int64s, Int64s, Int64s]:
    """``cores``, ``core_threads``, ``boundaries``, and ``threads`` with core, rank and server."""
    threads = np.full((len(system.threads), at.THREAD_COLUMNS), NONE, dtype=np.int64)
    threads[:, at.T_ROW] = np.arange(len(threads))
    cores = np.zeros((len(places), at.CORE_COLUMNS), dtype=np.int64)
    boundaries: list[tuple[int, int]] = []
    for number, thread in enumerate(system.threads):
        server = servers.get(number)
        threads[number, at.T_CORE] = places[thread.core if server is None else server.core]
        threads[number, at.T_RANK] = BEST_EFFORT - thread.priority
    core_threads: list[int] = []
    for core, place in places.items():
        own = [] if plan is None else [s for s in plan.servers if s.core == core]
        ranked = sorted((s for s in own if s in servers.values()), key=lambda s: s.priority)
        for number, server in servers.items():
            if server in ranked:
                bit = ranked.index(server)
                threads[number, at.T_SERVER] = bit
                threads[number, at.T_RANK] = bit - len(ranked)
        mine = [n for n in range(len(threads)) if threads[n, at.T_CORE] == place]
        row = cores[place]
        row[at.C_FIRST], row[at.C_END] = len(core_threads), len(core_threads) + len(mine)
        core_threads += mine
        row[at.C_RUNNING], row[at.C_LAST] = NONE, NONE
        row[at.C_UNTIL], row[at.C_BOUNDARY], row[at.C_DIRTY] = FOREVER, FOREVER, 1
        if plan is not None and ranked:
            table = _slot_table(plan, ranked)
            row[at.C_TABLE], row[at.C_TABLE_END] = len(boundaries), len(boundaries) + len(table)
            boundaries += table
            _enter_table(row, table, timing.start_ns, timing.anchor_ns + plan.offset_ns, plan)
    return cores, _rows([[n] for n in core_threads], 1), _rows(boundaries, 2), threads


def _slot_table(plan: Plan, ranked: Sequence[Server]) -> list[tuple[int, int]]:
    """Rows (offset in the cycle, mask of the servers that are open from then on)."""
    # A shaping node holds its messages itself: its thread needs no slot to run in.
    shaping = {node.thread for node in shaping_nodes(plan)}
    slots = [
        server.slots if shaping.isdisjoint(server.threads) else ((0, plan.cycle_ns),)
        for server in ranked
    ]
    offsets = {0} | {instant for own in slots for slot in own for instant in slot}
    return [
        (
            offset,
            sum(
                1 << bit
                for bit, own in enumerate(slots)
                if any(start <= offset < end for start, end in own)
            ),
        )
        for offset in sorted(offsets)
        if offset < plan.cycle_ns
    ]


def _enter_table(
    row: Int64s, table: Sequence[tuple[int, int]], start: int, anchor: int, plan: Plan
) -> None:
    """The state of a core's table at the start of the run, which is anywhere in a cycle."""
    elapsed = (start - anchor) % plan.cycle_ns
    current = max(number for number, (offset, _) in enumerate(table) if offset <= elapsed)
    row[at.C_MASK] = table[current][1]
    following = (current + 1) % len(table)
    row[at.C_NEXT] = row[at.C_TABLE] + following
    offset = table[following][0] + (plan.cycle_ns if following <= current else 0)
    row[at.C_BOUNDARY] = start - elapsed + offset


def _describe_threads(system: System, threads: Int64s, streams: Streams) -> None:
    described = system.application.simulation
    for number, thread in enumerate(system.threads):
        node = system.processes[thread.process].node
        row = threads[number]
        columns = (at.T_WAKE, at.T_TAKE, at.T_PUBLISH, at.T_RECEIVE, at.T_DELIVERY)
        for place, (name, column) in enumerate(zip(COSTS, columns, strict=True)):
            times = getattr(described, name)
            if times is not None:
                offset = len(COSTS) * ("executor", "publisher", "dds").index(thread.role)
                row[column] = streams.cost(times, node, offset + place)
        row[at.T_RUNNABLE], row[at.T_LEFT], row[at.T_SEQUENCE] = 0, 0, 0
        row[at.T_PREEMPTED], row[at.T_USED] = 0, 0
        if thread.role == "executor":
            mine = [n for n, e in enumerate(system.entities) if e.process == thread.process]
            row[at.T_KIND] = EXECUTORS.index(described.executor)
            row[at.T_FIRST], row[at.T_END] = mine[0], mine[-1] + 1
            row[at.T_STEP] = at.COLLECT
            row[at.T_PUBLISHER_THREAD] = _sibling(system, thread, "publisher")
            row[at.T_DDS_THREAD] = _sibling(system, thread, "dds")
        else:
            sends = thread.role == "publisher"
            row[at.T_KIND] = at.PUBLISHER if sends else at.DDS
            row[at.T_STEP] = at.SEND if sends else at.RECEIVE


def _sibling(system: System, thread: SimulatedThread, role: str) -> int:
    same = [
        n for n, t in enumerate(system.threads) if t.process == thread.process and t.role == role
    ]
    return same[0] if same else NONE


def _gates(
    system: System, timing: Timing
) -> tuple[Int64s, Int64s, Int64s, dict[tuple[int, int], int]]:
    """``gates``, ``slots``, ``bands``, and the gate's row by (process, callback's place)."""
    gates: list[list[int]] = []
    slots: list[tuple[int, int]] = []
    bands: list[int] = []
    rows: dict[tuple[int, int], int] = {}
    for entity in system.entities:
        gate = entity.described.gate
        if gate is None or entity.listens:
            continue
        rows[entity.process, entity.index] = len(gates)
        row = [NONE] * at.GATE_COLUMNS
        row[at.G_SLOTS], row[at.G_SLOTS_END] = len(slots), len(slots) + len(gate.slots)
        slots += gate.slots
        row[at.G_CYCLE], row[at.G_STAMPED] = gate.cycle_ns, int(gate.anchor == "stamp")
        row[at.G_OVERRUN] = WORDS["overrun"].index(gate.overrun)
        row[at.G_DUE], row[at.G_SPIN], row[at.G_PAUSE] = (
            gate.due_cycles,
            gate.spin_ns,
            gate.pause_ns,
        )
        row[at.G_PHASE], row[at.G_CHANGED] = timing.anchor_ns, 0
        row[at.G_CHANGES] = len(gates) * at.CHANGES_KEPT
        row[at.G_MESSAGES] = WORDS["messages"].index(gate.messages)
        if gate.modes is not None:
            row[at.G_LATE] = WORDS["overrun"].index(gate.modes.late)
            row[at.G_DEFAULT], row[at.G_BANDS] = system.modes.index(gate.modes.default), len(bands)
            bands += [gate.modes.bands.get(mode, NONE) for mode in system.modes]
        gates.append(row)
    return _rows(gates, at.GATE_COLUMNS), _rows(slots, 2), _rows([[b] for b in bands], 1), rows


def _synchronisers(
    system: System, ring: Callable[[int], int]
) -> tuple[Int64s, Int64s, dict[tuple[int, int], int]]:
    """``synchronisers``, ``inputs``, and the row by (process, callback's place)."""
    synchronisers: list[list[int]] = []
    inputs: list[list[int]] = []
    rows: dict[tuple[int, int], int] = {}
    for number, entity in enumerate(system.entities):
        if not entity.described.synchronises:
            continue
        key = (entity.process, entity.index)
        if key not in rows:
            rows[key] = len(synchronisers)
            synchronisers.append([len(inputs), len(inputs) + len(entity.described.synchronises)])
        depth = system.application.topic(entity.topic or "").depth
        inputs.append([int(number in system.chain.callbacks), ring(depth), depth, 0, 0])
    return _rows(synchronisers, at.SYNCHRONISER_COLUMNS), _rows(inputs, at.INPUT_COLUMNS), rows


def _entity_rows(
    system: System,
    timing: Timing,
    streams: Streams,
    bodies: dict[tuple[int, int], int],
    ring: Callable[[int], int],
) -> Int64s:
    entities = np.zeros((len(system.entities), at.ENTITY_COLUMNS), dtype=np.int64)
    executors = {t.process: n for n, t in enumerate(system.threads) if t.role == "executor"}
    executions: dict[tuple[int, int], int] = {}  # inputs of a synchroniser execute the same
    for number, entity in enumerate(system.entities):
        row, described = entities[number], entity.described
        process, callback = system.processes[entity.process], (entity.process, entity.index)
        if callback not in executions:
            executions[callback] = streams.callback(described.execution, process.node, entity.index)
        row[at.E_ROW] = number
        row[at.E_THREAD] = executors[entity.process]
        row[at.E_KIND] = KINDS.index(entity.kind)
        row[at.E_BODY] = _body(entity)
        row[at.E_BODY_ROW] = bodies.get(callback, NONE)
        row[at.E_INPUT] = entity.number
        row[at.E_EXECUTION] = executions[callback]
        row[at.E_PUBLISHERS] = entity.publishers[0] if entity.publishers else 0
        row[at.E_PUBLISHERS_END] = row[at.E_PUBLISHERS] + len(entity.publishers)
        row[at.E_STARTS_CHAIN] = number in system.chain.callbacks[:1]
        row[at.E_ON_CHAIN] = number in system.chain.callbacks[1:]
        row[at.E_LIFESPAN] = NONE
        if entity.topic is None:
            drift = system.application.simulation.drift.get(process.key, 0)
            period = described.timer_ns or 0
            row[at.E_PERIOD] = max(1, round(period * (1 - drift / 1_000_000)))
            row[at.E_DUE] = timing.start_ns + described.phase_ns
        else:
            topic = system.application.topic(entity.topic)
            gate = described.gate
            depth = topic.depth if gate is None or entity.listens else gate.depth
            row[at.E_HISTORY], row[at.E_DEPTH] = ring(depth), depth
            if topic.lifespan_ns is not None:
                row[at.E_LIFESPAN] = topic.lifespan_ns
    return entities


def _body(entity: Entity) -> int:
    if entity.listens:
        return at.MODE_LISTENER
    if entity.described.gate is not None:
        return at.GATE
    return at.SYNCHRONISE if entity.described.synchronises else at.COMPUTE


def _publishers(system: System) -> tuple[Int64s, Int64s, Int64s]:
    """``publishers``, ``readers``, ``announced``."""
    rows = np.zeros((len(system.publishers), at.PUBLISHER_COLUMNS), dtype=np.int64)
    readers: list[tuple[int, int]] = []
    announced: list[int] = []
    owner = {p: entity for entity in system.entities for p in entity.publishers}
    chain = system.chain
    ends = [(system.entities[c].publishers, chain.topics[-1]) for c in chain.callbacks[-1:]]
    for number, publisher in enumerate(system.publishers):
        row, topic = rows[number], system.application.topic(publisher.topic)
        reached = system.readers.get(publisher.topic, ())
        row[at.P_ROW] = number
        row[at.P_FIRST], row[at.P_END] = len(readers), len(readers) + len(reached)
        readers += [(entity, 0) for entity in reached]
        row[at.P_ASYNCHRONOUS], row[at.P_DEPTH] = publisher.asynchronous, topic.depth
        row[at.P_LIFESPAN] = NONE if topic.lifespan_ns is None else topic.lifespan_ns
        row[at.P_ENDS_CHAIN] = any(
            number in own and publisher.topic == topic for own, topic in ends
        )
        modes = owner[number].described.announces
        row[at.P_MODES], row[at.P_MODES_COUNT] = len(announced), len(modes)
        announced += [system.modes.index(mode) for mode in modes]
    return rows, _rows(readers, at.READER_COLUMNS), _rows([[m] for m in announced], 1)
