"""What runs in a node: executor, synchroniser, publisher thread, and what callbacks do.

**Executor.** With one thread it works as rclcpp's `SingleThreadedExecutor` (Casini et al., ECRTS
2019). It waits until something is ready, takes a snapshot of all that is, and runs that to its end:
timers first, then subscriptions, each in the order of registration and at most once. What becomes
ready meanwhile waits for the next snapshot. A timer that missed whole periods fires once and keeps
its phase.

With several threads it works as rclcpp's `MultiThreadedExecutor` (Jazzy). One thread at a time
takes the next entity of the snapshot or, if none is left, waits for the next snapshot; the other
threads wait for their turn. While a callback of a mutually exclusive group runs, no snapshot has
entities of its group. When it is done, the thread that waits looks again.

**Synchroniser** (message_filters). Each input has a subscription and a callback of its own. A set
is the oldest message of every input. The callback whose message completes it computes and
publishes; the other callbacks only leave their message.

**Asynchronous publication.** As Fast DDS has it (paper, section 2.2): publishing puts the message
into its writer's history, with the source timestamp of that instant, and wakes the **publisher
thread** (``dds.asyn.…``), which sends for all asynchronous writers of the process.

A reservation server may stop this thread while the executor goes on (section 3.2.1). So it waits
in the kernel, and holds neither the interpreter's lock nor one of DDS. If it is woken while its
server is closed, it stops before it returns to user space, and the executor, which only appends and
wakes, never waits for it. But if it is stopped while it sends, it holds both locks, and the whole
process waits. So a publish slot has to be far longer than a send
(:mod:`chainshaper.planning.overruns`).

**Work.** A callback spends its described time, or calls the function that it ``computes:`` with
the serialized messages that triggered it (none for a timer, the whole set for a synchroniser). The
function returns the serialized message to publish on every topic of the callback, or None to
publish nothing. Gates count from the stamp in the header, which the function has to pass on
(:func:`~chainshaper.workload.dds.data_of` and :func:`~chainshaper.workload.dds.data_message` read
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

from chainshaper.linux.child_processes import named_folders
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
    group: str | None = None  # of which its callback runs alone

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
    group: str | None = None  # of which its callback runs alone


Entity: TypeAlias = Timer | SubscriptionEntity

IDLE_NS = 500_000_000  # an executor with nothing to do looks so often whether it is to end


class NodeExecutor:
    """Runs the callbacks of a process on the calling thread, and on ``threads`` − 1 more.

    To end it early, set ``over``; it looks at that when it is done with a snapshot.
    """

    def __init__(self, participant: Any, log: EventLog, threads: int = 1) -> None:
        self.timers: list[Timer] = []
        self.subscriptions: list[SubscriptionEntity] = []
        self.backlogs: list[Callable[[], bool]] = []  # each works some off; whether more is left
        self._wait_set = dds.WaitSet(participant)
        # An empty wait set would return at once instead of waiting. It also wakes a waiting thread.
        self._guard = dds.GuardCondition(participant)
        self._wait_set.attach(self._guard)
        self._wait_for_work = log.point("rclcpp_executor_wait_for_work")
        self._execute, self._take = log.point("execute"), log.point("take")
        self.over = False
        self._turn = threading.Lock()
        self._snapshot: deque[Entity] = deque()
        self._busy: set[str] = set()  # groups of which a callback runs
        self._begin: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
        self._workers: list[threading.Thread] = []
        named = threading.Semaphore(0)
        for _ in range(1, threads):  # they start before the run, so that they can get priorities
            worker = threading.Thread(target=self._join_in, args=(named,), daemon=True)
            worker.start()
            named.acquire()
            self._workers.append(worker)

    def add_subscription(self, entity: SubscriptionEntity) -> None:
        """Add a subscription behind those that were added before."""
        self.subscriptions.append(entity)
        self._wait_set.attach(entity.subscription.condition)

    def spin_until(self, stop_ns: int, last_timer_ns: int) -> None:
        """Wait and run until ``stop_ns`` of CLOCK_MONOTONIC; a running callback is finished.

        Timers expire until ``last_timer_ns``, so that what they have started can be completed.
        Backlogs, messages that a callback has taken beside that which triggered it, are worked off
        before each wait.
        """
        for _ in self._workers:
            self._begin.put((stop_ns, last_timer_ns))
        self._spin(stop_ns, last_timer_ns)
        for worker in self._workers:
            worker.join()

    def _join_in(self, named: threading.Semaphore) -> None:
        """Be a worker: take the name, wait for the beginning, and run callbacks until the end."""
        set_thread_name(WORKER_NAME)
        named.release()
        try:
            stop_ns, last_timer_ns = self._begin.get()
            self._spin(stop_ns, last_timer_ns)
        except BaseException as error:  # otherwise the thread alone would end, its group busy
            end_process(error.code if isinstance(error, SystemExit) else traceback.format_exc())

    def _spin(self, stop_ns: int, last_timer_ns: int) -> None:
        """Run callbacks on the calling thread until the end."""
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
        """Wait for what this thread executes next; None: the end has come."""
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
        has_more, now = [work_off() for work_off in self.backlogs], monotonic_ns()
        free = [timer for timer in self.timers if timer.group not in self._busy]
        due = [timer.due_ns for timer in free if timer.due_ns <= last_timer_ns]
        timeout = 0 if any(has_more) else max(0, min([stop_ns, now + IDLE_NS, *due]) - now)
        if self._workers:
            for entity in self.subscriptions:
                if entity.group in self._busy:
                    self._wait_set.detach(entity.subscription.condition)
                else:
                    self._wait_set.attach(entity.subscription.condition)
        self._wait_for_work(now, timeout)
        self._wait_set.wait(timeout)
        if self._workers:
            self._guard.set(False)
        now = min(monotonic_ns(), last_timer_ns)
        ready: list[Entity] = [timer for timer in self.timers if timer.due_ns <= now]
        ready += [entity for entity in self.subscriptions if entity.subscription.ready()]
        self._snapshot.extend(entity for entity in ready if entity.group not in self._busy)

    def record_take(self, rmw_handle: int, message: Message) -> None:
        """Record that a message was taken for the callback that starts next."""
        self._take(monotonic_ns(), rmw_handle, id(message), message.source_timestamp, 1)


Input = TypeVar("Input")


class Synchroniser(Generic[Input]):
    """The messages that wait for their set: of each input the newest, as many as its ``depths``.

    With a ``trigger``, the number of an input, each message of that input makes a set with the
    newest of every other input, which stay. If an input has none, there is no set.
    """

    def __init__(self, depths: Sequence[int], trigger: int | None = None) -> None:
        self._waiting: list[deque[Input]] = [deque(maxlen=depth) for depth in depths]
        self._trigger = trigger

    def add(self, number: int, message: Input) -> tuple[Input, ...]:
        """Add a message of an input; return the set that it completes, or nothing."""
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

    It holds the last ``depth`` messages that are not sent yet. Messages older than ``lifespan_ns``
    are not sent any more. ``write`` gives a message and its source timestamp to DDS. Taking and
    appending are single steps of the interpreter, so no lock is needed, which a stopped thread
    could hold.
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
        """Executor: hand a message over without waiting; a full history loses its oldest."""
        self._history.append((payload, source_timestamp))
        # If the thread takes the oldest just now, the next one is lost instead. In DDS, too, a
        # message that is being sent has a place in the history.
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


def end_process(said: object) -> None:
    """End this process from a thread of it, with a reason for whoever started it."""
    sys.stderr.write(f"{said}\n")
    sys.stderr.flush()
    os._exit(1)


def start_publisher_thread() -> "queue.SimpleQueue[AsynchronousWriter]":
    """Start the thread that sends for all asynchronous writers of this process.

    Writers put themselves into the queue that is returned, once for each message.
    """
    waiting: queue.SimpleQueue[AsynchronousWriter] = queue.SimpleQueue()

    def send() -> None:
        set_thread_name(THREAD_NAME)
        while True:
            waiting.get().send_next()

    def send_or_end() -> None:
        try:
            send()
        except BaseException:  # otherwise the thread alone would end, and nothing be sent
            end_process(traceback.format_exc())

    threading.Thread(target=send_or_end, daemon=True).start()
    return waiting


Work = Callable[[Sequence[dds.Message], int, int], Iterable[bytes]]
"""What a callback does before it publishes.

It takes the messages, and what the wall clock and the thread's CPU clock showed at the callback's
start (ns). It returns the message for each topic, in the topics' order, or nothing.
"""


NumbersOf: TypeAlias = Callable[[Sequence[dds.Message]], bytes]
"""Gives the numbers of a control loop that a callback publishes, from the messages it gets."""


def spending(
    times: ExecutionTimes,
    templates: Sequence[bytes],
    announced: list[bytes],
    *,
    numbers_of: NumbersOf | None = None,
    beside_others: bool = False,
) -> Work:
    """Return work that spends the next execution time, and passes the first message's stamp on.

    ``templates`` has the data for each topic; ``numbers_of`` gives what takes the place of their
    first bytes. If messages are ``announced``, these are published in turn instead. Messages are
    made first, so that making them is part of the execution time.
    """
    announcements = cycle(announced)

    def work(messages: Sequence[dds.Message], wall_ns: int, cpu_ns: int) -> Sequence[bytes]:
        stamp = (origin_of(messages[0].payload) or 0) if messages else wall_ns
        numbers = b"" if numbers_of is None else numbers_of(messages)
        made = [
            next(announcements, None) or dds.data_message(numbers + data[len(numbers) :], stamp)
            for data in templates
        ]
        spend(times.next(), cpu_ns, beside_others=beside_others)
        return made

    return work


def computing(name: str, function: Callable[..., object], topics: int) -> Work:
    """Return work that calls a function. If that raises, the process ends with a line that says so.

    ``name`` is the function's, ``topics`` the number of topics.
    """

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
    """Load the function that ``MODULE:FUNCTION`` names; end the process if there is none.

    Nothing is loaded from folders that other users may change, be they in PYTHONPATH or the
    working directory.
    """
    module, _, attribute = name.partition(":")
    places = {folder: why_distrusted(folder) for folder in (*named_folders(), str(Path.cwd()))}
    sys.path += [folder for folder, reason in places.items() if reason is None]
    try:
        function = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:
        file, line, words = _explained(error)
        where = "" if file.startswith("<frozen") else f" ({file}:{line})"
        sys.exit(
            f"{name} cannot be loaded: {words}{where}; its module has to be installed, "
            f"on PYTHONPATH, or in the working directory {Path.cwd()}"
            + "".join(f"; not {place}: {reason}" for place, reason in places.items() if reason)
        )
    if function is None:
        file = getattr(sys.modules[module], "__file__", None) or module
        sys.exit(f"{name} cannot be loaded: {file} has no {attribute}")
    if not callable(function):
        sys.exit(f"{name} cannot be called: name a function")
    return function  # type: ignore[no-any-return]


def _explained(error: Exception) -> tuple[str, int | None, str]:
    """Return the file and line where an exception was raised, and what it says, on one line."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    return at.filename, at.lineno, " ".join(f"{type(error).__name__}: {error}".split())
