"""The plan of one chain: the servers, slots, threads and shaping nodes that hold its latency.

Every :class:`ChainPlan` obeys every rule checked here, whichever way it came about. Durations are
integer nanoseconds, in fields that end in ``_ns``; in YAML the same keys stand without the suffix,
their values with a unit (``period: 100ms``). Slots are half-open and count from a cycle's start.

A server may stop the thread of an asynchronous publisher (design 1, section 3.2.1), which shares
locks with its process. With Fast DDS 2.14, three things are destructive and refused:

* a slot hardly longer than a send (0.25 ms): a thread that is stopped in a send keeps the locks
  that every publisher of its process needs;
* a thread that out-ranks its executor on the same core: it spins for the lock under which the
  executor hands a message over;
* a history too shallow for the messages that come while the thread may not run.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, combinations, pairwise, product
from typing import Annotated, Literal, NamedTuple, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from chainshaper.robot.gate import Anchor, IntoOpenSlot, Late, Messages, Overrun
from chainshaper.values.callback_groups import parse_group_id
from chainshaper.values.durations import (
    duration_text,
    format_duration,
    milliseconds,
    parse_duration,
)
from chainshaper.values.errors import shown
from chainshaper.values.handed_over import HandedOver
from chainshaper.values.notebook import notebook_html
from chainshaper.values.plan_choices import (
    EqualPriorities,
    Fallback,
    InStep,
    Policy,
    ShapingThread,
    SlotEnds,
)
from chainshaper.values.yaml_file import (
    Duration,
    FullName,
    Model,
    Part,
    PositiveDuration,
    wrong_value,
    wrong_values_refused,
)

SHORTEST_SLOT_NS = 1_000_000  # of an asynchronous publisher; of any, unless one is given
SENDS_PER_SLOT = 4
PER_CALLBACK = ("server-per-callback", "let-per-callback", "pipelined")
"""Policies whose slots follow from the callbacks, so that an execution may span cycles."""
UNSHAPED = ("server-per-chain", "server-per-callback")


def _plain_name(kind: str) -> AfterValidator:
    """Check the name of a mode or a node, as ``kind`` says."""

    def check(value: str) -> str:
        if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
            return value
        raise ValueError(f"{value!r} is not a {kind}'s name: write letters, digits and underscores")

    return AfterValidator(check)


ModeName = Annotated[str, _plain_name("mode")]
Count = Annotated[int, Field(ge=0)]
FromOne = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Slot: TypeAlias = tuple[Duration, Duration]
"""A time slot [start, end) of a cycle."""
Range: TypeAlias = tuple[Duration, Duration]
"""The lowest and the highest of some times."""
Wrong: TypeAlias = Iterator[tuple[str | int, ...]]
"""What breaks a rule: for each place the reason, and behind it the place's keys in the file."""


def checked(model: Model, *rules: Callable[[Model], Wrong]) -> Model:
    """Return a model that obeys these rules. Raises an error for the first that it breaks."""
    for reason, *where in chain.from_iterable(rule(model) for rule in rules):
        raise wrong_value(str(reason), *where)
    return model


def slot_text(slot: Slot) -> str:
    """Return a slot as people write it: ``[86ms, 87ms)``."""
    return f"[{duration_text(slot[0])}, {duration_text(slot[1])})"


def meet(first: Slot, second: Slot) -> bool:
    """Whether two slots overlap."""
    return first[0] < second[1] and second[0] < first[1]


class ChainOfPlan(Part):
    """The chain that is planned for.

    From bare latencies only the period is known. Such a plan can be studied, not carried out.
    """

    spec: str | None = None  # the chain as the user wrote it: /t1../t5
    output: FullName | None = None  # its last topic
    publisher: FullName | None = None  # the node that publishes the output
    output_depth: FromOne | None = None  # history depth of the output's writer
    # What no event shows of the chain, and the user has declared (values/handed_over.py): /in=/out
    through: Annotated[tuple[HandedOver, ...], Field(strict=False)] = ()
    period_ns: PositiveDuration


class Evidence(Part):
    """The measurements that the plan rests on: end-to-end latencies under high SCHED_FIFO.

    What is None is not known.
    """

    recording: str | None = None  # its path
    samples: FromOne  # cycles that the three latencies are of
    # Of undisturbed cycles; of all cycles, if `all_disturbed`.
    min_latency_ns: Duration
    mean_latency_ns: Duration
    max_latency_ns: PositiveDuration
    max_of_all_ns: PositiveDuration | None = None  # of all cycles, disturbed ones included
    incomplete: Count = 0  # traversals without an end
    unpublished: Count = 0  # those of them that the application ended without a publication
    disturbed: Count = 0  # cycles that the machine disturbed
    realtime: bool | None = None  # whether the chain ran with SCHED_FIFO
    longest_stall_ns: Duration | None = None  # of the machine, during the recording
    # The share of its core that the chain takes, 0 to 1.
    utilisation: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    # The part of the average and of the longest latency that is for others
    # (:mod:`~chainshaper.planning.profile`).
    interference_ns: Duration | None = None
    longest_send_ns: Duration | None = None  # by the output's asynchronous publisher
    longest_publication_ns: Duration | None = None  # by its synchronous publisher
    # Where the length of the publish slot (Δ of section 4.1) is from.
    publish_slot: Literal["given", "measured", "least"] | None = None
    # How long an output is on its way to its receiver's callback: least, mean and longest, without
    # the time for which others had that callback's core.
    delivery_ns: tuple[Duration, Duration, Duration] | None = None
    lost_events: FromOne | None = None  # lost by the tracer
    all_disturbed: Literal[True] | None = None  # at most one cycle was undisturbed
    intra_process: Literal[True] | None = None  # subscribers get the output without DDS
    # Those that a chain across several went over; its latencies are the upper ends of intervals.
    hosts: tuple[str, ...] | None = None
    modes: "dict[ModeName, Evidence] | None" = None  # the same for the cycles in each mode

    @model_validator(mode="after")
    def _ordered(self) -> "Evidence":
        if not self.min_latency_ns <= self.mean_latency_ns <= self.max_latency_ns:
            raise wrong_value("min, mean and max latency must ascend: correct them", "mean_latency")
        return self


class Margin(Part):
    """How far the chain's slot reaches beyond the longest undisturbed latency (ε of eq. 1).

    See :mod:`chainshaper.planning.margins`.
    """

    epsilon_ns: Duration
    # By the user; measured: it covers all cycles of the sample but a share; derived: it is the
    # upper end of an interval for the tail of the latencies.
    source: Literal["given", "measured", "derived"] = "given"
    # The share of late outputs, at most, with 95 % confidence.
    overrun_probability: Annotated[float, Field(gt=0, le=1)] | None = None
    stalls_ns: Duration = 0  # the part of it that covers disturbed cycles
    confidence_interval_ns: tuple[Duration, Duration] | None = None  # of a derived margin
    # How many cycles the sample is worth, where long cycles come in clusters.
    independent_cycles: FromOne | None = None


def _callback(value: str) -> str:
    """Return what starts a callback in its one spelling: a topic, or a timer's `every 100ms`.

    Raises ValueError: it is neither.
    """
    if value.startswith("every "):
        return f"every {format_duration(parse_duration(value.removeprefix('every ')))}"
    if re.fullmatch(r"(/[A-Za-z_]\w*)+", value):
        return value
    raise ValueError(f"{value!r} is no callback: write its topic, or a timer's `every 100ms`")


class Thread(Part):
    """A thread of a node that runs inside a server; other DDS threads are never gated (sec. 3.1).

    A node may have callback groups with an executor each (section 6).
    """

    node: FullName
    role: Literal["executor", "publisher"] = "executor"
    # The callbacks of the executor, by topic or as `every 100ms`; none: all executors of the node.
    # Behind the look at its callback group, values of a file are lists, as in Python: not strict.
    callbacks: tuple[Annotated[str, AfterValidator(_callback)], ...] = Field(
        default=(), strict=False
    )
    # The executor's callback group as callback_isolated_executor names it, which says node and
    # callbacks as well (values/callback_groups.py).
    callback_group: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_its_group(cls, values: object) -> object:
        """Take node and callbacks from the callback group, where only that is written."""
        if not isinstance(values, dict) or not isinstance(values.get("callback_group"), str):
            return values
        try:
            group = parse_group_id(values["callback_group"])
        except ValueError as error:
            raise wrong_value(str(error), "callback_group") from error
        if not group.triggers:
            reason = "has neither timer nor subscription of its own: a plan's thread runs some"
            raise wrong_value(f"{group.id} {reason}", "callback_group")
        for key, value in (("node", group.node), ("callbacks", group.triggers)):
            if tuple(values.get(key) or value) != tuple(value):
                reason = f"is not that of {group.id}: write the one or the other"
                raise wrong_value(reason, key)
        return {**values, "node": group.node, "callbacks": group.triggers}

    def overlaps(self, thread: "Thread") -> bool:
        """Whether a running thread may be both."""
        if (self.node, self.role) != (thread.node, thread.role):
            return False
        if not self.callbacks or not thread.callbacks:
            return True
        return not set(self.callbacks).isdisjoint(thread.callbacks)

    @property
    def text(self) -> str:
        """The thread as messages name it."""
        if self.callback_group is not None:
            return f"the thread of callback group {self.callback_group}"
        runs = f" that runs {', '.join(self.callbacks)}" if self.callbacks else ""
        return f"the {self.role} of {self.node}{runs}"


class Server(Part):
    """A table-driven reservation server (section 2.2.1): its threads run in its slots only."""

    name: Annotated[str, Field(min_length=1)]
    core: Count
    priority: FromOne  # a smaller one is better, as in LITMUS^RT
    slots: Annotated[tuple[Slot, ...], Field(min_length=1)]
    threads: tuple[Thread, ...] = ()  # the most urgent first (:attr:`.Plan.most_urgent_first`)
    # Whether its threads have only the time that all others leave of its core (R_m' and R_int of
    # the paper, sections 3.1 and 5.1).
    best_effort: bool = False

    @model_validator(mode="after")
    def _slots_ascend(self) -> "Server":
        for number, (before, slot) in enumerate(pairwise(((0, 0), *self.slots))):
            named = f"the slot {slot_text(slot)}"
            if slot[0] >= slot[1]:
                reason = f"{named} is empty: its end must come after its start"
                raise wrong_value(reason, "slots", number)
            if slot[0] < before[1]:
                reason = f"{named} begins before {slot_text(before)} ends: write slots ascending"
                raise wrong_value(f"{reason}, no overlap", "slots", number)
        return self


class ReceiverPlace(Part):
    """Where the executors of the nodes run that receive a shaped output.

    They run behind shaping nodes and above all servers of chains.
    """

    core: Count
    priority: FromOne  # that of outputs, as servers count priorities
    time_ns: Duration  # for so long in a cycle, at most, the plan leaves the core to them


class LoopAge(Part):
    """How old the data of a loop are when it reads them, since the start of the chain's cycle.

    See :mod:`chainshaper.planning.loop_ages`.
    """

    first_ns: Range  # at the first use of a message, which is the reaction to it
    every_ns: Range  # in all cycles of the loop, also those that use a message again
    # Whether the first use comes at one age but for the jitter of the loop's start.
    constant: bool
    uses: tuple[Count, Count]  # in how many cycles a message is used: the fewest, and the most


class PlannedLoop(Part):
    """A loop that reads the shaped output, and what is planned for it.

    What is measured anew at each start of the loop stands here as it was in the recording:
    ``phase_ns``, with all that follows from it, which is ``age`` and, in step with the output, the
    output's slot.
    """

    chain: str | None = None  # the chain as the user wrote it, into the loop or through it
    node: FullName  # whose loop it is
    thread: Annotated[str, Field(min_length=1)] | None = None  # its thread's name; None: not known
    topic: FullName  # what it reads: the chain's output
    # From one start to the next; None: it sleeps irregularly, and has no period.
    period_ns: PositiveDuration | None = None
    # Between its starts, where they are irregular: 5th percentile, median, 95th percentile.
    intervals_ns: tuple[Duration, Duration, Duration] | None = None
    # How long after the start of a cycle of the chain its instances start, at the earliest, modulo
    # the greatest common divisor of its period and the cycle (:attr:`common_ns`).
    phase_ns: Duration = 0
    jitter_ns: Duration = 0  # its starts lie within so much behind the phase, 99 % of them
    # How much faster than the chain's clock the loop's runs, in millionths; its phase moves so.
    drift_ppm: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    samples: FromOne  # instances that were measured
    # Its starts are those of its publications, since the recording has no events of its sleeps.
    inferred: Literal[True] | None = None
    # From the output's publication to the loop's store: shortest, longest of 99.5 %, longest.
    delivery_ns: tuple[Duration, Duration, Duration]
    # So long before an instance the output leaves, in step, at least: delivery and margin.
    lead_ns: Duration
    # "output": at each start of the loop the output's slot is put the lead before its instances.
    # "loop": the loop's sleep is moved once, so that it starts the lead behind the slot's start.
    in_step: InStep | None = None
    # In step with "output", where the slot starts, earliest (behind L̄ + ε) and latest (so that it
    # ends, and its gate is done, with the cycle): see :func:`.loop_ages.start_in_step`.
    starts_ns: Range | None = None
    # How much later the output's slots are so that no instance starts while a message is stored.
    moved_ns: Duration = 0
    # In step with "loop", how much later than in the recording its instances start.
    move_ns: Duration | None = None
    # The real-time priority that the thread has by itself; None: it has none.
    realtime_priority: FromOne | None = None
    # Where its thread runs while the plan is in force; None: where and as it does by itself.
    runs_at: ReceiverPlace | None = None
    age: LoopAge  # with the phase of the recording, or in step
    age_at_any_phase: LoopAge | None = None  # whatever phase the loop starts with; None: the same

    @property
    def stored_ns(self) -> Range:
        """From the start of the output's slot to the loop's store: shortest, and with margin.

        In step, what is stored within the lead is there when the loop's instance starts.
        """
        return self.delivery_ns[0], max(self.delivery_ns[0], self.lead_ns - 1)


class ShapingNode(Part):
    """The node that takes a topic and republishes it in the slots of the server with its thread."""

    name: Annotated[str, _plain_name("node")]
    input: FullName  # the topic on which the chain publishes
    output: FullName  # the topic that its subscribers have
    publisher: FullName | None = None  # the node that publishes `input`, if not `chain.publisher`
    core: Count
    fifo_priority: Annotated[int, Field(ge=1, le=98)]
    spin_ns: Duration  # so long before the slot it begins to watch the clock
    pause_ns: Duration  # so long it rests after a publication, so that it does not delay delivery
    receivers: tuple[FullName, ...] = ()  # nodes that subscribe to `output`, under SCHED_FIFO
    receivers_at: ReceiverPlace | None = None  # where they run; None: below all servers
    depth: FromOne | None = None  # how many messages may wait in it; None: see :class:`.Wishes`
    # Whether it is a thread in the publisher's process, where a library takes what is published;
    # tracers call that `input`.
    in_process: bool = False
    # So long behind its publication a library in the receivers' processes hands each message over.
    delivery_ns: PositiveDuration | None = None

    @property
    def thread(self) -> Thread:
        """The node's executor, as servers name it."""
        return Thread(node=f"/{self.name}")

    @model_validator(mode="after")
    def _two_topics(self) -> "ShapingNode":
        if self.input == self.output:
            reason = f"the node would feed itself: let the chain publish on {self.output}_tmp"
            raise wrong_value(reason, "input")
        if self.delivery_ns is not None and not self.receivers:
            reason = f"no receiver of {self.output} is named: plan with --receivers, from a"
            reason += " recording that has its subscribers, or leave out --delivery"
            raise wrong_value(reason, "delivery_ns")
        return self


class Modes(Part):
    """Which latency band the output has in each mode of the system (sections 3.3 and 6)."""

    topic: FullName  # a `std_msgs/msg/String` that names the mode in force
    default: ModeName  # the mode in force until the topic names another
    bands: Annotated[dict[ModeName, FromOne], Field(min_length=1)]  # 1 is the first slot
    # An output behind its mode's slot: it waits for that of the next cycle, is discarded, leaves at
    # once (`publish`), or takes the `next-slot` of the cycle.
    late: Late = "wait"

    @model_validator(mode="after")
    def _default_exists(self) -> "Modes":
        if self.default not in self.bands:
            reason = f"{self.default!r} has no band: write one of {', '.join(self.bands)}"
            raise wrong_value(reason, "default")
        return self


class Adaptation(Part):
    """How slots follow the latencies of what runs (:class:`~chainshaper.planning.adaptation.Tail`).

    Slots move later when too many cycles would have been late in them, and earlier when that takes
    enough off the latency.
    """

    window: Annotated[int, Field(ge=500, le=1_000_000)] = 4_000  # so many last cycles are judged
    late: Annotated[float, Field(gt=1, le=10)] = 1.5  # so many times the promised share is too many
    gain: Annotated[float, Field(gt=0, lt=1)] = 0.01  # the least share of the latency to be gained
    after: FromOne = 500  # for so many cycles on end that has to be gained
    max_latency_ns: PositiveDuration | None = None  # where slots end at the latest; None: the cycle


class Prediction(Part):
    """What the plan promises: end-to-end latency, and the share of cycles per latency band.

    A band is represented by the end of its slot (section 4.1).
    """

    mean_ns: Duration
    max_ns: Duration
    jitter_ns: Duration  # from the start of the first slot to the end of the last
    shares: tuple[Share, ...] = ()  # of each band
    modes: "dict[ModeName, Prediction] | None" = None  # the same in each mode
    # The same until the callbacks of receivers start; None: nothing is promised.
    receivers: "Prediction | None" = None


class ControlCost(Part):
    """What the plan's slots let a controller cost per second, and what was chosen from."""

    plant: str  # the file that describes the loop
    cost: float
    unshaped: float | None  # the same without a plan; None: the loop is unstable
    chosen: str  # the name of one of the alternatives
    delay_ns: Duration | None = None  # that the controller is to be designed for; None: it stays
    alternatives: dict[str, float | None] = Field(default_factory=dict)
    worth: bool = True  # whether it costs less than unshaped


class BandPrediction(NamedTuple):
    """What a plan promises of a latency band."""

    start_ns: int  # of its slot
    end_ns: int
    share: float  # of the cycles
    jitter_ns: int  # at most


class ChainPlan(Part):
    """Servers and shaping nodes for one chain, with the evidence and the prediction."""

    chain: ChainOfPlan
    evidence: Evidence
    margin: Margin
    policy: Policy
    cycle_ns: PositiveDuration  # a whole multiple of the chain's period
    offset_ns: Duration = 0  # of its cycles, from the instant that cycles of all chains count from
    # See :mod:`chainshaper.robot.gate`:
    anchor: Anchor = "stamp"
    overrun: Overrun = "wait"
    into_open_slot: IntoOpenSlot = "at-once"
    messages: Messages = "all-in-order"
    # See :mod:`chainshaper.values.plan_choices`:
    fallback: Fallback = "bypass"
    shaping_thread: ShapingThread = "free"
    equal_priorities: EqualPriorities = "apart"
    slot_ends: SlotEnds = "open-until-done"
    servers: Annotated[tuple[Server, ...], Field(min_length=1)]
    # That of the chain's output; None: nothing is shaped, or the publisher's own thread is gated.
    shaping_node: ShapingNode | None = None
    # Those of further sinks, or of topics inside the chain (LET per callback).
    further_shaping_nodes: tuple[ShapingNode, ...] = ()
    modes: Modes | None = None
    adaptation: Adaptation | None = None
    loop: PlannedLoop | None = None  # that reads the output; None: no loop of the chain does
    control: ControlCost | None = None  # of the plant that the slots are placed for
    predicted: Prediction

    def __repr__(self) -> str:
        slots = ", ".join(slot_text(slot) for slot in publish_slots(self))
        parts = [self.policy, f"cycle {duration_text(self.cycle_ns)}"]
        parts += [f"outputs in {slots}"] if slots else []
        parts += [f"average {milliseconds(self.predicted.mean_ns)} ms"]
        parts += [f"jitter {milliseconds(self.predicted.jitter_ns)} ms at most"]
        return shown(f"ChainPlan({self.chain.spec or 'a chain'}: {', '.join(parts)})")

    __str__ = __repr__
    _repr_html_ = notebook_html

    @model_validator(mode="after")
    def _consistent(self) -> "ChainPlan":
        rules = (_servers, _overlaps, _shaping_nodes, _modes, _publisher_threads, _choices, _loop)
        return checked(self, _cycle, *rules)


def in_one_slot(slot: Slot, mean_ns: int | None = None) -> Prediction:
    """Return the prediction for outputs that leave in one slot, by default (eq. 5) at its end."""
    start, end = slot
    mean_ns = end if mean_ns is None else mean_ns
    return Prediction(mean_ns=mean_ns, max_ns=end, jitter_ns=end - start, shares=(1.0,))


def predicted_later(predicted: Prediction, later_ns: int) -> Prediction:
    """Return the prediction for outputs that leave so much later."""
    modes = {
        mode: predicted_later(of_mode, later_ns)
        for mode, of_mode in (predicted.modes or {}).items()
    }
    return predicted.model_copy(
        update={
            "mean_ns": predicted.mean_ns + later_ns,
            "max_ns": predicted.max_ns + later_ns,
            "modes": modes or None,
        }
    )


def server_of(plan: ChainPlan, thread: Thread) -> Server | None:
    """Return the server that a thread is assigned to; None: it runs outside all servers."""
    return next((server for server in plan.servers if thread in server.threads), None)


def shaping_nodes(plan: ChainPlan) -> list[ShapingNode]:
    """Return all shaping nodes of a plan, that of the chain's output first."""
    if plan.shaping_node is None:
        return [*plan.further_shaping_nodes]
    return [plan.shaping_node, *plan.further_shaping_nodes]


def inner_gates(plan: ChainPlan) -> tuple[ShapingNode, ...]:
    """Return the shaping nodes of topics inside the chain: under LET per callback.

    Their messages have only to be there when the next callback is to start.
    """
    return plan.further_shaping_nodes if plan.policy == "let-per-callback" else ()


def output_server(plan: ChainPlan) -> Server | None:
    """Return the server in whose slots the chain's output is published; None: nothing is shaped.

    A plan from bare latencies names no threads; there it is the server called ``output``.
    """
    server = None
    if plan.shaping_node is not None:
        server = server_of(plan, plan.shaping_node.thread)
    elif plan.chain.publisher is not None:
        server = server_of(plan, Thread(node=plan.chain.publisher, role="publisher"))
    if server is not None:
        return server
    return next((server for server in plan.servers if server.name == "output"), None)


def publish_slots(plan: ChainPlan) -> tuple[Slot, ...]:
    """Return the slots of :func:`output_server`, ascending; none where nothing is shaped."""
    server = output_server(plan)
    return () if server is None else server.slots


def band_predictions(plan: ChainPlan) -> tuple[BandPrediction, ...]:
    """Return the prediction of each band; of none where nothing is shaped.

    There is none either where a user has added or removed a slot in the plan's file.
    """
    slots, shares = publish_slots(plan), plan.predicted.shares
    if len(slots) != len(shares):
        return ()
    is_exact = plan.into_open_slot == "next-slot"  # outputs leave only when a slot begins
    return tuple(
        BandPrediction(start, end, share, jitter_ns=0 if is_exact else end - start)
        for (start, end), share in zip(slots, shares, strict=True)
    )


def publishing_servers(plan: ChainPlan) -> tuple[Server, ...]:
    """Return all servers in whose slots something is published: outputs, or topics inside."""
    gates = {node.thread for node in shaping_nodes(plan)}
    output = output_server(plan)
    return tuple(
        server
        for server in plan.servers
        if server is output
        or any(thread in gates or thread.role == "publisher" for thread in server.threads)
    )


def running_servers(plan: ChainPlan) -> list[Server]:
    """Return the servers that run the chain: nothing is published in them, none is best effort."""
    publishing = publishing_servers(plan)
    return [
        server for server in plan.servers if server not in publishing and not server.best_effort
    ]


def with_slots(
    servers: Iterable[Server], slots: Mapping[str, Sequence[Slot]]
) -> tuple[Server, ...]:
    """Return the servers, those of these names with other slots."""
    return tuple(
        server.model_copy(update={"slots": tuple(slots.get(server.name, server.slots))})
        for server in servers
    )


def until(server: Server, end_ns: int) -> tuple[Slot, ...]:
    """Return a server's slots; the last one ends at ``end_ns``, or later, if it did so before."""
    *before, (start, end) = server.slots
    return (*before, (start, max(end, end_ns)))


def revised(plan: ChainPlan, **changes: object) -> ChainPlan:
    """Return a plan with some fields replaced, checked. Raises InputError: they make no plan."""
    values = {name: getattr(plan, name) for name in ChainPlan.model_fields}
    with wrong_values_refused(ChainPlan):
        return ChainPlan.model_validate({**values, **changes})


# The rules ------------------------------------------------------------------------------------


def _cycle(plan: ChainPlan) -> Wrong:
    cycle, period, longest = plan.cycle_ns, plan.chain.period_ns, plan.evidence.max_latency_ns
    if cycle % period:
        reason = f"{duration_text(cycle)} is no multiple of the period {duration_text(period)}"
        yield reason, "cycle"
    if cycle <= longest and plan.policy not in PER_CALLBACK:
        reason = f"{duration_text(cycle)} is not longer than the longest latency measured,"
        reason += f" {duration_text(longest)}: plan with a longer period or a shorter chain"
        yield reason, "cycle"
    if plan.policy == "pipelined" and plan.anchor == "cycle":
        reason = "an output of a pipeline is whole cycles old, as only its stamp says: write stamp"
        yield reason, "anchor"


def _servers(plan: ChainPlan) -> Wrong:
    homes: dict[Thread, str] = {}
    for place, server in enumerate(plan.servers):
        where = ("servers", place)
        if server.name in (earlier.name for earlier in plan.servers[:place]):
            yield f"two servers are named {server.name!r}: rename one", *where, "name"
        for number, slot in enumerate(server.slots):
            if slot[1] > plan.cycle_ns:
                reason = f"the slot {slot_text(slot)} ends after the cycle"
                reason += f" {duration_text(plan.cycle_ns)}: move or split it"
                yield reason, *where, "slots", number
        for number, thread in enumerate(server.threads):
            for taken in filter(thread.overlaps, homes):
                reason = f"{taken.text} is already in server {homes[taken]!r}: write it in one"
                yield reason, *where, "threads", number
            homes[thread] = server.name
        for reserved in plan.servers if server.best_effort else ():
            same_core = not reserved.best_effort and reserved.core == server.core
            if same_core and server.priority <= reserved.priority:
                reason = f"best effort comes behind all others: write more than {reserved.priority}"
                yield reason, *where, "priority"


def _overlaps(plan: ChainPlan) -> Wrong:
    """Two servers of one core may overlap only when a priority says who runs, or by turns."""
    if plan.equal_priorities != "apart":
        return
    for (_, first), (place, second) in combinations(enumerate(plan.servers), 2):
        if (first.core, first.priority) != (second.core, second.priority):
            continue
        for (number, slot), taken in product(enumerate(second.slots), first.slots):
            if meet(slot, taken):
                reason = f"the slot {slot_text(slot)} overlaps {slot_text(taken)} of server"
                reason += f" {first.name!r} on core {first.core}: move one, or give one server"
                yield f"{reason} another priority", "servers", place, "slots", number


def _shaping_nodes(plan: ChainPlan) -> Wrong:
    output, nodes = plan.chain.output, shaping_nodes(plan)
    for place, node in enumerate(nodes, start=-1 if plan.shaping_node else 0):
        where = ("shaping_node",) if place < 0 else ("further_shaping_nodes", place)
        server = server_of(plan, node.thread)
        further = [shaping for shaping in nodes if shaping is not node]
        if any(node.name == shaping.name or node.output == shaping.output for shaping in further):
            reason = f"another one has the name {node.name} or the output {node.output} too: both"
            yield f"{reason} must be its own", *where
        if place < 0 and output not in (None, node.output):
            reason = f"publishes {node.output}, but the chain's output is {output}"
            yield f"{reason}: make them the same", *where, "output"
        if server is None:
            reason = f"no server holds its thread: add {{node: {node.thread.node}}} to one's"
            yield f"{reason} threads", *where, "name"
        elif server.core != node.core:
            reason = f"{node.core}, but server {server.name!r} is on {server.core}"
            yield f"{reason}: make them the same", *where, "core"
    if not nodes and plan.shaping_thread != "free":
        reason = f"{plan.shaping_thread}, but the plan has no shaping node: remove it"
        yield reason, "shaping_thread"


def _modes(plan: ChainPlan) -> Wrong:
    if plan.modes is None:
        return
    if plan.shaping_node is None:
        reason = "only a shaping node knows the mode of the system, and the plan has none: plan"
        yield f"{reason} with synchronous publication, or without modes", "modes"
    elif plan.modes.topic in (plan.shaping_node.input, plan.shaping_node.output):
        reason = f"{plan.modes.topic} carries the chain's output: name that of the mode"
        yield reason, "modes", "topic"
    slots = len(publish_slots(plan))
    for mode, band in plan.modes.bands.items():
        if band > slots:
            reason = f"{band}, but there are {slots} slots: write from 1 to {slots}, or add a slot"
            yield reason, "modes", "bands", mode


def _publisher_threads(plan: ChainPlan) -> Wrong:
    """The thread of a gated publisher must not block its process, nor be blocked by it."""
    measured, depth = plan.evidence.longest_send_ns, plan.chain.output_depth
    shortest = max(SHORTEST_SLOT_NS, SENDS_PER_SLOT * (measured or 0))
    took = f" (the longest took {duration_text(measured)})" if measured else ""
    for place, server, nodes in publisher_servers(plan):
        where = ("servers", place)
        for number, slot in enumerate(server.slots):
            if slot[1] - slot[0] < shortest:
                reason = f"the slot {slot_text(slot)} is too short for a publisher's thread:"
                reason += f" stopped in a send{took}, it would block the whole process; make it"
                reason += f" {duration_text(shortest)} or longer (--publish-slot)"
                yield reason, *where, "slots", number
        worse = [
            running
            for running in plan.servers
            if running.core == server.core and running.priority > server.priority
        ]
        for node, running, slot in product(nodes, worse, server.slots):
            if not any(map(Thread(node=node).overlaps, running.threads)):
                continue
            # No output comes before the shortest latency.
            sends = (max(slot[0], plan.evidence.min_latency_ns), slot[1])
            if sends[0] < sends[1] and any(meet(sends, runs) for runs in running.slots):
                worst = running.priority
                reason = f"the publisher thread of {node} would out-rank its executor, which server"
                reason += f" {running.name!r} runs at priority {worst} in {slot_text(slot)}, and"
                reason += f" spin for its lock: write a number above {worst}, or move the slot"
                yield reason, *where, "priority"
        if plan.overrun == "publish" and plan.policy not in ("shaped", "one-long-slot"):
            reason = f"under {plan.policy} an asynchronous output in its own cycle looks like an"
            reason += " overrun: write wait or discard, or plan with --publication synchronous"
            yield reason, "overrun"
        waiting = messages_waiting(plan, server)
        if depth is not None and plan.chain.publisher in nodes and depth < waiting:
            reason = f"a history of {depth} is too shallow for the {waiting} messages that come"
            reason += f" while the thread may not run: give {plan.chain.output or 'the output'} a"
            reason += f" depth of {waiting + 1}, or the server {server.name!r} more slots"
            yield reason, "chain", "output_depth"


def _choices(plan: ChainPlan) -> Wrong:
    gated = any(publisher_servers(plan))
    if plan.into_open_slot == "next-slot" and (gated or plan.policy != "shaped"):
        reason = "only a shaping node sees when an output comes, under the policy shaped, not"
        reason += f" {'a gated publisher' if gated else plan.policy}: write at-once"
        yield reason, "into_open_slot"
    latest = None if plan.adaptation is None else plan.adaptation.max_latency_ns
    for slot in publish_slots(plan)[-1:]:
        if latest is not None and slot[1] > latest:
            reason = f"{duration_text(latest)}, but the slot {slot_text(slot)} ends behind it"
            yield f"{reason}: write more", "adaptation", "max_latency"


def loop_common_ns(plan: ChainPlan) -> int:
    """Return g, the greatest common divisor of the cycle and the period of the plan's loop (ns).

    Instances of the loop lie g apart in the cycle. Raises ValueError: no loop of a period reads the
    output.
    """
    if plan.loop is None or plan.loop.period_ns is None:
        raise ValueError("the plan has no loop with a period")
    return math.gcd(plan.cycle_ns, plan.loop.period_ns)


def _loop(plan: ChainPlan) -> Wrong:
    loop = plan.loop
    if loop is None:
        return
    if plan.chain.output not in (None, loop.topic):
        reason = f"{loop.topic}, but the chain's output is {plan.chain.output}: make them the same"
        yield reason, "loop", "topic"
    if (loop.period_ns is None) == (loop.intervals_ns is None):
        yield "write its period, or the intervals of an irregular one", "loop"
    if loop.in_step is None:
        return
    if loop.period_ns is None:
        yield "it has no period, so nothing is in step with it: remove this", "loop", "in_step"
        return
    if loop.period_ns % plan.cycle_ns and plan.cycle_ns % loop.period_ns:
        reason = f"neither of its period {duration_text(loop.period_ns)} and the cycle"
        reason += f" {duration_text(plan.cycle_ns)} is a multiple of the other, so no age is"
        yield f"{reason} constant: remove this", "loop", "in_step"
    if plan.shaping_node is None or len(publish_slots(plan)) != 1:
        reason = "a shaping node has to publish the output in one slot of the cycle, which is put"
        yield f"{reason} before the loop's start: remove this", "loop", "in_step"
    if (loop.in_step == "output") != (loop.starts_ns is not None):
        yield "goes with in_step: output, and only with it", "loop", "starts"
    if (loop.in_step == "loop") != (loop.move_ns is not None):
        yield "goes with in_step: loop, and only with it", "loop", "move"


def below_executors(servers: Sequence[Server]) -> tuple[Server, ...]:
    """Return the servers with worse priorities where they have to run behind others of their core.

    Those of publishers' threads run behind all that may run at the same time, those for best effort
    behind all.
    """

    def behind(server: Server, better: Iterable[Server]) -> Server:
        worse = (above.priority + 1 for above in better if above.core == server.core)
        return server.model_copy(update={"priority": max([server.priority, *worse])})

    publishing = [
        server for server in servers if any(thread.role == "publisher" for thread in server.threads)
    ]
    running = [server for server in servers if server not in publishing and not server.best_effort]
    ranked = []
    for server in servers:
        begins_ns = server.slots[0][0]
        meanwhile = (executing for executing in running if executing.slots[-1][1] > begins_ns)
        ranked.append(behind(server, meanwhile) if server in publishing else server)
    reserved = [server for server in ranked if not server.best_effort]
    return tuple(behind(server, reserved) if server.best_effort else server for server in ranked)


def publisher_servers(plan: ChainPlan) -> Iterator[tuple[int, Server, list[str]]]:
    """Yield servers with publishers' threads: place in the plan, server, nodes of these threads."""
    for number, server in enumerate(plan.servers):
        nodes = [thread.node for thread in server.threads if thread.role == "publisher"]
        if nodes:
            yield number, server, nodes


def messages_waiting(plan: ChainPlan, server: Server) -> int:
    """Return how many messages may be handed over while a server is closed, in one stretch."""
    first, *_ = server.slots
    again = (first[0] + plan.cycle_ns, first[1])
    longest = max(after[0] - before[1] for before, after in pairwise([*server.slots, again]))
    return longest // plan.chain.period_ns + 1  # one where the stretch begins
