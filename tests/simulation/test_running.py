"""A whole sweep: its frame, who computes it, and what ends it half-way."""

import fcntl
import json
import signal
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from command_line import Running
from processes import wait_for
from quick_chain import quick_chain

from chainshaper import sweep
from chainshaper.flow.sweep import FIGURES, rows_beside
from chainshaper.values.errors import InputError, OperationError
from chainshaper.workload.description import Application, application_as_written

AXES: dict[str, list[Any]] = {"bands": [1, 2], "interference": ["0ms", "10ms"]}
CYCLES = 50
MANY = "200000"


def varying() -> Application:
    return quick_chain(*[{"uniform": ["1ms", "6ms"]}] * 2)


def swept(output: Path, axes: Any = None, **wishes: Any) -> pl.DataFrame:
    """A short sweep, by this process."""
    return sweep(varying(), axes or AXES, output, **{"cycles": CYCLES, "workers": 1, **wishes})


def compared(frame: pl.DataFrame) -> pl.DataFrame:
    """A frame without what a machine's mood decides."""
    return frame.drop("seconds")


def test_the_frame_has_axes_and_figures_and_is_what_the_file_has(tmp_path: Path) -> None:
    axes = {**AXES, "policy": ["shaped"], "max_gap": [None]}
    frame = swept(tmp_path / "out.parquet", axes)
    names = ["bands", "interference_ns", "policy", "max_gap_ns", "cycles", "seed"]
    assert frame.columns == [*names, *FIGURES]
    assert frame["bands"].to_list() == [1, 1, 2, 2]
    assert frame["interference_ns"].to_list() == [0, 10_000_000] * 2
    assert frame["max_gap_ns"].dtype == pl.Int64
    assert set(frame["seed"]) == {7}
    assert pl.read_parquet(tmp_path / "out.parquet").equals(frame)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.parquet"]


def test_rows_do_not_depend_on_the_order_of_axes_or_on_who_computes_them(tmp_path: Path) -> None:
    reference = compared(swept(tmp_path / "one.parquet"))
    backwards = {name: AXES[name][::-1] for name in reversed(AXES)}
    turned = compared(swept(tmp_path / "turned.parquet", backwards))
    assert turned.select(reference.columns).sort("bands", "interference_ns").equals(reference)
    assert compared(swept(tmp_path / "two.parquet", workers=2)).equals(reference)


def test_seeds_draw_other_execution_times_and_what_cannot_be_does_not_end_the_others(
    tmp_path: Path,
) -> None:
    frame = swept(tmp_path / "out.parquet", {"seed": [1, 2], "policy": ["none"]})
    assert frame["seed"].to_list() == [1, 2]
    assert frame["mean_ns"].n_unique() == 2
    axes = {"nodes.first.callbacks.0.execution": [{"constant": "60ms"}, {"constant": "1ms"}]}
    frame = swept(tmp_path / "impossible.parquet", axes)
    assert "do not fit into the cycle" in frame["error"][0]
    assert frame["error"][1] is None
    assert frame["nodes.first.callbacks.0.execution"][0] == "{constant: 60ms}"


def _first_rows(output: Path, count: int) -> Path:
    """The file of a sweep that was ended after some rows."""

    def end(share: float, _: str) -> None:
        if share >= count / 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        swept(output, progress=end)
    return rows_beside(output)


def test_a_sweep_that_was_ended_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    output = tmp_path / "out.parquet"
    rows = _first_rows(output, 2)
    assert not output.exists()
    with rows.open("a") as file:
        file.write('{"number": 2, "row": {"mean_')  # a crash in the middle of writing
    first = json.loads(rows.read_text().splitlines()[1])
    assert first["number"] == 0
    marked = rows.read_text().replace(f'"mean_ns": {first["row"]["mean_ns"]}', '"mean_ns": 1', 1)
    rows.write_text(marked)  # so it was not computed again
    shares: list[float] = []
    frame = swept(output, progress=lambda share, _: shares.append(share))
    assert shares == [0.5, 0.75, 1.0]
    assert frame["mean_ns"][0] == 1
    reference = compared(swept(tmp_path / "reference.parquet"))
    assert compared(frame)[1:].equals(reference[1:])
    assert not rows.exists()


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"cycles": 51}, "the number of cycles changed since"),
        ({"axes": {"bands": [1, 2, 3]}}, "the axes changed since"),
        ({"seed": 8}, "the application or the seed changed since"),
    ],
)
def test_rows_of_another_sweep_are_not_mixed_in(
    tmp_path: Path, wishes: dict[str, Any], said: str
) -> None:
    output = tmp_path / "out.parquet"
    rows = _first_rows(output, 1)
    before = rows.read_bytes()
    with pytest.raises(InputError, match=said) as refused:
        swept(output, **wishes)
    assert "has 1 finished rows of another sweep" in str(refused.value)
    assert rows.read_bytes() == before
    assert not output.exists()


def test_rows_that_are_in_use_or_something_else_are_left_alone(tmp_path: Path) -> None:
    for mine in (b"my notes\n", b'{"a\xff": 1}\nand more'):  # a text, and none
        rows_beside(tmp_path / "mine.parquet").write_bytes(mine)
        with pytest.raises(InputError, match="these are no rows of a sweep"):
            swept(tmp_path / "mine.parquet")
        assert rows_beside(tmp_path / "mine.parquet").read_bytes() == mine
    rows = _first_rows(tmp_path / "out.parquet", 1)
    with rows.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OperationError, match="another process works on this sweep"):
            swept(tmp_path / "out.parquet")


def test_nothing_is_overwritten_and_nothing_begun_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "out.parquet").write_text("mine")
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        swept(tmp_path / "out.parquet")
    with pytest.raises(InputError, match=r"write to a file that ends in \.parquet"):
        swept(tmp_path / "out.csv")
    with pytest.raises(InputError, match="0 workers compute nothing"):
        swept(tmp_path / "other.parquet", workers=0)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.parquet"]


def test_a_full_disk_is_named(full_disk: Path) -> None:
    with pytest.raises(OperationError, match="finished rows cannot be written"):
        swept(full_disk / "out.parquet")


@pytest.fixture
def description(tmp_path: Path) -> Path:
    path = tmp_path / "application.yaml"
    path.write_text(json.dumps(application_as_written(varying())))  # JSON is YAML
    return path


def _under_way(description: Path, output: Path, *options: str) -> Running:
    """A sweep of forty long points, of which at least one is finished."""
    grid = ("--vary", "bands=1..4", "--vary", "seed=1..10", "--cycles", MANY)
    running = Running.start("sweep", description, *grid, "-o", output, *options)
    rows = rows_beside(output)
    wait_for(lambda: rows.exists() and rows.read_bytes().count(b"\n") > 1, "a row", seconds=60)
    return running


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_ended_it_leaves_its_rows_and_no_processes(
    number: signal.Signals, description: Path, tmp_path: Path
) -> None:
    running = _under_way(description, tmp_path / "out.parquet", "--workers", "2")
    running.process.send_signal(number)
    finished = running.end()
    wait_for(lambda: not running.nodes(), f"the end of {running.nodes()}")
    rows = rows_beside(tmp_path / "out.parquet")
    assert 1 <= rows.read_bytes().count(b"\n") - 1 < 40
    assert not (tmp_path / "out.parquet").exists()
    if number == signal.SIGINT:
        assert finished.code not in (0, -signal.SIGINT)
        assert f"finished points are in {rows}" in finished.err
        assert "Traceback" not in finished.err
