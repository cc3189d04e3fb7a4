"""The engine's description of a :class:`System`: its times, gates, servers and cores.

The engine (core/simulation) gets one description, in which things refer to each other by their
places in lists. While it runs it asks for random numbers, by stream.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from chainshaper import _core
from chainshaper.planning.chain_plan import ReceiverPlace, Server
from chainshaper.planning.plan import Plan
from chainshaper.robot.gate import values_of
from chainshaper.simulation.system import ROLES, Entity, SimulatedPublisher, System
from chainshaper.values.application import LOOP_END
from chainshaper.values.errors import InputError
from chainshaper.workload.description import (
    MOST_THREADS,
    CallbackDescription,
    ExecutionTime,
    TopicDescription,
    origin_timer,
)
from chainshaper.workload.execution import FIRST_AFTER, blocks
from chainshaper.workload.timing import Timing

Int64s = npt.NDArray[np.int64]

FIRST_COST = 1 << 20
"""Threads' costs are numbered from here, a node's callbacks from 0: each draws its own sequence."""
FIRST_DELIVERY = 1 << 21
"""Deliveries are numbered from here, by publishing node, callback and input."""
OF_EXECUTORS = 3  # roles whose threads' costs are numbered together, one by one
COSTS = ("wake_up", "take", "publish", "receive", "delivery")  # numbered in this order
BEST_EFFORT = 1000  # the rank of threads of the fair class, behind all real-time ones
LOG_ROWS = 1 << 17  # of a kind, in a part of the log
INSTANTS = 1 << 18  # after so many the engine pauses, so that Ctrl-C ends the simulation
POOL = 4096  # room for messages under way, besides those in histories

_NO_TIME = ExecutionTime(constant_ns=0)
_EXECUTORS = {
    "single-threaded": _core.ExecutorKind.single_threaded,
    "static": _core.ExecutorKind.static_single_threaded,
    "events": _core.ExecutorKind.events,
}


class Streams:
    """The random numbers of a simulation, in streams, drawn block by block as the engine asks.

    A callback's stream is that of the live workload, value for value.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self.constants: list[int | None] = []
        self._drawn: list[Iterator[Int64s]] = []

    def add(self, times: ExecutionTime, node: str | None, index: int) -> int:
        """Add a stream of CPU times or delays (ns); return its place."""
        self.constants.append(times.constant_ns)
        self._drawn.append(blocks(times, self._seed, node or "", index))
        return len(self.constants) - 1

    def draw(self, stream: int) -> Int64s:
        """The next values of a stream."""
        return next(self._drawn[stream])


class Handles(NamedTuple):
    """The handles of a system's objects, by their places."""

    entities: Sequence[tuple[int, int, int]]  # of the callback, of rcl and of rmw
    publishers: Sequence[tuple[int, int]]  # of rcl and of rmw


class Machine:
    """The engine, with the description of a system, the plan in force and the instants of a run.

    With ``latencies`` it notes the latency of so many recorded instances of the chain, and logs no
    events. With 0 it logs events, and with ``switches`` context switches as well.
    """

    def __init__(
        self,
        system: System,
        handles: Handles,
        plan: Plan | None,
        timing: Timing,
        *,
        switches: bool,
        latencies: int,
    ) -> None:
        self._system, self._handles, self._plan, self._timing = system, handles, plan, timing
        self._numbers = {process.node: place for place, process in enumerate(system.processes)}
        self._streams = Streams(system.application.seed)
        self._deliveries: dict[tuple[str, str, int], int] = {}
        self._groups: dict[tuple[int, str], int] = {}
        self._gates: list[_core.GateDescription] = []
        self._synchronisers: list[_core.SynchroniserDescription] = []
        self._loops: list[_core.LoopDescription] = []
        threads = self._threads()
        cores = self._cores(threads)
        entities = self._entities()
        publishers = self._publishers()
        described = system.application.simulation
        turns = plan is not None and plan.takes_turns
        away = round(1e6 * described.interrupts / (1 - described.interrupts))
        self.description = _core.Description(
            cores=cores,
            threads=threads,
            processes=self._processes(),
            entities=entities,
            publishers=publishers,
            gates=self._gates,
            synchronisers=self._synchronisers,
            loops=self._loops,
            streams=self._streams.constants,
            groups=len(self._groups),
            cycle_ns=0 if plan is None else plan.cycle_ns,
            quantum_ns=described.quantum_ns if turns else _core.FOREVER_NS,
            context_switch_ns=described.context_switch_ns,
            preemption_ns=described.preemption_ns,
            interrupts_ppm=min(away, _core.FOREVER_NS),
            last_timer_ns=timing.last_timer_ns,
            stop_ns=timing.stop_ns,
            record_from_ns=timing.record_from_ns,
            events=not latencies,
            switches=switches,
            instances=latencies,
            log_rows=LOG_ROWS,
            most_messages=POOL + self._waiting(entities),
        )
        try:
            self.simulation = _core.Simulation(self.description, self._streams.draw)
        except ValueError as error:
            raise InputError(f"{system.application.name}: {error}") from error

    def _waiting(self, entities: Sequence[_core.EntityDescription]) -> int:
        """How many messages may wait: in a history and for it to be sent, each with its mark."""
        depth, system = self._system.depth, self._system
        topics = [entity.topic or "" for entity in system.entities]
        topics += [publisher.topic for publisher in system.publishers]
        histories = sum(
            described.depth
            for described, entity in zip(entities, system.entities, strict=True)
            if entity.topic is not None
        )
        return 2 * sum(map(depth, topics)) + histories

    def _processes(self) -> list[_core.ProcessDescription]:
        system, processes = self._system, []
        several = [0] * len(system.processes)
        for info in system.threads:
            several[self._numbers[info.node or ""]] += info.role == "executor"
        kind = _EXECUTORS[system.application.simulation.executor]
        # Its loop, at which no executor looks, is the last entity of a process.
        of_process = [-1 if entity.kind == "loop" else entity.process for entity in system.entities]
        for number, threads in enumerate(several):
            count = of_process.count(number)
            processes.append(
                _core.ProcessDescription(
                    executor=_core.ExecutorKind.multi_threaded if threads > 1 else kind,
                    first_entity=of_process.index(number) if count else 0,
                    entity_count=count,
                )
            )
        return processes

    def _threads(self) -> list[_core.ThreadDescription]:
        system = self._system
        described, threads = system.application.simulation, []
        executing: dict[str | None, int] = {}  # threads of a node's executor so far
        for info in system.threads:
            assert info.role is not None  # noqa: S101 - of a simulated thread it is known
            worker = executing.get(info.node, 0) if info.role == "executor" else 0
            executing[info.node] = executing.get(info.node, 0) + (info.role == "executor")
            if info.role == "loop":
                worker = MOST_THREADS  # behind those of any executor
            place = ROLES.index(info.role) % OF_EXECUTORS + OF_EXECUTORS * worker
            first = FIRST_COST + len(COSTS) * place
            costs = {
                name: self._streams.add(times, info.node, first + number)
                for number, name in enumerate(COSTS)
                if (times := getattr(described, name)) is not None
            }
            threads.append(
                _core.ThreadDescription(
                    core=system.cores.index(info.cores[0]),
                    rank=BEST_EFFORT - info.priority,
                    role=getattr(_core.Role, info.role),
                    process=self._numbers[info.node or ""],
                    pid=info.pid,
                    tid=info.tid,
                    cpu=info.cores[0],
                    **costs,
                )
            )
        return threads

    def _cores(self, threads: Sequence[_core.ThreadDescription]) -> list[_core.CoreDescription]:
        """The cores; threads that a plan governs get their servers and ranks."""
        system, plan = self._system, self._plan
        cores = []
        for core in system.cores:
            governed = {
                thread: server for thread, server in system.servers.items() if server.core == core
            }
            if plan is None or not governed:
                cores.append(_core.CoreDescription())
                continue
            ranked = [server for server in plan.servers if server in governed.values()]
            ranked.sort(key=lambda server: server.priority)
            receiving = {
                thread: place for thread, place in system.receivers.items() if place.core == core
            }
            self._rank(threads, plan, governed, ranked, receiving)
            cores.append(_governed_core(plan, ranked, self._timing))
        return cores

    def _rank(
        self,
        threads: Sequence[_core.ThreadDescription],
        plan: Plan,
        governed: dict[int, Server],
        ranked: list[Server],
        receiving: dict[int, ReceiverPlace],
    ) -> None:
        """Set server and rank of the threads that a plan governs on a core.

        ``governed`` threads rank by the priority of their server and, within one, in the plan's
        order, as `server_priorities` has them live. Threads that are ``receiving`` an output rank
        behind all of their priority. Both are by the thread's place.
        """
        order = plan.most_urgent_first
        place_of = {node: place for place, node in enumerate(order)}
        position = {
            number: place_of.get(self._system.threads[number].node, len(order))
            for number in governed
        }
        positions = {
            server.name: sorted(
                {
                    position[thread]
                    for thread, its_server in governed.items()
                    if its_server is server
                }
            )
            for server in ranked
        }
        behind_outputs = plan.behind_outputs
        urgency = {
            number: (
                server.priority,
                positions[server.name].index(position[number]) + (server.name in behind_outputs),
            )
            for number, server in governed.items()
        }
        behind = {number: (place.priority, len(governed)) for number, place in receiving.items()}
        urgent = sorted({*urgency.values(), *behind.values()})
        for number, key in behind.items():
            threads[number].rank = urgent.index(key) - len(urgent)
        for number, server in governed.items():
            threads[number].server = ranked.index(server)
            threads[number].rank = urgent.index(urgency[number]) - len(urgent)
            if server.best_effort:  # under the fair class, behind all real-time threads
                threads[number].rank = BEST_EFFORT

    def _entities(self) -> list[_core.EntityDescription]:
        system, entities = self._system, []
        # The entities of a callback share its streams, and its gate, synchroniser or loop.
        executions: dict[tuple[int, int], tuple[int, int | None]] = {}
        bodies: dict[tuple[int, int], int] = {}
        for number, entity in enumerate(system.entities):
            key, process = (entity.process, entity.index), system.processes[entity.process]
            if key not in executions:
                executions[key] = self._executions(entity)
            if key not in bodies:
                bodies[key] = self._add_body(entity)
            group = system.application.nodes[process.key].exclusive_group(entity.described)
            callback, handle, rmw_handle = self._handles.entities[number]
            execution, afterwards = executions[key]
            if entity.stores:  # in no time
                execution, afterwards = self._streams.add(_NO_TIME, None, 0), None
            described = _core.EntityDescription(
                callback=callback,
                handle=handle,
                rmw_handle=rmw_handle,
                process=entity.process,
                kind=getattr(_core.EntityKind, entity.kind),
                group=None if group is None else self._group(entity.process, group),
                first_publisher=entity.publishers[0] if entity.publishers else 0,
                publisher_count=len(entity.publishers),
                starts_chain=number in system.chain.callbacks[:1],
                on_chain=number in system.chain.callbacks[1:],
                execution=execution,
                afterwards=afterwards,
            )
            self._set_body(described, entity, bodies[key], number in system.chain.callbacks)
            self._set_trigger(described, entity)
            entities.append(described)
        return entities

    def _executions(self, entity: Entity) -> tuple[int, int | None]:
        """The streams of a callback's times: up to its publication, and afterwards (None: no)."""
        node, described = self._system.processes[entity.process].node, entity.described
        execution = self._streams.add(described.execution, node, entity.index)
        if described.afterwards is None:
            return execution, None
        number = FIRST_AFTER + entity.index
        return execution, self._streams.add(described.afterwards, node, number)

    def _group(self, process: int, group: str) -> int:
        return self._groups.setdefault((process, group), len(self._groups))

    def _add_body(self, entity: Entity) -> int:
        """Add the callback's gate, synchroniser or loop, if it has one; return its place."""
        described = entity.described
        if described.loop_ns is not None:
            self._loops.append(self._loop(entity))
            return len(self._loops) - 1
        if described.gate is not None:
            self._gates.append(self._gate(described))
            return len(self._gates) - 1
        topics, triggered_by = described.synchronises, described.triggered_by
        trigger = None if triggered_by is None else topics.index(triggered_by)
        depths = [1 if triggered_by else self._system.depth(topic) for topic in topics]
        inputs = [_core.InputDescription(depth=depth) for depth in depths]
        if topics:
            synchroniser = _core.SynchroniserDescription(inputs=inputs, trigger=trigger)
            self._synchronisers.append(synchroniser)
        return len(self._synchronisers) - 1

    def _loop(self, entity: Entity) -> _core.LoopDescription:
        process, reads = self._system.processes[entity.process], entity.described.reads
        threads = [(info.node, info.role) for info in self._system.threads]
        starts_chain = origin_timer(self._system.application)[1] is entity.described
        return _core.LoopDescription(
            thread=threads.index((process.node, "loop")),
            inputs=len(reads),
            last_ns=self._timing.last_timer_ns if starts_chain else self._timing.stop_ns,
            ends_chain=self._system.chain.topics[-1:] == (process.node + LOOP_END,),
        )

    def _set_body(
        self, described: _core.EntityDescription, entity: Entity, place: int, on_chain: bool
    ) -> None:
        if entity.described.loop_ns is not None:
            described.loop, described.input = place, entity.number
            if entity.stores:
                described.body = _core.Body.store
        elif entity.described.gate is not None:
            described.body = _core.Body.mode_listener if entity.listens else _core.Body.gate
            described.gate = place
        elif entity.described.synchronises:
            described.body, described.synchroniser = _core.Body.synchronise, place
            described.input = entity.number
            inputs = self._synchronisers[place].inputs  # a copy of them
            inputs[entity.number].on_chain = on_chain
            self._synchronisers[place].inputs = inputs

    def _set_trigger(self, described: _core.EntityDescription, entity: Entity) -> None:
        """Set when a timer expires, or how many messages a reader's history holds, how long."""
        system, gate = self._system, entity.described.gate
        if entity.topic is None:
            key = system.processes[entity.process].key
            drift = system.application.simulation.drift.get(key, 0)
            period = (entity.described.period_ns or 0) * (1 - drift / 1_000_000)
            described.period_ns = max(1, round(period))
            described.due_ns = self._timing.start_ns + entity.described.phase_ns
        else:
            topic = system.application.topic(entity.topic)
            described.depth = topic.depth if gate is None or entity.listens else gate.gate().depth
            described.lifespan_ns = topic.lifespan_ns

    def _gate(self, described: CallbackDescription) -> _core.GateDescription:
        gate, timing = described.gate, self._timing
        assert gate is not None  # noqa: S101 - the caller has seen it
        description = _core.GateDescription(
            slots=list(gate.slots),
            depth=gate.gate().depth,
            moves=gate.moved(timing.start_ns),
            spin_ns=gate.spin_ns,
            pause_ns=gate.pause_ns,
        )
        for name, value in values_of(gate.gate()).items():  # a name that C++ lacks is refused
            setattr(description, name, value)
        description.phase_ns = timing.anchor_ns
        if gate.phase_ns is not None:
            description.phase_ns = timing.start_ns + gate.phase_ns
        if (modes := gate.gate().modes) is not None:
            description.mode_names = list(modes.slots)
            description.mode_slots = list(modes.slots.values())
            description.modes = [self._system.modes.index(mode) for mode in modes.slots]
            description.first_mode = description.mode_names.index(modes.default)
            description.late = modes.late
        return description

    def _publishers(self) -> list[_core.PublisherDescription]:
        system, publishers = self._system, []
        owner = {place: entity for entity in system.entities for place in entity.publishers}
        last = [
            (system.entities[place].process, system.entities[place].index)
            for place in system.chain.callbacks[-1:]
        ]
        reading: dict[str | None, list[int]] = {}
        for number, entity in enumerate(system.entities):
            reading.setdefault(entity.topic, []).append(number)
        for number, publisher in enumerate(system.publishers):
            topic: TopicDescription = system.application.topic(publisher.topic)
            handle, rmw_handle = self._handles.publishers[number]
            ends = (owner[number].process, owner[number].index) in last
            announces = owner[number].described.announces
            readers = [
                _core.ReaderDescription(
                    entity=reader, delivery=self._delivery(system.entities[reader], publisher)
                )
                for reader in reading.get(publisher.topic, [])
            ]
            publishers.append(
                _core.PublisherDescription(
                    handle=handle,
                    rmw_handle=rmw_handle,
                    readers=readers,
                    asynchronous=publisher.asynchronous,
                    depth=topic.depth,
                    lifespan_ns=topic.lifespan_ns,
                    ends_chain=ends and publisher.topic == system.chain.topics[-1],
                    modes=[system.modes.index(mode) for mode in announces],
                )
            )
        return publishers

    def _delivery(self, reader: Entity, publisher: SimulatedPublisher) -> int | None:
        """The stream of delivery times that are described for a reader alone; None: none are."""
        process = self._system.processes[reader.process]
        described: Mapping[str, ExecutionTime] = self._system.application.simulation.deliveries.get(
            process.key, {}
        )
        if publisher.topic not in described:
            return None
        times = described[publisher.topic]
        # A sequence is of the topic's messages in the order of their sending, by whichever node.
        sender = publisher.process if times.sequence_ns is None else 0
        number = FIRST_DELIVERY + (sender << 32) + (reader.index << 16) + reader.number
        stream = process.node, publisher.topic, number
        if stream not in self._deliveries:
            self._deliveries[stream] = self._streams.add(times, process.node, number)
        return self._deliveries[stream]


def _governed_core(plan: Plan, ranked: Sequence[Server], timing: Timing) -> _core.CoreDescription:
    """A core with servers, in the state that it has at the run's start, anywhere in a cycle."""
    table = _slot_table(plan, ranked)
    anchor = timing.start_ns if plan.moves_timers else timing.anchor_ns
    elapsed = (timing.start_ns - anchor) % plan.cycle_ns
    current = max(number for number, (offset, _) in enumerate(table) if offset <= elapsed)
    following = (current + 1) % len(table)
    until = table[following][0] + (plan.cycle_ns if following <= current else 0)
    return _core.CoreDescription(
        table=table,
        open_servers=table[current][1],
        next=following,
        boundary_ns=timing.start_ns - elapsed + until,
    )


def _slot_table(plan: Plan, ranked: Sequence[Server]) -> list[tuple[int, int]]:
    """The slot table of a core: (offset in the cycle (ns), bit mask of the servers open then)."""
    # A free shaping node times its messages itself: its thread needs no slot to run in.
    slots = [
        server.slots if plan.free_threads.isdisjoint(server.threads) else ((0, plan.cycle_ns),)
        for server in ranked
    ]
    offsets = {0} | {instant for of_server in slots for slot in of_server for instant in slot}
    table = []
    for offset in sorted(offset for offset in offsets if offset < plan.cycle_ns):
        mask = 0
        for bit, of_server in enumerate(slots):
            if any(start <= offset < end for start, end in of_server):
                mask |= 1 << bit
        table.append((offset, mask))
    return table
