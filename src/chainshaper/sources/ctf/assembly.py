"""Putting the metadata of all folders into the tables that the kernels read."""

# ruff: noqa: PLR0917 - what is known of a trace on the way down its metadata

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.layout import (
    REGISTERS,
    LayoutError,
    Number,
    Reader,
    Shape,
    Slot,
    Step,
    compile_fields,
)
from chainshaper.sources.ctf.program import Code, Op, Program, Storage
from chainshaper.sources.ctf.types import (
    EnumType,
    EventClass,
    IntegerType,
    StreamClass,
    StructType,
    TraceClass,
    Type,
    VariantType,
    alignment,
    field_name,
)

__all__ = ["Assembly", "Table", "Wanted", "assemble", "attach"]

_STREAM_WIDTH = 20
_EVENT_WIDTH = 11
_DENSE_IDS = 4096


@dataclass(frozen=True)
class Table:
    """Where the events of one name and one shape go.

    ``counter`` is the row counter of level 0 and ``levels`` how many belong to the table; the
    columns are ``time``, ``cpu`` where known, and those of ``columns``.
    """

    name: str
    columns: tuple[tuple[str, Shape], ...]
    slots: tuple[Slot, ...]
    levels: int
    has_cpu: bool
    counter: int


@dataclass(frozen=True)
class Wanted:
    """What is to be read: events that get a table, and which of their context.

    pid, tid and procname always, procname not for the ``nameless`` ones; the other context fields
    with ``context``.
    """

    names: frozenset[str] = frozenset()
    nameless: frozenset[str] = frozenset()
    context: bool = False


@dataclass
class Assembly:
    """Tables for the kernels, and what their rows mean."""

    program: Program = field(default_factory=Program)
    stream_rows: list[list[int]] = field(default_factory=list)
    event_rows: list[list[int]] = field(default_factory=list)
    event_names: list[str] = field(default_factory=list)
    # Per event class: its table's number (-1 where not wanted) and its steps.
    event_tables: list[int] = field(default_factory=list)
    event_steps: list[list[Step]] = field(default_factory=list)
    event_streams: list[int] = field(default_factory=list)
    # Rows of the stream classes of each folder: first, end.
    folders: list[tuple[int, int]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    counters: int = 0
    registers: int = len(REGISTERS)

    def streams(self) -> NDArray[np.int64]:
        """The table of stream classes (see `tables.StreamColumn`)."""
        return np.array(self.stream_rows, np.int64).reshape(-1, _STREAM_WIDTH)

    def events(self) -> NDArray[np.int64]:
        """The table of event classes (see `tables.EventColumn`)."""
        return np.array(self.event_rows or [[0] * _EVENT_WIDTH], np.int64)


def assemble(folders: Sequence[tuple[Path, TraceClass]], wanted: Wanted) -> Assembly:
    """Lay out every stream and event class of all ``folders``.

    Raises `CtfError` for types that cannot be read.
    """
    assembly = Assembly()
    for path, trace in folders:
        first = len(assembly.stream_rows)
        try:
            _folder(assembly, len(assembly.folders), trace, wanted)
        except LayoutError as error:
            raise CtfError(
                path / "metadata", None, str(error), "the trace cannot be read"
            ) from None
        assembly.folders.append((first, len(assembly.stream_rows)))
    return assembly


def attach(assembly: Assembly, table: int, storage: Storage, time: int, cpu: int) -> None:
    """Give a table's event classes the operations that write to its columns.

    ``time`` and ``cpu`` are the addresses of those columns, ``cpu`` 0 for none.
    """
    for event, own in enumerate(assembly.event_tables):
        if own == table:
            row = assembly.event_rows[event]
            row[4], row[5] = assembly.program.add(assembly.event_steps[event], storage)
            row[8], row[9] = time, cpu
            row[10] = int(row[2] >= 8 and row[3] > 0 and assembly.program.offsets(row[4], row[5]))


def _folder(
    assembly: Assembly,
    folder: int,
    trace: TraceClass,
    wanted: Wanted,
) -> None:
    reader = Reader(big=trace.byte_order == "be", registers=len(REGISTERS))
    header, _ = compile_fields(reader, "trace.packet.header", trace.packet_header, fixed=True)
    pending: list[tuple[list[int], list[Step], list[Step]]] = []
    for stream in trace.streams.values():
        own = Reader(reader.big, reader.registers, dict(reader.roots))
        packet, _ = compile_fields(own, "stream.packet.context", stream.packet_context, fixed=True)
        event, _ = compile_fields(own, "stream.event.header", stream.event_header, fixed=True)
        row = [0] * _STREAM_WIDTH
        row[0], row[1] = stream.id, folder
        row[8:12] = _quick_header(stream.event_header, reader.big)
        row[16] = _frequency(stream, trace)
        known = {n.register for n in [*header, *packet] if isinstance(n, Number)}
        row[17] = sum(1 << r for r in known if 0 <= r < len(REGISTERS))
        if trace.uuid is not None:
            row[18], row[19] = _uuid_words(trace.uuid)
        else:
            row[17] &= ~(1 << REGISTERS["uuid_low"])
        has_cpu = bool(row[17] >> REGISTERS["cpu_id"] & 1)
        rows = _events(assembly, own, stream, trace, has_cpu, wanted)
        reader.registers = max(reader.registers, own.registers)
        row[12:16] = _id_table(assembly, rows)
        assembly.stream_rows.append(row)
        pending.append((row, packet, event))
    # Only now is it known which of the headers' numbers anybody refers to.
    start, stop = assembly.program.add(header, None)
    for row, packet, event in pending:
        row[2], row[3] = start, stop
        row[4], row[5] = assembly.program.add(packet, None)
        row[6], row[7] = assembly.program.add(event, None)
    assembly.registers = max(assembly.registers, reader.registers)


def _events(
    assembly: Assembly,
    reader: Reader,
    stream: StreamClass,
    trace: TraceClass,
    has_cpu: bool,
    wanted: Wanted,
) -> dict[int, int]:
    """Lay out a stream class's events; returns their rows by event id."""
    rows: dict[int, int] = {}
    roots = dict(reader.roots)
    for event in stream.events.values():
        own = Reader(reader.big, reader.registers, dict(roots))
        keep = event.name in wanted.names
        steps, columns = _event(own, stream, event, trace, wanted)
        reader.registers = max(reader.registers, own.registers)
        number, storage = -1, None
        row = [0] * _EVENT_WIDTH
        row[6] = -1
        if keep:
            number = _table(assembly, event.name, columns, own, has_cpu)
            table = assembly.tables[number]
            storage = Storage(table.counter)
            row[6], row[7] = table.counter, table.levels
        row[0], row[1] = assembly.program.add(steps, storage)
        only = assembly.program.rows[row[0] : row[1]]
        if not only:
            row[2] = 1
        elif len(only) == 1 and only[0][Op.CODE] == Code.SKIP:
            row[2], row[3] = only[0][Op.ALIGN], only[0][Op.SIZE]
        rows[event.id] = len(assembly.event_rows)
        assembly.event_rows.append(row)
        assembly.event_names.append(event.name)
        assembly.event_tables.append(number)
        assembly.event_steps.append(steps)
        assembly.event_streams.append(len(assembly.stream_rows))
    return rows


def _event(
    reader: Reader,
    stream: StreamClass,
    event: EventClass,
    trace: TraceClass,
    asked: Wanted,
) -> tuple[list[Step], list[tuple[str, Shape]]]:
    """The steps of an event behind its header, and its columns by their final names."""
    keep = event.name in asked.names
    names = _standard_names(stream, event, trace) if keep else {}
    if event.name in asked.nameless:
        names = {place: name for place, name in names.items() if name != "procname"}
    columns: list[tuple[str, Shape]] = []
    steps: list[Step] = []
    for scope, kind in (
        ("stream.event.context", stream.event_context),
        ("event.context", event.context),
    ):
        wanted = None if keep and asked.context else frozenset(n for s, n in names if s == scope)
        more, found = compile_fields(reader, scope, kind, wanted)
        steps += more
        for name, shape in found:
            standard = names.get((scope, name)) or names.get((scope, "_" + name))
            columns.append((standard or f"context.{name}", shape))
    more, found = compile_fields(
        reader, "event.fields", event.fields, None if keep else frozenset()
    )
    taken = {"time", "cpu", "pid", "tid", "procname", *(name for name, _ in columns)}
    for own, shape in found:
        name = own
        while name in taken:
            name = f"payload.{name}"
        taken.add(name)
        columns.append((name, shape))
    return steps + more, columns


def _standard_names(
    stream: StreamClass, event: EventClass, trace: TraceClass
) -> dict[tuple[str, str], str]:
    """Which context fields (scope, TSDL name) are the columns pid, tid and procname.

    A kernel trace's own pid and tid are those of the initial namespace; user space traces have
    ``vpid`` and ``vtid`` of the process's namespace only.
    """
    kernel = trace.env.get("domain") == "kernel"
    present: dict[str, tuple[str, str]] = {}
    for scope, kind in (
        ("stream.event.context", stream.event_context),
        ("event.context", event.context),
    ):
        for member in kind.fields if kind is not None else ():
            present.setdefault(field_name(member.name), (scope, member.name))
    found: dict[tuple[str, str], str] = {}
    for column, candidates in (
        ("pid", ("pid", "vpid") if kernel else ("vpid", "pid")),
        ("tid", ("tid", "vtid") if kernel else ("vtid", "tid")),
        ("procname", ("procname",)),
    ):
        for candidate in candidates:
            if candidate in present:
                found[present[candidate]] = column
                break
    return found


def _table(
    assembly: Assembly,
    name: str,
    columns: list[tuple[str, Shape]],
    reader: Reader,
    has_cpu: bool,
) -> int:
    """The number of the table for events of this name and shape."""
    shape = (name, tuple(columns), tuple(reader.slots), reader.levels, has_cpu)
    for number, table in enumerate(assembly.tables):
        if (table.name, table.columns, table.slots, table.levels, table.has_cpu) == shape:
            return number
    assembly.tables.append(Table(*shape, counter=assembly.counters))
    assembly.counters += reader.levels
    return len(assembly.tables) - 1


def _id_table(assembly: Assembly, rows: dict[int, int]) -> list[int]:
    """Append a stream class's event ids; returns where they lie and the id to assume."""
    first = len(assembly.ids)
    dense = max((i + 1 for i in rows if i < _DENSE_IDS), default=0)
    assembly.ids += [rows.get(i, -1) for i in range(dense)]
    pairs = [(i, row) for i, row in rows.items() if i >= dense]
    for identifier, row in pairs:
        assembly.ids += [identifier, row]
    return [first, dense, len(pairs), next(iter(rows)) if len(rows) == 1 else 0]


def _quick_header(header: StructType | None, big: bool) -> list[int]:
    """Alignment, id bits, clock shift and clock bits of LTTng's compact and large headers.

    Both put an id of few bits and the clock's low bits into one load, and announce anything
    larger by an id of all ones.  Zeros for every other header, which is then interpreted.
    """
    none = [0, 0, 0, 0]
    if header is None or big or len(header.fields) != 2:
        return none
    identifier, variant = header.fields
    if not isinstance(identifier.type, EnumType) or not isinstance(variant.type, VariantType):
        return none
    number = identifier.type.container
    options = {option.name: option.type for option in variant.type.options}
    last = (1 << number.size) - 1
    ranges = {m.label: (m.low, m.high) for m in identifier.type.mappings}
    compact = options.get("compact")
    if (
        identifier.name != "id"
        or variant.type.tag != "id"
        or ranges != {"compact": (0, last - 1), "extended": (last, last)}
        or not isinstance(compact, StructType)
        or len(compact.fields) != 1
    ):
        return none
    clock = compact.fields[0].type
    if (
        not isinstance(clock, IntegerType)
        or clock.clock is None
        or number.signed
        or clock.signed
        or clock.size > 63
        or "be" in (number.byte_order, clock.byte_order)
    ):
        return none
    align, inner = alignment(header), alignment(compact)
    shift = -(-number.size // inner) * inner
    if align < max(8, inner) or shift + clock.size > 64:
        return none
    return [align, number.size, shift, clock.size]


def _clock_names(kind: Type | None) -> list[str]:
    match kind:
        case IntegerType(clock=str(name)):
            return [name]
        case EnumType(container=IntegerType(clock=str(name))):
            return [name]
        case StructType(fields=fields):
            return [name for f in fields for name in _clock_names(f.type)]
        case VariantType(options=fields):
            return [name for f in fields for name in _clock_names(f.type)]
    return []


def _frequency(stream: StreamClass, trace: TraceClass) -> int:
    """The rate of the clock that a stream's time stamps are mapped to, in Hz."""
    names = _clock_names(stream.event_header) + _clock_names(stream.packet_context)
    for name in names:
        if name not in trace.clocks:
            raise LayoutError(f"stream {stream.id} is mapped to the undeclared clock {name!r}")
    names += list(trace.clocks)
    return trace.clocks[names[0]].frequency if names else 1_000_000_000


def _uuid_words(text: str) -> tuple[int, int]:
    try:
        data = UUID(text).bytes
    except ValueError:
        raise LayoutError(f"trace uuid {text!r} is none") from None
    low, high = np.frombuffer(data, "<i8")
    return int(low), int(high)
