"""Tables and figures show what there is, whatever its name, but what no plan governed."""

import io
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from command_line import called, json_of
from known_run import LATENCY_NS, MS, PERIOD_NS, known_plan, known_run
from rich.console import Console

from chainshaper import (
    compare_recordings,
    draw_distribution,
    draw_latency,
    measure_latency,
    open_recording,
)
from chainshaper.planning import ChainPlan
from chainshaper.reporting import figures
from chainshaper.reporting.latency import comparison_json, comparison_table
from chainshaper.reporting.overviews import plan_table
from chainshaper.reporting.tables import ResultTable
from chainshaper.values.recording import InForceInfo, Recording


def _text(table: ResultTable) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_brackets_are_shown_and_not_taken_for_markup(
    tmp_path: Path, simulated: Recording, simulated_shaped: Recording, plan: ChainPlan
) -> None:
    """Before and after, the first in a folder whose name looks like Rich's markup."""
    odd = shutil.copytree(simulated.path, tmp_path / "before [bold]")
    comparison = compare_recordings([odd, simulated_shaped])
    text = _text(comparison_table(comparison))
    for words in ("End-to-end latency of /t1../t3 [ms]", "before [bold]", "slots [21.000, 22.000)"):
        assert words in text
    assert "[21.000, 22.000)" in _text(plan_table(plan))
    values = comparison_json(comparison)
    names = [Path(entry["recording"]).name for entry in values["recordings"]]
    assert (values["chain"], names) == ("/t1../t3", ["before [bold]", "after"])


@pytest.mark.parametrize(
    ("since", "until", "starts", "text"),
    [
        (0, None, [0, 1, 2, 3], None),
        (PERIOD_NS, None, [1, 2, 3], "the first 99 ms, before the plan came into force"),
        (PERIOD_NS, 3 * PERIOD_NS, [1, 2], "the first 99 ms, before the plan came into "),
        (0, 3 * PERIOD_NS, [0, 1, 2], "the last "),
        (9_000 * MS, None, [], "the first "),
    ],
)
def test_what_no_plan_governed_is_left_out(
    since: int, until: int | None, starts: list[int], text: str | None, tmp_path: Path
) -> None:
    in_force = InForceInfo(since_ns=since, until_ns=until)
    recording = known_run(tmp_path / "known", cycles=4, overran=(0,), in_force=in_force)
    measured = measure_latency(recording)
    cycles = measured.analysis.traversals
    assert cycles["start"].to_list() == [cycle * PERIOD_NS + MS for cycle in starts]
    overruns = {"publish": 1} if 0 in starts else {}
    assert (measured.overruns, measured.analysis.statistics.late) == (overruns, len(overruns))
    values = json_of("latency", recording.path)
    assert values["in_force"] == {"since_ns": since, "until_ns": until}
    assert values["count"] == len(starts)
    shown = " ".join(called("latency", recording.path).out.split())
    if text is None:
        assert "left out" not in shown
    else:
        assert text in (measured.left_out.text or "")
        assert "left out" in shown
        compared = called("compare", recording.path, recording.path).out
        assert "known: left out" in " ".join(compared.split())


def test_over_all_cycles_late_outputs_maximum_and_jitter_are_shown(tmp_path: Path) -> None:
    """The last output arrives at the end of its slot, and leaves at once."""
    recording = known_run(tmp_path / "known", cycles=2, overran=(1,))
    longest = 31 * MS
    values = json_of("latency", recording.path)
    assert (values["late"], values["max_all_ns"]) == (1, longest)
    assert values["jitter_all_ns"] == longest - LATENCY_NS
    assert values["undisturbed"]["late"] == 1
    shown = called("compare", recording.path, recording.path).out
    assert "came late" in shown
    assert "1 of 2" in shown


def test_a_recording_from_before_says_nothing_and_is_read_whole(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known")
    file = recording.path / "recording.json"
    file.write_text(file.read_text().replace('"in_force": null', '"was_not_there": null'))
    measured = measure_latency(open_recording(recording.path))
    assert measured.analysis.statistics.count == 3
    assert measured.left_out.text is None


def test_publish_slots_are_shaded_where_outputs_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under LET in the slot [30 ms, 31 ms) of the next cycle, 100 ms later."""
    drawn: list[Any] = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, _: drawn.append(figure))
    let = known_plan().model_copy(update={"policy": "let-per-chain"})
    draw_distribution([replace(measure_latency(known_run(tmp_path / "known")), plan=let)], "")
    (slot,) = drawn[0].axes[0].patches
    assert (slot.get_x(), slot.get_width()) == pytest.approx((130, 1))


def test_drawing_leaves_the_callers_backend_and_style(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a style that may be others'
    monkeypatch.setattr(mpl, "matplotlib_fname", lambda: str(tmp_path / "matplotlibrc"))
    before = mpl.get_backend()
    with mpl.rc_context({"lines.linewidth": 7}):
        mpl.use("svg")
        try:
            draw_latency([measure_latency(known_run(tmp_path / "known"))], tmp_path / "latency.png")
            assert (mpl.get_backend(), mpl.rcParams["lines.linewidth"]) == ("svg", 7)
        finally:
            mpl.use(before)
