"""Find the publication of each source timestamp, where publications have none (before Jazzy).

Events have the monotonic clock. Source timestamps have the wall clock, which may be moved: stepped
(by NTP, a person, a satellite receiver), or slewed for a while. The distance of the two clocks is
known at one instant only. So messages are followed in the order in which they were taken, with the
distance that the last ones had. A message fits a publication that gives nearly the same distance
again. If none does, either the clock was moved or the publication's events were lost. Both
explanations are continued until later messages decide: a moved clock stays moved. Also certain is:

* a message is published before it is taken, and once;
* a publisher's messages are taken in the order in which they were published;
* a publisher stamps a message before it publishes the next one.

Each explanation has a price, the logarithm of how unlikely it is: one for how far each message is
off the distance, so that one step costs less than many small misfits, and a fixed one for each step
and each message without a publication. The cheapest explanation counts. Messages that an almost
equally cheap explanation gives another publication are left out.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import polars as pl

# The time from a publication's event to its stamp.
_CLOCKS_AGREE_NS = 2_000  # how exactly the distance of two clocks can be known
_FINE_NS = 20_000  # usual
_NEAR_NS = 200_000  # rarely more

# How the wall clock moves.
_SLEW = 0.1  # share of the time that passed: as fast as chrony slews; adjtime is far slower
_MOST_SLEWED_NS = 20_000_000  # between two messages
_SLOW = 0.005  # share of the time that passed: a slower slew needs no forecast
_LOOK_BACK = 16  # messages: if all are stamped late, the clock was sped up
_NOTED_NS = 1_000_000  # a clock that was moved by less needs no note

# Prices: logarithms of how unlikely something is.
_MOST = 8.0  # of a misfit, however large
_STEP = 4.0  # of a step of the clock
_SLEWED = 1.0  # of a clock that begins to be slewed
_MISSING = 7.0  # of a publication whose events were lost
_IN_FLIGHT = 1.0  # of a message that was stamped before a step and taken after it

# Which explanations are followed.
_HOPELESS = 12.0  # an explanation that costs so much more than the cheapest is given up
_ALIKE = 1.0  # an explanation that costs at most so much more is as good
_SAME_NS = 50_000  # of explanations whose distances differ by less the cheapest is followed
_CANDIDATES = 32  # publications that are tried for a message, the latest before its take
_EXPLANATIONS = 24  # at most

_Path: TypeAlias = "tuple[_Path | None, int, int | None, int] | None"
"""The path until the message before, this message's number, the place of its publication in its
topic (None: its events were lost), and the distance of the clocks (ns)."""


@dataclass(frozen=True)
class ClockMove:
    """The wall clock was moved ``by_ns`` just before the publication at ``time_ns``."""

    time_ns: int
    by_ns: int


@dataclass(frozen=True)
class StampedMessages:
    """The publications of messages that have only a source timestamp."""

    frame: pl.DataFrame  # `topic, source_timestamp, publication` (null: not known), a row a message
    moves: tuple[ClockMove, ...]  # of the wall clock


@dataclass(frozen=True)
class _Topic:
    """A topic's publications in order of time."""

    times: Sequence[int]  # ns of the event clock
    numbers: Sequence[int]  # of the publications in the data flow
    publishers: Sequence[int]


class _Message(NamedTuple):
    """A message that was taken."""

    number: int  # its place in the order in which messages were taken
    stamp: int  # ns of the wall clock
    took: int  # when it was first taken, ns of the event clock


@dataclass(slots=True)
class _Explanation:
    """An explanation of all messages so far. Times are in ns."""

    price: float  # of all that it assumes
    distance: int  # of the clocks by now: wall clock less event clock
    path: _Path = None  # the publication of each message
    stamp: int | None = None  # of the last message
    before: int | None = None  # distance of the clocks before the last step; None: there was none
    stepped: int = 0  # that step lies before the publication at this instant
    latest: dict[int, int] = field(default_factory=dict)  # publisher → place of its last message
    rate: float = 0.0  # share of time by which the clock is slewed, if fast
    unsure: frozenset[int] = frozenset()  # messages that may be of another publication
    low: int = _NEAR_NS  # the smallest delay of a stamp since the last look back
    passed: int = 0  # messages since the last look back


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
    explanations = [_Explanation(0.0, clock_offset_ns)]
    topic_of = messages["topic"].cast(pl.String).to_list()
    times = zip(topic_of, messages["source_timestamp"], messages["time"], strict=True)
    for number, (topic, stamp, took) in enumerate(times):
        message = _Message(number, stamp, took)
        if topic in topics:
            explanations = _explained(explanations, message, topics[topic])
    best = explanations[0]
    unsure = best.unsure
    for rival in explanations[1:]:
        if rival.price <= best.price + _ALIKE:
            unsure |= _differing(best.path, rival.path)
    publication_of: list[int | None] = [None] * messages.height
    steps: list[tuple[int, int]] = []
    path = best.path
    while path is not None:
        path, number, place, distance = path
        if place is not None and number not in unsure:
            of_topic = topics[topic_of[number]]
            publication_of[number] = of_topic.numbers[place]
            steps.append((of_topic.times[place], distance))
    frame = messages.select(
        "topic", "source_timestamp", publication=pl.Series(publication_of, dtype=pl.UInt32)
    )
    return StampedMessages(frame, tuple(_moves(sorted(steps), clock_offset_ns)))


def _explained(
    explanations: list[_Explanation], message: _Message, topic: _Topic
) -> list[_Explanation]:
    """Continue the explanations with a message; return them with the most likely first."""
    if len(explanations) == 1 and _goes_on(explanations[0], message, topic):
        return explanations
    following: list[_Explanation] = []
    for explanation in explanations:
        following += _continued(explanation, message, topic)
    following.sort(key=lambda explanation: explanation.price)
    shortlist: list[_Explanation] = []
    for explanation in following:
        if explanation.price > following[0].price + _HOPELESS or len(shortlist) == _EXPLANATIONS:
            break
        same = next(
            (
                likelier
                for likelier in shortlist
                if abs(likelier.distance - explanation.distance) <= _SAME_NS
            ),
            None,
        )
        if same is None:
            shortlist.append(explanation)
        elif explanation.price <= same.price + _ALIKE:
            same.unsure |= explanation.unsure | _differing(same.path, explanation.path)
    return shortlist


def _price(misfit: int) -> float:
    """Return the price of assuming that a stamp lies ``misfit`` ns behind its event.

    A stamp is never made before the event: a small negative misfit is expensive.
    """
    scale = _FINE_NS if misfit >= 0 or misfit < -_NEAR_NS else _CLOCKS_AGREE_NS
    return math.log1p(abs(misfit) / scale)


def _goes_on(explanation: _Explanation, message: _Message, topic: _Topic) -> bool:
    """Continue the only explanation with the obvious publication; return whether there is one."""
    number, stamp, took = message
    if explanation.rate:
        return False
    expected = bisect_right(topic.times, stamp - explanation.distance + _CLOCKS_AGREE_NS) - 1
    for place in (expected, expected + 1):
        if not 0 <= place < len(topic.times) or topic.times[place] > took:
            continue
        misfit = stamp - topic.times[place] - explanation.distance
        publisher = topic.publishers[place]
        if abs(misfit) > _NEAR_NS or explanation.latest.get(publisher, -1) >= place:
            continue
        explanation.price += _price(misfit)
        if misfit < -_CLOCKS_AGREE_NS:  # the clock was slowed down
            explanation.distance += misfit
        explanation.latest[publisher] = place
        explanation.path = (explanation.path, number, place, explanation.distance)
        explanation.stamp = stamp
        _look_back(explanation, misfit)
        return True
    return False


def _look_back(explanation: _Explanation, misfit: int) -> None:
    """Follow a clock that was sped up: all of the last messages were stamped late."""
    explanation.low, explanation.passed = min(explanation.low, misfit), explanation.passed + 1
    if explanation.passed == _LOOK_BACK:
        if explanation.low > _FINE_NS:
            explanation.distance += explanation.low
        explanation.low, explanation.passed = _NEAR_NS, 0


def _continued(
    explanation: _Explanation, message: _Message, topic: _Topic
) -> Iterator[_Explanation]:
    """Continue an explanation with all publications that the message may be of.

    These are the last ones before it was taken, and one whose events were lost.
    """
    number, stamp, took = message
    last = bisect_right(topic.times, took)
    passed = 0 if explanation.stamp is None else abs(stamp - explanation.stamp)
    slack = _NEAR_NS + min(round(_SLEW * passed), _MOST_SLEWED_NS)
    # The distance of the clocks by now, if the clock goes on as it did.
    now = explanation.distance + round(explanation.rate * passed)
    expected = bisect_right(topic.times, stamp - now + _CLOCKS_AGREE_NS) - 1
    places = {*range(max(0, last - _CANDIDATES), last)}
    places |= {place for place in (expected, expected + 1) if 0 <= place < last}
    written_later = set[int]()
    for place in sorted(places, reverse=True):
        publisher, sent = topic.publishers[place], topic.times[place]
        if explanation.latest.get(publisher, -1) >= place:
            continue
        misfit = stamp - sent - now
        price, moved = min(_price(misfit), _MOST), now + misfit
        latest = {**explanation.latest, publisher: place}

        def continued(
            more: float, distance: int, place: int = place, latest: dict[int, int] = latest
        ) -> _Explanation:
            path = (explanation.path, number, place, distance)
            return replace(
                explanation,
                price=explanation.price + more,
                distance=distance,
                path=path,
                stamp=stamp,
                latest=latest,
            )

        if misfit >= -_CLOCKS_AGREE_NS and publisher not in written_later:
            written_later.add(publisher)  # it stamps a message before it publishes the next
            yield continued(price, now)
        if explanation.before is not None and sent < explanation.stepped:
            of_before = stamp - sent - explanation.before
            if -_CLOCKS_AGREE_NS <= of_before <= _NEAR_NS:
                explained = continued(_IN_FLIGHT + _price(of_before), explanation.before)
                yield replace(explained, distance=now)
        if abs(misfit) <= _NEAR_NS:
            if explanation.rate:
                yield continued(min(price, math.log1p(abs(misfit) / _FINE_NS)), moved)
            elif misfit < -_CLOCKS_AGREE_NS:
                yield continued(price, moved)
        elif abs(misfit) <= slack:
            rate = (moved - explanation.distance) / max(passed, 1)
            rate = rate if abs(rate) > _SLOW else 0.0
            yield replace(continued(price + _SLEWED, moved), rate=rate)
        else:
            explained = continued(price + _STEP, moved)
            yield replace(explained, before=now, stepped=sent, rate=0.0)
    path = (explanation.path, number, None, explanation.distance)
    yield replace(
        explanation, price=explanation.price + _MISSING, path=path, latest=dict(explanation.latest)
    )


def _differing(first: _Path, second: _Path) -> set[int]:
    """Find the messages that two explanations give different publications."""
    differing: set[int] = set()
    while first is not second:
        if first is None or second is None:
            break
        if first[2] != second[2]:
            differing.add(first[1])
        first, second = first[0], second[0]
    return differing


def _moves(distances: list[tuple[int, int]], begun: int) -> Iterator[ClockMove]:
    """Find where the distance of the clocks has changed since the last move that was noted."""
    for time, distance in distances:
        if abs(distance - begun) > _NOTED_NS:
            yield ClockMove(time, distance - begun)
            begun = distance
