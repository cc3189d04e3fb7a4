"""The nodes' common part on the side of ROS 2, for rclpy of Humble to Rolling.

It has parameters, topics, trace points, real-time scheduling, and the log of a gate.
"""

import atexit
import ctypes
import fcntl
import functools
import gc
import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from rclpy import qos as policies
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from rclpy.utilities import get_rmw_implementation_identifier

from chainshaper.robot.clear_core import started_beside
from chainshaper.robot.gate import DEPTH
from chainshaper.robot.gate_log import LOG_COLUMNS
from chainshaper.robot.node_parameters import PARAMETERS, NodeParameters, parameters_from
from chainshaper.robot.shaper import READER_DEPTH
from chainshaper.robot.waiting import Outcome

HUMBLE = not hasattr(Subscription, "CallbackType")
"""On Humble a callback gets the message only, and serialized messages pass no trace points."""


def parameters_of(node: Node) -> NodeParameters:
    """Return a node's parameters: those of its file, and defaults for the rest."""
    return parameters_from(
        {
            name: node.get_parameter_or(name, Parameter(name, value=default)).value
            for name, (_, default) in PARAMETERS.items()
        }
    )


def delivery_core(server_cores: list[int]) -> int | None:
    """Return the core where DDS threads deliver the output.

    It is the first one that this process may use and that has no server. None: the plan names no
    server's core, because it leaves receivers alone; or the middleware is Fast DDS before 2.13
    (Jazzy), whose threads have no names, so they get no priority, and would wait while the core is
    cleared.
    """
    nameless = HUMBLE and get_rmw_implementation_identifier().startswith("rmw_fastrtps")
    usable = os.sched_getaffinity(0) - set(server_cores)
    return min(usable, default=None) if server_cores and not nameless else None


def wait(seconds: float) -> None:
    """Wait. Raises ExternalShutdownException: the process has to stop."""
    until = time.monotonic() + seconds
    while rclpy.ok() and (left := until - time.monotonic()) > 0:
        time.sleep(min(left, 0.05))
    if not rclpy.ok():
        raise ExternalShutdownException


def wait_for_publisher(node: Node, topic: str) -> Any:
    """Wait until a topic has a publisher; return that (`TopicEndpointInfo`)."""
    logger, name, is_reported = node.get_logger(), node.resolve_topic_name(topic), False
    while not (publishers := _typed_publishers(node, topic)):
        if not is_reported:
            logger.info(f"waiting for a publisher of {name}")
        is_reported = True
        wait(0.01)
    first = publishers[0]
    if len(publishers) > 1:
        logger.warning(f"{name} has {len(publishers)} publishers: the QoS of the first is copied")
    node_name = f"{first.node_namespace.rstrip('/')}/{first.node_name}"
    logger.info(f"{name} is published by {node_name} as {first.topic_type}")
    return first


def _typed_publishers(node: Node, topic: str) -> list[Any]:
    """Return the publishers of a topic whose type discovery knows already."""
    return [info for info in node.get_publishers_info_by_topic(topic) if info.topic_type]


def message_class(type_name: str) -> Any:
    """Return the class of a type such as ``sensor_msgs/msg/Image``, which rclpy needs."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def offered_by(info: Any, node: Node) -> QoSProfile:
    """Return the quality of service of a publisher, for the publisher in its place.

    Discovery does not know everything. For what is unknown, the usual value is assumed, and a
    history that keeps the last ``output_depth`` messages.
    """
    offered = info.qos_profile
    copied = ("lifespan", "deadline", "liveliness_lease_duration")
    values = {name: getattr(offered, name) for name in copied}
    for name, kind, exception, usual in (
        ("history", policies.QoSHistoryPolicy, "KEEP_ALL", "KEEP_LAST"),
        ("reliability", policies.QoSReliabilityPolicy, "BEST_EFFORT", "RELIABLE"),
        ("durability", QoSDurabilityPolicy, "TRANSIENT_LOCAL", "VOLATILE"),
        ("liveliness", policies.QoSLivelinessPolicy, "MANUAL_BY_TOPIC", "AUTOMATIC"),
    ):
        is_exception = getattr(offered, name) == kind[exception]
        values[name] = kind[exception if is_exception else usual]
    return QoSProfile(depth=offered.depth or parameters_of(node).output_depth, **values)


def asked_of(offered: QoSProfile, depth: int = 0) -> QoSProfile:
    """Return the QoS of a subscription to a publisher: its history, reliability and durability."""
    return QoSProfile(
        history=offered.history,
        depth=depth or offered.depth,
        reliability=offered.reliability,
        durability=offered.durability,
    )


def room_of(node: Node, info: Any) -> tuple[int, QoSProfile, QoSProfile]:
    """Return how many messages may wait at a topic's gate, and the QoS of its output and input."""
    offered = offered_by(info, node)
    depth = parameters_of(node).depth or max(DEPTH, offered.depth)
    if offered.durability != QoSDurabilityPolicy.TRANSIENT_LOCAL:
        # The writer needs room for all messages that leave in one slot.
        offered.depth = max(offered.depth, depth)
    return depth, offered, asked_of(offered, max(READER_DEPTH, depth))


def become_realtime(node: Node) -> None:
    """Lock the memory, and give the calling thread its core and SCHED_FIFO priority, as permitted.

    To be called when all endpoints exist: new threads inherit the core, and threads of DDS must
    not. (They do not inherit the priority.)
    """
    parameters = parameters_of(node)
    core, priority = parameters.core, parameters.fifo_priority

    def warn(problem: str, remedy: str) -> None:
        node.get_logger().warning(f"{problem}; it works on without: {remedy}")

    if ctypes.CDLL(None).mlockall(1 | 2):  # MCL_CURRENT | MCL_FUTURE
        warn("memory cannot be locked", "give the user a memlock limit of unlimited")
    try:
        if priority > 0:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        remedy = "give the user an rtprio limit of 98, or the container cpu.rt_runtime_us"
        warn(f"SCHED_FIFO is refused: {error.strerror}", remedy)
    try:
        if core >= 0:
            os.sched_setaffinity(0, {core})
    except OSError as error:
        warn(f"core {core} is refused: {error.strerror}", "name another in the plan")
    gc.collect()
    gc.freeze()
    gc.disable()


def run(name: str, set_up: Callable[[Node], Callable[[], bool]], *, realtime: bool = True) -> None:
    """Run a node until it is interrupted.

    ``set_up`` makes the node's endpoints and returns a function, which is called behind each
    callback; that returns True to be called again before another message comes.
    """
    signal.signal(signal.SIGINT, interrupt_once)
    rclpy.init()
    # The parameter file declares the parameters.
    node = Node(name, automatically_declare_parameters_from_overrides=True)
    try:
        work_off = set_up(node)
        if realtime:
            become_realtime(node)
        executor = rclpy.get_global_executor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=0 if work_off() else None)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ValueError, OSError, ImportError) as error:
        node.get_logger().fatal(str(error))
        sys.exit(1)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # also where rclpy alone has seen the first
        node.destroy_node()
        with suppress(RuntimeError):  # rclpy's thread for signals does so now; Zenoh takes its time
            rclpy.try_shutdown()


def interrupt_once(number: int, _frame: object) -> None:
    """Raise KeyboardInterrupt for the first Ctrl-C only, so that none interrupts its handling.

    It reaches a node from its terminal, and then again from `ros2 launch`.
    """
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


# Trace points ------------------------------------------------------------------------------------
#
# rclpy has none, and before Jazzy neither rcl nor rmw has any on the way of serialized messages.
# The functions behind them are exported by a library that rcl has loaded into this process
# (upstream: ros2_tracing, `tracetools/tracetools.h`; rcl, `rcl/subscription.h`). Called from here,
# which takes a microsecond, they make LTTng write its events and uprobes fire. Where that library
# is not loaded, or was built without tracing, no event is emitted.

_ARGUMENTS = {  # how many arguments each event has: integers, pointers or texts
    **{"rclcpp_subscription_init": 2, "rclcpp_subscription_callback_added": 2},
    **{"rclcpp_timer_callback_added": 2, "rclcpp_timer_link_node": 2},
    **{"rclcpp_callback_register": 2, "callback_start": 2, "callback_end": 1},
    **{"rcl_publish": 2, "rmw_publish": 1, "rmw_take": 4},
}


@functools.cache
def _events() -> dict[str, Any]:
    """Return the functions of all events; none where the library is not loaded, or lacks one.

    A library that LD_PRELOAD puts in front of that one is asked first, and hands events on.
    """
    functions: dict[str, Any] = {}
    for file in ("libtracetools.so", None):  # None: the whole process
        with suppress(OSError, AttributeError):
            library = ctypes.CDLL(file, mode=os.RTLD_NOLOAD)
            functions = {name: getattr(library, f"ros_trace_{name}") for name in _ARGUMENTS}
    for name, function in functions.items():
        function.argtypes, function.restype = (ctypes.c_void_p,) * _ARGUMENTS[name], None
    return functions


def emit(name: str, *values: int | bytes) -> None:
    """Emit an event."""
    if functions := _events():
        functions[name](*values)


def _traced(callback: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that emits its events; its handle is its address."""

    @functools.wraps(callback)  # rclpy inspects how many arguments a callback takes
    def traced(*arguments: Any) -> None:
        emit("callback_start", handle, False)
        try:
            callback(*arguments)
        finally:
            emit("callback_end", handle)

    # The library in front traces callbacks of rclpy that do not say this.
    vars(traced)["chainshaper_emits_events"] = True
    handle = id(traced)
    return traced


def take_event(subscription: Any) -> Callable[[int, int], None]:
    """Return a function that emits a take: of a message's address and source timestamp."""
    if not _events():
        return lambda *_: None
    handle_of = ctypes.CDLL("librcl.so", mode=os.RTLD_NOLOAD).rcl_subscription_get_rmw_handle
    handle_of.restype = ctypes.c_void_p
    handle = handle_of(ctypes.c_void_p(subscription.handle.pointer))
    return lambda message, source: emit("rmw_take", handle, message, source, True)


def create_subscription(
    node: Node,
    message_type: Any,
    topic: str,
    callback: Callable[..., None],
    qos: QoSProfile,
    *,
    raw: bool = False,
) -> Any:
    """Create a subscription (`Node.create_subscription`) that emits the events of rclcpp's.

    On Humble a raw one emits the event of each take, too. The source timestamp is not known there:
    the event has the time of the call in its place, or the time that the callback is given. The
    analysis takes the latest publication before it.
    """
    traced = _traced(callback)
    subscription = node.create_subscription(message_type, topic, traced, qos, raw=raw)
    emit("rclcpp_subscription_init", subscription.handle.pointer, id(subscription))
    emit("rclcpp_subscription_callback_added", id(subscription), id(traced))
    emit("rclcpp_callback_register", id(traced), callback.__qualname__.encode())
    if raw and HUMBLE:
        take, executed = take_event(subscription), subscription.callback

        def taken(payload: bytes, stamp: int | None = None) -> None:
            take(id(payload), time.time_ns() if stamp is None else stamp)
            executed(payload)

        vars(taken)["chainshaper_emits_events"] = True
        subscription.callback = taken
    return subscription


def create_timer(node: Node, period_ns: int, callback: Callable[[], None]) -> None:
    """Create a timer (`Node.create_timer`) on CLOCK_MONOTONIC that emits the events of rclcpp's."""
    traced, clock = _traced(callback), Clock(clock_type=ClockType.STEADY_TIME)
    # rclpy takes seconds and cuts off behind the nanosecond.
    timer = node.create_timer((period_ns + 0.5) / 1e9, traced, clock=clock)
    emit("rclcpp_timer_callback_added", timer.handle.pointer, id(traced))
    emit("rclcpp_timer_link_node", timer.handle.pointer, node.handle.pointer)
    emit("rclcpp_callback_register", id(traced), callback.__qualname__.encode())


def publish_function(publisher: Any) -> Callable[[bytes], None]:
    """Return a function that publishes serialized messages and emits the events of that."""
    publish: Callable[[bytes], None] = publisher.publish
    if not HUMBLE:
        return publish
    handle = publisher.handle.pointer

    def with_events(payload: bytes) -> None:
        emit("rcl_publish", handle, id(payload))
        emit("rmw_publish", id(payload))
        publish(payload)

    return with_events


# The log -----------------------------------------------------------------------------------------
#
# A process of its own writes the file, so that neither a slow disk nor a full one can delay the
# gate: the gate only puts a line into a pipe, and drops the line where the pipe is full. Lines that
# are in the pipe are written even if the gate is killed. Rows have numbers, which show what is
# missing. The owner of the folder may put a link in the file's place: it is not followed.

LOG_HEADER = f"{','.join(LOG_COLUMNS)}\n".encode()


def _write_rows(path: str, header: bytes, most_bytes: int) -> None:
    """Add the lines of standard input to a file until they end; never a part of a line.

    A file that would have more than half of ``most_bytes`` becomes ``….1``, in place of the one
    before it. A file that has been removed is made anew. Lines that cannot be written are missing.
    """
    import os
    import time

    def append(text: bytes) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        with os.fdopen(os.open(path, flags | os.O_NOFOLLOW, 0o644), "ab", 0) as file:
            state = os.fstat(file.fileno())
            if state.st_nlink > 1 or state.st_uid != os.geteuid():
                raise OSError  # another user has put a file in its place
            size = file.tell()
            if size <= len(header) or size + len(text) <= most_bytes // 2:
                whole = text if size else header + text
                try:
                    written = file.write(whole)
                except OSError:
                    written = 0
                if written < len(whole):
                    file.truncate(size)
                    raise OSError
                return
        os.replace(path, path + ".1")  # noqa: PTH105 - there is little to import here
        append(text)

    rest, received = b"", b"\n"
    while received:
        received = os.read(0, 1 << 16)
        lines, newline, rest = (rest + received).rpartition(b"\n")
        try:
            if newline:
                append(lines + newline)
        except OSError:
            time.sleep(1 if received else 0)  # what comes meanwhile is tried together


class GateLog:
    """The log of a gate, with a row for each message if it has a file, and counts of losses."""

    def __init__(self, node: Node) -> None:
        parameters = parameters_of(node)
        self._logger = node.get_logger()
        self._pipe: int | None = None
        self._process = f"{os.getpid()},{threading.get_native_id()}"
        self._rows = self._warned_ns = 0
        # Messages that were lost so far, by reason, and those that a warning has named.
        self._lost, self._reported = Counter[str](), Counter[str]()
        if parameters.log:
            self._start_writer(parameters.log, parameters.log_bytes)

    def _start_writer(self, path: str, most_bytes: int) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NONBLOCK
        try:
            with os.fdopen(os.open(path, flags | os.O_NOFOLLOW, 0o644), "ab", 0) as file:
                state = os.fstat(file.fileno())
                if state.st_nlink > 1 or state.st_uid != os.geteuid():
                    raise PermissionError(0, "it is not a file of this user's alone")
                file.write(b"" if file.tell() else LOG_HEADER)
        except OSError as error:
            self._logger.warning(f"no log is written to {path}: {error.strerror}")
        writer, self._pipe = started_beside(_write_rows, path, LOG_HEADER, most_bytes)
        os.set_blocking(self._pipe, False)
        with suppress(OSError):  # more than a user may have
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, 1 << 20)
        atexit.register(self._end, writer)

    def _end(self, writer: "subprocess.Popen[bytes]") -> None:
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None
        with suppress(subprocess.TimeoutExpired):
            writer.wait(2)

    def write(
        self, outcome: Outcome, published: int | None = None, stalled: int | None = None
    ) -> None:
        """Note what became of a message.

        * ``published``: when publishing returned (ns of CLOCK_MONOTONIC); None: it was dropped.
        * ``stalled``: for how long the machine stood still behind the release (ns); None: unknown.
        """
        release, message = outcome.release, outcome.message
        self._rows += 1
        if release.dropped is not None:
            self._lost[release.dropped] += 1
        if message.lost:
            self._lost["lost by DDS"] += message.lost
        if self._pipe is not None:
            core = next(iter(os.sched_getaffinity(0)))
            values = (  # of LOG_COLUMNS, in their order
                *(outcome.awake_ns, self._process, core, message.about, message.arrival_ns),
                *(release.origin_ns, release.at_ns, release.slot, release.cycles_waited),
                *(release.anchor, release.overrun, release.mode, published, stalled),
                *(release.dropped, message.lost, self._rows, release.moved_ns),
            )
            line = ",".join("" if value is None else str(value) for value in values) + "\n"
            try:
                os.write(self._pipe, line.encode())
            except OSError:
                self._lost["not in the log"] += 1
        now = time.monotonic_ns()
        warned_lately = self._warned_ns and now - self._warned_ns < 10_000_000_000
        if self._lost == self._reported or warned_lately:
            return
        self._warned_ns, self._reported = now, self._lost.copy()
        lost = ", ".join(f"{count} {reason}" for reason, count in self._lost.items())
        self._logger.warning(f"of {self._rows} messages so far: {lost}")
