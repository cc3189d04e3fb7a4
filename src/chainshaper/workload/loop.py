"""A loop of a live node: a thread that sleeps until multiples of a period, and is no callback.

The executor stores messages for it. An instance uses the newest that were stored before it began. A
multiple that the instance before has missed is left out.
"""

import queue
import threading
import time
import traceback
from collections.abc import Callable

from chainshaper.linux.scheduling import set_thread_name
from chainshaper.robot.clocks import sleep_until
from chainshaper.workload.dds import Message
from chainshaper.workload.event_log import CLOCK_NANOSLEEP, EventLog
from chainshaper.workload.executor import end_process
from chainshaper.workload.launcher import LOOP_NAME


class Loop:
    """The loop of a node, in a thread of its own, which waits for the beginning of the run.

    ``body`` is what an instance does with the newest message of the first topic that it reads; it
    gets None where there is none. Its first instance is ``phase_ns`` behind the start. To end it
    early, set ``over``; it looks at that when it wakes up.

    When timers expire no more, it runs only instances that have something new to use, so that what
    timers have begun is completed.
    """

    def __init__(
        self,
        period_ns: int,
        phase_ns: int,
        topics: int,
        body: Callable[[Message | None], None],
        log: EventLog,
    ) -> None:
        self.period_ns = period_ns
        self.over = False
        self._stored: list[Message | None] = [None] * topics  # of each topic that it reads
        self._has_news = False
        self._phase_ns, self._body = phase_ns, body
        self._sleeps, self._wakes = log.point("thread_sleep"), log.point("thread_wake")
        self._begin: queue.SimpleQueue[tuple[int, int, int]] = queue.SimpleQueue()
        named = threading.Semaphore(0)
        # It starts before the run, so that it can get its priority.
        self._thread = threading.Thread(target=self._wait_and_run, args=(named,), daemon=True)
        self._thread.start()
        named.acquire()

    def store(self, number: int, message: Message) -> None:
        """Store a message of a topic that it reads."""
        self._stored[number], self._has_news = message, True

    def begin(self, start_ns: int, last_timer_ns: int, last_ns: int) -> None:
        """Let it run from the common start on; no instance begins after ``last_ns``.

        Timers expire until ``last_timer_ns``.
        """
        self._begin.put((start_ns + self._phase_ns, last_timer_ns, last_ns))

    def wait_for_end(self) -> None:
        """Wait until its last instance has ended."""
        self._thread.join()

    def _wait_and_run(self, named: threading.Semaphore) -> None:
        set_thread_name(LOOP_NAME)
        named.release()
        try:
            self._run(*self._begin.get())
        except BaseException as error:  # otherwise the thread alone would end
            end_process(error.code if isinstance(error, SystemExit) else traceback.format_exc())

    def _run(self, due_ns: int, last_timer_ns: int, last_ns: int) -> None:
        """Sleep and run instances until the end."""
        while due_ns <= last_ns:
            self._sleeps(time.monotonic_ns(), due_ns, CLOCK_NANOSLEEP, time.thread_time_ns())
            sleep_until(due_ns)
            if self.over:
                return
            if due_ns <= last_timer_ns or self._has_news:
                self._wakes(time.monotonic_ns(), CLOCK_NANOSLEEP, time.thread_time_ns())
                self._has_news = False
                self._body(self._stored[0] if self._stored else None)
            due_ns += self.period_ns
            missed_ns = max(0, time.monotonic_ns() - due_ns)
            due_ns += -(-missed_ns // self.period_ns) * self.period_ns
