"""The event tables: their names, columns and units, whoever traced them.

They are the events of `ros2_tracing` (tracetools 8.x, Jazzy, `tracetools.h`) under their own names
and fields, and the kernel's `sched:sched_switch`. Every table has the columns of
:data:`COMMON_COLUMNS` followed by the event's own fields:

* ``time``: nanoseconds of CLOCK_MONOTONIC; with the recording's ``clock_offset_ns`` wall-clock
  time, which is what DDS source timestamps are.
* ``pid``, ``tid``: process and thread, as the kernel numbers them in the traced container.
* ``cpu``: the core, null where the source does not know it.

Handles (``*_handle``, ``callback``, ``message``, ``subscription``) are addresses: unique only
within one process and only until they are freed. Tables lack columns that their source cannot
know; a table that is missing altogether is the same as an empty one.
"""

from collections.abc import Iterable, Mapping
from typing import TypeAlias

import polars as pl

EventTables: TypeAlias = Mapping[str, pl.DataFrame]
"""One frame per event name, each sorted by ``time``."""

COMMON_COLUMNS: dict[str, pl.DataType] = {
    "time": pl.Int64(),
    "pid": pl.Int32(),
    "tid": pl.Int32(),
    "cpu": pl.Int32(),
}

_HANDLE = _COUNT = pl.UInt64()
_NUMBER = pl.Int32()
_NAME = pl.String()
_NANOSECONDS = pl.Int64()

# fmt: off
FIELDS: dict[str, dict[str, pl.DataType]] = {
    # Who exists: emitted once per object, in this order of dependence.
    "rcl_init": {"context_handle": _HANDLE, "version": _NAME},
    "rcl_node_init": {
        "node_handle": _HANDLE, "rmw_handle": _HANDLE, "node_name": _NAME, "namespace": _NAME,
    },
    "rmw_publisher_init": {"rmw_publisher_handle": _HANDLE, "gid": pl.List(pl.UInt8)},
    "rcl_publisher_init": {
        "publisher_handle": _HANDLE, "node_handle": _HANDLE, "rmw_publisher_handle": _HANDLE,
        "topic_name": _NAME, "queue_depth": _COUNT,
    },
    "rmw_subscription_init": {"rmw_subscription_handle": _HANDLE, "gid": pl.List(pl.UInt8)},
    "rcl_subscription_init": {
        "subscription_handle": _HANDLE, "node_handle": _HANDLE, "rmw_subscription_handle": _HANDLE,
        "topic_name": _NAME, "queue_depth": _COUNT,
    },
    "rclcpp_subscription_init": {"subscription_handle": _HANDLE, "subscription": _HANDLE},
    "rclcpp_subscription_callback_added": {"subscription": _HANDLE, "callback": _HANDLE},
    "rcl_service_init": {
        "service_handle": _HANDLE, "node_handle": _HANDLE, "rmw_service_handle": _HANDLE,
        "service_name": _NAME,
    },
    "rclcpp_service_callback_added": {"service_handle": _HANDLE, "callback": _HANDLE},
    "rcl_client_init": {
        "client_handle": _HANDLE, "node_handle": _HANDLE, "rmw_client_handle": _HANDLE,
        "service_name": _NAME,
    },
    "rmw_client_init": {"rmw_client_handle": _HANDLE, "gid": pl.List(pl.UInt8)},
    "rcl_timer_init": {"timer_handle": _HANDLE, "period": _NANOSECONDS},
    "rclcpp_timer_callback_added": {"timer_handle": _HANDLE, "callback": _HANDLE},
    "rclcpp_timer_link_node": {"timer_handle": _HANDLE, "node_handle": _HANDLE},
    "rclcpp_callback_register": {"callback": _HANDLE, "symbol": _NAME},
    "rcl_lifecycle_state_machine_init": {"node_handle": _HANDLE, "state_machine": _HANDLE},
    "rcl_lifecycle_transition": {
        "state_machine": _HANDLE, "start_label": _NAME, "goal_label": _NAME,
    },
    # What happens, again and again. Timestamps of messages are DDS source timestamps:
    # CLOCK_REALTIME, as the publisher wrote them.
    "callback_start": {"callback": _HANDLE, "is_intra_process": _NUMBER},
    "callback_end": {"callback": _HANDLE},
    "rclcpp_publish": {"message": _HANDLE},
    "rclcpp_intra_publish": {"publisher_handle": _HANDLE, "message": _HANDLE},
    "rcl_publish": {"publisher_handle": _HANDLE, "message": _HANDLE},
    "rmw_publish": {
        "rmw_publisher_handle": _HANDLE, "message": _HANDLE, "timestamp": _NANOSECONDS,
    },
    "rmw_take": {
        "rmw_subscription_handle": _HANDLE, "message": _HANDLE, "source_timestamp": _NANOSECONDS,
        "taken": _NUMBER,
    },
    "rcl_take": {"message": _HANDLE},
    "rclcpp_take": {"message": _HANDLE},
    # Calls of services, from tracetools 8.5 (Kilted) on; of all before only by our own library. A
    # call is known by its client and its number.
    "rmw_send_request": {
        "rmw_client_handle": _HANDLE, "request": _HANDLE, "sequence_number": pl.Int64(),
    },
    "rmw_take_request": {
        "rmw_service_handle": _HANDLE, "request": _HANDLE, "client_gid": pl.List(pl.UInt8),
        "sequence_number": pl.Int64(), "taken": _NUMBER,
    },
    "rmw_send_response": {
        "rmw_service_handle": _HANDLE, "response": _HANDLE, "client_gid": pl.List(pl.UInt8),
        "sequence_number": pl.Int64(), "timestamp": _NANOSECONDS,
    },
    "rmw_take_response": {
        "rmw_client_handle": _HANDLE, "response": _HANDLE, "sequence_number": pl.Int64(),
        "source_timestamp": _NANOSECONDS, "taken": _NUMBER,
    },
    # CARET (before Humble) instead of rmw_publish and rmw_take: the message that was written, the
    # DDS source timestamp it got, and the callback that the message with this stamp went to.
    "dds_write": {"message": _HANDLE},
    "dds_bind_addr_to_stamp": {"addr": _HANDLE, "source_stamp": _NANOSECONDS},
    "dispatch_subscription_callback": {
        "message": _HANDLE, "callback": _HANDLE, "source_stamp": _NANOSECONDS,
    },
    "rmw_implementation": {"rmw_impl": _NAME},
    # Intra-process communication: messages travel through ring buffers, not through DDS.
    "rclcpp_construct_ring_buffer": {"buffer": _HANDLE, "capacity": _COUNT},
    "rclcpp_buffer_to_ipb": {"buffer": _HANDLE, "ipb": _HANDLE},
    "rclcpp_ipb_to_subscription": {"ipb": _HANDLE, "subscription": _HANDLE},
    "rclcpp_ring_buffer_enqueue": {
        "buffer": _HANDLE, "index": _COUNT, "size": _COUNT, "overwritten": _NUMBER,
    },
    "rclcpp_ring_buffer_dequeue": {"buffer": _HANDLE, "index": _COUNT, "size": _COUNT},
    "rclcpp_ring_buffer_clear": {"buffer": _HANDLE},
    "rclcpp_executor_get_next_ready": {},
    "rclcpp_executor_wait_for_work": {"timeout": _NANOSECONDS},
    "rclcpp_executor_execute": {"handle": _HANDLE},
    "sched_switch": {
        "prev_comm": _NAME, "prev_tid": _NUMBER, "prev_prio": _NUMBER, "prev_state": pl.Int64(),
        "next_comm": _NAME, "next_tid": _NUMBER, "next_prio": _NUMBER,
    },
    # Ours, by the library in front of ROS 2: a timer was called, and its callback comes next; of
    # rclpy's no other event tells.
    "rcl_timer_call": {"timer_handle": _HANDLE},
    # Ours: what the shaping node decided, when a message of an asynchronous publisher really
    # left, and what the machine did to everybody.
    "gate_release": {  # `time` is the instant at which the gate let the message go
        "callback": _HANDLE,  # the shaping node's subscription callback
        "source_timestamp": _NANOSECONDS,  # of the message that the gate delayed
        "arrival": _NANOSECONDS,
        "origin": _NANOSECONDS,  # the anchor the slots were counted from
        # Planned; `time` minus this is the gate's own error. Null: it was never let go.
        "release": _NANOSECONDS,
        "slot": _NUMBER,  # null: in none
        "cycles_waited": _NUMBER,  # 0: in its own cycle
        "anchor": _NAME,  # "stamp", or "cycle" (also when a stamp was unusable)
    },
    "asynchronous_send": {  # `time` is when the publisher thread had the message in its hands
        "rmw_publisher_handle": _HANDLE,
        "timestamp": _NANOSECONDS,  # the DDS source timestamp of its `rmw_publish`
        # "sent"; "expired": older than its topic's lifespan; "overwritten": newer messages
        # had filled the history. The last two were never sent.
        "outcome": _NAME,
        "duration": _NANOSECONDS,  # of sending
    },
    # `time` is when the sleeper should have woken, `cpu` where it sleeps; how late it woke.
    "machine_stall": {"duration": _NANOSECONDS},
    # `time` is when a stretch of the sleeper's wake-ups began, on `cpu`; its duration, and the CPU
    # time of one wake-up in it. The work is the same each time: where it takes longer, the core
    # runs at a slower pace.
    "machine_pace": {"duration": _NANOSECONDS, "cpu_time": _NANOSECONDS},
}

OPTIONAL_FIELDS: dict[str, dict[str, pl.DataType]] = {
    # CPU time of the executing thread so far: where it is there, execution times need no
    # sched_switch.
    "callback_start": {"thread_time": _NANOSECONDS},
    "callback_end": {"thread_time": _NANOSECONDS},
    "rmw_take_request": {"source_timestamp": _NANOSECONDS},  # of the request; of our own library
    # Not 0: a thread of its own sends what this publisher gets (`asynchronous_send`).
    "rcl_publisher_init": {"asynchronous": _NUMBER},
    "gate_release": {
        # Null: the message came in time; otherwise what was done about the overrun, "wait",
        # "discard" or "publish", or about a message behind its mode's slot, also "next-slot".
        # "bypass" and "silence" are a standby's: it published the message at once, or did not,
        # because no shaping node was there. Recordings from before there was a choice lack it.
        "overrun": _NAME,
        "mode": _NAME,  # of the message's cycle; null: the gate knows no modes
        # Null: it left, or the recording is from before messages could wait. "replaced" by a newer
        # one of its cycle, "surplus" behind the first one of it, "overflowed" where newer ones
        # needed the room, "discarded" as an overrun.
        "dropped": _NAME,
        "published": _NANOSECONDS,  # when publishing returned, in the log of a ROS 2 node
        # For how long behind the release neither the gate nor any other thread ran on its core,
        # in the same log: what the machine itself took.
        "stalled": _NANOSECONDS,
        # In the same log: how many messages DDS lost between the one before and this one (null:
        # not known), and the number of the row since the node started. Rows that are missing
        # could not be written, or were in a file that has been removed since.
        "lost": pl.Int64(),
        "row": pl.Int64(),
        # By how much the slots of the cycle in which it leaves are moved from where the plan has
        # them; null: the recording is from before slots could follow the latencies.
        "moved": _NANOSECONDS,
        "gate": _NAME,  # the shaping node's name, in its log; one process may have several gates
    },
}
# fmt: on

VERSION_FIELDS = {
    "rmw_publish": {"rmw_publisher_handle", "timestamp"},  # since Jazzy
    "rmw_take": {"taken"},
    "rmw_take_request": {"taken"},  # nor has our own library, which sees no others
    "rmw_take_response": {"taken"},
    "rmw_send_response": {"timestamp"},
    "callback_start": {"is_intra_process"},
    "rclcpp_ring_buffer_enqueue": {"overwritten"},
    "dispatch_subscription_callback": {"source_stamp"},
}
"""Fields that not every version has, and that the analysis asks for as such."""

_CREATION_ENDINGS = ("_init", "_added", "_register", "_link_node", "_to_ipb", "_to_subscription")
CREATION = frozenset(name for name in FIELDS if name.endswith(_CREATION_ENDINGS)) | {
    *("rmw_implementation", "rclcpp_construct_ring_buffer", "rcl_lifecycle_transition")
}
"""The events of objects' creation, and changes of their state, which all others depend on."""
NODE_NAME = pl.col("namespace").fill_null("").str.strip_chars_end("/") + "/" + pl.col("node_name")
"""The full name of the node that a row of `rcl_node_init` is about: ``/front/filter``."""


def happened(tables: EventTables, since_ns: int, until_ns: int | None = None) -> EventTables:
    """The events of a time, those of gates by when the cycle began; and all objects' creation."""
    found = dict(tables)
    for name, frame in tables.items():
        if name not in CREATION:
            begun = pl.min_horizontal("time", *{"origin"}.intersection(frame.columns))
            ended = pl.lit(False) if until_ns is None else pl.col("time") >= until_ns
            found[name] = frame.filter((begun >= since_ns) & ~ended)
    return found


def empty(name: str) -> pl.DataFrame:
    """An empty table with all columns of event ``name``."""
    return pl.DataFrame(schema={**COMMON_COLUMNS, **FIELDS[name]})


def table(tables: EventTables, name: str, columns: Iterable[str] = ()) -> pl.DataFrame:
    """The table of event ``name``, empty when absent, with ``columns``, null if unknown."""
    frame, known = tables[name] if name in tables else empty(name), column_types(name)
    nulls = [pl.lit(None, known[one]).alias(one) for one in columns if one not in frame.columns]
    return frame.with_columns(nulls) if nulls else frame


def column_types(name: str) -> dict[str, pl.DataType]:
    """Every column that a table of event ``name`` may have; of others only the common ones."""
    own = {**FIELDS.get(name, {}), **OPTIONAL_FIELDS.get(name, {})}
    return {**COMMON_COLUMNS, **own} if name in FIELDS else {"time": COMMON_COLUMNS["time"]}


def column_problems(schema: Mapping[str, pl.DataType], name: str) -> list[str]:
    """What is wrong with the columns of a table of event ``name``, in words."""
    types = column_types(name)
    optional = {"cpu", *OPTIONAL_FIELDS.get(name, ()), *VERSION_FIELDS.get(name, ())}
    problems = [
        f"an event table needs a column `{column}`, this one has none"
        for column in types
        if column not in schema and column not in optional
    ]
    problems += [
        f"column `{column}` has values of type {schema[column]}, not {kind}"
        for column, kind in types.items()
        if column in schema and not castable(schema[column], kind)
    ]
    return problems


def castable(found: pl.DataType | None, wanted: pl.DataType) -> bool:
    """Whether values can become those of a column: integers of another width can."""
    if isinstance(wanted, pl.List):
        return isinstance(found, pl.List | pl.Array) and found.inner.is_integer()
    if wanted.is_integer() and found is not None:
        return found.is_integer() or isinstance(found, pl.Null)
    return isinstance(found, pl.String | pl.Categorical | pl.Null)


def as_table(frame: pl.DataFrame, name: str) -> pl.DataFrame:
    """A frame with the types of its event's table. Raises PolarsError: a value does not fit."""
    if "cpu" not in frame.columns:
        frame = frame.with_columns(cpu=pl.lit(None, COMMON_COLUMNS["cpu"]))
    frame = frame.with_columns(
        pl.col(column).cast(kind, strict=True)
        for column, kind in column_types(name).items()
        if column in frame.columns
    )
    if frame["time"].null_count():
        raise pl.exceptions.InvalidOperationError("rows without a time")
    return frame
