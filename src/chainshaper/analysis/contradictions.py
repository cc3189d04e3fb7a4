"""Contradictions between a recording's events: all of them are looked for here.

* **A message was taken before it was published**: a clock, or an event, is wrong. No plan can be
  made from it.
* **The wall clock was moved** while messages were recognised by its time alone: messages are
  followed with the clock as it was then, and those that are not certain are left out.
* **A callback ran, but no event shows a take of its message**: messages are followed if
  publications and callbacks determine each other; else no plan can be made from them.
* **A timer's callback starts at another period than declared**: the period that its starts show
  counts; if they are not regular, no plan can be made.
* **A callback spans its executor's next take, or its search for work**: its end is left out; if
  only the search for work contradicts it, no plan can be made. Where no event was lost, the
  callback spins an executor itself, and keeps its end.
* **A callback ran inside itself in one thread**: the outer instances have no end. No plan can be
  made, unless events were lost, which looks the same.
* **Events lie behind the end of their packet**: the decoder drops them, and a note of the recording
  says so.

Each contradiction has a note that says where, how often and when. All that build on callbacks call
:func:`refuse_contradicted` first: a callback whose events contradict each other is no evidence.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.lost_ends import LostEnds
from chainshaper.analysis.matching import first_after, latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.analysis.periods import ShownPeriod, shown_periods
from chainshaper.analysis.unseen_takes import UnseenTakes
from chainshaper.analysis.wall_clock import StampedMessages
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, trigger_text
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError


@dataclass(frozen=True)
class Contradiction:
    """A contradiction in a recording's events."""

    callbacks: frozenset[int]  # the ids of those that it is about
    note: str  # in plain words
    refused: bool  # whether no plan can be made from these callbacks
    period_ns: int | None = None  # that a timer's starts show instead of the declared period


def contradictions(
    *,
    tables: events.EventTables,
    objects: Objects,
    instances: pl.DataFrame,
    published: pl.DataFrame,
    taken: pl.DataFrame,
    ends: LostEnds,
    unseen: tuple[UnseenTakes, ...],
    stamped: StampedMessages | None,
) -> tuple[Contradiction, ...]:
    """Find all contradictions in a recording whose events have been resolved."""
    nodes = objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    periods = tuple(map(_of_another_period, shown_periods(nodes, instances, taken)))
    nodes = with_shown_periods(nodes, periods)
    return (
        *_moved_clock(stamped),
        *_before_their_publication(taken, published),
        *(_without_takes(subscription) for subscription in unseen),
        *periods,
        *_longer_than_they_ran(nodes, ends),
        *_inside_themselves(tables, nodes, ends),
    )


def refuse_contradicted(
    contradictions: Collection[Contradiction], callbacks: Collection[int], recording: object
) -> None:
    """Refuse to build on callbacks whose events contradict each other.

    Raises InputError: a contradiction about one of ``callbacks``.
    """
    concerned = set(callbacks)
    for contradiction in contradictions:
        if contradiction.refused and concerned & contradiction.callbacks:
            raise InputError(f"{recording}: nothing can be planned from it, {contradiction.note}")


def with_shown_periods(
    callbacks: pl.DataFrame, contradictions: Iterable[Contradiction]
) -> pl.DataFrame:
    """Set ``period_ns`` of timers whose starts show another period than the declared one."""
    shown = {
        callback: contradiction.period_ns
        for contradiction in contradictions
        for callback in contradiction.callbacks
        if contradiction.period_ns is not None
    }
    period = pl.col("callback_id").replace_strict(shown, default=None, return_dtype=pl.Int64)
    return callbacks.with_columns(period_ns=pl.coalesce(period, "period_ns"))


def clock_text(time_ns: int) -> str:
    """Text for an instant of the trace's clock: ``at 3600.101000 s of the trace's clock``."""
    return f"at {time_ns / 1e9:.6f} s of the trace's clock"


def _moved_clock(stamped: StampedMessages | None) -> Iterator[Contradiction]:
    """Yield a moved wall clock, where messages are recognised by its time alone."""
    if stamped is None or not stamped.moves:
        return
    first, total = stamped.moves[0], sum(move.by_ns for move in stamped.moves)
    moved = f"by {first.by_ns / 1e6:+.3f} ms {clock_text(first.time_ns)}"
    if len(stamped.moves) > 1:
        moved += f", and {len(stamped.moves) - 1} times more, by {total / 1e6:+.3f} ms in all"
    count, uncertain = stamped.frame.height, stamped.frame["publication"].null_count()
    followed = f"all {count} could be followed, with the clock as it was then"
    if uncertain:
        followed = (
            f"of {uncertain} among {count} the publication is not certain, and they are left out"
        )
    yield Contradiction(
        frozenset(),
        f"the wall clock was moved while this was recorded, {moved}; before Jazzy messages are"
        f" recognised by its time: {followed}.",
        refused=False,
    )


def _before_their_publication(
    taken: pl.DataFrame, published: pl.DataFrame
) -> Iterator[Contradiction]:
    """Messages were taken before they were published."""
    sent = published["time"].gather(taken["publication"])
    if not (early := taken.filter(taken["time"] < sent)).height:
        return
    sent = published["time"].gather(early["publication"])
    writers = published["callback_id"].gather(early["publication"])
    early = early.with_columns(by=sent - early["time"], writer=writers)
    for (node, topic), rows in early.group_by("node", "topic", maintain_order=True):
        worst, first = rows.select(pl.col("by").max(), pl.col("time").min()).row(0)
        yield Contradiction(
            frozenset({*rows["callback_id"].drop_nulls(), *rows["writer"].drop_nulls()}),
            f"{node} took messages on {topic} up to {duration_text(worst)} before they were"
            f" published ({rows.height} of them, the first {clock_text(first)} in thread"
            f" {rows['tid'][0]}): the clocks of publisher and subscriber are not the same (two"
            " machines?), or events are wrong; record both with one clock.",
            refused=True,
        )


def _without_takes(subscription: UnseenTakes) -> Contradiction:
    """Report a callback that ran although no event shows a take of its message."""
    first = f"the first {clock_text(subscription.first_ns)} in thread {subscription.tid}"
    problem = (
        f"the callback of {subscription.node} for {subscription.topic} ran without any event of a"
        f" take (instances: {subscription.runs}, {first}; loaned messages have no such events, nor"
        " have Foxy and plain Galactic)"
    )
    if subscription.linked:
        problem += (
            f": of {subscription.linked} it is certain which publication they got, by their times"
        )
        if subscription.linked < subscription.runs:
            problem += ", the others are left out"
        return Contradiction(frozenset({subscription.callback_id}), f"{problem}.", refused=False)
    reason = f"{subscription.publishers} publishers write the topic"
    if subscription.publishers == 1:
        reason = "publications and callbacks do not alternate"
    elif not subscription.publishers:
        reason = "no publication of the topic was recorded"
    return Contradiction(
        frozenset({subscription.callback_id}),
        f"{problem}: which message it got cannot be known, since {reason}. Record without loaned"
        " messages (ROS_DISABLE_LOANED_MESSAGES=1), or on a distribution that traces takes.",
        refused=True,
    )


def _of_another_period(timer: ShownPeriod) -> Contradiction:
    """Report a timer whose callback starts at another period than declared."""
    declared = duration_text(timer.declared_ns)
    declared_only = (
        f"the timer of {timer.node} was created with a period of {declared}, but its callback"
    )
    when = f" ({timer.starts} starts, the first {clock_text(timer.first_ns)})"
    if timer.period_ns is not None:
        shown = duration_text(timer.period_ns)
        note = f"{declared_only} starts every {shown}{when}: {shown} counts as its period."
        return Contradiction(frozenset({timer.callback_id}), note, False, timer.period_ns)
    usual = duration_text(round(timer.usual_ns, -3))
    note = (
        f"{declared_only} starts more often, mostly {usual} apart but not regularly{when}: its"
        " period is not known; record it while the period stays the same."
    )
    return Contradiction(frozenset({timer.callback_id}), note, refused=True)


def _longer_than_they_ran(nodes: pl.DataFrame, ends: LostEnds) -> Iterator[Contradiction]:
    """Report callbacks that span their executor's next take, or its search for work."""
    lost = "their ends and the starts after them were lost, so they have no end"
    if ends.complete:
        doubt = "it spins an executor itself now and then, or losses were not counted; they count"
        doubt += " with all that time"
    else:
        doubt = f"{lost} here, or it spins an executor itself now and then, and they are longer:"
        doubt += " record again without losses"
    proofs = (
        (ends.by_take, "took the next message for it, or executed it again", lost, False),
        (ends.by_wait, "looked for other work, or did some", doubt, not ends.complete),
    )
    for numbers, proof, consequence, refused in proofs:
        rows = ends.instances.filter(pl.col("instance").is_in(numbers.implode()))
        for number, about, where in _by_callback(rows, nodes):
            note = f"{about} seems to last on although its thread {proof} ({where}): {consequence}."
            yield Contradiction(frozenset({number}), note, refused)


def _inside_themselves(
    tables: events.EventTables, nodes: pl.DataFrame, ends: LostEnds
) -> Iterator[Contradiction]:
    """Callbacks ran inside themselves in one thread.

    An instance has no end, the same callback starts again on the thread, and there is an event of
    an end that belongs to no other start.
    """
    thread, key = ["pid", "tid"], ["pid", "tid", "callback_id"]
    instances = ends.instances
    if not instances["end"].null_count():
        return
    unended = instances.filter(pl.col("end").is_null() & ~pl.col("assumed"))
    numbers = unended["callback_id"].unique().implode()
    following = instances.filter(pl.col("callback_id").is_in(numbers)).select(*key, after="start")
    rows = first_after(unended, following, key, "start", "after", strictly=True)
    rows = rows.drop_nulls("after")
    if rows.is_empty():
        return
    handles = nodes.select("callback_id", callback="handle")
    closed = instances.select(*thread, "callback_id", time="end").drop_nulls("time")
    closed = closed.join(handles, on="callback_id").select(*thread, "callback", "time")
    unmatched = events.table(tables, "callback_end").select("time", *thread, "callback")
    unmatched = unmatched.join(
        closed, on=[*thread, "callback", "time"], how="anti", maintain_order="left"
    )
    opened = rows.join(handles, on="callback_id", maintain_order="left")
    opened = opened.select(*thread, "callback", "instance", "after", opened="start")
    ended_inside = latest_before(unmatched, opened, [*thread, "callback"], "time", "opened")
    ended_inside = ended_inside.filter(pl.col("time") > pl.col("after"))
    rows = instances.filter(
        pl.col("instance").is_in(ended_inside["instance"].drop_nulls().implode())
    )
    for number, about, where in _by_callback(rows, nodes):
        consequence = "how long the outer ones took cannot be known"
        if not ends.complete:
            consequence += "; or the end of each, and the start of a later one, were lost"
        note = f"{about} ran inside itself in one thread ({where}): {consequence}."
        yield Contradiction(frozenset({number}), note, refused=ends.complete)


def _by_callback(rows: pl.DataFrame, nodes: pl.DataFrame) -> Iterator[tuple[int, str, str]]:
    """Count the rows of each callback; callbacks that every node has are left out.

    Yield the callback's id, its name in words, and how many rows there are and when the first was.
    """
    about = nodes.select("callback_id", "node", "kind", "topic", "period_ns", "declared_ns")
    for (number,), of_callback in rows.sort("start").group_by("callback_id", maintain_order=True):
        _, node, kind, topic, period, declared = about.filter(callback_id=number).row(0)
        if topic in INTERNAL_TOPICS:
            continue
        trigger = trigger_text(topic and f"for {topic}", period, declared)
        first, tid = of_callback.select("start", "tid").row(0)
        where = f"instances: {of_callback.height}, the first {clock_text(first)} in thread {tid}"
        yield int(str(number)), f"the {kind} callback of {node} {trigger}", where
