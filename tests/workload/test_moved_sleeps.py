"""The instants until which a loop's sleeps lasted, with what the library has added to them."""

import polars as pl

from chainshaper.values.event_declarations import LOOP_MOVES
from chainshaper.workload.live import with_moved_sleeps


def test_each_sleep_gets_what_was_added_to_it() -> None:
    """Tried with 30 from the second sleep on, kept, 50 from the fourth on, and taken back."""
    sleeps = pl.DataFrame(
        {
            "time": [0, 3, 100, 200, 300, 400, 500],
            "pid": [1, 2, 1, 1, 1, 1, 1],
            "tid": [7, 8, 7, 7, 7, 7, 7],
            "until": [90, 95, 190, 290, 390, 490, 590],
        }
    )
    moved = pl.DataFrame(
        {
            "time": [101, 201, 301, 501],
            "pid": [1] * 4,
            "tid": [7] * 4,
            "added": [30, 0, 20, -50],
            "kept": [0, 30, 50, 0],
            "why": [LOOP_MOVES.index(why) for why in ("asked", "kept", "kept", "over")],
        }
    )
    seen = with_moved_sleeps(sleeps, moved)
    assert seen["until"].to_list() == [90, 95, 220, 320, 440, 540, 590]
    assert seen.columns == sleeps.columns
    assert with_moved_sleeps(sleeps, moved.clear()).equals(sleeps)
