"""Which live runs the tests measure."""

from dataclasses import replace
from pathlib import Path

import polars as pl
from calm_runs import calm_run, has_undisturbed_executions

from chainshaper import measure_latency
from chainshaper.values.recording import Recording


def test_a_run_is_usable_as_long_as_each_callback_ran_undisturbed(simulated: Recording) -> None:
    analysis = measure_latency(simulated).analysis
    assert has_undisturbed_executions(analysis)
    all_but_last = pl.col("traversal") < pl.col("traversal").max()
    one_left = analysis.traversals.with_columns(disturbed=all_but_last)
    assert has_undisturbed_executions(replace(analysis, traversals=one_left))
    none_left = analysis.traversals.with_columns(disturbed=pl.lit(value=True))
    assert not has_undisturbed_executions(replace(analysis, traversals=none_left))


def test_a_calm_run_is_not_repeated(simulated: Recording, tmp_path: Path) -> None:
    places: list[Path] = []

    def run(place: Path) -> Recording:
        places.append(place)
        return simulated

    assert calm_run(run, tmp_path) is simulated
    assert places == [tmp_path / "attempt0"]
