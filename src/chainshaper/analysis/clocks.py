"""How far the clock of one host is ahead of another's, over time, from the messages between them.

A message that the reference sends at its time x, and that the host takes when its own clock shows
y, was not taken before it was sent: at x the host was ahead by y − x at most. A message the other
way bounds it from below. Both together leave a corridor.

* **Straight pieces.** Two oscillators run apart at a nearly constant rate. Which lines lie between
  all bounds is a linear program of two variables, the line's height and its rate: the rates of all
  such lines are an interval, found exactly on the convex hulls of both sides (Duda et al. 1987;
  Poirier, Roy, Dagenais 2010; Jabbarifar 2013). Where no line fits any more, a clock was set or
  slewed, and another piece begins.
* **Between the bounds.** No clock runs at a constant rate for long. So the corridor is not that of
  the lines: within a piece the clock may run at any of their rates, and by ``WANDER`` faster or
  slower, and it may change its rate at any time. This, too, is exact: the highest offset at an
  instant is the lowest of all upper bounds, each carried there at the highest rate that is allowed.
* **Where a piece begins** is uncertain from the first message that may belong to the new piece to
  the first that must. There the corridor covers both pieces.

A step that is smaller than the corridor is wide cannot be seen.

Offsets are the host's clock less the reference's. Times and offsets are integer ns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.float64]

WANDER = 5e-6
"""By how much (share of time) a clock's rate may leave those of the lines that fit a piece."""
MOST_RATE = 1e-3
"""Two clocks run apart no faster than this; adjtimex slews each by 500 ppm at most."""
_ROUNDED_NS = 2.0  # what rounding may take from bounds that touch each other
_BEHIND_NS = 1_000  # how much later, at least, an uncertain stretch ends
_FIRST_TRIED = 64  # bounds
_CELLS = 4096  # the corridor is kept as so many cells, and one for each uncertain stretch
_MOST_PIECES = 10  # so many may have less than:
_LEAST_PER_PIECE = 20  # bounds in each piece, on average


class ContradictingClocksError(ValueError):
    """No offset fits the bounds for long enough."""


@dataclass(frozen=True)
class OffsetBounds:
    """Bounds of an offset: ``offsets[i]`` holds at the reference's time ``times[i]`` (both ns)."""

    times: Times
    offsets: Times


@dataclass(frozen=True)
class Piece:
    """A stretch in which the offset is nearly a line.

    ``since`` and ``until`` are the reference's times of its first and last bound that belong to no
    other piece; ``begins`` is the time of the host's clock from which on it is converted by this
    piece's line. ``rates`` are the lowest and the highest that are allowed here, in shares of time.
    """

    since: int
    until: int
    begins: int
    follows: int  # the last time of the host's clock that the piece before can have shown
    origin: int  # reference's time at which the line has the offset `offset`
    offset: int
    rate: float
    rates: tuple[float, float]
    is_step: bool = True  # the clock jumped as it began; else it changed its rate
    unsure: int = 0  # so far around where it begins, instants may be converted by the wrong line

    def line(self, times: Times) -> Times:
        """Return the offset on the line at times of the reference."""
        away = np.rint((times - self.origin) * self.rate).astype(np.int64)
        return np.asarray(self.offset + away, dtype=np.int64)


@dataclass(frozen=True)
class Corridor:
    """The offset of a host over time.

    ``cells`` begin at ``starts`` (reference's time, ns). In a cell the host's true offset is at
    most ``above`` over the line of its piece, and at most ``below`` under it. ``piece`` is −1 where
    it is uncertain which of two pieces holds. ``slack`` is how much longer or shorter, as a share,
    a span of the host's time may be than what it is converted to.
    """

    pieces: tuple[Piece, ...]
    starts: Times
    above: Times
    below: Times
    piece: Times
    slack: Numbers
    ends: int  # the reference's time of the last bound

    def converted(self, times: Times) -> Times:
        """Return times of the host's clock as times of the reference; their order stays."""
        begins = np.array([piece.begins for piece in self.pieces[1:]], dtype=np.int64)
        place = np.searchsorted(begins, times, side="right")
        result = np.empty(len(times), dtype=np.int64)
        least = np.iinfo(np.int64).min
        for number, piece in enumerate(self.pieces):
            here = place == number
            inverse = _inverse(piece, times[here])
            result[here] = np.maximum(inverse, least)
            if number + 1 < len(self.pieces):
                last = np.array([self.pieces[number + 1].follows], dtype=np.int64)
                least = max(least, int(_inverse(piece, last)[0]))
        return result

    def errors(self, times: Times) -> tuple[Times, Times]:
        """Return how much earlier, and later, converted instants may truly have been (ns)."""
        cell = self.cell(times)
        outside = np.maximum(self.starts[0] - times, 0) + np.maximum(times - self.ends, 0)
        more = np.ceil(outside * self.slack[cell]).astype(np.int64)
        return self.above[cell] + more, self.below[cell] + more

    def cell(self, times: Times) -> npt.NDArray[np.intp]:
        """Return the number of the cell of each time of the reference."""
        place = np.searchsorted(self.starts, times, side="right") - 1
        return np.clip(place, 0, len(self.starts) - 1)


def _inverse(piece: Piece, times: Times) -> Times:
    """Return the reference's times at which a host's clock on the line of a piece shows these."""
    passed = times - (piece.origin + piece.offset)
    # passed / (1 + rate), but as a small correction: it is rounded to 1 ns over hours.
    correction = np.rint(passed * (piece.rate / (1 + piece.rate))).astype(np.int64)
    return np.asarray(piece.origin + passed - correction, dtype=np.int64)


def corridor(
    upper: OffsetBounds,
    lower: OffsetBounds,
    *,
    host_events: Times | None = None,
    reference_events: Times | None = None,
    wander: float = WANDER,
) -> Corridor:
    """Find the corridor of a host's offset between its upper and its lower bounds.

    The events, in order of time, are those of either host, by its own clock: they show when a clock
    jumped. Raises ContradictingClocksError: no offset fits for longer than a few messages.
    """
    bounds = _sorted_bounds(upper, lower)
    spans = _spans(bounds)
    if len(spans) > max(_MOST_PIECES, len(bounds.x) // _LEAST_PER_PIECE):
        raise ContradictingClocksError(
            f"no offset that changes by less than {MOST_RATE * 1e6:.0f} ppm fits more than"
            f" {len(bounds.x) / len(spans):.0f} messages in a row"
        )
    pieces = list[Piece]()
    cones = list[_Cone]()
    for number, span in enumerate(spans):
        piece, cone = _piece(bounds, span, wander)
        if number:
            piece = _after(
                bounds, (pieces[-1], cones[-1]), (piece, cone), host_events, reference_events
            )
        pieces.append(piece)
        cones.append(cone)
    return _in_cells(bounds, pieces, cones)


@dataclass(frozen=True)
class _Bounds:
    """All bounds in order of time, as numbers relative to the first time and the first offset."""

    x: Numbers
    value: Numbers
    is_upper: npt.NDArray[np.bool_]
    time: int
    offset: int


def _sorted_bounds(upper: OffsetBounds, lower: OffsetBounds) -> _Bounds:
    times = np.concatenate((upper.times, lower.times))
    offsets = np.concatenate((upper.offsets, lower.offsets))
    is_upper = np.arange(len(times)) < len(upper.times)
    order = np.argsort(times, kind="stable")
    times, offsets, is_upper = times[order], offsets[order], is_upper[order]
    time, offset = int(times[0]), int(offsets[0])
    x, value = (times - time).astype(np.float64), (offsets - offset).astype(np.float64)
    return _Bounds(x, value, is_upper, time, offset)


@dataclass(frozen=True)
class _Hulls:
    """Those of a set of bounds that can touch a line: the lower hull of the upper ones, …"""

    upper: tuple[Numbers, Numbers]
    lower: tuple[Numbers, Numbers]


def _hulls(bounds: _Bounds, since: int, until: int, more: _Hulls | None = None) -> _Hulls:
    """Return the hulls of the bounds with these numbers, and of those in ``more``."""
    x, value = bounds.x[since:until], bounds.value[since:until]
    is_upper = bounds.is_upper[since:until]
    sides = []
    for mask, sign, known in (
        (is_upper, 1.0, None if more is None else more.upper),
        (~is_upper, -1.0, None if more is None else more.lower),
    ):
        side_x, side_value = x[mask], value[mask]
        if known is not None:
            side_x = np.concatenate((known[0], side_x))
            side_value = np.concatenate((known[1], side_value))
            order = np.argsort(side_x, kind="stable")
            side_x, side_value = side_x[order], side_value[order]
        hull_x, hull_value = _lower_hull(side_x, sign * side_value)
        sides.append((hull_x, sign * hull_value))
    return _Hulls(*sides)


def _lower_hull(x: Numbers, value: Numbers) -> tuple[Numbers, Numbers]:
    """Return the vertices of the lower convex hull of points in order of ``x``.

    A point on or above the line between its neighbours is no vertex. All such go at once, again and
    again: for random points half of them in each turn.
    """
    if len(x) > 1 and not (x[1:] > x[:-1]).all():
        first = np.concatenate(([True], x[1:] > x[:-1]))
        groups = np.flatnonzero(first)
        x, value = x[groups], np.minimum.reduceat(value, groups)
    while len(x) > 2:
        share = (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
        below = value[1:-1] < value[:-2] + share * (value[2:] - value[:-2])
        if below.all():
            break
        keep = np.concatenate(([True], below, [True]))
        x, value = x[keep], value[keep]
    return x, value


def _gap(hulls: _Hulls, rates: Numbers) -> Numbers:
    """Return by how much lines of these rates may be moved up and down; negative: none fits."""
    (upper_x, upper), (lower_x, lower) = hulls.upper, hulls.lower
    highest = (upper[:, None] - upper_x[:, None] * rates).min(axis=0, initial=np.inf)
    lowest = (lower[:, None] - lower_x[:, None] * rates).max(axis=0, initial=-np.inf)
    return np.asarray(highest - lowest, dtype=np.float64)


def _fitting_rates(hulls: _Hulls) -> tuple[float, float] | None:
    """Return the lowest and the highest rate of all lines between the hulls; None: there is none.

    The gap is a concave function of the rate, of straight parts that meet at the rates of the
    hulls' edges: between these its zeros are interpolated exactly.
    """
    if not (len(hulls.upper[0]) and len(hulls.lower[0])):
        return -MOST_RATE, MOST_RATE
    edges = [np.diff(value) / np.diff(x) for x, value in (hulls.upper, hulls.lower)]
    rates = np.unique(
        np.clip(np.concatenate((*edges, [-MOST_RATE, MOST_RATE])), -MOST_RATE, MOST_RATE)
    )
    gap = _gap(hulls, rates) + _ROUNDED_NS
    best = int(np.argmax(gap))
    if gap[best] < 0:
        return None
    fits = np.flatnonzero(gap >= 0)
    low, high = int(fits[0]), int(fits[-1])
    lowest, highest = float(rates[low]), float(rates[high])
    if low:
        share = gap[low] / (gap[low] - gap[low - 1])
        lowest -= float(share * (rates[low] - rates[low - 1]))
    if high + 1 < len(rates):
        share = gap[high] / (gap[high] - gap[high + 1])
        highest += float(share * (rates[high + 1] - rates[high]))
    return lowest, highest


@dataclass(frozen=True)
class _Span:
    """Numbers of the bounds of a piece: from ``since`` on, those before ``until`` are its own."""

    since: int
    until: int  # from here on they may be of the next piece


def _spans(bounds: _Bounds) -> list[_Span]:
    """Divide the bounds into the fewest pieces, each of which a line fits."""
    count = len(bounds.x)
    firsts, hulls = [0], list[_Hulls]()
    while True:
        end, fitting = _longest(bounds, firsts[-1])
        hulls.append(fitting)
        if end >= count:
            break
        firsts.append(end)
    spans = list[_Span]()
    for place, first in enumerate(firsts):
        until = count
        if place + 1 < len(firsts):
            until = _earliest(bounds, first + 1, firsts[place + 1], hulls[place + 1])
        spans.append(_Span(first, until))
    return spans


def _longest(bounds: _Bounds, first: int) -> tuple[int, _Hulls]:
    """Return the end of the longest piece from a bound on that a line fits, and its hulls."""
    count = len(bounds.x)
    end, step = first, _FIRST_TRIED
    hulls = _hulls(bounds, first, first)
    while end < count:
        tried = min(end + step, count)
        longer = _hulls(bounds, end, tried, hulls)
        if _fitting_rates(longer) is not None:
            end, hulls, step = tried, longer, step * 2
        elif step == 1 or tried - end == 1:
            break
        else:
            step = max(1, (tried - end) // 2)
            while step >= 1 and end < count:  # the first that does not fit is not far
                tried = min(end + step, count)
                longer = _hulls(bounds, end, tried, hulls)
                if _fitting_rates(longer) is not None:
                    end, hulls = tried, longer
                if step == 1:
                    break
                step = (step + 1) // 2
            tried = min(end + 1, count)
            if end < count and _fitting_rates(_hulls(bounds, end, tried, hulls)) is None:
                break
            step = 1
    return end, hulls


def _earliest(bounds: _Bounds, least: int, first: int, hulls: _Hulls) -> int:
    """Return the first bound from which on all before ``first`` fit a piece with these hulls."""
    low, step = first, 1
    while low > least:
        tried = max(low - step, least)
        longer = _hulls(bounds, tried, low, hulls)
        if _fitting_rates(longer) is not None:
            low, hulls, step = tried, longer, step * 2
        elif low - tried == 1:
            break
        else:
            step = max(1, (low - tried) // 2)
    return low


@dataclass(frozen=True)
class _Cone:
    """The bounds of a piece, carried forwards and backwards in time at the rates allowed.

    ``x`` are the times of either side's bounds. Each array has, in place k, the tightest bound
    among the first k, or the last ones from k on, as its height at x = 0 at that rate.
    """

    rates: tuple[float, float]
    upper_x: Numbers
    upper_before: Numbers
    upper_after: Numbers
    lower_x: Numbers
    lower_before: Numbers
    lower_after: Numbers

    def highest(self, x: Numbers) -> Numbers:
        """Return the highest offset that is possible at these times."""
        low, high = self.rates
        before = np.searchsorted(self.upper_x, x, side="right")
        after = np.searchsorted(self.upper_x, x, side="left")
        forwards = self.upper_before[before] + high * x
        return np.minimum(forwards, self.upper_after[after] + low * x)

    def lowest(self, x: Numbers) -> Numbers:
        """Return the lowest offset that is possible at these times."""
        low, high = self.rates
        before = np.searchsorted(self.lower_x, x, side="right")
        after = np.searchsorted(self.lower_x, x, side="left")
        forwards = self.lower_before[before] + low * x
        return np.maximum(forwards, self.lower_after[after] + high * x)


def _cone(bounds: _Bounds, span: _Span, rates: tuple[float, float]) -> _Cone:
    low, high = rates
    x, value = bounds.x[span.since : span.until], bounds.value[span.since : span.until]
    is_upper = bounds.is_upper[span.since : span.until]
    upper_x, upper = x[is_upper], value[is_upper]
    lower_x, lower = x[~is_upper], value[~is_upper]
    return _Cone(
        rates=rates,
        upper_x=upper_x,
        upper_before=_running(upper - high * upper_x, np.inf),
        upper_after=_running((upper - low * upper_x)[::-1], np.inf)[::-1],
        lower_x=lower_x,
        lower_before=-_running(low * lower_x - lower, np.inf),
        lower_after=-_running((high * lower_x - lower)[::-1], np.inf)[::-1],
    )


def _running(values: Numbers, start: float) -> Numbers:
    """Return the least of the first k values, for each k from 0 on."""
    return np.minimum.accumulate(np.concatenate(([start], values)))


def _piece(bounds: _Bounds, span: _Span, wander: float) -> tuple[Piece, _Cone]:
    """Make a piece of its own bounds: the line in the middle of all that fit, and the cone."""
    hulls = _hulls(bounds, span.since, span.until)
    # It is a part of what a line fits; without it, rounding would be to blame.
    fitting = _fitting_rates(hulls) or (-MOST_RATE, MOST_RATE)
    rate = (fitting[0] + fitting[1]) / 2
    (upper_x, upper), (lower_x, lower) = hulls.upper, hulls.lower
    highest = (upper - rate * upper_x).min(initial=np.inf)
    lowest = (lower - rate * lower_x).max(initial=-np.inf)
    sides = [height for height in (highest, lowest) if np.isfinite(height)]
    origin = float(bounds.x[span.since])
    offset = float(np.mean(sides)) + rate * origin
    rates = (fitting[0] - wander, fitting[1] + wander)
    piece = Piece(
        since=bounds.time + int(bounds.x[span.since]),
        until=bounds.time + int(bounds.x[span.until - 1]),
        begins=np.iinfo(np.int64).min,
        follows=np.iinfo(np.int64).min,
        origin=bounds.time + int(origin),
        offset=bounds.offset + round(offset),
        rate=rate,
        rates=rates,
    )
    return piece, _cone(bounds, span, rates)


def _after(
    bounds: _Bounds,
    last: tuple[Piece, _Cone],
    this: tuple[Piece, _Cone],
    host_events: Times | None,
    reference_events: Times | None,
) -> Piece:
    """Return a piece with what is known of where it begins.

    If a clock that only changes its rate explains all bounds of both pieces, it did no more: the
    piece begins where both lines meet. Else it jumped. A clock that jumps forwards shows a gap in
    its own host's events; if that is the only gap so wide, no instant is converted by the wrong
    line; else some may be, and land a jump away.
    """
    (before, cone), (piece, own_cone) = last, this
    since, until = before.until, piece.since
    edges = np.array([since, until], dtype=np.int64)
    jumps = piece.line(edges) - before.line(edges)
    jump = int(jumps.mean())
    joint = _cone(bounds, _joint_span(bounds, before, piece), _joint(cone, own_cone))
    x = np.unique(np.concatenate((joint.upper_x, joint.lower_x)))
    if (joint.highest(x) + _ROUNDED_NS >= joint.lowest(x)).all():
        share = (
            float(np.clip(-jumps[0] / (jumps[1] - jumps[0]), 0, 1)) if jumps[0] != jumps[1] else 0.5
        )
        at = since + round(share * (until - since))
        begins = at + int(before.line(np.array([at], dtype=np.int64))[0])
        return replace(piece, begins=begins, follows=begins, is_step=False)
    if jump >= 0:
        first, final = since + int(before.line(edges)[0]), until + int(piece.line(edges)[1])
        gap = _gap_of(jump, host_events, first, final)
        if gap is None:
            return replace(piece, begins=final, follows=final, unsure=jump)
        return replace(piece, begins=gap[1], follows=gap[0])
    gap = _gap_of(-jump, reference_events, since, until)
    # What the host did before its partner's clock jumped is converted to before the gap.
    at = until if gap is None else gap[1]
    begins = at + int(piece.line(np.array([at], dtype=np.int64))[0])
    return replace(piece, begins=begins, follows=begins, unsure=-jump if gap is None else 0)


def _gap_of(jump: int, events: Times | None, first: int, last: int) -> tuple[int, int] | None:
    """Return the only gap between events as wide as a jump; None: it is not the only one."""
    if events is None:
        return None
    low, high = np.searchsorted(events, first), np.searchsorted(events, last, side="right")
    inside = events[max(int(low) - 1, 0) : int(high) + 1]  # where lines may be off by the corridor
    wide = np.flatnonzero(np.diff(inside) >= 0.99 * jump)
    if len(wide) != 1:
        return None
    return int(inside[wide[0]]), int(inside[wide[0] + 1])


def _in_cells(bounds: _Bounds, pieces: list[Piece], cones: list[_Cone]) -> Corridor:
    """Cut the corridor into cells, each as wide as it is at its widest."""
    parts = list[_Cells]()
    cells = max(8, _CELLS // len(pieces))
    begun = pieces[0].since
    for number, (piece, cone) in enumerate(zip(pieces, cones, strict=True)):
        if number + 1 == len(pieces):
            edges = _edges(begun, max(piece.until, begun + 1), cells)
            parts.append(_cells(bounds, [cone], [piece], edges, number))
            break
        following = pieces[number + 1]
        until = max(piece.until - following.unsure, begun + 1)
        parts.append(_cells(bounds, [cone], [piece], _edges(begun, until, cells), number))
        # What was converted by the wrong line, and what had to stay behind that, lies in here too.
        behind = following.unsure + following.unsure // 100 + _BEHIND_NS
        begun = max(following.since + behind, until + 1)
        if following.is_step:
            # By which line an instant was converted here, and which holds, is not known.
            both, edges = [cone, cones[number + 1]], _edges(until, begun, 1)
        else:
            joint = _cone(
                bounds, _joint_span(bounds, piece, following), _joint(cone, cones[number + 1])
            )
            both, edges = [joint], _edges(until, begun, cells)
        parts.append(_cells(bounds, both, [piece, following], edges, -1))
    return Corridor(
        pieces=tuple(pieces),
        starts=np.concatenate([part.starts for part in parts]),
        above=np.concatenate([part.above for part in parts]),
        below=np.concatenate([part.below for part in parts]),
        piece=np.concatenate([np.full(len(part.starts), part.piece) for part in parts]),
        slack=np.concatenate([np.full(len(part.starts), part.slack) for part in parts]),
        ends=bounds.time + int(bounds.x[-1]),
    )


@dataclass(frozen=True)
class _Cells:
    starts: Times
    above: Times
    below: Times
    piece: int
    slack: float


def _edges(first: int, last: int, cells: int) -> Times:
    return np.unique(np.linspace(first, last, cells + 1).astype(np.int64))


def _cells(
    bounds: _Bounds, cones: list[_Cone], lines: list[Piece], edges: Times, number: int
) -> _Cells:
    """Make cells between edges. Where there are two lines, the nearer to the bounds counts."""
    sides = [_widest(bounds, cone, line, edges) for cone in cones for line in lines]
    if len(cones) == 1 and len(lines) == 2:
        # Instants are converted by the first line until the second begins.
        turned = edges[:-1] + lines[0].line(edges[:-1]) >= lines[1].begins
        before, after = sides
        above, below = (np.where(turned, after[k], before[k]) for k in (0, 1))
        at = int(np.argmax(turned)) if turned.any() else len(turned)
        for place in {max(at - 1, 0), min(at, len(turned) - 1)}:
            above[place] = max(before[0][place], after[0][place])
            below[place] = max(before[1][place], after[1][place])
    else:
        above, below = (np.max([side[k] for side in sides], axis=0) for k in (0, 1))
    slack = max(
        max(cone.rates[1] - line.rate, line.rate - cone.rates[0])
        for cone in cones
        for line in lines
    )
    return _Cells(edges[:-1], above, below, number, slack)


def _joint(first: _Cone, second: _Cone) -> tuple[float, float]:
    """Return the rates of which either piece allows."""
    return min(first.rates[0], second.rates[0]), max(first.rates[1], second.rates[1])


def _joint_span(bounds: _Bounds, piece: Piece, following: Piece) -> "_Span":
    """Return the bounds of two pieces, and those between them."""
    since = int(np.searchsorted(bounds.x, piece.since - bounds.time))
    until = int(np.searchsorted(bounds.x, following.until - bounds.time, side="right"))
    return _Span(since, until)


def _widest(bounds: _Bounds, cone: _Cone, piece: Piece, edges: Times) -> tuple[Times, Times]:
    """Return how far, at most, the corridor reaches over and under a line between the edges.

    Between two times at which it is known it rises and falls no faster than the rates allow.
    """
    x = np.unique(np.concatenate((edges - bounds.time, cone.upper_x, cone.lower_x)))
    first, last = edges[0] - bounds.time, edges[-1] - bounds.time
    x = x[(x >= first) & (x <= last)]
    line = (piece.line(x.astype(np.int64) + bounds.time) - bounds.offset).astype(np.float64)
    steepest = max(abs(cone.rates[1] - piece.rate), abs(cone.rates[0] - piece.rate))
    between = np.diff(x) * steepest
    cell = np.searchsorted(x, (edges - bounds.time)[:-1].astype(np.float64))
    sides = []
    for height in (cone.highest(x) - line, line - cone.lowest(x)):
        peaks = (height[1:] + height[:-1] + between) / 2
        most = np.maximum(np.maximum(height[1:], height[:-1]), peaks)
        known = np.where(np.isfinite(most), most, float(1 << 60))
        widest = np.maximum.reduceat(known, cell)
        sides.append(np.ceil(np.maximum(widest, 0) + _ROUNDED_NS).astype(np.int64))
    return sides[0], sides[1]


def steps(found: Corridor) -> Iterator[tuple[int, int, int]]:
    """Yield where the offset jumped: between which times of the reference, and by how much (ns)."""
    for before, after in pairwise(found.pieces):
        if after.is_step:
            edges = np.array([before.until, after.since], dtype=np.int64)
            jump = int((after.line(edges) - before.line(edges)).mean())
            yield before.until, after.since, jump
