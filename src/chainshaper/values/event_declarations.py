"""Every event that a recording can have: its fields, their types, and where tracers find them.

An event is declared here once. The columns of its table (:mod:`.events`), the list of events in the
tracing library (`sources/preload`), the arguments that uprobes read (`sources/ebpf`), and what is
decoded together from an LTTng trace (`sources/lttng`) are derived from its declaration.

The events are those of `ros2_tracing` (tracetools 8.x, Jazzy, `tracetools.h`) and of CARET under
their own names and fields, the kernel's `sched:sched_switch`, and ours. This module imports the
standard library only: the tracing library's list is made from it when chainshaper is built.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

FieldKind: TypeAlias = Literal[
    "address",  # of an object in the traced process; 64 bits, unsigned
    "count",  # 64 bits, unsigned
    "nanoseconds",  # 64 bits, signed
    "instant",  # ns of CLOCK_MONOTONIC; 0 or less: none
    "number",  # 64 bits, signed
    "small number",  # 32 bits, signed
    "thread",  # the kernel's number of one; 0: a core's idle thread
    "real",  # a floating-point number of 64 bits
    "flag",  # 0 or 1: of a C `bool` in a register, only the lowest byte is defined
    "text",
    "gid",  # bytes of a DDS or RMW identifier
]

Presence: TypeAlias = Literal["always", "some versions", "optional"]
"""Whether tables have a field.

"always": a table without it is damaged. "some versions": not every version of the tracer knows it,
and the analysis asks for it as such. "optional": an addition of ours that is no part of the event;
an empty table has no such column.
"""

EventGroup: TypeAlias = Literal["creation", "messages", "upper layers", "executor", "switches"]
"""Events that are used together, and so decoded together.

"creation": objects are created, or change their state; all other events depend on these, and a
window of time never leaves them out. "messages": callbacks and messages. "upper layers": the same
messages as rcl and rclcpp see them. "executor": how an executor waits and chooses. "switches": the
kernel's context switches.
"""


@dataclass(frozen=True)
class EventField:
    """One field of an event, which is one column of its table.

    * ``name``: as the tracer calls it.
    * ``kind``: what the values are.
    * ``argument``: which argument of `ros_trace_<event>` it is, from 0; None: it is none.
    * ``presence``: whether all tables have it.
    * ``record_place``: which of a record's six values it is (of a gid: the first of two), where the
      tracing library finds it elsewhere than among the arguments.
    """

    name: str
    kind: FieldKind
    argument: int | None = None
    presence: Presence = "always"
    record_place: int | None = None


@dataclass(frozen=True)
class Event:
    """One event.

    * ``name``: the table's name; the function that emits it is `ros_trace_<name>`.
    * ``group``: what it is used with.
    * ``fields``: in the order of the columns.
    * ``recorded_by_library``: how the tracing library in front of ROS 2 (`preload.c`) learns of it.
      "arguments": from the call of `ros_trace_<name>`. "service call": from rcl's call of
      `<name>` in rmw, of whose data it records what ``record_place`` says. "no": not at all.
    * ``fields_before_8``: the fields that are arguments before tracetools 8 (Jazzy), where these
      differ.
    """

    name: str
    group: EventGroup
    fields: tuple[EventField, ...]
    recorded_by_library: Literal["arguments", "service call", "no"] = "no"
    fields_before_8: tuple[EventField, ...] | None = None

    def fields_of_version(self, tracetools_major: int) -> tuple[EventField, ...]:
        """Return the fields that this major version of tracetools passes as arguments."""
        if tracetools_major < 8 and self.fields_before_8 is not None:
            return self.fields_before_8
        return self.fields

    def place_in_record(self, field: EventField) -> int | None:
        """Return the place of a field in a record of the library's memory; None: it has none."""
        if self.recorded_by_library == "service call" or field.argument is None:
            return field.record_place
        return field.argument


# Objects are created: each event once per object, in this order of dependence.
_OBJECTS = (
    Event(
        "rcl_init",
        "creation",
        (
            EventField("context_handle", "address", 0),
            EventField("version", "text"),  # the library's own; tracers read its `package.xml`
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_node_init",
        "creation",
        (
            EventField("node_handle", "address", 0),
            EventField("rmw_handle", "address", 1),
            EventField("node_name", "text", 2),
            EventField("namespace", "text", 3),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rmw_publisher_init",
        "creation",
        (
            EventField("rmw_publisher_handle", "address", 0),
            EventField("gid", "gid", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_publisher_init",
        "creation",
        (
            EventField("publisher_handle", "address", 0),
            EventField("node_handle", "address", 1),
            EventField("rmw_publisher_handle", "address", 2),
            EventField("topic_name", "text", 3),
            EventField("queue_depth", "count", 4),
            # Ours: not 0 where a thread of the publisher sends what it is given
            # (`asynchronous_send`).
            EventField("asynchronous", "small number", presence="optional"),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rmw_subscription_init",
        "creation",
        (
            EventField("rmw_subscription_handle", "address", 0),
            EventField("gid", "gid", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_subscription_init",
        "creation",
        (
            EventField("subscription_handle", "address", 0),
            EventField("node_handle", "address", 1),
            EventField("rmw_subscription_handle", "address", 2),
            EventField("topic_name", "text", 3),
            EventField("queue_depth", "count", 4),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_subscription_init",
        "creation",
        (
            EventField("subscription_handle", "address", 0),
            EventField("subscription", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_subscription_callback_added",
        "creation",
        (
            EventField("subscription", "address", 0),
            EventField("callback", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_service_init",
        "creation",
        (
            EventField("service_handle", "address", 0),
            EventField("node_handle", "address", 1),
            EventField("rmw_service_handle", "address", 2),
            EventField("service_name", "text", 3),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_service_callback_added",
        "creation",
        (
            EventField("service_handle", "address", 0),
            EventField("callback", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_client_init",
        "creation",
        (
            EventField("client_handle", "address", 0),
            EventField("node_handle", "address", 1),
            EventField("rmw_client_handle", "address", 2),
            EventField("service_name", "text", 3),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rmw_client_init",
        "creation",
        (
            EventField("rmw_client_handle", "address", 0),
            EventField("gid", "gid", 1),
        ),
    ),
    Event(
        "rcl_timer_init",
        "creation",
        (
            EventField("timer_handle", "address", 0),
            EventField("period", "nanoseconds", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_timer_callback_added",
        "creation",
        (
            EventField("timer_handle", "address", 0),
            EventField("callback", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_timer_link_node",
        "creation",
        (
            EventField("timer_handle", "address", 0),
            EventField("node_handle", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_callback_register",
        "creation",
        (
            EventField("callback", "address", 0),
            EventField("symbol", "text", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_lifecycle_state_machine_init",
        "creation",
        (
            EventField("node_handle", "address", 0),
            EventField("state_machine", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_lifecycle_transition",  # not created, but a state that what follows depends on
        "creation",
        (
            EventField("state_machine", "address", 0),
            EventField("start_label", "text", 1),
            EventField("goal_label", "text", 2),
        ),
        recorded_by_library="arguments",
    ),
)

# Callbacks run and messages move. Timestamps of messages are DDS source timestamps: CLOCK_REALTIME,
# as the publisher wrote them.
_CALLBACKS_AND_MESSAGES = (
    Event(
        "callback_start",
        "messages",
        (
            EventField("callback", "address", 0),
            EventField("is_intra_process", "flag", 1, "some versions"),
            # Ours: the CPU time of the executing thread so far. Where it is there, execution times
            # need no `sched_switch`.
            EventField("thread_time", "nanoseconds", presence="optional", record_place=2),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "callback_end",
        "messages",
        (
            EventField("callback", "address", 0),
            EventField("thread_time", "nanoseconds", presence="optional", record_place=2),  # ours
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_publish",
        "upper layers",
        (EventField("message", "address", 1),),  # argument 0, the publisher, is mostly null
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_intra_publish",
        "messages",
        (
            EventField("publisher_handle", "address", 0),
            EventField("message", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_publish",
        "upper layers",
        (
            EventField("publisher_handle", "address", 0),
            EventField("message", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rmw_publish",
        "messages",
        (
            EventField("rmw_publisher_handle", "address", 0, "some versions"),
            EventField("message", "address", 1),
            EventField("timestamp", "nanoseconds", 2, "some versions"),
        ),
        recorded_by_library="arguments",
        fields_before_8=(EventField("message", "address", 0),),
    ),
    Event(
        "rmw_take",
        "messages",
        (
            EventField("rmw_subscription_handle", "address", 0),
            EventField("message", "address", 1),
            EventField("source_timestamp", "nanoseconds", 2),
            EventField("taken", "flag", 3, "some versions"),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rcl_take",
        "upper layers",
        (EventField("message", "address", 0),),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_take",
        "upper layers",
        (EventField("message", "address", 0),),
        recorded_by_library="arguments",
    ),
)

# Services are called. ros2_tracing has these events from tracetools 8.5 (Kilted) on; before, only
# our tracing library knows of calls. A call is known by its client and its number. Where `taken` is
# missing the call was taken: our library records no others.
_SERVICE_CALLS = (
    Event(
        "rmw_send_request",
        "messages",
        (
            EventField("rmw_client_handle", "address", 0, record_place=0),
            EventField("request", "address", 1, record_place=1),
            EventField("sequence_number", "number", 2, record_place=4),
        ),
        recorded_by_library="service call",
    ),
    Event(
        "rmw_take_request",
        "messages",
        (
            EventField("rmw_service_handle", "address", 0, record_place=0),
            EventField("request", "address", 1, record_place=1),
            EventField("client_gid", "gid", 2, record_place=2),
            EventField("sequence_number", "number", 3, record_place=4),
            EventField("taken", "flag", 4, "some versions"),
            # Ours: of requests, our library alone knows it.
            EventField("source_timestamp", "nanoseconds", presence="optional", record_place=5),
        ),
        recorded_by_library="service call",
    ),
    Event(
        "rmw_send_response",
        "messages",
        (
            EventField("rmw_service_handle", "address", 0, record_place=0),
            EventField("response", "address", 1, record_place=1),
            EventField("client_gid", "gid", 2, record_place=2),
            EventField("sequence_number", "number", 3, record_place=4),
            EventField("timestamp", "nanoseconds", 4, "some versions"),
        ),
        recorded_by_library="service call",
    ),
    Event(
        "rmw_take_response",
        "messages",
        (
            EventField("rmw_client_handle", "address", 0, record_place=0),
            EventField("response", "address", 1, record_place=1),
            EventField("sequence_number", "number", 2, record_place=4),
            EventField("source_timestamp", "nanoseconds", 3, record_place=5),
            EventField("taken", "flag", 4, "some versions"),
        ),
        recorded_by_library="service call",
    ),
)

# CARET's own.
_CARET = (
    # Before Humble, instead of `rmw_publish` and `rmw_take`: the message that was written, the DDS
    # source timestamp it got, and the callback that the message with this stamp went to.
    Event("dds_write", "messages", (EventField("message", "address", 0),)),
    Event(
        "dds_bind_addr_to_stamp",
        "messages",
        (
            EventField("addr", "address", 0),
            EventField("source_stamp", "nanoseconds", 1),
        ),
    ),
    Event(
        "dispatch_subscription_callback",
        "messages",
        (
            EventField("message", "address", 0),
            EventField("callback", "address", 1),
            EventField("source_stamp", "nanoseconds", 2, "some versions"),
        ),
    ),
    Event("rmw_implementation", "creation", (EventField("rmw_impl", "text", 0),)),
    # About messages within a process, before there were ring buffers (its first version had the
    # shorter name): `rclcpp_intra_publish` hands a message over, which may be copied, and the
    # dispatch gives it, or its copy, to the callback.
    Event(
        "message_construct",
        "messages",
        (
            EventField("original_message", "address", 0),
            EventField("constructed_message", "address", 1),
        ),
    ),
    Event(
        "dispatch_intra_process_subscription_callback",
        "messages",
        (
            EventField("message", "address", 0),
            EventField("callback", "address", 1),
        ),
    ),
    Event(
        "dispatch_intra_process",
        "messages",
        (
            EventField("message", "address", 0),
            EventField("callback", "address", 1),
        ),
    ),
)

# Intra-process communication: messages travel through ring buffers, not through DDS.
_RING_BUFFERS = (
    Event(
        "rclcpp_construct_ring_buffer",
        "creation",
        (
            EventField("buffer", "address", 0),
            EventField("capacity", "count", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_buffer_to_ipb",
        "creation",
        (
            EventField("buffer", "address", 0),
            EventField("ipb", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_ipb_to_subscription",
        "creation",
        (
            EventField("ipb", "address", 0),
            EventField("subscription", "address", 1),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_ring_buffer_enqueue",
        "messages",
        (
            EventField("buffer", "address", 0),
            EventField("index", "count", 1),
            EventField("size", "count", 2),
            EventField("overwritten", "flag", 3, "some versions"),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_ring_buffer_dequeue",
        "messages",
        (
            EventField("buffer", "address", 0),
            EventField("index", "count", 1),
            EventField("size", "count", 2),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "rclcpp_ring_buffer_clear",
        "messages",
        (EventField("buffer", "address", 0),),
        recorded_by_library="arguments",
    ),
)

# An executor waits and chooses. Our library leaves out the first two, which are some 100,000 a
# second.
_EXECUTOR = (
    Event("rclcpp_executor_get_next_ready", "executor", ()),
    Event("rclcpp_executor_wait_for_work", "executor", (EventField("timeout", "nanoseconds", 0),)),
    Event(
        "rclcpp_executor_execute",
        "executor",
        (EventField("handle", "address", 0),),
        recorded_by_library="arguments",
    ),
)

# The kernel changes the thread that runs on a core. `prev_state` is what the thread before is now;
# 0: it can run, and was pre-empted.
_SWITCHES = (
    Event(
        "sched_switch",
        "switches",
        (
            EventField("prev_comm", "text"),
            EventField("prev_tid", "thread"),
            EventField("prev_prio", "small number"),
            EventField("prev_state", "number"),
            EventField("next_comm", "text"),
            EventField("next_tid", "thread"),
            EventField("next_prio", "small number"),
        ),
    ),
)

# The functions by which a loop's thread sleeps, by the numbers in `thread_sleep` and `thread_wake`.
SLEEPING_CALLS = (
    "none",  # of `thread_wake`: the thread did not sleep; its sleeps are recorded from here on
    "clock_nanosleep",
    "nanosleep",
    "pthread_cond_timedwait",
    "pthread_cond_clockwait",
    "poll",  # and ppoll
    "epoll_wait",  # and epoll_pwait, epoll_pwait2
    "select",  # and pselect; `time.sleep` of Python before 3.11
    "timerfd",  # read of a timer's file
    "rmw_wait",  # an executor waits for work, in a thread that publishes outside callbacks
    "pthread_cond_wait",  # without a time: another thread paces it
)

# Why what is added to the sleeps of a loop has changed, by the numbers in `loop_moved`.
LOOP_MOVES = (
    "asked",  # added to one sleep, to see whether the loop's own instants move with it
    "kept",  # they do not move: it is added to each sleep
    "followed",  # they follow from when the sleep ended: it was added to one sleep
    "rate changed",  # the loop left instances out: nothing is added any more
    "over",  # the process that had it moved does not ask any more
)

# The functions of `controller_manager::ControllerManager` that ros2_control's loop calls in each of
# its turns, by the numbers in `controller_manager_call`.
MANAGER_FUNCTIONS = ("read", "update", "write")

# What a coroutine did, by the numbers in `coroutine_step`.
COROUTINE_STATES = (
    "begins",  # to run, on the event's thread
    "runs",  # from here on, after it waited
    "waits",  # and gives its thread back
    "done",
    "created",  # a task, in the callback that then runs: it is run later
)

_OURS = (
    # The library in front met rclpy: its callbacks emit events from here on.
    Event(
        "rclpy_followed",
        "creation",
        (EventField("problem", "text", 0),),  # which ones do not, and why; empty: all do
        recorded_by_library="arguments",
    ),
    # A callback of rclpy that is neither a timer's nor a message's: that of a guard condition.
    Event(
        "rclpy_callback_added",
        "creation",
        (EventField("callback", "address", 0), EventField("node_handle", "address", 1)),
        recorded_by_library="arguments",
    ),
    # A callback of rclpy that is a coroutine gets a thread, or gives it back; or a task does, which
    # a callback created.
    Event(
        "coroutine_step",
        "messages",
        (
            EventField("callback", "address", 0),  # 0: a task
            EventField("call", "count", 1),  # which call of it, or which task, of its process
            EventField("thread_time", "nanoseconds", 2),
            EventField("state", "count", 3),  # place in COROUTINE_STATES
        ),
        recorded_by_library="arguments",
    ),
    # The user named a loop by its node, which was created in this process (`is_thread` 0), or by
    # the name of its thread, which is the event's `tid`.
    Event(
        "loop_named",
        "creation",
        (EventField("name", "text", 0), EventField("is_thread", "count", 1)),
        recorded_by_library="arguments",
    ),
    # A controller manager of ros2_control was called for the first time. It is a node.
    Event(
        "controller_manager_found",
        "creation",
        (EventField("manager", "address", 0), EventField("name", "text", 1)),  # empty: not known
        recorded_by_library="arguments",
    ),
    # A function of it returned. The tracing library emits it, which stands in front of the three.
    Event(
        "controller_manager_call",
        "messages",
        (
            EventField("manager", "address", 0),
            EventField("function", "count", 1),  # place in MANAGER_FUNCTIONS
            EventField("thread_time", "nanoseconds", 2),  # when it returned
            EventField("began", "instant", 3),
            EventField("thread_time_began", "nanoseconds", 4),
        ),
        recorded_by_library="arguments",
    ),
    # A thread goes to sleep for a time, outside callbacks, or wakes up from it: what lies between a
    # wake-up and the next sleep is an instance of a loop. The tracing library emits both, for
    # threads that publish or take outside callbacks, and for those that `record --loop` names.
    Event(
        "thread_sleep",
        "messages",
        (
            EventField("until", "instant", 0),  # 0: the call does not say it
            EventField("call", "count", 1),  # place in SLEEPING_CALLS
            EventField("thread_time", "nanoseconds", presence="optional", record_place=2),
        ),
        recorded_by_library="arguments",
    ),
    Event(
        "thread_wake",
        "messages",
        (
            EventField("call", "count", 0),
            EventField("thread_time", "nanoseconds", presence="optional", record_place=2),
        ),
        recorded_by_library="arguments",
    ),
    # The sleeps of a loop were moved, as another process asked (`move_loop`).
    Event(
        "loop_moved",
        "messages",
        (
            EventField("request", "count", 0),  # which one, from 1
            EventField("asked", "nanoseconds", 1),  # how much later than by itself it shall wake up
            EventField("added", "nanoseconds", 2),  # to this sleep, beside what was before
            EventField("kept", "nanoseconds", 3),  # what is added to each sleep from this one on
            EventField("why", "count", 4),  # place in LOOP_MOVES
        ),
        recorded_by_library="arguments",
    ),
    # A timer was called, and its callback comes next; of rclpy's timers no other event tells. The
    # tracing library emits it, which stands in front of rcl.
    Event(
        "rcl_timer_call",
        "messages",
        (EventField("timer_handle", "address", 0),),
        recorded_by_library="arguments",
    ),
    # The shaping node decided about a message. `time` is when the gate let the message go. Of the
    # optional fields, those from `published` to `row` are in the log of a ROS 2 node only;
    # recordings from before a field was there lack it.
    Event(
        "gate_release",
        "messages",
        (
            EventField("callback", "address"),  # that the message came to
            EventField("source_timestamp", "nanoseconds"),  # of the message; CLOCK_REALTIME
            EventField("arrival", "instant"),  # when the message came
            EventField("origin", "instant"),  # the cycle's beginning, from which slots count
            EventField("release", "instant"),  # when it was to leave; null: never
            EventField("slot", "small number"),  # in which it left, from 0; null: in none
            EventField("cycles_waited", "small number"),  # 0: it left in its own cycle
            EventField("anchor", "text"),  # of `origin`: "stamp", or "cycle" (no usable stamp too)
            # What the gate did about a message that was too late: "wait", "discard", "publish", or
            # "next-slot" behind its mode's slot. "bypass" and "silence" are a standby's: it
            # published at once, or did not, as no shaping node was there. Null: it came in time.
            EventField("overrun", "text", presence="optional"),
            # Of the message's cycle; null: the gate knows no modes.
            EventField("mode", "text", presence="optional"),
            # Why it never left: "replaced" by a newer one of its cycle, "surplus" behind the first
            # one of it, "overflowed" where newer ones needed the room, "discarded" as an overrun.
            # Null: it left.
            EventField("dropped", "text", presence="optional"),
            EventField("published", "instant", presence="optional"),  # publishing returned
            # For how long after the release neither the gate nor any other thread ran on its core,
            # since the machine itself stood still.
            EventField("stalled", "nanoseconds", presence="optional"),
            # How many messages DDS lost between the one before and this one; null: not known.
            EventField("lost", "number", presence="optional"),
            # Number of the row since the node started. Rows that are missing could not be written,
            # or were in a file that has been removed since.
            EventField("row", "number", presence="optional"),
            # By how much the slots of the cycle in which it leaves differ from the plan's.
            EventField("moved", "nanoseconds", presence="optional"),
            # The shaping node's name; one process may have several gates.
            EventField("gate", "text", presence="optional"),
        ),
    ),
    # The thread of an asynchronous publisher was done with a message. `time` is when it had taken
    # the message.
    Event(
        "asynchronous_send",
        "messages",
        (
            EventField("rmw_publisher_handle", "address"),
            EventField("timestamp", "nanoseconds"),  # that of the message's `rmw_publish`
            # "sent"; "expired": older than its topic's lifespan; "overwritten": newer messages had
            # filled the history. The last two were never sent.
            EventField("outcome", "text"),
            EventField("duration", "nanoseconds"),  # of sending
        ),
    ),
    # The machine stood still: a sleeper on core `cpu` woke up late. `time` is when it should have.
    Event("machine_stall", "messages", (EventField("duration", "nanoseconds"),)),  # how late
    # The plant of the live workload's control loop was sampled, or its input changed. `cost` is
    # what the time since the event before it cost: the integral of the loop's quadratic cost,
    # averaged over copies of the plant, expected from their states when that time began.
    Event(
        "plant_step",
        "messages",
        (
            EventField("step", "text"),  # "sampled"; "driven": the input of a sample arrived
            EventField("sample", "number"),  # its number in the run, from 0
            EventField("cost", "real"),
            EventField("output", "real"),  # the first one, of the first copy
            EventField("input", "real"),  # the same, from now on
        ),
    ),
    # The pace of core `cpu`, by the CPU time of a sleeper's wake-ups, whose work is the same each
    # time: where it takes longer, the core is slower. `time` is when a stretch of them began.
    Event(
        "machine_pace",
        "messages",
        (
            EventField("duration", "nanoseconds"),  # of the stretch
            EventField("cpu_time", "nanoseconds"),  # of one wake-up in it
        ),
    ),
    # Of a joint recording of several hosts: from `time` on, by the reference's clock, instants of a
    # host may truly have been so much earlier or later than they are recorded. No tracer emits it.
    # Its last row is of the last message that says anything about the host's clock.
    Event(
        "host_clock",
        "creation",
        (
            EventField("host", "small number"),  # its place in the recording's `hosts`
            EventField("earlier", "nanoseconds"),
            EventField("later", "nanoseconds"),
            # Share, in 1e-9, by which a span of the host's time may be longer or shorter.
            EventField("slack", "number"),
            # In which of its clock's pieces; -1: between two of them.
            EventField("piece", "small number"),
        ),
    ),
)

EVENTS: dict[str, Event] = {
    event.name: event
    for event in (
        *_OBJECTS,
        *_CALLBACKS_AND_MESSAGES,
        *_SERVICE_CALLS,
        *_CARET,
        *_RING_BUFFERS,
        *_EXECUTOR,
        *_SWITCHES,
        *_OURS,
    )
}
"""All events by name."""


def events_in_group(group: EventGroup) -> frozenset[str]:
    """Return the names of a group's events."""
    return frozenset(event.name for event in EVENTS.values() if event.group == group)


def events_of_library(declared: Iterable[Event] | None = None) -> tuple[Event, ...]:
    """Return the events that the tracing library in front of ROS 2 records, by their numbers.

    They are chosen from the ``declared`` events, which tests give; by default from all.
    """
    chosen = EVENTS.values() if declared is None else declared
    return tuple(event for event in chosen if event.recorded_by_library != "no")
