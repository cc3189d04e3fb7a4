"""The event log of one process of the live workload: written without disturbing the process.

A trace point appends a few integers to an array in locked memory, in one step, so that threads
may share the log; names are written once, at start-up. Nothing touches a file or a pipe before
the run is over. The layout is read back by
:mod:`chainshaper.workload.live`, which turns it into the tables of
:mod:`chainshaper.values.events`. Nothing heavy is imported: the pages are locked into memory.

A process and the launcher talk in lines of JSON on pipes, and bytes at the end:

1. launcher → process: what it is;
2. process → launcher: that it is ready;
3. launcher → process: when to start and stop (ns of CLOCK_MONOTONIC);
4. process → launcher: one line with the size of its events, then the events;
5. launcher → process: an empty line: leave.

Between 3 and 4 neither touches a pipe, so that talking never disturbs what is measured.
"""

import json
import sys
from array import array
from collections.abc import Callable
from time import monotonic_ns
from typing import Any

from chainshaper.gate.decision import ANCHORS, DROPPED, LATE, MESSAGES

__all__ = [
    "ABSENT",
    "LAYOUT",
    "WIDTH",
    "WORDS",
    "EventLog",
    "number_of",
    "receive",
    "send",
    "send_events",
    "wait_for_leave",
]

LAYOUT: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("callback_start", ("callback", "thread_time", "is_intra_process")),
    ("callback_end", ("callback", "thread_time")),
    ("rclcpp_publish", ("message",)),
    ("rcl_publish", ("publisher_handle", "message")),
    ("rmw_publish", ("rmw_publisher_handle", "message", "timestamp")),
    ("rmw_take", ("rmw_subscription_handle", "message", "source_timestamp", "taken")),
    ("rcl_take", ("message",)),
    ("rclcpp_take", ("message",)),
    ("rclcpp_executor_get_next_ready", ()),
    ("rclcpp_executor_wait_for_work", ("timeout",)),
    ("rclcpp_executor_execute", ("handle",)),
    (
        "gate_release",
        (
            "callback",
            "source_timestamp",
            "arrival",
            "origin",
            "release",
            "slot",
            "cycles_waited",
            "anchor",
            "overrun",
            "mode",
            "dropped",
        ),
    ),
    ("asynchronous_send", ("tid", "rmw_publisher_handle", "timestamp", "outcome", "duration")),
    ("machine_stall", ("duration",)),
)
"""Event names and the order of their fields; an event's number is its place in this list."""

WIDTH = 13  # event number, time, and up to eleven fields

ABSENT = -1
"""Stands for null in fields that may be."""

WORDS: dict[str, tuple[str, ...]] = {
    "anchor": ANCHORS,
    "overrun": LATE,
    "messages": MESSAGES,
    "dropped": DROPPED,
    "outcome": ("sent", "expired", "overwritten"),
}
"""Fields that hold words are recorded as places in these lists.

So is ``mode``, in the list of the gate's own modes.
"""


def number_of(field: str, word: str | None) -> int:
    """The number under which a word of :data:`WORDS` is recorded."""
    return ABSENT if word is None else WORDS[field].index(word)


class EventLog:
    """Events of one process. :meth:`point` makes a fast recording function for one event."""

    def __init__(self) -> None:
        self.rows = array("q")
        self.objects: list[dict[str, Any]] = []  # the init events, which carry names

    def init(self, event: str, **fields: Any) -> None:
        """Record an object's creation (`rcl_node_init` and its kind)."""
        self.objects.append({"event": event, "time": monotonic_ns(), **fields})

    def point(self, event: str) -> Callable[..., None]:
        """A function of (time, *fields) that records one event; fields as in :data:`LAYOUT`."""
        number = next(i for i, (name, _) in enumerate(LAYOUT) if name == event)
        extend = self.rows.extend
        padding = (0,) * (WIDTH - 2 - len(LAYOUT[number][1]))

        def record(time_ns: int, *fields: int) -> None:
            extend((number, time_ns, *fields, *padding))

        return record


def receive() -> dict[str, Any]:
    """The launcher's next line; ends this process when the launcher is gone."""
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    received: dict[str, Any] = json.loads(line)
    return received


def send(**fields: Any) -> None:
    """One line to the launcher."""
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def send_events(events: bytes, **fields: Any) -> None:
    """What was recorded, behind a line that says how much it is."""
    send(bytes=len(events), **fields)
    # A process that is frozen while it writes has written a part; without a buffer
    # (PYTHONUNBUFFERED) no other layer writes the rest.
    left = memoryview(events)
    while left:
        left = left[sys.stdout.buffer.write(left) :]
    sys.stdout.buffer.flush()


def wait_for_leave() -> None:
    """Stay until everybody is done: a participant that leaves early disturbs the others."""
    sys.stdin.readline()
