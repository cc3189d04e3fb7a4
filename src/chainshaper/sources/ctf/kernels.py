"""The compiled passes over a trace: find packets, count events, and write columns.

They run without Python's lock. `layout` says what they are given.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False
# ruff: noqa: PLR0911, PLR0912, PLR0917 - numbers rather than objects, whose references Numba would count

import numpy as np

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf.interpreter import ZERO, advance_clock, afforded, execute, move_batch
from chainshaper.values.compiled.memory import (
    compiled,
    get,
    load_byte,
    load_word,
    put,
    store_long,
    store_word,
)


@compiled(inline=True)
def nanoseconds(cycles, frequency):
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
def scan_packets(machine, regs, base, size, packets, room, reached, first, last):
    """Find the packets of a file from where an earlier call stopped (section 5); the status.

    ``reached`` are two numbers that advance: the offset in the file and the packets found. The
    folder's stream classes are the rows [first, last). A packet that is CUT short is listed.
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
            machine, leading, tb.S_HEADER, start, mapped, mapped * 8, ZERO, regs, ZERO
        )
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
            machine, row, tb.S_CONTEXT, start, mapped, mapped * 8, position, regs, ZERO
        )
        if position < 0:
            return np.int64(tb.BAD_HEADER)
        known = get(row, tb.S_KNOWN)
        bits = known_or(known, tb.R_PACKET, regs, mapped * 8)
        content = known_or(known, tb.R_CONTENT, regs, bits)
        if bits <= 0 or bits & 7 or content < position or content > bits:
            return np.int64(tb.BAD_SIZE)
        packet = packets + found * tb.P_ROW
        put(packet, tb.P_BYTE, offset)
        put(packet, tb.P_BYTES, min(bits >> 3, mapped))
        put(packet, tb.P_END, min(content, mapped * 8))
        put(packet, tb.P_STREAM, stream)
        for index in range(6):  # from INSTANCE to CPU, as their registers stand
            number = known_or(known, tb.R_INSTANCE + index, regs, np.int64(-1))
            put(packet, tb.P_INSTANCE + index, number)
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
    position = execute(machine, stream, tb.S_HEADER, base + at, size - at, end, ZERO, regs, ZERO)
    if position < 0:
        return position
    return execute(machine, stream, tb.S_CONTEXT, base + at, size - at, end, position, regs, ZERO)


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
    after = execute(machine, stream, tb.S_EVENT, start, mapped, end, position, regs, ZERO)
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
def believed(machine, stream, packet, start, end, position, read, regs):
    """The position behind an event's header, or a failure where no tracer wrote such an event.

    It happened while its packet was open, in a process; and what a disk never got reads as zeros.
    """
    now = get(get(machine, tb.M_STATE), tb.X_CLOCK)
    if now < get(packet, tb.P_EARLIEST) or now > get(packet, tb.P_LATEST):
        return np.int64(tb.OTHER_TIME)
    align = get(stream, tb.S_PROCESS_ALIGN)
    if align != 0:
        begin, last = (read + align - 1) & -align, (end >> 3) - 8
        process = (begin + get(stream, tb.S_PROCESS)) >> 3
        thread = (begin + get(stream, tb.S_THREAD)) >> 3
        if (process <= last and load_word(start + process) & tb.LOW == tb.U0) or (
            thread <= last and load_word(start + thread) & tb.LOW == tb.U0
        ):
            return np.int64(tb.NO_PROCESS)
    elif get(regs, tb.R_ID) == 0 and get(stream, tb.S_ALIGN) != 0:
        align = get(stream, tb.S_ALIGN)
        at = ((position + align - 1) & -align) >> 3
        stop = (read >> 3) + tb.ZEROS
        while at < stop <= end >> 3 and load_byte(start + at) == tb.U0:
            at += 1
        if at == stop:
            return np.int64(tb.ALL_ZEROS)
    return read


@compiled(inline=True)
def step_over(machine, row, start, mapped, end, position, regs):
    """The position behind an event's contexts and payload, or a failure."""
    align = get(row, tb.E_ALIGN)
    if align != 0:
        position = ((position + align - 1) & -align) + get(row, tb.E_SIZE)
        return position if position <= end else np.int64(-1)
    return execute(machine, row, tb.E_WALK, start, mapped, end, position, regs, ZERO)


@compiled(inline=True)
def write_event(machine, number, packet, start, mapped, end, position, regs):
    """Write an event of class ``number`` to the next row of its table; the position behind it.

    One of constant layout goes to a batch, which is written as it fills.
    """
    event, rows = get(machine, tb.M_EVENTS) + number * tb.E_ROW, get(machine, tb.M_ROWS)
    counter = get(event, tb.E_COUNTER)
    row = get(rows, counter)
    if row >= get(get(machine, tb.M_CAPS), counter):
        return np.int64(tb.FULL_TABLE)
    put(rows, counter, row + 1)
    stream = get(machine, tb.M_STREAMS) + get(packet, tb.P_STREAM) * tb.S_ROW
    time = nanoseconds(get(get(machine, tb.M_STATE), tb.X_CLOCK), get(stream, tb.S_FREQUENCY))
    store_long(get(event, tb.E_TIME) + 8 * row, np.uint64(time))
    if get(event, tb.E_CPU) != 0:
        store_word(get(event, tb.E_CPU) + 4 * row, np.uint64(get(packet, tb.P_CPU)))
    align, size = get(event, tb.E_ALIGN), get(event, tb.E_SIZE)
    begin = (position + align - 1) & -align
    if get(event, tb.E_MOVED) == 0 or (begin + size >> 3) + 8 > mapped:
        return execute(machine, event, tb.E_WALK, start, mapped, end, position, regs, row)
    batch = get(machine, tb.M_BATCHES) + number * tb.B_ROW
    if get(batch, 0) == tb.BATCH and move_batch(machine, event, batch) < 0:
        return np.int64(tb.FULL_DICTIONARY)
    count = get(batch, 0)
    put(batch, 2 * count + 1, start + (begin >> 3))
    put(batch, 2 * count + 2, row)
    put(batch, 0, count + 1)
    return begin + size


@compiled()
def run_events(machine, regs, base, size, packets, first, last, counts, events):
    """Step through every event of the ``packets`` [first, last) of a file: to count, or to write.

    Where ``counts`` per event class are given, these and the tables' row counters advance; an event
    that cannot be read ends its packet: END becomes that event's position. Else the wanted events,
    of so many ``events`` classes, go to their tables' next rows. Returns 0, FULL_DICTIONARY where
    the caller has to give a larger one and begin again, or another failure where the file has
    changed since its events were counted.
    """
    state, rows, counting = get(machine, tb.M_STATE), get(machine, tb.M_ROWS), counts != 0
    for index in range(first, last):
        packet = packets + index * tb.P_ROW
        stream = get(machine, tb.M_STREAMS) + get(packet, tb.P_STREAM) * tb.S_ROW
        at, end = get(packet, tb.P_BYTE), get(packet, tb.P_END)
        start, mapped, before = base + at, size - at, get(state, tb.X_CLOCK)
        if counting:
            put(state, tb.X_BUDGET, tb.BUDGET * ((end + 7) >> 3))
        position, read = ZERO, end  # of the event that is read, and behind it
        if end > 0:
            read = open_packet(machine, packet, base, size, regs)
        while 0 <= read < end:
            position, before = read, get(state, tb.X_CLOCK)
            read, event = read_header(machine, stream, start, mapped, end, position, regs)
            if counting and read >= 0:
                read = believed(machine, stream, packet, start, end, position, read, regs)
            if read < 0:
                break
            row = get(machine, tb.M_EVENTS) + event * tb.E_ROW
            table = get(row, tb.E_COUNTER)
            if table >= 0 and not counting:
                read = write_event(machine, event, packet, start, mapped, end, read, regs)
                continue
            read = step_over(machine, row, start, mapped, end, read, regs)
            if counting and not afforded(state, get(row, tb.E_COST)):
                read = np.int64(tb.OVER_BUDGET)
            if read == position:
                read = np.int64(tb.TRUNCATED)
            if counting and read >= 0:
                put(counts, event, get(counts, event) + 1)
                if table >= 0:
                    put(rows, table, get(rows, table) + 1)
        if counting and read < 0:
            put(packet, tb.P_ERROR, read)
            put(packet, tb.P_ERROR_AT, position)
            put(packet, tb.P_END, position)
            put(state, tb.X_CLOCK, before)
        elif read < 0 or read > end > 0:
            return min(read, np.int64(tb.TRUNCATED))
    for event in range(events):
        batch = get(machine, tb.M_BATCHES) + event * tb.B_ROW
        row = get(machine, tb.M_EVENTS) + event * tb.E_ROW
        if get(batch, 0) > 0 and move_batch(machine, row, batch) < 0:
            return np.int64(tb.FULL_DICTIONARY)
    return np.int64(0)
