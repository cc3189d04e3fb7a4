"""The event log of a process of the live workload, which is written without disturbing the process.

A trace point appends a few integers to an array, in one step of the interpreter, so that threads
may share the log. Names are written once, at start-up. Nothing touches a file or a pipe before the
run is over.

The arrays are in locked memory. None gets long: after half an hour, enlarging a single array would
allocate so many pages at once that its thread would pause for ten milliseconds. For the same reason
nothing heavy is imported. The simulator notes its objects here as well, and its log has the same
layout.
"""

from array import array
from collections.abc import Callable
from functools import partial
from itertools import count
from struct import Struct
from threading import get_native_id
from time import monotonic_ns
from typing import Any

from chainshaper.robot.decision import DROPPED
from chainshaper.robot.gate import ANCHORS, LATE, MESSAGES
from chainshaper.values.event_declarations import SLEEPING_CALLS

_RELEASE = "callback source_timestamp arrival origin release slot cycles_waited anchor overrun mode"
LAYOUT: dict[str, tuple[str, ...]] = {
    "callback_start": ("callback", "thread_time", "is_intra_process"),
    "callback_end": ("callback", "thread_time"),
    "publish": ("publisher_handle", "rmw_publisher_handle", "message", "timestamp"),
    "take": ("rmw_subscription_handle", "message", "source_timestamp", "taken"),
    "execute": ("handle",),
    "rclcpp_executor_wait_for_work": ("timeout",),
    "gate_release": (*_RELEASE.split(), "dropped", "moved"),
    "asynchronous_send": ("rmw_publisher_handle", "timestamp", "outcome", "duration"),
    "machine_stall": ("duration",),
    "thread_sleep": ("until", "call", "thread_time"),
    "thread_wake": ("call", "thread_time"),
    "plant_step": ("step", "sample", "cost", "output", "input"),
}
"""Kinds of entries, and the order of their fields. The number of a kind is its place here."""
ALSO_TAKEN = ("rcl_take", "rclcpp_take")  # only where a message was taken
EVENTS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in LAYOUT},
    "publish": ("rclcpp_publish", "rcl_publish", "rmw_publish"),
    "take": ("rmw_take", *ALSO_TAKEN),
    "execute": ("rclcpp_executor_get_next_ready", "rclcpp_executor_execute"),
}
"""The events for which each kind of entry stands; all have its instant."""

WIDTH = 15  # numbers of an entry: its kind, time, thread, and up to twelve fields
BLOCK = 1_000 * WIDTH  # numbers in an array before the next one is begun

ABSENT = -1  # stands for null
_REAL, _REAL_BITS = Struct("<d"), Struct("<q")
WORDS: dict[str, tuple[str, ...]] = {
    "anchor": ANCHORS,
    "overrun": LATE,
    "messages": MESSAGES,
    "dropped": DROPPED,
    "outcome": ("sent", "expired", "overwritten"),
    "step": ("sampled", "driven"),
}
"""Words are recorded as their places in these lists; a ``mode`` by its place among its gate's."""

CLOCK_NANOSLEEP = SLEEPING_CALLS.index("clock_nanosleep")  # by which loops sleep
FIRST_HANDLE = 0x55D0_0000_0100  # like a real address; other processes have the same


def number_of_real(value: float) -> int:
    """Return the number by which a floating-point number is recorded: the same 64 bits."""
    bits: int = _REAL_BITS.unpack(_REAL.pack(value))[0]
    return bits


def number_of(field: str, word: str | None) -> int:
    """Return the number by which a word of :data:`WORDS` is recorded."""
    return ABSENT if word is None else WORDS[field].index(word)


class EventLog:
    """The events of a process, and the creation of its node's objects, which get their handles.

    Logs of several nodes in one process take their handles from one `new_handle`.
    """

    def __init__(
        self,
        clock: Callable[[], int] = monotonic_ns,
        new_handle: Callable[[], int] | None = None,
    ) -> None:
        self._blocks = [array("q")]
        self.objects: list[dict[str, Any]] = []  # the init events, which carry names
        self.new_handle = new_handle or partial(next, count(FIRST_HANDLE, 0x100))
        self._clock = clock
        self._node = self.new_handle()

    def init(self, event: str, **fields: Any) -> None:
        """Record an object's creation (`rcl_node_init` and its kind)."""
        self.objects.append({"event": event, "time": self._clock(), **fields})

    def node(self, node: str, version: str) -> None:
        """Record that the process's node is created; ``node`` is its full name."""
        self.init("rcl_init", context_handle=self.new_handle(), version=version)
        namespace, _, name = node.rpartition("/")
        self.init(
            "rcl_node_init",
            node_handle=self._node,
            rmw_handle=self.new_handle(),
            node_name=name,
            namespace=namespace or "/",
        )

    def publisher(self, topic: str, depth: int, asynchronous: bool) -> tuple[int, int]:
        """Record that a publisher is created; return its handle, and that of rmw."""
        handle, rmw_handle = self.new_handle(), self.new_handle()
        self.init(
            "rcl_publisher_init",
            node_handle=self._node,
            publisher_handle=handle,
            rmw_publisher_handle=rmw_handle,
            topic_name=topic,
            queue_depth=depth,
            asynchronous=int(asynchronous),
        )
        return handle, rmw_handle

    def callback(self, symbol: str) -> int:
        """Record that a callback is registered; return its handle."""
        handle = self.new_handle()
        self.init("rclcpp_callback_register", callback=handle, symbol=symbol)
        return handle

    def timer(self, callback: int, period_ns: int) -> int:
        """Record that a timer is created for a callback; return its handle."""
        handle = self.new_handle()
        self.init("rcl_timer_init", timer_handle=handle, period=period_ns)
        self.init("rclcpp_timer_callback_added", timer_handle=handle, callback=callback)
        self.init("rclcpp_timer_link_node", timer_handle=handle, node_handle=self._node)
        return handle

    def subscription(self, callback: int, topic: str, depth: int) -> tuple[int, int]:
        """Record that a subscription is created for a callback; return its handle, and rmw's."""
        handle, rmw_handle, of_rclcpp = self.new_handle(), self.new_handle(), self.new_handle()
        self.init(
            "rcl_subscription_init",
            node_handle=self._node,
            subscription_handle=handle,
            rmw_subscription_handle=rmw_handle,
            topic_name=topic,
            queue_depth=depth,
        )
        self.init("rclcpp_subscription_init", subscription_handle=handle, subscription=of_rclcpp)
        self.init("rclcpp_subscription_callback_added", subscription=of_rclcpp, callback=callback)
        return handle, rmw_handle

    def loop(self, node: str) -> None:
        """Record that the process's node, by its full name, has a loop, which is no callback."""
        self.init("loop_named", name=node, is_thread=0)

    def point(self, entry: str) -> Callable[..., None]:
        """Return a fast function that records an entry of this kind, for the calling thread.

        It takes the time (ns), then the fields in the order of :data:`LAYOUT`.
        """
        number, blocks = list(LAYOUT).index(entry), self._blocks
        padding = (0,) * (WIDTH - 3 - len(LAYOUT[entry]))

        def record(time_ns: int, *fields: int) -> None:
            block = blocks[-1]
            block.extend((number, time_ns, get_native_id(), *fields, *padding))
            if len(block) >= BLOCK:
                blocks.append(array("q"))

        return record

    @property
    def rows(self) -> bytes:
        """All entries, each of :data:`WIDTH` signed 64-bit numbers."""
        return b"".join(block.tobytes() for block in self._blocks)
