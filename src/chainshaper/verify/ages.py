"""What a plan promises of the age of a loop's data, beside what was measured.

A plan states how old the data of the loop that reads the output are, at their first use and in all
of the loop's cycles (:class:`~chainshaper.planning.chain_plan.PlannedLoop`). That holds for 99 % of
the loop's starts and for 99.5 % of the deliveries, so a share of the cycles may be elsewhere. All
others count, whatever disturbed them. A cycle of which events do not tell the message
(:mod:`~chainshaper.analysis.data_age`) breaks nothing by its age, and is counted aside.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis.data_age import DataAge
from chainshaper.analysis.statistics import LatencyStatistics, latency_statistics
from chainshaper.planning.chain_plan import PlannedLoop
from chainshaper.values import events
from chainshaper.values.durations import milliseconds
from chainshaper.values.event_declarations import LOOP_MOVES
from chainshaper.verify.promises import most_by_chance

ELSEWHERE = 0.015  # the share of cycles whose age may be elsewhere: 1 % of starts, 0.5 % delivered


@dataclass(frozen=True)
class JudgedAge:
    """The age of a loop's data (ns), from the beginning of the chain's cycle, beside the promise.

    * ``chain``: through the loop, as the recording has it.
    * ``loop``: its node.
    * ``first``, ``every``: at the first use of a message, and in all cycles of the loop.
    * ``promised_first_ns``, ``promised_every_ns``: lowest and highest age.
    * ``promised_jitter_ns``: of the first use; None: a plan that is not in step promises none.
    * ``outside``: in how many cycles the age was outside of what is promised.
    * ``ambiguous``: in how many cycles events do not tell which message was used; None: not known.
    * ``never_used``: how many messages no cycle used although the plan promises a use.
    * ``before``: how many cycles were before the two had been brought into step; they do not count.
    """

    chain: str
    loop: str
    first: LatencyStatistics
    every: LatencyStatistics
    promised_first_ns: tuple[int, int]
    promised_every_ns: tuple[int, int]
    promised_jitter_ns: int | None
    outside: int
    ambiguous: int | None
    never_used: int
    before: int

    @property
    def kept(self) -> bool | None:
        """Whether the promise was kept; None: no cycle used a message."""
        return None if not self.first.count else not self.broken

    @property
    def broken(self) -> tuple[str, ...]:
        """What was not kept, a part of a sentence each."""
        if not self.first.count:
            return ()
        reasons = []
        if self.outside > most_by_chance(self.every.count, ELSEWHERE):
            reasons.append(
                f"the age of {self.loop}'s data is outside of what is promised in {self.outside} of"
                f" {self.every.count} cycles ({self._ages})"
            )
        messages = self.first.count + self.never_used
        if self.never_used > most_by_chance(messages, ELSEWHERE):
            reasons.append(f"{self.never_used} of {messages} messages were never used")
        jitter_ns, most_ns = self.first.spread_ns, self.promised_jitter_ns
        if jitter_ns is not None and most_ns is not None and jitter_ns > most_ns:
            reasons.append(
                f"the age at the first use spreads over {milliseconds(jitter_ns)} ms,"
                f" {milliseconds(most_ns)} ms are promised"
            )
        return tuple(reasons)

    @property
    def text(self) -> str:
        """What was measured, beside the promise, in a part of a sentence."""
        if not self.first.count:
            return f"no cycle of the loop of {self.loop} used a message of {self.chain}"
        return (
            f"age of {self.loop}'s data {self._ages};"
            f" outside: {self.outside} of {self.every.count} cycles{self._aside}"
        )

    @property
    def _ages(self) -> str:
        ages = (self.first.min_ns, self.first.max_ns)
        every = (self.every.min_ns, self.every.max_ns)
        return (
            f"at the first use {_range(ages)} ms, promised {_range(self.promised_first_ns)};"
            f" in all cycles {_range(every)} ms, promised {_range(self.promised_every_ns)}"
        )

    @property
    def _aside(self) -> str:
        parts = []
        if self.ambiguous:
            parts.append(f"{self.ambiguous} ambiguous")
        if self.ambiguous is None:
            parts.append("how many are ambiguous is not known")
        if self.never_used:
            parts.append(f"{self.never_used} messages never used")
        if self.before:
            parts.append(f"{self.before} before they were in step")
        return f" ({', '.join(parts)})" if parts else ""


def _range(ages_ns: tuple[int | None, int | None]) -> str:
    return " to ".join("-" if ns is None else milliseconds(ns) for ns in ages_ns)


def judge_age(chain: str, loop: PlannedLoop, age: DataAge, tables: events.EventTables) -> JudgedAge:
    """Judge the age of a loop's data in a recording, of whose events ``tables`` has the moves."""
    promised = loop.age_at_any_phase or loop.age
    since = _in_step_since(loop, tables)
    cycles = age.cycles.filter(pl.col("start") >= since)
    used = cycles.drop_nulls("traversal")
    first = used.filter(use=1)
    is_first, at = pl.col("use") == 1, pl.col("age_at_loop_ns")
    outside = ~at.is_between(*promised.every_ns) | (is_first & ~at.is_between(*promised.first_ns))
    certain = ~pl.col("ambiguous").fill_null(False)
    known = cycles["ambiguous"].drop_nulls()
    messages = age.messages.filter(pl.col("stored") >= since)
    never = messages.join(age.cycles, on="traversal", how="anti").height
    jitter_ns = None
    if loop.in_step is not None and promised.constant and len(first) > 1:
        lasted = int(first["start"][-1]) - int(first["start"][0])
        follows = loop.in_step == "output"  # its age changes as the clocks of the two drift apart
        drifts = abs(loop.drift_ppm) * 1e-6 * lasted if follows else 0.0
        jitter_ns = loop.age.first_ns[1] - loop.age.first_ns[0] + round(drifts)
    return JudgedAge(
        chain=chain,
        loop=loop.node,
        first=latency_statistics(first["age_at_loop_ns"].to_numpy()),
        every=latency_statistics(used["age_at_loop_ns"].to_numpy()),
        promised_first_ns=promised.first_ns,
        promised_every_ns=promised.every_ns,
        promised_jitter_ns=jitter_ns,
        outside=used.filter(outside & certain).height,
        ambiguous=int(known.sum()) if len(known) or cycles.is_empty() else None,
        never_used=never if promised.uses[0] else 0,
        before=age.cycles.height - cycles.height,
    )


def _in_step_since(loop: PlannedLoop, tables: events.EventTables) -> int:
    """Return from when on both were in step (ns): when the first of the two was moved first.

    Where nothing was moved they have been from the beginning on.
    """
    if loop.in_step == "loop":
        moved = events.table(tables, "loop_moved")
        over = [LOOP_MOVES.index("over")]
        times = moved.filter((pl.col("added") != 0) & ~pl.col("why").is_in(over))["time"]
    elif loop.in_step == "output" and "gate_release" in tables:
        gated = events.table(tables, "gate_release", ["moved"])
        times = gated.filter(pl.col("moved").fill_null(0) != 0)["time"]
    else:
        return 0
    return int(times.min() or 0)  # type: ignore[arg-type]
