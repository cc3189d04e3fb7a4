"""Publishers and callbacks of the live workload whose events are recorded."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from chainshaper.workload.event_log import EventLog


@dataclass(frozen=True)
class TracedPublisher:
    """A publisher with its trace point; sending and recording are two calls."""

    write: Callable[[bytes, int], None]  # takes a message and its source timestamp
    template: bytes  # the data of its messages
    handle: int
    rmw_handle: int
    point: Callable[..., None]  # see EventLog.point

    def send(self, payload: bytes) -> tuple[int, int]:
        """Publish; return the time of publication (ns) and the source timestamp.

        Trace point and DDS get the same source timestamp, as from the rmw layers. With asynchronous
        publication it is when the message was handed over, not when it was sent.
        """
        source_timestamp, now_ns = time.time_ns(), time.monotonic_ns()
        self.write(payload, source_timestamp)
        return now_ns, source_timestamp

    def record(self, payload: bytes, now_ns: int, source_timestamp: int) -> None:
        """Record what :meth:`send` did."""
        self.point(now_ns, self.handle, self.rmw_handle, id(payload), source_timestamp)


def traced_callback(log: EventLog, handle: int, body: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that calls ``body`` and records its start and end."""
    start, end = log.point("callback_start"), log.point("callback_end")

    def callback(*arguments: Any) -> None:
        start(time.monotonic_ns(), handle, time.thread_time_ns(), 0)
        body(*arguments)
        end(time.monotonic_ns(), handle, time.thread_time_ns())

    return callback
