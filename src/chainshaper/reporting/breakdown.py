"""Where a chain's latency goes: the shares of communication and computation, hop by hop.

A hop is a callback of the chain. Its *communication* is the time from the publication before it to
its own start: transport, and waiting for its executor. Its *computation* is the time from its
start to its publication: execution, pre-emption, and, where another callback of the node publishes
for it (a synchroniser), waiting for that one. Over a complete traversal the two add up to the
latency, so mean shares add up to one.
"""

from typing import Any

import polars as pl
from rich.table import Table

from chainshaper.analysis import LatencyAnalysis
from chainshaper.reporting.cells import ms, percent, terminal_table

__all__ = ["breakdown_json", "breakdown_table", "hop_breakdown"]

PARTS = ("communication", "computation")


def hop_breakdown(analysis: LatencyAnalysis) -> pl.DataFrame:
    """Communication and computation of every hop of a chain, over its complete traversals.

    One row per hop: ``hop`` (from 0), ``callback_id``, ``node``, ``callback`` (a short text),
    ``topic`` (that it publishes), ``count``, ``by_sibling`` (how often another callback of the
    node published for it), and for both parts ``…_ns``, a struct ``{min, mean, max}`` in ns (null
    without traversals, and for the first hop's communication), and ``…_share`` of the mean latency.
    """
    callbacks = {callback.id: callback for callback in analysis.graph.callbacks}
    complete = analysis.traversals.filter("complete")
    hops = analysis.hops.join(complete.select("traversal"), on="traversal", how="semi")
    latency = complete["latency_ns"].mean()
    figures = hops.group_by("hop").agg(
        pl.len().alias("count"),
        (pl.col("via") == "sibling").sum().alias("by_sibling"),
        *(_summary(part) for part in PARTS),
    )
    rows = pl.DataFrame(
        {
            "hop": range(len(analysis.chain.callbacks)),
            "callback_id": analysis.chain.callbacks,
            "node": [callbacks[number].node for number in analysis.chain.callbacks],
            "callback": [callbacks[number].label for number in analysis.chain.callbacks],
            "topic": analysis.chain.topics,
        },
        schema_overrides={"hop": pl.UInt8, "callback_id": pl.UInt32},
    )
    joined = rows.join(figures, on="hop", how="left", maintain_order="left")
    means = [pl.col(f"{part}_ns").struct.field("mean").alias(f"{part}_share") for part in PARTS]
    return joined.with_columns(
        pl.col("count", "by_sibling").fill_null(0),
        *(mean / pl.lit(latency, dtype=pl.Float64) for mean in means),
    )


def _summary(part: str) -> pl.Expr:
    values = pl.col(f"{part}_ns")
    summary = pl.struct(min=values.min(), mean=values.mean(), max=values.max())
    return pl.when(values.count() > 0).then(summary).alias(f"{part}_ns")


def breakdown_json(analysis: LatencyAnalysis) -> dict[str, Any]:
    """The breakdown as plain data: ``hops``, and the two parts' shares of the mean latency."""
    frame = hop_breakdown(analysis)
    shares = {
        f"{part}_share": frame[f"{part}_share"].sum() if frame[f"{part}_share"].count() else None
        for part in PARTS
    }
    return {"hops": frame.to_dicts(), **shares}


def breakdown_table(analysis: LatencyAnalysis) -> Table:
    """Every hop's communication and computation, and their shares of the mean latency."""
    table = terminal_table("Where it goes, hop by hop [ms]", ("callback", "publishes"))
    table.show_footer, table.columns[0].footer = True, "together"
    frame = hop_breakdown(analysis)
    for part in PARTS:
        shares = frame[f"{part}_share"].drop_nulls().to_list()
        table.add_column(f"{part}\nmean", justify="right")
        table.add_column("max", justify="right")
        table.add_column("share", percent(sum(shares) if shares else None), justify="right")
    for row in frame.iter_rows(named=True):
        cells = [row["callback"], row["topic"]]
        for part in PARTS:
            times = row[f"{part}_ns"] or {"mean": None, "max": None}
            cells += [ms(times["mean"]), ms(times["max"]), percent(row[f"{part}_share"])]
        table.add_row(*cells)
    return table
