"""Callback groups with a thread each, by the ids and in the file of callback_isolated_executor.

An id names the node and what the group holds, such as
``/front/filter@Subscription(/points)@Timer(100000000)``. There are four kinds of entries,
``Subscription(TOPIC)``, ``Service(NAME)``, ``Client(NAME)`` and ``Timer(PERIOD IN NS)``. Newer
versions sort them; earlier ones list subscriptions, services, clients and timers, each in the order
in which the node made them. The earliest still had ``@Waitable`` at the end, which later ones leave
out when they read. Agnocast's version has ``/node/*`` for all groups of a node.

The file (`callback_groups:`, `non_ros_threads:`) gives each group's thread its scheduling. For
classes without a priority, newer versions read ``nice``, earlier ones the nice value in
``priority``.

Upstream: callback_isolated_executor, cie_thread_configurator/src/util.cpp and
thread_configurator_node.cpp; agnocast, agnocast_cie_thread_configurator/src/thread_config.cpp.
"""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import yaml
from pydantic import ConfigDict, Field, model_validator

from chainshaper.values.application import INTERNAL_TOPICS, trigger_text
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import Part, read_model, wrong_value

ANNOUNCEMENTS = "/cie_thread_configurator/callback_group_info"
"""The topic on which a process says which thread runs which of its callback groups."""

Policy: TypeAlias = Literal[
    "SCHED_OTHER", "SCHED_BATCH", "SCHED_IDLE", "SCHED_FIFO", "SCHED_RR", "SCHED_DEADLINE"
]
_REAL_TIME = ("SCHED_FIFO", "SCHED_RR")
_RESERVATION = ("runtime", "period", "deadline")
_ENTRY = re.compile(r"(Subscription|Service|Client)\(([^()@]+)\)|Timer\((\d+)\)")
_FORM = "write it as /namespace/node@Subscription(/topic)@Timer(100000000)"


@dataclass(frozen=True)
class CallbackGroup:
    """A callback group of a node."""

    node: str
    entries: tuple[str, ...]  # such as ``Timer(100000000)``, in the order of its id
    every: bool = False  # all groups of the node, which Agnocast writes as ``/node/*``

    @property
    def id(self) -> str:
        return f"{self.node}/*" if self.every else "@".join((self.node, *self.entries))

    @property
    def triggers(self) -> tuple[str, ...]:
        """What starts its timers and subscriptions, as plans name them: topics, ``every 100ms``.

        Those that every node has are left out.
        """
        names = list[str]()
        for entry in self.entries:
            kind, _, value = entry.removesuffix(")").partition("(")
            if kind == "Timer":
                names.append(trigger_text(None, int(value)))
            elif kind == "Subscription" and value not in INTERNAL_TOPICS:
                names.append(value)
        return tuple(dict.fromkeys(names))

    @property
    def key(self) -> tuple[str, frozenset[tuple[str, int]], bool]:
        """What is equal for ids of one group, in whatever order they list its entries."""
        return self.node, frozenset(Counter(self.entries).items()), self.every

    def has(self, node: str, triggers: Iterable[str]) -> bool:
        """Whether a thread may be the group's that runs these callbacks of a node."""
        if node != self.node:
            return False
        return self.every or (bool(wanted := set(triggers)) and wanted <= set(self.triggers))


def sorted_group(node: str, entries: Iterable[str]) -> CallbackGroup:
    """Return a group of a node with its entries in the order of newer versions."""
    return CallbackGroup(node, tuple(sorted(entries)))


def parse_group_id(text: str) -> CallbackGroup:
    """Return the group that an id names. Raises ValueError: it is no such id."""
    node, *entries = text.split("@")
    while entries and entries[-1] == "Waitable":
        entries.pop()
    every = node.endswith("/*") and not entries
    node = node.removesuffix("/*") if every else node
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", node):
        raise ValueError(f"{text!r} is not the id of a callback group: {_FORM}")
    for entry in entries:
        if not _ENTRY.fullmatch(entry):
            raise ValueError(f"{entry!r} in {text!r} is no part of a callback group: {_FORM}")
    return CallbackGroup(node, tuple(entries), every)


class ThreadConfiguration(Part):
    """What the file gives to the thread of a callback group, or to a thread outside ROS 2."""

    model_config = ConfigDict(extra="allow")

    id: str | None = None
    name: str | None = None  # in place of `id`, of a thread outside ROS 2 in Agnocast's version
    domain_id: Annotated[int, Field(ge=0)] | None = None
    affinity: tuple[Annotated[int, Field(ge=0)], ...] | None = None  # None, empty: any core
    policy: Policy
    priority: int | None = None  # 1 to 99; of other classes, in earlier versions, the nice value
    nice: Annotated[int, Field(ge=-20, le=19)] | None = None
    # Of SCHED_DEADLINE, in ns.
    runtime: Annotated[int, Field(ge=1)] | None = None
    deadline: Annotated[int, Field(ge=1)] | None = None
    period: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> "ThreadConfiguration":
        if self.id is None and self.name is None:
            raise wrong_value("names no thread: add its id", "id")
        if self.policy in _REAL_TIME and not 1 <= (self.priority or 0) <= 99:
            raise wrong_value(f"{self.policy} needs a priority from 1 to 99", "priority")
        if self.policy == "SCHED_DEADLINE":
            for name in _RESERVATION:
                if getattr(self, name) is None:
                    raise wrong_value("SCHED_DEADLINE needs it, in ns: add it", name)
        elif self.policy not in _REAL_TIME and not -20 <= self.nice_value <= 19:
            raise wrong_value("a nice value is from -20 to 19: correct it", "priority")
        return self

    @property
    def nice_value(self) -> int:
        """The nice value of a class without priorities."""
        return self.nice if self.nice is not None else self.priority or 0

    @property
    def real_time_priority(self) -> int:
        """The priority of a real-time thread; 0: of all other threads."""
        return self.priority or 0 if self.policy in _REAL_TIME else 0

    @property
    def text(self) -> str:
        """For a person: ``SCHED_FIFO 87, cores 1, 2``."""
        words: list[str] = [self.policy]
        if self.policy == "SCHED_DEADLINE":
            words[0] += (
                f" {format_duration(self.runtime or 0)} of {format_duration(self.period or 0)}"
            )
        elif self.policy in _REAL_TIME:
            words[0] += f" {self.priority}"
        elif self.nice_value:
            words.append(f"nice {self.nice_value}")
        if self.affinity:
            words.append(f"cores {', '.join(map(str, self.affinity))}")
        return ", ".join(words)


class GroupConfiguration(Part):
    """A file of callback_isolated_executor's thread configurator.

    Sections that are not of threads (`hardware_info`, `rt_throttling`, `irqs`, …) are kept.
    """

    model_config = ConfigDict(extra="allow")

    callback_groups: tuple[ThreadConfiguration, ...] | None = ()
    non_ros_threads: tuple[ThreadConfiguration, ...] | None = ()

    @model_validator(mode="after")
    def _valid_ids(self) -> "GroupConfiguration":
        seen = set[tuple[int | None, object]]()
        for number, entry in enumerate(self.callback_groups or ()):
            try:
                key = (entry.domain_id, parse_group_id(entry.id or "").key)
            except ValueError as error:
                raise wrong_value(str(error), "callback_groups", number, "id") from error
            if key in seen:
                raise wrong_value("stands twice: leave one out", "callback_groups", number, "id")
            seen.add(key)
        return self

    @property
    def groups(self) -> tuple[tuple[CallbackGroup, ThreadConfiguration], ...]:
        """The callback groups with what each one's thread gets; those of whole nodes come last."""
        read = [(parse_group_id(entry.id or ""), entry) for entry in self.callback_groups or ()]
        return tuple(sorted(read, key=lambda pair: pair[0].every))

    def of_thread(
        self, callbacks: Iterable[tuple[str, str]]
    ) -> tuple[CallbackGroup, ThreadConfiguration] | None:
        """Return the group whose thread runs some callbacks (node, trigger); None: none is named.

        Where several groups may be meant, such as of timers of one period, none is returned.
        """
        of_nodes: dict[str, set[str]] = {}
        for node, trigger in callbacks:
            of_nodes.setdefault(node, set()).add(trigger)
        if len(of_nodes) != 1:
            return None
        ((node, triggers),) = of_nodes.items()
        fitting = [pair for pair in self.groups if pair[0].has(node, triggers)]
        exact = [pair for pair in fitting if not pair[0].every]
        chosen = exact or fitting
        return chosen[0] if len(chosen) == 1 else None


def read_group_configuration(path: str | Path) -> GroupConfiguration:
    """Read a configuration. Raises: as :func:`.read_model`."""
    made_by = "the configuration of callback_isolated_executor (`callback_groups:`)"
    configuration = read_model(path, GroupConfiguration, made_by=made_by)
    if "callback_groups" not in configuration.model_fields_set:
        raise InputError(f"{path}:1: callback_groups: is missing; such a file is {made_by}")
    return configuration


def group_configuration_text(configuration: GroupConfiguration, comment: str = "") -> str:
    """Return a configuration as YAML that their thread configurator reads."""
    values: dict[str, Any] = configuration.model_dump(mode="json", exclude_unset=True)
    for section in ("callback_groups", "non_ros_threads"):
        values[section] = values.get(section) or []
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=False, width=1_000_000)
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    return header + text
