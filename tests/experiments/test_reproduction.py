"""The experiments run in short form and come to the paper's values where they can."""

import re
import subprocess
import sys
from pathlib import Path

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def _printed(name: str, *arguments: str, samples: int = 3000) -> str:
    run = subprocess.run(
        [sys.executable, EXPERIMENTS / name, "--samples", str(samples), *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_table_4_has_the_papers_slots() -> None:
    text = _printed("table_4.py")
    assert "calibrated on table 3" in text
    assert "average 67.4 (paper 67.4), maximum 84.7 (84.7), jitter 51.8 ms (51.8)" in text
    rows = dict(re.findall(r"^(\w.*)\n  slots    ours  (.*)$", text, re.MULTILINE))
    assert rows["1 server per callback"] == "[0,2) [2,22) [2,33) [33,37) [37,47) [47,98)"
    assert rows["3 1-band"] == "[0,2) [2,86) [86,87)"
    for solver in ("PSO", "exact"):
        assert rows[f"5 3-band, {solver}"] == "[0,2) [2,86) [62,63) [77,78) [86,87)"
    assert "at most 1.0 per band, 25.0 in all, paper 0.2 per band, 25 in all" in text


def test_table_5_has_the_papers_latencies() -> None:
    text = _printed("table_5.py", samples=200)
    assert re.search(r"synthetic +ours +59\.0 … 60\.0 +500\.0 … 501\.0 +100\.0 … 101\.0", text)
    assert re.search(r"parking +ours +86\.0 … 87\.0 +400\.0 … 401\.0 +100\.0 … 101\.0", text)


def test_figure_7_is_flat_beyond_four_bands(tmp_path: Path) -> None:
    drawn = tmp_path / "figure_7.png"
    text = _printed("figure_7.py", "--draw", str(drawn))
    gains = [float(gain) for gain in re.findall(r"^\d.* ([\d.]+)% ", text, re.MULTILINE)]
    assert gains[1] > gains[2] > gains[3] > 1
    assert all(gain < 1 for gain in gains[4:])
    assert "stopped at 4" in text
    assert drawn.read_bytes().startswith(b"\x89PNG")
