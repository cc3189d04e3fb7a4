"""Tables and figures show what there is, whatever it is called."""

import io
import shutil
from pathlib import Path

import pytest
from rich.console import Console

from chainshaper import compare_recordings, draw_distribution, draw_latency
from chainshaper.planning import Plan
from chainshaper.reporting.figures import draw_comparison
from chainshaper.reporting.latency import comparison_json, comparison_table
from chainshaper.reporting.overviews import plan_table
from chainshaper.reporting.tables import ResultTable
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Comparison


def _text(table: ResultTable) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.fixture
def comparison(tmp_path: Path, unshaped: Recording, shaped: Recording) -> Comparison:
    """Before and after, the first in a folder whose name looks like Rich's markup."""
    odd = tmp_path / "before [bold]"
    shutil.copytree(unshaped.path, odd)
    return compare_recordings([odd, shaped])


def test_brackets_are_shown_and_not_taken_for_markup(comparison: Comparison, plan: Plan) -> None:
    text = _text(comparison_table(comparison))
    assert "End-to-end latency of /t1../t3 [ms]" in text
    assert "before [bold]" in text
    assert "slots [21.000, 22.000)" in text
    assert "[21.000, 22.000)" in _text(plan_table(plan))


def test_a_comparison_names_what_it_compares(comparison: Comparison) -> None:
    values = comparison_json(comparison)
    assert [Path(entry["recording"]).name for entry in values["recordings"]] == [
        "before [bold]",
        "after",
    ]
    assert values["chain"] == "/t1../t3"


def test_figures_are_drawn_and_never_over_others(comparison: Comparison, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "figures"
    for path in draw_comparison(comparison.measurements, folder):
        assert path.read_bytes().startswith(b"\x89PNG")
    drawn = (folder / "latency.png").read_bytes()
    with pytest.raises(InputError, match=r"latency.png exists already and is not overwritten"):
        draw_comparison(comparison.measurements, folder)
    assert (folder / "latency.png").read_bytes() == drawn


def test_a_figure_on_a_full_disk_leaves_nothing(comparison: Comparison, full_disk: Path) -> None:
    for draw in (draw_latency, draw_distribution):
        path = full_disk / "figure.png"
        with pytest.raises(OperationError, match=f"{path}: the file cannot be written.*No space"):
            draw(comparison.measurements, path)
        assert not path.exists()
