"""From a trace's metadata to what the decoder in C++ is given (core/ctf).

`describe` hands over the types of a trace; `select` says which of its events are wanted, and which
of their fields get columns. How the bits of all that lie is the decoder's own business.
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
_STREAM_CONTEXT, _EVENT_CONTEXT, _FIELDS = (
    _core.CtfScope.STREAM_EVENT_CONTEXT,
    _core.CtfScope.EVENT_CONTEXT,
    _core.CtfScope.EVENT_FIELDS,
)


class LayoutError(ValueError):
    """Types that cannot be laid out: an unresolved length or tag, too deep a nesting."""


# Types


def describe(trace: tsdl.TraceClass) -> _core.CtfTraceClass:
    """What a trace's metadata declares, for the decoder. Raises `CtfError`."""
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
    """Lay out all streams and events. Raises `CtfError` for types that cannot be read."""
    try:
        return _core.CtfLayout(described, wanted)
    except ValueError as error:
        reason, number = error.args
        raise _cannot_be_read(traces[number], reason) from None


def _cannot_be_read(trace: tsdl.TraceClass, reason: str) -> tsdl.CtfError:
    return tsdl.CtfError(trace.path / "metadata", None, reason, "the trace cannot be read")


def _of_kernel(trace: tsdl.TraceClass) -> bool:
    return trace.env.get("domain") == "kernel"


def _uuid(trace: tsdl.TraceClass) -> tuple[int, int] | None:
    if trace.uuid is None:
        return None
    try:
        low, high = struct.unpack("<qq", UUID(trace.uuid).bytes)
    except ValueError:
        raise LayoutError(f"trace uuid {trace.uuid!r} is none") from None
    return low, high


class _Types:
    """Types of a trace for the decoder; one that is declared once is handed over once."""

    def __init__(self, big_endian: bool) -> None:
        self._big_endian = big_endian
        self._known: dict[int, _core.CtfType] = {}

    def scope(self, structure: tsdl.StructType | None) -> _core.CtfType | None:
        """A structure at the top: a header, a context, an event's fields."""
        return None if structure is None else self._type("", structure, 0)

    def _type(self, name: str, kind: tsdl.Type, depth: int) -> _core.CtfType:
        if depth > _DEEPEST:
            raise LayoutError(f"{name}: types nested too deeply")
        known = self._known.get(id(kind))
        if known is None:
            known = self._known[id(kind)] = self._made(name, kind, depth + 1)
        return known

    def _made(self, name: str, kind: tsdl.Type, depth: int) -> _core.CtfType:
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
        # Values of 64 bits, counted from the least one.
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
    match kind:
        case tsdl.IntegerType(clock=str(name)):
            yield name
        case tsdl.StructType(fields=fields) | tsdl.VariantType(options=fields):
            for member in fields:
                yield from _clock_names(member.type)


def _frequency(stream: tsdl.StreamClass, trace: tsdl.TraceClass) -> int:
    """The rate of the clock that a stream's time stamps are mapped to, in Hz."""
    names = [*_clock_names(stream.event_header), *_clock_names(stream.packet_context)]
    for name in names:
        if name not in trace.clocks:
            raise LayoutError(f"stream {stream.id} is mapped to the undeclared clock {name!r}")
    names += list(trace.clocks)
    return trace.clocks[names[0]].frequency if names else _BILLION


# Tables


class Table(NamedTuple):
    """Where the events of one name and one shape go: ``time``, ``cpu`` where known, ``columns``."""

    name: str
    columns: tuple[tuple[str, tsdl.Type], ...]
    has_cpu: bool

    def column_types(self) -> list[np.dtype[Any]]:
        """What each column has: integers, or codes of texts."""
        return [
            np.dtype(f"{'i' if kind.signed else 'u'}{1 << ((kind.size + 7 >> 3) - 1).bit_length()}")
            if isinstance(kind, tsdl.IntegerType)
            else np.dtype("u4")
            for _, kind in self.columns
        ]


class Selection(NamedTuple):
    """The events that are wanted, the stream classes that have any, and the tables they go to.

    Events and stream classes are counted over all traces, in order of declaration.
    """

    events: list[_core.CtfWantedEvent]
    stream_classes: set[int]
    tables: list[Table]


def select(traces: Sequence[tsdl.TraceClass], wanted: Mapping[str, bool]) -> Selection:
    """Choose the events that are ``wanted``, and their columns.

    All get pid and tid, and the procname where that is true.
    """
    tables: dict[Table, int] = {}
    found = Selection([], set(), [])
    number = -1
    streams = [(trace, stream) for trace in traces for stream in trace.streams.values()]
    for row, (trace, stream) in enumerate(streams):
        for event in stream.events.values():
            number += 1
            if event.name not in wanted:
                continue
            places, columns = _columns(stream, event, _of_kernel(trace), wanted[event.name])
            table = Table(event.name, columns, _says_cpu(trace, stream))
            found.events.append(
                _core.CtfWantedEvent(
                    event=number, table=tables.setdefault(table, len(tables)), columns=places
                )
            )
            found.stream_classes.add(row)
    return found._replace(tables=list(tables))


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


def _columns(
    stream: tsdl.StreamClass, event: tsdl.EventClass, kernel: bool, procname: bool
) -> _Columns:
    """The fields of an event that get columns, and these columns, in the order in which they lie.

    A kernel trace's pid and tid are of the initial namespace; user space traces have ``vpid`` and
    ``vtid`` of the process's only.
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
    present = {tsdl.field_name(members[place].name): place for place in reversed(contexts)}
    named: dict[_Place, str] = {}
    for column in ("pid", "tid", "procname") if procname else ("pid", "tid"):
        names = (column, f"v{column}") if kernel else (f"v{column}", column)
        if found := next((present[name] for name in names if name in present), None):
            named[found] = column
    taken = {"time", "cpu", "pid", "tid", "procname"}
    for place, member in members.items():
        if place[0] == _FIELDS:
            name = tsdl.field_name(member.name)
            while name in taken:
                name = f"payload.{name}"
            taken.add(name)
            named[place] = name
    places = [place for place in members if place in named]
    return places, tuple((named[place], members[place].type) for place in places)


def _has_column(kind: tsdl.Type) -> bool:
    match kind:
        case tsdl.IntegerType() | tsdl.StringType() | tsdl.ArrayType(tsdl.IntegerType(8, 8)):
            return True
    return False
