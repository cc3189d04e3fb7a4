"""The compiled passes over a trace: find packets, count events, merge streams and write columns.

They run without Python's lock. `layout` says what they are given.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False
# ruff: noqa: PLR0911, PLR0917 - numbers rather than objects, whose references Numba would count

import numpy as np

from chainshaper.sources.ctf import layout as tb
from chainshaper.sources.ctf.interpreter import ZERO, advance_clock, afforded, execute, move_batch
from chainshaper.values.compiled.memory import compiled, get, load_word, put, store_long, store_word

A_ALL = tb.A_ROW * tb.AHEAD


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
def step_over(machine, row, start, mapped, end, position, regs):
    """The position behind an event's contexts and payload, or a failure."""
    align = get(row, tb.E_ALIGN)
    if align != 0:
        position = ((position + align - 1) & -align) + get(row, tb.E_SIZE)
        return position if position <= end else np.int64(-1)
    return execute(machine, row, tb.E_WALK, start, mapped, end, position, regs, ZERO)


@compiled()
def walk_events(
    machine, regs, base, size, packets, first, last, counts, borders, border, spans, marks
):
    """Step through every event of the ``packets`` [first, last) of a file; the next border.

    Advances ``counts`` per event class and the tables' row counters. ``borders`` are ``spans``
    instants (ns, ascending), those before number ``border`` being done; for each, the row of
    ``marks`` gets the first event at or after it (packet, position, clock) and the row counters
    before it. An event that cannot be read ends its packet: END becomes that event's position.
    """
    state, rows = get(machine, tb.M_STATE), get(machine, tb.M_ROWS)
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
            row = events
            if after >= 0:
                while border < spans and time >= get(borders, border):
                    mark = marks + 8 * border * (3 + counters)
                    put(mark, 0, index)
                    put(mark, 1, position)
                    put(mark, 2, before)
                    for counter in range(counters):
                        put(mark, 3 + counter, get(rows, counter))
                    border += 1
                row = events + event * tb.E_ROW
                after = step_over(machine, row, start, mapped, end, after, regs)
                if not afforded(state, get(row, tb.E_COST)):
                    after = np.int64(tb.OVER_BUDGET)
            if after < 0 or after == position:
                put(packet, tb.P_ERROR, min(after, np.int64(-1)))
                put(packet, tb.P_ERROR_AT, position)
                put(packet, tb.P_END, position)
                put(state, tb.X_CLOCK, before)
                break
            if time < get(state, tb.X_LATEST):
                put(state, tb.X_UNSORTED, np.int64(1))
            put(state, tb.X_LATEST, time)
            put(counts, event, get(counts, event) + 1)
            table = get(row, tb.E_COUNTER)
            if table >= 0:
                put(rows, table, get(rows, table) + 1)
            position = after
    return border


@compiled()
def next_packet(machine, file, packets, index, regs):
    """Open the first packet from ``index`` on that has events in the file's span.

    Returns (packet, position of its first event, end of its events in the span); the position is
    -1 at the span's end, a failure below that.
    """
    last = get(file, tb.F_LAST_PACKET)
    while index < last or (index == last and get(file, tb.F_LAST_POSITION) >= 0):
        packet = packets + index * tb.P_ROW
        end = get(file, tb.F_LAST_POSITION) if index == last else get(packet, tb.P_END)
        if end > 0:
            base, size = get(file, tb.F_BASE), get(file, tb.F_SIZE)
            position = open_packet(machine, packet, base, size, regs)
            if position < 0:
                return index, np.int64(tb.FULL_TABLE), end
            if index == get(file, tb.F_PACKET) and get(file, tb.F_POSITION) >= 0:
                position = get(file, tb.F_POSITION)
                put(get(machine, tb.M_STATE), tb.X_CLOCK, get(file, tb.F_CLOCK))
            if position < end:
                return index, position, end
        index += 1
    return index, np.int64(-1), np.int64(0)


@compiled()
def read_ahead(machine, file, cursor, ahead, packets, regs):
    """Find the next wanted events of a file: how many, 0 at the span's end.

    Fills the file's part of the table ``ahead`` up to the end of a packet, whose registers go with
    all of them, or to an event whose length only reading it will tell. Negative where the file is
    not what it was when its events were counted.
    """
    state, events = get(machine, tb.M_STATE), get(machine, tb.M_EVENTS)
    put(state, tb.X_CLOCK, get(cursor, tb.C_CLOCK))
    index, position = get(cursor, tb.C_PACKET), get(cursor, tb.C_POSITION)
    end = get(cursor, tb.C_END)
    count = np.int64(0)
    while count == 0:
        if position >= end:
            index, position, end = next_packet(machine, file, packets, index + 1, regs)
            if position < 0:
                return np.int64(0) if position == -1 else position
        packet = packets + index * tb.P_ROW
        stream = get(machine, tb.M_STREAMS) + get(packet, tb.P_STREAM) * tb.S_ROW
        at, content = get(packet, tb.P_BYTE), get(packet, tb.P_END)
        frequency = get(stream, tb.S_FREQUENCY)
        start, mapped = get(file, tb.F_BASE) + at, get(file, tb.F_SIZE) - at
        while position < end and count < tb.AHEAD:
            position, event = read_header(machine, stream, start, mapped, content, position, regs)
            if position < 0:
                return np.int64(tb.FULL_TABLE)
            row = events + event * tb.E_ROW
            if get(row, tb.E_COUNTER) >= 0:
                entry = ahead + count * tb.A_ROW
                put(entry, tb.A_TIME, nanoseconds(get(state, tb.X_CLOCK), frequency))
                put(entry, tb.A_EVENT, event)
                count += 1
                align, size = get(row, tb.E_ALIGN), get(row, tb.E_SIZE)
                position = (position + align - 1) & -align if align > 0 else position
                if get(row, tb.E_CONSTANT) == 0 or (position + size >> 3) + 8 > mapped:
                    put(entry, tb.A_ADDRESS, np.int64(0))
                    break
                put(entry, tb.A_ADDRESS, start + (position >> 3))
                position += size
            else:
                position = step_over(machine, row, start, mapped, content, position, regs)
            if position < 0 or position > content:
                return np.int64(tb.FULL_TABLE)
        put(cursor, tb.C_CPU, get(packet, tb.P_CPU))
    put(cursor, tb.C_PACKET, index)
    put(cursor, tb.C_POSITION, position)
    put(cursor, tb.C_END, end)
    put(cursor, tb.C_CLOCK, get(state, tb.X_CLOCK))
    put(cursor, tb.C_PLACE, np.int64(0))
    put(cursor, tb.C_COUNT, count)
    return count


@compiled()
def write_apart(machine, event, file, cursor, packets, regs, row):
    """Write an event whose length is not known before, the last one that was read ahead.

    Returns 0 or a failure, after which the cursor is as it was.
    """
    state = get(machine, tb.M_STATE)
    packet = packets + get(cursor, tb.C_PACKET) * tb.P_ROW
    at = get(packet, tb.P_BYTE)
    put(state, tb.X_CLOCK, get(cursor, tb.C_CLOCK))
    base, mapped, end = get(file, tb.F_BASE) + at, get(file, tb.F_SIZE) - at, get(packet, tb.P_END)
    position = get(cursor, tb.C_POSITION)
    position = execute(machine, event, tb.E_FILL, base, mapped, end, position, regs, row)
    if position < 0:
        return position
    put(cursor, tb.C_POSITION, position)
    put(cursor, tb.C_CLOCK, get(state, tb.X_CLOCK))
    return np.int64(0)


@compiled(inline=True)
def write_event(machine, file, cursor, entry, packets, regs):
    """Write an event that was read ahead to its row: 0 or a failure, after which it is undone."""
    number, address = get(entry, tb.A_EVENT), get(entry, tb.A_ADDRESS)
    event, rows = get(machine, tb.M_EVENTS) + number * tb.E_ROW, get(machine, tb.M_ROWS)
    counter = get(event, tb.E_COUNTER)
    row = get(rows, counter)
    if row >= get(get(machine, tb.M_CAPS), counter):
        return np.int64(tb.FULL_TABLE)
    if address != 0:
        batch = get(machine, tb.M_BATCHES) + number * tb.B_ROW
        if get(batch, 0) == tb.BATCH and move_batch(machine, event, batch) < 0:
            return np.int64(tb.FULL_DICTIONARY)
        count = get(batch, 0)
        put(batch, 2 * count + 1, address)
        put(batch, 2 * count + 2, row)
        put(batch, 0, count + 1)
    else:
        status = write_apart(machine, event, file, cursor, packets, regs, row)
        if status < 0:
            return status
    store_long(get(event, tb.E_TIME) + 8 * row, np.uint64(get(entry, tb.A_TIME)))
    if get(event, tb.E_CPU) != 0:
        store_word(get(event, tb.E_CPU) + 4 * row, np.uint64(get(cursor, tb.C_CPU)))
    put(rows, counter, row + 1)
    return np.int64(0)


@compiled()
def finish_batches(machine, events):
    """Write what is left in the batches of all event classes; 0 or FULL_DICTIONARY."""
    for number in range(events):
        batch = get(machine, tb.M_BATCHES) + number * tb.B_ROW
        event = get(machine, tb.M_EVENTS) + number * tb.E_ROW
        if get(batch, 0) > 0 and move_batch(machine, event, batch) < 0:
            return np.int64(tb.FULL_DICTIONARY)
    return np.int64(0)


@compiled(inline=True)
def play(tree, leaf, time, file):
    """Enter a file's next time at a ``leaf`` of the tournament and find the winners above it.

    Node n has the children 2n and 2n + 1 and the (time, file) of the earlier of them; node 1 is
    the first of all. Files stand in order, so that at equal times the left one wins.
    """
    node = leaf
    put(tree, 2 * node, time)
    put(tree, 2 * node + 1, file)
    while node > 1:
        other = node ^ 1
        rival, its = get(tree, 2 * other), get(tree, 2 * other + 1)
        lost = rival < time + (node & 1)
        time = rival if lost else time
        file = its if lost else file
        node >>= 1
        put(tree, 2 * node, time)
        put(tree, 2 * node + 1, file)


@compiled()
def fill_columns(machine, files, cursors, ahead, tree, leaves, packets, regs, registers, events):
    """Write the wanted events of a span of all files, merged by time.

    ``tree`` has twice as many nodes as ``leaves``, a power of two; a file comes first as long as
    none of its events is known. ``ahead`` has AHEAD rows and ``regs`` the ``registers`` of every
    file. Returns 0 at the end of the span, FULL_DICTIONARY where the caller has to give a larger
    one and call again, another failure where a file has changed.
    """
    while get(tree, 2) < tb.NEVER:
        file, time = get(tree, 3), np.int64(tb.NEVER)
        row, cursor, own = files + file * tb.F_ROW, cursors + file * tb.C_ROW, ahead + file * A_ALL
        its, place = regs + 8 * registers * file, get(cursor, tb.C_PLACE)
        if place < get(cursor, tb.C_COUNT):
            status = write_event(machine, row, cursor, own + place * tb.A_ROW, packets, its)
            if status < 0:
                return status
            place += 1
        if place < get(cursor, tb.C_COUNT):
            put(cursor, tb.C_PLACE, place)
            time = min(get(own + place * tb.A_ROW, tb.A_TIME), tb.NEVER - 1)
        else:
            status = read_ahead(machine, row, cursor, own, packets, its)
            if status < 0:
                return status
            if status > 0:
                time = min(get(own, tb.A_TIME), tb.NEVER - 1)
        play(tree, leaves + file, time, file)
    return finish_batches(machine, events)
