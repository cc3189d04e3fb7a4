"""Overruns in a recording: outputs that came behind the slot they were due in, and what was done.

An output that comes when its slot has opened already is in time, but a gate cannot hold it until
the slot's start: it leaves at once, and later than all others. Such outputs are counted as well.

A gate records its decision about every message. The thread of an asynchronous publisher records
none: there, messages that were never sent count as discarded, and messages that were sent in a
later cycle than due count as having waited.

If several chains are shaped, a chain's figures are those of its own gates: the rows with the name
of one of them. Rows without a name, as in live recordings, belong to the nodes of their process.

An overrun must not delay the cycle after it, whatever the policy: the **next cycle** was hit if its
output missed its slot as well, or did not come, for whatever cause.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from chainshaper.analysis import LatencyAnalysis
from chainshaper.analysis.messages import with_overrun
from chainshaper.analysis.objects import named_nodes
from chainshaper.analysis.traversals import OWES_NO_OUTPUT
from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import publisher_servers, shaping_nodes
from chainshaper.planning.overruns import cycles_until_output, slots_of_latency
from chainshaper.robot.decision import DROPPED
from chainshaper.values import events
from chainshaper.values.plan_choices import STANDBY
from chainshaper.values.recording import Recording

# What was done with an output that overran, by policy.
_DONE = {
    "wait": "waited for the next slot",
    "discard": "discarded",
    "publish": "published at once",
    "next-slot": "left in the slot behind their mode's",
}
# What became of outputs while the shaping node was not there.
_WITHOUT_NODE = {
    "bypass": "went around the shaping node, which was not there",
    "silence": "were not published, since the shaping node was not there",
}

_MOVES_SHOWN = 8  # in a text, the last ones


def gate_releases(
    recording: Recording, plan: ChainPlan | None, analysis: LatencyAnalysis
) -> pl.DataFrame | None:
    """The rows of `gate_release` for the analysed chain; None: no gate decided about it.

    The column ``overrun`` is added to older recordings. With a plan these are the rows of its
    shaping nodes on the chain, and of their standbys, without those of the plan's other sinks.
    """
    if "gate_release" not in recording.events:
        return None
    table = events.table(recording.events, "gate_release", ["dropped", "lost", "gate"])
    table = with_overrun(table, 0 if plan is None else cycles_until_output(plan))
    if plan is None:
        return table
    nodes = [node for node in shaping_nodes(plan) if node.output in analysis.chain.topics]
    names = [f"{node.name}{ending}" for node in nodes for ending in ("", STANDBY)]
    table = table.filter(pl.col("gate").is_in(names) | pl.col("gate").is_null())
    return _of_nodes(recording, table, [f"/{name}" for name in names]) if names else None


def _of_nodes(recording: Recording, table: pl.DataFrame, names: Collection[str]) -> pl.DataFrame:
    """The rows of a table without those of processes that are known to run only other nodes."""
    nodes = named_nodes(recording.events)
    of_names = nodes.filter(pl.col("node").is_in(names))
    elsewhere = nodes.join(of_names, on="pid", how="anti")
    return table.join(elsewhere, on="pid", how="anti", maintain_order="left")


def overruns_in(
    recording: Recording,
    plan: ChainPlan | None,
    analysis: LatencyAnalysis,
    decided: pl.DataFrame | None,
) -> dict[str, int] | None:
    """Count the outputs that overran, by the policy that was applied; None: nothing was gated.

    ``decided`` is the frame of :func:`gate_releases`. Outputs that a standby published, or held
    back, while the shaping node was not there, count as overruns as well.
    """
    gated = (
        [] if plan is None else [node for *_, nodes in publisher_servers(plan) for node in nodes]
    )
    if decided is None and not gated:
        return None
    counts = Counter[str](() if decided is None else decided["overrun"].drop_nulls())
    if plan is not None and gated:
        sends = _of_nodes(recording, events.table(recording.events, "asynchronous_send"), gated)
        counts["discard"] += sends.filter(pl.col("outcome") != "sent").height
        cycles, due_until = analysis.traversals, (cycles_until_output(plan) + 1) * plan.cycle_ns
        counts["wait"] += cycles.filter(pl.col("latency_ns") >= due_until).height
        if plan.overrun == "publish":
            behind = pl.col("place_ns") >= slots_of_latency(plan)[-1][1]
            counts["publish"] += cycles.filter(behind & ~pl.col("late")).height
    return {policy: counts[policy] for policy in (*_DONE, *_WITHOUT_NODE) if counts[policy]}


@dataclass(frozen=True)
class OverrunOutcome:
    """What became of a chain's outputs that overran under one policy."""

    late: int  # number of those that left
    discarded: int  # number of those that did not
    followed: int  # number of those whose next cycle is in the recording
    next_hit: int  # number of these next cycles that were hit


def outcomes_in(analysis: LatencyAnalysis, plan: ChainPlan | None) -> dict[str, OverrunOutcome]:
    """Find what became of the outputs that overran, by the policy that was applied.

    Outputs that a standby published, or held back, are not among them.
    """
    decided = analysis.decided.select("traversal", "overrun")
    decided = decided.filter(~pl.col("overrun").is_in([*_WITHOUT_NODE]).fill_null(False))
    cycles = analysis.traversals.join(decided, on="traversal", how="left", maintain_order="left")
    missed = pl.col("late").fill_null(False) | (pl.col("reason") == "discarded").fill_null(False)
    policy = pl.col("overrun")
    if plan is not None and not decided.height and any(publisher_servers(plan)):
        missed |= (pl.col("place_ns") >= slots_of_latency(plan)[-1][1]).fill_null(False)
        policy = pl.when(missed).then(pl.lit(plan.overrun))
    unknown = ["not taken", "not sent", "still running", *OWES_NO_OUTPUT]
    cut = pl.col("reason").is_in(unknown).fill_null(False)
    hit = pl.when(~cut).then(missed | ~pl.col("complete"))
    cycles = cycles.select("complete", policy=policy, next_hit=hit.shift(-1))
    rows = cycles.drop_nulls("policy").group_by("policy", maintain_order=True)
    figures = rows.agg(
        late=pl.col("complete").sum(),
        discarded=(~pl.col("complete")).sum(),
        followed=pl.col("next_hit").count(),
        next_hit=pl.col("next_hit").sum(),
    )
    return {row.pop("policy"): OverrunOutcome(**row) for row in figures.iter_rows(named=True)}


def next_cycles(outcomes: Mapping[str, OverrunOutcome]) -> str:
    """Text: how many of the cycles after overruns were hit, such as ``1 of 3``."""
    hit = sum(outcome.next_hit for outcome in outcomes.values())
    return f"{hit} of {sum(outcome.followed for outcome in outcomes.values())}"


def into_open_slots(decided: pl.DataFrame | None) -> int | None:
    """Count the outputs that came when their slot had opened already; None: no gate decided.

    They took longer than the plan's L̄ + ε. The jitter of a wide slot comes from them.
    """
    at_once = pl.col("overrun").is_null() & (pl.col("release") == pl.col("arrival"))
    return None if decided is None else decided.filter(at_once).height


def moves_in(analysis: LatencyAnalysis) -> list[dict[str, int]]:
    """List the moves of slots that follow the latencies.

    Each has ``from_ns``, the origin of the first cycle with it, and ``moved_ns``, how far the slots
    were then from where the plan has them.
    """
    moved = pl.col("moved_ns")
    changes = analysis.decided.sort("origin").filter(moved != moved.shift(1, fill_value=0))
    return changes.select(from_ns="origin", moved_ns=moved).to_dicts()


def moves_text(moves: Sequence[Mapping[str, int]]) -> str:
    """Text of moves, with the last ones: ``moved 2 times, by +1.200 +0.800 ms``."""
    last = " ".join(f"{move['moved_ns'] / 1e6:+.3f}" for move in moves[-_MOVES_SHOWN:])
    more = "last " if len(moves) > _MOVES_SHOWN else ""
    return f"moved {len(moves)} {'time' if len(moves) == 1 else 'times'}, {more}by {last} ms"


def dropped_in(decided: pl.DataFrame | None) -> dict[str, int] | None:
    """Count the messages that gates did not let out, by reason; None: no gate decided.

    With those that DDS lost before they reached a gate, if its sequence numbers show them. The
    reasons are those of ``dropped`` in :mod:`chainshaper.values.events`.
    """
    if decided is None:
        return None
    discarded = pl.col("release").is_null() & (pl.col("overrun") == "discard")
    reason = pl.coalesce("dropped", pl.when(discarded).then(pl.lit("discarded")))
    counts = Counter[str](decided.select(reason).to_series().drop_nulls())
    counts["lost by DDS"] = int(decided["lost"].sum())
    return {name: counts[name] for name in (*DROPPED, "lost by DDS") if counts[name]}


def dropped_text(dropped: dict[str, int]) -> str:
    """``3 messages were lost at the gate (2 replaced, 1 overflowed)``."""
    total = sum(dropped.values())
    why = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
    return f"{total} {'message was' if total == 1 else 'messages were'} lost at the gate ({why})"


def overruns_text(overruns: dict[str, int]) -> str:
    """``3 outputs were too late for their slot (2 discarded, 1 published at once)``."""
    parts = [
        f"{count} {_WITHOUT_NODE[reason]}"
        for reason, count in overruns.items()
        if reason in _WITHOUT_NODE
    ]
    treated = {policy: count for policy, count in overruns.items() if policy in _DONE}
    if treated or not parts:
        total = sum(treated.values())
        done = ", ".join(f"{count} {_DONE[policy]}" for policy, count in treated.items())
        late = "output was too late for its" if total == 1 else "outputs were too late for their"
        parts.insert(0, f"{total} {late} slot ({done})")
    return "; ".join(parts)
