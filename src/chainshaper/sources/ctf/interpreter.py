"""The compiled interpreter: runs operations over a packet's bits (CTF 1.8, section 4).

Positions are bits from the start of a packet.  Every operation checks the end of the packet's
content before it reads, and every load checks the number of bytes mapped behind the packet's
start; a failed check ends the run with one of the negative codes of `Failure`.
"""

# Numba mixes int64 and uint64 into float64: every value below keeps to one of the two.
# Kernels take many numbers rather than objects, whose references Numba would have to count.
# ruff: noqa: PLR0911, PLR0912, PLR0915, PLR0917

from __future__ import annotations

from typing import Any

import numpy as np

from chainshaper.compiled.memory import (
    compiled,
    get,
    load_byte,
    load_word,
    put,
    store_byte,
    store_half,
    store_long,
    store_word,
    swap_bytes,
)
from chainshaper.sources.ctf.machine import (
    ADDRESS,
    AGAIN,
    ALIGN,
    BAD_LENGTH,
    CHARACTERS,
    CLOCK,
    CODE,
    COPY,
    COUNT,
    COUNTER,
    FLAGS,
    FULL_DICTIONARY,
    FULL_TABLE,
    INNER,
    INNER_ADDRESS,
    LEAST,
    LOOP,
    M_CAPS,
    M_OPS,
    M_RANGES,
    M_ROWS,
    M_STATE,
    MOVE_HALF,
    MOVE_LONG,
    MOVE_WORD,
    NO_OPTION,
    NUMBER,
    OFFSET,
    OP_BYTES,
    REGISTER,
    SIZE,
    SKIP,
    SKIP_MANY,
    STACK,
    SWITCH,
    TARGET,
    TEXT,
    TRUNCATED,
    U1,
    U8,
    U64,
    UNTERMINATED,
    WIDTH,
)
from chainshaper.sources.ctf.texts import digest_text, digest_whole, intern, word_at

__all__ = ["advance_clock", "execute", "move_batch"]


@compiled()
def bits_at(base: Any, position: Any, size: Any, big: Any, mapped: Any) -> Any:
    """An unsigned integer of ``size`` bits at any bit, as uint64 (section 4.1.5)."""
    at = position >> 3
    shift = np.uint64(position & 7)
    width = np.uint64(size)
    word = word_at(base, at, mapped)
    across = shift + width > U64 and at + 8 < mapped
    if big:
        word = swap_bytes(word) << shift
        if across:
            word |= load_byte(base + at + 8) >> (U8 - shift)
        return word >> (U64 - width)
    word >>= shift
    if across:
        word |= load_byte(base + at + 8) << (U64 - shift)
    if size < 64:
        word &= (U1 << width) - U1
    return word


@compiled(inline=True)
def keep(op: Any, value: Any, rows: Any) -> None:
    """Write a value to its slot's row."""
    width = get(op, WIDTH)
    target = get(op, ADDRESS) + get(rows, get(op, COUNTER)) * width
    if width == 8:
        store_long(target, value)
    elif width == 4:
        store_word(target, value)
    elif width == 1:
        store_byte(target, value)
    else:
        store_half(target, value)


@compiled(inline=True)
def advance_clock(state: Any, value: Any, size: Any) -> None:
    """Set the low ``size`` bits of the clock; it wraps forward only (section 8)."""
    if size >= 64:
        put(state, CLOCK, np.int64(value))
        return
    mask = (U1 << np.uint64(size)) - U1
    now = np.uint64(get(state, CLOCK))
    if value < (now & mask):
        now += mask + U1
    put(state, CLOCK, np.int64((now & ~mask) | value))


@compiled()
def run_number(machine: Any, op: Any, base: Any, mapped: Any, position: Any, regs: Any) -> None:
    """Read an integer or a float's bits; the caller has checked the end."""
    size, flags = get(op, SIZE), get(op, FLAGS)
    value = bits_at(base, position, size, flags & 2, mapped)
    if flags & 1:
        rest = np.int64(64 - size)
        value = np.uint64((np.int64(value) << rest) >> rest)
    register = get(op, REGISTER)
    if register >= 0:
        put(regs, register, np.int64(value))
    if get(op, ADDRESS) != 0:
        keep(op, value, get(machine, M_ROWS))
    if flags & 4:
        advance_clock(get(machine, M_STATE), value, size)


@compiled(inline=True)
def run_text(
    machine: Any, op: Any, base: Any, mapped: Any, end: Any, position: Any, regs: Any
) -> Any:
    """Read a string or a text array; returns the position behind it or a failure."""
    at = position >> 3
    if get(op, CODE) == TEXT:
        length, digest, word = digest_text(base, at, end >> 3, mapped)
        if length < 0:
            return np.int64(UNTERMINATED)
        following = (at + length + 1) << 3
    else:
        register = get(op, REGISTER)
        count = get(op, COUNT) if register < 0 else get(regs, register)
        if count < 0 or count > (end - position) >> 3:
            return np.int64(BAD_LENGTH)
        length, digest, word = digest_text(base, at, at + count, mapped)
        if length < 0:
            length, digest, word = digest_whole(base, at, count, mapped)
        following = (at + count) << 3
    if get(op, ADDRESS) != 0:
        code = intern(machine, base + at, length, digest, word)
        if code < 0:
            return np.int64(FULL_DICTIONARY)
        keep(op, np.uint64(code), get(machine, M_ROWS))
    return following


@compiled()
def run_copy(op: Any, base: Any, position: Any, count: Any, rows: Any) -> None:
    """Copy ``count`` elements that lie alike in packet and slot; both ends are checked."""
    width = get(op, SIZE) >> 3
    source = base + (position >> 3)
    target = get(op, INNER_ADDRESS) + get(rows, get(op, INNER)) * width
    total = count * width
    index = total * 0
    while index + 8 <= total:
        store_long(target + index, load_word(source + index))
        index += 8
    while index < total:
        store_byte(target + index, load_byte(source + index))
        index += 1


@compiled()
def choose(op: Any, ranges: Any, regs: Any) -> Any:
    """The address of the row of ``ranges`` that holds a variant's tag, or -1."""
    tag = get(regs, get(op, REGISTER))
    if get(op, FLAGS) == 0:
        tag = np.int64(np.uint64(tag) ^ (U1 << np.uint64(63)))
    first = get(op, COUNT)
    for index in range(first, first + get(op, LEAST)):
        row = ranges + 32 * index
        if get(row, 0) <= tag <= get(row, 1):
            return row
    return np.int64(-1)


@compiled()
def run_many(
    machine: Any, op: Any, base: Any, end: Any, position: Any, regs: Any, depth: Any
) -> Any:
    """Begin a SKIP_MANY, COPY or LOOP; returns the position behind the first two or a failure.

    A loop's number of turns goes on the stack at ``depth``.
    """
    code, register = get(op, CODE), get(op, REGISTER)
    count = get(op, COUNT) if register < 0 else get(regs, register)
    least = get(op, LEAST) if code == LOOP else get(op, SIZE)
    if count < 0 or position > end or count > (end - position) // max(least, np.int64(1)):
        return np.int64(BAD_LENGTH)
    rows, inner = get(machine, M_ROWS), get(op, INNER)
    if inner >= 0 and get(rows, inner) + count > get(get(machine, M_CAPS), inner):
        return np.int64(FULL_TABLE)
    if get(op, ADDRESS) != 0:
        keep(op, np.uint64(count), rows)
    if code == LOOP:
        put(get(machine, M_STATE), STACK + depth, count)
        return position
    if code == COPY:
        run_copy(op, base, position, count, rows)
    if inner >= 0:
        put(rows, inner, get(rows, inner) + count)
    return position + count * get(op, SIZE)


@compiled(inline=True)
def move(code: Any, column: Any, row: Any, word: Any) -> None:
    """Write the low bytes of a word to a row of a column."""
    if code == MOVE_LONG:
        store_long(column + 8 * row, word)
    elif code == MOVE_WORD:
        store_word(column + 4 * row, word)
    elif code == MOVE_HALF:
        store_half(column + 2 * row, word)
    else:
        store_byte(column + row, word)


@compiled()
def move_batch(machine: Any, first: Any, last: Any, size: Any, batch: Any) -> Any:
    """Run the operations [first, last) of events of constant layout, one operation at a time.

    ``batch`` is the number of events and their (address, row); each has ``size`` bytes, and
    eight more that may be loaded.  One operation over many events has no branches to guess and
    nothing to wait for.  Returns 0 or FULL_DICTIONARY, after which all is to be done again.
    """
    count, ops = get(batch, 0), get(machine, M_OPS)
    for op in range(ops + (first << 7), ops + (last << 7), OP_BYTES):
        code, column, offset = get(op, CODE), get(op, ADDRESS), get(op, OFFSET)
        if code == SKIP:
            continue
        if code == CHARACTERS:
            length = get(op, COUNT)
            for index in range(count):
                place = get(batch, 2 * index + 1) + offset
                found, digest, word = digest_text(place, np.int64(0), length, size - offset + 8)
                if found < 0:
                    found, digest, word = digest_whole(
                        place, np.int64(0), length, size - offset + 8
                    )
                text = intern(machine, place, found, digest, word)
                if text < 0:
                    return np.int64(FULL_DICTIONARY)
                store_word(column + 4 * get(batch, 2 * index + 2), np.uint64(text))
        else:
            for index in range(count):
                word = load_word(get(batch, 2 * index + 1) + offset)
                move(code, column, get(batch, 2 * index + 2), word)
    put(batch, 0, np.int64(0))
    return np.int64(0)


@compiled()
def execute(
    machine: Any,
    first: Any,
    last: Any,
    base: Any,
    mapped: Any,
    end: Any,
    position: Any,
    regs: Any,
    row: Any,
) -> Any:
    """Run the operations [first, last) from ``position``; the position after or a failure.

    ``base`` is the address of the packet, ``mapped`` the bytes that may be loaded from there,
    ``end`` the end of the content in bits, ``regs`` the address of the registers,
    ``row`` that of the table that the event goes to.
    """
    ops, state = get(machine, M_OPS), get(machine, M_STATE)
    op, stop = ops + (first << 7), ops + (last << 7)
    depth, turns = np.int64(0), np.int64(0)
    while op < stop:
        code, align = get(op, CODE), get(op, ALIGN)
        position = (position + align - 1) & -align
        if code >= MOVE_LONG:
            place = position >> 3
            position += get(op, SIZE)
            if position > end:
                return np.int64(TRUNCATED)
            if place + 8 > mapped:
                run_number(machine, op, base, mapped, position - get(op, SIZE), regs)
            else:
                move(code, get(op, ADDRESS), row, load_word(base + place))
            op += OP_BYTES
        elif code == NUMBER:
            following = position + get(op, SIZE)
            if following > end:
                return np.int64(TRUNCATED)
            run_number(machine, op, base, mapped, position, regs)
            position = following
            op += OP_BYTES
        elif code == SKIP:
            position += get(op, SIZE)
            if position > end:
                return np.int64(TRUNCATED)
            op += OP_BYTES
        elif code in (TEXT, CHARACTERS):
            position = run_text(machine, op, base, mapped, end, position, regs)
            if position < 0:
                return position
            op += OP_BYTES
        elif code in (SKIP_MANY, COPY, LOOP):
            position = run_many(machine, op, base, end, position, regs, depth)
            if position < 0:
                return position
            if code != LOOP:
                op += OP_BYTES
            elif get(state, STACK + depth) == 0:
                op = ops + (get(op, TARGET) << 7)
            else:
                depth += 1
                op += OP_BYTES
        elif code == AGAIN:
            inner = get(op, INNER)
            if inner >= 0:
                rows = get(machine, M_ROWS)
                put(rows, inner, get(rows, inner) + 1)
            # Elements of no bits must not keep us here for ever.
            turns += 1
            if turns > 2 * end + 1024:
                return np.int64(BAD_LENGTH)
            left = get(state, STACK + depth - 1) - 1
            put(state, STACK + depth - 1, left)
            if left > 0:
                op = ops + (get(op, TARGET) << 7)
            else:
                depth -= 1
                op += OP_BYTES
        elif code == SWITCH:
            chosen = choose(op, get(machine, M_RANGES), regs)
            if chosen < 0:
                return np.int64(NO_OPTION)
            if get(op, ADDRESS) != 0:
                keep(op, np.uint64(get(chosen, 3)), get(machine, M_ROWS))
            op = ops + (get(chosen, 2) << 7)
        else:
            op = ops + (get(op, TARGET) << 7)
    return position
