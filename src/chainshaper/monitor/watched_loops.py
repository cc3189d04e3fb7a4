"""Loops of an application that is watched: how they keep their rate, and why one does not.

A loop **misses its rate** when an instance of it

* woke up late, by more than a tenth of its period;
* overran: it ended when the next one should have begun;
* began more than one and a half periods behind the one before;
* does not come any more.

Who ran on its core meanwhile is told from two sides. Callbacks and loops of the watched processes
have events, with instants and cores. Of all other threads the kernel counts how long they ran
(:mod:`~chainshaper.linux.core_use`): within the second or so between two looks, not at which
instants. If the loop's thread did not wait for a core either, the kernel itself, an interrupt, or
the machine held it up, or it waited for something else.
"""

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from chainshaper.analysis import DataFlow
from chainshaper.analysis.loop_rates import LoopRate, loop_instances, loop_rates, of_rate
from chainshaper.analysis.periods import REGULAR
from chainshaper.linux.core_use import CoreUse, Used, strangers_are_hidden
from chainshaper.values import events
from chainshaper.values.durations import duration_text

SECOND = 1_000_000_000
MINUTE = 60 * SECOND
_SKIPPED = 1.5  # periods between two starts from which on one was left out
_AT_MOST = 3  # others on its core are named


@dataclass(frozen=True)
class Miss:
    """An instance of a loop that missed its rate."""

    loop: str
    since_ns: int  # what held it up was there between these two instants (CLOCK_MONOTONIC)
    until_ns: int
    text: str  # when, by how much, and who ran on its core


@dataclass(frozen=True)
class LoopNow:
    """How a loop keeps its rate."""

    loop: str
    rate: LoopRate  # over the last minute
    misses: int  # over the last minute
    problem: str | None  # why there is nothing to show


@dataclass(frozen=True)
class _Missed:
    """An instance that missed the rate, before it is known why. Times are in ns."""

    by_ns: int
    how: str
    since_ns: int
    until_ns: int
    row: dict[str, int | None]


class WatchedLoops:
    """The loops of the last minute, and who ran when one of them missed its rate."""

    def __init__(self) -> None:
        self._cores = CoreUse()
        self._looked_ns = 0
        self._instances: deque[tuple[int, pl.DataFrame]] = deque()
        self._misses: deque[tuple[int, str]] = deque()
        self._known: dict[tuple[str, tuple[str, ...]], LoopRate] = {}
        self._said_ns: dict[str, int] = {}

    def look_at_cores(self, now_ns: int) -> None:
        """Read who ran since the last time, once a second where there are loops."""
        if self._known and now_ns - self._looked_ns >= SECOND:
            self._looked_ns = now_ns
            self._cores.look()

    def take(
        self, flow: DataFlow, since_ns: int, over_ns: int, offset_ns: int, running: Collection[int]
    ) -> list[Miss]:
        """Add the instances that began between two instants; return misses that are to be said.

        ``offset_ns`` is CLOCK_REALTIME less CLOCK_MONOTONIC, ``running`` are the processes' ids. Of
        a loop that goes on missing its rate, the worst miss is said once a minute.
        """
        seen = loop_instances(flow)
        new = seen.filter(pl.col("start").is_between(since_ns, over_ns, "right"))
        self._instances.append((over_ns, new))
        for timed in (self._instances, self._misses):
            while timed and timed[0][0] < over_ns - MINUTE:
                timed.popleft()
        rates = self._rates()
        for rate in rates:
            self._know(rate)
        to_say = []
        for rate in self._known.values():
            missed = list(_missed(of_rate(seen, rate), rate, since_ns, over_ns, running))
            self._misses += [(over_ns, rate.label)] * len(missed)
            if missed and over_ns - self._said_ns.get(rate.label, -MINUTE) >= MINUTE:
                self._said_ns[rate.label] = over_ns
                worst = max(missed, key=lambda miss: miss.by_ns)
                to_say.append(self._explained(rate, worst, len(missed), flow, offset_ns))
        return to_say

    def now(self) -> tuple[LoopNow, ...]:
        """Return how each loop that was seen kept its rate over the last minute."""
        minute = self._rates()
        shown = []
        for rate in self._known.values():
            now = next((each for each in minute if _is_same(each, rate)), None)
            problem = None if now else "no instance in the last minute"
            if now and now.period_ns is None and now.apart_ns is not None:
                problem = now.irregular
            misses = sum(label == rate.label for _, label in self._misses)
            stopped = LoopRate(rate.node, rate.publishes, rate.tids, 0, None, None, None)
            shown.append(LoopNow(rate.label, now or stopped, misses, problem))
        return tuple(shown)

    def _rates(self) -> list[LoopRate]:
        frames = [frame for _, frame in self._instances if frame.height]
        return loop_rates(pl.concat(frames)) if frames else []

    def _know(self, rate: LoopRate) -> None:
        """Take a loop among those that are known; its topics may have become more."""
        for key, known in list(self._known.items()):
            if _is_same(known, rate):
                del self._known[key]
                if rate.period_ns is None:  # few instances: the period of before counts
                    rate = _with_period(rate, known.period_ns)
        self._known[rate.node, rate.publishes] = rate

    def _explained(
        self, rate: LoopRate, missed: _Missed, count: int, flow: DataFlow, offset_ns: int
    ) -> Miss:
        """Say when a loop missed its rate, and who ran on its core then."""
        at = datetime.fromtimestamp((missed.since_ns + offset_ns) / SECOND).astimezone()
        more = f", the worst of {count} such instances" if count > 1 else ""
        period = f"its {duration_text(rate.period_ns)}" if rate.period_ns else "its rate"
        who = "; ".join(self._who(missed, flow))
        text = (
            f"the {rate.label} missed {period} at {at:%H:%M:%S}.{at.microsecond // 1000:03d}"
            f"{more}: {missed.how}; {who}"
        )
        return Miss(rate.label, missed.since_ns, missed.until_ns, text)

    def _who(self, missed: _Missed, flow: DataFlow) -> Iterator[str]:
        """Yield sentences about who ran on a loop's core."""
        core, tid = missed.row["cpu"], missed.row["tid"]
        if core is None:
            yield "on which core it runs, no event says"
            return
        watched = ", ".join(
            f"{name} for {duration_text(lasted)}"
            for name, lasted in _beside(flow, core, tid, missed.since_ns, missed.until_ns)
        )
        if watched:
            yield f"under way on its core {core} then: {watched}"
        lasted, used = self._cores.between(missed.since_ns, missed.until_ns)
        if not lasted:
            yield f"who else ran on core {core} is not known: it was not looked at yet"
            return
        around = f"in the {duration_text(round(lasted, -8))} around it"
        others = [each for each in used.values() if each.core == core and each.tid != tid]
        others.sort(key=lambda each: -each.ran_ns)
        names = ", ".join(map(_used_text, others[:_AT_MOST])) or "no other thread"
        hidden = " (those of other users are hidden, hidepid)" if strangers_are_hidden() else ""
        yield f"{around} ran on core {core}: {names}{hidden}"
        own = used.get(tid or 0)
        if own is not None:
            yield _waited_text(own, missed.by_ns)


def _with_period(rate: LoopRate, period_ns: int | None) -> LoopRate:
    figures = (rate.start_jitter_ns, rate.overruns)
    return LoopRate(rate.node, rate.publishes, rate.tids, rate.count, period_ns, *figures)


def _is_same(first: LoopRate, second: LoopRate) -> bool:
    """Return whether both are the same loop: of one node, with a topic in common, or none."""
    topics = {*first.publishes}, {*second.publishes}
    return first.node == second.node and bool(topics[0] & topics[1] or topics[0] == topics[1])


def _missed(
    instances: pl.DataFrame, rate: LoopRate, since_ns: int, over_ns: int, running: Collection[int]
) -> Iterator[_Missed]:
    """Yield the instances of a loop, begun between two instants, that missed its period.

    And one more, if none comes any more although its process still runs.
    """
    period = rate.period_ns
    if period is None:
        return
    rows = instances.with_columns(
        last_start=pl.col("start").shift(1).over("pid", "tid"),
        late=pl.col("start") - pl.col("due"),
    )
    new = rows.filter(pl.col("start").is_between(since_ns, over_ns, "right"))
    for row in new.iter_rows(named=True):
        start, end, late, last = row["start"], row["end"], row["late"], row["last_start"]
        if late is not None and late > REGULAR * period:
            how = f"it woke up {duration_text(late)} late"
            yield _Missed(late, how, row["due"], start, row)
        elif row["overran"]:
            computed = row["execution_ns"]
            how = f"its instance took {duration_text(end - start)}"
            if computed is not None:
                how += f", of which it computed for {duration_text(computed)}"
            yield _Missed(end - start, how, start, end, row)
        elif last is not None and start - last > _SKIPPED * period:
            how = f"it began {duration_text(start - last)} behind the instance before"
            yield _Missed(start - last - period, how, last + period, start, row)
    if instances.height:
        newest = instances.row(-1, named=True)
        silent = over_ns - newest["start"]
        if silent > max(_SKIPPED * period, SECOND) and newest["pid"] in running:
            how = f"no instance has begun for {duration_text(round(silent, -6))}"
            yield _Missed(silent, how, newest["start"] + period, over_ns, newest)


def _beside(
    flow: DataFlow, core: int, tid: int | None, since_ns: int, until_ns: int
) -> list[tuple[str, int]]:
    """Return what was under way on a core between two instants, and for how long (ns).

    It is of watched processes; on other threads than ``tid``, the longest first.
    """
    names = ("callback_start", "thread_wake")
    began = pl.concat(
        events.table(flow.events, name, ["cpu"]).select("pid", "tid", "cpu", start="time")
        for name in names
    ).unique(["pid", "tid", "start"], keep="first")
    callbacks = flow.objects.callbacks.unique("callback_id", keep="first")
    callbacks = callbacks.select("callback_id", node=pl.col("node").cast(pl.String), kind="kind")
    over = pl.coalesce("end", pl.lit(until_ns))
    rows = flow.instances.filter(
        pl.col("start") < until_ns, over > since_ns, pl.col("tid") != (tid or 0)
    )
    rows = rows.join(began, on=["pid", "tid", "start"]).filter(cpu=core)
    rows = rows.join(callbacks, on="callback_id").with_columns(
        inside=pl.min_horizontal(over, pl.lit(until_ns))
        - pl.max_horizontal("start", pl.lit(since_ns))
    )
    longest = rows.group_by("node", "kind").agg(pl.col("inside").sum())
    longest = longest.sort("inside", "node", descending=[True, False]).head(_AT_MOST)
    return [
        (f"a {kind} of {node or 'a node without a name'}", lasted)
        for node, kind, lasted in longest.iter_rows()
    ]


def _used_text(used: Used) -> str:
    return f"{used.name} (thread {used.tid}) for {duration_text(round(used.ran_ns, -5))}"


def _waited_text(own: Used, by_ns: int) -> str:
    """Say whether the loop's thread waited for its core as long as it was late."""
    waited = f"its thread waited for a core for {duration_text(round(own.waited_ns, -4))} then"
    if own.waited_ns >= by_ns / 2:
        return f"{waited}: another thread had it"
    return (
        f"{waited}, so no thread took its core for all that time: it waited for something else, or"
        " the kernel, an interrupt or the machine itself held it up"
    )
