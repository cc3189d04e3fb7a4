"""The event tables: a frame for each event, with the same columns whichever tracer recorded it.

:mod:`.event_declarations` says which events there are, with which fields. Each table begins with

* ``time``: ns of CLOCK_MONOTONIC. The sum with the recording's ``clock_offset_ns`` is wall-clock
  time, as DDS source timestamps are;
* ``pid``, ``tid``: process and thread, as the kernel numbers them in the traced container;
* ``cpu``: the core, null where the source does not know it.

The event's fields follow. Handles (``*_handle``, ``callback``, ``message``, ``subscription``) are
addresses: unique only within a process, and only until the object is freed. Columns that a source
cannot know are missing in its tables. A missing table is the same as an empty one.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Protocol, TypeAlias, runtime_checkable

import polars as pl

from chainshaper.values.event_declarations import EVENTS, EventField, FieldKind, events_in_group

EventTables: TypeAlias = Mapping[str, pl.DataFrame]
"""One frame per event name, each sorted by ``time``."""

COMMON_COLUMNS: dict[str, pl.DataType] = {
    "time": pl.Int64(),
    "pid": pl.Int32(),
    "tid": pl.Int32(),
    "cpu": pl.Int32(),
}
"""The columns that every table begins with."""

_TYPES: dict[FieldKind, pl.DataType] = {
    "address": pl.UInt64(),
    "count": pl.UInt64(),
    "nanoseconds": pl.Int64(),
    "instant": pl.Int64(),
    "number": pl.Int64(),
    "small number": pl.Int32(),
    "thread": pl.Int32(),
    "real": pl.Float64(),
    "flag": pl.Int32(),
    "text": pl.String(),
    "gid": pl.List(pl.UInt8()),
}


def type_of(field: EventField) -> pl.DataType:
    """Return the type of a field's column."""
    return _TYPES[field.kind]


FIELDS: dict[str, dict[str, pl.DataType]] = {
    event.name: {
        field.name: type_of(field) for field in event.fields if field.presence != "optional"
    }
    for event in EVENTS.values()
}
"""Event → the columns that its table has behind :data:`COMMON_COLUMNS`."""

OPTIONAL_FIELDS: dict[str, dict[str, pl.DataType]] = {
    event.name: optional
    for event in EVENTS.values()
    if (optional := {f.name: type_of(f) for f in event.fields if f.presence == "optional"})
}
"""Event → the columns that its table may have in addition."""

VERSION_FIELDS: dict[str, frozenset[str]] = {
    event.name: names
    for event in EVENTS.values()
    if (names := frozenset(f.name for f in event.fields if f.presence == "some versions"))
}
"""Event → those of :data:`FIELDS` that not every version has."""

CREATION = events_in_group("creation")
"""The events of objects' creation, and changes of their state, which all others depend on."""

NODE_NAME = pl.col("namespace").fill_null("").str.strip_chars_end("/") + "/" + pl.col("node_name")
"""The full name of the node that a row of `rcl_node_init` is about: ``/front/filter``."""


def happened(tables: EventTables, since_ns: int, until_ns: int | None = None) -> EventTables:
    """Return the events of a span of time, and the creation of all objects.

    An event of a gate counts from when its cycle began.
    """
    chosen = dict(tables)
    for name, frame in tables.items():
        if name not in CREATION:
            begins = [column for column in ("time", "origin") if column in frame.columns]
            is_inside = pl.min_horizontal(begins) >= since_ns
            if until_ns is not None:
                is_inside &= pl.col("time") < until_ns
            chosen[name] = frame.filter(is_inside)
    return chosen


def first_and_last_start(tables: EventTables) -> tuple[int, int]:
    """Return when the first and the last callback began (ns); 0 where none did.

    Where callbacks emit no events (rclpy), they begin with a timer's call or a message's take.
    """
    for names in (("callback_start",), ("rcl_timer_call", "rmw_take")):
        times = pl.concat([table(tables, name)["time"] for name in names])
        if times.len():
            return int(times.min()), int(times.max())  # type: ignore[arg-type]
    return 0, 0


def empty(name: str) -> pl.DataFrame:
    """Return an empty table with all columns of event ``name``."""
    return pl.DataFrame(schema={**COMMON_COLUMNS, **FIELDS[name]})


def table(tables: EventTables, name: str, columns: Iterable[str] = ()) -> pl.DataFrame:
    """Return the table of event ``name``, empty if absent, with these ``columns``.

    A column that the table lacks is null.
    """
    frame, types = tables[name] if name in tables else empty(name), column_types(name)
    nulls = [
        pl.lit(None, types[column]).alias(column)
        for column in columns
        if column not in frame.columns
    ]
    return frame.with_columns(nulls) if nulls else frame


@runtime_checkable
class ReadAgain(Protocol):
    """Tables that can be read again, so that nobody needs to keep them in memory."""

    def let_go(self, names: Collection[str]) -> None:
        """Forget these tables until they are asked for the next time."""


def column_types(name: str) -> dict[str, pl.DataType]:
    """Return the types of all columns that a table of event ``name`` may have.

    Of an event that is not declared, it is the time only.
    """
    if name not in FIELDS:
        return {"time": COMMON_COLUMNS["time"]}
    return {**COMMON_COLUMNS, **FIELDS[name], **OPTIONAL_FIELDS.get(name, {})}


def column_problems(schema: Mapping[str, pl.DataType], name: str) -> list[str]:
    """Say what is wrong with the columns of a table of event ``name``."""
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


def castable(type_: pl.DataType | None, wanted: pl.DataType) -> bool:
    """Whether values of a type can be cast to a column's: numbers of another width can."""
    if isinstance(wanted, pl.List):
        return isinstance(type_, pl.List | pl.Array) and type_.inner.is_integer()
    if wanted.is_integer() and type_ is not None:
        return type_.is_integer() or isinstance(type_, pl.Null)
    if wanted.is_float() and type_ is not None:
        return type_.is_numeric() or isinstance(type_, pl.Null)
    return isinstance(type_, pl.String | pl.Categorical | pl.Null)


def as_table(frame: pl.DataFrame, name: str) -> pl.DataFrame:
    """Cast a frame to the types of its event's table.

    Raises PolarsError: a value does not fit, or a row has no time.
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
