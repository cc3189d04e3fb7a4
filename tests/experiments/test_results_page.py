"""What experiments hand in, and the page that is made from it."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import claim_pictures
import numpy as np
import polars as pl
import pytest
import render
import results
import table_1
from claims import CLAIMS, Claim, Judged, Part, judged, most_within, two_runs, verdict_of
from configurations import stood_still
from results import (
    MS,
    OURS,
    PICTURES,
    RESULTS,
    Column,
    Line,
    Run,
    Value,
    earlier_runs,
    lines_from,
    lines_of,
    save,
)


def a_run(
    column: Column, *latencies_ms: float, disturbed: tuple[int, ...] = (), name: str = "a"
) -> Run:
    marks = np.zeros(len(latencies_ms), np.bool_)
    marks[list(disturbed)] = True
    measured = "" if column == "simulated" else "2026-11-28, a machine"
    latency = (np.array(latencies_ms) * MS).astype(np.int64)
    return Run(name, column, latency, marks, measured=measured)


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


def test_the_jitter_at_the_receiver_stands_beside_that_of_the_publication() -> None:
    """Where a run has it; an output that nobody received is not in it."""
    sent = a_run("simulated", 10, 10, 10, 11)
    received = (np.array([11, 14, -1e-6, 13]) * MS).astype(np.int64)
    lines = lines_of("a", [replace(sent, reception_ns=received)], {"jitter": 1.0})
    assert [(line.what, line.simulated_all) for line in lines] == [
        ("a: jitter", 1.0),
        ("a: jitter, received", 3.0),
    ]
    assert len(lines_of("a", [sent], {"jitter": 1.0})) == 1


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


def test_measured_runs_stay_when_nothing_is_measured(tmp_path: Path) -> None:
    live = replace(
        a_run("live", 10, 12, disturbed=(1,)),
        block=np.array([0, 1]),
        repeats=2,
        reception_ns=np.array([11 * MS, -1]),
        facts={"slots": "[0,2)"},
    )
    pictures = [tmp_path / "x_live.png", tmp_path / "x_simulated.png"]

    def lines(runs: Sequence[Run]) -> list[Line]:
        return lines_of("a", runs, {"maximum": 1.0})

    runs = [live, a_run("simulated", 9), replace(a_run("fast", 11), measured="")]
    save("x", "X", lines, runs=runs, pictures=pictures, folder=tmp_path)
    measured = earlier_runs("x", "live", "ros", "fast", folder=tmp_path)
    kept, fast = measured
    assert (kept.measured, kept.facts, kept.repeats) == (live.measured, live.facts, 2)
    for of in ("latency_ns", "disturbed", "block", "reception_ns"):
        assert getattr(kept, of).tolist() == getattr(live, of).tolist(), of
    assert "Linux" in fast.measured and fast.reception_ns is None
    again = [a_run("simulated", 8, 8), *measured]
    path = save("x", "X", lines, runs=again, pictures=pictures[1:], folder=tmp_path)
    document = json.loads(path.read_text())
    (line,) = document["lines"]
    assert [line[column] for column in OURS] == [8.0, 10.0, None, 11.0]
    assert line["machines"] == {"live": live.measured, "fast": fast.measured}
    assert document["pictures"] == ["x_live.png", "x_simulated.png"]


def test_every_line_of_the_results_is_computed_from_their_latencies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of every experiment, in every column: nothing that is written comes from elsewhere."""
    monkeypatch.setattr(results, "RESAMPLES", 2)  # intervals are looked at below
    checked = 0
    for name in render.EXPERIMENTS:
        written = json.loads((RESULTS / f"{name}.json").read_text())["lines"]
        made = lines_from(name, earlier_runs(name, *OURS))
        assert [line.what for line in made] == [line["what"] for line in written], name
        for line, known in zip(made, written, strict=True):
            for column in (one for of in OURS for one in (of, f"{of}_all")):
                value, before = getattr(line, column), known[column]
                if isinstance(value, float):
                    value, before = pytest.approx(value), float(before)
                assert before == value, (name, line.what, column)
                checked += before is not None
    assert checked > 1_000


def test_intervals_of_the_results_are_computed_from_their_latencies() -> None:
    written = json.loads((RESULTS / "figure_8.json").read_text())["lines"]
    made = lines_from("figure_8", earlier_runs("figure_8", *OURS))
    for line, known in zip(made, written, strict=True):
        assert {key: list(ends) for key, ends in line.intervals.items()} == known["intervals"]


def test_the_page_is_what_the_results_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it but the intervals, which take a minute."""
    monkeypatch.setattr(results, "RESAMPLES", 2)
    interval = re.compile(r" \(-?[\d.]+–-?[\d.]+\)")
    written = interval.sub("", render.PAGE.read_text())
    assert interval.sub("", render.page()).splitlines() == written.splitlines()
    for picture in re.findall(r"\(pictures/([\w.]+)\)", written):
        assert (PICTURES / picture).exists(), picture


def test_tables_have_values_of_one_machine_in_a_row() -> None:
    """Each row of a table, and of the claims, has the letter of at most one."""
    page = render.PAGE.read_text()
    assert page.index("| the paper's claim |") < page.index("## The tables")
    rows = [line.split(" | ") for line in page.splitlines() if line.count(" | ") in (7, 8)]
    assert len(rows) > 200
    for row in rows:
        letters = [cell for cell in row if re.fullmatch("[A-H]", cell.strip())]
        assert len(letters) <= 1, row


def save_table_1(folder: Path, *runs: Run) -> None:
    save("table_1", "Table 1: X", table_1.lines, runs=runs, notes="A note.", folder=folder)


def test_a_table_has_a_row_for_each_machine_and_each_reason_once(tmp_path: Path) -> None:
    fifo, servers = (table_1.run_name(of, 40) for of in ("SCHED_FIFO", "five servers"))
    elsewhere = replace(a_run("fast", 40, 72, name=fifo), measured="2026-11-28, another machine")
    live = a_run("live", 70, 80, 178, name=servers)
    live = replace(live, latency_ns=np.append(live.latency_ns, -1), disturbed=np.zeros(4, np.bool_))
    save_table_1(tmp_path, a_run("live", 40, 65, name=fifo), elsewhere, live)
    page = render.page(tmp_path)
    rows = [line for line in page.splitlines() if line.startswith(f"| {fifo}: jitter |")]
    assert len(rows) == 1 and " 25.0 " in rows[0] and rows[0].count(" | A | ") == 1
    assert "| ″ |  |  |  |  |  | 32.0 (32.0–32.0) | B |  |" in page
    assert f"| {servers}: maximum | ms | ≈ 80 | – | 178.0 " in page and ", calm 80.0 ○ |" in page
    assert page.count("The paper's grows with the load") <= 1
    assert "A note." in page
    assert "`experiments/table_2.py` failed" in page, "an experiment without results is named"
    assert "| 4 | 1, 0 | 0 | 1, under way at the end | 2026-11-28 A |" in page
    assert "all these cycles are the last of their block" in page


def test_a_small_number_of_the_paper_is_a_bound_and_another_within_five_percent() -> None:
    lines = [
        Line("a", "ms", 100.0, None, None, live_all=104.9),
        Line("b", "ms", "≈ 10", None, None, live_all=9.4),
        Line("c", "ms", "≈ 0.2", None, None, live_all=0.26),
        Line("d", "ms", "≈ 0.2 per band", None, None, live_all=0.05),
        Line("e", "ms", 3.0, None, None, live_all=3.0, no_evidence={"live": "the paper's"}),
        Line("f", "ms", "words", None, None, live_all=3.0),
    ]
    assert render._near(lines, "live") == [True, False, False, True]


def two_latencies(before: Sequence[float], after: Sequence[float], *parts: Part) -> list[str]:
    runs = {
        name: a_run("live", *latencies, name=name)
        for name, latencies in (("before", before), ("after", after))
    }
    made = two_runs("before", "after", *parts)(runs, "live")
    return [f"{one.verdict}: {one.text}" for one in made]


def test_a_claim_is_judged_by_its_own_ratio_over_all_cycles() -> None:
    """By hand: from 40 … 90 ms to 79 … 89 ms, jitter 50 → 10 ms is −80 %, the maximum −1.1 %."""
    jitter = Part("jitter", "effect", -0.72)
    assert two_latencies((40, 90), (79, 89, -1e-6), jitter) == ["holds: jitter −80.0 %"]
    assert two_latencies((40, 90), (70, 89), jitter) == ["partly: jitter −62.0 %"]
    assert two_latencies((40, 90), (50, 89), jitter) == ["not: jitter −22.0 %"]
    price = Part("maximum", "price", 0.02)
    for longest, verdict in ((102.4, "holds"), (104.4, "partly"), (104.6, "not")):
        (text,) = two_latencies((50, 100), (60, longest), price)
        assert text.startswith(verdict), text
    assert two_latencies((50, 100), (50, 99), Part("maximum", "equal")) == ["holds: maximum −1.0 %"]


def test_half_a_millisecond_does_not_hide_a_claim_of_a_fifth() -> None:
    """One output of 100 behind it is partly, of ten not; what was taken over and fails counts."""
    constant = Part("jitter", "constant", 0.2)
    assert two_latencies((40, 90), (91, 91.24), constant) == ["holds: jitter 50.0 → 0.24 ms"]
    late = (*[91.0] * 99, 91.7)
    assert two_latencies((40, 90), late, constant) == [
        "partly: jitter 50.0 → 0.70 ms (99 of 100 within 0.25)"
    ]
    (text,) = two_latencies((40, 90), late[-10:], constant)
    assert text.startswith("not")
    taken = replace(constant, taken_over=("live",))
    assert two_latencies((40, 90), (91, 91), taken)[0].startswith("taken over")
    assert two_latencies((40, 90), late[-10:], taken)[0].startswith("not")


def test_outputs_that_are_near_each_other_are_counted() -> None:
    latency = (np.array([10.0, 10.2, 10.3, 50.0, 50.1, 50.2, 50.3]) * MS).astype(np.int64)
    assert most_within(latency, 0.2) == 3
    assert most_within(latency, 0.3) == 4


def test_the_verdict_is_of_what_was_not_taken_over() -> None:
    def of(*verdicts: str) -> str:
        return verdict_of([Judged("", verdict) for verdict in verdicts])  # type: ignore[arg-type]

    assert of("holds", "taken over") == "holds"
    assert of("holds", "not") == of("partly") == of("partly", "not") == "partly"
    assert of("not", "not") == "not"
    assert of("taken over") == "taken over"


def claim_of(key: str) -> Claim:
    (claim,) = (claim for claim in CLAIMS if claim.key == key)
    return claim


def test_claims_are_about_runs_that_there_are() -> None:
    """Each has a number in some column, and a picture."""
    for claim in CLAIMS:
        runs = earlier_runs(claim.experiment, *OURS)
        assert judged(claim, runs), claim.key
        assert set(claim.runs) <= {run.name for run in runs}, claim.key
        for picture in claim_pictures.pictures_of(claim):
            assert (PICTURES / picture).exists(), picture


def test_a_late_output_is_in_its_claim() -> None:
    """Live, one of 320 outputs of the asynchronous chain came a cycle later."""
    runs = earlier_runs("figure_8", *OURS)
    live = judged(claim_of("asynchronous"), runs)["live"]
    assert "→ 100.08 ms (319 of 320 within 0.25)" in live[0].text
    assert [one.verdict for one in live[:2]] == ["partly", "not"]


def test_a_picture_has_all_columns(tmp_path: Path) -> None:
    claim = replace(claim_of("one_band"), runs=("a",))
    path = claim_pictures.draw_claim(claim, [a_run("live", 1, 2, -1e-6)], tmp_path / "x.png")
    assert path.stat().st_size > 5_000


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
