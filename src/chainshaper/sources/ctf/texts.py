"""Compiled reading of texts into a dictionary: every different string is kept once."""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

# Numba mixes int64 and uint64 into float64: every value below keeps to one of the two.
# Kernels take many numbers rather than objects, whose references Numba would have to count.

import numpy as np

from chainshaper.sources.ctf import tables as tb
from chainshaper.values.compiled.memory import (
    compiled,
    get,
    load_byte,
    load_word,
    put,
    store_word,
    trailing_zeros,
)

__all__ = ["digest_text", "digest_whole", "intern", "rehash", "word_at"]


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
def digest_text(base, at, limit, mapped):
    """Read a text in [at, limit) up to its first NUL.

    Returns (length or -1 where there is no NUL, its hash, its last word with zeros behind it).
    """
    digest, word = tb.FACTOR, tb.U0
    place = at
    while place < limit:
        word = word_at(base, place, mapped)
        zeros = (word - tb.ONES) & ~word & tb.HIGHS
        if zeros != tb.U0:
            # The first NUL is the lowest marked byte; what lies behind it does not count.
            length = place - at + (trailing_zeros(zeros) >> 3)
            word &= ((zeros & (tb.U0 - zeros)) >> np.uint64(7)) - tb.U1
            if at + length >= limit:
                break
            digest = (digest ^ word) * tb.FACTOR
            return length, digest ^ (digest >> tb.U29), word
        digest = (digest ^ word) * tb.FACTOR
        digest ^= digest >> tb.U29
        place += 8
    return np.int64(-1), digest, word


@compiled()
def digest_whole(base, at, length, mapped):
    """The same of a text of ``length`` bytes without NUL."""
    digest, word = tb.FACTOR, tb.U0
    offset = length * 0
    while offset + 8 <= length:
        word = word_at(base, at + offset, mapped)
        digest = (digest ^ word) * tb.FACTOR
        digest ^= digest >> tb.U29
        offset += 8
    word = word_at(base, at + offset, mapped)
    word &= (tb.U1 << np.uint64(8 * (length - offset))) - tb.U1
    digest = (digest ^ word) * tb.FACTOR
    return length, digest ^ (digest >> tb.U29), word


@compiled(inline=True)
def slot_at(slots, place):
    """1 + the code in a place of the hash table, 0 for none."""
    return np.int64(load_word(slots + 4 * place) & tb.LOW)


@compiled(inline=True)
def intern(machine, place, length, digest, word):
    """The dictionary code of the string at an address, or -1 where the dictionary is full.

    Entries are rows (address, length, hash, last word); the hash table is open, with as many
    places as a power of two.
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
            index = length * 0
            while index + 8 < length and load_word(get(entry, 0) + index) == load_word(
                place + index
            ):
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
def rehash(machine, count):
    """Fill the zeroed hash table with the first ``count`` entries; returns their number."""
    slots, mask = get(machine, tb.M_SLOTS), get(machine, tb.M_MASK)
    entries = get(machine, tb.M_ENTRIES)
    for code in range(count):
        place = np.int64(np.uint64(get(entries + 32 * code, 2)) >> tb.U32) & mask
        while slot_at(slots, place) != 0:
            place = (place + 1) & mask
        store_word(slots + 4 * place, np.uint64(code + 1))
    return count
