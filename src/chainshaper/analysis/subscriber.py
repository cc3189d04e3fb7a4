"""The latency that the subscriber of a chain's output sees.

The paper's latency ends at the publication; what acts on it is the node that subscribes to it,
whose callback starts later: after transport, and after whatever else its executor is doing.
"""

import polars as pl

from chainshaper.analysis.flow import DataFlow
from chainshaper.analysis.matching import by_number
from chainshaper.analysis.traversals import Traversals
from chainshaper.values.application import ApplicationGraph

__all__ = ["reception"]


def reception(
    flow: DataFlow, traversals: Traversals, graph: ApplicationGraph, node: str | None = None
) -> pl.DataFrame:
    """When a callback of the output's subscriber started with each traversal's message.

    One row per traversal, in order: ``traversal``, ``received`` (start of the callback instance
    that took the output, null if there is none) and ``reception_ns`` (from the traversal's
    start). The subscriber is that of ``node``, by default the first subscription callback of the
    last topic that received anything at all.
    """
    topic = traversals.chain.topics[-1]
    candidates = [
        callback.id
        for callback in graph.callbacks
        if callback.kind == "subscription"
        and callback.topic == topic
        and node in {None, callback.node}
    ]
    taken = flow.takes.filter(
        pl.col("callback_id").is_in(candidates)
        & pl.col("publication").is_not_null()
        & pl.col("instance").is_not_null()
    ).select("callback_id", "publication", "instance")
    taken = taken.filter(pl.col("callback_id") == pl.col("callback_id").min())
    # Of several takes the first: what is laid out last stays.
    reader = by_number(taken.reverse(), "publication", "instance", flow.publications.height)
    received = flow.instances["start"].gather(reader.gather(traversals.frame["publication"]))
    return traversals.frame.select(
        "traversal", received=received, reception_ns=received - pl.col("start")
    )
