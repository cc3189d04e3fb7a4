"""The compiled pass over a span of all streams that merges them by time and writes columns.

See `kernels` for the passes before it.
"""

# Kernels take many numbers rather than objects, which Numba would have to count references to.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

import numpy as np

from chainshaper.sources.ctf.interpreter import execute, move_batch
from chainshaper.sources.ctf.kernels import (
    copy_numbers,
    nanoseconds,
    open_packet,
    read_header,
    step_over,
)
from chainshaper.sources.ctf.machine import BATCH, Failure, Machine, State
from chainshaper.sources.ctf.memory import compiled, get, put, store_long, store_word
from chainshaper.sources.ctf.tables import (
    C_CLOCK,
    C_END,
    C_EVENT,
    C_PACKET,
    C_POSITION,
    C_ROW,
    C_TIME,
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

B_ROW = 8 * (1 + 2 * BATCH)
CLOCK, HEAP = int(State.CLOCK), int(State.HEAP)
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
def next_wanted(machine: Any, file: Any, cursor: Any, packets: Any, regs: Any) -> Any:
    """Move a file's cursor behind the header of its next wanted event: 1, 0 at the span's end.

    Negative where the file no longer is what it was when its events were counted.
    """
    state, events = get(machine, M_STATE), get(machine, M_EVENTS)
    put(state, CLOCK, get(cursor, C_CLOCK))
    index, position, end = get(cursor, C_PACKET), get(cursor, C_POSITION), get(cursor, C_END)
    while True:
        if position >= end:
            index, position, end = next_packet(machine, file, packets, index + 1, regs)
            if position < 0:
                return np.int64(0) if position == -1 else position
        packet = packets + index * P_ROW
        stream = get(machine, M_STREAMS) + get(packet, P_STREAM) * S_ROW
        at, content = get(packet, P_BYTE), get(packet, P_END)
        start, mapped = get(file, F_BASE) + at, get(file, F_SIZE) - at
        position, event = read_header(machine, stream, start, mapped, content, position, regs)
        if position < 0:
            return np.int64(FULL_TABLE)
        row = events + event * E_ROW
        if get(row, E_COUNTER) >= 0:
            put(cursor, C_PACKET, index)
            put(cursor, C_POSITION, position)
            put(cursor, C_END, end)
            put(cursor, C_CLOCK, get(state, CLOCK))
            put(cursor, C_EVENT, event)
            put(cursor, C_TIME, nanoseconds(get(state, CLOCK), get(stream, S_FREQUENCY)))
            return np.int64(1)
        position = step_over(machine, row, start, mapped, content, position, regs)
        if position < 0:
            return np.int64(FULL_TABLE)


@compiled(inline=True)
def write_event(machine: Any, file: Any, cursor: Any, packets: Any, regs: Any) -> Any:
    """Write the event at a cursor to its row; returns the position behind it or a failure."""
    state, rows = get(machine, M_STATE), get(machine, M_ROWS)
    event = get(machine, M_EVENTS) + get(cursor, C_EVENT) * E_ROW
    packet = packets + get(cursor, C_PACKET) * P_ROW
    counter, levels = get(event, E_COUNTER), get(event, E_LEVELS)
    row = get(rows, counter)
    if row >= get(get(machine, M_CAPS), counter):
        return np.int64(FULL_TABLE)
    put(state, CLOCK, get(cursor, C_CLOCK))
    at = get(packet, P_BYTE)
    start, mapped = get(file, F_BASE) + at, get(file, F_SIZE) - at
    position, align = get(cursor, C_POSITION), get(event, E_ALIGN)
    position = (position + align - 1) & -align
    if get(event, E_CONSTANT) and (position + get(event, E_SIZE) >> 3) + 8 <= mapped:
        batch = get(machine, M_BATCHES) + get(cursor, C_EVENT) * B_ROW
        if get(batch, 0) == BATCH:
            status = move_batch(
                machine, get(event, E_FILL), get(event, E_FILL_STOP), get(event, E_SIZE) >> 3, batch
            )
            if status < 0:
                return status
        count = get(batch, 0)
        put(batch, 2 * count + 1, start + (position >> 3))
        put(batch, 2 * count + 2, row)
        put(batch, 0, count + 1)
        position += get(event, E_SIZE)
    else:
        if levels > 1:
            copy_numbers(get(machine, M_SAVED), rows + 8 * counter, levels)
        position = execute(
            machine, get(event, E_FILL), get(event, E_FILL_STOP),
            start, mapped, get(packet, P_END), get(cursor, C_POSITION), regs, row,
        )  # fmt: skip
    if position < 0:
        if levels > 1:
            copy_numbers(rows + 8 * counter, get(machine, M_SAVED), levels)
        return position
    store_long(get(event, E_TIME) + 8 * row, np.uint64(get(cursor, C_TIME)))
    if get(event, E_CPU) != 0:
        store_word(get(event, E_CPU) + 4 * row, np.uint64(get(packet, P_CPU)))
    put(rows, counter, row + 1)
    return position


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
def sift_down(heap: Any, count: Any, place: Any) -> None:
    """Restore the heap of rows (time, file) below ``place``; equal times go by the file."""
    time, file = get(heap, 2 * place), get(heap, 2 * place + 1)
    while True:
        child = 2 * place + 1
        if child >= count:
            break
        low, own = get(heap, 2 * child), get(heap, 2 * child + 1)
        if child + 1 < count:
            other, its = get(heap, 2 * child + 2), get(heap, 2 * child + 3)
            if other < low or (other == low and its < own):
                child, low, own = child + 1, other, its
        if time < low or (time == low and file < own):
            break
        put(heap, 2 * place, low)
        put(heap, 2 * place + 1, own)
        place = child
    put(heap, 2 * place, time)
    put(heap, 2 * place + 1, file)


@compiled("int64(int64, int64, int64, int64, int64, int64, int64, int64, int64)")
def fill_columns(
    machine: Any,
    files: Any,
    count: Any,
    cursors: Any,
    heap: Any,
    packets: Any,
    regs: Any,
    registers: Any,
    events: Any,
) -> Any:
    """Write the wanted events of a span of all ``count`` files, merged by time.

    ``heap`` has room for (time, file) of every file and ``regs`` for the ``registers`` of every
    file; there are ``events`` event classes; the state's HEAP is -1 at first.  Returns 0 at the
    end of the span, FULL_DICTIONARY where the caller has to give a larger dictionary and call
    again, another failure where a file changed under our hands.
    """
    state = get(machine, M_STATE)
    size = get(state, HEAP)
    if size < 0:
        size = np.int64(0)
        for file in range(count):
            row, cursor = files + file * F_ROW, cursors + file * C_ROW
            put(cursor, C_PACKET, get(row, F_PACKET) - 1)
            status = next_wanted(machine, row, cursor, packets, regs + 8 * registers * file)
            if status < 0:
                return status
            if status > 0:
                put(heap, 2 * size, get(cursor, C_TIME))
                put(heap, 2 * size + 1, file)
                size += 1
        for place in range(size // 2 - 1, -1, -1):
            sift_down(heap, size, place)
    while size > 0:
        file = get(heap, 1)
        row, cursor = files + file * F_ROW, cursors + file * C_ROW
        own = regs + 8 * registers * file
        position = write_event(machine, row, cursor, packets, own)
        if position < 0:
            put(state, HEAP, size)
            return position
        put(cursor, C_POSITION, position)
        put(cursor, C_CLOCK, get(state, CLOCK))
        status = next_wanted(machine, row, cursor, packets, own)
        if status < 0:
            return status
        if status > 0:
            put(heap, 0, get(cursor, C_TIME))
        else:
            size -= 1
            put(heap, 0, get(heap, 2 * size))
            put(heap, 1, get(heap, 2 * size + 1))
        sift_down(heap, size, np.int64(0))
    put(state, HEAP, size)
    return finish_batches(machine, events)
