"""The compiled passes over a trace that find packets and count events.

They run without Python's lock.  Tables are of int64, given by their addresses (see
`machine.Machine`), with the columns named in `tables`; `layout` and `program` say what the
operations in them mean.  `filling` holds the pass that writes columns.
"""

# Kernels take many numbers rather than objects, which Numba would have to count references to.
# ruff: noqa: PLR0911, PLR0917

from __future__ import annotations

from typing import Any

import numpy as np

from chainshaper.compiled.memory import compiled, get, load_word, put
from chainshaper.sources.ctf.interpreter import advance_clock, execute
from chainshaper.sources.ctf.machine import Failure, Machine, State
from chainshaper.sources.ctf.tables import (
    BAD_HEADER,
    BAD_MAGIC,
    BAD_SIZE,
    BAD_STREAM,
    BAD_UUID,
    BILLION,
    CUT,
    DONE,
    E_ALIGN,
    E_COUNTER,
    E_LEVELS,
    E_ROW,
    E_SIZE,
    E_WALK,
    E_WALK_STOP,
    FULL,
    MAGIC,
    P_BEGIN,
    P_BYTE,
    P_BYTES,
    P_CPU,
    P_DISCARDED,
    P_END,
    P_ERROR,
    P_ERROR_AT,
    P_INSTANCE,
    P_LAST,
    P_ROW,
    P_SEQUENCE,
    P_STREAM,
    R_BEGIN,
    R_CONTENT,
    R_CPU,
    R_DISCARDED,
    R_END,
    R_ID,
    R_INSTANCE,
    R_MAGIC,
    R_PACKET,
    R_SEQUENCE,
    R_STREAM,
    R_UUID_HIGH,
    R_UUID_LOW,
    S_ALIGN,
    S_CLOCK_BITS,
    S_CONTEXT,
    S_CONTEXT_STOP,
    S_DEFAULT,
    S_EVENT,
    S_EVENT_STOP,
    S_FREQUENCY,
    S_HEADER,
    S_HEADER_STOP,
    S_ID,
    S_ID_BITS,
    S_ID_DENSE,
    S_ID_FIRST,
    S_ID_PAIRS,
    S_KNOWN,
    S_ROW,
    S_SHIFT,
    S_UUID_HIGH,
    S_UUID_LOW,
)

__all__ = [
    "copy_numbers",
    "nanoseconds",
    "open_packet",
    "read_header",
    "scan_packets",
    "step_over",
    "walk_events",
]

CLOCK = int(State.CLOCK)
UNSORTED, LATEST = int(State.UNSORTED), int(State.LATEST)
M_STREAMS, M_EVENTS, M_IDS, M_COUNTERS, M_BATCHES = (
    int(Machine.STREAMS),
    int(Machine.EVENTS),
    int(Machine.IDS),
    int(Machine.COUNTERS),
    int(Machine.BATCHES),
)
M_STATE, M_ROWS, M_CAPS, M_SAVED = (
    int(Machine.STATE),
    int(Machine.ROWS),
    int(Machine.CAPS),
    int(Machine.SAVED),
)
U1 = np.uint64(1)
FULL_TABLE, UNKNOWN_EVENT = int(Failure.FULL_TABLE), int(Failure.UNKNOWN_EVENT)


@compiled(inline=True)
def nanoseconds(cycles: Any, frequency: Any) -> Any:
    """Clock cycles in ns, rounded down."""
    if frequency == BILLION:
        return cycles
    count, rate = np.uint64(cycles), np.uint64(frequency)
    whole, rest = count // rate, count % rate
    return np.int64(whole * np.uint64(BILLION) + rest * np.uint64(BILLION) // rate)


@compiled(inline=True)
def known_or(known: Any, register: Any, regs: Any, default: Any) -> Any:
    """A number of the packet header or context, or ``default`` where it has none."""
    return get(regs, register) if known >> register & 1 else default


@compiled()
def note_packet(
    packet: Any, offset: Any, mapped: Any, stream: Any, known: Any, regs: Any, end: Any
) -> None:
    """Fill a row of the table of packets."""
    bits = known_or(known, R_PACKET, regs, mapped * 8)
    put(packet, P_BYTE, offset)
    put(packet, P_BYTES, min(bits >> 3, mapped))
    put(packet, P_END, min(end, mapped * 8))
    put(packet, P_STREAM, stream)
    put(packet, P_INSTANCE, known_or(known, R_INSTANCE, regs, np.int64(-1)))
    put(packet, P_BEGIN, known_or(known, R_BEGIN, regs, np.int64(-1)))
    put(packet, P_LAST, known_or(known, R_END, regs, np.int64(-1)))
    put(packet, P_SEQUENCE, known_or(known, R_SEQUENCE, regs, np.int64(-1)))
    put(packet, P_DISCARDED, known_or(known, R_DISCARDED, regs, np.int64(-1)))
    put(packet, P_CPU, known_or(known, R_CPU, regs, np.int64(-1)))
    put(packet, P_ERROR, np.int64(0))


@compiled()
def scan_packets(
    machine: Any,
    regs: Any,
    base: Any,
    size: Any,
    packets: Any,
    room: Any,
    reached: Any,
    first: Any,
    last: Any,
) -> Any:
    """Find the packets of a file from where an earlier call stopped (section 5).

    ``reached`` are two numbers that advance: the offset in the file and the packets found.  The
    folder's stream classes are the rows [first, last).  Returns the status; a packet that the
    file cuts short is listed with status CUT.
    """
    streams = get(machine, M_STREAMS)
    leading = streams + first * S_ROW
    while get(reached, 0) < size:
        offset, found = get(reached, 0), get(reached, 1)
        if found >= room:
            return np.int64(FULL)
        start, mapped = base + offset, size - offset
        known = get(leading, S_KNOWN)
        put(regs, R_STREAM, get(leading, S_ID))
        position = execute(
            machine, get(leading, S_HEADER), get(leading, S_HEADER_STOP),
            start, mapped, mapped * 8, np.int64(0), regs, np.int64(0),
        )  # fmt: skip
        if position < 0:
            return np.int64(BAD_HEADER)
        if known >> R_MAGIC & 1 and get(regs, R_MAGIC) != MAGIC:
            return np.int64(BAD_MAGIC)
        if known >> R_UUID_LOW & 1 and (
            get(regs, R_UUID_LOW) != get(leading, S_UUID_LOW)
            or get(regs, R_UUID_HIGH) != get(leading, S_UUID_HIGH)
        ):
            return np.int64(BAD_UUID)
        stream = first
        while stream < last and get(streams + stream * S_ROW, S_ID) != get(regs, R_STREAM):
            stream += 1
        if stream == last:
            return np.int64(BAD_STREAM)
        row = streams + stream * S_ROW
        position = execute(
            machine, get(row, S_CONTEXT), get(row, S_CONTEXT_STOP),
            start, mapped, mapped * 8, position, regs, np.int64(0),
        )  # fmt: skip
        if position < 0:
            return np.int64(BAD_HEADER)
        known = get(row, S_KNOWN)
        bits = known_or(known, R_PACKET, regs, mapped * 8)
        content = known_or(known, R_CONTENT, regs, bits)
        if bits <= 0 or bits & 7 or content < position or content > bits:
            return np.int64(BAD_SIZE)
        note_packet(packets + found * P_ROW, offset, mapped, stream, known, regs, content)
        put(reached, 1, found + 1)
        if bits >> 3 > mapped:
            return np.int64(CUT)
        put(reached, 0, offset + (bits >> 3))
    return np.int64(DONE)


@compiled()
def open_packet(machine: Any, packet: Any, base: Any, size: Any, regs: Any) -> Any:
    """Read a packet's header and context anew; returns the position of the first event."""
    stream = get(machine, M_STREAMS) + get(packet, P_STREAM) * S_ROW
    at, end = get(packet, P_BYTE), get(packet, P_END)
    position = execute(
        machine, get(stream, S_HEADER), get(stream, S_HEADER_STOP),
        base + at, size - at, end, np.int64(0), regs, np.int64(0),
    )  # fmt: skip
    if position < 0:
        return position
    return execute(
        machine, get(stream, S_CONTEXT), get(stream, S_CONTEXT_STOP),
        base + at, size - at, end, position, regs, np.int64(0),
    )  # fmt: skip


@compiled(inline=True)
def event_class(machine: Any, stream: Any, identifier: Any) -> Any:
    """The row of the event classes that an id names in a stream class, or -1."""
    ids = get(machine, M_IDS) + 8 * get(stream, S_ID_FIRST)
    dense = get(stream, S_ID_DENSE)
    if 0 <= identifier < dense:
        return get(ids, identifier)
    for index in range(dense, dense + 2 * get(stream, S_ID_PAIRS), 2):
        if get(ids, index) == identifier:
            return get(ids, index + 1)
    return np.int64(-1)


@compiled()
def read_other_header(
    machine: Any, stream: Any, start: Any, mapped: Any, end: Any, position: Any, regs: Any
) -> Any:
    """`read_header` for every form of header, by its operations."""
    put(regs, R_ID, get(stream, S_DEFAULT))
    after = execute(
        machine, get(stream, S_EVENT), get(stream, S_EVENT_STOP),
        start, mapped, end, position, regs, np.int64(0),
    )  # fmt: skip
    if after < 0:
        return after, np.int64(-1)
    event = event_class(machine, stream, get(regs, R_ID))
    return (after if event >= 0 else np.int64(UNKNOWN_EVENT)), event


@compiled(inline=True)
def read_header(
    machine: Any, stream: Any, start: Any, mapped: Any, end: Any, position: Any, regs: Any
) -> Any:
    """Read an event header; returns (position after or a failure, event class)."""
    align = get(stream, S_ALIGN)
    if align != 0:
        at = (position + align - 1) & -align
        shift, bits = get(stream, S_SHIFT), get(stream, S_CLOCK_BITS)
        after = at + shift + bits
        if after <= end and (at >> 3) + 8 <= mapped:
            word = load_word(start + (at >> 3))
            mask = (U1 << np.uint64(get(stream, S_ID_BITS))) - U1
            identifier = np.int64(word & mask)
            if word & mask != mask:
                low = (word >> np.uint64(shift)) & ((U1 << np.uint64(bits)) - U1)
                advance_clock(get(machine, M_STATE), low, bits)
                put(regs, R_ID, identifier)
                event = event_class(machine, stream, identifier)
                return (after if event >= 0 else np.int64(UNKNOWN_EVENT)), event
    return read_other_header(machine, stream, start, mapped, end, position, regs)


@compiled(inline=True)
def step_over(
    machine: Any, row: Any, start: Any, mapped: Any, end: Any, position: Any, regs: Any
) -> Any:
    """The position behind an event's contexts and payload, or a failure."""
    align = get(row, E_ALIGN)
    if align != 0:
        position = ((position + align - 1) & -align) + get(row, E_SIZE)
        return position if position <= end else np.int64(-1)
    return execute(
        machine, get(row, E_WALK), get(row, E_WALK_STOP),
        start, mapped, end, position, regs, np.int64(0),
    )  # fmt: skip


@compiled()
def copy_numbers(target: Any, source: Any, count: Any) -> None:
    """Copy ``count`` numbers from one table to another."""
    for index in range(count):
        put(target, index, get(source, index))


@compiled()
def walk_events(
    machine: Any,
    regs: Any,
    base: Any,
    size: Any,
    packets: Any,
    first: Any,
    last: Any,
    counts: Any,
    borders: Any,
    border: Any,
    spans: Any,
    marks: Any,
) -> Any:
    """Step through every event of the ``packets`` [first, last) of a file.

    Advances ``counts`` per event class and the row counters per level.  ``borders`` are
    ``spans`` instants (ns, ascending), those before number ``border`` being done; for each, the
    row of ``marks`` gets the first event at or after it (packet, position, clock) and the row
    counters before it.  Returns the next border.  An event that cannot be read ends its packet:
    the packet's END becomes that event's position, ERROR the failure, ERROR_AT where.
    """
    state, rows, events = get(machine, M_STATE), get(machine, M_ROWS), get(machine, M_EVENTS)
    saved, counters = get(machine, M_SAVED), get(machine, M_COUNTERS)
    for index in range(first, last):
        packet = packets + index * P_ROW
        stream = get(machine, M_STREAMS) + get(packet, P_STREAM) * S_ROW
        at, end, frequency = get(packet, P_BYTE), get(packet, P_END), get(stream, S_FREQUENCY)
        start, mapped = base + at, size - at
        position = open_packet(machine, packet, base, size, regs)
        if position < 0:
            put(packet, P_ERROR, position)
            put(packet, P_ERROR_AT, np.int64(0))
            put(packet, P_END, np.int64(0))
            continue
        while position < end:
            before = get(state, CLOCK)
            after, event = read_header(machine, stream, start, mapped, end, position, regs)
            time = nanoseconds(get(state, CLOCK), frequency)
            counter, levels, row = np.int64(-1), np.int64(0), events
            if after >= 0:
                while border < spans and time >= get(borders, border):
                    mark = marks + 8 * border * (3 + counters)
                    put(mark, 0, index)
                    put(mark, 1, position)
                    put(mark, 2, before)
                    copy_numbers(mark + 24, rows, counters)
                    border += 1
                row = events + event * E_ROW
                counter, levels = get(row, E_COUNTER), get(row, E_LEVELS)
                if levels > 1:
                    copy_numbers(saved, rows + 8 * counter, levels)
                after = step_over(machine, row, start, mapped, end, after, regs)
            if after < 0 or after == position:
                if levels > 1:
                    copy_numbers(rows + 8 * counter, saved, levels)
                put(packet, P_ERROR, min(after, np.int64(-1)))
                put(packet, P_ERROR_AT, position)
                put(packet, P_END, position)
                put(state, CLOCK, before)
                break
            if time < get(state, LATEST):
                put(state, UNSORTED, np.int64(1))
            put(state, LATEST, time)
            put(counts, event, get(counts, event) + 1)
            if counter >= 0:
                put(rows, counter, get(rows, counter) + 1)
            position = after
    return border
