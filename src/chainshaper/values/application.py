"""What an application is: nodes, callbacks, topics and chains (paper, sections 2.1 and 2.3)."""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from chainshaper.values.durations import format_duration

INTERNAL_TOPICS = frozenset(("/parameter_events", "/rosout", "/clock", "/_chainshaper_rehearsal"))
"""Topics that every node, or every shaping node, has for itself: they connect no computation."""

_PARAMETERS = ("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters")
_STATES = ("change_state", "get_state", "get_available_states", "get_available_transitions")
INTERNAL_SERVICES = frozenset((*_PARAMETERS, *_STATES)) | {
    "get_type_description",
    "set_parameters",
    "set_parameters_atomically",
    "get_transition_graph",
}
"""The last parts of the names of services that every node, or lifecycle node, has for itself."""

REQUEST, RESPONSE = ":request", ":response"
"""Endings of a service's name: requests and responses are treated as messages on such topics."""
LOOP_END = ":end"
"""Ending of a node's name: the end of each instance of its named loop counts as a message there."""
MANAGER_WRITE = ":write"
"""Ending of a controller manager's name (ros2_control): that `write()` returned counts so, too."""
LOOP_ENDS = (LOOP_END, MANAGER_WRITE)
CallbackKind: TypeAlias = Literal["timer", "subscription", "service", "client", "loop", "unknown"]
"""What starts a callback.

"loop": a thread of the node's own, which sleeps in between (``handle`` is 0).

"unknown": its creation was not seen, since tracing started later; or only its publications were
seen, since a thread of the node's own makes them, of whose sleep no event tells (``handle`` is 0
then).
"""


def trigger_text(topic: str | None, period_ns: int | None, declared_ns: int | None = None) -> str:
    """Say what starts a callback: its topic, or ``every 100ms``; empty: not known.

    A timer that starts with another period than the declared one has both:
    ``every 50ms (declared 100ms)``.
    """
    if period_ns is None:
        return topic or ""
    return f"every {period_text(period_ns, declared_ns)}"


def period_text(period_ns: int, declared_ns: int | None) -> str:
    """Return a timer's period, with the declared one if that is another."""
    if declared_ns in (None, period_ns):
        return format_duration(period_ns)
    return f"{format_duration(period_ns)} (declared {format_duration(declared_ns)})"


@dataclass(frozen=True)
class Node:
    """A ROS 2 node: a name in a process. ``name`` includes the namespace (``/front/filter``).

    A node that was started again has its last process in ``pid``, and those before that in
    ``earlier_pids``.
    """

    name: str
    pid: int
    earlier_pids: tuple[int, ...] = ()

    @property
    def processes(self) -> tuple[int, ...]:
        """All of its processes, in order."""
        return (*self.earlier_pids, self.pid)


@dataclass(frozen=True)
class Callback:
    """A callback of a node."""

    id: int  # its number in the graph, from 0: the key in analysis tables
    kind: CallbackKind
    node: str
    pid: int
    handle: int  # its address in the traced process; other processes may have the same
    topic: str | None = None  # subscribed topic, or the service's name
    period_ns: int | None = None  # of a timer or a loop, as its starts show it
    symbol: str | None = None  # the registered function, demangled where possible
    publishes: tuple[str, ...] = ()  # topics on which it publishes, or another one for it
    passes_on: tuple[str, ...] = ()  # those of `publishes` that another callback writes for it
    in_turns: tuple[str, ...] = ()  # those that it or another writes, whichever has the last input
    earlier_pids: tuple[int, ...] = ()  # processes before `pid` of a node that was started again
    declared_ns: int | None = None  # the period with which the timer was created, always the same

    @property
    def processes(self) -> tuple[int, ...]:
        """All processes in which it ran, in order."""
        return (*self.earlier_pids, self.pid)

    @property
    def trigger(self) -> str | None:
        """The topic whose messages it takes; a service takes requests, a client responses."""
        ending = {"subscription": "", "service": REQUEST, "client": RESPONSE}.get(self.kind)
        return None if ending is None or self.topic is None else self.topic + ending

    @property
    def label(self) -> str:
        """A short text that tells callbacks apart: ``/node2 ← /t1`` or ``/node1 every 100ms``."""
        if self.kind == "timer":
            return f"{self.node} {trigger_text(None, self.period_ns or 0, self.declared_ns)}"
        if self.kind == "loop":
            return f"{self.node} loop {trigger_text(None, self.period_ns)}".rstrip()
        if self.kind == "unknown" and not self.handle:
            return f"{self.node} outside callbacks"
        if self.kind == "unknown":
            return f"{self.node} callback {self.handle:#x}"
        return f"{self.node} ← {self.topic}"


@dataclass(frozen=True)
class ApplicationGraph:
    """The paper's graph G: callbacks, connected where one publishes a topic that another takes.

    ``publishers`` and ``subscribers`` name the nodes of each topic, also of topics that no
    callback was seen to publish (a node may publish outside its callbacks).
    """

    nodes: tuple[Node, ...]
    callbacks: tuple[Callback, ...]
    publishers: dict[str, tuple[str, ...]] = field(default_factory=dict)
    subscribers: dict[str, tuple[str, ...]] = field(default_factory=dict)
    through: tuple[tuple[str, str], ...] = ()  # declared: messages of the first go into the second

    @property
    def topics(self) -> tuple[str, ...]:
        return tuple(sorted(self.publishers.keys() | self.subscribers.keys()))

    def label(self, callback: Callback) -> str:
        """Return the callback's label, with its process where two nodes of its name ran at once."""
        return f"{self.node_text(callback)}{callback.label.removeprefix(callback.node)}"

    def node_text(self, callback: Callback) -> str:
        """Return the node as a way point: ``/talker``, or ``/talker@4711`` of several at once."""
        pids = {namesake.pid for namesake in self.callbacks if namesake.node == callback.node}
        pids |= {namesake.pid for namesake in self.nodes if namesake.name == callback.node}
        return f"{callback.node}@{callback.pid}" if len(pids) > 1 else callback.node

    def path(self, chain: "Chain") -> list[Callback]:
        """Return the callbacks of a chain."""
        by_id = {callback.id: callback for callback in self.callbacks}
        return [by_id[number] for number in chain.callbacks]


@dataclass(frozen=True)
class Chain:
    """A computation chain: callbacks (ids in its graph) connected by topics (paper, section 2.3).

    ``callbacks[i]`` publishes ``topics[i]``, which ``callbacks[i + 1]`` subscribes to; the last
    topic is the chain's output. ``spec`` is how a person wrote it (``/t1../t5``).
    """

    spec: str
    callbacks: tuple[int, ...]
    topics: tuple[str, ...]
