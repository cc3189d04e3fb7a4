"""Machine code that is kept on disk: found again, made anew, and never in the way."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import chainshaper

_KERNEL = """
from chainshaper.compiled.memory import compiled, get, put

@compiled()
def total(table, count):
    sum = 0
    for index in range(count):
        sum += get(table, index)
        put(table, index, sum)
    return sum {more}
"""
_CALL = """
import sys
import numpy as np
from chainshaper.compiled import kernel
numbers = np.arange(1, 5)
print(kernel("made.summing", "total")(numbers.ctypes.data, 4), numbers, "numba" in sys.modules)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A package with a kernel."""
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "__init__.py").touch()
    (tmp_path / "made" / "summing.py").write_text(_KERNEL.format(more=""))
    return tmp_path


def called(folder: Path) -> str:
    path = os.pathsep.join((str(folder), str(Path(chainshaper.__file__).parents[1])))
    environment = {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(folder / "cache")}
    command = [sys.executable, "-c", _CALL]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return found.stdout.strip()


def test_the_compiler_is_needed_once_and_again_when_the_source_changed(folder: Path) -> None:
    assert called(folder) == "10 [ 1  3  6 10] True"
    assert called(folder) == "10 [ 1  3  6 10] False"
    (folder / "made" / "summing.py").write_text(_KERNEL.format(more="+ 1"))
    assert called(folder) == "11 [ 1  3  6 10] True"
    assert len(list((folder / "made" / "__pycache__").glob("*.o"))) == 1


def test_code_goes_to_the_users_cache_where_the_package_cannot_be_written(folder: Path) -> None:
    (folder / "made" / "__pycache__").touch()  # a file, which takes no other
    assert called(folder).endswith("True")
    assert len(list((folder / "cache" / "chainshaper").glob("made.summing.total-*.o"))) == 1
    assert called(folder).endswith("False")


def test_without_any_folder_every_process_compiles(folder: Path) -> None:
    (folder / "made" / "__pycache__").touch()
    (folder / "cache").touch()
    assert called(folder) == called(folder) == "10 [ 1  3  6 10] True"
