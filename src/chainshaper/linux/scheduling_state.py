"""How a thread is scheduled, as a value that can be kept, compared and put back.

It has three **aspects**, which the kernel keeps and changes apart from each other: its class
(policy, priority and the flag that children start without it), its nice value, and its cores.
"""

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeAlias

from chainshaper.linux.threads import POLICIES, RESET_ON_FORK

__all__ = [
    "ASPECTS",
    "Aspect",
    "SchedulingClass",
    "SchedulingState",
    "set_state",
    "state_as_json",
    "state_from_json",
    "state_of",
    "state_text",
    "with_aspect",
]

Aspect: TypeAlias = Literal["scheduling_class", "nice", "cores"]
ASPECTS: tuple[Aspect, ...] = ("scheduling_class", "nice", "cores")


@dataclass(frozen=True)
class SchedulingClass:
    """Policy (a number of `sched(7)`), real-time priority, and whether children start without."""

    policy: int
    priority: int
    reset_on_fork: bool


@dataclass(frozen=True)
class SchedulingState:
    """All that the kernel keeps about how a thread is scheduled, SCHED_DEADLINE's numbers apart."""

    scheduling_class: SchedulingClass
    nice: int
    cores: tuple[int, ...]


def state_of(tid: int) -> SchedulingState:
    """How a thread is scheduled now.

    Raises:
        ProcessLookupError: it has ended.
    """
    policy = os.sched_getscheduler(tid)
    return SchedulingState(
        SchedulingClass(
            policy=policy & ~RESET_ON_FORK,
            priority=os.sched_getparam(tid).sched_priority,
            reset_on_fork=bool(policy & RESET_ON_FORK),
        ),
        nice=os.getpriority(os.PRIO_PROCESS, tid),
        cores=tuple(sorted(os.sched_getaffinity(tid))),
    )


def set_state(tid: int, target: SchedulingState, aspects: Iterable[Aspect]) -> None:
    """Give a thread these aspects of a state.

    The class goes first: on a core where a FIFO thread spins, a thread moved there as SCHED_OTHER
    would not run again.

    Raises:
        ProcessLookupError: it has ended.
        OSError: the kernel refuses.
    """
    for aspect in sorted(aspects, key=ASPECTS.index):
        if aspect == "scheduling_class":
            wanted = target.scheduling_class
            flag = RESET_ON_FORK if wanted.reset_on_fork else 0
            os.sched_setscheduler(tid, wanted.policy | flag, os.sched_param(wanted.priority))
        elif aspect == "nice":
            os.setpriority(os.PRIO_PROCESS, tid, target.nice)
        else:
            os.sched_setaffinity(tid, target.cores)


def with_aspect(state: SchedulingState, aspect: Aspect, source: SchedulingState) -> SchedulingState:
    """A state with one aspect taken from another."""
    values: dict[str, Any] = {aspect: getattr(source, aspect)}
    return replace(state, **values)


def state_as_json(state: SchedulingState) -> dict[str, Any]:
    """A state as plain data."""
    return asdict(state)


def state_from_json(values: dict[str, Any]) -> SchedulingState:
    """What :func:`state_as_json` made plain."""
    return SchedulingState(
        SchedulingClass(**values["scheduling_class"]), values["nice"], tuple(values["cores"])
    )


def state_text(state: SchedulingState) -> str:
    """A state for a person: ``SCHED_FIFO 87, nice 0, cores 1, 2``."""
    held = state.scheduling_class
    policy = POLICIES.get(held.policy, f"policy {held.policy}")
    priority = f" {held.priority}" if held.priority else ""
    return f"{policy}{priority}, nice {state.nice}, cores {', '.join(map(str, state.cores))}"
