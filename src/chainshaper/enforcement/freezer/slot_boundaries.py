"""When servers open and close: the instants of a cycle, and how cycles move to another anchor.

A table of servers becomes a list of **boundaries**: instants of the cycle with the servers that
are open from there on. Slots are half-open, so at a boundary that two slots share one server
closes and the other opens, and nothing is open twice. A slot that ends with the cycle ends where
the next cycle begins; a boundary stands at 0 always, because cycles of another anchor may begin
there.

Which instants those are on the clock depends on the anchor. Moving to another anchor must let no
thread slip between: a new cycle begins where an old one ends or would have, whichever of the two
is shorter to reach. Either the old cycle is cut short by less than half of its length, or all
servers wait, closed, for less than that.
"""

from collections.abc import Iterator
from dataclasses import dataclass

__all__ = [
    "Anchoring",
    "Boundary",
    "boundaries_of",
    "first_anchoring",
    "instants",
    "moved",
    "next_anchoring",
]


@dataclass(frozen=True)
class Boundary:
    """From ``offset_ns`` into the cycle on, exactly the servers in ``open`` are open.

    ``starts`` are those of them of which a slot begins here. Servers are counted by their place
    in the table.
    """

    offset_ns: int
    open: frozenset[int]
    starts: frozenset[int]


@dataclass(frozen=True)
class Anchoring:
    """Cycles start at ``begin_ns`` and every cycle time thereafter; the old ones end at ``end_ns``.

    Both are instants of CLOCK_MONOTONIC. The earlier of the two is when the old cycles are left.
    """

    begin_ns: int
    end_ns: int


def boundaries_of(
    cycle_ns: int, slots: tuple[tuple[tuple[int, int], ...], ...]
) -> tuple[Boundary, ...]:
    """The boundaries of one cycle, ascending; ``slots`` has one entry per server.

    >>> [(b.offset_ns, set(b.open)) for b in boundaries_of(10, (((0, 4),), ((4, 10),)))]
    [(0, {0}), (4, {1})]
    """
    offsets = {0} | {edge % cycle_ns for own in slots for slot in own for edge in slot}
    return tuple(
        Boundary(
            offset,
            frozenset(
                server
                for server, own in enumerate(slots)
                if any(start <= offset < end for start, end in own)
            ),
            frozenset(
                server for server, own in enumerate(slots) if any(s == offset for s, _ in own)
            ),
        )
        for offset in sorted(offsets)
    )


def instants(
    boundaries: tuple[Boundary, ...], cycle_ns: int, begin_ns: int
) -> Iterator[tuple[int, Boundary]]:
    """Every boundary with its time (ns), without end, from the cycle at ``begin_ns`` on.

    Where nothing changes nobody needs to wake up: from the second cycle on such a boundary (only
    the one at 0 can be) is left out.
    """
    first, last = boundaries[0], boundaries[-1]
    idle = len(boundaries) > 1 and first.open == last.open and not first.starts
    for boundary in boundaries:
        yield begin_ns + boundary.offset_ns, boundary
    while True:
        begin_ns += cycle_ns
        for boundary in boundaries[1:] if idle else boundaries:
            yield begin_ns + boundary.offset_ns, boundary


def moved(
    ahead: Iterator[tuple[int, Boundary]],
    anchoring: Anchoring,
    boundaries: tuple[Boundary, ...],
    cycle_ns: int,
) -> Iterator[tuple[int, Boundary]]:
    """The boundaries ``ahead`` until the new anchoring's turn comes, and its own from there on."""
    turn = min(anchoring.begin_ns, anchoring.end_ns)
    for at, boundary in ahead:
        if at >= turn:
            break
        yield at, boundary
    del ahead  # it may itself be a stream that was moved: only the last move matters now
    if anchoring.end_ns < anchoring.begin_ns:
        yield anchoring.end_ns, Boundary(cycle_ns, frozenset(), frozenset())
    yield from instants(boundaries, cycle_ns, anchoring.begin_ns)


def first_anchoring(anchor_ns: int, cycle_ns: int, earliest_ns: int) -> Anchoring:
    """The first start of a cycle at or after ``earliest_ns``; before it nothing is enforced."""
    begin = anchor_ns + -((anchor_ns - earliest_ns) // cycle_ns) * cycle_ns
    return Anchoring(begin, begin)


def next_anchoring(
    in_force: Anchoring, anchor_ns: int, cycle_ns: int, earliest_ns: int
) -> Anchoring:
    """From the anchoring in force to another anchor, at the first end of a cycle that allows it.

    ``earliest_ns`` is when the change may happen at the earliest. Worked by hand, cycle time 100,
    cycles at 0, 100, 200, …, not before 950:

        >>> next_anchoring(Anchoring(0, 0), 30, 100, 950)       # wait, closed, from 1000 to 1030
        Anchoring(begin_ns=1030, end_ns=1000)
        >>> next_anchoring(Anchoring(0, 0), 80, 100, 950)       # cut the cycle from 900 short
        Anchoring(begin_ns=980, end_ns=1000)
    """
    end = first_anchoring(in_force.begin_ns, cycle_ns, max(earliest_ns, in_force.begin_ns)).begin_ns
    shift = (anchor_ns - end) % cycle_ns
    if shift > cycle_ns // 2:
        shift -= cycle_ns
    if end + shift < earliest_ns:
        end += cycle_ns
    return Anchoring(end + shift, end)
