"""The event log of one process of the live workload: written without disturbing the process.

A trace point appends a few integers to an array in locked memory, in one step, so that threads
may share the log; names are written once, at start-up. Nothing touches a file or a pipe before
the run is over. No array gets long: one that does is given so many pages at a time that after half
an hour its thread pauses for ten milliseconds. Nothing heavy is imported: the pages are locked into
memory. The simulator notes its objects here as well, and has its log laid out alike.
"""

from array import array
from collections.abc import Callable
from functools import partial
from itertools import count
from threading import get_native_id
from time import monotonic_ns
from typing import Any

from chainshaper.robot.decision import DROPPED
from chainshaper.robot.gate import ANCHORS, LATE, MESSAGES

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
}
"""What is recorded, and the order of its fields; its number is its place in this list."""
ALSO_TAKEN = ("rcl_take", "rclcpp_take")  # only where a message was taken
EVENTS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in LAYOUT},
    "publish": ("rclcpp_publish", "rcl_publish", "rmw_publish"),
    "take": ("rmw_take", *ALSO_TAKEN),
    "execute": ("rclcpp_executor_get_next_ready", "rclcpp_executor_execute"),
}
"""The events that each stands for, all of the same instant."""

WIDTH = 15  # number of what is recorded, time, thread, and up to twelve fields
BLOCK = 1_000 * WIDTH  # numbers in an array, when the next one is begun

ABSENT = -1  # for null in fields that may be
WORDS: dict[str, tuple[str, ...]] = {
    **{"anchor": ANCHORS, "overrun": LATE, "messages": MESSAGES, "dropped": DROPPED},
    "outcome": ("sent", "expired", "overwritten"),
}
"""Fields that hold words are recorded as places in these lists; ``mode`` in that of its gate."""

FIRST_HANDLE = 0x55D0_0000_0100  # like a real address; other processes have the same


def number_of(field: str, word: str | None) -> int:
    """The number under which a word of :data:`WORDS` is recorded."""
    return ABSENT if word is None else WORDS[field].index(word)


class EventLog:
    """Events of one process, and the objects of its node with their handles."""

    def __init__(self, clock: Callable[[], int] = monotonic_ns) -> None:
        self._blocks = [array("q")]
        self.objects: list[dict[str, Any]] = []  # the init events, which carry names
        self.new_handle: Callable[[], int] = partial(next, count(FIRST_HANDLE, 0x100))
        self._clock = clock
        self._node = self.new_handle()

    def init(self, event: str, **fields: Any) -> None:
        """Record an object's creation (`rcl_node_init` and its kind)."""
        self.objects.append({"event": event, "time": self._clock(), **fields})

    def node(self, node: str, version: str) -> None:
        """The process's node is created; ``node`` is its full name."""
        self.init("rcl_init", context_handle=self.new_handle(), version=version)
        namespace, _, name = node.rpartition("/")
        named = {"node_name": name, "namespace": namespace or "/"}
        self.init("rcl_node_init", node_handle=self._node, rmw_handle=self.new_handle(), **named)

    def publisher(self, topic: str, depth: int, asynchronous: bool) -> tuple[int, int]:
        """A publisher is created: its handle, and that of rmw."""
        handle, rmw_handle = self.new_handle(), self.new_handle()
        own = {"publisher_handle": handle, "rmw_publisher_handle": rmw_handle}
        about = {"topic_name": topic, "queue_depth": depth, "asynchronous": int(asynchronous)}
        self.init("rcl_publisher_init", node_handle=self._node, **own, **about)
        return handle, rmw_handle

    def callback(self, symbol: str) -> int:
        """A callback is registered: its handle."""
        handle = self.new_handle()
        self.init("rclcpp_callback_register", callback=handle, symbol=symbol)
        return handle

    def timer(self, callback: int, period_ns: int) -> int:
        """A timer is created for a callback: its handle."""
        handle = self.new_handle()
        self.init("rcl_timer_init", timer_handle=handle, period=period_ns)
        self.init("rclcpp_timer_callback_added", timer_handle=handle, callback=callback)
        self.init("rclcpp_timer_link_node", timer_handle=handle, node_handle=self._node)
        return handle

    def subscription(self, callback: int, topic: str, depth: int) -> tuple[int, int]:
        """A subscription is created for a callback: its handle, and that of rmw."""
        handle, rmw_handle, above = self.new_handle(), self.new_handle(), self.new_handle()
        own = {"subscription_handle": handle, "rmw_subscription_handle": rmw_handle}
        about = {"topic_name": topic, "queue_depth": depth}
        self.init("rcl_subscription_init", node_handle=self._node, **own, **about)
        self.init("rclcpp_subscription_init", subscription_handle=handle, subscription=above)
        self.init("rclcpp_subscription_callback_added", subscription=above, callback=callback)
        return handle, rmw_handle

    def point(self, entry: str) -> Callable[..., None]:
        """A fast function of (time, *fields as in :data:`LAYOUT`) that records for its thread."""
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
        """All that was recorded: :data:`WIDTH` signed 64-bit numbers for each entry."""
        return b"".join(block.tobytes() for block in self._blocks)
