"""How a trace's events become event tables: their providers, fields and types.

Tables have the columns of :mod:`chainshaper.values.events`. A trace may declare other events of the
same name (another provider's), other types (a narrower integer), and fewer fields: older
distributions do, and so does damaged metadata. Integers are widened; a field that is absent, or of
a kind that no cast brings right, becomes a column of nulls, which the analysis takes for "not
known", and is said in words unless that is how a distribution is.

CARET keeps the events of an application's start and emits them again when tracing begins; those
carry ``init_timestamp``, the time at which they really happened, and are put there.
"""

from collections.abc import Mapping, Sequence

import polars as pl

from chainshaper.sources.ctf import CtfTrace
from chainshaper.sources.ctf.types import (
    ArrayType,
    FloatType,
    IntegerType,
    SequenceType,
    StringType,
    StructType,
    Type,
    VariantType,
    field_name,
)
from chainshaper.values import events

__all__ = [
    "CARET_INIT",
    "DeclaredFields",
    "declared_fields",
    "event_table",
    "merged",
    "missing_fields",
    "table_name",
]

DeclaredFields = Mapping[str, Mapping[str, Type]]
"""Table → the fields that the trace declares for its event."""

CARET_INIT = "caret_init"
"""An event that is read, but is no table of ours."""

_PROVIDERS = ("ros2", "ros2_caret")


def table_name(event: str) -> str | None:
    """The table that an event belongs to: ``ros2:callback_start`` → ``callback_start``.

    None for events that no table is for, and for another provider's event of the same name. The
    kernel's events have no provider.
    """
    provider, _, name = event.rpartition(":")
    if name == "sched_switch":
        return None if provider else name
    known = provider in _PROVIDERS and (name in events.FIELDS or name == CARET_INIT)
    return name if known else None


def declared_fields(trace: CtfTrace) -> dict[str, dict[str, Type]]:
    """The fields of every event of the trace that a table is for."""
    declared: dict[str, dict[str, Type]] = {}
    for folder in trace.folders:
        for stream in folder.declared.streams.values():
            for event in stream.events.values():
                name = table_name(event.name)
                if name is not None:
                    kind = event.fields or StructType()
                    fields = {field_name(f.name): f.type for f in kind.fields}
                    declared.setdefault(name, {}).update(fields)
    return declared


def missing_fields(declared: DeclaredFields, counts: Mapping[str, int]) -> tuple[str, ...]:
    """In words, which fields of events that happened are absent, or of a kind without use."""
    happened = {str(table_name(event)) for event, count in counts.items() if count}
    notes = []
    for name in sorted(happened & declared.keys() & events.FIELDS.keys()):
        fields = declared[name]
        wanted = {
            f: t
            for f, t in events.FIELDS[name].items()
            if f not in events.VERSION_FIELDS.get(name, ())
        }
        missing = [f for f, t in wanted.items() if f not in fields or not _fits(fields[f], t)]
        if missing:
            notes.append(
                f"the trace's {name} has no usable field {', '.join(missing)}: what depends on "
                "it cannot be known."
            )
    return tuple(notes)


def _fits(declared: Type, wanted: pl.DataType) -> bool:
    """Whether the values of a declared field can be those of a column."""
    match declared:
        case StructType() | VariantType():
            return False
        case StringType():
            return isinstance(wanted, pl.String)
        case ArrayType(element=element) | SequenceType(element=element):
            if not isinstance(element, IntegerType):
                return False
            text = element.encoding != "none" and element.size == element.align == 8
            return isinstance(wanted, pl.String if text else pl.List)
        case FloatType():
            return False
        case _:
            return wanted.is_integer()


def _castable(found: pl.DataType | None, wanted: pl.DataType) -> bool:
    """The same for a column that was decoded."""
    if isinstance(found, pl.List | pl.Array):
        return isinstance(wanted, pl.List) and found.inner.is_integer()
    if isinstance(wanted, pl.String):
        return isinstance(found, pl.String)
    return found is not None and found.is_integer() and wanted.is_integer()


def event_table(frame: pl.DataFrame, name: str, clock_offset_ns: int) -> pl.DataFrame:
    """A decoded event's frame as an event table, without events of nobody knows which thread."""
    types = {**events.COMMON_COLUMNS, **events.FIELDS.get(name, {})}
    if "init_timestamp" in frame.columns and frame.schema["init_timestamp"].is_integer():
        happened = pl.col("init_timestamp")
        wall_clock = happened > clock_offset_ns
        at = pl.when(wall_clock).then(happened - clock_offset_ns).otherwise(happened)
        frame = frame.with_columns(time=at.cast(pl.Int64)).sort("time", maintain_order=True)
    if name not in events.FIELDS:
        return frame
    columns = []
    for column, kind in types.items():
        if _castable(frame.schema.get(column), kind):
            columns.append(pl.col(column).cast(kind, strict=False))
        elif column not in events.VERSION_FIELDS.get(name, ()):
            columns.append(pl.lit(None, dtype=kind).alias(column))
    table = frame.select(columns)
    # `sched_switch` names its threads itself.
    nameless = name != "sched_switch" and (table["pid"].null_count() or table["tid"].null_count())
    return table.drop_nulls(["pid", "tid"]) if nameless else table


def merged(parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Several providers' events of one name, by time; CARET's copy of an event is not another."""
    together = pl.concat(parts, how="diagonal_relaxed").sort("time", maintain_order=True)
    return together.unique(maintain_order=True) if together.height else together
