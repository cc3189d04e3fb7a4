"""Putting the metadata of all folders into the tables that the kernels read."""

# ruff: noqa: PLR0917 - what is known of a trace on the way down its metadata

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.program import (
    LayoutError,
    Number,
    Program,
    Reader,
    Shape,
    Slot,
    Step,
    Storage,
)
from chainshaper.sources.ctf.types import (
    CtfError,
    CtfFolder,
    EnumType,
    EventClass,
    Field,
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
    counter: int = field(compare=False)


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
class Event:
    """An event class: its row, its table's number (-1 where not wanted), its steps.

    ``stream`` is the row of its stream class.
    """

    name: str
    row: list[int]
    table: int
    steps: list[Step]
    stream: int


@dataclass
class Assembly:
    """Tables for the kernels, and what their rows mean.

    ``events_of`` is by a table's number, ``folders`` the rows of each folder's stream classes:
    first, end.
    """

    program: Program = field(default_factory=Program)
    stream_rows: list[list[int]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    events_of: dict[int, list[Event]] = field(default_factory=dict)
    folders: list[tuple[int, int]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    table_numbers: dict[Table, int] = field(default_factory=dict)
    ids: list[int] = field(default_factory=list)
    counters: int = 0
    registers: int = len(tb.REGISTERS)

    def streams(self) -> NDArray[np.int64]:
        """The table of stream classes (see `tables`)."""
        return np.array(self.stream_rows, np.int64).reshape(-1, tb.STREAM_COLUMNS)

    def event_rows(self) -> NDArray[np.int64]:
        """The table of event classes (see `tables`)."""
        return np.array([e.row for e in self.events] or [[0] * tb.EVENT_COLUMNS], np.int64)


def assemble(folders: Sequence[CtfFolder], wanted: Wanted) -> Assembly:
    """Lay out every stream and event class of all ``folders``.

    Raises `CtfError` for types that cannot be read.
    """
    assembly = Assembly()
    for folder in folders:
        first = len(assembly.stream_rows)
        try:
            _add_folder(assembly, folder.declared, wanted)
        except LayoutError as error:
            file = folder.path / "metadata"
            raise CtfError(file, None, str(error), "the trace cannot be read") from None
        assembly.folders.append((first, len(assembly.stream_rows)))
    return assembly


def attach(assembly: Assembly, table: int, storage: Storage, time: int, cpu: int) -> None:
    """Give a table's event classes the operations that write to its columns.

    ``time`` and ``cpu`` are the addresses of those columns, ``cpu`` 0 for none.
    """
    for event in assembly.events_of[table]:
        row = event.row
        start, stop = assembly.program.add(event.steps, storage)
        row[tb.E_FILL], row[tb.E_FILL_STOP] = start, stop
        row[tb.E_TIME], row[tb.E_CPU] = time, cpu
        row[tb.E_CONSTANT] = int(
            row[tb.E_ALIGN] >= 8 and row[tb.E_SIZE] > 0 and assembly.program.offsets(start, stop)
        )


def _add_folder(assembly: Assembly, trace: TraceClass, wanted: Wanted) -> None:
    reader = Reader(big=trace.byte_order == "be", registers=len(tb.REGISTERS))
    header, _ = reader.scope("trace.packet.header", trace.packet_header, fixed=True)
    pending: list[tuple[list[int], Iterable[int], list[Step], list[Step]]] = []
    for stream in trace.streams.values():
        own = reader.child()
        packet, _ = own.scope("stream.packet.context", stream.packet_context, fixed=True)
        event, _ = own.scope("stream.event.header", stream.event_header, fixed=True)
        row = [0] * tb.STREAM_COLUMNS
        row[tb.S_ID] = stream.id
        row[tb.S_ALIGN : tb.S_CLOCK_BITS + 1] = _quick_header(stream.event_header, own.big)
        row[tb.S_FREQUENCY] = _frequency(stream, trace)
        known = {n.register for n in [*header, *packet] if isinstance(n, Number)}
        row[tb.S_KNOWN] = sum(1 << r for r in known if 0 <= r < len(tb.REGISTERS))
        if trace.uuid is not None:
            row[tb.S_UUID_LOW], row[tb.S_UUID_HIGH] = _uuid_words(trace.uuid)
        else:
            row[tb.S_KNOWN] &= ~(1 << tb.R_UUID_LOW)
        has_cpu = bool(row[tb.S_KNOWN] >> tb.R_CPU & 1)
        rows = _add_events(assembly, own, stream, trace, has_cpu, wanted)
        reader.join(own)
        row[tb.S_ID_FIRST : tb.S_DEFAULT + 1] = _id_table(assembly, rows)
        assembly.stream_rows.append(row)
        pending.append((row, rows.values(), packet, event))
    # Only now is it known which of the headers' numbers lengths and tags refer to.
    program = assembly.program
    start, stop = program.add(header, None)
    for row, events, packet, event in pending:
        row[tb.S_HEADER], row[tb.S_HEADER_STOP] = start, stop
        row[tb.S_CONTEXT], row[tb.S_CONTEXT_STOP] = context = program.add(packet, None)
        row[tb.S_EVENT], row[tb.S_EVENT_STOP] = own_header = program.add(event, None)
        row[tb.S_COST] = tb.P_ROW + program.cost(start, stop) + program.cost(*context)
        for number in events:
            assembly.events[number].row[tb.E_COST] += program.cost(*own_header)
    assembly.registers = max(assembly.registers, reader.registers)


def _add_events(
    assembly: Assembly,
    reader: Reader,
    stream: StreamClass,
    trace: TraceClass,
    has_cpu: bool,
    wanted: Wanted,
) -> dict[int, int]:
    """Lay out a stream class's events; returns their rows by event id."""
    rows: dict[int, int] = {}
    for event in stream.events.values():
        own = reader.child()
        steps, columns = _laid_out(own, stream, event, trace, wanted)
        reader.join(own)
        number, storage = -1, None
        row = [0] * tb.EVENT_COLUMNS
        row[tb.E_COUNTER] = -1
        if event.name in wanted.names:
            number = _table(assembly, event.name, columns, own, has_cpu)
            table = assembly.tables[number]
            storage = Storage(table.counter, _row_bytes(table))
            row[tb.E_COUNTER], row[tb.E_LEVELS] = table.counter, table.levels
            row[tb.E_COST] = storage.costs[0]
        start, stop = row[tb.E_WALK], row[tb.E_WALK_STOP] = assembly.program.add(steps, storage)
        row[tb.E_COST] += assembly.program.cost(start, stop)
        only = assembly.program.rows[start:stop]
        if not only:
            row[tb.E_ALIGN] = 1
        elif len(only) == 1 and only[0][tb.O_CODE] == tb.SKIP:
            row[tb.E_ALIGN], row[tb.E_SIZE] = only[0][tb.O_ALIGN], only[0][tb.O_SIZE]
        rows[event.id] = len(assembly.events)
        laid_out = Event(event.name, row, number, steps, len(assembly.stream_rows))
        assembly.events.append(laid_out)
        assembly.events_of.setdefault(number, []).append(laid_out)
    return rows


def _laid_out(
    reader: Reader, stream: StreamClass, event: EventClass, trace: TraceClass, asked: Wanted
) -> tuple[list[Step], list[tuple[str, Shape]]]:
    """The steps of an event behind its header, and its columns by their final names."""
    keep = event.name in asked.names
    contexts = (
        ("stream.event.context", stream.event_context),
        ("event.context", event.context),
    )
    names: dict[tuple[str, str], str] = {}
    if keep:
        present: dict[str, tuple[str, str]] = {}
        for scope, kind in contexts:
            for member in kind.fields if kind is not None else ():
                present.setdefault(field_name(member.name), (scope, member.name))
        names = _standard_names(present, trace.env.get("domain") == "kernel")
    if event.name in asked.nameless:
        names = {place: name for place, name in names.items() if name != "procname"}
    columns: list[tuple[str, Shape]] = []
    steps: list[Step] = []
    for scope, kind in contexts:
        wanted = None if keep and asked.context else frozenset(n for s, n in names if s == scope)
        more, found = reader.scope(scope, kind, wanted)
        steps += more
        for name, shape in found:
            standard = names.get((scope, name)) or names.get((scope, "_" + name))
            columns.append((standard or f"context.{name}", shape))
    more, found = reader.scope("event.fields", event.fields, None if keep else frozenset())
    taken = {"time", "cpu", "pid", "tid", "procname", *(name for name, _ in columns)}
    for own, shape in found:
        name = own
        while name in taken:
            name = f"payload.{name}"
        taken.add(name)
        columns.append((name, shape))
    return steps + more, columns


def _standard_names(
    present: dict[str, tuple[str, str]], kernel: bool
) -> dict[tuple[str, str], str]:
    """Which context fields (scope, TSDL name) are the columns pid, tid and procname.

    A kernel trace's own pid and tid are those of the initial namespace; user space traces have
    ``vpid`` and ``vtid`` of the process's namespace only.
    """
    found: dict[tuple[str, str], str] = {}
    for column in ("pid", "tid"):
        candidates = (column, f"v{column}") if kernel else (f"v{column}", column)
        for candidate in [name for name in candidates if name in present][:1]:
            found[present[candidate]] = column
    if "procname" in present:
        found[present["procname"]] = "procname"
    return found


def _table(
    assembly: Assembly, name: str, columns: list[tuple[str, Shape]], reader: Reader, has_cpu: bool
) -> int:
    """The number of the table for events of this name and shape."""
    slots, counter = tuple(reader.slots), assembly.counters
    table = Table(name, tuple(columns), slots, reader.levels, has_cpu, counter)
    number = assembly.table_numbers.setdefault(table, len(assembly.tables))
    if number == len(assembly.tables):
        assembly.tables.append(table)
        assembly.counters += reader.levels
    return number


def _row_bytes(table: Table) -> list[int]:
    """The bytes that a row of each level of a table takes."""
    found = [0] * table.levels
    found[0] = 8 + 4 * table.has_cpu
    for slot in table.slots:
        found[slot.level] += np.dtype(slot.dtype).itemsize
    return found


def _id_table(assembly: Assembly, rows: dict[int, int]) -> list[int]:
    """Append a stream class's event ids; returns where they lie and the id to assume."""
    first = len(assembly.ids)
    dense = max((i + 1 for i in rows if i < _DENSE_IDS), default=0)
    assembly.ids += [rows.get(i, -1) for i in range(dense)]
    pairs = sorted((i, row) for i, row in rows.items() if i >= dense)  # searched by halves
    for identifier, row in pairs:
        assembly.ids += [identifier, row]
    return [first, dense, len(pairs), next(iter(rows)) if len(rows) == 1 else 0]


def _quick_header(header: StructType | None, big: bool) -> list[int]:
    """Alignment, id bits, clock shift and clock bits of LTTng's compact and large headers.

    Both put an id of few bits and the clock's low bits into one load, and announce anything
    larger by an id of all ones. Zeros for every other header, which is then interpreted.
    """
    none = [0, 0, 0, 0]
    match header:
        case StructType(
            fields=(
                Field("id", EnumType(container=IntegerType(signed=False) as number) as labels),
                Field(_, VariantType(tag="id", options=options)),
            )
        ) if not big:
            last = (1 << number.size) - 1
            ranges = {m.label: (m.low, m.high) for m in labels.mappings}
            compact = next((o.type for o in options if o.name == "compact"), None)
        case _:
            return none
    match compact:
        case StructType(fields=(Field(_, IntegerType(signed=False, clock=str()) as clock),)):
            pass
        case _:
            return none
    if (
        ranges != {"compact": (0, last - 1), "extended": (last, last)}
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
        case IntegerType(clock=str(name)) | EnumType(container=IntegerType(clock=str(name))):
            return [name]
        case StructType(fields=fields) | VariantType(options=fields):
            return [name for f in fields for name in _clock_names(f.type)]
    return []


def _frequency(stream: StreamClass, trace: TraceClass) -> int:
    """The rate of the clock that a stream's time stamps are mapped to, in Hz."""
    names = _clock_names(stream.event_header) + _clock_names(stream.packet_context)
    for name in names:
        if name not in trace.clocks:
            raise LayoutError(f"stream {stream.id} is mapped to the undeclared clock {name!r}")
    names += list(trace.clocks)
    return trace.clocks[names[0]].frequency if names else tb.BILLION


def _uuid_words(text: str) -> tuple[int, int]:
    try:
        data = UUID(text).bytes
    except ValueError:
        raise LayoutError(f"trace uuid {text!r} is none") from None
    low, high = np.frombuffer(data, "<i8")
    return int(low), int(high)
