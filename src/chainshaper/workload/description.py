"""The description of an application in one YAML file: what runs, how long, where.

The live workload executes it with real processes over DDS, the simulator as discrete events.

    name: synthetic chain
    chain: /t1../t5
    scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
    nodes:
      node1:
        callbacks:
          - {timer: 100ms, execution: {uniform: [5ms, 15ms]}, publishes: [/t1]}
      node2:
        callbacks:
          - {subscription: /t1, execution: {uniform: [5ms, 15ms]}, publishes: [/t2]}
"""

import re
from collections.abc import Iterator
from dataclasses import MISSING, fields, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_origin

from pydantic import Field, create_model, model_validator

from chainshaper.control.plant_file import LoopFile, described_loop
from chainshaper.robot.gate import Gate, GateModes, Late, limit_of
from chainshaper.values.application import LOOP_END
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Publication
from chainshaper.values.yaml_file import (
    AS_YAML,
    Duration,
    FullName,
    Part,
    PositiveDuration,
    read_model,
    wrong_value,
)

LONGEST_BLOCK = 1024
MOST_CORES = 8191  # that Linux can be built for
MOST_THREADS = 64
_FUNCTION = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)
_NODE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_CONTAINER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
Core: TypeAlias = Annotated[int, Field(ge=0, le=MOST_CORES)]
Priority: TypeAlias = Annotated[int, Field(ge=1, le=97)]  # 98 and 99 stay free for measuring
Pair: TypeAlias = tuple[Duration, Duration]


class ExecutionTime(Part):
    """CPU time of a callback instance, by exactly one of these distributions.

    * ``constant_ns``: always the same.
    * ``uniform_ns``: the two limits.
    * ``normal_ns``: mean and standard deviation. A value outside ``within_ns`` is drawn again.
    * ``samples_ns``: drawn in stretches of ``block`` consecutive samples (1: independently).
      Callbacks with as many samples and the same block draw the same stretches, so that what was
      measured together stays together (the moving block bootstrap of Künsch, 1989, with the
      circular end of Politis and Romano, 1992).
    * ``sequence_ns``: taken in its order, again and again, so that what was recorded happens again.
    """

    constant_ns: Duration | None = None
    uniform_ns: Pair | None = None
    normal_ns: Pair | None = None
    within_ns: Pair | None = None
    samples_ns: Annotated[tuple[Duration, ...], Field(min_length=1)] | None = None
    block: Annotated[int, Field(ge=1, le=LONGEST_BLOCK)] = 1
    sequence_ns: Annotated[tuple[Duration, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_distribution(self) -> "ExecutionTime":
        given: list[object] = [self.constant_ns, self.uniform_ns, self.normal_ns]
        given += [self.samples_ns, self.sequence_ns]
        if given.count(None) != len(given) - 1:
            raise wrong_value("give exactly one of constant, uniform, normal, samples, sequence")
        if self.block > 1 and self.samples_ns is None:
            raise wrong_value("a block is a stretch of `samples`: remove it", "block")
        if (self.normal_ns is None) != (self.within_ns is None):
            raise wrong_value("`within: [low, high]` goes with `normal`, and normal needs it")
        for key, pair in (("uniform", self.uniform_ns), ("within", self.within_ns)):
            if pair is not None and pair[0] > pair[1]:
                raise wrong_value("the shorter duration comes first: exchange the two", key)
        if self.normal_ns is not None and self.within_ns is not None:
            (mean, deviation), (low, high) = self.normal_ns, self.within_ns
            if deviation == 0 or not low <= mean <= high:
                reason = "the mean must lie within the limits, with a deviation above 0ms"
                raise wrong_value(reason, "normal")
            if high - low < deviation:  # nearly every value would be drawn again, or for ever
                reason = "the limits are closer together than one deviation: write `uniform`"
                raise wrong_value(reason, "within")
        return self


class SimulationDescription(Part):
    """Properties of the machine, which a simulation needs as values.

    * ``executor``: which of rclcpp's executors all nodes have.
    * ``wake_up``: CPU time of a thread from its waking until it is at work.
    * ``take``: CPU time from taking a message until its callback begins.
    * ``publish``: CPU time of publishing a message, in the executor or the publisher thread.
    * ``delivery``: how long a message is under way.
    * ``deliveries``: the same to single nodes, by node and topic.
    * ``receive``: CPU time of a DDS thread for a message; None: these compete with no thread.
    * ``context_switch_ns``: CPU time that switching to a thread takes from it.
    * ``preemption_ns``: CPU time that resuming a thread takes from it, which was pre-empted.
    * ``quantum_ns``: how long turns last where the plan has round robin.
    * ``interrupts``: the share of a core's time that interrupts and the stall meter take from
      callbacks, which counts as the callbacks' CPU time.
    * ``drift``: by how much the clocks of nodes are too fast, by node (ppm of a period).

    The defaults are medians of live runs on a virtual machine of two cores.
    """

    executor: Literal["single-threaded", "static", "events"] = "single-threaded"
    wake_up: ExecutionTime = ExecutionTime(constant_ns=110_000)
    take: ExecutionTime = ExecutionTime(constant_ns=42_000)
    publish: ExecutionTime = ExecutionTime(constant_ns=95_000)
    delivery: ExecutionTime = ExecutionTime(constant_ns=30_000)
    deliveries: dict[str, dict[FullName, ExecutionTime]] = Field(default_factory=dict)
    receive: ExecutionTime | None = None
    context_switch_ns: Duration = 0
    preemption_ns: Duration = 0
    quantum_ns: PositiveDuration = 1_000_000
    interrupts: Annotated[float, Field(ge=0, lt=1)] = 0.016
    drift: dict[str, Annotated[float, Field(gt=-100_000, lt=100_000)]] = Field(default_factory=dict)


class ModesDescription(Part):
    """The modes of a gate, as :class:`~chainshaper.robot.gate.GateModes` has them.

    * ``topic``: where modes are announced.
    * ``bands``: which slot each mode has, from 1.
    """

    topic: FullName
    bands: Annotated[dict[str, int], Field(min_length=1)]
    default: str
    late: Late = "wait"


def _gate_fields() -> dict[str, Any]:
    """Return the fields of a gate's description, from those that ``Gate`` declares."""
    described: dict[str, Any] = {}
    for declared in fields(Gate):
        limit = limit_of(declared)
        type_: Any = Any  # slots and modes: `GateDescription` has types of its own for them
        if get_origin(declared.type) is Literal:
            type_ = declared.type
        elif declared.name.endswith("_ns"):
            type_ = PositiveDuration if limit and limit.number == 1 else Duration
        elif limit is not None:
            type_ = Annotated[int, Field(ge=limit.number)]
        default = ... if declared.default is MISSING else declared.default
        described[declared.name] = (type_, default)
    return described


if TYPE_CHECKING:
    _DescribedGate = Part
else:
    _DescribedGate = create_model("_DescribedGate", __base__=Part, **_gate_fields())


class GateDescription(_DescribedGate):
    """A :class:`~chainshaper.robot.gate.Gate` in a callback: republishing in ``slots`` only.

    It has the fields of a gate under their names, times as durations, and:

    * ``phase_ns``: where cycles begin without a stamp, behind the common start; None: with the
      timer that starts the application's chain.
    * ``modes``: with the topic that announces them.
    * ``moves``: shifts of all slots while the application runs. Of each, when it begins, after the
      common start, and where in the cycle the first slot begins then.
    * ``spin_ns``: how long before a release the thread watches the clock.
    * ``pause_ns``: how long after a publication the thread rests.
    """

    slots: Annotated[tuple[Pair, ...], Field(min_length=1)]
    phase_ns: Duration | None = None
    modes: ModesDescription | None = None
    moves: tuple[Pair, ...] = ()
    spin_ns: Duration = 0
    pause_ns: Duration = 0

    @model_validator(mode="after")
    def _gate_exists(self) -> "GateDescription":
        key = "slots"
        try:
            gate = self._without_modes()
            key = "modes"
            gate = self.gate()
        except ValueError as error:
            raise wrong_value(str(error), key) from error
        before = -1
        for number, (since, by) in enumerate(self.moved(0)):
            if not gate.may_move(by):
                reason = "the last slot would leave the cycle: write less"
                raise wrong_value(reason, "moves", number)
            if since <= before:
                reason = "comes before the one above: write later ones last"
                raise wrong_value(reason, "moves", number)
            before = since
        for key, rest in (("spin", self.spin_ns), ("pause", self.pause_ns)):
            if rest >= gate.cycle_ns:
                raise wrong_value("must be shorter than the cycle: shorten it", key)
        return self

    def gate(self) -> Gate:
        """Return the gate that is described; its ``phase_ns`` counts from the common start."""
        gate, modes = self._without_modes(), self.modes
        if modes is None:
            return gate
        slots = {mode: band - 1 for mode, band in modes.bands.items()}
        return replace(gate, modes=GateModes(slots, modes.default, modes.late))

    def _without_modes(self) -> Gate:
        values = {declared.name: getattr(self, declared.name) for declared in fields(Gate)}
        return Gate(**values | {"phase_ns": self.phase_ns or 0, "modes": None})

    def moved(self, start_ns: int) -> list[tuple[int, int]]:
        """Return the moves of a run that starts then: each instant, and the shift (ns) from it on.

        :class:`~chainshaper.robot.waiting.Queue` takes them so.
        """
        return [(start_ns + since, begin - self.slots[0][0]) for since, begin in self.moves]


class CallbackDescription(Part):
    """A callback: what triggers it, what it does, and the topics it publishes.

    What triggers it, one of the first four:

    * ``timer_ns``: a timer of this period; ``phase_ns`` delays its first expiry after the common
      start.
    * ``loop_ns``: no callback at all, but a thread of the node that sleeps until multiples of this
      period, behind ``phase_ns``, and is then awake for an instance.
    * ``subscription``: the messages of this topic.
    * ``synchronises``: these topics, when a message of each has come. The stamp that it passes on
      is that of the first topic's message.
    * ``triggered_by``: one of the topics that it ``synchronises``: each message of that one
      triggers it, with the newest message of each of the others.
    * ``kind``: executors look at services and clients after subscriptions of topics.
    * ``group``: one of its node's ``callback_groups``; None: the node's default group, which is
      mutually exclusive.

    Of a loop:

    * ``reads``: topics of which it uses the newest message that the node's executor has stored
      before the instance began. The stamp that it passes on is that of the first topic's message.
    * ``core``, ``priority``: of its thread; None: those of the node's executor.

    What it does:

    * ``execution``: CPU time before it publishes.
    * ``afterwards``: CPU time after it has published.
    * ``computes``: a Python function that is called instead of spending time
      (:mod:`chainshaper.workload.executor`).
    * ``publishes``: topics.
    * ``announces``: names of modes, which it publishes in turn, each as a ``std_msgs/String``.
    * ``gate``: it executes nothing, and forwards what it received in slots.
    * ``control``: its part in the application's ``control_loop``, in a live run, when it starts:
      a timer's that ``samples`` the plant, and publishes the samples; that of the controller, which
      ``computes`` the plant's inputs from them, and publishes these; or it ``drives`` the plant
      with the inputs that it gets. All other callbacks pass on what the first message carries.
    """

    timer_ns: PositiveDuration | None = None
    loop_ns: PositiveDuration | None = None
    phase_ns: Duration = 0
    reads: tuple[FullName, ...] = ()
    core: Core | None = None
    priority: Priority | None = None
    subscription: FullName | None = None
    synchronises: tuple[FullName, ...] = ()
    triggered_by: FullName | None = None
    kind: Literal["subscription", "service", "client"] = "subscription"
    execution: ExecutionTime = ExecutionTime(constant_ns=0)
    afterwards: ExecutionTime | None = None
    computes: str | None = None
    publishes: tuple[FullName, ...] = ()
    announces: tuple[str, ...] = ()
    gate: GateDescription | None = None
    control: Literal["samples", "computes", "drives"] | None = None
    group: str | None = None

    @property
    def subscriptions(self) -> tuple[str, ...]:
        """All topics that are subscribed to for this callback, that of the gate's modes first."""
        if self.gate is None or self.gate.modes is None:
            return self.inputs or self.reads
        return (self.gate.modes.topic, *self.inputs)

    @property
    def period_ns(self) -> int | None:
        """The period of its timer or loop; None: messages trigger it."""
        return self.loop_ns if self.timer_ns is None else self.timer_ns

    @property
    def inputs(self) -> tuple[str, ...]:
        """The topics whose messages trigger it."""
        return self.synchronises if self.subscription is None else (self.subscription,)

    @model_validator(mode="after")
    def _one_trigger(self) -> "CallbackDescription":
        triggers = (self.timer_ns, self.loop_ns, self.subscription, self.synchronises or None)
        if triggers.count(None) != len(triggers) - 1:
            raise wrong_value(
                "give either `timer: PERIOD` or `loop: PERIOD` or `subscription: TOPIC` or"
                " `synchronises: [TOPICS]`"
            )
        if len(self.synchronises) == 1 or len(set(self.synchronises)) < len(self.synchronises):
            raise wrong_value("name two topics at least, each of them once", "synchronises")
        if self.triggered_by not in (None, *self.synchronises):
            raise wrong_value("write one of the topics that it `synchronises`", "triggered_by")
        if self.phase_ns and self.period_ns is None:
            reason = "a phase is a timer's or loop's delay after the common start: remove it"
            raise wrong_value(reason, "phase")
        self._check_loop()
        if self.gate is not None and (self.subscription is None or len(self.publishes) != 1):
            raise wrong_value("a gate forwards one subscription to exactly one topic", "gate")
        if self.computes is not None:
            if not _FUNCTION.fullmatch(self.computes):
                raise wrong_value("write MODULE:FUNCTION, such as robot.nodes:filter", "computes")
            if {"execution", "afterwards", "gate", "announces"} & self.model_fields_set:
                reason = "a callback that computes has no execution, afterwards, gate or announces:"
                reason += " keep one"
                raise wrong_value(reason, "computes")
        self._check_control()
        if self.announces and len(self.publishes) != 1:
            raise wrong_value("modes are announced on exactly one topic", "announces")
        return self

    def _check_control(self) -> None:
        """Refuse a part in a control loop that this callback cannot have."""
        if self.control is None:
            return
        if self.computes is not None or self.gate is not None or self.announces:
            reason = "a callback that has a part in the control loop has no computes, gate or"
            raise wrong_value(f"{reason} announces: keep one", "control")
        if self.control == "samples" and self.timer_ns is None:
            raise wrong_value("a timer's callback samples the plant: write `timer`", "control")
        if self.control != "samples" and self.subscription is None:
            reason = "is for what the messages of one topic carry: write `subscription`"
            raise wrong_value(reason, "control")
        if self.control != "drives" and not self.publishes:
            reason = "what it samples or computes goes into its messages: write `publishes`"
            raise wrong_value(reason, "control")

    def _check_loop(self) -> None:
        """Refuse what only a loop has elsewhere, and what a loop has not."""
        if self.loop_ns is None:
            for key, reason in (
                ("reads", "a loop reads what has arrived: write `loop: PERIOD`, or `subscription`"),
                ("core", "is of a loop's thread: write it beside the node's `callbacks`"),
                ("priority", "is of a loop's thread: write it beside the node's `callbacks`"),
            ):
                if getattr(self, key) not in (None, ()):
                    raise wrong_value(reason, key)
        elif self.computes is not None:
            raise wrong_value("a loop calls no function: describe its `execution`", "computes")
        elif self.execution.constant_ns == 0:  # its waking up and its sleep would be one instant
            reason = "an instance of a loop takes time: describe it, such as {constant: 500us}"
            raise wrong_value(reason, "execution")
        if len(set(self.reads)) < len(self.reads):
            raise wrong_value("name each topic once", "reads")


class NodeDescription(Part):
    """A node in a process of its own, or in a container.

    * ``container``: the name of a process that it shares with other nodes of this container; each
      has the threads of its executor for itself, as in ``component_container_isolated``.
    * ``core``, ``priority``, ``dds_priority``: instead of those in ``scheduling``.
    * ``bound``: whether it stays on its core. If not, it runs on any core in a live run; in a
      simulation it runs on its core all the same.
    * ``threads``: of a multi-threaded executor. They stay on the ``cores`` in turn, or all on
      ``core``.
    * ``callback_groups``: of a mutually exclusive group, callbacks run one at a time; of a
      reentrant one, whenever a thread is free.
    """

    callbacks: tuple[CallbackDescription, ...] = Field(min_length=1)
    core: Core | None = None
    priority: Priority | None = None
    dds_priority: Priority | None = None
    container: str | None = None
    bound: bool = True
    executor: Literal["single_threaded", "multi_threaded"] = "single_threaded"
    threads: int = Field(default=1, ge=1, le=MOST_THREADS)
    cores: tuple[Core, ...] = ()
    callback_groups: dict[str, Literal["mutually_exclusive", "reentrant"]] = Field(
        default_factory=dict
    )

    @model_validator(mode="after")
    def _executor_exists(self) -> "NodeDescription":
        if self.container is not None and not _CONTAINER.fullmatch(self.container):
            reason = "a container's name has letters, digits and _ only, and begins with a letter"
            raise wrong_value(reason, "container")
        if self.executor == "single_threaded":
            for key in ("callback_groups", "cores", "threads"):
                if getattr(self, key) not in ({}, (), 1):
                    reason = "is of several threads: write `executor: multi_threaded`, or remove it"
                    raise wrong_value(reason, key)
        elif self.threads == 1:
            raise wrong_value("say how many `threads` it has: 2 or more", "executor")
        if self.core is not None and self.cores:
            raise wrong_value("give `core` or `cores`, not both", "core")
        for number, callback in enumerate(self.callbacks):
            if callback.group not in (None, *self.callback_groups):
                reason = f"the node has no callback group {callback.group!r}: add it to"
                reason += " `callback_groups`, as mutually_exclusive or reentrant"
                raise wrong_value(reason, "callbacks", number, "group")
            if callback.gate is not None and self.threads > 1:
                reason = "a gate needs a node with a single-threaded executor"
                raise wrong_value(reason, "callbacks", number, "gate")
        self._check_loops()
        return self

    @property
    def loop(self) -> CallbackDescription | None:
        """Its loop; None: it has none."""
        return next((callback for callback in self.callbacks if callback.loop_ns is not None), None)

    def _check_loops(self) -> None:
        """Refuse a second loop, and callbacks that would be in its loop's way."""
        for number, callback in enumerate(self.callbacks):
            where = ("callbacks", number)
            if callback.loop_ns is not None and callback is not self.loop:
                reason = "a node has one loop thread, which is in a loop already: describe another"
                raise wrong_value(f"{reason} node with this one", *where, "loop")
            if self.loop is None or callback is self.loop:
                continue
            if callback.gate is not None:
                reason = "while a gate waits, nothing is stored for the loop: give it its own node"
                raise wrong_value(reason, *where, "gate")
            if again := [topic for topic in callback.subscriptions if topic in self.loop.reads]:
                reason = f"the node's loop `reads` {again[0]}, so that the node subscribes to it"
                key = "synchronises" if callback.subscription is None else "subscription"
                raise wrong_value(f"{reason} already: remove one of the two", *where, key)

    def exclusive_group(self, callback: CallbackDescription) -> str | None:
        """Return the group of which it runs alone; None: it may run beside any other callback.

        "" is the node's default group.
        """
        reentrant = self.callback_groups.get(callback.group or "") == "reentrant"
        return None if self.threads == 1 or reentrant else callback.group or ""


class TopicDescription(Part):
    """How a topic is published, and its quality of service (keep-last ``depth``)."""

    publication: Publication = "synchronous"
    reliability: Literal["reliable", "best_effort"] = "reliable"
    depth: int = Field(default=10, ge=1, le=1_000_000)
    lifespan_ns: PositiveDuration | None = None  # older messages are neither sent nor received
    payload: int = Field(default=1024, ge=0, le=16_000_000)  # bytes behind the header


class Scheduling(Part):
    """Core and SCHED_FIFO priority of a class of threads."""

    core: Core
    priority: Priority


class SchedulingOfApplication(Part):
    executors: Scheduling
    dds: Scheduling


class Application(Part):
    """A whole application. ``chain`` is the chain of interest, as ``FIRST..LAST``.

    ``control_loop`` is what a live run controls, as :mod:`chainshaper.control.plant_file` has it.
    """

    name: str
    chain: str
    seed: int = Field(default=1, ge=0, lt=1 << 64)
    scheduling: SchedulingOfApplication
    topics: dict[FullName, TopicDescription] = Field(default_factory=dict)
    simulation: SimulationDescription = SimulationDescription()
    control_loop: LoopFile | None = None
    nodes: dict[str, NodeDescription] = Field(min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> "Application":
        published = {topic for _, callback in self.callbacks() for topic in callback.publishes}
        order: TopologicalSorter[str] = TopologicalSorter()  # generic from Python 3.11 on
        written: dict[str, str] = {}  # names in the file by full name
        for name, described in self.nodes.items():
            if not _NODE.fullmatch(name):
                raise wrong_value("a node's name has letters, digits, _ and / only", "nodes", name)
            for number, callback in enumerate(described.callbacks):
                self._refuse_unpublished(callback, published, ("nodes", name, "callbacks", number))
                for topic in callback.publishes:
                    order.add(topic, *callback.inputs)
            if (namesake := written.setdefault(node_name(name), name)) != name:
                raise wrong_value(f"is the same name as {namesake!r}: rename one", "nodes", name)
        for topic in self.topics:
            if topic not in published:
                raise wrong_value("is published by no node: remove it", "topics", topic)
        # A run takes a while, so a chain that could not be found in its recording is refused here.
        known = {*published, *map(node_name, self.nodes)}
        known |= {node_name(name) + LOOP_END for name, node in self.nodes.items() if node.loop}
        for way_point in map(str.strip, self.chain.split("..")):
            if "/" + way_point.removeprefix("/") not in known:
                reason = f"no topic or node is called {way_point!r}: write way points of "
                reason += f"{', '.join(sorted(known))}, such as FIRST..LAST"
                raise wrong_value(reason, "chain")
        try:
            order.prepare()
        except CycleError as error:
            reason = "the topics form a cycle, in which messages would circle for ever: "
            reason += f"{' → '.join(error.args[1])}; break it at one of these topics"
            raise wrong_value(reason, "nodes") from error
        self._check_simulation()
        self._check_control_loop()
        return self

    def _check_simulation(self) -> None:
        described = self.simulation
        for key, named in (("drift", [*described.drift]), ("deliveries", [*described.deliveries])):
            for node in named:
                if node not in self.nodes:
                    raise wrong_value("no such node: remove it", "simulation", key, node)
        for node, topics in described.deliveries.items():
            read = {
                topic for callback in self.nodes[node].callbacks for topic in callback.subscriptions
            }
            for topic in topics:
                if topic not in read:
                    reason = f"the node does not subscribe to it, but to {', '.join(sorted(read))}:"
                    raise wrong_value(
                        f"{reason} remove it", "simulation", "deliveries", node, topic
                    )

    def _check_control_loop(self) -> None:
        """Refuse a control loop that does not close, and one that is not right."""
        parts: dict[str, list[tuple[str, CallbackDescription]]] = {}
        for name, node in self.nodes.items():
            for number, callback in enumerate(node.callbacks):
                if callback.control is None:
                    continue
                where = ("nodes", name, "callbacks", number, "control")
                if self.control_loop is None:
                    reason = "is for an application with a `control_loop`: describe it"
                    raise wrong_value(reason, *where)
                if node.threads > 1:
                    raise wrong_value("needs a node with a single-threaded executor", *where)
                if callback.control in parts:
                    reason = f"a second callback that {callback.control}: keep one"
                    raise wrong_value(reason, *where)
                parts.setdefault(callback.control, []).append((name, callback))
        if self.control_loop is None:
            return
        for part in ("samples", "computes", "drives"):
            if part not in parts:
                reason = f"no callback has its part `control: {part}`: write it to one"
                raise wrong_value(reason, "control_loop")
        (sampling, timer), (driving, _) = parts["samples"][0], parts["drives"][0]
        if sampling != driving:
            reason = f"node {sampling} samples the plant, and {driving} drives it: it is one plant,"
            raise wrong_value(f"{reason} in one node", "control_loop")
        try:
            described_loop(Path("control_loop"), self.control_loop).problem(timer.timer_ns)
        except InputError as error:
            raise wrong_value(str(error), "control_loop") from error

    def _refuse_unpublished(
        self, callback: CallbackDescription, published: set[str], where: tuple[str | int, ...]
    ) -> None:
        for wanted in callback.inputs or callback.reads:
            if wanted not in published:
                key = "synchronises" if callback.subscription is None else "subscription"
                key = "reads" if callback.reads else key
                known = ", ".join(sorted(published)) or "no topics"
                raise wrong_value(f"no node publishes {wanted}; published are {known}", *where, key)
        modes = None if callback.gate is None else callback.gate.modes
        if modes is not None and modes.topic not in self.announced():
            reason = f"no callback `announces` modes on {modes.topic}: describe one"
            raise wrong_value(reason, *where, "gate", "modes", "topic")

    def callbacks(self) -> Iterator[tuple[str, CallbackDescription]]:
        """Yield every callback with the name of its node, in the order of the file."""
        for name, node in self.nodes.items():
            for callback in node.callbacks:
                yield name, callback

    def announced(self) -> set[str]:
        """Return the topics that carry the names of modes (``std_msgs/String``)."""
        return {
            topic
            for _, callback in self.callbacks()
            if callback.announces
            for topic in callback.publishes
        }

    def topic(self, name: str) -> TopicDescription:
        """Return a topic's description; the default one where the file says nothing about it."""
        return self.topics.get(name, TopicDescription())

    def scheduling_of(self, node: str) -> Scheduling:
        """Return core and priority of a node's executor (of several cores, the first)."""
        described, executors = self.nodes[node], self.scheduling.executors
        first = described.cores[0] if described.cores else described.core
        core = executors.core if first is None else first
        return Scheduling(core=core, priority=described.priority or executors.priority)

    def cores_of(self, node: str) -> tuple[int, ...]:
        """Return the core of each thread of a node's executor."""
        cores = self.nodes[node].cores or (self.scheduling_of(node).core,)
        return tuple(cores[place % len(cores)] for place in range(self.nodes[node].threads))

    def dds_scheduling_of(self, node: str) -> Scheduling:
        """Return core and priority of a node's DDS threads."""
        priority, dds = self.nodes[node].dds_priority, self.scheduling.dds
        return dds if priority is None else Scheduling(core=dds.core, priority=priority)

    def loop_scheduling_of(self, node: str) -> Scheduling | None:
        """Return core and priority of the thread of a node's loop; None: the node has none."""
        executor, loop = self.scheduling_of(node), self.nodes[node].loop
        if loop is None:
            return None
        core = executor.core if loop.core is None else loop.core
        return Scheduling(core=core, priority=loop.priority or executor.priority)

    def cores(self) -> dict[int, str]:
        """Return every core that threads of the application are bound to, and what asks for it."""
        bound = [name for name, node in self.nodes.items() if node.bound]
        executors = {core: f"node {name}" for name in bound for core in self.cores_of(name)}
        loops = {
            loop.core: f"the loop of node {name}"
            for name in bound
            if (loop := self.loop_scheduling_of(name)) is not None
        }
        return {self.scheduling.dds.core: "scheduling.dds", **loops, **executors}


def node_name(name: str) -> str:
    """Return a node's full name, which has a leading slash."""
    return "/" + name.strip("/")


def origin_timer(
    application: Application, chain: str | None = None
) -> tuple[str, CallbackDescription]:
    """Return the timer or loop that starts a chain, or leads to its start, and its node's name.

    The chain is the application's, unless another is given. Raises InputError: no callback begins
    it.
    """
    chain = chain or application.chain
    first = chain.split("..")[0].strip().strip("/")
    starts = [
        (name, callback)
        for name, callback in application.callbacks()
        if f"/{first}" in callback.publishes or first == name.strip("/")
    ]
    # This ends at a timer or loop, since every topic has a publisher, and topics that trigger
    # callbacks form no cycle.
    while starts and all(callback.period_ns is None for _, callback in starts):
        inputs = {topic for _, callback in starts for topic in callback.subscriptions}
        starts = [
            (name, callback)
            for name, callback in application.callbacks()
            if inputs.intersection(callback.publishes)
        ]
    if not starts:
        lacks = f"has no /{first}, with which the chain {chain} begins"
        remedy = "plan again from a recording of this application"
        raise InputError(f"the application {application.name!r} {lacks}: {remedy}")
    return next((name, callback) for name, callback in starts if callback.period_ns is not None)


def loop_period_ns(application: Application) -> int:
    """Return the period at which the control loop's plant is sampled; 0: there is none."""
    sampling = (call for _, call in application.callbacks() if call.control == "samples")
    return next((callback.timer_ns or 0 for callback in sampling), 0)


def load_application(path: str | Path) -> Application:
    """Read an application's YAML file.

    Raises InputError: with file, line, key, reason and remedy of each wrong value.
    """
    return read_model(path, Application, made_by="written by `chainshaper init`")


def application_as_written(application: Application) -> dict[str, Any]:
    """Return the application as in a YAML file: durations with units, defaults left out."""
    return application.model_dump(
        mode="json", by_alias=True, exclude_defaults=True, context=AS_YAML
    )
