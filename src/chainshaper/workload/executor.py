"""What runs in a node: executor, synchroniser, publisher thread, and what callbacks do.

**Executor.** As rclcpp's `SingleThreadedExecutor` (Casini et al., ECRTS 2019): wait until something
is ready, take a snapshot of all that is, then run it to the end: timers first, then subscriptions,
each in the order of registration and each at most once. What becomes ready meanwhile waits for the
next snapshot. A timer that missed whole periods fires once and keeps its phase.

With several threads it is as rclcpp's `MultiThreadedExecutor` (Jazzy): one of them at a time takes
the next of the snapshot, or waits if none is left; the others wait for their turn. While a callback
of a mutually exclusive group runs, the others are no part of a snapshot, and when it is done, the
thread that waits looks again.

**Synchroniser** (message_filters). Each input has a subscription and a callback of its own. The
callback that completes a set, of the oldest message of every input, computes and publishes; the
others only leave their message.

**Asynchronous publication.** As Fast DDS has it (paper, section 2.2): publishing puts the message
into its writer's history, with the source timestamp of that instant, and wakes the **publisher
thread** (``dds.asyn.…``), which sends for all asynchronous writers of the process.

A reservation server may stop this thread while the executor goes on (section 3.2.1). So it waits
in the kernel, without the interpreter's lock or one of DDS: woken while its server is closed, it
stops before it returns to user space, and the executor, which only appends and wakes, never waits
for it. Stopped in the midst of sending, however, it has both locks, and the process stands still:
a publish slot has to be far longer than a send (:mod:`chainshaper.planning.overruns`).

**Work.** A callback spends its described time, or calls the function that it ``computes:`` with
the serialized messages that it is for (none for a timer, the whole set for a synchronising
callback). The function returns the serialized message to publish on every topic of the callback,
or None: nothing then. The stamp of the header, from which gates count, is the function's to pass on
(:func:`~chainshaper.workload.dds.data_of` and :func:`~chainshaper.workload.dds.data_message` open
and make messages).
"""

import importlib
import os
import queue
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from time import monotonic_ns
from typing import Any, Generic, TypeAlias, TypeVar

from chainshaper.linux.own_processes import named_folders
from chainshaper.linux.scheduling import set_thread_name
from chainshaper.robot.serialized import origin_of
from chainshaper.values.files import why_distrusted
from chainshaper.workload import dds
from chainshaper.workload.dds import Message, Subscription
from chainshaper.workload.event_log import EventLog
from chainshaper.workload.execution import ExecutionTimes, spend
from chainshaper.workload.launcher import WORKER_NAME


@dataclass
class Timer:
    """A timer: every ``period_ns`` from ``due_ns`` on (CLOCK_MONOTONIC) it runs ``callback``."""

    handle: int
    period_ns: int
    callback: Callable[[], None]
    due_ns: int = 0
    group: str | None = None  # that it is alone in

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
    group: str | None = None  # that it is alone in


Entity: TypeAlias = Timer | SubscriptionEntity

IDLE_NS = 500_000_000  # between looks of an executor with nothing to do whether it is to end


class NodeExecutor:
    """Runs the callbacks of one process on the calling thread, and on ``threads`` − 1 others.

    Once ``over``, it ends when it next looks.
    """

    def __init__(self, participant: Any, log: EventLog, threads: int = 1) -> None:
        self.timers: list[Timer] = []
        self.subscriptions: list[SubscriptionEntity] = []
        self.backlogs: list[Callable[[], bool]] = []
        self._wait_set = dds.WaitSet(participant)
        # Never triggered: an empty wait set would return at once instead of waiting.
        self._guard = dds.GuardCondition(participant)
        self._wait_set.attach(self._guard)
        self._wait_for_work = log.point("rclcpp_executor_wait_for_work")
        self._execute, self._take = log.point("execute"), log.point("take")
        self.over = False
        self._turn = threading.Lock()
        self._snapshot: deque[Entity] = deque()
        self._busy: set[str] = set()  # groups
        self._begin: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
        self._others: list[threading.Thread] = []
        named = threading.Semaphore(0)
        for _ in range(1, threads):  # they exist before they run: their priorities have to be set
            other = threading.Thread(target=self._join_in, args=(named,), daemon=True)
            other.start()
            named.acquire()
            self._others.append(other)

    def add_subscription(self, entity: SubscriptionEntity) -> None:
        self.subscriptions.append(entity)
        self._wait_set.attach(entity.subscription.condition)

    def spin_until(self, stop_ns: int, last_timer_ns: int) -> None:
        """Wait and run until ``stop_ns`` of CLOCK_MONOTONIC; a running callback is finished.

        Timers expire up to ``last_timer_ns``, so that what they began can be completed. Backlogs,
        what callbacks have taken beyond their own message, are worked off first.
        """
        for _ in self._others:
            self._begin.put((stop_ns, last_timer_ns))
        self._spin(stop_ns, last_timer_ns)
        for other in self._others:
            other.join()

    def _join_in(self, named: threading.Semaphore) -> None:
        set_thread_name(WORKER_NAME)
        named.release()
        try:
            self._spin(*self._begin.get())
        except BaseException as error:  # a thread would end alone, and its group stay busy
            _end_process(error.code if isinstance(error, SystemExit) else traceback.format_exc())

    def _spin(self, stop_ns: int, last_timer_ns: int) -> None:
        while (entity := self._next(stop_ns, last_timer_ns)) is not None:
            if isinstance(entity, Timer):
                entity.callback()
            elif (message := entity.subscription.take()) is None:
                self._take(monotonic_ns(), entity.rmw_handle, id(message), 0, 0)
            else:
                self.record_take(entity.rmw_handle, message)
                entity.callback(message)
            if entity.group is not None:
                self._busy.discard(entity.group)
                self._guard.set(True)

    def _next(self, stop_ns: int, last_timer_ns: int) -> Entity | None:
        """What this thread executes next, waited for; None at the end."""
        with self._turn:
            while True:
                while self._snapshot:
                    entity = self._snapshot.popleft()
                    if entity.group not in self._busy:
                        now = monotonic_ns()
                        self._execute(now, entity.handle)
                        if isinstance(entity, Timer):
                            entity.call(now)
                        if entity.group is not None:
                            self._busy.add(entity.group)
                        return entity
                if monotonic_ns() >= stop_ns or self.over:
                    return None
                self._wait(stop_ns, last_timer_ns)

    def _wait(self, stop_ns: int, last_timer_ns: int) -> None:
        """Wait until something is ready, or a group is free again, and take a snapshot."""
        more, now = [work_off() for work_off in self.backlogs], monotonic_ns()
        free = [timer for timer in self.timers if timer.group not in self._busy]
        due = [timer.due_ns for timer in free if timer.due_ns <= last_timer_ns]
        timeout = 0 if any(more) else max(0, min([stop_ns, now + IDLE_NS, *due]) - now)
        for entity in self.subscriptions if self._others else ():
            busy, condition = entity.group in self._busy, entity.subscription.condition
            (self._wait_set.detach if busy else self._wait_set.attach)(condition)
        self._wait_for_work(now, timeout)
        self._wait_set.wait(timeout)
        if self._others:
            self._guard.set(False)
        now = min(monotonic_ns(), last_timer_ns)
        ready: list[Entity] = [timer for timer in self.timers if timer.due_ns <= now]
        ready += [one for one in self.subscriptions if one.subscription.ready()]
        self._snapshot.extend(one for one in ready if one.group not in self._busy)

    def record_take(self, rmw_handle: int, message: Message) -> None:
        """Record that a message was taken for the callback that starts next."""
        self._take(monotonic_ns(), rmw_handle, id(message), message.source_timestamp, 1)


Input = TypeVar("Input")


class Synchroniser(Generic[Input]):
    """The messages that wait for their set, at most ``depths[i]`` of input i (the newest).

    With a ``trigger``, the number of an input, each of its messages makes a set with the newest of
    the others, which are kept; without these it is gone.
    """

    def __init__(self, depths: Sequence[int], trigger: int | None = None) -> None:
        self._waiting: list[deque[Input]] = [deque(maxlen=depth) for depth in depths]
        self._trigger = trigger

    def add(self, number: int, message: Input) -> tuple[Input, ...]:
        """A message of an input; the set that is complete now, or nothing."""
        self._waiting[number].append(message)
        if self._trigger is not None:
            complete = number == self._trigger and all(self._waiting)
            newest = tuple(waiting[-1] for waiting in self._waiting) if complete else ()
            self._waiting[self._trigger].clear()
            return newest
        if not all(self._waiting):
            return ()
        return tuple(waiting.popleft() for waiting in self._waiting)


THREAD_NAME = "dds.asyn.0.1"  # Fast DDS's for user data

Note: TypeAlias = Callable[[int, int, str, int], None]
"""Records an `asynchronous_send`: time, source timestamp, outcome, duration of sending (ns)."""


class AsynchronousWriter:
    """The history of one writer, between the executor and the publisher thread.

    It has the last ``depth`` messages that are not sent yet; those older than ``lifespan_ns`` are
    not sent any more. ``write`` gives a message and its source timestamp to DDS. Taking and
    appending are single steps of the interpreter, so no lock is needed that a stopped thread could
    hold.
    """

    def __init__(
        self,
        write: Callable[[bytes, int], None],
        depth: int,
        lifespan_ns: int | None,
        note: Note,
        to_send: "queue.SimpleQueue[AsynchronousWriter]",
    ) -> None:
        self._write, self._note, self._to_send = write, note, to_send
        self._depth, self._lifespan_ns = depth, lifespan_ns
        self._history: deque[tuple[bytes, int]] = deque()

    def publish(self, payload: bytes, source_timestamp: int) -> None:
        """Executor: hand a message over, never waiting; a full history loses its oldest."""
        self._history.append((payload, source_timestamp))
        # Should the oldest be taken for sending just now, the one after it is lost: a message that
        # is being sent has its place in the history, as in DDS.
        if len(self._history) > self._depth and (oldest := self._oldest()) is not None:
            self._note(time.monotonic_ns(), oldest[1], "overwritten", 0)
        self._to_send.put(self)

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


def _end_process(said: object) -> None:
    """End this process from a thread of it, with a reason for whoever started it."""
    sys.stderr.write(f"{said}\n")
    sys.stderr.flush()
    os._exit(1)


def start_publisher_thread() -> "queue.SimpleQueue[AsynchronousWriter]":
    """Start the one thread that sends for all asynchronous writers of this process.

    They put themselves into the queue, once for each message.
    """
    waiting: queue.SimpleQueue[AsynchronousWriter] = queue.SimpleQueue()

    def send() -> None:
        set_thread_name(THREAD_NAME)
        while True:
            waiting.get().send_next()

    def send_or_end() -> None:
        try:
            send()
        except BaseException:  # a thread would end alone, and nothing be sent any more
            _end_process(traceback.format_exc())

    threading.Thread(target=send_or_end, daemon=True).start()
    return waiting


Work = Callable[[Sequence[dds.Message], int, int], Iterable[bytes]]
"""Of messages, and the wall clock and the thread's CPU clock (ns) at the callback's start: what is
published on each topic, in their order, or nothing."""


def spending(
    times: ExecutionTimes,
    templates: Sequence[bytes],
    announced: list[bytes],
    *,
    beside_others: bool = False,
) -> Work:
    """Spend the next execution time; the first message's stamp is passed on to all topics.

    ``templates`` has the data for each topic. What is ``announced`` is published in turn instead.
    Messages are made first: what a callback does before it publishes is its execution time.
    """
    announcements = cycle(announced)

    def work(messages: Sequence[dds.Message], wall_ns: int, cpu_ns: int) -> Sequence[bytes]:
        stamp = (origin_of(messages[0].payload) or 0) if messages else wall_ns
        made = [next(announcements, None) or dds.data_message(one, stamp) for one in templates]
        spend(times.next(), cpu_ns, beside_others=beside_others)
        return made

    return work


def computing(name: str, function: Callable[..., object], topics: int) -> Work:
    """Call a loaded function; what it raises ends the process with one line that says where."""

    def work(messages: Sequence[dds.Message], _wall_ns: int, _cpu_ns: int) -> Sequence[bytes]:
        try:
            made = function(*(message.payload for message in messages))
        except Exception as error:
            file, line, words = _explained(error)
            sys.exit(f"{name} failed at {file}:{line}: {words}")
        if made is None:
            return ()
        if not isinstance(made, bytes):
            remedy = "return the message to publish as bytes, or None"
            sys.exit(f"{name} returned {type(made).__name__}: {remedy}")
        return (made,) * topics

    return work


def load_function(name: str) -> Callable[..., object]:
    """The function that ``MODULE:FUNCTION`` names; ends the process if there is none.

    Nothing is loaded from a folder of PYTHONPATH, or the working one, that others may change.
    """
    module, _, attribute = name.partition(":")
    places = {folder: why_distrusted(folder) for folder in (*named_folders(), str(Path.cwd()))}
    sys.path += [folder for folder, reason in places.items() if reason is None]
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:
        file, line, words = _explained(error)
        where = "" if file.startswith("<frozen") else f" ({file}:{line})"
        sys.exit(
            f"{name} cannot be loaded: {words}{where}; its module has to be installed, "
            f"on PYTHONPATH, or in the working directory {Path.cwd()}"
            + "".join(f"; not {place}: {reason}" for place, reason in places.items() if reason)
        )
    if found is None:
        file = getattr(sys.modules[module], "__file__", None) or module
        sys.exit(f"{name} cannot be loaded: {file} has no {attribute}")
    if not callable(found):
        sys.exit(f"{name} cannot be called: name a function")
    return found  # type: ignore[no-any-return]


def _explained(error: Exception) -> tuple[str, int | None, str]:
    """File and line where it was raised, and what it says on one line."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    return at.filename, at.lineno, " ".join(f"{type(error).__name__}: {error}".split())
