"""`chainshaper sweep` as a person or a script uses it."""

from pathlib import Path

from command_line import called, json_of, refused

PNG = b"\x89PNG\r\n"


def test_a_table_a_picture_and_a_file(application_file: Path, tmp_path: Path) -> None:
    output, picture = tmp_path / "out.parquet", tmp_path / "out.png"
    finished = called(
        *("sweep", application_file, "--cycles", "20", "--workers", "1", "-o", output),
        *("--vary", "bands=1,40", "--vary", "epsilon=0,1ms", "--draw", picture),
    )
    assert finished.code == 0, finished
    lines = finished.out.splitlines()
    assert lines[-2:] == [str(picture), str(output)]
    assert sum("failed" in line for line in lines) == 2
    assert "note: " in finished.err, "why they failed"
    assert picture.read_bytes().startswith(PNG)
    assert output.is_file()


def test_json_has_all_rows_in_nanoseconds(application_file: Path, tmp_path: Path) -> None:
    first, second = json_of(
        *("sweep", application_file, "--cycles", "20", "--workers", "1"),
        *("--vary", "epsilon=1ms,2ms", "-o", tmp_path / "out.parquet"),
    )
    assert (first["epsilon_ns"], second["epsilon_ns"]) == (1_000_000, 2_000_000)
    assert second["mean_ns"] - first["mean_ns"] == 1_000_000
    assert first["error"] is None
    assert first["per_band"][0]["jitter_ns"] == first["band_jitter_ns"]


def test_a_plan_is_in_force_at_all_points(application_file: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    recording = tmp_path / "recording"
    assert called("simulate", application_file, "-o", recording, "--cycles", "20").code == 0
    assert called("plan", recording, "-o", plan).code == 0
    early, late = json_of(
        *("sweep", application_file, plan, "--cycles", "20", "--workers", "1"),
        *("--vary", "nodes.first.callbacks.0.execution={constant: 1ms},{constant: 20ms}"),
        *("-o", tmp_path / "out.parquet"),
    )
    assert (early["late"], early["jitter_ns"]) == (0, 0)
    assert late["late"] > 0
    assert early["predicted_max_ns"] == late["predicted_max_ns"]


def test_wrong_use_is_named(application_file: Path, tmp_path: Path) -> None:
    sweep = ("sweep", application_file, "-o", tmp_path / "out.parquet")
    assert "is no axis" in refused(2, *sweep, "--vary", "bands")
    assert "given twice" in refused(2, *sweep, "--vary", "bands=1", "--vary", "bands=2")
    said = refused(2, *sweep, "--vary", "bands=1", "--workers", "2", "--scheduler", "host:8786")
    assert "leave out --workers, or --scheduler" in said
    said = refused(2, *sweep, "--vary", "bands=1", "--draw", tmp_path / "out.txt")
    assert "ends in .png or .pdf or .svg" in said
