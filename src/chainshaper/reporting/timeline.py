"""What happened when, thread by thread: the rows that a timeline draws, wherever it is drawn.

The report's page and the trace for Perfetto show the same things: the threads that ran callbacks,
the callbacks, the messages between them, the slots of the servers, what the gate retained, and
stalls of the machine. Times are ns of the event clock throughout.
"""

from dataclasses import dataclass

import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis
from chainshaper.analysis.disturbance import lateness_in_cycle
from chainshaper.planning import Plan
from chainshaper.values import events
from chainshaper.values.recording import Recording
from chainshaper.verify.predictions import due_of

__all__ = ["Timeline", "timeline_of"]


@dataclass(frozen=True)
class Timeline:
    """The rows of a timeline.

    * ``threads``: ``pid, tid, nodes`` (whose callbacks ran there), ``about`` (how the kernel
      schedules it, null where unknown); the chain's nodes first, in the chain's order.
    * ``slices``: ``instance, callback_id, pid, tid, start, end, ended, execution_ns``, sorted by
      start. Where the end was lost ``ended`` is false and ``end`` that of the data flow's
      convention: the start of the thread's next instance, or the end of the recording.
    * ``holds``: what a gate did with the chain's messages: ``traversal, hop, arrival, origin,
      release, let_go, slot, overrun``; it was to be let go at ``release`` and was at ``let_go``.
    * ``origins``: ``traversal, origin, assumed``: from when the plan's slots count in its cycle;
      ``assumed`` where no event says so. Empty without a plan.
    * ``slots``: ``traversal, server, slot, start, end`` of every server in every such cycle.
    * ``stalls``: ``core, start, end``.
    """

    threads: pl.DataFrame
    slices: pl.DataFrame
    holds: pl.DataFrame
    origins: pl.DataFrame
    slots: pl.DataFrame
    stalls: pl.DataFrame


def timeline_of(
    recording: Recording,
    flow: DataFlow,
    analysis: LatencyAnalysis | None = None,
    plan: Plan | None = None,
) -> Timeline:
    """The timeline of a recording; cycles and slots are those of ``analysis`` and ``plan``."""
    slices = _slices(flow)
    holds = _holds(analysis)
    origins = _origins(analysis, plan, holds)
    stalls = events.table(recording.events, "machine_stall", ["cpu"])
    return Timeline(
        threads=_threads(recording, flow, slices, analysis),
        slices=slices,
        holds=holds,
        origins=origins,
        slots=_slots(plan, origins),
        stalls=stalls.select(
            core=pl.col("cpu"), start=pl.col("time"), end=pl.col("time") + pl.col("duration")
        ),
    )


def _slices(flow: DataFlow) -> pl.DataFrame:
    last = pl.concat(
        [flow.instances["start"], flow.instances["end"], flow.publications["time"]]
    ).max()
    following = pl.col("start").shift(-1).over("pid", "tid")
    return flow.instances.sort("start", maintain_order=True).select(
        *("instance", "callback_id", "pid", "tid", "start"),
        pl.coalesce("end", following, pl.lit(last)).alias("end"),
        pl.col("end").is_not_null().alias("ended"),
        "execution_ns",
    )


def _threads(
    recording: Recording, flow: DataFlow, slices: pl.DataFrame, analysis: LatencyAnalysis | None
) -> pl.DataFrame:
    chain = () if analysis is None else analysis.chain.callbacks
    place = pl.col("callback_id").replace_strict(
        list(chain), list(range(len(chain))), default=len(chain), return_dtype=pl.Int32
    )
    owners = flow.objects.callbacks.select("callback_id", "node").unique("callback_id")
    about = {
        (thread.pid, thread.tid): f"{thread.policy} {thread.priority}, "
        f"core{'s' if len(thread.cores) > 1 else ''} {', '.join(map(str, thread.cores))}"
        for thread in recording.info.threads
    }
    found = (
        slices.join(owners, on="callback_id", how="left")
        .group_by("pid", "tid")
        .agg(
            pl.col("node").drop_nulls().unique().sort().str.join(", ").alias("nodes"),
            place.min().alias("place"),
        )
        .sort("place", "nodes", "pid", "tid")
        .drop("place")
    )
    texts = [about.get(key) for key in found.select("pid", "tid").iter_rows()]
    return found.with_columns(pl.Series("about", texts, dtype=pl.String))


def _holds(analysis: LatencyAnalysis | None) -> pl.DataFrame:
    if analysis is None:
        return pl.DataFrame(schema={"traversal": pl.UInt32(), "hop": pl.UInt8(), **_HELD})
    return analysis.releases.select("traversal", "hop", *_HELD)


_HELD = {
    "arrival": pl.Int64(),
    "origin": pl.Int64(),
    "release": pl.Int64(),
    "let_go": pl.Int64(),
    "slot": pl.Int32(),
    "overrun": pl.String(),
}


def _origins(
    analysis: LatencyAnalysis | None, plan: Plan | None, holds: pl.DataFrame
) -> pl.DataFrame:
    """The gate says from when it counted; else the chain's stamp, or where cycles seem to start.

    Cycles of which the recording says nothing are taken to start as
    :mod:`chainshaper.analysis.disturbance` takes them.
    """
    if analysis is None or plan is None:
        return pl.DataFrame(
            schema={"traversal": pl.UInt32(), "origin": pl.Int64(), "assumed": pl.Boolean()}
        )
    last = len(analysis.chain.callbacks) - 1
    decided = holds.filter(pl.col("hop") == last).select("traversal", decided="origin")
    rows = analysis.traversals.select("traversal", "start").join(
        decided.unique("traversal"), on="traversal", how="left", maintain_order="left"
    )
    from_cycle = plan.shaping_node is None or due_of(plan)[0].from_cycle
    late = lateness_in_cycle(rows["start"], plan.cycle_ns) if from_cycle else 0
    return rows.select(
        "traversal",
        pl.coalesce("decided", pl.col("start") - pl.lit(late)).alias("origin"),
        pl.col("decided").is_null().alias("assumed"),
    )


def _slots(plan: Plan | None, origins: pl.DataFrame) -> pl.DataFrame:
    servers = () if plan is None else plan.servers
    table = pl.DataFrame(
        [
            (server.name, number, start, end)
            for server in servers
            for number, (start, end) in enumerate(server.slots)
        ],
        schema={
            "server": pl.String(),
            "slot": pl.Int32(),
            "opens": pl.Int64(),
            "closes": pl.Int64(),
        },
        orient="row",
    )
    # Cycles that two traversals share (the gate counts from its own) are drawn once.
    cycles = origins.unique("origin", keep="first", maintain_order=True)
    return cycles.join(table, how="cross", maintain_order="left_right").select(
        *("traversal", "server", "slot"),
        start=pl.col("origin") + pl.col("opens"),
        end=pl.col("origin") + pl.col("closes"),
    )
