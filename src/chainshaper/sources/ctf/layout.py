"""From a trace's metadata to the tables that the compiled kernels read.

Tables are of int64, a row per thing. A kernel gets the address of the one whose words (``M_…``) are
the addresses of the others: to count references to arrays would cost more than to read an event.

`lay_out` turns the types of all events into operations. Runs of fixed size that are not asked for
become one SKIP, so that an event that is not wanted costs one addition. Values of a column go to
one flat array, its *slot*, with a row per event: integers as they are, texts and bytes as their
code in a dictionary of all that are different.
"""

# ruff: noqa: PLR0917 - what is known of a trace on the way down its metadata

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from chainshaper.sources.ctf import tsdl

# fmt: off
# The machine. RANGES of variants' tags: low, high, operation to go on with. ROWS are the row
# counters of the tables, CAPS how far each may go. SLOTS is the dictionary's hash table, int32,
# MASK + 1 of them; ENTRIES are its ROOM strings. BATCHES has per event class a count and BATCH
# pairs (address, row).
(
    M_OPS, M_RANGES, M_STATE, M_ROWS, M_CAPS, M_SLOTS, M_MASK, M_ENTRIES, M_ROOM,
    M_STREAMS, M_EVENTS, M_IDS, M_BATCHES, MACHINE_WORDS,
) = range(14)

BATCH = 128

# The state: what a run reads and advances. BUDGET is what may still be spent (see `BUDGET`).
X_CLOCK, X_STRINGS, X_BUDGET, X_STACK = range(4)
STATE_WORDS = X_STACK + 16

# Packets, in order of the file: BYTE its offset there, END the end of the content and ERROR_AT in
# bits from the packet's start, STREAM the row of its class; from INSTANCE to CPU -1 where unknown;
# BEGIN and LAST in clock cycles, as the packet says; EARLIEST and LATEST are what its events' times
# can be.
(
    P_BYTE, P_END, P_STREAM, P_INSTANCE, P_BEGIN, P_LAST, P_SEQUENCE, P_DISCARDED, P_CPU,
    P_ERROR, P_ERROR_AT, P_BYTES, P_EARLIEST, P_LATEST, PACKET_COLUMNS,
) = range(15)
ALWAYS = (-(1 << 63), (1 << 63) - 1)
"""EARLIEST and LATEST of a packet that says no times."""

# Stream classes of all folders: operations (first, end) of packet HEADER, packet CONTEXT and EVENT
# header; LTTng's event headers in one load, ALIGN 0 where the header is another; event ids in the
# table of ids, a dense part, then pairs; bit n of KNOWN: register n is read in header or context;
# the COST of a packet; where an event's 32 bits of the process and the thread lie behind its header
# (ALIGN, PROCESS and THREAD, in bits; ALIGN 0 where that is not known, or the trace is a kernel's).
(
    S_ID, S_HEADER, S_HEADER_STOP, S_CONTEXT, S_CONTEXT_STOP, S_EVENT, S_EVENT_STOP,
    S_ALIGN, S_ID_BITS, S_SHIFT, S_CLOCK_BITS, S_ID_FIRST, S_ID_DENSE, S_ID_PAIRS, S_DEFAULT,
    S_FREQUENCY, S_KNOWN, S_UUID_LOW, S_UUID_HIGH, S_COST, S_PROCESS_ALIGN, S_PROCESS,
    S_THREAD, STREAM_COLUMNS,
) = range(24)

# Event classes of all stream classes: operations (first, end) of context and payload; ALIGN and
# SIZE where these are one constant step, else 0, and MOVED 1 where they only move what they read;
# the COUNTER of its table's rows, -1 where the event is not wanted; addresses of row 0 of TIME and
# CPU (or 0).
(
    E_WALK, E_WALK_STOP, E_ALIGN, E_SIZE, E_MOVED, E_COUNTER, E_TIME, E_CPU, E_COST, EVENT_COLUMNS,
) = range(10)

# Operations. Rows are two cache lines, and a shift away from each other.
(
    O_CODE,
    O_ALIGN,  # bits
    O_SIZE,  # bits; of one element for SKIP_MANY
    O_FLAGS,  # 1 signed, 2 big-endian, 4 advances the clock; 1: a text, which ends at a NUL
    O_ADDRESS,  # where row 0 of the slot lies, 0 for no slot
    O_WIDTH,  # bytes per row of the slot
    O_REGISTER,  # written by NUMBER, the length or tag for others; -1 for none
    O_COUNT,  # constant length; first range of SWITCH
    O_TARGET,  # operation to go on with
    O_LEAST,  # the least bits an element takes; number of ranges of SWITCH
    O_OFFSET,  # bytes from the aligned start of an event of constant layout
    O_COST,  # of an element of LOOP
) = range(12)
OPERATION_COLUMNS = 16

SKIP, NUMBER, MOVE, TEXT, CHARACTERS, SKIP_MANY, LOOP, AGAIN, SWITCH, JUMP = range(10)
"""In groups that run alike. MOVE: a NUMBER of 8, 4, 2 or 1 bytes as they lie in the packet."""

# Bytes per row.
P_ROW, S_ROW, E_ROW = 8 * PACKET_COLUMNS, 8 * STREAM_COLUMNS, 8 * EVENT_COLUMNS
O_ROW, B_ROW = 8 * OPERATION_COLUMNS, 8 * (1 + 2 * BATCH)

BUDGET = 64
"""What decoding may cost for each byte of a packet, and finding packets for each byte of a file.

An operation costs 1, a byte of a column as well: fields of no bits could else fill the memory.
"""
ZEROS = 32
"""So many bytes of zeros from an event's header on are no event."""
ENDLESS = 1 << 40
"""More elements than any packet has, even of no bits; times what one costs it is still a number."""

# Why a run ended early.
(
    ALL_ZEROS, NO_PROCESS, OTHER_TIME, OVER_BUDGET, FULL_TABLE, FULL_DICTIONARY, UNKNOWN_EVENT,
    UNTERMINATED, BAD_LENGTH, NO_OPTION, TRUNCATED,
) = range(-11, 0)

# How a scan for packets ended, and what was wrong where.
DONE, FULL, BAD_MAGIC, BAD_UUID, BAD_STREAM, BAD_SIZE, BAD_HEADER, CUT, COSTLY = range(9)

REGISTERS = dict(zip((
    "id", "magic", "stream_id", "stream_instance_id", "timestamp_begin", "timestamp_end",
    "packet_seq_num", "events_discarded", "cpu_id", "content_size", "packet_size",
    "uuid_low", "uuid_high",
), range(13), strict=True))
"""The numbers that the decoder itself needs, by their TSDL name in packet header and context."""
(
    R_ID, R_MAGIC, R_STREAM, R_INSTANCE, R_BEGIN, R_END, R_SEQUENCE, R_DISCARDED, R_CPU,
    R_CONTENT, R_PACKET, R_UUID_LOW, R_UUID_HIGH,
) = range(13)

MAGIC = 0xC1FC1FC1
BILLION = 1_000_000_000
ONES = np.uint64(0x0101010101010101)
HIGHS = np.uint64(0x8080808080808080)
FACTOR = np.uint64(0x9E3779B97F4A7C15)
LOW = np.uint64(0xFFFFFFFF)
U0, U1, U8, U29, U32, U64 = (np.uint64(n) for n in (0, 1, 8, 29, 32, 64))

# fmt: on

_DEEPEST = 12
_MOST_STEPS = 200_000
"""Types to lay out in a trace: one with all the kernel's events has some 10,000."""
# More bits than any packet has: sizes beyond are all the same and must not overflow int64.
_ENDLESS_BITS = 1 << 56
_DENSE_IDS = 4096


class LayoutError(ValueError):
    """Types that cannot be laid out: an unresolved length or tag, too deep a nesting."""


class Table(NamedTuple):
    """Where the events of one name and one shape go: ``time``, ``cpu`` where known, ``columns``."""

    name: str
    columns: tuple[tuple[str, tsdl.Type], ...]
    has_cpu: bool

    def slot_types(self) -> list[np.dtype[Any]]:
        """What each column's slot has: integers, or codes in the dictionary."""
        return [
            np.dtype(f"{'i' if kind.signed else 'u'}{1 << ((kind.size + 7 >> 3) - 1).bit_length()}")
            if isinstance(kind, tsdl.IntegerType)
            else np.dtype("u4")
            for _, kind in self.columns
        ]


_Scopes = Mapping[str, tsdl.StructType | None]
"""Dynamic scopes (``stream.event.context``, …) and their structures."""
_Named = Mapping[tuple[str, str], str]
"""Scope and field (as in TSDL) → the column that it gets."""


class Event(NamedTuple):
    """An event class: its row, its stream class's row, its columns' operations."""

    name: str
    row: list[int]
    stream: int
    columns: list[list[int]]


@dataclass
class Layout:
    """Tables for the kernels, and what their rows mean.

    ``folders`` has the rows of each folder's stream classes (first, end), ``steps`` counts the
    types that were laid out, ``labels`` has the ranges of enumerations by label; the rows of
    ``tables`` are counted in this order.
    """

    operations: list[list[int]] = field(default_factory=list)
    ranges: list[list[int]] = field(default_factory=list)
    streams: list[list[int]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    folders: list[tuple[int, int]] = field(default_factory=list)
    tables: dict[Table, list[Event]] = field(default_factory=dict)
    ids: list[int] = field(default_factory=list)
    registers: int = len(REGISTERS)
    steps: int = 0
    labels: dict[int, dict[str, list[tuple[int, int]]]] = field(default_factory=dict)
    _arrays: dict[int, NDArray[np.int64]] = field(default_factory=dict)

    def arrays(self) -> dict[int, NDArray[np.int64]]:
        """The kernels' tables by their word in the machine, none of them empty."""
        if not self._arrays:
            rows = {M_OPS: self.operations, M_RANGES: self.ranges, M_STREAMS: self.streams}
            rows |= {M_EVENTS: [one.row for one in self.events], M_IDS: [[n] for n in self.ids]}
            self._arrays = {word: np.array(t or [[0]], np.int64) for word, t in rows.items()}
        return self._arrays

    def attach(self, table: Table, time: int, cpu: int, slots: Sequence[tuple[int, int]]) -> None:
        """Have a table's events write to its columns, whose addresses and widths these are."""
        self._arrays = {}
        for event in self.tables[table]:
            event.row[E_TIME], event.row[E_CPU] = time, cpu
            for column, slot in zip(event.columns, slots, strict=True):
                column[O_ADDRESS : O_WIDTH + 1] = slot

    def step(self, start: int, stop: int) -> tuple[int, int, bool]:
        """ALIGN, SIZE and MOVED of an event; notes where its operations read."""
        align, position, numbers = 1, 0, False
        for row in self.operations[start:stop]:
            align = align if position else max(align, row[O_ALIGN])
            number = row[O_CODE] == NUMBER and not row[O_FLAGS] & 4
            constant = number or row[O_CODE] in {SKIP, MOVE, CHARACTERS}
            if not constant or row[O_REGISTER] >= 0 or row[O_ALIGN] > align:
                return 0, 0, False
            numbers |= number
            position += -position % row[O_ALIGN]
            row[O_OFFSET] = position >> 3
            position += 8 * row[O_COUNT] if row[O_CODE] == CHARACTERS else row[O_SIZE]
        return align, position, align >= 8 and position > 0 and not numbers

    def cost(self, start: int, stop: int) -> int:
        """What running operations once costs at most, the turns of their loops aside."""
        rows = self.operations[start:stop]
        return len(rows) + sum(row[O_LEAST] for row in rows if row[O_CODE] == SWITCH)


def lay_out(traces: Sequence[tsdl.TraceClass], wanted: Mapping[str, bool]) -> Layout:
    """Lay out every stream and event class. Raises `CtfError` for types that cannot be read.

    Events that are ``wanted`` get a table with pid and tid, and the procname where that is true.
    """
    layout = Layout()
    for trace in traces:
        first = len(layout.streams)
        try:
            header = _Writer(layout, trace.byte_order == "be", trace.referenced)
            in_header = header.run({"trace.packet.header": trace.packet_header}, {})
            for stream in trace.streams.values():
                _add_stream(layout, trace, stream, header.following(True), in_header, wanted)
        except LayoutError as error:
            file = trace.path / "metadata"
            raise tsdl.CtfError(file, None, str(error), "the trace cannot be read") from None
        layout.folders.append((first, len(layout.streams)))
    return layout


# Types


class _Number(NamedTuple):
    """An integer that lengths and tags can refer to."""

    register: int
    signed: bool
    mappings: tuple[tuple[str, int, int], ...]


_Frame = dict[str, "_Number | _Frame"]


class _Place(NamedTuple):
    """Where a type stands: the numbers around it, and whether it gets a column."""

    frames: tuple[_Frame, ...]
    has_column: bool

    def inside(self, frame: _Frame) -> _Place:
        """In a structure, variant or array, whose members get no columns."""
        return _Place((*self.frames, frame), False)


@dataclass
class _Writer:
    """Writes the operations of types that follow each other.

    ``columns`` are those that write to one each. ``roots`` maps a dynamic scope to the numbers read
    there so far; a number whose name is ``referenced`` gets a register, ``registers`` the next one.
    In headers (``fixed``) the numbers of REGISTERS have those.
    """

    layout: Layout
    big: bool
    referenced: frozenset[str]
    fixed: bool = True
    registers: int = len(REGISTERS)
    roots: dict[str, _Frame] = field(default_factory=dict)
    columns: list[list[int]] = field(default_factory=list)
    start: int = field(default=0, init=False)

    def following(self, fixed: bool) -> _Writer:
        """A writer for what follows in one of several places."""
        return replace(self, roots=dict(self.roots), columns=[], fixed=fixed)

    def run(self, scopes: _Scopes, named: _Named) -> tuple[int, int]:
        """Lay out scopes: their first operation and the one after the last."""
        self.start = len(self.layout.operations)
        for scope, kind in scopes.items():
            frame = self.roots[scope] = _Frame()
            if kind is not None:
                self._skip(kind.align, 0)
            for name, member in kind.fields if kind is not None else ():
                place = _Place((frame,), (scope, name) in named)
                match member if self.fixed and name == "uuid" else None:
                    case tsdl.ArrayType(tsdl.IntegerType(8, 8), 16):
                        half = tsdl.IntegerType(64, 8, byte_order="le")
                        self._number("uuid_low", half, place)
                        self._number("uuid_high", half, place)
                    case _:
                        self._type(name, member, place)
        self.layout.registers = max(self.layout.registers, self.registers)
        return self.start, len(self.layout.operations)

    def _type(self, name: str, kind: tsdl.Type, at: _Place) -> int:
        """Lay out a type; returns the least number of bits that it takes, alignment aside."""
        self.layout.steps += 1
        if len(at.frames) > _DEEPEST or self.layout.steps > _MOST_STEPS:
            raise LayoutError(f"{name}: types nested too deeply")
        match kind:
            case tsdl.StringType():
                self._row(TEXT, {O_ALIGN: 8, O_FLAGS: 1}, at)
                return 8
            case tsdl.StructType():
                frame = at.frames[-1][name] = _Frame()
                self._skip(kind.align, 0)
                return sum(self._type(f.name, f.type, at.inside(frame)) for f in kind.fields)
            case tsdl.ArrayType():
                return min(self._array(name, kind, at), _ENDLESS_BITS)
            case tsdl.VariantType():
                return self._variant(name, kind, at)
        return self._number(name, kind, at)

    def _number(self, name: str, kind: tsdl.IntegerType, at: _Place) -> int:
        big = self.big if kind.byte_order == "native" else kind.byte_order == "be"
        register, clock = -1, kind.clock is not None
        if self.fixed and name in REGISTERS and (len(at.frames) == 1 or name == "id"):
            register = REGISTERS[name]
            # The end of a packet is no instant that its events follow.
            clock = clock and register != R_END
        elif name in self.referenced:
            register, self.registers = self.registers, self.registers + 1
        at.frames[-1][name] = _Number(register, kind.signed, kind.mappings)
        if not at.has_column and register < 0 and not clock:
            self._skip(kind.align, kind.size)
            return kind.size
        flags = kind.signed + 2 * big + 4 * clock
        # Whether its bytes are the same in a packet and in its slot.
        alike = kind.align >= 8 and kind.size in {8, 16, 32, 64} and (kind.size == 8 or not big)
        code = MOVE if alike and not clock and register < 0 else NUMBER
        columns = {O_ALIGN: kind.align, O_SIZE: kind.size, O_FLAGS: flags, O_REGISTER: register}
        self._row(code, columns, at)
        return kind.size

    def _array(self, name: str, kind: tsdl.ArrayType, at: _Place) -> int:
        rows, count, register = self.layout.operations, 0, -1
        if isinstance(kind.length, int):
            count = kind.length
        else:
            register = self._referred(kind.length, at).register
        columns = {O_ALIGN: tsdl.alignment(kind), O_REGISTER: register, O_COUNT: count}
        if at.has_column:
            self._row(CHARACTERS, {**columns, O_FLAGS: int(tsdl.is_text(kind))}, at)
            return 8 * count
        loop, first = self._row(LOOP, columns), len(rows)
        least = self._type(f"{name}[]", kind.element, at.inside({}))
        only = rows[first] if len(rows) == first + 1 else loop
        even = only[O_CODE] == SKIP and only[O_SIZE] % only[O_ALIGN] == 0
        if even and (register < 0 or only[O_SIZE] == 0):  # 0: an array of empty structures
            del rows[first - 1 :]
            self._skip(max(tsdl.alignment(kind), only[O_ALIGN]), only[O_SIZE] * count)
        elif even:
            loop[O_CODE], loop[O_SIZE] = SKIP_MANY, only[O_SIZE]
            del rows[first:]
        else:
            self._row(AGAIN, {O_TARGET: first})
            loop[O_TARGET], loop[O_LEAST] = len(rows), least
            loop[O_COST] = self.layout.cost(first, len(rows))
        return count * least

    def _variant(self, name: str, kind: tsdl.VariantType, at: _Place) -> int:
        if kind.tag is None:
            raise LayoutError(f"variant {name!r} has no tag")
        rows, ranges, tag = self.layout.operations, self.layout.ranges, self._referred(kind.tag, at)
        first, by_label = len(ranges), self._ranges_by_label(tag)
        for number, option in enumerate(kind.options):
            for label in dict.fromkeys((option.name, option.name.removeprefix("_"))):
                ranges += [[low, high, number] for low, high in by_label.get(label, ())]
        own = ranges[first:]
        self.layout.steps += len(own)
        columns = {O_REGISTER: tag.register, O_FLAGS: int(tag.signed)}
        self._row(SWITCH, {**columns, O_COUNT: first, O_LEAST: len(own)})
        frame = at.frames[-1][name] = _Frame()
        begins, jumps, least = [], [], []
        for option in kind.options:
            begins.append(len(rows))
            least.append(self._type(option.name, option.type, at.inside(frame)))
            jumps.append(self._row(JUMP, {}))
        for jump in jumps:
            jump[O_TARGET] = len(rows)
        for one in own:
            one[2] = begins[one[2]]
        return min(least, default=0)

    def _ranges_by_label(self, tag: _Number) -> dict[str, list[tuple[int, int]]]:
        """The values that choose each option of a variant; variants may share an enumeration."""
        found = self.layout.labels.get(id(tag.mappings))
        if found is None:
            found = self.layout.labels[id(tag.mappings)] = {}
            # Unsigned tags are compared as signed numbers, both with their top bit turned.
            first, turned = (-(1 << 63), 0) if tag.signed else (0, 1 << 63)
            last = first + (1 << 64) - 1
            for label, low, high in tag.mappings:
                if low <= last and high >= first:
                    ends = max(low, first) - turned, min(high, last) - turned
                    found.setdefault(label, []).append(ends)
        return found

    def _referred(self, path: str, at: _Place) -> _Number:
        """The number that a length or tag path names, relative or absolute (section 7.3.2)."""
        places = [(f, path[len(root) + 1 :]) for root, f in self.roots.items()
                  if path.startswith(root + ".")]  # fmt: skip
        places += [(f, path) for f in (*reversed(at.frames), *reversed(self.roots.values()))]
        for frame, names in places:
            found: _Number | _Frame | None = frame
            for name in names.split("."):
                found = found.get(name) if isinstance(found, dict) else None
            if isinstance(found, _Number):
                return found
        raise LayoutError(f"length or tag {path!r} names no number that is read before it")

    def _row(self, code: int, columns: dict[int, int], at: _Place | None = None) -> list[int]:
        row = [0] * OPERATION_COLUMNS
        for column, value in {O_CODE: code, O_ALIGN: 1, O_REGISTER: -1, **columns}.items():
            row[column] = value
        self.layout.operations.append(row)
        if at is not None and at.has_column:
            self.columns.append(row)
        return row

    def _skip(self, align: int, size: int) -> None:
        """Skip ``size`` bits, in one operation with what is skipped before where that is alike."""
        rows, size = self.layout.operations, min(size, _ENDLESS_BITS)
        last = rows[-1] if len(rows) > self.start else [TEXT]
        if last[O_CODE] == SKIP and (
            last[O_SIZE] == 0 or (align <= last[O_ALIGN] and last[O_SIZE] % align == 0)
        ):
            last[O_ALIGN] = max(last[O_ALIGN], align)
            last[O_SIZE] = min(last[O_SIZE] + size, _ENDLESS_BITS)
        else:
            self._row(SKIP, {O_ALIGN: align, O_SIZE: size})


# Stream and event classes


def _add_stream(
    layout: Layout,
    trace: tsdl.TraceClass,
    stream: tsdl.StreamClass,
    header: _Writer,
    in_header: tuple[int, int],
    wanted: Mapping[str, bool],
) -> None:
    in_context = header.run({"stream.packet.context": stream.packet_context}, {})
    in_event = header.run({"stream.event.header": stream.event_header}, {})
    row = [0] * STREAM_COLUMNS
    row[S_ID : S_EVENT_STOP + 1] = [stream.id, *in_header, *in_context, *in_event]
    row[S_ALIGN : S_CLOCK_BITS + 1] = _quick_header(stream.event_header, header.big)
    row[S_FREQUENCY] = _frequency(stream, trace)
    row[S_COST] = P_ROW + layout.cost(*in_header) + layout.cost(*in_context)
    for scope in ("trace.packet.header", "stream.packet.context"):
        for number in header.roots[scope].values():
            if isinstance(number, _Number) and 0 <= number.register < len(REGISTERS):
                row[S_KNOWN] |= 1 << number.register
    if trace.uuid is None:
        row[S_KNOWN] &= ~(1 << R_UUID_LOW)
    else:
        try:
            row[S_UUID_LOW], row[S_UUID_HIGH] = struct.unpack("<qq", UUID(trace.uuid).bytes)
        except ValueError:
            raise LayoutError(f"trace uuid {trace.uuid!r} is none") from None
    has_cpu, kernel = bool(row[S_KNOWN] >> R_CPU & 1), trace.env.get("domain") == "kernel"
    row[S_PROCESS_ALIGN : S_THREAD + 1] = [0, 0, 0] if kernel else _places_of_process(stream)
    ids = {}
    for event in stream.events.values():
        ids[event.id] = len(layout.events)
        scopes = {"stream.event.context": stream.event_context, "event.context": event.context}
        scopes["event.fields"] = event.fields
        named, columns = _columns(scopes, kernel, wanted.get(event.name))
        writer = header.following(False)
        own = Event(event.name, [0] * EVENT_COLUMNS, len(layout.streams), writer.columns)
        layout.events.append(own)
        start, stop = own.row[E_WALK], own.row[E_WALK_STOP] = writer.run(scopes, named)
        own.row[E_ALIGN : E_MOVED + 1] = layout.step(start, stop)
        own.row[E_COUNTER], own.row[E_COST] = -1, layout.cost(start, stop) + layout.cost(*in_event)
        if event.name in wanted:
            table = Table(event.name, columns, has_cpu)
            alike = layout.tables.setdefault(table, [])
            own.row[E_COUNTER] = alike[0].row[E_COUNTER] if alike else len(layout.tables) - 1
            own.row[E_COST] += 8 + 4 * has_cpu + sum(one.itemsize for one in table.slot_types())
            alike.append(own)
    row[S_ID_FIRST : S_DEFAULT + 1] = _id_table(layout, ids)
    layout.streams.append(row)


def _places_of_process(stream: tsdl.StreamClass) -> list[int]:
    """The alignment of what follows an event's header, and the bits of ``vpid`` and ``vtid`` in it.

    All are 0 where these are not both of 32 bits at a constant place.
    """
    position, context = 0, stream.event_context or tsdl.StructType()
    places: dict[str, int] = {}
    for name, kind in context.fields:
        position += -position % tsdl.alignment(kind)
        match kind:
            case tsdl.IntegerType(size=size):
                if size == 32 and kind.align >= 8:
                    places[tsdl.field_name(name)] = position
                position += size
            case tsdl.ArrayType(tsdl.IntegerType(size, align), int(count)) if size % align == 0:
                position += count * size
            case _:
                break
    if {"vpid", "vtid"} <= places.keys():
        return [context.align, places["vpid"], places["vtid"]]
    return [0, 0, 0]


def _columns(
    scopes: _Scopes, kernel: bool, procname: bool | None
) -> tuple[_Named, tuple[tuple[str, tsdl.Type], ...]]:
    """The fields of an event behind its header that get columns, and the columns in their order.

    There are none where ``procname``, whether that is one of them, is None.
    A kernel trace's pid and tid are of the initial namespace; user space traces have ``vpid`` and
    ``vtid`` of the process's only.
    """
    if procname is None:
        return {}, ()
    members = {
        (scope, member.name): member.type
        for scope, kind in scopes.items()
        for member in (kind.fields if kind is not None else ())
        if _has_column(member.type)
    }
    contexts = [place for place in members if place[0] != "event.fields"]
    present = {tsdl.field_name(place[1]): place for place in reversed(contexts)}
    named: dict[tuple[str, str], str] = {}
    for column in ("pid", "tid", "procname") if procname else ("pid", "tid"):
        names = (column, f"v{column}") if kernel else (f"v{column}", column)
        if found := next((present[name] for name in names if name in present), None):
            named[found] = column
    taken = {"time", "cpu", "pid", "tid", "procname"}
    for place in members:
        if place[0] == "event.fields":
            name = tsdl.field_name(place[1])
            while name in taken:
                name = f"payload.{name}"
            taken.add(name)
            named[place] = name
    return named, tuple((named[place], kind) for place, kind in members.items() if place in named)


def _has_column(kind: tsdl.Type) -> bool:
    match kind:
        case tsdl.IntegerType() | tsdl.StringType() | tsdl.ArrayType(tsdl.IntegerType(8, 8)):
            return True
    return False


def _id_table(layout: Layout, rows: dict[int, int]) -> list[int]:
    """Append a stream class's event ids; where they lie, and the id to assume."""
    first = len(layout.ids)
    dense = max((i + 1 for i in rows if i < _DENSE_IDS), default=0)
    layout.ids += [rows.get(i, -1) for i in range(dense)]
    pairs = sorted((i, row) for i, row in rows.items() if i >= dense)  # searched by halves
    layout.ids += [number for pair in pairs for number in pair]
    return [first, dense, len(pairs), next(iter(rows)) if len(rows) == 1 else 0]


def _quick_header(header: tsdl.StructType | None, big: bool) -> list[int]:
    """Alignment, id bits, clock shift and clock bits of LTTng's compact and large headers.

    Both put an id of few bits and the clock's low bits into one load, and announce anything
    larger by an id of all ones. Zeros for every other header, which is then interpreted.
    """
    match header:
        case tsdl.StructType(
            [
                ("id", tsdl.IntegerType(signed=False) as number),
                (
                    _,
                    tsdl.VariantType("id", [("compact", tsdl.StructType([(_, clock)], inner)), *_]),
                ),
            ],
            align,
        ) if isinstance(clock, tsdl.IntegerType) and clock.clock is not None and not big:
            last, shift = (1 << number.size) - 1, -(-number.size // inner) * inner
            ranges = {("compact", 0, last - 1), ("extended", last, last)}
            quick = ranges == {*number.mappings}
            quick &= "be" not in (number.byte_order, clock.byte_order) and not clock.signed
            quick &= clock.size <= 63 and shift + clock.size <= 64
            if quick and align >= max(8, inner):
                return [align, number.size, shift, clock.size]
    return [0, 0, 0, 0]


def _clock_names(kind: tsdl.Type | None) -> list[str]:
    match kind:
        case tsdl.IntegerType(clock=str(name)):
            return [name]
        case tsdl.StructType(fields=fields) | tsdl.VariantType(options=fields):
            return [name for f in fields for name in _clock_names(f.type)]
    return []


def _frequency(stream: tsdl.StreamClass, trace: tsdl.TraceClass) -> int:
    """The rate of the clock that a stream's time stamps are mapped to, in Hz."""
    names = _clock_names(stream.event_header) + _clock_names(stream.packet_context)
    for name in names:
        if name not in trace.clocks:
            raise LayoutError(f"stream {stream.id} is mapped to the undeclared clock {name!r}")
    names += list(trace.clocks)
    return trace.clocks[names[0]].frequency if names else BILLION
