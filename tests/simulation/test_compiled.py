"""Compiled functions that others changed under are compiled anew."""

import os
from pathlib import Path

from chainshaper.simulation.compiled import forget_stale


def test_what_was_compiled_before_the_newest_source_is_forgotten(tmp_path: Path) -> None:
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    for name, time in (
        ("caller.py", 10),
        ("called.py", 20),
        ("__pycache__/caller.f-1.py311.nbi", 15),
        ("__pycache__/caller.f-1.py311.1.nbc", 15),
        ("__pycache__/called.g-1.py311.nbi", 25),
        ("__pycache__/caller.cpython-311.pyc", 5),
    ):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time, time))
    forget_stale(tmp_path)
    left = sorted(file.name for file in cache.iterdir())
    assert left == ["called.g-1.py311.nbi", "caller.cpython-311.pyc"]
