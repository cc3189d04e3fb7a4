"""Callbacks of a Python node that tracers see like those of rclcpp.

rclpy has no trace points: without this a chain could not begin at the throttler's timer, and nobody
would know how long the shaping node holds a message. The functions behind rclcpp's trace points are
exported by a library that rcl has loaded into this process too (ros2_tracing,
`tracetools/include/tracetools/tracetools.h`, Humble to Rolling). Called from here, they make LTTng
write its events and uprobes fire; each call takes about a microsecond. Where that library is not
loaded, or was built without tracing, a callback is registered as it is.
"""

import ctypes
import functools
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import QoSProfile

from chainshaper.splicing.nodes.python.message_events import emit_takes, trace_points

__all__ = ["create_subscription", "create_timer"]

_POINTER = ctypes.c_void_p
_TRACE_POINTS = {
    "rclcpp_subscription_init": (_POINTER, _POINTER),
    "rclcpp_subscription_callback_added": (_POINTER, _POINTER),
    "rclcpp_timer_callback_added": (_POINTER, _POINTER),
    "rclcpp_timer_link_node": (_POINTER, _POINTER),
    "rclcpp_callback_register": (_POINTER, ctypes.c_char_p),
    "callback_start": (_POINTER, ctypes.c_bool),
    "callback_end": (_POINTER,),
}


def create_subscription(
    node: Node,
    message_type: Any,
    topic: str,
    callback: Callable[..., None],
    qos: QoSProfile,
    *,
    raw: bool = False,
) -> Any:
    """`Node.create_subscription`, with the events of rclcpp's."""
    emit = trace_points(_TRACE_POINTS)
    seen = _seen(callback, emit)
    subscription = node.create_subscription(message_type, topic, seen, qos, raw=raw)
    if emit:
        handle = subscription.handle.pointer
        emit["rclcpp_subscription_init"](handle, id(subscription))
        emit["rclcpp_subscription_callback_added"](id(subscription), id(seen))
        emit["rclcpp_callback_register"](id(seen), callback.__qualname__.encode())
    if raw:
        emit_takes(subscription)
    return subscription


def create_timer(node: Node, period_ns: int, callback: Callable[[], None], clock: Clock) -> None:
    """`Node.create_timer`, with the events of rclcpp's."""
    emit = trace_points(_TRACE_POINTS)
    seen = _seen(callback, emit)
    # rclpy takes seconds and cuts off behind the nanosecond.
    timer = node.create_timer((period_ns + 0.5) / 1e9, seen, clock=clock)
    if emit:
        emit["rclcpp_timer_callback_added"](timer.handle.pointer, id(seen))
        emit["rclcpp_timer_link_node"](timer.handle.pointer, node.handle.pointer)
        emit["rclcpp_callback_register"](id(seen), callback.__qualname__.encode())


def _seen(callback: Callable[..., None], emit: dict[str, Any]) -> Callable[..., None]:
    """A callback with its events; its handle is its address."""
    if not emit:
        return callback
    start, end = emit["callback_start"], emit["callback_end"]

    @functools.wraps(callback)  # rclpy looks how many arguments it takes
    def seen(*arguments: Any) -> None:
        start(handle, False)
        try:
            callback(*arguments)
        finally:
            end(handle)

    handle = id(seen)
    return seen
