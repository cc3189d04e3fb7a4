"""Which publication a source timestamp is of, where publications carry none (before Jazzy).

Events have the monotonic clock, timestamps the wall clock, which is moved: stepped (NTP, a person,
a receiver of satellites), or slewed for a while. The distance of the two clocks is known at one
instant only. So messages are followed in the order in which they were taken, with the distance that
the last ones had. A message fits a publication that leads to nearly the same distance again; where
none does, either the clock was moved, or the publication's events were lost. Both are kept in mind
until later messages tell: a moved clock stays moved. What is certain besides:

* a message is published before it is taken, and once;
* a publisher's messages are taken in the order in which they were published;
* a publisher stamps a message before it publishes the next one.

Explanations are compared by how unlikely they are: with the logarithm of how far the distance is
off, so that one step costs less than many small misfits, and a fixed price for each step and each
message without a publication. Of explanations that are nearly as likely as the best one, messages
that they explain differently are left out.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import polars as pl

_CLOCKS_AGREE_NS = 2_000  # so exactly the distance of two clocks can be known
_FINE_NS = 20_000  # between its event and its stamp a message is on its way for about so long
_NEAR_NS = 200_000  # and for so long rarely
_SLEW = 0.1  # of the time that passed: chrony moves a clock so fast at most, adjtime far slower
_MOST_SLEWED_NS = 20_000_000
_SLOW = 0.005  # of the time that passed: a slower slew needs no forecast
_MOST = 8.0  # the price of a misfit, however large
_STEP, _SLEWED, _MISSING, _IN_FLIGHT = 4.0, 1.0, 7.0, 1.0  # prices: logarithms of how unlikely
_LOOK_BACK = 16  # messages, of which hardly all were held up on their way
_HOPELESS = 12.0  # an explanation that is so much less likely is given up
_ALIKE = 1.0  # so little less likely is as good
_SAME_NS = 50_000  # explanations with distances so close go on alike
_CANDIDATES, _EXPLANATIONS = 32, 24
_SAID_NS = 1_000_000  # a clock that was moved by less needs no note

_Path: TypeAlias = "tuple[_Path | None, int, int | None, int] | None"
"""The explanation so far, this message, its publication, the clocks' distance by it."""


@dataclass(frozen=True)
class ClockMove:
    """The wall clock was moved ``by_ns`` just before the publication at ``time_ns``."""

    time_ns: int
    by_ns: int


@dataclass(frozen=True)
class StampedMessages:
    """``frame`` has ``topic, source_timestamp, publication`` (null: not known) of each message;
    ``moves`` are the wall clock's."""

    frame: pl.DataFrame
    moves: tuple[ClockMove, ...]


@dataclass(frozen=True)
class _Topic:
    """A topic's publications in order of time: when, their numbers, and their publishers."""

    times: Sequence[int]
    numbers: Sequence[int]
    publishers: Sequence[int]


class _Message(NamedTuple):
    """A message: its place in the order in which messages were taken, its stamp, and when it was
    first taken."""

    number: int
    stamp: int
    took: int


@dataclass(slots=True)
class _Explanation:
    """What happened so far: its price, the distance of the clocks by now, and before their last
    step, which lies before the publication at ``stepped``; each publisher's latest place; by which
    share of time the clock is slewed, if fast; which messages may as well have been others.

    Of ``passed`` messages since the last look back none had its stamp less than ``low`` late.
    """

    price: float
    distance: int
    path: _Path = None
    stamp: int | None = None
    before: int | None = None
    stepped: int = 0
    latest: dict[int, int] = field(default_factory=dict)
    rate: float = 0.0
    unsure: frozenset[int] = frozenset()
    low: int = _NEAR_NS
    passed: int = 0


def messages_of_stamps(
    taken: pl.DataFrame, published: pl.DataFrame, clock_offset_ns: int
) -> StampedMessages:
    """Find the publication of each message in ``taken`` (``topic, source_timestamp, time``).

    ``published`` are publications without timestamps (``topic, publication, publisher, time``, in
    order of time), ``clock_offset_ns`` is the distance of the clocks when the recording began.
    """
    messages = taken.group_by("topic", "source_timestamp").agg(pl.col("time").min())
    messages = messages.sort("time", "source_timestamp")
    topics = {
        str(topic): _Topic(*(rows[name].to_list() for name in ("time", "publication", "publisher")))
        for (topic,), rows in published.group_by("topic", maintain_order=True)
    }
    known = [_Explanation(0.0, clock_offset_ns)]
    topic_of = messages["topic"].cast(pl.String).to_list()
    times = zip(topic_of, messages["source_timestamp"], messages["time"], strict=True)
    for number, (topic, stamp, took) in enumerate(times):
        message = _Message(number, stamp, took)
        if topic in topics:
            known = _explained(known, message, topics[topic])
    best = known[0]
    unsure = best.unsure
    for rival in known[1:]:
        if rival.price <= best.price + _ALIKE:
            unsure |= _differing(best.path, rival.path)
    found: list[int | None] = [None] * messages.height
    steps: list[tuple[int, int]] = []
    path = best.path
    while path is not None:
        path, number, place, distance = path
        if place is not None and number not in unsure:
            about = topics[topic_of[number]]
            found[number] = about.numbers[place]
            steps.append((about.times[place], distance))
    frame = messages.select(
        "topic", "source_timestamp", publication=pl.Series(found, dtype=pl.UInt32)
    )
    return StampedMessages(frame, tuple(_moves(sorted(steps), clock_offset_ns)))


def _explained(known: list[_Explanation], message: _Message, topic: _Topic) -> list[_Explanation]:
    """The explanations of all messages up to this one, the most likely first."""
    if len(known) == 1 and _goes_on(known[0], message, topic):
        return known
    following: list[_Explanation] = []
    for one in known:
        following += _continued(one, message, topic)
    following.sort(key=lambda one: one.price)
    kept: list[_Explanation] = []
    for one in following:
        if one.price > following[0].price + _HOPELESS or len(kept) == _EXPLANATIONS:
            break
        alike = next((k for k in kept if abs(k.distance - one.distance) <= _SAME_NS), None)
        if alike is None:
            kept.append(one)
        elif one.price <= alike.price + _ALIKE:
            alike.unsure |= one.unsure | _differing(alike.path, one.path)
    return kept


def _price(misfit: int) -> float:
    """Of a stamp that comes so much behind its event; it never comes before it by one clock."""
    scale = _FINE_NS if misfit >= 0 or misfit < -_NEAR_NS else _CLOCKS_AGREE_NS
    return math.log1p(abs(misfit) / scale)


def _goes_on(one: _Explanation, message: _Message, topic: _Topic) -> bool:
    """Whether the only explanation so far has an obvious publication for the message: take it."""
    number, stamp, took = message
    if one.rate:
        return False
    expected = bisect_right(topic.times, stamp - one.distance + _CLOCKS_AGREE_NS) - 1
    for place in (expected, expected + 1):
        if not 0 <= place < len(topic.times) or topic.times[place] > took:
            continue
        misfit = stamp - topic.times[place] - one.distance
        publisher = topic.publishers[place]
        if abs(misfit) > _NEAR_NS or one.latest.get(publisher, -1) >= place:
            continue
        one.price += _price(misfit)
        if misfit < -_CLOCKS_AGREE_NS:  # the clock was slowed down
            one.distance += misfit
        one.latest[publisher] = place
        one.path, one.stamp = (one.path, number, place, one.distance), stamp
        _look_back(one, misfit)
        return True
    return False


def _look_back(one: _Explanation, misfit: int) -> None:
    """Follow a clock that was sped up: then all messages seem to be stamped late."""
    one.low, one.passed = min(one.low, misfit), one.passed + 1
    if one.passed == _LOOK_BACK:
        if one.low > _FINE_NS:
            one.distance += one.low
        one.low, one.passed = _NEAR_NS, 0


def _continued(one: _Explanation, message: _Message, topic: _Topic) -> Iterator[_Explanation]:
    """An explanation with all that a message may be: one of the publications before it was taken,
    or one whose events were lost."""
    number, stamp, took = message
    last = bisect_right(topic.times, took)
    passed = 0 if one.stamp is None else abs(stamp - one.stamp)
    slack = _NEAR_NS + min(round(_SLEW * passed), _MOST_SLEWED_NS)
    now = one.distance + round(one.rate * passed)  # the clocks' distance, as it goes on
    expected = bisect_right(topic.times, stamp - now + _CLOCKS_AGREE_NS) - 1
    places = {*range(max(0, last - _CANDIDATES), last)}
    places |= {place for place in (expected, expected + 1) if 0 <= place < last}
    written_later = set[int]()
    for place in sorted(places, reverse=True):
        publisher, sent = topic.publishers[place], topic.times[place]
        if one.latest.get(publisher, -1) >= place:
            continue
        misfit = stamp - sent - now
        price, moved = min(_price(misfit), _MOST), now + misfit
        latest = {**one.latest, publisher: place}

        def with_(
            more: float, distance: int, place: int = place, latest: dict[int, int] = latest
        ) -> _Explanation:
            path = (one.path, number, place, distance)
            return replace(
                one, price=one.price + more, distance=distance, path=path, stamp=stamp,
                latest=latest,
            )  # fmt: skip

        if misfit >= -_CLOCKS_AGREE_NS and publisher not in written_later:
            written_later.add(publisher)  # it stamps a message before it publishes the next
            yield with_(price, now)
        if one.before is not None and sent < one.stepped:
            of_before = stamp - sent - one.before
            if -_CLOCKS_AGREE_NS <= of_before <= _NEAR_NS:
                found = with_(_IN_FLIGHT + _price(of_before), one.before)
                yield replace(found, distance=now)
        if abs(misfit) <= _NEAR_NS:
            if misfit < -_CLOCKS_AGREE_NS or one.rate:
                yield with_(
                    min(price, math.log1p(abs(misfit) / _FINE_NS)) if one.rate else price, moved
                )
        elif abs(misfit) <= slack:
            rate = (moved - one.distance) / max(passed, 1)
            rate = rate if abs(rate) > _SLOW else 0.0
            yield replace(with_(price + _SLEWED, moved), rate=rate)
        else:
            found = with_(price + _STEP, moved)
            yield replace(found, before=now, stepped=sent, rate=0.0)
    path = (one.path, number, None, one.distance)
    yield replace(one, price=one.price + _MISSING, path=path, latest=dict(one.latest))


def _differing(first: _Path, second: _Path) -> set[int]:
    """The messages that two explanations give different publications, back to where they part."""
    found: set[int] = set()
    while first is not second:
        if first is None or second is None:
            break
        if first[2] != second[2]:
            found.add(first[1])
        first, second = first[0], second[0]
    return found


def _moves(distances: list[tuple[int, int]], begun: int) -> Iterator[ClockMove]:
    """Where the distance of the clocks is another than when the last note was due."""
    for time, distance in distances:
        if abs(distance - begun) > _SAID_NS:
            yield ClockMove(time, distance - begun)
            begun = distance
