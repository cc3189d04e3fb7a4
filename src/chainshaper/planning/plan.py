"""The plan: which reservation servers, slots, threads and shaping nodes make a latency constant.

A plan is a value. It is computed from measured latencies (:mod:`chainshaper.planning.shaping`),
written as YAML that people edit (:mod:`chainshaper.planning.plan_file`), and carried out by the
back ends. Every :class:`Plan` obeys every rule checked here, whichever way it came about.

Durations are integer nanoseconds, in fields that end in ``_ns``; in YAML the same keys stand
without the suffix and their values carry a unit (``period: 100ms``). Slots are half-open intervals
``(start, end)`` in nanoseconds after the start of a cycle.

A server may stop the thread of an asynchronous publisher (design 1, section 3.2.1), which shares
locks with the rest of its process. With Fast DDS 2.14, three things turned out to be destructive:

* *a slot that is hardly longer than a send*: stopped in the midst of one, the thread has what
  every publisher and the executor need, until the slot opens again. 0.25 ms did that; the bound
  is four times as much, and four times the longest send where sends were measured.
* *a thread that out-ranks its executor*: the executor hands a message over under the writer's
  lock, for which the publisher thread spins. Above the executor on the same core, it never lets
  it give that lock back. Before the shortest latency measured nothing is handed over, so what
  happens until then is not looked at.
* *a history that is too shallow*: what is handed over while the thread may not run has to fit in.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations, pairwise, product
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from chainshaper.gate.decision import Anchor, Late, Messages, Overrun
from chainshaper.values.durations import format_duration
from chainshaper.values.plan_choices import Fallback, Policy
from chainshaper.values.yaml_file import (
    Duration,
    FullName,
    Part,
    PositiveDuration,
    wrong_value,
    wrong_values_refused,
)

SHORTEST_SLOT_NS = 1_000_000
"""Of an asynchronous publisher."""
SENDS_PER_SLOT = 4

PER_CALLBACK = ("server-per-callback", "let-per-callback")
"""Policies whose slots follow from the callbacks, so that an execution may span cycles."""


def _plain_name(what: str) -> AfterValidator:
    def check(value: str) -> str:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
            raise ValueError(
                f"{value!r} is not a {what}'s name: write letters, digits and underscores,"
                f" {'no slash, ' if what == 'node' else ''}no digit first"
            )
        return value

    return AfterValidator(check)


ModeName = Annotated[str, _plain_name("mode")]

Slot: TypeAlias = tuple[Duration, Duration]
"""A time slot [start, end) of a cycle."""


class ChainOfPlan(Part):
    """The chain that is planned for, as far as it is known.

    A plan from bare latencies knows only the period; it can be studied but not carried out.
    ``publisher`` is the node that publishes ``output``, ``output_depth`` its writer's history.
    """

    spec: str | None = None
    output: FullName | None = None
    publisher: FullName | None = None
    output_depth: Annotated[int, Field(ge=1)] | None = None
    period_ns: PositiveDuration


class Evidence(Part):
    """The measurements that the plan rests on: end-to-end latencies under high SCHED_FIFO.

    The latencies are those of undisturbed cycles; ``max_of_all_ns`` is the longest of all.
    ``incomplete`` counts traversals without an end, ``disturbed`` those that a stall of the machine
    hit; ``utilisation`` is the share of its core that the chain's execution takes,
    ``longest_send_ns`` is of the output's asynchronous publisher. ``None`` is: not known.
    """

    recording: str | None = None
    samples: Annotated[int, Field(ge=1)]
    min_latency_ns: Duration
    mean_latency_ns: Duration
    max_latency_ns: PositiveDuration
    max_of_all_ns: PositiveDuration | None = None
    incomplete: Annotated[int, Field(ge=0)] = 0
    disturbed: Annotated[int, Field(ge=0)] = 0
    realtime: bool | None = None
    longest_stall_ns: Duration | None = None
    utilisation: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    longest_send_ns: Duration | None = None
    lost_events: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> "Evidence":
        if not self.min_latency_ns <= self.mean_latency_ns <= self.max_latency_ns:
            raise wrong_value("min, mean and max latency must ascend: correct them", "mean_latency")
        return self


class Margin(Part):
    """How far the chain's slot reaches beyond the longest undisturbed latency (ε of eq. 1).

    ``given`` by a person; ``measured``: it covers all cycles but a share, also those that the
    machine disturbed, for which ``stalls_ns`` of it are needed; ``derived`` from the tail of the
    latencies, with its confidence interval. ``overrun_probability`` is the share of late outputs,
    at most, with 95 % confidence.
    """

    epsilon_ns: Duration
    source: Literal["given", "measured", "derived"] = "given"
    overrun_probability: Annotated[float, Field(gt=0, le=1)] | None = None
    stalls_ns: Duration = 0
    confidence_interval_ns: tuple[Duration, Duration] | None = None


class Thread(Part):
    """A thread of a node that runs inside a server: its executor, or its asynchronous publisher.

    Other DDS threads are never gated (section 3.1), so they have no role.
    """

    node: FullName
    role: Literal["executor", "publisher"] = "executor"


class Server(Part):
    """A table-driven reservation server (section 2.2.1): its threads run in its slots only.

    A smaller ``priority`` is better, which is LITMUS^RT's order.
    """

    name: Annotated[str, Field(min_length=1)]
    core: Annotated[int, Field(ge=0)]
    priority: Annotated[int, Field(ge=1)]
    slots: Annotated[tuple[Slot, ...], Field(min_length=1)]
    threads: tuple[Thread, ...] = ()

    @model_validator(mode="after")
    def _slots_ascend(self) -> "Server":
        for number, slot in enumerate(self.slots):
            reason = "" if slot[0] < slot[1] else "is empty: its end must come after its start"
            if number and slot[0] < (before := self.slots[number - 1])[1]:
                reason = reason or (
                    f"begins before {slot_text(before)} ends: write a server's slots in ascending"
                    " order, without overlap"
                )
            if reason:
                raise wrong_value(f"the slot {slot_text(slot)} {reason}", "slots", number)
        return self


class ShapingNode(Part):
    """The node that takes the chain's output from ``input`` and republishes it on ``output``.

    It publishes in the slots of the server that has its thread. It sleeps until ``spin_ns`` before
    the slot and spins from there, and pauses for ``pause_ns`` after a publication so that delivery
    is not delayed by it. ``publisher`` is the node whose output it takes, where that is not
    `chain.publisher`. While the plan is in force the executors of ``receivers``, which subscribe to
    the output, run under SCHED_FIFO below all servers. ``depth`` is how many messages may wait in
    it; None: as many as the history of the output's publisher has room for, as far as that is
    known, and 10 at least. The histories of its subscribers do not count.
    """

    name: Annotated[str, _plain_name("node")]
    input: FullName
    output: FullName
    publisher: FullName | None = None
    core: Annotated[int, Field(ge=0)]
    fifo_priority: Annotated[int, Field(ge=1, le=98)]
    spin_ns: Duration
    pause_ns: Duration
    receivers: tuple[FullName, ...] = ()
    depth: Annotated[int, Field(ge=1)] | None = None

    @property
    def thread(self) -> Thread:
        """The node's executor, as servers name it."""
        return Thread(node=f"/{self.name}")

    @model_validator(mode="after")
    def _two_topics(self) -> "ShapingNode":
        if self.input == self.output:
            raise wrong_value(
                f"the shaping node would feed itself: input and output are both {self.input};"
                f" let the chain publish on another topic, such as {self.output}_tmp",
                "input",
            )
        return self


class Modes(Part):
    """Which latency band the chain's output has in each mode of the system (sections 3.3, 6).

    The active mode's name is read from ``topic``, a ``std_msgs/msg/String``; until one is read it
    is ``default``. ``bands`` has the number of each mode's band, 1 for the first slot. An early
    output waits for its mode's slot. A late one waits for the same slot of the next cycle
    (``wait``), is discarded, leaves at once (``publish``), or takes the ``next-slot`` of the cycle.
    """

    topic: FullName
    default: ModeName
    bands: Annotated[dict[ModeName, Annotated[int, Field(ge=1)]], Field(min_length=1)]
    late: Late = "wait"

    @model_validator(mode="after")
    def _default_exists(self) -> "Modes":
        if self.default not in self.bands:
            raise wrong_value(
                f"the mode {self.default!r} has no band: write one of {', '.join(self.bands)}, or"
                " give it a band",
                "default",
            )
        return self


class Prediction(Part):
    """What the plan promises: end-to-end latency, and the share of cycles per latency band.

    A band is represented by the end of its slot (section 4.1). The jitter is the widest distance of
    two outputs, from the start of the first slot to the end of the last.
    """

    mean_ns: Duration
    max_ns: Duration
    jitter_ns: Duration
    shares: tuple[Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)], ...] = ()


class BandPrediction(NamedTuple):
    """One latency band: its slot, its share of the cycles, its jitter at most."""

    start_ns: int
    end_ns: int
    share: float
    jitter_ns: int


def slot_text(slot: Slot) -> str:
    """A slot as people write it: ``[86ms, 87ms)``."""
    return f"[{format_duration(slot[0])}, {format_duration(slot[1])})"


class Plan(Part):
    """Servers and shaping nodes for one chain, with the evidence and the prediction.

    ``cycle_ns`` is the servers' cycle time: the chain's period, or a whole multiple of it. This
    chain's cycles start ``offset_ns`` after the instant from which those of all chains count.
    ``anchor`` says what starts a cycle for the shaping node: the stamp that each message carries
    from the chain's first callback, or the servers' own cycle. ``overrun`` says what becomes of an
    output that missed its last slot, ``messages`` which of several outputs of one cycle leave,
    ``fallback`` what becomes of outputs while their shaping node is not there. ``shaping_node``
    serves the chain's output; it is absent when the publisher's own thread is gated or nothing is.
    ``further_shaping_nodes`` serve other sinks, or the topics inside a chain whose callbacks follow
    LET one by one.
    """

    format: Literal[1] = 1
    chain: ChainOfPlan
    evidence: Evidence
    margin: Margin
    policy: Policy
    cycle_ns: PositiveDuration
    offset_ns: Duration = 0
    anchor: Anchor = "stamp"
    overrun: Overrun = "wait"
    messages: Messages = "all-in-order"
    fallback: Fallback = "bypass"
    servers: Annotated[tuple[Server, ...], Field(min_length=1)]
    shaping_node: ShapingNode | None = None
    further_shaping_nodes: tuple[ShapingNode, ...] = ()
    modes: Modes | None = None
    predicted: Prediction

    @model_validator(mode="after")
    def _consistent(self) -> "Plan":
        _check_cycle(self)
        _check_servers(self)
        _check_overlaps(self)
        for where, node in _placed_nodes(self):
            _check_shaping_node(self, node, where)
        _check_modes(self)
        _check_publisher_threads(self)
        return self


def server_of(plan: Plan, thread: Thread) -> Server | None:
    """The server that a thread is assigned to, or None when it runs outside all servers."""
    return next((server for server in plan.servers if thread in server.threads), None)


def shaping_nodes(plan: Plan) -> list[ShapingNode]:
    """All shaping nodes of a plan, that of the chain's output first."""
    return [node for _, node in _placed_nodes(plan)]


def output_server(plan: Plan) -> Server | None:
    """The server in whose slots the chain's output is published; None without shaping.

    It has the thread of the shaping node or of the asynchronous publisher. A plan from bare
    latencies names no threads; its server ``output`` is the one meant.
    """
    server = None
    if plan.shaping_node is not None:
        server = server_of(plan, plan.shaping_node.thread)
    elif plan.chain.publisher is not None:
        server = server_of(plan, Thread(node=plan.chain.publisher, role="publisher"))
    return server or next((other for other in plan.servers if other.name == "output"), None)


def publish_slots(plan: Plan) -> tuple[Slot, ...]:
    """The slots of :func:`output_server`, ascending; none without shaping."""
    return server.slots if (server := output_server(plan)) else ()


def band_predictions(plan: Plan) -> tuple[BandPrediction, ...]:
    """The prediction band by band; none where nothing is shaped, or slots were edited in number.

    Slots count from the start of a cycle, under LET one after the execution's own.
    """
    slots, shares = publish_slots(plan), plan.predicted.shares
    if len(slots) != len(shares):
        return ()
    return tuple(
        BandPrediction(start, end, share, end - start)
        for (start, end), share in zip(slots, shares, strict=True)
    )


def publishing_servers(plan: Plan) -> tuple[Server, ...]:
    """All servers in whose slots something is published: the output, other sinks, inner topics."""
    nodes = {node.thread for node in shaping_nodes(plan)}
    output = output_server(plan)
    return tuple(
        server
        for server in plan.servers
        if server is output
        or any(thread in nodes or thread.role == "publisher" for thread in server.threads)
    )


def with_slots(
    servers: Iterable[Server], slots: Mapping[str, Sequence[Slot]]
) -> tuple[Server, ...]:
    """The servers, of which those of these names have other slots."""
    return tuple(
        server.model_copy(update={"slots": tuple(slots.get(server.name, server.slots))})
        for server in servers
    )


def until(server: Server, end_ns: int) -> tuple[Slot, ...]:
    """A server's slots, of which the last ends at another instant."""
    return (*server.slots[:-1], (server.slots[-1][0], end_ns))


def revised(plan: Plan, **changes: object) -> Plan:
    """A copy of a plan with some fields replaced, checked like any other plan.

    Raises:
        InputError: the fields make no plan together.
    """
    values = {name: getattr(plan, name) for name in Plan.model_fields}
    with wrong_values_refused(Plan):
        return Plan.model_validate({**values, **changes})


def _placed_nodes(plan: Plan) -> Iterator[tuple[tuple[str | int, ...], ShapingNode]]:
    """The shaping nodes with their places in the file."""
    if plan.shaping_node is not None:
        yield ("shaping_node",), plan.shaping_node
    for number, node in enumerate(plan.further_shaping_nodes):
        yield ("further_shaping_nodes", number), node


def _check_cycle(plan: Plan) -> None:
    cycle, period, longest = plan.cycle_ns, plan.chain.period_ns, plan.evidence.max_latency_ns
    if cycle % period:
        raise wrong_value(
            f"the cycle {format_duration(cycle)} is no multiple of the chain's period"
            f" {format_duration(period)}: make it the period, or a whole multiple",
            "cycle",
        )
    if cycle <= longest and plan.policy not in PER_CALLBACK:
        raise wrong_value(
            f"the cycle {format_duration(cycle)} is not longer than the longest latency measured,"
            f" {format_duration(longest)}: plan with a longer period or a shorter chain",
            "cycle",
        )


def _check_servers(plan: Plan) -> None:
    names: set[str] = set()
    homes: dict[Thread, str] = {}
    for number, server in enumerate(plan.servers):
        where = ("servers", number)
        if server.name in names:
            raise wrong_value(f"two servers are named {server.name!r}: rename one", *where, "name")
        names.add(server.name)
        for slot_number, slot in enumerate(server.slots):
            if slot[1] > plan.cycle_ns:
                raise wrong_value(
                    f"the slot {slot_text(slot)} ends after the cycle"
                    f" {format_duration(plan.cycle_ns)}: move it, or split it in two slots",
                    *(*where, "slots", slot_number),
                )
        for thread_number, thread in enumerate(server.threads):
            if thread in homes:
                raise wrong_value(
                    f"the {thread.role} of {thread.node} is already in server {homes[thread]!r}:"
                    " a thread belongs to one server, remove it from the other",
                    *(*where, "threads", thread_number),
                )
            homes[thread] = server.name


def _check_overlaps(plan: Plan) -> None:
    # Two servers of one core may overlap only when a priority says who runs.
    for (_, one), (number, two) in combinations(enumerate(plan.servers), 2):
        if (one.core, one.priority) != (two.core, two.priority):
            continue
        for (slot_number, slot), other in product(enumerate(two.slots), one.slots):
            if slot[0] < other[1] and other[0] < slot[1]:
                raise wrong_value(
                    f"the slot {slot_text(slot)} overlaps {slot_text(other)} of server"
                    f" {one.name!r} on core {one.core} at the same priority {one.priority}:"
                    " move one of them, or give one server another priority",
                    *("servers", number, "slots", slot_number),
                )


def _check_shaping_node(plan: Plan, node: ShapingNode, where: tuple[Any, ...]) -> None:
    others = [other for place, other in _placed_nodes(plan) if place != where]
    server = server_of(plan, node.thread)
    if any(node.name == other.name or node.output == other.output for other in others):
        raise wrong_value(
            f"another shaping node has the name {node.name} or the output {node.output} too:"
            " both must be its own",
            *where,
        )
    if where == ("shaping_node",) and plan.chain.output not in (None, node.output):
        raise wrong_value(
            f"publishes {node.output}, but the chain's output is {plan.chain.output}: make them"
            " the same",
            *(*where, "output"),
        )
    if server is None:
        raise wrong_value(
            f"no server holds the shaping node's thread: add {{node: {node.thread.node}}} to the"
            " threads of the server whose slots it publishes in",
            *(*where, "name"),
        )
    if server.core != node.core:
        raise wrong_value(
            f"core {node.core}, but its server {server.name!r} is on core {server.core}: make them"
            " the same",
            *(*where, "core"),
        )


def _check_modes(plan: Plan) -> None:
    if plan.modes is None:
        return
    if plan.shaping_node is None:
        raise wrong_value(
            "only a shaping node knows the mode of the system, and the plan has no `shaping_node`:"
            " remove the modes, or plan with synchronous publication",
            "modes",
        )
    if plan.modes.topic in (plan.shaping_node.input, plan.shaping_node.output):
        raise wrong_value(
            f"{plan.modes.topic} carries the chain's output: name the topic on which the mode is"
            " published",
            *("modes", "topic"),
        )
    slots = len(publish_slots(plan))
    for mode, band in plan.modes.bands.items():
        if band > slots:
            raise wrong_value(
                f"the band {band}, but the shaping node publishes in {slots} slots: write a number"
                f" from 1 to {slots}, or add a slot",
                *("modes", "bands", mode),
            )


def _check_publisher_threads(plan: Plan) -> None:
    """Refuse a gated asynchronous publisher that would stop, or be stopped by, its process."""
    for number, server, nodes in publisher_servers(plan):
        _check_slots(plan, number, server)
        for node in nodes:
            _check_rank(plan, number, server, node)
        if plan.overrun == "publish" and plan.policy not in ("shaped", "one-long-slot"):
            raise wrong_value(
                f"under {plan.policy} an output of an asynchronous publisher that comes in its own"
                " cycle looks like an overrun of the one before: write wait or discard, or"
                " plan with --publication synchronous",
                "overrun",
            )
        depth = plan.chain.output_depth
        if depth is not None and plan.chain.publisher in nodes:
            waiting = messages_waiting(plan, server)
            if depth < waiting:
                raise wrong_value(
                    f"a history of {depth} is too shallow: while the publisher's thread may not"
                    f" run, {waiting} messages are handed over, and the oldest would be lost; give"
                    f" {plan.chain.output or 'the output'} a depth of {waiting + 1}, or the server"
                    f" {server.name!r} more slots",
                    *("chain", "output_depth"),
                )


def below_executors(servers: Sequence[Server]) -> tuple[Server, ...]:
    """The servers, with those of publishers' threads ranked below what may run at the same time."""
    publishing = [
        server for server in servers if any(t.role == "publisher" for t in server.threads)
    ]
    ranked = []
    for server in servers:
        below = [
            other.priority + 1
            for other in servers
            if server in publishing and other not in publishing
            if other.core == server.core and other.slots[-1][1] > server.slots[0][0]
        ]
        priority = max([server.priority, *below])
        ranked.append(server.model_copy(update={"priority": priority}))
    return tuple(ranked)


def publisher_servers(plan: Plan) -> Iterator[tuple[int, Server, list[str]]]:
    """Servers that hold publishers' threads: place in the plan, server, nodes of these threads."""
    for number, server in enumerate(plan.servers):
        nodes = [thread.node for thread in server.threads if thread.role == "publisher"]
        if nodes:
            yield number, server, nodes


def messages_waiting(plan: Plan, server: Server) -> int:
    """How many messages may be handed over while a server is closed, in one stretch.

    One per period of the chain, and one more for where the stretch begins.
    """
    (first, _), (_, last) = server.slots[0], server.slots[-1]
    closed = [after[0] - before[1] for before, after in pairwise(server.slots)]
    longest = max([*closed, plan.cycle_ns + first - last])
    return longest // plan.chain.period_ns + 1


def _check_slots(plan: Plan, number: int, server: Server) -> None:
    measured = plan.evidence.longest_send_ns
    shortest = max(SHORTEST_SLOT_NS, SENDS_PER_SLOT * (measured or 0))
    for slot_number, slot in enumerate(server.slots):
        if slot[1] - slot[0] < shortest:
            sends = "" if measured is None else f" (the longest took {format_duration(measured)})"
            raise wrong_value(
                f"the slot {slot_text(slot)} is too short for an asynchronous publisher: stopped"
                f" in the midst of a send{sends}, its thread would block the whole process; make"
                f" it {format_duration(shortest)} or longer (--publish-slot)",
                *("servers", number, "slots", slot_number),
            )


def _check_rank(plan: Plan, number: int, server: Server, node: str) -> None:
    """Nowhere may the thread run at a better priority than its node's executor could then."""
    for other in plan.servers:
        executes = any(t.node == node and t.role == "executor" for t in other.threads)
        if not executes or other.core != server.core or other.priority <= server.priority:
            continue
        for slot in server.slots:
            since = max(slot[0], plan.evidence.min_latency_ns)
            if any(max(since, start) < min(slot[1], end) for start, end in other.slots):
                raise wrong_value(
                    f"the publisher thread of {node} would out-rank its executor, which server"
                    f" {other.name!r} runs at priority {other.priority} on the same core in"
                    f" {slot_text(slot)}: spinning for a lock that the executor holds, it would"
                    f" never let it go on; write a number above {other.priority}, or move the slot"
                    " behind the executor's",
                    *("servers", number, "priority"),
                )
