"""Where a recording's events contradict each other: the one place that looks for it.

* **A message was taken before it was published**: a clock, or an event, is wrong. A plan from it is
  refused.
* **The wall clock was moved** while messages were recognised by its time alone: they are followed
  with the clock as it was then, and those that are not certain are left out.
* **A callback ran, but no event tells of its takes**: it is followed where publication and callback
  determine each other; where not, a plan is refused.
* **A timer's callback starts at another period than declared**: the period that its starts show
  counts; where they are not regular, a plan is refused.
* **A callback spans its executor's next take, or its search for work**: its end is left out; where
  only the search for work says so, a plan is refused. Where no event was lost, it spins an executor
  itself.
* **A callback ran inside itself in one thread**: the outer instances have no end. A plan is
  refused, but where events were lost, which looks alike.
* **Events lie behind the end of their packet**: the decoder drops them, and the recording's own
  notes say so.

Each has a note, which says where, how often and when. A callback whose own events are at odds is no
evidence to plan from: :func:`refuse_contradicted` is asked by all that build on it.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.lost_ends import LostEnds
from chainshaper.analysis.matching import first_after, latest_before
from chainshaper.analysis.objects import Objects
from chainshaper.analysis.periods import OtherPeriod, other_periods
from chainshaper.analysis.unseen_takes import UnseenTakes
from chainshaper.analysis.wall_clock import StampedMessages
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, trigger_text
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError


@dataclass(frozen=True)
class Contradiction:
    """One contradiction in a recording's events.

    ``callbacks`` are the ids of those that it is about, ``note`` says it in plain words,
    ``refused`` that nothing can be planned from them. ``period_ns`` is the period that a timer's
    starts show instead of the declared one.
    """

    callbacks: frozenset[int]
    note: str
    refused: bool
    period_ns: int | None = None


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
    """All contradictions in a recording whose events have been resolved."""
    nodes = objects.callbacks.unique("callback_id", keep="first", maintain_order=True)
    periods = tuple(map(_of_another_period, other_periods(nodes, instances, taken)))
    nodes = with_shown_periods(nodes, periods)
    return (
        *_moved_clock(stamped),
        *_before_their_publication(taken, published),
        *(_without_takes(one) for one in unseen),
        *periods,
        *_longer_than_they_ran(nodes, ends),
        *_inside_themselves(tables, nodes, ends),
    )


def refuse_contradicted(
    found: Collection[Contradiction], callbacks: Collection[int], recording: object
) -> None:
    """Raises InputError: what is to be built on ``callbacks`` contradicts itself."""
    concerned = set(callbacks)
    for one in found:
        if one.refused and concerned & one.callbacks:
            raise InputError(f"{recording}: nothing can be planned from it, {one.note}")


def with_shown_periods(callbacks: pl.DataFrame, found: Iterable[Contradiction]) -> pl.DataFrame:
    """The frame of callbacks, with the period that a timer's starts show as its ``period_ns``,
    where that differs from the declared one."""
    shown = {
        callback: contradiction.period_ns
        for contradiction in found
        for callback in contradiction.callbacks
        if contradiction.period_ns is not None
    }
    period = pl.col("callback_id").replace_strict(shown, default=None, return_dtype=pl.Int64)
    return callbacks.with_columns(period_ns=pl.coalesce(period, "period_ns"))


def clock_text(time_ns: int) -> str:
    """When something happened, as the trace's clock shows it: ``at 3600.101 s``."""
    return f"at {time_ns / 1e9:.6f} s of the trace's clock"


def _moved_clock(stamped: StampedMessages | None) -> Iterator[Contradiction]:
    if stamped is None or not stamped.moves:
        return
    first, total = stamped.moves[0], sum(one.by_ns for one in stamped.moves)
    said = f"by {first.by_ns / 1e6:+.3f} ms {clock_text(first.time_ns)}"
    if len(stamped.moves) > 1:
        said += f", and {len(stamped.moves) - 1} times more, by {total / 1e6:+.3f} ms in all"
    count, untold = stamped.frame.height, stamped.frame["publication"].null_count()
    left = f"all {count} could be followed, with the clock as it was then"
    if untold:
        left = f"of {untold} among {count} the publication is not certain, and they are left out"
    yield Contradiction(
        frozenset(),
        f"the wall clock was moved while this was recorded, {said}; before Jazzy messages are"
        f" recognised by its time: {left}.",
        refused=False,
    )


def _before_their_publication(
    taken: pl.DataFrame, published: pl.DataFrame
) -> Iterator[Contradiction]:
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


def _without_takes(one: UnseenTakes) -> Contradiction:
    said = (
        f"the callback of {one.node} for {one.topic} ran without any event of a take (instances:"
        f" {one.runs}, the first {clock_text(one.first_ns)} in thread {one.tid}; loaned messages"
        " have no such events, nor have Foxy and plain Galactic)"
    )
    if one.linked:
        said += f": of {one.linked} it is certain which publication they got, by their times"
        if one.linked < one.runs:
            said += ", the others are left out"
        return Contradiction(frozenset({one.callback_id}), f"{said}.", refused=False)
    why = f"{one.publishers} publishers write the topic"
    if one.publishers == 1:
        why = "publications and callbacks do not alternate"
    elif not one.publishers:
        why = "no publication of the topic was recorded"
    return Contradiction(
        frozenset({one.callback_id}),
        f"{said}: which message it got cannot be known, since {why}. Record without loaned messages"
        " (ROS_DISABLE_LOANED_MESSAGES=1), or on a distribution that traces takes.",
        refused=True,
    )


def _of_another_period(one: OtherPeriod) -> Contradiction:
    declared = duration_text(one.declared_ns)
    said = f"the timer of {one.node} was created with a period of {declared}, but its callback"
    when = f" ({one.starts} starts, the first {clock_text(one.first_ns)})"
    if one.period_ns is not None:
        shown = duration_text(one.period_ns)
        note = f"{said} starts every {shown}{when}: {shown} counts as its period."
        return Contradiction(frozenset({one.callback_id}), note, False, one.period_ns)
    usual = duration_text(round(one.usual_ns, -3))
    note = (
        f"{said} starts more often, mostly {usual} apart but not regularly{when}: its period is not"
        " known; record it while the period stays the same."
    )
    return Contradiction(frozenset({one.callback_id}), note, refused=True)


def _longer_than_they_ran(nodes: pl.DataFrame, ends: LostEnds) -> Iterator[Contradiction]:
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
    for numbers, proof, said, refused in proofs:
        rows = ends.instances.filter(pl.col("instance").is_in(numbers.implode()))
        for number, about, where in _by_callback(rows, nodes):
            note = f"{about} seems to last on although its thread {proof} ({where}): {said}."
            yield Contradiction(frozenset({number}), note, refused)


def _inside_themselves(
    tables: events.EventTables, nodes: pl.DataFrame, ends: LostEnds
) -> Iterator[Contradiction]:
    """Instances without an end in which the same callback ran on the same thread, as an end of it
    that belongs to no other start tells."""
    thread, key = ["pid", "tid"], ["pid", "tid", "callback_id"]
    instances = ends.instances
    if not instances["end"].null_count():
        return
    open_ones = instances.filter(pl.col("end").is_null() & ~pl.col("assumed"))
    numbers = open_ones["callback_id"].unique().implode()
    following = instances.filter(pl.col("callback_id").is_in(numbers)).select(*key, after="start")
    rows = first_after(open_ones, following, key, "start", "after", strictly=True)
    rows = rows.drop_nulls("after")
    if rows.is_empty():
        return
    handles = nodes.select("callback_id", callback="handle")
    closed = instances.select(*thread, "callback_id", time="end").drop_nulls("time")
    closed = closed.join(handles, on="callback_id").select(*thread, "callback", "time")
    spare = events.table(tables, "callback_end").select("time", *thread, "callback")
    spare = spare.join(closed, on=[*thread, "callback", "time"], how="anti", maintain_order="left")
    opened = rows.join(handles, on="callback_id", maintain_order="left")
    opened = opened.select(*thread, "callback", "instance", "after", opened="start")
    hit = latest_before(spare, opened, [*thread, "callback"], "time", "opened")
    hit = hit.filter(pl.col("time") > pl.col("after"))
    rows = instances.filter(pl.col("instance").is_in(hit["instance"].drop_nulls().implode()))
    for number, about, where in _by_callback(rows, nodes):
        said = "how long the outer ones took cannot be known"
        if not ends.complete:
            said += "; or the end of each, and the start of a later one, were lost"
        note = f"{about} ran inside itself in one thread ({where}): {said}."
        yield Contradiction(frozenset({number}), note, refused=ends.complete)


def _by_callback(rows: pl.DataFrame, nodes: pl.DataFrame) -> Iterator[tuple[int, str, str]]:
    """Callback, what it is in words, and how many rows of it there are, and where the first one
    is; not of what every node has for itself."""
    about = nodes.select("callback_id", "node", "kind", "topic", "period_ns", "declared_ns")
    for (number,), own in rows.sort("start").group_by("callback_id", maintain_order=True):
        _, node, kind, topic, period, declared = about.filter(callback_id=number).row(0)
        if topic in INTERNAL_TOPICS:
            continue
        trigger = trigger_text(topic and f"for {topic}", period, declared)
        first, tid = own.select("start", "tid").row(0)
        where = f"instances: {own.height}, the first {clock_text(first)} in thread {tid}"
        yield int(str(number)), f"the {kind} callback of {node} {trigger}", where
