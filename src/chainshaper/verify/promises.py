"""What became of the outputs that were due, and whether a plan's promise about them was kept.

A plan promises that of the outputs that are due a share at most comes later than its slot. One that
never comes is not in time either, whatever the reason: discarded, lost on the way, never published,
or its chain did not begin. So all of them count; what is judged elsewhere (in comparisons, sweeps,
watches and budgets) is judged by this.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl

from chainshaper.analysis import LatencyAnalysis, LatencyStatistics
from chainshaper.planning import Plan

STANDARD_ERRORS = 3  # beyond so many, a figure is not what was predicted
NOT_PUBLISHED, NOT_BEGUN = "not published", "not begun"


@dataclass(frozen=True)
class OutputsDue:
    """How many outputs were ``due``, and what became of them.

    ``late`` came behind the slot or cycle they were due in (None: nothing says when they were),
    ``absent`` never came, by reason. ``usual`` of the absent ones were not published by the
    application, as often as in the recording that was planned from. ``promised`` is the share that
    the plan says may be missed, at most (None: no plan was in force).
    """

    due: int
    late: int | None
    absent: Mapping[str, int] = field(default_factory=dict)
    usual: int = 0
    promised: float | None = None

    @classmethod
    def of(cls, statistics: LatencyStatistics, promised: float | None = None) -> "OutputsDue":
        """What statistics alone say of it, which have no reasons."""
        gone = statistics.incomplete
        absent = {"that never came": gone} if gone else {}
        return cls(statistics.count + gone, statistics.late, absent, promised=promised)

    @property
    def missed(self) -> int:
        """Outputs that were late or never came, but for the usual ones."""
        return (self.late or 0) + sum(self.absent.values()) - self.usual

    @property
    def share(self) -> float | None:
        """The share of outputs that were missed; None where none was due."""
        return self.missed / self.due if self.due else None

    @property
    def most_missed(self) -> int | None:
        """So many may be missed as promised, as far as chance goes."""
        if self.promised is None:
            return None
        return _by_chance(self.due, self.promised)

    @property
    def kept(self) -> bool | None:
        """Whether the promise was kept; None: there was none, or nothing was due."""
        if self.most_missed is None or not self.due:
            return None
        return self.missed <= self.most_missed

    @property
    def text(self) -> str:
        """``875 of 1000 outputs missed (875 discarded)``, ``0 of 320 outputs late``."""
        absent = {reason: count for reason, count in self.absent.items() if count}
        if not absent:
            return f"{self.late or 0} of {self.due} outputs late"
        parts = [f"{self.late} late"] if self.late else []
        parts += [f"{count} {reason}" for reason, count in absent.items()]
        usual = f", {self.usual} of these as before the plan" if self.usual else ""
        return f"{self.missed} of {self.due} outputs missed ({', '.join(parts)}{usual})"


def _by_chance(count: int, share: float) -> int:
    """How many of so many may be hit where this share is, as far as chance goes."""
    mean = count * share
    return math.floor(mean + STANDARD_ERRORS * math.sqrt(mean))


def outputs_due(analysis: LatencyAnalysis, plan: Plan | None = None) -> OutputsDue:
    """What became of the outputs of a chain that were due, under a plan if one was in force."""
    return _counted(analysis.traversals, analysis.not_begun, plan)


def undisturbed_outputs_due(analysis: LatencyAnalysis) -> OutputsDue:
    """The same without the cycles that the machine disturbed."""
    return _counted(analysis.traversals.filter(~pl.col("disturbed")), analysis.not_begun, None)


def _counted(traversals: pl.DataFrame, not_begun: int, plan: Plan | None) -> OutputsDue:
    due = traversals.filter("was_due")
    gone = due.filter(~pl.col("complete"))
    absent = Counter[str](gone["reason"].cast(pl.String)) if gone.height else Counter[str]()
    if not_begun:
        absent[NOT_BEGUN] = not_begun
    known = due["late"].count() or not due.filter("complete").height
    count, usual, promised = due.height + not_begun, 0, None
    if plan is not None:
        promised = plan.margin.overrun_probability or 0.0
        evidence = plan.evidence
        planned_from = evidence.samples + evidence.disturbed + evidence.incomplete
        if evidence.unpublished:
            as_often = _by_chance(count, evidence.unpublished / planned_from)
            usual = min(absent[NOT_PUBLISHED], as_often)
    return OutputsDue(
        due=count,
        late=int(due["late"].sum() or 0) if known else None,
        absent=dict(absent),
        usual=usual,
        promised=promised,
    )
