"""A stand-in for rclpy, where there is no ROS 2: as much of its API as the Python nodes use.

Built after rclpy of Jazzy. It receives and publishes lines of JSON on the standard streams, and
knows of the publishers that ``STAND_IN_PUBLISHERS`` describes, whom it discovers at the second
look. Its submodules, and the message packages, are this module under other names.
"""

import inspect
import json
import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from enum import Enum, IntEnum
from types import SimpleNamespace
from typing import Any

import yaml

# Addresses of rcl's objects: the last one fits into no 32 bits.
NODE, SUBSCRIPTION, PUBLISHER, TIMER = 0x1000, 0x2000, 0x4000, 0x7F0000003000

_running = [False]


class ExternalShutdownException(Exception):  # noqa: N818 - upstream's name
    """The process is to stop."""


def get_rmw_implementation_identifier() -> str:
    return os.environ.get("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")


QoSHistoryPolicy = IntEnum("QoSHistoryPolicy", "DEFAULT KEEP_LAST KEEP_ALL", start=0)
QoSReliabilityPolicy = IntEnum("QoSReliabilityPolicy", "DEFAULT RELIABLE BEST_EFFORT", start=0)
QoSDurabilityPolicy = IntEnum("QoSDurabilityPolicy", "DEFAULT TRANSIENT_LOCAL VOLATILE", start=0)
QoSLivelinessPolicy = IntEnum(
    "QoSLivelinessPolicy", "DEFAULT AUTOMATIC MANUAL_BY_NODE MANUAL_BY_TOPIC", start=0
)
ClockType = IntEnum("ClockType", "STEADY_TIME", start=3)


class _Record(SimpleNamespace):
    """Fields as they are given. Upstream checks those of a QoSProfile; the test does here."""


# Messages, of their packages, and what has fields only.
QoSProfile = Clock = SetParametersResult = DiagnosticStatus = KeyValue = String = _Record


def Parameter(name: str, *, value: Any) -> _Record:  # noqa: N802 - upstream's name
    return _Record(name=name, value=value)


class Subscription:
    """Upstream has the class inside since Iron."""

    if not os.environ.get("STAND_IN_HUMBLE"):

        class CallbackType(Enum):
            MESSAGE_ONLY = 0
            WITH_MESSAGE_INFO = 1


class DiagnosticArray:
    def __init__(self, status: list[_Record]) -> None:
        self.status, self.header = status, SimpleNamespace(stamp=None)


Image, Empty = type("Image", (), {}), type("Empty", (), {})


def _say(**what: Any) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def init() -> None:
    def stop(*_: object) -> None:
        _running[0] = False
        raise ExternalShutdownException

    _running[0] = True
    signal.signal(signal.SIGTERM, stop)
    # As upstream, it has handlers of its own, also where a shell's background job ignores Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def ok() -> bool:
    return _running[0]


def try_shutdown() -> None:
    _running[0] = False
    _say(event="shutdown")


_lines: deque[bytes | None] = deque()
_rest = [b""]


def _receive(timeout_s: float | None) -> None:
    """Wait for lines, unless there are some; None is their end."""
    while timeout_s is None and not _lines and not select.select([0], [], [], 0.1)[0]:
        pass  # a signal that comes right before the call ends none; upstream's ends its wait
    if not _lines and select.select([0], [], [], timeout_s)[0]:
        received = os.read(0, 1 << 16)
        *lines, _rest[0] = (_rest[0] + received).split(b"\n")
        _lines.extend(lines if received else [None])


class _Executor:
    """Gives each line to its subscription; timers expire between lines."""

    def add_node(self, node: "Node") -> None:
        self._node = node
        _say(event="spinning")

    def spin_once(self, timeout_sec: float | None) -> None:
        _receive(timeout_sec)
        if not _lines:
            return
        if (line := _lines.popleft()) is None:
            raise ExternalShutdownException
        node, message = self._node, json.loads(line)
        if "set" in message:
            name, value = message["set"]
            node.on_set([Parameter(name, value=value)])
        elif "tick" in message:
            for timer in node.timers:
                timer()
        else:
            subscription = node.subscriptions[message["topic"]]
            callback = subscription.callback
            taken = _taken(message) if subscription.raw else (String(data=message["data"]), {})
            informed = len(inspect.signature(callback).parameters) == 2
            callback(*taken[: 2 if informed and hasattr(Subscription, "CallbackType") else 1])


def get_global_executor() -> _Executor:
    return _Executor()


def _taken(message: dict[str, Any]) -> tuple[bytes, dict[str, Any]]:
    info = {} if message["source"] is None else {"source_timestamp": message["source"]}
    if "number" in message:
        info["publication_sequence_number"] = message["number"]
    return bytes.fromhex(message["payload"]), info


class _Handle(SimpleNamespace):
    """A subscription's own; what it takes is the next line, if that is a message of its topic."""

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def take_message(self, _: type, raw: bool) -> tuple[bytes, dict[str, Any]] | None:
        assert raw
        _receive(0)
        if not _lines or _lines[0] is None:
            return None
        message = json.loads(_lines[0])
        if message.get("topic") != self.topic:
            return None
        _lines.popleft()
        return _taken(message)


class Logger:
    def _log(self, text: str, **_: float) -> None:
        _say(log=text)

    info = warning = error = fatal = _log


class Publisher:
    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._word = "rehearsed" if topic.startswith("/_") else "published"
        self.handle = SimpleNamespace(pointer=PUBLISHER)

    def get_subscription_count(self) -> int:
        return 1

    def publish(self, payload: Any) -> None:
        if isinstance(payload, DiagnosticArray):
            (status,) = payload.status
            _say(diagnostics=status.name, level=status.level[0], message=status.message)
            return
        _say(**{self._word: self._topic}, payload=payload.hex(), time=time.monotonic_ns())


class Node:
    def __init__(self, _: str, *, automatically_declare_parameters_from_overrides: bool) -> None:
        assert automatically_declare_parameters_from_overrides
        words = sys.argv[1:]
        self._names = dict(word.split(":=") for word in words if ":=" in word)
        file = words[words.index("--params-file") + 1]
        with open(file, encoding="utf-8") as stream:  # noqa: PTH123
            self._parameters = yaml.safe_load(stream)["/**"]["ros__parameters"]
        self._publishers = json.loads(os.environ["STAND_IN_PUBLISHERS"])
        self._looks = 0
        self.subscriptions: dict[str, SimpleNamespace] = {}
        self.timers: list[Callable[[], None]] = []
        self.handle = SimpleNamespace(pointer=NODE)
        self.on_set: Callable[[list[Any]], object] = lambda _: None
        self.get_logger, self.count_subscribers = Logger, lambda _: 1
        self.get_clock = lambda: SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))
        self.destroy_node = lambda: None

    def get_parameter_or(self, name: str, otherwise: Any) -> Any:
        return Parameter(name, value=self._parameters.get(name, otherwise.value))

    def resolve_topic_name(self, topic: str) -> str:
        return str(self._names.get(topic, topic))

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        self._looks += 1
        found = self._publishers.get(self.resolve_topic_name(topic), [])
        node = {"node_name": "node5", "node_namespace": "/ns"}
        return [
            SimpleNamespace(**node, topic_type=info["type"], qos_profile=_Record(**info["qos"]))
            for info in (found if self._looks > 1 else [])
        ]

    def create_publisher(self, message_type: type, topic: str, qos: Any) -> Publisher:
        topic = self.resolve_topic_name(topic)
        if not topic.startswith("/_"):
            said = {"depth": qos} if isinstance(qos, int) else vars(qos)
            _say(publisher=topic, type=message_type.__name__, qos=said)
        return Publisher(topic)

    def create_subscription(
        self, message_type: type, topic: str, callback: Any, qos: Any, *, raw: bool = False
    ) -> SimpleNamespace:
        topic = self.resolve_topic_name(topic)
        _say(subscription=topic, type=message_type.__name__, qos=vars(qos), raw=raw)
        handle = _Handle(pointer=SUBSCRIPTION, topic=topic)
        subscription = SimpleNamespace(handle=handle, callback=callback, raw=raw)
        self.subscriptions[topic] = subscription
        return subscription

    def create_timer(
        self, seconds: float, callback: Callable[[], None], clock: Any = None
    ) -> SimpleNamespace:
        kind = None if clock is None else clock.clock_type
        _say(timer=seconds, clock=kind, time=time.monotonic_ns())
        self.timers.append(callback)
        return SimpleNamespace(handle=SimpleNamespace(pointer=TIMER))

    def add_on_set_parameters_callback(self, callback: Callable[..., object]) -> None:
        self.on_set = callback


for _name in (
    *("rclpy." + part for part in ("clock", "executors", "node", "parameter", "qos")),
    *("rclpy.subscription", "rclpy.utilities", "rcl_interfaces", "rcl_interfaces.msg"),
    *("std_msgs", "std_msgs.msg", "sensor_msgs", "sensor_msgs.msg"),
    *("diagnostic_msgs", "diagnostic_msgs.msg"),
):
    sys.modules[_name] = sys.modules[__name__]
