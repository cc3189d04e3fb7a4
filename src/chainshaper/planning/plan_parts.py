"""What a plan is made of: the chain, the evidence, the margin, servers, shaping nodes, prediction.

Each part checks itself; what they must fit together is :mod:`chainshaper.planning.plan`'s. Slots
are half-open intervals ``(start, end)`` in nanoseconds after the start of a cycle.
"""

import re
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from chainshaper.gate.decision import Late
from chainshaper.values.durations import format_duration
from chainshaper.values.yaml_file import Duration, FullName, Part, PositiveDuration, wrong_value

__all__ = [
    "PER_CALLBACK",
    "BandPrediction",
    "ChainOfPlan",
    "Evidence",
    "Margin",
    "Modes",
    "Prediction",
    "Server",
    "ShapingNode",
    "Slot",
    "Thread",
    "slot_text",
]


def _node_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        raise ValueError(
            f"{value!r} is not a node's name: write letters, digits and underscores, no slash, no"
            " digit first"
        )
    return value


def _mode_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        raise ValueError(
            f"{value!r} is not a mode's name: write letters, digits and underscores, no digit first"
        )
    return value


ModeName = Annotated[str, AfterValidator(_mode_name)]

Slot: TypeAlias = tuple[Duration, Duration]
"""A time slot [start, end) of a cycle."""

PER_CALLBACK = ("server-per-callback", "let-per-callback")
"""Policies whose slots follow from the callbacks, so that an execution may span cycles."""


class ChainOfPlan(Part):
    """The chain that is planned for, as far as it is known.

    ``publisher`` is the node that publishes ``output``, the chain's last topic. A plan computed
    from bare latencies knows only the period; it can be studied but not carried out.
    ``output_depth`` is the history (keep last) of the output's writer, where it is known.
    """

    spec: str | None = None
    output: FullName | None = None
    publisher: FullName | None = None
    output_depth: Annotated[int, Field(ge=1)] | None = None
    period_ns: PositiveDuration


class Evidence(Part):
    """The measurements that the plan rests on: end-to-end latencies under high SCHED_FIFO.

    ``incomplete`` counts traversals without an end, ``disturbed`` those that a stall of the
    machine hit, ``utilisation`` is the share of its core that the chain's execution takes,
    ``longest_send_ns`` how long the output's asynchronous publisher took to send one message.
    The latencies are those of undisturbed cycles; ``max_of_all_ns`` is the longest of all cycles.
    ``lost_events`` counts what the tracer lost, if it lost anything.
    ``None`` is: not known.
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

    ``given`` by a person, ``measured``: it covers all cycles that were measured but a share, also
    those that the machine disturbed, for which ``stalls_ns`` of it are needed; either way
    ``overrun_probability`` is the share of outputs that will be late, at most, with 95 %
    confidence. Or ``derived`` from the tail of the latencies, for a probability smaller than the
    sample shows, with the confidence interval of the margin.
    """

    epsilon_ns: Duration
    source: Literal["given", "measured", "derived"] = "given"
    overrun_probability: Annotated[float, Field(gt=0, le=1)] | None = None
    stalls_ns: Duration = 0
    confidence_interval_ns: tuple[Duration, Duration] | None = None


class Thread(Part):
    """A thread of a node that runs inside a server: its executor, or its asynchronous publisher.

    DDS threads other than the publisher's are never gated (section 3.1), so they have no role.
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
        for number, (start, end) in enumerate(self.slots):
            if end <= start:
                raise wrong_value(
                    f"the slot {slot_text((start, end))} is empty: its end must come after its"
                    " start",
                    "slots",
                    number,
                )
        for number, (before, after) in enumerate(pairwise(self.slots), start=1):
            if after[0] < before[1]:
                raise wrong_value(
                    f"the slot {slot_text(after)} begins before {slot_text(before)} ends: write"
                    " a server's slots in ascending order, without overlap",
                    "slots",
                    number,
                )
        return self


class ShapingNode(Part):
    """The node that takes the chain's output from ``input`` and republishes it on ``output``.

    It publishes in the slots of the server that holds its thread. ``core`` and ``fifo_priority``
    are those of its executor; it sleeps until ``spin_ns`` before the slot and spins from there,
    and pauses for ``pause_ns`` after a publication so that delivery is not delayed by it.
    ``publisher`` is the node whose output it takes, of a node that stands elsewhere than behind
    the chain's own output (`chain.publisher`), where it is known. ``receivers`` are nodes that
    subscribe to the output: while the plan is in force their executors run under SCHED_FIFO below
    all servers, so that what comes in time is taken in time. ``depth`` is how many messages may
    wait in it; None: as many as the history of the output's publisher has room for, as far as that
    is known, and 10 at least. The histories of its subscribers do not count.
    """

    name: Annotated[str, AfterValidator(_node_name)]
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
    is ``default``. ``bands`` has the number of each mode's band, 1 for the slot that comes first of
    those that the shaping node publishes in. An output that is early for its mode's slot waits for
    it. ``late`` says what becomes of one that comes behind it: ``wait`` for the same slot of the
    next cycle, ``discard``, ``publish`` at once, or take the ``next-slot`` of the cycle.
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

    A band is represented by the end of its slot (section 4.1). The jitter is the widest
    distance of two outputs, from the start of the first slot to the end of the last.
    """

    mean_ns: Duration
    max_ns: Duration
    jitter_ns: Duration
    shares: tuple[Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)], ...] = ()


class BandPrediction(NamedTuple):
    """One latency band: its slot, its share of the cycles, and the jitter within it at most.

    An output of the band leaves somewhere in its slot, so the jitter is the slot's length.
    """

    start_ns: int
    end_ns: int
    share: float
    jitter_ns: int


def slot_text(slot: Slot) -> str:
    """A slot as people write it: ``[86ms, 87ms)``."""
    return f"[{format_duration(slot[0])}, {format_duration(slot[1])})"
