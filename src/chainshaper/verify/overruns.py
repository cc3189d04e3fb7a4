"""Overruns in a recording: outputs that came behind the slot they were due in, and what was done.

One that comes when its slot has opened already is in time, but a gate cannot hold it until the
slot's start: it leaves at once, and later than all others. Those are counted, too.

A gate records its decision for every message. The thread of an asynchronous publisher decides
nothing; there the messages that were never sent count as discarded, and those that were sent in a
later cycle than due as having waited.

Where several chains are shaped, a chain's figures are those of its own gates: of the rows that name
one of them, and where rows name none, as in live recordings, each gate is a process.

Whatever the policy, an overrun is to be late by itself: the **next cycle** was hit where its output
missed its slot too, or did not come, whatever the cause.
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

_DONE = {
    "wait": "waited for the next slot",
    "discard": "discarded",
    "publish": "published at once",
    "next-slot": "left in the slot behind their mode's",
}
_WITHOUT_NODE = {
    "bypass": "went around the shaping node, which was not there",
    "silence": "were not published, since the shaping node was not there",
}

_MOVES_SHOWN = 8


def gate_releases(
    recording: Recording, plan: ChainPlan | None, analysis: LatencyAnalysis
) -> pl.DataFrame | None:
    """The table `gate_release` with ``overrun``, which older recordings lack; None: there is none.

    Of a plan it has the rows of its shaping nodes on the analysed chain and of their standbys, not
    those of the plan's other sinks.
    """
    if "gate_release" not in recording.events:
        return None
    table = events.table(recording.events, "gate_release", ["dropped", "lost", "gate"])
    table = with_overrun(table, 0 if plan is None else cycles_until_output(plan))
    if plan is None:
        return table
    nodes = [one for one in shaping_nodes(plan) if one.output in analysis.chain.topics]
    names = [f"{one.name}{ending}" for one in nodes for ending in ("", STANDBY)]
    table = table.filter(pl.col("gate").is_in(names) | pl.col("gate").is_null())
    return _of_nodes(recording, table, [f"/{name}" for name in names]) if names else None


def _of_nodes(recording: Recording, table: pl.DataFrame, own: Collection[str]) -> pl.DataFrame:
    """The rows of a table but those of processes of which it is known that they run other nodes."""
    nodes = named_nodes(recording.events)
    ours = nodes.filter(pl.col("node").is_in(own))
    others = nodes.join(ours, on="pid", how="anti")
    return table.join(others, on="pid", how="anti", maintain_order="left")


def overruns_in(
    recording: Recording,
    plan: ChainPlan | None,
    analysis: LatencyAnalysis,
    decided: pl.DataFrame | None,
) -> dict[str, int] | None:
    """How many outputs overran, per policy that was applied to them; None: nothing was gated.

    ``decided`` is that of :func:`gate_releases`. Those that a standby dealt with, while the shaping
    node was not there, count as overruns too.
    """
    gated = [] if plan is None else [n for *_, nodes in publisher_servers(plan) for n in nodes]
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
class Outcome:
    """Of a chain's outputs that overran under one policy, ``late`` left and ``discarded`` did not.
    Behind ``followed`` of them the recording has the next cycle; ``next_hit`` of these were hit.
    """

    late: int
    discarded: int
    followed: int
    next_hit: int


def outcomes_in(analysis: LatencyAnalysis, plan: ChainPlan | None) -> dict[str, Outcome]:
    """What became of the outputs that overran, per policy that was applied to them; those that a
    standby dealt with did not overrun.
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
    return {row.pop("policy"): Outcome(**row) for row in figures.iter_rows(named=True)}


def next_cycles(outcomes: Mapping[str, Outcome]) -> str:
    """How many of the cycles behind overruns were hit: ``1 of 3``."""
    hit = sum(one.next_hit for one in outcomes.values())
    return f"{hit} of {sum(one.followed for one in outcomes.values())}"


def into_open_slots(decided: pl.DataFrame | None) -> int | None:
    """How many outputs came into their slot when it was open already; None: no gate decided.

    They took longer than the plan's L̄ + ε, and make up the jitter that a wide slot lets through.
    """
    at_once = pl.col("overrun").is_null() & (pl.col("release") == pl.col("arrival"))
    return None if decided is None else decided.filter(at_once).height


def moves_in(analysis: LatencyAnalysis) -> list[dict[str, int]]:
    """From which cycle on (``from_ns``, its origin) the slots of a chain's output were moved, and
    by how much from where the plan has them (``moved_ns``): slots that follow the latencies.
    """
    moved = pl.col("moved_ns")
    found = analysis.decided.sort("origin").filter(moved != moved.shift(1, fill_value=0))
    return found.select(from_ns="origin", moved_ns=moved).to_dicts()


def moves_text(moves: Sequence[Mapping[str, int]]) -> str:
    """``moved 2 times, by +1.2 +0.8 ms``; of many the last."""
    last = " ".join(f"{move['moved_ns'] / 1e6:+.3f}" for move in moves[-_MOVES_SHOWN:])
    more = "last " if len(moves) > _MOVES_SHOWN else ""
    return f"moved {len(moves)} {'time' if len(moves) == 1 else 'times'}, {more}by {last} ms"


def dropped_in(decided: pl.DataFrame | None) -> dict[str, int] | None:
    """How many messages gates received and did not let out, per reason, and how many DDS lost
    before they reached one, where its numbers say so; None: no gate decided.

    The reasons are those of ``dropped`` in :mod:`chainshaper.values.events`.
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
    parts = [f"{n} {_WITHOUT_NODE[what]}" for what, n in overruns.items() if what in _WITHOUT_NODE]
    treated = {policy: count for policy, count in overruns.items() if policy in _DONE}
    if treated or not parts:
        total = sum(treated.values())
        done = ", ".join(f"{count} {_DONE[policy]}" for policy, count in treated.items())
        late = "output was too late for its" if total == 1 else "outputs were too late for their"
        parts.insert(0, f"{total} {late} slot ({done})")
    return "; ".join(parts)
