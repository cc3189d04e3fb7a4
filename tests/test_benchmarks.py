"""Benchmarks come to their end, whatever their random instances are."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("instances", [0, 40])
def test_band_placement_counts_instances_without_room_for_their_bands(instances: int) -> None:
    command = [sys.executable, str(BENCHMARKS / "band_placement.py"), "--samples"]
    run = subprocess.run(
        [*command, "--instances", str(instances)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    found = re.search(rf"{instances} random instances, (\d+) of them without any", run.stdout)
    assert found is not None
    assert (int(found[1]) > 0) == (instances > 0)
