"""Overruns in a recording: outputs that came behind the slot they were due in, and what was done.

One that comes when its slot has opened already is in time, but a gate cannot hold it until the
slot's start: it leaves at once, and later than all others. Those are counted, too.

A gate records its decision for every message. The thread of an asynchronous publisher decides
nothing; there the messages that were never sent count as discarded, and those that were sent in a
later cycle than due as having waited.
"""

import polars as pl

from chainshaper import events
from chainshaper.analysis import LatencyAnalysis
from chainshaper.planning import Plan
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.planning.publisher_threads import publisher_servers
from chainshaper.recording import Recording

__all__ = ["gate_releases", "into_open_slots", "overruns_in", "overruns_text"]

_DONE = {
    "wait": "waited for the next slot",
    "discard": "discarded",
    "publish": "published at once",
    "next-slot": "left in the slot behind their mode's",
}


def gate_releases(recording: Recording, plan: Plan | None) -> pl.DataFrame:
    """The table `gate_release` with ``overrun`` and ``mode``, which older recordings lack.

    Without the former a message overran when it left in a later cycle than the ``plan`` says.
    """
    table = events.table(recording.events, "gate_release", ["mode"])
    if "overrun" in table.columns:
        return table
    late = pl.col("cycles_waited") > (0 if plan is None else cycles_until_output(plan))
    return table.with_columns(overrun=pl.when(late).then(pl.lit("wait")))


def overruns_in(
    recording: Recording, plan: Plan | None, analysis: LatencyAnalysis | None = None
) -> dict[str, int] | None:
    """How many outputs overran, per policy that was applied to them; None: nothing was gated.

    ``analysis`` is that of the plan's chain; without it, outputs of an asynchronous publisher that
    waited cannot be counted.
    """
    gated = plan is not None and any(publisher_servers(plan))
    if "gate_release" not in recording.events and not gated:
        return None
    treated = gate_releases(recording, plan)["overrun"].drop_nulls()
    counts = {policy: int((treated == policy).sum()) for policy in _DONE}
    if gated and plan is not None:
        outcomes = events.table(recording.events, "asynchronous_send")["outcome"]
        counts["discard"] += int((outcomes != "sent").sum())
        if analysis is not None:
            due_until = (cycles_until_output(plan) + 1) * plan.cycle_ns
            late = analysis.traversals["latency_ns"].drop_nulls() >= due_until
            counts["wait"] += int(late.sum())
    return {policy: count for policy, count in counts.items() if count}


def into_open_slots(recording: Recording, plan: Plan | None) -> int | None:
    """How many outputs came into their slot when it was open already; None: no gate decided.

    They took longer than the plan's L̄ + ε, and make up the jitter that a wide slot lets through.
    """
    if "gate_release" not in recording.events:
        return None
    table = gate_releases(recording, plan).filter(pl.col("overrun").is_null())
    return int((table["release"] == table["arrival"]).sum())


def overruns_text(overruns: dict[str, int]) -> str:
    """``3 outputs were too late for their slot (2 discarded, 1 published at once)``."""
    total = sum(overruns.values())
    done = ", ".join(f"{count} {_DONE[policy]}" for policy, count in overruns.items())
    late = "output was too late for its" if total == 1 else "outputs were too late for their"
    return f"{total} {late} slot ({done})"
