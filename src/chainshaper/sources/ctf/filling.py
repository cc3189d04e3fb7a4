"""The compiled pass over a span of all streams that merges them by time and writes columns.

See `kernels` for the passes before it.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Kernels take many numbers rather than objects, which Numba would have to count references to.
# ruff: noqa: PLR0917

import numpy as np

from chainshaper.sources.ctf import tables as tb
from chainshaper.sources.ctf.interpreter import execute, move_batch
from chainshaper.sources.ctf.kernels import (
    copy_numbers,
    nanoseconds,
    open_packet,
    read_header,
    step_over,
)
from chainshaper.values.compiled.memory import compiled, get, put, store_long, store_word

__all__ = ["fill_columns"]

A_ALL = tb.A_ROW * tb.AHEAD


@compiled()
def next_packet(machine, file, packets, index, regs):
    """Open the first packet from ``index`` on that has events in the file's span.

    Returns (packet, position of its first event, end of its events in the span); position -1
    for the span's end, a failure below that.
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

    Fills the file's part of the table ``ahead`` up to the end of a packet, whose registers then
    hold for all of them, or to an event whose length only reading it will tell. Negative where
    the file no longer is what it was when its events were counted.
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
    """Write an event whose length is not known before: 0 or a failure, after which it is undone.

    It is the last that was read ahead, so that its file goes on behind it.
    """
    state, levels = get(machine, tb.M_STATE), get(event, tb.E_LEVELS)
    counters = get(machine, tb.M_ROWS) + 8 * get(event, tb.E_COUNTER)
    if levels > 1:
        copy_numbers(get(machine, tb.M_SAVED), counters, levels)
    packet = packets + get(cursor, tb.C_PACKET) * tb.P_ROW
    at = get(packet, tb.P_BYTE)
    put(state, tb.X_CLOCK, get(cursor, tb.C_CLOCK))
    position = execute(
        machine, get(event, tb.E_FILL), get(event, tb.E_FILL_STOP), get(file, tb.F_BASE) + at,
        get(file, tb.F_SIZE) - at, get(packet, tb.P_END), get(cursor, tb.C_POSITION), regs, row,
    )  # fmt: skip
    if position < 0:
        if levels > 1:
            copy_numbers(counters, get(machine, tb.M_SAVED), levels)
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
        count = get(batch, 0)
        if count == tb.BATCH:
            status = move_batch(machine, event, batch)
            if status < 0:
                return status
            count = np.int64(0)
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
        if get(batch, 0) > 0:
            event = get(machine, tb.M_EVENTS) + number * tb.E_ROW
            status = move_batch(machine, event, batch)
            if status < 0:
                return status
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
def fill_columns(
    machine, files, count, cursors, ahead, tree, leaves, packets, regs, registers, events
):
    """Write the wanted events of a span of all ``count`` files, merged by time.

    ``tree`` has twice as many nodes as ``leaves``, a power of two and at least ``count``; all
    its times are NEVER at first, and its node 0 counts the files that were entered. ``ahead``
    has AHEAD rows and ``regs`` the ``registers`` of every file; there are ``events`` event
    classes. Returns 0 at the end of the span, FULL_DICTIONARY where the caller has to give a
    larger dictionary and call again, another failure where a file changed under our hands.
    """
    while get(tree, 0) < count:
        file = get(tree, 0)
        row, cursor, own = files + file * tb.F_ROW, cursors + file * tb.C_ROW, ahead + file * A_ALL
        put(cursor, tb.C_PACKET, get(row, tb.F_PACKET) - 1)
        status = read_ahead(machine, row, cursor, own, packets, regs + 8 * registers * file)
        if status < 0:
            return status
        if status > 0:
            play(tree, leaves + file, min(get(own, tb.A_TIME), tb.NEVER - 1), file)
        put(tree, 0, file + 1)
    while get(tree, 2) < tb.NEVER:
        file = get(tree, 3)
        row, cursor, own = files + file * tb.F_ROW, cursors + file * tb.C_ROW, ahead + file * A_ALL
        entry = own + get(cursor, tb.C_PLACE) * tb.A_ROW
        its = regs + 8 * registers * file
        status = write_event(machine, row, cursor, entry, packets, its)
        if status < 0:
            return status
        place = get(cursor, tb.C_PLACE) + 1
        time = np.int64(tb.NEVER)
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
