"""Compiled reading of texts into a dictionary: every different string is kept once."""

# Numba mixes int64 and uint64 into float64: every value below keeps to one of the two.
# Kernels take many numbers rather than objects, whose references Numba would have to count.

from __future__ import annotations

from typing import Any

import numpy as np

from chainshaper.compiled.memory import (
    compiled,
    get,
    load_byte,
    load_word,
    put,
    store_word,
    trailing_zeros,
)
from chainshaper.sources.ctf.machine import (
    FACTOR,
    HIGHS,
    LOW,
    M_ENTRIES,
    M_MASK,
    M_ROOM,
    M_SLOTS,
    M_STATE,
    ONES,
    STRINGS,
    U0,
    U1,
    U29,
    U32,
)

__all__ = ["digest_text", "digest_whole", "intern", "rehash", "word_at"]


@compiled(inline=True)
def word_at(base: Any, at: Any, mapped: Any) -> Any:
    """The little-endian 8 bytes at byte ``at``, zeros behind the ``mapped`` bytes."""
    if at + 8 <= mapped:
        return load_word(base + at)
    word = U0
    for index in range(max(0, min(8, mapped - at))):
        word |= load_byte(base + at + index) << np.uint64(8 * index)
    return word


@compiled(inline=True)
def digest_text(base: Any, at: Any, limit: Any, mapped: Any) -> Any:
    """Read a text in [at, limit) up to its first NUL.

    Returns (length or -1 where there is no NUL, its hash, its last word with zeros behind it).
    """
    digest, word = FACTOR, U0
    place = at
    while place < limit:
        word = word_at(base, place, mapped)
        zeros = (word - ONES) & ~word & HIGHS
        if zeros != U0:
            # The first NUL is the lowest marked byte; what lies behind it does not count.
            length = place - at + (trailing_zeros(zeros) >> 3)
            word &= ((zeros & (U0 - zeros)) >> np.uint64(7)) - U1
            if at + length >= limit:
                break
            digest = (digest ^ word) * FACTOR
            return length, digest ^ (digest >> U29), word
        digest = (digest ^ word) * FACTOR
        digest ^= digest >> U29
        place += 8
    return np.int64(-1), digest, word


@compiled()
def digest_whole(base: Any, at: Any, length: Any, mapped: Any) -> Any:
    """The same of a text of ``length`` bytes without NUL."""
    digest, word = FACTOR, U0
    offset = length * 0
    while offset + 8 <= length:
        word = word_at(base, at + offset, mapped)
        digest = (digest ^ word) * FACTOR
        digest ^= digest >> U29
        offset += 8
    word = word_at(base, at + offset, mapped)
    word &= (U1 << np.uint64(8 * (length - offset))) - U1
    digest = (digest ^ word) * FACTOR
    return length, digest ^ (digest >> U29), word


@compiled(inline=True)
def slot_at(slots: Any, place: Any) -> Any:
    """1 + the code in a place of the hash table, 0 for none."""
    return np.int64(load_word(slots + 4 * place) & LOW)


@compiled(inline=True)
def intern(machine: Any, place: Any, length: Any, digest: Any, word: Any) -> Any:
    """The dictionary code of the string at an address, or -1 where the dictionary is full.

    Entries are rows (address, length, hash, last word); the hash table is open, with as many
    places as a power of two.
    """
    slots, mask, entries = get(machine, M_SLOTS), get(machine, M_MASK), get(machine, M_ENTRIES)
    slot = np.int64(digest >> U32) & mask
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
    state = get(machine, M_STATE)
    code = get(state, STRINGS)
    if 2 * code > mask or code >= get(machine, M_ROOM):
        return np.int64(-1)
    put(state, STRINGS, code + 1)
    entry = entries + 32 * code
    put(entry, 0, place)
    put(entry, 1, length)
    put(entry, 2, np.int64(digest))
    put(entry, 3, np.int64(word))
    store_word(slots + 4 * slot, np.uint64(code + 1))
    return code


@compiled()
def rehash(machine: Any, count: Any) -> Any:
    """Fill the zeroed hash table with the first ``count`` entries; returns their number."""
    slots, mask, entries = get(machine, M_SLOTS), get(machine, M_MASK), get(machine, M_ENTRIES)
    for code in range(count):
        place = np.int64(np.uint64(get(entries + 32 * code, 2)) >> U32) & mask
        while slot_at(slots, place) != 0:
            place = (place + 1) & mask
        store_word(slots + 4 * place, np.uint64(code + 1))
    return count
