"""The screen of a comparison: it fits, shows what is there, and claims nothing else."""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

from chainshaper.analysis import LatencyStatistics
from chainshaper.reporting.latency import write_comparison_json
from chainshaper.reporting.screen import (
    WIDTH,
    TimeAxis,
    compared_before,
    comparison_lines,
    figure_rows,
    unplanned_lines,
    verdict_lines,
)
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Comparison, Measurement, compare_recordings
from chainshaper.verify.promises import OutputsDue

MS = 1_000_000


@pytest.fixture(scope="module")
def comparison(simulated: Recording, simulated_shaped: Recording) -> Comparison:
    """The small chain as it is, and shaped: its slot begins at 21 ms."""
    return compare_recordings([simulated, simulated_shaped])


def text_of(lines: Sequence[Text]) -> str:
    console = Console(width=WIDTH, file=io.StringIO())
    for line in lines:
        console.print(line)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def stalled(measurement: Measurement, calm: int, disturbed: int) -> Measurement:
    """The measurement as if the machine had hit so many of its cycles."""

    def with_counts(statistics: LatencyStatistics, count: int) -> LatencyStatistics:
        return replace(statistics, count=count, disturbed=disturbed)

    analysis = replace(
        measurement.analysis,
        undisturbed=with_counts(measurement.analysis.undisturbed, calm),
        statistics=with_counts(measurement.analysis.statistics, calm + disturbed),
    )
    return replace(measurement, analysis=analysis, longest_stall_ns=14_000_000)


def test_a_comparison_fits_on_a_screen(comparison: Comparison) -> None:
    lines = text_of(comparison_lines(comparison)).splitlines()
    assert len(lines) <= 18
    assert max(map(len, lines)) <= WIDTH
    before, after = (measured.analysis.undisturbed for measured in comparison.measurements)
    assert before.mean_ns is not None
    assert before.jitter_ns is not None
    rows = {line.split()[0]: line for line in lines if line.strip()}
    assert f"{before.mean_ns / MS:.1f} ms" in rows["average"]
    assert "21.0 ms" in rows["average"]
    assert "the price" in rows["average"]
    assert f"{before.jitter_ns / MS:.1f} ms" in rows["jitter"]
    assert f"0 of {after.count}" in rows["late"]
    assert rows["✓"].strip() == "✓ As planned: every output at 21.0 ms, none late."


def test_no_gain_is_claimed_that_is_not_there(comparison: Comparison) -> None:
    """The same recording twice, and in the wrong order."""
    before, after = comparison.measurements
    assert "the same" in text_of(figure_rows(before, before))
    statistics = replace(after.analysis.statistics, jitter_ns=100_000)
    shaped = replace(after, analysis=replace(after.analysis, statistics=statistics))
    assert "times more" in text_of(figure_rows(shaped, before))
    assert "times less" in text_of(figure_rows(before, shaped))


def test_where_stalls_left_no_cycle_a_broken_promise_says_nothing(comparison: Comparison) -> None:
    before, after = (stalled(measured, 3, 97) for measured in comparison.measurements)
    assert after.prediction is not None
    judged = replace(after.prediction, outputs=OutputsDue(100, 40, promised=0.01))
    assert judged.broken
    broken = replace(after, prediction=judged)
    said = " ".join(text_of(verdict_lines(before, broken)).split())
    assert "Nothing can be said: stalls of the machine left 3 cycles undisturbed" in said
    assert "chainshaper doctor" in said
    assert "stood still for up to 14 ms, in 97 of 100 cycles before and 97 of 100 after" in said
    assert "✓" not in said
    calm = replace(stalled(comparison.measurements[1], 300, 20), prediction=judged)
    assert "Not as planned" in text_of(verdict_lines(before, calm))


def test_without_a_plan_the_machine_is_to_blame_and_the_reason_is_said(
    comparison: Comparison,
) -> None:
    said = text_of(unplanned_lines(comparison.measurements[0], "latencies do not fit"))
    assert max(map(len, said.splitlines())) <= WIDTH
    assert "no plan could be made on this machine: latencies do not fit" in " ".join(said.split())


@pytest.mark.parametrize(
    ("latencies_ms", "first_ms", "ticks"),
    [
        ([33.1, 71.2], 30, ["30", "40", "50", "60", "70"]),
        ([72.24, 72.27], 72.24, ["72.24", "72.26", "72.28"]),
        ([5.0, 905.0], 0, ["0", "200", "400", "600", "800"]),
    ],
)
def test_an_axis_has_round_numbers_and_room_for_all(
    latencies_ms: list[float], first_ms: float, ticks: list[str]
) -> None:
    latencies = np.array([round(latency * MS) for latency in latencies_ms])
    axis = TimeAxis.over(latencies)
    assert axis.first_ns == round(first_ms * MS)
    shown = axis.scale().removesuffix(" ms").split()
    assert set(ticks) >= set(shown)
    assert len(shown) >= 2
    drawn = axis.histogram(latencies)
    assert sum(character != " " for character in drawn) == 2


def test_figures_of_an_earlier_comparison_stand_beside(
    comparison: Comparison, tmp_path: Path
) -> None:
    file = write_comparison_json(comparison, tmp_path)
    shown = [str(line) for line in compared_before(file)]
    first = comparison.measurements[0].analysis.undisturbed
    assert first.jitter_ns is not None
    assert f"jitter {first.jitter_ns / 1e6:.1f} ms → " in shown[0]
    assert shown[1].strip() == f"({tmp_path})"
    for text in ("", "{}", '{"recordings": []}', '{"recordings": [{}, {}]}'):
        file.write_text(text)
        assert not compared_before(file)
    assert not compared_before(tmp_path / "nothing")


def test_the_histogram_is_as_high_as_outputs_are_many() -> None:
    axis = TimeAxis(0, MS, 10 * MS)
    drawn = axis.histogram(np.array([2] * 800 + [3] * 400 + [4]) * MS)
    assert drawn.rstrip() == "  █▄·"
    assert axis.histogram(np.array([7, 7]) * MS).strip() == "┃"
