"""What the stall meters' wake-ups say about the machine's pace."""

import numpy as np
import polars as pl
from validate_simulator import ordinary_pace, relative_pace


def _tables() -> dict[str, pl.DataFrame]:
    """Core 0: 20 each but for a stretch from 200 to 300; core 1: watched from 100 to 200."""
    rows = [(0, 0, 20), (100, 0, 20), (200, 0, 50), (300, 0, 20), (100, 1, 7)]
    frame = pl.DataFrame(rows, schema=["time", "cpu", "cpu_time"], orient="row")
    return {"machine_pace": frame.with_columns(duration=pl.lit(100), pid=0, tid=0)}


def test_the_ordinary_pace_of_a_core_is_its_median() -> None:
    assert ordinary_pace(_tables()) == {0: 20, 1: 7}
    assert ordinary_pace({}) == {}


def test_a_window_has_the_mean_pace_of_all_stretches_that_it_meets_if_they_were_watched() -> None:
    start, end = np.array([150, 210, 0, 310]), np.array([250, 290, 100, 320])
    first, second = relative_pace(_tables(), start, end, {0: 20.0, 1: 3.5})
    # 20 and 50: 35; only 50; only 20, since a window ends before its end.
    assert first.tolist() == [35 / 20, 50 / 20, 1, 1]
    assert second[0] == 2
    (row,) = relative_pace(_tables(), start, end, {7: 20.0})
    assert np.isnan(row).all()
