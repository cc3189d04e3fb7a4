"""Serialized messages that tracers see on Humble as they do on later distributions.

Before Jazzy neither rcl nor rmw has trace points on the way of serialized messages, so that what a
Python node receives and republishes would be in no trace. The functions behind the trace points of
all other messages are exported, and called from here instead (ros2_tracing,
`tracetools/include/tracetools/tracetools.h`, 4.1.1; rcl, `rcl/subscription.h`).
"""

import ctypes
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.subscription import Subscription

__all__ = ["emit_takes", "publish_function", "take_event", "trace_points"]

_ADDRESS = ctypes.c_void_p
_MESSAGE_EVENTS = {
    "rcl_publish": (_ADDRESS, _ADDRESS),
    "rmw_publish": (_ADDRESS,),
    "rmw_take": (_ADDRESS, _ADDRESS, ctypes.c_int64, ctypes.c_bool),
}


def trace_points(wanted: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
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


def _missing_events() -> dict[str, Any]:
    """The functions by their events' names; none where rcl and rmw call them, or nobody can."""
    later_than_humble = hasattr(Subscription, "CallbackType")
    return {} if later_than_humble else trace_points(_MESSAGE_EVENTS)


def publish_function(publisher: Any) -> Callable[[bytes], None]:
    """`publisher.publish` for serialized messages, with its events."""
    emit = _missing_events()
    if not emit:
        publish: Callable[[bytes], None] = publisher.publish
        return publish
    handle = publisher.handle.pointer

    def with_events(payload: bytes) -> None:
        emit["rcl_publish"](handle, id(payload))
        emit["rmw_publish"](id(payload))
        publisher.publish(payload)

    return with_events


def emit_takes(subscription: Any) -> None:
    """Have a subscription to serialized messages emit the event of each that it takes.

    Humble's callbacks are not told the source timestamp. In its place stands the time of the call:
    the publication that the analysis looks for is the latest before.
    """
    emit = _missing_events()
    if not emit:
        return
    handle = _rmw_handle(subscription)
    callback = subscription.callback

    def with_event(payload: bytes) -> None:
        emit["rmw_take"](handle, id(payload), time.time_ns(), True)
        callback(payload)

    subscription.callback = with_event


def take_event(subscription: Any) -> Callable[[int | None], None]:
    """What emits the event of a take once more, when a callback is executed for its message.

    Others were taken meanwhile, and a callback is for the message that was taken last.
    """
    emit = {} if _missing_events() else trace_points(_MESSAGE_EVENTS)
    if not emit:
        return lambda _: None
    handle = _rmw_handle(subscription)
    return lambda source: emit["rmw_take"](handle, id(subscription), source or 0, True)


def _rmw_handle(subscription: Any) -> int:
    rcl = ctypes.CDLL("librcl.so", mode=os.RTLD_NOLOAD)
    rcl.rcl_subscription_get_rmw_handle.argtypes = (_ADDRESS,)
    rcl.rcl_subscription_get_rmw_handle.restype = _ADDRESS
    handle: int = rcl.rcl_subscription_get_rmw_handle(subscription.handle.pointer)
    return handle
