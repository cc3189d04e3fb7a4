"""The compiled interpreter: runs operations over a packet's bits (CTF 1.8, section 4).

Positions are bits from the start of a packet. Every operation checks the end of the packet's
content before it reads, and every load the bytes mapped behind the packet's start; a failed check
ends the run with a negative code of `layout`. Texts go to a dictionary, each different one once.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False
# ruff: noqa: PLR0912, PLR0917

import numpy as np

from chainshaper.sources.ctf import layout as tb
from chainshaper.values.compiled.memory import (
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
    trailing_zeros,
)

ZERO = np.int64(0)

# Numba mixes int64 and uint64 into float64: every value below keeps to one of the two.


@compiled(inline=True)
def word_at(base, at, mapped):
    """The little-endian 8 bytes at byte ``at``, zeros behind the ``mapped`` bytes."""
    if at + 8 <= mapped:
        return load_word(base + at)
    word = tb.U0
    for index in range(max(0, min(8, mapped - at))):
        word |= load_byte(base + at + index) << np.uint64(8 * index)
    return word


@compiled(inline=True)
def digest_characters(op, base, at, limit, mapped):
    """Length, hash and last word (zeros behind it) of what ends at ``limit``, a text at a NUL."""
    digest, word, place, zeros = tb.FACTOR, tb.U0, at, tb.U0
    is_text = get(op, tb.O_FLAGS) != 0
    while zeros == tb.U0 and (is_text or place < limit):
        word = word_at(base, place, mapped)
        if place + 8 > limit:  # what lies behind the limit counts as NUL
            word &= (tb.U1 << np.uint64(8 * (limit - place))) - tb.U1
        if is_text:
            zeros = (word - tb.ONES) & ~word & tb.HIGHS
            if zeros != tb.U0:
                # The first NUL is the lowest marked byte; what lies behind it does not count.
                word &= ((zeros & (tb.U0 - zeros)) >> np.uint64(7)) - tb.U1
        digest = (digest ^ word) * tb.FACTOR
        digest ^= digest >> tb.U29
        place += 8
    length = place - 8 + (trailing_zeros(zeros) >> 3) - at if is_text else limit - at
    return length, digest, word


@compiled(inline=True)
def slot_at(slots, place):
    """1 + the code in a place of the hash table, 0 for none."""
    return np.int64(load_word(slots + 4 * place) & tb.LOW)


@compiled(inline=True)
def intern(machine, place, length, digest, word):
    """The dictionary code of the string at an address, or -1 where the dictionary is full.

    Entries are rows (address, length, hash, last word); the hash table is open.
    """
    slots, mask = get(machine, tb.M_SLOTS), get(machine, tb.M_MASK)
    entries = get(machine, tb.M_ENTRIES)
    slot = np.int64(digest >> tb.U32) & mask
    code = slot_at(slots, slot) - 1
    while code >= 0:
        entry = entries + 32 * code
        if (
            get(entry, 2) == np.int64(digest)
            and get(entry, 1) == length
            and get(entry, 3) == np.int64(word)
        ):
            index, known = length * 0, get(entry, 0)
            while index + 8 < length and load_word(known + index) == load_word(place + index):
                index += 8
            if index + 8 >= length:
                return code
        slot = (slot + 1) & mask
        code = slot_at(slots, slot) - 1
    state = get(machine, tb.M_STATE)
    code = get(state, tb.X_STRINGS)
    if 2 * code > mask or code >= get(machine, tb.M_ROOM):
        return np.int64(-1)
    put(state, tb.X_STRINGS, code + 1)
    entry = entries + 32 * code
    put(entry, 0, place)
    put(entry, 1, length)
    put(entry, 2, np.int64(digest))
    put(entry, 3, np.int64(word))
    store_word(slots + 4 * slot, np.uint64(code + 1))
    return code


@compiled()
def bits_at(base, position, size, big, mapped):
    """An unsigned integer of ``size`` bits at any bit, as uint64 (section 4.1.5)."""
    at = position >> 3
    shift = np.uint64(position & 7)
    width = np.uint64(size)
    word = word_at(base, at, mapped)
    across = shift + width > tb.U64 and at + 8 < mapped
    if big:
        word = swap_bytes(word) << shift
        if across:
            word |= load_byte(base + at + 8) >> (tb.U8 - shift)
        return word >> (tb.U64 - width)
    word >>= shift
    if across:
        word |= load_byte(base + at + 8) << (tb.U64 - shift)
    if size < 64:
        word &= (tb.U1 << width) - tb.U1
    return word


@compiled(inline=True)
def store(column, width, row, value):
    if width == 8:
        store_long(column + 8 * row, value)
    elif width == 4:
        store_word(column + 4 * row, value)
    elif width == 2:
        store_half(column + 2 * row, value)
    else:
        store_byte(column + row, value)


@compiled(inline=True)
def keep(op, value, row):
    if get(op, tb.O_ADDRESS) != 0:
        store(get(op, tb.O_ADDRESS), get(op, tb.O_WIDTH), row, value)


@compiled(inline=True)
def afforded(state, cost):
    """Spend some of the budget; whether it lasts."""
    left = get(state, tb.X_BUDGET) - cost
    put(state, tb.X_BUDGET, left)
    return left >= 0


@compiled(inline=True)
def advance_clock(state, value, size):
    """Set the low ``size`` bits of the clock; it wraps forward only (section 8)."""
    if size >= 64:
        put(state, tb.X_CLOCK, np.int64(value))
        return
    mask = (tb.U1 << np.uint64(size)) - tb.U1
    now = np.uint64(get(state, tb.X_CLOCK))
    if value < (now & mask):
        now += mask + tb.U1
    put(state, tb.X_CLOCK, np.int64((now & ~mask) | value))


@compiled()
def run_number(machine, op, base, mapped, position, regs, row):
    """Read an integer or a float's bits; the caller has checked the end."""
    size, flags = get(op, tb.O_SIZE), get(op, tb.O_FLAGS)
    value = bits_at(base, position, size, flags & 2, mapped)
    if flags & 1:
        rest = np.int64(64 - size)
        value = np.uint64((np.int64(value) << rest) >> rest)
    register = get(op, tb.O_REGISTER)
    if register >= 0:
        put(regs, register, np.int64(value))
    keep(op, value, row)
    if flags & 4:
        advance_clock(get(machine, tb.M_STATE), value, size)


@compiled(inline=True)
def run_text(machine, op, base, mapped, end, position, regs, row):
    """Read a string or a text array; returns the position behind it or a failure."""
    at, limit, is_open = position >> 3, end >> 3, get(op, tb.O_CODE) == tb.TEXT
    if not is_open:
        register = get(op, tb.O_REGISTER)
        count = get(op, tb.O_COUNT) if register < 0 else get(regs, register)
        if count < 0 or count > (end - position) >> 3:
            return np.int64(tb.BAD_LENGTH)
        limit = at + count
    length, digest, word = digest_characters(op, base, at, limit, mapped)
    if is_open:
        if at + length >= limit:
            return np.int64(tb.UNTERMINATED)
        limit = at + length + 1
    if get(op, tb.O_ADDRESS) != 0:
        code = intern(machine, base + at, length, digest, word)
        if code < 0:
            return np.int64(tb.FULL_DICTIONARY)
        keep(op, np.uint64(code), row)
    return limit << 3


@compiled()
def choose(op, ranges, regs):
    """The address of the row of ``ranges`` that holds a variant's tag, or -1."""
    tag = get(regs, get(op, tb.O_REGISTER))
    if get(op, tb.O_FLAGS) == 0:
        tag = np.int64(np.uint64(tag) ^ (tb.U1 << np.uint64(63)))
    first = get(op, tb.O_COUNT)
    for index in range(first, first + get(op, tb.O_LEAST)):
        row = ranges + 24 * index
        if get(row, 0) <= tag <= get(row, 1):
            return row
    return np.int64(-1)


@compiled()
def run_many(machine, op, end, position, regs, depth):
    """Run a SKIP_MANY, or begin a LOOP, whose turns go on the stack at ``depth``.

    Returns the position behind it or a failure.
    """
    code, register = get(op, tb.O_CODE), get(op, tb.O_REGISTER)
    count = get(op, tb.O_COUNT) if register < 0 else get(regs, register)
    least = get(op, tb.O_LEAST) if code == tb.LOOP else get(op, tb.O_SIZE)
    if count < 0 or count >= tb.ENDLESS or position > end:
        return np.int64(tb.BAD_LENGTH)
    if least > 0 and count > (end - position) // least:
        return np.int64(tb.BAD_LENGTH)
    state = get(machine, tb.M_STATE)
    if not afforded(state, count * get(op, tb.O_COST)):
        return np.int64(tb.OVER_BUDGET)
    if code == tb.LOOP:
        put(state, tb.X_STACK + depth, count)
        return position
    return position + count * get(op, tb.O_SIZE)


@compiled()
def move_batch(machine, event, batch):
    """Run the operations of a class of events of constant layout, each over the whole ``batch``.

    So there are no branches to guess and nothing to wait for. Eight bytes behind each event may be
    loaded. Returns 0 or FULL_DICTIONARY, after which all is to be done again.
    """
    count, ops, size = get(batch, 0), get(machine, tb.M_OPS), get(event, tb.E_SIZE) >> 3
    first, last = get(event, tb.E_WALK), get(event, tb.E_WALK_STOP)
    for op in range(ops + (first << 7), ops + (last << 7), tb.O_ROW):
        code, column, offset = get(op, tb.O_CODE), get(op, tb.O_ADDRESS), get(op, tb.O_OFFSET)
        if code == tb.SKIP:
            continue
        if code == tb.CHARACTERS:
            length = get(op, tb.O_COUNT)
            for index in range(count):
                place = get(batch, 2 * index + 1) + offset
                mapped = size - offset + 8
                found, digest, word = digest_characters(op, place, ZERO, length, mapped)
                text = intern(machine, place, found, digest, word)
                if text < 0:
                    return np.int64(tb.FULL_DICTIONARY)
                store_word(column + 4 * get(batch, 2 * index + 2), np.uint64(text))
        else:
            width = get(op, tb.O_WIDTH)
            for index in range(count):
                word = load_word(get(batch, 2 * index + 1) + offset)
                store(column, width, get(batch, 2 * index + 2), word)
    put(batch, 0, np.int64(0))
    return np.int64(0)


@compiled()
def execute(machine, owner, column, base, mapped, end, position, regs, row):
    """Run operations from ``position``; the position after or a failure.

    Their first and the one after their last stand in the ``column`` of ``owner`` and the next.
    ``base`` is the address of the packet, ``mapped`` the bytes that may be loaded from there,
    ``end`` the end of the content in bits, ``row`` that of the table that the event goes to.
    """
    ops, state = get(machine, tb.M_OPS), get(machine, tb.M_STATE)
    op, stop = ops + (get(owner, column) << 7), ops + (get(owner, column + 1) << 7)
    depth = np.int64(0)
    while op < stop:
        code, align, following = get(op, tb.O_CODE), get(op, tb.O_ALIGN), op + tb.O_ROW
        position = (position + align - 1) & -align
        if code <= tb.MOVE:
            start, place = position, position >> 3
            position += get(op, tb.O_SIZE)
            if position > end:
                return np.int64(tb.TRUNCATED)
            slot = get(op, tb.O_ADDRESS)
            if code == tb.MOVE and slot != 0 and place + 8 <= mapped:
                store(slot, get(op, tb.O_WIDTH), row, load_word(base + place))
            elif code == tb.NUMBER or slot != 0:
                run_number(machine, op, base, mapped, start, regs, row)
        elif code <= tb.CHARACTERS:
            position = run_text(machine, op, base, mapped, end, position, regs, row)
            if position < 0:
                return position
        elif code <= tb.LOOP:
            position = run_many(machine, op, end, position, regs, depth)
            if position < 0:
                return position
            if code == tb.LOOP and get(state, tb.X_STACK + depth) == 0:
                following = ops + (get(op, tb.O_TARGET) << 7)
            elif code == tb.LOOP:
                depth += 1
        elif code == tb.AGAIN:
            left = get(state, tb.X_STACK + depth - 1) - 1
            put(state, tb.X_STACK + depth - 1, left)
            if left > 0:
                following = ops + (get(op, tb.O_TARGET) << 7)
            else:
                depth -= 1
        elif code == tb.SWITCH:
            chosen = choose(op, get(machine, tb.M_RANGES), regs)
            if chosen < 0:
                return np.int64(tb.NO_OPTION)
            following = ops + (get(chosen, 2) << 7)
        else:
            following = ops + (get(op, tb.O_TARGET) << 7)
        op = following
    return position
