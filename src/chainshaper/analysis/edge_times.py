"""How long messages take along each edge of the application graph, from topic to callback."""

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.latency import summary


def edge_times(flow: DataFlow) -> pl.DataFrame:
    """Make a frame of every edge along which messages came, one row each. Columns:

    * ``topic``; ``callback_id`` of the callback that got its messages.
    * ``count``: of the messages whose publication and callback instance are known.
    * ``communication_ns``: from the publication (of an asynchronous publisher: from when its thread
      sent it) to the start of the callback, a struct ``{min, mean, max}`` in ns.
    """
    sent = flow.publications.select("topic", sent=pl.coalesce("sent", "time")).with_row_index(
        "publication"
    )
    started = flow.instances.select("callback_id", "start").with_row_index("instance")
    taken = flow.takes.select("publication", "instance").drop_nulls()
    came = taken.cast({"publication": pl.UInt32, "instance": pl.UInt32}).join(
        sent, on="publication"
    )
    delivered = came.join(started, on="instance")
    times = summary(pl.col("start") - pl.col("sent")).alias("communication_ns")
    by_edge = delivered.group_by("topic", "callback_id").agg(times, count=pl.len())
    return by_edge.select("topic", "callback_id", "count", "communication_ns").sort(
        "callback_id", "topic"
    )
