"""Which registrations are the same callback to a person.

Events know callbacks by address. A subscription that is destroyed and created again gets another
one, a subscription with intra-process communication has two at once; in a graph and in statistics
each of them is one callback. Two timers of one node with the same period, on the other hand, are
two, however alike they look.
"""

import polars as pl

from chainshaper.analysis.matching import latest_before
from chainshaper.values import events

__all__ = ["numbered"]


def numbered(tables: events.EventTables, callbacks: pl.DataFrame) -> pl.DataFrame:
    """Add ``callback_id``: registrations of what is the same callback to a person share one.

    Two registrations are one callback when they belong to the same subscription (intra-process
    twins), or when node, kind, topic, period and symbol agree and the first was done before the
    second began: its address was reused, or its last instance started before.
    """
    missing = pl.format("unknown (process {})", "pid")
    callbacks = callbacks.sort("valid_from", "handle", maintain_order=True).with_columns(
        named=pl.col("node").is_not_null(), node=pl.col("node").fill_null(missing)
    )
    identity = ["pid", "kind", "node", "topic", "period_ns", "symbol"]
    last_start = _last_starts(tables, callbacks, identity)
    latest: dict[tuple[object, ...], tuple[int, int]] = {}  # identity → (id, row) seen last
    of_subscription: dict[int, int] = {}
    ids: list[int] = []
    count = 0
    columns = [*identity, "subscription", "valid_from", "valid_to", "named"]
    for row, values in enumerate(callbacks.select(columns).iter_rows()):
        *key, subscription, valid_from, _, named = values
        found = of_subscription.get(subscription)
        if found is None and named and tuple(key) in latest:
            previous, at = latest[tuple(key)]
            freed = callbacks["valid_to"][at]
            ended = last_start.get(at)
            if (freed is not None and freed <= valid_from) or (
                ended is not None and ended < valid_from
            ):
                found = previous
        number = count if found is None else found
        count = max(count, number + 1)
        ids.append(number)
        latest[tuple(key)] = (number, row)
        if subscription is not None:
            of_subscription.setdefault(subscription, number)
    return callbacks.drop("named").with_columns(pl.Series("callback_id", ids, dtype=pl.UInt32))


def _last_starts(
    tables: events.EventTables, callbacks: pl.DataFrame, identity: list[str]
) -> dict[int, int]:
    """Row of a registration → time of its last instance, for those that look alike."""
    alike = callbacks.with_row_index("row").filter(pl.len().over(identity) > 1)
    if alike.is_empty():
        return {}
    handles = alike.select("pid", callback="handle").unique()
    starts = events.table(tables, "callback_start").select("time", "pid", "callback")
    starts = starts.join(handles, on=["pid", "callback"], how="semi")
    owner = alike.select("row", "valid_from", "pid", callback="handle")
    found = latest_before(starts, owner, ["pid", "callback"], "time", "valid_from")
    last = found.drop_nulls("row").group_by("row").agg(pl.col("time").max())
    return dict(last.select("row", "time").iter_rows())
