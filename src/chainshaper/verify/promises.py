"""What became of the outputs that were due, and whether a plan's promise about them was kept.

A plan promises that at most a certain share of the outputs that are due misses its slot
(:func:`~chainshaper.planning.margins.allowed_late_share`). An output
that never comes is not in time either, for whatever reason: it was discarded, lost on the way or
never published, or its chain did not begin. So all of these count. Comparisons, sweeps, watches and
budgets all judge by this module.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl

from chainshaper.analysis import LatencyAnalysis
from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import Evidence
from chainshaper.planning.margins import allowed_late_share

STANDARD_ERRORS = 3  # a figure that is off by more is not what was predicted
NOT_PUBLISHED, NOT_BEGUN, NEVER_CAME = "not published", "not begun", "never came"


@dataclass(frozen=True)
class OutputsDue:
    """How many outputs were due, and what became of them."""

    due: int  # number of outputs
    late: int | None  # number of those behind their slot or cycle; None: it is not known
    absent: Mapping[str, int] = field(default_factory=dict)  # number that never came, by reason
    usual: int = 0
    """Number of absent ones that the application did not publish, as in the recording from which
    the plan was made."""
    promised: float | None = None  # the share that may be missed; None: no plan was in force

    @classmethod
    def of(
        cls, count: int, late: int | None, incomplete: int, plan: ChainPlan | None = None
    ) -> "OutputsDue":
        """Make it of numbers: ``count`` outputs came, ``incomplete`` never, for unknown reasons."""
        absent, due, usual = {NEVER_CAME: incomplete} if incomplete else {}, count + incomplete, 0
        if plan is not None:
            usual = _usual(plan.evidence, plan.evidence.incomplete, due, incomplete)
        return cls(
            due, late, absent, usual, None if plan is None else allowed_late_share(plan.margin)
        )

    @property
    def missed(self) -> int:
        """Number of outputs that were late or never came, without the usual ones."""
        return (self.late or 0) + sum(self.absent.values()) - self.usual

    @property
    def share(self) -> float | None:
        """The share of outputs that were missed; None where none was due."""
        return self.missed / self.due if self.due else None

    @property
    def most_missed(self) -> int | None:
        """How many may be missed under the promise, with room for chance; None: no promise."""
        if self.promised is None:
            return None
        return most_by_chance(self.due, self.promised)

    @property
    def kept(self) -> bool | None:
        """Whether the promise was kept; None: there was none, or nothing was due."""
        if self.most_missed is None or not self.due:
            return None
        return self.missed <= self.most_missed

    @property
    def text(self) -> str:
        """``875 of 1000 outputs missed (875 discarded)``, ``0 of 320 outputs late``."""
        if not self.absent:
            return f"{self.late or 0} of {self.due} outputs late"
        parts = [f"{self.late} late"] if self.late else []
        parts += [f"{count} {reason}" for reason, count in self.absent.items()]
        usual = f", {self.usual} of these as before the plan" if self.usual else ""
        return f"{self.missed} of {self.due} outputs missed ({', '.join(parts)}{usual})"


def most_by_chance(count: int, share: float) -> int:
    """How many of ``count`` may be hit by chance, if a ``share`` of all is."""
    mean = count * share
    return math.floor(mean + STANDARD_ERRORS * math.sqrt(mean))


def _usual(evidence: Evidence, before: int, due: int, absent: int) -> int:
    """How many of ``absent`` outputs are as usual.

    ``before`` is how many were absent in the recording from which the plan was made.
    """
    planned_from = evidence.samples + evidence.disturbed + evidence.incomplete
    return min(absent, most_by_chance(due, before / planned_from)) if before else 0


def outputs_due(analysis: LatencyAnalysis, plan: ChainPlan | None = None) -> OutputsDue:
    """Count the outputs of a chain that were due, under a plan if one was in force."""
    return _counted(analysis.traversals, analysis.not_begun, plan)


def undisturbed_outputs_due(analysis: LatencyAnalysis) -> OutputsDue:
    """Do the same without the cycles that the machine disturbed."""
    return _counted(analysis.traversals.filter(~pl.col("disturbed")), analysis.not_begun, None)


def _counted(traversals: pl.DataFrame, not_begun: int, plan: ChainPlan | None) -> OutputsDue:
    due = traversals.filter("was_due")
    gone = due.filter(~pl.col("complete"))
    absent = Counter[str](gone["reason"].cast(pl.String)) if gone.height else Counter[str]()
    if not_begun:
        absent[NOT_BEGUN] = not_begun
    known = due["late"].count() or not due.filter("complete").height
    count, usual = due.height + not_begun, 0
    if plan is not None:
        before = plan.evidence.unpublished
        usual = _usual(plan.evidence, before, count, absent[NOT_PUBLISHED])
    return OutputsDue(
        due=count,
        late=int(due["late"].sum() or 0) if known else None,
        absent={reason: number for reason, number in absent.items() if number},
        usual=usual,
        promised=None if plan is None else allowed_late_share(plan.margin),
    )
