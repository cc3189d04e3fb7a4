"""What experiments hand in, and the page that is made from it."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import render
from configurations import stood_still
from results import MS, OURS, RESULTS, Column, Line, Run, Value, earlier_runs, lines_of, save


def a_run(column: Column, *latencies_ms: float, disturbed: tuple[int, ...] = ()) -> Run:
    marks = np.zeros(len(latencies_ms), np.bool_)
    marks[list(disturbed)] = True
    return Run("a", column, (np.array(latencies_ms) * MS).astype(np.int64), marks)


def values(line: Line) -> tuple[Value, ...]:
    return line.simulated, line.simulated_all, line.live, line.live_all


def test_figures_of_calm_cycles_in_time_stand_beside_those_of_all() -> None:
    """Disturbed, incomplete and late ones are out of the former; all that ended in the other."""
    runs = [a_run("live", 10, 12, 90, -1e-6, 130, disturbed=(2,)), a_run("simulated", 20, 21)]
    paper: dict[str, Value] = {"average": 11, "maximum": 12.5, "jitter": "≈ 2", "late": None}
    lines = lines_of("a", runs, paper, late_from_ns=100 * MS, why="so")
    assert [(line.what, line.unit, line.paper, line.why, *values(line)) for line in lines] == [
        ("a: average", "ms", 11, "so", 20.5, 20.5, 11.0, 60.5),
        ("a: maximum", "ms", 12.5, "so", 21.0, 21.0, 12.0, 130.0),
        ("a: jitter", "ms", "≈ 2", "so", 1.0, 1.0, 2.0, 120.0),
        ("a: late", "cycles", None, "so", 0, 0, 1, 1),
    ]
    late = [a_run("live", 10, 130, 140, disturbed=(2,))]
    (line,) = lines_of("a", late, {"late": None}, late_from_ns=100 * MS)
    assert values(line) == (None, None, 1, 2), "those of disturbed cycles are counted"


def test_an_interval_holds_what_the_figure_is_when_blocks_are_drawn_again() -> None:
    """Of 20 blocks of 10 equal cycles: the mean's deviation is that of 20 values, not of 200."""
    levels = np.random.default_rng(0).normal(50, 5, 20)
    run = a_run("live", *np.repeat(levels, 10))
    (line,) = lines_of("a", [run], {"average": None})
    low, high = line.intervals["live_all"]
    assert low < levels.mean() < high
    of_blocks = 2 * 1.96 * levels.std() / np.sqrt(20)
    assert 0.6 * of_blocks < high - low < 1.2 * of_blocks
    turns = replace(run, block=np.repeat(np.arange(20), 10))
    (fixed,) = lines_of("a", [turns], {"average": None})
    assert fixed.intervals["live_all"] == (fixed.live, fixed.live), "each block is equal to itself"


def test_a_machine_that_stood_still_is_seen_by_its_stalls_alone() -> None:
    starts = pl.DataFrame({"time": [0, 4_000 * MS]})
    for stalls_ms, still in (([20.0, 19.0], False), ([20.0, 21.0], True), ([], False)):
        values = {"cpu": [0] * len(stalls_ms), "duration": [one * MS for one in stalls_ms]}
        events = {"machine_stall": pl.DataFrame(values), "callback_start": starts}
        assert stood_still(SimpleNamespace(events=events)) == still  # type: ignore[arg-type]


def test_measured_values_stay_when_nothing_is_measured(tmp_path: Path) -> None:
    live = replace(a_run("live", 10, 12, disturbed=(1,)), block=np.array([0, 1]), repeats=2)
    pictures, figures = [tmp_path / "x_live.png", tmp_path / "x_simulated.png"], {"maximum": 1.0}

    def saved(runs: list[Run], drawn: list[Path], of_ros: float | None = None) -> dict[str, Any]:
        lines = [*lines_of("a", runs, figures), Line("b", "ms", 1.0, 3.0, None, ros=of_ros)]
        path = save("x", "X", lines, runs=runs, pictures=drawn, folder=tmp_path)
        return dict(json.loads(path.read_text()))

    before = saved([live, a_run("simulated", 9), a_run("fast", 11)], pictures, of_ros=2.0)
    measured = earlier_runs("x", "live", "ros", "fast", folder=tmp_path)
    document = saved([a_run("simulated", 8, 8), *measured], pictures[1:])
    assert [
        tuple(line[one] for one in ("simulated", "live", "ros", "fast"))
        for line in document["lines"]
    ] == [(8.0, 10.0, None, 11.0), (3.0, None, 2.0, None)]
    assert document["lines"][0]["measured"] == before["lines"][0]["measured"]
    assert document["pictures"] == ["x_live.png", "x_simulated.png"]
    counted = {
        run["column"]: tuple(run[of] for of in ("cycles", "disturbed", "blocks", "repeats"))
        for run in document["runs"]
    }
    assert counted == {"live": (2, 1, 2, 2), "simulated": (2, 0, 1, 0), "fast": (1, 0, 1, 0)}
    rows = pl.read_parquet(tmp_path / "x.parquet")
    assert rows.filter(pl.col("column") == "live")["latency_ns"].to_list() == [10 * MS, 12 * MS]
    assert rows.filter(pl.col("column") == "simulated")["latency_ns"].to_list() == [8 * MS, 8 * MS]


def test_every_figure_of_the_page_can_be_recomputed_from_the_latencies() -> None:
    """Of the results that are in the repository: maximum, jitter and late outputs of all cycles."""
    checked = 0
    for path in sorted(RESULTS.glob("*.json")):
        document, rows = json.loads(path.read_text()), pl.read_parquet(path.with_suffix(".parquet"))
        for line in document["lines"]:
            name, _, what = line["what"].rpartition(": ")
            own = rows.filter(pl.col("run") == name, pl.col("latency_ns") >= 0)
            for of_column in OURS:
                column = f"{of_column}_all"
                ours = own.filter(pl.col("column") == of_column)["latency_ns"].to_numpy() / MS
                if line[column] is None or not ours.size:
                    continue
                of = {"maximum": ours.max(), "jitter": np.ptp(ours), "average": ours.mean()}
                if what in of:
                    assert line[column] == pytest.approx(of[what]), (path.name, line["what"])
                    checked += 1
    assert checked > 60


def test_the_page_has_every_number_the_reasons_once_and_a_summary(tmp_path: Path) -> None:
    lines = [
        Line("one", "ms", 100.0, 104.9, None, "the reason"),
        Line("two", "ms", "≈ 10", 9.4, None, "the reason"),
        Line("three", "", None, "words", None),
        Line("four", "ms", "≈ 0.2 per band", 0.5, 7.0),
        Line("five", "ms", 3.0, 3.0, None, no_evidence={"simulated": "simulated, the paper's"}),
    ]
    save("table_1", "Table 1", lines, notes="A note.", folder=tmp_path)
    page = render.page(tmp_path)
    assert "| Table 1 | 4 | 2 of 3 | 0 of 1 | – | – | – | " in page
    assert f"| one | ms | 100.0 | 104.9 |{' – |' * 7} (1) |" in page
    assert f"| two | ms | ≈ 10 | 9.40 |{' – |' * 7} (1) |" in page
    assert f"| three |  | – | words |{' – |' * 7}  |" in page
    assert f"| four | ms | ≈ 0.2 per band | 0.50 | – | 7.00 |{' – |' * 5}  |" in page
    assert f"| five | ms | 3.00 | 3.00 ○ |{' – |' * 7} (2) |" in page
    assert page.count("The reason.") == 1
    assert "(2) ○ simulated, the paper's" in page
    assert "The paper states 4 numbers" in page
    assert "2 of 3 simulated values are near, 0 of 1 live ones" in page
    assert "A note." in page
    assert "`experiments/table_2.py` failed" in page, "an experiment without results is named"


def test_an_experiment_that_fails_is_named_and_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.py").write_text("raise ValueError('no core left')")
    (tmp_path / "good.py").write_text("import sys; print('arguments', *sys.argv[1:])")
    monkeypatch.setattr(render, "HERE", tmp_path)
    monkeypatch.setattr(render, "EXPERIMENTS", ("bad", "good"))
    monkeypatch.setattr(render, "SHARED", ("good",))
    failed = render.run_all(["--simulated"], tmp_path / "recordings")
    assert failed == ["bad (exit code 1): ValueError: no core left"]
    assert f"arguments --simulated --keep {tmp_path}/recordings" in capfd.readouterr().out
