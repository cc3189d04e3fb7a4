"""The plan: which reservation servers, slots, threads and shaping nodes make a latency constant.

A plan is a value. It is computed from measured latencies (:mod:`chainshaper.planning.shaping`),
written as YAML that people edit (:mod:`chainshaper.planning.plan_file`), and carried out by
:mod:`chainshaper.enforcement`. Whoever holds a :class:`Plan` may rely on every rule checked
here, whichever way it came about.

Durations are integer nanoseconds, in fields that end in ``_ns``; in YAML the same keys stand
without the suffix and their values carry a unit (``period: 100ms``). Slots are half-open
intervals ``(start, end)`` in nanoseconds after the start of a cycle.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from chainshaper.gate.decision import Anchor, Messages, Overrun
from chainshaper.planning.plan_parts import (
    PER_CALLBACK,
    BandPrediction,
    ChainOfPlan,
    Evidence,
    Margin,
    Modes,
    Prediction,
    Server,
    ShapingNode,
    Slot,
    Thread,
    slot_text,
)
from chainshaper.planning.publisher_threads import check_publisher_threads
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback, Policy
from chainshaper.values.yaml_file import (
    Duration,
    Part,
    PositiveDuration,
    explanations,
    key_text,
    wrong_value,
)

__all__ = [
    "PER_CALLBACK",
    "BandPrediction",
    "ChainOfPlan",
    "Evidence",
    "Margin",
    "Modes",
    "Plan",
    "Prediction",
    "Server",
    "ShapingNode",
    "Slot",
    "Thread",
    "band_predictions",
    "output_server",
    "publish_slots",
    "publishing_servers",
    "revised",
    "server_of",
    "shaping_nodes",
    "wrong_values_refused",
]


class Plan(Part):
    """Servers and shaping nodes for one chain, with the evidence and the prediction.

    ``cycle_ns`` is the servers' cycle time: the chain's period, or a whole multiple of it. Where
    several chains share cores, this chain's cycles start ``offset_ns`` after the instant from
    which all of them count; slots count from the start of the chain's own cycle nevertheless.
    ``anchor`` says what starts a cycle for the shaping node: the stamp that each message carries
    from the chain's first callback, or the servers' own cycle. ``overrun`` says what becomes of
    an output that missed its last slot, ``messages`` which of several outputs of one cycle leave,
    and ``fallback`` what becomes of outputs while their shaping node is not there.
    ``shaping_node`` serves the chain's output; it is absent
    when the publisher's own thread is gated (asynchronous publication) or nothing is.
    ``further_shaping_nodes`` serve other sinks, or the topics inside a chain whose callbacks
    follow LET one by one. With ``modes`` the slot of an output depends on the mode of the system.
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
        check_publisher_threads(self)
        return self


def server_of(plan: Plan, thread: Thread) -> Server | None:
    """The server that a thread is assigned to, or None when it runs outside all servers."""
    return next((server for server in plan.servers if thread in server.threads), None)


def shaping_nodes(plan: Plan) -> list[ShapingNode]:
    """All shaping nodes of a plan, that of the chain's output first."""
    return [node for _, node in _placed_nodes(plan)]


def output_server(plan: Plan) -> Server | None:
    """The server in whose slots the chain's output is published; None without shaping.

    It is the one of the shaping node or, where the publisher is asynchronous, of the
    publisher's thread. A plan from bare latencies names no threads; its server ``output`` is
    the one meant.
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
    """All servers in whose slots something is published: the output, other sinks, inner topics.

    They hold shaping nodes' threads or publishers' threads; the others run the chain.
    """
    nodes = {node.thread for node in shaping_nodes(plan)}
    output = output_server(plan)
    return tuple(
        server
        for server in plan.servers
        if server is output
        or any(thread in nodes or thread.role == "publisher" for thread in server.threads)
    )


def revised(plan: Plan, **changes: object) -> Plan:
    """A copy of a plan with some fields replaced, checked like any other plan.

    Raises:
        InputError: the fields make no plan together.
    """
    values = {name: getattr(plan, name) for name in Plan.model_fields}
    with wrong_values_refused():
        return Plan.model_validate({**values, **changes})


@contextmanager
def wrong_values_refused(model: type[Part] | None = None) -> Iterator[None]:
    """Inside, a value that no plan may have ends in an InputError that names it.

    For code that builds plans, or a ``model`` that is a part of one, from what a caller gave.
    """
    try:
        yield
    except ValidationError as error:
        found = explanations(error, model or Plan)
        problems = [f"{key_text(where)}: {reason}" for where, reason in found]
        raise InputError("; ".join(problems)) from error


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
        if server.name in names:
            raise wrong_value(
                f"two servers are named {server.name!r}: rename one", "servers", number, "name"
            )
        names.add(server.name)
        for slot_number, slot in enumerate(server.slots):
            if slot[1] > plan.cycle_ns:
                raise wrong_value(
                    f"the slot {slot_text(slot)} ends after the cycle"
                    f" {format_duration(plan.cycle_ns)}: move it, or split it in two slots",
                    *("servers", number, "slots", slot_number),
                )
        for thread_number, thread in enumerate(server.threads):
            if thread in homes:
                raise wrong_value(
                    f"the {thread.role} of {thread.node} is already in server {homes[thread]!r}:"
                    " a thread belongs to one server, remove it from the other",
                    *("servers", number, "threads", thread_number),
                )
            homes[thread] = server.name


def _check_overlaps(plan: Plan) -> None:
    # Two servers of one core may overlap only when a priority says who runs.
    for (_, one), (number, two) in combinations(enumerate(plan.servers), 2):
        if (one.core, one.priority) != (two.core, two.priority):
            continue
        for slot_number, slot in enumerate(two.slots):
            for other in one.slots:
                if slot[0] < other[1] and other[0] < slot[1]:
                    raise wrong_value(
                        f"the slot {slot_text(slot)} overlaps {slot_text(other)} of server"
                        f" {one.name!r} on core {one.core} at the same priority {one.priority}:"
                        " move one of them, or give one server another priority",
                        *("servers", number, "slots", slot_number),
                    )


def _check_shaping_node(plan: Plan, node: ShapingNode, where: tuple[Any, ...]) -> None:
    others = [other for place, other in _placed_nodes(plan) if place != where]
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
            *where,
            "output",
        )
    server = server_of(plan, node.thread)
    if server is None:
        raise wrong_value(
            f"no server holds the shaping node's thread: add {{node: {node.thread.node}}} to the"
            " threads of the server whose slots it publishes in",
            *where,
            "name",
        )
    if server.core != node.core:
        raise wrong_value(
            f"core {node.core}, but its server {server.name!r} is on core {server.core}: make them"
            " the same",
            *where,
            "core",
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
