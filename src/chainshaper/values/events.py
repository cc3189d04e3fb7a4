"""The event tables: their names, columns and units, whoever traced them.

They are the events of `ros2_tracing` (tracetools 8.x, Jazzy, `tracetools.h`) under their own names
and fields, the kernel's `sched:sched_switch`, and ours. Every table has :data:`COMMON_COLUMNS`,
followed by the event's own fields: ``time``, nanoseconds of CLOCK_MONOTONIC (with the recording's
``clock_offset_ns`` wall-clock time, as DDS source timestamps are), process and thread, as the
kernel numbers them in the traced container, and the core, null where the source does not know it.

Handles (``*_handle``, ``callback``, ``message``, ``subscription``) are addresses: unique only
within one process and only until they are freed. Tables lack columns that their source cannot
know; a table that is missing altogether is the same as an empty one.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Protocol, TypeAlias, runtime_checkable

import polars as pl

EventTables: TypeAlias = Mapping[str, pl.DataFrame]
"""One frame per event name, each sorted by ``time``."""

COMMON_COLUMNS: dict[str, pl.DataType] = {
    "time": pl.Int64(),
    "pid": pl.Int32(),
    "tid": pl.Int32(),
    "cpu": pl.Int32(),
}

# fmt: off
_FIELDS_OF_TYPE: dict[pl.DataType, str] = {
    pl.String():
        "version node_name namespace topic_name service_name symbol start_label goal_label rmw_impl"
        " prev_comm next_comm anchor outcome overrun mode dropped gate",
    pl.Int32():
        "is_intra_process taken overwritten prev_tid prev_prio next_tid next_prio slot"
        " cycles_waited asynchronous",
    pl.Int64():  # nanoseconds, but for the last four
        "period timestamp source_timestamp source_stamp timeout arrival origin release duration"
        " cpu_time thread_time published stalled moved sequence_number prev_state lost row",
    pl.List(pl.UInt8): "gid client_gid",
}
_TYPES = {field: kind for kind, fields in _FIELDS_OF_TYPE.items() for field in fields.split()}
"""Of fields; all others are addresses or counts."""


def _typed(fields: Mapping[str, str]) -> dict[str, dict[str, pl.DataType]]:
    return {
        event: {field: _TYPES.get(field, pl.UInt64()) for field in own.split()}
        for event, own in fields.items()
    }


FIELDS = _typed({
    # Who exists: emitted once per object, in this order of dependence.
    "rcl_init": "context_handle version",
    "rcl_node_init": "node_handle rmw_handle node_name namespace",
    "rmw_publisher_init": "rmw_publisher_handle gid",
    "rcl_publisher_init":
        "publisher_handle node_handle rmw_publisher_handle topic_name queue_depth",
    "rmw_subscription_init": "rmw_subscription_handle gid",
    "rcl_subscription_init":
        "subscription_handle node_handle rmw_subscription_handle topic_name queue_depth",
    "rclcpp_subscription_init": "subscription_handle subscription",
    "rclcpp_subscription_callback_added": "subscription callback",
    "rcl_service_init": "service_handle node_handle rmw_service_handle service_name",
    "rclcpp_service_callback_added": "service_handle callback",
    "rcl_client_init": "client_handle node_handle rmw_client_handle service_name",
    "rmw_client_init": "rmw_client_handle gid",
    "rcl_timer_init": "timer_handle period",
    "rclcpp_timer_callback_added": "timer_handle callback",
    "rclcpp_timer_link_node": "timer_handle node_handle",
    "rclcpp_callback_register": "callback symbol",
    "rcl_lifecycle_state_machine_init": "node_handle state_machine",
    "rcl_lifecycle_transition": "state_machine start_label goal_label",
    # What happens, again and again. Timestamps of messages are DDS source timestamps:
    # CLOCK_REALTIME, as the publisher wrote them.
    "callback_start": "callback is_intra_process",
    "callback_end": "callback",
    "rclcpp_publish": "message",
    "rclcpp_intra_publish": "publisher_handle message",
    "rcl_publish": "publisher_handle message",
    "rmw_publish": "rmw_publisher_handle message timestamp",
    "rmw_take": "rmw_subscription_handle message source_timestamp taken",
    "rcl_take": "message",
    "rclcpp_take": "message",
    # Calls of services, from tracetools 8.5 (Kilted) on; of all before only by our own library. A
    # call is known by its client and its number.
    "rmw_send_request": "rmw_client_handle request sequence_number",
    "rmw_take_request": "rmw_service_handle request client_gid sequence_number taken",
    "rmw_send_response": "rmw_service_handle response client_gid sequence_number timestamp",
    "rmw_take_response": "rmw_client_handle response sequence_number source_timestamp taken",
    # CARET (before Humble) instead of rmw_publish and rmw_take: the message that was written, the
    # DDS source timestamp it got, and the callback that the message with this stamp went to.
    "dds_write": "message",
    "dds_bind_addr_to_stamp": "addr source_stamp",
    "dispatch_subscription_callback": "message callback source_stamp",
    "rmw_implementation": "rmw_impl",
    # CARET's own about messages within a process, before there were ring buffers (its first version
    # had the shorter name): `rclcpp_intra_publish` hands a message over, which may be copied, and
    # the dispatch gives it, or its copy, to the callback.
    "message_construct": "original_message constructed_message",
    "dispatch_intra_process_subscription_callback": "message callback",
    "dispatch_intra_process": "message callback",
    # Intra-process communication: messages travel through ring buffers, not through DDS.
    "rclcpp_construct_ring_buffer": "buffer capacity",
    "rclcpp_buffer_to_ipb": "buffer ipb",
    "rclcpp_ipb_to_subscription": "ipb subscription",
    "rclcpp_ring_buffer_enqueue": "buffer index size overwritten",
    "rclcpp_ring_buffer_dequeue": "buffer index size",
    "rclcpp_ring_buffer_clear": "buffer",
    "rclcpp_executor_get_next_ready": "",
    "rclcpp_executor_wait_for_work": "timeout",
    "rclcpp_executor_execute": "handle",
    "sched_switch": "prev_comm prev_tid prev_prio prev_state next_comm next_tid next_prio",
    # Ours, by the library in front of ROS 2: a timer was called, and its callback comes next; of
    # rclpy's no other event tells.
    "rcl_timer_call": "timer_handle",
    # Ours: what the shaping node decided about a message that came to its `callback` with this
    # `source_timestamp`. `time` is when the gate let it go, `release` when it was to (null: never);
    # slots count from `origin`, the `anchor` "stamp" or "cycle" (also when a stamp was unusable).
    # `slot` is null where it left in none, `cycles_waited` 0 in its own cycle.
    "gate_release":
        "callback source_timestamp arrival origin release slot cycles_waited anchor",
    # Ours: what became of the message of an asynchronous publisher with this `timestamp` (that of
    # its `rmw_publish`). `time` is when the publisher thread had it in its hands, `duration` that
    # of sending. The outcome is "sent"; "expired": older than its topic's lifespan; or
    # "overwritten": newer messages had filled the history. The last two were never sent.
    "asynchronous_send": "rmw_publisher_handle timestamp outcome duration",
    # Ours, what the machine did to everybody. `time` is when the sleeper should have woken, `cpu`
    # where it sleeps; how late it woke.
    "machine_stall": "duration",
    # `time` is when a stretch of the sleeper's wake-ups began, on `cpu`; its duration, and the CPU
    # time of one wake-up in it. The work is the same each time: where it takes longer, the core
    # runs at a slower pace.
    "machine_pace": "duration cpu_time",
})

# `thread_time` is the CPU time of the executing thread so far: where it is there, execution times
# need no sched_switch. Of requests, our own library alone knows the `source_timestamp`. A publisher
# that is `asynchronous` (not 0) has a thread of its own send what it gets (`asynchronous_send`).
#
# A gate's `overrun` is null where the message came in time; otherwise what was done about it,
# "wait", "discard" or "publish", or about a message behind its mode's slot, also "next-slot".
# "bypass" and "silence" are a standby's: it published the message at once, or did not, because no
# shaping node was there. `mode` is that of the message's cycle; null: the gate knows no modes.
# `dropped` is null where it left, else "replaced" by a newer one of its cycle, "surplus" behind the
# first one of it, "overflowed" where newer ones needed the room, "discarded" as an overrun.
# `published` is when publishing returned, `stalled` for how long behind the release neither the
# gate nor any other thread ran on its core: what the machine itself took. `lost` is how many
# messages DDS lost between the one before and this one (null: not known), `row` the number of the
# row since the node started: rows that are missing could not be written, or were in a file that has
# been removed since. `moved` is by how much the slots of the cycle in which it leaves are moved
# from where the plan has them. `gate` is the shaping node's name; one process may have several
# gates. Those from `published` to `row` are in the log of a ROS 2 node only; recordings from before
# a field was there lack it.
OPTIONAL_FIELDS = _typed({
    "callback_start": "thread_time",
    "callback_end": "thread_time",
    "rmw_take_request": "source_timestamp",
    "rcl_publisher_init": "asynchronous",
    "gate_release": "overrun mode dropped published stalled lost row moved gate",
})
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


@runtime_checkable
class ReadAgain(Protocol):
    """Tables that can be read again, so that nobody needs to keep them in memory."""

    def let_go(self, names: Collection[str]) -> None:
        """Forget these tables until they are asked for the next time."""


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
    """A frame with the types of its event's table. Raises PolarsError: a value does not fit, or a
    row has no time.
    """
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
