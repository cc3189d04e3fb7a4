"""The plan of one chain: the servers, slots, threads and shaping nodes that hold its latency.

Every :class:`ChainPlan` obeys every rule checked here, whichever way it came about. Durations are
integer nanoseconds, in fields that end in ``_ns``; in YAML the same keys stand without the suffix,
their values with a unit (``period: 100ms``). Slots are half-open and count from a cycle's start.

A server may stop the thread of an asynchronous publisher (design 1, section 3.2.1), which shares
locks with its process. With Fast DDS 2.14, three things are destructive and refused: a slot hardly
longer than a send (0.25 ms; stopped in one, the thread has what every publisher needs); a thread
that out-ranks its executor on the same core (it spins for the lock under which that hands a message
over); and a history too shallow for what comes while it may not run.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, combinations, pairwise, product
from typing import Annotated, Literal, NamedTuple, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from chainshaper.robot.gate import Anchor, IntoOpenSlot, Late, Messages, Overrun
from chainshaper.values.durations import duration_text, format_duration, parse_duration
from chainshaper.values.plan_choices import (
    EqualPriorities,
    Fallback,
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


def _plain_name(what: str) -> AfterValidator:
    def check(value: str) -> str:
        if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
            return value
        raise ValueError(f"{value!r} is not a {what}'s name: write letters, digits and underscores")

    return AfterValidator(check)


ModeName = Annotated[str, _plain_name("mode")]
Count = Annotated[int, Field(ge=0)]
FromOne = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Slot: TypeAlias = tuple[Duration, Duration]
"""A time slot [start, end) of a cycle."""
Wrong: TypeAlias = Iterator[tuple[str | int, ...]]
"""What a rule finds: the reason, and where it is wrong, by keys as in the file."""


def checked(model: Model, *rules: Callable[[Model], Wrong]) -> Model:
    """A model that obeys these rules: the first that does not hold is raised."""
    for reason, *where in chain.from_iterable(rule(model) for rule in rules):
        raise wrong_value(str(reason), *where)
    return model


def slot_text(slot: Slot) -> str:
    """A slot as people write it: ``[86ms, 87ms)``."""
    return f"[{duration_text(slot[0])}, {duration_text(slot[1])})"


def meet(one: Slot, two: Slot) -> bool:
    """Whether two slots overlap."""
    return one[0] < two[1] and two[0] < one[1]


class ChainOfPlan(Part):
    """The chain that is planned for. From bare latencies only the period is known: such a plan can
    be studied, not carried out. ``publisher`` is a node, ``output_depth`` its writer's history.
    """

    spec: str | None = None
    output: FullName | None = None
    publisher: FullName | None = None
    output_depth: FromOne | None = None
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
    modes: "dict[ModeName, Evidence] | None" = None  # the same for the cycles in each mode

    @model_validator(mode="after")
    def _ordered(self) -> "Evidence":
        if not self.min_latency_ns <= self.mean_latency_ns <= self.max_latency_ns:
            raise wrong_value("min, mean and max latency must ascend: correct them", "mean_latency")
        return self


class Margin(Part):
    """How far the chain's slot reaches beyond the longest undisturbed latency (ε of eq. 1).

    ``given``; ``measured``: it covers all cycles but a share, for which ``stalls_ns`` of it are
    needed; ``derived``: it is the upper end of an interval that the tail of the latencies has.
    ``overrun_probability`` is the share of late outputs, at most, with 95 % confidence;
    ``independent_cycles`` is how many the sample is worth, where long cycles come in clusters.
    """

    epsilon_ns: Duration
    source: Literal["given", "measured", "derived"] = "given"
    overrun_probability: Annotated[float, Field(gt=0, le=1)] | None = None
    stalls_ns: Duration = 0
    confidence_interval_ns: tuple[Duration, Duration] | None = None
    independent_cycles: FromOne | None = None


def _callback(value: str) -> str:
    """A callback by what starts it, in one spelling. Raises ValueError: it is neither."""
    if value.startswith("every "):
        return f"every {format_duration(parse_duration(value.removeprefix('every ')))}"
    if re.fullmatch(r"(/[A-Za-z_]\w*)+", value):
        return value
    raise ValueError(f"{value!r} is no callback: write its topic, or a timer's `every 100ms`")


class Thread(Part):
    """A thread of a node that runs inside a server; other DDS threads are never gated (sec. 3.1).

    A node may have callback groups with an executor each (section 6): ``callbacks`` are those of
    the one that is meant, by topic or as ``every 100ms``. Without, all executors of the node are.
    """

    node: FullName
    role: Literal["executor", "publisher"] = "executor"
    callbacks: tuple[Annotated[str, AfterValidator(_callback)], ...] = ()

    def overlaps(self, other: "Thread") -> bool:
        """Whether a thread may be both."""
        apart = self.callbacks and other.callbacks
        same = (self.node, self.role) == (other.node, other.role)
        return same and not (apart and set(self.callbacks).isdisjoint(other.callbacks))

    @property
    def text(self) -> str:
        """A thread as messages name it."""
        said = f" that runs {', '.join(self.callbacks)}" if self.callbacks else ""
        return f"the {self.role} of {self.node}{said}"


class Server(Part):
    """A table-driven reservation server (section 2.2.1): its threads run in its slots only, the
    first the most urgent (:attr:`.Plan.most_urgent_first`). A smaller ``priority`` is
    better, as in LITMUS^RT. One for ``best_effort`` (R_m' and R_int of the paper, sections 3.1 and
    5.1) runs only what is left of its core by all others.
    """

    name: Annotated[str, Field(min_length=1)]
    core: Count
    priority: FromOne
    slots: Annotated[tuple[Slot, ...], Field(min_length=1)]
    threads: tuple[Thread, ...] = ()
    best_effort: bool = False

    @model_validator(mode="after")
    def _slots_ascend(self) -> "Server":
        for number, (before, slot) in enumerate(pairwise(((0, 0), *self.slots))):
            what = f"the slot {slot_text(slot)}"
            if slot[0] >= slot[1]:
                reason = f"{what} is empty: its end must come after its start"
                raise wrong_value(reason, "slots", number)
            if slot[0] < before[1]:
                reason = f"{what} begins before {slot_text(before)} ends: write slots ascending"
                raise wrong_value(f"{reason}, no overlap", "slots", number)
        return self


class ReceiverPlace(Part):
    """Where the executors of those run that receive a shaped output.

    At the ``priority`` of outputs, as servers count it, they run behind shaping nodes and above all
    servers of chains. For ``time_ns`` in a cycle, at most, the plan leaves the core to them.
    """

    core: Count
    priority: FromOne
    time_ns: Duration


class ShapingNode(Part):
    """The node that takes the chain's output from ``input`` and republishes it on ``output``, in
    the slots of the server that has its thread.

    It spins from ``spin_ns`` before the slot on, and pauses for ``pause_ns`` after a publication so
    that it does not delay delivery. ``publisher`` is the node whose output it takes, where that is
    not `chain.publisher`. The executors of ``receivers``, which subscribe to the output, run under
    SCHED_FIFO, at ``receivers_at`` or, without, below all servers. ``depth`` messages may wait in
    it (None: see :class:`.Wishes`). With ``in_process`` it is a thread in the publisher's process,
    where a library takes what is published, which tracers call ``input``. With ``delivery_ns`` a
    library in the receivers' processes hands them each message that long behind its publication.
    """

    name: Annotated[str, _plain_name("node")]
    input: FullName
    output: FullName
    publisher: FullName | None = None
    core: Count
    fifo_priority: Annotated[int, Field(ge=1, le=98)]
    spin_ns: Duration
    pause_ns: Duration
    receivers: tuple[FullName, ...] = ()
    receivers_at: ReceiverPlace | None = None
    depth: FromOne | None = None
    in_process: bool = False
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
    """Which latency band, 1 for the first slot, the output has in each mode (sections 3.3, 6).

    The active mode is read from ``topic``, a ``std_msgs/msg/String``; until then it is ``default``.
    A ``late`` output waits for its mode's slot of the next cycle, is discarded, leaves at once
    (``publish``), or takes the ``next-slot`` of the cycle.
    """

    topic: FullName
    default: ModeName
    bands: Annotated[dict[ModeName, FromOne], Field(min_length=1)]
    late: Late = "wait"

    @model_validator(mode="after")
    def _default_exists(self) -> "Modes":
        if self.default not in self.bands:
            reason = f"{self.default!r} has no band: write one of {', '.join(self.bands)}"
            raise wrong_value(reason, "default")
        return self


class Adaptation(Part):
    """How slots follow the latencies of what runs (:class:`~chainshaper.planning.adaptation.Tail`).

    They move later when ``late`` times the promised share of the last ``window`` cycles would have
    been late in them; earlier where that has taken at least the share ``gain`` off the latency for
    ``after`` cycles on end. None ends behind ``max_latency_ns`` (None: behind the cycle).
    """

    window: Annotated[int, Field(ge=500, le=1_000_000)] = 4_000
    late: Annotated[float, Field(gt=1, le=10)] = 1.5
    gain: Annotated[float, Field(gt=0, lt=1)] = 0.01
    after: FromOne = 500
    max_latency_ns: PositiveDuration | None = None


class Prediction(Part):
    """What the plan promises: end-to-end latency, and the share of cycles per latency band.

    A band is represented by the end of its slot (section 4.1). The jitter is the widest distance of
    two outputs, from the start of the first slot to the end of the last. ``modes`` has each mode's,
    ``receivers`` the same until the receiver's callback starts (None: nothing is promised).
    """

    mean_ns: Duration
    max_ns: Duration
    jitter_ns: Duration
    shares: tuple[Share, ...] = ()
    modes: "dict[ModeName, Prediction] | None" = None
    receivers: "Prediction | None" = None


class BandPrediction(NamedTuple):
    """One latency band: its slot, its share of the cycles, its jitter at most."""

    start_ns: int
    end_ns: int
    share: float
    jitter_ns: int


class ChainPlan(Part):
    """Servers and shaping nodes for one chain, with the evidence and the prediction.

    ``cycle_ns`` is a whole multiple of the chain's period; cycles start ``offset_ns`` after the
    instant from which those of all chains count. For ``anchor`` to ``messages`` see
    :mod:`chainshaper.robot.gate`, for the next four :mod:`chainshaper.values.plan_choices`.
    ``shaping_node`` serves the chain's output, unless the publisher's own thread is gated;
    ``further_shaping_nodes`` serve other sinks, or topics inside a chain (LET per callback).
    """

    chain: ChainOfPlan
    evidence: Evidence
    margin: Margin
    policy: Policy
    cycle_ns: PositiveDuration
    offset_ns: Duration = 0
    anchor: Anchor = "stamp"
    overrun: Overrun = "wait"
    into_open_slot: IntoOpenSlot = "at-once"
    messages: Messages = "all-in-order"
    fallback: Fallback = "bypass"
    shaping_thread: ShapingThread = "free"
    equal_priorities: EqualPriorities = "apart"
    slot_ends: SlotEnds = "open-until-done"
    servers: Annotated[tuple[Server, ...], Field(min_length=1)]
    shaping_node: ShapingNode | None = None
    further_shaping_nodes: tuple[ShapingNode, ...] = ()
    modes: Modes | None = None
    adaptation: Adaptation | None = None
    predicted: Prediction

    @model_validator(mode="after")
    def _consistent(self) -> "ChainPlan":
        rules = (_servers, _overlaps, _shaping_nodes, _modes, _publisher_threads, _choices)
        return checked(self, _cycle, *rules)


def in_one_slot(slot: Slot, mean_ns: int | None = None) -> Prediction:
    """What is promised of outputs that all leave in one slot, by default (eq. 5) at its end."""
    start, end = slot
    mean_ns = end if mean_ns is None else mean_ns
    return Prediction(mean_ns=mean_ns, max_ns=end, jitter_ns=end - start, shares=(1.0,))


def server_of(plan: ChainPlan, thread: Thread) -> Server | None:
    """The server that a thread is assigned to, or None when it runs outside all servers."""
    return next((server for server in plan.servers if thread in server.threads), None)


def shaping_nodes(plan: ChainPlan) -> list[ShapingNode]:
    """All shaping nodes of a plan, that of the chain's output first."""
    return [*([plan.shaping_node] if plan.shaping_node else []), *plan.further_shaping_nodes]


def inner_gates(plan: ChainPlan) -> tuple[ShapingNode, ...]:
    """The shaping nodes of topics inside the chain, whose messages have only to be there when the
    next callback is to start: under LET per callback all but that of the output.
    """
    return plan.further_shaping_nodes if plan.policy == "let-per-callback" else ()


def output_server(plan: ChainPlan) -> Server | None:
    """The server in whose slots the chain's output is published; None without shaping. A plan from
    bare latencies names no threads: its server ``output`` is meant.
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
    """The slots of :func:`output_server`, ascending; none without shaping."""
    return server.slots if (server := output_server(plan)) else ()


def band_predictions(plan: ChainPlan) -> tuple[BandPrediction, ...]:
    """The prediction band by band; none where nothing is shaped, or slots were edited in number."""
    slots, shares = publish_slots(plan), plan.predicted.shares
    if len(slots) != len(shares):
        return ()
    exact, bands = plan.into_open_slot == "next-slot", zip(slots, shares, strict=True)
    return tuple(BandPrediction(a, b, own, 0 if exact else b - a) for (a, b), own in bands)


def publishing_servers(plan: ChainPlan) -> tuple[Server, ...]:
    """All servers in whose slots something is published: the output, other sinks, inner topics."""
    nodes = {node.thread for node in shaping_nodes(plan)}
    output = output_server(plan)
    return tuple(
        server
        for server in plan.servers
        if server is output or any(t in nodes or t.role == "publisher" for t in server.threads)
    )


def running_servers(plan: ChainPlan) -> list[Server]:
    """The servers that run the chain: in which nothing is published, and none for best effort."""
    publishing = publishing_servers(plan)
    return [
        server for server in plan.servers if server not in publishing and not server.best_effort
    ]


def with_slots(
    servers: Iterable[Server], slots: Mapping[str, Sequence[Slot]]
) -> tuple[Server, ...]:
    """The servers, of which those of these names have other slots."""
    return tuple(
        server.model_copy(update={"slots": tuple(slots.get(server.name, server.slots))})
        for server in servers
    )


def until(server: Server, end_ns: int) -> tuple[Slot, ...]:
    """A server's slots, the last of which does not end earlier than that."""
    *before, (start, end) = server.slots
    return (*before, (start, max(end, end_ns)))


def revised(plan: ChainPlan, **changes: object) -> ChainPlan:
    """A copy of a plan with some fields replaced, checked. Raises InputError: they make no plan."""
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
        if server.name in (one.name for one in plan.servers[:place]):
            yield f"two servers are named {server.name!r}: rename one", *where, "name"
        for number, slot in enumerate(server.slots):
            if slot[1] > plan.cycle_ns:
                what = f"the slot {slot_text(slot)} ends after the cycle"
                reason = f"{what} {duration_text(plan.cycle_ns)}: move or split it"
                yield reason, *where, "slots", number
        for number, thread in enumerate(server.threads):
            for taken in filter(thread.overlaps, homes):
                reason = f"{taken.text} is already in server {homes[taken]!r}: write it in one"
                yield reason, *where, "threads", number
            homes[thread] = server.name
        for other in plan.servers:
            above = server.best_effort and not other.best_effort and server.core == other.core
            if above and server.priority <= other.priority:
                reason = f"best effort comes behind all others: write more than {other.priority}"
                yield reason, *where, "priority"


def _overlaps(plan: ChainPlan) -> Wrong:
    """Two servers of one core may overlap only when a priority says who runs, or by turns."""
    apart = plan.equal_priorities == "apart"
    for (_, one), (place, two) in combinations(enumerate(plan.servers) if apart else (), 2):
        if (one.core, one.priority) != (two.core, two.priority):
            continue
        for (number, slot), other in product(enumerate(two.slots), one.slots):
            if meet(slot, other):
                reason = f"the slot {slot_text(slot)} overlaps {slot_text(other)} of server"
                reason += f" {one.name!r} on core {one.core}: move one, or give one server another"
                yield f"{reason} priority", "servers", place, "slots", number


def _shaping_nodes(plan: ChainPlan) -> Wrong:
    output, nodes = plan.chain.output, shaping_nodes(plan)
    for place, node in enumerate(nodes, start=-1 if plan.shaping_node else 0):
        where = ("shaping_node",) if place < 0 else ("further_shaping_nodes", place)
        others, server = [one for one in nodes if one is not node], server_of(plan, node.thread)
        if any(node.name == other.name or node.output == other.output for other in others):
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
    """A gated asynchronous publisher must not stop, or be stopped by, its process."""
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
        worse = [s for s in plan.servers if s.core == server.core and s.priority > server.priority]
        for node, other, slot in product(nodes, worse, server.slots):
            runs_it = any(map(Thread(node=node).overlaps, other.threads))
            late = (max(slot[0], plan.evidence.min_latency_ns), slot[1])  # nothing comes before
            if runs_it and late[0] < late[1] and any(meet(late, one) for one in other.slots):
                reason = f"the publisher thread of {node} would out-rank its executor, which server"
                reason += f" {other.name!r} runs at priority {other.priority} in {slot_text(slot)},"
                reason += f" and spin for its lock: write a number above {other.priority}, or move"
                yield f"{reason} the slot", *where, "priority"
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
        found = "a gated publisher" if gated else plan.policy
        reason = "only a shaping node sees when an output comes, under the policy shaped, not"
        yield f"{reason} {found}: write at-once", "into_open_slot"
    latest = None if plan.adaptation is None else plan.adaptation.max_latency_ns
    for slot in publish_slots(plan)[-1:]:
        if latest is not None and slot[1] > latest:
            reason = f"{duration_text(latest)}, but the slot {slot_text(slot)} ends behind it"
            yield f"{reason}: write more", "adaptation", "max_latency"


def below_executors(servers: Sequence[Server]) -> tuple[Server, ...]:
    """The servers, with those of publishers' threads ranked below what may run at the same time,
    and those for best effort behind all others of their core.
    """

    def behind(server: Server, others: Iterable[Server]) -> Server:
        worse = (one.priority + 1 for one in others if one.core == server.core)
        return server.model_copy(update={"priority": max([server.priority, *worse])})

    publishing = [s for s in servers if any(t.role == "publisher" for t in s.threads)]
    usual = [one for one in servers if one not in publishing and not one.best_effort]
    ranked = []
    for one in servers:
        begins_ns = one.slots[0][0]
        below = (other for other in usual if other.slots[-1][1] > begins_ns)
        ranked.append(behind(one, below if one in publishing else ()))
    rest = [one for one in ranked if not one.best_effort]
    return tuple(behind(one, rest if one.best_effort else ()) for one in ranked)


def publisher_servers(plan: ChainPlan) -> Iterator[tuple[int, Server, list[str]]]:
    """Servers with publishers' threads: place in the plan, server, nodes of these threads."""
    for number, server in enumerate(plan.servers):
        nodes = [thread.node for thread in server.threads if thread.role == "publisher"]
        if nodes:
            yield number, server, nodes


def messages_waiting(plan: ChainPlan, server: Server) -> int:
    """How many messages may be handed over while a server is closed, in one stretch."""
    first, *_ = server.slots
    again = (first[0] + plan.cycle_ns, first[1])
    longest = max(after[0] - before[1] for before, after in pairwise([*server.slots, again]))
    return longest // plan.chain.period_ns + 1  # one where the stretch begins
