"""The compiled pass over a span of all streams that merges them by time and writes columns.

See `kernels` for the passes before it.
"""

# Kernels take many numbers rather than objects, which Numba would have to count references to.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

import numpy as np

from chainshaper.compiled.memory import compiled, get, put, store_long, store_word
from chainshaper.sources.ctf.interpreter import execute, move_batch
from chainshaper.sources.ctf.kernels import (
    copy_numbers,
    nanoseconds,
    open_packet,
    read_header,
    step_over,
)
from chainshaper.sources.ctf.machine import AHEAD, BATCH, NEVER, Failure, Machine, State
from chainshaper.sources.ctf.tables import (
    A_ADDRESS,
    A_EVENT,
    A_ROW,
    A_TIME,
    C_CLOCK,
    C_COUNT,
    C_CPU,
    C_END,
    C_PACKET,
    C_PLACE,
    C_POSITION,
    C_ROW,
    E_ALIGN,
    E_CONSTANT,
    E_COUNTER,
    E_CPU,
    E_FILL,
    E_FILL_STOP,
    E_LEVELS,
    E_ROW,
    E_SIZE,
    E_TIME,
    F_BASE,
    F_CLOCK,
    F_LAST_PACKET,
    F_LAST_POSITION,
    F_PACKET,
    F_POSITION,
    F_ROW,
    F_SIZE,
    P_BYTE,
    P_CPU,
    P_END,
    P_ROW,
    P_STREAM,
    S_FREQUENCY,
    S_ROW,
)

__all__ = ["fill_columns"]

A_ALL, B_ROW = A_ROW * AHEAD, 8 * (1 + 2 * BATCH)
CLOCK = int(State.CLOCK)
FULL_TABLE, UNKNOWN_EVENT = int(Failure.FULL_TABLE), int(Failure.UNKNOWN_EVENT)
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


@compiled()
def next_packet(machine: Any, file: Any, packets: Any, index: Any, regs: Any) -> Any:
    """Open the first packet from ``index`` on that has events in the file's span.

    Returns (packet, position of its first event, end of its events in the span); position -1
    for the span's end, a failure below that.
    """
    last = get(file, F_LAST_PACKET)
    while index < last or (index == last and get(file, F_LAST_POSITION) >= 0):
        packet = packets + index * P_ROW
        end = get(file, F_LAST_POSITION) if index == last else get(packet, P_END)
        if end > 0:
            position = open_packet(machine, packet, get(file, F_BASE), get(file, F_SIZE), regs)
            if position < 0:
                return index, np.int64(FULL_TABLE), end
            if index == get(file, F_PACKET) and get(file, F_POSITION) >= 0:
                position = get(file, F_POSITION)
                put(get(machine, M_STATE), CLOCK, get(file, F_CLOCK))
            if position < end:
                return index, position, end
        index += 1
    return index, np.int64(-1), np.int64(0)


@compiled()
def read_ahead(machine: Any, file: Any, cursor: Any, ahead: Any, packets: Any, regs: Any) -> Any:
    """Find the next wanted events of a file: how many, 0 at the span's end.

    Fills the file's part of the table ``ahead`` up to the end of a packet, whose registers then
    hold for all of them, or to an event whose length only reading it will tell. Negative where
    the file no longer is what it was when its events were counted.
    """
    state, events = get(machine, M_STATE), get(machine, M_EVENTS)
    put(state, CLOCK, get(cursor, C_CLOCK))
    index, position, end = get(cursor, C_PACKET), get(cursor, C_POSITION), get(cursor, C_END)
    count = np.int64(0)
    while count == 0:
        if position >= end:
            index, position, end = next_packet(machine, file, packets, index + 1, regs)
            if position < 0:
                return np.int64(0) if position == -1 else position
        packet = packets + index * P_ROW
        stream = get(machine, M_STREAMS) + get(packet, P_STREAM) * S_ROW
        at, content, frequency = get(packet, P_BYTE), get(packet, P_END), get(stream, S_FREQUENCY)
        start, mapped = get(file, F_BASE) + at, get(file, F_SIZE) - at
        while position < end and count < AHEAD:
            position, event = read_header(machine, stream, start, mapped, content, position, regs)
            if position < 0:
                return np.int64(FULL_TABLE)
            row = events + event * E_ROW
            if get(row, E_COUNTER) >= 0:
                entry = ahead + count * A_ROW
                put(entry, A_TIME, nanoseconds(get(state, CLOCK), frequency))
                put(entry, A_EVENT, event)
                count += 1
                align, size = get(row, E_ALIGN), get(row, E_SIZE)
                position = (position + align - 1) & -align if align > 0 else position
                if get(row, E_CONSTANT) == 0 or (position + size >> 3) + 8 > mapped:
                    put(entry, A_ADDRESS, np.int64(0))
                    break
                put(entry, A_ADDRESS, start + (position >> 3))
                position += size
            else:
                position = step_over(machine, row, start, mapped, content, position, regs)
            if position < 0 or position > content:
                return np.int64(FULL_TABLE)
        put(cursor, C_CPU, get(packet, P_CPU))
    put(cursor, C_PACKET, index)
    put(cursor, C_POSITION, position)
    put(cursor, C_END, end)
    put(cursor, C_CLOCK, get(state, CLOCK))
    put(cursor, C_PLACE, np.int64(0))
    put(cursor, C_COUNT, count)
    return count


@compiled()
def write_apart(
    machine: Any, event: Any, file: Any, cursor: Any, packets: Any, regs: Any, row: Any
) -> Any:
    """Write an event whose length is not known before: 0 or a failure, after which it is undone.

    It is the last that was read ahead, so that its file goes on behind it.
    """
    state, counters = get(machine, M_STATE), get(machine, M_ROWS) + 8 * get(event, E_COUNTER)
    levels = get(event, E_LEVELS)
    if levels > 1:
        copy_numbers(get(machine, M_SAVED), counters, levels)
    packet = packets + get(cursor, C_PACKET) * P_ROW
    at = get(packet, P_BYTE)
    put(state, CLOCK, get(cursor, C_CLOCK))
    position = execute(
        machine, get(event, E_FILL), get(event, E_FILL_STOP), get(file, F_BASE) + at,
        get(file, F_SIZE) - at, get(packet, P_END), get(cursor, C_POSITION), regs, row,
    )  # fmt: skip
    if position < 0:
        if levels > 1:
            copy_numbers(counters, get(machine, M_SAVED), levels)
        return position
    put(cursor, C_POSITION, position)
    put(cursor, C_CLOCK, get(state, CLOCK))
    return np.int64(0)


@compiled(inline=True)
def write_event(machine: Any, file: Any, cursor: Any, entry: Any, packets: Any, regs: Any) -> Any:
    """Write an event that was read ahead to its row: 0 or a failure, after which it is undone."""
    number, address = get(entry, A_EVENT), get(entry, A_ADDRESS)
    event, rows = get(machine, M_EVENTS) + number * E_ROW, get(machine, M_ROWS)
    counter = get(event, E_COUNTER)
    row = get(rows, counter)
    if row >= get(get(machine, M_CAPS), counter):
        return np.int64(FULL_TABLE)
    if address != 0:
        batch = get(machine, M_BATCHES) + number * B_ROW
        count = get(batch, 0)
        if count == BATCH:
            status = move_batch(
                machine, get(event, E_FILL), get(event, E_FILL_STOP), get(event, E_SIZE) >> 3, batch
            )
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
    store_long(get(event, E_TIME) + 8 * row, np.uint64(get(entry, A_TIME)))
    if get(event, E_CPU) != 0:
        store_word(get(event, E_CPU) + 4 * row, np.uint64(get(cursor, C_CPU)))
    put(rows, counter, row + 1)
    return np.int64(0)


@compiled()
def finish_batches(machine: Any, events: Any) -> Any:
    """Write what is left in the batches of all event classes; 0 or FULL_DICTIONARY."""
    for number in range(events):
        batch = get(machine, M_BATCHES) + number * B_ROW
        if get(batch, 0) > 0:
            event = get(machine, M_EVENTS) + number * E_ROW
            status = move_batch(
                machine, get(event, E_FILL), get(event, E_FILL_STOP), get(event, E_SIZE) >> 3, batch
            )
            if status < 0:
                return status
    return np.int64(0)


@compiled(inline=True)
def play(tree: Any, leaf: Any, time: Any, file: Any) -> None:
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
    machine: Any,
    files: Any,
    count: Any,
    cursors: Any,
    ahead: Any,
    tree: Any,
    leaves: Any,
    packets: Any,
    regs: Any,
    registers: Any,
    events: Any,
) -> Any:
    """Write the wanted events of a span of all ``count`` files, merged by time.

    ``tree`` has twice as many nodes as ``leaves``, a power of two and at least ``count``; all
    its times are NEVER at first, and its node 0 counts the files that were entered. ``ahead``
    has AHEAD rows and ``regs`` the ``registers`` of every file; there are ``events`` event
    classes. Returns 0 at the end of the span, FULL_DICTIONARY where the caller has to give a
    larger dictionary and call again, another failure where a file changed under our hands.
    """
    while get(tree, 0) < count:
        file = get(tree, 0)
        row, cursor, own = files + file * F_ROW, cursors + file * C_ROW, ahead + file * A_ALL
        put(cursor, C_PACKET, get(row, F_PACKET) - 1)
        status = read_ahead(machine, row, cursor, own, packets, regs + 8 * registers * file)
        if status < 0:
            return status
        if status > 0:
            play(tree, leaves + file, min(get(own, A_TIME), NEVER - 1), file)
        put(tree, 0, file + 1)
    while get(tree, 2) < NEVER:
        file = get(tree, 3)
        row, cursor, own = files + file * F_ROW, cursors + file * C_ROW, ahead + file * A_ALL
        entry = own + get(cursor, C_PLACE) * A_ROW
        its = regs + 8 * registers * file
        status = write_event(machine, row, cursor, entry, packets, its)
        if status < 0:
            return status
        place = get(cursor, C_PLACE) + 1
        time = np.int64(NEVER)
        if place < get(cursor, C_COUNT):
            put(cursor, C_PLACE, place)
            time = min(get(own + place * A_ROW, A_TIME), NEVER - 1)
        else:
            status = read_ahead(machine, row, cursor, own, packets, its)
            if status < 0:
                return status
            if status > 0:
                time = min(get(own, A_TIME), NEVER - 1)
        play(tree, leaves + file, time, file)
    return finish_batches(machine, events)
