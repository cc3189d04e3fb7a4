"""What is simulated: an application in words (:class:`System`), then in the engine's array.

The words are plain values between the description, which people write, and the array, which the
engine runs on. Their order is that of the array's rows, so a row's number in the engine's log
leads back to a name.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from chainshaper.analysis.chains import find_chain
from chainshaper.gate.decision import CHANGES
from chainshaper.planning.application_plan import ApplicationPlan
from chainshaper.planning.plan import Server, Thread
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, A, C, D, E, G, H, I, Int64s, M, P, R, S, T, X
from chainshaper.values.application import ApplicationGraph, Callback, Chain, Node
from chainshaper.values.errors import InputError
from chainshaper.values.recording import ThreadInfo
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    ExecutionTime,
    node_name,
)
from chainshaper.workload.event_log import WORDS
from chainshaper.workload.execution import BLOCK, blocks
from chainshaper.workload.live import Timing

FIRST_PID, FIRST_TID = 1000, 100_000
"""Of processes, whose number the main thread has, and of threads beside it that execute."""
ROLES = ("executor", "publisher", "dds")
KINDS = ("timer", "subscription", "service", "client")
STATIC_ORDER = ("subscription", "timer", "client", "service")
"""The orders in which executors look at what is ready, the static one and others (Jazzy)."""

AHEAD = 16 * BLOCK
"""So many values of every stream are drawn beforehand."""

FIRST_COST = 1 << 20
"""Costs are numbered from here, callbacks of a node from 0: no two draw the same sequence."""

LOG_ENTRIES = 1 << 17
POOL = 4096
"""Messages under way, besides those in histories."""

BEST_EFFORT = 1000
COSTS = ("wake_up", "take", "publish", "receive", "delivery")  # in the order of their columns


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


class Publisher(NamedTuple):
    """One callback's publisher of a topic."""

    process: int
    topic: str
    asynchronous: bool


class Process(NamedTuple):
    """A node's process; ``key`` is the node's name in the description."""

    node: str
    key: str
    pid: int


@dataclass(frozen=True)
class System:
    """An application with everything that runs in it, numbered as in the engine's array.

    ``servers`` has the server of each thread that is in one, ``cores`` the numbers of the cores.
    ``readers`` are the entities that each topic's messages reach. ``chain`` has its callbacks by
    entity; it is empty where it is not followed.
    """

    application: Application
    processes: tuple[Process, ...]
    threads: tuple[ThreadInfo, ...]
    servers: Mapping[int, Server]
    cores: tuple[int, ...]
    entities: tuple[Entity, ...]
    publishers: tuple[Publisher, ...]
    readers: Mapping[str, tuple[int, ...]]
    chain: Chain
    modes: tuple[str, ...]

    def depth(self, topic: str) -> int:
        """How many messages of a topic a history has."""
        return self.application.topic(topic).depth


def build_system(
    application: Application, plan: ApplicationPlan | None = None, *, follow_chain: bool
) -> System:
    """Everything that runs in an application; ``follow_chain`` if its chain has to be known.

    Raises InputError: the application's chain is not one path through it, or a server of the plan
    has a thread that the application does not have.
    """
    processes = tuple(
        Process(node_name(key), key, FIRST_PID + 10 * number)
        for number, key in enumerate(application.nodes)
    )
    entities: list[Entity] = []
    publishers: list[Publisher] = []
    order = STATIC_ORDER if application.simulation.executor == "static" else KINDS
    for number, process in enumerate(processes):
        own = list(_entities(application, number, process.key, publishers))
        entities += sorted(own, key=lambda entity: order.index(entity.kind))
    readers: dict[str, tuple[int, ...]] = {}
    for number, entity in enumerate(entities):
        if entity.topic is not None:
            readers[entity.topic] = (*readers.get(entity.topic, ()), number)
    described = [callback for _, callback in application.callbacks()]
    announced = [mode for callback in described for mode in callback.announces]
    gates = [callback.gate for callback in described if callback.gate is not None]
    known = [mode for gate in gates if gate.modes is not None for mode in gate.modes.bands]
    threads = list(_threads(application, processes, publishers))
    servers = {} if plan is None else _servers(plan, threads)
    cores = sorted({thread.cores[0] for thread in threads})
    for number, server in servers.items():
        threads[number] = threads[number].model_copy(update={"cores": (server.core,)})
    chain = Chain(application.chain, (), ())
    if follow_chain:
        chain = find_chain(_graph(processes, entities, publishers), application.chain)
    return System(
        application=application,
        processes=processes,
        threads=tuple(threads),
        servers=servers,
        cores=tuple(dict.fromkeys([*cores, *(server.core for server in servers.values())])),
        entities=tuple(entities),
        publishers=tuple(publishers),
        readers=readers,
        chain=chain,
        modes=tuple(dict.fromkeys(announced + known)),
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
    application: Application, processes: Sequence[Process], publishers: Sequence[Publisher]
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
            several = 0 < place < len(executing)
            yield ThreadInfo(
                tid=FIRST_TID + 100 * number + place
                if several
                else process.pid + ROLES.index(role),
                pid=process.pid,
                comm=comm,
                node=process.node,
                role=role,
                policy="SCHED_FIFO",
                priority=priority,
                cores=(core,),
            )


def _servers(plan: ApplicationPlan, threads: Sequence[ThreadInfo]) -> dict[int, Server]:
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


def _graph(
    processes: Sequence[Process], entities: Sequence[Entity], publishers: Sequence[Publisher]
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


class Rows(list[int]):
    """The beginning of the engine's array while it is made."""

    def add(self, count: int, columns: int, fill: int = 0) -> range:
        """Room for so many rows; their places."""
        first = len(self)
        self.extend([fill] * (count * columns))
        return range(first, len(self), columns)

    def put(self, values: Sequence[int]) -> tuple[int, int]:
        """Some values; where they begin and end."""
        self.extend(values)
        return len(self) - len(values), len(self)

    def ring(self, depth: int) -> int:
        """A ring for so many messages; its place."""
        return self.put([NONE] * depth)[0]


class Streams:
    """All streams of a simulation: drawn in Python, consumed by the engine.

    A callback's stream is that of the live workload, value for value: it depends on the seed, the
    node's full name and the callback's place in it. So does a cost's; constants need no drawing.
    """

    def __init__(self, seed: int, rows: Rows) -> None:
        self._seed = seed
        self._rows = rows
        self._drawn: list[tuple[int, Iterator[Int64s]]] = []
        self._first = 0

    def add(self, times: ExecutionTime, node: str, index: int) -> int:
        """The place of a new stream of CPU times or delays (ns)."""
        constant = times.constant_ns
        place, _ = self._rows.put([NONE if constant is None else constant, 0, 0])
        if constant is None:
            source = blocks(times.model_dump(), self._seed, node, index)
            self._drawn.append((place, source))
        return place

    def settle(self, first: int) -> int:
        """What is drawn stands from that place on; where it ends."""
        self._first = first
        for number, (row, _) in enumerate(self._drawn):
            end = first + (number + 1) * AHEAD
            self._rows[row + D.NEXT], self._rows[row + D.LIMIT] = end, end - at.RESERVE
        return first + len(self._drawn) * AHEAD

    def fill(self, m: Int64s) -> None:
        """Draw for all streams that run short (all, the first time)."""
        for number, (row, source) in enumerate(self._drawn):
            begin = self._first + number * AHEAD
            if m[row + D.NEXT] < m[row + D.LIMIT] - BLOCK:
                continue
            used = (int(m[row + D.NEXT]) - begin) // BLOCK * BLOCK
            values = m[begin : begin + AHEAD]
            values[: AHEAD - used] = values[used:].copy()
            for place in range(AHEAD - used, AHEAD, BLOCK):
                values[place : place + BLOCK] = next(source)
            m[row + D.NEXT] -= used


@dataclass(frozen=True)
class Machine:
    """The engine's array, and what is read of it: latencies and the log."""

    array: Int64s
    streams: Streams
    latencies: Int64s
    logs: tuple[Int64s, ...]

    def entries(self, kind: int) -> Int64s:
        """The log's entries of a kind: a row of times, one of threads, and one for each field."""
        return self.logs[kind][:, : self._counts()[kind]]

    def forget_entries(self) -> None:
        """The log is empty again."""
        self._counts()[:] = 0

    def _counts(self) -> Int64s:
        first = self.array[X.LOGS] + A.COUNT
        return self.array[first : first + len(self.logs) * A.COLUMNS : A.COLUMNS]


def build_machine(
    system: System,
    plan: ApplicationPlan | None,
    timing: Timing,
    *,
    switches: bool,
    latencies: int,
) -> Machine:
    """The array of a system before anything has happened.

    ``latencies`` is for how many recorded instances of the chain the latency is noted; where it is
    for none, events are logged, with ``switches`` those of threads as well.
    """
    rows = Rows([0] * X.COLUMNS)
    streams = Streams(system.application.seed, rows)
    cores = rows.add(len(system.cores), C.COLUMNS)
    threads = rows.add(len(system.threads), T.COLUMNS, NONE)
    entities = rows.add(len(system.entities), E.COLUMNS)
    publishers = rows.add(len(system.publishers), P.COLUMNS)
    _fill_cores(rows, system, (cores, threads), plan, timing)
    _fill_threads(rows, system, threads, entities, streams)
    _fill_entities(rows, system, (threads, entities, publishers), timing, streams)
    _fill_publishers(rows, system, publishers, entities)
    histories = sum(rows[entity + E.DEPTH] for entity in entities)
    synchronised = (e.topic for e in system.entities if e.described.synchronises)
    waiting = histories + sum(system.depth(topic or "") for topic in synchronised)
    unsent = sum(system.depth(publisher.topic) for publisher in system.publishers)
    pool = POOL + waiting + unsent + at.RESERVE
    entries = 0 if latencies else LOG_ENTRIES
    logs = rows.add(len(at.LOG_FIELDS), A.COLUMNS)
    first_message = streams.settle(len(rows))
    heap = first_message + pool * M.COLUMNS
    heap_end = heap + (pool + len(entities) + len(threads) + at.RESERVE) * H.COLUMNS
    end = heap_end
    for log, fields in zip(logs, at.LOG_FIELDS, strict=True):
        rows[log + A.FIRST], rows[log + A.STRIDE] = end, entries
        end += fields * entries
    described = system.application.simulation
    for column, value in {
        X.CORES: cores.start,
        X.CORES_END: cores.stop,
        X.HEAP_LIMIT: heap_end - at.RESERVE * H.COLUMNS,
        X.HEAP: heap,
        X.LOGS: logs.start,
        X.LATENCIES: end,
        X.LATENCIES_END: end + latencies,
        X.FREE: first_message,
        X.UNUSED: pool,
        X.STOP: timing.stop_ns,
        X.LAST_TIMER: timing.last_timer_ns,
        X.RECORD_FROM: timing.record_from_ns,
        X.LOGGING: not latencies,
        X.SWITCHES: switches,
        X.SWITCH_COST: described.context_switch_ns,
        X.PREEMPTION_COST: described.preemption_ns,
        X.QUANTUM: described.quantum_ns if plan is not None and plan.takes_turns else at.FOREVER,
        X.AWAY: round(1e6 * described.interrupts / (1 - described.interrupts)),
        X.CYCLE: plan.cycle_ns if plan is not None else 0,
    }.items():
        rows[column] = value
    m = np.zeros(end + latencies, dtype=np.int64)
    m[: len(rows)] = rows
    m[end:] = NONE
    messages = m[first_message:heap].reshape(-1, M.COLUMNS)
    messages[:] = NONE
    messages[:-1, M.NEXT] = range(first_message + M.COLUMNS, heap, M.COLUMNS)
    timers = zip(entities, system.entities, strict=True)
    expiries = sorted((rows[place + E.DUE], place) for place, e in timers if e.kind == "timer")
    for order, (due, place) in enumerate(expiries):  # in order, they are a heap
        first = heap + order * H.COLUMNS
        m[first : first + H.COLUMNS] = due, order, at.EXPIRY, place
    m[X.COUNTER], m[X.HEAP_END] = len(expiries), heap + len(expiries) * H.COLUMNS
    streams.fill(m)
    views = tuple(
        m[rows[log + A.FIRST] :][: fields * entries].reshape(fields, entries)
        for log, fields in zip(logs, at.LOG_FIELDS, strict=True)
    )
    return Machine(m, streams, m[end:], views)


def _fill_cores(
    rows: Rows,
    system: System,
    areas: tuple[range, range],
    plan: ApplicationPlan | None,
    timing: Timing,
) -> None:
    """The cores, and the core, rank and server of each thread."""
    cores, threads = areas
    order, takes_turns = ((), False) if plan is None else (plan.most_urgent_first, plan.takes_turns)
    places = {node: place for place, node in enumerate(order)}
    for thread, info in zip(threads, system.threads, strict=True):
        rows[thread + T.CORE] = cores[system.cores.index(info.cores[0])]
        rows[thread + T.RANK] = BEST_EFFORT - info.priority
    for place, core in zip(cores, system.cores, strict=True):
        own = [] if plan is None else [server for server in plan.servers if server.core == core]
        used = [server for server in own if server in system.servers.values()]
        ranked = sorted(used, key=lambda server: server.priority)
        governed = {
            number: (
                server.priority if takes_turns else ranked.index(server),
                places.get(system.threads[number].node, len(order)),
            )
            for number, server in system.servers.items()
            if server in ranked
        }
        urgent = sorted(set(governed.values()))
        for number, urgency in governed.items():
            server = system.servers[number]
            rows[threads[number] + T.SERVER] = ranked.index(server)
            rows[threads[number] + T.RANK] = urgent.index(urgency) - len(urgent)
            if server.best_effort:  # under the fair class, behind all real-time threads
                rows[threads[number] + T.RANK] = BEST_EFFORT
        mine = [thread for thread in threads if rows[thread + T.CORE] == place]
        rows[place + C.FIRST], rows[place + C.END] = rows.put(mine)
        rows[place + C.RUNNING], rows[place + C.LAST] = NONE, NONE
        rows[place + C.UNTIL], rows[place + C.BOUNDARY] = at.FOREVER, at.FOREVER
        rows[place + C.DIRTY] = 1
        if plan is None or not ranked:
            continue
        table = _slot_table(plan, ranked)
        first, end = rows.put([number for pair in table for number in pair])
        rows[place + C.TABLE], rows[place + C.TABLE_END] = first, end
        # The run starts anywhere in a cycle.
        anchor = timing.start_ns if plan.moves_timers else timing.anchor_ns
        elapsed = (timing.start_ns - anchor) % plan.cycle_ns
        current = max(number for number, (offset, _) in enumerate(table) if offset <= elapsed)
        following = (current + 1) % len(table)
        rows[place + C.MASK], rows[place + C.NEXT] = table[current][1], first + 2 * following
        until = table[following][0] + (plan.cycle_ns if following <= current else 0)
        rows[place + C.BOUNDARY] = timing.start_ns - elapsed + until


def _slot_table(plan: ApplicationPlan, ranked: Sequence[Server]) -> list[tuple[int, int]]:
    """Rows (offset in the cycle, mask of the servers that are open from then on)."""
    # A free shaping node times its messages itself: its thread needs no slot to run in.
    slots = [
        server.slots if plan.free_threads.isdisjoint(server.threads) else ((0, plan.cycle_ns),)
        for server in ranked
    ]
    offsets = {0} | {instant for own in slots for slot in own for instant in slot}
    table = []
    for offset in sorted(offset for offset in offsets if offset < plan.cycle_ns):
        is_open = [any(start <= offset < end for start, end in own) for own in slots]
        table.append((offset, sum(1 << bit for bit, one in enumerate(is_open) if one)))
    return table


def _fill_threads(
    rows: Rows, system: System, threads: range, entities: range, streams: Streams
) -> None:
    described = system.application.simulation
    named = zip(threads, system.threads, strict=True)
    # Of an executor, its first thread's.
    places = {(info.pid, info.role): place for place, info in reversed([*named])}
    for number, (thread, info) in enumerate(zip(threads, system.threads, strict=True)):
        for column in (T.RUNNABLE, T.LEFT, T.SEQUENCE, T.PREEMPTED, T.USED):
            rows[thread + column] = 0
        rows[thread + T.ROW] = number
        pool = places[info.pid, "executor"]
        worker = (thread - pool) // T.COLUMNS if info.role == "executor" else 0
        offset = FIRST_COST + len(COSTS) * (ROLES.index(info.role) + len(ROLES) * worker)
        for place, name in enumerate(COSTS):
            if (times := getattr(described, name)) is not None:
                stream = streams.add(times, info.node, offset + place)
                rows[thread + T.WAKE + place] = stream
        if info.role != "executor":
            sends = info.role == "publisher"
            rows[thread + T.KIND] = at.PUBLISHER if sends else at.DDS
            rows[thread + T.STEP] = at.SEND if sends else at.RECEIVE
            continue
        kinds = {"static": at.STATIC, "events": at.EVENTS}
        rows[thread + T.KIND] = kinds.get(described.executor, at.SINGLE_THREADED)
        rows[thread + T.POOL] = pool
        rows[pool + T.POOL_END], rows[pool + T.OWNER] = thread + T.COLUMNS, pool
        for several in range(pool, thread + 1, T.COLUMNS) if worker else ():
            rows[several + T.KIND] = at.MULTI_THREADED
        pids = [system.processes[entity.process].pid for entity in system.entities]
        rows[thread + T.FIRST] = entities[pids.index(info.pid)]
        rows[thread + T.END] = rows[thread + T.FIRST] + pids.count(info.pid) * E.COLUMNS
        rows[thread + T.STEP] = at.TURN if worker else at.COLLECT
        rows[thread + T.PUBLISHER_THREAD] = places.get((info.pid, "publisher"), NONE)
        rows[thread + T.DDS_THREAD] = places.get((info.pid, "dds"), NONE)


def _fill_entities(
    rows: Rows, system: System, areas: tuple[range, ...], timing: Timing, streams: Streams
) -> None:
    threads, entities, publishers = areas
    named = zip(threads, system.threads, strict=True)
    executors = {info.pid: place for place, info in reversed([*named]) if info.role == "executor"}
    groups: dict[tuple[int, str], int] = {}
    # What inputs of a synchroniser share, and a gate with its listener: stream, gate or inputs.
    executions: dict[tuple[int, int], int] = {}
    bodies: dict[tuple[int, int], int] = {}
    for number, (row, entity) in enumerate(zip(entities, system.entities, strict=True)):
        described, process = entity.described, system.processes[entity.process]
        callback, gate = (entity.process, entity.index), entity.described.gate
        on_chain = number in system.chain.callbacks
        if callback not in executions:
            executions[callback] = streams.add(described.execution, process.node, entity.index)
        body = at.COMPUTE
        if gate is not None:
            body = at.MODE_LISTENER if entity.listens else at.GATE
            if callback not in bodies:
                bodies[callback] = _add_gate(rows, system, described, timing)
        elif described.synchronises:
            body = at.SYNCHRONISE
            if callback not in bodies:
                inputs = rows.add(len(described.synchronises), I.COLUMNS)
                bodies[callback] = rows.put([inputs.start, inputs.stop])[0]
            depth = system.depth(entity.topic or "")
            first = rows[bodies[callback] + S.FIRST] + entity.number * I.COLUMNS
            rows[first : first + I.COLUMNS] = [on_chain, rows.ring(depth), depth, 0, 0]
        rows[row + E.ROW], rows[row + E.THREAD] = number, executors[process.pid]
        group = system.application.nodes[process.key].exclusive_group(described)
        if group is not None and (entity.process, group) not in groups:
            groups[entity.process, group] = rows.put([0])[0]
        rows[row + E.GROUP] = NONE if group is None else groups[entity.process, group]
        rows[row + E.KIND], rows[row + E.INPUT] = KINDS.index(entity.kind), entity.number
        rows[row + E.BODY], rows[row + E.BODY_ROW] = body, bodies.get(callback, NONE)
        rows[row + E.EXECUTION] = executions[callback]
        if entity.publishers:
            rows[row + E.PUBLISHERS] = publishers[entity.publishers[0]]
            rows[row + E.PUBLISHERS_END] = publishers[entity.publishers[-1]] + P.COLUMNS
        rows[row + E.STARTS_CHAIN] = number in system.chain.callbacks[:1]
        rows[row + E.ON_CHAIN] = number in system.chain.callbacks[1:]
        rows[row + E.LIFESPAN] = NONE
        if entity.topic is None:
            drift = system.application.simulation.drift.get(process.key, 0)
            period = described.timer_ns or 0
            rows[row + E.PERIOD] = max(1, round(period * (1 - drift / 1_000_000)))
            rows[row + E.DUE] = timing.start_ns + described.phase_ns
        else:
            topic = system.application.topic(entity.topic)
            depth = topic.depth if gate is None or entity.listens else gate.depth
            rows[row + E.HISTORY], rows[row + E.DEPTH] = rows.ring(depth), depth
            if topic.lifespan_ns is not None:
                rows[row + E.LIFESPAN] = topic.lifespan_ns


def _add_gate(rows: Rows, system: System, described: CallbackDescription, timing: Timing) -> int:
    gate, number_of = described.gate, WORDS["overrun"].index
    assert gate is not None  # noqa: S101 - the caller has seen it
    slots, slots_end = rows.put([instant for slot in gate.slots for instant in slot])
    moves, moves_end = rows.put([number for move in gate.moved(timing.start_ns) for number in move])
    (row,) = rows.add(1, at.GATE_COLUMNS, NONE)
    for column, value in {
        G.SLOTS: slots,
        G.SLOTS_END: slots_end,
        G.MOVES: moves,
        G.MOVES_END: moves_end,
        G.CYCLE: gate.cycle_ns,
        G.STAMPED: int(gate.anchor == "stamp"),
        G.OVERRUN: number_of(gate.overrun),
        G.DUE: gate.due_cycles,
        G.SPIN: gate.spin_ns,
        G.PAUSE: gate.pause_ns,
        G.MESSAGES: WORDS["messages"].index(gate.messages),
        G.AT_ONCE: int(gate.into_open_slot == "at-once"),
        G.PHASE: timing.start_ns + gate.phase_ns if gate.phase_ns is not None else timing.anchor_ns,
        G.CHANGED: 0,
        G.CHANGES: rows.add(CHANGES, 2).start,
    }.items():
        rows[row + column] = value
    if gate.modes is not None:
        rows[row + G.LATE] = number_of(gate.modes.late)
        rows[row + G.DEFAULT] = system.modes.index(gate.modes.default)
        bands, _ = rows.put([gate.modes.bands.get(mode, NONE) for mode in system.modes])
        rows[row + G.BANDS] = bands
    return row


def _fill_publishers(rows: Rows, system: System, publishers: range, entities: range) -> None:
    owner = {p: entity for entity in system.entities for p in entity.publishers}
    ends: tuple[int, ...] = ()
    if system.chain.callbacks:
        ends = system.entities[system.chain.callbacks[-1]].publishers
    for number, (row, publisher) in enumerate(zip(publishers, system.publishers, strict=True)):
        topic = system.application.topic(publisher.topic)
        reached = system.readers.get(publisher.topic, ())
        readers = rows.add(len(reached), R.COLUMNS)
        for reader, entity in zip(readers, reached, strict=True):
            rows[reader + R.ENTITY] = entities[entity]
        modes = [system.modes.index(mode) for mode in owner[number].described.announces]
        rows[row + P.ROW] = number
        rows[row + P.FIRST], rows[row + P.END] = readers.start, readers.stop
        rows[row + P.ASYNCHRONOUS], rows[row + P.DEPTH] = publisher.asynchronous, topic.depth
        rows[row + P.LIFESPAN] = NONE if topic.lifespan_ns is None else topic.lifespan_ns
        rows[row + P.ENDS_CHAIN] = number in ends and publisher.topic == system.chain.topics[-1]
        rows[row + P.MODES], _ = rows.put(modes)
        rows[row + P.MODES_COUNT] = len(modes)
