"""The nodes of `tests/roles`, compiled once for all tests marked `ros2`."""

import atexit
import functools
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ros2 import ros2_environment

__all__ = ["printed", "role"]


@functools.cache
def role() -> Path:
    """The program; `role ROLE [NUMBER]` plays one."""
    environment = ros2_environment()
    folder = Path(tempfile.mkdtemp(prefix="roles-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    source = Path(__file__).parents[1] / "roles"
    settings = ["-DCMAKE_BUILD_TYPE=Release", f"-DCMAKE_PREFIX_PATH={_prefixes(environment)}"]
    for command in (["cmake", "-S", source, "-B", folder, *settings], ["cmake", "--build", folder]):
        subprocess.run(
            ["env", *map(str, command)], env=environment, check=True, capture_output=True
        )
    return folder / "role"


def _prefixes(environment: dict[str, str]) -> str:
    return environment["AMENT_PREFIX_PATH"].replace(os.pathsep, ";")


def printed(text: str, word: str) -> npt.NDArray[np.int64]:
    """The numbers in the lines that begin with a word."""
    lines = (line.split() for line in text.splitlines())
    return np.array([[int(n) for n in rest] for first, *rest in lines if first == word], np.int64)
