"""Tell the decoder in C++ (core/ctf) what a trace's metadata declares, and what is wanted of it.

`describe` converts the types of a trace; `select` chooses events, and which of their fields get
columns. The decoder works out where each field's bits are (`lay_out`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np

from chainshaper import _core
from chainshaper.sources.ctf import tsdl

MAGIC = _core.CTF_MAGIC
"""The number that each packet begins with."""
_BILLION = 1_000_000_000
_DEEPEST = 12
"""Types inside types that are converted at most: hostile metadata must not exhaust the stack."""
_STREAM_CONTEXT, _EVENT_CONTEXT, _FIELDS = (
    _core.CtfScope.STREAM_EVENT_CONTEXT,
    _core.CtfScope.EVENT_CONTEXT,
    _core.CtfScope.EVENT_FIELDS,
)


class LayoutError(ValueError):
    """Types that cannot be laid out: an unresolved length or tag, too deep a nesting."""


# Types


def describe(trace: tsdl.TraceClass) -> _core.CtfTraceClass:
    """Convert what a trace's metadata declares for the decoder. Raises `CtfError`."""
    types = _Types(trace.byte_order == "be")
    try:
        return _core.CtfTraceClass(
            big_endian=trace.byte_order == "be",
            of_kernel=_of_kernel(trace),
            uuid=_uuid(trace),
            packet_header=types.scope(trace.packet_header),
            referenced=set(trace.referenced),
            streams=[
                _core.CtfStreamClass(
                    id=stream.id,
                    packet_context=types.scope(stream.packet_context),
                    event_header=types.scope(stream.event_header),
                    event_context=types.scope(stream.event_context),
                    events=[
                        _core.CtfEventClass(
                            id=event.id,
                            context=types.scope(event.context),
                            fields=types.scope(event.fields),
                        )
                        for event in stream.events.values()
                    ],
                    frequency_hz=_frequency(stream, trace),
                )
                for stream in trace.streams.values()
            ],
        )
    except LayoutError as error:
        raise _cannot_be_read(trace, str(error)) from None


def lay_out(
    traces: Sequence[tsdl.TraceClass],
    described: Sequence[_core.CtfTraceClass],
    wanted: Sequence[_core.CtfWantedEvent] = (),
) -> _core.CtfLayout:
    """Let the decoder lay out all streams and events.

    Raises `CtfError`: types that cannot be read.
    """
    try:
        return _core.CtfLayout(described, wanted)
    except ValueError as error:
        reason, trace_number = error.args
        raise _cannot_be_read(traces[trace_number], reason) from None


def _cannot_be_read(trace: tsdl.TraceClass, reason: str) -> tsdl.CtfError:
    return tsdl.CtfError(trace.path / "metadata", None, reason, "the trace cannot be read")


def _of_kernel(trace: tsdl.TraceClass) -> bool:
    return trace.env.get("domain") == "kernel"


def _uuid(trace: tsdl.TraceClass) -> tuple[int, int] | None:
    """Return the trace's UUID as two numbers of 64 bits, as they lie in a packet's header."""
    if trace.uuid is None:
        return None
    try:
        low, high = struct.unpack("<qq", UUID(trace.uuid).bytes)
    except ValueError:
        raise LayoutError(f"trace uuid {trace.uuid!r} is none") from None
    return low, high


class _Types:
    """Converts the types of a trace for the decoder.

    A type that many fields share is one object in the metadata, and is converted once.
    """

    def __init__(self, big_endian: bool) -> None:
        self._big_endian = big_endian
        self._converted: dict[
            int, _core.CtfType
        ] = {}  # by the identity of the type in the metadata

    def scope(self, structure: tsdl.StructType | None) -> _core.CtfType | None:
        """Convert the structure of a scope: a header, a context, or an event's fields."""
        return None if structure is None else self._type("", structure, 0)

    def _type(self, name: str, kind: tsdl.Type, depth: int) -> _core.CtfType:
        if depth > _DEEPEST:
            raise LayoutError(f"{name}: types nested too deeply")
        converted = self._converted.get(id(kind))
        if converted is None:
            converted = self._converted[id(kind)] = self._convert(name, kind, depth + 1)
        return converted

    def _convert(self, name: str, kind: tsdl.Type, depth: int) -> _core.CtfType:
        match kind:
            case tsdl.IntegerType():
                return self._integer(kind)
            case tsdl.StringType():
                return _core.CtfType.string()
            case tsdl.ArrayType(element, length):
                return _core.CtfType.array(
                    element=self._type(f"{name}[]", element, depth),
                    length=length,
                    is_text=tsdl.is_text(kind),
                )
            case tsdl.StructType(fields, align):
                members = [(n, self._type(n, member, depth)) for n, member in fields]
                return _core.CtfType.structure(fields=members, align=align)
            case tsdl.VariantType(tag, options):
                members = [(n, self._type(n, member, depth)) for n, member in options]
                return _core.CtfType.variant(tag=tag, options=members)

    def _integer(self, kind: tsdl.IntegerType) -> _core.CtfType:
        big = self._big_endian if kind.byte_order == "native" else kind.byte_order == "be"
        # The decoder gets ranges of labels as distances from the least value of 64 bits, so that
        # signed and unsigned values need one type only.
        least, most = -(1 << 63) if kind.signed else 0, (1 << 64) - 1
        return _core.CtfType.integer(
            size=kind.size,
            align=kind.align,
            is_signed=kind.signed,
            big_endian=big,
            maps_clock=kind.clock is not None,
            labels=[
                (label, max(low - least, 0), min(high - least, most))
                for label, low, high in kind.mappings
                if low - least <= most and high >= least
            ],
        )


def _clock_names(kind: tsdl.Type | None) -> Iterator[str]:
    """Yield the names of the clocks that integers of a type are mapped to."""
    match kind:
        case tsdl.IntegerType(clock=str(name)):
            yield name
        case tsdl.StructType(fields=fields) | tsdl.VariantType(options=fields):
            for member in fields:
                yield from _clock_names(member.type)


def _frequency(stream: tsdl.StreamClass, trace: tsdl.TraceClass) -> int:
    """Return the rate in Hz of the clock that a stream's time stamps are mapped to."""
    names = [*_clock_names(stream.event_header), *_clock_names(stream.packet_context)]
    for name in names:
        if name not in trace.clocks:
            raise LayoutError(f"stream {stream.id} is mapped to the undeclared clock {name!r}")
    names += list(trace.clocks)
    return trace.clocks[names[0]].frequency if names else _BILLION


# Tables


class Table(NamedTuple):
    """A table for events of one name whose fields have the same names and types.

    It has the column ``time``, ``cpu`` where that is known, and those of ``columns``.
    """

    name: str  # of the events
    columns: tuple[tuple[str, tsdl.Type], ...]  # name and type of each
    has_cpu: bool

    def column_types(self) -> list[np.dtype[Any]]:
        """Return the types of the columns' arrays: integers as declared, or codes of texts."""
        return [
            np.dtype(f"{'i' if kind.signed else 'u'}{1 << ((kind.size + 7 >> 3) - 1).bit_length()}")
            if isinstance(kind, tsdl.IntegerType)
            else np.dtype("u4")
            for _, kind in self.columns
        ]


class Selection(NamedTuple):
    """The events that are wanted, and where they go.

    Events and stream classes are numbered over all traces, in order of declaration.
    """

    events: list[_core.CtfWantedEvent]
    stream_classes: set[int]  # that have wanted events
    tables: list[Table]


def select(traces: Sequence[tsdl.TraceClass], wanted: Mapping[str, bool]) -> Selection:
    """Choose the events that are ``wanted``, and their columns.

    ``wanted`` maps the name of an event to whether it gets a column ``procname``; all get pid and
    tid.
    """
    table_numbers: dict[Table, int] = {}
    events: list[_core.CtfWantedEvent] = []
    stream_classes: set[int] = set()
    event_number = -1
    streams = [(trace, stream) for trace in traces for stream in trace.streams.values()]
    for stream_class, (trace, stream) in enumerate(streams):
        for event in stream.events.values():
            event_number += 1
            if event.name not in wanted:
                continue
            places, columns = _columns(stream, event, _of_kernel(trace), wanted[event.name])
            table = Table(event.name, columns, _says_cpu(trace, stream))
            table_number = table_numbers.setdefault(table, len(table_numbers))
            events.append(
                _core.CtfWantedEvent(event=event_number, table=table_number, columns=places)
            )
            stream_classes.add(stream_class)
    return Selection(events, stream_classes, list(table_numbers))


def _says_cpu(trace: tsdl.TraceClass, stream: tsdl.StreamClass) -> bool:
    """Whether a stream's packets say on which core they were recorded."""
    return any(
        name == "cpu_id" and isinstance(kind, tsdl.IntegerType)
        for scope in (trace.packet_header, stream.packet_context)
        if scope is not None
        for name, kind in scope.fields
    )


_Place = tuple[_core.CtfScope, int]
"""A scope and the number of a field in it."""
_Columns = tuple[list[_Place], tuple[tuple[str, tsdl.Type], ...]]
"""The places of the fields that get columns, and the name and type of each column."""


def _columns(
    stream: tsdl.StreamClass, event: tsdl.EventClass, kernel: bool, procname: bool
) -> _Columns:
    """Choose the fields of an event that get columns, in the order in which they are recorded.

    A ``kernel`` trace has ``pid`` and ``tid`` of the initial namespace; traces of user space have
    only ``vpid`` and ``vtid``, of the process's namespace.
    """
    scopes = {_STREAM_CONTEXT: stream.event_context, _EVENT_CONTEXT: event.context}
    scopes[_FIELDS] = event.fields
    members = {
        (scope, number): member
        for scope, structure in scopes.items()
        for number, member in enumerate(structure.fields if structure is not None else ())
        if _has_column(member.type)
    }
    contexts = [place for place in members if place[0] != _FIELDS]
    # Reversed, so that of two fields of one name the one of the outer scope stays.
    place_of = {tsdl.field_name(members[place].name): place for place in reversed(contexts)}
    column_names: dict[_Place, str] = {}
    for column in ("pid", "tid", "procname") if procname else ("pid", "tid"):
        names = (column, f"v{column}") if kernel else (f"v{column}", column)
        recorded = [name for name in names if name in place_of]
        if recorded:
            column_names[place_of[recorded[0]]] = column
    taken = {"time", "cpu", "pid", "tid", "procname"}
    for place, member in members.items():
        if place[0] == _FIELDS:
            name = tsdl.field_name(member.name)
            while name in taken:
                name = f"payload.{name}"
            taken.add(name)
            column_names[place] = name
    places = [place for place in members if place in column_names]
    return places, tuple((column_names[place], members[place].type) for place in places)


def _has_column(kind: tsdl.Type) -> bool:
    """Whether fields of this type become columns: integers, texts, arrays of bytes."""
    match kind:
        case tsdl.IntegerType() | tsdl.StringType() | tsdl.ArrayType(tsdl.IntegerType(8, 8)):
            return True
    return False
