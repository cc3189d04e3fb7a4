"""The compiled passes over a trace that find packets and count events.

They run without Python's lock.  `tables` says what they are given, `layout` and `program` what the
operations mean.  `filling` holds the pass that writes columns.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which Numba would have to count references to.
# ruff: noqa: PLR0911, PLR0917

import numpy as np

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.interpreter import advance_clock, afforded, execute
from chainshaper.values.compiled.memory import compiled, get, load_word, put

__all__ = [
    "copy_numbers",
    "nanoseconds",
    "open_packet",
    "read_header",
    "scan_packets",
    "step_over",
    "walk_events",
]


@compiled(inline=True)
def nanoseconds(cycles, frequency):
    """Clock cycles in ns, rounded down."""
    if frequency == tb.BILLION:
        return cycles
    count, rate = np.uint64(cycles), np.uint64(frequency)
    whole, rest = count // rate, count % rate
    return np.int64(whole * np.uint64(tb.BILLION) + rest * np.uint64(tb.BILLION) // rate)


@compiled(inline=True)
def known_or(known, register, regs, default):
    """A number of the packet header or context, or ``default`` where it has none."""
    return get(regs, register) if known >> register & 1 else default


@compiled()
def note_packet(packet, offset, mapped, stream, known, regs, end):
    """Fill a row of the table of packets."""
    bits = known_or(known, tb.R_PACKET, regs, mapped * 8)
    put(packet, tb.P_BYTE, offset)
    put(packet, tb.P_BYTES, min(bits >> 3, mapped))
    put(packet, tb.P_END, min(end, mapped * 8))
    put(packet, tb.P_STREAM, stream)
    put(packet, tb.P_INSTANCE, known_or(known, tb.R_INSTANCE, regs, np.int64(-1)))
    put(packet, tb.P_BEGIN, known_or(known, tb.R_BEGIN, regs, np.int64(-1)))
    put(packet, tb.P_LAST, known_or(known, tb.R_END, regs, np.int64(-1)))
    put(packet, tb.P_SEQUENCE, known_or(known, tb.R_SEQUENCE, regs, np.int64(-1)))
    put(packet, tb.P_DISCARDED, known_or(known, tb.R_DISCARDED, regs, np.int64(-1)))
    put(packet, tb.P_CPU, known_or(known, tb.R_CPU, regs, np.int64(-1)))
    put(packet, tb.P_ERROR, np.int64(0))


@compiled()
def scan_packets(machine, regs, base, size, packets, room, reached, first, last):
    """Find the packets of a file from where an earlier call stopped (section 5).

    ``reached`` are two numbers that advance: the offset in the file and the packets found.  The
    folder's stream classes are the rows [first, last).  Returns the status; a packet that the
    file cuts short is listed with status CUT.
    """
    streams, state = get(machine, tb.M_STREAMS), get(machine, tb.M_STATE)
    leading = streams + first * tb.S_ROW
    while get(reached, 0) < size:
        offset, found = get(reached, 0), get(reached, 1)
        if found >= room:
            return np.int64(tb.FULL)
        start, mapped = base + offset, size - offset
        known = get(leading, tb.S_KNOWN)
        put(regs, tb.R_STREAM, get(leading, tb.S_ID))
        position = execute(
            machine, get(leading, tb.S_HEADER), get(leading, tb.S_HEADER_STOP),
            start, mapped, mapped * 8, np.int64(0), regs, np.int64(0),
        )  # fmt: skip
        if position < 0:
            return np.int64(tb.BAD_HEADER)
        if known >> tb.R_MAGIC & 1 and get(regs, tb.R_MAGIC) != tb.MAGIC:
            return np.int64(tb.BAD_MAGIC)
        if known >> tb.R_UUID_LOW & 1 and (
            get(regs, tb.R_UUID_LOW) != get(leading, tb.S_UUID_LOW)
            or get(regs, tb.R_UUID_HIGH) != get(leading, tb.S_UUID_HIGH)
        ):
            return np.int64(tb.BAD_UUID)
        stream = first
        while stream < last and get(streams + stream * tb.S_ROW, tb.S_ID) != get(regs, tb.R_STREAM):
            stream += 1
        if stream == last:
            return np.int64(tb.BAD_STREAM)
        row = streams + stream * tb.S_ROW
        if not afforded(state, get(row, tb.S_COST) + stream - first):
            return np.int64(tb.COSTLY)
        position = execute(
            machine, get(row, tb.S_CONTEXT), get(row, tb.S_CONTEXT_STOP),
            start, mapped, mapped * 8, position, regs, np.int64(0),
        )  # fmt: skip
        if position < 0:
            return np.int64(tb.BAD_HEADER)
        known = get(row, tb.S_KNOWN)
        bits = known_or(known, tb.R_PACKET, regs, mapped * 8)
        content = known_or(known, tb.R_CONTENT, regs, bits)
        if bits <= 0 or bits & 7 or content < position or content > bits:
            return np.int64(tb.BAD_SIZE)
        note_packet(packets + found * tb.P_ROW, offset, mapped, stream, known, regs, content)
        put(reached, 1, found + 1)
        if bits >> 3 > mapped:
            return np.int64(tb.CUT)
        put(reached, 0, offset + (bits >> 3))
    return np.int64(tb.DONE)


@compiled()
def open_packet(machine, packet, base, size, regs):
    """Read a packet's header and context anew; returns the position of the first event."""
    stream = get(machine, tb.M_STREAMS) + get(packet, tb.P_STREAM) * tb.S_ROW
    at, end = get(packet, tb.P_BYTE), get(packet, tb.P_END)
    position = execute(
        machine, get(stream, tb.S_HEADER), get(stream, tb.S_HEADER_STOP),
        base + at, size - at, end, np.int64(0), regs, np.int64(0),
    )  # fmt: skip
    if position < 0:
        return position
    return execute(
        machine, get(stream, tb.S_CONTEXT), get(stream, tb.S_CONTEXT_STOP),
        base + at, size - at, end, position, regs, np.int64(0),
    )  # fmt: skip


@compiled(inline=True)
def event_class(machine, stream, identifier):
    """The row of the event classes that an id names in a stream class, or -1."""
    ids = get(machine, tb.M_IDS) + 8 * get(stream, tb.S_ID_FIRST)
    dense = get(stream, tb.S_ID_DENSE)
    if 0 <= identifier < dense:
        return get(ids, identifier)
    pairs = ids + 8 * dense
    low, high = np.int64(0), get(stream, tb.S_ID_PAIRS)
    while low < high:
        middle = (low + high) >> 1
        if get(pairs, 2 * middle) < identifier:
            low = middle + 1
        else:
            high = middle
    if low < get(stream, tb.S_ID_PAIRS) and get(pairs, 2 * low) == identifier:
        return get(pairs, 2 * low + 1)
    return np.int64(-1)


@compiled()
def read_other_header(machine, stream, start, mapped, end, position, regs):
    """`read_header` for every form of header, by its operations."""
    put(regs, tb.R_ID, get(stream, tb.S_DEFAULT))
    after = execute(
        machine, get(stream, tb.S_EVENT), get(stream, tb.S_EVENT_STOP),
        start, mapped, end, position, regs, np.int64(0),
    )  # fmt: skip
    if after < 0:
        return after, np.int64(-1)
    event = event_class(machine, stream, get(regs, tb.R_ID))
    return (after if event >= 0 else np.int64(tb.UNKNOWN_EVENT)), event


@compiled(inline=True)
def read_header(machine, stream, start, mapped, end, position, regs):
    """Read an event header; returns (position after or a failure, event class)."""
    align = get(stream, tb.S_ALIGN)
    if align != 0:
        at = (position + align - 1) & -align
        shift, bits = get(stream, tb.S_SHIFT), get(stream, tb.S_CLOCK_BITS)
        after = at + shift + bits
        if after <= end and (at >> 3) + 8 <= mapped:
            word = load_word(start + (at >> 3))
            mask = (tb.U1 << np.uint64(get(stream, tb.S_ID_BITS))) - tb.U1
            identifier = np.int64(word & mask)
            if word & mask != mask:
                low = (word >> np.uint64(shift)) & ((tb.U1 << np.uint64(bits)) - tb.U1)
                advance_clock(get(machine, tb.M_STATE), low, bits)
                put(regs, tb.R_ID, identifier)
                event = event_class(machine, stream, identifier)
                return (after if event >= 0 else np.int64(tb.UNKNOWN_EVENT)), event
    return read_other_header(machine, stream, start, mapped, end, position, regs)


@compiled(inline=True)
def step_over(machine, row, start, mapped, end, position, regs):
    """The position behind an event's contexts and payload, or a failure."""
    align = get(row, tb.E_ALIGN)
    if align != 0:
        position = ((position + align - 1) & -align) + get(row, tb.E_SIZE)
        return position if position <= end else np.int64(-1)
    return execute(
        machine, get(row, tb.E_WALK), get(row, tb.E_WALK_STOP),
        start, mapped, end, position, regs, np.int64(0),
    )  # fmt: skip


@compiled()
def copy_numbers(target, source, count):
    """Copy ``count`` numbers from one table to another."""
    for index in range(count):
        put(target, index, get(source, index))


@compiled()
def walk_events(
    machine, regs, base, size, packets, first, last, counts, borders, border, spans, marks
):
    """Step through every event of the ``packets`` [first, last) of a file.

    Advances ``counts`` per event class and the row counters per level.  ``borders`` are
    ``spans`` instants (ns, ascending), those before number ``border`` being done; for each, the
    row of ``marks`` gets the first event at or after it (packet, position, clock) and the row
    counters before it.  Returns the next border.  An event that cannot be read ends its packet:
    the packet's END becomes that event's position, ERROR the failure, ERROR_AT where.
    """
    state, rows, saved = get(machine, tb.M_STATE), get(machine, tb.M_ROWS), get(machine, tb.M_SAVED)
    events, counters = get(machine, tb.M_EVENTS), get(machine, tb.M_COUNTERS)
    for index in range(first, last):
        packet = packets + index * tb.P_ROW
        stream = get(machine, tb.M_STREAMS) + get(packet, tb.P_STREAM) * tb.S_ROW
        at, end = get(packet, tb.P_BYTE), get(packet, tb.P_END)
        frequency = get(stream, tb.S_FREQUENCY)
        start, mapped = base + at, size - at
        put(state, tb.X_BUDGET, tb.BUDGET * ((end + 7) >> 3))
        position = open_packet(machine, packet, base, size, regs)
        if position < 0:
            put(packet, tb.P_ERROR, position)
            put(packet, tb.P_ERROR_AT, np.int64(0))
            put(packet, tb.P_END, np.int64(0))
            continue
        while position < end:
            before = get(state, tb.X_CLOCK)
            after, event = read_header(machine, stream, start, mapped, end, position, regs)
            time = nanoseconds(get(state, tb.X_CLOCK), frequency)
            counter, levels, row = np.int64(-1), np.int64(0), events
            if after >= 0:
                while border < spans and time >= get(borders, border):
                    mark = marks + 8 * border * (3 + counters)
                    put(mark, 0, index)
                    put(mark, 1, position)
                    put(mark, 2, before)
                    copy_numbers(mark + 24, rows, counters)
                    border += 1
                row = events + event * tb.E_ROW
                counter, levels = get(row, tb.E_COUNTER), get(row, tb.E_LEVELS)
                if levels > 1:
                    copy_numbers(saved, rows + 8 * counter, levels)
                after = step_over(machine, row, start, mapped, end, after, regs)
                if not afforded(state, get(row, tb.E_COST)):
                    after = np.int64(tb.OVER_BUDGET)
            if after < 0 or after == position:
                if levels > 1:
                    copy_numbers(rows + 8 * counter, saved, levels)
                put(packet, tb.P_ERROR, min(after, np.int64(-1)))
                put(packet, tb.P_ERROR_AT, position)
                put(packet, tb.P_END, position)
                put(state, tb.X_CLOCK, before)
                break
            if time < get(state, tb.X_LATEST):
                put(state, tb.X_UNSORTED, np.int64(1))
            put(state, tb.X_LATEST, time)
            put(counts, event, get(counts, event) + 1)
            if counter >= 0:
                put(rows, counter, get(rows, counter) + 1)
            position = after
    return border
