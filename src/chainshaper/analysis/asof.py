"""The compiled asof join: for every row the latest row of another table with the same key.

Events come sorted by time, so one walk over both tables that remembers the latest row of every key
is enough. Keys are few (threads, handles) and times many: a lookup stays in the processor's
nearest cache, and a row costs some ten nanoseconds, a fraction of grouping both tables by key.
"""

# mypy: disallow_untyped_defs=False, disallow_untyped_calls=False, disallow_untyped_decorators=False

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["key_table", "latest_rows", "next_rows", "place_of"]

Int64s = npt.NDArray[np.int64]
Keys = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Two numbers that are a row's key together."""

_FIRST_SLOTS = 1024


def latest_rows(left: Keys, at: Int64s, right: Keys, times: Int64s, *, strictly: bool) -> Int64s:
    """For every row of ``left`` the last row of ``right`` with its key at or before it, else −1.

    ``at`` and ``times`` (ns) ascend; ``strictly`` leaves out rows at the very time.
    """
    found: Int64s = np.full(len(at), -1, dtype=np.int64)
    slots = _FIRST_SLOTS
    while not _walk_forward((*left, at), (*right, times), strictly, found, slots):
        slots *= 8
    return found


def next_rows(left: Keys, at: Int64s, right: Keys, times: Int64s, *, strictly: bool) -> Int64s:
    """For every row of ``left`` the first row of ``right`` with its key at or after it, else −1."""
    found: Int64s = np.full(len(at), -1, dtype=np.int64)
    slots = _FIRST_SLOTS
    while not _walk_backward((*left, at), (*right, times), strictly, found, slots):
        slots *= 8
    return found


@numba.njit(cache=True, nogil=True)
def key_table(slots):
    """An empty open-addressed table of ``slots`` keys, a power of two, for :func:`place_of`."""
    return (
        np.zeros(slots, dtype=np.int64),
        np.zeros(slots, dtype=np.int64),
        np.zeros(slots + 1, dtype=np.int64),  # which are taken, and in the last how many
    )


@numba.njit(cache=True, nogil=True)
def place_of(table, first, second, add):
    """The place of a key in a table; with ``add`` it gets one, −1 once the table is half full.

    Without ``add``, −1 for a key that is not there.
    """
    firsts, seconds, taken = table
    slots = len(firsts)
    mixed = (np.uint64(first) * np.uint64(0x9E3779B97F4A7C15)) ^ (
        np.uint64(second) * np.uint64(0xC2B2AE3D27D4EB4F)
    )
    at = np.int64((mixed >> np.uint64(17)) & np.uint64(slots - 1))
    while taken[at]:
        if firsts[at] == first and seconds[at] == second:
            return at
        at = (at + 1) & (slots - 1)
    if not add or 2 * taken[slots] >= slots:
        return np.int64(-1)
    taken[slots] += 1
    firsts[at], seconds[at], taken[at] = first, second, 1
    return at


@numba.njit(cache=True, nogil=True)
def _walk_forward(left, right, strictly, found, slots):
    """Fill ``found`` in order of time; false where ``slots`` are too few for all keys."""
    table, latest = key_table(slots), np.zeros(slots, dtype=np.int64)
    (first, second, at), (its_first, its_second, times) = left, right
    other = 0
    for row in range(len(at)):
        now = at[row]
        while other < len(times) and (times[other] < now or (times[other] == now and not strictly)):
            place = place_of(table, its_first[other], its_second[other], True)
            if place < 0:
                return False
            latest[place] = other
            other += 1
        place = place_of(table, first[row], second[row], False)
        found[row] = latest[place] if place >= 0 else -1
    return True


@numba.njit(cache=True, nogil=True)
def _walk_backward(left, right, strictly, found, slots):
    """The same from the end, which leaves the earliest row of every key."""
    table, earliest = key_table(slots), np.zeros(slots, dtype=np.int64)
    (first, second, at), (its_first, its_second, times) = left, right
    other = len(times) - 1
    for row in range(len(at) - 1, -1, -1):
        now = at[row]
        while other >= 0 and (times[other] > now or (times[other] == now and not strictly)):
            place = place_of(table, its_first[other], its_second[other], True)
            if place < 0:
                return False
            earliest[place] = other
            other -= 1
        place = place_of(table, first[row], second[row], False)
        found[row] = earliest[place] if place >= 0 else -1
    return True
