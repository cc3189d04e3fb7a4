"""A single-threaded executor with the semantics of ROS 2's.

The order in which a node's callbacks run is part of what is measured, so it follows rclcpp's
`SingleThreadedExecutor` (Casini et al., ECRTS 2019): wait until something is ready, take a
snapshot of all that is, then run it to the end: timers first, then subscriptions, each in the
order of registration and each at most once. What becomes ready meanwhile waits for the next
snapshot. A timer that missed whole periods fires once and keeps its phase.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic_ns
from typing import Any

from chainshaper.workload.dds import GuardCondition, Message, Subscription, WaitSet
from chainshaper.workload.event_log import EventLog

__all__ = ["Executor", "SubscriptionEntity", "Timer"]


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
