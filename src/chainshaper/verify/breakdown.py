"""Where a chain's latency goes: the shares of communication and computation, hop by hop.

A hop is a callback of the chain. Its *communication* is the time from the publication before it to
its own start: transport, and waiting for its executor. Its *computation* is the time from its
start to its publication: execution, pre-emption, and, where another callback of the node publishes
for it (a synchroniser), waiting for that one. Over a complete traversal the two add up to the
latency, so mean shares add up to one.
"""

import polars as pl

from chainshaper.analysis import LatencyAnalysis

__all__ = ["PARTS", "hop_breakdown", "part_shares"]

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
    found = hops.group_by("hop").agg(
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
    joined = rows.join(found, on="hop", how="left", maintain_order="left")
    means = [pl.col(f"{part}_ns").struct.field("mean").alias(f"{part}_share") for part in PARTS]
    return joined.with_columns(
        pl.col("count", "by_sibling").fill_null(0),
        *(mean / pl.lit(latency, dtype=pl.Float64) for mean in means),
    )


def _summary(part: str) -> pl.Expr:
    values = pl.col(f"{part}_ns")
    summary = pl.struct(min=values.min(), mean=values.mean(), max=values.max())
    return pl.when(values.count() > 0).then(summary).alias(f"{part}_ns")


def part_shares(frame: pl.DataFrame) -> dict[str, float | None]:
    """The parts' shares of the mean latency, over all hops; None without traversals."""
    shares = {part: frame[f"{part}_share"].drop_nulls() for part in PARTS}
    return {part: float(one.sum()) if len(one) else None for part, one in shares.items()}
