"""Ends of starts: the compiled walk against the definition."""

import itertools
import random

import polars as pl
import pytest

from chainshaper.analysis.matching import ends_of_starts


def by_definition(
    starts: list[tuple[int, int, int]], ends: list[tuple[int, int, int]]
) -> list[int]:
    """For every start the next event of its thread and callback, if that is an end."""
    result = [-1] * len(starts)
    for key in {event[:2] for event in (*starts, *ends)}:
        own = [(t, 0, i) for i, (*k, t) in enumerate(starts) if tuple(k) == key]
        own += [(t, 1, i) for i, (*k, t) in enumerate(ends) if tuple(k) == key]
        ordered: list[tuple[int, int, int]] = []
        for moment in sorted({t for t, _, _ in own}):
            now = [event for event in own if event[0] == moment]
            is_open = sum(1 if kind == 0 else -1 for _, kind, _ in ordered) > 0
            ordered += sorted(now, key=lambda e: (e[1] == 0) == is_open)
        for (_, kind, row), (_, after, end) in itertools.pairwise(ordered):
            if (kind, after) == (0, 1):
                result[row] = end
    return result


def as_table(events: list[tuple[int, int, int]]) -> pl.DataFrame:
    types = {"tid": pl.Int32, "callback": pl.UInt64, "time": pl.Int64}
    return pl.DataFrame(events, schema=types, orient="row").with_columns(
        pl.lit(7, dtype=pl.Int32).alias("pid")
    )


@pytest.mark.parametrize("seed", range(60))
def test_any_order_of_events(seed: int) -> None:
    """Lost starts, lost ends, equal times: whatever a trace may hold."""
    chance = random.Random(seed)
    length = chance.choice((0, 1, 5, 40, 200))
    starts, ends = (
        sorted(
            (
                (chance.randrange(2), chance.randrange(3), chance.randrange(1 + length // 2))
                for _ in range(length)
            ),
            key=lambda event: event[2],
        )
        for _ in range(2)
    )
    found = ends_of_starts(as_table(starts), as_table(ends)).cast(pl.Int64).fill_null(-1)
    assert found.to_list() == by_definition(starts, ends)


def test_more_callbacks_than_the_table_was_made_for() -> None:
    starts = [(1, callback, 2 * callback) for callback in range(5000)]
    ends = [(1, callback, 2 * callback + 1) for callback in range(5000)]
    found = ends_of_starts(as_table(starts), as_table(ends)).cast(pl.Int64).fill_null(-1)
    assert found.to_list() == list(range(5000))
