"""Read and set how threads are scheduled, and what this process is permitted.

A thread's scheduling has three **aspects**, which the kernel changes one by one: class (policy,
priority, and whether children start without them), nice value, cores.
"""

import ctypes
import gc
import os
import signal
import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

from chainshaper.linux.threads import POLICIES, RESET_ON_FORK, RunningThread
from chainshaper.values.errors import OperationError, PlatformError

Aspect: TypeAlias = Literal["scheduling_class", "nice", "cores"]
ASPECTS: tuple[Aspect, ...] = ("scheduling_class", "nice", "cores")

_libc = ctypes.CDLL(None, use_errno=True)
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_THROTTLE = "/proc/sys/kernel/sched_rt_{}_us"


@dataclass(frozen=True)
class SchedulingRequest:
    """The class and the cores that a thread is to get; None: what it has."""

    priority: int | None  # 0: SCHED_OTHER
    cores: tuple[int, ...] | None
    takes_turns: bool = False  # SCHED_RR in place of SCHED_FIFO

    @property
    def policy(self) -> int:
        if self.priority == 0:
            return os.SCHED_OTHER
        return os.SCHED_RR if self.takes_turns else os.SCHED_FIFO


@dataclass(frozen=True)
class SchedulingClass:
    """A thread's scheduling class, with its real-time priority."""

    policy: int  # a number of `sched(7)`
    priority: int  # 0 where the policy has none
    reset_on_fork: bool  # whether children start as SCHED_OTHER


@dataclass(frozen=True)
class SchedulingState:
    """How a thread is scheduled, without the parameters of SCHED_DEADLINE."""

    scheduling_class: SchedulingClass
    nice: int
    cores: tuple[int, ...]

    @property
    def text(self) -> str:
        """For a person: ``SCHED_FIFO 87, nice 0, cores 1, 2``."""
        scheduling_class = self.scheduling_class
        policy = POLICIES.get(scheduling_class.policy, f"policy {scheduling_class.policy}")
        priority = f" {scheduling_class.priority}" if scheduling_class.priority else ""
        return f"{policy}{priority}, nice {self.nice}, cores {', '.join(map(str, self.cores))}"


def state_of(tid: int) -> SchedulingState:
    """Return how a thread is scheduled now. Raises ProcessLookupError: it has ended."""
    policy, priority = os.sched_getscheduler(tid), os.sched_getparam(tid).sched_priority
    resets = bool(policy & RESET_ON_FORK)
    scheduling_class = SchedulingClass(policy & ~RESET_ON_FORK, priority, resets)
    nice = os.getpriority(os.PRIO_PROCESS, tid)
    return SchedulingState(scheduling_class, nice, tuple(sorted(os.sched_getaffinity(tid))))


def set_state(tid: int, target: SchedulingState) -> None:
    """Give a thread a state, by changing the aspects in which it differs.

    The class comes first: as SCHED_OTHER, a thread would not run any more on a core where a
    SCHED_FIFO thread spins. Raises OSError: it has ended (ProcessLookupError), or the kernel
    refuses.
    """
    for aspect in different_aspects(state_of(tid), target):
        if aspect == "scheduling_class":
            wanted = target.scheduling_class
            flag = RESET_ON_FORK if wanted.reset_on_fork else 0
            os.sched_setscheduler(tid, wanted.policy | flag, os.sched_param(wanted.priority))
        elif aspect == "nice":
            os.setpriority(os.PRIO_PROCESS, tid, target.nice)
        else:
            os.sched_setaffinity(tid, target.cores)


def after_wish(now: SchedulingState, wanted: SchedulingRequest) -> SchedulingState:
    """Return a thread's state after a request; what the request leaves open stays as it is."""
    if wanted.priority is not None:
        scheduling_class = replace(
            now.scheduling_class, policy=wanted.policy, priority=wanted.priority
        )
        now = replace(now, scheduling_class=scheduling_class)
    return now if wanted.cores is None else replace(now, cores=tuple(sorted(wanted.cores)))


def different_aspects(first: SchedulingState, second: SchedulingState) -> list[Aspect]:
    """Return the aspects in which two states differ, the class first."""
    return [aspect for aspect in ASPECTS if getattr(first, aspect) != getattr(second, aspect)]


def with_aspect(state: SchedulingState, aspect: Aspect, source: SchedulingState) -> SchedulingState:
    """Return a state with one aspect taken from a ``source``."""
    values: dict[str, Any] = {aspect: getattr(source, aspect)}
    return replace(state, **values)


def state_from_json(values: dict[str, Any]) -> SchedulingState:
    """Make a state of what `dataclasses.asdict` made of it."""
    scheduling_class = SchedulingClass(**values["scheduling_class"])
    return SchedulingState(scheduling_class, values["nice"], tuple(values["cores"]))


def apply_scheduling(thread: RunningThread, wanted: SchedulingRequest) -> None:
    """Give a running thread class and cores. Raises OperationError: the kernel refuses."""
    try:
        set_state(thread.tid, after_wish(state_of(thread.tid), wanted))
    except ProcessLookupError:
        return
    except OSError as error:
        asked = f"priority {wanted.priority} on cores {wanted.cores}: {error.strerror}"
        raise OperationError(f"{thread.text}: the kernel refuses {asked}") from error


def become_fifo(priority: int) -> bool:
    """Put the calling thread under SCHED_FIFO; return False if that is not permitted."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False


def may_use_fifo() -> bool:
    """Whether SCHED_FIFO is permitted; a thread that ends at once asks for it."""
    answers: list[bool] = []
    thread = threading.Thread(target=lambda: answers.append(become_fifo(1)))
    thread.start()
    thread.join()
    return answers == [True]


def available_cores() -> tuple[int, ...]:
    """Return the cores that the calling thread may use, ascending."""
    return tuple(sorted(os.sched_getaffinity(0)))


def check_cores(cores: dict[int, str]) -> None:
    """Check that cores are available; each is given with what asks for it.

    Raises PlatformError: one is not.
    """
    available = available_cores()
    for core in sorted(cores.keys() - set(available)):
        raise PlatformError(
            f"core {core}, which {cores[core]} asks for, is not available: this process may use "
            f"{', '.join(map(str, available))}; name one of those"
        )


def lock_memory() -> bool:
    """Lock all pages of this process in memory, now and later; return False if not permitted."""
    return bool(_libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0)


def stop_garbage_collection() -> None:
    """Stop garbage collection for good, since a full one pauses the process for milliseconds."""
    gc.collect()
    gc.freeze()
    gc.disable()


def signalled_with_parent(parent_pid: int, number: signal.Signals) -> None:
    """Have the kernel send this process a signal when its parent ends, however that happens."""
    _libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
    if os.getppid() != parent_pid:  # it had ended before the kernel was asked
        os.kill(os.getpid(), number)


def set_thread_name(name: str) -> None:
    """Name the calling thread as `ps` and /proc show it (15 bytes at most)."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def throttle_fraction() -> float:
    """Return the share of a core that real-time threads may use; 1.0: there is no limit."""
    try:
        runtime = int(Path(_THROTTLE.format("runtime")).read_bytes())
        period = int(Path(_THROTTLE.format("period")).read_bytes())
    except (OSError, ValueError):
        return 1.0
    return 1.0 if runtime < 0 else runtime / period
