"""What experiments hand in, and the page that is made from it."""

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import render
from results import MS, Line, Run, Value, lines_of, save


def a_run(live: bool, *latencies_ms: float, disturbed: tuple[int, ...] = ()) -> Run:
    marks = np.zeros(len(latencies_ms), np.bool_)
    marks[list(disturbed)] = True
    return Run("a", live, (np.array(latencies_ms) * MS).astype(np.int64), marks)


def test_figures_leave_out_what_was_disturbed_incomplete_or_late() -> None:
    runs = [a_run(True, 10, 12, 90, -1e-6, 130, disturbed=(2,)), a_run(False, 20, 21)]
    paper: dict[str, Value] = {"average": 11, "maximum": 12.5, "jitter": "≈ 2", "late": None}
    lines = lines_of("a", runs, paper, late_from_ns=100 * MS, why="so")
    assert lines == [
        Line("a: average", "ms", 11, 20.5, 11.0, "so"),
        Line("a: maximum", "ms", 12.5, 21.0, 12.0, "so"),
        Line("a: jitter", "ms", "≈ 2", 1.0, 2.0, "so"),
        Line("a: late", "cycles", None, 0, 1, "so"),
    ]


def test_a_jitter_is_not_told_from_the_few_cycles_that_were_undisturbed() -> None:
    """Two calm cycles out of five have no jitter to speak of; all five have one of 3 ms."""
    run = a_run(True, 10, 10, 12, 13, 11, disturbed=(2, 3, 4))
    (line,) = lines_of("a", [run], {"jitter": 1.0}, why="so")
    assert line.live == 3.0
    assert line.why == "so; live over all cycles, as 3 of 5 are marked as disturbed"
    calm = a_run(True, 10, 10, 12, 13, 11, disturbed=(2, 3))
    assert lines_of("a", [calm], {"jitter": 1.0})[0].live == 1.0


def test_live_values_stay_when_nothing_is_run_live(tmp_path: Path) -> None:
    live, first, second = a_run(True, 10, 12, disturbed=(1,)), a_run(False, 9), a_run(False, 8, 8)
    pictures = [tmp_path / "x_live.png", tmp_path / "x_simulated.png"]
    save(
        "x", "X", [Line("a", "ms", 1.0, 9.0, 10.0)], runs=[live, first], pictures=pictures,
        folder=tmp_path,
    )  # fmt: skip
    earlier = json.loads((tmp_path / "x.json").read_text())
    path = save(
        "x", "X", [Line("a", "ms", 1.0, 8.0, None)], runs=[second], pictures=pictures[1:],
        folder=tmp_path,
    )  # fmt: skip

    document = json.loads(path.read_text())
    assert [(line["simulated"], line["live"]) for line in document["lines"]] == [(8.0, 10.0)]
    assert document["lines"][0]["measured"] == earlier["lines"][0]["measured"]
    assert document["pictures"] == ["x_live.png", "x_simulated.png"]
    counted = {run["live"]: (run["cycles"], run["disturbed"]) for run in document["runs"]}
    assert counted == {True: (2, 1), False: (2, 0)}
    rows = pl.read_parquet(tmp_path / "x.parquet")
    assert rows.filter("live")["latency_ns"].to_list() == [10 * MS, 12 * MS]
    assert rows.filter(~pl.col("live"))["latency_ns"].to_list() == [8 * MS, 8 * MS]


def test_the_page_has_every_number_the_reasons_once_and_a_summary(tmp_path: Path) -> None:
    lines = [
        Line("one", "ms", 100.0, 104.9, None, "the reason"),
        Line("two", "ms", "≈ 10", 9.4, None, "the reason"),
        Line("three", "", None, "words", None),
    ]
    save("table_1", "Table 1", lines, notes="A note.", folder=tmp_path)
    page = render.page(tmp_path)
    assert "| Table 1 | 2 | 1 of 2 | – |  |" in page
    assert "| one | ms | 100.0 | 104.9 | – | (1) |" in page
    assert "| two | ms | ≈ 10 | 9.40 | – | (1) |" in page
    assert "| three |  | – | words | – |  |" in page
    assert page.count("The reason.") == 1
    assert "A note." in page
    assert "`experiments/table_2.py` failed" in page, "an experiment without results is named"


def test_an_experiment_that_fails_is_named_and_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.py").write_text("raise ValueError('no core left')")
    (tmp_path / "good.py").write_text("import sys; print('arguments', *sys.argv[1:])")
    monkeypatch.setattr(render, "HERE", tmp_path)
    monkeypatch.setattr(render, "EXPERIMENTS", ("bad", "good"))
    assert render.run_all(["--simulated"]) == ["bad (exit code 1): ValueError: no core left"]
    assert "arguments --simulated" in capfd.readouterr().out
