"""From a thread's run windows to what it did in its slots and outside; ns throughout.

Windows and slots are lists of half-open (start, end) pairs, ascending and disjoint.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

Intervals = list[tuple[int, int]]


def read_windows(log: Path) -> Intervals:
    return list(struct.iter_unpack("<qq", log.read_bytes()))


def slots_between(
    slots: tuple[tuple[int, int], ...], cycle: int, anchor: int, start: int, end: int
) -> Intervals:
    """The slots of every cycle as absolute intervals, cut to [start, end)."""
    first = (start - anchor) // cycle
    last = (end - anchor) // cycle
    absolute = (
        (anchor + k * cycle + a, anchor + k * cycle + b)
        for k in range(first, last + 1)
        for a, b in slots
    )
    return [(max(a, start), min(b, end)) for a, b in absolute if b > start and a < end]


def cut(windows: Intervals, start: int, end: int) -> Intervals:
    return [(max(a, start), min(b, end)) for a, b in windows if b > start and a < end]


def overlap(left: Intervals, right: Intervals) -> int:
    total, i, j = 0, 0, 0
    while i < len(left) and j < len(right):
        total += max(0, min(left[i][1], right[j][1]) - max(left[i][0], right[j][0]))
        if left[i][1] < right[j][1]:
            i += 1
        else:
            j += 1
    return total


def length(intervals: Intervals) -> int:
    return sum(end - start for start, end in intervals)


@dataclass(frozen=True)
class Precision:
    """How exactly slots were kept: first run after their start, last run after their end."""

    enter: tuple[int, ...]
    leave: tuple[int, ...]
    unused: int
    outside: int

    def text(self) -> str:
        return (
            f"{len(self.enter)} slots, enter {_spread(self.enter)} us, leave "
            f"{_spread(self.leave)} us, outside {self.outside / 1e3:.1f} us"
        )


def precision(windows: Intervals, slots: Intervals) -> Precision:
    """Compare windows of a thread that always wants to run with its slots."""
    enter, leave, unused = [], [], 0
    for start, end in slots:
        inside = [(a, b) for a, b in windows if b > start and a < end]
        if not inside:
            unused += 1
            continue
        enter.append(max(inside[0][0] - start, 0))
        leave.append(inside[-1][1] - end)
    outside = length(windows) - overlap(windows, slots)
    return Precision(tuple(enter), tuple(leave), unused, outside)


def _spread(values: tuple[int, ...]) -> str:
    ordered = sorted(values)
    chosen = (ordered[0], ordered[len(ordered) // 2], ordered[-1])
    return "/".join(f"{value / 1e3:.1f}" for value in chosen)
