"""Work that no callback event shows, but that messages prove: instances assumed from them.

* A Python node (rclpy), or one that takes from a wait set, has no callback events. An instance of
  its subscription is assumed to begin with each take. What its thread publishes for the same node
  until its next take is counted as that instance's output; when it ends is not known.
* A driver's own thread, a player of recorded data, a Python timer or the callback of a service's
  client publishes outside all callbacks that events show. For a topic that its node publishes only
  like this a callback of kind ``unknown`` is assumed, with the handle 0 and one instance per
  publication, so that chains can begin there.

Assumed instances have ``assumed`` set and no ``end``; they have no response times.
"""

from dataclasses import replace

import polars as pl

from chainshaper.analysis.objects import CALLBACK_SCHEMA, Objects
from chainshaper.values.application import INTERNAL_TOPICS

__all__ = ["with_assumed_readers", "with_assumed_writers"]


def with_assumed_readers(
    instances: pl.DataFrame, taken: pl.DataFrame, objects: Objects
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Add an instance for every take of a subscription that has no callback events.

    Returns the instances, renumbered in order of start, and the takes with ``assumed_instance``.
    """
    silent = objects.callbacks.filter(~pl.col("observed")).select("callback_id").unique()
    assumed = taken.join(silent, on="callback_id", how="semi").select(
        "callback_id",
        "pid",
        "tid",
        "take",
        pl.col("time").alias("start"),
        "intra_process",
        pl.lit(True).alias("assumed"),
    )
    if assumed.is_empty():
        none = pl.lit(None, dtype=pl.UInt32).alias("assumed_instance")
        return instances, taken.with_columns(none)
    every = pl.concat([instances.drop("instance"), assumed], how="diagonal_relaxed")
    every = every.sort("start", maintain_order=True).with_row_index("instance")
    of_take = every.drop_nulls("take").select("take", assumed_instance="instance")
    taken = taken.join(of_take, on="take", how="left", maintain_order="left")
    return every.drop("take").select(instances.columns), taken


def with_assumed_writers(
    objects: Objects, instances: pl.DataFrame, published: pl.DataFrame
) -> tuple[Objects, pl.DataFrame, pl.DataFrame]:
    """Add a callback, and instances, for topics published only outside callbacks.

    Returns the objects, the instances (the new ones last) and the publications with them.
    """
    key = ["pid", "node", "topic"]
    # By publisher first: one number per row to group by instead of three.
    of_publisher = published.group_by("publisher").agg(
        pl.col(key).first(),
        pl.col("instance").count().alias("inside"),
        pl.col("time").min().alias("valid_from"),
    )
    writers = of_publisher.group_by(key).agg(pl.col("inside").sum(), pl.col("valid_from").min())
    internal = pl.col("topic").cast(pl.String).is_in(sorted(INTERNAL_TOPICS))
    outside = writers.filter((pl.col("inside") == 0) & ~internal & pl.col("node").is_not_null())
    if outside.is_empty():
        return objects, instances, published
    first = objects.callbacks.select(pl.col("callback_id").max()).item()
    outside = outside.sort("valid_from", "topic").with_row_index(
        "assumed_id", offset=0 if first is None else first + 1
    )
    assumed = (
        published.join(outside, on=key, how="inner", maintain_order="left")
        .select("publication", "pid", "tid", start="time", callback_id="assumed_id")
        .with_row_index("assumed_instance", offset=instances.height)
    )
    more = assumed.select(
        "callback_id",
        "pid",
        "tid",
        "start",
        instance="assumed_instance",
        intra_process=pl.lit(False),
        assumed=pl.lit(True),
    )
    given = assumed.select("publication", "assumed_instance", assumed_id="callback_id")
    published = published.join(given, on="publication", how="left", maintain_order="left")
    published = published.with_columns(
        pl.coalesce("instance", "assumed_instance").alias("instance"),
        pl.coalesce("callback_id", "assumed_id").alias("callback_id"),
    ).drop("assumed_instance", "assumed_id")
    every = pl.concat([instances, more], how="diagonal").select(instances.columns)
    return _with_callbacks(objects, outside), every, published


def _with_callbacks(objects: Objects, outside: pl.DataFrame) -> Objects:
    new = outside.select(
        "pid",
        "valid_from",
        callback_id="assumed_id",
        node=pl.col("node").cast(pl.String),
        kind=pl.lit("unknown"),
        handle=pl.lit(0, dtype=pl.UInt64),
        observed=pl.lit(False),
    )
    callbacks = pl.concat([objects.callbacks, new], how="diagonal_relaxed").select(
        pl.col(name).cast(type_) for name, type_ in CALLBACK_SCHEMA.items()
    )
    notes = tuple(
        f"{node} publishes {topic} outside its callbacks (from a thread of its own, from Python, "
        "or from a service client's callback): a chain that begins there is measured from the "
        "publication."
        for node, topic in outside.select("node", "topic").iter_rows()
    )
    return replace(objects, callbacks=callbacks, notes=(*objects.notes, *notes))
