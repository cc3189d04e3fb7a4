"""Asynchronous publication: a thread of its own sends what the executor hands over.

As Fast DDS has it (paper, section 2.2): publishing puts the message into its writer's history,
with the source timestamp of that instant, and wakes the **publisher thread** (``dds.asyn.…``),
which sends for all asynchronous writers of the process. The history keeps the last ``depth``
messages that are not sent yet; one that is older than the topic's lifespan is not sent any more.

A reservation server may keep this thread from running while the executor goes on (section 3.2.1).
So what it waits for, it waits for in the kernel: without the interpreter's lock, and without any
lock of DDS. Woken while it is kept from running, it stops before it returns to user space, and
the executor, which only appends and wakes, never waits for it. Stopped in the midst of sending,
however, it holds both, and the process stands still: a publish slot has to be far longer than a
send (:mod:`chainshaper.planning.overruns`).
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

from chainshaper.linux.scheduling import set_thread_name
from chainshaper.workload.event_log import number_of

__all__ = ["AsynchronousWriter", "Note", "PublisherThread", "noting_sends"]

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
