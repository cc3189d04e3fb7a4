"""What runs callbacks and sends messages in a node: executor, synchroniser, publisher thread.

**Executor.** The order in which a node's callbacks run is part of what is measured, so it follows
rclcpp's `SingleThreadedExecutor` (Casini et al., ECRTS 2019): wait until something is ready, take a
snapshot of all that is, then run it to the end: timers first, then subscriptions, each in the order
of registration and each at most once. What becomes ready meanwhile waits for the next snapshot. A
timer that missed whole periods fires once and keeps its phase.

**Synchroniser** (message_filters). Each input has a subscription and a callback of its own. The
callback that completes a set, of the oldest message of every input, computes and publishes; the
others only leave their message.

**Asynchronous publication.** As Fast DDS has it (paper, section 2.2): publishing puts the message
into its writer's history, with the source timestamp of that instant, and wakes the **publisher
thread** (``dds.asyn.…``), which sends for all asynchronous writers of the process. The history
keeps the last ``depth`` messages that are not sent yet; one that is older than the topic's lifespan
is not sent any more.

A reservation server may keep this thread from running while the executor goes on (section 3.2.1).
So what it waits for, it waits for in the kernel: without the interpreter's lock, and without any
lock of DDS. Woken while it is kept from running, it stops before it returns to user space, and
the executor, which only appends and wakes, never waits for it. Stopped in the midst of sending,
however, it holds both, and the process stands still: a publish slot has to be far longer than a
send (:mod:`chainshaper.planning.publication`).
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic_ns
from typing import Any, Generic, TypeAlias, TypeVar

from chainshaper.linux.scheduling import set_thread_name
from chainshaper.workload.dds import GuardCondition, Message, Subscription, WaitSet
from chainshaper.workload.event_log import EventLog, number_of

__all__ = [
    "AsynchronousWriter",
    "Executor",
    "Note",
    "PublisherThread",
    "SubscriptionEntity",
    "Synchroniser",
    "Timer",
    "noting_sends",
]


@dataclass
class Timer:
    """A timer: every ``period_ns`` from ``due_ns`` on (CLOCK_MONOTONIC) it runs ``callback``."""

    handle: int
    period_ns: int
    callback: Callable[[], None]
    due_ns: int = 0

    def call(self, now_ns: int) -> None:
        """Move on to the next expiry after ``now_ns``, as `rcl_timer_call` does."""
        self.due_ns += self.period_ns
        if self.due_ns < now_ns:
            self.due_ns += -(-(now_ns - self.due_ns) // self.period_ns) * self.period_ns


@dataclass(frozen=True)
class SubscriptionEntity:
    """A subscription and the callback that runs for each of its messages."""

    handle: int
    rmw_handle: int
    subscription: Subscription
    callback: Callable[[Message], None]


class Executor:
    """Runs the callbacks of one process on the calling thread."""

    def __init__(self, participant: Any, log: EventLog) -> None:
        self.timers: list[Timer] = []
        self.subscriptions: list[SubscriptionEntity] = []
        self.backlogs: list[Callable[[], bool]] = []
        self._wait_set = WaitSet(participant)
        # Never triggered: an empty wait set would return at once instead of waiting.
        self._guard = GuardCondition(participant)
        self._wait_set.attach(self._guard)
        self._wait_for_work = log.point("rclcpp_executor_wait_for_work")
        self._next_ready = log.point("rclcpp_executor_get_next_ready")
        self._execute = log.point("rclcpp_executor_execute")
        self._rmw_take = log.point("rmw_take")
        self._rcl_take = log.point("rcl_take")
        self._rclcpp_take = log.point("rclcpp_take")

    def add_subscription(self, entity: SubscriptionEntity) -> None:
        self.subscriptions.append(entity)
        self._wait_set.attach(entity.subscription.condition)

    def spin_until(self, stop_ns: int, last_timer_ns: int) -> None:
        """Wait and run until ``stop_ns`` of CLOCK_MONOTONIC; a running callback is finished.

        Timers expire up to ``last_timer_ns`` only, so that what they began can be completed. What
        a callback has taken beyond its own message, its backlog, is worked off first.
        """
        while (now := monotonic_ns()) < stop_ns:
            more = [work_off() for work_off in self.backlogs]
            due = [timer.due_ns for timer in self.timers if timer.due_ns <= last_timer_ns]
            timeout = 0 if any(more) else max(0, min([stop_ns, *due]) - now)
            self._wait_for_work(now, timeout)
            self._wait_set.wait(timeout)
            now = min(monotonic_ns(), last_timer_ns)
            timers = [timer for timer in self.timers if timer.due_ns <= now]
            subscriptions = [entity for entity in self.subscriptions if entity.subscription.ready()]
            for timer in timers:
                self._run_timer(timer)
            for entity in subscriptions:
                self._run_subscription(entity)

    def _run_timer(self, timer: Timer) -> None:
        now = monotonic_ns()
        self._next_ready(now)
        self._execute(now, timer.handle)
        timer.call(now)
        timer.callback()

    def _run_subscription(self, entity: SubscriptionEntity) -> None:
        now = monotonic_ns()
        self._next_ready(now)
        self._execute(now, entity.handle)
        message = entity.subscription.take()
        if message is None:
            self._rmw_take(monotonic_ns(), entity.rmw_handle, id(message), 0, 0)
            return
        self.record_take(entity.rmw_handle, message)
        entity.callback(message)

    def record_take(self, rmw_handle: int, message: Message) -> None:
        """Record that a message was taken for the callback that starts next."""
        now, address = monotonic_ns(), id(message)
        self._rmw_take(now, rmw_handle, address, message.source_timestamp, 1)
        self._rcl_take(now, address)
        self._rclcpp_take(now, address)


Input = TypeVar("Input")


class Synchroniser(Generic[Input]):
    """The messages that wait for their set, at most ``depths[i]`` of input i (the newest)."""

    def __init__(self, depths: Sequence[int]) -> None:
        self._waiting: list[deque[Input]] = [deque(maxlen=depth) for depth in depths]

    def add(self, number: int, message: Input) -> tuple[Input, ...]:
        """A message of an input; the set that is complete now, or nothing."""
        self._waiting[number].append(message)
        if not all(self._waiting):
            return ()
        return tuple(waiting.popleft() for waiting in self._waiting)


THREAD_NAME = "dds.asyn.0.1"  # Fast DDS's for user data

Note: TypeAlias = Callable[[int, int, str, int], None]
"""Records what became of a message: time, source timestamp, outcome, duration of sending (ns).

The outcomes are those of `asynchronous_send` in :mod:`chainshaper.values.events`.
"""


class AsynchronousWriter:
    """The history of one writer, between the executor and the publisher thread.

    ``write`` gives a message and its source timestamp to DDS. Taking and appending are single
    steps of the interpreter, so no lock is needed that somebody could be stopped with.
    """

    def __init__(
        self,
        write: Callable[[bytes, int], None],
        depth: int,
        lifespan_ns: int | None,
        note: Note,
    ) -> None:
        self._write = write
        self._depth = depth
        self._lifespan_ns = lifespan_ns
        self._note = note
        self._history: deque[tuple[bytes, int]] = deque()

    def keep(self, payload: bytes, source_timestamp: int) -> None:
        """Executor: put a message into the history; a full one loses its oldest (keep last)."""
        self._history.append((payload, source_timestamp))
        # Should the oldest be taken for sending just now, the one after it is lost: a message that
        # is being sent has its place in the history, as in DDS.
        if len(self._history) > self._depth and (oldest := self._oldest()) is not None:
            self._note(time.monotonic_ns(), oldest[1], "overwritten", 0)

    def send_next(self) -> None:
        """Publisher thread: send the oldest message, unless it has been overwritten or expired."""
        if (oldest := self._oldest()) is None:
            return
        payload, source_timestamp = oldest
        began = time.monotonic_ns()
        if self._lifespan_ns is not None and time.time_ns() - source_timestamp > self._lifespan_ns:
            self._note(began, source_timestamp, "expired", 0)
            return
        self._write(payload, source_timestamp)
        self._note(began, source_timestamp, "sent", time.monotonic_ns() - began)

    def _oldest(self) -> tuple[bytes, int] | None:
        try:
            return self._history.popleft()
        except IndexError:
            return None


class PublisherThread:
    """The one thread that sends for all asynchronous writers of this process."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[AsynchronousWriter] = queue.SimpleQueue()
        threading.Thread(target=self._send, daemon=True).start()

    def publish(self, writer: AsynchronousWriter, payload: bytes, source_timestamp: int) -> None:
        """Executor: hand a message over; never waits."""
        writer.keep(payload, source_timestamp)
        self._waiting.put(writer)

    def _send(self) -> None:
        set_thread_name(THREAD_NAME)
        while True:
            self._waiting.get().send_next()


def noting_sends(record: Callable[..., None], rmw_handle: int) -> Note:
    """What records the sends of one publisher, whichever thread they happen in."""

    def note(time_ns: int, source_timestamp: int, outcome: str, duration_ns: int) -> None:
        tid = threading.get_native_id()
        record(
            time_ns, tid, rmw_handle, source_timestamp, number_of("outcome", outcome), duration_ns
        )

    return note
