"""What is simulated: an application in words (:class:`System`), then in the engine's array.

The order of the words is that of the array's rows: a number in the engine's log leads to a name.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from chainshaper.analysis.chains import find_chain
from chainshaper.gate.decision import CHANGES
from chainshaper.planning.application_plan import ApplicationPlan
from chainshaper.planning.plan import ReceiverPlace, Server, Thread
from chainshaper.simulation import layout as at
from chainshaper.simulation.layout import NONE, C, D, E, G, H, I, Int64s, M, P, R, T, X
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
from chainshaper.workload.execution import BLOCK, FIRST_AFTER, blocks
from chainshaper.workload.live import Timing

FIRST_PID, FIRST_TID = 1000, 100_000  # of processes, and of executors' threads but the first
ROLES = ("executor", "publisher", "dds")
KINDS = ("timer", "subscription", "service", "client")
STATIC_ORDER = ("subscription", "timer", "client", "service")
"""The orders in which executors look at what is ready, the static one and others (Jazzy)."""

AHEAD = 16 * BLOCK  # values of every stream that are drawn beforehand
FIRST_COST = 1 << 20
"""Costs are numbered from here, callbacks of a node from 0: no two draw the same sequence."""
FIRST_DELIVERY = 1 << 21  # and deliveries from here, by publishing node, callback and input
LOG_ROWS = 1 << 17
POOL = 4096  # messages under way, besides those in histories
BEST_EFFORT = 1000
COSTS = ("wake_up", "take", "publish", "receive", "delivery")  # in the order of their columns


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

    ``servers`` are by thread, and ``receivers`` of outputs, which are in none, with their places.
    ``chain`` has its callbacks by entity; it is empty where it is not followed.
    """

    application: Application
    processes: tuple[Process, ...]
    threads: tuple[ThreadInfo, ...]
    servers: Mapping[int, Server]
    receivers: Mapping[int, ReceiverPlace]
    cores: tuple[int, ...]
    entities: tuple[Entity, ...]
    publishers: tuple[Publisher, ...]
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
    application: Application, process: int, key: str, publishers: list[Publisher]
) -> Iterator[Entity]:
    """A node's entities in the order of registration; their publishers are added to the list."""
    for index, described in enumerate(application.nodes[key].callbacks):
        own = tuple(range(len(publishers), len(publishers) + len(described.publishes)))
        for topic in described.publishes:
            asynchronous = application.topic(topic).publication == "asynchronous"
            publishers.append(Publisher(process, topic, asynchronous))
        if described.timer_ns is not None:
            yield Entity(process, index, 0, "timer", None, described, own)
        of_modes = len(described.subscriptions) - len(described.inputs)
        for number, topic in enumerate(described.subscriptions):
            if number < of_modes:
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


def _receivers(
    plan: ApplicationPlan, threads: Sequence[ThreadInfo], servers: Mapping[int, Server]
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

    def set(self, row: int, values: Mapping[Any, int]) -> None:
        """Fields of a row, by column."""
        for column, value in values.items():
            self[row + column] = value


class Streams:
    """All streams of a simulation: drawn in Python, consumed by the engine.

    A callback's stream is that of the live workload, value for value. ``deliveries`` are the places
    of those by which messages reach an entity: by process, callback and input.
    """

    def __init__(self, seed: int, rows: Rows) -> None:
        self._seed, self._rows = seed, rows
        self._drawn: list[tuple[int, Iterator[Int64s]]] = []
        self.deliveries: dict[tuple[int, int, int], int] = {}
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
        for row, _ in self._drawn:
            first += AHEAD
            self._rows[row + D.NEXT], self._rows[row + D.LIMIT] = first, first - at.RESERVE
        return first

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


class Handles(NamedTuple):
    """Of entities: callback, own, rmw; of publishers: own, rmw."""

    entities: Sequence[tuple[int, int, int]]
    publishers: Sequence[tuple[int, int]]


class Machine:
    """The engine's array before anything has happened, and what is read of it.

    ``latencies`` is for how many recorded instances of the chain the latency is noted; where it is
    for none, events are logged, with ``switches`` those of threads as well.
    """

    def __init__(
        self,
        system: System,
        handles: Handles,
        plan: ApplicationPlan | None,
        timing: Timing,
        *,
        switches: bool,
        latencies: int,
    ) -> None:
        self._system, self._handles, self._plan, self._timing = system, handles, plan, timing
        self._rows = rows = Rows([0] * X.COLUMNS)
        self._streams = Streams(system.application.seed, rows)
        self._cores = rows.add(len(system.cores), C.COLUMNS)
        self._threads = rows.add(len(system.threads), T.COLUMNS, NONE)
        self._first_threads = {
            (one.pid, one.role): row
            for row, one in zip(reversed(self._threads), reversed(system.threads), strict=True)
        }
        self._entities = rows.add(len(system.entities), E.COLUMNS)
        self._publishers = rows.add(len(system.publishers), P.COLUMNS)
        self._fill_cores()
        self._fill_threads()
        self._fill_entities()
        self._fill_publishers()
        topics = [one.topic or "" for one in system.entities]
        topics += [one.topic for one in system.publishers]
        waiting = 2 * sum(map(system.depth, topics))  # a message, and its mark
        waiting += sum(rows[entity + E.DEPTH] for entity in self._entities)
        pool = POOL + waiting + at.RESERVE
        counts, _ = rows.put([0] * (at.L_SWITCH + 1))
        first_message = self._streams.settle(len(rows))
        events = first_message + pool * M.COLUMNS
        most = pool + len(self._entities) + len(self._threads)
        log = events + (most + at.RESERVE) * H.COLUMNS
        kinds = 0 if latencies else at.L_SWITCH + 1
        end = log + kinds * at.LOG_COLUMNS * LOG_ROWS
        expiries = sorted(
            ((rows[place + E.DUE], place) for place in self._entities if rows[place + E.DUE]),
            reverse=True,
        )
        described = system.application.simulation
        turns = plan is not None and plan.takes_turns
        away = round(1e6 * described.interrupts / (1 - described.interrupts))
        quantum = described.quantum_ns if turns else at.FOREVER
        rows.set(0, {X.CORES: self._cores.start, X.CORES_END: self._cores.stop})
        rows.set(0, {X.EVENTS: events, X.EVENTS_END: events + len(expiries) * H.COLUMNS})
        rows.set(0, {X.EVENTS_LIMIT: events + most * H.COLUMNS, X.FREE: first_message})
        rows.set(0, {X.LOGGED: counts, X.LOG: log, X.LOG_ROWS: LOG_ROWS, X.UNUSED: pool})
        rows.set(0, {X.LATENCIES: end, X.LATENCIES_END: end + latencies, X.LOGGING: not latencies})
        rows.set(0, {X.STOP: timing.stop_ns, X.LAST_TIMER: timing.last_timer_ns})
        rows.set(0, {X.RECORD_FROM: timing.record_from_ns, X.SWITCHES: switches})
        rows.set(0, {X.SWITCH_COST: described.context_switch_ns, X.QUANTUM: quantum, X.AWAY: away})
        rows.set(0, {X.PREEMPTION_COST: described.preemption_ns})
        rows.set(0, {X.CYCLE: 0 if plan is None else plan.cycle_ns})
        self.array = m = np.zeros(end + latencies, dtype=np.int64)
        m[: len(rows)] = rows
        m[end:] = NONE
        messages = m[first_message:events].reshape(-1, M.COLUMNS)
        messages[:] = NONE
        messages[:-1, M.NEXT] = range(first_message + M.COLUMNS, events, M.COLUMNS)
        for (due, place), first in zip(expiries, range(events, end, H.COLUMNS), strict=False):
            m[first : first + H.COLUMNS] = due, at.EXPIRY, place
        self._streams.fill(m)
        self.latencies = m[end:]
        self._log = m[log:end].reshape(kinds, at.LOG_COLUMNS, LOG_ROWS)
        self._counts = m[counts : counts + kinds]

    def draw_more(self) -> None:
        """Draw for all streams that run short."""
        self._streams.fill(self.array)

    def take_log(self) -> list[Int64s]:
        """The columns of the log, by kind, until the engine goes on; it is empty then."""
        found = [log[:, :count] for log, count in zip(self._log, self._counts, strict=True)]
        self._counts[:] = 0
        return found

    def _fill_cores(self) -> None:
        """The cores, and the core, rank and server of each thread."""
        rows, system, plan, timing = self._rows, self._system, self._plan, self._timing
        for thread, info in zip(self._threads, system.threads, strict=True):
            rows[thread + T.CORE] = self._cores[system.cores.index(info.cores[0])]
            rows[thread + T.RANK] = BEST_EFFORT - info.priority
        for place, core in zip(self._cores, system.cores, strict=True):
            threads = [thread for thread in self._threads if rows[thread + T.CORE] == place]
            first, end = rows.put(threads)
            rows.set(place, {C.FIRST: first, C.END: end, C.DIRTY: 1, C.RUNNING: NONE, C.LAST: NONE})
            rows.set(place, {C.UNTIL: at.FOREVER, C.BOUNDARY: at.FOREVER})
            governed = {number: one for number, one in system.servers.items() if one.core == core}
            if plan is None or not governed:
                continue
            ranked = [server for server in plan.servers if server in governed.values()]
            ranked.sort(key=lambda server: server.priority)
            receiving = {n: one for n, one in system.receivers.items() if one.core == core}
            self._rank(plan, governed, ranked, receiving)
            table = _slot_table(plan, ranked)
            first, end = rows.put([number for pair in table for number in pair])
            # The run starts anywhere in a cycle.
            anchor = timing.start_ns if plan.moves_timers else timing.anchor_ns
            elapsed = (timing.start_ns - anchor) % plan.cycle_ns
            current = max(number for number, (offset, _) in enumerate(table) if offset <= elapsed)
            following = (current + 1) % len(table)
            until = table[following][0] + (plan.cycle_ns if following <= current else 0)
            rows.set(place, {C.TABLE: first, C.TABLE_END: end, C.MASK: table[current][1]})
            rows.set(place, {C.NEXT: first + 2 * following})
            rows[place + C.BOUNDARY] = timing.start_ns - elapsed + until

    def _rank(
        self,
        plan: ApplicationPlan,
        governed: dict[int, Server],
        ranked: list[Server],
        receiving: dict[int, ReceiverPlace],
    ) -> None:
        """Server and rank of the threads that are ``governed`` on a core: by the priority of the
        server and, within one, in the plan's order, as `server_priorities` has them live; and the
        rank of those ``receiving`` an output, behind all of their priority.
        """
        order = plan.most_urgent_first
        place_of = {node: place for place, node in enumerate(order)}
        named = {
            number: place_of.get(self._system.threads[number].node, len(order))
            for number in governed
        }
        taken = {
            server.name: sorted({named[n] for n, one in governed.items() if one is server})
            for server in ranked
        }
        behind_outputs = plan.behind_outputs
        urgency = {
            number: (
                server.priority,
                taken[server.name].index(named[number]) + (server.name in behind_outputs),
            )
            for number, server in governed.items()
        }
        behind = {number: (one.priority, len(governed)) for number, one in receiving.items()}
        urgent = sorted({*urgency.values(), *behind.values()})
        for number, key in behind.items():
            self._rows[self._threads[number] + T.RANK] = urgent.index(key) - len(urgent)
        for number, server in governed.items():
            rank = urgent.index(urgency[number]) - len(urgent)
            if server.best_effort:  # under the fair class, behind all real-time threads
                rank = BEST_EFFORT
            self._rows.set(self._threads[number], {T.SERVER: ranked.index(server), T.RANK: rank})

    def _fill_threads(self) -> None:
        rows, system = self._rows, self._system
        described = system.application.simulation
        pids = [system.processes[entity.process].pid for entity in system.entities]
        for number, (thread, info) in enumerate(zip(self._threads, system.threads, strict=True)):
            rows.set(thread, {T.ROW: number, T.RUNNABLE: 0, T.LEFT: 0, T.SEQUENCE: 0})
            rows.set(thread, {T.PREEMPTED: 0, T.USED: 0, T.WAITING: 0})
            pool = self._thread(info.pid, "executor")
            worker = (thread - pool) // T.COLUMNS if info.role == "executor" else 0
            offset = FIRST_COST + len(COSTS) * (ROLES.index(info.role) + len(ROLES) * worker)
            for place, name in enumerate(COSTS):
                if (times := getattr(described, name)) is not None:
                    stream = self._streams.add(times, info.node, offset + place)
                    rows[thread + T.WAKE + place] = stream
            if info.role == "publisher":
                rows.set(thread, {T.KIND: at.PUBLISHER, T.STEP: at.SEND})
            elif info.role == "dds":
                rows.set(thread, {T.KIND: at.DDS, T.STEP: at.RECEIVE})
            else:
                first = self._entities[pids.index(info.pid)]
                end = first + pids.count(info.pid) * E.COLUMNS
                kinds = {"static": at.STATIC, "events": at.EVENTS}
                kind = kinds.get(described.executor, at.SINGLE_THREADED)
                rows.set(thread, {T.KIND: kind, T.FIRST: first, T.END: end, T.POOL: pool})
                rows[thread + T.STEP] = at.TURN if worker else at.COLLECT
                rows[thread + T.PUBLISHER_THREAD] = self._thread(info.pid, "publisher")
                rows[thread + T.DDS_THREAD] = self._thread(info.pid, "dds")
                rows.set(pool, {T.POOL_END: thread + T.COLUMNS, T.OWNER: pool})
                for several in range(pool, thread + 1, T.COLUMNS) if worker else ():
                    rows[several + T.KIND] = at.MULTI_THREADED

    def _thread(self, pid: int, role: str) -> int:
        """The first thread of a process that has a role, NONE if none has."""
        return self._first_threads.get((pid, role), NONE)

    def _fill_entities(self) -> None:
        rows, system, timing = self._rows, self._system, self._timing
        # What the entities of a callback share, and the callbacks of a group.
        executions: dict[tuple[int, int], int] = {}
        afterwards: dict[tuple[int, int], int] = {}
        bodies: dict[tuple[int, int], int] = {}
        groups: dict[tuple[int, str], int] = {}
        for number, (row, entity) in enumerate(zip(self._entities, system.entities, strict=True)):
            described, process = entity.described, system.processes[entity.process]
            callback, gate = (entity.process, entity.index), described.gate
            on_chain = number in system.chain.callbacks
            if callback not in executions:
                stream = self._streams.add(described.execution, process.node, entity.index)
                executions[callback] = stream
                if described.afterwards is not None:
                    times, number_of = described.afterwards, FIRST_AFTER + entity.index
                    afterwards[callback] = self._streams.add(times, process.node, number_of)
            body = at.COMPUTE
            if gate is not None:
                body = at.MODE_LISTENER if entity.listens else at.GATE
                if callback not in bodies:
                    bodies[callback] = _add_gate(rows, system, described, timing)
            elif described.synchronises:
                body = at.SYNCHRONISE
                if callback not in bodies:
                    bodies[callback] = rows.add(len(described.synchronises), I.COLUMNS).start
                self._fill_input(entity, bodies[callback], on_chain)
            group = system.application.nodes[process.key].exclusive_group(described)
            if group is not None and (entity.process, group) not in groups:
                groups[entity.process, group] = rows.put([0])[0]
            rows[row : row + 3] = self._handles.entities[number]
            rows[row + E.THREAD] = self._thread(process.pid, "executor")
            rows[row + E.GROUP] = NONE if group is None else groups[entity.process, group]
            rows.set(row, {E.KIND: KINDS.index(entity.kind), E.INPUT: entity.number, E.BODY: body})
            rows.set(row, {E.BODY_ROW: bodies.get(callback, NONE), E.LIFESPAN: NONE})
            rows[row + E.EXECUTION] = executions[callback]
            rows[row + E.AFTERWARDS] = afterwards.get(callback, NONE)
            if publishers := [self._publishers[one] for one in entity.publishers]:
                end = publishers[-1] + P.COLUMNS
                rows.set(row, {E.PUBLISHERS: publishers[0], E.PUBLISHERS_END: end})
            rows[row + E.STARTS_CHAIN] = number in system.chain.callbacks[:1]
            rows[row + E.ON_CHAIN] = number in system.chain.callbacks[1:]
            if entity.topic is None:
                drift = system.application.simulation.drift.get(process.key, 0)
                period = (described.timer_ns or 0) * (1 - drift / 1_000_000)
                due = timing.start_ns + described.phase_ns
                rows.set(row, {E.PERIOD: max(1, round(period)), E.DUE: due})
            else:
                topic = system.application.topic(entity.topic)
                rows[row + E.DEPTH] = topic.depth if gate is None or entity.listens else gate.depth
                rows[row + E.LIFESPAN] = NONE if topic.lifespan_ns is None else topic.lifespan_ns

    def _fill_input(self, entity: Entity, first: int, on_chain: bool) -> None:
        """The input of a synchroniser, whose inputs stand from ``first`` on, that an entity is."""
        topics, triggered_by = entity.described.synchronises, entity.described.triggered_by
        trigger, depth = NONE, self._system.depth(entity.topic or "")
        if triggered_by is not None:
            trigger, depth = first + topics.index(triggered_by) * I.COLUMNS, 1
        own = {I.ON_CHAIN: on_chain, I.DEPTH: depth, I.END: first + len(topics) * I.COLUMNS}
        self._rows.set(first + entity.number * I.COLUMNS, own | {I.TRIGGER: trigger})

    def _fill_publishers(self) -> None:
        rows, system = self._rows, self._system
        owner = {one: entity for entity in system.entities for one in entity.publishers}
        last = system.chain.callbacks[-1:]
        reading: dict[str | None, list[int]] = {}
        for number, entity in enumerate(system.entities):
            reading.setdefault(entity.topic, []).append(number)
        for number, publisher in enumerate(system.publishers):
            row = self._publishers[number]
            topic = system.application.topic(publisher.topic)
            reached = reading.get(publisher.topic, [])
            readers = rows.add(len(reached), R.COLUMNS)
            for reader, read_by in zip(readers, reached, strict=True):
                rows[reader + R.ENTITY] = self._entities[read_by]
                rows[reader + R.DELIVERY] = self._delivery(system.entities[read_by], publisher)
            announces = owner[number].described.announces
            modes, _ = rows.put([system.modes.index(mode) for mode in announces])
            ends = any(number in system.entities[one].publishers for one in last)
            rows[row : row + 3] = number, *self._handles.publishers[number]
            rows.set(row, {P.FIRST: readers.start, P.END: readers.stop, P.DEPTH: topic.depth})
            rows.set(row, {P.MODES: modes, P.MODES_COUNT: len(announces)})
            rows[row + P.ASYNCHRONOUS] = publisher.asynchronous
            rows[row + P.LIFESPAN] = NONE if topic.lifespan_ns is None else topic.lifespan_ns
            rows[row + P.ENDS_CHAIN] = ends and publisher.topic == system.chain.topics[-1]

    def _delivery(self, reader: Entity, publisher: Publisher) -> int:
        """The stream of a reader's own times of delivery, from all publishers of its topic in the
        order of their publications; NONE: it has none."""
        process = self._system.processes[reader.process]
        described = self._system.application.simulation.deliveries.get(process.key, {})
        if publisher.topic not in described:
            return NONE
        place = (reader.process, reader.index, reader.number)
        if place not in self._streams.deliveries:
            number = FIRST_DELIVERY + (publisher.process << 32)
            number += (reader.index << 16) + reader.number
            stream = self._streams.add(described[publisher.topic], process.node, number)
            self._streams.deliveries[place] = stream
        return self._streams.deliveries[place]


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


def _add_gate(rows: Rows, system: System, described: CallbackDescription, timing: Timing) -> int:
    gate, number_of = described.gate, WORDS["overrun"].index
    assert gate is not None  # noqa: S101 - the caller has seen it
    slots, slots_end = rows.put([instant for slot in gate.slots for instant in slot])
    moves, moves_end = rows.put([number for move in gate.moved(timing.start_ns) for number in move])
    (row,) = rows.add(1, at.GATE_COLUMNS, NONE)
    phase = timing.anchor_ns if gate.phase_ns is None else timing.start_ns + gate.phase_ns
    rows.set(row, {G.SLOTS: slots, G.SLOTS_END: slots_end, G.MOVES: moves, G.MOVES_END: moves_end})
    rows.set(row, {G.CYCLE: gate.cycle_ns, G.DUE: gate.due_cycles, G.PHASE: phase})
    rows.set(row, {G.SPIN: gate.spin_ns, G.PAUSE: gate.pause_ns})
    rows.set(row, {G.STAMPED: gate.anchor == "stamp", G.OVERRUN: number_of(gate.overrun)})
    rows[row + G.MESSAGES] = WORDS["messages"].index(gate.messages)
    rows[row + G.AT_ONCE] = gate.into_open_slot == "at-once"
    rows.set(row, {G.CHANGED: 0, G.CHANGES: rows.add(CHANGES, 2).start})
    if (modes := gate.modes) is not None:
        bands, _ = rows.put([modes.bands.get(mode, NONE) for mode in system.modes])
        default = system.modes.index(modes.default)
        rows.set(row, {G.LATE: number_of(modes.late), G.DEFAULT: default, G.BANDS: bands})
    return row
