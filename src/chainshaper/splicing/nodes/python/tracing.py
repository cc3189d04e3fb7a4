"""Callbacks and serialized messages of a Python node that tracers see like those of rclcpp.

rclpy has no trace points: without this a chain could not begin at the throttler's timer, and the
time for which the shaping node holds a message would not be known. Before Jazzy neither rcl nor rmw
has trace points on the way of serialized messages, either. The functions behind them all are
exported by a library that rcl has loaded into this process (ros2_tracing,
`tracetools/include/tracetools/tracetools.h`, Humble to Rolling; rcl, `rcl/subscription.h`). Called
from here, they make LTTng write its events and uprobes fire; each call takes about a microsecond.
Where that library is not loaded, or was built without tracing, no event is emitted.
"""

import ctypes
import functools
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

_POINTER = ctypes.c_void_p
_CALLBACK_EVENTS = {
    "rclcpp_subscription_init": (_POINTER, _POINTER),
    "rclcpp_subscription_callback_added": (_POINTER, _POINTER),
    "rclcpp_timer_callback_added": (_POINTER, _POINTER),
    "rclcpp_timer_link_node": (_POINTER, _POINTER),
    "rclcpp_callback_register": (_POINTER, ctypes.c_char_p),
    "callback_start": (_POINTER, ctypes.c_bool),
    "callback_end": (_POINTER,),
}
_MESSAGE_EVENTS = {
    "rcl_publish": (_POINTER, _POINTER),
    "rmw_publish": (_POINTER,),
    "rmw_take": (_POINTER, _POINTER, ctypes.c_int64, ctypes.c_bool),
}

HUMBLE = not hasattr(Subscription, "CallbackType")
"""There a callback gets the message only, and serialized messages pass no trace points."""


def create_subscription(
    node: Node,
    message_type: Any,
    topic: str,
    callback: Callable[..., None],
    qos: QoSProfile,
    *,
    raw: bool = False,
) -> Any:
    """`Node.create_subscription`, with the events of rclcpp's.

    On Humble a raw one emits the event of each take, too. In place of the source timestamp, which
    is not known there, stands the time of the call: the publication that the analysis looks for is
    the latest before.
    """
    emit = _functions(_CALLBACK_EVENTS)
    traced = _traced(callback, emit)
    subscription = node.create_subscription(message_type, topic, traced, qos, raw=raw)
    if emit:
        handle = subscription.handle.pointer
        emit["rclcpp_subscription_init"](handle, id(subscription))
        emit["rclcpp_subscription_callback_added"](id(subscription), id(traced))
        emit["rclcpp_callback_register"](id(traced), callback.__qualname__.encode())
    if raw and HUMBLE and (takes := _functions(_MESSAGE_EVENTS)):
        handle, executed = _rmw_handle(subscription), subscription.callback

        def taken(payload: bytes) -> None:
            takes["rmw_take"](handle, id(payload), time.time_ns(), True)
            executed(payload)

        subscription.callback = taken
    return subscription


def create_timer(node: Node, period_ns: int, callback: Callable[[], None], clock: Clock) -> None:
    """`Node.create_timer`, with the events of rclcpp's."""
    emit = _functions(_CALLBACK_EVENTS)
    traced = _traced(callback, emit)
    # rclpy takes seconds and cuts off behind the nanosecond.
    timer = node.create_timer((period_ns + 0.5) / 1e9, traced, clock=clock)
    if emit:
        emit["rclcpp_timer_callback_added"](timer.handle.pointer, id(traced))
        emit["rclcpp_timer_link_node"](timer.handle.pointer, node.handle.pointer)
        emit["rclcpp_callback_register"](id(traced), callback.__qualname__.encode())


def publish_function(publisher: Any) -> Callable[[bytes], None]:
    """`publisher.publish` for serialized messages, with its events."""
    emit = _functions(_MESSAGE_EVENTS) if HUMBLE else {}
    publish: Callable[[bytes], None] = publisher.publish
    if not emit:
        return publish
    handle = publisher.handle.pointer

    def with_events(payload: bytes) -> None:
        emit["rcl_publish"](handle, id(payload))
        emit["rmw_publish"](id(payload))
        publish(payload)

    return with_events


def take_event(subscription: Any) -> Callable[[int | None], None]:
    """What emits the event of a take once more, when a callback is executed for its message.

    Others were taken meanwhile, and a callback is for the message that was taken last.
    """
    emit = {} if HUMBLE else _functions(_MESSAGE_EVENTS)
    if not emit:
        return lambda _: None
    handle = _rmw_handle(subscription)
    return lambda source: emit["rmw_take"](handle, id(subscription), source or 0, True)


def _functions(wanted: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """The functions of events, by their names with their arguments' types.

    None where the library is not loaded, or one of them is missing.
    """
    try:
        library = ctypes.CDLL("libtracetools.so", mode=os.RTLD_NOLOAD)
        functions = {name: getattr(library, f"ros_trace_{name}") for name in wanted}
    except (OSError, AttributeError):
        return {}
    for name, function in functions.items():
        function.argtypes, function.restype = wanted[name], None
    return functions


def _traced(callback: Callable[..., None], emit: dict[str, Any]) -> Callable[..., None]:
    """A callback with its events; its handle is its address."""
    if not emit:
        return callback
    start, end = emit["callback_start"], emit["callback_end"]

    @functools.wraps(callback)  # rclpy looks how many arguments it takes
    def traced(*arguments: Any) -> None:
        start(handle, False)
        try:
            callback(*arguments)
        finally:
            end(handle)

    handle = id(traced)
    return traced


def _rmw_handle(subscription: Any) -> int:
    rcl = ctypes.CDLL("librcl.so", mode=os.RTLD_NOLOAD)
    rcl.rcl_subscription_get_rmw_handle.argtypes = (_POINTER,)
    rcl.rcl_subscription_get_rmw_handle.restype = _POINTER
    handle: int = rcl.rcl_subscription_get_rmw_handle(subscription.handle.pointer)
    return handle
